"""The plugin ``neural_sdf``: files, places, the two ways in which it is traced, what it refuses."""

import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from weakref import WeakValueDictionary

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from sdf_fields import dense_table, sparse_table, torus
from variants import warnings_of

from mi_diffind import plugins
from mi_diffind.arrays.tables import load_table, save_table
from mi_diffind.core import compat
from mi_diffind.scenes import loading
from mi_diffind.scenes.loading import SceneError
from mi_diffind.tasks.sdf.mesh import load_mesh

SCALE, CENTRE = 2.0, (0.5, -1.0, 0.25)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """``torus.npz`` and the mesh ``torus.ply`` that its settings name."""
    import trimesh

    path = tmp_path_factory.mktemp("sdf")
    table = sparse_table(scale=SCALE, centre=CENTRE)
    mesh = trimesh.creation.torus(0.38, 0.12, 96, 48)
    mesh.apply_scale(SCALE)
    mesh.apply_translation(CENTRE)
    mesh.export(path / "torus.ply")
    table.settings["mesh_path"] = "torus.ply"
    save_table(path / "torus.npz", table)
    return path


@pytest.fixture(scope="module")
def dense(tmp_path_factory):
    """The torus in two dense arrays."""
    path = tmp_path_factory.mktemp("dense") / "dense.npz"
    save_table(path, dense_table(scale=SCALE, centre=CENTRE))
    return path


def shape(folder, **more):
    return {"type": "neural_sdf", "filename": str(folder / "torus.npz"), **more}


def scene(mi, shapes, integrator="path_sdf", **more):
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 48, "height": 32, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 45, "to_world": at().look_at([0, -3, 2.5], [0.5, -1, 0.2], [0, 0, 1])}
    return mi.load_dict({
        "type": "scene",
        "lamp": {"type": "point", "position": [-2, -4, 5], "intensity": 40.0},
        "sky": {"type": "constant", "radiance": 0.3},
        "sensor": {**sensor, "film": film},
        "integrator": {"type": integrator, "max_depth": 4},
        **shapes,
        **more,
    })  # fmt: skip


def rays(rng, count=4096):
    """From around the torus in the unit frame towards it: origins and directions."""
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return rng.uniform(-0.4, 0.4, (count, 3)) * [1, 1, 0.3] - 2 * d, d


def analytic(o, d):
    """The first zero of the torus' distance along rays, or infinity: sphere tracing in double precision."""
    t = np.zeros(len(o))
    for _ in range(400):
        step = torus(o + t[:, None] * d)[0]
        t = np.where(t < 6, t + step, t)
    return np.where((t < 6) & (np.abs(torus(o + t[:, None] * d)[0]) < 1e-6), t, np.inf)


def test_sparse_grids_are_traced_where_their_surface_is(mi_rgb, folder, rng):
    """From cell to cell, hits are those of sphere tracing through the same field, and near the torus itself."""
    from mi_diffind.tasks.sdf import TASK, grids, marching

    mi = mi_rgb
    field = TASK.open(mi.TensorXf, folder / "torus.npz").field
    o, d = rays(rng)
    within = rng.random(len(o)) < 0.3  # some start in the tube
    angle = rng.uniform(0, 2 * np.pi, len(o))
    o[within] = np.stack([0.38 * np.cos(angle), 0.38 * np.sin(angle), 0.05 * np.sin(9 * angle)], 1)[within]
    p, v = (mi.Vector3f(*(mi.Float(aligned(x)) for x in values.T)) for values in (o, d))
    hit = marching.intersect(field, p, v, dr.inf)
    dr.eval(hit)  # at once: each result of its own would be another kernel
    t, result = np.array(hit.t), np.array(hit.hit)
    near, far, active = marching.enter(field, p, v, mi.Float(dr.inf))
    start = dr.clip(dr.fma(v, near, p), mi.Vector3f(*field.lower), mi.Vector3f(*field.upper))
    other, slow, _ = marching.sphere_trace(field, start, v, far - near, near == 0, active)
    slow = np.array(dr.select(other, near + slow, dr.inf))
    assert (np.array(hit.leaving) == within).all() and result[within].all()
    assert np.isclose(t, slow, rtol=0, atol=2e-4).mean() > 0.995
    expected = analytic(o[~within], d[~within])
    both = np.isfinite(expected) & result[~within]
    assert (np.isfinite(expected) == result[~within]).mean() > 0.995 and both.mean() > 0.3
    assert np.median(np.abs(t[~within][both] - expected[both])) < 1e-3
    where = np.array(hit.p).T[result]
    assert np.abs(grids.point_values(field, where)).max() < 5e-5


def test_axis_aligned_rays_through_cells(mi_rgb, folder):
    """Also those that run exactly in the sides of cells, and those from far away."""
    from mi_diffind.tasks.sdf import TASK, marching

    mi = mi_rgb
    field = TASK.open(mi.TensorXf, folder / "torus.npz").field
    o, d, expected = [], [], []
    lower, h = np.array(field.lower), field.spacing
    at = lower + h * np.round((np.array([0.38, 0.0, 0.0]) - lower) / h)  # a node in the tube
    for offset in (0.0, 0.3 * h):
        for distance in (0.9, 1000.0):
            for axis, side in ((2, np.sqrt(0.12**2 - (at[0] + offset - 0.38) ** 2)), (0, 0.5)):
                for sign in (1.0, -1.0):
                    origin, direction = np.array([at[0] + offset, 0.0, 0.0]), np.zeros(3)
                    origin[axis], direction[axis] = -sign * distance, sign
                    if axis == 0:
                        origin[1:] = at[1:] if offset == 0 else 0
                        side = np.hypot(*[0.5, 0]) if offset else 0.38 + np.sqrt(0.12**2 - at[2] ** 2)
                    o.append(origin), d.append(direction), expected.append(distance - side)
    o, d = (mi.Vector3f(*(mi.Float(aligned(x)) for x in np.transpose(values))) for values in (o, d))
    hit = marching.intersect(field, o, d, dr.inf)
    dr.eval(hit)
    assert np.array(hit.hit).all()
    assert np.abs(np.array(hit.t) - expected).max() < 3e-3


@pytest.mark.parametrize("turned", [False, True])
def test_grid_and_arrays_agree_and_are_where_the_mesh_is(mi_rgb, folder, turned):
    mi = mi_rgb
    to_world = {}
    if turned:
        at = mi.ScalarTransform4f
        to_world = {"to_world": at().translate([0.4, -0.5, 0.2]).rotate([0.6, 0, 0.8], 50).scale(0.8)}
    bsdf = {"bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}}
    shapes = {
        "arrays": {"type": "neural_sdf", "filename": str(folder / "torus.npz"), "normals": "analytic"},
        "grid": shape(folder, trace="grid", normals="analytic"),
        "mesh": {"type": "ply", "filename": str(folder / "torus.ply")},
    }
    images, boxes = {}, {}
    for name, dictionary in shapes.items():
        loaded = scene(mi, {"torus": {**dictionary, **bsdf, **to_world}})
        images[name] = np.array(mi.render(loaded, spp=64, seed=1))
        box = loaded.bbox()
        boxes[name] = np.array([box.min, box.max])
    assert np.abs(images["arrays"] - images["grid"]).mean() < 2.5e-3  # noise of 64 samples included
    assert np.abs(images["arrays"] - images["mesh"]).mean() < 2.5e-3
    assert np.abs(images["arrays"].mean() - images["grid"].mean()) < 2e-4
    assert np.abs(images["mesh"] - images["mesh"].mean()).mean() > 0.02
    for name in ("arrays", "grid"):
        assert (boxes[name][0] < boxes["mesh"][0] + 1e-3).all() and (boxes[name][1] > boxes["mesh"][1] - 1e-3).all()


def test_reports(mi_rgb, folder):
    mi = mi_rgb
    turned = mi.ScalarTransform4f().rotate([0, 0, 1], 30)
    loaded = scene(mi, {
        "a": shape(folder, id="a"),
        "b": shape(folder, id="b", trace="grid", resolution=24),
        "c": shape(folder, id="c", trace="grid", resolution=24, to_world=turned),
    })  # fmt: skip
    result = {entry["trace"] + str("to_world" in entry["parameters"]): entry for entry in loading.reports(loaded)}
    assert set(result) == {"arraysFalse", "gridFalse", "gridTrue"}
    assert result["arraysFalse"]["table_bytes"] < 100_000 and result["arraysFalse"]["index_bytes"] > 0
    turned = result["gridTrue"]
    assert turned["resolution"] == 24 and turned["grid_bytes"] == 4 * np.prod(np.add(turned["cells"], 1))
    assert turned["memory_bytes"] == 40 * np.prod(turned["cells"]) and "24 cells" in turned["decoded"]
    json.dumps(list(result.values()))


def test_each_variant_has_a_shape_of_its_own(mi_any, folder):
    """One process may change the variant: a shape derived from the mesh of another variant is no shape there."""
    loaded = mi_any.load_dict({"type": "scene", "solid": shape(folder, id="solid")})
    assert loaded.shapes()[0].id() == "solid" and isinstance(loaded.shapes()[0], mi_any.Mesh)


def test_shapes_of_one_file_share_its_arrays(mi_rgb, folder):
    loaded = scene(mi_rgb, {"a": shape(folder), "b": shape(folder)})
    a, b = (s for s in loaded.shapes() if isinstance(s, mi_rgb.Mesh))
    assert a.model.field is b.model.field
    params = mi_rgb.traverse(loaded)
    assert not [key for key in params.keys() if "vertex" in key or "tables" in key]
    assert "a.bsdf.reflectance.value" in params


def test_shapes_made_at_once_share_their_arrays(mi_rgb, folder, monkeypatch):
    """As Mitsuba makes them: in several threads, of which one may make a shape while it waits within another."""
    from mi_diffind.plugins import neural_sdf as plugin

    props = mi_rgb.Properties("neural_sdf")
    props["filename"] = shape(folder)["filename"]
    opened, nested = plugin.TASK.open, []

    def slowly(*args, **kwargs):
        time.sleep(0.1)
        if not nested:
            nested.append(None)
            nested.append(plugin.open_model(props))
        return opened(*args, **kwargs)

    monkeypatch.setattr(type(plugin.TASK), "open", lambda self, *args, **kwargs: slowly(*args, **kwargs))
    monkeypatch.setattr(plugin, "_shared", WeakValueDictionary())
    with ThreadPoolExecutor(4) as pool:
        models = [*pool.map(lambda _: plugin.open_model(props), range(4))]
    assert {id(model) for model in models} == {id(nested[1])}


def test_derivatives_reach_the_nodes(mi_rgb, folder):
    """All nodes further out: by the integrator as by differences."""
    mi = mi_rgb
    close = {
        "type": "perspective",
        "fov": 3,
        "to_world": mi.ScalarTransform4f().look_at([0.5, -3, 2.5], [0.5, -1.75, 0.4], [0, 0, 1]),
    }
    close["film"] = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    loaded = scene(mi, {"a": shape(folder, storage="float32", normals="analytic")}, sensor=close)
    params = mi.traverse(loaded)
    key = "a.tables.nodes"
    nodes = mi.TensorXf(params[key])
    integrator = mi.load_dict({"type": "path_sdf", "max_depth": 2})
    flat = np.array(nodes)
    step = np.zeros_like(flat)
    step[:, 0] = 0.02  # spacings
    images = []
    for sign in (1, -1):
        params[key] = mi.TensorXf(aligned(flat + sign * step))
        params.update()
        images.append(np.array(mi.render(loaded, spp=16, seed=2, integrator=integrator)))
    differences = (images[0] - images[1]).sum() / 0.04
    params[key] = mi.TensorXf(aligned(flat))
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(loaded, params, spp=16, seed=2, integrator=integrator)
    dr.backward(dr.sum(image.array))
    result = np.array(dr.grad(params[key]))[:, 0].sum()
    assert abs(differences) > 1e-3
    assert result == pytest.approx(differences, rel=0.03)


def test_a_moved_shape_is_that_of_a_new_scene(mi_rgb, folder):
    """To the last bit, with its extent; a transform that is refused moves nothing."""
    mi, at = mi_rgb, mi_rgb.ScalarTransform4f
    turn = at().translate([0.3, 0.2, -0.1]).rotate([0.6, 0, 0.8], 40).scale([-1.2, 1.2, 1.2])
    new, loaded = (scene(mi, {"a": shape(folder, **more)}) for more in ({"to_world": turn}, {}))
    expected, before = (np.array(mi.render(v, spp=4)) for v in (new, loaded))
    assert np.abs(before - expected).max() > 0.1
    params = mi.traverse(loaded)
    params["a.to_world"] = turn
    params.update()
    np.testing.assert_array_equal(np.array(mi.render(loaded, spp=4)), expected)
    assert loaded.bbox() == new.bbox()
    params["a.to_world"] = at().scale([1, 2, 1])
    with pytest.raises(RuntimeError, match=r'parameter "to_world": found .* allowed are rotations'):
        params.update()
    np.testing.assert_array_equal(np.array(mi.render(loaded, spp=4)), expected)
    params["a.to_world"] = at()
    params.update()
    np.testing.assert_array_equal(np.array(mi.render(loaded, spp=4)), before)


def test_frozen_dense_arrays(mi_rgb, dense, no_garbage_collection):
    """A recorded render is the other one to the last bit, with another seed and place; see also ``test_frozen.py``."""
    mi, at = mi_rgb, mi_rgb.AffineTransform4f
    loaded = scene(mi, {"a": {"type": "neural_sdf", "filename": str(dense)}})
    params = mi.traverse(loaded)
    frozen = dr.freeze(lambda scene, seed: mi.render(scene, spp=2, seed=seed))
    images = []
    for number in range(4):
        if number > 1:
            params["a.to_world"] = at().translate([0.2, 0.1, 0]).rotate([0, 0, 1], 30 * number)
            params.update()
        seed = dr.opaque(mi.UInt32, min(number, 1))
        images.append(np.array(frozen(loaded, seed)))
        np.testing.assert_array_equal(images[-1], np.array(mi.render(loaded, spp=2, seed=seed)))
    assert frozen.n_recordings < 4 and np.abs(images[2] - images[1]).mean() > 1e-3


# -- how fine a grid is ------------------------------------------------------------------------------------------------


def upright(p):
    """The torus around the y axis, in whose box Y is the short side."""
    d, n = torus(p[:, [0, 2, 1]])
    return d, n[:, [0, 2, 1]]


@pytest.fixture(scope="module")
def upright_files(tmp_path_factory):
    """Error of the arrays that a file tells (``None``: it does not) → the file."""
    path = tmp_path_factory.mktemp("grids")
    table = sparse_table(upright, scale=SCALE, centre=CENTRE)
    files = {}
    for error in (None, 3e-4, 1e-4, 1e-6):
        files[error] = path / f"{error}.npz"
        table.measured.pop("mae_surface", None)
        if error is not None:
            table.measured["mae_surface"] = error
        save_table(files[error], table)
    return files


def as_grid(mi, file, **more):
    shape = {"type": "neural_sdf", "filename": str(file), "trace": "grid", **more}
    return mi.load_dict({"type": "scene", "a": shape})


def grid_of(mi, file, **more):
    """What a shape that is a grid reports, its values (Z, Y, X), and its box."""
    loaded = as_grid(mi, file, **more)
    values = np.array(mi.traverse(loaded)["a.grid"])[..., 0]
    box = loaded.bbox()
    (report,) = loading.reports(loaded)
    return report, values, np.array(box.min), np.array(box.max)


def off_the_field(mi, file, values, lower, upper):
    """How much a grid in the world differs from the field of a file, on the torus, on average."""
    from scipy.ndimage import map_coordinates

    from mi_diffind.tasks.sdf import TASK

    field = TASK.open(mi.TensorXf, file).field
    a, b = np.random.default_rng(3).uniform(0, 2 * np.pi, (2, 30000))
    p = np.stack([(0.38 + 0.12 * np.cos(b)) * np.cos(a), 0.12 * np.sin(b), (0.38 + 0.12 * np.cos(b)) * np.sin(a)], 1)
    place = (SCALE * p + CENTRE - lower) / (upper - lower) * (np.array(values.shape[::-1]) - 1)
    result = map_coordinates(values.astype(np.float64), place.T[::-1], order=1)
    return np.abs(result - field.value(mi.Point3f(p.T.astype(np.float32))).numpy()).mean()


@pytest.mark.parametrize("error", [3e-4, 1e-4])
def test_grids_are_as_coarse_as_the_error_of_the_arrays_allows(mi_rgb, upright_files, error):
    """By brute force: the chosen grid keeps below that error, one that is 6% coarser does not."""
    report, *grid = grid_of(mi_rgb, upright_files[error])
    assert report["arrays_error"] == error and report["arrays_error_measured"] and report["error"] <= error
    assert report["error"] == pytest.approx(off_the_field(mi_rgb, upright_files[error], *grid), rel=0.06)
    coarser, *grid = grid_of(mi_rgb, upright_files[error], resolution=int(report["resolution"] / 1.06))
    assert off_the_field(mi_rgb, upright_files[error], *grid) > 0.97 * error
    assert coarser["error"] > 0.97 * error


def test_grids_are_cut_to_what_is_inside(mi_rgb, upright_files):
    """As many bytes as there are nodes; Y is shorter than X and Z, and the torus is hit where it is all the same."""
    mi = mi_rgb
    report, values, lower, upper = grid_of(mi, upright_files[3e-4], normals="analytic")
    z, y, x = values.shape
    assert z == x > 2.5 * y and report["cells"] == [x - 1, y - 1, z - 1]
    assert report["grid_bytes"] == 4 * x * y * z and report["memory_bytes"] == 40 * (x - 1) * (y - 1) * (z - 1)
    half, cell = SCALE * np.array([0.5, 0.12, 0.5]), (upper - lower) / np.array([x - 1, y - 1, z - 1])
    assert np.allclose(cell, cell[0], rtol=1e-4)
    assert (
        (lower < CENTRE - half).all() and (CENTRE + half < upper).all() and (upper - lower < 2 * half + 6 * cell).all()
    )
    o, d = rays(np.random.default_rng(4))
    o, d = o[:, [0, 2, 1]], d[:, [0, 2, 1]]
    expected = analytic(o[:, [0, 2, 1]], d[:, [0, 2, 1]])
    loaded = mi.load_dict(
        {"type": "scene", "a": {"type": "neural_sdf", "filename": str(upright_files[3e-4]), "trace": "grid"}}
    )
    ray = mi.Ray3f(mi.Point3f((SCALE * o + CENTRE).T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    t = np.array(loaded.ray_intersect(ray).t) / SCALE
    both = np.isfinite(expected) & np.isfinite(t)
    assert (np.isfinite(expected) == np.isfinite(t)).mean() > 0.995 and both.mean() > 0.3
    assert np.median(np.abs(t[both] - expected[both])) < 1e-3


def test_grids_of_sparse_fields(mi_rgb, upright_files):
    """Where no node is stored, one value of a block stands for all: as if each had been asked for."""
    from mi_diffind.tasks.sdf import TASK, grids

    field = TASK.open(mi_rgb.TensorXf, upright_files[None]).field
    for resolution in (70, 150):
        values, lower, upper = grids.grid(field, resolution)
        shape = values.shape[::-1]
        expected = grids.node_values(field, lower, (upper[0] - lower[0]) / (shape[0] - 1), shape).transpose(2, 1, 0)
        assert np.abs(values - expected).max() < 1e-6
        crossed = grids.crossed_blocks(field, lower, (upper[0] - lower[0]) / (shape[0] - 1), shape)
        assert crossed.any() and (resolution < 100 or crossed.mean() < 0.9)


def test_grids_are_no_larger_than_allowed(mi_rgb, upright_files, monkeypatch):
    """A warning says what the errors are then; a resolution that was asked for is not limited."""
    plugin = plugins.declared()["neural_sdf"].factory.__globals__  # each variant has modules of its own
    warned = warnings_of(mi_rgb, monkeypatch)
    monkeypatch.setitem(plugin, "LARGEST", 2_000_000)
    report, *_ = grid_of(mi_rgb, upright_files[1e-6])
    assert report["memory_bytes"] < 2_000_000 and report["error"] > 10 * report["arrays_error"]
    assert len(warned) == 1 and report["decoded"] in warned[0] and "1e-06 off the mesh" in warned[0]
    requested, *_ = grid_of(mi_rgb, upright_files[1e-6], resolution=80)
    assert requested["memory_bytes"] > 2_000_000 and len(warned) == 1
    monkeypatch.setitem(plugin, "FINEST", 20)
    assert grid_of(mi_rgb, upright_files[1e-6])[0]["resolution"] == 20
    box = [1.0, 0.3, 0.6]
    n = plugin["finest"](box, 10**8)
    assert 40 * n * 0.3 * n * n <= 10**8 < 40 * (n + 1) * 0.3 * (n + 1) ** 2


def test_grids_of_files_that_tell_no_error(mi_rgb, upright_files):
    report, *_ = grid_of(mi_rgb, upright_files[None])
    assert not report["arrays_error_measured"] and report["arrays_error"] == pytest.approx(0.005 / 40)
    assert report["error"] <= report["arrays_error"] and "about" in report["decoded"]


def test_crops_keep_two_cells_around_what_is_inside(mi_rgb):
    """Two cells and no more, unless the grid ends; what is added until X and Z are equal is outside."""
    from mi_diffind.plugins.support import distance_shapes

    values = np.ones((12, 10, 14))
    values[5, 1, 4:9] = -1
    cropped, lower, upper = distance_shapes.crop_grid(values, np.array([1.0, 2, 3]), 0.5)
    assert cropped.shape == (9, 4, 9)  # x: 2 to 10, y: 0 to 3, z: 3 to 7 and 4 more
    np.testing.assert_array_equal(cropped[:5], values[3:8, :4, 2:11])
    assert (cropped[5:] == 1).all()
    np.testing.assert_allclose(lower, [2, 2, 4.5])
    np.testing.assert_allclose(upper, [6, 3.5, 8.5])
    with pytest.raises(RuntimeError, match="nothing is inside at 13 cells"):
        distance_shapes.crop_grid(np.ones((12, 10, 14)), np.zeros(3), 0.1)


# -- what cannot be ----------------------------------------------------------------------------------------------------


def refused(mi, folder, message, **more):
    with pytest.raises(RuntimeError) as raised:
        mi.load_dict(shape(folder, **more))
    sentence = compat.one_sentence(raised.value)
    assert message in sentence and "\n" not in sentence and "Traceback" not in sentence
    return sentence


@pytest.mark.parametrize(
    "more, message",
    [
        ({"trace": "rays"}, 'parameter "trace": found "rays"'),
        ({"normals": "flat"}, 'parameter "normals": found "flat"'),
        ({"storage": "float16"}, 'parameter "storage": found "float16"'),
        ({"storage": "float32", "trace": "grid"}, 'parameter "storage": found "float32"'),
        ({"resolution": 64, "trace": "arrays"}, 'parameter "resolution": has no effect'),
        ({"resolution": 2, "trace": "grid"}, 'parameter "resolution": found 2'),
        ({"resolution": 0.5, "trace": "grid"}, 'parameter "resolution": found 0.5'),
        ({"filename": ""}, 'parameter "filename": not given'),
    ],
)
def test_wrong_parameters(mi_rgb, folder, more, message):
    refused(mi_rgb, folder, message, **more)


@pytest.mark.parametrize("trace", ["arrays", "grid"])
def test_scales_that_differ(mi_rgb, folder, trace):
    at = mi_rgb.ScalarTransform4f().scale([1, 1, 2])
    refused(mi_rgb, folder, 'parameter "to_world": found', to_world=at, trace=trace)


@pytest.mark.parametrize("fault", ["missing", "other task"])
def test_damaged_files(mi_rgb, folder, tmp_path, fault):
    from mi_diffind.tasks.ggx import TASK as GGX

    path = GGX.file() if fault == "other task" else tmp_path / "bad.npz"
    sentence = refused(mi_rgb, folder, path.name, filename=str(path))
    assert len(sentence) < 400


def written(folder, tmp_path, parameters="", integrator=""):
    path = tmp_path / "scene.xml"
    path.write_text(f"""<scene version="3.0.0"><shape type="neural_sdf" id="ring">
        <string name="filename" value="{folder}/torus.npz"/>{parameters}</shape>
        {integrator}<sensor type="perspective"/></scene>""")
    return path


def integrator(name, inner=""):
    return f'<integrator type="{name}">{inner}</integrator>'


EXPLICIT = '<string name="trace" value="arrays"/>'
TRACED = integrator("path_sdf")
CHANNELS = integrator("aov", '<string name="aovs" value="d:depth"/>' + TRACED)  # from rays of its own
STOCK = [integrator("path"), integrator("moment", integrator("path")), integrator("prb"), CHANNELS]
OURS = [TRACED, integrator("moment", TRACED)]


@pytest.mark.parametrize("xml", STOCK)
def test_other_integrators_see_a_grid(mi_rgb, folder, tmp_path, monkeypatch, xml):
    """If the scene says nothing; one line tells what that takes."""
    warned = warnings_of(mi_rgb, monkeypatch)
    path = written(folder, tmp_path, '<integer name="resolution" value="40"/>', xml)
    for load in (loading.load, loading.load_file):
        loaded = load(path)
        (report,) = loading.reports(loaded)
        assert report["trace"] == "grid" and warned.pop().endswith(report["decoded"]) and not warned
        ray = mi_rgb.Ray3f(mi_rgb.Point3f(CENTRE[0] + 0.76, CENTRE[1], 5), mi_rgb.Vector3f(0, 0, -1))
        assert dr.all(loaded.ray_test(ray))


@pytest.mark.parametrize("xml", OURS)
def test_our_integrator_sees_arrays(mi_rgb, folder, tmp_path, monkeypatch, xml):
    """Also within another one."""
    warned = warnings_of(mi_rgb, monkeypatch)
    for load in (loading.load, loading.load_file):
        (report,) = loading.reports(load(written(folder, tmp_path, "", xml)))
        assert report["trace"] == "arrays" and not warned


def test_commands_tell_what_a_grid_takes(mi_rgb, folder, tmp_path, capsys):
    """Once, on stderr, where they keep Mitsuba's log quiet."""
    from mi_diffind.commands.cli import main

    path = written(folder, tmp_path, '<integer name="resolution" value="40"/>', STOCK[0])
    assert main(["render", str(path), "-o", str(tmp_path / "a.exr"), "--spp", "1", "--variant", mi_rgb.variant()]) == 0
    report = [line for line in capsys.readouterr().err.splitlines() if "decoded to a grid" in line]
    assert len(report) == 1 and report[0].startswith("warning: ") and "MB in Mitsuba" in report[0]


def test_scenes_without_an_integrator(mi_rgb, folder, tmp_path, monkeypatch):
    """Commands that need none take ``path``; in Python, another one may be meant."""
    warned = warnings_of(mi_rgb, monkeypatch)
    path = written(folder, tmp_path)
    assert loading.reports(loading.load(path))[0]["trace"] == "grid" and len(warned) == 1
    assert loading.reports(loading.load_file(path))[0]["trace"] == "arrays"
    assert 'is seen by the integrator "path_sdf" alone, found none' in warned[1]


@pytest.mark.parametrize("more", [EXPLICIT, '<string name="storage" value="float32"/>'])
@pytest.mark.parametrize("xml", STOCK[:2])
def test_arrays_that_other_integrators_do_not_see(mi_rgb, folder, tmp_path, monkeypatch, more, xml):
    """Asked for, they are refused rather than left out of an image; ``load_file`` warns."""
    warned = warnings_of(mi_rgb, monkeypatch)
    path = written(folder, tmp_path, more, xml)
    with pytest.raises(SceneError, match=r'"ring".*"path_sdf".*found.*"path"'):
        loading.load(path)
    assert loading.reports(loading.load_file(path))[0]["trace"] == "arrays" and len(warned) == 1
    loaded = loading.load(written(folder, tmp_path, more, TRACED))
    assert len(loaded.shapes()) == 1
    mesh = loading.load(path, exact=True).shapes()[0]
    assert mesh.face_count() == 96 * 48 * 2 and type(mesh) is mi_rgb.Mesh


def test_mesh_elsewhere(mi_rgb, folder, tmp_path):
    """A recorded mesh outside of the file's folder is shown only if it is what the file was made from."""
    table, digest = load_table(folder / "torus.npz"), load_mesh(folder / "torus.ply").digest
    table.settings["mesh_path"] = os.path.relpath(folder / "torus.ply", tmp_path)
    for recorded in ("0" * 64, digest):
        table.settings["source"] = recorded
        save_table(tmp_path / "torus.npz", table)
        path = written(tmp_path, tmp_path)
        if recorded == digest:
            assert loading.load(path, exact=True).shapes()[0].face_count() == 96 * 48 * 2
        else:
            with pytest.raises(SceneError, match="has changed since"):
                loading.load(path, exact=True)


def test_load_file_takes_what_mitsuba_takes(mi_rgb, folder, tmp_path):
    path = written(
        folder,
        tmp_path,
        EXPLICIT,
        '<default name="n" value="3"/>' + integrator("path_sdf", '<integer name="max_depth" value="$n"/>'),
    )
    for parallel in (True, False):
        loaded = loading.load_file(path, parallel=parallel, optimize=False, n=7)
        assert loaded.integrator().max_depth == 7
    with pytest.raises(RuntimeError, match=r"none\.xml"):
        loading.load_file(tmp_path / "none.xml")
    with pytest.raises(RuntimeError, match="unused"):
        loading.load_file(path, unused=1)
