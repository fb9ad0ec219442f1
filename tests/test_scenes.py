"""The scenes of the repository, and swapping learned plugins for exact ones."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mi_diffind.commands import cli
from mi_diffind.images import metrics
from mi_diffind.scenes import comparison, loading

SCENES = Path(__file__).resolve().parents[1] / "scenes"
SMALL = {"width": 96, "height": 56}


@pytest.mark.parametrize("name", [pytest.param("materials", marks=pytest.mark.slow), "still_life"])
def test_scene_as_written_and_exact(mi_rgb, name):
    """The bound on the approximation: 77.8 and 77.2 dB are reached, FLIP of 0.0010 and 0.0014."""
    result = comparison.compare(SCENES / f"{name}.xml", spp=32, passes=1, progress=False, defines=SMALL)
    assert np.isfinite(result.written).all() and result.written.min() >= 0
    assert result.written.std() > 0.05
    assert not np.array_equal(result.written, result.reference)
    assert result.figures["psnr_db"] > 75
    assert result.figures["flip"] < 0.002
    assert result.figures["learned_plugins"] == (60 if name == "materials" else 9)
    assert result.figures["table_bytes"] == 384


#: Materials without ids, one of them inside another beside one that has an id, and a texture.
UNNAMED = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <shape type="sphere"><bsdf type="neural_disney"><float name="roughness" value="0.2"/></bsdf></shape>
    <shape type="sphere"><bsdf type="neural_disney"><float name="roughness" value="0.7"/>
        <string name="preset" value="paper"/><texture name="base_color" type="neural_image">
        <string name="filename" value="TILES"/><string name="channels" value="albedo"/></texture></bsdf></shape>
    <shape type="sphere"><bsdf type="blendbsdf"><float name="weight" value="0.5"/>
        <bsdf type="neural_ggx"><float name="alpha" value="0.3"/></bsdf>
        <bsdf type="neural_ggx" id="copper"><string name="material" value="Cu"/></bsdf></bsdf></shape>
    <shape type="sphere"><bsdf type="disney"/></shape>
</scene>
"""


def test_reports_have_the_parameters_of_their_own_node(mi_rgb, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(UNNAMED.replace("TILES", str(SCENES / "assets" / "tiles.npz")))
    found = loading.reports(loading.load(path))
    expected = {
        "neural_disney tables": {"roughness": 0.2},
        "neural_disney paper": {"roughness": 0.7, "base_color": "texture"},
        "neural_image ours": {},
        "neural_ggx tables": {"alpha": 0.3},
        "neural_ggx tables copper": {"material": "Cu"},
    }
    assert {f"{r['plugin']} {r['preset']} {r['id']}".strip(): r["parameters"] for r in found} == expected
    parsed = [r["parameters"] for r in loading.ParsedScene(path).learned_plugins()]
    assert sorted(map(str, parsed)) == sorted(map(str, expected.values()))
    (image,) = [r for r in found if r["kind"] == "texture"]
    assert image["map"] == "albedo" and image["effects_in_use"] == ["albedo", "srgb"]
    assert image["effects_left_out"]["roughness"] == "is another map of the file"
    assert image["channels_read"] == [0, 1, 2] and image["channels_left_out"] == [3, 4, 5, 6]
    assert image["storage"] == "uint8" and image["table_bytes"] > 0 and image["operations"] == {}


PAIR = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="32"/>
        <integer name="height" value="32"/><rfilter type="box"/></film>
        <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform></sensor>
    <emitter type="constant"/>
    <shape type="sphere"><bsdf type="PLUGIN" id="m">PARAMETERS</bsdf></shape>
</scene>
"""


@pytest.mark.parametrize("name", ["disney", "neural_disney"])
def test_compare_against_principled(mi_rgb, tmp_path, name):
    """Another Fresnel term: a little darker than Mitsuba's model, in every parameter else the same."""
    path, given = tmp_path / "scene.xml", {"subsurface": 0.8, "clearcoat": 0.5, "eta": 1.4}
    parameters = "".join(f'<float name="{k}" value="{v}"/>' for k, v in given.items())
    parameters += '<string name="effects" value="all"/>'
    path.write_text(PAIR.replace("PLUGIN", name).replace("PARAMETERS", parameters))
    result = comparison.compare(path, spp=32, passes=1, progress=False, against="principled")
    assert 0.96 < result.figures["brightness"] < 1 and result.figures["psnr_db"] > 30
    assert result.figures["replaced_plugins"] == 1 and result.figures["against"] == "principled"
    learned = (0, 0) if name == "disney" else (1, 384)
    assert (result.figures["learned_plugins"], result.figures["table_bytes"]) == learned
    paths = result.save(tmp_path)
    assert paths["principled"].endswith("principled.exr") and Path(paths["figure"]).is_file()


@pytest.mark.parametrize(
    "plugin, parameters, against, sentence",
    [
        ("disney", "", "exact", "names no learned plugin (neural_bsdf, neural_disney, neural_field, neural_ggx, "),
        ("neural_ggx", "", "principled", 'names no plugin that "principled" can stand for (disney, neural_disney, '),
        ("disney", "", "plastic", 'against: found "plastic", allowed are exact, '),
        ("disney", '<texture name="specular" type="checkerboard"/>', "principled", '"specular": is a texture, but'),
    ],
)
def test_what_cannot_be_compared(mi_rgb, tmp_path, plugin, parameters, against, sentence):
    path = tmp_path / "scene.xml"
    path.write_text(PAIR.replace("PLUGIN", plugin).replace("PARAMETERS", parameters))
    with pytest.raises(loading.SceneError) as caught:
        comparison.compare(path, spp=1, passes=1, progress=False, against=against)
    assert sentence in str(caught.value)


@pytest.mark.parametrize("name", ["library", "materials", "metals"])
def test_scenes_are_what_their_scripts_write(tmp_path, name):
    """Both files of a pair are in the repository: they must not drift apart."""
    (tmp_path / "scenes").mkdir()
    for file in (f"make_{name}.py", "scene_xml.py"):
        shutil.copy(SCENES / file, tmp_path / "scenes")
    subprocess.run([sys.executable, str(tmp_path / "scenes" / f"make_{name}.py")], check=True, cwd=tmp_path)
    assert (tmp_path / "scenes" / f"{name}.xml").read_bytes() == (SCENES / f"{name}.xml").read_bytes()


def test_same_arguments_same_image(mi_rgb):
    """Passes of unequal size are weighed by their samples."""
    scene = loading.load(SCENES / "still_life.xml", defines=SMALL)
    first, second, other = (loading.render(scene, 4, seed=seed, passes=2)[0] for seed in (5, 5, 6))
    assert np.array_equal(first, second) and not np.array_equal(first, other)
    image, seconds = loading.render(scene, 7, passes=3)
    assert len(seconds) == 3 and abs(image.mean() / loading.render(scene, 64)[0].mean() - 1) < 0.1


def test_samples_that_a_sampler_adds_are_said(mi_rgb, tmp_path, capsys, monkeypatch):
    """By ``render`` and ``compare``: as many as Mitsuba takes."""
    text = (Path(__file__).parent / "lamp.xml").read_text().replace('type="independent"', 'type="multijitter"')
    (tmp_path / "a.xml").write_text(text)
    render, counts = mi_rgb.render, []

    def counted(scene, *arguments, **options):
        image = render(scene, *arguments, **options)
        counts.append(scene.sensors()[0].sampler().sample_count())
        return image

    monkeypatch.setattr(mi_rgb, "render", counted)
    scene = [str(tmp_path / "a.xml"), "-D", "width=12", "-D", "height=8", "--spp"]
    added = " ({} requested, the sampler adds some)".format
    for words, taken, note in (
        (["render", *scene, "32", "-o", str(tmp_path / "a.exr")], 32, ""),
        (["render", *scene, "13", "-o", str(tmp_path / "a.exr")], 14, added(13)),
        (["compare", *scene, "14", "--passes", "2", "--out", str(tmp_path)], 16, added(14)),
    ):
        counts.clear()
        assert cli.main(words) == 0
        assert sum(counts) == taken * (2 if words[0] == "compare" else 1)
        assert f", {taken} spp{note}" in capsys.readouterr().out


def test_metrics():
    rng = np.random.default_rng(0)
    a = rng.random((32, 48, 3)).astype(np.float32)
    assert metrics.psnr(a, a) == np.inf and metrics.flip(a, a) == 0 and metrics.mae(a, a) == 0
    b = np.clip(a + 0.1, 0, 1)
    assert metrics.psnr(a, b) == pytest.approx(-10 * np.log10(np.mean((a - b) ** 2)), rel=1e-5)
    assert metrics.psnr(a, np.where(a > 0.5, a + 7, a)) < 40  # clipped, yet seen
    assert metrics.psnr(np.full_like(a, 3), np.full_like(a, 9)) == np.inf  # both white
    assert 0.01 < metrics.flip(a, b) < 1
    signed = np.where(a > 0.5, 4, -0.2).astype(np.float32)
    assert metrics.mae(a, a + signed) == pytest.approx(np.abs(signed).mean(), rel=1e-5)  # above 1 and below 0, too
    each = {"psnr_db": metrics.psnr(a, b), "flip": metrics.flip(a, b), "mae": metrics.mae(a, b)}
    assert metrics.compare(a, b) == each
    # Normals of any length, 30 degrees from each other
    n = rng.normal(size=(8, 8, 3))
    aside = np.cross(n, rng.normal(size=(8, 8, 3)))
    turned = np.sqrt(3) / 2 * n / np.linalg.norm(n, axis=-1, keepdims=True)
    turned += 0.5 * aside / np.linalg.norm(aside, axis=-1, keepdims=True)
    assert metrics.angle(n / 2 + 0.5, 3 * turned / 2 + 0.5) == pytest.approx(30, abs=1e-6)


def test_folders_of_a_scene_are_searched(mi_rgb, tmp_path):
    """``<path>`` counts when the scene is built, not only while it is parsed."""
    (tmp_path / "common" / "textures").mkdir(parents=True)
    mi_rgb.Bitmap(np.full((2, 2, 3), 0.5, np.float32)).write(str(tmp_path / "common" / "textures" / "grey.exr"))
    (tmp_path / "scenes").mkdir()
    path = tmp_path / "scenes" / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><path value="../common"/><emitter type="envmap">'
        '<string name="filename" value="textures/grey.exr"/></emitter></scene>'
    )
    assert len(loading.load(path).emitters()) == 1
    assert len(loading.load_file(path).emitters()) == 1
