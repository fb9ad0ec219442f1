"""Study ``tradeoff field``: the radiance field of a capture by ours and by other methods in equal bytes.

All contenders begin with one trained grid and are trained through the same images for the same number of steps.
*Sparse* grids have thirteen numbers of 8 bits at a node, or 6 bits for colours. A *codebook* holds colours found by
k-means (the idea of VQRF). The *hash grid* is that of ``drjit.nn`` with a network. *Paper* and *ours* are presets of
``fit field``. Cells that no ray sees are removed from all by the same rule.

Equal bytes: ours is counted in memory, index included; all others on disk, where the numbers of grids are predicted
from their neighbours and deflated. Grids are as fine as the budget allows: a coarser grid is trained for half of the
steps, loses the cells that no ray sees, and is trained in its stored form for the other half. The network, whose steps
take longer, has the time ``--seconds``.

Errors are PSNR of sRGB values before white in held-out views: of the pixels of the foreground
(``psnr_foreground_db``) and of all pixels (``psnr_white_db``), which flatters.
"""

from __future__ import annotations

import argparse
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.progress import Deadline
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting.loop import FitSettings, fit
from ..measure import plot
from ..measure.report import figure_caption
from ..measure.store import fingerprint, package_files
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..tasks.radiance import dense_bytes
from ..tasks.radiance import grid as grids
from ..tasks.radiance.files import grid_of, load
from ..tasks.radiance.march import march
from ..tasks.radiance.session import FieldSession, ImagesProblem, displayed
from ..tasks.radiance.views import load_views
from ..tasks.radiance.volume_field import NodeField, VolumeField
from . import equal_memory
from .baselines import radiance_fields as rivals
from .equal_memory import Contender

#: Default budgets, as compression against a dense float32 grid. At the first one, all methods are trained and timed.
RATIOS = (75.0, 50.0, 200.0)

#: Default folder of the capture, and the scene that it is made from.
DEFAULT = "captures/group"
SCENE = "scenes/capture_group.xml"

#: Method → its label, and the group that it belongs to in pictures. Those of :data:`ONCE` have the first budget only.
METHODS = {
    "sparse": ("sparse grid, 8 bits", "grid"), "sparse6": ("sparse grid, 6-bit colours", "grid"),
    "codebook": ("codebook", "codes"), "hash": ("hash grid + network", "network"),
    "paper": ("paper", "supplement's arrays"), "ours": ("ours", "ours"),
}  # fmt: skip
ONCE = ("hash",)

#: Method → preset of ``fit field``.
PRESETS = {"ours": "sparse", "paper": "paper"}

#: Methods by whose times ours is divided.
AGAINST = ("sparse", "codebook", "paper")

#: References: the grid that all begin with, and the same grid trained for as many steps as the contenders.
GRID = "grid"
LONGER = "grid, trained on"

#: Settings of the training through images.
SETTINGS = FitSettings(seed=1, batch=8192, lr=2e-3, loss="mse", schedule="cosine", check_every=50, deterministic=False)

#: Learning rates of contenders that begin far from their optimum. At these, a trained grid gets worse in test views.
COARSER_RATE = 5e-3
HASH_RATE = 1e-2

#: Share of a budget that untrained numbers may take, since trained numbers deflate less.
ROOM = 0.97

#: Expected share of its bytes that a coarser grid keeps when cells that no ray sees are removed.
SHRINK = 0.8

#: Weights in a ray, in units of the default, below which cells of a coarser grid are removed: the first that fits.
LADDER = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0, 6.0, 9.0)

#: Entries of a codebook, in the order in which they are tried.
COUNTS = (2**14, 2**12, 2**10)

#: Largest ratio of node distances of a coarser grid.
COARSEST = 6.0

#: The two figures that are always given together.
FOREGROUND = "psnr_foreground_db"
WHITE = "psnr_white_db"


def ratio_text(ratio: float) -> str:
    """Return a compression as text, such as ``"75×"``."""
    return f"{ratio:g}×"


def references(result: dict) -> dict[str, dict]:
    """Return the reference candidates by name: the initial grid, and the grid that is trained on."""
    return {name: c for name, c in result["candidates"].items() if c["is_reference"] and c["errors"]}


class RadianceStudy(Study):
    """Study of radiance fields in equal bytes: errors in held-out views, and the times of reads and renders."""

    name = "field"
    title = "the radiance field of a capture, in equal bytes, views, reads and renders"
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
        equal_memory.add_without_option(parser)
        parser.add_argument(
            "--resolution", type=int, default=0, metavar="N",
            help="nodes along the side of a cube of the same volume, of the initial grid (default: 128; --quick: 24)",
        )  # fmt: skip
        parser.add_argument(
            "--steps", type=int, default=0, metavar="N", help="steps of each training through the images (default: 500)"
        )
        parser.add_argument(
            "--seconds", type=float, default=0.0, metavar="S",
            help="seconds of the training of the network, whose steps take long (default: 90)",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and read the views; raise :class:`~mi_diffind.tasks.radiance.views.ViewsError`."""
        default = ("75",) if arguments.quick else map(str, RATIOS)
        arguments.ratios = tuple(dict.fromkeys(map(parse_compression, arguments.compression or default)))
        equal_memory.check_without(arguments.without, METHODS)
        for name, least in (("resolution", 8), ("steps", 2)):
            value = getattr(arguments, name)
            if value and value < least:
                raise ValueError(f"--{name}: found {value}, at least {least} is needed")
        if not 0 <= arguments.seconds < float("inf"):
            raise ValueError(f"--seconds: found {arguments.seconds:g}, allowed are numbers that are not negative")
        if arguments.source == DEFAULT and not Path(DEFAULT).exists():
            raise ValueError(f'there is no folder "{DEFAULT}": make it by mi-diffind capture {SCENE} -o {DEFAULT}')
        arguments.views = tuple(load_views(arguments.source, split) for split in ("train", "test"))

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        settings = SimpleNamespace(
            ratios=arguments.ratios,
            without=tuple(arguments.without),
            resolution=arguments.resolution or (24 if quick else 128),
            grid_steps=60 if quick else 0,  # of the initial grid; 0: as its preset says
            steps=arguments.steps or (40 if quick else 500),
            seconds=arguments.seconds or (3.0 if quick else 90.0),
            film=48 if quick else 200,  # pixels on a side of the timed picture
        )
        session = FieldSession(array_module(mi.variant()), *arguments.views)
        return plan(session, arguments.source, settings)


STUDY = RadianceStudy()


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class RadianceStudyContext:
    """State shared by all contenders: the session of the capture in the folder ``source``, and their grid."""

    session: FieldSession
    source: str
    settings: SimpleNamespace
    jobs: dict[str, Contender] = field(default_factory=dict)

    @property
    def types(self):
        """The module of Dr.Jit types."""
        return self.session.types

    @functools.cached_property
    def node_grid(self) -> grids.NodeGrid:
        """The trained grid."""
        return grid_of(load(self.jobs[GRID].file), self.types)

    @functools.cached_property
    def grid(self) -> rivals.WeightedGrid:
        """The visible part of the trained grid."""
        return self.visible(self.node_grid.field())

    def visible(self, trained: NodeField, least: float = 1.0) -> rivals.WeightedGrid:
        """Return a grid without the cells whose largest weight in a ray is below ``least`` · :data:`.grid.VISIBLE`."""
        grid = rivals.WeightedGrid.of(trained, rivals.visibility(trained, self.session.images))
        seen = grids.weights(trained, self.session.images) >= least * grids.VISIBLE
        return grid.kept(trained.nodes.cells_where(seen))

    @functools.cached_property
    def dense_bytes(self) -> int:
        """Bytes of the dense float32 grid, to which ratios refer."""
        return dense_bytes(self.node_grid.nodes.shape)

    def budget_bytes(self, job: Contender) -> int:
        """Return the budget of a contender in bytes."""
        return round(self.dense_bytes / job.budget)

    def train(self, trained_fit, rate: float, steps: int, progress: bool, title: str, seconds: float | None = None):
        """Train a fit in place at a learning rate and return the result; the last step counts for all contenders."""
        problem = ImagesProblem(self.session, trained_fit.net, trained_fit.field_of)
        problem.measure = lambda net: {"step": 0.0}
        settings = replace(SETTINGS, lr=rate, steps=steps, measure_every=steps)
        result = fit(problem, settings, progress=progress, title=title, deadline=seconds and Deadline(seconds))
        trained_fit.net = problem.net
        return result

    def errors(self, trained: VolumeField) -> dict[str, float]:
        """Return the PSNR of a field in the held-out views."""
        return self.session.held_out_images.evaluate(trained)

    def record(self, job: Contender, nbytes: int, file_bytes: int, **details) -> dict:
        """Return the record of a contender that has a model, with its errors."""
        details |= {"memory_bytes": nbytes, "file_bytes": file_bytes, "dense_bytes": self.dense_bytes}
        counted = nbytes if job.method == "ours" else file_bytes
        return {"bytes": counted, "errors": self.errors(job.model), "details": details}

    def finish(self, job: Contender, trained_fit, **details) -> dict:
        """Store a trained fit, set the model and return the record."""
        state = trained_fit.state()
        job.save_arrays(**state)
        job.model = trained_fit.field(self.types, state)
        return self.record(job, job.model.nbytes, trained_fit.file_bytes(state), **details)


def preset_contender(name: str, method: str, ratio: float, context: RadianceStudyContext, **fields) -> Contender:
    """Return a contender that a preset of ``fit field`` trains: the grid itself, or from the grid."""
    settings = context.settings

    def fit_field(job: Contender, progress: bool) -> dict | None:
        arguments = {"source": context.source}
        if method == GRID:  # the other methods store numbers of directions
            arguments |= {"resolution": settings.resolution, "colours": "directions"}
            arguments |= {"steps": settings.grid_steps} if settings.grid_steps else {}
        else:
            arguments |= {"grid": str(context.jobs[GRID].file), "bytes": str(context.budget_bytes(job)),
                          "steps": settings.steps}  # fmt: skip
        trained = equal_memory.fit_preset(job, progress, "field", "field", PRESETS.get(method, method), arguments)
        if trained is None:
            return None
        model, fitted = trained
        details = {"steps": fitted.result.steps, "nodes": model.field.nodes.count}
        return context.record(job, model.memory_nbytes, job.file.stat().st_size, **details)

    return Contender(name, method, ratio, fit_field, lambda job: equal_memory.open_preset(job, "field").field, **fields)


def longer_reference(context: RadianceStudyContext) -> Contender:
    """Return the reference that is the grid after as many more steps as the contenders have."""

    def train(job: Contender, progress: bool) -> dict | None:
        steps = context.settings.steps
        problem = grids.GridProblem(context.node_grid, context.session)
        problem.measure = lambda net: {"step": 0.0}
        settings = replace(SETTINGS, steps=steps, measure_every=steps)
        if fit(problem, settings, progress=progress, title=job.name).interrupted:
            return None
        grid = problem.grid()
        job.save_arrays(density=grid.density, colour=grid.colour)
        job.model = grid.field()
        nbytes = 52 * grid.nodes.count
        return context.record(job, nbytes, nbytes, steps=steps)

    def read(job: Contender) -> VolumeField:
        return grids.NodeGrid(context.node_grid.nodes, **equal_memory.load_arrays(job.file)).field()

    return Contender(LONGER, "longer", 1.0, train, read)


def node_bytes(nodes_fit: rivals.NodesFit) -> int:
    """Return the bytes of a fit on disk."""
    return nodes_fit.file_bytes(nodes_fit.state())


def fit_nodes(context: RadianceStudyContext, job: Contender, progress: bool) -> dict | None:
    """Train a rival on nodes, a grid or a codebook, as fine as the budget allows."""
    makers: list[Callable] = [functools.partial(rivals.plain, levels=64 if job.method == "sparse6" else 256)]
    if job.method == "codebook":
        makers = [functools.partial(rivals.codebook, count=n) for n in COUNTS]
    room = ROOM * context.budget_bytes(job)
    make, scale = choose_nodes(context.grid, makers, room)
    steps = rest = context.settings.steps
    rate = COARSER_RATE if scale > 1 else SETTINGS.lr
    if scale > 1:
        first, rest = rivals.plain(context.grid.resampled(scale)), steps - steps // 2
        if context.train(first, rate, steps - rest, progress, f"{job.name}, at first").interrupted:
            return None
        for least in LADDER:
            stored = make(context.visible(first.field_of(first.net), least))
            if node_bytes(stored) <= room:
                break
    else:
        stored = make(context.grid)
    if context.train(stored, rate, rest, progress, job.name).interrupted:
        return None
    entries = len(stored.state()["colour"]) if job.method == "codebook" else 0
    return context.finish(job, stored, steps=steps, coarser=scale, nodes=stored.nodes.count, entries=entries)


def choose_nodes(grid: rivals.WeightedGrid, makers: list[Callable], room: float) -> tuple[Callable, float]:
    """Return the first of the ``makers`` of a fit that is within ``room`` bytes, and the ratio of node distances.

    The ratio is 1 if a fit of the grid itself is within them.
    """
    sizes = []
    for make in makers:
        sizes.append(node_bytes(make(grid)))
        if sizes[-1] <= room:
            return make, 1.0
    chosen = min(1, len(makers) - 1)
    rate, low, high = SHRINK * sizes[chosen] / grid.nodes.count, 1.0, COARSEST
    for _ in range(12):
        scale = math.sqrt(low * high)
        fits_in = rate * np.count_nonzero(grid.coarser(scale)) <= room
        low, high = (low, scale) if fits_in else (scale, high)
    return makers[chosen], high


def fit_hash(context: RadianceStudyContext, job: Contender, progress: bool) -> dict | None:
    """Train a hash grid and a network."""
    finest = float(max(context.grid.nodes.shape))
    entries = rivals.hash_entries(0.97 * context.budget_bytes(job), finest)
    hash_fit = rivals.HashVolumeFit(context.grid, entries, finest)
    result = context.train(hash_fit, HASH_RATE, 10**6, progress, job.name, context.settings.seconds)
    return None if result.interrupted else context.finish(job, hash_fit, steps=result.steps)


def contender(method: str, ratio: float, context: RadianceStudyContext) -> Contender:
    """Return the contender of a method at a ratio."""
    label, family = METHODS[method]
    name, fields = f"{label} {ratio_text(ratio)}", {"label": label, "family": family, "setting": ratio_text(ratio)}
    if method in PRESETS:
        return preset_contender(name, method, ratio, context, **fields)
    train = fit_hash if method == "hash" else fit_nodes
    rival = rivals.HashVolumeFit if method == "hash" else rivals.NodesFit

    def read(job: Contender) -> VolumeField:
        return rival.field(context.types, equal_memory.load_arrays(job.file))

    return Contender(name, method, ratio, functools.partial(train, context), read, **fields)


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(session: FieldSession, source: str, settings: SimpleNamespace) -> Plan:
    """Return the plan of the study for a session of the capture in the folder ``source``."""
    context = RadianceStudyContext(session, source, settings)
    views, held_out, first, jobs = session.views, session.held_out, settings.ratios[0], context.jobs
    height, width = views.sizes[0].tolist()
    jobs |= {GRID: preset_contender(GRID, GRID, 1.0, context), LONGER: longer_reference(context)}
    for method, ratio in equal_memory.combinations(METHODS, settings.ratios, ONCE, settings.without):
        job = contender(method, ratio, context)
        jobs[job.name] = job
    candidates = [
        Candidate(name, "reference", job=name, is_reference=True, details={"kind": jobs[name].method})
        for name in (GRID, LONGER)
    ]
    candidates += [job.candidate() for job in jobs.values() if job.method in METHODS]
    shown = [name for name, job in jobs.items() if job.budget == first and job.method in METHODS]
    ours = next((n for n in shown if jobs[n].method == "ours"), "")
    timed = tuple([GRID, *shown])
    cases = [
        Case("reads", lambda lanes: _reads(context, timed, lanes), lambda: _renders(context, timed)),
    ]
    code = package_files("tasks/radiance/*.py", "fitting/loop.py", "studies/field.py",
                         "studies/baselines/radiance_fields.py")  # fmt: skip
    return Plan(
        study="field",
        title=f"Radiance field: {Path(source).name}",
        candidates=candidates,
        cases=cases,
        ratios=[(ours, n) for n in shown if jobs[n].method in AGAINST] if ours else [],
        details={
            "source": source, "source_digest": views.digest + held_out.digest, "views": [len(views), len(held_out)],
            "pixels": [width, height], "request": vars(settings), "first": first,
        },
        notes=[
            f"{Path(source).name}, {len(views)} views of {width} × {height} and {len(held_out)} to test. "
            "Equal bytes: ours in memory, the others on disk, deflated.",
        ],
        jobs=list(jobs.values()),
        jobs_fingerprint=fingerprint(code) + views.digest[:16],
        panels=("bytes",),
        pictures={"views": functools.partial(draw_views, context)},
        measures=(Measure("PSNR of the foreground, dB", FOREGROUND), Measure("of all pixels", WHITE)),
    )  # fmt: skip


def _reads(context: RadianceStudyContext, names, lanes: int) -> dict:
    """Return queries of density, and of density and colour, at random points of the visible cells."""
    types, nodes = context.types, context.grid.nodes
    rng = np.random.default_rng(1)
    cells = np.argwhere(context.grid.cells())
    places = cells[rng.integers(len(cells), size=lanes)] + rng.random((lanes, 3))
    points = np.float32(np.array(nodes.lower) + places * nodes.spacing)
    away = rng.normal(size=(lanes, 3))
    away = np.float32(away / np.linalg.norm(away, axis=1, keepdims=True))
    p, d = (types.Array3f(*(types.Float(np.ascontiguousarray(v)) for v in rows.T)) for rows in (points, away))
    dr.make_opaque(p, d)

    def both(model: VolumeField) -> list:
        density, point_data = model.density_at(p)
        return [density, *model.radiance_at(point_data, p, d)]

    queries = {query: {FLOOR: lambda: [*p, *d]} for query in ("density", "both")}
    for name in names:
        model = context.jobs[name].model
        queries["density"][name] = lambda f=model: [f.density_at(p)[0]]
        queries["both"][name] = lambda f=model: both(f)
    return queries


def _renders(context: RadianceStudyContext, names) -> dict:
    """Return renders of the first held-out view, one ray a pixel."""
    types, side = context.types, context.settings.film
    images = context.session.held_out_images
    lane = dr.arange(types.UInt32, side * side)
    tile, pixel = lane // 16, lane % 16
    across = side // 4
    x, y = (tile % across) * 4 + pixel % 4, (tile // across) * 4 + pixel // 4
    height, width = images.views.sizes[0].tolist()
    scale = [width / side, height / side]
    o, d = images.rays(
        types.UInt32(0), (types.Float(x) + 0.5) * scale[0] - 0.5, (types.Float(y) + 0.5) * scale[1] - 0.5
    )
    dr.make_opaque(o, d)

    def render(model):
        seen = march(model, o, d, 0, dr.inf)
        return [*seen.colour, seen.transmittance]

    return {name: lambda k, f=context.jobs[name].model: render(f) for name in names}


def draw_views(context: RadianceStudyContext, result: dict):
    """Draw the first test view by all fields at the first budget, and the differences to it."""
    truth, first = context.session.held_out.image(0), result["details"]["first"]
    crop, reference = plot.crop_to(truth[..., 3] > 0), displayed(truth)
    views, differences = {"test view": reference[crop]}, {"": reference[crop]}
    for job in context.jobs.values():
        if job.budget == first and job.method in METHODS:
            picture = displayed(context.session.held_out_images.render(job.model, 0))
            errors = result["candidates"][job.name]["errors"]
            views[f"{job.label}\n{errors[WHITE]:.2f} / {errors[FOREGROUND]:.2f} dB"] = picture[crop]
            differences[job.label] = np.abs(picture - reference).mean(axis=-1)[crop]
    rows = {"": views, "difference": differences}
    return plot.draw_images(f"{result['title']}, {ratio_text(first)}", figure_caption(result), rows, 1.6, "sRGB")
