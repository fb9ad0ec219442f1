"""Everything that a person with a GPU can run for this project, by one command, as one file that can be sent back.

    python tests/benchmarks/on_a_gpu.py [-o on_a_gpu.json] [--quick] [--variant cuda_ad_rgb] [--skip tests,trust,times]

Runs the tests in the variants of the GPU, the table of docs/trust.md, and short versions of the studies, whose times
are set against those of the same machine's processor. The report is written after each part, so that it is complete as
far as it goes when the run is interrupted or killed. "--variant llvm_ad_rgb" tries the command without a GPU.
Exit codes: 0 nothing failed, 1 something did (the report says what), 2 no GPU or bad usage, 130 interrupted.
"""

from __future__ import annotations

import argparse
import datetime
import os
import statistics
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from frame import ROOT, earlier

from mi_diffind.core.errors import DiffindError
from mi_diffind.core.files import OutputError, write_json
from mi_diffind.core.runtime import use_variant
from mi_diffind.measure.clock import machine

#: Parts of the report, in their order.
PARTS = ("tests", "trust", "times")

#: Files of tests, and studies without a source file, of all runs and of quick ones.
TESTS = {False: ("test_*.py",), True: ("test_lookup.py", "test_srgb.py")}
STUDIES = {False: ("ggx", "disney"), True: ("ggx",)}

#: Seconds for one file of tests, for the table of one variant, and for one study.
LIMITS = {"tests": 3600, "trust": 4 * 3600, "times": 4 * 3600}


def run(command: list, part: str, backend: str) -> tuple[int, str]:
    """Run a command in a process of its own; return its exit code (``-1``: out of time) and the end of its output.

    A crash of the driver ends that process alone. ``MI_DIFFIND_BACKENDS`` chooses the variants of the tests.
    """
    try:
        done = subprocess.run(
            [sys.executable, *map(str, command)], cwd=ROOT, env={**os.environ, "MI_DIFFIND_BACKENDS": backend},
            timeout=LIMITS[part], check=False, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            errors="replace",
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return -1, f"out of time, {LIMITS[part]} s"
    return done.returncode, done.stdout[-1000:]


def outcomes(path: Path) -> dict:
    """Return the names of tests in a JUnit file by outcome, with the beginnings of messages."""
    results = {"passed": 0, "failed": {}, "skipped": {}}
    for case in ElementTree.parse(path).getroot().iter("testcase"):
        name = f"{case.get('classname')}::{case.get('name')}"
        reasons = {child.tag: (child.get("message") or "")[:500] for child in case}
        if failure := [reasons[tag] for tag in ("failure", "error") if tag in reasons]:
            results["failed"][name] = failure[0]
        elif "skipped" in reasons:
            results["skipped"][name] = reasons["skipped"]
        else:
            results["passed"] += 1
    return results


def run_tests(report: dict, save, quick: bool, backend: str) -> None:
    """Run each file of tests in a process of its own."""
    tests = report["tests"] = {"passed": 0, "failed": {}, "skipped": {}, "seconds": {}}
    for path in sorted({path for pattern in TESTS[quick] for path in (ROOT / "tests").rglob(pattern)}):
        if path.relative_to(ROOT / "tests").parts[0] in ("benchmarks", "thirdparty"):
            continue
        name, start = str(path.relative_to(ROOT)), time.perf_counter()
        print(f"{name} …", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            junit = Path(folder) / "junit.xml"
            code, output = run(["-m", "pytest", "-q", "-n0", f"--junitxml={junit}", path], "tests", backend)
            if junit.is_file():
                result = outcomes(junit)
                tests["passed"] += result["passed"]
                for word in ("failed", "skipped"):
                    tests[word] |= result[word]
            elif code != 5:  # 5: no test is left of the file
                tests["failed"][name] = f"exit code {code}: {output}"
        tests["seconds"][name] = round(time.perf_counter() - start, 1)
        save()


def run_trust(report: dict, save, quick: bool, backend: str, variants: list[str]) -> None:
    """Measure the table plugin × variant × property, one variant a process."""
    trust = report["trust"] = {"cells": {}, "errors": {}}
    for variant in variants:
        print(f"trust, {variant} …", flush=True)
        with tempfile.TemporaryDirectory() as folder:
            output = Path(folder) / "trust.json"
            command = [ROOT / "tests" / "trust" / "measure.py", "-o", output, "--variants", variant]
            command += ["--quick"] if quick else []
            code, text = run(command, "trust", backend)
            for name, by_variant in earlier(output, cells={})["cells"].items():
                trust["cells"].setdefault(name, {})[variant] = by_variant[variant]
            if code not in (0, 1) or not output.is_file():
                trust["errors"][variant] = f"exit code {code}: {text}"
        save()


def medians(study: dict) -> dict[str, float]:
    """Return the time of each candidate of a study, by "case / query / candidate"."""
    return {
        f"{case} / {query} / {name}": timing["time"]
        for case, content in study["cases"].items()
        for query, candidates in content["queries"].items()
        for name, timing in candidates.items()
        if isinstance(timing, dict) and timing.get("time")
    }


def run_times(report: dict, save, quick: bool, variant: str) -> None:
    """Run quick studies in the variant and on the processor, and the ratio of their times."""
    times, processor = report.setdefault("times", {}), "llvm_" + variant.partition("_")[2]
    for study in STUDIES[quick]:
        entry = times[study] = {"errors": {}, "ns": {}, "ratios": {}}
        for chosen in dict.fromkeys((variant, processor)):
            print(f"tradeoff {study}, {chosen} …", flush=True)
            with tempfile.TemporaryDirectory() as folder:
                output = Path(folder) / "study.json"
                command = ["-m", "mi_diffind.commands.cli", "tradeoff", study, "--quick", "--variant", chosen]
                code, text = run([*command, "--out", folder, "--json", output], "times", chosen.partition("_")[0])
                if code == 0 and output.is_file():
                    entry["ns"][chosen] = medians(earlier(output))
                else:
                    entry["errors"][chosen] = f"exit code {code}: {text}"
            save()
        first, second = (entry["ns"].get(chosen, {}) for chosen in (variant, processor))
        if variant != processor and (both := first.keys() & second.keys()):
            entry["ratios"] = {key: first[key] / second[key] for key in both}
            entry["median_ratio"] = statistics.median(entry["ratios"].values())
        save()


def failures(report: dict) -> list[str]:
    """Return the names of all that failed."""
    cells = report.get("trust", {}).get("cells", {})
    return [
        *report.get("tests", {}).get("failed", {}),
        *report.get("trust", {}).get("errors", {}),
        *(f"{name}, {variant}, {prop}" for name, by in cells.items() for variant, row in by.items()
          for prop, cell in row.items() if cell["result"] == "fails"),
        *(f"{study}, {variant}" for study, entry in report.get("times", {}).items() for variant in entry["errors"]),
    ]  # fmt: skip


def main(arguments=None) -> int:
    """Run all parts; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", metavar="FILE.json", default="on_a_gpu.json")
    parser.add_argument("--variant", default="cuda_ad_rgb", help="default: cuda_ad_rgb")
    parser.add_argument("--quick", action="store_true", help="minutes: few tests, one variant, one study")
    parser.add_argument("--skip", default="", help=f"parts to leave out, with commas between them: {', '.join(PARTS)}")
    given = parser.parse_args(arguments)
    skipped = [word for word in given.skip.split(",") if word]
    if unknown := [word for word in skipped if word not in PARTS]:
        parser.error(f"--skip: found {unknown[0]!r}, allowed are {', '.join(PARTS)}")
    report = {"date": datetime.date.today().isoformat(), "quick": given.quick, "complete": False}

    def save() -> None:
        write_json(given.output, report)

    try:
        use_variant(given.variant)
        report["machine"] = machine(given.variant)
        save()
    except (DiffindError, OutputError) as e:
        print(f"on_a_gpu: {e}", file=sys.stderr)
        return 2
    import mitsuba as mi

    backend = given.variant.partition("_")[0]
    variants = [v for v in mi.variants() if v.startswith(f"{backend}_ad_") and not v.endswith("_double")]
    parts = {
        "tests": lambda: run_tests(report, save, given.quick, backend),
        "trust": lambda: run_trust(report, save, given.quick, backend, [given.variant] if given.quick else variants),
        "times": lambda: run_times(report, save, given.quick, given.variant),
    }
    try:
        for part in parts:
            if part not in skipped:
                parts[part]()
    except KeyboardInterrupt:
        report["interrupted"] = True
        save()
        print(f"interrupted; {given.output} holds what was measured", file=sys.stderr)
        return 130
    report["complete"], report["failures"] = not skipped, failures(report)
    save()
    print(f"{given.output}: {len(report['failures'])} failed; please attach the file to an issue")
    return int(bool(report["failures"]))


if __name__ == "__main__":
    sys.exit(main())
