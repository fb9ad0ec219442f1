"""``mi-diffind tradeoff``: studies that are found, interruption, bad input."""

import argparse
import json
import os
import sys
import types
from pathlib import Path

import pytest
from small_study import KERNELS, SETTINGS, Log, small_plan
from variants import BACKENDS

from mi_diffind.commands.cli import main
from mi_diffind.measure.benchmark import BenchmarkSettings
from mi_diffind.measure.study import Study
from mi_diffind.studies import studies

ROOT = Path(__file__).resolve().parents[2]

#: Studies that ship.
STUDIES = ["bsdf", "disney", "field", "ggx", "image", "scene", "scene-training", "sdf", "shading", "texture"]


class SmallStudy(Study):
    """One of another package: its plan is that of the frame's tests."""

    name = "small"
    title = "something small"

    def __init__(self, log):
        self.log = log

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--side", type=int, default=1)

    def check(self, arguments) -> None:
        if arguments.side < 1:
            raise ValueError(f"--side: found {arguments.side}, at least 1 is needed")

    def plan(self, arguments):
        return small_plan(self.log, {"side": arguments.side})


@pytest.fixture
def small(tmp_path, monkeypatch):
    """The log of a study that an installed package adds by an entry point."""
    from importlib import metadata

    log = Log()
    module = types.ModuleType("its_module")
    module.STUDY = SmallStudy(log)
    monkeypatch.setitem(sys.modules, "its_module", module)
    points = [metadata.EntryPoint("small", "its_module:STUDY", "mi_diffind.studies"),
              metadata.EntryPoint("ggx", "its_module", "mi_diffind.studies"),
              metadata.EntryPoint("broken", "no_such_module_at_all", "mi_diffind.studies")]  # fmt: skip
    others = metadata.entry_points
    monkeypatch.setattr(
        metadata, "entry_points", lambda **k: points if k.get("group") == "mi_diffind.studies" else others(**k)
    )
    monkeypatch.setattr(BenchmarkSettings, "choose", lambda quick: SETTINGS)
    studies.cache_clear()
    yield log
    monkeypatch.undo()
    studies.cache_clear()


def test_studies_are_found():
    assert list(studies()) == STUDIES
    titles = {name: studies().title(name) for name in STUDIES}
    assert titles == {name: study.title for name, study in studies().items()}


def test_studies_of_others_are_found(small):
    with pytest.warns(RuntimeWarning) as warned:
        assert list(studies()) == [*STUDIES, "small"]
    texts = sorted(str(w.message) for w in warned)
    assert len(texts) == 2 and "No module named 'no_such_module_at_all'" in texts[0]
    assert texts[1].startswith('"ggx" (its_module) is left out: mi_diffind.studies has ')


@pytest.mark.filterwarnings("ignore:.* is left out")
def test_command_interrupted_and_gone_on_with(small, tmp_path, capsys):
    log = small
    log.stop_at = 2 + KERNELS * 4
    out = str(tmp_path / "out")
    variant = ["--variant", f"{BACKENDS[0]}_ad_rgb", "--side", "2"]
    assert main(["tradeoff", "small", "--out", out, *variant]) == 130
    assert "Interrupted" in capsys.readouterr().out
    assert "tradeoff_small.json" in os.listdir(out) and "tradeoff_small.partial.json" in os.listdir(out)
    found = json.loads(Path(out, "tradeoff_small.json").read_text(encoding="utf-8"))
    assert found["interrupted"] and found["details"] == {"side": 2}
    log.stop_at = None
    assert main(["tradeoff", "small", "--out", out, *variant]) == 0
    captured = capsys.readouterr()
    assert "continuing from" in captured.err and "Interrupted" not in captured.out
    assert sorted(os.listdir(out)) == [f"tradeoff_small.{kind}" for kind in ("csv", "json", "png")]


@pytest.mark.filterwarnings("ignore:.* is left out")
def test_what_a_study_refuses(small, tmp_path, capsys):
    assert main(["tradeoff", "small", "--out", str(tmp_path / "out"), "--side", "0"]) == 2
    assert capsys.readouterr().err == "mi-diffind: error: --side: found 0, at least 1 is needed\n"
    assert not (tmp_path / "out").exists()


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
