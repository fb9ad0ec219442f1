"""Image codecs that learned textures are compared with: ASTC, BC7, JPEG and WebP.

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
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image

from ...arrays.budget import Budget
from ...core.errors import DiffindError, missing_package

#: Block sizes of ASTC in 2D, width × height, finest first; a block has 16 bytes.
ASTC_BLOCKS = (
    "4x4", "5x4", "5x5", "6x5", "6x6", "8x5", "8x6", "10x5", "10x6", "8x8", "10x8", "10x10", "12x10", "12x12",
)  # fmt: skip

#: Preset of the ASTC encoder in studies; the next one, ``exhaustive``, takes many times as long.
QUALITY = "thorough"

#: Most levels that :func:`astc_levels` leaves out at the fine end of a map.
DROPPED = 2

#: Codec → its name in notes and legends.
TITLES = {"astc": "ASTC", "bc7": "BC7", "jpeg": "JPEG", "webp": "WebP"}

#: Codec → its optional packages, each as a distribution and a module.
_PACKAGES = {
    "astc": (("astc-encoder-py", "astc_encoder"),),
    "bc7": (("ispc_texcomp", "ispc_texcomp"), ("texture2ddecoder", "texture2ddecoder")),
}


class CodecError(DiffindError, RuntimeError):
    """A codec that is not installed or cannot store an image; the message is one sentence."""


@dataclass
class Encoded:
    """Result of encoding and decoding with ``codec``, for example ``"ASTC 8x8"``.

    ``nbytes`` counts the payload of blocks, or whole files; ``levels`` are decoded, float32 in [0, 1], of the input's
    shapes: an image, or an image and its mip maps.
    """

    codec: str
    nbytes: int
    levels: list[np.ndarray]

    @property
    def image(self) -> np.ndarray:
        """The decoded image."""
        return self.levels[0]


def available() -> tuple[str, ...]:
    """Return the codecs whose packages are installed, of :data:`TITLES`."""
    names = []
    for codec in TITLES:
        with contextlib.suppress(CodecError):
            _modules(codec)
            names.append(codec)
    return tuple(names)


def install_notes(codecs: Iterable[str] = tuple(TITLES)) -> list[str]:
    """Return a note, in a list, about those of ``codecs`` that are not installed; an empty list if all are."""
    missing = [codec for codec in codecs if codec not in available()]
    packages = dict.fromkeys(package for codec in missing for package, _ in _PACKAGES.get(codec, ()))
    titles = ", ".join(TITLES[codec] for codec in missing)
    return [f"Left out: {titles}; needed: {missing_package(*packages)}"] if missing else []


def _modules(codec: str) -> list:
    """Return the modules that a codec needs; raise :class:`CodecError` with the ``pip`` command if one is missing."""
    modules = []
    for package, module in _PACKAGES.get(codec, ()):
        try:
            modules.append(importlib.import_module(module))
        except ImportError:
            raise CodecError(f"the codec {codec} needs {missing_package(package)}") from None
    return modules


# -- Blocks ------------------------------------------------------------------------------------------------------------


def astc(image: np.ndarray, block: str, quality: str, normal: bool = False) -> Encoded:
    """Encode an image with ASTC, linear LDR profile, on one core.

    One channel, or three equal ones, are stored as luminance, two as luminance and alpha with equal weights. ``block``
    is one of :data:`ASTC_BLOCKS`, ``quality`` a preset of the encoder, from ``fastest`` to ``exhaustive``. With
    ``normal``, only x and y of the three channels are stored; z is the square root of 1 - x² - y².
    """
    (package,) = _modules("astc")
    texels = _texels(image)
    grey = texels.shape[2] == 3 and bool((texels[..., :1] == texels).all())
    normal = normal and not grey
    texels = texels[..., :1] if grey else texels[..., :2] if normal else texels
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
    if normal:
        z = np.sqrt(np.maximum(0, 1 - np.sum((2 * decoded - 1) ** 2, -1, keepdims=True)))
        decoded = np.concatenate([decoded, (z + 1) / 2], -1)
    decoded = np.repeat(decoded, 3, -1) if grey else decoded
    return Encoded(f"ASTC {block}{' xy' * normal}", len(payload), [np.ascontiguousarray(decoded, np.float32)])


@functools.lru_cache(maxsize=2 * len(ASTC_BLOCKS))
def _context(block: str, quality: str, pair: bool):
    """Return an ASTC encoder and decoder; creating one takes longer than encoding a small image."""
    (package,) = _modules("astc")
    flags = package.ASTCConfigFlags.USE_DECODE_UNORM8
    if pair:
        flags |= package.ASTCConfigFlags.MAP_NORMAL  # red and alpha weigh the same
    size, effort = map(int, block.split("x")), float(getattr(package.ASTCQualityPreset, quality.upper()))
    return package.ASTCContext(package.ASTCConfig(package.ASTCProfile.LDR, *size, quality=effort, flags=int(flags)))


def astc_bytes(shape: tuple[int, ...], block: str) -> int:
    """Return the bytes that :func:`astc` stores for an image of shape ``(height, width, ...)``."""
    w, h = map(int, block.split("x"))
    return 16 * -(-shape[1] // w) * -(-shape[0] // h)


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
    return Encoded("BC7", len(payload), [np.ascontiguousarray(decoded)])


#: A choice of encodings: bytes, squared error, and for each map its name, whether only x and y are stored, its block
#: size, and its number of dropped levels.
AstcChoice = tuple[int, float, tuple[tuple[str, bool, str, int], ...]]


def astc_levels(
    maps: Mapping[str, Sequence[np.ndarray]],
    nbytes: float,
    quality: str,
    normals: Collection[str] = (),
    mip_maps: bool = True,
    cache: dict | None = None,
) -> tuple[dict[str, Encoded], int]:
    """Encode the ``maps`` of a material, name → levels, finest first, in ``nbytes`` together, with the least error.

    Each map has its own block size and may drop up to :data:`DROPPED` of its finest levels, which are then read from
    the first stored level with bicubic filtering; maps named in ``normals`` are stored with or without z. The squared
    error of the finest levels, of all texels and channels, is minimised. Without ``mip_maps``, only the first stored
    level is kept, and coarser ones are other resolutions to choose from.

    The choice is optimal for errors with the preset ``medium`` of the encoder, or a faster ``quality``, which is the
    preset of the result. A ``cache``, for calls with the same maps only, avoids encoding twice. Returns the encoded
    maps by name, and their bytes. Raises :class:`CodecError` if no choice fits.
    """
    _modules("astc")
    cache = {} if cache is None else cache
    choosing = quality if quality in ("fastest", "fast") else "medium"
    rounded = {name: [_texels(level) / np.float32(255) for level in levels] for name, levels in maps.items()}

    def coded(*key) -> Encoded:
        name, level, normal, block, quality = key
        if key not in cache:
            cache[key] = astc(rounded[name][level], block, quality, normal)
        return cache[key]

    def kept(name: str, drop: int) -> range:
        return range(drop, len(rounded[name]) if mip_maps else drop + 1)

    def finer(name: str, level: int, stored: Encoded) -> np.ndarray:
        return resized(stored.image, *rounded[name][level].shape[:2], Image.Resampling.BICUBIC)

    def choices(name: str) -> Iterable[AstcChoice]:
        finest = rounded[name][0]
        both = (False, True) if name in normals and finest.shape[2] == 3 else (False,)
        drops = range(min(DROPPED + 1, len(rounded[name])))
        for normal, block, drop in itertools.product(both, ASTC_BLOCKS, drops):
            size = sum(astc_bytes(rounded[name][i].shape, block) for i in kept(name, drop))
            if size <= nbytes:
                stored = coded(name, drop, normal, block, choosing)
                image = finer(name, 0, stored) if drop else stored.image
                yield size, _squared(finest, image), ((name, normal, block, drop),)

    front: list[AstcChoice] = [(0, 0.0, ())]  # choices that no other beats in bytes and error
    for name in maps:
        pairs = itertools.product(front, list(choices(name)))
        joined = sorted(((a[0] + b[0], a[1] + b[1], a[2] + b[2]) for a, b in pairs), key=lambda c: c[:2])
        front, least = [], math.inf
        for choice in joined:
            if choice[0] <= nbytes and choice[1] < least:
                front.append(choice)
                least = choice[1]
    if not front:
        text = " with mip maps" if mip_maps else ""
        raise CodecError(f"ASTC cannot store {', '.join(maps)}{text} in {nbytes:,.0f} bytes")
    result = {}
    for name, normal, block, drop in min(front, key=lambda choice: choice[1])[2]:
        stored = [coded(name, i, normal, block, quality) for i in kept(name, drop)]
        levels = [*(finer(name, i, stored[0]) for i in range(drop)), *(e.image for e in stored)]
        codec = stored[0].codec + (f" from level {drop} on" if drop else "")
        result[name] = Encoded(codec, sum(e.nbytes for e in stored), levels)
    return result, sum(e.nbytes for e in result.values())


# -- Files -------------------------------------------------------------------------------------------------------------


def image_file(codec: str, image: np.ndarray, nbytes: float) -> Encoded:
    """Encode an image in at most ``nbytes``, as progressive JPEG (``"jpeg"``) or lossy WebP (``"webp"``).

    The quality is the highest that fits, else the lowest. JPEG has optimised Huffman tables and halves the resolution
    of colours if the error is smaller then; WebP always does. Two channels become two files, four channels one file of
    three and one of one; their bytes are added.
    """
    texels, qualities, options = _texels(image), range(101), [{"method": 6}]
    if codec == "jpeg":
        qualities = range(1, 101)
        options = [{"progressive": True, "optimize": True, "subsampling": s} for s in ("4:4:4", "4:2:0")]
    coded = [_largest_file(TITLES[codec], texels, nbytes, qualities, each) for each in options]
    fitting = [e for e in coded if e.nbytes <= nbytes] or [min(coded, key=lambda e: e.nbytes)]
    return min(fitting, key=lambda e: _squared(texels / np.float32(255), e.image))


def _largest_file(name: str, texels: np.ndarray, nbytes: float, qualities: range, options: dict) -> Encoded:
    """Encode texels as one or two files of Pillow, with the highest of the ``qualities`` that fits, or the lowest."""
    height, width, channels = texels.shape

    @functools.cache
    def encoded(quality: int) -> Encoded:
        decoded, size = np.empty(texels.shape, np.float32), 0
        for group in {1: [[0]], 2: [[0], [1]], 3: [[0, 1, 2]], 4: [[0, 1, 2], [3]]}[channels]:
            mode = "L" if len(group) == 1 else "RGB"
            plane = texels[..., group[0]] if mode == "L" else texels[..., group]
            file = io.BytesIO()
            try:
                Image.fromarray(np.ascontiguousarray(plane)).save(file, name.upper(), quality=quality, **options)
            except (OSError, ValueError) as e:  # too large
                raise CodecError(f"{name} cannot store {width}x{height} texels: {e}") from None
            size += file.tell()
            with Image.open(file) as opened:
                decoded[..., group] = np.asarray(opened.convert(mode)).reshape(height, width, -1) / np.float32(255)
        return Encoded(f"{name} {quality}", size, [decoded])

    return encoded(Budget(nbytes).largest(encoded, qualities, strict=False))


# -- Images ------------------------------------------------------------------------------------------------------------


def resized(image: np.ndarray, height: int, width: int, resampling: Image.Resampling) -> np.ndarray:
    """Resize each channel (with antialiasing if it becomes smaller), clipped to [0, 1]."""
    planes = [Image.fromarray(np.ascontiguousarray(plane, np.float32)) for plane in np.moveaxis(image, -1, 0)]
    return np.clip(np.stack([plane.resize((width, height), resampling) for plane in planes], -1), 0, 1)


def _texels(image: np.ndarray) -> np.ndarray:
    """Return an image in 8 bits; raise ``ValueError`` for a wrong shape or values outside [0, 1]."""
    image = np.asarray(image)
    if image.ndim != 3 or not 1 <= image.shape[2] <= 4 or 0 in image.shape:
        raise ValueError(f"image: found the shape {image.shape}, (height, width, 1 to 4 channels) is needed")
    if not (image.min() >= 0 and image.max() <= 1):
        raise ValueError(f"image: found values from {image.min():g} to {image.max():g}, 0 to 1 is needed")
    return np.rint(image * np.float32(255)).astype(np.uint8)


def _squared(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the sum of squared differences."""
    return float(np.sum((reference - image) ** 2, dtype=np.float64))
