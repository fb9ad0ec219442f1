"""Mip pyramids of the maps of a material, read trilinearly as graphics hardware does.

- **Levels.** Level 0 is the source. Each further level has max(1, n // 2) of the n texels along each axis, down to one
  texel. A texel is the mean of the rectangle that it covers: two by two texels of the level below; along an axis with
  an odd number of texels three, of which the outer two count in part (the "polyphase" box).
- **Averages.** sRGB colours are averaged as linear values and encoded again; values of high dynamic range as values,
  not as logarithms. Normals: the mean vector of all covered texels of level 0, rescaled to their mean length, so unit
  vectors stay unit vectors (a layout that leaves out the third component relies on that). Other maps: plain means.
- **Interpolation.** Linear values of sRGB colours, stored values of all other maps: bilinear in two levels, linear
  between the levels. The result is encoded again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType

import drjit as dr
import numpy as np

from ..arrays import lookup
from ..arrays.indirection import aligned
from ..core import compat
from ..images import srgb
from .compressed import FilteredMaps
from .layout import Layout, MapLayout, choose_borders
from .source import Source


def level_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """Return rows and columns of all levels of an image, down to a single texel."""
    count = max(height, width).bit_length()
    return [(max(1, height >> level), max(1, width >> level)) for level in range(count)]


def halved(values: np.ndarray) -> np.ndarray:
    """Return the next level of ``values``, ``(height, width, k)``: each texel is the mean of the area it covers."""
    for axis in (0, 1):
        n = values.shape[axis]
        if n == 1:
            continue
        half, rest = n // 2, values.swapaxes(0, axis)
        if n % 2 == 0:
            rest = 0.5 * (rest[0::2] + rest[1::2])
        else:
            i = np.arange(half, dtype=values.dtype).reshape(-1, *[1] * (values.ndim - 1))
            rest = ((half - i) * rest[0:-1:2] + half * rest[1::2] + (i + 1) * rest[2::2]) / n
        values = rest.swapaxes(0, axis)
    return values


class Pyramid(FilteredMaps):
    """Mip pyramid of the stored channels of a ``layout``, uncompressed: the reference of all filtered textures.

    ``values`` are the levels, float32, ``(height, width, stored)``, each channel in [0, 1] as :meth:`.Layout.encode`
    returns it. Without ``types`` the pyramid cannot be read, only its ``values``. Raises ``ValueError`` for levels of
    other shapes.
    """

    def __init__(self, layout: Layout, values: Sequence[np.ndarray], types: ModuleType | None, border):
        self.layout, self.types, self.border = layout, types, tuple(border)
        self.values = [np.asarray(level, np.float32) for level in values]
        sizes = level_sizes(layout.height, layout.width)
        expected = [(*size, layout.stored) for size in sizes]
        if [level.shape for level in self.values] != expected:
            raise ValueError(f"levels: found {[level.shape for level in self.values]}, expected {expected}")
        self._owners = [_owner(layout, channel) for channel in range(layout.stored)]
        self._texels = self._offsets = None
        if types is None or not layout.stored:
            return
        offsets = np.cumsum([0] + [rows * columns for rows, columns in sizes])
        padded = aligned((int(offsets[-1]), lookup.padded_channels(layout.stored)), np.float32)
        padded[:, layout.stored :] = 0
        for level, start, end in zip(self.values, offsets, offsets[1:], strict=False):
            flat = level.reshape(-1, layout.stored)
            for channel, owner in enumerate(self._owners):
                padded[start:end, channel] = _interpolated(flat[:, channel], owner)
        self._padded = padded.shape[-1]
        self._hold(types.TensorXf(padded).array, offsets[:-1])

    def _hold(self, texels, offsets: np.ndarray) -> None:
        """Keep the texels and the levels' offsets in memory of Dr.Jit: frozen functions take NumPy's for constants."""
        offsets = self.types.UInt32(offsets.astype(np.uint32))
        self._texels, self._offsets = compat.owned(texels), compat.owned(offsets)
        dr.eval(self._texels)

    @staticmethod
    def of(source: Source, layout: Layout | None = None, types: ModuleType | None = None, border=None) -> Pyramid:
        """Return the pyramid of a source.

        ``layout`` is any layout of this source (default: ``Layout.of(source, filtered=True)``); a stored channel of
        several maps is averaged as in the first of them. ``border`` along v and u is by default
        :func:`.layout.choose_borders`.
        """
        layout = layout or Layout.of(source, filtered=True)
        sizes = level_sizes(source.height, source.width)
        values = [np.zeros((*size, layout.stored), np.float32) for size in sizes]
        values[0] = layout.encode(source)
        for m, entry in zip(source.maps, layout.maps, strict=True):
            channels = [(c, w) for c, w in enumerate(entry.where) if isinstance(w, int) and _owner(layout, w) is entry]
            if not channels:
                continue
            vectors = m.role == "normal" and m.channels == 3
            signed = m.values.min() < 0
            if vectors:
                level = m.values if signed else 2 * m.values - 1
                level = np.concatenate([level, np.linalg.norm(level, axis=-1, keepdims=True)], axis=-1)
            else:
                level = srgb.to_linear(m.values) if m.color_space == "srgb" else m.values
                level = level.astype(np.float32)
            for stored in values[1:]:
                level = halved(level)
                if vectors:
                    length = np.linalg.norm(level[..., :3], axis=-1, keepdims=True)
                    mean = np.where(length > 1e-6, level[..., :3] / np.maximum(length, 1e-6), [0, 0, 1])
                    mean = mean * level[..., 3:]
                    mean = mean if signed else 0.5 + 0.5 * mean
                else:
                    mean = srgb.from_linear(level) if m.color_space == "srgb" else level
                for c, where in channels:
                    stored[..., where] = entry.encode(mean[..., c])
        border = border or choose_borders(values[0])
        return Pyramid(layout, values, types, border)

    @property
    def levels(self) -> int:
        return len(level_sizes(self.layout.height, self.layout.width))

    @property
    def nbytes(self) -> int:
        """Bytes of all levels of the maps, uncompressed, each channel at its depth in the source."""
        depth = sum(m.channels * m.depth for m in self.layout.maps)
        return depth * sum(rows * columns for rows, columns, _ in (level.shape for level in self.values))

    @property
    def arrays(self) -> dict:
        """Dr.Jit arrays of a read, by name."""
        return {} if self._texels is None else {"texels": self._texels, "offsets": self._offsets}

    @property
    def memory_nbytes(self) -> int:
        """Bytes in memory, in single precision and with padding."""
        return 4 * sum(map(dr.width, self.arrays.values()))

    def is_linear(self, name: str) -> bool:
        """Return whether :meth:`interpolated` returns linear values for a map that is sRGB-encoded in its source."""
        m = self.layout[name]
        channels = [self._owners[w] for w in m.where if isinstance(w, int)]
        return all((o.color_space, o.low, o.high, o.knee) == ("srgb", 0, 1, 0) for o in (m, *channels))

    def stored(self, u, v, active=True) -> list:
        """Return the stored channels at (u, v) in level 0, bilinear."""
        return self.encoded(self.interpolated(u, v, type(u)(0), active, whole=True))

    def filtered(self, u, v, level, active=True) -> list:
        """Return the stored channels at (u, v) and a level of detail, trilinear."""
        return self.encoded(self.interpolated(u, v, level, active))

    def interpolated(self, u, v, level, active=True, whole: bool = False) -> list:
        """Return the interpolated values before they are encoded, which can be averaged further.

        They are linear for sRGB colours and for high dynamic range. ``whole``: levels are whole numbers, which halves
        the reads.
        """
        if not self.layout.stored:
            return []
        level = self.clamped(level, type(u))
        if whole:
            return self._bilinear(u, v, level, active)
        lower = dr.floor(level)
        weight = level - dr.detach(lower)
        below = self._bilinear(u, v, lower, active)
        above = self._bilinear(u, v, dr.minimum(lower + 1, self.levels - 1), active)
        return [dr.fma(weight, b - a, a) for a, b in zip(below, above, strict=True)]

    def texels(self, index) -> list:
        """Return the stored channels of texels, given their ``index`` in a list of all, level by level, row by row."""
        return self.encoded(self.interpolated_texels(index, True))

    def _bilinear(self, u, v, level, active) -> list:
        """Return the bilinear values in one level, a whole number, for each place."""
        UInt32 = dr.uint32_array_t(type(u))
        level = UInt32(level)
        corners = []
        for x, n, border in ((v, self.layout.height, self.border[0]), (u, self.layout.width, self.border[1])):
            corners.append(around(x, dr.maximum(UInt32(n) >> level, 1), border))
        columns = dr.maximum(UInt32(self.layout.width) >> level, 1)
        offset = dr.gather(UInt32, self._offsets, level, active)
        total = None
        for row, a in corners[0]:
            for column, b in corners[1]:
                total = weighted_sum(a * b, self.interpolated_texels(offset + row * columns + column, active), total)
        return total

    def interpolated_texels(self, index, active=True) -> list:
        """Return the values of texels, given their ``index`` as in :meth:`texels`, in the form that is interpolated."""
        return padded_texels(self.types, self._texels, self._padded, index, active)[: self.layout.stored]

    def encoded(self, values: list) -> list:
        """Return the stored channels in [0, 1] from interpolated values; ``None`` stays ``None``."""
        stored = []
        for value, owner in zip(values, self._owners, strict=True):
            if value is None:
                stored.append(None)
                continue
            if owner.color_space == "srgb":
                value = srgb.from_linear(value)
            if owner.knee > 0:
                scale = 1 / np.log2(1 + owner.high / owner.knee)
                value = dr.log2(1 + dr.maximum(value, 0) / owner.knee) * float(scale)
            elif owner.color_space == "srgb" and (owner.low, owner.high) != (0, 1):
                value = (value - owner.low) / (owner.high - owner.low)
            stored.append(value)
        return stored


class TexelPyramid(Pyramid):
    """Mip pyramid of one map whose finest level is a Dr.Jit tensor: derivatives of all levels reach that tensor.

    ``texels``, ``(height, width, channels)``, holds the values that are interpolated and averaged: linear values for a
    map ``entry`` in sRGB, the values themselves for all other maps. Values of any size are allowed. The map of the
    resulting ``layout`` is linear, with no channel constant or left out, and ``values`` is empty.
    """

    def __init__(self, entry: MapLayout, texels, border):
        height, width, count = texels.shape
        plain = replace(entry, color_space="linear", where=tuple(range(count)), low=0.0, high=1.0, knee=0.0)
        self.layout = Layout(width, height, (plain,), (0.5,) * count, (entry.name,) * count)
        self.types, self.border, self.values = compat.backend_module(texels), tuple(border), []
        self._owners, self._padded = [plain] * count, lookup.padded_channels(count)
        Float, UInt32 = self.types.Float, self.types.UInt32
        sizes = level_sizes(height, width)
        offsets = np.cumsum([0] + [rows * columns for rows, columns in sizes])
        index = dr.arange(UInt32, int(offsets[1]))
        levels = [[dr.gather(Float, texels.array, dr.fma(index, count, c)) for c in range(count)]]
        vectors, signed = entry.role == "normal" and count == 3, entry.low < 0
        if vectors:
            mean = levels[0] if signed else [2 * x - 1 for x in levels[0]]
            mean = [*mean, dr.norm(self.types.Array3f(*mean))]
        else:
            mean = levels[0]
        for rows, columns in sizes[:-1]:
            mean = _halved_channels(self.types, mean, rows, columns)
            levels.append(_rescaled(self.types, mean, signed) if vectors else mean)
        index = dr.arange(UInt32, int(offsets[-1]))
        self._texels = dr.zeros(Float, int(offsets[-1]) * self._padded)
        for c in range(count):
            channel = dr.concat([level[c] for level in levels])
            dr.scatter(self._texels, channel, dr.fma(index, self._padded, c), mode=dr.ReduceMode.NoConflicts)
        self._hold(self._texels, offsets[:-1])


def _halved_channels(types: ModuleType, channels: list, rows: int, columns: int) -> list:
    """Return :func:`halved` for ``channels``, flat Dr.Jit arrays of ``rows · columns`` texels each."""
    index = dr.arange(types.UInt32, max(1, rows // 2) * max(1, columns // 2))
    # Opaque, so that one kernel halves images of all sizes
    width, stride = dr.opaque(types.UInt32, max(1, columns // 2)), dr.opaque(types.UInt32, columns)
    down, across = _covered(types, index // width, rows), _covered(types, index % width, columns)
    total = None
    for i, a in down:
        for j, b in across:
            place = dr.fma(i, stride, j)
            total = weighted_sum(a * b, [dr.gather(types.Float, x, place) for x in channels], total)
    return total


def _covered(types: ModuleType, i, n: int) -> list:
    """Return the texels, out of ``n`` along an axis, that texel ``i`` of the next level covers, with their weights."""
    if n == 1:
        return [(i, types.Float(1))]
    if n % 2 == 0:
        return [(2 * i, types.Float(0.5)), (2 * i + 1, types.Float(0.5))]
    scale, half, x = dr.opaque(types.Float, 1 / n), dr.opaque(types.Float, n // 2), types.Float(i)
    return [(2 * i, (half - x) * scale), (2 * i + 1, half * scale), (2 * i + 2, (x + 1) * scale)]


def _rescaled(types: ModuleType, mean: list, signed: bool) -> list:
    """Return mean vectors (three channels) rescaled to their mean length (the fourth), in [0, 1] unless ``signed``."""
    vector = types.Array3f(*mean[:3])
    length = dr.norm(vector)
    valid = length > 1e-6
    vector = dr.select(valid, vector / dr.select(valid, length, 1), types.Array3f(0, 0, 1)) * mean[3]
    return list(vector if signed else dr.fma(vector, 0.5, 0.5))


def weighted_sum(weight, values: list, total: list | None) -> list:
    """Return ``total + weight · values``, channel by channel; ``total`` is ``None`` at the start of a sum."""
    if total is None:
        return [weight * value for value in values]
    return [dr.fma(weight, value, t) for value, t in zip(values, total, strict=True)]


def padded_texels(types: ModuleType, texels, width: int, index, active=True) -> list:
    """Return the ``width`` numbers (1, 2 or a multiple of 4) of each texel of a flat array, gathered four at a time."""
    if width <= 2:
        return [dr.gather(types.Float, texels, index * width + i, active) for i in range(width)]
    groups = width // 4
    return [v for i in range(groups) for v in dr.gather(types.Array4f, texels, index * groups + i, active)]


def _owner(layout: Layout, channel: int) -> MapLayout:
    """Return the first map that contains a stored channel."""
    return next(m for m in layout.maps if channel in m.where)


def _interpolated(stored: np.ndarray, owner: MapLayout) -> np.ndarray:
    """Return the values that are interpolated in place of a stored channel."""
    if owner.color_space == "srgb":
        return srgb.to_linear(owner.decode(stored))
    return owner.decode(stored) if owner.knee > 0 else stored


def around(x, n, border: str) -> list:
    """Return the two texels around ``x`` in [0, 1] of ``n`` along an axis (one number a lane), with their weights."""
    Float, Int32 = type(x), dr.int32_array_t(type(x))
    size = Float(n)
    x = lookup.clamp(x - dr.floor(x), 0.0, 1.0) if border == "repeat" else lookup.clamp(x, 0.0, 1.0)
    position = dr.fma(x, size, -0.5)
    lower = dr.floor(position)
    weight = position - dr.detach(lower)
    lower, n = Int32(lower), Int32(n)
    if border == "repeat":
        both = [dr.select(lower < 0, n - 1, lower), dr.select(lower + 1 >= n, 0, lower + 1)]
    else:
        both = [dr.clip(lower, 0, n - 1), dr.clip(lower + 1, 0, n - 1)]
    UInt32 = dr.uint32_array_t(Float)
    return [(UInt32(both[0]), 1 - weight), (UInt32(both[1]), weight)]
