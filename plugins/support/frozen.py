"""Plugins in frozen functions (``dr.freeze``), which record kernels once and replay them.

A frozen function sees the Dr.Jit arrays in attributes of a plugin's instance, also in lists, dictionaries, dataclasses
and PyTrees there. It records again if their number, their types or the equality of their sizes change; it sees neither
numbers of Python nor sizes. Arrays in memory that Dr.Jit did not allocate, such as NumPy's, are constants of a
recording.
"""

from __future__ import annotations

import hashlib

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat

#: Types of Dr.Jit's literals that stand for the digits of a key.
_DIGITS = ("Int8", "UInt8", "Int32", "UInt32", "Int64", "UInt64", "Float16", "Float64")

#: Digits of a key: 2⁴⁸ keys.
_LENGTH = 16


def key(*settings) -> list:
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
