"""Hits of rays with signed distance fields, against formulas and a slow march."""

import functools

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from sdf_fields import Ball, Slab, Steps, TrilinearField, sparse_table, torus

from mi_diffind.core.compat import backend_module
from mi_diffind.tasks.sdf import grids, marching, model, nodes
from mi_diffind.tasks.sdf.nodes import MIDDLE

COUNT = 4096


@pytest.fixture
def types(mi_rgb):
    return backend_module(mi_rgb.Float)


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def rays(types, o, d, maxt=np.inf):
    """Origins, directions and lengths as arrays that are alike in all tests, so that they share kernels."""
    o, d = np.broadcast_arrays(o, d)
    maxt = types.Float(aligned(np.broadcast_to(maxt, len(o))))
    return *(types.Array3f(*(types.Float(aligned(x)) for x in v.T)) for v in (o, d)), maxt


def trace(field, o, d, maxt=np.inf):
    """Distances, hits, places and whether the ray came from within, as NumPy arrays."""
    ray = rays(field.types, o, d, maxt)
    hit, occluded = marching.intersect(field, *ray), marching.occluded(field, *ray)
    dr.eval(hit, occluded)  # at once: each result of its own would be another kernel
    assert (occluded.numpy() == hit.hit.numpy()).all()
    return hit.t.numpy(), hit.hit.numpy(), hit.p.numpy().T, hit.leaving.numpy()


def sphere(o, d, r):
    """Both distances to a sphere around the origin, NaN for a miss."""
    o, d = np.broadcast_arrays(np.asarray(o, np.float64), np.asarray(d, np.float64))
    b, c = (o * d).sum(-1), (o * o).sum(-1) - r * r
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - c)
    return -b - root, -b + root


@pytest.mark.parametrize("start", ["far", "near", "within"])
def test_spheres(types, rng, start):
    """Rays start outside of the box, within it, or within the solid, in any direction."""
    d = unit(rng.normal(size=(COUNT, 3)))
    at = unit(rng.normal(size=(COUNT, 3)))
    o = {"far": 0.3 * at - 2 * d, "near": 0.45 * at, "within": 0.35 * at * rng.random((COUNT, 1))}[start]
    near, far = sphere(o, d, 0.4)
    t, is_hit, p, leaving = trace(Ball(types), o, d)
    expected = near if start != "within" else far
    hits = expected > 0
    clear = np.abs(np.linalg.norm(np.cross(o, d), axis=1) - 0.4) > 1e-5
    assert (is_hit == hits)[clear].all() and hits.mean() > 0.1
    both = is_hit & hits & clear
    cosine = np.abs(((o + expected[:, None] * d) * d).sum(-1) / 0.4)[both]
    assert (np.abs(t[both] - expected[both]) * cosine < 2e-5).all()
    assert np.abs(np.linalg.norm(p[both], axis=1) - 0.4).max() < 1e-5
    assert (leaving[both] == (start == "within")).all() and np.isinf(t[~is_hit]).all()


def test_axis_aligned_rays(types):
    """Components that are zero, of either sign, also where the ray lies in a side of the box or starts on it."""
    ball = Ball(types)
    o, d, expected = [], [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            for zero in (0.0, -0.0):
                for offset, t in ((0.0, 0.1), (0.3, 0.5 - np.sqrt(0.16 - 0.09)), (0.45, np.inf), (0.5, np.inf)):
                    for start in (0.5, 3.0):
                        direction, origin = np.full(3, zero), np.zeros(3)
                        direction[axis], origin[axis], origin[axis - 1] = sign, -sign * start, offset
                        o.append(origin), d.append(direction), expected.append(t + start - 0.5)
    t, is_hit, _, _ = trace(ball, np.array(o), np.array(d))
    expected = np.array(expected)
    assert (is_hit == np.isfinite(expected)).all()
    assert np.abs(t[is_hit] - expected[is_hit]).max() < 2e-5


def test_length_of_rays(types):
    """A ray ends where it is said to end: before the surface it finds nothing."""
    o, d = np.array([[0, 0, -2.0]] * 4), np.array([[0, 0, 1.0]] * 4)
    maxt = np.array([1.0, 1.599, 1.601, 9], np.float32)
    t, is_hit, _, _ = trace(Ball(types), o, d, maxt)
    assert is_hit.tolist() == [False, False, True, True]
    short = marching.trace(Ball(types), *rays(types, o, d, maxt))
    dr.eval(short)
    assert np.array_equal(short[0].numpy(), t) and np.array_equal(short[1].numpy(), is_hit)


@pytest.mark.parametrize("thickness", [3e-4, 0.02])
def test_thin_walls_have_no_holes(types, rng, thickness):
    slab = Slab(types, thickness, (0.3, 0.2, 1.0))
    aim = rng.uniform(-0.2, 0.2, (4 * COUNT, 3))
    aim -= (aim @ slab.axis)[:, None] * slab.axis
    d = unit(rng.normal(size=(4 * COUNT, 3)))
    t, is_hit, _, _ = trace(slab, aim - 2 * d, d)
    assert is_hit.all()
    cosine = np.abs(d @ slab.axis)
    clear = cosine > 4 * thickness
    assert (np.abs((2 - t) * cosine - thickness / 2)[clear] < 2e-5).all()


def test_what_the_box_cuts_is_closed(types):
    """A solid that reaches the side of the box ends there, seen from outside and from within."""
    slab = Slab(types, 0.2)
    o = np.array([[-2.0, 0, 0], [-2.0, 0, 0.3], [0, 0, 0], [0.2, 0, 0.05]])
    d = np.array([[1.0, 0, 0], [1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])
    t, is_hit, _, _ = trace(slab, o, d)
    assert is_hit.tolist() == [True, False, True, True]
    assert np.abs(t[[0, 2, 3]] - [1.5, 0.5, 0.7]).max() < 1e-5
    _, is_hit, _, _ = trace(slab, o, d, 0.4)
    assert not is_hit.any()


def test_jumps_are_bracketed(types, rng):
    """A change of sign without a zero is bisected."""
    d = unit(rng.normal(size=(COUNT, 3)))
    o = 0.3 * unit(rng.normal(size=(COUNT, 3))) - 2 * d
    t, is_hit, _, _ = trace(Steps(types), o, d)
    assert is_hit.all()
    assert np.abs(t - sphere(o, d, 0.4)[0]).max() < 5e-5


def test_grids_against_a_slow_march(types, rng):
    """Hits with a bumpy grid are the first changes of sign that steps of 2e-4 see, except where a ray only touches."""
    n = 17
    x = np.linspace(-0.5, 0.5, n)
    grid = np.stack(np.meshgrid(x, x, x, indexing="ij"), -1)
    values = np.linalg.norm(grid, axis=-1) - 0.33 + rng.uniform(-0.02, 0.02, (n, n, n))
    field = TrilinearField(types.TensorXf(values.astype(np.float32)), (-0.5,) * 3, (0.5,) * 3, 0.2)
    count = 1024
    d = unit(rng.normal(size=(count, 3)))
    o = 0.4 * rng.random((count, 1)) * unit(rng.normal(size=(count, 3))) - d
    t, is_hit, _, _ = trace(field, o, d)
    steps = np.arange(0, 2, 2e-4, dtype=np.float32)
    p = (o[:, None] + steps[None, :, None] * d[:, None]).reshape(-1, 3).astype(np.float32)
    inside = (grids.point_values(field, p) < 0).reshape(count, -1)
    first = np.where(inside.any(1), steps[inside.argmax(1)], np.inf)
    agree = np.isclose(t, first, rtol=0, atol=4e-4)
    # A ray may touch a bump for less than a step, which either of the two may see
    assert agree.mean() > 0.998 and np.isfinite(t[is_hit]).all()
    assert not (is_hit & (t > first + 4e-4)).sum() > 1


def shell(p):
    """Distance to a sphere's wall, thinner than two cells, and its gradient: blocks see both of its sides."""
    r = np.linalg.norm(p, axis=1, keepdims=True)
    return np.abs(r[:, 0] - 0.4) - 0.016, p / np.maximum(r, 1e-9) * np.sign(r - 0.4)


@functools.cache
def table_of(shape, entries):
    return sparse_table(shape, entries=entries)


@pytest.fixture(params=[(torus, 16), (torus, 256), (shell, 256)], ids=lambda v: f"{v[0].__name__}-{v[1]}")
def coded(types, request):
    """The sparse field of a torus, well coded or badly, and of a thin wall."""
    return model.build_field(table_of(*request.param), {}, types)


def test_slabs_change_no_hit(types, coded, rng):
    """Rays from far away, from within the box and from within the solid meet what they meet without slabs."""
    d = unit(rng.normal(size=(3 * COUNT, 3)))
    o = rng.uniform(-0.45, 0.45, (3 * COUNT, 3))
    o[:COUNT] -= 2 * d[:COUNT]
    t, is_hit, _, leaving = trace(coded, o, d)
    marching.get_marcher(coded).slabs = None
    slow, met, _, left = trace(coded, o, d)
    assert 0.3 < is_hit.mean() < 0.95 and 0.05 < leaving.mean() < 0.5
    # Looked at in other places, a ray that grazes may be seen to touch, or start, elsewhere
    assert (is_hit != met).mean() < 1e-3 and (leaving != left).mean() < 1e-3
    both = is_hit & met
    assert np.quantile(np.abs(t[both] - slow[both]), 0.995) < 2e-5


def test_rays_along_the_plane_of_a_block(coded, rng):
    """Distances to a slab of rays in its plane stay within the range of whole numbers."""
    types, marcher, structure = coded.types, marching.get_marcher(coded), coded.structure
    axes, middles, _ = nodes.unpack_frames(coded.frames())
    normals = np.stack(axes, axis=1)
    block = rng.choice(np.flatnonzero(marching.GridCells(coded).crossed.any(axis=1)), COUNT)
    aside = unit(np.cross(normals[block], rng.normal(size=(COUNT, 3))))
    middle = structure.block_positions()[block] + MIDDLE
    height = rng.uniform(-4, 4, COUNT) - middles[block]
    o, aside, _ = rays(types, middle + height[:, None] * normals[block], aside)
    ray = marching.GridRay(coded, o, aside)
    number, t = types.UInt32(aligned(block, np.uint32)), types.Float(0)
    cell = [types.Int32(aligned(v, np.int32)) for v in structure.block_positions()[block].T + 1]
    first, last, below = marcher.slab(ray, t, number, cell, True)
    dr.eval(first, last, below)
    assert np.abs(np.array(first)).max() < 2**31 and np.abs(np.array(last)).max() < 2**31
    low = (np.array(marcher.slabs)[1::2][block] & 0xFFFF) * (2 * marching.SLAB / marching.STEPS) - marching.SLAB
    off = (np.array(first) > 0) | (np.array(last) < 0)
    above = middles[block] + height
    clear = off & (np.abs(above - low) > 1e-3)
    assert clear.mean() > 0.2 and (np.array(below) == (above < low))[clear].all()
