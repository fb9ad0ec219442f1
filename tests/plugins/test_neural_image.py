"""
The texture ``neural_image`` inside Mitsuba: against ``bitmap`` with the image that it decodes to, an independent
implementation, and under what scenes do to a texture.
"""

import functools
import itertools
import json
import math
import os
import re
import threading
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from scipy.ndimage import map_coordinates
from texture_scenes import alive, check_process, refused, scene_xml
from variants import VARIANTS, set_variant, warnings_of

from mi_diffind.arrays.tables import StoredArray, Table, load_table, save_table
from mi_diffind.core import compat
from mi_diffind.maps.layout import Layout, MapLayout
from mi_diffind.maps.source import load_source
from mi_diffind.measure.operations import bsdf_operations, count
from mi_diffind.scenes import comparison, loading
from mi_diffind.tasks.ggx import TASK as GGX
from mi_diffind.tasks.image import TASK
from mi_diffind.tasks.image.arrays import CompressedImage

WIDTH, HEIGHT = 12, 10

#: Of each kind that a material may have. ``glow`` is of high dynamic range, ``flat`` constant.
MAPS = (
    MapLayout("albedo", "albedo", "srgb", 1, (0, 1, 2)),
    MapLayout("normal", "normal", "linear", 1, (3, 4, "z")),
    MapLayout("roughness", "roughness", "linear", 1, (5,)),
    MapLayout("metallic", "metallic", "linear", 1, (("constant", 0.25),)),
    MapLayout("grey", "other", "srgb", 1, (6, 6, 6)),
    MapLayout("height", "other", "linear", 2, (2,)),
    MapLayout("stain", "other", "srgb", 1, (6,)),
    MapLayout("glow", "other", "linear", 4, (2, 1, 0), 0.0, 8.0, 0.5),
    MapLayout("flat", "other", "srgb", 1, (("constant", 0.5), ("constant", 0.2), ("constant", 0.7))),
    MapLayout("pair", "other", "linear", 1, (0, 1)),
)
LAYOUT = Layout(WIDTH, HEIGHT, MAPS, (0.5,) * 7, ("albedo",) * 3 + ("normal",) * 2 + ("roughness", "stain"))

#: A read of bytes may be 1/64 of a step off, which is another 1/64 on the other side of an entry.
ROUNDING = 1e-4

USABLE = tuple(m.name for m in MAPS if m.channels != 2)
WRAP_MODES = ("repeat", "mirror", "clamp")
METHODS = ("eval", "eval_1", "eval_3", "eval_1_grad")

#: Each colour mode once, polarised in one of them: a texture returns no Mueller matrix in any.
RENDERED = [v for v in VARIANTS if v.endswith(("ad_rgb", "ad_mono", "ad_spectral_polarized"))]


# -- helpers -----------------------------------------------------------------------------------------------------------


def make(path, layout=LAYOUT, border=("repeat", "clamp"), seed=1, shape=(8, 9), side=4, spread=(0, 255), coarse=False):
    """A file of random arrays, the primary of 6 bits; ``coarse``: one of its two channels is in an array of its own."""
    rng = np.random.default_rng(seed)
    table = Table("image", {}, settings={"layout": layout.to_json()})
    if layout.stored:
        arrays = {
            "primary": rng.integers(0, 63, (*shape, 2), np.uint8, endpoint=True),
            "cascaded": rng.integers(*spread, (side, side, layout.stored), np.uint8, endpoint=True),
        }
        if coarse:
            arrays["coarse"] = arrays["primary"][::2, ::2, 1:].copy()
            arrays["primary"] = arrays["primary"][..., :1].copy()
        for name, array in arrays.items():
            around, bits = (("clamp", "clamp"), 8) if name == "cascaded" else (border, 6)
            affine = ((1 / (2**bits - 1),) * array.shape[-1], (0.0,) * array.shape[-1])
            table.arrays[name] = StoredArray(array, around, *affine, bits)
    save_table(path, table)
    return str(path)


def single(kind, color_space="linear", channels=3):
    """A layout of one map."""
    one = MapLayout("image", kind, color_space, 1, tuple(range(channels)))
    return Layout(WIDTH, HEIGHT, (one,), (0.5,) * channels, ("image",) * channels)


def tabulated(path, layout, values, **settings):
    """A file whose primary is uv, and whose cascaded array has the channels ``values(y, x)`` of places in [0, 1]."""
    y, x = np.mgrid[0:129, 0:129] / 128
    ramp = np.stack(np.meshgrid([0, 255], [0, 255], indexing="ij"), axis=-1).astype(np.uint8)
    table = Table("image", {}, settings={"layout": layout.to_json(), **settings})
    for name, entries in (("primary", ramp), ("cascaded", np.rint(255 * values(y, x)).astype(np.uint8))):
        scale, offset = (1 / 255,) * entries.shape[-1], (0.0,) * entries.shape[-1]
        table.arrays[name] = StoredArray(entries, ("clamp", "clamp"), scale, offset, 8)
    save_table(path, table)
    return str(path)


def layout_of(file):
    return Layout.from_json(TASK.load(file).settings["layout"])


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return make(tmp_path_factory.mktemp("images") / "material.npz")


@pytest.fixture(scope="module")
def smooth(tmp_path_factory):
    """Three smooth colours, and the image with 8 bits that they stand for."""
    path = tmp_path_factory.mktemp("smooth") / "smooth.npz"

    def waves(y, x):
        return np.stack([0.5 + 0.3 * np.sin(2 * np.pi * (x + k * y / 2) + k) for k in range(3)], axis=-1)

    y, x = np.mgrid[0:48, 0:64]
    layout = replace(single("albedo", "srgb"), width=64, height=48)
    return tabulated(path, layout, waves), np.rint(255 * waves((y + 0.5) / 48, (x + 0.5) / 64)).astype(np.uint8)


def plugin(file, channels="albedo", **more):
    return {"type": "neural_image", "filename": file, "channels": channels, **more}


@functools.lru_cache
def decoded(dtype, file, stamp):
    return CompressedImage.of(TASK.load(file), dtype).decode()


def counterpart(mi, file, channels="albedo", **more):
    """``bitmap`` with the image that the file decodes to."""
    layout = layout_of(file)
    bitmap = mi.Bitmap(np.ascontiguousarray(decoded(mi.TensorXf, file, os.stat(file).st_mtime_ns)[channels]))
    bitmap.set_srgb_gamma(layout[channels].color_space == "srgb")
    raw = {"raw": True} if channels in ("normal", "roughness", "metallic") else {}
    return {"type": "bitmap", "bitmap": bitmap, "format": "variant", **raw, **more}


def interactions(mi, u, v):
    u, v = (np.atleast_1d(x) for x in (u, v))
    si = dr.zeros(mi.SurfaceInteraction3f, max(len(u), len(v)))
    si.uv = mi.Point2f(mi.Float(aligned(u)), mi.Float(aligned(v)))
    if mi.is_spectral:
        wavelengths = np.random.default_rng(5).uniform(360, 830, (4, dr.width(si.uv)))
        si.wavelengths = type(si.wavelengths)(*[mi.Float(aligned(w)) for w in wavelengths])
    return si


def centres(rng, n, tiles=0):
    """Coordinates of texel centres, of ``tiles`` images to either side, too."""
    x = rng.integers(-tiles * WIDTH, (tiles + 1) * WIDTH, n)
    y = rng.integers(-tiles * HEIGHT, (tiles + 1) * HEIGHT, n)
    return (x + 0.5) / WIDTH, (y + 0.5) / HEIGHT


def values_of(textures, si, methods=METHODS):
    """Values as NumPy arrays by texture and method, ``None`` where the texture raises; computed by one kernel."""
    values = {}
    for (name, texture), method in itertools.product(textures.items(), methods):
        try:
            values[name, method] = getattr(texture, method)(si)
        except RuntimeError:
            values[name, method] = None
    dr.eval([v for v in values.values() if v is not None])
    return {key: None if v is None else v.numpy() for key, v in values.items()}


def sentence(error):
    text = compat.one_sentence(error)
    assert "Traceback" not in text and len(text) < 350, text
    return text


def lamp_place(mi):
    return mi.ScalarTransform4f().translate([0, 1.2, 0.6]).rotate([1, 0, 0], 60).scale(0.6)


def scene(mi, bsdf=None, emitter=None, size=16, **integrator):
    rotated = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    found = {
        "type": "scene",
        "integrator": integrator or {"type": "path", "max_depth": 3},
        "sensor": {"type": "perspective", "fov": 35, "to_world": rotated, "film": film},
        "wall": {"type": "rectangle", "bsdf": bsdf or {"type": "diffuse"}},
    }
    if emitter is None:
        return mi.load_dict({**found, "sky": {"type": "constant"}})
    return mi.load_dict({**found, "lamp": {"type": "rectangle", "to_world": lamp_place(mi), "emitter": emitter}})


# -- the same as a bitmap ----------------------------------------------------------------------------------------------


def test_equals_a_bitmap_of_what_it_decodes_to(mi_any, file, rng):
    """At texel centres, every map in every method; and where ``bitmap`` has no answer there is none."""
    mi = mi_any
    ours = {name: mi.load_dict(plugin(file, name)) for name in USABLE}
    theirs = {name: mi.load_dict(counterpart(mi, file, name)) for name in USABLE}
    si = interactions(mi, *centres(rng, 400))
    found = values_of(ours, si)
    for (name, method), b in values_of(theirs, si).items():
        a = found[name, method]
        assert (a is None) == (b is None), (name, method)
        if b is not None:
            steep = (WIDTH if method == "eval_1_grad" else 1) * max(1, np.abs(b).max())
            a = np.broadcast_to(a, b.shape)
            np.testing.assert_allclose(a, b, atol=2 * ROUNDING * steep, err_msg=f"{name}, {method}")
    for name in USABLE:
        a, b = ours[name], theirs[name]
        assert list(a.resolution()) == list(b.resolution()) == [WIDTH, HEIGHT], name
        assert a.is_spatially_varying() == (name not in ("metallic", "flat")), name
        # Both clamp the spectra of bright colours, but only one of them at the same brightness
        if not (name == "glow" and mi.is_spectral):
            assert abs(float(a.mean()[0]) - float(b.mean()[0])) < 2e-5, name
        largest = dr.max(mi.traverse(mi.load_dict(counterpart(mi, file, name, raw=True)))["data"].array)[0]
        if not (a.raw or layout_of(file)[name].color_space == "linear"):
            largest = dr.srgb_to_linear(largest)
        assert a.max() >= float(largest) * (1 - 1e-5), name


def test_raw(mi_any, file, rng):
    mi, names = mi_any, ("albedo", "grey", "stain", "glow")
    si = interactions(mi, *centres(rng, 300))
    ours, theirs = (
        values_of({n: mi.load_dict(t(n)) for n in names}, si, METHODS[:3])
        for t in (lambda n: plugin(file, n, raw=True), lambda n: counterpart(mi, file, n, raw=True))
    )
    for key, b in theirs.items():
        a = ours[key]
        assert (a is None) == (b is None), key
        if b is not None:
            np.testing.assert_allclose(a, b, atol=ROUNDING * max(1, b.max()), err_msg=str(key))


@pytest.mark.parametrize("border", [("repeat", "repeat"), ("clamp", "clamp"), ("clamp", "repeat")])
@pytest.mark.parametrize("wrap_mode", WRAP_MODES)
def test_wrap_modes(mi_rgb, tmp_path, rng, wrap_mode, border):
    mi = mi_rgb
    path = make(tmp_path / "a.npz", border=border)
    more = {"wrap_mode": wrap_mode}
    textures = [mi.load_dict(t) for t in (plugin(path, **more), counterpart(mi, path, **more))]
    u, v = (rng.random(500) * 0.5 / n for n in (WIDTH, HEIGHT))
    ends = [(u, v), (1 - u, v), (1 - u, 1 - v), (0 * u, 0 * v), (0 * u + 1, 0 * v), (0 * u + 1, 0 * v + 1)]
    seam = [([0, 0.3], [0.4, 0]), ([1, 0.3], [0.4, 1])]
    places = np.concatenate([np.array(p) for p in (centres(rng, 1000, tiles=3), *ends, *seam)], axis=1)
    found = values_of(dict(enumerate(textures)), interactions(mi, *places), ("eval", "eval_1_grad"))
    ours, theirs = found[0, "eval"], found[1, "eval"]
    np.testing.assert_allclose(ours[:, :1000], theirs[:, :1000], atol=ROUNDING)
    if wrap_mode != "repeat" or border == ("repeat", "repeat"):  # elsewhere the outermost texels have other neighbours
        a, b = (found[i, "eval_1_grad"][:, :1000] for i in (0, 1))
        np.testing.assert_allclose(a, b, atol=WIDTH * ROUNDING)
    if wrap_mode != "repeat":  # nothing bleeds over the ends, whatever the arrays' borders
        np.testing.assert_allclose(ours[:, 1000:-4], theirs[:, 1000:-4], atol=ROUNDING)
    elif border == ("repeat", "repeat"):
        np.testing.assert_allclose(ours[:, -4:-2], ours[:, -2:], atol=ROUNDING)


@pytest.mark.parametrize("wrap_mode", WRAP_MODES)
@pytest.mark.parametrize("border", [("repeat", "repeat"), ("clamp", "repeat")])
def test_two_primaries(mi_rgb, tmp_path, rng, border, wrap_mode):
    mi = mi_rgb
    path = make(tmp_path / "a.npz", border=border, coarse=True)
    theirs = mi.load_dict(counterpart(mi, path, wrap_mode=wrap_mode))
    si = interactions(mi, *centres(rng, 500, tiles=2))
    textures = {s: mi.load_dict(plugin(path, wrap_mode=wrap_mode, storage=s)) for s in ("uint8", "float32")}
    found = values_of({**textures, "bitmap": theirs}, si, ("eval",))
    for storage in textures:
        np.testing.assert_allclose(found[storage, "eval"], found["bitmap", "eval"], atol=3 * ROUNDING)
    keys = sorted(mi.traverse(textures["float32"]).keys())
    assert keys == ["tables.cascaded", "tables.coarse", "tables.primary", "to_uv"]
    bsdf = mi.load_dict(materials(lambda m: plugin(path, m, wrap_mode=wrap_mode))["principled"])
    one = mi.load_dict(materials(lambda m: plugin(path, m, wrap_mode=wrap_mode))["diffuse"])
    both, one = (bsdf_operations(b, ("eval",))["eval"].gathers for b in (bsdf, one))
    assert one <= both < 2 * one  # a further word of each corner for further channels


@pytest.mark.parametrize("border", [("repeat", "clamp"), ("clamp", "repeat")])
def test_reads_as_an_independent_implementation_does(mi_rgb, tmp_path, rng, border):
    """Anywhere, by SciPy in double precision."""
    mi = mi_rgb
    path = make(tmp_path / "a.npz", border=border, seed=3)
    arrays = TASK.load(path).arrays
    u, v = rng.random((2, 3000)).astype(np.float32).astype(np.float64)
    x = [t * (n if b == "repeat" else n - 1) for t, n, b in zip((v, u), arrays["primary"].shape, border, strict=False)]
    primary = arrays["primary"].entries / 63
    for axis, b in enumerate(border):
        if b == "repeat":
            primary = np.concatenate([primary, np.take(primary, [0], axis)], axis)
    pointer = [map_coordinates(primary[..., k], x, order=1) * 3 for k in range(2)]
    stored = [map_coordinates(arrays["cascaded"].entries[..., k] / 255, pointer, order=1) for k in range(7)]
    si = interactions(mi, u, v)
    s = np.stack(stored[:3])
    albedo = np.where(s < 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    textures = {name: mi.load_dict(plugin(path, name)) for name in ("albedo", "normal", "glow")}
    found = values_of(textures, si, ("eval", "eval_3"))
    np.testing.assert_allclose(found["albedo", "eval"], albedo, atol=ROUNDING)
    n = 2 * np.stack(stored[3:5]) - 1
    z = np.sqrt(np.maximum(0, 1 - (n**2).sum(axis=0)))
    normal = found["normal", "eval_3"]
    np.testing.assert_allclose(normal[:2] * 2 - 1, n, atol=2 * ROUNDING)
    np.testing.assert_allclose((normal[2] * 2 - 1) ** 2, z**2, atol=1e-3)
    glow = 0.5 * ((1 + 8 / 0.5) ** s[::-1] - 1)
    np.testing.assert_allclose(found["glow", "eval"], glow, rtol=1e-3, atol=1e-3)
    assert normal.max() <= 1 + 1e-6 and glow.max() > 1


TRANSFORMS = {
    "scale": lambda t: t.scale([2, 3, 1]),
    "flip": lambda t: t.translate([0, 1, 0]).scale([1, -1, 1]),
    "turn": lambda t: t.translate([1, 0, 0]).rotate([0, 0, 1], 90),
    "any": lambda t: t.translate([0.3, -0.2, 0]).rotate([0, 0, 1], 30).scale([1.5, 0.7, 1]),
}


@pytest.mark.parametrize("name", list(TRANSFORMS))
def test_to_uv(mi_rgb, file, rng, name):
    mi = mi_rgb
    to_uv = TRANSFORMS[name](mi.ScalarTransform4f())
    ours, theirs = mi.load_dict(plugin(file, to_uv=to_uv)), mi.load_dict(counterpart(mi, file, to_uv=to_uv))
    u, v = centres(rng, 300)
    m = np.array([[float(to_uv.matrix[i, j]) for j in (0, 1, 3)] for i in (0, 1)] + [[0, 0, 1]])
    uv = np.linalg.solve(m, np.stack([u, v, np.ones_like(u)]))
    si = interactions(mi, uv[0], uv[1])
    found = values_of({"ours": ours, "theirs": theirs}, si, ("eval", "eval_1_grad"))
    np.testing.assert_allclose(found["ours", "eval"], found["theirs", "eval"], atol=2 * ROUNDING)
    if name in ("scale", "flip"):  # of others ``bitmap`` takes width for height
        a, b = (found[t, "eval_1_grad"] for t in ("ours", "theirs"))
        np.testing.assert_allclose(a, b, atol=2e-3 * np.abs(b).max())


def test_to_uv_is_a_parameter(mi_rgb, file, rng):
    mi = mi_rgb
    ours = mi.load_dict(plugin(file))
    si = interactions(mi, *centres(rng, 100))
    params = mi.traverse(ours)
    params["to_uv"] = mi.ScalarTransform3f().scale(2)
    params.update()
    expected = mi.load_dict(plugin(file, to_uv=mi.ScalarTransform3f().scale(2)))
    np.testing.assert_array_equal(ours.eval(si).numpy(), expected.eval(si).numpy())
    params["to_uv"] = mi.ScalarTransform3f()
    params.update()
    np.testing.assert_array_equal(ours.eval(si).numpy(), mi.load_dict(plugin(file)).eval(si).numpy())


@pytest.mark.parametrize(
    "variant, wrap_mode", [(v, w) for v in VARIANTS for w in WRAP_MODES if v.endswith("ad_rgb") or w == "repeat"]
)
def test_any_coordinate_gives_a_finite_value(variant, file, wrap_mode):
    mi = set_variant(variant)
    bad = [math.nan, math.inf, -math.inf, 3e38, -3e38, 1e20, 2**31, -(2**31), 2**24 + 1, 1e-45, -1e-45, 0, 1, -0.0]
    u, v = (x.ravel() for x in np.meshgrid(bad, bad))
    si = interactions(mi, u, v)
    # Wrapping comes before all maps, reading before the colours of a variant: all maps where both are the first ones
    first = wrap_mode == "repeat" and mi.is_rgb
    for storage in ("uint8", "float32") if mi.is_rgb else ("uint8",):
        names = ("albedo", "normal", "roughness", "glow") if first else ("albedo", "glow")
        more = {"wrap_mode": wrap_mode, "storage": storage}
        textures = {name: mi.load_dict(plugin(file, name, **more)) for name in names}
        for methods in (METHODS[:3], METHODS[3:]):
            for key, value in values_of(textures, si, methods).items():
                assert value is None or np.isfinite(value).all(), (key, storage)
        densities = {name: texture.pdf_position(si.uv) for name, texture in textures.items()}
        dr.eval(densities)
        for name, density in densities.items():
            assert np.isfinite(density.numpy()).all() and density.numpy().min() >= 0, (name, storage)


WRONG = (math.nan, math.inf, -math.inf, 1e30, -1e30)


def test_tables_of_anything(mi_rgb, file, rng):
    """What an optimiser leaves in the tables: values are finite, and between those that the map can have."""
    mi = mi_rgb
    si = interactions(mi, *rng.uniform(-1, 2, (2, 200)))
    textures = {name: mi.load_dict(plugin(file, name, storage="float32")) for name in ("albedo", "normal", "glow")}
    params = mi.traverse(textures["albedo"])  # which all of them share
    loaded = scene(mi, {"type": "diffuse", "reflectance": textures["albedo"]}, size=4)
    for key in ("tables.primary", "tables.cascaded"):
        before = params[key].numpy()
        for wrong, share in [(math.nan, 1), *((wrong, 0.3) for wrong in WRONG)]:
            params[key] = mi.TensorXf(aligned(np.where(rng.random(before.shape) < share, np.float32(wrong), before)))
            params.update()
            found = values_of(textures, si, ("eval", "eval_1", "eval_1_grad"))
            assert all(np.isfinite(v).all() for v in found.values()), (key, wrong, share)
            for name, texture in textures.items():
                assert np.isfinite([texture.mean()[0], texture.max()]).all(), (name, key, wrong, share)
                (low, high), values = (0, 1) if name != "glow" else (0, 9), found[name, "eval"]
                assert low <= values.min() and values.max() <= high + 1e-4, (name, key, wrong, share)
            uv, pdf = textures["albedo"].sample_position(mi.Point2f(si.uv - dr.floor(si.uv)))
            assert np.isfinite(uv.numpy()).all() and np.isfinite(pdf.numpy()).all() and pdf.numpy().min() > 0
            image = mi.render(loaded, spp=1).numpy()
            assert np.isfinite(image).all() and image.min() >= 0
        params[key] = mi.TensorXf(before)
        params.update()


@pytest.mark.parametrize("wrong", WRONG)
def test_gradients_of_wrong_tables_are_finite(mi_rgb, file, rng, wrong):
    mi = mi_rgb
    si = interactions(mi, *rng.random((2, 200)))
    textures = [mi.load_dict(plugin(file, name, storage="float32")) for name in ("albedo", "normal", "glow")]
    params = mi.traverse(textures[0])  # which all of them share
    keys = ("tables.primary", "tables.cascaded")
    for key in keys:
        entries = params[key].numpy()
        params[key] = mi.TensorXf(aligned(np.where(rng.random(entries.shape) < 0.1, np.float32(wrong), entries)))
        dr.enable_grad(params[key])
    params.update()
    dr.backward(sum(dr.sum(channel) for texture in textures for channel in texture.eval_3(si)))
    for key in keys:
        assert np.isfinite(params[key].grad.numpy()).all(), key


@pytest.mark.parametrize("wrap_mode", WRAP_MODES)
@pytest.mark.parametrize("transformed", [False, True])
def test_positions_of_samples_that_are_none(mi_rgb, file, wrap_mode, transformed):
    """A position that is none would spread through a whole render."""
    mi = mi_rgb
    more = {"to_uv": TRANSFORMS["turn"](mi.ScalarTransform4f())} if transformed else {}
    bad = [math.nan, math.inf, -math.inf, -1, -1e-9, 0, 1, 1 + 1e-6, 2, 1e30, 3e38, 1 - 2**-24]
    u, v = (mi.Float(aligned(x.ravel())) for x in np.meshgrid(bad, bad))
    found = {}
    for name in ("albedo", "roughness", "glow", "flat"):
        texture = mi.load_dict(plugin(file, name, wrap_mode=wrap_mode, **more))
        uv, pdf = texture.sample_position(mi.Point2f(u, v))
        found[name] = uv, pdf, texture.pdf_position(uv)
    dr.eval(found)
    for name, (uv, pdf, again) in found.items():
        pdf, again = np.broadcast_to(pdf.numpy(), len(bad) ** 2), again.numpy()
        assert np.isfinite(pdf).all() and pdf.min() > 0 and np.isfinite(again).all(), name
        if name != "flat":  # of one colour: the sample is the position
            assert np.isfinite(uv.numpy()).all() and uv.numpy().min() >= 0 and uv.numpy().max() <= 1, name


def test_storage_forms_agree(mi_any, file, rng):
    mi = mi_any
    si = interactions(mi, *rng.random((2, 1000)))
    names, storages = ("albedo", "glow", "stain"), ("uint8", "float32")
    textures = {(n, s): mi.load_dict(plugin(file, n, storage=s)) for n in names for s in storages}
    found = values_of(textures, si, ("eval",))
    for name in names:
        a, b = (found[(name, s), "eval"] for s in storages)
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=2e-4, err_msg=name)


def test_gradient_of_the_image(mi_rgb, file, rng):
    """``eval_1_grad``: differences of the texels around, per unit of uv, through ``to_uv``, for sides that differ."""
    mi = mi_rgb
    for name in ("height", "albedo"):
        image = mi.load_dict(plugin(file, name))
        x, y = rng.integers(0, WIDTH - 1, 200), rng.integers(0, HEIGHT - 1, 200)
        f = {
            (i, j): image.eval_1(interactions(mi, (x + i + 0.5) / WIDTH, (y + j + 0.5) / HEIGHT)).numpy()
            for i in (0, 1)
            for j in (0, 1)
        }
        a, b = rng.uniform(0.1, 0.9, (2, 200))
        expected = [
            WIDTH * ((1 - b) * (f[1, 0] - f[0, 0]) + b * (f[1, 1] - f[0, 1])),
            HEIGHT * ((1 - a) * (f[0, 1] - f[0, 0]) + a * (f[1, 1] - f[1, 0])),
        ]
        uv = np.stack([(x + 0.5 + a) / WIDTH, (y + 0.5 + b) / HEIGHT])
        np.testing.assert_allclose(image.eval_1_grad(interactions(mi, *uv)).numpy(), expected, atol=2e-3)
        to_uv = TRANSFORMS["any"](mi.ScalarTransform4f())
        m = np.array([[float(to_uv.matrix[i, j]) for j in (0, 1)] for i in (0, 1)])
        shift = np.array([[float(to_uv.matrix[i, 3])] for i in (0, 1)])
        turned = mi.load_dict(plugin(file, name, to_uv=to_uv))
        found = turned.eval_1_grad(interactions(mi, *np.linalg.solve(m, uv - shift))).numpy()
        np.testing.assert_allclose(found, m.T @ expected, atol=5e-3)


# -- spectra -----------------------------------------------------------------------------------------------------------


def test_spectra_between_texels(smooth):
    """Of smooth colours, against ``bitmap`` with what the file decodes to (51 dB) and with the original (48 dB)."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_spectral")
    mi.set_log_level(mi.LogLevel.Error)
    path, image = smooth
    rng = np.random.default_rng(2)
    si = interactions(mi, *rng.random((2, 20000)))
    si.wavelengths = type(si.wavelengths)(*[mi.Float(aligned(w)) for w in rng.uniform(400, 700, (4, 20000))])
    more = {"wrap_mode": "clamp"}
    ours = mi.load_dict(plugin(path, "image", **more)).eval(si).numpy()
    for bitmap, floor in ((mi.load_dict(counterpart(mi, path, "image", **more)), 48), (None, 45)):
        theirs = bitmap or mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(image), **more})
        mse = np.mean((ours - theirs.eval(si).numpy()) ** 2, dtype=np.float64)
        assert -10 * math.log10(mse) > floor


def test_upsampling_is_mitsubas(rng):
    """The same spectra as from Mitsuba's coefficients, for all colours, with gradients that are their differences."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_spectral")
    from mi_diffind.plugins.support import upsampling

    n = 300
    colours = rng.random((3, n)) ** rng.choice([0.3, 1, 6], n)
    special = [(0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5), (1, 0, 0), (0, 1, 1), (1, 1, 0), (0, 0, 1e-4), (2, -1, 0.5)]
    special += [(1e-7, 2e-7, 0), (0.3, 0.3, 0.1), (0.1, 0.3, 0.3), (0.3, 0.1, 0.3), (1, 1, 0.999999)]
    colours = np.concatenate([colours, np.transpose(special)], axis=1).astype(np.float32)
    wavelengths = np.float32([380, 470, 560, 700])
    rgb = [mi.Float(aligned(c)) for c in colours]
    dr.enable_grad(rgb)
    found = upsampling.spectrum(rgb, mi.UnpolarizedSpectrum(*[float(w) for w in wavelengths]))
    expected = []
    for c in colours.T:
        c0, c1, c2 = np.array(mi.srgb_model_fetch([float(v) for v in c]), np.float64)
        x = (c0 * wavelengths + c1) * wavelengths + c2
        expected.append(0.5 + 0.5 * x / np.sqrt(1 + x * x))
    error = np.abs(found.numpy() - np.transpose(expected))
    assert error.max() < 2e-3 and error.mean() < 1e-5  # 0 and 1 are 1/8192 off in theirs

    dr.backward(sum(dr.sum(channel) for channel in found))
    for k in range(3):
        gradient = rgb[k].grad.numpy()
        assert np.isfinite(gradient).all()
        step, values = 1e-3, []
        for sign in (-1, 1):
            moved = [mi.Float(aligned(c + (sign * step if i == k else 0))) for i, c in enumerate(colours)]
            values.append(sum(upsampling.spectrum(moved, mi.UnpolarizedSpectrum(*wavelengths.tolist())).numpy()))
        difference = (values[1] - values[0]) / (2 * step)
        inside = (colours[:, :n].min(axis=0) > 0.1) & (colours[:, :n].max(axis=0) < 0.95)
        error = np.abs(gradient - difference)[:n][inside]
        assert np.median(error) < 0.02 * np.abs(difference[:n][inside]).mean()


# -- positions ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrap_mode", WRAP_MODES)
@pytest.mark.parametrize("name", ["none", "flip", "turn", "any"])
def test_sampled_positions_have_their_density(mi_rgb, file, rng, name, wrap_mode):
    mi, n, bins = mi_rgb, 100_000, 10
    more = {} if name == "none" else {"to_uv": TRANSFORMS[name](mi.ScalarTransform4f())}
    texture = mi.load_dict(plugin(file, wrap_mode=wrap_mode, **more))
    uv, pdf = texture.sample_position(mi.Point2f(*[mi.Float(aligned(x)) for x in rng.random((2, n))]))
    side = 20 * bins
    grid = (np.mgrid[0:side, 0:side].reshape(2, -1) + 0.5) / side
    grid = mi.Point2f(*[mi.Float(aligned(x)) for x in grid])
    density = np.broadcast_to(texture.pdf_position(grid).numpy(), side * side).reshape(bins, 20, bins, 20)
    assert density.mean() == pytest.approx(1, abs=2e-3) and density.min() > 0
    expected = density.mean(axis=(1, 3)) / bins**2 * n
    counts, _, _ = np.histogram2d(*uv.numpy(), bins=bins, range=[[0, 1]] * 2)
    assert counts.sum() == n
    assert ((counts - expected) ** 2 / expected).sum() < bins**2 + 6 * bins
    if name != "any":  # brightness is what it follows, in the places where it is on the surface
        np.testing.assert_allclose(pdf.numpy(), texture.pdf_position(uv).numpy(), rtol=1e-3)
        brightness = texture.eval_1(interactions(mi, *grid.numpy())).numpy()
        assert np.corrcoef(brightness, density.ravel())[0, 1] > 0.8


@pytest.mark.parametrize("variant", RENDERED)
def test_area_emitters(variant, file):
    """As with a bitmap, to what the values between texels differ, and by less noise than if all places were alike."""
    mi = set_variant(variant)
    names, images = ("albedo", "glow", "flat", "stain"), []
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    for t in (lambda n: plugin(file, n), lambda n: counterpart(mi, file, n)):
        found = {"type": "scene", "integrator": {"type": "path", "max_depth": 3}}
        for i, name in enumerate(names):  # each before a wall of its own, out of sight of the others
            place = mi.ScalarTransform4f().translate([1000 * i, 0, 0])
            seen = place @ mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
            emitter = {"type": "area", "radiance": t(name)}
            found[f"sensor{i}"] = {"type": "perspective", "fov": 35, "to_world": seen, "film": film}
            found[f"wall{i}"] = {"type": "rectangle", "to_world": place, "bsdf": {"type": "diffuse"}}
            found[f"lamp{i}"] = {"type": "rectangle", "to_world": place @ lamp_place(mi), "emitter": emitter}
        loaded = mi.load_dict(found)
        images.append([mi.render(loaded, sensor=i, spp=2048).numpy() for i in range(len(names))])
    for name, a, b in zip(names, *images, strict=True):
        assert a.mean() > 0 and a.mean() == pytest.approx(b.mean(), rel=0.2 if name == "glow" else 0.05), name


def test_emitters_of_any_transformation(mi_rgb, file):
    """Light that is sampled by position is the light that paths find by chance."""
    mi = mi_rgb
    for name in ("none", *TRANSFORMS):
        more = {} if name == "none" else {"to_uv": TRANSFORMS[name](mi.ScalarTransform4f())}
        emitter = {"type": "area", "radiance": plugin(file, wrap_mode="clamp", **more)}
        means = [
            mi.render(scene(mi, emitter=emitter, size=4, type="direct", emitter_samples=e, bsdf_samples=b), spp=2**15)
            .numpy()
            .mean(dtype=np.float64)
            for e, b in ((1, 0), (0, 1))
        ]
        assert means[0] == pytest.approx(means[1], rel=0.02), name


@pytest.mark.parametrize("variant", RENDERED)
def test_particle_tracer(variant, file):
    """Asks for a wavelength and a ray from the emitter."""
    mi = set_variant(variant)
    emitter = {"type": "area", "radiance": plugin(file)}
    image = mi.render(scene(mi, emitter=emitter, size=4, type="ptracer", max_depth=3), spp=2**13).numpy()
    expected = mi.render(scene(mi, emitter=emitter, size=4), spp=2**10).numpy()
    assert image.mean() == pytest.approx(expected.mean(), rel=0.05)


# -- in materials ------------------------------------------------------------------------------------------------------


def materials(t):
    """BSDFs that use textures ``t(map)`` in every way that there is."""
    plain = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    return {
        "diffuse": {"type": "diffuse", "reflectance": t("albedo")},
        "principled": {
            "type": "principled",
            "base_color": t("albedo"),
            "roughness": t("roughness"),
            "metallic": t("metallic"),
        },
        "roughconductor": {"type": "roughconductor", "alpha": t("roughness"), "specular_reflectance": t("albedo")},
        "roughplastic": {"type": "roughplastic", "diffuse_reflectance": t("albedo"), "alpha": 0.3},
        "plastic": {"type": "plastic", "diffuse_reflectance": t("grey")},
        "normalmap": {"type": "normalmap", "normalmap": t("normal"), "bsdf": plain},
        "bumpmap": {"type": "bumpmap", "texture": t("height"), "bsdf": plain, "scale": 0.05},
        "blendbsdf": {
            "type": "blendbsdf",
            "weight": t("roughness"),
            "a": plain,
            "b": {"type": "diffuse", "reflectance": t("albedo")},
        },
        "mask": {"type": "mask", "opacity": t("stain"), "bsdf": plain},
        "neural_disney": {"type": "neural_disney", "base_color": t("albedo"), "roughness": t("roughness")},
        "neural_ggx": {"type": "neural_ggx", "alpha": t("roughness")},
    }


@pytest.mark.parametrize("variant", RENDERED)
def test_renders_as_with_bitmaps(variant, tmp_path):
    """Of arrays that are smooth enough for both to agree between texels; all materials in one scene, side by side."""
    mi = set_variant(variant)
    path = make(tmp_path / "a.npz", spread=(110, 140))
    names, images = list(materials(lambda m: m)), []
    for t in (lambda m: plugin(path, m), lambda m: counterpart(mi, path, m)):
        shapes = {
            f"wall{i}": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([2 * i + 1 - len(names), 0, 0]),
                "bsdf": bsdf,
            }
            for i, bsdf in enumerate(materials(t).values())
        }
        to_world = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, -1, 0])  # x goes right
        film = {"type": "hdrfilm", "width": 12 * len(names), "height": 12, "rfilter": {"type": "box"}}
        loaded = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {
                "type": "orthographic", "film": {**film, "pixel_format": "rgb"},
                "to_world": to_world @ mi.ScalarTransform4f().scale([len(names), len(names), 1]),
            },
            "sky": {"type": "constant"},
            **shapes,
        })  # fmt: skip
        images.append(mi.render(loaded, spp=32).numpy().reshape(12, len(names), 12, -1))
    for i, name in enumerate(names):
        a, b = (image[:, i] for image in images)
        assert np.isfinite(a).all() and b.mean() > 0.01, name
        assert a.mean() == pytest.approx(b.mean(), rel=0.02), name
        assert np.abs(a - b).mean() < 0.05 * b.mean(), name
    assert not any(np.allclose(images[1][:, 0], images[1][:, i], rtol=0.05) for i in range(1, len(names)))


def test_maps_of_one_file_are_decoded_once(mi_rgb, file):
    mi = mi_rgb
    for more in ({}, {"to_uv": mi.ScalarTransform4f().scale(3)}, {"wrap_mode": "mirror"}):
        found = {k: mi.load_dict(b) for k, b in materials(lambda m, k=more: plugin(file, m, **k)).items()}
        once = bsdf_operations(found["diffuse"], ("eval",))["eval"].gathers
        assert 0 < once <= 8 + 4  # a primary of 2 channels, a cascaded array of 2 dimensions
        for method in ("eval", "pdf", "sample"):
            gathers = bsdf_operations(found["principled"], (method,))[method].gathers
            assert once <= gathers <= once + 4, (method, more)  # a further word of four corners for further channels
        both = mi.load_dict({
            "type": "normalmap", "normalmap": plugin(file, "normal", **more), "bsdf": materials(
                lambda m, k=more: plugin(file, m, **k))["principled"],
        })  # fmt: skip
        assert once <= bsdf_operations(both, ("eval",))["eval"].gathers <= once + 4


@pytest.mark.parametrize("storage", ["uint8", "float32"])
def test_maps_of_one_file_are_decoded_once_in_a_render(mi_rgb, file, storage):
    mi = mi_rgb

    def gathers(name):
        loaded = scene(mi, materials(lambda m: plugin(file, m, storage=storage))[name] if name else None)
        return count(lambda: mi.render(loaded, spp=1)).gathers

    with_maps = {k: gathers(k) for k in (None, "diffuse", "principled")}
    one, two = with_maps["diffuse"] - with_maps[None], with_maps["principled"] - with_maps[None]
    # The roughness is among other four channels than the albedo, at each of four corners
    assert 0 < one <= two <= one + 6


def test_maps_of_other_places_are_not_confused(mi_rgb, file, rng):
    mi = mi_rgb
    forms = [{}, {"to_uv": mi.ScalarTransform4f().scale(2)}, {"wrap_mode": "clamp"}, {"storage": "float32"}]
    si = interactions(mi, *rng.uniform(-1, 2, (2, 200)))
    alone = [mi.load_dict(plugin(file, **f)).eval(si).numpy() for f in forms]
    textures = [mi.load_dict(plugin(file, **f)) for f in forms]
    together = [t.eval(si) for t in textures]
    dr.eval(together)
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_allclose(a, b.numpy(), atol=1e-6)


# -- optimisation ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["eval", "eval_1_grad"])
def test_gradients_against_finite_differences(mi_any, file, rng, method):
    mi = mi_any
    name = "albedo" if method == "eval" else "height"
    texture = mi.load_dict(plugin(file, name, storage="float32"))
    params = mi.traverse(texture)
    assert sorted(params.keys()) == ["tables.cascaded", "tables.primary", "to_uv"]
    assert mi.ParamFlags.Differentiable == params.flags("tables.primary")
    si = interactions(mi, *rng.random((2, 64)))
    weights = [mi.Float(aligned(w)) for w in rng.normal(size=(4, 64))]

    def total():
        value = getattr(texture, method)(si)
        return dr.sum(sum(w * v for w, v in zip(weights, value, strict=False)))

    for key in ("tables.primary", "tables.cascaded"):
        start = params[key].numpy() * 0.98 + 0.01  # away from the ends, where entries are folded
        params[key] = mi.TensorXf(aligned(start))
        params.update()
        dr.enable_grad(params[key])
        dr.backward(total())
        gradient = dr.grad(params[key]).numpy().ravel()
        dr.disable_grad(params[key])
        strongest = np.argsort(-np.abs(gradient))[:6]
        assert np.abs(gradient[strongest]).min() > 0
        for i in strongest:
            values = []
            for sign in (-1, 1):
                moved = start.copy()
                moved.ravel()[i] += sign * 1e-3
                params[key] = mi.TensorXf(aligned(moved))
                params.update()
                values.append(float(total()[0]))
            difference = (values[1] - values[0]) / 2e-3
            assert gradient[i] == pytest.approx(difference, rel=0.05, abs=0.02 * float(np.abs(gradient).max()))
        params[key] = mi.TensorXf(aligned(start))
        params.update()


def test_gradients_reach_the_coordinate(mi_any, file, rng):
    mi = mi_any
    texture = mi.load_dict(plugin(file))
    u, v = rng.random((2, 200)) * 0.98 + 0.01
    si = interactions(mi, u, v)
    dr.enable_grad(si.uv)
    dr.backward(sum(dr.sum(c) for c in texture.eval(si)))
    gradient = dr.grad(si.uv).numpy()
    values = []
    for sign in (-1, 1):
        values.append(texture.eval(interactions(mi, u + sign * 2e-4, v)).numpy())
    difference = (values[1] - values[0]).reshape(-1, 200).sum(axis=0) / 4e-4
    assert np.isfinite(gradient).all()
    assert np.median(np.abs(gradient[0] - difference)) < 0.02 * np.abs(difference).mean()


@pytest.mark.parametrize("integrator", ["path", "prb"])
def test_optimisation_recovers_a_colour(mi_rgb, tmp_path, integrator):
    mi = mi_rgb
    path = make(tmp_path / "a.npz", single("albedo"))
    texture = plugin(path, "image", storage="float32")
    loaded = scene(mi, {"type": "diffuse", "reflectance": texture}, size=8, type=integrator, max_depth=3)
    target = mi.TensorXf(np.broadcast_to(np.float32([0.7, 0.3, 0.5]), (8, 8, 3)).copy())
    params = mi.traverse(loaded)
    keys = [k for k in params.keys() if ".tables." in k]
    assert len(keys) == 2
    opt = mi.ad.Adam(lr=0.08)
    for key in keys:
        opt[key] = params[key]
    losses = []
    for step in range(30):
        params.update(opt)
        image = mi.render(loaded, params, spp=4, seed=step)
        loss = dr.mean(dr.square(image - target), axis=None)
        dr.backward(loss)
        opt.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.1 * losses[0]


def test_textures_of_one_file_share_their_parameters(mi_rgb, file, rng):
    """What changes one changes the other, and what had been found out about it; later ones start from the file."""
    mi = mi_rgb
    a, b = (mi.load_dict(plugin(file, name, storage="float32")) for name in ("albedo", "glow"))
    si = interactions(mi, *rng.random((2, 10)))
    before, mean, largest = b.eval(si).numpy(), float(b.mean()[0]), b.max()
    point = mi.Point2f(0.3, 0.4)
    density = float(b.pdf_position(point)[0])
    params = mi.traverse(a)
    entries = params["tables.cascaded"].numpy()
    params["tables.cascaded"] = mi.TensorXf(aligned(entries * np.linspace(0.2, 0.9, 4)[:, None, None]))
    params.update()
    assert (np.abs(b.eval(si).numpy() - before) > 1e-3).any()
    assert float(b.mean()[0]) < 0.8 * mean and b.max() < largest
    assert float(b.pdf_position(point)[0]) != density
    fresh = mi.load_dict(plugin(file, "glow", storage="float32"))
    np.testing.assert_array_equal(fresh.eval(si).numpy(), before)
    params["tables.cascaded"] = mi.TensorXf(aligned(np.zeros((2, 2, 7), "f4")))
    with pytest.raises(RuntimeError, match=re.escape('parameter "tables.cascaded": "data" has the shape (2, 2, 7)')):
        params.update()


def test_bytes_have_no_parameters_but_the_transformation(mi_rgb, file):
    mi = mi_rgb
    assert list(mi.traverse(mi.load_dict(plugin(file))).keys()) == ["to_uv"]


# -- files -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", RENDERED)
def test_no_arrays(variant, tmp_path, rng, monkeypatch):
    """An image of one colour is a few numbers, none of which can be optimised."""
    mi = set_variant(variant)
    warned = warnings_of(mi, monkeypatch)
    one = MapLayout("image", "albedo", "srgb", 1, (("constant", 0.5), ("constant", 0.2), ("constant", 0.7)))
    path = make(tmp_path / "a.npz", Layout(WIDTH, HEIGHT, (one,), (), ()))
    theirs = mi.load_dict(counterpart(mi, path, "image"))
    si = interactions(mi, *rng.random((2, 30)))
    expected = values_of({"": theirs}, si)
    for storage in ("uint8", "float32"):
        texture = mi.load_dict({"type": "neural_image", "filename": path, "storage": storage})
        for key, a in values_of({"": texture}, si).items():
            b = expected[key]
            assert (a is None) == (b is None)
            if a is not None:
                np.testing.assert_allclose(np.broadcast_to(a, b.shape), b, atol=2e-5)
        assert not texture.is_spatially_varying()
        assert (storage == "float32") == any("a.npz is of one colour: it has no arrays" in text for text in warned)
        assert float(texture.mean()[0]) == pytest.approx(float(theirs.mean()[0]), abs=1e-5)
        t = plugin(path, "image", storage=storage)
        lit = scene(mi, {"type": "diffuse", "reflectance": t}, {"type": "area", "radiance": t})
        assert mi.render(lit, spp=4).numpy().mean() > 0


def test_the_only_map_need_not_be_named(mi_rgb, file, tmp_path, rng):
    mi = mi_rgb
    si = interactions(mi, *rng.random((2, 20)))
    for path, name in ((file, "albedo"), (make(tmp_path / "a.npz", single("other")), "image")):
        found = mi.load_dict({"type": "neural_image", "filename": path})
        np.testing.assert_array_equal(found.eval(si).numpy(), mi.load_dict(plugin(path, name)).eval(si).numpy())


def test_a_file_that_was_written_anew_is_read_anew(mi_rgb, tmp_path, rng):
    mi = mi_rgb
    si = interactions(mi, *rng.random((2, 20)))
    path = make(tmp_path / "a.npz")
    first = mi.load_dict(plugin(path))
    before = first.eval(si).numpy()
    make(path, seed=9)
    os.utime(path, ns=(1, 1))
    second = mi.load_dict(plugin(path))
    assert np.abs(second.eval(si).numpy() - before).max() > 0.01
    np.testing.assert_array_equal(first.eval(si).numpy(), before)


def test_relative_names_and_xml(mi_rgb, tmp_path, rng):
    mi = mi_rgb
    make(tmp_path / "a.npz")
    (tmp_path / "b.xml").write_text(
        '<bsdf version="3.0.0" type="diffuse"><texture type="neural_image" name="reflectance">'
        '<string name="filename" value="a.npz"/><string name="channels" value="albedo"/>'
        '<string name="wrap_mode" value="clamp"/><boolean name="raw" value="true"/>'
        '<boolean name="accel" value="false"/><string name="filter_type" value="bilinear"/>'
        '<transform name="to_uv"><scale x="2" y="3"/><translate x="0.1"/></transform></texture></bsdf>'
    )
    found = mi.load_file(str(tmp_path / "b.xml"))
    to_uv = mi.ScalarTransform4f().translate([0.1, 0, 0]).scale([2, 3, 1])
    expected = mi.load_dict(plugin(str(tmp_path / "a.npz"), raw=True, wrap_mode="clamp", to_uv=to_uv))
    si = interactions(mi, *rng.uniform(-0.2, 0.6, (2, 100)))
    np.testing.assert_allclose(found.eval_diffuse_reflectance(si).numpy(), expected.eval(si).numpy(), rtol=0, atol=1e-5)
    assert "map = albedo of albedo, normal" in str(expected)


def test_shipped_description(mi_rgb, file):
    texture = mi_rgb.load_dict(plugin(file, "normal"))
    text = str(texture)
    for part in ("NeuralImage[", "map = normal", f"{WIDTH} x {HEIGHT}", "raw = true", "as uint8"):
        assert part in text


BAD = {
    "no file name": (lambda f: {"type": "neural_image"}, 'parameter "filename": not given'),
    "missing file": (lambda f: plugin("/nowhere/a.npz"), 'parameter "filename": /nowhere/a.npz: no such file'),
    "a folder": (lambda f: plugin(os.path.dirname(f)), "is a folder, a table file"),
    "not an archive": (lambda f: plugin(__file__), "not a table file"),
    "another task": (lambda f: plugin(str(GGX.file())), 'parameter "filename": '),
    "unknown map": (lambda f: plugin(f, "depth"), 'parameter "channels": found "depth", the file holds albedo, normal'),
    "two channels": (lambda f: plugin(f, "pair"), '"pair" has 2 channels, a texture has 1 or 3'),
    "wrap mode": (lambda f: plugin(f, wrap_mode="tile"), 'parameter "wrap_mode": found "tile", allowed are repeat'),
    "storage": (lambda f: plugin(f, storage="float16"), 'parameter "storage": found "float16", allowed are uint8'),
    "filter": (lambda f: plugin(f, filter_type="nearest"), 'parameter "filter_type": found "nearest", allowed are bi'),
    "raw": (lambda f: plugin(f, raw=0.5), 'parameter "raw": found 0.5, allowed are true and false'),
    "transformation": (lambda f: plugin(f, to_uv=2.0), 'parameter "to_uv": found 2'),
    "unknown": (lambda f: plugin(f, chanel="x"), "chanel"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_bad_parameters(mi_any, file, case):
    wrong, expected = BAD[case]
    assert expected in refused(mi_any, wrong(file))


def test_several_maps_and_none_named(mi_rgb, tmp_path):
    path = make(tmp_path / "a.npz", replace(LAYOUT, maps=MAPS[1:]))
    with pytest.raises(RuntimeError, match="not given, and the file holds several maps: normal, roughness"):
        mi_rgb.load_dict({"type": "neural_image", "filename": path})


# -- the exact counterpart ---------------------------------------------------------------------------------------------


def wall_xml(bsdf, textures):
    content = f'<shape type="rectangle"><bsdf type="{bsdf}">{textures}</bsdf></shape>'
    return scene_xml(f'<emitter type="constant"/>{content}')


def texture_xml(slot, filename, more="", **strings):
    inner = "".join(f'<string name="{k}" value="{v}"/>' for k, v in {"filename": filename, **strings}.items())
    return f'<texture type="neural_image" name="{slot}">{inner}{more}</texture>'


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """A compressed material with the files that it stands for, a scene of it, and the images."""
    import mitsuba as mi

    folder = tmp_path_factory.mktemp("material")

    def wave(y, x):
        return 0.5 + 0.4 * np.sin(2 * np.pi * np.stack([x, y, x + y], axis=-1))

    def stored(y, x):
        values = wave(y, x)
        return np.concatenate([values, 0.8 * values[..., 1:2]], axis=-1)

    image = wave(*(np.mgrid[0:16, 0:16] + 0.5) / 16)
    albedo, orm = (np.rint(255 * v).astype(np.uint8) for v in (image, image[..., ::-1] * 0.8))
    mi.Bitmap(albedo).write(str(folder / "albedo.png"))
    mi.Bitmap(orm).write(str(folder / "orm.png"))
    maps = {"albedo": "albedo.png", "roughness": {"file": "orm.png", "channels": "g"}}
    (folder / "wall.json").write_text(json.dumps(maps))
    layout = Layout.of(load_source(folder / "wall.json"))
    tabulated(folder / "wall.npz", layout, stored, source_path="wall.json")
    textures = texture_xml("base_color", "wall.npz", channels="albedo") + texture_xml(
        "roughness", "wall.npz", channels="roughness", wrap_mode="mirror"
    )
    (folder / "scene.xml").write_text(wall_xml("principled", textures))
    return folder, albedo, orm


@pytest.mark.parametrize("variant", RENDERED)
def test_exact_counterpart(variant, material):
    """The same scene as with the images themselves, where there is a file for each; and it can be compared."""
    mi = set_variant(variant)
    folder, _, orm = material
    exact = loading.load(folder / "scene.xml", exact=True)
    mi.Bitmap(np.ascontiguousarray(orm[..., 1:2])).write(str(folder / "roughness.png"))
    textures = (
        '<texture type="bitmap" name="base_color"><string name="filename" value="albedo.png"/></texture>'
        '<texture type="bitmap" name="roughness"><string name="filename" value="roughness.png"/>'
        '<boolean name="raw" value="true"/><string name="wrap_mode" value="mirror"/></texture>'
    )
    (folder / "stock.xml").write_text(wall_xml("principled", textures))
    stock = loading.load(folder / "stock.xml")
    np.testing.assert_array_equal(mi.render(exact, spp=8).numpy(), mi.render(stock, spp=8).numpy())
    if not mi.is_rgb:
        return

    result = comparison.compare(folder / "scene.xml", spp=8, passes=1, progress=False)
    assert result.figures["psnr_db"] > 40
    assert result.figures["learned_plugins"] == 2
    assert result.figures["table_bytes"] == load_table(folder / "wall.npz").nbytes


def test_exact_counterpart_of_a_given_source(mi_rgb, material, rng):
    """``source`` names an image or a manifest; the values' own transfer function and ``raw`` are kept."""
    mi = mi_rgb
    folder, albedo, _ = material
    for source, raw in (("albedo.png", ""), ("wall.json", ""), ("albedo.png", '<boolean name="raw" value="true"/>')):
        xml = texture_xml("reflectance", "wall.npz", raw, channels="albedo", source=source)
        (folder / "b.xml").write_text(wall_xml("diffuse", xml))
        exact = loading.load(folder / "b.xml", exact=True).shapes()[0].bsdf()
        bitmap = mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(albedo), "raw": bool(raw)})
        si = interactions(mi, *rng.random((2, 100)))
        np.testing.assert_array_equal(exact.eval_diffuse_reflectance(si).numpy(), bitmap.eval(si).numpy())


def test_exact_counterpart_without_a_source(mi_rgb, material, tmp_path):
    folder, _, _ = material
    table = load_table(folder / "wall.npz")
    cases = []
    for recorded, given, expected in (
        (None, None, 'does not record its original image, give it as the parameter "source"'),
        ("gone.png", None, "gone.png: no such file"),
        ("wall.json", "gone.png", "gone.png: no such file"),
        (None, str(folder / "orm.png"), 'has 3 channel(s), the map "roughness" has 1'),
    ):
        table.settings.pop("source_path", None)
        if recorded:
            table.settings["source_path"] = recorded
        save_table(tmp_path / "wall.npz", table)
        more = {} if given is None else {"source": given}
        xml = texture_xml("alpha", "wall.npz", channels="roughness", **more)
        (tmp_path / "s.xml").write_text(wall_xml("roughconductor", xml))
        loading.load(tmp_path / "s.xml")  # as written it needs none
        with pytest.raises(loading.SceneError) as e:
            loading.load(tmp_path / "s.xml", exact=True)
        cases.append((expected, sentence(e.value)))
    for expected, found in cases:
        assert expected in found


def test_exact_counterpart_elsewhere(mi_rgb, material, tmp_path):
    """A recorded source outside of the file's folder is shown only if it is what the file was made from."""
    folder, albedo, _ = material
    table = load_table(folder / "wall.npz")
    table.settings["source_path"] = os.path.relpath(folder / "wall.json", tmp_path)
    (tmp_path / "s.xml").write_text(wall_xml("diffuse", texture_xml("reflectance", "elsewhere.npz", channels="albedo")))
    digest = load_source(folder / "wall.json").digest
    for recorded in (None, "0" * 64, digest):
        table.settings["source"] = recorded
        save_table(tmp_path / "elsewhere.npz", table)
        if recorded == digest:
            exact = loading.load(tmp_path / "s.xml", exact=True).shapes()[0].bsdf()
            bitmap = mi_rgb.load_dict({"type": "bitmap", "bitmap": mi_rgb.Bitmap(albedo)})
            si = interactions(mi_rgb, np.float32([0.2, 0.7]), np.float32([0.4, 0.1]))
            np.testing.assert_array_equal(exact.eval_diffuse_reflectance(si).numpy(), bitmap.eval(si).numpy())
        else:
            with pytest.raises(loading.SceneError, match="has changed since"):
                loading.load(tmp_path / "s.xml", exact=True)


# -- what scenes do to a texture ---------------------------------------------------------------------------------------


def test_two_variants_in_turn(file, rng):
    """A texture of either keeps to its own classes."""
    import mitsuba as mi

    uv, images = rng.random((2, 50)), {}
    textures = {}
    for variant in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_rgb"):
        mi.set_variant(variant)
        textures.setdefault(variant, mi.load_dict(plugin(file)))
        found = textures[variant].eval(interactions(mi, *uv)).numpy()
        np.testing.assert_array_equal(images.setdefault(variant, found), found)
        loaded = scene(mi, {"type": "diffuse", "reflectance": plugin(file)})
        assert mi.render(loaded, spp=4).numpy().mean() > 0
    assert images["llvm_ad_rgb"].shape == (3, 50) and images["llvm_ad_mono"].shape == (1, 50)


def test_scenes_loaded_in_threads(mi_rgb, file):
    mi = mi_rgb
    variant, found, failed = mi.variant(), [], []
    bsdfs = {f"b{i}": b for i, b in enumerate(materials(lambda m: plugin(file, m)).values())}

    def load():
        try:
            mi.set_variant(variant)
            shapes = {f"s{k}": {"type": "rectangle", "bsdf": b} for k, b in bsdfs.items()}
            found.append(mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **shapes}))
        except Exception as e:
            failed.append(e)

    threads = [threading.Thread(target=load) for _ in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join(120)
    assert not failed and len(found) == 4


@pytest.mark.parametrize("storage", ["uint8", "float32"])
def test_frozen_renders(mi_rgb, file, no_garbage_collection, storage):
    """Changes of parameters show; an emitter has to be rendered once before, as with ``bitmap``."""
    mi = mi_rgb
    bsdf = materials(lambda m: plugin(file, m, storage=storage))["principled"]
    lamp = {"type": "area", "radiance": plugin(file, "glow", storage=storage)}
    loaded = scene(mi, bsdf, lamp)
    params = mi.traverse(loaded)

    @dr.freeze
    def frozen(loaded, seed):
        return mi.render(loaded, spp=4, seed=seed)

    dr.eval(mi.render(loaded, spp=4))
    for step in range(4):
        if storage == "float32" and step == 2:
            key = next(k for k in params.keys() if k.endswith("tables.cascaded"))
            params[key] = params[key] * 0.5
            params.update()
            dr.eval(mi.render(loaded, spp=4))
        image = frozen(loaded, mi.UInt32(step)).numpy()
        expected = mi.render(loaded, spp=4, seed=mi.UInt32(step)).numpy()
        np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-5)


def test_textures_die_with_their_scene(mi_rgb, file, no_garbage_collection):
    mi = mi_rgb
    before = alive("NeuralImage")
    lamp = {"type": "area", "radiance": plugin(file, "glow")}
    loaded = scene(mi, materials(lambda m: plugin(file, m))["principled"], lamp)
    mi.render(loaded, spp=1)
    assert alive("NeuralImage") == before + 4
    del loaded
    assert alive("NeuralImage") == before


def test_unsupported_variants_and_leaks(file):
    """A sentence in a scalar variant; nothing is left of textures that were rendered and optimised."""
    check_process(plugin(file, storage="float32"), ("llvm_ad_rgb", "llvm_ad_spectral"))
