"""Scene whose textures are trained: their files and problems, and their arrays as parameters of its renders."""

from __future__ import annotations

import dataclasses
import os
import re
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import mitsuba as mi
from drjit import nn

from ... import plugins
from ...arrays.indirection import DifferentiableArray
from ...arrays.tables import PAGES, Table, TableError, save_table
from ...core import compat
from ...core.errors import UsageError
from ...fitting.loop import Problem
from ...maps.entries import split_material
from ...maps.layout import Layout
from ...maps.pyramid import Pyramid
from ...maps.source import load_source
from ...plugins.support import footprint
from ...tasks.texture import PRESETS, TextureSettings
from ...tasks.texture.arrays import FineArray, PaperBudget, TextureBudget
from ...tasks.texture.compressed import (
    CompressedTexture,
    PaperStructure,
    load,
    read_level_bias,
    read_structure,
    to_table,
)
from ...tasks.texture.training import TextureProblem, build_problem, stored_form
from .. import loading
from .options import View, ViewDistribution
from .rig import Rig


class JointNet(nn.Module):
    """Arrays of several textures; ``names`` are those of the textures, ``nets`` read their arrays.

    Each array is called ``TEXTURE/ARRAY``.
    """

    DRJIT_STRUCT = {"nets": tuple, "names": object}  # noqa: RUF012

    def __init__(self, nets=(), names: tuple[str, ...] = ()):
        self.nets, self.names = tuple(nets), names

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name."""
        pairs = zip(self.names, self.nets, strict=True)
        return {f"{name}/{key}": array for name, net in pairs for key, array in net.arrays.items()}

    def changed(self, change) -> JointNet:
        """Return a copy with ``change(array, bits)`` in place of each array."""
        return JointNet([net.changed(change) for net in self.nets], self.names)


class JointProblem(Problem):
    """Training problem of several textures, by name: the sum of their losses.

    As the maps of one file, each texture has a share of the loss and of the samples: that of its stored channels.
    """

    def __init__(self, problems: Mapping[str, TextureProblem]):
        self.problems = list(problems.values())
        self.net = JointNet([problem.net for problem in self.problems], tuple(problems))
        channels = [problem.pyramid.layout.stored for problem in self.problems]
        self.shares = [count / sum(channels) for count in channels]
        identities = {name: problem.identity for name, problem in problems.items()}
        self.identity = {"source": [i["source"] for i in identities.values()], "textures": identities}

    def begin(self, step: int, share: float) -> str:
        """Start a step of each texture."""
        return ", ".join(problem.begin(step, share) for problem in self.problems)

    def loss(self, net: JointNet, rng, size: int) -> list:
        """Return the losses of all textures, each with its share of ``size`` samples."""
        parts = zip(self.problems, self.shares, net.nets, strict=True)
        return [
            share * values
            for problem, share, part in parts
            for values in problem.loss(part, rng, max(1, round(share * size)))
        ]

    def seen(self, net: JointNet) -> JointNet:
        """Return the folded arrays as training reads them (:meth:`.TextureProblem.seen`)."""
        pairs = zip(self.problems, net.nets, strict=True)
        return JointNet([problem.seen(part) for problem, part in pairs], net.names)

    def measure(self, net: JointNet) -> dict[str, float]:
        """Return the figures of each texture (:meth:`.TextureProblem.measure`), their names behind its own."""
        parts = zip(net.names, self.problems, net.nets, strict=True)
        return {f"{name}_{key}": v for name, problem, part in parts for key, v in problem.measure(part).items()}


#: Plugins whose arrays are trained.
PLUGINS = ("neural_texture", "neural_material")


def texture_files(parsed: loading.ParsedScene, files: Sequence[str | os.PathLike] = ()) -> dict[Path, str]:
    """Return the files of trained textures, each with the ``source`` that the scene gives for it ("": none).

    They are the ``files``, by default all that textures of the scene read. Raises
    :class:`.UsageError` and :class:`.SceneError`.
    """
    folder, sources = parsed.path.resolve().parent, {}
    for entry in parsed.learned_plugins():
        if entry["plugin"] in PLUGINS and entry.get("filename"):
            source = entry.get("source", "")
            sources.setdefault((folder / entry["filename"]).resolve(), str(folder / source) if source else "")
    names, readers = ", ".join(f.name for f in sources) or "none", " or ".join(PLUGINS)
    if not sources:
        raise UsageError(f"{parsed.path}: names no file of {readers}, whose arrays could be trained")
    for file in files:
        if Path(file).resolve() not in sources:
            raise UsageError(f"{parsed.path}: no {readers} reads {file}, the files are {names}")
    wanted = {Path(file).resolve(): sources[Path(file).resolve()] for file in files} or sources
    if len({file.name for file in wanted}) < len(wanted):
        raise UsageError(f"{parsed.path}: two of its textures have the same name ({names}): train one by --texture")
    return wanted


def texture_file(parsed: loading.ParsedScene) -> tuple[Path, str]:
    """Return the only file of :func:`texture_files`, and its source. Raises as it does, also if there are several."""
    files = texture_files(parsed)
    if len(files) > 1:
        raise UsageError(
            f"{parsed.path}: names {len(files)} textures ({', '.join(f.name for f in files)}), one is needed"
        )
    return next(iter(files.items()))


def find_source(table: Table, file: Path, given: str = "") -> Path:
    """Return the image or manifest of a texture, recorded or ``given``. Raises :class:`TableError`."""
    recorded = str(table.settings.get("source_path", ""))
    if not given and not recorded:
        raise TableError(f'{file}: does not record its source; the parameter "source" of the texture may name it')
    original = Path(given) if given else file.parent / recorded
    if not split_material(original)[0].exists():
        raise TableError(f"{original}: no such file, {file.name} was made from it")
    return original.resolve()


class SceneTexture:
    """Texture of a scene: its ``file``, the ``table`` that the training starts from, its source, and its ``problem``.

    ``given``: source that the scene gives for it, if any. ``start``: another table of the same maps to start from.
    Without a ``trained`` start, the arrays are those of an untrained texture.
    """

    def __init__(self, file: Path, table: Table, given: str = "", start: Table | None = None, trained: bool = True):
        self.file, self.table = file, start or table
        self.source_path = find_source(table, file, given)
        self.source = load_source(self.source_path, nonfinite="clean")
        layout, recipe = Layout.from_json(self.table.settings["layout"]), texture_recipe(self.table)
        if not layout.stored:
            raise UsageError(f"{self.table.path}: holds a texture of one colour, without arrays to train")
        texture = CompressedTexture.from_table(self.table, mi.TensorXf, "float32")
        pyramid = Pyramid.from_source(self.source, layout, compat.backend_module(mi.TensorXf), texture.border)
        if trained:
            self.problem = TextureProblem(texture.net, pyramid, recipe, self.source.digest)
        else:
            self.problem = build_problem(self.source, texture_budget(self.table), recipe, pyramid)
        self.problem.settings, self.level_bias = recipe, read_level_bias(self.table.settings)
        if not trained:
            self.table = self.to_table({})

    def to_table(self, settings: Mapping) -> Table:
        """Return the table of the arrays in their state, with ``settings``."""
        texture = CompressedTexture(self.problem.pyramid.layout, stored_form(self.problem.net), self.level_bias)
        return to_table(texture, dict(settings))

    def measure(self, table: Table) -> dict[str, float]:
        """Return the errors of a table against the source (:meth:`.CompressedTexture.measure`)."""
        return CompressedTexture.from_table(table, mi.TensorXf).measure(self.source)

    @property
    def identity(self) -> dict:
        """Settings of the texture's own training, as a table file keeps them."""
        return {k: v for k, v in self.problem.identity.items() if k not in ("structure", "border")}


def load_textures(
    parsed: loading.ParsedScene,
    files: Sequence[str | os.PathLike] = (),
    starts: Sequence[str | os.PathLike] = (),
    trained: bool = True,
) -> list[SceneTexture]:
    """Return the textures of a scene that are trained: of the ``files``, by default of all that hold arrays.

    ``starts`` are files to start from; each belongs to the texture that has its maps and its source. Raises
    :class:`.UsageError`, :class:`.TableError` and :class:`~mi_diffind.maps.source.SourceError`.
    """
    given = texture_files(parsed, files)
    tables = {file: load(file) for file in given}
    if not files:
        tables = {file: table for file, table in tables.items() if table.arrays} or tables
    begin = {}
    for start in starts:
        other = load(start)
        same = [
            file for file, table in tables.items()
            if all(other.settings.get(key) == table.settings.get(key) for key in ("layout", "source"))
        ]  # fmt: skip
        if not same:
            names = " or ".join(file.name for file in tables)
            raise UsageError(f"--start: {start} holds other maps, or is of another source, than {names}")
        if len(same) > 1 or same[0] in begin:
            raise UsageError(f"--start: {start} is not the only one for {same[0].name}, or belongs to several textures")
        begin[same[0]] = other
    return [SceneTexture(file, table, given[file], begin.get(file), trained) for file, table in tables.items()]


def texture_recipe(table: Table) -> TextureSettings:
    """Return the recipe by which the arrays of a file were trained as a texture."""
    preset = PRESETS["ours" if table.settings.get("layered", True) else "paper"]
    return dataclasses.replace(preset, **{n: table.settings[n] for n in preset.further if n in table.settings})


def texture_budget(table: Table) -> TextureBudget | PaperBudget:
    """Return the memory budget that the arrays of a texture were made for."""
    layout = Layout.from_json(table.settings["layout"])
    structure, _ = read_structure(table.settings, layout)
    shapes = {name: array.shape for name, array in table.arrays.items()}
    if isinstance(structure, PaperStructure):
        rows, columns, _ = shapes["primary0"]
        return PaperBudget(rows, columns, shapes["cascaded"][0], shapes["cascaded"][1], layout.stored)
    paged = [layer for layer in structure.layers if layer.paged]
    fine = tuple(FineArray(x.level, x.channels, x.bits) for x in structure.layers if not x.paged)
    dims, axes = shapes["coarse"][-1], len(shapes["cascaded"]) - 1
    sides = tuple(shapes["cascaded"][axes - dims : axes])
    names = [f"level{x.level}" for x in paged]
    nbytes = sum(table.arrays[name].nbytes + table.arrays[name + PAGES].nbytes for name in names)
    return TextureBudget(
        layout.height, layout.width, layout.stored, fine, structure.skip, dims, sides,
        structure.skip + 1 if axes > dims else 1, structure.bits, tuple(x.level for x in paged), nbytes,
        paged[0].bits if paged else 5,
    )  # fmt: skip


class TrainedScene:
    """Loaded scene in which textures of the files in ``tables`` read the arrays of these, which can be replaced.

    All maps of a file read the same arrays, each of which is one parameter. Arrays of several files are called as in
    :class:`JointNet`. Renders use the integrator ``prb`` in place of ``path``, the same estimator: paths are sampled
    *detached*, without derivatives of the sampling decisions, and the values along them are differentiated. The
    gradient is right on average, since neither visible surfaces nor the places of samples depend on a texture's values;
    the choice of a lobe does, but the density divides it out.
    """

    def __init__(self, parsed: loading.ParsedScene, tables: Mapping[Path, Table], views: ViewDistribution):
        folder = parsed.path.resolve().parent
        with tempfile.TemporaryDirectory() as temporary:
            # Files in another folder, so that no other scene reads the same arrays
            copies = {file: Path(temporary).resolve() / file.name for file in tables}
            for file, table in tables.items():
                untrained = {name: value for name, value in table.settings.items() if name != "shading"}
                save_table(copies[file], dataclasses.replace(table, settings=untrained))  # any samples are right

            def change(state):
                for props in compat.parsed_properties(state):
                    name = props.plugin_name()
                    file = (folder / str(props.get("filename", ""))).resolve() if name in PLUGINS else None
                    if file in copies:
                        props["filename"], props["storage"] = str(copies[file]), "float32"
                    elif name == "path":
                        props["max_depth"] = props.get("max_depth", loading.MAX_DEPTHS[name])
                        props.set_plugin_name("prb")

            changed = parsed.copy()
            changed.change(change)
            self.scene = changed.load(parallel=False)
        self.rig, self._cones = Rig(self.scene, views), {}
        self._seeing = footprint.textures(self.scene)
        #: Name of each array → the parameter of the scene that is set for it.
        self.keys = {}
        for copy in copies.values():
            keys = self._parameters(copy)
            self.keys |= {f"{copy.name}/{n}": k for n, k in keys.items()} if len(copies) > 1 else keys
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

    def place(self, view: View, spp: int) -> None:
        """Move camera and lights to a view, and set the footprints of ``spp`` samples a pixel.

        As in renders, a texture reads the only sample of a pixel at the pixel's centre, and several where they are.
        """
        self.rig.place(view)
        if (view, spp) not in self._cones:
            footprint.attach(self.scene, 0, spp)
            self._cones[view, spp] = [texture.cone for texture in self._seeing]
        for texture, cone in zip(self._seeing, self._cones[view, spp], strict=True):
            texture.set_cone(cone)

    def render(self, seed, seed_grad, spp: int):
        """Return the image of the current view, a tensor that is differentiable by the arrays.

        Values come from the samples of ``seed``, derivatives from those of ``seed_grad`` (:mod:`.problem` says why).
        ``spp`` changes no footprints.
        """
        image = mi.render(self.scene, self.parameters, spp=spp, spp_grad=spp, seed=seed, seed_grad=seed_grad)
        return loading.colour_channels(image)
