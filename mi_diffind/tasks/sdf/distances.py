"""
Exact distances to a mesh, from libigl in a process of its own (:mod:`.distances_child`): |d| by a bounding-volume tree,
the sign, apart, by the winding number.

A point is inside where the winding number is at least one half. That of a watertight mesh is a whole number. An open
one is closed first, hole by hole (:func:`.solids.closed`), if that agrees with its winding number; in how much of space
that lies in between, :attr:`Distances.ambiguity` says. Triangles inside of the solid, where pieces overlap, have no
part in distances: they would let the distance be zero where no surface is seen.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import math
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ...errors import DiffindError, reason
from . import solids
from .distances_child import read, write
from .mesh import NO_VOLUME, Mesh

#: Points per request: fewer than a second's work, so that Ctrl-C is heard.
CHUNK = 2**17

#: Distance from the surface below which the direction to it is that of the triangle's normal.
TOUCHING = 1e-9

#: A winding number that is further from a whole number than this leaves open what is inside.
AMBIGUOUS = 0.1

#: Points at which the winding number of an open mesh is looked at, and, of those for certain inside, the share that may
#: be so in the mesh or in the closed one only.
AMBIGUITY_POINTS, DISAGREEMENT = 2**16, 0.01

#: Cells along the longest side of the coarse grid that says which points are far.
COARSE = 40


class DistancesError(DiffindError, RuntimeError):
    """Distances could not be found; the message is one sentence that names the mesh."""


class Distances:
    """
    Distances, signs and nearest points of the solid that ``mesh`` encloses; points are in the unit frame, ``(N, 3)``.

    A context manager: the process starts at the first question and ends with the block. Where libigl aborts, the
    question raises :class:`DistancesError`, and the next one starts the process anew.
    """

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._child: subprocess.Popen | None = None
        self._stderr = None
        self._owner = 0
        self._sent: set[str] = set()
        self._ambiguity: tuple[float, float] | None = None

    def __enter__(self) -> Distances:
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __del__(self):
        self.close()

    def close(self) -> None:
        """End the process, if it runs."""
        child, self._child = self._child, None
        self._sent = set()
        if child is not None and self._owner == os.getpid():  # not that of whoever was forked
            for stream in (child.stdin, child.stdout):
                with contextlib.suppress(OSError):
                    stream.close()
            with contextlib.suppress(OSError):
                child.kill()
            child.wait()
        if self._stderr is not None:
            self._stderr.close()
            self._stderr = None

    # -- the solid ----------------------------------------------------------------------------------------------------

    @functools.cached_property
    def solid(self) -> Mesh:
        """The mesh, closed: the mesh itself if it is watertight, or cannot be closed sensibly."""
        if self.mesh.watertight:
            return self.mesh
        rng = np.random.default_rng(0)
        points = rng.uniform(self.mesh.lower, self.mesh.upper, (AMBIGUITY_POINTS, 3))
        winding = self.winding(points)
        unclear = np.abs(winding - np.round(winding)) > AMBIGUOUS
        self._ambiguity = float(unclear.mean()), float((np.abs(winding - 0.5) < 0.25).mean())
        filled = solids.closed(self.mesh)
        inside, clear = winding >= 0.5, ~unclear
        differ = self._ask("inside", points, "filled", filled)["inside"] != inside
        return filled if np.sum(differ & clear) <= DISAGREEMENT * np.sum(inside & clear) else self.mesh

    @functools.cached_property
    def surface(self) -> Mesh:
        """
        What of :attr:`solid` has inside on one side and outside on the other: draw samples from it. Raises
        :class:`DistancesError` if there is nothing of the kind.
        """
        found = solids.bounding(self.solid, self.inside)
        if not len(found.faces) or (found.watertight and abs(found.volume) < NO_VOLUME):
            raise DistancesError(f"{self.mesh.path}: encloses no volume, expected the surface of a solid")
        return found

    @property
    def ambiguity(self) -> float:
        """
        The share of the bounding box in which the mesh's winding number is further than 0.1 from a whole number, so
        that it is a matter of opinion what is inside. 0 for a watertight mesh.
        """
        return self._ambiguous[0]

    @property
    def _ambiguous(self) -> tuple[float, float]:
        self.solid  # noqa: B018
        return self._ambiguity or (0.0, 0.0)

    @property
    def warnings(self) -> list[str]:
        """A sentence for each thing that has to be said of what is inside of the mesh, besides the mesh's own."""
        said = []
        if not self.mesh.watertight:
            unclear, doubtful = self._ambiguous
            how = "its holes were closed" if self.solid is not self.mesh else "inside is where it is at least 0.5"
            said.append(
                f"{self.mesh.path}: in {_percent(unclear)} of its bounding box's volume it is ambiguous what is inside "
                f"of the mesh, which is not closed (winding numbers further than {AMBIGUOUS} from a whole number; in "
                f"{_percent(doubtful)}, from 0.25 to 0.75): {how}"
            )
        left = 1 - self.surface.area / self.solid.area
        if left > 1e-6:
            said.append(
                f"{self.mesh.path}: pieces overlap: {_percent(left)} of its surface does not bound the solid and was "
                f"left out"
            )
        return said

    # -- questions ----------------------------------------------------------------------------------------------------

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """|d| ``(N,)`` float64, the nearest triangle of :attr:`surface`, ``(N,)``, and the nearest point, (N, 3)."""
        found = self._ask("nearest", points, "surface", self.surface)
        return found["distance"], found["face"], found["closest"]

    def unsigned(self, points) -> np.ndarray:
        """|d|, ``(N,)`` float64."""
        return self._ask("distance", points, "surface", self.surface)["distance"]

    def to_triangles(self, points) -> np.ndarray:
        """The distance to the mesh as it is, whether it encloses anything or not, ``(N,)`` float64."""
        return self._ask("distance", points, "mesh", self.mesh)["distance"]

    def winding(self, points) -> np.ndarray:
        """The winding number of the mesh as it is, ``(N,)``: within about 0.01, and exact where it is near a half."""
        return self._ask("winding", points, "mesh", self.mesh)["winding"]

    def inside(self, points) -> np.ndarray:
        """Whether points are inside, ``(N,)`` bool: three times as fast as the winding number itself."""
        return self._ask("inside", points, "solid", self.solid)["inside"]

    def signed(self, points, limit: float = math.inf) -> np.ndarray:
        """
        The signed distance, ``(N,)`` float32, truncated to ± ``limit``: with a small one, many points all over space
        are several times as fast, since most of them need not be looked at.
        """
        points = _checked(points)
        if limit < math.inf and len(points) > COARSE**3:
            return self._truncated(points, limit)
        sign = np.where(self.inside(points), -1, 1).astype(np.float32)
        return sign * np.minimum(self.unsigned(points), limit).astype(np.float32)

    def _truncated(self, points: np.ndarray, limit: float) -> np.ndarray:
        """The same by means of a coarse grid: from a centre's distance follows that its neighbours are far."""
        lower, upper = points.min(axis=0), points.max(axis=0)
        side = max(float((upper - lower).max()) / COARSE, 1e-9)
        index = np.minimum((points - lower) / side, COARSE - 1).astype(np.int64)
        keys, which = np.unique((index[:, 0] * COARSE + index[:, 1]) * COARSE + index[:, 2], return_inverse=True)
        index = np.stack([keys // COARSE**2, keys // COARSE % COARSE, keys % COARSE], axis=-1)
        centres = lower + (index + 0.5) * side
        distance = self.unsigned(centres)
        step = np.linalg.norm(points - centres[which], axis=1)
        far = distance[which] - step >= limit
        found = np.empty(len(points), np.float32)
        if self.solid.watertight:  # the sign changes on the surface only
            found[far] = np.where(self.inside(centres), -limit, limit)[which[far]]
        else:
            found[far] = np.where(self.inside(points[far]), -limit, limit)
        found[~far] = self.signed(points[~far]).clip(-limit, limit)
        return found

    def signed_normals(self, points) -> tuple[np.ndarray, np.ndarray]:
        """
        The signed distance ``(N,)`` and its gradient ``(N, 3)``, float32: away from the nearest point, on the surface
        the normal of its triangle.
        """
        points = _checked(points)
        d, face, closest = self.nearest(points)
        sign = np.where(self.inside(points), -1.0, 1.0)
        near = d < TOUCHING
        away = (points - closest) * (sign / np.where(near, 1, d))[:, None]
        away[near] = self.surface.normals[face[near]]
        return (sign * d).astype(np.float32), away.astype(np.float32)

    # -- the process --------------------------------------------------------------------------------------------------

    def _ask(self, question: str, points, name: str, mesh: Mesh) -> dict[str, np.ndarray]:
        """The answers for all points of a mesh, which is sent under its ``name`` when it is needed, chunk by chunk."""
        points = _checked(points)
        if not len(points):
            return {key: found[:0] for key, found in self._ask(question, np.zeros((1, 3)), name, mesh).items()}
        parts = [points[i : i + CHUNK] for i in range(0, len(points), CHUNK)]
        if self._owner != os.getpid():
            self.close()
        if self._child is None:
            self._start()
        if name not in self._sent:
            arrays = {"vertices": mesh.vertices, "faces": mesh.faces.astype(np.int64), "watertight": mesh.watertight}
            self._request(f"mesh {name}", {key: np.ascontiguousarray(a) for key, a in arrays.items()})
            self._sent.add(name)
        answers = [self._request(f"{question} {name}", {"points": part}) for part in parts]
        return {key: np.concatenate([a[key] for a in answers]) for key in answers[0]}

    def _request(self, name: str, arrays: dict) -> dict:
        try:
            write(self._child.stdin, name, arrays)
            answer = read(self._child.stdout)
        except OSError:
            answer = None
        except BaseException:  # Ctrl-C in the middle of an answer: what follows would be the rest of it
            self.close()
            raise
        if answer is None:
            self._died()
        if answer[0] != name:
            said = reason(Exception(answer[0].removeprefix("error: ")))
            self.close()
            raise DistancesError(f"{self.mesh.path}: libigl finds no distances to this mesh ({said})")
        return answer[1]

    def _start(self) -> None:
        if importlib.util.find_spec("igl") is None:
            raise DistancesError(
                f"{self.mesh.path}: distances need libigl, which is not installed (pip install libigl)"
            )
        self._owner = os.getpid()
        script = Path(__file__).with_name("distances_child.py")
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115
        self._child = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, map(os.path.abspath, sys.path)))},
        )  # fmt: skip

    def _died(self) -> None:
        """The process is gone: say why."""
        code = self._child.wait()
        self._stderr.seek(0, os.SEEK_END)
        self._stderr.seek(max(0, self._stderr.tell() - 2000))
        last = self._stderr.read().decode(errors="replace").strip().splitlines()
        how = f"exit code {code}"
        if code < 0:
            with contextlib.suppress(ValueError):
                how = signal.Signals(-code).name
        said = f": {reason(Exception(last[-1]))}" if last else ""
        self.close()
        raise DistancesError(
            f"{self.mesh.path}: libigl ended while it looked for distances to this mesh ({how}{said}); a repaired mesh "
            f"may work"
        )


def _checked(points) -> np.ndarray:
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: have the shape {points.shape}, expected (N, 3)")
    if not np.all(np.isfinite(points)):
        raise ValueError("points: there are NaN or infinite ones, allowed are finite ones")
    return points


def _percent(share: float) -> str:
    return f"{100 * share:.2g}%" if share >= 1e-4 else ("0%" if share == 0 else "less than 0.01%")
