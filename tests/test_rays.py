"""Rays and boxes against the definition: which of many points of a ray lie in the box."""

import drjit as dr
import numpy as np

from mi_diffind.arrays.boxes import box_interval, is_direction
from mi_diffind.core.runtime import array_module


def test_box_interval(rng):
    ad = array_module("llvm")
    lower, upper = np.array([-1.0, 0.0, 2.0]), np.array([1.0, 0.5, 4.0])
    o = rng.uniform(-3, 5, (4000, 3))
    d = rng.normal(size=o.shape)
    d[:1000, rng.integers(3)] = 0  # parallel to two faces …
    o[:300, 0] = lower[0]  # … or within one
    d[:300, 0] = 0
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = o.astype(np.float32), d.astype(np.float32)
    rays, corners, count = (ad.Array3f(o.T), ad.Array3f(d.T)), (lower.tolist(), upper.tolist()), len(o)
    start = dr.zeros(ad.Float, count), dr.full(ad.Float, 6, count), dr.full(ad.Bool, True, count)
    near, far, active = box_interval(*rays, *corners, *start)
    near, far, active = near.numpy(), far.numpy(), active.numpy()
    t = np.linspace(0, 6, 6001)
    found = 0
    for k in range(len(o)):
        p = o[k] + t[:, None] * d[k]
        inside = ((p >= lower - 1e-6) & (p <= upper + 1e-6)).all(axis=1)
        if active[k] and far[k] - near[k] > 3e-3:
            found += 1
            assert abs(t[inside][0] - near[k]) < 2e-3 and abs(t[inside][-1] - far[k]) < 2e-3
        elif not (active[k] and abs(far[k] - near[k]) <= 3e-3):
            assert inside.sum() <= 3
    assert found > 100


def test_nan_is_in_no_box():
    ad = array_module("llvm")
    p = ad.Array3f(dr.nan, 0.5, 0.5)
    for o, d in ((p, ad.Array3f(1, 0, 0)), (ad.Array3f(0.5), ad.Array3f(dr.nan, 0, 0))):
        near, far, active = box_interval(o, d, (0, 0, 0), (1, 1, 1), ad.Float(0), ad.Float(dr.inf), ad.Bool(True))
        assert not (active & (near <= far) & dr.isfinite(near) & dr.isfinite(far))[0]


def test_only_vectors_of_about_unit_length_are_directions():
    ad = array_module("llvm")
    lengths = [0, 1e-45, 1e-30, 0.4, 0.6, 1, 1.9, 2.1, 1e19, 1e30, np.inf, np.nan]
    d = ad.Array3f(np.float32([lengths, [0] * 12, [0] * 12]))
    assert is_direction(d).numpy().tolist() == [False] * 4 + [True] * 3 + [False] * 5


def test_denormal_components_count_as_zero():
    """Also along a side of the box, where the product with the reciprocal would be NaN."""
    ad = array_module("llvm")
    for tiny in (1e-45, -1e-45, 1e-31):
        near, far, active = box_interval(
            ad.Array3f(0, 0.5, -1),
            ad.Array3f(tiny, 0, 1),
            (0, 0, 0),
            (1, 1, 1),
            ad.Float(0),
            ad.Float(9),
            ad.Bool(True),
        )
        assert active[0] and near[0] == 1 and far[0] == 2
