"""Entry point of the group ``mitsuba``, which Mitsuba 3.10 and later load: all plugins, without ``import mi_diffind``.

Mitsuba imports this module when the first variant is set and loads it anew after each change of variant (``[project.
entry-points.mitsuba]`` in ``pyproject.toml``). Plugins are registered once for each variant, whatever else has
registered them before (:func:`mi_diffind.plugins.register`). Mitsuba 3.9 does not know entry points.
"""

import mitsuba as mi

from .. import plugins

if mi.variant() is not None:
    plugins.register(mi.variant())
