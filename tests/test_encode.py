"""Material encoding: parameter textures as latent textures."""

import json
import re

import drjit as dr
import numpy as np
import pytest

from mi_diffind.cli import main
from mi_diffind.tables import save_table
from mi_diffind.tasks.disney import TASK
from mi_diffind.tasks.disney.decoder import Decoder

NAMES = (
    "roughness", "anisotropic", "metallic", "specular", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat",
    "clearcoat_gloss",
)  # fmt: skip


def smooth(rng, channels, size=32):
    """Periodic waves between 0 and 1."""
    u, v = np.meshgrid(*[np.arange(size) / size * 2 * np.pi] * 2)
    waves = [
        np.sin(a * u + p) * np.cos(b * v + q) for a, b, p, q in zip(*rng.integers(1, 4, (4, channels)), strict=True)
    ]
    return 0.5 + 0.5 * np.stack(waves, -1)


def write_scene(folder, rng, names=NAMES, zero=(), transforms=()):
    import mitsuba as mi

    textures = []
    for name in ("base_color", *names):
        values = smooth(rng, 3 if name == "base_color" else 1) * (name not in zero)
        mi.Bitmap(np.round(255 * values).astype(np.uint8)).write(str(folder / f"{name}.png"))
        raw = "" if name == "base_color" else '<boolean name="raw" value="true"/>'
        scale = 2 if name in transforms else 3
        textures.append(
            f'<texture name="{name}" type="bitmap"><string name="filename" value="{name}.png"/>{raw}'
            f'<transform name="to_uv"><scale x="{scale}" y="{scale}"/></transform></texture>'
        )
    path = folder / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><default name="preset" value="tables"/><integrator type="path"/><shape type="sphere">'
        '<bsdf type="twosided"><bsdf type="neural_disney" id="m"><string name="preset" value="$preset"/>'
        f'<float name="clearcoat_sampling_rate" value="1"/>{"".join(textures)}</bsdf></bsdf></shape></scene>'
    )
    return path


@pytest.fixture(autouse=True)
def few_samples(monkeypatch):
    """What is lost and gained is measured at fewer places, and less often, than for a user."""
    from mi_diffind import encode

    _, _, seed = encode.measure.__defaults__
    monkeypatch.setattr(encode.measure, "__defaults__", (2**16, 2, seed))


@pytest.mark.parametrize("preset", TASK.presets)
def test_decode_inverts_encode(rng, preset):
    import drjit.llvm.ad as ad

    decoder = TASK.open(ad.TensorXf, "", preset).decoder
    roughness, anisotropic = (ad.Float(rng.random(10_000).astype("f4")) for _ in range(2))
    latent = decoder.encode_roughness(roughness), decoder.encode_anisotropic(anisotropic)
    assert all(v.numpy().min() >= -1e-3 and v.numpy().max() <= 1.001 for v in latent)
    found = decoder.decode(latent)
    visible = roughness.numpy() > 0.05  # below, α has a floor
    tolerances = {"tables": (6e-5, 0.0025), "paper": (0.0012, 0.012)}[preset]
    for a, b, tolerance in zip(found, (roughness, anisotropic), tolerances, strict=True):
        assert np.quantile(np.abs(a.numpy() - b.numpy())[visible], 0.99) < tolerance


@pytest.mark.parametrize("preset", ["tables", pytest.param("paper", marks=pytest.mark.slow)])
def test_encoded_materials_look_the_same(mi_rgb, rng, tmp_path, capsys, preset):
    from mi_diffind import scenes
    from mi_diffind.measure import operations

    mi = mi_rgb
    scene, out, report = write_scene(tmp_path, rng), tmp_path / "out", tmp_path / "report.json"
    arguments = ["encode", str(scene), "--material", "m", "-o", str(out), "--json", str(report)]
    assert main([*arguments, "-D", f"preset={preset}"]) == 0
    found = json.loads(report.read_text())
    assert "latents_0   roughness, anisotropic, metallic" in capsys.readouterr().out
    assert sorted(found["layout"]) == sorted(NAMES) and found["preset"] == preset
    assert found["bytes"] == found["bytes_before"] == 13 * 32 * 32
    assert found["psnr_db"] > 50  # few texels: interpolating coordinates is not interpolating roughness

    before = scenes.learned_instances(scenes.load(scene, defines={"preset": preset}))[0]
    after = mi.load_file(str(out / "material.xml"))
    reads = [operations.bsdf_operations(b, ("eval",))["eval"].gathers for b in (before, after)]
    assert reads[1] <= reads[0] - 20

    # Sampling and density fit together, whatever encoding did to the roughness
    n = 20_000
    si = dr.zeros(mi.SurfaceInteraction3f, n)
    si.uv = mi.Point2f(rng.random((2, n)).astype("f4"))
    si.wi = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.random((2, n)).astype("f4")))
    uniform = [mi.Float(rng.random(n).astype("f4")) for _ in range(3)]
    bs, weight = after.sample(mi.BSDFContext(), si, uniform[0], mi.Point2f(uniform[1], uniform[2]))
    valid = bs.pdf.numpy() > 0
    assert valid.mean() > 0.5
    pdf, value = after.pdf(mi.BSDFContext(), si, bs.wo).numpy(), after.eval(mi.BSDFContext(), si, bs.wo).numpy()
    assert np.allclose(bs.pdf.numpy()[valid], pdf[valid], rtol=5e-3)
    assert np.allclose(weight.numpy()[:, valid], (value / np.maximum(pdf, 1e-30))[:, valid], rtol=5e-3, atol=1e-5)


def test_bytes_are_spaced_for_the_decoder(mi_rgb, rng, tmp_path):
    """Where roughness is low, an encoded byte is finer than a raw one: 0.02 to 0.06 in float16, stored as bytes."""
    mi = mi_rgb
    decoder = Decoder()
    roughness = mi.Float((0.02 + 0.04 * rng.random(10_000)).astype("f4"))
    coded = decoder.encode_roughness(roughness)
    encoded, raw = (np.round(255 * v.numpy()) / 255 for v in (coded, roughness))
    error = np.abs(decoder.decode((mi.Float(encoded.astype("f4")), mi.Float(0)))[0].numpy() - roughness.numpy()).mean()
    assert error < 0.5 * np.abs(raw - roughness.numpy()).mean()


def test_encoded_materials_outlive_a_change_of_variant(mi_rgb, rng, tmp_path):
    """The module is executed again for each variant: a class must not look itself up by its name."""
    from mi_diffind.encode import encode

    mi = mi_rgb
    variant = mi.variant()
    encode(write_scene(tmp_path, rng, ("roughness",)), "m", tmp_path / "out")
    bsdf = mi.load_file(str(tmp_path / "out" / "material.xml"))
    mi.set_variant(variant.replace("rgb", "mono"))
    mi.set_variant(variant)
    si = dr.zeros(mi.SurfaceInteraction3f, 10)
    si.wi = mi.Vector3f(0, 0, 1)
    assert np.isfinite(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0.6, 0.8)).numpy()).all()


def test_only_what_has_an_effect_is_stored(mi_rgb, rng, tmp_path):
    from mi_diffind.encode import encode

    scene = write_scene(tmp_path, rng, ("roughness", "clearcoat", "clearcoat_gloss", "metallic"), zero=("clearcoat",))
    found = encode(scene, "m", tmp_path / "out", "float16")
    assert found["layout"] == ["roughness", "metallic"]
    after = mi_rgb.load_file(str(tmp_path / "out" / "material.xml"))
    keys = mi_rgb.traverse(after).keys()
    assert "roughness.value" not in keys and "latents_0.data" in keys and "clearcoat.value" in keys


def test_latents_can_be_optimised(mi_rgb, rng, tmp_path):
    from mi_diffind.encode import encode

    mi = mi_rgb
    encode(write_scene(tmp_path, rng, ("roughness", "metallic")), "m", tmp_path / "out", "float16")
    file = tmp_path / "out" / "material.xml"
    floats = '<texture name="latents_0" type="bitmap"><string name="format" value="variant"/>'
    file.write_text(file.read_text().replace('<texture name="latents_0" type="bitmap">', floats))
    bsdf = mi.load_file(str(file))
    params = mi.traverse(bsdf)
    dr.enable_grad(params["latents_0.data"])
    params.update()
    si = dr.zeros(mi.SurfaceInteraction3f, 1000)
    si.uv = mi.Point2f(rng.random((2, 1000)).astype("f4"))
    si.wi = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.random((2, 1000)).astype("f4")))
    wo = mi.warp.square_to_uniform_hemisphere(mi.Point2f(rng.random((2, 1000)).astype("f4")))
    dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), si, wo).x))
    gradient = dr.grad(params["latents_0.data"]).numpy()
    assert np.isfinite(gradient).all() and (np.abs(gradient[..., :2]).sum(axis=(0, 1)) > 0).all()


@pytest.mark.parametrize(
    "names, options, sentence",
    [
        (("roughness",), ["--material", "x"], 'has no material "x"; only materials of neural_disney can be encoded: m'),
        (("roughness", "sheen"), ["--transforms"], "have to be bitmaps with the same to_uv"),
    ],
)
def test_refusals(mi_rgb, rng, tmp_path, capsys, names, options, sentence):
    transforms = ("sheen",) if "--transforms" in options else ()
    scene = write_scene(tmp_path, rng, names, transforms=transforms)
    options = [o for o in options if o != "--transforms"] or ["--material", "m"]
    assert main(["encode", str(scene), "-o", str(tmp_path / "out"), *options]) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("plugin", ["disney", "neural_ggx", "principled"])
def test_materials_without_latents_are_refused(mi_rgb, tmp_path, capsys, plugin):
    scene = tmp_path / "scene.xml"
    scene.write_text(f'<scene version="3.0.0"><shape type="sphere"><bsdf type="{plugin}" id="m"/></shape></scene>')
    assert main(["encode", str(scene), "--material", "m", "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert '"m" has no latents, which only materials of neural_disney have; there are none' in error
    assert "Traceback" not in error and not (tmp_path / "out").exists()


def test_what_is_written_keeps_what_was_said(mi_rgb, rng, tmp_path):
    """One's own tables, their storage, constants, and the place of the textures."""
    from mi_diffind.encode import encode

    scene = write_scene(tmp_path, rng, ("roughness",))
    save_table(tmp_path / "own.npz", TASK.load(TASK.file(preset="paper")))
    own = '<string name="filename" value="own.npz"/><string name="storage" value="float16"/>'
    own += '<float name="sheen" value="0.25"/><float name="eta" value="1.5"/>'
    scene.write_text(scene.read_text().replace('<string name="preset" value="$preset"/>', own))
    encode(scene, "m", tmp_path / "out")
    text = (tmp_path / "out" / "material.xml").read_text()
    assert text.startswith("<bsdf version=") and 'type="neural_disney" id="m"' in text
    assert '<float name="sheen" value="0.25" />' in text and '<scale x="3" y="3" />' in text
    bsdf = mi_rgb.load_file(str(tmp_path / "out" / "material.xml"))
    report = bsdf.report()
    assert (report["preset"], report["storage"]) == ("paper", "float16") and bsdf.id() == "m"
    assert float(mi_rgb.traverse(bsdf)["eta"][0]) == pytest.approx(1.5, rel=1e-5)


@pytest.mark.parametrize(
    "parameters, sentence",
    [
        ({"latents": "roughness hue"}, 'parameter "latents": found "hue", allowed are roughness'),
        ({"latents": "roughness roughness"}, 'parameter "latents": found "roughness", twice'),
        ({"latents": "roughness", "roughness": 0.5}, 'parameter "roughness": is given by "latents", too'),
        ({"latents": "specular", "eta": 1.5}, 'parameter "eta": is given by "latents", too'),
        ({"latents": "flatness", "subsurface": 0.5}, 'parameter "subsurface": is given by "latents", too'),
    ],
)
def test_contradictions_are_refused(mi_rgb, parameters, sentence):
    with pytest.raises(RuntimeError) as caught:
        mi_rgb.load_dict({"type": "neural_disney", "latents_0": {"type": "checkerboard"}, **parameters})
    assert sentence in str(caught.value)


def test_encoded_materials_have_no_exact_counterpart(mi_rgb, rng, tmp_path, capsys):
    from mi_diffind.encode import encode

    encode(write_scene(tmp_path, rng, ("roughness",)), "m", tmp_path / "out")
    material = re.sub(' version="[0-9.]*"', "", (tmp_path / "out" / "material.xml").read_text())
    scene = tmp_path / "out" / "scene.xml"
    scene.write_text(f'<scene version="3.0.0"><integrator type="path"/><shape type="sphere">{material}</shape></scene>')
    assert main(["compare", str(scene), "--out", str(tmp_path)]) == 2
    assert '"m" has its parameters encoded (latents)' in capsys.readouterr().err
