"""The share of each bounce, and the depth that is chosen from it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import refused

from mi_diffind.commands.cli import main

SCENES = Path(__file__).resolve().parents[1] / "scenes"
SMALL = {"width": 96, "height": 56}
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])  # of linear sRGB

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

#: Glass, metal, a lamp in view, a point light, light from the floor: every kind of vertex.
MIXED = """
    <emitter type="constant"><spectrum name="radiance" value="0.4"/></emitter>
    <emitter type="point"><point name="position" x="0" y="2" z="2"/><spectrum name="intensity" value="3"/></emitter>
    <shape type="sphere"><transform name="to_world"><translate z="4"/></transform><bsdf type="dielectric"/></shape>
    <shape type="sphere"><transform name="to_world"><translate x="2.2" z="5"/></transform>
        <bsdf type="roughconductor"/></shape>
    <shape type="sphere"><transform name="to_world"><scale value="0.4"/><translate x="-1" y="1.2" z="3.5"/></transform>
        <emitter type="area"><spectrum name="radiance" value="5"/></emitter></shape>
    <shape type="rectangle"><transform name="to_world"><scale value="10"/><rotate x="1" angle="-90"/>
        <translate y="-1"/></transform><bsdf type="diffuse"><spectrum name="reflectance" value="0.7"/></bsdf></shape>"""

PATH = '<integrator type="path"><integer name="max_depth" value="$depth"/></integrator>'


def scene_file(tmp_path, content, integrator=PATH, depth=-1, albedo=0.5):
    path = tmp_path / "scene.xml"
    defaults = f'<default name="depth" value="{depth}"/><default name="albedo" value="{albedo}"/>'
    path.write_text(f'<scene version="3.0.0">{defaults}{integrator}{SENSOR}{content}</scene>')
    return str(path)


def luminance(image):
    return float((image @ LUMINANCE if image.shape[-1] == 3 else image[..., 0]).mean(dtype=np.float64))


# -- the probe ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("albedo, max_depth, expected", [(0.5, -1, 9), (0.8, -1, 25), (0.5, 8, 8), (0.1, 8, 4)])
def test_furnace(mi_rgb, tmp_path, albedo, max_depth, expected):
    """
    Analytic: of the scattered light up to depth D, a render to depth d leaves out (ρ^(d-1) − ρ^(D-1)) / (1 − ρ^(D-1)).

    For ρ = 0.5 it falls below 0.5% after eight bounces (0.39%), for 0.8 after 24 (0.47%), for 0.1 after 3 (0.1%). With
    ρ = 0.5 and D = 8, depth 7 would leave out 0.79%: the scene's own depth stays.
    """
    from mi_diffind.scenes import depth, loading

    scene = loading.load(scene_file(tmp_path, FURNACE, depth=max_depth, albedo=albedo))
    light = depth.probe(scene, max_depth)
    found = depth.bounces(light)
    assert len(found) == (depth.MAX_BINS if max_depth < 0 else max_depth)
    assert [b.depth for b in found] == list(range(1, len(found) + 1))
    bounce = np.arange(len(found))
    end = 0 if max_depth < 0 else albedo ** (max_depth - 1)
    means = light.mean((1, 2))
    assert np.allclose(means[:8], albedo ** bounce[:8], rtol=0.01)
    rest = np.array([b.rest for b in found])
    assert np.allclose(rest, np.maximum(0, albedo**bounce - end) / (1 - end), rtol=0.01, atol=2e-4)
    shares = np.array([b.share for b in found])
    assert shares[0] == 0 and shares.sum() == pytest.approx(1) and np.allclose(1 - np.cumsum(shares), rest)
    assert depth.choose(found, max_depth) == expected


@pytest.mark.parametrize("name", ["volpath", "path_footprint", "path_sdf", "neural_field"])
def test_other_integrators(mi_rgb, tmp_path, name):
    """The furnace is the same for all that follow paths; without a medium, there is no light through media."""
    from mi_diffind.scenes import depth, loading

    file = "" if name != "neural_field" else f'<string name="filename" value="{SCENES / "assets/group.npz"}"/>'
    integrator = f'<integrator type="{name}"><integer name="max_depth" value="$depth"/>{file}</integrator>'
    parsed = loading.ParsedScene(scene_file(tmp_path, FURNACE, integrator, depth=8))
    found = depth.auto_depth(parsed, 0.05, progress=False)
    assert (found["chosen"], found["scene"]) == (6, 8)
    assert found["left_out"] == pytest.approx((0.5**5 - 0.5**7) / (1 - 0.5**7), rel=0.02)


def test_distance_fields_are_met(mi_rgb, tmp_path):
    """Each depth is that of a render by ``path_sdf``: light that bounces between a solid and the floor, and shadows."""
    from mi_diffind.scenes import depth, loading

    solid = f"""
    <emitter type="constant"/>
    <emitter type="point"><point name="position" x="0" y="4" z="2"/><spectrum name="intensity" value="20"/></emitter>
    <shape type="neural_sdf"><string name="filename" value="{SCENES / "assets/knot.npz"}"/>
        <transform name="to_world"><scale value="1.5"/><translate z="4" y="-1"/></transform>
        <bsdf type="diffuse"/></shape>
    <shape type="rectangle"><transform name="to_world"><scale value="10"/><rotate x="1" angle="-90"/>
        <translate y="-1"/></transform><bsdf type="diffuse"><spectrum name="reflectance" value="0.7"/></bsdf></shape>"""
    file = scene_file(tmp_path, solid, PATH.replace('"path"', '"path_sdf"'), depth=3)
    probed = depth.probe(loading.load(file), 3, spp=32).mean((1, 2))
    renders = [loading.render(loading.load(file, longest_path=d), 128)[0] for d in (1, 2, 3)]
    path = np.diff([luminance(image) for image in renders], prepend=0)
    assert np.allclose(probed, path, rtol=0.03), (probed, path)


def test_deeper_than_the_bins(mi_rgb, tmp_path):
    """What arrives deeper than the bins reach is booked under the last, and such a scene keeps its own depth."""
    from mi_diffind.scenes import depth, loading

    albedo = 0.95
    scene = loading.load(scene_file(tmp_path, FURNACE, albedo=albedo))
    light = depth.probe(scene, -1, spp=8)
    means = light.mean((1, 2))
    assert means.sum() == pytest.approx(1 / (1 - albedo), rel=0.02)
    assert means[-1] == pytest.approx(albedo**63 / (1 - albedo), rel=0.1)
    assert depth.choose(depth.bounces(light), -1) == -1
    limited = depth.probe(scene, 80, spp=8).mean((1, 2))
    assert len(limited) == 64 and limited[-1] == pytest.approx((albedo**63 - albedo**80) / (1 - albedo), rel=0.1)


def test_one_bounce_alone(mi_rgb, tmp_path):
    from mi_diffind.scenes import depth, loading

    found = depth.auto_depth(loading.ParsedScene(scene_file(tmp_path, CONVEX)), progress=False)
    assert found["chosen"] == 2 and found["scene"] == -1 and found["left_out"] == 0
    assert [s["share"] for s in found["shares"][:3]] == [0, 1, 0]
    assert depth.auto_depth(loading.ParsedScene(scene_file(tmp_path, CONVEX, depth=1)), progress=False)["chosen"] == 1
    assert depth.auto_depth(loading.ParsedScene(scene_file(tmp_path, CONVEX, depth=0)), progress=False)["chosen"] == 0


def test_without_scattered_light(mi_rgb, tmp_path):
    from mi_diffind.scenes import depth, loading

    found = depth.auto_depth(loading.ParsedScene(scene_file(tmp_path, '<emitter type="constant"/>')), progress=False)
    assert found["chosen"] == 1 and found["left_out"] == 0


def test_each_depth_is_that_of_path(mi_rgb, tmp_path):
    """Against Mitsuba's own path tracer, image by image."""
    from mi_diffind.scenes import depth, loading

    file, depths = scene_file(tmp_path, MIXED), 5
    probed = depth.probe(loading.load(file), depths, spp=64).mean((1, 2))
    renders = [loading.render(loading.load(file, longest_path=d), 256)[0] for d in range(1, depths + 1)]
    path = np.diff([luminance(image) for image in renders], prepend=0)
    assert np.allclose(probed, path, rtol=0.02), (probed, path)


def test_in_each_variant(mi_any, tmp_path):
    """Spectra are sampled and polarisation is left out; what glass polarises is below the bound."""
    from mi_diffind.scenes import depth, loading

    file = scene_file(tmp_path, MIXED)
    probed = depth.probe(loading.load(file), 4, spp=32).mean((1, 2))
    direct, full = (luminance(loading.render(loading.load(file, longest_path=d), 128)[0]) for d in (2, 4))
    assert probed[2:].sum() / probed.sum() == pytest.approx(1 - direct / full, rel=0.03)


def test_same_seed_same_numbers(mi_rgb):
    from mi_diffind.scenes import depth, loading

    scene = loading.load(SCENES / "still_life.xml")
    first, again, other = (depth.probe(scene, 5, spp=4, passes=2, seed=s) for s in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert first.shape == (5, 80, 128)  # 960 x 580 in tiles of 8 pixels


@pytest.mark.parametrize(
    "name", ["tiles", *(pytest.param(name, marks=pytest.mark.slow) for name in ("materials", "still_life"))]
)
def test_left_out_is_what_a_render_lacks(mi_rgb, name):
    """The repository's scenes at 5%: the image to the chosen depth lacks what was announced, and less than allowed."""
    from mi_diffind.scenes import depth, loading

    file = SCENES / f"{name}.xml"
    found = depth.auto_depth(loading.ParsedScene(file), 0.05, progress=False)
    assert 2 < found["chosen"] < found["scene"] == 5
    emitted, chosen, full = (
        luminance(loading.render(loading.load(file, longest_path=d, defines=SMALL), 64)[0])
        for d in (1, found["chosen"], 5)
    )
    lacks = (full - chosen) / (full - emitted)
    assert 0 < lacks < 0.05
    assert lacks == pytest.approx(found["left_out"], rel=0.25)


# -- shares and choice, from given images ------------------------------------------------------------------------------


def images(*levels):
    """Luminance by depth, constant over 64 x 128 pixels."""
    return np.ones((len(levels), 64, 128)) * np.array(levels, float)[:, None, None]


def test_bright_lamps_and_highlights_hide_nothing():
    from mi_diffind.scenes import depth

    plain = images(0, 90, 10)
    rest = depth.bounces(plain)[1].rest
    assert rest == pytest.approx(0.1)
    lamp = plain.copy()
    lamp[0, :40] = 1e6
    assert depth.bounces(lamp) == depth.bounces(plain)
    highlight = plain.copy()
    highlight[1, 20:24, 50:60] = 1e6
    assert depth.bounces(highlight)[1].rest == pytest.approx(rest, rel=0.05)
    scaled = [b.rest for b in depth.bounces(plain * 1e-6)]
    assert scaled == pytest.approx([b.rest for b in depth.bounces(plain)])


def test_a_corner_counts():
    """1 of 128 tiles would lose a third: 0.26% of the image, yet more than ten times the tolerance there."""
    from mi_diffind.scenes import depth

    light = images(0, 1, 0)
    light[2, :8, :8] = 0.5
    bounce = depth.bounces(light)[1]
    assert bounce.rest == pytest.approx(0.5 / (128 + 0.5)) and bounce.rest < 0.005
    assert bounce.rest_in_a_tile == pytest.approx(1 / 3)
    assert depth.choose([*depth.bounces(light)], 3) == 3
    assert depth.choose([*depth.bounces(light)], 3, tolerance=0.04) == 2
    light[1:, :8, :8] *= 0.001  # nearly black there: nobody sees it
    assert depth.choose([*depth.bounces(light)], 3) == 2


def test_tolerance():
    from mi_diffind.scenes import depth

    found = depth.bounces(images(5, 90, 9, 0.9, 0.1))
    assert [round(b.rest, 4) for b in found] == [1, 0.1, 0.01, 0.001, 0]
    chosen = {t: depth.choose(found, 5, t) for t in (0.999, 0.11, 0.05, 0.009, 0.0011, 0.0009)}
    assert chosen == {0.999: 2, 0.11: 2, 0.05: 3, 0.009: 4, 0.0011: 4, 0.0009: 5}
    for bad in (0, -0.1, 1, 2, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="allowed is more than 0 and less than 1"):
            depth.choose(found, 5, bad)
        with pytest.raises(ValueError, match="tolerance"):
            depth.auto_depth(None, bad)


# -- the command -------------------------------------------------------------------------------------------------------


def render(tmp_path, *arguments):
    """Run ``render``; returns the image and the report."""
    import mitsuba as mi

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
    assert depth["left_out"] == pytest.approx(0.5**5, rel=0.02) and depth["probe_seconds"] > 0
    assert depth["left_out"] == depth["shares"][5]["rest"] <= depth["left_out_in_a_tile"] < 0.045
    assert [s["light"] for s in depth["shares"][:3]] == ["emitted", "direct", "2 bounces"]
    assert luminance(image) == pytest.approx((1 - 0.5**6) / (1 - 0.5), rel=0.005)
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
    nested = f'<integrator type="moment">{PATH}</integrator>'
    assert (
        render(tmp_path, scene_file(tmp_path, FURNACE, nested), "--spp", "1", "--depth", "2")[1]["depth"]["scene"] == -1
    )
    default = '<integrator type="prb"/>'
    assert render(tmp_path, scene_file(tmp_path, FURNACE, default), "--spp", "1")[1]["depth"]["scene"] == 6
    direct = '<integrator type="direct"/>'
    assert render(tmp_path, scene_file(tmp_path, FURNACE, direct), "--spp", "1")[1]["depth"]["chosen"] is None


def test_the_scene_may_have_a_default_of_any_name(tmp_path):
    """The repository's scenes call theirs ``max_depth``; it limits what is chosen."""
    for name in ("max_depth", "depth", "tolerance", "seed", "progress", "spp"):
        file = scene_file(tmp_path, FURNACE, PATH.replace("$depth", f"${name}"))
        file_text = Path(file).read_text().replace('name="depth" value="-1"', f'name="{name}" value="-1"')
        Path(file).write_text(file_text)
        options = ("--spp", "1", "--depth", "auto", "-D", f"{name}=3")
        depth = render(tmp_path, file, *options)[1]["depth"]
        assert depth["scene"] == depth["chosen"] == 3


@pytest.mark.parametrize(
    "integrator, request_, sentence",
    [
        ('<integrator type="direct"/>', "auto", "a depth needs one integrator of path, volpath"),
        ('<integrator type="direct"/>', "3", "found direct"),
        ("", "auto", "found none"),
        (
            '<integrator type="moment"><integrator type="path"/><integrator type="prb"/></integrator>',
            "auto",
            "found moment, path, prb",
        ),
        ('<integrator type="volpath"/>', "auto", '"volpath" also follows light through media'),
    ],
)
def test_integrators_without_a_depth(tmp_path, capsys, integrator, request_, sentence):
    content = FOG if "volpath" in integrator else FURNACE
    file, out = scene_file(tmp_path, content, integrator), tmp_path / "image.exr"
    message = refused(capsys, "render", file, "-o", str(out), "--depth", request_)
    assert sentence in message and "scene.xml" in message
    assert not out.exists()


def test_bad_options(tmp_path, capsys):
    file = scene_file(tmp_path, FURNACE)
    assert "needs --depth auto" in refused(capsys, "render", file, "--depth-tolerance", "0.1")
    for option in ("--depth=0", "--depth=-1", "--depth=deep", "--depth=2.5"):
        with pytest.raises(SystemExit) as caught:
            main(["render", file, option])
        assert caught.value.code == 2 and "allowed are auto, scene" in capsys.readouterr().err
    for value in ("0", "1", "-0.1", "nan", "inf", "small"):
        with pytest.raises(SystemExit) as caught:
            main(["render", file, "--depth", "auto", f"--depth-tolerance={value}"])
        assert caught.value.code == 2 and "allowed are numbers above 0 and below 1" in capsys.readouterr().err


def test_interrupted_probe(tmp_path):
    """Ctrl-C while the probe runs: nothing to keep, exit code 130."""
    code = """
import os, signal, sys, mi_diffind.scenes.depth as depth
original = depth._pass
def one_pass(*args):
    os.kill(os.getpid(), signal.SIGINT)
    return original(*args)
depth._pass = one_pass
from mi_diffind.commands.cli import main
sys.exit(main())"""
    out = tmp_path / "image.exr"
    arguments = ["render", scene_file(tmp_path, CONVEX), "-o", str(out), "--depth", "auto"]
    code = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')" + code
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 130, done.stderr
    assert "mi-diffind: interrupted" in done.stderr and "Traceback" not in done.stderr
    assert not out.exists()
