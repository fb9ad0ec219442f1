"""Conversion of scenes: what replaces Mitsuba's plugins, what stays and why, and fits that are not repeated."""

import json
import struct
import zlib

import numpy as np
import pytest
import trimesh

from mi_diffind import comparison, conversion, scenes
from mi_diffind.errors import UsageError
from mi_diffind.tasks.sdf import serialized
from mi_diffind.tasks.sdf.mesh import MeshError, load_mesh

SCENE = """
<scene version="3.0.0">
    <default name="rough" value="0.3"/>
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="24"/>
        <integer name="height" value="16"/><rfilter type="box"/></film>
        <transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform></sensor>
    <emitter type="constant"/>
    OBJECTS
</scene>
"""

BALL = """<shape type="ply" id="ball"><string name="filename" value="ball.ply"/>MORE
    <bsdf type="principled"><rgb name="base_color" value="0.6,0.3,0.2"/><float name="roughness" value="$rough"/></bsdf>
</shape>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a ball, an image and short fits, which it counts."""
    import mitsuba as mi

    trimesh.creation.icosphere(2).export(tmp_path / "ball.ply")
    y, x = np.mgrid[:64, :64] / 64
    image = np.stack([0.5 + 0.4 * np.sin(6 * np.pi * x), 0.3 + 0.2 * y, 0.2 + 0 * x], axis=-1)
    mi.Bitmap(np.rint(255 * image).astype(np.uint8)).write(str(tmp_path / "image.png"))
    fits, fit = [], conversion.fit

    def short(task, **options):
        fits.append((task, options["source"]))
        less = {"bytes": 2**14, "steps": 2} if task == "sdf" else {"steps": 40, "batch": 2**12, "compression": 3}
        return fit(task, **{**options, **less})

    monkeypatch.setattr(conversion, "fit", short)
    return tmp_path, fits


def parsed(folder, objects, name="scene.xml"):
    (folder / name).write_text(SCENE.replace("OBJECTS", objects))
    return scenes.ParsedScene(folder / name)


def test_a_converted_scene_shows_the_same(mi_rgb, folder):
    """Materials, textures and a mesh, in memory and written to another folder; a second time nothing is fitted."""
    folder, fits = folder
    floor = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
        <translate y="-1"/></transform><bsdf type="twosided" id="floor"><bsdf type="principled">
        <texture name="base_color" type="bitmap"><string name="filename" value="image.png"/>
        <string name="filter_type" value="bilinear"/></texture></bsdf></bsdf></shape>"""
    scene = parsed(folder, BALL.replace("MORE", "") + floor)
    stock = scenes.render(scene.load(), 16)[0]
    conversions = conversion.replace_stock(scene, ["principled", "bitmap", "mesh"], folder / "tables")
    assert [(c.stock, c.learned, c.name) for c in conversions] == [
        ("ply", "neural_sdf", "ball"), ("principled", "neural_disney", "ball"),
        ("principled", "neural_disney", "floor"), ("bitmap", "neural_texture", "floor"),
        ("path", "path_sdf", "path"),
    ]  # fmt: skip
    assert [task for task, _ in fits] == ["sdf", "texture"]
    assert conversion.summary(conversions)[0] == "replaced    1 x ply → neural_sdf"
    (folder / "other").mkdir()
    conversion.write_scene(scene, folder / "other" / "new.xml")
    learned = scenes.render(scenes.load(folder / "other" / "new.xml"), 16)[0]
    assert stock.std() > 0.1 and np.abs(learned - stock).mean() < 0.02
    exact = scenes.load(folder / "other" / "new.xml", exact=True)
    assert "PLYMesh" in [shape.class_name() for shape in exact.shapes()]
    twice = parsed(folder, BALL.replace("MORE", "") + floor, "again.xml")
    assert len(conversion.replace_stock(twice, ["mesh", "bitmap"], folder / "tables")) == 3 and len(fits) == 2


@pytest.mark.parametrize(
    "group, objects, name, reason",
    [
        ("principled", '<bsdf type="principled" id="Glass"><float name="spec_trans" value="0.9"/></bsdf>',
         'principled "Glass"', "transmits light"),
        ("principled", '<bsdf type="twosided" id="Gem"><bsdf type="principled"><float name="eta" value="4"/></bsdf>'
         "</bsdf>", 'principled "Gem"', 'the parameter "eta" 4, the Disney BRDF allows 1 to 3'),
        ("bitmap", '<bsdf type="diffuse" id="Sharp"><texture type="bitmap" name="reflectance"><string name="filename" '
         'value="image.png"/><string name="filter_type" value="nearest"/></texture></bsdf>',
         'bitmap "Sharp"', 'the filter_type "nearest", allowed are bilinear'),
        ("bitmap", '<bsdf type="diffuse" id="Lost"><texture type="bitmap" name="reflectance"><string name="filename" '
         'value="none.png"/></texture></bsdf>', 'bitmap "Lost"', "names no file that exists"),
        ("mesh", BALL.replace("MORE", '<emitter type="area"/>'), 'ply "ball"', "emits light"),
        ("mesh", BALL.replace("MORE", '<transform name="to_world"><scale x="1" y="2" z="1"/></transform>'),
         'ply "ball"', "allowed are rotations, uniform scales"),
        ("mesh", BALL.replace("ball.ply", "bowl.ply").replace("MORE", ""), 'ply "ball"', "encloses no solid"),
        ("mesh", '<shape type="ply"><string name="filename" value="ball.ply"/><bsdf type="diffuse" id="Worn"><texture '
         'name="reflectance" type="checkerboard"/></bsdf></shape>', "scene.xml", "with textures (checkerboard)"),
    ],
)  # fmt: skip
def test_what_stays_is_named_with_the_reason(mi_rgb, folder, group, objects, name, reason):
    folder, fits = folder
    half = trimesh.creation.icosphere(3)
    half.update_faces(half.triangles_center[:, 1] < 0)
    half.export(folder / "bowl.ply")
    scene = parsed(folder, objects)
    (one,) = conversion.replace_stock(scene, [group], folder / "tables")
    assert one.learned == "" and reason in one.reason and name in str(one) and not fits
    assert conversion.summary([one]) == [f"kept        {one}"]
    stays = scene.change(lambda state: [node.props.plugin_name() for node in state.nodes])
    assert one.stock in stays and "path" in stays


def test_the_command_and_a_comparison_with_the_stock_scene(mi_rgb, tmp_path, capsys):
    import mi_diffind
    from mi_diffind.cli import main

    materials = '<bsdf type="principled" id="Clay"/><bsdf type="principled" id="Glass"><float name="spec_trans" '
    ball = 'value="1"/></bsdf><shape type="sphere"><ref id="Clay"/></shape>'
    parsed(tmp_path, materials + ball)
    scene, new = str(tmp_path / "scene.xml"), tmp_path / "new.xml"
    arguments = ["-o", str(new), "--json", str(tmp_path / "a.json"), "--variant", mi_rgb.variant()]
    assert main(["convert", scene, *arguments]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed == [
        "replaced    1 x principled → neural_disney",
        'kept        principled "Glass": transmits light (spec_trans), which the Disney BRDF does not',
        f"scene       {new}",
    ]  # fmt: skip
    assert [c["learned"] for c in json.loads((tmp_path / "a.json").read_text())["conversions"]] == ["neural_disney", ""]
    assert new.read_text().count("neural_disney") == 1 and not (tmp_path / "new_tables").exists()
    for output, fault in (("scene.xml", "the same file as the scene"), ("new.json", "allowed is .xml")):
        assert main(["convert", scene, "-o", str(tmp_path / output)]) == 2 and fault in capsys.readouterr().err
    result = mi_diffind.compare(scene, 8, learn=["principled"], progress=False)
    assert comparison.truth_label(result.figures) == "stock (principled), 8 spp" and result.further == ()
    assert printed[:2] == str(result).splitlines()[3:5] and result.figures["psnr_db"] > 25
    same = mi_diffind.compare(new, 8, against="principled", progress=False)
    np.testing.assert_allclose(same.written, result.written, atol=1e-4)


def test_unknown_groups_are_refused(mi_rgb, folder):
    with pytest.raises(UsageError, match='found "glass", allowed are principled, mesh, bitmap'):
        conversion.replace_stock(parsed(folder[0], ""), ["glass"], folder[0])


def test_misspelt_parameters_stay_errors(mi_rgb, folder):
    """Conversion reads the properties of the scene, which must not make them known to a plugin."""
    scene = parsed(folder[0], '<bsdf type="principled" id="a"><float name="rougness" value="0.9"/></bsdf>'
                   '<shape type="sphere"><ref id="a"/></shape>')  # fmt: skip
    (one,) = conversion.replace_stock(scene, ["principled"], folder[0])
    assert one.reason == 'has the parameter "rougness", which the learned plugin lacks'
    with pytest.raises(scenes.SceneError, match="rougness"):
        scene.load()


def write_serialized(path, meshes, version, double=False):
    """Write meshes with texture coordinates in Mitsuba's format."""
    data, starts = b"", []
    for mesh in meshes:
        starts.append(len(data))
        content = struct.pack("<I", 0x2 | (0x2000 if double else 0x1000)) + (b"name\0" if version == 4 else b"")
        content += struct.pack("<2Q", len(mesh.vertices), len(mesh.faces))
        content += mesh.vertices.astype("<f8" if double else "<f4").tobytes()
        content += np.zeros((len(mesh.vertices), 2), "<f8" if double else "<f4").tobytes()
        data += struct.pack("<2H", 0x041C, version) + zlib.compress(content + mesh.faces.astype("<u4").tobytes())
    path.write_bytes(data + struct.pack(f"<{len(starts)}{'Q' if version == 4 else 'I'}I", *starts, len(starts)))


@pytest.mark.parametrize("version, double", [(4, False), (4, True), (3, False)])
def test_serialized_meshes(mi_rgb, tmp_path, version, double):
    """Read as Mitsuba reads them, and as one mesh of all for a fit."""
    mi, path = mi_rgb, tmp_path / "two.serialized"
    meshes = [trimesh.creation.icosphere(1), trimesh.creation.box(bounds=[[2, 0, 0], [3, 1, 2]])]
    write_serialized(path, meshes, version, double)
    for index, (vertices, faces) in enumerate(serialized.read(path)):
        shape = mi.load_dict({"type": "serialized", "filename": str(path), "shape_index": index})
        params = mi.traverse(shape)
        assert np.allclose(params["vertex_positions"].numpy().reshape(-1, 3), vertices, atol=1e-6)
        assert np.array_equal(params["faces"].numpy().reshape(-1, 3), faces)
    both = load_mesh(path)
    assert both.components == 2 and both.watertight and both.scale == pytest.approx(4)
    assert load_mesh(f"{path}#1").digest == load_mesh((meshes[1].vertices, meshes[1].faces)).digest
    with pytest.raises(MeshError, match='holds no mesh "2", allowed are 0 to 1'):
        load_mesh(f"{path}#2")
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(MeshError, match="no file of serialized meshes, or cut short"):
        load_mesh(path)


def test_shapes_of_a_scene(mi_rgb, tmp_path):
    """One by its id, placed as in the scene, or all; the fitted field finds its mesh again."""
    from mi_diffind.plugins.support import sdf_meshes

    trimesh.creation.icosphere(1).export(tmp_path / "ball.ply")
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="ply" id="ball"><string name="filename" value="ball.ply"/><transform '
        'name="to_world"><scale x="1" y="2" z="1"/><translate x="5"/></transform></shape>'
        '<shape type="cube" id="box"/><shape type="sphere" id="round"/></scene>'
    )
    ball = load_mesh(f"{path}#ball")
    assert ball.scale == pytest.approx(4) and ball.centre == pytest.approx((5, 0, 0)) and ball.components == 1
    assert load_mesh(path).components == 2 and load_mesh(path).scale == pytest.approx(7)
    with pytest.raises(MeshError, match='holds no mesh "round", found "ball", "box"'):
        load_mesh(f"{path}#round")
    written = sdf_meshes._as_ply(tmp_path / "scene.xml#box", (0,))
    assert load_mesh(written).digest == load_mesh(f"{path}#box").digest
