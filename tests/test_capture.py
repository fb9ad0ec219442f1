"""``mi-diffind capture``: where the cameras are, what their images show, and going on with a folder."""

import json
from pathlib import Path

import captures
import numpy as np
import pytest
from commands import interrupt_at
from PIL import Image

from mi_diffind.commands import cli
from mi_diffind.core.jobs import Outcome
from mi_diffind.scenes import capture, loading
from mi_diffind.scenes.capture import CaptureSettings
from mi_diffind.scenes.poses import pose, upright_frame
from mi_diffind.tasks.radiance.views import load_views

SCENES = Path(__file__).resolve().parents[1] / "scenes"

#: Centre, radius and colour of three spheres of which no two can be taken for another.
SPHERES = (
    ((0, 0, 0), 0.5, "0.8, 0.05, 0.05"),
    ((1, 0.3, 0), 0.3, "0.05, 0.8, 0.05"),
    ((0, 1, 0.4), 0.4, "0.05, 0.05, 0.8"),
)

SCENE = """
<scene version="3.0.0">
    <default name="red" value="0.8"/>
    <integrator type="direct"/>
    <emitter type="constant"/>
    SPHERES
    <shape type="rectangle"><transform name="to_world"><scale value="3"/><translate z="-9"/></transform>
        <emitter type="area"/></shape>
</scene>
"""


SPHERE = """<shape type="sphere" id="s{}"><point name="center" value="{}"/><float name="radius" value="{}"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="{}"/></bsdf></shape>"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.xml"
    spheres = [SPHERE.format(i, f"{x}, {y}, {z}", *s) for i, ((x, y, z), *s) in enumerate(SPHERES)]
    path.write_text(SCENE.replace("SPHERES", "".join(spheres)).replace("0.8, 0.05, 0.05", "$red, 0.05, 0.05"))
    return path


def stopped(capsys, scene, folder, *options):
    """What a capture that must fail says."""
    assert run(scene, folder, *options) == 2
    return capsys.readouterr().err


def images(folder):
    return captures.images_of(load_views(folder))


def run(scene, folder, *options):
    """Capture few small views; the exit code."""
    small = ("--views", "4", "--test", "2", "--resolution", "24", "--spp", "16")
    return cli.main(["capture", str(scene), "-o", str(folder), *small, *options])


def nearest(origin, direction):
    """The number of the sphere that rays ``(…, 3)`` meet first, −1: none."""
    found, number = np.full(direction.shape[:-1], np.inf), np.full(direction.shape[:-1], -1)
    for i, (centre, radius, _) in enumerate(SPHERES):
        to = np.array(centre) - origin
        along = (to * direction).sum(axis=-1)
        inside = radius**2 - ((to**2).sum(axis=-1) - along**2)
        t = np.where((inside > 0) & (along > 0), along - np.sqrt(np.maximum(inside, 0)), np.inf)
        number[t < found] = i
        found = np.minimum(found, t)
    return number


def test_images_show_what_rays_of_their_poses_meet(mi_rgb, scene, tmp_path, capsys):
    """Against spheres met by formulas: colours and alpha, from the files alone. Lights are hidden."""
    folder = tmp_path / "views"
    assert run(scene, folder) == 0
    assert "views: 6 of 6 views, 6 rendered now" in capsys.readouterr().out
    for split, count in (("train", 4), ("test", 2)):
        views = load_views(folder, split)
        assert len(views) == count and views.has_alpha and (views.sizes == 24).all()
        seen_images = captures.images_of(views)
        edges = np.arange(25) - 0.5
        numbers = np.stack([nearest(*captures.rays_of(views, v, *np.meshgrid(edges, edges))) for v in range(count)])
        corners = np.stack([numbers[:, :-1, :-1], numbers[:, 1:, :-1], numbers[:, :-1, 1:], numbers[:, 1:, 1:]])
        same = (corners == corners[0]).all(axis=0)
        for i in range(3):  # the colour that a sphere is of is the largest, nowhere else
            seen = seen_images[same & (corners[0] == i)]
            assert len(seen) > 20 and (seen[:, :3].argmax(axis=1) == i).all() and seen[:, 3].min() == 1
        nothing = seen_images[same & (corners[0] == -1)]
        assert len(nothing) > 200 and nothing.max() < 0.3 and np.mean(nothing == 0) > 0.97
        assert not seen_images[:, 0, 0].any()
        assert views.box[0] == pytest.approx([-0.5 - 0.018, -0.5 - 0.019, -0.5 - 0.018], abs=0.003)
        assert views.box[1] == pytest.approx([1.3 + 0.018, 1.4 + 0.019, 0.8 + 0.018], abs=0.003)


def test_formats_agree(mi_rgb, scene, tmp_path):
    assert run(scene, tmp_path / "png") == run(scene, tmp_path / "exr", "--format", "exr") == 0
    png, exr = (load_views(tmp_path / name) for name in ("png", "exr"))
    assert exr.names[0] == "train/r_000.exr" and np.array_equal(png.poses, exr.poses)
    png, exr = images(tmp_path / "png"), images(tmp_path / "exr")
    assert np.abs(png - np.minimum(exr, exr[..., 3:])).max() < 0.006
    assert len(np.unique(exr)) > len(np.unique(png))


def test_other_settings_are_refused(mi_rgb, scene, tmp_path, capsys):
    folder = tmp_path / "views"
    assert run(scene, folder, "--seed", "3") == 0
    record = (folder / "capture.json").read_text()
    for options, message in (
        (("--seed", "4"), "holds a capture with other settings (seed: 3, now 4): take those, or another folder"),
        (("--seed", "3", "--fov", "30"), "(fov: 40.0, now 30.0)"),
        (("--seed", "3", "-D", "red=0.5"), "(red: None, now 0.5)"),
        (("--seed", "3", "--variant", "llvm_ad_mono"), "(variant: llvm_ad_rgb, now llvm_ad_mono)"),
    ):
        assert message in stopped(capsys, scene, folder, *options)
    scene.write_text(scene.read_text().replace('"0.3"', '"0.2"'))
    assert "(the scene's files have changed)" in stopped(capsys, scene, folder, "--seed", "3")
    assert (folder / "capture.json").read_text() == record
    (folder / "capture.json").write_text("{")
    assert "capture.json: cannot be read" in stopped(capsys, scene, folder)
    (folder / "capture.json").unlink()
    assert "holds views that were not captured here" in stopped(capsys, scene, folder)


def test_an_interrupted_capture_is_gone_on_with(mi_rgb, scene, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        interrupt_at(patch, capture.SceneSubject, "render", 3)
        assert run(scene, tmp_path / "views") == 130
    assert "3 of 6 views, 3 rendered now" in capsys.readouterr().out
    assert len(load_views(tmp_path / "views")) == 3  # what there is can be used
    with monkeypatch.context() as patch:  # and a failure on the way leaves no half image

        def failing(path, image):
            raise capture.SceneError("disk")

        patch.setattr(capture, "_write", failing)
        assert run(scene, tmp_path / "views") == 2
    assert run(scene, tmp_path / "views") == 0 and "3 rendered now" in capsys.readouterr().out
    assert run(scene, tmp_path / "whole") == 0
    for path in (tmp_path / "whole").glob("*/*.png"):
        assert path.read_bytes() == (tmp_path / "views" / path.relative_to(tmp_path / "whole")).read_bytes()


def test_views_of_other_processes(mi_rgb, scene, tmp_path, monkeypatch, capsys):
    """Images and lists are equal to the last byte; a view that fails ends the capture."""
    assert run(scene, tmp_path / "one", "-D", "red=0.5") == run(
        scene, tmp_path / "two", "-D", "red=0.5", "--workers", "1"
    )
    files = sorted(path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*.*"))
    assert len(files) == 6 + 3 and "two: 6 of 6 views, 6 rendered now" in capsys.readouterr().out
    for file in files:
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes(), file
    (tmp_path / "two" / "train" / "r_000.png").unlink()
    monkeypatch.setattr(capture, "run_jobs", lambda *_: (o for o in [Outcome("train/r_000.png", failure="disk full")]))
    assert "train/r_000.png: disk full" in stopped(capsys, scene, tmp_path / "two", "-D", "red=0.5", "--workers", "1")


@pytest.mark.parametrize("integrator", ["direct", "prb"])
def test_objects_alone_are_seen(mi_rgb, scene, tmp_path, capsys, integrator):
    """One of three, in the middle of the images, wholly, wherever the others stand; in their shadow."""
    wall = '<shape type="cube"><transform name="to_world"><scale x="0.1"/><translate x="1.5"/></transform></shape>'
    scene.write_text(scene.read_text().replace("</scene>", f"{wall}</scene>").replace("direct", integrator))
    options = ("--objects", "s1", "--views", "8", "--test", "0", "--resolution", "32", "--elevation", "-50", "60")
    assert run(scene, tmp_path / "one", *options) == 0
    assert not (tmp_path / "one" / "transforms_test.json").exists()
    content = json.loads((tmp_path / "one" / "transforms_train.json").read_text())
    assert content["aabb"] == [pytest.approx([0.694, -0.006, -0.306]), pytest.approx([1.306, 0.606, 0.306])]
    (tmp_path / "one" / "transforms_test.json").write_text("{}")
    views, centre, inside = load_views(tmp_path / "one"), np.array([1, 0.3, 0]), []
    for i, matrix in enumerate(views.poses):
        away = centre - matrix[:3, 3]
        assert -matrix[:3, 2] == pytest.approx(away / np.linalg.norm(away), abs=1e-6)
        assert -50 < np.degrees(np.arcsin(-away[1] / np.linalg.norm(away))) < 60
        origin, direction = captures.rays_of(views, i, *np.meshgrid(np.arange(32), np.arange(32)))
        beside = np.linalg.norm(np.cross(direction, centre - origin), axis=-1)
        image = views.image(i)
        assert (image[..., 3][beside < 0.27] > 0.99).all()  # half a pixel within
        assert not image[beside > 0.33].any()
        inside.append(image[beside < 0.2])
        assert (inside[-1][:, :3].argmax(axis=1) == 1).mean() > 0.97  # but where nothing arrived
    # Beside a wall, and below another sphere, it is not as bright everywhere as alone in this light
    assert np.concatenate(inside)[:, 1].min() < 0.6 < np.concatenate(inside)[:, 1].max()
    message = 'objects: found "other", the ids of the scene\'s shapes are: s0, s1, s2'
    assert message in stopped(capsys, scene, tmp_path / "two", "--objects", "s1", "other")


def test_meshes_of_one_material_keep_their_ids(mi_rgb, tmp_path):
    """Mitsuba makes one mesh of them, where it may."""
    path, cube = tmp_path / "cubes.xml", '<shape type="cube" id="{}"><ref id="grey"/><transform name="to_world">{}'
    cubes = [cube.format(name, f'<translate x="{x}"/></transform></shape>') for name, x in (("a", -2), ("b", 3))]
    path.write_text(f'<scene version="3.0.0"><bsdf type="diffuse" id="grey"/>{"".join(cubes)}</scene>')
    assert len(loading.load(path).shapes()) == 1
    assert capture.SceneSubject(path, None, capture.CaptureSettings()).bounds().tolist() == [[-3, -1, -1], [4, 1, 1]]
    subject = capture.SceneSubject(path, None, capture.CaptureSettings(objects=("b",)))
    assert subject.bounds().tolist() == [[2, -1, -1], [4, 1, 1]]
    # As far as their vertices, which is nearer than the corners of a box around both
    assert subject.reach(np.array([3.0, 0, 0])) == pytest.approx(np.sqrt(3))


def test_integrators_that_nest_another_leave_lights_to_it(mi_rgb, scene, tmp_path):
    """And further channels are none of the image's."""
    nested = '<integrator type="aov"><string name="aovs" value="d:depth"/><integrator type="direct"/></integrator>'
    other = tmp_path / "other.xml"
    other.write_text(scene.read_text().replace('<integrator type="direct"/>', nested))
    assert run(scene, tmp_path / "plain") == run(other, tmp_path / "nested") == 0
    plain, found = images(tmp_path / "plain"), images(tmp_path / "nested")
    assert not found[:, 0, 0].any() and np.abs(found - plain).mean() < 0.01


def test_a_field_of_distances_is_captured_whole_only(mi_rgb, scene, tmp_path, capsys):
    """Its shape in the scene is a box, which the integrator alone knows what to do with."""
    file = f'<string name="filename" value="{SCENES / "assets" / "knot.npz"}"/>'
    knot = f'<shape type="neural_sdf" id="knot">{file}</shape>'
    scene.write_text(SCENE.replace("SPHERES", knot).replace("direct", "path_sdf"))
    assert 'objects: found "knot", ' in stopped(capsys, scene, tmp_path / "views", "--objects", "knot")
    assert run(scene, tmp_path / "views", "--spp", "1") == 0
    assert 0.05 < images(tmp_path / "views")[..., 3].mean() < 0.4


def test_what_hides_nothing_is_said(mi_rgb, scene, tmp_path, capsys):
    inside = ("--centre", "0", "0", "0", "--radius", "0.1", "--views", "2", "--test", "0")
    assert run(scene, tmp_path / "views", *inside) == 0
    assert "alpha is 1 everywhere" in capsys.readouterr().out
    assert run(scene, tmp_path / "away", "--centre", "50", "0", "0", "--radius", "1", "--views", "2") == 0
    with Image.open(tmp_path / "away" / "train" / "r_000.png") as image:
        assert not np.array(image).any()


@pytest.mark.parametrize(
    "options, message",
    [
        (("--radius", "0"), "radius: found 0, allowed are numbers > 0"),
        (("--radius", "nan"), "radius: found nan, allowed are numbers > 0"),
        (("--fov", "180"), "fov: found 180, allowed are degrees between 0 and 170"),
        (("--elevation", "30", "20"), "elevation: found 30 to 20, allowed are degrees from −90 to 90, the lower first"),
        (("--up", "0", "0", "0"), "up: found no direction"),
        (("--centre", "0", "inf", "0"), "centre: found NaN or infinity"),
    ],
)
def test_options_that_are_refused(mi_rgb, scene, tmp_path, capsys, options, message):
    assert message in stopped(capsys, scene, tmp_path / "views", *options) and not (tmp_path / "views").exists()


@pytest.mark.parametrize("name", ["group", "thin", "glossy"])
def test_scenes_that_ship_are_wholly_in_sight(mi_rgb, tmp_path, name):
    """From below, from the side and from above, from the distance that is taken by default."""
    options = ("--views", "3", "--test", "0", "--resolution", "40", "--spp", "4")
    assert cli.main(["capture", str(SCENES / f"capture_{name}.xml"), "-o", str(tmp_path / "views"), *options]) == 0
    file = tmp_path / "views" / "transforms_train.json"
    content = json.loads(file.read_text())
    # The first view of a capture without test views is held out
    file.write_text(json.dumps({**content, "frames": content["frames"] + content["frames"][:1]}))
    seen = images(tmp_path / "views")
    alpha = seen[..., 3]
    border = np.concatenate([alpha[:, [0, -1]].ravel(), alpha[:, :, [0, -1]].ravel()])
    assert border.max() < 1 and border.mean() < 0.03  # touched, not crossed
    assert 0.1 < alpha.mean() < 0.6
    rows, columns = np.nonzero(alpha.any(axis=0))
    assert np.ptp(rows) > 28 and np.ptp(columns) > 28  # and they fill the images
    assert 0.02 < seen[..., :3].mean() < 0.5


def angles(a, b):
    return np.degrees(np.arccos(np.clip(a @ b.T, -1, 1)))


def test_views_on_a_sphere_are_even_and_test_views_between_them(mi_rgb):
    train, test = CaptureSettings(seed=1).directions()
    assert train.shape == (60, 3) and test.shape == (20, 3)
    assert np.allclose(np.linalg.norm(train, axis=1), 1)
    apart = angles(train, train) + 360 * np.eye(60)
    even = np.degrees(np.sqrt(4 * np.pi / 60))  # the side of a square that each has for itself
    assert apart.min() > 0.7 * even and np.abs(train.mean(axis=0)).max() < 0.02
    assert angles(test, train).min() > 0.2 * even
    assert angles(test, train).min(axis=1).max() < 0.9 * even
    other = CaptureSettings(seed=2).directions()[0]
    assert np.abs(other - train).max() > 0.1 and np.allclose(other[:, 2], train[:, 2])
    upper = np.degrees(np.arcsin(CaptureSettings(elevation=(10.0, 50.0)).directions()[0][:, 2]))
    assert upper.min() > 10 and upper.max() < 50 and upper.min() < 12 and upper.max() > 48


@pytest.mark.parametrize(("views", "test"), [(8, 3), (5, 5), (4, 1)])
def test_an_orbit_closes_and_swings(mi_rgb, views, test):
    """Test views lie halfway between two neighbours, and as many steps of the orbit from each other, to one."""
    train, held_out = CaptureSettings(path="orbit", views=views, test=test, elevation=(0.0, 60.0)).directions()
    turns, steps = (np.degrees(np.arctan2(d[:, 1], d[:, 0])) % 360 / (360 / views) for d in (train, held_out))
    np.testing.assert_allclose(turns, np.arange(views), atol=1e-9)
    np.testing.assert_allclose(steps % 1, 0.5, atol=1e-9)
    gaps = np.diff(np.append(steps, steps[0] + views))
    assert gaps.max() - gaps.min() < 1 + 1e-9
    # The elevation goes up and down once, from the lowest in the first view
    for directions, place in ((train, turns), (held_out, steps)):
        elevation = 30 - 30 * np.cos(2 * np.pi * place / views)
        np.testing.assert_allclose(np.degrees(np.arcsin(directions[:, 2])), elevation, atol=1e-6)
    assert np.allclose(CaptureSettings(path="orbit").directions()[0][:, 2], np.sin(np.radians(20)))


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 2), (1, 1, -1)])
def test_poses_are_rigid_and_upright(mi_rgb, up):
    frame = upright_frame(up)
    axis = np.array(up) / np.linalg.norm(up)
    assert np.allclose(frame.T @ frame, np.eye(3)) and np.allclose(frame[:, 2], axis)
    target = np.array([0.2, -1, 3])
    aside = 3e-7 * frame[:, 0]  # the way up is next to the line of sight
    for offset in (np.array([1.0, 2, 3]), np.array([-2.0, 0.1, 0.5]), 2 * axis, -3 * axis, 2 * axis + aside):
        found = pose(target + offset, target, up)
        assert np.allclose(found[:3, :3].T @ found[:3, :3], np.eye(3)) and np.linalg.det(found[:3, :3]) > 0
        assert np.allclose(found[:3, 2] * np.linalg.norm(offset), offset)
        assert found[:3, 1] @ axis > -1e-9 and abs(found[:3, 0] @ axis) < 1e-6
