"""Libraries of learned BSDFs: their files, reports, and going on with a folder."""

import json

import pytest
import worker_jobs
from PIL import Image

import mi_diffind
from mi_diffind.arrays.tables import load_table
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.tasks.bsdf import library

BSDF = '<bsdf version="3.0.0" type="{}"><float name="alpha" value="{}"/></bsdf>'

SCENE = """<scene version="3.0.0">
    <bsdf type="roughplastic" id="blue/paint"/><bsdf type="roughplastic" id="Blue paint"/>
    <bsdf type="diffuse" id="unused"/>
    <shape type="sphere"><ref id="blue/paint"/></shape><shape type="sphere"><ref id="Blue paint"/></shape>
    <shape type="sphere"><bsdf type="diffuse"/></shape>
</scene>"""


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Quick fits, here and in other processes."""
    monkeypatch.setattr(library, "fit_material", worker_jobs.fit_quickly)
    for module, name in worker_jobs.QUICK:
        monkeypatch.setattr(module, name, getattr(module, name))


def fit(folder, output, *options, capsys):
    """Fit a library by few steps; return the exit code and what was printed."""
    code = main(["fit", "bsdf", str(folder), "-o", str(output), "--steps", "5", "--batch", "512", *options])
    return code, capsys.readouterr().out


def test_a_library(mi_rgb, tmp_path, monkeypatch, capsys):
    """Two processes, of which one is killed, give the bytes of one; the next call keeps what has not changed."""
    source, one, two = tmp_path / "library", tmp_path / "one", tmp_path / "two"
    source.mkdir()
    (source / "killed.xml").write_text(BSDF.format("roughplastic", 0.1))
    (source / "plain name.xml").write_text(BSDF.format("roughconductor", 0.2))
    (source / "glass.xml").write_text('<bsdf version="3.0.0" type="dielectric"/>')
    (source / "read me.txt").write_text("no source")
    two.mkdir()
    code, text = fit(source, two, "--workers", "2", capsys=capsys)
    assert code == 1 and (two / "killed.npz.mark").exists()
    assert "3 materials: 2 fitted, 0 kept from before, 1 failed" in text
    assert "glass: glass.xml: transmits light, only BSDFs that reflect" in text
    report = json.loads((two / "report.json").read_text())
    assert {n: m["status"] for n, m in report["materials"].items()} == {
        "glass": "failed", "killed": "fitted", "plain_name": "fitted",
    }  # fmt: skip
    assert report["materials"]["plain_name"]["psnr_db"] == load_table(two / "plain_name.npz").measured["psnr_db"] > 20

    one.mkdir()
    (one / "killed.npz.mark").touch()
    (source / "glass.xml").unlink()
    assert fit(source, one, capsys=capsys)[0] == 0
    for name in ("killed.npz", "plain_name.npz"):
        assert (one / name).read_bytes() == (two / name).read_bytes(), name

    before = {file.name: file.stat().st_mtime_ns for file in one.glob("*.npz")}
    code, text = fit(source, one, capsys=capsys)
    assert code == 0 and "0 fitted, 2 kept from before, 0 failed" in text
    assert {file.name: file.stat().st_mtime_ns for file in one.glob("*.npz")} == before
    monkeypatch.setattr(library, "run_jobs", lambda function, jobs, *_: ())
    (source / "killed.xml").write_text(BSDF.format("roughplastic", 0.3))
    code, text = fit(source, one, capsys=capsys)
    assert code == 130 and "0 fitted, 1 kept from before, 0 failed, 1 left: the same command continues" in text
    assert "2 left: " in fit(source, one, "--energy", "raw", capsys=capsys)[1]


def test_names_and_identities(mi_rgb, tmp_path, monkeypatch):
    """Each material of a scene has a file of its own; identities follow options and the files that a source names."""
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    fitted = []
    monkeypatch.setattr(library, "run_jobs", lambda function, jobs, *_: fitted.append(jobs) or ())

    def materials(source, **options):
        mi_diffind.fit("bsdf", source, output=tmp_path / "out", progress=False, **options)
        return fitted[-1]

    assert {name: m.material for name, m in materials(scene, material="all").items()} == {
        "Blue_paint": "Blue paint", "blue_paint-2": "blue/paint",
    }  # fmt: skip
    folder = tmp_path / "library"
    folder.mkdir()
    (folder / "a.xml").write_text(
        '<bsdf version="3.0.0" type="diffuse"><texture type="bitmap" name="reflectance">'
        '<string name="filename" value="a.png"/></texture></bsdf>'
    )
    for name in ("b.xml", "b.bsdf"):
        (folder / name).write_text("")
    identities = []
    for colour, options in ((0, {}), (0, {}), (1, {}), (1, {"steps": 7}), (1, {"uv": (0.1, 0.2)})):
        Image.new("L", (1, 1), colour).save(folder / "a.png")
        found = materials(folder, **options)
        assert list(found) == ["a", "b", "b-2"]
        identities.append(found["a"].identity)
    assert identities[0] == identities[1] and len(set(identities)) == 4 and "" not in identities


def test_reports_of_measurements(tmp_path):
    """Materials that are known by samples alone have no PSNR, and materials that failed no figures."""
    figures = {
        "relative_error": 0.0123,
        "relative_error_floor": 0.011,
        "albedo_largest": 0.7,
        "sample_weight_moment": 1.1,
        "seconds": None,
    }
    records = {
        "cloth": {"status": "kept", "failure": "", "file": "cloth.npz", "bytes": 2148, **figures},
        "glass": {"status": "failed", "failure": "glass: transmits light", "file": "", "bytes": 0},
    }
    lines = library.FittedLibrary(None, None, folder=tmp_path, materials=records).summary()
    assert [line.split() for line in lines[2:4]] == [
        ["cloth", "kept", "2,148", "error", "1.2%", "1.1%", "–", "1.10"], ["glass", "failed", *"––––––"],
    ]  # fmt: skip
    assert lines[4] == "  glass: glass: transmits light"


def test_what_does_not_suit_is_refused(mi_rgb, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "full").mkdir()
    for source, options, message in (
        (tmp_path / "empty", {"output": "out"}, "empty: holds no sources, allowed are files that end in .xml, .bsdf"),
        (tmp_path / "full", {}, "output: found none, a library is written to a folder"),
        (tmp_path / "full", {"output": "a.npz"}, "output: found a.npz, a library is written to a folder"),
        (tmp_path / "full", {"output": "out", "seconds": 9}, "seconds: given for a library, which is limited by steps"),
        (tmp_path / "full", {"output": "out", "checkpoint": "c"}, "checkpoint: given for a library, which the same"),
        ({"type": "diffuse"}, {"workers": 2}, "workers: given for a single BSDF"),
        ({"type": "diffuse"}, {"output": "out"}, "found a folder for a single BSDF, a .npz file is needed"),
    ):
        options = {k: tmp_path / v if k in ("output", "checkpoint") and v != "a.npz" else v for k, v in options.items()}
        with pytest.raises(UsageError, match=message):
            mi_diffind.fit("bsdf", source, **options)
