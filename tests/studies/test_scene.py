"""The study of a scene: sample counts, whole runs of a tiny one, interruption."""

import csv
import itertools
import json
import math
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from mi_diffind.images import metrics
from mi_diffind.measure import bias
from mi_diffind.scenes import loading
from mi_diffind.scenes.loading import SceneError
from mi_diffind.studies import scene as study
from mi_diffind.studies.scene import VERSIONS, SceneStudySettings

FILES = ["tradeoff_scene.csv", "tradeoff_scene.json", "tradeoff_scene.png"]


def test_sample_counts_are_powers_of_two():
    full, quick = SceneStudySettings.choose(), SceneStudySettings.choose(quick=True)
    assert full.counts(64) == [1, 4, 16, 64] and full.counts(100) == [1, 4, 16, 64]
    assert full.counts(32) == [2, 8, 32] and full.counts(1) == [1] and full.counts(2) == [2]
    assert quick.counts(64) == [1, 2, 4] and quick.counts(1) == [1]
    assert SceneStudySettings.choose(spp=300).counts(64) == [1, 4, 16, 64, 256]
    assert SceneStudySettings.choose(quick=True, spp=16).counts(4) == [1, 2, 4, 8, 16]


SCENE = """<scene version="3.0.0">
    <default name="spp" value="16"/>
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="30"/>
        <transform name="to_world"><lookat origin="0, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="16"/> <integer name="height" value="12"/>
            <string name="pixel_format" value="rgb"/> <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value="0.5, 0.6, 0.7"/></emitter>
    <emitter type="directional"><vector name="direction" value="0.4, -0.8, -0.5"/></emitter>
    <shape type="sphere">MATERIAL</shape>
</scene>"""


LEARNED = """<bsdf type="neural_disney" id="ball"><string name="preset" value="paper"/>
    <rgb name="base_color" value="0.5, 0.3, 0.2"/> <float name="roughness" value="0.6"/> EXTRA</bsdf>"""


@pytest.fixture
def scene(tmp_path, mi_rgb):
    path = tmp_path / "ball.xml"
    path.write_text(SCENE.replace("MATERIAL", LEARNED.replace("EXTRA", "")), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def wholes():
    """Variant → what :func:`whole` has measured."""
    return {}


@pytest.fixture
def whole(scene, wholes, mi_rgb):
    """A whole run of the scene; what depends on time apart, all are the same."""
    if mi_rgb.variant() not in wholes:
        wholes[mi_rgb.variant()] = study.measure(scene, QUICK, progress=False)
    return wholes[mi_rgb.variant()]


QUICK = SceneStudySettings.choose(quick=True)


PASSES = 1 + 2 + 2 * QUICK.passes  # the first is for the brightness, and two compile


RENDERS = PASSES + 2 * QUICK.rounds * 2


class Renders(list):
    """Records the sample counts and seeds of passes; the ``stop_at``-th presses Ctrl-C."""

    def __init__(self, monkeypatch, stop_at=None):
        original = loading.render_pass

        def render_pass(loaded, spp, seed):
            self.append((spp, seed))
            if len(self) == stop_at:
                os.kill(os.getpid(), signal.SIGINT)
            return original(loaded, spp, seed)

        monkeypatch.setattr(loading, "render_pass", render_pass)


def errors_of(result):
    """All that does not depend on time."""
    points = [[p[k] for k in ("version", "spp", "mse", "mse_q1", "mse_q3", "psnr_db")] for p in result["points"]]
    crossover = {k: v for k, v in result["crossover"].items() if not k.startswith("seconds")}
    return points, result["bias"], result["noise"], result["reference"], crossover


def test_a_run_from_scene_to_picture(scene, tmp_path, monkeypatch):
    renders = Renders(monkeypatch)
    result = study.measure(scene, QUICK, tmp_path / "out", seed=3, progress=False)
    assert len(renders) == RENDERS and not result["interrupted"] and not result["resumed"]
    taken = renders[:1] + renders[3:]  # without what compiles
    top = {seed for spp, seed in taken if spp == 4}
    lower = {seed for spp, seed in taken if spp < 4}
    assert not top & lower and len(top) == 1 + QUICK.passes and len(lower) == 2 * QUICK.rounds  # twins share seeds

    assert [(p["spp"], p["version"]) for p in result["points"]] == list(itertools.product((1, 2, 4), VERSIONS))
    for p in result["points"]:
        assert p["images"] == (QUICK.passes if p["spp"] == 4 else QUICK.rounds) and 0 < p["timed"] <= p["images"]
        assert 0 < p["mse_q1"] <= p["mse"] <= p["mse_q3"] and p["rmse"] == pytest.approx(math.sqrt(p["mse"]))
        assert 0 < p["seconds_q1"] <= p["seconds"] <= p["seconds_q3"]
    for name in VERSIONS:  # noise as the passes' scatter has it, σ² / spp
        sigma = result["noise"][name]["mse_of_a_sample"]
        for p in (p for p in result["points"] if p["version"] == name):
            assert p["mse"] * p["spp"] == pytest.approx(sigma, rel=0.5)
    assert result["bias"]["measured"] and 20 < result["bias"]["psnr_db"] < 60
    crossover = result["crossover"]
    assert crossover["spp_low"] < crossover["spp"] < crossover["spp_high"]
    at_crossover = result["noise"]["learned"]["mse_of_a_sample"] / crossover["spp"]
    assert at_crossover == pytest.approx(result["bias"]["rmse"] ** 2)

    assert any(".npz" in name for name in os.listdir(tmp_path / "out"))
    paths = study.write(result, tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == FILES
    with open(paths["csv"], encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert len(table) == 2 * 3
    for row, p in zip(table, result["points"], strict=True):
        assert (row["scene"], row["version"], int(row["spp"])) == ("ball.xml", p["version"], p["spp"])
        assert float(row["mse"]) == pytest.approx(p["mse"], rel=1e-5) and float(row["seconds"]) > 0
        assert float(row["time_ratio"]) > 0
    assert json.loads(Path(paths["json"]).read_text(encoding="utf-8")) == result
    assert Path(paths["png"]).stat().st_size > 50_000
    text = "\n".join(study.summary(result))
    assert "ball.xml, 16 x 12, learned plugins: 1" in text and "PSNR" in text


def test_bias_is_that_of_converged_images(scene, whole, mi_rgb):
    """The bias, known with few samples, against the difference of two converged renders."""
    found = whole["bias"]
    written, exact = (loading.load(scene, exact=e) for e in (False, True))
    images = [mi_rgb.render(s, spp=4096, seed=77).numpy().astype(np.float64) for s in (written, exact)]
    weights = bias.relative_weights(images[1])
    rmse = math.sqrt(np.mean(weights * (images[0] - images[1]) ** 2))
    assert found["rmse"] == pytest.approx(rmse, abs=4 * found["rmse_standard_error"])
    assert found["rmse_standard_error"] < 0.15 * rmse
    assert found["psnr_db"] == pytest.approx(metrics.psnr(*images), abs=3)


@pytest.mark.parametrize("stop_at", [3, PASSES + 3, RENDERS - 1])
def test_interruption_and_the_same_errors_in_the_end(scene, whole, tmp_path, monkeypatch, capsys, stop_at):
    monkeypatch.setattr(study, "draw", lambda result: None)
    monkeypatch.setattr("mi_diffind.measure.plot.save", lambda sheet, path: Path(path).touch())
    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        renders = Renders(patch, stop_at)
        result = study.measure(scene, QUICK, out, progress=False)
    assert result["interrupted"] and len(renders) == stop_at
    assert (result["points"] == []) == (stop_at <= 7)
    paths = study.write(result, out)  # with whatever there is
    assert ("png" in paths) == (stop_at > 7) and "Interrupted" in "\n".join(study.summary(result))
    assert json.loads(Path(paths["json"]).read_text(encoding="utf-8"))["interrupted"]

    capsys.readouterr()
    renders = Renders(monkeypatch)
    finished = study.measure(scene, QUICK, out)
    assert "continuing from" in capsys.readouterr().err
    assert finished["resumed"] and not finished["interrupted"]
    assert len(renders) <= RENDERS - stop_at + 2 + 1  # compiled again, and the pair that was being rendered
    assert errors_of(finished) == errors_of(whole)
    done = len(renders)
    assert errors_of(study.measure(scene, QUICK, out)) == errors_of(whole) and len(renders) == done  # if writing fails
    study.write(finished, out)
    assert sorted(os.listdir(out)) == FILES


def test_values_that_are_not_finite_are_counted(scene, monkeypatch):
    original = loading.render_pass

    def render_pass(*arguments):
        image = original(*arguments)
        image[0, 0, 0] = math.nan
        return image

    monkeypatch.setattr(loading, "render_pass", render_pass)
    result = study.measure(scene, QUICK, progress=False)
    assert result["not_finite"] == 2 * (QUICK.passes + 2 * QUICK.rounds)
    assert math.isfinite(result["points"][0]["mse"])
    assert "counted as 0" in "\n".join(study.summary(result))


def test_scenes_without_a_learned_plugin(mi_rgb, tmp_path):
    plain = tmp_path / "plain.xml"
    plain.write_text(SCENE.replace("MATERIAL", '<bsdf type="diffuse"/>'), encoding="utf-8")
    with pytest.raises(SceneError, match=r"plain\.xml: names no learned plugin \(neural_bsdf, neural_disney"):
        study.measure(plain, QUICK, progress=False)
