"""What a table file of task 6 holds, and the field that it becomes."""

from __future__ import annotations

import math

import numpy as np

from ...indirection import Indirection
from ...tables import StoredArray, Table, TableError, load_table
from . import codes
from .field import DistanceField
from .nodes import SparseNodes, decoded_nodes
from .paper import PairField
from .structure import ACTIVE, Structure, StructureError

#: Of the sparse layout: name of an array → number of its dimensions, and channels (bytes, but of entries).
SPARSE = {"regions": (3, 1), "region_masks": (1, 16), "blocks": (1, 13), "pointers": (1, 4), "entries": (1, 3)}

PAIR = {"primary": (3, 3), "cascaded": (3, 1)}


def _bytes(words: np.ndarray) -> StoredArray:
    """Words (n, k) as an array of bytes (n, 4k)."""
    raw = np.ascontiguousarray(words, "<u4").view(np.uint8).reshape(len(words), -1)
    return _raw(raw)


def _raw(raw: np.ndarray) -> StoredArray:
    channels = raw.shape[-1]
    return StoredArray(raw, (), (1.0,) * channels, (0.0,) * channels)


def sparse_arrays(structure: Structure, frames, pointers, entries) -> dict[str, StoredArray]:
    """The arrays of a sparse field: words of frames (B,) and pointers, and the entries (K, 3), float32."""
    signs = structure.block_signs[:, None]
    blocks = np.concatenate([_bytes(structure.block_masks).entries, signs, _bytes(frames[:, None]).entries], axis=1)
    masks = np.concatenate([structure.region_masks, structure.region_signs], axis=1)
    return {
        "regions": _raw(structure.regions[..., None]),
        "region_masks": _bytes(masks),
        "blocks": _raw(blocks),
        "pointers": _bytes(pointers[:, None]),
        "entries": StoredArray(np.ascontiguousarray(entries, np.float32)),
    }


def load(path) -> Table:
    """Read and check a file. Raises :class:`~mi_diffind.tables.TableError`."""
    table = load_table(path, "sdf")
    layout = table.settings.get("layout")
    shapes = {"sparse": SPARSE, "pair": PAIR}.get(layout)
    if shapes is None:
        raise TableError(f'{path}: has the layout {layout!r}, allowed are "sparse" and "pair"')
    for name, (dims, channels) in shapes.items():
        array = table.arrays.get(name)
        if array is None or len(array.shape) != dims + 1 or array.shape[-1] != channels:
            found = "is missing" if array is None else f"has the shape {array.shape}"
            raise TableError(
                f'{path}: the array "{name}" {found}, expected {dims} dimension(s) and {channels} channels'
            )
    numbers = {"lower": 3, "centre": 3} | ({"upper": 3} if layout == "pair" else {})
    singles = ["scale", "slope", *(("spacing", "bits", "nodes") if layout == "sparse" else ("band",))]
    for name, count in (numbers | dict.fromkeys(singles, 1)).items():
        value = table.settings.get(name)
        values = value if count > 1 else [value]
        good = isinstance(values, list) and len(values) == count
        good = good and all(isinstance(v, (int, float)) and math.isfinite(v) for v in values)
        if not good or (name in singles and values[0] <= 0):
            allowed = "a positive number" if name in singles else f"{count} finite numbers"
            raise TableError(f'{path}: its setting "{name}" is {value!r}, expected {allowed}')
    if layout == "sparse":
        structure_of(table)
    return table


def structure_of(table: Table) -> Structure:
    """The structure of a sparse field. Raises :class:`~mi_diffind.tables.TableError` if its masks are damaged."""
    settings = table.settings

    def words(raw):
        return np.ascontiguousarray(raw).view("<u4")

    blocks, masks = table.arrays["blocks"].entries, table.arrays["region_masks"].entries
    bits, nodes = settings["bits"], settings["nodes"]
    regions = table.arrays["regions"].entries[..., 0]
    active = int((regions == ACTIVE).sum())
    if active == 0:  # arrays of the file have an entry at least
        blocks, masks = blocks[:0], masks[:0]
    structure = Structure(
        tuple(settings["lower"]), float(settings["spacing"]), regions,
        words(masks[:, :8]), words(masks[:, 8:]), words(blocks[:, :8]), blocks[:, 8],
    )  # fmt: skip
    try:
        structure.check()
    except StructureError as e:
        raise TableError(f"{table.path}: is damaged: {e}") from None
    if bits not in codes.POINTERS or structure.nodes != nodes:
        raise TableError(f"{table.path}: is damaged: its masks say {structure.nodes} nodes, its settings {nodes}")
    count, entries = len(table.arrays["pointers"].entries), len(table.arrays["entries"].entries)
    if count != max(1, -(-nodes // codes.POINTERS[bits])):
        raise TableError(f"{table.path}: is damaged: {nodes} pointers of {bits} bits do not fit in {count} words")
    pointers = codes.pointers_of(words(table.arrays["pointers"].entries)[:, 0], bits, nodes)
    if nodes and pointers.max() >= entries:
        raise TableError(f"{table.path}: is damaged: a pointer names entry {pointers.max()} of {entries}")
    return structure


def field_of(table: Table, arrays: dict, types, storage: str = "") -> DistanceField:
    """
    The field of a checked table. ``arrays`` are those of a pair, allocated. With the ``storage`` ``"float32"``, the
    nodes of a sparse field are decoded: they can then be trained.
    """
    settings = table.settings
    if settings["layout"] == "pair":
        net = Indirection(arrays["primary"], arrays["cascaded"])
        return PairField(types, net, settings["lower"], settings["upper"], settings["band"], settings["slope"])
    structure = structure_of(table)

    def words(name, part=slice(None)):
        return np.ascontiguousarray(table.arrays[name].entries[:, part]).view("<u4")[:, 0]

    frames = words("blocks", slice(9, 13))[: structure.blocks]
    entries = table.arrays["entries"].values
    if storage == "float32":
        pointers = codes.pointers_of(words("pointers"), settings["bits"], structure.nodes)
        nodes = decoded_nodes(structure, frames, entries[pointers])
        return SparseNodes(types, structure, settings["slope"], nodes=types.TensorXf(nodes))
    return coded_field(types, structure, settings["slope"], frames, words("pointers"), settings["bits"], entries)


def coded_field(types, structure, slope, frames, pointer_words, bits, entries) -> SparseNodes:
    """A sparse field whose nodes are pointers into ``entries`` (K, 3)."""
    offset, step = codes.entry_scale(entries)
    return SparseNodes(
        types, structure, slope, frames=frames, pointers=pointer_words, bits=bits,
        entries=codes.entry_words(entries, offset, step), offset=offset, step=step,
    )  # fmt: skip
