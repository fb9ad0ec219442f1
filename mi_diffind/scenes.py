"""
Scene files: load them, render them, say which tables they read, swap every learned plugin for its exact counterpart.

Everything here runs in the variant that is set.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import compat, plugins
from .errors import DiffindError
from .files import replacing
from .measure.operations import bsdf_operations
from .plugins.support import footprint
from .task import tasks

#: Integrators that follow paths to a ``max_depth``, with the depth that each takes if none is given (-1: infinite).
MAX_DEPTHS = {
    **dict.fromkeys(("path", "volpath", "volpathmis", "ptracer", "path_footprint", "path_sdf", "neural_field"), -1),
    **dict.fromkeys(("prb", "prb_basic", "prb_projective", "prbvolpath"), 6),
}


class SceneError(DiffindError, RuntimeError):
    """A scene cannot be loaded or rendered; the message is one sentence that names the file and the fault."""


def load(
    path: str | os.PathLike,
    exact: bool = False,
    longest_path: int | None = None,
    defines: dict[str, str] | None = None,
    against: str = "exact",
    change: Callable[[object], object] | None = None,
    merge: bool = True,
):
    """
    Load a scene as :func:`load_file` does; with ``exact``, every learned plugin is replaced by its exact counterpart,
    or by the one that ``against`` names (:func:`swap`).

    ``longest_path`` replaces the ``max_depth`` of the scene's integrator (1: emitted light, 2: direct light, …; -1:
    infinite), and ``defines`` (name → value) the scene's ``<default>`` values. ``change(state)`` may change the parsed
    scene (``mi.parser.ParserState``) before anything else does. Without ``merge``, no meshes are made one, and each
    keeps its id.

    Shapes that the scene's integrator does not see as they are stored are decoded to what it does see, unless the scene
    says that they are not to be; a warning says what that takes. Raises :class:`SceneError`.
    """
    with scene_errors(path), _resolving(path):
        config, state = _parse(path, defines)
        if not merge:
            compat.keep_meshes(config)
        if change is not None:
            change(state)
        if exact:
            swap(state, against)
        if longest_path is not None:
            _path_integrator(state)["max_depth"] = longest_path
        integrators = _integrators(state) or ["path"]  # which commands take that need none in the scene
        decoded = _decode_unseen(state, integrators)
        loaded = compat.instantiate(config, state)
        if not isinstance(loaded, mi.Scene):
            raise RuntimeError(f"{path}: holds a {type(loaded).__name__}, a scene is expected")
        unseen = _unseen(loaded, integrators)
        if unseen:
            raise RuntimeError(unseen)
        _say_decoded(loaded, decoded, integrators)
        footprint.attach(loaded)
        return loaded


def _integrators(state) -> list[str]:
    """The names of all integrators of a parsed scene, those within others, too."""
    return [props.plugin_name() for props in compat.properties_of(state, mi.ObjectType.Integrator)]


def _decode_unseen(state, integrators: list[str]) -> list[str]:
    """
    Have the shapes that none of the ``integrators`` sees (their plugins' ``seen_by``) decoded, if the parsed scene does
    not say how they are traced, nor that their arrays are optimised; returns their ids.
    """
    found = []
    for props in compat.properties_of(state):
        plugin = plugins.declared().get(props.plugin_name())
        if plugin is None or plugin.otherwise is None or set(plugin.seen_by) & set(integrators):
            continue
        key, value = plugin.otherwise
        if key not in props and not ("storage" in props and props["storage"] == "float32"):
            props[key] = value
            found.append(props.id())
    return found


def _say_decoded(scene, ids: list[str], integrators: list[str]) -> None:
    """A warning for each shape that was decoded so that the ``integrators`` see it."""
    names = ", ".join(f'"{name}"' for name in integrators)
    for made in instances(scene) if ids else ():
        origin, said = plugins.origin(made), plugins.report(made) or {}
        if origin["id"] in ids and "decoded" in said:
            plugins.warn(f"{origin['filename']}, whose arrays {names} does not see, is {said['decoded']}")


def _unseen(scene, integrators: list[str]) -> str:
    """A sentence about a shape that is seen by none of the ``integrators`` (names of plugins), "" if there is none."""
    for made in instances(scene):
        seen_by = getattr(made, "seen_by", None)
        if seen_by and not set(seen_by) & set(integrators):
            allowed = " or ".join(f'"{name}"' for name in seen_by)
            found = ", ".join(f'"{name}"' for name in integrators) or "none"
            return (
                f'the shape "{made.id()}" ({plugins.origin(made)["plugin"]}) is seen by the integrator {allowed} '
                f'alone, found {found}: take that one, or trace="grid"'
            )
    return ""


def load_file(path: str | os.PathLike, parallel: bool = True, optimize: bool = True, **defines):
    """
    Load a scene file as ``mi.load_file`` does, with ``defines`` for its ``<default>`` values (and ``parallel`` and
    ``optimize``, which are Mitsuba's own), and do what that does not: tell textures that filter themselves which sensor
    sees them, the first one of the scene, at the samples of its sampler (:func:`.plugins.support.footprint.attach`);
    decode shapes that the scene's integrator does not see as they are stored, if the scene does not say that they are
    not to be, with a warning that says what that takes. Where it says so, and in a scene without an integrator (another
    one may be meant), a warning says that they are left out. Raises what ``mi.load_file`` raises.
    """
    if not Path(path).is_file():
        return mi.load_file(str(path))
    with _resolving(path):
        config, state = compat.parse_file(path, defines)
        compat.build_as(config, parallel, optimize)
        integrators = _integrators(state)
        decoded = _decode_unseen(state, integrators) if integrators else []
        loaded = compat.instantiate(config, state)
    if isinstance(loaded, mi.Scene):
        unseen = _unseen(loaded, integrators)
        if unseen:
            plugins.warn(unseen)
        _say_decoded(loaded, decoded, integrators)
        footprint.attach(loaded)
    return loaded


def swap(state, against: str = "exact") -> int:
    """
    Replace the plugins of a parsed scene (``mi.parser.ParserState``) that have one by their exact counterpart, or by
    the one that ``against`` names, such as ``"principled"``; returns how many.
    """
    found = _declared_nodes(state, against)
    for props, plugin in found:
        plugin.counterpart(against).replace(props)
    return len(found)


def _declared_nodes(state, against: str) -> list:
    """The properties of a parsed scene's nodes that are plugins of ours with such a counterpart, and the plugins."""
    declared = plugins.declared()
    found = [(props, declared.get(props.plugin_name())) for props in compat.properties_of(state)]
    return [(props, plugin) for props, plugin in found if plugin and plugin.counterpart(against)]


def integrator_of(path: str | os.PathLike, defines: dict[str, str] | None = None) -> tuple[str, int]:
    """
    The integrator that follows the scene's paths (others, like ``aov``, may contain it) and its ``max_depth``.

    Raises :class:`SceneError`, also if there is none of :data:`MAX_DEPTHS`, or more than one.
    """
    with scene_errors(path), _resolving(path):
        props = _path_integrator(_parse(path, defines)[1])
        name = props.plugin_name()
        return name, int(props.get("max_depth", MAX_DEPTHS[name]))


def learned_plugins(
    path: str | os.PathLike, defines: dict[str, str] | None = None, against: str = "exact"
) -> list[dict]:
    """
    The learned plugins that a scene file names, in the file's order: ``plugin``, ``kind``, ``id``, ``parameters``
    (constants as numbers, textures as ``"texture"``), and ``preset``, ``filename``, ``storage``, … as far as they are
    given. With ``against``, all plugins that have the counterpart of that name. Raises :class:`SceneError`.
    """
    with scene_errors(path), _resolving(path):
        _, state = _parse(path, defines)
        return [plugin.described(props) for props, plugin in _declared_nodes(state, against)]


def instances(scene) -> list:
    """
    What the package's plugins made in a loaded scene, wherever it hides (in a ``twosided``, a ``bumpmap``, …): objects
    of Mitsuba, each once.
    """
    # Not only nodes that own a parameter: tables of bytes are none
    return [node for node in compat.objects_of(scene) if plugins.origin(node) is not None]


def learned_instances(scene) -> list:
    """Those of :func:`instances` that learned plugins made."""
    learned = plugins.with_counterpart()
    return [made for made in instances(scene) if plugins.origin(made)["plugin"] in learned]


def reports(scene) -> list[dict]:
    """
    What each learned plugin of a loaded scene does: ``plugin``, ``kind``, ``id`` and ``parameters`` as in
    :func:`learned_plugins`; what it reports, ``preset``, ``effects_in_use``, ``effects_left_out`` (effect → reason),
    ``evaluated_once``, ``storage``, ``table_bytes`` and more; and for a BSDF the ``operations`` of ``eval``, ``pdf``
    and ``sample`` (:class:`~mi_diffind.measure.operations.Operations`, by name); for the integrator of a radiance
    field, how many steps of ``rays`` are taken, skipped, … (:class:`~mi_diffind.tasks.radiance.counting.Counts`).
    """
    found = []
    for made in learned_instances(scene):
        counts = bsdf_operations(made) if isinstance(made, mi.BSDF) else {}
        found.append({
            **plugins.origin(made),
            "id": made.id(),
            **(plugins.report(made) or {}),
            "operations": {method: n.asdict() for method, n in counts.items()},
            **({"rays": made.counts(scene)} if hasattr(made, "counts") and scene.sensors() else {}),
        })  # fmt: skip
    return found


def table_bytes(scene: str | os.PathLike, learned: list[dict]) -> int:
    """Bytes of all distinct tables that the learned plugins of a scene read, in their storage forms."""
    return sum(table.nbytes for table in tables_of(scene, learned).values())


def tables_of(scene: str | os.PathLike, learned: list[dict]) -> dict[tuple[str, str], object]:
    """The distinct tables of a scene's learned plugins: ``(file, storage)`` → :class:`~mi_diffind.tables.Table`."""
    found = {}
    for entry in learned:
        plugin = plugins.declared()[entry["plugin"]]
        if not plugin.task:
            continue
        name, storage = entry.get("filename", ""), entry.get("storage", "") or plugin.storage
        task = tasks()[plugin.task]
        file = task.file(name and Path(scene).resolve().parent / name, entry.get("preset", ""))
        if (str(file), storage) not in found:
            table = task.load(file)
            found[str(file), storage] = table.to(storage) if storage else table
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
        _, state = _parse(path, defines)
    found = [Path(file).resolve() for file in compat.parsed_files(state)]
    for props in compat.properties_of(state):
        texts = (props[k] for k in props if compat.property_kind(props, k) == "text")
        for file in (folder / text for text in texts if text):
            with contextlib.suppress(OSError, ValueError):  # any text may be asked for, and few are names of files
                if file.is_file():
                    found.append(file.resolve())
    return list(dict.fromkeys(found))


def _parse(path, defines: dict[str, str] | None) -> tuple:
    if not Path(path).is_file():
        raise RuntimeError(f"{path}: no such scene file")
    return compat.parse_file(path, defines)


def _path_integrator(state):
    integrators = compat.properties_of(state, mi.ObjectType.Integrator)
    found = [props for props in integrators if props.plugin_name() in MAX_DEPTHS]
    # One that has another integrator for its paths leaves the depth to that
    found = [
        props
        for props in found
        if props.plugin_name() != "neural_field"
        or not any(compat.property_kind(props, key) == "object" for key in props)
    ]
    if len(found) != 1:
        names = ", ".join(props.plugin_name() for props in integrators) or "none"
        raise RuntimeError(f"a depth needs one integrator of {', '.join(MAX_DEPTHS)}; found {names}")
    return found[0]


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
        message = compat.one_sentence(e)
        if path is not None and str(path) not in message:
            message = f"{path}: {message}"
        raise SceneError(message) from e
