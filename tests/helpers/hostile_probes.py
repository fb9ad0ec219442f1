"""Functions that read a file as a user would; :mod:`limited_child` calls them in a child process.

Each raises what the library raises, or a fault; it returns further figures of an answer, if there are any.
"""

from __future__ import annotations

import contextlib
import inspect
import io
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from limited_child import Fault, fault_of_sentence, status

from mi_diffind.arrays.tables import load_table
from mi_diffind.core.errors import UsageError
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


def bounded(read, path: str):
    """Return the result of a reader. Raises ``MemoryError`` if it takes more than the file or folder allows."""
    size = sum(file.stat().st_size for file in [Path(path), *Path(path).rglob("*")] if file.is_file())
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the largest use begins anew
    before = status("VmHWM")
    try:
        return read()
    finally:
        if (growth := status("VmHWM") - before) > MEMORY + TIMES * size:
            raise MemoryError(f"{growth / 2**20:,.0f} MB for {size:,} bytes")


def check_finite(value, name: str = "") -> None:
    """Raise a fault for a number in nested content that is not finite."""
    if isinstance(value, dict | list | tuple):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            check_finite(each, f"{name}.{key}")
        return
    numbers = np.asarray(getattr(value, "vertices", value))
    if numbers.dtype.kind == "f" and not np.isfinite(numbers).all():
        raise Fault("nonfinite", name)


# -- table files -------------------------------------------------------------------------------------------------------


def load(path: str):
    """Return the checked table of a file of any task."""
    return find_task(load_table(path)).load(path)


def check_arrays(table, before, untouched: list[str] | None) -> None:
    """Raise a fault for an array that differs from the original's without a reason.

    ``untouched`` are those that nothing was done to; ``None``: nothing was done to any, nor to the description.
    """
    if untouched is None:
        untouched = list(before.arrays)
        for name in ("task", "preset", "settings", "seed", "measured"):
            if getattr(table, name) != getattr(before, name):
                raise Fault("silent", f"{name} differs")
    for name in untouched:
        both = [t.arrays[name] for t in (table, before) if name in t.arrays]
        about = [(x.entries.dtype, x.shape, x.border, x.scale, x.offset, x.bits, x.entries.tobytes()) for x in both]
        if len(about) == 2 and about[0] != about[1]:
            raise Fault("silent", f"{name} differs")


def table(path: str, original: str, untouched: list[str] | None, evaluate: bool = True) -> None:
    """Read a table file, compare it with the original, describe it, decode it and render the plugin that reads it."""
    loaded, model = bounded(lambda: opened(path), path)
    check_arrays(loaded, load(original), untouched)
    figures, lines = model.describe()
    check_finite(figures, "describe")
    for line in lines:
        if not line.isprintable():  # a terminal would obey it
            raise Fault("sentence", f"{line!r:.200}")
    if evaluate:
        check_finite(decoded(model), "decode")
        if find_task(loaded).plugin:
            check_finite(rendered(path), "picture")


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


def capture(path: str) -> None:
    """Read the views of a folder, and one image of them."""
    from mi_diffind.tasks.radiance.views import load_views

    views = bounded(lambda: load_views(path), path)
    check_finite([views.image(0), views.poses, views.focal, views.centre])


def manifest(path: str) -> None:
    """Read the maps of a material."""
    from mi_diffind.maps.source import load_source

    source = bounded(lambda: load_source(path), str(Path(path).parent))
    check_finite({m.name: m.values for m in source.maps})


def mesh(path: str) -> None:
    """Read a mesh for a distance field."""
    from mi_diffind.tasks.sdf.mesh import load_mesh

    check_finite(bounded(lambda: load_mesh(path), path), "mesh")


def splats(path: str) -> None:
    """Read Gaussians, and crop them."""
    from mi_diffind.scenes.splats import Splats

    loaded = bounded(lambda: Splats.read(path), path)
    names = ("centres", "scales", "quaternions", "opacities", "colours")
    check_finite({name: getattr(loaded, name) for name in names} | {"box": loaded.crop().box()})


def checkpoint(path: str) -> None:
    """Go on with a short training from a checkpoint, or begin it where there is none."""
    from mi_diffind.fitting.loop import FitSettings, fit
    from mi_diffind.fitting.task import FitRequest
    from mi_diffind.tasks.ggx import TASK

    types = array_module("llvm")
    settings = FitSettings(steps=2, batch=64, lr=1e-2, measure_every=1, seed=1)
    request = FitRequest("tables", settings, types, options={"primary": 4, "cascaded": 3})
    problem = TASK.problem(request)
    problem.measure = lambda net: {"psnr_db": 1.0}
    result = fit(problem, settings, path, Path(path).exists(), False, log=lambda text: None)
    check_finite([{name: problem.net[name].numpy() for name in problem.net}, result.measured])


def command(arguments: list[str]) -> None:
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
        raise Fault("sentence", f"control characters: {printed!r:.200}")
    if code in (0, 1, None):
        return
    if code != 2:
        raise Fault("traceback", f"exit code {code}")
    sentences = [line for line in err.getvalue().splitlines() if ": error: " in line]
    if len(sentences) != 1:
        raise Fault("sentence", f"{len(sentences)} sentences: {err.getvalue()[-200:]!r}")
    if fault := fault_of_sentence(sentences[0]):
        raise Fault("sentence", f"{fault}: {sentences[0]}")
    raise UsageError(sentences[0])


def still_ray(path: str) -> None:
    """Intersect a distance field with rays that have no direction."""
    shape = mi.load_dict({"type": "scene", "shape": {"type": "neural_sdf", "filename": path}})
    t = shape.ray_intersect(mi.Ray3f(mi.Point3f([0.0, 0.1, 5.0], 0.0, 0.0), mi.Vector3f(0, 0, 0))).t.numpy()
    if np.isnan(t).any():
        raise Fault("nonfinite", "t is NaN")


def rays(folder: str, count: int) -> dict:
    """Trace rays that no camera sends through the fields of a folder."""
    import hostile_inputs

    return {"fields": hostile_inputs.trace(folder, count)}
