"""Mitsuba plugins, one a file. ``import mi_diffind`` registers them; nothing here needs to be imported by hand.

A plugin's module declares it as ``PLUGIN`` (:class:`Plugin`). Modules are discovered: those of this package, and those
that other packages name as entry points of the group ``mi_diffind.plugins``. Mitsuba's classes differ from variant to
variant (``mi.BSDF`` is another class in each), so a module is executed afresh for each variant (:func:`register`), now
or when the variant is set (:func:`install`): its classes keep the globals of their own variant.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from mi_diffind.core import compat, discovery

#: Modules of this package that are no plugins.
IGNORED = ("support", "mitsuba_entry")

#: Type of a plugin → the class in ``mitsuba`` whose instances its factory returns.
OBJECT_TYPES = {"bsdf": "BSDF", "texture": "Texture", "shape": "Shape", "integrator": "Integrator"}


@dataclass(frozen=True)
class Counterpart:
    """Plugin that may replace another one in a scene.

    The plugin called ``name`` takes the same parameters except ``learned_only``, and needs those of ``given`` in
    addition. If more has to change, ``convert(props)`` changes the properties (``mi.Properties``), or raises
    ``RuntimeError``; where several plugins replace one, it returns the name of the outermost. ``oversampling``: how
    many times the samples of the scene it needs to be a truth.
    """

    name: str
    learned_only: tuple[str, ...] = ()
    given: dict[str, Any] = field(default_factory=dict)
    convert: Callable[[Any], str | None] | None = None
    oversampling: int = 1

    def replace(self, props) -> None:
        """Change the properties of the plugin, in place, to those of the counterpart."""
        props.set_plugin_name((self.convert(props) if self.convert else None) or self.name)
        for key in self.learned_only:
            if key in props:
                del props[key]
        for key, value in self.given.items():
            props[key] = value


@dataclass(frozen=True)
class Stock:
    """Plugins of Mitsuba that a learned plugin can stand for, fitted to what they show if need be.

    ``word``: the name of all of them for users; ``names``: their types in a scene. ``convert(node)`` changes the
    properties of a :class:`.StockNode`, without the type, and returns what was fitted and how well, or "", or raises
    :class:`.Kept`; it returns ``None`` for a plugin that is none of these, such as a part of another. ``advised``: a
    scene gains from the learned plugin, so that it is put in without being asked for.
    """

    word: str
    names: tuple[str, ...]
    convert: Callable[[Any], str | None]
    advised: bool = False


@dataclass(frozen=True)
class Plugin:
    """Declaration of a plugin.

    - ``name``: its ``type`` in a scene; ``object_type``: one of :data:`OBJECT_TYPES`;
    - ``factory(props)``: a class, or a function, which may return an object of one of Mitsuba's own classes;
    - ``task``: the task whose tables it reads; ``storage``: their default storage form ("": that of the file);
    - ``exact``: the exact counterpart, which makes the plugin a *learned* one; ``others``: further counterparts;
      ``truths``: the counterparts that a comparison takes by default, in order; ``stock``: the plugins of Mitsuba that
      it can stand for;
    - ``seen_by``: for a shape that only some integrators see, these; ``otherwise``: the parameter and the value with
      which all others see it, too.

    Instances with a method ``report()`` describe what they do (:func:`.reports`); for an object of one
    of Mitsuba's own classes, the factory calls :func:`reports_as`.
    """

    name: str
    object_type: str
    factory: Callable[[Any], Any]
    task: str = ""
    storage: str = ""
    exact: Counterpart | None = None
    others: tuple[Counterpart, ...] = ()
    truths: tuple[str, ...] = ("exact",)
    stock: Stock | None = None
    seen_by: tuple[str, ...] = ()
    otherwise: tuple[str, str] | None = None

    def __post_init__(self):
        if self.object_type not in OBJECT_TYPES:
            allowed = ", ".join(OBJECT_TYPES)
            raise ValueError(f'plugin "{self.name}": found the object type "{self.object_type}", allowed are {allowed}')

    def counterpart(self, against: str | tuple[str, ...] = "exact") -> Counterpart | None:
        """Return the exact counterpart, or another one by its name; ``None`` if there is none.

        Of several names, the first that the plugin has a counterpart of counts.
        """
        named = {**{c.name: c for c in self.others}, "exact": self.exact}
        return next(filter(None, map(named.get, (against,) if isinstance(against, str) else against)), None)

    def describe(self, props) -> dict:
        """Return a plain description of the properties (``mi.Properties``) of an instance.

        It has the keys ``plugin``, ``kind`` (the object type), ``id`` and ``parameters`` (numbers, text, colours and
        matrices as lists, ``"texture"`` for any named object). Parameters that only the learned plugin has, and the
        file that it reads, are keys of their own.
        """
        learned = dict.fromkeys(
            (*(self.exact.learned_only if self.exact else ()), *(("filename",) if self.task else ()))
        )
        parameters = {k: self._plain(props, k) for k in props if k not in learned and not k.startswith("_arg_")}
        described = {"plugin": self.name, "kind": self.object_type, "id": props.id(), "parameters": parameters}
        return described | {key: str(props[key]) for key in learned if key in props}

    def _plain(self, props, key: str):
        word, is_transform = compat.property_kind(props, key), props.type(key) == type(props).Type.Transform
        if props.type(key) == type(props).Type.Any:
            return type(props[key]).__name__
        if word in ("object", "existing"):
            return "nested" if self.object_type == "integrator" else "texture"
        if word == "number":
            return float(props[key])
        if word == "colour":
            return [float(v) for v in props[key]]
        if is_transform:
            matrix = props[key].matrix
            return [[float(matrix[i, j]) for j in range(4)] for i in range(4)]
        return str(props[key])


#: Variant that was set → its plugins by name.
_declared: dict[str, dict[str, Plugin]] = {}

#: Objects of Mitsuba's own classes that factories returned: id → the object, its description, its report function.
_native: dict[int, list] = {}

#: Id of an object that a factory is about to return and that a scene takes apart → the part that stays in the scene.
_parts: dict[int, object] = {}


def supported(variant: str) -> bool:
    """Return whether the plugins run in a variant: in vectorised (JIT) ones with derivatives."""
    return "_ad_" in variant and not variant.endswith("_double")


def install() -> None:
    """Register the plugins with the variant that is set, if any, and with every variant that will be set."""
    import mitsuba as mi

    compat.on_variant_change(_on_variant_change)
    if mi.variant() is not None:
        register(mi.variant())


def declared() -> dict[str, Plugin]:
    """Return the plugins of the variant that is set, by name."""
    import mitsuba as mi

    return _declared.get(mi.variant(), {})


def with_counterpart(against: str = "exact") -> tuple[str, ...]:
    """Return the names of the plugins that have a counterpart: by default, those of the learned plugins."""
    return tuple(plugin.name for plugin in declared().values() if plugin.counterpart(against))


def _on_variant_change(old: str | None, new: str) -> None:
    # After a purge of sys.modules, those imported anew register their own classes
    if getattr(sys.modules.get(__name__), "_declared", None) is _declared:
        register(new)


def register(variant: str) -> None:
    """Register every plugin with ``variant``, which must be the one that is set; only the first call does anything."""
    if variant in _declared:
        return
    _declared[variant] = declarations = {}
    for plugin in _load():
        declarations[plugin.name] = plugin
        # In scalar variants, Mitsuba needs the type of every object that it loads
        factory = _checking_factory(plugin) if supported(variant) else _refusing_factory(plugin.name, variant)
        compat.register(plugin.object_type, plugin.name, factory)


def _load() -> list[Plugin]:
    """Execute the modules of plugins afresh and return their declarations."""
    # All of them first, since modules import each other; the classes of the last one derive from ``mi.Texture``
    for name in (*discovery.modules(__name__, IGNORED).values(), f"{__name__}.support.map_textures"):
        sys.modules.pop(name, None)
    return list(discovery.load(__name__, "PLUGIN", IGNORED, expected=Plugin).values())


def _refusing_factory(name: str, variant: str):
    def make(props):
        import mitsuba as mi

        usable = [v for v in mi.variants() if supported(v)]
        shown = ", ".join(usable[:2]) + (", …" if usable[2:] else "")
        raise RuntimeError(f'the plugin "{name}" does not run in the variant "{variant}"; use one of {shown}')

    return make


def _checking_factory(plugin: Plugin):
    """Return the factory to register: it checks the type of the instance and records the properties it came from."""

    def make(props):
        instance = plugin.factory(props)
        needed = getattr(compat.mi, OBJECT_TYPES[plugin.object_type])
        if not isinstance(instance, needed):  # Mitsuba would crash
            returned = "nothing" if instance is None else f"a {type(instance).__name__}"
            raise RuntimeError(
                f'plugin "{plugin.name}": the factory returned {returned}, a {plugin.object_type} is needed'
            )
        unknown = [key for key in props if not props.was_queried(key)]  # Mitsuba refuses these, if they stay so
        description = plugin.describe(props)
        for key in unknown:
            props.mark_queried(key, False)
        part = _parts.pop(id(instance), instance)
        _forget_dead()  # a dead ``roughplastic`` of Mitsuba's would keep functions from being frozen
        if hasattr(part, "__dict__"):
            # No dictionary, in whose entries ``dr.freeze`` would look for arrays
            part._origin = SimpleNamespace(description=description)
        else:
            _native.setdefault(id(part), [part, description, None])[1] = description
        return instance

    return make


def warn(text: str) -> None:
    """Warn through Mitsuba's log, or on stderr if the log hides warnings, as in the commands."""
    import mitsuba as mi

    if mi.log_level() <= mi.LogLevel.Warn:
        mi.Log(mi.LogLevel.Warn, text)
    else:
        print(f"warning: {text}", file=sys.stderr)


def reports_as(instance, report: Callable[[], dict]) -> None:
    """Attach ``report()`` to ``instance``, an object of one of Mitsuba's own classes that a factory is about to return.

    ``report`` replaces the method of that name of plugins written in Python. It must not hold the object.
    """
    _forget_dead()
    _native[id(instance)] = [instance, None, report]


def shown_as(instance, part) -> None:
    """Declare that only ``part`` of ``instance`` stays in the scene.

    A factory calls this before it returns an object that scenes take apart and drop, such as a ``merge`` of shapes.
    """
    _parts[id(instance)] = part


def _forget_dead() -> None:
    """Drop the native objects that nothing else refers to."""
    for key, entry in list(_native.items()):
        if not compat.is_shared(entry):
            _native.pop(key, None)


def origin(instance) -> dict | None:
    """Return the description of an instance of a plugin (:meth:`Plugin.describe`); ``None`` for any other object."""
    recorded = getattr(instance, "_origin", None)
    if recorded is not None:
        return recorded.description
    entry = _native.get(id(instance))
    return None if entry is None else entry[1]


def report(instance) -> dict | None:
    """Return the report of an instance of a plugin; ``None`` if it has none."""
    if hasattr(instance, "report"):
        return instance.report()
    entry = _native.get(id(instance))
    return None if entry is None or entry[2] is None else entry[2]()
