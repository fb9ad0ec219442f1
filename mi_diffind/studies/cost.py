"""Study ``tradeoff cost``: error, times and bytes of each learned plugin and of what a user would take instead.

A row is a material, a texture or a solid in a scene under an environment light, rendered by several contenders, of
which the first is what a user would take instead. All figures of a contender are those of one run: the *error* of a
render at equal samples, with its noise and bias (:func:`.equal_time.errors`); the error with as many samples as fit in
the time of the first contender; the time of that *render*; the time of a *step*, which renders and derives a quarter of
the pixels with respect to all entries of tables, texels, grid values or vertex positions, of BSDFs the parameters; the
bytes in *memory*, with the index of rays, and on *disk*.

Times are those of the processor, on one core, with the tracing of kernels by Python. Contenders render in turn, each in
a process of its own, because Dr.Jit compiles the materials of all scenes of a process into each kernel.
"""

import argparse
import math
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import plugins
from ..core import compat
from ..core.arguments import positive
from ..core.progress import interruptible, progress_bar
from ..fitting import task
from ..measure import plot, report
from ..measure.clock import machine
from ..measure.statistics import spread
from ..measure.study import Study, Tradeoff
from ..plugins.support.distance_shapes import CELL_BYTES, crop_grid
from ..scenes import equal_time, loading
from ..tasks.sdf import marching
from ..tasks.sdf.distances import Distances
from ..tasks.sdf.mesh import load_mesh

#: Folder of the scenes' files in a checkout.
ASSETS = Path("scenes/assets")

#: Repetitions of textures on the floor.
REPEATS = 6

#: Plugins of whose storage forms one can be optimised.
LEARNED = ("neural_image", "neural_texture", "neural_material", "neural_sdf")

#: Cells of ``sdfgrid`` along the longest side.
CELLS = 128

DISNEY = {"base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}, "roughness": 0.4, "metallic": 0.3, "clearcoat": 0.5}
METAL = {"eta": {"type": "rgb", "value": [0.2, 0.9, 1.1]}, "k": {"type": "rgb", "value": [3.9, 2.4, 2.2]}, "alpha": 0.2}
COPPER = {"type": "roughconductor", "distribution": "ggx", "material": "Cu", "alpha": 0.03}

#: Light of a row → emitter.
LIGHTS = {
    "sky": {"type": "envmap", "filename": str(ASSETS / "forest.exr")},
    "sun": {"type": "directional", "direction": [-0.55, -0.6, -0.35], "irradiance": 3.0},
}


@dataclass(frozen=True)
class Row:
    """Row of the study: ``contenders`` (name → plugin of Mitsuba) at a ``place`` of the scene.

    ``place``: ``"ball"`` or ``"floor"`` (a BSDF), ``"shape"``, or ``"scene"`` (BSDFs ``floor`` and ``objects``, a ball
    and a mesh). ``keys``: pattern of the parameters that a step derives. ``references``: name → the contender whose
    picture of many samples that of ``name`` is compared with, where it is not the first. ``samples``: name → samples a
    pixel, where they are not those of the others. ``light``: one of :data:`LIGHTS`.
    """

    title: str
    place: str
    contenders: dict[str, dict]
    keys: str
    references: dict[str, str] = field(default_factory=dict)
    samples: dict[str, int] = field(default_factory=dict)
    light: str = "sky"

    @property
    def first(self) -> str:
        """The contender that a user would take instead."""
        return next(iter(self.contenders))

    def reference(self, name: str) -> str:
        """Return the contender whose picture of many samples that of ``name`` is compared with."""
        return self.references.get(name, self.first)


def material(maps: str, bsdf: str = "principled", texture: str = "bitmap", file: str = "") -> dict:
    """Return a normal map around a BSDF, with textures of bitmaps ``MAPS_ROLE.png``, or of a file of tables."""

    def read(role: str) -> dict:
        if file:
            return {"type": texture, "filename": file, "channels": role}
        return {"type": texture, "filename": f"{maps}_{role}.png", "raw": role != "albedo"}

    roles = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}
    inner = {name: read(role) for name, role in roles.items() if (maps, role) != ("tiles", "metallic")}
    return {"type": "normalmap", "normalmap": read("normal"), "bsdf": {"type": bsdf, **inner}}


#: Name → row.
ROWS = {
    "disney": Row(
        "Disney BRDF", "ball",
        {"principled": {"type": "principled", **DISNEY}, "disney": {"type": "disney", **DISNEY},
         "neural_disney": {"type": "neural_disney", **DISNEY},
         "neural_disney, paper": {"type": "neural_disney", "preset": "paper", **DISNEY}},
        r".*ball\.bsdf\.(?!tables).*",
        references=dict.fromkeys(("disney", "neural_disney", "neural_disney, paper"), "disney"),
    ),
    "ggx": Row(
        "GGX metal", "ball",
        {"roughconductor": {"type": "roughconductor", "distribution": "ggx", **METAL},
         "neural_ggx": {"type": "neural_ggx", **METAL},
         "neural_ggx, paper": {"type": "neural_ggx", "preset": "paper", **METAL}},
        r".*ball\.bsdf\.(alpha|eta|k)\b.*",
    ),
    "bsdf": Row(
        "copper, from its plugin", "ball",
        {"roughconductor": COPPER, "neural_bsdf": {"type": "neural_bsdf", "filename": "library/copper.npz"}},
        r".*ball\.bsdf\.(?!tables).*",
    ),
    "image": Row(
        "maps of tiles, unfiltered", "floor",
        {"bitmap": material("tiles"), "neural_image": material("tiles", texture="neural_image", file="tiles.npz")},
        r".*floor\.bsdf\..*(data|tables\..*)",
    ),
    "texture": Row(
        "maps of tiles, filtered", "floor",
        {"bitmap": material("tiles"), "bitmap, 4 samples": material("tiles"), "bitmap, 1 sample": material("tiles"),
         "mipmap": material("tiles", texture="mipmap"),
         "neural_texture": material("tiles", texture="neural_texture", file="tiles_filtered.npz")},
        r".*floor\.bsdf\..*(data|levels.*|tables\..*)",
        samples={"bitmap, 1 sample": 1, "bitmap, 4 samples": 4},
    ),
    "material": Row(
        "rust", "floor",
        {"normalmap, principled, bitmaps": material("rust"), "normalmap, disney, bitmaps": material("rust", "disney"),
         "neural_material": {"type": "neural_material", "filename": "rust_shaded.npz"}},
        r".*floor\.bsdf\..*(data|tables\..*)",
        references=dict.fromkeys(("normalmap, disney, bitmaps", "neural_material"), "normalmap, disney, bitmaps"),
    ),
    "solid": Row(
        "Suzanne", "shape",
        {"mesh": {"type": "ply", "filename": "suzanne.ply"},
         "sdfgrid": {"type": "sdfgrid", "normals": "smooth", "mesh": "suzanne.ply"},
         "neural_sdf": {"type": "neural_sdf", "filename": "suzanne.npz", "trace": "arrays"},
         "neural_sdf, decoded": {"type": "neural_sdf", "filename": "suzanne.npz", "trace": "grid"}},
        r".*shape\.(grid|vertex_positions|tables\..*)",
    ),
}  # fmt: skip

#: Passes of a reference, as a multiple of those of a contender.
REFERENCE = 8

#: First passes, which compile kernels.
WARM = 2

#: Seed of the references, far from those of contenders.
REFERENCE_SEED = 1 << 16


@dataclass(frozen=True)
class CostSettings:
    """Settings: ``spp`` samples a pixel, ``rounds`` passes of each contender, sides of the films in pixels."""

    spp: int = 16
    rounds: int = 9
    render: int = 320
    step: int = 160


class CostStudy(Study):
    """Error, times and bytes of learned plugins and of what a user would take instead, a row from one run."""

    name = "cost"
    title = "each learned plugin and of what a user would take instead, in whole renders"
    example = "texture material"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("rows", nargs="*", metavar="ROW", help=f"{', '.join(ROWS)} (default: all; --quick: disney)")
        parser.add_argument(
            "--rounds", type=positive, metavar="N", help="passes of each contender, at least 2 (default: 9)"
        )
        parser.add_argument("--measured", metavar="FILE.bsdf", help="add a measured copper to the row bsdf")

    def check(self, arguments) -> None:
        """Raise ``ValueError`` for a row that does not exist, or without the files of the scenes."""
        if unknown := [name for name in arguments.rows if name not in ROWS]:
            raise ValueError(f'found the row "{unknown[0]}", allowed are {", ".join(ROWS)}')
        if arguments.rounds == 1:
            raise ValueError("--rounds: found 1, at least 2 are needed to tell noise from bias")
        for path in (ASSETS / "forest.exr", *([Path(arguments.measured)] if arguments.measured else [])):
            if not path.is_file():
                raise ValueError(f"{path}: no such file; run the study in a checkout, with files that exist")

    def run(self, arguments) -> Tradeoff:
        quick = arguments.quick
        settings = CostSettings(4, 2, 64, 32) if quick else CostSettings(rounds=arguments.rounds or CostSettings.rounds)
        rows = {name: ROWS[name] for name in arguments.rows or (["disney"] if quick else ROWS)}
        if arguments.measured and "bsdf" in rows:
            measured = {"type": "measured", "filename": str(Path(arguments.measured).resolve())}
            contenders = {"roughconductor": COPPER, "measured": measured, **rows["bsdf"].contenders}
            rows["bsdf"] = replace(rows["bsdf"], contenders=contenders)
        result = measure(rows, settings)
        pictures = {"png": lambda: picture(result)} if result["rows"] else {}
        return report.publish(
            result, report.write_files("cost", arguments.out, result, table(result), pictures), lines(result)
        )


STUDY = CostStudy()


# -- Scenes ------------------------------------------------------------------------------------------------------------


def plugin(description: dict, storage: str = "") -> dict:
    """Return a plugin for ``mi.load_dict``: with paths of files and repeated textures.

    ``storage``: the storage form of learned arrays (``""``: the default); with ``"float32"``, bitmaps can be optimised.
    """
    result = {key: plugin(value, storage) if isinstance(value, dict) else value for key, value in description.items()}
    name = result.get("type", "")
    if name == "sdfgrid":
        values, lower, size = grid_of_mesh(str(ASSETS / result.pop("mesh")))
        place = mi.ScalarTransform4f().translate(lower.tolist()).scale(size.tolist())
        return {**result, "grid": mi.TensorXf(values), "to_world": place}
    if "filename" in result:
        result["filename"] = str(ASSETS / result["filename"])
    if name in ("bitmap", "mipmap", "neural_image", "neural_texture", "neural_material"):
        result["to_uv"] = mi.ScalarTransform3f().scale(REPEATS)
    if storage and name == "bitmap":
        result["format"] = "variant"
    if storage and name in LEARNED:
        result["storage"] = storage
    return result


def grid_of_mesh(path: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the exact distances of a mesh at the corners of :data:`CELLS` cells, their lower corner and size."""
    mesh = load_mesh(path)
    spacing = float((mesh.upper - mesh.lower).max()) / CELLS
    lower = mesh.lower - 3 * spacing
    counts = np.ceil((mesh.upper - lower) / spacing).astype(int) + 4
    z, y, x = np.meshgrid(*(np.arange(n) for n in counts[::-1]), indexing="ij")
    values = Distances(mesh).signed(lower + spacing * np.stack([x, y, z], -1).reshape(-1, 3)).reshape(x.shape)
    values, lower, upper = crop_grid(values, lower, spacing)
    return np.float32(values[..., None] * mesh.scale), mesh.centre + mesh.scale * lower, mesh.scale * (upper - lower)


def load_scene(row: Row, name: str, step: bool, settings: CostSettings):
    """Return the scene of a contender: a floor, with a ball or a solid or both, under a light."""
    part, side = plugin(row.contenders[name], "float32" if step else ""), settings.step if step else settings.render
    objects, move = {"type": "ref", "id": "objects"}, mi.ScalarTransform4f().translate([0.7, 0, 0]).scale(0.7)
    parts = {
        "ball": {"ball": {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.8, "bsdf": part}},
        "shape": {"shape": part},
        "scene": {
            "objects": part.get("objects"),
            "ball": {"type": "sphere", "center": [-0.8, 0.6, 0.2], "radius": 0.6, "bsdf": objects},
            "mesh": {"type": "ply", "filename": str(ASSETS / "suzanne.ply"), "to_world": move, "bsdf": objects},
        },
    }.get(row.place, {})
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(6)
    return loading.load_dict({
        "type": "scene",
        "integrator": {"type": "path_sdf" if part.get("trace") == "arrays" else "prb", "max_depth": 4},
        "sensor": {
            "type": "perspective", "fov": 40,
            "sampler": {"type": "multijitter", "sample_count": row.samples.get(name, settings.spp)},
            "to_world": mi.ScalarTransform4f().look_at([0, 1.9, 3.6], [0, 0.6, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb", "rfilter": {"type": "box"},
            },
        },
        "light": LIGHTS[row.light],
        "floor": {"type": "rectangle", "to_world": turn,
                  "bsdf": part.get("floor", part if row.place == "floor" else {"type": "diffuse", "reflectance": 0.5})},
        **parts,
    })  # fmt: skip


# -- Processes ---------------------------------------------------------------------------------------------------------


class ContenderProcess(ProcessPoolExecutor):
    """Process of the scene of a contender, which renders or steps on demand, on one core.

    ``nbytes``: the bytes of the contender's arrays in its scene.
    """

    def __init__(self, row: Row, name: str, step: bool, settings: CostSettings):
        super().__init__(1, multiprocessing.get_context("spawn"))
        self.spp = row.samples.get(name, settings.spp)
        self.nbytes = self.submit(_load, row, name, step, settings, mi.variant()).result()

    def run(self, seed: int, spp: int = 0) -> tuple[float, int, np.ndarray | None]:
        """Return the processor's seconds, the samples a pixel that were allowed, and the image of a render.

        ``spp``: samples a pixel (0: those of the row). The seconds of a step are NaN if there is nothing to derive.
        """
        return self.submit(_run, spp or self.spp, seed).result()


#: Of the process of a contender: its scene, and the function of a step, if it steps.
_loaded: list = []


def _load(row: Row, name: str, step: bool, settings: CostSettings, variant: str) -> int:
    """Load the scene of this process, and return the bytes of the contender's arrays."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    compat.use_threads(1)
    scene = load_scene(row, name, step, settings)
    _loaded[:] = scene, step, _step(scene, row.keys) if step else None
    return array_bytes(scene, row.place)


def _run(spp: int, seed: int) -> tuple[float, int, np.ndarray | None]:
    """Render or step (:meth:`ContenderProcess.run`)."""
    scene, step, take_step = _loaded
    if step and take_step is None:
        return math.nan, spp, None
    spp = spp if step else equal_time.attach_samples(scene, spp)
    dr.sync_thread()
    start = time.process_time()
    seed = dr.opaque(mi.UInt32, seed)
    result = take_step(spp, seed) if step else mi.render(scene, spp=spp, seed=seed)
    dr.eval(result)
    dr.sync_thread()
    return time.process_time() - start, spp, None if step else np.array(result)


def _step(scene, keys: str) -> Callable | None:
    """Return a function that renders and derives all parameters of a pattern, ``None`` if there are none."""
    parameters = mi.traverse(scene)
    parameters.keep([keys])
    chosen = [k for k in parameters.keys() if dr.is_diff_v(parameters[k]) and dr.is_float_v(dr.leaf_t(parameters[k]))]
    if not chosen:
        return None

    def run(spp, seed):
        for key in chosen:
            dr.enable_grad(parameters[key])
            dr.set_grad(parameters[key], 0)
        parameters.update()
        image = mi.render(scene, parameters, spp=spp, seed=seed, seed_grad=seed + 10_000)
        dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
        return [parameters[key].grad for key in chosen]

    return run


def array_bytes(scene, place: str) -> int:
    """Return the bytes of all arrays of more than a few numbers of an object of a scene."""
    parameters, total = mi.traverse(scene), 0
    for key in parameters.keys():
        value = parameters[key]
        if key.split(".")[0] == place and dr.is_array_v(value):
            array = value.array if dr.is_tensor_v(value) else dr.ravel(value)
            nbytes = CELL_BYTES if key.endswith(".grid") else dr.itemsize_v(array)
            total += dr.width(array) * nbytes if dr.width(array) > 64 else 0
    return total


# -- Measurement -------------------------------------------------------------------------------------------------------


def measure(rows: dict[str, Row], settings: CostSettings, progress: bool = True) -> dict:
    """Measure rows, and return ``rows``: name → ``title`` and ``contenders``, each with its figures.

    A contender has ``spp``, ``reference`` (a contender), ``error``, ``noise``, ``bias`` (:func:`.equal_time.errors`),
    ``render`` and ``step`` (``seconds`` and the ``ratio`` to the first contender, with quartiles), ``memory_bytes``,
    ``disk_bytes``, and ``equal_time``: ``spp``, ``seconds``, ``error`` and its ``ratio`` to the first contender's, of
    passes that take as long as one of it. Raises what the process of a contender raises.
    """
    measured, interrupted = {}, False
    total = sum(
        (3 * len(row.contenders) + REFERENCE * len(dict.fromkeys(map(row.reference, row.contenders)))) * settings.rounds
        for row in rows.values()
    )
    with interruptible() as stop, progress_bar("render", total, progress=progress) as bar:

        def passed(count: int = 1) -> None:
            bar.update(count)
            if stop.is_set():
                raise KeyboardInterrupt

        try:
            for name, row in rows.items():
                measured[name] = _measure_row(row, settings, passed)
        except KeyboardInterrupt:
            interrupted = True
    return {
        "task": "cost", "title": "What accuracy costs", "machine": machine(mi.variant()), "spp": settings.spp,
        "rounds": settings.rounds, "sides": {"render": settings.render, "step": settings.step}, "rows": measured,
        "interrupted": interrupted,
    }  # fmt: skip


def _measure_row(row: Row, settings: CostSettings, passed: Callable) -> dict:
    steps = _measure_steps(row, settings, passed)
    with ExitStack() as stack:
        processes = _processes(stack, row, row.contenders, False, settings)
        equal = {name: _equal_samples(process, processes[row.first]) for name, process in processes.items()}
        halves = {
            name: _reference(processes[name], settings, passed)
            for name in dict.fromkeys(map(row.reference, row.contenders))
        }
        passes, timely = ({name: [] for name in processes} for _ in range(2))
        for i in range(settings.rounds):
            for name, process in _turns(processes, i):
                passes[name].append(process.run(2 * i))
                timely[name].append(process.run(2 * i + 1, equal[name]))
                passed(2)
    contenders = {}
    for name, description in row.contenders.items():
        reference = halves[row.reference(name)]
        seconds, spps, images = zip(*passes[name], strict=True)
        equal_seconds, equal_spps, equal_images = zip(*timely[name], strict=True)
        figures = equal_time.errors(images, reference)
        contenders[name] = {
            "spp": spps[0], "reference": row.reference(name),
            **{key: figures[key] for key in ("error", "noise", "bias", "bias_resolution")},
            "render": _times(seconds, [p[0] for p in passes[row.first]]),
            "step": steps.get(name),
            "equal_time": {"spp": equal_spps[0], "seconds": spread(equal_seconds),
                           "error": equal_time.errors(equal_images, reference)["error"]},
            **file_sizes(description, processes[name].nbytes),
        }  # fmt: skip
    for c in contenders.values():
        c["equal_time"]["ratio"] = c["equal_time"]["error"] / contenders[row.first]["equal_time"]["error"]
    return {"title": row.title, "contenders": contenders}


def _processes(stack: ExitStack, row: Row, names: Iterable[str], step: bool, settings: CostSettings) -> dict:
    """Return the processes of contenders, with their kernels compiled; they end with the ``stack``."""
    processes = {name: stack.enter_context(ContenderProcess(row, name, step, settings)) for name in names}
    for process in processes.values():
        for seed in range(WARM):
            process.run(seed)
    return processes


def _turns(processes: dict, i: int) -> Iterator[tuple[str, ContenderProcess]]:
    return iter(processes.items()) if i % 2 == 0 else reversed(processes.items())


def _reference(process: ContenderProcess, settings: CostSettings, passed: Callable) -> list[np.ndarray]:
    """Return two independent halves of a picture of many samples."""
    halves, count = [0.0, 0.0], REFERENCE * settings.rounds
    for i in range(count):
        halves[i % 2] = halves[i % 2] + process.run(REFERENCE_SEED + i, settings.spp)[2]
        passed()
    return [half / (count / 2) for half in halves]


def _measure_steps(row: Row, settings: CostSettings, passed: Callable) -> dict[str, dict]:
    """Return the seconds of a step of each contender, and ratios to the first, by turns.

    A grid that is decoded from tables has none: Mitsuba would build its tree anew, for minutes.
    """
    names = [name for name, description in row.contenders.items() if description.get("trace") != "grid"]
    seconds = {name: [] for name in names}
    with ExitStack() as stack:
        processes = _processes(stack, row, names, True, settings)
        for i in range(settings.rounds):
            for name, process in _turns(processes, i):
                seconds[name].append(process.run(WARM + i)[0])
            passed(len(row.contenders))
    return {name: _times(taken, seconds[row.first]) for name, taken in seconds.items()}


def _equal_samples(process: ContenderProcess, first: ContenderProcess) -> int:
    """Return the samples of a contender whose pass takes as long as one of the first contender."""
    spp = process.spp
    for _ in range(equal_time.CORRECTIONS):
        pairs = [(process.run(i, spp)[0], first.run(i)[0]) for i in range(equal_time.PAIRS)]
        before, spp = spp, max(1, round(spp / float(np.median([a / b for a, b in pairs]))))
        if spp == before or process is first:
            break
    return process.spp if process is first else spp


def _times(seconds: list[float], first: list[float]) -> dict[str, dict[str, float]] | None:
    if math.isnan(sum(seconds)):
        return None
    return {"seconds": spread(seconds), "ratio": spread(a / b for a, b in zip(seconds, first, strict=True))}


def file_sizes(description: dict, counted: int) -> dict[str, int]:
    """Return ``memory_bytes`` and ``disk_bytes`` of a contender; ``counted``: the bytes of its arrays in a scene."""
    parts = list(_plugins(description))
    files = {ASSETS / part[key] for part in parts for key in ("filename", "mesh") if key in part}
    learned = next((part for part in parts if part["type"].startswith("neural_")), None)
    if learned is None:
        nbytes = sum(path.stat().st_size for path in files)
        hidden = description["type"] == "measured"  # its arrays, those of the file, are no parameters
        return {"memory_bytes": nbytes if hidden else counted, "disk_bytes": nbytes}
    declared = plugins.declared()[learned["type"]]
    path = task.tasks()[declared.task].file(next(iter(files), ""), learned.get("preset", ""))
    if learned.get("trace") != "grid":
        model = task.open_model(path, declared.storage)
        counted = model.memory_nbytes + (marching.index_bytes(model.field) if declared.task == "sdf" else 0)
    return {"memory_bytes": counted, "disk_bytes": path.stat().st_size}


def _plugins(description: dict) -> Iterator[dict]:
    """Yield a plugin and all that are in it."""
    yield description
    for value in description.values():
        if isinstance(value, dict) and "type" in value:
            yield from _plugins(value)


# -- Report ------------------------------------------------------------------------------------------------------------


def table(result: dict) -> list[dict]:
    """Return one row for each contender; times and the error at equal time are ratios to the first one of its row."""
    return [
        {
            "row": row["title"], "contender": name, "spp": c["spp"], "error": c["error"], "bias": c["bias"],
            "render": c["render"]["ratio"]["median"], "step": c["step"]["ratio"]["median"] if c["step"] else None,
            "memory_bytes": c["memory_bytes"], "disk_bytes": c["disk_bytes"],
            "error_at_equal_time": c["equal_time"]["ratio"],
        }
        for row in result["rows"].values() for name, c in row["contenders"].items()
    ]  # fmt: skip


def lines(result: dict) -> list[str]:
    """Return the table of a result as lines of text."""
    rows = table(result)
    forms = ["", "", "", ".2e", ".1e", ".2f", ".2f", ",", ",", ".2f"]
    cells = [[key.replace("_", " ") for key in rows[0]]] if rows else []
    cells += [["-" if v is None else format(v, f) for v, f in zip(row.values(), forms, strict=True)] for row in rows]
    note = f"error: relative mean squared error at {result['spp']} samples a pixel, against many samples of the first"
    return [*report.grid(cells), "", note, "times, error at equal time: ratios to the first contender of a row"]


def picture(result: dict):
    """Return a Matplotlib figure: error against the time of a render, a panel for each row.

    Marks are measured; curves are the law noise / samples + squared bias through them.
    """
    columns = min(3, len(result["rows"]))
    rows = -(-len(result["rows"]) // columns)
    side = result["sides"]["render"]
    caption = (
        f"Marks: renders of {side} × {side} pixels with {result['spp']} samples a pixel, unless named, and with those "
        "that fit in the time of the first contender. Curves: noise falls with the samples, bias stays."
    )
    figure = plot.figure("What accuracy costs: error against render time", caption, 4.2 * columns, 3.4 * rows)
    for k, row in enumerate(result["rows"].values()):
        axes = figure.add_subplot(rows, columns, k + 1, xscale="log", yscale="log")
        first = next(iter(row["contenders"]))
        base = row["contenders"][first]["render"]["seconds"]["median"]
        for (name, c), (colour, marker) in zip(row["contenders"].items(), plot.STYLES, strict=False):
            at = c["render"]["seconds"]["median"] / base
            times = np.geomspace(min(at, 1) / 4, 16, 60)
            axes.plot(times, c["noise"] * at / times + (c["bias"] or 0), color=colour, linewidth=1.1)
            measured = [(at, c["error"]), (c["equal_time"]["seconds"]["median"] / base, c["equal_time"]["error"])]
            axes.plot(*zip(*measured, strict=True), marker, color=colour, label=name, markersize=5)
        plot.log_ticks(axes.xaxis, *axes.get_xlim())
        axes.set_title(row["title"], fontsize=10)
        axes.legend(fontsize=7, frameon=False)
        plot.finish(axes, f"time of a render / that of {first}", "relative mean squared error")
    return figure
