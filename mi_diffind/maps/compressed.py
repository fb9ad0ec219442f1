"""Maps of a material that are read from arrays, however these are laid out: decoded, and measured against a source."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import ModuleType

import drjit as dr
import numpy as np

from .. import lookup
from .layout import Layout
from .source import Source

#: Texels that are decoded at a time.
CHUNK = 2**20


class CompressedMaps:
    """
    The maps of a material that are stored in arrays; the base class. ``layout`` says which there are; ``types`` is the
    module of the Dr.Jit types that they are read with, ``None`` if nothing is stored, since all is constant; ``border``
    that of the image along v and u.
    """

    layout: Layout
    types: ModuleType | None
    border: tuple[str, str]

    # -- reading ----------------------------------------------------------------------------------------------------

    def stored(self, u, v, active=True) -> list:
        """
        The stored channels at (u, v) in [0, 1]², without filtering; v runs down, (0, 0) is the upper left corner of the
        first texel.
        """
        raise NotImplementedError

    def maps(self, stored: list, names: Sequence[str]) -> dict[str, list]:
        """The channels of some maps, in the color space of each, from the stored ones."""
        return {name: self.layout.decode(name, stored, dr.exp2, root) for name in names}

    def read(self, u, v, names: Sequence[str] | None = None, active=True) -> dict[str, list]:
        """The channels of the maps ``names`` (default: all) at (u, v)."""
        return self.maps(self.stored(u, v, active), names or self.layout.names)

    def decode(self, names: Sequence[str] | None = None, width: int = 0, height: int = 0) -> dict[str, np.ndarray]:
        """
        The maps as images, float32, ``(height, width, channels)``, in the color space of each: their values at texel
        centres of an image of that size (default: the source's).
        """
        return self._decoded(self.stored, names, width or self.layout.width, height or self.layout.height)

    def _decoded(self, stored, names: Sequence[str] | None, width: int, height: int) -> dict[str, np.ndarray]:
        """:meth:`decode` of what the function ``stored`` says at (u, v)."""
        layout = self.layout
        names = tuple(names or layout.names)
        found = {name: np.empty((height * width, layout[name].channels), np.float32) for name in names}
        types = self.types
        for start in range(0, height * width, CHUNK):
            count = min(CHUNK, height * width - start)
            if types is None:
                values = self.maps([], names)
            else:
                index = dr.arange(types.UInt32, count) + dr.opaque(types.UInt32, start)
                # Opaque, so that images of all sizes are read by one kernel
                columns, rows = dr.opaque(types.UInt32, width), dr.opaque(types.UInt32, height)
                u = (types.Float(index % columns) + 0.5) / types.Float(columns)
                v = (types.Float(index // columns) + 0.5) / types.Float(rows)
                values = self.maps(stored(u, v), names)
            for name, channels in values.items():
                for c, value in enumerate(channels):
                    found[name][start : start + count, c] = value if isinstance(value, float) else value.numpy()
        return {name: image.reshape(height, width, -1) for name, image in found.items()}

    # -- what it costs, how good it is ------------------------------------------------------------------------------

    def measure(self, source: Source) -> dict[str, float]:
        """
        Errors at texel centres against ``source``: ``psnr_db`` of all channels together, ``psnr_MAP_db`` of each map,
        ``psnr_mean_db``, the mean of those, and ``psnr_between_db``, of all channels at 2²⁰ random places against the
        bilinear interpolation of the source. Values are compared as they are in the file (sRGB-encoded if it is), those
        of high dynamic range as the logarithms that stand for them.
        """
        decoded = self.decode()
        found, errors, weights = {}, [], []
        for m, layout in zip(source.maps, self.layout.maps, strict=True):
            error = layout.encode(decoded[m.name]) - layout.encode(m.values)
            errors.append(float(np.mean(error**2, dtype=np.float64)))
            weights.append(layout.channels)
            found[f"psnr_{m.name}_db"] = decibel(errors[-1])
        joint = float(np.average(errors, weights=weights))
        mean = float(np.mean([found[f"psnr_{m.name}_db"] for m in source.maps]))
        return {
            "psnr_db": decibel(joint),
            "psnr_mean_db": mean,
            **found,
            "psnr_between_db": decibel(self._between(source)),
        }

    def _between(self, source: Source, count: int = 2**20) -> float:
        """Mean squared error at random places against the bilinear interpolation of the source."""
        types = self.types
        if types is None:
            return 0.0
        u, v = np.random.default_rng(2023).random((2, count), dtype=np.float32)
        read = self.read(types.Float(u), types.Float(v))
        border = self.border
        rows, columns = (taps(x, n, b) for x, n, b in ((v, source.height, border[0]), (u, source.width, border[1])))
        total, channels = 0.0, 0
        for m, layout in zip(source.maps, self.layout.maps, strict=True):
            values = layout.encode(m.values)
            for c in range(layout.channels):
                plane = values[..., c]
                expected = sum(a * b * plane[i, j] for i, a in rows for j, b in columns)
                got = read[m.name][c]
                got = np.full(count, got) if isinstance(got, float) else got.numpy()
                total += float(np.mean((layout.encode(got) - expected) ** 2, dtype=np.float64))
                channels += 1
        return total / channels


class FilteredMaps(CompressedMaps):
    """
    Maps that can be read at any level of detail; the base class. There are ``levels``, each half as large as the one
    before it: level 0 is the source, ``levels - 1`` one texel.
    """

    levels: int

    def filtered(self, u, v, level, active=True) -> list:
        """
        The stored channels at (u, v) in [0, 1]² and the level of detail ``level``, a real number for each place: linear
        between levels. Numbers beyond the levels mean the nearest, NaN means 0.
        """
        raise NotImplementedError

    def clamped(self, level, Float):
        """A level of detail within those that there are, as an array."""
        return lookup.clamp(Float(level), 0.0, float(self.levels - 1))

    def level_size(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        return max(1, self.layout.height >> level), max(1, self.layout.width >> level)

    def decode(
        self, names: Sequence[str] | None = None, width: int = 0, height: int = 0, level: float = 0
    ) -> dict[str, np.ndarray]:
        """
        The maps as images, as in the base class, at a level of detail; their size is by default that of the level.
        """
        rows, columns = self.level_size(int(level))
        stored = self.stored if level == 0 else lambda u, v: self.filtered(u, v, dr.opaque(type(u), level))
        return self._decoded(stored, names, width or columns, height or rows)


def taps(x: np.ndarray, n: int, border: str) -> list:
    """The two texels around each place and their weights."""
    position = x * n - 0.5
    lower = np.floor(position).astype(np.int64)
    weight = (position - lower).astype(np.float32)
    both = (
        [lower % n, (lower + 1) % n] if border == "repeat" else [np.clip(lower, 0, n - 1), np.clip(lower + 1, 0, n - 1)]
    )
    return [(both[0], 1 - weight), (both[1], weight)]


def root(v):
    """A square root of what may be negative, whose derivative is finite everywhere."""
    return dr.select(v > 1e-6, dr.sqrt(dr.maximum(v, 1e-6)), 0)


def decibel(mse: float) -> float:
    """PSNR for a peak of 1, at most 120 dB."""
    return -10 * math.log10(max(mse, 1e-12))
