"""``mi-diffind tradeoff``: studies that are found, interruption, bad input."""

import argparse
import sys
import types

import pytest
from small_study import SETTINGS, Log, small_plan

from mi_diffind.commands.cli import main
from mi_diffind.measure.benchmark import BenchmarkSettings
from mi_diffind.measure.study import Study
from mi_diffind.studies import studies

#: Studies that ship.
STUDIES = ["bsdf", "disney", "field", "ggx", "image", "scene-training", "sdf", "shading", "texture"]


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
def test_what_a_study_refuses(small, tmp_path, capsys):
    assert main(["tradeoff", "small", "--out", str(tmp_path / "out"), "--side", "0"]) == 2
    assert capsys.readouterr().err == "mi-diffind: error: --side: found 0, at least 1 is needed\n"
    assert not (tmp_path / "out").exists()
