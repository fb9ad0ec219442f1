"""
Measure how far the albedo of ``neural_bsdf`` lies above the source's, for the files of the library scene:

    python tests/benchmarks/bench_albedo.py --json docs/measured/bench_albedo.json

Both albedos are integrals of ``eval`` over the same directions, at 19 angles of incidence and eight azimuths.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

import mi_diffind  # noqa: F401  (registers the plugins)
from mi_diffind.core.files import write_json
from mi_diffind.core.runtime import array_module
from mi_diffind.measure.clock import machine
from mi_diffind.tasks.bsdf import TASK, energy
from mi_diffind.tasks.bsdf.truth import MitsubaTruth

LIBRARY = Path(__file__).resolve().parents[2] / "scenes" / "assets" / "library"
ANGLES = (0, 1, 2, 4, *range(8, 88, 6), 88)


def excess(path: Path, samples: int) -> dict:
    """Return the largest relative excess of the albedo over channels, angles and azimuths, and its angle."""
    types = array_module()
    source = TASK.open(mi.TensorXf, path).source()
    plugin = MitsubaTruth(mi.load_dict({"type": "neural_bsdf", "filename": str(path)}), path.stem, "")
    largest = []
    for azimuth in np.arange(8) * np.pi / 8:
        cosines = np.cos(np.radians(ANGLES))
        expected, found = energy.albedos([source.value, plugin.value], source, types, cosines, azimuth, size=samples)
        largest.append((found / np.maximum(expected, 1e-3) - 1).max(axis=1))
    largest = np.max(largest, axis=0)
    return {"excess": float(f"{largest.max():.4g}"), "degrees": ANGLES[int(largest.argmax())]}


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", required=True, type=Path, metavar="FILE.json")
    parser.add_argument("--samples", type=int, default=2**17, help="directions of an angle (default: 131072)")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    described = machine("llvm_ad_rgb")
    result = {"machine": {name: described[name] for name in ("cpu", "cores", "system", "mi-diffind")}, "files": {}}
    for path in sorted(LIBRARY.glob("*.npz")):
        result["files"][path.stem] = excess(path, arguments.samples)
        print(path.stem, result["files"][path.stem], flush=True)
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
