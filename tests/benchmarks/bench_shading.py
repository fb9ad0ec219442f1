"""
What training for the shading costs: time a step and memory over a long training, and the time of renders with what it
made beside one that was trained as a texture alone, in turn.

    python tests/benchmarks/bench_shading.py [--steps 2000] [--json FILE]
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.core import compat
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import loop
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import load_source
from mi_diffind.scenes import loading
from mi_diffind.tasks.shading import PRESETS, training
from mi_diffind.tasks.texture import PRESETS as TEXTURES
from mi_diffind.tasks.texture import TASK
from mi_diffind.tasks.texture import training as textures

SCENES = Path(__file__).resolve().parents[2] / "scenes"


def resident() -> float:
    """MiB of the process in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20


def long_training(steps: int) -> list[dict]:
    """Ten equal parts of a training: milliseconds a step, of one core, memory, and whether all entries are finite."""
    types, recipe = array_module(), PRESETS["ours"]
    source = load_source(SCENES / "assets" / "rust.json")
    pyramid = Pyramid.of(source, textures.layout_of(source, TEXTURES["ours"]), types)
    table = TASK.load(SCENES / "assets" / "rust_plain.npz")
    settings = dataclasses.replace(recipe.settings, steps=steps, batch=2**14)
    problem = training.ShadingProblem(training.start_of(table, pyramid), pyramid, recipe, source.digest)
    problem.settings = settings
    trainer, found = loop._Trainer(problem, settings), []
    compat.use_threads(1)
    trainer.take_step()  # compiles
    for part in range(10):
        start = time.process_time()
        for step in range(steps // 10):
            trainer.share = part / 10 + step / steps
            loss = trainer.take_step()
            dr.eval(loss)
            dr.sync_thread()
        seconds = time.process_time() - start
        found.append({
            "ms_per_step": 1e3 * seconds / (steps // 10), "mebibytes": resident(), "finite": trainer.finite(),
        })  # fmt: skip
        print(found[-1], flush=True)
    return found


def render_ratio(rounds: int = 15) -> dict:
    """Time of a render with ``rust_shaded.npz``, as a multiple of that with ``rust_plain.npz``: median, quartiles."""
    mi.set_variant("llvm_ad_rgb")
    defines = {"width": "320", "height": "180", "max_depth": "2"}
    loaded = [loading.load(SCENES / "rust.xml", defines={**defines, "metal": f"rust_{name}.npz"})
              for name in ("plain", "shaded")]  # fmt: skip
    times = []
    for i in range(rounds + 1):
        own = []
        for scene in loaded:
            start = time.perf_counter()
            loading.render_pass(scene, 4, i)
            own.append(time.perf_counter() - start)
        times.append(own)
    ratios = [b / a for a, b in times[1:]]  # the first compiles
    low, median, high = np.quantile(ratios, (0.25, 0.5, 0.75))
    return {"median": float(median), "quartiles": [float(low), float(high)]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--json")
    arguments = parser.parse_args()
    found = {"render_ratio": render_ratio()}
    print(found, flush=True)
    found["training"] = long_training(arguments.steps)
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
