"""Functions that read a file as a user would; :mod:`limited_child` calls them in a child process.

Each raises what the library raises, or returns its outcome where that is not "loaded".
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import io
import json
import os
import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from limited_child import Growth, fault_of_sentence

import mi_diffind
from mi_diffind.core import compat
from mi_diffind.core.errors import DiffindError
from mi_diffind.core.runtime import array_module

#: Memory that reading a file may take: bytes, and multiples of the file's size.
MEMORY, TIMES = 64 << 20, 20

#: Options of ``decode`` for a small result, by name, where a task has them.
DECODED = {"resolution": 4, "width": 5, "height": 4, "rows": 4}

#: Pixels of a picture, and samples of each.
SIDE, SAMPLES = 6, 2


def prepare() -> None:
    """Set the variant, and run everything once that is loaded when it is first used."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    mi.render(mi.load_dict(scene_with({"type": "rectangle"})), spp=1).numpy()


class Fault(Exception):
    """An outcome that no exception of the library reports."""


def outcome(name: str, message: str) -> dict:
    """Return an answer."""
    return {"outcome": name, "message": message}


def allowed(path: str) -> int:
    """Return the bytes that reading a file, or the files of a folder, may take."""
    files = [path] if os.path.isfile(path) else [os.path.join(d, f) for d, _, fs in os.walk(path) for f in fs]
    return MEMORY + TIMES * sum(os.path.getsize(file) for file in files if os.path.isfile(file))


def nonfinite(value, name: str = "", fault=None) -> str:
    """Return the name of a number in nested content that is not finite, "" if all are."""
    if isinstance(value, dict):
        return next(filter(None, (nonfinite(v, f"{name}.{k}") for k, v in value.items())), "")
    if isinstance(value, (list, tuple)):
        return next(filter(None, (nonfinite(v, f"{name}[{i}]") for i, v in enumerate(value))), "")
    if hasattr(value, "vertices"):
        return nonfinite(np.asarray(value.vertices), f"{name}.vertices")
    if isinstance(value, (float, np.floating)):
        return "" if np.isfinite(value) else name
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return "" if np.isfinite(value).all() else name
    return ""


# -- table files -------------------------------------------------------------------------------------------------------


@functools.lru_cache(maxsize=32)
def content(path: str):
    """Return the checked table of an original file."""
    return load(path)


def load(path: str):
    """Return the checked table of a file of any task."""
    from mi_diffind.arrays.tables import load_table
    from mi_diffind.fitting.task import task_of

    return task_of(load_table(path)).load(path)


def changed_array(path: str, original: str, untouched: list[str] | None) -> str:
    """Return the name of an array that differs from the original's without a reason, "" if none does.

    ``untouched`` are those that nothing was done to; ``None``: nothing was done to any, nor to the description.
    """
    table, before = load(path), content(original)
    if untouched is None:
        for name in ("task", "preset", "settings", "seed", "measured"):
            if getattr(table, name) != getattr(before, name):
                return name
        untouched = list(before.arrays)
    for name in untouched:
        a, b = table.arrays.get(name), before.arrays.get(name)
        if a is None or b is None:
            continue
        about = [(x.entries.dtype, x.shape, x.border, x.scale, x.offset, x.bits) for x in (a, b)]
        if about[0] != about[1] or a.entries.tobytes() != b.entries.tobytes():
            return name
    return ""


def table(path: str, original: str, untouched: list[str] | None, evaluate: bool = True) -> dict | None:
    """Read a table file, compare it with the original, describe it, decode it and render the plugin that reads it."""
    from mi_diffind.fitting.task import task_of

    try:
        with Growth() as growth:
            loaded = load(path)
            model = task_of(loaded).model(loaded, array_module("llvm").TensorXf)
    finally:
        if growth.bytes > allowed(path):
            raise Growing(growth.bytes, path)
    if name := changed_array(path, original, untouched):
        return outcome("silent", f"{name} differs")
    figures, lines = model.describe()
    if name := nonfinite(figures):
        return outcome("nonfinite", f"describe(): {name}")
    for line in lines:
        if not line.isprintable():
            return outcome("sentence", f"describe(): {line!r:.200}")
    if not evaluate:
        return None
    if name := nonfinite(decoded(model)):
        return outcome("nonfinite", f"decode(): {name}")
    if (task := task_of(loaded)).plugin and (fault := rendered(task, loaded, path)):
        return outcome("nonfinite", fault)
    return None


class Growing(MemoryError):
    """Reading took more memory than the file's size allows."""

    def __init__(self, nbytes: int, path: str):
        super().__init__(f"{nbytes / 2**20:,.0f} MB for {os.path.getsize(path):,} bytes")


def refuse(error: RuntimeError, path: str) -> None:
    """Raise :class:`DiffindError` if a plugin refused a file, by a sentence that Mitsuba wrapped in its own."""
    raised = re.findall(r"^([\w.]+): (.*)", str(error), re.MULTILINE)
    if raised and raised[-1][0] == "RuntimeError" and f"{Path(path).name}: " in raised[-1][1]:
        raise DiffindError(compat.one_sentence(error)) from None


def decoded(model) -> object:
    """Return the content of a model in an ordinary format, ``None`` if there is no such format."""
    from mi_diffind.fitting.task import Model, task_of

    if type(model).decode is Model.decode:
        return None
    names = {argument.name for argument in task_of(model.table).decode_arguments}
    options = {name: value for name, value in DECODED.items() if name in names}
    if inspect.signature(type(model).decode).parameters["output"].default is None:
        options.pop("rows", None)  # of a file only
        return model.decode(**options)
    path = Path("decoded.npz")
    model.decode(path, **options)
    with np.load(path) as data:
        return {name: data[name] for name in data.files}


def rendered(task, loaded, path: str) -> str:
    """Render the plugin of a task; returns what is wrong with the picture, "" if nothing is."""
    from mi_diffind.scenes import loading

    tag, name = task.plugin
    plugin = {"type": name, "filename": path}
    layout = loaded.settings.get("layout")
    maps = layout["maps"] if isinstance(layout, dict) else []
    if len(maps) > 1:
        plugin["channels"] = maps[0]["name"]
    if tag == "integrator":
        scene = scene_with({"type": "rectangle"}) | {"integrator": plugin}
    elif tag == "shape":
        scene = scene_with({**plugin, "bsdf": {"type": "diffuse"}})
    elif tag == "texture":
        scene = scene_with({"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": plugin}})
    else:
        scene = scene_with({"type": "rectangle", "bsdf": plugin})
    try:
        scene = loading.load_dict(scene)
    except RuntimeError as e:
        refuse(e, path)
        raise
    picture = mi.render(scene, spp=SAMPLES).numpy()
    return "" if np.isfinite(picture).all() else "a picture"


def scene_with(shape: dict) -> dict:
    """Return a scene of one shape in white surroundings."""
    look_at = mi.ScalarTransform4f().look_at([0.6, 0.4, 3.5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 3},
        "emitter": {"type": "constant"},
        "sensor": {"type": "perspective", "fov": 40, "to_world": look_at, "film": film},
        "shape": shape,
    }


# -- other files -------------------------------------------------------------------------------------------------------


def bounded(read, path: str):
    """Return the result of a reader. Raises :class:`Growing` if it takes too much memory."""
    try:
        with Growth() as growth:
            return read()
    finally:
        if growth.bytes > allowed(path):
            raise Growing(growth.bytes, path) if os.path.isfile(path) else MemoryError(f"{growth.bytes >> 20} MB")


def capture(path: str) -> dict | None:
    """Read the views of a folder, and one image of them."""
    from mi_diffind.tasks.radiance.views import load_views

    views = bounded(lambda: load_views(path), path)
    image = views.image(0)
    fault = nonfinite({"image": image, "poses": views.poses, "focal": views.focal, "centre": views.centre})
    return outcome("nonfinite", fault) if fault else None


def manifest(path: str) -> dict | None:
    """Read the maps of a material."""
    from mi_diffind.maps.source import load_source

    source = bounded(lambda: load_source(path), str(Path(path).parent))
    fault = nonfinite({m.name: m.values for m in source.maps})
    return outcome("nonfinite", fault) if fault else None


def mesh(path: str) -> dict | None:
    """Read a mesh for a distance field."""
    from mi_diffind.tasks.sdf.mesh import load_mesh

    loaded = bounded(lambda: load_mesh(path), path)
    fault = nonfinite({"vertices": np.asarray(loaded.vertices)})
    return outcome("nonfinite", fault) if fault else None


def splats(path: str) -> dict | None:
    """Read Gaussians, and crop them."""
    from mi_diffind.scenes.splats import Splats

    loaded = bounded(lambda: Splats.read(path), path)
    names = ("centres", "scales", "quaternions", "opacities", "colours")
    if fault := nonfinite({name: getattr(loaded, name) for name in names}):
        return outcome("nonfinite", fault)
    fault = nonfinite({"box": loaded.cropped().box()})
    return outcome("nonfinite", fault) if fault else None


def checkpoint(path: str, write: bool = False) -> dict | None:
    """Go on with a short training from a checkpoint; ``write``: make the checkpoint instead."""
    from mi_diffind.fitting.loop import FitSettings, fit
    from mi_diffind.fitting.task import FitRequest
    from mi_diffind.tasks.ggx import TASK

    types = array_module("llvm")
    settings = FitSettings(steps=2, batch=64, lr=1e-2, measure_every=1, seed=1)
    request = FitRequest("tables", settings, types, options={"primary": 4, "cascaded": 3})
    problem = TASK.problem(request)
    problem.measure = lambda net: {"psnr_db": 1.0}
    result = fit(problem, settings, path, not write, False, log=lambda text: None)
    entries = {name: np.asarray(problem.net[name].numpy()) for name in problem.net}
    fault = nonfinite({"entries": entries, "measured": result.measured})
    return outcome("nonfinite", fault) if fault else None


def command(arguments: list[str]) -> dict | None:
    """Run a command line; it has to end with an exit code and, if it is refused, in one sentence."""
    from mi_diffind.commands import cli

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(list(arguments))
        except SystemExit as e:
            code = e.code
    dr.sync_thread()
    printed = out.getvalue() + err.getvalue()
    if any(not (c.isprintable() or c in "\n\r\t") for c in printed):
        return outcome("sentence", f"control characters: {printed!r:.200}")
    if code in (0, 1, None):
        return None
    if code != 2:
        return outcome("traceback", f"exit code {code}")
    sentences = [line for line in err.getvalue().splitlines() if ": error: " in line]
    if len(sentences) != 1:
        return outcome("sentence", f"{len(sentences)} sentences: {err.getvalue()[-200:]!r}")
    fault = fault_of_sentence(sentences[0])
    return outcome("sentence", f"{fault}: {sentences[0]}") if fault else outcome("refused", sentences[0])


def report(path: str) -> dict | None:
    """Describe a file as ``mi-diffind inspect --json`` does."""
    result = mi_diffind.inspect(path)
    json.dumps(result.figures, allow_nan=False)
    for line in result.lines(verbose=True):
        if not line.isprintable():
            return outcome("sentence", f"{line!r:.200}")
    return None


def still_ray(path: str) -> dict | None:
    """Intersect a distance field with rays that have no direction."""
    shape = mi.load_dict({"type": "scene", "shape": {"type": "neural_sdf", "filename": path}})
    ray = mi.Ray3f(mi.Point3f([0.0, 0.1, 5.0], 0.0, 0.0), mi.Vector3f(0, 0, 0))
    t = shape.ray_intersect(ray).t.numpy()
    return outcome("nonfinite", "t is NaN") if np.isnan(t).any() else None
