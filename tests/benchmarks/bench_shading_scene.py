"""
Training inside a scene: its gradients against differences, and two textures trained together and one by one.

    python tests/benchmarks/bench_shading_scene.py [differences | several] [--json FILE.json]

The scene is a rectangle with a small material, normals and metal among its maps, through ``neural_texture``,
``normalmap`` and ``neural_disney``. Minutes on one core; every number is printed as it is found.
"""

from __future__ import annotations

import gc
import json
import sys
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import VARIANT, parser, write

import mi_diffind
from mi_diffind.arrays.indirection import unfolded
from mi_diffind.core.compat import use_threads
from mi_diffind.maps.source import load_source
from mi_diffind.scenes.loading import ParsedScene
from mi_diffind.scenes.training.options import View, ViewDistribution
from mi_diffind.scenes.training.trained_scene import TrainedScene, texture_problem
from mi_diffind.tasks.texture.compressed import load
from mi_diffind.tasks.texture.training import rounded

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
from shading_scenes import fitted, material, scene_file

NAMES = ("albedo", "normal", "roughness", "metallic")
FILM = 24
ORBIT = ViewDistribution(
    8, 4, azimuth=(-60, 60), elevation=(25, 65), light_azimuth=(-90, 90), light_elevation=(35, 80), up=(0, 0, 1)
)


def opaque(seed: int):
    return dr.opaque(mi.UInt32, seed)


def say(**found) -> dict:
    print(json.dumps(found), flush=True)
    return found


def opened(folder: Path, light: str, names=NAMES, preset="ours", fine="0:2:4", depth=2):
    """A trained scene of a material in ``folder``, and its texture."""
    file = fitted(material(folder, names=names), 40, fine)
    table = load(file)
    problem = texture_problem(table, load_source(folder / "material.json"))
    path = scene_file(file, names, light, FILM, depth)
    views = ORBIT if light == "directional" else ViewDistribution()
    return TrainedScene(ParsedScene(path), {file: table}, views, 1), problem, path


def inside(net):
    """The arrays as training sees them, away from the ends of [0, 1], where a difference has one side only."""
    net = rounded(unfolded(net))
    for array in net.arrays.values():
        array.data = mi.TensorXf(0.02 + 0.96 * array.data)
    return net


def differences(folder: Path) -> dict:
    """
    Central differences of a weighted sum of pixels at equal samples, for 30 entries of each array among those with
    more than a twentieth of the largest gradient; those that are off by more than 5%, again with a quarter of the step:
    where a pixel's pointer comes from one cell of the cascaded array to the next, the derivative jumps.
    """
    found = {}
    scene, problem, _ = opened(folder, "directional")
    scene.place(View())
    net, rng = inside(problem.net), np.random.default_rng(0)
    weights = mi.TensorXf(rng.random((FILM, FILM, 3), dtype=np.float32))
    for array in net.arrays.values():
        dr.enable_grad(array.data)
    scene.hold(net)
    dr.backward(dr.sum(scene.render(opaque(4), opaque(3)) * weights, axis=None))
    gradients = {name: dr.grad(array.data).numpy() for name, array in net.arrays.items()}
    for name, gradient in gradients.items():
        array, order = net.arrays[name], np.argsort(-np.abs(gradient), axis=None)
        before, values = array.data, array.data.numpy()
        used = int((np.abs(gradient) > 0.05 * np.abs(gradient).max()).sum())

        def error(index, step, array=array, gradient=gradient, values=values):
            sums = []
            for sign in (1, -1):
                changed = values.copy()
                changed.flat[index] += sign * step
                array.data = mi.TensorXf(changed)
                with dr.suspend_grad():
                    scene.hold(net)
                    image = scene.render(opaque(3), opaque(4)).numpy().astype(np.float64)
                sums.append((image * weights.numpy()).sum())
            return abs(gradient.flat[index] / ((sums[0] - sums[1]) / (2 * step)) - 1)

        indices = rng.choice(order[: max(used, 30)], 30, replace=False)
        errors = [error(index, 2e-3) for index in indices]
        again = [error(index, 5e-4) for index, e in zip(indices, errors, strict=True) if e > 0.05]
        array.data = before
        found[name] = say(
            what="differences", array=name, entries=len(errors), of=used, median=float(np.median(errors)),
            within_5_percent=int(np.sum(np.array(errors) <= 0.05)), largest=float(np.max(errors)),
            again=[float(e) for e in again],
        )  # fmt: skip
    return found


def several(folder: Path, count=60) -> dict:
    """Two textures of a scene: as they were fitted, trained together, and one after the other."""
    files = []
    for seed, name in enumerate(("first", "second")):
        (folder / name).mkdir()
        file = fitted(material(folder / name, 64, seed), 60)
        files.append(file.rename(file.with_name(f"{name}.npz")))

    def plate(file: Path, x: float) -> dict:
        bsdf = {"type": "neural_material", "filename": str(file), "to_uv": mi.ScalarTransform3f().scale(6)}
        return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([x, 0, 0]), "bsdf": bsdf}

    look = mi.ScalarTransform4f().look_at([0, -5, 3.5], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 64, "height": 40, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
    sensor["sampler"] = {"type": "independent", "sample_count": 1}
    sun = {"type": "directional", "direction": [0.3, 0.5, -1], "irradiance": {"type": "rgb", "value": 2.5}}
    result = {}

    def train(name: str, files: list, **more) -> mi_diffind.fitting.task.Fitted:
        plates = {f"plate{i}": plate(file, 2 * i - 1) for i, file in enumerate(files)}
        integrator = {"type": "path", "max_depth": 2}
        scene = {"type": "scene", "integrator": integrator, "sensor": sensor, "sun": sun, **plates}
        more |= {"references": folder / "kept", "reference_spp": 64, "samples": 2**13, "progress": False}
        more |= {"views": 6, "held_out": 3, "azimuth": (-40, 40), "light_azimuth": (-60, 60)}
        more |= {"up": (0, 0, 1), "target": (0, 0, 0)}
        before = mi_diffind.fit("scene", scene, steps=1, lr=1e-9, **more)  # renders references, compiles kernels
        begin = time.process_time()
        trained = mi_diffind.fit("scene", scene, steps=count, **more)
        result[name] = say(
            what="several", run=name, steps=trained.result.step, processor_seconds=time.process_time() - begin,
            psnr_db=[run.result.measured["psnr_db"] for run in (before, trained)],
        )  # fmt: skip
        gc.collect()
        return trained

    train("together", files)
    first = train("first", files, texture=str(files[0])).save(folder / "first" / "trained.npz")
    train("then second", [first, files[1]], texture=str(files[1]))
    return result


def main() -> None:
    parts = {"differences": differences, "several": several}
    command = parser(__doc__)
    command.add_argument("parts", nargs="*", metavar="PART", default=list(parts), help=", ".join(parts))
    arguments = command.parse_args()
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    use_threads(1)
    found = {}
    for name in arguments.parts:  # each in its turn: Dr.Jit compiles the materials of all scenes that there are
        with tempfile.TemporaryDirectory() as folder:
            found[name] = parts[name](Path(folder))
        gc.collect()
    write(arguments.json, found)


if __name__ == "__main__":
    main()
