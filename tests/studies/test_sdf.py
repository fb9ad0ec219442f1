"""
``tradeoff sdf``: baselines of distance fields against trilinear interpolation by NumPy and distances by formulas.

Also the files and sentences of the study.
"""

import json
import math
from types import SimpleNamespace

import drjit as dr
import drjit.llvm.ad as T
import numpy as np
import pytest
import solid_meshes as solids

from mi_diffind.commands.cli import main
from mi_diffind.fitting import loop, task
from mi_diffind.measure import benchmark
from mi_diffind.studies.baselines import bricks, byte_grids, direct_nodes, hash_grids, volumes
from mi_diffind.studies.sdf import conclusions, contenders, parts
from mi_diffind.studies.sdf.contenders import DistanceStudySettings
from mi_diffind.studies.sdf.plan import plan as plan_of
from mi_diffind.studies.sdf.view import MeshView, scene_distance, traced_distance
from mi_diffind.tasks.sdf import encoding, marching, nodes
from mi_diffind.tasks.sdf.fit import NodeProblem
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
    "dense": lambda h, train=False: byte_grids.dense(T, Torus(), h, train),
    "4³": lambda h: bricks.bricks(T, Torus(), h, 4),
    "8³": lambda h: bricks.bricks(T, Torus(), h, 8),
    "4³ shared": lambda h: bricks.bricks(T, Torus(), h, 4, False),
    "nodes": lambda h, train=False: volumes.distance_nodes(T, Torus(), h, train),
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


@pytest.mark.parametrize("name", [name for name in MAKERS if name != "nodes"])  # which are not sphere-traced
def test_no_sign_changes_within_a_step(fields, name, rng):
    field = fields[name]
    points = rng.uniform(Torus.mesh.lower, Torus.mesh.upper, (20000, 3))
    d = rng.normal(size=points.shape)
    d[::3] = np.eye(3)[rng.integers(3, size=len(d[::3]))] * rng.choice([-1, 1], (len(d[::3]), 1))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    value, step = field.safe_step(arrays(points), arrays(d))
    value, step = value.numpy(), step.numpy()
    assert np.array_equal(value < 0, field.value(arrays(points)).numpy() < 0)
    assert np.isfinite(step).all() and (step >= 0).all() and step.mean() > 0.2 * field.spacing
    for share in np.linspace(0.05, 1, 12):
        there = points + d * np.maximum(share * step - 2e-3 * field.spacing, 0)[:, None]
        near = np.abs(field.value(arrays(there)).numpy()) < 1e-5
        assert np.array_equal((field.value(arrays(there)).numpy() < 0)[~near], (value < 0)[~near]), share


def test_bytes_count_nodes_and_index(fields):
    dense, aprons, shared = (fields[n] for n in ("dense", "4³", "4³ shared"))
    assert dense.nbytes == np.prod([n + 1 for n in dense.cells])
    groups = math.prod(-(-n // 4) for n in aprons.state["present"].shape)
    kept = dr.width(aprons.ranks) // 2
    assert aprons.nbytes == 125 * aprons.count + 24 * kept + 4 * -(-groups // 2)
    assert shared.nbytes == 64 * shared.count + shared.index_bytes
    # No brick more than those with both signs
    assert aprons.count == sum((b < 128).any() and (b >= 128).any() for b in aprons.state["nodes"])


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
    found = byte_grids.least_squares(Plane(), lower, 0.1, (10,) * 3, keys, values)
    assert np.abs(found - values).max() < 1e-6
    off = values + 0.03 * np.sin(np.arange(1000)).astype(np.float32)
    found = byte_grids.least_squares(Plane(), lower, 0.1, (10,) * 3, keys, off, keep=1e-6)
    changed = found != off
    assert 100 < changed.sum() < 900
    assert np.abs(found - values)[changed].max() < 1e-3


class Ball(Torus):
    """A ball's distances, with a mesh."""

    mesh = surface = make_mesh(*solids.sphere(24), "ball.ply")
    warnings = ()

    def signed(self, p, limit=math.inf):
        return np.clip(np.linalg.norm(p, axis=1) - 0.5, -limit, limit).astype(np.float32)


@pytest.mark.parametrize("side, apron", [(4, True), (4, False), (1, False)])
def test_as_fine_as_the_bytes_allow(side, apron):
    def make(h):
        return bricks.bricks(T, Ball(), h, side, apron) if side > 1 else volumes.distance_nodes(T, Ball(), h)

    found = volumes.fit_bytes(make, 60000)
    assert 0.97 * 60000 <= found.nbytes <= 60000
    with pytest.raises(ValueError, match="too few"):
        volumes.fit_bytes(make, 10)


def test_dense_size():
    grid = byte_grids.dense(T, Ball(), byte_grids.dense_spacing(Ball.mesh, 50000))
    assert 0.8 * 50000 < grid.nbytes <= 50000


def test_files_of_fields(fields, tmp_path, rng):
    points = arrays(rng.uniform(-0.5, 0.5, (5000, 3)))
    for i, (name, field) in enumerate(fields.items()):
        path = tmp_path / f"{i}.npz"
        size = volumes.save(path, field)
        found = volumes.load(path, T)
        assert np.array_equal(found.value(points).numpy(), field.value(points).numpy()), name
        assert (found.nbytes, found.slope) == (field.nbytes, field.slope)
        assert path.stat().st_size == size == volumes.save(None, field)


def test_normals_are_the_nearest_that_can_be_stored(rng):
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    side = direct_nodes.SIDE
    every = direct_nodes.octahedral(np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2))
    assert np.abs(np.linalg.norm(every, axis=1) - 1).max() < 1e-12
    assert direct_nodes.LEVELS * side**2 <= 2**16
    found = np.sum(direct_nodes.octahedral(direct_nodes.to_octahedral(normals)) * normals, axis=1)
    best = (normals @ every.T).max(axis=1)
    assert np.mean(found < best - 1e-9) < 0.02 and np.degrees(np.arccos(found)).mean() < 90 / side


def test_nodes_without_indirection(rng, tmp_path):
    """What they say is what was stored, by NumPy; no node changes its side; files; bytes."""
    sampled = encoding.sample(Ball(), 1 / 24)
    coding = direct_nodes.DirectCoding(sampled)
    count = sampled.structure.nodes
    off = np.concatenate([sampled.distances[:, None] + rng.normal(0, 0.3, (count, 1)), sampled.normals], axis=1)
    coding.encode(off)
    values = coding.values().astype(np.float64)
    assert np.array_equal(values[:, 0] < 0, sampled.distances < 0)
    assert (np.abs(values[:, 0]) >= coding.least - 1e-6).mean() > 0.99
    step, kept = 2 * byte_grids.NEAREST / direct_nodes.LEVELS, np.abs(off[:, 0]) < byte_grids.NEAREST
    kept &= ((off[:, 0] < 0) == (sampled.distances < 0)) & (coding.least == encoding.LEAST)
    assert kept.mean() > 0.5 and np.abs(values - off)[kept, 0].max() < 0.51 * step
    field = coding.field(T)
    assert field.nbytes == coding.nbytes == sampled.structure.nbytes + 4 * -(-count // 2)
    cells = sampled.corners[rng.integers(len(sampled.corners), size=2000)]
    place = rng.random((len(cells), 3))
    h, lower = field.spacing, np.array(sampled.structure.lower)
    points = lower + (sampled.positions[cells[:, 0]] + place) * h
    expected = 0
    for n, corner in enumerate(CORNERS):
        d, g = values[cells[:, n], 0], values[cells[:, n], 1:]
        weight = np.prod(np.where(corner == 1, place, 1 - place), axis=1)
        expected = expected + weight * (d + 0.5 * np.sum(g * (place - corner), axis=1))
    found = field.value(arrays(points)).numpy()
    assert np.abs(found - h * expected.clip(-2, 2)).max() < 1e-5
    away = rng.normal(size=(3000, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    t, hit = marching.trace(field, arrays(0.9 * away), arrays(-away), math.inf)
    met = (0.9 - t.numpy()[:, None]) * away
    assert hit.numpy().all() and np.abs(np.linalg.norm(met, axis=1) - 0.5).max() < 1.5 * h
    assert np.abs(field.value(arrays(met)).numpy()).max() < 1e-4
    volumes.save(tmp_path / "a.npz", field)
    again = volumes.load(tmp_path / "a.npz", T, direct_nodes.DirectNodes)
    assert np.array_equal(again.value(arrays(points)).numpy(), found) and again.slope == field.slope


def test_hash_grid(rng):
    net = hash_grids.network(40000)
    lower, upper = Ball.mesh.lower - 0.01, Ball.mesh.upper + 0.01
    pools = [hash_grids.pool(Ball(), lower, upper, n, n) for n in (2**13, 2**10)]
    problem = hash_grids.HashProblem(net, T, Ball.mesh, *pools)
    field = problem.field
    assert 0.8 * 40000 < field.nbytes <= 40000
    start = problem.measure(problem.net)["psnr_db"]
    from mi_diffind.fitting.loop import FitSettings, fit

    entries = problem.net.entries.numpy()
    fit(problem, FitSettings(seed=1, steps=80, batch=2**11, lr=1e-2, loss="mae", measure_every=80), progress=False)
    assert problem.measure(problem.net)["psnr_db"] > start + 6
    assert not np.array_equal(problem.net.entries.numpy(), entries)  # the grid learns, too
    hash_grids.halved(problem.net)
    assert np.array_equal(problem.net.entries.numpy(), problem.net.entries.numpy().astype(np.float16))
    points = rng.uniform(-0.4, 0.4, (200, 3))
    _, found = field.gradient(arrays(points))

    def unclipped(p):
        return field.net([x - a for x, a in zip(arrays(p), field.lower, strict=True)])[0].numpy() * hash_grids.BAND

    for axis in range(3):
        e = 1e-4 * np.eye(3)[axis]
        difference = (unclipped(points + e) - unclipped(points - e)) / 2e-4
        assert np.median(np.abs(difference - found[axis].numpy())) < 0.02
    with pytest.raises(NotImplementedError):
        field.safe_step(arrays(points), arrays(points))


# -- the study --------------------------------------------------------------------------------------------------------

LEFT_OUT = [k for k in contenders.METHODS if k not in ("bricks4", "ours")]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The mesh, a ball that is flat on top, and the results of a quick run."""
    folder = tmp_path_factory.mktemp("sdf")
    vertices, faces = solids.sphere(16)
    vertices[:, 2] = np.minimum(vertices[:, 2], 0.64 + 0.2 * vertices[:, 2])
    solids.write(folder / "dent.ply", (vertices, faces))
    with pytest.MonkeyPatch.context() as patch:
        small = benchmark.BenchmarkSettings(2**10, 2, 1, 2**10, True)
        patch.setattr(benchmark.BenchmarkSettings, "choose", classmethod(lambda cls, variant, quick=False: small))
        assert main([*command(folder), "--json", str(folder / "r.json")]) == 0
    return folder


def command(folder, *more):
    left_out = [x for kind in LEFT_OUT for x in ("--without", kind)]
    return ["tradeoff", "sdf", str(folder / "dent.ply"), "--quick", "--bytes", "24k", *left_out,
            "--out", str(folder / "out"), "--variant", "llvm_ad_rgb", *more]  # fmt: skip


def test_what_is_written(finished):
    result = json.loads((finished / "r.json").read_text(encoding="utf-8"))
    made = {n: c for n, c in result["candidates"].items() if not c["is_reference"]}
    assert set(made) == {"4³ bricks 24 KiB", "ours 24 KiB"}
    for name, c in made.items():
        e = c["errors"]
        assert 0.5 * 24576 < c["bytes"] <= 24576 and c["details"]["file_bytes"] > 0, name
        assert 0.9 < e["iou"] < 1 and e["iou_db"] == pytest.approx(-10 * math.log10(1 - e["iou"]))
        assert 0 < e["normal_deg"] < e["normal_p95_deg"] < 40 and 0 < e["mae_near"] < 0.01
    rays = result["cases"]["rays"]
    assert set(rays["queries"]["ray"]) == set(rays["passes"]["render"]) == {*made, "mesh (Embree)", "sdfgrid 32³"}
    assert set(result["cases"]["reads"]["queries"]) == {"value", "normal"}
    out = finished / "out"
    assert (out / "tradeoff_sdf_shapes.png").stat().st_size > 20_000
    assert len(list((out / "tradeoff_sdf_models").glob("*.npz"))) == 2
    assert result["conclusions"][0].startswith("24 KiB: ")


@pytest.fixture(scope="module")
def planned(finished):
    """The plan for two budgets, the first of which is that of the folder's run, and its records of an earlier run."""
    import mitsuba as mi

    from mi_diffind.tasks.sdf.mesh import load_mesh

    assert mi.variant() == "llvm_ad_rgb"
    settings, before = DistanceStudySettings((24576, 32768), tuple(LEFT_OUT)), {}
    return plan_of(load_mesh(finished / "dent.ply"), str(finished / "dent.ply"), settings, before), before


def test_trained_models_are_cached(finished, planned):
    result = json.loads((finished / "r.json").read_text(encoding="utf-8"))
    jobs = planned[0].jobs[:2]
    assert [job.name for job in jobs] == list(result["jobs"])
    models = finished / "out" / "tradeoff_sdf_models"
    for job in jobs:
        record = result["jobs"][job.name]
        assert job.cached_record(models, None) is None and job.cached_record(None, record) is None
        assert job.cached_record(models, record) == record
        assert (job.model.spacing, job.model.slope) == (record["details"]["spacing"], record["details"]["slope"])


def test_fields_and_meshes_are_in_one_place(finished):
    """The rays of fields, of the mesh and of the decoded grid meet surfaces in the same places."""
    import mitsuba as mi

    from mi_diffind.tasks.sdf.mesh import load_mesh

    mesh = load_mesh(finished / "dent.ply")
    view = MeshView(mesh, (64, 48))
    model = volumes.load(next((finished / "out" / "tradeoff_sdf_models").glob("4*bricks*.npz")), T)
    o, d = view.rays(mi)
    scenes = view.mesh_scene(), view.grid_scene(model, 48)  # what is not evaluated yet needs them
    expected = scene_distance(scenes[0], o, d).numpy()
    hit = np.isfinite(expected)
    assert 0.2 < hit.mean() < 0.8
    for t in (traced_distance(model, o, d), scene_distance(scenes[1], o, d)):
        t = t.numpy()
        assert np.mean(np.isfinite(t) != hit) < 0.03
        both = np.isfinite(t) & hit
        assert np.median(np.abs(t[both] - expected[both])) < 5e-3


def test_trained_in_other_ways():
    """Nodes move in the usual training, and stay as sampled without one."""
    settings, moved = loop.FitSettings(steps=10, batch=2**10, lr=1e-2, measure_every=10), []
    for request in (task.FitRequest, parts.UntrainedRequest):
        sampled = encoding.sample(Ball(), 1 / 12)
        field = nodes.SparseNodes(T, sampled.structure, 1.0)
        problem = NodeProblem(field, Ball.mesh, sampled, 10, SimpleNamespace(measure=lambda field: {"x": 0.0}))
        request("sparse", settings, T, progress=False).train(problem)
        moved.append(np.abs(problem.values()[:, 0] - sampled.distances).max() > 1e-3)
    assert moved == [True, False]


def test_parts_are_jobs(tmp_path):
    """Which there are; those without indirection are made and known again."""
    made = ("untrained", "direct", "direct-untrained")
    without = tuple(kind for kind in contenders.PARTS if kind not in made)
    plan = plan_of(Ball.mesh, "ball.ply", DistanceStudySettings((24576,), without, True, 2**10, 10))
    assert [c.details["kind"] for c in plan.candidates] == list(made) and [c.name for c in plan.cases] == ["reads"]
    assert (plan.jobs[0].preset, isinstance(plan.jobs[0], parts.UntrainedContender)) == ("", True)
    records = []
    for job in plan.jobs[1:]:
        job.context.distances, job.context.errors = Ball(), lambda field: {}
        assert job.cached_record(tmp_path, None) is None
        records.append(job.run(tmp_path, False))
        assert 0.9 * 24576 < records[-1]["bytes"] <= 24576
        field = job.model
        assert job.cached_record(tmp_path, records[-1]) == records[-1] and job.model is not field
        assert (job.model.nbytes, job.model.slope) == (field.nbytes, field.slope)
    assert [r["details"]["steps"] for r in records] == [10, 0]
    assert not np.array_equal(*(job.model.state["numbers"] for job in plan.jobs[1:]))


def test_errors_of_an_earlier_run(finished, planned):
    """They stand for contenders that are not timed; those that are timed are trained unless their files are there."""
    jobs, before, models = planned[0].jobs, planned[1], finished / "out" / "tradeoff_sdf_models"
    assert [job.cached_record(models, None) for job in jobs] == [None] * 4
    before |= {job.name: {"name": job.name} for job in jobs}
    assert [job.cached_record(models, None) for job in jobs] == list(before.values())
    assert [job.cached_record(None, None) for job in jobs] == [None, None, *list(before.values())[2:]]
    assert jobs[0].cached_record(models, {"own": 1}) == {"own": 1}


def result_of(**errors):
    """A result with candidates of 1 MiB: kind → errors."""
    made = {
        f"{contenders.METHODS[kind]} 1 MiB": {
            "errors": {"iou": 0.99, "iou_near": 0.98, "normal_deg": 4.0, "normal_p95_deg": 9.0, "mae_near": 1e-4,
                       "normal_smooth_deg": 4.0, **e},
            "details": {"kind": kind, "asked": 2**20, "file_bytes": 5}, "bytes": 2**20, "training_seconds": 1.0,
            "label": contenders.METHODS[kind], "is_reference": False,
        }
        for kind, e in errors.items()
    }  # fmt: skip
    return {"candidates": made, "cases": {}, "details": {"first": 2**20, "source": "x", "triangles": 7}, "notes": [""]}


def test_verdicts():
    ahead = result_of(ours={"iou": 0.999, "iou_near": 0.99, "normal_deg": 3.0}, bricks4={}, dense={"iou": 0.98})
    (line,) = conclusions.conclusions(ahead)
    assert line.startswith(
        "1 MiB: ours is ahead of all others in IoU and in normals. IoU 0.9990 against 0.9900 (4³ bricks)"
    )
    behind = result_of(ours={"iou": 0.999, "normal_deg": 3.0}, bricks4={}, dense={"iou_near": 0.985})
    (line,) = conclusions.conclusions(behind)
    assert line.startswith("1 MiB: not ahead in IoU near. ") and "IoU near 0.9800 against 0.9850 (dense grid)" in line
    lines = conclusions.table(behind)
    assert lines[0] == "x: 7 triangles" and sum(line.startswith("ours 1 MiB") for line in lines) == 1


def test_sentences_about_times():
    result = result_of(ours={}, bricks4={})
    rays = {"ours 1 MiB": {"time": 200.0}, "4³ bricks 1 MiB": {"time": 100.0}}
    ratios = {"ours 1 MiB / 4³ bricks 1 MiB": {"median": 2.0}, "ours 1 MiB / mesh (Embree)": {"median": 4.5}}
    result["cases"] = {
        "rays": {"queries": {"ray": rays}, "passes": {}, "ratios": {"ray": ratios}},
        "reads": {"queries": {"value": rays, "normal": rays}},
    }
    ray, read = conclusions.conclusions(result)[1:]
    assert ray == (
        "A primary ray with ours 1 MiB takes 200 ns: 2.00 times that of 4³ bricks 1 MiB and 4.50 times that of mesh "
        "(Embree)."
    )
    assert read.endswith("the fastest is 4³ bricks 1 MiB: 100 and 100 ns.")


@pytest.mark.parametrize(
    "options, message",
    [
        (["--bytes", "0"], "0"),
        (["--without", "bricks"], '--without: found "bricks", allowed are dense, dense-trained'),
        (["--ablation", "--without", "hash"], '--without: found "hash", allowed are ours, bits6'),
        (["--errors-of", "none.json"], "--errors-of: none.json is not a file that --json wrote of this study"),
    ],
)
def test_bad_options(tmp_path, options, message, capsys):
    solids.write(tmp_path / "ball.ply", solids.sphere(8))
    assert main(["tradeoff", "sdf", str(tmp_path / "ball.ply"), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_errors_of_another_mesh(finished, tmp_path, capsys):
    solids.write(tmp_path / "ball.ply", solids.sphere(8))
    assert main(["tradeoff", "sdf", str(tmp_path / "ball.ply"), "--errors-of", str(finished / "r.json")]) == 2
    assert "is of another mesh than" in capsys.readouterr().err
    assert main(["tradeoff", "sdf", str(finished / "dent.ply"), "--errors-of", str(finished / "r.json")]) == 2
    assert "is of a run with --quick" in capsys.readouterr().err


def test_no_mesh(tmp_path, capsys):
    assert main(["tradeoff", "sdf", str(tmp_path / "none.ply"), "--out", str(tmp_path / "out")]) == 2
    assert "there is no such file, expected a mesh" in capsys.readouterr().err
