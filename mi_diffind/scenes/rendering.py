"""Rendering of a scene or of cameras that move through it: ``mi_diffind.render``, to the path depth that is needed."""

import contextlib
import io
import os
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import plugins
from ..core.errors import UsageError
from ..core.files import replacing
from ..core.progress import interruptible, progress_bar
from ..core.runtime import use_variant
from ..core.units import check_memory
from ..images import films, metrics
from ..plugins.support import footprint
from . import conversion, loading
from . import depth as depths
from .poses import rotation

#: Samples per pixel of a pass, after each of which Ctrl-C may end the rendering.
PASS = 16

#: Numbers of passes that are tried beside that of :data:`PASS`, for samplers that round up.
TRIED = 8

#: Axis of an orbit.
UP = (0.0, 1.0, 0.0)

#: Largest number of frames in a row of a film strip.
COLUMNS = 6


@dataclass
class Rendering:
    """Rendered ``frames``, linear ``(height, width, channels)`` float32: one image, or the frames of an orbit.

    ``figures`` are those of ``mi-diffind render --json``: ``spp``, ``seed``, ``variant``, ``seconds_render``, ``depth``
    and, of a scene that was given as a file, its ``learned_plugins`` and ``table_bytes``.
    """

    frames: list[np.ndarray] = field(repr=False)
    figures: dict
    scene: object = field(repr=False)

    @property
    def image(self) -> np.ndarray:
        """The image, or all frames side by side (:func:`strip`)."""
        return self.frames[0] if len(self.frames) == 1 else strip(self.frames)

    def save(self, path: str | os.PathLike) -> Path:
        """Write the image (``.exr``, ``.png``) or a film (``.mp4``, ``.webp``, ``.gif``), and return the path.

        Raises :class:`.UsageError` and :class:`.OutputError`.
        """
        path = image_path(path, len(self.frames) > 1)
        _check_channels(path, self.image.shape[2])
        extension = path.suffix.lower()
        if extension in films.FILMS and len(self.frames) > 1:
            displayed = films.over_black if extension == ".mp4" else films.displayed
            films.write(path, [displayed(frame) for frame in self.frames])
        elif extension == ".png" and len(self.frames) > 1:
            with replacing(path) as temporary:
                temporary.write_bytes(self._repr_png_())
        else:
            loading.write_image(path, self.image)
        return path

    def _repr_png_(self) -> bytes:
        from PIL import Image

        stream = io.BytesIO()
        Image.fromarray(films.displayed(self.image)).save(stream, "PNG")
        return stream.getvalue()


def _check_channels(path: Path, channels: int) -> None:
    if path.suffix.lower() != ".exr" and channels > 4:
        form = path.suffix[1:].upper()
        raise UsageError(f'output "{path}": the image has {channels} channels, {form} holds 4: use .exr')


def channel_count(scene) -> int:
    """Return the number of channels of the images of a scene: those of its film, and further ones of its integrator."""
    names = scene.integrator().aov_names() if scene.integrator() else []
    images = {name.removesuffix(".A") for name in names if name.endswith(".A")}  # nested in aov, in the film's format
    further = [name for name in names if name.rpartition(".")[0] not in images]
    return scene.sensors()[0].film().base_channels_count() + len(further)


def image_path(path: str | os.PathLike, film: bool = False) -> Path:
    """Return the path of a picture, or with ``film`` of a film. Raises :class:`.UsageError`."""
    path, allowed = Path(path), (".exr", ".png", *(films.FILMS if film else ()))
    if path.suffix.lower() not in allowed:
        names = ", ".join(allowed) if film else " and ".join(allowed)
        raise UsageError(f'output "{path}": found the extension "{path.suffix}", allowed are {names}')
    films.check_encoder(path)
    return path


def render(
    scene,
    spp: int | None = None,
    seed: int = 0,
    *,
    depth: int | str = "scene",
    depth_tolerance: float | None = None,
    orbit: int | None = None,
    centre: Sequence[float] | None = None,
    defines: Mapping[str, object] | None = None,
    output: str | os.PathLike | None = None,
    learn: Sequence[str] = (),
    progress: bool = True,
) -> Rendering:
    """Render a scene: ``mi-diffind render`` in Python, in the variant that is set.

    - ``scene``: a scene file, a dictionary, or a loaded ``mi.Scene``.
    - ``spp``: samples per pixel (``None``: the scene's); ``seed``: seed of the random numbers.
    - ``depth``: longest path, counted as ``max_depth``: a number, ``"scene"``, or ``"auto"``, the smallest depth that
      leaves out less than ``depth_tolerance`` of the scattered light (of a scene file; :mod:`mi_diffind.scenes.depth`).
    - ``orbit``: number of frames of a camera that goes once around ``centre`` (``None``: the middle of the scene).
    - ``defines``: values of the file's ``<default>`` parameters.
    - ``output``: file in which the image will be saved; nothing is written there, but one that cannot hold the image
      is refused before it is rendered.
    - ``learn``: groups of Mitsuba's plugins that learned ones replace (:mod:`.conversion`), fitted if need be.

    Ctrl-C ends the rendering after a pass or a frame and keeps what there is; ``figures["interrupted"]`` is then true.
    Raises :class:`.SceneError` and :class:`.UsageError`.
    """
    use_variant()
    if centre is not None and not orbit:
        raise UsageError("centre: given without orbit, whose middle it is")
    if depth_tolerance is not None and depth != "auto":
        raise UsageError('depth_tolerance: given without depth="auto"')
    if output is not None:
        image_path(output, bool(orbit))
    start = time.perf_counter()
    parsed, chosen, conversions = None, None, []
    if isinstance(scene, (str, os.PathLike)):
        parsed = loading.ParsedScene(scene, dict(defines or {}))
        conversions = conversion.replace_stock(parsed, learn, progress=progress)
        chosen = _choose_depth(parsed, depth, depth_tolerance, seed)
        changed = chosen["chosen"] != chosen["scene"]
        loaded = parsed.load(longest_path=chosen["chosen"] if changed else None)
    elif learn or depth != "scene" or defines:
        raise UsageError("learn, depth, defines: given with a scene in memory, allowed are scene files")
    else:
        loaded = loading.load_dict(scene) if isinstance(scene, dict) else scene
        if not isinstance(loaded, mi.Scene):
            raise UsageError(f"scene: found a {type(loaded).__name__}, expected a scene, its file or its dictionary")
    name = str(parsed.path) if parsed else "scene"
    loading.check_renderable(loaded, name)
    if output is not None:
        _check_channels(Path(output), channel_count(loaded))
    ready = time.perf_counter()
    spp = spp or loaded.sensors()[0].sampler().sample_count()
    footprint.check_samples(footprint.textures(loaded), spp)
    loading.check_size(loaded, spp)
    if orbit:
        width, height = loading.film_size(loaded)
        check_memory("orbit", orbit, 16 * orbit * width * height)
        with interruptible() as stop, progress_bar("orbit", orbit, "frame", progress) as bar:
            centre = middle(loaded) if centre is None else np.array(centre, np.float64)
            turns = [rotation(UP, 360 * i / orbit, centre) for i in range(orbit)]
            frames = along(loaded, turns, spp, seed, on_frame=bar.update, stop=stop)
        interrupted, done = len(frames) < orbit, sum(loading.sample_counts(loaded, spp))
    else:
        passes = pass_count(loaded, spp)
        with interruptible() as stop, progress_bar("render", passes, "pass", progress) as bar:
            image, seconds = loading.render(loaded, spp, seed, passes, bar.update, stop)
        frames, done = [image], sum(loading.sample_counts(loaded, spp, passes)[: len(seconds)])
        interrupted = len(seconds) < passes
    bad = sum(map(metrics.nonfinite_pixels, frames))
    if bad:
        total = len(frames) * frames[0].shape[0] * frames[0].shape[1]
        plugins.warn(f"{name}: {bad:,} of {total:,} rendered pixels are not finite (NaN or infinite)")
    loading.warn_if_black(loaded, name, frames)
    figures = {
        "interrupted": interrupted,
        "nonfinite_pixels": bad,
        "scene": name if parsed else None,
        "variant": mi.variant(),
        "width": frames[0].shape[1],
        "height": frames[0].shape[0],
        "spp": done,
        "spp_requested": spp,
        "seed": seed,
        "depth": chosen,
        "conversions": [vars(c) for c in conversions],
        "seconds_load": ready - start,
        "seconds_render": time.perf_counter() - ready,
    }
    if orbit:
        figures |= {"frames": len(frames), "frames_requested": orbit}
    elif parsed:
        learned = parsed.learned_plugins()
        figures |= {"learned_plugins": learned, "table_bytes": parsed.table_bytes(learned)}
    return Rendering(frames, figures, loaded)


def pass_count(scene, spp: int) -> int:
    """Return the number of passes, of about :data:`PASS` samples, of which the sampler rounds up least."""
    about = max(1, spp // PASS)
    counts = range(about, min(2 * about, about + TRIED, spp) + 1)
    return min(counts, key=lambda passes: sum(loading.sample_counts(scene, spp, passes)))


def _choose_depth(parsed: loading.ParsedScene, requested, tolerance: float | None, seed: int) -> dict:
    """Choose the depth to render to and say why; what was not measured is ``None``."""
    if requested == "auto":
        return {"requested": "auto", **depths.auto_depth(parsed, tolerance or depths.TOLERANCE, seed)}
    scene_depth = None
    with contextlib.suppress(loading.SceneError):  # no integrator with a depth: fine, unless one is asked for
        scene_depth = parsed.path_integrator()[1]
    chosen = scene_depth if requested == "scene" else requested
    unknown = ("tolerance", "shares", "left_out", "left_out_in_a_tile", "probe_seconds")
    return {"requested": requested, "chosen": chosen, "scene": scene_depth, **dict.fromkeys(unknown)}


# -- cameras that move ------------------------------------------------------------------------------------------------


def along(
    scene,
    motions: Sequence[np.ndarray],
    spp: int | None = None,
    seed: int = 0,
    new_seeds: bool = False,
    on_frame: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> list[np.ndarray]:
    """Render a loaded scene once for each of ``motions`` of its first camera, which then returns to its place.

    A motion is a matrix ``(4, 4)`` in world space that moves the camera from its place in the scene. All frames have
    the random numbers of ``seed``; with ``new_seeds``, frame ``i`` has those of ``seed + i``.

    Returns the linear images; once ``stop`` is set, the frames that are done. Raises :class:`.SceneError` if there is
    no camera that can be moved.
    """
    if not scene.sensors():
        raise loading.SceneError("orbit: the scene has no sensor")
    sensor = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    if "to_world" not in parameters:
        raise loading.SceneError(f"orbit: the sensor {sensor.class_name()} cannot be moved")
    transform, before = type(parameters["to_world"]), np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)

    def move(matrix: np.ndarray) -> None:
        parameters["to_world"] = transform(mi.ScalarTransform4f(matrix))
        parameters.update()
        footprint.attach(scene, 0, spp)

    images = []
    try:
        for i, motion in enumerate(motions):
            move(motion @ before)
            images.append(loading.render(scene, spp, seed + i * new_seeds)[0])
            if on_frame is not None:
                on_frame()
            if stop is not None and stop.is_set():
                break
    finally:
        move(before)
    return images


def middle(scene) -> np.ndarray:
    """Return the middle of the box of all shapes that are no lights, ``(3,)``; the origin without such shapes."""
    box = loading.bounds(s for s in scene.shapes() if not s.is_emitter())
    return box.mean(axis=0) if np.isfinite(box).all() else np.zeros(3)


def strip(frames: Sequence[np.ndarray]) -> np.ndarray:
    """Return one image of all frames, at most :data:`COLUMNS` in a row; missing cells are 0."""
    columns = min(COLUMNS, len(frames))
    rows = -(-len(frames) // columns)
    height, width, channels = frames[0].shape
    grid = np.zeros((rows * columns, height, width, channels), np.float32)
    grid[: len(frames)] = frames
    return grid.reshape(rows, columns, *frames[0].shape).swapaxes(1, 2).reshape(rows * height, -1, channels)
