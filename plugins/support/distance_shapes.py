"""Shapes of Mitsuba that are signed distance fields, and their ray intersection for our integrators.

Mitsuba 3.9 has no shapes written in Python but meshes. A *distance shape* (:func:`distance_shape`) is therefore a mesh
of eight triangles without area, at the corners of the field's box: the scene knows its extent, its material and its
parameters, and no ray ever hits it. Integrators that support these shapes trace their fields (:class:`Solids`).

Once Mitsuba has Python shapes (``mi.Shape`` with ``bbox``, ``ray_intersect_preliminary``,
``compute_surface_interaction``), a distance shape becomes one of these, and any integrator sees it.
"""

from __future__ import annotations

import functools
import hashlib
import tempfile
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mi_diffind.core import compat
from mi_diffind.core.files import is_within, stamp
from mi_diffind.tasks.sdf import TASK, marching
from mi_diffind.tasks.sdf.mesh import edge_balance, load_mesh, read_serialized, split_part

from .. import warn
from . import omissions, properties
from .placement import Placement
from .properties import Kept
from .tables import Entries, arrays_of

#: Distance of secondary rays' origins from the surface: three shortest steps of a ray.
OFFSET = 3 * marching.SHORTEST_STEP

#: Cosine between ray and normal below which the derivative of a hit is that at this cosine.
GRAZING = 1e-2

#: Bytes of each cell of Mitsuba's ``sdfgrid``, crossed or not: its value, a number, and a box of 32 bytes.
CELL_BYTES = 40

#: Integrators that trace distance shapes.
SEEN_BY = ("path_sdf",)

#: Number of triangles without area.
CORNERS = 8

#: Attribute that keeps Mitsuba from merging such triangles with other meshes.
UNMERGED = "face_solid"


@functools.cache
def distance_shape(mesh: type) -> type:
    """Return the base class of distance shapes for ``mi.Mesh`` of the current variant; each variant has its class."""

    class DistanceShape(mesh):
        """Shape of a distance ``field``'s surface, placed in the world by ``placement``.

        ``smooth``: shading normals are the field's smooth ones. A class whose field can be optimised overrides
        :meth:`entries`.
        """

        #: Integrators that trace it.
        seen_by = SEEN_BY

        def __init__(self, props: mi.Properties, field, placement: Placement, smooth: bool):
            self.field, self.smooth, self.placement = field, smooth, placement
            self.ready, self.differentiated = False, False
            self._accepted = Entries(self.entries())
            super().__init__(props.plugin_name(), CORNERS, CORNERS, props)
            if self.is_emitter():
                raise RuntimeError("emitter: found one, signed distance fields emit no light")
            if self.is_medium_transition():
                raise RuntimeError("medium: found one, signed distance fields hold none")
            self._hold()
            self._place()
            self.add_attribute(UNMERGED, 1, [0.0] * CORNERS)
            omissions.watch(self)

        def _place(self) -> None:
            """Move the triangles to the corners of the field's box in the world, and the frame with them."""
            # Attributes of their own, where frozen functions (``dr.freeze``) look for arrays
            self.axes, self.origin, self.size = self.placement.axes, self.placement.origin, self.placement.size
            box = np.array([self.field.lower, self.field.upper], np.float64)
            corners = np.stack(np.meshgrid(*box.T, indexing="ij"), -1).reshape(-1, 3)
            self.ready = False
            buffers = mi.traverse(self)
            compat.set_triangles(buffers, self.placement.world(corners), np.repeat(np.arange(CORNERS), 3))
            buffers.update()
            self.ready = True

        def _hold(self) -> None:
            """Keep all arrays that rays read as an attribute, for frozen functions; build the index of the field."""
            marching.index_bytes(self.field)
            self.held = arrays_of(self.field)

        def traverse(self, cb: mi.TraversalCallback) -> None:
            if not self.ready:
                super().traverse(cb)
                return
            cb.put("bsdf", self.bsdf(), mi.ParamFlags.Differentiable)
            cb.put("to_world", self.placement.transform, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
            for name, values in self.tensors().items():
                cb.put(f"tables.{name}", values, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()) -> None:
            if not self.ready:
                super().parameters_changed(keys)
                return
            if not keys or "to_world" in keys:
                self.placement.update()
                self._place()
            self._accepted.accept()
            if self.optimisable() and (not keys or any(key.startswith("tables.") for key in keys)):
                self.field.update_bound()
                self._hold()

        def omitted(self, integrators: list, sensor) -> str:
            """Return a sentence if these integrators do not trace the shape; see :mod:`.omissions`."""
            names = [compat.integrator_name(integrator) for integrator in integrators]
            if any(getattr(i, "traces_solids", False) for i in integrators) and compat.INTERSECTING not in names:
                return ""
            name = compat.INTERSECTING if compat.INTERSECTING in names else names[-1]
            decoded = ', set its parameter trace="grid", or load the scene with mi_diffind.load_file, which decodes it'
            return (
                f'the shape "{self.id()}" ({omissions.plugin_of(self)}) is left out: the integrator {name} does not '
                f"trace its arrays; render with the integrator {' or '.join(SEEN_BY)}"
                + ("" if self.optimisable() else decoded)
            )

        def optimisable(self) -> bool:
            """Return whether the field's arrays are kept in a form that can be optimised."""
            return bool(self.entries())

        def entries(self) -> dict:
            """Return the arrays that can be optimised by name: tensors, or ``DifferentiableArray``."""
            return {}

        def tensors(self) -> dict:
            """Return the tensors that can be optimised, by name."""
            return {name: v if dr.is_tensor_v(v) else v.data for name, v in self.entries().items()}

        def attached(self) -> list:
            """Return the arrays of the field and the transform whose derivatives are tracked."""
            moved = [self.placement.transform.matrix] if self.placement.moving() else []
            return moved + [values for values in self.tensors().values() if compat.has_gradient(values)]

        def optimised(self) -> bool:
            """Return whether derivatives with respect to the field or its place are enabled."""
            return bool(self.attached())

        def local_ray(self, o, d, rest=0):
            """Return a ray's origin and direction in the unit frame: lengths are those of the world by ``size``."""
            return self.local_point(o, rest), self.axes.to_local(d)

        def local_point(self, p, rest=0):
            """Return the point ``p`` + ``rest`` of the world in the unit frame; see :meth:`split_world`."""
            return self.axes.to_local(mi.Vector3f(p - self.origin) + rest) / self.size

        def to_world(self, p):
            """Return a point of the unit frame in the world."""
            return mi.Point3f(dr.fma(self.axes.to_world(mi.Vector3f(p)), self.size, self.origin))

        def split_world(self, p) -> tuple:
            """Return a point of the unit frame in the world, and the rest that single precision rounds off.

            Far from the world's origin the rest is larger than :data:`OFFSET`: rays that start without it begin on the
            wrong side of the surface. The sum of two numbers and its error: Knuth, *The Art of Computer Programming*,
            section 4.2.2, theorem B.
            """
            a, b = self.axes.to_world(mi.Vector3f(p)) * self.size, mi.Vector3f(self.origin)
            total = a + b
            part = total - a
            return mi.Point3f(total), (a - (total - part)) + (b - part)

        def move_along(self, p, d, active=True) -> tuple:
            """Return the hit ``p`` (unit frame) of a ray with the direction ``d`` (world), and its place in the world.

            If derivatives are enabled and not suspended, both are attached to the field's entries and to its placement:
            the hit moves along the ray so that the value stays zero.
            """
            p = mi.Point3f(dr.detach(p))
            if not self.optimised():
                return p, self.to_world(p)
            direction = mi.Vector3f(dr.detach(self.axes).to_local(dr.detach(d)))
            value, slope = self.field.gradient(p, active)
            slope = dr.detach(slope)
            along = dr.dot(slope, direction)
            along = dr.copysign(dr.maximum(dr.abs(along), dr.maximum(GRAZING * dr.norm(slope), 1e-6)), along)
            moving = self.placement.moving()
            if moving:
                # The frame moves, this place of the world does not
                place = dr.detach(self.to_world(p))
                p = dr.replace_grad(p, self.local_point(place))
                value = value + dr.dot(slope, p - dr.detach(p))
            back = (value - dr.detach(value)) / along
            p = p - direction * back
            return p, place - dr.detach(d) * (back * dr.detach(self.size)) if moving else self.to_world(p)

        def surface(self, p, d, active=True):
            """Return place, geometric and shading normal, in the world, of the hit ``p`` (unit frame) of a ray.

            The ray has the direction ``d`` (world); the place is attached as in :meth:`move_along`.
            """
            p, place = self.move_along(p, d, active)
            if not self.smooth:
                shading = normal = self._unit(self.field.gradient(p, active)[1], d)
            else:
                normal, shading = (self._unit(v, d) for v in self.field.normals(p, active))
            return place, self.axes.to_world(normal), self.axes.to_world(shading)

        def _unit(self, v, d):
            length = dr.norm(v)
            valid = length > 0
            direction = self.axes.to_local(dr.detach(d))
            return dr.select(valid, mi.Vector3f(v) / dr.select(valid, length, 1), -direction)

    return DistanceShape


@dataclass  # a type that loops of Dr.Jit accept as state
class ShapeHit:
    """Hit of a distance shape: its ``number`` from 1, or 0; ``t``, ``p`` (unit frame), and the ray's direction ``d``.

    Without a hit, ``t`` is the length of the ray.
    """

    number: mi.UInt32
    t: mi.Float
    p: mi.Point3f
    d: mi.Vector3f


@dataclass
class SolidHit:
    """Hit of one of Mitsuba's shapes, ``pi``, or of a distance shape, ``solid``: one of them is not valid.

    ``previous`` is ``solid`` of the vertex before.
    """

    pi: mi.PreliminaryIntersection3f
    solid: ShapeHit
    previous: ShapeHit

    @property
    def t(self):
        """Distance to the hit, the length of the ray without one."""
        return self.solid.t


class Solids:
    """Distance ``shapes`` among those of Mitsuba, as paths meet them; see :class:`.path_footprint.Surfaces`.

    Loops of Dr.Jit do not traverse this object: no arrays of a shape are part of a loop's state.
    """

    def __init__(self, shapes):
        self.shapes = tuple(shapes)

    def optimised(self) -> bool:
        return any(shape.optimised() for shape in self.shapes)

    def _each(self, hit: ShapeHit, active):
        """Iterate over the shapes and the rays that hit each of them."""
        return ((shape, (hit.number == i) & active) for i, shape in enumerate(self.shapes, 1))

    def intersect(self, o, d, maxt, active=True, rest=0) -> ShapeHit:
        """Return the first hit before ``maxt`` of rays that start at ``o`` + ``rest`` (:meth:`spawn`)."""
        nearest = ShapeHit(mi.UInt32(0), mi.Float(maxt), mi.Point3f(0), mi.Vector3f(d))
        for i, shape in enumerate(self.shapes, 1):
            start, direction = shape.local_ray(o, d, rest)
            result = marching.intersect(shape.field, start, direction, nearest.t / shape.size, active)
            nearest.number = dr.select(result.hit, i, nearest.number)
            nearest.t = dr.select(result.hit, result.t * shape.size, nearest.t)
            nearest.p = dr.select(result.hit, mi.Point3f(result.p), nearest.p)
        return nearest

    def nearest(self, ray, pi, active, rest=0, before=None) -> SolidHit:
        solid = self.intersect(ray.o, ray.d, dr.minimum(pi.t, ray.maxt), active, rest)
        pi.t = dr.select(solid.number > 0, dr.inf, pi.t)
        return SolidHit(pi, solid, dr.zeros(ShapeHit) if before is None else before.solid)

    def interaction(self, ray, hit: SolidHit, flags, active, moving=False):
        with dr.suspend_grad():  # ordinary shapes are constants
            si = hit.pi.compute_surface_interaction(ray, ray_flags=flags, active=active)
        for shape, here in self._each(hit.solid, active):
            p, normal, shading = shape.surface(hit.solid.p, ray.d, here)
            at = dr.zeros(mi.SurfaceInteraction3f)
            at.t, at.time, at.wavelengths = hit.solid.t, ray.time, ray.wavelengths
            at.p, at.n = p, mi.Normal3f(normal)
            at.sh_frame = mi.Frame3f(shading)
            at.dp_du, at.dp_dv = at.sh_frame.s, at.sh_frame.t
            at.wi = at.sh_frame.to_local(-ray.d)
            at.shape = mi.ShapePtr(shape)
            at.duv_dx, at.duv_dy = si.duv_dx, si.duv_dy
            si = dr.select(here, at, si)
        if moving:
            # Seen from the vertex before, which also moves
            aside = mi.Vector3f(0)
            for shape, here in self._each(hit.previous, active & si.is_valid()):
                _, place = shape.move_along(hit.previous.p, hit.previous.d, here)
                aside = dr.select(here, place - dr.detach(place), aside)
            turn = aside - ray.d * dr.dot(aside, ray.d)
            si.wi += dr.detach(si.sh_frame).to_local(turn) * dr.rcp(dr.select(si.is_valid(), si.t, 1))
        return si

    def spawn(self, hit: SolidHit, si, d) -> tuple:
        # The origin of a ray from a distance shape is off the surface by OFFSET, in the unit frame
        with dr.suspend_grad():
            ray = si.spawn_ray(d)
            o, rest = mi.Point3f(ray.o), mi.Vector3f(0)
            for shape, here in self._each(hit.solid, True):
                away = dr.copysign(mi.Float(OFFSET), dr.dot(si.n, d))
                place, low = shape.split_world(dr.fma(shape.axes.to_local(mi.Vector3f(si.n)), away, hit.solid.p))
                o, rest = dr.select(here, place, o), dr.select(here, low, rest)
            ray.o = dr.detach(o)
            return ray, dr.detach(rest)

    def occluded(self, hit: SolidHit, si, ds, active):
        ray, rest = self.spawn(hit, si, ds.d)
        to = mi.Vector3f(ds.p - ray.o) - rest
        distance = dr.norm(to)
        # Places on infinite emitters are as far as the scene is large, and rounded far from the world's origin
        infinite = mi.has_flag(ds.emitter.flags(), mi.EmitterFlags.Infinite)
        d, distance = dr.select(infinite, ds.d, to / distance), dr.select(infinite, ds.dist, distance)
        blocked, maxt = mi.Bool(False), distance * (1 - mi.math.ShadowEpsilon)
        for shape in self.shapes:
            start, direction = shape.local_ray(ray.o, d, rest)
            blocked |= marching.occluded(shape.field, start, direction, maxt / shape.size, active & ~blocked)
        return blocked

    def attach_emitter(self, si, ds):
        # Points of emitters stay fixed, and so do directions to infinite ones
        flags = ds.emitter.flags()
        finite = ~mi.has_flag(flags, mi.EmitterFlags.Infinite)
        distance = dr.norm(ds.p - si.p)
        ds.d = dr.replace_grad(ds.d, dr.select(finite, (ds.p - si.p) / distance, ds.d))
        ds.dist = dr.replace_grad(ds.dist, dr.select(finite, distance, ds.dist))
        surface = mi.has_flag(flags, mi.EmitterFlags.Surface)
        return dr.select(surface, dr.relative_grad(_jacobian(si.p, ds.p, ds.n)), 1)

    def attach_direction(self, si, bs, ray, hit: SolidHit, active) -> tuple:
        # The next vertex stays fixed, or the direction if there is none
        target = self.interaction(ray, hit, compat.ray_flags(), active)
        active = active & target.is_valid()
        with dr.resume_grad():
            d = dr.select(active, dr.normalize(target.p - si.p), ray.d)
            wo = dr.replace_grad(bs.wo, si.to_local(d))
            return wo, dr.select(active, dr.relative_grad(_jacobian(si.p, target.p, target.n)), 1)

    def check_derivatives(self, adjoint: mi.TensorXf) -> None:
        """Warn of shapes whose first backward pass, with a nonzero ``adjoint`` of the image, gave only zeros."""
        if dr.flag(dr.JitFlag.FreezingScope):  # nothing can be evaluated
            return
        moving = [shape for shape in self.shapes if shape.optimised() and not shape.differentiated]
        if not moving or not np.array(adjoint).any():
            return
        for shape in moving:
            shape.differentiated = True
        if not any(np.array(dr.grad(values)).any() for shape in moving for values in shape.attached()):
            warn(
                f'the derivatives of the shape "{moving[0].id()}" ({omissions.plugin_of(moving[0])}) are all zero: '
                "they leave out outlines that move; add a loss on the field, such as masks"
            )


def _jacobian(p, q, n):
    return mi.ad.integrators.common.solid_angle_to_area_jacobian(p, q, n)


def solids_in(scene: mi.Scene) -> Solids:
    """Return the distance shapes of a scene. Raises ``RuntimeError`` if one is in a shape group."""
    shapes = [shape for shape in scene.shapes() if hasattr(shape, "local_ray")]
    hidden = [s for s in compat.scene_objects(scene) if hasattr(s, "local_ray") and s not in shapes]
    if hidden:
        raise RuntimeError(
            f'"{hidden[0].id()}": is in a shapegroup, where its arrays cannot be traced; several shapes of one file '
            f'with a "to_world" of their own share its memory, and trace="grid" may be instanced'
        )
    return Solids(shapes)


def crop_grid(values: np.ndarray, lower, spacing: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Crop a grid of ``values`` (Z, Y, X) to two cells around its inside; return it with its corners.

    The grid begins at ``lower``. The result is padded with outside until X and Z are equal: where they differ, the
    ``sdfgrid`` of Mitsuba 3.9 finds next to no hits, and reads beyond its end. Raises ``RuntimeError`` if nothing is
    inside.
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
    """Return the most cells along the longest of a box's ``sides`` (X, Y, Z) whose grid fits into ``nbytes``."""
    x, y, z = np.asarray(sides, np.float64) / max(sides)
    return int((nbytes / (CELL_BYTES * y * max(x, z) ** 2)) ** (1 / 3))


def native_grid(props: mi.Properties, values: np.ndarray, lower, upper, to_world, normals: str):
    """Create Mitsuba's ``sdfgrid`` of ``values`` (Z, Y, X) with the material of ``props``.

    X and Z are equal; ``lower`` and ``upper`` are the corners of the box, which ``to_world`` moves. A rotated grid is
    an instance, in a ``merge`` with its group. Returns the shape, and the shape that a scene keeps of it.
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
        shape = mi.load_dict({**grid, "to_world": to_world @ box}, parallel=False)
        return shape, shape
    group = mi.load_dict({"type": "shapegroup", "grid": {**grid, "to_world": box}}, parallel=False)
    instance = mi.load_dict({"type": "instance", "group": group, "to_world": to_world}, parallel=False)
    both = mi.Properties("merge")
    both["group"], both["instance"] = group, instance
    both.set_id(props.id())
    return mi.PluginManager.instance().create_object(both), instance


#: Share of open edges up to which a mesh counts as closed: a fit closes holes, but not a surface without an inside.
OPEN = 0.01

#: Share of triangles that may face inwards: those of a distance field all face outwards.
INWARDS = 0.01

#: Mean angle between shading normals and triangles up to which a field stands for both, in degrees. A ball of polished
#: metal under the sun is 24% darker with triangles of 5.1°, and equal within 0.1% with those of 2.5° (4% in blocks).
SMOOTH_DEG = 3.0


def to_mesh(props: mi.Properties) -> None:
    """Replace the ``filename`` of a ``neural_sdf`` by that of its mesh, as a ``ply`` file."""
    path = Path(properties.filename(props))
    with properties.refused_as():
        settings = TASK.load(path).settings
    recorded = settings.get("mesh_path")
    if not recorded:
        raise RuntimeError(f"{path}: names no mesh that it was made from")
    mesh = (path.resolve().parent / recorded).resolve()
    file, _ = split_part(mesh)
    if not file.is_file():
        raise RuntimeError(f"{file}: no such file, {path.name} was made from it")
    beside = is_within(path.resolve().parent, recorded)
    if beside and mesh.suffix.lower() == ".ply":
        props["filename"] = str(mesh)
        return
    digest, props["filename"] = _as_ply(mesh, stamp(file))
    if not beside and digest != settings.get("source"):
        raise RuntimeError(f"{file}: has changed since {path.name} was made from it")


def closed_mesh_file(path: Path, folder: Path, index: int = 0) -> Path:
    """Return the file of a mesh to fit: ``path``, or the PLY file of one shape of a ``.serialized`` in ``folder``.

    Raises :class:`~.stock.Kept` for a mesh that encloses no solid.
    """
    try:
        if path.suffix.lower() == ".serialized":
            vertices, faces = read_serialized(path)[index]
            path = folder / f"{path.stem}_{index}_{hashlib.sha256(vertices.tobytes()).hexdigest()[:12]}.ply"
            trimesh.Trimesh(vertices, faces, process=False).export(path)
        faces = load_mesh(path).faces
    except IndexError:
        raise Kept(f"has the shape_index {index}, which {path} lacks") from None
    except (ValueError, OSError) as e:
        raise Kept(f"is no solid: {e}") from None
    _, surplus, _ = edge_balance(faces, int(faces.max()) + 1)
    if np.count_nonzero(surplus) > OPEN * len(surplus):
        raise Kept(f"encloses no solid: {np.count_nonzero(surplus):,} of {len(surplus):,} edges are open")
    return path


def check_normals(props: mi.Properties, source: Path) -> float:
    """Return the mean angle between the shading normals of a mesh and those of its triangles, in degrees.

    ``props``: properties of the shape; ``source``: the file of its mesh. Raises :class:`~.stock.Kept` for a mesh whose
    normals, as Mitsuba renders them, a distance field does not have: the triangles have to face outwards, and the
    shading normals, of the file or smoothed by Mitsuba, have to be near those of the triangles.
    """
    mesh = load_mesh(source)
    linear = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix)[:3, :3]
    inwards = mesh.turned / len(mesh.faces)
    if (np.linalg.det(linear) < 0) != (props.get("flip_normals", False) is True):
        inwards = 1 - inwards
    if inwards > INWARDS:
        raise Kept(f"is wound inside out: {inwards:.0%} of its triangles face inwards, those of fields outwards")
    if props.get("face_normals", False) is True:
        return 0.0
    keys = [key for key in ("filename", "shape_index", "face_normals") if key in props]
    angle = _smoothness(mi.load_dict({"type": props.plugin_name(), **{key: props[key] for key in keys}}))
    if angle > SMOOTH_DEG:
        raise Kept(
            f"has shading normals {angle:.0f}° from those of its triangles, distance fields have the latter: "
            f"face_normals true renders it without"
        )
    return angle


def _smoothness(mesh: mi.Mesh) -> float:
    """Return the mean angle over a mesh's area between its shading normals and those of its triangles, in degrees."""
    vertices, faces = compat.triangles(mesh)
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    index, angles = dr.arange(mi.UInt32, len(faces)), 0
    for place in ((1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)):  # exact for quadratic functions on a triangle
        pi = dr.zeros(mi.PreliminaryIntersection3f, len(faces))
        pi.t, pi.prim_index, pi.prim_uv = 1, index, mi.Point2f(*place)
        si = mesh.compute_surface_interaction(dr.zeros(mi.Ray3f, len(faces)), pi)
        angles = angles + np.degrees(dr.safe_acos(dr.dot(si.n, si.sh_frame.n)).numpy()) / 3
    return float((angles * areas).sum() / areas.sum())


@functools.lru_cache
def _folder() -> tempfile.TemporaryDirectory:
    """Return a folder that is removed when the process ends."""
    return tempfile.TemporaryDirectory(prefix="mi_diffind_")


@functools.lru_cache
def _as_ply(path: Path, stamp: tuple) -> tuple[str, str]:
    """Return the digest of a mesh file, and the path of the mesh as a PLY file, kept until the process ends."""
    with properties.refused_as():
        mesh = load_mesh(path)
    if path.suffix.lower() == ".ply":
        return mesh.digest, str(path)
    written = Path(_folder().name) / f"{split_part(path)[0].stem}_{abs(hash((path, stamp))):x}.ply"
    trimesh.Trimesh(mesh.to_file_frame(mesh.vertices), mesh.faces, process=False).export(written)
    return mesh.digest, str(written)
