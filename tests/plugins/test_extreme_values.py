"""Constants that single precision cannot carry through a path: refused where a file or a property is read."""

import math

import drjit as dr
import numpy as np
import pytest
import texture_files

from mi_diffind.arrays.tables import load_table, save_table
from mi_diffind.core import compat
from mi_diffind.maps.source import from_arrays

ALLOWED = "allowed in a scene are -1e+09 to 1e+09"


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A material of the task ``texture``."""
    rng = np.random.default_rng(0)
    maps = {"albedo": rng.integers(0, 255, (16, 16, 3), dtype=np.uint8)}
    maps["roughness"] = rng.integers(0, 255, (16, 16, 1), dtype=np.uint8)
    maps["normal"] = np.full((16, 16, 3), [128, 128, 255], np.uint8)
    return texture_files.make(tmp_path_factory.mktemp("extreme") / "texture.npz", from_arrays(maps))


@pytest.fixture(scope="module")
def image_file(tmp_path_factory):
    """An image of which all channels are constant, of the task ``image``."""
    from mi_diffind.arrays.tables import Table
    from mi_diffind.maps.layout import Layout, MapLayout

    where = (("constant", 0.5),) * 3
    layout = Layout(8, 8, (MapLayout("albedo", "albedo", "srgb", 1, where),), (), ())
    path = tmp_path_factory.mktemp("extreme") / "image.npz"
    save_table(path, Table("image", {}, settings={"layout": layout.to_json()}))
    return str(path)


def changed(path, folder, values: dict, name: str = ""):
    """A copy of a file whose maps (or the one called ``name``) have these settings."""
    table = load_table(path)
    for m in table.settings["layout"]["maps"]:
        if name in ("", m["name"]):
            m.update({k: [v] * len(m["where"]) if k == "where" else v for k, v in values.items()})
    result = folder / "changed.npz"
    save_table(result, table)
    return str(result)


def constant(value, color_space="linear"):
    return {"where": ["constant", value], "color_space": color_space}


def plugin_of(name, path):
    bsdf = {"type": name, "filename": path}
    return bsdf if name == "neural_material" else {"type": "diffuse", "reflectance": {**bsdf, "channels": "albedo"}}


def image(mi, bsdf, emitter=None):
    """A ball in a white box: paths of five vertices."""
    at = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    loaded = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": at().look_at([0, -4, 0.5], [0, 0, 0], [0, 0, 1]), "film": film},
        "below": {"type": "rectangle", "to_world": at().translate([0, 0, -1]).scale(3), "bsdf": bsdf},
        "ball": {"type": "sphere", "bsdf": bsdf},
    })  # fmt: skip
    return np.array(mi.render(loaded, spp=4))


def refused(mi, dictionary) -> str:
    with pytest.raises(RuntimeError) as raised:
        mi.load_dict(dictionary)
    sentence = compat.one_sentence(raised.value)
    assert len(sentence.split(": parameter", 1)[-1]) < 300
    return sentence


@pytest.mark.parametrize("value", [1e30, -1e300, 2e9])
@pytest.mark.parametrize("name", ["neural_image", "neural_texture", "neural_material"])
def test_constants_in_files(mi_rgb, file, image_file, tmp_path, name, value):
    path = changed(image_file if name == "neural_image" else file, tmp_path, constant(value), "albedo")
    sentence = refused(mi_rgb, plugin_of(name, path))
    assert f'parameter "filename": {path}' in sentence
    if abs(value) < 1e38:
        assert f'found values up to {value:.3g} in the map "albedo", {ALLOWED}' in sentence
    else:
        assert f"a channel has the constant {value:g}, allowed are numbers from -1.7e+38 to 1.7e+38" in sentence


@pytest.mark.parametrize("name", ["neural_image", "neural_texture", "neural_material"])
def test_largest_constants_in_files(mi_rgb, file, image_file, tmp_path, name):
    """Finite along the paths of four bounces."""
    path = changed(image_file if name == "neural_image" else file, tmp_path, constant(1e9), "albedo")
    assert np.isfinite(image(mi_rgb, plugin_of(name, path))).all()


def test_colours_in_files_are_limited_where_they_are_linear(mi_rgb, image_file, tmp_path):
    """The sRGB-encoded number 10⁴ is 3.5 · 10⁹."""
    path = changed(image_file, tmp_path, constant(1e4, "srgb"))
    assert "found values up to 3.5e+09 in the map" in refused(mi_rgb, plugin_of("neural_image", path))
    path = changed(image_file, tmp_path, constant(1e3, "srgb"))
    bsdf = plugin_of("neural_image", path)
    texture = mi_rgb.load_dict(bsdf["reflectance"])
    value = np.array(texture.eval(dr.zeros(mi_rgb.SurfaceInteraction3f)))
    assert value == pytest.approx(((1e3 + 0.055) / 1.055) ** 2.4, rel=1e-5)
    assert np.isfinite(image(mi_rgb, bsdf)).all()


@pytest.mark.parametrize("name", ["neural_texture", "neural_material"])
def test_ranges_in_files(mi_rgb, file, tmp_path, name):
    for values, found in (({"low": -1e30}, "-1e+30"), ({"high": 1e30, "knee": 1e25}, "1e+30")):
        path = changed(file, tmp_path, {**values, "color_space": "linear"}, "albedo")
        assert f'found values up to {found} in the map "albedo", {ALLOWED}' in refused(mi_rgb, plugin_of(name, path))


def test_material_maps_are_all_checked(mi_rgb, file, tmp_path):
    path = changed(file, tmp_path, constant(1e30), "normal")
    assert 'in the map "normal"' in refused(mi_rgb, plugin_of("neural_material", path))
    assert np.isfinite(image(mi_rgb, {**plugin_of("neural_material", path), "ignore": "normal"})).all()


@pytest.mark.parametrize("raw", [False, True])
def test_bitmaps(mi_rgb, raw):
    mi = mi_rgb
    for value in (1e30, -1e30, 2e9):
        texture = {"type": "mipmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), value, np.float32)), "raw": raw}
        sentence = refused(mi, {"type": "diffuse", "reflectance": texture})
        assert f'parameter "bitmap": found values up to {value:.3g} in the map "image", {ALLOWED}' in sentence
    texture["bitmap"] = mi.Bitmap(np.full((4, 4, 3), 1e9, np.float32))
    assert np.isfinite(image(mi, {"type": "diffuse", "reflectance": texture})).all()


def test_transformations_of_coordinates(mi_rgb, image_file):
    for value in (1e30, 1e300, math.nan):
        matrix = mi_rgb.ScalarTransform4f([[value, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        sentence = refused(mi_rgb, {"type": "neural_image", "filename": image_file, "to_uv": matrix})
        assert 'parameter "to_uv": found an entry of ' in sentence and "allowed are up to 1e+18" in sentence
