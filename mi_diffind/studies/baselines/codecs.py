"""
What learned textures are compared with: thin layers over maintained codecs, each of which is optional.

An image is float32, ``(height, width, channels)`` with 1 to 4 channels and values in [0, 1], and is rounded to 8 bits
first. What is decoded are the stored values, without any transfer function; errors are meant to be measured of these.
Sizes that blocks do not divide are padded by repeating the edge and cropped after; the padded blocks count. All
functions raise ``ValueError`` for another image and :class:`CodecError` if a package is missing.
"""

from __future__ import annotations

import functools
import importlib
import io
import itertools
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...errors import DiffindError
from ...units import largest_fitting

#: The 2D block sizes of ASTC, width × height, from the finest on, and their bits per texel.
ASTC_BLOCKS = {
    f"{w}x{h}": 128 / (w * h)
    for w, h in (
        *((4, 4), (5, 4), (5, 5), (6, 5), (6, 6), (8, 5), (8, 6)),
        *((10, 5), (10, 6), (8, 8), (10, 8), (10, 10), (12, 10), (12, 12)),
    )
}

#: Codec → what pip installs, what is imported.
_PACKAGES = {
    "astc": (("astc-encoder-py", "astc_encoder"),),
    "bc7": (("ispc_texcomp", "ispc_texcomp"), ("texture2ddecoder", "texture2ddecoder")),
    "jpeg": (("pillow", "PIL.Image"),),
    "webp": (("pillow", "PIL.Image"), ("pillow", "PIL._webp")),
    "bicubic": (("pillow", "PIL.Image"),),
}
#: File format → its name, the longest side, the qualities, the options tried by :func:`at_bytes`.
_FILES = {
    "jpeg": ("JPEG", 65535, range(1, 101), ({"subsampling": "4:4:4"}, {"subsampling": "4:2:0"})),
    "webp": ("WebP", 16383, range(0, 101), ({},)),
}


class CodecError(DiffindError, RuntimeError):
    """A codec is not installed or cannot store an image; the message is one sentence."""


@dataclass
class Encoded:
    """
    An image after ``codec`` (e.g. ``"ASTC 8x8"``): the ``nbytes`` stored (payload of blocks and samples, whole files),
    the decoded ``image`` (float32 in [0, 1], shape of the input).
    """

    codec: str
    nbytes: int
    image: np.ndarray


def available() -> tuple[str, ...]:
    """The codecs whose packages are installed, of ``astc``, ``bc7``, ``jpeg``, ``webp``, ``bicubic``."""
    found = []
    for codec in _PACKAGES:
        try:
            _modules(codec)
        except CodecError:
            continue
        found.append(codec)
    return tuple(found)


def missing() -> list[str]:
    """The names of the codecs that are not installed."""
    return [{"bicubic": "bicubic scaling", "webp": "WebP"}.get(c, c.upper()) for c in _PACKAGES if c not in available()]


def astc(
    image: np.ndarray, block: str = "8x8", quality: str = "exhaustive", normal: bool = False, reduce: int = 1
) -> Encoded:
    """
    ASTC, linear LDR profile, on one core (the package's threads do not run at once): one channel as luminance, two as
    luminance and alpha with equal weights. ``block`` is one of :data:`ASTC_BLOCKS`, ``quality`` a
    preset of the encoder, from ``fastest`` to ``exhaustive``.

    ``normal``: of the three channels only x and y are stored, z is the square root of 1 - x² - y². ``reduce``: stored
    at a width and height that many times smaller (rounded up), read with bicubic filtering.
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
    """An ASTC encoder and decoder, which takes longer to make than a small image to encode."""
    (package,) = _modules("astc")
    flags = package.ASTCConfigFlags.USE_DECODE_UNORM8
    if pair:
        flags |= package.ASTCConfigFlags.MAP_NORMAL  # red and alpha weigh the same
    size, effort = map(int, block.split("x")), float(getattr(package.ASTCQualityPreset, quality.upper()))
    return package.ASTCContext(package.ASTCConfig(package.ASTCProfile.LDR, *size, quality=effort, flags=int(flags)))


def astc_bytes(shape: tuple[int, ...], block: str, reduce: int = 1) -> int:
    """What :func:`astc` stores for an image of that shape, ``(height, width, ...)``."""
    height, width = _reduced(shape, reduce)
    w, h = map(int, block.split("x"))
    return 16 * -(-width // w) * -(-height // h)


def bc7(image: np.ndarray) -> Encoded:
    """BC7 with the slowest preset: 16 bytes for 4×4 texels, one channel stored as grey, two as red and green."""
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
    """
    JPEG, progressive, Huffman tables optimised, ``quality`` from 1 to 100. Two channels are two files, four are one of
    three channels and one of one; bytes add up.
    """
    return _files("jpeg", image, quality, progressive=True, optimize=True, subsampling=subsampling)


def webp(image: np.ndarray, quality: int) -> Encoded:
    """
    Lossy WebP (which halves the resolution of colour), slowest method, ``quality`` from 0 to 100. Two channels are two
    files, four are one of three channels and one of one; bytes add up.
    """
    return _files("webp", image, quality, method=6)


def bicubic(image: np.ndarray, nbytes: int) -> Encoded:
    """
    The image at the highest resolution of the same aspect whose 8-bit samples fit into ``nbytes`` (1×1 if none does),
    read with bicubic filtering. Downscaled by the antialiased Lanczos or bicubic filter, whichever errs less.
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
            found = _resized(small, height, width, "BICUBIC")
            if (error := _squared(samples, found)) < least:
                best, least = found, error
    return Encoded(f"bicubic {w}x{h}", h * w * channels, best)


def at_bytes(codec: str, image: np.ndarray, nbytes: int) -> Encoded:
    """
    ``image`` in ``nbytes`` by one of the codecs ``jpeg`` and ``webp``: the highest quality that fits, else the lowest
    (JPEG: with or without chroma subsampling, whichever errs less); ``bicubic`` as it is; ``bc7`` at its only size.
    """
    if codec not in _FILES:
        return bc7(image) if codec == "bc7" else bicubic(image, nbytes)
    encode = {"jpeg": jpeg, "webp": webp}[codec]
    _, _, qualities, tries = _FILES[codec]
    found = [_fitting(lambda q, o=o: encode(image, q, **o), qualities, nbytes) for o in tries]
    fitting = [e for e in found if e.nbytes <= nbytes] or [min(found, key=lambda e: e.nbytes)]
    reference = _texels(image) / np.float32(255)
    return min(fitting, key=lambda e: _squared(reference, e.image))


#: One way to store a map (its name, whether only x and y, block size, reduction), or several: bytes, squared error.
_Way = tuple[int, float, tuple[tuple[str, bool, str, int], ...]]


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
    """
    The ``maps`` of a material, name → image, in ``nbytes`` together, with the least squared error over all their texels
    and channels: each map at its own block size and resolution (one of ``reduces``, see :func:`astc`), three equal
    channels as luminance, the maps named in ``normals`` with or without z. ``uniform``: one block size and resolution
    for all maps instead, the best one.

    The choice is the best one for the errors with the preset ``choose``, for which each map is encoded some dozens of
    times; ``quality`` is for the result. A ``cache``, only for calls with the same maps, saves encoding twice. Returns
    the encoded maps by name, and their bytes. Raises :class:`CodecError` if no choice fits.
    """
    _modules("astc")
    cache = {} if cache is None else cache
    rounded = {name: _texels(image) / np.float32(255) for name, image in maps.items()}
    settings = list(itertools.product(ASTC_BLOCKS, reduces))

    def cached(kind: Callable, *part):
        if (key := (kind.__name__, *part)) not in cache:
            cache[key] = kind(rounded[part[0]], *part[1:])
        return cache[key]

    known: dict[str, list[_Way]] = {}
    for name, image in rounded.items():
        both = (False, True) if name in normals and image.shape[2] == 3 else (False,)
        for normal, (block, reduce) in itertools.product(both, settings):
            size = astc_bytes(image.shape, block, reduce)
            if size <= nbytes:
                error = cached(_error, name, normal, block, reduce, choose)
                known.setdefault(name, []).append((size, error, ((name, normal, block, reduce),)))

    def ways(allowed) -> list[_Way]:
        """The ways to store the material that nothing beats, at the block sizes and resolutions allowed."""
        front: list[_Way] = [(0, 0.0, ())]
        for name in rounded:
            one = [way for way in known.get(name, ()) if way[2][0][2:] in allowed]
            front = _front(itertools.product(front, one), nbytes)
        return front

    found = [way for setting in settings for way in ways([setting])] if uniform else ways(settings)
    if not found:
        raise CodecError(f"ASTC cannot store {', '.join(maps)} in {nbytes:,} bytes")
    result = {part[0]: cached(_encode, *part, quality) for part in min(found, key=lambda way: way[1])[2]}
    return result, sum(e.nbytes for e in result.values())


@dataclass
class EncodedLevels:
    """
    A map and its mip maps after ``codec``: the ``nbytes`` stored, and all ``levels`` decoded, as :class:`Encoded` has
    an image.
    """

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
    """
    The ``maps`` of a material with their mip maps, name → all levels from the finest on, in ``nbytes`` together: each
    map at its own block size, with or without its finest levels (so many may be ``dropped``; they are read from the
    first that is stored with bicubic filtering), such that the squared errors of the finest levels are least. Otherwise
    as :func:`astc_material`.
    """
    _modules("astc")
    cache = {} if cache is None else cache
    rounded = {name: [_texels(level) / np.float32(255) for level in levels] for name, levels in maps.items()}

    def coded(name: str, level: int, normal: bool, block: str, quality: str) -> Encoded:
        key = ("level", name, level, normal, block, quality)
        if key not in cache:
            cache[key] = _encode(rounded[name][level], normal, block, 1, quality)
        return cache[key]

    def finest(name: str, normal: bool, block: str, drop: int, quality: str) -> np.ndarray:
        image, (height, width) = coded(name, drop, normal, block, quality).image, rounded[name][0].shape[:2]
        return _resized(image, height, width, "BICUBIC") if drop else image

    front: list[_Way] = [(0, 0.0, ())]
    for name, levels in rounded.items():
        ways = []
        both = (False, True) if name in normals and levels[0].shape[2] == 3 else (False,)
        for normal, block, drop in itertools.product(both, ASTC_BLOCKS, dropped):
            size = sum(astc_bytes(level.shape, block) for level in levels[drop:])
            if drop < len(levels) and size <= nbytes:
                error = _squared(levels[0], finest(name, normal, block, drop, choose))
                ways.append((size, error, ((name, normal, block, drop),)))
        front = _front(itertools.product(front, ways), nbytes)
    if not front:
        raise CodecError(f"ASTC cannot store {', '.join(maps)} with mip maps in {nbytes:,} bytes")
    found = {}
    for name, normal, block, drop in min(front, key=lambda way: way[1])[2]:
        parts = [coded(name, i, normal, block, quality) for i in range(drop, len(rounded[name]))]
        above = []
        for level in rounded[name][:drop]:
            above.append(_resized(parts[0].image, *level.shape[:2], "BICUBIC"))
        codec = f"{parts[0].codec}{f' from level {drop} on' if drop else ''}"
        found[name] = EncodedLevels(codec, sum(p.nbytes for p in parts), [*above, *(p.image for p in parts)])
    return found, sum(e.nbytes for e in found.values())


def _encode(image: np.ndarray, normal: bool, block: str, reduce: int, quality) -> Encoded:
    """An image by :func:`astc`, three equal channels as luminance."""
    if not _grey(image):
        return astc(image, block, quality, normal, reduce)
    coded = astc(image[..., :1], block, quality, False, reduce)
    return replace(coded, image=np.repeat(coded.image, 3, -1))


def _error(image: np.ndarray, *options) -> float:
    """The squared error of :func:`_encode`."""
    return _squared(image, _encode(image, *options).image)


def _grey(image: np.ndarray) -> bool:
    """Whether there are three equal channels."""
    return image.shape[2] == 3 and bool((image[..., :1] == image).all())


def _front(pairs: Iterable[tuple[_Way, _Way]], nbytes: int) -> list[_Way]:
    """Two ways at a time put together, of these the ones within ``nbytes`` that nothing beats."""
    joined = [(a[0] + b[0], a[1] + b[1], a[2] + b[2]) for a, b in pairs if a[0] + b[0] <= nbytes]
    kept, least = [], math.inf
    for way in sorted(joined, key=lambda w: w[:2]):
        if way[1] < least:
            kept.append(way)
            least = way[1]
    return kept


def _fitting(encode: Callable[[int], Encoded], qualities: range, nbytes: int) -> Encoded:
    """Encode at the highest quality that takes at most ``nbytes``, else at the lowest."""
    coded = functools.cache(encode)
    return coded(largest_fitting(lambda quality: coded(quality).nbytes <= nbytes, qualities[0], qualities[-1] + 1))


def _files(kind: str, image: np.ndarray, quality: int, **options) -> Encoded:
    """An image as one or two files that Pillow writes."""
    pillow = _modules(kind)[0]
    name, longest, *_ = _FILES[kind]
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
        source.save(file, kind.upper(), quality=quality, **options)
        nbytes += file.tell()
        with pillow.open(file) as opened:
            decoded[..., group] = np.asarray(opened.convert(mode)).reshape(height, width, -1) / np.float32(255)
    return Encoded(f"{name} {quality}", nbytes, decoded)


def _modules(codec: str) -> list:
    """The modules a codec needs. Raises :class:`CodecError` that says how to install what is missing."""
    found = []
    for package, module in _PACKAGES[codec]:
        try:
            found.append(importlib.import_module(module))
        except ImportError:
            raise CodecError(f'the codec {codec} needs {package}, which "pip install {package}" installs') from None
    return found


def _texels(image: np.ndarray) -> np.ndarray:
    """An image in 8 bits. Raises ``ValueError`` if it is none."""
    image = np.asarray(image)
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4 or 0 in image.shape:
        raise ValueError(f"image: found the shape {image.shape}, (height, width, 1 to 4 channels) is needed")
    if not (image.min() >= 0 and image.max() <= 1):
        raise ValueError(f"image: found values from {image.min():g} to {image.max():g}, 0 to 1 is needed")
    return _rounded(image)


def _rounded(image: np.ndarray) -> np.ndarray:
    """Values in [0, 1] in 8 bits."""
    return np.rint(image * np.float32(255)).astype(np.uint8)


def _reduced(shape: tuple[int, ...], reduce: int) -> tuple[int, int]:
    """Height and width, a whole number of times smaller, rounded up."""
    return -(-shape[0] // reduce), -(-shape[1] // reduce)


def _resized(image: np.ndarray, height: int, width: int, resampling: str) -> np.ndarray:
    """Each channel at another size (antialiased when that is smaller), clipped to [0, 1]."""
    pillow = importlib.import_module("PIL.Image")
    resampling = getattr(pillow.Resampling, resampling)
    planes = [pillow.fromarray(np.ascontiguousarray(plane, np.float32)) for plane in np.moveaxis(image, -1, 0)]
    return np.clip(np.stack([plane.resize((width, height), resampling) for plane in planes], -1), 0, 1)


def _squared(reference: np.ndarray, image: np.ndarray) -> float:
    """Sum of squared differences."""
    return float(np.sum((reference - image) ** 2, dtype=np.float64))
