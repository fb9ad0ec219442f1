"""``fit sdf``, ``decode`` and ``inspect``: presets, sizes, interruptions, damaged files, and how they refuse."""

import json
import os
import signal

import drjit as dr
import numpy as np
import pytest
import trimesh
from sdf_fields import TrilinearField
from solid_meshes import box, sphere, together, write

from mi_diffind.arrays.indirection import DifferentiableArray, Indirection, ramp
from mi_diffind.arrays.tables import StoredArray, TableError, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import fit, tasks
from mi_diffind.tasks.sdf import fit as sdf_fit
from mi_diffind.tasks.sdf import paper
from mi_diffind.tasks.sdf.distances import Distances
from mi_diffind.tasks.sdf.evaluation import SurfaceEvaluation
from mi_diffind.tasks.sdf.marching import trace
from mi_diffind.tasks.sdf.mesh import load_mesh
from mi_diffind.tasks.sdf.model import SdfModel

BYTES = 96 * 1024
SHORT = ["--steps", "60", "--batch", "16384", "--variant", "llvm_ad_rgb"]


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


@pytest.fixture(scope="module", autouse=True)
def few_points():
    """Short trainings need no large sets to measure with."""
    patch = pytest.MonkeyPatch()
    patch.setattr(sdf_fit.fit, "__defaults__", (2**14, 2**16, 2**12))
    patch.setattr(SdfModel.measure, "__defaults__", (None, 2**14))
    yield
    patch.undo()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A ball and a box apart from it, twice as large as the unit frame and off its middle, and its file."""
    path = tmp_path_factory.mktemp("sdf")
    mesh = together(sphere(32, 0.8, (3, 0.2, 0)), box((0.3, 0.7, 0.5), (4.2, 0.1, -0.1)))
    write(path / "solids.ply", mesh)
    assert main(["fit", "sdf", str(path / "solids.ply"), "-o", str(path / "solids.npz"), "--bytes", str(BYTES),
                 "--json", str(path / "fit.json"), *SHORT]) == 0  # fmt: skip
    return path


@pytest.fixture(scope="module")
def evaluation(folder):
    mesh = load_mesh(folder / "solids.ply")
    with Distances(mesh) as distances:
        yield SurfaceEvaluation(mesh, distances, 2**16)


def opened(path, ad):
    return tasks()["sdf"].open(ad.TensorXf, path)


# -- what comes out ----------------------------------------------------------------------------------------------------


def test_size_and_accuracy(folder, evaluation, ad):
    """Bytes are within 3% of those asked for; errors are below those of a dense grid of as many bytes."""
    report = json.loads((folder / "fit.json").read_text())
    model = opened(folder / "solids.npz", ad)
    assert 0.97 * BYTES <= model.memory_nbytes <= BYTES
    assert report["bytes_asked"] == BYTES and report["mesh_bytes"] == 12 * (1994 + 3980)
    result = evaluation.measure(model.field)
    for key, value in report["measured"].items():
        assert value == pytest.approx(result[key], rel=0.25 if "iou" not in key else 5e-3), key

    distances, mesh = evaluation.distances, evaluation.mesh
    h = ((mesh.upper - mesh.lower + 0.04).prod() / BYTES) ** (1 / 3)
    shape = np.floor((mesh.upper - mesh.lower + 0.04) / h).astype(int) + 1
    axes = [a - 0.02 + h * np.arange(n) for a, n in zip(mesh.lower, shape, strict=True)]
    grid = distances.signed(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)).reshape(shape)
    grid = np.round(np.clip(grid / (2 * h), -1, 1) * 127) / 127 * (2 * h)
    assert grid.size <= 1.1 * BYTES
    dense = evaluation.measure(
        TrilinearField(ad.TensorXf(grid.astype(np.float32)), mesh.lower - 0.02, [a[-1] for a in axes], 2 * h)
    )
    assert 1 - result["iou_near"] < 0.5 * (1 - dense["iou_near"])
    assert result["normal_deg"] < 0.7 * dense["normal_deg"]
    assert result["iou"] > 0.997 and result["normal_deg"] < 2


def test_training_earns_its_place(folder, evaluation, ad):
    """Errors are below those of sampled nodes that were coded without training."""
    sampled = fit("sdf", source=str(folder / "solids.ply"), bytes=str(BYTES), steps=1, batch=16384, lr=1e-9,
                  variant="llvm_ad_rgb", progress=False)  # fmt: skip
    before = evaluation.measure(tasks()["sdf"].model(sampled.table, ad.TensorXf).field)
    after = evaluation.measure(opened(folder / "solids.npz", ad).field)
    assert 1 - after["iou_near"] < 0.95 * (1 - before["iou_near"])
    assert after["normal_deg"] < 1.1 * before["normal_deg"]


@pytest.mark.parametrize("preset", ["dense", "paper"])
def test_presets_of_the_supplement(folder, evaluation, ad, preset, tmp_path):
    path = tmp_path / "pair.npz"
    command = ["fit", "sdf", str(folder / "solids.ply"), "--bytes", str(BYTES), "--preset", preset, *SHORT]
    assert main([*command, "-o", str(path)]) == 0
    table = load_table(path)
    assert 0.8 * BYTES <= table.nbytes <= BYTES and table.storage == "uint8"
    primary, cascaded = table.arrays["primary"].shape, table.arrays["cascaded"].shape
    assert primary[-1] == 3 and 1.7 < max(primary[:3]) / max(cascaded[:3]) < 2.4  # Table 5 at 6 MB: 2
    result = evaluation.measure(opened(path, ad).field)
    assert result["iou"] > 0.95 and result["iou_near"] > 0.85


def test_start_from_nearest_samples(rng):
    """The cascaded array begins with the truncated distance of the nearest sample: against all distances."""
    samples = rng.random((300, 3))
    distances = rng.uniform(-0.2, 0.2, 300)
    net = paper.initial("ramp", (6, 5, 4), (4, 3, 3), None, samples, distances, 0.1)
    entries = np.asarray(net.cascaded.init)
    for index in np.ndindex(4, 3, 3):
        place = np.array(index) / (np.array([4, 3, 3]) - 1)
        nearest = np.argmin(np.linalg.norm(samples - place, axis=1))
        assert entries[index][0] == pytest.approx(np.clip(distances[nearest] / 0.1, -1, 1) / 2 + 0.5, abs=1e-6)


def test_the_bound_of_the_slope_follows_entries(ad, rng):
    """Bounds before and after a change of the entries, against small steps all over the box.

    Steps are steepest where the pointers of a cell reach neither first nor last.
    """
    arrays = ramp((4, 4, 4), 3, ("clamp",) * 3) + 0.02 * rng.random((4, 4, 4, 3)), 0.05 * rng.random((9, 9, 9, 1))
    arrays[1][4, 4, 4] = 1
    net = Indirection(*(DifferentiableArray(a.shape[:3], a.shape[3], a) for a in arrays)).alloc(ad.TensorXf)
    field = paper.PairField(ad, net, (-0.5, -0.4, -0.3), (0.5, 0.4, 0.3), 0.2, 1.0)
    p = rng.uniform(field.lower, field.upper, (100000, 3))
    d = rng.normal(size=p.shape)
    p, d = (ad.Array3f(*v.T.astype(np.float32)) for v in (p, 1e-4 * d / np.linalg.norm(d, axis=1, keepdims=True)))
    bounds = []
    for factor in (1, 3):
        net.cascaded.data = net.cascaded.data * factor
        field.update_bound()
        steps = dr.abs(field.value(p + d) - field.value(p - d)) / 2e-4
        steepest = dr.max(dr.select(field.inside(p + d) & field.inside(p - d), steps, 0))[0]
        bounds.append(field.slope)
        assert field.bound[0] == np.float32(field.slope)
        assert 0.3 * bounds[-1] < steepest <= 1.01 * bounds[-1]
    assert bounds[1] == pytest.approx(3 * bounds[0])


def test_files_with_bounds_of_empty_regions(folder, tmp_path, ad, rng):
    """Earlier files hold a bound of the distance above an empty region's sign: it is ignored."""
    table = load_table(folder / "solids.npz")
    damaged(table, "regions", lambda a: a.__setitem__(a != 255, a[a != 255] | 6))
    save_table(tmp_path / "old.npz", table)
    fields = [opened(path, ad).field for path in (folder / "solids.npz", tmp_path / "old.npz")]
    p = ad.Array3f(*rng.uniform(fields[0].lower, fields[0].upper, (20000, 3)).T.astype(np.float32))
    assert np.array_equal(*(field.value(p).numpy() for field in fields))
    origin, direction = ad.Array3f(-2 * p), ad.Array3f(dr.normalize(p))
    assert np.array_equal(*(trace(field, origin, direction, 9.0)[0].numpy() for field in fields))


def test_decode_and_inspect(folder, tmp_path, capsys):
    file, out = str(folder / "solids.npz"), tmp_path / "mesh.ply"
    assert main(["decode", file, "-o", str(out), "--resolution", "160"]) == 0
    result, truth = trimesh.load(out), trimesh.load(folder / "solids.ply")
    assert result.is_watertight and result.body_count == truth.body_count == 2
    assert result.volume == pytest.approx(truth.volume, rel=0.01)
    assert np.allclose(result.bounds, truth.bounds, atol=0.02)  # in units and place of the file
    assert main(["decode", file, "-o", str(tmp_path / "grid.npz"), "--resolution", "32"]) == 0
    with np.load(tmp_path / "grid.npz") as grid:
        assert grid["distance"].ndim == 3 and grid["distance"].min() < 0
        assert np.all(grid["lower"] < truth.bounds[0]) and np.all(grid["upper"] > truth.bounds[1])
    assert main(["inspect", file, "--json", str(tmp_path / "i.json")]) == 0
    report = json.loads((tmp_path / "i.json").read_text())
    assert report["layout"] == "sparse" and report["nodes"] > 1000 and report["slope"] >= 1
    assert "nodes in" in capsys.readouterr().out
    assert main(["inspect", file, "--measure"]) == 0


def test_resumed_equals_uninterrupted(folder, tmp_path, monkeypatch):
    """Ctrl-C in the middle of a training; and the same command gives the same file."""
    whole = folder / "solids.npz"
    command = ["fit", "sdf", str(folder / "solids.ply"), "--bytes", str(BYTES), *SHORT]
    original, calls = sdf_fit.NodeProblem.loss, []

    def loss(self, *arguments):
        calls.append(1)
        if len(calls) == 50:
            os.kill(os.getpid(), signal.SIGINT)
        return original(self, *arguments)

    monkeypatch.setattr(sdf_fit.NodeProblem, "loss", loss)
    checkpoint = str(tmp_path / "c.npz")
    part = folder / "part.npz"
    assert main([*command, "-o", str(part), "--checkpoint", checkpoint]) == 130
    assert load_table(part).measured["iou"] > 0.99  # what was there is kept
    assert main([*command, "-o", str(part), "--checkpoint", checkpoint, "--resume"]) == 0
    assert part.read_bytes() == whole.read_bytes()


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["none.ply"], "none.ply: there is no such file"),
        (["solids.ply", "--bytes", "200"], "--bytes: found 200 bytes, the smallest of"),
        (["solids.ply", "--bytes", "lots"], "is not a number of bytes"),
        (["solids.ply", "--ratio", "2"], "--ratio: found the preset sparse, allowed are dense and paper"),
        (["solids.ply", "--constant"], "--constant: found the preset sparse, allowed is paper"),
        (["solids.ply", "--preset", "paper", "--bytes", "20"], "--bytes: found 20 bytes, the smallest arrays need"),
        (["solids.ply", "--bits", "7"], "invalid choice"),
    ],
)
def test_refused(folder, tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(folder)
    out = tmp_path / "x.npz"
    try:
        code = main(["fit", "sdf", *arguments, "-o", str(out), *SHORT])
    except SystemExit as e:
        code = e.code
    assert code == 2 and says in capsys.readouterr().err and not out.exists()


def damaged(table, name, change):
    array = table.arrays[name]
    entries = array.entries.copy()
    change(entries)
    table.arrays[name] = StoredArray(entries, array.border, array.scale, array.offset, array.bits)


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("blocks", lambda a: a[0].__setitem__(slice(0, 8), 255), "its masks have"),
        ("region_masks", lambda a: a[0].__setitem__(slice(0, 8), 255), "blocks have nodes, found masks for"),
        ("regions", lambda a: a.__setitem__(a == 255, 0), "is damaged"),
        ("pointers", lambda a: a.__setitem__(slice(None), 255), "a pointer names entry 1023"),
        ("entries", lambda a: a.__setitem__((0, 0), np.nan), "NaN"),
        ("spacing", -1, 'its setting "spacing" is -1, expected a positive number'),
        ("lower", [0, 1], 'its setting "lower" is'),
        ("bits", 9, "is damaged"),
        ("layout", "octree", "has the layout 'octree'"),
    ],
)
def test_damaged_files(folder, tmp_path, name, change, says, ad):
    table, path = load_table(folder / "solids.npz"), tmp_path / "damaged.npz"
    if name == "pointers":  # entries that no pointer may name
        damaged(table, "entries", lambda a: None)
        array = table.arrays["entries"]
        table.arrays["entries"] = StoredArray(array.entries[:100])
    if callable(change):
        damaged(table, name, change)
    else:
        table.settings[name] = change
    try:
        save_table(path, table)
        opened(path, ad)
    except TableError as e:
        assert says in str(e) and "\n" not in str(e)
    else:
        pytest.fail("it was read")


# -- hard cases --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extent", [(1, 1, 20), (2**-20, 2**-20, 2**-19)])
def test_extents_and_scales(tmp_path, ad, extent):
    """A box of 1:1:20 and a tiny one: its middle and sides are where they ought to be."""
    source = write(tmp_path / "box.ply", box(extent, (5 * extent[0], 0, 0)))
    done = fit("sdf", source=str(source), bytes="24k", steps=10, batch=4096, variant="llvm_ad_rgb", progress=False)
    model = tasks()["sdf"].model(done.table, ad.TensorXf)
    assert done.table.measured["iou"] > 0.98
    middle = (np.array([5 * extent[0], 0, 0]) - model.centre) / model.scale
    p = ad.Array3f(*(middle[:, None] + np.array([[0, 0.49, 0.51], [0, 0, 0], [0, 0, 0]]) * extent[0] / model.scale))
    assert np.array_equal(model.field.value(p).numpy() < 0, [True, True, False])


def test_one_triangle_and_thin_solids(tmp_path):
    """Meshes that enclose no volume, or less than a cell, are refused."""
    write(tmp_path / "one.obj", (np.eye(3), np.array([[0, 1, 2]])))
    write(tmp_path / "sheet.ply", box((1, 1, 1e-4)))
    for name, says in (("one.obj", "one.obj"), ("sheet.ply", "thinner than the cells of 32,768 bytes")):
        with pytest.raises(Exception, match=says) as e:
            fit("sdf", source=str(tmp_path / name), bytes="32k", steps=2, batch=64, variant="llvm_ad_rgb",
                progress=False)  # fmt: skip
        assert "\n" not in str(e.value)
