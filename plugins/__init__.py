"""
Mitsuba plugins, one a file. ``import mi_diffind`` registers them; nothing here needs to be imported by hand.

A plugin's module defines its class for the variant that is set, as Mitsuba's own Python plugins do, and is therefore
executed once for each variant (:func:`register`).
"""

from __future__ import annotations

import importlib
import sys

#: Modules of this package that define a plugin, in an order in which each follows those that it builds upon.
MODULES = ("disney", "neural_disney")

#: For each learned plugin: its exact counterpart and the parameters that only the learned one has.
EXACT_COUNTERPARTS = {"neural_disney": ("disney", ("filename", "storage"))}

_registered: set[str] = set()


def supported(variant: str) -> bool:
    """Can the plugins run in this variant? Python plugins need a vectorised (JIT) one with derivatives."""
    return "_ad_" in variant and not variant.endswith("_double")


def register(variant: str) -> None:
    """Register every plugin with ``variant``, which must be the one that is set. Does nothing the second time."""
    import mitsuba as mi

    if variant in _registered:
        return
    if not supported(variant):
        for name in MODULES:
            mi.register_bsdf(name, _refusal(name, variant))
    else:
        for name in MODULES:
            qualified = f"{__name__}.{name}"
            if qualified in sys.modules:
                importlib.reload(sys.modules[qualified])
            else:
                importlib.import_module(qualified)
    _registered.add(variant)


def _refusal(name: str, variant: str):
    def factory(props):
        import mitsuba as mi

        usable = ", ".join(v for v in mi.variants() if supported(v))
        raise RuntimeError(f'the plugin "{name}" does not run in the variant "{variant}"; use one of {usable}')

    return factory
