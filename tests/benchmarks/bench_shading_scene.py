"""
Two textures of a scene: trained together inside the scene, and one after the other.

    python tests/benchmarks/bench_shading_scene.py several --json docs/measured/bench_shading_several.json

Minutes on one core; every number is printed as it is found.
"""

from __future__ import annotations

import gc
import json
import sys
import tempfile
import time
from pathlib import Path

import mitsuba as mi
from frame import VARIANT, parser, write

import mi_diffind
from mi_diffind.core.compat import use_threads

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
from shading_scenes import fitted, material


def say(**found) -> dict:
    print(json.dumps(found), flush=True)
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
    command = parser(__doc__)
    command.add_argument("parts", nargs="*", metavar="PART", default=["several"], choices=["several"], help="several")
    arguments = command.parse_args()
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    use_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        write(arguments.json, {"several": several(Path(folder))})


if __name__ == "__main__":
    main()
