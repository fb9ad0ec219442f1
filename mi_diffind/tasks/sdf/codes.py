"""Codes of a sparse grid's nodes: each node holds a distance and a normal, coded in the frame of its block.

A block of 4 × 4 × 4 nodes is described by a plane, its *frame*: a normal N (octahedral, 2 × 10 bits), the distance D of
the block's middle (8 bits), and a scale s (4 bits). A node holds a pointer into one small array that all blocks share,
the *cascaded array*. Its entry ``(e, a, b)`` says how the node differs from the plane. With the offset o from the
middle, in spacings,

    distance = D + N·o + s e,    normal = c N + f s (a T + b B),    r² = s² (a² + b²),  c = 1 − r²/2,  f = √(1 − r²/4)

where T and B complete N to a frame, and (a, b) are coordinates of Lambert's azimuthal projection, which reach every
direction. The array is learned: see :mod:`.encoding`. Functions accept Dr.Jit arrays, or NumPy arrays in double
precision.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import drjit as dr
import numpy as np

#: Bits of a frame: each coordinate of the normal, the distance of the middle, the scale.
NORMAL_BITS, DISTANCE_BITS, SCALE_BITS = 10, 8, 4

#: Largest distance of a block's middle, in spacings.
REACH = 4.5

#: The scale is 2^(k/2 − SMALLEST), k from 0 to 15.
SMALLEST = 7

#: Bits of an entry of the cascaded array: distance, and both coordinates of the normal.
ENTRY_BITS = (10, 11, 11)

#: Radius slightly below that at which the projection reaches the direction opposite to N.
EDGE = 1.999

#: Bits of a pointer → pointers in a word of 32 bits.
POINTERS = {4: 8, 5: 6, 6: 5, 8: 4, 10: 3, 16: 2}

#: The functions of Dr.Jit that codes need, for NumPy arrays.
NUMPY = SimpleNamespace(
    abs=np.abs, minimum=np.minimum, maximum=np.maximum, sqrt=np.sqrt, copysign=np.copysign, select=np.where,
    fma=lambda a, b, c: a * b + c, rcp=lambda x: 1 / x, rsqrt=lambda x: 1 / np.sqrt(np.maximum(x, 1e-300)),
)  # fmt: skip


def _functions(array):
    """Return the functions for an array: those of Dr.Jit, or :data:`NUMPY`."""
    return dr if dr.is_array_v(array) else NUMPY


def orthonormal(n):
    """Return two vectors that complete unit vectors ``n`` to a right-handed frame (Duff et al., JCGT 2017)."""
    x, y, z = n
    sign = _functions(z).select(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def to_octahedral(normals: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) as whole numbers (n, 2) of :data:`NORMAL_BITS` bits."""
    n = normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-30)
    folded = (1 - np.abs(n[:, 1::-1])) * np.where(n[:, :2] >= 0, 1, -1)
    xy = np.where(n[:, 2:] < 0, folded, n[:, :2])
    top = 2**NORMAL_BITS - 1
    return np.clip(np.round((xy + 1) / 2 * top), 0, top).astype(np.uint32)


def frame_words(normals: np.ndarray, distances: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Pack frames into words (B,): normals (B, 3), distances in spacings (B,), scales (B,), which are rounded up."""
    x, y = to_octahedral(normals).T
    top = 2**DISTANCE_BITS - 1
    d = np.clip(np.round((distances / REACH + 1) / 2 * top), 0, top).astype(np.uint32)
    k = np.ceil(2 * (np.log2(np.maximum(scales, 1e-9)) + SMALLEST) - 0.5)
    k = np.clip(k, 0, 2**SCALE_BITS - 1).astype(np.uint32)
    return x | y << np.uint32(10) | d << np.uint32(20) | k << np.uint32(28)


def frames(words, Float=np.float64):
    """Unpack the frames of blocks: the normal (three arrays), the middle's distance in spacings, and the scale.

    ``words`` are ``UInt32`` and ``Float`` the type of the result, of Dr.Jit; or a NumPy array of words.
    """
    f, top = _functions(words), 2**NORMAL_BITS - 1
    x = f.fma(Float(words & top), 2 / top, -1)
    y = f.fma(Float(words >> 10 & top), 2 / top, -1)
    z = 1 - f.abs(x) - f.abs(y)
    t = f.maximum(-z, 0)
    x, y = x - f.copysign(t, x), y - f.copysign(t, y)
    inverse = f.rsqrt(f.fma(x, x, f.fma(y, y, z * z)))
    d = f.fma(Float(words >> 20 & 255), 2 * REACH / 255, -REACH)
    k = words >> 28
    if f is NUMPY:
        power = np.exp2((k >> 1) - float(SMALLEST))
    else:
        power = dr.reinterpret_array(Float, ((k >> 1) + (127 - SMALLEST)) << 23)
    return (x * inverse, y * inverse, z * inverse), d, f.select((k & 1) == 1, power * math.sqrt(2), power)


def residuals(distances, normals, offsets, n, d, scales) -> np.ndarray:
    """Return the exact entries ``(m, 3)`` of nodes: the inverse of :func:`decode_nodes`.

    Nodes have ``distances`` (m,) in spacings, ``normals`` (m, 3) and ``offsets`` from the middle of their block (m, 3);
    their frames are ``n`` (three arrays), ``d`` (m,) and ``scales`` (m,).
    """
    t, b = (np.stack(v, axis=1) for v in orthonormal(n))
    n = np.stack(n, axis=1)
    c = np.sum(normals * n, axis=1)
    stretch = np.sqrt(2 / np.maximum(1 + c, 1e-6))
    a, b = np.sum(normals * t, axis=1) * stretch, np.sum(normals * b, axis=1) * stretch
    e = distances - d - np.sum(offsets * n, axis=1)
    return np.stack([e, a, b], axis=1) / scales[:, None]


def decode_nodes(entry, n, d, scale, offset):
    """Return the distance (in spacings) and the normal (three arrays) of nodes.

    ``entry`` is ``(e, a, b)``; ``n`` (three arrays), ``d`` and ``scale`` are the frame; ``offset`` (three arrays) is
    the node's position relative to the block's middle.
    """
    functions = _functions(n[0])
    e, a, b = (v * scale for v in entry)
    square = a * a + b * b
    # Entries beyond the edge count as on it. Few divisions and roots: rays spend their time here
    inside, inverse = functions.minimum(square, EDGE**2), -functions.rcp(1 + functions.abs(n[2]))
    f = functions.sqrt(1 - inside / 4) * functions.select(square > EDGE**2, EDGE * functions.rsqrt(square), 1)
    # T and B are those of :func:`orthonormal`, their products with N shared
    x, y, z = n
    sign = functions.select(z >= 0, 1.0, -1.0)
    c, p, q = 1 - inside / 2, f * a, sign * f * b
    m = sign * (x * p + y * q)
    along = c + sign * inverse * m
    return d + x * offset[0] + y * offset[1] + z * offset[2] + e, (x * along + p, y * along + q, c * z - m)


def entry_scale(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and step of each channel, (3,) twice, with which entries (K, 3) round to :data:`ENTRY_BITS`."""
    low, high = entries.min(axis=0), entries.max(axis=0)
    steps = np.maximum(high - low, 1e-6) / (2.0 ** np.array(ENTRY_BITS) - 1)
    return low.astype(np.float32), steps.astype(np.float32)


def entry_words(entries: np.ndarray, offset, step) -> np.ndarray:
    """Pack entries (K, 3) into words (K,)."""
    top = 2 ** np.array(ENTRY_BITS) - 1
    e, a, b = np.clip(np.round((entries - offset) / step), 0, top).astype(np.uint32).T
    return e | a << np.uint32(10) | b << np.uint32(21)


def entries(words, offset, step, Float=np.float64):
    """Unpack the entries of words: three arrays; types as in :func:`frames`."""
    parts = words & 1023, words >> 10 & 2047, words >> 21
    fma = _functions(words).fma
    return [fma(Float(p), s, o) for p, s, o in zip(parts, step, offset, strict=True)]


def pointer_words(pointers: np.ndarray, bits: int) -> np.ndarray:
    """Pack pointers (n,) into words (⌈n / k⌉,), k to a word, the first one in the lowest bits."""
    each = POINTERS[bits]
    padded = np.zeros(-(-len(pointers) // each) * each, np.uint32)
    padded[: len(pointers)] = pointers
    shifts = (np.arange(each) * bits).astype(np.uint32)
    return np.bitwise_or.reduce(padded.reshape(-1, each) << shifts, axis=1)


def pointers_of(words: np.ndarray, bits: int, count: int) -> np.ndarray:
    """Unpack ``count`` pointers from words."""
    each = POINTERS[bits]
    shifts = (np.arange(each) * bits).astype(np.uint32)
    return (words[:, None] >> shifts & np.uint32(2**bits - 1)).reshape(-1)[:count]


def pointer_at(source, index, bits: int, active):
    """Gather the pointers at positions ``index`` from words (Dr.Jit arrays)."""
    each = POINTERS[bits]
    word = index // each
    return dr.gather(type(index), source, word, active) >> ((index - word * each) * bits) & (2**bits - 1)
