"""Properties of plugins: checks, and those of stock plugins on their way to learned ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from mi_diffind.arrays.tables import Table
from mi_diffind.core.errors import DiffindError, raised_as


def refused_as(name: str = ""):
    """Raise errors of this package as ``RuntimeError``, as Mitsuba's plugins do; ``name`` is the parameter at fault."""
    return raised_as(RuntimeError, DiffindError, at=f'parameter "{name}"' if name else "")


def one_of(props: mi.Properties, name: str, allowed: tuple[str, ...]) -> str:
    """Return a property that is one of some words, the first by default."""
    value = props.get(name, allowed[0])
    if value not in allowed:
        raise RuntimeError(f'parameter "{name}": found "{value}", allowed are {", ".join(allowed)}')
    return str(value)


def flag(props: mi.Properties, name: str, default: bool = False) -> bool:
    """Return a property that is true or false."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise RuntimeError(f'parameter "{name}": found {value}, allowed are true and false')
    return value


def is_number(props: mi.Properties, name: str) -> bool:
    """Return whether the property ``name``, which must exist, is a number."""
    return props.type(name) in (mi.Properties.Type.Float, mi.Properties.Type.Integer)


def check_range(props: mi.Properties, name: str, low: float, high: float) -> None:
    """Refuse a number outside of ``[low, high]``.

    Textures are not checked, since a constructor would have to wait for a kernel.
    """
    if name in props and is_number(props, name):
        value = float(props[name])
        if not low <= value <= high:  # NaN, too
            raise RuntimeError(f'parameter "{name}": found {value:g}, allowed is [{low}, {high}]')


def remove(props: mi.Properties, *names: str) -> None:
    """Remove properties, those that are there."""
    for name in names:
        if name in props:
            del props[name]


def filename(props: mi.Properties) -> str:
    """Return the property ``filename`` as Mitsuba resolves it, or ""."""
    name = str(props.get("filename", ""))
    return str(mi.file_resolver().resolve(name)) if name else ""


class Kept(RuntimeError):
    """Reason for which a stock plugin stays in the scene: the rest of a sentence that begins with its name."""


@dataclass(frozen=True)
class StockNode:
    """Stock plugin of a parsed scene.

    ``props``: its properties, which a conversion changes; ``parents``: those of the objects that refer to it, the scene
    left out; ``children``: the objects that it nests or refers to, by parameter; ``shared``: it is nested in one
    object and others refer to it; ``folder``: where files may be written. ``fit(task, source, **options)`` returns the
    table of the task, read from its file ``table.path``, that was fitted to the file ``source``, or before to the same
    content.
    """

    object_type: mi.ObjectType
    props: mi.Properties
    parents: tuple[mi.Properties, ...]
    children: dict[str, StockNode]
    shared: bool
    folder: Path
    fit: Callable[..., Table]

    @property
    def name(self) -> str:
        """Name of the plugin."""
        return self.props.plugin_name()

    def nested_types(self, object_type: mi.ObjectType) -> list[str]:
        """Return the plugin names of all nested objects of one type, each once."""
        return sorted({name for child in self.children.values() for name in child._types(object_type)})

    def _types(self, object_type: mi.ObjectType) -> list[str]:
        return [*self.nested_types(object_type), *([self.name] if self.object_type == object_type else [])]

    def allow(self, *names: str) -> None:
        """Raise :class:`Kept` if a parameter is none of ``names``; nested objects without a name are allowed."""
        for key in self.props:
            if key not in names and not key.startswith("_arg_"):
                raise Kept(f'has the parameter "{key}", which the learned plugin lacks')

    def file(self) -> Path:
        """Return the file that ``filename`` names. Raises :class:`Kept` if there is none."""
        path = Path(filename(self.props))
        if "filename" not in self.props or not path.is_file():
            raise Kept(f"names no file that exists, found {path}" if "filename" in self.props else "names no file")
        return path
