"""
Measure grid and field on captures in the format of NeRF's synthetic scenes, which the user brings:

    python tests/benchmarks/bench_nerf.py nerf_synthetic/lego nerf_synthetic/chair -o docs/measured/nerf_scenes.json

A scene is called as its folder. ``mi-diffind fit field FOLDER --grid GRID`` trains grid and field in a process of its
own, with the defaults but for ``--steps`` (for trials) and ``--all-cores``. ``--disk`` fits one more field to the grid
for each size. The file grows with each result; rows of the same scene, size of the views and method are replaced. Files
of fields stay in ``--work``; with the same folder, an interrupted run goes on behind the last finished training.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from frame import earlier, parser, short_machine, write

from mi_diffind.arrays.tables import load_table
from mi_diffind.tasks.radiance.views import load_views


def timed(command: list[str]) -> dict:
    """Run a command; return minutes of the clock and of the processor, and peak memory. Raises ``SystemExit``."""
    print(" ".join(command), flush=True)
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "mi_diffind.commands.cli", *command])
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"exit code {process.returncode} of: {' '.join(command)}")
    return {
        "minutes": (time.perf_counter() - start) / 60,
        "cpu_minutes": (usage.ru_utime + usage.ru_stime) / 60,
        "peak_bytes": usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024),
    }


def training(folder: str, output: Path, options: list[str]) -> dict:
    """Fit a field to a folder, and return its report and its cost."""
    report, costs = output.with_suffix(".json"), output.with_suffix(".cost.json")
    if not costs.is_file():
        write(costs, timed(["fit", "field", folder, "-o", str(output), "--json", str(report), *options]))
    cost, fitted = (json.loads(file.read_text(encoding="utf-8")) for file in (costs, report))
    return fitted | cost


def row(fitted: dict, output: Path, options: list[str], before: dict | None = None) -> dict:
    """Return the row of a field: its cost and, if it began with the grid of another training, that of the grid."""
    minutes, peak = fitted["minutes"], fitted["peak_bytes"]
    if before is not None:
        minutes, peak = minutes + before["grid_seconds"] / 60, max(peak, before["peak_bytes"])
    return {
        **fitted["measured"], "minutes": minutes, "peak_bytes": peak, "file_bytes": output.stat().st_size,
        "memory_bytes": fitted["memory_bytes"], "options": options,
    }  # fmt: skip


def grid_row(fitted: dict, grid_file: Path, options: list[str]) -> dict:
    """Return the row of the grid of a training."""
    return {
        **load_table(grid_file, "field").measured, "minutes": fitted["grid_seconds"] / 60,
        "peak_bytes": fitted["peak_bytes"], "file_bytes": grid_file.stat().st_size, "memory_bytes": None,
        "options": options,
    }  # fmt: skip


def main() -> None:
    command = parser(__doc__, required=True)
    command.add_argument("folders", nargs="+", metavar="FOLDER")
    command.add_argument("--steps", type=int, metavar="N", help="steps of each training, for trials")
    command.add_argument(
        "--all-cores", action="store_true", help="train on all cores: results differ in the last digits"
    )
    command.add_argument("--disk", nargs="*", default=[], metavar="N", help="one more field of so many bytes on disk")
    command.add_argument(
        "--work", metavar="FOLDER", help="folder for the files of the fields (default: a temporary one)"
    )
    arguments = command.parse_args()
    result, quoted = earlier(arguments.json, rows=[]), short_machine()
    options = [] if arguments.steps is None else ["--steps", str(arguments.steps)]
    options += ["--all-cores"] if arguments.all_cores else []
    work = Path(arguments.work or tempfile.mkdtemp())
    work.mkdir(parents=True, exist_ok=True)
    for folder in arguments.folders:
        scene = Path(folder).resolve().name
        side = int(load_views(folder, "test", 1).sizes[0].max())
        grid_file = work / f"{scene}{side}.grid.npz"

        def add(values: dict, scene=scene, side=side) -> None:
            place = {"scene": scene, "side": side, "method": values["method"]}
            result["rows"] = [r for r in result["rows"] if any(r[k] != v for k, v in place.items())]
            result["rows"].append(place | values | {"machine": quoted})
            write(arguments.json, result)

        output = work / f"{scene}{side}.npz"
        fitted = training(folder, output, ["--grid", str(grid_file), *options])
        add({"method": "grid", **grid_row(fitted, grid_file, options)})
        add({"method": "field", **row(fitted, output, options)})
        for size in arguments.disk:
            output, sized = work / f"{scene}{side}.{size}.npz", [*options, "--disk", size]
            smaller = training(folder, output, ["--grid", str(grid_file), *sized])
            add({"method": f"field, --disk {size}", **row(smaller, output, sized, fitted)})


if __name__ == "__main__":
    main()
