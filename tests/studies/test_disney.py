"""The study of the Disney BRDF: what it writes, its candidates, what it concludes."""

import csv
import json
import os

import numpy as np
import pytest

from mi_diffind.commands.cli import main
from mi_diffind.measure import report
from mi_diffind.studies.disney import REPRESENTATIONS, conclusions

ERRORS = ["mae_training", "mae_uniform", "psnr_db_training", "psnr_db_uniform"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder and result of a smoke run."""
    folder = tmp_path_factory.mktemp("disney") / "out"
    found = folder.parent / "report.json"
    code = main(["tradeoff", "disney", "--quick", "--out", str(folder), "--json", str(found)])
    assert code == 0
    return folder, json.loads(found.read_text(encoding="utf-8"))


def test_quick_run_writes_what_it_promises(finished):
    folder, found = finished
    files = {kind: f"tradeoff_disney.{kind}" for kind in ("csv", "json", "png")}
    files["training"] = "tradeoff_disney_training.png"
    assert sorted(os.listdir(folder)) == sorted([*files.values(), "tradeoff_disney_models"])
    with open(folder / "tradeoff_disney.csv", encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert list(table[0])[: len(report.COLUMNS)] == list(report.COLUMNS)
    details = found["candidates"]["network, bytes of tables"]["details"]
    others = set(list(table[0])[len(report.COLUMNS) :])
    assert set(ERRORS) <= others <= {*ERRORS, *details}
    names = {row["candidate"] for row in table}
    stored = {f"{q}{s}" for q in ("tables", "paper") for s in ("", ", uint8")}
    assert {c["representation"] for c in found["candidates"].values()} == set(REPRESENTATIONS)  # the words of --only
    single = {f"only {factor} read" for factor in ("alpha", "masking", "coat")}
    assert names == {"principled", "disney", "formulas", "network, bytes of tables", *stored, *single}
    assert {row["query"] for row in table} == {"eval", "sample", "pdf", "render", "render, with tracing"}
    assert {row["case"] for row in table} == {"constant, all lobes", "textured, diffuse + specular"}
    for row in table:
        assert float(row["time_with_floor"]) > 0 and int(row["rounds"]) >= 2
        assert (row["psnr_db_training"] == "") == (row["candidate"] in ("principled", "formulas"))
    written = json.loads((folder / "tradeoff_disney.json").read_text(encoding="utf-8"))
    assert found.pop("files") == {k: str(folder / name) for k, name in files.items()}
    assert written == found and not found["interrupted"]
    assert {"cpu", "cores", "variant", "mitsuba", "drjit", "mi-diffind"} <= set(found["machine"])
    assert (folder / "tradeoff_disney.png").stat().st_size > 50_000


def test_candidates_are_what_they_are_called(finished):
    """Accuracies, reads and operations tell one from another: a wrong decoder or storage would show."""
    _, found = finished
    accuracy = {name: c["errors"].get("psnr_db_training") for name, c in found["candidates"].items()}
    assert accuracy["disney"] > 100
    single = [accuracy[f"only {factor} read"] for factor in ("masking", "coat")]
    assert accuracy["paper"] < accuracy["tables"] < min(single)
    assert abs(accuracy["only alpha read"] - accuracy["tables"]) < 3  # the table that limits the others
    assert accuracy["tables, uint8"] < accuracy["tables"]
    bytes_of = {name: c["bytes"] for name, c in found["candidates"].items()}
    for preset in ("tables", "paper"):
        assert bytes_of[preset] == 4 * bytes_of[f"{preset}, uint8"] > 0
    network = found["candidates"]["network, bytes of tables"]
    assert bytes_of["tables, uint8"] < network["bytes"] <= network["details"]["equal_to_bytes"] == 832
    timed = {
        query for query, times in found["cases"]["constant, all lobes"]["queries"].items() if network["label"] in times
    }
    assert timed == {"eval"}
    assert bytes_of["formulas"] == bytes_of["disney"] == bytes_of["principled"] == 0
    constant, textured = found["cases"].values()
    for query in ("eval", "sample"):
        reads = {name: t["operations"]["gathers"] for name, t in constant["queries"][query].items()}
        assert reads["disney"] == reads["principled"] == reads.get("formulas", 0) == 0
        assert reads["only alpha read"] == reads["only coat read"] == 0  # read once
        assert 0 < reads["only masking read"] == reads["tables"]
        assert 0 < reads["tables, uint8"] < reads["tables"] and 0 < reads["paper, uint8"] < reads["paper"]
    flops = {name: t["operations"]["flops"] for name, t in constant["queries"]["eval"].items()}
    assert flops["disney"] < flops["principled"] and flops["disney"] < flops["formulas"]
    assert textured["queries"]["eval"]["disney"]["operations"]["gathers"] > 0
    # Base colour and roughness are textures for both; `specular` is not
    assert (
        textured["queries"]["eval"]["principled"]["operations"]["bytes_gathered"]
        == textured["queries"]["eval"]["disney"]["operations"]["bytes_gathered"]
    )


def test_textured_materials(mi_rgb):
    """Everything is a texture but `specular`, for which `principled` takes none."""
    from mi_diffind.studies.disney import plan as disney

    found = disney._material("textured", disney.ALL_LOBES)
    assert set(found) == {"base_color", *disney.ALL_LOBES} and found["specular"] == disney.ALL_LOBES["specular"]
    for name, texture in found.items():
        if name != "specular":
            data, around = np.array(texture["data"]), np.atleast_1d(disney.ALL_LOBES.get(name, disney.BASE_COLOR))
            assert data.shape == (64, 64, len(around)) and data.min() >= 0.01 and data.max() <= 0.99
            assert np.allclose(data.mean((0, 1)), around, atol=0.02) and (data.std((0, 1)) > 0.02).all()
    assert mi_rgb.load_dict({"type": "principled", **found}) is not None


def test_conclusions(finished):
    _, found = finished
    text = "\n".join(found["conclusions"])
    assert "exact, the paper's" in text and "bar, all lobes: principled / disney ≥ 2.5" in text
    assert "bar, all lobes: principled / tables, uint8 ≥ 0.952" in text
    assert "of the forms that read a table, the fastest" in text
    paper = found["details"]["paper_operations"]
    assert paper["exact, the paper's"]["flops"] == 92 + 150 + 2 * 17 + 4 * 5 + 4
    assert paper["tables, the paper's"]["flops"] == 11 + 26 + 4 and paper["tables, the paper's"]["gathers"] == 5


@pytest.mark.parametrize(
    "times, verdict", [((1, 3), "arithmetic wins"), ((3, 1), "a table saves time"), ((1, 1), "no difference")]
)
def test_verdict(times, verdict):
    def timing(time, gathers):
        return {"time": time, "q1": 0.9 * time, "q3": 1.1 * time, "operations": {"gathers": gathers}}

    timings = {
        "disney": timing(times[0], 0),
        "tables": timing(times[1], 5),
        "once": timing(0.1, 0),
    }
    accuracy = {"disney": 150.0, "tables": 67.0, "once": 80.0}
    result = {
        "accuracy": "db",
        "candidates": {n: {"errors": {"db": accuracy[n]} if n in accuracy else {}} for n in timings},
        "cases": {"a case": {"queries": {"eval": timings}}},
    }
    (line,) = conclusions._verdict(result)
    assert verdict in line and f"tables, takes {times[1] / times[0]:.2f} times" in line and "67 dB" in line
