"""Codecs that learned textures are compared with: sane round trips, exact bytes, budgets kept, sentences for errors."""

import importlib.util
import itertools
import math
import sys

import numpy as np
import pytest

from mi_diffind.images.metrics import psnr
from mi_diffind.studies.baselines import codecs
from mi_diffind.studies.baselines.codecs import ASTC_BLOCKS, CodecError, Encoded

MODULES = {
    "astc": ("astc_encoder",),
    "bc7": ("ispc_texcomp", "texture2ddecoder"),
    **dict.fromkeys(("jpeg", "webp"), ()),
}
SIZES = [(1, 1), (7, 5), (1, 4096), (33, 70)]
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


def check(image, coded):
    assert isinstance(coded, Encoded)
    assert coded.image.shape == image.shape and coded.image.dtype == np.float32
    assert coded.image.min() >= 0 and coded.image.max() <= 1
    assert coded.nbytes > 0


@every_codec
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_channels(codec, channels):
    image = picture(96, 80, channels)
    coded = encode(codec, image)
    check(image, coded)
    assert psnr(image, coded.image) > (27 if codec == "webp" else 31)
    for c in range(channels):
        assert psnr(image[..., c], coded.image[..., c]) > 25  # the channels are in their order


@every_codec
@pytest.mark.parametrize("size", SIZES)
def test_sizes(codec, size):
    image = picture(*size)
    coded = encode(codec, image)
    check(image, coded)
    assert psnr(image, coded.image) > 22


@every_codec
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_constant(codec, channels):
    image = np.broadcast_to(np.float32([0.2, 0.5, 0.8, 0.4][:channels]), (13, 22, channels))
    coded = encode(codec, image, 1)
    limit = {"jpeg": 3, "webp": 4}.get(codec, 1) if channels > 2 else {"webp": 2}.get(codec, 1)
    assert np.abs(coded.image - image).max() <= (limit + 1e-3) / 255


@every_codec
def test_repeatable_and_input_untouched(codec):
    image = picture(20, 31)
    before = image.copy()
    first, second = encode(codec, image), encode(codec, image)
    assert np.array_equal(image, before)
    assert first.nbytes == second.nbytes and np.array_equal(first.image, second.image)


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
def test_astc_blocks():
    image = picture(120, 120)
    assert len(ASTC_BLOCKS) == 14 and ASTC_BLOCKS["4x4"] == 8 and ASTC_BLOCKS["10x5"] == 2.56
    found = [codecs.astc(image, block, "fast") for block in ASTC_BLOCKS]
    for (block, bits), coded in zip(ASTC_BLOCKS.items(), found, strict=True):
        assert coded.codec == f"ASTC {block}" and coded.nbytes == 120 * 120 * bits / 8
        assert coded.nbytes == codecs.astc_bytes(image.shape, block)
    errors = [psnr(image, coded.image) for coded in found]
    assert errors[0] > 35 and errors[-1] > 20
    assert all(b < a + 0.3 for a, b in itertools.pairwise(errors)) and errors[-1] < errors[0] - 8


@astc_only
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("block", ["4x4", "10x5", "12x12"])
@pytest.mark.parametrize("reduce", [1, 2])
def test_astc_bytes(size, block, reduce):
    w, h = map(int, block.split("x"))
    height, width = (math.ceil(n / reduce) for n in size)
    expected = 16 * math.ceil(width / w) * math.ceil(height / h)
    coded = codecs.astc(picture(*size, 1), block, reduce=reduce, **QUICK)
    assert coded.nbytes == codecs.astc_bytes(size, block, reduce) == expected
    assert coded.image.shape == (*size, 1)


@astc_only
def test_astc_quality():
    image = picture(96, 96)
    errors = [psnr(image, codecs.astc(image, "6x6", q).image) for q in ("fastest", "medium", "thorough")]
    assert errors[0] < errors[1] < errors[2]


@astc_only
def test_astc_two_channels_weigh_the_same():
    image = picture(96, 96, 2)
    one, other = (codecs.astc(i, "8x8", "medium").image for i in (image, image[..., ::-1]))
    assert abs(psnr(image, one) - psnr(image[..., ::-1], other)) < 0.5


@astc_only
@pytest.mark.parametrize("reduce", [1, 2])
def test_astc_normal(reduce):
    image = normal_map(90, 70)
    coded = codecs.astc(image, "5x5", "fast", normal=True, reduce=reduce)
    check(image, coded)
    assert " xy" in coded.codec and psnr(image, coded.image) > 25
    length = np.linalg.norm(2 * coded.image - 1, axis=-1)
    assert np.abs(length - 1).max() < 1e-5
    flat = np.broadcast_to(np.float32([0.5, 0.5, 1]), (9, 9, 3))
    assert np.abs(codecs.astc(flat, "8x8", normal=True, **QUICK).image - flat).max() <= 1 / 255


@every("bc7")
@pytest.mark.parametrize("size", SIZES)
def test_bc7_bytes(codec, size):
    assert codecs.bc7(picture(*size)).nbytes == 16 * math.ceil(size[0] / 4) * math.ceil(size[1] / 4)


@every("jpeg", "webp")
def test_files(codec):
    image = picture(120, 90)
    found = [getattr(codecs, codec)(image, q) for q in (5, 30, 60, 90)]
    for a, b in itertools.pairwise(found):
        assert a.nbytes < b.nbytes and psnr(image, a.image) < psnr(image, b.image)
    assert found[-1].codec == {"jpeg": "JPEG 90", "webp": "WebP 90"}[codec]
    pair = picture(40, 40, 2)
    single = [getattr(codecs, codec)(pair[..., c : c + 1], 50) for c in range(2)]
    both = getattr(codecs, codec)(pair, 50)
    assert both.nbytes == sum(e.nbytes for e in single)
    assert np.array_equal(both.image, np.concatenate([e.image for e in single], -1))


def test_too_long_for_webp():
    with pytest.raises(CodecError, match=r"^WebP cannot store 16384x1 texels, at most 16383 a side$"):
        codecs.webp(np.zeros((1, 16384, 1), np.float32), 50)


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


def test_at_bytes_bicubic():
    assert codecs.at_bytes("bicubic", picture(40, 40), 1200).codec == "bicubic 20x20"


@every("bc7")
def test_at_bytes_bc7(codec):
    assert codecs.at_bytes(codec, picture(16, 16), 1).nbytes == 256


def material():
    return {
        "base": np.repeat(picture(60, 72, 1), 3, -1),
        "normal": normal_map(60, 72),
        "rough": np.full((60, 72, 1), 0.5, np.float32),
    }


def squared(maps, coded):
    return sum(float(np.sum((maps[k] - e.image) ** 2, dtype=np.float64)) for k, e in coded.items())


@astc_only
def test_material():
    maps, cache = material(), {}
    options = {"quality": "fast", "choose": "fast", "reduces": (1, 2), "cache": cache}
    errors = []
    for n in (60 * 72 // 4, 60 * 72 // 2):
        best, total = codecs.astc_material(maps, n, **options)
        even, even_total = codecs.astc_material(maps, n, uniform=True, **options)
        assert total == sum(e.nbytes for e in best.values()) <= n and even_total <= n
        assert list(best) == list(even) == list(maps)
        for name, e in best.items():
            check(maps[name], e)
            assert e.codec.startswith("ASTC ")
        assert np.array_equal(best["base"].image[..., 0], best["base"].image[..., 2])
        settings = {e.codec.replace(" xy", "") for e in even.values()}
        assert len(settings) == 1
        errors.append(squared(maps, best))
        assert errors[-1] < squared(maps, even)
    assert errors[1] < errors[0]
    known = len(cache)
    again, _ = codecs.astc_material(maps, 60 * 72 // 2, **options)
    assert len(cache) == known and {k: e.codec for k, e in again.items()} == {k: e.codec for k, e in best.items()}
    with pytest.raises(CodecError, match=r"^ASTC cannot store base, normal, rough in 10 bytes$"):
        codecs.astc_material(maps, 10, **options)


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


@astc_only
def test_normals_without_z_where_that_is_better():
    normal = {"normal": normal_map(48, 48)}
    options = {"quality": "fast", "choose": "fast", "reduces": (1, 4)}
    errors = [
        squared(normal, codecs.astc_material(normal, 48 * 48 // 4, normals=names, **options)[0])
        for names in ((), ("normal",))
    ]
    assert errors[1] <= errors[0]


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
            codecs.astc_material(material(), 1000)


@every_codec
def test_available(codec):
    assert codec in codecs.available()
