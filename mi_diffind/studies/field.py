"""Study ``tradeoff field``: the radiance field of a capture by ours and by other methods in equal bytes.

All contenders begin with one trained grid and are trained through the same images for the same number of steps. A
*sparse grid* has thirteen numbers of 8 bits at a node, a *codebook* holds colours found by k-means (the idea of VQRF).
*Paper* and *ours* are presets of ``fit field``. Cells that no ray sees are removed from the grid.

Bytes are those in memory of all that a read needs, the index included. Grids are as fine as the budget allows.

Errors are PSNR of sRGB values before white in held-out views: of the pixels of the foreground
(``psnr_foreground_db``) and of all pixels (``psnr_white_db``), which flatters.
"""

import argparse
import functools
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.sparse_grid import complete_cells
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting.loop import FitSettings, fit
from ..measure import plot
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender, load_arrays
from ..tasks.radiance import dense_bytes
from ..tasks.radiance import grid as grids
from ..tasks.radiance.compression import importance
from ..tasks.radiance.files import grid_of, load
from ..tasks.radiance.session import FieldSession, ImagesProblem, displayed
from ..tasks.radiance.views import load_views
from ..tasks.radiance.volume_field import VolumeField
from . import equal_memory
from .baselines import radiance_fields as rivals

#: Default budgets, as compression against a dense float32 grid. At the first one, all methods are trained and timed.
RATIOS = (75.0, 50.0, 200.0)

#: Default folder of the capture, and the scene that it is made from.
DEFAULT = "captures/group"
SCENE = "scenes/capture_group.xml"

#: Method → its label.
METHODS = {"sparse": "sparse grid, 8 bits", "codebook": "codebook", "paper": "paper", "ours": "ours"}

#: Method → preset of ``fit field``; the grid is that which all begin with.
GRID = "grid"
PRESETS = {"ours": "sparse", "paper": "paper", GRID: "grid"}

#: Settings of a run: nodes along the side of a cube with the volume of the initial grid, the steps of its training
#: (0: the preset's own), those of each training that begins with it, and further options of ``fit field``.
FULL = {"resolution": 128, "grid_steps": 0, "steps": 500, "options": {}}
QUICK = {"resolution": 20, "grid_steps": 30, "steps": 10, "options": {"downscale": 2}}

#: Sides of images in pixels that a quick run reduces larger ones to; all are at least halved.
QUICK_SIDE = 80

#: Settings of the training through images.
SETTINGS = FitSettings(seed=1, batch=8192, lr=2e-3, loss="mse", schedule="cosine", check_every=50, deterministic=False)

#: Learning rate of grids that are coarser than the initial one. At this rate, a trained grid gets worse in test views.
COARSER_RATE = 5e-3

#: Largest number of entries of a codebook, which takes at most a quarter of the budget.
ENTRIES = 2**12

#: The two figures that are always given together.
FOREGROUND = "psnr_foreground_db"
WHITE = "psnr_white_db"


class RadianceStudy(Study):
    """Study of radiance fields in equal bytes: errors in held-out views, and times of reads."""

    name = "field"
    title = "the radiance field of a capture, in equal bytes, views and reads"
    example = "views"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default=DEFAULT, metavar="FOLDER",
            help=f"folder of views, as mi-diffind capture writes it (default: {DEFAULT})",
        )  # fmt: skip
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="compression against a dense float32 grid; may be repeated (default: "
            f"{', '.join(f'{r:g}' for r in RATIOS)}; --quick: 75); all methods are trained and timed at the first one",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and read the views; raise :class:`~mi_diffind.tasks.radiance.views.ViewsError`."""
        default = ("75",) if arguments.quick else map(str, RATIOS)
        arguments.ratios = tuple(dict.fromkeys(map(parse_compression, arguments.compression or default)))
        if arguments.source == DEFAULT and not Path(DEFAULT).exists():
            raise ValueError(f'there is no folder "{DEFAULT}": make it by mi-diffind capture {SCENE} -o {DEFAULT}')
        arguments.settings = SimpleNamespace(ratios=arguments.ratios, **(QUICK if arguments.quick else FULL))
        if arguments.quick:
            side = int(load_views(arguments.source, "test", most=1, downscale=1).sizes.max())
            arguments.settings.options = {"downscale": max(2, side // QUICK_SIDE)}
        downscale = arguments.settings.options.get("downscale")
        arguments.views = [load_views(arguments.source, split, downscale=downscale) for split in ("train", "test")]

    def plan(self, arguments) -> Plan:
        session = FieldSession(array_module(mi.variant()), *arguments.views)
        return plan(session, arguments.source, arguments.settings)


STUDY = RadianceStudy()


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class RadianceStudyContext:
    """State shared by all contenders: the session of the capture in the folder ``source``, and their grid."""

    session: FieldSession
    source: str
    settings: SimpleNamespace

    @functools.cached_property
    def grid(self) -> Contender:
        """Contender of the grid."""
        return preset_contender(self, {"name": GRID, "method": GRID, "budget": 1.0})

    @functools.cached_property
    def trained(self) -> grids.NodeGrid:
        """The trained grid."""
        return grid_of(load(self.grid.file), self.session.types)

    @functools.cached_property
    def cells(self) -> np.ndarray:
        """The cells of the trained grid that some ray sees."""
        return grids.visible(self.trained, self.session.images)

    def nbytes(self, ratio: float) -> float:
        """Return the bytes of a compression of the dense float32 grid."""
        return dense_bytes(self.trained.nodes.shape) / ratio

    def record(self, model: VolumeField, nbytes: int, file_bytes: int, **details) -> dict:
        """Return the record of a contender, with its errors."""
        details |= {"memory_bytes": nbytes, "file_bytes": file_bytes}
        return {"bytes": nbytes, "errors": self.session.held_out_images.evaluate(model), "details": details}


def preset_contender(context: RadianceStudyContext, fields: dict) -> Contender:
    """Return a contender that a preset of ``fit field`` trains: the grid itself, or from the grid."""
    settings = context.settings

    def fit_field(job: Contender, progress: bool) -> dict | None:
        arguments = {"source": context.source, **settings.options}
        if job.method == GRID:  # the other methods store numbers of directions
            arguments |= {"resolution": settings.resolution, "colours": "directions"}
            arguments |= {"steps": settings.grid_steps} if settings.grid_steps else {}
        else:
            nbytes = str(round(context.nbytes(job.budget)))
            arguments |= {"grid": str(context.grid.file), "bytes": nbytes, "steps": settings.steps}
        trained = equal_memory.fit_preset(job, progress, "field", "field", PRESETS[job.method], arguments)
        if trained is None:
            return None
        model, fitted = trained
        details = {"steps": fitted.result.steps, "nodes": model.field.nodes.count}
        return context.record(job.model, model.memory_nbytes, job.file.stat().st_size, **details)

    return Contender(fit=fit_field, read=lambda job: equal_memory.open_preset(job, "field").field, **fields)


def rival_contender(context: RadianceStudyContext, fields: dict) -> Contender:
    """Return a rival that is trained through the images as it is stored, and as fine as the budget allows."""
    settings, types = context.settings, context.session.types

    def train(job: Contender, progress: bool) -> dict | None:
        nbytes = context.nbytes(job.budget)
        entries = min(ENTRIES, int(nbytes / 64)) if job.method == "codebook" else 0
        grid = rivals.fitting_grid(context.trained, context.cells, nbytes, entries)
        trained = rivals.NodesFit(grid, importance(grid, context.session, SETTINGS.seed), entries)
        rate = COARSER_RATE if grid.nodes.spacing > context.trained.nodes.spacing else SETTINGS.lr
        problem = ImagesProblem(context.session, trained.net, trained.field_of)
        problem.measure = lambda net: {"step": 0.0}  # the last step counts for all contenders
        options = replace(SETTINGS, lr=rate, steps=settings.steps, measure_every=settings.steps)
        result = fit(problem, options, progress=progress, title=job.name)
        if result.interrupted:
            return None
        trained.net = problem.net
        state = trained.state()
        job.save_arrays(**state)
        job.model = rivals.NodesFit.field(types, state)
        details = {"steps": result.steps, "nodes": grid.nodes.count}
        return context.record(job.model, job.model.nbytes, rivals.compressed_bytes(state), **details)

    return Contender(fit=train, read=lambda job: rivals.NodesFit.field(types, load_arrays(job.file)), **fields)


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(session: FieldSession, source: str, settings: SimpleNamespace) -> Plan:
    """Return the plan of the study for a session of the capture in the folder ``source``."""
    context, views, jobs = RadianceStudyContext(session, source, settings), session.views, []
    for method, ratio in equal_memory.combinations(METHODS, settings.ratios, ()):
        label, setting = METHODS[method], f"{ratio:g}×"
        fields = {"name": f"{label} {setting}", "method": method, "budget": ratio, "label": label, "setting": setting}
        jobs.append((preset_contender if method in PRESETS else rival_contender)(context, fields))
    shown = jobs[: len(METHODS)]
    candidates = [
        Candidate(GRID, "reference", job=GRID, is_reference=True, label="initial grid", details={"kind": GRID})
    ]
    return Plan(
        study="field",
        title=f"Radiance fields of the capture {Path(source).name}: held-out views against bytes and time",
        candidates=candidates + [job.candidate() for job in jobs],
        cases=[Case("reads", functools.partial(_reads, context, [context.grid, *shown]))],
        ratios=[(shown[-1].name, job.name) for job in shown[:-1]],
        details={
            "source": source, "source_digest": views.digest + session.held_out.digest, "request": vars(settings)
        },
        notes=[
            f"{Path(source).name}, {len(views)} views and {len(session.held_out)} to test. "
            "Bytes in memory, index included; paper packs corners of cells for reading, in more bytes than asked for.",
        ],
        jobs=[context.grid, *jobs],
        panels=("bytes",),
        pictures={"views": functools.partial(draw_views, context, shown)},
        measures=(Measure("PSNR of the foreground, dB", FOREGROUND), Measure("of all pixels", WHITE)),
    )  # fmt: skip


def _reads(context: RadianceStudyContext, jobs: list[Contender], lanes: int) -> dict:
    """Return queries of density, and of density and colour, at random points of the visible cells."""
    types, nodes = context.session.types, context.trained.nodes
    rng = np.random.default_rng(1)
    cells = np.argwhere(context.cells & complete_cells(nodes.stored))
    places = cells[rng.integers(len(cells), size=lanes)] + rng.random((lanes, 3))
    away = rng.normal(size=(lanes, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    p, d = (
        types.Array3f(*(types.Float(np.ascontiguousarray(v, np.float32)) for v in rows.T))
        for rows in (np.array(nodes.lower) + places * nodes.spacing, away)
    )
    dr.make_opaque(p, d)

    def both(model: VolumeField) -> list:
        density, point_data = model.density_at(p)
        return [density, *model.radiance_at(point_data, p, d)]

    queries = {query: {FLOOR: lambda: [*p, *d]} for query in ("density", "both")}
    for job in jobs:
        queries["density"][job.name] = lambda f=job.model: [f.density_at(p)[0]]
        queries["both"][job.name] = lambda f=job.model: both(f)
    return queries


def draw_views(context: RadianceStudyContext, jobs: list[Contender], result: dict):
    """Draw the first test view by the fields at the first budget, and the differences to it."""
    truth = context.session.held_out.image(0)
    crop, reference = plot.crop_to(truth[..., 3] > 0), displayed(truth)
    views, differences = {"held-out view": reference[crop]}, {"held-out view": reference[crop]}
    for job in jobs:
        picture = displayed(context.session.held_out_images.render(job.model, 0))
        errors = result["candidates"][job.name]["errors"]
        views[f"{job.label}\n{errors[FOREGROUND]:.2f} dB"] = picture[crop]
        differences[job.label] = np.abs(picture - reference).mean(axis=-1)[crop]
    rows = {"": views, "difference": differences}
    title = f"A held-out view by fields {context.settings.ratios[0]:g}× smaller than a dense grid, and their errors"
    notes = ["dB: PSNR of the foreground in all held-out views.", *result["notes"]]
    return plot.draw_images(title, " ".join(notes), rows, 1.6, "difference of sRGB values")
