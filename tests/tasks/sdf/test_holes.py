"""Sparse fields have no holes and no floaters: rays at what is surely inside, signs of cells far from the surface."""

import math

import drjit as dr
import numpy as np
import pytest
import solid_meshes as solids

from mi_diffind.arrays.sparse_grid import CORNERS
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.sdf import encoding, grids, nodes
from mi_diffind.tasks.sdf.distances import Distances, sample_box
from mi_diffind.tasks.sdf.field import DistanceField
from mi_diffind.tasks.sdf.mesh import make_mesh


@pytest.fixture(scope="module")
def types():
    return array_module("llvm")


def shapes():
    """A ball with a cavity, a box that cuts into it, a thin rod and a turned cube: one mesh."""
    ball, cavity = solids.sphere(24), solids.turned(solids.sphere(16, 0.6))
    rod = solids.box((0.08, 2.6, 0.08), (1.15, 0, 0.3))
    vertices, faces = solids.box((0.5, 0.5, 0.5))
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    cube = vertices @ (turn * np.sign(np.linalg.det(turn))) + (-1.2, 0.9, 0), faces
    return make_mesh(*solids.together(ball, cavity, solids.box((0.6, 0.6, 0.6), (0.9, 0, 0)), rod, cube), "shapes")


@pytest.fixture(scope="module")
def sampled():
    mesh = shapes()
    with Distances(mesh) as distances:
        yield distances, encoding.sample(distances, 1 / 72)


def coded(types, sampled, bits=8):
    """Sampled, not trained: entries of 8 bits are coarse enough for errors."""
    frames = encoding.fit_frames(sampled)
    wanted = encoding.exact_entries(sampled, frames)
    entries = encoding.cluster(wanted, min(2**bits, len(wanted)))
    pointers = encoding.assign(wanted, entries)
    values = nodes.decode_to_array(sampled.structure, frames, entries[pointers]).astype(np.float64)
    slope = nodes.slope_bound(values[:, 0], values[:, 1:], sampled.corners)
    words = nodes.pointer_words(pointers, bits)
    return nodes.coded_field(types, sampled.structure, slope, frames, words, bits, entries)


def vectors(types, values):
    return types.Array3f(np.ascontiguousarray(np.asarray(values).T, dtype=np.float32))


# -- floaters ---------------------------------------------------------------------------------------------------------


def test_wrong_nodes_make_no_floaters(types, sampled):
    """
    Nodes whose distances are lost have a part in the cells that the surface crosses only: all others keep their signs.
    """
    distances, s = sampled
    rng = np.random.default_rng(4)
    values = np.concatenate([s.distances[:, None], s.normals], axis=1)
    values[rng.random(len(values)) < 0.3, 0] *= -1
    field = nodes.SparseNodes(types, s.structure, 3.0, nodes=types.TensorXf(values.astype(np.float32)))
    points = sample_box(field.lower, field.upper, 40000, 5)
    cell = np.floor((points - field.lower) / field.spacing).astype(int)
    stored = set(map(tuple, s.structure.node_positions()[0].tolist()))
    corners = (cell[:, None] + CORNERS).tolist()
    count = np.array([sum(tuple(c) in stored for c in eight) for eight in corners])
    inside = distances.inside(points)
    wrong = (field.value(vectors(types, points)).numpy() < 0) != inside
    assert not wrong[count < 8].any() and wrong[count == 8].any()
    assert np.any((count > 0) & (count < 8) & inside) and np.any((count > 0) & (count < 8) & ~inside)


def test_as_many_pieces_as_the_mesh(types, sampled):
    """Also after coding, decoded finer than the field's cells: two solids, one with a cavity, and nothing else."""
    distances, s = sampled
    volumes = grids.components(grids.extract(coded(types, s), 108)) * distances.mesh.scale**3
    assert len(volumes) == 3 and np.sum(volumes < 0) == 1
    assert volumes[1] == pytest.approx(-4 / 3 * math.pi * 0.6**3, rel=0.05)
    assert volumes[2] == pytest.approx(0.5**3, rel=0.05)


def test_empty_blocks_are_left_out_of_decoding(types, sampled, monkeypatch):
    """The same triangles, whether all of the grid is looked at or what is near stored nodes only."""
    field = coded(types, sampled[1])
    few = grids.extract(field, 100)
    blocks = grids.crossed_blocks(field, np.array(field.lower), 1 / 100, [100] * 3)
    assert blocks.shape == (4, 4, 4) and 0.2 < blocks.mean() < 0.95
    monkeypatch.setattr(grids, "crossed_blocks", lambda field, lower, spacing, cells: np.ones(-(-cells // 32), bool))
    every = grids.extract(field, 100)
    assert np.array_equal(few.vertices, every.vertices) and np.array_equal(few.faces, every.faces)


# -- holes ------------------------------------------------------------------------------------------------------------


def shoot(types, distances, field, count, seed):
    """
    ``count`` rays that start outside, from a sphere around the solid, from afar, along axes and from places in the box,
    each at a place that lies deeper inside than the field's cells are wide: how many go through, how many end elsewhere
    than on the surface.
    """
    from mi_diffind.tasks.sdf.marching import trace

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
    t, hit = trace(field, vectors(types, o), vectors(types, d), types.Float(math.inf))
    t, hit = t.numpy().astype(np.float64), hit.numpy()
    some = rng.choice(np.flatnonzero(hit & (start != 2)), min(20_000, int(hit.sum() // 2)), replace=False)
    place = o[some] + d[some] * t[some, None]
    return int(np.sum(~hit | (t > length))), int(np.sum(distances.unsigned(place) > 1.5 * h))


def test_no_holes(types, sampled):
    distances, s = sampled
    assert shoot(types, distances, coded(types, s), 2**17, 6) == (0, 0)


def test_no_holes_where_nodes_are_wrong(types, sampled):
    """Nodes on the wrong side, as an optimisation may leave them: rays end at the latest where signs are known."""
    distances, s = sampled
    values = np.concatenate([s.distances[:, None], s.normals], axis=1)
    values[np.random.default_rng(4).random(len(values)) < 0.3, 0] *= -1
    field = nodes.SparseNodes(types, s.structure, 3.0, nodes=types.TensorXf(values.astype(np.float32)))
    assert shoot(types, distances, field, 2**15, 9)[0] == 0


def test_a_hole_would_be_found(types, sampled):
    """The same field with a thin tube through its middle, along z: some rays go through, or end in the tube."""
    distances, s = sampled

    class Pierced(DistanceField):
        def __init__(self, field):
            super().__init__(field.types, field.lower, field.upper, field.spacing, field.band)
            self.field, self.slope = field, field.slope

        def value(self, p, active=True):
            tube = 0.02 - dr.sqrt(dr.square(p.x - self.upper[0] / 4) + dr.square(p.y))
            return dr.maximum(self.field.value(p, active), dr.clip(tube, -self.band, self.band))

    assert shoot(types, distances, Pierced(coded(types, s)), 2**14, 8) > (0, 0)
