"""Side of the viewer: a loaded scene, its numbers and colours, and passes that are recorded once and then repeated."""

from __future__ import annotations

import contextlib
import gc
import math
import re
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import plugins
from ...core import compat
from ...core.errors import UsageError
from ...plugins.support import footprint
from .. import loading
from ..inspection import object_paths, owner_names

#: Passes of a region, the first ones, whose times include compilation and recording.
SETTLED = 3

#: Regions whose renders are kept as recordings.
RECORDED = 12

#: Parameters of a sensor that are listed, with their ranges; its position is the mouse's.
SENSOR_RANGES = {"x_fov": (1.0, 170.0)}

#: Largest exponent of two of a slider's range.
LARGEST_EXPONENT = 100


class RenderedSide:
    """Loaded scene, the sum of its passes of one sample per pixel, and its :class:`NamedParameters`.

    A ``region`` of the picture is its width and height, its first rendered column and the one after the last.
    ``oversampling``: passes for each pass of the scene as written.
    """

    def __init__(self, scene, oversampling: int):
        self.scene, self.oversampling = scene, oversampling
        self.placement = mi.traverse(scene.sensors()[0])
        self.parameters = NamedParameters(scene)
        #: Whether single pixels can be sampled: others are rendered as whole films by ``mi.render``.
        self.by_pixels = (
            isinstance(scene.integrator(), mi.SamplingIntegrator) and not mi.is_spectral and not mi.is_polarized
        )
        self.recordable, self.region = True, (0, 0, 0, 0)
        #: Recorded render of each region, its pixels, and how often it was called.
        self.renders: dict[tuple[int, int, int, int], list] = {}
        self.restart()

    def restart(self) -> None:
        """Forget all passes."""
        self.total, self.samples, self.passes, self.seconds = 0.0, 0, 0, math.nan

    def place(self, matrix: np.ndarray, spp: int) -> None:
        """Move the camera, and give textures the footprint of ``spp`` samples per pixel."""
        self.placement["to_world"] = type(self.placement["to_world"])(mi.ScalarTransform4f(matrix))
        self.placement.update()
        footprint.attach(self.scene, 0, spp)
        self.restart()

    def change(self, values: Mapping[str, object]) -> None:
        """Change parameters. Plugins may then compute something else, so that recorded renders are of no use."""
        self.parameters.set(values)
        self.renders = {}
        self.restart()

    def add_pass(self, region: tuple[int, int, int, int], spp: int, seed: int, moving: bool = False) -> None:
        """Add one sample of the pixels of a ``region``, or unless ``moving`` as many as oversampled.

        Filtering textures get the footprint of ``spp`` samples per pixel.
        """
        start = time.perf_counter()
        if region != self.region:
            self.region = region
            self.restart()
        for _ in range(1 if moving else self.oversampling):
            self.total = self.total + self._render(spp, ((seed << 16) + self.samples) % 2**32)
            self.samples += 1
        self.passes += 1
        self.seconds = time.perf_counter() - start

    @property
    def settled(self) -> bool:
        """Whether the last pass compiled and recorded nothing."""
        return self.region in self.renders and self.renders[self.region][2] > SETTLED

    @property
    def image(self) -> np.ndarray:
        """Mean of the passes, ``(height, width, 3)`` float32, black outside of the rendered columns."""
        width, height, first, after = self.region
        image = np.zeros((height, width, 3), np.float32)
        if self.samples:
            image[:, first:after] = self.total / self.samples
        return image

    def _render(self, spp: int, seed: int) -> np.ndarray:
        """Return a pass ``(height, columns, 3)``, float64."""
        _, height, first, after = self.region
        render = _sample_pixels if self.by_pixels else _render_film
        if self.region not in self.renders:
            if len(self.renders) >= RECORDED:
                self.renders = {}
            self.renders[self.region] = [dr.freeze(render), _pixels(*self.region), 0]
        self.renders[self.region][2] += 1
        recorded, pixels, _ = self.renders[self.region]
        arguments = (self.scene, *pixels, dr.opaque(mi.UInt32, seed), spp)
        with loading.scene_errors(None), dr.suspend_grad(), no_collection():
            values = None
            if self.recordable:
                with contextlib.suppress(RuntimeError):  # of the scene, or of a plugin that computes outside Dr.Jit
                    values = np.array(recorded(*arguments))
            if values is None:
                self.renders = {}
                values = np.array(render(*arguments))
                self.recordable = False
        if self.by_pixels:
            image = values.astype(np.float64).T.reshape(height, after - first, -1)
        else:
            image = loading.colour_channels(values.astype(np.float64))[:, first:after]
        return image.repeat(3, axis=2) if image.shape[2] == 1 else image


def _pixels(width: int, height: int, first: int, after: int) -> tuple:
    """Return the columns and rows of the pixels of a region, row by row, and the size of a pixel in the film."""
    index, count = dr.arange(mi.UInt32, height * (after - first)), dr.opaque(mi.UInt32, after - first)
    row = index // count
    column, row = mi.Float(index - row * count + first), mi.Float(row)
    dr.eval(column, row)  # memory of NumPy may be aligned otherwise, and have another kernel
    return column, row, dr.opaque(mi.Vector2f, [1 / width, 1 / height])


def _sample_pixels(scene, column, row, step, seed, spp: int):
    """Return one sample of each pixel, channels first.

    This is ``mi.render`` with one sample per pixel, a box filter and the same random numbers, for any pixels: neither
    their number nor the size of the picture is part of the kernel, so that another size needs no new one.
    """
    sensor, integrator = scene.sensors()[0], scene.integrator()
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(1)
    sampler.set_samples_per_wavefront(1)
    sampler.seed(seed, dr.width(column))
    surfaces = getattr(integrator, "surfaces", integrator)  # inside a radiance field
    centre = not getattr(surfaces, "jitter", True)
    place = (mi.Vector2f(column, row) + (0.5 if centre else sampler.next_2d())) * step
    on_lens = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    moment = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        moment += sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray_differential(moment, 0, place, on_lens)
    sampler.set_sample_count(spp)
    if hasattr(surfaces, "narrow"):
        surfaces.narrow(scene, sensor, sampler, ray)
    if compat.written_in_python(integrator):
        light, *_ = integrator.sample(
            mode=dr.ADMode.Primal, scene=scene, sampler=sampler, ray=ray, depth=mi.UInt32(0), δL=None, δaovs=None,
            state_in=None, active=mi.Bool(True),
        )  # fmt: skip
    else:
        light, *_ = integrator.sample(scene, sampler, ray, None, mi.Bool(True))
    return light * weight


def _render_film(scene, column, row, step, seed, spp: int):
    """Return one sample of each pixel of the film; the other arguments are those of :func:`_sample_pixels`."""
    return mi.render(scene, spp=1, seed=seed)


@contextlib.contextmanager
def no_collection():
    """Keep Python from collecting garbage: Dr.Jit aborts if arrays are freed while it records.

    Mitsuba loads scenes in several threads, none of which should free another scene either.
    """
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


# -- numbers and colours ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NamedParameter:
    """A number or a colour of a scene.

    ``owner`` is the name of the object that groups it, ``name`` its name within. ``value`` is a number or the three
    components of a linear colour when the scene was loaded; ``low`` and ``high`` limit a slider.
    """

    owner: str
    name: str
    value: float | tuple[float, float, float]
    low: float
    high: float

    @property
    def path(self) -> str:
        """Unique name in a scene: ``owner.name``."""
        return f"{self.owner}.{self.name}"

    @property
    def is_colour(self) -> bool:
        """Whether the value has three components."""
        return isinstance(self.value, tuple)


class NamedParameters:
    """Scalars and colours of a loaded scene, by :attr:`NamedParameter.path`; this package's plugins come first.

    A parameter of ``mi.traverse`` is listed if it is one number or one colour, and finite. Tables, transformations,
    switches and whole numbers are not.
    """

    def __init__(self, scene):
        self._params, self._keys = mi.traverse(scene), {}
        objects = object_paths(scene)
        owners, first, rest = owner_names(objects), {}, {}
        for key in self._params.keys():
            path = next(p for p in _parents(key) if p in owners)
            value, node = _plain(self._params[key]), objects[path]
            hidden = isinstance(node, mi.Sensor) and key.rpartition(".")[2] not in SENSOR_RANGES
            if value is None or hidden or isinstance(node, (mi.Film, mi.Sampler)):
                continue
            owner, inner = re.match(r"(\([^)]*\)|[^.]*)\.?(.*)", owners[path]).groups()  # "(Sphere 2).bsdf"
            name = ".".join(filter(None, (inner, key[len(path) :].strip("."))))
            limits = SENSOR_RANGES.get(name) or _limits(value)
            parameter = NamedParameter(owner, name.removesuffix(".value") or "value", value, *limits)
            if parameter.path not in self._keys:
                self._keys[parameter.path] = key
                ours = any(plugins.origin(objects[p]) for p in (path, *_parents(path)) if p in objects)
                (first if ours else rest)[parameter.path] = parameter
        self.listed = {**first, **rest}

    def __contains__(self, path: str) -> bool:
        return path in self.listed

    def value(self, path: str) -> float | tuple[float, float, float]:
        """Return the value that a parameter has now."""
        return _plain(self._params[self._keys[path]])

    def set(self, values: Mapping[str, float | tuple[float, float, float]]) -> None:
        """Give parameters other values, as of :meth:`check`, and update the scene."""
        for path, value in values.items():
            value_type = type(self._params[self._keys[path]])
            # Opaque: another value needs no other kernel
            self._params[self._keys[path]] = value if value_type is float else dr.opaque(value_type, value)
        self._params.update()

    def check(self, path: str, value) -> float | tuple[float, float, float]:
        """Return a value as the parameter holds it.

        Raises :class:`.UsageError` for a parameter that is not listed, and a value that is no finite number or colour.
        """
        if path not in self.listed:
            raise UsageError(f'parameter "{path}": not one of the {len(self.listed)} numbers and colours of the scene')
        colour = self.listed[path].is_colour
        try:
            numbers = tuple(float(x) for x in (value if colour else (value,)))
        except (TypeError, ValueError):
            numbers = ()
        if len(numbers) != (3 if colour else 1) or not all(map(math.isfinite, numbers)):
            expected = "three finite numbers" if colour else "a finite number"
            raise UsageError(f'parameter "{path}": found {str(value)[:40]}, expected {expected}')
        return numbers if colour else numbers[0]

    def counterpart(self, path: str) -> str:
        """Return the path of the parameter here that the learned scene calls ``path``, "" if there is none.

        Objects without an id are named by their plugin: ``(neural_disney 2)`` is ``(disney 2)`` in the exact scene.
        """
        names = {name: plugin.exact.name for name, plugin in plugins.declared().items() if plugin.exact}
        path = re.sub(r"^\((\w+)", lambda match: f"({names.get(match[1], match[1])}", path)
        return path if path in self.listed else ""


def _parents(key: str) -> Iterator[str]:
    """Yield the dotted prefixes of a key, the longest first, down to the empty one of the scene."""
    while key:
        key = key.rpartition(".")[0]
        yield key


def _plain(value) -> float | tuple[float, float, float] | None:
    """Return a parameter as a number or a colour, ``None`` if it is neither, or not finite."""
    if isinstance(value, float):
        numbers = (value,)
    elif isinstance(value, mi.Float) and len(value) == 1:
        numbers = (float(value[0]),)
    elif mi.is_rgb and isinstance(value, mi.Color3f) and dr.width(value) == 1:
        numbers = tuple(float(x[0]) for x in value)
    else:
        return None
    if not all(map(math.isfinite, numbers)):
        return None
    return numbers if len(numbers) == 3 else numbers[0]


def _limits(value: float | tuple[float, ...]) -> tuple[float, float]:
    """Return the range of a slider: [0, 1], or up to the power of two above twice the value; negative likewise."""
    values = value if isinstance(value, tuple) else (value,)
    largest = max(map(abs, values))
    high = 1.0 if largest <= 1 else 2.0 ** min(math.ceil(math.log2(2 * largest)), LARGEST_EXPONENT)
    return (-high if min(values) < 0 else 0.0), high
