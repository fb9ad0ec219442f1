"""
What a sparse grid's nodes hold: a distance and a normal, coded in the frame of their block.

A block of 4 × 4 × 4 nodes is described by a plane, its *frame*: a normal N (octahedral, 2 × 10 bits), the distance D of
the block's middle (8 bits), and a scale s (4 bits). A node holds a pointer into one small array that all blocks share,
the *cascaded array*. Its entry ``(e, a, b)`` says how the node differs from the plane: with the offset o from the
middle, in spacings,

    distance = D + N·o + s e,    normal = c N + f s (a T + b B),    r² = s² (a² + b²),  c = 1 − r²/2,  f = √(1 − r²/4)

where T and B complete N to a frame, and (a, b) are coordinates of Lambert's azimuthal projection, which reach every
direction. The array is learned: see :mod:`.training`.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

#: Bits of a frame: of each of the normal's coordinates, of the middle's distance, of the scale.
NORMAL_BITS, DISTANCE_BITS, SCALE_BITS = 10, 8, 4

#: The largest distance of a block's middle, in spacings.
REACH = 4.5

#: The scale is 2^(k/2 − SMALLEST), k from 0 to 15.
SMALLEST = 7

#: Bits of an entry of the cascaded array: distance, and both coordinates of the normal.
ENTRY_BITS = (10, 11, 11)

#: The projection's radius, at which it reaches the direction opposite to N; kept a little below.
EDGE = 1.999


def orthonormal(n):
    """Two vectors that complete unit vectors ``n`` to a right-handed frame (Duff et al., JCGT 2017)."""
    x, y, z = n
    sign = _select(n, z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def _select(like, mask, a, b):
    return np.where(mask, a, b) if isinstance(like[0], np.ndarray) else dr.select(mask, a, b)


def to_octahedral(normals: np.ndarray) -> np.ndarray:
    """Unit vectors (n, 3) as whole numbers (n, 2) of :data:`NORMAL_BITS` bits."""
    n = normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-30)
    folded = (1 - np.abs(n[:, 1::-1])) * np.where(n[:, :2] >= 0, 1, -1)
    xy = np.where(n[:, 2:] < 0, folded, n[:, :2])
    top = 2**NORMAL_BITS - 1
    return np.clip(np.round((xy + 1) / 2 * top), 0, top).astype(np.uint32)


def frame_words(normals: np.ndarray, distances: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Frames as words (B,): normals (B, 3), distances of the middle in spacings (B,), scales (B,), rounded up."""
    x, y = to_octahedral(normals).T
    top = 2**DISTANCE_BITS - 1
    d = np.clip(np.round((distances / REACH + 1) / 2 * top), 0, top).astype(np.uint32)
    k = np.ceil(2 * (np.log2(np.maximum(scales, 1e-9)) + SMALLEST) - 0.5)
    k = np.clip(k, 0, 2**SCALE_BITS - 1).astype(np.uint32)
    return x | y << np.uint32(10) | d << np.uint32(20) | k << np.uint32(28)


def frames(words, types):
    """
    The normal (three), the middle's distance in spacings and the scale that words (Dr.Jit ``UInt32``) stand for.
    """
    Float = types.Float
    top = 2**NORMAL_BITS - 1
    x = dr.fma(Float(words & top), 2 / top, -1)
    y = dr.fma(Float(words >> 10 & top), 2 / top, -1)
    z = 1 - dr.abs(x) - dr.abs(y)
    t = dr.maximum(-z, 0)
    x, y = x - dr.copysign(t, x), y - dr.copysign(t, y)
    inverse = dr.rsqrt(dr.fma(x, x, dr.fma(y, y, z * z)))
    d = dr.fma(Float(words >> 20 & 255), 2 * REACH / 255, -REACH)
    k = words >> 28
    power = dr.reinterpret_array(Float, ((k >> 1) + (127 - SMALLEST)) << 23)
    return (x * inverse, y * inverse, z * inverse), d, dr.select((k & 1) == 1, power * math.sqrt(2), power)


def frames_numpy(words: np.ndarray):
    """As :func:`frames`, for arrays of numbers: ``(B, 3), (B,), (B,)`` in double precision."""
    words = words.astype(np.uint32)
    top = 2**NORMAL_BITS - 1
    x, y = (words & top) * (2 / top) - 1, (words >> 10 & top) * (2 / top) - 1
    z = 1 - np.abs(x) - np.abs(y)
    t = np.maximum(-z, 0)
    x, y = x - np.copysign(t, x), y - np.copysign(t, y)
    n = np.stack([x, y, z], axis=1)
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    return n, (words >> 20 & 255) * (2 * REACH / 255) - REACH, 2.0 ** ((words >> 28) / 2 - SMALLEST)


def residuals(distances, normals, offsets, n, d, scales) -> np.ndarray:
    """
    What entries ought to be: for nodes of distances (m,) in spacings, normals (m, 3) and offsets from the middle of
    their block (m, 3), whose frames are n (m, 3), d (m,) and scales (m,). ``(m, 3)``.
    """
    t, b = (np.stack(v, axis=1) for v in orthonormal(tuple(n.T)))
    c = np.sum(normals * n, axis=1)
    stretch = np.sqrt(2 / np.maximum(1 + c, 1e-6))
    a, b = np.sum(normals * t, axis=1) * stretch, np.sum(normals * b, axis=1) * stretch
    e = distances - d - np.sum(offsets * n, axis=1)
    return np.stack([e, a, b], axis=1) / scales[:, None]


def decoded(entry, n, d, scale, offset):
    """
    The distance (in spacings) and the normal of a node: entry ``(e, a, b)``, frame n (three), d and scale, and offset
    (three) from the block's middle. Arrays of Dr.Jit, or NumPy.
    """
    e, a, b = (v * scale for v in entry)
    square = a * a + b * b
    # Beyond the edge, on it
    if isinstance(n[0], np.ndarray):
        inside, inverse = np.minimum(square, EDGE**2), -1 / (1 + np.abs(n[2]))
        f = np.sqrt(1 - inside / 4) * np.where(square > EDGE**2, EDGE / np.sqrt(np.maximum(square, EDGE**2)), 1)
    else:  # few divisions and roots: this is where rays spend their time
        inside, inverse = dr.minimum(square, EDGE**2), -dr.rcp(1 + dr.abs(n[2]))
        f = dr.sqrt(1 - inside / 4) * dr.select(square > EDGE**2, EDGE * dr.rsqrt(square), 1)
    # T and B are those of :func:`orthonormal`, their products with N shared
    x, y, z = n
    sign = _select(n, z >= 0, 1.0, -1.0)
    c, p, q = 1 - inside / 2, f * a, sign * f * b
    m = sign * (x * p + y * q)
    along = c + sign * inverse * m
    return d + x * offset[0] + y * offset[1] + z * offset[2] + e, (x * along + p, y * along + q, c * z - m)


def entry_scale(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Offset and step of each channel, (3,) twice, with which entries (K, 3) are rounded to :data:`ENTRY_BITS`."""
    low, high = entries.min(axis=0), entries.max(axis=0)
    steps = np.maximum(high - low, 1e-6) / (2.0 ** np.array(ENTRY_BITS) - 1)
    return low.astype(np.float32), steps.astype(np.float32)


def entry_words(entries: np.ndarray, offset, step) -> np.ndarray:
    """Entries (K, 3) as words (K,)."""
    top = 2 ** np.array(ENTRY_BITS) - 1
    e, a, b = np.clip(np.round((entries - offset) / step), 0, top).astype(np.uint32).T
    return e | a << np.uint32(10) | b << np.uint32(21)


def entries_of(words, offset, step, types):
    """The entries, three arrays, that words (Dr.Jit ``UInt32``) stand for."""
    parts = words & 1023, words >> 10 & 2047, words >> 21
    return [dr.fma(types.Float(p), float(s), float(o)) for p, s, o in zip(parts, step, offset, strict=True)]


def entries_numpy(words: np.ndarray, offset, step) -> np.ndarray:
    """As :func:`entries_of`, for an array of numbers: (K, 3) in double precision."""
    return np.stack([words & 1023, words >> 10 & 2047, words >> 21], axis=1) * np.array(step) + np.array(offset)


#: Bits of a pointer → pointers in a word of 32 bits.
POINTERS = {4: 8, 5: 6, 6: 5, 8: 4, 10: 3, 16: 2}


def pointer_words(pointers: np.ndarray, bits: int) -> np.ndarray:
    """Pointers (n,) as words (⌈n / k⌉,), k to a word, the first one lowest."""
    each = POINTERS[bits]
    padded = np.zeros(-(-len(pointers) // each) * each, np.uint32)
    padded[: len(pointers)] = pointers
    shifts = (np.arange(each) * bits).astype(np.uint32)
    return np.bitwise_or.reduce(padded.reshape(-1, each) << shifts, axis=1)


def pointers_of(words: np.ndarray, bits: int, count: int) -> np.ndarray:
    """The reverse: (count,)."""
    each = POINTERS[bits]
    shifts = (np.arange(each) * bits).astype(np.uint32)
    return (words[:, None] >> shifts & np.uint32(2**bits - 1)).reshape(-1)[:count]


def pointer_at(source, index, bits: int, active):
    """The pointers at positions ``index``, gathered from words."""
    each = POINTERS[bits]
    word = index // each
    return dr.gather(type(index), source, word, active) >> ((index - word * each) * bits) & (2**bits - 1)
