"""
Measure fields with and without surroundings on a capture without alpha:

    python scenes/make_phone.py out/phone
    python tests/benchmarks/bench_surroundings.py out/phone --json docs/measured/bench_surroundings.json

Each row is a process of its own, ``mi-diffind fit field`` with the options that the row names, with the same numbers of
rays and of nodes along a side. The row "scene, larger box" has an ``aabb`` of five times the side of the other boxes.
"""

import json
import shutil
import tempfile
from pathlib import Path

from bench_nerf import training
from frame import VARIANT, earlier, parser, short_machine, write

from mi_diffind.tasks.radiance.grid import inner_cube
from mi_diffind.tasks.radiance.views import load_views

#: Name of a row → further options of ``fit field``.
ROWS = {
    "scene": ["--background", "scene"],
    "scene, larger box": ["--background", "scene"],
    "surroundings": ["--background", "surroundings"],
}

#: Side of the larger box as a multiple of that of the inner cube.
LARGER = 5.0


def with_box(folder: Path, copy: Path) -> Path:
    """Copy a capture and give it a larger box."""
    shutil.copytree(folder, copy)
    centre, half = inner_cube(load_views(folder, "train", background="surroundings"))
    for file in copy.glob("transforms_*.json"):
        content = json.loads(file.read_text(encoding="utf-8"))
        content["aabb"] = [list(centre - LARGER * half), list(centre + LARGER * half)]
        file.write_text(json.dumps(content), encoding="utf-8")
    return copy


def main() -> None:
    command = parser(__doc__, required=True)
    command.add_argument("folder", metavar="FOLDER")
    command.add_argument("--resolution", default="48", help="nodes along a side of all grids (default: 48)")
    command.add_argument("--steps", default="200", help="steps of a grid (default: 200)")
    command.add_argument("--downscale", default="2", help="factor by which the views are reduced (default: 2)")
    command.add_argument("--rows", nargs="*", default=list(ROWS), help="names of the rows (default: all)")
    arguments = command.parse_args()
    output, folder = arguments.json, Path(arguments.folder)
    result = earlier(output, rows={}) | {"machine": short_machine()}
    with tempfile.TemporaryDirectory() as work:
        for name in arguments.rows:
            source = with_box(folder, Path(work) / "boxed") if "box" in name else folder
            options = ["--variant", VARIANT, "--resolution", arguments.resolution, *ROWS[name], "--preset", "grid"]
            options += ["--downscale", arguments.downscale, "--steps", arguments.steps]
            report = Path(work) / "x.npz"
            row = training(str(source), report, options)
            result["rows"][name] = row
            write(output, result)


if __name__ == "__main__":
    main()
