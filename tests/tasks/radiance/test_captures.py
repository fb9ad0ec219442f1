"""Lists of views of NeRF's Blender data, nerfstudio, instant-ngp and BlenderNeRF: spellings, masks, and refusals."""

import json
import math

import drjit.llvm.ad as llvm
import numpy as np
import pytest
from captures import SIZE, change, pose, refused, write_blender, write_exr, write_image, write_json
from PIL import Image

from mi_diffind.tasks.radiance.session import FieldSession
from mi_diffind.tasks.radiance.views import ViewsError, load_views

#: Keys of the focal lengths 10 and 12 of images of 8 × 6 pixels, and of a centre and a lens.
PIXELS = {"fl_x": 10.0, "fl_y": 12}
ANGLES = {"camera_angle_x": 2 * math.atan(0.4), "camera_angle_y": 2 * math.atan(0.25)}
DEGREES = {"x_fov": 2 * math.degrees(math.atan(0.4)), "y_fov": 2 * math.degrees(math.atan(0.25))}
CENTRE = {"cx": 4.5, "cy": 3.25}
LENS = {"k1": -0.12, "k2": 0.03, "k3": 0.01, "p1": 0.004, "p2": -0.003}
LISTED = {"distortion_params": [-0.12, 0.03, 0.01, 0.0, 0.004, -0.003]}
ZERO = {"distortion_params": [0] * 6}
WRONG = {"fl_x": 77, "fl_y": 78, "cx": 1, "cy": 2}


def studio(folder, of_file, of_frames, views=3):
    """Views that the list ``train_filenames`` names, with these keys of the file and of each frame."""
    (folder / "images").mkdir(exist_ok=True)
    frames = []
    for i in range(views):
        write_image(folder / "images" / f"{i}.png", i, channels=3)
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose(i)} | of_frames)
    names = [frame["file_path"] for frame in frames]
    write_json(folder / "transforms.json", frames=frames, train_filenames=names, **of_file)
    return folder


@pytest.mark.parametrize(
    ("of_file", "of_frames", "focal", "centre"),
    [
        (PIXELS | CENTRE | {"w": 8, "h": 6.0}, {}, (10, 12), (4.5, 3.25)),
        ({}, PIXELS | CENTRE | {"w": 8.0, "h": 6}, (10, 12), (4.5, 3.25)),
        (WRONG, PIXELS | CENTRE, (10, 12), (4.5, 3.25)),
        (CENTRE, PIXELS, (10, 12), (4.5, 3.25)),
        (ANGLES, {}, (10, 12), (4, 3)),
        (WRONG, ANGLES | CENTRE, (10, 12), (4.5, 3.25)),
        (DEGREES, CENTRE, (10, 12), (4.5, 3.25)),
        (ANGLES | {"camera_angle_x": 0.1}, DEGREES, (10, 12), (4, 3)),
        (PIXELS | ANGLES | DEGREES, {}, (10, 12), (4, 3)),
        ({"fl_x": 10}, {}, (10, 10), (4, 3)),
        ({"fl_x": 10, "camera_angle_y": ANGLES["camera_angle_y"]}, {}, (10, 12), (4, 3)),
        ({"camera_angle_x": ANGLES["camera_angle_x"]}, {}, (10, 10), (4, 3)),
        ({"x_fov": DEGREES["x_fov"]}, {"cy": 2}, (10, 10), (4, 2)),
        (PIXELS | {"cx": None, "k1": None, "is_fisheye": None}, {}, (10, 12), (4, 3)),
        (PIXELS | ZERO | {"camera_model": "SIMPLE_PINHOLE", "is_fisheye": False}, {}, (10, 12), (4, 3)),
        (PIXELS | {"camera_model": "OPENCV", "k1": 0, "k2": 0.0, "k3": 0, "k4": 0}, {}, (10, 12), (4, 3)),
        (PIXELS | {"camera_model": "pinhole"}, {"camera_model": "RADIAL"}, (10, 12), (4, 3)),
    ],
)  # fmt: skip
def test_spellings_of_focal_lengths(tmp_path, of_file, of_frames, focal, centre):
    views = load_views(studio(tmp_path, of_file, of_frames))
    np.testing.assert_allclose(views.focal, [focal] * 3)
    np.testing.assert_allclose(views.centre, [centre] * 3)
    assert views.mask is None and not any("lens" in note or "field of view" in note for note in views.notes)


@pytest.mark.parametrize(
    ("of_file", "of_frames"),
    [
        (LISTED, {}),
        ({}, LISTED),
        ({}, LENS),
        (ZERO, LENS),
        ({"k1": 0.3, "k2": 0.1}, LISTED),
        ({"k1": LENS["k1"], "k2": LENS["k2"]}, {"k3": LENS["k3"], "p1": LENS["p1"], "p2": LENS["p2"]}),
        (LISTED | {"camera_model": "OPENCV", "is_fisheye": False}, {}),
        (LENS | {"k4": 0.0, "camera_model": "opencv"}, {}),
    ],
)  # fmt: skip
def test_spellings_of_lenses(tmp_path, of_file, of_frames):
    """The images are those of the same coefficients by their names."""
    (tmp_path / "names").mkdir()
    expected = load_views(studio(tmp_path / "names", PIXELS | LENS, {}))
    views = load_views(studio(tmp_path, PIXELS | of_file, of_frames))
    assert "all images have a lens distortion and were undistorted" in views.notes
    assert np.array_equal(views.pixels, expected.pixels) and np.array_equal(views.mask, expected.mask)
    plain = load_views(studio(tmp_path / "names", PIXELS, {}))
    assert not np.array_equal(plain.pixels, views.pixels) and not plain.notes


def shear():
    matrix = np.array(pose())
    matrix[0, 1] = 0.04
    matrix[:, 1] /= np.linalg.norm(matrix[:3, 1])
    return matrix.tolist()


#: Keys of a file or of a frame → what is said.
REFUSED_CAMERAS = [
    *(
        ({"camera_model": name}, f"has the camera model '{name}', allowed are PINHOLE, .*: undistort the images")
        for name in ("OPENCV_FISHEYE", "EQUIRECTANGULAR", "FISHEYE624", "ORTHOPHOTO", "VR180_L", "RADIAL_FISHEYE")
    ),
    ({"is_fisheye": True, "camera_model": "OPENCV"}, "has the camera model 'fisheye'"),
    ({"latlong": True}, "has the camera model 'latlong'"),
    ({"equirectangular": True}, "has the camera model 'equirectangular'"),
    ({"orthographic": True}, "has the camera model 'orthographic'"),
    ({"ftheta_p0": 0.1}, "has the camera model 'f-theta'"),
    ({"distortion_params": [0.1, 0.2, 0, 0]}, r'has the "distortion_params" \[0.1, 0.2, 0, 0\], expected the list'),
    ({"distortion_params": {"k1": 0.1}}, r"expected the list \[k1, k2, k3, k4, p1, p2\] of nerfstudio"),
    ({"distortion_params": [0.1, "0.2", 0, 0, 0, 0]}, "has the \"k2\" '0.2', expected a number"),
    ({"distortion_params": [0, 0, 0, 0.01, 0, 0]}, r"has the distortion k4 = 0.01, which nerfstudio multiplies"),
    ({"k1": 0.1, "k4": 0.01}, r"has the distortion k4 = 0.01, which nerfstudio multiplies by r⁸"),
    ({"fl_x": None, "x_fov": 180}, r'has the "x_fov" 180, expected degrees between 0 and 180'),
    ({"camera_model": ["PINHOLE"]}, r"has the camera model \['PINHOLE'\], allowed are"),
    ({"k1": "0.02"}, "has the \"k1\" '0.02', expected a number"),
    ({"fl_x": None}, "has no focal length"),
    ({"fl_x": 0}, 'has the "fl_x" 0, expected a number > 0'),
    ({"camera_angle_x": 4.0}, 'has the "camera_angle_x" 4, expected radians'),
    ({"camera_angle_x": 1e-320}, 'has the "camera_angle_x" .*, expected radians between 1e-06 and π'),
    ({"cx": 1e308}, 'has the "cx" 1e\\+308, expected a number between -1e\\+09 and 1e\\+09'),
    ({"k2": -1e300}, 'has the "k2" -1e\\+300, expected a number between'),
    ({"k1": -1e6, "cx": -900.0}, r"transforms\.json: no pixel counts: masks or lens distortions exclude all of 3 i"),
    ({"w": 16}, "has 8 × 6 pixels, .*json says 16 × 6"),
]  # fmt: skip

#: Keys of all frames → what is said.
REFUSED_FRAMES = [
    ({"file_path": ""}, 'frame 0 has no "file_path"'),
    ({"mask_path": 3}, 'frame 0 has a "mask_path" that is no name of a file$'),
    ({"mask_path": "mask.png"}, r"mask\.png: no such image"),
    ({"mask_path": "small.png"}, r"small\.png: has 3 × 3 pixels, its image 0\.png has 8 × 6$"),
    ({"mask_path": "broken.png"}, r"broken\.png: cannot be read as an image"),
    ({"transform_matrix": None}, 'frame "images/0.png" has no "transform_matrix"'),
    ({"transform_matrix": pose(np.nan)}, "with NaN or infinite numbers"),
    ({"transform_matrix": pose(0, 0.5)}, r"that scales \(columns of length 0.5, 0.5, 0.5\)"),
    ({"transform_matrix": shear()}, "that shears"),
    ({"transform_matrix": (np.array(pose()) * [1, 1, -1, 1]).tolist()}, "that mirrors"),
    ({"transform_matrix": np.eye(3).tolist()}, r"of the shape \(3, 3\), expected \(4, 4\)"),
    ({"transform_matrix": [[1, 2], [3]]}, "that is not a matrix of numbers"),
    ({"transform_matrix": np.ones((4, 4)).tolist()}, "whose last row is not 0, 0, 0, 1"),
]

#: Keys of a file → what is said.
REFUSED_FILES = [
    *(({"aabb": box}, r'transforms\.json: has the "aabb" .*, expected two corners')
      for box in ([[0, 0, 0], [1, 1, 0]], [0, 1], [[0, 0, 0], [1, "a", 1]])),
    ({"frames": []}, 'has no "frames"'),
]  # fmt: skip


@pytest.mark.parametrize(
    ("of_file", "of_frames", "message"),
    [
        *((keys, {}, message) for keys, message in REFUSED_CAMERAS + REFUSED_FILES),
        *(({}, keys, message) for keys, message in REFUSED_CAMERAS + REFUSED_FRAMES),
    ],
)
def test_lists_that_are_refused(tmp_path, of_file, of_frames, message):
    studio(tmp_path, {} if of_frames else PIXELS, PIXELS | of_frames if of_frames else {})
    change(tmp_path, "transforms.json", **of_file)
    Image.fromarray(np.zeros((3, 3), np.uint8)).save(tmp_path / "small.png")
    (tmp_path / "broken.png").write_bytes(b"no")
    with pytest.raises(ViewsError, match=message) as e:
        load_views(tmp_path)
    assert "\n" not in str(e.value) and str(tmp_path) in str(e.value)


def test_files_that_are_refused(tmp_path):
    """Images, lists that are no JSON, and folders."""
    path = studio(tmp_path, PIXELS, {}) / "images" / "1.png"
    data = path.read_bytes()
    for broken in (data[: len(data) // 2], b"", b"not an image", data[:40] + b"\0" * 40 + data[80:]):
        path.write_bytes(broken)
        refused(tmp_path, r"1\.png: (cannot be read as an image|is cut short)")
    path.unlink()
    path = path.with_suffix(".exr")
    path.write_bytes(b"no")
    change(tmp_path, "transforms.json", frame=1, file_path="images/1")
    change(tmp_path, "transforms.json", train_filenames=None)
    refused(tmp_path, r"1\.exr: cannot be read as an image")
    write_exr(path, {"Z": np.zeros(SIZE, np.float32)})
    refused(tmp_path, r"has the channels Z, expected R, G, B or Y, and A")
    for broken in ("{", "[1, 2]", "{}"):
        (tmp_path / "transforms.json").write_text(broken)
        refused(tmp_path, r"transforms\.json: (is not valid JSON|has no \"frames\")")
    refused(tmp_path / "missing", r"missing: no such folder$")
    refused(tmp_path / "transforms.json", r"json: is not a folder$")
    refused(tmp_path / "images", r"holds no views: neither transforms_train\.json nor transforms\.json")
    refused(studio(tmp_path, PIXELS, {}, 1), r"has 1 view for training, at least 2 are needed")
    with pytest.raises(ValueError, match=r'split: found "all", allowed are train, test, val'):
        load_views(tmp_path, "all")


def test_a_principal_point_in_shares_of_the_image_is_named(tmp_path):
    (note,) = load_views(studio(tmp_path, PIXELS | {"cx": 0.56, "cy": 0.54}, {})).notes
    assert '"cx" and "cy" in pixels are expected' in note and "(0.56, 0.54) of 0.png" in note
    assert not load_views(studio(tmp_path, PIXELS | {"cx": 5.5, "cy": 2.0}, {})).notes


def test_fields_of_view_that_contradict_focal_lengths_are_noted(tmp_path):
    views = load_views(studio(tmp_path, PIXELS | {"camera_angle_x": ANGLES["camera_angle_x"] * 1.02}, {}))
    assert views.focal[0].tolist() == [10, 12]
    (note,) = views.notes
    assert note.startswith(
        'transforms.json: the field of view 0.7762 ("camera_angle_x") would be a focal length of 9.7'
    )


# -- poses ------------------------------------------------------------------------------------------------------------


def test_spellings_of_poses(tmp_path):
    turned = np.array(pose(7.0))
    turned[:3, :3] = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
    turned[:3, :3] *= np.sign(np.linalg.det(turned[:3, :3]))
    studio(tmp_path, PIXELS, {})

    content = json.loads((tmp_path / "transforms.json").read_text())

    def read(**keys):
        content["frames"][1] = {"file_path": "images/1.png"} | keys
        write_json(tmp_path / "transforms.json", **content)
        return load_views(tmp_path)

    for matrix in (turned, turned[:3]):
        views = read(transform_matrix=matrix.tolist())
        np.testing.assert_allclose(views.poses[1], turned)
        assert not views.notes
    near = pose(2, 1.0008)  # within the tolerance of lengths, and no shear
    assert np.array_equal(read(transform_matrix=near).poses[1], near)


def test_poses_of_mitsuba(tmp_path):
    """instant-ngp's ``from_mitsuba``: cameras look along +z, with x to the left, as Mitsuba's ``look_at`` says."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    matrix = np.array(mi.ScalarTransform4f().look_at(origin=[3, 1, 2], target=[0, 0.5, 0], up=[0, 1, 0]).matrix)
    studio(tmp_path, PIXELS | {"from_mitsuba": True}, {"transform_matrix": matrix.tolist()})
    camera = load_views(tmp_path).poses[0]
    np.testing.assert_allclose(camera[:3, 3], [3, 1, 2])
    forward = np.array([-3, -0.5, -2]) / np.linalg.norm([3, 0.5, 2])
    np.testing.assert_allclose(-camera[:3, 2], forward, atol=1e-6)
    np.testing.assert_allclose(camera[:3, 0], np.cross(forward, [0, 1, 0]) / np.hypot(*forward[[0, 2]]), atol=1e-6)
    change(tmp_path, "transforms.json", from_mitsuba=False)
    np.testing.assert_allclose(load_views(tmp_path).poses[0], matrix, atol=1e-6)


def test_nerfstudio_layout(tmp_path):
    studio(tmp_path, PIXELS | CENTRE | {"w": 8, "h": 6, "k1": 0.0, "applied_transform": np.eye(4)[:3].tolist()}, {}, 10)
    change(tmp_path, "transforms.json", train_filenames=None)
    train, test = load_views(tmp_path), load_views(tmp_path, "test")
    assert test.names == ("images/0.png", "images/8.png") and len(train) == 8 and not train.has_alpha
    assert np.array_equal(train.poses[0], pose(1))
    assert train.settings == {"applied_transform": np.eye(4)[:3].tolist()}
    listed = [f"images/{i}.png" for i in range(10)]
    change(tmp_path, "transforms.json", applied_transform=None, train_filenames=listed[3:], test_filenames=listed[:2])
    assert load_views(tmp_path, "test").names == tuple(listed[:2])
    again = load_views(tmp_path)
    assert len(again) == 7 and again.settings == {} and np.array_equal(again.poses[0], pose(3))
    refused(tmp_path, r'has no list "val_filenames"', "val")
    change(tmp_path, "transforms.json", test_filenames=["images/other.png"])
    refused(tmp_path, r"test_filenames\" names 'images/other.png', which is not among the frames$", "test")


def test_blender_layout(tmp_path):
    blender = write_blender(tmp_path)
    views = load_views(blender)
    assert len(views) == 4 and np.array_equal(views.sizes, [SIZE] * 4) and views.pixels.nbytes == 4 * 4 * 6 * 8
    assert views.names == tuple(f"train/r_{i}.png" for i in range(4)) and views.has_alpha and views.box is None
    assert np.array_equal(views.poses, [pose(i) for i in range(4)]) and np.array_equal(views.origins[:, 0], range(4))
    assert np.allclose(views.focal, 4 / np.tan(0.35)) and np.array_equal(views.centre[0], [4, 3])
    assert len(load_views(blender, "test")) == 2
    refused(blender, r"transforms_val\.json: no such file$", "val")
    assert load_views(blender).digest == views.digest != load_views(blender, "test").digest
    change(blender, aabb=[[-1, 0, -1], [1, 2, 1]])
    assert np.array_equal(load_views(blender).box, [[-1, 0, -1], [1, 2, 1]])
    (blender / "transforms_test.json").unlink()
    assert load_views(blender).names == tuple(f"train/r_{i}.png" for i in (1, 2, 3))
    assert load_views(blender, "test").names == ("train/r_0.png",)


# -- names of images and splits ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("./images/a.png", "images/a.png"), ("images/a", "images/a.png"), ("images\\a.png", "images/a.png"),
        (".\\images\\a", "images/a.png"), ("images/a.png", "images/a.PNG"), ("images/a.JPG", "images/a.jpg"),
        ("images/a", "images/A.JPG"), ("images/a.jpg", "images/a.jpeg"), ("images/A.JPEG", "images/a.jpg"),
        ("images/a.b", "images/a.b.png"), ("images/./a.png", "images/a.png"),
        ("Images\\A.png", "images/a.png"),
    ],
)  # fmt: skip
def test_spellings_of_names(tmp_path, name, file):
    studio(tmp_path, PIXELS, {})
    values = np.full((*SIZE, 3), 200, np.uint8)
    Image.fromarray(values).save(tmp_path / file)
    change(tmp_path, "transforms.json", frame=1, file_path=name)
    change(tmp_path, "transforms.json", train_filenames=["images/0.png", name.replace("\\", "/").removeprefix("./")])
    views = load_views(tmp_path)
    assert views.names == ("images/0.png", file) and np.abs(views.stored(1)[..., :3].astype(int) - 200).max() <= 2


def test_two_files_of_one_name_are_none(tmp_path):
    studio(tmp_path, PIXELS, {})
    change(tmp_path, "transforms.json", frame=1, file_path="images/A.png")
    change(tmp_path, "transforms.json", train_filenames=None)
    assert (tmp_path / "images" / "a.PNG").write_bytes(b"x") and (tmp_path / "images" / "a.pnG").write_bytes(b"x")
    (tmp_path / "images" / "3.png").write_bytes((tmp_path / "images" / "0.png").read_bytes())
    content = json.loads((tmp_path / "transforms.json").read_text())
    content["frames"].append(content["frames"][0] | {"file_path": "images/3.png"})
    write_json(tmp_path / "transforms.json", **content)
    assert load_views(tmp_path).names == ("images/2.png", "images/3.png")


def test_views_for_a_validation_are_test_views_where_there_are_no_others(tmp_path):
    studio(tmp_path, PIXELS, {}, views=5)
    names = [f"images/{i}.png" for i in range(5)]
    change(tmp_path, "transforms.json", train_filenames=names[:3], val_filenames=[f"./{n}" for n in names[3:]])
    assert load_views(tmp_path, "test").names == load_views(tmp_path, "val").names == tuple(names[3:])
    content = json.loads((tmp_path / "transforms.json").read_text())
    for split, frames in (("train", content["frames"][:3]), ("val", content["frames"][3:])):
        write_json(tmp_path / f"transforms_{split}.json", frames=frames, **PIXELS)
    assert load_views(tmp_path).names == tuple(names[:3])
    assert load_views(tmp_path, "test").names == load_views(tmp_path, "val").names == tuple(names[3:])
    (tmp_path / "transforms_val.json").rename(tmp_path / "transforms_test.json")
    assert load_views(tmp_path, "test").names == tuple(names[3:])


# -- missing images ---------------------------------------------------------------------------------------------------


def test_views_without_images_are_left_out(tmp_path):
    studio(tmp_path, PIXELS, {}, views=12)
    change(tmp_path, "transforms.json", train_filenames=None)
    for i in (3, 4, 5, 9):
        (tmp_path / "images" / f"{i}.png").unlink()
    views = load_views(tmp_path)
    assert views.names == tuple(f"images/{i}.png" for i in (1, 2, 6, 7, 10, 11))
    np.testing.assert_array_equal(views.origins[:, 0], [1, 2, 6, 7, 10, 11])
    assert views.notes == (
        'transforms.json: 4 of 10 images of the split "train" do not exist and are left out, such as images/3.png',
    )
    assert load_views(tmp_path, most=3).names == tuple(f"images/{i}.png" for i in (1, 6, 10))
    for i in (0, 8):
        (tmp_path / "images" / f"{i}.png").unlink()
    refused(tmp_path, r'0\.png: no such image, transforms.json names it; 2 of 2 images of the split "t', "test")
    session = FieldSession.load(llvm, tmp_path)
    assert not session.has_test_views and len(session.held_out) == 6
    assert len(session.notes) == 2 and session.notes[1].startswith("no test views: ")
    for i in (1, 2, 6, 7, 10):
        (tmp_path / "images" / f"{i}.png").unlink()
    refused(tmp_path, r'9 of 10 images of the split "train" do not exist, at least 2 are needed$')


# -- masks ------------------------------------------------------------------------------------------------------------


def masked(folder, name="mask.png"):
    """Three views with the same mask."""
    studio(folder, PIXELS, {"mask_path": name} if name else {})
    return load_views(folder)


@pytest.mark.parametrize("colour", [0, 255, None])
def test_masks_in_an_alpha_channel(tmp_path, colour):
    """The mask is read from alpha for any colours, those of a cut-out photograph included."""
    counts = np.random.default_rng(0).random(SIZE) < 0.6
    image = np.random.default_rng(1).integers(0, 256, (*SIZE, 4), np.uint8)
    if colour is not None:
        image[..., :3] = colour
    image[..., 3] = 255 * counts
    Image.fromarray(image).save(tmp_path / "mask.png")
    views = masked(tmp_path)
    np.testing.assert_array_equal(views.counted(1), counts)
    assert views.notes == ("the masks of 3 images are those of their alpha",)
    image[..., 3], image[..., :3] = 255, 255 * counts[..., None]  # an alpha of 1 holds nothing
    Image.fromarray(image).save(tmp_path / "mask.png")
    views = masked(tmp_path)
    np.testing.assert_array_equal(views.counted(1), counts)
    assert not views.notes


def test_masks_of_other_formats(tmp_path):
    counts = np.zeros(SIZE, bool)
    counts[:, 3:] = True
    Image.fromarray(np.uint8(255 * counts)).save(tmp_path / "mask.jpg", quality=30)
    assert np.array(Image.open(tmp_path / "mask.jpg"))[~counts].max() > 0  # black is not exact
    Image.fromarray(np.uint16(counts)).save(tmp_path / "sixteen.png")
    Image.fromarray(counts).save(tmp_path / "bits.png")
    palette = Image.fromarray(np.uint8(counts), "P")
    palette.putpalette([0, 0, 0, 128, 0, 0])
    palette.save(tmp_path / "labels.png")
    for name in ("mask.jpg", "sixteen.png", "bits.png", "labels.png"):
        np.testing.assert_array_equal(masked(tmp_path, name).counted(0), counts, err_msg=name)
    Image.fromarray(np.uint8(255 * counts)).save(tmp_path / "images" / "dynamic_mask_1.png")
    views = masked(tmp_path, "")
    np.testing.assert_array_equal(views.counted(1), ~counts)  # instant-ngp's are white where nothing counts
    assert views.counted(0).all()


# -- keys that are not used -------------------------------------------------------------------------------------------


def test_keys_that_are_not_used_are_named(tmp_path):
    """The note names unused keys of the file and of its frames, and lenses that a frame replaces."""
    unused = {"aabb_scale": 16, "rolling_shutter": [0, 0, 0], "distortion_params": [0] * 6, "k1": 0.2}
    (note,) = load_views(studio(tmp_path, PIXELS | unused, {"sharpness": 20.0} | LISTED)).notes[:1]
    assert note == f"transforms.json: keys that are not used: frames.sharpness, {', '.join(unused)}"
    used = PIXELS | ANGLES | CENTRE | LENS | {"w": 8, "h": 6, "camera_model": "OPENCV", "is_fisheye": False}
    used |= {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 2.0, "aabb": [[0, 0, 0], [1, 1, 1]]}
    assert load_views(studio(tmp_path, used, {})).notes == ("all images have a lens distortion and were undistorted",)
    # Of a key that only a frame of another split has, nothing is said
    change(tmp_path, "transforms.json", frame=1, sharpness=3)
    change(tmp_path, "transforms.json", train_filenames=["images/0.png", "images/2.png"])
    assert len(load_views(tmp_path).notes) == 1
