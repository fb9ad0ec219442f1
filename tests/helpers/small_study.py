"""A study of three candidates and two cases, with a log of what has been called."""

import os
import signal

import drjit as dr
import mitsuba as mi
from variants import BACKENDS

from mi_diffind.core.runtime import array_module
from mi_diffind.measure.benchmark import BenchmarkSettings
from mi_diffind.measure.study import FLOOR, Candidate, Case, Measure, Plan

SETTINGS = BenchmarkSettings(lanes=1024, rounds=4, passes=3, samples=100)


class Log(list):
    """Names of what has been called, in order; the ``stop_at``-th call presses Ctrl-C."""

    stop_at = None

    def __call__(self, *what):
        self.append(what)
        if len(self) == self.stop_at:
            os.kill(os.getpid(), signal.SIGINT)


def small_plan(log):
    """Candidates ``slow`` (20 dB), ``good`` (30 dB), ``exact`` (the truth); a case with passes and one without."""
    mi.set_variant(f"{BACKENDS[0]}_ad_rgb")
    ad = array_module(BACKENDS[0])
    x = dr.arange(ad.Float, SETTINGS.lanes) + 1
    dr.make_opaque(x)
    functions = {
        FLOOR: lambda: x,
        "slow": lambda: [dr.sqrt(x) * x, x + 1],
        "good": lambda: [x * x, x * 2],
        "exact": lambda: [x * 3, x],
    }

    def logged(function, *what):
        """Return a function of anything, which logs what it is and calls another one without arguments."""
        return lambda *given: (log(*what, *given), function())[1]

    def case(name, passes=None):
        queries = {q: {c: logged(f, "query", name, q, c) for c, f in functions.items()} for q in ("eval", "pdf")}
        return Case(name, lambda lanes: queries, passes, {"case": name})

    def errors(name, db):
        return lambda samples: (log("errors", name), {"db": db, "samples": samples})[1]

    return Plan(
        study="small",
        title="A small study",
        candidates=[
            Candidate("slow", "a", "x", 10, errors("slow", 20.0)),
            Candidate("good", "b", errors=errors("good", 30.0)),
            Candidate("exact", "c", is_truth=True),
        ],
        cases=[
            case("first", lambda: {c: logged(lambda: dr.sqrt(x), "pass", "first", c) for c in ("slow", "exact")}),
            case("second"),
        ],
        measures=(Measure("PSNR, dB", "db"),),
        ratios=[("slow", "good"), ("good", "exact"), ("slow", "nobody")],
    )


KERNELS = 2 * (3 + 1)  # queries × (candidates and the floor)
CALLS = 2 + 2 * KERNELS * (1 + SETTINGS.rounds) + 2 * (1 + SETTINGS.passes)
