"""Text of converted scenes: what was changed and nothing else, as Mitsuba reads it, in any folder and encoding."""

import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from mi_diffind.scenes import conversion, loading, scene_text

HEAD = '<scene version="3.0.0">'


def written(source, text, output, learn=("disney",), **defines):
    """Convert a text without pictures; return the new text."""
    source.write_text(text)
    conversion.convert(source, output, learn=learn, defines=defines, check=False, progress=False)
    return output.read_text()


@pytest.fixture
def folders(tmp_path):
    """A folder with a small image and an included material, and another one."""
    import mitsuba as mi

    (tmp_path / "a" / "parts").mkdir(parents=True)
    (tmp_path / "b").mkdir()
    for name in ("a/leaf.png", "a/parts/leaf.png", 'a/ä & "b".png'):
        mi.Bitmap(np.full((4, 4, 3), 100, np.uint8)).write(str(tmp_path / name))
    leaf = '<texture type="bitmap" name="base_color"><string name="filename" value="leaf.png"/></texture>'
    (tmp_path / "a/parts/paint.xml").write_text(f'{HEAD}<bsdf type="principled" id="paint">{leaf}</bsdf></scene>')
    (tmp_path / "a/parts/plain.xml").write_text(f'{HEAD}<bsdf type="diffuse" id="plain"/></scene>')
    (tmp_path / "a/parts/lone.xml").write_text(
        f'<bsdf version="3.0.0" type="principled" name="x" id="lone">{leaf}</bsdf>'
    )
    (tmp_path / "a/parts/values.xml").write_text(
        f'{HEAD}<default name="m" value="0.25"/><default name="p" value="leaf"/></scene>'
    )
    (tmp_path / "a/parts/old.xml").write_text('<scene version="0.6.0"><bsdf type="principled" id="old"/></scene>')
    (tmp_path / "b/leaf").write_text("no texture")
    (tmp_path / "a/lamp.spd").write_text("400 1\n500 2\n700 0.3\n")
    return tmp_path / "a", tmp_path / "b"


def test_transforms_of_all_sizes(mi_rgb, tmp_path):
    """Scales of 1e-4 to 1e4 with rotations, of shapes and ``to_uv``, against their matrices in double precision."""
    mi, objects, matrices = mi_rgb, [], []
    for i, (scale, degrees) in enumerate(itertools.product(10.0 ** np.arange(-4, 5), (0, 33, 90, -179.5))):
        turn = f'<scale value="{scale:g}"/><rotate y="1" angle="{degrees}"/>'
        objects.append(
            f'<shape type="cube" id="s{i}"><transform name="to_world">{turn}</transform><bsdf type="principled">'
            f'<texture type="checkerboard" name="base_color"><transform name="to_uv"><scale x="{scale:g}" y="2"/>'
            f'<rotate z="1" angle="{degrees}"/></transform></texture></bsdf></shape>'
        )
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        world = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) * scale
        uv = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.diag([scale, 2, 1])
        matrices += [world, uv]
    written(tmp_path / "scene.xml", f"{HEAD}{''.join(objects)}</scene>", tmp_path / "new.xml")
    parsed = loading.ParsedScene(tmp_path / "new.xml")
    found = parsed.change(lambda s: [n.props[k] for n in s.nodes for k in ("to_world", "to_uv") if k in n.props])
    assert len(found) == len(matrices) == 72
    for transform, matrix in zip(found, matrices, strict=True):
        np.testing.assert_allclose(np.array(transform.matrix)[:3, :3], matrix, atol=1e-12 * np.abs(matrix).max())
    box = mi.load_file(str(tmp_path / "new.xml"), optimize=False).shapes()[-1].bbox()
    np.testing.assert_allclose(box.max, np.abs(matrices[-2]).sum(axis=1), rtol=1e-5)


def test_ids_aliases_references_and_both_sides(mi_rgb, tmp_path):
    """Materials, ids that nothing refers to, and paths of parameters, as Mitsuba loads them from both files."""
    text = f"""{HEAD}
    <!-- two  - - dashes -- and <bsdf type="principled"> in a comment -->
    <sensor type="perspective" id="cam"/>
    <emitter type="point" id="lamp"/>
    <bsdf type="diffuse" id="red"><rgb name="reflectance" value="0.6 0.1 .30"/></bsdf>
    <alias id="red" as="walls"/>
    <shape type="sphere" id="ball"><ref id="red"/>
        <emitter type="area"><rgb name="radiance" value="0.2"/></emitter></shape>
    <shape type="sphere" id="round"><ref id="walls"/></shape>
    <shape type="rectangle" id="sheet"><bsdf type="twosided" id="both">
        <bsdf type="diffuse"/><bsdf type="principled" id="back"><float name="roughness" value="0.1"/></bsdf>
    </bsdf></shape>
</scene>"""
    new = written(tmp_path / "scene.xml", text, tmp_path / "new.xml")
    assert new == text.replace('<bsdf type="principled" id="back"', '<bsdf type="disney" id="back"')
    a, b = (loading.load_file(tmp_path / f, optimize=False) for f in ("scene.xml", "new.xml"))
    assert [shape.id() for shape in a.shapes()] == [shape.id() for shape in b.shapes()]
    assert [str(shape.bsdf()) for shape in a.shapes()[:2]] == [str(shape.bsdf()) for shape in b.shapes()[:2]]
    keys, back = [set(mi_rgb.traverse(scene).keys()) for scene in (a, b)], "sheet.bsdf.brdf_1"
    assert {"lamp.intensity.value", "cam.x_fov", f"{back}.roughness.value"} <= keys[0] & keys[1]
    assert {k for k in keys[0] if not k.startswith(back)} == {k for k in keys[1] if not k.startswith(back)}


#: What stands for the names of files in two folders: that of the scene, and another.
NAMES = {
    "NUMBERED": ("l&#101;a&#x66;.png", "../a/leaf.png"), "UP": ("", "../a/"), "FILE": ("$f", "../a/leaf.png"),
    "DOLLAR": ("$p.png", "../a/leaf.png"), "QUOTED": ('"ä &amp; &quot;b&quot;.png"', "'../a/ä &amp; \"b\".png'"),
}  # fmt: skip
LEAF = '<texture type="bitmap" name="base_color"><string name="filename" value="UPleaf.png"/></texture></bsdf>'
FILE = '<texture type="bitmap"><string name="filename" value={}/></texture>'.format
METAL = '<bsdf type="{}"><float name="metallic" value="$m"/></bsdf>'.format
VALUES = '<include filename="UPparts/values.xml"/>'


@pytest.mark.parametrize("folder", [0, 1])
@pytest.mark.parametrize(
    "body, expected",
    [
        ('<include filename="UPparts/plain.xml"/>', ""),
        ('<include filename="parts/paint.xml"/>', f'<bsdf type="disney" id="paint">{LEAF}'),
        ('<shape type="sphere"><include name="m" filename="parts/lone.xml"/></shape>',
         f'<shape type="sphere"><bsdf name="m"  type="disney"  id="lone">{LEAF}</shape>'),
        (VALUES + METAL("principled"), VALUES + METAL("disney")),
        (VALUES + FILE('"DOLLAR"'), ""),
        ('<default name="n" value="leaf"/><default name="f" value="$n.png"/>\n' + FILE('"FILE"'), ""),
        (FILE("QUOTED"), ""),
        (FILE('"NUMBERED"'), ""),
        ('<path value="UPparts"/>' + FILE('"UPparts/leaf.png"'), ""),
        ('<emitter type="constant"><spectrum name="radiance" filename="UPlamp.spd"/></emitter>', ""),
        ('<emitter type="constant"><string name="w" value="leaf"/><string name="file" value="no.jpg"/></emitter>', ""),
    ],
)  # fmt: skip
def test_files_includes_and_parameters(mi_rgb, folders, body, expected, folder):
    """Files are found from the new folder; an included file that changes takes the place of its include."""

    def text(names, folder):
        for name, values in NAMES.items():
            names = names.replace(name, values[folder])
        return f"{HEAD}{names}</scene>"

    a, _ = folders
    new = written(a / "scene.xml", text(body, 0), a.parent / "ab"[folder] / "new.xml")
    assert new == text(expected or body, folder)


def test_values_of_defines_become_defaults(mi_rgb, folders):
    """The new file shows the same without ``-D``, and can still be given other values."""
    a, b = folders
    body = '<default name="rough" value="0.5"/><bsdf type="principled"><float name="roughness" value="$rough"/>'
    body += '<float name="metallic" value="$m"/></bsdf>'
    new = written(a / "scene.xml", f"{HEAD}{body}</scene>", b / "new.xml", rough=0.1, m="0.25")
    assert re.findall(r'<default name="(\w+)" value="([\d.]+)"/>', new) == [("m", "0.25"), ("rough", "0.1")]
    read = loading.ParsedScene(b / "new.xml", {"rough": 0.7}).change(lambda s: s.nodes[1].props)
    assert (read.plugin_name(), read["roughness"], read["metallic"]) == ("disney", 0.7, 0.25)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
def test_encodings(mi_rgb, tmp_path, encoding):
    """Places of objects are bytes of what Mitsuba converts a file to, or the scene is refused."""
    text = f'{HEAD}<!-- äöü --><bsdf type="principled" id="ä"/></scene>'
    head = f'<?xml version="1.0" encoding="{ {"latin-1": "iso-8859-1"}.get(encoding, "utf-8") }"?>\n'
    source, new = tmp_path / "scene.xml", tmp_path / "new.xml"
    source.write_bytes(("\ufeff" * (encoding == "utf-16-le") + head + text).encode(encoding))
    if encoding == "latin-1":
        with pytest.raises(loading.SceneError, match=r"scene\.xml: found text in another encoding, needed is UTF-8"):
            conversion.convert(source, new, learn=["disney"], check=False)
        assert not new.exists()
        return
    conversion.convert(source, new, learn=["disney"], check=False)
    assert new.read_bytes().decode().endswith(text.replace("principled", "disney"))


@pytest.mark.parametrize(
    "damage, fault",
    [
        ((b'value="1000"', b'value="1296"'), "has to_world"),
        ((b'value="0.5"', b'value="0.50000001"'), "has roughness 0.50000001 in place of 0.5"),
        ((b' id="lamp"', b""), 'in place of point "lamp"'),
        ((b'type="disney"', b'type="neural_disney"'), 'neural_disney "m" in place of disney "m"'),
        ((b'<ref id="m"/>', b""), 'cube "box" lacks "_arg_0"'),
        ((b'<ref id="m"/>', b'<ref id="n"/>'), "objects that refer to others than before"),
        ((b"</scene>", b'<bsdf type="diffuse"/></scene>'), '"_arg_4"'),
        ((b'value="leaf.png"', b'value="parts/leaf.png"'), "has filename"),
        ((b"</scene>", b""), "new.xml"),
    ],
)
def test_a_text_that_reads_differently_is_not_written(mi_rgb, folders, monkeypatch, damage, fault):
    a, _ = folders
    (a / "scene.xml").write_text(
        f'{HEAD}<bsdf type="principled" id="m"><float name="roughness" value="0.5"/></bsdf>'
        '<bsdf type="diffuse" id="n"><texture name="reflectance" type="bitmap">'
        '<string name="filename" value="leaf.png"/></texture></bsdf><emitter type="point" id="lamp"/>'
        '<shape type="cube" id="box"><transform name="to_world">'
        '<scale value="1000"/></transform><ref id="m"/></shape></scene>'
    )
    right, before = conversion.edit_text, set(a.iterdir())

    def wrong(*arguments):
        content = right(*arguments)
        assert content.count(damage[0]) == 1
        return content.replace(*damage)

    monkeypatch.setattr(conversion, "edit_text", wrong)
    with pytest.raises(loading.SceneError, match=fault):
        conversion.convert(a / "scene.xml", a / "new.xml", learn=["disney"], check=False)
    assert set(a.iterdir()) == before


@pytest.mark.parametrize(
    "body, fault",
    [
        ('<shape type="sphere"><ref id="none"/></shape>', 'refers to the id "none", which no object has'),
        ('<include filename="parts/old.xml"/>', r"old\.xml: has to change, and is of another version"),
    ],
)
def test_scenes_that_cannot_be_written(mi_rgb, folders, body, fault):
    a, _ = folders
    with pytest.raises(loading.SceneError, match=fault):
        written(a / "scene.xml", f"{HEAD}{body}</scene>", a / "new.xml")
    assert not (a / "new.xml").exists()


def test_the_example_scenes(mi_rgb, tmp_path):
    """Each of them, with nothing learned, in another folder: the same objects in Mitsuba's words, but for paths."""
    for source in sorted((Path(__file__).parents[1] / "scenes").glob("*.xml")):
        conversion.convert(source, tmp_path / source.name, learn=[])
        paths = source, tmp_path / source.name
        states = [loading.ParsedScene(path).change(scene_text.absolute_paths) for path in paths]
        lines = [re.sub(r"object_\d+", "", "\n".join(str(node.props) for node in state.nodes)) for state in states]
        assert lines[0] == lines[1] and lines[0].count("\n") > 20
