"""What a table file of task 7 holds, and the field that it becomes."""

from __future__ import annotations

import math

import numpy as np

from ...indirection import Indirection
from ...tables import StoredArray, Table, TableError, load_table
from .coded import CodedField
from .compression import CODE_BITS, SHARE_BITS, packed_field
from .field import GridField, VolumeField
from .nodes import Nodes
from .paper import PairsField

#: Layout → name of an array → number of its dimensions, and channels.
LAYOUTS = {
    "sparse": {"cells": (1, 1), "shares": (1, 1), "codes": (1, 2), "curve": (1, 1), "palette": (1, 12)},
    "grid": {"cells": (1, 1), "density": (1, 1), "colour": (1, 12)},
    "pairs": {
        "cells": (1, 1), "density_primary": (3, 3), "density_cascaded": (3, 1), "colour_primary": (3, 3),
        "colour_cascaded": (3, 12),
    },
}  # fmt: skip

#: Most nodes of a grid, stored or not.
MOST_NODES = 2**28


def raw(codes: np.ndarray) -> StoredArray:
    """Bytes that stand for themselves, ``(n, c)``."""
    channels = codes.shape[-1]
    return StoredArray(np.ascontiguousarray(codes, np.uint8), (), (1.0,) * channels, (0.0,) * channels)


def stored_nodes(nodes: Nodes) -> tuple[dict[str, StoredArray], dict]:
    """The array of a file that says which nodes are stored, and its settings."""
    bits = np.packbits(nodes.stored.reshape(-1))
    settings = {"lower": list(nodes.lower), "spacing": nodes.spacing, "shape": list(nodes.shape)}
    return {"cells": raw(bits[:, None])}, settings


def palette_table(nodes: Nodes, stored: dict, code_bits: int) -> Table:
    """The table of :meth:`.compression.PaletteProblem.stored`."""
    arrays, settings = stored_nodes(nodes)
    codes = stored["codes"].astype(np.uint32)
    arrays["shares"] = raw(stored["shares"][:, None])
    arrays["codes"] = raw(np.stack([codes & 255, codes >> 8], axis=1))
    arrays["curve"] = StoredArray(np.ascontiguousarray(stored["curve"][:, None], np.float32))
    arrays["palette"] = StoredArray(stored["palette"], (), tuple(stored["scale"]), tuple(stored["offset"]))
    return Table("field", arrays, settings={"layout": "sparse", "code_bits": code_bits, **settings})


def grid_table(nodes: Nodes, density: np.ndarray, colour: np.ndarray, dtype=np.float16) -> Table:
    """The table of a grid, in half precision by default; the first entry stands for no node."""
    arrays, settings = stored_nodes(nodes)
    arrays["density"] = StoredArray(np.clip(density, -1e4, 1e4)[:, None].astype(dtype))
    arrays["colour"] = StoredArray(np.clip(colour, -1e3, 1e3).astype(dtype))
    return Table("field", arrays, settings={"layout": "grid", **settings})


def pairs_table(nodes: Nodes, arrays: dict, low, high) -> Table:
    """The table of the supplement's pairs: :class:`~mi_diffind.tables.StoredArray` by name."""
    masks, settings = stored_nodes(nodes)
    ranges = {"low": [float(v) for v in low], "high": [float(v) for v in high]}
    return Table("field", {**masks, **arrays}, settings={"layout": "pairs", **ranges, **settings})


def load(path) -> Table:
    """Read and check a file. Raises :class:`~mi_diffind.tables.TableError`."""
    table = load_table(path, "field")
    layout = table.settings.get("layout")
    if not isinstance(layout, str) or layout not in LAYOUTS:
        raise TableError(f"{path}: has the layout {layout!r}, allowed are {', '.join(LAYOUTS)}")
    for name, (dims, channels) in LAYOUTS[layout].items():
        array = table.arrays.get(name)
        if array is None or len(array.shape) != dims + 1 or array.shape[-1] != channels:
            found = "is missing" if array is None else f"has the shape {array.shape}"
            raise TableError(
                f'{path}: the array "{name}" {found}, expected {dims} dimension(s) and {channels} channel(s)'
            )
    for name, count, whole in (("lower", 3, False), ("spacing", 1, False), ("shape", 3, True)):
        _numbers(table, name, count, whole, positive=name != "lower")
    shape = table.settings["shape"]
    if min(shape) < 2 or math.prod(shape) > MOST_NODES:
        raise TableError(f"{path}: is damaged: found a grid of {shape}, allowed are 2 to {MOST_NODES:,} nodes in all")
    if len(table.arrays["cells"].entries) != -(-math.prod(shape) // 8):
        raise TableError(f"{path}: is damaged: its masks are not those of a grid of {shape}")
    if layout == "pairs":
        for name in ("low", "high"):
            _numbers(table, name, 13, False, False)
        return table
    entries = int(np.count_nonzero(stored_of(table))) + 1
    names = ("shares", "codes") if layout == "sparse" else ("density", "colour")
    for name in names:
        if len(table.arrays[name].entries) != entries:
            found = len(table.arrays[name].entries) - 1
            raise TableError(f'{path}: is damaged: its masks say {entries - 1} nodes, the array "{name}" has {found}')
    if layout == "sparse":
        bits = table.settings.get("code_bits")
        if bits not in CODE_BITS:
            raise TableError(f"{path}: is damaged: found indices of {bits!r} bits, allowed are {CODE_BITS}")
        codes, palette = codes_of(table), len(table.arrays["palette"].entries)
        if codes.max() >= min(palette, 2**bits):
            raise TableError(f"{path}: is damaged: an index names colour {codes.max()} of {palette}")
        if len(table.arrays["curve"].entries) != 2**SHARE_BITS or table.arrays["shares"].entries.max() >= 2**SHARE_BITS:
            raise TableError(f"{path}: is damaged: its curve or coordinates in it are not of {SHARE_BITS} bits")
    return table


def _numbers(table: Table, name: str, count: int, whole: bool, positive: bool) -> None:
    value = table.settings.get(name)
    values = [value] if count == 1 else value
    kinds = (int,) if whole else (int, float)
    good = isinstance(values, list) and len(values) == count
    good = good and all(isinstance(v, kinds) and math.isfinite(v) and (v > 0 or not positive) for v in values)
    if not good:
        kind = "whole number" if whole else "number"
        allowed = f"{count} {'positive ' if positive else 'finite '}{kind}{'s' if count > 1 else ''}"
        raise TableError(f'{table.path}: its setting "{name}" is {value!r}, expected {allowed}')


def stored_of(table: Table) -> np.ndarray:
    """Which nodes are stored, ``shape`` bool."""
    shape = table.settings["shape"]
    bits = np.unpackbits(np.ascontiguousarray(table.arrays["cells"].entries[:, 0]), count=math.prod(shape))
    return bits.reshape(shape).astype(bool)


def codes_of(table: Table) -> np.ndarray:
    """Indices in the palette, uint32."""
    low, high = table.arrays["codes"].entries.astype(np.uint32).T
    return low | (high << 8)


def field_of(table: Table, types, storage: str = "") -> VolumeField:
    """
    The field of a checked table: packed for rendering, or, with the ``storage`` ``"float32"``, with ``arrays`` that can
    be trained.
    """
    settings, layout, arrays = table.settings, table.settings["layout"], table.arrays
    floats = storage == "float32"
    nodes = Nodes(types, settings["lower"], settings["spacing"], settings["shape"], stored_of(table), packed=not floats)
    tensor = types.TensorXf
    if layout == "grid":
        return GridField(nodes, tensor(arrays["density"].values[:, 0]), tensor(arrays["colour"].values))
    if layout == "pairs":
        made = {name: arrays[name].allocate(tensor, storage) for name in PairsField.NAMES}
        density, colour = (
            Indirection([made[f"{kind}_primary"]], made[f"{kind}_cascaded"]) for kind in ("density", "colour")
        )
        return PairsField(nodes, density, colour, settings["low"], settings["high"])
    palette, shares, curve = arrays["palette"], arrays["shares"].entries[:, 0], arrays["curve"].entries[:, 0]
    if floats:
        share = tensor(shares.astype(np.float32) / (2**SHARE_BITS - 1))
        return CodedField(nodes, share, tensor(curve), types.UInt32(codes_of(table)), tensor(palette.values))
    stored = {
        "shares": shares, "curve": curve, "codes": codes_of(table), "palette": palette.entries, "scale": palette.scale,
        "offset": palette.offset,
    }  # fmt: skip
    return packed_field(nodes, stored, settings["code_bits"])
