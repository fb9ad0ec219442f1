"""Compressed textures: reading at any level of detail, errors by level, and their table files."""

from __future__ import annotations

import math
import os
from dataclasses import asdict, dataclass

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays import lookup
from ...arrays.indirection import DifferentiableArray, aligned_copy
from ...arrays.lookup import BORDERS
from ...arrays.pages import PagedArray
from ...arrays.tables import PAGES, Table, TableError, load_table, to_stored_arrays
from ...core.compat import backend_module
from ...core.errors import UsageError
from ...maps.arguments import BIAS_RANGE
from ...maps.layout import Layout
from ...maps.model import MapsModel, allocate_maps, check_arrays, read_layout
from ...maps.pyramid import FilteredMaps, Pyramid, around, decibel, level_sizes, map_figure
from ...maps.source import Source

#: Distributions that footprints are drawn from.
FOOTPRINTS = ("power", "exponential")

#: Fraction p of the samples below the threshold t.
FRACTION = 0.5


def exponent(base: int) -> float:
    """Return ``n = log_p(t)``, for which a fraction p of all ``u^n`` lies below ``t`` (equation 6).

    ``t = 1 / base`` for the side of a texture in texels; half of [0, 1] for a side of 1.
    """
    return math.log(1 / max(2, base)) / math.log(FRACTION)


def exponential_rate(base: int) -> float:
    """Return ``λ_e = −ln(1 − p) / t``, for which a fraction p of all samples lies below ``t`` (equation 9)."""
    return -math.log1p(-FRACTION) / (1 / max(2, base))


def footprints(u, distribution: str, base: int):
    """Draw footprints in [0, 1] for a texture of side ``base`` from uniform numbers ``u`` in (0, 1].

    ``distribution`` is one of :data:`FOOTPRINTS`: ``x = u^n`` (equation 3), or ``x = −ln(u) / λ_e`` (equation 7), at
    most 1.
    """
    if distribution == "power":
        return u ** exponent(base)
    return dr.minimum(-dr.log(dr.maximum(u, 1e-30)) / exponential_rate(base), 1)


def footprint_level(x, levels: int):
    """Return the level of detail in [0, levels − 1] of a footprint in [0, 1]."""
    return dr.maximum(dr.log2(dr.maximum(x, 1e-30)) + (levels - 1), 0)


def level_footprint(level, levels: int):
    """Return the footprint in [0, 1] of a level of detail: the inverse of :func:`footprint_level`.

    Level 0 has the footprint of one texel; smaller footprints are magnified and read level 0, too.
    """
    return dr.exp2(level - (levels - 1))


@dataclass(frozen=True)
class PaperStructure:
    """Structure of the paper's arrays: the number of ``levels`` of the texture."""

    levels: int


class PaperNet(nn.Module):
    """The paper's arrays (supplement, table 3).

    ``primary0`` has 3 channels and is read at (v, u); ``primary1`` has 1 channel and is read at the footprint. Together
    they point into ``cascaded``, ``N_lod × N_c³``.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "primary0": DifferentiableArray,
        "primary1": DifferentiableArray,
        "cascaded": DifferentiableArray,
        "structure": object,
    }

    def __init__(self, primary0=None, primary1=None, cascaded=None, structure: PaperStructure | None = None):
        self.primary0, self.primary1, self.cascaded, self.structure = primary0, primary1, cascaded, structure

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name, in the order of a file."""
        return {"primary0": self.primary0, "primary1": self.primary1, "cascaded": self.cascaded}

    #: Numbers beside the channels: none
    extras = None

    @property
    def border(self) -> tuple[str, str]:
        """The border of the texture along v and u."""
        return self.primary0.border

    def extra(self, u, v, level, active=True) -> None:
        """Return ``None``, see :meth:`LayeredNet.extra`."""

    def changed(self, change) -> PaperNet:
        """Return a copy with ``change(array, bits)`` in place of each array."""
        return PaperNet(*(change(a, 8) for a in self.arrays.values()), self.structure)

    def at_footprint(self, u, v, x, active=True) -> list:
        """Return the channels at (u, v) for a footprint in [0, 1]."""
        inside = self.primary0.is_pointer and self.primary1.is_pointer
        return self.cascaded([*self.primary1([x], active), *self.primary0([v, u], active)], active, inside)

    def filtered(self, u, v, level, active=True) -> list:
        """Return the channels at (u, v) and a level of detail from 0 to ``levels − 1``."""
        return self.at_footprint(u, v, level_footprint(level, self.structure.levels), active)

    def stored(self, u, v, active=True) -> list:
        """Return the channels at level 0; with bytes, the footprint's array is one constant and is not read."""
        array, x = self.primary1, float(level_footprint(0.0, self.structure.levels))
        if array.storage == "uint8":
            entries, at = array.numpy()[:, 0], x * (array.resolution[0] - 1)
            lower = min(int(at), len(entries) - 2)
            lod = type(u)(float(entries[lower] + (at - lower) * (entries[lower + 1] - entries[lower])))
        else:
            (lod,) = array([type(u)(x)])
        return self.cascaded([lod, *self.primary0([v, u], active)], active, self.primary0.is_pointer)


@dataclass(frozen=True)
class FineLayer:
    """A fine array, on the grid of the level of detail ``level``.

    Its value, less :attr:`zero` and times the ``scale`` of each channel, is added to the pointer in full up to the
    level ``until`` and fades out from there to ``until + 1``. ``bits`` are those of an entry. A ``paged`` layer
    consists of pages, whose resolution follows the content. Layers that hold pointers
    (:meth:`LayeredStructure.is_pointer`) replace the pointer instead; their ``scale`` is 1 and they have no zero.
    """

    level: int
    until: int
    bits: int
    scale: tuple[float, ...]
    paged: bool = False

    @property
    def channels(self) -> int:
        return len(self.scale)

    @property
    def zero(self) -> float:
        """Entry that stands for no difference: a multiple of 1 / (2^bits − 1), or 0.5 for a single bit."""
        return 0.5 if self.bits == 1 else 2 ** (self.bits - 1) / (2**self.bits - 1)


@dataclass(frozen=True)
class LayeredStructure:
    """Structure of our arrays.

    - ``height``, ``width``: size of the texture in texels.
    - ``layers``: the fine arrays, the finest first.
    - ``skip``: first level of the coarse array, whose pointers have ``bits`` bits.
    - ``base``: the coarsest layer holds pointers, so finer levels do not read the coarse array.
    """

    height: int
    width: int
    layers: tuple[FineLayer, ...]
    skip: int
    bits: int = 8
    base: bool = False

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Rows and columns of all levels."""
        return level_sizes(self.height, self.width)

    def is_pointer(self, layer: FineLayer) -> bool:
        """Return whether a layer holds pointers in place of differences."""
        return layer.paged or (self.base and layer == self.layers[-1])


#: Extras that change nothing: two for the shape of a specular lobe (an entry of 8 bits), and its weight.
NEUTRAL = (128 / 255, 128 / 255, 1.0)

#: Entries along a side of each level of the extras, at most.
EXTRA_SIDE = 8


def neutral_extras(height: int, width: int, border: tuple[str, str]) -> DifferentiableArray:
    """Return extras for a texture of ``height`` × ``width`` texels, not allocated, all neutral.

    There is a grid for each level that is larger than a grid, and for the first that is not.
    """
    sizes = level_sizes(height, width)
    levels = next((i for i, size in enumerate(sizes) if max(size) <= EXTRA_SIDE), len(sizes) - 1) + 1
    resolution = (levels, *(min(n, EXTRA_SIDE) for n in (height, width)))
    return DifferentiableArray(resolution, len(NEUTRAL), "constant", NEUTRAL, fold=True, border=("clamp", *border))


class LayeredNet(nn.Module):
    """Our arrays.

    - ``coarse``: pointers of all texels of the levels from ``structure.skip`` on, level by level, read trilinearly.
    - ``fine``: differences of the pointers of finer levels, each array on the grid of its level, in few bits and not of
      all channels; or pointers, where arrays consist of pages.
    - ``cascaded``: the colours, read at the sum. If it has one dimension more than ``coarse`` has channels, its first
      axis is the level of detail, one entry a level up to ``structure.skip``.
    - ``extras`` (or ``None``): numbers beside the channels, in a coarse grid for each level up to one as coarse, read
      trilinearly by :meth:`extra`.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "fine": tuple,
        "coarse": DifferentiableArray,
        "cascaded": DifferentiableArray,
        "structure": object,
        "border": tuple,
        "extras": object,
    }

    def __init__(
        self, fine=(), coarse=None, cascaded=None, structure: LayeredStructure | None = None,
        border=("clamp", "clamp"), extras: DifferentiableArray | None = None,
    ):  # fmt: skip
        self.fine, self.coarse, self.cascaded, self.structure = tuple(fine), coarse, cascaded, structure
        #: The border of the texture along v and u
        self.border = tuple(border)
        self.extras = extras

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name, in the order of a file."""
        fine = {f"level{x.level}": a for x, a in zip(self.structure.layers, self.fine, strict=True)}
        extras = {} if self.extras is None else {"extras": self.extras}
        return {**fine, "coarse": self.coarse, "cascaded": self.cascaded, **extras}

    def changed(self, change) -> LayeredNet:
        """Return a copy with ``change(array, bits)`` in place of each array, in the order of :attr:`arrays`."""
        structure = self.structure
        fine = [change(a, x.bits) for a, x in zip(self.fine, structure.layers, strict=True)]
        coarse, cascaded = change(self.coarse, structure.bits), change(self.cascaded, 8)
        extras = None if self.extras is None else change(self.extras, 8)
        return LayeredNet(fine, coarse, cascaded, structure, self.border, extras)

    def extra(self, u, v, level, active=True) -> list | None:
        """Return the ``extras`` at (u, v) and a level of detail, numbers in [0, 1], or ``None`` without them."""
        if self.extras is None:
            return None
        levels, *sizes = self.extras.resolution
        coordinates = [lookup.clamp(level * (1 / max(1, levels - 1)), 0.0, 1.0)]
        return self.extras([*coordinates, *self._at(u, v, sizes)], active)

    def filtered(self, u, v, level, active=True) -> list:
        """Return the channels at (u, v) and a level of detail from 0 to the last level."""
        structure, Float = self.structure, type(u)
        UInt32 = dr.uint32_array_t(Float)
        above = dr.maximum(level - structure.skip, 0)
        lower = dr.floor(above)
        weight = above - dr.detach(lower)
        (rows, columns), offset = self._level(UInt32(lower) + structure.skip)
        pointer = self._coarse(u, v, rows, columns, offset, active)
        offset = dr.minimum(offset + rows * columns, self.coarse.resolution[0] - 1)
        rows, columns = (dr.maximum(n >> 1, 1) for n in (rows, columns))
        upper = self._coarse(u, v, rows, columns, offset, active)
        pointer = [dr.fma(weight, b - a, a) for a, b in zip(pointer, upper, strict=True)]
        for x, array in reversed([*zip(structure.layers, self.fine, strict=True)]):
            share = 1 - lookup.clamp(level - x.until, 0.0, 1.0)
            self._add(pointer, x, array, u, v, share, active)
        return self._answer(pointer, level, active)

    def stored(self, u, v, active=True) -> list:
        """Return the channels at level 0: from the finest layer that holds pointers and the finer ones alone."""
        layers = [*zip(self.structure.layers, self.fine, strict=True)]
        last = next((i for i, (x, _) in enumerate(layers) if self.structure.is_pointer(x)), None)
        if last is None:
            UInt32 = dr.uint32_array_t(type(u))
            pointer = self._coarse(u, v, *map(UInt32, self.structure.sizes[self.structure.skip]), UInt32(0), active)
        else:
            _, array = layers[last]
            pointer = array(self._place(array, u, v), active)
            layers = layers[:last]
        for x, array in layers:
            self._add(pointer, x, array, u, v, None, active)
        return self._answer(pointer, type(u)(0), active)

    def _answer(self, pointer: list, level, active) -> list:
        """Return the cascaded array at a pointer, with the level as its first coordinate if it has such an axis."""
        if self.cascaded.dims > len(pointer):
            pointer = [lookup.clamp(level * (1 / max(1, self.structure.skip)), 0.0, 1.0), *pointer]
        return self.cascaded(pointer, active)

    def _add(self, pointer: list, layer: FineLayer, array: DifferentiableArray, u, v, share, active) -> None:
        """Add a layer to ``pointer``, or replace it by a layer that holds pointers, times ``share`` (``None``: 1)."""
        values = array(self._place(array, u, v), active)
        if self.structure.is_pointer(layer):
            for k, value in enumerate(values):
                pointer[k] = value if share is None else dr.fma(share, value - pointer[k], pointer[k])
            return
        for k, value in enumerate(values):
            value = (value - layer.zero) * layer.scale[k]
            pointer[k] = pointer[k] + value if share is None else dr.fma(share, value, pointer[k])

    def _place(self, array: DifferentiableArray, u, v) -> list:
        """Return the coordinates (v, u) of a read of a fine array, whose entries lie at texel centres."""
        return [v, u] if isinstance(array, PagedArray) else self._at(u, v, array.resolution)

    def _at(self, u, v, resolution) -> list:
        """Return the coordinates (v, u) of a read of a grid, whose entries lie at texel centres."""
        place = []
        for x, n, border in zip((v, u), resolution, self.border, strict=True):
            place.append(x - 0.5 / n if border == "repeat" else (x * n - 0.5) * (1 / max(1, n - 1)))
        return place

    def _level(self, level) -> tuple:
        """Return rows and columns of a whole level for each place, and its first entry in ``coarse``."""
        structure, UInt32 = self.structure, type(level)
        sizes = structure.sizes[structure.skip :]
        if len(sizes) == 1:
            return tuple(map(UInt32, sizes[0])), UInt32(0)
        offset, start = UInt32(0), 0
        for i, size in enumerate(sizes[:-1]):
            start += math.prod(size)
            offset = dr.select(level > structure.skip + i, start, offset)
        return tuple(dr.maximum(UInt32(n) >> level, 1) for n in (structure.height, structure.width)), offset

    def _coarse(self, u, v, rows, columns, offset, active) -> list:
        """Return the pointer of ``coarse`` at (u, v) in the level of so many rows and columns from an entry on."""
        across = around(u, columns, self.border[1])
        corners = []
        for row, a in around(v, rows, self.border[0]):
            corners += [(offset + row * columns + column, a * b) for column, b in across]
        return self.coarse.blend(corners, active)


#: Names of the paper's arrays.
PAPER = ("primary0", "primary1", "cascaded")


class CompressedTexture(FilteredMaps):
    """A compressed texture or material, read at any level of detail.

    ``layout`` lists the maps, ``net`` reads the arrays. ``net`` is ``None`` if all channels are
    constant. ``level_bias`` is added to a footprint's level of detail; negative
    ones (:data:`.arguments.BIAS_RANGE`) read finer levels.
    """

    def __init__(self, layout: Layout, net: PaperNet | LayeredNet | None, level_bias: float = 0.0):
        self.layout, self.net, self.level_bias = layout, net, level_bias
        self.types = None if net is None else backend_module(net.cascaded.data)
        self.border = ("clamp", "clamp") if net is None else net.border
        self.levels = len(level_sizes(layout.height, layout.width))

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name."""
        return {} if self.net is None else self.net.arrays

    @staticmethod
    def from_table(table: Table, dtype, storage: str = "") -> CompressedTexture:
        """Return the texture of a checked table, in a storage form (:func:`allocate`)."""
        return assemble(table, allocate(table, dtype, storage))

    def stored(self, u, v, active=True) -> list:
        """Return the stored channels at (u, v) in level 0, with as few reads as that takes."""
        return [] if self.net is None else self.net.stored(u, v, active)

    def filtered(self, u, v, level, active=True) -> list:
        """Return the stored channels at (u, v) and a level of detail."""
        return [] if self.net is None else self.net.filtered(u, v, self.clamped(self.biased(level), type(u)), active)

    @property
    def has_extras(self) -> bool:
        """Whether the arrays hold numbers beside the channels (:attr:`.LayeredNet.extras`)."""
        return self.net is not None and self.net.extras is not None

    def extra(self, u, v, level, active=True) -> list | None:
        """Return the extras at (u, v) and a level of detail (:meth:`.LayeredNet.extra`), ``None`` without them."""
        return self.net.extra(u, v, self.clamped(self.biased(level), type(u)), active) if self.has_extras else None

    def measure(self, source: Source) -> dict[str, float]:
        """Return the errors against the mip pyramid of ``source``.

        - ``psnr_db``, ``psnr_MAP_db``: all channels, and each map, at the texel centres of level 0.
        - ``psnr_l0_db``, ``psnr_l1_db``, …: all channels at the texel centres of each level; ``psnr_worst_db``: the
          least of these.
        - ``psnr_between_db``: all channels at 2¹⁸ random places and levels of detail, half of them magnified, against
          the pyramid at the same level.
        - ``mean_error``: the largest difference of the mean of a channel at level 0.

        Values are compared in the encoding of the file, values of high dynamic range as logarithms.
        """
        pyramid = Pyramid.from_source(source, self.layout, self.types, self.border)
        by_level, by_map, worst_mean = [], {}, 0.0
        for level, values in enumerate(pyramid.values):
            decoded, errors, weights = self.decode(level=level), [], []
            for m, layout in zip(source.maps, self.layout.maps, strict=True):
                truth = m.values if level == 0 else np.stack(self._truth(layout.name, values), axis=-1)
                got, expected = layout.encode(decoded[m.name]), layout.encode(truth)
                errors.append(float(np.mean((got - expected) ** 2, dtype=np.float64)))
                weights.append(layout.channels)
                if level == 0:
                    by_map[map_figure(m.name)] = decibel(errors[-1])
                    means = [x.mean(axis=(0, 1), dtype=np.float64) for x in (got, expected)]
                    worst_mean = max(worst_mean, float(np.abs(means[0] - means[1]).max()))
            by_level.append(decibel(float(np.average(errors, weights=weights))))
        return {
            "psnr_db": by_level[0],
            "psnr_worst_db": min(by_level),
            **by_map,
            **{f"psnr_l{i}_db": value for i, value in enumerate(by_level)},
            "psnr_between_db": decibel(self._between(pyramid)),
            "mean_error": worst_mean,
        }

    def _truth(self, name: str, values: np.ndarray) -> list:
        """Return the channels of a map from the stored channels of a level."""
        channels = self.layout.decode(name, np.moveaxis(values, -1, 0))
        return [np.broadcast_to(np.asarray(v, np.float32), values.shape[:2]) for v in channels]

    def _between(self, pyramid: Pyramid, count: int = 2**18) -> float:
        """Return the mean squared error of the stored channels at random places and levels of detail."""
        if self.types is None:
            return 0.0
        Float, rng = self.types.Float, np.random.default_rng(2023)
        u, v = rng.random((2, count), dtype=np.float32)
        level = np.maximum(0, rng.random(count, dtype=np.float32) * 2 - 1) * (self.levels - 1)
        place = [Float(aligned_copy(x, np.float32)) for x in (u, v, level)]
        with dr.suspend_grad():
            truth = pyramid.filtered(*place[:2], self.biased(place[2]))
            pairs = [*zip(self.filtered(*place), truth, strict=True)]
            dr.eval(pairs)  # all channels at once: NumPy asks for one after the other, each a kernel
            return float(np.mean([np.mean((a.numpy() - b.numpy()) ** 2, dtype=np.float64) for a, b in pairs]))


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """Return the arrays of a checked table: :func:`~mi_diffind.maps.model.allocate_maps` of this task."""
    layout = Layout.from_json(table.settings["layout"])
    sizes = level_sizes(layout.height, layout.width)
    return allocate_maps(table, dtype, storage, lambda name: sizes[int(name.removeprefix("level"))])


def assemble(table: Table, arrays: dict[str, DifferentiableArray]) -> CompressedTexture:
    """Return the texture of a checked table from its allocated arrays."""
    layout, bias = Layout.from_json(table.settings["layout"]), read_level_bias(table.settings)
    if not arrays:
        return CompressedTexture(layout, None)
    structure, border = read_structure(table.settings, layout)
    if isinstance(structure, PaperStructure):
        return CompressedTexture(layout, PaperNet(*(arrays[name] for name in PAPER), structure), bias)
    fine = [arrays[f"level{layer.level}"] for layer in structure.layers]
    net = LayeredNet(fine, arrays["coarse"], arrays["cascaded"], structure, border, arrays.get("extras"))
    return CompressedTexture(layout, net, bias)


def to_table(texture: CompressedTexture, settings: dict) -> Table:
    """Return the table file of a texture, with ``settings``."""
    stored = {}
    for name, array in texture.arrays.items():
        stored |= to_stored_arrays(name, array)
    settings = {k: v for k, v in settings.items() if k not in ("structure", "border")}  # in "arrays" below
    settings["layout"] = texture.layout.to_json()
    if texture.level_bias:
        settings["level_bias"] = texture.level_bias
    if texture.net is not None:
        structure = texture.net.structure
        if isinstance(structure, PaperStructure):
            settings["arrays"] = {"kind": "paper", "axis": "side"}
        else:
            settings["arrays"] = {
                "kind": "layers", "skip": structure.skip, "bits": structure.bits, "base": structure.base,
                "border": list(texture.border), "layers": list(map(asdict, structure.layers)),
            }  # fmt: skip
    return Table("texture", stored, settings=settings)


def read_level_bias(settings: dict) -> float:
    """Return the level bias of a file, 0 if its settings have none. Raises ``ValueError`` beyond the allowed range."""
    bias = settings.get("level_bias", 0.0)
    low, high = BIAS_RANGE
    if isinstance(bias, bool) or not isinstance(bias, (int, float)) or not low <= bias <= high:
        raise ValueError(f"level_bias: found {bias!r:.40}, allowed are numbers from {low:g} to {high:g}")
    return float(bias)


def read_structure(settings: dict, layout: Layout):
    """Return the structure of the arrays of a file and the border along v and u (``None`` for the paper's arrays).

    Raises ``KeyError``, ``TypeError`` or ``ValueError`` for damaged settings.
    """
    entry, levels = settings["arrays"], len(level_sizes(layout.height, layout.width))
    if entry["kind"] == "paper":
        if entry["axis"] != "side":
            raise ValueError(f"its footprints measure {entry['axis']!r:.40}, allowed is 'side': train it again")
        return PaperStructure(levels), None
    if entry["kind"] != "layers":
        raise ValueError(f"arrays of the kind {entry['kind']!r:.40}")
    skip, bits, border = int(entry["skip"]), int(entry["bits"]), tuple(entry["border"])
    if not 0 <= skip < levels or not 1 <= bits <= 8 or len(border) != 2 or any(b not in BORDERS for b in border):
        raise ValueError("the first level of the coarse array, its bits or the borders are damaged")
    layers, last = [], -1
    for item in entry["layers"]:
        scale, paged = tuple(map(float, item["scale"])), bool(item["paged"])
        layer = FineLayer(int(item["level"]), int(item["until"]), int(item["bits"]), scale, paged)
        if not last < layer.level <= layer.until < skip or not 1 <= layer.bits <= 8:
            raise ValueError("the levels or bits of the fine arrays are damaged")
        if not layer.scale or not all(math.isfinite(s) and 0 < s <= 4 for s in layer.scale):
            raise ValueError("the scales of the fine arrays are damaged")
        last = layer.level
        layers.append(layer)
    base = bool(entry["base"])
    if base and not layers:
        raise ValueError("no fine array could hold pointers")
    return LayeredStructure(layout.height, layout.width, tuple(layers), skip, bits, base), border


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`.TableError`."""
    table = load_table(path, "texture")
    layout = read_layout(table)
    try:
        read_level_bias(table.settings)
        structure, border = read_structure(table.settings, layout) if layout.stored else (None, None)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as e:
        raise TableError(f"{path}: its settings describe no texture ({e})") from None
    if structure is None:
        check_arrays(table, {}, {})
    elif isinstance(structure, PaperStructure):
        check_arrays(
            table, {"primary0": (None, None, 3), "primary1": (None, 1), "cascaded": (*(None,) * 4, layout.stored)}, {}
        )
    else:
        _check_layers(table, layout, structure, border)
    return table


def _check_layers(table: Table, layout: Layout, structure: LayeredStructure, border: tuple[str, str]) -> None:
    """Raise :class:`TableError` unless a table holds the arrays of a structure."""
    path, arrays, layers = table.path, table.arrays, {f"level{x.level}": x for x in structure.layers}
    dims = arrays["coarse"].shape[-1] if "coarse" in arrays else 0
    axes = len(arrays["cascaded"].shape) - 1 if "cascaded" in arrays else 0
    sizes = {name: structure.sizes[x.level] for name, x in layers.items()}
    shapes = {name: (*sizes[name], x.channels) for name, x in layers.items()}
    shapes["coarse"] = (sum(map(math.prod, structure.sizes[structure.skip :])), dims)
    shapes["cascaded"] = (structure.skip + 1,) * (axes > dims) + (None,) * dims + (layout.stored,)
    shapes |= {"extras": (None, None, None, len(NEUTRAL))} if "extras" in arrays else {}
    check_arrays(table, shapes, {name: sizes[name] for name, x in layers.items() if x.paged})
    for name, layer in layers.items():
        array, along = arrays[name], arrays[name + PAGES if layer.paged else name].border
        if layer.channels > dims or (layer.channels < dims and structure.is_pointer(layer)):
            raise TableError(f'{path}: array "{name}" has {layer.channels} channels, its pointers have {dims}')
        if along != border:
            raise TableError(f'{path}: array "{name}" has the borders {along}, expected {border}')
        if array.storage == "uint8" and array.bits != layer.bits:
            bits = f"{layer.bits} by its settings"
            raise TableError(f'{path}: array "{name}" has {array.bits} bits an entry, expected {bits}')
    if "extras" in arrays and (along := arrays["extras"].border) != ("clamp", *border):
        raise TableError(f'{path}: array "extras" has the borders {along}, expected {("clamp", *border)}')


class TextureModel(MapsModel):
    """Model of a texture file; ``image`` is a :class:`CompressedTexture`."""

    def build(self):
        self.image = assemble(self.table, self.arrays)

    def describe(self):
        figures, lines = super().describe()
        image, measured = self.image, self.table.measured
        by_level = [measured.get(f"psnr_l{i}_db") for i in range(image.levels)]
        figures = {**figures, "levels": image.levels, "level_bias": image.level_bias, "psnr_by_level_db": by_level}
        if all(value is not None for value in by_level):
            listed = ", ".join(f"{value:.1f}" for value in by_level)
            lines.append(f"  {image.levels} levels of detail: {listed} dB")
        if image.level_bias:
            lines.append(f"  read {-image.level_bias:g} levels finer than a round footprint")
        if image.has_extras:
            lines.append("  extras: shape and weight of the highlight, read by neural_material alone")
        return {**figures, "extras": image.has_extras}, lines

    def decode(self, output=None, map=None, width=None, height=None, level: int = 0):
        """Write the maps at a level of detail, by default in its own size (:meth:`.MapsModel.decode`)."""
        image = self.image
        if not 0 <= level < image.levels:
            raise UsageError(f"{self.table.path}: --level: found {level}, the file has levels 0 to {image.levels - 1}")
        rows, columns = image.level_size(level)
        return super().decode(output, map, width or columns, height or rows, level=level)


MODEL = TextureModel
