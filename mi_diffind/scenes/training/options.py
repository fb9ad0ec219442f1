"""Options of a training inside a scene: recipe, views and the arguments of ``fit scene``. Free of Mitsuba."""

import argparse
import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...core.arguments import Argument, define, positive, positive_or_none
from ...core.errors import UsageError
from ...fitting.task import FitSettings
from ...maps.arguments import PREVIEW

#: Starting points of the arrays: those of the file, or those of an untrained texture.
STARTS = ("file", "untrained")

#: Steps of a training without a time limit.
STEPS = 400

#: Footprints that are trained and measured, in samples a pixel, as multiples of ``spp``.
FOOTPRINTS = (1, 4)

#: Dimensions of the sequence of views: azimuth, elevation and distance (or a place), and two of the light.
DIMENSIONS = 5


@dataclass(frozen=True)
class SceneRecipe:
    """Recipe of a training inside a scene.

    ``share``: λ, the share of the loss of rendered images; the rest is the loss of the texture. ``spp``: samples a
    pixel of the trained renders, at least 1: choose the number with which the result will be rendered. Footprints are
    those of ``spp`` and of four times as many (:data:`FOOTPRINTS`) in turn. ``samples``: smallest number of samples of
    a trained render; a small film gets more than ``spp`` a pixel, with the same footprints, since a step takes little
    longer and its gradient has less noise.
    ``bound``: limit of an error, in units of ``exposure``, beyond which its derivative grows no further (``None``:
    unlimited). ``reference_spp``: samples a pixel of a trained view's reference; those of held-out views have a
    quarter, since the measurement does not count their noise. ``against``: counterpart of learned plugins in
    references, ``"exact"`` or the name of another one. ``exposure``: factor of all radiance that maps white to 1
    (``None``: maps the value that 5% of the references' pixels exceed). ``start``: one of :data:`STARTS`.
    ``settings``: the rest; its ``loss`` is that of images (:mod:`.problem`), its ``batch`` the texture samples of a
    step.
    """

    share: float = 0.9
    spp: int = 1
    bound: float | None = 1.0
    samples: int = 2**15
    reference_spp: int = 1024
    against: str = "exact"
    exposure: float | None = None
    start: str = "file"
    settings: FitSettings = dataclasses.field(
        default_factory=lambda: FitSettings(
            steps=STEPS, batch=2**16, lr=1e-2, schedule="cosine", loss="mse", measure_every=STEPS // 4
        )
    )

    def __post_init__(self):
        if not 0 <= self.share <= 1:
            raise UsageError(f"share: found {self.share}, allowed are numbers from 0 to 1")
        for name in ("spp", "samples", "reference_spp"):
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
    about the direction ``up`` (``None``: the y axis), ``elevation`` its height above the plane through the target, both
    in degrees, and ``distance`` its distance to the target. Alternatively, ``origins`` are two corners of a box that
    contains the camera, which looks at the target. ``light_azimuth`` is the turn of all movable lights about the same
    axis, environments included; ``light_elevation`` the height of all lights but environments, and of the sun of a
    sunsky. Area lights move with their shapes.

    ``count`` views are trained and ``held_out`` others measured. They are points of a low-discrepancy sequence
    (Roberts' R₅) with a random offset from the ``seed``: the first views of a large set are those of a small one. The
    errors of views differ by 10 dB, so that few of them measure little.

    Without any range, ``fit scene`` draws small ones around the scene's own camera and lights
    (:func:`.rig.small_ranges`). With a ``count`` of 1, it trains the scene's own view alone and measures that view: its
    figure is then a training score.
    """

    count: int = 16
    held_out: int = 32
    azimuth: tuple[float, float] | None = None
    elevation: tuple[float, float] | None = None
    distance: tuple[float, float] | None = None
    origins: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    target: tuple[float, float, float] | None = None
    up: tuple[float, float, float] | None = None
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
        if self.up is not None and not any(self.up):
            raise UsageError("up: found 0, 0, 0, a direction is needed")

    @property
    def moves(self) -> bool:
        """Whether views differ from the scene's own."""
        return self.moves_camera or self.moves_light

    @property
    def moves_camera(self) -> bool:
        """Whether the camera differs from view to view."""
        return any(v is not None for v in (self.azimuth, self.elevation, self.distance, self.origins))

    @property
    def moves_light(self) -> bool:
        """Whether the lights differ from view to view."""
        return self.light_azimuth is not None or self.light_elevation is not None

    def trained(self) -> list[View]:
        """Return the views for training."""
        return self._views(self.count, 0)

    def measured(self) -> list[View]:
        """Return the views for measurement."""
        return self._views(self.held_out, 1)

    def _views(self, count: int, stream: int) -> list[View]:
        if not self.moves:
            return [View()]
        root = 2.0
        for _ in range(64):  # x^(d + 1) = x + 1
            root = (1 + root) ** (1 / (DIMENSIONS + 1))
        steps = root ** -np.arange(1, DIMENSIONS + 1)
        offset = np.random.default_rng((self.seed, stream)).random(DIMENSIONS)
        return [self._view((offset + i * steps) % 1) for i in range(1, count + 1)]

    def _view(self, x: np.ndarray) -> View:
        shares = dict(zip(self.LIMITS, x, strict=True))
        ranges = {name: getattr(self, name) for name in shares if getattr(self, name) is not None}
        values = {name: float(low + shares[name] * (high - low)) for name, (low, high) in ranges.items()}
        if self.origins is not None:
            values["origin"] = tuple(float(a + s * (b - a)) for a, b, s in zip(*self.origins, x[:3], strict=True))
        return View(**values)


def _numbers(text: str, count: int, separator: str, expected: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(separator))
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {expected}")
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


_DEFAULT = SceneRecipe()

#: All arguments of ``fit scene`` but the scene and the share. Without any range, ``fit scene`` draws small ones;
#: otherwise, ranges that are not given leave the scene as it is.
SCENE_ARGUMENTS = (
    Argument(
        "--views", type=positive, metavar="N",
        help="number of views for training (default: 16); without a range of camera or lights they lie close around "
        "the scene's own: azimuth ±15°, elevation ±10°, lights turned by ±20°, less where a surface is in the way; "
        "1: the scene's own view alone, whose figure is a training score",
    ),
    Argument("--held-out", type=positive, metavar="N", help="number of other views, for measurement (default: 32)"),
    Argument(
        "--azimuth", type=span, metavar="A:B",
        help="degrees by which the camera turns about the target (if the first number is negative, write "
        "--azimuth=-30:30)",
    ),
    Argument("--elevation", type=span, metavar="A:B", help="degrees of the camera above the target"),
    Argument("--distance", type=span, metavar="A:B", help="distance of the camera from the target"),
    Argument(
        "--origins", type=box, metavar="X,Y,Z:X,Y,Z",
        help="corners of a box for the camera, instead of angles and distance",
    ),
    Argument(
        "--target", type=point, metavar="X,Y,Z",
        help="point that the camera looks at (default: the middle of the image)",
    ),
    Argument(
        "--up", type=point, metavar="X,Y,Z",
        help="the vertical of all angles (default: 0,1,0; without any range, the axis closest to the camera's)",
    ),
    Argument(
        "--light-azimuth", type=span, metavar="A:B",
        help="degrees by which lights and environments turn; area lights take their shapes along",
    ),
    Argument(
        "--light-elevation", type=span, metavar="A:B",
        help="degrees of lights, and of the sun of a sunsky, above the target; environments stay",
    ),
    Argument(
        "--spp", type=positive, metavar="N",
        help="samples a pixel of renders with the result; footprints of four times as many are trained, too (default: "
        "1)",
    ),
    Argument(
        "--samples", type=positive, metavar="N",
        help="smallest number of samples of a trained render: a small film gets more than --spp a pixel, with the "
        f"same footprints (default: {_DEFAULT.samples})",
    ),
    Argument(
        "--reference-spp", type=positive, metavar="N",
        help="samples a pixel of the references; those of held-out views have a quarter (default: "
        f"{_DEFAULT.reference_spp})",
    ),
    Argument(
        "--bound", type=positive_or_none, metavar="X",
        help=f"error of a pixel beyond which its derivative grows no further, or none (default: {_DEFAULT.bound:g})",
    ),
    Argument(
        "--exposure", type=positive_or_none, metavar="X", help="factor that maps white to 1 (default: estimated)"
    ),
    Argument("--begin", choices=STARTS, help="start with the arrays of the file, or untrained (default: file)"),
    Argument(
        "-D", dest="defines", action="append", type=define, metavar="NAME=VALUE", help="set a <default> of the scene"
    ),
    Argument(
        "--start", action="append", file="read", metavar="FILE.npz",
        help="arrays to start from, of the same maps, such as those of fit texture; may be repeated, once for each "
        "texture (default: the scene's files)",
    ),
    Argument(
        "--texture", action="append", file="read", metavar="FILE.npz",
        help="file of a trained texture, may be repeated (default: all that the scene reads); several are trained "
        "together, and -o names a folder, in which each keeps its name",
    ),
    Argument("--references", metavar="FOLDER", help="folder that keeps the references for later runs"),
    PREVIEW,
)  # fmt: skip


def views_from(options: Mapping, seed: int = 0) -> ViewDistribution:
    """Return the distribution of the given options. Raises :class:`.UsageError`."""
    names = {f.name: f.name for f in dataclasses.fields(ViewDistribution) if f.name != "seed"} | {"count": "views"}
    given = {field: options[name] for field, name in names.items() if options.get(name) is not None}
    return ViewDistribution(**given, seed=seed)


def recipe_from(options: Mapping, settings: FitSettings) -> SceneRecipe:
    """Return the recipe of the given options. Raises :class:`.UsageError`."""
    names = {n: n for n in ("share", "spp", "samples", "reference_spp", "bound", "exposure")} | {"start": "begin"}
    given = {field: options[name] for field, name in names.items() if options.get(name) is not None}
    if given.get("bound") == math.inf:
        given["bound"] = None
    return SceneRecipe(**given, settings=settings)
