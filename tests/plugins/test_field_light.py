"""Surfaces that a radiance field lights and shadows: against meshes of the same shape and radiance in ``path``."""

import drjit as dr
import numpy as np
import pytest
from radiance_fields import Fog, register
from texture_scenes import refused

from mi_diffind.core import compat

#: Half of the sides of boxes that are opaque within a hundredth of them.
HALF = (0.3, 0.5, 0.2)

RADIANCE = (3.0, 2.0, 1.0)


@pytest.fixture
def fields(mi):
    types = compat.backend_module(mi.Float)
    fields = {
        "lamp": Fog(types, 1e3, RADIANCE, voxel=0.01, half=HALF),
        "black": Fog(types, 1e3, (0, 0, 0), voxel=0.01, half=HALF),
        "white": Fog(types, 1.0, (1, 1, 1), voxel=0.1),
    }
    register(mi, fields)
    return fields


def scene(mi, integrator, **more):
    film = {"type": "hdrfilm", "width": 32, "height": 24, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at([0.5, -3, 4], [0, 0, -0.3], [0, 0, 1])
    sensor = {"type": "perspective", "fov": 50, "to_world": at, "film": film}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **more})


def room(mi, floor=None):
    """A floor, a wall that mirrors roughly, and a leaf with holes."""
    at = mi.ScalarTransform4f
    leaf = {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse", "reflectance": 0.9}}
    metal, plastic = {"type": "roughconductor", "alpha": 0.2}, {"type": "plastic", "diffuse_reflectance": 0.7}
    wall = at().translate([0, 1.4, 0]).rotate([1, 0, 0], 90).scale(2)
    return {
        "floor": {"type": "rectangle", "to_world": at().translate([0, 0, -0.6]).scale(2), "bsdf": floor or plastic},
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": metal},
        "leaf": {"type": "rectangle", "to_world": at().translate([0.3, -0.6, 0.9]).scale(0.4), "bsdf": leaf},
    }


def turned(mi, offset=(0.1, 0, 0)):
    return mi.ScalarTransform4f().translate(offset).rotate([0.6, 0, 0.8], 30).scale(0.8)


def box(mi, to_world, radiance=None):
    """The mesh of a field."""
    material = {"bsdf": {"type": "diffuse", "reflectance": 0.0}}
    if radiance is not None:
        material = {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}}
    return {"type": "cube", "to_world": to_world @ mi.ScalarTransform4f().scale(list(HALF)), **material}


def field(name, **more):
    return {"type": "test_field", "field": name, "lit": True, **more}


def images(mi, made, spp, count=4):
    return np.stack([np.array(mi.render(made, spp=spp, seed=seed)) for seed in range(count)]).astype(np.float64)


def compare(mi, made, expected, spp=64, tolerance=0.02):
    """Means within ``tolerance``, and those of blocks of 8² pixels within their noise and the outline's pixels."""
    a, b = images(mi, made, spp), images(mi, expected, spp)
    assert (a.shape[1:3], a.shape[3]) == ((24, 32), 4)
    assert np.abs(a.mean((0, 1, 2)) / b.mean((0, 1, 2)) - 1).max() < tolerance
    a, b = (v.reshape(len(v), 3, 8, 4, 8, 4).mean((2, 4)) for v in (a, b))
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / len(a))
    assert (np.abs(a.mean(0) - b.mean(0)) < 6 * error + 0.02 * b.mean(0) + 1e-3).all()


@pytest.mark.parametrize("lights", ["one", "two", "joined"])
def test_a_lamp_lights_a_room_as_its_mesh_does(mi, fields, lights):
    """Plastic, a rough mirror, and through holes; one of two fields shadows the light of the other."""
    lamp, more = field("lamp", to_world=turned(mi), max_depth=4), {}
    if lights != "one":
        other = mi.ScalarTransform4f().translate([-0.9, -0.3, 0.2] if lights == "two" else [-0.1, -0.2, 0.1])
        del lamp["max_depth"]
        lamp["c"] = {"type": "test_field", "field": "black", "to_world": other, "max_depth": 4}
        more["other"] = box(mi, other)
    mesh = {"type": "path", "max_depth": 4}
    expected = scene(mi, mesh, box=box(mi, turned(mi), RADIANCE), **room(mi), **more)
    compare(mi, scene(mi, lamp, **room(mi)), expected)


def test_a_field_casts_the_shadow_of_its_mesh(mi, fields):
    """Shadows under a small lamp, in a dim sky that is hidden from the camera."""
    at = mi.ScalarTransform4f().translate([-1.2, 0.9, 2.5]).rotate([1, 0, 0], 180).scale(0.1)
    lights = {
        "lamp": {"type": "rectangle", "to_world": at, "emitter": {"type": "area", "radiance": 200.0}},
        "sky": {"type": "constant", "radiance": 0.2},
    }
    things = {**room(mi, {"type": "diffuse"}), **lights}
    del things["leaf"]
    paths = {"max_depth": 2, "hide_emitters": True}
    made = scene(mi, field("black", to_world=turned(mi), **paths), **things)
    compare(mi, made, scene(mi, {"type": "path", **paths}, box=box(mi, turned(mi)), **things))
    # Without the shadow, the floor is brighter
    unlit = scene(mi, field("black", to_world=turned(mi), **paths) | {"lit": False}, **things)
    bright, shadowed = (images(mi, one, 64, 1)[0, ..., 0] for one in (unlit, made))
    assert (bright > 1.3 * shadowed + 0.01).sum() > 20


def test_light_and_alpha_through_holes(mi, fields):
    """The expectation over the holes of what is seen without the leaf; nothing is hidden with the lights."""
    at = mi.ScalarTransform4f().look_at([0.0, -1.5, 2], [0, 0, 0], [0, 0, 1]).scale(3)
    leaf = {"type": "rectangle", "to_world": at}
    leaf["bsdf"] = {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse", "reflectance": 0.0}}
    covered, bare = (
        images(mi, scene(mi, field("white", hide_emitters=True), sky={"type": "constant"}, **more), 512, 1)[0]
        for more in ({"leaf": leaf}, {})
    )
    assert bare[..., 3].max() > 0.7 and bare[..., 3].min() < 0.3
    assert np.abs(covered[..., :3] - 0.6 * bare[..., :3]).max() < 0.12
    assert np.abs(covered[..., 3] - 0.4 - 0.6 * bare[..., 3]).max() < 0.12
    assert np.abs(covered - [0, 0, 0, 0.4] - 0.6 * bare).mean() < 0.02


def test_directions_towards_a_field_have_their_density(mi, fields):
    """The directions' histogram is that of the density, near and far; and the density is a density."""
    light = scene(mi, field("lamp", to_world=turned(mi))).integrator().surfaces.between
    count = 1 << 18
    rng = mi.PCG32(count)
    numbers = [rng.next_float32() for _ in range(5)]
    for place in ([0.1, 0.05, 0.1], [0.5, 0.2, -0.6], [3.0, 20.0, 1.0]):
        place = mi.Point3f(place)
        d, density = light.sample(place, numbers[0], mi.Point2f(*numbers[1:3]))
        uniform = mi.warp.square_to_uniform_sphere(mi.Point2f(*numbers[3:]))
        if place.x[0] == 3:  # a small cone around the field
            axis = mi.Frame3f(dr.normalize(-mi.Vector3f(place)))
            uniform = axis.to_world(mi.warp.square_to_uniform_cone(mi.Point2f(*numbers[3:]), 0.999))
            area = 2 * np.pi * 1e-3
        else:
            area = 4 * np.pi
        assert np.array(density > 0).mean() > 0.999
        expected = area * np.array(light.density(place, uniform))
        assert expected.mean() == pytest.approx(1, abs=0.03)
        for axis in range(3):
            mean = (expected * np.array(uniform)[axis]).mean()
            assert np.array(d)[axis].mean() == pytest.approx(mean, abs=0.02)


@pytest.mark.parametrize("name, place", [("lamp", (0, 0, 0.3)), ("speck", (-0.1, 0.04, 0.24))])
def test_directions_towards_a_field_reduce_the_noise(mi, fields, name, place):
    """Spheres only guide samples: the mean without them is the same; the light may be small in a large empty box."""

    class Speck(Fog):
        def density_at(self, p, active=True):
            density, data = super().density_at(p, active)
            return dr.select(dr.norm(p - mi.Point3f(0.5, -0.2, 0.3)) < 0.1, density, 0), data

    register(mi, {**fields, "speck": Speck(compat.backend_module(mi.Float), 1e3, RADIANCE, voxel=0.01)})
    at = mi.ScalarTransform4f().translate(list(place))
    made = scene(mi, field(name, to_world=at.scale(0.2) if name == "lamp" else at, max_depth=2),
                 **room(mi, {"type": "diffuse"}))  # fmt: skip
    guided = images(mi, made, 64)[:, 16:, :, :3]  # the floor before the lamp
    between = made.integrator().surfaces.between
    between.radiances = dr.zeros(mi.Float, dr.width(between.radiances))
    unguided = images(mi, made, 64)[:, 16:, :, :3]
    assert guided.var(0, ddof=1).mean() < 0.02 * unguided.var(0, ddof=1).mean()
    assert guided.mean() == pytest.approx(unguided.mean(), rel=0.05)


def test_a_field_that_moves_or_changes_is_followed(mi, fields):
    made = scene(mi, field("lamp", id="it"), **room(mi))
    params, between = mi.traverse(made), made.integrator().surfaces.between
    spheres, radiances = np.array(between.spheres).reshape(-1, 4), np.array(between.radiances)
    params["it.to_world"] = mi.AffineTransform4f().translate([1, 0, 0])
    params["it.tables.colour"] = mi.TensorXf(np.float32(2 * np.array(RADIANCE)))
    params.update()
    between = made.integrator().surfaces.between
    assert np.abs(np.array(between.spheres).reshape(-1, 4) - spheres - [1, 0, 0, 0]).max() < 1e-4
    assert np.abs(np.array(between.radiances) / radiances - 2).max() < 1e-3


def test_what_is_refused_and_warned_of(mi, fields):
    for more, message in (
        ({"c": {"type": "path"}}, 'parameter "lit": the nested integrator PathIntegrator does not see fields'),
        ({"lit": 1}, 'parameter "lit": found 1, allowed are true and false'),
    ):
        assert message in refused(mi, field("lamp") | more)
    smoke = {"type": "sphere", "id": "smoke", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous"}}
    made = scene(mi, field("lamp"), smoke=smoke, **room(mi))
    assert 'the participating medium of "smoke" is not rendered' in made.integrator()._unseen(made)
    assert made.integrator()._unseen(scene(mi, field("lamp"), **room(mi))) == ""
    unlit = scene(mi, field("lamp") | {"lit": False}, **room(mi))
    assert 'not visible through the holes of "leaf", "lit" shows it' in unlit.integrator()._unseen(unlit)
