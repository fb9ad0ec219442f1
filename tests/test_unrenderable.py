"""Scenes that cannot be rendered, and pictures that are no numbers: one sentence each, in every command."""

import numpy as np
import pytest
from commands import refused

from mi_diffind.commands.cli import main
from mi_diffind.core import units
from mi_diffind.core.errors import UsageError
from mi_diffind.fitting.task import tasks
from mi_diffind.images import metrics
from mi_diffind.scenes import loading
from mi_diffind.scenes.rendering import render
from mi_diffind.scenes.viewer.page import status_lines
from mi_diffind.scenes.viewer.session import Session

PARTS = {
    "integrator": '<integrator type="path"><integer name="max_depth" value="2"/></integrator>',
    "sensor": '<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>'
    '</transform><film type="hdrfilm"><rfilter type="box"/><integer name="width" value="WIDTH"/><integer name="height" '
    'value="12"/></film></sensor>',
    "emitter": '<emitter type="constant"/>',
    "shape": '<shape type="sphere"><bsdf type="neural_disney"/></shape>',
}

#: Light that is NaN in half of the picture's pixels at most: where the sphere is.
NAN = '<emitter type="point"><rgb name="intensity" value="nan"/><point name="position" x="0" y="0" z="3"/></emitter>'


def scene_file(tmp_path, *without, more="", width=16):
    path = tmp_path / "scene.xml"
    parts = "".join(text for name, text in PARTS.items() if name not in without).replace("WIDTH", str(width))
    path.write_text(f'<scene version="3.0.0">{parts}{more}</scene>')
    return path


def commands(path, folder):
    """Return the commands that render the scene ``path``, by name."""
    return {
        "render": ["render", path, "-o", folder / "a.exr", "--spp", "2"],
        "orbit": ["render", path, "-o", folder / "a.png", "--spp", "1", "--orbit", "2"],
        "compare": ["compare", path, "--spp", "2", "--out", folder / "out"],
        "view": ["view", path, "--port", "0", "--seconds", "1", "--width", "64"],
        "regress": ["regress", path, "--update", "--references", folder / "references"],
        "equal time": ["compare", path, "--equal-time", "--spp", "1", "--out", folder / "out"],
    }


COMMANDS = ["render", "orbit", "compare", "view", "regress", "equal time"]


@pytest.mark.parametrize("name", COMMANDS)
@pytest.mark.parametrize("missing", ["integrator", "sensor"])
def test_scenes_without_a_part(tmp_path, capsys, name, missing):
    path = scene_file(tmp_path, missing)
    sentence = refused(capsys, *map(str, commands(path, tmp_path)[name]))
    assert f"scene.xml: has no {missing}, one is needed" in sentence
    assert sorted(f.name for f in tmp_path.rglob("*") if f.is_file()) == ["scene.xml"]


@pytest.mark.parametrize("missing", ["integrator", "sensor", "emitter"])
def test_what_is_not_rendered_from_the_sensor_needs_none(tmp_path, capsys, missing):
    """``capture`` has cameras of its own, and a path integrator if the scene has none; ``inspect`` renders nothing."""
    path = str(scene_file(tmp_path, missing))
    assert main(["inspect", path]) == 0
    views = ["--views", "1", "--test", "0", "--resolution", "8", "--spp", "1"]
    assert main(["capture", path, "-o", str(tmp_path / "views"), *views]) == 0
    capsys.readouterr()


@pytest.mark.parametrize("missing", ["emitter", "shape"])
def test_scenes_without_lights_or_shapes(tmp_path, capsys, missing):
    path = str(scene_file(tmp_path, missing))
    assert main(["render", path, "-o", str(tmp_path / "a.exr"), "--spp", "2"]) == 0
    warned = capsys.readouterr().err
    assert ("the picture is black, the scene has no emitter" in warned) == (missing == "emitter")


def test_scenes_in_memory(mi_rgb):
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "shape": {"type": "sphere"}}
    with pytest.raises(loading.SceneError, match="scene: has no integrator"):
        render(scene, 1)
    with pytest.raises(loading.SceneError, match="scene: has no integrator"):
        render(mi_rgb.load_dict(scene), 1)


@pytest.mark.parametrize("name", COMMANDS)
def test_films_beyond_the_memory(tmp_path, capsys, monkeypatch, name):
    """On a machine of 32 kB; the film of the viewer has the width that it is asked for."""
    monkeypatch.setattr(units, "memory", lambda: 2**15)
    sentence = refused(capsys, *map(str, commands(scene_file(tmp_path, width=64), tmp_path)[name]))
    assert "film: found 64 x 12 pixels, which takes about 0 GiB of memory" in sentence


@pytest.mark.parametrize("name", ["render", "orbit", "compare", "equal time"])
def test_absurd_samples(tmp_path, capsys, name):
    arguments = [*map(str, commands(scene_file(tmp_path), tmp_path)[name]), "--spp", "1000000000"]
    assert "spp: found 1,000,000,000 samples per pixel, allowed are 1 to 1,048,576" in refused(capsys, *arguments)
    with pytest.raises(UsageError, match="spp: found 0"):
        units.check_samples(0)


def test_render_counts_what_is_not_finite(tmp_path, capsys):
    import mitsuba as mi

    path = scene_file(tmp_path, more=NAN)
    assert main(["render", str(path), "-o", str(tmp_path / "a.exr"), "--spp", "2"]) == 0
    count = int(np.isnan(mi.render(mi.load_file(str(path)), spp=2, seed=0)).any(axis=2).sum())
    assert 0 < count < 192
    assert f"scene.xml: {count} of 192 rendered pixels are not finite" in capsys.readouterr().err
    assert render(path, 2, progress=False).figures["nonfinite_pixels"] == count
    assert render(scene_file(tmp_path), 2, progress=False).figures["nonfinite_pixels"] == 0


@pytest.mark.parametrize("name", ["compare", "equal time"])
def test_compare_refuses_what_is_not_finite(tmp_path, capsys, name):
    sentence = refused(capsys, *map(str, commands(scene_file(tmp_path, more=NAN), tmp_path)[name]))
    assert "pixels are not finite" in sentence and "of 192" in sentence


def test_capture_and_viewer_count_what_is_not_finite(tmp_path, capsys):
    path = scene_file(tmp_path, more=NAN)
    views = ["--views", "2", "--test", "0", "--resolution", "8", "--spp", "16"]
    assert main(["capture", str(path), "-o", str(tmp_path / "views"), *views]) == 0
    assert "of 64 pixels of a view have NaN or infinite samples" in capsys.readouterr().err
    session = Session(path, width=16, spp=1)
    session.refine()
    figures = session.figures
    assert figures["psnr_db"] is None and figures["nonfinite_pixels"] > 0
    assert f"**not finite** {figures['nonfinite_pixels']} pixels" in status_lines(session)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("error", [metrics.psnr, metrics.mae, metrics.flip, metrics.compare])
def test_no_error_of_what_is_not_finite(value, error):
    image = np.full((12, 12, 3), 0.5, np.float32)
    other = image.copy()
    other[3, 4, 1] = other[3, 4, 2] = other[0, 0, 0] = value
    for pair in ((image, other), (other, image)):
        with pytest.raises(UsageError, match="2 of 144 pixels are not finite"):
            error(*pair)
    assert metrics.nonfinite_pixels(other) == 2 and metrics.nonfinite_pixels(image) == 0


def test_inspect_refuses_measurements_that_are_no_numbers(monkeypatch, capsys):
    ggx = tasks()["ggx"]
    monkeypatch.setattr(ggx.model_class(), "measure", lambda self: {"mae": 0.1, "worst": np.nan, "psnr_db": np.inf})
    sentence = refused(capsys, "inspect", str(ggx.file()), "--measure")
    assert "ggx_tables.npz: as " in sentence and "worst is no number" in sentence
