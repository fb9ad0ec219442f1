"""
What each task fills into the frame of :mod:`mi_diffind.tradeoff`. A module builds its candidates with the plugins, so
this package lies above them.
"""

#: Tasks with a study: ``mi_diffind.tradeoffs.NAME.study(quick)``, to be called with a Mitsuba variant set.
TASKS = ("disney", "ggx")
