"""Differentiable arrays, the indirection, and table files."""
