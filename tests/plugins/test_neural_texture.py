"""The texture ``neural_texture``: levels, filters, the paper's arrays, counterparts; see ``test_texture_contract``."""

import json

import drjit as dr
import numpy as np
import pytest
import texture_scenes
from arrays import aligned, numpy_of
from texture_files import make, material
from texture_scenes import linear

from mi_diffind.arrays.tables import load_table
from mi_diffind.maps.source import from_arrays, load_source
from mi_diffind.measure.clock import bsdf_operations, count
from mi_diffind.plugins.support import footprint
from mi_diffind.scenes import loading
from mi_diffind.tasks.texture import TASK

SIZE = WIDTH, HEIGHT = 32, 16

FILTERS = ("off", "trilinear", "anisotropic", "stochastic")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("textures")
    source = from_arrays(material(WIDTH, HEIGHT))
    found = {preset: make(folder / f"{preset}.npz", source, preset) for preset in ("ours", "paper")}
    return {**found, "clamp": make(folder / "clamp.npz", source, border="clamp")}


@pytest.fixture(scope="module")
def file(files):
    return files["ours"]


def plugin(file, name="trilinear", channels="albedo", **more):
    return {"type": "neural_texture", "filename": file, "channels": channels, "filter": name, **more}


def opened(mi, file, storage=""):
    return TASK.model(TASK.load(file), mi.TensorXf, storage).image


def floats(mi, *arrays):
    return [mi.Float(aligned(x)) for x in arrays]


def expected(mi, image, name, uv, level):
    """The channels of a map in its own color space."""
    u, v, level = floats(mi, *uv, level)
    return numpy_of(map(mi.Float, image.maps(image.filtered(u, v, level), [name])[name])).T


# -- what is read ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["x_diff", "x_normal", "x_disp", "x_arm"])
def test_counterparts_of_images_with_names(mi_rgb, tmp_path, rng, name):
    """Both counterparts show a single image as its file is read: linear if its name is that of data."""
    mi, path = mi_rgb, tmp_path / f"{name}.png"
    image = material(WIDTH, HEIGHT)["normal" if name == "x_normal" else "albedo"][..., : 1 if name == "x_disp" else 3]
    mi.Bitmap(np.ascontiguousarray(image)).write(str(path))
    texture = plugin(make(tmp_path / "a.npz", load_source(path)), "off", "image", source=str(path))
    bsdf = {"type": "diffuse", "reflectance": texture}
    parsed, uv = (
        loading.ParsedScene({"type": "scene", "shape": {"type": "rectangle", "bsdf": bsdf}}),
        rng.random((2, 500)),
    )
    values = []
    for against in ("exact", "mipmap"):
        (shape,) = parsed.load(exact=True, against=against, needs=()).shapes()
        values.append(shape.bsdf().eval_diffuse_reflectance(texture_scenes.hits(mi, uv)).numpy())
    np.testing.assert_allclose(*values, atol=5e-3)  # "mipmap" derives z of a normal from x and y
    expected = linear(image / 255) if name == "x_diff" else image / 255
    assert values[0].mean() == pytest.approx(expected.mean(), abs=0.02)


@pytest.mark.parametrize("preset", ["ours", "paper"])
def test_off_costs_no_footprint(mi_rgb, files, rng, preset):
    """The arrays of coarser levels and of the footprint are not read."""
    mi = mi_rgb
    uv, (ddx, ddy) = rng.random((2, 200)), texture_scenes.footprints(rng, 200, SIZE)
    image, textures = opened(mi, files[preset]), {n: mi.load_dict(plugin(files[preset], n)) for n in FILTERS}
    si = texture_scenes.hits(mi, uv, ddx, ddy)
    reads = {name: count(lambda t=t: t.eval(si)) for name, t in textures.items()}
    u, v = floats(mi, *uv)
    dr.make_opaque(u, v)
    needed = image.layout.needed("albedo")
    assert reads["off"].gathers == count(lambda: [image.stored(u, v)[i] for i in needed]).gathers
    if preset == "paper":  # the footprint's array is one more, of one dimension
        assert reads["trilinear"].gathers == reads["off"].gathers + 1
        assert reads["anisotropic"].gathers == 4 * reads["off"].gathers + 1
    assert reads["off"].gathers < reads["trilinear"].gathers == reads["stochastic"].gathers
    assert 3 * reads["trilinear"].gathers < reads["anisotropic"].gathers <= 4 * reads["trilinear"].gathers
    assert reads["off"].instructions < reads["trilinear"].instructions - 100


# -- hard cases --------------------------------------------------------------------------------------------------------


# -- in scenes ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["off", "anisotropic"])
def test_maps_of_one_file_are_read_once(mi_rgb, file, name):
    """In one material, seen by a sensor: all of its maps at one place of one level, of one footprint.

    Only the words of a further map's channels are read in addition.
    """
    mi = mi_rgb
    found = []
    for bsdf in (
        {"type": "diffuse", "reflectance": plugin(file, name)},
        {"type": "principled", "base_color": plugin(file, name), "roughness": plugin(file, name, "roughness")},
        {"type": "neural_disney", "base_color": plugin(file, name), "roughness": plugin(file, name, "roughness")},
    ):
        shape = {"type": "rectangle", "bsdf": bsdf}
        loaded = texture_scenes.plane(mi, None, shape=shape)
        footprint.attach(loaded)
        found.append(bsdf_operations(loaded.shapes()[0].bsdf(), ("eval",))["eval"].gathers)
    other = {"base_color": {"type": "checkerboard"}, "roughness": {"type": "checkerboard"}}  # which gathers nothing
    tables = bsdf_operations(mi.load_dict({"type": "neural_disney", **other}), ("eval",))["eval"].gathers
    assert found[0] <= found[1] == found[2] - tables < 2 * found[0]


# -- counterparts and words --------------------------------------------------------------------------------------------

LAMP = """<shape type="rectangle"><emitter type="area"><texture name="radiance" type="neural_texture">
        <string name="filename" value="wall.npz"/><string name="channels" value="MAP"/>MORE
        <transform name="to_uv"><scale x="3" y="3"/></transform>
    </texture></emitter></shape>"""


def test_counterparts(mi_rgb, tmp_path):
    """The image or the manifest that it was made from, unfiltered or filtered; parameters of filters are left out."""
    mi = mi_rgb
    maps = material(WIDTH, HEIGHT)
    mi.Bitmap(maps["albedo"]).write(str(tmp_path / "albedo.png"))
    mi.Bitmap(maps["roughness"]).write(str(tmp_path / "roughness.png"))
    (tmp_path / "wall.json").write_text(json.dumps({"albedo": "albedo.png", "roughness": "roughness.png"}))
    sensor = (
        '<transform name="sensor_to_world"><lookat origin="0,0,3" target="0,0,0" up="0,1,0"/></transform>'
        '<float name="fov" value="40"/><integer name="resolution" value="8"/>'
    )
    for name, source, more in (
        ("albedo", "wall.json", '<string name="filter_type" value="trilinear"/>'),
        ("roughness", "wall.json", '<string name="filter" value="anisotropic"/>' + sensor),
        ("albedo", "albedo.png", '<integer name="max_anisotropy" value="2"/>'),
    ):
        held = ("albedo",) if source.endswith("png") else ("albedo", "roughness")
        make(tmp_path / "wall.npz", from_arrays({k: maps[k] for k in held}), source_path=source)
        scene = texture_scenes.scene_xml(LAMP.replace("MAP", name).replace("MORE", more), size=8, depth=1)
        (tmp_path / "scene.xml").write_text(scene)
        bitmap = {"type": "bitmap", "filename": str(tmp_path / f"{name}.png"), "raw": name == "roughness"}
        image = {**bitmap, "to_uv": mi.ScalarTransform4f().scale([3, 3, 1])}
        exact = loading.load(tmp_path / "scene.xml", exact=True)
        stock = texture_scenes.plane(mi, image, shape=None, size=8)
        si = texture_scenes.hits(mi, np.random.default_rng(1).random((2, 50)), (0.05, 0), (0, 0.05))
        a, b = (s.emitters()[0] for s in (exact, stock))
        np.testing.assert_allclose(a.eval(si).numpy(), b.eval(si).numpy(), atol=1e-6)
        levels = loading.load(tmp_path / "scene.xml", exact=True, against="mipmap")
        (found,) = footprint.textures(levels)
        assert type(found).__name__ == "MipMap" and found.map.name in (name, "image")
        ours = loading.load(tmp_path / "scene.xml")
        np.testing.assert_allclose(
            ours.emitters()[0].eval(si).numpy(), levels.emitters()[0].eval(si).numpy(), atol=0.03
        )
        (report,) = loading.reports(ours)
        assert (
            report["plugin"] == "neural_texture" and report["table_bytes"] == load_table(tmp_path / "wall.npz").nbytes
        )
        assert report["footprint"] == ["uv partials", "sensor"] and report["map"] == name
