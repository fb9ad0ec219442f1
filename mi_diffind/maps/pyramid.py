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

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType

import drjit as dr
import numpy as np

from ..arrays import lookup
from ..arrays.indirection import aligned, aligned_copy
from ..core import compat
from ..images import srgb
from .layout import FROM_NORMAL, Layout, MapLayout, choose_borders
from .source import Source

#: Texels decoded at a time.
CHUNK = 2**20


class CompressedMaps:
    """Base class of maps that are stored in arrays.

    ``layout`` lists the maps; ``types`` is the module of the Dr.Jit types of a read, ``None`` if all channels are
    constant; ``border`` is that of the image along v and u.
    """

    layout: Layout
    types: ModuleType | None
    border: tuple[str, str]

    def stored(self, u, v, active=True) -> list:
        """Return the stored channels at (u, v) in [0, 1]²; v runs down from the upper left corner of the image."""
        raise NotImplementedError

    def maps(self, stored: list, names: Sequence[str]) -> dict[str, list]:
        """Return the channels of some maps, in the color space of each, from the stored channels."""
        return {name: self.layout.decode(name, stored, dr.exp2, root) for name in names}

    def read(self, u, v, names: Sequence[str] | None = None, active=True) -> dict[str, list]:
        """Return the channels of the maps ``names`` (default: all) at (u, v)."""
        return self.maps(self.stored(u, v, active), names or self.layout.names)

    def decode(self, names: Sequence[str] | None = None, width: int = 0, height: int = 0) -> dict[str, np.ndarray]:
        """Return the maps at the texel centres of an image, by default of the source's size.

        float32, ``(height, width, channels)``, in the color space of each map.
        """
        return self._decoded(self.stored, names, width or self.layout.width, height or self.layout.height)

    def _decoded(self, stored, names: Sequence[str] | None, width: int, height: int) -> dict[str, np.ndarray]:
        """Return :meth:`decode` with the function ``stored`` in place of :meth:`stored`."""
        layout = self.layout
        names = tuple(names or layout.names)
        images = {name: np.empty((height * width, layout[name].channels), np.float32) for name in names}
        types = self.types
        for start in range(0, height * width, CHUNK):
            count = min(CHUNK, height * width - start)
            if types is None:
                values = self.maps([], names)
            else:
                index = dr.arange(types.UInt32, count) + dr.opaque(types.UInt32, start)
                # Opaque, so that one kernel reads images of all sizes
                columns, rows = dr.opaque(types.UInt32, width), dr.opaque(types.UInt32, height)
                u = (types.Float(index % columns) + 0.5) / types.Float(columns)
                v = (types.Float(index // columns) + 0.5) / types.Float(rows)
                values = self.maps(stored(u, v), names)
                dr.eval(values)  # all channels at once: NumPy asks for one after the other, each a kernel
            for name, channels in values.items():
                for c, value in enumerate(channels):
                    images[name][start : start + count, c] = value if isinstance(value, float) else value.numpy()
        return {name: image.reshape(height, width, -1) for name, image in images.items()}

    def largest(self, name: str) -> float | None:
        """Return an upper bound of the values of a map, in its color space, at any place and level of detail.

        A read interpolates entries of the array ``cascaded``, so that none of its values is above the largest entry; a
        component that is derived from others reaches 1. ``None`` if texels are interpolated.
        """
        if FROM_NORMAL in self.layout[name].where:
            return 1.0
        net = getattr(self, "net", None)
        if net is None:
            return None
        entries = net.cascaded.numpy()
        return float(max(self.layout.decode(name, entries.reshape(-1, entries.shape[-1]).max(axis=0).tolist())))

    def measure(self, source: Source) -> dict[str, float]:
        """Return the errors at texel centres against ``source``.

        - ``psnr_db``: all channels together; ``psnr_MAP_db``: each map; ``psnr_mean_db``: the mean over maps.
        - ``psnr_between_db``: all channels at 2²⁰ random places, against the bilinear interpolation of the source.

        Values are compared in the encoding of the file (sRGB, where it is), values of high dynamic range as logarithms.
        """
        decoded = self.decode()
        by_map, errors, weights = {}, [], []
        for m, layout in zip(source.maps, self.layout.maps, strict=True):
            error = layout.encode(decoded[m.name]) - layout.encode(m.values)
            errors.append(float(np.mean(error**2, dtype=np.float64)))
            weights.append(layout.channels)
            by_map[map_figure(m.name)] = decibel(errors[-1])
        return {
            "psnr_db": decibel(float(np.average(errors, weights=weights))),
            "psnr_mean_db": float(np.mean(list(by_map.values()))),
            **by_map,
            "psnr_between_db": decibel(self._between(source)),
        }

    def _between(self, source: Source, count: int = 2**20) -> float:
        """Return the mean squared error at random places against the bilinear interpolation of the source."""
        types = self.types
        if types is None:
            return 0.0
        u, v = np.random.default_rng(2023).random((2, count), dtype=np.float32)
        read = self.read(types.Float(aligned_copy(u)), types.Float(aligned_copy(v)))
        dr.eval(read)
        border = self.border
        rows, columns = (taps(x, n, b) for x, n, b in ((v, source.height, border[0]), (u, source.width, border[1])))
        total, channels = 0.0, 0
        for m, layout in zip(source.maps, self.layout.maps, strict=True):
            values = layout.encode(m.values)
            for c in range(layout.channels):
                plane = values[..., c]
                expected = sum(a * b * plane[i, j] for i, a in rows for j, b in columns)
                actual = read[m.name][c]
                actual = np.full(count, actual) if isinstance(actual, float) else actual.numpy()
                total += float(np.mean((layout.encode(actual) - expected) ** 2, dtype=np.float64))
                channels += 1
        return total / channels


class FilteredMaps(CompressedMaps):
    """Base class of maps that are read at any level of detail.

    Each of the ``levels`` is half as large as the one before it; level 0 is the source, ``levels - 1`` one texel.
    """

    levels: int

    #: Levels by which a round footprint's level of detail is read finer (negative): :meth:`biased`, :func:`bias_share`.
    level_bias: float = 0.0

    def filtered(self, u, v, level, active=True) -> list:
        """Return the stored channels at (u, v) in [0, 1]² and a level of detail, a real number for each place.

        The level is that of the footprint; :meth:`biased` is read. Linear between levels. Numbers beyond the levels
        mean the nearest level, NaN means 0.
        """
        raise NotImplementedError

    def extra(self, u, v, level, active=True) -> list | None:
        """Return numbers beside the channels at a place and a footprint's level of detail, ``None`` without any."""
        return None

    def biased(self, level):
        """Return the level of detail that is read for a footprint's ``level``, not limited to the existing levels."""
        return level + self.level_bias if self.level_bias else level

    def clamped(self, level, Float):
        """Return a level of detail limited to the existing levels, as an array."""
        return lookup.clamp(Float(level), 0.0, float(self.levels - 1))

    def level_size(self, level: int) -> tuple[int, int]:
        """Return rows and columns of a level."""
        return max(1, self.layout.height >> level), max(1, self.layout.width >> level)

    def decode(
        self, names: Sequence[str] | None = None, width: int = 0, height: int = 0, level: float = 0
    ) -> dict[str, np.ndarray]:
        """Return the maps as images at a level of detail, by default in the size of that level."""
        rows, columns = self.level_size(int(level))
        stored = self.stored if level == 0 else lambda u, v: self.filtered(u, v, dr.opaque(type(u), level))
        return self._decoded(stored, names, width or columns, height or rows)


#: Words that stand for something else than a map in the names of figures.
_FIGURES = re.compile(r"mean|between|worst|seen|shaded|scene|l\d+|seen_.*|shaded_.*|map_.*")


def map_figure(name: str) -> str:
    """Return the name of the PSNR of a map: ``psnr_NAME_db``, or ``psnr_map_NAME_db`` if that is another figure's."""
    return f"psnr_map_{name}_db" if _FIGURES.fullmatch(name) else f"psnr_{name}_db"


def taps(x: np.ndarray, n: int, border: str) -> list:
    """Return the two of ``n`` texels around each place in [0, 1] along an axis, with their weights."""
    position = x * n - 0.5
    lower = np.floor(position).astype(np.int64)
    weight = (position - lower).astype(np.float32)
    first, second = ((i % n if border == "repeat" else np.clip(i, 0, n - 1)) for i in (lower, lower + 1))
    return [(first, 1 - weight), (second, weight)]


def root(v):
    """Return the square root, 0 for negative numbers; its derivative is finite everywhere."""
    return dr.select(v > 1e-6, dr.sqrt(dr.maximum(v, 1e-6)), 0)


def mean_square(values: list, truth: list) -> float:
    """Return the mean squared difference of channels, Dr.Jit arrays."""
    squares = [dr.square(a - b) for a, b in zip(values, truth, strict=True)]
    dr.eval(squares)  # one kernel in place of one for each channel
    return sum(float(dr.mean(s)[0]) for s in squares) / len(squares)


def decibel(mse: float) -> float:
    """Return the PSNR of a mean squared error, for a peak of 1, at most 120 dB."""
    return -10 * math.log10(max(mse, 1e-12))


def bias_share(ratio):
    """Return the share of a level bias that counts, by the ratio of a footprint's area to ½ (‖ddx‖² + ‖ddy‖²).

    The ratio is 2/(a + 1/a) of an aspect a: 1 of a circle, 0.47 where it is four times as long as wide.
    """
    return dr.square(ratio)


def level_sizes(height: int, width: int) -> list[tuple[int, int]]:
    """Return rows and columns of all levels of an image, down to a single texel."""
    count = max(height, width).bit_length()
    return [(max(1, height >> level), max(1, width >> level)) for level in range(count)]


def halve(values: np.ndarray) -> np.ndarray:
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
    def from_source(
        source: Source, layout: Layout | None = None, types: ModuleType | None = None, border=None
    ) -> Pyramid:
        """Return the pyramid of a source.

        ``layout`` is any layout of this source, by default the one for filtered reads; a stored channel of several maps
        is averaged as in the first of them. ``border`` along v and u is by default :func:`.layout.choose_borders`.
        """
        layout = layout or Layout.from_source(source, filtered=True)
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
                level = halve(level)
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
        return lookup.weighted_sum(
            (a * b, self.interpolated_texels(offset + row * columns + column, active))
            for row, a in corners[0]
            for column, b in corners[1]
        )

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
    """Return :func:`halve` for ``channels``, flat Dr.Jit arrays of ``rows · columns`` texels each."""
    index = dr.arange(types.UInt32, max(1, rows // 2) * max(1, columns // 2))
    # Opaque, so that one kernel halves images of all sizes
    width, stride = dr.opaque(types.UInt32, max(1, columns // 2)), dr.opaque(types.UInt32, columns)
    down, across = _covered(types, index // width, rows), _covered(types, index % width, columns)
    return lookup.weighted_sum(
        (a * b, [dr.gather(types.Float, x, dr.fma(i, stride, j)) for x in channels]) for i, a in down for j, b in across
    )


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
