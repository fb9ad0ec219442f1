"""The page of costs: its tables come from the JSON of the studies, and no cell is empty without a reason."""

import importlib.util
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"


def module(name: str):
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[name] = loaded
    spec.loader.exec_module(loaded)
    return loaded


@pytest.fixture(scope="module")
def cost_table():
    return module("cost_table")


def page_table(name: str) -> list[list[str]]:
    """Return the cells of a table of the page, without its head."""
    text = (DOCS / "cost.md").read_text(encoding="utf-8")
    lines = text.split(f"<!-- table {name} -->\n")[1].split("<!-- end -->")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def measured(name: str) -> dict:
    return json.loads((DOCS / "measured" / f"{name}.json").read_text(encoding="utf-8"))


def test_the_page_is_as_measured():
    """The tables of the page are those that ``make_tables.py`` makes of the JSON, and a changed digit is noticed."""
    make_tables = module("make_tables")
    page = DOCS / "cost.md"
    assert make_tables.written()[page] == page.read_text(encoding="utf-8")
    for name in ("cost", "cost_losses", "cost_sources"):
        assert str(make_tables.TABLES[name]()) in page.read_text(encoding="utf-8")


def test_figures_are_those_of_the_json():
    """Cells hold what the JSON of studies and of the benchmark holds, read here without the module of the table."""
    cells = {line[0] + line[1]: line[4:] for line in page_table("cost")}
    sdf = cells["[`neural_sdf`](sdf.md)mesh, Embree"]
    study = measured("tradeoff_sdf_suzanne")["candidates"]
    ours, paper = (study[name]["errors"]["normal_deg"] for name in ("ours 1 MiB", "paper 1 MiB"))
    assert sdf[0] == f"{ours:.2f}°<br>exact<br>{paper:.2f}°"
    bench = measured("bench_backward")["tasks"]["sdf"]
    for cell, size in ((sdf[1], "render"), (sdf[2], "step")):
        ratios = [bench[size][name]["ratio"]["median"] for name in ("ours", "mesh", "paper")]
        assert [float(text) for text in cell.split("<br>")] == pytest.approx(ratios, abs=0.005)
    field = cells["[`neural_field`](field.md)codebook (VQRF)"]
    study = measured("tradeoff_field")["candidates"]
    sizes = [study[f"{name} 75×"]["details"]["file_bytes"] for name in ("ours", "codebook", "paper")]
    units = {"MB": 1e6, "kB": 1e3}
    shown = [float(n) * units[unit] for n, unit in (text.split() for text in field[4].split("<br>"))]
    assert shown == pytest.approx(sizes, rel=0.005)


def test_missing_figures_have_a_reason(cost_table):
    """Each row with a cell that is not measured says why, and each row names commands."""
    notes = [line[2] for line in page_table("cost_sources")]
    rows = page_table("cost")
    assert len(rows) == len(notes) >= 10
    for cells, sources, note in zip(rows, page_table("cost_sources"), notes, strict=True):
        assert sources[1].count("`") >= 2
        if any("not measured" in cell or "–" in cell.split("<br>") for cell in cells):
            assert any(reason in note for reason in ("not measured", "no plugin", "no file on disk")), cells[0]
    assert set(cost_table.COMMANDS) <= {path.stem for path in (DOCS / "measured").glob("*.json")}


def test_a_loss_is_a_loss(cost_table):
    """Better and worse are told apart by the direction of the error, and ratios near 1 are equal."""

    def row(better, unit):
        good, bad = (40.0, 30.0) if better else (1.0, 2.0)
        ours = cost_table.Contender(good, 2.0, 1.02, 100, 10)
        theirs = cost_table.Contender(bad, 1.0, 1.0, 200, 0)
        return cost_table.Row("a", "a", "b", "e", unit, ours, theirs, theirs, {}, better=better)

    for better, unit in ((True, "dB"), (False, "°")):
        made = row(better, unit)
        wins, losses = cost_table.compared(made, made.theirs)
        assert len(wins) == 2 and wins[0].startswith("error") and wins[1].startswith("memory 0.5")
        assert len(losses) == 2 and losses[0].startswith("a render 2") and losses[1].startswith("disk 10 B")
    exact = cost_table.Contender(cost_table.EXACT)
    assert cost_table.compared(row(True, "dB"), exact) == ([], ["not exact"])
