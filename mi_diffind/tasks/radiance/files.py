"""Table files of radiance fields: arrays of each layout, checks, and the field of a table."""

import functools
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...arrays.indirection import Indirection, device_array
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
from . import COLOURS
from .coding import MOST_STORED, TooManyNodes, decode, encode
from .compression import INDEX_BITS, MOST_BITS, to_bytes
from .grid import NodeGrid
from .nodes import Nodes, layer_count, layers, unpack_mask
from .paper import PairsField
from .volume_field import COLUMNS, DIRECTIONS, ENTRIES, NodeField, PackedPaletteField, PaletteArrays, VolumeField

#: Numbers of a colour: without and with reflections.
NUMBERS = (DIRECTIONS, COLUMNS)

#: Layout → name of an array → number of its dimensions, and channels. "sparse" is read, but no longer written.
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

#: Bytes of memory for each stored node, measured.
NODE_BYTES = 30

#: Range of the largest coordinate of a grid.
SMALLEST, LARGEST = 1e-9, 1e9

#: Bits of a density level of the layout "sparse", and most bits of one.
SPARSE_BITS = MOST_DENSITY_BITS = 6


def stored_nodes(nodes: Nodes) -> tuple[dict[str, StoredArray], dict]:
    """Return the array that marks the stored nodes, one bit each, and the settings of the grid."""
    bits = np.packbits(nodes.stored.reshape(-1))
    settings = {"lower": list(nodes.lower), "spacing": nodes.spacing, "shape": list(nodes.shape)}
    if nodes.contraction is not None:
        settings["inner"] = list(nodes.contraction.inner)
    return {"cells": byte_array(bits[:, None])}, settings


def palette_table(nodes: Nodes, numbers: PaletteArrays) -> Table:
    """Return the table of the numbers of stored ``nodes``, entropy-coded."""
    offset, scale = numbers.density_range
    levels = {"density_bits": numbers.density_bits, "density_offset": offset, "density_scale": scale}
    settings = {"layout": "coded", **levels, **stored_nodes(nodes)[1]}
    if numbers.environment is not None:
        settings["colours"] = "reflections"
    return Table("field", coded_arrays(nodes.stored, numbers), settings=settings)


def coded_arrays(stored: np.ndarray, numbers: PaletteArrays) -> dict[str, StoredArray]:
    """Return the arrays of the layout "coded" for a mask of ``stored`` nodes."""
    levels, index, palette = numbers.levels[1:], numbers.index[1:], numbers.palette
    coding = encode(stored, levels, index, 2**numbers.density_bits, len(palette.entries))
    probabilities, symbols = (byte_array(part[:, None]) for part in coding)
    shared = {} if numbers.environment is None else {"environment": numbers.environment}
    return {"probabilities": probabilities, "nodes": symbols, "palette": palette, **shared}


def palette_arrays(table: Table) -> tuple[np.ndarray, PaletteArrays]:
    """Return the flags of stored nodes, eight to a byte, and the numbers of a table of the layout "coded" or "sparse".

    Raises :class:`.TableError` if it is damaged.
    """
    arrays, settings = table.arrays, table.settings
    shared = arrays["palette"], arrays.get("environment")
    if settings["layout"] == "sparse":
        density, index = arrays["density"], arrays["index"].entries.astype(np.uint32)
        levels = density.entries[:, 0], settings.get("density_bits", SPARSE_BITS), (density.offset[0], density.scale[0])
        return stored_flags(table), PaletteArrays(*levels, index[:, 0] | index[:, 1] << 8, *shared)
    bits, colours, shape = settings["density_bits"], len(arrays["palette"].entries), tuple(settings["shape"])
    coding, most = (arrays[name].entries.tobytes() for name in ("probabilities", "nodes")), MOST_STORED
    if table.path is not None:  # as check_nodes allows
        left = allowed(Path(table.path).stat().st_size) - _grid_bytes(shape)
        most = min(most, max(0, left) // NODE_BYTES)
    try:
        flags, levels, index = decode_once(*coding, shape, 2**bits, colours, most)
    except ValueError as e:
        if isinstance(e, TooManyNodes):
            check_nodes(table, e.count)
        raise TableError(f"{table.path}: is damaged: {e}") from None
    range_ = settings["density_offset"], settings["density_scale"]
    return flags, PaletteArrays(levels, bits, range_, index, *shared)


@functools.lru_cache(maxsize=1)
def decode_once(probabilities: bytes, data: bytes, *sizes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flags of the stored nodes, eight to a byte, and their levels and indices; the last result is kept.

    Levels (uint8) and indices (uint16) have a first entry of 0 for no node. Raises ``ValueError`` as
    :func:`.coding.decode` does, for the same arguments.
    """
    coding = (np.frombuffer(part, np.uint8) for part in (probabilities, data))
    places, *numbers = decode(*coding, *sizes)
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
    # Bytes of a place while a file is decoded and its field built, and of the layers that are processed, both measured
    return int(0.55 * math.prod(shape) + 8 * (layer_count(shape) + 1) * math.prod(shape[1:]))


def grid_table(grid: NodeGrid, dtype=np.float16) -> Table:
    """Return the table of a grid, in half precision by default; the first entry stands for no node."""
    arrays, settings = stored_nodes(grid.nodes)
    arrays["density"] = StoredArray(np.clip(grid.density, -1e4, 1e4)[:, None].astype(dtype))
    arrays["colour"] = StoredArray(np.clip(grid.colour, -1e3, 1e3).astype(dtype))
    if grid.environment is not None:
        arrays["environment"] = StoredArray(np.clip(grid.environment[:, :3], -1e3, 1e3).astype(dtype))
        settings["colours"] = "reflections"
    return Table("field", arrays, settings={"layout": "grid", **settings})


def pairs_table(field: PairsField) -> Table:
    """Return the table of a field of the pairs of the supplement."""
    masks, settings = stored_nodes(field.nodes)
    arrays = {name: StoredArray.of(module.quantised(8)) for name, module in field.modules.items()}
    settings = {"layout": "pairs", "low": field.low, "high": field.high, **settings}
    return Table("field", {**masks, **arrays}, settings=settings)


def load(path) -> Table:
    """Read and check a table file of a radiance field. Raises :class:`.TableError`."""
    table = load_layout(path, "field", LAYOUTS)
    if "curve" in table.arrays:
        raise TableError(
            f"{path}: has a density curve, which this package no longer reads: make the file again with "
            f'"mi-diffind fit field FOLDER -o {Path(path).name}"'
        )
    check_numbers(table, "lower", 3)
    check_numbers(table, "spacing", 1, positive=True)
    check_numbers(table, "shape", 3, positive=True, whole=True)
    if fault := next(faults(table), ""):
        raise TableError(f"{path}: is damaged: {fault}")
    return table


def faults(table: Table) -> Iterator[str]:
    """Yield what is wrong with a table, one after the other: each check relies on those before it.

    Raises :class:`.TableError` for settings that are no numbers, for too much memory, and for damaged coded nodes.
    """
    arrays, settings = table.arrays, table.settings
    layout, shape, spacing = settings["layout"], settings["shape"], settings["spacing"]
    # The environment that the setting "colours" speaks of
    colours, environment = settings.get("colours", "directions"), arrays.get("environment")
    allowed = ("directions",) if layout == "pairs" else COLOURS
    if colours not in allowed:
        yield f"found the colours {colours!r}, allowed are {', '.join(allowed)}"
    numbers = arrays.get("colour", arrays.get("palette"))
    present = environment and environment.shape, numbers and numbers.shape[-1]
    expected = ((ENTRIES, 3), COLUMNS) if colours == "reflections" else (None, DIRECTIONS)
    if layout != "pairs" and present != expected:
        yield (
            f"found an environment of the shape {present[0]} and {present[1]} numbers of a colour, the colours "
            f'"{colours}" have {expected[0]} and {expected[1]}'
        )
    # A grid of an allowed size, whose nodes single precision tells apart
    lower = np.float64(settings["lower"])
    largest = max(np.abs(lower).max(), np.abs(lower + spacing * np.float64(shape)).max())
    if not SMALLEST < largest < LARGEST or spacing < np.spacing(np.float32(largest)):
        yield (
            f"found nodes at a distance of {spacing:g} from {settings['lower']} on, allowed are coordinates between "
            f"{SMALLEST:g} and {LARGEST:g} that single precision tells apart"
        )
    if "inner" in settings:
        check_numbers(table, "inner", 4)
        if (half := settings["inner"][3]) <= 0:
            yield f"found the half side {half} of the inner cube, allowed are those > 0"
    if min(shape) < 2 or math.prod(shape) > MOST_NODES:
        yield f"found a grid of {shape}, allowed are at most {MOST_NODES:,} nodes"
    check_nodes(table)
    for name in arrays if layout in ("coded", "sparse") else ("cells",):
        if (storage := arrays[name].storage) != "uint8":
            yield f'its array "{name}" is stored as {storage}, allowed is uint8'
    if layout == "coded":
        check_numbers(table, "density_scale", 1, positive=True)
        check_numbers(table, "density_offset", 1)
        bits, colours = settings.get("density_bits"), len(arrays["palette"].entries)
        if bits not in range(1, MOST_DENSITY_BITS + 1) or colours > 2**MOST_BITS:
            yield f"found {bits!r} bits of a density and {colours:,} colours"
        palette_arrays(table)
        return
    if len(arrays["cells"].entries) != -(-math.prod(shape) // 8):
        yield f'the array "cells" is not that of a grid of {shape}'
    if layout == "pairs":
        check_numbers(table, "low", 13)
        check_numbers(table, "high", 13)
        return
    nodes = sum(int(np.count_nonzero(part)) for part in layers(stored_flags(table), shape))
    check_nodes(table, nodes)
    for name in ("density", "index" if layout == "sparse" else "colour"):
        if (entries := len(arrays[name].entries)) != nodes + 1:
            yield f'the array "{name}" has {entries} entries, expected {nodes + 1}'
    if layout == "sparse":
        if (bits := settings.get("index_bits")) not in INDEX_BITS:
            yield f"found indices of {bits!r} bits, allowed are {INDEX_BITS}"
        last, palette = palette_arrays(table)[1].index.max(), len(arrays["palette"].entries)
        if last >= min(palette, 2**bits):
            yield f"found the index {last} in a palette of {palette} colours"
        if arrays["density"].entries.max() >= 2**SPARSE_BITS:
            yield f"found a density level that is not a number from 0 to {2**SPARSE_BITS - 1}"


def stored(table: Table, entries: dict, storage: str = "") -> Table:
    """Return a table with optimised ``entries``: ``density`` and ``colour`` of its nodes, or of its palette."""
    layout, arrays = table.settings["layout"], dict(table.arrays)
    if layout == "pairs":
        allocated = {name: table.arrays[name].allocate(type(values), "float32") for name, values in entries.items()}
        for name, array in allocated.items():
            array.data = entries[name]
        return restored(table, allocated, storage)
    if storage and not (layout == "grid" and storage != "uint8"):
        allowed = "float16 and float32" if layout == "grid" else "none: levels and a palette of bytes"
        raise ValueError(f'storage: found "{storage}", allowed of the layout {layout} are {allowed}')
    values, settings = {name: tensor.numpy() for name, tensor in entries.items()}, {"optimised": True}
    if "environment" in values:
        values["environment"] = values["environment"][:, :3]
    if layout == "grid":
        values["density"] = values["density"][:, None]
        for name, numbers in values.items():
            arrays[name] = StoredArray(numbers.astype(np.float32)).to(storage or arrays[name].storage)
    else:
        flags, numbers = palette_arrays(table)
        offset, scale = numbers.density_range
        levels = np.clip(np.rint((values["density"] - offset) / scale), 0, 2**numbers.density_bits - 1)
        shared = {"palette": to_bytes(values["colour"].reshape(-1, numbers.palette.shape[-1]))}
        if "environment" in values:
            shared["environment"] = to_bytes(values["environment"])
        numbers = replace(numbers, levels=levels.astype(np.uint8), **shared)
        arrays = coded_arrays(unpack_mask(flags, table.settings["shape"]), numbers)
        settings |= {"layout": "coded", "density_bits": numbers.density_bits}
        settings |= {"density_offset": offset, "density_scale": scale}
    return replace(table, arrays=arrays, settings={**table.settings, **settings}, measured={}, path=None)


def stored_flags(table: Table) -> np.ndarray:
    """Return the flags of stored nodes, eight to a byte."""
    return np.ascontiguousarray(table.arrays["cells"].entries[:, 0])


def read_nodes(table: Table, types, packed: bool = False, flags: np.ndarray | None = None) -> Nodes:
    """Return the nodes of a checked table, or those with ``flags``. Raises :class:`TableError` if there are none."""
    settings, flags = table.settings, stored_flags(table) if flags is None else flags
    if not flags.any():
        raise TableError(f"{table.path or 'the field'}: holds no nodes")
    stored = flags if packed else unpack_mask(flags, settings["shape"])
    place = settings["lower"], settings["spacing"], settings["shape"]
    return Nodes(types, *place, stored, packed, settings.get("inner"))


def grid_of(table: Table, types, packed: bool = False) -> NodeGrid:
    """Return the grid of a checked table of the layout "grid"."""
    density, colour = (table.arrays[name].values for name in ("density", "colour"))
    return NodeGrid(read_nodes(table, types, packed), density[:, 0], colour, read_environment(table))


def read_environment(table: Table) -> np.ndarray | None:
    """Return the environment of a table as :class:`.NodeField` takes it, or ``None``."""
    array = table.arrays.get("environment")
    return None if array is None else np.pad(array.values, ((0, 0), (0, 1)))


def field_of(table: Table, types, storage: str = "") -> VolumeField:
    """Return the field of a checked table.

    It is packed for rendering; with the ``storage`` ``"float32"``, its ``arrays`` can be trained instead.
    """
    settings, layout, arrays = table.settings, table.settings["layout"], table.arrays
    packed = storage != "float32"
    if layout == "grid":
        return grid_of(table, types, packed).field()
    if layout == "pairs":
        allocated = {name: arrays[name].allocate(types.TensorXf, storage) for name in PairsField.NAMES}
        pairs = (
            Indirection([allocated[f"{name}_primary"]], allocated[f"{name}_cascaded"]) for name in ("density", "colour")
        )
        return PairsField(read_nodes(table, types, packed), *pairs, settings["low"], settings["high"])
    flags, numbers = palette_arrays(table)
    nodes = read_nodes(table, types, packed, flags)
    if packed:
        return PackedPaletteField(nodes, numbers)
    density = byte_array(numbers.levels[:, None], numbers.density_range[1], numbers.density_range[0]).values[:, 0]
    tensors = NodeGrid(nodes, density, numbers.palette.values, read_environment(table)).tensors()
    return NodeField(nodes, **tensors, palette_index=device_array(types.UInt32, numbers.index.astype(np.uint32)))
