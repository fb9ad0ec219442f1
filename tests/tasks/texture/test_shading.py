"""``fit texture --shading``: what a material looks like, references, limited derivatives, training, command."""

import dataclasses
import functools
import json
import re
import signal
from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from bsdf_queries import interactions, texels
from commands import refused
from scipy.ndimage import map_coordinates
from texture_files import bumpy, pyramid_of, write_manifest

import mi_diffind
from mi_diffind.arrays.tables import TableError, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import loop, task
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps import as_seen
from mi_diffind.maps.model import size_figures
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.disney import TASK as DISNEY
from mi_diffind.tasks.disney.decoder import Decoder
from mi_diffind.tasks.disney.model import Effects
from mi_diffind.tasks.disney.training import uniform_hemisphere
from mi_diffind.tasks.texture import PRESETS as TEXTURES
from mi_diffind.tasks.texture import SHADING_PRESETS as PRESETS
from mi_diffind.tasks.texture import TASK as TEXTURE
from mi_diffind.tasks.texture import fit as texture_fit
from mi_diffind.tasks.texture import heldout, parse_structure
from mi_diffind.tasks.texture import shading as training
from mi_diffind.tasks.texture import surface as material
from mi_diffind.tasks.texture import training as textures
from mi_diffind.tasks.texture.appearance import ShadedEvaluation, reader, reference
from mi_diffind.tasks.texture.arrays import PaperBudget
from mi_diffind.tasks.texture.compressed import CompressedTexture
from mi_diffind.tasks.texture.heldout import HeldOutFootprints

OURS = PRESETS["ours"]


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


def directions(ad, rng, n):
    u = [ad.Float(x) for x in rng.random((4, n), dtype=np.float32)]
    return uniform_hemisphere(ad, u[0], u[1]), uniform_hemisphere(ad, u[2], u[3])


def shading_surface(ad, *maps):
    """Parameters of a surface by its albedo, normal, roughness and metallic, ``(n, channels)`` each."""
    albedo, normal, rough, metal = ([ad.Float(aligned(c)) for c in v.T] for v in maps)
    return material.SurfaceParameters(ad.Array3f(albedo), ad.Array3f(normal), *rough, *metal)


# -- limited derivatives ----------------------------------------------------------------------------------------------


def test_clip_changes_derivatives_only(ad):
    x = ad.Float([0.5, -2.0, 3.0, 7.0])
    y = ad.Float([1.0, 2.0, 3.0, 4.0])
    dr.enable_grad(x, y)
    value = material.clipped(x, 0.1)
    assert np.array_equal(dr.detach(value).numpy(), dr.detach(x).numpy())
    slopes = ad.Float([0.05, -3.0, 0.1, np.nan])
    dr.backward(dr.sum(slopes * value + 5 * x * y))
    # What does not flow through the operation is not touched
    assert np.allclose(dr.grad(x).numpy(), np.array([0.05, -0.1, 0.1, 0]) + 5 * y.numpy(), atol=1e-6)
    assert np.allclose(dr.grad(y).numpy(), 5 * dr.detach(x).numpy())


def test_clip_is_for_the_specular_lobe(ad, rng):
    """A bound changes no value and no derivative of the diffuse lobe; those of a highlight are limited."""
    wi, wo = directions(ad, rng, 512)
    effects, results = Effects(**{**dict.fromkeys(("metal", "dielectric", "diffuse"), True),
                                  **dict.fromkeys(("subsurface", "sheen", "sheen_tint", "spec_tint", "anisotropic",
                                                   "clearcoat"), False)}), []  # fmt: skip
    for limit in (None, 1e-3, 1e9):
        rough = dr.full(ad.Float, 0.1, 512)
        dr.enable_grad(rough)
        surface = material.SurfaceParameters(ad.Array3f(0.5), None, rough, 0.5)
        value = material.shaded(Decoder(), surface, wi, wo, effects, limit)
        dr.backward(dr.sum(value.x))
        results.append((numpy_of(dr.detach(value)), dr.grad(rough).numpy()))
    (a, free), (b, bounded), (c, loose) = results
    assert np.allclose(a, b, rtol=1e-5, atol=1e-6) and np.allclose(a, c, rtol=1e-5, atol=1e-6)
    assert np.allclose(free, loose, rtol=1e-3, atol=1e-3 * np.abs(free).max())
    # What is left over the bound is the derivative of the diffuse lobe, at most 2 albedo (1 - metallic) · Fresnel
    assert np.abs(free).max() > 10 and np.abs(bounded).max() < 2


# -- what a material looks like ---------------------------------------------------------------------------------------


def test_shaded_is_mitsubas_normalmap(mi_rgb, rng):
    """A plugin of Mitsuba's around ours, with textures of one texel a place, evaluated in random directions."""
    mi, n = mi_rgb, 256
    ad = array_module("llvm")
    xy = rng.uniform(-0.65, 0.65, (n, 2))
    normal = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(-1, keepdims=True))], -1)
    values = {
        "base_color": rng.random((n, 3)),
        "roughness": rng.uniform(0.1, 1, (n, 1)),
        "metallic": rng.random((n, 1)),
    }
    bsdf = mi.load_dict({
        "type": "normalmap", "normalmap": texels(mi, 0.5 + 0.5 * normal),
        "bsdf": {"type": "disney", **{name: texels(mi, v) for name, v in values.items()}},
    })  # fmt: skip
    wi, wo = directions(ad, rng, n)
    si = interactions(mi, mi.Vector3f(*wi), np.arange(n), n)
    expected = np.pi * np.stack([c.numpy() for c in bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*wo))], -1)

    surface = shading_surface(ad, values["base_color"], normal, values["roughness"], values["metallic"])
    effects, _ = material.material_effects(pyramid_of(bumpy(8), ad)[1].layout)
    for decoder in (Decoder(), None):
        got = numpy_of(material.shaded(decoder, surface, wi, wo, dataclasses.replace(effects, diffuse=True,
                                                                                     dielectric=True)))  # fmt: skip
        assert np.allclose(got, expected, rtol=2e-3, atol=2e-4)
    assert (expected.max(axis=-1) == 0).mean() < 0.3 and (expected > 0.5).any()
    flat = material.shaded(Decoder(), dataclasses.replace(surface, normal=None), wi, wo, effects)
    assert not np.allclose(numpy_of(flat), expected, rtol=0.1, atol=0.1)


def test_extreme_materials_stay_finite(ad, rng):
    """Roughness 0, black, short and vanishing normals, directions at the horizon: values and derivatives."""
    n = 4096
    wi, wo = directions(ad, rng, n)
    flat = rng.choice([1e-7, 1e-4, 0.5, 1.0], (2, n)).astype(np.float32)
    wi, wo = (dr.normalize(type(w)(w.x, w.y, w.z * ad.Float(s))) for w, s in zip((wi, wo), flat, strict=True))
    normal = ad.Array3f(*(ad.Float(x) for x in rng.choice([-1.0, 0.0, 1e-8, 0.7], (3, n)).astype(np.float32)))
    albedo = ad.Array3f(*(ad.Float(x) for x in rng.choice([0.0, 1e-8, 1.0], (3, n)).astype(np.float32)))
    rough, metal = (ad.Float(x) for x in rng.choice([0.0, 1e-4, 1.0], (2, n)).astype(np.float32))
    for decoder in (Decoder(), material.frozen_decoder(ad)):
        leaves = [type(x)(x) for x in (normal, albedo, rough, metal)]
        dr.enable_grad(leaves)
        surface = material.SurfaceParameters(leaves[1], leaves[0], leaves[2], leaves[3])
        value = material.shaded(decoder, surface, wi, wo, Effects(), 0.1)
        assert np.isfinite(numpy_of(dr.detach(value))).all() and (numpy_of(dr.detach(value)) >= 0).all()
        dr.backward(dr.sum(sum(dr.minimum(c, 10) for c in value)))
        for leaf in leaves:
            assert all(np.isfinite(g).all() for g in np.atleast_2d(dr.grad(leaf).numpy()))


# -- references -------------------------------------------------------------------------------------------------------


def lanes(ad, rng, n, level):
    u, v = (ad.Float(x) for x in rng.random((2, n), dtype=np.float32))
    return u, v, dr.full(ad.Float, level, n), *directions(ad, rng, n)


def test_converged_reference_is_the_mean_of_shaded_texels(ad, rng):
    """The mean of bilinear reads by SciPy, shaded one by one."""
    size, n, level = 16, 6, 2.0
    source, pyramid = pyramid_of(bumpy(size, metallic=0.5), ad)
    effects, _ = material.material_effects(pyramid.layout)
    at = lanes(ad, rng, n, level)
    u, v = at[0].numpy().astype(np.float64), at[1].numpy().astype(np.float64)
    k = (np.arange(16) + 0.5) / 16 - 0.5
    x = (u[:, None, None] + k[None, None, :] * 4 / size) * size - 0.5 + np.zeros((n, 16, 16))
    y = (v[:, None, None] + k[None, :, None] * 4 / size) * size - 0.5 + np.zeros((n, 16, 16))

    def read(values):
        channels = [map_coordinates(c, [y, x], order=1, mode="grid-wrap") for c in np.moveaxis(values, -1, 0)]
        return np.stack(channels, axis=-1).reshape(n * 256, -1)

    maps = {m.name: m.values.astype(np.float64) for m in source.maps}
    decode = np.where(maps["albedo"] <= 0.04045, maps["albedo"] / 12.92, ((maps["albedo"] + 0.055) / 1.055) ** 2.4)
    # The third component follows from the other two, as it is stored
    xy = 2 * read(maps["normal"])[:, :2] - 1
    normal = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(-1, keepdims=True))], -1)

    surface = shading_surface(ad, read(decode), normal, read(maps["roughness"]), read(maps["metallic"]))
    index = dr.arange(ad.UInt32, n * 256) // 256
    wi, wo = (dr.gather(type(w), w, index) for w in at[3:])
    expected = numpy_of(material.shaded(None, surface, wi, wo, effects)).reshape(n, 256, 3).mean(axis=1)
    got = numpy_of(reference("converged", pyramid, *at, effects))
    assert np.allclose(got, expected, rtol=2e-3, atol=1e-3) and expected.max() > 0.05


def test_jittered_reference_is_right_on_average(ad, rng):
    _, pyramid = pyramid_of(bumpy(16, metallic=0.5, roughness=0.5), ad)
    effects, _ = material.material_effects(pyramid.layout)
    n, repeats = 16, 512
    at = lanes(ad, rng, n, 3.0)
    truth = numpy_of(reference("converged", pyramid, *at, effects, side=64))
    index = dr.arange(ad.UInt32, n * repeats) % n
    many = [dr.gather(type(x), x, index) for x in at]
    got = numpy_of(reference("jittered", pyramid, *many, effects, dr.rng(seed=5))).reshape(repeats, n, 3)
    error = got.mean(axis=0) - truth
    deviation = got.std(axis=0) / np.sqrt(repeats) + 1e-3 * truth.max()
    assert np.abs(error / deviation).max() < 5 and np.sqrt(np.mean((error / deviation) ** 2)) < 1.5
    # The paper's prefiltered samples are not: parameters are filtered first, for a footprint of 4 levels more so
    prefiltered = numpy_of(reference("prefiltered", pyramid, *at, effects))
    assert np.abs((prefiltered - truth) / deviation).max() > 5


# -- training ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def start(ad, tmp_path_factory):
    """A metal trained as a texture: source, pyramid, table, the images that measure, its file, and its size."""
    source, pyramid = pyramid_of(bumpy(), ad)
    recipe = TEXTURES["ours"]
    recipe = dataclasses.replace(recipe, steps=60, batch=4096, measure_every=60)
    options = {argument.name: argument.default for argument in TEXTURE.arguments} | {
        "structure": parse_structure("0:1:2,1:2:4")
    }
    options["skip"] = 2
    size = texture_fit.find_size(source, pyramid, source.nbytes / 2, recipe, options)
    request = FitRequest("ours", recipe, ad, progress=False)
    table, _ = textures.fit_texture(source, size, recipe, request, pyramid)
    path = tmp_path_factory.mktemp("shading") / "start.npz"
    save_table(path, table)
    effects, _ = material.material_effects(pyramid.layout)
    evaluation = ShadedEvaluation(pyramid, effects, levels=4, pairs=24, side=16)
    return source, pyramid, TEXTURE.load(path), evaluation, path, size


def quick(**changed):
    settings = {"steps": 60, "batch": 4096, "measure_every": 60, "lr": 1e-2, "level_bias": 0.0}
    return dataclasses.replace(OURS, **settings | changed)


@pytest.fixture(autouse=True)
def few_footprints(monkeypatch):
    """Fewer footprints and samples than by default, which tests do without."""
    monkeypatch.setattr(training, "HeldOutFootprints", functools.partial(HeldOutFootprints, count=256))
    monkeypatch.setattr(heldout, "CASES", (0, 4))
    monkeypatch.setattr(training, "BIASES", (0.0, -0.5))
    monkeypatch.setattr(training, "TRIED", 2**12)


@pytest.fixture
def unseen(monkeypatch):
    """No renders of the results."""
    monkeypatch.setattr(as_seen, "measure", lambda *a: {})


def trained(start, ad, recipe, measured=True, **request):
    """The table of the last stage without trainings for weighted maps, and its record."""
    source, pyramid, table, evaluation, *_ = start
    evaluation = evaluation if measured else SimpleNamespace(measure=lambda read, flip: {})
    net = training.trainable_arrays(table, pyramid)
    asked = FitRequest("ours", recipe, ad, progress=False, **request)
    return training.ShadingTraining(source, net, recipe, asked, pyramid, evaluation).fit()


def test_training_for_shading_gains(start, ad):
    """More than 1.5 dB on coarse levels over what was trained as a texture."""
    _, pyramid, table, evaluation, *_ = start
    effects, _ = material.material_effects(pyramid.layout)
    old = evaluation.measure(reader(CompressedTexture.from_table(table, ad.TensorXf), effects), flip=False)
    found, result = trained(start, ad, quick())
    assert result.restarts == 0 and result.step > 0
    new = evaluation.measure(reader(CompressedTexture.from_table(found, ad.TensorXf), effects), flip=False)
    assert np.mean(np.subtract(new["C"]["psnr_db"], old["C"]["psnr_db"])[2:]) > 1.5
    assert found.measured["shaded_converged_db"] == pytest.approx(new["C"]["mean_db"], abs=1e-3)
    assert found.settings["before"]["shaded_converged_db"] == pytest.approx(old["C"]["mean_db"], abs=1e-3)
    assert found.task == "texture" and found.settings["shading"]["share"] == OURS.share
    assert "kept_start" not in found.settings and found.settings["state"].startswith("appearance")


@pytest.mark.parametrize("changed", [{"lr": 0.3}, {"lr": 1e-12}])
def test_a_training_that_gains_nothing_keeps_its_start(start, ad, changed):
    """Trainings at a rate that destroys everything, or that changes nothing, return what they started with."""
    table = start[2]
    found, result = trained(start, ad, quick(steps=1, measure_every=1, **changed))
    assert found.settings["kept_start"] and found.settings["state"] == "start" and found.settings["level_bias"] == 0
    assert result.step == 0 and result.measured == {"gain_db": 0}  # those of what was kept
    assert found.measured["shaded_converged_db"] == pytest.approx(found.settings["before"]["shaded_converged_db"])
    for name, array in table.arrays.items():
        assert np.array_equal(found.arrays[name].entries, array.entries)
    states = found.settings["states"]
    assert states.pop("start") == 0 and all((gain < 0) == (changed["lr"] == 0.3) for gain in states.values() if gain)


def test_ctrl_c_before_the_first_step_keeps_the_start(start, ad, monkeypatch):
    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return HeldOutFootprints(*arguments, 64)

    monkeypatch.setattr(training, "HeldOutFootprints", interrupted)
    found, result = trained(start, ad, quick(level_bias=0.0))
    assert result.interrupted and result.outcome == "interrupted at step 0, kept step 0"
    assert found.settings["kept_start"] and not result.history


def test_arrays_leave_room_for_extras(ad):
    """Extras have four levels of 8 x 8 x 3 bytes, and none where these are more than a small part of all bytes."""
    _, pyramid = pyramid_of(bumpy(64), ad)
    recipe = dataclasses.replace(OURS, extras=True)
    nbytes = 4 * 8 * 8 * 3 / texture_fit.EXTRAS_SHARE
    assert texture_fit.room_for_extras(recipe, pyramid, nbytes) == (recipe, 4 * 8 * 8 * 3)
    assert texture_fit.room_for_extras(recipe, pyramid, nbytes - 1) == (OURS, 0)
    assert texture_fit.room_for_extras(OURS, pyramid, nbytes) == (OURS, 0)
    # A file without the extras that it has room for is not said to have missed its size
    source, table = from_arrays(bumpy(64)), SimpleNamespace(nbytes=9000, arrays={})
    assert len(size_figures(source, table, 10_000, 1000)[1]) == 1 and len(size_figures(source, table, 10_000)[1]) == 2


def test_extras_are_trained_stored_and_read_by_the_material_alone(mi_rgb, start, ad, tmp_path, monkeypatch):
    monkeypatch.setattr(training, "choose", lambda states: states[-1])  # whether it gains or not
    found, _ = trained(start, ad, quick(steps=30, measure_every=30, extras=True))
    extras = found.arrays["extras"]
    assert extras.shape == (3, 8, 8, 3) and found.settings["shading"]["extras"] and "kept_start" not in found.settings
    assert found.settings["state"] == "appearance 100%"
    assert all(np.ptp(extras.entries[..., k].astype(float)) > 3 for k in range(3))
    path, plain = str(tmp_path / "extras.npz"), str(tmp_path / "plain.npz")
    save_table(path, found)
    save_table(plain, dataclasses.replace(found, arrays={k: v for k, v in found.arrays.items() if k != "extras"}))
    assert TEXTURE.load(path).nbytes == TEXTURE.load(plain).nbytes + 576
    mi, values = mi_rgb, {}
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.uv, si.wi = mi.Point2f(*np.random.default_rng(1).random((2, 64)).astype(np.float32)), mi.Vector3f(0.6, 0, 0.8)
    for file in (path, plain):
        texture = mi.load_dict({"type": "neural_texture", "filename": file, "channels": "roughness"})
        bsdf = mi.load_dict({"type": "neural_material", "filename": file, "filter": "off"})
        value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(-0.5, 0.1, 0.8))
        values[file] = texture.eval_1(si).numpy(), value.numpy()
    np.testing.assert_array_equal(values[path][0], values[plain][0])
    assert np.abs(values[path][1] - values[plain][1]).max() > 1e-3
    for entries, border, sentence in (
        (extras.entries[..., :2], extras.border, 'array "extras" has the shape (3, 8, 8, 2), expected N x N x N x 3'),
        (extras.entries, ("clamp",) * 3, 'array "extras" has the borders'),
    ):
        scale = extras.scale[: entries.shape[-1]], extras.offset[: entries.shape[-1]]
        damaged = dataclasses.replace(extras, entries=entries, border=border, scale=scale[0], offset=scale[1])
        save_table(path, dataclasses.replace(found, arrays={**found.arrays, "extras": damaged}))
        with pytest.raises(TableError, match=re.escape(sentence)):
            TEXTURE.load(path)


def test_training_reads_the_level_that_a_file_is_read_at(start, ad):
    """Arrays whose levels differ: the loss of round footprints at a bias is that of what a biased file reads."""
    _, pyramid, table, *_ = start
    recipe = quick(share=1.0, rendered=False)
    problem = training.ShadingProblem(training.trainable_arrays(table, pyramid), pyramid, recipe)
    problem.settings, losses = problem.shading, []
    for bias, net in ((-0.5, problem.net), (0.0, CompressedTexture(pyramid.layout, problem.net, -0.5))):
        problem.level_bias = bias
        losses.append(problem.shading_errors(net, dr.rng(seed=dr.opaque(ad.UInt64, 7)), 512).numpy())
    np.testing.assert_allclose(*losses, rtol=1e-4, atol=1e-6)
    assert not np.allclose(losses[0], problem.shading_errors(problem.net, dr.rng(seed=dr.opaque(ad.UInt64, 7)), 512))


def test_share_zero_is_the_texture_alone(start, ad, monkeypatch):
    """λ = 0 trains as task 4 does, entry by entry."""
    source, pyramid, table, *_ = start
    monkeypatch.setattr(training, "choose", lambda states: states[-1])  # else the start might be kept
    recipe = quick(share=0.0, steps=5, measure_every=5)
    found, _ = trained(start, ad, recipe, measured=False)
    problem = textures.TextureProblem(
        training.trainable_arrays(table, pyramid), pyramid, TEXTURES["ours"], source.digest
    )
    loop.fit(problem, recipe, progress=False)
    # Settings say "mse" in both, and the samples are those of the same seed
    for name, array in textures.stored_form(problem.net).arrays.items():
        assert np.array_equal(found.arrays[name].entries, array.codes()), name


def test_gradient_of_the_loss_is_that_of_finite_differences(start, ad):
    """The gradient of the cascaded array's entries, without rounding and without bounds."""
    source, pyramid, table, *_ = start
    recipe = quick(share=1.0, clip=None, reference="converged", mirrored=0.0)
    problem = training.ShadingProblem(training.trainable_arrays(table, pyramid), pyramid, recipe, source.digest)
    problem.settings = recipe
    problem.recipe = dataclasses.replace(problem.recipe, rounded=False)
    net = problem.net
    original = dr.detach(net.cascaded.data)
    values = original.numpy()
    # Inside of the interval: what lies at its ends is folded back
    values = np.clip(values, 0.05, 0.95)

    def loss(entries, gradient=False):
        data = ad.TensorXf(entries)
        if gradient:
            dr.enable_grad(data)
        net.cascaded.data = data
        total = dr.sum(sum(dr.sum(x) for x in problem.loss(net, dr.rng(seed=dr.opaque(ad.UInt64, 7)), 2048)))
        if not gradient:
            return float(total[0])
        dr.backward(total)
        return dr.grad(data).numpy()

    derivative = loss(values, True)
    largest = np.argsort(-np.abs(derivative).ravel())[:12]
    for i in largest:
        step = np.zeros(values.size, np.float32)
        step[i] = 4e-3
        step = step.reshape(values.shape)
        finite = (loss(values + step) - loss(values - step)) / 8e-3
        assert derivative.ravel()[i] == pytest.approx(finite, rel=0.05, abs=0.02 * float(np.abs(derivative).max()))
    net.cascaded.data = original


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def manifest(tmp_path):
    return write_manifest(tmp_path, bumpy())


@pytest.fixture
def small(start, monkeypatch):
    """Few images that measure, small batches, and the arrays of other tests, lest everything is compiled anew."""
    evaluation = functools.partial(ShadedEvaluation, levels=4, pairs=24, side=16)
    monkeypatch.setattr(texture_fit, "ShadedEvaluation", evaluation)
    monkeypatch.setattr(texture_fit, "find_size", lambda *a: start[5])
    for name, recipe in PRESETS.items():
        monkeypatch.setitem(PRESETS, name, dataclasses.replace(recipe, batch=4096))


SHORT = ["--steps", "6", "--batch", "4096", "--border", "repeat", "--variant", "llvm_ad_rgb"]


def test_command_trains_both_and_the_plugin_reads_it(mi_rgb, small, manifest, tmp_path):
    mi = mi_rgb
    out, record = tmp_path / "metal.npz", tmp_path / "record.json"
    command = ["fit", "texture", str(manifest), "-o", str(out), *SHORT, "--json", str(record),
               "--checkpoint", str(tmp_path / "state")]  # fmt: skip
    assert main(command) == 0
    said = json.loads(record.read_text())
    assert said["task"] == "texture" and said["settings"]["shading"]["share"] == OURS.share
    assert said["settings"]["steps"] == 6 and said["settings"]["lr"] == OURS.lr  # of the last stage
    ways = {f"appearance {way:.0%}" for way in training.WAYS}
    assert {"start", "finer level", "weights"} | ways <= set(said["settings"]["states"])
    assert said["settings"]["state"] in said["settings"]["states"] and said["settings"]["level_bias"] in training.BIASES
    assert said["effects_left_out"]["diffuse"] == "metallic is 1" and said["measured"]["shaded_converged_db"] > 10
    assert said["before"]["shaded_converged_db"] > 10 and {"psnr_db", "seen_db"} <= set(said["measured"])
    assert np.array(mi.Bitmap(str(tmp_path / "metal_preview.png"))).shape == (2 * (16 + 192), 3 * 192, 3)
    texture = mi.load_dict({"type": "neural_texture", "filename": str(out), "channels": "roughness"})
    si = dr.zeros(mi.SurfaceInteraction3f, 4)
    assert np.isfinite(texture.eval_1(si).numpy()).all()
    first = out.read_bytes()
    assert main([*command, "--resume"]) == 0 and out.read_bytes() == first
    assert load_table(out).task == "texture"


def test_an_interrupted_training_goes_on_in_its_stage(small, unseen, manifest, tmp_path, monkeypatch):
    """Ctrl-C in a stage keeps the texture so far; resumed, all stages give the arrays of a run without it."""
    titles = []

    class Interrupted(FitRequest):
        """Request whose training of the stage with the title ``stop`` ends at its first measurement."""

        stop = ""

        def train(self, problem, title=None, *arguments, **options):
            titles.append(title)
            if title != self.stop:
                return super().train(problem, title, *arguments, **options)
            measure = type(problem).measure

            def interrupt(net):
                signal.raise_signal(signal.SIGINT)
                return measure(problem, net)

            problem.measure = interrupt
            return super().train(problem, title, *arguments, **options)

    monkeypatch.setattr(task, "FitRequest", Interrupted)
    given = {"steps": 20, "batch": 2048, "border": "repeat", "level_bias": 0, "progress": False,
             "variant": "llvm_ad_rgb", "measure_every": 5}  # fmt: skip
    run = functools.partial(mi_diffind.fit, "texture", str(manifest), **given)
    expected, stages = run(), ["maps", "trial", "trial", "weights", "appearance"]
    assert titles[:5] == stages
    files = {"maps": [""], "trial": [""], "weights": ["", ".shading.weights"]}
    files["appearance"] = [*files["weights"], ".shading.appearance"]
    for stage, suffixes in files.items():
        checkpoint = tmp_path / stage
        Interrupted.stop = stage
        titles.clear()
        stopped = run(checkpoint=checkpoint)
        assert titles == stages[: stages.index(stage) + 1]
        assert stopped.result.interrupted and stopped.table.measured["psnr_db"] > 5
        assert "interrupted" in stopped.result.outcome and stopped.summary()
        assert ("not trained for its shading: interrupted" in stopped.lines) == (stage == "maps")
        assert ("appearance 100%" in stopped.table.settings.get("states", {})) == (stage == "appearance")
        assert {file.name for file in tmp_path.glob(f"{stage}*")} == {f"{stage}{suffix}" for suffix in suffixes}
        Interrupted.stop = ""
        resumed = run(checkpoint=checkpoint, resume=True)
        assert not resumed.result.interrupted and resumed.table.settings == expected.table.settings
        for name, array in expected.table.arrays.items():
            assert np.array_equal(array.entries, resumed.table.arrays[name].entries), (stage, name)


def test_training_goes_on_from_a_file(start, small, unseen, manifest, tmp_path):
    """The last stage alone, from arrays that fit texture wrote: those of one run with both stages."""
    run = functools.partial(
        mi_diffind.fit, "texture", str(manifest), steps=6, batch=2048, border="repeat", variant="llvm_ad_rgb",
        progress=False,
    )  # fmt: skip
    plain = run(shading="off").save(tmp_path / "plain.npz")
    both, last = run(), run(start=str(plain))
    assert both.table.settings["before"] == last.table.settings["before"]
    for name, array in both.table.arrays.items():
        assert np.array_equal(array.entries, last.table.arrays[name].entries), name
    request = FitRequest("ours", TEXTURES["ours"], ad, options={"source": "other.json"})
    with pytest.raises(UsageError, match=r"was made from another source than other\.json"):
        texture_fit.load_start(plain, from_arrays(bumpy(seed=9)), request)
    paper = dataclasses.replace(request, preset="paper", settings=TEXTURES["paper"])
    with pytest.raises(UsageError, match="--start: found arrays of the preset ours, paper is needed"):
        texture_fit.load_start(plain, from_arrays(bumpy()), paper)


def test_the_whole_stage_is_seeded_and_never_below_its_start(ad, small, unseen, tmp_path):
    """A glossy material: the same bytes twice; what is kept gains on held-out footprints, by its own figures."""
    maps = bumpy(roughness=0.2)
    run = functools.partial(
        mi_diffind.fit, "texture", maps, steps=20, batch=2048, border="repeat", variant="llvm_ad_rgb", progress=False
    )  # fmt: skip
    first, second = (run().save(tmp_path / f"{name}.npz") for name in ("first", "second"))
    assert first.read_bytes() == second.read_bytes()
    table, plain = load_table(first), run(shading="off").table
    states, state = table.settings["states"], table.settings["state"]
    assert states["start"] == 0 and states[state] == max(states.values())
    assert ("kept_start" in table.settings) == (state == "start")
    _, pyramid = pyramid_of(maps, ad)
    effects, _ = material.material_effects(pyramid.layout)
    held_out = HeldOutFootprints(pyramid, effects, 256)
    base, errors = (
        held_out.errors(reader(CompressedTexture.from_table(t, ad.TensorXf), effects)) for t in (plain, table)
    )
    gain, _ = heldout.loss_or_gain(base, errors)
    assert gain == pytest.approx(states[state], abs=1e-3) and gain >= 0


def test_the_papers_training(ad, small, unseen, tmp_path, monkeypatch):
    """Its tables shade, which stay as they are, lights are uniform, levels are read as they are stored."""
    lights, pairs, training_numbers = [], training.mirrored_pairs, training.under_skies
    monkeypatch.setattr(training, "mirrored_pairs", lambda *a: lights.append(a[2]) or pairs(*a))
    skies = lambda types, sky, numbers: lights.append(dr.any(sky)[0]) or training_numbers(types, sky, numbers)  # noqa: E731
    monkeypatch.setattr(training, "under_skies", skies)
    arrays = DISNEY.open(ad.TensorXf, storage="uint8").arrays
    before = {name: array.numpy().copy() for name, array in arrays.items()}
    monkeypatch.setattr(texture_fit, "find_size", lambda *a: PaperBudget(8, 8, 5, 4, 6))
    fitted = mi_diffind.fit("texture", bumpy(), preset="paper", shading="on", steps=4, batch=2048, border="repeat",
                            variant="llvm_ad_rgb", progress=False)  # fmt: skip
    settings = fitted.table.settings
    assert settings["shading"]["tables"] and settings["level_bias"] == 0 and lights and not any(lights)
    assert [*settings["states"]] == ["start", "finer level", *(f"appearance {way:.0%}" for way in training.WAYS)]
    assert "primary0" in fitted.table.arrays and np.isfinite(fitted.table.measured["shaded_converged_db"])
    arrays = DISNEY.open(ad.TensorXf, storage="uint8").arrays
    assert all(np.array_equal(arrays[name].numpy(), values) for name, values in before.items())


def test_auto_is_for_materials_whose_shading_changes(ad, unseen, tmp_path):
    """Other sources are trained as without the last stage, to the byte, and a line says why."""
    maps = bumpy(16)
    smooth = np.full((16, 16, 1), 90, np.uint8)
    sources = (
        ({"image": maps["albedo"]}, "no map of normals or roughness, or a constant one"),
        ({"albedo": maps["albedo"], "roughness": smooth}, "no map of normals or roughness, or a constant one"),
        ({"normal": maps["normal"]}, "one map alone is no material"),
        ({**maps, "diffuse": maps["albedo"]}, 'map "diffuse": found a second albedo'),
        ({"albedo": smooth}, "no map of normals or roughness, or a constant one"),
    )
    given = {"steps": 2, "batch": 1024, "border": "repeat", "variant": "llvm_ad_rgb", "progress": False}
    for source, reason in sources:
        auto, off = (mi_diffind.fit("texture", source, shading=shading, **given) for shading in ("auto", "off"))
        auto.save(tmp_path / "auto.npz"), off.save(tmp_path / "off.npz")
        assert (tmp_path / "auto.npz").read_bytes() == (tmp_path / "off.npz").read_bytes()
        (line,) = [line for line in auto.lines if line not in off.lines]
        assert line.startswith(f"not trained for its shading: {reason}")
        with pytest.raises(UsageError, match=f"--lambda: found 0.5, but nothing is trained for its shading: {reason}"):
            mi_diffind.fit("texture", source, share=0.5, **given)
    layout, options = pyramid_of(maps, ad)[1].layout, {"shading": "auto", "psnr": None}
    for preset, reason in (("ours", ""), ("paper", "the preset paper does so with --shading on")):
        request = FitRequest(preset, TEXTURES[preset], ad, options=options)
        assert texture_fit.reason_without_shading(layout, request) == reason


@pytest.mark.parametrize(
    "changed, message",
    [
        (["--lambda", "1.5"], "argument --lambda: found '1.5', allowed are numbers from 0 to 1"),
        (["--shading", "maybe"], "argument --shading: invalid choice"),
        (["--start", "x.npz", "--compression", "3x"], "--start: the arrays have their size, leave out --compression"),
        (["--start", "x.npz", "--skip", "3", "--structure", "auto"], "their size, leave out --structure, --skip"),
        (["--start", "x.npz", "--shading", "off"], "--start: found x.npz, but nothing is trained for its shading"),
        (["--lambda", "0.5", "--shading", "off"], "--lambda: found 0.5, but nothing is trained for its shading"),
        (["--preview", "x.png", "--shading", "off"], "--preview: found x.png, but nothing is trained for its shading"),
        (["--level-bias", "0.5"], "argument --level-bias: found '0.5', allowed are numbers from -4 to 0"),
        (["--spp", "4"], "unrecognized arguments: --spp 4"),
    ],
)
def test_bad_arguments_are_one_sentence(manifest, tmp_path, capsys, changed, message):
    assert message in refused(capsys, "fit", "texture", manifest, "-o", tmp_path / "x.npz", *changed)


@pytest.mark.parametrize("words", [["shading"], ["shading", "m.json", "-o", "m.npz", "--compression", "12x", "--help"]])
def test_the_former_task_says_what_to_use(words, capsys):
    sentence = 'task "shading" is no more: materials are trained for their shading by fit texture, see its --shading'
    assert refused(capsys, "fit", *words).endswith(sentence)
    with pytest.raises(UsageError, match=sentence):
        mi_diffind.fit("shading", "m.json")


def test_sources_that_cannot_be_shaded_are_refused(ad):
    small, zeros = bumpy(8), np.zeros((4, 4, 2), np.uint8)
    for maps, message in (
        ({"height": small["roughness"]}, "found no map that shading reads, these are albedo, normal"),
        ({"albedo": zeros}, 'map "albedo": found 2 channels, allowed for albedo are 1 or 3'),
        ({"albedo": small["albedo"], "diffuse": small["albedo"]}, 'map "diffuse": found a second albedo'),
    ):
        with pytest.raises(UsageError, match=message):
            material.material_effects(pyramid_of(maps, ad)[1].layout)
    for source, message in (
        ({"height": small["roughness"]}, "found no map that shading reads"),
        ({"albedo": zeros[..., :1]}, "all of its maps are constant, there is nothing to learn"),
        (None, "source: not given, an image"),
        ("scene.xml", r"found the scene scene\.xml; fit scene trains"),
    ):
        with pytest.raises(UsageError, match=message):
            mi_diffind.fit("texture", source=source, shading="on", variant="llvm_ad_rgb", progress=False)
