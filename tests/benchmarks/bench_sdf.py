"""A ray through the arrays of signed distance fields, beside Embree on their meshes and Mitsuba's ``sdfgrid``:

    mi-diffind fit sdf armadillo.off -o out/armadillo.npz
    python tests/benchmarks/bench_sdf.py out/armadillo.npz --json docs/measured/bench_sdf.json

Of several files, one after the other.

Primary rays of a camera (512², coherent) and random ones through the box: the median of interleaved runs of the
kernels, in nanoseconds a ray, and the median of the ratios to Embree. Meshes have to be where they were when they were
fitted.
"""

import functools
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import VARIANT, against, by_turns, parser, write

import mi_diffind  # noqa: F401
from mi_diffind.measure.clock import machine, timed
from mi_diffind.studies.sdf import camera_rays, grid_scene, mesh_scene
from mi_diffind.tasks.sdf import TASK, marching
from mi_diffind.tasks.sdf.mesh import load_mesh

SIDE = 512

#: Names of rows: the mesh, which ratios refer to; ``sdfgrid``; the field.
MESH, GRID, ARRAYS = "Embree, the mesh", "sdfgrid {}³", "the arrays"


def rays(ray_set: str):
    """Return origins and directions in the unit frame."""
    if ray_set == "primary":
        return camera_rays(SIDE * SIDE)
    rng = np.random.default_rng(1)
    start, end = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, SIDE * SIDE, 3)))
    o, d = 0.8 * start, 0.3 * end - 0.8 * start
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    result = mi.Point3f(np.float32(o.T)), mi.Vector3f(np.float32(d.T))
    dr.eval(result)
    return result


def measured(file: Path, resolution: int, rounds: int) -> dict:
    """Return the rows of one file, and its sizes."""
    model = TASK.open(mi.TensorXf, file)
    mesh = load_mesh(file.resolve().parent / model.table.settings["mesh_path"])
    scenes = {MESH: mesh_scene(mesh)}
    if resolution:
        scenes[GRID.format(resolution)] = grid_scene(model.field, resolution)

    def native(scene):
        def run(o, d, coherent):
            result = scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=coherent)
            return result.t, result.is_valid()

        return run

    runs = {name: native(scene) for name, scene in scenes.items()}
    runs[ARRAYS] = lambda o, d, coherent: marching.trace(model.field, o, d, dr.inf)
    rows = []
    for ray_set in ("primary", "random"):
        o, d = rays(ray_set)
        passes = {name: functools.partial(run, o, d, ray_set == "primary") for name, run in runs.items()}
        results = by_turns({name: functools.partial(timed, run) for name, run in passes.items()}, rounds, warm=2)
        seconds = {name: np.array(values) for name, values in results.items()}
        hits = {name: np.array(run()[1]) for name, run in passes.items()}
        for name, row in against(seconds, MESH, SIDE**2).items():
            differ = float((hits[name] != hits[MESH]).mean())
            rows.append({"rays": ray_set, "name": name, **row, "hits_differ": differ})
            print(json.dumps(rows[-1]), flush=True)
    return {
        "name": Path(model.table.settings["mesh_path"]).stem, "triangles": len(mesh.faces), "bytes": model.nbytes,
        "index_bytes": marching.index_bytes(model.field), "rows": rows,
    }  # fmt: skip


def main() -> None:
    command = parser(__doc__, rounds=11)
    command.add_argument("files", nargs="+", type=Path, metavar="FILE", help="as fit sdf made it; may be several")
    command.add_argument("--grid", type=int, default=256, help="cells of sdfgrid along the longest side; 0: none")
    command.add_argument("--threads", type=int, default=1)
    arguments = command.parse_args()
    mi.set_variant(VARIANT)
    dr.set_thread_count(arguments.threads)
    result = [measured(file, arguments.grid, arguments.rounds) for file in arguments.files]
    given = {"threads": arguments.threads, "rounds": arguments.rounds, "grid": arguments.grid}
    write(arguments.json, {**given, "machine": machine(mi.variant()), "files": result})


if __name__ == "__main__":
    main()
