"""Image codecs that learned textures are compared with: thin layers over maintained packages, each of them optional.

An image is float32, ``(height, width, channels)`` with 1 to 4 channels and values in [0, 1], and is rounded to 8 bits
before it is encoded. Decoded values are the stored ones, without any transfer function; errors are meant to be measured
on them. An image whose sides are no multiples of the block size is padded by repeating the edge and cropped afterwards;
padded blocks count. All functions raise ``ValueError`` for other images and :class:`CodecError` for a missing package.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...arrays.budget import Budget
from ...core.errors import DiffindError, missing_package

#: Block size of ASTC in 2D, width × height, finest first → bits per texel.
ASTC_BLOCKS = {
    f"{w}x{h}": 128 / (w * h)
    for w, h in (
        *((4, 4), (5, 4), (5, 5), (6, 5), (6, 6), (8, 5), (8, 6)),
        *((10, 5), (10, 6), (8, 8), (10, 8), (10, 10), (12, 10), (12, 12)),
    )
}

#: Codec → its packages, each as a distribution and a module.
_PACKAGES = {
    "astc": (("astc-encoder-py", "astc_encoder"),),
    "bc7": (("ispc_texcomp", "ispc_texcomp"), ("texture2ddecoder", "texture2ddecoder")),
    "jpeg": (("pillow", "PIL.Image"),),
    "webp": (("pillow", "PIL.Image"), ("pillow", "PIL._webp")),
    "bicubic": (("pillow", "PIL.Image"),),
}
#: Codec → its name in notes and legends.
TITLES = {"astc": "ASTC", "bc7": "BC7", "jpeg": "JPEG", "webp": "WebP", "bicubic": "bicubic scaling"}

#: File format → its longest side, its qualities, and the options that :func:`at_bytes` tries.
_FILES = {
    "jpeg": (65535, range(1, 101), ({"subsampling": "4:4:4"}, {"subsampling": "4:2:0"})),
    "webp": (16383, range(0, 101), ({},)),
}


class CodecError(DiffindError, RuntimeError):
    """A codec that is not installed or cannot store an image; the message is one sentence."""


@dataclass
class Encoded:
    """Result of encoding and decoding an image with ``codec``, for example ``"ASTC 8x8"``.

    ``nbytes`` counts the payload of blocks or samples, or whole files; ``image`` is decoded, float32 in [0, 1], of the
    input's shape.
    """

    codec: str
    nbytes: int
    image: np.ndarray


def available() -> tuple[str, ...]:
    """Return the codecs whose packages are installed, of ``astc``, ``bc7``, ``jpeg``, ``webp``, ``bicubic``."""
    names = []
    for codec in _PACKAGES:
        with contextlib.suppress(CodecError):
            _modules(codec)
            names.append(codec)
    return tuple(names)


def install_notes(codecs: Iterable[str] = tuple(_PACKAGES)) -> list[str]:
    """Return a note, in a list, about those of ``codecs`` that are not installed; an empty list if all are."""
    missing = [codec for codec in codecs if codec not in available()]
    packages = dict.fromkeys(package for codec in missing for package, _ in _PACKAGES[codec])
    titles = ", ".join(TITLES[codec] for codec in missing)
    return [f"Left out: {titles}; needed: {missing_package(*packages)}"] if missing else []


def astc(
    image: np.ndarray, block: str = "8x8", quality: str = "exhaustive", normal: bool = False, reduce: int = 1
) -> Encoded:
    """Encode an image with ASTC, linear LDR profile, on one core.

    One channel is stored as luminance, two as luminance and alpha with equal weights. ``block`` is one of
    :data:`ASTC_BLOCKS`, ``quality`` a preset of the encoder, from ``fastest`` to ``exhaustive``. With ``normal``, only
    x and y of the three channels are stored; z is the square root of 1 - x² - y². With ``reduce``, width and height
    are divided by that number (rounded up) before encoding, and the result is scaled up with bicubic filtering.
    """
    (package,) = _modules("astc")
    texels = _texels(image)
    if normal:
        texels = texels[..., :2]
    if reduce > 1:
        texels = _rounded(_resized(texels / np.float32(255), *_reduced(texels.shape, reduce), "LANCZOS"))
    height, width, channels = texels.shape
    rgba = np.full((height, width, 4), 255, np.uint8)
    rgba[..., :channels] = texels
    stored, read = (("rrr1", [0]), ("rrrg", [0, 3]), ("rgb1", [0, 1, 2]), ("rgba", [0, 1, 2, 3]))[channels - 1]

    context = _context(block, quality, channels == 2)
    source = package.ASTCImage(package.ASTCType.U8, width, height, 1, rgba.tobytes())
    payload = context.compress(source, package.ASTCSwizzle.from_str(stored))
    target = package.ASTCImage(package.ASTCType.U8, width, height)
    target = context.decompress(payload, target, package.ASTCSwizzle.from_str("rgba"))
    decoded = np.frombuffer(target.data, np.uint8).reshape(height, width, 4)[..., read] / np.float32(255)
    if reduce > 1:
        decoded = _resized(decoded, *image.shape[:2], "BICUBIC")
    if normal:
        z = np.sqrt(np.maximum(0, 1 - np.sum((2 * decoded - 1) ** 2, -1, keepdims=True)))
        decoded = np.concatenate([decoded, (z + 1) / 2], -1)
    name = f"ASTC {block}{' xy' if normal else ''}{f' at 1/{reduce}' if reduce > 1 else ''}"
    return Encoded(name, len(payload), np.ascontiguousarray(decoded, np.float32))


@functools.lru_cache(maxsize=2 * len(ASTC_BLOCKS))
def _context(block: str, quality: str, pair: bool):
    """Return an ASTC encoder and decoder; creating one takes longer than encoding a small image."""
    (package,) = _modules("astc")
    flags = package.ASTCConfigFlags.USE_DECODE_UNORM8
    if pair:
        flags |= package.ASTCConfigFlags.MAP_NORMAL  # red and alpha weigh the same
    size, effort = map(int, block.split("x")), float(getattr(package.ASTCQualityPreset, quality.upper()))
    return package.ASTCContext(package.ASTCConfig(package.ASTCProfile.LDR, *size, quality=effort, flags=int(flags)))


def astc_bytes(shape: tuple[int, ...], block: str, reduce: int = 1) -> int:
    """Return the bytes that :func:`astc` stores for an image of shape ``(height, width, ...)``."""
    height, width = _reduced(shape, reduce)
    w, h = map(int, block.split("x"))
    return 16 * -(-width // w) * -(-height // h)


def bc7(image: np.ndarray) -> Encoded:
    """Encode an image with BC7's slowest preset: 16 bytes for 4×4 texels; one channel is grey, two red and green."""
    encoder, decoder = _modules("bc7")
    texels = _texels(image)
    height, width, channels = texels.shape
    padded = np.pad(texels, ((0, -height % 4), (0, -width % 4), (0, 0)), "edge")
    h, w = padded.shape[:2]
    rgba = np.zeros((h, w, 4), np.uint8)
    rgba[..., 3] = 255
    rgba[..., : 3 if channels == 1 else channels] = padded

    settings = encoder.BC7EncSettings.from_profile("alpha_slow" if channels == 4 else "slow")
    payload = encoder.compress_blocks_bc7(encoder.RGBASurface(rgba.tobytes(), w, h, 4 * w), settings)
    bgra = np.frombuffer(decoder.decode_bc7(payload, w, h), np.uint8).reshape(h, w, 4)
    decoded = bgra[:height, :width, [2, 1, 0, 3][:channels]] / np.float32(255)
    return Encoded("BC7", len(payload), np.ascontiguousarray(decoded))


def jpeg(image: np.ndarray, quality: int, subsampling: str = "4:4:4") -> Encoded:
    """Encode an image as progressive JPEG with optimised Huffman tables; ``quality`` is from 1 to 100.

    Two channels become two files, four channels one file of three and one of one; their bytes are added.
    """
    return _files("jpeg", image, quality, progressive=True, optimize=True, subsampling=subsampling)


def webp(image: np.ndarray, quality: int) -> Encoded:
    """Encode an image as lossy WebP by the slowest method; ``quality`` is from 0 to 100.

    WebP halves the resolution of colour. Files are as in :func:`jpeg`.
    """
    return _files("webp", image, quality, method=6)


def bicubic(image: np.ndarray, nbytes: int) -> Encoded:
    """Scale an image down until its 8-bit samples fit into ``nbytes`` (1×1 if none does), and up by bicubic filtering.

    The aspect ratio is kept. The image is scaled down by an antialiased Lanczos or bicubic filter, whichever has the
    smaller error.
    """
    _modules("bicubic")
    samples = _texels(image) / np.float32(255)
    height, width, channels = samples.shape
    scales = np.unique(np.concatenate([np.arange(1, n + 1) / n for n in (height, width)]))
    sizes = np.maximum(1, np.floor(np.outer(scales, (height, width)) + 1e-9)).astype(int)
    fitting = sizes[sizes.prod(1) * channels <= nbytes]
    h, w = map(int, fitting[-1]) if len(fitting) else (1, 1)
    best, least = samples, math.inf
    if (h, w) != (height, width):
        for down in ("LANCZOS", "BICUBIC"):
            small = _rounded(_resized(samples, h, w, down)) / np.float32(255)
            enlarged = _resized(small, height, width, "BICUBIC")
            if (error := _squared(samples, enlarged)) < least:
                best, least = enlarged, error
    return Encoded(f"bicubic {w}x{h}", h * w * channels, best)


def at_bytes(codec: str, image: np.ndarray, nbytes: int) -> Encoded:
    """Encode an image in at most ``nbytes`` with a codec other than ASTC.

    ``jpeg`` and ``webp`` take the highest quality that fits, else the lowest; JPEG is tried with and without chroma
    subsampling. ``bc7`` has one size only.
    """
    if codec not in _FILES:
        return bc7(image) if codec == "bc7" else bicubic(image, nbytes)
    encode = {"jpeg": jpeg, "webp": webp}[codec]
    _, qualities, tries = _FILES[codec]
    results = []
    for options in tries:
        coded = functools.cache(functools.partial(encode, image, **options))
        qualities = range(qualities[0], qualities[-1] + 1)
        results.append(coded(Budget(nbytes).largest(coded, qualities, strict=False)))
    fitting = [e for e in results if e.nbytes <= nbytes] or [min(results, key=lambda e: e.nbytes)]
    reference = _texels(image) / np.float32(255)
    return min(fitting, key=lambda e: _squared(reference, e.image))


#: A choice of encodings: bytes, squared error, and for each map its name, whether only x and y are stored, its block
#: size, and its reduction or number of dropped levels.
AstcChoice = tuple[int, float, tuple[tuple[str, bool, str, int], ...]]


def astc_material(
    maps: Mapping[str, np.ndarray],
    nbytes: int,
    quality: str = "exhaustive",
    uniform: bool = False,
    normals: Collection[str] = ("normal",),
    reduces: Iterable[int] = (1, 2, 4),
    choose: str = "medium",
    cache: dict | None = None,
) -> tuple[dict[str, Encoded], int]:
    """Encode the ``maps`` of a material, name → image, with ASTC in ``nbytes`` together, with the least squared error.

    Each map has its own block size and resolution (one of ``reduces``, see :func:`astc`); three equal channels are
    stored as luminance, the maps named in ``normals`` with or without z. With ``uniform``, all maps share the best
    block size and resolution. The error is summed over all texels and channels.

    The choice is optimal for errors with the preset ``choose``, by which each map is encoded some dozens of times;
    ``quality`` is the preset of the result. A ``cache``, for calls with the same maps only, avoids encoding twice.
    Returns the encoded maps by name, and their bytes. Raises :class:`CodecError` if no choice fits.
    """
    _modules("astc")
    cache = {} if cache is None else cache
    rounded = {name: _texels(image) / np.float32(255) for name, image in maps.items()}
    settings = list(itertools.product(ASTC_BLOCKS, reduces))

    def size(name: str, block: str, reduce: int) -> int:
        return astc_bytes(rounded[name].shape, block, reduce)

    def error(name: str, *options) -> float:
        if (key := ("error", name, *options, choose)) not in cache:
            cache[key] = _squared(rounded[name], _encode(rounded[name], *options, choose).image)
        return cache[key]

    def encoded(name: str, *options) -> Encoded:
        if (key := ("image", name, *options, quality)) not in cache:
            cache[key] = _encode(rounded[name], *options, quality)
        return cache[key]

    groups = [[setting] for setting in settings] if uniform else [settings]
    result = {part[0]: encoded(*part) for part in _least_error(rounded, normals, groups, nbytes, size, error)}
    return result, sum(e.nbytes for e in result.values())


@dataclass
class EncodedLevels:
    """Result of encoding a map with its mip maps: as :class:`Encoded`, with all ``levels`` decoded."""

    codec: str
    nbytes: int
    levels: list[np.ndarray]


def astc_levels(
    maps: Mapping[str, Sequence[np.ndarray]],
    nbytes: int,
    quality: str = "exhaustive",
    normals: Collection[str] = ("normal",),
    choose: str = "medium",
    cache: dict | None = None,
    dropped: Iterable[int] = (0, 1, 2),
) -> tuple[dict[str, EncodedLevels], int]:
    """Encode the ``maps`` of a material with their mip maps, name → levels, finest first, in ``nbytes`` together.

    Each map has its own block size and may drop some of its finest levels (one of ``dropped``), which are then read
    from the first stored level with bicubic filtering. The squared error of the finest levels is minimised. Otherwise
    as :func:`astc_material`.
    """
    _modules("astc")
    cache = {} if cache is None else cache
    rounded = {name: [_texels(level) / np.float32(255) for level in levels] for name, levels in maps.items()}

    def coded(name: str, level: int, normal: bool, block: str, quality: str) -> Encoded:
        if (key := ("level", name, level, normal, block, quality)) not in cache:
            cache[key] = _encode(rounded[name][level], normal, block, 1, quality)
        return cache[key]

    def size(name: str, block: str, drop: int) -> float:
        levels = rounded[name]
        return sum(astc_bytes(v.shape, block) for v in levels[drop:]) if drop < len(levels) else math.inf

    def read(name: str, level: int, stored: Encoded, drop: int) -> np.ndarray:
        return _resized(stored.image, *rounded[name][level].shape[:2], "BICUBIC") if drop else stored.image

    def error(name: str, normal: bool, block: str, drop: int) -> float:
        return _squared(rounded[name][0], read(name, 0, coded(name, drop, normal, block, choose), drop))

    finest = {name: levels[0] for name, levels in rounded.items()}
    groups, result = [list(itertools.product(ASTC_BLOCKS, dropped))], {}
    for name, normal, block, drop in _least_error(finest, normals, groups, nbytes, size, error, " with mip maps"):
        stored = [coded(name, i, normal, block, quality) for i in range(drop, len(rounded[name]))]
        levels = [*(read(name, i, stored[0], drop) for i in range(drop)), *(e.image for e in stored)]
        codec = stored[0].codec + (f" from level {drop} on" if drop else "")
        result[name] = EncodedLevels(codec, sum(e.nbytes for e in stored), levels)
    return result, sum(e.nbytes for e in result.values())


def _least_error(
    images: Mapping[str, np.ndarray], normals: Collection[str], groups: Sequence[Sequence[tuple[str, int]]],
    nbytes: int, size: Callable, error: Callable, extent: str = "",
) -> tuple:  # fmt: skip
    """Return the parts of the choice with the least error that fits; all maps have settings of one of the ``groups``.

    Raises :class:`CodecError` if none fits.
    """
    joint: list[AstcChoice] = []
    for settings in groups:
        front: list[AstcChoice] = [(0, 0.0, ())]  # choices that no other beats in bytes and error
        for name, image in images.items():
            both = (False, True) if name in normals and image.shape[2] == 3 else (False,)
            options = [(size(name, *setting), normal, setting) for normal in both for setting in settings]
            choices = [(n, error(name, w, *s), ((name, w, *s),)) for n, w, s in options if n <= nbytes]
            joined = [(a[0] + b[0], a[1] + b[1], a[2] + b[2]) for a, b in itertools.product(front, choices)]
            front, least = [], math.inf
            for choice in sorted((c for c in joined if c[0] <= nbytes), key=lambda c: c[:2]):
                if choice[1] < least:
                    front.append(choice)
                    least = choice[1]
        joint += front
    if not joint:
        raise CodecError(f"ASTC cannot store {', '.join(images)}{extent} in {nbytes:,} bytes")
    return min(joint, key=lambda choice: choice[1])[2]


def _encode(image: np.ndarray, normal: bool, block: str, reduce: int, quality) -> Encoded:
    """Encode an image by :func:`astc`, three equal channels as luminance."""
    if image.shape[2] != 3 or not (image[..., :1] == image).all():
        return astc(image, block, quality, normal, reduce)
    coded = astc(image[..., :1], block, quality, False, reduce)
    return replace(coded, image=np.repeat(coded.image, 3, -1))


def _files(codec: str, image: np.ndarray, quality: int, **options) -> Encoded:
    """Encode an image as one or two files that Pillow writes."""
    pillow, name, longest = _modules(codec)[0], TITLES[codec], _FILES[codec][0]
    texels = _texels(image)
    height, width, channels = texels.shape
    if max(height, width) > longest:
        raise CodecError(f"{name} cannot store {width}x{height} texels, at most {longest} a side")
    groups = {1: [[0]], 2: [[0], [1]], 3: [[0, 1, 2]], 4: [[0, 1, 2], [3]]}[channels]
    decoded, nbytes = np.empty(texels.shape, np.float32), 0
    for group in groups:
        mode = "L" if len(group) == 1 else "RGB"
        plane = texels[..., group[0]] if mode == "L" else texels[..., group]
        source = pillow.fromarray(np.ascontiguousarray(plane))
        file = io.BytesIO()
        source.save(file, codec.upper(), quality=quality, **options)
        nbytes += file.tell()
        with pillow.open(file) as opened:
            decoded[..., group] = np.asarray(opened.convert(mode)).reshape(height, width, -1) / np.float32(255)
    return Encoded(f"{name} {quality}", nbytes, decoded)


def _modules(codec: str) -> list:
    """Return the modules that a codec needs; raise :class:`CodecError` with the ``pip`` command if one is missing."""
    modules = []
    for package, module in _PACKAGES[codec]:
        try:
            modules.append(importlib.import_module(module))
        except ImportError:
            raise CodecError(f"the codec {codec} needs {missing_package(package)}") from None
    return modules


def _texels(image: np.ndarray) -> np.ndarray:
    """Return an image in 8 bits; raise ``ValueError`` for a wrong shape or values outside [0, 1]."""
    image = np.asarray(image)
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4 or 0 in image.shape:
        raise ValueError(f"image: found the shape {image.shape}, (height, width, 1 to 4 channels) is needed")
    if not (image.min() >= 0 and image.max() <= 1):
        raise ValueError(f"image: found values from {image.min():g} to {image.max():g}, 0 to 1 is needed")
    return _rounded(image)


def _rounded(image: np.ndarray) -> np.ndarray:
    """Return values in [0, 1] in 8 bits."""
    return np.rint(image * np.float32(255)).astype(np.uint8)


def _reduced(shape: tuple[int, ...], reduce: int) -> tuple[int, int]:
    """Return height and width divided by ``reduce``, rounded up."""
    return -(-shape[0] // reduce), -(-shape[1] // reduce)


def _resized(image: np.ndarray, height: int, width: int, resampling: str) -> np.ndarray:
    """Resize each channel (with antialiasing if it becomes smaller), clipped to [0, 1]."""
    pillow = importlib.import_module("PIL.Image")
    resampling = getattr(pillow.Resampling, resampling)
    planes = [pillow.fromarray(np.ascontiguousarray(plane, np.float32)) for plane in np.moveaxis(image, -1, 0)]
    return np.clip(np.stack([plane.resize((width, height), resampling) for plane in planes], -1), 0, 1)


def _squared(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the sum of squared differences."""
    return float(np.sum((reference - image) ** 2, dtype=np.float64))
