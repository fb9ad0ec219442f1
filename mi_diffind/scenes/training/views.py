"""Views of a training inside a scene: places of camera and lights, their random distribution, and its arguments."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...core.arguments import Argument, positive
from ...core.errors import UsageError


@dataclass(frozen=True)
class View:
    """One view and its light: angles in degrees, ``origin`` and ``distance`` in units of the scene.

    ``None`` leaves a value as in the scene (:class:`ViewDistribution`).
    """

    azimuth: float | None = None
    elevation: float | None = None
    distance: float | None = None
    origin: tuple[float, float, float] | None = None
    light_azimuth: float | None = None
    light_elevation: float | None = None


@dataclass(frozen=True)
class ViewDistribution:
    """Distribution of views and lights: ranges ``(low, high)``; ``None`` leaves a value as in the scene.

    The camera orbits ``target`` (``None``: the surface in the middle of the scene's image): ``azimuth`` is its turn
    about the direction ``up``, ``elevation`` its height above the plane through the target, both in degrees, and
    ``distance`` its distance to the target. Alternatively, ``origins`` are two corners of a box that contains the
    camera, which looks at the target. ``light_azimuth`` is the turn of all movable lights about the same axis,
    environments included; ``light_elevation`` the height of all lights but environments, and of the sun of a sunsky.
    Area lights move with their shapes.

    ``count`` views are trained and ``held_out`` others measured. They are points of a low-discrepancy sequence
    (Roberts' R₅) with a random offset from the ``seed``: the first views of a large set are those of a small one.
    Without any range there is one view, the scene's own, for training and measurement.
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

    #: Allowed values of each range.
    LIMITS = {  # noqa: RUF012
        "azimuth": (-360, 360), "elevation": (-89, 89), "distance": (1e-6, 1e6), "light_azimuth": (-360, 360),
        "light_elevation": (-89, 89),
    }  # fmt: skip

    def __post_init__(self):
        for name in ("count", "held_out"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} of the views: found {getattr(self, name)}, at least 1 is needed")
        for name, (low, high) in self.LIMITS.items():
            given = getattr(self, name)
            if given is not None and not low <= given[0] <= given[1] <= high:
                raise UsageError(
                    f"{name}: found {given[0]:g} to {given[1]:g}, allowed are ascending numbers in [{low:g}, {high:g}]"
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
        """Return the views for training."""
        return self._drawn(self.count, 0)

    def measured(self) -> list[View]:
        """Return the views for measurement."""
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
            limits = getattr(self, name)
            return None if limits is None else float(limits[0] + share * (limits[1] - limits[0]))

        origin = None
        if self.origins is not None:
            origin = tuple(float(a + s * (b - a)) for a, b, s in zip(*self.origins, x[:3], strict=True))
        return View(
            at("azimuth", x[0]), at("elevation", x[1]), at("distance", x[2]), origin,
            at("light_azimuth", x[3]), at("light_elevation", x[4]),
        )  # fmt: skip


def _numbers(text: str, count: int, separator: str, form: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(separator))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {form}")
    return numbers


def span(text: str) -> tuple[float, float]:
    """Parse a range, ``LOW:HIGH``, or one number. Raises ``ArgumentTypeError``."""
    return _numbers(text if ":" in text else f"{text}:{text}", 2, ":", "LOW:HIGH, as in 10:60")


def point(text: str) -> tuple[float, float, float]:
    """Parse ``X,Y,Z``. Raises ``ArgumentTypeError``."""
    return _numbers(text, 3, ",", "X,Y,Z, as in 0,1.5,-2")


def box(text: str) -> tuple:
    """Parse two corners, ``X,Y,Z:X,Y,Z``. Raises ``ArgumentTypeError``."""
    corners = text.split(":")
    if len(corners) != 2:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected two corners, X,Y,Z:X,Y,Z")
    return tuple(map(point, corners))


_NEGATIVE = "if the first number is negative, write --azimuth=-30:30"

#: Arguments of the views; ranges that are not given leave the scene as it is.
VIEW_ARGUMENTS = (
    Argument("--views", type=positive, metavar="N", help="number of views for training (default: 16)"),
    Argument("--held-out", type=positive, metavar="N", help="number of other views, for measurement (default: 4)"),
    Argument(
        "--azimuth", type=span, metavar="A:B", help=f"degrees by which the camera turns about the target ({_NEGATIVE})"
    ),
    Argument("--elevation", type=span, metavar="A:B", help="degrees of the camera above the target"),
    Argument("--distance", type=span, metavar="A:B", help="distance of the camera from the target"),
    Argument(
        "--origins",
        type=box,
        metavar="X,Y,Z:X,Y,Z",
        help="corners of a box for the camera, instead of angles and distance",
    ),
    Argument(
        "--target",
        type=point,
        metavar="X,Y,Z",
        help="point that the camera looks at (default: the middle of the image)",
    ),
    Argument("--up", type=point, metavar="X,Y,Z", help="the vertical of all angles (default: 0,1,0)"),
    Argument(
        "--light-azimuth",
        type=span,
        metavar="A:B",
        help="degrees by which lights and environments turn; area lights take their shapes along",
    ),
    Argument(
        "--light-elevation",
        type=span,
        metavar="A:B",
        help="degrees of lights, and of the sun of a sunsky, above the target; environments stay",
    ),
)


def views_of(options: Mapping, seed: int = 0) -> ViewDistribution:
    """Return the distribution of the given options. Raises :class:`.UsageError`."""
    names = {
        "views": "count",
        **{f.name: f.name for f in dataclasses.fields(ViewDistribution) if f.name not in ("count", "seed")},
    }
    given = {names[k]: options[k] for k in names if options.get(k) is not None}
    return ViewDistribution(**given, seed=seed)
