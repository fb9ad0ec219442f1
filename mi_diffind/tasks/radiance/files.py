"""Table files of radiance fields: arrays of each layout, checks, and the field of a table."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...arrays.indirection import Indirection, device_array, device_tensor
from ...arrays.tables import (
    StoredArray,
    Table,
    TableError,
    byte_array,
    check_allowance,
    check_numbers,
    load_layout,
    restored,
)
from ...core.archives import allowed
from . import node_codes
from .compression import INDEX_BITS, MOST_BITS, as_bytes
from .grid import NodeGrid
from .nodes import Nodes, layer_count, layers, unpacked
from .paper import PairsField
from .presets import COLOURS
from .reflection import COLUMNS, DIRECTIONS, ENTRIES
from .surroundings import ContractedNodes
from .volume_field import NodeField, PackedPaletteField, VolumeField

#: Numbers of a colour: without and with reflections.
NUMBERS = (DIRECTIONS, COLUMNS)

#: Layout → name of an array → number of its dimensions, and channels. "coded" is "sparse" in fewer bytes.
LAYOUTS = {
    "coded": {"probabilities": (1, 1), "nodes": (1, 1), "palette": (1, NUMBERS)},
    "sparse": {"cells": (1, 1), "density": (1, 1), "index": (1, 2), "palette": (1, NUMBERS)},
    "grid": {"cells": (1, 1), "density": (1, 1), "colour": (1, NUMBERS)},
    "pairs": {
        "cells": (1, 1), "density_primary": (3, 3), "density_cascaded": (3, 1), "colour_primary": (3, 3),
        "colour_cascaded": (3, 12),
    },
}  # fmt: skip

#: Most nodes of a grid, counting those that are not stored.
MOST_NODES = 2**28

#: Bytes of memory for each place of a grid, each one of the layers that are processed at a time, and each stored node,
#: while a file is decoded and its field built, measured.
PLACE_BYTES, LAYER_BYTES, NODE_BYTES = 0.55, 8, 30

#: Range of the largest coordinate of a grid.
SMALLEST, LARGEST = 1e-9, 1e9

#: Bits of a density level of the layout "sparse", and most bits of one.
SPARSE_BITS, MOST_DENSITY_BITS = 6, 6


def stored_nodes(nodes: Nodes) -> tuple[dict[str, StoredArray], dict]:
    """Return the array that marks the stored nodes, one bit each, and the settings of the grid."""
    bits = np.packbits(nodes.stored.reshape(-1))
    settings = {"lower": list(nodes.lower), "spacing": nodes.spacing, "shape": list(nodes.shape)}
    if nodes.contraction is not None:
        settings["inner"] = list(nodes.contraction.inner)
    return {"cells": byte_array(bits[:, None])}, settings


def palette_table(nodes: Nodes, stored: dict) -> Table:
    """Return the table of what :meth:`.compression.PaletteProblem.stored` returned."""
    palette = StoredArray(stored["palette"], (), tuple(stored["scale"]), tuple(stored["offset"]))
    offset, scale = stored["density_range"]
    levels = {"density_bits": stored["density_bits"], "density_offset": offset, "density_scale": scale}
    settings = {"layout": "coded", **levels, **stored_nodes(nodes)[1]}
    arrays = coded(nodes.stored, stored["levels"], stored["index"], palette, settings)
    if "environment" in stored:
        arrays["environment"] = StoredArray(stored["environment"], (), *map(tuple, stored["environment_range"]))
        settings["colours"] = "reflections"
    return Table("field", arrays, settings=settings)


def coded(stored: np.ndarray, levels: np.ndarray, index: np.ndarray, palette: StoredArray, settings: dict) -> dict:
    """Return the arrays of the layout "coded"; the first entries of ``levels`` and ``index`` stand for no node."""
    count = 2 ** settings["density_bits"]
    probabilities, data = node_codes.encoded(stored, levels[1:], index[1:], count, len(palette.entries))
    return {"probabilities": byte_array(probabilities[:, None]), "nodes": byte_array(data[:, None]), "palette": palette}


def sparse(table: Table) -> Table:
    """Return a table of the layout "coded" in the layout "sparse", any other table as it is.

    Raises :class:`.TableError` if it is damaged.
    """
    if table.settings["layout"] != "coded":
        return table
    settings, palette = table.settings, table.arrays["palette"]
    probabilities, data = (table.arrays[name].entries.tobytes() for name in ("probabilities", "nodes"))
    shape, count = tuple(settings["shape"]), 2 ** settings["density_bits"]
    try:
        most = _most_nodes(table.path, shape)
        cells, levels, index = decoded(probabilities, data, shape, count, len(palette.entries), most)
    except node_codes.TooManyNodes as e:
        check_nodes(table, e.count)
        raise TableError(f"{table.path}: is damaged: {e}") from None
    except ValueError as e:
        raise TableError(f"{table.path}: is damaged: {e}") from None
    arrays = {
        "cells": byte_array(cells[:, None]),
        "density": byte_array(levels[:, None], settings["density_scale"], settings["density_offset"]),
        "index": byte_array(index.astype("<u2", copy=False).view(np.uint8).reshape(-1, 2)),
        "palette": palette,
    }
    if "environment" in table.arrays:
        arrays["environment"] = table.arrays["environment"]
    bits = max(1, (len(palette.entries) - 1).bit_length())
    return replace(table, arrays=arrays, settings={**settings, "layout": "sparse", "index_bits": bits})


@functools.lru_cache(maxsize=1)
def decoded(probabilities: bytes, data: bytes, *sizes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flags of the stored nodes, eight to a byte, and their levels and indices; the last result is kept.

    Levels (uint8) and indices (uint16) have a first entry of 0 for no node. Raises ``ValueError`` as
    :func:`.node_codes.decoded_places` does, for the same arguments.
    """
    coding = (np.frombuffer(part, np.uint8) for part in (probabilities, data))
    places, *numbers = node_codes.decoded_places(*coding, *sizes)
    levels, index = (np.concatenate([np.zeros(1, values.dtype), values]) for values in numbers)
    return _packed(places, math.prod(sizes[0])), levels, index


def _packed(places: np.ndarray, size: int) -> np.ndarray:
    """Return ``size`` flags, packed as ``np.packbits`` does, that are set at ``places`` in ascending order."""
    packed, bytes_ = np.zeros(-(-size // 8), np.uint8), places >> 3
    first = np.flatnonzero(np.diff(bytes_, prepend=-1))
    if len(places):
        packed[bytes_[first]] = np.bitwise_or.reduceat(np.uint8(128) >> (places & 7).astype(np.uint8), first)
    return packed


def check_nodes(table: Table, nodes: int = 0) -> None:
    """Raise :class:`TableError` if the grid of a table and so many stored ``nodes`` take more memory than they may."""
    shape = table.settings["shape"]
    size = math.prod(shape)
    content = f"a field of {nodes:,} nodes in a grid of {size:,}" if nodes else f"a field in a grid of {size:,} nodes"
    check_allowance(table, _grid_bytes(shape) + NODE_BYTES * nodes, content)


def _grid_bytes(shape) -> int:
    """Return the bytes of memory of a grid without its stored nodes."""
    return int(PLACE_BYTES * math.prod(shape) + LAYER_BYTES * (layer_count(shape) + 1) * math.prod(shape[1:]))


def _most_nodes(path, shape) -> int:
    """Return the most nodes that a coded file may store: those of :func:`check_nodes`."""
    if path is None:
        return node_codes.MOST_STORED
    left = allowed(Path(path).stat().st_size) - _grid_bytes(shape)
    return min(node_codes.MOST_STORED, max(0, left) // NODE_BYTES)


def grid_table(grid: NodeGrid, dtype=np.float16) -> Table:
    """Return the table of a grid, in half precision by default; the first entry stands for no node."""
    arrays, settings = stored_nodes(grid.nodes)
    arrays["density"] = StoredArray(np.clip(grid.density, -1e4, 1e4)[:, None].astype(dtype))
    arrays["colour"] = StoredArray(np.clip(grid.colour, -1e3, 1e3).astype(dtype))
    if grid.environment is not None:
        arrays["environment"] = StoredArray(np.clip(grid.environment[:, :3], -1e3, 1e3).astype(dtype))
        settings["colours"] = "reflections"
    return Table("field", arrays, settings={"layout": "grid", **settings})


def pairs_table(nodes: Nodes, arrays: dict, low, high) -> Table:
    """Return the table of the pairs of the supplement; ``arrays`` maps names to arrays of a file."""
    masks, settings = stored_nodes(nodes)
    ranges = {"low": [float(v) for v in low], "high": [float(v) for v in high]}
    return Table("field", {**masks, **arrays}, settings={"layout": "pairs", **ranges, **settings})


def load(path) -> Table:
    """Read and check a table file of a radiance field. Raises :class:`.TableError`."""
    table = load_layout(path, "field", LAYOUTS)
    layout = table.settings["layout"]
    if "curve" in table.arrays:
        raise TableError(
            f"{path}: has a density curve, which this package no longer reads: make the file again with "
            f'"mi-diffind fit field FOLDER -o {Path(path).name}"'
        )
    check_colours(table)
    check_numbers(table, "lower", 3)
    check_numbers(table, "spacing", 1, positive=True)
    check_numbers(table, "shape", 3, positive=True, whole=True)
    check_place(table)
    if "inner" in table.settings:
        check_numbers(table, "inner", 4)
        half = table.settings["inner"][3]
        if half <= 0:
            raise TableError(f"{path}: is damaged: found the half side {half} of the inner cube, allowed are those > 0")
    shape = table.settings["shape"]
    if min(shape) < 2 or math.prod(shape) > MOST_NODES:
        raise TableError(f"{path}: is damaged: found a grid of {shape}, allowed are at most {MOST_NODES:,} nodes")
    check_nodes(table)
    if layout == "coded":
        check_numbers(table, "density_scale", 1, positive=True)
        check_numbers(table, "density_offset", 1)
        bits, colours = table.settings.get("density_bits"), len(table.arrays["palette"].entries)
        if bits not in range(1, MOST_DENSITY_BITS + 1) or colours > 2**MOST_BITS:
            raise TableError(f"{path}: is damaged: found {bits!r} bits of a density and {colours:,} colours")
        check_bytes(table, table.arrays)
        sparse(table)
        return table
    check_bytes(table, ["cells"])
    if len(table.arrays["cells"].entries) != -(-math.prod(shape) // 8):
        raise TableError(f'{path}: is damaged: the array "cells" is not that of a grid of {shape}')
    if layout == "pairs":
        for name in ("low", "high"):
            check_numbers(table, name, 13)
        return table
    entries = sum(int(np.count_nonzero(part)) for part in layers(cells_of_file(table), shape)) + 1
    check_nodes(table, entries - 1)
    names = ("density", "index") if layout == "sparse" else ("density", "colour")
    for name in names:
        stored = len(table.arrays[name].entries)
        if stored != entries:
            raise TableError(f'{path}: is damaged: the array "{name}" has {stored} entries, expected {entries}')
    if layout == "sparse":
        check_bytes(table, table.arrays)
        bits = table.settings.get("index_bits")
        if bits not in INDEX_BITS:
            raise TableError(f"{path}: is damaged: found indices of {bits!r} bits, allowed are {INDEX_BITS}")
        last, palette = index_of(table).max(), len(table.arrays["palette"].entries)
        if last >= min(palette, 2**bits):
            raise TableError(f"{path}: is damaged: found the index {last} in a palette of {palette} colours")
        density = table.arrays["density"]
        last = 2**SPARSE_BITS - 1
        if density.storage != "uint8" or density.entries.max() > last:
            raise TableError(f"{path}: is damaged: found a density level that is not a number from 0 to {last}")
    return table


def check_place(table: Table) -> None:
    """Raise :class:`TableError` unless single precision tells the nodes of a grid apart."""
    lower, spacing, shape = (np.float64(table.settings[name]) for name in ("lower", "spacing", "shape"))
    largest = max(np.abs(lower).max(), np.abs(lower + spacing * shape).max())
    if not SMALLEST < largest < LARGEST or spacing < np.spacing(np.float32(largest)):
        raise TableError(
            f"{table.path}: is damaged: found nodes at a distance of {spacing:g} from {table.settings['lower']} on, "
            f"allowed are coordinates between {SMALLEST:g} and {LARGEST:g} that single precision tells apart"
        )


def check_bytes(table: Table, names: Iterable[str]) -> None:
    """Raise :class:`TableError` unless the arrays of these names are bytes."""
    for name in names:
        if table.arrays[name].storage != "uint8":
            kept = table.arrays[name].storage
            raise TableError(f'{table.path}: is damaged: its array "{name}" is stored as {kept}, allowed is uint8')


def check_colours(table: Table) -> None:
    """Raise :class:`TableError` unless a table has the environment that its setting ``colours`` speaks of."""
    colours, environment = table.settings.get("colours", "directions"), table.arrays.get("environment")
    allowed = COLOURS if table.settings["layout"] != "pairs" else ("directions",)
    if colours not in allowed:
        raise TableError(f"{table.path}: is damaged: found the colours {colours!r}, allowed are {', '.join(allowed)}")
    numbers = table.arrays.get("colour", table.arrays.get("palette"))
    shape, columns = environment and environment.shape, numbers and numbers.shape[-1]
    expected = ((ENTRIES, 3), COLUMNS) if colours == "reflections" else (None, DIRECTIONS)
    if table.settings["layout"] != "pairs" and (shape, columns) != expected:
        raise TableError(
            f"{table.path}: is damaged: found an environment of the shape {shape} and {columns} numbers of a "
            f'colour, the colours "{colours}" have {expected[0]} and {expected[1]}'
        )


def environment_of(table: Table) -> np.ndarray | None:
    """Return the environment of a table as :class:`.NodeField` takes it, or ``None``."""
    array = table.arrays.get("environment")
    return None if array is None else np.pad(array.values, ((0, 0), (0, 1)))


def stored(table: Table, entries: dict, storage: str = "") -> Table:
    """Return a table with optimised ``entries``: ``density`` and ``colour`` of its nodes, or of its palette."""
    given, table = table, sparse(table)
    layout, arrays = table.settings["layout"], dict(table.arrays)
    if layout == "pairs":
        allocated = {name: table.arrays[name].allocate(type(values), "float32") for name, values in entries.items()}
        for name, array in allocated.items():
            array.data = entries[name]
        return restored(table, allocated, storage)
    if storage and not (layout == "grid" and storage != "uint8"):
        allowed = "float16 and float32" if layout == "grid" else "none: levels and a palette of bytes"
        raise ValueError(f'storage: found "{storage}", allowed of the layout {layout} are {allowed}')
    density, colour = entries["density"].numpy(), entries["colour"].numpy()
    if "environment" in entries:
        environment = entries["environment"].numpy()[:, :3]
        if layout == "grid":
            form = storage or table.arrays["environment"].storage
            arrays["environment"] = StoredArray(environment.astype(np.float32)).to(form)
        else:
            codes, scale, offset = as_bytes(environment)
            arrays["environment"] = StoredArray(codes, (), tuple(scale.tolist()), tuple(offset.tolist()))
    if layout == "grid":
        for name, values in (("density", density[:, None]), ("colour", colour)):
            form = storage or table.arrays[name].storage
            arrays[name] = StoredArray(values.astype(np.float32)).to(form)
    else:
        levels, palette = table.arrays["density"], colour.reshape(-1, table.arrays["palette"].shape[-1])
        last = 2 ** table.settings.get("density_bits", SPARSE_BITS) - 1
        codes = np.clip(np.rint((density - levels.offset[0]) / levels.scale[0]), 0, last)
        arrays["density"] = replace(levels, entries=codes.astype(np.uint8)[:, None])
        codes, scale, offset = as_bytes(palette)
        arrays["palette"] = StoredArray(codes, (), tuple(scale.tolist()), tuple(offset.tolist()))
        if given is not table:
            codes, palette = arrays["density"].entries[:, 0], arrays["palette"]
            nodes = coded(stored_of(table), codes, index_of(table), palette, given.settings)
            arrays, table = {**given.arrays, **nodes, **{n: a for n, a in arrays.items() if n == "environment"}}, given
    return replace(table, arrays=arrays, settings={**table.settings, "optimised": True}, measured={}, path=None)


def stored_of(table: Table) -> np.ndarray:
    """Return the mask of stored nodes: bool of the ``shape`` of the grid."""
    return unpacked(cells_of_file(table), table.settings["shape"])


def cells_of_file(table: Table) -> np.ndarray:
    """Return the flags of stored nodes, eight to a byte."""
    return np.ascontiguousarray(table.arrays["cells"].entries[:, 0])


def nodes_of(table: Table, types, packed: bool = False) -> Nodes:
    """Return the nodes of a checked table. Raises :class:`TableError` if there are none."""
    settings = table.settings
    stored = cells_of_file(table) if packed else stored_of(table)
    if not stored.any():
        raise TableError(f"{table.path or 'the field'}: holds no nodes")
    place = types, settings["lower"], settings["spacing"], settings["shape"], stored, packed
    return ContractedNodes(*place, inner=settings["inner"]) if "inner" in settings else Nodes(*place)


def grid_of(table: Table, types, nodes: Nodes | None = None) -> NodeGrid:
    """Return the grid of a checked table of the layout "grid", with its ``nodes``, if these are made already."""
    nodes = nodes_of(table, types) if nodes is None else nodes
    density, colour = (table.arrays[name].values for name in ("density", "colour"))
    return NodeGrid(nodes, density[:, 0], colour, environment_of(table))


def index_of(table: Table) -> np.ndarray:
    """Return the palette index of each node, uint32 ``(n,)``."""
    low, high = table.arrays["index"].entries.astype(np.uint32).T
    return low | (high << 8)


def field_of(table: Table, types, storage: str = "") -> VolumeField:
    """Return the field of a checked table.

    It is packed for rendering; with the ``storage`` ``"float32"``, its ``arrays`` can be trained instead.
    """
    table = sparse(table)
    settings, layout, arrays = table.settings, table.settings["layout"], table.arrays
    floats = storage == "float32"
    nodes = nodes_of(table, types, packed=not floats)
    tensor, environment = types.TensorXf, environment_of(table)
    if layout == "grid":
        return grid_of(table, types, nodes).field()
    if layout == "pairs":
        allocated = {name: arrays[name].allocate(tensor, storage) for name in PairsField.NAMES}
        density, colour = (
            Indirection([allocated[f"{name}_primary"]], allocated[f"{name}_cascaded"]) for name in ("density", "colour")
        )
        return PairsField(nodes, density, colour, settings["low"], settings["high"])
    palette, density, index = arrays["palette"], arrays["density"], index_of(table)
    if floats:
        environment = None if environment is None else device_tensor(tensor, environment)
        return NodeField(nodes, *(device_tensor(tensor, v) for v in (density.values[:, 0], palette.values)),
                         device_array(types.UInt32, index), environment)  # fmt: skip
    stored = {
        "levels": density.entries[:, 0], "density_range": (density.offset[0], density.scale[0]), "index": index,
        "palette": palette.entries, "scale": palette.scale, "offset": palette.offset,
    }  # fmt: skip
    if environment is not None:
        array = arrays["environment"]
        stored |= {"environment": array.entries, "environment_range": (array.scale, array.offset)}
    return PackedPaletteField(nodes, stored, settings.get("density_bits", SPARSE_BITS), settings["index_bits"])
