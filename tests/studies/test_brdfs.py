"""BRDFs that learned BSDFs are compared with: what they evaluate, and what their training recovers."""

import dataclasses
import json

import numpy as np
import pytest
from arrays import aligned, numpy_of
from bsdf_queries import random_directions

from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import fit
from mi_diffind.studies import bsdf
from mi_diffind.studies.baselines import brdfs
from mi_diffind.tasks.bsdf import training
from mi_diffind.tasks.bsdf.shifted_gamma import NUMBERS
from mi_diffind.tasks.bsdf.truth import truth_of


@pytest.mark.parametrize("is_cooperative", [False, True])
def test_network_is_that_of_the_source(mi, rng, tmp_path, is_cooperative):
    """With the weights of a file, a network has the values of that source."""
    types = array_module()
    net = brdfs.BRDFNetwork().alloc(types.TensorXf, 6)
    for key in net:
        net[key] = types.TensorXf(rng.normal(0, 0.5, net[key].shape).astype(np.float32))
    layers = [net[key].numpy() for key in net]  # weights (outputs, inputs) and biases in turn
    assert [layer.ndim for layer in layers] == [2, 1] * 3
    np.savez(tmp_path / "net.npz", net=np.concatenate([layer.T.ravel() for layer in layers]))
    directions = [types.Array3f(aligned(random_directions(rng, 500, 0.02).T)) for _ in range(2)]
    expected = numpy_of(truth_of(tmp_path / "net.npz", types).value(*directions))
    peer = (net.cooperative() if is_cooperative else net).at()
    assert (expected > 0).mean() > 0.2
    np.testing.assert_allclose(numpy_of(peer.cosine_value(*directions)), expected, rtol=1e-3, atol=1e-5)


def test_shifted_gamma_is_recovered(mi, tmp_path, monkeypatch):
    """A fit is found again from samples of it, by a short training."""
    numbers = [(0.1, 0.2, 0.3), (0.5, 0.3, 0.4), 0.1, 0.05, 20, 0.03, 0.5, 2, 0.02, 8, 0.2]
    content = {name: np.broadcast_to(x, 3).tolist() for name, x in zip(NUMBERS, numbers, strict=True)}
    (tmp_path / "fits.json").write_text(json.dumps({"paint": content}), encoding="utf-8")
    monkeypatch.setattr(training, "SAMPLES", 2**16)
    data = bsdf.DataSource(f"{tmp_path / 'fits.json'}#paint")
    problem = brdfs.gamma_problem(brdfs.gamma_start(data.samples[0], data.accuracy), data.samples[0], data.accuracy)
    fit(problem, dataclasses.replace(bsdf.GAMMA, steps=300, measure_every=100), progress=False)
    errors = data.errors(problem.net.at())
    print(errors)
    assert errors["relative_error"] < 0.01 and errors["psnr_db"] > 60 and errors["irreciprocal_share"] < 1e-6
