"""
Task 5 inside a scene: the arrays of a ``neural_texture`` trained by differentiating renders of the scene that shows it.

The reference is the same scene with exact plugins, rendered with many samples. The result is a table file of the task
``texture``. This package stands above plugins and scenes, which it renders; :mod:`mi_diffind.tasks.shading` trains for
shaded values without a scene.

- :mod:`.recipe`, :mod:`.arguments`: settings, and the arguments of ``fit scene``;
- :mod:`.rig`: camera and lights of a view; :mod:`.references`: renders with exact plugins;
- :mod:`.texture`: the scene with the arrays as parameters; :mod:`.problem`: the loss; :mod:`.fit`: the training.
"""

from __future__ import annotations

import dataclasses

from ..arguments import Argument, fraction
from ..errors import UsageError
from ..task import FitRequest, Fitted, Task
from .arguments import SCENE_ARGUMENTS, recipe_of, views_of
from .recipe import SceneRecipe


class SceneTraining(Task):
    """The task ``scene``. Its files are those of the task ``texture``."""

    name = "scene"
    title = "a texture, through renders of a scene that shows it"
    section = "supplemental 1.5"
    presets = {"ours": SceneRecipe().settings}  # noqa: RUF012
    storages = ()
    arguments = (
        Argument("source", metavar="SCENE.xml", help="a scene with a neural_texture, whose arrays are trained"),
        Argument(
            "--lambda", dest="share", type=fraction, metavar="L",
            help=f"share of the loss of rendered images, 0 to 1 (default: {SceneRecipe().share:g})",
        ),
        *SCENE_ARGUMENTS,
    )  # fmt: skip

    def settings(self, preset, given, options):
        own = self.presets[preset]
        steps = given.get("steps", own.steps)
        return dataclasses.replace(own, measure_every=max(1, steps // 10), **given)

    def check(self, request: FitRequest) -> None:
        source = request.options["source"]
        if not str(source).lower().endswith(".xml"):
            raise UsageError(f"source: found {source}, a scene file (.xml) is needed; fit shading trains maps")

    def fit(self, request: FitRequest) -> Fitted:
        """Train a texture of a scene, in the active variant, or in the one of ``request.types`` if none is set."""
        import mitsuba as mi

        if mi.variant() is None:
            mi.set_variant("cuda_ad_rgb" if ".cuda." in request.types.__name__ else "llvm_ad_rgb")
        from ..tasks.shading.fit import preview_of
        from .fit import fit_scene

        options = request.options
        views, recipe = views_of(options, request.settings.seed), recipe_of(options, request.settings)
        table, result = fit_scene(
            options["source"], views, recipe, request, options["texture"], options["references"], preview_of(request),
            dict(options["defines"] or ()),
        )  # fmt: skip
        figures = {
            "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
            "bits": {name: a.bits for name, a in table.arrays.items()},
            "views": dataclasses.asdict(views),
        }
        return Fitted(table, result, [f"{views.count} views, {recipe.spp} samples a pixel"], figures)


TASK = SceneTraining()
