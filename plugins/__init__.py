"""
Mitsuba plugins, one a file. ``import mi_diffind`` registers them; nothing here needs to be imported by hand.

Mitsuba's classes differ from variant to variant (``mi.BSDF`` is another class in each). A plugin's module therefore
defines its class for the variant that is set, as Mitsuba's own Python plugins do, and is executed once for each variant
(:func:`register`), now or when the variant is set (:func:`install`).
"""

from __future__ import annotations

import importlib
import sys
from dataclasses import dataclass, field

#: Modules of this package that define a plugin, and what it is, in an order in which each follows those that it builds
#: upon.
MODULES = {"disney": "bsdf", "neural_disney": "bsdf", "neural_ggx": "bsdf", "neural_image": "texture"}


@dataclass(frozen=True)
class Counterpart:
    """
    What is exact where a learned plugin is not: the ``name`` of a plugin that takes the same parameters but those of
    ``learned_only``, and needs those of ``given`` in addition. ``convert``, as ``"module.function"`` of this package,
    is what turns the properties of the one into those of the other if that is not all there is to it.
    """

    name: str
    learned_only: tuple[str, ...]
    given: dict[str, str] = field(default_factory=dict)
    convert: str = ""

    def replace(self, props) -> None:
        """Turn the properties (``mi.Properties``) of the learned plugin into those of the exact one, in place."""
        if self.convert:
            module, function = self.convert.split(".")
            getattr(importlib.import_module(f"{__name__}.{module}"), function)(props)
        props.set_plugin_name(self.name)
        for key in self.learned_only:
            if key in props:
                del props[key]
        for key, value in self.given.items():
            props[key] = value


#: The exact counterpart of each learned plugin.
EXACT_COUNTERPARTS = {
    "neural_disney": Counterpart("disney", ("quality", "effects", "filename", "storage")),
    "neural_ggx": Counterpart("roughconductor", ("quality", "filename", "storage"), {"distribution": "ggx"}),
    "neural_image": Counterpart(
        "bitmap", ("filename", "channels", "storage", "source"), convert="image_files.to_bitmap"
    ),
}

_registered: set[str] = set()


def supported(variant: str) -> bool:
    """Can the plugins run in this variant? Python plugins need a vectorised (JIT) one with derivatives."""
    return "_ad_" in variant and not variant.endswith("_double")


def install() -> None:
    """Register the plugins with the variant that is set, if any, and with every one that will be set."""
    import mitsuba as mi

    mi.detail.add_variant_callback(_on_variant_change)  # a set: the second time changes nothing
    if mi.variant() is not None:
        register(mi.variant())


def _on_variant_change(old: str | None, new: str) -> None:
    register(new)


def register(variant: str) -> None:
    """Register every plugin with ``variant``, which must be the one that is set. Does nothing the second time."""
    import mitsuba as mi

    if variant in _registered:
        return
    if not supported(variant):
        for name, kind in MODULES.items():
            getattr(mi, f"register_{kind}")(name, _refusal(name, variant))
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
