"""A sample that is the only one of its pixel: textures that filter themselves read at the pixel's centre."""

import numpy as np
import pytest

from mi_diffind.plugins.support import footprint

FILM = (20, 12)

SENSORS = {
    "perspective": {"type": "perspective", "fov": 50.0},
    "orthographic": {"type": "orthographic"},
    "thinlens": {"type": "thinlens", "fov": 50.0, "aperture_radius": 0.1, "focus_distance": 3.0},
}


def scene_of(mi, kind, slant=0.0, spp=1):
    tilt = mi.ScalarTransform4f().rotate([1, 0, 0], slant).scale([6, 6, 1])
    look = mi.ScalarTransform4f().look_at([0.1, 0.2, 3], [0, 0, 0], [0, 1, 0])
    if kind == "orthographic":
        look = look.scale([2, 2, 1])
    film = {"type": "hdrfilm", "width": FILM[0], "height": FILM[1]}
    sampler = {"type": "independent", "sample_count": spp}
    return mi.load_dict({
        "type": "scene", "surface": {"type": "rectangle", "to_world": tilt},
        "sensor": {**SENSORS[kind], "to_world": look, "film": film, "sampler": sampler},
    })  # fmt: skip


def hits(mi, scene, x, y):
    sensor = scene.sensors()[0]
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(x / FILM[0], y / FILM[1]), mi.Point2f(0.5))
    return scene.ray_intersect(ray)


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
@pytest.mark.parametrize("slant, tolerance", [(0, 5e-3), (-35, 0.06)])
def test_what_the_centre_shows(mi, rng, kind, slant, tolerance):
    """The shift leads to where a ray through the centre goes; on a slant, but for the curvature of perspective."""
    scene = scene_of(mi, kind, slant)
    x, y = (rng.random(400) * n for n in FILM)
    si = hits(mi, scene, x, y)
    cone = footprint.Cone.from_sensor(scene.sensors()[0])
    ddx, ddy = footprint.footprint(si, cone)
    shift = np.array(footprint.to_centre(cone, si, ddx, ddy)).T
    centre = hits(mi, scene, np.floor(x) + 0.5, np.floor(y) + 0.5)
    both = np.array(si.is_valid()) & np.array(centre.is_valid())
    inside = (np.abs(x % 1 - 0.5) < 0.49) & (np.abs(y % 1 - 0.5) < 0.49)  # rounding may choose a neighbour
    assert both.mean() > 0.9
    error = np.linalg.norm(np.array(si.uv).T + shift - np.array(centre.uv).T, axis=1)[both & inside]
    size = np.linalg.norm(np.array(ddx).T, axis=1)[both & inside]
    assert (error / size).max() < tolerance
    assert np.linalg.norm(shift, axis=1)[both].max() > 0.4 * size.min()


def test_where_nothing_is_moved(mi, rng):
    """The shift is 0 with a lens, with several samples, without a sensor, and off the sensor's line of sight."""
    x, y = (rng.random(50) * n for n in FILM)
    for kind, spp in (("thinlens", 1), ("perspective", 4)):
        scene = scene_of(mi, kind, spp=spp)
        si = hits(mi, scene, x, y)
        cone = footprint.Cone.from_sensor(scene.sensors()[0])
        assert np.abs(np.array(footprint.to_centre(cone, si, *footprint.footprint(si, cone)))).max() == 0
    scene = scene_of(mi, "perspective")
    si, cone = hits(mi, scene, x, y), footprint.Cone.from_sensor(scene.sensors()[0])
    found = footprint.footprint(si, cone)
    assert np.abs(np.array(footprint.to_centre(cone, si, *found))).max() > 0
    assert np.abs(np.array(footprint.to_centre(None, si, *found))).max() == 0
    si.wi = si.to_local(mi.Vector3f(0.6, 0, 0.8))  # seen by way of something else
    assert np.abs(np.array(footprint.to_centre(cone, si, *found))).max() == 0
