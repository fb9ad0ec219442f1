"""The sparse layout of signed distance fields: masks, codes, what cells say; no holes and no floaters."""

import math

import drjit as dr
import numpy as np
import pytest
from sdf_fields import coded, coded_table
from solid_meshes import box, sphere, together, turned

from mi_diffind.arrays.sparse_grid import CORNERS
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.sdf import encoding, grids, model, nodes
from mi_diffind.tasks.sdf.distances import Distances, sample_box
from mi_diffind.tasks.sdf.marching import trace
from mi_diffind.tasks.sdf.mesh import make_mesh


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


@pytest.fixture(scope="module")
def shapes():
    """A ball with a cavity, a box that cuts into it, a thin rod and a turned cube: distances and samples."""
    ball, cavity, rod = sphere(24), turned(sphere(16, 0.6)), box((0.08, 2.6, 0.08), (1.15, 0, 0.3))
    vertices, faces = box((0.5, 0.5, 0.5))
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    cube = vertices @ (turn * np.sign(np.linalg.det(turn))) + (-1.2, 0.9, 0), faces
    with Distances(make_mesh(*together(ball, cavity, box((0.6, 0.6, 0.6), (0.9, 0, 0)), rod, cube))) as distances:
        yield distances, encoding.sample(distances, 1 / 72, 8)


@pytest.fixture(scope="module")
def sampled(shapes):
    return shapes[1]


def points(types, values):
    return types.Array3f(*np.ascontiguousarray(np.asarray(values, np.float32).T))


def decoded(types, sampled, wrong=0.0):
    """The sampled nodes; this share of them is on the wrong side, as an optimisation may leave them."""
    values = np.concatenate([sampled.distances[:, None], sampled.normals], axis=1).astype(np.float32)
    values[np.random.default_rng(4).random(len(values)) < wrong, 0] *= -1
    return nodes.SparseNodes(types, sampled.structure, 3.0, nodes=types.TensorXf(values))


def field_of(types, coding):
    return model.build_field(coded_table(coding), {}, types)


# -- masks -------------------------------------------------------------------------------------------------------------


def test_every_node_of_the_grid_has_its_sign(ad, shapes):
    """Stored nodes, and all others, of which eight share a bit, against winding numbers."""
    distances, sampled = shapes
    s = sampled.structure
    grid = np.stack(np.meshgrid(*[np.arange(n - 1) for n in s.shape], indexing="ij"), axis=-1).reshape(-1, 3)
    places = np.array(s.lower) + s.spacing * grid
    inside = distances.inside(places)
    # A hair within the cell whose lowest corner the node is, so that rounding does not choose another
    result = decoded(ad, sampled).value(points(ad, places + 1e-4 * s.spacing)).numpy()
    sure = np.abs(distances.unsigned(places)) > 1e-3 * s.spacing
    assert 0.02 < inside.mean() < 0.5
    assert np.array_equal((result < 0)[sure], inside[sure])


# -- codes -------------------------------------------------------------------------------------------------------------


def test_frames_are_the_same_for_both_kinds_of_arrays(ad, rng):
    n = rng.normal(size=(2000, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    n[:6] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    d, s = rng.uniform(-4.4, 4.4, 2000), 2.0 ** rng.uniform(-6.9, 0.4, 2000)
    words = nodes.frame_words(n, d, s)
    axes, distance, scale = nodes.unpack_frames(words)
    normal = np.stack(axes, axis=1)
    assert np.degrees(np.arccos(np.sum(normal * n, axis=1).clip(-1, 1))).max() < 0.25
    assert np.abs(distance - d).max() <= 4.5 / 255 + 1e-9
    assert np.all(np.abs(np.log2(scale / s)) <= 0.2501)
    n, e, k = nodes.unpack_frames(ad.UInt32(words), ad.Float)
    assert np.allclose(np.stack([v.numpy() for v in n], axis=1), normal, atol=2e-6)
    assert np.allclose(e.numpy(), distance, atol=1e-6) and np.allclose(k.numpy(), scale, rtol=1e-6)


def test_residuals_reach_every_direction(rng):
    """decode_nodes() undoes residuals(), whatever the angle between a node and its block."""
    count = 5000
    n, g = rng.normal(size=(2, count, 3))
    n, g = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (n, g))
    offsets, d, s = rng.uniform(-1.5, 1.5, (count, 3)), rng.uniform(-2, 2, count), 2.0 ** rng.integers(-4, 1, count)
    distance = rng.uniform(-2, 2, count)
    entry = nodes.residuals(distance, g, offsets, tuple(n.T), d, s)
    back, normal = nodes.decode_nodes(tuple(entry.T), tuple(n.T), d, s, tuple(offsets.T))
    opposite = np.sum(n * g, axis=1) < -0.99
    assert np.allclose(back, distance, atol=1e-9)
    assert np.allclose(np.stack(normal, axis=1)[~opposite], g[~opposite], atol=1e-6)
    length = np.linalg.norm(np.stack(normal, axis=1), axis=1)
    assert np.allclose(length, 1, atol=1e-6)


def test_entries_beyond_the_projections_edge_stay_unit_vectors():
    n = tuple(np.array([[0.0, 0.6, 0.8]]).T)
    for a in (1.9, 1.9999, 2.5, 100.0):
        _, normal = nodes.decode_nodes((0.0, np.array([a]), np.array([0.0])), n, 0.0, 1.0, (0.0, 0.0, 0.0))
        assert np.isclose(np.linalg.norm(np.array(normal)), 1, atol=1e-6), a


@pytest.mark.parametrize("bits", nodes.POINTERS)
def test_pointers_in_words(ad, bits, rng):
    values = rng.integers(2**bits, size=1001).astype(np.uint32)
    words = nodes.pointer_words(values, bits)
    assert np.array_equal(nodes.unpack_pointers(words, bits, 1001), values)
    index = ad.UInt32(rng.permutation(1001).astype(np.uint32))
    result = nodes.pointer_at(ad.UInt32(words), index, bits, ad.Bool(True))
    assert np.array_equal(result.numpy(), values[index.numpy()])


# -- what cells say ----------------------------------------------------------------------------------------------------


def test_quadratic_functions_are_exact(ad, sampled):
    """f(x) = Σ wᵢ (dᵢ + ½ gᵢ·(x − xᵢ)) has no error but rounding for any quadratic f, and so have its gradients."""
    s = sampled.structure
    positions, _ = s.node_positions()
    a = np.array([[0.02, 0.01, -0.03], [0.01, -0.04, 0.02], [-0.03, 0.02, 0.05]])
    b, c = np.array([0.3, -0.2, 0.5]), -20.0
    x = positions.astype(float)
    values = np.concatenate([(np.einsum("ni,ij,nj->n", x, a, x) + x @ b + c)[:, None], 2 * x @ a + b], axis=1)
    values[:, 0] /= 40
    values[:, 1:] /= 40
    field = nodes.SparseNodes(ad, s, 1.0, nodes=ad.TensorXf(values.astype(np.float32)))
    rng = np.random.default_rng(1)
    cells = positions[sampled.corners[rng.integers(len(sampled.corners), size=500), 0]] + rng.random((500, 3))
    p = points(ad, np.array(s.lower) + s.spacing * cells)
    value, slope, _, complete = field.blend(p)
    assert np.all(complete.numpy())
    cells = np.stack([(p[i].numpy() - s.lower[i]) / s.spacing for i in range(3)], axis=1).astype(float)
    truth = (np.einsum("ni,ij,nj->n", cells, a, cells) + cells @ b + c) / 40
    assert np.abs(value.numpy() - truth).max() < 2e-4 * np.abs(truth).max()
    assert np.abs(np.stack([v.numpy() for v in slope], axis=1) - (2 * cells @ a + b) / 40).max() < 1e-3


def test_gradients_are_those_of_the_values(ad, sampled):
    """Derivatives by place against central differences, those by nodes against changes of single nodes."""
    field, s = decoded(ad, sampled), sampled.structure
    rng = np.random.default_rng(2)
    corner = s.node_positions()[0][sampled.corners[rng.integers(len(sampled.corners), size=400), 0]]
    places = np.array(s.lower) + s.spacing * (corner + 0.1 + 0.8 * rng.random((400, 3)))
    p = points(ad, places)
    _, slope = field.gradient(p)
    h = 0.02 * s.spacing
    for axis in range(3):
        step = [h if i == axis else 0 for i in range(3)]
        result = (field.value(p + ad.Array3f(*step)) - field.value(p - ad.Array3f(*step))) / (2 * h)
        assert np.abs(result.numpy() - slope[axis].numpy()).max() < 5e-3

    start = field.nodes
    weights = ad.Float(rng.normal(size=400).astype(np.float32))
    dr.enable_grad(start)
    field.nodes = start
    dr.backward(dr.sum(weights * field.value(p)) / s.spacing)
    grad = dr.grad(start).numpy()
    values = dr.detach(start).numpy()
    touched = np.argwhere(np.abs(grad) > 1e-3)
    assert len(touched) > 500
    for node, channel in touched[rng.integers(len(touched), size=8)]:
        result = []
        for sign in (1, -1):
            moved = values.copy()
            moved[node, channel] += sign * 0.01
            field.nodes = ad.TensorXf(moved)
            result.append(dr.sum(weights * field.value(p))[0] / s.spacing)
        assert (result[0] - result[1]) / 0.02 == pytest.approx(grad[node, channel], rel=2e-2, abs=2e-3)


def test_coded_nodes_are_the_decoded_ones(ad, sampled):
    """Read from pointers, entries and frames in the kernel, and decoded by NumPy: one field."""
    field = field_of(ad, coded(sampled))
    other = nodes.SparseNodes(ad, sampled.structure, 3.0, nodes=ad.TensorXf(field.decoded()))
    rng = np.random.default_rng(3)
    p = points(ad, rng.uniform(field.lower, field.upper, (20000, 3)))
    assert np.abs(field.value(p).numpy() - other.value(p).numpy()).max() < 2e-2 * field.spacing
    known = np.abs(other.value(p).numpy()) < field.band
    gap = np.abs(np.stack([v.numpy() for v in field.gradient(p)[1] - other.gradient(p)[1]]))[:, known]
    assert known.sum() > 500 and gap.max() < 0.02


def test_slope_is_bounded(ad, sampled):
    bound = nodes.slope_bound(sampled.distances, sampled.normals, sampled.corners)
    rng = np.random.default_rng(5)
    corner = sampled.structure.node_positions()[0][np.repeat(sampled.corners[:, 0], 16)]
    field = decoded(ad, sampled)
    p = points(ad, np.array(field.lower) + field.spacing * (corner + rng.random(corner.shape)))
    _, slope, _, complete = field.blend(p)
    steepest = dr.max(dr.select(complete, dr.norm(ad.Array3f(*slope)), 0))[0]
    assert 0.5 * bound < steepest <= bound < 3


def test_places_where_there_is_nothing(ad, sampled):
    field = field_of(ad, coded(sampled))
    p = points(ad, [[np.nan, 0, 0], [0, 0, 9], [-1e30, 0, 0], [np.inf, 0, 0]])
    value, slope = field.gradient(p)
    assert np.array_equal(value.numpy(), np.full(4, np.float32(field.band)))
    assert np.all(slope.numpy() == 0)
    assert np.all(field.value(p, ad.Bool(False)).numpy() == np.float32(field.band))
    corners = points(ad, [field.lower, field.upper])
    assert np.all(field.value(corners).numpy() > 0)


def test_spoiled_nodes_keep_their_sides(ad, sampled):
    """Coded nodes are on the sides of the sampled ones, and nothing is left beside the solids."""
    rng = np.random.default_rng(7)
    values = np.concatenate([sampled.distances[:, None], sampled.normals], axis=1)
    values[:, 0] += rng.normal(scale=0.1, size=len(values))
    values[:, 1:] += rng.normal(scale=0.5, size=(len(values), 3))
    values[:, 1:] /= np.linalg.norm(values[:, 1:], axis=1, keepdims=True)
    coding = encoding.NodeCoding(sampled)
    coding.encode(values)
    distances = coding.values()[:, 0]
    assert np.all((distances < 0) == (sampled.distances < 0)) and np.all(np.abs(distances) > 0.005)
    field = field_of(ad, coding)
    assert len(grids.components(grids.extract(field, 200))) == 3


# -- floaters ---------------------------------------------------------------------------------------------------------


def test_wrong_nodes_make_no_floaters(ad, shapes):
    """Stored nodes count only in cells that the surface crosses: all other cells keep their signs."""
    distances, s = shapes
    field = decoded(ad, s, 0.3)
    places = sample_box(field.lower, field.upper, 40000, 5)
    cell = np.floor((places - field.lower) / field.spacing).astype(int)
    stored = set(map(tuple, s.structure.node_positions()[0].tolist()))
    corners = (cell[:, None] + CORNERS).tolist()
    count = np.array([sum(tuple(c) in stored for c in eight) for eight in corners])
    inside = distances.inside(places)
    wrong = (field.value(points(ad, places)).numpy() < 0) != inside
    assert not wrong[count < 8].any() and wrong[count == 8].any()
    assert np.any((count > 0) & (count < 8) & inside) and np.any((count > 0) & (count < 8) & ~inside)


def test_as_many_pieces_as_the_mesh(ad, shapes):
    """Coded and decoded finer than the field's cells: two solids, one with a cavity, and no other piece."""
    distances, s = shapes
    volumes = grids.components(grids.extract(field_of(ad, coded(s)), 108)) * distances.mesh.scale**3
    assert len(volumes) == 3 and np.sum(volumes < 0) == 1
    assert volumes[1] == pytest.approx(-4 / 3 * math.pi * 0.6**3, rel=0.05)
    assert volumes[2] == pytest.approx(0.5**3, rel=0.05)


def test_empty_blocks_are_left_out_of_decoding(ad, shapes, monkeypatch):
    """The same triangles and values, whether all of the grid is looked at or what is near stored nodes only."""
    field = field_of(ad, coded(shapes[1]))
    few, (values, *_) = grids.extract(field, 100), grids.grid(field, 100)
    blocks = grids.crossed_blocks(field, np.array(field.lower), 1 / 100, [100] * 3)
    assert blocks.shape == (4, 4, 4) and 0.2 < blocks.mean() < 0.95
    monkeypatch.setattr(grids, "crossed_blocks", lambda field, lower, spacing, cells: np.ones(-(-cells // 32), bool))
    every = grids.extract(field, 100)
    assert np.abs(values - grids.grid(field, 100)[0]).max() < 1e-6
    assert np.array_equal(few.vertices, every.vertices) and np.array_equal(few.faces, every.faces)


# -- holes ------------------------------------------------------------------------------------------------------------


def shoot(ad, distances, field, count, seed):
    """``count`` rays that start outside, from a sphere around the solid, from afar, along axes and from places in the
    box, each at a place that lies deeper inside than the field's cells are wide: how many go through, how many end
    elsewhere than on the surface.
    """
    rng = np.random.default_rng(seed)
    h = field.spacing
    pool = sample_box(distances.mesh.lower - 3 * h, distances.mesh.upper + 3 * h, min(4 * count, 400_000), rng)
    d = distances.signed(pool, 4 * h)
    deep, free = pool[d < -1.5 * h], pool[d > 1.5 * h]
    target = deep[rng.integers(len(deep), size=count)] + rng.uniform(-0.25, 0.25, (count, 3)) * h
    away, start = rng.normal(size=(count, 3)), rng.integers(8, size=count)
    along, flat = start == 0, start == 1
    away[along] = np.eye(3)[rng.integers(3, size=along.sum())] * rng.choice([-1, 1], (along.sum(), 1))
    away[flat, rng.integers(3, size=flat.sum())] = 0
    away /= np.linalg.norm(away, axis=1)[:, None]
    o = target + np.where(start == 2, 30, 2)[:, None] * away
    box = start >= 5
    o[box] = free[rng.integers(len(free), size=box.sum())]
    o = o.astype(np.float32).astype(np.float64)
    length = np.linalg.norm(target - o, axis=1)
    d = (target - o) / length[:, None]
    t, hit = trace(field, points(ad, o), points(ad, d), ad.Float(math.inf))
    t, hit = t.numpy().astype(np.float64), hit.numpy()
    some = rng.choice(np.flatnonzero(hit & (start != 2)), min(20_000, int(hit.sum() // 2)), replace=False)
    place = o[some] + d[some] * t[some, None]
    return int(np.sum(~hit | (t > length))), int(np.sum(distances.unsigned(place) > 1.5 * h))


def test_no_holes(ad, shapes):
    assert shoot(ad, shapes[0], field_of(ad, coded(shapes[1])), 2**17, 6) == (0, 0)


def test_no_holes_where_nodes_are_wrong(ad, shapes):
    """Rays end at the latest where signs are known."""
    assert shoot(ad, shapes[0], decoded(ad, shapes[1], 0.3), 2**15, 9)[0] == 0
