"""Fast logarithm and exponential, against NumPy in double precision."""

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float

from mi_diffind.arrays import fast_math


def test_logarithm():
    """The error is 2e-7 of the logarithm, or of 1 where that is smaller; that of 1 is exact."""
    x = np.exp(np.random.default_rng(0).uniform(-80, 80, 100_000)).astype(np.float32)
    x = np.concatenate([x, np.linspace(0.7, 1.42, 10_001, dtype=np.float32), np.float32([1, 2, 1e-37, 3e38])])
    exact = np.log2(x.astype(np.float64))
    error = np.abs(fast_math.log2(Float(x)).numpy() - exact)
    assert (error <= 2e-7 * np.maximum(1, np.abs(exact))).all()
    assert fast_math.log2(Float(1))[0] == 0


def test_exponential():
    """The relative error is 3e-7; what is below the smallest normal number becomes that."""
    x = np.concatenate([np.random.default_rng(1).uniform(-125.9, 126.9, 100_000), np.arange(-125, 127), [0.5, -0.5]])
    x = x.astype(np.float32)
    assert np.abs(fast_math.exp2(Float(x)).numpy() / 2.0 ** x.astype(np.float64) - 1).max() < 3e-7
    assert 0 < fast_math.exp2(Float(-1e30))[0] < 1.2e-38


@pytest.mark.parametrize(
    ("function", "derivative"), [("log2", lambda x: 1 / (x * np.log(2))), ("exp2", lambda x: 2**x * np.log(2))]
)
def test_gradients_are_those_of_drjit(function, derivative):
    """Arguments whose gradient is tracked have the right derivative."""
    x = Float(0.3, 1.7)
    dr.enable_grad(x)
    dr.backward(getattr(fast_math, function)(x))
    assert np.allclose(dr.grad(x).numpy(), derivative(np.array([0.3, 1.7])), rtol=1e-5)
