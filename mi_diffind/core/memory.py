"""Memory of Dr.Jit's arrays: copies into it, and assignments in place.

Functions import Dr.Jit when they are called, as those of :mod:`.compat`, which has other hooks.
"""

from __future__ import annotations

from .compat import has_gradient


def owned(array):
    """Return a copy of an evaluated array in memory of Dr.Jit, with the same derivatives; others as they are.

    Where a virtual call reads an array, a frozen function (``dr.freeze`` of Dr.Jit 1.5) takes the address of memory
    that Dr.Jit did not allocate, such as NumPy's, for a constant. No public function tells or copies such memory.
    """
    import drjit as dr

    if array.state != dr.VarState.Evaluated:
        return array
    zero = dr.opaque(
        type(array), -0.0 if dr.is_float_v(array) else 0
    )  # no number changes, not even −0; denormal ones may become 0
    copy = dr.detach(array) + zero
    dr.eval(copy)
    return dr.replace_grad(copy, array) if has_gradient(array) else copy


def assign(target, value) -> None:
    """Assign to an array in place, so that all who refer to it see the value, as ``mi.SceneParameters`` does.

    ``mi.set_property`` is not in the manual.
    """
    import mitsuba as mi

    mi.set_property(target, value)
