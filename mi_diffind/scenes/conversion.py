"""Conversion of scenes: learned plugins in place of stock ones, fitted where they need a table file; saved tables.

Plugins declare which plugins of Mitsuba they can stand for (:class:`.plugins.Stock`). A fit is kept in a folder under
a name that contains a digest of the source, its place and the options, and is not repeated.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import plugins
from ..arrays.tables import Table, move_paths, save_table
from ..core import compat
from ..core.errors import DiffindError, UsageError
from ..core.files import cache_folder, check_scene_file, relative_path, replacing, writable_file, writable_folder
from ..core.jobs import run_jobs
from ..core.runtime import use_variant
from ..fitting.task import STORAGES, find_task, fit, table_path, tasks
from ..plugins.support.properties import Kept, StockNode
from .block_test import PICTURE_SAMPLES, PictureCheck, check_picture
from .loading import ParsedScene, SceneError
from .models import is_model, model_scene
from .scene_text import absolute_paths, difference, edit_text

#: Integrator whose estimator those of ``Plugin.seen_by`` share.
TRACER = "path"

#: Parameters of :data:`TRACER` that those of ``Plugin.seen_by`` take.
TRACER_PARAMETERS = ("max_depth", "rr_depth", "hide_emitters")


@dataclass(frozen=True)
class Conversion:
    """Stock plugin of a scene and what became of it.

    ``word``: its group (:class:`.plugins.Stock`); ``name``: its id, that of an object around it, or its place in the
    file; ``stock``: its type; ``learned``: the type that replaces it, "" if it is kept; ``reason``: why, or the table
    file that was fitted to it and its error.
    """

    word: str
    name: str
    stock: str
    learned: str
    reason: str

    def __str__(self) -> str:
        if not self.learned:
            return f'{self.stock} "{self.name}": {self.reason}'
        return f'{self.stock} "{self.name}" → {self.learned}{f", {self.reason}" if self.reason else ""}'


class Conversions(list):
    """List of all :class:`Conversion`, and the ``check`` of the pictures before and after, ``None`` without one.

    ``unchecked`` is the reason why there is none although there should be. ``disk_bytes``, ``memory_bytes`` and
    ``image_bytes`` are those of the scene before and after: of all its files; of meshes, images and tables as loaded;
    of images and tables alone.
    """

    check: PictureCheck | None = None
    unchecked: str = ""
    disk_bytes: tuple[int, int] | None = None
    memory_bytes: tuple[int, int] | None = None
    image_bytes: tuple[int, int] | None = None

    def __str__(self) -> str:
        lines = summary(self) if any(c.learned for c in self) else ["replaced    nothing", *summary(self)]
        for name in ("disk", "memory", "image"):
            pair, label = getattr(self, f"{name}_bytes"), {"image": "  of images"}.get(name, name)
            lines += [f"{label:12}{pair[0]:,} → {pair[1]:,} bytes"] if pair else []
        if self.check and self.check.seconds:
            before, after = self.check.seconds
            lines.append(f"render      {before:.3f} → {after:.3f} s for {PICTURE_SAMPLES} spp of the small picture")
        if self.check or self.unchecked:
            lines.append(f"check       {self.check or self.unchecked}")
        return "\n".join(lines)


def words() -> dict[str, plugins.Plugin]:
    """Return the groups of stock plugins that learned ones can stand for, and the learned plugin of each."""
    return {plugin.stock.word: plugin for plugin in plugins.declared().values() if plugin.stock}


def convert(
    scene: str | os.PathLike,
    output: str | os.PathLike,
    *,
    learn: Sequence[str] | None = None,
    tables: str | os.PathLike | None = None,
    defines: Mapping[str, object] | None = None,
    check: bool = True,
    progress: bool = True,
) -> Conversions:
    """Write a scene with learned plugins in place of Mitsuba's: ``mi-diffind convert`` in Python.

    - ``scene``: a scene file, or a glTF model, which is first written as a scene into ``NEW_model`` beside ``NEW.xml``
      (:func:`.model_scene`); ``output``: the scene file to write (:func:`write_scene`).
    - ``learn``: groups of plugins to replace (:func:`words`; ``None``: those of which a scene gains, textures).
    - ``tables``: folder of the table files (``None``: ``NEW_tables`` beside ``NEW.xml``).
    - ``defines``: values of the file's ``<default>`` parameters.
    - ``check``: render small pictures before and after (:func:`.block_test.check_picture`), if anything was replaced.

    Returns what was replaced and what was kept (:func:`replace_stock`, whose errors are raised, too), and the check.
    """
    output = Path(output)
    if output.suffix.lower() != ".xml":
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .xml')
    if output.resolve() == Path(scene).resolve():
        raise UsageError(f'output "{output}": is the scene itself')
    writable_file(output)
    use_variant()
    folder, model = (output.with_name(f"{output.stem}_{part}") for part in ("tables", "model"))
    folder, is_new = Path(tables or folder), not model.exists()
    groups = [word for word, plugin in words().items() if plugin.stock.advised] if learn is None else learn
    try:
        if is_model(scene):
            check_scene_file(scene)
            scene = model_scene(scene, model)
        parsed = ParsedScene(scene, dict(defines or {}))
        conversions = Conversions(replace_stock(parsed, groups, folder, progress))

        def render(written: ParsedScene) -> None:
            if not check or not any(c.learned for c in conversions):
                return
            sides = ParsedScene(scene, parsed.defines), written
            pair = tuple(side.load(needs=()) for side in sides)
            conversions.disk_bytes = tuple(sum(file.stat().st_size for file in side.files()) for side in sides)
            memory = map(_memory_bytes, sides, pair)
            conversions.memory_bytes, conversions.image_bytes = zip(*memory, strict=True)
            if all(loaded.sensors() and loaded.integrator() for loaded in pair):
                conversions.check = check_picture(*pair)
            else:
                conversions.unchecked = "none: the scene has no sensor or no integrator"

        write_scene(parsed, output, render)
    except DiffindError:
        if is_new:
            shutil.rmtree(model, ignore_errors=True)
        raise
    finally:
        with contextlib.suppress(OSError):  # does not exist, or is not empty
            folder.rmdir()
    return conversions


def _memory_bytes(parsed: ParsedScene, scene) -> tuple[int, int]:
    """Return the bytes of a loaded scene with the tables that it reads, and those of its images and tables alone."""
    arrays = {}
    for key, value in mi.traverse(scene):
        value = value.array if dr.is_tensor_v(value) else value
        if isinstance(value, dr.ArrayBase) and dr.depth_v(value) == 1:
            arrays[compat.identity(value)] = dr.width(value) * dr.itemsize_v(value), key.endswith("data")
    tables = parsed.table_bytes(parsed.learned_plugins())
    images = sum(nbytes for nbytes, is_image in arrays.values() if is_image)
    return sum(nbytes for nbytes, _ in arrays.values()) + tables, images + tables


def replace_stock(
    parsed: ParsedScene, learn: Sequence[str], folder: str | os.PathLike | None = None, progress: bool = True
) -> list[Conversion]:
    """Replace the stock plugins of the groups ``learn`` (:func:`words`) in a parsed scene, and return what was done.

    A plugin that no learned one can stand for stays as it is, with the reason. Fits go into ``folder``, by default
    :func:`cache_folder`. Where shapes were replaced that only one integrator traces as they are stored, that integrator
    replaces a ``path`` of the scene.

    Raises :class:`.UsageError` for an unknown group, :class:`.SceneError`,
    :class:`.OutputError`, and :class:`.FittingError` if a training fails.
    """
    groups = words()
    for word in learn:
        if word not in groups:
            raise UsageError(f'learn: found "{word}", allowed are {", ".join(groups)}')
    if not learn:
        return []
    folder = cache_folder() if folder is None else writable_folder(folder, create=True)
    return parsed.change(lambda state: _replace_nodes(state, {w: groups[w] for w in learn}, folder.resolve(), progress))


def _replace_nodes(state, groups: dict[str, plugins.Plugin], folder: Path, progress: bool) -> list[Conversion]:
    types, fits, conversions, waiting = compat.parsed_types(state), _Fits(folder, progress), {}, {0}
    nodes, references = compat.parsed_properties(state), _references(state)
    while waiting:  # for fits, which are carried out together
        fits.run()
        waiting = set()
        # A plugin that stands for several nested ones comes before those that stand for one of them
        for word, plugin in sorted(groups.items(), key=lambda item: -len(item[1].stock.names)):
            object_type = getattr(mi.ObjectType, plugins.OBJECT_TYPES[plugin.object_type])
            for index, props in enumerate(nodes):
                before = props.plugin_name()
                if before not in plugin.stock.names or object_type != types[index]:
                    continue
                around = list(_around(references, index))
                in_use = any(index in others.values() for others in references)  # not a part of a material until now
                if not in_use or waiting & {index, *around}:
                    continue
                if index in conversions and (conversions[index].learned or conversions[index].word == word):
                    continue
                name = next(filter(None, (nodes[i].id() for i in (index, *around))), "")
                name = name or compat.parsed_place(state, index)
                try:
                    fitted = plugin.stock.convert(_stock_node(nodes, types, references, index, fits))
                except _Waiting:
                    waiting.add(index)
                except Kept as e:
                    conversions.setdefault(index, Conversion(word, name, before, "", str(e)))
                else:
                    if fitted is not None:
                        props.set_plugin_name(plugin.name)
                        conversions[index] = Conversion(word, name, before, plugin.name, fitted)
                        below, references = _below(references, index), _references(state)
                        _drop_unused(nodes[0], references, below)
                        references = _references(state)
                for key in props:
                    props.mark_queried(key, False)  # else Mitsuba takes what was read here for known to the plugin
    result = [conversions[index] for index in sorted(conversions)]
    for plugin in groups.values():
        if plugin.seen_by and any(c.learned == plugin.name for c in result):
            result += _trace_by(plugin.seen_by, compat.parsed_properties(state, mi.ObjectType.Integrator))
    return result


def _stock_node(nodes: list, types: list, references: list[dict[str, int]], index: int, fits: _Fits) -> StockNode:
    parents = [nodes[i] for i, others in enumerate(references) if i and index in others.values()]
    children = {k: _stock_node(nodes, types, references, i, fits) for k, i in references[index].items()}
    shared = len(parents) > 1 and index not in references[0].values()
    return StockNode(types[index], nodes[index], tuple(parents), children, shared, fits.folder, fits.table)


def _references(state) -> list[dict[str, int]]:
    """Return :func:`.compat.parsed_references`, without those of objects that nothing refers to any more."""
    walk = set(compat.parsed_walk(state))
    return [others if index in walk else {} for index, others in enumerate(compat.parsed_references(state))]


def _drop_unused(scene, references: list[dict[str, int]], below: list[int]) -> None:
    """Remove from the scene those of the objects ``below`` a former plugin that nothing else refers to."""
    for key, other in references[0].items():
        if other in below and not any(other in others.values() for others in references[1:]):
            del scene[key]


def _around(references: list[dict[str, int]], index: int) -> Iterator[int]:
    """Yield the objects that refer to one, then those that refer to these, …; the scene has index 0 and is left out."""
    level = [index]
    while level:
        level = [i for i, others in enumerate(references) if i and set(others.values()) & set(level)]
        yield from level


def _below(references: list[dict[str, int]], index: int) -> list[int]:
    """Return all objects that one nests or refers to, directly or not."""
    return sorted({i for other in references[index].values() for i in (other, *_below(references, other))})


def _trace_by(seen_by: tuple[str, ...], integrators: list) -> list[Conversion]:
    """Replace each integrator :data:`TRACER` by the first of ``seen_by``, unless another one needs decoded fields."""
    conversions, tracers = [], []
    for props in integrators:
        name = props.plugin_name()
        if name == TRACER and all(key in TRACER_PARAMETERS for key in props):
            tracers.append(props)
        elif name not in seen_by:
            reason = "does not trace distance fields: they are decoded to grids when the scene is loaded"
            conversions.append(Conversion("integrator", props.id() or name, name, "", reason))
    for props in tracers if not conversions else ():
        props.set_plugin_name(seen_by[0])
        reason = "which follows no footprints: textures filter by the sensor's alone"
        conversions.append(Conversion("integrator", props.id() or TRACER, TRACER, seen_by[0], reason))
    return conversions


class _Waiting(Exception):
    """A table is asked for that has to be fitted first."""


class _Fits:
    """Fits of a conversion, kept in a ``folder``, and those that wait to be carried out together."""

    def __init__(self, folder: Path, progress: bool):
        self.folder, self.progress = folder, progress
        self._jobs: dict[str, tuple] = {}
        self._failures: dict[Path, str] = {}
        self._paths: dict[str, Path] = {}

    def table(self, task: str, source: Path, **options) -> Table:
        """Return the table of a fit, of this call or an earlier one, as its file holds it.

        Equal content is fitted once. Raises :class:`_Waiting` for a table that is not there, and
        :class:`~.plugins.support.properties.Kept` for a source that the task refuses.
        """
        content = _digest([task, sorted(options.items()), _content(source)])
        place = _digest([content, relative_path(source, self.folder)])  # the file records its source by that path
        path = self._paths.setdefault(content, self.folder / f"{source.stem}_{place}.npz")
        if not path.name.startswith(f"{source.stem}_"):
            _discard(self.folder, source)
        if path in self._failures:
            _discard(self.folder, source)
            raise Kept(f"cannot be fitted: {self._failures[path]}")
        if not path.is_file():
            self._jobs.setdefault(path.name, (task, str(source), options, path, mi.variant()))
            raise _Waiting
        return tasks()[task].load(path)  # raises for a damaged file

    def run(self) -> None:
        """Carry out the fits that wait, side by side on the processor's cores, each on one; after Ctrl-C, keep those.

        Raises ``KeyboardInterrupt`` if some are missing.
        """
        if not self._jobs:
            return
        jobs, self._jobs, cores = self._jobs, {}, _cores()
        workers = min(len(jobs), cores) if len(jobs) > 1 and cores > 1 and not mi.variant().startswith("cuda") else None
        alone = self.progress and len(jobs) == 1
        if self.progress:
            for task, source, _, path, _ in jobs.values():
                print(f"fit {task} to {Path(source).name}: {path}", file=sys.stderr, flush=True)
        values, missing = {name: (*job, alone) for name, job in jobs.items()}, set(jobs)
        try:
            for outcome in run_jobs(
                _fit, values, workers, progress=self.progress and not alone, title="fit", unit="tables"
            ):
                missing.discard(outcome.name)
                if outcome.failure:
                    self._failures[self.folder / outcome.name] = outcome.failure
        finally:
            for name, (_, source, *_) in jobs.items():
                if not (self.folder / name).is_file():
                    _discard(self.folder, Path(source))
        if missing:
            if self.progress and len(missing) < len(jobs):
                kept = f"kept {len(jobs) - len(missing)} of {len(jobs)} fits in {self.folder}"
                print(f"{kept}: the same command goes on from there", file=sys.stderr, flush=True)
            raise KeyboardInterrupt


def _cores() -> int:
    return os.cpu_count() or 1


def _fit(job: tuple) -> None:
    """Carry out a fit and write its table. Raises ``KeyboardInterrupt`` after Ctrl-C."""
    task, source, options, path, variant, progress = job
    fitted = fit(task, variant=variant, output=path, progress=progress, source=source, **options)
    if fitted.result.interrupted:
        raise KeyboardInterrupt
    save_table(path, fitted.table)


def _discard(folder: Path, source: Path) -> None:
    """Remove a manifest without a table, and its links to images."""
    if source.suffix == ".json" and not any(folder.glob(f"{glob.escape(source.stem)}_*.npz")):
        for file in folder.glob(f"{glob.escape(source.stem)}*"):
            if file == source or file.is_symlink():
                file.unlink()


def _content(source: Path) -> list:
    """Return what a file holds: a digest, or if it is a manifest, its maps, with a digest in place of each image."""
    if source.suffix != ".json":
        return [hashlib.sha256(source.read_bytes()).hexdigest()]
    maps = json.loads(source.read_text(encoding="utf-8"))["maps"]
    return [[name, {**entry, "file": _content(source.parent / entry["file"])}] for name, entry in maps.items()]


def _digest(value) -> str:
    """Return a digest of plain data; ten hexadecimal digits."""
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:10]


def write_scene(
    parsed: ParsedScene, path: str | os.PathLike, check: Callable[[ParsedScene], object] | None = None
) -> None:
    """Write a parsed and changed scene file: as it was, but for what was changed (:mod:`.scene_text`).

    What was written is parsed again. The file stays only if it holds the objects of the changed scene, with their ids,
    plugins, parameters and references, and if ``check(written)`` raises nothing. Raises :class:`.scenes.SceneError` and
    :class:`.OutputError`.
    """
    if parsed.description:
        raise UsageError("scene: found one in memory, a scene file is needed")
    target, before = Path(path).resolve().parent, ParsedScene(parsed.path, parsed.defines)
    content = before.change(lambda b: parsed.change(lambda a: edit_text(b, a, parsed.defines, target)))
    with replacing(path) as temporary:
        temporary.write_bytes(content)
        try:
            written = ParsedScene(temporary)
            states = parsed.change(absolute_paths), written.change(absolute_paths)
            if fault := parsed.change(lambda _: difference(*states)):
                raise SceneError(f"{parsed.path}: cannot be written as {path}, which would have {fault}")
            if check is not None:
                check(written)
        except SceneError as e:
            raise SceneError(str(e).replace(temporary.name, Path(path).name)) from e


def summary(conversions: Sequence[Conversion | Mapping]) -> list[str]:
    """Return what was replaced and what was kept, by name, as lines of text; mappings hold the fields."""
    conversions = [Conversion(**c) if isinstance(c, Mapping) else c for c in conversions]
    replaced = [c for c in conversions if c.learned]
    lines = []
    for stock, learned in dict.fromkeys((c.stock, c.learned) for c in replaced):
        count = sum((c.stock, c.learned) == (stock, learned) for c in replaced)
        lines.append(f"replaced    {count} x {stock} → {learned}")
        lines += [
            f'            "{c.name}": {c.reason}'
            for c in replaced
            if (c.stock, c.learned, bool(c.reason)) == (stock, learned, True)
        ]
    return [*lines, *(f"kept        {c}" for c in conversions if not c.learned)]


# -- tables that were optimised inside of a scene ---------------------------------------------------------------------


@dataclass(frozen=True)
class Saved:
    """Saved table file: its ``path``, ``nbytes`` and ``storage`` form.

    ``rms`` is the root mean square error of each array that was optimised, against its values in single precision.
    """

    path: Path
    nbytes: int
    storage: str
    rms: dict[str, float]

    def __str__(self) -> str:
        errors = ", ".join(f"{name} {value:.2g}" for name, value in self.rms.items())
        return f"{self.path}: {self.nbytes:,} bytes as {self.storage}; RMS error against float32: {errors}"


def save(source, path: str | os.PathLike, storage: str = "", file: str | os.PathLike = "") -> Saved:
    """Write tables that were optimised through renders into a table file.

    - ``source``: a plugin (``neural_texture``, ``neural_material``, ``neural_image``, ``neural_disney``,
      ``neural_ggx``, ``neural_sdf``, ``neural_field``), a scene, or ``mi.traverse(…)`` of one of them. The plugin has
      the storage form ``"float32"``.
    - ``path``: table file (``.npz``) to write.
    - ``storage``: storage form of the entries (``"uint8"``, ``"float16"``, ``"float32"``); "": that of the file that
      the plugin read, with its bits per entry.
    - ``file``: if a scene optimises the tables of several files, the name of the one to save.

    The new file keeps the settings of the old one, without its measurements. Raises
    :class:`.UsageError` and :class:`.OutputError`.
    """
    path = table_path(path)
    if storage and storage not in STORAGES:
        raise UsageError(f'storage: found "{storage}", allowed are {", ".join(STORAGES)}')
    table, entries = _optimised_table(source, str(file))
    try:
        stored = find_task(table).stored(table, entries, storage)
    except ValueError as e:
        raise UsageError(f"{path}: {e}") from None
    stored.settings = move_paths(stored.settings, Path(table.path or "x").resolve().parent, path.resolve().parent)
    save_table(path, stored)
    read = find_task(stored).model(stored, mi.TensorXf, "float32").entries()
    errors = {name: array.numpy().reshape(-1) - read[name].numpy().reshape(-1) for name, array in entries.items()}
    rms = {name: float(np.sqrt(np.mean(np.square(e, dtype=np.float64)))) for name, e in errors.items()}
    return Saved(path, stored.nbytes, stored.storage, rms)


def _optimised_table(source, file: str) -> tuple[Table, dict]:
    """Return the one table of an object whose entries can be optimised, and these entries."""
    if isinstance(source, mi.SceneParameters):
        nodes = compat.nodes_of(source)
    else:
        nodes = [source] if hasattr(source, "trained") else compat.scene_objects(source)
    trained = {}
    for node in nodes:
        if hasattr(node, "trained") and plugins.origin(node) is not None:
            table, entries = node.trained()
            if table is not None and entries:
                trained.setdefault(tuple(id(v) for v in entries.values()), (table, entries))
    if file:
        trained = {key: value for key, value in trained.items() if Path(value[0].path).name == Path(file).name}
    if not trained:
        raise UsageError(
            'save: found no tables that can be optimised; give the plugin storage="float32"'
            + (f", or another name than {file}" if file else "")
        )
    if len(trained) > 1:
        names = ", ".join(str(table.path) for table, _ in trained.values())
        raise UsageError(f"save: found the tables of several files ({names}): name one of them by file")
    return next(iter(trained.values()))
