"""The frame for time against accuracy: fronts, rounds, interruption, files; and the study of the Disney BRDF."""

import csv
import itertools
import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from conftest import BACKENDS

from mi_diffind import plot, report, tradeoff
from mi_diffind.cli import main
from mi_diffind.operations import Operations
from mi_diffind.runtime import array_module
from mi_diffind.tradeoff import FLOOR, Candidate, Case, Settings, Study, measure, pareto

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = Settings(lanes=1024, rounds=4, passes=3, samples=100)


# -- the Pareto front -------------------------------------------------------------------------------------------------


def brute_force(points):
    def beats(a, b):
        return all(x <= y for x, y in zip(a, b, strict=True)) and any(x < y for x, y in zip(a, b, strict=True))

    return [not any(beats(q, p) for q in points) for p in points]


@pytest.mark.parametrize("dims", [1, 2, 3])
def test_front_against_brute_force(rng, dims):
    for size in (0, 1, 2, 30):
        points = rng.integers(0, 6, (size, dims)).astype(float).tolist()  # ties included
        assert pareto(points) == brute_force(points)


def test_front_of_known_points():
    assert pareto([(1, 5), (2, 3), (3, 3), (2, 3), (4, 1), (0.5, 9), (5, 1)]) == [
        True, True, False, True, True, True, False,
    ]  # fmt: skip
    assert pareto([(math.nan, 0), (1, 1), (2, 2)]) == [False, True, False]
    assert pareto([(math.inf, 0), (1, math.inf), (1, 1)]) == [True, False, True]


def test_slack_makes_near_values_equal():
    points = [(1.00, 5), (0.98, 6), (0.5, 9)]  # the second is hardly faster, and less accurate
    assert pareto(points) == [True, True, True]
    assert pareto(points, (0.03, 0)) == [True, False, True]
    assert pareto([(1.0, 5.0), (1.01, 5.0)], (0.03, 0)) == [True, True]


def test_spread():
    assert tradeoff.spread([3.0, 1.0, 2.0, math.nan, 5.0, 4.0]) == {"median": 3.0, "q1": 2.0, "q3": 4.0}
    assert math.isnan(tradeoff.spread([math.nan])["median"])


# -- a small study ----------------------------------------------------------------------------------------------------


class Log(list):
    """Names of what has been called, in order; the ``stop_at``-th call presses Ctrl-C."""

    stop_at = None

    def __call__(self, *what):
        self.append(what)
        if len(self) == self.stop_at:
            os.kill(os.getpid(), signal.SIGINT)


def small_study(log, fingerprint="1"):
    """Candidates ``slow`` (20 dB), ``good`` (30 dB), ``exact`` (the truth); a case with passes and one without."""
    ad = array_module(BACKENDS[0])
    x = dr.arange(ad.Float, SETTINGS.lanes) + 1
    dr.make_opaque(x)
    functions = {
        FLOOR: lambda: x,
        "slow": lambda: [dr.sqrt(x) * x, x + 1],
        "good": lambda: [x * x, x * 2],
        "exact": lambda: [x * 3, x],
    }

    def logged(case, query, name):
        def function():
            log("query", case, query, name)
            return functions[name]()

        return function

    def case(name, passes):
        return Case(
            name,
            lambda lanes: {q: {c: logged(name, q, c) for c in functions} for q in ("eval", "pdf")},
            (lambda: {c: lambda number, c=c: (log("pass", name, c, number), dr.sqrt(x))[1] for c in ("slow", "exact")})
            if passes
            else None,
            {"case": name},
        )

    def errors(name, db):
        def measured(samples):
            log("errors", name)
            return {"db": db, "samples": samples}

        return measured

    return Study(
        task="small",
        title="A small study",
        candidates=[
            Candidate("slow", "a", "x", 10, None, errors("slow", 20.0)),
            Candidate("good", "b", errors=errors("good", 30.0), in_passes=False),
            Candidate("exact", "c", is_truth=True, note="the truth"),
        ],
        cases=[case("first", True), case("second", False)],
        queries=("eval", "pdf"),
        accuracy="db",
        accuracy_label="PSNR, dB",
        ratios=[("slow", "good"), ("good", "exact"), ("slow", "nobody")],
        fingerprint=fingerprint,
        variant=f"{BACKENDS[0]}_ad_rgb",
        conclusions=lambda result: [f"{len(result['cases'])} cases done"],
    )


KERNELS = 2 * (3 + 1)  # queries × (candidates and the floor)
CALLS = 2 + 2 * KERNELS * (1 + SETTINGS.rounds) + 2 * (1 + SETTINGS.passes)


def test_everything_is_measured_in_turn(tmp_path):
    log = Log()
    result = measure(small_study(log), SETTINGS, tmp_path, progress=False)
    assert len(log) == CALLS and not result["interrupted"] and not result["resumed"]
    rounds = [entry[2:] for entry in log if entry[:2] == ("query", "first")][KERNELS:]
    for k in range(SETTINGS.rounds):  # each round has each once, every other one backwards
        this = rounds[k * KERNELS : (k + 1) * KERNELS]
        assert len(set(this)) == KERNELS
        assert this == (rounds[:KERNELS] if k % 2 == 0 else rounds[KERNELS - 1 :: -1])
    for case in ("first", "second"):
        for timing in result["cases"][case]["queries"]["eval"].values():
            assert timing["rounds"] == SETTINGS.rounds and timing["with_floor"] > 0
            assert timing["q1"] <= timing["time"] <= timing["q3"]
            assert timing["time"] == pytest.approx(timing["with_floor"] - timing["floor"])
    assert list(result["cases"]["first"]["passes"]["render"]) == ["slow", "exact"]
    assert result["cases"]["second"]["passes"] == {}
    passes = [e[2] for e in log if e[0] == "pass"]
    assert passes == ["slow", "exact", "slow", "exact", "exact", "slow", "slow", "exact"]  # the first compiles
    # A different random number in each pass, the same for all candidates
    assert [e[3] for e in log if e[0] == "pass" and e[2] == "slow"] == [0, 1, 2, 3]
    assert os.listdir(tmp_path) == ["tradeoff_small.partial.json"]  # until it is written
    report.write(result, tmp_path)
    assert sorted(os.listdir(tmp_path)) == ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]


def test_operations_are_those_of_the_candidate(tmp_path):
    found = measure(small_study(Log()), SETTINGS, progress=False)["cases"]["first"]["queries"]["eval"]
    counts = {name: tuple(found[name]["operations"][k] for k in ("add", "mul", "sqrt")) for name in found}
    assert counts == {"slow": (1, 1, 1), "good": (0, 2, 0), "exact": (0, 1, 0)}
    assert found["good"]["operations"]["instructions"] == 2


def test_numbers_from_known_times(monkeypatch):
    """Medians, quartiles, ratios by round, floor, units: with times that are made up."""
    current = []
    seconds = {FLOOR: 1.0, "slow": 9.0, "good": 3.0, "exact": 5.0}

    class Recording(Log):
        def __call__(self, *what):
            current[:] = what
            super().__call__(*what)

    log = Recording()

    def made_up(function):
        function()
        kind = current[0]
        if kind == "pass":
            return {"slow": 0.004, "exact": 0.002}[current[2]]
        round_number = (sum(e[0] == "query" for e in log) - 1) // KERNELS - 1
        disturbed = 1.0 if current[3] == FLOOR else (1.0, 1.0, 4.0, 1.0)[round_number % 4]
        return seconds[current[3]] * disturbed * SETTINGS.lanes / 1e9

    monkeypatch.setattr(tradeoff, "kernel_seconds", made_up)
    result = measure(small_study(log), SETTINGS, progress=False)
    case = result["cases"]["first"]
    slow, good = case["queries"]["eval"]["slow"], case["queries"]["eval"]["good"]
    assert slow["with_floor"] == pytest.approx(9) and slow["floor"] == pytest.approx(1)
    assert slow["time"] == pytest.approx(8) and slow["q1"] == pytest.approx(8)
    assert slow["q3"] == pytest.approx(8 + 27 / 4)  # one round of four took 36
    assert good["time"] == pytest.approx(2)
    ratio = case["ratios"]["eval"]["slow / good"]
    assert ratio["median"] == pytest.approx(4) and ratio["with_floor"] == pytest.approx(3)
    assert "slow / nobody" not in case["ratios"]["eval"]
    seconds["good"] = 1.1  # hardly more than the floor
    again = measure(small_study(Recording()), SETTINGS, progress=False)
    ratio = again["cases"]["first"]["ratios"]["eval"]["slow / good"]
    assert math.isnan(ratio["median"]) and ratio["with_floor"] == pytest.approx(9 / 1.1)
    assert case["passes"]["render"]["slow"]["time"] == pytest.approx(4)  # ms
    # `good` is faster and more accurate; the truth is not in competition
    assert (good["on_front"], slow["on_front"], case["queries"]["eval"]["exact"]["on_front"]) == (True, False, None)


def test_files(tmp_path):
    result = measure(small_study(Log()), SETTINGS, progress=False)
    paths = report.write(result, tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]
    with open(paths["csv"], encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0]) == [*report.COLUMNS, "db", "samples"]
    assert len(table) == 2 * 2 * 3 + 2 * 2  # queries, and passes of one case, kernels and with tracing
    first = table[0]
    assert (first["task"], first["case"], first["query"], first["candidate"]) == ("small", "first", "eval", "slow")
    assert (first["bytes"], first["training_seconds"], first["unit"], first["db"]) == ("10", "", "ns", "20")
    assert (first["add"], first["sqrt"], first["reads"], first["flops"]) == ("1", "1", "0", "6")
    whole = next(row for row in table if row["query"] == "render")
    assert whole["unit"] == "ms a pass" and whole["floor"] == whole["flops"] == ""
    assert json.loads(Path(paths["json"]).read_text(encoding="utf-8")) == report.finite(result)
    assert Path(paths["png"]).read_bytes()[:4] == b"\x89PNG"
    text = "\n".join(report.summary(result))
    assert "2 cases done" in text and "slow / good" in text and "exact: the truth" in text and "20.0 dB" in text


def test_json_has_no_nan():
    tree = report.finite({"a": math.nan, "b": [1.5, -math.inf], "c": ("x", None, True)})
    assert tree == {"a": None, "b": [1.5, None], "c": ["x", None, True]}


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
def test_interruption_keeps_what_is_done_and_the_same_command_goes_on(tmp_path, where):
    log = Log()
    log.stop_at = STOPS[where]
    result = measure(small_study(log), SETTINGS, tmp_path, progress=False)
    assert result["interrupted"] and len(log) == STOPS[where]  # it stops at once
    assert os.listdir(tmp_path) == ["tradeoff_small.partial.json"]
    if where in ("passes", "last"):
        assert result["cases"]["first"]["queries"]["eval"]["slow"]["rounds"] == SETTINGS.rounds
    if where == "rounds":  # one round and a part of the next: the part does not count
        assert result["cases"]["first"]["queries"]["pdf"]["good"]["rounds"] == 2
    assert len(report.summary(result)) > 1
    report.write(result, tmp_path)  # with whatever there is

    again = Log()
    finished = measure(small_study(again), SETTINGS, tmp_path, progress=False)
    assert finished["resumed"] and not finished["interrupted"]
    done = {e for e in log if e[0] == "errors"}
    assert not done & set(again)  # an error is not measured twice
    assert len(log) + len(again) <= CALLS + 2 * KERNELS + 2  # what was begun, and kernels of the case compiled again
    for case in finished["cases"].values():
        assert all(t["rounds"] == SETTINGS.rounds for q in case["queries"].values() for t in q.values())
        assert all(t["rounds"] == SETTINGS.passes for q in case["passes"].values() for t in q.values())
    report.write(finished, tmp_path)
    assert not list(tmp_path.glob("*.partial.json"))


@pytest.mark.parametrize("change", ["settings", "sources", "damage"])
def test_a_run_of_something_else_is_not_gone_on_with(tmp_path, change, capsys):
    log = Log()
    log.stop_at = CALLS - 1
    measure(small_study(log), SETTINGS, tmp_path, progress=False)
    study, settings = small_study(Log()), SETTINGS
    if change == "settings":
        settings = replace(SETTINGS, lanes=2048)
    elif change == "sources":
        study = small_study(Log(), fingerprint="2")
    else:
        (tmp_path / "tradeoff_small.partial.json").write_text('{"key": [1')
    result = measure(study, settings, tmp_path)
    assert not result["resumed"] and not result["interrupted"]
    assert "starting anew" in capsys.readouterr().err


def test_nothing_is_measured_again_if_writing_fails(tmp_path):
    measure(small_study(Log()), SETTINGS, tmp_path, progress=False)
    log = Log()
    result = measure(small_study(log), SETTINGS, tmp_path, progress=False)
    assert log == [] and result["resumed"]
    assert result["cases"]["second"]["queries"]["pdf"]["good"]["rounds"] == SETTINGS.rounds


def test_an_error_keeps_what_is_done(tmp_path):
    study = small_study(Log())
    study.cases[1].queries = lambda lanes: 1 / 0
    with pytest.raises(ZeroDivisionError):
        measure(study, SETTINGS, tmp_path, progress=False)
    result = measure(small_study(Log()), SETTINGS, tmp_path, progress=False)
    assert result["resumed"]


def test_fingerprint(tmp_path):
    (tmp_path / "a.py").write_text("1")
    (tmp_path / "b.py").write_text("2")
    both = tradeoff.fingerprint([tmp_path / "b.py", tmp_path / "a.py"])
    assert both == tradeoff.fingerprint([tmp_path / "a.py", tmp_path / "b.py"])
    (tmp_path / "a.py").write_text("3")
    assert both != tradeoff.fingerprint([tmp_path / "a.py", tmp_path / "b.py"])


# -- the picture ------------------------------------------------------------------------------------------------------


def crowd(rng, number):
    """Points of which many lie close together."""
    points = []
    for k in range(number):
        time, accuracy = float(np.exp(rng.normal(1, 0.6))), float(rng.choice([40, 41, 70, 110]))
        points.append(plot.Point(f"candidate {k}", time, 0.95 * time, 1.1 * time, accuracy, f"form {k % 5}", k == 0))
    return plot.Panel("crowd", "ns", points, [plot.Line("exact", 3.0, True), plot.Line("reference", 3.1, False)])


def test_labels_do_not_cover_each_other(rng):
    sheet = plot.draw("title", [crowd(rng, n) for n in (3, 8, 12)], "dB", "A caption of many words. " * 30)
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


def test_a_picture_of_little(tmp_path):
    alone = plot.Point("alone", 1.0, 0.0, 2.0, 50.0, "a", True)
    for panel in (plot.Panel("a", "ns", [alone], []), plot.Panel("b", "ns", [], [plot.Line("exact", 2.0, True)])):
        plot.write(tmp_path / "plot.png", "title", [panel], "dB", "caption")
        assert (tmp_path / "plot.png").stat().st_size > 5000


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def disney(tmp_path_factory):
    """Folder and result of a smoke run."""
    folder = tmp_path_factory.mktemp("disney") / "out"
    found = folder.parent / "report.json"
    code = main(["tradeoff", "disney", "--quick", "--out", str(folder), "--json", str(found)])
    assert code == 0
    return folder, json.loads(found.read_text(encoding="utf-8"))


def test_quick_run_writes_what_it_promises(disney):
    folder, found = disney
    assert sorted(os.listdir(folder)) == ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]
    with open(folder / "tradeoff.csv", encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    errors = ["mae_training", "mae_uniform", "psnr_db_training", "psnr_db_uniform"]
    assert list(table[0]) == [*report.COLUMNS, *errors]
    names = {row["candidate"] for row in table}
    stored = {f"{q}{s}" for q in ("tables", "paper") for s in ("", ", float16", ", uint8")}
    single = {f"only {factor} read" for factor in ("alpha", "masking", "cosine", "coat")}
    assert names == {"principled", "disney", "fast", *stored, *single}
    assert {row["query"] for row in table} == {"eval", "sample", "pdf", "render", "render, with tracing"}
    assert {row["case"] for row in table} == {"constant, all lobes", "textured, diffuse + specular"}
    for row in table:
        assert float(row["time_with_floor"]) > 0 and int(row["rounds"]) >= 2
        assert (row["psnr_db_training"] == "") == (row["candidate"] in ("principled", "disney"))
    written = json.loads((folder / "tradeoff.json").read_text(encoding="utf-8"))
    assert found.pop("files") == {k: str(folder / f"tradeoff.{k}") for k in ("csv", "json", "png")}
    assert written == found and not found["interrupted"]
    assert {"cpu", "cores", "variant", "mitsuba", "drjit", "mi-diffind"} <= set(found["machine"])
    assert (folder / "tradeoff.png").stat().st_size > 50_000


def test_candidates_are_what_they_are_called(disney):
    """Accuracies, reads and operations tell one from another: a wrong decoder or storage would show."""
    _, found = disney
    accuracy = {name: c["errors"].get("psnr_db_training") for name, c in found["candidates"].items()}
    assert accuracy["fast"] > 100
    single = [accuracy[f"only {factor} read"] for factor in ("masking", "cosine", "coat")]
    assert accuracy["paper"] < accuracy["tables"] < min(single)
    assert abs(accuracy["only alpha read"] - accuracy["tables"]) < 3  # the table that limits the others
    assert accuracy["tables, uint8"] < accuracy["tables"]
    bytes_of = {name: c["bytes"] for name, c in found["candidates"].items()}
    for quality in ("tables", "paper"):
        assert bytes_of[quality] == 2 * bytes_of[f"{quality}, float16"] == 4 * bytes_of[f"{quality}, uint8"] > 0
    assert bytes_of["fast"] == bytes_of["disney"] == bytes_of["principled"] == 0
    constant, textured = found["cases"].values()
    for query in ("eval", "sample"):
        reads = {name: t["operations"]["gathers"] for name, t in constant["queries"][query].items()}
        assert reads["fast"] == reads["disney"] == reads["principled"] == 0
        assert reads["only alpha read"] == reads["only coat read"] == 0  # read once
        assert 0 < reads["only masking read"] < reads["tables"] == reads["tables, float16"]
        assert reads["only masking read"] + reads["only cosine read"] == reads["tables"]
        assert 0 < reads["tables, uint8"] < reads["tables"] and 0 < reads["paper, uint8"] < reads["paper"]
    flops = {name: t["operations"]["flops"] for name, t in constant["queries"]["eval"].items()}
    assert flops["fast"] < flops["disney"] < flops["principled"]
    assert textured["queries"]["eval"]["fast"]["operations"]["gathers"] > 0
    # Base colour and roughness are textures for both; `specular` is not
    assert (
        textured["queries"]["eval"]["principled"]["operations"]["bytes_gathered"]
        == textured["queries"]["eval"]["fast"]["operations"]["bytes_gathered"]
    )


def test_textured_materials(mi_rgb):
    """Everything is a texture but `specular`, for which `principled` takes none."""
    from mi_diffind.tradeoffs import disney

    found = disney._material("textured", disney.ALL_LOBES)
    assert set(found) == {"base_color", *disney.ALL_LOBES} and found["specular"] == disney.ALL_LOBES["specular"]
    for name, texture in found.items():
        if name != "specular":
            data, around = np.array(texture["data"]), np.atleast_1d(disney.ALL_LOBES.get(name, disney.BASE_COLOR))
            assert data.shape == (64, 64, len(around)) and data.min() >= 0.01 and data.max() <= 0.99
            assert np.allclose(data.mean((0, 1)), around, atol=0.02) and (data.std((0, 1)) > 0.02).all()
    assert mi_rgb.load_dict({"type": "principled", **found}) is not None


def test_conclusions(disney):
    _, found = disney
    text = "\n".join(found["conclusions"])
    assert "exact, the paper's" in text and "bar, all lobes: principled / fast ≥ 1.5" in text
    assert "of the forms that read a table, the fastest" in text
    paper = found["about"]["paper_operations"]
    assert paper["exact, the paper's"]["flops"] == 92 + 150 + 2 * 17 + 4 * 5 + 4
    assert paper["tables, the paper's"]["flops"] == 11 + 26 + 4 and paper["tables, the paper's"]["gathers"] == 5


def fake_disney(monkeypatch, log):
    from mi_diffind.tradeoffs import TASKS

    assert "disney" in TASKS
    import mitsuba as mi

    mi.set_variant(f"{BACKENDS[0]}_ad_rgb")
    from mi_diffind.tradeoffs import disney

    monkeypatch.setattr(disney, "study", lambda quick: small_study(log))
    monkeypatch.setattr(Settings, "choose", classmethod(lambda cls, variant, quick=False: SETTINGS))


def test_command_interrupted_and_gone_on_with(tmp_path, monkeypatch, capsys):
    log = Log()
    log.stop_at = 2 + KERNELS * 4
    fake_disney(monkeypatch, log)
    out = str(tmp_path / "out")
    capsys.readouterr()
    assert main(["tradeoff", "disney", "--out", out]) == 130
    assert "Interrupted" in capsys.readouterr().out
    assert "tradeoff.json" in os.listdir(out) and "tradeoff_small.partial.json" in os.listdir(out)
    assert json.loads(Path(out, "tradeoff.json").read_text(encoding="utf-8"))["interrupted"]
    log.stop_at = None
    assert main(["tradeoff", "disney", "--out", out]) == 0
    captured = capsys.readouterr()
    assert "going on from" in captured.err and "Interrupted" not in captured.out
    assert sorted(os.listdir(out)) == ["tradeoff.csv", "tradeoff.json", "tradeoff.png"]


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--out", "/nowhere/out"], 'output folder "/nowhere/out" does not exist'),
        (["--variant", "nonsense"], 'the variant "nonsense" does not exist'),
        (["--variant", "scalar_rgb"], 'the plugins do not run in the variant "scalar_rgb"; use one of llvm_ad_'),
    ],
)
def test_bad_input(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(["tradeoff", "disney", *arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1 and error[0].startswith("mi-diffind: error: ") and message in error[0]


@pytest.mark.parametrize("arguments", [[], ["nerf"], ["disney", "--rounds", "3"]])
def test_bad_usage(arguments, capsys):
    with pytest.raises(SystemExit) as e:
        main(["tradeoff", *arguments])
    assert e.value.code == 2


def test_benchmark_is_the_same_command():
    script = ROOT / "tests" / "benchmarks" / "bench_disney.py"
    found = subprocess.run([sys.executable, str(script), "--help"], capture_output=True, text=True, timeout=60)
    assert found.returncode == 0 and "--quick" in found.stdout


def test_some_cases_have_fewer_candidates_and_other_queries(tmp_path):
    study = small_study(Log())
    study.cases[1] = replace(study.cases[1], candidates=("good", "exact"), query_names=("pdf",), in_picture=False)
    result = measure(study, SETTINGS, tmp_path, progress=False)
    assert list(result["cases"]["second"]["queries"]) == ["pdf"]
    assert list(result["cases"]["second"]["queries"]["pdf"]) == ["good", "exact"]
    assert list(result["cases"]["first"]["queries"]["eval"]) == ["slow", "good", "exact"]
    report.write(result, tmp_path)
    text = "\n".join(report.summary(result)).split("second")[1]
    assert "good" in text and "slow  " not in text.split("ratios")[0]


def test_operations_of_its_own(tmp_path):
    """What a kernel does not show, a candidate says itself."""
    study = small_study(Log())
    study.candidates[0].operations = lambda query: Operations(mul=1000 if query == "eval" else 2000)
    result = measure(study, SETTINGS, tmp_path, progress=False)
    found = result["cases"]["first"]["queries"]
    assert [found[q]["slow"]["operations"]["mul"] for q in ("eval", "pdf")] == [1000, 2000]
    assert found["eval"]["good"]["operations"]["mul"] < 10


class FakeTraining:
    """A training that takes ``runs`` calls: the others are interrupted."""

    def __init__(self, log, name="model", interrupted=0):
        self.log, self.name, self.interrupted = log, name, interrupted

    def run(self, folder, progress):
        self.log("train", self.name)
        if self.interrupted:
            self.interrupted -= 1
            return None
        run = {"steps": 2, "seconds": 3.0, "psnr_db": 20.0, "curve_steps": [1, 2], "curve_psnr_db": [10.0, 20.0]}
        return {"psnr_db": 20.0, "seconds": 3.0, "converged": False, "gain_db": 1.5, "runs": [run]}


def test_trainings_come_first_and_can_be_interrupted(tmp_path):
    log = Log()
    study = small_study(log)
    study.trainings, study.bytes_in_picture = [FakeTraining(log, interrupted=1)], True
    study.candidates[0] = replace(study.candidates[0], training="model", label="s")
    result = measure(study, SETTINGS, tmp_path, progress=False)
    assert result["interrupted"] and log == [("train", "model")] and not result["cases"]
    report.write(result, tmp_path)
    result = measure(study, SETTINGS, tmp_path, progress=False)
    assert not result["interrupted"] and log[1:3] == [("train", "model"), ("errors", "slow")]
    slow = result["candidates"]["slow"]
    assert (slow["training_seconds"], slow["converged"], slow["label"]) == (3.0, False, "s")
    assert result["candidates"]["good"]["converged"] is None
    paths = report.write(result, tmp_path)
    assert Path(paths["training"]).stat().st_size > 10_000
    assert "not converged" in "\n".join(report.summary(result))


@pytest.mark.parametrize(
    "times, verdict", [((1, 3), "arithmetic wins"), ((3, 1), "a table saves time"), ((1, 1), "no difference")]
)
def test_verdict(times, verdict):
    from mi_diffind.tradeoffs.disney import _verdict

    def timing(time, gathers):
        return {"time": time, "q1": 0.9 * time, "q3": 1.1 * time, "operations": {"gathers": gathers}}

    timings = {
        "fast": timing(times[0], 0),
        "tables": timing(times[1], 5),
        "once": timing(0.1, 0),
        "disney": timing(9, 0),
    }
    accuracy = {"fast": 150.0, "tables": 67.0, "once": 80.0}
    result = {
        "accuracy": "db",
        "candidates": {n: {"errors": {"db": accuracy[n]} if n in accuracy else {}} for n in timings},
        "cases": {"a case": {"queries": {"eval": timings}}},
    }
    (line,) = _verdict(result)
    assert verdict in line and f"tables, takes {times[1] / times[0]:.2f} times" in line and "67 dB" in line
