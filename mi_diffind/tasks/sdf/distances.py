"""Exact distances to the solid that a mesh encloses, points on and around it, and cells that its surface crosses.

Distances are computed by libigl in a child process (:mod:`.distances_child`), since some meshes make libigl abort.
The magnitude |d| comes from a bounding-volume tree, the sign from the winding number: a point is inside where the
winding number is at least 1/2. That of a watertight mesh is a whole number. An open mesh is closed hole by hole first
(:func:`.mesh.close_holes`) if the closed mesh agrees with its winding number; :attr:`Distances.warnings` tell the share
of space that is in doubt. Triangles inside of the solid, where pieces overlap, have no part in distances: with them,
the distance would be zero where no surface is visible.

A grid has a ``lower`` corner, cells with sides of length ``spacing``, and ``shape``, the number of cells along x, y and
z. A ``seed`` is a number or a ``numpy.random.Generator``.
"""

from __future__ import annotations

import functools
import importlib.util
import math

import numpy as np

from ...arrays.sparse_grid import CORNERS
from ...core.errors import DiffindError, missing_package
from ...core.jobs import WorkerProcess
from .distances_child import answer
from .mesh import NO_VOLUME, Mesh, close_holes, outer_surface

#: Points per request: less than a second of work, so that Ctrl-C is noticed.
CHUNK = 2**17

#: Distance from the surface below which the gradient is the triangle's normal.
TOUCHING = 1e-9

#: Deviation of a winding number from a whole number beyond which the inside is ambiguous.
AMBIGUOUS = 0.1

#: Points at which the winding number of an open mesh is evaluated.
AMBIGUITY_POINTS = 2**16

#: Largest share of the certain ones among these points that may differ between the mesh and the closed mesh.
DISAGREEMENT = 0.01

#: Cells along the longest side of the coarse grid with which far points are recognised.
COARSE = 40


class DistancesError(DiffindError, RuntimeError):
    """Distances cannot be computed; the message is one sentence that names the mesh."""


class Distances:
    """Distances, signs and nearest points of the solid that ``mesh`` encloses, for points (N, 3) in the unit frame.

    A context manager: the child process starts with the first query and ends with the block. If libigl aborts, the
    query raises :class:`DistancesError`, and the next query starts a new process.
    """

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._child: WorkerProcess | None = None
        self._sent: set[str] = set()
        self._doubt = (0.0, 0.0)

    def __enter__(self) -> Distances:
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __del__(self):
        self.close()

    def close(self) -> None:
        """End the child process if it runs."""
        child, self._child, self._sent = self._child, None, set()
        if child is not None:
            child.process.kill()
            child.close()

    @functools.cached_property
    def solid(self) -> Mesh:
        """The closed mesh: the mesh itself if it is watertight, or cannot be closed consistently."""
        if self.mesh.watertight:
            return self.mesh
        rng = np.random.default_rng(0)
        points = rng.uniform(self.mesh.lower, self.mesh.upper, (AMBIGUITY_POINTS, 3))
        winding = self.winding(points)
        unclear = np.abs(winding - np.round(winding)) > AMBIGUOUS
        self._doubt = float(unclear.mean()), float((np.abs(winding - 0.5) < 0.25).mean())
        closed = close_holes(self.mesh)
        inside = winding >= 0.5
        differ = self._ask("inside", points, "closed", closed)[0] != inside
        agrees = np.sum(differ & ~unclear) <= DISAGREEMENT * np.sum(inside & ~unclear)
        return closed if agrees else self.mesh

    @functools.cached_property
    def surface(self) -> Mesh:
        """The part of :attr:`solid` with inside on one side and outside on the other, from which samples are drawn.

        Raises :class:`DistancesError` if no volume is enclosed.
        """
        outer = outer_surface(self.solid, self.inside)
        if not len(outer.faces) or (outer.watertight and abs(outer.volume) < NO_VOLUME):
            raise DistancesError(f"{self.mesh.path}: encloses no volume, expected the surface of a solid")
        return outer

    @property
    def warnings(self) -> list[str]:
        """One sentence for each doubt about the inside of the mesh, besides the mesh's own warnings."""
        sentences = []
        if not self.mesh.watertight:
            remedy = "its holes were closed" if self.solid is not self.mesh else "inside is where it is at least 0.5"
            unclear, doubtful = self._doubt
            sentences.append(
                f"{self.mesh.path}: in {_percent(unclear)} of its bounding box's volume it is ambiguous what is inside "
                f"of the mesh, which is not closed (winding numbers further than {AMBIGUOUS} from a whole number; in "
                f"{_percent(doubtful)}, from 0.25 to 0.75): {remedy}"
            )
        left = 1 - self.surface.area / self.solid.area
        if left > 1e-6:
            sentences.append(
                f"{self.mesh.path}: pieces overlap: {_percent(left)} of its surface does not bound the solid and was "
                f"left out"
            )
        return sentences

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return |d| (N,) float64, the nearest triangle of :attr:`surface` (N,), and the nearest point (N, 3)."""
        return self._ask("nearest", points, "surface", self.surface)

    def unsigned(self, points) -> np.ndarray:
        """Return |d|, ``(N,)`` float64."""
        return self._ask("distance", points, "surface", self.surface)[0]

    def winding(self, points) -> np.ndarray:
        """Return the winding number of the unclosed mesh, ``(N,)``: within about 0.01, and exact near 1/2."""
        return self._ask("winding", points, "mesh", self.mesh)[0]

    def inside(self, points) -> np.ndarray:
        """Return whether points are inside, ``(N,)`` bool, in a third of the time of :meth:`winding`."""
        return self._ask("inside", points, "solid", self.solid)[0]

    def signed(self, points, limit: float = math.inf) -> np.ndarray:
        """Return the signed distance, ``(N,)`` float32, truncated to ± ``limit``.

        With a small limit, many points all over space are several times as fast, since far ones are recognised by a
        coarse grid.
        """
        points = _check_points(points)
        if limit < math.inf and len(points) > COARSE**3:
            return self._signed_near(points, limit)
        sign = np.where(self.inside(points), -1, 1).astype(np.float32)
        return sign * np.minimum(self.unsigned(points), limit).astype(np.float32)

    def _signed_near(self, points: np.ndarray, limit: float) -> np.ndarray:
        """Compute :meth:`signed` with a coarse grid: the distance of a cell's centre bounds those of its points."""
        lower, upper = points.min(axis=0), points.max(axis=0)
        side = max(float((upper - lower).max()) / COARSE, 1e-9)
        index = np.minimum((points - lower) / side, COARSE - 1).astype(np.int64)
        keys, cell = np.unique((index[:, 0] * COARSE + index[:, 1]) * COARSE + index[:, 2], return_inverse=True)
        index = np.stack([keys // COARSE**2, keys // COARSE % COARSE, keys % COARSE], axis=-1)
        centres = lower + (index + 0.5) * side
        step = np.linalg.norm(points - centres[cell], axis=1)
        far = self.unsigned(centres)[cell] - step >= limit
        values = np.empty(len(points), np.float32)
        if self.solid.watertight:  # the sign changes on the surface only
            values[far] = np.where(self.inside(centres), -limit, limit)[cell[far]]
        else:
            values[far] = np.where(self.inside(points[far]), -limit, limit)
        values[~far] = self.signed(points[~far]).clip(-limit, limit)
        return values

    def signed_normals(self, points) -> tuple[np.ndarray, np.ndarray]:
        """Return the signed distance ``(N,)`` and its gradient ``(N, 3)``, float32.

        The gradient points away from the nearest point; on the surface it is the normal of the triangle.
        """
        points = _check_points(points)
        d, face, closest = self.nearest(points)
        sign = np.where(self.inside(points), -1.0, 1.0)
        near = d < TOUCHING
        gradient = (points - closest) * (sign / np.where(near, 1, d))[:, None]
        gradient[near] = self.surface.normals[face[near]]
        return (sign * d).astype(np.float32), gradient.astype(np.float32)

    def _ask(self, question: str, points, name: str, mesh: Mesh) -> tuple[np.ndarray, ...]:
        """Return the answers for all points, chunk by chunk; the mesh is sent once, under its ``name``."""
        points = _check_points(points)
        if not len(points):
            return tuple(array[:0] for array in self._ask(question, np.zeros((1, 3)), name, mesh))
        if self._child is None:
            if importlib.util.find_spec("igl") is None:
                raise DistancesError(f"{self.mesh.path}: distances need {missing_package('libigl')}")
            self._child = WorkerProcess(threads=0)
        if name not in self._sent:
            faces = np.ascontiguousarray(mesh.faces, np.int64)
            self._request("mesh", name, (np.ascontiguousarray(mesh.vertices), faces, mesh.watertight))
            self._sent.add(name)
        answers = [self._request(question, name, points[i : i + CHUNK]) for i in range(0, len(points), CHUNK)]
        return tuple(map(np.concatenate, zip(*answers, strict=True)))

    def _request(self, *request) -> tuple[np.ndarray, ...]:
        try:
            outcome = self._child.carry_out("distances", answer, request)
        except (OSError, EOFError):
            end, self._child, self._sent = self._child.close(), None, set()
            raise DistancesError(
                f"{self.mesh.path}: libigl ended while it computed distances to this mesh ({end}); a repaired mesh may "
                f"work"
            ) from None
        except BaseException:  # after Ctrl-C the rest of an answer would be read as the next one
            self.close()
            raise
        if outcome.failure:
            self.close()
            raise DistancesError(f"{self.mesh.path}: libigl finds no distances to this mesh ({outcome.failure})")
        return outcome.value


def _check_points(points) -> np.ndarray:
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: found the shape {points.shape}, expected (N, 3)")
    if not np.all(np.isfinite(points)):
        raise ValueError("points: found NaN or infinite ones, allowed are finite ones")
    return points


def _percent(share: float) -> str:
    return f"{100 * share:.2g}%" if share >= 1e-4 else ("0%" if share == 0 else "less than 0.01%")


#: Largest number of cells along an axis at the coarsest level of :func:`surface_cells`.
COARSEST = 16


def sample_surface(mesh: Mesh, count: int, seed) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points uniform over the area, and the normals of their triangles: ``(count, 3)`` twice, float64.

    The area is divided into ``count`` equal parts with one point in each, so that small pieces get their share.
    """
    rng = np.random.default_rng(seed)
    total = np.cumsum(mesh.areas)
    places = (np.arange(count) + rng.random(count)) / count * total[-1]
    triangle = np.minimum(np.searchsorted(total, places, side="right"), len(total) - 1)
    # Folding the unit square over its diagonal keeps a point uniform over the triangle
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    a, b, c = np.moveaxis(mesh.corners[triangle], 1, 0)
    return a + u * (b - a) + v * (c - a), mesh.normals[triangle]


def sample_near(mesh: Mesh, count: int, width: float, seed) -> np.ndarray:
    """Return ``count`` surface points, (count, 3), displaced by a normal distribution of deviation ``width``."""
    rng = np.random.default_rng(seed)
    points, _ = sample_surface(mesh, count, rng)
    return points + rng.normal(scale=width, size=points.shape)


def sample_box(lower, upper, count: int, seed) -> np.ndarray:
    """Return ``count`` points uniform in the box between two corners, ``(count, 3)``."""
    return np.random.default_rng(seed).uniform(lower, upper, (count, 3))


def surface_cells(distances: Distances, lower, spacing: float, shape, reach: float = 0.0) -> np.ndarray:
    """Return the cells whose circumscribed sphere comes within ``reach`` of the surface, searching from coarse to fine.

    The result is ``(K, 3)``, int32, in lexicographic order. No cell that the surface passes through is missing; about a
    sixth of the cells are only passed by.
    """
    lower, shape = np.asarray(lower, dtype=np.float64), np.asarray(shape)
    side = 1
    while -(-int(shape.max()) // side) > COARSEST:
        side *= 2
    cells = np.stack(np.meshgrid(*[np.arange(-(-n // side)) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        centres = lower + (cells + 0.5) * (side * spacing)
        near = distances.unsigned(centres) <= (np.sqrt(3) / 2 * side * spacing + reach) * (1 + 1e-6)
        cells = cells[near]
        if side == 1:
            break
        side //= 2
        cells = (2 * cells[:, None] + CORNERS).reshape(-1, 3)
        cells = cells[np.all(cells * side < shape, axis=1)]
    keys = np.sort(np.ravel_multi_index(cells.T, tuple(shape)))
    return np.stack(np.unravel_index(keys, tuple(shape)), axis=-1).astype(np.int32)


def near_nodes(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of cells, each once, and for each cell the positions of its eight corners among them.

    The nodes are ``(M, 3)``, int32, in lexicographic order; the positions are ``(K, 8)``, z fastest.
    """
    cells = np.asarray(cells, dtype=np.int64)
    shape = tuple(cells.max(axis=0, initial=0) + 2)
    keys = np.ravel_multi_index(cells.T, shape)[:, None] + np.ravel_multi_index(CORNERS.T, shape)
    keys, corners = np.unique(keys, return_inverse=True)
    return np.stack(np.unravel_index(keys, shape), axis=-1).astype(np.int32), corners.reshape(-1, 8)
