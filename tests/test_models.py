"""glTF models as scenes: places, images the right way up, factors, both sides, and files that are refused."""

import base64
import json
import struct
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from mi_diffind.commands.cli import main
from mi_diffind.core.files import CACHE, OutputError
from mi_diffind.maps.entries import SourceError
from mi_diffind.maps.source import load_source
from mi_diffind.scenes import conversion, loading
from mi_diffind.scenes.models import model_scene

#: Colours of the quarters of an image: above, below; left, right.
COLORS = np.array([[[200, 30, 30], [30, 200, 30]], [[30, 30, 200], [200, 200, 30]]], np.uint8)

#: Corners of a card in the plane z = 0 that faces +z, and their texture coordinates as glTF has them: v points down.
CORNERS = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float32)
TEXCOORDS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
TRIANGLES = np.array([[0, 3, 2], [0, 2, 1]], np.uint16)


def card(**change):
    """Return the JSON and the buffer of a card with a material, whose keys ``change`` replaces."""
    image = BytesIO()
    Image.fromarray(COLORS.repeat(32, axis=0).repeat(32, axis=1)).save(image, "PNG")
    parts = [CORNERS.tobytes(), TEXCOORDS.tobytes(), TRIANGLES.tobytes(), image.getvalue()]
    starts = np.cumsum([0, *map(len, parts)])
    material = {
        "name": "Card / ä", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.25}, **change
    }  # fmt: skip
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [-1, -1, 0], "max": [1, 1, 0]},
        {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
        {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    content = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [10, 20, 30], "scale": [2, 2, 2]}],
        "meshes": [{"name": "Card", "primitives": [primitive]}], "accessors": accessors, "materials": [material],
        "images": [{"bufferView": 3, "mimeType": "image/png"}], "textures": [{"source": 0}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(a), "byteLength": len(p)} for a, p in zip(starts[:-1], parts, strict=True)
        ],
        "buffers": [{"byteLength": sum(map(len, parts))}],
    }  # fmt: skip
    return content, b"".join(parts)


def write(path, content, data):
    """Write a model, as text with its data inside or as a binary file."""
    if path.suffix == ".gltf":
        content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        path.write_text(json.dumps(content))
        return path
    text, data = (part + pad * (-len(part) % 4) for part, pad in ((json.dumps(content).encode(), b" "), (data, b"\0")))
    chunks = struct.pack("<2I", len(text), 0x4E4F534A) + text + struct.pack("<2I", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


#: A quarter turn of the texture coordinates, counterclockwise; the image turns clockwise.
QUARTER = {"rotation": np.pi / 2, "offset": [0, 1]}


def place(content, change):
    """Give the texture of a card a transform."""
    texture = content["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    texture["extensions"] = {"KHR_texture_transform": change}


@pytest.mark.parametrize("extension, change", [("glb", {}), ("gltf", QUARTER)])
def test_a_card_is_seen_the_right_way_up(mi_rgb, tmp_path, monkeypatch, extension, change):
    """Quarters of its image where a viewer in front sees them, from a camera that frames it."""
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    content, data = card(doubleSided=True)
    place(content, change)
    path, colors = write(tmp_path / f"card.{extension}", content, data), np.rot90(COLORS, -1 if change else 0)
    scene = loading.load(path, {"width": 32, "height": 32, "spp": 16})
    picture = loading.render(scene)[0][..., :3]
    (shape,) = [s for s in scene.shapes() if "PLY" in s.class_name()]
    assert np.allclose(shape.bbox().min, [8, 18, 30]) and np.allclose(shape.bbox().max, [12, 22, 30])
    for row, column in np.ndindex(2, 2):
        seen = picture[12 + 8 * row, 12 + 8 * column]
        assert (seen > 0.6 * seen.max()).tolist() == (colors[row, column] > 100).tolist()
    before = sorted((tmp_path / "cache").rglob("*"))
    assert main(["render", str(path), "-o", str(tmp_path / "a.exr"), "-D", "width=16", "-D", "spp=1"]) == 0
    assert sorted((tmp_path / "cache").rglob("*")) == before and len(before) == 4


def test_factors_and_materials_without_images(mi_rgb, tmp_path):
    """Numbers of a material, opacity, both sides and the default material, as the file has them."""
    content, data = card(alphaMode="BLEND", doubleSided=True)
    content["materials"][0]["pbrMetallicRoughness"] = {
        "baseColorFactor": [0.5, 0.25, 0.125, 0.75], "roughnessFactor": 0.6, "metallicFactor": 0.1
    }  # fmt: skip
    content["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}, "indices": 2}]})
    content["nodes"].append({"mesh": 1})
    content["scenes"][0]["nodes"].append(1)
    scene = loading.ParsedScene(model_scene(write(tmp_path / "m.gltf", content, data), tmp_path / "parts"))
    nodes = {n.props.plugin_name(): n.props for n in scene.change(lambda state: list(state.nodes))[::-1]}
    assert nodes["mask"]["opacity"] == 0.75 and "twosided" in nodes
    inner = [n for n in scene.change(lambda state: list(state.nodes)) if n.props.plugin_name() == "principled"]
    colors = [np.allclose(list(n.props["base_color"]), [0.5, 0.25, 0.125]) for n in inner]
    assert sorted(colors) == [False, True]
    painted = inner[colors.index(True)].props
    assert (painted["roughness"], painted["metallic"]) == pytest.approx((0.6, 0.1))
    assert scene.load().shapes()


def test_a_model_is_converted(mi_rgb, tmp_path, monkeypatch):
    """Its parts beside the new scene, one material of a file, and nothing in the user's cache."""
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    fit = conversion.fit
    monkeypatch.setattr(conversion, "fit", lambda task, **given: fit(task, **{**given, "steps": 40, "batch": 2**12}))
    content, data = card(doubleSided=True)
    place(content, QUARTER)
    path, new = write(tmp_path / "card.glb", content, data), tmp_path / "new.xml"
    (one,) = result = conversion.convert(path, new, defines={"width": 16, "height": 16}, progress=False)
    assert (one.stock, one.learned, one.name) == ("twosided", "neural_material", "Card_ä")
    text = new.read_text()
    assert "twosided" not in text and 'name="two_sided" value="true"' in text and 'name="to_uv"' in text
    assert result.disk_bytes[0] > 0 and result.check is not None and not (tmp_path / "cache").exists()
    names = {file.name for file in (tmp_path / "new_model").iterdir()}
    assert names == {"scene.xml", "Card_0.ply", "Card_ä_albedo.png"}
    assert len(list(tmp_path.glob("new_tables/*.npz"))) == 1
    assert loading.load(new).shapes()
    content["meshes"][0]["name"] = "Other"
    with pytest.raises(OutputError, match=r"new_model: holds Card_0\.ply, which is not of other\.glb: remove"):
        conversion.convert(write(tmp_path / "other.glb", content, data), new, progress=False)
    assert {file.name for file in (tmp_path / "new_model").iterdir()} == names and new.read_text() == text


def test_names_that_are_missing_long_or_taken(mi_rgb, tmp_path):
    """Each primitive has the material that its file gives it by number, and each object an id of its own."""
    content, data = card()
    names = [None, "", "A", "A", "Card_0", "a" * 300, 'q"&<$spp>', 7]
    content["materials"] = [
        {"pbrMetallicRoughness": {"roughnessFactor": i / 8}, **({} if name is None else {"name": name})}
        for i, name in enumerate(names)
    ]
    part = content["meshes"][0]["primitives"][0]
    content["meshes"][0]["primitives"] = [{**part, "material": i} for i in reversed(range(len(names)))]
    content["meshes"][0]["name"] = "Card_0"
    scene = loading.load(model_scene(write(tmp_path / "m.glb", content, data), tmp_path / "parts"))
    bsdfs = [s.bsdf() for s in scene.shapes() if "PLY" in s.class_name()]
    assert len({b.id() for b in bsdfs}) == len(names) and load_source(f"{tmp_path}/m.glb#A3", constant=True)
    assert {float(mi_rgb.traverse(b)["roughness.value"][0]) for b in bsdfs} == {i / 8 for i in range(len(names))}


def test_parts_that_are_not_used_are_named(mi_rgb, tmp_path, capfd):
    """Skins, morph targets, colours of vertices, fans, animations, cameras, lights and borders of images."""
    content, data = card()
    part = content["meshes"][0]["primitives"][0]
    part["targets"], part["attributes"]["COLOR_0"] = [{"POSITION": 0}], 0
    content["meshes"][0]["primitives"].append({**part, "mode": 6})
    content["nodes"][0]["skin"], content["textures"][0]["sampler"] = 0, 0
    content |= {
        "animations": [],
        "cameras": [],
        "extensions": {"KHR_lights_punctual": {}},
        "samplers": [{"wrapS": 33071}],
    }
    model_scene(write(tmp_path / "m.glb", content, data), tmp_path / "parts")
    said = capfd.readouterr()
    said = said.out + said.err
    assert "skins, morph targets, colours of vertices, fans" in said and "animations, cameras, lights" in said
    assert "beyond the border is not used" in said


def test_numbers_that_would_be_read_wrong(mi_rgb, tmp_path):
    """Sparse accessors, whole texture coordinates and a file that is cut short are refused."""
    for index, change, fault in ((0, {"sparse": {}}, "sparse"), (1, {"componentType": 5123}, "whole numbers")):
        content, data = card()
        content["accessors"][index].update(change)
        with pytest.raises(SourceError, match=fault):
            model_scene(write(tmp_path / "m.glb", content, data), tmp_path / "parts")
    (tmp_path / "m.glb").write_bytes((tmp_path / "m.glb").read_bytes()[:15])
    with pytest.raises(SourceError, match="cut short"):
        model_scene(tmp_path / "m.glb", tmp_path / "parts")


def test_a_changed_image_is_read_again(mi_rgb, tmp_path, monkeypatch):
    """Also one whose name is encoded in the file."""
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    content, data = card()
    content["images"][0] = {"uri": "an%20image.png"}
    path = write(tmp_path / "m.gltf", content, data)
    scenes = []
    for side in (8, 16):
        Image.fromarray(COLORS.repeat(side, axis=0)).save(tmp_path / "an image.png")
        scenes.append(model_scene(path))
    assert scenes[0] != scenes[1]


@pytest.mark.parametrize(
    "change, fault",
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "requires the extension KHR_draco_mesh_compression"),
        ({"nodes": [{}]}, "has no triangles"),
        ({}, "bogus"),
        ({"accessors": [{"count": 10**15}]}, "memory"),
        ({"nodes": [{"mesh": 0, "camera": 0}]}, "a node with a camera"),
        ({"nodes": [{"mesh": 0, "scale": [1e30] * 3}]}, "has coordinates beyond 1e+18"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 9}}]}]}, "m.gltf"),
    ],
)
def test_models_that_are_refused(mi_rgb, tmp_path, monkeypatch, capsys, change, fault):
    """In one sentence, without files that stay."""
    monkeypatch.setenv(CACHE, str(tmp_path / "cache"))
    content, data = card()
    path = write(tmp_path / "m.gltf", {**content, **change}, data)
    more = ["-D", "bogus=1"] if not change else []
    assert main(["convert", str(path), "-o", str(tmp_path / "new.xml"), *more]) == 2
    error = capsys.readouterr().err
    assert fault in error and error.count("\n") == 1
    assert not list(tmp_path.rglob("*.ply")) and not (tmp_path / "new.xml").exists()
