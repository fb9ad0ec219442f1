"""``tradeoff image``: what is compared, how errors are measured, what is written, how a run goes on."""

import csv
import json
import math

import drjit as dr
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from mi_diffind import codecs, metrics
from mi_diffind.cli import main
from mi_diffind.tasks.image.source import from_arrays


def smooth(height, width, channels, seed=0):
    random = np.random.default_rng(seed).random((height, width, channels))
    values = gaussian_filter(random, (3, 3, 0), mode="wrap")
    values = (values - values.min()) / (values.max() - values.min())
    return np.rint(255 * values).astype(np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A material of three maps, and what a quick run leaves of it."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("tradeoff")
    normal = np.concatenate([smooth(48, 64, 2), np.full((48, 64, 1), 255, np.uint8)], -1)
    maps = {"albedo": smooth(48, 64, 3, 1), "normal": normal, "roughness": smooth(48, 64, 1, 2)}
    for name, values in maps.items():
        mi.Bitmap(values).write(str(folder / f"{name}.png"))
    (folder / "m.json").write_text(json.dumps({name: f"{name}.png" for name in maps}))
    command = ["tradeoff", "image", str(folder / "m.json"), "--quick", "--seconds", "1", "--dims", "4", "--dims", "2"]
    assert main([*command, "--out", str(folder / "out"), "--json", str(folder / "r.json")]) == 0
    return folder


def test_what_is_written(folder):
    result = json.loads((folder / "r.json").read_text())
    rows = {r["name"]: r for r in result["rows"]}
    assert {"ours 12x 1 s", "paper 12x 1 s", "ours 2D→2D 12x 1 s"} <= set(rows)
    for name, row in rows.items():
        assert row["bytes"] > 0 and math.isfinite(row["errors"]["psnr_db"]), name
        assert row["random_access"] == (row["representation"] not in ("JPEG", "WebP")), name
    for name in ("ours 12x 1 s", "ours 2D→2D 12x 1 s"):
        assert rows[name]["ratio"] == pytest.approx(12, rel=0.05)
        assert rows[name]["bytes"] == result["source_bytes"] / rows[name]["ratio"]
        assert rows[name]["seconds"] == pytest.approx(1, abs=0.7)
    for place in ("random", "coherent"):
        assert {"bitmap, 8 bits", "bitmap, floats"} < set(result["reads"][place])
        assert len(result["reads"][place]) == 5
    with open(folder / "out" / "tradeoff_image.csv", encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    assert [r["name"] for r in table] == list(rows)
    assert float(table[0]["psnr_normal_db"]) == pytest.approx(result["rows"][0]["errors"]["psnr_normal_db"])
    assert (folder / "out" / "tradeoff_image.png").stat().st_size > 10_000
    assert not list((folder / "out").glob("*.partial*"))
    assert len(list((folder / "out").glob("image_*.npz"))) == 3


def test_what_is_installed_takes_part(folder):
    rows = [r["representation"] for r in json.loads((folder / "r.json").read_text())["rows"]]
    names = {"astc": "ASTC", "bc7": "BC7", "jpeg": "JPEG", "webp": "WebP", "bicubic": "bicubic"}
    assert {names[c] for c in codecs.available()} == set(rows) & set(names.values())


def test_errors(mi_rgb):
    from mi_diffind.tradeoffs import image

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


def test_a_run_goes_on(folder, tmp_path, capfd, monkeypatch):
    """After Ctrl-C in the second training, the first is not made again."""
    import signal

    from mi_diffind import fitting

    step, seen = fitting._Trainer.take_step, []

    def interrupted(self, *args):
        seen.append(self.problem.recipe)
        if self.problem.recipe is not seen[0] and self.step == 2:
            signal.raise_signal(signal.SIGINT)
        return step(self, *args)

    command = ["tradeoff", "image", str(folder / "albedo.png"), "--quick", "--seconds", "1", "--dims", "4"]
    command += ["--out", str(tmp_path)]
    with monkeypatch.context() as m:
        m.setattr(codecs, "available", lambda: ())
        m.setattr(fitting._Trainer, "take_step", interrupted)
        assert main(command) == 130
        assert (tmp_path / "tradeoff_image.partial.json").is_file()
        result = json.loads((tmp_path / "tradeoff_image.json").read_text())
        assert result["interrupted"] and [r["name"] for r in result["rows"]] == ["ours 12x 1 s"]
        m.setattr(fitting._Trainer, "take_step", step)
        capfd.readouterr()
        assert main(command) == 0
    out, err = capfd.readouterr()
    assert "going on from" in err and "1 of 2" not in err and "2 of 2: paper" in err
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
def test_bad_options(folder, tmp_path, options, message, capsys):
    command = ["tradeoff", "image", str(folder / "albedo.png"), "--out", str(tmp_path / "out"), *options]
    try:
        assert main(command) == 2
    except SystemExit as e:
        assert e.code == 2
    assert message in capsys.readouterr().err


def test_variants_without_plugins_are_refused(folder, capsys):
    assert main(["tradeoff", "image", str(folder / "albedo.png"), "--variant", "scalar_rgb"]) == 2
    assert "do not run" in capsys.readouterr().err
    assert dr.has_backend(dr.JitBackend.LLVM)
