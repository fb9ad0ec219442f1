"""
A ray through the arrays of a signed distance field, beside Embree on its mesh and Mitsuba's ``sdfgrid``.

    mi-diffind fit sdf armadillo.off -o armadillo.npz
    python tests/benchmarks/bench_sdf.py armadillo.npz [--grid 256] [--threads 1]

Primary rays of a camera (512², coherent) and random ones through the box; the median of interleaved runs, in
nanoseconds a ray, and the median of the ratios to Embree. The mesh has to be where it was when it was fitted.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import drjit as dr
import numpy as np

import mi_diffind  # noqa: F401

SIDE = 512


def rays(mi, kind: str):
    """Origins and directions in the unit frame."""
    count = SIDE * SIDE
    if kind == "primary":
        at = mi.ScalarTransform4f().look_at([0.9, 0.5, 1.3], [0, 0, 0], [0, 1, 0])
        film = {"type": "hdrfilm", "width": SIDE, "height": SIDE}
        sensor = mi.load_dict({"type": "perspective", "fov": 40, "to_world": at, "film": film})
        i = dr.arange(mi.UInt32, count)
        place = (mi.Point2f(i % SIDE, i // SIDE) + 0.5) / SIDE
        ray, _ = sensor.sample_ray(0, 0, place, mi.Point2f(0.5))
        found = mi.Point3f(ray.o), mi.Vector3f(ray.d)
    else:
        rng = np.random.default_rng(1)
        start, end = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, count, 3)))
        o = 0.8 * start
        d = 0.3 * end - o
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        found = mi.Point3f(np.float32(o.T)), mi.Vector3f(np.float32(d.T))
    dr.eval(found)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument(
        "--grid", type=int, default=256, help="cells of sdfgrid along the longest side; 0: leave it out"
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=11)
    arguments = parser.parse_args()

    import mitsuba as mi
    import trimesh

    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(arguments.threads)
    from mi_diffind.tasks.sdf import TASK, decode, tracing
    from mi_diffind.tasks.sdf.mesh import load_mesh

    model = TASK.open(mi.TensorXf, arguments.file)
    settings = model.table.settings
    mesh = load_mesh(arguments.file.resolve().parent / settings["mesh_path"])
    ply = Path(f"{arguments.file}.bench.ply")
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(ply)
    shapes = {"Embree, the mesh": {"type": "ply", "filename": str(ply)}}
    if arguments.grid:
        values, lower, _ = decode.grid(model.field, arguments.grid)
        side = max(values.shape)
        values = np.pad(values, [(0, side - n) for n in values.shape], constant_values=values.max())
        size = (model.field.upper[0] - model.field.lower[0]) / max(
            1, round((model.field.upper[0] - model.field.lower[0]) / (max(
                b - a for a, b in zip(model.field.lower, model.field.upper, strict=True)) / arguments.grid))
        )  # fmt: skip
        box = mi.ScalarTransform4f().translate(lower.tolist()).scale(size * (side - 1))
        grid = mi.TensorXf(np.ascontiguousarray(values[..., None]))
        shapes[f"sdfgrid, {arguments.grid}"] = {"type": "sdfgrid", "grid": grid, "to_world": box}
    scenes = {name: mi.load_dict({"type": "scene", "shape": shape}) for name, shape in shapes.items()}
    ply.unlink()

    def native(scene):
        def run(o, d, coherent):
            found = scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=coherent)
            return found.t, found.is_valid()

        return run

    runs = {name: native(scene) for name, scene in scenes.items()}
    runs["the arrays"] = lambda o, d, coherent: tracing.trace(model.field, o, d, dr.inf)
    print(f"{arguments.file.name}: {model.nbytes:,} bytes, and {tracing.index_of(model.field):,} to find the way")
    for kind in ("primary", "random"):
        o, d = rays(mi, kind)
        times, hits = {name: [] for name in runs}, {}
        for _ in range(arguments.rounds + 2):
            for name, run in runs.items():
                start = time.perf_counter()
                t, found = run(o, d, kind == "primary")
                dr.eval(t, found)
                dr.sync_thread()
                times[name].append(time.perf_counter() - start)
                hits[name] = np.array(found)
        first = times["Embree, the mesh"][2:]
        for name, values in times.items():
            ratio = statistics.median(b / a for a, b in zip(first, values[2:], strict=True))
            differ = 100 * (hits[name] != hits["Embree, the mesh"]).mean()
            ns = 1e9 * statistics.median(values[2:]) / SIDE**2
            print(f"{kind:9}{name:18}{ns:>8.0f} ns a ray{ratio:>7.2f}x{differ:>9.3f}% of hits differ")


if __name__ == "__main__":
    main()
