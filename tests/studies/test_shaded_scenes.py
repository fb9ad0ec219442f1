"""Renders of a material from near to far: errors without noise, parts of the floor, and maps in place of a file."""

import drjit as dr
import numpy as np
import pytest
from arrays import numpy_of

from mi_diffind.arrays.tables import save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.measure.renders import directions
from mi_diffind.studies import shaded_scenes
from mi_diffind.studies.baselines import normals
from mi_diffind.studies.shaded_scenes import VIEWS, FloorScenes, RenderedFile, SceneQuality
from mi_diffind.tasks import texture
from mi_diffind.tasks.texture import training
from mi_diffind.tasks.texture.appearance import reader
from mi_diffind.tasks.texture.compressed import CompressedTexture, to_table
from mi_diffind.tasks.texture.fit import find_size
from mi_diffind.tasks.texture.surface import material_effects

QUALITY = SceneQuality((48, 27), 512, 64, 1)


@pytest.fixture(scope="module")
def bumpy():
    """A source of 32 × 32 texels: a rough surface with slopes, without metal."""
    rng = np.random.default_rng(3)
    n = np.concatenate([rng.normal(0, 0.15, (32, 32, 2)), np.ones((32, 32, 1))], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    maps = {"albedo": rng.random((32, 32, 3)), "normal": 0.5 + 0.5 * n, "roughness": 0.4 + 0.2 * rng.random((32, 32))}
    return from_arrays({name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()})


@pytest.fixture
def file(bumpy, mi_rgb, tmp_path):
    from mi_diffind.fitting import task

    fitted = task.fit("texture", bumpy, compression=2, steps=1, shading="off", progress=False)
    fitted.save(tmp_path / "m.npz")
    return tmp_path / "m.npz"


def test_errors_without_noise(rng):
    """The noise of both pairs of halves is not counted."""
    truth = np.full((2, 300, 300, 3), 0.4)
    noise = rng.normal(0, 0.05, (2, *truth.shape))
    assert shaded_scenes.psnr(0.5 * truth, 0.5 * (truth + 0.01), 2.0) == pytest.approx(40)
    assert shaded_scenes.psnr(truth + noise[0], truth + 0.01 + noise[1], 1.0) == pytest.approx(40, abs=1)


def test_brightness():
    """The mean of values up to 16: one brighter pixel counts as 16."""
    truth = np.full((2, 10, 10, 3), 0.5)
    images = 1.1 * truth
    assert shaded_scenes.brightness(truth, images, 2.0) == pytest.approx(1.1)
    images[:, 0, 0] = 1e4
    assert shaded_scenes.brightness(truth, images, 2.0) == pytest.approx(1.1 * 0.99 + 0.16)


def test_parts_of_the_floor(bumpy, mi_rgb):
    """Near lies below far in the picture, and no part is empty."""
    scenes = FloorScenes(bumpy, "repeat", SceneQuality((48, 27), 2, 2, 3))
    for view in VIEWS:
        _, exposure, masks = scenes.truth("sun", view)
        heights = [np.flatnonzero(masks[part].any(axis=1)).mean() for part in ("near", "middle", "far")]
        assert heights[0] > heights[1] > heights[2] and exposure > 0
        assert (masks["near"].astype(int) + masks["middle"] + masks["far"] <= masks["whole"]).all()


def test_lean_in_a_material(bumpy, mi_rgb, tmp_path):
    """The plugin with LEAN's maps in place of those of a file, against the shading of the same maps."""
    mi, layout = mi_rgb, training.source_layout(bumpy, texture.PRESETS["ours"])
    pyramid = Pyramid.from_source(bumpy, layout, array_module(mi.variant()), ("repeat", "repeat"))
    lean, recipe = normals.lean_pyramid(pyramid), texture.PRESETS["ours"]
    size = find_size(bumpy, lean, bumpy.nbytes / 2, recipe, dict.fromkeys(("structure", "skip", "cascaded")))
    net = training.stored_form(training.build_problem(bumpy, size, recipe, lean).net)
    save_table(tmp_path / "lean.npz", to_table(CompressedTexture(lean.layout, net), {}))
    maps = normals.ReadMaps(lean)
    bsdf = mi.load_dict(RenderedFile(tmp_path / "lean.npz", maps).material(bumpy, "repeat")((1, 1)))
    bsdf.maps.image = maps
    si, wo, _, _ = directions(256)
    for level in (0, 3):
        side = 2.0**level / 32
        si.duv_dx, si.duv_dy = mi.Vector2f(side, 0), mi.Vector2f(0, side)
        value = numpy_of(np.pi * bsdf.eval(mi.BSDFContext(), si, wo))
        lanes = dr.opaque(mi.Float, level, 256), mi.Vector3f(si.wi), mi.Vector3f(wo)
        expected = numpy_of(reader(maps, material_effects(layout)[0])(si.uv.x, si.uv.y, *lanes))
        np.testing.assert_allclose(value, expected, rtol=2e-3, atol=1e-4)
        plain = numpy_of(reader(pyramid, material_effects(layout)[0])(si.uv.x, si.uv.y, *lanes))
        assert np.abs(expected - plain).max() > 0.01


def test_exact_maps_approach_the_truth(bumpy, file, mi_rgb):
    """Uncompressed maps in place of the file's, at level 0 and without its footprints, are the truth."""
    layout = training.source_layout(bumpy, texture.PRESETS["ours"])
    pyramid = Pyramid.from_source(bumpy, layout, array_module(mi_rgb.variant()), ("repeat", "repeat"))
    scenes = FloorScenes(bumpy, "repeat", QUALITY)
    level_0, footprints = (
        scenes.measure(RenderedFile(file, normals.ReadMaps(pyramid, [bias]))) for bias in (-20.0, 0.0)
    )
    for lights in shaded_scenes.LIGHTS:
        exact = level_0[lights]["4"]  # the read of a single sample is that of the pixel's centre
        assert exact["psnr_db"][0] > max(35, 5 + footprints[lights]["1"]["psnr_db"][0])
        for ratio in exact["brightness"][0].values():
            assert ratio == pytest.approx(1, abs=0.02)
