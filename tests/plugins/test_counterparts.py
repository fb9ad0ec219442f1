"""Counterparts of ``neural_image`` and ``neural_texture``: scenes with the images that their files were made from."""

import json
import os

import numpy as np
import pytest
import texture_scenes
from texture_files import make, make_image, material
from texture_scenes import linear
from variants import VARIANTS, set_variant

from mi_diffind.arrays.tables import load_table, save_table
from mi_diffind.maps.source import load_source
from mi_diffind.plugins.support import footprint
from mi_diffind.scenes import comparison, loading

SIZE = WIDTH, HEIGHT = 32, 16

#: Texture → function that writes its file.
MAKE = {"neural_image": make_image, "neural_texture": make}

#: Each colour mode once.
RENDERED = [v for v in VARIANTS if v.endswith(("ad_rgb", "ad_mono", "ad_spectral_polarized"))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Images, the manifest ``wall.json`` that names them, and the files of both plugins."""
    import mitsuba as mi

    folder, albedo = tmp_path_factory.mktemp("walls"), material(*SIZE)["albedo"]
    for name, image in {"albedo": albedo, "roughness": np.ascontiguousarray(albedo[..., 1:2])}.items():
        mi.Bitmap(image).write(str(folder / f"{name}.png"))
    described = {"albedo": "albedo.png", "roughness": {"file": "albedo.png", "channels": "g"}}
    (folder / "wall.json").write_text(json.dumps(described))
    for name, write in MAKE.items():
        write(folder / f"{name}.npz", load_source(folder / "wall.json"), source_path="wall.json")
    return folder


def scene(mi, bsdf) -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    eye = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 3}, "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": eye, "film": film},
        "wall": {"type": "rectangle", "bsdf": bsdf},
    }  # fmt: skip


def exact(given, against="exact"):
    return loading.ParsedScene(given).load(exact=True, against=against)


@pytest.mark.parametrize("variant", RENDERED)
@pytest.mark.parametrize("name", MAKE)
def test_exact_counterparts(variant, folder, name):
    """Pictures are those of ``bitmap`` with the images; parameters of filters are left out."""
    mi = set_variant(variant)
    place = {"wrap_mode": "mirror", "to_uv": mi.ScalarTransform4f().scale([3, 3, 1])}
    eye = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    sensor = {"sensor_to_world": eye, "fov": 40.0, "resolution": 8, "filter": "anisotropic", "max_anisotropy": 2}
    filters = sensor if name == "neural_texture" else {}
    file = {"type": name, "filename": str(folder / f"{name}.npz"), **place, **filters}
    ours = {"base_color": {**file, "channels": "albedo"}, "roughness": {**file, "channels": "roughness"}}
    image = {"type": "bitmap", **place}
    theirs = {
        "base_color": {**image, "filename": str(folder / "albedo.png")},
        "roughness": {**image, "filename": str(folder / "roughness.png"), "raw": True},
    }
    ours, theirs = (scene(mi, {"type": "principled", **maps}) for maps in (ours, theirs))
    images = [mi.render(loaded, spp=8).numpy() for loaded in (exact(ours), mi.load_dict(theirs))]
    np.testing.assert_array_equal(*images)
    if not mi.is_rgb:
        return
    figures = comparison.compare(ours, spp=8, passes=1, progress=False).figures
    assert figures["psnr_db"] > 30 and figures["learned_plugins"] == 2
    assert figures["table_bytes"] == load_table(file["filename"]).nbytes
    if filters:
        written, levels = mi.render(loading.load_dict(ours), spp=8), exact(ours, "mipmap")
        assert {type(texture).__name__ for texture in footprint.textures(levels)} == {"MipMap"}
        assert np.abs(mi.render(levels, spp=8).numpy() - written.numpy()).mean() < 0.01


@pytest.mark.parametrize("name", ["x_diff", "x_normal", "x_disp", "x_arm"])
def test_counterparts_of_images_with_names(mi, tmp_path, rng, name):
    """Both counterparts show a single image as its file is read: linear if its name is that of data."""
    path = tmp_path / f"{name}.png"
    image = material(*SIZE)["normal" if name == "x_normal" else "albedo"][..., : 1 if name == "x_disp" else 3]
    mi.Bitmap(np.ascontiguousarray(image)).write(str(path))
    texture = {"type": "neural_texture", "filename": make(tmp_path / "a.npz", load_source(path)), "source": str(path)}
    given = scene(mi, {"type": "diffuse", "reflectance": {**texture, "channels": "image"}})
    si, values = texture_scenes.hits(mi, rng.random((2, 500))), []
    for against in ("exact", "mipmap"):
        values.append(exact(given, against).shapes()[0].bsdf().eval_diffuse_reflectance(si).numpy())
    np.testing.assert_allclose(*values, atol=5e-3)  # "mipmap" derives z of a normal from x and y
    expected = linear(image / 255) if name == "x_diff" else image / 255
    assert values[0].mean() == pytest.approx(expected.mean(), abs=0.02)


#: Recorded path of the source, recorded digest, parameter ``source`` and a sentence. OUTSIDE is another folder.
SOURCES = [
    ({}, {}, 'does not record its original image, give it as the parameter "source"'),
    ({"source_path": "gone.png"}, {}, "gone.png: no such file"),
    ({"source_path": "OUTSIDE/wall.json"}, {"source": "gone.png"}, "gone.png: no such file"),
    ({}, {"source": "OUTSIDE/albedo.png"}, 'has 3 channel(s), the map "roughness" has 1'),
    ({"source_path": "OUTSIDE/wall.json"}, {}, "has changed since"),
    ({"source_path": "OUTSIDE/wall.json", "source": "0" * 64}, {}, "has changed since"),
    ({"source_path": "OUTSIDE/wall.json", "source": "DIGEST"}, {}, ""),
]


@pytest.mark.parametrize("recorded, given, sentence", SOURCES)
@pytest.mark.parametrize("name", MAKE)
def test_sources_of_counterparts(mi, folder, tmp_path, name, recorded, given, sentence):
    """A recorded source outside of the file's folder is shown only if it is what the file was made from."""
    table = load_table(folder / f"{name}.npz")
    texts = {"OUTSIDE": os.path.relpath(folder, tmp_path), "DIGEST": load_source(folder / "wall.json").digest}
    for old, new in texts.items():
        recorded, given = ({k: v.replace(old, new) for k, v in d.items()} for d in (recorded, given))
    table.settings = {**{k: v for k, v in table.settings.items() if not k.startswith("source")}, **recorded}
    save_table(tmp_path / "wall.npz", table)
    if "source" in given:
        given = {"source": str(tmp_path / given["source"])}
    texture = {"type": name, "filename": str(tmp_path / "wall.npz"), "channels": "roughness", **given}
    described = scene(mi, {"type": "roughconductor", "alpha": texture})
    loading.load_dict(described)  # as written it needs none
    if sentence:
        with pytest.raises(loading.SceneError) as raised:
            exact(described)
        assert sentence in str(raised.value)
    else:
        exact(described)
