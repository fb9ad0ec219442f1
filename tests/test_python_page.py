"""Scripts of docs/python.md, as a reader copies them; and notebooks that need only the package's public names."""

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

#: Title of a script → the files that it leaves.
WRITTEN = {
    "Compress a material and render it filtered": ("tiles.npz", "floor.png"),
    "Recover a map from a picture": ("true.exr",),
    "Deform a distance field and save it": ("ball.npz", "deformed.npz"),
    "Capture, fit and place a radiance field": ("field.npz", "placed.png"),
}


@pytest.mark.parametrize("title, script", SCRIPTS, ids=[title for title, _ in SCRIPTS])
def test_scripts_run(mi_rgb, tmp_path, monkeypatch, capsys, title, script):
    lines = [line for line in script.splitlines() if line.strip()]
    assert len(lines) <= 25
    monkeypatch.chdir(tmp_path)
    exec(compile(script, title, "exec"), {"__name__": "__main__"})
    for name in WRITTEN[title]:
        assert (tmp_path / name).stat().st_size > 100
    if title.startswith("Recover"):
        errors = [float(e) for e in re.findall(r"recovered to ([0-9.]+) dB", capsys.readouterr().out)]
        assert len(errors) == 3 and min(errors) > 20  # 28 dB; the grey start has 11
    if title.startswith("Deform"):
        before, after = map(float, re.search(r"loss ([0-9.]+) → ([0-9.]+)", capsys.readouterr().out).groups())
        assert after < 0.8 * before


def test_all_scripts_are_known():
    assert {title for title, _ in SCRIPTS} == set(WRITTEN)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])
def test_notebooks_need_only_public_names(path):
    cells = [cell["source"] for cell in json.loads(path.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]
    text = "\n".join("".join(source) for source in cells)
    assert re.findall(r"^\s*(?:from|import) mi_diffind.*$", text, re.M)
    assert not re.findall(r"^\s*(?:from|import) mi_diffind\.\w+", text, re.M)
    assert set(re.findall(r"\bmd\.(\w+)", text)) <= set(mi_diffind.__all__)
