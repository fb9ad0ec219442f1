"""Baselines of distance fields: sparse distances without indirection; files of fields, and fields of a given size."""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ...arrays.sparse_grid import SparseGrid
from ...core.files import replacing
from ...tasks.sdf import nodes
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.encoding import sample
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.nodes import SparseNodes, middles
from .bricks import Bricks
from .byte_grids import NEAREST, ByteGrid, dequantised, least_squares, quantised, slope_bound

#: Spacings, of the longest side: where :func:`fit_bytes` begins, and its limits.
FIRST, FINEST, COARSEST = 1 / 64, 1 / 2048, 1 / 12


class DistanceNodes(SparseNodes):
    """Distances of ``bits`` each at the nodes of a sparse ``structure``: our layout without normals and indirection."""

    def __init__(self, types, structure: SparseGrid, numbers: np.ndarray, band: float, bits: int, slope: float):
        words = nodes.pointer_words(numbers, bits)
        super().__init__(types, structure, slope, pointers=words, bits=bits)
        self.state = {"numbers": numbers, "band": band, "bits": bits, "slope": slope, **structure_arrays(structure)}
        self.band_spacings, self.number_bytes = band / self.spacing, 4 * len(words)

    def _node(self, number, record, i, j, k, active):
        value = self.types.Float(nodes.pointer_at(self._pointers, number, self.bits, active))
        half = 2 ** (self.bits - 1)
        zero = self.types.Float(0)
        return (value + (0.5 - half)) * (self.band_spacings / half), (zero, zero, zero)

    def normal(self, p, active=True):
        return self.gradient(p, active)[1]

    def decoded(self) -> np.ndarray:
        distances = dequantised(self.state["numbers"], self.band_spacings, self.bits)
        return np.stack([distances, *[np.zeros_like(distances)] * 3], axis=1)

    def frames(self) -> np.ndarray:
        """Return for each block the plane nearest to its nodes' distances, which bounds the part that rays march."""
        positions, block = self.structure.node_positions()
        terms = np.concatenate([np.ones((len(positions), 1)), middles(positions)], axis=1)
        columns = np.concatenate([terms, self.decoded()[:, :1]], axis=1)
        sums = np.zeros((self.structure.blocks, 4, 5))
        np.add.at(sums, block, terms[:, :, None] * columns[:, None])
        planes = np.linalg.solve(sums[..., :4] + 1e-3 * np.eye(4), sums[..., 4:])[..., 0]
        length = np.linalg.norm(planes[:, 1:], axis=1, keepdims=True)
        normals = np.where(length > 0, planes[:, 1:] / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
        return nodes.frame_words(normals, planes[:, 0], np.ones(len(planes)))

    @property
    def nbytes(self) -> int:
        return self.structure.nbytes + self.number_bytes


def distance_nodes(types, distances: Distances, spacing: float, train: bool = False, bits: int = 6) -> DistanceNodes:
    """Return the corners of all cells that have corners of both signs, with exact distances or trained ones."""
    sampled = sample(distances, spacing)
    structure, band = sampled.structure, NEAREST * spacing
    keys = np.ravel_multi_index(sampled.positions.astype(np.int64).T, structure.shape)
    order = np.argsort(keys)
    values = sampled.distances * spacing
    if train:
        # Nodes keep their sides: the signs decide which nodes there are
        lower = np.asarray(structure.lower)
        trained = least_squares(distances, lower, spacing, structure.shape, keys[order], values[order])
        least = 0.5 * band / 2 ** (bits - 1)
        values[order] = np.where(values[order] < 0, np.minimum(trained, -least), np.maximum(trained, least))
    numbers = quantised(values, band, bits)
    corners = dequantised(numbers, band, bits)[sampled.corners].reshape(-1, 2, 2, 2)
    slope = max(slope_bound(part, spacing) for part in np.array_split(corners, max(1, corners.size // 2**21)))
    return DistanceNodes(types, structure, numbers, band, bits, slope)


def structure_arrays(structure: SparseGrid) -> dict:
    """Return the fields of a structure for the ``state`` of a field, each name with ``structure_`` before it."""
    return {f"structure_{f.name}": getattr(structure, f.name) for f in dataclasses.fields(structure)}


def save(path: Path | str | None, field: DistanceField) -> int:
    """Write a field's ``state``, the arguments of its class without ``types``, unless ``path`` is ``None``.

    :func:`load` reads the file. Returns its size; the arrays are compressed (zlib).
    """
    file = io.BytesIO()
    np.savez_compressed(file, class_name=type(field).__name__, **field.state)
    if path:
        with replacing(path) as temporary:
            temporary.write_bytes(file.getvalue())
    return len(file.getvalue())


def load(path: Path | str, types, *more: type[DistanceField]) -> DistanceField:
    """Return the field of a file that :func:`save` wrote, of one of the classes here or in ``more``."""
    with np.load(path, allow_pickle=False) as file:
        state = {name: file[name] if file[name].ndim else file[name].item() for name in file}
    field_class = {c.__name__: c for c in (ByteGrid, Bricks, DistanceNodes, *more)}[state.pop("class_name")]
    parts = {name: state.pop(name) for name in list(state) if name.startswith("structure_")}
    if parts:
        parts = {name.removeprefix("structure_"): v for name, v in parts.items()}
        state["structure"] = SparseGrid(**{**parts, "lower": tuple(parts["lower"].tolist())})
    return field_class(types, **state)


def fit_bytes(make: Callable[[float], DistanceField], nbytes: int) -> DistanceField:
    """Return the field ``make(spacing)`` with the finest spacing that fits into ``nbytes``.

    The field is within 1.5% of ``nbytes`` if few attempts reach that, else within 3% if possible. Raises ``ValueError``
    if no spacing fits.
    """
    spacing, power, before, best = FIRST, 2.0, None, None
    for attempt in range(8):
        field = make(spacing)
        if field.nbytes <= nbytes and (best is None or field.nbytes > best.nbytes):
            best = field
        if best is not None and best.nbytes >= (0.985 if attempt < 3 else 0.97) * nbytes:
            break
        if before is not None and field.nbytes != before[1]:
            power = math.log(field.nbytes / before[1]) / math.log(before[0] / spacing)
        before = spacing, field.nbytes
        # A quarter of the bytes shows how they grow, and takes a quarter of the time
        aim = 0.25 if attempt == 0 and field.nbytes < nbytes / 8 else 0.993
        spacing *= (field.nbytes / (aim * nbytes)) ** (1 / np.clip(power, 1.5, 3.0))
        spacing = float(np.clip(spacing, FINEST, COARSEST))
        if spacing == before[0]:
            break
    if best is None:
        raise ValueError(f"{nbytes:,} bytes are too few: {field.nbytes:,} are the least that was found")
    return best
