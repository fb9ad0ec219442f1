"""Textures without a training, and textures whose constant channels have arrays."""

import drjit as dr
import numpy as np
import pytest

import mi_diffind as md
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.texture import TASK
from mi_diffind.tasks.texture.arrays import BLANK_LADDER, LADDER, SMOOTH_LADDER, ladder

SIDE = 32

BLANK = {
    "albedo": np.full((SIDE, SIDE, 3), 128, np.uint8),
    "roughness": np.full((SIDE, SIDE, 1), 77, np.uint8),
    "normal": np.tile(np.uint8([128, 128, 255]), (SIDE, SIDE, 1)),
}


def untrained(maps=BLANK, **options):
    return md.fit("texture", maps, steps=0, compression=2, progress=False, **options)


@pytest.fixture(scope="module")
def blank():
    return untrained()


def test_constant_maps_have_arrays(blank):
    """Each channel has entries of its own, but the third of a normal; values are those of the maps."""
    maps = {m["name"]: m["where"] for m in blank.table.settings["layout"]["maps"]}
    assert maps == {"albedo": [0, 1, 2], "roughness": [3], "normal": [4, 5, "z"]}
    assert blank.table.arrays["cascaded"].shape[-1] == 6 and blank.result.steps == 0
    assert "untrained" in blank.summary()[0] and "not trained for its shading: --steps is 0" in blank.lines
    for name, values in blank.model.decode().items():
        np.testing.assert_allclose(values, BLANK[name] / 255, atol=3e-3)
    assert 0.9 * blank.figures["source_bytes"] / 2 <= blank.table.nbytes <= blank.figures["source_bytes"] / 2


def test_every_array_can_be_optimised(blank):
    """Adam finds maps that vary from arrays of constants, and changes each array."""
    types, rng = array_module("llvm"), np.random.default_rng(0)
    image = TASK.model(blank.table, types.TensorXf, "float32").image
    before = {name: array.numpy() for name, array in image.arrays.items()}
    optimizer = dr.opt.Adam(lr=0.03, params={n: dr.detach(a.data) for n, a in image.arrays.items()})
    losses = []
    for _ in range(60):
        for name, array in image.arrays.items():
            array.data = optimizer[name]
        u, v, level = (types.Float(x.astype(np.float32)) for x in rng.random((3, 1024)))
        target = [0.5 + 0.3 * dr.sin(2 * np.pi * u), 0.5 + 0.3 * dr.cos(2 * np.pi * v)]
        channels = image.filtered(u, v, 4 * level)
        loss = dr.mean(dr.square(channels[0] - target[0]) + dr.square(channels[3] - target[1]))
        dr.backward(loss)
        optimizer.step()
        losses.append(loss[0])
    assert losses[-1] < 0.1 * losses[0]
    assert all(np.abs(array.numpy() - before[name]).max() > 0.01 for name, array in image.arrays.items())


def test_a_start_of_maps_with_content():
    """The start of a training, which is a smaller picture already; the same call, the same bytes."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE * 2 * np.pi
    wave = np.rint(127.5 + 100 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)).astype(np.uint8)
    one, two = (untrained({**BLANK, "albedo": wave}) for _ in range(2))
    assert one.table.measured["psnr_albedo_db"] > 25 and one.table.settings["layout"]["maps"][1]["where"] == [3]
    for name, array in one.table.arrays.items():
        np.testing.assert_array_equal(array.entries, two.table.arrays[name].entries)
    grey = untrained({"albedo": wave[..., :1].repeat(3, axis=2)})
    assert grey.table.settings["layout"]["maps"][0]["where"] == [0, 1, 2], "equal channels may become different"


def test_separate_channels_are_trained():
    wave = np.rint(127.5 + 100 * np.sin(np.arange(SIDE) / 5)).astype(np.uint8)
    maps = {"albedo": np.tile(wave[:, None, None], (1, SIDE, 1)), "metallic": np.zeros((SIDE, SIDE, 1), np.uint8)}
    options = {"shading": "off", "steps": 2, "batch": 256, "progress": False, "compression": 1}
    layouts = [md.fit("texture", maps, separate=s, **options).table.settings["layout"] for s in (False, True)]
    assert [layout["maps"][1]["where"] for layout in layouts] == [[["constant", 0.0]], [1]]


def test_what_needs_a_training():
    for options in ({"psnr": 30}, {"shading": "on"}):
        with pytest.raises(UsageError, match="--steps: found 0, but --psnr and --shading on need a training"):
            md.fit("texture", BLANK, steps=0, progress=False, **options)
    with pytest.raises(UsageError, match="--checkpoint: nothing is trained with --steps 0"):
        md.fit("texture", BLANK, steps=0, checkpoint="c.npz")
    with pytest.raises(Exception, match="steps: found 0, a whole number from 1"):
        md.fit("image", BLANK, steps=0, progress=False)
    assert [ladder(db) for db in (20, 50, 120)] == [LADDER, SMOOTH_LADDER, BLANK_LADDER]


def test_the_smallest_of_a_quality():
    """A training of full length reaches the quality; the stage for shading, which gives some of it up, is left out."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE * 2 * np.pi
    wave = np.rint(127.5 + 100 * np.stack([np.sin(3 * x), np.cos(2 * y), np.sin(x + y)], axis=-1)).astype(np.uint8)
    fitted = md.fit("texture", {"albedo": wave}, psnr=24, steps=16, batch=2048, progress=False)
    tried = fitted.figures["tried"]
    assert fitted.table.measured["psnr_db"] >= 24 and fitted.figures["compression_asked"] is None
    assert fitted.table.nbytes == min(t["bytes"] for t in tried if t["psnr_db"] >= 24)
    assert sum(line.startswith("tried ") for line in fitted.lines) == len(tried)
    with pytest.raises(UsageError, match="--psnr: chooses the arrays: leave out --skip"):
        md.fit("texture", {"albedo": wave}, psnr=24, skip=2)
    with pytest.raises(UsageError, match="--psnr: asks for the values of the maps"):
        md.fit("texture", BLANK, psnr=24, shading="on")
