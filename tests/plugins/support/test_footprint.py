"""Footprints of pixels: against finite differences of rays, and where there is nothing to measure."""

from dataclasses import replace

import drjit as dr
import footprints as fp
import numpy as np
import pytest

import mi_diffind
from mi_diffind.plugins.support import footprint
from mi_diffind.plugins.support.footprint import LARGEST, Cone
from mi_diffind.scenes import loading


def scene_of(mi, kind: str, camera: str = "perspective", **more):
    """A shape of about radius 1.5 in front of a camera."""
    if kind in ("vase", "knot"):
        shape = fp.mesh(kind)
    elif kind == "plane":
        shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -80).scale(20)}
    else:
        shape = {"type": "sphere"}
    place = fp.look_at([0.5, 0.8, 3], [0, 0, 0])
    if camera == "orthographic":
        return shape, place @ mi.ScalarTransform4f().scale([2, 2, 1]), {}
    return shape, place, {"fov": 60, **more}


def measured(mi, scene, cone=None) -> tuple:
    """Side and major axis of all pixels, ``(n, 2)``, as a texture is told; and what finite differences say."""
    si, *expected = fp.truth(scene)
    cone = Cone.from_sensor(scene.sensors()[0]) if cone is None else cone
    found = np.stack([np.array(v).T for v in footprint.footprint(si, cone)])
    return fp.measures(*found), *expected


@pytest.mark.parametrize("kind", ["plane", "plane90", "sphere", "vase", "knot"])
@pytest.mark.parametrize("camera", ["perspective", "thinlens", "orthographic"])
def test_as_finite_differences(mi, kind, camera):
    shape, place, more = scene_of(mi, kind.removesuffix("90"), camera, **({"fov": 90} if "90" in kind else {}))
    scene = mi.load_dict({"type": "scene", "shape": shape, "sensor": fp.sensor(camera, place, **more)})
    found, ddx, ddy, where = measured(mi, scene)
    assert where.sum() > 100
    errors = fp.errors(found, ddx, ddy, where)
    assert (errors[:, 0] < 0.05).all() and (errors[:, 1] < 0.2).all(), errors
    if "plane" in kind:
        assert (errors[:, 1] < 0.03).all(), errors


@pytest.mark.parametrize("kind", ["instance", "scaled", "mirrored", "inside", "crop", "near", "principal"])
def test_shapes_and_sensors_that_are_out_of_the_ordinary(mi, kind):
    scaled, turned = mi.ScalarTransform4f().scale, mi.ScalarTransform4f().rotate
    shape, place, more = scene_of(mi, "sphere" if kind == "inside" else "vase")
    shapes = {"shape": shape}
    if kind == "instance":
        turn = turned([1, 2, 0], 50) @ scaled([1, 2, 0.5])
        instance = {"type": "instance", "to_world": turn, "group": {"type": "ref", "id": "group"}}
        shapes = {"group": {"type": "shapegroup", "shape": shape}, "shape": instance}
    elif kind == "scaled":
        shape["to_world"] = scaled([1, 0.3, 1.4]) @ shape["to_world"]
    elif kind == "mirrored":
        shape["to_world"] = scaled([-1, 1, 1]) @ shape["to_world"]
    elif kind == "inside":
        shape["to_world"], place = scaled(4), fp.look_at([1, 0.5, 0.2], [0, -1, 3])
    elif kind == "crop":
        crop = {"crop_width": fp.WIDTH, "crop_height": fp.HEIGHT, "crop_offset_x": 40, "crop_offset_y": 30}
        more["film"] = {"type": "hdrfilm", "width": 3 * fp.WIDTH, "height": 3 * fp.HEIGHT, **crop}
    elif kind == "near":
        more["near_clip"] = 1.0
    else:
        more.update(principal_point_offset_x=0.2, principal_point_offset_y=-0.1)
    scene = mi.load_dict({"type": "scene", **shapes, "sensor": fp.sensor(to_world=place, **more)})
    found, ddx, ddy, where = measured(mi, scene)
    errors = fp.errors(found, ddx, ddy, where)
    assert where.sum() > 80 and (errors[:, 0] < 0.05).all() and (errors[:, 1] < 0.2).all(), errors


@pytest.mark.parametrize("integrator", ["path", "prb", "direct"])
def test_textures_of_stock_integrators_get_it(mi, integrator):
    """Both sides of a material, and a material below a normal map, evenly lit."""
    fp.register_probe()
    diffuse = {"type": "diffuse", "reflectance": {"type": "probe"}}
    flat = {"type": "bitmap", "raw": True, "data": mi.TensorXf(np.full((2, 2, 3), (0.5, 0.5, 1.0), np.float32))}
    mapped = {"type": "normalmap", "normalmap": flat, "bsdf": diffuse}
    for flip, bsdf in ((False, diffuse), (True, {"type": "twosided", "bsdf": diffuse}), (False, mapped)):
        shape, place, more = scene_of(mi, "sphere")
        shape.update(bsdf=bsdf, flip_normals=flip)
        scene = mi.load_dict({
            "type": "scene", "shape": shape, "sky": {"type": "constant"}, "sensor": fp.sensor(to_world=place, **more)
        })  # fmt: skip
        assert footprint.attach(scene) == 1
        given = {"max_depth": 2} if integrator != "direct" else {}
        image = mi.render(scene, spp=64, integrator=mi.load_dict({"type": integrator, **given}))
        image = np.array(image).reshape(-1, 3)
        _, ddx, ddy, where = fp.truth(scene)
        errors = fp.errors(image[:, :2] / image[:, 2:].clip(1e-6), ddx, ddy, where & (image[:, 2] > 0.2))
        assert (errors[:, 0] < 0.05).all() and (errors[:, 1] < 0.2).all(), errors


def test_what_is_not_seen_directly_is_never_blurred_more_than_in_truth(mi):
    """In a flat mirror, beyond which the path is longer, the estimate is below the true footprint."""
    mirror = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)}
    room = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(6), "flip_normals": True}
    camera = fp.sensor(to_world=fp.look_at([1, 0.5, 3], [0, 0, 0]), fov=50)
    scene = mi.load_dict({"type": "scene", "mirror": mirror, "room": room, "sensor": camera})
    si, ddx, ddy, where = fp.truth(scene, (fp.mirrored,))
    where &= np.array(scene.ray_intersect(fp.rays(scene.sensors()[0], 0, 0)).t) < 4.5
    found = np.stack([np.array(v).T for v in footprint.footprint(si, Cone.from_sensor(scene.sensors()[0]))])
    side, truth = fp.measures(*found)[where, 0], fp.measures(ddx, ddy)[where, 0]
    assert where.sum() > 500 and (side < 1.001 * truth).all() and (side > 0).all()


def hit(mi, **fields):
    """A place 2 in front of a sensor at the origin that looks along z, facing it, with uv = (x, y)."""
    si = dr.zeros(mi.SurfaceInteraction3f)
    given = {
        "p": mi.Point3f(0, 0, 2), "n": mi.Normal3f(0, 0, -1), "wi": mi.Vector3f(0, 0, 1), "t": 2.0,
        "dp_du": mi.Vector3f(1, 0, 0), "dp_dv": mi.Vector3f(0, 1, 0), "sh_frame": mi.Frame3f(mi.Normal3f(0, 0, -1)),
    }  # fmt: skip
    for name, value in {**given, **fields}.items():
        setattr(si, name, value)
    return si


def looking_along_z(mi, **given):
    props = mi.Properties()
    for name, value in {"sensor_to_world": mi.ScalarTransform4f(), "fov": 90.0, "resolution": 100, **given}.items():
        if value is not None:
            props[name] = value
    return Cone.from_properties(props)


def columns(found) -> np.ndarray:
    return np.array([[float(v.x[0]), float(v.y[0])] for v in found]).T


def test_places_that_a_lens_sees_from_its_rim(mi):
    """Directly seen, as from the middle of the lens; a pinhole there does not see the place along this line."""
    pinhole = looking_along_z(mi)
    lens = replace(pinhole, projection="thinlens", lens=dr.opaque(mi.Float, 0.3))
    si = hit(mi)
    si.wi = si.sh_frame.to_local(dr.normalize(mi.Vector3f(0.25, 0, -2)))
    np.testing.assert_allclose(columns(footprint.footprint(si, lens)), np.diag([-0.04, -0.04]), atol=1e-6)
    assert footprint.area(*footprint.footprint(si, pinhole))[0] < 0.04**2 / 2


@pytest.mark.parametrize(("t", "cosine"), [(1.5, 0.3), (1, 0.3), (1.9, 0.9), (3, 0.9)])
def test_the_larger_estimate_of_what_is_not_seen_directly(mi, t, cosine):
    """Along the last segment onto a surface oblique to it, or from the sensor, 2 away, onto one that faces it."""
    cone = looking_along_z(mi)
    si = hit(mi, wi=mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine), t=t)
    corner = 0.02 * 3**-0.75  # a pixel at the film's corner, at 90° of view
    expected = corner**2 * max(t**2 / cosine, 2**2)
    assert footprint.area(*footprint.footprint(si, cone))[0] == pytest.approx(expected, rel=1e-4)


def test_sources_hand_over_to_the_next_one(mi):
    cone = looking_along_z(mi)
    of_cone = np.diag([-0.04, -0.04])  # 2 tan 45° / 100, 2 away; Mitsuba's x points to the left, and y up
    np.testing.assert_allclose(columns(footprint.footprint(hit(mi), cone)), of_cone, atol=1e-6)
    given = {"duv_dx": mi.Vector2f(0.1, 0.2), "duv_dy": mi.Vector2f(-0.3, 0)}
    np.testing.assert_allclose(columns(footprint.footprint(hit(mi, **given), cone)), [[0.1, -0.3], [0.2, 0]])
    for bad in (np.nan, np.inf, -np.inf):
        si = hit(mi, **{**given, "duv_dx": mi.Vector2f(bad, 0)})
        np.testing.assert_allclose(columns(footprint.footprint(si, cone)), of_cone, atol=1e-6)
        alone = columns(footprint.footprint(si))
        np.testing.assert_allclose(alone[:, 0], [0 if np.isnan(bad) else np.sign(bad) * LARGEST, 0])
    assert (columns(footprint.footprint(hit(mi))) == 0).all()


def test_finite_whatever_the_place(mi):
    nan, inf, zero = mi.Vector3f(np.nan), mi.Vector3f(np.inf, 0, 0), mi.Vector3f(0)
    places = [
        {"dp_du": zero}, {"dp_dv": zero}, {"dp_du": zero, "dp_dv": zero}, {"dp_du": mi.Vector3f(0, 3, 0)},
        {"dp_du": nan}, {"dp_du": inf}, {"p": mi.Point3f(np.nan)}, {"p": mi.Point3f(np.inf)}, {"p": mi.Point3f(0)},
        {"p": mi.Point3f(0, 0, -2)}, {"p": mi.Point3f(0, 5, 0)}, {"wi": nan}, {"dp_du": mi.Vector3f(1e-25, 0, 0)},
        {"dp_du": mi.Vector3f(1e25, 0, 0)}, {"dp_du": mi.Vector3f(0, 0, 1)}, {"dp_du": mi.Vector3f(1e-9, 0, 1)},
    ]  # fmt: skip
    flat = mi.ScalarTransform4f()
    parallel = Cone.from_sensor(
        mi.load_dict({"type": "orthographic", "to_world": flat, "sampler": {"type": "independent"}})
    )
    for cone in (looking_along_z(mi), parallel, None):
        for i, given in enumerate(places):
            ddx, ddy = footprint.footprint(hit(mi, **given), cone)
            found = columns((ddx, ddy))
            assert np.isfinite(found).all() and np.abs(found).max() <= LARGEST, given
            major, minor, direction = footprint.axes(ddx, ddy)
            assert 0 <= minor[0] <= major[0] < np.inf and dr.norm(direction)[0] == pytest.approx(1, abs=1e-5)
            if i < 4:
                assert (found == 0).all()
    # On edge: long along what recedes, and no NaN
    on_edge = footprint.axes(*footprint.footprint(hit(mi, dp_du=mi.Vector3f(0, 0, 1)), looking_along_z(mi)))
    assert on_edge[0][0] == LARGEST or on_edge[0][0] > 1e3


def test_axes_are_those_of_the_singular_values(mi, rng):
    n = 2000
    matrix = rng.normal(size=(n, 2, 2)) * 10.0 ** rng.uniform(-3, 3, (n, 1, 1)) * 10.0 ** rng.uniform(-2, 2, (n, 2, 1))
    matrix = matrix.astype(np.float32)
    matrix[0], matrix[1], matrix[2] = 0, np.eye(2), [[0, 2], [0, 0]]
    ddx, ddy = (mi.Vector2f(np.ascontiguousarray(matrix[:, :, i].T)) for i in (0, 1))
    major, minor, direction = (np.array(v) for v in footprint.axes(ddx, ddy))
    left, values, _ = np.linalg.svd(matrix.astype(np.float64))
    np.testing.assert_allclose(major, values[:, 0], rtol=1e-5)
    np.testing.assert_allclose(minor, values[:, 1], rtol=1e-3, atol=1e-6 * values[:, 0].max())
    clear = values[:, 0] > 1.1 * values[:, 1]
    np.testing.assert_allclose(np.abs((direction.T * left[:, :, 0]).sum(1))[clear], 1, atol=1e-4)
    np.testing.assert_allclose(np.array(footprint.area(ddx, ddy)), np.abs(np.linalg.det(matrix)), rtol=1e-3, atol=1e-6)

    rows = [[2.0, 1.0, 7.0], [-0.5, 3.0, 8.0], [0.0, 0.0, 1.0]]
    found = footprint.transform(ddx, ddy, rows)
    expected = np.array(rows)[:2, :2] @ matrix
    for i in (0, 1):
        np.testing.assert_allclose(np.array(found[i]).T, expected[:, :, i], rtol=1e-4, atol=1e-4)

    # One blurred by another: covariances add
    other = np.roll(matrix, 7, axis=0)
    s, t = (mi.Vector2f(np.ascontiguousarray(other[:, :, i].T)) for i in (0, 1))
    both = np.stack([np.array(v).T for v in footprint.add_moments(ddx, ddy, s, t)], axis=-1).astype(np.float64)
    sums = sum(m @ m.transpose(0, 2, 1) for m in (matrix.astype(np.float64), other.astype(np.float64)))
    scale = np.trace(sums, axis1=1, axis2=2)[:, None, None] + 1e-30
    np.testing.assert_allclose(both @ both.transpose(0, 2, 1) / scale, sums / scale, atol=1e-4)


def test_parameters_say_the_same_as_the_sensor(mi):
    place = fp.look_at([1, 2, 3], [0, 0.5, 0])
    sensor = mi.load_dict(fp.sensor(to_world=place, fov=70))
    expected = Cone.from_sensor(sensor, 16)
    found = looking_along_z(mi, sensor_to_world=place, fov=70.0, resolution=fp.WIDTH, spp=16)
    for name in ("origin", "axis", "dx", "dy", "scale", "spread", "lens"):
        a, b = np.array(getattr(found, name)), np.array(getattr(expected, name))
        np.testing.assert_allclose(a, b, atol=2e-5, err_msg=name)
    assert found.projection == expected.projection == "perspective"
    assert [footprint.sample_scale(n) for n in (0, 1, 4, 64, 4096)] == [1, 1, 0.5, 0.125, 0.125]

    assert Cone.from_properties(mi.Properties()) is None
    scaled = mi.ScalarTransform4f().scale(2)
    for given, message in (
        ({"fov": None}, 'parameter "fov": not given, it is needed beside "sensor_to_world"'),
        ({"fov": 180.0}, 'parameter "fov": found 180, allowed is more than 0, below 180'),
        ({"resolution": 0}, 'parameter "resolution": found 0'),
        ({"spp": -1}, 'parameter "spp": found -1'),
        ({"fov": "wide"}, 'parameter "fov": found wide, a number is needed'),
        ({"sensor_to_world": scaled}, 'parameter "sensor_to_world": found a scale'),
        ({"sensor_to_world": 3.0}, 'parameter "sensor_to_world": found a scale, or no transformation'),
    ):
        with pytest.raises(RuntimeError, match=message):
            looking_along_z(mi, **given)


def test_sensors_without_pixels_of_a_known_size(mi):
    a, b = fp.sensor(to_world=fp.look_at([1, 2, 3], [0, 0, 0])), fp.sensor(to_world=fp.look_at([3, 2, 1], [0, 0, 0]))
    one = {"film": {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}}
    for sensor in ({"type": "distant", **one}, {"type": "radiancemeter", **one}, {"type": "batch", "a": a, "b": b}):
        with pytest.raises(RuntimeError, match="has no pixels whose footprint is known, supported are perspective"):
            Cone.from_sensor(mi.load_dict({**sensor, "id": "odd"}))


SCENE = """
<scene version="3.0.0">
    <default name="fov" value="60"/>
    <sensor type="perspective">
        <float name="fov" value="$fov"/>
        <sampler type="independent"><integer name="sample_count" value="16"/></sampler>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere">
        <transform name="to_world"><translate z="3"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"><texture type="probe" name="reflectance"/></bsdf></bsdf>
    </shape>
</scene>
"""


def test_scenes_tell_their_textures(mi, tmp_path):
    fp.register_probe()
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    probe = footprint.textures(mi.load_file(str(path)))[0]
    assert probe.cone is None
    for scene, fov in (
        (mi_diffind.load_file(path), 60), (mi_diffind.load_file(path, fov=30), 30), (loading.load(path), 60)
    ):  # fmt: skip
        cone = footprint.textures(scene)[0].cone
        assert cone.scale[0] == 0.25 and cone.spread[0] == pytest.approx(2 * np.tan(np.radians(fov) / 2) / 8, rel=1e-4)
    assert footprint.attach(scene, scene.sensors()[0], spp=1) == 1
    assert footprint.textures(scene)[0].cone.scale[0] == 1
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    odd = mi.load_dict({"type": "radiancemeter", "film": film})
    assert footprint.attach(scene, odd) == 1 and footprint.textures(scene)[0].cone is None
    assert footprint.attach(mi.load_dict({"type": "scene"})) == 0


def test_another_sensor_compiles_nothing_anew(mi):
    fp.register_probe()
    shape, _, _ = scene_of(mi, "sphere")
    shape["emitter"] = {"type": "area", "radiance": {"type": "probe"}}
    sensors = [fp.sensor(to_world=fp.look_at([x, 1, 3], [0, 0, 0]), fov=fov) for x, fov in ((0, 40), (1, 70))]
    scene = mi.load_dict({"type": "scene", "shape": shape, "a": sensors[0], "b": sensors[1]})

    def hashes(i, spp):
        footprint.attach(scene, i, spp)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            np.array(mi.render(scene, sensor=0, spp=4, integrator=mi.load_dict({"type": "direct"})))
            return {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}

    assert hashes(0, 1) == hashes(1, 9) != set()
