"""Model of a radiance-field file: its field, what is measured of it, and its dense grid in ordinary formats.

The dense grid is a NumPy archive, or an OpenVDB file that Blender and others read. The Python package index has no
OpenVDB (``openvdb`` comes with conda-forge, Debian's ``python3-openvdb`` and Blender's Python), so the module is used
where it is installed and is not required.
"""

import importlib
import math
from pathlib import Path

import drjit as dr
import numpy as np
from scipy.ndimage import distance_transform_edt

from ...arrays.indirection import device_array
from ...core.errors import UsageError
from ...core.files import replacing
from ...fitting.task import Model
from . import dense_bytes
from .files import field_of
from .volume_field import VolumeField

#: Points at which a field is evaluated at once.
CHUNK = 2**20

#: Most nodes along the longest side of a decoded grid.
MAX_RESOLUTION = 512

#: Offset, in voxels, at which a node is sampled from inside each adjacent cell.
WITHIN = 1e-3

#: Names of the OpenVDB module, newest first.
MODULES = ("openvdb", "pyopenvdb")


def dense_grid(field: VolumeField, resolution: int | None = None) -> dict[str, np.ndarray]:
    """Return a field sampled at the nodes ``lower + voxel · (i, j, k)`` of a dense grid, as float32 arrays by name.

    ``density`` ``(X, Y, Z)`` is per unit of length. ``colour`` ``(X, Y, Z, 12)`` holds numbers a and b for each of red,
    green and blue: the radiance in direction d is exp(a + b·d) (:func:`.volume_field.colour_of`). ``lower`` is
    ``(3,)``, ``voxel`` ``()``. The grid has ``resolution`` nodes along the longest side; by
    default, its voxels are those of the field.

    If the radiance of a field is not such an exponential, the mean of the logarithms of opposite directions is kept
    along the axes. Empty nodes get the colour of the nearest node that is not empty. A sparse field ends at the faces
    of its occupied cells, a dense grid fades out over the next cell: a grid twice as fine is closer to the field.
    Raises :class:`.UsageError` for a resolution outside of 2 … 512.
    """
    lower, extent = np.array(field.lower), np.array(field.upper) - np.array(field.lower)
    if resolution is None:
        voxel = field.voxel
        resolution = int(np.ceil(extent.max() / voxel - 1e-6)) + 1
    elif resolution >= 2:
        voxel = float(extent.max() / (resolution - 1))
    if not 2 <= resolution <= MAX_RESOLUTION:
        raise UsageError(f"resolution: found {resolution}, allowed are 2 to {MAX_RESOLUTION} nodes along a side")
    shape = tuple(np.ceil(extent / voxel - 1e-6).astype(int) + 1)
    density, colour = np.empty(np.prod(shape), np.float32), np.empty((np.prod(shape), 12), np.float32)
    with dr.suspend_grad():
        for start in range(0, len(density), CHUNK):
            last = min(start + CHUNK, len(density))
            density[start:last], colour[start:last] = _nodes(field, lower, voxel, shape, start, last)
    density, colour = density.reshape(shape), colour.reshape(*shape, 12)
    something = density * voxel > 1e-3  # optical depth of a voxel
    if something.any():
        nearest = distance_transform_edt(~something, return_distances=False, return_indices=True)
        colour = colour[tuple(nearest)]
    return {
        "density": np.where(something, density, np.float32(0)), "colour": colour,
        "lower": lower.astype(np.float32), "voxel": np.float32(voxel),
    }  # fmt: skip


def _nodes(field: VolumeField, lower, voxel: float, shape, start: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Return density and colour coefficients of the nodes from ``start`` to ``last``, in lexicographic order."""
    t = field.types
    n = dr.arange(t.UInt32, start, last)
    index = (n // (shape[1] * shape[2]), n // shape[2] % shape[1], n % shape[2])
    nodes = [dr.fma(t.Float(i), voxel, float(a)) for i, a in zip(index, lower, strict=True)]
    largest, numbers = t.Float(0), [t.Float(0)] * 12
    for corner in np.ndindex(2, 2, 2):
        place = [
            dr.clip(x + (WITHIN if c else -WITHIN) * field.voxel, a, b)
            for x, c, a, b in zip(nodes, corner, field.lower, field.upper, strict=True)
        ]
        p = t.Array3f(*place)
        sigma, point_data = field.density_at(p, t.Bool(True))
        more = sigma > largest
        coefficients = _exponential(field, point_data, p, more)
        largest = dr.select(more, sigma, largest)
        numbers = [dr.select(more, new, old) for new, old in zip(coefficients, numbers, strict=True)]
        dr.eval(largest, numbers)
    return largest.numpy(), np.stack([x.numpy() for x in numbers], axis=-1)


def _exponential(field: VolumeField, point_data: list, p, active) -> list:
    """Return the numbers a, b of each channel, from the radiance in six directions."""
    t = field.types
    a, slopes = [t.Float(0)] * 3, []
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        ends = [
            [dr.log(dr.maximum(c, 1e-6)) for c in field.radiance_at(point_data, p, d, active)]
            for d in (t.Array3f(*(sign * x for x in axis)) for sign in (1.0, -1.0))
        ]
        a = [x + (plus + minus) / 6 for x, plus, minus in zip(a, *ends, strict=True)]
        slopes.append([(plus - minus) / 2 for plus, minus in zip(*ends, strict=True)])
    return [x for c in range(3) for x in (a[c], *(b[c] for b in slopes))]


def mean_colour(numbers: np.ndarray) -> np.ndarray:
    """Return the mean of exp(a + b·d) over all directions, exp(a) · sinh|b| / |b|: ``(…, 3)`` from ``(…, 12)``."""
    four = numbers.reshape(*numbers.shape[:-1], 3, 4).astype(np.float64)
    slope = np.maximum(np.linalg.norm(four[..., 1:], axis=-1), 1e-6)
    return (np.exp(four[..., 0]) * np.sinh(slope) / slope).astype(np.float32)


def decode(field: VolumeField, output: Path, resolution: int | None = None) -> list[tuple[Path, str]]:
    """Write a field as a dense grid and return the file with a line about its content.

    A ``.npz`` file holds the arrays of :func:`dense_grid`; a ``.vdb`` file holds grids ``density`` and ``color``, the
    mean radiance over all directions. Raises :class:`.UsageError` for another extension, a bad resolution, or if
    OpenVDB is not installed.
    """
    suffix = output.suffix.lower()
    if suffix not in (".npz", ".vdb"):
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are .npz and .vdb')
    module = _openvdb(output) if suffix == ".vdb" else None
    content = dense_grid(field, resolution)
    shape = " x ".join(map(str, content["density"].shape))
    filled = np.count_nonzero(content["density"]) / content["density"].size
    with replacing(output) as temporary:
        if module is None:
            with open(temporary, "wb") as stream:
                np.savez_compressed(stream, **content)
        else:
            _write_vdb(module, temporary, content)
    summary = "density and 12 numbers of colour" if module is None else "density and mean colour"
    return [(output, f"{shape} nodes (x, y, z), {100 * filled:.1f}% of them not empty: {summary}")]


def _openvdb(output: Path):
    for name in MODULES:
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise UsageError(
        f'output "{output}": a VDB file needs the Python module openvdb, which is not installed (it is in conda-forge, '
        f"in Debian's python3-openvdb and in Blender); a .npz file needs no other module"
    )


def _write_vdb(module, path: Path, content: dict[str, np.ndarray]) -> None:
    """Write VDB grids whose voxels are the nodes; empty nodes are not active."""
    voxel, grids = float(content["voxel"]), []
    # OpenVDB multiplies row vectors from the left
    matrix = np.diag([voxel, voxel, voxel, 1.0])
    matrix[3, :3] = content["lower"]
    transform = module.createLinearTransform(matrix.tolist())
    something = content["density"][..., None] > 0
    for name, grid_type, array in (
        ("density", module.FloatGrid, content["density"]),
        ("color", module.Vec3SGrid, mean_colour(content["colour"]) * something),
    ):
        vdb = grid_type()
        vdb.copyFromArray(np.ascontiguousarray(array, np.float64))
        vdb.name, vdb.transform = name, transform
        grids.append(vdb)
    grids[0].gridClass = module.GridClass.FOG_VOLUME
    module.write(str(path), grids=grids)


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
        """Write density and colour on a dense grid (:func:`decode`)."""
        return decode(self.field, Path(output), resolution)


MODEL = RadianceFieldModel
