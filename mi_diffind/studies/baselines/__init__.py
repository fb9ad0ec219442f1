"""Baselines that learned tables are compared with: codecs, classical filters, grids and networks."""
