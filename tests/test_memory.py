"""Copies of arrays into memory of Dr.Jit, and assignments in place."""

import drjit as dr
import numpy as np
import pytest

from mi_diffind.core import compat


@pytest.mark.parametrize("name", ["Float", "UInt32"])
def test_copies_are_not_numpys_memory(mi_rgb, name):
    dtype = getattr(mi_rgb, name)
    values = np.array([0, -0.0, 1, 7] if name == "Float" else [0, 1, 2**32 - 1], "f4" if name == "Float" else "u4")
    array, kept = dtype(values), values.copy()
    copy = compat.owned(array)
    dr.sync_thread()  # copies are made in the background
    assert copy.index != array.index
    if mi_rgb.variant().startswith("llvm"):
        values[:] = 3
        np.testing.assert_array_equal(array.numpy(), 3)  # what the copy is for
    np.testing.assert_array_equal(copy.numpy().view("u4"), kept.view("u4"))


def test_numbers_that_are_none_stay(mi_rgb):
    copy = compat.owned(mi_rgb.Float(np.array([np.nan, np.inf, -np.inf, 1e-37], np.float32)))
    np.testing.assert_array_equal(copy.numpy(), np.float32([np.nan, np.inf, -np.inf, 1e-37]))


def test_derivatives_pass_through(mi_rgb):
    """A copy is the same node: also gradients of an array that is no leaf stay where they were."""
    array = mi_rgb.Float(np.arange(3, dtype=np.float32))
    dr.enable_grad(array)
    copy = compat.owned(array)
    dr.backward(dr.sum(dr.square(copy)))
    np.testing.assert_array_equal(dr.grad(array).numpy(), [0, 2, 4])
    np.testing.assert_array_equal(dr.grad(copy).numpy(), [0, 2, 4])


def test_what_is_not_evaluated_is_no_copy(mi_rgb):
    array = mi_rgb.Float(np.arange(3, dtype=np.float32)) + 1
    assert compat.owned(array) is array


def test_assignments_are_seen_by_all(mi_rgb):
    tensor = mi_rgb.TensorXf(np.zeros((2, 2), np.float32))
    same = tensor
    compat.assign(tensor, mi_rgb.TensorXf(np.ones((1, 3), np.float32)))
    assert same.shape == (1, 3) and same.array.numpy().tolist() == [1, 1, 1]
