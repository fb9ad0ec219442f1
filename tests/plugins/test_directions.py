"""Directions that are none, as masked lanes hold: no material reflects from or to them, and no gradient sees them."""

import drjit as dr
import numpy as np
import plugin_examples as examples
import pytest
from arrays import aligned

#: Vectors that are no directions: short ones, zero, NaN, infinite.
NONE = np.array([
    (0, 0, 1e-30), (1e-30, 2e-30, 1e-30), (0, 0, 0), (0, 0, 1e-45), (1e-45, 0, 1e-45), (1e-20, 0, 1e-20), (0, 0, 1e-8),
    (1e-8, 0, 1e-12), (1e-4, 1e-4, 1e-4), (0, 0, -1e-30), (np.nan, 0, 0.5), (0.1, np.nan, np.nan), (np.inf, 0, 1),
    (0, 0, 1e30),
])  # fmt: skip

DIRECTIONS = np.array([(0.3, 0.2, 0.9), (-0.5, 0.1, 0.8), (0, 0, 1), (0.9, -0.3, 1e-3)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)

CASES = [
    ("disney", {}),
    ("disney", {"roughness": 0.0, "clearcoat_gloss": 1.0, "metallic": 1.0}),
    ("neural_disney", {"storage": "float32"}),
    ("neural_ggx", {"storage": "float32"}),
    ("neural_material", {"storage": "float32", "two_sided": True}),
    ("neural_bsdf", {"storage": "float32", "two_sided": True}),
]


#: Pairs of which ``wi`` is none, of which ``wo`` is none, and of two directions.
FROM = np.array([(a, b) for a in NONE for b in (*DIRECTIONS, *NONE)])
TO = np.array([(b, a) for a in NONE for b in DIRECTIONS])
RIGHT = np.array([(a, b) for a in DIRECTIONS for b in DIRECTIONS])


def answers(mi, bsdf, pairs) -> dict[str, list]:
    """Values of all methods for pairs of vectors, by method."""

    def vector(values):
        return mi.Vector3f(*(mi.Float(aligned(component)) for component in values.T))

    si = dr.zeros(mi.SurfaceInteraction3f, len(pairs))
    si.wi, si.uv, si.t = vector(pairs[:, 0]), mi.Point2f(0.3, 0.4), mi.Float(1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv, si.n = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Normal3f(0, 0, 1)
    context, wo = mi.BSDFContext(), vector(pairs[:, 1])
    value, density = bsdf.eval_pdf(context, si, wo)
    sample, weight = bsdf.sample(context, si, mi.Float(0.3), mi.Point2f(0.4, 0.6))
    return {"value": list(value), "density": [density], "sample": [sample.pdf, *sample.wo], "weight": list(weight)}


def derivatives(params, keys, mi, bsdf, pairs, unseen) -> dict[str, np.ndarray]:
    """Derivatives of the sum of all values, and of the weights of the first ``unseen`` pairs, by parameter."""
    found = answers(mi, bsdf, pairs)
    first = dr.arange(mi.UInt32, len(pairs)) < unseen
    total = sum(dr.sum(v) for v in found["value"]) + sum(dr.sum(dr.select(first, w, 0)) for w in found["weight"])
    dr.backward(total)
    result = {key: np.array(dr.grad(params[key])) for key in keys}
    for key in keys:
        dr.clear_grad(params[key])
    return result


@pytest.mark.parametrize(("name", "more"), CASES)
def test_vectors_that_are_no_directions(mi_rgb, name, more):
    """Values are 0, and the derivatives are those of the pairs of directions alone."""
    mi = mi_rgb
    bsdf = mi.load_dict(examples.example(name, **more))
    pairs = np.concatenate([FROM, TO, RIGHT])
    wrong = len(FROM) + len(TO)
    found = answers(mi, bsdf, pairs)
    dr.eval(found)
    for method, values in found.items():
        for value in values:
            value = np.broadcast_to(value.numpy(), len(pairs))
            assert np.isfinite(value).all(), f"{method}: {pairs[~np.isfinite(value)][0]}"
            zero = {"value": wrong, "density": wrong, "weight": len(FROM)}.get(method, 0)
            assert (value[:zero] == 0).all(), f"{method}: {pairs[:zero][value[:zero] != 0][0]}"
    assert max(value.numpy()[wrong:].max() for value in found["value"]) > 0
    params = mi.traverse(bsdf)
    keys = [k for k in params.keys() if isinstance(params[k], dr.ArrayBase) and not k.endswith("_rate")]
    for key in keys:
        dr.enable_grad(params[key])
        params.set_dirty(key)
    params.update()
    expected = derivatives(params, keys, mi, bsdf, RIGHT, 0)
    seen = derivatives(params, keys, mi, bsdf, pairs, len(FROM))
    for key in keys:
        assert np.isfinite(seen[key]).all(), key
        scale = np.abs(expected[key]).max() + 1e-6
        np.testing.assert_allclose(seen[key] / scale, expected[key] / scale, atol=1e-4, err_msg=key)
    assert any(np.abs(value).max() > 0 for value in expected.values())
