"""Filtered maps as a hash grid and a network."""

import dataclasses

import numpy as np
import pytest

from mi_diffind.commands.cli import main
from mi_diffind.core.runtime import array_module
from mi_diffind.studies.texture import METHODS, networks


def ramps(side=64):
    """Return a source of two maps, of which one varies along x and y; both repeat without a seam."""
    from mi_diffind.maps.source import from_arrays

    y, x = np.mgrid[:side, :side] * 2 * np.pi / side
    albedo = 0.5 + 0.4 * np.stack([np.sin(x), np.cos(y), 0.5 * np.sin(x + y)], axis=-1)
    maps = {"albedo": albedo, "roughness": (0.5 + 0.3 * np.cos(x))[..., None]}
    return from_arrays({name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()})


def problem_of(nbytes, mi):
    from mi_diffind.maps.pyramid import Pyramid

    source, types = ramps(), array_module(mi.variant())
    pyramid = Pyramid.of(source, types=types, border=("repeat", "repeat"))
    net = networks.network(source, pyramid.layout, nbytes)
    return networks.TextureNetworkProblem(net, pyramid, source.digest)


@pytest.mark.parametrize("nbytes", [6000, 12000])
def test_a_network_takes_no_more_than_its_bytes(mi_rgb, nbytes):
    net = problem_of(nbytes, mi_rgb).net
    assert 0.9 * nbytes < 2 * net.parameters <= nbytes


def test_a_network_learns_all_levels(mi_rgb):
    """After a short training, levels are those of the pyramid, in their sizes."""
    from mi_diffind.fitting.loop import fit
    from mi_diffind.fitting.settings import FitSettings
    from mi_diffind.studies.texture import levels

    problem = problem_of(12000, mi_rgb)
    before = problem.measure(problem.net)["psnr_db"]
    result = fit(problem, FitSettings(steps=150, batch=2048, lr=1e-2, loss="mse", measure_every=50), progress=False)
    assert result.measured["psnr_db"] > before + 10
    pyramid, maps = problem.pyramid, problem.maps(problem.net)
    decoded = levels.decoded(maps, pyramid.layout.names, pyramid.levels)
    errors = levels.errors(levels.images(pyramid), decoded)["all"]
    assert min(errors[:3]) > 28 and min(errors) > 10  # coarse levels have few samples
    assert [values.shape[:2] for values in decoded["albedo"]] == [values.shape[:2] for values in pyramid.values]


def numpy_read(net, u, v, level, types):
    """Return the outputs at places, ``(channels, n)``: features of Dr.Jit's grid, then fading and layers in NumPy."""
    net.encoding.data = net.entries.array
    features = np.array([f.numpy() for f in net.encoding([types.Float(u), types.Float(v)])], np.float64)
    count = net.grid["n_features_per_level"]
    for i in range(net.grid["n_levels"]):
        side = net.grid["base_resolution"] * net.grid["per_level_scale"] ** i
        visible = np.clip(1 + np.log2(net.size / 2**level / side), 0, 1)
        features[i * count : (i + 1) * count] *= visible
    x = np.concatenate([features, level[None] / (net.levels - 1)])
    layers = [key.removesuffix(".weights") for key in net if key.endswith(".weights")]
    for layer in layers:
        x = net[f"{layer}.weights"].numpy().astype(np.float64) @ x + net[f"{layer}.bias"].numpy().reshape(-1, 1)
        x = x if layer == layers[-1] else np.where(x > 0, x, 0.01 * x)
    return x


def test_the_plugin_reads_the_network(mi_rgb):
    """Reads of maps and of the plugin ``mipmap`` are those of NumPy; the texture repeats; level 0 is the finest."""
    import drjit as dr

    import mi_diffind  # noqa: F401  (registers the plugins)
    from mi_diffind.plugins.support.image_files import PYRAMIDS
    from mi_diffind.studies.baselines.hash_grids import halved

    types, problem = array_module(mi_rgb.variant()), problem_of(12000, mi_rgb)
    net = problem.net
    random = np.random.default_rng(4)
    net["entries"] = types.TensorXf(random.normal(size=net.entries.shape).astype(np.float32))
    halved(net)
    u, v = random.random((2, 7), dtype=np.float32)
    level = np.array([0, 0.4, 1, 2.7, 4, 5.5, 6], np.float32)
    expected = numpy_read(net, u, v, level, types)
    assert np.ptp(expected) > 0.05
    for cooperative in (False, True):
        maps = networks.NetworkMaps(net, problem.pyramid.layout, types, ("repeat", "repeat"), cooperative)
        for shift in (0, 1):
            with dr.suspend_grad():
                actual = maps.filtered(types.Float(u) + shift, types.Float(v) - shift, types.Float(level))
            np.testing.assert_allclose([a.numpy() for a in actual], expected, rtol=2e-3, atol=2e-3)
    PYRAMIDS["test network"] = maps
    try:
        texture = mi_rgb.load_dict(
            {"type": "mipmap", "pyramid": "test network", "channels": "albedo", "filter": "off", "raw": True}
        )
        si = dr.zeros(mi_rgb.SurfaceInteraction3f, len(u))
        si.uv = mi_rgb.Point2f(u, v)
        actual = np.array(texture.eval_3(si))
    finally:
        del PYRAMIDS["test network"]
    finest = numpy_read(net, u, v, 0 * level, types)
    decoded = np.array(maps.layout.decode("albedo", list(finest)))
    np.testing.assert_allclose(np.clip(actual, 0, 1), np.clip(decoded, 0, 1), rtol=2e-3, atol=2e-3)


def test_the_study_compares_with_a_network(mi_rgb):
    """The plan has a network in the bytes of a ratio, alone with ``only``; of tiny images it has none."""
    from mi_diffind.studies.texture import plan as plans

    settings = plans.TextureStudySettings(
        "albedo", (2.0,), film=(24, 16), zoom_film=(24, 16), frames=2, network_steps=2, only=("network",)
    )
    plan = plans.plan(ramps(), "ramps", settings)
    assert [c.name for c in plan.candidates] == ["network 2x, trilinear"]
    truths, (job,) = plan.jobs[:-1], plan.jobs[-1:]
    assert all(isinstance(truth, plans.TextureTruth) for truth in truths) and job.name == "network 2x"
    record = job.run(None, False)
    assert record["bytes"] == 2 * job.training.net.parameters <= ramps().nbytes / 2
    assert len(record["details"]["levels"]["all"]) == 7 and record["details"]["steps"] <= 2 * networks.LONGEST
    for key in job.training.net:
        value = job.training.net[key].numpy()
        np.testing.assert_array_equal(value, value.astype(np.float16).astype(np.float32))
    everything = plans.plan(ramps(), "ramps", dataclasses.replace(settings, only=()))
    assert {c.representation for c in everything.candidates} <= set(METHODS)
    assert not plans.plan(ramps(16), "ramps", settings).candidates


def test_unknown_methods_are_refused():
    with pytest.raises(SystemExit):
        main(["tradeoff", "texture", "--only", "nothing"])
