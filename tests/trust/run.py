"""Attack all readers with damaged files: ``python tests/trust/run.py --mutants N --raw M``.

Prints a table of figures a file (refused, loaded, and every sort of fault) and writes it as JSON, with the lies of the
shortest file of each fault. ``--add EARLIER.json --seed N`` adds other mutants to those of an earlier report.
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


def report(results: list[dict], arguments) -> dict:
    """Return the report of some campaigns, with those of an earlier report added."""
    earlier = json.loads(arguments.add.read_text(encoding="utf-8")) if arguments.add else {"results": [], "seeds": []}
    rows = {(r["recipes"], r["target"]): dict(r) for r in earlier["results"]}
    for result in results:
        row = rows.setdefault((result["recipes"], result["target"]), {**result, **dict.fromkeys(COLUMNS, 0)})
        row |= {column: row[column] + result[column] for column in COLUMNS}
        row["faults"] = {**row.get("faults", {}), **result["faults"]}
    totals = {
        form: {c: sum(r[c] for r in rows.values() if r["recipes"] == form) for c in COLUMNS}
        for form in ("structured", "raw")
    }
    return {
        "version": __version__, "machine": platform.processor() or platform.machine(),
        "date": time.strftime("%Y-%m-%d"), "seeds": [*earlier.get("seeds", [0]), arguments.seed], "totals": totals,
        "faults": sum(t[fault] for t in totals.values() for fault in FAULTS),
        "results": [rows[key] for key in sorted(rows)],
    }  # fmt: skip


def main() -> int:
    """Run the campaigns; return 1 if there was a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mutants", type=int, default=1000, help="structured mutants of each file (default: 1000)")
    parser.add_argument("--raw", type=int, default=1000, help="mutants by bytes of each file (default: 1000)")
    parser.add_argument("--share", type=int, default=1, help="one in so many tables that load is rendered (default: 1)")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="limit of the time of all together")
    parser.add_argument("--seed", type=int, default=0, help="other mutants for each number (default: 0)")
    parser.add_argument("--add", type=Path, metavar="EARLIER", help="report of another seed, whose figures are added")
    parser.add_argument("--json", type=Path, default=Path("trust_files.json"), help="report to write")
    parser.add_argument("--seeds", action="store_true", help="write the valid files of all tasks anew, and end")
    parser.add_argument("only", nargs="*", help="names of files (default: all)")
    arguments = parser.parse_args()
    if arguments.seeds:
        make_seeds(arguments.only)
        return 0
    names, began, results = arguments.only or [*campaigns.tables(), *campaigns.OTHERS], time.monotonic(), []
    print(f"{'file':24} {'recipes':10} " + " ".join(f"{c:>13}" for c in COLUMNS))
    for number, name in enumerate(names):
        # Each file has an equal share of the time that is left
        share = (arguments.seconds - (time.monotonic() - began)) / (len(names) - number)
        with tempfile.TemporaryDirectory() as folder, LimitedChild(Path(folder)) as child:
            target = campaigns.target(name, child)
            for form, count in {"structured": arguments.mutants, "raw": arguments.raw}.items():
                if count < 1:
                    continue
                end = time.monotonic() + share * count / (arguments.mutants + arguments.raw)
                spare = lambda end=end: time.monotonic() < end  # noqa: E731
                figures = campaigns.run(child, name, target, form, count, spare, arguments.share, arguments.seed)
                results.append(figures)
                print(f"{name:24} {form:10} " + " ".join(f"{figures[c]:13,}" for c in COLUMNS), flush=True)
        text = json.dumps(report(results, arguments), indent=1, default=repr)
        arguments.json.write_text(text + "\n", encoding="utf-8")
    total = {c: sum(r[c] for r in results) for c in COLUMNS}
    print(f"{'all':35} " + " ".join(f"{total[c]:13,}" for c in COLUMNS))
    for result in results:
        for key, (message, lies) in result["faults"].items():
            print(f"\n{result['target']}: {key}\n  {message[:300]!r}\n  {lies!r:.300}")
    return int(any(total[fault] for fault in FAULTS))


if __name__ == "__main__":
    sys.exit(main())
