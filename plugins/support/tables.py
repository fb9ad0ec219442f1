"""Tables of plugins: opening their file, and exposing their entries as parameters."""

from __future__ import annotations

from types import ModuleType

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat
from mi_diffind.fitting.task import Model, Task

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


def traverse(cb: mi.TraversalCallback, arrays: dict) -> None:
    """Expose the entries of arrays as parameters ``tables.NAME``."""
    for name, array in arrays.items():
        cb.put(f"tables.{name}", array.data, mi.ParamFlags.Differentiable)


class Entries:
    """Entries that are exposed as parameters, which are of their shape and in memory of Dr.Jit.

    ``exposed``, by name, are tensors, or arrays (``DifferentiableArray``), which check their shape.
    """

    def __init__(self, exposed: dict):
        self._exposed = exposed
        self._shapes = {name: tuple(_tensor(entries).shape) for name, entries in exposed.items()}
        self._accepted = {}
        self.accept()

    def accept(self) -> None:
        """Take assigned entries over, into memory of Dr.Jit (:func:`.memory.owned`).

        Raises ``RuntimeError`` for those of another shape, after the entries before are put back: a read would go
        beyond the end.
        """
        refused = []
        for name, entries in self._exposed.items():
            tensor, accepted = _tensor(entries), self._accepted.get(name)
            if fault := self._fault(name, entries):
                refused.append(f'parameter "tables.{name}": {fault}')
                compat.assign(tensor, accepted)
            elif accepted is None or compat.identity(accepted) != compat.identity(tensor):
                compat.assign(tensor, type(tensor)(compat.owned(tensor.array), tensor.shape))
            self._accepted[name] = dr.detach(tensor)  # a reference keeps the variable's index from being used again
        if refused:
            raise RuntimeError(refused[0])

    def _fault(self, name: str, entries) -> str:
        if dr.is_tensor_v(entries):
            shape, expected = tuple(entries.shape), self._shapes[name]
            return "" if shape == expected else f"has the shape {shape}, expected {expected}"
        try:
            entries.check_shape()
        except ValueError as e:
            return str(e)
        return ""

    def shapes(self) -> list[tuple]:
        """Return the present shapes, which decide what is traced: the last axis may be padded or not."""
        return [tuple(_tensor(entries).shape) for entries in self._exposed.values()]


def _tensor(entries):
    return entries if dr.is_tensor_v(entries) else entries.data


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
    if hasattr(value, "__dict__") and not isinstance(value, (type, ModuleType)):
        value = vars(value)
    inside = value.values() if isinstance(value, dict) else value if isinstance(value, (list, tuple)) else ()
    return [array for one in inside for array in arrays_of(one, visited)]


def optimised(arrays: dict) -> bool:
    """Return whether gradients of any entry are enabled."""
    return any(compat.has_gradient(array.data) for array in arrays.values())
