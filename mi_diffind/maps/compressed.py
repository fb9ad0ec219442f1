"""Maps of a material that are read from arrays: base classes, which decode them and measure their errors."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from types import ModuleType

import drjit as dr
import numpy as np

from ..arrays import lookup
from ..arrays.indirection import aligned_copy
from .layout import FROM_NORMAL, Layout
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

    #: Levels by which a footprint's level of detail is read finer (negative): :meth:`biased`.
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
