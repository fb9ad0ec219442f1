"""The path tracer with footprints: the light is that of Mitsuba's, the footprints those of finite differences."""

import drjit as dr
import footprints as fp
import numpy as np
import pytest
from variants import set_variant

from mi_diffind.plugins.support.footprint import Differentials

GLASS = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0, "specular_reflectance": 0.0}
MIRROR = {"type": "conductor", "material": "none"}
SIZE = {"type": "hdrfilm", "width": 16, "height": 12, "rfilter": {"type": "box"}}


def scaled(mi, *scale):
    return mi.ScalarTransform4f().scale(list(scale) if len(scale) > 1 else scale[0])


def shown(mi, shapes: dict, **sensor) -> tuple:
    """The scene in a room that emits the footprints on its walls, and what is seen of them."""
    room = {"type": "cube", "flip_normals": True, "to_world": scaled(mi, 6)}
    room["emitter"] = {"type": "area", "radiance": {"type": "probe"}}
    camera = fp.sensor(**{"to_world": fp.look_at([0.5, 2.5, 4], [0, 0, 0]), "fov": 40, **sensor})
    scene = mi.load_dict({"type": "scene", "room": room, "sensor": camera, **shapes}, parallel=False)
    integrator = mi.load_dict({"type": "path_footprint", "jitter": False, "max_depth": 6})
    image = np.array(mi.render(scene, spp=1, integrator=integrator)).reshape(-1, 3)
    return scene, image[:, :2] / np.maximum(image[:, 2:], 1e-9), image[:, 2] > 0


def trusted(scene, chain: tuple, seen) -> tuple:
    """Finite differences, and where to trust them: all of the way belongs to the mirrors, its end to the room."""
    si, ddx, ddy, where = fp.truth(scene, chain)
    for mirror in fp.hits(scene, chain)[:-1]:
        where &= ~np.array(mirror.shape.is_emitter())
    return ddx, ddy, where & np.array(si.shape.is_emitter()) & seen


def check(mi, shapes: dict, chain: tuple, median: float, worst: float, **sensor):
    """Check the errors of side and major axis against two limits: median, 90th percentile."""
    fp.register_probe()
    scene, found, seen = shown(mi, shapes, **sensor)
    ddx, ddy, where = trusted(scene, chain, seen)
    assert where.sum() > 40
    errors = fp.errors(found, ddx, ddy, where)
    assert (errors[:, 0] < median).all() and (errors[:, 1] < worst).all(), errors


def test_directly_seen_from_a_far_near_plane_and_in_a_crop(mi):
    crop = {"crop_width": fp.WIDTH, "crop_height": fp.HEIGHT, "crop_offset_x": 20, "crop_offset_y": 5}
    film = {"type": "hdrfilm", "width": 3 * fp.WIDTH, "height": 2 * fp.HEIGHT, "rfilter": {"type": "box"}, **crop}
    check(mi, {}, (), 0.005, 0.01, near_clip=1.0, film=film)


@pytest.mark.parametrize("kind", ["plane", "ball", "knot", "vase", "mirrored", "instance"])
def test_through_mirrors(mi, kind):
    if kind == "plane":
        turn = mi.ScalarTransform4f().rotate([1, 0, 0], -60) @ scaled(mi, 2)
        shapes = {"m": {"type": "rectangle", "to_world": turn, "bsdf": MIRROR}}
    elif kind == "ball":
        shapes = {"m": {"type": "sphere", "to_world": scaled(mi, 1.4), "bsdf": MIRROR}}
    else:
        shapes = {"m": fp.mesh("knot" if kind == "knot" else "vase", bsdf=MIRROR)}
    place = shapes["m"]["to_world"]
    if kind == "mirrored":
        shapes["m"] |= {"to_world": scaled(mi, -1, 1, 1) @ place, "bsdf": {"type": "twosided", "bsdf": MIRROR}}
    elif kind == "instance":
        del shapes["m"]["to_world"]
        instance = {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}
        shapes = {"group": {"type": "shapegroup", **shapes}, "m": instance}
    # Of meshes, a pixel spans several triangles, over which differences are not derivatives
    median, worst = (0.01, 0.05) if kind in ("plane", "ball") else (0.1, 1.5)
    check(mi, shapes, (fp.mirrored,), median, worst)


def test_through_hollow_mirrors_and_glass(mi):
    lamp = {"type": "area", "radiance": {"type": "probe"}}
    place = mi.ScalarTransform4f().translate([0.5, 2.0, 1.5]) @ scaled(mi, 1.2)
    hollow = {"type": "sphere", "to_world": scaled(mi, 7), "flip_normals": True, "bsdf": MIRROR}
    check(mi, {"m": hollow, "room": {"type": "sphere", "to_world": place, "emitter": lamp}}, (fp.mirrored,), 0.02, 0.1)
    follow = fp.refracted(1.5)
    check(mi, {"m": {"type": "sphere", "bsdf": GLASS}}, (follow, follow), 0.02, 0.1)


def test_rough_bounces_widen_and_samples_share(mi):
    """The rougher, the larger; of many samples, each covers less; straight on through a mask, nothing changes."""
    fp.register_probe()

    def side(bsdf, spp=1):
        mirror = {"type": "rectangle", "to_world": scaled(mi, 2), "bsdf": bsdf}
        wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 3]) @ scaled(mi, 9, 9, -1)}
        wall["emitter"] = {"type": "area", "radiance": {"type": "probe"}}
        camera = fp.sensor(to_world=fp.look_at([0, 0.3, 2], [0, 0, 0]), fov=30, film=SIZE)
        scene = mi.load_dict({"type": "scene", "m": mirror, "w": wall, "s": camera})
        image = np.array(mi.render(scene, spp=spp, integrator=mi.load_dict({"type": "path_footprint", "max_depth": 2})))
        return np.median(image[..., 0] / image[..., 2])

    rough = [side({"type": "roughconductor", "material": "none", "alpha": a}) for a in (0.01, 0.03, 0.1)]
    smooth = side(MIRROR)
    assert smooth < rough[0] < rough[1] < rough[2]
    # 3 away, a lobe of solid angle 4π α² (GGX at its peak) on a wall 18 wide
    assert 0.5 < rough[1] / (3 * np.sqrt(4 * np.pi) * 0.03 / 18) < 3
    assert side(MIRROR, 16) == pytest.approx(smooth / 4, rel=0.02)
    assert side(MIRROR, 256) == pytest.approx(smooth / 8, rel=0.02)


def test_cones_of_rough_bounces_add_up(mi):
    """The variances of the angles add up over several bounces, each of the solid angle of its sample."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.n, si.sh_frame = mi.Normal3f(0, 0, 1), mi.Frame3f(mi.Normal3f(0, 0, 1))
    ray, still = mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, -1)), mi.Vector3f(0)
    cone = Differentials(still, still, still, still, mi.Float(0), mi.Float(0))
    edges = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    spreads = []
    for pdf, delta in ((400, False), (100, False), (1, True), (400, False)):
        cone = cone.bounce(ray, si, mi.Vector3f(0, 0, 1), mi.Float(1), mi.Float(pdf), mi.Bool(delta), 0.5, edges)
        spreads.append(cone.spread[0])
    assert spreads == pytest.approx(0.025 * np.sqrt([1, 1 + 4, 1 + 4, 1 + 4 + 1]))


def lit(mi, bsdf: dict, **more) -> dict:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1]) @ scaled(mi, 3)}
    light = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 4]) @ scaled(mi, 1, 1, -1)}
    texels = np.random.default_rng(1).uniform(0.2, 0.8, (4, 4, 1 if mi.is_spectral else 3)).astype(np.float32)
    floor["bsdf"] = {"type": "diffuse", "reflectance": {"type": "bitmap", "id": "texels", "raw": True}}
    floor["bsdf"]["reflectance"].update(data=mi.TensorXf(texels), filter_type="bilinear")
    return {
        "type": "scene",
        "floor": floor,
        "light": {**light, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}},
        "ball": {"type": "sphere", "bsdf": bsdf},
        "sky": {"type": "constant", "radiance": 0.3},
        "sensor": fp.sensor(to_world=fp.look_at([0, -5, 2.5], [0, 0, 0], [0, 0, 1]), fov=45, film=SIZE),
        **more,
    }


BSDFS = {
    "glass": {"type": "dielectric"},
    "rough": {"type": "roughconductor", "alpha": 0.2},
    "mask": {"type": "mask", "opacity": 0.4, "nested": {"type": "diffuse"}},
}


@pytest.mark.parametrize("footprints", [False, True])
def test_light_and_derivatives_are_those_of_prb(mi, footprints):
    """The same random numbers lead to the same paths: images agree sample by sample, with footprints or without."""
    fp.register_probe()
    balls = {
        f"ball{i or ''}": {"type": "sphere", "center": [1.6 * i - 1.6, 0, 0], "radius": 0.75, "bsdf": bsdf}
        for i, (name, bsdf) in enumerate(BSDFS.items())
    }
    dark = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 40]), "bsdf": {"type": "diffuse"}}
    dark["bsdf"]["reflectance"] = {"type": "probe"}
    scene = mi.load_dict(lit(mi, {}, **balls, **({"dark": dark} if footprints else {})))
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("texels.data") or k.endswith("reflectance.data"))
    images, gradients = [], []
    for plugin in ("prb", "path_footprint"):
        integrator = mi.load_dict({"type": plugin, "max_depth": 5, "rr_depth": 3})
        params[key] = type(params[key])(dr.detach(params[key]))
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, spp=16, seed=3, integrator=integrator)
        dr.backward(dr.mean(dr.square(image), axis=None))
        images.append(np.array(dr.detach(image)))
        gradients.append(np.array(dr.grad(params[key])))
    assert np.isclose(*images, rtol=1e-3, atol=1e-5).mean() > 0.99
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=1e-3) and np.abs(gradients[0]).max() > 0
    np.testing.assert_allclose(*gradients, rtol=2e-2, atol=1e-3 * np.abs(gradients[0]).max())


def test_light_is_that_of_path(mi):
    """Alpha, hidden emitters, environments and null surfaces, in which ``prb`` differs."""
    rough, mask = BSDFS["rough"], {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}}
    for bsdf, more, given in (
        (BSDFS["mask"], {}, {"hide_emitters": True}),
        (mask, {"sky": {"type": "point", "position": [1, -3, 3], "intensity": 9.0}}, {"max_depth": 3}),
        (rough, {}, {"max_depth": 1}),
    ):
        scene = lit(mi, bsdf, **more)
        scene["sensor"]["film"] = {**SIZE, "pixel_format": "rgba"}
        scene = mi.load_dict(scene)
        passes = []
        for seed, plugin in enumerate(("path", "path_footprint")):
            integrator = mi.load_dict({"type": plugin, **given})
            images = (mi.render(scene, spp=64, seed=9 * seed + i, integrator=integrator) for i in range(8))
            passes.append(np.array([np.array(image).mean((0, 1)) for image in images]))
        a, b = passes
        error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 8)
        assert (np.abs(a.mean(0) - b.mean(0)) < 5 * error + 1e-6).all(), (bsdf, given, a.mean(0), b.mean(0), error)


def test_spheres_behind_hidden_emitters(mi):
    """Shaded where they are: with a hidden lamp that sends no light before the camera as without it."""
    images = []
    place = mi.ScalarTransform4f().translate([0, -4, 0]).rotate([1, 0, 0], 90)
    dark = {"type": "area", "radiance": {"type": "rgb", "value": 0}}
    lamp = {"type": "rectangle", "to_world": place, "emitter": dark}
    for more in ({}, {"lamp": lamp}):
        camera = fp.sensor(to_world=fp.look_at([0, -5, 0], [0, 0, 0], [0, 0, 1]), fov=30, film=SIZE)
        light = {"type": "point", "position": [-6, -6, 6], "intensity": 40.0}
        scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "light": light, "sensor": camera, **more})
        integrator = mi.load_dict({"type": "path_footprint", "max_depth": 2, "hide_emitters": True})
        images.append(np.array(mi.render(scene, spp=256, integrator=integrator)))
    assert images[0].mean() > 0.01 and np.abs(images[0] - images[1]).mean() < 0.1 * images[0].mean()


def test_centres_of_pixels_and_parameters(mi):
    scene = mi.load_dict(lit(mi, {"type": "diffuse"}))
    centred = mi.load_dict({"type": "path_footprint", "jitter": False, "max_depth": 1})
    images = [np.array(mi.render(scene, spp=1, seed=s, integrator=centred)) for s in (0, 1)]
    assert (images[0] == images[1]).all()
    assert "jitter = false" in str(centred) and "max_depth = 1" in str(centred)
    assert "max_depth = -1" in str(mi.load_dict({"type": "path_footprint"}))
    for name, value in (("max_depth", -2), ("rr_depth", 0), ("jitter", 3), ("max_depth", 2.5)):
        with pytest.raises(RuntimeError, match=f'parameter "{name}": found {value}, allowed'):
            mi.load_dict({"type": "path_footprint", name: value})


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral", "llvm_ad_mono_polarized"])
def test_other_variants(variant):
    mi = set_variant(variant)
    fp.register_probe()
    if "polarized" in variant:
        with pytest.raises(RuntimeError, match="does not run in polarised variants"):
            mi.load_dict({"type": "path_footprint"})
        return
    scene = mi.load_dict(lit(mi, BSDFS["rough"]))
    a, b = (
        np.array(mi.render(scene, spp=256, seed=s, integrator=mi.load_dict({"type": plugin, "max_depth": 3}))).mean()
        for s, plugin in enumerate(("path", "path_footprint"))
    )
    assert a == pytest.approx(b, rel=0.03)
