"""A scene whose texture is trained: its arrays as parameters, and renders that are differentiable by them."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

import mitsuba as mi

from .. import compat, plugins, scenes
from ..errors import UsageError
from ..plugins.support import footprint
from ..tables import Table, save_table
from .recipe import View, ViewDistribution
from .references import colours
from .rig import Rig

#: The plugin whose arrays are trained.
PLUGIN = "neural_texture"


def texture_file(path: str | os.PathLike, file: str | os.PathLike | None = None, defines=None) -> tuple[Path, str]:
    """
    The file of the scene's textures that is trained, and the ``source`` that the scene gives for it (""): ``file``, or
    the only one that there is. Raises :class:`~mi_diffind.errors.UsageError` and
    :class:`~mi_diffind.scenes.SceneError`.
    """
    folder, found = Path(path).resolve().parent, {}
    for entry in scenes.learned_plugins(path, defines):
        if entry["plugin"] == PLUGIN and entry.get("filename"):
            source = entry.get("source", "")
            found.setdefault((folder / entry["filename"]).resolve(), str(folder / source) if source else "")
    names = ", ".join(f.name for f in found) or "none"
    if file is None:
        if len(found) != 1:
            raise UsageError(f"{path}: names {len(found)} files of {PLUGIN} ({names}): say which one is to be trained")
        return next(iter(found.items()))
    wanted = Path(file).resolve()
    if wanted not in found:
        raise UsageError(f"{path}: no {PLUGIN} reads {file}, the files are {names}")
    return wanted, found[wanted]


class TrainedScene:
    """
    The scene of a file in which the textures that read ``file`` read the arrays of ``table`` instead, which can be set.

    All maps of a file read the same arrays, whose parameters have a name for each map; one name of each array is set,
    which sets it for all. Renders are those of the integrator ``prb`` in place of ``path``, the same estimator: paths
    are sampled *detached*, without derivatives of what decides on them, and what is evaluated along them is
    differentiated. That is right on average since neither visible surfaces nor samples' places depend on a texture's
    values: a lobe's sampling does, but the density divides it out. Footprints are those of ``spp`` samples a pixel.
    """

    def __init__(self, path, file: Path, views: ViewDistribution, spp: int, table: Table, defines=None):
        folder = Path(path).resolve().parent
        with tempfile.TemporaryDirectory() as temporary:
            # A name of its own, so that no other scene reads the same arrays
            own = Path(temporary).resolve() / file.name
            save_table(own, table)

            def change(state):
                for props in compat.properties_of(state):
                    name = props.plugin_name()
                    if name == PLUGIN and (folder / str(props.get("filename", ""))).resolve() == file:
                        props["filename"], props["storage"] = str(own), "float32"
                    elif name == "path":
                        props["max_depth"] = props.get("max_depth", scenes.MAX_DEPTHS[name])
                        props.set_plugin_name("prb")

            self.scene = scenes.load(path, defines=defines, change=change)
        self.spp, self.rig, self._cones = spp, Rig(self.scene, views), {}
        self._seeing = footprint.textures(self.scene)
        #: Array → the parameter of the scene that is set for it.
        self.keys = self._parameters(own)
        self.parameters = mi.traverse(self.scene)
        self.parameters.keep([re.escape(key) + "$" for key in self.keys.values()])

    def _parameters(self, own: Path) -> dict[str, str]:
        made = [m for m in scenes.instances(self.scene) if plugins.origin(m)["plugin"] == PLUGIN]
        reading = [m for m in made if Path(plugins.origin(m)["filename"]).resolve() == own and m.net is not None]
        if not reading:
            raise UsageError(f"{own.name}: holds no arrays that could be trained, or no surface of the scene reads it")
        parameters, arrays = mi.traverse(self.scene), reading[0].net.arrays
        for array in arrays.values():
            array.folded = False  # what it will hold is folded already: half of the kernel would be that
        known = {compat.identity(array.data): name for name, array in arrays.items()}
        found = {}
        for key in parameters.keys():
            if ".tables." in key:
                found.setdefault(known.get(compat.identity(parameters[key])), key)
        return {name: found[name] for name in arrays}

    def hold(self, net) -> None:
        """
        Let the scene's texture read the entries of the arrays of ``net``, which are folded already; differentiable.
        """
        for name, array in net.arrays.items():
            self.parameters[self.keys[name]] = array.data
        self.parameters.update()

    def place(self, view: View) -> None:
        """Move camera and lights, and footprints with them."""
        self.rig.place(view)
        if view not in self._cones:
            footprint.attach(self.scene, 0, self.spp)
            self._cones[view] = [texture.cone for texture in self._seeing]
        for texture, cone in zip(self._seeing, self._cones[view], strict=True):
            texture.set_cone(cone)

    def render(self, seed, seed_grad, spp: int | None = None):
        """
        The image from where the camera is, a tensor that is differentiable by the arrays. Values come from the samples
        of ``seed``, derivatives from those of ``seed_grad``: a loss's derivative by the image is then independent of
        the image's by the arrays, and their product right on average for squared errors.
        """
        return colours(
            mi.render(
                self.scene, self.parameters, spp=spp or self.spp, spp_grad=self.spp, seed=seed, seed_grad=seed_grad
            )
        )
