"""Task 5 inside a scene: arrays of textures or materials, trained through renders of the scene that shows them.

References are renders of the same scene with exact plugins and many samples. The result is a table file of the task
``texture``. This package stands above plugins and scenes, which it renders; training for shaded values without a scene
is :mod:`mi_diffind.tasks.texture.shading`.
"""

import os
from pathlib import Path

from ...core.arguments import WORKER_ARGUMENTS, Argument, fraction
from ...core.errors import UsageError
from ...fitting.task import FitRequest, Fitted, Task, table_path
from .options import SCENE_ARGUMENTS, SceneRecipe


class SceneTraining(Task):
    """Task ``scene``; its files are those of the task ``texture``."""

    name = "scene"
    title = "textures, through renders of a scene that shows them"
    section = "supplemental 1.5"
    example = "scene.xml"
    presets = {"ours": SceneRecipe().settings}  # noqa: RUF012
    storages = ()
    measurements = 4
    arguments = (
        Argument(
            "source", file="read", metavar="SCENE.xml",
            help="a scene with neural_textures or neural_materials, whose arrays are trained",
        ),
        Argument(
            "--lambda", dest="share", type=fraction, metavar="L",
            help=f"share of the loss of rendered images, 0 to 1 (default: {SceneRecipe().share:g})",
        ),
        *SCENE_ARGUMENTS,
        *WORKER_ARGUMENTS,
    )  # fmt: skip

    def check(self, request: FitRequest) -> None:
        source = request.options["source"]
        if isinstance(source, (str, os.PathLike, type(None))) and not str(source).lower().endswith(".xml"):
            raise UsageError(f"source: found {source}, a scene file (.xml) is needed; fit texture trains maps")

    def output_path(self, path: str | os.PathLike) -> Path:
        """Return the path of the output: a table file, or a folder for several, which exists or has no extension."""
        is_folder = Path(path).is_dir() or not Path(path).suffix
        return Path(path).absolute() if is_folder else table_path(path)

    def fit(self, request: FitRequest) -> Fitted:
        """Train textures of a scene, in the active variant, or in the one of ``request.types`` if none is set."""
        import mitsuba as mi

        if mi.variant() is None:
            mi.set_variant("cuda_ad_rgb" if ".cuda." in request.types.__name__ else "llvm_ad_rgb")
        return super().fit(request)


TASK = SceneTraining()
