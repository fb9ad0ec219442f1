"""Conversion of scenes: what replaces Mitsuba's plugins, what stays and why, and fits that are not repeated."""

import contextlib
import json
import os
import re
import struct
import zlib
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import trimesh

import mi_diffind
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.plugins.support import distance_shapes, image_files
from mi_diffind.plugins.support.properties import Kept
from mi_diffind.scenes import comparison, conversion, loading
from mi_diffind.tasks.sdf.mesh import MeshError, load_mesh, read_serialized

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
    monkeypatch.setattr(conversion, "_cores", lambda: 1)  # other processes know nothing of this fit
    return tmp_path, fits


def principled(name, **numbers):
    """A material with an id."""
    listed = "".join(f'<float name="{key}" value="{value}"/>' for key, value in numbers.items())
    return f'<bsdf type="principled" id="{name}">{listed}</bsdf>'


def textured(name, image, filter_type="bilinear"):
    """A diffuse material with an id that shows an image."""
    return f"""<bsdf type="diffuse" id="{name}"><texture type="bitmap" name="reflectance"><string name="filename"
        value="{image}"/><string name="filter_type" value="{filter_type}"/></texture></bsdf>"""


def parsed(folder, objects, name="scene.xml"):
    (folder / name).write_text(SCENE.replace("OBJECTS", objects))
    return loading.ParsedScene(folder / name)


def test_a_converted_scene_shows_the_same(mi_rgb, folder):
    """Materials, textures and a mesh, in memory and written to another folder; a second time nothing is fitted."""
    folder, fits = folder
    floor = """<shape type="rectangle"><transform name="to_world"><rotate x="1" angle="-90"/><scale value="4"/>
        <translate y="-1"/></transform><bsdf type="twosided" id="floor"><bsdf type="principled">
        <texture name="base_color" type="bitmap"><string name="filename" value="image.png"/>
        <string name="filter_type" value="bilinear"/></texture></bsdf></bsdf></shape>"""
    ball = BALL.replace("MORE", '<boolean name="face_normals" value="true"/>')
    scene = parsed(folder, ball + floor)
    stock = loading.render(scene.load(), 16)[0]
    conversions = conversion.replace_stock(scene, ["disney", "bitmap", "mesh"], folder / "tables")
    assert [(c.stock, c.learned, c.name) for c in conversions] == [
        ("ply", "neural_sdf", "ball"), ("principled", "disney", "ball"),
        ("principled", "disney", "floor"), ("bitmap", "neural_texture", "floor"),
        ("path", "path_sdf", "path"),
    ]  # fmt: skip
    assert [task for task, _ in fits] == ["sdf", "texture"]
    lines = conversion.summary(conversions)
    assert lines[0] == "replaced    1 x ply → neural_sdf" and re.fullmatch(
        r' +"ball": ball_\w+\.npz, IoU 0\.9\d+, normals off by \d\.\d°', lines[1]
    )
    assert re.fullmatch(r' +"floor": image_\w+\.npz, \d\d\.\d dB', lines[4])
    assert lines[6] == " " * 12 + '"path": which follows no footprints: textures filter by the sensor\'s alone'
    (folder / "other").mkdir()
    conversion.write_scene(scene, folder / "other" / "new.xml")
    learned = loading.render(loading.load(folder / "other" / "new.xml"), 16)[0]
    assert stock.std() > 0.1 and np.abs(learned - stock).mean() < 0.02
    exact = loading.load(folder / "other" / "new.xml", exact=True)
    assert "PLYMesh" in [shape.class_name() for shape in exact.shapes()]
    twice = parsed(folder, ball + floor, "again.xml")
    assert len(conversion.replace_stock(twice, ["mesh", "bitmap"], folder / "tables")) == 3 and len(fits) == 2


@pytest.mark.parametrize(
    "group, objects, name, reason",
    [
        ("disney", principled("Glass", spec_trans=0.9), 'principled "Glass"', "transmits light"),
        ("disney", f'<bsdf type="twosided" id="Gem">{principled("Inner", eta=4)}</bsdf>', 'principled "',
         'the parameter "eta" 4, the Disney BRDF allows 1 to 3'),
        ("bitmap", textured("Sharp", "image.png", "nearest"), 'bitmap "Sharp"', '"nearest" and fewer than 256'),
        ("bitmap", textured("Webp", "leaf.webp"), 'bitmap "Webp"', "leaf.webp: cannot be read"),
        ("bitmap", textured("Lost", "none.png"), 'bitmap "Lost"', "names no file that exists"),
        *(
            ("disney", principled("Gold", metallic=metal, **{name: value}), 'principled "Gold"',
             f'is a metal with "{name}" {value}')
            for metal, name, value in ((1, "specular", 0), (0.5, "eta", 1))
        ),
        *(
            ("disney", principled("Floor", **{name: value}), 'principled "Floor"',
             f'has the "{name}" {value}, below {least} the Disney BRDF reflects more at grazing')
            for name, value, least in (("specular", 0, 0.1), ("specular", 0.09, 0.1), ("eta", 1.1, 1.2))
        ),
        ("mesh", BALL.replace("MORE", '<emitter type="area"/>'), 'ply "ball"', "emits light"),
        ("mesh", BALL.replace("MORE", '<transform name="to_world"><scale x="1" y="2" z="1"/></transform>'),
         'ply "ball"', "allowed are rotations, uniform scales"),
        ("mesh", BALL.replace("ball.ply", "bowl.ply").replace("MORE", ""), 'ply "ball"', "encloses no solid"),
        ("mesh", BALL.replace("MORE", '<boolean name="flip_normals" value="true"/>'), 'ply "ball"',
         "is wound inside out: 100% of its triangles face inwards"),
        ("mesh", BALL.replace("ball.ply", "coarse.ply").replace("MORE", ""), 'ply "ball"',
         "has shading normals 10° from those of its triangles"),
        ("mesh", '<shape type="ply"><string name="filename" value="ball.ply"/><bsdf type="diffuse" id="Worn"><texture '
         'name="reflectance" type="checkerboard"/></bsdf></shape>', "scene.xml", "with textures (checkerboard)"),
    ],
)  # fmt: skip
def test_what_stays_is_named_with_the_reason(mi_rgb, folder, group, objects, name, reason):
    folder, fits = folder
    half = trimesh.creation.icosphere(3)
    half.update_faces(half.triangles_center[:, 1] < 0)
    half.export(folder / "bowl.ply")
    trimesh.creation.icosphere(1).export(folder / "coarse.ply")
    (folder / "leaf.webp").write_bytes(b"RIFF\0\0\0\0WEBP" + bytes(64))
    scene = parsed(folder, objects)
    (one,) = conversion.replace_stock(scene, [group], folder / "tables")
    assert one.learned == "" and reason in one.reason and name in str(one) and not fits and "\n" not in one.reason
    assert conversion.summary([one]) == [f"kept        {one}"]
    stays = scene.change(lambda state: [node.props.plugin_name() for node in state.nodes])
    assert one.stock in stays and "path" in stays
    if name == 'principled "Glass"':
        with pytest.raises(loading.SceneError, match='nothing to compare; kept is principled "Glass": transmits light'):
            comparison.compare(folder / "scene.xml", learn=[group], progress=False)


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), UsageError("no")])
def test_a_fit_that_ends_early_leaves_no_files(mi_rgb, folder, monkeypatch, fault):
    """An interrupted conversion leaves nothing; one whose fit is refused keeps the image, and writes no table."""

    def failing(*_, **__):
        raise fault

    monkeypatch.setattr(conversion, "fit", failing)
    parsed(folder[0], f'<shape type="sphere">{textured("m", "image.png")}</shape>')
    before = sorted(folder[0].iterdir())
    (folder[0] / "new").mkdir()
    with pytest.raises(KeyboardInterrupt) if isinstance(fault, KeyboardInterrupt) else contextlib.nullcontext():
        conversion.convert(folder[0] / "scene.xml", folder[0] / "new" / "new.xml", check=False)
    assert sorted(folder[0].iterdir()) == sorted([*before, folder[0] / "new"])
    assert [file.name for file in (folder[0] / "new").iterdir()] == ["new.xml"] * isinstance(fault, UsageError)


@pytest.mark.parametrize("names, after", [(["path"], ["path_sdf"]), (["aov", "path"], ["aov", "path"])])
def test_a_path_stays_where_another_integrator_needs_decoded_fields(mi_rgb, names, after):
    """``path_sdf`` follows no footprints: nothing is gained where the fields are decoded to grids in any case."""
    integrators = [mi_rgb.Properties(name) for name in names]
    conversions = conversion._trace_by(("path_sdf",), integrators)
    assert [props.plugin_name() for props in integrators] == after
    assert [c.learned for c in conversions] == ["path_sdf" if len(names) == 1 else ""]


@pytest.mark.parametrize("metal, specular, most", [(0, 0.1, 0.2), (0, 0.5, 0.03), (1, 0.05, 0.03)])
def test_albedos_at_grazing_angles_of_what_is_replaced(mi_rgb, folder, metal, specular, most):
    """A polished floor seen at 11° is up to 15% brighter at the limit of ``specular``, and 3% by default."""
    mi, n = mi_rgb, 1 << 16
    numbers = {"roughness": 0.1, "metallic": float(metal), "specular": specular}
    scene = parsed(folder[0], principled("Floor", **numbers))
    (one,) = conversion.replace_stock(scene, ["disney"], folder[0] / "tables")
    albedo, si = [], dr.zeros(mi.SurfaceInteraction3f, n)
    si.wi = mi.Vector3f(0.96**0.5, 0, 0.2)
    for plugin in (one.stock, one.learned):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(1, n)
        bsdf = mi.load_dict({"type": plugin, **numbers})
        weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())[1]
        albedo.append(float(dr.mean(weight.x)[0]))
    assert abs(albedo[1] / albedo[0] - 1) < most


def test_the_command_and_a_comparison_with_the_stock_scene(mi_rgb, tmp_path, capsys):
    ball = '<shape type="sphere"><ref id="Clay"/></shape>'
    parsed(tmp_path, principled("Clay") + principled("Glass", spec_trans=1) + ball)
    scene, new = str(tmp_path / "scene.xml"), tmp_path / "new.xml"
    arguments = ["-o", str(new), "--json", str(tmp_path / "a.json"), "--variant", mi_rgb.variant()]
    assert main(["convert", scene, *arguments, "--learn", "disney"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed == [
        "replaced    1 x principled → disney",
        'kept        principled "Glass": transmits light (spec_trans), which the Disney BRDF does not',
        *printed[2:7], f"scene       {new}",
    ]  # fmt: skip
    assert [line.split()[0] for line in printed[2:6]] == ["disk", "memory", "of", "render"]
    assert printed[6].startswith("check       equal within noise (24 x 16 pixels, 64 spp), which would have shown")
    assert [c["learned"] for c in json.loads((tmp_path / "a.json").read_text())["conversions"]] == ["disney", ""]
    assert new.read_text().count("disney") == 1 and not (tmp_path / "new_tables").exists()
    for output, fault in (("scene.xml", "the same file as the scene"), ("new.json", "allowed is .xml")):
        assert main(["convert", scene, "-o", str(tmp_path / output)]) == 2 and fault in capsys.readouterr().err
    result = mi_diffind.compare(scene, 8, learn=["disney"], progress=False)
    assert result.truth == "stock (principled), 8 spp" and result.further == ()
    assert main(["convert", scene, "-o", str(new), "--learn", "disney", "--no-check"]) == 0
    assert "check" not in capsys.readouterr().out
    assert printed[:2] == str(result).splitlines()[3:5] and result.figures["psnr_db"] > 25
    same = mi_diffind.compare(new, 8, against="principled", progress=False)
    np.testing.assert_allclose(same.written, result.written, atol=1e-4)


def test_by_default_only_textures_are_learned(mi_rgb, folder):
    """Formulas stay formulas and meshes stay meshes unless they are asked for."""
    folder, fits = folder
    card = f'<shape type="rectangle">{textured("card", "image.png")}</shape>'
    parsed(folder, BALL.replace("MORE", "") + card)
    result = conversion.convert(folder / "scene.xml", folder / "new.xml", defines={"rough": 0.4}, progress=False)
    assert [(c.stock, c.learned, c.name) for c in result] == [("bitmap", "neural_texture", "card")]
    assert [task for task, _ in fits] == ["texture"] and str(result).splitlines()[-1] == f"check       {result.check}"
    types = loading.ParsedScene(folder / "new.xml").change(lambda state: [n.props.plugin_name() for n in state.nodes])
    assert {"principled", "ply", "path", "neural_texture"} <= set(types) and "bitmap" not in types
    same = conversion.convert(folder / "scene.xml", folder / "same.xml", learn=[])
    assert same.check is None and str(same) == "replaced    nothing"
    assert (folder / "same.xml").read_bytes() == (folder / "scene.xml").read_bytes()


def image(name, role, scale=2, raw=True):
    """A bitmap for a parameter, ``scale`` times over the surface."""
    return f"""<texture type="bitmap" name="{role}"><string name="filename" value="{name}.png"/><boolean name="raw"
        value="{str(raw).lower()}"/><transform name="to_uv"><scale x="{scale}" y="2"/></transform></texture>"""


def paint(*more):
    """A ``principled`` of two images and a number."""
    color, rough = image("image", "base_color", raw=False), image("rough", "roughness")
    return f'<bsdf type="principled">{color}{rough}{"".join(more)}<float name="metallic" value="0.25"/></bsdf>'


#: A texture that nests an image.
CHECKER = f'<texture type="checkerboard" name="sheen">{image("rough", "color0")}</texture>'


def bumpy(inner):
    return f'<bsdf type="normalmap">{image("bumps", "normalmap")}{inner}</bsdf>'


@pytest.fixture
def maps(folder, mi_rgb, monkeypatch):
    """Images of a material beside the image of the folder; a short fit is good enough."""
    monkeypatch.setattr(image_files, "LEAST_DB", 0)
    y, x = np.mgrid[:64, :64] / 64
    bumps = np.stack([0.3 * np.cos(4 * np.pi * x), 0.2 * np.sin(4 * np.pi * y), np.ones_like(x)], axis=2)
    bumps = 0.5 + 0.5 * bumps / np.linalg.norm(bumps, axis=2, keepdims=True)
    for name, values in (("bumps", bumps), ("rough", 0.5 + 0.3 * np.sin(4 * np.pi * y)), ("holes", np.rint(x))):
        mi_rgb.Bitmap(np.rint(255 * values).astype(np.uint8)).write(str(folder[0] / f"{name}.png"))
    return folder


def test_a_material_of_nested_plugins(mi_rgb, maps):
    """One file for a mask, both sides, normals and images; with the images again, it shows what the scene showed."""
    folder, fits = maps
    leaf = (
        f'<bsdf type="mask" id="leaf">{image("holes", "opacity")}<bsdf type="twosided">{bumpy(paint())}</bsdf></bsdf>'
    )
    floor = '<transform name="to_world"><rotate x="1" angle="-90"/><scale value="2"/></transform>'
    shared = '<texture type="bitmap" id="shared"><string name="filename" value="image.png"/></texture>'
    cloth = """<bsdf type="twosided" id="ID"><bsdf type="principled"><ref name="base_color" id="shared"/>
        <float name="roughness" value="ROUGH"/></bsdf></bsdf>"""
    cloths = [cloth.replace("ID", name).replace("ROUGH", rough) for name, rough in (("silk", "0.3"), ("wool", "0.9"))]
    balls = "".join(
        f'<shape type="sphere"><point name="center" value="{x}, 0, 0"/><float name="radius" value="0.8"/>{bsdf}</shape>'
        for x, bsdf in ((-2, '<ref id="wool"/>'), (0, bumpy(paint())), (2, principled("plain", roughness=0.4)))
    )
    objects = f'{shared}{leaf}{"".join(cloths)}<shape type="rectangle">{floor}<ref id="leaf"/></shape>{balls}'
    stock = loading.render(parsed(folder, objects).load(), 16)[0]
    (folder / "other").mkdir()
    new = folder / "other" / "new.xml"
    result = conversion.convert(folder / "scene.xml", new, check=False, progress=False)
    assert [(c.stock, c.learned, c.name) for c in result[:3]] == [
        ("mask", "neural_material", "leaf"), ("twosided", "neural_material", "silk"),
        ("twosided", "neural_material", "wool"),
    ]  # fmt: skip
    assert [(c.stock, c.learned) for c in result[3:]] == [("normalmap", "neural_material")]
    text = new.read_text()
    assert len(fits) == 3 and text.count('"neural_material"') == 4 and text.count('"principled"') == 1
    assert text.count('name="two_sided"') == 3 and "bitmap" not in text and 'id="shared"' not in text
    exact = loading.render(loading.ParsedScene(new).load(exact=True, against="principled"), 16)[0]
    assert stock.std() > 0.1 and np.abs(exact - stock).mean() < 0.01
    learned = loading.render(loading.load(new), 16)[0]
    assert np.abs(learned - stock).mean() < 0.05
    conversion.convert(folder / "scene.xml", new, check=False, progress=False)
    assert len(fits) == 3


@pytest.mark.parametrize(
    "material, reason",
    [
        (bumpy(f'<bsdf type="twosided">{paint()}</bsdf>'), "has a twosided within, allowed is the order mask"),
        (paint(image("image", "sheen")), 'has the image image.png with colours for "sheen", which is a number'),
        (paint(image("holes", "sheen", scale=3)), 'has images that differ in "to_uv"'),
        (paint('<texture type="checkerboard" name="sheen"/>'), 'has the texture "checkerboard" for "sheen"'),
        (f'<bsdf type="principled">{CHECKER}</bsdf>', 'has the texture "checkerboard" for "sheen", allowed are'),
        (paint('<spectrum name="sheen" value="400:0.1, 700:0.2"/>'), 'has a spectrum for "sheen"'),
        (paint('<float name="spec_trans" value="0.5"/>'), "transmits light (spec_trans)"),
        (f'<bsdf type="mask"><float name="opacity" value="0.5"/>{paint()}</bsdf>', 'has a number for "opacity"'),
    ],
)  # fmt: skip
def test_materials_that_stay(mi_rgb, maps, material, reason):
    folder, fits = maps
    scene = parsed(folder, f'<shape type="sphere">{material}</shape>')
    (one,) = conversion.replace_stock(scene, ["material"], folder / "tables", progress=False)
    assert one.learned == "" and reason in one.reason and not fits


def test_equal_images_are_fitted_once(mi_rgb, maps):
    """Two names of one content share a table; a failed fit is told for both."""
    folder, fits = maps
    (folder / "copy.png").write_bytes((folder / "image.png").read_bytes())
    scene = parsed(folder, textured("a", "image.png") + textured("b", "copy.png"))
    a, b = conversion.replace_stock(scene, ["bitmap"], folder / "tables", progress=False)
    assert len(fits) == 1 and a.reason == b.reason and a.learned == b.learned == "neural_texture"
    assert len(list((folder / "tables").glob("*.json"))) == 1


def test_a_bump_map_stays_around_its_material(mi_rgb, maps):
    """Its slope depends on the shape, which no file of a material knows."""
    folder, _ = maps
    bump = f'<bsdf type="bumpmap" id="hide">{image("rough", "arbitrary")}{paint()}</bsdf>'
    parsed(folder, f'<shape type="sphere">{bump}</shape>')
    conversions = conversion.convert(folder / "scene.xml", folder / "new.xml", check=False, progress=False)
    assert [(c.stock, c.learned) for c in conversions] == [
        ("bitmap", "neural_texture"), ("principled", "neural_material")
    ]  # fmt: skip
    assert loading.load(folder / "new.xml").shapes() and "bumpmap" in (folder / "new.xml").read_text()


def test_what_ended_before_ctrl_c_is_kept(mi_rgb, maps, monkeypatch, capsys):
    """The same command then fits the others alone."""
    folder, fits = maps
    parsed(folder, textured("a", "image.png") + textured("b", "bumps.png"))
    fit, arguments = conversion.fit, (folder / "scene.xml", folder / "new.xml")

    def interrupted(task, **options):
        if fits:
            raise KeyboardInterrupt
        return fit(task, **options)

    monkeypatch.setattr(conversion, "fit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        conversion.convert(*arguments, check=False)
    assert "kept 1 of 2 fits in" in capsys.readouterr().err and not (folder / "new.xml").exists()
    monkeypatch.setattr(conversion, "fit", fit)
    assert len(conversion.convert(*arguments, check=False, progress=False)) == 2 and len(fits) == 2


#: A scene by other people, beside the checkout; it does not ship.
MODERN_HALL = Path(os.environ.get("MI_DIFFIND_DATA", Path(__file__).parents[2] / "shared/data")) / "scenes/modern_hall"


@pytest.mark.skipif(not MODERN_HALL.is_dir(), reason="the scene Modern Hall is not on this machine")
def test_modern_hall(mi_rgb, folder):
    """A scene as people have it: 32 shapes, 8 materials, 3 images; converted, compared and checked for regressions."""
    folder, fits = folder
    new, defines = folder / "new.xml", {"resx": 32, "resy": 32, "spp": 4, "integrator": "path", "max_depth": 3}
    result = conversion.convert(MODERN_HALL / "scene.xml", new, defines=defines, progress=False)
    assert {(c.stock, c.learned, c.name) for c in result} == {
        ("bitmap", "neural_texture", "WoodBSDF"), ("bitmap", "neural_texture", "WallpaperBSDF"),
        ("twosided", "neural_material", "FloorTilesBSDF"),
    }  # fmt: skip
    assert len(fits) == 3 and result.disk_bytes and 2 * result.image_bytes[1] < result.image_bytes[0]
    assert result.check is not None and result.check.difference < 0.1
    compared = comparison.compare(new, 4, progress=False)
    assert compared.figures["learned_plugins"] == 3 and compared.figures["brightness"] == pytest.approx(1, abs=0.1)
    assert main(["regress", str(new), "--update", "--references", str(folder / "references")]) == 0
    assert main(["regress", str(new), "--references", str(folder / "references")]) == 0


def test_small_and_noisy_images_stay(mi_rgb, folder):
    """Images of less than 4 kB without a fit, and one of noise that the fit would blur, whose PSNR is said."""
    folder, fits = folder
    rng = np.random.default_rng(1)
    sizes = {f"small{i}": size for i, size in enumerate([(1, 1, 3), (1, 64, 4), (7, 3, 1), (36, 37, 3), (63, 64, 1)])}
    for name, size in [*sizes.items(), ("noise", (64, 64, 3))]:
        mi_rgb.Bitmap(rng.integers(0, 256, size).astype(np.uint8)).write(str(folder / f"{name}.png"))
    scene = parsed(folder, "".join(textured(f"m{name}", f"{name}.png") for name in [*sizes, "noise"]))
    *small, noise = conversion.replace_stock(scene, ["bitmap"], folder / "tables", progress=False)
    for (name, size), one in zip(sizes.items(), small, strict=True):
        assert str(one) == f'bitmap "m{name}": {name}.png has {np.prod(size):,} bytes, of which no fit would save any'
    expected = r"noise\.png would have 1\d\.\d dB, at least 25 are needed: fit it by hand, with more bytes"
    assert len(fits) == 1 and noise.learned == "" and re.fullmatch(expected, noise.reason)
    (again,) = [c for c in conversion.replace_stock(scene, ["bitmap"], folder / "tables") if c.name == "mnoise"]
    assert again == noise and len(fits) == 1


@pytest.mark.parametrize("wound", ["outwards", "inwards", "a tenth inwards"])
def test_windings_and_mirrorings(mi_rgb, tmp_path, wound):
    """A mesh is kept if the normals that Mitsuba gives to its hits face inwards; rooms would come out black."""
    mi, ball = mi_rgb, trimesh.creation.icosphere(3)
    turned = {"outwards": 0, "inwards": len(ball.faces), "a tenth inwards": len(ball.faces) // 10}[wound]
    ball.faces[:turned] = ball.faces[:turned, ::-1]
    ball.export(tmp_path / "ball.ply")
    transform = mi.ScalarTransform4f
    for placed in (transform(), transform().rotate([1, 2, 3], 50).scale(3), transform().scale([-1, 1, 1])):
        for flipped in (False, True):
            props = mi.Properties("ply")
            props["filename"], props["to_world"] = str(tmp_path / "ball.ply"), placed
            props["flip_normals"], props["face_normals"] = flipped, True
            shape = mi.load_dict({"type": "ply", **{key: props[key] for key in props}})
            points = mi.Point2f(*np.random.default_rng(0).random((2, 999)))
            rays = mi.Ray3f(mi.Point3f(0), mi.warp.square_to_uniform_sphere(points))
            si = mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(rays)
            inwards = np.mean(np.sum(np.array(si.n) * np.array(si.p), axis=0) < 0)
            if inwards < 0.005:
                distance_shapes.check_normals(props, tmp_path / "ball.ply")
                continue
            with pytest.raises(Kept, match="is wound inside out") as kept:
                distance_shapes.check_normals(props, tmp_path / "ball.ply")
            assert abs(int(re.search(r"(\d+)%", str(kept.value))[1]) / 100 - inwards) < 0.03


def test_shading_normals(mi_rgb, tmp_path):
    """Smooth normals, of the file or Mitsuba's, are far from those of the triangles unless ``face_normals`` is true."""
    mi = mi_rgb
    box, ball = trimesh.creation.box(), trimesh.creation.icosphere(1)
    box.export(tmp_path / "box.ply")
    ball.export(tmp_path / "ball.obj", include_normals=True)
    trimesh.creation.icosphere(3).export(tmp_path / "fine.ply")
    box.unmerge_vertices()
    box.export(tmp_path / "flat.ply")
    for name, angle in (("box.ply", 39), ("ball.obj", 10), ("fine.ply", None), ("flat.ply", None)):
        props = mi.Properties(name[-3:])
        props["filename"] = str(tmp_path / name)
        if angle is not None:
            with pytest.raises(Kept, match=f"has shading normals {angle}° from those of its triangles"):
                distance_shapes.check_normals(props, tmp_path / name)
            props["face_normals"] = True
        lost = distance_shapes.check_normals(props, tmp_path / name)
        assert lost == pytest.approx(2.54 if name == "fine.ply" else 0, abs=0.02)


def test_misspelt_groups_and_parameters_stay_errors(mi_rgb, folder):
    """Conversion reads the properties of the scene, which must not make them known to a plugin."""
    scene = parsed(folder[0], principled("a", rougness=0.9) + '<shape type="sphere"><ref id="a"/></shape>')
    with pytest.raises(UsageError, match='found "glass", allowed are disney, material, mesh, bitmap'):
        conversion.replace_stock(scene, ["glass"], folder[0])
    (one,) = conversion.replace_stock(scene, ["disney"], folder[0])
    assert one.reason == 'has the parameter "rougness", which the learned plugin lacks'
    with pytest.raises(loading.SceneError, match="rougness"):
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
    for index, (vertices, faces) in enumerate(read_serialized(path)):
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
    _, written = distance_shapes._as_ply(tmp_path / "scene.xml#box", (0,))
    assert load_mesh(written).digest == load_mesh(f"{path}#box").digest
