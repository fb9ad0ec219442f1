"""
What training inside a scene rests on, measured: gradients against differences, their means, convergence, 2000 steps.

    python tests/benchmarks/bench_shading_scene.py [differences | means | convergence | steps …] [--json FILE.json]

The scene is a rectangle with a small material, normals and metal among its maps, through ``neural_texture``,
``normalmap`` and ``neural_disney``. Minutes on one core; every number is printed as it is found.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import json
import re
import sys
import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import mi_diffind
from mi_diffind.arrays.indirection import unfolded
from mi_diffind.arrays.tables import save_table
from mi_diffind.core.compat import use_threads
from mi_diffind.fitting.loop import fit
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.source import load_source
from mi_diffind.scenes.loading import ParsedScene
from mi_diffind.scenes.training.fit import fit_scene
from mi_diffind.scenes.training.options import SceneRecipe, View, ViewDistribution
from mi_diffind.scenes.training.problem import SceneProblem
from mi_diffind.scenes.training.references import ReferenceRenders
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


class Gradients:
    """Gradients of the squared error of a render of few samples, of all arrays as one vector."""

    def __init__(self, scene, problem, reference):
        self.scene, self.net, self.reference = scene, problem.net, reference

    def __call__(self, adjoint, seed: int, spp: int = 1) -> np.ndarray:
        """Of Σ adjoint · I, where the derivatives of I are those of the samples of ``seed``."""
        net = inside(self.net)
        for array in net.arrays.values():
            dr.enable_grad(array.data)
        self.scene.hold(net)
        image = mi.render(
            self.scene.scene, self.scene.parameters, spp=1, spp_grad=spp, seed=opaque(seed + 1), seed_grad=opaque(seed)
        )
        dr.backward(dr.sum(image * mi.TensorXf(adjoint), axis=None))
        return np.concatenate([dr.grad(array.data).numpy().ravel() for array in net.arrays.values()])

    def image(self, seed: int, spp: int = 1) -> np.ndarray:
        with dr.suspend_grad():
            self.scene.hold(inside(self.net))
            return self.scene.render(opaque(seed), opaque(seed + 1), spp).numpy()

    def adjoint(self, image) -> np.ndarray:
        return 2 * (image - self.reference) / image.size


def means(folder: Path, count=300) -> dict:
    """
    The mean of many gradients of one sample a pixel under a constant sky, paths of two bounces, against that of many
    samples: standard scores of projections on random directions and of the entries with the largest gradients. Then
    what it is if value and derivative share their samples, and central differences of the expected loss.
    """
    scene, problem, _ = opened(folder, "constant", depth=3)
    scene.place(View())
    truth = Gradients(scene, problem, 0).image(5, 1024)
    reference = 0.8 * truth + 0.05  # another one, so that there is a gradient; near, so that noise matters
    gradients = Gradients(scene, problem, reference)
    passes = [gradients(gradients.adjoint(gradients.image(10_000 + i, 512)), 20_000 + i, 512) for i in range(6)]
    exact, spread = np.mean(passes, axis=0), np.std(passes, axis=0, ddof=1) / np.sqrt(len(passes))
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((64, exact.size))
    largest = np.argsort(-np.abs(exact))[:200]
    found = {}
    for kind in ("independent", "shared"):
        each = []
        for i in range(count):
            seed = 100_000 + 10 * i
            value = gradients.image(seed + 5 if kind == "independent" else seed)
            each.append(gradients(gradients.adjoint(value), seed))
        each = np.array(each)
        for name, a, b in (
            ("directions", each @ directions.T, exact @ directions.T),
            ("entries", each[:, largest], exact[largest]),
        ):
            own = np.std(passes @ directions.T, axis=0, ddof=1) / 6**0.5 if name == "directions" else spread[largest]
            z = (a.mean(axis=0) - b) / np.hypot(a.std(axis=0, ddof=1) / np.sqrt(count), own)
            found[kind, name] = say(
                what="means", samples=kind, of=name, renders=count, rms_score=float(np.sqrt((z**2).mean())),
                largest=float(np.abs(z).max()), within_2=float((np.abs(z) < 2).mean()),
                ratio=float((a.mean(axis=0) @ b) / (b @ b)),
            )  # fmt: skip
    # Detached sampling is right on average: the derivative of an image of many samples, by differences
    for name, array in inside(problem.net).arrays.items():
        direction = rng.standard_normal(array.data.shape).astype(np.float32)

        def total(step, name=name, direction=direction):
            net = inside(problem.net)
            net.arrays[name].data = mi.TensorXf(net.arrays[name].data.numpy() + step * direction)
            sums = []
            with dr.suspend_grad():
                scene.hold(net)
                for seed in range(40, 52):
                    sums.append(float(scene.render(opaque(seed), opaque(seed + 1), 512).numpy().mean()))
            return np.array(sums)

        net = inside(problem.net)
        for other in net.arrays.values():
            dr.enable_grad(other.data)
        sums = []
        for seed in range(60, 66):
            for other in net.arrays.values():
                dr.set_grad(other.data, 0)
            scene.hold(net)
            image = mi.render(
                scene.scene, scene.parameters, spp=1, spp_grad=512, seed=opaque(1), seed_grad=opaque(seed)
            )
            dr.backward(dr.mean(image, axis=None))
            sums.append(float((dr.grad(net.arrays[name].data).numpy() * direction).sum()))
        each = (total(4e-3) - total(-4e-3)) / 8e-3
        error = np.hypot(each.std(ddof=1) / np.sqrt(len(each)), np.std(sums, ddof=1) / np.sqrt(len(sums)))
        found["detached", name] = say(
            what="detached sampling", array=name, gradient=float(np.mean(sums)), difference=float(each.mean()),
            standard_error=float(error),
        )  # fmt: skip
    return {" ".join(key): value for key, value in found.items()}


def convergence(folder: Path, steps=240) -> dict:
    """
    Steps to the PSNR that a wrong start reaches in the end, less half a decibel, of it and of the fitted texture. Wrong
    are: the cascaded array, which is one grey, or its negative; all arrays, which are another material's.
    """
    (folder / "other").mkdir()
    right = load(fitted(material(folder, 64, names=NAMES), 600, "0:2:4,1:3:6", 2, 6, 2**14))
    other = load(fitted(material(folder / "other", 64, 7, names=NAMES[::-1]), 600, "0:2:4,1:3:6", 2, 6, 2**14))
    histories = {}
    for start in ("fitted", "grey", "negative", "other"):
        table, where = load(folder / "material.npz"), folder / start
        where.mkdir(exist_ok=True)
        for file in folder.iterdir():
            if file.suffix in (".png", ".json"):
                (where / file.name).write_bytes(file.read_bytes())
        for name, array in right.arrays.items():
            if start == "other":
                table.arrays[name] = dataclasses.replace(array, entries=other.arrays[name].entries)
            elif start != "fitted" and name == "cascaded":
                entries = 255 - array.entries if start == "negative" else np.full_like(array.entries, 128)
                table.arrays[name] = dataclasses.replace(array, entries=entries)
        save_table(where / "material.npz", table)
        path = scene_file(where / "material.npz", NAMES, "directional", 48)
        recipe = SceneRecipe(reference_spp=256)
        settings = dataclasses.replace(
            recipe.settings, steps=steps, lr=1e-2, measure_every=steps // 24, batch=2**14, check_every=10
        )
        recipe = dataclasses.replace(recipe, settings=settings)
        request = FitRequest("ours", settings, None, progress=False)
        begin = time.perf_counter()
        _, result = fit_scene(
            ParsedScene(path), ORBIT, recipe, request, references=folder / "kept", preview=folder / "p.png"
        )
        histories[start] = [(h["step"], h["psnr_db"], h["texture_psnr_db"]) for h in result.history]
        say(
            what="run", start=start, seconds=time.perf_counter() - begin, restarts=result.restarts,
            history=[(s, round(p, 2), round(t, 2)) for s, p, t in histories[start][::3]],
        )  # fmt: skip
        gc.collect()
    found = {}
    for start in ("grey", "negative", "other"):
        goal = histories[start][-1][1] - 0.5
        needed = {k: next((s for s, p, _ in histories[k] if p >= goal), None) for k in ("fitted", start)}
        found[start] = say(
            what="convergence", start=start, goal_db=goal, steps=needed, first=histories[start][0][1],
            last=histories[start][-1][1], fitted_first=histories["fitted"][0][1],
            fitted_last=histories["fitted"][-1][1],
        )  # fmt: skip
    return found


def losses(folder: Path, count=120) -> dict:
    """What losses reach from the fitted texture at the default rate: under the sun, and with the noise of a sky."""
    fitted(material(folder, 64, names=NAMES), 600, "0:2:4,1:3:6", 2, 6, 2**14)
    found = {}
    for light, views in (
        ("directional", ORBIT),
        ("constant", dataclasses.replace(ORBIT, light_azimuth=None, light_elevation=None)),
    ):
        path = scene_file(folder / "material.npz", NAMES, light, 48, 3)
        for loss, bound in (("none", 1.0), ("mse", 1.0), ("mse", None), ("mae", None)):
            recipe = SceneRecipe(bound=bound, reference_spp=256)
            settings = dataclasses.replace(
                recipe.settings, steps=count, batch=2**14, measure_every=count // 4, check_every=10
            )
            if loss == "none":  # as it was
                settings = dataclasses.replace(settings, steps=1, lr=1e-9)
            else:
                settings = dataclasses.replace(settings, loss=loss)
            recipe = dataclasses.replace(recipe, settings=settings)
            request = FitRequest("ours", settings, None, progress=False)
            _, result = fit_scene(ParsedScene(path), views, recipe, request, references=folder / "kept")
            found[light, loss, bound] = say(
                what="losses", light=light, loss=loss, bound=bound, restarts=result.restarts,
                psnr_db=[round(h["psnr_db"], 2) for h in result.history],
                texture_db=[round(h["texture_psnr_db"], 2) for h in result.history],
            )  # fmt: skip
            gc.collect()
    return {" ".join(map(str, key)): value for key, value in found.items()}


def resident() -> float:
    """MiB of this process that are in memory."""
    return int(re.search(r"VmRSS:\s*(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))[1]) / 1024


def steps(folder: Path, count=2000) -> dict:
    """Time of a step and memory over 2000 of them, on a small film."""
    names = ("albedo", "roughness")
    scene, texture, path = opened(folder, "directional", names)
    recipe = SceneRecipe(reference_spp=64)
    settings = dataclasses.replace(recipe.settings, steps=count, batch=4096, measure_every=count, check_every=20)
    views = dataclasses.replace(ORBIT, count=4, held_out=1)
    del scene
    gc.collect()
    rendered = ReferenceRenders(ParsedScene(path), views, 64, progress=False)
    trained, measured = views.trained(), views.measured()
    images = rendered.images([*trained, *measured])
    file = path.parent / "material.npz"
    scene = TrainedScene(ParsedScene(path), {file: load(file)}, views, 1)
    problem = SceneProblem(texture, scene, [*zip(trained, images, strict=False)], [(measured[0], images[-1])], recipe)
    marks, begin = [], problem.begin

    def noted(step, share):
        if step % (count // 20) == 0:
            dr.sync_thread()
            marks.append((step, time.perf_counter(), resident()))
        return begin(step, share)

    problem.begin = noted
    result = fit(problem, settings, progress=False)
    marks.append((count, time.perf_counter(), resident()))
    each = np.diff([t for _, t, _ in marks]) / (count // 20)
    memory = [m for _, _, m in marks]
    finite = all(np.isfinite(a.numpy()).all() for a in problem.net.arrays.values())
    return say(
        what="steps", steps=result.steps, restarts=result.restarts, finite=finite, psnr_db=result.measured["psnr_db"],
        ms=[round(1000 * t, 1) for t in each], mib=[round(m) for m in memory],
    )  # fmt: skip


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
    parts = {
        "differences": differences, "means": means, "convergence": convergence, "losses": losses, "steps": steps,
        "several": several,
    }  # fmt: skip
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", default=list(parts), help=", ".join(parts))
    parser.add_argument("--json")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    use_threads(1)
    found = {}
    for name in arguments.parts:  # each in its turn: Dr.Jit compiles the materials of all scenes that there are
        with tempfile.TemporaryDirectory() as folder:
            found[name] = parts[name](Path(folder))
        gc.collect()
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
