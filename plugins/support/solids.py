"""
Solids: shapes of Mitsuba that are signed distance fields, traced by an integrator of ours.

Mitsuba 3.9 has no shapes written in Python but meshes. A :class:`Solid` is therefore a mesh of eight triangles without
area, at the corners of the field's box: the scene knows its extent, its material and its parameters, and no ray ever
hits it. Integrators that know of solids (:func:`solids_of`) trace the fields themselves (:func:`meet`,
:func:`occluded`) and make of what they met what Mitsuba would (:func:`interaction`).

This file is the seam: with the next Mitsuba's Python shapes (``mi.Shape`` with ``bbox``,
``ray_intersect_preliminary``, ``compute_surface_interaction``), :class:`Solid` becomes one of these, the functions its
methods, and any integrator sees it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind import compat
from mi_diffind.tasks.sdf import tracing

#: Secondary rays start this far from a surface, in steps of a ray.
OFFSET = 3 * tracing.EPSILON

#: Below this cosine between ray and normal, a hit moves with the field's entries as at it.
GRAZING = 1e-2

#: What Mitsuba's ``sdfgrid`` takes for each cell, crossed or not: its value, a number, and a box of 32 bytes.
CELL_BYTES = 40

#: Triangles without area, and an attribute that keeps Mitsuba from merging them with others' meshes.
CORNERS, UNMERGED = 8, "face_solid"


@dataclass(frozen=True)
class Placement:
    """
    From the unit frame to the world: ``p ↦ size · rotation p + origin``, where ``rotation`` may be a reflection, too.
    """

    rotation: np.ndarray
    size: float
    origin: np.ndarray

    @classmethod
    def of(cls, to_world, scale: float, centre) -> Placement:
        """
        Of a mesh whose box has the centre ``centre`` and the longest side ``scale``, in its own units, as ``to_world``
        (``mi.ScalarTransform4f``) moves it. Raises ``RuntimeError`` unless that is a rotation, a uniform scale and a
        translation.
        """
        matrix = np.array(to_world.matrix, np.float64)
        linear = matrix[:3, :3]
        size = float(np.abs(np.linalg.det(linear))) ** (1 / 3)
        turned = np.isfinite(matrix).all() and size > 0 and np.allclose(matrix[3], (0, 0, 0, 1))
        if not turned or not np.allclose(linear.T @ linear, size**2 * np.eye(3), atol=1e-4 * size**2):
            raise RuntimeError(
                f'parameter "to_world": found {_written(linear)}, allowed are rotations, uniform scales and '
                f"translations"
            )
        return cls(linear / size, size * scale, linear @ np.asarray(centre, np.float64) + matrix[:3, 3])

    def world(self, p: np.ndarray) -> np.ndarray:
        """Points ``(N, 3)`` of the unit frame in the world."""
        return self.size * (p @ self.rotation.T) + self.origin


def _written(linear: np.ndarray) -> str:
    return "[" + ", ".join("[" + ", ".join(f"{v:.4g}" for v in row) + "]" for row in linear) + "]"


class Solid(mi.Mesh):
    """
    A shape that is the surface of a ``field``, put into the world by ``placement``. ``smooth``: its shading normals are
    the field's smooth ones.
    """

    #: The integrators that trace it.
    seen_by = ("path_sdf",)

    def __init__(self, props: mi.Properties, field, placement: Placement, smooth: bool):
        self.field, self.placement, self.smooth = field, placement, smooth
        self.ready = False
        super().__init__(props.plugin_name(), CORNERS, CORNERS, props)
        if self.is_emitter():
            raise RuntimeError("an emitter: signed distance fields emit no light")
        if self.is_medium_transition():
            raise RuntimeError("a medium: signed distance fields hold none")
        box = np.array([field.lower, field.upper], np.float64)
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)
        buffers = mi.traverse(self)
        buffers["vertex_positions"] = placement.world(corners).astype(np.float32).ravel()
        buffers["faces"] = np.repeat(np.arange(CORNERS, dtype=np.uint32), 3)
        buffers.update()
        self.add_attribute(UNMERGED, 1, [0.0] * CORNERS)
        self.ready = True
        self._place()

    def _place(self) -> None:
        """The placement as opaque numbers: another one compiles nothing anew."""
        at = self.placement
        self.axes = mi.Frame3f(*(mi.Vector3f(column.tolist()) for column in at.rotation.T))
        dr.make_opaque(self.axes)
        self.origin = dr.opaque(mi.Point3f, at.origin.tolist())
        self.size = dr.opaque(mi.Float, at.size)

    def traverse(self, cb: mi.TraversalCallback) -> None:
        if not self.ready:
            super().traverse(cb)
            return
        cb.put("bsdf", self.bsdf(), mi.ParamFlags.Differentiable)

    def optimised(self) -> bool:
        """Is a derivative with respect to the field asked for?"""
        return False

    @property
    def index_bytes(self) -> int:
        """Bytes of what is made of the field so that rays find their way."""
        return tracing.index_of(self.field)

    # -- between the world and the unit frame ---------------------------------------------------------------------

    def local_ray(self, o, d):
        """A ray's origin and direction in the unit frame; lengths there are those of the world by ``size``."""
        return self.axes.to_local(mi.Vector3f(o - self.origin)) / self.size, self.axes.to_local(d)

    def to_world(self, p):
        """A point of the unit frame."""
        return mi.Point3f(dr.fma(self.axes.to_world(mi.Vector3f(p)), self.size, self.origin))

    # -- the surface ----------------------------------------------------------------------------------------------

    def moved(self, p, d, active=True):
        """
        The place ``p`` (unit frame) where a ray with the direction ``d`` (world) met the surface, attached to the
        field's entries if derivatives are asked for and not suspended: along the ray, where the value stays zero.
        """
        p = mi.Point3f(dr.detach(p))
        if not self.optimised():
            return p
        d = self.axes.to_local(dr.detach(d))
        value, slope = self.field.gradient(p, active)
        slope = dr.detach(slope)
        along = dr.dot(slope, d)
        along = dr.copysign(dr.maximum(dr.abs(along), dr.maximum(GRAZING * dr.norm(slope), 1e-6)), along)
        return p - mi.Vector3f(d) * ((value - dr.detach(value)) / along)

    def surface(self, p, d, active=True):
        """
        Place, geometric and shading normal, in the world, where a ray with the direction ``d`` met the surface at ``p``
        (unit frame), attached as :meth:`moved` is.
        """
        p = self.moved(p, d, active)
        if not self.smooth:
            shading = normal = self._unit(self.field.gradient(p, active)[1], d)
        else:
            normal, shading = (self._unit(v, d) for v in self.field.normals(p, active))
        return self.to_world(p), self.axes.to_world(normal), self.axes.to_world(shading)

    def _unit(self, v, d):
        length = dr.norm(v)
        known = length > 0
        turned = self.axes.to_local(dr.detach(d))
        return dr.select(known, mi.Vector3f(v) / dr.select(known, length, 1), -turned)


def solids_of(scene: mi.Scene) -> list[Solid]:
    """The solids of a scene. Raises ``RuntimeError`` for those in a shape group, which cannot be traced."""
    found = [shape for shape in scene.shapes() if isinstance(shape, Solid)]
    hidden = [shape for shape in compat.objects_of(scene) if isinstance(shape, Solid) and shape not in found]
    if hidden:
        raise RuntimeError(
            f'"{hidden[0].id()}": is in a shapegroup, where its arrays cannot be traced; several shapes of one file '
            f'with a "to_world" of their own share its memory, and trace="grid" may be instanced'
        )
    return found


def cube_of(values: np.ndarray, lower, upper) -> tuple[np.ndarray, np.ndarray]:
    """A grid of ``values`` (Z, Y, X) in a box with these corners, filled with outside to a cube; its upper corner."""
    side = max(values.shape)
    spacing = (upper[0] - lower[0]) / (values.shape[2] - 1)
    values = np.pad(values, [(0, side - n) for n in values.shape], constant_values=float(values.max()))
    return values, np.asarray(lower, np.float64) + spacing * (side - 1)


def fitted(values: np.ndarray, lower, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Of a grid of ``values`` (Z, Y, X), from the corner ``lower`` on, what its surface needs, with its corners: cut to
    two cells around what is inside, then filled with outside until X and Z are the same. Where they are not, the
    ``sdfgrid`` of Mitsuba 3.9 finds next to no hits, and reads beyond its end; Y may be any. Raises ``RuntimeError`` if
    nothing is inside.
    """
    parts = []
    for axis, count in enumerate(values.shape):
        inside = np.flatnonzero((values < 0).any(axis=tuple({0, 1, 2} - {axis})))
        if not len(inside):
            raise RuntimeError(f"nothing is inside at {max(values.shape) - 1} cells along the longest side")
        parts.append(slice(max(0, inside[0] - 2), min(count, inside[-1] + 3)))
    values = values[tuple(parts)]
    lower = np.asarray(lower, np.float64) + spacing * np.array([part.start for part in reversed(parts)])
    side = max(values.shape[0], values.shape[2])
    fill = [(0, side - values.shape[0]), (0, 0), (0, side - values.shape[2])]
    values = np.pad(values, fill, constant_values=float(values.max()))
    return values, lower, lower + spacing * (np.array(values.shape[::-1]) - 1)


def finest(sides, nbytes: int) -> int:
    """
    Cells along the longest side of the finest grid in a box with these ``sides`` (X, Y, Z) that takes ``nbytes`` bytes
    in Mitsuba.
    """
    x, y, z = np.asarray(sides, np.float64) / max(sides)
    return int((nbytes / (CELL_BYTES * y * max(x, z) ** 2)) ** (1 / 3))


def native_grid(props: mi.Properties, values: np.ndarray, lower, upper, to_world, normals: str):
    """
    Mitsuba's ``sdfgrid`` of ``values`` (Z, Y, X), X and Z the same, in a box with these corners, which ``to_world``
    moves; with the material of ``props``. Rotated, it is an instance, in a ``merge`` with its group. Returns the shape,
    and what a scene keeps of it.
    """
    at = mi.ScalarTransform4f
    box = at().translate(list(map(float, lower))).scale(list(map(float, np.asarray(upper) - lower)))
    grid = {
        "type": "sdfgrid",
        "id": props.id() or "grid",
        "grid": mi.TensorXf(np.ascontiguousarray(values[..., None], np.float32)),
        "normals": normals,
    }
    for name, child in props.objects():
        grid[name] = child
    linear = np.array(to_world.matrix, np.float64)[:3, :3]
    if np.allclose(linear, linear[0, 0] * np.eye(3), atol=1e-6 * abs(linear[0, 0])) and linear[0, 0] > 0:
        made = mi.load_dict({**grid, "to_world": to_world @ box}, parallel=False)
        return made, made
    group = mi.load_dict({"type": "shapegroup", "grid": {**grid, "to_world": box}}, parallel=False)
    instance = mi.load_dict({"type": "instance", "group": group, "to_world": to_world}, parallel=False)
    both = mi.Properties("merge")
    both["group"], both["instance"] = group, instance
    both.set_id(props.id())
    return mi.PluginManager.instance().create_object(both), instance


# -- rays --------------------------------------------------------------------------------------------------------------


@dataclass
class Met:
    """What rays met of the solids: ``which``, its place in the list and 1 more, 0: none; ``t``; ``p`` (unit frame)."""

    which: mi.UInt32
    t: mi.Float
    p: mi.Point3f


def meet(solids: list[Solid], o, d, maxt, active=True) -> Met:
    """The first place before ``maxt`` where rays meet a solid; ``t`` is ``maxt`` for those that do not."""
    found = Met(mi.UInt32(0), mi.Float(maxt), mi.Point3f(0))
    for i, solid in enumerate(solids):
        start, direction = solid.local_ray(o, d)
        hit = tracing.intersect(solid.field, start, direction, found.t / solid.size, active)
        found.which = dr.select(hit.found, i + 1, found.which)
        found.t = dr.select(hit.found, hit.t * solid.size, found.t)
        found.p = dr.select(hit.found, mi.Point3f(hit.p), found.p)
    return found


def occluded(solids: list[Solid], o, d, maxt, active=True):
    """Whether rays meet any solid before ``maxt``."""
    found = mi.Bool(False)
    for solid in solids:
        start, direction = solid.local_ray(o, d)
        found |= tracing.occluded(solid.field, start, direction, maxt / solid.size, active & ~found)
    return found


def interaction(solids: list[Solid], met: Met, ray, si, active=True):
    """``si`` (``mi.SurfaceInteraction3f``), replaced where a solid was met by what Mitsuba would say of it."""
    for i, solid in enumerate(solids):
        here = (met.which == i + 1) & active
        p, normal, shading = solid.surface(met.p, ray.d, here)
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.t, at.time, at.wavelengths = met.t, ray.time, ray.wavelengths
        at.p, at.n = p, mi.Normal3f(normal)
        at.sh_frame = mi.Frame3f(shading)
        at.dp_du, at.dp_dv = at.sh_frame.s, at.sh_frame.t
        at.wi = at.sh_frame.to_local(-ray.d)
        at.shape = mi.ShapePtr(solid)
        si = dr.select(here, at, si)
    return si


def shift(solids: list[Solid], met: Met, d, active=True):
    """Zero, with the derivative of the place in the world where rays with the direction ``d`` met a solid."""
    found = mi.Vector3f(0)
    for i, solid in enumerate(solids):
        here = (met.which == i + 1) & active
        p = solid.to_world(solid.moved(met.p, d, here))
        found = dr.select(here, p - dr.detach(p), found)
    return found


def spawn(solids: list[Solid], met: Met, si, d):
    """The origin of a ray from ``si`` in the direction ``d``: off a solid by more than a step of a ray."""
    o = si.spawn_ray(d).o
    for i, solid in enumerate(solids):
        away = dr.copysign(OFFSET * solid.size, dr.dot(si.n, d))
        o = dr.select(met.which == i + 1, dr.fma(si.n, away, si.p), o)
    return mi.Point3f(o)
