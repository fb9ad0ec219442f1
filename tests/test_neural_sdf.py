"""The plugin ``neural_sdf``: files, places, the two ways in which it is traced, what it refuses."""

import json
import time
from concurrent.futures import ThreadPoolExecutor
from weakref import WeakValueDictionary

import drjit as dr
import numpy as np
import pytest
from sdf_fields import sparse_table, torus

from mi_diffind import compat, plugins, scenes
from mi_diffind.scenes import SceneError
from mi_diffind.tables import save_table

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
    from mi_diffind.tasks.sdf import TASK, tracing

    mi = mi_rgb
    field = TASK.open(mi.TensorXf, folder / "torus.npz").field
    o, d = rays(rng)
    within = rng.random(len(o)) < 0.3  # some start in the tube
    angle = rng.uniform(0, 2 * np.pi, len(o))
    o[within] = np.stack([0.38 * np.cos(angle), 0.38 * np.sin(angle), 0.05 * np.sin(9 * angle)], 1)[within]
    p, v = mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32))
    hit = tracing.intersect(field, p, v, dr.inf)
    t, found = np.array(hit.t), np.array(hit.found)
    near, far, active = tracing.enter(field, p, v, mi.Float(dr.inf))
    start = dr.clip(dr.fma(v, near, p), mi.Vector3f(*field.lower), mi.Vector3f(*field.upper))
    other, slow, _ = tracing.spheres(field, start, v, far - near, near == 0, active)
    slow = np.where(other, np.array(near + slow), np.inf)
    assert (np.array(hit.leaving) == within).all() and found[within].all()
    assert np.isclose(t, slow, rtol=0, atol=2e-4).mean() > 0.995
    expected = analytic(o[~within], d[~within])
    both = np.isfinite(expected) & found[~within]
    assert (np.isfinite(expected) == found[~within]).mean() > 0.995 and both.mean() > 0.3
    assert np.median(np.abs(t[~within][both] - expected[both])) < 1e-3
    where = np.array(hit.p).T[found]
    assert np.abs(np.array(field.value(mi.Point3f(where.T)))).max() < 5e-5


def test_axis_aligned_rays_through_cells(mi_rgb, folder):
    """Also those that run exactly in the sides of cells, and those from far away."""
    from mi_diffind.tasks.sdf import TASK, tracing

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
    t, found = tracing.trace(field, mi.Point3f(np.float32(o).T), mi.Vector3f(np.float32(d).T), dr.inf)
    assert np.array(found).all()
    assert np.abs(np.array(t) - expected).max() < 3e-3


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
        "grid": shape(folder, trace="grid", resolution=96, normals="analytic"),
        "mesh": {"type": "ply", "filename": str(folder / "torus.ply")},
    }
    images, boxes = {}, {}
    for name, dictionary in shapes.items():
        made = scene(mi, {"torus": {**dictionary, **bsdf, **to_world}})
        images[name] = np.array(mi.render(made, spp=64, seed=1))
        box = made.bbox()
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
    made = scene(mi, {
        "a": shape(folder, id="a"),
        "b": shape(folder, id="b", trace="grid", resolution=24),
        "c": shape(folder, id="c", trace="grid", resolution=24, to_world=turned),
    })  # fmt: skip
    found = {entry["trace"] + str("to_world" in entry["parameters"]): entry for entry in scenes.reports(made)}
    assert set(found) == {"arraysFalse", "gridFalse", "gridTrue"}
    assert found["arraysFalse"]["table_bytes"] < 100_000 and found["arraysFalse"]["index_bytes"] > 0
    assert found["gridTrue"]["grid_bytes"] == 4 * max(found["gridTrue"]["resolution"]) ** 3
    json.dumps(list(found.values()))


def test_shapes_of_one_file_share_its_arrays(mi_rgb, folder):
    made = scene(mi_rgb, {"a": shape(folder), "b": shape(folder)})
    a, b = (s for s in made.shapes() if isinstance(s, mi_rgb.Mesh))
    assert a.model.field is b.model.field
    params = mi_rgb.traverse(made)
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
    made = scene(mi, {"a": shape(folder, storage="float32", normals="analytic")}, sensor=close)
    params = mi.traverse(made)
    key = "a.tables.nodes"
    nodes = mi.TensorXf(params[key])
    integrator = mi.load_dict({"type": "path_sdf", "max_depth": 2})
    flat = np.array(nodes)
    step = np.zeros_like(flat)
    step[:, 0] = 0.02  # spacings
    images = []
    for sign in (1, -1):
        params[key] = mi.TensorXf(flat + sign * step)
        params.update()
        images.append(np.array(mi.render(made, spp=16, seed=2, integrator=integrator)))
    differences = (images[0] - images[1]).sum() / 0.04
    params[key] = mi.TensorXf(flat)
    dr.enable_grad(params[key])
    params.update()
    image = mi.render(made, params, spp=16, seed=2, integrator=integrator)
    dr.backward(dr.sum(image.array))
    found = np.array(dr.grad(params[key]))[:, 0].sum()
    assert abs(differences) > 1e-3
    assert found == pytest.approx(differences, rel=0.03)


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
        ({"resolution": 64}, 'parameter "resolution": has no effect'),
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


@pytest.mark.parametrize("fault", ["missing", "truncated", "NaN", "other task"])
def test_damaged_files(mi_rgb, folder, tmp_path, fault):
    from mi_diffind.tasks.ggx import TASK as GGX

    path = tmp_path / "bad.npz"
    whole = (folder / "torus.npz").read_bytes()
    if fault == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif fault == "NaN":
        with np.load(folder / "torus.npz") as file:
            content = dict(file)
        entries = next(v for v in content.values() if v.dtype == np.float32 and v.ndim == 2 and v.shape[1] == 3)
        entries[3] = np.nan
        np.savez(path, **content)
    elif fault == "other task":
        path = GGX.file()
    sentence = refused(mi_rgb, folder, path.name, filename=str(path))
    assert len(sentence) < 400


def test_other_integrators_are_refused(mi_rgb, folder, tmp_path):
    """Rather than an image in which the shape is missing."""
    text = f"""<scene version="3.0.0"><shape type="neural_sdf" id="ring">
        <string name="filename" value="{folder}/torus.npz"/></shape>
        <integrator type="path"/><sensor type="perspective"/></scene>"""
    path = tmp_path / "scene.xml"
    path.write_text(text)
    with pytest.raises(SceneError, match=r'"ring".*"path_sdf".*found "path"'):
        scenes.load(path)
    path.write_text(text.replace('type="path"', 'type="path_sdf"'))
    assert len(scenes.load(path).shapes()) == 1
    mesh = scenes.load(path, exact=True).shapes()[0]
    assert mesh.face_count() == 96 * 48 * 2 and type(mesh) is mi_rgb.Mesh


def test_plugin_is_declared(mi_rgb):
    assert plugins.declared()["neural_sdf"].exact.name == "ply"
