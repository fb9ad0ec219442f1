"""Model of a radiance-field file: its field, what is measured of it, and its dense grid."""

from __future__ import annotations

import math
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...fitting.task import Model
from . import dense_bytes
from .files import field_of

#: Rays along each side of the box in counts of steps.
PIXELS = 96


class RadianceFieldModel(Model):
    """Radiance field of a file: ``field`` (:class:`.volume_field.VolumeField`), in the coordinates of its capture."""

    def build(self):
        self.field = field_of(self.table, self.types, self.form)

    @property
    def storage(self):
        return self.form or self.table.storage

    @property
    def nbytes(self):
        """Bytes in memory, including the index of the nodes."""
        return self.memory_nbytes

    @property
    def memory_nbytes(self):
        nbytes = getattr(self.field, "nbytes", None)
        if nbytes is not None:
            return nbytes
        return self.field.nodes.nbytes + sum(4 * math.prod(a.shape) for a in self.field.arrays.values())

    def describe(self):
        field, settings = self.field, self.table.settings
        file_bytes = self.table.path.stat().st_size if self.table.path is not None else None
        counts, dense = self.counts(), dense_bytes(settings["shape"])
        figures = {
            "layout": settings["layout"],
            "memory_bytes": self.memory_nbytes,
            "file_bytes": file_bytes,
            "dense_bytes": dense,
            "box": [list(field.lower), list(field.upper)],
            "surroundings": field.unbounded,
            "voxel": field.voxel,
            "shape": list(settings["shape"]),
            "nodes": field.nodes.count,
            **counts,
        }
        shape = " x ".join(map(str, settings["shape"]))
        share = 100 * field.nodes.count / math.prod(settings["shape"])
        lines = [
            f"{self.memory_nbytes:,} bytes in memory, {dense / self.memory_nbytes:.0f} times less than the "
            f"dense grid of float32",
            f"{field.nodes.count:,} of {shape} nodes ({share:.0f}%), voxels of {field.voxel:.4g}",
        ]
        if field.unbounded:
            side = field.upper[0] - field.lower[0]
            lines.append(f"with surroundings: voxels grow outside of a cube with the side {side:.4g}")
        if file_bytes:
            lines.append(f"{file_bytes:,} bytes on disk, {dense / file_bytes:.0f} times less")
        steps, looks = max(1, counts["steps"]), max(1, counts["looks"])
        skipped, hidden = (100 * counts[name] / steps for name in ("skipped", "hidden"))
        lines.append(
            f"of {steps / counts['crossing']:.0f} steps of a ray through the box, {skipped:.1f}% are skipped as empty "
            f"and {hidden:.1f}% lie behind an opaque part; of {looks / counts['crossing']:.1f} that read the density, "
            f"{100 * (1 - counts['colours'] / looks):.0f}% read no colour"
        )
        return figures, lines

    def entries(self) -> dict:
        return {name: values for name, values in self.field.arrays.items() if dr.is_float_v(values)}

    def counts(self) -> dict[str, int]:
        """Return the counts (:func:`.march.count`) of parallel rays along the axes, in both directions."""
        from .march import count

        lower, upper = np.array(self.field.lower), np.array(self.field.upper)
        u = (np.arange(PIXELS) + 0.5) / PIXELS
        place = np.stack(np.meshgrid(u, u, [-1.0], indexing="ij"), axis=-1).reshape(-1, 3)
        origins, directions = [], []
        for axis in range(3):
            for sign in (1, -1):
                at = np.roll(place * [1, 1, 1] if sign > 0 else place * [1, 1, -2], axis + 1, axis=1)
                origins.append(lower + at * (upper - lower))
                directions.append(np.broadcast_to(sign * np.eye(3)[axis], at.shape))
        o, d = (
            self.types.Array3f(*(device_array(self.types.Float, x) for x in np.concatenate(v).T))
            for v in (origins, directions)
        )
        return count(self.field, o, d, 0, np.inf)

    def measure(self, capture=None):
        """Return PSNR and SSIM of the test views of a capture.

        ``capture`` is its folder; by default, that of the capture that was fitted, if it still exists.
        """
        return self._test_views(capture).evaluate(self.field, ssim=True)

    def render_views(self, capture=None, count: int | None = None) -> list[np.ndarray]:
        """Return pictures of the field from the test views of a capture (default: that which was fitted).

        They are the first ``count`` (default: all), ``(height, width, 4)``: linear colours multiplied by alpha, and
        alpha.
        """
        images = self._test_views(capture)
        return [images.render(self.field, i) for i in range(min(count or len(images.views), len(images.views)))]

    def _test_views(self, capture):
        """Return the test views of a capture. Raises :class:`.TableError` if it is not there."""
        from .session import ViewImages, load_held_out

        folder = (self.table.path or Path("x")).resolve().parent
        path = Path(capture) if capture is not None else folder / self.table.settings.get("capture_path", "")
        if (capture is None and not self.table.settings.get("capture_path")) or not path.is_dir():
            self._refuse(f"was fitted to the capture {path}, which is not there")
        settings = self.table.settings
        reading = {"background": settings.get("background", "scene"), "downscale": settings.get("downscale")}
        return ViewImages(self.types, load_held_out(path, **reading)[0])

    def decode(self, output: Path, resolution: int | None = None):
        """Write density and colour on a dense grid (:mod:`.decode`)."""
        from .decode import decode

        return decode(self.field, Path(output), resolution)


MODEL = RadianceFieldModel
