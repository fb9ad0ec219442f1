"""Footprints by finite differences: rays through a pixel's centre and half a pixel to each side, followed along a whole
specular chain, and what their uv differ by. And a texture that shows the footprint it is given.
"""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.plugins.support import footprint

ASSETS = Path(__file__).resolve().parents[2] / "scenes" / "assets"

#: Pixels.
WIDTH, HEIGHT = 48, 32


def register_probe() -> None:
    """The texture ``probe``, in the variant that is set: the side √|det|, the major axis, and 1."""

    class Probe(mi.Texture):
        cone = None

        def set_cone(self, cone):
            self.cone = cone

        def eval(self, si, active=True):
            ddx, ddy = footprint.footprint(si, self.cone)
            return mi.Color3f(dr.sqrt(footprint.area(ddx, ddy)), footprint.axes(ddx, ddy)[0], 1)

        def eval_3(self, si, active=True):
            return self.eval(si, active)

    mi.register_texture("probe", Probe)


def mesh(name: str, **more) -> dict:
    """Return one of the scenes' meshes as a shape, within a ball of radius 1.5."""
    shape = {"type": "ply", "filename": str(ASSETS / f"{name}.ply")}
    box = mi.load_dict(shape).bbox()
    move = mi.ScalarTransform4f().translate((-np.array(box.center())).tolist())
    radius = float(np.linalg.norm(np.array(box.extents()))) / 2
    return {**shape, "to_world": mi.ScalarTransform4f().scale(1.5 / radius) @ move, **more}


def sensor(kind="perspective", to_world=None, **more) -> dict:
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    lens = {"aperture_radius": 0.01, "focus_distance": 2.0} if kind == "thinlens" else {}
    place = {} if to_world is None else {"to_world": to_world}
    return {"type": kind, "film": film, "sampler": {"type": "independent", "sample_count": 1}, **lens, **place, **more}


def look_at(origin, target, up=(0, 1, 0)):
    return mi.ScalarTransform4f().look_at(origin=list(origin), target=list(target), up=list(up))


def rays(sensor, dx: float, dy: float):
    """The rays of all pixels, through their centres moved by that many pixels; any move is the same kernel."""
    x, y = dr.meshgrid(dr.arange(mi.Float, WIDTH), dr.arange(mi.Float, HEIGHT))
    dx, dy = dr.opaque(mi.Float, dx), dr.opaque(mi.Float, dy)
    place = mi.Point2f((x + 0.5 + dx) / WIDTH, (y + 0.5 + dy) / HEIGHT)
    return sensor.sample_ray(sensor.shutter_open(), 0.5, place, mi.Point2f(0.5))[0]


def hits(scene, chain=(), dx: float = 0, dy: float = 0) -> list:
    """The hits of the rays through all pixels, followed along ``chain``; each evaluated, which compiles one kernel."""
    ray, found = rays(scene.sensors()[0], dx, dy), []
    for follow in (*chain, None):
        found.append(scene.ray_intersect(ray))
        dr.eval(found[-1])
        if follow is not None:
            ray = follow(found[-1])
    return found


def mirrored(si):
    """The ray that a mirror reflects."""
    return si.spawn_ray(si.to_world(mi.reflect(si.wi)))


def refracted(ior: float):
    """Return a function that follows rays through a boundary with vacuum outside."""

    def follow(si):
        _, cosine, _, ratio = mi.fresnel(mi.Frame3f.cos_theta(si.wi), ior)
        return si.spawn_ray(si.to_world(mi.refract(si.wi, cosine, ratio)))

    return follow


def truth(scene, chain=()) -> tuple:
    """The hit of the central rays, and ``ddx, ddy`` as NumPy arrays ``(n, 2)``, and where they are to be trusted: all
    five rays meet the same shapes, and the last within a small piece of the texture. ``chain``: what follows a ray at
    each hit before the last.
    """

    def hit(dx, dy):
        met = hits(scene, chain, dx, dy)
        shapes = [np.array(dr.reinterpret_array(mi.UInt32, si.shape)) for si in met]
        return met[-1], np.isfinite(np.array(met[-1].t)), np.array(met[-1].uv).T, shapes

    centre, valid, _, shapes = hit(0, 0)
    uv = []
    for place in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)):
        _, there, found, met = hit(*place)
        valid &= there & np.all([a == b for a, b in zip(shapes, met, strict=True)], axis=0)
        uv.append(found)
    ddx, ddy = uv[0] - uv[1], uv[2] - uv[3]
    valid &= np.maximum(np.abs(ddx).max(axis=1), np.abs(ddy).max(axis=1)) < 0.3
    return centre, ddx, ddy, valid


def measures(ddx, ddy) -> np.ndarray:
    """Side and major axis, ``(n, 2)``, of diameters ``(n, 2)`` each, by NumPy alone."""
    matrix = np.stack([ddx, ddy], axis=-1).astype(np.float64)
    return np.stack([np.sqrt(np.abs(np.linalg.det(matrix))), np.linalg.svd(matrix)[1][:, 0]], axis=-1)


def errors(found: np.ndarray, ddx, ddy, where) -> np.ndarray:
    """Return median and 90th percentile of the relative errors of side and major axis, ``(2, 2)``."""
    expected = measures(ddx, ddy)[where]
    return np.percentile(np.abs(found[where] / expected - 1), (50, 90), axis=0).T
