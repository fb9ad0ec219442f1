"""Checks against stored references: the statistics, what they let pass and catch, the files, and the command."""

import dataclasses
import json
import os
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from commands import interrupt_at, refused
from variants import set_variant

from mi_diffind.commands.cli import main
from mi_diffind.scenes import regression as regress

TESTS = Path(__file__).resolve().parent
SCENES = TESTS.parent / "scenes"
NAMES = ("field", "horizon", "library", "materials", "metals", "rust", "solids", "still_life", "tiles")
STORED = [*(SCENES / f"{name}.xml" for name in NAMES), TESTS / "lamp.xml"]


def scene_file(tmp_path, name="scene", reflectance=0.5):
    """A scene that Mitsuba traces in no time, since references of it consist of hundreds of renders."""
    path = tmp_path / f"{name}.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="direct"/><emitter type="constant"/><default name="width" value="16"/>'
        '<default name="sampler" value="independent"/><sensor type="perspective"><sampler type="$sampler"/>'
        '<film type="hdrfilm"><integer name="width" value="$width"/>'
        '<integer name="height" value="12"/><rfilter type="box"/><string name="pixel_format" value="rgb"/></film>'
        '</sensor><shape type="sphere"><transform name="to_world"><translate z="4"/></transform>'
        f'<bsdf type="diffuse"><spectrum name="reflectance" value="{reflectance}"/></bsdf></shape></scene>'
    )
    return str(path)


@pytest.fixture
def check(tmp_path):
    """A function that runs the command and returns its exit code and the figures of the first scene."""

    def run(*arguments):
        report = tmp_path / "report.json"
        code = main(["regress", *map(str, arguments), "--json", str(report)])
        return code, json.loads(report.read_text())["scenes"][0] if report.exists() else None

    return run


def test_passes_share_no_samples(mi_rgb, monkeypatch, tmp_path):
    """Neither with each other nor with those of the other side, also where a pass takes several renders."""
    taken = []

    def render_pass(scene, spp, seed):
        taken.append((spp, seed))
        return np.full((12, 16, 3), 0.5)

    monkeypatch.setattr(regress.loading, "render_pass", render_pass)
    path = scene_file(tmp_path)
    for limit, renders in ((1 << 22, 1), (192, 4)):
        monkeypatch.setattr(regress, "_RENDER", limit)
        for seed in (0, 3):
            regress.regress(path, update=True, spp=32, seed=seed, progress=False)
            assert regress.regress(path, seed=seed, progress=False).figures["spp"] == 32
        assert len(taken) == 2 * (128 + 8 + 8) * renders and {spp for spp, _ in taken} == {4 // renders}
        assert len({seed % 2**32 for _, seed in taken}) == len(taken) - 8 * renders  # both updates end in one check
        taken.clear()


def test_samplers_that_round(mi_rgb, tmp_path, capsys, check):
    """Reports state the rendered samples; a check has the samples of its reference, or is refused."""
    path = scene_file(tmp_path)
    rounded = {"independent": 24, "stratified": 32, "multijitter": 24, "orthogonal": 32, "ldsampler": 32}
    for sampler, spp in rounded.items():
        scene = regress.loading.load(path, {"sampler": sampler})
        assert regress.PassSize.for_check(scene, 20).check_spp == spp
    _, stored = check(path, "--update", "-D", "sampler=stratified", "--spp", "20")
    assert "a check has 32 spp (asked for 20) and would see" in capsys.readouterr().out
    assert (stored["asked_spp"], stored["budget"], stored["spp"]) == (20, 32, 512)
    code, checked = check(path)
    assert (code, checked["spp"]) == (0, 32)
    for wrong in (["--spp", "100"], ["--spp", "128", "-D", "sampler=independent"]):
        message = refused(capsys, "regress", path, *wrong)
        assert "samples a pixel, its reference is for 32: keep --spp" in message and "--update --spp 128" in message


def test_passes_of_references_repeat_to_the_last_bit(mi_rgb):
    """Passes of 30 or 54 samples do not on several cores: threads share pixels, and add up in any order."""
    scene = regress.loading.load(TESTS / "lamp.xml")
    for spp in (32, 64):
        assert len({regress.loading.render_pass(scene, spp, 7).tobytes() for _ in range(6)}) == 1


#: Scenes of which other variants show the same already, or that take longest, by the end of the variant.
SLOW = {
    "mono": ("horizon", "materials", "metals", "field", "library", "rust", "solids", "still_life"),
    "spectral": ("field", "library", "rust", "solids", "still_life"),
}


@pytest.mark.parametrize(
    "path, variant",
    [
        pytest.param(path, f"llvm_ad_{v}", id=f"{path.stem}-llvm_ad_{v}",
                     marks=[pytest.mark.slow] if path.stem in SLOW.get(v, ()) else [])
        for path in STORED for v in ("rgb", "spectral", "mono")
    ],
)  # fmt: skip
def test_scene_renders_as_its_reference(path, variant):
    """If a change is meant, render the references again: scenes/README.md says how."""
    set_variant(variant)
    result = regress.regress(path, progress=False).figures
    assert result["passed"], result
    assert result["reference_spp"] == 16 * result["spp"] and result["spp"] >= 128


def test_update_stores_what_a_check_needs(tmp_path, capsys, check):
    path, folder = scene_file(tmp_path), tmp_path / "references"
    code, _ = check(path, "--update", "--spp", "20", "--seed", "7", "-D", "width=10")
    assert code == 0 and "10 x 12, 384 spp" in capsys.readouterr().out  # 128 passes of 3
    assert os.listdir(folder) == ["scene.llvm_ad_rgb.exr"]
    file = folder / "scene.llvm_ad_rgb.exr"
    with OpenEXR.File(str(file), separate_channels=True) as content:
        about = json.loads(content.header()["mi_diffind"])
        image, blocks = ({k: v.pixels.copy() for k, v in part.channels.items()} for part in content.parts)
    assert sorted(image) == ["B", "G", "R"]
    assert sorted(blocks) == sorted(f"{n}.{c}" for c in "RGB" for n in ("mean", *(f"pass{i:02}" for i in range(16))))
    assert all(c.shape == (12, 10) and c.dtype == np.float16 for c in image.values())
    assert all(c.shape == (3, 3) and c.dtype == np.float32 for c in blocks.values())
    assert blocks["mean.G"][2, 1] == pytest.approx(image["G"][8:12, 4:8].mean(), rel=1e-3)
    assert set(about.pop("versions")) == {"mi_diffind", "mitsuba"} and len(about.pop("stops")) == 16
    assert 0 < about.pop("visible_change") < 0.5
    expected = {"scene": "scene", "variant": "llvm_ad_rgb", "budget": 24, "spp": 384, "seed": 7}
    assert about == {**expected, "defines": {"width": "10"}}

    files = []
    for options in (["--spp", "16"], [], ["--seed", "8"]):  # the second: size, samples and seed as before
        assert check(path, "--update", *options)[0] == 0
        files.append(file.read_bytes())
    assert files[0] == files[1] != files[2]
    code, result = check(path)
    assert code == 0
    assert (result["width"], result["height"], result["spp"], result["reference_spp"]) == (10, 12, 16, 256)
    code, result = check(path, "--spp", "16", "--seed", "5")
    assert (code, result["seed"]) == (0, 5)


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
    verdicts = [line.split()[:2] for line in lines if "spp" in line]
    assert verdicts == [["passed", "first"], ["FAILED", "second"], ["passed", "third"]]
    assert len(os.listdir(tmp_path / "out")) == 5


def test_an_update_that_does_not_end_changes_nothing(mi_rgb, tmp_path, capsys, monkeypatch, check):
    path, file = scene_file(tmp_path), tmp_path / "references" / "scene.llvm_ad_rgb.exr"
    assert check(path, "--update", "--spp", "8")[0] == 0
    before = file.read_bytes()

    class Failing(OpenEXR.File):
        def write(self, name):
            Path(name).write_bytes(b"half")
            raise RuntimeError("disk full")

    with monkeypatch.context() as patch:
        patch.setattr(OpenEXR, "File", Failing)
        assert "cannot be written: disk full" in refused(capsys, "regress", path, "--update", "--seed", "1")
    assert file.read_bytes() == before and os.listdir(file.parent) == [file.name]
    interrupt_at(monkeypatch, regress.loading, "render_pass")
    code, result = check(path)
    assert (code, result["passed"]) == (130, None) and "interrupted" in capsys.readouterr().out


def test_a_reference_that_would_fail_unchanged_is_refused(mi_rgb, rng, tmp_path, capsys, monkeypatch):
    """One of two checks has to pass: one of a hundred fails by chance."""
    path, fails = scene_file(tmp_path), 2

    def brighter_checks(scene, spp, seed):
        number = 65535 - (seed >> 16)
        return rng.normal(1.5 if number < fails else 1, 0.1, (12, 16, 3))

    monkeypatch.setattr(regress.loading, "render_pass", brighter_checks)
    message = refused(capsys, "regress", path, "--update", "--spp", "16")
    assert "fails two checks at 16 samples a pixel although nothing has changed: bright paths are too rare" in message
    assert os.listdir(tmp_path / "references") == []
    fails = 1
    assert main(["regress", path, "--update", "--spp", "16"]) == 0


def test_pixels_that_are_not_finite(mi_rgb, tmp_path, capsys, monkeypatch):
    """A reference with such pixels is refused, a check fails and counts them."""
    path, original, out = scene_file(tmp_path), regress.loading.render_pass, tmp_path / "out"

    def spoiled(scene, spp, seed):
        image = original(scene, spp, seed)
        image[3, 4:6, 1] = np.nan, np.inf
        return image

    assert main(["regress", path, "--update", "--spp", "16"]) == 0
    monkeypatch.setattr(regress.loading, "render_pass", spoiled)
    capsys.readouterr()
    assert main(["regress", path, "--out", str(out)]) == 1
    assert "16 spp: 2 pixel(s) are not finite\n" in capsys.readouterr().out
    assert np.isnan(np.array(mi.Bitmap(str(out / "scene.llvm_ad_rgb.image.exr")))[3, 4, 1])
    message = refused(capsys, "regress", path, "--update")
    assert "2 pixel(s) are not finite, so this cannot be a reference" in message


def test_an_interrupted_update_goes_on(mi_rgb, tmp_path, capsys, monkeypatch, check):
    """From where it was: the bytes of the reference are those of one that was never interrupted."""
    path, name = scene_file(tmp_path), "scene.llvm_ad_rgb.exr"
    folder, partial = tmp_path / "own", tmp_path / "own" / "scene.llvm_ad_rgb.partial.npz"
    update = [path, "--update", "--spp", "16", "--references"]
    assert check(*update, tmp_path / "undisturbed")[0] == 0
    taken = interrupt_at(monkeypatch, regress.loading, "render_pass", 50)
    capsys.readouterr()
    assert check(*update, folder)[0] == 130
    assert f"{partial}: 100 samples a pixel are kept, the same command goes on" in capsys.readouterr().out
    assert os.listdir(folder) == [partial.name]
    before = len(taken)
    code, result = check(*update, folder)
    assert (code, result["reused_passes"], len(taken) - before) == (0, 50, 128 - 50 + 8)  # and the check
    content = (folder / name).read_bytes()
    assert content == (tmp_path / "undisturbed" / name).read_bytes() and os.listdir(folder) == [name]

    taken.clear()
    assert check(*update, folder)[0] == 130
    assert (folder / name).read_bytes() == content
    scene_file(tmp_path, reflectance=0.3)  # another scene: nothing of it is used
    code, result = check(*update, folder)
    assert (code, result["reused_passes"]) == (0, 0)
    partial.write_bytes(b"damaged")
    assert check(*update, folder)[0] == 0


def test_references_serve_both_backends(mi_rgb, tmp_path, monkeypatch):
    path = scene_file(tmp_path)
    regress.regress(path, update=True, spp=8, progress=False)
    stored = regress.read_reference(path)
    monkeypatch.setattr(mi, "variant", lambda: "cuda_ad_rgb")
    assert np.array_equal(regress.read_reference(path).image, stored.image)
    monkeypatch.setattr(mi, "variant", lambda: "llvm_ad_spectral")
    with pytest.raises(regress.loading.SceneError, match=r'no reference ".*scene.llvm_ad_spectral.exr"; run'):
        regress.read_reference(path)


def test_bad_references(mi_rgb, tmp_path, capsys):
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
    regress.loading.write_image(file, np.zeros((12, 16, 3)))
    assert "is an EXR image, but no reference" in refused(capsys, "regress", path, *out)
    file.write_bytes(content)
    stored = regress.read_reference(path)
    for wrong in ({"budget": 0}, {"spp": "many"}, {"image": stored.image + np.nan}, {"image": stored.image[:8]}):
        image = wrong.pop("image", stored.image)
        regress.write_reference(file, dataclasses.replace(stored, image=image, about={**stored.about, **wrong}))
        assert "is a damaged reference" in refused(capsys, "regress", path, *out)
    assert not (tmp_path / "out").exists()


def test_bad_options(tmp_path, capsys):
    path = scene_file(tmp_path)
    assert 'more than one is called "scene"' in refused(capsys, "regress", path, path)
    assert "does not exist" in refused(capsys, "regress", path, "--out", str(tmp_path / "no" / "out"))
    assert "is not a folder" in refused(capsys, "regress", path, "--out", path)
    assert "does not exist" in refused(capsys, "regress", path, "--update", "--references", str(tmp_path / "no" / "r"))
