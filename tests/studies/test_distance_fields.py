"""Rivals of distance fields against trilinear interpolation by NumPy and distances by formulas; views of a mesh."""

import math
from types import SimpleNamespace

import drjit.llvm.ad as T
import numpy as np
import pytest
import solid_meshes as solids

from mi_diffind.arrays.budget import BudgetError
from mi_diffind.fitting.loop import FitSettings, fit
from mi_diffind.measure.training import halve
from mi_diffind.studies import sdf
from mi_diffind.studies.baselines import distance_fields as rivals
from mi_diffind.tasks.sdf import marching
from mi_diffind.tasks.sdf.mesh import make_mesh

CORNERS = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)])


class Torus:
    """Exact distances to a torus by its formula, as :class:`Distances` offers them; radii 0.35 and 0.15."""

    mesh = SimpleNamespace(lower=np.array([-0.5, -0.5, -0.15]), upper=np.array([0.5, 0.5, 0.15]))

    def signed(self, p, limit=math.inf):
        ring = np.hypot(p[:, 0], p[:, 1]) - 0.35
        return np.clip(np.hypot(ring, p[:, 2]) - 0.15, -limit, limit).astype(np.float32)

    def unsigned(self, p):
        return np.abs(self.signed(p)).astype(np.float64)

    def inside(self, p):
        return self.signed(p) < 0

    def signed_normals(self, p):
        axis = np.hypot(p[:, 0], p[:, 1])
        v = np.stack([p[:, 0] * (1 - 0.35 / axis), p[:, 1] * (1 - 0.35 / axis), p[:, 2]], -1)
        return self.signed(p), (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


class Ball(Torus):
    """Exact distances to a ball, with a mesh of it."""

    mesh = surface = make_mesh(*solids.sphere(24), "ball.ply")
    warnings = ()

    def signed(self, p, limit=math.inf):
        return np.clip(np.linalg.norm(p, axis=1) - 0.5, -limit, limit).astype(np.float32)


@pytest.fixture(scope="module", params=[rivals.dense_grid, rivals.distance_nodes])
def field(request):
    return request.param(T, Torus(), 1 / 37)


def arrays(points):
    return T.Array3f(*(T.Float(np.ascontiguousarray(v, np.float32)) for v in points.T))


def lattice(field):
    """Return the position of the first node of a field, and its spacing."""
    return np.array(getattr(field, "structure", field).lower), field.spacing


def interpolated(field, points):
    """Return the corners' rounded distances and their trilinear interpolation, by NumPy."""
    origin, h = lattice(field)
    place = (points - origin) / h
    cell = np.floor(place).astype(int)
    exact = Torus().signed((origin + (cell[:, None] + CORNERS) * h).reshape(-1, 3)).astype(np.float64).reshape(-1, 8)
    rounded = (np.clip(np.floor(exact / (1.75 * h) * 128), -128, 127) + 0.5) * 1.75 * h / 128
    t = (place - cell)[:, None]
    weights = np.prod(np.where(CORNERS == 1, t, 1 - t), axis=-1)
    return rounded, np.sum(weights * rounded, axis=1)


def test_values_are_those_of_the_rounded_nodes(field, rng):
    points = rng.uniform(Torus.mesh.lower - 0.01, Torus.mesh.upper + 0.01, (60000, 3)).astype(np.float32)
    corners, expected = interpolated(field, points.astype(np.float64))
    found = field.value(arrays(points)).numpy()
    crossed = (corners < 0).any(axis=1) & (corners > 0).any(axis=1)
    assert crossed.sum() > 3000
    assert np.abs(found - expected)[crossed].max() < 2e-6
    sure = ~crossed | (np.abs(expected) > 1e-6)
    assert np.array_equal(found[sure] < 0, expected[sure] < 0)
    assert field.value(arrays(np.array([[0.9, 0, 0], [0, -2, 0]]))).numpy() == pytest.approx([field.band] * 2)


def test_gradients_are_those_of_the_values(field, rng):
    step = 1e-4
    u, v = rng.uniform(0, 2 * np.pi, (2, 4000))
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], -1)
    points = 0.35 * np.stack([np.cos(u), np.sin(u), 0 * u], -1) + 0.15 * normals
    value, found = field.gradient(arrays(points))
    assert np.abs(value.numpy() - field.value(arrays(points)).numpy()).max() < 1e-6
    origin, h = lattice(field)
    place = (points - origin) / h % 1
    inner = ((place > 0.05) & (place < 0.95)).all(axis=1)  # off the sides of cells, where the gradient jumps
    for axis in range(3):
        e = step * np.eye(3)[axis]
        difference = field.value(arrays(points + e)).numpy() - field.value(arrays(points - e)).numpy()
        assert np.abs(difference / (2 * step) - found[axis].numpy())[inner].max() < 0.02
    length = np.linalg.norm(np.array(found), axis=0)
    assert length[inner].max() <= field.slope * (1 + 1e-4)
    angle = np.sum(np.array(found).T * normals, axis=1) / length
    assert np.degrees(np.arccos(angle.clip(-1, 1))).mean() < 6


def test_grids_are_as_fine_as_the_bytes_allow():
    field = rivals.finest_distance_nodes(T, Ball(), 60000)
    assert 0.97 * 60000 <= field.nbytes <= 60000
    with pytest.raises(BudgetError):
        rivals.finest_distance_nodes(T, Ball(), 10)
    grid = rivals.finest_dense_grid(T, Ball(), 50000)
    assert 0.8 * 50000 < grid.nbytes == np.prod(grid.shape) <= 50000


def test_hash_grid(rng):
    """A network learns distances on the samples of the supplement's arrays; gradients are those of the values."""
    ball = Ball()
    samples = rivals.PairProblem(ball, ((128,) * 3, (2,) * 3), "constant", T, 1, 2**13, 2**10)
    problem = rivals.HashProblem(samples, 40000)
    field = rivals.HashDistanceField(problem.net, samples.field)
    assert 0.8 * 40000 < field.nbytes <= 40000
    start = problem.measure(problem.net)["agree_db"]
    entries = problem.net.entries.numpy()
    fit(problem, FitSettings(seed=1, steps=300, batch=2**11, lr=1e-2, loss="mae", measure_every=300), progress=False)
    assert problem.measure(problem.net)["agree_db"] > start + 4
    assert not np.array_equal(problem.net.entries.numpy(), entries)  # the grid learns, too
    halve(problem.net)
    assert np.array_equal(problem.net.entries.numpy(), problem.net.entries.numpy().astype(np.float16))
    points = rng.uniform(-0.4, 0.4, (200, 3))
    value, found = field.gradient(arrays(points))
    assert np.abs(value.numpy() - ball.signed(points, field.band)).mean() < 0.2 * field.band

    def unclipped(p):
        return field.distance(arrays(p), True).numpy()

    for axis in range(3):
        e = 1e-4 * np.eye(3)[axis]
        difference = (unclipped(points + e) - unclipped(points - e)) / 2e-4
        assert np.median(np.abs(difference - found[axis].numpy())) < 0.02


def test_fields_and_meshes_are_in_one_place(mi_rgb):
    """The rays of fields, of the mesh and of the decoded grid meet surfaces in the same places."""
    model = rivals.distance_nodes(T, Ball(), 1 / 30)
    o, d = sdf.camera_rays(64 * 64)
    scenes = sdf.mesh_scene(Ball.mesh), sdf.grid_scene(model, 48)  # what is not evaluated yet needs them
    of_mesh, of_grid = (s.ray_intersect_preliminary(mi_rgb.Ray3f(o, d), coherent=True).t for s in scenes)
    expected = of_mesh.numpy()
    hit = np.isfinite(expected)
    assert 0.1 < hit.mean() < 0.8
    for t in (marching.trace(model, o, d, np.inf)[0], of_grid):
        t = t.numpy()
        assert np.mean(np.isfinite(t) != hit) < 0.03
        both = np.isfinite(t) & hit
        assert np.median(np.abs(t[both] - expected[both])) < 5e-3


def test_grids_are_computed_anew(mi_rgb, tmp_path):
    """A grid has no file: its record stands for it, and its model is that of the record's spacing."""
    settings = SimpleNamespace(sizes=(24576, 32768), **{**sdf.FULL, "points": 2**10})
    (tmp_path / "ball.ply").write_text("a mesh")
    jobs = [job for job in sdf.plan(Ball.mesh, str(tmp_path / "ball.ply"), settings).jobs if not job.has_file]
    assert [job.name for job in jobs] == [f"{m} grid {n} KiB" for n in (24, 32) for m in ("dense", "sparse")]
    job = jobs[0]
    assert job.cached_record(tmp_path) is None
    record = job.run(tmp_path, False)
    assert 0.8 * 24576 < record["bytes"] <= 24576 and record["errors"]["iou"] > 0.9
    assert job.cached_record(tmp_path) == record
    assert (job.model.spacing, job.model.nbytes) == (record["details"]["spacing"], record["bytes"])
