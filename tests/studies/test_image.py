"""``tradeoff image``: what is compared, how errors are measured, what is written, how a run goes on. Trainings take a
number of steps here, not of seconds: nothing depends on how fast the machine is."""

import csv
import dataclasses
import json
import math

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mi_diffind.commands.cli import main
from mi_diffind.fitting import loop
from mi_diffind.images import metrics
from mi_diffind.maps.source import from_arrays
from mi_diffind.studies.baselines import codecs
from mi_diffind.tasks.image import IMPROVEMENTS, replaced, training
from mi_diffind.tasks.image.arrays import CompressedImage

#: Steps of a training.
STEPS = 8


def smooth(height, width, channels, seed=0):
    random = np.random.default_rng(seed).random((height, width, channels))
    values = gaussian_filter(random, (3, 3, 0), mode="wrap")
    values = (values - values.min()) / (values.max() - values.min())
    return np.rint(255 * values).astype(np.uint8)


@pytest.fixture(scope="module", autouse=True)
def requested_seconds():
    """The seconds that trainings were requested_seconds to take; they take :data:`STEPS` steps."""
    seconds, fit_image = [], training.fit_image

    def stepwise(source, size, recipe, request, *options):
        seconds.append(request.deadline.total)
        recipe = replaced(recipe, steps=STEPS, batch=2**12)
        return fit_image(source, size, recipe, dataclasses.replace(request, deadline=None), *options)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "fit_image", stepwise)
        patch.setattr(CompressedImage._between, "__defaults__", (2**13,))
        yield seconds


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """The folder of a material of three maps."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("tradeoff")
    normal = np.concatenate([smooth(48, 64, 2), np.full((48, 64, 1), 255, np.uint8)], -1)
    maps = {"albedo": smooth(48, 64, 3, 1), "normal": normal, "roughness": smooth(48, 64, 1, 2)}
    for name, values in maps.items():
        mi.Bitmap(values).write(str(folder / f"{name}.png"))
    (folder / "m.json").write_text(json.dumps({name: f"{name}.png" for name in maps}))
    return folder


@pytest.fixture(scope="module")
def finished(material, requested_seconds):
    """The folder with the results of a quick run."""
    command = ["tradeoff", "image", str(material / "m.json"), "--quick", "--seconds", "3", "--dims", "4"]
    assert main([*command, "--out", str(material / "out"), "--json", str(material / "r.json")]) == 0
    assert requested_seconds == [3, 3]
    return material


def test_what_is_written(finished):
    result = json.loads((finished / "r.json").read_text())
    candidates = {name: c for name, c in result["candidates"].items() if not c["is_reference"]}
    trained = ["ours 12x 3 s", "paper 12x 3 s"]
    assert set(trained) <= set(candidates)
    for name, c in candidates.items():
        assert c["bytes"] > 0 and math.isfinite(c["errors"]["psnr_db"]), name
        assert c["competes"] == ("JPEG" not in name and "WebP" not in name), name
    for name in trained:
        c = candidates[name]
        assert c["details"]["ratio"] == pytest.approx(12, rel=0.05) and c["details"]["steps"] == STEPS
        assert c["bytes"] * c["details"]["ratio"] == pytest.approx(result["details"]["source_bytes"])
        assert c["training_seconds"] > 0 and c["details"]["seconds_asked"] == 3
    for place in ("random places", "coherent places"):  # the codecs have no kernels that read them
        assert set(result["cases"][place]["queries"]["read"]) == {*trained, "bitmap, 8 bits", "bitmap, floats"}
        for t in result["cases"][place]["queries"]["read"].values():
            assert t["time"] >= 0.2 * t["floor"] > 0
    assert [c for c, found in result["cases"].items() if found["in_picture"]] == ["random places"]
    with open(finished / "out" / "tradeoff_image.csv", encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    assert {r["candidate"] for r in table} == set(result["candidates"])
    by_name = {r["candidate"]: r for r in table}
    assert by_name["paper 12x 3 s"]["case"] == "coherent places" and by_name["bicubic 12x"]["case"] == ""
    for name, c in candidates.items():
        assert float(by_name[name]["psnr_normal_db"]) == pytest.approx(c["errors"]["psnr_normal_db"], rel=1e-5)
    assert (finished / "out" / "tradeoff_image.png").stat().st_size > 10_000
    assert not list((finished / "out").glob("*.partial*"))
    assert len(list((finished / "out" / "tradeoff_image_models").glob("*.npz"))) == 2


def test_panels(finished):
    """Bytes, training, reads; codecs have bytes only."""
    from mi_diffind.measure.report import panels

    found = panels(json.loads((finished / "r.json").read_text()))
    assert [p.title for p in found] == ["bytes", "training", "random places"]
    names = [{point.name for point in p.points} for p in found]
    assert names[1] == names[2] < names[0] and "bicubic 12x" in names[0] - names[1]
    assert not any(p.on_front for p in found[0].points if "no random access" in p.representation)
    assert {line.name.split(", below")[0] for line in found[2].lines} == {"bitmap, 8 bits", "bitmap, floats"}


def test_what_is_installed_takes_part(finished):
    result = json.loads((finished / "r.json").read_text())
    kinds = {c["details"].get("kind") for c in result["candidates"].values()}
    names = {"astc": "ASTC", "bc7": "BC7", "jpeg": "JPEG", "webp": "WebP", "bicubic": "bicubic"}
    assert {names[c] for c in codecs.available()} == kinds & set(names.values())


def test_what_is_left_out_is_said(mi_rgb, monkeypatch):
    from mi_diffind.studies.image import conclusions
    from mi_diffind.studies.image import plan as plans

    source = from_arrays({"albedo": smooth(32, 32, 3)})
    monkeypatch.setattr(codecs, "available", lambda: ("jpeg", "bicubic"))
    plan = plans.plan(source, "a.png", plans.ImageStudySettings())
    assert [c.name for c in plan.candidates if c.name.startswith(("ASTC", "BC7", "WebP"))] == []
    assert plan.notes[1].startswith("Left out: ASTC, BC7, WebP; needed: the packages astc-encoder-py, ")
    assert plan.notes[1].endswith("pip install astc-encoder-py ispc_texcomp texture2ddecoder pillow")
    lines = conclusions.table({"details": plan.details, "candidates": {}, "notes": plan.notes})
    assert plan.notes[1] in lines


def test_names_of_trainings(mi_rgb):
    from mi_diffind.studies.image import plan as plans

    source = from_arrays({"albedo": smooth(32, 32, 3)})
    settings = plans.ImageStudySettings((12.0, 6.0), (5.0, 2.0), (7.0,), (4, 3), ablation=True)
    names = [job.name for job in plans._trainings(plans.ImageStudyContext(source, "a", settings))]
    assert names[:4] == ["ours 12x 2 s", "ours 12x 5 s", "paper 12x 7 s", "ours 2D→3D 12x 2 s"]
    assert names[4:-1] == [f"ours without {name} 12x 2 s" for name in IMPROVEMENTS]
    assert names[-1] == "ours 6x 2 s"
    assert not any(c.in_picture for c in plans.plan(source, "a", settings).candidates if " without " in c.name)


def test_errors(mi_rgb):
    from mi_diffind.studies.image import plan as image

    reference = {"albedo": smooth(32, 32, 3), "normal": smooth(32, 32, 3, 1), "ao": smooth(32, 32, 1, 2)}
    source = from_arrays(reference)
    maps = {name: np.clip(v / 255 + 0.1 * (name == "ao"), 0, 1).astype(np.float32) for name, v in reference.items()}
    found = image.errors_of(source, maps)
    assert found["psnr_albedo_db"] == 120 and found["flip_albedo"] == 0 and found["ssim_albedo"] == pytest.approx(1)
    assert found["angle_normal_deg"] == pytest.approx(0, abs=1e-4)
    difference = np.rint(255 * maps["ao"]) / 255 - reference["ao"] / 255
    mse = np.mean(difference**2)
    assert found["psnr_ao_db"] == pytest.approx(-10 * math.log10(mse), abs=1e-3)
    assert found["psnr_db"] == pytest.approx(-10 * math.log10(mse / 7), abs=1e-3)
    assert found["psnr_mean_db"] == pytest.approx((240 + found["psnr_ao_db"]) / 3)
    assert found["flip"] == pytest.approx(found["flip_ao"] / 3) and found["flip_ao"] > 0.01
    assert image.between(source, maps) == pytest.approx(found["psnr_db"], abs=1)  # a nearly constant difference
    assert image.between(source, {n: v / 255 for n, v in reference.items()}) == 120


def test_angles():
    turned = np.radians(30)
    a, b = np.array([0.0, 0.0, 1.0]), np.array([np.sin(turned), 0.0, np.cos(turned)])
    images = [np.broadcast_to(0.5 + 0.5 * 0.7 * n, (8, 8, 3)) for n in (a, b)]  # of any length
    assert metrics.angle(*images) == pytest.approx(30, abs=1e-4)


def test_verdicts():
    from mi_diffind.studies.image import conclusions

    def candidate(kind, psnr, flip, compression=12.0, in_picture=True):
        errors = {"psnr_db": psnr, "psnr_between_db": psnr, "psnr_mean_db": psnr, "flip": flip}
        return {"details": {"kind": kind, "compression": compression}, "in_picture": in_picture, "errors": errors}

    candidates = {
        "ours": candidate("indirection", 40.0, 0.02), "worse": candidate("indirection", 30.0, 0.03),
        "without": candidate("indirection", 50.0, 0.0, in_picture=False), "blocks": candidate("ASTC", 39.0, 0.01),
        "ours at 6": candidate("indirection", 45.0, 0.01, 6.0),
    }  # fmt: skip
    (line,) = conclusions.conclusions({"candidates": candidates})
    assert line.startswith("12x, ours and blocks: PSNR 40.00 against 39.00: ours; ")
    assert line.endswith("FLIP 0.0200 against 0.0100: ASTC")


def test_a_run_goes_on(material, tmp_path, capfd, monkeypatch):
    """After Ctrl-C in the second training, the first is not trained again if its file exists."""
    import signal

    step, seen = loop._Trainer.take_step, []

    def interrupted(self, *args):
        seen.append(self.problem.recipe)
        if self.problem.recipe is not seen[0] and self.step == 2:
            signal.raise_signal(signal.SIGINT)
        return step(self, *args)

    command = ["tradeoff", "image", str(material / "albedo.png"), "--quick", "--seconds", "1", "--dims", "4"]
    command += ["--out", str(tmp_path)]
    monkeypatch.setattr(codecs, "available", lambda: ())
    with monkeypatch.context() as m:
        m.setattr(loop._Trainer, "take_step", interrupted)
        assert main(command) == 130
    assert (tmp_path / "tradeoff_image.partial.json").is_file()
    result = json.loads((tmp_path / "tradeoff_image.json").read_text())
    candidates = [name for name, c in result["candidates"].items() if not c["is_reference"]]
    assert result["interrupted"] and candidates == ["ours 12x 1 s"]
    capfd.readouterr()
    assert main(command) == 0
    out, err = capfd.readouterr()
    assert "continuing from" in err and "1 of 2" not in err and "2 of 2: paper" in err
    assert "paper 12x 1 s" in out


@pytest.mark.parametrize(
    "options, message",
    [
        (["--compression", "0"], "0"),
        (["--compression", "x"], "'x'"),
        (["--dims", "5"], "5"),
        (["--seconds", "0"], "0"),
    ],
)
def test_bad_options(material, tmp_path, options, message, capsys):
    command = ["tradeoff", "image", str(material / "albedo.png"), "--out", str(tmp_path / "out"), *options]
    try:
        assert main(command) == 2
    except SystemExit as e:
        assert e.code == 2
    assert message in capsys.readouterr().err


def test_variants_without_plugins_are_refused(material, capsys):
    assert main(["tradeoff", "image", str(material / "albedo.png"), "--variant", "scalar_rgb"]) == 2
    assert "do not run" in capsys.readouterr().err
    assert dr.has_backend(dr.JitBackend.LLVM)
