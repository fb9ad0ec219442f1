"""The texture ``mipmap``: filters against NumPy and many samples, texels, sensors; see ``test_texture_contract``."""

import numpy as np
import pytest
import texture_scenes
from arrays import aligned, numpy_of
from texture_scenes import linear

from mi_diffind.core.compat import backend_module
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.plugins.support import footprint, image_files
from mi_diffind.scenes import loading

SIZE = WIDTH, HEIGHT = 24, 16


@pytest.fixture(scope="module")
def image():
    """Noise and a wave, bytes."""
    rng = np.random.default_rng(1)
    x = np.mgrid[0:HEIGHT, 0:WIDTH][1] / WIDTH
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * np.stack([x, 2 * x, 3 * x], axis=-1))
    return np.rint(255 * (0.5 * wave + 0.5 * rng.random((HEIGHT, WIDTH, 3)))).astype(np.uint8)


@pytest.fixture(scope="module")
def file(tmp_path_factory, image):
    import mitsuba as mi

    path = tmp_path_factory.mktemp("mipmap") / "wall.png"
    mi.Bitmap(image).write(str(path))
    return str(path)


def plugin(file, name="trilinear", **more):
    return {"type": "mipmap", "filename": file, "filter": name, **more}


def pyramid(mi, image, border="repeat", color_space="srgb"):
    source = from_arrays({"image": image}, {"image": color_space})
    return Pyramid.from_source(source, types=backend_module(mi.TensorXf), border=(border, border))


def expected(mi, truth, uv, level):
    """Linear values of the truth."""
    u, v, level = (mi.Float(aligned(x)) for x in (*uv, level))
    return linear(numpy_of(truth.filtered(u, v, level)).T)


@pytest.mark.parametrize("taps", [1, 7])
def test_anisotropic_is_the_mean_along_the_major_axis(mi, file, image, rng, taps):
    """The axis is that of singular values: ``taps`` places, half a level finer than each is wide."""
    uv, (ddx, ddy) = rng.random((2, 300)), texture_scenes.footprints(rng, 300, SIZE)
    major, minor, axis = texture_scenes.ellipse(ddx, ddy, SIZE)
    level = np.log2(np.maximum(np.maximum(minor, major / taps) / np.sqrt(2), 1))
    places = [(k + 0.5) / taps - 0.5 for k in range(taps)]
    truth = np.mean([expected(mi, pyramid(mi, image), uv + x * axis, level) for x in places], axis=0)
    found = mi.load_dict(plugin(file, "anisotropic", max_anisotropy=taps)).eval(texture_scenes.hits(mi, uv, ddx, ddy))
    np.testing.assert_allclose(found.numpy(), truth, atol=3e-3)  # single precision where both axes are alike


@pytest.mark.parametrize("taps", [1, 4])
def test_stochastic_is_unbiased(mi, file, rng, taps):
    """Many hits of one place and footprint have the mean of all taps and both levels, in linear values."""
    n, cases = 2**14, 6
    uv, (ddx, ddy) = rng.random((2, cases)), texture_scenes.footprints(rng, cases, SIZE, 3)
    one, all_ = (mi.load_dict(plugin(file, x, max_anisotropy=taps)) for x in ("stochastic", "anisotropic"))
    repeated = [np.repeat(x, n, axis=1) for x in (uv, ddx, ddy)]
    found = one.eval(texture_scenes.hits(mi, *repeated, rng.normal(size=(3, n * cases)))).numpy().reshape(3, cases, n)
    truth = all_.eval(texture_scenes.hits(mi, uv, ddx, ddy)).numpy()
    error = found.std(axis=-1) / np.sqrt(n)
    assert (np.abs(found.mean(axis=-1) - truth) < 4.5 * error + 2e-5).all()
    assert error.max() > 1e-4


def changed(mi, texture, values):
    """Set ``data`` from an array; return the parameters."""
    params = mi.traverse(texture)
    params["data"] = mi.TensorXf(np.array(values, np.float32))
    params.update()
    return params


@pytest.mark.parametrize("role", ["srgb", "linear", "normal"])
def test_changed_texels_are_those_of_a_new_texture(mi, rng, role):
    """All levels follow, also of odd sizes; ``data`` are the values of ``bitmap``."""
    shape = (10, 7, 3)
    old, new = rng.random((2, *shape)).astype(np.float32)
    if role == "normal":
        old, new = (0.5 + 0.5 * v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (old - 0.5, new - 0.5))
    space = "srgb" if role == "srgb" else "linear"
    si = texture_scenes.hits(mi, rng.random((2, 300)), *texture_scenes.footprints(rng, 300, shape[1::-1], 4))
    textures = []
    for values in (old, new):
        source = from_arrays({role: values}, {role: space})
        assert source.maps[0].role == role or role != "normal"
        image_files.PYRAMIDS["texels"] = Pyramid.from_source(
            source, types=backend_module(mi.TensorXf), border=("repeat",) * 2
        )
        textures.append(mi.load_dict({"type": "mipmap", "pyramid": "texels", "raw": role != "srgb"}))
    del image_files.PYRAMIDS["texels"]
    texture, truth = textures
    data, precision = mi.traverse(truth)["data"].numpy(), 3e-3 if role == "normal" else 2e-5
    np.testing.assert_allclose(data, linear(new) if role == "srgb" else new, atol=precision)
    assert np.abs(texture.eval(si).numpy() - truth.eval(si).numpy()).max() > 0.1
    changed(mi, texture, data)
    np.testing.assert_allclose(texture.eval(si).numpy(), truth.eval(si).numpy(), atol=precision)
    assert float(texture.mean()[0]) == pytest.approx(float(truth.mean()[0]), abs=1e-4)
    assert texture.max() == pytest.approx(truth.max(), abs=1e-4)


def test_texels_of_other_textures_stay(mi, file, rng):
    """Reading ``data`` changes nothing; changing it changes one texture, of another size and with colours, too."""
    si = texture_scenes.hits(mi, rng.random((2, 100)), *texture_scenes.footprints(rng, 100, SIZE))
    grey = {"type": "mipmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), 128, np.uint8))}
    one, other, constant = mi.load_dict(plugin(file)), mi.load_dict(plugin(file)), mi.load_dict(grey)
    before = one.eval(si).numpy()
    params = mi.traverse(one)
    assert params.flags("data") == mi.ParamFlags.Differentiable and one.image is other.image
    params.update()
    np.testing.assert_array_equal(one.eval(si).numpy(), before)
    values = rng.random((6, 5, 3))
    for texture in (one, constant):
        changed(mi, texture, values)
        assert list(texture.resolution()) == [5, 6] and texture.is_spatially_varying()
        assert texture.max() == pytest.approx(values.max())
    np.testing.assert_array_equal(one.eval(si).numpy(), constant.eval(si).numpy())
    np.testing.assert_array_equal(other.eval(si).numpy(), before)
    assert np.abs(one.eval(si).numpy() - before).max() > 0.1


def test_slope_of_a_filtered_texture(mi, rng):
    """``eval_1_grad`` is the slope of a ramp at any level, through ``to_uv``; of the whole image it is 0."""
    x, y = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(32) + 0.5) / 32)
    bitmap = mi.Bitmap((0.3 * x + 0.5 * y)[..., None].astype(np.float32))
    uv = rng.uniform(0.4, 0.6, (2, 100))
    for name in ("trilinear", "anisotropic"):
        texture = mi.load_dict({"type": "mipmap", "bitmap": bitmap, "raw": True, "filter": name})
        for scale in (0, 1, 3):
            si = texture_scenes.hits(mi, uv, (2**scale / 64, 0), (0, 2**scale / 32))
            found = texture.eval_1_grad(si).numpy()
            np.testing.assert_allclose(found, np.broadcast_to([[0.3], [0.5]], found.shape), atol=1e-3)
        assert np.abs(texture.eval_1_grad(texture_scenes.hits(mi, uv, (50, 0), (0, 50))).numpy()).max() < 1e-6
    turned = {"to_uv": mi.ScalarTransform4f().rotate([0, 0, 1], 90).scale([2, 1, 1])}
    texture = mi.load_dict({"type": "mipmap", "bitmap": bitmap, "raw": True, "wrap_mode": "mirror", **turned})
    found = texture.eval_1_grad(texture_scenes.hits(mi, [[0.25], [-0.5]])).numpy()  # at (0.5, 0.5)
    np.testing.assert_allclose(found.ravel(), [2 * 0.5, -0.3], atol=1e-3)


@pytest.mark.parametrize("raw", [False, True])
@pytest.mark.parametrize("name", ["x_normal", "x_nor_dx", "x_Roughness", "x_arm"])
def test_names_of_images_change_no_values(mi, tmp_path, rng, name, raw):
    """A single image is what ``bitmap`` shows, whatever its name; a manifest is read by names."""
    path = str(tmp_path / f"{name}.png")
    image = rng.integers(0, 255, (8, 8, 1 if name == "x_Roughness" else 3), np.uint8)
    mi.Bitmap(image.repeat(3, 2) if image.shape[2] == 1 else image).write(path)
    given = {"filename": path, "raw": raw}
    si = texture_scenes.hits(mi, rng.random((2, 200)))
    ours = mi.load_dict({"type": "mipmap", "filter": "off", **given}).eval(si).numpy()
    theirs = mi.load_dict({"type": "bitmap", **given}).eval(si).numpy()
    np.testing.assert_allclose(np.broadcast_to(ours, theirs.shape), theirs, atol=1e-3)


def SENSOR(mi, spp=1, size=48):
    """The parameters of a texture for the sensor of :func:`texture_scenes.plane`."""
    to_world = mi.ScalarTransform4f().look_at([0, -2.5, 0.5], [0, 0, 0], [0, 0, 1])
    return {"sensor_to_world": to_world, "fov": 60.0, "resolution": size, "spp": spp}


@pytest.fixture(scope="module")
def detailed():
    """A texture with detail at every level."""
    rng = np.random.default_rng(3)
    total = sum(np.kron(rng.random((2**i, 2**i, 3)), np.ones((256 >> i, 256 >> i, 1))) for i in range(2, 9))
    return np.rint(255 * total / total.max()).astype(np.uint8)


def test_one_sample_a_pixel_on_a_plane(mi, detailed):
    """Filters are in order of PSNR against many samples; parameters say what the scene's sensor does."""
    more = {"bitmap": mi.Bitmap(detailed), "to_uv": mi.ScalarTransform4f().scale([2, 2, 1])}
    truth = mi.render(texture_scenes.plane(mi, {"type": "bitmap", **more}, 256, "multijitter")).numpy()
    found = {}
    for name in ("bitmap", "off", "trilinear", "anisotropic", "stochastic"):
        texture = {"type": "bitmap", **more} if name == "bitmap" else {"type": "mipmap", "filter": name, **more}
        loaded = texture_scenes.plane(mi, texture)
        footprint.attach(loaded)
        found[name] = mi.render(loaded).numpy()
        if name in ("trilinear", "anisotropic"):
            given = mi.render(texture_scenes.plane(mi, {**texture, **SENSOR(mi)})).numpy()
            np.testing.assert_allclose(given, found[name], atol=2e-3)
    quality = {name: texture_scenes.psnr(x, truth) for name, x in found.items()}
    assert quality["off"] == pytest.approx(quality["bitmap"], abs=0.05)
    assert quality["bitmap"] + 0.5 < quality["stochastic"] < quality["trilinear"] - 1, quality
    assert quality["bitmap"] + 5 < quality["trilinear"] < quality["anisotropic"] - 3, quality


def test_sources(mi, tmp_path, image, rng):
    """A manifest's maps, an image with alpha, an object, named levels; data are averaged as they are."""
    mi.Bitmap(image).write(str(tmp_path / "a.png"))
    (tmp_path / "wall.json").write_text('{"albedo": "a.png", "roughness": {"file": "a.png", "channels": "g"}}')
    alpha = np.concatenate([image, image[..., :1]], axis=-1)
    mi.Bitmap(alpha, mi.Bitmap.PixelFormat.RGBA).write(str(tmp_path / "alpha.png"))
    image_files.PYRAMIDS["wall"] = pyramid(mi, image)
    uv, (ddx, ddy) = rng.random((2, 200)), texture_scenes.footprints(rng, 200, SIZE)
    si = texture_scenes.hits(mi, uv, ddx, ddy)
    try:
        same = [
            {"filename": str(tmp_path / "a.png")}, {"bitmap": mi.Bitmap(image)}, {"pyramid": "wall"},
            {"filename": str(tmp_path / "wall.json")}, {"filename": str(tmp_path / "alpha.png")},
        ]  # fmt: skip
        found = [mi.load_dict({"type": "mipmap", **x}).eval(si).numpy() for x in same]
    finally:
        del image_files.PYRAMIDS["wall"]
    for x in found[1:]:
        np.testing.assert_allclose(x, found[0], atol=1e-5)
    level = texture_scenes.isotropic(ddx, ddy, SIZE)
    u, v, level = (mi.Float(aligned(x)) for x in (*uv, level))
    (truth,) = pyramid(mi, image[..., 1:2], color_space="linear").filtered(u, v, level)
    rough = {"filename": str(tmp_path / "wall.json"), "channels": "roughness"}
    np.testing.assert_allclose(mi.load_dict({"type": "mipmap", **rough}).eval_1(si), truth, atol=1e-5)
    grey = {"bitmap": mi.Bitmap(np.ascontiguousarray(image[..., 1])), "raw": True}
    np.testing.assert_allclose(mi.load_dict({"type": "mipmap", **grey}).eval_1(si), truth, atol=1e-5)


def test_report(mi, file):
    found = mi.load_dict(plugin(file, "anisotropic", max_anisotropy=3)).report()
    assert (found["filter"], found["taps"], found["footprint"]) == ("anisotropic", 3, ["uv partials"])
    assert found["effects_left_out"]["sensor"].startswith("is not known")
    seen = mi.load_dict(plugin(file, **SENSOR(mi)))
    assert seen.report()["footprint"] == ["uv partials", "parameters"]
    seen.set_cone(mi.load_dict(plugin(file, **SENSOR(mi, spp=4))).cone)
    assert seen.report()["footprint"] == ["uv partials", "sensor"]
    seen.set_cone(None)
    assert seen.report()["footprint"] == ["uv partials", "parameters"]
    off = mi.load_dict(plugin(file, "off", **SENSOR(mi))).report()
    assert off["footprint"] == [] and off["effects_left_out"]["footprint"] == "the filter is off"
    text = str(mi.load_dict(plugin(file, "stochastic", max_anisotropy=8, **SENSOR(mi))))
    assert "MipMap[" in text and "filter = stochastic, at most 8 taps, a perspective sensor" in text
    assert loading.learned_instances(texture_scenes.plane(mi, plugin(file))) == []


def test_words_of_bitmap(mi, file):
    for word, name in (("bilinear", "off"), ("trilinear", "trilinear"), ("anisotropic", "anisotropic")):
        for more in ({}, {"filter": name}):
            assert mi.load_dict({"type": "mipmap", "filename": file, "filter_type": word, **more}).filter.name == name


@pytest.mark.parametrize("wrong, sentence", [
    ({}, "found none, exactly one is needed"),
    ({"filename": "a.png", "pyramid": "b"}, 'found "filename" and "pyramid", exactly one is needed'),
    ({"pyramid": "x"}, 'parameter "pyramid": found "x", allowed are the keys of PYRAMIDS: none'),
    ({"filter_type": "nearest"}, 'parameter "filter_type": found "nearest", allowed are bilinear, trilinear'),
])  # fmt: skip
def test_bad_parameters(mi, wrong, sentence):
    assert sentence in texture_scenes.refused(mi, {"type": "mipmap", **wrong})
