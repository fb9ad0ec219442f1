"""
Images of a scene from all sides, with the poses of the cameras, in the layout of NeRF's Blender data (Mildenhall et al.
2020): ``transforms_train.json``, ``transforms_test.json`` and an image each view, with alpha.

What is captured is what the scene's surfaces look like in its light; lights, environments among them, are hidden and
leave alpha 0. Poses and boxes are in the scene's own coordinates. A folder says in ``capture.json`` how it was made,
and is gone on with, view by view, by the same call.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import math
import os
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from . import __version__, compat, scenes, srgb
from .errors import DiffindError, reason
from .files import replacing, writable_folder, write_json
from .interrupt import interruptible
from .plugins.support import footprint

PATHS = ("sphere", "orbit")
FORMATS = ("png", "exr")

#: Samples of the whole image in one pass.
PASS = 1 << 23

#: By so much of its longest side the box of what is captured is enlarged on each side, for what is written with it.
MARGIN = 0.01

#: Surfaces of others that a camera ray passes through to reach the objects that are asked for.
THROUGH = 8

#: The angle between neighbours on a Fibonacci lattice: the golden one.
GOLDEN = math.pi * (3 - math.sqrt(5))

#: The largest number of a half float, the type of the colours of an EXR.
LARGEST = 65504.0

#: The file that says how a folder was made.
RECORD = "capture.json"


class CaptureError(DiffindError, RuntimeError):
    """A scene cannot be captured so, or not in this folder; the message is one sentence."""


@dataclass(frozen=True)
class CaptureSettings:
    """
    How a scene is captured: ``views`` for training and ``test`` views, square images of ``resolution`` pixels and a
    field of view ``fov`` (degrees), ``spp`` samples a pixel.

    Of ``objects``, ids of shapes, others only cast light and shadow on them; none: all surfaces that do not shine.
    Cameras look at ``centre`` (default: that of their box) from a distance ``radius`` (default: from where a sphere
    around them fills the image). ``path``: "sphere", all over it, or "orbit", once around the axis ``up``.
    ``elevation``: the lowest and the highest, degrees above the plane that ``up`` is normal to; an orbit swings from
    the one to the other (default: −90, 90 for a sphere, 20, 20 for an orbit). ``format``: "png", as displayed, 8 bits,
    or "exr", linear half floats.
    """

    views: int = 60
    test: int = 20
    resolution: int = 160
    spp: int = 256
    fov: float = 40.0
    centre: tuple[float, float, float] | None = None
    radius: float | None = None
    path: str = "sphere"
    elevation: tuple[float, float] | None = None
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    objects: tuple[str, ...] = ()
    seed: int = 0
    format: str = "png"

    def check(self) -> None:
        """Raise ``ValueError`` for what is not allowed."""
        if self.path not in PATHS:
            raise ValueError(f'path: found "{self.path}", allowed are {", ".join(PATHS)}')
        if self.format not in FORMATS:
            raise ValueError(f'format: found "{self.format}", allowed are {", ".join(FORMATS)}')
        for name, least in (("views", 1), ("test", 0), ("resolution", 1), ("spp", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: found {getattr(self, name)}, allowed are whole numbers ≥ {least}")
        if not 0 < self.fov < 170:
            raise ValueError(f"fov: found {self.fov:g}, allowed are degrees between 0 and 170")
        if self.radius is not None and not 0 < self.radius < math.inf:
            raise ValueError(f"radius: found {self.radius:g}, allowed are numbers > 0")
        if self.centre is not None and not np.isfinite(self.centre).all():
            raise ValueError("centre: found NaN or infinity, allowed are numbers")
        if not np.isfinite(self.up).all() or not np.any(self.up):
            raise ValueError("up: found no direction, allowed are three numbers that are not all 0")
        low, high = self.elevations
        if not -90 <= low <= high <= 90:
            raise ValueError(
                f"elevation: found {low:g} to {high:g}, allowed are degrees from −90 to 90, the lower first"
            )

    @property
    def elevations(self) -> tuple[float, float]:
        """``elevation`` or its default, degrees."""
        return self.elevation or ((20.0, 20.0) if self.path == "orbit" else (-90.0, 90.0))


# -- places -----------------------------------------------------------------------------------------------------------


def directions(settings: CaptureSettings) -> tuple[np.ndarray, np.ndarray]:
    """
    From the centre to the cameras, unit vectors ``(views, 3)`` and ``(test, 3)``; z is up.

    On a sphere, both are Fibonacci lattices; the one for training is turned about the axis by an angle that the seed
    gives, that of the test views to where the nearest view for training is farthest. On an orbit, test views are
    between those for training, as evenly as their numbers allow.
    """
    low, high = np.radians(settings.elevations)
    if settings.path == "orbit":
        test = (
            np.floor((np.arange(settings.test) + 0.5) * settings.views / max(settings.test, 1)) + 0.5
        ) / settings.views
        return _orbit(np.arange(settings.views) / settings.views, low, high), _orbit(test, low, high)
    turn = np.random.default_rng(settings.seed).uniform(0, 2 * np.pi)
    train = _lattice(settings.views, low, high, turn)
    turns = [_lattice(settings.test, low, high, turn + t) for t in np.linspace(0, 2 * np.pi, 90, endpoint=False)]
    if not settings.test:
        return train, turns[0]
    return train, max(turns, key=lambda test: np.arccos(np.clip(test @ train.T, -1, 1)).min())


def _lattice(count: int, low: float, high: float, turn: float) -> np.ndarray:
    i = np.arange(count)
    z = math.sin(low) + (math.sin(high) - math.sin(low)) * (i + 0.5) / max(count, 1)
    return _unit(GOLDEN * i + turn, np.arcsin(z))


def _orbit(turns: np.ndarray, low: float, high: float) -> np.ndarray:
    azimuth = 2 * np.pi * turns
    return _unit(azimuth, (low + high) / 2 - (high - low) / 2 * np.cos(azimuth))


def _unit(azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def frame_of(up) -> np.ndarray:
    """A rotation ``(3, 3)`` that takes z to ``up``; y up: azimuth 0 is z, and grows towards x."""
    z = np.array(up, np.float64) / np.linalg.norm(up)
    y = np.eye(3)[(int(np.argmax(np.abs(z))) + 2) % 3]
    x = np.cross(y, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def pose(origin: np.ndarray, target: np.ndarray, up) -> np.ndarray:
    """Camera to world, ``(4, 4)``, of a camera at ``origin`` that looks at ``target``, along its −z; y is up."""
    z = (origin - target) / np.linalg.norm(origin - target)
    x = np.cross(np.array(up, np.float64) / np.linalg.norm(up), z)
    if np.linalg.norm(x) < 1e-6:  # straight from above or below
        x = frame_of(up)[:, 0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    found = np.eye(4)
    found[:3] = np.stack([x, np.cross(z, x), z, origin], axis=1)
    return found


# -- capture ----------------------------------------------------------------------------------------------------------


@dataclass
class Captured:
    """
    What there is in a folder: files of images and how many there will be; those ``rendered`` now, in ``seconds``;
    ``radius``, ``centre`` and ``box`` ``(2, 3)``; ``opaque``: no pixel that was rendered has alpha below 1.
    """

    folder: Path
    files: list[str]
    total: int
    rendered: int
    seconds: float
    radius: float
    centre: np.ndarray
    box: np.ndarray
    opaque: bool


def capture(
    scene: str | os.PathLike,
    folder: str | os.PathLike,
    settings: CaptureSettings = CaptureSettings(),
    defines: dict[str, str] | None = None,
    progress: bool = True,
) -> Captured:
    """
    Render the views of a scene file into ``folder``, made if its parent exists, in the variant that is set. Views that
    are there, made with the same settings of the same scene, are kept; after Ctrl-C the one that is rendered is the
    last.

    Raises :class:`CaptureError`, also for a folder that was made otherwise, ``ValueError`` for settings, and
    :class:`~mi_diffind.scenes.SceneError` and :class:`~mi_diffind.files.OutputError`.
    """
    import time

    settings.check()
    folder = writable_folder(folder, create=True)
    record = _record(scene, settings, defines)
    _check_record(folder, record)
    loaded = _load(scene, defines)
    box = bounds(loaded, settings.objects)
    centre = box.mean(axis=0) if settings.centre is None else np.array(settings.centre, np.float64)
    radius = settings.radius or _reach(loaded, settings.objects, centre) / math.sin(math.radians(settings.fov) / 2)
    if not radius > 0:
        raise CaptureError(f"{scene}: what is captured has no extent, --radius has to be given")
    camera = CaptureCamera(loaded, settings)
    write_json(folder / RECORD, record)
    splits, left = _plan(settings, centre, radius), []
    for split, views in splits.items():
        writable_folder(folder / split, create=True)
        left += [(split, i) for i in range(len(views)) if not (folder / _name(split, i, settings)).is_file()]
    total, start, rendered, opaque = sum(map(len, splits.values())), time.perf_counter(), 0, bool(left)
    bar = tqdm(total=total, initial=total - len(left), desc="capture", unit="view", disable=None if progress else True)
    _write_lists(folder, settings, splits, box)
    with interruptible() as stop, bar:
        for split, i in left:
            image = camera.render(splits[split][i], (settings.seed << 16) + 2 * i + (split == "test"))
            opaque &= bool((image[..., 3] > 0.999).all())
            _write(folder / _name(split, i, settings), image)
            rendered += 1
            bar.update()
            if stop.is_set():
                break
    seconds = time.perf_counter() - start
    files = _write_lists(folder, settings, splits, box)
    return Captured(folder, files, total, rendered, seconds, radius, centre, box, opaque)


def shapes_of(scene, objects: tuple[str, ...] = ()) -> list:
    """The shapes with the ids ``objects``; of none: all shapes that are no lights. Raises :class:`CaptureError`."""
    shapes = [s for s in scene.shapes() if not s.is_emitter()]
    if objects:
        found = {s.id() for s in scene.shapes()}
        for name in objects:
            if name not in found:
                named = ", ".join(sorted(n for n in found if n and not n.startswith("_"))) or "none has one"
                raise CaptureError(f'objects: found "{name}", the ids of the scene\'s shapes are: {named}')
        shapes = [s for s in scene.shapes() if s.id() in objects]
    if not shapes:
        raise CaptureError("the scene has no surfaces but lights, there is nothing to capture")
    return shapes


def bounds(scene, objects: tuple[str, ...] = ()) -> np.ndarray:
    """The corners ``(2, 3)`` of the box of :func:`shapes_of`. Raises :class:`CaptureError`."""
    boxes = [_box(s) for s in shapes_of(scene, objects)]
    box = np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])
    if not np.isfinite(box).all():
        raise CaptureError("the box around what is captured is not finite: name the objects")
    return box


def _box(shape) -> np.ndarray:
    return np.array([shape.bbox().min, shape.bbox().max], np.float64).reshape(2, 3)


def _reach(scene, objects: tuple[str, ...], centre: np.ndarray) -> float:
    """How far shapes reach from a point: the vertices of meshes, the corners of the boxes of others."""
    found = 0.0
    for shape in shapes_of(scene, objects):
        vertices = "vertex_positions"
        parameters = mi.traverse(shape) if isinstance(shape, mi.Mesh) and shape.vertex_count() else {}
        if vertices in parameters:
            points = np.array(parameters[vertices], np.float64).reshape(-1, 3)
        else:
            points = np.array(list(itertools.product(*_box(shape).T)))
        found = max(found, float(np.linalg.norm(points - centre, axis=1).max()))
    return found


def _plan(settings: CaptureSettings, centre: np.ndarray, radius: float) -> dict[str, list[np.ndarray]]:
    """Split → poses."""
    frame = frame_of(settings.up)
    places = (d @ frame.T * radius + centre for d in directions(settings))
    return {
        split: [pose(origin, centre, settings.up) for origin in origins]
        for split, origins in zip(("train", "test"), places, strict=True)
    }


def _load(path, defines: dict[str, str] | None):
    """A scene whose integrators hide its lights."""

    def hide(state) -> None:
        for props in compat.properties_of(state, mi.ObjectType.Integrator):
            # One that nests another leaves it to that one
            if not any(compat.property_kind(props, key) == "object" for key in props):
                props["hide_emitters"] = True

    return scenes.load(path, defines=defines, change=hide, merge=False)


class CaptureCamera:
    """A camera of its own for a loaded scene."""

    def __init__(self, scene, settings: CaptureSettings):
        self.scene, self.settings = scene, settings
        side = settings.resolution
        mono = mi.is_monochromatic
        self.sensor = mi.load_dict({
            "type": "perspective", "fov": settings.fov, "fov_axis": "x", "near_clip": 1e-3, "far_clip": 1e6,
            "film": {
                "type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"},
                "pixel_format": "luminance_alpha" if mono else "rgba", "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": settings.spp},
        })  # fmt: skip
        self.parameters = mi.traverse(self.sensor)
        self.integrator = scene.integrator()
        if self.integrator is None:
            self.integrator = mi.load_dict({"type": "path", "hide_emitters": True})
        if settings.objects:
            self.integrator = _only(self.integrator, shapes_of(scene, settings.objects))

    def render(self, pose: np.ndarray, seed: int) -> np.ndarray:
        """``(height, width, 4)``, float32: linear colours, multiplied by alpha, and alpha."""
        matrix = pose @ np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba's cameras look along +z, x to the left
        self.parameters["to_world"] = type(self.parameters["to_world"])(mi.ScalarTransform4f(matrix))
        self.parameters.update()
        footprint.attach(self.scene, self.sensor, self.settings.spp)
        total, done = 0.0, 0
        most = 1 << (max(1, PASS // self.settings.resolution**2).bit_length() - 1)
        while done < self.settings.spp:
            n = min(most, self.settings.spp - done)
            with scenes.scene_errors(None):
                image = mi.render(
                    self.scene, sensor=self.sensor, integrator=self.integrator, spp=n,
                    seed=(seed * 4096 + done // most) % 2**32,
                ).numpy().astype(np.float64)  # fmt: skip
            total = total + n * np.where(np.isfinite(image), image, 0)
            done += n
        image = total / done
        colours = 1 if mi.is_monochromatic else 3
        alpha = np.clip(image[..., colours : colours + 1], 0, 1)
        return np.concatenate([image[..., :colours].repeat(3 // colours, axis=-1), alpha], axis=-1).astype(np.float32)


def _only(inner, shapes: list):
    """
    An integrator to which camera rays see but these ``shapes``: they pass through all others, up to :data:`THROUGH`
    surfaces. ``inner``, which it hands the rays to right before the surface that they meet, knows all.
    """
    for shape in shapes:
        if hasattr(shape, "seen_by"):
            raise CaptureError(
                f'objects: found "{shape.id()}", whose arrays {" and ".join(shape.seen_by)} traces; allowed are meshes '
                f"and Mitsuba's own shapes"
            )
    if not isinstance(inner, mi.SamplingIntegrator):
        raise CaptureError(f"objects: the integrator {inner.class_name()} follows no rays from a camera, as path does")
    replays = compat.samples_in_python(inner)

    class Only(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            ray, found = mi.Ray3f(ray), mi.Bool(False)
            left = mi.Bool(active)
            for _ in range(THROUGH):
                si = scene.ray_intersect(ray, left)
                wanted = mi.Bool(False)
                for shape in shapes:
                    wanted |= (si.shape == mi.ShapePtr(shape)) | (si.instance == mi.ShapePtr(shape))
                left &= si.is_valid()
                found |= left & wanted
                left &= ~wanted
                ray.o = dr.select(left, si.spawn_ray(ray.d).o, ray.o)
            beginning = mi.RayDifferential3f(ray)
            if replays:
                light, valid, *_ = inner.sample(
                    mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=beginning,
                    δL=None, δaovs=None, state_in=None, active=found,
                )  # fmt: skip
            else:
                light, valid, _ = inner.sample(scene, sampler, beginning, medium, found)
            return dr.select(found, light, 0), valid & found, []

    return Only(mi.Properties("only"))


# -- files ------------------------------------------------------------------------------------------------------------


def _record(scene, settings: CaptureSettings, defines: dict[str, str] | None) -> dict:
    """How a folder is made: the settings, and what else its images depend on."""
    digest = hashlib.sha256()
    for file in scenes.files_of(scene, defines):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return {
        "scene": Path(scene).name,
        "settings": json.loads(json.dumps(dataclasses.asdict(settings))),
        "defines": dict(sorted((defines or {}).items())),
        "variant": mi.variant(),
        "versions": {"mitsuba": mi.__version__, "mi_diffind": __version__},
        "digest": digest.hexdigest(),
    }


def _check_record(folder: Path, record: dict) -> None:
    """Raise :class:`CaptureError` if a folder holds a capture that was made otherwise, or another one's."""
    path = folder / RECORD
    if not path.is_file():
        if next(folder.glob("transforms*.json"), None) is not None:
            raise CaptureError(f"{folder}: holds views that were not captured here, a folder of its own is needed")
        return
    try:
        before = json.loads(path.read_text(encoding="utf-8"))
        changed = _changed(before, record)
    except (ValueError, OSError, AttributeError) as e:
        raise CaptureError(f"{path}: cannot be read ({reason(e)})") from None
    if changed:
        raise CaptureError(
            f"{folder}: holds a capture with other settings ({'; '.join(changed)}): take those, or another folder"
        )


def _changed(before: dict, now: dict) -> list[str]:
    found = []
    for key, value in now.items():
        was = before.get(key)
        if key == "digest" and was != value:
            found.append("the scene's files have changed")
        elif isinstance(value, dict):
            was = was or {}
            keys = dict.fromkeys([*value, *was])
            found += [f"{k}: {was.get(k)}, now {value.get(k)}" for k in keys if was.get(k) != value.get(k)]
        elif was != value:
            found.append(f"{key}: {was}, now {value}")
    return found


def _name(split: str, i: int, settings: CaptureSettings) -> str:
    return f"{split}/r_{i:03d}.{settings.format}"


def _write_lists(folder: Path, settings: CaptureSettings, splits: dict, box: np.ndarray) -> list[str]:
    """Write ``transforms_*.json`` of the images that are there; returns their names."""
    margin = MARGIN * (box[1] - box[0]).max()
    head = {
        "camera_angle_x": math.radians(settings.fov),
        "w": settings.resolution,
        "h": settings.resolution,
        "aabb": [(box[0] - margin).tolist(), (box[1] + margin).tolist()],
    }
    found = []
    for split, poses in splits.items():
        there = [i for i in range(len(poses)) if (folder / _name(split, i, settings)).is_file()]
        frames = [{"file_path": f"./{_name(split, i, settings)}", "transform_matrix": poses[i].tolist()} for i in there]
        found += [_name(split, i, settings) for i in there]
        if poses:
            write_json(folder / f"transforms_{split}.json", {**head, "frames": frames})
    return found


def _write(path: Path, image: np.ndarray) -> None:
    """An image ``(height, width, 4)``, linear and multiplied by alpha: as sRGB, not multiplied, or as it is."""
    with replacing(path) as temporary:
        if path.suffix == ".png":
            from PIL import Image

            colours = image[..., :3] / np.maximum(image[..., 3:], 1e-6)
            shown = np.concatenate([srgb.for_display(colours), image[..., 3:]], axis=-1)
            Image.fromarray(np.round(255 * shown).astype(np.uint8)).save(temporary)
        else:
            import OpenEXR

            channels = {"RGBA": np.clip(image, -LARGEST, LARGEST).astype(np.float16)}
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            with OpenEXR.File(header, channels) as file:
                file.write(str(temporary))


def lines(captured: Captured) -> list[str]:
    """What there is to say, as lines of text."""
    box = " to ".join(map(_point, captured.box))
    count = f"{len(captured.files)} of {captured.total} views"
    found = [
        f"{captured.folder}: {count}, {captured.rendered} rendered now, {captured.seconds:.1f} s",
        f"  from a distance of {captured.radius:.4g} around {_point(captured.centre)}, box {box}",
    ]
    if captured.opaque:
        found.append("  alpha is 1 everywhere: what is behind the objects became part of the views")
    return found


def _point(p: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in p) + ")"
