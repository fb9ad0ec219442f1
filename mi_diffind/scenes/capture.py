"""Views of a scene from all sides, with camera poses, in the layout of NeRF's Blender data (Mildenhall et al. 2020).

A folder holds ``transforms_train.json``, ``transforms_test.json`` and an image with alpha for each view. Images show
the scene's surfaces in its light; lights, environments included, are hidden and leave alpha 0. Poses and boxes are in
the scene's own coordinates. ``capture.json`` records the settings; the same call continues a folder, view by view.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import io
import itertools
import json
import math
import os
import pickle
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import __version__, plugins
from ..core import compat
from ..core.errors import DiffindError, UsageError, reason
from ..core.files import replacing, writable_folder, write_json
from ..core.jobs import run_jobs
from ..core.progress import interruptible, progress_bar
from ..core.runtime import use_variant
from ..core.threads import threads_for_files
from ..images import srgb
from ..plugins.support import footprint
from . import loading, splats
from .capture_settings import CaptureSettings
from .poses import frame_of, pose
from .splat_files import is_splats

#: Samples of the whole image in one pass.
PASS = 1 << 23

#: Margin of the box that is written with the views, on each side, as a part of its longest side.
MARGIN = 0.01

#: Surfaces of other shapes that a camera ray may pass through on its way to the captured objects.
THROUGH = 8

#: Largest number of a half float, the type of the colours of an EXR.
LARGEST = 65504.0

#: Number of views of a contact sheet.
SHOWN = 24

#: File that records the settings of a folder.
RECORD = "capture.json"


class CaptureError(DiffindError, RuntimeError):
    """A scene cannot be captured with these settings, or not in this folder; the message is one sentence."""


@dataclass
class Captured:
    """State of a folder after a capture.

    ``files`` of images (relative to ``folder``) and their ``total`` once complete; the number ``rendered`` now, in
    ``seconds``; ``radius``, ``centre`` and ``box`` ``(2, 3)`` of the cameras' target; ``opaque``: no rendered pixel has
    alpha below 1; ``notes`` on what is not used of a file of 3D Gaussians.
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
    notes: tuple[str, ...] = ()

    @property
    def interrupted(self) -> bool:
        """Whether views are missing."""
        return len(self.files) < self.total

    @property
    def figures(self) -> dict:
        """Figures of ``mi-diffind capture --json``."""
        return {
            "interrupted": self.interrupted,
            "output": str(self.folder),
            "files": self.files,
            "views": self.total,
            "rendered": self.rendered,
            "seconds": self.seconds,
            "radius": self.radius,
            "centre": self.centre.tolist(),
            "box": self.box.tolist(),
            "notes": list(self.notes),
        }

    @property
    def poses(self) -> np.ndarray:
        """Camera-to-world matrices ``(views, 4, 4)`` of all ``files``, in this order; cameras look along −z."""
        matrices = {}
        for path in self.folder.glob("transforms_*.json"):
            for frame in json.loads(path.read_text(encoding="utf-8"))["frames"]:
                matrices[frame["file_path"].removeprefix("./")] = frame["transform_matrix"]
        return np.array([matrices[name] for name in self.files], np.float64).reshape(-1, 4, 4)

    @property
    def images(self) -> list[np.ndarray]:
        """Images of all ``files``, ``(height, width, 4)``, read when asked for: uint8, or of EXR linear floats."""
        with threads_for_files():
            return [np.array(mi.Bitmap(str(self.folder / name))) for name in self.files]

    def __str__(self) -> str:
        return "\n".join(lines(self))

    def _repr_png_(self) -> bytes:
        """Return a contact sheet of at most :data:`SHOWN` views on white, evenly chosen."""
        from PIL import Image

        chosen = np.unique(np.linspace(0, len(self.files) - 1, min(SHOWN, len(self.files))).round().astype(int))
        columns, side = min(8, max(1, len(chosen))), 128
        sheet = Image.new("RGB", (columns * side, max(1, -(-len(chosen) // columns)) * side), "white")
        for i, number in enumerate(chosen):
            with threads_for_files():
                image = np.array(mi.Bitmap(str(self.folder / self.files[number])))
            if image.dtype != np.uint8:  # linear, multiplied by alpha
                straight = image[..., :3] / np.maximum(image[..., 3:], 1e-6)
                shown = np.concatenate([srgb.for_display(straight), np.clip(image[..., 3:], 0, 1)], axis=-1)
                image = np.rint(255 * shown).astype(np.uint8)
            thumbnail = Image.fromarray(image).resize((side, side))
            sheet.paste(thumbnail, (i % columns * side, i // columns * side), thumbnail)
        stream = io.BytesIO()
        sheet.save(stream, "PNG")
        return stream.getvalue()


def capture(
    scene: str | os.PathLike | dict,
    folder: str | os.PathLike,
    *,
    defines: Mapping[str, object] | None = None,
    progress: bool = True,
    workers: int | None = None,
    scheduler: str = "",
    **given,
) -> Captured:
    """Render the views of a ``scene`` into ``folder``, in the variant that is set.

    The scene is a file or a dictionary as of ``mi.load_dict``; of a loaded scene, lights could not be hidden. It may
    also be a file of 3D Gaussians (:mod:`.splat_files`), of which ``box`` crops a part.
    ``given`` are fields of :class:`CaptureSettings`, the options of ``mi-diffind capture`` as keywords: ``views=60``,
    ``resolution=160``, ``path="orbit"``, …; ``defines`` replace the file's ``<default>`` parameters; ``workers``
    processes share the views, or those of the Dask cluster ``scheduler``. The folder is created if its parent exists.
    Views of an earlier capture with the same settings of the same scene are kept, unless a dictionary holds objects
    that exist already; after Ctrl-C the current view is the last. Raises :class:`.UsageError` for bad
    settings, :class:`CaptureError`, also for a folder with other settings, :class:`.SceneError`,
    :class:`.SplatsError` and :class:`.OutputError`.
    """
    use_variant()
    settings = _settings(scene, given)
    subject = _subject(scene, defines, settings)
    folder = writable_folder(folder, create=True)
    record = _record(subject, settings)
    _check_record(folder, record)
    box = subject.bounds()
    centre = box.mean(axis=0) if settings.centre is None else np.array(settings.centre, np.float64)
    radius = settings.radius or subject.reach(centre) / math.sin(math.radians(settings.fov) / 2)
    if not radius > 0:
        raise CaptureError(f"{subject.path}: the captured objects have no extent, --radius has to be given")
    camera = subject.camera(settings)
    write_json(folder / RECORD, record)
    splits, left = _plan(settings, centre, radius), []
    for split, views in splits.items():
        writable_folder(folder / split, create=True)
        left += [(split, i) for i in range(len(views)) if not (folder / _name(split, i, settings)).is_file()]
    total, start, rendered, opaque = sum(map(len, splits.values())), time.perf_counter(), 0, bool(left)
    _write_lists(folder, settings, splits, box)
    if left and (workers or scheduler):
        views = _shared(scene, subject, (settings, centre, radius), folder, left)
        outcomes = run_jobs(
            render_separately, views, workers, scheduler, progress, "capture", "view", total - len(left)
        )
        for outcome in outcomes:
            if outcome.failure:
                raise CaptureError(f"{outcome.name}: {outcome.failure}")
            rendered += 1
            opaque &= outcome.value
    elif left:
        bar = progress_bar("capture", total, "view", progress, initial=total - len(left))
        with interruptible() as stop, bar:
            for split, i in left:
                opaque &= _render(camera, splits, folder, split, i)
                rendered += 1
                bar.update()
                if stop.is_set():
                    break
    seconds = time.perf_counter() - start
    files = _write_lists(folder, settings, splits, box)
    return Captured(folder, files, total, rendered, seconds, radius, centre, box, opaque, subject.notes)


def _render(camera: CaptureCamera, splits: dict, folder: Path, split: str, i: int) -> bool:
    """Render a view, write it, and return whether it is opaque everywhere."""
    settings = camera.settings
    image = camera.render(splits[split][i], ((settings.seed << 16) + 2 * i + (split == "test")) % 2**32)
    _write(folder / _name(split, i, settings), image)
    return bool((image[..., 3] > 0.999).all())


def _shared(scene, subject: SceneSubject, given: tuple, folder: Path, left: list) -> dict[str, tuple]:
    """Return the jobs of :func:`render_separately`. Raises :class:`.UsageError`."""
    source = scene if isinstance(scene, dict) else str(subject.path.resolve())
    try:
        content = pickle.dumps((source, subject.record()["defines"], *given, mi.variant()))
    except Exception:  # of the objects in a dictionary, each has its own
        raise UsageError("workers: the scene holds objects of this process, a scene file is needed") from None
    return {_name(split, i, given[0]): (content, str(folder.resolve()), split, i) for split, i in left}


def render_separately(view: tuple[bytes, str, str, int]) -> bool:
    """Render a view in this process, which loads the scene once, and write it; return whether it is opaque."""
    content, folder, split, i = view
    camera, splits = _camera_of(content)
    return _render(camera, splits, Path(folder), split, i)


@functools.lru_cache(maxsize=1)
def _camera_of(content: bytes) -> tuple[CaptureCamera, dict]:
    scene, defines, settings, centre, radius, variant = pickle.loads(content)
    use_variant(variant)
    return _subject(scene, defines, settings).camera(settings), _plan(settings, centre, radius)


def _subject(scene, defines: Mapping | None, settings: CaptureSettings) -> SceneSubject | splats.SplatSubject:
    """Return the subject of a capture. Raises :class:`.UsageError`."""
    if not is_splats(scene):
        if settings.box is not None:
            raise UsageError("box: given with a scene, allowed are files of 3D Gaussians; objects names shapes")
        return SceneSubject(scene, defines, settings.objects)
    for name, value in (("defines", defines), ("objects", settings.objects)):
        if value:
            raise UsageError(f"{name}: given with the 3D Gaussians {scene}, allowed are scenes")
    return splats.SplatSubject(scene, settings.box)


class SceneSubject:
    """Scene as the subject of a capture, of which ``objects`` are captured."""

    notes = ()

    def __init__(self, scene, defines: Mapping | None, objects: tuple[str, ...]):
        self.parsed, self.objects = loading.ParsedScene(scene, defines), objects
        self.path = self.parsed.path

    @functools.cached_property
    def scene(self):
        """Scene whose integrators hide its lights."""
        return _load(self.parsed)

    def record(self) -> dict:
        """Return what the images depend on beside the settings."""
        parsed, digest = self.parsed, hashlib.sha256(self.parsed.description.encode())
        for file in parsed.files():
            digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
        return {
            "scene": parsed.path.name,
            "defines": dict(sorted(parsed.defines.items())),
            "digest": digest.hexdigest(),
        }

    def bounds(self) -> np.ndarray:
        """Return the corners ``(2, 3)`` of the captured objects' box."""
        return bounds(self.scene, self.objects)

    def reach(self, centre: np.ndarray) -> float:
        """Return the radius of a sphere around a point that holds the captured objects."""
        return _reach(self.scene, self.objects, centre)

    def camera(self, settings: CaptureSettings) -> CaptureCamera:
        """Return the camera of a capture with these settings."""
        return CaptureCamera(self.scene, settings)


def _settings(scene, given: dict) -> CaptureSettings:
    """Return the settings with the ``given`` fields. Raises :class:`.UsageError`."""
    allowed = [f.name for f in dataclasses.fields(CaptureSettings)]
    for name in given:
        if name not in allowed:
            raise UsageError(f'capture: found the argument "{name}", allowed are {", ".join(allowed)}')
    names = ("centre", "elevation", "up", "objects", "box")
    tuples = {name: tuple(given[name]) for name in names if given.get(name) is not None}
    if given.get("spp") is None:
        tuples["spp"] = splats.SPP if is_splats(scene) else CaptureSettings.spp
    settings = CaptureSettings(**{**given, **tuples})
    try:
        settings.check()
    except ValueError as e:
        raise UsageError(str(e)) from None
    return settings


def shapes_of(scene, objects: tuple[str, ...] = ()) -> list:
    """Return the shapes with the ids ``objects`` (none: all that are no lights). Raises :class:`CaptureError`."""
    shapes = [s for s in scene.shapes() if not s.is_emitter()]
    if objects:
        ids = {s.id() for s in scene.shapes()}
        for name in objects:
            if name not in ids:
                named = ", ".join(sorted(n for n in ids if n and not n.startswith("_"))) or "none has one"
                raise CaptureError(f'objects: found "{name}", the ids of the scene\'s shapes are: {named}')
        shapes = [s for s in scene.shapes() if s.id() in objects]
    if not shapes:
        raise CaptureError("the scene has no surfaces but lights, there is nothing to capture")
    return shapes


def bounds(scene, objects: tuple[str, ...] = ()) -> np.ndarray:
    """Return the corners ``(2, 3)`` of the box of :func:`shapes_of`. Raises :class:`CaptureError`."""
    boxes = [_box(s) for s in shapes_of(scene, objects)]
    box = np.stack([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])
    if not np.isfinite(box).all():
        raise CaptureError("the box around the captured objects is not finite: name the objects")
    return box


def _box(shape) -> np.ndarray:
    return np.array([shape.bbox().min, shape.bbox().max], np.float64).reshape(2, 3)


def _reach(scene, objects: tuple[str, ...], centre: np.ndarray) -> float:
    """Return the largest distance of shapes from a point: of the vertices of meshes, of the corners of other boxes."""
    reach = 0.0
    for shape in shapes_of(scene, objects):
        vertices = "vertex_positions"
        parameters = mi.traverse(shape) if isinstance(shape, mi.Mesh) and shape.vertex_count() else {}
        if vertices in parameters:
            points = np.array(parameters[vertices], np.float64).reshape(-1, 3)
        else:
            points = np.array(list(itertools.product(*_box(shape).T)))
        reach = max(reach, float(np.linalg.norm(points - centre, axis=1).max()))
    return reach


def _plan(settings: CaptureSettings, centre: np.ndarray, radius: float) -> dict[str, list[np.ndarray]]:
    """Return the poses of each split, ``"train"`` and ``"test"``."""
    frame = frame_of(settings.up)
    places = (d @ frame.T * radius + centre for d in settings.directions())
    return {
        split: [pose(origin, centre, settings.up) for origin in origins]
        for split, origins in zip(("train", "test"), places, strict=True)
    }


def _load(parsed: loading.ParsedScene):
    """Load a scene so that its integrators hide its lights, and its meshes keep their ids."""

    def hide(state) -> None:
        for props in loading.integrator_properties(state):
            if not loading.nests_another(props):  # the nested one follows the paths
                props["hide_emitters"] = True

    return parsed.load(change=hide, merge=False, needs=())


class CaptureCamera:
    """Camera of a capture, beside the sensors of the loaded scene."""

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
        """Render a view, ``(height, width, 4)``, float32: linear colours, multiplied by alpha, and alpha."""
        matrix = pose @ np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba's cameras look along +z, x to the left
        self.parameters["to_world"] = type(self.parameters["to_world"])(mi.ScalarTransform4f(matrix))
        self.parameters.update()
        footprint.attach(self.scene, self.sensor, self.settings.spp)
        total, done, passes = 0.0, 0, 0
        bad = np.zeros((self.settings.resolution,) * 2, bool)
        most = 1 << (max(1, PASS // self.settings.resolution**2).bit_length() - 1)
        while done < self.settings.spp:
            n = min(most, self.settings.spp - done)
            if loading.rounded(self.sensor, n) > n:  # multijitter takes powers of four as they are
                n = 4 ** ((n.bit_length() - 1) // 2)
            with loading.scene_errors(None):
                image = mi.render(
                    self.scene, sensor=self.sensor, integrator=self.integrator, spp=n,
                    seed=(seed * 4096 + passes) % 2**32,
                ).numpy().astype(np.float64)  # fmt: skip
            bad |= ~np.isfinite(image).all(axis=-1)
            total = total + n * np.where(np.isfinite(image), image, 0)
            done, passes = done + n, passes + 1
        if bad.any():
            plugins.warn(
                f"{int(bad.sum()):,} of {bad.size:,} pixels of a view have NaN or infinite samples, which count 0"
            )
        image = total / done
        colours = 1 if mi.is_monochromatic else 3
        alpha = np.clip(image[..., colours : colours + 1], 0, 1)
        return np.concatenate([image[..., :colours].repeat(3 // colours, axis=-1), alpha], axis=-1).astype(np.float32)


def _only(inner, shapes: list):
    """Return an integrator whose camera rays see only these ``shapes``, and pass through all others.

    Rays pass through up to :data:`THROUGH` surfaces. Right before the first surface of the shapes, ``inner`` takes
    over, which sees everything.
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

    class ObjectsOnly(mi.SamplingIntegrator):
        def traverse(self, cb):
            cb.put("inner", inner, mi.ParamFlags.Differentiable)

        def sample(self, scene, sampler, ray, medium=None, active=True):
            ray, hit = mi.Ray3f(ray), mi.Bool(False)
            left = mi.Bool(active)
            for _ in range(THROUGH):
                si = scene.ray_intersect(ray, left)
                wanted = mi.Bool(False)
                for shape in shapes:
                    wanted |= (si.shape == mi.ShapePtr(shape)) | (si.instance == mi.ShapePtr(shape))
                left &= si.is_valid()
                hit |= left & wanted
                left &= ~wanted
                ray.o = dr.select(left, si.spawn_ray(ray.d).o, ray.o)
            beginning = mi.RayDifferential3f(ray)
            if replays:
                light, valid, *_ = inner.sample(
                    mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=beginning,
                    δL=None, δaovs=None, state_in=None, active=hit,
                )  # fmt: skip
            else:
                light, valid, _ = inner.sample(scene, sampler, beginning, medium, hit)
            return dr.select(hit, light, 0), valid & hit, []

    return ObjectsOnly(mi.Properties("only"))


def _record(subject: SceneSubject | splats.SplatSubject, settings: CaptureSettings) -> dict:
    """Return the record of a folder: the settings, and everything else that its images depend on."""
    return {
        "settings": json.loads(json.dumps(dataclasses.asdict(settings))),
        "variant": mi.variant(),
        "versions": {"mitsuba": mi.__version__, "mi_diffind": __version__},
        **subject.record(),
    }


def _check_record(folder: Path, record: dict) -> None:
    """Raise :class:`CaptureError` if a folder holds a capture with other settings, or views of another program."""
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
    changes = []
    for key, value in now.items():
        was = before.get(key)
        if key == "digest" and was != value:
            changes.append("the scene's files have changed")
        elif isinstance(value, dict):
            was = was or {}
            keys = dict.fromkeys([*value, *was])
            changes += [f"{k}: {was.get(k)}, now {value.get(k)}" for k in keys if was.get(k) != value.get(k)]
        elif was != value:
            changes.append(f"{key}: {was}, now {value}")
    return changes


def _name(split: str, i: int, settings: CaptureSettings) -> str:
    return f"{split}/r_{i:03d}.{settings.format}"


def _write_lists(folder: Path, settings: CaptureSettings, splits: dict, box: np.ndarray) -> list[str]:
    """Write ``transforms_*.json`` of the rendered images, and return their names."""
    margin = MARGIN * (box[1] - box[0]).max()
    head = {
        "camera_angle_x": math.radians(settings.fov),
        "w": settings.resolution,
        "h": settings.resolution,
        "aabb": [(box[0] - margin).tolist(), (box[1] + margin).tolist()],
    }
    names = []
    for split, poses in splits.items():
        there = [i for i in range(len(poses)) if (folder / _name(split, i, settings)).is_file()]
        frames = [{"file_path": f"./{_name(split, i, settings)}", "transform_matrix": poses[i].tolist()} for i in there]
        names += [_name(split, i, settings) for i in there]
        if poses:
            write_json(folder / f"transforms_{split}.json", {**head, "frames": frames})
    return names


def _write(path: Path, image: np.ndarray) -> None:
    """Write a linear image ``(height, width, 4)``, multiplied by alpha: PNG as sRGB with straight alpha, or EXR."""
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
    """Return a summary as lines of text."""
    box = " to ".join(map(_point, captured.box))
    count = f"{len(captured.files)} of {captured.total} views"
    text = [
        f"{captured.folder}: {count}, {captured.rendered} rendered now, {captured.seconds:.1f} s",
        f"  from a distance of {captured.radius:.4g} around {_point(captured.centre)}, box {box}",
    ]
    if captured.opaque:
        text.append("  alpha is 1 everywhere: surfaces behind the objects became part of the views")
    return [*text, *(f"  {note}" for note in captured.notes)]


def _point(p: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in p) + ")"
