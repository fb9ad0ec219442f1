"""Views of a scene from all sides, with camera poses, in the layout of NeRF's Blender data (Mildenhall et al. 2020).

A folder holds ``transforms_train.json``, ``transforms_test.json`` and an image with alpha for each view. Images show
the scene's surfaces in its light; lights, environments included, are hidden and leave alpha 0. Poses and boxes are in
the scene's own coordinates. ``capture.json`` records the settings; the same call continues a folder, view by view.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
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
from ..core.errors import UsageError, reason
from ..core.files import replacing, writable_folder, write_json
from ..core.jobs import run_jobs
from ..core.runtime import use_variant
from ..core.threads import threads_for_files
from ..core.units import check_memory, check_samples
from ..images import srgb
from ..plugins.support import footprint
from . import loading, splats
from .loading import SceneError
from .poses import orbit_directions, pose, sphere_directions, upright_frame

#: Samples of the whole image in one pass.
PASS = 1 << 23

#: Margin of the box that is written with the views, on each side, as a part of its longest side.
MARGIN = 0.01

#: Surfaces of other shapes that a camera ray may pass through on its way to the captured objects.
THROUGH = 8

#: Largest number of a half float, the type of the colours of an EXR.
LARGEST = 65504.0

#: Bytes of memory for a sample of a pass, roughly.
SAMPLE_BYTES = 512

#: Bytes of memory for the camera of a view, roughly.
VIEW_BYTES = 1024

#: Shapes of the camera path.
PATHS = ("sphere", "orbit")

#: Formats of the images.
FORMATS = ("png", "exr")

#: File that records the settings of a folder.
RECORD = "capture.json"


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture: number and size of the views, samples, camera path.

    ``views`` are for training, ``test`` further ones for tests: square images of ``resolution`` pixels with a field of
    view ``fov`` (degrees) and ``spp`` samples a pixel. ``objects`` are the ids of the captured shapes (none: all
    surfaces that do not shine); all other shapes only cast light and shadow on them. Cameras look at ``centre``
    (default: the centre of the objects' box) from the distance ``radius`` (default: a sphere around the objects fills
    the image). ``path``: "sphere", all over it, or "orbit", once around the axis ``up``. ``elevation``: the lowest and
    the highest, degrees above the plane normal to ``up``; an orbit swings between them (default: −90, 90 for a sphere,
    20, 20 for an orbit). ``format``: "png", as displayed, 8 bits, or "exr", linear half floats. ``box``: of 3D
    Gaussians, the lower and the upper corner of what is captured (default: :meth:`.splats.Splats.crop`). Other
    values raise :class:`.UsageError`.
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
    box: tuple[float, ...] | None = None

    def __post_init__(self):
        if self.path not in PATHS:
            raise UsageError(f'path: found "{self.path}", allowed are {", ".join(PATHS)}')
        if self.format not in FORMATS:
            raise UsageError(f'format: found "{self.format}", allowed are {", ".join(FORMATS)}')
        for name, least in (("views", 1), ("test", 0), ("resolution", 1), ("spp", 1)):
            if getattr(self, name) < least:
                raise UsageError(f"{name}: found {getattr(self, name)}, allowed are whole numbers ≥ {least}")
        check_samples(self.spp)
        check_memory("resolution", self.resolution, SAMPLE_BYTES * self.resolution**2)
        check_memory("views", self.views + self.test, VIEW_BYTES * (self.views + self.test))
        if not 0 < self.fov < 170:
            raise UsageError(f"fov: found {self.fov:g}, allowed are degrees between 0 and 170")
        if self.radius is not None and not 0 < self.radius < math.inf:
            raise UsageError(f"radius: found {self.radius:g}, allowed are numbers > 0")
        if self.centre is not None and not np.isfinite(self.centre).all():
            raise UsageError("centre: found NaN or infinity, allowed are numbers")
        if not np.isfinite(self.up).all() or not np.any(self.up):
            raise UsageError("up: found no direction, allowed are three numbers that are not all 0")
        if self.box is not None and not (len(self.box) == 6 and np.less(self.box[:3], self.box[3:]).all()):
            raise UsageError("box: found no box, allowed are six numbers, those of the lower corner first")
        low, high = self.elevations
        if not -90 <= low <= high <= 90:
            raise UsageError(
                f"elevation: found {low:g} to {high:g}, allowed are degrees from −90 to 90, the lower first"
            )

    @property
    def elevations(self) -> tuple[float, float]:
        """Lowest and highest elevation, degrees: ``elevation`` or its default."""
        return self.elevation or ((20.0, 20.0) if self.path == "orbit" else (-90.0, 90.0))

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return unit vectors from the centre to the cameras, ``(views, 3)`` and ``(test, 3)``; z is up."""
        low, high = np.radians(self.elevations)
        if self.path == "orbit":
            return orbit_directions(self.views, self.test, low, high)
        return sphere_directions(self.views, self.test, low, high, self.seed)


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
        names = ("interrupted", "files", "rendered", "seconds", "radius")
        return {
            **{name: getattr(self, name) for name in names}, "output": str(self.folder), "views": self.total,
            "centre": self.centre.tolist(), "box": self.box.tolist(), "notes": list(self.notes),
        }  # fmt: skip

    @property
    def images(self) -> list[np.ndarray]:
        """Images of all ``files``, ``(height, width, 4)``, read when asked for: uint8, or of EXR linear floats."""
        with threads_for_files():
            return [np.array(mi.Bitmap(str(self.folder / name))) for name in self.files]

    def __str__(self) -> str:
        lines = [
            f"{self.folder}: {len(self.files)} of {self.total} views, {self.rendered} rendered now, "
            f"{self.seconds:.1f} s",
            f"  from a distance of {self.radius:.4g} around {_point(self.centre)}, "
            f"box {' to '.join(map(_point, self.box))}",
        ]
        if self.opaque:
            lines.append("  alpha is 1 everywhere: surfaces behind the objects became part of the views")
        return "\n".join([*lines, *(f"  {note}" for note in self.notes)])


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
    also be a file of 3D Gaussians (:mod:`.splats`), of which ``box`` crops a part. ``given`` are fields of
    :class:`CaptureSettings`, the options of ``mi-diffind capture`` as keywords: ``views=60``, ``resolution=160``,
    ``path="orbit"``, …; ``defines`` replace the file's ``<default>`` parameters; ``workers`` processes share the views,
    or those of the Dask cluster ``scheduler``. The folder is created if its parent exists. Views of an earlier capture
    with the same settings of the same scene are kept, unless a dictionary holds objects that exist already; after
    Ctrl-C the current view is the last. Raises :class:`.UsageError` for bad settings, :class:`.SceneError`, also for a
    folder with other settings, and :class:`.OutputError`.
    """
    use_variant()
    settings = _settings(scene, given)
    subject = _subject(scene, defines, settings)
    folder = writable_folder(folder, create=True)
    record = {
        "settings": json.loads(json.dumps(dataclasses.asdict(settings))),
        "variant": mi.variant(),
        "versions": {"mitsuba": mi.__version__, "mi_diffind": __version__},
        **subject.record(),
    }
    _check_record(folder, record)
    box = subject.bounds()
    centre = box.mean(axis=0) if settings.centre is None else np.array(settings.centre, np.float64)
    radius = settings.radius or subject.reach(centre) / math.sin(math.radians(settings.fov) / 2)
    if not radius > 0:
        raise SceneError(f"{subject.path}: the captured objects have no extent, --radius has to be given")
    subject.prepare()
    write_json(folder / RECORD, record)
    poses, start = _plan(settings, centre, radius), time.perf_counter()
    for split in poses:
        writable_folder(folder / split, create=True)
    views = {_name(split, i, settings): (split, i) for split, places in poses.items() for i in range(len(places))}
    missing = {name: view for name, view in views.items() if not (folder / name).is_file()}
    _write_lists(folder, settings, poses, box)
    render, rendered, opaque = functools.partial(_render, subject, poses, folder), 0, bool(missing)
    if workers or scheduler:
        render = functools.partial(render_separately, _pickle(scene, subject, centre, radius), folder.resolve())
    jobs = run_jobs(render, missing, workers, scheduler, progress, "capture", "view", len(views) - len(missing))
    with contextlib.closing(jobs) as outcomes:
        for outcome in outcomes:
            if outcome.failure:
                raise SceneError(f"{outcome.name}: {outcome.failure}")
            rendered += 1
            opaque &= outcome.value
    seconds = time.perf_counter() - start
    files = _write_lists(folder, settings, poses, box)
    return Captured(folder, files, len(views), rendered, seconds, radius, centre, box, opaque, subject.notes)


def _render(subject: SceneSubject, poses: dict, folder: Path, view: tuple[str, int]) -> bool:
    """Render a view, write it, and return whether it is opaque everywhere."""
    split, i = view
    seed = (subject.settings.seed << 16) + 2 * i + (split == "test")
    image = subject.render(poses[split][i], seed % 2**32)
    _write(folder / _name(split, i, subject.settings), image)
    return bool((image[..., 3] > 0.999).all())


def _pickle(scene, subject: SceneSubject, centre: np.ndarray, radius: float) -> bytes:
    """Return what another process needs to render views (:func:`render_separately`). Raises :class:`.UsageError`."""
    source = scene if isinstance(scene, dict) else str(subject.path.resolve())
    try:
        return pickle.dumps((source, subject.record()["defines"], subject.settings, centre, radius, mi.variant()))
    except Exception:  # of the objects in a dictionary, each has its own
        raise UsageError("workers: the scene holds objects of this process, a scene file is needed") from None


def render_separately(content: bytes, folder: Path, view: tuple[str, int]) -> bool:
    """Render a view in this process, which loads the scene once, and write it; return whether it is opaque."""
    return _render(*_cached_subject(content), folder, view)


@functools.lru_cache(maxsize=1)
def _cached_subject(content: bytes) -> tuple[SceneSubject, dict]:
    scene, defines, settings, centre, radius, variant = pickle.loads(content)
    use_variant(variant)
    subject = _subject(scene, defines, settings)
    subject.prepare()
    return subject, _plan(settings, centre, radius)


def _subject(scene, defines: Mapping | None, settings: CaptureSettings) -> SceneSubject | splats.SplatSubject:
    """Return the subject of a capture. Raises :class:`.UsageError`."""
    if not splats.is_splats(scene):
        if settings.box is not None:
            raise UsageError("box: given with a scene, allowed are files of 3D Gaussians; objects names shapes")
        return SceneSubject(scene, defines, settings)
    for name, value in (("defines", defines), ("objects", settings.objects)):
        if value:
            raise UsageError(f"{name}: given with the 3D Gaussians {scene}, allowed are scenes")
    return splats.SplatSubject(scene, settings)


class SceneSubject:
    """Scene as the subject of a capture, seen by a camera beside its own sensors."""

    notes = ()

    def __init__(self, scene, defines: Mapping | None, settings: CaptureSettings):
        self.parsed, self.settings = loading.ParsedScene(scene, defines), settings
        self.path = self.parsed.path

    @functools.cached_property
    def scene(self):
        """Scene whose integrators hide its lights, and whose meshes keep their ids."""

        def hide(state) -> None:
            for props in loading.integrator_properties(state):
                if not loading.nests_another(props):  # the nested one follows the paths
                    props["hide_emitters"] = True

        parsed = self.parsed.copy()
        parsed.change(hide)
        return parsed.load(merge=False, needs=())

    def shapes(self) -> list:
        """Return the captured shapes, without ``objects`` all that are no lights. Raises :class:`.SceneError`."""
        shapes = self.scene.shapes()
        ids = {s.id() for s in shapes}
        for name in self.settings.objects:
            if name not in ids:
                named = ", ".join(sorted(n for n in ids if n and not n.startswith("_"))) or "none has one"
                raise SceneError(f'objects: found "{name}", the ids of the scene\'s shapes are: {named}')
        shapes = [
            s for s in shapes if (s.id() in self.settings.objects if self.settings.objects else not s.is_emitter())
        ]
        if not shapes:
            raise SceneError("the scene has no surfaces but lights, there is nothing to capture")
        return shapes

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
        """Return the corners ``(2, 3)`` of the captured objects' box. Raises :class:`.SceneError`."""
        box = loading.bounds(self.shapes())
        if not np.isfinite(box).all():
            raise SceneError("the box around the captured objects is not finite: name the objects")
        return box

    def reach(self, centre: np.ndarray) -> float:
        """Return the largest distance of objects from a point: of vertices of meshes, of corners of other boxes."""
        reach, vertices = 0.0, "vertex_positions"
        for shape in self.shapes():
            parameters = mi.traverse(shape) if isinstance(shape, mi.Mesh) and shape.vertex_count() else {}
            if vertices in parameters:
                points = np.array(parameters[vertices], np.float64).reshape(-1, 3)
            else:
                points = np.array(list(itertools.product(*loading.bounds([shape]).T)))
            reach = max(reach, float(np.linalg.norm(points - centre, axis=1).max()))
        return reach

    def prepare(self) -> None:
        """Set up the camera. Raises :class:`.SceneError`."""
        side, mono = self.settings.resolution, mi.is_monochromatic
        self.sensor = mi.load_dict({
            "type": "perspective", "fov": self.settings.fov, "fov_axis": "x", "near_clip": 1e-3, "far_clip": 1e6,
            "film": {
                "type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"},
                "pixel_format": "luminance_alpha" if mono else "rgba", "component_format": "float32",
            },
            "sampler": {"type": "multijitter", "sample_count": self.settings.spp},
        })  # fmt: skip
        self.parameters = mi.traverse(self.sensor)
        self.integrator = self.scene.integrator() or mi.load_dict({"type": "path", "hide_emitters": True})
        if self.settings.objects:
            self.integrator = _only(self.integrator, self.shapes())

    def render(self, pose: np.ndarray, seed: int) -> np.ndarray:
        """Render a view, ``(height, width, 4)``, float32: linear colours, multiplied by alpha, and alpha."""
        matrix = pose @ np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba's cameras look along +z, x to the left
        sensor, side, spp = self.sensor, self.settings.resolution, self.settings.spp
        self.parameters["to_world"] = type(self.parameters["to_world"])(mi.ScalarTransform4f(matrix))
        self.parameters.update()
        footprint.attach(self.scene, sensor, spp)
        total, done, passes, bad = 0.0, 0, 0, np.zeros((side, side), bool)
        most = 1 << (max(1, PASS // side**2).bit_length() - 1)
        while done < spp:
            n = min(most, spp - done)
            if loading.sampler_count(sensor, n) > n:  # multijitter takes powers of four as they are
                n = 4 ** ((n.bit_length() - 1) // 2)
            with loading.scene_errors(None):
                seed_of_pass = (seed * 4096 + passes) % 2**32
                image = mi.render(self.scene, sensor=sensor, integrator=self.integrator, spp=n, seed=seed_of_pass)
            image = image.numpy().astype(np.float64)
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


def _settings(scene, given: dict) -> CaptureSettings:
    """Return the settings with the ``given`` fields. Raises :class:`.UsageError`."""
    allowed = [f.name for f in dataclasses.fields(CaptureSettings)]
    for name in given:
        if name not in allowed:
            raise UsageError(f'capture: found the argument "{name}", allowed are {", ".join(allowed)}')
    names = ("centre", "elevation", "up", "objects", "box")
    tuples = {name: tuple(given[name]) for name in names if given.get(name) is not None}
    if given.get("spp") is None:
        tuples["spp"] = splats.SPP if splats.is_splats(scene) else CaptureSettings.spp
    return CaptureSettings(**{**given, **tuples})


def _plan(settings: CaptureSettings, centre: np.ndarray, radius: float) -> dict[str, list[np.ndarray]]:
    """Return the poses of each split, ``"train"`` and ``"test"``."""
    frame = upright_frame(settings.up)
    places = (d @ frame.T * radius + centre for d in settings.directions())
    return {
        split: [pose(origin, centre, settings.up) for origin in origins]
        for split, origins in zip(("train", "test"), places, strict=True)
    }


def _only(inner, shapes: list):
    """Return an integrator whose camera rays see only these ``shapes``, and pass through all others.

    Rays pass through up to :data:`THROUGH` surfaces. Right before the first surface of the shapes, ``inner`` takes
    over, which sees everything.
    """
    for shape in shapes:
        if hasattr(shape, "seen_by"):
            raise SceneError(
                f'objects: found "{shape.id()}", whose arrays {" and ".join(shape.seen_by)} traces; allowed are meshes '
                f"and Mitsuba's own shapes"
            )
    if not isinstance(inner, mi.SamplingIntegrator):
        raise SceneError(f"objects: the integrator {inner.class_name()} follows no rays from a camera, as path does")
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


def _check_record(folder: Path, record: dict) -> None:
    """Raise :class:`.SceneError` if a folder holds a capture with other settings, or views of another program."""
    path = folder / RECORD
    if not path.is_file():
        if next(folder.glob("transforms*.json"), None) is not None:
            raise SceneError(f"{folder}: holds views that were not captured here, a folder of its own is needed")
        return
    try:
        before, now = _flat(json.loads(path.read_text(encoding="utf-8"))), _flat(record)
    except (ValueError, OSError, AttributeError) as e:
        raise SceneError(f"{path}: cannot be read ({reason(e)})") from None
    keys = [key for key in dict.fromkeys([*now, *before]) if before.get(key) != now.get(key)]
    if keys:
        changes = [
            "the scene's files have changed"
            if key[0] == "digest"
            else f"{key[-1]}: {before.get(key)}, now {now.get(key)}"
            for key in keys
        ]
        raise SceneError(
            f"{folder}: holds a capture with other settings ({'; '.join(changes)}): take those, or another folder"
        )


def _flat(record: dict) -> dict[tuple, object]:
    """Return the values of a record by their path in it."""
    parts = [(k, v if isinstance(v, dict) else {None: v}) for k, v in record.items()]
    return {tuple(filter(None, (k, inner))): value for k, part in parts for inner, value in part.items()}


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


def _point(p: np.ndarray) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in p) + ")"
