"""
A library of 100 random materials, fitted by several processes while one of these and then the whole run is killed.

    python tests/benchmarks/bench_library.py FOLDER --materials 100 --steps 20 --workers 2 --json FILE

After a third of the materials one worker gets ``kill -9``, after half of them the command, which is then given again.
A few materials are fitted once more, alone, and their bytes compared.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

from frame import parser, resident, write


def write_materials(folder: Path, count: int) -> None:
    """Write random conductors, plastics and principled BSDFs."""
    rng = random.Random(24)
    folder.mkdir(exist_ok=True)
    for k in range(count):
        colour = " ".join(f"{rng.uniform(0.05, 0.9):.3f}" for _ in range(3))
        alpha = 10 ** rng.uniform(-1.5, -0.3)
        plugin = ("roughconductor", "roughplastic", "principled")[k % 3]
        if plugin == "roughconductor":
            texts = {"material": rng.choice(["Au", "Cu", "Al", "Cr", "W"])}
            texts["distribution"] = rng.choice(["ggx", "beckmann"])
            inside = "".join(f'<string name="{n}" value="{v}"/>' for n, v in texts.items())
            inside += f'<float name="alpha" value="{alpha:.4f}"/>'
        elif plugin == "roughplastic":
            inside = f'<rgb name="diffuse_reflectance" value="{colour}"/><float name="alpha" value="{alpha:.4f}"/>'
        else:
            numbers = {"roughness": alpha**0.5, "metallic": rng.choice([0, rng.random()]), "specular": rng.random()}
            numbers["clearcoat"] = rng.choice([0, rng.random()])
            inside = f'<rgb name="base_color" value="{colour}"/>'
            inside += "".join(f'<float name="{n}" value="{v:.4f}"/>' for n, v in numbers.items())
        text = f'<bsdf version="3.0.0" type="{plugin}">{inside}</bsdf>\n'
        (folder / f"{plugin}_{k:03d}.xml").write_text(text)


def children(process: int) -> list[int]:
    """Return the processes that a process has begun."""
    return list(map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split()))


def runs(process: int) -> bool:
    """Return whether a process has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def main() -> None:
    """Run."""
    command = parser(__doc__)
    command.add_argument("folder", type=Path)
    command.add_argument("--materials", type=int, default=100)
    command.add_argument("--steps", type=int, default=20)
    command.add_argument("--workers", type=int, default=2)
    arguments = command.parse_args()
    arguments.folder.mkdir(exist_ok=True)
    sources, output = arguments.folder / "materials", arguments.folder / "learned"
    write_materials(sources, arguments.materials)
    command = [sys.executable, "-m", "mi_diffind.commands.cli", "fit", "bsdf", "--steps", str(arguments.steps)]
    library = [*command, str(sources), "-o", str(output), "--workers", str(arguments.workers)]

    def fitted() -> int:
        return len(list(output.glob("*.npz")))

    start, memory = time.perf_counter(), []
    run = subprocess.Popen(library, stdout=subprocess.DEVNULL)
    while fitted() < arguments.materials // 3 and run.poll() is None:
        time.sleep(0.2)
    victim = children(run.pid)[0]
    memory.append(1.048576 * resident(victim))
    os.kill(victim, signal.SIGKILL)
    at_worker = fitted()
    while fitted() < arguments.materials // 2 and run.poll() is None:
        time.sleep(0.2)
    assert victim not in children(run.pid) and len(children(run.pid)) == arguments.workers
    workers = children(run.pid)
    memory += [1.048576 * resident(worker) for worker in workers]
    run.kill()
    run.wait()
    killed = time.perf_counter()
    while any(map(runs, workers)):
        time.sleep(0.01)
    ended = time.perf_counter() - killed
    at_run = fitted()
    before = {file.name: file.stat().st_mtime_ns for file in output.glob("*.npz")}
    again = subprocess.run(library, stdout=subprocess.PIPE, text=True)
    seconds = time.perf_counter() - start
    kept = {file.name: file.stat().st_mtime_ns for file in output.glob("*.npz") if file.name in before} == before
    report = json.loads((output / "report.json").read_text())

    some = arguments.folder / "alone" / "materials"  # files name their sources relative to themselves
    some.mkdir(exist_ok=True, parents=True)
    for source in sorted(sources.glob("*.xml"))[:: max(1, arguments.materials // 5)]:
        (some / source.name).write_bytes(source.read_bytes())
    alone = arguments.folder / "alone" / "learned"
    subprocess.run([*command, str(some), "-o", str(alone)], stdout=subprocess.DEVNULL, check=True)
    same = [file.read_bytes() == (output / file.name).read_bytes() for file in alone.glob("*.npz")]
    quality = sorted(m["psnr_db"] for m in report["materials"].values())
    result = {
        "materials": arguments.materials, "steps": arguments.steps, "workers": arguments.workers,
        "exit_code": again.returncode, "fitted_at_kill_of_worker": at_worker, "fitted_at_kill_of_run": at_run,
        "seconds_until_workers_ended": ended, "kept_unchanged": kept, "fitted_by_second_run": report["fitted"],
        "kept_by_second_run": report["kept"], "failed": report["failed"], "seconds": seconds,
        "same_bytes_alone": f"{sum(same)} of {len(same)}", "worker_memory_mb": memory, "bytes": report["bytes"],
        "psnr_db": {"least": quality[0], "median": quality[len(quality) // 2], "most": quality[-1]},
        "leftovers": [str(file.relative_to(output)) for file in output.rglob(".*")],
    }  # fmt: skip
    print(json.dumps(result, indent=2))
    write(arguments.json, result)


if __name__ == "__main__":
    main()
