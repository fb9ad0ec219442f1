"""Folders of maps, manifests, glTF and MaterialX files: read to the values that a script wrote, or refused."""

import base64
import json
import re
import struct
import subprocess
import sys
from io import BytesIO
from urllib.parse import quote

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

import mi_diffind
from mi_diffind.core.errors import UsageError
from mi_diffind.core.files import PATHS
from mi_diffind.fitting.task import tasks
from mi_diffind.maps.entries import IDENTITY, split_material
from mi_diffind.maps.layout import Layout
from mi_diffind.maps.model import origin_lines, size_figures
from mi_diffind.maps.source import SourceError, from_arrays, load_source
from mi_diffind.plugins.support.image_files import to_bitmap, to_mipmap
from mi_diffind.tasks.texture.surface import maps_of

SIZE = 8


def noise(channels, seed=0, dtype=np.uint8, side=SIZE):
    return np.random.default_rng(seed).integers(0, np.iinfo(dtype).max, (side, side, channels), dtype, endpoint=True)


def normals(side=SIZE, seed=7):
    """Return unit normals with 8 bits, y up."""
    rng = np.random.default_rng(seed)
    n = np.concatenate([rng.uniform(-0.5, 0.5, (side, side, 2)), np.ones((side, side, 1))], axis=2)
    return np.rint(127.5 * (n / np.linalg.norm(n, axis=2, keepdims=True) + 1)).astype(np.uint8)


COLOR, NORMAL, GREY, ORM, MASK = noise(3, 1), normals(), noise(1, 2), noise(3, 3), noise(4, 4)
DIRECTX = np.concatenate([NORMAL[..., :1], 255 - NORMAL[..., 1:2], NORMAL[..., 2:]], axis=2)
RGBA = np.concatenate([COLOR, noise(1, 5)], axis=2)
DEEP = noise(1, 6, np.uint16)


def write(folder, **images):
    """Write images by the names of their files, in which ``__`` stands for the dot."""
    for name, array in images.items():
        mi.Bitmap(np.ascontiguousarray(array)).write(str(folder / name.replace("__", ".")))
    return folder


def png(array):
    file = BytesIO()
    Image.fromarray(array.squeeze()).save(file, "PNG")
    return file.getvalue()


def unit(values):
    return np.float64(values) / np.iinfo(values.dtype).max


def linear(values):
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def encoded(values):
    return np.where(values <= 0.0031308, 12.92 * values, 1.055 * np.maximum(values, 1e-9) ** (1 / 2.4) - 0.055)


def gltf(folder, images=("color.png", "normal.png", "orm.png"), more=None, name="m.gltf", count=1, **material):
    """Write a glTF file of ``count`` materials that use all three images, unless ``material`` says otherwise."""
    pbr = {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 2}}
    material = {"name": "paint", "pbrMetallicRoughness": pbr, "normalTexture": {"index": 1}, **material}
    content = {
        "asset": {"version": "2.0"},
        "images": [{"uri": image} if isinstance(image, str) else image for image in images],
        "textures": [{"source": i} for i in range(len(images))],
        "materials": [{**material, "name": f"paint{i}" if i else "paint"} for i in range(count)],
        **(more or {}),
    }
    (folder / name).write_text(json.dumps(content), encoding="utf-8")
    return folder / name


def three(folder):
    return write(folder, color__png=COLOR, normal__png=NORMAL, orm__png=ORM)


def pbr(**more):
    return {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 2}, **more}


#: Maps of the three images as a glTF material uses them.
PAINT = {
    "albedo": unit(COLOR),
    "normal": unit(NORMAL),
    "roughness": unit(ORM[..., 1:2]),
    "metallic": unit(ORM[..., 2:]),
}

CASES = {}


def case(function):
    """Add a case: it writes files and returns the source, its maps, and parts of its notes."""
    CASES[function.__name__] = function
    return function


@case
def ambientcg(folder):
    names = {"Color__jpg": np.full((8, 8, 3), 99, np.uint8), "NormalGL__png": NORMAL, "NormalDX__png": DIRECTX,
             "Roughness__png": GREY, "AmbientOcclusion__png": GREY, "Displacement__png": DEEP}  # fmt: skip
    write(folder, **{f"Wood051_1K-JPG_{name}": array for name, array in names.items()}, Wood051_1K_JPG__png=COLOR)
    maps = {"albedo": np.full((8, 8, 3), 99 / 255), "normal": unit(NORMAL), "roughness": unit(GREY), "ao": unit(GREY)}
    notes = [
        "NormalDX.png: not used, Wood051_1K-JPG_NormalGL.png is taken for normal",
        "Displacement.png: not used, the",
    ]
    return folder, maps, [*notes, "Wood051_1K_JPG.png: not used, its name is that of no map"]


@case
def poly_haven_packed_and_separate(folder):
    write(folder, wood_diff_1k__png=COLOR, wood_nor_gl_1k__png=NORMAL, wood_arm_1k__png=ORM, wood_rough_1k__png=GREY)
    maps = {"albedo": unit(COLOR), "normal": unit(NORMAL), "roughness": unit(GREY), "metallic": unit(ORM[..., 2:])}
    return folder, {**maps, "ao": unit(ORM[..., :1])}, ["wood_arm_1k.png (g): not used, wood_rough_1k.png is taken"]


@case
def quixel(folder):
    write(folder, vh_2K_Albedo__png=COLOR, vh_2K_Normal_LOD0__png=NORMAL, vh_2K_Gloss__png=GREY, vh_2K_Cavity__png=GREY,
          vh_Preview__png=COLOR)  # fmt: skip
    maps = {"albedo": unit(COLOR), "normal": unit(NORMAL), "roughness": 1 - unit(GREY)}
    return folder, maps, ["vh_2K_Cavity.png: not used, the BRDF", "vh_Preview.png: not used, a preview"]


@case
def substance_with_directx_normals(folder):
    write(
        folder, Wall_Base_Color__png=COLOR, Wall_Normal_DirectX__png=DIRECTX, Wall_OcclusionRoughnessMetallic__png=ORM
    )
    parts = {name: unit(ORM[..., i : i + 1]) for i, name in enumerate(("ao", "roughness", "metallic"))}
    return folder, {"albedo": unit(COLOR), "normal": unit(NORMAL), **parts}, ['map "normal": normals of DirectX']


@case
def substance_with_opengl_normals_and_opacity(folder):
    grey = np.repeat(GREY, 3, 2)
    write(
        folder, Wall_BaseColor__png=COLOR, Wall_Normal_OpenGL__png=NORMAL, Wall_Opacity__png=grey, Wall_Height__png=DEEP
    )
    return folder, {"albedo": unit(COLOR), "normal": unit(NORMAL), "opacity": unit(GREY)}, ["Wall_Height.png: not used"]


@case
def unity_mask_map(folder):
    write(folder, Maple_Natural_BC__png=COLOR, Maple_NM__png=NORMAL, Maple_M__png=MASK)
    maps = {"metallic": unit(MASK[..., :1]), "ao": unit(MASK[..., 1:2]), "roughness": 1 - unit(MASK[..., 3:])}
    return folder, {"albedo": unit(COLOR), "normal": unit(NORMAL), **maps}, []


@case
def unity_metallic_smoothness(folder):
    write(folder, Wall_AlbedoTransparency__png=RGBA, Wall_MetallicSmoothness__png=MASK)
    maps = {"albedo": unit(COLOR), "opacity": unit(RGBA[..., 3:]), "metallic": unit(MASK[..., :1])}
    return folder, {**maps, "roughness": 1 - unit(MASK[..., 3:])}, []


@case
def metallic_by_its_letter(folder):
    write(folder, x_BC__png=COLOR, x_M__png=GREY, x_R__png=DEEP, x_N__png=NORMAL)
    maps = {"metallic": unit(GREY), "roughness": unit(DEEP), "normal": unit(NORMAL)}
    return folder, {"albedo": unit(COLOR), **maps}, []


@case
def two_resolutions_and_two_formats(folder):
    large = noise(3, 8, side=16)
    write(folder, wood_diff_1k__png=COLOR, wood_diff_2k__png=large, wood_diff_2k__jpg=large, wood_rough_2k__png=GREY)
    notes = [f"wood_diff_{name}: not used, wood_diff_2k.png is taken" for name in ("1k.png", "2k.jpg")]
    rough = unit(GREY)
    for axis in (0, 1):  # a quarter of the neighbour beyond the nearer edge, where the image repeats
        before, after = (0.75 * rough + 0.25 * np.roll(rough, shift, axis) for shift in (1, -1))
        rough = np.stack([before, after], axis + 1).reshape([n * (1 + (i == axis)) for i, n in enumerate(rough.shape)])
    return (
        folder,
        {"albedo": unit(large), "roughness": rough},
        [*notes, 'map "roughness": 8 × 8 texels, interpolated to 16 × 16'],
    )


@case
def spaces_and_umlauts(folder):
    folder = folder / "Tür & Tor"
    folder.mkdir()
    write(folder, **{"grüne Tür_Color__png": COLOR, "grüne Tür_Roughness__png": GREY})
    return folder, {"albedo": unit(COLOR), "roughness": unit(GREY)}, []


@case
def textures_that_are_not_read(folder):
    write(folder, a_Color__png=COLOR)
    for name in ("a_Normal.ktx2", "a_Roughness.tif", "a.blend"):
        (folder / name).write_bytes(b"?")
    return folder, {"albedo": unit(COLOR)}, ["a_Normal.ktx2: not used, files .ktx2", "a_Roughness.tif: not used"]


@case
def manifest_with_factor_and_inversion(folder):
    maps = {"albedo": {"file": "color.png", "factor": [0.5, 1, 0.25]}, "roughness": {"file": "g.png", "invert": True},
            "metallic": {"file": "orm.png", "channels": "b", "factor": 0.5}}  # fmt: skip
    write(three(folder), g__png=DEEP)
    (folder / "m.json").write_text(json.dumps({"maps": maps}))
    albedo = encoded(linear(unit(COLOR)) * [0.5, 1, 0.25])
    return folder / "m.json", {"albedo": albedo, "roughness": 1 - unit(DEEP), "metallic": PAINT["metallic"] / 2}, []


@case
def gltf_files(folder):
    path = gltf(three(folder), occlusionTexture={"index": 2})
    return path, {**PAINT, "ao": unit(ORM[..., :1])}, []


@case
def gltf_factors(folder):
    factors = {"baseColorFactor": [0.5, 0.25, 1, 1], "metallicFactor": 0.5, "roughnessFactor": 0.25}
    texture = {"index": 1, "scale": 0.5}
    path = gltf(three(folder), pbrMetallicRoughness=pbr(**factors), normalTexture=texture)
    n = (2 * unit(NORMAL) - 1) * [0.5, 0.5, 1]
    maps = {"roughness": PAINT["roughness"] / 4, "metallic": PAINT["metallic"] / 2}
    maps["albedo"] = encoded(linear(unit(COLOR)) * [0.5, 0.25, 1])
    return path, {**maps, "normal": 0.5 + 0.5 * n / np.linalg.norm(n, axis=2, keepdims=True)}, []


@case
def gltf_without_some_maps(folder):
    path = gltf(three(folder), pbrMetallicRoughness={"baseColorFactor": [0.5, 0.25, 1, 1], "roughnessFactor": 0.75})
    constants = {"albedo": [0.5, 0.25, 1], "roughness": [0.75], "metallic": [1]}
    maps = {name: np.broadcast_to(np.float64(value), (8, 8, len(value))) for name, value in constants.items()}
    return path, {**maps, "normal": unit(NORMAL)}, []


@case
def gltf_blend(folder):
    path = gltf(write(three(folder), color__png=RGBA), alphaMode="BLEND", doubleSided=True)
    return path, {**PAINT, "opacity": unit(RGBA[..., 3:])}, []


@case
def gltf_mask(folder):
    path = gltf(write(three(folder), color__png=RGBA), alphaMode="MASK", alphaCutoff=0.25)
    return path, {**PAINT, "opacity": np.float64(unit(RGBA[..., 3:]) >= 0.25)}, []


@case
def gltf_opaque(folder):
    path = gltf(write(three(folder), color__png=RGBA))
    return path, PAINT, ["baseColorTexture: its alpha is not used, alphaMode is OPAQUE"]


@case
def gltf_data_uris(folder):
    images = ["data:image/png;base64," + base64.b64encode(png(array)).decode() for array in (COLOR, NORMAL, ORM)]
    return gltf(folder, images), PAINT, []


@case
def gltf_sixteen_bits_and_grey(folder):
    path = gltf(write(three(folder), color__png=DEEP))
    return path, {**PAINT, "albedo": unit(DEEP)}, []


@case
def gltf_names_with_spaces_and_umlauts(folder):
    (folder / "Bilder ä").mkdir()
    write(folder / "Bilder ä", **{"Farbe 1__png": COLOR, "normal__png": NORMAL, "100%__png": ORM})
    return gltf(folder, [quote("Bilder ä/Farbe 1.png"), "Bilder ä/normal.png", "Bilder ä/100%.png"]), PAINT, []


@case
def glb(folder):
    data = [png(array) for array in (COLOR, NORMAL, ORM)]
    ends = np.cumsum([len(d) for d in data]).tolist()
    views = [{"buffer": 0, "byteOffset": end - len(d), "byteLength": len(d)} for d, end in zip(data, ends, strict=True)]
    images = [{"bufferView": i, "mimeType": "image/png"} for i in range(3)]
    text = gltf(folder, images, {"bufferViews": views, "buffers": [{"byteLength": ends[-1]}]}).read_bytes()
    text, binary = (part + fill * (-len(part) % 4) for part, fill in ((text, b" "), (b"".join(data), b"\0")))
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    (folder / "m.glb").write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return folder / "m.glb", PAINT, []


@case
def gltf_one_of_several(folder):
    path = gltf(three(folder), count=3)
    return f"{path}#paint2", PAINT, []


@case
def gltf_with_extensions(folder):
    texture = {"index": 1, "extensions": {"KHR_texture_webp": {}}, "texCoord": 1}
    glass = {"KHR_materials_transmission": {"transmissionFactor": 1}}
    path = gltf(three(folder), normalTexture=texture, extensions=glass, emissiveFactor=[1, 1, 1])
    notes = ["normalTexture: KHR_texture_webp is not used", "normalTexture: its texture coordinates, set 1, are"]
    return path, PAINT, [*notes, "keys that are not used: emissiveFactor", "KHR_materials_transmission is not used"]


@case
def gltf_with_a_ktx_image(folder):
    textures = [{"source": 0}, {"extensions": {"KHR_texture_basisu": {"source": 1}}}, {"source": 2}]
    path = gltf(three(folder), more={"textures": textures})
    maps = {name: values for name, values in PAINT.items() if name != "normal"}
    return path, maps, ["normalTexture: not used, images of KHR_texture_basisu are not read"]


@case
def gltf_with_smaller_maps(folder):
    small = np.full((4, 4, 3), 100, np.uint8)
    path = gltf(write(three(folder), orm__png=small))
    maps = {name: np.full((8, 8, 1), 100 / 255) for name in ("roughness", "metallic")}
    return path, {**PAINT, **maps}, [f'map "{name}": 4 × 4 texels, interpolated to 8 × 8' for name in maps]


@case
def gltf_with_maps_of_other_proportions(folder):
    """All maps get the largest width and the largest height."""
    row = np.arange(16, dtype=np.uint8)[None, :, None] * np.full((2, 1, 3), 10, np.uint8)
    path = gltf(write(three(folder), orm__png=row))
    maps = {name: np.broadcast_to(row[:1, :, :1] / 255, (8, 16, 1)) for name in ("roughness", "metallic")}
    up = 0.5 + 0.5 * np.array([1, 1, 255]) / np.sqrt(2 + 255**2)
    flat = {"albedo": np.full((8, 16, 3), 40 / 255), "normal": np.broadcast_to(up, (8, 16, 3))}
    write(
        folder, color__png=np.full((8, 8, 3), 40, np.uint8), normal__png=np.full((4, 4, 3), [128, 128, 255], np.uint8)
    )
    sizes = {"albedo": "8 × 8", "normal": "4 × 4", "roughness": "16 × 2", "metallic": "16 × 2"}
    return path, {**flat, **maps}, [f'map "{n}": {size} texels, interpolated to 16 × 8' for n, size in sizes.items()]


@pytest.mark.parametrize("name", CASES)
def test_a_source_is_read(tmp_path, name):
    source, maps, notes = CASES[name](tmp_path)
    loaded = load_source(str(source), outside=True)
    assert {m.name for m in loaded.maps} == set(maps)
    for m in loaded.maps:
        assert m.values.shape == maps[m.name].shape, m.name
        np.testing.assert_allclose(m.values, maps[m.name], atol=2e-6, err_msg=m.name)
        # A constant colour is linear
        assert m.color_space == ("srgb" if m.name == "albedo" and m.depth else "linear")
    assert len(loaded.notes) == len(notes), loaded.notes
    for part in notes:
        assert any(part in note for note in loaded.notes), (part, loaded.notes)
    lines = origin_lines(loaded)
    assert len(lines) == 1 + len(maps) and re.split(r"  +", lines[0])[:3] == ["map", "file", "channels"]
    assert load_source(str(source), outside=True).digest == loaded.digest and loaded.file_nbytes > 0
    assert loaded.double_sided == (name == "gltf_blend") and {m.transform for m in loaded.maps} == {IDENTITY}


def test_the_table_says_what_was_changed(tmp_path):
    source, *_ = unity_mask_map(tmp_path)
    row = next(row for row in load_source(source).origins if row["map"] == "roughness")
    expected = {"file": "Maple_M.png", "channels": "a", "color_space": "linear", "factor": "1"}
    assert row == {"map": "roughness", **expected, "change": "inverted (1 − x)"}
    write(tmp_path, Maple_NM__png=NORMAL).joinpath("Maple_NM.png").rename(tmp_path / "Maple_NormalDX.png")
    assert [row["change"] for row in load_source(tmp_path).origins][1] == "y inverted"


#: A texture transform of glTF, and a step along u.
CHANGE, HALF = {"scale": [2, 0.5], "rotation": 0.5, "offset": [0.25, -0.1]}, np.array([0.5, 0])


def transformed(transform, uv):
    return np.reshape(transform, (2, 3)) @ [*uv, 1]


def test_texture_transforms_of_gltf(tmp_path):
    """Against the matrices that the extension's text multiplies; maps that differ are no material for one read."""
    moved, extension = {"offset": [*HALF], "texCoord": 1}, "KHR_texture_transform"
    base, other = ({"index": i, "extensions": {extension: change}} for i, change in ((0, CHANGE), (2, moved)))
    textures = {"baseColorTexture": base, "metallicRoughnessTexture": other}
    path = gltf(write(three(tmp_path), color__png=RGBA), pbrMetallicRoughness=textures, alphaMode="BLEND")
    source, uv = load_source(path), np.random.default_rng(2).random(2)
    c, s = np.cos(CHANGE["rotation"]), np.sin(CHANGE["rotation"])
    columns = [[[1, 0, 0], [0, 1, 0], [*CHANGE["offset"], 1]], [[c, -s, 0], [s, c, 0], [0, 0, 1]]]
    translation, rotation = (np.transpose(matrix) for matrix in columns)
    there = (translation @ rotation @ np.diag([*CHANGE["scale"], 1]) @ [*uv, 1])[:2]
    expected = {"albedo": there, "opacity": there, "roughness": uv + HALF, "metallic": uv + HALF, "normal": uv}
    for m in source.maps:
        np.testing.assert_allclose(transformed(m.transform, uv), expected.pop(m.name), rtol=1e-6)
    assert not expected and [*source.notes] == [
        "metallicRoughnessTexture: its texture coordinates, set 1, are not used"
    ]  # fmt: skip
    changes = {row["map"]: row["change"] for row in source.origins}
    assert changes["roughness"] == "uv transform [1 0 0.5, 0 1 0]" and changes["normal"] == ""
    with pytest.raises(UsageError, match=r'the maps "albedo" \(.*\) and "normal" \(none\) differ in their'):
        maps_of(Layout.from_source(source))


REFUSALS = {}
NO_MAPS = (
    "is a folder without an image that has the name of a map: write a manifest there, as in "
    '{"maps": {"albedo": "FILE.png"}}'
)


def refusal(sentence):
    """Add a source that is refused with a ``sentence``, in which DIR stands for its folder."""

    def add(function):
        REFUSALS[function.__name__] = function, sentence
        return function

    return add


@refusal('DIR: a_Color.png and b_Color.png may both be the albedo: write a manifest there, as in {"maps": {"albedo": '
         '"a_Color.png"}}')  # fmt: skip
def two_materials(folder):
    return write(folder, a_Color__png=COLOR, b_Color__png=COLOR, a_Normal__png=NORMAL)


@refusal('DIR: holds maps of several materials, "brick" and "wood": write a manifest there, as in {"maps": {"normal": '
         '"wood_Normal.png"}}')  # fmt: skip
def maps_of_two_materials(folder):
    return write(folder, brick_Color__png=COLOR, wood_Normal__png=NORMAL)


@refusal(f"DIR: {NO_MAPS}")
def unknown_names(folder):
    return write(folder, one__png=COLOR, two__png=NORMAL)


@refusal(f"DIR: {NO_MAPS}, or name m.gltf")
def a_folder_of_a_model(folder):
    return gltf(write(folder, one__png=COLOR), name="m.gltf").parent


@refusal('DIR/x_M.png: may be a metallic map or one of several masks: write a manifest there, as in {"maps": '
         '{"metallic": {"file": "x_M.png", "channels": "r"}, "ao": {"file": "x_M.png", "channels": "g"}}}')  # fmt: skip
def an_ambiguous_mask(folder):
    return write(folder, x_BC__png=COLOR, x_M__png=ORM)


@refusal('DIR: the alpha of x_Metallic.png may be a smoothness: write a manifest there, as in {"maps": {"metallic": '
         '{"file": "x_Metallic.png", "channels": "r"}, "roughness": {"file": "x_Metallic.png", "channels": "a", '
         '"invert": true}}}')  # fmt: skip
def an_ambiguous_alpha(folder):
    return write(folder, x_BC__png=COLOR, x_Metallic__png=MASK)


@refusal('DIR: x_ORM.png has one channel, several are needed: write a manifest there, as in {"maps": {"roughness": '
         '{"file": "x_ORM.png", "channels": "g"}}}')  # fmt: skip
def a_grey_packed_map(folder):
    return write(folder, x_ORM__png=GREY)


@refusal("DIR/m.gltf: has 2 materials, name one as m.gltf#NAME: paint, paint1")
def gltf_without_a_name(folder):
    return gltf(three(folder), count=2)


@refusal('DIR/m.gltf: has no material called "wood", the names are paint, paint1')
def gltf_with_a_wrong_name(folder):
    return f"{gltf(three(folder), count=2)}#wood"


@refusal("DIR/m.gltf: has no materials")
def gltf_without_materials(folder):
    return gltf(folder, more={"materials": []})


@refusal("DIR/m.gltf: its material has no images that are read, there is nothing to fit")
def gltf_of_constants(folder):
    path = gltf(folder, pbrMetallicRoughness={"roughnessFactor": 0.5})
    content = json.loads(path.read_text())
    del content["materials"][0]["normalTexture"]
    path.write_text(json.dumps(content))
    return path


@refusal("DIR/orm.png: no such file")
def gltf_without_a_file(folder):
    return gltf(write(folder, color__png=COLOR, normal__png=NORMAL))


@refusal("DIR/m.gltf: is not valid JSON (Expecting value: line 1 column 15 (char 14))")
def gltf_cut_short(folder):
    (folder / "m.gltf").write_text('{"materials": ')
    return folder / "m.gltf"


@refusal("DIR/m.gltf: is no valid glTF file (IndexError: list index out of range)")
def gltf_with_a_wrong_index(folder):
    return gltf(three(folder), normalTexture={"index": 9})


@refusal("DIR/m.gltf: is no valid glTF file (ValueError: could not convert string to float: 'red')")
def gltf_with_a_word_for_a_number(folder):
    return gltf(three(folder), pbrMetallicRoughness=pbr(metallicFactor="red"))


@refusal('DIR/m.gltf: map "roughness" has the factors (inf,), allowed are numbers up to 1e+06')
def gltf_with_an_infinite_factor(folder):
    return gltf(three(folder), pbrMetallicRoughness=pbr(roughnessFactor=float("inf")))


@refusal("DIR/m.gltf: is cut short, buffer view 0 ends behind its buffer")
def gltf_with_a_short_buffer(folder):
    views = {"bufferViews": [{"buffer": 0, "byteLength": 99}], "buffers": [{"uri": "data:;base64,AAAA"}]}
    return gltf(three(folder), [{"bufferView": 0}, "normal.png", "orm.png"], views)


@refusal("DIR/m.gltf: names 'https://example.org/a.png', allowed are files and data")
def gltf_with_an_address(folder):
    return gltf(three(folder), ["https://example.org/a.png", "normal.png", "orm.png"])


@refusal("DIR/m.glb: is of version 1 of glTF, allowed is 2, with JSON first")
def an_old_glb(folder):
    (folder / "m.glb").write_bytes(struct.pack("<5I", 0x46546C67, 1, 20, 0, 0))
    return folder / "m.glb"


@refusal('DIR/m.json: map "a" has 2 factors, allowed are 1 or 3')
def a_manifest_with_two_factors(folder):
    (write(folder, a__png=COLOR) / "m.json").write_text('{"a": {"file": "a.png", "factor": [1, 2]}}')
    return folder / "m.json"


@refusal('DIR/m.json: map "a" has invert 1, allowed are true and false')
def a_manifest_that_inverts_by_a_number(folder):
    (folder / "m.json").write_text('{"a": {"file": "a.png", "invert": 1}}')
    return folder / "m.json"


@refusal(
    'DIR: map "albedo" has 8×8 texels and map "roughness" has 4×8 texels, all maps need the same ratio of width '
    "and height"
)
def maps_of_other_proportions(folder):
    return write(folder, a_Color__png=COLOR, a_Roughness__png=GREY[:, :4])


@pytest.mark.parametrize("name", REFUSALS)
def test_a_source_is_refused(tmp_path, name):
    write_files, sentence = REFUSALS[name]
    with pytest.raises(SourceError) as error:
        load_source(str(write_files(tmp_path)), outside=True)
    assert str(error.value).replace(str(tmp_path), "DIR") == sentence


def test_enough_cases():
    assert len(CASES) + len(REFUSALS) >= 20


# -- paths -------------------------------------------------------------------------------------------------------------


def test_paths_outside_are_for_the_files_that_the_user_names(tmp_path, monkeypatch):
    """``fit`` reads them; scenes, table files and ``load_source`` by default do not."""
    for folder in ("images", "material"):
        (tmp_path / folder).mkdir()
    three(tmp_path / "images")
    absolute = {"albedo": str(tmp_path / "images" / "color.png"), "normal": "../images/normal.png"}
    (tmp_path / "material" / "m.json").write_text(json.dumps(absolute))
    model = gltf(tmp_path / "material", [f"../images/{name}.png" for name in ("color", "normal", "orm")])
    for path, names in ((tmp_path / "material" / "m.json", list(absolute)), (model, list(PAINT))):
        assert [m.name for m in load_source(path, outside=True).maps] == names
        with pytest.raises(SourceError, match=rf"lies outside of its folder.*{PATHS}=any"):
            load_source(path)
        monkeypatch.setenv(PATHS, "any")
        assert len(load_source(path).maps) == len(names)
        monkeypatch.delenv(PATHS)


@pytest.mark.parametrize(
    "source, expected",
    [("m.gltf", ("m.gltf", "")), ("m.gltf#a", ("m.gltf", "a")), ("m.GLB#a#b", ("m.GLB", "a#b")),
     ("a#b/m.mtlx#c", ("a#b/m.mtlx", "c")), ("a#b.png", ("a#b.png", "")), ("a#b", ("a#b", ""))],
)  # fmt: skip
def test_names_of_materials(source, expected):
    path, name = split_material(source)
    assert (str(path), name) == expected


# -- the command line --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", ["image", "texture"])
def test_a_material_of_a_gltf_file_is_fitted(mi_rgb, tmp_path, monkeypatch, capsys, task):
    """The table is printed once; the result measures itself by the material that it records."""
    monkeypatch.chdir(tmp_path)
    turned = {"KHR_texture_transform": {"offset": [0.25, 0.5]}}
    textures = {name: {**texture, "extensions": turned} for name, texture in pbr().items()}
    normal = {"index": 1, "extensions": turned}
    more = {"pbrMetallicRoughness": textures, "normalTexture": normal, "doubleSided": True}
    path = gltf(write(three(tmp_path), color__png=DEEP), count=2, **more)
    options = {"steps": 2, "batch": 256, "compression": 2, **({"shading": "off"} if task == "texture" else {})}
    fitted = mi_diffind.fit(task, f"{path.name}#paint1", **options)
    printed = capsys.readouterr().out
    assert printed.count("color space") == 1 and re.search(r"roughness +orm\.png +g +linear +1", printed)
    text = "\n".join(fitted.summary("a.npz"))
    bits = 8 * fitted.table.nbytes / SIZE**2
    assert f"x requested), {bits:.2f} bits a texel" in text and fitted.report["bits_per_texel"] == bits
    assert [row["map"] for row in fitted.report["origins"]] == list(PAINT)
    model = mi_diffind.open(fitted.save(tmp_path / "a.npz"))
    assert model.table.settings["source_path"] == "m.gltf#paint1" and model.measure()["psnr_db"] > 0
    described, lines = model.describe()
    assert described["double_sided"] and described["maps"]["albedo"]["transform"] == [1, 0, 0.25, 0, 1, 0.5]
    assert "uv transform [1 0 0.25, 0 1 0.5]" in lines[2] and "  the material is double-sided" in lines
    # The exact counterparts read the same material
    for name, values in (("albedo", unit(DEEP)[..., 0]), ("roughness", ORM[..., 1])):
        props = mi_rgb.Properties(f"neural_{task}")
        props["filename"], props["channels"] = str(tmp_path / "a.npz"), name
        to_bitmap(tasks()[task], props)
        np.testing.assert_allclose(np.array(props["bitmap"]), values, rtol=1e-6)
    to_mipmap(tasks()[task], props)
    texture = {"type": "mipmap", "channels": "roughness", "filename": props["filename"], "filter": "off"}
    si = mi_rgb.SurfaceInteraction3f()
    si.uv = mi_rgb.Point2f(2.5 / SIZE, 3.5 / SIZE)
    bitmap = {"type": "bitmap", **{name: props[name] for name in ("bitmap", "raw", "to_uv")}}
    for one in (texture, bitmap):  # the texel two to the right and four below
        assert mi_rgb.load_dict(one).eval_1(si)[0] == pytest.approx(unit(ORM[7, 4, 1]), abs=1e-6)


def test_small_source_files_are_said(tmp_path):
    source = load_source(write(tmp_path, a_Color__png=np.zeros((64, 64, 3), np.uint8)))

    class Sized:
        nbytes, arrays = 2000, {}

    line = size_figures(source, Sized, None)[1][-1]
    expected = f"the files of the source have {source.file_nbytes} bytes, fewer than these arrays (2,000); in the"
    assert line == f"{expected} memory of a renderer they take {source.nbytes:,}"
    assert len(size_figures(from_arrays({"albedo": COLOR}), Sized, None)[1]) == 1


# -- MaterialX ---------------------------------------------------------------------------------------------------------

MTLX = """<?xml version="1.0"?>
<materialx version="1.39" colorspace="lin_rec709" fileprefix="maps/">
  <image name="color" type="color3">
    <input name="file" type="filename" value="color.png" colorspace="srgb_texture" />
  </image>
  <image name="orm" type="vector3"><input name="file" type="filename" value="orm.png" /></image>
  <separate3 name="parts" type="multioutput"><input name="in" type="vector3" nodename="orm" /></separate3>
  <invert name="rough" type="float"><input name="in" type="float" nodename="parts" output="outy" /></invert>
  <nodegraph name="graph">
    <image name="n" type="vector3"><input name="file" type="filename" value="normal.png" /></image>
    <normalmap name="map" type="vector3"><input name="in" type="vector3" nodename="n" /></normalmap>
    <output name="bumps" type="vector3" nodename="map" />
  </nodegraph>
  <standard_surface name="surface" type="surfaceshader">
    <input name="base" type="float" value="0.5" />
    <input name="base_color" type="color3" nodename="color" />
    <input name="specular_roughness" type="float" nodename="rough" />
    <input name="metalness" type="float" value="0.25" />
    <input name="normal" type="vector3" nodegraph="graph" output="bumps" />
    <input name="coat" type="float" value="1" />
  </standard_surface>
  <surfacematerial name="Paint" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="surface" />
  </surfacematerial>
</materialx>
"""


def test_materialx(tmp_path):
    pytest.importorskip("MaterialX", reason="the optional package MaterialX is not installed")
    (tmp_path / "maps").mkdir()
    three(tmp_path / "maps")
    path = tmp_path / "m.mtlx"
    path.write_text(MTLX)
    source = load_source(f"{path}#Paint")
    maps = {"albedo": encoded(linear(unit(COLOR)) / 2), "normal": unit(NORMAL), "roughness": 1 - unit(ORM[..., 1:2])}
    maps["metallic"] = np.full((8, 8, 1), 0.25)
    for m in source.maps:
        np.testing.assert_allclose(m.values, maps.pop(m.name), atol=2e-6, err_msg=m.name)
    assert not maps and source.notes == ("m.mtlx: inputs that are not used: coat",)
    surface = MTLX[MTLX.index("<standard_surface") : MTLX.index("</materialx>")]
    for old, new, match in (
        (surface, "", "m.mtlx: has no materials"),
        ("standard_surface", "toon", "has the shader toon, allowed are standard_surface"),
        ("srgb_texture", "acescg", "albedo has the color space acescg, allowed are"),
        ("color.png", "../../a.png", "lies outside of its folder"),
        ("color.png", "a.png", r"maps/a\.png: no such file"),
        ("</materialx>", "", "is not valid XML"),
        ("</materialx>", "<a>" * 99 + "</a>" * 99 + "</materialx>", "has more than 64 elements in each other"),
    ):
        path.write_text(MTLX.replace(old, new))
        with pytest.raises(SourceError, match=match):
            load_source(path)
    path.write_text(MTLX.replace("image", "noise2d").replace("surface_color", "x"))
    with pytest.raises(SourceError, match="has no images that are read"):
        load_source(path)


@pytest.mark.parametrize("order", [0, 1])
def test_texture_transforms_of_materialx(tmp_path, order):
    """``tiledimage``, ``place2d`` in both orders, and both after each other, point by point as their graphs say."""
    pytest.importorskip("MaterialX", reason="the optional package MaterialX is not installed")
    (tmp_path / "maps").mkdir()
    three(tmp_path / "maps")
    numbers = {"pivot": "0.5, 0.25", "scale": "0.5, 2", "rotate": 30, "offset": "0.1, 0.3", "operationorder": order}
    ports = "".join(f'<input name="{name}" value="{value}"/>' for name, value in numbers.items())
    place = '<input name="texcoord" type="vector2" nodename="place" />'
    tiles = ("uvtiling", "3, 2"), ("uvoffset", "0.5, 0")
    tiles = "".join(f'<input name="{name}" type="vector2" value="{value}" />' for name, value in tiles)
    text = MTLX.replace("  <nodegraph", f'  <place2d name="place" type="vector2">{ports}</place2d>\n  <nodegraph', 1)
    text = text.replace('colorspace="srgb_texture" />', f'colorspace="srgb_texture" />{place}')
    text = re.sub(r'<image (name="orm".*?)</image>', rf"<tiledimage \1{tiles}{place}</tiledimage>", text)
    text = text.replace('value="normal.png" /></image>', f'value="normal.png" />{tiles}</image>')
    (tmp_path / "m.mtlx").write_text(text)
    source, uv = load_source(tmp_path / "m.mtlx"), np.random.default_rng(3).random(2)
    x, y = uv[0] - 0.5, (1 - uv[1]) - 0.25  # v points up, from the pivot
    x, y = (x - 0.1, y - 0.3) if order else (x / 0.5, y / 2)
    turned = (x + 1j * y) * np.exp(-1j * np.pi / 6)
    x, y = (turned.real / 0.5, turned.imag / 2) if order else (turned.real - 0.1, turned.imag - 0.3)
    placed = np.array([x + 0.5, y + 0.25])
    expected = {"albedo": placed, "roughness": placed * [3, 2] - HALF}
    transforms = {m.name: m.transform for m in source.maps}
    for name, place in expected.items():
        np.testing.assert_allclose(transformed(transforms[name], uv) * [1, -1] + [0, 1], place, rtol=1e-6)
    assert transforms["normal"] == transforms["metallic"] == IDENTITY and [*source.notes] == [
        "normal: image: inputs that are not used: uvtiling, uvoffset",
        "m.mtlx: inputs that are not used: coat",
    ]


def test_materialx_may_be_missing(tmp_path):
    (tmp_path / "m.mtlx").write_text(MTLX)
    code = (
        "import sys; sys.modules['MaterialX'] = None\n"
        "from mi_diffind.maps.source import load_source\n"
        "try:\n    load_source('m.mtlx')\nexcept ValueError as e:\n    print(e)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout == 'm.mtlx: reading it needs MaterialX: pip install "mi-diffind[materialx]"\n'
