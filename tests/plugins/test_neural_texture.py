"""
The texture ``neural_texture`` inside Mitsuba: against its arrays, read at footprints that NumPy made something of, and
against ``mipmap`` with the levels that it decodes to. (What all textures that filter themselves share:
``test_mipmap_plugin.py``; all textures of compressed maps: ``test_image_plugin.py``.)
"""

import json
import math
import re

import drjit as dr
import numpy as np
import pytest
import texture_scenes
from arrays import aligned, numpy_of
from texture_files import make
from texture_scenes import WRONG, linear

from mi_diffind.arrays.tables import load_table, save_table
from mi_diffind.core.compat import module_of
from mi_diffind.maps.layout import Layout
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays, load_source
from mi_diffind.measure.clock import bsdf_operations, count
from mi_diffind.scenes import loading
from mi_diffind.tasks.texture import TASK
from mi_diffind.tasks.texture.compressed import CompressedTexture, to_table

SIZE = WIDTH, HEIGHT = 32, 16

FILTERS = ("off", "trilinear", "anisotropic", "stochastic")


def material(seed=2):
    """Smooth maps of every kind."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] / [[[HEIGHT]], [[WIDTH]]]
    wave = 0.5 + 0.35 * np.sin(2 * np.pi * np.stack([x + k * y for k in range(4)], axis=-1) + np.arange(4))
    normal = np.stack([0.5 + 0.3 * (wave[..., 0] - 0.5), 0.5 + 0.3 * (wave[..., 1] - 0.5)], axis=-1)
    z = 0.5 + 0.5 * np.sqrt(1 - ((2 * normal - 1) ** 2).sum(axis=-1, keepdims=True))
    maps = {"albedo": wave[..., :3], "normal": np.concatenate([normal, z], axis=-1), "roughness": wave[..., 3:]}
    return {name: np.rint(255 * v).astype(np.uint8) for name, v in maps.items()}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("textures")
    source = from_arrays(material())
    found = {preset: make(folder / f"{preset}.npz", source, preset) for preset in ("ours", "paper")}
    return {**found, "clamp": make(folder / "clamp.npz", source, border="clamp")}


@pytest.fixture(scope="module")
def file(files):
    return files["ours"]


def plugin(file, name="trilinear", channels="albedo", **more):
    return {"type": "neural_texture", "filename": file, "channels": channels, "filter": name, **more}


def opened(mi, file, storage=""):
    return TASK.model(TASK.load(file), mi.TensorXf, storage).image


def floats(mi, *arrays):
    return [mi.Float(aligned(x)) for x in arrays]


def expected(mi, image, name, uv, level):
    """The channels of a map in its own color space."""
    u, v, level = floats(mi, *uv, level)
    return numpy_of(map(mi.Float, image.maps(image.filtered(u, v, level), [name])[name])).T


# -- what is read ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["x_diff", "x_normal", "x_disp", "x_arm"])
def test_counterparts_of_images_with_names(mi_rgb, tmp_path, rng, name):
    """Both counterparts show a single image as its file is read: linear if its name is that of data."""
    mi, path = mi_rgb, tmp_path / f"{name}.png"
    image = material()["normal" if name == "x_normal" else "albedo"][..., : 1 if name == "x_disp" else 3]
    mi.Bitmap(np.ascontiguousarray(image)).write(str(path))
    texture = plugin(make(tmp_path / "a.npz", load_source(path)), "off", "image", source=str(path))
    bsdf = {"type": "diffuse", "reflectance": texture}
    parsed, uv = (
        loading.ParsedScene({"type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf}}),
        rng.random((2, 500)),
    )
    values = []
    for against in ("exact", "mipmap"):
        (shape,) = parsed.load(exact=True, against=against, needs=()).shapes()
        values.append(shape.bsdf().eval_diffuse_reflectance(texture_scenes.hits(mi, uv)).numpy())
    np.testing.assert_allclose(*values, atol=5e-3)  # "mipmap" derives z of a normal from x and y
    expected = linear(image / 255) if name == "x_diff" else image / 255
    assert values[0].mean() == pytest.approx(expected.mean(), abs=0.02)


@pytest.mark.parametrize("channels", ["albedo", "normal", "roughness"])
@pytest.mark.parametrize("preset", ["ours", "paper"])
def test_the_maximum_is_an_upper_bound(mi_rgb, files, rng, preset, channels):
    """At any place, between texels, too, and at any level of detail; of 1 at most."""
    mi = mi_rgb
    uv, (ddx, ddy) = rng.random((2, 200_000)), texture_scenes.footprints(rng, 200_000, SIZE)
    for name in ("off", "trilinear"):
        texture = mi.load_dict(plugin(files[preset], name, channels))
        values = texture.eval(texture_scenes.hits(mi, uv, ddx, ddy)).numpy()
        assert values.max() <= texture.max() + 1e-6 and texture.max() <= 1


@pytest.mark.parametrize("preset", ["ours", "paper"])
def test_off_is_level_0_and_costs_no_footprint(mi_rgb, files, rng, preset):
    """The arrays of coarser levels and of the footprint are not read."""
    mi = mi_rgb
    uv, (ddx, ddy) = rng.random((2, 200)), texture_scenes.footprints(rng, 200, SIZE)
    image, textures = opened(mi, files[preset]), {n: mi.load_dict(plugin(files[preset], n)) for n in FILTERS}
    stored = image.stored(*floats(mi, *uv))
    truth = linear(numpy_of(image.maps(stored, ["albedo"])["albedo"]).T)
    si, magnified = texture_scenes.hits(mi, uv, ddx, ddy), texture_scenes.hits(mi, uv)
    np.testing.assert_allclose(textures["off"].eval(si).numpy(), truth, atol=1e-4)
    found = {n: textures[n].eval(magnified) for n in ("trilinear", "anisotropic", "stochastic")}
    dr.eval(found)
    for value in found.values():  # and all are that where nothing is minified
        np.testing.assert_allclose(value.numpy(), truth, atol=3e-3 if preset == "paper" else 3e-4)
    reads = {name: count(lambda t=t: t.eval(si)) for name, t in textures.items()}
    u, v = floats(mi, *uv)
    dr.make_opaque(u, v)
    needed = image.layout.needed("albedo")
    assert reads["off"].gathers == count(lambda: [image.stored(u, v)[i] for i in needed]).gathers
    if preset == "paper":  # the footprint's array is one more, of one dimension
        assert reads["trilinear"].gathers == reads["off"].gathers + 1
        assert reads["anisotropic"].gathers == 4 * reads["off"].gathers + 1
    assert reads["off"].gathers < reads["trilinear"].gathers == reads["stochastic"].gathers
    assert 3 * reads["trilinear"].gathers < reads["anisotropic"].gathers <= 4 * reads["trilinear"].gathers
    assert reads["off"].instructions < reads["trilinear"].instructions - 100


@pytest.mark.parametrize("preset, name", [("ours", "albedo"), ("ours", "normal"), ("paper", "roughness")])
def test_trilinear_is_the_level_of_the_area(mi_any, files, rng, preset, name):
    mi = mi_any
    uv, (ddx, ddy) = rng.random((2, 300)), texture_scenes.footprints(rng, 300, SIZE)
    truth = expected(mi, opened(mi, files[preset]), name, uv, texture_scenes.isotropic(ddx, ddy, SIZE))
    si = texture_scenes.hits(mi, uv, ddx, ddy)
    more = {"raw": True} if mi.is_spectral and name == "albedo" else {}
    texture = mi.load_dict(plugin(files[preset], channels=name, **more))
    found = texture.eval_1(si).numpy()[None] if name == "roughness" else texture.eval_3(si).numpy()
    truth = linear(truth) if name == "albedo" and not more else truth
    np.testing.assert_allclose(found, truth, atol=2e-3 if preset == "paper" else 5e-4)
    if more:
        spectra = mi.load_dict(plugin(files[preset], channels=name)).eval(si).numpy()
        assert np.isfinite(spectra).all() and spectra.min() >= 0 and spectra.max() <= 1


@pytest.mark.parametrize("name", ["trilinear", "anisotropic"])
def test_a_level_bias_reads_as_a_smaller_footprint(mi_rgb, files, tmp_path, rng, name):
    """One level finer: a footprint of half the side, in colours, gradients, and images that are not repeated."""
    mi = mi_rgb
    biased = make(tmp_path / "biased.npz", from_arrays(material()), level_bias=-1.0)
    uv, (ddx, ddy) = rng.random((2, 200)), (8 * x for x in texture_scenes.footprints(rng, 200, SIZE))
    si = texture_scenes.hits(mi, uv, ddx, ddy)
    for more in ({}, {"wrap_mode": "clamp"}):
        texture, plain = (mi.load_dict(plugin(f, name, "roughness", **more)) for f in (biased, files["ours"]))
        if name == "anisotropic":  # the taps stay where they are
            plain._filtered = lambda uv, level, read=plain._filtered: read(uv, level - 1)
            smaller = si
        else:
            smaller = texture_scenes.hits(mi, uv, ddx / 2, ddy / 2)
        found, expected = texture.eval_1(si).numpy(), plain.eval_1(smaller).numpy()
        np.testing.assert_allclose(found, expected, atol=1e-5)
        assert np.abs(found - plain.eval_1(texture_scenes.hits(mi, uv, 2 * ddx, 2 * ddy)).numpy()).max() > 0.01
        if name == "trilinear":
            slopes = texture.eval_1_grad(si).numpy(), plain.eval_1_grad(smaller).numpy()
            np.testing.assert_allclose(*slopes, atol=1e-3)


@pytest.mark.parametrize("border, wrap_mode", [("ours", "clamp"), ("clamp", "repeat")])
def test_equals_a_mipmap_of_what_it_decodes_to(mi_rgb, files, rng, border, wrap_mode):
    """At the texel centres of each level, with texels for footprints, of neighbouring images, too."""
    mi = mi_rgb
    from mi_diffind.plugins.support import image_files

    image = opened(mi, files[border])
    layout, along = image.layout, ("repeat" if wrap_mode == "repeat" else "clamp",) * 2
    levels = []
    for level in range(image.levels):
        rows, columns = image.level_size(level)
        y, x = np.mgrid[0:rows, 0:columns]
        u, v, at = floats(mi, (x.ravel() + 0.5) / columns, (y.ravel() + 0.5) / rows, np.full(x.size, level))
        levels.append(numpy_of(image.filtered(u, v, at)).reshape(rows, columns, -1))
    image_files.PYRAMIDS["decoded"] = Pyramid(layout, levels, module_of(mi.TensorXf), along)
    try:
        ours = mi.load_dict(plugin(files[border], wrap_mode=wrap_mode))
        theirs = mi.load_dict({"type": "mipmap", "pyramid": "decoded", "channels": "albedo", "wrap_mode": wrap_mode})
        for level in range(image.levels - 1):  # the last: a texel is higher than the image
            rows, columns = image.level_size(level)
            uv = [(rng.integers(-2 * n, 3 * n, 100) + 0.5) / n for n in (columns, rows)]
            si = texture_scenes.hits(mi, uv, (2**level / WIDTH, 0), (0, 2**level / HEIGHT))
            a, b = numpy_of(t.eval_1(si) for t in (ours, theirs)).T
            np.testing.assert_allclose(a, b, atol=5e-4, err_msg=f"level {level}")
    finally:
        del image_files.PYRAMIDS["decoded"]


def test_clamped_images_know_nothing_of_the_other_end(mi_rgb, tmp_path):
    """Although the arrays go round: at any level, nothing is read beyond the centre of its outermost texels."""
    mi = mi_rgb
    halves = np.zeros((16, 16, 1), np.uint8)
    halves[:, 8:] = 255
    path = make(tmp_path / "a.npz", from_arrays({"roughness": halves}))
    for mode, ends in (("clamp", [0, 0, 1, 1]), ("mirror", [0, 0, 1, 1]), ("repeat", [0.5] * 4)):
        texture = mi.load_dict(plugin(path, channels="roughness", wrap_mode=mode))
        for level in (0, 0.5, 1, 1.7, 2):
            size = 2**level / 16
            si = texture_scenes.hits(mi, [[0, 1e-4, 1, 0.9999], [0.3] * 4], (size, 0), (0, size))
            np.testing.assert_allclose(texture.eval_1(si).numpy(), ends, atol=0.02, err_msg=f"{mode} {level}")


@pytest.mark.parametrize("name", ["albedo", "normal", "roughness"])
def test_stochastic_is_unbiased(mi_rgb, file, rng, name):
    """Over many hits of one place and footprint, of colours and data."""
    mi = mi_rgb
    n, cases = 2**13, 4
    uv, (ddx, ddy) = rng.random((2, cases)), texture_scenes.footprints(rng, cases, SIZE, 3)
    one, all_ = (mi.load_dict(plugin(file, x, name)) for x in ("stochastic", "anisotropic"))
    repeated = [np.repeat(x, n, axis=1) for x in (uv, ddx, ddy)]
    found = one.eval(texture_scenes.hits(mi, *repeated, rng.normal(size=(3, n * cases)))).numpy().reshape(3, cases, n)
    truth = np.broadcast_to(all_.eval(texture_scenes.hits(mi, uv, ddx, ddy)).numpy(), (3, cases))
    error = found.std(axis=-1) / np.sqrt(n)
    # Of a normal, the third component of the mean is not the mean of those
    assert (np.abs(found.mean(axis=-1) - truth) < 4.5 * error + 1e-4)[: 2 if name == "normal" else 3].all()
    assert error.max() > 1e-4


# -- hard cases --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["ours", "paper"])
def test_any_footprint_gives_a_finite_value(mi_rgb, files, rng, preset):
    mi = mi_rgb
    parts = np.stack(np.meshgrid(*[WRONG] * 4)).reshape(4, -1)
    uv = rng.choice([0, 1, 0.3, -7.5, 1e20, math.nan, math.inf], (2, parts.shape[1]))
    si = texture_scenes.hits(mi, uv, parts[:2], parts[2:])
    for name, wrap_mode in (("trilinear", "repeat"), ("anisotropic", "clamp"), ("stochastic", "mirror")):
        texture = mi.load_dict(plugin(files[preset], name, wrap_mode=wrap_mode))
        found, slope = texture.eval(si), texture.eval_1_grad(si)
        dr.eval(found, slope)
        found = found.numpy()
        assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1 + 1e-4, name
        assert np.isfinite(slope.numpy()).all(), name


@pytest.mark.parametrize("shape", [(1, 16), (7, 5)])
def test_odd_sizes(mi_rgb, tmp_path, rng, shape):
    mi = mi_rgb
    values = rng.integers(0, 256, (*shape, 3), np.uint8)
    path = make(tmp_path / "a.npz", from_arrays({"albedo": values}))
    si = texture_scenes.hits(mi, rng.uniform(-1, 2, (2, 100)), *texture_scenes.footprints(rng, 100, shape[::-1], 6))
    for name in ("off", "anisotropic"):
        texture = mi.load_dict(plugin(path, name))
        assert list(texture.resolution()) == list(shape[::-1])
        assert np.isfinite(texture.eval(si).numpy()).all() and np.isfinite(texture.eval_1_grad(si).numpy()).all()
    largest = texture.eval(texture_scenes.hits(mi, [[0.3], [0.6]], (100, 0), (0, 100))).numpy().ravel()
    np.testing.assert_allclose(largest, linear(values / 255).mean(axis=(0, 1)), atol=0.03)


def test_no_arrays(mi_rgb, tmp_path):
    """A texture of one colour is a few numbers, and has no footprint."""
    mi = mi_rgb
    source = from_arrays({"albedo": np.full((4, 8, 3), 128, np.uint8)})
    layout = Layout.of(source, filtered=True)
    save_table(tmp_path / "a.npz", to_table(CompressedTexture(layout, None), {}))
    for name in FILTERS:
        texture = mi.load_dict(plugin(str(tmp_path / "a.npz"), name))
        si = texture_scenes.hits(mi, [[0.3], [0.6]], (0.1, 0), (0, 0.1))
        np.testing.assert_allclose(texture.eval(si).numpy().ravel(), linear(128 / 255), atol=1e-4)
        assert texture.report()["footprint"] == [] and not texture.is_spatially_varying()


# -- optimisation ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", ["ours", "paper"])
def test_gradients_against_finite_differences(mi_rgb, files, rng, preset):
    """With respect to every array and to uv, at footprints of every size."""
    mi = mi_rgb
    texture = mi.load_dict(plugin(files[preset], storage="float32"))
    params = mi.traverse(texture)
    names = ("level0", "coarse", "cascaded") if preset == "ours" else ("primary0", "primary1", "cascaded")
    keys = [f"tables.{name}" for name in names]
    assert sorted(params.keys()) == sorted([*keys, "to_uv"])
    uv, (ddx, ddy) = rng.random((2, 64)), texture_scenes.footprints(rng, 64, SIZE, 4)
    si = texture_scenes.hits(mi, uv, ddx, ddy)
    weights = mi.Float(aligned(rng.normal(size=64)))

    def total():
        return dr.sum(weights * texture.eval_1(si))

    for key in keys:
        start = params[key].numpy() * 0.98 + 0.01  # away from the ends, where entries are folded
        params[key] = mi.TensorXf(aligned(start))
        params.update()
        dr.enable_grad(params[key])
        dr.backward(total())
        gradient = dr.grad(params[key]).numpy().ravel()
        dr.disable_grad(params[key])
        assert np.isfinite(gradient).all()
        strongest = np.argsort(-np.abs(gradient))[:3]
        for i in strongest:
            values = []
            for sign in (-1, 1):
                moved = start.copy()
                moved.ravel()[i] += sign * 1e-3
                params[key] = mi.TensorXf(aligned(moved))
                params.update()
                values.append(float(total()[0]))
            largest = float(np.abs(gradient).max())
            assert gradient[i] == pytest.approx((values[1] - values[0]) / 2e-3, rel=0.05, abs=0.03 * largest), key
        params[key] = mi.TensorXf(aligned(start))
        params.update()
    dr.enable_grad(si.uv)
    dr.backward(dr.sum(texture.eval_1(si)))
    gradient = dr.grad(si.uv).numpy()
    assert np.isfinite(gradient).all()
    for axis in (0, 1):
        step = 2e-4 * np.eye(2)[:, axis : axis + 1]
        a, b = (texture.eval_1(texture_scenes.hits(mi, uv + s * step, ddx, ddy)).numpy() for s in (1, -1))
        error = np.abs((a - b) / 4e-4 - gradient[axis])
        assert np.median(error) < 0.03 * np.abs(gradient[axis]).max()


def test_gradients_of_wrong_footprints_are_finite(mi_rgb, file):
    mi = mi_rgb
    parts = np.stack(np.meshgrid(*[(0, 1, 1e20, math.nan, math.inf, -math.inf)] * 4)).reshape(4, -1)
    si = texture_scenes.hits(mi, [[0.3], [0.7]], parts[:2], parts[2:])
    texture = mi.load_dict(plugin(file, "anisotropic", storage="float32", max_anisotropy=1))
    params = mi.traverse(texture)
    keys = [key for key in params.keys() if key.startswith("tables.")]
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    dr.enable_grad(si.uv)
    dr.backward(dr.sum(texture.eval_1(si)))
    assert all(np.isfinite(dr.grad(params[key]).numpy()).all() for key in keys)
    assert np.isfinite(dr.grad(si.uv).numpy()).all()
    dr.disable_grad(*(params[key] for key in keys))


def test_parameters_are_shared_and_checked(mi_rgb, file, rng):
    """What changes one texture of a file changes the other, and what had been found out about it."""
    mi = mi_rgb
    a, b = (mi.load_dict(plugin(file, channels=name, storage="float32")) for name in ("albedo", "roughness"))
    si = texture_scenes.hits(mi, rng.random((2, 10)), (0.1, 0), (0, 0.1))
    before, mean, largest = b.eval_1(si).numpy(), float(b.mean()[0]), b.max()
    params = mi.traverse(a)
    params["tables.cascaded"] = params["tables.cascaded"] * 0.5
    params.update()
    np.testing.assert_allclose(b.eval_1(si).numpy(), before / 2, atol=1e-4)
    assert float(b.mean()[0]) == pytest.approx(mean / 2, abs=1e-3) and b.max() < 0.6 * largest
    fresh = mi.load_dict(plugin(file, channels="roughness", storage="float32"))
    np.testing.assert_array_equal(fresh.eval_1(si).numpy(), before)
    params["tables.cascaded"] = mi.TensorXf(aligned(np.zeros((2, 2, 7), "f4")))
    with pytest.raises(RuntimeError, match=re.escape('parameter "tables.cascaded": "data" has the shape (2, 2, 7)')):
        params.update()
    assert list(mi.traverse(mi.load_dict(plugin(file))).keys()) == ["to_uv"]


# -- in scenes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["off", "anisotropic"])
def test_maps_of_one_file_are_read_once(mi_rgb, file, name):
    """In one material, seen by a sensor: all of its maps at one place of one level, of one footprint.

    Only the words of a further map's channels are read in addition.
    """
    mi = mi_rgb
    from mi_diffind.plugins.support import footprint

    found = []
    for bsdf in (
        {"type": "diffuse", "reflectance": plugin(file, name)},
        {"type": "principled", "base_color": plugin(file, name), "roughness": plugin(file, name, "roughness")},
        {"type": "neural_disney", "base_color": plugin(file, name), "roughness": plugin(file, name, "roughness")},
    ):
        shape = {"type": "rectangle", "bsdf": bsdf}
        loaded = texture_scenes.plane(mi, None, shape=shape)
        footprint.attach(loaded)
        found.append(bsdf_operations(loaded.shapes()[0].bsdf(), ("eval",))["eval"].gathers)
    other = {"base_color": {"type": "checkerboard"}, "roughness": {"type": "checkerboard"}}  # which gathers nothing
    tables = bsdf_operations(mi.load_dict({"type": "neural_disney", **other}), ("eval",))["eval"].gathers
    assert found[0] <= found[1] == found[2] - tables < 2 * found[0]


def test_one_sample_a_pixel_on_a_plane(mi_rgb, tmp_path):
    """Against many of its own level 0: anisotropic before trilinear before neither."""
    mi = mi_rgb
    from mi_diffind.plugins.support import footprint

    rng = np.random.default_rng(3)
    total = sum(np.kron(rng.random((2**i, 2**i, 3)), np.ones((64 >> i, 64 >> i, 1))) for i in range(2, 7))
    path = make(tmp_path / "a.npz", from_arrays({"albedo": np.rint(255 * total / total.max()).astype(np.uint8)}))
    more = {"to_uv": mi.ScalarTransform4f().scale([8, 8, 1])}
    truth = mi.render(texture_scenes.plane(mi, plugin(path, "off", **more), 256, "multijitter", 32)).numpy()
    quality = {}
    for name in ("off", "trilinear", "anisotropic"):
        loaded = texture_scenes.plane(mi, plugin(path, name, **more), size=32)
        assert footprint.attach(loaded) == 1
        quality[name] = texture_scenes.psnr(mi.render(loaded).numpy(), truth)
    assert quality["off"] + 4 < quality["trilinear"] < quality["anisotropic"] - 2, quality


def test_materials_and_integrators(mi_rgb, file):
    """Filtered parameters of stock and of learned materials: as bright as with level 0 at many samples."""
    mi = mi_rgb
    to_uv = {"to_uv": mi.ScalarTransform4f().scale([9, 9, 1])}

    def textures(name):
        return {m: plugin(file, name, m, **to_uv) for m in ("albedo", "normal", "roughness")}

    images = []
    for name, integrator in (("off", "path"), ("trilinear", "path_footprint")):
        t = textures(name)
        bsdfs = [
            {"type": "normalmap", "normalmap": t["normal"], "bsdf": {"type": "diffuse", "reflectance": t["albedo"]}},
            {"type": "neural_disney", "base_color": t["albedo"], "roughness": t["roughness"]},
        ]
        walls = {
            f"wall{i}": {"type": "rectangle", "bsdf": {"type": "twosided", "bsdf": bsdf},
                         "to_world": mi.ScalarTransform4f().translate([2 * i - 1, 0, 0])}
            for i, bsdf in enumerate(bsdfs)
        }  # fmt: skip
        film = {"type": "hdrfilm", "width": 16, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
        loaded = mi.load_dict({
            "type": "scene", "integrator": {"type": integrator, "max_depth": 2}, "sky": {"type": "constant"},
            "sensor": {"type": "perspective", "to_world": to_world, "film": film}, **walls,
        })  # fmt: skip
        from mi_diffind.plugins.support import footprint

        footprint.attach(loaded, spp=1)
        images.append(mi.render(loaded, spp=32).numpy())
    assert all(np.isfinite(image).all() for image in images) and images[0].mean() > 0.1
    for image in images[1:]:
        assert image.mean() == pytest.approx(images[0].mean(), rel=0.05)


def test_frozen_renders(mi_rgb, file, no_garbage_collection):
    mi = mi_rgb
    from mi_diffind.plugins.support import footprint

    texture = plugin(file, storage="float32", to_uv=mi.ScalarTransform4f().scale(8))
    loaded = texture_scenes.plane(mi, texture, size=16, integrator={"type": "path", "max_depth": 1})
    footprint.attach(loaded)
    frozen = dr.freeze(lambda loaded, seed: mi.render(loaded, spp=1, seed=seed))
    for seed in range(5):
        image = frozen(loaded, mi.UInt32(seed)).numpy()
        np.testing.assert_allclose(image, mi.render(loaded, spp=1, seed=seed).numpy(), atol=1e-5)


def test_textures_die_with_their_scene(mi_rgb, file, no_garbage_collection):
    mi = mi_rgb
    from mi_diffind.plugins.support import footprint

    before = texture_scenes.alive("NeuralTexture")
    loaded = texture_scenes.plane(mi, plugin(file), size=8)
    footprint.attach(loaded)
    mi.render(loaded, spp=1)
    assert texture_scenes.alive("NeuralTexture") == before + 1
    del loaded
    assert texture_scenes.alive("NeuralTexture") == before


def test_unsupported_variants_and_leaks(file):
    """A sentence in a scalar variant; nothing is left of a texture that was rendered and optimised."""
    texture_scenes.check_process(plugin(file, storage="float32"), ("llvm_ad_rgb",))


# -- counterparts and words --------------------------------------------------------------------------------------------

LAMP = """<shape type="rectangle"><emitter type="area"><texture name="radiance" type="neural_texture">
        <string name="filename" value="wall.npz"/><string name="channels" value="MAP"/>MORE
        <transform name="to_uv"><scale x="3" y="3"/></transform>
    </texture></emitter></shape>"""


def test_counterparts(mi_rgb, tmp_path):
    """The image or the manifest that it was made from, unfiltered or filtered; parameters of filters are left out."""
    mi = mi_rgb
    from mi_diffind.plugins.support import footprint

    maps = material()
    mi.Bitmap(maps["albedo"]).write(str(tmp_path / "albedo.png"))
    mi.Bitmap(maps["roughness"]).write(str(tmp_path / "roughness.png"))
    (tmp_path / "wall.json").write_text(json.dumps({"albedo": "albedo.png", "roughness": "roughness.png"}))
    sensor = (
        '<transform name="sensor_to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>'
        '<float name="fov" value="40"/><integer name="resolution" value="8"/>'
    )
    for name, source, more in (
        ("albedo", "wall.json", '<string name="filter_type" value="trilinear"/>'),
        ("roughness", "wall.json", '<string name="filter" value="anisotropic"/>' + sensor),
        ("albedo", "albedo.png", '<integer name="max_anisotropy" value="2"/>'),
    ):
        maps_of = {"albedo": maps["albedo"]} if source.endswith("png") else {
            k: v for k, v in maps.items() if k != "normal"
        }  # fmt: skip
        make(tmp_path / "wall.npz", from_arrays(maps_of), source_path=source)
        scene = texture_scenes.scene_xml(LAMP.replace("MAP", name).replace("MORE", more), size=8, depth=1)
        (tmp_path / "scene.xml").write_text(scene)
        bitmap = {"type": "bitmap", "filename": str(tmp_path / f"{name}.png"), "raw": name == "roughness"}
        image = {**bitmap, "to_uv": mi.ScalarTransform4f().scale([3, 3, 1])}
        exact = loading.load(tmp_path / "scene.xml", exact=True)
        stock = texture_scenes.plane(mi, image, shape=None, size=8)
        si = texture_scenes.hits(mi, np.random.default_rng(1).random((2, 50)), (0.05, 0), (0, 0.05))
        a, b = (s.emitters()[0] for s in (exact, stock))
        np.testing.assert_allclose(a.eval(si).numpy(), b.eval(si).numpy(), atol=1e-6)
        levels = loading.load(tmp_path / "scene.xml", exact=True, against="mipmap")
        (found,) = footprint.textures(levels)
        assert type(found).__name__ == "MipMap" and found.map.name in (name, "image")
        ours = loading.load(tmp_path / "scene.xml")
        np.testing.assert_allclose(
            ours.emitters()[0].eval(si).numpy(), levels.emitters()[0].eval(si).numpy(), atol=0.03
        )
        (report,) = loading.reports(ours)
        assert (
            report["plugin"] == "neural_texture" and report["table_bytes"] == load_table(tmp_path / "wall.npz").nbytes
        )
        assert report["footprint"] == ["uv partials", "sensor"] and report["map"] == name


def test_report_and_description(mi_rgb, file):
    mi = mi_rgb
    found = mi.load_dict(plugin(file, "anisotropic", "normal")).report()
    assert (found["filter"], found["taps"], found["footprint"]) == ("anisotropic", 4, ["uv partials"])
    assert found["map"] == "normal" and found["storage"] == "uint8" and found["table_bytes"] > 0
    assert found["effects_left_out"]["sensor"].startswith("is not known")
    off = mi.load_dict(plugin(file, "off")).report()
    assert off["footprint"] == [] and off["effects_left_out"]["footprint"] == "the filter is off"
    text = str(mi.load_dict(plugin(file)))
    for part in ("NeuralTexture[", "map = albedo of albedo, normal, roughness", f"{WIDTH} x {HEIGHT}", "filter = tri"):
        assert part in text


BAD = {
    "no file name": ({"filename": ""}, 'parameter "filename": not given'),
    "missing file": ({"filename": "/nowhere/a.npz"}, "/nowhere/a.npz: no such file"),
    "unknown map": ({"channels": "depth"}, 'parameter "channels": found "depth", the file holds albedo, normal, roug'),
    "storage": ({"storage": "float16"}, 'parameter "storage": found "float16", allowed are uint8, float32'),
    "filter": ({"filter": "cubic"}, 'parameter "filter": found "cubic", allowed are trilinear, off, anisotropic, stoc'),
    "contradiction": ({"filter_type": "bilinear"}, 'found "bilinear", which contradicts the filter "trilinear"'),
    "taps": ({"max_anisotropy": 0}, 'parameter "max_anisotropy": found 0, allowed are whole numbers 1 to 16'),
    "unknown": ({"level": 3}, "level"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_bad_parameters(mi_rgb, file, case):
    wrong, sentence = BAD[case]
    assert sentence in texture_scenes.refused(mi_rgb, {**plugin(file), **wrong})
