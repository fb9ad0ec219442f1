"""Child process that runs libigl: a script of its own, since some meshes make libigl abort its process.

Requests arrive on standard input and answers leave on standard output, both as pickles, until the input ends. A request
is ``(question, name, argument)``: the question ``"mesh"`` registers the arrays of a mesh under a name; any other is a
method of :class:`MeshQueries` that is called with points. An answer is ``(None, arrays)`` or ``(error, None)``. The
script imports NumPy and libigl only.
"""

import contextlib
import os
import pickle
import signal
import sys


class MeshQueries:
    """Queries to libigl about one mesh; its search trees are built on first use."""

    #: Accuracies of the fast winding number, and the distance from 1/2 below which values are computed once more with
    #: the next accuracy, in the end exactly, which takes ten times as long. The largest errors observed are 0.23 and
    #: 0.013. Winding numbers of a watertight mesh are whole, so fewer are in doubt.
    ACCURACIES = ((1.0, 0.3), (2.0, 0.05))
    WATERTIGHT_ACCURACIES = ((1.0, 0.15), (2.0, 0.05))

    def __init__(self, vertices, faces, watertight):
        import igl

        self.igl, self.vertices, self.faces = igl, vertices, faces
        self.accuracies = self.WATERTIGHT_ACCURACIES if watertight else self.ACCURACIES
        self.tree = self.hierarchy = None

    def nearest(self, points):
        import numpy as np

        if self.tree is None:
            self.tree = self.igl.AABB()
            self.tree.init(self.vertices, self.faces)
        order = spatial_order(points)
        squared, faces, places = self.tree.squared_distance(
            self.vertices, self.faces, np.ascontiguousarray(points[order])
        )[:3]
        distance, face, closest = np.empty(len(points)), np.empty(len(points), np.int32), np.empty_like(points)
        distance[order], face[order], closest[order] = np.sqrt(np.maximum(squared, 0)), faces, places
        return distance, face, closest

    def distance(self, points):
        return self.nearest(points)[:1]

    def winding(self, points):
        return (self._windings(points, self.ACCURACIES[-1:]),)

    def inside(self, points):
        return (self._windings(points, self.accuracies) >= 0.5,)

    def _windings(self, points, accuracies):
        import numpy as np

        if self.hierarchy is None:
            self.hierarchy = self.igl.FastWindingNumberBVH()
            self.hierarchy.init(self.vertices, self.faces)
        order = spatial_order(points)
        winding = np.empty(len(points))
        for accuracy, doubt in accuracies:
            winding[order] = self.hierarchy.winding_number(np.ascontiguousarray(points[order]), accuracy)
            order = order[np.abs(winding[order] - 0.5) < doubt]
        if len(order):
            exact = self.igl.winding_number(self.vertices, self.faces, np.ascontiguousarray(points[order]))
            winding[order] = np.reshape(exact, -1)
        return winding


def spatial_order(points):
    """Return Morton's order of points: neighbours follow each other, and trees are searched twice as fast."""
    import numpy as np

    lower, upper = points.min(axis=0), points.max(axis=0)
    cells = ((points - lower) / max(float((upper - lower).max()), 1e-30) * 1023).astype(np.uint64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return np.argsort(cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2)), kind="stable")


def main():
    """Answer requests until the input ends."""
    # Ctrl-C is handled by the parent, which ends this process; the end of the input ends it, too
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Output of libigl must not mix with the answers
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    meshes = {}
    while True:
        question, name, argument = pickle.load(sys.stdin.buffer)
        try:
            if question == "mesh":
                meshes[name], arrays = MeshQueries(*argument), ()
            else:
                arrays = getattr(meshes[name], question)(argument)
            answer = None, arrays
        except Exception as e:
            answer = f"{type(e).__name__}: {e}", None
        pickle.dump(answer, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()


if __name__ == "__main__":
    del sys.path[0]  # modules of this folder might shadow others
    with contextlib.suppress(BrokenPipeError, EOFError):
        main()
