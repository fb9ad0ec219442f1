"""The share of each bounce, and the depth that is chosen from it."""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from commands import interrupt_at, refused

from mi_diffind.commands.cli import main
from mi_diffind.scenes import depth, loading

SCENES = Path(__file__).resolve().parents[1] / "scenes"

SENSOR = """
    <sensor type="perspective"><float name="fov" value="60"/><sampler type="independent"/>
        <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="32"/>
            <rfilter type="box"/></film></sensor>"""

#: Inside a sphere that emits 1 and reflects ρ everywhere, bounce k brings ρ^k.
FURNACE = """
    <shape type="sphere"><boolean name="flip_normals" value="true"/>
        <transform name="to_world"><scale value="3"/><translate x="1"/></transform>
        <bsdf type="diffuse"><spectrum name="reflectance" value="$albedo"/></bsdf>
        <emitter type="area"><spectrum name="radiance" value="1"/></emitter></shape>"""

#: A convex body under a sky: nothing arrives there twice.
CONVEX = """
    <emitter type="constant"/>
    <shape type="sphere"><transform name="to_world"><translate z="4"/></transform><bsdf type="diffuse"/></shape>"""

#: A sphere of fog.
FOG = """
    <emitter type="constant"/>
    <shape type="sphere"><transform name="to_world"><translate z="4"/></transform><bsdf type="null"/>
        <medium name="interior" type="homogeneous"><spectrum name="sigma_t" value="1"/></medium></shape>"""

PATH = '<integrator type="path"><integer name="max_depth" value="$depth"/></integrator>'


def scene_file(tmp_path, content, integrator=PATH, depth=-1, albedo=0.5):
    path = tmp_path / "scene.xml"
    defaults = f'<default name="depth" value="{depth}"/><default name="albedo" value="{albedo}"/>'
    path.write_text(f'<scene version="3.0.0">{defaults}{integrator}{SENSOR}{content}</scene>')
    return str(path)


def auto_depth(file, tolerance=0.005, **options):
    return depth.auto_depth(loading.ParsedScene(file), tolerance, progress=False, **options)


@pytest.mark.parametrize(
    "albedo, max_depth, tolerance, expected", [(0.5, -1, 0.005, 9), (0.5, 8, 0.005, 8), (0.8, -1, 0.2, 9)]
)
def test_furnace(mi_rgb, tmp_path, albedo, max_depth, tolerance, expected):
    """Up to depth D, a render to depth d leaves out (ρ^(d-1) − ρ^(D-1)) / (1 − ρ^(D-1)) of the scattered light.

    For ρ = 0.5 and 9: 0.39%; for 0.8: 16.8%. For 0.5 and D = 8, depth 7 would leave out 0.79%: the scene's own stays.
    """
    found = auto_depth(scene_file(tmp_path, FURNACE, depth=max_depth, albedo=albedo), tolerance)
    assert (found["chosen"], found["scene"]) == (expected, max_depth)
    assert [s["depth"] for s in found["shares"]] == list(range(1, expected + 1))
    end = 0 if max_depth < 0 else albedo ** (max_depth - 1)
    rest = np.array([s["rest"] for s in found["shares"]])
    bounce = np.arange(expected)
    assert np.allclose(rest, np.maximum(0, albedo**bounce - end) / (1 - end), rtol=0.02, atol=1.5e-3)
    shares = np.array([s["share"] for s in found["shares"]])
    assert shares[0] == 0 and np.allclose(1 - np.cumsum(shares), rest)
    assert found["left_out"] == (0 if max_depth == 8 else rest[-1])


def test_other_integrators_and_variants(mi_any, tmp_path):
    """The furnace is the same for all that follow paths, and the fog is left to the scene's integrator."""
    rgb = mi_any.variant().endswith("ad_rgb")
    for name in ("path", *(("volpath", "path_footprint", "path_sdf", "neural_field") if rgb else ())):
        file = "" if name != "neural_field" else f'<string name="filename" value="{SCENES / "assets/group.npz"}"/>'
        integrator = f'<integrator type="{name}"><integer name="max_depth" value="$depth"/>{file}</integrator>'
        found = auto_depth(scene_file(tmp_path, FURNACE, integrator, depth=6), 0.2)
        assert (found["chosen"], found["scene"]) == (4, 6), name
        assert found["left_out"] == pytest.approx((0.5**3 - 0.5**5) / (1 - 0.5**5), abs=1.5e-3)
    if rgb:
        fog = scene_file(tmp_path, FOG, '<integrator type="volpath"/>')
        assert auto_depth(fog, 0.5)["shares"][1]["share"] > 0


def test_deeper_than_what_is_tried(mi_rgb, tmp_path, monkeypatch):
    """Such a scene keeps its own depth."""
    monkeypatch.setattr(depth, "DEEPEST", 4)
    for own in (-1, 6):
        found = auto_depth(scene_file(tmp_path, FURNACE, depth=own, albedo=0.95))
        assert found["chosen"] == own and len(found["shares"]) == 4 and found["left_out"] == 0


def test_one_bounce_alone_and_no_scattered_light(mi_rgb, tmp_path):
    found = auto_depth(scene_file(tmp_path, CONVEX))
    assert found["chosen"] == 2 and found["scene"] == -1 and found["left_out"] == 0
    assert [s["share"] for s in found["shares"]] == [0, 1]
    for own in (0, 1):
        assert auto_depth(scene_file(tmp_path, CONVEX, depth=own))["chosen"] == own
    found = auto_depth(scene_file(tmp_path, '<emitter type="constant"/>'))
    assert found["chosen"] == 1 and found["left_out"] == 0


def bounces(light):
    """Shares of luminance by depth, ``(depths, height, width)``."""
    images = np.cumsum(light, axis=0)
    return depth.bounces(images, images[-1])


def images(*levels):
    """Luminance by depth, constant over 64 x 128 pixels."""
    return np.ones((len(levels), 64, 128)) * np.array(levels, float)[:, None, None]


def test_bright_lamps_and_highlights_hide_nothing():
    plain = images(0, 90, 10)
    rest = bounces(plain)[1].rest
    assert rest == pytest.approx(0.1)
    lamp = plain.copy()
    lamp[0, :40] = 1e4
    np.testing.assert_allclose([b.rest for b in bounces(lamp)], [b.rest for b in bounces(plain)])
    highlight = plain.copy()
    highlight[1, 20:24, 50:60] = 1e6
    assert bounces(highlight)[1].rest == pytest.approx(rest, rel=0.05)
    assert [b.rest for b in bounces(plain * 1e-6)] == pytest.approx([b.rest for b in bounces(plain)])


def test_a_corner_counts():
    """1 of 128 tiles would lose a third: 0.26% of the image, yet more than ten times the tolerance there."""
    light = images(0, 1, 0)
    light[2, :8, :8] = 0.5
    bounce = bounces(light)[1]
    assert bounce.rest == pytest.approx(0.5 / (128 + 0.5)) and bounce.rest < 0.005
    assert bounce.rest_in_a_tile == pytest.approx(1 / 3)
    assert not bounce.is_enough(0.005) and bounce.is_enough(0.04)
    light[1:, :8, :8] *= 0.001  # nearly black there: nobody sees it
    assert bounces(light)[1].is_enough(0.005)


def test_tolerance():
    """On a film of any size: tiles differ by a pixel, as with a crop window."""
    found = bounces(images(5, 90, 9, 0.9, 0.1)[:, :37, :100])
    assert [round(b.rest, 4) for b in found] == [1, 0.1, 0.01, 0.001, 0]
    for tolerance, chosen in {0.999: 2, 0.11: 2, 0.05: 3, 0.009: 4, 0.0011: 4, 0.0009: 5}.items():
        assert next(b.depth for b in found if b.is_enough(tolerance)) == chosen
    for bad in (0, -0.1, 1, 2, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="allowed is more than 0 and less than 1"):
            auto_depth(SCENES / "tiles.xml", bad)


def render(tmp_path, *arguments):
    """Run ``render``; returns the image and the report."""
    out, report = tmp_path / "image.exr", tmp_path / "report.json"
    assert main(["render", *arguments, "-o", str(out), "--json", str(report)]) == 0
    return np.array(mi.Bitmap(str(out))), json.loads(report.read_text())


def test_render_auto(tmp_path, capsys):
    """The furnace shows by its brightness how many bounces were rendered."""
    file = scene_file(tmp_path, FURNACE)
    image, report = render(tmp_path, file, "--depth", "auto", "--depth-tolerance", "0.05", "--spp", "64")
    text = capsys.readouterr().out
    depth = report["depth"]
    assert (depth["requested"], depth["chosen"], depth["scene"], depth["tolerance"]) == ("auto", 6, -1, 0.05)
    assert depth["left_out"] == pytest.approx(0.5**5, abs=1.5e-3) and depth["probe_seconds"] > 0
    assert depth["left_out"] == depth["shares"][5]["rest"] <= depth["left_out_in_a_tile"] < 0.045
    assert [s["light"] for s in depth["shares"][:3]] == ["emitted", "direct", "2 bounces"]
    assert (image @ [0.212671, 0.715160, 0.072169]).mean() == pytest.approx((1 - 0.5**6) / (1 - 0.5), rel=0.005)
    assert "6  5 bounces" in text and "<- chosen" in text
    assert "depth 6 instead of the scene's infinite depth leaves out 3.1" in text and "tolerance 0.05" in text


def test_render_to_a_given_depth(tmp_path, capsys):
    file = scene_file(tmp_path, FURNACE, depth=4)
    own, report = render(tmp_path, file, "--spp", "4")
    assert report["depth"]["requested"] == "scene" and report["depth"]["chosen"] == report["depth"]["scene"] == 4
    assert report["depth"]["shares"] is None and "bounces" not in capsys.readouterr().out
    assert np.array_equal(own, render(tmp_path, file, "--spp", "4", "--depth", "scene")[0])
    two, report = render(tmp_path, file, "--spp", "4", "--depth", "2")
    assert report["depth"]["requested"] == report["depth"]["chosen"] == 2 and report["depth"]["left_out"] is None
    assert np.array_equal(two, render(tmp_path, file, "--spp", "4", "-D", "depth=2")[0])
    assert not np.array_equal(two, own)
    moment = f'<integrator type="moment">{PATH}</integrator>'
    for integrator, scene_depth in (
        (moment, -1),
        ('<integrator type="prb"/>', 6),
        ('<integrator type="direct"/>', None),
    ):
        report = render(tmp_path, scene_file(tmp_path, FURNACE, integrator), "--spp", "1")[1]
        assert report["depth"]["chosen"] == report["depth"]["scene"] == scene_depth


NESTED = '<integrator type="moment"><integrator type="path"/><integrator type="prb"/></integrator>'


@pytest.mark.parametrize(
    "integrator, request_, sentence",
    [
        ('<integrator type="direct"/>', "auto", "a depth needs one integrator of path, volpath"),
        ('<integrator type="direct"/>', "3", "found direct"),
        ("", "auto", "found none"),
        (NESTED, "auto", "found moment, path, prb"),
    ],
)
def test_integrators_without_a_depth(tmp_path, capsys, integrator, request_, sentence):
    file, out = scene_file(tmp_path, FURNACE, integrator), tmp_path / "image.exr"
    message = refused(capsys, "render", file, "-o", str(out), "--depth", request_)
    assert sentence in message and "scene.xml" in message
    assert not out.exists()


def test_bad_options(tmp_path, capsys):
    file = scene_file(tmp_path, FURNACE)
    assert "depth_tolerance: given without depth" in refused(capsys, "render", file, "--depth-tolerance", "0.1")
    depths = [[f"--depth={value}"] for value in ("0", "-1", "deep", "2.5")]
    values = ("0", "1", "-0.1", "nan", "inf", "small")
    tolerances = [["--depth", "auto", f"--depth-tolerance={value}"] for value in values]
    for options, allowed in ((depths, "allowed are auto, scene"), (tolerances, "numbers above 0 and below 1")):
        for option in options:
            assert allowed in refused(capsys, "render", file, *option)


def test_interrupted_probe(tmp_path, monkeypatch, capsys):
    """Ctrl-C while the probe runs: nothing to keep, exit code 130."""
    interrupt_at(monkeypatch, depth, "probe")
    out = tmp_path / "image.exr"
    assert main(["render", scene_file(tmp_path, CONVEX), "-o", str(out), "--depth", "auto"]) == 130
    assert "mi-diffind: interrupted" in capsys.readouterr().err and not out.exists()
