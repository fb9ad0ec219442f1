"""The frame for time against accuracy: fronts, rounds, interruption, files, pictures."""

import csv
import itertools
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_study import CALLS, KERNELS, SETTINGS, Log, small_plan

from mi_diffind.measure import plot, report
from mi_diffind.measure.benchmark import measure
from mi_diffind.measure.clock import Operations
from mi_diffind.measure.statistics import finite

FILES = ["tradeoff_small.csv", "tradeoff_small.json", "tradeoff_small.png"]


def test_front_of_a_panel():
    """Times within 5% count as equal; what does not compete is on no front and beats nothing; equal points stay."""
    values = {"a": (3.0, 50), "b": (1.0, 30), "c": (0.98, 20), "d": (0.1, 99), "e": (2.0, 29), "f": (3.0, 50)}
    points = [plot.Point(name, x, x, x, db, "", name != "d") for name, (x, db) in values.items()]
    assert [p.name for p in plot.Panel("", "", points, []).front()] == ["b", "a", "f"]


# -- a small study ----------------------------------------------------------------------------------------------------


def test_everything_is_measured_in_turn(tmp_path):
    log = Log()
    result = measure(small_plan(log), SETTINGS, tmp_path, progress=False)
    assert len(log) == CALLS and not result["interrupted"]
    rounds = [entry[2:] for entry in log if entry[:2] == ("query", "first")][KERNELS:]
    for k in range(SETTINGS.rounds):  # each round has each once, every other one backwards
        this = rounds[k * KERNELS : (k + 1) * KERNELS]
        assert len(set(this)) == KERNELS
        assert this == (rounds[:KERNELS] if k % 2 == 0 else rounds[KERNELS - 1 :: -1])
    for case in ("first", "second"):
        for timing in result["cases"][case]["queries"]["eval"].values():
            assert timing["rounds"] == SETTINGS.rounds and timing["with_floor"] > 0
            assert timing["q1"] <= timing["time"] <= timing["q3"]
            beyond = timing["with_floor"] - timing["floor"]
            assert timing["time"] == pytest.approx(max(beyond, 0.2 * timing["floor"]))
            assert timing["hidden"] == (beyond < 0.2 * timing["floor"])
    assert list(result["cases"]["first"]["passes"]["render"]) == ["slow", "exact"]
    assert set(result["cases"]["first"]["ratios"]["eval"]) == {"slow / good", "good / exact"}
    assert result["cases"]["second"]["passes"] == {}
    passes = [e[2] for e in log if e[0] == "pass"]
    assert passes == ["slow", "exact", "slow", "exact", "exact", "slow", "slow", "exact"]  # the first compiles
    # A different random number in each pass, the same for all candidates
    assert [e[3] for e in log if e[0] == "pass" and e[2] == "slow"] == [0, 1, 2, 3]


def test_operations(tmp_path):
    """They are those of the kernel, or those that a candidate states."""
    study = small_plan(Log())
    study.candidates[0].operations = lambda query: Operations(mul=1000 if query == "eval" else 2000)
    found = measure(study, SETTINGS, progress=False)["cases"]["first"]["queries"]
    counts = {name: tuple(t["operations"][k] for k in ("add", "mul", "sqrt")) for name, t in found["eval"].items()}
    assert counts == {"slow": (0, 1000, 0), "good": (0, 2, 0), "exact": (0, 1, 0)}
    assert found["eval"]["good"]["operations"]["instructions"] == 2
    assert found["pdf"]["slow"]["operations"]["mul"] == 2000


def test_files(tmp_path):
    result = measure(small_plan(Log()), SETTINGS, progress=False)
    paths = report.write(result, tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == FILES
    with open(paths["csv"], encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * 2 * 3 + 2  # queries, and passes of one case
    first = table[0]
    assert (first["case"], first["query"], first["candidate"]) == ("first", "eval", "slow")
    assert (first["bytes"], first["training_seconds"], first["unit"], first["db"]) == ("10", "", "ns", "20")
    assert (first["add"], first["sqrt"], first["gathers"], first["flops"]) == ("1", "1", "0", "6")
    whole = next(row for row in table if row["query"] == "render")
    assert whole["unit"] == "ms" and whole["flops"] == ""
    assert json.loads(Path(paths["json"]).read_text(encoding="utf-8")) == finite(result)
    assert Path(paths["png"]).read_bytes()[:4] == b"\x89PNG"
    text = "\n".join(report.summary(result))
    assert "good" in text and "20.00" in text


# -- interruption -----------------------------------------------------------------------------------------------------

#: In the errors; while the first case is compiled; in its rounds; in its passes; in the last rounds.
STOPS = {
    "errors": 1,
    "compilation": 2 + 3,
    "rounds": 2 + KERNELS * 3 + 2,
    "passes": 2 + KERNELS * 5 + 2 + 3,
    "last": CALLS - 1,
}


@pytest.mark.parametrize("where", STOPS)
def test_interruption_keeps_what_is_done(tmp_path, monkeypatch, where):
    monkeypatch.setattr(plot, "draw_panels", lambda *arguments: None)
    monkeypatch.setattr(plot, "save", lambda sheet, path: Path(path).touch())
    log = Log()
    log.stop_at = STOPS[where]
    result = measure(small_plan(log), SETTINGS, tmp_path, progress=False)
    assert result["interrupted"] and len(log) == STOPS[where]  # it stops at once
    if where in ("passes", "last"):
        assert result["cases"]["first"]["queries"]["eval"]["slow"]["rounds"] == SETTINGS.rounds
    if where == "rounds":  # two rounds and a part of the next: the part does not count
        assert result["cases"]["first"]["queries"]["pdf"]["good"]["rounds"] == 2
    assert len(report.summary(result)) > 1
    report.write(result, tmp_path)  # with whatever there is


# -- the picture ------------------------------------------------------------------------------------------------------


def crowd(rng, number):
    """Points of which many lie close together."""
    points = []
    for k in range(number):
        time, accuracy = float(np.exp(rng.normal(1, 0.6))), float(rng.choice([40, 41, 70, 110]))
        points.append(plot.Point(f"candidate {k}", time, 0.95 * time, 1.1 * time, accuracy, f"form {k % 5}"))
    return plot.Panel("crowd", "ns", points, [("exact", 3.0, True), ("reference", 3.1, False)])


def test_labels_do_not_cover_each_other(rng):
    sheet = plot.draw_panels("title", [crowd(rng, n) for n in (3, 8, 12)], "dB", "A caption of many words. " * 30)
    sheet.draw_without_rendering()
    renderer = sheet.canvas.get_renderer()
    for axes, number in zip(sheet.axes, (3, 8, 12), strict=True):
        labels = {t.get_text(): t for t in axes.texts}
        assert set(labels) == {*(f"candidate {k}" for k in range(number)), "exact (exact)", "reference", "Pareto front"}
        boxes = [t.get_window_extent(renderer) for name, t in labels.items() if name != "Pareto front"]
        for a, b in itertools.combinations(boxes, 2):
            assert not a.overlaps(b)
        inside = axes.get_window_extent(renderer).padded(1)
        assert all(inside.contains(b.x0, b.y0) and inside.contains(b.x1, b.y1) for b in boxes)
        assert axes.get_xscale() == "log"


def test_some_cases_have_fewer_candidates_and_other_queries(tmp_path):
    study = small_plan(Log())
    every = study.cases[1].queries

    def queries(lanes):
        return {"pdf": {name: f for name, f in every(lanes)["pdf"].items() if name != "slow"}}

    study.cases[1] = replace(study.cases[1], queries=queries, in_picture=False)
    result = measure(study, SETTINGS, tmp_path, progress=False)
    assert list(result["cases"]["second"]["queries"]) == ["pdf"]
    assert list(result["cases"]["second"]["queries"]["pdf"]) == ["good", "exact"]
    assert list(result["cases"]["first"]["queries"]["eval"]) == ["slow", "good", "exact"]
    report.write(result, tmp_path)
    text = "\n".join(report.summary(result)).split("\nsecond")[1]
    assert "good" in text and "slow  " not in text


class FakeTraining:
    """A training that is interrupted once and has not converged."""

    name = "model"

    def __init__(self, log):
        self.log, self.interrupted = log, 1

    def cached_record(self, folder):
        return None

    def run(self, folder, progress):
        self.log("train", self.name)
        if self.interrupted:
            self.interrupted -= 1
            return None
        return {"psnr_db": 20.0, "seconds": 3.0, "converged": False}


def test_jobs_come_first_and_can_be_interrupted(tmp_path):
    log = Log()
    study = small_plan(log)
    study.jobs, study.panels = [FakeTraining(log)], ("bytes",)
    study.candidates[0] = replace(study.candidates[0], job="model", label="s")
    result = measure(study, SETTINGS, tmp_path, progress=False)
    assert result["interrupted"] and log == [("train", "model")] and not result["cases"]
    report.write(result, tmp_path)
    result = measure(study, SETTINGS, tmp_path, progress=False)
    assert not result["interrupted"] and log[1:3] == [("train", "model"), ("errors", "slow")]
    slow = result["candidates"]["slow"]
    assert (slow["training_seconds"], slow["converged"], slow["label"]) == (3.0, False, "s")
    assert result["candidates"]["good"]["converged"] is None
    assert "not converged" in "\n".join(report.summary(result))
