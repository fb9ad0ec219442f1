"""``mi-diffind tradeoff``: the studies that ship, and what one refuses."""

from mi_diffind.commands.cli import main
from mi_diffind.measure.study import Study
from mi_diffind.studies import studies

#: Studies that ship; those of others are found by ``test_thirdparty.py``, the rules by ``test_task.py``.
STUDIES = ["bsdf", "cost", "disney", "field", "ggx", "image", "scene-training", "sdf", "shading", "texture"]


class Refusing(Study):
    name = "refusing"
    title = "nothing"

    def check(self, arguments) -> None:
        raise ValueError("--side: found 0, at least 1 is needed")


def test_studies_are_found():
    assert list(studies()) == STUDIES
    titles = {name: studies().title(name) for name in STUDIES}
    assert titles == {name: study.title for name, study in studies().items()}


def test_what_a_study_refuses(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(studies().data, "refusing", Refusing())
    assert main(["tradeoff", "refusing", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == "mi-diffind: error: --side: found 0, at least 1 is needed\n"
    assert not (tmp_path / "out").exists()
