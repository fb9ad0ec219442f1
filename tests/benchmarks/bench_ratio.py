"""
Errors of the preset ``paper`` by the ratio ρ = N_p / N_c, side of the primary over side of the cascaded array.

    python tests/benchmarks/bench_ratio.py [image texture sdf field] [--json docs/measured/bench_ratio.json]

This is the sweep behind tables 2, 4, 5 and 6 of the paper's supplement, on smaller data: the colours of the tiles at
1024² by ``scenes/make_tiles.py`` for images and textures, Suzanne for distance fields, and a small capture of
``capture_group.xml`` for radiance fields. Density and colour of a radiance field have a ratio each; one is varied with
the default of the other. Images are swept with our preset as well, by the side of the cascaded array.

For images and textures, N_p is a multiple of 8 and N_c a multiple of 4, as in the supplement's search, and bytes are
those of the budget within 5%. Other tasks take the largest whole sides that fit: bytes are at most 7% below the budget.
A training has a fixed number of steps and one seed. ``--seeds 2`` adds trainings by a second seed, whose difference
from the first is the noise of a training. Batches are smaller than those of the presets, so all trainings are shorter;
rates, losses and schedules are the presets'.

Each training is written to the file as soon as it ends, and is not repeated by the next run with the same steps: a run
that was interrupted goes on. Budgets are trained in turn, so that an early end leaves the sweep of the first budgets.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import runpy
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import ROOT, VARIANT, earlier, parser, write

import mi_diffind
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest, tasks
from mi_diffind.maps.source import load_source
from mi_diffind.measure import clock
from mi_diffind.tasks.image import PRESETS
from mi_diffind.tasks.image import arrays as image_budget
from mi_diffind.tasks.image.fit import default_size
from mi_diffind.tasks.radiance import dense_bytes, files, ratio_for
from mi_diffind.tasks.radiance import fit as field_fit
from mi_diffind.tasks.radiance import paper as field_paper
from mi_diffind.tasks.sdf import paper as sdf_paper
from mi_diffind.tasks.sdf.model import build_field
from mi_diffind.tasks.texture import arrays as texture_budget

#: Side and channels of the image, and the largest difference of bytes from those of a budget.
SIDE, CHANNELS, TOLERANCE = 1024, 3, 0.05

#: Task → budgets: compressions of images and textures, bytes of distance fields, compressions of radiance fields.
BUDGETS = {"image": (12, 24, 3), "texture": (12, 24), "sdf": (256_000, 1_000_000), "field": (50, 25)}

#: Task → steps and batch of a training.
STEPS = {"image": (800, 2**16), "texture": (800, 2**16), "sdf": (300, 2**16), "field": (60, 2**13)}

#: Sides of the cascaded array: of ours, and the largest of the paper's that are tried.
OURS, LARGEST = (4, 8, 12, 16, 24), {"image": 20, "texture": 32}

#: Ratios of the other tasks; the defaults of a budget are added.
SDF_RATIOS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0)
FIELD_RATIOS = {"density": (1.5, 3.0, 5.0), "colour": (2.0, 3.0, 7.0)}

#: Training samples of a distance field, held-out points on the way, and points at which the result is measured.
SAMPLES, HELD_OUT, MEASURED = 2**18, 2**14, 2**18

#: Views of the capture: training, test, side, samples a pixel; resolution of the grid and its steps.
VIEWS, TEST, PIXELS, SPP, RESOLUTION, GRID_STEPS = 24, 4, 64, 16, 64, 300


@dataclass(frozen=True)
class Layout:
    """Sides of the arrays of one training.

    ``ratio`` is ρ = ``primary`` / ``cascaded``, ``nbytes`` the bytes of all arrays, and ``default`` says whether the
    preset takes this side of the cascaded array if no ratio is given. ``part`` is "density" or "colour" for a radiance
    field, else "".
    """

    task: str
    preset: str
    budget: float
    ratio: float
    primary: float
    cascaded: int
    nbytes: int
    default: bool = False
    part: str = ""

    @property
    def key(self) -> tuple:
        """Values that identify the training."""
        return (self.task, self.preset, self.budget, self.part, round(self.ratio, 3))


def wanted_bytes(budget: float) -> float:
    """Return the bytes of a compression ratio of the image."""
    return SIDE**2 * CHANNELS / budget


def planar_bytes(task: str, primary: int, cascaded: int) -> int:
    """Return the bytes of the paper's arrays of an image or a texture."""
    if task == "image":
        return image_budget.ImageBudget(primary, primary, cascaded, CHANNELS).nbytes
    return texture_budget.PaperBudget(primary, primary, texture_budget.lod_count(SIDE, SIDE), cascaded, CHANNELS).nbytes


def planar_layouts(task: str, budget: float) -> list[Layout]:
    """Return the layouts of images or textures for a compression ratio, the smallest cascaded array first."""
    nbytes, layouts = wanted_bytes(budget), []
    for cascaded in range(4, LARGEST[task] + 1, 4):
        primaries = range(8, SIDE + 1, 8)
        primary = min(primaries, key=lambda n, c=cascaded: abs(planar_bytes(task, n, c) - nbytes))
        actual = planar_bytes(task, primary, cascaded)
        if abs(actual / nbytes - 1) <= TOLERANCE:
            layouts.append(Layout(task, "paper", budget, primary / cascaded, primary, cascaded, actual))
    uncompressed = SIDE**2 * CHANNELS
    if task == "image":
        size = image_budget.search(uncompressed, budget, CHANNELS, SIDE, SIDE)
    else:
        size = texture_budget.paper_size(nbytes, uncompressed, CHANNELS, SIDE, SIDE)
    return [dataclasses.replace(layout, default=layout.cascaded == size.cascaded) for layout in layouts]


def our_layouts(budget: float) -> list[Layout]:
    """Return layouts of our preset for images, whose sides and bytes are known only after the training."""
    return [Layout("image", "ours", budget, cascaded, math.nan, cascaded, 0) for cascaded in OURS]


def sdf_layouts(budget: float, extent) -> list[Layout]:
    """Return the layouts of distance fields in a box of this ``extent``."""
    default, layouts = sdf_paper.ratio_for(budget), []
    for ratio in sorted({*SDF_RATIOS, default}):
        primary, cascaded = sdf_paper.resolutions(int(budget), ratio, extent)
        nbytes = 3 * math.prod(primary) + math.prod(cascaded)
        layouts.append(Layout("sdf", "paper", budget, ratio, max(primary), max(cascaded), nbytes, ratio == default))
    return layouts


def field_layouts(budget: float, shape, extent) -> list[Layout]:
    """Return the layouts of radiance fields for a compression of a grid of this ``shape`` and ``extent``."""
    nbytes, layouts = dense_bytes(shape) / budget, []
    shares = {"density": (1, field_fit.DENSITY_SHARE), "colour": (12, 1 - field_fit.DENSITY_SHARE)}

    def sized(part: str, ratio: float) -> tuple:
        channels, share = shares[part]
        primary, cascaded = field_paper.sides(share * nbytes, ratio, channels, extent)
        return primary, cascaded, 3 * math.prod(primary) + channels * math.prod(cascaded)

    defaults = {part: ratio_for(part, budget) for part in shares}
    for part, other in (("density", "colour"), ("colour", "density")):
        for ratio in sorted({*FIELD_RATIOS[part], defaults[part]}):
            primary, cascaded, actual = sized(part, ratio)
            total = actual + sized(other, defaults[other])[2]
            default = ratio == defaults[part]
            layouts.append(Layout("field", "paper", budget, ratio, max(primary), max(cascaded), total, default, part))
    return layouts


def request_of(task: str, preset: str, seed: int, **options) -> FitRequest:
    """Return the request of a training of this benchmark."""
    steps, batch = STEPS[task]
    changed = {"steps": steps, "batch": batch, "measure_every": steps, "seed": seed}
    settings = dataclasses.replace(tasks()[task].presets[preset], **changed)
    given = {argument.name: argument.default for argument in tasks()[task].arguments} | options
    return FitRequest(preset, settings, array_module("llvm"), options=given, progress=False, task=task)


#: A layout and a seed → bytes, ``primary`` where the layout leaves it open, and errors.
Training = Callable[[Layout, int], dict]


def planar_training(folder: Path) -> Training:
    """Return the training of images and textures, of tiles that are written to ``folder``."""
    source = folder / "tiles_albedo.png"
    if not source.is_file():
        names = runpy.run_path(str(ROOT / "scenes" / "make_tiles.py"))
        names["main"].__globals__.update(SIDE=SIDE, FOLDER=folder)
        names["main"]()

    def train(layout: Layout, seed: int) -> dict:
        steps, batch = STEPS[layout.task]
        given = {"ratio": layout.ratio, "bytes": layout.nbytes}
        if layout.preset == "ours":
            given = {"cascaded": layout.cascaded, "bytes": int(wanted_bytes(layout.budget))}
        fitted = mi_diffind.fit(
            layout.task, source, preset=layout.preset, steps=steps, batch=batch, seed=seed, progress=False, **given
        )
        table = fitted.table
        result = {"bytes": table.nbytes, **{k: v for k, v in table.measured.items() if k.endswith("_db")}}
        if layout.task == "texture":
            levels = [v for k, v in table.measured.items() if k.startswith("psnr_l")]
            result["psnr_levels_db"] = float(np.mean(levels))
        if layout.preset == "ours":
            ratio = table.settings["ratio"]
            recipe, wanted = PRESETS["ours"], wanted_bytes(layout.budget)
            default = default_size(load_source(source), wanted, recipe).cascaded == layout.cascaded
            result |= {"ratio": ratio, "primary": ratio * layout.cascaded, "default": default}
        return result

    return train


def sdf_training(distances) -> Training:
    """Return the training of distance fields of a mesh."""
    from mi_diffind.tasks.sdf.evaluation import SurfaceEvaluation

    evaluation = SurfaceEvaluation(distances.mesh, distances, MEASURED)

    def train(layout: Layout, seed: int) -> dict:
        request = request_of("sdf", "paper", seed, ratio=layout.ratio)
        extent = distances.mesh.upper - distances.mesh.lower
        shapes = sdf_paper.resolutions(int(layout.budget), layout.ratio, extent)
        problem = sdf_paper.PairProblem(distances, shapes, "ramp", request.types, seed, SAMPLES, HELD_OUT)
        request.train(problem)
        table = problem.table(seed)
        arrays = tasks()["sdf"].allocate(table, request.types.TensorXf)
        errors = evaluation.measure(build_field(table, arrays, request.types))
        return {"bytes": table.nbytes, **{name: float(f"{value:.6g}") for name, value in errors.items()}}

    return train


def field_training(session, grid) -> Training:
    """Return the training of radiance fields that compress a grid."""

    def train(layout: Layout, seed: int) -> dict:
        options = {"compression": layout.budget, f"{layout.part}_ratio": layout.ratio}
        request = request_of("field", "paper", seed, **options)
        table, _ = field_fit.FieldFit(request, session).pairs(grid, False)
        errors = session.held_out_images.evaluate(files.field_of(table, session.types))
        arrays = sum(array.nbytes for name, array in table.arrays.items() if name.startswith(("density_", "colour_")))
        return {"bytes": arrays, **errors}

    return train


def captured(folder: Path):
    """Return the session of a small capture in ``folder``, and its grid."""
    from mi_diffind.tasks.radiance.session import FieldSession

    views, path = folder / "views", folder / "grid.npz"
    if not path.is_file():
        # On one core, the loading of a scene in parallel waits for itself
        dr.set_thread_count(max(2, dr.thread_count()))
        scene = ROOT / "scenes" / "capture_group.xml"
        mi_diffind.capture(scene, views, views=VIEWS, test=TEST, resolution=PIXELS, spp=SPP)
        options = {"preset": "grid", "steps": GRID_STEPS, "resolution": RESOLUTION, "colours": "directions"}
        mi_diffind.fit("field", views, progress=False, **options).save(path)
    types = array_module("llvm")
    return FieldSession.load(types, views), files.grid_of(files.load(path), types)


def sweeps(names: list[str], folder: Path, stack) -> Iterator[tuple[Layout, Training]]:
    """Yield each layout with its training: the first budget of all tasks, then the second, and so on."""
    from mi_diffind.tasks.sdf.distances import Distances
    from mi_diffind.tasks.sdf.mesh import load_mesh

    trainings, distances, grid = {}, None, None
    for turn in range(max(len(BUDGETS[name]) for name in names)):
        for name in names:
            if turn >= len(BUDGETS[name]):
                continue
            budget = BUDGETS[name][turn]
            if name in ("image", "texture"):
                train = trainings.setdefault(name, planar_training(folder))
                layouts = planar_layouts(name, budget)
                layouts += our_layouts(budget) if (name, turn) == ("image", 0) else []
            elif name == "sdf":
                if distances is None:
                    mesh = load_mesh(str(ROOT / "scenes" / "assets" / "suzanne.ply"))
                    distances = stack.enter_context(Distances(mesh))
                    trainings[name] = sdf_training(distances)
                train, layouts = trainings[name], sdf_layouts(budget, distances.mesh.upper - distances.mesh.lower)
            else:
                if grid is None:
                    session, grid = captured(folder)
                    trainings[name] = field_training(session, grid)
                extent = np.array(grid.nodes.upper) - np.array(grid.nodes.lower)
                train, layouts = trainings[name], field_layouts(budget, grid.nodes.shape, extent)
            yield from ((layout, train) for layout in layouts)


#: Task → figure of the progress line.
SHOWN = {"image": "psnr_db", "texture": "psnr_levels_db", "sdf": "normal_deg", "field": "psnr_foreground_db"}


def main() -> None:
    """Train the layouts of the tasks that are named, or of all tasks."""
    command = parser(__doc__)
    command.add_argument("tasks", nargs="*", metavar="TASK", help=", ".join(BUDGETS))
    command.add_argument("--seeds", type=int, default=1, help="trainings of each layout, by seeds from 0 on")
    command.add_argument("--folder", help="folder for the image, the views and the grid, which a later run reads")
    arguments = command.parse_args()
    if unknown := set(arguments.tasks) - set(BUDGETS):
        command.error(f"unknown task {', '.join(sorted(unknown))}: allowed are {', '.join(BUDGETS)}")
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    rows = earlier(arguments.json, rows=[])["rows"]

    def identity(layout: Layout, seed: int) -> list:
        return [*layout.key[:-1], layout.cascaded, round(layout.primary, 3) if layout.primary == layout.primary else 0,
                seed, *STEPS[layout.task]]  # fmt: skip

    with contextlib.ExitStack() as stack:
        folder = arguments.folder or stack.enter_context(tempfile.TemporaryDirectory())
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(arguments.seeds):
            for layout, train in sweeps(arguments.tasks or list(BUDGETS), folder, stack):
                name = identity(layout, seed)
                if any(row["identity"] == name for row in rows):
                    continue
                steps, batch = STEPS[layout.task]
                row = {**dataclasses.asdict(layout), "seed": seed, "steps": steps, "batch": batch, "identity": name}
                del row["nbytes"]
                row |= train(layout, seed)
                rows.append(row)
                part = f" {layout.part}" if layout.part else ""
                figure = f"{SHOWN[layout.task]} {row[SHOWN[layout.task]]:.4g}"
                print(
                    f"{layout.task}{part} {layout.preset} {layout.budget:g}: ρ {row['ratio']:.3g} = "
                    f"{row['primary']:.4g} / {row['cascaded']}, {row['bytes']:,} bytes, seed {seed}: {figure}",
                    flush=True,
                )
                write(arguments.json, {"machine": clock.machine(VARIANT), "side": SIDE, "rows": rows})


if __name__ == "__main__":
    main()
