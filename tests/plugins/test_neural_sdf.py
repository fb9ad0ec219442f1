"""The plugin ``neural_sdf``: files, places, the two ways in which it is traced, what it refuses."""

import json
import os

import drjit as dr
import numpy as np
import pytest
import trimesh
from arrays import aligned
from sdf_fields import sparse_table, torus
from texture_scenes import refused
from variants import warnings_of

from mi_diffind import plugins
from mi_diffind.arrays.tables import load_table, save_table
from mi_diffind.plugins.support import distance_shapes
from mi_diffind.scenes import loading
from mi_diffind.scenes.loading import SceneError
from mi_diffind.tasks.sdf import TASK, grids, marching
from mi_diffind.tasks.sdf.mesh import load_mesh

SCALE, CENTRE = 2.0, (0.5, -1.0, 0.25)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """``torus.npz`` and the mesh ``torus.ply`` that its settings name."""
    path = tmp_path_factory.mktemp("sdf")
    table = sparse_table(scale=SCALE, centre=CENTRE)
    mesh = trimesh.creation.torus(0.38, 0.12, 96, 48)
    mesh.apply_scale(SCALE)
    mesh.apply_translation(CENTRE)
    mesh.export(path / "torus.ply")
    table.settings["mesh_path"] = "torus.ply"
    save_table(path / "torus.npz", table)
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
    """Return origins and directions of rays from around the torus, in the unit frame, towards it."""
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


def test_sparse_grids_are_traced_where_their_surface_is(mi, folder, rng):
    """Hits from cell to cell are those of sphere tracing through the same field, and near the torus."""
    field = TASK.open(mi.TensorXf, folder / "torus.npz").field
    o, d = rays(rng)
    within = rng.random(len(o)) < 0.3  # some start in the tube
    # Others run exactly in the sides of cells
    along, lower, h = ~within & (rng.random(len(o)) < 0.3), np.array(field.lower), field.spacing
    d[along] = rng.choice([-1, 1], (along.sum(), 1)) * np.eye(3)[rng.integers(0, 3, along.sum())]
    o[along] = np.where(d == 0, lower + h * np.round((o + 2 * d - lower) / h), -0.9 * d)[along]
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
    error = np.abs(t[~within][both] - expected[both])
    assert np.median(error) < 1e-3 and np.quantile(error, 0.98) < 5e-3
    where = np.array(hit.p).T[result]
    assert np.abs(grids.point_values(field, where)).max() < 5e-5


@pytest.mark.parametrize("turned", [False, True])
def test_grid_and_arrays_agree_and_are_where_the_mesh_is(mi, folder, turned):
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


def test_reports(mi, folder):
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


def test_shapes_of_one_file_share_its_arrays(mi, folder):
    loaded = scene(mi, {"a": shape(folder), "b": shape(folder)})
    a, b = (s for s in loaded.shapes() if isinstance(s, mi.Mesh))
    assert a.model.field is b.model.field
    params = mi.traverse(loaded)
    assert not [key for key in params.keys() if "vertex" in key or "tables" in key]
    assert "a.bsdf.reflectance.value" in params


def test_derivatives_reach_the_nodes(mi, folder):
    """All nodes further out: by the integrator as by differences."""
    view = mi.ScalarTransform4f().look_at([0.5, -3, 2.5], [0.5, -1.75, 0.4], [0, 0, 1])
    close = {"type": "perspective", "fov": 3, "to_world": view}
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


def test_a_moved_shape_is_that_of_a_new_scene(mi, folder):
    """Images and extents are equal to the last bit; a refused transform moves nothing."""
    at = mi.ScalarTransform4f
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


def grid_report(mi, path, error=None, **more):
    """Report of the torus as a grid, from a file that records this error of its arrays (``None``: none)."""
    table = sparse_table(scale=SCALE, centre=CENTRE)
    table.measured = {} if error is None else {"mae_surface": error}
    save_table(path / "torus.npz", table)
    (report,) = loading.reports(mi.load_dict({"type": "scene", "a": shape(path, trace="grid", **more)}))
    return report


def test_grids_are_no_larger_than_allowed(mi, tmp_path, monkeypatch):
    """A warning states the errors of a limited grid; a ``resolution`` is not limited."""
    plugin = plugins.declared()["neural_sdf"].factory.__globals__  # each variant has modules of its own
    warned = warnings_of(mi, monkeypatch)
    monkeypatch.setitem(plugin, "LARGEST", 2_000_000)
    report = grid_report(mi, tmp_path, 1e-6)
    assert report["memory_bytes"] < 2_000_000 and report["error"] > 10 * report["arrays_error"]
    assert len(warned) == 1 and report["decoded"] in warned[0] and "1e-06 off the mesh" in warned[0]
    assert grid_report(mi, tmp_path, 1e-6, resolution=80)["memory_bytes"] > 2_000_000 and len(warned) == 1
    monkeypatch.setitem(plugin, "FINEST", 20)
    assert grid_report(mi, tmp_path, 1e-6)["resolution"] == 20
    n = plugin["finest"]([1.0, 0.3, 0.6], 10**8)
    assert 40 * n * 0.3 * n * n <= 10**8 < 40 * (n + 1) * 0.3 * (n + 1) ** 2


def test_grids_of_files_without_a_measured_error(mi, tmp_path):
    report = grid_report(mi, tmp_path)
    assert not report["arrays_error_measured"] and report["arrays_error"] == pytest.approx(0.005 / 40)
    assert report["error"] <= report["arrays_error"] and "about" in report["decoded"]


def test_grids_without_an_inside_are_refused(mi):
    with pytest.raises(RuntimeError, match="nothing is inside at 13 cells"):
        distance_shapes.crop_grid(np.ones((12, 10, 14)), np.zeros(3), 0.1)


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
        ({"trace": "grid", "to_world": [1, 1, 2]}, 'parameter "to_world": found'),
    ],
)
def test_wrong_parameters(mi, folder, more, message):
    if "to_world" in more:
        more = {**more, "to_world": mi.ScalarTransform4f().scale(more["to_world"])}
    assert message in refused(mi, shape(folder, **more))


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


@pytest.mark.parametrize("xml", [*STOCK, *OURS, ""])
def test_integrators_see_a_grid_or_arrays(mi, folder, tmp_path, monkeypatch, xml):
    """For other integrators, shapes without ``trace`` are decoded, and one line states the memory. Without an
    integrator, commands take ``path``; in Python, another one may be meant.
    """
    warned = warnings_of(mi, monkeypatch)
    path = written(folder, tmp_path, '<integer name="resolution" value="40"/>' if xml in STOCK else "", xml)
    for load in (loading.load, loading.load_file):
        loaded = load(path)
        (report,) = loading.reports(loaded)
        if xml in STOCK or (not xml and load is loading.load):
            assert report["trace"] == "grid" and warned.pop().endswith(report["decoded"])
            ray = mi.Ray3f(mi.Point3f(CENTRE[0] + 0.76, CENTRE[1], 5), mi.Vector3f(0, 0, -1))
            assert dr.all(loaded.ray_test(ray))
        else:
            assert report["trace"] == "arrays"
            assert xml or 'is seen by the integrator "path_sdf" alone, found none' in warned.pop()
        assert not warned


def test_commands_tell_what_a_grid_takes(mi, folder, tmp_path, capsys):
    """One line on stderr, while Mitsuba's log is quiet."""
    from mi_diffind.commands.cli import main

    path = written(folder, tmp_path, '<integer name="resolution" value="40"/>', STOCK[0])
    assert main(["render", str(path), "-o", str(tmp_path / "a.exr"), "--spp", "1", "--variant", mi.variant()]) == 0
    report = [line for line in capsys.readouterr().err.splitlines() if "decoded to a grid" in line]
    assert len(report) == 1 and report[0].startswith("warning: ") and "MB in Mitsuba" in report[0]


@pytest.mark.parametrize("more", [EXPLICIT, '<string name="storage" value="float32"/>'])
@pytest.mark.parametrize("xml", STOCK[:2])
def test_arrays_that_other_integrators_do_not_see(mi, folder, tmp_path, monkeypatch, more, xml):
    """Asked for, they are refused rather than left out of an image; ``load_file`` warns."""
    warned = warnings_of(mi, monkeypatch)
    path = written(folder, tmp_path, more, xml)
    with pytest.raises(SceneError, match=r'"ring".*"path_sdf".*found.*"path"'):
        loading.load(path)
    assert loading.reports(loading.load_file(path))[0]["trace"] == "arrays" and len(warned) == 1
    loaded = loading.load(written(folder, tmp_path, more, TRACED))
    assert len(loaded.shapes()) == 1
    mesh = loading.load(path, exact=True).shapes()[0]
    assert mesh.face_count() == 96 * 48 * 2 and type(mesh) is mi.Mesh


def test_mesh_elsewhere(mi, folder, tmp_path):
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
