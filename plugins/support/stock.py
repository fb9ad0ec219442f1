"""Stock plugins of a parsed scene on their way to learned ones: what a conversion sees, and why it may refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from mi_diffind.arrays.tables import Table

from . import properties


class Kept(RuntimeError):
    """Reason for which a stock plugin stays in the scene: the rest of a sentence that begins with its name."""


@dataclass(frozen=True)
class StockNode:
    """Stock plugin of a parsed scene.

    ``props``: its properties, which a conversion changes; ``parents``: those of the objects that refer to it;
    ``nested``: type and properties of all objects below it; ``folder``: where files may be written.
    ``fit(task, source, **options)`` returns the table of the task, read from its file ``table.path``, that was fitted
    to the file ``source``, or before to the same content.
    """

    props: mi.Properties
    parents: tuple[mi.Properties, ...]
    nested: tuple[tuple[mi.ObjectType, mi.Properties], ...]
    folder: Path
    fit: Callable[..., Table]

    def nested_types(self, object_type: mi.ObjectType) -> list[str]:
        """Return the plugin names of all nested objects of one type, each once."""
        return sorted({props.plugin_name() for other, props in self.nested if other == object_type})

    def allow(self, *names: str) -> None:
        """Raise :class:`Kept` if a parameter is none of ``names``; nested objects without a name are allowed."""
        for key in self.props:
            if key not in names and not key.startswith("_arg_"):
                raise Kept(f'has the parameter "{key}", which the learned plugin lacks')

    def file(self) -> Path:
        """Return the file that ``filename`` names. Raises :class:`Kept` if there is none."""
        path = Path(properties.filename(self.props))
        if "filename" not in self.props or not path.is_file():
            raise Kept(f"names no file that exists, found {path}" if "filename" in self.props else "names no file")
        return path
