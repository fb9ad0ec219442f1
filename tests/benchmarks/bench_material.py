"""
What a shaded pixel costs: one ``neural_material`` beside ``normalmap``, ``disney`` and a ``neural_texture`` for each
map of the same file, and beside bitmaps of its source. Interleaved passes: a frame of one sample a pixel; the same with
a film of 8 × 8 pixels, which is the time of everything but the kernel; and the operations of one lane of the kernel.
Ratios are those of passes that follow each other, to the second contender. Times of a processor (``cpu_ms``) depend
less on what else the machine does than those of a clock (``ms``); those of the small film are of the main thread. Last,
a step of a training inside the scene: a render by ``prb`` and its derivatives with respect to all arrays.

    python tests/benchmarks/bench_material.py [--rounds 21] [--json FILE]
"""

import time

import drjit as dr
import mitsuba as mi
from frame import ASSETS, VARIANT, answer_passes, in_processes, parser, spread, write

import mi_diffind
from mi_diffind.measure import clock

FILE = str(ASSETS / "rust_plain.npz")

#: Parameter of the BSDF → map of the file.
PARAMETERS = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}

#: Contender that ratios are to.
SEPARATE = "normalmap + disney + 4 neural_texture"

#: Width and height of the film.
SIZES = {"fixed": (8, 8), "frame": (960, 640), "step": (128, 128)}

#: The contenders (:func:`materials`).
NAMES = ("neural_material", SEPARATE, "normalmap + disney + 4 bitmap", "normalmap + principled + 4 bitmap")


def materials(scale: float, storage: str = "uint8") -> dict[str, dict]:
    """The BSDFs, all maps repeated ``scale`` times."""
    to_uv = mi.ScalarTransform4f().scale(scale)

    def nested(bsdf, texture):
        maps = {parameter: texture(name) for parameter, name in PARAMETERS.items()}
        return {"type": "normalmap", "normalmap": texture("normal"), "nested": {"type": bsdf, **maps}}

    def learned(name):
        return {"type": "neural_texture", "filename": FILE, "channels": name, "to_uv": to_uv, "storage": storage}

    def bitmap(name):
        raw = name != "albedo"
        return {"type": "bitmap", "filename": str(ASSETS / f"rust_{name}.png"), "raw": raw, "to_uv": to_uv}

    return {
        "neural_material": {"type": "neural_material", "filename": FILE, "to_uv": to_uv, "storage": storage},
        SEPARATE: nested("disney", learned),
        "normalmap + disney + 4 bitmap": nested("disney", bitmap),
        "normalmap + principled + 4 bitmap": nested("principled", bitmap),
    }


def scene(bsdf: dict, width: int, height: int, integrator: str = "path"):
    """A plate and a ball of one material, a sun and a sky."""
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    eye = at().look_at([0, 4.2, 7.5], [0, 0.35, 0.2], [0, 1, 0])
    return mi_diffind.load_dict({
        "type": "scene", "integrator": {"type": integrator, "max_depth": 3},
        "sensor": {
            "type": "perspective", "fov": 36, "to_world": eye, "film": film,
            "sampler": {"type": "independent", "sample_count": 1},
        },
        "sun": {"type": "directional", "irradiance": 3.0, "direction": [-0.55, -0.6, 0.35]},
        "sky": {"type": "constant", "radiance": 0.5},
        "material": {**bsdf, "id": "material"},
        "plate": {
            "type": "rectangle", "to_world": at().rotate([1, 0, 0], -90).scale(5),
            "bsdf": {"type": "ref", "id": "material"},
        },
        "ball": {
            "type": "sphere", "to_world": at().translate([0, 1, 0]).rotate([1, 0, 0], -90),
            "bsdf": {"type": "ref", "id": "material"},
        },
    })  # fmt: skip


def worker(name: str, size: str, pipe) -> None:
    """Process of one scene: Dr.Jit compiles the materials of all scenes that a process holds into each kernel."""
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    trains = size == "step"
    bsdf = materials(8, "float32" if trains else "uint8")[name]
    loaded = scene(bsdf, *SIZES[size], "prb" if trains else "path")
    parameters = mi.traverse(loaded)
    parameters.keep([r".*\.tables\..*"])
    seconds = time.thread_time if size == "fixed" else time.process_time

    def run(seed):
        if not trains:
            return mi.render(loaded, spp=1, seed=seed)
        for key in parameters.keys():
            dr.enable_grad(parameters[key])
            dr.set_grad(parameters[key], 0)
        parameters.update()
        dr.backward(dr.mean(mi.render(loaded, parameters, spp=1, seed=seed, seed_grad=seed + 10_000), axis=None))
        return [parameters[key].grad for key in parameters.keys()]

    pipe.send({"operations": clock.count(lambda: run(dr.opaque(mi.UInt32, 0))).asdict()})
    answer_passes(pipe, run, seconds)


def measured(size: str, rounds: int) -> dict[str, dict]:
    """Operations of the kernels of each scene, milliseconds of a pass, and ratios to separate plugins, by turns."""
    results = in_processes(worker, NAMES[: 2 if size == "step" else None], rounds, size)
    wall, cpu = ({name: figures.pop(key) for name, figures in results.items()} for key in ("ms", "cpu_ms"))
    for name, figures in results.items():
        figures |= {"ms": spread(wall[name]), "cpu_ms": spread(cpu[name])}
        figures |= {"ratio": spread(wall[name] / wall[SEPARATE]), "cpu_ratio": spread(cpu[name] / cpu[SEPARATE])}
    return results


def main() -> None:
    arguments = parser(__doc__, rounds=21).parse_args()
    results = {"machine": clock.machine(VARIANT), "spp": 1, "max_depth": 3, "sizes": SIZES}
    for size in SIZES:
        results[size] = measured(size, arguments.rounds)
        for name, figures in results[size].items():
            shown = {key: round(figures[key]["median"], 3) for key in ("ms", "cpu_ms", "ratio", "cpu_ratio")}
            print(size, name, shown, figures["operations"]["instructions"], figures["operations"]["flops"], flush=True)
    write(arguments.json, results)


if __name__ == "__main__":
    main()
