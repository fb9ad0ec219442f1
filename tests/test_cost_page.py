"""The page of costs holds the figures of the JSON files, and no cell is empty without a reason."""

import json
from pathlib import Path

import make_tables
import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"


def page_table(name: str) -> list[list[str]]:
    """Return the cells of a table of the page, without its head."""
    text = (DOCS / "cost.md").read_text(encoding="utf-8")
    lines = text.split(f"<!-- table {name} -->\n")[1].split("<!-- end -->")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines[2:]]


def measured(name: str) -> dict:
    return json.loads((DOCS / "measured" / f"{name}.json").read_text(encoding="utf-8"))


def test_figures_are_those_of_the_json():
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


def test_missing_figures_have_a_reason():
    """Each row with a cell that is not measured says why, and each row names the commands of its files."""
    commands = make_tables.commands()
    for row, cells, sources in zip(
        make_tables.cost_rows(), page_table("cost"), page_table("cost_sources"), strict=True
    ):
        assert row.files and all(commands[name].split(" --json")[0] in sources[1] for name in row.files)
        if any("not measured" in cell or "–" in cell.split("<br>") for cell in cells):
            assert any(reason in sources[2] for reason in ("not measured", "no plugin", "no file on disk")), cells[0]
