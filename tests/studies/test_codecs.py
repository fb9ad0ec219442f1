"""Codecs: order of channels, exact bytes, memory budgets that are kept, sentences for errors."""

import importlib.util
import itertools
import math
import sys

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mi_diffind.images.metrics import psnr
from mi_diffind.studies.baselines import codecs
from mi_diffind.studies.baselines.codecs import ASTC_BLOCKS, CodecError

MODULES = {"astc": ("astc_encoder",), "bc7": ("ispc_texcomp", "texture2ddecoder")}
QUICK = {"quality": "fastest"}


def needs(codec):
    missing = [m for m in MODULES.get(codec, ()) if importlib.util.find_spec(m) is None]
    return pytest.mark.skipif(bool(missing), reason=f"{codec} needs {', '.join(missing)}")


def every(*names):
    return pytest.mark.parametrize("codec", [pytest.param(n, marks=needs(n)) for n in names])


every_codec = every("astc", "bc7", "jpeg", "webp", "bicubic")


astc_only = needs("astc")


def picture(height, width, channels=3):
    """Waves of all directions with a little noise, the same for the same size."""
    y, x = np.mgrid[:height, :width] / 64
    rng = np.random.default_rng(height * width)
    waves = [0.5 + 0.4 * np.sin(2 * np.pi * (a * x + b * y)) for a, b in [(1, 0.3), (0.2, 1.1), (0.7, -0.9), (2, 1)]]
    image = np.stack(waves[:channels], -1) + rng.normal(0, 0.01, (height, width, channels))
    return np.clip(image, 0, 1).astype(np.float32)


def normal_map(height, width):
    xy = 0.6 * (2 * picture(height, width, 2) - 1)
    return np.concatenate([xy, np.sqrt(1 - np.sum(xy**2, -1, keepdims=True))], -1).astype(np.float32) / 2 + 0.5


def encode(codec, image, nbytes=None):
    """By the codec named, at a high quality."""
    if codec == "astc":
        return codecs.astc(image, "4x4", **QUICK)
    if codec == "bicubic":
        return codecs.bicubic(image, image.size if nbytes is None else nbytes)
    return codecs.bc7(image) if codec == "bc7" else getattr(codecs, codec)(image, 95)


@every_codec
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_channels(codec, channels):
    image = picture(96, 80, channels)
    coded = encode(codec, image)
    assert coded.image.shape == image.shape and coded.image.min() >= 0 and coded.image.max() <= 1 and coded.nbytes > 0
    assert psnr(image, coded.image) > (27 if codec == "webp" else 31)
    for c in range(channels):
        assert psnr(image[..., c], coded.image[..., c]) > 25  # the channels are in their order


@every_codec
@pytest.mark.parametrize(
    ("image", "match"),
    [
        (np.zeros((4, 4)), r"found the shape \(4, 4\)"),
        (np.zeros((4, 4, 5)), "1 to 4 channels"),
        (np.zeros((0, 4, 3)), "found the shape"),
        (np.full((4, 4, 1), 1.5), "values from 1.5 to 1.5, 0 to 1 is needed"),
        (np.full((4, 4, 1), np.nan), "values from nan"),
        (np.full((4, 4, 1), -0.1), "0 to 1 is needed"),
    ],
)
def test_refused(codec, image, match):
    with pytest.raises(ValueError, match=match):
        encode(codec, image.astype(np.float32))


@astc_only
@pytest.mark.parametrize("size", [(1, 1), (7, 5), (33, 70)])
@pytest.mark.parametrize("block, reduce", [("4x4", 1), ("10x5", 2)])
def test_astc_bytes(size, block, reduce):
    w, h = map(int, block.split("x"))
    height, width = (math.ceil(n / reduce) for n in size)
    expected = 16 * math.ceil(width / w) * math.ceil(height / h)
    coded = codecs.astc(picture(*size, 1), block, reduce=reduce, **QUICK)
    assert coded.nbytes == codecs.astc_bytes(size, block, reduce) == expected
    assert coded.image.shape == (*size, 1)


@astc_only
@pytest.mark.parametrize("reduce", [1, 2])
def test_astc_normal(reduce):
    image = normal_map(90, 70)
    coded = codecs.astc(image, "5x5", "fast", normal=True, reduce=reduce)
    assert " xy" in coded.codec and psnr(image, coded.image) > 25
    length = np.linalg.norm(2 * coded.image - 1, axis=-1)
    assert np.abs(length - 1).max() < 1e-5
    flat = np.broadcast_to(np.float32([0.5, 0.5, 1]), (9, 9, 3))
    assert np.abs(codecs.astc(flat, "8x8", normal=True, **QUICK).image - flat).max() <= 1 / 255


def test_bicubic():
    image = picture(120, 80)
    exact = codecs.bicubic(image, image.size)
    assert exact.nbytes == image.size and np.abs(exact.image - image).max() <= 0.5001 / 255
    found = [codecs.bicubic(image, n) for n in (300, 1200, 4800, 14400)]
    for (a, b), n in zip(itertools.pairwise(found), (300, 1200, 4800), strict=True):
        assert 0.9 * n < a.nbytes <= n and psnr(image, a.image) < psnr(image, b.image)
    assert codecs.bicubic(image, 7200).codec == "bicubic 40x60" and codecs.bicubic(image, 7199).codec != "bicubic 40x60"
    assert codecs.bicubic(image, 0).nbytes == 3


@every("jpeg", "webp")
@pytest.mark.parametrize("channels", [1, 3])
def test_at_bytes_files(codec, channels):
    image = picture(90, 70, channels)
    for n in (1200, 2500):
        found = codecs.at_bytes(codec, image, n)
        assert 0.6 * n < found.nbytes <= n
        better = getattr(codecs, codec)(image, int(found.codec.split()[1]) + 1)
        assert better.nbytes > n
    lowest = codecs.at_bytes(codec, image, 10)
    assert lowest.nbytes > 10 and lowest.codec.split()[1] == {"jpeg": "1", "webp": "0"}[codec]
    highest = codecs.at_bytes(codec, image, 10**6)
    assert highest.codec.split()[1] == "100"


def squared(maps, coded):
    return sum(float(np.sum((maps[k] - e.image) ** 2, dtype=np.float64)) for k, e in coded.items())


@astc_only
def test_material_is_optimal():
    """No other choice of block sizes does better."""
    maps = {"a": picture(60, 60, 1), "b": picture(48, 48, 1)}
    n = 1200
    options = {"quality": "fast", "choose": "fast", "reduces": (1,)}
    found, total = codecs.astc_material(maps, n, **options)
    coded = {k: [codecs.astc(image, b, "fast") for b in ASTC_BLOCKS] for k, image in maps.items()}
    fitting = [p for p in itertools.product(*coded.values()) if sum(e.nbytes for e in p) <= n]
    rounded = {k: np.rint(image * 255) / 255 for k, image in maps.items()}
    least = min(squared(rounded, dict(zip(maps, p, strict=True))) for p in fitting)
    assert total <= n and squared(rounded, found) == pytest.approx(least, rel=1e-4)


@pytest.mark.parametrize(
    ("codec", "module", "package"),
    [
        ("astc", "astc_encoder", "astc-encoder-py"),
        ("bc7", "ispc_texcomp", "ispc_texcomp"),
        ("jpeg", "PIL.Image", "pillow"),
        ("webp", "PIL._webp", "pillow"),
        ("bicubic", "PIL.Image", "pillow"),
    ],
)
def test_missing_package(monkeypatch, codec, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    assert codec not in codecs.available()
    with pytest.raises(CodecError, match=rf"needs the package {package}, .*: pip install {package}$"):
        encode(codec, picture(8, 8))
    if codec == "astc":
        assert {"jpeg", "webp", "bicubic"} <= set(codecs.available())
        with pytest.raises(CodecError, match="astc-encoder-py"):
            codecs.astc_material({"base": picture(8, 8)}, 1000)


def smooth(height, width, channels, seed=0):
    random = np.random.default_rng(seed).random((height, width, channels))
    values = gaussian_filter(random, (2, 2, 0), mode="wrap")
    values = (values - values.min()) / (values.max() - values.min())
    return np.rint(255 * values).astype(np.uint8)


@astc_only
def test_astc_with_mip_maps():
    maps = {"albedo": [], "ao": []}
    for i in range(6):
        maps["albedo"].append(smooth(32 >> i, 32 >> i, 3).astype(np.float32) / 255 if i < 5 else np.ones((1, 1, 3)))
        maps["ao"].append(smooth(32 >> i, 32 >> i, 1, 1).astype(np.float32) / 255 if i < 5 else np.ones((1, 1, 1)))
    options = {"quality": "fast", "choose": "fast", "cache": {}}
    errors = []
    for nbytes in (3000, 1200, 400):
        found, taken = codecs.astc_levels(maps, nbytes, **options)
        assert taken == sum(e.nbytes for e in found.values()) <= nbytes
        for name, e in found.items():
            block = e.codec.split()[1]
            drop = int(e.codec.split("level ")[1].split()[0]) if "level" in e.codec else 0
            assert e.nbytes == sum(codecs.astc_bytes(level.shape, block) for level in maps[name][drop:])
            assert [level.shape for level in e.levels] == [level.shape for level in maps[name]]
            alone = codecs.astc(maps[name][drop + 1], block, "fast")
            np.testing.assert_array_equal(e.levels[drop + 1], alone.image)
        errors.append(sum(float(((e.levels[0] - maps[n][0]) ** 2).sum()) for n, e in found.items()))
    assert errors == sorted(errors) and errors[0] < errors[-1]
    assert "level" in "".join(e.codec for e in found.values())  # so little takes less than all levels
    with pytest.raises(codecs.CodecError, match="100 bytes"):
        codecs.astc_levels(maps, 100, **options)
