"""
The process in which libigl runs: a script of its own, since some meshes make libigl abort the process that it runs in.

It reads requests from standard input and writes answers to standard output until its input ends, and imports NumPy and
libigl only. A message is one line of JSON, a list of ``[name, dtype, shape]`` after the name of a request, and then the
bytes of these arrays. A name is a question and, after a space, which mesh it is about.
"""

import contextlib
import json
import os
import signal
import sys


def write(stream, name, arrays):
    """One message: its ``name`` and a dict of arrays."""
    head = [name, [[key, a.dtype.str, list(a.shape)] for key, a in arrays.items()]]
    stream.write(json.dumps(head).encode() + b"\n")
    for a in arrays.values():
        stream.write(memoryview(a).cast("B") if a.size else b"")
    stream.flush()


def read(stream):
    """The name and the arrays of the next message, ``None`` if there is none."""
    import numpy as np

    line = stream.readline()
    if not line.endswith(b"\n"):
        return None
    name, heads = json.loads(line)
    arrays = {}
    for key, dtype, shape in heads:
        a = np.empty(shape, dtype)
        view = memoryview(a).cast("B") if a.size else memoryview(bytearray())
        while len(view):
            count = stream.readinto(view)
            if not count:
                return None
            view = view[count:]
        arrays[key] = a
    return name, arrays


class Queries:
    """What libigl is asked for, of one mesh. The trees are built when they are needed."""

    #: Accuracies of the fast winding number, and how near to a half its values are doubtful: those are found once more
    #: with the next accuracy, in the end exactly. The largest errors that were seen are 0.23 and 0.013; the exact
    #: number takes ten times as long. Of a watertight mesh, whose winding numbers are whole ones, less is in doubt.
    ACCURACIES = ((1.0, 0.3), (2.0, 0.05))
    WHOLE = ((1.0, 0.15), (2.0, 0.05))

    def __init__(self, vertices, faces, watertight):
        import igl

        self.igl, self.vertices, self.faces = igl, vertices, faces
        self.accuracies = self.WHOLE if watertight else self.ACCURACIES
        self.tree = self.hierarchy = None

    def nearest(self, points):
        import numpy as np

        if self.tree is None:
            self.tree = self.igl.AABB()
            self.tree.init(self.vertices, self.faces)
        order = spatial_order(points)
        found = self.tree.squared_distance(self.vertices, self.faces, np.ascontiguousarray(points[order]))
        distance, face, closest = np.empty(len(points)), np.empty(len(points), np.int32), np.empty_like(points)
        distance[order], face[order], closest[order] = np.sqrt(np.maximum(found[0], 0)), found[1], found[2]
        return {"distance": distance, "face": face, "closest": closest}

    def distance(self, points):
        return {"distance": self.nearest(points)["distance"]}

    def winding(self, points):
        return {"winding": self._windings(points, self.ACCURACIES[-1:])}

    def inside(self, points):
        return {"inside": self._windings(points, self.accuracies) >= 0.5}

    def _windings(self, points, accuracies):
        import numpy as np

        if self.hierarchy is None:
            self.hierarchy = self.igl.FastWindingNumberBVH()
            self.hierarchy.init(self.vertices, self.faces)
        order = spatial_order(points)
        found = np.empty(len(points))
        for accuracy, doubt in accuracies:
            found[order] = self.hierarchy.winding_number(np.ascontiguousarray(points[order]), accuracy)
            order = order[np.abs(found[order] - 0.5) < doubt]
        if len(order):
            exact = self.igl.winding_number(self.vertices, self.faces, np.ascontiguousarray(points[order]))
            found[order] = np.reshape(exact, -1)
        return found


def spatial_order(points):
    """An order in which neighbours follow each other (Morton's), in which trees are searched twice as fast."""
    import numpy as np

    lower, upper = points.min(axis=0), points.max(axis=0)
    cells = ((points - lower) / max(float((upper - lower).max()), 1e-30) * 1023).astype(np.uint64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return np.argsort(cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2)), kind="stable")


def main():
    # Whoever is asked by Ctrl-C to stop is the parent, which ends this process; so does the end of the input
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What libigl prints must not come between the answers
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    requests = sys.stdin.buffer
    meshes = {}
    while (message := read(requests)) is not None:
        name, arrays = message
        try:
            question, _, mesh = name.partition(" ")
            if question == "mesh":
                meshes[mesh] = Queries(arrays["vertices"], arrays["faces"], bool(arrays["watertight"]))
                result = {}
            else:
                result = getattr(meshes[mesh], question)(arrays["points"])
        except Exception as e:
            name, result = f"error: {type(e).__name__}: {e}", {}
        write(answers, name, result)


if __name__ == "__main__":
    del sys.path[0]  # this folder, whose modules might take the place of others
    with contextlib.suppress(BrokenPipeError):
        main()
