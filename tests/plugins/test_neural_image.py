"""The texture ``neural_image``: maps of every kind, arrays, spectra; see ``test_texture_contract``."""

import itertools
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from scipy.ndimage import map_coordinates
from texture_scenes import hits, refused
from variants import set_variant

from mi_diffind.arrays.tables import StoredArray, Table, save_table
from mi_diffind.maps.layout import Layout, MapLayout
from mi_diffind.plugins.support import textures
from mi_diffind.tasks.image import TASK
from mi_diffind.tasks.image.arrays import CompressedImage

WIDTH, HEIGHT = 12, 10

#: One map of each kind that a material may have. ``glow`` is of high dynamic range, ``flat`` constant.
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
METHODS = ("eval", "eval_1", "eval_3", "eval_1_grad")


def make(path, layout=LAYOUT, border=("repeat", "clamp"), coarse=False):
    """A file of random arrays, the primary of 6 bits; ``coarse``: one of its two channels is in an array of its own."""
    rng, table = np.random.default_rng(3), Table("image", {}, settings={"layout": layout.to_json()})
    arrays = {
        "primary": rng.integers(0, 63, (8, 9, 2), np.uint8, endpoint=True),
        "cascaded": rng.integers(0, 255, (4, 4, layout.stored), np.uint8, endpoint=True),
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


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return make(tmp_path_factory.mktemp("images") / "material.npz")


def plugin(file, channels="albedo", **more):
    return {"type": "neural_image", "filename": file, "channels": channels, **more}


def counterpart(mi, image, name, **more):
    """``bitmap`` with the image that the file decodes to."""
    bitmap = mi.Bitmap(np.ascontiguousarray(image))
    bitmap.set_srgb_gamma(LAYOUT[name].color_space == "srgb")
    raw = {"raw": True} if name in ("normal", "roughness", "metallic") else {}
    return {"type": "bitmap", "bitmap": bitmap, "format": "variant", **raw, **more}


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


def test_equals_a_bitmap_of_what_it_decodes_to(mi_any, file, rng):
    """Every map in every method at texel centres, slopes between them; where ``bitmap`` has no answer there is none."""
    mi = mi_any
    images = CompressedImage.from_table(TASK.load(file), mi.TensorXf).decode()
    ours = {name: mi.load_dict(plugin(file, name)) for name in USABLE}
    theirs = {name: mi.load_dict(counterpart(mi, images[name], name)) for name in USABLE}
    centres = hits(mi, [(rng.integers(0, size, 400) + 0.5) / size for size in (WIDTH, HEIGHT)])
    between = hits(mi, rng.uniform(0.1, 0.9, (2, 400)))
    found, truth = (values_of(t, centres, METHODS[:3]) | values_of(t, between, METHODS[3:]) for t in (ours, theirs))
    for (name, method), b in truth.items():
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
        largest = dr.max(mi.traverse(mi.load_dict(counterpart(mi, images[name], name, raw=True)))["data"].array)[0]
        if not (a.raw or LAYOUT[name].color_space == "linear"):
            largest = dr.srgb_to_linear(largest)
        assert a.max() >= float(largest) * (1 - 1e-5), name


@pytest.mark.parametrize("border, coarse", [(("repeat", "clamp"), False), (("clamp", "repeat"), True)])
def test_reads_as_an_independent_implementation_does(mi, tmp_path, rng, border, coarse):
    """Anywhere, by SciPy in double precision; of one primary array and of two."""
    path = make(tmp_path / "a.npz", border=border, coarse=coarse)
    arrays = TASK.load(path).arrays
    u, v = rng.random((2, 3000)).astype(np.float32).astype(np.float64)
    pointer = []
    for entries in (array.entries / 63 for name, array in arrays.items() if name != "cascaded"):
        x = [t * (n if b == "repeat" else n - 1) for t, n, b in zip((v, u), entries.shape, border, strict=False)]
        for axis in (axis for axis, b in enumerate(border) if b == "repeat"):
            entries = np.concatenate([entries, np.take(entries, [0], axis)], axis)
        pointer += [map_coordinates(channel, x, order=1) * 3 for channel in np.moveaxis(entries, -1, 0)]
    stored = [map_coordinates(arrays["cascaded"].entries[..., k] / 255, pointer, order=1) for k in range(7)]
    si = hits(mi, [u, v])
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


def test_upsampling_is_mitsubas(rng):
    """The same spectra as from Mitsuba's coefficients, for all colours."""
    mi, n = set_variant("llvm_ad_spectral"), 300
    colours = rng.random((3, n)) ** rng.choice([0.3, 1, 6], n)
    special = [(0, 0, 0), (1, 1, 1), (0.5, 0.5, 0.5), (1, 0, 0), (0, 1, 1), (1, 1, 0), (0, 0, 1e-4), (2, -1, 0.5)]
    special += [(1e-7, 2e-7, 0), (0.3, 0.3, 0.1), (0.1, 0.3, 0.3), (0.3, 0.1, 0.3), (1, 1, 0.999999)]
    colours = np.concatenate([colours, np.transpose(special)], axis=1).astype(np.float32)
    wavelengths = np.float32([380, 470, 560, 700])
    rgb = [mi.Float(aligned(c)) for c in colours]
    found = textures.upsampled_spectrum(rgb, mi.UnpolarizedSpectrum(*[float(w) for w in wavelengths]))
    expected = []
    for c in colours.T:
        c0, c1, c2 = np.array(mi.srgb_model_fetch([float(v) for v in c]), np.float64)
        x = (c0 * wavelengths + c1) * wavelengths + c2
        expected.append(0.5 + 0.5 * x / np.sqrt(1 + x * x))
    error = np.abs(found.numpy() - np.transpose(expected))
    assert error.max() < 2e-3 and error.mean() < 1e-5  # 0 and 1 are 1/8192 off in theirs


def test_maps_of_other_places_are_not_confused(mi, file, rng):
    forms = [{}, {"to_uv": mi.ScalarTransform4f().scale(2)}, {"wrap_mode": "clamp"}, {"storage": "float32"}]
    si = hits(mi, rng.uniform(-1, 2, (2, 200)))
    alone = [mi.load_dict(plugin(file, **f)).eval(si).numpy() for f in forms]
    textures = [mi.load_dict(plugin(file, **f)) for f in forms]
    together = [t.eval(si) for t in textures]
    dr.eval(together)
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_allclose(a, b.numpy(), atol=1e-6)


def test_several_maps_and_none_named(mi, tmp_path):
    path = make(tmp_path / "a.npz", replace(LAYOUT, maps=MAPS[1:]))
    assert '"pair" has 2 channels, a texture has 1 or 3' in refused(mi, plugin(path, "pair"))
    with pytest.raises(RuntimeError, match="not given, and the file holds several maps: normal, roughness"):
        mi.load_dict({"type": "neural_image", "filename": path})
