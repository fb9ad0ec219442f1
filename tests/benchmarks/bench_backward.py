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

import math
import tempfile
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import ASSETS, ROOT, VARIANT, answer_passes, earlier, in_processes, parser, spread, write

import mi_diffind
from mi_diffind.core import compat
from mi_diffind.core.files import write_json
from mi_diffind.measure import clock

#: Pass → side of the film; samples a pixel, and those of tasks whose rays or textures make up for fewer.
SIDES, SPP, FEWER = {"render": 320, "step": 160}, 16, {"sdf": 4, "field": 4, "texture": 4}

#: Seconds of a training by the paper's recipe, and of one of a material of 4096² texels.
SECONDS, LARGE_SECONDS = 120, 30

#: First rounds, which compile kernels.
WARM = 2

DISNEY = {"base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}, "roughness": 0.4, "metallic": 0.3, "clearcoat": 0.5}
METAL = {"eta": {"type": "rgb", "value": [0.2, 0.9, 1.1]}, "k": {"type": "rgb", "value": [3.9, 2.4, 2.2]}, "alpha": 0.2}
CONDUCTOR = {"type": "roughconductor", "distribution": "ggx", **METAL}

#: Maps of the materials.
TILES = [f"tiles_{name}" for name in ("albedo", "normal", "roughness", "ao")]
RUST = [f"rust_{name}" for name in ("albedo", "normal", "roughness", "metallic")]

BITMAP = {"type": "bitmap", "filename": "tiles_albedo.png"}
BITMAPS = {
    "type": "normalmap", "normalmap": {"type": "bitmap", "filename": "rust_normal.png", "raw": True},
    "bsdf": {
        "type": "principled", "base_color": {"type": "bitmap", "filename": "rust_albedo.png"},
        **{name: {"type": "bitmap", "filename": f"rust_{name}.png", "raw": True} for name in ("roughness", "metallic")},
    },
}  # fmt: skip

#: Repetitions of textures on the plane.
REPEATS = 6


def learned(plugin: str, file: str, **more) -> dict:
    """Return a plugin that reads a table file; of images and textures, the albedo."""
    channels = {"channels": "albedo"} if plugin in ("neural_image", "neural_texture") else {}
    return {"type": plugin, "filename": file, **channels, **more}


#: Task → name of a contender → its plugin, with files of ``scenes/assets`` or of :func:`prepare`. The first contender
#: is what a user would take instead.
CONTENDERS = {
    "ggx": {
        "roughconductor": CONDUCTOR, "ours": {"type": "neural_ggx", **METAL},
        "paper": {"type": "neural_ggx", "preset": "paper", **METAL},
    },
    "disney": {
        **{name: {"type": name, **DISNEY} for name in ("principled", "disney")},
        "ours": {"type": "neural_disney", **DISNEY}, "paper": {"type": "neural_disney", "preset": "paper", **DISNEY},
    },
    "bsdf": {
        "roughconductor": CONDUCTOR, "ours": learned("neural_bsdf", "library/copper.npz"),
        "paper": learned("neural_bsdf", "bsdf_paper.npz"),
    },
    "image": {
        "bitmap": BITMAP, "ours": learned("neural_image", "tiles.npz"),
        "paper": learned("neural_image", "image_paper.npz"),
    },
    "large": {
        "bitmap": {"type": "bitmap", "filename": "large/albedo.png"},
        **{name: learned("neural_image", f"large_{name}.npz") for name in ("ours", "paper")},
    },
    "texture": {
        "bitmap": BITMAP, "mipmap": {"type": "mipmap", "filename": "tiles_albedo.png"},
        "ours": learned("neural_texture", "tiles_filtered.npz", filter="anisotropic"),
        "paper": learned("neural_texture", "texture_paper.npz"),
    },
    "shading": {
        "normalmap + principled + bitmaps": BITMAPS, "ours": learned("neural_material", "rust_shaded.npz"),
        "paper": learned("neural_material", "shading_paper.npz"),
    },
    "sdf": {
        "mesh": {"type": "ply", "filename": "suzanne.ply"},
        "sdfgrid": {"type": "sdfgrid", "normals": "smooth", "filename": "sdf_grid.npz"},
        **{name: learned("neural_sdf", f"sdf_{name}.npz", trace="arrays") for name in ("ours", "paper")},
    },
    "field": {name: learned("neural_field", f"field_{name}.npz") for name in ("grid", "ours", "paper")},
}  # fmt: skip


def place(file: str, folder: Path) -> Path:
    """Return the path of a file of ``scenes/assets`` or of the folder of :func:`prepare`."""
    return ASSETS / file if (ASSETS / file).is_file() else folder / file


def described(plugin: dict, storage: str, folder: Path) -> dict:
    """Return a plugin for ``mi.load_dict``: paths of files, storage, repetitions of textures, and those within it."""
    plugin = {key: described(value, storage, folder) if isinstance(value, dict) else value
              for key, value in plugin.items()}  # fmt: skip
    kind = plugin["type"]
    if kind == "sdfgrid":
        return {"type": kind, "normals": plugin["normals"], **grid_of(place(plugin["filename"], folder))}
    if "filename" in plugin:
        plugin["filename"] = str(place(plugin["filename"], folder))
    if kind == "bitmap" and storage == "float32":
        plugin["format"] = "variant"  # only a bitmap in the variant's precision can be optimised
    if kind in ("neural_image", "neural_texture", "neural_material", "neural_sdf", "neural_field"):
        plugin["storage"] = "float32" if plugin["filename"].endswith("field_grid.npz") else storage
    if kind in ("bitmap", "mipmap", "neural_image", "neural_texture", "neural_material"):
        plugin["to_uv"] = mi.ScalarTransform3f().scale(REPEATS)
    return plugin


def parts(task: str, contender: str, storage: str, folder: Path) -> dict:
    """Return the parts of the scene of a contender: a ball or a plane of its material, a shape, or an integrator."""
    plugin = described(CONTENDERS[task][contender], storage, folder)
    if task in ("ggx", "disney", "bsdf"):
        return {"shape": {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.8, "bsdf": plugin}}
    if task in ("sdf", "field"):
        return {"shape" if task == "sdf" else "integrator": plugin}
    bsdf = plugin if task == "shading" else {"type": "diffuse", "reflectance": plugin}
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    return {"shape": {"type": "rectangle", "to_world": turn, "bsdf": bsdf}}


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

    mesh = load_mesh(str(ASSETS / "suzanne.ply"))
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
    from mi_diffind.tasks.sdf.distances import Distances, sample_surface
    from mi_diffind.tasks.sdf.mesh import load_mesh

    mesh = load_mesh(str(ASSETS / "suzanne.ply"))
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


def sizes(task: str, folder: Path) -> dict[str, dict]:
    """Return the bytes of the contenders of a task in memory and on disk; meshes and images as they are stored."""
    if task == "large":
        return {}
    storages = {"field": "", "ggx": "float32"}
    result = {name: {"memory": 0, "disk": 0} for name in CONTENDERS[task] if task in ("ggx", "disney")}
    for name, plugin in CONTENDERS[task].items():
        if plugin["type"].startswith("neural_"):
            shipped = ROOT / "mi_diffind" / "data" / f"{task}_{plugin.get('preset', 'tables')}.npz"
            path = place(plugin["filename"], folder) if "filename" in plugin else shipped
            result[name] = file_sizes(path, storages.get(task, "uint8"))
    if task in ("image", "texture", "shading"):
        paths = [ASSETS / f"{name}.png" for name in (RUST if task == "shading" else TILES)]
        memory = sum(math.prod(np.array(mi.Bitmap(str(path))).shape) for path in paths)
        result[next(iter(CONTENDERS[task]))] = {"memory": memory, "disk": sum(path.stat().st_size for path in paths)}
    if task == "sdf":
        result["mesh"] = {"disk": (ASSETS / "suzanne.ply").stat().st_size}
        result["sdfgrid"] = {"memory": int(np.load(folder / "sdf_grid.npz")["values"].nbytes)}
    return result


def write_maps(folder: Path) -> Path:
    """Write the maps of a procedural material of 4096² texels and return their manifest."""
    folder.mkdir()
    maps = mi_diffind.example_maps("lacquer", 4096)
    for name, values in maps.items():
        mi.Bitmap(values if values.ndim == 3 else values[..., None]).write(str(folder / f"{name}.png"))
    manifest = folder / "material.json"
    write_json(manifest, {"maps": {name: f"{name}.png" for name in maps}})
    return manifest


def prepare(folder: Path, tasks: list[str]) -> None:
    """Write the files that the repository lacks to ``folder``."""

    def fitted(task, source, name, **options):
        print(f"fit {task}: {name}", flush=True)
        return mi_diffind.fit(task, source, progress=False, **options).save(folder / f"{name}.npz")

    if "bsdf" in tasks:
        fitted("bsdf", CONDUCTOR, "bsdf_paper", preset="paper")
    if "image" in tasks:
        fitted("image", str(ASSETS / "tiles.json"), "image_paper", preset="paper", seconds=SECONDS)
    if "large" in tasks:
        manifest = write_maps(folder / "large")
        for preset in ("ours", "paper"):
            options = {"preset": preset, "seconds": LARGE_SECONDS, "compression": 12}
            fitted("image", str(manifest), f"large_{preset}", **options)
    if "texture" in tasks:
        fitted("texture", str(ASSETS / "tiles.json"), "texture_paper", preset="paper", seconds=SECONDS)
    if "shading" in tasks:
        fitted("texture", str(ASSETS / "rust.json"), "shading_paper", preset="paper", seconds=SECONDS)
    if "sdf" in tasks:
        for preset, name in (("sparse", "sdf_ours"), ("paper", "sdf_paper")):
            fitted("sdf", str(ASSETS / "suzanne.ply"), name, preset=preset, bytes="1m")
        write_grid(folder / "sdf_grid.npz")
    if "field" in tasks:
        views = folder / "views"
        mi_diffind.capture(ROOT / "scenes" / "capture_group.xml", views, views=24, test=4, resolution=64, spp=16)
        grid = fitted("field", views, "field_grid", preset="grid", steps=200, resolution=64)
        for preset, name in (("sparse", "field_ours"), ("paper", "field_paper")):
            fitted("field", views, name, preset=preset, steps=20, resolution=64, grid=str(grid))


def scene(task: str, contender: str, size: str, folder: Path):
    """Return the scene of a contender."""
    eye, target = VIEWS.get(task, ([0, 2.2, 4.2], [0, 0.5, 0]))
    traced = CONTENDERS[task][contender]["type"] == "neural_sdf"
    many = (task, contender) == ("texture", "bitmap")
    side, spp = SIDES[size], SPP if many else FEWER.get(task, SPP)
    return mi_diffind.load_dict({
        "type": "scene", "integrator": {"type": "path_sdf" if traced else "prb", "max_depth": 3},
        "sensor": {
            "type": "perspective", "fov": 40,
            "sampler": {"type": "multijitter" if many else "independent", "sample_count": spp},
            "to_world": mi.ScalarTransform4f().look_at(eye, target, [0, 1, 0]),
            "film": {
                "type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb", "rfilter": {"type": "box"},
            },
        },
        "sky": {"type": "constant", "radiance": 0.6},
        "lamp": {"type": "point", "position": [2.0, 4.0, 3.0], "intensity": 20.0},
        **parts(task, contender, "float32" if size == "step" else "uint8", folder),
    })  # fmt: skip


def worker(contender: str, task: str, size: str, folder: str, pipe) -> None:
    """Process of one scene: send its parameters, then the times of passes."""
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
    answer_passes(pipe, run)


def measured(task: str, size: str, folder: Path, rounds: int) -> dict[str, dict]:
    """Return the milliseconds of a pass of each contender, and ratios to the first, by turns."""
    results = in_processes(worker, list(CONTENDERS[task]), rounds, task, size, str(folder))
    first = next(iter(results.values())).get("cpu_ms")
    for name, figures in results.items():
        if "error" in figures:
            print(task, size, name, figures, flush=True)
            continue
        cpu = figures["cpu_ms"]
        figures |= {"ms": spread(figures["ms"]), "cpu_ms": spread(cpu)}
        if first is not None:
            figures["ratio"] = spread(cpu / first)
    return results


def main() -> None:
    """Measure the tasks that are named, or all of them."""
    command = parser(__doc__, rounds=15)
    command.add_argument("tasks", nargs="*", metavar="TASK", help=", ".join(CONTENDERS))
    arguments = command.parse_args()
    if unknown := set(arguments.tasks) - set(CONTENDERS):
        command.error(f"unknown task {', '.join(sorted(unknown))}: allowed are {', '.join(CONTENDERS)}")
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    names = arguments.tasks or list(CONTENDERS)
    before = earlier(arguments.json, tasks={}, bytes={}, errors={})
    results, counted, errors = (before[key] for key in ("tasks", "bytes", "errors"))
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder), names)
        counted |= {task: sizes(task, Path(folder)) for task in names}
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
            write(arguments.json, {
                "machine": clock.machine(VARIANT), "rounds": arguments.rounds, "spp": SPP, "fewer": FEWER,
                "sides": SIDES, "bytes": counted, "errors": errors, "tasks": results,
            })  # fmt: skip


if __name__ == "__main__":
    main()
