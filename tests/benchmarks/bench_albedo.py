"""
Measure how far the albedo of ``neural_bsdf`` lies above the source's, for the files of the library scene:

    python tests/benchmarks/bench_albedo.py --json docs/measured/bench_albedo.json

Both albedos are integrals of ``eval`` over the same directions, at 19 angles of incidence and eight azimuths.
"""

from pathlib import Path

import mitsuba as mi
import numpy as np
from frame import ASSETS, VARIANT, parser, short_machine, write

import mi_diffind  # noqa: F401  (registers the plugins)
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import TASK, energy
from mi_diffind.tasks.bsdf.truth import MitsubaTruth

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
    command = parser(__doc__, required=True)
    command.add_argument("--samples", type=int, default=2**17, help="directions of an angle (default: 131072)")
    arguments = command.parse_args()
    mi.set_variant(VARIANT)
    result = {"machine": short_machine(), "files": {}}
    for path in sorted((ASSETS / "library").glob("*.npz")):
        result["files"][path.stem] = excess(path, arguments.samples)
        print(path.stem, result["files"][path.stem], flush=True)
    write(arguments.json, result)


if __name__ == "__main__":
    main()
