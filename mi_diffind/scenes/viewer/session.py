"""State of the viewer without a page: a scene with learned plugins, its exact counterpart, camera and passes."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np

from ... import plugins
from ...arrays.tables import load_table
from ...core import compat
from ...core.errors import DiffindError, UsageError
from ...core.runtime import array_module, use_variant
from ...fitting.task import find_task
from ...images import metrics
from ...images.films import displayed
from .. import loading
from ..rendering import middle
from .passes import NamedParameter, RenderedSide, no_collection

#: Contents of the picture.
VIEWS = ("side by side", "learned", "exact", "difference")

#: Width of the picture in pixels by default.
WIDTH = 320

#: Smallest width of the picture in pixels.
NARROWEST = 16

#: Largest width of the picture in pixels.
WIDEST = 4096

#: Seconds of a picture while the camera moves above which the next is smaller.
SLOW = 0.18

#: Seconds of a picture while the camera moves below which the next is larger again.
FAST = 0.04

#: Factors by which the sides of a picture are smaller while the camera moves.
REDUCTIONS = (1, 2, 4)

#: Maps that a texture's table file shows, the first that the file has; else its first map.
SHOWN_MAPS = ("base_color", "albedo", "image")

#: Direction from the middle of what a table file shows to the camera.
CAMERA = (0.5, 0.35, 1.0)

#: Direction from the middle of what a table file shows to the lamp.
LAMP = (-0.6, 1.0, 0.7)


class Session:
    """Scene that is looked at: what is shown, from where, with which values, and the picture so far.

    The arguments are those of :func:`mi_diffind.view`. A table file is shown by :func:`table_scene`. A picture is the
    mean of passes of one sample, ``passes`` so far; :meth:`refine` adds one. A change of anything restarts it.
    ``refusal`` is the sentence that says why there is no exact side, "" if there is one. Poses are matrices ``(4, 4)``
    of a sensor that only rotate and move; ``start`` is that of the scene. Computations run in the thread that calls,
    and only one thread may.

    Raises :class:`.SceneError`, :class:`.TableError` and :class:`.UsageError`.
    """

    def __init__(
        self,
        source: str | os.PathLike | dict,
        width: int = WIDTH,
        spp: int | None = None,
        seed: int = 0,
        *,
        against: str = "exact",
        defines: Mapping[str, object] | None = None,
    ):
        use_variant()
        if not isinstance(width, int) or not NARROWEST <= width <= WIDEST:
            raise UsageError(f"width: found {width}, allowed are whole numbers from {NARROWEST} to {WIDEST}")
        loading.check_counterpart(against)
        self.against, self.seed, self._values = against, seed, {}
        in_file = isinstance(source, (str, os.PathLike))
        self.name = Path(source).name if in_file else "scene"
        if in_file and Path(source).suffix.lower() == ".npz":
            if defines:
                raise UsageError(f"{source}: found a table file with defines, which only a scene file has")
            source = table_scene(source)
        self._parsed = loading.ParsedScene(source, dict(defines or {}), self.name)
        self._load(width)
        sensor = self.learned.scene.sensors()[0]
        if "to_world" not in self.learned.placement:
            raise loading.SceneError(f"{self._parsed.path}: the sensor {sensor.class_name()} cannot be moved")
        film = loading.film_size(self.learned.scene)
        self.full = (width, max(1, round(width * film[1] / film[0]))) if self.learned.by_pixels else film
        self.spp = _check_samples(spp or sensor.sampler().sample_count())
        loading.check_size(self.learned.scene, self.spp, self.full)
        written = np.array(self.learned.placement["to_world"].matrix, np.float64).reshape(4, 4)
        self.pose = self.start = rigid(written)
        self._residue = np.linalg.inv(self.start) @ written
        self.view = self.views[0]
        self.divider, self.gain = 0.5, 10.0
        self.moving, self.reduction, self.pictures = False, REDUCTIONS[0], 0
        self._place()

    def _load(self, width: int) -> None:
        """Load both sides, with films of a ``width``."""
        parsed, names = self._parsed, tuple(dict.fromkeys((self.against, "exact")))
        parsed.change(lambda state: _resize(state, width))
        self.exact, self.refusal = None, ""
        with no_collection():
            self.learned = RenderedSide(parsed.load(), 1)
            self.table_bytes = parsed.table_bytes(parsed.learned_plugins())
            replaced = parsed.learned_plugins(names)
            if not replaced:
                self.refusal = "the scene names no learned plugin, so there is nothing to compare"
                return
            counterparts = [plugins.declared()[entry["plugin"]].counterpart(names) for entry in replaced]
            try:
                exact = parsed.load(exact=True, against=names)
            except DiffindError as e:
                self.refusal = str(e)
            else:
                self.exact = RenderedSide(exact, max(c.oversampling for c in counterparts))

    # -- what is shown ------------------------------------------------------------------------------------------------

    @property
    def views(self) -> tuple[str, ...]:
        """Allowed values of :attr:`view`: all of :data:`VIEWS` if there is an exact side."""
        return VIEWS if self.exact else VIEWS[1:2]

    def show(self, view: str | None = None, divider: float | None = None, gain: float | None = None) -> None:
        """Choose one of :attr:`views`, the place of the divider, 0 to 1, or the factor of the difference.

        The samples so far are kept, unless another side becomes visible. Raises :class:`.UsageError`.
        """
        if view is not None and view not in self.views:
            because = f" ({self.refusal})" if self.refusal else ""
            raise UsageError(f'view: found "{view}", allowed are {", ".join(self.views)}{because}')
        self.divider = self.divider if divider is None else float(divider)
        self.gain = self.gain if gain is None else float(gain)
        self.view = view or self.view
        if view and (len({side.passes for side in self._visible()}) > 1 or self.passes == 0):
            self._restart()

    def _visible(self) -> list[RenderedSide]:
        if self.exact is None or self.view == "learned":
            return [self.learned]
        return [self.exact] if self.view == "exact" else [self.learned, self.exact]

    def _sides(self) -> list[RenderedSide]:
        return [self.learned, self.exact] if self.exact else [self.learned]

    # -- camera -------------------------------------------------------------------------------------------------------

    def move_camera(self, pose: np.ndarray) -> bool:
        """Move the camera, and return whether it moved; the next :meth:`moving_picture` shows it."""
        if not np.isfinite(pose).all():
            raise UsageError("camera: found a position or a direction that is not finite")
        if np.allclose(pose, self.pose, rtol=1e-6, atol=1e-6 * (1 + np.abs(pose[:3, 3]).max())):
            return False
        self.pose = pose
        self._restart()
        return True

    def target(self) -> np.ndarray:
        """Return the point on the first view's axis that the camera turns about: the nearest to the scene's middle."""
        position, forward = self.start[:3, 3], self.start[:3, 2]
        distance = float((middle(self.learned.scene) - position) @ forward)
        if distance <= 1e-6:
            box = self.learned.scene.bbox()
            distance = float(np.linalg.norm(np.array(box.max) - np.array(box.min))) / 4 if box.valid() else 1.0
            distance = distance if math.isfinite(distance) and distance > 0 else 1.0
        return position + distance * forward

    def up(self) -> np.ndarray:
        """Return the upward direction of the world: the axis nearest to the camera's, which a level camera shares."""
        left, up = self.start[:3, 0], self.start[:3, 1]
        axis = np.where(np.arange(3) == np.abs(up).argmax(), np.sign(up), 0.0)
        return axis if abs(float(axis @ left)) < 1e-3 else up

    # -- passes -------------------------------------------------------------------------------------------------------

    @property
    def passes(self) -> int:
        """Passes of the picture so far."""
        return min(side.passes for side in self._visible())

    @property
    def finished(self) -> bool:
        """Whether the picture has all of its samples, at full size."""
        return not self.moving and self.passes >= self.spp

    def moving_picture(self) -> np.ndarray:
        """Render one sample per pixel from where the camera is, at a reduced size if need be; return the picture.

        If pictures take more than :data:`SLOW` seconds, the next one has half the width and height, at most a quarter.
        """
        if not self.moving:
            self.moving = True
            self._restart()
        start = time.perf_counter()
        self._place()
        self._add_pass()
        seconds = time.perf_counter() - start
        if self.learned.by_pixels and all(side.settled for side in self._visible() if side.seconds > 0):
            index = REDUCTIONS.index(self.reduction) + (seconds > SLOW) - (seconds < FAST)
            self.reduction = REDUCTIONS[min(max(index, 0), len(REDUCTIONS) - 1)]
        return self.picture()

    def refine(self) -> np.ndarray:
        """Add a pass at full size, unless the picture is :attr:`finished`, and return the picture."""
        if self.moving:
            self.moving = False
            self._restart()
        if not self.finished:
            if self.passes == 0:
                self._place()
            self._add_pass()
        return self.picture()

    def _place(self) -> None:
        for side in self._sides():
            side.place(self.pose @ self._residue, self.spp)

    def _add_pass(self) -> None:
        """Render the sides that are visible; while the camera moves, each only where it is visible."""
        reduction = self.reduction if self.moving and self.learned.by_pixels else 1
        width, height = (max(1, round(n / reduction)) for n in self.full)
        for side in self._visible():
            first, after = 0, width
            if self.moving and self.view == VIEWS[0]:
                column = round(self.divider * width)
                first, after = (0, column) if side is self.exact else (column, width)
            if first < after:
                side.add_pass((width, height, first, after), self.spp, self.seed, self.moving)
            else:
                side.region = (width, height, 0, 0)
                side.passes += 1
        self.pictures += 1

    def _restart(self) -> None:
        for side in self._sides():
            side.restart()

    # -- values -------------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> dict[str, NamedParameter]:
        """Numbers and colours of the scene by their paths (:class:`.passes.NamedParameters`)."""
        return self.learned.parameters.listed

    def set(self, values: Mapping[str, object]) -> None:
        """Give parameters other values on both sides, as far as both have them.

        If the scene refuses them, it keeps the old ones. Raises :class:`.UsageError` and :class:`.SceneError`.
        """
        checked = {path: self.learned.parameters.check(path, value) for path, value in values.items()}
        before = {path: self.learned.parameters.value(path) for path in checked}
        try:
            with loading.scene_errors(self._parsed.path):
                self._set(checked)
        except loading.SceneError:
            self._set(before)
            raise
        self._values |= checked
        self._restart()

    def _set(self, values: Mapping[str, object]) -> None:
        self.learned.change(values)
        if self.exact:
            named = {self.exact.parameters.counterpart(path): value for path, value in values.items()}
            self.exact.change({path: value for path, value in named.items() if path})

    def on_both(self, path: str) -> bool:
        """Return whether a parameter changes the exact side, too."""
        return self.exact is None or bool(self.exact.parameters.counterpart(path))

    def samples(self, spp: int) -> None:
        """Choose the samples per pixel of a finished picture. Raises :class:`.UsageError`."""
        self.spp = _check_samples(spp)
        self._restart()  # the footprint of a sample depends on their number

    # -- picture and figures ------------------------------------------------------------------------------------------

    def picture(self) -> np.ndarray:
        """Return the picture, as bytes for a screen ``(height, width, 3)``.

        Side by side, the exact scene is left of a white line at ``divider``, the learned one right of it. The
        difference is the absolute one of values clipped to [0, 1], times ``gain``, grey where colours agree in it.
        """
        sides = self._visible()
        if len(sides) == 1:
            return displayed(sides[0].image)
        return combine(self.exact.image, self.learned.image, self.view, self.divider, self.gain)

    @property
    def figures(self) -> dict:
        """Figures of the picture.

        ``seconds`` of the last pass of each visible side, ``psnr_db`` between the sides as they are now, noise
        included (``None`` unless both are rendered as a whole, and finite), ``nonfinite_pixels`` of the visible sides,
        ``table_bytes`` of the learned plugins, ``samples``, ``spp``, ``width`` and ``height``.
        """
        sides, names = self._visible(), {id(self.learned): "learned", id(self.exact): "exact"}
        bad = sum(metrics.nonfinite_pixels(side.image) for side in sides) if self.passes else 0
        both = not bad and len(sides) == 2 and self.passes and not (self.moving and self.view == VIEWS[0])
        return {
            "scene": self.name,
            "variant": mi.variant(),
            "view": self.view,
            "against": self.against if self.exact else None,
            "width": sides[0].region[0] or self.full[0],
            "height": sides[0].region[1] or self.full[1],
            "samples": self.passes,
            "spp": self.spp,
            "pictures": self.pictures,
            "seconds": {names[id(side)]: side.seconds for side in sides if side.seconds > 0},
            "psnr_db": metrics.psnr(self.exact.image, self.learned.image) if both else None,
            "nonfinite_pixels": bad,
            "table_bytes": self.table_bytes,
            "values": {k: list(v) if isinstance(v, tuple) else v for k, v in self._values.items()},
            "to_world": (self.pose @ self._residue).tolist(),
        }


def _check_samples(spp) -> int:
    if not isinstance(spp, int) or not 1 <= spp <= 2**16:
        raise UsageError(f"spp: found {spp}, allowed are whole numbers from 1 to {2**16}")
    return spp


def rigid(to_world: np.ndarray) -> np.ndarray:
    """Return the pose of a sensor's matrix ``(4, 4)``: without scale, and turned back where it mirrors."""
    up, forward = (to_world[:3, i] / np.linalg.norm(to_world[:3, i]) for i in (1, 2))
    matrix = np.eye(4)
    matrix[:3] = np.stack([np.cross(up, forward), up, forward, to_world[:3, 3]], axis=1)
    return matrix


def combine(exact: np.ndarray, learned: np.ndarray, view: str, divider: float, gain: float) -> np.ndarray:
    """Return two linear images ``(height, width, 3)`` side by side, or their difference, as bytes for a screen."""
    if view == "difference":
        return displayed(gain * np.abs(np.clip(exact, 0, 1) - np.clip(learned, 0, 1)))
    width = exact.shape[1]
    column = round(divider * width)
    shown = displayed(np.concatenate([exact[:, :column], learned[:, column:]], axis=1))
    if 0 < column < width:
        shown[:, column] = 255
    return shown


def _resize(state, width: int) -> None:
    """Give the films of a parsed scene the width of the picture, for footprints; those with a crop window keep theirs.

    The default size of a film is 768 x 576 pixels.
    """
    for props in compat.parsed_properties(state, mi.ObjectType.Film):
        if not any(key.startswith("crop_") for key in props):
            props["height"] = max(1, round(width * props.get("height", 576) / props.get("width", 768)))
            props["width"] = width


# -- table files ------------------------------------------------------------------------------------------------------


def table_scene(file: str | os.PathLike) -> dict:
    """Return a scene, as a dictionary for ``mi.load_dict``, in which the plugin of a file's task reads the file.

    A texture lies on a square, a BSDF on a ball; a shape and a radiance field stand alone. The light is a white
    surrounding and, but for textures and fields, a lamp. Raises :class:`.TableError`, and :class:`.UsageError` for a
    task whose tables no plugin reads.
    """
    path = Path(file).resolve()
    task = find_task(load_table(file))
    table = task.load(file)
    if task.plugin is None:
        raise UsageError(f'{file}: holds tables for the task "{task.name}", which no plugin shows')
    object_type, name = task.plugin
    plugin = {"type": name, "filename": str(path)}
    layout = table.settings.get("layout")
    maps = [entry["name"] for entry in layout["maps"]] if isinstance(layout, dict) else []
    if len(maps) > 1:
        plugin["channels"] = next((shown for shown in SHOWN_MAPS if shown in maps), maps[0])
    lower, upper, integrator, shape = [-1] * 3, [1] * 3, "path", {"type": "sphere", "bsdf": plugin}
    if object_type == "texture":
        lower, integrator = [-1, -1, 0], "path_footprint"
        shape = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": plugin}}
        upper = [1, 1, 0]
    elif object_type == "shape":
        with loading.scene_errors(path):
            box = mi.load_dict(plugin).bbox()
        lower, upper, integrator = list(box.min), list(box.max), "path_sdf"
        shape = {**plugin, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}
    elif object_type != "bsdf":
        lower, upper = task.model(table, array_module().TensorXf).describe()[0].get("box", (lower, upper))
        integrator = shape = None
    lit, lower, upper = object_type in ("bsdf", "shape"), np.array(lower, float), np.array(upper, float)
    middle, radius = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)) / 2, 1e-6)
    towards = np.array((0, 0, 1) if object_type == "texture" else CAMERA, float)
    origin = middle + 2.3 * radius * towards / np.linalg.norm(towards)
    look_at = mi.ScalarTransform4f().look_at
    scene = {
        "type": "scene",
        "sensor": {
            "type": "perspective", "fov": 40, "fov_axis": "y",
            "to_world": look_at(origin.tolist(), middle.tolist(), [0, 1, 0]),
            "film": {
                "type": "hdrfilm", "width": 320, "height": 180, "pixel_format": "rgb", "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": 64},
        },
        "integrator": {"type": integrator, "max_depth": 4} if integrator else plugin,
    }  # fmt: skip
    if shape:
        scene["shown"] = shape
        scene["light"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.4 if lit else 1.0}}
    if lit:
        place = middle + 4 * radius * np.array(LAMP)
        scene["lamp"] = {
            "type": "rectangle", "to_world": look_at(place.tolist(), middle.tolist(), [0, 1, 0.1]).scale(radius),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
        }  # fmt: skip
    return scene
