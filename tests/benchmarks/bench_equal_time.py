"""Error times time of a scene of tiles, a ball and a mesh, with stock plugins and step by step with learned ones.

    python tests/benchmarks/bench_equal_time.py [--rounds N] [--json FILE]

A floor of ``tiles`` and a ball and Suzanne of ``rust``, under an environment light and under a sun alone. Each
contender changes one thing of the one before. Errors are those of ``tradeoff cost``. The time is that of a sample: the
difference of passes of most and of fewest samples, over that of their samples. So the fixed time of a pass, for tracing
and launching its kernel, is no part of it.
"""

from contextlib import ExitStack

import mitsuba as mi
import numpy as np
from frame import VARIANT, parser, write

from mi_diffind.measure.clock import machine
from mi_diffind.measure.statistics import spread
from mi_diffind.scenes import equal_time
from mi_diffind.studies import cost

#: Samples a pixel whose errors are measured, those of the longest pass, and passes of a reference of the latter.
SAMPLES, LONGEST, REFERENCE = (1, 4, 16), 64, 4

#: Side of the picture in pixels.
SIDE = 192


def stock(bsdf: str, texture: str = "bitmap", files: tuple[str, str] = ("", "")) -> dict:
    """Return normal maps around BSDFs."""
    floor, objects = (cost.material(m, bsdf, texture, f) for m, f in zip(("tiles", "rust"), files, strict=True))
    return {"floor": floor, "objects": objects}


def learned(*files: str) -> dict:
    """Return learned materials of the floor and the objects."""
    return {k: {"type": "neural_material", "filename": f} for k, f in zip(("floor", "objects"), files, strict=True)}


PLAIN = ("tiles_filtered.npz", "rust_plain.npz")

CONTENDERS = {
    "normalmap, principled, bitmap": stock("principled"),
    "normalmap, disney, bitmap": stock("disney"),
    "normalmap, disney, mipmap": stock("disney", "mipmap"),
    "normalmap, disney, neural_texture": stock("disney", "neural_texture", PLAIN),
    "neural_material": learned(*PLAIN),
    "neural_material, trained for shading": learned(PLAIN[0], "rust_shaded.npz"),
}


def measure(light: str, rounds: int) -> dict[str, dict]:
    """Return the figures of each contender under a light; ratios are those to the first."""
    first, second = list(CONTENDERS)[:2]
    references = {name: first if name == first else second for name in CONTENDERS}
    row = cost.Row("tiles, ball and mesh", "scene", CONTENDERS, "", references, light=light)
    settings, samples, halves = cost.CostSettings(LONGEST, render=SIDE), (*SAMPLES, LONGEST), {}
    with ExitStack() as stack:
        processes = {n: stack.enter_context(cost.ContenderProcess(row, n, False, settings)) for n in CONTENDERS}
        for name in (first, second):
            images = [processes[name].run(cost.REFERENCE_SEED + i)[2] for i in range(REFERENCE)]
            halves[name] = [np.mean(images[i::2], axis=0) for i in range(2)]
        passes = {name: {spp: [] for spp in samples} for name in processes}
        for i in range(-1, rounds):  # the first round compiles
            for name, process in list(processes.items())[:: 1 if i % 2 else -1]:
                for spp in samples:
                    seconds, _, image = process.run(rounds + i, spp)
                    if i >= 0:
                        passes[name][spp].append((seconds, image))
            print(f"{light}: round {i + 1} of {rounds}", flush=True)
    seconds = {n: {spp: np.array([p[0] for p in each[spp]]) for spp in samples} for n, each in passes.items()}
    sample = {n: (s[LONGEST] - s[1]) / (LONGEST - 1) / SIDE**2 for n, s in seconds.items()}
    result = {}
    for name in CONTENDERS:
        time = spread(sample[name] / np.median(sample[first]))
        result[name] = {
            "ns_per_sample": 1e9 * float(np.median(sample[name])), "time_ratio": time,
            "fixed_seconds": float(np.median(seconds[name][1] - sample[name] * SIDE**2)), "spp": {},
        }  # fmt: skip
        for spp in SAMPLES:
            reference, images = halves[references[name]], [p[1] for p in passes[name][spp]]
            mean, noise = sum(reference) / 2, np.mean((reference[0] - reference[1]) ** 2) / 4
            figures = equal_time.errors(images, reference)
            figures["mse"] = float(np.mean([np.mean((image - mean) ** 2) for image in images]) - noise)
            base = result[first]["spp"].get(spp, figures)
            ratios = {key: figures[key] / base[key] for key in ("error", "mse")}
            products = {f"{key}_times_time": ratio * time["median"] for key, ratio in ratios.items()}
            result[name]["spp"][spp] = {k: v for k, v in figures.items() if k != "errors"} | products
    return result


def main() -> None:
    """Measure, print and write."""
    arguments = parser(__doc__, 9).parse_args()
    mi.set_variant(VARIANT)
    result = {"machine": machine(VARIANT), "rounds": arguments.rounds, "side": SIDE, "lights": {}}
    for light in cost.LIGHTS:
        result["lights"][light] = measure(light, arguments.rounds)
        for name, c in result["lights"][light].items():
            cells = [f"{c['spp'][spp][f'{key}_times_time']:.2f}" for key in ("error", "mse") for spp in SAMPLES]
            print(f"{light:4} {name:38} {c['ns_per_sample']:6.1f} ns a sample, relMSE x time, MSE x time:", *cells)
        write(arguments.json, result)


if __name__ == "__main__":
    main()
