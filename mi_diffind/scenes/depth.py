"""Light of a scene by path depth: the share of each bounce, and the smallest depth that leaves out almost nothing.

Depths are counted like Mitsuba's ``max_depth``: 1 is emitted light alone, 2 adds direct light, 3 adds light that
bounced twice, and so on.

:func:`probe` follows paths through a coarse image once, to the scene's own depth, and adds the light of each vertex to
the depth at which it arrives. All depths are parts of the same paths: their differences are added bounces, never
noise, and one kernel serves all of them (an image for each depth would compile one for each).

Shares (:func:`bounces`) are parts of the scattered light:

- *Scattered light* reached the camera by way of a surface. Emitted light that is seen directly (lamps, the sky) is in
  the image at any depth and costs nothing; it is not counted, so bright lamps hide no error.
- Brightness is exposed as a photographer would, the median of the lit pixels at middle grey (0.18), and clipped at 1,
  so that a few brilliant highlights hide no error either. The unit of light in the file has no influence.
- A mean hides errors in a corner. The image is therefore also divided into tiles, 16 along its longer side, and the
  largest loss of any tile is reported. Tiles darker than a tenth of middle grey count as if they had that brightness.

:func:`choose` returns the smallest depth at which the rest of the whole image is below the tolerance, and the rest of
each tile below ten times the tolerance.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import compat
from ..core.compat import ray_flags
from ..core.progress import interruptible, progress_bar
from ..plugins.support import distance_shapes as sdf
from . import loading

#: Part of the scattered light that may be left out, and the multiple of it that a single tile may lose of its light.
TOLERANCE, IN_A_TILE = 0.005, 10

#: Integrators that follow light through media, which the probe does not.
MEDIA = ("volpath", "volpathmis", "prbvolpath")

#: Settings of the probe: tiles along the longer side of the image, pixels along the side of a tile, paths per pixel,
#: passes.
TILES, TILE, SPP, PASSES = 16, 8, 16, 4

#: Number of depths that are distinguished; light of deeper paths counts at the last.
MAX_BINS = 64

#: First vertex of Russian roulette: a path continues with the probability of its throughput, at most 0.95 (unbiased).
ROULETTE = 8

#: Luminance of middle grey, to which images are exposed.
MIDDLE_GREY = 0.18


@dataclass(frozen=True)
class Bounce:
    """Light that arrives at one ``depth`` (1: an emitter is seen), as parts of all scattered light, 0 to 1.

    ``share``: of this depth (emitted light has none); ``rest``: left out by a render up to this depth;
    ``rest_in_a_tile``: the largest part that any tile would lose of its own light.
    """

    depth: int
    share: float
    rest: float
    rest_in_a_tile: float

    @property
    def name(self) -> str:
        """Name of the light: emitted, direct, or the number of bounces."""
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
    """Return the luminance of a coarse image by depth, float64 ``(depths, height, width)``; ``[k]`` is depth ``k + 1``.

    There are ``max_depth`` depths, at most :data:`MAX_BINS`; deeper paths, or infinitely deep ones (-1), are followed
    as well, and the last entry sums them.

    The path tracer samples emitters and uses multiple importance sampling, as Mitsuba's ``path``: surfaces only,
    without polarisation, and with the emitters that ``hide_emitters`` hides. Distance fields are traced as by
    ``path_sdf``; radiance fields are left out. Spectral variants scale all by one factor.
    ``spp`` paths start in each pixel, in ``passes``; ``on_pass()`` is called after each. The same seed gives the same
    numbers. Raises :class:`.SceneError`, and ``KeyboardInterrupt`` after a pass if ``stop`` is set.
    """
    sensor = scene.sensors()[0]
    size = sensor.film().crop_size()
    width, height = (TILE * max(1, round(TILES * n / max(size))) for n in (size[0], size[1]))
    depths = MAX_BINS if max_depth < 0 else max(1, min(max_depth, MAX_BINS))
    passes = max(1, min(passes, spp))
    total, done = np.zeros((depths, height, width)), 0
    for i in range(passes):
        n = (i + 1) * spp // passes - done
        with loading.scene_errors(None):
            light = _pass(scene, sensor, width, height, n, (seed * passes + i) % 2**32, max_depth, depths)
            total += light.numpy().reshape(total.shape)
        done += n
        if on_pass is not None:
            on_pass()
        if stop is not None and stop.is_set():
            raise KeyboardInterrupt
    return total / spp


def _pass(scene, sensor, width: int, height: int, spp: int, seed: int, max_depth: int, depths: int):
    """Return the sums over the paths of each pixel of one pass, ``depths · height · width`` numbers."""
    paths = width * height * spp
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), paths)
    path = dr.arange(mi.UInt32, paths)
    pixel = path // dr.opaque(mi.UInt32, spp)  # opaque like all numbers that differ between probes: one kernel for all
    position = mi.Point2f(pixel % width, pixel // width) + sampler.next_2d()
    moment = sensor.shutter_open() + sampler.next_1d() * sensor.shutter_open_time()
    position /= mi.Point2f(width, height)
    ray, weight = sensor.sample_ray(moment, sampler.next_1d(), position, sampler.next_2d())
    light = dr.zeros(mi.Float, depths * paths)  # each path adds to its own entries: the same sums each time
    limits = [dr.opaque(mi.UInt32, n) for n in (paths, depths - 1, 0xFFFFFFFF if max_depth < 0 else max_depth)]
    shapes = sdf.distance_shapes_in(scene)
    _follow(scene, shapes, sampler, mi.Ray3f(ray), mi.unpolarized_spectrum(weight), light, path, *limits)
    return dr.block_sum(light, spp)


@compat.syntax
def _follow(scene, shapes, sampler, ray, β, light, path, paths, deepest, limit):
    """Follow paths as ``mi.ad.integrators.prb`` does; add luminance of depth ``k + 1`` to ``light[k·paths + path]``.

    ``shapes`` are distance fields, which Mitsuba's rays do not meet.
    """
    context = mi.BSDFContext()
    depth, η, active = mi.UInt32(0), mi.Float(1), mi.Bool(True)
    si_prev = dr.zeros(mi.SurfaceInteraction3f)
    pdf_prev, delta_prev = mi.Float(1), mi.Bool(True)
    rest = mi.Vector3f(0)

    while active:
        pi = scene.ray_intersect_preliminary(ray, active=active)
        if dr.hint(bool(shapes), mode="scalar"):
            hit = sdf.intersect(shapes, ray.o, ray.d, dr.minimum(pi.t, ray.maxt), active, rest)
            pi.t = dr.select(hit.number > 0, dr.inf, pi.t)
        si = pi.compute_surface_interaction(ray, ray_flags(), active)
        if dr.hint(bool(shapes), mode="scalar"):
            si = sdf.interaction(shapes, hit, ray, si, active)
        bsdf = si.bsdf(ray)

        # Emission at this vertex
        ds = mi.DirectionSample3f(scene, si=si, ref=si_prev)
        mis = _mis(pdf_prev, scene.pdf_emitter_direction(si_prev, ds, ~delta_prev))
        Le = β * mis * mi.unpolarized_spectrum(ds.emitter.eval(si, active))
        _add(light, Le, ray.wavelengths, dr.minimum(depth, deepest) * paths + path, active)

        # Emitters sampled from this vertex: one bounce more
        active &= (depth + 1 < limit) & si.is_valid()
        lit = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, lit)
        lit &= ds.pdf != 0
        if dr.hint(bool(shapes), mode="scalar"):
            lit &= ~sdf.occluded_from(shapes, hit, si, ds, lit)
        value, pdf = bsdf.eval_pdf(context, si, si.to_local(ds.d), lit)
        mis = dr.select(ds.delta, 1, _mis(ds.pdf, pdf))
        Lr = β * mis * mi.unpolarized_spectrum(value) * mi.unpolarized_spectrum(weight)
        _add(light, Lr, ray.wavelengths, dr.minimum(depth + 1, deepest) * paths + path, lit)

        # The next vertex
        bs, weight = bsdf.sample(context, si, sampler.next_1d(), sampler.next_2d(), active)
        β *= mi.unpolarized_spectrum(weight)
        η *= bs.eta
        ray = si.spawn_ray(si.to_world(bs.wo))
        if dr.hint(bool(shapes), mode="scalar"):
            ray.o, rest = sdf.spawn(shapes, hit, si, ray.d)
        si_prev, pdf_prev, delta_prev = si, bs.pdf, mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        survival = dr.minimum(dr.max(β) * η * η, 0.95)
        survival = dr.select(depth >= ROULETTE, survival, 1)
        active &= (dr.max(β) != 0) & (sampler.next_1d() < survival)
        β *= dr.rcp(survival)
        depth += 1


def _mis(a, b):
    """Return the weight of the strategy with density ``a``: the power heuristic (Veach 1997), without overflow."""
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)


def _add(light, radiance, wavelengths, index, active):
    luminance = radiance[0] if mi.is_monochromatic else mi.luminance(radiance, wavelengths)
    dr.scatter_add(light, luminance, index, active & dr.isfinite(luminance), mode=dr.ReduceMode.NoConflicts)


def bounces(light: np.ndarray) -> list[Bounce]:
    """Return one :class:`Bounce` for each depth of a :func:`probe`. Without scattered light all shares are 0."""
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
    """Raise ``ValueError`` unless the tolerance is between 0 and 1."""
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: found {tolerance:g}, allowed is more than 0 and less than 1")


def choose(shares: list[Bounce], max_depth: int, tolerance: float = TOLERANCE) -> int:
    """Return the smallest depth with a ``rest`` below ``tolerance`` and ``rest_in_a_tile`` below ten times that.

    If there is none, the scene's own ``max_depth`` (-1: infinite). Raises ``ValueError`` as :func:`check_tolerance`.
    """
    check_tolerance(tolerance)
    for bounce in shares[:-1]:
        if bounce.rest < tolerance and bounce.rest_in_a_tile < IN_A_TILE * tolerance:
            return bounce.depth
    return max_depth


def auto_depth(parsed: loading.ParsedScene, tolerance: float = TOLERANCE, seed: int = 0, progress: bool = True) -> dict:
    """Probe a scene and choose the depth of its paths.

    Returns ``chosen`` and ``scene`` (its own depth, never exceeded; -1: infinite), ``tolerance``, ``shares`` (of each
    depth: ``depth``, ``light``, and the figures of a :class:`Bounce`), ``left_out`` and ``left_out_in_a_tile``
    (``rest`` and ``rest_in_a_tile`` of the chosen depth), ``probe_seconds`` (with compilation). Ctrl-C ends the probe
    after the current pass with ``KeyboardInterrupt``. Raises :class:`.SceneError`, also if the
    scene's integrator follows light through media that the scene has, and ``ValueError`` as :func:`choose`.
    """
    check_tolerance(tolerance)
    integrator, max_depth = parsed.path_integrator()
    scene = parsed.load()
    if integrator in MEDIA and any(isinstance(node, mi.Medium) for node in compat.objects_of(scene)):
        raise loading.SceneError(
            f'{parsed.path}: the integrator "{integrator}" also follows light through media, and only bounces on '
            f"surfaces can be measured; a number sets its depth"
        )
    start = time.perf_counter()
    with interruptible() as stop, progress_bar("probe", PASSES, progress=progress) as bar:
        shares = bounces(probe(scene, max_depth, seed=seed, on_pass=bar.update, stop=stop))
    seconds = time.perf_counter() - start
    chosen = choose(shares, max_depth, tolerance)
    kept = shares[chosen - 1] if chosen != max_depth else Bounce(max_depth, 0.0, 0.0, 0.0)
    return {
        "chosen": chosen,
        "scene": max_depth,
        "tolerance": tolerance,
        "shares": [{"depth": bounce.depth, "light": bounce.name, **dataclasses.asdict(bounce)} for bounce in shares],
        "left_out": kept.rest,
        "left_out_in_a_tile": kept.rest_in_a_tile,
        "probe_seconds": seconds,
    }


def summary(f: dict) -> list[str]:
    """Return the result of :func:`auto_depth` as lines of text."""
    lines = ["depth  light        share      rest   in a tile"]
    shown = [s for s in f["shares"] if s["depth"] <= 2 or s["share"] >= 5e-6 or s["depth"] == f["chosen"]]
    for s in shown:
        share = f"{s['share']:8.3%}" if s["depth"] > 1 else "       –"
        mark = "  <- chosen" if s["depth"] == f["chosen"] else ""
        lines.append(f"{s['depth']:5}  {s['light']:10} {share}  {s['rest']:8.3%}    {s['rest_in_a_tile']:8.3%}{mark}")
    scene_depth = "infinite depth" if f["scene"] < 0 else f"depth {f['scene']}"
    tolerance = f"tolerance {f['tolerance']:.3g}, in a tile {IN_A_TILE * f['tolerance']:.3g}"
    if f["chosen"] == f["scene"]:
        outcome = f"the scene's {scene_depth} is kept and nothing left out"
    else:
        outcome = (
            f"depth {f['chosen']} instead of the scene's {scene_depth} leaves out {f['left_out']:.3%} of the scattered "
            f"light, at most {f['left_out_in_a_tile']:.2%} in a tile"
        )
    return [*lines, f"{outcome} ({tolerance}; probed in {f['probe_seconds']:.1f} s)"]
