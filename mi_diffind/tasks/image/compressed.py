"""
An image or a material as a table file holds it: a layout of its maps, and the arrays that hold its channels.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import drjit as dr
import numpy as np

from ...compat import module_of
from ...indirection import DifferentiableArray, Indirection
from ...tables import StoredArray, Table, TableError, load_table
from .arrays import joined
from .layout import Layout
from .source import Source

#: Names of the primary arrays: the second is of lower resolution, and not always there.
PRIMARIES = ("primary", "coarse")

#: Texels that are decoded at a time.
CHUNK = 2**20


class CompressedImage:
    """
    A compressed image or material: ``layout`` says which maps there are, ``net`` maps (v, u) in [0, 1]² to the stored
    channels; v runs down, (0, 0) is the upper left corner of the first texel. ``net`` is ``None`` if no channel is
    stored, since all are constant.
    """

    def __init__(self, layout: Layout, net: Indirection | None):
        self.layout, self.net = layout, net

    @staticmethod
    def of(table: Table, dtype, storage: str = "") -> CompressedImage:
        """The image of a checked table, see :func:`allocate`."""
        return CompressedImage(Layout.from_json(table.settings["layout"]), joined_of(allocate(table, dtype, storage)))

    # -- reading ----------------------------------------------------------------------------------------------------

    def stored(self, u, v, active=True) -> list:
        """The stored channels at (u, v)."""
        return [] if self.net is None else self.net([v, u], active)

    def maps(self, stored: list, names: Sequence[str]) -> dict[str, list]:
        """The channels of some maps, in the color space of each, from the stored ones."""
        return {name: self.layout.decode(name, stored, dr.exp2, _root) for name in names}

    def read(self, u, v, names: Sequence[str] | None = None, active=True) -> dict[str, list]:
        """The channels of the maps ``names`` (default: all) at (u, v)."""
        return self.maps(self.stored(u, v, active), names or self.layout.names)

    def decode(self, names: Sequence[str] | None = None, width: int = 0, height: int = 0) -> dict[str, np.ndarray]:
        """
        The maps as images, float32, ``(height, width, channels)``, in the color space of each: their values at texel
        centres of an image of that size (default: the source's).
        """
        layout = self.layout
        width, height = width or layout.width, height or layout.height
        names = tuple(names or layout.names)
        found = {name: np.empty((height * width, layout[name].channels), np.float32) for name in names}
        types = None if self.net is None else module_of(self.net.cascaded.data)
        for start in range(0, height * width, CHUNK):
            count = min(CHUNK, height * width - start)
            if types is None:
                values = self.maps([], names)
            else:
                index = dr.arange(types.UInt32, count) + dr.opaque(types.UInt32, start)
                u = (types.Float(index % width) + 0.5) / width
                v = (types.Float(index // width) + 0.5) / height
                values = self.read(u, v, names)
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
            found[f"psnr_{m.name}_db"] = _decibel(errors[-1])
        joint = float(np.average(errors, weights=weights))
        mean = float(np.mean([found[f"psnr_{m.name}_db"] for m in source.maps]))
        return {
            "psnr_db": _decibel(joint),
            "psnr_mean_db": mean,
            **found,
            "psnr_between_db": _decibel(self._between(source)),
        }

    def _between(self, source: Source, count: int = 2**20) -> float:
        """Mean squared error at random places against the bilinear interpolation of the source."""
        if self.net is None:
            return 0.0
        u, v = np.random.default_rng(2023).random((2, count), dtype=np.float32)
        types = module_of(self.net.cascaded.data)
        read = self.read(types.Float(u), types.Float(v))
        border = self.net.primary[0].border
        rows, columns = (_taps(x, n, b) for x, n, b in ((v, source.height, border[0]), (u, source.width, border[1])))
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


def _taps(x: np.ndarray, n: int, border: str) -> list:
    """The two texels around each place and their weights."""
    position = x * n - 0.5
    lower = np.floor(position).astype(np.int64)
    weight = (position - lower).astype(np.float32)
    both = (
        [lower % n, (lower + 1) % n] if border == "repeat" else [np.clip(lower, 0, n - 1), np.clip(lower + 1, 0, n - 1)]
    )
    return [(both[0], 1 - weight), (both[1], weight)]


def _root(v):
    """A square root of what may be negative, whose derivative is finite everywhere."""
    return dr.select(v > 1e-6, dr.sqrt(dr.maximum(v, 1e-6)), 0)


def _decibel(mse: float) -> float:
    """PSNR for a peak of 1, at most 120 dB."""
    return -10 * math.log10(max(mse, 1e-12))


# -- files ------------------------------------------------------------------------------------------------------------


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """
    The arrays of a checked table for the tensor type ``dtype``: as bytes, if it has them as bytes, which can be read
    only; with the ``storage`` ``"float32"``, as floats that pass through the fold, which can be optimised.
    """
    as_bytes = storage != "float32" and table.storage == "uint8"
    form = "uint8" if as_bytes else "float32"
    return {name: array.allocate(dtype, form, fold=True) for name, array in table.arrays.items()}


def joined_of(found: dict[str, DifferentiableArray]) -> Indirection | None:
    """The indirection of named arrays; ``None`` of none."""
    return joined([found[name] for name in PRIMARIES if name in found], found["cascaded"]) if found else None


def to_table(image: CompressedImage, settings: dict) -> Table:
    """The table file of an image."""
    named = []
    if image.net is not None:
        named = [*zip(PRIMARIES, image.net.primary, strict=False), ("cascaded", image.net.cascaded)]
    stored = {name: StoredArray.of(array) for name, array in named}
    return Table("image", stored, settings={**settings, "layout": image.layout.to_json()})


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`~mi_diffind.tables.TableError`."""
    table = load_table(path, "image")
    try:
        layout = Layout.from_json(table.settings["layout"])
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise TableError(f"{path}: its settings describe no image ({e})") from None
    found = set(table.arrays)
    expected = [{"primary", "cascaded"}, {*PRIMARIES, "cascaded"}] if layout.stored else [set()]
    if found not in expected:
        names = " or ".join(", ".join(sorted(e)) or "none" for e in expected)
        raise TableError(f"{path}: holds the arrays {', '.join(sorted(found)) or 'none'}, expected {names}")
    if not layout.stored:
        return table
    shapes = {name: array.shape for name, array in table.arrays.items()}
    cascaded = shapes.pop("cascaded")
    pointers = sum(shape[-1] for shape in shapes.values())
    if any(len(s) != 3 for s in shapes.values()) or len(cascaded) != pointers + 1 or cascaded[-1] != layout.stored:
        raise TableError(
            f"{path}: primary arrays of the shapes {', '.join(map(str, shapes.values()))} and a cascaded one of "
            f"{cascaded} make no image of {layout.stored} stored channel(s)"
        )
    for name, array in table.arrays.items():
        if not array.is_pointer:
            raise TableError(f'{path}: array "{name}" has entries outside of [0, 1]')
    return table
