"""``mi-diffind render --orbit``: a camera that goes once around a scene."""

import contextlib
import json
import sys
import threading

import numpy as np
import pytest
from commands import refused
from PIL import Image

from mi_diffind.commands import cli
from mi_diffind.scenes import loading, rendering

SCENE = """
<scene version="3.0.0">
    <integrator type="direct"><boolean name="hide_emitters" value="true"/></integrator>
    <emitter type="constant"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="32"/>
        <integer name="height" value="24"/><string name="pixel_format" value="rgba"/><rfilter type="box"/></film>
        <sampler type="independent"><integer name="sample_count" value="8"/></sampler>
        <transform name="to_world"><lookat origin="1,1,6" target="1,0,2" up="0,1,0"/></transform></sensor>
    <shape type="sphere"><point name="center" value="1, 0, 3"/><float name="radius" value="0.4"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.1, 0.1"/></bsdf></shape>
    <shape type="sphere"><point name="center" value="1, 0, 1"/><float name="radius" value="0.4"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.1, 0.8"/></bsdf></shape>
    <shape type="sphere"><point name="center" value="40, 0, 1"/><emitter type="area"/></shape>
</scene>
"""


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(SCENE)
    return file


def place_of(image, channel):
    """The mean column, from the middle, of pixels in which a channel is the largest of those that are not empty."""
    where = (image[..., :3].argmax(axis=-1) == channel) & (image[..., 3] > 0.5)
    return np.argwhere(where)[:, 1].mean() - 15.5, np.count_nonzero(where)


def test_the_camera_goes_around(mi_rgb, path):
    """Two spheres about the axis: after half a turn, the far one is the near one; a quarter shows both."""
    scene = loading.load(path)
    assert rendering.middle(scene) == pytest.approx([1, 0, 2])  # the light is none of it
    frames = rendering.render(scene, orbit=4, progress=False).frames
    assert len(frames) == 4 and frames[0].shape == (24, 32, 4)
    (x0, near), (x2, far) = place_of(frames[0], 0), place_of(frames[2], 0)
    assert abs(x0) < 0.5 and near > 1.3 * far and abs(x2) < 0.5
    # From +x, what has the larger z is on the left
    assert place_of(frames[1], 0)[0] < -3 and place_of(frames[1], 2)[0] > 3
    assert place_of(frames[3], 0)[0] > 3 and place_of(frames[3], 2)[0] < -3
    # The colours change places, nothing else does
    assert np.abs(frames[0][..., 3] - frames[2][..., 3]).mean() < 0.02
    again = loading.render(scene, 8)[0]
    assert np.abs(again - frames[0]).max() < 1e-6  # the camera is where it was


def test_random_numbers_of_frames(mi_rgb, path):
    """Frames of one view have the same noise, or that of the seeds that follow each other."""
    scene, still = loading.load(path), [np.eye(4)] * 2
    same, new = (rendering.along(scene, still, 4, 7, new_seeds=new_seeds) for new_seeds in (False, True))
    assert np.array_equal(same[0], same[1]) and np.array_equal(same[0], new[0])
    assert np.array_equal(new[1], loading.render(scene, 4, 8)[0]) and not np.array_equal(new[0], new[1])


def test_films_and_strips(mi_rgb, path, tmp_path, capsys):
    for name, count in (("film.webp", 3), ("film.gif", 3), ("strip.png", 8)):
        report = tmp_path / f"{name}.json"
        options = ("--orbit", str(count), "--spp", "4", "-o", str(tmp_path / name), "--json", str(report))
        assert cli.main(["render", str(path), *options]) == 0
        assert f"{name}: {count} frames of 32 x 24, 4 spp" in capsys.readouterr().out
        assert json.loads(report.read_text())["frames"] == count
    for name in ("film.webp", "film.gif"):
        with Image.open(tmp_path / name) as film:
            assert film.n_frames == 3 and film.size == (32, 24) and film.info["loop"] == 0
            film.seek(1)
            assert np.array(film.convert("RGBA"))[0, 0, 3] == 0
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.size == (6 * 32, 2 * 24)
        pixels = np.array(strip.convert("RGBA"))
    assert pixels[24:, : 2 * 32, 3].any() and not pixels[24:, 2 * 32 :].any()


def test_an_interrupted_orbit_keeps_its_frames(mi_rgb, path, tmp_path, monkeypatch, capsys):
    stop = threading.Event()
    stop.set()
    monkeypatch.setattr(rendering, "interruptible", lambda: contextlib.nullcontext(stop))
    assert cli.main(["render", str(path), "--orbit", "5", "--spp", "1", "-o", str(tmp_path / "strip.png")]) == 130
    assert "interrupted, kept 1 of 5 frames" in capsys.readouterr().out
    with Image.open(tmp_path / "strip.png") as strip:
        assert strip.size == (32, 24)


def test_what_is_refused(mi_rgb, path, tmp_path, capsys):
    for options, message in (
        (("--orbit", "3", "-o", str(tmp_path / "film.avi")), "allowed are .exr, .png, .mp4, .webp, .gif"),
        (("-o", str(tmp_path / "film.mp4")), "allowed are .exr and .png"),
    ):
        assert message in refused(capsys, "render", str(path), *options)


def test_h264_is_refused_before_frames_are_rendered(mi_rgb, path, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # as if it were not installed
    monkeypatch.setattr(rendering, "along", lambda *_, **__: pytest.fail("rendered"))
    message = refused(capsys, "render", str(path), "--orbit", "3", "-o", str(tmp_path / "film.mp4"))
    assert 'film.mp4": H.264 needs the package imageio-ffmpeg, which is not installed' in message
    assert [file.name for file in tmp_path.iterdir()] == ["scene.xml"]
