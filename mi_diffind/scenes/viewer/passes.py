"""Passes of one sample per pixel over a scene or a part of its picture, recorded once and then repeated."""

from __future__ import annotations

import contextlib
import gc
import math
import time
from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import compat
from ...plugins.support import footprint
from .. import loading
from .parameters import NamedParameters

#: Passes of a size, the first ones, whose times include compilation and recording.
SETTLED = 3

#: Sizes and parts of pictures whose renders are kept as recordings.
RECORDED = 12


class RenderedSide:
    """Scene, the sum of its passes, and renders that repeat without tracing.

    ``oversampling``: passes for each pass of the scene as written.
    """

    def __init__(self, scene, oversampling: int):
        self.scene, self.oversampling = scene, oversampling
        self.sensor = scene.sensors()[0]
        self.placement = mi.traverse(self.sensor)
        self.parameters = NamedParameters(scene)
        self.by_pixels = samples_pixels(scene)
        self.region: tuple[int, int, int, int] = (0, 0, 0, 0)
        self.grids: dict[tuple[int, int, int, int], tuple] = {}
        self.frozen: dict[tuple[int, int, int, int], object] | None = {}
        self.counts: dict[tuple[int, int, int, int], int] = {}
        self.restart()

    def restart(self) -> None:
        self.total, self.samples, self.passes, self.seconds = 0.0, 0, 0, math.nan

    def place(self, matrix: np.ndarray, spp: int) -> None:
        """Move the camera, and give textures the footprint of ``spp`` samples per pixel."""
        transform = type(self.placement["to_world"])
        self.placement["to_world"] = transform(mi.ScalarTransform4f(matrix))
        self.placement.update()
        footprint.attach(self.scene, 0, spp)
        self.restart()

    def change(self, values: Mapping[str, object]) -> None:
        """Change parameters. Plugins may then compute something else, so that recorded renders are of no use."""
        self.parameters.set(values)
        self.counts = {}
        if self.frozen is not None:
            self.frozen = {}
        self.restart()

    def add_pass(self, region: tuple[int, int, int, int], spp: int, seed: int, moving: bool = False) -> None:
        """Render one sample of the pixels of a ``region``, or unless ``moving`` as many as oversampled, and add them.

        The region is the ``width`` and ``height`` of the picture, its first column and the one after its last.
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
        return self.counts.get(self.region, 0) > SETTLED

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
        if self.region not in self.grids:
            if len(self.grids) >= RECORDED:
                self.grids, self.frozen, self.counts = {}, None if self.frozen is None else {}, {}
            self.grids[self.region] = _pixels(*self.region)
        self.counts[self.region] = self.counts.get(self.region, 0) + 1
        arguments = (*self.grids[self.region], dr.opaque(mi.UInt32, seed), spp)
        render = _sample_pixels if self.by_pixels else _render_film
        with loading.scene_errors(None), dr.suspend_grad(), no_collection():
            values = None
            if self.frozen is not None:
                if self.region not in self.frozen:
                    self.frozen[self.region] = dr.freeze(render)
                with contextlib.suppress(RuntimeError):  # of the scene, or of a plugin that computes outside Dr.Jit
                    values = np.array(self.frozen[self.region](self.scene, *arguments))
            if values is None:
                self.frozen = {}
                values = np.array(render(self.scene, *arguments))
                self.frozen = None  # it renders, and cannot be recorded
        if self.by_pixels:
            image = values.astype(np.float64).T.reshape(height, after - first, -1)
        else:
            image = loading.colour_channels(values.astype(np.float64))[:, first:after]
        return image.repeat(3, axis=2) if image.shape[2] == 1 else image


def samples_pixels(scene) -> bool:
    """Return whether single pixels of a scene can be sampled: its integrator follows rays of a camera, without spectra.

    Others are rendered as whole films by ``mi.render``.
    """
    return isinstance(scene.integrator(), mi.SamplingIntegrator) and not mi.is_spectral and not mi.is_polarized


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
