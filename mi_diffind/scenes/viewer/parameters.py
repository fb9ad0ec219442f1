"""Scalars and colours of a loaded scene that sliders may change, by names that a person can read."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ... import plugins
from ...core.errors import UsageError
from ..inspection import owners_of, paths_of

#: Parameters of a sensor that are listed, with their ranges; its position is the mouse's.
OF_SENSORS = {"x_fov": (1.0, 170.0)}

#: Exponents of two that a slider's range may have.
WIDEST = 100


@dataclass(frozen=True)
class NamedParameter:
    """A number or a colour of a scene.

    ``owner`` is the name of the object that groups it, ``name`` its name within. ``value`` is a number or the three
    components of a linear colour when the scene was loaded; ``low`` and ``high`` limit a slider.
    """

    owner: str
    name: str
    value: float | tuple[float, float, float]
    low: float
    high: float

    @property
    def path(self) -> str:
        """Unique name in a scene: ``owner.name``."""
        return f"{self.owner}.{self.name}"

    @property
    def is_colour(self) -> bool:
        """Whether the value has three components."""
        return isinstance(self.value, tuple)


class NamedParameters:
    """Scalars and colours of a loaded scene, by :attr:`NamedParameter.path`; this package's plugins come first.

    A parameter of ``mi.traverse`` is listed if it is one number or one colour, and finite. Tables, transformations,
    switches and whole numbers are not.
    """

    def __init__(self, scene):
        self._params = mi.traverse(scene)
        paths = paths_of(scene)
        owners = owners_of(paths)
        listed, self._keys = [], {}
        for key in self._params.keys():
            path = next(p for p in _parents(key) if p in owners)
            if isinstance(paths[path], (mi.Film, mi.Sampler)):
                continue
            if isinstance(paths[path], mi.Sensor) and key.rpartition(".")[2] not in OF_SENSORS:
                continue
            value = _plain(self._params[key])
            if value is None:
                continue
            owner, _, inner = owners[path].partition(".") if not owners[path].startswith("(") else _nested(owners[path])
            name = ".".join(filter(None, (inner, key[len(path) :].strip("."))))
            limits = OF_SENSORS.get(name) or _limits(value)
            parameter = NamedParameter(owner, name.removesuffix(".value") or "value", value, *limits)
            if parameter.path not in self._keys:
                self._keys[parameter.path] = key
                listed.append((_is_ours(paths, path), parameter))
        listed.sort(key=lambda pair: not pair[0])
        self.listed = {parameter.path: parameter for _, parameter in listed}

    def __contains__(self, path: str) -> bool:
        return path in self.listed

    def value(self, path: str) -> float | tuple[float, float, float]:
        """Return the value that a parameter has now."""
        return _plain(self._params[self._keys[path]])

    def set(self, values: Mapping[str, float | tuple[float, float, float]]) -> None:
        """Give parameters other values and update the scene.

        Raises :class:`.UsageError` for a parameter that is not listed or a value that is no finite
        number, or colour; the scene then stays as it is.
        """
        checked = {path: self.checked(path, value) for path, value in values.items()}
        for path, value in checked.items():
            key = self._keys[path]
            value_type = type(self._params[key])
            # Opaque: another value needs no other kernel
            self._params[key] = value if value_type is float else dr.opaque(value_type, value)
        self._params.update()

    def checked(self, path: str, value):
        """Return a value as the parameter holds it. Raises :class:`.UsageError`."""
        if path not in self.listed:
            raise UsageError(f'parameter "{path}": not one of the {len(self.listed)} numbers and colours of the scene')
        wanted = self.listed[path]
        try:
            numbers = tuple(float(x) for x in value) if wanted.is_colour else float(value)
        except (TypeError, ValueError):
            numbers = None
        expected = "three finite numbers" if wanted.is_colour else "a finite number"
        parts = numbers if isinstance(numbers, tuple) else (numbers,)
        if numbers is None or len(parts) != (3 if wanted.is_colour else 1) or not all(map(math.isfinite, parts)):
            raise UsageError(f'parameter "{path}": found {str(value)[:40]}, expected {expected}')
        return numbers


def counterparts(paths: Iterable[str], exact: NamedParameters) -> dict[str, str]:
    """Return the parameters of the exact scene by those of the learned one, as far as both have them.

    Objects without an id are named by their plugin, which differs between the two.
    """
    names = {
        name: plugin.exact.name for name, plugin in plugins.declared().items() if plugin.exact
    }  # "(neural_disney 2)" → "(disney 2)"
    pairs = {}
    for path in paths:
        other = re.sub(r"^\((\w+)", lambda match: f"({names.get(match[1], match[1])}", path)
        if other in exact:
            pairs[path] = other
    return pairs


def _parents(key: str):
    """Yield the dotted prefixes of a key, the longest first, down to the empty one of the scene."""
    while key:
        key = key.rpartition(".")[0]
        yield key


def _nested(owner: str) -> tuple[str, str, str]:
    """Split the name of an object without an id, such as ``(Sphere 2).bsdf``, whose plugin may contain no dot."""
    head, _, rest = owner.partition(")")
    return f"{head})", ".", rest.lstrip(".")


def _is_ours(paths: Mapping[str, object], path: str) -> bool:
    """Return whether an object, or one that it is nested in, is a plugin of this package."""
    return any(plugins.origin(paths[p]) is not None for p in (path, *_parents(path)) if p in paths)


def _plain(value) -> float | tuple[float, float, float] | None:
    """Return a parameter as a number or a colour, ``None`` if it is neither."""
    if isinstance(value, bool):
        return None
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, mi.Float) and len(value) == 1:
        number = float(value[0])
        return number if math.isfinite(number) else None
    if mi.is_rgb and isinstance(value, mi.Color3f) and dr.width(value) == 1:
        colour = tuple(float(x[0]) for x in value)
        return colour if all(map(math.isfinite, colour)) else None
    return None


def _limits(value: float | tuple[float, ...]) -> tuple[float, float]:
    """Return the range of a slider: [0, 1], or up to the power of two above twice the value; negative likewise."""
    largest = max(map(abs, value)) if isinstance(value, tuple) else abs(value)
    high = 1.0 if largest <= 1 else 2.0 ** min(math.ceil(math.log2(2 * largest)), WIDEST)
    negative = min(value) < 0 if isinstance(value, tuple) else value < 0
    return (-high if negative else 0.0), high
