"""
Mitsuba plugins, one a file. ``import mi_diffind`` registers them; nothing here needs to be imported by hand.

A plugin's module says in ``PLUGIN`` what it is (:class:`Plugin`). The modules of this package are found, and those that
other packages name as entry points of the group ``mi_diffind.plugins``. Mitsuba's classes differ from variant to
variant (``mi.BSDF`` is another class in each), so a module is executed afresh for each (:func:`register`), now or when
the variant is set (:func:`install`): its classes keep the globals of their own variant.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from mi_diffind import compat, discovery

#: What lies beside the plugins and is none.
IGNORED = ("support",)

#: What a plugin may be → the class in ``mitsuba`` whose instances its factory returns.
KINDS = {"bsdf": "BSDF", "texture": "Texture", "shape": "Shape", "volume": "Volume", "integrator": "Integrator"}


@dataclass(frozen=True)
class Counterpart:
    """
    Another plugin that may stand in the place of one: the ``name`` of one that takes the same parameters but those of
    ``learned_only``, and needs those of ``given`` in addition. ``convert(props)``, if that is not all there is to it,
    turns the properties (``mi.Properties``) of the one into those of the other, or raises ``RuntimeError``.
    """

    name: str
    learned_only: tuple[str, ...] = ()
    given: dict[str, Any] = field(default_factory=dict)
    convert: Callable[[Any], None] | None = None

    def replace(self, props) -> None:
        """Turn the properties of the plugin into those of the counterpart, in place."""
        if self.convert:
            self.convert(props)
        props.set_plugin_name(self.name)
        for key in self.learned_only:
            if key in props:
                del props[key]
        for key, value in self.given.items():
            props[key] = value


@dataclass(frozen=True)
class Plugin:
    """
    A plugin: its ``name`` in a scene; its ``kind`` (:data:`KINDS`); ``factory(props)``, a class or a function, which
    may return an object of Mitsuba's own; the ``task`` whose tables it reads, and their storage form by default ("":
    the file's). One that has an ``exact`` counterpart is *learned*; ``others`` may stand in its place, too. Of a shape
    that only some integrators see, these (``seen_by``), and the parameter and its value by which all others see it
    (``otherwise``).

    Instances with a method ``report()`` say what they do (:func:`mi_diffind.scenes.reports`); for an object of
    Mitsuba's own, its factory says so with :func:`reports_as`.
    """

    name: str
    kind: str
    factory: Callable[[Any], Any]
    task: str = ""
    storage: str = ""
    exact: Counterpart | None = None
    others: tuple[Counterpart, ...] = ()
    seen_by: tuple[str, ...] = ()
    otherwise: tuple[str, str] | None = None

    def __post_init__(self):
        if self.kind not in KINDS:
            raise ValueError(f'the kind of "{self.name}" is "{self.kind}", allowed are {", ".join(KINDS)}')

    def counterpart(self, against: str = "exact") -> Counterpart | None:
        """The exact counterpart, or another one by its name; ``None`` if there is none."""
        return self.exact if against == "exact" else next((c for c in self.others if c.name == against), None)

    def described(self, props) -> dict:
        """
        What properties (``mi.Properties``) say: ``plugin``, ``kind``, ``id``, ``parameters`` (numbers, text, colours
        and matrices as lists, ``"texture"`` for any object with a name), and by themselves those that only the learned
        plugin has, and the file that it reads.
        """
        learned_only = self.exact.learned_only if self.exact else ()
        if self.task and "filename" not in learned_only:
            learned_only = (*learned_only, "filename")
        return {
            "plugin": self.name,
            "kind": self.kind,
            "id": props.id(),
            "parameters": {
                key: _plain(props, key, self.kind)
                for key in props
                if key not in learned_only and not key.startswith("_arg_")
            },
            **{key: str(props[key]) for key in learned_only if key in props},
        }


#: For each variant that was set: the plugins by name.
_declared: dict[str, dict[str, Plugin]] = {}

#: Objects of Mitsuba's own that factories returned: id → the object, what its properties said, what it does.
_native: dict[int, list] = {}

#: What factories are about to return, if a scene takes it apart: id → the part of it that is looked for.
_parts: dict[int, object] = {}


def supported(variant: str) -> bool:
    """Can the plugins run in this variant? Python plugins need a vectorised (JIT) one with derivatives."""
    return "_ad_" in variant and not variant.endswith("_double")


def install() -> None:
    """Register the plugins with the variant that is set, if any, and with every one that will be set."""
    import mitsuba as mi

    compat.on_variant_change(_on_variant_change)
    if mi.variant() is not None:
        register(mi.variant())


def declared() -> dict[str, Plugin]:
    """The plugins of the variant that is set, by name."""
    import mitsuba as mi

    return _declared.get(mi.variant(), {})


def with_counterpart(against: str = "exact") -> tuple[str, ...]:
    """The names of the plugins that have this counterpart; of the learned ones by default."""
    return tuple(plugin.name for plugin in declared().values() if plugin.counterpart(against))


def _on_variant_change(old: str | None, new: str) -> None:
    register(new)


def register(variant: str) -> None:
    """Register every plugin with ``variant``, which must be the one that is set. Does nothing the second time."""
    import mitsuba as mi

    if variant in _declared:
        return
    _declared[variant] = known = {}
    for plugin in _load():
        known[plugin.name] = plugin
        if supported(variant):
            make = _checked(plugin)
        elif plugin.kind != "volume":  # for scalar variants, Mitsuba cannot do without the type of what it loads
            make = _refusal(plugin.name, variant)
        else:
            continue
        # Of volumes, Mitsuba's Python interface knows nothing; in a scene, they are looked up among textures
        getattr(mi, f"register_{'texture' if plugin.kind == 'volume' else plugin.kind}")(plugin.name, make)


def _load() -> list[Plugin]:
    """Execute the modules of plugins afresh, and return what they declare."""
    for name in discovery.modules(__name__, IGNORED).values():  # all of them first, since one may build upon another
        sys.modules.pop(name, None)
    return list(discovery.load(__name__, "PLUGIN", IGNORED, expected=Plugin).values())


def _refusal(name: str, variant: str):
    def make(props):
        import mitsuba as mi

        usable = ", ".join(v for v in mi.variants() if supported(v))
        raise RuntimeError(f'the plugin "{name}" does not run in the variant "{variant}"; use one of {usable}')

    return make


def _checked(plugin: Plugin):
    """The factory as Mitsuba gets it: it returns what it should, and it is known what that was made from."""

    def make(props):
        import mitsuba as mi

        made = plugin.factory(props)
        kind = getattr(mi, KINDS[plugin.kind])
        if not isinstance(made, kind):  # Mitsuba would crash, or speak of a bad cast
            found = "nothing" if made is None else f"a {type(made).__name__}"
            raise RuntimeError(f'the factory of the plugin "{plugin.name}" returned {found}, a {plugin.kind} is needed')
        unknown = [key for key in props if not props.was_queried(key)]  # Mitsuba refuses these, if they stay so
        said = plugin.described(props)
        for key in unknown:
            props.mark_queried(key, False)
        shown = _parts.pop(id(made), made)
        if hasattr(shown, "__dict__"):
            shown._made_from = _Origin(said)
        else:
            _forget_dead()
            _native.setdefault(id(shown), [shown, said, None])[1] = said
        return made

    return make


class _Origin:
    """What an instance was made from: not a dictionary, in whose entries ``dr.freeze`` would look for arrays."""

    def __init__(self, said: dict):
        self.said = said


def warn(text: str) -> None:
    """Warn by Mitsuba's log; on stderr where that is told to be quiet, as commands tell it."""
    import mitsuba as mi

    if mi.log_level() <= mi.LogLevel.Warn:
        mi.Log(mi.LogLevel.Warn, text)
    else:
        print(f"warning: {text}", file=sys.stderr)


def reports_as(made, report: Callable[[], dict]) -> None:
    """
    For a factory that is about to return ``made``, an object of Mitsuba's own: ``report()`` says what it does, as the
    method of that name of a plugin written in Python does. It must not hold the object.
    """
    _forget_dead()
    _native[id(made)] = [made, None, report]


def shown_as(made, part) -> None:
    """
    For a factory that is about to return ``made``, an object of Mitsuba's own that a scene takes apart and drops, as a
    ``merge`` of shapes: what is left of it in the scene is ``part``.
    """
    _parts[id(made)] = part


def _forget_dead() -> None:
    """Drop the native objects that nothing else refers to."""
    for key, entry in list(_native.items()):
        if not compat.is_shared(entry):
            del _native[key]


def origin(made) -> dict | None:
    """What the properties of an instance of a plugin said (:meth:`Plugin.described`); ``None`` for any other object."""
    found = getattr(made, "_made_from", None)
    if found is not None:
        return found.said
    entry = _native.get(id(made))
    return None if entry is None else entry[1]


def report(made) -> dict | None:
    """What an instance of a plugin says that it does; ``None`` if it says nothing."""
    if hasattr(made, "report"):
        return made.report()
    entry = _native.get(id(made))
    return None if entry is None or entry[2] is None else entry[2]()


def _plain(props, key: str, owner: str):
    kind, types = props.type(key), type(props).Type
    if kind in (types.Float, types.Integer):
        return float(props[key])
    if kind == types.Color:
        return [float(v) for v in props[key]]
    if kind in (types.Reference, types.ResolvedReference, types.Object):
        return "nested" if owner == "integrator" else "texture"
    if kind == types.Transform:
        m = props[key].matrix
        return [[float(m[i, j]) for j in range(4)] for i in range(4)]
    if kind == types.Any:
        return type(props[key]).__name__
    return str(props[key])
