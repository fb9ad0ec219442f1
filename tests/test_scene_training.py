"""Training inside a scene: views, references, arrays as parameters, gradients, and what comes out."""

import argparse
import dataclasses
import gc
import re

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from shading_scenes import fitted, material, scene_file
from variants import warnings_of

import mi_diffind
from mi_diffind.arrays.tables import TableError, load_table, save_table
from mi_diffind.core.arguments import add_arguments
from mi_diffind.core.compat import use_threads, was_compiled
from mi_diffind.core.errors import UsageError
from mi_diffind.core.progress import Deadline
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest, FitResult, FitSettings
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import load_source
from mi_diffind.plugins.support import footprint
from mi_diffind.scenes import loading
from mi_diffind.scenes.training import references
from mi_diffind.scenes.training.fit import fit_scene, joint_problem, limit, score_lines
from mi_diffind.scenes.training.options import (
    FOOTPRINTS,
    SCENE_ARGUMENTS,
    SceneRecipe,
    View,
    ViewDistribution,
    recipe_from,
    views_from,
)
from mi_diffind.scenes.training.problem import SceneProblem, estimate_exposure
from mi_diffind.scenes.training.references import ReferenceRenders
from mi_diffind.scenes.training.rig import Rig, small_ranges
from mi_diffind.scenes.training.trained_scene import (
    SceneTexture,
    TrainedScene,
    load_textures,
    texture_budget,
    texture_file,
    texture_files,
    texture_recipe,
)
from mi_diffind.tasks.texture import PRESETS
from mi_diffind.tasks.texture.arrays import PaperBudget, TextureBudget, parse_structure
from mi_diffind.tasks.texture.compressed import CompressedTexture, load, to_table
from mi_diffind.tasks.texture.training import build_problem, rounded, source_layout, stored_form

ORBIT = ViewDistribution(
    3, 1, azimuth=(-60, 60), elevation=(30, 60), light_azimuth=(-90, 90), light_elevation=(40, 80), up=(0, 0, 1)
)


@pytest.fixture(scope="module", autouse=True)
def one_core():
    """Sums that repeat, and kernels that do not wait for each other."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    before = dr.thread_count()
    use_threads(1)
    yield
    use_threads(before)


@pytest.fixture(scope="module")
def folder(one_core, tmp_path_factory):
    """A material, its table, and a scene of both."""
    found = tmp_path_factory.mktemp("scene")
    scene_file(fitted(material(found)))
    return found


@pytest.fixture(scope="module")
def path(folder):
    return folder / "material_directional.xml"


@pytest.fixture(scope="module")
def trained(folder, path):
    """The scene with its arrays as parameters, and the problem of the texture."""
    parsed = loading.ParsedScene(path)
    file, _ = texture_file(parsed)
    table = load(file)
    problem = SceneTexture(file, table).problem
    scene = TrainedScene(parsed, {file: table}, ORBIT)
    return scene, problem


def test_views_lie_in_their_ranges_and_repeat():
    views = dataclasses.replace(ORBIT, count=200, distance=(2, 3))
    drawn = views.trained()
    for name in ("azimuth", "elevation", "distance", "light_azimuth", "light_elevation"):
        low, high = getattr(views, name)
        found = np.array([getattr(view, name) for view in drawn])
        assert low <= found.min() < low + 0.03 * (high - low) and high - 0.03 * (high - low) < found.max() <= high
        # Low discrepancy: the mean of 200 independent numbers is off by 0.02, in one case of three by more
        assert abs(found.mean() - (low + high) / 2) < 8e-3 * (high - low)
    assert all(view.origin is None for view in drawn)
    assert dataclasses.replace(views, count=5).trained() == drawn[:5] == views.trained()[:5]
    assert not set(drawn) & set(dataclasses.replace(views, held_out=200).measured())
    assert not set(drawn) & set(dataclasses.replace(views, seed=1).trained())


def test_views_without_ranges_and_in_a_box():
    assert ViewDistribution().trained() == ViewDistribution().measured() == [View()] and not ViewDistribution().moves
    boxed = ViewDistribution(50, origins=((-1, 2, 3), (1, 2, 5))).trained()
    origins = np.array([view.origin for view in boxed])
    assert (origins >= [-1, 2, 3]).all() and (origins <= [1, 2, 5]).all() and np.ptp(origins, axis=0)[2] > 1.8
    assert boxed[0].azimuth is None


@pytest.mark.parametrize(
    ("options", "change", "match"),
    [
        (ViewDistribution, {"count": 0}, "count of the views: found 0"),
        (ViewDistribution, {"elevation": (10, 95)}, r"elevation: found 10 to 95"),
        (ViewDistribution, {"azimuth": (5, -5)}, "azimuth: found 5 to -5"),
        (ViewDistribution, {"distance": (0, 1)}, "distance: found 0 to 1"),
        (ViewDistribution, {"origins": ((0, 0, 0), (1, 1, 1)), "azimuth": (0, 1)}, "origins"),
        (ViewDistribution, {"up": (0, 0, 0)}, "up: found 0"),
        (SceneRecipe, {"share": 1.5}, "share: found 1.5"), (SceneRecipe, {"spp": 0}, "spp: found 0"),
        (SceneRecipe, {"samples": 0}, "samples: found 0"), (SceneRecipe, {"bound": -1.0}, "bound: found -1"),
        (SceneRecipe, {"start": "there"}, 'start: found "there"'),
        (SceneRecipe, {"exposure": float("nan")}, "exposure: found nan"),
    ],
)  # fmt: skip
def test_bad_options(options, change, match):
    with pytest.raises(UsageError, match=match):
        options(**change)


def parsed(*words):
    parser = argparse.ArgumentParser()
    add_arguments(parser, SCENE_ARGUMENTS)
    return vars(parser.parse_args(words))


def test_arguments():
    assert views_from(parsed()) == ViewDistribution() and recipe_from(parsed(), FitSettings()).bound == 1
    found = parsed(
        "--views", "3", "--azimuth=-30:30", "--elevation", "40", "--target=-1,0,2.5", "--light-elevation", "10:80",
        "--bound", "none", "--spp", "4", "--begin", "untrained",
    )  # fmt: skip
    expected = ViewDistribution(
        3, azimuth=(-30, 30), elevation=(40, 40), target=(-1, 0, 2.5), light_elevation=(10, 80), seed=7
    )
    assert views_from(found, 7) == expected
    recipe = recipe_from({**found, "share": 0.5}, FitSettings(steps=9))
    assert recipe == SceneRecipe(0.5, 4, None, start="untrained", settings=FitSettings(steps=9))
    assert views_from(parsed("--origins", "0,0,0:1,1,1")).origins == ((0, 0, 0), (1, 1, 1))


LIGHTS = {
    "sun": {"type": "directional", "direction": [0.3, 0.5, -1]},
    "lamp": {"type": "point", "position": [1, 0, 1]},
    "sky": {"type": "envmap", "bitmap": None},
    "shape": {"type": "rectangle", "emitter": {"type": "area"}},
    "ambient": {"type": "constant"},
    "noon": {"type": "sunsky", "hour": 12.0},
}


def lit(*names, sensor=None):
    lights = {name: dict(LIGHTS[name]) for name in names}
    if "sky" in lights:
        lights["sky"]["bitmap"] = mi.Bitmap(np.ones((4, 8, 3), np.float32))
    look = mi.ScalarTransform4f().look_at([0, -2, 2], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    return mi.load_dict({
        "type": "scene", **lights, "sensor": sensor or {"type": "perspective", "to_world": look, "film": film},
    })  # fmt: skip


def matrix(node):
    return np.array(mi.traverse(node)["to_world"].matrix, np.float64).reshape(4, 4)


def emitters(scene):
    found = {"Directional": "sun", "Point": "lamp", "Environment": "sky", "Area": "shape"}
    return {found[next(k for k in found if e.class_name().startswith(k))]: e for e in scene.emitters()}


def test_camera_and_lights_are_where_a_view_has_them():
    """Against ``look_at`` and rotations of Mitsuba's own."""
    scene = lit("sun", "lamp", "sky", "shape")
    target = (0.5, 0, 0)
    ranges = {"azimuth": (0, 1), "elevation": (0, 1), "distance": (1, 2), "light_azimuth": (0, 1)}
    rig = Rig(scene, ViewDistribution(target=target, up=(0, 0, 1), light_elevation=(0, 1), **ranges))
    before = {name: matrix(e) for name, e in emitters(scene).items() if name in ("sun", "sky")}
    angle = np.arctan2(-2, -0.5) + np.radians(30)
    origin = target + 3 * np.array([np.cos(0.7) * np.cos(angle), np.cos(0.7) * np.sin(angle), np.sin(0.7)])
    for _ in range(2):  # from where the scene has them, not from where they were last
        rig.place(View(30, np.degrees(0.7), 3, None, 50, 20))
        sensor, lights = scene.sensors()[0], emitters(scene)
        assert np.array(sensor.world_transform().translation()).ravel() == pytest.approx(origin, abs=1e-5)
        # It looked past the target before: the angle between both stays
        t = mi.ScalarTransform4f()
        old, new = (np.array(t.look_at(list(o), list(target), [0, 0, 1]).matrix) for o in ([0, -2, 2], origin))
        look = np.array(t.look_at([0, -2, 2], [0, 0, 0], [0, 0, 1]).matrix)
        np.testing.assert_allclose(matrix(sensor), new @ np.linalg.inv(old) @ look, atol=1e-5)
        sun = -matrix(lights["sun"])[:3, 2]
        turned = np.arctan2(-0.5, -0.3) + np.radians(50)
        np.testing.assert_allclose(np.arcsin(sun[2]), np.radians(20), atol=1e-5)
        np.testing.assert_allclose(np.exp(1j * np.arctan2(sun[1], sun[0])), np.exp(1j * turned), atol=1e-5)
        np.testing.assert_allclose(np.linalg.det(matrix(lights["sun"])[:3, :3]), 1, atol=1e-5)
        lamp = np.array(mi.traverse(lights["lamp"])["position"]).ravel() - target
        np.testing.assert_allclose(np.linalg.norm(lamp), np.sqrt(1.25), rtol=1e-5)
        np.testing.assert_allclose(lamp[2] / np.linalg.norm(lamp), np.sin(np.radians(20)), atol=1e-5)
        rotation = np.array(t.rotate([0, 0, 1], 50).matrix)[:3, :3]
        np.testing.assert_allclose(matrix(lights["sky"])[:3, :3], rotation @ before["sky"][:3, :3], atol=1e-5)
    rig.place(View())
    np.testing.assert_allclose(matrix(scene.sensors()[0]), look, atol=1e-5)
    np.testing.assert_allclose(matrix(emitters(scene)["sun"])[:3, 2], before["sun"][:3, 2], atol=1e-5)
    # A camera in a box looks at the target
    Rig(scene, ViewDistribution(origins=((0, 0, 0), (1, 1, 1)), target=(0, 0, 0))).place(View(origin=(3, 4, 5)))
    expected = np.array(t.look_at([3, 4, 5], [0, 0, 0], [0, 1, 0]).matrix)
    np.testing.assert_allclose(matrix(scene.sensors()[0])[:3, 2:], expected[:3, 2:], atol=1e-5)


@pytest.fixture
def tilted(tmp_path):
    """A mesh whose normals are not those of its faces, in a file."""
    vertices, normals = np.float32([[0, 0, 0], [0, 1, 0], [1, 0, 0]]), np.float32([[0.6, 0, -0.8]] * 3)
    mesh = mi.Mesh("tilted", 3, 1, has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.ravel(), [0, 1, 2]
    parameters["vertex_normals"] = normals.ravel()
    mesh.write_ply(str(tmp_path / "tilted.ply"))
    return str(tmp_path / "tilted.ply")


def test_area_lights_are_where_a_view_has_them(tilted):
    """Images equal those of a scene that is written so, by Mitsuba's own rotations; no kernel depends on the place."""
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "to_world": t().look_at([0, -4, 4], [0, 0, 0], [0, 0, 1]), "film": film}
    lights = {
        "rectangle": ({"type": "rectangle"}, t().translate([1, 1, 1]).rotate([1, 0, 0], 180).scale(0.3)),
        "sphere": ({"type": "sphere"}, t().translate([-1, 1, 1]).scale(0.2)),
        "mesh": ({"type": "ply", "filename": tilted}, t().translate([-1.5, -1.5, 1])),
    }

    def scene(places):
        glow = {"type": "area", "radiance": {"type": "rgb", "value": 9}}
        content = {name: {**lights[name][0], "to_world": place, "emitter": glow} for name, place in places.items()}
        content |= {"floor": {"type": "rectangle", "to_world": t().scale(3)}, "sensor": sensor}
        return mi.load_dict({"type": "scene", "integrator": {"type": "direct"}, **content}, parallel=False)

    def image(scene):
        return mi.render(scene, spp=16, seed=opaque(3)).numpy()

    moved = scene({name: place for name, (_, place) in lights.items()})
    rig = Rig(moved, ViewDistribution(target=(0, 0, 0), up=(0, 0, 1), light_azimuth=(0, 9), light_elevation=(0, 9)))
    rig.place(View())
    before = image(moved)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        rig.place(View(light_azimuth=40, light_elevation=50))
        after = image(moved)
        assert not any(was_compiled([entry]) for entry in dr.kernel_history() if entry.get("operation_count", 0) > 500)
    places = {}
    for (name, (_, place)), middle in zip(lights.items(), ([1, 1, 1], [-1, 1, 1], [-1, -1, 1]), strict=True):
        turned = np.array(t().rotate([0, 0, 1], 40) @ mi.ScalarPoint3f(middle)).ravel()
        angle = 50 - np.degrees(np.arcsin(turned[2] / np.linalg.norm(turned)))
        axis = np.cross(turned, [0, 0, 1])
        places[name] = t().rotate(list(axis / np.linalg.norm(axis)), angle) @ t().rotate([0, 0, 1], 40) @ place
    expected = image(scene(places))
    np.testing.assert_allclose(after, expected, atol=1e-4 * expected.max())
    assert np.abs(after - before).mean() > 0.3 * before.mean()
    rig.place(View())
    np.testing.assert_allclose(image(moved), before, atol=1e-4 * before.max())


def test_the_sun_of_a_sky_is_where_a_view_has_it():
    """It turns with its sky, and rises in it, whose zenith is the vertical."""
    t = mi.ScalarTransform4f
    upright = t().rotate([1, 0, 0], -90)
    sky = {"type": "sunsky", "sun_direction": [0.6, 0, 0.8], "to_world": upright, "sun_scale": 0.5}
    scene = mi.load_dict({"type": "scene", "sky": sky, "sensor": {"type": "perspective"}})
    rig = Rig(scene, ViewDistribution(up=(0, 1, 0), light_azimuth=(0, 9), light_elevation=(0, 9)))
    (emitter,) = scene.emitters()
    for view, azimuth, direction in (
        (View(light_azimuth=90, light_elevation=30), 90, [np.sqrt(0.75), 0, 0.5]), (View(), 0, [0.6, 0, 0.8])
    ):  # fmt: skip
        rig.place(view)
        np.testing.assert_allclose(np.array(mi.traverse(emitter)["sun_direction"]).ravel(), direction, atol=1e-5)
        np.testing.assert_allclose(matrix(emitter), (t().rotate([0, 1, 0], azimuth) @ upright).matrix, atol=1e-5)


def test_rigs_that_cannot_be():
    turn = ViewDistribution(light_azimuth=(0, 90))
    with pytest.raises(loading.SceneError, match=r"light_azimuth: no light .* \(ConstantBackgroundEmitter\)"):
        Rig(lit("ambient"), turn)
    raised = dataclasses.replace(turn, light_elevation=(0, 9))
    for name in ("sky", "noon"):
        with pytest.raises(loading.SceneError, match="light_elevation: no light"):
            Rig(lit(name), raised)
    Rig(lit("sky"), turn)
    with pytest.raises(loading.SceneError, match="target: not given, and the middle"):
        Rig(lit("sky"), ViewDistribution(azimuth=(0, 9)))


def test_small_ranges_around_the_camera_and_lights():
    """In the open as far as they may be; in a narrow room camera and lamp stay between the walls."""
    origin, t = np.array([1.0, -3, 1.5]), mi.ScalarTransform4f
    sensor = {"type": "perspective", "to_world": t().look_at(list(origin), [0, 0, 0], [0, 0, 1])}

    def ranges(**objects):
        scene = mi.load_dict({"type": "scene", "sensor": sensor, **objects})
        return small_ranges(scene, ViewDistribution(9, 3)), scene

    floor = {"type": "rectangle", "to_world": t().scale(9)}
    views, scene = ranges(floor=floor, sun=LIGHTS["sun"])
    assert (views.azimuth, views.light_azimuth, views.up) == ((-15, 15), (-20, 20), (0, 0, 1))
    assert np.linalg.norm(np.cross(views.target, origin)) < 1e-5  # on the axis
    offset = origin - views.target
    height = np.degrees(np.arcsin(offset[2] / np.linalg.norm(offset)))
    np.testing.assert_allclose(views.elevation, [max(height - 10, height / 2), height + 10], atol=1e-3)
    assert len({*views.trained(), *views.measured()}) == 12
    narrow = {"type": "cube", "to_world": t().translate([0.7, 0, 0]).scale([0.6, 4, 3])}
    views, scene = ranges(room=narrow, lamp={"type": "point", "position": [1.2, 1, 2.0]})
    rig = Rig(scene, views)
    (lamp,) = rig.lights
    for view in (*views.trained(), *views.measured()):
        for place in (rig.camera(view)[:3, 3], (rig.turn(lamp, view) @ [*lamp.centre, 1])[:3]):
            assert (np.abs(place - [0.7, 0, 0]) < [0.6, 4, 3]).all()
    assert 0 < views.azimuth[1] < 15 and 0 < views.light_azimuth[1] < 20
    # A light that cannot turn stays, and so does all where nothing can be seen
    assert ranges(floor=floor, sky=LIGHTS["ambient"])[0].light_azimuth is None
    assert ranges(sun=LIGHTS["sun"])[0] == ViewDistribution(9, 3)


#: Samples of an image in passes of four samples a pixel.
FOUR = 4 * 24 * 24


def references_of(path, *arguments, **options):
    """References of a scene file, without a progress bar."""
    return ReferenceRenders(loading.ParsedScene(path), *arguments, progress=False, **options)


@pytest.fixture
def passes(monkeypatch):
    """Seeds of the rendered passes, of which one can be made to fail."""
    render, seeds = loading.render_pass, []

    def counted(scene, spp, seed):
        seeds.append(seed)
        if len(seeds) == counted.stop:
            raise KeyboardInterrupt
        return render(scene, spp, seed)

    counted.stop, counted.seeds = 0, seeds
    monkeypatch.setattr(loading, "render_pass", counted)
    return counted


def test_references_are_rendered_once(path, tmp_path, passes):
    def rendered(spp=10, **more):
        return references_of(path, ORBIT, spp, tmp_path / "kept", pass_samples=FOUR, **more)

    views = ORBIT.trained()[:2]
    first = rendered()
    images = first.images(views)
    assert first.rendered == 8 and first.reused == 0 and len(set(passes.seeds)) == 8
    assert min(passes.seeds) >= references.SEEDS
    files = sorted((tmp_path / "kept").iterdir())
    assert [file.suffix for file in files] == [".npz"] * 2
    again = rendered()
    np.testing.assert_array_equal(images, again.images(views))
    assert again.rendered == 0 and again.reused == 2
    # Other samples, a scene that is written otherwise: other images; not for what is trained
    unchanged = rendered(without=(path.with_name("material.npz"),))
    assert not {rendered(11).path(v) for v in views} & set(files)
    assert not {rendered(inputs=("x",)).path(v) for v in views} & set(files)
    for file, kept in ((path, False), (path.with_name("material.npz"), True)):
        before = file.read_bytes()
        file.write_bytes(before + b"<!-- changed -->")
        own = {"without": (path.with_name("material.npz"),)}
        assert ({rendered(**own).path(v) for v in views} == {unchanged.path(v) for v in views}) == kept
        file.write_bytes(before)
    # A damaged file is rendered anew
    files[0].write_bytes(files[0].read_bytes()[:100])
    np.testing.assert_array_equal(images, rendered().images(views))


def test_references_of_other_processes_and_after_an_interruption(path, tmp_path, passes):
    """Workers render equal images and keep them in the same files; an interrupted one goes on after its last pass."""
    views = ORBIT.trained()[:3]
    alone = references_of(path, ORBIT, 10, pass_samples=FOUR).images(views)
    seeds = list(passes.seeds)
    for options, counts in (({"workers": 1}, (12, 0)), ({}, (0, 3))):
        shared = references_of(path, ORBIT, 10, tmp_path, pass_samples=FOUR, **options)
        np.testing.assert_array_equal(shared.images(views), alone)
        assert (shared.rendered, shared.reused) == counts and passes.seeds == seeds
    kept = references_of(path, ORBIT, 10, tmp_path / "own", pass_samples=FOUR)
    passes.stop = len(seeds) + 2
    with pytest.raises(KeyboardInterrupt):
        kept.images(views[:1])
    assert [f.name for f in (tmp_path / "own").iterdir()] == [
        kept.path(views[0]).name
    ]  # nothing half-written beside it
    passes.stop = 0
    again = references_of(path, ORBIT, 10, tmp_path / "own", pass_samples=FOUR)
    np.testing.assert_array_equal(again.images(views[:1])[0], alone[0])
    assert again.reused == 1 and again.rendered == 3
    assert passes.seeds[-5:] == [seeds[0], seeds[1], *seeds[1:4]]


def test_references_are_the_exact_scene(path):
    """Against the scene rendered as it is written, in the view that it has; of a transparent film the colours."""
    with_alpha = path.with_name("alpha.xml")
    with_alpha.write_text(path.read_text().replace('value="rgb"', 'value="rgba"'))
    expected = mi.render(loading.load(path, exact=True), spp=64, seed=9).numpy()
    for file in (path, with_alpha):
        image = references_of(file, ViewDistribution(), 64).images([View()])[0]
        assert image.shape == (24, 24, 3) and not np.array_equal(image, expected)
        assert np.abs(image - expected).mean() < 0.05 * expected.mean()


class Timed:
    """A problem whose measurement takes seconds of a clock that stands still otherwise: one for each sample."""

    def __init__(self, clock):
        self.clock, self.net, self.measured, self.samples = clock, None, [None], 8
        self.recipe = SceneRecipe()
        self.identity = {"shading": {"share": 0.9}}

    def measure(self, net):
        self.clock.now += 0.1 * 2 * len(FOOTPRINTS) * self.samples
        return {"psnr_db": 20.0}


@pytest.mark.parametrize(
    ("seconds", "compiling", "known", "samples", "remark"),
    [
        (40, 0.0, True, 8, ""),
        (10, 0.0, True, 2, ""),
        (2, 0.0, True, 1, "one takes about 2 s; the texture was trained alone; give --seconds 6 or more"),
        (40, 6.0, True, 8, "one takes about 50 s, 48 s of it to compile its kernels; the texture was trained alone"),
        (40, 0.0, False, 8, "one takes about 50 s, 48 s of it to compile its kernels; the texture was trained alone"),
    ],
)
def test_renders_that_fit_into_a_limited_time(monkeypatch, seconds, compiling, known, samples, remark):
    clock = type("clock", (), {"now": 5.0})
    monkeypatch.setattr("time.perf_counter", lambda: clock.now)

    def profiled(work):
        start = clock.now
        return (
            work(),
            clock.now - start,
            [{}, {"backend_time": 1e3 * compiling, "operation_count": 20_000, "cache_hit": known}],
        )

    monkeypatch.setattr("mi_diffind.scenes.training.fit.profiled", profiled)
    problem = Timed(clock)
    request = FitRequest("ours", problem.recipe.settings, None, deadline=Deadline(seconds))
    sentence = limit(problem, request)
    assert sentence.startswith("no step through renders: " + remark if remark else remark)
    assert bool(sentence) == bool(remark) == (problem.recipe.share == 0)
    assert problem.samples == samples and problem.identity["shading"]["share"] == problem.recipe.share
    assert request.deadline.reserve == pytest.approx(0.4 * samples)


def test_a_scene_is_trained(folder, tmp_path, monkeypatch):
    """From arrays that say something else, towards the references, as far as few steps go; what comes out is an
    ordinary file, and a run that was interrupted ends where one that was not does.
    """
    for name in ("material.json", "albedo.png", "roughness.png"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    table = load_table(folder / "material.npz")
    entries = table.arrays["cascaded"]
    table.arrays["cascaded"] = dataclasses.replace(entries, entries=255 - entries.entries)
    save_table(tmp_path / "material.npz", table)
    scene = scene_file(tmp_path / "material.npz")
    parsed = loading.ParsedScene(scene)
    recipe = SceneRecipe(share=1.0, reference_spp=16, samples=1)
    changed = {"steps": 12, "measure_every": 6, "batch": 2048, "lr": 0.1, "schedule": "constant"}
    recipe = dataclasses.replace(recipe, settings=dataclasses.replace(recipe.settings, **changed))

    def fitted_scene(**more):
        request = FitRequest("ours", recipe.settings, None, progress=False, output=tmp_path / "trained.npz", **more)
        files = {"references": tmp_path / "kept", "preview": tmp_path / "preview.png"}
        tables, result = fit_scene(parsed, ORBIT, recipe, request, **files)
        return tables["material.npz"], result

    found, result = fitted_scene()
    history = [h["psnr_db"] for h in result.history]
    assert result.steps == 12 and result.restarts == 0 and history[1] > history[0] + 1
    preview = np.array(mi.Bitmap(str(tmp_path / "preview.png")))
    assert preview.shape == (16 + 24, 72, 3) and np.ptp(preview[16:, :48]) > 50  # titles above

    # Before another scene is loaded: kernels contain the materials of all scenes that are there
    gc.collect()
    measure, measured = SceneProblem.measure, []

    def stopped(self, net):
        measured.append(net)
        if len(measured) == 3:  # after those of the start and of step 6
            raise KeyboardInterrupt
        return measure(self, net)

    monkeypatch.setattr(SceneProblem, "measure", stopped)
    with pytest.raises(KeyboardInterrupt):
        fitted_scene(checkpoint=tmp_path / "c.npz")
    gc.collect()
    again, resumed = fitted_scene(checkpoint=tmp_path / "c.npz", resume=True)
    assert [h["psnr_db"] for h in resumed.history] == history
    for name, array in again.arrays.items():
        np.testing.assert_array_equal(array.entries, found.arrays[name].entries)

    # Only the entries of the texture have changed, in the form that they had
    save_table(tmp_path / "trained.npz", found)
    assert found.settings["source_path"] == "material.json" and found.task == "texture"
    assert found.measured["psnr_scene_4_spp_db"] == pytest.approx(result.measured["psnr_4_spp_db"], rel=1e-4)
    assert texture_recipe(load(tmp_path / "trained.npz")) == PRESETS["ours"]
    shapes, given = ({k: (a.shape, a.bits) for k, a in t.arrays.items()} for t in (found, table))
    assert shapes == given
    # The scene that names it looks as was measured
    (tmp_path / "after.xml").write_text(scene.read_text().replace("material.npz", "trained.npz"))
    plain, view = loading.load(tmp_path / "after.xml"), ORBIT.measured()[0]
    own = {"without": (tmp_path / "material.npz",), "inputs": (found.settings["source"],)}
    kept = references_of(scene, ORBIT, 16, tmp_path / "kept", **own)
    (halves,) = kept.halves([(view, 16)])
    assert kept.reused == 1
    Rig(plain, ORBIT).place(view)
    warned = warnings_of(mi, monkeypatch)
    for spp in (8, 1, 4, 8, None):
        footprint.attach(plain, 0, spp)
    assert len(warned) == 1 and "trained.npz: was trained for spp=1, found spp=8: fit scene --spp 8" in warned[0]
    images = [np.clip(found.settings["exposure"] * mi.render(plain, spp=1, seed=i).numpy(), 0, 1) for i in range(16)]
    a, b = (np.mean(images, axis=0) - np.clip(found.settings["exposure"] * half, 0, 1) for half in halves)
    assert -10 * np.log10(np.mean(a * b)) == pytest.approx(result.measured["psnr_1_spp_db"], abs=0.3)


def opaque(seed):
    return dr.opaque(mi.UInt32, seed)


def test_the_scene_reads_what_it_is_given(path, trained):
    """Against the scene as it is written, which reads bytes; also from another view. No other scene reads them."""
    scene, problem = trained
    floats = loading.ParsedScene(path)
    floats.change(lambda state: [
        props.__setitem__("storage", "float32") for props in loading.compat.parsed_properties(state)
        if props.plugin_name() == "neural_texture"
    ])  # fmt: skip
    others = mi.traverse(floats.load(needs=()))
    coarse = next(key for key in others.keys() if key.endswith("tables.coarse"))
    before = others[coarse].numpy()
    scene.hold(rounded(problem.net))
    plain = loading.load(path)
    rig = Rig(plain, ORBIT)
    for view in (View(), ORBIT.trained()[1]):
        scene.place(view, 1)
        rig.place(view)
        footprint.attach(plain)
        image, expected = scene.render(opaque(3), opaque(4), 1).numpy(), mi.render(plain, spp=1, seed=3).numpy()
        np.testing.assert_allclose(image, expected, atol=2e-3 * expected.max())
    # One parameter for each array sets it for all maps
    assert set(scene.keys) == {"level0", "coarse", "cascaded"} and len(scene.parameters) == 3
    everything = mi.traverse(scene.scene)
    (named,) = [key for key in everything.keys() if key.endswith("tables.coarse")]
    scene.hold(problem.net.changed(lambda array, bits: array.unfolded(lambda entries: 0.5 * entries)))
    assert everything[named].numpy().max() <= 0.5
    np.testing.assert_array_equal(others[coarse].numpy(), before)


def inside(net):
    """The arrays as training sees them, away from the ends of [0, 1]."""
    net = rounded(net)
    for array in net.arrays.values():
        array.data = mi.TensorXf(0.02 + 0.96 * array.data)
    return net


def rendered(scene, net, weights, *seeds):
    """An image, and the gradients of a weighted sum of its pixels with respect to all arrays."""
    for array in net.arrays.values():
        dr.enable_grad(array.data)
    scene.hold(net)
    image = scene.render(*map(opaque, seeds), 1)
    dr.backward(dr.sum(image * weights, axis=None))
    return image.numpy(), {name: dr.grad(array.data).numpy() for name, array in net.arrays.items()}


@pytest.fixture(scope="module")
def weights(one_core):
    return mi.TensorXf(np.random.default_rng(0).random((24, 24, 3), dtype=np.float32))


def test_values_and_derivatives_have_their_own_samples(trained, weights):
    scene, problem = trained
    scene.place(View(), 1)
    (bsdf,) = (made for made in loading.instances(scene.scene) if hasattr(made, "decoder"))
    tables = {name: array.codes() for name, array in bsdf.tables.arrays.items()}
    (a, da), (b, db), (c, dc) = (
        rendered(scene, inside(problem.net), weights, *seeds) for seeds in ((1, 2), (1, 3), (5, 2))
    )
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 1e-3
    for name, gradient in da.items():
        np.testing.assert_array_equal(gradient, dc[name])
        assert np.abs(gradient - db[name]).max() > 1e-3 * np.abs(gradient).max()
    # The tables of the BRDF are bytes, which no derivative reaches
    for name, array in bsdf.tables.arrays.items():
        np.testing.assert_array_equal(array.codes(), tables[name])
    assert not [key for key in mi.traverse(bsdf).keys() if key.startswith("tables.")]


def test_a_material_is_trained_as_its_maps_are(folder, path, trained, weights):
    """One plugin that reads all maps gives the images and gradients of a plugin for each map."""
    text = re.sub(
        "<bsdf .*</bsdf>", '<bsdf type="neural_material"><string name="filename" value="material.npz"/><string '
        'name="lobes" value="tables"/></bsdf>', path.read_text(encoding="utf-8"),
    )  # fmt: skip
    (folder / "whole.xml").write_text(text)
    parsed = loading.ParsedScene(folder / "whole.xml")
    file, _ = texture_file(parsed)
    whole, (scene, problem) = TrainedScene(parsed, {file: load(file)}, ORBIT), trained
    whole.place(View(), 1)
    scene.place(View(), 1)
    (a, da), (b, db) = (rendered(s, inside(problem.net), weights, 1, 2) for s in (whole, scene))
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)
    for name, gradient in da.items():
        assert np.abs(gradient - db[name]).max() < 1e-3 * np.abs(gradient).max()


def test_gradients_against_differences(trained, weights):
    """Of a weighted sum of all pixels with respect to entries of each array, seven of those with the largest gradients
    and three others, by central differences at equal samples. The sun's direction is no random number, so nothing is
    sampled that would depend on the entries.
    """
    scene, problem = trained
    scene.place(View(), 1)
    rng, net = np.random.default_rng(1), inside(problem.net)
    _, gradients = rendered(scene, net, weights, 4, 3)
    for name, gradient in gradients.items():
        assert np.isfinite(gradient).all()
        array, used = net.arrays[name], np.argsort(-np.abs(gradient), axis=None)
        before, values = array.data, array.data.numpy()
        for index in [*rng.choice(used[:70], 7, replace=False), *rng.choice(used[70:], 3, replace=False)]:
            found = []
            for step in (4e-3, -4e-3):
                changed = values.copy()
                changed.flat[index] += step
                array.data = mi.TensorXf(changed)
                with dr.suspend_grad():
                    scene.hold(net)
                    image = scene.render(opaque(3), opaque(4), 1) * weights
                found.append(float(dr.sum(image, axis=None).array[0]))
            expected, largest = (found[0] - found[1]) / 8e-3, float(np.abs(gradient).max())
            assert gradient.flat[index] == pytest.approx(expected, rel=0.05, abs=5e-3 * largest)
        array.data = before


def test_a_training_reads_as_renders_do(trained):
    """One sample a pixel at the pixel's centre, whatever its random numbers; those of four anywhere in the pixel."""
    scene, _ = trained
    spread = {}
    for spp in FOOTPRINTS:
        scene.place(View(), spp)
        images = [scene.render(opaque(seed), opaque(99), 1).numpy()[8:16, 8:16] for seed in range(8)]
        spread[spp] = np.std(images, axis=0).mean() / np.mean(images)
    assert spread[1] < 0.2 * spread[4], spread


def test_which_textures(path, folder, trained):
    """Those of a file, also of a scene that is a dictionary, whose parameters are those of the file."""
    file = (folder / "material.npz").resolve()
    texture = {"type": "neural_texture", "filename": str(file), "channels": "albedo"}
    floor = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}
    scene = {"type": "scene", "integrator": {"type": "path"}, "sensor": {"type": "perspective"}, "floor": floor}
    parsed = loading.ParsedScene(scene)
    assert texture_file(parsed) == (file, "")
    assert TrainedScene(parsed, {file: load(file)}, ViewDistribution()).keys.keys() == trained[0].keys.keys()
    parsed = loading.ParsedScene(path)
    assert texture_files(parsed) == texture_files(parsed, [folder / "material.npz"]) == {folder / "material.npz": ""}
    with pytest.raises(
        UsageError, match=r"no neural_texture or neural_material reads .*other\.npz, the files are material\.npz"
    ):
        texture_files(parsed, [folder / "other.npz"])
    plain = folder / "plain.xml"
    plain.write_text('<scene version="3.0.0"><shape type="sphere"/></scene>')
    with pytest.raises(UsageError, match="names no file of neural_texture or neural_material"):
        texture_files(loading.ParsedScene(plain))


@pytest.fixture(scope="module")
def pair(path):
    """A scene of two surfaces with textures of two files that hold the same arrays; of one file with ``b=a.npz``."""
    folder = path.parent / "pair"
    folder.mkdir()
    for name in ("albedo.png", "roughness.png", "material.json"):
        (folder / name).write_bytes(path.with_name(name).read_bytes())
    for name in ("a.npz", "b.npz"):
        (folder / name).write_bytes(path.with_name("material.npz").read_bytes())
    text = path.read_text("utf-8")
    surface = (
        '<shape type="rectangle"><transform name="to_world"><translate x="{}"/></transform><bsdf type="diffuse">'
        '<texture type="neural_texture" name="reflectance"><string name="filename" value="{}"/>'
        '<string name="channels" value="albedo"/><string name="filter" value="off"/></texture></bsdf></shape>'
    )
    surfaces = surface.format(-1, "a.npz") + surface.format(1, "$b")
    text = re.sub("<shape .*</shape>", surfaces, text)
    (folder / "pair.xml").write_text(text.replace("<default", '<default name="b" value="b.npz"/><default', 1), "utf-8")
    return folder / "pair.xml"


def test_gradients_of_several_files(pair, weights):
    """Together they are the gradients of one file that both surfaces show."""
    images, gradients = {}, {}
    for b in ("a.npz", "b.npz"):
        parsed = loading.ParsedScene(pair, {"b": b})
        textures = load_textures(parsed)
        problem = joint_problem({t.file.name: t.problem for t in textures})
        scene = TrainedScene(parsed, {t.file: t.table for t in textures}, ViewDistribution())
        images[b], gradients[b] = rendered(scene, inside(problem.net), weights, 1, 2)
    np.testing.assert_allclose(images["a.npz"], images["b.npz"], atol=1e-5)
    assert len(gradients["b.npz"]) == 2 * len(gradients["a.npz"])
    assert np.abs(gradients["a.npz"]["level0"]).max() > 0
    for name, gradient in gradients["a.npz"].items():
        parts = [gradients["b.npz"][f"{file}/{name}"] for file in ("a.npz", "b.npz")]
        assert all(np.abs(part).max() >= 0.1 * np.abs(gradient).max() for part in parts)
        np.testing.assert_allclose(sum(parts), gradient, atol=1e-4 * np.abs(gradient).max())
    # Both textures are the same, and so is the loss of both
    losses = []
    for each in (problem, textures[0].problem):
        each.begin(0, 0.0)
        losses.append(float(sum(dr.sum(part)[0] for part in each.loss(each.net, dr.rng(seed=1), 2**14))))
    assert losses[0] == pytest.approx(losses[1], rel=0.1)
    assert problem.measure(problem.net) == {
        f"{t.file.name}_{key}": value for t in textures for key, value in t.problem.measure(t.problem.net).items()
    }


def test_several_files_are_trained(pair, tmp_path, monkeypatch):
    """All that the scene names, in one run, into a folder; a checkpoint keeps all of them."""
    checkpoint = tmp_path / "c.npz"
    given = {
        "defines": [("film", "6")], "views": 1, "held_out": 1, "reference_spp": 64, "progress": False,
        "steps": 2, "measure_every": 2, "batch": 512, "lr": 0.02, "deterministic": True, "begin": "untrained",
    }  # fmt: skip

    def trained_files(**more):
        return mi_diffind.fit("scene", pair, checkpoint=checkpoint, output=tmp_path / "out", **given, **more)

    fitted_files = trained_files()
    folder = fitted_files.save(tmp_path / "out")
    names = ["a.npz", "b.npz"]
    assert sorted(file.name for file in folder.iterdir()) == sorted(fitted_files.report["files"]) == names
    assert fitted_files.report["bytes"] == sum(model.nbytes for model in fitted_files.models.values())
    assert f"{folder / 'b.npz'}: " in "\n".join(fitted_files.summary(folder))
    with pytest.raises(UsageError, match="2 files were trained"):
        _ = fitted_files.model
    resumed = trained_files(resume=True)
    for name in names:
        table = load(folder / name)
        assert table.settings["trained_with"] == names and table.settings["source_path"].endswith("pair/material.json")
        assert ((folder / table.settings["source_path"]).resolve()) == pair.with_name("material.json")
        changed = {key for key, array in table.arrays.items() if not np.array_equal(
            array.entries, load(pair.with_name(name)).arrays[key].entries)}  # fmt: skip
        assert "coarse" in changed and "kept_start" not in table.settings
        for key, array in resumed.tables[name].arrays.items():
            np.testing.assert_array_equal(array.entries, table.arrays[key].entries)
    # Nothing is replaced if one of them cannot be written
    before = {name: (folder / name).read_bytes() for name in names}
    fitted_files.tables["a.npz"].seed = 5
    fitted_files.tables["b.npz"].seed = object()
    with pytest.raises(TableError):
        fitted_files.save(folder)
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"output": "x.npz"}, r"2 textures are trained \(a.npz, b.npz\): give a folder"),
        ({"output": "."}, "found the folder of the trained textures"),
        ({"texture": "b.npz", "output": "x"}, 'found the extension ""'),
        ({"start": ["a.npz"]}, "--start: a.npz is not the only one for a.npz, or belongs to several"),
        ({"texture": "b.npz", "start": ["b.npz", "a.npz"]}, "--start: a.npz is not the only one for b.npz"),
    ],
)
def test_several_files_that_cannot_be(pair, monkeypatch, change, match):
    monkeypatch.chdir(pair.parent)
    with pytest.raises(UsageError, match=match):
        mi_diffind.fit("scene", pair, progress=False, **change)


def test_errors_of_pixels():
    problem = object.__new__(SceneProblem)
    error = mi.Float([-3, -0.5, 0, 0.25, 2])
    for loss, bound, expected, slope in (
        ("mse", None, [9, 0.25, 0, 0.0625, 4], [-6, -1, 0, 0.5, 4]),
        ("mse", 1.0, [5, 0.25, 0, 0.0625, 3], [-2, -1, 0, 0.5, 2]),
        ("mae", 1.0, [3, 0.5, 0, 0.25, 2], [-1, -1, 0, 1, 1]),
    ):
        problem.recipe = SceneRecipe(bound=bound)
        problem.settings = dataclasses.replace(problem.recipe.settings, loss=loss)
        x = mi.Float(error)
        dr.enable_grad(x)
        found = problem.errors(x)
        dr.backward(found)
        np.testing.assert_allclose(found.numpy(), expected)
        nonzero = np.array(error) != 0
        np.testing.assert_allclose(dr.grad(x).numpy()[nonzero], np.array(slope)[nonzero])


def test_exposure():
    image = np.linspace(0, 2, 100, dtype=np.float32).reshape(10, 10, 1) * np.float32([1, 0.5, 0.2])
    assert estimate_exposure([image]) == pytest.approx(1 / 1.9, rel=0.02)
    assert estimate_exposure([np.zeros((2, 2, 3))]) == 1


def test_lines_of_the_score():
    """A figure of trained views is called so; one of held-out views says which they are."""
    result = FitResult({"psnr_db": 30.0}, 4, 4, 1.0, False, 0, [{"step": 0, "loss": None, "psnr_db": 24.0}])
    (_, line) = score_lines(ViewDistribution(1), SceneRecipe(), result)
    assert line == "training score: trained and measured on the same view"
    ranges, line = score_lines(ViewDistribution(12, 3, azimuth=(-15, 15), light_azimuth=(0, 9)), SceneRecipe(), result)
    assert ranges == "12 views: azimuth -15:15, light-azimuth 0:9"
    assert line == "3 held-out views: 24.00 → 30.00 dB, mean of footprints of 1 and 4 samples a pixel"


def test_a_state_that_loses_at_a_footprint_is_no_gain():
    problem = object.__new__(SceneProblem)
    problem.footprints = [1, 4]
    before, figures = (
        {"psnr_db": 25.0, "psnr_1_spp_db": 24.0, "psnr_4_spp_db": 26.0},
        ("psnr_1_spp_db", "psnr_4_spp_db"),
    )
    for one, four, gains in (
        (25, 27, True),
        (25, 25.95, True),
        (28, 25.8, False),
        (24, 26, False),
        (23.95, 25.9, False),
    ):
        after = {"psnr_db": (one + four) / 2, **dict(zip(figures, (one, four), strict=True))}
        assert problem.gains(before, after) == gains


@pytest.mark.parametrize("preset", ["ours", "paper"])
def test_arrays_of_the_same_size(folder, preset, tmp_path):
    """A file says all that is needed to begin anew."""
    source, recipe = load_source(folder / "material.json"), PRESETS[preset]
    layout = source_layout(source, recipe)
    wanted = PaperBudget(16, 24, 4, 5, layout.stored)
    if preset == "ours":
        wanted = TextureBudget(32, 32, layout.stored, parse_structure("0:2:4,1:3:6"), 2, 3, (7, 6, 5), 3)
    pyramid = Pyramid.from_source(source, layout, array_module("llvm"))
    net = build_problem(source, wanted, recipe, pyramid).net
    own = recipe.further
    table = to_table(CompressedTexture(layout, stored_form(net)), {**own, "loss": "mae"})  # a render's
    save_table(tmp_path / "x.npz", table)
    table = load(tmp_path / "x.npz")
    assert texture_budget(table) == wanted
    assert texture_recipe(table) == recipe


def test_the_figure_holds_for_views_that_it_has_not_seen(folder, path):
    """Without ranges, small ones are drawn, and the figure is that of renders of other views of them, by Mitsuba alone,
    with other samples. Beside it stands the figure of the start, in the same views.
    """
    settings = FitSettings(steps=6, batch=512, lr=0.01, measure_every=6, deterministic=True)
    recipe, parsed = SceneRecipe(reference_spp=256, samples=4096, settings=settings), loading.ParsedScene(path)
    request = FitRequest("ours", settings, array_module("llvm"), progress=False, output=folder / "after.npz")
    tables, result = fit_scene(parsed, ViewDistribution(4, 12), recipe, request)
    table = tables["material.npz"]
    views = ViewDistribution(**table.settings["views"])
    assert views.moves_camera and views.moves_light and views.up == (0, 0, 1) and len(views.measured()) == 12
    assert [entry["step"] for entry in result.history] == [0, 6]
    save_table(folder / "after.npz", table)
    (folder / "after.xml").write_text(path.read_text().replace("material.npz", "after.npz"))
    others, exposure = dataclasses.replace(views, seed=7, held_out=12).measured(), table.settings["exposure"]

    def halves(exact, spp, footprints):
        """Renders of all other views, each twice."""
        scene = loading.load(folder / "after.xml", exact=exact)
        rig, images = Rig(scene, views), []
        for number, view in enumerate(others):
            rig.place(view)
            footprint.attach(scene, 0, footprints)
            pair = [mi.render(scene, spp=spp, seed=2 * number + half + 1000 * exact).numpy() for half in range(2)]
            images.append([np.clip(exposure * image, 0, 1) for image in pair])
        return np.array(images)

    truth = halves(True, 64, 64)
    for spp in (1, 4):
        error = np.mean(np.prod(halves(False, 16, spp) - truth, axis=1))
        assert -10 * np.log10(error) == pytest.approx(table.measured[f"psnr_scene_{spp}_spp_db"], abs=0.5)


def test_a_training_that_gains_nothing_keeps_its_start(folder, path):
    """With a rate that ruins the arrays; and a start of another source is refused."""
    settings = FitSettings(steps=4, batch=64, lr=5.0, measure_every=4, deterministic=True)
    recipe, before = SceneRecipe(reference_spp=4, settings=settings), load(folder / "material.npz")
    request = FitRequest("ours", settings, array_module("llvm"), progress=False)
    parsed, views = loading.ParsedScene(path, {"film": 4}), ViewDistribution(1, 1)
    tables, result = fit_scene(parsed, views, recipe, request)
    table = tables["material.npz"]
    assert table.settings["kept_start"] and result.step == 0 and result.measured.items() <= result.history[0].items()
    for name, array in table.arrays.items():
        np.testing.assert_array_equal(array.values, before.arrays[name].values)
    other = load(folder / "material.npz")
    other.settings["source"] = "other"
    save_table(folder / "other.npz", other)
    with pytest.raises(UsageError, match=r"--start: .*other\.npz holds other maps"):
        fit_scene(parsed, views, recipe, request, starts=[folder / "other.npz"])
