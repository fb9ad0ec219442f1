"""How a texture is trained inside a scene, what its views and lights are: settings, without Mitsuba."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from ..errors import UsageError
from ..settings import FitSettings

#: Where the arrays start: as they are in the file, or as a training of the texture starts.
STARTS = ("file", "untrained")

#: Steps of a training that is not told how long it may take.
STEPS = 400


@dataclass(frozen=True)
class SceneRecipe:
    """
    ``share``: λ, the share of the loss of rendered images; the rest is the loss of the texture. ``spp``: samples a
    pixel of the renders that are trained, from 1 on, which the footprints are of: as the result is to be rendered.
    ``bound``: the derivative of the loss of a pixel stays within that of an error of ± ``bound``, in units of
    ``exposure`` (``None``: unbounded). ``reference_spp``: samples a pixel of a reference. ``against``: what stands for
    learned plugins there, ``"exact"`` or the name of another counterpart. ``exposure``: factor of all radiance, which
    makes 1 of what is white (``None``: of what 5% of the references' pixels exceed). ``start``: one of :data:`STARTS`.
    ``settings``: the rest; its ``loss`` is that of images, its ``batch`` the samples of the texture a step.

    Only ``"mse"`` without a bound has gradients that are right on average at few samples: that of ``"mae"``, and
    squared errors beyond the bound, see the median of noisy pixels rather than the mean.
    """

    share: float = 0.9
    spp: int = 1
    bound: float | None = 1.0
    reference_spp: int = 1024
    against: str = "exact"
    exposure: float | None = None
    start: str = "file"
    settings: FitSettings = dataclasses.field(
        default_factory=lambda: FitSettings(
            steps=STEPS, batch=2**16, lr=3e-3, schedule="cosine", loss="mse", measure_every=STEPS // 10
        )
    )

    def __post_init__(self):
        if not 0 <= self.share <= 1:
            raise UsageError(f"share: found {self.share}, allowed are numbers from 0 to 1")
        for name in ("spp", "reference_spp"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name}: found {getattr(self, name)}, at least 1 is needed")
        for name in ("bound", "exposure"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise UsageError(f"{name}: found {value}, a positive number is needed")
        if self.start not in STARTS:
            raise UsageError(f'start: found "{self.start}", allowed are {", ".join(STARTS)}')


@dataclass(frozen=True)
class View:
    """
    One view and its light: angles in degrees, ``origin`` and ``distance`` in units of the scene; ``None``: as in the
    scene (:class:`ViewDistribution`).
    """

    azimuth: float | None = None
    elevation: float | None = None
    distance: float | None = None
    origin: tuple[float, float, float] | None = None
    light_azimuth: float | None = None
    light_elevation: float | None = None


@dataclass(frozen=True)
class ViewDistribution:
    """
    Ranges, ``(low, high)``, that views and lights are drawn from; ``None`` leaves what it is of as it is in the scene.

    The camera orbits ``target`` (``None``: what the middle of the scene's image shows): ``azimuth`` is what it is
    turned by about the direction ``up``, ``elevation`` its height above the plane through the target, both in degrees,
    and ``distance`` that to the target. In place of these, ``origins`` are two corners of a box that it is in, from
    where it looks at the target. ``light_azimuth`` is what all lights that can be moved are turned by about the same
    axis, environments among them; ``light_elevation`` the height of those that are in one direction or at one place.

    ``count`` views are trained on and ``held_out`` others measured. They are points of a sequence of low discrepancy
    (Roberts' R₅) with an offset that the ``seed`` draws, so that the first of many are those of few. Without any range,
    there is one view, the scene's own, and it is measured, too.
    """

    count: int = 16
    held_out: int = 4
    azimuth: tuple[float, float] | None = None
    elevation: tuple[float, float] | None = None
    distance: tuple[float, float] | None = None
    origins: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    target: tuple[float, float, float] | None = None
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    light_azimuth: tuple[float, float] | None = None
    light_elevation: tuple[float, float] | None = None
    seed: int = 0

    #: Ranges, and what they have to lie in.
    LIMITS = {  # noqa: RUF012
        "azimuth": (-360, 360), "elevation": (-89, 89), "distance": (1e-6, 1e6), "light_azimuth": (-360, 360),
        "light_elevation": (-89, 89),
    }  # fmt: skip

    def __post_init__(self):
        for name in ("count", "held_out"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} of the views: found {getattr(self, name)}, at least 1 is needed")
        for name, (low, high) in self.LIMITS.items():
            found = getattr(self, name)
            if found is not None and not low <= found[0] <= found[1] <= high:
                raise UsageError(
                    f"{name}: found {found[0]:g} to {found[1]:g}, allowed are ascending numbers in [{low:g}, {high:g}]"
                )
        if self.origins is not None and any(getattr(self, n) for n in ("azimuth", "elevation", "distance")):
            raise UsageError("origins: a camera in a box has neither azimuth, elevation nor distance")
        if not any(self.up):
            raise UsageError("up: found 0, 0, 0, a direction is needed")

    @property
    def moves_camera(self) -> bool:
        return any(v is not None for v in (self.azimuth, self.elevation, self.distance, self.origins))

    @property
    def moves_light(self) -> bool:
        return self.light_azimuth is not None or self.light_elevation is not None

    def trained(self) -> list[View]:
        """The views that are trained on."""
        return self._drawn(self.count, 0)

    def measured(self) -> list[View]:
        """Those that are measured."""
        return self._drawn(self.held_out, 1)

    def _drawn(self, count: int, stream: int) -> list[View]:
        if not (self.moves_camera or self.moves_light):
            return [View()]
        dims = 5
        root = 2.0
        for _ in range(64):  # x^(d + 1) = x + 1
            root = (1 + root) ** (1 / (dims + 1))
        steps = root ** -np.arange(1, dims + 1)
        offset = np.random.default_rng((self.seed, stream)).random(dims)
        return [self._view((offset + i * steps) % 1) for i in range(1, count + 1)]

    def _view(self, x: np.ndarray) -> View:
        def at(name: str, share: float) -> float | None:
            found = getattr(self, name)
            return None if found is None else float(found[0] + share * (found[1] - found[0]))

        origin = None
        if self.origins is not None:
            origin = tuple(float(a + s * (b - a)) for a, b, s in zip(*self.origins, x[:3], strict=True))
        return View(
            at("azimuth", x[0]), at("elevation", x[1]), at("distance", x[2]), origin,
            at("light_azimuth", x[3]), at("light_elevation", x[4]),
        )  # fmt: skip
