"""Properties of every plugin against the published table, and the commands that write the table and a GPU's report."""

import json
import subprocess
import sys
from pathlib import Path

import drjit as dr
import plugin_examples as examples
import pytest
import trust_properties as trust
from variants import VARIANTS, set_variant

ROOT = Path(__file__).resolve().parents[2]
TABLE = ROOT / "docs" / "measured" / "trust.json"

#: Properties that are always measured, in RGB: kernels without loops. Renders and all other variants are slow.
QUICK = ("energy", "reciprocity", "gradients")


def is_quick(variant: str, prop: str) -> bool:
    """Return whether a cell is measured by tests that always run."""
    return variant.endswith("_ad_rgb") and prop in QUICK


@pytest.mark.parametrize(
    "variant, name, prop",
    [
        pytest.param(v, name, prop, marks=() if is_quick(v, prop) else pytest.mark.slow)
        for v in VARIANTS
        for name in examples.names()
        for prop in trust.PROPERTIES
    ],
)
def test_what_the_table_says_holds(variant, name, prop, tmp_path, monkeypatch):
    """A property that holds in the table holds again, and what does not apply does not."""
    monkeypatch.chdir(tmp_path)  # where a failing χ² test leaves its histogram
    cells = json.loads(TABLE.read_text(encoding="utf-8"))["cells"]
    cell = cells[name][variant.replace("cuda_", "llvm_")][prop]  # on a GPU, that of the same colours on a processor
    if cell["result"] in (trust.FAILS, trust.NOT_RUN):
        pytest.skip(f"the table says: {cell['result']}: {cell['reason']}")
    effort = trust.QUICK if is_quick(variant, prop) else trust.Effort()
    result = trust.PROPERTIES[prop](set_variant(variant), name, effort)
    assert result.result == cell["result"], result


def test_the_table_has_every_plugin():
    """One row a plugin, one cell a variant and property; each figure has a limit, each other cell a reason."""
    table = json.loads(TABLE.read_text(encoding="utf-8"))
    assert set(table["cells"]) == set(examples.names())
    assert {"mi-diffind", "mitsuba", "drjit", "llvm", "cpu"} <= set(table["machine"]) and table["date"]
    for name, by_variant in table["cells"].items():
        for variant, row in by_variant.items():
            assert set(row) == set(trust.PROPERTIES)
            for prop, cell in row.items():
                assert cell["result"] in (trust.HOLDS, trust.FAILS, trust.NOT_APPLICABLE, trust.NOT_RUN)
                assert cell["reason"] and (cell["figure"] is None) == (cell["limit"] is None), (name, variant, prop)


def on_a_gpu(*arguments, folder):
    command = [sys.executable, str(ROOT / "tests" / "benchmarks" / "on_a_gpu.py"), *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.skipif(dr.has_backend(dr.JitBackend.CUDA), reason="this machine has a GPU")
def test_without_a_gpu_there_is_one_sentence(tmp_path):
    done = on_a_gpu(folder=tmp_path)
    assert done.returncode == 2 and not list(tmp_path.iterdir())
    assert done.stderr.count("\n") == 1 and "needs an NVIDIA GPU" in done.stderr


@pytest.mark.slow
def test_the_report_of_a_gpu_can_be_tried_on_a_processor(tmp_path):
    done = on_a_gpu("--variant", "llvm_ad_rgb", "--quick", "-o", "report.json", folder=tmp_path)
    assert done.returncode in (0, 1), done.stdout + done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["complete"] and report["tests"]["passed"] > 20 and not report["tests"]["failed"]
    assert set(report["trust"]["cells"]) == set(examples.names()) and report["times"]["ggx"]["ns"]["llvm_ad_rgb"]
    assert report["machine"]["mitsuba"] and done.returncode == int(bool(report["failures"]))
