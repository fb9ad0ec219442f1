"""Tables of plugins: opening their file, and exposing their entries as parameters."""

from __future__ import annotations

from types import ModuleType

import drjit as dr
import mitsuba as mi

from mi_diffind import compat
from mi_diffind.task import Model, Task

from . import properties


def open_tables(props: mi.Properties, task: Task, storage: str = "") -> Model:
    """Open the file that the properties ``filename``, ``storage`` and ``preset`` name (:meth:`.Task.open`).

    ``storage`` is the default of the property of that name ("": the form of the file); ``preset`` defaults to that of
    the file, or of the task.
    """
    given, preset = (str(props.get(name, "")) for name in ("storage", "preset"))
    return task.open(mi.TensorXf, properties.filename(props), preset, given or storage)


def described(preset: str, arrays: dict) -> dict:
    """Return the part of a report on tables: ``preset``, ``storage`` (None without tables) and ``table_bytes``."""
    storage = "/".join(dict.fromkeys(array.storage for array in arrays.values())) or None
    return {"preset": preset, "storage": storage, "table_bytes": sum(array.nbytes for array in arrays.values())}


def exposed(arrays: dict) -> dict:
    """Return those of the arrays (name → ``DifferentiableArray``) that can be optimised."""
    return {name: array for name, array in arrays.items() if array.storage == "float32"}


def copy_entries(arrays: dict) -> None:
    """Copy the entries of arrays that can be optimised from NumPy's memory to that of Dr.Jit.

    Frozen functions (``dr.freeze``) of Dr.Jit 1.5 take entries in foreign memory for constants: a change would not be
    seen.
    """
    for array in exposed(arrays).values():
        entries, shape = array.data.array, array.data.shape
        one, zero = (dr.opaque(type(entries), number) for number in (1.0, -0.0))
        array.data = type(array.data)(dr.fma(entries, one, zero), shape)  # no number changes, not even −0 and NaN
        dr.eval(array.data)


def traverse(cb: mi.TraversalCallback, arrays: dict) -> None:
    """Expose the entries of arrays as parameters ``tables.NAME``."""
    for name, array in arrays.items():
        cb.put(f"tables.{name}", array.data, mi.ParamFlags.Differentiable)


def check_shapes(arrays: dict) -> None:
    """Raise ``RuntimeError`` if a changed parameter has another shape."""
    for name, array in arrays.items():
        try:
            array.check_shape()
        except ValueError as e:
            raise RuntimeError(f'parameter "tables.{name}": {e}') from None


def arrays_of(value, visited: set | None = None) -> list:
    """Return the Dr.Jit arrays of an object and of all objects that it refers to.

    A plugin keeps them as an attribute of its instance, since a frozen function (``dr.freeze``) does not traverse other
    objects.
    """
    visited = set() if visited is None else visited
    if id(value) in visited:
        return []
    visited.add(id(value))
    if isinstance(value, dr.ArrayBase):
        value = value.array if dr.is_tensor_v(value) else value
        return [value] if dr.is_jit_v(value) else []
    if isinstance(value, dict):
        inside = value.values()
    elif isinstance(value, (list, tuple)):
        inside = value
    else:
        inside = (
            vars(value).values() if hasattr(value, "__dict__") and not isinstance(value, (type, ModuleType)) else ()
        )
    return [array for one in inside for array in arrays_of(one, visited)]


def optimised(arrays: dict) -> bool:
    """Return whether gradients of any entry are enabled."""
    return any(compat.has_gradient(array.data) for array in arrays.values())
