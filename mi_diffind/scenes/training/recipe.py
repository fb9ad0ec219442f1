"""Recipe of a training inside a scene: settings, and the arguments of ``fit scene``. Free of Mitsuba."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

from ...core.arguments import Argument, define, positive, positive_or_none
from ...core.errors import UsageError
from ...fitting.settings import FitSettings
from ...maps.arguments import PREVIEW
from .views import VIEW_ARGUMENTS

#: Starting points of the arrays: those of the file, or those of an untrained texture.
STARTS = ("file", "untrained")

#: Steps of a training without a time limit.
STEPS = 400


@dataclass(frozen=True)
class SceneRecipe:
    """Recipe of a training inside a scene.

    ``share``: λ, the share of the loss of rendered images; the rest is the loss of the texture. ``spp``: samples a
    pixel of the trained renders, at least 1, and of their footprints: choose the number with which the result will
    be rendered. ``samples``: smallest number of samples of a trained render; a small film gets more than ``spp`` a
    pixel, with the footprints of ``spp``, since a step takes little longer and its gradient has less noise.
    ``bound``: limit of an error, in units of ``exposure``, beyond which its derivative grows no further (``None``:
    unlimited). ``reference_spp``: samples a pixel of a reference. ``against``: counterpart of learned plugins in
    references, ``"exact"`` or the name of another one. ``exposure``: factor of all radiance that maps white to 1
    (``None``: maps the value that 5% of the references' pixels exceed). ``start``: one of :data:`STARTS`.
    ``settings``: the rest; its ``loss`` is that of images, its ``batch`` the texture samples of a step.

    Only ``"mse"`` without a bound has gradients that are right on average at few samples; ``"mae"``, and squared errors
    beyond the bound, follow the median of noisy pixels rather than their mean.
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
            steps=STEPS, batch=2**16, lr=3e-3, schedule="cosine", loss="mse", measure_every=STEPS // 10
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


_DEFAULT = SceneRecipe()

#: Arguments of the recipe.
RECIPE_ARGUMENTS = (
    Argument("--spp", type=positive, metavar="N", help="samples a pixel of renders with the result (default: 1)"),
    Argument(
        "--samples", type=positive, metavar="N",
        help="smallest number of samples of a trained render: a small film gets more than --spp a pixel, with the "
        f"footprints of --spp (default: {_DEFAULT.samples})",
    ),
    Argument(
        "--reference-spp", type=positive, metavar="N",
        help=f"samples a pixel of the references (default: {_DEFAULT.reference_spp})",
    ),
    Argument(
        "--bound", type=positive_or_none, metavar="X",
        help=f"error of a pixel beyond which its derivative grows no further, or none (default: {_DEFAULT.bound:g})",
    ),
    Argument(
        "--exposure", type=positive_or_none, metavar="X", help="factor that maps white to 1 (default: estimated)"
    ),
    Argument("--begin", choices=STARTS, help="start with the arrays of the file, or untrained (default: file)"),
)  # fmt: skip

FILE_ARGUMENTS = (
    Argument(
        "-D", dest="defines", action="append", type=define, metavar="NAME=VALUE", help="set a <default> of the scene"
    ),
    Argument(
        "--start", action="append", file="read", metavar="FILE.npz",
        help="arrays to start from, of the same maps, such as those of fit shading; may be repeated, once for each "
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

#: All arguments of ``fit scene`` but the scene and the share.
SCENE_ARGUMENTS = (*VIEW_ARGUMENTS, *RECIPE_ARGUMENTS, *FILE_ARGUMENTS)


def recipe_of(options: Mapping, settings) -> SceneRecipe:
    """Return the recipe of the given options. Raises :class:`.UsageError`."""
    names = {"begin": "start", **{n: n for n in ("share", "spp", "samples", "reference_spp", "bound", "exposure")}}
    given = {names[k]: options[k] for k in names if options.get(k) is not None}
    if given.get("bound") == math.inf:
        given["bound"] = None
    return SceneRecipe(**given, settings=settings)
