"""Networks in place of the factors of the Disney BRDF."""

import json

import numpy as np
import pytest

from mi_diffind.commands.cli import main
from mi_diffind.core.runtime import array_module
from mi_diffind.studies.disney import networks

#: Steps of a training.
STEPS = 6


def draw(types, count=64):
    """Return random materials, directions and albedos."""
    import drjit as dr

    from mi_diffind.tasks.disney.training import random_directions, random_materials

    rng = dr.rng(seed=5)
    m, (wi, wo) = random_materials(rng, types, count), random_directions(rng, types, count)
    return m, types.Array3f([rng.random(types.Float, count) for _ in range(3)]), wi, wo


@pytest.mark.parametrize("nbytes", [832, 13440])
def test_a_network_takes_no_more_than_its_bytes(mi_rgb, nbytes):
    """Two bytes a parameter of the allocated network are at most the bytes asked for; one more unit is too large."""
    types = array_module(mi_rgb.variant())
    net = networks.network(nbytes)
    assert 2 * net.alloc(types.TensorXf).parameters <= nbytes
    wider = networks.Network(net.inputs, net.width + 1, net.layers, outputs=net.outputs)
    assert 2 * wider.alloc(types.TensorXf).parameters > nbytes


def test_too_few_bytes_are_refused():
    with pytest.raises(ValueError, match="20 bytes are too few"):
        networks.network(20)


def test_exact_factors_give_the_published_formulas(mi_rgb):
    """A function that returns exact factors in place of a network gives BRDF · cosine of the model."""
    import drjit as dr

    from mi_diffind.tasks.disney.model import exact_factors
    from mi_diffind.tasks.disney.training import shade

    m, albedo, wi, wo = draw(array_module(mi_rgb.variant()))
    f = exact_factors(m, wi, wo)

    def exact(x):
        return [dr.log(f.specular), f.diffuse / wo.z, f.flat / wo.z, dr.log(f.clearcoat / wo.z)]

    decoded, truth = (np.array(shade(d, m, albedo, wi, wo)) for d in (networks.NetworkDecoder(exact), None))
    np.testing.assert_allclose(decoded, truth, rtol=1e-4, atol=1e-6)


def test_coordinates_hold_the_specular_lobe(mi_rgb):
    """The specular factor is a product of powers of the inputs: D · G · cos θ_o / (4 cos θ_i cos θ_o)."""
    from mi_diffind.tasks.disney.model import exact_factors

    m, _, wi, wo = draw(array_module(mi_rgb.variant()))
    x = [np.array(v) for v in networks.coordinates(m, wi, wo)]
    assert len(x) == networks.INPUTS
    stretched, roughness, _ = (v / networks.LOGARITHM_SCALE for v in x[5:8])
    expected = np.exp(-2 * stretched - roughness - x[8] - x[9]) / np.pi * np.array(wo.z)
    np.testing.assert_allclose(expected, np.array(exact_factors(m, wi, wo).specular), rtol=2e-3)


def test_errors_of_training():
    """Truth above 1 counts as 1, and values above 1 have errors, and gradients, that grow with their logarithms."""
    import drjit as dr

    Float = array_module("llvm_ad_rgb").Float
    value, truth = Float(0.5, 3, 0.5, 2, 1000), Float(0.25, 7, 7, 0.5, 1)
    dr.enable_grad(value)
    (error,) = networks.squared_errors([value], [truth])
    expected = np.array([0.25, 0, -0.5, 0.5 + np.log(2), 0]) ** 2
    np.testing.assert_allclose(error.numpy(), expected, atol=1e-6)
    dr.backward(error)
    gradient = dr.grad(value).numpy()
    assert (gradient[[1, 4]] == 0).all() and gradient[2] == pytest.approx(-1)
    assert gradient[3] == pytest.approx((0.5 + np.log(2)), rel=1e-5)


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(networks, "QUICK_STEPS", STEPS)


def test_a_trained_network(mi_rgb, short, tmp_path):
    """Parameters are half-precision numbers, measured as such; a file brings them back; NumPy evaluates the same."""
    import drjit as dr

    from mi_diffind.tasks.disney.training import measure

    types = array_module(mi_rgb.variant())
    training = networks.DisneyNetworkTraining("network", 832, quick=True)
    record = training.run(tmp_path, False)
    assert record["bytes"] == 2 * training.net.parameters <= 832 and record["details"]["steps"] <= 2 * STEPS
    values = {key: training.net[key].numpy() for key in training.net}
    for value in values.values():
        np.testing.assert_array_equal(value, value.astype(np.float16).astype(np.float32))
    again = networks.DisneyNetworkTraining("network", 832, quick=True)
    assert again.cached_record(tmp_path) == record
    for key, value in values.items():
        np.testing.assert_array_equal(again.net[key].numpy(), value)
    assert networks.DisneyNetworkTraining("network", 700, quick=True).cached_record(tmp_path) is None

    x = np.random.default_rng(3).normal(size=(networks.INPUTS, 9)).astype(np.float32)
    expected = x
    weights = [(values[f"mlp.layers.{2 * i}.weights"], values[f"mlp.layers.{2 * i}.bias"]) for i in range(3)]
    for i, (weight, bias) in enumerate(weights):
        expected = weight.astype(np.float64) @ expected + bias.reshape(-1, 1)
        expected = expected if i == 2 else np.where(expected > 0, expected, 0.01 * expected)
    for net in (training.net, training.cooperative().network):
        with dr.suspend_grad():
            actual = np.array([v.numpy() for v in net([types.Float(row) for row in x])])
        np.testing.assert_allclose(actual, expected, rtol=1e-3, atol=1e-4)
    assert measure(training.decoder, types, 2**12)["psnr_db"] > 5


def test_only_networks(short, tmp_path):
    """``--only network`` measures networks alone, without renders."""
    out = tmp_path / "out"
    found = tmp_path / "report.json"
    command = ["tradeoff", "disney", "--quick", "--only", "network", "--out", str(out), "--json", str(found)]
    assert main(command) == 0
    result = json.loads(found.read_text(encoding="utf-8"))
    (name,) = result["candidates"]
    assert set(result["cases"]) == {"constant, all lobes"} and not result["cases"]["constant, all lobes"]["passes"]
    assert set(result["cases"]["constant, all lobes"]["queries"]) == {"eval"}
    assert result["candidates"][name]["errors"]["psnr_db_training"] > 5
    with pytest.raises(SystemExit):
        main(["tradeoff", "disney", "--only", "nothing"])
