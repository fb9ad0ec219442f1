"""Sources of task 3: what each kind of file gives, exactly, and one sentence for what cannot be used."""

import json
import struct
import subprocess
import sys

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mi_diffind.maps.source import SourceError, content_of, from_arrays, load_source


def pattern(height, width, channels, dtype=np.uint8, seed=0):
    rng = np.random.default_rng(seed)
    if np.dtype(dtype).kind == "f":
        return rng.normal(0.5, 2, (height, width, channels)).astype(dtype)
    return rng.integers(0, np.iinfo(dtype).max, (height, width, channels), dtype, endpoint=True)


def write(path, array):
    mi.Bitmap(array).write(str(path))
    return path


def manifest(folder, content):
    path = folder / "material.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), encoding="utf-8")
    return path


def described(source):
    return [(m.name, m.role, m.color_space, m.depth, m.channels) for m in source.maps]


def refused(match, source):
    """The source, a file or arrays, is refused in one sentence that begins with its folder."""
    with pytest.raises(SourceError, match=match) as error:
        from_arrays(source) if isinstance(source, dict) else load_source(source)
    text = str(error.value)
    assert "\n" not in text and not text.endswith("."), text
    assert isinstance(source, dict) or text.startswith(str(source.parent))


def write_exr(path, planes):
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, dict(planes)) as file:
        file.write(str(path))
    return path


@pytest.mark.parametrize("height, width", [(1, 1), (7, 5), (1, 4096), (4096, 1)])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("dtype, depth", [(np.uint8, 1), (np.uint16, 2)])
def test_png_is_exact(tmp_path, height, width, channels, dtype, depth):
    array = pattern(height, width, channels, dtype)
    source = load_source(write(tmp_path / "a.png", array))
    colors = 1 if channels < 3 else 3
    assert described(source)[0] == ("image", "albedo", "srgb", depth, colors)
    assert described(source)[1:] == [("alpha", "other", "linear", depth, 1)] * (channels in (2, 4))
    values = np.concatenate([m.values for m in source.maps], 2)
    assert values.dtype == np.float32 and values.shape == (height, width, channels)
    assert np.array_equal(np.rint(values.astype(np.float64) * np.iinfo(dtype).max), array)
    assert (source.height, source.width, source.channels) == (height, width, channels)
    assert source.nbytes == array.nbytes and source.texels == height * width


@pytest.mark.parametrize("dtype, depth", [(np.float16, 2), (np.float32, 4)])
@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 7, 16])
def test_exr_is_exact(tmp_path, channels, dtype, depth):
    array = pattern(5, 7, channels, dtype)
    assert (array < 0).any()
    source = load_source(write(tmp_path / "a.exr", array))
    assert np.array_equal(np.concatenate([m.values for m in source.maps], 2), array.astype(np.float32))
    assert {m.color_space for m in source.maps} == {"linear"} and {m.depth for m in source.maps} == {depth}
    names = [m.name for m in source.maps]
    assert names == (["image", "alpha"] if channels in (2, 4) else ["image"])
    assert source.maps[0].role == ("albedo" if channels < 5 else "other")


def test_exr_with_named_channels_is_one_map(tmp_path):
    planes = {
        name: pattern(5, 7, 1, np.float32, i)[..., 0] for i, name in enumerate(("N.X", "N.Y", "base.R", "base.Z"))
    }
    source = load_source(write_exr(tmp_path / "a.exr", planes))
    assert described(source) == [("image", "other", "linear", 4, 4)]
    assert np.array_equal(source.maps[0].values, np.stack(list(planes.values()), 2))


@pytest.mark.parametrize("extension, channels", [("hdr", 3), ("pfm", 1), ("pfm", 3), ("jpg", 1), ("jpg", 3)])
def test_hdr_pfm_and_jpeg(tmp_path, extension, channels):
    """HDR has a common exponent of three mantissas of 8 bits; JPEG decodes as in Pillow."""
    tolerance = 1 / 128 if extension == "hdr" else 0
    if extension == "jpg":
        path = tmp_path / "a.jpg"
        Image.fromarray(pattern(24, 40, channels).squeeze()).save(path, quality=90, subsampling=0)
        truth = np.atleast_3d(np.array(Image.open(path))) / 255
    else:
        truth = np.abs(pattern(24, 40, channels, np.float32)) * 100
        path = write(tmp_path / f"a.{extension}", truth)
    source = load_source(path)
    assert described(source) == [("image", "albedo", *(("srgb", 1) if extension == "jpg" else ("linear", 4)), channels)]
    error = np.abs(source.maps[0].values - truth)
    assert (error <= tolerance * truth.max(axis=2, keepdims=True) + (3 / 255 if extension == "jpg" else 0)).all()


def test_exr_of_whole_numbers(tmp_path):
    path = write_exr(tmp_path / "a.exr", {"id": np.full((2, 3), 2**24, np.uint32)})
    assert (load_source(path).maps[0].values == 2**24).all()
    path = write_exr(tmp_path / "b.exr", {"id": np.full((2, 3), 2**24 + 1, np.uint32)})
    refused("16,777,217, single precision is exact to 16,777,216", path)


@pytest.mark.parametrize("name", ["a.tga", "a.bmp"])
def test_tga_and_bmp(tmp_path, name):
    array, path = pattern(7, 5, 3), tmp_path / name
    Image.fromarray(array).save(path)
    assert np.array_equal(np.rint(load_source(path).maps[0].values * 255), array)
    data = path.read_bytes()
    for length in (0, 1, 17, 60, len(data) - 40):
        path.write_bytes(data[:length])
        refused("cannot be read as an image", path)


def test_bmp_with_a_palette(tmp_path):
    array = pattern(7, 5, 1)[..., 0] // 2
    grey = Image.fromarray(array)
    grey.save(tmp_path / "grey.bmp")
    assert np.array_equal(np.rint(load_source(tmp_path / "grey.bmp").maps[0].values[..., 0] * 255), array)
    grey.putpalette(list(range(256)) * 3)
    grey.save(tmp_path / "colors.bmp")
    refused("is a BMP file with a palette", tmp_path / "colors.bmp")


#: Names as programs and libraries of textures write them: Poly Haven, ambientCG, Quixel, Substance, Unity, Poliigon,
#: and further lobes of glTF, MaterialX and OpenPBR, which are other maps.
ROLES = {
    "albedo": "albedo baseColor base_color_map diffuse Color diff rough_wood_diff_1k Wood051_1K-JPG_Color "
    "vhlmdg_4K_Albedo Wall_Base_Color.1001 Wall_BaseMap MainTex Planks_COL_VAR1_3K",
    "normal": "normalTexture nor_gl nor_dx NormalGL NormalDX Wood051_1K-JPG_NormalGL vhlmdg_4K_Normal_LOD0 "
    "Wall_Normal_OpenGL Wall_NormalMap_GL Planks_NRM_3K",
    "ao": "occlusion AO ao AmbientOcclusion Wall_Mixed_AO",
    "metallic": "metalness metal Metal003_2K-PNG_Metalness",
    "roughness": "roughness rough specular_roughness",
    "other": "alpha height arm disp spec Displacement Wall_MaskMap MetallicSmoothness clearcoat_normal coat_roughness "
    "sheenColorTexture",
}


@pytest.mark.parametrize("name, role", [(name, role) for role, names in ROLES.items() for name in names.split()])
def test_roles(name, role):
    assert content_of(name).role == role


@pytest.mark.parametrize(
    "name, colours, packed, y_down",
    [("Wood_Color", True, False, False), ("emissive", True, False, False), ("sheen_color", True, False, False),
     ("spec", False, False, False), ("arm", False, True, False), ("metallicRoughnessTexture", False, True, False),
     ("nor_gl", False, False, False), ("brick_nor_dx_2k", False, False, True),
     ("Wall_Normal_DirectX", False, False, True)],
)  # fmt: skip
def test_contents(name, colours, packed, y_down):
    content = content_of(name)
    assert (content.colours, content.packed, content.y_down) == (colours, packed, y_down)


def normal_map(height=8, width=8, seed=0):
    """Return an 8-bit map of unit normals, y up."""
    rng = np.random.default_rng(seed)
    n = np.concatenate([rng.uniform(-0.5, 0.5, (height, width, 2)), np.ones((height, width, 1))], axis=2)
    n /= np.linalg.norm(n, axis=2, keepdims=True)
    return np.rint(127.5 * (n + 1)).astype(np.uint8)


@pytest.mark.parametrize(
    "stem, kind, expected, said",
    [("photo", "colours", ("albedo", "srgb", 3), ""),
     ("x_normal", "normals", ("normal", "linear", 3), "taken for a normal map by its name"),
     ("Wood051_1K-JPG_NormalDX", "normals", ("normal", "linear", 3), "y points down"),
     ("x_normal", "colours", ("albedo", "srgb", 3), "but the values of colours"),
     ("bumps", "normals", ("albedo", "srgb", 3), "looks like a normal map"),
     ("Wood_Roughness", "grey", ("roughness", "linear", 1), "taken for a roughness map"),
     ("metal", "colours", ("albedo", "srgb", 3), "but the values of colours"),
     ("Wood_Displacement", "grey", ("other", "linear", 3), "taken for data"),
     ("wood_arm_2k", "colours", ("other", "linear", 3), "taken for data"),
     ("photo", "grey", ("albedo", "srgb", 3), "")],
)  # fmt: skip
def test_names_of_single_images(tmp_path, stem, kind, expected, said):
    arrays = {"colours": pattern(8, 8, 3), "normals": normal_map(), "grey": np.repeat(pattern(8, 8, 1), 3, 2)}
    source = load_source(write(tmp_path / f"{stem}.png", arrays[kind]))
    (m,) = source.maps
    assert (m.role, m.color_space, m.channels) == expected and m.name == "image"
    assert (len(source.notes) == 1 and said in source.notes[0]) if said else source.notes == ()
    assert np.array_equal(np.rint(m.values * 255), arrays[kind][..., : m.channels])  # no note changes values
    assert load_source(tmp_path / f"{stem}.png", named=False).maps[0].color_space == "srgb"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, "signed"])
def test_normals_of_directx(tmp_path, dtype):
    array = normal_map()
    array = array * np.uint16(257) if dtype == np.uint16 else array
    if dtype in (np.float32, "signed"):
        array = array.astype(np.float32) / 255
        array = 2 * array - 1 if dtype == "signed" else array
    name = "n.png" if np.dtype(array.dtype).kind == "u" else "n.exr"
    write(tmp_path / name, array)
    source = load_source(manifest(tmp_path, {"nor_gl": name, "nor_dx": name}))
    up, down = (m.values if dtype == "signed" else 2 * m.values - 1 for m in source.maps)
    np.testing.assert_allclose(down, up * [1, -1, 1], atol=1e-6)
    assert [m.role for m in source.maps] == ["normal"] * 2
    assert len(source.notes) == 1 and 'map "nor_dx": normals of DirectX' in source.notes[0]


@pytest.mark.parametrize(
    "maps, said",
    [({"albedo": "c.png", "normal": "n.png", "height": "c.png", "Wood_Color": "c.png"}, []),
     ({"paint": "c.png"}, ['map "paint": an unknown name, taken for data, linear']),
     ({"paint": {"file": "c.png", "color_space": "linear"}}, []),
     ({"paint": "grey.png"}, []),
     ({"paint": "n.png"}, ['map "paint": looks like a normal map']),
     ({"BumpMap": "n.png"}, ['map "BumpMap": looks like a normal map']),
     ({"paint": "Wood_Color.png"}, ['map "paint": has the role albedo by the name of its file']),
     ({"paint": {"file": "Wood_Color.png", "channels": "r"}}, []),
     ({"arm": "c.png"}, ['map "arm": holds several maps']),
     ({"maps": {"albedo": "c.png"}, "licence": "CC0", "more": {"a": 1}}, ["keys that are not used: licence, more"])],
)  # fmt: skip
def test_notes_of_manifests(tmp_path, maps, said):
    images = {"c": pattern(8, 8, 3), "Wood_Color": pattern(8, 8, 3), "n": normal_map()}
    for name, array in {**images, "grey": np.repeat(pattern(8, 8, 1), 3, 2)}.items():
        write(tmp_path / f"{name}.png", array)
    notes = load_source(manifest(tmp_path, maps)).notes
    assert len(notes) == len(said) and all(part in note for part, note in zip(said, notes, strict=True)), notes


@pytest.mark.parametrize(
    "name", ["maps/A.JPG", "./maps/A.JPG", r"maps\A.JPG", r".\maps\A.JPG", "maps/a.jpg", r"Maps\a.JPG"]
)
def test_names_of_files_as_other_systems_write_them(tmp_path, name):
    (tmp_path / "maps").mkdir()
    write(tmp_path / "a.jpg", np.full((4, 4, 3), 99, np.uint8)).rename(tmp_path / "maps" / "A.JPG")
    assert load_source(manifest(tmp_path, {"albedo": name})).maps[0].values.shape == (4, 4, 3)


@pytest.mark.parametrize("name", [r"..\secret.png", "../secret.png"])
def test_names_of_files_outside(tmp_path, name):
    (tmp_path / "inside").mkdir()
    write(tmp_path / "secret.png", pattern(4, 4, 3))
    refused("lies outside of its folder", manifest(tmp_path / "inside", {"albedo": name}))


def test_no_variant_is_set_or_changed(tmp_path, mi_rgb):
    path = write(tmp_path / "a.png", pattern(5, 7, 3))
    before = mi_rgb.variant()
    digest = load_source(path).digest
    assert mi_rgb.variant() == before
    code = (
        "import sys; from mi_diffind.maps import source\n"
        "print(source.load_source(sys.argv[1]).digest); import mitsuba; assert mitsuba.variant() is None"
    )
    run = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == digest


@pytest.mark.parametrize(
    "extension, size", [("png", 7), ("png", 200), ("jpg", 7), ("jpg", 200), ("exr", 7), ("exr", 99)]
)
def test_cut_short(tmp_path, capfd, extension, size):
    array = pattern(size, size + 1, 3, np.float16 if extension == "exr" else np.uint8)
    data = write(tmp_path / f"whole.{extension}", array).read_bytes()
    load_source(tmp_path / f"whole.{extension}")
    path = tmp_path / f"cut.{extension}"
    count = len(data)
    for length in (0, 1, 4, 8, 20, *(count * k // 4 for k in (1, 2, 3)), *(count - k for k in (20, 12, 2, 1))):
        path.write_bytes(data[:length])
        refused(None, path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("extension", ["png", "jpg"])
def test_more_after_the_end_is_fine(tmp_path, extension):
    path = write(tmp_path / f"a.{extension}", pattern(7, 5, 3))
    digest = load_source(path).digest
    path.write_bytes(path.read_bytes() + bytes(10) + b"more")
    assert load_source(path).digest == digest


def test_jpeg_with_a_thumbnail_is_not_taken_for_whole(tmp_path):
    data = write(tmp_path / "a.jpg", pattern(50, 50, 3)).read_bytes()
    inner = write(tmp_path / "b.jpg", pattern(5, 5, 3)).read_bytes()
    segment = b"\xff\xe1" + struct.pack(">H", len(inner) + 2) + inner
    (tmp_path / "c.jpg").write_bytes(data[:2] + segment + data[2:])
    assert load_source(tmp_path / "c.jpg").digest == load_source(tmp_path / "a.jpg").digest
    (tmp_path / "c.jpg").write_bytes(data[:2] + segment + data[2:-100])
    refused("is cut short, a JPEG file ends", tmp_path / "c.jpg")


def test_not_an_image(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.png").write_text("This is text, and not an image. " * 3)
    for name, match in {
        "missing.png": "no such file",
        "folder": "is a folder",
        "text.png": "cannot be read",
    }.items():
        refused(match, tmp_path / name)


@pytest.mark.parametrize("name", ["", "a b", "1a", "a-b", "ä b"])
def test_bad_names(tmp_path, name):
    write(tmp_path / "a.png", pattern(5, 7, 3))
    refused("a map is called", manifest(tmp_path, {name: "a.png"}))


def test_nonfinite_values(tmp_path):
    array = pattern(5, 7, 3, np.float32)
    expected = array.copy()
    array[2, 4, 1], expected[2, 4, 1] = np.nan, 0
    array[3, 0, 0], array[4, 6, 0] = np.inf, -np.inf
    expected[3, 0, 0] = np.delete(array[..., 0], [21, 34]).max()
    expected[4, 6, 0] = np.delete(array[..., 0], [21, 34]).min()
    path = write(tmp_path / "a.exr", array)
    refused(r'map "image" has 3 values that are NaN or infinite.*x = 4, y = 2', path)
    source = load_source(path, nonfinite="clean")
    assert source.cleaned == 3 and np.array_equal(source.maps[0].values, expected)
    assert load_source(write(tmp_path / "b.exr", expected), nonfinite="clean").cleaned == 0
    with pytest.raises(ValueError, match='nonfinite: found "zero", allowed are'):
        load_source(path, nonfinite="zero")


@pytest.mark.parametrize("flat", [False, True])
def test_manifest(tmp_path, flat):
    (tmp_path / "textures").mkdir()
    orm, base, normal = pattern(5, 7, 3), pattern(5, 7, 3, np.uint16), pattern(5, 7, 3, seed=2)
    for name, array in (("textures/orm.png", orm), ("base.png", base), ("n.png", normal)):
        write(tmp_path / name, array)
    maps = {
        "albedo": "base.png",
        "normal": {"file": "n.png", "color_space": "linear"},
        "roughness": {"file": "textures/orm.png", "channels": "g"},
        "ao": {"file": "textures/orm.png", "channels": [0]},
    }
    source = load_source(manifest(tmp_path, maps if flat else {"maps": maps}))
    assert described(source) == [
        ("albedo", "albedo", "srgb", 2, 3),
        ("normal", "normal", "linear", 1, 3),
        ("roughness", "roughness", "linear", 1, 1),
        ("ao", "ao", "linear", 1, 1),
    ]
    assert source.maps[3].file == str(tmp_path / "textures" / "orm.png")
    assert source.nbytes == 35 * (3 * 2 + 3 + 1 + 1) and source.channels == 8
    arrays = {"albedo": base, "normal": normal, "roughness": orm[..., 1], "ao": orm[..., 0]}
    assert from_arrays(arrays).digest == source.digest


def test_color_spaces_of_a_manifest(tmp_path):
    write(tmp_path / "a.png", pattern(5, 7, 3))
    write(tmp_path / "a.exr", pattern(5, 7, 3, np.float16))
    maps = {"diffuse": {"file": "a.png", "color_space": "linear"}, "albedo": "a.exr", "normal": "a.png"}
    maps |= {"sheen": "a.png", "paint": {"file": "a.png", "color_space": "srgb"}}
    source = load_source(manifest(tmp_path, maps))
    assert [m.color_space for m in source.maps] == ["linear"] * 4 + ["srgb"]


def test_equal_channels(tmp_path):
    write(tmp_path / "grey.png", np.repeat(pattern(5, 7, 1), 3, 2))
    write(tmp_path / "rgb.png", pattern(5, 7, 3))
    maps = {"roughness": "grey.png", "metallic": "rgb.png", "albedo": "grey.png", "height": "grey.png"}
    source = load_source(manifest(tmp_path, {**maps, "ao": {"file": "grey.png", "channels": "rgb"}}))
    assert [m.channels for m in source.maps] == [1, 3, 3, 3, 3]


def test_alpha_in_a_manifest(tmp_path):
    array = pattern(5, 7, 4)
    write(tmp_path / "a.png", array)
    refused(
        'map "albedo" is from a file with transparency: "channels" is needed', manifest(tmp_path, {"albedo": "a.png"})
    )
    maps = {"albedo": {"file": "a.png", "channels": "rgb"}, "alpha": {"file": "a.png", "channels": "a"}}
    source = load_source(manifest(tmp_path, maps))
    assert [m.color_space for m in source.maps] == ["srgb", "linear"]
    assert np.array_equal(np.rint(source.maps[1].values * 255), array[..., 3:])
    array[..., 3] = 255
    write(tmp_path / "a.png", array)
    assert load_source(manifest(tmp_path, {"albedo": "a.png"})).channels == 3


@pytest.mark.parametrize("channels", ["", "x", "ra", "rr", [], [3], [-1], [0, 0], [True], ["r"], 1, None, {}])
def test_bad_channels(tmp_path, channels):
    write(tmp_path / "a.png", pattern(5, 7, 3))
    refused('map "ao" has the channels', manifest(tmp_path, {"ao": {"file": "a.png", "channels": channels}}))


@pytest.mark.parametrize(
    "content, match",
    [
        ('{"maps": ', "is not valid JSON"),
        ("", "is not valid JSON"),
        ('{"a": "a.png", "a": "a.png"}', 'the key "a" comes twice'),
        ("[" * 100_000, "is not valid JSON"),
        ([], "has no maps"),
        ({}, "has no maps"),
        ({"maps": {}}, "has no maps"),
        ({"maps": "a.png"}, "has no maps"),
        ({"a": 3}, 'map "a" is 3, expected'),
        ({"a": {"path": "a.png"}}, 'map "a" is {.path.: .a.png.}, expected a file name, or an object'),
        ({"a": {"channels": "r"}}, 'map "a" is {.channels.: .r.}, expected a file name, or an object'),
        ({"a": {"file": "a.png", "color_space": "rgb"}}, "has the color space 'rgb', allowed are"),
        ({"a": {"file": "a.png", "color_space": []}}, "has the color space"),
        ({"a": "missing.png"}, r"missing\.png: no such file"),
        ({"a": "."}, "is a folder"),
        ({"a": "a\0.png"}, "cannot be read|no such file"),
        ({"albedo": "a.png", "normal": "b.png"}, 'map "albedo" has 7×5 texels and map "normal" has 5×7'),
    ],
)
def test_bad_manifests(tmp_path, content, match):
    write(tmp_path / "a.png", pattern(5, 7, 3))
    write(tmp_path / "b.png", pattern(7, 5, 3))
    refused(match, manifest(tmp_path, content))


def test_the_digest_tells_everything_apart():
    array = pattern(6, 4, 2)
    changed = array.copy()
    changed[5, 3, 1] ^= 1
    sources = [
        from_arrays({"a": array}),
        from_arrays({"b": array}),
        from_arrays({"a": array}, {"a": "srgb"}),
        from_arrays({"a": array.reshape(4, 6, 2)}),
        from_arrays({"a": array[..., :1], "b": array[..., 1:]}),
        from_arrays({"a": changed}),
        from_arrays({"a": array.astype(np.float32) / 255}),
    ]
    assert len({s.digest for s in sources}) == len(sources)
    assert sources[0].digest == from_arrays({"a": np.asfortranarray(array)}).digest


@pytest.mark.parametrize(
    "arrays, match",
    [
        ({}, "arrays: has no maps"),
        ({"a": np.zeros((0, 3))}, r'array "a": has the shape \(0, 3\)'),
        ({"a": np.zeros((3, 3, 0))}, "has the shape"),
        ({"a": np.zeros(3)}, "has the shape"),
        ({"a": np.zeros((2, 2), np.int32)}, "has the type int32, allowed are"),
        ({"a": np.zeros((2, 2), bool)}, "has the type bool, allowed are"),
        ({"a": np.zeros((2, 2), object)}, "has the type object, allowed are"),
        ({"normal": np.zeros((4, 4))}, 'the normal map "normal" has 1 channel, 3 are needed'),
        ({"a": np.zeros((2, 2, 17))}, "has 17 channels in all, at most 16"),
        ({"a b": np.zeros((2, 2))}, "a map is called 'a b'"),
        ({3: np.zeros((2, 2))}, "a map is called 3"),
        ({"a": np.zeros((2, 2)), "b": np.zeros((2, 3))}, 'map "a" has 2×2 texels and map "b" has 3×2'),
        ({"a": np.full((2, 2), 1e300)}, 'map "a" has 4 values that are NaN or infinite'),
    ],
)
def test_bad_arrays(arrays, match):
    refused(match, arrays)
