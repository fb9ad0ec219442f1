"""Image codecs that learned textures are compared with: ASTC, BC7, JPEG and WebP.

An image is float32, ``(height, width, channels)`` with 1 to 4 channels and values in [0, 1], and is rounded to 8 bits
before it is encoded. Decoded values are the stored ones, without any transfer function; errors are meant to be measured
on them. An image whose sides are no multiples of the block size is padded by repeating the edge and cropped afterwards;
padded blocks count.
"""

import functools
import io
import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from PIL import Image

from ...arrays.budget import Budget
from ...core.errors import UsageError, missing_package, raised_as

#: Block sizes of ASTC in 2D, width × height, finest first; a block has 16 bytes.
ASTC_BLOCKS = (
    "4x4", "5x4", "5x5", "6x5", "6x6", "8x5", "8x6", "10x5", "10x6", "8x8", "10x8", "10x10", "12x10", "12x12",
)  # fmt: skip

#: Most levels that :func:`astc_levels` leaves out at the fine end of a map.
DROPPED = 2

#: Codec → its name in notes and legends.
TITLES = {"astc": "ASTC", "bc7": "BC7", "jpeg": "JPEG", "webp": "WebP"}

#: Codec → its optional packages, and their modules.
PACKAGES = {
    "astc": {"astc-encoder-py": "astc_encoder"},
    "bc7": {"ispc_texcomp": "ispc_texcomp", "texture2ddecoder": "texture2ddecoder"},
}


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


def missing(codec: str) -> list[str]:
    """Return the packages of a codec that are not installed."""
    return [package for package, module in PACKAGES.get(codec, {}).items() if find_spec(module) is None]


def available() -> tuple[str, ...]:
    """Return the codecs whose packages are installed, of :data:`TITLES`."""
    return tuple(codec for codec in TITLES if not missing(codec))


def install_notes(codecs: Iterable[str] = tuple(TITLES)) -> list[str]:
    """Return a note for each of ``codecs`` that is not installed."""
    packages = {TITLES[codec]: missing(codec) for codec in codecs}
    return [f"Left out: {title}; needed: {missing_package(*names)}" for title, names in packages.items() if names]


# -- Blocks ------------------------------------------------------------------------------------------------------------


def astc(image: np.ndarray, block: str, quality: str, normal: bool = False) -> Encoded:
    """Encode an image with ASTC, linear LDR profile, on one core.

    One channel is stored as luminance, two as luminance and alpha with equal weights. ``block`` is one of
    :data:`ASTC_BLOCKS`, ``quality`` a preset of the encoder, from ``fastest`` to ``exhaustive``. With ``normal``, only
    x and y of the three channels are stored; z is the square root of 1 - x² - y².
    """
    import astc_encoder as package

    texels = _texels(image)[..., : 2 if normal else 4]
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
    return Encoded(f"ASTC {block}{' xy' * normal}", len(payload), [np.ascontiguousarray(decoded, np.float32)])


@functools.lru_cache(maxsize=2 * len(ASTC_BLOCKS))
def _context(block: str, quality: str, pair: bool):
    """Return an ASTC encoder and decoder; creating one takes longer than encoding a small image."""
    import astc_encoder as package

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
    import ispc_texcomp as encoder
    import texture2ddecoder as decoder

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
    maps by name, and their bytes. Raises :class:`.UsageError` if no choice fits.
    """
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

    # A choice is its bytes, its squared error, and for each map its name, whether only x and y are stored, its block
    # size and its number of dropped levels. The front holds those that no other beats in bytes and error.
    front: list[tuple[int, float, tuple]] = [(0, 0.0, ())]
    for name, levels in rounded.items():
        both = (False, True) if name in normals and levels[0].shape[2] == 3 else (False,)
        joined = []
        for normal, block, drop in itertools.product(both, ASTC_BLOCKS, range(min(DROPPED + 1, len(levels)))):
            size = sum(astc_bytes(levels[i].shape, block) for i in kept(name, drop))
            if size <= nbytes:
                stored = coded(name, drop, normal, block, choosing)
                error = _squared(levels[0], enlarged(stored.image, levels[0].shape) if drop else stored.image)
                joined += [(a + size, b + error, (*rest, (name, normal, block, drop))) for a, b, rest in front]
        front, least = [], math.inf
        for choice in sorted(joined, key=lambda choice: choice[:2]):
            if choice[0] <= nbytes and choice[1] < least:
                front.append(choice)
                least = choice[1]
    if not front:
        raise UsageError(f"ASTC cannot store {', '.join(maps)} in {nbytes:,.0f} bytes")
    result = {}
    for name, normal, block, drop in min(front, key=lambda choice: choice[1])[2]:
        stored = [coded(name, i, normal, block, quality) for i in kept(name, drop)]
        finer = [enlarged(stored[0].image, level.shape) for level in rounded[name][:drop]]
        codec = stored[0].codec + (f" from level {drop} on" if drop else "")
        result[name] = Encoded(codec, sum(e.nbytes for e in stored), [*finer, *(e.image for e in stored)])
    return result, sum(e.nbytes for e in result.values())


# -- Files -------------------------------------------------------------------------------------------------------------


def image_file(codec: str, image: np.ndarray, nbytes: float) -> Encoded:
    """Encode an image in at most ``nbytes``, as progressive JPEG (``"jpeg"``) or lossy WebP (``"webp"``).

    The quality is the highest that fits, else the lowest. JPEG has optimised Huffman tables and halves the resolution
    of colours if the error is smaller then; WebP always does. Two channels become two files, four channels one file of
    three and one of one; their bytes are added. Raises :class:`.UsageError` if an image is too large.
    """
    texels, qualities, options = _texels(image), range(101), [{"method": 6}]
    if codec == "jpeg":
        qualities = range(1, 101)
        options = [{"progressive": True, "optimize": True, "subsampling": s} for s in ("4:4:4", "4:2:0")]
    coded = []
    for each in options:
        file = functools.cache(functools.partial(_pillow, TITLES[codec], texels, **each))
        coded.append(file(Budget(nbytes).largest(file, qualities, strict=False)))
    return min(coded, key=lambda e: (max(0, e.nbytes - nbytes), _squared(texels / np.float32(255), e.image)))


def _pillow(name: str, texels: np.ndarray, quality: int, **options) -> Encoded:
    """Encode texels as one or two files of Pillow."""
    decoded, size = np.empty(texels.shape, np.float32), 0
    for group in (([0],), ([0], [1]), ([0, 1, 2],), ([0, 1, 2], [3]))[texels.shape[2] - 1]:
        file, pixels = io.BytesIO(), texels[..., group[0] if len(group) == 1 else group]
        problem = f"{name} cannot store {texels.shape[1]}x{texels.shape[0]} texels"
        with raised_as(UsageError, OSError, ValueError, at=problem):  # too large
            Image.fromarray(np.ascontiguousarray(pixels)).save(file, name.upper(), quality=quality, **options)
        size += file.tell()
        with Image.open(file) as opened:
            values = np.asarray(opened.convert("L" if len(group) == 1 else "RGB"))
        decoded[..., group] = values.reshape(*texels.shape[:2], -1) / np.float32(255)
    return Encoded(f"{name} {quality}", size, [decoded])


# -- Images ------------------------------------------------------------------------------------------------------------


def enlarged(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Enlarge each channel to the rows and columns of ``shape`` with bicubic filtering, clipped to [0, 1]."""
    planes = [Image.fromarray(np.ascontiguousarray(plane, np.float32)) for plane in np.moveaxis(image, -1, 0)]
    return np.clip(np.stack([plane.resize(shape[1::-1], Image.Resampling.BICUBIC) for plane in planes], -1), 0, 1)


def _texels(image: np.ndarray) -> np.ndarray:
    """Return an image in 8 bits."""
    return np.rint(image * np.float32(255)).astype(np.uint8)


def _squared(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the sum of squared differences."""
    return float(np.sum((reference - image) ** 2, dtype=np.float64))
