"""Tables of plugins: opening their file, exposing their entries, and showing them to frozen functions.

A frozen function (``dr.freeze``) sees the Dr.Jit arrays in attributes of a plugin's instance, also in lists,
dictionaries, dataclasses and PyTrees there. It records again if their number, their types or the equality of their
sizes change; it sees neither numbers of Python nor sizes. Arrays in memory that Dr.Jit did not allocate, such as
NumPy's, are constants of a recording.
"""

from __future__ import annotations

import hashlib
import threading
import weakref
from collections.abc import Callable
from types import ModuleType

import drjit as dr
import mitsuba as mi

from mi_diffind.arrays.tables import Table
from mi_diffind.core import compat
from mi_diffind.fitting.task import Model, Task

from . import properties

#: Types of Dr.Jit's literals that stand for the digits of a key.
_DIGITS = ("Int8", "UInt8", "Int32", "UInt32", "Int64", "UInt64", "Float16", "Float64")

#: Digits of a key: 2⁴⁸ keys.
_LENGTH = 16


def open_tables(props: mi.Properties, task: Task, storage: str = "") -> Model:
    """Open the file that the properties ``filename``, ``storage`` and ``preset`` name (:meth:`.Task.open`).

    ``storage`` is the default of the property of that name ("": the form of the file); ``preset`` defaults to that of
    the file, or of the task.
    """
    given, preset = (str(props.get(name, "")) for name in ("storage", "preset"))
    return task.open(mi.TensorXf, properties.filename(props), preset, given or storage)


def file_and_storage(props: mi.Properties, task: str) -> tuple[str, str]:
    """Return the properties ``filename``, a file of a task, and ``storage``. Raises ``RuntimeError``."""
    path, storage = properties.filename(props), properties.one_of(props, "storage", ("uint8", "float32"))
    if not path:
        raise RuntimeError(f'parameter "filename": not given, a file of "mi-diffind fit {task}" is needed')
    return path, storage


class Entries:
    """Entries that are exposed as parameters ``tables.NAME``, of their shape and in memory of Dr.Jit.

    ``exposed``, by name, are tensors, or arrays (``DifferentiableArray``), which check their shape.
    """

    def __init__(self, exposed: dict):
        self.exposed = exposed
        self._shapes = {name: tuple(_tensor(entries).shape) for name, entries in exposed.items()}
        self._accepted = {}
        self.accept()

    def traverse(self, cb: mi.TraversalCallback) -> None:
        """Expose the entries."""
        for name, entries in self.exposed.items():
            cb.put(f"tables.{name}", _tensor(entries), mi.ParamFlags.Differentiable)

    def accept(self) -> None:
        """Take assigned entries over, into memory of Dr.Jit (:func:`.memory.owned`).

        Raises ``RuntimeError`` for those of another shape, after the entries before are put back: a read would go
        beyond the end.
        """
        refused = []
        for name, entries in self.exposed.items():
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
        return [tuple(_tensor(entries).shape) for entries in self.exposed.values()]

    def optimised(self) -> bool:
        """Return whether gradients of any entry are enabled."""
        return any(compat.has_gradient(_tensor(entries)) for entries in self.exposed.values())


class Tables(Entries):
    """Arrays (name → ``DifferentiableArray``) that a plugin reads; those of 32-bit floats are exposed.

    ``table`` is the table of the file that they are from, ``None`` without a file; ``names`` are the arrays that may be
    exposed (default: all).
    """

    def __init__(self, arrays: dict, table: Table | None = None, names: tuple[str, ...] | None = None):
        names = arrays if names is None else names
        super().__init__({n: arrays[n] for n in names if n in arrays and arrays[n].storage == "float32"})
        self.arrays, self.table = arrays, table

    def report(self) -> dict:
        """Return the part of a plugin's report on tables; the storage is ``None`` without arrays."""
        arrays = self.arrays.values()
        return {
            "preset": self.table.preset if self.table else "",
            "storage": "/".join(dict.fromkeys(array.storage for array in arrays)) or None,
            "table_bytes": sum(array.nbytes for array in arrays),
        }


_alive: weakref.WeakValueDictionary = weakref.WeakValueDictionary()

#: Lock of objects that threads share; a thread that waits for a kernel may enter another constructor.
lock = threading.RLock()


def shared(key: tuple, make: Callable, is_usable: Callable = bool):
    """Return ``make()``, or its earlier result for this ``key`` if that is still in use and ``is_usable``.

    Dr.Jit merges equal reads of several plugins only if they share their variables.
    """
    with lock:
        value = _alive.get(key)
        if value is None or not is_usable(value):
            value = _alive[key] = make()
        return value


def _tensor(entries):
    return entries if dr.is_tensor_v(entries) else entries.data


def arrays_of(value, visited: set | None = None) -> list:
    """Return the Dr.Jit arrays of an object and of all objects that it refers to.

    A plugin keeps them as an attribute of its instance, since a frozen function does not traverse other objects.
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


def frozen_key(*settings) -> list:
    """Return literals whose types stand for ``settings``, values of Python that decide what is traced.

    A plugin keeps them as an attribute of its instance: a frozen function records again where they differ. They are
    never computed.
    """
    types = compat.backend_module(mi.Float)
    digest = int.from_bytes(hashlib.blake2b(repr(settings).encode(), digest_size=8).digest(), "little")
    return [getattr(types, _DIGITS[digest >> 3 * i & 7])(0) for i in range(_LENGTH)]


def make_opaque(numbers: dict) -> None:
    """Make parameters (name → number or colour, Dr.Jit arrays) inputs of kernels, after an assignment.

    A number of Python that was assigned would be part of the kernel, which would be compiled anew for the next one.
    Raises ``RuntimeError`` for several numbers where one is allowed; the first of them, or 0, is kept.
    """
    for name, value in numbers.items():
        width = dr.width(value)
        if width != 1:
            compat.assign(value, dr.gather(type(value), dr.detach(value), 0) if width else dr.zeros(type(value)))
        dr.make_opaque(value)
        if width != 1:
            raise RuntimeError(f'parameter "{name}": found {width} values, allowed is one')
