"""Table files of distance fields: their arrays, the fields that they become, and what users do with them."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...arrays.indirection import Indirection, device_tensor
from ...arrays.sparse_grid import ACTIVE, SparseGrid, SparseGridError
from ...arrays.tables import (  # fmt: skip
    StoredArray,
    Table,
    TableError,
    byte_array,
    check_allowance,
    check_numbers,
    load_layout,
    restored,
)
from ...core.compat import backend_module
from ...core.errors import UsageError, raised_as
from ...core.files import replacing
from ...core.units import check_memory
from ...fitting.task import Model
from .encoding import NodeCoding
from .field import DistanceField
from .nodes import POINTERS, SparseNodes, decode_to_array, pointer_words, unpack_pointers
from .paper import PairField

#: Arrays of each layout: name → number of dimensions, and channels (bytes in the sparse layout, except for entries).
LAYOUTS = {
    "sparse": {"regions": (3, 1), "region_masks": (1, 16), "blocks": (1, 13), "pointers": (1, 4), "entries": (1, 3)},
    "pair": {"primary": (3, 3), "cascaded": (3, 1)},
}

#: Bytes of memory for each cell of a side's square while a surface is extracted, roughly.
TRIANGLES = 128

#: Bytes of memory for each region while a sparse field and its index for rays are built, measured.
REGION_BYTES = 300

#: Bytes of memory for each block meanwhile.
BLOCK_BYTES = 400

#: Bytes of memory for each node meanwhile.
NODE_BYTES = 28

#: Coordinates of a box are smaller.
LARGEST = 1e9

#: Extensions of the mesh formats that ``decode`` writes, through trimesh.
MESHES = (".ply", ".obj", ".stl", ".off", ".glb")


def _word_bytes(words: np.ndarray) -> np.ndarray:
    """Return words (n, k) as bytes (n, 4k)."""
    return np.ascontiguousarray(words, "<u4").view(np.uint8).reshape(len(words), -1)


def coded_arrays(coding: NodeCoding) -> tuple[dict[str, StoredArray], dict]:
    """Return the arrays of a file for the codes of a grid's nodes, and the settings that go with them."""
    grid, bits = coding.sampled.structure, coding.sampled.bits
    blocks = [_word_bytes(grid.block_masks), grid.block_signs[:, None], _word_bytes(coding.frames[:, None])]
    arrays = {
        "regions": byte_array(grid.regions[..., None]),
        "region_masks": byte_array(_word_bytes(np.concatenate([grid.region_masks, grid.region_signs], axis=1))),
        "blocks": byte_array(np.concatenate(blocks, axis=1)),
        "pointers": byte_array(_word_bytes(pointer_words(coding.pointers, bits)[:, None])),
        "entries": StoredArray(np.ascontiguousarray(coding.entries, np.float32)),
    }
    settings = {
        "layout": "sparse", "lower": list(grid.lower), "spacing": grid.spacing, "bits": bits, "nodes": grid.nodes,
        "slope": coding.slope,
    }  # fmt: skip
    return arrays, settings


def load(path) -> Table:
    """Read and check a file. Raises :class:`.TableError`."""
    table = load_layout(path, "sdf", LAYOUTS)
    sparse = table.settings["layout"] == "sparse"
    for name in ("lower", "centre", *(() if sparse else ("upper",))):
        check_numbers(table, name, 3)
    for name in ("scale", "slope", *(("spacing", "bits", "nodes") if sparse else ("band",))):
        check_numbers(table, name, 1, positive=True)
    if sparse:
        check_numbers(table, "nodes", 1, positive=True, whole=True)
        regions, blocks = table.arrays["regions"].entries.size, len(table.arrays["blocks"].entries)
        nbytes = REGION_BYTES * regions + BLOCK_BYTES * blocks + NODE_BYTES * table.settings["nodes"]
        check_allowance(table, nbytes, f"a field of {regions:,} regions and {blocks:,} blocks")
        read_grid(table)
    else:
        check_pair(table)
    return table


def check_pair(table: Table) -> None:
    """Raise :class:`.TableError` unless the box of two arrays has a volume, and cells."""
    sides = table.arrays["primary"].shape[:-1]
    if min(sides) < 2:
        raise TableError(
            f'{table.path}: its array "primary" has the shape {sides}, allowed are 2 or more along each axis'
        )
    lower, upper = (np.array(table.settings[name], np.float32) for name in ("lower", "upper"))
    largest = max(np.abs(lower).max(), np.abs(upper).max())
    if not (largest < LARGEST and ((upper - lower) / sides > np.spacing(largest)).all()):
        raise TableError(
            f"{table.path}: is damaged: found the box from {table.settings['lower']} to {table.settings['upper']}, "
            f"allowed are boxes with a volume that single precision can divide into {sides} entries"
        )


def _words(table: Table, name: str, part=slice(None)) -> np.ndarray:
    """Return the bytes of an array's channels ``part`` as words, (n, k)."""
    return np.ascontiguousarray(table.arrays[name].entries[:, part]).view("<u4")


def read_grid(table: Table) -> SparseGrid:
    """Return the structure of a sparse field. Raises :class:`.TableError` if it is damaged."""
    settings = table.settings
    bits, nodes = settings["bits"], settings["nodes"]
    regions = table.arrays["regions"].entries[..., 0]
    # Arrays of a file have at least one entry, even if no region has nodes
    some = slice(None) if (regions == ACTIVE).any() else slice(0)
    masks, blocks = _words(table, "region_masks")[some], _words(table, "blocks", slice(8))[some]
    signs = table.arrays["blocks"].entries[some, 8]
    structure = SparseGrid(
        tuple(settings["lower"]), float(settings["spacing"]), regions, masks[:, :2], masks[:, 2:], blocks, signs
    )
    with raised_as(TableError, SparseGridError, at=f"{table.path}: is damaged"):
        structure.check()
    if bits not in POINTERS or structure.nodes != nodes:
        raise TableError(f"{table.path}: is damaged: its masks have {structure.nodes} nodes, its settings {nodes}")
    words, entries = _words(table, "pointers")[:, 0], len(table.arrays["entries"].entries)
    if len(words) != max(1, -(-nodes // POINTERS[bits])):
        raise TableError(f"{table.path}: is damaged: {nodes} pointers of {bits} bits do not fit in {len(words)} words")
    pointers = unpack_pointers(words, bits, nodes)
    if nodes and pointers.max() >= entries:
        raise TableError(f"{table.path}: is damaged: a pointer names entry {pointers.max()} of {entries}")
    return structure


def build_field(table: Table, arrays: dict, types, storage: str = "") -> DistanceField:
    """Return the field of a checked table.

    ``arrays`` are the allocated arrays of a pair. With the ``storage`` ``"float32"``, the nodes of a sparse field are
    decoded, and can be trained.
    """
    settings = table.settings
    if settings["layout"] == "pair":
        net = Indirection(arrays["primary"], arrays["cascaded"])
        return PairField(types, net, settings["lower"], settings["upper"], settings["band"], settings["slope"])
    structure = read_grid(table)
    frames, words = _words(table, "blocks", slice(9, 13))[: structure.blocks, 0], _words(table, "pointers")[:, 0]
    entries = table.arrays["entries"].values
    if storage == "float32":
        pointers = unpack_pointers(words, settings["bits"], structure.nodes)
        nodes = decode_to_array(structure, frames, entries, pointers)
        return SparseNodes(types, structure, settings["slope"], nodes=device_tensor(types.TensorXf, nodes))
    codes = {"frames": frames, "pointers": words, "bits": settings["bits"], "entries": entries}
    return SparseNodes(types, structure, settings["slope"], **codes)


def stored(table: Table, entries: dict, storage: str = "") -> Table:
    """Return a table with optimised entries: the ``nodes`` (n, 4) of a sparse field, encoded again, or the pair's."""
    if "nodes" not in entries:
        return restored(table, entries, storage)
    from .encoding import encode_again

    if storage not in ("", "uint8"):
        raise ValueError(f'storage: found "{storage}", allowed is uint8: the nodes of a sparse field are coded')
    values = entries["nodes"].numpy().astype(np.float64)
    values[:, 1:] /= np.maximum(np.linalg.norm(values[:, 1:], axis=1, keepdims=True), 1e-9)
    before = build_field(table, {}, backend_module(entries["nodes"]), "float32").nodes.numpy().astype(np.float64)
    arrays, settings = coded_arrays(encode_again(read_grid(table), before, values, table.settings["bits"], table.seed))
    settings = {**table.settings, **settings, "optimised": True}
    return replace(table, arrays=arrays, settings=settings, measured={}, path=None)


class SdfModel(Model):
    """Distance field of a file: ``field`` (:class:`.field.DistanceField`), in the unit frame.

    A point of the mesh's file is ``scale`` · p + ``centre``.
    """

    def build(self):
        settings = self.table.settings
        self.sparse = settings["layout"] == "sparse"
        self.field = build_field(self.table, self.arrays, self.types, self.form)
        self.scale, self.centre = float(settings["scale"]), tuple(settings["centre"])

    @property
    def storage(self):
        return self.form or self.table.storage

    @property
    def nbytes(self):
        return self.field.nbytes if self.sparse else super().nbytes

    @property
    def memory_nbytes(self):
        return self.field.nbytes if self.sparse else super().memory_nbytes

    def describe(self):
        field = self.field
        figures = {
            "layout": self.table.settings["layout"],
            "memory_bytes": self.memory_nbytes,
            "box": [list(field.lower), list(field.upper)],
            "spacing": field.spacing,
            "slope": field.slope,
            "scale": self.scale,
            "centre": list(self.centre),
        }
        size = " x ".join(f"{self.scale * (b - a):.4g}" for a, b in zip(field.lower, field.upper, strict=True))
        centre = ", ".join(f"{x:.4g}" for x in self.centre)
        lines = [
            f"{self.memory_nbytes:,} bytes in memory, box of {size} units around ({centre})",
            f"cells of 1/{1 / field.spacing:.0f} of the longest side, slope at most {field.slope:.2f}",
        ]
        if self.sparse:
            structure = field.structure
            figures |= {"nodes": structure.nodes, "blocks": structure.blocks}
            bits = 8 * self.memory_nbytes / max(1, structure.nodes)
            lines.append(f"{structure.nodes:,} nodes in {structure.blocks:,} blocks, {bits:.1f} bits a node in all")
        return figures, lines

    def entries(self) -> dict:
        nodes = getattr(self.field, "nodes", None)
        return super().entries() if nodes is None else {"nodes": nodes}

    def measure(self, mesh=None, count: int = 2**18):
        """Return errors against a ``mesh``, by default that of the file that was fitted.

        ``mesh`` is a file or a mesh in memory, as :func:`.mesh.load_mesh` takes them. ``count`` is the
        number of held-out points.
        """
        from .distances import Distances
        from .evaluation import SurfaceEvaluation
        from .mesh import load_mesh, split_part

        settings, folder = self.table.settings, (self.table.path or Path("x")).resolve().parent
        if mesh is None and not settings.get("mesh_path"):
            self._refuse("was fitted to a mesh in memory, which is not in the file: measure(mesh)")
        path = folder / settings["mesh_path"] if mesh is None else mesh
        if isinstance(path, (str, os.PathLike)) and not split_part(path)[0].is_file():
            self._refuse(f"was fitted to the mesh {path}, which is not there")
        loaded = load_mesh(path)
        if loaded.digest != settings.get("source"):
            self._refuse(f"was fitted to another mesh than {loaded.path} is now")
        with Distances(loaded) as distances:
            return SurfaceEvaluation(loaded, distances, count).measure(self.field)

    def decode(self, output: str | os.PathLike | None = None, resolution: int | None = None):
        """Write the surface as triangles, or distances as a grid (``.npz``); without an ``output``, return the mesh.

        ``resolution`` is the number of cells along the longest side, by default finer than the field's cells.
        """
        from .grids import extract, grid

        resolution = resolution or min(1024, round(1.5 / self.field.spacing))
        check_memory("resolution", resolution, TRIANGLES * resolution**2)
        if output is None:
            return extract(self.field, resolution, self.scale, self.centre)
        output = Path(output)
        suffix = output.suffix.lower()
        if suffix == ".npz":
            values, lower, upper = grid(self.field, resolution)
            lower, upper = (p * self.scale + np.array(self.centre) for p in (lower, upper))
            with replacing(output) as temporary, open(temporary, "wb") as stream:
                np.savez_compressed(stream, distance=values * np.float32(self.scale), lower=lower, upper=upper)
            return [(output, f"{' x '.join(map(str, values.shape))} distances (z, y, x) in units of the mesh")]
        if suffix not in MESHES:
            allowed = ", ".join((*MESHES, ".npz"))
            raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are {allowed}')
        start = time.perf_counter()
        mesh = extract(self.field, resolution, self.scale, self.centre)
        if len(mesh.faces) == 0:
            raise UsageError(f"{self.table.path}: there is nothing inside at {resolution} cells along the longest side")
        with replacing(output) as temporary:
            mesh.export(temporary)
        seconds = time.perf_counter() - start
        return [
            (output, f"{len(mesh.faces):,} triangles at {resolution} cells along the longest side, {seconds:.1f} s")
        ]


MODEL = SdfModel
