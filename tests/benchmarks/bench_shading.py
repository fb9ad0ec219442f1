"""
What training for the shading costs: time a step and memory over a long training, and the time of renders with what it
made beside one that was trained as a texture alone, in turn.

    python tests/benchmarks/bench_shading.py [--steps 2000] [--json FILE]
"""

import dataclasses
import time

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import ROOT, VARIANT, by_turns, parser, resident, spread, write

from mi_diffind.core import compat
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import loop
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import load_source
from mi_diffind.scenes import loading
from mi_diffind.tasks.shading import PRESETS, training
from mi_diffind.tasks.texture import PRESETS as TEXTURES
from mi_diffind.tasks.texture import TASK
from mi_diffind.tasks.texture import fit as textures

SCENES = ROOT / "scenes"


def long_training(steps: int) -> list[dict]:
    """Ten equal parts of a training: milliseconds a step, of one core, memory, and whether all entries are finite."""
    types, recipe = array_module(), PRESETS["ours"]
    source = load_source(SCENES / "assets" / "rust.json")
    pyramid = Pyramid.from_source(source, textures.source_layout(source, TEXTURES["ours"]), types)
    table = TASK.load(SCENES / "assets" / "rust_plain.npz")
    settings = dataclasses.replace(recipe, steps=steps, batch=2**14)
    problem = training.ShadingProblem(training.trainable_arrays(table, pyramid), pyramid, recipe, source.digest)
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
    mi.set_variant(VARIANT)
    defines = {"width": "320", "height": "180", "max_depth": "2"}

    def render(name):
        scene = loading.load(SCENES / "rust.xml", defines={**defines, "metal": f"rust_{name}.npz"})

        def seconds():
            start = time.perf_counter()
            loading.render_pass(scene, 4, 0)
            return time.perf_counter() - start

        return seconds

    times = by_turns({name: render(name) for name in ("plain", "shaded")}, rounds)
    ratio = spread(np.divide(times["shaded"], times["plain"]))
    return {"median": ratio["median"], "quartiles": [ratio["q1"], ratio["q3"]]}


def main() -> None:
    command = parser(__doc__)
    command.add_argument("--steps", type=int, default=2000)
    arguments = command.parse_args()
    found = {"render_ratio": render_ratio()}
    print(found, flush=True)
    found["training"] = long_training(arguments.steps)
    write(arguments.json, found)


if __name__ == "__main__":
    main()
