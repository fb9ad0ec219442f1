"""What plugins that read tables have in common: how they open them, and the entries as parameters."""

from __future__ import annotations

import mitsuba as mi

from mi_diffind import compat
from mi_diffind.task import Model, Task

from . import properties


def open_tables(props: mi.Properties, task: Task, storage: str = "") -> Model:
    """
    The model of a task's file that the properties ``filename``, ``storage`` (by default ``storage``; "": the file's own
    form) and ``preset`` (default: that of the file, or of the task) name (:meth:`.Task.open`).
    """
    given, preset = (str(props.get(name, "")) for name in ("storage", "preset"))
    return task.open(mi.TensorXf, properties.filename(props), preset, given or storage)


def described(preset: str, arrays: dict) -> dict:
    """What a report says of tables: ``preset``, ``storage`` (None: there are none) and ``table_bytes``."""
    storage = "/".join(dict.fromkeys(array.storage for array in arrays.values())) or None
    return {"preset": preset, "storage": storage, "table_bytes": sum(array.nbytes for array in arrays.values())}


def exposed(arrays: dict) -> dict:
    """Those of the arrays (name → ``DifferentiableArray``) that can be optimised."""
    return {name: array for name, array in arrays.items() if array.storage == "float32"}


def traverse(cb: mi.TraversalCallback, arrays: dict) -> None:
    """Name the entries of exposed arrays as parameters, ``tables.NAME``."""
    for name, array in arrays.items():
        cb.put(f"tables.{name}", array.data, mi.ParamFlags.Differentiable)


def check_shapes(arrays: dict) -> None:
    """Refuse entries of another shape, after parameters have changed."""
    for name, array in arrays.items():
        try:
            array.check_shape()
        except ValueError as e:
            raise RuntimeError(f'parameter "tables.{name}": {e}') from None


def optimised(arrays: dict) -> bool:
    """Is a derivative with respect to any entry asked for?"""
    return any(compat.has_gradient(array.data) for array in arrays.values())
