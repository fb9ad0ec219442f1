"""Properties that every texture of maps has, over the registry; the maps of ``neural_material`` are read as textures.

The truth is ``bitmap`` with the image that a file decodes to, and NumPy. Plugin test files keep what only they do.
"""

import itertools
import math
import os
import re

import drjit as dr
import numpy as np
import pytest
import trust_properties as trust
from arrays import aligned, numpy_of
from texture_files import make, make_image, material, write_manifest
from texture_scenes import WRONG, ellipse, footprints, hits, isotropic, linear, plane, refused
from variants import VARIANTS, set_variant, warnings_of

from mi_diffind import plugins
from mi_diffind.arrays.tables import load_table, save_table
from mi_diffind.fitting.task import find_task, load_model
from mi_diffind.maps import pyramid
from mi_diffind.maps.layout import Layout
from mi_diffind.maps.source import from_arrays
from mi_diffind.measure.clock import bsdf_operations, count
from mi_diffind.plugins.support import footprint
from mi_diffind.tasks.ggx import TASK as GGX
from mi_diffind.tasks.image import arrays as image_arrays
from mi_diffind.tasks.texture import compressed

SIZE = WIDTH, HEIGHT = 12, 10
TEXTURES = ("mipmap", "neural_image", "neural_texture")
READERS = (*TEXTURES, "neural_material")
FILTERED = ("mipmap", "neural_texture", "neural_material")
WRAP_MODES = ("repeat", "mirror", "clamp")
FILTERS = ("trilinear", "anisotropic", "stochastic")


def readings(first: str, *others: str) -> list[tuple[str, str]]:
    """Readers with each of these filters; ``neural_image``, which has none, with the first."""
    return [(name, filter_) for name in READERS for filter_ in (first, *(others if name in FILTERED else ()))]


#: Name of a map → parameter of ``neural_material``.
PARAMETERS = {"albedo": "base_color", "normal": "normal", "roughness": "roughness"}

#: Reads of bytes may be 1/64 of a step off; half precision of a third component that is derived.
ROUNDING = 5e-4

#: Texture → class and function that make a table without arrays.
EMPTY = {
    "neural_image": (image_arrays.CompressedImage, image_arrays.to_table),
    "neural_texture": (compressed.CompressedTexture, compressed.to_table),
}

#: Each colour mode once.
RENDERED = [v for v in VARIANTS if v.endswith(("ad_rgb", "ad_mono", "ad_spectral_polarized"))]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return the file that each plugin reads; those with ``_clamp`` have arrays that do not repeat."""
    folder, source = tmp_path_factory.mktemp("contract"), from_arrays(material(*SIZE))
    written = {"mipmap": str(write_manifest(folder, material(*SIZE)))}
    for border in ("repeat", "clamp"):
        end = "" if border == "repeat" else "_clamp"
        written[f"neural_image{end}"] = make_image(folder / f"image{end}.npz", source, border)
        written[f"neural_texture{end}"] = make(folder / f"texture{end}.npz", source, border=border)
        written[f"neural_material{end}"] = written[f"neural_texture{end}"]
    written["neural_texture_paper"] = make(folder / "paper.npz", source, "paper")
    return written


def plugin(files, name, channels="albedo", **more):
    """Return the description of a plugin that shows a map; ``neural_material`` shows all."""
    more = {"filter": "off", **more} if name in FILTERED else more
    more = more if name == "neural_material" else {"channels": channels, **more}
    return {"type": name, "filename": files[name], **more}


def decoded(mi, files, name, **level):
    """Return the images that a file decodes to, by map."""
    if name == "mipmap":
        return {name: values.astype(np.float32) / 255 for name, values in material(*SIZE).items()}
    table = load_table(files[name])
    return find_task(table).model(table, mi.TensorXf).image.decode(**level)


def bitmap(mi, files, name, channels="albedo", **more):
    image = mi.Bitmap(np.ascontiguousarray(decoded(mi, files, name)[channels]))
    image.set_srgb_gamma(channels == "albedo")
    return {"type": "bitmap", "bitmap": image, "format": "variant", "raw": channels != "albedo", **more}


def reader(mi, files, name, channels="albedo", **more):
    """Return a function of hits that returns the channels of a map, ``(channels, n)``, linear."""
    loaded = mi.load_dict(plugin(files, name, channels, **more))

    def read(si):
        if name == "neural_material":
            return list(loaded.maps.read(si)[PARAMETERS[channels]])
        return [loaded.eval_1(si)] if channels == "roughness" else list(loaded.eval_3(si))

    return read, loaded


def values(read, si):
    channels = read(si)
    dr.eval(channels)
    return np.stack([np.broadcast_to(c.numpy(), dr.width(si.uv)) for c in channels])


def centres(rng, n, tiles=0):
    """Return texel centres, of ``tiles`` images to either side, too."""
    return np.stack([(rng.integers(-tiles * size, (tiles + 1) * size, n) + 0.5) / size for size in SIZE])


def test_the_contract_has_every_texture(mi):
    registered = {name for name, p in plugins.declared().items() if p.object_type == "texture"}
    assert registered == set(TEXTURES)


# ---------------------- Values ----------------------


@pytest.mark.parametrize("channels", PARAMETERS)
@pytest.mark.parametrize("name", READERS)
def test_reads_as_decoded(mi, files, rng, name, channels):
    """Values at texel centres by every method, size, mean and largest value are those of ``bitmap``."""
    si = hits(mi, centres(rng, 300))
    read, ours = reader(mi, files, name, channels)
    theirs = mi.load_dict(bitmap(mi, files, name, channels))
    truth = theirs.eval(si).numpy()
    found = values(read, si)
    close = {"atol": 3e-3 if (name, channels) == ("mipmap", "normal") else ROUNDING}  # z follows from rounded x and y
    np.testing.assert_allclose(found, truth[: len(found)], **close)
    if name == "neural_material":
        return
    np.testing.assert_allclose(np.broadcast_to(ours.eval(si).numpy(), truth.shape), truth, **close)
    np.testing.assert_allclose(ours.eval_1(si).numpy(), theirs.eval_1(si).numpy(), **close)
    assert list(ours.resolution()) == list(SIZE) and ours.is_spatially_varying()
    assert float(ours.mean()[0]) == pytest.approx(float(theirs.mean()[0]), abs=ROUNDING)
    image = decoded(mi, files, name)[channels]
    assert ours.max() >= (linear(image) if channels == "albedo" else image).max() - 1e-3


@pytest.mark.parametrize("name", READERS[1:3])
def test_images_are_decoded_in_parts(mi, files, monkeypatch, name):
    whole = decoded(mi, files, name)
    monkeypatch.setattr(pyramid, "CHUNK", 37)
    for m, image in decoded(mi, files, name).items():
        np.testing.assert_array_equal(image, whole[m])


@pytest.mark.parametrize("name", TEXTURES)
def test_inactive_lanes_are_zero(mi, files, rng, name):
    """Pointers and levels of theirs are no numbers; all others read as without a mask."""
    active = rng.random(64) < 0.5
    image = mi.load_dict(plugin(files, name)).image
    u, v, level = (mi.Float(aligned(np.where(active, x, np.nan))) for x in rng.random((3, 64)))
    for read in (image.stored, lambda u, v, a=True: image.filtered(u, v, 2 * level, a))[: 1 + (name in FILTERED)]:
        masked, plain = (np.stack([c.numpy() for c in read(u, v, a)]) for a in (mi.Bool(active), True))
        np.testing.assert_array_equal(masked, np.where(active, plain, 0))


@pytest.mark.parametrize("name", [*TEXTURES, "neural_texture_paper"])
def test_no_value_is_above_the_maximum(mi, files, rng, name):
    """The maximum bounds values at any place and level of detail, also of random arrays, and is at most 1."""
    kind = name.removesuffix("_paper")
    for channels in PARAMETERS:
        more = {"filter": "trilinear"} if kind in FILTERED else {}
        read, loaded = reader(mi, {kind: files[name]}, kind, channels, **more)
        found = values(read, hits(mi, rng.uniform(-1, 2, (2, 4000)), *footprints(rng, 4000, SIZE)))
        assert found.max() <= loaded.max() + 1e-5 and loaded.max() <= 1 + 1e-6, channels


@pytest.mark.parametrize("wrap_mode", WRAP_MODES)
@pytest.mark.parametrize("name, border", [*((name, "") for name in READERS), *((n, "_clamp") for n in READERS[1:])])
def test_wrap_modes(mi, files, rng, name, border, wrap_mode):
    """Texel centres of neighbouring images, both ends, and places beyond the outermost centres, as ``bitmap``; of
    ``mipmap``, any place."""
    more = {"wrap_mode": wrap_mode}
    files = {name: files[name + border]}
    u, v = (rng.random(50) * 0.5 / n for n in SIZE)
    places = np.concatenate([centres(rng, 300, tiles=3), [1 - u, v], [u, 1 - v], [0 * u, v], [0 * u + 1, v]], axis=1)
    if name == "mipmap":
        places = np.concatenate([places, rng.uniform(-2, 3, (2, 500))], axis=1)
    si = hits(mi, places)
    found = values(reader(mi, files, name, **more)[0], si)
    truth = mi.load_dict(bitmap(mi, files, name, **more)).eval(si).numpy()
    # A seam may be blended in another encoding
    exact = slice(300) if wrap_mode == "repeat" and name != "mipmap" else slice(None)
    np.testing.assert_allclose(found[:, exact], truth[:, exact], atol=2 * ROUNDING)
    if not border:
        np.testing.assert_allclose(found, truth, atol=0.05)


@pytest.mark.parametrize("name, filtering", readings("off", "trilinear", "anisotropic"))
def test_to_uv(mi, files, rng, name, filtering):
    """A texture with a transformation is the one without it at places and footprints that went through it."""
    more = {"filter": filtering} if name in FILTERED else {}
    to_uv = mi.ScalarTransform4f().translate([0.3, -0.2, 0]).rotate([0, 0, 1], 30).scale([1.5, -0.4, 1])
    m = np.array([[float(to_uv.matrix[i, j]) for j in (0, 1, 3)] for i in (0, 1)])
    uv, (ddx, ddy) = rng.random((2, 200)), footprints(rng, 200, SIZE, 3)
    found = values(reader(mi, files, name, to_uv=to_uv, **more)[0], hits(mi, uv, ddx, ddy))
    read, loaded = reader(mi, files, name, **more)
    inside = hits(mi, m[:, :2] @ uv + m[:, 2:], m[:, :2] @ ddx, m[:, :2] @ ddy)
    np.testing.assert_allclose(found, values(read, inside), atol=2e-3)
    if name != "neural_material":
        turned = mi.load_dict(plugin(files, name, to_uv=to_uv, **more)).eval_1_grad(hits(mi, uv, ddx, ddy)).numpy()
        slope = m[:, :2].T @ loaded.eval_1_grad(inside).numpy()
        assert np.quantile(np.abs(turned - slope), 0.95) < 0.02 * np.abs(slope).max()
    params = mi.traverse(loaded)
    key = next(k for k in params.keys() if k.endswith("to_uv"))
    params[key] = mi.ScalarTransform3f([[*map(float, row)] for row in [*m, [0, 0, 1]]])
    params.update()
    np.testing.assert_allclose(values(read, hits(mi, uv, ddx, ddy)), found, atol=1e-5)


@pytest.mark.parametrize("name", READERS[1:])
def test_storage_forms_agree(mi, files, rng, name):
    si = hits(mi, rng.random((2, 500)))
    found, truth = (values(reader(mi, files, name, storage=s)[0], si) for s in ("float32", "uint8"))
    np.testing.assert_allclose(found, truth, rtol=1e-3, atol=ROUNDING)


# ---------------------- Footprints and hard cases ----------------------


@pytest.mark.parametrize("filtering", FILTERS)
@pytest.mark.parametrize("name", FILTERED)
def test_zero_and_huge_footprints(mi, files, rng, name, filtering):
    """Without a footprint level 0 is read, with the largest one the mean; ``off`` ignores footprints."""
    uv = rng.uniform(-2, 2, (2, 100))
    off, read = (reader(mi, files, name, filter=f)[0] for f in ("off", filtering))
    huge = hits(mi, uv, (1000, 0), (0, 1000))
    np.testing.assert_allclose(values(read, hits(mi, uv)), values(off, hits(mi, uv)), atol=ROUNDING)
    np.testing.assert_array_equal(values(off, huge), values(off, hits(mi, uv)))
    if name == "mipmap":
        mean = linear(material(*SIZE)["albedo"] / 255).mean(axis=(0, 1))
    else:
        mean = linear(decoded(mi, files, name, level=3)["albedo"])[0, 0]
        half = linear(decoded(mi, files, name, level=1)["albedo"])
        y, x = np.mgrid[0 : HEIGHT // 2, 0 : WIDTH // 2].reshape(2, -1)
        at = hits(mi, [(x + 0.5) / (WIDTH // 2), (y + 0.5) / (HEIGHT // 2)], (2 / WIDTH, 0), (0, 2 / HEIGHT))
        if filtering == "trilinear":
            np.testing.assert_allclose(values(read, at), half.reshape(-1, 3).T, atol=2 * ROUNDING)
    np.testing.assert_allclose(values(read, huge), np.broadcast_to(mean[:, None], (3, 100)), atol=2 * ROUNDING)


@pytest.mark.parametrize("name", [*FILTERED, "neural_texture_paper"])
def test_trilinear_is_the_level_of_the_area(mi_any, files, rng, name):
    """The channels that the levels give there; in spectral variants, colours and spectra."""
    mi, files, name = mi_any, {name.removesuffix("_paper"): files[name]}, name.removesuffix("_paper")
    raw = {"raw": True} if mi.is_spectral and name != "neural_material" else {}
    read, loaded = reader(mi, files, name, filter="trilinear", **raw)
    uv, (ddx, ddy) = rng.random((2, 300)), footprints(rng, 300, SIZE, 2)
    place = [mi.Float(aligned(x)) for x in (*uv, isotropic(ddx, ddy, SIZE))]
    image = getattr(loaded, "maps", loaded).image
    truth = numpy_of(image.maps(image.filtered(*place), ["albedo"])["albedo"]).T
    found = values(read, hits(mi, uv, ddx, ddy))
    np.testing.assert_allclose(found, truth if raw else linear(truth), atol=2e-3)
    if raw:
        spectra = mi.load_dict(plugin(files, name, filter="trilinear")).eval(hits(mi, uv, ddx, ddy)).numpy()
        assert np.isfinite(spectra).all() and spectra.min() >= 0 and spectra.max() <= 1


@pytest.mark.parametrize("name", FILTERED[1:])
def test_level_bias_of_elongated_footprints(mi, files, tmp_path, rng, name):
    """A part of the bias counts: area over half of the squared axes, squared; all of it where a footprint is round."""
    table, path = load_table(files[name]), tmp_path / "biased.npz"
    table.settings["level_bias"] = -0.75
    save_table(path, table)
    (read, _), (_, plain) = (reader(mi, {name: str(file)}, name, filter="trilinear") for file in (path, files[name]))
    uv, (ddx, ddy) = rng.random((2, 300)), footprints(rng, 300, SIZE, 2)
    ddx[:, :30], ddy[:, :30] = [[2 / WIDTH], [0]], [[0], [2 / HEIGHT]]
    major, minor, _ = ellipse(ddx, ddy, SIZE)
    share = (2 * major * minor / (major**2 + minor**2)) ** 2
    assert share[:30].min() > 0.999 and share.min() < 0.1
    level = np.maximum(isotropic(ddx, ddy, SIZE) - 0.75 * share, 0)
    image = getattr(plain, "maps", plain).image
    place = [mi.Float(aligned(x)) for x in (*uv, level)]
    truth = linear(numpy_of(image.maps(image.filtered(*place), ["albedo"])["albedo"]).T)
    np.testing.assert_allclose(values(read, hits(mi, uv, ddx, ddy)), truth, atol=2e-3)


@pytest.mark.parametrize("filtering", FILTERS[:2])
@pytest.mark.parametrize("name", FILTERED)
def test_seams(mi, tmp_path, name, filtering):
    """A repeated image goes on with any footprint; a mirrored or clamped one knows nothing of its other end."""
    halves = np.zeros((16, 16, 3), np.uint8)
    halves[:, 8:] = 255
    files = {"mipmap": str(write_manifest(tmp_path, {"albedo": halves}))}
    if name != "mipmap":
        files[name] = make(tmp_path / "a.npz", from_arrays({"albedo": halves}))
    for mode, expected in (("clamp", [0, 0, 1, 1]), ("mirror", [0, 0, 1, 1]), ("repeat", [linear(0.5)] * 4)):
        read, _ = reader(mi, files, name, wrap_mode=mode, filter=filtering)
        for level in (0, 0.5, 1, 1.7, 2):
            size = 2**level / 16
            ends = values(read, hits(mi, [[0, 1e-4, 1, 0.9999], [0.3] * 4], (size, 0), (0, size)))[0]
            tolerance = 0.05 if mode != "repeat" else 0.3  # colours are averaged linearly, or as they are stored
            np.testing.assert_allclose(ends, expected, atol=tolerance, err_msg=f"{mode} {level}")


@pytest.mark.parametrize("name, filtering", readings(*FILTERS))
def test_any_place_and_footprint_gives_a_finite_value(mi, files, rng, name, filtering):
    wrap_mode = WRAP_MODES[FILTERS.index(filtering)]
    parts = np.stack(np.meshgrid(*[WRONG[::2]] * 4)).reshape(4, -1)
    uv = rng.choice([0, 1, 0.3, -7.5, 1e20, math.nan, math.inf, -math.inf], (2, parts.shape[1]))
    si = hits(mi, uv, parts[:2], parts[2:])
    more = {"filter": filtering} if name in FILTERED else {}
    for channels in PARAMETERS:
        read, loaded = reader(mi, files, name, channels, wrap_mode=wrap_mode, **more)
        found = values(read, si)
        assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1 + 1e-4, channels
        if name != "neural_material":
            assert np.isfinite(loaded.eval_1_grad(si).numpy()).all(), channels


@pytest.mark.parametrize("shape", [(1, 16), (7, 5), (2, 2)])
@pytest.mark.parametrize("name", READERS)
def test_odd_sizes(mi, tmp_path, rng, name, shape):
    """Values between those of the image, at any footprint; a flat channel stays flat."""
    image = rng.integers(0, 256, (*shape, 3), np.uint8)
    image[..., 1] = 77
    source = from_arrays({"albedo": image})
    files = {"mipmap": str(write_manifest(tmp_path, {"albedo": image}))}
    if name != "mipmap":
        files[name] = (make_image if name == "neural_image" else make)(tmp_path / "a.npz", source)
    si = hits(mi, rng.uniform(-1, 2, (2, 100)), *footprints(rng, 100, shape[::-1], 6))
    for filtering in ("off", "anisotropic") if name in FILTERED else ("off",):
        more = {"filter": filtering} if name in FILTERED else {}
        found = values(reader(mi, files, name, **more)[0], si)
        image_of = decoded(mi, files, name)["albedo"] if name != "mipmap" else image / np.float32(255)
        assert found.min() >= linear(image_of).min() - 0.06 and found.max() <= linear(image_of).max() + 0.06
        np.testing.assert_allclose(found[1], linear(77 / 255), rtol=1e-5)


@pytest.mark.parametrize("variant", RENDERED)
@pytest.mark.parametrize("name", TEXTURES[1:])
def test_no_arrays(variant, tmp_path, rng, monkeypatch, name):
    """A file of one colour is a few numbers, none of which can be optimised, and has no footprint."""
    mi, colour = set_variant(variant), np.uint8([128, 51, 179])
    warned, files = warnings_of(mi, monkeypatch), {name: str(tmp_path / "a.npz")}
    source = from_arrays({"albedo": np.full((4, 8, 3), colour)})
    maps, to_table = EMPTY[name]
    layout = Layout.from_source(source, filtered=name == "neural_texture")
    save_table(files[name], to_table(maps(layout, None), {}))
    np.testing.assert_allclose(decoded(mi, files, name)["albedo"][0, 0], colour / 255, atol=1e-6)
    si, theirs = hits(mi, rng.random((2, 30))), mi.load_dict(bitmap(mi, files, name))
    for storage, filtering in itertools.product(("uint8", "float32"), FILTERS if name in FILTERED else ("",)):
        ours = mi.load_dict(plugin(files, name, storage=storage, **({"filter": filtering} if filtering else {})))
        truth = theirs.eval(si).numpy()
        np.testing.assert_allclose(np.broadcast_to(ours.eval(si).numpy(), truth.shape), truth, atol=1e-4)
        assert not ours.is_spatially_varying() and ours.report().get("footprint", []) == []
        assert float(ours.mean()[0]) == pytest.approx(float(theirs.mean()[0]), abs=1e-5)
        assert (storage == "float32") == any(
            "has constants in place of the maps albedo, no arrays" in text for text in warned
        )


# ---------------------- Derivatives ----------------------


@pytest.mark.parametrize("name", ["neural_image", "neural_texture"])
def test_arrays_of_a_file_are_one_set_of_parameters(mi, files, rng, name):
    """They are those of the first texture that reads them; assigned values count for all textures of the file."""
    maps = {"base_color": "albedo", "roughness": "roughness"}
    nested = {p: plugin(files, name, channels, storage="float32") for p, channels in maps.items()}
    material = mi.load_dict({"type": "principled", **nested})
    params = mi.traverse(material)
    keys = [key for key in params.keys() if ".tables." in key]
    assert len({key.split(".")[0] for key in keys}) == 1
    assert sorted(key.split(".")[-1] for key in keys) == sorted(load_model(files[name], mi.TensorXf).arrays)
    si = hits(mi, rng.random((2, 20)))
    ctx, si.wi, wo = mi.BSDFContext(), mi.Vector3f(0.48, 0, 0.877), mi.Vector3f(0, 0.6, 0.8)
    cascaded = next(key for key in keys if key.endswith("cascaded"))
    params[cascaded] = 0 * params[cascaded] + 0.5
    params.update()
    half = {"base_color": {"type": "rgb", "value": 0.21404}, "roughness": 0.5}
    expected = mi.load_dict({"type": "principled", **half}).eval(ctx, si, wo).numpy()
    assert expected.min() > 0.01
    actual = material.eval(ctx, si, wo).numpy()
    np.testing.assert_allclose(actual, np.broadcast_to(expected, actual.shape), rtol=1e-3)


@pytest.mark.parametrize("name, filtering", readings("off", "trilinear"))
def test_gradients_reach_the_coordinate(mi, files, rng, name, filtering):
    """Gradients are finite differences, except between two texels; ``eval_1_grad`` is the gradient of the luminance."""
    more = {"filter": filtering} if name in FILTERED else {}
    uv, (ddx, ddy) = rng.random((2, 300)), footprints(rng, 300, SIZE, 2)
    read, loaded = reader(mi, files, name, "roughness", **more)
    si = hits(mi, uv, ddx, ddy)
    dr.enable_grad(si.uv)
    dr.backward(dr.sum(read(si)[0]))
    gradient = dr.grad(si.uv).numpy()
    assert np.isfinite(gradient).all()
    for axis in (0, 1):
        step = 4e-4 * np.eye(2)[:, axis : axis + 1]
        ahead, behind = (values(read, hits(mi, uv + s * step, ddx, ddy))[0] for s in (1, -1))
        error = np.abs((ahead - behind) / 8e-4 - gradient[axis])
        assert np.quantile(error, 0.7) < 0.03 * np.abs(gradient[axis]).max()
    if name in TEXTURES[::2] and filtering == "off":  # ``neural_image`` interpolates texels for its slope
        slope = loaded.eval_1_grad(hits(mi, uv)).numpy()
        assert np.quantile(np.abs(slope - gradient), 0.7) < 0.15 * np.abs(gradient).max()


@pytest.mark.parametrize("name", [*READERS, "neural_texture_paper"])
def test_gradients_of_tables_are_finite_differences(mi, files, rng, name):
    more = {} if name == "mipmap" else {"storage": "float32"}
    files, name = {name.removesuffix("_paper"): files[name]}, name.removesuffix("_paper")
    read, loaded = reader(mi, files, name, **({"filter": "trilinear"} if name in FILTERED else {}), **more)
    params = mi.traverse(loaded)
    keys = [k for k in params.keys() if "tables." in k or k == "data"]
    assert keys and all(params.flags(k) == mi.ParamFlags.Differentiable for k in keys)
    si = hits(mi, rng.random((2, 512)), *footprints(rng, 512, SIZE, 2))
    worst, names = trust.compared(lambda: sum(read(si)), params, keys, rng)
    assert worst <= 0.03 and names == keys


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 1e30])
@pytest.mark.parametrize("name", READERS[1:])
def test_wrong_tables_and_footprints_leave_finite_gradients(mi, files, rng, name, wrong):
    """Values stay finite and within the map's range, too."""
    parts = np.stack(np.meshgrid(*[(0, 1, 1e20, math.nan, -math.inf)] * 4)).reshape(4, -1)
    more = {"filter": "anisotropic", "max_anisotropy": 1} if name in FILTERED else {}
    read, loaded = reader(mi, files, name, storage="float32", **more)
    params = mi.traverse(loaded)
    keys = [k for k in params.keys() if "tables." in k]
    for key in keys:
        entries = params[key].numpy()
        params[key] = mi.TensorXf(aligned(np.where(rng.random(entries.shape) < 0.1, np.float32(wrong), entries)))
        dr.enable_grad(params[key])
    params.update()
    si = hits(mi, rng.random((2, parts.shape[1])), parts[:2], parts[2:])
    dr.enable_grad(si.uv)
    channels = read(si)
    dr.backward(dr.sum(sum(channels)))
    found = np.stack([dr.detach(c).numpy() for c in channels])
    assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 1 + 1e-4
    assert all(np.isfinite(dr.grad(params[key]).numpy()).all() for key in keys)
    assert np.isfinite(dr.grad(si.uv).numpy()).all()


@pytest.mark.parametrize("name", READERS)
def test_a_file_is_read_once(mi, files, name):
    """Textures and materials that name one file share its image."""
    one, two = (mi.load_dict(plugin(files, n, c)) for n, c in ((name, "albedo"), (name, "roughness")))
    others = [mi.load_dict(plugin(files, "neural_texture"))] if name == "neural_material" else []
    images = {id(getattr(t, "maps", t).image) for t in (one, two, *others)}
    assert len(images) == 1


@pytest.mark.parametrize("name", TEXTURES[1:])
def test_textures_of_one_file_share_their_parameters(mi, files, rng, name):
    """A change of one shows in the other, in its mean, maximum and positions; later ones start from the file."""
    si = hits(mi, rng.random((2, 10)))
    a, b = (mi.load_dict(plugin(files, name, channels, storage="float32")) for channels in ("albedo", "roughness"))
    before, mean, largest = b.eval_1(si).numpy(), float(b.mean()[0]), b.max()
    density = float(b.pdf_position(mi.Point2f(0.3, 0.4))[0])
    params = mi.traverse(a)
    entries = params["tables.cascaded"].numpy()
    ramp = np.linspace(0.2, 0.9, entries.shape[-2])[:, None]
    params["tables.cascaded"] = mi.TensorXf(aligned(entries * ramp))
    params.update()
    assert np.abs(b.eval_1(si).numpy() - before).max() > 1e-3
    assert float(b.mean()[0]) < 0.9 * mean and b.max() < largest
    assert float(b.pdf_position(mi.Point2f(0.3, 0.4))[0]) != density
    fresh = mi.load_dict(plugin(files, name, "roughness", storage="float32"))
    np.testing.assert_array_equal(fresh.eval_1(si).numpy(), before)
    params["tables.cascaded"] = mi.TensorXf(aligned(np.zeros((2, 2, 7), "f4")))
    with pytest.raises(RuntimeError, match=re.escape('parameter "tables.cascaded": "data" has the shape (2, 2, 7)')):
        params.update()


# ---------------------- Work ----------------------


@pytest.mark.parametrize("name", ["neural_texture", "neural_texture_paper"])
def test_off_costs_no_footprint(mi, files, rng, name):
    """The arrays of coarser levels and of the footprint are not read."""
    file, si = {"neural_texture": files[name]}, hits(mi, rng.random((2, 200)), *footprints(rng, 200, SIZE))
    textures = {f: mi.load_dict(plugin(file, "neural_texture", filter=f)) for f in ("off", *FILTERS)}
    reads = {f: count(lambda t=t: t.eval(si)) for f, t in textures.items()}
    image = textures["off"].image
    needed = image.layout.needed("albedo")
    assert reads["off"].gathers == count(lambda: [image.stored(*si.uv)[i] for i in needed]).gathers
    if name.endswith("paper"):  # the footprint's array is one more, of one dimension
        assert reads["trilinear"].gathers == reads["off"].gathers + 1
        assert reads["anisotropic"].gathers == 4 * reads["off"].gathers + 1
    assert reads["off"].gathers < reads["trilinear"].gathers == reads["stochastic"].gathers
    assert 3 * reads["trilinear"].gathers < reads["anisotropic"].gathers <= 4 * reads["trilinear"].gathers
    assert reads["off"].instructions < reads["trilinear"].instructions - 100


@pytest.mark.parametrize("filtering", ["off", "anisotropic"])
def test_maps_of_one_file_are_read_once(mi, files, filtering):
    """In one material, seen by a sensor: all of its maps at one place of one level, of one footprint.

    Only the words of a further map's channels are read in addition.
    """
    found = []
    albedo, roughness = (plugin(files, "neural_texture", m, filter=filtering) for m in ("albedo", "roughness"))
    for bsdf in (
        {"type": "diffuse", "reflectance": albedo},
        {"type": "principled", "base_color": albedo, "roughness": roughness},
        {"type": "neural_disney", "base_color": albedo, "roughness": roughness},
    ):
        loaded = plane(mi, None, shape={"type": "rectangle", "bsdf": bsdf})
        footprint.attach(loaded)
        found.append(bsdf_operations(loaded.shapes()[0].bsdf(), ("eval",))["eval"].gathers)
    other = {"base_color": {"type": "checkerboard"}, "roughness": {"type": "checkerboard"}}  # which gathers nothing
    tables = bsdf_operations(mi.load_dict({"type": "neural_disney", **other}), ("eval",))["eval"].gathers
    assert found[0] <= found[1] == found[2] - tables < 2 * found[0]


# ---------------------- Spectra and emitters ----------------------


@pytest.mark.parametrize("variant", RENDERED)
@pytest.mark.parametrize("name", TEXTURES)
def test_colours_in_every_mode(variant, files, rng, name):
    """``eval`` is a bitmap's at texel centres, with and without ``raw``; a texture refuses where a bitmap does."""
    mi = set_variant(variant)
    si = hits(mi, centres(rng, 200))
    for channels, raw in itertools.product(("albedo", "roughness"), (False, True)):
        more = {"raw": raw} if channels == "albedo" or raw else {}
        ours, theirs = (mi.load_dict(t(channels, **more)) for t in (
            lambda c, **m: plugin(files, name, c, **m),
            lambda c, **m: bitmap(mi, files, name, c, **m)))  # fmt: skip
        for method in ("eval", "eval_1", "eval_3"):
            results = []
            for texture in (ours, theirs):
                try:
                    results.append(getattr(texture, method)(si).numpy())
                except RuntimeError:
                    results.append(None)
            assert (results[0] is None) == (results[1] is None), (channels, raw, method)
            if results[1] is not None:
                found = np.broadcast_to(results[0], results[1].shape)
                np.testing.assert_allclose(found, results[1], atol=2e-3, err_msg=f"{channels} {raw} {method}")


@pytest.mark.parametrize("wrap_mode, turned", [("repeat", ""), ("mirror", "turn"), ("clamp", "flip"), ("clamp", "any")])
@pytest.mark.parametrize("name", TEXTURES)
def test_sampled_positions_have_their_density(mi, files, rng, name, wrap_mode, turned):
    n, bins, side = 50_000, 8, 80
    t = mi.ScalarTransform4f()
    to_uv = {
        "turn": t.translate([1, 0, 0]).rotate([0, 0, 1], 90), "flip": t.translate([1, 0, 0]).scale([-1, 1, 1]),
        "any": t.rotate([0, 0, 1], 30).scale(2),
    }.get(turned)  # fmt: skip
    texture = mi.load_dict(plugin(files, name, wrap_mode=wrap_mode, **({"to_uv": to_uv} if turned else {})))
    uv, pdf = texture.sample_position(mi.Point2f(*[mi.Float(aligned(x)) for x in rng.random((2, n))]))
    grid = (np.mgrid[0:side, 0:side].reshape(2, -1) + 0.5) / side
    grid = mi.Point2f(*[mi.Float(aligned(x)) for x in grid])
    density = np.broadcast_to(texture.pdf_position(grid).numpy(), side * side).reshape(bins, side // bins, bins, -1)
    assert density.mean() == pytest.approx(1, abs=5e-3) and density.min() > 0
    expected = density.mean(axis=(1, 3)) / bins**2 * n
    counts, _, _ = np.histogram2d(*uv.numpy(), bins=bins, range=[[0, 1]] * 2)
    assert counts.sum() == n and ((counts - expected) ** 2 / expected).sum() < bins**2 + 6 * bins
    if turned != "any":  # brightness is what the density follows
        np.testing.assert_allclose(pdf.numpy(), texture.pdf_position(uv).numpy(), rtol=1e-3)
        brightness = texture.eval_1(hits(mi, grid.numpy())).numpy()
        assert np.corrcoef(brightness, density.ravel())[0, 1] > 0.8
    bad = [math.nan, math.inf, -math.inf, -1, 0, 1, 1 + 1e-6, 2, 1e30, 1 - 2**-24]
    wrong = mi.Point2f(*(mi.Float(aligned(x.ravel())) for x in np.meshgrid(bad, bad)))
    uv, pdf = texture.sample_position(wrong)
    assert np.isfinite(np.broadcast_to(pdf.numpy(), 100)).all() and np.isfinite(texture.pdf_position(uv).numpy()).all()
    assert turned == "any" or (np.isfinite(uv.numpy()).all() and uv.numpy().min() >= 0 and uv.numpy().max() <= 1)


def lamp(mi, texture, **integrator):
    """Return a scene of a wall under a lamp that shines as a texture says."""
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return mi.load_dict({
        "type": "scene", "integrator": integrator or {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 35, "to_world": t.look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
                   "film": film},
        "wall": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
        "lamp": {"type": "rectangle", "to_world": t.translate([0, 1.2, 0.6]).rotate([1, 0, 0], 60).scale(0.6),
                 "emitter": {"type": "area", "radiance": texture}},
    })  # fmt: skip


@pytest.mark.parametrize(
    "name, variant", [*itertools.product(TEXTURES, RENDERED[:1]), *itertools.product(TEXTURES[1:2], RENDERED[1:])]
)
def test_emitters(variant, files, name):
    """Light that is sampled by position is the light that paths find by chance, and that of a bitmap."""
    mi, means = set_variant(variant), []
    texture = plugin(files, name, wrap_mode="clamp")
    for described, emitter, bsdf in ((texture, 1, 0), (texture, 0, 1), (bitmap(mi, files, name), 1, 0)):
        scene = lamp(mi, described, type="direct", emitter_samples=emitter, bsdf_samples=bsdf)
        means.append(mi.render(scene, spp=2**13).numpy().mean(dtype=np.float64))
    assert means[0] == pytest.approx(means[1], rel=0.03) and means[0] == pytest.approx(means[2], rel=0.03)


@pytest.mark.parametrize("variant", RENDERED)
def test_particle_tracer(variant, files):
    """A particle tracer asks for a wavelength and a ray from the emitter."""
    mi, texture = set_variant(variant), plugin(files, "neural_image")
    image = mi.render(lamp(mi, texture, type="ptracer", max_depth=3), spp=2**13).numpy()
    assert image.mean() == pytest.approx(mi.render(lamp(mi, texture), spp=2**10).numpy().mean(), rel=0.05)


# ---------------------- Reports and mistakes ----------------------


@pytest.mark.parametrize("name", TEXTURES)
def test_report_and_description(mi, files, name):
    texture = mi.load_dict(plugin(files, name, "normal"))
    report, text = texture.report(), str(texture)
    assert report["map"] == "normal" and report["table_bytes"] > 0 and "normal" in report["effects_in_use"]
    assert sorted(report["channels_read"] + report["channels_left_out"]) == list(range(texture.image.layout.stored))
    assert report["effects_left_out"]["albedo"] == "is another map of the file"
    for part in (f"{type(texture).__name__}[", "map = normal", f"{WIDTH} x {HEIGHT}", "raw = true"):
        assert part in text


BAD = {
    "no file name": ({"filename": ""}, 'parameter "filename": not given'),
    "a missing file": ({"filename": "/nowhere/a.npz"}, '"filename": /nowhere/a.npz: no such file'),
    "a folder": ({"filename": os.path.dirname(__file__)}, "is a folder"),
    "another task": ({"filename": str(GGX.file())}, 'parameter "filename": '),
    "an unknown map": ({"channels": "depth"}, 'parameter "channels": found "depth", the file holds albedo, normal'),
    "a wrap mode": ({"wrap_mode": "tile"}, 'parameter "wrap_mode": found "tile", allowed are repeat, mirror, clamp'),
    "a storage": ({"storage": "float16"}, 'parameter "storage": found "float16", allowed are uint8, float32'),
    "a filter": ({"filter": "cubic"}, 'parameter "filter": found "cubic", allowed are trilinear, off, anisotropic'),
    "contradicting filters": ({"filter": "off", "filter_type": "trilinear"}, "which contradicts the filter"),
    "too many taps": ({"max_anisotropy": 17}, 'parameter "max_anisotropy": found 17, allowed are whole numbers 1 to'),
    "half a sensor": ({"fov": 60.0}, 'parameter "sensor_to_world": not given'),
    "raw": ({"raw": 0.5}, 'parameter "raw": found 0.5, allowed are true and false'),
    "no transformation": ({"to_uv": 2.0}, 'parameter "to_uv": found 2'),
    "an unknown name": ({"chanel": "x"}, "chanel"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("name", TEXTURES)
def test_bad_parameters(mi, files, name, case):
    wrong, sentence = BAD[case]
    unknown = {"neural_image": ("filter", "max_anisotropy", "fov"), "mipmap": ("storage",)}.get(name, ())
    if next(iter(wrong)) in unknown:
        sentence = next(iter(wrong))
    if name == "mipmap" and case == "no file name":
        sentence = "exactly one is needed"
    assert sentence in refused(mi, {**plugin(files, name), **wrong})


# ---------------------- Values that single precision cannot carry through a path ----------------------

ALLOWED = "allowed in a scene are -1e+09 to 1e+09"


def constants(values, file, folder, name="albedo"):
    """Return a copy of a file with other settings of a map."""
    table = load_table(file)
    (entry,) = (m for m in table.settings["layout"]["maps"] if m["name"] == name)
    entry.update(values)
    entry["where"] = [entry["where"]] * 3 if entry["where"][0] == "constant" else entry["where"]
    save_table(folder / "changed.npz", table)
    return str(folder / "changed.npz")


@pytest.mark.parametrize("values, found", [
    ({"where": ["constant", 1e30], "color_space": "linear"}, "found values up to 1e+30 in the map"),
    ({"where": ["constant", 2e9], "color_space": "linear"}, "found values up to 2e+09 in the map"),
    ({"where": ["constant", -1e300]}, "has the constant -1e+300, allowed are numbers from -1.7e+38 to 1.7e+38"),
    ({"where": ["constant", 1e4]}, "found values up to 3.5e+09 in the map"),  # sRGB
    ({"low": -1e30, "color_space": "linear"}, "found values up to -1e+30 in the map"),
    ({"high": 1e30, "knee": 1e25, "color_space": "linear"}, "found values up to 1e+30 in the map"),
    ({"where": ["constant", 1e9], "color_space": "linear"}, ""),
    ({"where": ["constant", 1e3]}, ""),
])  # fmt: skip
@pytest.mark.parametrize("name", READERS[1:])
def test_values_in_files(mi, files, tmp_path, name, values, found):
    """Too large ones are refused; the largest are finite along paths of four bounces."""
    described = plugin({name: constants(values, files[name], tmp_path)}, name)
    if found:
        sentence = refused(mi, described)
        assert 'parameter "filename": ' in sentence and found in sentence
        assert "constant" in found or f'the map "albedo", {ALLOWED}' in sentence
        return
    bsdf = described if name == "neural_material" else {"type": "diffuse", "reflectance": described}
    inside = {"type": "sphere", "radius": 9, "flip_normals": True, "bsdf": bsdf}
    lamp = {"type": "point", "position": [0.0, 0.0, 3.0], "intensity": 1.0}
    sensor = {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8}}
    loaded = {"type": "scene", "integrator": {"type": "path", "max_depth": 5}, "lamp": lamp, "sensor": sensor}
    assert np.isfinite(mi.render(mi.load_dict({**loaded, "room": inside}), spp=4).numpy()).all()


def test_every_map_of_a_material_is_checked(mi, files, tmp_path):
    path = constants({"where": ["constant", 1e30]}, files["neural_material"], tmp_path, "normal")
    assert 'in the map "normal"' in refused(mi, {"type": "neural_material", "filename": path})
    mi.load_dict({"type": "neural_material", "filename": path, "ignore": "normal"})


@pytest.mark.parametrize("raw", [False, True])
def test_values_of_bitmaps(mi, raw):
    def texture(value):
        return {"type": "mipmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), value, np.float32)), "raw": raw}

    for value in (1e30, -1e30, 2e9):
        assert f'"bitmap": found values up to {value:.3g} in the map "image", {ALLOWED}' in refused(mi, texture(value))
    mi.load_dict(texture(1e9))


@pytest.mark.parametrize("value", [1e30, 1e300, math.nan])
def test_transformations_beyond_single_precision(mi, files, value):
    matrix = mi.ScalarTransform4f([[value, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    sentence = refused(mi, plugin(files, "neural_image", to_uv=matrix))
    assert 'parameter "to_uv": found an entry of ' in sentence and "allowed are up to 1e+18" in sentence
