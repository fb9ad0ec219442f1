"""Tables and figures of the pages are those of the JSON files that commands wrote."""

import json
import math
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

#: Numbers of a page that no file backs: more are refused, and whoever lowers a count lowers it here. Other pages: none.
UNBACKED = {}
#: Numbers of trials without a kept script, by the same rule.
TRIALS = {"04_sdf_from_images.ipynb": 16, "bsdf.md": 61, "field.md": 18, "shading.md": 16, "texture.md": 10}
#: Tables of more than ten rows in a page: each task or plugin has a row, or shorter ones would hide what ours loses.
LONG = {"cost", "cost_losses", "cost_sources", "trust", "shading_best"}


def test_pages_are_as_the_files_say():
    pages, troubles = make_tables.figures(make_tables.written())
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


def check(folder: Path) -> subprocess.CompletedProcess:
    command = [sys.executable, str(folder / "docs" / "make_tables.py"), "--check"]
    return subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )


def spoiled(text: str, place: int) -> str:
    """Change one digit."""
    return text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :]


def test_one_digit_that_is_changed_by_hand_is_refused(copy):
    assert check(copy).returncode == 0
    readme, page = copy / "README.md", copy / "docs" / "sdf.md"
    claim = next(c for c in figures.claims() if c.page == "README.md")
    whole = readme.read_text(encoding="utf-8")
    readme.write_text(spoiled(whole, claim.matches(whole)[0].start(1)), encoding="utf-8")
    result = check(copy)
    assert result.returncode == 1 and "README.md: would change" in result.stdout
    readme.write_text(whole, encoding="utf-8")

    whole = page.read_text(encoding="utf-8")
    row = re.search(r"<!-- table sdf_parts -->\n(?:.*\n){2}\| ours \| (\d)", whole)
    page.write_text(spoiled(whole, row.start(1)), encoding="utf-8")
    result = check(copy)
    assert result.returncode == 1 and "sdf.md: would change" in result.stdout


def test_each_figure_of_a_claim_is_checked():
    """A digit of any figure makes a page that differs from the one written."""
    for claim in figures.claims():
        text = claim.path.read_text(encoding="utf-8")
        for match in claim.matches(text):
            for group in range(1, len(match.groups()) + 1):
                place = match.start(group) + re.search(r"\d", match[group]).start()
                assert claim.written(spoiled(text, place)) == text, claim.text


def test_a_sentence_that_is_gone_is_named(copy):
    readme = copy / "README.md"
    readme.write_text(readme.read_text(encoding="utf-8").replace("a grid of ", "the grid of "), encoding="utf-8")
    result = check(copy)
    assert result.returncode == 1 and "README.md: no such sentence: “a grid of" in result.stderr


def test_a_claim_in_words_that_does_not_hold_is_refused():
    claim = figures.Claim("README.md", "a grid of {n:.0f} dB", {"n": "nerf_scenes.rows[0].psnr_white_db"}, "1 > 2")
    with pytest.raises(figures.ClaimError, match="does not hold: 1 > 2"):
        claim.written("a grid of 5 dB")


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("nothing_of_this_name.x", r"docs/measured/nothing_of_this_name\.json: no such file"),
        ("nerf_scenes.row", r"nerf_scenes\.row: no entry 'row'; allowed: 'rows'"),
        ("nerf_scenes.rows[99].minutes", r"nerf_scenes\.rows\[99\]\.minutes: list index out of range"),
        ('one(nerf_scenes.rows, scene="chair")', "0 rows have"),
        ("nerf_scenes.rows[0].minutes / 0", "claims.toml: nerf_scenes.rows.*division by zero"),
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
    errors |= {"ours": 19, "as four": 16}
    study = study_of({"candidates": {n: {"errors": {"psnr_plane_db": e}} for n, e in errors.items()}})
    assert figures.equal_samples(study, "plane", "ours") == pytest.approx(8)
    assert figures.equal_samples(study, "plane", "as four") == pytest.approx(4)
    assert figures.equal_samples(study, "plane", "as four", "multijittered") == pytest.approx(4**0.6)
    errors["ours"] = 30
    study = study_of({"candidates": {n: {"errors": {"psnr_plane_db": e}} for n, e in errors.items()}})
    with pytest.raises(ValueError, match="no sample count"):
        figures.equal_samples(study, "plane", "ours")


def test_time_at_equal_error():
    """An error that halves with each doubling of the time: the bitmap takes as long as the PSNR says."""
    times = {"bitmap, 1 spp": 2.0, "bitmap, 4 spp": 8.0, "bitmap, 16 spp": 32.0, "ours": 3.0, "best": 4.0}
    errors = dict(zip(times, (20, 20 + 20 * math.log10(2), 20 + 20 * math.log10(4), 29.0, 40.0), strict=True))
    study = study_of({
        "candidates": {name: {"errors": {"psnr_plane_db": psnr}} for name, psnr in errors.items()},
        "cases": {"plane": {"passes": {"render": {name: {"time": t} for name, t in times.items()}}}},
    })  # fmt: skip
    assert figures.time_at_equal_error(study, "plane", "ours") == (pytest.approx(2.0 * 10**0.9 / 3.0), False)
    assert figures.time_at_equal_error(study, "plane", "best") == (32.0 / 4.0, True)
    assert figures.time_at_equal_error(study, "plane", "bitmap, 4 spp") == (pytest.approx(1), False)


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


def test_figures_of_shading_are_those_of_its_table():
    """The function that sentences use, against the rows that the table has."""
    table = make_tables.shading_best(figures.measured("tradeoff_shading"))
    rows = [line.split(" | ") for line in str(table).splitlines()[2:]]
    for material in ("hammered", "weave", "lacquer"):
        by_label = {r[1]: r for r in rows if r[0].strip("| ") == material}
        (trained,) = [r for label, r in by_label.items() if label.startswith("trained")]
        (best,) = [r for label, r in by_label.items() if label.endswith("equal bytes")]
        study = figures.measured("tradeoff_shading")
        assert f"{figures.shading(study, material, 'trained'):.2f}" == trained[2].split()[0]
        assert f"{figures.shading(study, material, 'equal bytes'):.2f}" == best[2].split()[0]
        assert f"{figures.shading_level(study, material, 'trained', 3):.1f}" == trained[7]
        assert f"{figures.flip(study, material, 'trained'):.3f}" == trained[3]
        assert f"{figures.shading(study, material, 'trained', 'P'):.2f}" == trained[-1].strip(" |")


def test_each_file_has_its_command():
    files = {path.stem: path for path in (DOCS / "measured").glob("*.json")}
    commands = figures.commands()
    assert set(commands) == set(files)
    for name, command in commands.items():
        assert command.split()[0] in ("mi-diffind", "python") and "docs/measured" in command
        json.loads(files[name].read_text(encoding="utf-8"))
        if command.startswith("python"):
            assert (ROOT / command.split()[1]).is_file(), command


def test_numbers_are_classed():
    text = (
        "# A page\n\nAt 12x it has 34.5 dB after 1500 steps (Mitsuba 3.9, 2023, section 1.2, `x = 7`).\n"
        "<!-- table t -->\n| 8 |\n<!-- end -->\n<!-- trials: a script that is not kept -->\n9 dB\n<!-- /trials -->\n"
    )
    found = {n.number: n.kind for n in figures.numbers("page.md", text)}
    assert found == {
        "12": "setting", "34.5": "unbacked", "1500": "setting", "8": "backed", "9": "trial",
    }  # fmt: skip


def test_each_phrase_of_the_settings_stands_in_its_page():
    pages = figures.pages()
    for page, phrases in figures.toml("settings.toml").items():
        for phrase in phrases:
            assert re.search(figures.phrase_pattern(phrase), pages[page]), f"{page}: {phrase}"


def test_numbers_without_a_file_only_become_fewer():
    counts = {page: count["unbacked"] for page, count in figures.counts().items()}
    more = {page: n for page, n in counts.items() if n > UNBACKED.get(page, 0)}
    assert more == {}, "python docs/figures.py lists them"


def test_numbers_of_trials_only_become_fewer():
    counts = {page: count["trial"] for page, count in figures.counts().items() if count["trial"]}
    assert counts == TRIALS, "more are refused; fewer: lower the count here"


def test_long_tables_are_shortened():
    """A page shows at most ten rows, and links to all of them."""
    for name, make in make_tables.TABLES.items():
        table = make()
        text = table.of_page(name)
        rows = text.count("\n|") - 1
        assert rows <= 10 or name in LONG, name
        assert (f"measured/{name}.csv" in text) == (table.shown is not None), name
        assert table.csv().count("\n") == len(table.rows) + 1
        if table.shown:
            assert 0 < rows < len(table.rows), name


def test_a_changed_or_superfluous_csv_is_refused(copy):
    path = copy / "docs" / "measured" / "field_errors.csv"
    whole = path.read_text(encoding="utf-8")
    path.write_text(spoiled(whole, re.search(r"\d", whole).start()), encoding="utf-8")
    result = check(copy)
    assert result.returncode == 1 and "field_errors.csv: would change" in result.stdout
    path.write_text(whole, encoding="utf-8")
    (path.parent / "nothing.csv").write_text("a\n", encoding="utf-8")
    result = check(copy)
    assert result.returncode == 1 and "measured/nothing.csv: no page has" in result.stderr


def test_headlines_of_the_readme_are_backed():
    numbers = figures.numbers("README.md", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert [n for n in numbers if n.headline and n.kind == "unbacked"] == []


def test_commands_are_accepted_today():
    """Each ``mi-diffind`` command that wrote a file of figures: its options exist, and its methods are not cut."""
    from mi_diffind.commands import cli
    from mi_diffind.measure.study import Study
    from mi_diffind.studies import equal_memory, field, sdf, studies

    lines = [part for line in figures.commands().values() for part in line.split("&&")]
    words = [shlex.split(line)[1:] for line in lines if line.split()[0] == "mi-diffind"]
    for each in words:
        arguments = cli._parser(each).parse_args(each)
        if each[0] == "tradeoff":
            assert isinstance(studies()[arguments.study], Study)
            methods = {"field": field.METHODS, "sdf": sdf.METHODS}.get(arguments.study, ())
            if not getattr(arguments, "ablation", False):
                equal_memory.check_without(getattr(arguments, "without", ()), methods)
    assert len(words) > 40
