"""White furnace: a ball that absorbs nothing, under a sky of radiance 1, is invisible. The ball is a ``neural_sdf``
and, beside it, a mesh; here, and moved by 10⁴ times its size.
"""

import drjit as dr
import numpy as np
import pytest
from sdf_fields import sparse_table

from mi_diffind.arrays.tables import save_table
from mi_diffind.plugins.support import distance_shapes

SIZE, FAR = 48, 1e4

BSDFS = {
    "glass": {"type": "dielectric"},
    "mirror": {"type": "conductor", "material": "none", "specular_reflectance": 1.0},
}


def ball(p):
    """Distance to a ball that fills the unit frame, and its gradient."""
    r = np.linalg.norm(p, axis=1)
    return r - 0.5, p / np.maximum(r, 1e-12)[:, None]


@pytest.fixture(scope="module")
def shapes(tmp_path_factory):
    import trimesh

    path = tmp_path_factory.mktemp("furnace")
    save_table(path / "ball.npz", sparse_table(ball, scale=2.0, centre=(0, 0, 0)))
    trimesh.creation.icosphere(5, 1.0).export(path / "ball.ply")
    return {
        "field": {"type": "neural_sdf", "filename": str(path / "ball.npz")},
        "mesh": {"type": "ply", "filename": str(path / "ball.ply")},
    }


def furnace(mi, shape, bsdf, far=0.0, spp=16, view=(0.3, -5, 0.7), fov=30, size=SIZE):
    """A picture of a shape moved by ``far``, under a white sky. No path ends by roulette."""
    at = mi.ScalarTransform4f
    move = at().translate([far, -far, 0.5 * far])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = move @ at().look_at(view, [0, 0, 0], [0, 0, 1])
    loaded = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path_sdf", "max_depth": 1000, "rr_depth": 10**6},
        "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "fov": fov, "near_clip": 1e-3, "to_world": view, "film": film},
        "ball": {**shape, "to_world": move, "bsdf": BSDFS[bsdf]},
    })  # fmt: skip
    return np.array(mi.render(loaded, spp=spp)).mean(-1)


@pytest.mark.parametrize("far", [0.0, FAR])
@pytest.mark.parametrize("bsdf", ["glass", "mirror"])
def test_smooth_balls_are_invisible_in_every_sample(mi, shapes, bsdf, far):
    """The mesh, which is not moved, has a few pixels that are not 1: its smooth normals are not those of triangles."""
    image, mesh = furnace(mi, shapes["field"], bsdf, far), furnace(mi, shapes["mesh"], bsdf)
    assert np.abs(image - 1).max() < 1e-5
    assert (np.abs(image - mesh) > 0.01).sum() <= 16


def test_glass_seen_from_within(mi, shapes):
    """A path that starts in the ball leaves it once more than it enters: radiance grows by η²."""
    for far in (0.0, FAR):
        image = furnace(mi, shapes["field"], "glass", far, 32, view=(0.25, 0.5, 0.125), fov=90, size=16)
        assert np.abs(image / (1.5046 / 1.000277) ** 2 - 1).max() < 1e-4  # bk7 in air


def test_hits_far_from_the_origin_are_those_near_it(mi, shapes, rng):
    """Distances and places of camera rays: as exact as those of a mesh."""
    at = mi.ScalarTransform4f
    o = np.round(rng.normal(size=(3, 4000)) * 2**8) / 2**8  # exact after the move
    o += np.sign(o) * 2
    d = rng.uniform(-0.6, 0.6, o.shape) - o
    d = (d / np.linalg.norm(d, axis=0)).astype(np.float32)
    results = []
    for far in (0.0, 2.0**13):
        shape = mi.load_dict({**shapes["field"], "to_world": at().translate([far, -far, far])})
        start = o + far * np.array([[1], [-1], [1]])
        hit = distance_shapes.Solids([shape]).intersect(mi.Point3f(start), mi.Vector3f(d), mi.Float(dr.inf))
        results.append([np.array(v) for v in (hit.number, hit.t, hit.p)])
    (near, t, p), (moved, far_t, far_p) = results
    assert (near == moved).all() and near.mean() > 0.5
    assert np.abs(t - far_t)[near > 0].max() < 2e-6 and np.abs(p - far_p)[:, near > 0].max() < 2e-6
