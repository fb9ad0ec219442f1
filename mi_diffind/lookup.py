"""
Multilinear reads of small tables: 1 to 4 dimensions, any number of channels, three storage forms.

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

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

import drjit as dr

#: Storage forms: for training, for storing, for inference.
STORAGES = ("float32", "float16", "uint8")

BORDERS = ("clamp", "repeat")


def clamp(x, low: float, high: float):
    """
    ``x`` limited to ``[low, high]``; NaN becomes ``low``.

    Unlike ``dr.clip``, which propagates NaN, and unlike ``dr.fmin``/``dr.fmax``, whose gradient at a tie belongs to the
    bound, this keeps the gradient of ``x`` at the bounds themselves.
    """
    x = dr.select(x >= low, x, low)
    return dr.select(x <= high, x, high)


def padded_channels(channels: int) -> int:
    """Channels as stored: 1, 2, or the next multiple of 4, so that every read is a packet gather."""
    return channels if channels <= 2 else 4 * math.ceil(channels / 4)


def corner_bits(dims: int, channels: int) -> int:
    """
    How many trailing axes have both their corners inside one packed ``UInt32``: the largest ``k`` with
    ``channels · 2^k ≤ 4``. A one-channel bilinear read (k = 2) needs a single gather.
    """
    return min(dims, {1: 2, 2: 1}.get(channels, 0))


def gathers(resolution: Sequence[int], channels: int, storage: str) -> int:
    """Number of gather instructions that one read takes."""
    dims = len(resolution)
    if storage == "uint8":
        return 2 ** (dims - corner_bits(dims, channels)) * math.ceil(channels / 4)
    return 2**dims * max(1, padded_channels(channels) // 4)


def _axis(x, n: int, border: str):
    """Cell index, next index and weight of the next one along an axis with ``n`` entries."""
    UInt32 = dr.uint32_array_t(type(x))
    if n == 1:
        zero = UInt32(0)
        return zero, zero, type(x)(0)
    if border == "repeat":
        position = clamp(x - dr.floor(x), 0.0, 1.0) * n
        lower = dr.minimum(UInt32(position), n - 1)
        upper = dr.select(lower == n - 1, 0, lower + 1)
    else:
        position = clamp(x, 0.0, 1.0) * (n - 1)
        lower = dr.minimum(UInt32(position), n - 2)
        upper = lower + 1
    return lower, upper, position - type(x)(lower)


def _corners(axes, resolution):
    """All ``2^d`` pairs (texel index, weight) of a cell, built axis by axis so that products are shared."""
    result = [(None, None)]
    for (lower, upper, w), n in zip(axes, resolution, strict=True):
        grown = []
        for index, weight in result:
            for i, v in ((lower, 1 - w), (upper, w)):
                grown.append((i if index is None else dr.fma(index, n, i), v if weight is None else weight * v))
        result = grown
    return result


def _weighted_sum(terms):
    """Σ weight · value for each channel."""
    total = None
    for weight, values in terms:
        if total is None:
            total = [weight * v for v in values]
        else:
            total = [dr.fma(weight, v, t) for v, t in zip(values, total, strict=True)]
    return total


def read_float(
    data, resolution: Sequence[int], channels: int, x: Sequence, border: Sequence[str], active=True, transform=None
):
    """
    Read a table of 16- or 32-bit floats.

    ``data`` is the flat array of shape ``(N_1·…·N_d·padded_channels(channels),)``, ``x`` the ``d`` coordinates.
    Returns a list of ``channels`` arrays of the coordinates' (single precision) type. Differentiable with respect to
    ``data`` and ``x``. ``transform`` is applied to each entry that was fetched.
    """
    Float = type(x[0])
    stored = padded_channels(channels)
    packet = min(stored, 4)
    groups = stored // packet
    module = sys.modules[Float.__module__]
    suffix = "f16" if dr.is_half_v(type(data)) else "f"
    Packet = None if packet == 1 else getattr(module, f"Array{packet}{suffix}")

    def fetch(index):
        if Packet is None:
            values = [Float(dr.gather(type(data), data, index, active))]
        else:
            values = []
            for group in range(groups):
                where = index if groups == 1 else dr.fma(index, groups, group)
                values += [Float(v) for v in dr.gather(Packet, data, where, active)]
            values = values[:channels]
        return values if transform is None else [transform(v) for v in values]

    axes = [_axis(v, n, b) for v, n, b in zip(x, resolution, border, strict=True)]
    return _weighted_sum((weight, fetch(index)) for index, weight in _corners(axes, resolution))


def read_packed(
    words,
    scale,
    offset,
    resolution: Sequence[int],
    channels: int,
    x: Sequence,
    border: Sequence[str],
    active=True,
):
    """
    Read a table of bytes packed in ``UInt32`` words (:func:`pack`). Channel ``k`` of the result is
    ``offset[k] + scale[k] · (interpolated byte)``. Differentiable with respect to ``x`` only.

    A byte becomes a float by a bit trick: placed in the mantissa of a number in [1, 2) it reads ``1 + byte/256``, and
    since the weights of a read sum to one, the ones are subtracted once at the end.
    """
    Float = type(x[0])
    dims = len(resolution)
    inner = corner_bits(dims, channels)
    per_texel = math.ceil(channels / 4)
    axes = [_axis(v, n, b) for v, n, b in zip(x, resolution, border, strict=True)]

    # Axes whose corners share a word contribute their lower index only; their weights select bytes of the word.
    outer = dims - inner
    merged = [(a if k < outer else (a[0], a[0], a[2])) for k, a in enumerate(axes)]
    byte_weights = [None]
    for _, _, w in axes[outer:]:
        byte_weights = [v if b is None else b * v for b in byte_weights for v in (1 - w, w)]

    def mantissa(word, byte: int):
        shift = 15 - 8 * byte
        moved = word << shift if shift >= 0 else word >> -shift
        return dr.reinterpret_array(Float, (moved & 0x7F8000) | 0x3F800000)

    def fetch(index):
        values = []
        for group in range(per_texel):
            where = index if per_texel == 1 else dr.fma(index, per_texel, group)
            word = dr.gather(type(words), words, where, active)
            for channel in range(4 * group, min(channels, 4 * group + 4)):
                if inner == 0:
                    values.append(mantissa(word, channel - 4 * group))
                else:
                    corners = [mantissa(word, corner * channels + channel) for corner in range(2**inner)]
                    values.append(_weighted_sum(zip(byte_weights, ([c] for c in corners), strict=True))[0])
        return values

    outer_corners = _corners(axes[:outer], resolution[:outer]) if outer else [(None, None)]
    terms = []
    for index, weight in outer_corners:
        for (lower, _, _), n in zip(merged[outer:], resolution[outer:], strict=True):
            index = lower if index is None else dr.fma(index, n, lower)
        terms.append((weight, fetch(index)))
    sums = terms[0][1] if terms[0][0] is None else _weighted_sum(terms)
    values = [dr.fma(s - 1, 256 * scale[k], offset[k]) for k, s in enumerate(sums)]
    # A masked gather gives the byte 0, which means `offset`, not 0.
    return values if active is True else [dr.select(active, v, 0) for v in values]


def quantize(values, channels: int):
    """
    Bytes of a NumPy array of shape ``(…, channels)``, one affine map a channel.

    Returns ``(codes, scale, offset)`` with ``values ≈ offset + scale · codes``, at most half a ``scale`` off; the
    smallest and the largest value of each channel are hit exactly.
    """
    import numpy as np

    flat = np.asarray(values, dtype=np.float64).reshape(-1, channels)
    if not np.isfinite(flat).all():
        raise ValueError("entries that are NaN or infinite cannot be stored as bytes")
    offset = flat.min(axis=0)
    scale = (flat.max(axis=0) - offset) / 255
    codes = np.rint((flat - offset) / np.where(scale > 0, scale, 1))
    return codes.astype(np.uint8).reshape(np.shape(values)), scale, offset


def pack(codes, border: Sequence[str]):
    """
    The words that :func:`read_packed` reads, from a NumPy ``uint8`` array of shape ``(N_1, …, N_d, c)``: a flat
    ``uint32`` array, little end first, channels (and shared corners, last axis fastest) in ascending bytes.
    """
    import numpy as np

    codes = np.asarray(codes, dtype=np.uint8)
    *resolution, channels = codes.shape
    dims = len(resolution)
    inner = corner_bits(dims, channels)
    parts = [codes]
    for axis in range(dims - inner, dims):
        n = resolution[axis]
        following = np.arange(1, n + 1)
        following = following % n if border[axis] == "repeat" else np.minimum(following, n - 1)
        parts = [q for p in parts for q in (p, np.take(p, following, axis=axis))]
    joined = np.concatenate(parts, axis=-1)
    missing = -joined.shape[-1] % 4
    joined = np.concatenate([joined, np.zeros((*resolution, missing), np.uint8)], axis=-1)
    return np.ascontiguousarray(joined).view("<u4").astype(np.uint32).reshape(-1)
