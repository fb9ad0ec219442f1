"""The study of learned BSDFs: what it writes, and its candidates."""

import json
import os

import pytest

from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.studies.tradeoffs import tradeoff


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder and result of a smoke run."""
    folder = tmp_path_factory.mktemp("bsdf") / "out"
    report = folder.parent / "report.json"
    assert main(["tradeoff", "bsdf", "--quick", "--out", str(folder), "--json", str(report)]) == 0
    return folder, json.loads(report.read_text(encoding="utf-8"))


def test_quick_run_writes_what_it_promises(finished):
    folder, result = finished
    assert {f"tradeoff_bsdf.{kind}" for kind in ("csv", "json", "png")} <= set(os.listdir(folder))
    assert not result["interrupted"]
    ours = result["candidates"]["plastic, nonlinear: ours"]
    assert ours["bytes"] < 2300 and ours["errors"]["psnr_db"] > ours["errors"]["psnr_proxy_db"] > 35
    assert 1 <= ours["errors"]["moment_learned"] < 1.5
    queries = result["cases"]["plastic, nonlinear"]["queries"]
    assert set(queries) == {"eval", "eval_pdf", "sample"}
    assert {name.split(": ")[1] for name in queries["eval"]} >= {"source", "principled", "ours"}


def test_unknown_materials_are_refused(tmp_path):
    with pytest.raises(UsageError, match='found the material "gold", allowed are'):
        tradeoff("bsdf", "gold", out=tmp_path)
