"""Multilinear reads of small tables: 1 to 4 dimensions, any number of channels, three storage forms.

Conventions, the same everywhere in this package:

- **Axes.** A table of ``d`` dimensions has the shape ``(N_1, …, N_d, c)``; coordinate ``x[k]`` runs along axis ``k``.
- **Texel positions** are cell *corners*. Along an axis with a ``"clamp"`` border, entry ``i`` sits at ``i / (N − 1)``,
  so that the first and the last entry are the values at exactly 0 and exactly 1: the end points of a BRDF's domain
  are stored, not extrapolated. Along an axis with a ``"repeat"`` border, entry ``i`` sits at ``i / N`` and entry 0
  follows entry ``N − 1``.
- **Outside [0, 1].** ``"clamp"`` reads the nearest end, ``"repeat"`` wraps. A coordinate that is NaN reads as 0, and
  so does an infinite one under ``"repeat"``. No coordinate leads to an index outside the table.
- **Gradients** with respect to the coordinate are those of the cell that is read; at exactly 0 and exactly 1 they are
  those of the first and the last cell (not zero), beyond a clamped border they are zero.

Everything works on any JIT backend of Dr.Jit; nothing here knows Mitsuba.
"""

import math
from collections.abc import Sequence

import drjit as dr
import numpy as np

from ..core.compat import backend_module

#: Storage forms: for training, for storing, for inference.
STORAGES = ("float32", "float16", "uint8")

BORDERS = ("clamp", "repeat")


def clamp(x, low: float, high: float):
    """Limit ``x`` to ``[low, high]``; NaN becomes ``low``.

    Unlike ``dr.clip``, which propagates NaN, and unlike ``dr.fmin``/``dr.fmax``, whose gradient at a tie belongs to the
    bound, this keeps the gradient of ``x`` at the bounds themselves.
    """
    x = dr.select(x >= low, x, low)
    return dr.select(x <= high, x, high)


def padded_channels(channels: int) -> int:
    """Return the number of stored channels, 1, 2, or the next multiple of 4, so that every read is a packet gather."""
    return channels if channels <= 2 else 4 * math.ceil(channels / 4)


#: A packed table may hold each entry several times, so that one gather brings several corners of a cell, as long as it
#: stays below this size, in bytes: about what the cache of one core holds.
WIDE_BYTES = 2**20


def packed_layout(resolution: Sequence[int], channels: int) -> tuple[int, int, int]:
    """Return the layout of a packed table of bytes: ``(inner, stride, words)``.

    A texel stores the ``2^inner`` corners of a cell along the last ``inner`` axes, each in ``stride`` bytes, in
    ``words`` words of 32 bits. One word may hold what fits (a one-channel bilinear read is a single gather), and up to
    four words if the table stays below :data:`WIDE_BYTES`.
    """
    stride = padded_channels(channels)
    for inner in range(len(resolution), 0, -1):
        words = math.ceil(stride * 2**inner / 4)
        if words == 1 or (words in (2, 4) and math.prod(resolution) * 4 * words <= WIDE_BYTES):
            return inner, stride, words
    return 0, stride, math.ceil(stride / 4)


def _packet(count: int) -> int:
    """Return how many of ``count`` consecutive values one gather fetches."""
    return next(p for p in (4, 2, 1) if count % p == 0)


def gathers(resolution: Sequence[int], channels: int, storage: str, bits: int = 8) -> int:
    """Return the number of gather instructions that one read of all channels takes on the CPU."""
    dims = len(resolution)
    if storage == "uint8" and bits < 8:
        return 2 ** (dims - 1) * pair_words(channels, bits)
    if storage == "uint8":
        inner, _, words = packed_layout(resolution, channels)
        return 2 ** (dims - inner) * words
    stored = padded_channels(channels)
    return 2**dims * (stored // _packet(stored))


def _axis(x, n: int, border: str, inside: bool = False):
    """Return the cell, the next cell and the weight of the next one along an axis with ``n`` entries.

    ``inside``: ``x`` is in [0, 1].
    """
    UInt32 = dr.uint32_array_t(type(x))
    if n == 1:
        zero = UInt32(0)
        return zero, zero, type(x)(0)
    if border == "repeat":
        position = clamp(x - dr.floor(x), 0.0, 1.0) * n
        lower = dr.minimum(UInt32(position), n - 1)
        upper = dr.select(lower == n - 1, 0, lower + 1)
    else:
        position = (x if inside else clamp(x, 0.0, 1.0)) * (n - 1)
        lower = dr.minimum(UInt32(position), n - 2)
        upper = lower + 1
    return lower, upper, position - type(x)(lower)


def _corners(axes, resolution):
    """Return the ``2^d`` pairs (texel index, weight) of a cell, built axis by axis so that products are shared.

    Along an axis whose coordinate is a number that Dr.Jit knows, such as 0, only corners of weight other than zero.
    """
    result = [(None, None)]
    for (lower, upper, w), n in zip(axes, resolution, strict=True):
        ends, grown = [(lower, 1 - w), (upper, w)], []
        if w.state == dr.VarState.Literal and not dr.grad_enabled(w) and w[0] == 0:
            ends.pop()
        for index, weight in result:
            for i, v in ends:
                grown.append((i if index is None else dr.fma(index, n, i), v if weight is None else weight * v))
        result = grown
    return result


def weighted_sum(terms):
    """Return Σ weight · value for each channel."""
    terms = iter(terms)  # values are fetched one after the other
    weight, values = next(terms)
    total = [weight * v for v in values]
    for weight, values in terms:
        total = [dr.fma(weight, v, t) for v, t in zip(values, total, strict=True)]
    return total


def corners(x: Sequence, resolution: Sequence[int], border: Sequence[str]) -> list:
    """Return the ``2^d`` pairs (index of an entry, weight) of a multilinear read at the ``d`` coordinates ``x``."""
    return _corners([_axis(v, n, b) for v, n, b in zip(x, resolution, border, strict=True)], resolution)


def read_floats(data, channels: int, stored: int, corners, active=True, transform=None) -> list:
    """Return the sum of entries of a table of 16- or 32-bit floats, as single-precision arrays, one a channel.

    ``data`` is the flat array of entries of ``stored`` numbers each; ``corners`` are pairs (index of an entry, weight).
    Differentiable with respect to the entries and the weights. ``transform`` is applied to each number that was
    fetched.
    """
    Float = dr.float32_array_t(type(data))
    packet = _packet(stored)
    groups = stored // packet
    suffix = "f16" if dr.is_half_v(type(data)) else "f"
    Packet = None if packet == 1 else getattr(backend_module(Float), f"Array{packet}{suffix}")

    def fetch(index) -> list:
        values = []
        for group in range(groups):
            where = index if groups == 1 else dr.fma(index, groups, group)
            packet_values = dr.gather(Packet or type(data), data, where, active)
            values += [Float(v) for v in (packet_values if Packet else [packet_values])]
        values = values[:channels]
        return values if transform is None else [transform(v) for v in values]

    return weighted_sum((weight, fetch(index)) for index, weight in corners)


def read_packed(
    words,
    scale,
    offset,
    resolution: Sequence[int],
    channels: int,
    x: Sequence,
    border: Sequence[str],
    active=True,
    inside: bool = False,
):
    """Read a table of bytes packed in ``UInt32`` words (:func:`pack`).

    Channel ``k`` of the result is ``offset[k] + scale[k] · (interpolated byte)``. Differentiable with respect to ``x``
    only. ``inside``: all coordinates are known to lie in [0, 1], which saves a comparison.

    Two bytes of a word lie where a float has its mantissa, and rotated by half a word so do the other two. Under the
    exponent of 1, they read ``1 + byte/256`` and ``1 + byte/65536`` without any conversion; since the weights of a read
    sum to one, the ones are subtracted once at the end. The second pair loses at most 1/64 of a step by that in 1D and
    2D, and more with more corners: from 3D on those bytes are converted instead.
    """
    Float = type(x[0])
    UInt32, Int32 = type(words), dr.int32_array_t(type(words))
    module = backend_module(Float)
    inner, stride, per_texel = packed_layout(resolution, channels)
    axes = [_axis(v, n, b, inside) for v, n, b in zip(x, resolution, border, strict=True)]
    outer = len(resolution) - inner
    # On the CPU, a packet takes as long as a gather of each of its words, those included that nothing needs
    packet = _packet(per_texel) if dr.backend_v(UInt32) == dr.JitBackend.CUDA else 1
    groups = per_texel // packet

    convert = len(resolution) > 2

    inner_weights = [None]
    for _, _, w in axes[outer:]:
        inner_weights = [v if b is None else b * v for b in inner_weights for v in (1 - w, w)]

    def fetch(index) -> list:
        """All words of a texel, each also rotated."""
        gathered = []
        for group in range(groups):
            where = index if groups == 1 else dr.fma(index, groups, group)
            if packet == 1:
                gathered.append(dr.gather(UInt32, words, where, active))
            else:
                gathered += list(dr.gather(getattr(module, f"Array{packet}u"), words, where, active))
        return [(w, (w << 16) | (w >> 16)) for w in gathered]

    def byte(texel, position: int):
        word = texel[position // 4][position % 4 // 2]
        if position % 2 and channels == 1:  # the corners of one channel are summed, so all have to be of one kind
            word = word << 8
        elif position % 2:
            low = word & 0x7F80
            return Float(Int32(low)) if convert else dr.reinterpret_array(Float, low | 0x3F800000)
        return dr.reinterpret_array(Float, (word & 0x7F8000) | 0x3F800000)

    terms = []
    for index, weight in _corners(axes[:outer], resolution[:outer]) if outer else [(None, None)]:
        # Axes whose corners share a texel contribute their lower index only
        for (lower, _, _), n in zip(axes[outer:], resolution[outer:], strict=True):
            index = lower if index is None else dr.fma(index, n, lower)
        texel = fetch(index)
        corners = [[byte(texel, k * stride + channel) for channel in range(channels)] for k in range(2**inner)]
        if channels > 2:  # weights that all channels share are less work than a step along each axis for each
            corners = [weighted_sum(zip(inner_weights, corners, strict=True))] if inner else corners
        else:
            for _, _, w in reversed(axes[outer:]):
                pairs = zip(corners[::2], corners[1::2], strict=True)
                corners = [[dr.fma(w, b - a, a) for a, b in zip(*pair, strict=True)] for pair in pairs]
        terms.append((weight, corners[0]))
    sums = terms[0][1] if terms[0][0] is None else weighted_sum(terms)
    values = []
    for k, s in enumerate(sums):
        step = scale[k] / 128 if k % 2 and convert else (65536 if k % 2 else 256) * scale[k]
        ones = 0 if k % 2 and convert else step
        values.append(dr.fma(s, step, offset[k] - ones))
    # A masked gather gives the byte 0, which means `offset`, not 0.
    return values if active is True else [dr.select(active, v, 0) for v in values]


def channels_words(channels: int, bits: int, entries: int = 1) -> int:
    """Return the number of 32-bit words to read for all bits of consecutive entries of fewer than 8 bits a channel."""
    width = channels * bits
    return (entries * width + 63 - math.gcd(width, 32)) // 32  # entries begin at multiples of the divisor


def pair_words(channels: int, bits: int) -> int:
    """Return the number of gathers that bring two neighbouring entries of fewer than 8 bits a channel."""
    return min(2 * channels_words(channels, bits), channels_words(channels, bits, 2))


def resolution_in_memory(resolution: Sequence[int], border: Sequence[str]) -> tuple[int, ...]:
    """Return the resolution in memory of a table of fewer than 8 bits a channel.

    If the last axis repeats, its first entry follows the last one, so that the two entries of a cell are neighbours.
    """
    *outer, n = resolution
    return (*outer, n + (border[-1] == "repeat" and n > 1))


def neighbour_pairs(x: Sequence, resolution: Sequence[int], border: Sequence[str], inside: bool = False) -> list:
    """Return the entries that a multilinear read of a table of fewer than 8 bits a channel blends.

    They are pairs: the index of an entry, and the weights of it and of the next one along the last axis.
    """
    axes = [_axis(v, n, b, inside) for v, n, b in zip(x, resolution, border, strict=True)]
    stored, (lower, _, w) = resolution_in_memory(resolution, border), axes[-1]
    ends, pairs = (1 - w, w), []
    for index, weight in _corners(axes[:-1], stored[:-1]):
        index = lower if index is None else dr.fma(index, stored[-1], lower)
        pairs.append((index, ends if weight is None else [weight * end for end in ends]))
    return pairs


def read_words(
    words, scale, offset, channels: int, runs, active=True, bits: int = 4, resolution: Sequence[int] | None = None
) -> list:
    """Return the sum of entries of a table of words, by weights that sum to 1, for each channel.

    ``runs`` are pairs: the index of an entry, and the weights of it and of those that follow it. Entries have ``bits``
    bits a channel, one entry after the other (:func:`pack_bits`, and one word to spare for each entry of a run). With a
    ``resolution``, they are the bytes of :func:`pack`, and a run has one entry. Scale and offset are applied once, to
    the sum. Differentiable with respect to the weights.
    """
    Float, terms = dr.float32_array_t(type(words)), []
    steps = bit_steps(channels, bits) if resolution is None else [2.0**-15, 2.0**-7] * channels
    per_texel = 0 if resolution is None else packed_layout(resolution, channels)[2]
    for index, weights in runs:
        if per_texel:
            entries = [_fetch_bytes(words, channels, per_texel, active, Float, index)]
        else:
            entries = fetch_bits(words, channels, bits, active, Float, index, len(weights))
        terms += zip(weights, entries, strict=True)
    values = [dr.fma(v, scale[k] * steps[k], offset[k]) for k, v in enumerate(weighted_sum(terms))]
    return values if active is True else [dr.select(active, v, 0) for v in values]


def _fetch_bytes(words, channels: int, per_texel: int, active, Float, index) -> list:
    """Return the bytes of an entry of a packed table as ``Float``, still to be multiplied by 2⁻¹⁵ and 2⁻⁷ in turn."""
    UInt32, Int32, codes = type(words), dr.int32_array_t(type(words)), []
    for word in range((channels + 3) // 4):
        value = dr.gather(UInt32, words, index if per_texel == 1 else index * per_texel + word, active)
        for rotated in (value, (value << 16) | (value >> 16)):
            codes += [Float(Int32(rotated & mask)) for mask in (0x7F8000, 0x7F80)]
    return codes[:channels]


def fetch_bits(words, channels: int, bits: int, active, Float, index, entries: int = 1) -> list[list]:
    """Return the numbers that :func:`pack_bits` packed for one entry, or for it and the next one, for each.

    They are ``Float``, still to be multiplied by :func:`bit_steps`: bits stay where they are in a word, which saves a
    shift for each number. A table has one word to spare for each of the ``entries``.
    """
    UInt32, width = type(words), channels * bits
    count = channels_words(channels, bits, entries)
    if entries > 1 and channels_words(channels, bits) == 1 < count:  # no entry crosses a word
        return [fetch_bits(words, channels, bits, active, Float, index + i)[0] for i in range(entries)]
    start = index * width
    first, shift = start >> 5, start & 31
    gathered = [dr.gather(UInt32, words, first + i, active) for i in range(count)]
    if count > 1:  # what is left of a word, and what the next one adds above it: for LLVM, one funnel shift
        pairs = zip(gathered, [*gathered[1:], UInt32(0)], strict=True)
        gathered = [((high << 1) << (shift ^ 31)) | (low >> shift) for low, high in pairs]
    else:
        gathered = [gathered[0] >> shift]
    return [_numbers(_shift_right(gathered, i * width), channels, bits, Float) for i in range(entries)]


def _shift_right(words: list, by: int) -> list:
    """Return the words of a long number, the lowest first, without its lowest bits."""
    skipped, shift = divmod(by, 32)
    words = words[skipped:]
    if shift == 0:
        return words
    ahead = [*(word << (32 - shift) for word in words[1:]), None]
    return [word >> shift if more is None else (word >> shift) | more for word, more in zip(words, ahead, strict=True)]


def _numbers(words: list, channels: int, bits: int, Float) -> list:
    """Return the numbers of ``bits`` bits in words as ``Float``, divided by :func:`bit_steps`."""
    Int32, values = dr.int32_array_t(type(words[0])), []
    for k, step in enumerate(bit_steps(channels, bits)):
        word, at = divmod(k * bits, 32)
        value = words[word]
        if step == 1:
            value = value >> at
            if at + bits > 32:
                value |= words[word + 1] << (32 - at)
            at = 0
        values.append(Float(Int32(value & ((2**bits - 1) << at))))
    return values


def bit_steps(channels: int, bits: int) -> list[float]:
    """Return the powers of two by which numbers of :func:`fetch_bits` are to be multiplied."""
    places = [k * bits % 32 for k in range(channels)]
    return [2.0**-at if at + bits < 32 else 1.0 for at in places]


def quantize(values, channels: int):
    """Quantise a NumPy array of shape ``(…, channels)`` to bytes, with one affine map a channel.

    Returns ``(codes, scale, offset)`` with ``values ≈ offset + scale · codes``, at most half a ``scale`` off; the
    smallest and the largest value of each channel are hit exactly.
    """
    flat = np.asarray(values, dtype=np.float64).reshape(-1, channels)
    if not np.isfinite(flat).all():
        raise ValueError("entries that are NaN or infinite cannot be stored as bytes")
    offset = flat.min(axis=0)
    scale = (flat.max(axis=0) - offset) / 255
    codes = np.rint((flat - offset) / np.where(scale > 0, scale, 1))
    return codes.astype(np.uint8).reshape(np.shape(values)), scale, offset


def pack(codes, border: Sequence[str]):
    """Pack a NumPy ``uint8`` array of shape ``(N_1, …, N_d, c)`` into the words that :func:`read_packed` reads.

    Returns a flat ``uint32`` array in the layout of :func:`packed_layout`, the last axis fastest. See :func:`unpack`
    for the bits.
    """
    codes = np.asarray(codes, dtype=np.uint8)
    *resolution, channels = codes.shape
    inner, stride, words = packed_layout(resolution, channels)
    padding = [(0, 0)] * len(resolution)
    parts = [np.pad(codes, [*padding, (0, stride - channels)])]
    for axis in range(len(resolution) - inner, len(resolution)):
        n = resolution[axis]
        following = np.arange(1, n + 1)
        following = following % n if border[axis] == "repeat" else np.minimum(following, n - 1)
        parts = [q for p in parts for q in (p, np.take(p, following, axis=axis))]
    joined = np.concatenate(parts, axis=-1)
    joined = np.pad(joined, [*padding, (0, 4 * words - joined.shape[-1])]).reshape(-1, 4).astype(np.uint32)
    upper, lower = joined[:, 0] << 15 | joined[:, 1] << 7, joined[:, 2] << 15 | joined[:, 3] << 7
    return upper | lower >> 16 | lower << 16


def unpack(words, resolution: Sequence[int], channels: int):
    """Return the bytes of a packed table, ``(N_1, …, N_d, channels)``.

    Byte 0 of a word lies in bits 15 to 22, byte 1 in bits 7 to 14, and bytes 2 and 3 there once the word is rotated by
    16.
    """
    words = np.asarray(words, dtype=np.uint32)
    rotated = words << 16 | words >> 16
    codes = np.stack([words >> 15, words >> 7, rotated >> 15, rotated >> 7], axis=-1) & 0xFF
    return codes.astype(np.uint8).reshape(*resolution, -1)[..., :channels].copy()


#: Numbers that are packed or unpacked at a time, a multiple of 8.
PART = 2**16


def pack_bits(numbers: np.ndarray, bits: int) -> np.ndarray:
    """Pack the lowest ``bits`` bits of each unsigned number, in the order of the flat array: flat ``uint8``."""
    numbers = np.ascontiguousarray(numbers).reshape(-1, 1)
    packed = np.empty(-(-len(numbers) * bits // 8), np.uint8)
    for first in range(0, len(numbers), PART):  # flags take 8 or 32 bytes a number
        part = numbers[first : first + PART]
        if part.dtype != np.uint8:
            part = part.astype("<u4").view(np.uint8)
        flags = np.packbits(np.unpackbits(part, axis=1, bitorder="little")[:, :bits], bitorder="little")
        packed[first * bits // 8 : first * bits // 8 + len(flags)] = flags
    return packed


def unpack_bits(packed: np.ndarray, count: int, bits: int) -> np.ndarray:
    """Return the first ``count`` numbers of up to 8 bits that :func:`pack_bits` packed: flat ``uint8``."""
    numbers = np.empty(count, np.uint8)
    for first in range(0, count, PART):  # flags take 8 bytes a number
        part = numbers[first : first + PART]
        begin = first * bits // 8
        flags = np.unpackbits(packed[begin : begin + PART * bits // 8], count=len(part) * bits, bitorder="little")
        flags = np.pad(flags.reshape(-1, bits), ((0, 0), (0, 8 - bits)))
        part[:] = np.packbits(flags, axis=1, bitorder="little").reshape(-1)
    return numbers


def as_words(packed: np.ndarray, spare: int = 0) -> np.ndarray:
    """Return bytes as 32-bit words, filled up with zeros, and ``spare`` words of zeros after them."""
    return np.pad(packed, (0, -len(packed) % 4 + 4 * spare)).view("<u4")


def mask_words(flags: np.ndarray) -> np.ndarray:
    """Return each row of ``flags``, shape ``(…, 32 k)``, as ``k`` words: ``uint32`` of shape ``(…, k)``."""
    return np.packbits(flags, axis=-1, bitorder="little").view("<u4")


def mask_flags(masks: np.ndarray) -> np.ndarray:
    """Return the flags of rows of words, the inverse of :func:`mask_words`: ``bool`` of shape ``(…, 32 k)``."""
    return np.unpackbits(np.ascontiguousarray(masks, "<u4").view(np.uint8), axis=-1, bitorder="little").astype(bool)
