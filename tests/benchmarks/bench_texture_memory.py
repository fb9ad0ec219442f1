"""
Resident memory of a scene with 16 textures of 2048², 8-bit bitmaps beside compressed files that filter themselves.

    python tests/benchmarks/bench_texture_memory.py [--json FILE.json]

Each scene is loaded and rendered once in a process of its own, whose VmRSS is read after Dr.Jit's caches were emptied;
that of the same scene without textures is subtracted. Every texture is a file of its own. What is in the files does not
matter to memory: all are copies of one image, and the table is trained for a few steps only, at 12x.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from frame import VARIANT, parser, resident, write

COUNT, SIDE, COMPRESSION = 16, 2048, 12.0

#: What is measured: plugin, file, further parameters.
KINDS = {
    "none": {"type": "rgb", "value": 0.5},
    "bitmap, 8 bits": {"type": "bitmap", "filename": "{i}.png"},
    "neural_texture, 12x": {"type": "neural_texture", "filename": "{i}.npz"},
    "mipmap, uncompressed": {"type": "mipmap", "filename": "{i}.png"},
}


def child(kind: str, folder: Path) -> None:
    """Load, render once, and print the bytes."""
    import gc

    import drjit as dr
    import mitsuba as mi

    import mi_diffind  # noqa: F401

    mi.set_variant(VARIANT)
    from mi_diffind.scenes.loading import footprint

    quads = {}
    for i in range(COUNT):
        texture = {k: str(folder / v.format(i=i)) if k == "filename" else v for k, v in KINDS[kind].items()}
        place = mi.ScalarTransform4f().translate([i % 4 - 1.5, i // 4 - 1.5, 0]).scale([0.5, 0.5, 1])
        quads[f"quad_{i}"] = {
            "type": "rectangle",
            "to_world": place,
            "bsdf": {"type": "diffuse", "reflectance": texture},
        }
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "light": {"type": "constant"},
        "sensor": {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 6], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 256, "height": 256},
        },
        **quads,
    })  # fmt: skip
    footprint.attach(scene)
    image = mi.render(scene, spp=1)
    dr.eval(image)
    dr.sync_thread()
    del image
    gc.collect()
    dr.flush_malloc_cache()
    print(round(2**20 * resident()))


def main() -> None:
    command = parser(__doc__)
    command.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    arguments = command.parse_args()
    if arguments.child:
        child(arguments.child[0], Path(arguments.child[1]))
        return

    import mitsuba as mi
    import numpy as np

    import mi_diffind

    mi.set_variant(VARIANT)
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        v, u = np.mgrid[0:SIDE, 0:SIDE] / SIDE
        waves = [0.5 + 0.5 * np.sin(40 * (i + 1) * u + 25 * (3 - i) * v) for i in range(3)]
        mi.Bitmap(np.rint(255 * np.stack(waves, -1)).astype(np.uint8)).write(str(folder / "0.png"))
        fitted = mi_diffind.fit(
            "texture", source=str(folder / "0.png"), compression=COMPRESSION, steps=20, progress=False
        )  # fmt: skip
        mi_diffind.save_table(folder / "0.npz", fitted.table)
        for i in range(1, COUNT):
            for suffix in ("png", "npz"):
                shutil.copy(folder / f"0.{suffix}", folder / f"{i}.{suffix}")
        for kind in KINDS:
            command = [sys.executable, __file__, "--child", kind, name]
            found[kind] = int(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])
    base, bitmaps = found.pop("none"), found["bitmap, 8 bits"]
    rows = {k: {"bytes": v - base, "times_less": (bitmaps - base) / (v - base)} for k, v in found.items()}
    print(f"{COUNT} textures of {SIDE}², without them {base / 2**20:.1f} MiB are resident")
    for kind, row in rows.items():
        print(f"{kind:24}{row['bytes'] / 2**20:>9.1f} MiB{row['times_less']:>8.1f}x less")
    write(arguments.json, {"count": COUNT, "side": SIDE, "resident_without": base, "textures": rows})


if __name__ == "__main__":
    main()
