"""Reading images with poses: Blender's and nerfstudio's layout, what pixels mean, and what is refused in a sentence."""

import dataclasses
import itertools
import json

import captures
import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from captures import SIZE, change, pose, refused, write_blender, write_exr, write_image
from PIL import Image
from radiance_fields import Fog
from texture_scenes import linear

from mi_diffind.images import srgb
from mi_diffind.tasks.radiance import session
from mi_diffind.tasks.radiance.session import TILE, FieldSession, ImagesProblem, ViewImages
from mi_diffind.tasks.radiance.views import hull, load_views


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_compressed_views_are_the_same(blender, suffix):
    """Compressed views equal the views that they were made of, and so do some of them, for PNG and EXR."""
    if suffix == "exr":
        image = np.random.default_rng(0).uniform(size=(*SIZE, 4)).astype(np.float32)
        write_exr(blender / "train/r_1.exr", {"RGBA": image})
        listed = json.loads((blender / "transforms_train.json").read_text())["frames"]
        listed[1]["file_path"] = "./train/r_1.exr"
        change(blender, "transforms_train.json", frames=listed)
    views = load_views(blender)
    packed = views.compressed()
    assert packed.digest == views.digest and packed.pixels.size == 0
    few = packed.chosen(np.array([3, 1]))
    assert few.names == (views.names[3], views.names[1])
    np.testing.assert_array_equal(few.image(1), views.image(1))


def test_a_limit_of_pixels_leaves_out_held_out_views(blender):
    """Two views at least; the views that are trained by are complete."""
    height, width = SIZE
    for pixels in (None, 100 * height * width, 1):
        session = FieldSession.load(llvm, blender, pixels)
        assert (len(session.views), len(session.held_out)) == (4, 2)
        assert len(session.watched_images.views) == (2 if pixels is None else 1)
    change(
        blender, "transforms_test.json", frames=json.loads((blender / "transforms_train.json").read_text())["frames"]
    )
    session = FieldSession.load(llvm, blender, 3 * height * width)
    assert session.held_out.names == ("train/r_0.png", "train/r_1.png", "train/r_2.png")
    assert session.seeing_images is session.images


@pytest.fixture
def blender(tmp_path):
    return write_blender(tmp_path)


def test_pixels_are_linear_and_multiplied_by_alpha(blender):
    stored = write_image(blender / "train" / "r_0.png", 7)
    image = load_views(blender).image(0)
    for y, x in ((0, 0), (2, 5), (5, 7)):
        *colour, alpha = (int(v) for v in stored[y, x])
        expected = [linear(c / 255) * alpha / 255 for c in colour]
        assert image[y, x] == pytest.approx([*expected, alpha / 255], abs=1e-6)


def assert_colours_are_images(views):
    """Colours that a training reads, and all pixels of random patches, against the decoded images."""
    images = ViewImages(llvm, views)
    for v in range(len(views)):
        height, width = views.sizes[v]
        y, x = np.mgrid[:height, :width].astype(np.uint32)
        read = images.colours(llvm.UInt32(v), llvm.UInt32(x.ravel()), llvm.UInt32(y.ravel())).numpy().T
        np.testing.assert_allclose(read.reshape(height, width, 4), views.image(v), rtol=2e-7)
    view, x, y = (a.numpy() for a in images.random_pixels(dr.rng(seed=0), 32768))
    assert np.array_equal(np.unique(view), range(len(views)))
    for v in range(len(views)):
        seen = np.zeros(views.sizes[v], bool)
        seen[y[view == v], x[view == v]] = True
        assert seen.all()


def test_patches_lie_where_something_is_seen(blender):
    """Nearly all patches lie in or beside tiles that show something; with a mask of all pixels, they lie anywhere."""
    stored = np.zeros((64, 48, 4), np.uint8)
    stored[30:33, 5:7] = 255  # in the tiles (0, 3) and (0, 4)
    for i in range(4):
        write_image(blender / "train" / f"r_{i}.png", i, size=(64, 48))
        Image.fromarray(stored * (i == 2)).save(blender / "train" / f"r_{i}.png")
    images = ViewImages(llvm, load_views(blender))
    tiles = {(x // TILE, y // TILE) for view, x, y in images.tiles.numpy().T.tolist() if view == 2}
    assert tiles == {(x, y) for x in (0, 1) for y in (2, 3, 4, 5)} and dr.width(images.tiles) == len(tiles)
    view, x, y = (a.numpy() for a in images.random_pixels(dr.rng(seed=0), 2**14))
    near = (view == 2) & (x <= 2 * TILE) & (y >= 2 * TILE) & (y <= 6 * TILE)
    assert 0.94 < near.mean() < 0.965
    assert np.array_equal(np.unique(view), range(4)) and x.max() == 47 and y.max() == 63 and not (x.min() or y.min())
    masked = dataclasses.replace(images.views, mask=np.zeros(len(images.views.pixels), bool))
    view, *_ = (a.numpy() for a in ViewImages(llvm, masked).random_pixels(dr.rng(seed=0), 2**12))
    assert np.allclose(np.bincount(view) / 2**12, 0.25, atol=0.04)


def test_views_of_different_sizes(blender):
    """Each view keeps its size, and the focal length that its width gives."""
    stored = {i: write_image(blender / "train" / f"r_{i}.png", i, size=s) for i, s in ((1, (9, 4)), (3, (3, 11)))}
    views = load_views(blender)
    assert views.sizes.tolist() == [[6, 8], [9, 4], [6, 8], [3, 11]] and views.offsets.tolist() == [0, 48, 84, 132]
    assert np.allclose(views.focal[:, 0], np.array([8, 4, 8, 11]) / 2 / np.tan(0.35))
    assert views.centre.tolist() == [[4, 3], [2, 4.5], [4, 3], [5.5, 1.5]]
    for i, values in stored.items():
        assert np.array_equal(views.stored(i), values)
    assert_colours_are_images(views)
    fog, images = Fog(llvm, 1, (1, 1, 1), 0.5, (2, 2, 1)), ViewImages(llvm, views)
    for v, (height, width) in enumerate(views.sizes):
        # A pixel is the mean of rays through the middles of its quarters
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        opacities = []
        for across, down in itertools.product((-0.25, 0.25), repeat=2):
            o, d = captures.rays_of(views, v, x + across, y + down)
            with np.errstate(divide="ignore"):
                near, far = np.sort([(corner - o) / d for corner in (fog.lower, fog.upper)], axis=0)
            length = np.maximum(0, far.min(axis=-1) - near.max(axis=-1))
            opacities.append(1 - np.exp(-length))
        picture = images.render(fog, v)
        assert picture.shape == (height, width, 4) and (length > 1).any()
        np.testing.assert_allclose(picture[..., 3], np.mean(opacities, axis=0), atol=1e-4)
    few = views.chosen(np.array([3, 1]))
    assert np.shares_memory(few.pixels, views.pixels) and np.array_equal(few.image(1), views.image(1))
    assert few.names == ("train/r_3.png", "train/r_1.png")


def test_exr_is_taken_as_it_is(blender):
    values = np.random.default_rng(3).random((*SIZE, 4)).astype(np.float32) * [4, 4, 4, 1]
    byte_image = load_views(blender).image(0)
    (blender / "train" / "r_1.png").unlink()
    write_exr(blender / "train" / "r_1.exr", {"RGBA": values.astype(np.float32)})
    views = load_views(blender)
    assert np.array_equal(views.image(1), values.astype(np.float16)) and views.names[1] == "train/r_1.exr"
    np.testing.assert_allclose(views.image(0), byte_image, rtol=1e-3, atol=1e-7)
    assert_colours_are_images(views)
    values[2, 3, 1] = np.nan
    write_exr(blender / "train" / "r_1.exr", {"RGBA": values.astype(np.float32)})
    refused(blender, r"r_1\.exr: has 1 values that are NaN or infinite$")


def test_images_without_alpha_are_opaque(blender):
    stored = write_image(blender / "train" / "r_2.png", 5, channels=3)
    Image.fromarray(stored).save(blender / "train" / "r_3.jpg", quality=95)
    (blender / "train" / "r_3.png").unlink()
    grey = write_image(blender / "train" / "r_1.png", 6, channels=1)
    views = load_views(blender)
    images = captures.images_of(views)
    assert not views.has_alpha and (images[1:, ..., 3] == 1).all() and images[0, ..., 3].min() < 1
    assert images[2, 3, 4, :3] == pytest.approx(linear(stored[3, 4] / 255), abs=1e-6)
    assert images[1, 3, 4, :3] == pytest.approx(linear(grey[3, 4, [0, 0, 0]] / 255), abs=1e-6)
    assert views.names[3] == "train/r_3.jpg"


def test_rays_go_through_the_middles_of_pixels(blender):
    """Points on a ray are projected onto the pixel of the ray."""
    turn = np.array(pose())
    turn[:3, :3] = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn[:3, :3] *= np.sign(np.linalg.det(turn[:3, :3]))
    change(blender, frame=1, transform_matrix=turn.tolist())
    change(blender, fl_x=9.0, fl_y=7.0, cx=3.5, cy=2.5, camera_angle_x=None)
    views = load_views(blender)
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    origin, direction = captures.rays_of(views, np.full(x.shape, 1), x, y)
    assert np.allclose(np.linalg.norm(direction, axis=-1), 1) and np.allclose(origin, turn[:3, 3])
    local = np.linalg.inv(turn) @ np.concatenate([origin + 3 * direction, np.ones((6, 8, 1))], -1)[..., None]
    local = local[..., 0]
    assert (local[..., 2] < 0).all()  # in front, which is −z
    assert np.allclose(3.5 + 9 * local[..., 0] / -local[..., 2], x + 0.5)
    assert np.allclose(2.5 - 7 * local[..., 1] / -local[..., 2], y + 0.5)  # y is up, rows go down
    place = (llvm.UInt32(np.uint32(v).ravel()) for v in (x, y))
    for actual, expected in zip(ViewImages(llvm, views).rays(llvm.UInt32(1), *place), (origin, direction), strict=True):
        expected = expected.reshape(-1, 3)
        np.testing.assert_allclose(np.broadcast_to(actual.numpy().T, expected.shape), expected, atol=1e-6)


@pytest.fixture
def masked(blender):
    """The third training view and the first test view with masks: a rectangle does not count."""
    mask = np.full(SIZE, 255, np.uint8)
    mask[1:4, 2:7] = 0
    Image.fromarray(mask).save(blender / "mask.png")
    change(blender, frame=2, mask_path="mask.png")
    change(blender, "transforms_test.json", frame=0, mask_path="mask.png")
    return blender


def test_masked_pixels_do_not_count(masked):
    """Other colours of masked pixels change neither the loss nor the PSNR; those of other pixels change both."""
    figures = []
    for where in ((slice(0, 0),), (slice(1, 4), slice(2, 7)), (slice(4, 5), slice(2, 7))):
        for path in ("train/r_2.png", "test/r_0.png"):
            image = write_image(masked / path, 5)
            image[where] = 255 - image[where]
            Image.fromarray(image).save(masked / path)
        session = FieldSession.load(llvm, masked)
        fog = Fog(llvm, 1, (1, 1, 1), 0.5, (2, 2, 1))
        problem = ImagesProblem(session, {}, lambda net, fog=fog: fog)
        loss = float(dr.sum(problem.loss({}, dr.rng(seed=3), 1024))[0])
        figures.append([loss, *session.held_out_images.evaluate(fog).values()])
    assert session.views.mask.mean() == 1 - 15 / (4 * 48) and session.views.digest
    assert figures[0] == figures[1]
    assert (np.abs(np.subtract(figures[0], figures[2])) > 1e-4).all()


def test_masked_pixels_carve_nothing(masked):
    """A view that shows nothing at all empties the space that it sees; not if its pixels do not count."""
    for i in range(4):
        image = np.full((*SIZE, 4), 255 if i != 2 else 0, np.uint8)
        Image.fromarray(image).save(masked / "train" / f"r_{i}.png")
    box = (0, 0, -1), 0.25, (9, 9, 9)
    inside = hull(load_views(masked), *box)
    change(masked, frame=2, mask_path=None)
    carved = hull(load_views(masked), *box)
    assert (carved <= inside).all() and inside.sum() > 2 * carved.sum() and inside.any()


def test_patches_are_drawn_where_errors_are(blender):
    """Tiles are drawn in proportion to the root of their error before grey."""
    stored = np.zeros((64, 48, 4), np.uint8)
    stored[8:16, 8:16] = 255  # one tile of white, among eight empty ones that count as seen
    for i in range(4):
        Image.fromarray(stored * (i == 2)).save(blender / "train" / f"r_{i}.png")
    images = ViewImages(llvm, load_views(blender))
    empty = Fog(llvm, 0)
    cumulative = images.cumulative_errors(empty)
    # White before grey, of sRGB
    grey = srgb.from_linear(np.float64(session.GREY))
    error = 3 * (1 - grey) ** 2 * np.array([x == y == 8 for _, x, y in images.tiles.numpy().T])
    chances = np.sqrt(error + error.mean() * session.LEAST_ERROR)
    np.testing.assert_allclose(cumulative.numpy(), np.cumsum(chances / chances.sum()), rtol=1e-4)
    view, x, y = (a.numpy() for a in images.random_pixels(dr.rng(seed=0), 2**15, 1, cumulative))
    white = ((view == 2) & (x // TILE == 1) & (y // TILE == 1)).mean()
    share = (chances / chances.sum()).max()
    expected = (1 - session.ANYWHERE) * (session.BY_ERRORS * share + (1 - session.BY_ERRORS) / len(error))
    expected += session.ANYWHERE / 4 * TILE**2 / (64 * 48)
    assert white == pytest.approx(expected, abs=5 * np.sqrt(expected / 2**15))
    stored[:] = 0
    Image.fromarray(stored).save(blender / "train" / "r_2.png")
    assert ViewImages(llvm, load_views(blender)).cumulative_errors(empty) is None
