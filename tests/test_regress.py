"""Checks against stored references: the statistics, what they let pass and catch, the files, and the command."""

import json
import os
import re
import signal
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from commands import refused
from variants import set_variant

from mi_diffind.cli import main
from mi_diffind.reference_files import write_reference

TESTS = Path(__file__).resolve().parent
SCENES = TESTS.parent / "scenes"
STORED = [
    *(
        SCENES / f"{name}.xml"
        for name in ("field", "horizon", "library", "materials", "metals", "rust", "solids", "still_life", "tiles")
    ),
    TESTS / "lamp.xml",
]


@pytest.fixture
def regress(mi_rgb):
    from mi_diffind import regression as regress

    return regress


def scene_file(tmp_path, name="scene", reflectance=0.5):
    """A scene that Mitsuba traces in no time, since references of it consist of hundreds of renders."""
    path = tmp_path / f"{name}.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="direct"/><emitter type="constant"/><default name="width" value="16"/>'
        '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="$width"/>'
        '<integer name="height" value="12"/><rfilter type="box"/><string name="pixel_format" value="rgb"/></film>'
        '</sensor><shape type="sphere"><transform name="to_world"><translate z="4"/></transform>'
        f'<bsdf type="diffuse"><spectrum name="reflectance" value="{reflectance}"/></bsdf></shape></scene>'
    )
    return str(path)


def noise(rng, variance, spp):
    """What ``spp`` samples of zero mean average to, if they are normally distributed."""
    return rng.standard_normal(variance.shape) * np.sqrt(variance / spp)


# -- passes ------------------------------------------------------------------------------------------------------------


def test_mean_and_variance_of_passes(regress, rng, monkeypatch):
    """Of noise with a known variance of a sample, whatever the number of samples in a pass; alpha is left out."""
    truth, variance = rng.random((40, 50, 4)), 10 ** rng.uniform(-3, 1, (40, 50, 4))
    taken = []

    def render_pass(scene, spp, seed):
        taken.append((spp, seed))
        return truth + noise(rng, variance, spp)

    monkeypatch.setattr(regress.scenes, "render_pass", render_pass)
    for spp, in_a_pass in ((1, 1), (128, 1), (129, 2), (3808, 32), (6800, 64)):  # powers of two: see below
        taken.clear()
        mean, found, done = regress.render_with_variance(None, spp, seed=3)
        assert {n for n, _ in taken} == {in_a_pass} and done == 128 * in_a_pass >= spp
        assert mean.shape == found.shape == (40, 50, 3)
        ratio = found / variance[..., :3]
        assert abs(ratio.mean() - 1) < 0.02 and ratio.std() == pytest.approx(np.sqrt(2 / 127), rel=0.1)
        z = (mean - truth[..., :3]) / np.sqrt(variance[..., :3] / done)
        assert abs(z.mean()) < 0.1 and z.std() == pytest.approx(1, rel=0.05)
        seeds = {seed for _, seed in taken}
        assert len(seeds) == 128 and seeds == {(3 << 16) + (1 << 15) + i for i in range(128)}
    taken.clear()
    regress.scenes.render(None, 4000, seed=3, passes=100)
    assert seeds.isdisjoint(seed for _, seed in taken)  # a check never sees the samples of its reference
    with pytest.raises(ValueError, match="at least 2"):
        regress.render_with_variance(None, 16, passes=1)


# -- the repository's scenes -------------------------------------------------------------------------------------------


def test_passes_of_references_repeat_to_the_last_bit(regress):
    """Passes of 30 or 54 samples do not on several cores: threads share pixels, and add up in any order."""
    scene = regress.scenes.load(TESTS / "lamp.xml")
    for spp in (32, 64):
        assert len({regress.scenes.render_pass(scene, spp, 7).tobytes() for _ in range(6)}) == 1


#: What other variants of the same scenes show already, and what takes longest.
SLOW = {
    ("field", "llvm_ad_mono"),
    ("field", "llvm_ad_spectral"),
    ("horizon", "llvm_ad_mono"),
    ("library", "llvm_ad_mono"),
    ("library", "llvm_ad_spectral"),
    ("materials", "llvm_ad_mono"),
    ("rust", "llvm_ad_mono"),
    ("rust", "llvm_ad_spectral"),
    ("solids", "llvm_ad_mono"),
    ("solids", "llvm_ad_spectral"),
    ("still_life", "llvm_ad_spectral"),
    ("still_life", "llvm_ad_mono"),
    ("metals", "llvm_ad_mono"),
}


@pytest.mark.parametrize(
    "path, variant",
    [
        pytest.param(
            path, variant, id=f"{path.stem}-{variant}", marks=[pytest.mark.slow] if (path.stem, variant) in SLOW else []
        )
        for path in STORED
        for variant in ("llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono")
    ],
)
def test_scene_renders_as_its_reference(path, variant):
    """If a change is meant, render the references again: scenes/README.md says how."""
    set_variant(variant)
    from mi_diffind import regression as regress

    result = regress.regress(path, progress=False).figures
    assert result["passed"], result
    assert result["reference_spp"] >= 16 * result["spp"] and result["spp"] > 200


def test_references_are_small():
    files = [f for folder in (SCENES, TESTS) for f in (folder / "references").iterdir()]
    assert len(files) == 3 * len(STORED) and sum(f.stat().st_size for f in files) < 400_000 * len(STORED)


def seen_from_the_camera(scene):
    """128 × 128 points of a scene's image, and the direction of its lamp there, in the local frame."""
    position = dr.meshgrid(*2 * [dr.linspace(mi.Float, 0, 1, 128)])
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, mi.Point2f(position), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    return si, scene.emitters()[0].sample_direction(si, mi.Point2f(0.5))[0].d


def test_a_broken_table_entry_is_caught(regress, tmp_path, capsys, monkeypatch):
    """Of a table of the paper's layout, the entry that matters most for the image is changed by 10%; no other."""
    original = regress.scenes.ParsedScene.load

    def broken(parsed):
        scene = original(parsed)
        params = mi.traverse(scene)
        keys = [k for k in params.keys() if k.endswith("tables.masking") and params[k].shape[0] == 16]
        assert len(keys) == 2  # the two materials in that quality
        params = mi.traverse(scene)  # anew: what has been read counts as changed
        params.keep(keys)
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        (si, light), context, brightness = seen_from_the_camera(scene), mi.BSDFContext(), 0
        for shape in scene.shapes():
            if shape.bsdf().id().endswith("_paper"):
                of_shape = si.is_valid() & (si.shape == mi.ShapePtr(shape))
                value = shape.bsdf().eval(context, si, si.to_local(light), of_shape)
                brightness += dr.sum(dr.sum(value))
        dr.backward(brightness)
        slope = sum(np.abs(params[key].grad.numpy()) for key in keys)
        for key in keys:
            table = params[key].numpy().copy()  # or the memory of all that read this file is written to
            table.flat[slope.argmax()] *= 1.1
            params[key] = mi.TensorXf(table)
        params.update()
        return scene

    out, report = tmp_path / "out", tmp_path / "report.json"
    arguments = ["regress", str(TESTS / "lamp.xml"), "--out", str(out), "--json", str(report)]
    assert main(arguments) == 0 and not out.exists()
    assert "passed" in capsys.readouterr().out
    monkeypatch.setattr(regress.scenes.ParsedScene, "load", broken)
    assert main(arguments) == 1
    text = capsys.readouterr().out
    assert "FAILED" in text and str(out / "lamp.llvm_ad_rgb.png") in text
    found = json.loads(report.read_text())
    result = found["scenes"][0]
    assert found["failed"] == 1 and result["passed"] is False
    assert result["fraction"] == pytest.approx(1 - result["failing_pixels"] / (result["width"] * result["height"]))
    assert len(result["files"]) == 5 and {Path(f).name for f in result["files"].values()} == set(os.listdir(out))
    image, reference, error, p = (
        np.array(mi.Bitmap(result["files"][k])) for k in ("image", "reference", "error", "p_value")
    )
    assert np.array_equal(np.abs(image - reference), error)
    assert (p <= result["alpha"]).any(axis=-1).sum() == result["failing_pixels"] > 0.0025 * p[..., 0].size
    assert np.array(mi.Bitmap(result["files"]["figure"])).std() > 20  # not blank


# -- files -------------------------------------------------------------------------------------------------------------


def test_update_stores_what_a_check_needs(tmp_path, capsys):
    import OpenEXR

    path, report = scene_file(tmp_path), tmp_path / "report.json"
    update = ["regress", path, "--update", "--json", str(report)]
    assert main([*update, "--spp", "20", "--seed", "7", "-D", "width=10"]) == 0
    assert "10 x 12, 512 spp" in capsys.readouterr().out  # 128 passes of 4, more than 16 · 20
    folder = tmp_path / "references"
    assert os.listdir(folder) == ["scene.llvm_ad_rgb.exr"]
    with OpenEXR.File(str(folder / "scene.llvm_ad_rgb.exr"), separate_channels=True) as file:
        about = json.loads(file.header()["mi_diffind"])
        channels = {k: v.pixels.copy() for k, v in file.channels().items()}
    assert sorted(channels) == ["B", "G", "R", "variance.B", "variance.G", "variance.R"]
    assert all(c.shape == (12, 10) and c.dtype == np.float32 for c in channels.values())
    versions = about.pop("versions")
    assert set(versions) == {"mi_diffind", "mitsuba"}
    expected = {"scene": "scene", "variant": "llvm_ad_rgb", "defines": {"width": "10"}, "budget": 20, "spp": 512}
    assert about == {**expected, "seed": 7}

    first = (folder / "scene.llvm_ad_rgb.exr").read_bytes()
    assert main(update) == 0  # the same size, samples and seed again
    assert (folder / "scene.llvm_ad_rgb.exr").read_bytes() == first
    assert main([*update, "--seed", "8"]) == 0
    assert (folder / "scene.llvm_ad_rgb.exr").read_bytes() != first
    assert main(["regress", path, "--json", str(report)]) == 0
    result = json.loads(report.read_text())["scenes"][0]
    assert (result["width"], result["height"], result["spp"], result["reference_spp"]) == (10, 12, 20, 512)
    assert main(["regress", path, "--spp", "30", "--seed", "5", "--json", str(report)]) == 0
    result = json.loads(report.read_text())["scenes"][0]
    assert result["spp"] == 30 and result["seed"] == 5


def test_every_scene_is_checked(tmp_path, capsys):
    """One that fails does not hide the next; mono has one channel; --references names another folder."""
    paths = [scene_file(tmp_path, name) for name in ("first", "second", "third")]
    options = ["--references", str(tmp_path / "kept"), "--out", str(tmp_path / "out"), "--variant", "llvm_ad_mono"]
    assert main(["regress", *paths, *options, "--update", "--spp", "64"]) == 0
    assert len(os.listdir(tmp_path / "kept")) == 3 and not (tmp_path / "references").exists()
    scene_file(tmp_path, "second", reflectance=0.4)
    capsys.readouterr()
    assert main(["regress", *paths, *options]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines if "pixels" in line] == [
        ["passed", "first"],
        ["FAILED", "second"],
        ["passed", "third"],
    ]
    assert len(os.listdir(tmp_path / "out")) == 5


def test_an_update_that_does_not_end_changes_nothing(regress, tmp_path, capsys, monkeypatch):
    import OpenEXR

    path = scene_file(tmp_path)
    assert main(["regress", path, "--update", "--spp", "8"]) == 0
    file = tmp_path / "references" / "scene.llvm_ad_rgb.exr"
    before = file.read_bytes()

    def write(self, name):
        Path(name).write_bytes(b"half")
        raise RuntimeError("disk full")

    class Failing(OpenEXR.File):
        pass

    Failing.write = write
    with monkeypatch.context() as patch:
        patch.setattr(OpenEXR, "File", Failing)
        assert "cannot be written: disk full" in refused(capsys, "regress", path, "--update", "--seed", "1")
    assert file.read_bytes() == before and os.listdir(file.parent) == [file.name]

    original = regress.scenes.render_pass

    def interrupting(scene, spp, seed):
        os.kill(os.getpid(), signal.SIGINT)
        return original(scene, spp, seed)

    monkeypatch.setattr(regress.scenes, "render_pass", interrupting)
    report = tmp_path / "report.json"
    assert main(["regress", path, "--update", "--seed", "1", "--json", str(report)]) == 130
    assert json.loads(report.read_text())["interrupted"]
    assert file.read_bytes() == before and os.listdir(file.parent) == [file.name]
    capsys.readouterr()
    assert main(["regress", path, "--json", str(report)]) == 130
    assert "interrupted" in capsys.readouterr().out
    assert json.loads(report.read_text())["scenes"][0]["passed"] is None


def rare_bright_paths(tmp_path):
    """A rough metal ball throws the light of a small lamp onto the floor, on paths that are found by chance."""
    path = tmp_path / "rare.xml"
    path.write_text("""<scene version="3.0.0">
        <integrator type="path"><integer name="max_depth" value="4"/></integrator>
        <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="48"/>
                <integer name="height" value="36"/><rfilter type="box"/><string name="pixel_format" value="rgb"/></film>
            <transform name="to_world"><lookat origin="0,3,6" target="0,0,0" up="0,1,0"/></transform></sensor>
        <shape type="rectangle"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/></transform>
            <bsdf type="diffuse"/></shape>
        <shape type="sphere"><point name="center" x="0" y="1" z="0"/>
            <bsdf type="roughconductor"><float name="alpha" value="0.4"/></bsdf></shape>
        <shape type="sphere"><point name="center" x="-2" y="3" z="1"/><float name="radius" value="0.02"/>
            <emitter type="area"><rgb name="radiance" value="2500"/></emitter></shape></scene>""")
    return str(path)


def test_a_probe_foretells_the_check(regress, tmp_path, monkeypatch):
    """The failing part of checks against references of 16 times their samples, within a factor of two."""
    scene = regress.scenes.load(rare_bright_paths(tmp_path))
    params = mi.traverse(scene.sensors()[0])
    monkeypatch.setattr(regress, "PROBE_PIXELS", (256, 2048))
    for spp, width in ((32, 40), (8, 96)):  # the second has more pixels than a probe
        params["film.size"] = mi.ScalarVector2u(width, width * 3 // 4)
        params.update()
        before = regress.scenes.render_pass(scene, 1, 0)
        foretold = regress.probe(scene, spp, samples=1 << 19)
        assert np.array_equal(regress.scenes.render_pass(scene, 1, 0), before)  # the size is as it was
        image, variance, done = regress.render_with_variance(scene, 16 * spp)
        checks = [regress.scenes.render(scene, spp, seed)[0] for seed in range(3)]
        found = [1 - regress.z_test(c, image, variance, spp, done).fraction for c in checks]
        assert np.mean(found) / 2 - 1e-3 < foretold < 2 * np.mean(found) + 1e-3, (spp, found)
        assert foretold > 5e-4


def rare_bright_samples(tmp_path):
    """A black screen before a sky: every pixel is black in 96 of 100 samples, and bright in the others."""
    path = tmp_path / "rare.xml"
    path.write_text("""<scene version="3.0.0"><integrator type="direct"/>
        <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="48"/>
            <integer name="height" value="36"/><rfilter type="box"/><string name="pixel_format" value="rgb"/></film>
        </sensor><emitter type="constant"><rgb name="radiance" value="10"/></emitter>
        <shape type="rectangle"><transform name="to_world"><scale value="9"/><translate z="4"/></transform>
            <bsdf type="mask"><float name="opacity" value="0.96"/>
                <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf></bsdf></shape></scene>""")
    return str(path)


def test_too_few_samples_are_refused_early(regress, tmp_path, monkeypatch):
    """Before the reference is rendered, with the number of samples that suffices."""
    path, rendered, original = rare_bright_samples(tmp_path), [], regress.scenes.render_pass
    monkeypatch.setattr(regress.scenes, "render_pass", lambda *a: rendered.append(a[1]) or original(*a))
    options = {"progress": False, "probe_samples": 1 << 19}
    with pytest.raises(regress.scenes.SceneError) as caught:
        regress.update_reference(path, spp=4, **options)
    message = str(caught.value)
    assert "would fail the check at 4 samples a pixel although nothing has changed (about " in message
    assert "0.25% may" in message and "a lower max_depth" in message
    assert not list((tmp_path / "references").iterdir())
    factor = len(rendered) // regress.PROBE_PASSES  # of the samples that do; 2 to 16
    wanted = int(re.search(r"--spp (\d+) should do", message)[1])
    assert len(rendered) % regress.PROBE_PASSES == 0 and wanted == 4 * 2 ** (factor - 1) > 4
    assert regress.update_reference(path, spp=wanted, **options)["expected_fraction"] >= 0.9975
    monkeypatch.setattr(regress, "probe", lambda *_: 0.02)
    with pytest.raises(regress.scenes.SceneError, match="not even 16 times the samples would do: give a lower"):
        regress.update_reference(path, **options)


def test_a_reference_that_would_fail_unchanged_is_refused(regress, rng, tmp_path, capsys, monkeypatch):
    """Rare bright paths that no probe saw; what was rendered is not lost."""

    def fireflies(scene, spp, seed):
        return 0.5 + 100 * (rng.random((12, 16, 3)) < 1e-5 * spp)

    path, report = scene_file(tmp_path), tmp_path / "report.json"
    update, partial = ["regress", path, "--update"], tmp_path / "references" / "scene.llvm_ad_rgb.partial.npz"
    with monkeypatch.context() as patch:
        patch.setattr(regress.scenes, "render_pass", fireflies)
        assert "although nothing has changed (about " in refused(capsys, *update, "--spp", "1000")
        assert not list(partial.parent.iterdir())
        patch.setattr(regress, "probe", lambda scene, spp, *_: 0.01 if 1000 < spp < 4000 else 0.0)
        message = refused(capsys, *update, "--spp", "1000")
        assert "fails the check at 1000 samples a pixel although nothing has changed (" in message
        assert "--spp 4000 should do, or a lower max_depth" in message
        assert f"the same command continues from {partial.name} beside the reference" in message
    monkeypatch.setattr(regress.scenes, "render_pass", lambda *_: np.full((12, 16, 3), 0.5))
    assert [f.name for f in partial.parent.iterdir()] == [partial.name]
    kept = partial.read_bytes()
    assert main([*update, "--spp", "4000", "--json", str(report)]) == 0
    found = json.loads(report.read_text())["scenes"][0]
    assert found["reused_spp"] == 16384 and found["spp"] == 65536  # 96 more passes of 512
    assert not partial.exists()
    for content, seed in ((kept, "1"), (kept[:500], "0"), (b"", "0")):  # of other samples, or damaged
        partial.write_bytes(content)
        assert main([*update, "--spp", "40", "--seed", seed, "--json", str(report)]) == 0
        assert json.loads(report.read_text())["scenes"][0]["reused_spp"] == 0
    monkeypatch.setattr(regress.scenes, "render_pass", lambda *_: np.full((12, 16, 3), np.nan))
    assert "192 pixel(s) are not finite" in refused(capsys, *update, "--spp", "10")
    assert not partial.exists()


def test_an_interrupted_update_goes_on(regress, tmp_path, capsys, monkeypatch):
    """From where it was: the bytes of the reference are those of one that was never interrupted."""
    path, report = scene_file(tmp_path), tmp_path / "report.json"
    update = ["regress", path, "--update", "--spp", "20", "--json", str(report), "--references"]
    assert main([*update, str(tmp_path / "undisturbed")]) == 0
    original, taken = regress.scenes.render_pass, []

    def interrupting(*arguments):
        taken.append(1)
        if len(taken) == regress.PROBE_PASSES + 50:
            os.kill(os.getpid(), signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(regress.scenes, "render_pass", interrupting)
    folder = tmp_path / "own"
    capsys.readouterr()
    assert main([*update, str(folder)]) == 130
    partial = folder / "scene.llvm_ad_rgb.partial.npz"
    assert f"{partial}: 200 samples a pixel are kept, the same command goes on" in capsys.readouterr().out
    assert os.listdir(folder) == [partial.name]
    before = len(taken)
    assert main([*update, str(folder)]) == 0
    assert len(taken) - before == regress.PROBE_PASSES + 128 - 50 + 1  # and the check
    assert json.loads(report.read_text())["scenes"][0]["reused_spp"] == 200
    name = "scene.llvm_ad_rgb.exr"
    assert (folder / name).read_bytes() == (tmp_path / "undisturbed" / name).read_bytes()
    assert os.listdir(folder) == [name]

    taken.clear()
    assert main([*update, str(folder)]) == 130
    scene_file(tmp_path, reflectance=0.3)  # another scene: nothing of it is used
    assert main([*update, str(folder)]) == 0
    assert json.loads(report.read_text())["scenes"][0]["reused_spp"] == 0


def test_references_serve_both_backends(regress, tmp_path, monkeypatch):
    path = scene_file(tmp_path)
    regress.update_reference(path, spp=8, progress=False)
    stored = regress.read_reference(path)
    monkeypatch.setattr(mi, "variant", lambda: "cuda_ad_rgb")
    assert np.array_equal(regress.read_reference(path).image, stored.image)
    monkeypatch.setattr(mi, "variant", lambda: "llvm_ad_spectral")
    with pytest.raises(regress.BadReference, match=r'no reference ".*scene.llvm_ad_spectral.exr"; run'):
        regress.read_reference(path)


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_bad_references(regress, tmp_path, capsys):
    path, other = scene_file(tmp_path), scene_file(tmp_path, "other")
    out = ["--out", str(tmp_path / "out")]
    assert "with --update to make it" in refused(capsys, "regress", path, *out)
    assert main(["regress", path, "--update", "--spp", "8"]) == 0
    # The missing one is found before the first scene is rendered
    assert "other.xml: has no reference" in refused(capsys, "regress", path, other, *out)
    assert "passed" not in capsys.readouterr().out
    message = refused(capsys, "regress", path, "-D", "width=20", *out)
    assert "renders 20 x 12 pixels, its reference has 16 x 12 of 3 channel(s)" in message

    file = tmp_path / "references" / "scene.llvm_ad_rgb.exr"
    content = file.read_bytes()
    file.with_name("other.llvm_ad_rgb.exr").write_bytes(content)
    assert 'is the reference of the scene "scene"' in refused(capsys, "regress", other, *out)
    for damaged in (b"", b"no image", content[:300], content[: len(content) // 2]):
        file.write_bytes(damaged)
        assert "cannot be read as an EXR image" in refused(capsys, "regress", path, *out)
        assert "remove it" in refused(capsys, "regress", path, "--update")
    regress.scenes.write_image(file, np.zeros((12, 16, 3)))
    assert "is an EXR image, but no reference" in refused(capsys, "regress", path, *out)
    about = {"scene": "scene", "variant": "llvm_ad_rgb", "defines": {}, "budget": 8, "spp": 128, "seed": 0}
    picture = np.zeros((12, 16, 3), np.float32)
    for image, wrong in ((picture, {"budget": 0}), (picture, {"spp": "many"}), (picture + np.nan, {})):
        write_reference(file, regress.Reference(image, picture, {**about, **wrong}))
        assert "is a damaged reference" in refused(capsys, "regress", path, *out)
    assert not (tmp_path / "out").exists()


def test_bad_options(tmp_path, capsys):
    path = scene_file(tmp_path)
    assert "nowhere.xml: no such scene file" in refused(capsys, "regress", path, "nowhere.xml", "--update")
    assert 'more than one is called "scene"' in refused(capsys, "regress", path, path)
    assert "does not exist" in refused(capsys, "regress", path, "--out", str(tmp_path / "no" / "out"))
    assert "is not a folder" in refused(capsys, "regress", path, "--out", path)
    assert "does not exist" in refused(capsys, "regress", path, "--update", "--references", str(tmp_path / "no" / "r"))
    with pytest.raises(SystemExit) as caught:
        main(["regress", path, "--update", "-D", "width"])
    assert caught.value.code == 2 and "expected NAME=VALUE" in capsys.readouterr().err
    with pytest.raises(SystemExit) as caught:
        main(["regress"])
    assert caught.value.code == 2
