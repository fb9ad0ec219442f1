"""
Scene files: load them, render them, say which tables they read, swap every learned plugin for its exact counterpart.

Everything here runs in the variant that is set.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import plugins
from .files import replacing
from .measure.operations import bsdf_operations
from .tasks import ggx
from .tasks.disney import library as disney
from .tasks.image import compressed as image

#: Integrators that follow paths to a ``max_depth``, with the depth that each takes if none is given (-1: infinite).
MAX_DEPTHS = {
    **dict.fromkeys(("path", "volpath", "volpathmis", "ptracer"), -1),
    **dict.fromkeys(("prb", "prb_basic", "prb_projective", "prbvolpath"), 6),
}

#: For each learned plugin: which file it reads, by file name and quality, and how to read it.
_TABLES = {
    "neural_disney": (disney.table_file, disney.load_disney_table),
    "neural_ggx": (ggx.table_file, ggx.load_ggx_table),
    "neural_image": (lambda name, quality: name, image.load_image_table),
}


class SceneError(RuntimeError):
    """A scene cannot be loaded or rendered; the message is one sentence that names the file and the fault."""


def load(
    path: str | os.PathLike,
    exact: bool = False,
    longest_path: int | None = None,
    defines: dict[str, str] | None = None,
):
    """
    Load a scene as ``mi.load_file`` does; with ``exact``, every learned plugin is replaced by its exact counterpart.

    ``longest_path`` replaces the ``max_depth`` of the scene's integrator (1: emitted light, 2: direct light, …; -1:
    infinite), and ``defines`` (name → value) the scene's ``<default>`` values. Raises :class:`SceneError`.
    """
    with scene_errors(path), _resolving(path):
        config = mi.parser.ParserConfig(mi.variant())
        state = _parse(config, path, defines)
        if exact:
            swap_exact(state)
        if longest_path is not None:
            _path_integrator(state)["max_depth"] = longest_path
        mi.parser.transform_all(config, state)
        loaded = mi.parser.instantiate(config, state)
        if not isinstance(loaded, mi.Scene):
            raise RuntimeError(f"{path}: holds a {type(loaded).__name__}, a scene is expected")
        return loaded


def swap_exact(state) -> int:
    """Replace learned plugins in a parsed scene (``mi.parser.ParserState``) by exact ones; returns how many."""
    count = 0
    for node in state.nodes:
        props = node.props
        counterpart = plugins.EXACT_COUNTERPARTS.get(props.plugin_name())
        if counterpart is not None:
            if "latents" in props:
                raise RuntimeError(
                    f'"{props.id()}" has its parameters encoded (latents); its exact counterpart needs the originals'
                )
            counterpart.replace(props)
            count += 1
    return count


def integrator_of(path: str | os.PathLike, defines: dict[str, str] | None = None) -> tuple[str, int]:
    """
    The integrator that follows the scene's paths (others, like ``aov``, may contain it) and its ``max_depth``.

    Raises :class:`SceneError`, also if there is none of :data:`MAX_DEPTHS`, or more than one.
    """
    with scene_errors(path), _resolving(path):
        props = _path_integrator(_parse(mi.parser.ParserConfig(mi.variant()), path, defines))
        name = props.plugin_name()
        return name, int(props.get("max_depth", MAX_DEPTHS[name]))


def learned_plugins(path: str | os.PathLike, defines: dict[str, str] | None = None) -> list[dict]:
    """
    The learned plugins that a scene file names: ``plugin``, ``id``, ``parameters`` (constants as numbers, textures as
    ``"texture"``), ``filename`` and ``storage`` of its tables. Raises :class:`SceneError`.
    """
    found = []
    with scene_errors(path), _resolving(path):
        state = _parse(mi.parser.ParserConfig(mi.variant()), path, defines)
        for node in state.nodes:
            props = node.props
            if props.plugin_name() not in plugins.EXACT_COUNTERPARTS:
                continue
            learned_only = plugins.EXACT_COUNTERPARTS[props.plugin_name()].learned_only
            constants = {k: _constant(props, k) for k in props if k not in learned_only}
            found.append({
                "plugin": props.plugin_name(),
                "id": props.id(),
                "parameters": constants,
                **{k: str(props[k]) for k in learned_only if k in props},
            })  # fmt: skip
    return found


def learned_materials(scene) -> list:
    """The instances of learned BSDFs in a loaded scene, wherever they hide (in a ``twosided``, a ``bumpmap``, …)."""
    # Not only nodes that own a parameter: tables of bytes are none
    found = {id(node): node for node in mi.traverse(scene).hierarchy if isinstance(node, mi.BSDF)}
    return [node for node in found.values() if hasattr(node, "report")]


def reports(scene) -> list[dict]:
    """
    For each learned material of a loaded scene, what it does: its ``id``, ``quality``, ``effects_in_use``,
    ``effects_left_out`` (effect → reason), ``evaluated_once``, ``storage`` and ``table_bytes``, and the ``operations``
    of ``eval``, ``pdf`` and ``sample`` (:class:`~mi_diffind.measure.operations.Operations`, by name).
    """
    return [
        {
            "id": material.id(),
            **material.report(),
            "operations": {method: n.asdict() for method, n in bsdf_operations(material).items()},
        }
        for material in learned_materials(scene)
    ]


def table_bytes(scene: str | os.PathLike, learned: list[dict]) -> int:
    """Bytes of all distinct tables that the learned plugins of a scene read, in their storage forms."""
    return sum(table.nbytes for table in tables_of(scene, learned).values())


def tables_of(scene: str | os.PathLike, learned: list[dict]) -> dict[tuple[str, str], object]:
    """The distinct tables of a scene's learned plugins: ``(file, storage)`` → :class:`~mi_diffind.tables.Table`."""
    found = {}
    for entry in learned:
        name, storage = entry.get("filename", ""), entry.get("storage", "")
        table_file, load_table = _TABLES[entry["plugin"]]
        file = table_file(name and Path(scene).resolve().parent / name, entry.get("quality", ""))
        if file is not None and (str(file), storage) not in found:
            table, _ = load_table(file)
            found[str(file), storage] = table.to(storage or table.storage)
    return found


def render(
    scene,
    spp: int | None = None,
    seed: int = 0,
    passes: int = 1,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> tuple[np.ndarray, list[float]]:
    """
    Render in ``passes`` of about ``spp / passes`` samples each and average them.

    Returns the linear image ``(height, width, channels)``, float32, and the seconds that each pass took (the first
    includes compilation). ``on_pass()`` is called after each; once ``stop`` is set, the pass that is running is the
    last, and the image is the average of those done, ``len(seconds) · spp // passes`` samples. The same arguments give
    the same image, if the film's filter is a box (other filters add up samples of neighbouring pixels in any order) and
    the samples of a pass are a power of two (else the last bit of a few pixels varies).
    """
    spp = spp or scene.sensors()[0].sampler().sample_count()
    passes = max(1, min(passes, spp))
    image, seconds, done = 0, [], 0
    for i in range(passes):
        n = (i + 1) * spp // passes - done
        start = time.perf_counter()
        image = image + n * render_pass(scene, n, (seed << 16) + i)
        seconds.append(time.perf_counter() - start)
        done += n
        if on_pass is not None:
            on_pass()
        if stop is not None and stop.is_set():
            break
    return (image / done).astype(np.float32), seconds


def render_pass(scene, spp: int, seed: int) -> np.ndarray:
    """One pass, ``(height, width, channels)``, float64; ``seed`` is Mitsuba's own, modulo 2³². Raises SceneError."""
    with scene_errors(None):
        return mi.render(scene, spp=spp, seed=seed % 2**32).numpy().astype(np.float64)


def write_image(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a linear image: ``.exr`` as 32-bit floats, ``.png`` or ``.jpg`` as displayed."""
    with replacing(path) as temporary:
        bitmap = mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))
        if Path(path).suffix.lower() == ".exr":
            bitmap.write(str(temporary))
        else:
            mi.util.write_bitmap(str(temporary), bitmap, write_async=False)


def files_of(path: str | os.PathLike, defines: dict[str, str] | None = None) -> list[Path]:
    """The files that a scene consists of: itself, what it includes and what it names. Raises :class:`SceneError`."""
    folder = Path(path).resolve().parent
    with scene_errors(path), _resolving(path):
        state = _parse(mi.parser.ParserConfig(mi.variant()), path, defines)
    found = [Path(str(file)).resolve() for file in state.files]
    for node in state.nodes:
        texts = (node.props[k] for k in node.props if node.props.type(k) == mi.Properties.Type.String)
        for file in (folder / text for text in texts if text):
            with contextlib.suppress(OSError, ValueError):  # any text may be asked for, and few are names of files
                if file.is_file():
                    found.append(file.resolve())
    return list(dict.fromkeys(found))


def _parse(config, path, defines: dict[str, str] | None):
    if not Path(path).is_file():
        raise RuntimeError(f"{path}: no such scene file")
    return mi.parser.parse_file(config, str(path), **{k: str(v) for k, v in (defines or {}).items()})


def _path_integrator(state):
    integrators = [node.props for node in state.nodes if node.type == mi.ObjectType.Integrator]
    found = [props for props in integrators if props.plugin_name() in MAX_DEPTHS]
    if len(found) != 1:
        names = ", ".join(props.plugin_name() for props in integrators) or "none"
        raise RuntimeError(f"a depth needs one integrator of {', '.join(MAX_DEPTHS)}; found {names}")
    return found[0]


def _constant(props, key: str):
    kind, types = props.type(key), mi.Properties.Type
    if kind in (types.Float, types.Integer):
        return float(props[key])
    if kind == types.Color:
        return [float(v) for v in props[key]]
    return "texture" if kind in (types.Reference, types.ResolvedReference) else str(props[key])


@contextlib.contextmanager
def _resolving(path):
    """Look for relative file names beside the scene, as ``mi.load_file`` does."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    resolver.prepend(str(Path(path).resolve().parent))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


@contextlib.contextmanager
def scene_errors(path):
    """Turn Mitsuba's nested messages into one sentence."""
    try:
        yield
    except SceneError:
        raise
    except (RuntimeError, TypeError, ValueError, OSError) as e:
        message = one_sentence(e)
        if path is not None and str(path) not in message:
            message = f"{path}: {message}"
        raise SceneError(message) from e


def one_sentence(error: BaseException) -> str:
    """
    What went wrong, without the layers around it: Mitsuba prefixes source lines, embeds Python tracebacks, and hides
    the cause of an error at render time behind ``drjit.custom(...) error``.
    """
    while error.__cause__ is not None:
        error = error.__cause__
    text = re.sub(r"\[[\w.]+:\d+\] ", "", str(error)).strip()
    head, traceback, tail = text.partition("Traceback (most recent call last):")
    if traceback:
        last = [line for line in tail.splitlines() if re.match(r"[\w.]+: ", line)][-1]
        location = re.sub(r"failed to instantiate.*", "", head.strip())
        text = location + last.split(": ", 1)[1]
    return " ".join(text.split())
