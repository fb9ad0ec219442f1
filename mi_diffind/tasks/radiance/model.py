"""What a table file of task 7 stands for."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ...task import Model
from .files import field_of
from .presets import dense_bytes

#: Rays along each side of the box in which what they leave out is counted.
PIXELS = 96


class FieldModel(Model):
    """The radiance field in a file: ``field`` (:class:`.field.VolumeField`), in the coordinates of its capture."""

    #: The storage form that was asked for, "" for the file's own.
    form = ""

    def __init__(self, table, arrays, dtype, form: str = ""):
        self.form = form
        super().__init__(table, arrays, dtype)

    def build(self):
        self.field = field_of(self.table, self.types, self.form)

    def copy(self):
        return type(self)(self.table, {}, self.dtype, self.form)

    @property
    def storage(self):
        return self.form or self.table.storage

    @property
    def nbytes(self):
        """Bytes in memory, with the index of the nodes."""
        return self.memory_nbytes

    @property
    def memory_nbytes(self):
        own = getattr(self.field, "nbytes", None)
        if own is not None:
            return own
        return self.field.nodes.nbytes + sum(4 * math.prod(a.shape) for a in self.field.arrays.values())

    @property
    def dense_nbytes(self) -> int:
        """Bytes of a grid of thirteen float32 numbers at every node of the box: what ratios refer to."""
        return dense_bytes(self.table.settings["shape"])

    def describe(self):
        field, settings = self.field, self.table.settings
        file_bytes = self.table.path.stat().st_size if self.table.path is not None else None
        counts = self.counts()
        figures = {
            "layout": settings["layout"],
            "memory_bytes": self.memory_nbytes,
            "file_bytes": file_bytes,
            "dense_bytes": self.dense_nbytes,
            "box": [list(field.lower), list(field.upper)],
            "voxel": field.voxel,
            "shape": list(settings["shape"]),
            "nodes": field.nodes.count,
            **counts,
        }
        shape = " x ".join(map(str, settings["shape"]))
        share = 100 * field.nodes.count / math.prod(settings["shape"])
        lines = [
            f"{self.memory_nbytes:,} bytes in memory, {self.dense_nbytes / self.memory_nbytes:.0f} times less than the "
            f"dense grid of float32",
            f"{field.nodes.count:,} of {shape} nodes ({share:.0f}%), voxels of {field.voxel:.4g}",
        ]
        if file_bytes:
            lines.append(f"{file_bytes:,} bytes on disk, {self.dense_nbytes / file_bytes:.0f} times less")
        steps, looks = max(1, counts["steps"]), max(1, counts["looks"])
        skipped, hidden = (100 * counts[name] / steps for name in ("skipped", "hidden"))
        lines.append(
            f"of {steps / counts['crossing']:.0f} steps of a ray through the box, {skipped:.1f}% are skipped as empty "
            f"and {hidden:.1f}% lie behind what is opaque; of {looks / counts['crossing']:.1f} that are looked at, "
            f"{100 * (1 - counts['colours'] / looks):.0f}% read no colour"
        )
        return figures, lines

    def counts(self) -> dict[str, int]:
        """What rays leave out (:class:`.counting.Counts`): parallel ones, along the axes, in both directions."""
        from .counting import count

        lower, upper = np.array(self.field.lower), np.array(self.field.upper)
        u = (np.arange(PIXELS) + 0.5) / PIXELS
        place = np.stack(np.meshgrid(u, u, [-1.0], indexing="ij"), axis=-1).reshape(-1, 3)
        origins, directions = [], []
        for axis in range(3):
            for sign in (1, -1):
                at = np.roll(place * [1, 1, 1] if sign > 0 else place * [1, 1, -2], axis + 1, axis=1)
                origins.append(lower + at * (upper - lower))
                directions.append(np.broadcast_to(sign * np.eye(3)[axis], at.shape))
        o, d = (self.types.Array3f(np.float32(np.concatenate(v).T)) for v in (origins, directions))
        return count(self.field, o, d, 0, np.inf).asdict()

    def measure(self, capture=None):
        """
        PSNR of the test views of the capture in the folder ``capture`` (default: the one that was fitted, if it is
        where it was).
        """
        from .fit import held_views
        from .training import Images, evaluate

        folder = (self.table.path or Path("x")).resolve().parent
        path = Path(capture) if capture is not None else folder / self.table.settings.get("capture_path", "")
        if (capture is None and not self.table.settings.get("capture_path")) or not path.is_dir():
            self._refuse(f"was fitted to the capture {path}, which is not there")
        return evaluate(self.field, Images(self.types, held_views(path)[0]))

    def decode(self, output: Path, resolution: int | None = None):
        """Density and colour on a dense grid (:mod:`.decode`)."""
        from .decode import decode

        return decode(self.field, output, resolution)


MODEL = FieldModel
