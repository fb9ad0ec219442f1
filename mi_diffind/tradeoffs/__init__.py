"""
What each task fills into the frame of :mod:`mi_diffind.tradeoff`. A module builds its candidates with the plugins, so
this package lies above them.
"""

#: Tasks with a study (``mi_diffind.tradeoffs.NAME.study(quick)``, to be called with a variant set), and what it is of.
TASKS = {"disney": "all forms of the Disney BRDF", "ggx": "all forms of the GGX distribution"}
