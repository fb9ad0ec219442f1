"""
Fields back to dense grids, as NumPy's archives or OpenVDB files that Blender and others read.

No package of OpenVDB is on the index (``openvdb`` is part of conda's, Debian's ``python3-openvdb`` and Blender's own
Python), so it is used where it is there and not required.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import drjit as dr
import numpy as np
from scipy.ndimage import distance_transform_edt

from ...errors import UsageError
from ...files import replacing
from .field import DenseField, VolumeField, raw_of

#: Points that a field is asked at once.
CHUNK = 2**20

#: The finest grid that is decoded, nodes along the longest side.
MAX_RESOLUTION = 512

#: Of a voxel: a node belongs to all cells around it, and is looked at from within each.
WITHIN = 1e-3

#: Densities below this, per voxel, are nothing.
NOTHING = 1e-3

#: The least radiance whose logarithm is taken.
DARK = 1e-6

#: Names of OpenVDB's module, newest first.
MODULES = ("openvdb", "pyopenvdb")


def grid(field: VolumeField, resolution: int | None = None) -> dict[str, np.ndarray]:
    """
    A field at the nodes of a grid, ``lower + voxel · (i, j, k)``: ``density`` ``(X, Y, Z)``, per unit of length,
    ``colour`` ``(X, Y, Z, 12)``, of which the radiance in direction d is exp(a + b·d), four numbers a, b for each of
    red, green and blue (:func:`.field.colour_of`), ``lower`` ``(3,)`` and ``voxel`` ``()``; float32.

    With ``resolution`` nodes along the longest side, by default the field's own voxels. Where the radiance is no such
    exponential, it is right in the mean of the logarithms of opposite directions, along the axes. Where there is
    nothing, the colour is the nearest one. A cell that a sparse field does not look at, beside one that it does, fades
    out in a dense grid: one that is twice as fine is nearer to the field. Raises
    :class:`~mi_diffind.errors.UsageError` for a resolution out of 2 … 512.
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
    something = density * voxel > NOTHING
    if something.any():
        nearest = distance_transform_edt(~something, return_distances=False, return_indices=True)
        colour = colour[tuple(nearest)]
    return {
        "density": np.where(something, density, np.float32(0)), "colour": colour,
        "lower": lower.astype(np.float32), "voxel": np.float32(voxel),
    }  # fmt: skip


def _nodes(field: VolumeField, lower, voxel: float, shape, start: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Density and twelve numbers of colour of the nodes of these numbers, in lexicographic order."""
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
        sigma, latent = field.look(p, t.Bool(True))
        more = sigma > largest
        found = _exponential(field, latent, p, more)
        largest = dr.select(more, sigma, largest)
        numbers = [dr.select(more, new, old) for new, old in zip(found, numbers, strict=True)]
        dr.eval(largest, numbers)
    return largest.numpy(), np.stack([x.numpy() for x in numbers], axis=-1)


def _exponential(field: VolumeField, latent: list, p, active) -> list:
    """The numbers a, b of each channel, from the radiance in six directions."""
    t = field.types
    a, slopes = [t.Float(0)] * 3, []
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)):
        ends = [
            [dr.log(dr.maximum(c, DARK)) for c in field.colour(latent, p, t.Array3f(*(s * x for x in axis)), active)]
            for s in (1.0, -1.0)
        ]
        a = [x + (plus + minus) / 6 for x, plus, minus in zip(a, *ends, strict=True)]
        slopes.append([(plus - minus) / 2 for plus, minus in zip(*ends, strict=True)])
    return [x for c in range(3) for x in (a[c], *(b[c] for b in slopes))]


def dense(types, content: dict[str, np.ndarray]) -> DenseField:
    """The field that :func:`grid` made, or its archive holds, as one that can be rendered."""
    voxel = float(content["voxel"])
    return DenseField(types, raw_of(content["density"], voxel), content["colour"], content["lower"], voxel)


def mean_colour(numbers: np.ndarray) -> np.ndarray:
    """The mean over all directions of exp(a + b·d), ``(…, 3)`` of ``(…, 12)``: exp(a) · sinh|b| / |b|."""
    four = numbers.reshape(*numbers.shape[:-1], 3, 4).astype(np.float64)
    slope = np.maximum(np.linalg.norm(four[..., 1:], axis=-1), 1e-6)
    return (np.exp(four[..., 0]) * np.sinh(slope) / slope).astype(np.float32)


def decode(field: VolumeField, output: Path, resolution: int | None = None) -> list[tuple[Path, str]]:
    """
    Write a field as a grid, and return the file with a line about it: ``.npz`` with what :func:`grid` returns, or
    ``.vdb`` with grids ``density`` and ``color``, the mean over all directions. Raises
    :class:`~mi_diffind.errors.UsageError`, also where OpenVDB is not installed.
    """
    suffix = output.suffix.lower()
    if suffix not in (".npz", ".vdb"):
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are .npz and .vdb')
    module = _openvdb(output) if suffix == ".vdb" else None
    content = grid(field, resolution)
    shape = " x ".join(map(str, content["density"].shape))
    filled = np.count_nonzero(content["density"]) / content["density"].size
    with replacing(output) as temporary:
        if module is None:
            with open(temporary, "wb") as stream:
                np.savez_compressed(stream, **content)
        else:
            _write_vdb(module, temporary, content)
    what = "density and 12 numbers of colour" if module is None else "density and mean colour"
    return [(output, f"{shape} nodes (x, y, z), {100 * filled:.1f}% of them not empty: {what}")]


def _openvdb(output: Path):
    for name in MODULES:
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    raise UsageError(
        f'output "{output}": a VDB file needs the Python module openvdb, which is not installed (it is in conda-forge, '
        f"in Debian's python3-openvdb and in Blender); .npz needs nothing"
    )


def _write_vdb(module, path: Path, content: dict[str, np.ndarray]) -> None:
    """Grids whose voxels are the nodes; those with nothing are not active."""
    voxel, found = float(content["voxel"]), []
    # Rows are multiplied from the left
    matrix = np.diag([voxel, voxel, voxel, 1.0])
    matrix[3, :3] = content["lower"]
    transform = module.createLinearTransform(matrix.tolist())
    something = content["density"][..., None] > 0
    for name, kind, array in (
        ("density", module.FloatGrid, content["density"]),
        ("color", module.Vec3SGrid, mean_colour(content["colour"]) * something),
    ):
        vdb = kind()
        vdb.copyFromArray(np.ascontiguousarray(array, np.float64))
        vdb.name, vdb.transform = name, transform
        found.append(vdb)
    found[0].gridClass = module.GridClass.FOG_VOLUME
    module.write(str(path), grids=found)
