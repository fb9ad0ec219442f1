"""
Derivatives of the *default* storage, bytes in most plugins, against central differences: all parameters that are
exposed as differentiable, and the coordinates of textures. Entries of bytes are no parameters.
"""

import drjit as dr
import numpy as np
import pytest
import texture_files
from arrays import aligned
from learned_bsdfs import handmade
from radiance_fields import ball_table
from sdf_fields import sparse_table

from mi_diffind.arrays.tables import save_table
from mi_diffind.maps.source import from_arrays

COUNT = 20_000


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("defaults")
    rng = np.random.default_rng(0)
    maps = {"albedo": rng.integers(60, 200, (16, 16, 3), dtype=np.uint8)}
    maps["roughness"] = rng.integers(60, 200, (16, 16, 1), dtype=np.uint8)
    texture_files.make(folder / "texture.npz", from_arrays(maps))
    save_table(folder / "bsdf.npz", handmade())
    save_table(folder / "torus.npz", sparse_table())
    save_table(folder / "ball.npz", ball_table())
    return folder


def directions(mi, rng):
    """Off the horizon, across which values jump."""
    z, phi = 0.3 + 0.7 * rng.random(COUNT), 2 * np.pi * rng.random(COUNT)
    r = np.sqrt(1 - z * z)
    return mi.Vector3f(*(mi.Float(aligned(x)) for x in (r * np.cos(phi), r * np.sin(phi), z)))


BSDFS = {
    "neural_ggx": ({"alpha": 0.3, "eta": 0.6, "k": 2.0, "specular_reflectance": 0.8}, ("alpha", "eta", "k"), 4e-3),
    "neural_disney": (
        {"roughness": 0.4, "metallic": 0.3, "clearcoat": 0.5, "sheen": 0.4, "specular": 0.5, "flatness": 0.3},
        ("roughness.value", "metallic.value", "clearcoat.value", "sheen.value", "specular", "flatness.value"),
        1e-3,
    ),
    "neural_material": ({"clearcoat": 0.5, "sheen": 0.4, "metallic": 0.3}, ("clearcoat", "sheen", "metallic"), 4e-3),
    "neural_bsdf": ({"scale": 0.7}, ("scale", "edge", "first.alpha_u", "second.gamma"), 2e-3),
}


@pytest.mark.parametrize("name", BSDFS)
def test_parameters_of_materials(mi_rgb, files, rng, name):
    mi, (given, wanted, step) = mi_rgb, BSDFS[name]
    file = {"neural_material": "texture.npz", "neural_bsdf": "bsdf.npz"}.get(name)
    bsdf = mi.load_dict({"type": name, **given, **({"filename": str(files / file)} if file else {})})
    params, ctx = mi.traverse(bsdf), mi.BSDFContext()
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    si.wi, wo = directions(mi, rng), directions(mi, rng)
    si.uv = mi.Point2f(*(mi.Float(aligned(rng.random(COUNT))) for _ in range(2)))

    def total():
        return dr.mean(dr.minimum(sum(bsdf.eval(ctx, si, wo)), 4.0))

    keys = [next(k for k in params.keys() if k in (name_, f"{name_}.value")) for name_ in wanted]
    for key in keys:
        assert params.flags(key) != mi.ParamFlags.NonDifferentiable
        before, ends = mi.Float(dr.detach(params[key])), []
        for sign in (1, -1):
            params[key] = before + sign * step
            params.update()
            ends.append(total().numpy().astype(np.float64).item())
        params[key] = mi.Float(before)
        dr.enable_grad(params[key])
        params.update()
        dr.backward(total())
        slope = dr.grad(params[key]).numpy().item()
        params[key] = mi.Float(before)
        params.update()
        expected = (ends[0] - ends[1]) / (2 * step)
        # Tables are straight between entries, where derivatives jump
        assert slope == pytest.approx(expected, rel=0.03, abs=2e-4) and abs(expected) > 1e-4, key


@pytest.mark.parametrize("name", ["neural_texture", "mipmap"])
def test_coordinates_of_textures(mi_rgb, files, rng, name):
    mi = mi_rgb
    source = {"filename": str(files / "texture.npz"), "channels": "albedo"}
    if name == "mipmap":
        source = {"bitmap": mi.Bitmap(rng.random((16, 16, 3)).astype(np.float32))}
    texture = mi.load_dict({"type": name, "filter": "off", **source})
    si = dr.zeros(mi.SurfaceInteraction3f, COUNT)
    uv = rng.random((2, COUNT))
    values = []
    for sign in (1, -1):
        si.uv = mi.Point2f(mi.Float(aligned(uv[0] + sign * 1e-4)), mi.Float(aligned(uv[1])))
        values.append(texture.eval_1(si).numpy().astype(np.float64))
    si.uv = mi.Point2f(*(mi.Float(aligned(x)) for x in uv))
    dr.enable_grad(si.uv)
    dr.backward(dr.sum(texture.eval_1(si)))
    expected, slope = (values[0] - values[1]) / 2e-4, dr.grad(si.uv).numpy()[0]
    assert np.median(np.abs(slope - expected)) < 0.02 * np.abs(expected).mean()


def scene(mi, files, name):
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensor = {"type": "perspective", "film": film}
    lamp = {"lamp": {"type": "point", "position": [-2, -4, 5], "intensity": 40.0}}
    if name == "neural_field":
        integrator = {"type": name, "filename": str(files / "ball.npz"), "jitter": False}
        sensor |= {"fov": 12, "to_world": at().look_at([0.1, -5, 0.4], [0.1, 0, 0.1], [0, 0, 1])}
        return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor}), "integrator.to_world"
    # A part of the torus without an outline
    solid = {"type": name, "filename": str(files / "torus.npz"), "normals": "smooth", "id": "a"}
    sensor |= {"fov": 3, "to_world": at().look_at([0.5, -3, 2.5], [0.5, -1.75, 0.4], [0, 0, 1])}
    loaded = {"type": "scene", "integrator": {"type": "path_sdf", "max_depth": 2}, "sensor": sensor, "a": solid, **lamp}
    return mi.load_dict(loaded), "a.to_world"


@pytest.mark.parametrize("name, tolerance", [("neural_sdf", 0.05), ("neural_field", 0.1)])
def test_places(mi_rgb, files, name, tolerance):
    """With tolerances that the manual pages state for fields whose values jump from cell to cell."""
    mi = mi_rgb
    loaded, key = scene(mi, files, name)
    params = mi.traverse(loaded)
    start, images, step = mi.AffineTransform4f(params[key]), [], 2e-3
    for v in (step, -step):
        params[key] = mi.AffineTransform4f().translate(v * mi.Vector3f(0.3, 0.7, -0.4)) @ start
        params.update()
        images.append(np.array(mi.render(loaded, spp=16, seed=2)).astype(np.float64))
    v = mi.Float(0)
    dr.enable_grad(v)
    params[key] = mi.AffineTransform4f().translate(v * mi.Vector3f(0.3, 0.7, -0.4)) @ start
    params.update()
    dr.forward(v, dr.ADFlag.ClearEdges)
    forward = np.array(loaded.integrator().render_forward(loaded, params, spp=16, seed=2))
    expected = (images[0] - images[1]) / (2 * step)
    assert np.abs(expected).mean() > 1e-3
    assert np.abs(forward - expected).mean() < tolerance * np.abs(expected).mean()


def test_bytes_are_no_parameters(mi_rgb, files):
    """The pages say that arrays are exposed with ``storage`` ``float32`` alone; arrays of a grid are no bytes."""
    mi = mi_rgb
    given = {
        "neural_ggx": {},
        "neural_disney": {},
        "neural_material": {"filename": str(files / "texture.npz")},
        "neural_texture": {"filename": str(files / "texture.npz"), "channels": "albedo"},
        "neural_bsdf": {"filename": str(files / "bsdf.npz")},
        "neural_sdf": {"filename": str(files / "torus.npz")},
    }
    for name, more in given.items():
        byte, floats = (
            {k for k in mi.traverse(mi.load_dict({"type": name, **more, **storage})).keys() if "tables." in k}
            for storage in ({"storage": "uint8"}, {"storage": "float32"})
        )
        assert not byte and floats, name
    grid = {"type": "neural_field", "filename": str(files / "ball.npz")}
    assert "tables.density" in mi.traverse(mi.load_dict(grid)).keys()
