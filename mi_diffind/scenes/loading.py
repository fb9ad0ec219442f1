"""Scene files: parsing, loading, rendering, and the learned plugins and tables that they name.

Everything here runs in the variant that is set.
"""

from __future__ import annotations

import contextlib
import copy
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import plugins
from ..core import compat, tensor_files, units
from ..core.errors import DiffindError, UsageError, raised_as
from ..core.files import check_scene_file, replacing
from ..core.runtime import use_variant
from ..core.threads import in_turn, threads_for_files
from ..fitting.task import tasks
from ..maps.entries import SourceError
from ..measure.clock import bsdf_operations
from ..plugins.support import footprint, omissions
from .models import is_model, model_scene

#: Parts that a scene needs to be rendered, beside objects and lights.
NEEDS = ("integrator", "sensor")

#: Bytes of memory of a channel of a pixel while a pass is rendered: of the film, the developed image, its copy in
#: single precision, and sums in double precision.
PIXEL_BYTES = 3 * 4 + 2 * 8


class SceneError(DiffindError, RuntimeError):
    """A scene cannot be loaded or rendered; the message is one sentence that names the file and the fault."""


def check_counterpart(name: str) -> None:
    """Raise :class:`SceneError` if no plugin has the counterpart ``name``."""
    if not plugins.with_counterpart(name):
        others = dict.fromkeys(c.name for plugin in plugins.declared().values() for c in plugin.others)
        raise SceneError(f'against: found "{name}", allowed are exact, {", ".join(others)}')


def check_renderable(scene, path: str | os.PathLike = "scene", needs: tuple[str, ...] = NEEDS) -> None:
    """Raise :class:`SceneError` if a loaded scene lacks what it ``needs`` to be rendered."""
    for name in needs:
        if not (scene.integrator() if name == "integrator" else scene.sensors()):
            example = {"integrator": "path", "sensor": "perspective"}[name]
            raise SceneError(f'{path}: has no {name}, one is needed, such as <{name} type="{example}">')


def check_size(scene, spp: int, size: tuple[int, int] | None = None) -> None:
    """Refuse a picture that takes more memory than this machine has, or too many samples per pixel.

    ``size`` is its width and height, by default that of the first sensor's film. Raises :class:`.UsageError`.
    """
    width, height = size or map(int, scene.sensors()[0].film().crop_size())
    channels = scene.sensors()[0].film().base_channels_count()
    units.check_memory("film", f"{width:,} x {height:,} pixels", width * height * channels * PIXEL_BYTES)
    units.check_samples(spp)


def warn_if_black(scene, path: str | os.PathLike, images) -> None:
    """Warn if all ``images`` of a loaded scene are black."""
    if not any(image[..., :3].any() for image in images):
        plugins.warn(f"{path}: the picture is black{'' if scene.emitters() else ', the scene has no emitter'}")


def check_measured(state) -> None:
    """Refuse damaged files of measured materials that a parsed scene names. Raises UsageError."""
    for props in compat.parsed_properties(state):
        if props.plugin_name() in ("measured", "measured_polarized") and "filename" in props:
            path = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
            if path.is_file():
                tensor_files.check(path, tensor_files.read(path))


#: Integrators that follow paths to a ``max_depth``, and the depth of each where the scene gives none (-1: infinite).
MAX_DEPTHS = {
    **dict.fromkeys(("path", "volpath", "volpathmis", "ptracer", "path_footprint", "path_sdf", "neural_field"), -1),
    **dict.fromkeys(("prb", "prb_basic", "prb_projective", "prbvolpath"), 6),
}


class ParsedScene:
    """Scene file or model (:mod:`.models`) ``source``, parsed once.

    ``defines`` (name → value) take the place of its ``<default>`` values.

    Answers questions about the file, and builds any number of scenes from it: each from a copy of the parsed state.
    The source may also be a dictionary, as of ``mi.load_dict``: ``path`` is then a name in the current folder, beside
    which relative names of files are sought. All methods raise :class:`SceneError`, as does the constructor for a
    scene that cannot be parsed, and :class:`.UsageError` for a source of another type.
    """

    #: Text that stands for a scene without a file, "" for a scene file.
    description = ""

    def __init__(self, source: str | os.PathLike | dict, defines: dict[str, str] | None = None, name: str = "scene"):
        in_memory = isinstance(source, dict)
        if not isinstance(source, (dict, str, os.PathLike)):
            loaded = isinstance(source, mi.Scene)
            found_type = "loaded scene, which cannot be changed any more" if loaded else type(source).__name__
            raise UsageError(f"scene: found a {found_type}; a scene file is needed, or a dictionary as of mi.load_dict")
        if in_memory and defines:
            raise UsageError("defines: given with a scene in memory, allowed are scene files")
        self.path = path = Path.cwd() / name if in_memory else Path(source)
        self.defines = {name: str(value) for name, value in (defines or {}).items()}
        self._resolver = None  # parsing adds the folders of <path> to it
        if not in_memory:
            with raised_as(SceneError, UsageError, SourceError):
                check_scene_file(path)
                self.path = path = model_scene(path) if is_model(path) else path
        with self._errors():
            if in_memory:
                _, self._state = compat.parse(source)
                self.description = _description(self._state)
                return
            _, self._state = compat.parse_file(path, self.defines)

    @contextlib.contextmanager
    def _errors(self):
        """Resolve file names beside the scene, and turn errors into a :class:`SceneError`."""
        with scene_errors(self.path), _resolving(self.path, self._resolver) as self._resolver:
            yield

    def load(
        self,
        exact: bool = False,
        longest_path: int | None = None,
        against: str | tuple[str, ...] = "exact",
        merge: bool = True,
        parallel: bool = True,
        needs: tuple[str, ...] = NEEDS,
    ):
        """Return a loaded scene, as :func:`load_file` does.

        With ``exact``, every plugin that has a counterpart called ``against`` is replaced by it (the first of several
        names that it has). ``longest_path`` replaces the ``max_depth`` of the scene's integrator (1: emitted light, 2:
        direct light, …; -1: infinite). Without ``merge``, Mitsuba joins no meshes, and each keeps its id. Without
        ``parallel``, the order of objects is the same in each run, and the kernels of an earlier run are found again.
        A scene without what it ``needs`` to be rendered is an error (:func:`check_renderable`).

        Shapes whose stored arrays the scene's integrator cannot trace are decoded, with a warning that states the
        memory, unless the scene forbids decoding; then this is an error.
        """
        with self._errors():
            config, state = compat.copy_state(self._state)
            if not merge:
                compat.keep_meshes(config)
            config.parallel = parallel
            for props, plugin in _replaceable(state, against) if exact else ():
                plugin.counterpart(against).replace(props)
            if longest_path is not None:
                _path_integrator(state)["max_depth"] = longest_path
            integrators = _integrators(state) or ["path"]  # used by commands for a scene without an integrator
            loaded = _build(config, state, integrators, _refuse)
            if not isinstance(loaded, mi.Scene):
                raise RuntimeError(f"{self.path}: holds a {type(loaded).__name__}, a scene is expected")
            check_renderable(loaded, self.path, needs)
            return loaded

    def change(self, change: Callable[[object], object]):
        """Change the parsed scene (``mi.parser.ParserState``) for good by ``change(state)``, and return its result."""
        with self._errors():
            return change(self._state)

    def copy(self) -> ParsedScene:
        """Return a copy, which may be changed."""
        other = copy.copy(self)
        other._state = self._copy()
        return other

    def _copy(self):
        """Return a copy of the parsed state to read: Mitsuba takes a parameter that was read once for a known one."""
        return compat.copy_state(self._state)[1]

    def path_integrator(self) -> tuple[str, int]:
        """Return the plugin name and the ``max_depth`` of the integrator that follows the scene's paths.

        It may be nested in others, like ``aov``. A scene with none of :data:`MAX_DEPTHS`, or with several, is an error.
        """
        with self._errors():
            props = _path_integrator(self._copy())
            name = props.plugin_name()
            return name, int(props.get("max_depth", MAX_DEPTHS[name]))

    def load_integrator(self, longest_path: int):
        """Return the integrator of :meth:`path_integrator` alone, with another ``max_depth``."""
        with self._errors():
            props = mi.Properties(_path_integrator(self._copy()))
            props["max_depth"] = longest_path
            return mi.PluginManager.instance().create_object(props)

    def learned_plugins(self, against: str | tuple[str, ...] = "exact") -> list[dict]:
        """Return the descriptions (:meth:`.plugins.Plugin.describe`) of the learned plugins, in the file's order.

        With ``against``, of all plugins that have the counterpart of this name, or of one of these names.
        """
        with self._errors():
            return [plugin.describe(props) for props, plugin in _replaceable(self._copy(), against)]

    def tables(self, learned: list[dict]) -> dict[tuple[str, str], object]:
        """Return the distinct tables of learned plugins: ``(file, storage)`` → :class:`.Table`.

        ``learned`` are descriptions from :meth:`learned_plugins`.
        """
        tables = {}
        for entry in learned:
            plugin = plugins.declared()[entry["plugin"]]
            if plugin.task:
                name, storage = entry.get("filename", ""), entry.get("storage", "") or plugin.storage
                task = tasks()[plugin.task]
                file = task.file(name and self.path.resolve().parent / name, entry.get("preset", ""))
                if (str(file), storage) not in tables:
                    table = task.load(file)
                    tables[str(file), storage] = table.to(storage) if storage else table
        return tables

    def table_bytes(self, learned: list[dict]) -> int:
        """Return the bytes of all distinct tables that learned plugins read, in their storage forms."""
        return sum(table.nbytes for table in self.tables(learned).values())

    def files(self) -> list[Path]:
        """Return the files that the scene consists of: itself, the files that it includes and those that it names."""
        with self._errors():
            state = self._copy()
            files = [Path(file).resolve() for file in compat.parsed_files(state)]
            for props in compat.parsed_properties(state):
                texts = (props[k] for k in props if compat.property_kind(props, k) == "text")
                for file in (self.path.resolve().parent / text for text in texts if text):
                    with contextlib.suppress(OSError, ValueError):  # most texts are no names of files
                        if file.is_file():
                            files.append(file.resolve())
            return list(dict.fromkeys(files))


def _description(state) -> str:
    """Return a parsed scene as text: equal texts stand for equal scenes, without the content of files.

    Objects that exist already, such as bitmaps, have no such text: the result is then another one each time.
    """
    nodes = compat.parsed_properties(state)
    existing = any(compat.property_kind(props, key) == "existing" for props in nodes for key in props)
    return "\n".join([os.urandom(16).hex() if existing else "", *map(str, nodes)])


@in_turn
def load(path: str | os.PathLike, defines: dict[str, str] | None = None, **options):
    """Return the loaded scene of a file; ``options`` are those of :meth:`ParsedScene.load`. It ``needs`` nothing."""
    return ParsedScene(path, defines).load(**{"needs": (), **options})


@in_turn
def load_file(path: str | os.PathLike, parallel: bool = True, optimize: bool = True, **defines):
    """Load a scene file as ``mi.load_file`` does, prepared for filtering textures and for stored shapes.

    ``defines`` replace the scene's ``<default>`` values; ``parallel`` and ``optimize`` are Mitsuba's own arguments.
    Beyond ``mi.load_file``, textures that filter themselves learn which sensor sees them: the first one of the scene,
    at the samples of its sampler (:func:`.plugins.support.footprint.attach`). Shapes whose stored arrays the scene's
    integrator cannot trace are decoded, with a warning that states the memory. If the scene forbids decoding, or has
    no integrator (another one may be meant), a warning says that such shapes stay invisible. Raises what
    ``mi.load_file`` raises.
    """
    use_variant()
    if not Path(path).is_file():
        return mi.load_file(str(path))
    with _resolving(path):
        return _build_as(*compat.parse_file(path, defines), parallel, optimize)


@in_turn
def load_dict(scene: dict, parallel: bool = True, optimize: bool = True):
    """Load a scene or an object from a dictionary as ``mi.load_dict`` does, prepared as by :func:`load_file`."""
    use_variant()
    return _build_as(*compat.parse(scene), parallel, optimize)


@in_turn
def load_string(text: str, parallel: bool = True, optimize: bool = True, **defines):
    """Load a scene from a text of XML as ``mi.load_string`` does, prepared as by :func:`load_file`."""
    use_variant()
    return _build_as(*compat.parse(text, defines), parallel, optimize)


def _build_as(config, state, parallel: bool, optimize: bool):
    """Instantiate a parsed scene with Mitsuba's own arguments; what no integrator traces is a warning."""
    compat.build_as(config, parallel, optimize)
    return _build(config, state, _integrators(state), plugins.warn)


def attach(scene, sensor=0, spp: int | None = None):
    """Prepare a scene that Mitsuba itself loaded, and return it.

    Textures that filter themselves learn which ``sensor`` of the scene sees them (a number or a ``mi.Sensor``), at
    ``spp`` samples per pixel (default: those of its sampler). Call this again after a change of the sensor. A warning
    names shapes whose stored arrays the scene's integrator cannot trace; :func:`load_dict` and :func:`load_file` decode
    them. Raises :class:`SceneError` if there is no such sensor.
    """
    if isinstance(sensor, int) and not 0 <= sensor < len(scene.sensors()) and footprint.textures(scene):
        raise SceneError(f"sensor: found {sensor}, the scene has {len(scene.sensors())}")
    footprint.attach(scene, sensor, spp)
    omissions.check(scene)
    return scene


def _build(config, state, integrators: list[str], report: Callable[[str], None]):
    """Instantiate a parsed scene; ``report`` is called with a sentence about a shape that no integrator traces."""
    check_measured(state)
    decoded = _decode_unseen(state, integrators) if integrators else []
    with threads_for_files():
        loaded = compat.instantiate(config, state)
    if isinstance(loaded, mi.Scene):
        unseen = _unseen(loaded, integrators)
        if unseen:
            report(unseen)
            omissions.settle(instance for instance in instances(loaded) if hasattr(instance, "seen_by"))
        _warn_decoded(loaded, decoded, integrators)
        footprint.attach(loaded)
    return loaded


def _refuse(sentence: str):
    raise RuntimeError(sentence)


def _integrators(state) -> list[str]:
    """Return the plugin names of all integrators of a parsed scene, nested ones included."""
    return [props.plugin_name() for props in integrator_properties(state)]


def integrator_properties(state) -> list:
    """Return the properties of all integrators of a parsed scene, nested ones included."""
    names = {name for name, plugin in plugins.declared().items() if plugin.object_type == "integrator"}
    return compat.parsed_properties(state, mi.ObjectType.Integrator, names | set(MAX_DEPTHS))


def _path_integrator(state):
    """Return the properties of the one integrator that follows the paths of a parsed scene."""
    integrators = integrator_properties(state)
    following = [
        props for props in integrators if props.plugin_name() in MAX_DEPTHS
        # A radiance field leaves the paths to the integrator that is nested in it
        and not (props.plugin_name() == "neural_field" and nests_another(props))
    ]  # fmt: skip
    if len(following) != 1:
        names = ", ".join(props.plugin_name() for props in integrators) or "none"
        raise RuntimeError(f"a depth needs one integrator of {', '.join(MAX_DEPTHS)}; found {names}")
    return following[0]


def nests_another(props) -> bool:
    """Return whether the properties of an integrator contain another object."""
    return any(compat.property_kind(props, key) == "object" for key in props)


def _replaceable(state, against: str | tuple[str, ...]) -> list[tuple]:
    """Return ``(properties, plugin)`` of all nodes whose plugin has the counterpart ``against``."""
    declared = plugins.declared()
    nodes = [(props, declared.get(props.plugin_name())) for props in compat.parsed_properties(state)]
    return [(props, plugin) for props, plugin in nodes if plugin and plugin.counterpart(against)]


def _decode_unseen(state, integrators: list[str]) -> list[str]:
    """Have shapes decoded whose arrays none of the ``integrators`` traces, and return their ids.

    Left out are shapes for which the scene states how they are traced, or that their arrays are optimised.
    """
    ids = []
    for props in compat.parsed_properties(state):
        plugin = plugins.declared().get(props.plugin_name())
        if plugin is None or plugin.otherwise is None or _sees(integrators, plugin.seen_by):
            continue
        key, value = plugin.otherwise
        if key not in props and not ("storage" in props and props["storage"] == "float32"):
            props[key] = value
            ids.append(props.id())
    return ids


def _sees(integrators: list[str], seen_by: tuple[str, ...]) -> bool:
    """Return whether integrators see a shape that those called ``seen_by`` see; ``aov`` intersects rays itself."""
    return bool(set(seen_by) & set(integrators)) and "aov" not in integrators


def _warn_decoded(scene, ids: list[str], integrators: list[str]) -> None:
    """Warn of each shape that was decoded because the ``integrators`` cannot trace its arrays."""
    names = ", ".join(f'"{name}"' for name in integrators)
    for instance in instances(scene) if ids else ():
        origin, report = plugins.origin(instance), plugins.report(instance) or {}
        if origin["id"] in ids and "decoded" in report:
            plugins.warn(f"{origin['filename']}, whose arrays {names} does not see, is {report['decoded']}")


def _unseen(scene, integrators: list[str]) -> str:
    """Return a sentence about a shape that none of the ``integrators`` traces, "" if there is none."""
    for instance in instances(scene):
        seen_by = getattr(instance, "seen_by", None)
        if seen_by and not _sees(integrators, seen_by):
            allowed = " or ".join(f'"{name}"' for name in seen_by)
            present = ", ".join(f'"{name}"' for name in integrators) or "none"
            return (
                f'the shape "{instance.id()}" ({plugins.origin(instance)["plugin"]}) is seen by the integrator '
                f'{allowed} alone, found {present}: take that one, or trace="grid"'
            )
    return ""


def instances(scene) -> list:
    """Return all Mitsuba objects of a loaded scene that the package's plugins created, each once.

    Nested objects (in a ``twosided``, a ``bumpmap``, …) are included.
    """
    # All nodes, not only owners of parameters: tables of bytes are no parameters
    return [node for node in compat.scene_objects(scene) if plugins.origin(node) is not None]


def learned_instances(scene) -> list:
    """Return the :func:`instances` of learned plugins."""
    learned = plugins.with_counterpart()
    return [instance for instance in instances(scene) if plugins.origin(instance)["plugin"] in learned]


def reports(scene) -> list[dict]:
    """Return a report on each learned plugin of a loaded scene.

    It has the description of :meth:`ParsedScene.learned_plugins`; the plugin's own report, ``preset``,
    ``effects_in_use``, ``effects_left_out`` (effect → reason), ``evaluated_once``, ``storage``, ``table_bytes`` and
    more; for a BSDF the ``operations`` of ``eval``, ``pdf`` and ``sample``
    (:class:`~mi_diffind.measure.clock.Operations`, by name); for the integrator of a radiance field, how many
    steps of ``rays`` are taken, skipped, … (:func:`~mi_diffind.tasks.radiance.march.count`).
    """
    return [instance_report(instance, scene) for instance in learned_instances(scene)]


def instance_report(instance, scene) -> dict:
    """Return the report (:func:`reports`) on one of the :func:`instances` of a loaded scene, or of another object."""
    counts = bsdf_operations(instance) if isinstance(instance, mi.BSDF) else {}
    counted = hasattr(instance, "counts") and isinstance(scene, mi.Scene) and scene.sensors()
    return {
        **plugins.origin(instance),
        "id": instance.id(),
        **(plugins.report(instance) or {}),
        "operations": {method: n.asdict() for method, n in counts.items()},
        **({"rays": instance.counts(scene)} if counted else {}),
    }


def film_size(scene) -> tuple[int, int]:
    """Return the width and height, in pixels, of the images of a scene's first sensor."""
    width, height = scene.sensors()[0].film().crop_size()
    return int(width), int(height)


def bounds(shapes) -> np.ndarray:
    """Return the corners ``(2, 3)`` of the box around shapes; they are infinite if there are none."""
    boxes = np.array([[s.bbox().min, s.bbox().max] for s in shapes], np.float64).reshape(-1, 2, 3)
    return np.stack([boxes[:, 0].min(axis=0, initial=np.inf), boxes[:, 1].max(axis=0, initial=-np.inf)])


def sample_counts(scene, spp: int, passes: int = 1) -> list[int]:
    """Return the samples a pixel of each pass of :func:`render`: samplers other than ``independent`` may round up."""
    counts = [(i + 1) * spp // passes - i * spp // passes for i in range(passes)]
    taken = {count: sampler_count(scene.sensors()[0], count) for count in set(counts)}
    return [taken[count] for count in counts]


def sampler_count(sensor, spp: int) -> int:
    """Return the samples a pixel that the sampler of a sensor takes for ``spp``."""
    sampler = sensor.sampler().clone()
    sampler.set_sample_count(spp)
    return sampler.sample_count()


def samples_text(figures: dict) -> str:
    """Return ``spp`` of the figures of a render as text, with the reason if it is not ``spp_requested``."""
    spp, requested = figures["spp"], figures["spp_requested"]
    if figures["interrupted"]:
        return f"interrupted, kept {spp} of {requested} spp"
    return f"{spp} spp" if spp == requested else f"{spp} spp ({requested} requested, the sampler adds some)"


def render(
    scene,
    spp: int | None = None,
    seed: int = 0,
    passes: int = 1,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> tuple[np.ndarray, list[float]]:
    """Render in ``passes`` of about ``spp / passes`` samples a pixel each and average them.

    Returns the linear image ``(height, width, channels)``, float32, and the seconds of each pass (the first includes
    compilation). ``on_pass()`` is called after each pass. Once ``stop`` is set, the running pass is the last, and the
    image is the average of ``len(seconds)`` passes, of :func:`sample_counts` each. The same arguments give the same
    image if the film's filter is a box (other filters add up samples of neighbouring pixels in any order) and the
    samples of a pass are a power of two (else the last bit of a few pixels varies).
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
    """Render one pass, ``(height, width, channels)``, float64; ``seed`` is Mitsuba's own, modulo 2³²."""
    check_size(scene, spp)
    with scene_errors(None):
        return mi.render(scene, spp=spp, seed=seed % 2**32).numpy().astype(np.float64)


def colour_channels(image):
    """Drop alpha and other channels that are no colour from an image ``(height, width, channels)``, array or tensor."""
    count = 3 if image.shape[2] >= 3 else 1
    return image if image.shape[2] == count else image[:, :, :count]


def write_image(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write a linear image: ``.exr`` as 32-bit floats, ``.png`` or ``.jpg`` as displayed."""
    with replacing(path) as temporary, threads_for_files():
        bitmap = mi.Bitmap(np.ascontiguousarray(image, dtype=np.float32))
        if Path(path).suffix.lower() == ".exr":
            bitmap.write(str(temporary))
        else:
            mi.util.write_bitmap(str(temporary), bitmap, write_async=False)


@contextlib.contextmanager
def _resolving(path, resolver=None):
    """Look for relative file names beside the scene, as ``mi.load_file`` does; yield the resolver.

    ``resolver``: an earlier one for the same scene.
    """
    before = mi.file_resolver()
    if resolver is None:
        resolver = mi.FileResolver(before)
        resolver.prepend(str(Path(path).resolve().parent))
    mi.set_file_resolver(resolver)
    try:
        yield resolver
    finally:
        mi.set_file_resolver(before)


@contextlib.contextmanager
def scene_errors(path):
    """Turn Mitsuba's nested messages into a :class:`SceneError` of one sentence that names ``path``."""
    try:
        yield
    except SceneError:
        raise
    except (RuntimeError, TypeError, ValueError, OSError) as e:
        message = compat.one_sentence(e)
        if path is not None and str(path) not in message:
            message = f"{path}: {message}"
        raise SceneError(message) from e
