"""All studies: quick runs with the smallest sizes, bad options; errors of images, runs inside scenes."""

import csv
import json
import math
import signal
from pathlib import Path

import captures
import numpy as np
import pytest
import solid_meshes as solids
from texture_files import smooth, write_manifest

from mi_diffind.commands.cli import main
from mi_diffind.fitting import loop
from mi_diffind.maps.source import from_arrays
from mi_diffind.measure import benchmark
from mi_diffind.studies import image, studies

ROOT = Path(__file__).resolve().parents[2]

#: Study → arguments beside ``--quick``; files are those of the fixture ``inputs``.
RUNS = {
    "bsdf": [],
    "cost": ["bsdf"],
    "disney": [],
    "field": ["balls", "--compression", "120"],
    "ggx": [],
    "image": ["m.json", "--seconds", "1"],
    "scene-training": [str(ROOT / "scenes" / "training_floor.xml")],
    "sdf": ["ball.ply", "--bytes", "24k"],
    "shading": ["m.json", "--lambda", "1"],
    "texture": ["m.json", "--seconds", "1", "--compression", "2x"],
}

#: Study → pictures beside accuracy against time or bytes.
PICTURES = {
    "sdf": ["shapes"], "field": ["views"], "texture": ["crops", "levels"], "shading": ["lambda", "strip"],
}  # fmt: skip


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """The folder of a mesh, a capture of two balls and a material of three maps."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("inputs")
    captures.write(folder / "balls", 6, 2, 16)
    vertices, faces = solids.sphere(12)
    vertices[:, 2] = np.minimum(vertices[:, 2], 0.64 + 0.2 * vertices[:, 2])
    solids.write(folder / "ball.ply", (vertices, faces))
    normal = np.concatenate([smooth(48, 64, 2), np.full((48, 64, 1), 255, np.uint8)], -1)
    maps = {"albedo": smooth(48, 64, 3, 1), "normal": normal, "roughness": smooth(48, 64, 1, 2)}
    write_manifest(folder, maps)
    return folder


def test_all_studies_are_run():
    """They are found with their titles, without an import; those of others: ``test_thirdparty.py``."""
    titles = {name: studies().title(name) for name in RUNS}
    assert list(studies()) == list(RUNS) and titles == {name: study.title for name, study in studies().items()}


def run(study, inputs, out, *more):
    """The exit code of a study with the arguments :data:`RUNS`."""
    arguments = [str(inputs / word) if (inputs / word).exists() else word for word in RUNS[study]]
    first = next((i for i, word in enumerate(more) if word.startswith("-")), len(more))
    return main(["tradeoff", study, *more[:first], *arguments, "--quick", "--out", str(out), *more[first:]])


@pytest.mark.long
@pytest.mark.parametrize("study", RUNS)
def test_quick_runs(study, inputs, tmp_path, monkeypatch, capsys):
    """A run writes its table, JSON and pictures, and nothing else stays; all errors are numbers."""
    small = benchmark.BenchmarkSettings(2**10, 2, 1, 2**10, True)
    monkeypatch.setattr(benchmark.BenchmarkSettings, "choose", lambda quick: small)
    out = tmp_path / "out"
    assert run(study, inputs, out, "--json", str(tmp_path / "r.json")) == 0
    result = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    files = result.pop("files")
    written = json.loads((out / f"tradeoff_{study}.json").read_text(encoding="utf-8"))
    assert written == result and not result["interrupted"]
    assert set(files) >= {"csv", "json", "png", *PICTURES.get(study, [])}
    assert all(Path(path).stat().st_size > 5000 for path in files.values() if path.endswith(".png"))
    with open(files["csv"], encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert rows and capsys.readouterr().out.endswith(", ".join(files.values()) + "\n")
    if "candidates" not in result:
        return
    assert {row["candidate"] for row in rows} == set(result["candidates"])
    for name, c in result["candidates"].items():
        assert all(v is None or math.isfinite(v) for v in c["errors"].values()), name
        assert result["measures"][0]["key"] in c["errors"] or c["is_truth"] or c["is_reference"], name
    for case in result["cases"].values():
        assert all(t["with_floor"] > 0 for timings in case["queries"].values() for t in timings.values())


@pytest.mark.long
def test_a_run_goes_on(inputs, tmp_path, capfd, monkeypatch):
    """After Ctrl-C in the second training, the first is not trained again if its file exists."""
    step, seen, ratios = loop._Trainer.take_step, [], ["--compression", "12", "--compression", "6"]

    def interrupted(self, *args):
        seen.append(self.problem)
        if self.problem is not seen[0] and self.step == 0:
            patch.setattr(loop._Clock, "share", lambda clock: 0.5)  # its time is not over, however slow a step is
            signal.raise_signal(signal.SIGINT)
        return step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(loop._Trainer, "take_step", interrupted)
        assert run("image", inputs, tmp_path, *ratios) == 130
    assert len(list((tmp_path / "tradeoff_image_models").glob("*.npz"))) == 1
    capfd.readouterr()
    assert run("image", inputs, tmp_path, *ratios) == 0
    err = capfd.readouterr().err
    assert "1 of " not in err and "2 of " in err


@pytest.mark.parametrize(
    "study, options, message",
    [
        ("bsdf", ["gold"], 'found the material "gold", allowed are'),
        ("cost", ["glass"], 'found the row "glass", allowed are disney'),
        ("cost", ["--measured", "nowhere.bsdf"], "nowhere.bsdf: no such file"),
        ("field", ["--compression", "0"], "0"),
        ("image", ["--compression", "0"], "0"),
        ("image", ["--variant", "scalar_rgb"], "do not run"),
        ("scene-training", ["nowhere.xml"], "nowhere.xml, which is no file"),
        ("sdf", ["--bytes", "many"], "many"),
        ("shading", ["--lambda", "1.5"], "1.5"),
        ("shading", ["granite"], "hammered, weave, lacquer"),
        ("shading", ["weave", "weave"], "twice"),
        ("texture", ["--compression", "much"], "much"),
    ],
)
def test_bad_options(study, options, message, inputs, tmp_path, capsys):
    try:
        assert run(study, inputs, tmp_path / "out", *options) == 2
    except SystemExit as e:
        assert e.code == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out" / f"tradeoff_{study}.json").exists()


def test_errors(mi_rgb):
    reference = {"albedo": smooth(32, 32, 3), "normal": smooth(32, 32, 3, 1), "ao": smooth(32, 32, 1, 2)}
    source = from_arrays(reference)
    maps = {name: np.clip(v / 255 + 0.1 * (name == "ao"), 0, 1).astype(np.float32) for name, v in reference.items()}
    found = image.map_errors(source, maps)
    difference = np.rint(255 * maps["ao"]) / 255 - reference["ao"] / 255
    mse = np.mean(difference**2)
    assert found["psnr_db"] == pytest.approx(-10 * math.log10(mse / 7), abs=1e-3) and 0.01 < found["flip"] < 0.2
    assert found["psnr_between_db"] == pytest.approx(found["psnr_db"], abs=1)  # a nearly constant difference
    same = image.map_errors(source, {n: v / 255 for n, v in reference.items()})
    assert same["psnr_between_db"] == same["psnr_db"] == 120 and same["flip"] == 0
