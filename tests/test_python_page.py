"""Scripts of docs/python.md, as a reader copies them; notebooks and makers of scenes need public names only."""

import json
import re
from pathlib import Path

import pytest

import mi_diffind

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = re.findall(
    r"^## (.+?)$.+?^```python\n(.+?)^```", (ROOT / "docs" / "python.md").read_text("utf-8"), re.M | re.S
)
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAKERS = sorted((ROOT / "scenes").glob("*.py"))

#: Title of a script → the files that it leaves.
WRITTEN = {
    "Compress a material and render it filtered": ("tiles.npz", "floor.png"),
    "Recover maps from pictures": ("base_color.exr", "roughness.exr"),
    "Begin untrained": ("blank.npz",),
    "Freeze the steps of an optimisation": ("wall.exr",),
}


@pytest.mark.long
@pytest.mark.parametrize("title, script", SCRIPTS, ids=[title for title, _ in SCRIPTS])
def test_scripts_run(mi_rgb, no_garbage_collection, tmp_path, monkeypatch, capsys, title, script):
    assert sum(bool(line.strip()) for line in script.splitlines()) <= 40
    monkeypatch.chdir(tmp_path)
    exec(compile(script, title, "exec"), {"__name__": "__main__"})
    for name in WRITTEN[title]:
        assert (tmp_path / name).stat().st_size > 100
    if title.startswith("Recover"):
        errors = [list(map(float, re.findall(r"([0-9.]+) dB", line))) for line in capsys.readouterr().out.splitlines()]
        assert len(errors) == 3  # 35 and 31 dB; the grey start has 11 and 15
        assert all(colour > 28 and roughness > 24 for colour, roughness in errors)
    if title.startswith("Freeze"):
        before, after = map(float, re.findall(r"loss ([0-9.]+)", capsys.readouterr().out))
        assert after < 0.2 * before


def test_all_scripts_are_known():
    assert {title for title, _ in SCRIPTS} == set(WRITTEN)


@pytest.mark.parametrize("path", NOTEBOOKS + MAKERS, ids=[path.stem for path in NOTEBOOKS + MAKERS])
def test_only_public_names_are_needed(path):
    text = path.read_text("utf-8")
    if path in NOTEBOOKS:
        cells = [cell["source"] for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
        text = "\n".join("".join(source) for source in cells)
        assert re.findall(r"^\s*(?:from|import) mi_diffind.*$", text, re.M)
    assert not re.findall(r"^\s*(?:from|import) mi_diffind\.\w+", text, re.M)
    assert set(re.findall(r"\bmd\.(\w+)", text)) <= set(mi_diffind.__all__)
