"""Smoke runs of studies whose plans a test changes."""

import json

from mi_diffind.measure import report
from mi_diffind.measure.benchmark import BenchmarkSettings, measure


def quick_result(plan, folder):
    """The result, as written to ``folder``, of a smoke run of a plan, and its summary."""
    result = measure(plan, BenchmarkSettings.choose(plan.variant, quick=True), folder, progress=False)
    report.write(result, folder, plan)
    written = json.loads((folder / f"tradeoff_{plan.study}.json").read_text(encoding="utf-8"))
    return written, "\n".join(report.summary(result))
