"""State of the viewer without a page: a scene with learned plugins, its exact counterpart, camera and passes."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from ... import plugins
from ...core import compat
from ...core.errors import DiffindError, UsageError
from ...core.runtime import use_variant
from ...images import metrics, srgb
from .. import loading, scene_checks
from ..orbit import middle
from .parameters import NamedParameter, counterparts
from .passes import RenderedSide, no_collection
from .table_scene import table_scene

#: Contents of the picture.
VIEWS = ("side by side", "learned", "exact", "difference")

#: Width of the picture in pixels by default, and limits.
WIDTH, NARROWEST, WIDEST = 320, 16, 4096

#: Seconds of a picture while the camera moves above which the next is smaller, and below which it is larger again.
SLOW, FAST = 0.18, 0.04

#: Factors by which the sides of a picture are smaller while the camera moves.
REDUCTIONS = (1, 2, 4)

#: Option of a choice that leaves the file's own value.
AS_WRITTEN = "as written"


@dataclass(frozen=True)
class Pose:
    """Camera in world space: ``position``, and unit vectors to the ``right``, ``up`` and ``forward``, all ``(3,)``."""

    position: np.ndarray
    right: np.ndarray
    up: np.ndarray
    forward: np.ndarray

    @classmethod
    def of(cls, to_world: np.ndarray) -> Pose:
        """Return the pose of a sensor's matrix ``(4, 4)``; Mitsuba's x axis points to the left."""
        up, forward = (to_world[:3, i] / np.linalg.norm(to_world[:3, i]) for i in (1, 2))
        return cls(to_world[:3, 3].copy(), np.cross(forward, up), up, forward)  # also of a mirrored sensor

    @property
    def matrix(self) -> np.ndarray:
        """Matrix of a sensor in this pose, ``(4, 4)``."""
        matrix = np.eye(4)
        matrix[:3] = np.stack([-self.right, self.up, self.forward, self.position], axis=1)
        return matrix


class Session:
    """Scene that is looked at: what is shown, from where, with which values, and the picture so far.

    - ``source``: a scene file, a table file (:func:`.table_scene.table_scene`) or a dictionary as of ``mi.load_dict``;
    - ``width``: of the picture, pixels; the height follows the scene's film;
    - ``spp``: samples per pixel of a finished picture (``None``: the scene's); ``seed``: seed of the random numbers;
    - ``against``: the counterpart that replaces learned plugins on the other side, as of :func:`mi_diffind.compare`;
    - ``defines``: values of a scene file's ``<default>`` parameters.

    A picture is the mean of passes of one sample, ``passes`` so far; :meth:`refine` adds one. A change of anything
    restarts it. ``refusal`` is the sentence that says why there is no exact side, "" if there is one. Computations run
    in the thread that calls, and only one thread may.

    Raises :class:`.SceneError`, :class:`.TableError` and
    :class:`.UsageError`.
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
        if against != "exact" and not plugins.with_counterpart(against):
            others = dict.fromkeys(c.name for plugin in plugins.declared().values() for c in plugin.others)
            raise UsageError(f'against: found "{against}", allowed are exact, {", ".join(others)}')
        self.against, self.seed, self._width, self._values, self._chosen = against, seed, width, {}, {}
        in_file = isinstance(source, (str, os.PathLike))
        self.name = Path(source).name if in_file else "scene"
        if in_file and Path(source).suffix.lower() == ".npz":
            if defines:
                raise UsageError(f"{source}: found a table file with defines, which only a scene file has")
            source = table_scene(source)
        self._parsed = loading.ParsedScene(source, dict(defines or {}), self.name)
        self.learned, self.exact, self.refusal = self._load({})
        sensor = self.learned.scene.sensors()[0]
        if "to_world" not in self.learned.placement:
            raise loading.SceneError(f"{self._parsed.path}: the sensor {sensor.class_name()} cannot be moved")
        written = np.array(self.learned.placement["to_world"].matrix, np.float64).reshape(4, 4)
        film = loading.film_size(self.learned.scene)
        self.full = (width, max(1, round(width * film[1] / film[0]))) if self.learned.by_pixels else film
        self.spp = spp or sensor.sampler().sample_count()
        if not isinstance(self.spp, int) or not 1 <= self.spp <= 2**16:
            raise UsageError(f"spp: found {self.spp}, allowed are whole numbers from 1 to {2**16}")
        scene_checks.check_size(self.learned.scene, self.spp, self.full)
        self.start = Pose.of(written)
        self._pose, self._residue = self.start, np.linalg.inv(self.start.matrix) @ written
        self.view = VIEWS[0] if self.exact else VIEWS[1]
        self.divider, self.gain = 0.5, 10.0
        self.table_bytes = self._bytes({})
        self.moving, self.reduction, self.pictures = False, REDUCTIONS[0], 0
        self._place()

    def _load(self, chosen: Mapping[str, str]) -> tuple[RenderedSide, RenderedSide | None, str]:
        def change(state):
            _resize(state, self._width)
            for props, plugin in _of_plugins(state):
                for name, word in chosen.items():
                    if _has_choice(props, plugin, name) and word in plugin.choices[name]:
                        props[name] = word

        with no_collection():
            learned = self._parsed.load(change=change)
        names = tuple(dict.fromkeys((self.against, "exact")))
        replaced = self._parsed.learned_plugins(names)
        if not replaced:
            return RenderedSide(learned, 1), None, "the scene names no learned plugin, so there is nothing to compare"
        declared = plugins.declared()
        oversampling = max(declared[entry["plugin"]].counterpart(names).oversampling for entry in replaced)
        try:
            with no_collection():
                exact = self._parsed.load(exact=True, against=names, change=change)
        except DiffindError as e:
            return RenderedSide(learned, 1), None, str(e)
        return RenderedSide(learned, 1), RenderedSide(exact, oversampling), ""

    def _bytes(self, chosen: Mapping[str, str]) -> int:
        """Return the bytes of all tables, with another preset or storage form if it was chosen."""
        entries = self._parsed.learned_plugins()
        for entry in entries:
            options = plugins.declared()[entry["plugin"]].choices
            for name, word in chosen.items():
                if word in options.get(name, ()) and not (name == "preset" and "filename" in entry):
                    entry[name] = word
        return self._parsed.table_bytes(entries)

    # -- what is shown ------------------------------------------------------------------------------------------------

    @property
    def views(self) -> tuple[str, ...]:
        """Allowed values of :attr:`view`: all of :data:`VIEWS` if there is an exact side."""
        return VIEWS if self.exact else VIEWS[1:2]

    def show(self, view: str | None = None, divider: float | None = None, gain: float | None = None) -> None:
        """Choose one of :attr:`views`, the place of the divider, 0 to 1, or the factor of the difference.

        The samples so far are kept, unless another side becomes visible. Raises
        :class:`.UsageError`.
        """
        if view is not None and view not in self.views:
            because = f" ({self.refusal})" if self.refusal else ""
            raise UsageError(f'view: found "{view}", allowed are {", ".join(self.views)}{because}')
        for name, value, high in (("divider", divider, 1), ("gain", gain, 1e6)):
            if value is not None and not 0 <= value <= high:
                raise UsageError(f"{name}: found {value}, allowed are numbers from 0 to {high:g}")
        self.divider = self.divider if divider is None else float(divider)
        self.gain = self.gain if gain is None else float(gain)
        if view is not None and view != self.view:
            self.view = view
            if len({side.passes for side in self._visible()}) > 1 or self.passes == 0:
                self._restart()

    def _visible(self) -> list[RenderedSide]:
        if self.exact is None or self.view == "learned":
            return [self.learned]
        return [self.exact] if self.view == "exact" else [self.learned, self.exact]

    # -- camera -------------------------------------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """Camera."""
        return self._pose

    def move_camera(self, pose: Pose) -> bool:
        """Move the camera, and return whether it moved; the next :meth:`moving_picture` shows it."""
        if not np.isfinite(pose.matrix).all():
            raise UsageError("camera: found a position or a direction that is not finite")
        if np.allclose(pose.matrix, self._pose.matrix, rtol=1e-6, atol=1e-6 * (1 + np.abs(pose.position).max())):
            return False
        self._pose = pose
        self._restart()
        return True

    def target(self) -> np.ndarray:
        """Return the point on the first view's axis that the camera turns about: the nearest to the scene's middle."""
        centre = middle(self.learned.scene)
        distance = float((centre - self.start.position) @ self.start.forward)
        if distance <= 1e-6:
            box = self.learned.scene.bbox()
            distance = float(np.linalg.norm(np.array(box.max) - np.array(box.min))) / 4 if box.valid() else 1.0
            distance = distance if math.isfinite(distance) and distance > 0 else 1.0
        return self.start.position + distance * self.start.forward

    def up(self) -> np.ndarray:
        """Return the upward direction of the world: the axis nearest to the camera's, which a level camera shares."""
        axis = np.zeros(3)
        place = int(np.abs(self.start.up).argmax())
        axis[place] = np.sign(self.start.up[place])
        level = abs(float(axis @ self.start.right)) < 1e-3
        return axis if level else self.start.up

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
        seconds, sides = time.perf_counter() - start, self._visible()
        if self.learned.by_pixels and all(side.settled for side in sides if side.seconds > 0):
            step = 1 if seconds > SLOW else -1 if seconds < FAST else 0
            index = min(max(REDUCTIONS.index(self.reduction) + step, 0), len(REDUCTIONS) - 1)
            self.reduction = REDUCTIONS[index]
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
        matrix = self._pose.matrix @ self._residue
        for side in filter(None, (self.learned, self.exact)):
            side.place(matrix, self.spp)

    def _size(self) -> tuple[int, int]:
        """Return the size of the picture: reduced while the camera moves."""
        if self.moving and self.learned.by_pixels:
            return tuple(max(1, round(n / self.reduction)) for n in self.full)
        return self.full

    def _add_pass(self) -> None:
        width, height = self._size()
        sides = self._visible()
        for side in sides:
            first, after = 0, width
            if self.moving and self.view == VIEWS[0]:  # each side only where it is visible
                column = min(max(round(self.divider * width), 0), width)
                first, after = (0, column) if side is self.learned else (column, width)
            if first < after:
                side.add_pass((width, height, first, after), self.spp, self.seed, self.moving)
            else:
                side.region = (width, height, 0, 0)
                side.passes += 1
        self.pictures += 1

    def _restart(self) -> None:
        for side in filter(None, (self.learned, self.exact)):
            side.restart()

    # -- values -------------------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> dict[str, NamedParameter]:
        """Numbers and colours of the scene by their paths (:class:`.parameters.NamedParameters`)."""
        return self.learned.parameters.listed

    def set(self, values: Mapping[str, object]) -> None:
        """Give parameters other values on both sides, as far as both have them.

        If the scene refuses them, it keeps the old ones. Raises :class:`.UsageError` and
        :class:`.SceneError`.
        """
        checked = {path: self.learned.parameters.checked(path, value) for path, value in values.items()}
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
        if self.exact is not None:
            pairs = counterparts(values, self.exact.parameters)
            if pairs:
                self.exact.change({pairs[path]: values[path] for path in pairs})

    def on_both(self, path: str) -> bool:
        """Return whether a parameter changes the exact side, too."""
        return self.exact is None or bool(counterparts([path], self.exact.parameters))

    @property
    def choices(self) -> dict[str, tuple[str, ...]]:
        """Parameters of the scene's plugins that are one of a few words (:attr:`.plugins.Plugin.choices`)."""
        words: dict[str, tuple[str, ...]] = {}
        self._parsed.change(lambda state: words.update(_choices(state)))
        return {name: (AS_WRITTEN, *options) for name, options in words.items()}

    @property
    def chosen(self) -> dict[str, str]:
        """Choices that were made, by name."""
        return dict(self._chosen)

    def choose(self, name: str, word: str) -> None:
        """Give all plugins that have the choice ``name`` this value, and load the scene again with it.

        If the scene refuses it, it stays as it is. Raises :class:`.UsageError` and
        :class:`.SceneError`.
        """
        options = self.choices
        if name not in options or word not in options[name]:
            allowed = ", ".join(options.get(name, options)) or "none"
            raise UsageError(f'{name}: found "{word}", allowed are {allowed}')
        chosen = {**self._chosen, name: word}
        if word == AS_WRITTEN:
            del chosen[name]
        sides, table_bytes = self._load(chosen), self._bytes(chosen)
        self.learned, self.exact, self.refusal = sides
        self._chosen, self.table_bytes = chosen, table_bytes
        if self.view not in self.views:
            self.view = self.views[0]
        kept = {path: value for path, value in self._values.items() if path in self.learned.parameters}
        if kept:
            self._set(kept)
        self._place()

    def samples(self, spp: int) -> None:
        """Choose the samples per pixel of a finished picture. Raises :class:`.UsageError`."""
        if not isinstance(spp, int) or not 1 <= spp <= 2**16:
            raise UsageError(f"spp: found {spp}, allowed are whole numbers from 1 to {2**16}")
        self.spp = spp
        self._restart()  # the footprint of a sample depends on their number

    # -- picture and figures ------------------------------------------------------------------------------------------

    def picture(self) -> np.ndarray:
        """Return what is shown, as bytes for a screen ``(height, width, 3)``.

        Side by side, the learned scene is left of a white line at ``divider``, the exact one right of it. The
        difference is the absolute one of values clipped to [0, 1], times ``gain``, grey where colours agree in it.
        """
        if self.exact is None or self.view == "learned":
            return displayed(self.learned.image)
        if self.view == "exact":
            return displayed(self.exact.image)
        return combined(self.learned.image, self.exact.image, self.view, self.divider, self.gain)

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
            "choices": self.chosen,
            "values": {k: list(v) if isinstance(v, tuple) else v for k, v in self._values.items()},
            "to_world": (self._pose.matrix @ self._residue).tolist(),
        }


def displayed(image: np.ndarray) -> np.ndarray:
    """Return a linear image as bytes for a screen."""
    return np.round(255 * srgb.for_display(image)).astype(np.uint8)


def combined(learned: np.ndarray, exact: np.ndarray, view: str, divider: float, gain: float) -> np.ndarray:
    """Return two linear images ``(height, width, 3)`` side by side, or their difference, as bytes for a screen."""
    if view == "difference":
        return displayed(gain * np.abs(np.clip(learned, 0, 1) - np.clip(exact, 0, 1)))
    width = learned.shape[1]
    column = round(divider * width)
    shown = displayed(np.concatenate([learned[:, :column], exact[:, column:]], axis=1))
    if 0 < column < width:
        shown[:, column] = 255
    return shown


def _resize(state, width: int) -> None:
    """Give the films of a parsed scene the width of the picture, for footprints; those with a crop window keep theirs.

    The default size of a film is 768 x 576 pixels.
    """
    for props in compat.properties_of(state, mi.ObjectType.Film):
        if not any(key.startswith("crop_") for key in props):
            props["height"] = max(1, round(width * props.get("height", 576) / props.get("width", 768)))
            props["width"] = width


def _of_plugins(state) -> list[tuple]:
    """Return ``(properties, plugin)`` of all nodes of a parsed scene that are plugins of this package."""
    declared = plugins.declared()
    nodes = ((props, declared.get(props.plugin_name())) for props in compat.properties_of(state))
    return [(props, plugin) for props, plugin in nodes if plugin is not None]


def _has_choice(props, plugin, name: str) -> bool:
    """Return whether a node has a choice; a preset names a table that ships, in place of a file."""
    return name in plugin.choices and not (name == "preset" and "filename" in props)


def _choices(state) -> dict[str, tuple[str, ...]]:
    words: dict[str, tuple[str, ...]] = {}
    for props, plugin in _of_plugins(state):
        for name, options in plugin.choices.items():
            if _has_choice(props, plugin, name):
                words[name] = tuple(dict.fromkeys((*words.get(name, ()), *options)))
    return words
