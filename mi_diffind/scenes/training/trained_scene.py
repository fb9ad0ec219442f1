"""Scene whose textures are trained: arrays as parameters of the scene, and renders that are differentiable by them."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi

from ... import plugins
from ...arrays.tables import Table, save_table
from ...core import compat
from ...core.errors import UsageError
from ...plugins.support import footprint
from .. import loading
from .joint_problem import array_name
from .rig import Rig
from .stored_texture import PLUGINS
from .views import View, ViewDistribution


class TrainedScene:
    """Loaded scene in which textures of the files in ``tables`` read the arrays of these, which can be replaced.

    All maps of a file read the same arrays. Each array has one parameter for each map; setting one of them sets the
    array for all maps. Arrays of several files are called by :func:`.joint_problem.array_name`. Renders use the
    integrator ``prb`` in place of ``path``, the same estimator: paths are sampled *detached*, without derivatives of
    the sampling decisions, and the values along them are differentiated. The gradient is right on average, since
    neither visible surfaces nor the places of samples depend on a texture's values; the choice of a lobe does, but the
    density divides it out. Footprints are those of ``spp`` samples a pixel.
    """

    def __init__(self, parsed: loading.ParsedScene, tables: Mapping[Path, Table], views: ViewDistribution, spp: int):
        folder = parsed.path.resolve().parent
        with tempfile.TemporaryDirectory() as temporary:
            # Files in another folder, so that no other scene reads the same arrays
            copies = {file: Path(temporary).resolve() / file.name for file in tables}
            for file, table in tables.items():
                save_table(copies[file], table)

            def change(state):
                for props in compat.properties_of(state):
                    name = props.plugin_name()
                    file = (folder / str(props.get("filename", ""))).resolve() if name in PLUGINS else None
                    if file in copies:
                        props["filename"], props["storage"] = str(copies[file]), "float32"
                    elif name == "path":
                        props["max_depth"] = props.get("max_depth", loading.MAX_DEPTHS[name])
                        props.set_plugin_name("prb")

            self.scene = parsed.load(change=change, parallel=False)
        self.spp, self.rig, self._cones = spp, Rig(self.scene, views), {}
        self._seeing = footprint.textures(self.scene)
        #: Name of each array → the parameter of the scene that is set for it.
        self.keys = {}
        for copy in copies.values():
            keys = self._parameters(copy)
            self.keys |= {array_name(copy.name, n): k for n, k in keys.items()} if len(copies) > 1 else keys
        self.parameters = mi.traverse(self.scene)
        self.parameters.keep([re.escape(key) + "$" for key in self.keys.values()])

    def _parameters(self, file: Path) -> dict[str, str]:
        """Return the parameters that stand for the arrays of a file, by name of the array."""
        textures = [t for t in loading.instances(self.scene) if plugins.origin(t)["plugin"] in PLUGINS]
        reading = [t for t in textures if Path(plugins.origin(t)["filename"]).resolve() == file and t.net is not None]
        if not reading:
            raise UsageError(f"{file.name}: holds no arrays that could be trained, or no surface of the scene reads it")
        parameters, arrays = mi.traverse(self.scene), reading[0].net.arrays
        for array in arrays.values():
            array.folded = False  # its entries will be folded already, and folding again would be half of the kernel
        names = {compat.identity(array.data): name for name, array in arrays.items()}
        keys = {}
        for key in parameters.keys():
            if ".tables." in key:
                keys.setdefault(names.get(compat.identity(parameters[key])), key)
        return {name: keys[name] for name in arrays}

    def hold(self, net) -> None:
        """Let the scene's textures read the folded arrays of ``net``, differentiably."""
        for name, array in net.arrays.items():
            self.parameters[self.keys[name]] = array.data
        self.parameters.update()

    def place(self, view: View) -> None:
        """Move camera and lights to a view, and update the footprints."""
        self.rig.place(view)
        if view not in self._cones:
            footprint.attach(self.scene, 0, self.spp)
            self._cones[view] = [texture.cone for texture in self._seeing]
        for texture, cone in zip(self._seeing, self._cones[view], strict=True):
            texture.set_cone(cone)

    def render(self, seed, seed_grad, spp: int | None = None):
        """Return the image of the current view, a tensor that is differentiable by the arrays.

        Values come from the samples of ``seed``, derivatives from those of ``seed_grad``: the derivative of the loss by
        the image is then independent of the derivative of the image by the arrays, and their product is right on
        average for squared errors. ``spp`` (``None``: the scene's) changes no footprints.
        """
        spp = spp or self.spp
        image = mi.render(self.scene, self.parameters, spp=spp, spp_grad=spp, seed=seed, seed_grad=seed_grad)
        return loading.colour_channels(image)
