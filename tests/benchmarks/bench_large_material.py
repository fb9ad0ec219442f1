"""
A procedural material of 4096² texels in a twelfth of its bytes, by our preset, the paper's, and ASTC.

    python tests/benchmarks/bench_large_material.py FOLDER [--json docs/measured/bench_large_material.json]

The paper's equation 1 asks for a cascaded array of at most 1 MB. Each training takes ``--seconds``, which include the
preparation. Files that FOLDER holds are not trained again. Raw bytes are those of 8 bits a channel.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
from frame import VARIANT, parser, write

import mi_diffind
from mi_diffind.maps.source import load_source
from mi_diffind.measure import clock
from mi_diffind.studies.baselines import codecs

#: The smallest blocks of ASTC in which three maps of 7 channels take less than a twelfth of their raw bytes.
BLOCK = "10x10"


def material(folder: Path, name: str, side: int) -> Path:
    """Write the maps of a procedural material to ``folder``, if it has none, and return their manifest."""
    manifest = folder / "material.json"
    if not manifest.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        maps = mi_diffind.example_maps(name, side)
        for key, values in maps.items():
            mi.Bitmap(values if values.ndim == 3 else values[..., None]).write(str(folder / f"{key}.png"))
        manifest.write_text(json.dumps({"maps": {key: f"{key}.png" for key in maps}}), encoding="utf-8")
    return manifest


def trained(path: Path, manifest: Path, preset: str, seconds: float, compression: float) -> dict:
    """Return errors and bytes of a training, which writes the file ``path`` if it is missing."""
    if not path.is_file():
        options = {"preset": preset, "seconds": seconds, "compression": compression}
        mi_diffind.fit("image", str(manifest), progress=False, **options).save(path)
    model = mi_diffind.open(path, "uint8")
    table = model.table
    cascaded = list(table.arrays.values())[-1]
    return {
        "psnr_db": table.measured["psnr_db"], "psnr_between_db": table.measured["psnr_between_db"],
        "bytes": table.nbytes, "memory_bytes": model.memory_nbytes, "file_bytes": path.stat().st_size,
        "cascaded_bytes": cascaded.nbytes, "steps": table.settings["steps"], "seconds": table.settings["seconds"],
        "arrays": {name: list(array.shape) for name, array in table.arrays.items()},
    }  # fmt: skip


def astc(source) -> dict:
    """Return errors and bytes of ASTC: blocks of :data:`BLOCK` for all maps, encoded by the preset ``fast``."""
    start, squares, nbytes = time.perf_counter(), [], 0
    for m in source.maps:
        values = np.clip(m.values, 0, 1).astype(np.float32)
        encoded = codecs.astc(values, BLOCK, "fast")
        squares.append(np.mean((np.clip(encoded.image, 0, 1) - values) ** 2, dtype=np.float64))
        nbytes += encoded.nbytes
    psnr = -10 * np.log10(np.average(squares, weights=[m.channels for m in source.maps]))
    return {"psnr_db": float(psnr), "bytes": nbytes, "block": BLOCK, "seconds": time.perf_counter() - start}


def main() -> None:
    """Measure the contenders and write the JSON."""
    command = parser(__doc__)
    command.add_argument("folder", type=Path)
    command.add_argument("--material", default="lacquer")
    command.add_argument("--side", type=int, default=4096)
    command.add_argument("--seconds", type=float, default=300)
    command.add_argument("--compression", type=float, default=12)
    arguments = command.parse_args()
    mi.set_variant(VARIANT)
    manifest = material(arguments.folder, arguments.material, arguments.side)
    result = {"machine": clock.machine(VARIANT), "material": arguments.material, "side": arguments.side}
    for preset in ("ours", "paper"):
        path = arguments.folder / f"{preset}.npz"
        result[preset] = trained(path, manifest, preset, arguments.seconds, arguments.compression)
        print(preset, result[preset], flush=True)
    source = load_source(str(manifest))
    files = [arguments.folder / f"{m.name}.png" for m in source.maps]
    result["raw"] = {"bytes": source.nbytes, "file_bytes": sum(f.stat().st_size for f in files)}
    result["ASTC"] = astc(source)
    print("ASTC", result["ASTC"], flush=True)
    write(arguments.json, result)


if __name__ == "__main__":
    main()
