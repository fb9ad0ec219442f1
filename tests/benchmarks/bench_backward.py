"""
Time of a render, and of a render with its backward pass, of each task's plugin and of what a user would take instead.

    python tests/benchmarks/bench_backward.py [TASK …] [--rounds 15] [--json docs/measured/bench_backward.json]

A *render* has 320 × 320 pixels, with the storage that files have, a *step* 160 × 160: ``mi.render``, the mean squared
error against a grey picture, and ``dr.backward`` with respect to all parameters that can be optimised. For BSDFs, these
are the parameters of the counterpart; for the other tasks, they are the entries of the tables, of the bitmap, of the
grid, or the vertices of the mesh. Tables are then in single precision.

There are 16 samples a pixel; of solids, fields and filtered textures 4, beside a bitmap with 16 multijittered ones.
Times are those of the processor, on one core, and include the tracing of the kernel by Python, which takes
milliseconds. Contenders of a task run in turn; ratios are medians over the rounds of the ratio to the first contender
in the same round. Each contender has a process of its own, because Dr.Jit compiles the materials of all scenes that a
process holds into each kernel. Bytes are those of all maps of a file, in memory in the storage form that a plugin reads
by default, and on disk. Distance fields have 1 MiB and are trained by the whole recipe, because the steps of rays
depend on their entries. The grid of ``sdfgrid`` has the exact distances of the mesh; its error is the mean angle of its
normals where rays meet it. The paper's recipe for images and textures is trained for two minutes, which its bytes on
disk depend on. Materials of 4096² texels (``large``) and fields of a small capture are trained briefly: their times
depend on the arrays alone.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from bench_large_material import material

import mi_diffind
from mi_diffind.core import compat
from mi_diffind.core.files import write_json
from mi_diffind.measure import clock

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "scenes" / "assets"
VARIANT = "llvm_ad_rgb"

#: Pass → side of the film; samples a pixel, and those of tasks whose rays or textures make up for fewer.
SIDES, SPP, FEWER = {"render": 320, "step": 160}, 16, {"sdf": 4, "field": 4, "texture": 4}

#: Seconds of a training by the paper's recipe, and of one of a material of 4096² texels.
SECONDS, LARGE_SECONDS = 120, 30

#: First rounds, which compile kernels.
WARM = 2

DISNEY = {"base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}, "roughness": 0.4, "metallic": 0.3, "clearcoat": 0.5}
METAL = {"eta": {"type": "rgb", "value": [0.2, 0.9, 1.1]}, "k": {"type": "rgb", "value": [3.9, 2.4, 2.2]}, "alpha": 0.2}

#: Maps of the material rust.
RUST = ("albedo", "normal", "roughness", "metallic")

#: Repetitions of textures on the plane.
REPEATS = 6


def asset(name: str) -> str:
    """Return the path of a file of the repository's scenes."""
    return str(ASSETS / name)


def on_ball(bsdf: dict, **_) -> dict:
    """Return the parts of a scene with a ball of a material."""
    return {"shape": {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.8, "bsdf": bsdf}}


def on_plane(texture: dict, bsdf: str = "diffuse", **_) -> dict:
    """Return the parts of a scene with a plane of a textured material."""
    material = {"type": "diffuse", "reflectance": texture} if bsdf == "diffuse" else texture
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    return {"shape": {"type": "rectangle", "to_world": turn, "bsdf": material}}


def repeated(plugin: dict) -> dict:
    """Return a texture or material that is repeated on the plane."""
    return {**plugin, "to_uv": mi.ScalarTransform3f().scale(REPEATS)}


def bitmap(file: str, storage: str, raw: bool = False) -> dict:
    """Return Mitsuba's ``bitmap``; only one in the variant's precision can be optimised."""
    precision = {"format": "variant"} if storage == "float32" else {}
    return repeated({"type": "bitmap", "filename": asset(file), "raw": raw, **precision})


def rust_bitmaps(storage: str) -> dict:
    """Return Mitsuba's material of the maps of rust."""
    maps = {name: bitmap(f"rust_{name}.png", storage, name != "albedo") for name in RUST}

    parameters = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}
    nested = {"type": "principled", **{parameter: maps[name] for parameter, name in parameters.items()}}
    return {"type": "normalmap", "normalmap": maps["normal"], "bsdf": nested}


def sdf_mesh() -> dict:
    """Return Suzanne as a mesh."""
    return {"shape": {"type": "ply", "filename": asset("suzanne.ply")}}


def field(name: str, storage: str, folder: Path) -> dict:
    """Return the integrator of a radiance field."""
    return {"integrator": {"type": "neural_field", "filename": str(folder / f"field_{name}.npz"), "storage": storage}}


def learned_image(filename, storage: str) -> dict:
    """Return the albedo of a file of the task ``image``."""
    return repeated({"type": "neural_image", "filename": str(filename), "channels": "albedo", "storage": storage})


#: Task → name of a contender → parts of its scene, of ``storage`` and ``folder`` (the files of :func:`prepare`). The
#: first contender is what a user would take instead. ``keys``: parameters of the step, a pattern.
CONTENDERS = {
    "ggx": {
        "roughconductor": lambda **_: on_ball({"type": "roughconductor", "distribution": "ggx", **METAL}),
        "ours": lambda **_: on_ball({"type": "neural_ggx", **METAL}),
        "paper": lambda **_: on_ball({"type": "neural_ggx", "preset": "paper", **METAL}),
    },
    "disney": {
        "principled": lambda **_: on_ball({"type": "principled", **DISNEY}),
        "disney": lambda **_: on_ball({"type": "disney", **DISNEY}),
        "ours": lambda **_: on_ball({"type": "neural_disney", **DISNEY}),
        "paper": lambda **_: on_ball({"type": "neural_disney", "preset": "paper", **DISNEY}),
    },
    "bsdf": {
        "roughconductor": lambda **_: on_ball({"type": "roughconductor", "distribution": "ggx", **METAL}),
        "ours": lambda **_: on_ball({"type": "neural_bsdf", "filename": asset("library/copper.npz")}),
        "paper": lambda folder, **_: on_ball({"type": "neural_bsdf", "filename": str(folder / "bsdf_paper.npz")}),
    },
    "image": {
        "bitmap": lambda storage, **_: on_plane(bitmap("tiles_albedo.png", storage)),
        "ours": lambda storage, **_: on_plane(learned_image(asset("tiles.npz"), storage)),
        "paper": lambda storage, folder: on_plane(learned_image(folder / "image_paper.npz", storage)),
    },
    "large": {
        "bitmap": lambda storage, folder: on_plane(bitmap(str(folder / "large" / "albedo.png"), storage)),
        "ours": lambda storage, folder: on_plane(learned_image(folder / "large_ours.npz", storage)),
        "paper": lambda storage, folder: on_plane(learned_image(folder / "large_paper.npz", storage)),
    },
    "texture": {
        "bitmap": lambda storage, **_: {
            **on_plane(bitmap("tiles_albedo.png", storage)), "spp": SPP, "sampler": "multijitter",
        },
        "mipmap": lambda **_: on_plane(repeated({"type": "mipmap", "filename": asset("tiles_albedo.png")})),
        "ours": lambda storage, **_: on_plane(
            repeated({"type": "neural_texture", "filename": asset("tiles_filtered.npz"), "channels": "albedo",
                      "storage": storage, "filter": "anisotropic"})
        ),
        "paper": lambda storage, folder: on_plane(
            repeated({"type": "neural_texture", "filename": str(folder / "texture_paper.npz"), "channels": "albedo",
                      "storage": storage})
        ),
    },
    "shading": {
        "normalmap + principled + bitmaps": lambda storage, **_: on_plane(rust_bitmaps(storage), "material"),
        "ours": lambda storage, **_: on_plane(
            repeated({"type": "neural_material", "filename": asset("rust_shaded.npz"), "storage": storage}), "material"
        ),
        "paper": lambda storage, folder: on_plane(
            repeated({"type": "neural_material", "filename": str(folder / "shading_paper.npz"), "storage": storage}),
            "material",
        ),
    },
    "sdf": {
        "mesh": lambda **_: sdf_mesh(),
        "sdfgrid": lambda folder, **_: {
            "shape": {"type": "sdfgrid", "normals": "smooth", **grid_of(folder / "sdf_grid.npz")}
        },
        "ours": lambda storage, folder: {
            "shape": {"type": "neural_sdf", "filename": str(folder / "sdf_ours.npz"), "storage": storage,
                      "trace": "arrays"},
            "traced": True,
        },
        "paper": lambda storage, folder: {
            "shape": {"type": "neural_sdf", "filename": str(folder / "sdf_paper.npz"), "storage": storage,
                      "trace": "arrays"},
            "traced": True,
        },
    },
    "field": {
        "grid": lambda folder, **_: field("grid", "float32", folder),
        "ours": lambda storage, folder: field("ours", storage, folder),
        "paper": lambda storage, folder: field("paper", storage, folder),
    },
}  # fmt: skip

#: Task → pattern of the parameters of a step.
KEYS = {
    "ggx": r"shape\.bsdf\.(alpha|eta|k)\b.*", "disney": r"shape\.bsdf\.(?!tables).*",
    "bsdf": r"shape\.bsdf\.(?!tables).*",
    **dict.fromkeys(("image", "large"), r"shape\.bsdf\..*(data|tables\..*)"),
    "texture": r"shape\.bsdf\..*(data|levels.*|tables\..*)",
    "shading": r"shape\.bsdf\..*(data|tables\..*)",
    "sdf": r"shape\.(grid|vertex_positions|tables\..*)",
    "field": r"integrator\..*tables\..*",
}  # fmt: skip

#: Task → place of the camera and its target. Balls and the distance field fill the picture, planes three quarters.
VIEWS = {
    **dict.fromkeys(("ggx", "disney", "bsdf"), ([0, 1.5, 2.1], [0, 0.8, 0])),
    "sdf": ([0.8, 1.1, 2.7], [0, 0.67, 0]),
    "field": ([2.6, 2.6, 5.6], [0, 0.85, 0]),
}

#: Cells of ``sdfgrid`` along the longest side.
CELLS = 128


def grid_of(path: Path) -> dict:
    """Return the grid of Suzanne's distances for ``sdfgrid``, and its place."""
    stored = np.load(path)
    lower, size = stored["lower"], stored["upper"] - stored["lower"]
    to_world = mi.ScalarTransform4f().translate(lower.tolist()).scale(size.tolist())
    return {"grid": mi.TensorXf(stored["values"]), "to_world": to_world}


def write_grid(path: Path) -> None:
    """Write the exact distances of Suzanne for ``sdfgrid``, and the place of the grid."""
    from mi_diffind.plugins.support.distance_shapes import crop_grid
    from mi_diffind.tasks.sdf.distances import Distances
    from mi_diffind.tasks.sdf.mesh import load_mesh

    mesh = load_mesh(asset("suzanne.ply"))
    spacing = float((mesh.upper - mesh.lower).max()) / CELLS
    lower = mesh.lower - 3 * spacing
    counts = np.ceil((mesh.upper - lower) / spacing).astype(int) + 4
    z, y, x = np.meshgrid(*(np.arange(n) for n in counts[::-1]), indexing="ij")
    points = lower + spacing * np.stack([x, y, z], -1).reshape(-1, 3)
    values = Distances(mesh).signed(points).reshape(x.shape)
    values, lower, upper = crop_grid(values, lower, spacing)
    lower, upper = (np.array(mesh.centre) + mesh.scale * corner for corner in (lower, upper))
    values = values[..., None] * mesh.scale
    np.savez(path, values=values.astype(np.float32), lower=lower, upper=upper)


def grid_error(path: Path, normal: str = "smooth", count: int = 2**18) -> float:
    """Return the mean angle, in degrees, of the normals of ``sdfgrid`` from the mesh's, where rays meet both."""
    from mi_diffind.tasks.sdf.distances import Distances
    from mi_diffind.tasks.sdf.mesh import load_mesh
    from mi_diffind.tasks.sdf.sampling import sample_surface

    mesh = load_mesh(asset("suzanne.ply"))
    points, normals = sample_surface(Distances(mesh).surface, count, 1)
    shape = {"type": "sdfgrid", "normals": normal, **grid_of(path)}
    scene = mi.load_dict({"type": "scene", "shape": shape})
    points = points * mesh.scale + np.array(mesh.centre) + 0.01 * mesh.scale * normals
    vectors = [mi.Vector3f(*(np.ascontiguousarray(v, np.float32) for v in a.T)) for a in (points, -normals)]
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(vectors[0]), vectors[1]))
    met = np.array(si.is_valid()) & (np.array(si.t) < 0.02 * mesh.scale)
    cosine = np.sum(np.array(si.sh_frame.n).T * normals, axis=1)[met]
    print(f"sdfgrid: {met.mean():.1%} of the rays meet it", flush=True)
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean())


def file_sizes(path: Path, storage: str = "uint8") -> dict[str, int]:
    """Return the bytes of a table file, and of its arrays in memory in the storage form of its plugin."""
    model = mi_diffind.open(path, storage)
    return {"memory": model.memory_nbytes, "disk": path.stat().st_size}


def sizes(folder: Path, tasks: list[str]) -> dict[str, dict]:
    """Return the bytes of the contenders in memory and on disk, by task; meshes and images as they are stored."""

    def bitmaps(names) -> dict:
        paths = [ASSETS / f"{name}.png" for name in names]
        arrays = [mi.Bitmap(str(path)) for path in paths]
        memory = sum(math.prod(np.array(a).shape) for a in arrays)
        return {"memory": memory, "disk": sum(path.stat().st_size for path in paths)}

    def shipped(name, storage: str) -> dict:
        return file_sizes(ROOT / "mi_diffind" / "data" / f"{name}.npz", storage)

    nothing = {"memory": 0, "disk": 0}

    def files(ours: Path, paper: str, **theirs) -> dict:
        return {**theirs, "ours": file_sizes(ours), "paper": file_sizes(folder / paper)}

    tiles = [f"tiles_{name}" for name in ("albedo", "normal", "roughness", "ao")]
    maps = {"normalmap + principled + bitmaps": [f"rust_{name}" for name in RUST]}
    of_task = {
        "ggx": lambda: {
            "roughconductor": nothing,
            "ours": shipped("ggx_tables", "float32"),
            "paper": shipped("ggx_paper", "float32"),
        },
        "disney": lambda: {
            **dict.fromkeys(("principled", "disney"), nothing),
            "ours": shipped("disney_tables", "uint8"),
            "paper": shipped("disney_paper", "uint8"),
        },
        "bsdf": lambda: files(ASSETS / "library" / "copper.npz", "bsdf_paper.npz"),
        "image": lambda: files(ASSETS / "tiles.npz", "image_paper.npz", bitmap=bitmaps(tiles)),
        "large": dict,
        "texture": lambda: files(ASSETS / "tiles_filtered.npz", "texture_paper.npz", bitmap=bitmaps(tiles)),
        "shading": lambda: files(
            ASSETS / "rust_shaded.npz", "shading_paper.npz", **{name: bitmaps(maps[name]) for name in maps}
        ),
        "sdf": lambda: files(
            folder / "sdf_ours.npz", "sdf_paper.npz", mesh={"disk": (ASSETS / "suzanne.ply").stat().st_size},
            sdfgrid={"memory": int(np.load(folder / "sdf_grid.npz")["values"].nbytes)},
        ),
        "field": lambda: {name: file_sizes(folder / f"field_{name}.npz", "") for name in ("grid", "ours", "paper")},
    }  # fmt: skip
    return {task: of_task[task]() for task in tasks}


def prepare(folder: Path, tasks: list[str]) -> None:
    """Write the files that the repository lacks to ``folder``."""

    def fitted(task, source, name, **options):
        print(f"fit {task}: {name}", flush=True)
        return mi_diffind.fit(task, source, progress=False, **options).save(folder / f"{name}.npz")

    if "bsdf" in tasks:
        fitted("bsdf", {"type": "roughconductor", "distribution": "ggx", **METAL}, "bsdf_paper", preset="paper")
    if "image" in tasks:
        fitted("image", asset("tiles.json"), "image_paper", preset="paper", seconds=SECONDS)
    if "large" in tasks:
        manifest = material(folder / "large", "lacquer", 4096)
        for preset in ("ours", "paper"):
            options = {"preset": preset, "seconds": LARGE_SECONDS, "compression": 12}
            fitted("image", str(manifest), f"large_{preset}", **options)
    if "texture" in tasks:
        fitted("texture", asset("tiles.json"), "texture_paper", preset="paper", seconds=SECONDS)
    if "shading" in tasks:
        fitted("texture", asset("rust.json"), "shading_paper", preset="paper", seconds=SECONDS)
    if "sdf" in tasks:
        for preset, name in (("sparse", "sdf_ours"), ("paper", "sdf_paper")):
            fitted("sdf", asset("suzanne.ply"), name, preset=preset, bytes="1m")
        write_grid(folder / "sdf_grid.npz")
    if "field" in tasks:
        views = folder / "views"
        mi_diffind.capture(ROOT / "scenes" / "capture_group.xml", views, views=24, test=4, resolution=64, spp=16)
        grid = fitted("field", views, "field_grid", preset="grid", steps=200, resolution=64)
        for preset, name in (("sparse", "field_ours"), ("paper", "field_paper")):
            fitted("field", views, name, preset=preset, steps=20, resolution=64, grid=str(grid))


def scene(task: str, contender: str, size: str, folder: Path):
    """Return the scene of a contender."""
    parts = CONTENDERS[task][contender](storage="float32" if size == "step" else "uint8", folder=folder)
    eye, target = VIEWS.get(task, ([0, 2.2, 4.2], [0, 0.5, 0]))
    integrator = {"type": "path_sdf" if parts.pop("traced", False) else "prb", "max_depth": 3}
    side, spp, sampler = SIDES[size], parts.pop("spp", FEWER.get(task, SPP)), parts.pop("sampler", "independent")
    return mi_diffind.load_dict({
        "type": "scene", "integrator": integrator,
        "sensor": {
            "type": "perspective", "fov": 40, "sampler": {"type": sampler, "sample_count": spp},
            "to_world": mi.ScalarTransform4f().look_at(eye, target, [0, 1, 0]),
            "film": {
                "type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb", "rfilter": {"type": "box"},
            },
        },
        "sky": {"type": "constant", "radiance": 0.6},
        "lamp": {"type": "point", "position": [2.0, 4.0, 3.0], "intensity": 20.0},
        **parts,
    })  # fmt: skip


def worker(task: str, contender: str, size: str, folder: str, pipe) -> None:
    """Process of one scene: send its parameters, then the seconds of a pass for each seed received."""
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    compat.use_threads(1)
    try:
        loaded = scene(task, contender, size, Path(folder))
        parameters = mi.traverse(loaded)
        parameters.keep([KEYS[task]])
        keys = [k for k in parameters.keys() if dr.is_diff_v(parameters[k]) and dr.is_float_v(dr.leaf_t(parameters[k]))]

        def run(seed):
            if size == "render":
                return mi.render(loaded, seed=seed)
            for key in keys:
                dr.enable_grad(parameters[key])
                dr.set_grad(parameters[key], 0)
            parameters.update()
            image = mi.render(loaded, parameters, seed=seed, seed_grad=seed + 10_000)
            dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
            return [parameters[key].grad for key in keys]

        for i in range(WARM):
            gradients = run(dr.opaque(mi.UInt32, i))
            dr.eval(gradients)
        numbers = [float(np.abs(np.array(g)).max()) for g in gradients] if size == "step" else []
        pipe.send({"parameters": sum(0 < g < float("inf") for g in numbers), "exposed": len(keys)})
    except Exception as error:  # the reason is reported, and the task goes on without this contender
        pipe.send({"error": compat.one_sentence(error) if isinstance(error, RuntimeError) else repr(error)})
        return
    while (i := pipe.recv()) is not None:
        seed = dr.opaque(mi.UInt32, i)
        dr.sync_thread()
        start, start_cpu = time.perf_counter(), time.process_time()
        dr.eval(run(seed))
        dr.sync_thread()
        pipe.send((1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - start_cpu)))


def spread(values) -> dict:
    """Return the median and the quartiles."""
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75))
    return {"median": float(median), "q1": float(low), "q3": float(high)}


def measured(task: str, size: str, folder: Path, rounds: int) -> dict[str, dict]:
    """Return the milliseconds of a pass of each contender, and ratios to the first, by turns."""
    context, pipes, results, times = multiprocessing.get_context("spawn"), {}, {}, {}
    for name in CONTENDERS[task]:
        pipe, other = context.Pipe()
        context.Process(target=worker, args=(task, name, size, str(folder), other), daemon=True).start()
        results[name] = pipe.recv()
        if "error" in results[name]:
            print(task, size, name, results[name], flush=True)
        else:
            pipes[name], times[name] = pipe, []
    for i in range(rounds):
        for name in pipes if i % 2 == 0 else reversed(pipes):
            pipes[name].send(WARM + i)
            times[name].append(pipes[name].recv())
    for pipe in pipes.values():
        pipe.send(None)
    cpu = {name: np.array(both)[:, 1] for name, both in times.items()}
    first = next(iter(CONTENDERS[task]))
    for name, both in times.items():
        results[name] |= {"ms": spread(np.array(both)[:, 0]), "cpu_ms": spread(cpu[name])}
        if first in cpu:
            results[name]["ratio"] = spread(cpu[name] / cpu[first])
    return results


def main() -> None:
    """Measure the tasks that are named, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=", ".join(CONTENDERS))
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--json", help="file to write; tasks that it holds already and that are not named stay")
    arguments = parser.parse_args()
    unknown = set(arguments.tasks) - set(CONTENDERS)
    if unknown:
        parser.error(f"unknown task {', '.join(sorted(unknown))}: allowed are {', '.join(CONTENDERS)}")
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    names = arguments.tasks or list(CONTENDERS)
    kept = Path(arguments.json) if arguments.json else None
    before = json.loads(kept.read_text(encoding="utf-8")) if kept and kept.is_file() else {}
    results, counted, errors = (before.get(key, {}) for key in ("tasks", "bytes", "errors"))
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder), names)
        counted |= sizes(Path(folder), names)
        if "sdf" in names:
            errors["sdfgrid"] = grid_error(Path(folder) / "sdf_grid.npz")
        for task in names:
            results[task] = {}
            for size in SIDES:
                results[task][size] = measured(task, size, Path(folder), arguments.rounds)
                for name, figures in results[task][size].items():
                    if "ratio" in figures:
                        shown = {key: round(figures[key]["median"], 2) for key in ("ms", "cpu_ms", "ratio")}
                        print(task, size, name, shown, figures["parameters"], "of", figures["exposed"], flush=True)
            if kept:
                write_json(kept, {
                    "machine": clock.machine(VARIANT), "rounds": arguments.rounds, "spp": SPP, "fewer": FEWER,
                    "sides": SIDES, "bytes": counted, "errors": errors, "tasks": results,
                })  # fmt: skip


if __name__ == "__main__":
    main()
