"""
Exact distances to a mesh, from libigl in a process of its own (:mod:`.distances_child`): |d| by a bounding-volume tree,
the sign, apart, by the winding number.

A point is inside where the winding number is at least one half. That of a watertight mesh is a whole number; that of an
open one may lie in between, and :attr:`Distances.ambiguity` says in how much of space it does.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from ...errors import DiffindError, reason
from .distances_child import read, write
from .mesh import Mesh

#: Points per request: fewer than a second's work, so that Ctrl-C is heard.
CHUNK = 2**17

#: Distance from the surface below which the direction to it is that of the triangle's normal.
TOUCHING = 1e-9

#: A winding number that is further from a whole number than this leaves open what is inside.
AMBIGUOUS = 0.1

#: Points at which the winding number of an open mesh is looked at.
AMBIGUITY_POINTS = 2**16


class DistancesError(DiffindError, RuntimeError):
    """Distances could not be found; the message is one sentence that names the mesh."""


class Distances:
    """
    Distances, signs and nearest points of ``mesh``; points are in the unit frame, ``(N, 3)``.

    A context manager: the process starts at the first question and ends with the block. Where libigl aborts, the
    question raises :class:`DistancesError`, and the next one starts the process anew.
    """

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._child: subprocess.Popen | None = None
        self._stderr = None
        self._ambiguity: tuple[float, float] | None = None
        self._coarse: tuple[int, np.ndarray, np.ndarray] | None = None

    def __enter__(self) -> Distances:
        return self

    def __exit__(self, *exc) -> None:
        self.close()

    def __del__(self):
        self.close()

    def close(self) -> None:
        """End the process, if it runs."""
        child, self._child = self._child, None
        if child is not None:
            for stream in (child.stdin, child.stdout):
                with contextlib.suppress(OSError):
                    stream.close()
            with contextlib.suppress(OSError):
                child.kill()
            child.wait()
        if self._stderr is not None:
            self._stderr.close()
            self._stderr = None

    # -- questions ----------------------------------------------------------------------------------------------------

    def nearest(self, points) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """|d| ``(N,)`` float64, the number of the nearest triangle ``(N,)`` int32, and the nearest point ``(N, 3)``."""
        found = self._ask("nearest", points, {"distance": (np.float64, ()), "face": (np.int32, ()),
                                              "closest": (np.float64, (3,))})  # fmt: skip
        return found["distance"], found["face"], found["closest"]

    def unsigned(self, points) -> np.ndarray:
        """|d|, ``(N,)`` float64."""
        return self._ask("distance", points, {"distance": (np.float64, ())})["distance"]

    def winding(self, points) -> np.ndarray:
        """
        The winding number, ``(N,)`` float64: within 0.004 of the exact one, and within 1e-6 where it lies near a half.
        """
        return self._ask("winding", points, {"winding": (np.float64, ())})["winding"]

    def inside(self, points) -> np.ndarray:
        """Whether points are inside, ``(N,)`` bool."""
        return self.winding(points) >= 0.5

    def signed(self, points) -> np.ndarray:
        """The signed distance, ``(N,)`` float32."""
        points = _checked(points)
        return np.where(self.inside(points), -1, 1).astype(np.float32) * self.unsigned(points).astype(np.float32)

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
        away[near] = self.mesh.normals[face[near]]
        return (sign * d).astype(np.float32), away.astype(np.float32)

    # -- what an open mesh leaves open --------------------------------------------------------------------------------

    @property
    def ambiguity(self) -> float:
        """
        The share of the bounding box in which the winding number is further than 0.1 from a whole number, so that it
        is a matter of opinion what is inside. 0 for a watertight mesh.
        """
        return self._look_at_windings()[0]

    @property
    def warning(self) -> str:
        """What has to be said of the mesh's inside, "" for a watertight one."""
        if self.mesh.watertight:
            return ""
        unclear, doubtful = self._look_at_windings()
        return (
            f"{self.mesh.path}: the mesh is not closed: in {_percent(unclear)} of its bounding box's volume it is "
            f"ambiguous what is inside (winding numbers further than {AMBIGUOUS} from a whole number; in "
            f"{_percent(doubtful)}, between 0.25 and 0.75); inside is where the winding number is at least 0.5"
        )

    def check(self) -> None:
        """Raise :class:`DistancesError` if nothing is inside."""
        if not self.mesh.watertight:
            self._look_at_windings()

    def _look_at_windings(self) -> tuple[float, float]:
        if self._ambiguity is None:
            if self.mesh.watertight:
                self._ambiguity = 0.0, 0.0
                return self._ambiguity
            rng = np.random.default_rng(0)
            w = self.winding(rng.uniform(self.mesh.lower, self.mesh.upper, (AMBIGUITY_POINTS, 3)))
            if not np.any(w >= 0.5):
                # Thin pieces fall through such a net: a hair below their triangles
                which = rng.integers(len(self.mesh.faces), size=4096)
                depth = 1e-3 * np.sqrt(self.mesh.areas[which])[:, None]
                below = self.mesh.corners[which].mean(axis=1) - depth * self.mesh.normals[which]
                if not np.any(self.winding(below) >= 0.5 + AMBIGUOUS):
                    raise DistancesError(f"{self.mesh.path}: encloses no volume, expected the surface of a solid")
            off = np.abs(w - np.round(w)) > AMBIGUOUS
            self._ambiguity = float(off.mean()), float((np.abs(w - 0.5) < 0.25).mean())
        return self._ambiguity

    # -- the process --------------------------------------------------------------------------------------------------

    def _ask(self, question: str, points, answer: dict) -> dict[str, np.ndarray]:
        """The ``answer`` (name → type and shape of one) of all points, chunk by chunk."""
        points = _checked(points)
        found = {name: np.empty((len(points), *shape), dtype) for name, (dtype, shape) in answer.items()}
        for first in range(0, len(points), CHUNK):
            part = slice(first, min(first + CHUNK, len(points)))
            for name, value in self._request(question, {"points": points[part]}).items():
                found[name][part] = value
        return found

    def _request(self, name: str, arrays: dict) -> dict:
        if self._child is None:
            self._start()
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
        script = Path(__file__).with_name("distances_child.py")
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115
        self._child = subprocess.Popen(
            [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, map(os.path.abspath, sys.path)))},
        )  # fmt: skip
        faces = np.ascontiguousarray(self.mesh.faces, dtype=np.int64)
        self._request("mesh", {"vertices": np.ascontiguousarray(self.mesh.vertices), "faces": faces})

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
