"""Photographs: lenses with a distortion, backgrounds of one colour, and models of COLMAP."""

import json
import shutil
import sys

import captures
import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from captures import SIZE, change, pose, refused, write_blender, write_exr, write_image, write_json
from PIL import Image
from radiance_fields import Fog
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation

from mi_diffind.commands.cli import main
from mi_diffind.fitting.task import tasks
from mi_diffind.tasks.radiance import grid as grids
from mi_diffind.tasks.radiance import views as view_files
from mi_diffind.tasks.radiance.captures import LINEAR
from mi_diffind.tasks.radiance.session import RAYS, FieldSession, ImagesProblem
from mi_diffind.tasks.radiance.views import load_views, object_box

LENS = {"k1": -0.12, "k2": 0.03, "p1": 0.004, "p2": -0.003}
SIDE = 64


def shown_at(u, v, k1=0, k2=0, p1=0, p2=0, k3=0, k4=0, k5=0, k6=0):
    """Point at which a lens shows a direction, by the formula of ``cv2.projectPoints``."""
    r2 = u**2 + v**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u**2),
        v * radial + p1 * (r2 + 2 * v**2) + 2 * p2 * u * v,
    )


def pattern(u, v):
    """Linear colours of the directions (u, v, 1), ``(…, 3)``."""
    return np.stack([0.5 + 0.4 * np.sin(4 * u), 0.5 + 0.4 * np.cos(5 * v), 0.5 + 0.4 * np.sin(3 * (u + v))], axis=-1)


def photographs(folder, alpha=None, **lens):
    """Two views of :func:`pattern` through a lens, written as nerfstudio writes them."""
    (folder / "images").mkdir(exist_ok=True)
    focal, centre = np.array([50.0, 55.0]), np.array([33.0, 30.5])
    pixel = np.stack(np.meshgrid(np.arange(SIDE) + 0.5, np.arange(SIDE) + 0.5), axis=-1)
    point = seen = (pixel - centre) / focal
    for _ in range(200):  # the inverse, by fixed-point iterations
        point = point + 0.5 * (seen - np.stack(shown_at(point[..., 0], point[..., 1], **lens), axis=-1))
    colour = pattern(point[..., 0], point[..., 1])
    srgb = np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * colour ** (1 / 2.4) - 0.055)
    image = np.uint8(np.rint(255 * srgb))
    if alpha is not None:
        image = np.dstack([image, alpha])
    for i in range(2):
        Image.fromarray(image).save(folder / "images" / f"{i}.png")
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": pose(i)} for i in range(2)]
    names = [frame["file_path"] for frame in frames]
    write_json(
        folder / "transforms.json", w=SIDE, h=SIDE, fl_x=focal[0], fl_y=focal[1], cx=centre[0], cy=centre[1],
        camera_model="OPENCV", frames=frames, train_filenames=names, **lens,
    )  # fmt: skip
    u, v = np.moveaxis((pixel - centre) / focal, -1, 0)
    return u, v


def test_large_images_are_reduced(tmp_path, monkeypatch):
    """Pixels are averages of linear colours, and rays go through the middles of the areas that they cover."""
    blender = write_blender(tmp_path)
    large = write_image(blender / "train" / "r_0.png", 1, size=(7, 11))
    full = load_views(blender, downscale=1)
    monkeypatch.setattr(view_files, "LONGEST", 10)
    views = load_views(blender)
    assert views.sizes.tolist() == [[3, 5], [6, 8], [6, 8], [6, 8]] and not full.notes
    assert views.notes == ("images are reduced by the factor 2 along each side: option --downscale",)
    mean = full.image(0)[:6, :10].reshape(3, 2, 5, 2, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(views.image(0)[..., 3], mean[..., 3], atol=0.5 / 255 + 1e-6)
    known = mean[..., 3] > 0.4  # bytes are coarse where little is seen
    np.testing.assert_allclose(views.image(0)[known], mean[known], atol=0.01)
    assert np.array_equal(views.stored(1), full.stored(1)) and large.shape == (7, 11, 4)
    x, y = np.meshgrid(np.arange(5), np.arange(3))
    rays = captures.rays_of(views, 0, x, y)[1], captures.rays_of(full, 0, 2 * x + 0.5, 2 * y + 0.5)[1]
    np.testing.assert_allclose(*rays, atol=1e-12)
    assert load_views(blender, downscale=3).sizes.tolist() == [[2, 3], [2, 2], [2, 2], [2, 2]]
    refused(blender, r"r_1\.png: has 8 × 6 pixels, which cannot be reduced by the factor 7$", downscale=7)


@pytest.mark.parametrize("factor", [1, 2])
def test_alpha_masks_and_lenses_of_reduced_images(tmp_path, factor):
    alpha = np.full((SIDE, SIDE), 255, np.uint8)
    alpha[:, :20] = 0
    photographs(tmp_path, alpha, **LENS)
    mask = np.full((SIDE, SIDE), 255, np.uint8)
    mask[31:] = 0
    Image.fromarray(mask).save(tmp_path / "mask.png")
    change(tmp_path, "transforms.json", frame=1, mask_path="mask.png")
    views = load_views(tmp_path, downscale=factor)
    focal, centre = views.focal[0], views.centre[0]
    assert (factor * focal).tolist() == [50, 55] and (factor * centre).tolist() == [33, 30.5]
    x, y = np.meshgrid(np.arange(SIDE // factor) + 0.5, np.arange(SIDE // factor) + 0.5)
    u, v = (x - centre[0]) / focal[0], (y - centre[1]) / focal[1]
    x, y = shown_at(u, v, **LENS)
    x, y = 33 + 50 * x, 30.5 + 55 * y  # pixels of the photograph
    image, seen = views.image(0), x > 20 + factor
    assert (image[..., 3][x < 20 - factor] == 0).all() and (image[..., 3][seen] == 1).all()
    seen &= (np.abs(u) < 0.55) & (np.abs(v) < 0.5)
    assert seen.sum() > 300 and np.abs(image[..., :3] - pattern(u, v))[seen].max() < 0.01 * factor
    assert views.counted(0).all()
    np.testing.assert_array_equal(views.counted(1), y < 31 - 31 % factor)


@pytest.mark.parametrize("lens", [LENS, {"k1": 0.1, "k2": 0.02, "k3": 0.01, "k4": 0.05, "k5": 0.01, "k6": 0.002}])
def test_photographs_of_a_lens_become_those_of_a_pinhole(tmp_path, lens):
    u, v = photographs(tmp_path, **lens)
    views = load_views(tmp_path)
    assert views.notes == ("all images have a lens distortion and were undistorted",)
    counted = views.counted(1)
    x, y = shown_at(u, v, **lens)
    x, y = 33 + 50 * x, 30.5 + 55 * y  # pixels of the photograph
    np.testing.assert_array_equal(counted, (x >= 0) & (x <= SIDE) & (y >= 0) & (y <= SIDE))
    assert counted.mean() > 0.85
    error = np.abs(views.image(1)[..., :3] - pattern(u, v))
    inside = (x > 1) & (x < SIDE - 1) & (y > 1) & (y < SIDE - 1)
    assert error[inside].max() < 0.01 and not views.image(1)[~counted].any()
    change(tmp_path, "transforms.json", **dict.fromkeys(lens, 0))
    plain = load_views(tmp_path)
    assert not plain.notes and plain.mask is None
    assert np.abs(plain.image(1)[..., :3] - pattern(u, v))[inside].max() > 0.03


def test_a_lens_that_turns_back_is_cut_there(tmp_path):
    """r (1 − r²) has its maximum at the radius √⅓; farther out, the photograph would be seen mirrored."""
    u, v = photographs(tmp_path)
    change(tmp_path, "transforms.json", k1=-1.0)
    counted = load_views(tmp_path).counted(0)
    radius = np.hypot(u, v)
    assert counted[radius < 0.57].all() and not counted[radius > 0.58].any()


# -- backgrounds of one colour ----------------------------------------------------------------------------------------


@pytest.fixture
def studio_shots(tmp_path):
    """Two balls in front of a bright grey, without alpha; returns the folder and the bytes of all images by name."""
    captures.write(tmp_path, 6, 2)
    images = {}
    for path in sorted(tmp_path.glob("*.png")):
        with Image.open(path) as opened:
            values = np.array(opened)
        values[values[..., 3] == 0] = [240, 240, 235, 0]
        images[path.name] = values
        Image.fromarray(values[..., :3]).save(path)
    return tmp_path, images


def test_a_border_of_one_colour_is_the_background(studio_shots):
    folder, images = studio_shots
    values = images["train_2.png"]
    inside = np.argwhere(binary_erosion(values[..., 3] > 0))[0]
    values[tuple(inside)] = [240, 240, 235, 255]  # not connected with the border
    values[0, 0] = [237, 243, 235, 0]
    Image.fromarray(values[..., :3]).save(folder / "train_2.png")
    views = load_views(folder)
    assert views.background == (240, 240, 235) and views.settings == {"background": [240, 240, 235]}
    assert "(sRGB 240, 240, 235)" in views.notes[0] and views.has_alpha
    for view, name in enumerate(views.names):
        np.testing.assert_array_equal(views.stored(view), images[name] * (images[name][..., 3:] > 0))
    with_alpha = load_views(captures.write(folder / "alpha", 6, 2))
    np.testing.assert_allclose(object_box(views), object_box(with_alpha))
    session = FieldSession.load(llvm, folder)
    assert session.held_out.background == views.background and len(session.held_out) == 2
    # An empty field shows the background: no loss, and PSNR from the bytes of the files
    empty = Fog(llvm, 0)
    errors = [np.square((images[n][..., :3] - np.float64([240, 240, 235])) / 255) for n in session.held_out.names]
    expected = np.mean([-10 * np.log10(e.mean()) for e in errors])
    assert session.held_out_images.evaluate(empty)["psnr_white_db"] == pytest.approx(expected, abs=1e-3)
    loss = ImagesProblem(session, {}, lambda net: empty).loss({}, dr.rng(seed=0), 256)
    view, x, y = (a.numpy() for a in session.images.random_pixels(dr.rng(seed=0), 256 // RAYS))
    files = np.stack([images[name][..., :3] for name in views.names])[view, y, x]
    assert dr.sum(loss)[0] == pytest.approx(np.square((files - np.float64([240, 240, 235])) / 255).mean(), rel=1e-4)


def test_backgrounds_that_are_chosen(studio_shots):
    folder, images = studio_shots
    scene, black = (load_views(folder, background=name) for name in ("scene", "black"))
    assert scene.background is None and not scene.has_alpha and not scene.settings and not scene.notes
    assert black.background == (0, 0, 0) and black.has_alpha and not black.notes
    for views in (scene, black):
        opaque = np.dstack([images["train_1.png"][..., :3], np.full((24, 24), 255, np.uint8)])
        np.testing.assert_array_equal(views.stored(1), opaque)
    assert scene.digest != black.digest
    rng = np.random.default_rng(0)
    for name, values in images.items():  # surroundings
        Image.fromarray(np.uint8(values[..., :3] - rng.integers(0, 40, (24, 24, 1)))).save(folder / name)
    assert load_views(folder).background is None
    for name, values in images.items():
        Image.fromarray(values).save(folder / name)
    assert load_views(folder, background="white").notes == ("all images have alpha: the background is not used",)
    assert load_views(folder).background is None and not load_views(folder).notes


def test_an_alpha_of_one_everywhere_is_none(studio_shots):
    folder, images = studio_shots
    views = load_views(folder)
    for name, values in images.items():
        Image.fromarray(np.dstack([values[..., :3], np.full((24, 24), 255, np.uint8)])).save(folder / name)
    again = load_views(folder)
    assert again.background == views.background and again.digest == views.digest
    assert not load_views(folder, background="scene").has_alpha


def test_backgrounds_of_linear_images(studio_shots):
    folder, images = studio_shots
    views = load_views(folder)
    exr = views.image(0)
    exr[exr[..., 3] == 0] = [*np.float32(LINEAR[[240, 240, 235]]), 1]
    (folder / "train_0.png").unlink()
    write_exr(folder / "train_0.exr", {"RGB": np.ascontiguousarray(exr[..., :3])})
    content = (folder / "transforms_train.json").read_text()
    (folder / "transforms_train.json").write_text(content.replace("train_0.png", "train_0.exr"))
    again = load_views(folder)
    assert again.background == views.background and again.pixels.shape[1] == 2
    np.testing.assert_array_equal(again.image(0)[..., 3] > 0, images["train_0.png"][..., 3] > 0)
    np.testing.assert_allclose(again.image(0), views.image(0), atol=1e-3)


def test_masked_borders_are_no_background(studio_shots):
    """Masked pixels at the border do not decide on the background, and the background spreads through them."""
    folder, images = studio_shots
    mask = np.full((24, 24), 255, np.uint8)
    mask[:, :3] = mask[:3] = mask[-3:] = mask[:, -3:] = 0
    Image.fromarray(mask).save(folder / "mask.png")
    content = json.loads((folder / "transforms_train.json").read_text())
    for frame in content["frames"]:
        frame["mask_path"] = "mask.png"
        values = images[frame["file_path"]].copy()
        values[mask == 0] = 17
        Image.fromarray(values[..., :3]).save(folder / frame["file_path"])
    write_json(folder / "transforms_train.json", **content)
    assert load_views(folder).background is None  # no border is left
    views = load_views(folder, background=(240, 240, 235))
    counted = mask > 0
    for view, name in enumerate(views.names):
        np.testing.assert_array_equal(views.stored(view)[counted][:, 3], images[name][counted][:, 3])


def test_a_field_records_its_background(studio_shots, monkeypatch, capsys):
    """The file records the background; notes on training and test views are printed and written as JSON."""
    folder, _ = studio_shots
    change(folder, aabb_scale=4)
    change(folder, "transforms_test.json", frame=1, sharpness=3)
    (folder / "train_4.png").unlink()
    options = ["--preset", "grid", "--steps", "40", "--resolution", "12", "--batch", "256"]
    monkeypatch.setattr(view_files, "SEARCH", 24)
    monkeypatch.setattr(grids, "VISIBLE", 0.0)
    options += ["--variant", "llvm_ad_rgb", "--json", str(folder / "x.json")]
    assert main(["fit", "field", str(folder), "-o", str(folder / "x.npz"), *options]) == 0
    notes = [line for line in capsys.readouterr().err.splitlines() if line.startswith("transforms_")]
    assert notes == [
        "transforms_train.json: keys that are not used: aabb_scale",
        'transforms_train.json: 1 of 6 images of the split "train" do not exist and are left out, such as train_4.png',
        "transforms_test.json: keys that are not used: frames.sharpness",
    ]
    assert set(notes) < set(json.loads((folder / "x.json").read_text())["notes"])
    model = tasks()["field"].open(llvm.TensorXf, folder / "x.npz")
    assert model.table.settings["background"] == [240, 240, 235]
    measured = model.table.measured["psnr_white_db"]
    assert model.measure()["psnr_white_db"] == pytest.approx(measured, abs=1e-3)
    model.table.settings.pop("background")
    assert model.measure()["psnr_white_db"] != pytest.approx(measured, abs=1e-2)


# -- COLMAP -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def colmap(tmp_path):
    """Ten views of a model as text, written line by line, and the poses that they should have."""
    pytest.importorskip("pycolmap", reason="pycolmap reads COLMAP's models")
    (tmp_path / "images" / "left").mkdir(parents=True)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    poses, lines = [], []
    for i in range(10):
        write_image(tmp_path / "images" / "left" / f"{i}.png", i, channels=3)
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec([0.1 * i, 0.5, -0.2 * i]).as_matrix()
        matrix[:3, 3] = 2 - i, 1, 4
        poses.append(matrix)
        world_to_camera = np.linalg.inv(matrix @ np.diag([1, -1, -1, 1]))  # y downwards, along z
        turn = Rotation.from_matrix(world_to_camera[:3, :3]).as_quat(scalar_first=True)
        numbers = *turn, *world_to_camera[:3, 3]
        # Numbers of images are not in the order of names; each sees the points 1 and 2, two see 7
        camera = " ".join(map(repr, map(float, numbers)))
        seventh = 7 if i in (1, 2) else -1
        lines.append(f"{100 - i} {camera} {1 + i % 2} left/{i}.png\n1 1 1 2 2 2 3 3 {seventh}\n")
    model = tmp_path / "sparse" / "0"
    (model / "cameras.txt").write_text("1 OPENCV 8 6 10 11 4.5 3.25 0 0 0 0\n2 SIMPLE_PINHOLE 8 6 9 4 3\n")
    (model / "images.txt").write_text("# Image list\n" + "".join(lines))
    tracks = " ".join(f"{100 - i} {{0}}" for i in range(10))
    (model / "points3D.txt").write_text(
        "".join(f"{n + 1} {x} {2 * x} {-x} 1 2 3 0.5 {tracks.format(n)}\n" for n, x in enumerate((-1, 3)))
        + "7 100 100 100 1 2 3 0.5 98 2 99 2\n"  # two images only
    )
    return tmp_path, np.array(poses)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_colmap_models(colmap, place):
    folder, poses = colmap
    binary = folder / "other"
    binary.mkdir()
    import pycolmap

    pycolmap.Reconstruction(str(folder / "sparse" / "0")).write_binary(str(binary))
    shutil.rmtree(folder / "sparse")
    (folder / place).parent.mkdir(parents=True, exist_ok=True)
    binary.rename(folder / place)
    train, test = load_views(folder), load_views(folder, "test")
    assert test.names == ("images/left/0.png", "images/left/8.png") and len(train) == 8
    np.testing.assert_allclose(test.poses, poses[[0, 8]], atol=1e-9)
    np.testing.assert_allclose(train.poses[:3], poses[1:4], atol=1e-9)
    assert train.focal[:2].tolist() == [[9, 9], [10, 11]] and train.centre[:2].tolist() == [[4, 3], [4.5, 3.25]]
    # 98% of the extents of two points, and a margin of 5% of the longest
    np.testing.assert_allclose(train.box, [[-1.352, -2.312, -3.352], [3.352, 6.312, 1.352]], atol=1e-9)
    refused(folder, r'has no views for the split "val"$', "val")
    for i in range(10):
        write_image(folder / "images" / "left" / f"{i}.png", i)
    assert load_views(folder).box is None


def test_colmap_text_distortion_and_masks(colmap):
    folder, poses = colmap
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text("1 RADIAL 8 6 10 4.5 3.25 -0.1 0.02\n2 SIMPLE_RADIAL 8 6 9 4 3 0\n")
    (folder / "masks" / "left").mkdir(parents=True)
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(folder / "masks" / "left" / "3.png.png")
    views = load_views(folder)
    assert views.notes == ("3 of 8 images have a lens distortion and were undistorted",)
    np.testing.assert_allclose(views.poses[0], poses[1], atol=1e-9)
    assert not views.counted(2).any() and views.counted(0).all()
    write_json(folder / "transforms.json", frames=[])
    refused(folder, r'transforms\.json: has no "frames"')


def test_colmap_models_that_are_refused(colmap, monkeypatch):
    folder, _ = colmap
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text("1 OPENCV_FISHEYE 8 6 10 11 4.5 3.25 0 0 0 0\n2 PINHOLE 8 6 9 9 4 3\n")
    refused(folder, '"left/2.png" has the camera model OPENCV_FISHEYE, .*: undistort the')
    cameras.write_text("1 OPENCV x\n")
    refused(folder, r"sparse/0: cannot be read as a COLMAP model \(")
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    refused(folder, r"sparse/0: is a COLMAP model, .*: pip install pycolmap$")
