"""Rivals of distance fields against trilinear interpolation by NumPy and distances by formulas; views of a mesh."""

import math
from types import SimpleNamespace

import drjit.llvm.ad as T
import numpy as np
import pytest
import solid_meshes as solids

from mi_diffind.fitting.loop import FitSettings, fit
from mi_diffind.measure.training import halve
from mi_diffind.studies import sdf
from mi_diffind.studies.baselines import distance_fields as rivals
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


MAKERS = {
    "dense": lambda h, train=False: rivals.dense(T, Torus(), h, train),
    "nodes": lambda h, train=False: rivals.distance_nodes(T, Torus(), h, train),
}


@pytest.fixture(scope="module")
def fields():
    return {name: make(1 / 37) for name, make in MAKERS.items()}


def arrays(points):
    return T.Array3f(*(T.Float(np.ascontiguousarray(v, np.float32)) for v in points.T))


def lattice(field):
    """Where the first of its nodes is, and how far apart they are."""
    return np.array(getattr(field, "structure", field).lower), field.spacing


def interpolated(field, points):
    """The corners' rounded distances and their trilinear interpolation, by NumPy."""
    origin, h = lattice(field)
    band = 1.75 * h
    half = 2 ** (getattr(field, "bits", 8) - 1)
    place = (points - origin) / h
    cell = np.floor(place).astype(int)
    corner = origin + (cell[:, None] + CORNERS) * h
    exact = Torus().signed(corner.reshape(-1, 3)).astype(np.float64).reshape(-1, 8)
    steps = np.clip(np.floor(exact / band * half), -half, half - 1)
    rounded = (steps + 0.5) * band / half
    t = (place - cell)[:, None]
    weights = np.prod(np.where(CORNERS == 1, t, 1 - t), axis=-1)
    return rounded, np.sum(weights * rounded, axis=1)


@pytest.mark.parametrize("name", MAKERS)
def test_values_are_those_of_the_rounded_nodes(fields, name, rng):
    field = fields[name]
    points = rng.uniform(Torus.mesh.lower - 0.01, Torus.mesh.upper + 0.01, (60000, 3)).astype(np.float32)
    corners, expected = interpolated(field, points.astype(np.float64))
    found = field.value(arrays(points)).numpy()
    crossed = (corners < 0).any(axis=1) & (corners > 0).any(axis=1)
    assert crossed.sum() > 3000
    assert np.abs(found - expected)[crossed].max() < 2e-6
    sure = ~crossed | (np.abs(expected) > 1e-6)
    assert np.array_equal(found[sure] < 0, expected[sure] < 0)
    assert field.value(arrays(np.array([[0.9, 0, 0], [0, -2, 0]]))).numpy() == pytest.approx([field.band] * 2)


@pytest.mark.parametrize("name", MAKERS)
def test_gradients_are_those_of_the_values(fields, name, rng):
    field, step = fields[name], 1e-4
    points, normals = surface_points(rng, 4000)
    value, found = field.gradient(arrays(points))
    assert np.abs(value.numpy() - field.value(arrays(points)).numpy()).max() < 1e-6
    origin, h = lattice(field)
    place = (points - origin) / h % 1
    inner = ((place > 0.05) & (place < 0.95)).all(axis=1)  # off the sides of cells, where the gradient jumps
    for axis in range(3):
        e = step * np.eye(3)[axis]
        difference = field.value(arrays(points + e)).numpy() - field.value(arrays(points - e)).numpy()
        assert np.abs(difference / (2 * step) - found[axis].numpy())[inner].max() < 0.02
    angle = np.sum(np.array(found).T * normals, axis=1) / np.linalg.norm(np.array(found), axis=0)
    assert np.degrees(np.arccos(angle.clip(-1, 1))).mean() < 6


def surface_points(rng, count):
    u, v = rng.uniform(0, 2 * np.pi, (2, count))
    n = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], -1)
    return 0.35 * np.stack([np.cos(u), np.sin(u), 0 * u], -1) + 0.15 * n, n


def test_training_is_nearer_to_the_truth(rng):
    points, normals = surface_points(rng, 20000)
    near = points + rng.normal(scale=0.01, size=(len(points), 1)) * normals
    truth = Torus().signed(near) < 0
    for name in ("dense", "nodes"):
        sampled, trained = (MAKERS[name](1 / 20, train) for train in (False, True))
        wrong = [np.mean((f.value(arrays(near)).numpy() < 0) != truth) for f in (sampled, trained)]
        assert wrong[1] < 0.7 * wrong[0], name
        assert trained.nbytes <= 1.1 * sampled.nbytes


def test_training_leaves_what_is_exact():
    """Trilinear interpolation is exact for a plane: its nodes are the minimum already."""

    class Plane(Torus):
        def signed(self, p, limit=math.inf):
            return np.clip(p @ [0.6, 0, 0.8], -limit, limit).astype(np.float32)

        def signed_normals(self, p):
            return self.signed(p), np.tile(np.float32([0.6, 0, 0.8]), (len(p), 1))

    keys, lower = np.arange(1000), np.full(3, -0.45)
    values = Plane().signed(lower + np.stack(np.unravel_index(keys, (10,) * 3), -1) * 0.1)
    found = rivals.least_squares(Plane(), lower, 0.1, (10,) * 3, keys, values)
    assert np.abs(found - values).max() < 1e-6
    off = values + 0.03 * np.sin(np.arange(1000)).astype(np.float32)
    found = rivals.least_squares(Plane(), lower, 0.1, (10,) * 3, keys, off, keep=1e-6)
    changed = found != off
    assert 100 < changed.sum() < 900
    assert np.abs(found - values)[changed].max() < 1e-3


class Ball(Torus):
    """A ball's distances, with a mesh."""

    mesh = surface = make_mesh(*solids.sphere(24), "ball.ply")
    warnings = ()

    def signed(self, p, limit=math.inf):
        return np.clip(np.linalg.norm(p, axis=1) - 0.5, -limit, limit).astype(np.float32)


def test_files_of_fields(fields, tmp_path, rng):
    points = arrays(rng.uniform(-0.5, 0.5, (5000, 3)))
    for i, (name, field) in enumerate(fields.items()):
        path = tmp_path / f"{i}.npz"
        size = rivals.save(path, field)
        found = rivals.load(path, T)
        assert np.array_equal(found.value(points).numpy(), field.value(points).numpy()), name
        assert (found.nbytes, found.slope) == (field.nbytes, field.slope)
        assert path.stat().st_size == size == rivals.save(None, field)


def test_hash_grid(rng):
    net = rivals.network(40000)
    lower, upper = Ball.mesh.lower - 0.01, Ball.mesh.upper + 0.01
    pools = [rivals.pool(Ball(), lower, upper, n, n) for n in (2**13, 2**10)]
    problem = rivals.HashProblem(net, T, Ball.mesh, *pools)
    field = problem.field
    assert 0.8 * 40000 < field.nbytes <= 40000
    start = problem.measure(problem.net)["psnr_db"]
    entries = problem.net.entries.numpy()
    fit(problem, FitSettings(seed=1, steps=80, batch=2**11, lr=1e-2, loss="mae", measure_every=80), progress=False)
    assert problem.measure(problem.net)["psnr_db"] > start + 6
    assert not np.array_equal(problem.net.entries.numpy(), entries)  # the grid learns, too
    halve(problem.net)
    assert np.array_equal(problem.net.entries.numpy(), problem.net.entries.numpy().astype(np.float16))
    points = rng.uniform(-0.4, 0.4, (200, 3))
    _, found = field.gradient(arrays(points))

    def unclipped(p):
        return field.net([x - a for x, a in zip(arrays(p), field.lower, strict=True)])[0].numpy() * rivals.BAND

    for axis in range(3):
        e = 1e-4 * np.eye(3)[axis]
        difference = (unclipped(points + e) - unclipped(points - e)) / 2e-4
        assert np.median(np.abs(difference - found[axis].numpy())) < 0.02
    with pytest.raises(NotImplementedError):
        field.safe_step(arrays(points), arrays(points))


def test_the_pool_of_a_network_is_near_the_surface():
    """Three quarters of the points lie around the surface, the others anywhere in the box."""
    truth = SimpleNamespace(mesh=make_mesh(*solids.sphere(24)), signed=Torus().signed)
    box = truth.mesh.lower, truth.mesh.upper
    points, _ = rivals.pool(truth, *box, 4000, 3)
    radius = np.linalg.norm(points - np.mean(box, axis=0), axis=1)
    assert points.shape == (4000, 3)
    assert 0.72 < (np.abs(radius - (box[1] - box[0]).max() / 2) < 0.04).mean() < 0.9


def test_as_fine_as_the_bytes_allow():
    field = rivals.fit_bytes(lambda h: rivals.distance_nodes(T, Ball(), h), 60000)
    assert 0.97 * 60000 <= field.nbytes <= 60000
    with pytest.raises(ValueError, match="too few"):
        rivals.fit_bytes(lambda h: rivals.distance_nodes(T, Ball(), h), 10)
    grid = rivals.dense(T, Ball(), rivals.dense_spacing(Ball.mesh, 50000))
    assert 0.8 * 50000 < grid.nbytes == np.prod([n + 1 for n in grid.cells]) <= 50000


def test_fields_and_meshes_are_in_one_place(mi_rgb):
    """The rays of fields, of the mesh and of the decoded grid meet surfaces in the same places."""
    view, model = sdf.MeshView(Ball.mesh, (64, 48)), rivals.distance_nodes(T, Ball(), 1 / 30)
    o, d = view.rays(mi_rgb)
    scenes = view.mesh_scene(), view.grid_scene(model, 48)  # what is not evaluated yet needs them
    expected = sdf.scene_distance(scenes[0], o, d).numpy()
    hit = np.isfinite(expected)
    assert 0.1 < hit.mean() < 0.8
    for t in (sdf.traced_distance(model, o, d), sdf.scene_distance(scenes[1], o, d)):
        t = t.numpy()
        assert np.mean(np.isfinite(t) != hit) < 0.03
        both = np.isfinite(t) & hit
        assert np.median(np.abs(t[both] - expected[both])) < 5e-3


def test_records_and_models_of_earlier_runs(mi_rgb, tmp_path):
    """Errors of an earlier run stand for contenders that are not timed; those that are timed need their files."""
    settings = SimpleNamespace(sizes=(24576, 32768), without=("ours", "indirection", "paper", "hash"), ablation=False,
                               **{**sdf.FULL, "points": 2**10})  # fmt: skip
    plan = sdf.plan(Ball.mesh, "ball.ply", settings)
    names = [job.name for job in plan.jobs]
    assert names[:2] == ["dense grid 24 KiB", "dense grid, trained 24 KiB"] and len(names) == 8
    before = {name: {"name": name} for name in names}
    jobs = sdf.plan(Ball.mesh, "ball.ply", settings, before).jobs
    assert [job.cached_record(tmp_path, None) for job in jobs] == [None] * 4 + list(before.values())[4:]
    job = plan.jobs[0]
    record = job.run(tmp_path, False) if job.cached_record(tmp_path, None) is None else None
    assert 0.8 * 24576 < record["bytes"] <= 24576 and record["errors"]["iou"] > 0.9
    assert job.cached_record(None, record) is None and job.cached_record(tmp_path, record) == record
    assert (job.model.spacing, job.model.slope) == (record["details"]["spacing"], record["details"]["slope"])
