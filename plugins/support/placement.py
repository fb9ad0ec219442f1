"""Placement of objects in the world by ``to_world``, a similarity, which may change and be differentiated."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.core import compat


def similarity(to_world) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the matrix (4, 4) of ``to_world`` (a transform or a matrix), its rotation (3, 3) and its scale.

    The rotation may hold a reflection. Raises ``RuntimeError`` unless there are a rotation, a uniform scale and a
    translation alone.
    """
    matrix = np.array(getattr(to_world, "matrix", to_world), np.float64)
    linear = matrix[:3, :3]
    size = float(np.abs(np.linalg.det(linear))) ** (1 / 3)
    affine = np.isfinite(matrix).all() and size > 0 and np.allclose(matrix[3], (0, 0, 0, 1))
    if not affine or not np.allclose(linear.T @ linear, size**2 * np.eye(3), atol=1e-4 * size**2):
        rows = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row) + "]" for row in linear)
        raise RuntimeError(
            f'parameter "to_world": found [{rows}], allowed are rotations, uniform scales and translations'
        )
    return matrix, linear / size, size


class Placement:
    """Transform from the unit frame to the world, ``p ↦ to_world (scale · p + centre) = size · axes p + origin``.

    ``transform`` is the parameter ``to_world``. ``axes``, ``origin`` and ``size`` are Dr.Jit arrays of width 1, opaque,
    so that another placement compiles no new kernel, and attached to ``transform`` where it has gradients. ``rotation``
    (3, 3) and ``length`` are axes and size in NumPy.
    """

    def __init__(self, to_world=None, scale: float = 1.0, centre=(0.0, 0.0, 0.0)):
        self.scale, self.centre = scale, np.asarray(centre, np.float64)
        matrix = self._set(np.eye(4) if to_world is None else to_world)
        self.transform = mi.AffineTransform4f(matrix.tolist())

    def _set(self, to_world) -> np.ndarray:
        matrix, self.rotation, size = similarity(to_world)
        self.length, self._start = size * self.scale, matrix[:3, :3] @ self.centre + matrix[:3, 3]
        self.axes = mi.Frame3f(*(mi.Vector3f(column.tolist()) for column in self.rotation.T))
        dr.make_opaque(self.axes)
        self.origin = dr.opaque(mi.Point3f, self._start.tolist())
        self.size = dr.opaque(mi.Float, self.length)
        return matrix

    def world(self, p: np.ndarray) -> np.ndarray:
        """Return points ``(N, 3)`` of the unit frame in the world."""
        return self.length * (p @ self.rotation.T) + self._start

    def update(self) -> None:
        """Follow a change of ``transform``. Raises ``RuntimeError`` for anything but one similarity."""
        m = self.transform.matrix
        numbers = dr.detach(m)
        dr.make_opaque(numbers)  # NumPy asks for a kernel, which other numbers share
        values = np.array(numbers)
        if values.shape[2:] not in ((), (1,)):
            raise RuntimeError(f'parameter "to_world": found {values.shape[2]} transforms, allowed is one')
        self._set(values.reshape(4, 4))
        if compat.has_gradient(m):
            columns = [mi.Vector3f(*(m[i, j] for i in range(3))) for j in range(4)]
            size = dr.power(dr.abs(dr.dot(columns[0], dr.cross(columns[1], columns[2]))), 1 / 3)
            origin = sum((c * float(x) for c, x in zip(columns, self.centre, strict=False)), columns[3])
            self.axes = mi.Frame3f(
                *(dr.replace_grad(a, c / size) for a, c in zip(self._columns(), columns, strict=False))
            )
            self.origin = dr.replace_grad(self.origin, mi.Point3f(origin))
            self.size = dr.replace_grad(self.size, size * self.scale)

    def _columns(self) -> tuple:
        return self.axes.s, self.axes.t, mi.Vector3f(self.axes.n)

    def moving(self) -> bool:
        """Return whether derivatives with respect to ``transform`` are enabled."""
        return any(compat.has_gradient(v) for v in (*self._columns(), self.origin, self.size))
