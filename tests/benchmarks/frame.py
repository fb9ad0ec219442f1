"""Frame of the benchmarks: arguments, rounds by turns, JSON.

Contenders are measured in turn, one of each before the next of any, in the other direction in each second round: what
else the machine does, and its clock, then hit all of them alike.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mi_diffind.core.files import write_json
from mi_diffind.measure.statistics import spread

ROOT = Path(__file__).resolve().parents[2]
ASSETS = ROOT / "scenes" / "assets"
VARIANT = "llvm_ad_rgb"


def parser(description: str, rounds: int) -> argparse.ArgumentParser:
    """Return a parser with the options ``--json`` and ``--rounds``, whose default is ``rounds``."""
    result = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    result.add_argument("-o", "--json", type=Path, metavar="FILE.json", help="file to write")
    result.add_argument("--rounds", type=int, default=rounds, help=f"rounds (default: {rounds})")
    return result


def write(path: Path | None, result: dict) -> None:
    """Write the result of a benchmark, if there is a file for it."""
    if path:
        write_json(path, result)


def earlier(path: Path | None, **empty) -> dict:
    """Return what an earlier run has written to a file, or ``empty``."""
    return json.loads(path.read_text(encoding="utf-8")) if path and path.is_file() else empty


def by_turns(functions: dict[str, Callable], rounds: int, warm: int = 1) -> dict[str, list]:
    """Return what each function returns in ``rounds`` rounds, after ``warm`` ones that compile kernels."""
    results = {name: [] for name in functions}
    for i in range(warm + rounds):
        for name in functions if i % 2 == 0 else reversed(functions):
            value = functions[name]()
            if i >= warm:
                results[name].append(value)
    return results


def against(seconds: dict, base: str, count: int) -> dict[str, dict]:
    """Return ns a lane, and the median ratio to ``base`` with its quartiles."""
    rows = {}
    for name, values in seconds.items():
        ratio, ns = spread(values / seconds[base]), float(np.median(values)) / count * 1e9
        rows[name] = {"ns": ns, "ratio": ratio["median"], "quartiles": [ratio["q1"], ratio["q3"]]}
    return rows
