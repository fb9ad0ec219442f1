"""Light of a scene by path depth: the share of each bounce, and the smallest depth that leaves out almost nothing.

Depths are those of Mitsuba's ``max_depth``: 1 is emitted light alone, 2 adds direct light, 3 adds light that bounced
twice, and so on. A coarse image is rendered to the scene's own depth, then to the depths 1, 2, … by the same integrator
with the same random numbers: deeper paths continue shorter ones, so that differences are added bounces, never noise.

Shares (:func:`bounces`) are parts of the scattered light:

- *Scattered light* reached the camera by way of a surface. Emitted light that is seen directly (lamps, the sky) is in
  the image at any depth and costs nothing; it is not counted, so bright lamps hide no error.
- Brightness is exposed as a photographer would, the median of the lit pixels at middle grey (0.18), and clipped at 1,
  so that a few brilliant highlights hide no error either. The unit of light in the file has no influence.
- A mean hides errors in a corner. The image is therefore also divided into tiles, 16 along its longer side, and the
  largest loss of any tile is reported. Tiles darker than a tenth of middle grey count as if they had that brightness.

The chosen depth is the smallest at which the rest of the whole image is below the tolerance, and the rest of each tile
below ten times the tolerance.
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..core import compat
from ..core.progress import interruptible, progress_bar
from . import loading

#: Part of the scattered light that may be left out.
TOLERANCE = 0.005

#: Multiple of the tolerance that a single tile may lose of its light.
IN_A_TILE = 10

#: Tiles along the longer side of the image.
TILES = 16

#: Pixels along the side of a tile.
TILE = 8

#: Samples per pixel of the coarse image.
SPP = 64

#: Largest depth that is tried.
DEEPEST = 64

#: Luminance of middle grey, to which images are exposed.
MIDDLE_GREY = 0.18

#: Part of a pixel's light below which a difference is rounding: kernels of two depths round differently.
ROUNDING = 1e-5


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

    def is_enough(self, tolerance: float) -> bool:
        """Return whether ``rest`` is below the tolerance, and ``rest_in_a_tile`` below ten times that."""
        return self.rest < tolerance and self.rest_in_a_tile < IN_A_TILE * tolerance


def probe(scene, integrator, seed: int) -> np.ndarray:
    """Return the luminance of a coarse image by an integrator, ``(height, width)``; what is not finite counts as 0.

    A film with a crop window keeps its size. Raises :class:`.SceneError`.
    """
    sensor = scene.sensors()[0]
    size = sensor.film().crop_size()
    width, height = (TILE * max(1, round(TILES * n / max(size))) for n in size)
    with loading.scene_errors(None), compat.film_size(sensor, width, height):
        image = mi.render(scene, integrator=integrator, spp=SPP, seed=seed % 2**32).numpy().astype(np.float64)
    image = loading.colour_channels(image)
    luminance = image @ (0.212671, 0.715160, 0.072169) if image.shape[2] == 3 else image[..., 0]
    return np.where(np.isfinite(luminance), luminance, 0)


def _tiles(images: np.ndarray) -> np.ndarray:
    """Return the means of the tiles of images ``(…, height, width)``."""
    for axis in (-2, -1):
        n = images.shape[axis]
        count = max(1, round(TILES * n / max(images.shape[-2:])))
        starts = np.arange(count) * n // count
        lengths = np.diff(starts, append=n)
        images = np.add.reduceat(images, starts, axis=axis) / (lengths[:, None] if axis == -2 else lengths)
    return images


def bounces(images: Sequence[np.ndarray], full: np.ndarray) -> list[Bounce]:
    """Return one :class:`Bounce` for each of the ``images``, rendered to the depths 1, 2, ….

    All are luminances ``(height, width)``; ``full`` is rendered to the scene's own depth. Without scattered light all
    parts are 0.
    """
    scattered = np.stack([*images, full]) - images[0]
    scattered = np.where(scattered > ROUNDING * full, scattered, 0)
    lit = scattered[-1][scattered[-1] > 0]
    if lit.size == 0:
        return [Bounce(k + 1, 0.0, 0.0, 0.0) for k in range(len(images))]
    tiles = _tiles(np.clip(scattered * (MIDDLE_GREY / np.median(lit)), 0, 1))
    means = tiles.mean((1, 2)) / tiles[-1].mean()
    in_a_tile = ((tiles[-1] - tiles) / np.maximum(tiles[-1], MIDDLE_GREY / 10)).max((1, 2))
    parts = zip(np.diff(means, prepend=0), 1 - means, in_a_tile, strict=True)
    return [Bounce(k + 1, *map(float, each)) for k, each in enumerate(parts)][:-1]


def auto_depth(parsed: loading.ParsedScene, tolerance: float = TOLERANCE, seed: int = 0, progress: bool = True) -> dict:
    """Render a scene coarsely to growing depths, and choose the depth of its paths.

    Returns ``chosen``, the scene's own depth (``scene``, -1: infinite) if no smaller one is enough, the ``tolerance``,
    the ``shares`` of all depths up to it (:class:`Bounce`), the rest (``left_out``, ``left_out_in_a_tile``), and
    ``probe_seconds``. Raises :class:`.SceneError`, also for a scene that has not one integrator with a depth,
    ``ValueError`` unless the tolerance is between 0 and 1, and ``KeyboardInterrupt``.
    """
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: found {tolerance:g}, allowed is more than 0 and less than 1")
    _, max_depth = parsed.path_integrator()
    scene, start = parsed.load(), time.perf_counter()
    last = DEEPEST if max_depth < 0 else min(max_depth, DEEPEST)
    images: list[np.ndarray] = []
    with interruptible() as stop, progress_bar("probe", last, progress=progress) as bar:
        full = probe(scene, parsed.load_integrator(max_depth), seed)
        shares = bounces([full], full)
        for depth in range(1, last + 1):
            if stop.is_set():
                raise KeyboardInterrupt
            images.append(full if depth == max_depth else probe(scene, parsed.load_integrator(depth), seed))
            shares = bounces(images, full)
            bar.update()
            if shares[-1].is_enough(tolerance):
                break
    enough = bool(images) and shares[-1].is_enough(tolerance)
    chosen = shares[-1].depth if enough else max_depth
    return {
        "chosen": chosen,
        "scene": max_depth,
        "tolerance": tolerance,
        "shares": [{"depth": bounce.depth, "light": bounce.name, **dataclasses.asdict(bounce)} for bounce in shares],
        "left_out": shares[-1].rest if chosen != max_depth else 0.0,
        "left_out_in_a_tile": shares[-1].rest_in_a_tile if chosen != max_depth else 0.0,
        "probe_seconds": time.perf_counter() - start,
    }


def summary(f: dict) -> list[str]:
    """Return the result of :func:`auto_depth` as lines of text."""
    lines = ["depth  light        share      rest   in a tile"]
    for s in f["shares"]:
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
