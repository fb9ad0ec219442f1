"""The package as Python sees it: training from memory, opening, loading, attaching and saving."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import mi_diffind
from mi_diffind import studies
from mi_diffind.core.errors import UsageError
from mi_diffind.maps.source import load_source
from mi_diffind.measure.study import Tradeoff
from mi_diffind.scenes import rendering
from mi_diffind.scenes.loading import ParsedScene

ASSETS = Path(__file__).resolve().parents[1] / "scenes" / "assets"
TILES = ASSETS / "tiles_filtered.npz"


@pytest.fixture(scope="module")
def picture():
    """8 bits, ``(24, 32, 3)``."""
    y, x = np.mgrid[0:24, 0:32] / 32
    return np.rint(255 * np.stack([0.5 + 0.4 * np.sin(9 * x), 0.5 + 0.4 * np.cos(7 * y), x * y], -1)).astype(np.uint8)


def same(a, b):
    assert a.arrays.keys() == b.arrays.keys()
    for name, array in a.arrays.items():
        np.testing.assert_array_equal(array.entries, b.arrays[name].entries)


def test_maps_from_memory_are_those_of_files(mi_rgb, picture, tmp_path):
    """An array, a bitmap and a tensor are the PNG file that holds the same bytes, and give its tables."""
    mi = mi_rgb
    mi.Bitmap(picture).write(str(tmp_path / "a.png"))
    expected = load_source(tmp_path / "a.png")
    for source in (picture, mi.Bitmap(picture), {"image": tmp_path / "a.png"}, {"image": picture}):
        assert load_source(source).digest == expected.digest
    linear = picture.astype(np.float32) / 255
    assert load_source(mi.TensorXf(linear)).digest == load_source(linear).digest != expected.digest
    assert (load_source(linear).maps[0].color_space, expected.maps[0].color_space) == ("linear", "srgb")
    options = {"compression": 3, "steps": 2, "batch": 512, "progress": False}
    sources = tmp_path / "a.png", picture
    same(*(mi_diffind.fit("image", source, **options).table for source in sources))


def test_a_bitmap_keeps_its_alpha_and_its_colour_space(mi_rgb, picture):
    mi = mi_rgb
    transparent = np.concatenate([picture, picture[..., :1]], axis=-1)
    maps = load_source(mi.Bitmap(transparent)).maps
    assert [(m.name, m.channels, m.color_space) for m in maps] == [("image", 3, "srgb"), ("alpha", 1, "linear")]
    bitmap = mi.Bitmap(picture)
    bitmap.set_srgb_gamma(False)
    assert load_source({"albedo": bitmap}).maps[0].color_space == "linear"
    assert load_source({"albedo": mi.Bitmap(picture), "normal": picture}).maps[1].color_space == "linear"
    source = mi_diffind.from_arrays({"albedo": picture}, {"albedo": "linear"})
    assert load_source(source) is source and source.maps[0].color_space == "linear"


def test_a_result_measures_saves_and_opens(mi_rgb, picture, tmp_path, monkeypatch):
    """``fit`` → ``save`` → ``open``: the same errors; paths in the file follow it into its folder."""
    mi = mi_rgb
    monkeypatch.chdir(tmp_path)
    mi.Bitmap(picture).write("a.png")
    fitted = mi_diffind.fit("image", "a.png", compression="3x", steps=2, batch=512, progress=False)
    (tmp_path / "elsewhere").mkdir()
    path = fitted.save("elsewhere/a.npz")
    model = mi_diffind.open(path)
    assert model.nbytes == fitted.table.nbytes == fitted.report["bytes"]
    assert model.measure() == fitted.model.measure() == model.measure(picture)
    assert model.measure()["psnr_db"] == pytest.approx(fitted.report["measured"]["psnr_db"], abs=0.01)
    assert fitted.history == fitted.report["history"] and fitted.history[-1]["step"] == 2
    text = "\n".join(fitted.summary(path))
    assert '<texture type="neural_image">' in text and '"filename" value="a.npz"' in text and " dB" in text
    assert "neural_image" in fitted._repr_html_()
    with pytest.raises(mi_diffind.TableError, match=r"no source file is recorded, so errors need a source"):
        mi_diffind.fit("image", picture, compression=3, steps=1, batch=512, progress=False).model.measure()
    decoded = model.decode(tmp_path / "back.png")
    assert [file.name for file, _ in decoded] == ["back.png"]
    with pytest.raises(UsageError, match=r'output "a.exr": found the extension ".exr", allowed is .npz'):
        fitted.save("a.exr")


def test_meshes_from_memory(mi_rgb, tmp_path):
    """A ``trimesh.Trimesh``, a ``mi.Mesh`` and a pair of arrays are the mesh of the file that holds them."""
    from mi_diffind.tasks.sdf.mesh import MeshError, load_mesh

    mi = mi_rgb
    ball = trimesh.creation.icosphere(1)
    ball.vertices = np.float32(ball.vertices)  # as Mitsuba keeps them
    ball.export(tmp_path / "ball.ply")
    shape = mi.Mesh("ball", len(ball.vertices), len(ball.faces))
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(np.float32(ball.vertices))
    parameters["faces"] = np.ravel(np.uint32(ball.faces))
    parameters.update()
    digests = [load_mesh(m).digest for m in (ball, trimesh.Scene(ball), shape, (ball.vertices, ball.faces))]
    assert set(digests) == {load_mesh(tmp_path / "ball.ply").digest}
    with pytest.raises(MeshError, match=r"mesh: found a int, expected a file, a trimesh.Trimesh or a mi.Mesh"):
        load_mesh(3)


WRONG = {
    "source": (("ggx", 3), {}, "ggx: found a source, but this task has none"),
    "number": (("image", "a.png"), {"compression": "many"}, "compression: 'many' is not a compression ratio"),
    "choice": (("image", "a.png"), {"border": "mirror"}, "border: found 'mirror', allowed are auto, repeat, clamp"),
    "range": (("image", "a.png"), {"dims": 9}, "dims: found 9, allowed are 1, 2, 3, 4"),
    "whole": (("texture", "a.png"), {"skip": -1}, "skip: -1 is not a whole number"),
    "output": (("image", "a.png"), {"output": "a.png"}, 'output "a.png": found the extension ".png"'),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_arguments(mi_rgb, case):
    arguments, options, sentence = WRONG[case]
    with pytest.raises(UsageError, match=sentence):
        mi_diffind.fit(*arguments, **options)


def wall(mi, texture):
    """A wall that runs into the distance, in constant light."""
    away = mi.ScalarTransform4f().rotate([1, 0, 0], -80).scale(8)
    return {
        "type": "scene", "integrator": {"type": "direct"}, "light": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 1, 6], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 24, "height": 16}},
        "wall": {"type": "rectangle", "to_world": away, "bsdf": {"type": "diffuse", "reflectance": texture}},
    }  # fmt: skip


def texture(**parameters):
    return {"type": "neural_texture", "filename": str(TILES), "channels": "albedo"} | parameters


def small(mi):
    """Tiles that are smaller than pixels."""
    return texture(to_uv=mi.ScalarTransform3f().scale(8))


def image(mi, scene):
    return mi.render(scene, spp=16, seed=3).numpy()


def test_loads_tell_textures_their_sensor(mi_rgb):
    """A dictionary, and a scene that Mitsuba loaded: the same filtered picture; without it, another."""
    mi = mi_rgb
    scene = wall(mi, small(mi))
    expected = image(mi, mi_diffind.load_dict(scene))
    assert np.abs(image(mi, mi.load_dict(scene)) - expected).mean() > 0.01
    np.testing.assert_allclose(image(mi, mi_diffind.attach(mi.load_dict(scene))), expected, atol=1e-5)


def test_a_sensor_that_is_not_there(mi_rgb):
    scene = mi_rgb.load_dict(wall(mi_rgb, texture()))
    with pytest.raises(mi_diffind.DiffindError, match="sensor: found 2, the scene has 1"):
        mi_diffind.attach(scene, sensor=2)


def optimised(mi, scene, factor=0.97):
    """The parameters of a scene whose tables were changed, as an optimisation would."""
    parameters = mi.traverse(scene)
    tables = [key for key in parameters.keys() if "tables." in key]
    assert tables
    for key in tables:
        parameters[key] = parameters[key] * factor
    parameters.update()
    return parameters


PLUGINS = {
    "neural_texture": lambda: texture(storage="float32"),
    "neural_image": lambda: texture(storage="float32", type="neural_image", filename=str(ASSETS / "tiles.npz")),
    "neural_disney": lambda: {"type": "neural_disney", "storage": "float32"},
    "neural_ggx": lambda: {"type": "neural_ggx", "storage": "float32", "alpha": 0.3},
    "neural_material": lambda: {
        "type": "neural_material", "storage": "float32", "filename": str(ASSETS / "tiles_filtered.npz"),
    },
}  # fmt: skip


@pytest.mark.parametrize("name", PLUGINS)
def test_optimised_tables_render_as_before_when_saved(mi_rgb, tmp_path, name):
    """The picture of the saved file is that of the optimised plugin, not that of the file that it began with."""
    mi = mi_rgb

    def scene(**changes):
        content, plugin = wall(mi, {"type": "rgb", "value": 0.5}), {**PLUGINS[name](), **changes}
        is_texture = name in ("neural_texture", "neural_image")
        content["wall"]["bsdf"] = {"type": "diffuse", "reflectance": plugin} if is_texture else plugin
        return mi_diffind.load_dict(content)

    before, loaded = image(mi, scene()), scene()
    parameters = optimised(mi, loaded)
    expected = image(mi, loaded)
    assert np.abs(expected - before).mean() > 1e-3
    path = tmp_path / "saved.npz"
    saved = mi_diffind.save(parameters, path, "float32")
    assert saved.path == path and "float32" in saved.storage and max(saved.rms.values()) < 1e-6
    np.testing.assert_allclose(image(mi, scene(filename=str(path))), expected, atol=2e-4)
    packed = mi_diffind.save(loaded, path, "uint8")
    assert packed.storage == "uint8" and packed.nbytes < saved.nbytes and 0 < max(packed.rms.values()) < 0.05
    error = np.abs(image(mi, scene(filename=str(path))) - expected).mean()
    assert error < 0.3 * np.abs(expected - before).mean()
    assert f"{path}: {packed.nbytes:,} bytes as uint8; RMS error against float32: " in str(packed)
    table = mi_diffind.load_table(path)
    assert table.settings["optimised"] and not table.measured


def test_the_bits_of_a_file_are_kept(mi_rgb, tmp_path):
    scene = mi_diffind.load_dict(wall(mi_rgb, texture(storage="float32")))
    saved = mi_diffind.save(scene, tmp_path / "saved.npz")
    assert saved.nbytes == mi_diffind.load_table(TILES).nbytes
    same(mi_diffind.load_table(saved.path), mi_diffind.load_table(TILES))  # nothing was changed


def test_a_distance_field_is_encoded_again(mi_rgb, tmp_path):
    """A solid whose nodes move inward by a fifth of a cell is thinner by as much, within the surface's cells."""
    mi, knot = mi_rgb, ASSETS / "knot.npz"
    parameters = mi.traverse(mi.load_dict({"type": "neural_sdf", "filename": str(knot), "storage": "float32"}))
    nodes = parameters["tables.nodes"].numpy().copy()  # Dr.Jit frees the memory of a view when it is assigned to
    nodes[:, 0] += 0.2
    parameters["tables.nodes"] = mi.TensorXf(nodes)
    parameters.update()
    saved = mi_diffind.save(parameters, tmp_path / "thinner.npz")
    before, after = (mi_diffind.open(path).field for path in (knot, saved.path))
    corners = np.array([before.lower, before.upper])
    points = np.random.default_rng(0).uniform(*corners, size=(200_000, 3)).astype(np.float32)
    values = [field.value(mi.Point3f(points.T)).numpy() / before.spacing for field in (before, after)]
    near = (np.abs(values) < 0.3).all(axis=0)
    assert near.sum() > 500 and np.median((values[1] - values[0])[near]) == pytest.approx(0.2, abs=0.03)
    with pytest.raises(UsageError, match='storage: found "float16", allowed is uint8'):
        mi_diffind.save(parameters, tmp_path / "thinner.npz", "float16")


def test_nothing_to_save(mi_rgb, tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(UsageError, match='found no tables that can be optimised; give the plugin storage="float32"'):
        mi_diffind.save(mi_diffind.load_dict(wall(mi_rgb, texture())), path)
    content = wall(mi_rgb, texture(storage="float32"))
    content["other"] = {"type": "sphere", "bsdf": {"type": "neural_disney", "storage": "float32"}}
    scene = mi_diffind.load_dict(content)
    with pytest.raises(UsageError, match=r"found the tables of several files .*: name one of them by file"):
        mi_diffind.save(scene, path)
    assert mi_diffind.save(scene, path, file=TILES.name).nbytes == mi_diffind.load_table(TILES).nbytes
    assert not path.with_suffix(".xml").exists()


def test_a_rendering_is_that_of_mitsuba(mi_rgb, tmp_path):
    """A dictionary and a loaded scene give Mitsuba's image; ``save`` and the picture of a notebook show it."""
    mi = mi_rgb
    content = wall(mi, small(mi))
    loaded = mi_diffind.load_dict(content)
    expected = image(mi, loaded)
    for scene in (content, loaded):
        rendering = mi_diffind.render(scene, spp=16, seed=3, progress=False)
        assert rendering.image.mean() == pytest.approx(expected.mean(), abs=0.02)
        figures = rendering.figures
        assert (figures["spp"], figures["width"], rendering.frames[0].shape) == (16, 24, (16, 24, 3))
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(rendering.save(tmp_path / "a.exr")))), rendering.image)
    assert rendering._repr_png_().startswith(b"\x89PNG")
    frames = mi_diffind.render(loaded, spp=1, orbit=3, progress=False)
    assert len(frames.frames) == 3 and frames.image.shape == (16, 72, 3) and frames.figures["frames"] == 3


def test_refused_renderings(mi_rgb, tmp_path):
    scene = mi_diffind.load_dict(wall(mi_rgb, texture()))
    for options, sentence in (
        ({"centre": (0, 0, 0)}, "centre: given without orbit"),
        ({"depth": 3}, "learn, depth, defines: given with a scene in memory"),
        ({"depth_tolerance": 0.1}, "depth_tolerance: given without depth"),
    ):
        with pytest.raises(UsageError, match=sentence):
            mi_diffind.render(scene, **options)
    with pytest.raises(UsageError, match=r"scene: found a .*, expected a scene, its file or its dictionary"):
        mi_diffind.render({"type": "sphere"})
    with pytest.raises(mi_diffind.DiffindError, match="found a table file, a scene is needed"):
        mi_diffind.render(TILES)
    with pytest.raises(UsageError, match=r'output "a.webp": found the extension ".webp", allowed are .exr and .png'):
        mi_diffind.render(scene, spp=1, progress=False).save("a.webp")


def ball(light=1.0) -> dict:
    """Return a scene of plain values as a dictionary."""
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    return {
        "type": "scene", "integrator": {"type": "path"}, "sensor": {"type": "perspective", "film": film},
        "sky": {"type": "constant", "radiance": {"type": "spectrum", "value": light}},
        "ball": {"type": "sphere", "center": [0, 0, 4], "material": {"type": "diffuse"}},
    }  # fmt: skip


def test_scenes_in_memory_that_hold_existing_objects_are_known_once(mi_rgb):
    """The content of a bitmap is in no description; two dictionaries of plain values have equal ones."""
    assert ParsedScene(ball()).description == ParsedScene(ball()).description != ParsedScene(ball(2)).description
    scene = ball() | {"other": mi_rgb.load_dict({"type": "sphere"})}
    assert ParsedScene(scene).description != ParsedScene(scene).description


def test_keywords_of_a_study(monkeypatch, tmp_path, mi_rgb):
    """They become the arguments of the command, checked by its parser; the result shows its picture."""
    asked = []

    class Recorded(type(studies.studies()["image"])):
        def run(self, arguments):
            asked.append(arguments)
            (out / "a.png").write_bytes(b"\x89PNG")
            return Tradeoff({"quick": arguments.quick}, ["a line"], {"png": str(out / "a.png"), "csv": "a.csv"})

    monkeypatch.setattr(studies, "studies", lambda: {"image": Recorded()})
    source, out = tmp_path / "a.png", tmp_path / "out"
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(source)
    result = mi_diffind.tradeoff("image", source, out=out, quick=True, compression=["6x", "12x"])
    assert (asked[0].compression, asked[0].source) == (["6x", "12x"], str(source))
    assert result.figures == {"quick": True} and result.pictures == {"png": str(out / "a.png")}
    assert result._repr_png_() == b"\x89PNG" and str(result).startswith("a line\n")
    with pytest.raises(UsageError, match="tradeoff image: unrecognized arguments: --ratio=6"):
        mi_diffind.tradeoff("image", source, out=out, ratio=6)
    with pytest.raises(UsageError, match='found the study "nerf", allowed are image'):
        mi_diffind.tradeoff("nerf")


def test_an_image_that_a_file_cannot_hold_is_not_rendered(mi_rgb, tmp_path, monkeypatch):
    """The channels that are predicted are those of the render, for each format of the film."""
    mi = mi_rgb
    path = {"type": "path"}
    integrators = path, {"type": "aov", "aovs": "d:depth,n:sh_normal", "image": path}, {"type": "moment", "image": path}
    for integrator, pixel_format in itertools.product(integrators, ("rgb", "rgba", "luminance")):
        film = {"type": "hdrfilm", "width": 4, "height": 4, "pixel_format": pixel_format}
        content = wall(mi, {"type": "rgb", "value": 0.5}) | {"integrator": integrator}
        loaded = mi.load_dict(content | {"sensor": {"type": "perspective", "film": film}})
        assert rendering.channel_count(loaded) == mi.render(loaded, spp=1).shape[2], (integrator, pixel_format)
    monkeypatch.setattr(rendering.loading, "render", None)  # not reached
    with pytest.raises(UsageError, match=r"the image has 7 channels, PNG holds 4: use .exr"):
        mi_diffind.render(loaded, spp=1, output="a.png", progress=False)
