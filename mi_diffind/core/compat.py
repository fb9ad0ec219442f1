"""Uses of private interfaces of Mitsuba 3.9 and Dr.Jit 1.5, one per function.

Each has a test, in ``tests/test_compat.py`` or of its callers. Mitsuba and Dr.Jit are imported when a
function is called, so that this module may be imported before LLVM is chosen (:mod:`.runtime`).
"""

import contextlib
import ctypes
import importlib
import os
import re
import struct
import sys
import threading
from pathlib import Path


class _Lazy:
    """Module that is imported when an attribute is asked for."""

    def __init__(self, name: str):
        self._name = name

    def __getattr__(self, attribute: str):
        return getattr(importlib.import_module(self._name), attribute)


dr, mi = _Lazy("drjit"), _Lazy("mitsuba")


def llvm_version() -> tuple[int, int, int]:
    """Return the version of the LLVM that Dr.Jit has loaded, -1 first if none; waits for its start."""
    return tuple(dr.detail.llvm_version())


def core_library() -> str:
    """Return the path of Dr.Jit's native library."""
    name = {"linux": "libdrjit-core.so", "darwin": "libdrjit-core.dylib"}.get(sys.platform, "drjit-core.dll")
    return os.path.join(os.path.dirname(dr.__file__), name)


class JitCore:
    """C++ functions of Dr.Jit's library by their mangled names (Itanium ABI), which change with their signatures.

    These are ``jit_shutdown(int)``, ``jit_init(uint32_t)``, ``jit_launch_stats(size_t *, size_t *, size_t *)`` and
    ``jit_registry_id_bound(const char *, const char *)``. Raises ``OSError`` or ``AttributeError`` if one is missing.
    """

    #: Backends as bits of the mask that ``jit_init`` takes.
    CUDA = 1 << 1
    LLVM = 1 << 2

    #: Classes of scene objects under which Mitsuba registers them with Dr.Jit.
    DOMAINS = ("Texture", "BSDF", "Shape", "Emitter", "Sensor", "Scene", "Sampler", "Film")

    def __init__(self):
        core = ctypes.CDLL(core_library())
        self._shutdown, self._init = core["_Z12jit_shutdowni"], core["_Z8jit_initj"]
        self._launch_stats, self._id_bound = core["_Z16jit_launch_statsPmS_S_"], core["_Z21jit_registry_id_boundPKcS0_"]
        self._id_bound.argtypes, self._id_bound.restype = [ctypes.c_char_p] * 2, ctypes.c_uint32

    def launches(self) -> int:
        """Return the number of kernels launched since the start."""
        counts = [ctypes.c_size_t() for _ in range(3)]
        self._launch_stats(*map(ctypes.byref, counts))
        return counts[0].value

    def holds_objects(self, variant: str) -> bool:
        """Return whether scene objects of this Mitsuba variant exist."""
        return any(self._id_bound(variant.encode(), domain.encode()) for domain in self.DOMAINS)

    def shutdown(self) -> None:
        """Stop all backends; variables survive, kernels and registered objects do not."""
        self._shutdown(0)

    def init(self, backend: int) -> None:
        """Start a backend: :attr:`LLVM` or :attr:`CUDA`."""
        self._init(backend)


def new_scope(dtype) -> None:
    """Start a scope: Dr.Jit merges no later computation of the backend of ``dtype`` with an earlier one."""
    dr.detail.new_scope(dr.backend_v(dtype))


def kernel_code(entry: dict) -> str:
    """Return the intermediate code of an entry of ``dr.kernel_history()``: LLVM's or PTX."""
    return entry["ir"].getvalue()


def llvm_target(code: str) -> tuple[str, int] | None:
    """Return the processor and the lanes of vectors in LLVM code; ``None`` if they are not found."""
    name, width = re.search(r'"target-cpu"="([^"]+)"', code), re.search(r"<(\d+) x float>", code)
    return (name[1], int(width[1])) if name and width else None


def kernel_seconds(history: list[dict]) -> float:
    """Return the seconds that the kernels of a ``dr.kernel_history()`` took (which has milliseconds)."""
    return sum(entry["execution_time"] for entry in history) / 1e3


def compile_seconds(history: list[dict]) -> float:
    """Return the seconds that the compilation of the kernels of a ``dr.kernel_history()`` took."""
    return sum(entry.get("backend_time", 0.0) for entry in history) / 1e3


def was_compiled(history: list[dict]) -> bool:
    """Return whether a kernel of a ``dr.kernel_history()`` was compiled or fetched from the disk."""
    return any(not entry.get("cache_hit", True) or entry.get("cache_disk", False) for entry in history)


@contextlib.contextmanager
def room_for_sums(entries: int):
    """Let each core sum the gradients of arrays by itself, up to ``entries`` in the copies of all cores together."""
    before = dr.expand_threshold()
    dr.set_expand_threshold(max(before, entries // dr.thread_count()))
    try:
        yield
    finally:
        dr.set_expand_threshold(before)


def use_threads(count: int) -> None:
    """Compute on ``count`` cores, after waiting for all computations.

    A sum in progress has a place for each thread at its start, and Dr.Jit does not check for one.
    """
    if count != dr.thread_count():
        dr.eval()
        dr.sync_thread()
        dr.set_thread_count(count)


def backend_module(array):
    """Return the module with the types of the same backend as an array or type, such as ``drjit.llvm.ad``."""
    return sys.modules[(array if isinstance(array, type) else type(array)).__module__]


def has_gradient(value) -> bool:
    """Return whether a derivative with respect to this array is tracked, also where derivatives are suspended."""
    if dr.is_tensor_v(value):
        return value.array.index_ad != 0
    if dr.depth_v(value) > 1:
        return any(has_gradient(v) for v in value)
    return dr.is_diff_v(value) and value.index_ad != 0


#: Held while a syntax tree is made. Mitsuba loads plugins in several threads, and CPython 3.11 keeps one depth of
#: syntax trees for all of them: where two meet, "SystemError: AST constructor recursion depth mismatch" may end one.
SYNTAX_TREES = threading.RLock()


def syntax(function):
    """Apply ``dr.syntax`` to a function while no other thread makes a syntax tree."""
    with SYNTAX_TREES:
        return dr.syntax(function)


def identity(value) -> tuple:
    """Return the indices of Dr.Jit's variables, which identify the content of an array as long as the array is kept."""
    if dr.is_tensor_v(value):
        return identity(value.array)
    if dr.depth_v(value) > 1:
        return tuple(i for v in value for i in identity(v))
    return (value.index,) if dr.is_jit_v(value) else (value,)


def adam_state(optimizer) -> dict[str, tuple]:
    """Return the state of an ``Adam``: name → parameter, number of the step, and both moments (flat)."""
    return {key: (value, t, m, v) for key, (value, _, _, (t, m, v, _)) in optimizer.state.items()}


def set_adam_state(optimizer, key: str, value, t, m, v) -> None:
    """Set the state of the parameter ``key`` of an ``Adam``, from :func:`adam_state` or NumPy arrays and a number."""
    old, promoted, rate, (t_old, m_old, v_old, v_max) = optimizer.state[key]
    new = type(old)(value)
    dr.make_opaque(new)
    dr.enable_grad(new)
    optimizer.state[key] = new, promoted, rate, (type(t_old)(t), type(m_old)(m), type(v_old)(v), v_max)


def on_variant_change(callback) -> None:
    """Call ``callback(old, new)`` after each ``mi.set_variant``; the same function is registered once."""
    mi.detail.add_variant_callback(callback)


#: Mitsuba's class of integrators that read no textures.
UNTEXTURED = "DepthIntegrator"

#: Mitsuba's class of integrators that intersect rays with the scene beside their nested integrators.
INTERSECTING = "AOVIntegrator"

#: Mitsuba's classes of constant textures. ``is_spatially_varying`` is also false for ``mesh_attribute``, which varies.
CONSTANT_TEXTURES = ("UniformSpectrum", "SRGBReflectanceSpectrum")


def texture_class(texture) -> str:
    """Return Mitsuba's name of a texture's class, ``""`` for a class written in Python, which may have any name."""
    return texture.class_name() if type(texture).__module__.startswith("mitsuba") else ""


def is_constant_texture(texture) -> bool:
    """Return whether a texture is one of :data:`CONSTANT_TEXTURES`."""
    return texture_class(texture) in CONSTANT_TEXTURES


def is_uniform_spectrum(texture) -> bool:
    """Return whether a texture is constant over wavelengths, too. Its parameter is then ``value``."""
    return texture_class(texture) == "UniformSpectrum"


def is_bitmap(texture) -> bool:
    """Return whether a texture is a ``bitmap`` of any storage. Its parameter is then ``data``."""
    return texture_class(texture).startswith("BitmapTextureImpl")


def srgb_coefficients() -> tuple:
    """Return Mitsuba's table for spectra from colours (Jakob and Hanika 2019).

    Returned are its side ``n``, the positions ``(n,)`` along the largest component, and the coefficients ``(3·n³, 3)``,
    all float32. Raises ``RuntimeError`` in one sentence.
    """
    import numpy as np

    path = mi.file_resolver().resolve("data/srgb.coeff")
    content = Path(str(path)).read_bytes()
    side = struct.unpack("<I", content[4:8])[0] if len(content) >= 8 else 0
    count = 3 * side**3
    if content[:4] != b"SPEC" or len(content) < 8 + 4 * side + 12 * count:
        raise RuntimeError(f"{path}: is not the table of coefficients that is expected of Mitsuba")
    positions = np.frombuffer(content, "<f4", side, 8)
    return side, positions, np.frombuffer(content, "<f4", 3 * count, 8 + 4 * side).reshape(count, 3)


def normal_edges(pi, si, ray, active) -> tuple:
    """Return two vectors in space along which the shading normal changes by ``si.dn_du`` and ``si.dn_dv``.

    They are ``mi.Vector3f``; ``si`` is that of ``pi`` with derivatives of normals (:func:`.ray_flags`). The vectors are
    ``dp_du`` and ``dp_dv``, but edges of the triangle for meshes, where Mitsuba 3.9 gives derivatives in barycentric
    coordinates.
    """
    mesh = active & si.is_valid() & si.shape.is_mesh()
    edges = []
    for step, otherwise in (((1, 0), si.dp_du), ((0, 1), si.dp_dv)):
        moved = mi.PreliminaryIntersection3f(pi)
        moved.prim_uv = pi.prim_uv + mi.Point2f(*step)
        place = moved.compute_surface_interaction(ray, mi.RayFlags.Minimal, mesh).p
        edges.append(dr.detach(dr.select(mesh, place - si.p, otherwise)))
    return tuple(edges)


def replay_integrator() -> type:
    """Return ``RBIntegrator`` of the active variant, the base class of integrators that replay paths.

    Mitsuba loads it anew *after* it called the function of :func:`on_variant_change`.
    """
    return mi.ad.integrators.common.RBIntegrator


def written_in_python(integrator) -> bool:
    """Return whether an integrator is written in Python upon Mitsuba's base classes, whose ``sample`` takes a mode."""
    return isinstance(integrator, mi.CppADIntegrator)


def integrator_name(integrator) -> str:
    """Return the name of an integrator's class, in Python or C++."""
    if type(integrator).__module__ == "mitsuba":
        return integrator.class_name()
    return type(integrator).__name__


def replays_paths(integrator) -> bool:
    """Return whether an integrator derives from :func:`replay_integrator`'s class, by the name of that class."""
    return any(base.__name__ == "RBIntegrator" for base in type(integrator).__mro__)


def samples_in_python(integrator) -> bool:
    """Return whether an integrator derives from ``ADIntegrator``; its ``sample`` takes a mode."""
    return isinstance(integrator, mi.ad.integrators.common.ADIntegrator)


def splat(block, film, place, light, alpha, aovs: list, wavelengths) -> None:
    """Put samples into an image block, with further channels ``aovs``, as Mitsuba's integrators in Python do."""
    put = mi.ad.integrators.common.ADIntegrator._splat_to_block
    put(block, film, place, value=light, weight=1.0, alpha=alpha, aovs=aovs, wavelengths=wavelengths)


def scene_objects(scene) -> list:
    """Return all objects of a loaded scene, each once, nested ones too (in a ``twosided``, a ``bumpmap``, …)."""
    return nodes_of(mi.traverse(scene))


def nodes_of(params) -> list:
    """Return all objects that ``params`` (``mi.SceneParameters``) traverse, each once."""
    return list({id(node): node for node in params.hierarchy}.values())


def visited_objects(cb) -> list:
    """Return the objects that ``mi.traverse`` has visited so far; none of a traversal by Mitsuba itself."""
    return list(getattr(cb, "hierarchy", ()))


def is_instance(shape) -> bool:
    """Return whether a shape is an ``instance`` of a ``shapegroup``."""
    return shape.class_name() == "Instance"


def is_shared(holder: list) -> bool:
    """Return whether anything but the list ``holder`` refers to its first item, an object of Mitsuba's own.

    Classes of Mitsuba's objects allow no weak references, but references from C++ count in Python, too. The number that
    ``sys.getrefcount`` adds by itself differs between versions of Python, so it is measured on a new object.
    """

    def references(holder: list) -> int:
        return sys.getrefcount(holder[0])

    return references(holder) > references([object()])


def parse_file(path: str | os.PathLike, defines: dict[str, str] | None = None) -> tuple:
    """Return the configuration and the state of a parsed scene file, before anything is built.

    ``defines`` are its ``<default>`` values.
    """
    config = mi.parser.ParserConfig(mi.variant())
    return config, mi.parser.parse_file(config, str(path), **{k: str(v) for k, v in (defines or {}).items()})


def parse(scene: dict | str, defines: dict[str, str] | None = None) -> tuple:
    """Return the configuration and the state of a scene that is a dictionary or a text of XML."""
    config = mi.parser.ParserConfig(mi.variant())
    if isinstance(scene, dict):
        return config, mi.parser.parse_dict(config, scene)
    return config, mi.parser.parse_string(config, scene, **{k: str(v) for k, v in (defines or {}).items()})


def copy_state(state) -> tuple:
    """Return a configuration and a copy of a parsed scene's state, since :func:`instantiate` changes the state."""
    return mi.parser.ParserConfig(mi.variant()), mi.parser.ParserState(state)


def instantiate(config, state):
    """Build the parsed scene: transform and merge it, in place, as ``mi.load_file`` does."""
    mi.parser.transform_all(config, state)
    return mi.parser.instantiate(config, state)


def keep_meshes(config) -> None:
    """Keep all meshes of a parsed scene apart, where Mitsuba joins those of one material by default."""
    config.merge_meshes = False


def build_as(config, parallel: bool, optimize: bool) -> None:
    """Build a parsed scene as ``mi.load_file`` does with these arguments."""
    config.parallel, config.merge_equivalent, config.merge_meshes = parallel, optimize, optimize


def parsed_properties(state, object_type=None, names=()) -> list:
    """Return the properties (``mi.Properties``) of all objects of a parsed scene, or of one ``mi.ObjectType``.

    Changing them changes the scene. In dictionaries, Mitsuba does not know the type of plugins that are written in
    Python: ``names`` are those of this type.
    """

    def wanted(node) -> bool:
        return object_type is None or node.type == object_type or node.props.plugin_name() in names

    return [node.props for node in state.nodes if wanted(node)]


def parsed_types(state) -> list:
    """Return the ``mi.ObjectType`` of all objects of a parsed scene, in the order of :func:`parsed_properties`."""
    return [node.type for node in state.nodes]


def parsed_references(state) -> list[dict[str, int]]:
    """Return for each object of a parsed scene, in the order of :func:`parsed_properties`, those it nests or refers to.

    They are indices in that order, by the name of the parameter. References are resolved only when a scene is built.
    Raises ``RuntimeError`` for an id that does not exist.
    """
    types, result = mi.Properties.Type, []
    for props in parsed_properties(state):
        values = {key: props[key] for key in props if props.type(key) in (types.Reference, types.ResolvedReference)}
        for value in values.values():
            if not hasattr(value, "index") and value.id() not in state.id_to_index:
                raise RuntimeError(f'refers to the id "{value.id()}", which no object has')
        result.append({k: v.index() if hasattr(v, "index") else state.id_to_index[v.id()] for k, v in values.items()})
    return result


def parsed_walk(state) -> list[int]:
    """Return the objects that belong to a parsed scene, from its root on, each before those it nests or refers to.

    Objects that nothing refers to any more are left out.
    """
    references, reached, waiting = parsed_references(state), {}, [0]
    while waiting:
        if (index := waiting.pop()) not in reached:
            reached[index] = None
            waiting += reversed(references[index].values())
    return list(reached)


def parsed_place(state, index: int) -> str:
    """Return the file, line and column of an object of a parsed scene."""
    return mi.parser.file_location(state, state.nodes[index])


def parsed_offsets(state) -> list[tuple[int, int]]:
    """Return for each object of a parsed scene the number of its file, and the byte of UTF-8 behind its "<"."""
    return [(node.file_index, node.offset) for node in state.nodes]


def parsed_files(state) -> list[str]:
    """Return the files that were parsed: the scene and the files that it includes."""
    return [str(file) for file in state.files]


def property_kind(props, key: str) -> str:
    """Return the type of a parsed parameter as a word.

    It is ``number``, ``colour``, ``text``, ``object`` (nested or referred to), ``existing`` (an object that exists
    already) or ``other``.
    """
    types, parameter = mi.Properties.Type, props.type(key)
    if parameter in (types.Float, types.Integer):
        return "number"
    if parameter in (types.Reference, types.ResolvedReference):
        return "object"
    words = {types.Color: "colour", types.String: "text", types.Object: "existing", types.Any: "existing"}
    return words.get(parameter, "other")


@contextlib.contextmanager
def film_size(sensor, width: int, height: int):
    """Give the film of a loaded sensor another size (pixels) while the context is open; yield whether that is possible.

    A film with a crop window keeps its size.
    """
    film, params = sensor.film(), mi.traverse(sensor)
    before = [int(n) for n in film.size()]
    if "film.size" not in params or before != [int(n) for n in film.crop_size()]:
        yield False
        return
    try:
        params["film.size"] = mi.ScalarVector2u(width, height)
        params.update()
        yield True
    finally:
        params["film.size"] = mi.ScalarVector2u(*before)
        params.update()


def one_sentence(error: BaseException) -> str:
    """Return the message of an error without the layers that Mitsuba and Dr.Jit put around it.

    Mitsuba prefixes source lines (``[file.cpp:12]``), embeds Python tracebacks, and hides the cause of an error at
    render time behind ``drjit.custom(...) error``.
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


def ray_flags(curvature: bool = False) -> int:
    """Return the ``mi.RayFlags`` for all of an interaction, with ``curvature`` also the derivatives of normals."""
    return mi.RayFlags.All | mi.RayFlags.dNSdUV if curvature else mi.RayFlags.All


def register(object_type: str, name: str, factory) -> None:
    """Register a plugin with the variant that is set; Mitsuba looks volumes up among textures."""
    getattr(mi, f"register_{'texture' if object_type == 'volume' else object_type}")(name, factory)


def set_triangles(params, positions, faces) -> None:
    """Set the places ``(n, 3)`` and the triangles ``(m, 3)`` of a traversed mesh, NumPy arrays, without an update."""
    import numpy as np

    positions, faces = np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces, np.uint32)
    params["vertex_positions"], params["faces"] = positions.ravel(), faces.ravel()


def triangles(mesh) -> tuple:
    """Return the places ``(n, 3)`` and the triangles ``(m, 3)`` of a ``mi.Mesh`` as NumPy arrays."""
    return mesh.vertex_positions_buffer().numpy().reshape(-1, 3), mesh.faces_buffer().numpy().reshape(-1, 3)


def owned(array):
    """Return a copy of an evaluated array in memory of Dr.Jit, with the same derivatives; others as they are.

    Where a virtual call reads an array, a frozen function (``dr.freeze`` of Dr.Jit 1.5) takes the address of memory
    that Dr.Jit did not allocate, such as NumPy's, for a constant. No public function tells or copies such memory.
    """
    if array.state != dr.VarState.Evaluated:
        return array
    # Adding −0 changes no number, not even −0; denormal ones may become 0
    copy = dr.detach(array) + dr.opaque(type(array), -0.0 if dr.is_float_v(array) else 0)
    dr.eval(copy)
    return dr.replace_grad(copy, array) if has_gradient(array) else copy


def assign(target, value) -> None:
    """Assign to an array in place, so that all who refer to it see the value, as ``mi.SceneParameters`` does."""
    mi.set_property(target, value)
