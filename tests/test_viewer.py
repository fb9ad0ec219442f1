"""The viewer without a browser: passes, parts of pictures, parameters, table files, refused input."""

import json
import socket
import sys
import unittest.mock
from pathlib import Path

import numpy as np
import pytest

import mi_diffind
from mi_diffind.commands.cli import main
from mi_diffind.core import compat
from mi_diffind.core.errors import UsageError
from mi_diffind.images import srgb
from mi_diffind.scenes import loading
from mi_diffind.scenes.viewer import passes
from mi_diffind.scenes.viewer.page import Page, pad, server, status_lines
from mi_diffind.scenes.viewer.session import Session, combine

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "scenes" / "assets"
WIDTH, HEIGHT = 24, 16


def content(mi, integrator="path", roughness=0.3, origin=(0.6, 0.4, 3.5), paint="neural_disney", **given):
    """A ball in white surroundings, as for ``mi.load_dict``."""
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    bsdf = {"type": paint, "base_color": {"type": "rgb", "value": [0.8, 0.2, 0.1]}, "roughness": roughness}
    return {
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 3},
        "light": {"type": "constant"},
        "sensor": {
            "type": "perspective", "fov": 40, "film": film, "sampler": {"type": "independent", "sample_count": 16},
            "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0]),
        },
        "ball": {"type": "sphere", "bsdf": {**bsdf, **given}},
    }  # fmt: skip


def session(mi, **options):
    return Session(content(mi), WIDTH, seed=3, **options)


def check(shown, mi, passes=3, atol=1e-4, exact=True, **options):
    """Render passes, and compare them with the same ones of ``mi.render``."""
    for _ in range(passes):
        shown.refine()
    paints = ("neural_disney", "disney") if exact else ("neural_disney",)
    for side, paint in zip((shown.learned, shown.exact), paints, strict=False):
        scene = loading.load_dict(content(mi, **{"paint": paint, **options}))
        expected = loading.colour_channels(loading.render(scene, passes, 3, passes)[0])
        np.testing.assert_allclose(side.image, np.broadcast_to(expected, (HEIGHT, WIDTH, 3)), atol=atol)


@pytest.mark.parametrize("integrator", ["path", "path_sdf", "path_footprint", "prb", "ptracer"])
def test_a_picture_is_the_mean_of_mitsubas_passes(mi_rgb, integrator):
    """Both sides agree with Mitsuba; ``prb`` is written in Python, ``ptracer`` follows no rays of a camera."""
    shown = Session(content(mi_rgb, integrator), WIDTH, seed=3)
    check(shown, mi_rgb, integrator=integrator, atol=1e-3 if integrator == "ptracer" else 2e-6)
    assert shown.figures["samples"] == 3 and not shown.finished
    assert shown.learned.by_pixels == (integrator != "ptracer")
    assert shown.figures["psnr_db"] == pytest.approx(
        -10 * np.log10(np.mean((np.clip(shown.learned.image, 0, 1) - np.clip(shown.exact.image, 0, 1)) ** 2)), abs=1e-4
    )


def test_every_variant_shows_a_picture(mi_any):
    """Spectral and polarised ones by whole renders of Mitsuba; pixels of mono variants are grey."""
    shown = Session(content(mi_any), WIDTH, seed=3)
    check(shown, mi_any, 2, exact=False)
    assert 20 < shown.picture().mean() < 250
    assert shown.learned.by_pixels == (not mi_any.is_spectral and not mi_any.is_polarized)


def test_the_camera_moves_as_a_sensor_elsewhere(mi_rgb):
    shown, origin = session(mi_rgb), (-0.5, 1.5, 3.0)
    shown.refine()
    pose = np.array(mi_rgb.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0]).matrix, np.float64)
    assert shown.move_camera(pose) and not shown.move_camera(pose + 1e-9)
    assert shown.moving_picture().shape == (HEIGHT, WIDTH, 3)
    check(shown, mi_rgb, origin=origin)
    assert shown.figures["samples"] == 3 and shown.figures["to_world"][0][3] == pytest.approx(-0.5)
    np.testing.assert_allclose(shown.up(), [0, 1, 0])  # of the first view
    np.testing.assert_allclose(shown.target(), 0, atol=1e-5)


def test_a_mirrored_sensor_stays_mirrored(mi_rgb):
    flipped = content(mi_rgb)
    flipped["sensor"]["to_world"] = flipped["sensor"]["to_world"].scale([-1, 1, 1])
    flipped["lamp"] = {"type": "point", "position": [3, 0, 3], "intensity": 30.0}
    shown = Session(flipped, WIDTH, seed=3)
    shown.refine()
    expected = loading.render(loading.load_dict(flipped), 1, 3, 1)[0]
    np.testing.assert_allclose(shown.learned.image, expected, atol=1e-4)


def test_while_it_moves_each_side_renders_its_part(mi_rgb):
    """Also at a reduced size; the parts meet at the divider, and are no whole images to compare."""
    shown = session(mi_rgb)
    shown.show(divider=0.25)
    shown.reduction = 2
    picture = shown.moving_picture()
    assert picture.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert shown.exact.region == (12, 8, 0, 3) and shown.learned.region == (12, 8, 3, 12)
    assert (picture[:, 3] == 255).all() and (shown.exact.image[:, 3:] == 0).all()
    # A sample of the ball may be black
    assert (shown.exact.image[:, :3] > 0).mean() > 0.9 and (shown.learned.image[:, 3:] > 0).mean() > 0.9
    assert shown.figures["psnr_db"] is None and shown.figures["width"] == 12
    for divider in (0, 1):
        shown.show(divider=divider)
        assert (shown.moving_picture() > 0).mean() > 0.9
    shown.refine()
    assert shown.figures["psnr_db"] > 30 and shown.figures["width"] == WIDTH


def test_an_oversampled_truth_has_more_samples_unless_the_camera_moves(mi_rgb):
    texture = {"type": "neural_texture", "filename": str(ASSETS / "tiles_filtered.npz"), "channels": "albedo"}
    square = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    shown = Session(content(mi_rgb) | {"ball": square}, WIDTH)
    shown.moving_picture()
    assert shown.exact.samples == shown.learned.samples == 1
    shown.refine()
    shown.refine()
    assert (shown.learned.samples, shown.exact.samples, shown.figures["samples"]) == (2, 16, 2)
    assert shown.figures["psnr_db"] > 15
    mipmap = Session(content(mi_rgb) | {"ball": square}, WIDTH, against="mipmap")
    mipmap.refine()
    assert mipmap.exact.samples == 1 and mipmap.figures["against"] == "mipmap"


def test_divider_and_difference(rng):
    exact, learned = (rng.uniform(-0.2, 1.3, (5, 10, 3)).astype(np.float32) for _ in range(2))
    shown = combine(exact, learned, "side by side", 0.4, 1.0)
    for side, columns in ((exact, slice(0, 4)), (learned, slice(5, None))):
        expected = 255 * srgb.from_linear(np.clip(side, 0, 1))
        assert np.abs(shown[:, columns] - expected[:, columns]).max() <= 0.5 + 1e-3
    assert (shown[:, 4] == 255).all()
    a, b = (np.minimum(np.maximum(side, 0), 1) for side in (exact, learned))
    difference = 255 * srgb.from_linear(np.minimum(3 * np.abs(a - b), 1))
    assert np.abs(combine(exact, learned, "difference", 0.4, 3.0) - difference).max() <= 0.5 + 1e-3


def test_parameters_are_numbers_and_colours(mi_rgb):
    shown = session(mi_rgb)
    roughness, colour = (shown.parameters[f"ball.bsdf.{name}"] for name in ("roughness", "base_color"))
    assert (roughness.value, roughness.low, roughness.high) == (pytest.approx(0.3), 0, 1)
    assert colour.is_colour and colour.value == pytest.approx((0.8, 0.2, 0.1))
    fov = next(p for p in shown.parameters.values() if p.name == "x_fov")
    assert fov.value == pytest.approx(40) and (fov.low, fov.high) == (1, 170)
    assert next(iter(shown.parameters)).startswith("ball.bsdf.")  # of a plugin of the package: first
    assert not [path for path in shown.parameters if "to_world" in path or "size" in path]
    assert all(shown.on_both(path) for path in shown.parameters)


def test_a_changed_parameter_is_that_of_a_scene_written_so(mi_rgb):
    shown = session(mi_rgb)
    shown.refine()
    shown.set({"ball.bsdf.roughness": 0.9})
    check(shown, mi_rgb, roughness=0.9)
    shown.set({"ball.bsdf.base_color": (0.1, 0.2, 0.9)})
    shown.refine()
    assert shown.learned.image[HEIGHT // 2, WIDTH // 2, 2] > shown.learned.image[HEIGHT // 2, WIDTH // 2, 0]
    assert shown.figures["values"]["ball.bsdf.base_color"] == [0.1, 0.2, 0.9]


@pytest.mark.parametrize(
    "values, sentence",
    [
        ({"ball.color": 1}, r'parameter "ball\.color": not one of the \d+ numbers and colours of the scene'),
        ({"ball.bsdf.roughness": float("nan")}, "found nan, expected a finite number"),
        ({"ball.bsdf.roughness": "rough"}, "found rough, expected a finite number"),
        ({"ball.bsdf.base_color": (1, 2)}, r"found \(1, 2\), expected three finite numbers"),
    ],
)
def test_refused_values_leave_the_scene(mi_rgb, values, sentence):
    shown = session(mi_rgb)
    with pytest.raises(UsageError, match=sentence):
        shown.set({"ball.bsdf.metallic": 1.0, **values})
    assert shown.learned.parameters.value("ball.bsdf.metallic") == 0 and not shown.figures["values"]


def test_renders_that_cannot_be_recorded_are_traced_each_time(mi_rgb, monkeypatch):
    recorded = unittest.mock.Mock(side_effect=RuntimeError("cannot be recorded"))
    monkeypatch.setattr(passes.dr, "freeze", lambda function: recorded)
    shown = session(mi_rgb)
    check(shown, mi_rgb, atol=2e-6)
    assert not shown.learned.recordable


def test_a_scene_that_cannot_be_rendered_is_one_sentence(mi_rgb, monkeypatch):
    def fail(*arguments):
        raise RuntimeError("[path.cpp:12] no light")

    shown = session(mi_rgb)
    with monkeypatch.context() as patched:
        patched.setattr(passes, "_sample_pixels", fail)
        with pytest.raises(loading.SceneError, match=r"^no light$"):
            shown.refine()
    shown.refine()  # nothing stays behind
    assert shown.figures["samples"] == 1 and shown.learned.recordable


FILES = ("tiles_filtered.npz", "tiles.npz", "library/chrome.npz", "knot.npz", "group.npz")


@pytest.mark.parametrize("file", [*FILES, ROOT / "mi_diffind/data/ggx_tables.npz"])
def test_table_files_are_shown(mi_rgb, file):
    """Texture, image, BSDF, distance field, radiance field, GGX: something in the middle, and not everywhere."""
    shown = Session(ASSETS / file, 32)
    picture = shown.refine()
    assert picture.shape == (18, 32, 3) and (5 if file == "group.npz" else 20) < picture[6:12, 12:20].mean() < 200
    assert shown.figures["table_bytes"] > 500
    assert picture.astype(float).std(axis=(0, 1)).max() > 8
    assert shown.exact is not None or "exist" in shown.refusal or "source" in shown.refusal


def test_scenes_end_with_their_session(mi_rgb, no_garbage_collection):
    """Without the collector, which would free a scene within another one's render: Mitsuba crashes."""
    shown = session(mi_rgb)
    shown.refine()
    kept = [shown.learned.scene, shown.exact.scene]
    del shown
    while kept:
        assert not compat.is_shared([kept.pop()])


def test_a_scene_without_learned_plugins_has_one_side(mi_rgb):
    shown = Session(content(mi_rgb, paint="principled"), WIDTH)
    shown.refine()
    assert shown.views == ("learned",) and "names no learned plugin" in shown.refusal
    assert any("names no learned plugin" in line for line in status_lines(shown))
    with pytest.raises(UsageError, match=r'view: found "exact", allowed are learned \(the scene names no'):
        shown.show("exact")


def test_refused_input(mi_rgb, tmp_path):
    scene = content(mi_rgb)
    still = {"type": "irradiancemeter", "film": scene["sensor"]["film"]}
    (tmp_path / "broken.npz").write_bytes(b"PK")
    for source, options, error, sentence in (
        (scene, {"width": 8}, UsageError, "width: found 8, allowed are whole numbers from 16 to 4096"),
        (scene, {"spp": 2**17}, UsageError, "spp: found 131072, allowed are whole numbers from 1 to 65536"),
        (scene, {"against": "bitmap"}, loading.SceneError, 'against: found "bitmap", allowed are exact, '),
        (scene, {"defines": {"a": 1}}, UsageError, "defines: given with a scene in memory"),
        (loading.load_dict(scene), {}, UsageError, "found a loaded scene, which cannot be changed any more"),
        (ASSETS / "tiles.npz", {"defines": {"a": 1}}, UsageError, r"tiles\.npz: found a table file with defines"),
        ({k: v for k, v in scene.items() if k != "sensor"}, {}, loading.SceneError, "has no sensor"),
        ({**scene, "sensor": {"type": "rectangle", "meter": still}}, {}, loading.SceneError, "cannot be moved"),
        (tmp_path / "broken.npz", {}, mi_diffind.TableError, "broken"),
    ):
        with pytest.raises(error, match=sentence):
            Session(source, **options)
    shown = session(mi_rgb)
    with pytest.raises(UsageError, match='view: found "both", allowed are side by side, learned, exact, difference'):
        shown.show("both")
    with pytest.raises(UsageError, match="camera: found a position or a direction that is not finite"):
        shown.move_camera(shown.pose * np.nan)


def test_bars_beside_a_picture(rng):
    picture = rng.integers(1, 255, (10, 20, 3)).astype(np.uint8)
    for aspect, shape in ((2.0, (10, 20)), (1.0, (20, 20)), (4.0, (10, 40)), (0.0, (10, 20))):
        shown = pad(picture, aspect)
        assert shown.shape[:2] == shape and (shown > 0).sum() == picture.size
        np.testing.assert_array_equal(shown[(shown > 0).all(-1)], picture.reshape(-1, 3))


def test_without_viser_a_sentence_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UsageError, match=r"the package viser, which is not installed: pip install viser$"):
        server("127.0.0.1", 0)


def test_addresses_that_cannot_be_served():
    pytest.importorskip("viser", reason="the optional package viser is not installed")
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        for host, number, sentence in (
            ("127.0.0.1", port, f"127.0.0.1:{port}: the page cannot be served there"),
            ("203.0.113.1", 0, "203.0.113.1:0: the page cannot be served there"),
            ("127.0.0.1", 70000, "port: found 70000, allowed are whole numbers from 0 to 65535"),
        ):
            with pytest.raises(UsageError, match=sentence):
                server(host, number)


def test_requests_of_the_page(mi_rgb):
    """Without a browser: a moved camera, a value, a refused one, which the page reports, and all samples."""
    pytest.importorskip("viser", reason="the optional package viser is not installed")
    served = server("127.0.0.1", 0)
    try:
        shown = session(mi_rgb, spp=2)
        page = Page(shown, served)
        while page._step():
            pass
        assert shown.finished and "**samples** 2 of 2" in page._status.content
        before = page._picture
        page._camera = (np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.2, 0.0, 4.0]))
        assert page._step() and shown.moving
        # viser's camera looks along +z with y down; Mitsuba's along +z with y up and x to the left
        np.testing.assert_allclose(shown.pose[:3], [[-1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, -1, 4]], atol=1e-12)
        assert (page._picture != before).any()
        page._change("ball.bsdf.roughness", 0.7)
        page._change("ball.bsdf.roughness", 0.8)  # the newest counts
        page._step()
        assert shown.figures["values"] == {"ball.bsdf.roughness": 0.8}
        page._change("ball.bsdf.roughness", float("nan"))
        page._step()
        assert 'parameter "ball.bsdf.roughness": found nan' in page._status.content
        assert shown.figures["values"] == {"ball.bsdf.roughness": 0.8}
        page._search.value = "base_color"
        page._list_parameters()
        assert len(page._folders) == 1
        page._ask(page._first_view)
        page._step()
        assert shown.pose is shown.start
        for view in shown.views:
            page._ask(lambda view=view: shown.show(view, gain=50))
            while page._step():
                pass
            assert page._picture.shape == (HEIGHT, WIDTH, 3)
    finally:
        served.stop()


def test_the_command_serves_a_page(mi_rgb, tmp_path, monkeypatch, capsys):
    """At the loopback address; it ends by itself after some seconds, and writes the figures."""
    pytest.importorskip("viser", reason="the optional package viser is not installed")
    monkeypatch.chdir(tmp_path)
    words = ["view", str(ASSETS / "library/chrome.npz"), "--port", "0", "--width", "16", "--seconds", "1"]
    assert main([*words, "--variant", mi_rgb.variant(), "--spp", "2", "--json", "a.json"]) == 0
    assert "http://127.0.0.1:" in capsys.readouterr().out
    figures = json.loads((tmp_path / "a.json").read_text())
    assert figures["spp"] == 2 and figures["width"] == 16 and figures["url"].startswith("http://127.0.0.1:")
