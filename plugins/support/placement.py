"""Placement of objects in the world by ``to_world``, a similarity, which may change and be differentiated."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.core import compat


@dataclass(frozen=True)
class Placement:
    """Transform from the unit frame to the world: ``p ↦ size · rotation p + origin``, or with a reflection.

    It is ``p ↦ to_world (scale · p + centre)``, with the matrix ``to_world`` (4, 4).
    """

    rotation: np.ndarray
    size: float
    origin: np.ndarray
    to_world: np.ndarray
    scale: float
    centre: np.ndarray

    @classmethod
    def of(cls, to_world, scale: float, centre) -> Placement:
        """Return the placement of a mesh moved by ``to_world`` (``mi.ScalarTransform4f`` or a matrix).

        ``centre`` and ``scale`` are the centre and the longest side of the mesh's box in its units. Raises
        ``RuntimeError`` unless ``to_world`` is a rotation, a uniform scale and a translation.
        """
        matrix = np.array(getattr(to_world, "matrix", to_world), np.float64)
        linear, centre = matrix[:3, :3], np.asarray(centre, np.float64)
        size = float(np.abs(np.linalg.det(linear))) ** (1 / 3)
        affine = np.isfinite(matrix).all() and size > 0 and np.allclose(matrix[3], (0, 0, 0, 1))
        if not affine or not np.allclose(linear.T @ linear, size**2 * np.eye(3), atol=1e-4 * size**2):
            rows = ", ".join("[" + ", ".join(f"{v:.4g}" for v in row) + "]" for row in linear)
            raise RuntimeError(
                f'parameter "to_world": found [{rows}], allowed are rotations, uniform scales and translations'
            )
        return cls(linear / size, size * scale, linear @ centre + matrix[:3, 3], matrix, scale, centre)

    def world(self, p: np.ndarray) -> np.ndarray:
        """Return points ``(N, 3)`` of the unit frame in the world."""
        return self.size * (p @ self.rotation.T) + self.origin


class PlacementParameter:
    """Parameter ``to_world`` (``transform``, a ``mi.AffineTransform4f``) and the ``placement`` that follows it.

    ``axes``, ``origin`` and ``size`` are the placement as Dr.Jit arrays of width 1, opaque, so that another placement
    compiles no new kernel. They are attached to ``transform`` where it has gradients.
    """

    def __init__(self, placement: Placement):
        self.transform = mi.AffineTransform4f(placement.to_world.tolist())
        self._set(placement)

    def _set(self, placement: Placement) -> None:
        self.placement = placement
        self.axes = mi.Frame3f(*(mi.Vector3f(column.tolist()) for column in placement.rotation.T))
        dr.make_opaque(self.axes)
        self.origin = dr.opaque(mi.Point3f, placement.origin.tolist())
        self.size = dr.opaque(mi.Float, placement.size)

    def update(self) -> None:
        """Follow a change of ``transform``. Raises ``RuntimeError`` for anything but one similarity."""
        m, before = self.transform.matrix, self.placement
        numbers = dr.detach(m)
        dr.make_opaque(numbers)  # NumPy asks for a kernel, which other numbers share
        values = np.array(numbers)
        if values.shape[2:] not in ((), (1,)):
            raise RuntimeError(f'parameter "to_world": found {values.shape[2]} transforms, allowed is one')
        self._set(Placement.of(values.reshape(4, 4), before.scale, before.centre))
        if compat.has_gradient(m):
            columns = [mi.Vector3f(*(m[i, j] for i in range(3))) for j in range(4)]
            size = dr.power(dr.abs(dr.dot(columns[0], dr.cross(columns[1], columns[2]))), 1 / 3)
            origin = sum((c * float(x) for c, x in zip(columns, before.centre, strict=False)), columns[3])
            self.axes = mi.Frame3f(
                *(dr.replace_grad(a, c / size) for a, c in zip(self._columns(), columns, strict=False))
            )
            self.origin = dr.replace_grad(self.origin, mi.Point3f(origin))
            self.size = dr.replace_grad(self.size, size * before.scale)

    def _columns(self) -> tuple:
        return self.axes.s, self.axes.t, mi.Vector3f(self.axes.n)

    def moving(self) -> bool:
        """Return whether derivatives with respect to ``transform`` are enabled."""
        return any(compat.has_gradient(v) for v in (*self._columns(), self.origin, self.size))
