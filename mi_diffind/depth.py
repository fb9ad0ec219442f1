"""
How deep the light of a scene has to be followed: the share of each bounce, and the depth that leaves out almost none.

Depths are counted as Mitsuba's ``max_depth`` counts them: 1 is emitted light alone, 2 adds direct light, 3 adds what
bounced twice, and so on.

:func:`probe` follows paths through a coarse image once, to the scene's own depth, and books what each brings under the
depth at which it arrived. The depths are therefore parts of the same paths: their differences are added bounces, never
noise, and one kernel serves all of them (an image for each depth would compile one for each).

What a share is of (:func:`bounces`):

- *Scattered light*, which reached the camera by way of a surface. Emitted light seen directly (lamps, the sky) is in
  the image at any depth, costs nothing, and is not counted: however bright, it hides nothing.
- Brightness is exposed as a photographer would, the median of the lit pixels at middle grey (0.18), and clipped at 1,
  so that a few brilliant highlights do not hide the rest either. The unit of light in the file has no influence.
- A mean hides what happens in a corner. The image is therefore also divided into tiles, 16 along its longer side, and
  the tile that would lose most of its own light is reported. Tiles darker than a tenth of middle grey count as that.

:func:`choose` takes the smallest depth at which the rest of the whole image is below the tolerance, and that of each
tile below ten times the tolerance.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from . import scenes
from .interrupt import interruptible

#: Part of the scattered light that may be left out, and how many times that a single tile may lose of its own.
TOLERANCE, IN_A_TILE = 0.005, 10

#: Integrators whose light the probe computes; those for media follow other paths.
INTEGRATORS = ("path", "prb", "prb_basic", "prb_projective", "ptracer")

#: Probe: tiles along the longer side of the image, pixels along the side of a tile, paths in a pixel, passes.
TILES, TILE, SPP, PASSES = 16, 8, 16, 4

#: Depths told apart; what arrives deeper is booked under the last.
MAX_BINS = 64

#: From this vertex on, a path goes on with a probability of its throughput, at most 0.95 (Russian roulette, unbiased).
ROULETTE = 8

MIDDLE_GREY = 0.18


@dataclass(frozen=True)
class Bounce:
    """
    The light that arrives at one ``depth`` (an emitter is seen at depth 1), as parts of all scattered light, 0 to 1:
    its ``share``, the ``rest`` that a render up to this depth leaves out, and ``rest_in_a_tile``, the largest part that
    any tile would lose of its own light. Emitted light has no share.
    """

    depth: int
    share: float
    rest: float
    rest_in_a_tile: float

    @property
    def name(self) -> str:
        """What kind of light it is, in the field's words."""
        return {1: "emitted", 2: "direct"}.get(self.depth, f"{self.depth - 1} bounces")


def probe(
    scene,
    max_depth: int,
    spp: int = SPP,
    seed: int = 0,
    passes: int = PASSES,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> np.ndarray:
    """
    Luminance of a coarse image by depth, ``(depths, height, width)``, float64: ``[k]`` holds what arrives at depth
    ``k + 1``. There are ``max_depth`` depths, at most :data:`MAX_BINS`: more, or infinitely many (-1), are followed all
    the same, and the last entry gathers them.

    A path tracer with emitter sampling and multiple importance sampling, as Mitsuba's ``path``: surfaces only, without
    polarisation, and with the emitters that ``hide_emitters`` hides. Spectral variants scale all by one factor. ``spp``
    paths start in each pixel, in ``passes``; ``on_pass()`` is called after each. The same seed gives the same numbers.
    Raises :class:`~mi_diffind.scenes.SceneError`, and ``KeyboardInterrupt`` after a pass if ``stop`` is set.
    """
    sensor = scene.sensors()[0]
    size = sensor.film().crop_size()
    width, height = (TILE * max(1, round(TILES * n / max(size))) for n in (size[0], size[1]))
    depths = MAX_BINS if max_depth < 0 else max(1, min(max_depth, MAX_BINS))
    passes = max(1, min(passes, spp))
    total, done = np.zeros((depths, height, width)), 0
    for i in range(passes):
        n = (i + 1) * spp // passes - done
        with scenes.scene_errors(None):
            light = _pass(scene, sensor, width, height, n, (seed * passes + i) % 2**32, max_depth, depths)
            total += light.numpy().reshape(total.shape)
        done += n
        if on_pass is not None:
            on_pass()
        if stop is not None and stop.is_set():
            raise KeyboardInterrupt
    return total / spp


def _pass(scene, sensor, width: int, height: int, spp: int, seed: int, max_depth: int, depths: int):
    """One pass of :func:`probe`: the sums over the paths of each pixel, ``depths · height · width`` numbers."""
    paths = width * height * spp
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), paths)
    path = dr.arange(mi.UInt32, paths)
    pixel = path // spp
    position = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
    moment = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    position /= mi.Point2f(width, height)
    ray, weight = sensor.sample_ray(moment, sampler.next_1d(), position, sampler.next_2d())
    light = dr.zeros(mi.Float, depths * paths)  # each path adds to its own entries: the same sums each time
    limit = mi.UInt32(0xFFFFFFFF if max_depth < 0 else max_depth)
    _follow(scene, sampler, mi.Ray3f(ray), mi.unpolarized_spectrum(weight), light, path, paths, depths, limit)
    return dr.block_sum(light, spp)


@dr.syntax
def _follow(scene, sampler, ray, β, light, path, paths, depths, limit):
    """Follow paths as ``mi.ad.integrators.prb`` does, and add the luminance that arrives at depth ``k + 1`` to
    ``light[k · paths + path]``."""
    context = mi.BSDFContext()
    depth, η, active = mi.UInt32(0), mi.Float(1), mi.Bool(True)
    si_prev = dr.zeros(mi.SurfaceInteraction3f)
    pdf_prev, delta_prev = mi.Float(1), mi.Bool(True)

    while active:
        si = scene.ray_intersect(ray, active)
        bsdf = si.bsdf(ray)

        # Emission at this vertex
        ds = mi.DirectionSample3f(scene, si=si, ref=si_prev)
        mis = _mis(pdf_prev, scene.pdf_emitter_direction(si_prev, ds, ~delta_prev))
        Le = β * mis * mi.unpolarized_spectrum(ds.emitter.eval(si, active))
        _add(light, Le, ray.wavelengths, dr.minimum(depth, depths - 1) * paths + path, active)

        # Emitters sampled from this vertex: one bounce more
        active &= (depth + 1 < limit) & si.is_valid()
        lit = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, lit)
        lit &= ds.pdf != 0
        value, pdf = bsdf.eval_pdf(context, si, si.to_local(ds.d), lit)
        mis = dr.select(ds.delta, 1, _mis(ds.pdf, pdf))
        Lr = β * mis * mi.unpolarized_spectrum(value) * mi.unpolarized_spectrum(weight)
        _add(light, Lr, ray.wavelengths, dr.minimum(depth + 1, depths - 1) * paths + path, lit)

        # The next vertex
        bs, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        β *= mi.unpolarized_spectrum(weight)
        η *= bs.eta
        ray = si.spawn_ray(si.to_world(bs.wo))
        si_prev, pdf_prev, delta_prev = si, bs.pdf, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        going = dr.minimum(dr.max(β) * η * η, 0.95)
        going = dr.select(depth >= ROULETTE, going, 1)
        active &= (dr.max(β) != 0) & (sampler.next_1d() < going)
        β *= dr.rcp(going)
        depth += 1


def _mis(a, b):
    """Weight of the strategy with density ``a``: the power heuristic (Veach 1997), without a square that overflows."""
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)


def _add(light, radiance, wavelengths, index, active):
    luminance = radiance[0] if mi.is_monochromatic else mi.luminance(radiance, wavelengths)
    dr.scatter_add(light, luminance, index, active & dr.isfinite(luminance), mode=dr.ReduceMode.NoConflicts)


def bounces(light: np.ndarray) -> list[Bounce]:
    """The shares of a :func:`probe`, one :class:`Bounce` a depth, from 1. Without scattered light all are 0."""
    scattered = light.copy()
    scattered[0] = 0
    images = np.cumsum(scattered, axis=0)
    lit = images[-1][images[-1] > 0]
    if lit.size == 0:
        return [Bounce(k + 1, 0.0, 0.0, 0.0) for k in range(len(light))]
    images = np.clip(images * (MIDDLE_GREY / np.median(lit)), 0, 1)
    depths, height, width = images.shape
    tiles = images.reshape(depths, height // TILE, TILE, width // TILE, TILE).mean((2, 4))
    means = tiles.mean((1, 2))
    rest = 1 - means / means[-1]
    in_a_tile = ((tiles[-1] - tiles) / np.maximum(tiles[-1], MIDDLE_GREY / 10)).max((1, 2))
    share = np.diff(means, prepend=0) / means[-1]
    return [Bounce(k + 1, float(share[k]), float(rest[k]), float(in_a_tile[k])) for k in range(depths)]


def check_tolerance(tolerance: float) -> None:
    """Raises ``ValueError`` unless the tolerance is between 0 and 1."""
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: found {tolerance:g}, allowed is more than 0 and less than 1")


def choose(found: list[Bounce], max_depth: int, tolerance: float = TOLERANCE) -> int:
    """
    The smallest depth whose ``rest`` is below ``tolerance`` and whose ``rest_in_a_tile`` is below ten times that; else
    the scene's own ``max_depth`` (-1: infinite). Raises ``ValueError`` as :func:`check_tolerance`.
    """
    check_tolerance(tolerance)
    for bounce in found[:-1]:
        if bounce.rest < tolerance and bounce.rest_in_a_tile < IN_A_TILE * tolerance:
            return bounce.depth
    return max_depth


def auto_depth(
    path: str | os.PathLike,
    tolerance: float = TOLERANCE,
    seed: int = 0,
    progress: bool = True,
    defines: dict[str, str] | None = None,
) -> dict:
    """
    Probe the scene file ``path`` and choose its depth; ``defines`` replace its ``<default>`` values.

    Returns what was found: ``chosen`` and ``scene`` (its own depth, never exceeded; -1: infinite), ``tolerance``,
    ``shares`` (of each depth: ``depth``, ``light``, and the figures of a :class:`Bounce`), ``left_out`` and
    ``left_out_in_a_tile`` (``rest`` and ``rest_in_a_tile`` of the chosen depth), ``probe_seconds`` (with compilation).
    Ctrl-C ends it after the current pass with ``KeyboardInterrupt``. Raises :class:`~mi_diffind.scenes.SceneError`,
    also if the scene's integrator is not in :data:`INTEGRATORS`, and ``ValueError`` as :func:`choose`.
    """
    check_tolerance(tolerance)
    defines = defines or {}
    integrator, own = scenes.integrator_of(path, defines=defines)
    if integrator not in INTEGRATORS:
        names = ", ".join(INTEGRATORS)
        raise scenes.SceneError(
            f'{path}: the integrator "{integrator}" also follows light through media, and bounces can be measured for '
            f"{names} alone; a number sets its depth"
        )
    scene = scenes.load(path, defines=defines)
    start = time.perf_counter()
    with (
        interruptible() as stop,
        tqdm(total=PASSES, desc="probe", unit="pass", disable=None if progress else True) as bar,
    ):
        found = bounces(probe(scene, own, seed=seed, on_pass=bar.update, stop=stop))
    seconds = time.perf_counter() - start
    chosen = choose(found, own, tolerance)
    at = found[chosen - 1] if chosen != own else Bounce(own, 0.0, 0.0, 0.0)
    return {
        "chosen": chosen,
        "scene": own,
        "tolerance": tolerance,
        "shares": [
            {
                "depth": b.depth,
                "light": b.name,
                "share": b.share,
                "rest": b.rest,
                "rest_in_a_tile": b.rest_in_a_tile,
            }
            for b in found
        ],
        "left_out": at.rest,
        "left_out_in_a_tile": at.rest_in_a_tile,
        "probe_seconds": seconds,
    }


def summary(f: dict) -> list[str]:
    """What :func:`auto_depth` found, as lines of text."""
    lines = ["depth  light        share      rest   in a tile"]
    shown = [s for s in f["shares"] if s["depth"] <= 2 or s["share"] >= 5e-6 or s["depth"] == f["chosen"]]
    for s in shown:
        share = f"{s['share']:8.3%}" if s["depth"] > 1 else "       –"
        mark = "  <- chosen" if s["depth"] == f["chosen"] else ""
        lines.append(f"{s['depth']:5}  {s['light']:10} {share}  {s['rest']:8.3%}    {s['rest_in_a_tile']:8.3%}{mark}")
    own = "infinite depth" if f["scene"] < 0 else f"depth {f['scene']}"
    tolerance = f"tolerance {f['tolerance']:.3g}, in a tile {IN_A_TILE * f['tolerance']:.3g}"
    if f["chosen"] == f["scene"]:
        found = f"the scene's {own} is kept and nothing left out"
    else:
        found = (
            f"depth {f['chosen']} instead of the scene's {own} leaves out {f['left_out']:.3%} of the scattered light, "
            f"at most {f['left_out_in_a_tile']:.2%} in a tile"
        )
    return [*lines, f"{found} ({tolerance}; probed in {f['probe_seconds']:.1f} s)"]
