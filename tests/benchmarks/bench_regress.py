"""
Alarms of regression checks of changed and of unchanged scenes, and the predicted power beside the measured one:

    python tests/benchmarks/bench_regress.py --json docs/measured/bench_regress.json

Three scenes of 96 × 64 pixels: a box of diffuse walls, glossy balls under a small lamp, and balls under an environment.
Passes are rendered once, and each check takes passes of its own from them; each of several references meets other
checks. A lamp that is dimmed scales all passes, exactly, since it is the only light. A tile of 16 × 16 pixels at a
random place that is not dark is brightened by the change that a reference predicts to be found nine times of ten.
"""

import json
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from frame import VARIANT, earlier, parser, write

import mi_diffind  # noqa: F401
from mi_diffind.scenes import block_test, loading, regression

WIDTH, HEIGHT = 96, 64
PASSES, GROUP = block_test.CHECK_PASSES * block_test.GROUPS, block_test.CHECK_PASSES
#: Changes of one object: factors of its colour and its roughness, and its place as a share of the scene's width.
CHANGES = {"": (1, 1, 0), "colour −3%": (0.97, 1, 0), "roughness +10%": (1, 1.1, 0), "moved by 0.2%": (1, 1, 0.002)}
LAMPS = {"lamp −1%": 0.99, "lamp −2%": 0.98}
#: Rows of the file that differ in one of these are kept.
SETTINGS = ("scene", "variant", "sampler", "spp")


def sensor(origin, target, fov, sampler) -> dict:
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb", "rfilter": {"type": "gaussian"}}
    place = mi.ScalarTransform4f().look_at(origin=origin, target=target, up=[0, 1, 0])
    return {"type": "perspective", "fov": fov, "to_world": place, "film": film, "sampler": {"type": sampler}}


def diffuse(*colour) -> dict:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def metal(roughness: float) -> dict:
    return {"type": "roughconductor", "material": "Al", "alpha": roughness}


def ball(centre, radius, bsdf) -> dict:
    return {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": bsdf}


def box(colour: float, roughness: float, moved: float, sampler: str) -> dict:
    """Return a box of diffuse walls with a diffuse and a rough metal ball, 2 units wide."""
    scene = {key: value for key, value in mi.cornell_box().items() if key not in ("small-box", "large-box", "sensor")}
    scene["sensor"] = sensor([0, 0, 3.9], [0, 0, 0], 54, sampler)
    scene["integrator"] = {"type": "path", "max_depth": 5}
    scene["diffuse ball"] = ball(
        (-0.4 + 2 * moved, -0.55, -0.1), 0.45, diffuse(0.7 * colour, 0.6 * colour, 0.5 * colour)
    )
    scene["metal ball"] = ball((0.5, -0.6, 0.2), 0.4, metal(0.3 * roughness))
    return scene


def glossy(colour: float, roughness: float, moved: float, sampler: str) -> dict:
    """Return metal balls on a floor under a small lamp, whose reflections throw rare bright paths."""
    floor = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": [900, 850, 800]}}
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 4},
        "sensor": sensor([0, 2.2, 5], [0, 0.6, 0], 40, sampler),
        "lamp": {"type": "sphere", "center": [-1.5, 4, 1.5], "radius": 0.05, "emitter": lamp},
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": diffuse(0.5 * colour, 0.5 * colour, 0.45 * colour)},
        "left": ball((-1.1 + 4 * moved, 0.7, 0), 0.7, metal(0.1 * roughness)),
        "right": ball((0.9, 0.8, 0.3), 0.8, metal(0.25)),
        "back": ball((0.1, 0.5, -1.4), 0.5, {"type": "roughplastic", "alpha": 0.15}),
    }  # fmt: skip


def environment(colour: float, roughness: float, moved: float, sampler: str) -> dict:
    """Return a diffuse, a plastic and a metal ball under a sky with a bright window."""
    sky = np.full((32, 64, 3), 0.3) * np.linspace(1.5, 0.3, 32)[:, None, None] * [0.8, 0.9, 1]
    sky[6:12, 8:16] = 8
    floor = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(4)
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 4},
        "sensor": sensor([0, 1.8, 5], [0, 0.6, 0], 40, sampler),
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky.astype(np.float32)), "to_world": mi.ScalarTransform4f()},
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": diffuse(0.4, 0.4, 0.4)},
        "left": ball((-1.2 + 4 * moved, 0.7, 0), 0.7, diffuse(0.7 * colour, 0.5 * colour, 0.3 * colour)),
        "right": ball((1.2, 0.7, 0), 0.7, metal(0.3 * roughness)),
        "middle": ball((0, 0.5, 1), 0.5, {"type": "roughplastic", "alpha": 0.2}),
    }  # fmt: skip


SCENES = {"box": box, "glossy": glossy, "environment": environment}


class Passes:
    """Block means of independent passes of a scene, in the order of their seeds, kept in a folder if there is one."""

    def __init__(self, arguments, name: str, change: str):
        settings = (name, change or "unchanged", mi.variant(), arguments.sampler, arguments.spp)
        self.file = arguments.passes and Path(arguments.passes) / f"{'_'.join(map(str, settings))}.npy"
        self.kept = list(np.load(self.file)) if self.file and self.file.exists() else []
        self.scene, self.taken = mi.load_dict(SCENES[name](*CHANGES[change], arguments.sampler)), 0
        self.size = regression.PassSize.for_check(self.scene, arguments.spp)
        self.first_seed = list(CHANGES).index(change) << 24

    def take(self, count: int) -> np.ndarray:
        """Return passes that nobody has taken before, ``(count, rows, columns, channels)``."""
        for seed in range(len(self.kept), self.taken + count):
            image = loading.render_pass(self.scene, self.size.samples, self.first_seed + seed)
            self.kept.append(block_test.block_means(loading.colour_channels(image)).astype(np.float32))
        self.taken += count
        return np.float64(self.kept[self.taken - count : self.taken])

    def keep(self):
        if self.file:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            np.save(self.file, self.kept)


def reference_of(passes: np.ndarray) -> tuple[block_test.BlockReference, float]:
    """Return the reference of 128 passes and the change that it promises to see."""
    groups = passes.reshape(-1, GROUP, *passes.shape[1:])
    reference = block_test.BlockReference.from_groups(passes[: 2 * GROUP], groups.mean(axis=1), HEIGHT, WIDTH)
    return reference, reference.visible_change(groups[2:])


def with_brighter_tile(check: np.ndarray, reference: block_test.BlockReference, change: float, rng) -> np.ndarray:
    """Return a check with a brighter tile at a random place that is not dark, of blocks whose pixels are alike."""
    while True:
        y, x = rng.integers((HEIGHT - block_test.TILE + 1, WIDTH - block_test.TILE + 1))
        inside = np.zeros((HEIGHT, WIDTH, 1))
        inside[y : y + block_test.TILE, x : x + block_test.TILE] = 1
        part = block_test.block_means(inside)
        if (part * reference.mean).sum() >= part.sum() * reference.mean.shape[-1] * reference.dark:
            return check * (1 + change * part)


def measure(arguments, name: str) -> dict:
    """Return the alarms of checks of one scene, and the power."""
    rng, start = np.random.default_rng(1), time.perf_counter()
    same, per_reference = Passes(arguments, name, ""), arguments.unchanged // arguments.references
    changed = arguments.changed // arguments.references
    references = [reference_of(same.take(PASSES)) for _ in range(arguments.references)]
    alarms = dict.fromkeys(("unchanged", "unchanged, blocks", "unchanged, stops", *LAMPS), 0)
    seen, tiles = 0, 0
    for reference, change in references:
        for i in range(per_reference):
            check = same.take(GROUP)
            result = reference.test(check)
            alarms["unchanged"] += not result.passed
            alarms["unchanged, blocks"] += result.failing_blocks > 0
            alarms["unchanged, stops"] += result.stops > result.stops_threshold
            if i < changed:
                for lamp, factor in LAMPS.items():
                    alarms[lamp] += not reference.test(factor * check).passed
            if change < 100:
                for _ in range(4):
                    brighter = with_brighter_tile(check, reference, change, rng)
                    seen, tiles = seen + (not reference.test(brighter).passed), tiles + 1
    same.keep()
    for change in filter(None, CHANGES):
        other = Passes(arguments, name, change)
        alarms[change] = sum(not r.test(other.take(GROUP)).passed for r, _ in references for _ in range(changed))
        other.keep()
    checks = {key: (per_reference if "unchanged" in key else changed) * len(references) for key in alarms}
    row = {
        "scene": name, "variant": mi.variant(), "sampler": arguments.sampler, "spp": same.size.check_spp,
        "references": len(references), "checks": checks, "alarms": alarms,
        "percent": {key: round(100 * alarms[key] / checks[key], 2) for key in alarms},
        "power": {"predicted_change": float(np.median([change for _, change in references])),
                  "predicted_percent": 100 * block_test.POWER,
                  "measured_percent": round(100 * seen / tiles, 2) if tiles else None, "tiles": tiles},
        "seconds": round(time.perf_counter() - start, 1),
    }  # fmt: skip
    print(json.dumps({k: row[k] for k in (*SETTINGS, "percent", "power", "seconds")}, ensure_ascii=False), flush=True)
    return row


def main():
    command = parser(__doc__)
    command.add_argument("--passes", metavar="DIR", help="folder in which rendered passes are kept for a further run")
    command.add_argument("--variant", default=VARIANT)
    command.add_argument("--sampler", default="independent")
    command.add_argument("--spp", type=int, default=128)
    command.add_argument("--scenes", nargs="+", default=list(SCENES))
    command.add_argument("--references", type=int, default=5)
    command.add_argument("--unchanged", type=int, default=335, help="unchanged checks of a scene")
    command.add_argument("--changed", type=int, default=100, help="checks of each change")
    arguments = command.parse_args()
    mi.set_variant(arguments.variant)
    rows = earlier(arguments.json, rows=[])["rows"]
    for name in arguments.scenes:
        row = measure(arguments, name)
        rows = [other for other in rows if any(other[key] != row[key] for key in SETTINGS)] + [row]
        write(arguments.json, {"rows": rows})


if __name__ == "__main__":
    main()
