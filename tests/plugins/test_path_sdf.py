"""The integrator that traces signed distance fields, against Mitsuba's own shapes and against differences."""

import drjit as dr
import numpy as np
import pytest
from sdf_fields import Ball, register
from variants import warnings_of

from mi_diffind.core import compat
from mi_diffind.plugins.support import distance_shapes

BSDFS = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}},
    "rough": {"type": "roughconductor", "alpha": 0.2},
    "glass": {"type": "dielectric"},
    "mask": {"type": "mask", "opacity": 0.4, "nested": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
}


def scene(mi, shapes: dict, size=(32, 24), view=((0, -5, 2.5), (0, 0, 0)), passes=1, **more):
    """Shapes on a floor, with a lamp, a point light and a sky; ``passes`` images of one view beside each other."""
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": passes * size[0], "height": size[1], "rfilter": {"type": "box"}}
    view = {"type": "perspective", "fov": 45, "to_world": at().look_at(*view, [0, 0, 1])}
    sensor = view if passes == 1 else {"type": "batch", **{f"pass_{i}": dict(view) for i in range(passes)}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}
    return mi.load_dict({
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": at().translate([0, 0, -1]).scale(3)},
        "lamp": {"type": "rectangle", "to_world": at().translate([0, 1, 4]).scale([1, 1, -1]), "emitter": lamp},
        "point": {"type": "point", "position": [-3, -2, 1], "intensity": 4.0},
        "sky": {"type": "constant", "radiance": 0.3},
        "sensor": {**sensor, "film": film, "sampler": {"type": "independent"}},
        **shapes,
        **more,
    })  # fmt: skip


def render(mi, loaded, integrator="path_sdf", spp=16, seed=0, **options):
    tracer = mi.load_dict({"type": integrator, "max_depth": 6, **options})
    return np.array(mi.render(loaded, spp=spp, seed=seed, integrator=tracer))


@pytest.fixture
def fields(mi):
    """The fields that a ``test_solid`` may name."""
    types = compat.backend_module(mi.Float)
    by_name = {"ball": Ball(types), "aside": Ball(types, 0.3, (0.15, 0.1, -0.05))}
    register(mi, by_name)
    return by_name


def solid(mi, name, scale=2.5, **more):
    return {"type": "test_solid", "field": name, "to_world": mi.ScalarTransform4f().scale(scale), **more}


def same_light(mi, actual: dict, expected: dict, view=((0, -5, 2.5), (0, 0, 0)), passes=16, **options):
    """Scenes of these shapes, traced by ``path_sdf`` and by ``path``, have images with the same mean, as far as the
    noise of as many passes, all in one render, lets one see.
    """
    a, b = (scene(mi, shapes, view=view, passes=passes) for shapes in (actual, expected))
    a, b = (render(mi, *v, **options) for v in ((a, "path_sdf", 16, 0), (b, "path", 16, 100)))
    a, b = (np.stack(np.split(v, passes, axis=1)) for v in (a, b))
    assert np.isfinite(a).all() and np.isfinite(b).all()
    a, b = (np.minimum(v, 20).mean(-1) for v in (a, b))
    a, b = (v.reshape(passes, v.shape[1] // 4, 4, v.shape[2] // 4, 4).mean((2, 4)) for v in (a, b))
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / passes)
    difference = a.mean(0) - b.mean(0)
    seen = error > 1e-6
    assert np.abs(difference[~seen]).max(initial=0) < 1e-5
    z = difference[seen] / error[seen]
    assert np.abs(z).max() < 5.5 and abs(z.mean()) < 5 / np.sqrt(z.size) and z.std() < 1.5, (z.mean(), z.std())
    assert abs(difference.mean()) < 4 * np.sqrt((error**2).sum()) / error.size + 1e-5


def test_scenes_without_solids(mi):
    """Rendered by ``path_footprint``, whose loop it is."""
    loaded = scene(mi, {"ball": {"type": "sphere", "bsdf": BSDFS["rough"]}})
    np.testing.assert_array_equal(*(render(mi, loaded, name) for name in ("path_sdf", "path_footprint")))


@pytest.mark.parametrize("names", [("diffuse", "rough"), ("glass", "mask")], ids="-".join)
def test_balls_are_spheres(mi, fields, names):
    """Light, shadows, reflections and refractions of solids are those of Mitsuba's spheres, two materials a scene."""
    (first, second) = (BSDFS[name] for name in names)
    other = {"other": {"type": "sphere", "center": [1.6, 1.0, -0.4], "radius": 0.6, "bsdf": BSDFS["diffuse"]}}
    beside = {"to_world": mi.ScalarTransform4f().translate([-1.4, -1.2, 0.2]).scale(2.0), "bsdf": second}
    actual = {"ball": solid(mi, "ball", bsdf=first), "beside": {**solid(mi, "ball"), **beside}, **other}
    sphere = {"type": "sphere", "center": [-1.4, -1.2, 0.2], "radius": 0.8, "bsdf": second}
    same_light(mi, actual, {"ball": {"type": "sphere", "bsdf": first}, "beside": sphere, **other})


def test_several_solids_turned_scaled_and_overlapping(mi, fields):
    """Three solids of two fields, one of them a reflection, beside a mesh that one of them cuts."""
    at = mi.ScalarTransform4f
    turns = {
        "a": at().translate([-0.8, 0.2, 0.1]).rotate([0.6, 0, 0.8], 70).scale(2.0),
        "b": at().translate([0.1, -0.3, 0]).rotate([0, 1, 0], 200).scale(2.4),
        "c": at().translate([1.1, 0.4, -0.2]) @ at().scale([-1.6, 1.6, 1.6]),
    }
    bsdfs = {"a": BSDFS["diffuse"], "b": BSDFS["rough"], "c": BSDFS["glass"]}
    block = {"block": {"type": "cube", "to_world": at().translate([0.2, 1.2, -0.6]).scale(0.5)}}
    solids, spheres = {}, {}
    for name, turn in turns.items():
        solids[name] = {"type": "test_solid", "field": "aside", "to_world": turn, "bsdf": bsdfs[name]}
        centre = np.array(turn.matrix)[:3] @ [0.15, 0.1, -0.05, 1]
        radius = 0.3 * np.cbrt(abs(np.linalg.det(np.array(turn.matrix)[:3, :3])))
        spheres[name] = {"type": "sphere", "center": centre.tolist(), "radius": radius, "bsdf": bsdfs[name]}
    same_light(mi, {**solids, **block}, {**spheres, **block})


@pytest.mark.parametrize(
    "name, pane, view",
    [
        ("glass", False, ((0.1, -0.5, 0.2), (0.5, 0.5, -0.2))),
        ("diffuse", True, ((0, -4, 0.2), (0, 0, 0))),
        ("diffuse", False, ((0.95, -0.95, 0.95), (0, 0.2, 0))),
    ],
    ids=["within glass", "behind glass", "in the box"],
)
def test_where_the_camera_is(mi, fields, name, pane, view):
    bsdf = {"bsdf": BSDFS[name]}
    place = mi.ScalarTransform4f().translate([0, -2, 0]).scale([1.5, 0.1, 1.5])
    panes = {"pane": {"type": "cube", "to_world": place, "bsdf": BSDFS["glass"]}} if pane else {}
    same_light(mi, {"ball": solid(mi, "ball", **bsdf), **panes}, {"ball": {"type": "sphere", **bsdf}, **panes}, view)


def test_shadows_of_a_sky_far_from_the_origin(mi, fields):
    """Directions to a sky count, since its places are rounded far away: from between two balls."""
    count, far = 4000, 1e7
    at = mi.ScalarTransform4f().translate
    small = {**solid(mi, "ball"), "to_world": at([far, 3, 0])}
    large = {**solid(mi, "ball"), "to_world": at([far, 0, 0]).scale(2.5)}
    loaded = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "small": small, "large": large})
    solids = distance_shapes.solids_in(loaded)
    number = 1 + [shape.id() for shape in solids.shapes].index("small")
    hit = distance_shapes.ShapeHit(mi.UInt32(number), mi.Float(1), mi.Point3f(0, -0.4, 0), mi.Vector3f(0))
    hit = distance_shapes.SolidHit(dr.zeros(mi.PreliminaryIntersection3f), hit, hit)
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n = mi.Point3f(far, 2.6, 0), mi.Normal3f(0, -1, 0)
    ds, _ = loaded.emitters()[0].sample_direction(si, mi.Point2f(np.random.default_rng(1).random((2, count))))
    found, d = np.array(solids.occluded(hit, si, ds, True)), np.array(ds.d, np.float64).T
    below = d[:, 1] < -0.05
    expected = 2.6**2 * (1 - d[:, 1] ** 2) < 1
    assert 0.05 < expected[below].mean() < 0.2 and (found != expected)[below].sum() <= 2


@pytest.mark.parametrize("options", [{"max_depth": 1}, {"max_depth": 2, "hide_emitters": True}, {"rr_depth": 1}])
def test_depths_and_hidden_emitters(mi, fields, options):
    view = ((0, -5, 8.0), (0, 0, 1))
    actual, expected = solid(mi, "ball", bsdf=BSDFS["rough"]), {"type": "sphere", "bsdf": BSDFS["rough"]}
    same_light(mi, {"ball": actual}, {"ball": expected}, view, **options)


def test_solids_in_groups_are_refused(mi, fields):
    group = {"type": "shapegroup", "ball": solid(mi, "ball")}
    loaded = scene(mi, {"group": group, "one": {"type": "instance", "group": {"type": "ref", "id": "group"}}})
    with pytest.raises(RuntimeError) as raised:
        render(mi, loaded)
    assert "is in a shapegroup" in compat.one_sentence(raised.value)


@pytest.mark.parametrize(
    "more, message",
    [
        ({"emitter": {"type": "area"}}, "emit no light"),
        ({"interior": {"type": "homogeneous"}}, "hold none"),
    ],
)
def test_what_solids_cannot_be(mi, fields, more, message):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "test_solid", "field": "ball", **more})


def interior(mi):
    """A sensor that sees the middle of the ball only."""
    film = {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at((0, -1.9, 1.1), (0, 0, 0.25), [0, 0, 1])
    return {"sensor": {"type": "perspective", "fov": 20, "to_world": at, "film": film}}


#: A sphere beside the ball.
OTHER = {"other": {"type": "sphere", "center": [0.6, -0.9, 1.6], "radius": 0.5, "bsdf": BSDFS["rough"]}}


def check_derivatives(actual, expected, depth):
    """Compare derivatives, except where paths part, by a rounding error or since frames differ."""
    assert np.median(np.abs(actual - expected)) < 0.02 * np.median(np.abs(expected))
    assert actual.mean() == pytest.approx(expected.mean(), rel=0.01 if depth == 2 else 0.15)


def both_modes(mi, loaded, ball, depth, spp=64, seed=3):
    """The image's derivative with respect to the radius, and its sum as it comes backward."""
    integrator = mi.load_dict({"type": "path_sdf", "max_depth": depth})
    ball.r = r = dr.opaque(mi.Float, 0.4)
    dr.enable_grad(r)
    dr.set_grad(r, 1.0)
    forward = np.array(integrator.render_forward(loaded, None, spp=spp, seed=seed))
    ball.r = r = dr.opaque(mi.Float, 0.4)
    dr.enable_grad(r)
    integrator.render_backward(loaded, None, dr.ones(mi.TensorXf, forward.shape), spp=spp, seed=seed)
    backward = np.array(dr.grad(r))
    ball.r = dr.opaque(mi.Float, 0.4)
    assert backward == pytest.approx(forward.sum(), rel=1e-3)
    return forward, backward


@pytest.mark.parametrize("name, depth", [("diffuse", 2), ("rough", 2), ("rough", 5)])
def test_derivatives_are_those_of_prb(mi, fields, name, depth):
    """The same random numbers lead to the same derivatives as for Mitsuba's own sphere, at all vertices of a path."""
    loaded = scene(mi, {"ball": solid(mi, "ball", bsdf=BSDFS[name]), **OTHER}, **interior(mi))
    actual, _ = both_modes(mi, loaded, fields["ball"], depth)
    loaded = scene(mi, {"ball": {"type": "sphere", "bsdf": BSDFS[name]}, **OTHER}, **interior(mi))
    params = mi.traverse(loaded)
    r = dr.opaque(mi.Float, 0.4)
    dr.enable_grad(r)
    params["ball.to_world"] = mi.AffineTransform4f().scale(2.5 * r)
    params.update()
    dr.forward(r, dr.ADFlag.ClearEdges)
    prb = mi.load_dict({"type": "prb", "max_depth": depth})
    expected = np.array(prb.render_forward(loaded, params, spp=64, seed=3))
    check_derivatives(actual, expected, depth)


MOVES = {
    "translation": lambda mi, v: mi.AffineTransform4f().translate(v * mi.Vector3f(0.3, -0.5, 0.8)),
    "rotation": lambda mi, v: mi.AffineTransform4f().rotate(mi.Vector3f(0.6, 0, 0.8), 90 * v),
    "scale": lambda mi, v: mi.AffineTransform4f().scale(1 + v),
}


def of_place(mi, loaded, integrator, move, mode="forward", spp=64, seed=3):
    """The image's derivative along a move of the ball that begins at rest, or the gradient of its sum."""
    params, v = mi.traverse(loaded), mi.Float(0)
    dr.enable_grad(v)
    params["ball.to_world"] = MOVES[move](mi, v) @ mi.AffineTransform4f(params["ball.to_world"])
    params.update()
    if mode == "forward":
        dr.forward(v, dr.ADFlag.ClearEdges)
        return np.array(integrator.render_forward(loaded, params, spp=spp, seed=seed))
    dr.backward(dr.sum(mi.render(loaded, params, integrator=integrator, spp=spp, seed=9, seed_grad=seed), axis=None))
    return dr.grad(v)[0]


@pytest.mark.parametrize("move, depth", [("translation", 2), ("rotation", 4), ("scale", 2)])
def test_derivatives_of_the_place_are_those_of_prb(mi, fields, move, depth):
    at = mi.ScalarTransform4f
    ours = solid(mi, "aside", bsdf=BSDFS["rough"])
    sphere = {"type": "sphere", "to_world": at().scale(2.5).translate([0.15, 0.1, -0.05]).scale(0.3)}
    loaded = scene(mi, {"ball": ours, **OTHER}, **interior(mi))
    tracer = mi.load_dict({"type": "path_sdf", "max_depth": depth})
    assert mi.traverse(loaded).flags("ball.to_world") == mi.ParamFlags.Discontinuous
    actual = of_place(mi, loaded, tracer, move)
    assert of_place(mi, loaded, tracer, move, "backward") == pytest.approx(actual.sum(), rel=1e-3)
    loaded = scene(mi, {"ball": {**sphere, "bsdf": BSDFS["rough"]}, **OTHER}, **interior(mi))
    expected = of_place(mi, loaded, mi.load_dict({"type": "prb", "max_depth": depth}), move)
    check_derivatives(actual, expected, depth)


@pytest.mark.parametrize("moved", ["field", "place"])
def test_derivatives_that_are_zero_are_said(mi, fields, monkeypatch, moved):
    """One warning for a black ball, of which only the outline shows, and none for a lit ball."""
    ball, warned = fields["ball"], warnings_of(mi, monkeypatch)
    integrator = mi.load_dict({"type": "path_sdf", "max_depth": 2})
    for reflectance, count in ((0.5, 0), (0.0, 1)):
        bsdf = {"type": "diffuse", "reflectance": reflectance}
        loaded = scene(mi, {"ball": solid(mi, "ball", bsdf=bsdf)}, (12, 8))
        for _ in range(2):
            if moved == "place":
                of_place(mi, loaded, integrator, "translation", "backward", spp=4)
            else:
                ball.r = dr.opaque(mi.Float, 0.4)
                dr.enable_grad(ball.r)
                integrator.render_backward(loaded, None, dr.ones(mi.TensorXf, (8, 12, 3)), spp=4)
                ball.r = dr.opaque(mi.Float, 0.4)
        assert len(warned) == count
    assert 'the derivatives of the shape "ball" (' in warned[0] and "are all zero" in warned[0]
