"""What a table file of task 6 stands for."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from ...errors import UsageError
from ...task import Model
from .files import field_of

#: What meshes are decoded to: trimesh writes them.
MESHES = (".ply", ".obj", ".stl", ".off", ".glb")


class SdfModel(Model):
    """
    The signed distance field in a file: ``field`` (:class:`.field.Field`), in the unit frame. A point of the mesh's
    file is ``scale`` · p + ``centre``.
    """

    #: The storage form that was asked for, "" for the file's own.
    form = ""

    def __init__(self, table, arrays, dtype, form: str = ""):
        self.form = form
        super().__init__(table, arrays, dtype)

    def build(self):
        settings = self.table.settings
        self.field = field_of(self.table, self.arrays, self.types, self.form)
        self.scale, self.centre = float(settings["scale"]), tuple(settings["centre"])

    def copy(self):
        return type(self)(
            self.table, {name: array.copy() for name, array in self.arrays.items()}, self.dtype, self.form
        )

    @property
    def storage(self):
        return self.form or self.table.storage

    @property
    def nbytes(self):
        return self.memory_nbytes if self.table.settings["layout"] == "sparse" else super().nbytes

    @property
    def memory_nbytes(self):
        return self.field.nbytes if self.table.settings["layout"] == "sparse" else super().memory_nbytes

    def describe(self):
        settings, field = self.table.settings, self.field
        figures = {
            "layout": settings["layout"],
            "memory_bytes": self.memory_nbytes,
            "box": [list(field.lower), list(field.upper)],
            "spacing": field.spacing,
            "slope": field.slope,
            "scale": self.scale,
            "centre": list(self.centre),
        }
        size = " x ".join(f"{self.scale * (b - a):.4g}" for a, b in zip(field.lower, field.upper, strict=True))
        lines = [
            f"{self.memory_nbytes:,} bytes in memory, box of {size} units around {self.centre}",
            f"cells of 1/{1 / field.spacing:.0f} of the longest side, slope at most {field.slope:.2f}",
        ]
        if settings["layout"] == "sparse":
            structure = field.structure
            figures |= {"nodes": structure.nodes, "blocks": structure.blocks}
            bits = 8 * self.memory_nbytes / max(1, structure.nodes)
            lines.append(f"{structure.nodes:,} nodes in {structure.blocks:,} blocks, {bits:.1f} bits a node in all")
        return figures, lines

    def measure(self, mesh=None, count: int = 2**18):
        """Errors against the mesh in the file ``mesh`` (default: the one that was fitted, if it is where it was)."""
        from .distances import Distances
        from .evaluation import Evaluation
        from .mesh import load_mesh

        settings, folder = self.table.settings, (self.table.path or Path("x")).resolve().parent
        path = Path(mesh) if mesh is not None else folder / settings.get("mesh_path", "")
        if not path.is_file():
            self._refuse(f"was fitted to the mesh {path}, which is not there")
        loaded = load_mesh(path)
        if loaded.digest != settings.get("source"):
            self._refuse(f"was fitted to another mesh than {path} is now")
        with Distances(loaded) as distances:
            return Evaluation(loaded, distances, count).measure(self.field)

    def decode(self, output: Path, resolution: int | None = None):
        """The surface as triangles, or distances as a grid (``.npz``), ``resolution`` cells along the longest side."""
        from .decode import extract, grid

        resolution = resolution or min(1024, round(1.5 / self.field.spacing))
        suffix = output.suffix.lower()
        if suffix == ".npz":
            return [self._decode_grid(output, resolution, grid)]
        if suffix not in MESHES:
            allowed = ", ".join((*MESHES, ".npz"))
            raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are {allowed}')
        from ...files import replacing

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

    def _decode_grid(self, output: Path, resolution: int, grid):
        from ...files import replacing

        values, lower, upper = grid(self.field, resolution)

        def place(p):
            return np.asarray(p) * self.scale + np.array(self.centre)

        with replacing(output) as temporary, open(temporary, "wb") as stream:
            np.savez_compressed(
                stream, distance=values * np.float32(self.scale), lower=place(lower), upper=place(upper)
            )
        shape = " x ".join(map(str, values.shape))
        return output, f"{shape} distances (z, y, x) in units of the mesh"


MODEL = SdfModel
