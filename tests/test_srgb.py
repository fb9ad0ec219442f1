"""The sRGB transfer function against its definition (IEC 61966-2-1), for numbers, NumPy arrays and Dr.Jit arrays."""

import drjit as dr
import numpy as np
import pytest

from mi_diffind.core.runtime import array_module
from mi_diffind.images import srgb


def test_numpy():
    grey = np.full((4, 4, 3), 0.2140, np.float32)
    assert np.allclose(srgb.for_display(grey), 0.5, atol=1e-3)
    ramp = np.linspace(0, 1, 1000, dtype=np.float32)
    decoded = srgb.to_linear(ramp)
    assert np.allclose(srgb.to_linear(srgb.for_display(ramp)), ramp, atol=1e-6) and decoded.dtype == np.float32
    outside = srgb.to_linear(np.array([-1.0, 0.5, 2.0]))
    assert np.allclose(outside, [-1 / 12.92, 0.21404, 4.9538], rtol=1e-4)
    assert np.allclose(srgb.from_linear(outside), [-1.0, 0.5, 2.0]) and srgb.to_linear(0.5) == outside[1]
    assert srgb.for_display(np.array([np.nan, -1, 7.0])).tolist() == [0, 0, pytest.approx(1)]


def test_drjit_equals_numpy_and_dr_itself():
    Float = array_module("llvm").Float
    x = np.concatenate([np.linspace(-0.5, 2, 5000), [0.0031308, 0.04045]]).astype(np.float32)
    inside = (x >= 0) & (x <= 1)
    for ours, theirs in ((srgb.from_linear, dr.linear_to_srgb), (srgb.to_linear, dr.srgb_to_linear)):
        values = ours(Float(x)).numpy()
        assert np.allclose(values, ours(x), rtol=1e-5, atol=1e-6)
        assert np.allclose(values[inside], theirs(Float(x)).numpy()[inside], rtol=1e-5, atol=1e-6)
    bounded = srgb.to_linear_bounded(Float(x)).numpy()[inside]
    assert np.allclose(bounded, srgb.to_linear(x)[inside], rtol=6e-5, atol=4e-6)
