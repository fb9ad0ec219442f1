"""Arguments of ``fit scene``, and the views and the recipe that they ask for."""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping

from ..arguments import Argument, define, positive, positive_or_none
from .recipe import STARTS, SceneRecipe, ViewDistribution


def _numbers(text: str, count: int, separator: str, form: str) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in text.split(separator))
    except ValueError:
        found = ()
    if len(found) != count or not all(map(math.isfinite, found)):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected {form}")
    return found


def span(text: str) -> tuple[float, float]:
    """A range, ``LOW:HIGH``, or one number. Raises ``ArgumentTypeError``."""
    return _numbers(text if ":" in text else f"{text}:{text}", 2, ":", "LOW:HIGH, as in 10:60")


def point(text: str) -> tuple[float, float, float]:
    """``X,Y,Z``. Raises ``ArgumentTypeError``."""
    return _numbers(text, 3, ",", "X,Y,Z, as in 0,1.5,-2")


def box(text: str) -> tuple:
    """Two corners, ``X,Y,Z:X,Y,Z``. Raises ``ArgumentTypeError``."""
    corners = text.split(":")
    if len(corners) != 2:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected two corners, X,Y,Z:X,Y,Z")
    return tuple(map(point, corners))


_OWN = SceneRecipe()
_NEGATIVE = "if the first number is negative, write --azimuth=-30:30"

#: Of these, what is not given is as in the scene.
VIEWS = (
    Argument("--views", type=positive, metavar="N", help="views that are trained on (default: 16)"),
    Argument("--held-out", type=positive, metavar="N", help="other views, which are measured (default: 4)"),
    Argument(
        "--azimuth", type=span, metavar="A:B", help=f"degrees that the camera is turned about the target ({_NEGATIVE})"
    ),
    Argument("--elevation", type=span, metavar="A:B", help="degrees of the camera above the target"),
    Argument("--distance", type=span, metavar="A:B", help="distance of the camera from the target"),
    Argument("--origins", type=box, metavar="X,Y,Z:X,Y,Z", help="in place of these: corners of a box for the camera"),
    Argument("--target", type=point, metavar="X,Y,Z", help="what the camera looks at (default: the image's middle)"),
    Argument("--up", type=point, metavar="X,Y,Z", help="the vertical of all angles (default: 0,1,0)"),
    Argument("--light-azimuth", type=span, metavar="A:B", help="degrees that lights and environments are turned by"),
    Argument("--light-elevation", type=span, metavar="A:B", help="degrees of directional, point and spot lights"),
)

RECIPE = (
    Argument("--spp", type=positive, metavar="N", help="samples a pixel that the result is for (default: 1)"),
    Argument(
        "--reference-spp", type=positive, metavar="N",
        help=f"samples a pixel of the references (default: {_OWN.reference_spp})",
    ),
    Argument(
        "--bound", type=positive_or_none, metavar="X",
        help=f"error of a pixel from which on it pulls no stronger, or none (default: {_OWN.bound:g})",
    ),
    Argument(
        "--exposure", type=positive_or_none, metavar="X", help="factor that maps white to 1 (default: estimated)"
    ),
    Argument("--begin", choices=STARTS, help="with the arrays as they are in the file, or untrained (default: file)"),
)  # fmt: skip

FILES = (
    Argument(
        "-D", dest="defines", action="append", type=define, metavar="NAME=VALUE", help="set a <default> of the scene"
    ),
    Argument("--texture", metavar="FILE.npz", help="which file of the scene's textures (default: the only one)"),
    Argument("--references", metavar="FOLDER", help="keep the references there, to go on with"),
    Argument("--preview", metavar="FILE.png", help="write reference | render | 4x their difference at measurements"),
)

#: All of them; the share and what the scene's defaults are come from elsewhere.
SCENE_ARGUMENTS = (*VIEWS, *RECIPE, *FILES)


def views_of(options: Mapping, seed: int = 0) -> ViewDistribution:
    """The views that options ask for. Raises :class:`~mi_diffind.errors.UsageError`."""
    names = {
        "views": "count",
        **{f.name: f.name for f in dataclasses.fields(ViewDistribution) if f.name not in ("count", "seed")},
    }
    given = {names[k]: options[k] for k in names if options.get(k) is not None}
    return ViewDistribution(**given, seed=seed)


def recipe_of(options: Mapping, settings) -> SceneRecipe:
    """The recipe that options ask for. Raises :class:`~mi_diffind.errors.UsageError`."""
    names = {"begin": "start", **{n: n for n in ("share", "spp", "reference_spp", "bound", "exposure")}}
    given = {names[k]: options[k] for k in names if options.get(k) is not None}
    if given.get("bound") == math.inf:
        given["bound"] = None
    return SceneRecipe(**given, settings=settings)
