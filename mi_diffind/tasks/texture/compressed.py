"""
A texture as a table file holds it: a layout of its maps, and the arrays of its channels at every level of detail.
"""

from __future__ import annotations

import math
import os

import drjit as dr
import numpy as np

from ...indirection import DifferentiableArray
from ...lookup import BORDERS
from ...maps.compressed import FilteredMaps, decibel
from ...maps.layout import Layout
from ...maps.pyramid import Pyramid, level_sizes
from ...maps.source import Source
from ...pages import page_counts, page_shift
from ...tables import PAGES, Table, TableError, allocate_pages, load_table, page_sides, stored_arrays
from .nets import FineLayer, LayeredNet, LayeredStructure, PaperNet, PaperStructure, coarse_texels, types_of
from .sampling import AXES


class CompressedTexture(FilteredMaps):
    """
    A compressed texture or material that is read at any level of detail: ``layout`` says which maps there are, ``net``
    reads the arrays (:mod:`.nets`). ``net`` is ``None`` if no channel is stored, since all are constant.
    """

    def __init__(self, layout: Layout, net: PaperNet | LayeredNet | None):
        self.layout, self.net = layout, net
        self.types = None if net is None else types_of(net)
        self.border = ("clamp", "clamp") if net is None else net.border
        self.levels = len(level_sizes(layout.height, layout.width))

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name."""
        return {} if self.net is None else self.net.arrays

    @staticmethod
    def of(table: Table, dtype, storage: str = "") -> CompressedTexture:
        """The texture of a checked table, see :func:`allocate`."""
        return assembled(table, allocate(table, dtype, storage))

    def stored(self, u, v, active=True) -> list:
        """The stored channels at (u, v) in level 0; of arrays for coarser levels no more is read than that needs."""
        return [] if self.net is None else self.net.stored(u, v, active)

    def filtered(self, u, v, level, active=True) -> list:
        """The stored channels at (u, v) and a level of detail."""
        return [] if self.net is None else self.net.filtered(u, v, self.clamped(level, type(u)), active)

    # -- how good it is -----------------------------------------------------------------------------------------------

    def measure(self, source: Source) -> dict[str, float]:
        """
        Errors against the pyramid of ``source``: ``psnr_db``, of all channels together at the texel centres of level 0,
        ``psnr_MAP_db`` of each map there, ``psnr_l0_db``, ``psnr_l1_db``, … of all channels at those of each level,
        ``psnr_worst_db``, the least of these, ``psnr_between_db`` at 2¹⁸ random places and levels of detail, half of
        them magnified, and ``mean_error``, the largest difference of the mean of a channel at level 0. Values are
        compared as they are in the file, those of high dynamic range as logarithms.
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
                    by_map[f"psnr_{m.name}_db"] = decibel(errors[-1])
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
        """The channels of a map from the stored ones of a level."""
        found = self.layout.decode(name, np.moveaxis(values, -1, 0))
        return [np.broadcast_to(np.asarray(v, np.float32), values.shape[:2]) for v in found]

    def _between(self, pyramid: Pyramid, count: int = 2**18) -> float:
        """Mean squared error of the stored channels at random places and levels of detail."""
        types = self.types
        if types is None:
            return 0.0
        rng = np.random.default_rng(2023)
        u, v = (types.Float(x) for x in rng.random((2, count), dtype=np.float32))
        level = types.Float(np.maximum(0, rng.random(count, dtype=np.float32) * 2 - 1) * (self.levels - 1))
        with dr.suspend_grad():
            got, expected = self.filtered(u, v, level), pyramid.filtered(u, v, level)
            return float(
                np.mean(
                    [
                        np.mean((a.numpy() - b.numpy()) ** 2, dtype=np.float64)
                        for a, b in zip(got, expected, strict=True)
                    ]
                )
            )


# -- files ------------------------------------------------------------------------------------------------------------


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """
    The arrays of a checked table for the tensor type ``dtype``: as bytes, if it has them as bytes, which can be read
    only; with the ``storage`` ``"float32"``, as floats that pass through the fold, which can be optimised.
    """
    entry_type = "uint8" if storage != "float32" and table.storage == "uint8" else "float32"
    found = {}
    for name, array in table.arrays.items():
        pages = table.arrays.get(name + PAGES)
        if pages is not None:
            layout = Layout.from_json(table.settings["layout"])
            sizes = level_sizes(layout.height, layout.width)
            shift = page_shift(sizes[int(name.removeprefix("level"))])
            found[name] = allocate_pages(array, pages, dtype, shift, entry_type, fold=True)
        elif not name.endswith(PAGES):
            found[name] = array.allocate(dtype, entry_type, fold=True)
    return found


def assembled(table: Table, arrays: dict[str, DifferentiableArray]) -> CompressedTexture:
    """The texture that the allocated arrays of a checked table make."""
    layout = Layout.from_json(table.settings["layout"])
    if not arrays:
        return CompressedTexture(layout, None)
    structure, border = structure_of(table.settings, layout)
    if isinstance(structure, PaperStructure):
        return CompressedTexture(layout, PaperNet(*(arrays[name] for name in PAPER), structure))
    fine = [arrays[f"level{layer.level}"] for layer in structure.layers]
    return CompressedTexture(layout, LayeredNet(fine, arrays["coarse"], arrays["cascaded"], structure, border))


#: Names of the paper's arrays.
PAPER = ("primary0", "primary1", "cascaded")


def to_table(texture: CompressedTexture, settings: dict) -> Table:
    """The table file of a texture."""
    stored = {}
    for name, array in texture.arrays.items():
        stored |= stored_arrays(name, array)
    settings = {**settings, "layout": texture.layout.to_json()}
    if texture.net is not None:
        structure = texture.net.structure
        if isinstance(structure, PaperStructure):
            settings["arrays"] = {"kind": "paper", "axis": structure.axis}
        else:
            layers = [
                {"level": x.level, "until": x.until, "bits": x.bits, "scale": list(x.scale), "paged": x.paged}
                for x in structure.layers
            ]
            settings["arrays"] = {
                "kind": "layers", "skip": structure.skip, "bits": structure.bits, "base": structure.base,
                "border": list(texture.border), "layers": layers,
            }  # fmt: skip
    return Table("texture", stored, settings=settings)


def structure_of(settings: dict, layout: Layout):
    """
    What the settings of a file say about its arrays, and the border along v and u. Raises ``KeyError``, ``TypeError``
    or ``ValueError`` for anything else.
    """
    found, levels = settings["arrays"], len(level_sizes(layout.height, layout.width))
    if found["kind"] == "paper":
        if found["axis"] not in AXES:
            raise ValueError(f"footprints measure {found['axis']!r}")
        return PaperStructure(levels, found["axis"]), None
    if found["kind"] != "layers":
        raise ValueError(f"arrays of the kind {found['kind']!r:.40}")
    skip, bits, border = int(found["skip"]), int(found["bits"]), tuple(found["border"])
    if not 0 <= skip < levels or not 1 <= bits <= 8 or len(border) != 2 or any(b not in BORDERS for b in border):
        raise ValueError("the level that is skipped to, the bits or the borders are damaged")
    layers, last = [], -1
    for entry in found["layers"]:
        scale, paged = tuple(map(float, entry["scale"])), bool(entry["paged"])
        layer = FineLayer(int(entry["level"]), int(entry["until"]), int(entry["bits"]), scale, paged)
        if not last < layer.level <= layer.until < skip or not 1 <= layer.bits <= 8:
            raise ValueError("the fine arrays are of no levels that there are")
        if not layer.scale or not all(math.isfinite(s) and 0 < s <= 4 for s in layer.scale):
            raise ValueError("the scales of the fine arrays are damaged")
        last = layer.level
        layers.append(layer)
    base = bool(found["base"])
    if base and not layers:
        raise ValueError("there is no fine array that could hold pointers")
    return LayeredStructure(layout.height, layout.width, tuple(layers), skip, bits, base), border


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`~mi_diffind.tables.TableError`."""
    table = load_table(path, "texture")
    structure = border = None
    try:
        layout = Layout.from_json(table.settings["layout"])
        if layout.stored:
            structure, border = structure_of(table.settings, layout)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as e:
        raise TableError(f"{path}: its settings describe no texture ({e})") from None
    pages = (
        []
        if not isinstance(structure, LayeredStructure)
        else [f"level{x.level}{PAGES}" for x in structure.layers if x.paged]
    )
    shapes = {name: array.shape for name, array in table.arrays.items() if name not in pages}
    fine = (
        []
        if structure is None or isinstance(structure, PaperStructure)
        else [f"level{layer.level}" for layer in structure.layers]
    )
    expected = (
        [] if structure is None else PAPER if isinstance(structure, PaperStructure) else [*fine, "coarse", "cascaded"]
    )
    if set(table.arrays) != {*expected, *pages}:
        found, wanted = (", ".join(sorted(names)) or "none" for names in (table.arrays, {*expected, *pages}))
        raise TableError(f"{path}: holds the arrays {found}, expected {wanted}")
    if structure is None:
        return table
    if isinstance(structure, PaperStructure):
        wanted = {"primary0": (None, None, 3), "primary1": (None, 1), "cascaded": (None,) * 4 + (layout.stored,)}
    else:
        dims = shapes["coarse"][-1]
        axes = len(shapes["cascaded"]) - 1
        wanted = {
            **{
                n: (_entries(table, n, structure.sizes[x.level], border), x.channels)
                if x.paged
                else (*structure.sizes[x.level], x.channels)
                for n, x in zip(fine, structure.layers, strict=True)
            },
            "coarse": (coarse_texels(structure), dims),
            "cascaded": (structure.skip + 1,) * (axes > dims) + (None,) * dims + (layout.stored,),
        }
        for x in structure.layers:
            if x.channels != dims and structure.is_pointer(x):
                raise TableError(f"{path}: has a fine array that holds pointers of {x.channels} of {dims} coordinates")
            if x.channels > dims:
                raise TableError(f"{path}: has a fine array with more channels than the {dims} of its pointers")
    for name, shape in wanted.items():
        found = shapes[name]
        if len(found) != len(shape) or any(w not in (None, f) for f, w in zip(found, shape, strict=True)):
            text = " x ".join("N" if n is None else str(n) for n in shape)
            raise TableError(f'{path}: array "{name}" has the shape {found}, expected {text}')
        array = table.arrays[name]
        if not array.is_pointer:
            raise TableError(f'{path}: array "{name}" has entries outside of [0, 1]')
        if name in fine and name + PAGES not in pages and array.border != border:
            raise TableError(f'{path}: array "{name}" has the borders {array.border}, expected {border}')
        if name in fine and array.storage == "uint8" and array.bits != structure.layers[fine.index(name)].bits:
            raise TableError(f'{path}: array "{name}" has {array.bits} bits an entry, which its settings deny')
    return table


def _entries(table: Table, name: str, size: tuple[int, int], border) -> int:
    """The number of entries of an array of pages on a level of ``size``. Raises :class:`TableError`."""
    pages, counts = table.arrays[name + PAGES], page_counts(size)
    try:
        sides = page_sides(pages)
    except ValueError as e:
        raise TableError(f'{table.path}: array "{name}{PAGES}": {e}') from None
    if sides.shape != (*counts, 2) or pages.border != border:
        raise TableError(
            f'{table.path}: array "{name}{PAGES}" has the shape {sides.shape} and the borders {pages.border}, expected '
            f"{(*counts, 2)} and {border}"
        )
    return int(sides.prod(axis=2).sum())
