"""Tables and figures of the pages are those of the JSON files that commands wrote."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import figures
import make_tables
import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"

#: Tables of more than ten rows in a page: each task or plugin has a row, or shorter ones would hide what ours loses.
LONG = {"trust", "shading_contenders"}


def test_pages_are_as_the_files_say():
    pages, troubles = make_tables.written()
    assert troubles == []
    assert [p.name for p, text in pages.items() if p.read_text(encoding="utf-8") != text] == []


@pytest.fixture
def copy(tmp_path):
    """A copy of README and docs, to be spoiled."""
    shutil.copytree(DOCS, tmp_path / "docs", ignore=shutil.ignore_patterns("*.jpg", "*.png", "__pycache__"))
    shutil.copy(ROOT / "README.md", tmp_path)
    for name in ("scenes", "plugins", "notebooks"):
        (tmp_path / name).symlink_to(ROOT / name)
    return tmp_path


def spoiled(text: str, place: int) -> str:
    """Change one digit."""
    return text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :]


def test_changes_by_hand_are_refused(copy):
    """A digit of a sentence, of a table and of a CSV file, a sentence that is gone, and a superfluous file."""
    claim = next(c for c in make_tables.claims() if c.page == "README.md")
    readme, page = copy / "README.md", copy / "docs" / "studies" / "sdf.md"
    data = copy / "docs" / "measured" / "field_errors.csv"
    text = readme.read_text(encoding="utf-8")
    readme.write_text(spoiled(text, claim.matches(text)[0].start(1)).replace("a grid of ", "the grid of "), "utf-8")
    text = page.read_text(encoding="utf-8")
    row = re.search(r"<!-- table sdf_errors_suzanne -->\n(?:\|.*\n)+?\| ours \| (\d)", text)
    page.write_text(spoiled(text, row.start(1)), encoding="utf-8")
    text = data.read_text(encoding="utf-8")
    data.write_text(spoiled(text, re.search(r"\d", text).start()), encoding="utf-8")
    (data.parent / "nothing.csv").write_text("a\n", encoding="utf-8")
    command = [sys.executable, str(copy / "docs" / "make_tables.py"), "--check"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    result = subprocess.run(command, capture_output=True, text=True, cwd=copy, env=environment)
    assert result.returncode == 1
    for name in ("README.md", "studies/sdf.md", "field_errors.csv"):
        assert f"{name}: would change" in result.stdout
    assert "README.md: no such sentence: “NeRF's lego" in result.stderr
    assert "measured/nothing.csv: no page has" in result.stderr


def test_each_figure_of_a_claim_is_checked():
    """A digit of any figure makes a page that differs from the one written."""
    for claim in make_tables.claims():
        text = claim.path.read_text(encoding="utf-8")
        for match in claim.matches(text):
            for group in range(1, len(match.groups()) + 1):
                place = match.start(group) + re.search(r"\d", match[group]).start()
                assert claim.written(spoiled(text, place)) == text, claim.text


def test_a_claim_in_words_that_does_not_hold_is_refused():
    claim = make_tables.Claim("README.md", "a grid of {n:.0f} dB", {"n": "nerf_scenes.rows[0].psnr_white_db"}, "1 > 2")
    with pytest.raises(figures.ClaimError, match="does not hold: 1 > 2"):
        claim.written("a grid of 5 dB")


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("nothing_of_this_name.x", r"docs/measured/nothing_of_this_name\.json: no such file"),
        ("nerf_scenes.row", r"nerf_scenes\.row: no entry 'row'; allowed: 'rows'"),
        ("nerf_scenes.rows[99].minutes", r"nerf_scenes\.rows\[99\]\.minutes: list index out of range"),
        ('one(nerf_scenes.rows, scene="chair")', "0 rows have"),
        ("nerf_scenes.rows[0].minutes / 0", "nerf_scenes.rows.*division by zero"),
    ],
)
def test_expressions_name_what_is_missing(expression, message):
    with pytest.raises(figures.ClaimError, match=message):
        figures.evaluate(expression)


def study_of(content):
    return json.loads(json.dumps(content), object_hook=figures.Entries)


def test_samples_at_equal_error():
    """Halfway between two counts in dB is their geometric mean; at a count, it is that count."""
    errors = {"bitmap, 1 spp": 10, "bitmap, 4 spp": 16, "bitmap, 16 spp": 22, "bitmap, 4 spp, multijittered": 20}
    errors |= {"ours": 19, "as four": 16, "best": 30}
    study = study_of({"candidates": {n: {"errors": {"psnr_plane_db": e}} for n, e in errors.items()}})
    assert figures.equal_samples(study, "plane", "ours") == pytest.approx(8)
    assert figures.equal_samples(study, "plane", "as four") == pytest.approx(4)
    assert figures.equal_samples(study, "plane", "as four", "multijittered") == pytest.approx(4**0.6)
    with pytest.raises(ValueError, match="no sample count"):
        figures.equal_samples(study, "plane", "best")


def test_rows_of_shaded_renders_and_contenders():
    """Means of seeds and views, the worst of these, the darkest patch, and the best of several filters."""

    def job(kind, label, psnr=(0, 0), **details):
        errors = dict(zip(("footprints_db", "with_noise_db"), psnr, strict=True))
        return {"errors": errors, "details": {"material": "oak", "kind": kind, "label": label, **details}}

    def rendered(plain, ours):
        views = {"plain": (plain, 0.8), "ours": (ours, 0.98)}
        figures = {n: {"psnr_db": v, "brightness": [{"near": 1.01, "far": b}]} for n, (v, b) in views.items()}
        return job("renders", "renders", renders={n: {"sun": {"1": f}} for n, f in figures.items()})

    jobs = [
        job("plain", "plain, seed 0", [20, 30]), job("run", "lambda 1, seed 0", [50, 50]),
        job("run", "ours, seed 0", [24, 34]), job("run", "ours, seed 1", [26, 36]),
        job("compressed", "Toksvig, ASTC", [21, 31]), job("compressed", "baked, ASTC", [22, 29]),
        job("classical", "LEAN", [40, 20]), job("classical", "baked", [50, 50]),
        rendered([20, 22], [23, 22.5]), rendered([20, 22], [24, 21]),
    ]  # fmt: skip
    study, other = (study_of({"jobs": dict(enumerate(rows))}) for rows in (jobs, jobs[:1]))
    (row,) = figures.shaded_renders(study, other)
    assert (row.before, row.after) == ({"1": 21}, {"1": 22.625})
    assert (row.gain, row.worst) == (1.625, -1)
    assert row.brightness == pytest.approx({"plain": -0.2, "ours": -0.02})
    rows = {row.label: (row.converged, row.single) for row in figures.shaded_contenders(study, other)}
    best = {"best filter, equal bytes": (22, 31), "LEAN, uncompressed": (40, 20)}
    assert rows == {"plain": (20, 30), "ours": (25, 35), **best}
    assert figures.over_filters("best filter, equal bytes", "single", study) == [4]


def test_ratios_are_medians_in_either_order():
    case = {
        "ratios": {"eval": {"a / b": {"median": 4.0}}},
        "queries": {"eval": {"a": {"time": 9}, "b": {"time": 3}, "c": {"time": 6}}},
    }
    study = study_of({"cases": {"plain": case}})
    assert figures.ratio(study, "plain", "eval", "a", "b") == 4
    assert figures.ratio(study, "plain", "eval", "b", "a") == 0.25
    assert figures.ratio(study, "plain", "eval", "c", "b") == 2
    assert figures.time_over(study, "plain", "eval", "a", "b") == 3


def test_cells_of_a_table():
    """Fields, several cells of one field, and a cell whose figure is missing."""
    known = {"row": figures.Entries(a=1.25, b=[1, 2])}
    text = '{row.a:.1f} | {cells(row.b)}\n | {"x" if row.a else "y"} | {row.c:.1f}'
    assert make_tables.cells_of(text, known, "–") == ["1.2", "1", "2", "x", "–"]
    with pytest.raises(figures.ClaimError, match="no entry 'c'"):
        make_tables.cells_of(text, known)


def test_each_file_has_its_command():
    files = {path.stem: path for path in (DOCS / "measured").glob("*.json")}
    commands = make_tables.commands()
    assert set(commands) == set(files)
    for name, command in commands.items():
        json.loads(files[name].read_text(encoding="utf-8"))
        program = re.sub("^git checkout [0-9a-f]{7} && ", "", command).split()[0]
        assert "docs/measured" in command and program in ("mi-diffind", "python")
        if command.startswith("python"):
            assert (ROOT / command.split()[1]).is_file(), command


def test_commands_are_accepted_today():
    """Each ``mi-diffind`` command that wrote a file of figures: its options exist."""
    from mi_diffind.commands import cli
    from mi_diffind.measure.study import Study
    from mi_diffind.studies import studies

    kept = [line for line in make_tables.commands().values() if not line.startswith("git checkout")]
    lines = [part for line in kept for part in line.split("&&")]
    words = [shlex.split(line)[1:] for line in lines if line.split()[0] == "mi-diffind"]
    for each in words:
        arguments = cli._parser(each).parse_args(each)
        if each[0] == "tradeoff":
            assert isinstance(studies()[arguments.study], Study)
    assert len(words) > 30


def test_numbers_that_no_file_backs():
    text = (
        "# A page\n\nAt 12x it has 34.5 dB after 1500 steps (Mitsuba 3.9, 2023, section 1.2, `x = 7`).\n"
        "<!-- table t -->\n| 8 |\n<!-- end -->\n"
    )
    (line,) = make_tables.unbacked("page.md", text)
    assert line.startswith("page.md:3: 34.5 ")
    found = [line for page, text in make_tables.pages().items() for line in make_tables.unbacked(page, text)]
    assert found == []


def test_each_phrase_of_the_settings_stands_in_its_page():
    pages = make_tables.pages()
    for page, phrases in figures.toml("settings.toml").items():
        for phrase in phrases:
            assert re.search(make_tables.phrase_pattern(phrase), pages[page]), f"{page}: {phrase}"


def test_long_tables_are_shortened():
    """A page shows at most ten rows, and links to all of them."""
    for name, table in make_tables.tables().items():
        text = table.page_text(name)
        assert 0 < len(table.shown) <= 10 or name in LONG, name
        assert (f"measured/{name}.csv" in text) == (len(table.shown) < len(table.rows)), name
        assert table.csv().count("\n") == len(table.rows) + 1
        assert {len(row) for row in table.rows} <= {len(table.head)} or name.startswith("texture_levels")
