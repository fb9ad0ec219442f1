"""Conversion of scenes: stock plugins are replaced by learned ones, which are fitted where they need a table file.

Plugins declare which plugins of Mitsuba they can stand for (:class:`.plugins.Stock`). A fit is kept in a folder under
a name that contains a digest of the source, its place and the options, and is not repeated.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from . import compat, mitsuba_versions, plugins
from .errors import DiffindError, UsageError
from .files import OutputError, relative_path, replacing, shown, writable_file, writable_folder
from .plugins.support.stock import Kept, StockNode
from .runtime import use_variant
from .scenes import ParsedScene
from .tables import save_table
from .task import fit, tasks

#: Environment variable with the folder of fits for scenes that are rendered and not written.
FOLDER = "MI_DIFFIND_CACHE"

#: Integrator whose estimator those of ``Plugin.seen_by`` share, and the parameters that they take from it.
TRACER, TRACER_PARAMETERS = "path", ("max_depth", "rr_depth", "hide_emitters")


@dataclass(frozen=True)
class Conversion:
    """Stock plugin of a scene and what became of it.

    ``word``: its group (:class:`.plugins.Stock`); ``name``: its id, that of an object around it, or its place in the
    file; ``stock``: its type; ``learned``: the type that replaces it, "" if it is kept; ``reason``: why, or the table
    file that was fitted to it.
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


def words() -> dict[str, plugins.Plugin]:
    """Return the groups of stock plugins that learned ones can stand for, and the learned plugin of each."""
    return {plugin.stock.word: plugin for plugin in plugins.declared().values() if plugin.stock}


def cache_folder() -> Path:
    """Return the folder of fits of this user, which is created: ``$MI_DIFFIND_CACHE``, or in ``~/.cache``.

    Raises :class:`~mi_diffind.files.OutputError`.
    """
    folder = Path(os.environ.get(FOLDER) or Path.home() / ".cache" / "mi_diffind")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        return writable_folder(folder, create=True)
    except OSError as e:
        fault = str(e) if isinstance(e, OutputError) else f'folder "{shown(folder)}" cannot be made: {e.strerror}'
        raise OutputError(f"{fault}; the environment variable {FOLDER} names another folder") from None


def convert(
    scene: str | os.PathLike,
    output: str | os.PathLike,
    *,
    learn: Sequence[str] | None = None,
    tables: str | os.PathLike | None = None,
    defines: Mapping[str, object] | None = None,
    progress: bool = True,
) -> list[Conversion]:
    """Write a scene with learned plugins in place of Mitsuba's: ``mi-diffind convert`` in Python.

    - ``scene``: a scene file; ``output``: the scene file to write (:func:`write_scene`).
    - ``learn``: groups of plugins to replace (:func:`words`; ``None``: all).
    - ``tables``: folder of the table files (``None``: ``NEW_tables`` beside ``NEW.xml``).
    - ``defines``: values of the file's ``<default>`` parameters.

    Returns what was replaced and what was kept (:func:`replace_stock`, whose errors are raised, too).
    """
    output = Path(output)
    if output.suffix.lower() != ".xml":
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .xml')
    if output.resolve() == Path(scene).resolve():
        raise UsageError(f'output "{output}": is the scene itself')
    writable_file(output)
    use_variant()
    parsed = ParsedScene(scene, dict(defines or {}))
    folder = Path(tables or output.with_name(f"{output.stem}_tables"))
    conversions = replace_stock(parsed, list(words()) if learn is None else learn, folder, progress)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    write_scene(parsed, output)
    return conversions


def replace_stock(
    parsed: ParsedScene, learn: Sequence[str], folder: str | os.PathLike | None = None, progress: bool = True
) -> list[Conversion]:
    """Replace the stock plugins of the groups ``learn`` (:func:`words`) in a parsed scene, and return what was done.

    A plugin that no learned one can stand for stays as it is, with the reason. Fits go into ``folder``, by default
    :func:`cache_folder`. Where shapes were replaced that only one integrator traces as they are stored, that integrator
    replaces a ``path`` of the scene.

    Raises :class:`~mi_diffind.errors.UsageError` for an unknown group, :class:`~mi_diffind.scenes.SceneError`,
    :class:`~mi_diffind.files.OutputError`, and :class:`~mi_diffind.fitting.FittingError` if a training fails.
    """
    groups = words()
    for word in learn:
        if word not in groups:
            raise UsageError(f'learn: found "{word}", allowed are {", ".join(groups)}')
    if not learn:
        return []
    folder = cache_folder() if folder is None else writable_folder(folder, create=True)
    return parsed.change(lambda state: _convert(state, {w: groups[w] for w in learn}, folder.resolve(), progress))


def _convert(state, groups: dict[str, plugins.Plugin], folder: Path, progress: bool) -> list[Conversion]:
    nodes, types = compat.properties_of(state), compat.parsed_types(state)
    references = compat.parsed_references(state)
    stock = {name: (word, plugin) for word, plugin in groups.items() for name in plugin.stock.names}
    conversions = []
    for index, props in enumerate(nodes):
        if (before := props.plugin_name()) not in stock:
            continue
        word, plugin = stock[before]
        if mitsuba_versions.object_type(plugins.OBJECT_TYPES[plugin.object_type]) != types[index]:
            continue
        around = list(_around(references, index))
        name = next(filter(None, (nodes[i].id() for i in (index, *around))), "") or compat.parsed_place(state, index)
        parents = [i for i in around if index in references[i]]
        fits: list[Path] = []
        node = StockNode(
            props, tuple(nodes[i] for i in parents), tuple((types[i], nodes[i]) for i in _below(references, index)),
            folder, functools.partial(_fitted, folder, progress, fits),
        )  # fmt: skip
        try:
            plugin.stock.convert(node)
        except Kept as e:
            conversions.append(Conversion(word, name, before, "", str(e)))
        else:
            props.set_plugin_name(plugin.name)
            conversions.append(Conversion(word, name, before, plugin.name, fits[0].name if fits else ""))
        for key in props:
            props.mark_queried(key, False)  # else Mitsuba takes what was read here for known to the plugin
    for plugin in groups.values():
        if plugin.seen_by and any(c.learned == plugin.name for c in conversions):
            conversions += _trace_by(plugin.seen_by[0], compat.properties_of(state, mi.ObjectType.Integrator))
    return conversions


def _around(references: list[list[int]], index: int) -> Iterator[int]:
    """Yield the objects that refer to one, then those that refer to these, …; the scene has index 0 and is left out."""
    level = [index]
    while level:
        level = [i for i, others in enumerate(references) if i and set(others) & set(level)]
        yield from level


def _below(references: list[list[int]], index: int) -> list[int]:
    """Return all objects that one nests or refers to, directly or not."""
    seen, todo = set(), list(references[index])
    while todo:
        other = todo.pop()
        if other not in seen:
            seen.add(other)
            todo += references[other]
    return sorted(seen)


def _trace_by(name: str, integrators: list) -> list[Conversion]:
    """Replace an integrator :data:`TRACER` by another one that takes its parameters."""
    conversions = []
    for props in integrators:
        if props.plugin_name() == TRACER and all(key in TRACER_PARAMETERS for key in props):
            props.set_plugin_name(name)
            conversions.append(Conversion("integrator", props.id() or TRACER, TRACER, name, ""))
    return conversions


def _fitted(folder: Path, progress: bool, fits: list[Path], task: str, source: Path, **options) -> Path:
    """Return the table file of a fit, of this call or an earlier one, and add it to ``fits``.

    Raises :class:`~.plugins.support.stock.Kept` for a source that the task refuses.
    """
    key = [task, sorted(options.items()), relative_path(source, folder)]  # the file records its source by that path
    path = folder / f"{source.stem}_{_digest(source, key)}.npz"
    if not path.is_file():
        if progress:
            print(f"fit {task} to {source.name}: {path}", file=sys.stderr, flush=True)
        try:
            fitted = fit(task, variant=mi.variant(), output=path, progress=progress, source=str(source), **options)
        except DiffindError as e:
            raise Kept(f"cannot be fitted: {e}") from None
        if fitted.result.interrupted:
            raise KeyboardInterrupt
        save_table(path, fitted.table)
    tasks()[task].load(path)  # raises for a damaged file
    fits.append(path)
    return path


def _digest(source: Path, options) -> str:
    """Return a digest of a file, of the files that it names if it is JSON, and of options; ten hexadecimal digits."""
    files = [source]
    if source.suffix == ".json":
        maps = json.loads(source.read_text(encoding="utf-8"))["maps"]
        files += [source.parent / entry["file"] for entry in maps.values()]
    content = hashlib.sha256(json.dumps(options).encode())
    for file in files:
        content.update(hashlib.sha256(file.read_bytes()).digest())
    return content.hexdigest()[:10]


def write_scene(parsed: ParsedScene, path: str | os.PathLike) -> None:
    """Write a parsed scene as XML. Names of files are changed to those that the new file's folder needs.

    Values of ``defines`` are written in the place of ``$name``; comments and includes are not kept. Raises
    :class:`~mi_diffind.files.OutputError`.
    """
    target = Path(path).resolve().parent

    def text(state) -> str:
        for props in compat.properties_of(state):
            for key in props:
                if compat.property_kind(props, key) == "text" and key == "filename":
                    file = Path(str(mi.file_resolver().resolve(props[key])))
                    if file.is_file():
                        props[key] = relative_path(file, target)
        return compat.scene_xml(state)

    content = parsed.change(text)
    with replacing(path) as temporary:
        temporary.write_text(content, encoding="utf-8")


def summary(conversions: Sequence[Conversion | Mapping]) -> list[str]:
    """Return what was replaced and what was kept, by name, as lines of text; mappings hold the fields."""
    conversions = [Conversion(**c) if isinstance(c, Mapping) else c for c in conversions]
    replaced = [c for c in conversions if c.learned]
    lines = []
    for stock, learned in dict.fromkeys((c.stock, c.learned) for c in replaced):
        count = sum((c.stock, c.learned) == (stock, learned) for c in replaced)
        lines.append(f"replaced    {count} x {stock} → {learned}")
    return [*lines, *(f"kept        {c}" for c in conversions if not c.learned)]
