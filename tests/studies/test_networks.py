"""Networks that tables are compared with: against NumPy, in their bytes, and what they learn."""

import drjit as dr
import numpy as np
import pytest

from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import FitSettings, fit
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.measure.training import halve
from mi_diffind.studies import materials
from mi_diffind.studies.baselines import distance_fields as rivals
from mi_diffind.studies.baselines import networks
from mi_diffind.studies.baselines.networks import Network


@pytest.mark.parametrize(("width", "layers"), [(8, 1), (16, 2)])
def test_network_is_what_numpy_computes(ad, rng, width, layers):
    net = Network(2, width, layers).alloc(ad.TensorXf, 2, dr.rng(seed=2))
    values = rng.random((2, 500)).astype(np.float32)
    x = [ad.Float(v) for v in values]
    weights = [net[k].numpy() for k in net if k.endswith("weights")]
    biases = [net[k].numpy() for k in net if k.endswith("bias")]
    y = values
    for k, (w, b) in enumerate(zip(weights, biases, strict=True)):
        y = w @ y + b[:, None]
        y = np.where(y < 0, 0.01 * y, y) if k < layers else y
    assert len(weights) == layers + 1 and y.shape[0] == 1
    assert net.parameters == sum(v.size for v in (*weights, *biases)) and net.nbytes == 4 * net.parameters
    for form in (net, net.cooperative()):
        (found,) = form(x)
        assert np.allclose(found.numpy(), y[0], atol=1e-5)


def test_operations_of_products(ad):
    net = Network(2, 16, 2).alloc(ad.TensorXf, 2)
    n = net.products()
    assert n.add == n.mul == 2 * 16 + 16 * 16 + 16 and n.bytes_gathered == 4 * net.parameters


@pytest.fixture
def source():
    """Two maps of which one varies along x and y; both repeat without a seam."""
    y, x = (2 * np.pi * i / 64 for i in np.mgrid[:64, :64])
    albedo = 0.5 + 0.4 * np.stack([np.sin(x), np.cos(y), 0.5 * np.sin(x + y)], axis=-1)
    maps = {"albedo": albedo, "roughness": (0.5 + 0.3 * np.cos(x))[..., None]}
    return from_arrays({name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()})


def texture_problem(source, mi, nbytes=12000, levels=0):
    pyramid = Pyramid.from_source(source, types=array_module(mi.variant()), border=("repeat", "repeat"))
    net = networks.texture_network(pyramid.layout, nbytes, levels or pyramid.levels)
    return networks.TextureNetworkProblem(net, pyramid, source.digest)


@pytest.mark.parametrize("levels", [0, 1])
def test_a_network_learns_all_levels(mi_rgb, source, levels):
    """After a short training, maps are those of the pyramid, of all its levels or of the finest alone."""
    problem = texture_problem(source, mi_rgb, levels=levels)
    before = problem.measure(problem.net)["psnr_db"]
    result = fit(problem, FitSettings(steps=150, batch=2048, lr=1e-2, loss="mse", measure_every=50), progress=False)
    assert result.measured["psnr_db"] > before + 10
    decoded = materials.level_images(networks.NetworkMaps(problem.net, problem.pyramid))
    truth = {name: values[: levels or None] for name, values in materials.level_images(problem.pyramid).items()}
    errors = materials.level_errors(truth, decoded)
    assert min(errors[:3]) > 28 and min(errors) > 10  # coarse levels have few samples
    assert len(errors) == (levels or problem.pyramid.levels)


def test_reads_of_a_network(mi_rgb, source):
    """Reads repeat, and are those of NumPy: features of Dr.Jit's grid, fading, layers."""
    types, problem = array_module(mi_rgb.variant()), texture_problem(source, mi_rgb)
    net, random = problem.net, np.random.default_rng(4)
    net["entries"] = types.TensorXf(random.normal(size=net.entries.shape).astype(np.float32))
    halve(net)
    u, v = random.random((2, 7), dtype=np.float32)
    level = np.array([0, 0.4, 1, 2.7, 4, 5.5, 6], np.float32)
    net.encoding.data = net.entries.array
    features = np.array([f.numpy() for f in net.encoding([types.Float(u), types.Float(v)])], np.float64)
    for i in range(net.grid["n_levels"]):
        side = net.grid["base_resolution"] * net.grid["per_level_scale"] ** i
        features[2 * i : 2 * i + 2] *= np.clip(1 + np.log2(net.size / 2**level / side), 0, 1)
    x = np.concatenate([features, level[None] / (net.levels - 1)])
    layers = [key.removesuffix(".weights") for key in net if key.endswith(".weights")]
    for layer in layers:
        x = net[f"{layer}.weights"].numpy().astype(np.float64) @ x + net[f"{layer}.bias"].numpy().reshape(-1, 1)
        x = x if layer == layers[-1] else np.where(x > 0, x, 0.01 * x)
    assert np.ptp(x) > 0.05
    maps = networks.NetworkMaps(net, problem.pyramid)
    for shift in (0, 1):
        with dr.suspend_grad():
            actual = maps.filtered(types.Float(u) + shift, types.Float(v) - shift, types.Float(level))
        np.testing.assert_allclose([a.numpy() for a in actual], x, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("nbytes", [6000, 12000])
def test_networks_take_no_more_than_their_bytes(mi_rgb, source, nbytes):
    """Two bytes a parameter, counted on the allocated network, are at most the bytes asked for, and most of them."""
    types = array_module(mi_rgb.variant())
    for net in (texture_problem(source, mi_rgb, nbytes).net, rivals.network(nbytes).alloc(types.TensorXf)):
        assert 0.8 * nbytes < 2 * net.parameters <= nbytes


def test_too_few_bytes_are_refused(mi_rgb, source):
    with pytest.raises(ValueError, match="200 bytes are too few"):
        texture_problem(source, mi_rgb, 200)
