"""Attack all readers with damaged files: ``python tests/trust/run.py --mutants N --raw M``.

Prints the figures of each file (refused, loaded, and every sort of fault) and writes them as JSON, with the lies of the
first file of each fault. ``--add EARLIER.json --seed N`` adds other mutants to those of an earlier report.
``--seeds`` writes the small valid files of all tasks anew instead.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

import campaigns
import trial_files
from limited_child import FAULTS, GOOD, LimitedChild

from mi_diffind import __version__
from mi_diffind.fitting.task import tasks

COLUMNS = ("mutants", *GOOD, *FAULTS)


def make_seeds(only: list[str]) -> None:
    """Carry out the trials of all tasks, or those whose names are given, and keep their files."""
    for trial in trial_files.NAMES:
        task, name = trial.split("/")
        path = trial_files.SEEDS / f"{task}_{name}.npz"
        if not only or path.stem in only:
            with tempfile.TemporaryDirectory() as folder:
                trial_files.make(tasks()[task], name, Path(folder), path)
            print(f"{path}: {path.stat().st_size:,} bytes")


def add(results: list[dict], earlier: list[dict]) -> list[dict]:
    """Return the figures of campaigns with those of an earlier report added."""
    rows = {(row["recipes"], row["target"]): row for row in earlier}
    for result in results:
        row = rows.get((result["recipes"], result["target"]), {**dict.fromkeys(COLUMNS, 0), "faults": {}})
        sums = {column: row[column] + result[column] for column in COLUMNS}
        rows[result["recipes"], result["target"]] = {**result, **sums, "faults": {**row["faults"], **result["faults"]}}
    return [rows[key] for key in sorted(rows)]


def main() -> int:
    """Run the campaigns; return 1 if there was a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=1000, help="structured mutants of each file (default: 1000)")
    parser.add_argument("--raw", type=int, default=1000, help="mutants by bytes of each file (default: 1000)")
    parser.add_argument("--share", type=int, default=1, help="one in so many tables that load is rendered (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="other mutants for each number (default: 0)")
    parser.add_argument("--add", type=Path, metavar="EARLIER", help="report of another seed, whose figures are added")
    parser.add_argument("--json", type=Path, default=Path("trust_files.json"), help="report to write")
    parser.add_argument("--seeds", action="store_true", help="write the valid files of all tasks anew, and end")
    parser.add_argument("only", nargs="*", help="names of files (default: all)")
    arguments = parser.parse_args()
    if arguments.seeds:
        make_seeds(arguments.only)
        return 0
    before = json.loads(arguments.add.read_text(encoding="utf-8")) if arguments.add else {"results": [], "seeds": []}
    results = []
    for name in arguments.only or [*campaigns.TABLES, *campaigns.OTHERS]:
        with tempfile.TemporaryDirectory() as folder, LimitedChild(Path(folder)) as child:
            target = campaigns.target(name, child)
            for form, count in {"structured": arguments.mutants, "raw": arguments.raw}.items():
                if count < 1:
                    continue
                figures = campaigns.run(child, name, target, form, count, arguments.share, arguments.seed)
                results.append(figures)
                print(*(f"{key}: {value}" for key, value in figures.items() if value), sep=", ", flush=True)
        rows = add(results, before["results"])
        totals = {
            form: {column: sum(row[column] for row in rows if row["recipes"] == form) for column in COLUMNS}
            for form in ("structured", "raw")
        }
        report = {
            "version": __version__, "machine": platform.processor() or platform.machine(),
            "date": time.strftime("%Y-%m-%d"), "seeds": [*before["seeds"], arguments.seed], "totals": totals,
            "faults": sum(total[fault] for total in totals.values() for fault in FAULTS), "results": rows,
        }  # fmt: skip
        arguments.json.write_text(json.dumps(report, indent=1, default=repr) + "\n", encoding="utf-8")
    return int(any(result["faults"] for result in results))


if __name__ == "__main__":
    sys.exit(main())
