"""The optimiser of large tables: the steps of Dr.Jit's own Adam for entries with a gradient, and no others."""

import drjit as dr
import numpy as np
import pytest
from drjit.opt import Adam

from mi_diffind.fitting.loop import SparseAdam


@pytest.fixture
def ad():
    from drjit.llvm import ad

    return ad


def trained(ad, optimizer, shape, steps=12):
    """Return a tensor of random numbers after steps that read few of its rows, and how often each row was read."""
    rng, width = np.random.default_rng(3), shape[1] if len(shape) == 2 else 1
    optimizer["x"] = ad.TensorXf(rng.normal(size=shape).astype(np.float32))
    reads = np.zeros(shape[0], int)
    for _ in range(steps):
        rows = rng.choice(shape[0], 5, replace=False)
        reads[rows] += 1
        entries = (rows[:, None] * width + np.arange(width)).reshape(-1)
        slopes = ad.Float(rng.normal(size=entries.size).astype(np.float32))
        read = dr.gather(ad.Float, optimizer["x"].array, ad.UInt32(entries.astype(np.uint32)))
        dr.backward(dr.sum(dr.square(read) * slopes))
        del read
        optimizer.step()
    return optimizer["x"].numpy(), reads


@pytest.mark.parametrize("shape", [(60,), (40, 12), (40, 3)])
def test_steps(ad, shape):
    """Of entries alone and of columns in packets; a learning rate of 0.1 moves what was read by more than rounding."""
    values, reads = trained(ad, SparseAdam(lr=0.1, beta_2=0.99), shape)
    expected, _ = trained(ad, Adam(lr=0.1, beta_2=0.99, mask_updates=True), shape)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-5)
    begun, _ = trained(ad, SparseAdam(lr=0.1), shape, steps=0)
    moved = np.abs(values - begun).reshape(shape[0], -1).max(axis=1)
    assert (moved[reads == 0] == 0).all() and (moved[reads > 0] > 1e-3).all() and (reads == 0).any()


def test_columns_move_together(ad):
    """A row of four of which one column has a gradient: the others continue as their moments say."""
    optimizer = SparseAdam(lr=0.1)
    optimizer["x"] = ad.TensorXf(np.zeros((2, 4), np.float32))
    for columns in ((1, 1, 1, 1), (1, 0, 0, 0)):
        slopes = ad.Float(np.float32([*columns, 0, 0, 0, 0]))
        dr.backward(dr.sum(optimizer["x"].array * slopes))
        optimizer.step()
    values = optimizer["x"].numpy()
    assert (values[1] == 0).all() and values[0, 0] == pytest.approx(-0.2, abs=1e-3)
    assert (values[0, 1:] < -0.11).all() and (values[0, 1:] > -0.19).all()


def test_nothing_to_do(ad):
    """No gradient at all."""
    optimizer = SparseAdam(lr=0.1)
    optimizer["x"] = ad.TensorXf(np.float32([1, 2, 3]))
    dr.backward(dr.sum(optimizer["x"].array * ad.Float(np.zeros(3, np.float32))))
    optimizer.step()
    np.testing.assert_array_equal(optimizer["x"].numpy(), [1, 2, 3])


def test_rows_without_a_gradient_in_the_column_of_their_own(ad):
    """A tensor of columns beside one without: rows that the latter does not read are left alone."""
    optimizer = SparseAdam(lr=0.1)
    optimizer["density"], optimizer["colour"] = (ad.TensorXf(np.zeros(s, np.float32)) for s in ((3,), (3, 8)))
    read = ad.Float(np.float32([1, 0, 1])), ad.Float(np.float32([1] * 8 + [1] * 8 + [1] * 4 + [0] * 4))
    total = dr.sum(optimizer["density"].array * read[0]) + dr.sum(optimizer["colour"].array * read[1])
    dr.backward(total)
    del total
    optimizer.step()
    np.testing.assert_allclose(optimizer["density"].numpy(), [-0.1, 0, -0.1], atol=1e-5)
    expected = [[-0.1] * 8, [0] * 8, [-0.1] * 4 + [0] * 4]
    np.testing.assert_allclose(optimizer["colour"].numpy(), expected, atol=1e-5)
