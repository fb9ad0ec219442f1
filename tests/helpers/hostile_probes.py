"""Functions that read a file as a user would; :mod:`limited_child` calls them in a child process.

Each raises what the library raises, or returns its outcome where that is not "loaded".
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import io
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from limited_child import Growth, fault_of_sentence

from mi_diffind.arrays.tables import load_table
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import Model, find_task

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
    scene = {"type": "scene", "integrator": {"type": "path"}, "sensor": {"type": "perspective"}}
    mi.render(mi.load_dict({**scene, "shape": {"type": "rectangle"}, "light": {"type": "constant"}}), spp=1).numpy()


def outcome(name: str, message: str) -> dict:
    """Return an answer."""
    return {"outcome": name, "message": message}


def bounded(read, path: str):
    """Return the result of a reader. Raises ``MemoryError`` if it takes more than the file or folder allows."""
    files = [file for file in [Path(path), *Path(path).rglob("*")] if file.is_file()]
    size = sum(file.stat().st_size for file in files)
    try:
        with Growth() as growth:
            return read()
    finally:
        if growth.bytes > MEMORY + TIMES * size:
            raise MemoryError(f"{growth.bytes / 2**20:,.0f} MB for {size:,} bytes")


def finite(**values) -> dict | None:
    """Return the outcome for a number in nested content that is not finite, ``None`` if all are."""
    name = nonfinite(values)
    return outcome("nonfinite", name) if name else None


def nonfinite(value, name: str = "") -> str:
    """Return the name of a number in nested content that is not finite, "" if all are."""
    if isinstance(value, dict):
        return next(filter(None, (nonfinite(v, f"{name}.{k}") for k, v in value.items())), "")
    if isinstance(value, list | tuple):
        return next(filter(None, (nonfinite(v, f"{name}[{i}]") for i, v in enumerate(value))), "")
    if hasattr(value, "vertices"):
        return nonfinite(np.asarray(value.vertices), f"{name}.vertices")
    number = isinstance(value, float | np.floating) or (isinstance(value, np.ndarray) and value.dtype.kind == "f")
    return name if number and not np.isfinite(value).all() else ""


def printable(lines) -> dict | None:
    """Return the outcome for a line that a terminal would obey."""
    return next((outcome("sentence", f"{line!r:.200}") for line in lines if not line.isprintable()), None)


# -- table files -------------------------------------------------------------------------------------------------------


def load(path: str):
    """Return the checked table of a file of any task."""
    return find_task(load_table(path)).load(path)


#: Checked table of an original file.
original_table = functools.lru_cache(maxsize=32)(load)


def changed_array(table, before, untouched: list[str] | None) -> str:
    """Return the name of an array that differs from the original's without a reason, "" if none does.

    ``untouched`` are those that nothing was done to; ``None``: nothing was done to any, nor to the description.
    """
    if untouched is None:
        for name in ("task", "preset", "settings", "seed", "measured"):
            if getattr(table, name) != getattr(before, name):
                return name
    for name in before.arrays if untouched is None else untouched:
        both = [t.arrays[name] for t in (table, before) if name in t.arrays]
        about = [(x.entries.dtype, x.shape, x.border, x.scale, x.offset, x.bits, x.entries.tobytes()) for x in both]
        if len(about) == 2 and about[0] != about[1]:
            return name
    return ""


def table(path: str, original: str, untouched: list[str] | None, evaluate: bool = True) -> dict | None:
    """Read a table file, compare it with the original, describe it, decode it and render the plugin that reads it."""
    loaded, model = bounded(lambda: opened(path), path)
    if name := changed_array(load(path), original_table(original), untouched):
        return outcome("silent", f"{name} differs")
    figures, lines = model.describe()
    if fault := finite(describe=figures) or printable(lines):
        return fault
    if not evaluate:
        return None
    if fault := finite(decode=decoded(model)):
        return fault
    return finite(picture=rendered(path)) if find_task(loaded).plugin else None


def opened(path: str) -> tuple:
    """Return the table of a file, and its model."""
    loaded = load(path)
    return loaded, find_task(loaded).model(loaded, array_module("llvm").TensorXf)


def decoded(model) -> object:
    """Return the content of a model in an ordinary format, ``None`` if there is no such format."""
    if type(model).decode is Model.decode:
        return None
    names = {argument.name for argument in find_task(model.table).decode_arguments}
    options = {name: value for name, value in DECODED.items() if name in names}
    if inspect.signature(type(model).decode).parameters["output"].default is None:
        options.pop("rows", None)  # of a file only
        return model.decode(**options)
    path = Path("decoded.csv" if "rows" in names else "decoded.npz")
    model.decode(path, **options)
    if "rows" in names:
        return np.loadtxt(path, delimiter=",", skiprows=1)
    with np.load(path) as data:
        return {name: data[name] for name in data.files}


def rendered(path: str) -> np.ndarray:
    """Return a picture of the plugin that reads a table file, as the viewer shows it."""
    from mi_diffind.scenes import loading
    from mi_diffind.scenes.viewer.session import table_scene

    scene = table_scene(path)
    scene["sensor"]["film"] |= {"width": SIDE, "height": SIDE}
    with loading.scene_errors(path):
        return mi.render(loading.load_dict(scene), spp=SAMPLES).numpy()


# -- other files -------------------------------------------------------------------------------------------------------


def capture(path: str) -> dict | None:
    """Read the views of a folder, and one image of them."""
    from mi_diffind.tasks.radiance.views import load_views

    views = bounded(lambda: load_views(path), path)
    return finite(image=views.image(0), poses=views.poses, focal=views.focal, centre=views.centre)


def manifest(path: str) -> dict | None:
    """Read the maps of a material."""
    from mi_diffind.maps.source import load_source

    source = bounded(lambda: load_source(path), str(Path(path).parent))
    return finite(**{m.name: m.values for m in source.maps})


def mesh(path: str) -> dict | None:
    """Read a mesh for a distance field."""
    from mi_diffind.tasks.sdf.mesh import load_mesh

    return finite(mesh=bounded(lambda: load_mesh(path), path))


def splats(path: str) -> dict | None:
    """Read Gaussians, and crop them."""
    from mi_diffind.scenes.splats import Splats

    loaded = bounded(lambda: Splats.read(path), path)
    names = ("centres", "scales", "quaternions", "opacities", "colours")
    return finite(**{name: getattr(loaded, name) for name in names}) or finite(box=loaded.crop().box())


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
    return finite(**{name: problem.net[name].numpy() for name in problem.net}, measured=result.measured)


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


def still_ray(path: str) -> dict | None:
    """Intersect a distance field with rays that have no direction."""
    shape = mi.load_dict({"type": "scene", "shape": {"type": "neural_sdf", "filename": path}})
    t = shape.ray_intersect(mi.Ray3f(mi.Point3f([0.0, 0.1, 5.0], 0.0, 0.0), mi.Vector3f(0, 0, 0))).t.numpy()
    return outcome("nonfinite", "t is NaN") if np.isnan(t).any() else None


def rays(folder: str, count: int) -> dict:
    """Trace rays that no camera sends through the fields of a folder."""
    import hostile_inputs

    return {"fields": hostile_inputs.trace(folder, count)}
