"""Compressed textures: reading at any level of detail, errors by level, and their table files."""

from __future__ import annotations

import math
import os
from dataclasses import asdict

import drjit as dr
import numpy as np

from ...arrays.indirection import DifferentiableArray, aligned_copy
from ...arrays.lookup import BORDERS
from ...arrays.tables import PAGES, Table, TableError, load_table, to_stored_arrays
from ...core.compat import backend_module
from ...core.errors import UsageError
from ...maps.arguments import BIAS_RANGE
from ...maps.compressed import FilteredMaps, decibel, map_figure
from ...maps.layout import Layout
from ...maps.model import MapsModel, allocate_maps, stored_entries
from ...maps.pyramid import Pyramid, level_sizes
from ...maps.source import Source
from .nets import NEUTRAL, FineLayer, LayeredNet, LayeredStructure, PaperNet, PaperStructure

#: Names of the paper's arrays.
PAPER = ("primary0", "primary1", "cascaded")


class CompressedTexture(FilteredMaps):
    """A compressed texture or material, read at any level of detail.

    ``layout`` lists the maps, ``net`` reads the arrays (:mod:`.nets`). ``net`` is ``None`` if all channels are
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
    def of(table: Table, dtype, storage: str = "") -> CompressedTexture:
        """Return the texture of a checked table, in a storage form (:func:`allocate`)."""
        return assembled(table, allocate(table, dtype, storage))

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
        pyramid = Pyramid.of(source, self.layout, self.types, self.border)
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


def assembled(table: Table, arrays: dict[str, DifferentiableArray]) -> CompressedTexture:
    """Return the texture of a checked table from its allocated arrays."""
    layout, bias = Layout.from_json(table.settings["layout"]), bias_of(table.settings)
    if not arrays:
        return CompressedTexture(layout, None)
    structure, border = structure_of(table.settings, layout)
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


def bias_of(settings: dict) -> float:
    """Return the level bias of a file, 0 if its settings have none. Raises ``ValueError`` beyond the allowed range."""
    bias = settings.get("level_bias", 0.0)
    low, high = BIAS_RANGE
    if isinstance(bias, bool) or not isinstance(bias, (int, float)) or not low <= bias <= high:
        raise ValueError(f"level_bias: found {bias!r:.40}, allowed are numbers from {low:g} to {high:g}")
    return float(bias)


def structure_of(settings: dict, layout: Layout):
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
    table, expected = load_table(path, "texture"), ()
    try:
        layout = Layout.from_json(table.settings["layout"])
        bias_of(table.settings)
        structure, border = structure_of(table.settings, layout) if layout.stored else (None, None)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as e:
        raise TableError(f"{path}: its settings describe no texture ({e})") from None
    layers = {f"level{x.level}": x for x in getattr(structure, "layers", ())}
    if isinstance(structure, PaperStructure):
        expected = PAPER
    elif structure is not None:
        pages = [name + PAGES for name, x in layers.items() if x.paged]
        extras = ["extras"] if "extras" in table.arrays else []
        expected = (*layers, *pages, "coarse", "cascaded", *extras)
    if set(table.arrays) != set(expected):
        names, wanted = (", ".join(sorted(n)) or "none" for n in (table.arrays, expected))
        raise TableError(f"{path}: holds the arrays {names}, expected {wanted}")
    for name, shape in _shapes(table, layout, structure, layers).items():
        array = table.arrays[name]
        if len(array.shape) != len(shape) or any(w not in (None, n) for n, w in zip(array.shape, shape, strict=True)):
            text = " x ".join("N" if n is None else str(n) for n in shape)
            raise TableError(f'{path}: array "{name}" has the shape {array.shape}, expected {text}')
        if not array.is_pointer:
            raise TableError(f'{path}: array "{name}" has entries outside of [0, 1]')
        layer = layers.get(name)
        if layer or name == "extras":
            along = table.arrays[name + PAGES].border if layer and layer.paged else array.border
            wanted = border if layer else ("clamp", *border)
            if along != wanted:
                raise TableError(f'{path}: array "{name}" has the borders {along}, expected {wanted}')
        if layer and array.storage == "uint8" and array.bits != layer.bits:
            raise TableError(
                f'{path}: array "{name}" has {array.bits} bits an entry, expected {layer.bits} by its settings'
            )
    return table


def _shapes(table: Table, layout: Layout, structure, layers: dict[str, FineLayer]) -> dict[str, tuple]:
    """Return the shapes of arrays by name; ``None`` stands for any number. Raises :class:`TableError`."""
    if structure is None:
        return {}
    if isinstance(structure, PaperStructure):
        return {"primary0": (None, None, 3), "primary1": (None, 1), "cascaded": (*(None,) * 4, layout.stored)}
    dims, axes = table.arrays["coarse"].shape[-1], len(table.arrays["cascaded"].shape) - 1
    shapes = {}
    for name, layer in layers.items():
        if layer.channels > dims or (layer.channels < dims and structure.is_pointer(layer)):
            raise TableError(f'{table.path}: array "{name}" has {layer.channels} channels, its pointers have {dims}')
        size = structure.sizes[layer.level]
        shapes[name] = (*((stored_entries(table, name, size),) if layer.paged else size), layer.channels)
    shapes["coarse"] = (sum(map(math.prod, structure.sizes[structure.skip :])), dims)
    shapes["cascaded"] = (structure.skip + 1,) * (axes > dims) + (None,) * dims + (layout.stored,)
    return shapes | ({"extras": (None, None, None, len(NEUTRAL))} if "extras" in table.arrays else {})


class TextureModel(MapsModel):
    """Model of a texture file; ``image`` is a :class:`CompressedTexture`."""

    def build(self):
        self.image = assembled(self.table, self.arrays)

    def describe(self):
        figures, lines = super().describe()
        image, measured = self.image, self.table.measured
        by_level = [measured.get(f"psnr_l{i}_db") for i in range(image.levels)]
        figures = {**figures, "levels": image.levels, "level_bias": image.level_bias, "psnr_by_level_db": by_level}
        if all(value is not None for value in by_level):
            listed = ", ".join(f"{value:.1f}" for value in by_level)
            lines.append(f"  {image.levels} levels of detail: {listed} dB")
        if image.level_bias:
            lines.append(f"  read {-image.level_bias:g} levels finer than the footprint")
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
