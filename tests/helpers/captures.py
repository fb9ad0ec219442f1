"""Captures of two balls by formulas, written as Blender's data are."""

import json
import math

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mi_diffind.tasks.radiance.views import ViewsError, load_views

ANGLE = 0.7


def look_at(eye):
    """Camera to world: at ``eye``, looking at the origin."""
    z = eye / np.linalg.norm(eye)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([x, np.cross(z, x), z], axis=1), eye
    return pose


def rays_of(views, view, x, y):
    """Origins and unit directions (…, 3), float64, of the rays through the centres of the pixels (x, y) of views."""
    view = np.asarray(view)
    fx, fy = np.moveaxis(views.focal[view], -1, 0)
    cx, cy = np.moveaxis(views.centre[view], -1, 0)
    u, v = (np.asarray(x) + 0.5 - cx) / fx, -(np.asarray(y) + 0.5 - cy) / fy
    local = np.stack(np.broadcast_arrays(u, v, -1.0), axis=-1)
    pose = views.poses[view]
    directions = np.einsum("...ij,...j->...i", pose[..., :3, :3], local)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.broadcast_to(pose[..., :3, 3], directions.shape), directions


def images_of(views):
    """Images of views of one size, ``(V, height, width, 4)``, float32."""
    return np.stack([views.image(v) for v in range(len(views))])


def ball(pose, side, centre, radius, linear):
    """sRGB and alpha, uint8, of a ball with the colours ``linear`` (directions, normals)."""
    y, x = np.mgrid[:side, :side] + 0.5 - side / 2
    d = np.stack([x, -y, np.full_like(x, -side / 2 / math.tan(ANGLE / 2))], axis=-1)
    d = d / np.linalg.norm(d, axis=-1, keepdims=True) @ pose[:3, :3].T
    o = pose[:3, 3] - centre
    b = d @ o
    under = b**2 - o @ o + radius**2
    values = linear(d, (o + (-b - np.sqrt(np.maximum(under, 0)))[..., None] * d) / radius)
    srgb = np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)
    return np.rint(255 * np.concatenate([srgb, (under > 0)[..., None]], axis=-1)).astype(np.uint8)


def picture(pose, side):
    """sRGB and alpha, uint8: a red ball with stripes, and a blue one."""

    def shaded(n, colour):
        light = np.clip(n @ [0.5, 0.7, 0.5], 0, 1)[..., None] * (0.7 + 0.3 * np.sign(np.sin(9 * n[..., 1:2])))
        return (0.35 + 0.65 * light) * colour

    balls = ([-0.25, 0, 0.1], 0.35, [0.9, 0.3, 0.2]), ([0.3, 0.1, -0.1], 0.25, [0.2, 0.4, 0.9])
    balls = sorted(balls, key=lambda ball: np.linalg.norm(pose[:3, 3] - ball[0]))
    near, far = (ball(pose, side, at, radius, lambda _, n, c=colour: shaded(n, c)) for at, radius, colour in balls)
    return np.where(near[..., 3:] > 0, near, far)


def write(folder, views=12, test=3, side=24, picture=picture):
    """Views of a ``picture`` all around, and others to test by, in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    for split, count, turn in (("train", views, 0.0), ("test", test, 1.1)):
        frames = []
        for k in range(count):
            height = 1 - 2 * (k + 0.5) / count
            angle = turn + k * math.pi * (1 + math.sqrt(5))
            flat = math.sqrt(1 - height * height)
            pose = look_at(2.2 * np.array([flat * math.cos(angle), height, flat * math.sin(angle)]))
            name = f"{split}_{k}.png"
            Image.fromarray(picture(pose, side)).save(folder / name)
            frames.append({"file_path": name, "transform_matrix": pose.tolist()})
        write_json(folder / f"transforms_{split}.json", camera_angle_x=ANGLE, frames=frames)
    return folder


# -- few random pixels -------------------------------------------------------------------------------------------------

SIZE = (6, 8)  # height, width


def pose(x=0.0, scale=1.0):
    """A camera at (x, 1, 4) that looks along −z."""
    matrix = scale * np.eye(4)
    matrix[3, 3] = 1
    matrix[:3, 3] = x, 1, 4
    return matrix.tolist()


def write_image(path, seed=0, channels=4, size=SIZE):
    """Random bytes as PNG; returns them."""
    values = np.random.default_rng(seed).integers(0, 256, (*size, channels), dtype=np.uint8)
    Image.fromarray(values[..., 0] if channels == 1 else values).save(path)
    return values


def write_exr(path, channels):
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))


def write_json(path, **content):
    path.write_text(json.dumps(content))


def write_blender(folder):
    """Four views for training, two test views; extensions are left out, as Blender's data has it."""
    for split, count in (("train", 4), ("test", 2)):
        (folder / split).mkdir()
        frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": pose(i)} for i in range(count)]
        for i in range(count):
            write_image(folder / split / f"r_{i}.png", i)
        write_json(folder / f"transforms_{split}.json", camera_angle_x=0.7, frames=frames)
    return folder


def change(folder, name="transforms_train.json", frame=None, **changes):
    """Change a list of views, or its second frame; ``None`` removes a key."""
    path = folder / name
    content = json.loads(path.read_text())
    target = content if frame is None else content["frames"][frame]
    target.update(changes)
    for key in [key for key, value in changes.items() if value is None]:
        del target[key]
    path.write_text(json.dumps(content))


def refused(folder, message, *args, **reading):
    """Views in a folder are refused with a message."""
    with pytest.raises(ViewsError, match=message):
        load_views(folder, *args, **reading)
