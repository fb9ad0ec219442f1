"""Codecs: order of channels, exact bytes, memory budgets that are kept, the best choice of block sizes."""

import importlib.util
import itertools
import sys

import numpy as np
import pytest

from mi_diffind.core.errors import UsageError
from mi_diffind.images.metrics import psnr
from mi_diffind.studies.baselines import codecs
from mi_diffind.studies.baselines.codecs import ASTC_BLOCKS

MODULES = {"astc": ("astc_encoder",), "bc7": ("ispc_texcomp", "texture2ddecoder")}


def needs(codec):
    missing = [m for m in MODULES.get(codec, ()) if importlib.util.find_spec(m) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{codec} needs {', '.join(missing)}")


def picture(height, width, channels=3):
    """Return waves of all directions with a little noise, the same for the same size."""
    y, x = np.mgrid[:height, :width] / 64
    rng = np.random.default_rng(height * width)
    waves = [0.5 + 0.4 * np.sin(2 * np.pi * (a * x + b * y)) for a, b in [(1, 0.3), (0.2, 1.1), (0.7, -0.9), (2, 1)]]
    image = np.stack(waves[:channels], -1) + rng.normal(0, 0.01, (height, width, channels))
    return np.clip(image, 0, 1).astype(np.float32)


def encode(codec, image):
    if codec == "astc":
        return codecs.astc(image, "4x4", "fastest")
    return codecs.bc7(image) if codec == "bc7" else codecs.image_file(codec, image, 10**6)


@pytest.mark.parametrize("codec", [pytest.param(n, marks=needs(n)) for n in codecs.TITLES])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_channels(codec, channels):
    image = picture(96, 80, channels)
    coded = encode(codec, image)
    assert coded.image.shape == image.shape and coded.image.min() >= 0 and coded.image.max() <= 1 and coded.nbytes > 0
    assert psnr(image, coded.image) > (27 if codec == "webp" else 31)
    for c in range(channels):
        assert psnr(image[..., c], coded.image[..., c]) > 25  # the channels are in their order


@needs("astc")
def test_astc_normal():
    """Only x and y are stored, lengths are 1, and the blocks are those that fit into the rounded-up size."""
    xy = 0.6 * (2 * picture(90, 70, 2) - 1)
    image = np.concatenate([xy, np.sqrt(1 - np.sum(xy**2, -1, keepdims=True))], -1).astype(np.float32) / 2 + 0.5
    coded = codecs.astc(image, "8x5", "fast", normal=True)
    assert " xy" in coded.codec and psnr(image, coded.image) > 25
    assert coded.nbytes == codecs.astc_bytes(image.shape, "8x5") == 16 * 9 * 18
    assert np.abs(np.linalg.norm(2 * coded.image - 1, axis=-1) - 1).max() < 1e-5


@pytest.mark.parametrize("codec", ["jpeg", "webp"])
@pytest.mark.parametrize("channels", [1, 3])
def test_files_in_bytes(codec, channels):
    image = picture(90, 70, channels)
    found = [codecs.image_file(codec, image, n) for n in (10, 1200, 2500, 10**6)]
    assert found[0].nbytes > 10 and found[0].codec.split()[1] == {"jpeg": "1", "webp": "0"}[codec]
    assert 700 < found[1].nbytes <= 1200 < found[2].nbytes <= 2500 and found[3].codec.split()[1] == "100"
    errors = [psnr(image, e.image) for e in found]
    assert errors == sorted(errors)


@needs("astc")
def test_material_is_optimal():
    """No other choice of block sizes does better."""
    maps = {"a": [picture(60, 60, 1)], "b": [picture(48, 48, 1)]}
    found, total = codecs.astc_levels(maps, 1200, "fast", mip_maps=False)
    coded = {k: [codecs.astc(image, b, "fast") for b in ASTC_BLOCKS] for k, (image,) in maps.items()}
    fitting = [p for p in itertools.product(*coded.values()) if sum(e.nbytes for e in p) <= 1200]
    rounded = {k: np.rint(image * 255) / 255 for k, (image,) in maps.items()}

    def squared(choice):
        return sum(float(np.sum((rounded[k] - e.image) ** 2, dtype=np.float64)) for k, e in choice.items())

    least = min(squared(dict(zip(maps, p, strict=True))) for p in fitting)
    assert total <= 1200 and squared(found) == pytest.approx(least, rel=1e-4)


@needs("astc")
def test_astc_with_mip_maps():
    """All levels from the first stored one count; finer ones are scaled up; fewer bytes are worse."""
    maps = {name: [picture(32 >> i, 32 >> i, c) for i in range(6)] for name, c in (("albedo", 3), ("ao", 1))}
    errors, cache = [], {}
    for nbytes in (3000, 1200, 400):
        found, taken = codecs.astc_levels(maps, nbytes, "fast", cache=cache)
        assert taken == sum(e.nbytes for e in found.values()) <= nbytes
        for name, e in found.items():
            block = e.codec.split()[1]
            drop = int(e.codec.split("level ")[1].split()[0]) if "level" in e.codec else 0
            assert e.nbytes == sum(codecs.astc_bytes(level.shape, block) for level in maps[name][drop:])
            assert [level.shape for level in e.levels] == [level.shape for level in maps[name]]
            alone = codecs.astc(maps[name][drop + 1], block, "fast")
            np.testing.assert_array_equal(e.levels[drop + 1], alone.image)
        errors.append(sum(float(((e.image - maps[n][0]) ** 2).sum()) for n, e in found.items()))
    assert errors == sorted(errors) and errors[0] < errors[-1]
    with pytest.raises(UsageError, match="100 bytes"):
        codecs.astc_levels(maps, 100, "fast", cache=cache)


@pytest.mark.parametrize(("codec", "module", "package"), [
    ("astc", "astc_encoder", "astc-encoder-py"), ("bc7", "ispc_texcomp", "ispc_texcomp"),
])  # fmt: skip
def test_missing_package(monkeypatch, codec, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    assert codec not in codecs.available() and {"jpeg", "webp"} <= set(codecs.available())
    assert any(package in note for note in codecs.install_notes([codec]))
