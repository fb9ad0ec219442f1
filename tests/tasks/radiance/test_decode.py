"""Radiance fields as dense grids: the numbers of a grid come back, and what is not installed is said."""

import sys
from pathlib import Path
from unittest.mock import Mock

import drjit.llvm.ad as llvm
import numpy as np
import pytest

from mi_diffind.arrays.sparse_grid import complete_cells
from mi_diffind.core.errors import UsageError
from mi_diffind.tasks.radiance import model
from mi_diffind.tasks.radiance.nodes import Nodes
from mi_diffind.tasks.radiance.volume_field import FAINT, NodeField, VolumeField


@pytest.fixture
def t():
    return llvm


LOWER, VOXEL, SHAPE = (-1.0, 0.5, 2.0), 0.25, (6, 5, 4)


def numbers(rng, count=120):
    """Raw densities of which a third is nothing, and colours."""
    raw = np.where(rng.random(count) < 0.33, -15, rng.normal(1, 2, count))
    colour = rng.normal(0, 0.5, (count, 12))
    return raw.astype(np.float32), colour.astype(np.float32)


def dense(t, raw, colour, voxel=VOXEL):
    """A field with a number at every node of a box."""
    flat = raw.reshape(-1), colour.reshape(-1, 12)
    shape = SHAPE if raw.size == np.prod(SHAPE) else raw.shape
    entries = (np.concatenate([np.zeros_like(v[:1]), v]) for v in flat)
    nodes = Nodes(t, LOWER, voxel, shape, np.ones(shape, bool))
    return NodeField(nodes, *(t.TensorXf(np.ascontiguousarray(v, np.float32)) for v in entries))


def softplus(raw):
    return np.log1p(np.exp(np.asarray(raw, np.float64)))


def test_a_grid_comes_back(t, rng):
    raw, colour = numbers(rng)
    field = dense(t, raw, colour)
    found = model.dense_grid(field)
    assert found["density"].shape == SHAPE and found["colour"].shape == (*SHAPE, 12)
    assert found["lower"] == pytest.approx(LOWER) and found["voxel"] == pytest.approx(VOXEL)
    # Looked at from a thousandth of a voxel away, along each axis
    expected = softplus(raw.reshape(SHAPE)) / VOXEL
    assert np.abs(found["density"] - np.where(expected * VOXEL > 1e-3, expected, 0)).max() < 0.01 * expected.max()
    filled = found["density"] > 0
    assert 0.5 < filled.mean() < 0.8 and np.abs(found["colour"] - colour.reshape(*SHAPE, 12))[filled].max() < 0.02
    other = found["colour"][~filled].reshape(-1, 12)
    stored = found["colour"][filled]
    assert all((stored == row).all(axis=1).any() for row in other)  # of the nearest that is something


def test_what_was_decoded_is_the_same_field(t, rng):
    """A field made of the decoded grid has the same densities and radiances between nodes, at two resolutions."""
    smooth = np.stack(np.meshgrid(*(np.linspace(0, 2, n) for n in SHAPE), indexing="ij"))
    raw = 2 * np.sin(smooth.sum(axis=0))
    colour = 0.3 * np.sin(np.multiply.outer(smooth[0] + 2 * smooth[1], np.arange(12)) + np.arange(12))
    field = dense(t, raw, colour)
    places = rng.uniform(np.array(LOWER) + 0.01, np.array(field.upper) - 0.01, (500, 3))
    ways = rng.normal(size=(500, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)

    def seen(f):
        p, d = (t.Array3f(*(t.Float(np.float32(x)) for x in v.T)) for v in (places, ways))
        sigma, point_data = f.density_at(p, t.Bool(True))
        return sigma.numpy(), np.array([c.numpy() for c in f.radiance_at(point_data, p, d, t.Bool(True))])

    sigma, radiance = seen(field)
    for resolution, shape, tolerances in ((None, SHAPE, (0.01, 0.01)), (11, (11, 9, 7), (0.1, 0.02))):
        found = model.dense_grid(field, resolution)
        assert found["density"].shape == shape and found["voxel"] == pytest.approx(VOXEL * 5 / (shape[0] - 1))
        optical = found["density"] * np.float64(found["voxel"]) + FAINT
        again = seen(dense(t, np.log(np.expm1(optical)), found["colour"], float(found["voxel"])))
        for a, b, tolerance in zip(again, (sigma, radiance), tolerances, strict=True):
            assert np.allclose(a, b, rtol=tolerance)


def test_nodes_at_the_rim_of_what_is_stored_count(t, rng):
    """A node at the border of the occupied cells keeps its density and colour."""
    stored = np.zeros(SHAPE, bool)
    stored[1:4, 1:4, 1:3] = True
    nodes = Nodes(t, LOWER, VOXEL, SHAPE, stored)
    raw, colour = numbers(rng, nodes.entries)
    raw = np.abs(raw)
    field = NodeField(nodes, t.TensorXf(raw), t.TensorXf(colour))
    found = model.dense_grid(field)
    assert complete_cells(stored).sum() == 4 and np.array_equal(found["density"] > 0, stored)
    assert found["density"][stored] == pytest.approx(softplus(raw[1:]) / VOXEL, rel=0.02)
    assert found["colour"][stored] == pytest.approx(colour[1:], abs=0.02)


def test_mean_colour():
    """The mean colour is the average over many random directions."""
    rng = np.random.default_rng(1)
    d = rng.normal(size=(200_000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    row = np.float32([0.1, 0.5, -1, 0.7, -2, 0, 0, 0, 0.3, 2, 1, 0])
    expected = [np.exp(row[4 * c] + d @ row[4 * c + 1 : 4 * c + 4]).mean() for c in range(3)]
    assert model.mean_colour(row) == pytest.approx(expected, rel=0.01)


def test_an_archive_holds_the_grid(t, rng, tmp_path):
    raw, colour = numbers(rng)
    field = dense(t, raw, colour)
    ((path, line),) = model.decode(field, tmp_path / "grid.npz")
    assert path == tmp_path / "grid.npz" and line.startswith("6 x 5 x 4 nodes (x, y, z), 6")
    with np.load(path) as content:
        assert np.array_equal(content["density"], model.dense_grid(field)["density"])
        assert np.allclose(content["voxel"], VOXEL)


def test_vdb_where_openvdb_is_there(t, rng, tmp_path, monkeypatch):
    raw, colour = numbers(rng)
    field = dense(t, raw, colour)
    for name in model.MODULES:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UsageError, match=r"a VDB file needs the Python module openvdb, which is not installed"):
        model.decode(field, tmp_path / "grid.vdb")
    assert not list(tmp_path.iterdir())
    module, written = Mock(FloatGrid=Mock, Vec3SGrid=Mock, createLinearTransform=np.array), []
    module.write = lambda path, grids: written.extend(grids) or Path(path).write_bytes(b"vdb")
    monkeypatch.setitem(sys.modules, "pyopenvdb", module)
    model.decode(field, tmp_path / "grid.vdb")
    density, color = written
    densities, colours = (grid.copyFromArray.call_args.args[0] for grid in written)
    found = model.dense_grid(field)
    assert (density.name, color.name) == ("density", "color") and np.array_equal(densities, found["density"])
    assert np.array([2, 0, 1, 1]) @ density.transform == pytest.approx([LOWER[0] + 0.5, LOWER[1], LOWER[2] + 0.25, 1])
    assert np.array_equal(colours.any(axis=-1), found["density"] > 0)
    assert (tmp_path / "grid.vdb").read_bytes() == b"vdb"


def test_what_is_refused(t, tmp_path):
    field = VolumeField(t, (0, 0, 0), (1, 1, 1), 0.1, {})
    with pytest.raises(UsageError, match=r'found the extension "\.obj", allowed are \.npz and \.vdb'):
        model.decode(field, tmp_path / "grid.obj")
    for resolution in (1, 513):
        with pytest.raises(UsageError, match=rf"resolution: found {resolution}, allowed are 2 to 512"):
            model.dense_grid(field, resolution)
    field.voxel = 1e-3
    with pytest.raises(UsageError, match="resolution: found 1001, allowed are 2 to 512"):
        model.dense_grid(field)


def test_an_empty_field_is_empty(t):
    field = dense(t, np.full(SHAPE, -20.0), np.zeros((*SHAPE, 12)))
    found = model.dense_grid(field)
    assert not found["density"].any() and np.isfinite(found["colour"]).all()
