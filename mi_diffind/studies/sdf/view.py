"""Camera in the unit frame, and scenes of a distance field, a mesh or a grid, alone or lit on a floor."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import compat
from ...tasks.sdf import grids, marching
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh

#: The camera: its direction from the origin, its distance, and its field of view (degrees, of the longer side).
DIRECTION, DISTANCE, FOV = (0.45, 0.3, 1.0), 2.6, 32.0

#: Rays end there.
FAR = 1e3

MATERIAL = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.55, 0.5, 0.45]}}


class MeshView:
    """A camera that sees all of ``mesh``, with a ``film`` of (width, height) pixels."""

    def __init__(self, mesh: Mesh, film: tuple[int, int]):
        self.mesh, self.film = mesh, film
        away = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
        self.origin = DISTANCE * away
        right = np.cross((0.0, 1.0, 0.0), away)
        right /= np.linalg.norm(right)
        self.right, self.up, self.forward = right, np.cross(away, right), -away

    def rays(self, types, count: int | None = None):
        """Return origins and directions of the rays through all pixels' centres, row by row from the top, evaluated.

        With ``count``, so many rays of a film of the same shape.
        """
        width, height = self.film
        if count is not None:
            width = max(1, round(math.sqrt(count * width / height)))
            height = -(-count // width)
        index = np.arange(count or width * height)
        scale = 2 * math.tan(math.radians(FOV) / 2) / max(self.film)
        x = ((index % width + 0.5) / width - 0.5) * self.film[0] * scale
        y = (0.5 - (index // width + 0.5) / height) * self.film[1] * scale
        d = self.forward + x[:, None] * self.right + y[:, None] * self.up
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        rays = [
            types.Array3f(*(types.Float(np.ascontiguousarray(c, np.float32)) for c in v.T))
            for v in (np.broadcast_to(self.origin, d.shape), d)
        ]
        dr.make_opaque(rays)
        return rays

    def mesh_scene(self, lit: bool = False):
        """Return a scene of the mesh, alone or ``lit`` on a floor."""
        counts = len(self.mesh.vertices), len(self.mesh.faces)
        shape = mi.Mesh(*compat.mesh_arguments(_material(), *counts))
        buffers = mi.traverse(shape)
        compat.set_triangles(buffers, self.mesh.vertices, self.mesh.faces)
        buffers.update()
        return self._scene(shape, "path", lit)

    def grid_scene(self, field: DistanceField, resolution: int, lit: bool = False):
        """Return a scene of Mitsuba's ``sdfgrid``, decoded with ``resolution`` cells along the longest side."""
        from ...plugins.support.distance_shapes import crop_grid

        values, lower, upper = grids.grid(field, resolution)
        values, lower, upper = crop_grid(values, lower, (upper[0] - lower[0]) / (values.shape[2] - 1))
        to_world = mi.ScalarTransform4f().translate(lower.tolist()).scale((upper - lower).tolist())
        grid = mi.TensorXf(np.ascontiguousarray(values[..., None], np.float32))
        shape = mi.load_dict({"type": "sdfgrid", "grid": grid, "to_world": to_world, "normals": "smooth",
                              "bsdf": MATERIAL})  # fmt: skip
        return self._scene(shape, "path", lit)

    def field_scene(self, field: DistanceField, lit: bool = False):
        """Return a scene of the field, traced by ``path_sdf``."""
        from ...plugins.support.distance_shapes import distance_shape
        from ...plugins.support.placement import Placement

        placement = Placement.of(mi.ScalarTransform4f(), 1.0, (0.0, 0.0, 0.0))
        shape = distance_shape(mi.Mesh)(_material(), field, placement, True)
        return self._scene(shape, "path_sdf", lit)

    def _scene(self, shape, integrator: str, lit: bool):
        scene = {"type": "scene", "shape": shape}
        if lit:
            low = float(self.mesh.lower[1])
            turn = mi.ScalarTransform4f().translate([0, low, 0]).rotate([1, 0, 0], -90).scale(4.0)
            lamp = mi.ScalarTransform4f().look_at([1.5, 2.5, 1.0], [0, 0, 0], [0, 1, 0]).scale(0.6)
            target, up = (self.origin + self.forward).tolist(), self.up.tolist()
            camera = mi.ScalarTransform4f().look_at(self.origin.tolist(), target, up)
            scene |= {
                "integrator": {"type": integrator, "max_depth": 4},
                "floor": {"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse"}},
                "sky": {"type": "constant", "radiance": 0.4},
                "lamp": {"type": "rectangle", "to_world": lamp,
                         "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}},
                "sensor": {"type": "perspective", "fov": FOV, "fov_axis": "larger", "to_world": camera,
                           "sampler": {"type": "independent"},
                           "film": {"type": "hdrfilm", "width": self.film[0], "height": self.film[1],
                                    "rfilter": {"type": "box"}}},
            }  # fmt: skip
        return mi.load_dict(scene)


def _material() -> mi.Properties:
    props = mi.Properties("neural_sdf")
    props["bsdf"] = mi.load_dict(MATERIAL)
    return props


def traced_distance(field: DistanceField, o, d):
    """Return the length of rays until they meet a field, infinite if they miss it."""
    return marching.trace(field, o, d, FAR)[0]


def scene_distance(scene, o, d):
    """Return the length of rays until they meet a scene, which has to live until the result is evaluated."""
    return scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)), coherent=True).t
