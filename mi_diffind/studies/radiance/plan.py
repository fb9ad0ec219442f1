"""Contenders, cases and budgets of the study of radiance fields.

All contenders begin with one trained grid and are trained through the same images for the same number of steps. *Dense*
and *sparse* grids have thirteen numbers of 8 bits at a node, or 6 bits for colours. *Components* are principal
components of the colours, in steps that change the display equally. A *codebook* holds colours found by k-means (the
idea of VQRF). *Planes* are those of TensoRF, the *hash grid* is that of ``drjit.nn`` with a network. *Paper* and *ours*
are presets of ``fit field``. Cells that no ray sees are removed from all by the same rule.

Equal bytes: ours and dense grids are counted in memory, index included; all others on disk, where the numbers of grids
are predicted from their neighbours and deflated. Grids are as fine as the budget allows: a coarser grid is trained for
half of the steps, loses the cells that no ray sees, and is trained in its stored form for the other half. Planes and
networks, whose steps take longer, have :attr:`RadianceStudySettings.seconds`.

Errors are PSNR of sRGB values before white in held-out views: of the pixels of the foreground
(``psnr_foreground_db``) and of all pixels (``psnr_white_db``), which flatters.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import drjit as dr
import numpy as np

from ...core.progress import Deadline
from ...fitting.loop import FitSettings, fit
from ...measure.store import fingerprint
from ...measure.study import FLOOR, Candidate, Case, Plan
from ...tasks.radiance import dense_bytes
from ...tasks.radiance import grid as grids
from ...tasks.radiance.files import grid_of, load
from ...tasks.radiance.march import march
from ...tasks.radiance.session import FieldSession, ImagesProblem
from ...tasks.radiance.volume_field import NodeField, VolumeField
from .. import equal_memory
from ..baselines import radiance_factors as factors
from ..baselines import radiance_fits as fits
from . import pictures
from .conclusions import conclusions, ratio_text, table

#: Method → its label. Those of :data:`ONCE` are trained at the first budget only.
KINDS = {
    "dense": "dense grid, 8 bits", "sparse": "sparse grid, 8 bits", "sparse6": "sparse grid, 6-bit colours",
    "components": "principal components", "codebook": "codebook", "planes": "planes and lines",
    "hash": "hash grid + network", "paper": "paper", "ours": "ours",
}  # fmt: skip
ONCE = ("dense", "planes", "hash")

#: Method → the group that it belongs to in pictures.
FAMILIES = {
    "dense": "grid", "sparse": "grid", "sparse6": "grid", "components": "codes", "codebook": "codes",
    "planes": "planes", "hash": "network", "paper": "supplement's arrays", "ours": "ours",
}  # fmt: skip

#: Method → preset of ``fit field``.
PRESETS = {"ours": "sparse", "paper": "paper"}

#: Methods whose bytes are counted in memory; those of all others are counted on disk.
IN_MEMORY = ("dense", "ours")

#: Methods by whose times ours is divided.
AGAINST = ("sparse", "codebook", "paper")

#: References: the grid that all begin with, and the same grid trained for as many steps as the contenders.
GRID, LONGER = "grid", "grid, trained on"

#: Settings of the training through images.
SETTINGS = FitSettings(seed=1, batch=8192, lr=2e-3, loss="mse", schedule="cosine", check_every=50, deterministic=False)

#: Learning rates of contenders that begin far from their optimum. At these, a trained grid gets worse in test views.
RATES = {"coarser": 5e-3, "coarser, stored": 5e-3, "planes": 2e-2, "hash": 1e-2}

#: Share of a budget that untrained numbers may take, since trained numbers deflate less.
ROOM, ROOM_COMPONENTS = 0.97, 0.84

#: Expected share of its bytes that a coarser grid keeps when cells that no ray sees are removed.
SHRINK = 0.8

#: Weights in a ray, in units of the default, below which cells of a coarser grid are removed: the first that fits.
LADDER = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0, 6.0, 9.0)

#: Entries of a codebook and step widths of components, in the order in which they are tried.
COUNTS, WIDTHS = (2**14, 2**12, 2**10), (0.03, 0.05, 0.08)

#: Largest ratio of node distances of a coarser grid.
COARSEST = 6.0

#: Channels of planes and lines for density and for colour: more of them take minutes to compile.
RANKS = (8, 16)


@dataclass(frozen=True)
class RadianceStudySettings:
    """Settings of the study.

    ``ratios`` are the budgets, as compression against a dense float32 grid; the first is timed and shown. ``without``
    names the methods left out. ``resolution`` is that of the grid, trained for ``grid_steps`` (0: as its preset says).
    Each contender is trained for ``steps``, or for ``seconds`` if its steps take long. ``film`` is the side of the
    timed picture in pixels.
    """

    ratios: tuple[float, ...]
    without: tuple[str, ...] = ()
    resolution: int = 128
    grid_steps: int = 0
    steps: int = 500
    seconds: float = 90.0
    film: int = 200


@dataclass
class RadianceStudyContext:
    """State shared by all contenders: the session of the capture in the folder ``source``, and their grid."""

    session: FieldSession
    source: str
    settings: RadianceStudySettings
    jobs: dict[str, RadianceContender] = field(default_factory=dict)

    @property
    def types(self):
        """The module of Dr.Jit types."""
        return self.session.types

    @functools.cached_property
    def node_grid(self) -> grids.NodeGrid:
        """The trained grid."""
        return grid_of(load(self.jobs[GRID].file), self.types)

    @functools.cached_property
    def grid(self) -> fits.WeightedGrid:
        """The visible part of the trained grid."""
        return self.visible(self.node_grid.field())

    def visible(self, trained: NodeField, least: float = 1.0) -> fits.WeightedGrid:
        """Return a grid without the cells whose largest weight in a ray is below ``least`` · :data:`.grid.VISIBLE`."""
        grid = fits.WeightedGrid.of(trained, fits.visibility(trained, self.session.images))
        seen = grids.weights(trained, self.session.images) >= least * grids.VISIBLE
        return grid.kept(trained.nodes.cells_where(seen))

    @functools.cached_property
    def dense_bytes(self) -> int:
        """Bytes of the dense float32 grid, to which ratios refer."""
        return dense_bytes(self.node_grid.nodes.shape)

    def train(self, trained_fit, rate: str, steps: int, progress: bool, title: str, seconds: float | None = None):
        """Train a fit in place, at the learning rate of a name in :data:`RATES`, and return the result."""
        problem = UnmeasuredProblem(self.session, trained_fit.net, trained_fit.field_of)
        settings = replace(SETTINGS, lr=RATES.get(rate, SETTINGS.lr), steps=steps, measure_every=steps)
        result = fit(problem, settings, progress=progress, title=title, deadline=seconds and Deadline(seconds))
        trained_fit.net = problem.net
        return result

    def errors(self, trained: VolumeField) -> dict[str, float]:
        """Return the PSNR of a field in the held-out views."""
        return self.session.held_out_images.evaluate(trained)


class UnmeasuredProblem(ImagesProblem):
    """Training that measures nothing before its end, so that the last step counts for all contenders."""

    def measure(self, net):
        return {"step": 0.0}


def plan(session: FieldSession, source: str, settings: RadianceStudySettings) -> Plan:
    """Return the plan of the study for a session of the capture in the folder ``source``."""
    context = RadianceStudyContext(session, source, settings)
    views, held_out, first, jobs = session.views, session.held_out, settings.ratios[0], context.jobs
    height, width = views.sizes[0].tolist()
    jobs[GRID] = GridReference("grid", 1.0, context, GRID)
    jobs[LONGER] = TrainedOnReference("longer", 1.0, context, LONGER)
    for method, ratio in equal_memory.combinations(KINDS, settings.ratios, ONCE, settings.without):
        contender = RadianceContender.of(method, ratio, context)
        jobs[contender.name] = contender
    candidates = [job.candidate() for job in jobs.values()]
    shown = [name for name, job in jobs.items() if job.budget == first and job.method in KINDS]
    ours = next((n for n in shown if jobs[n].method == "ours"), "")
    timed = tuple([GRID, *shown])
    cases = [
        Case("reads", lambda lanes: _reads(context, timed, lanes), lambda: _renders(context, timed), candidates=timed,
             query_names=("density", "both")),
    ]  # fmt: skip
    package = Path(__file__).resolve().parents[2]
    sources = [*(package / "tasks" / "radiance").glob("*.py"), package / "fitting" / "loop.py", Path(__file__)]
    sources += (package / "studies" / "baselines").glob("radiance*.py")
    sources.append(package / "studies" / "baselines" / "node_codes.py")
    return Plan(
        study="field",
        title=f"Radiance field: {Path(source).name}",
        candidates=candidates,
        cases=cases,
        queries=("density",),
        accuracy="psnr_foreground_db",
        accuracy_label="PSNR of the foreground in test views, dB",
        ratios=[(ours, n) for n in shown if jobs[n].method in AGAINST] if ours else [],
        details={
            "source": source, "source_digest": views.digest + held_out.digest, "views": [len(views), len(held_out)],
            "pixels": [width, height], "request": asdict(settings), "first": first,
        },
        notes=[
            f"{Path(source).name}, {len(views)} views of {width} × {height} and {len(held_out)} to test. "
            "Equal bytes: ours and dense grids in memory, the others on disk, deflated.",
        ],
        jobs=list(jobs.values()),
        jobs_fingerprint=fingerprint(sources) + views.digest[:16],
        pictures={"views": functools.partial(pictures.views, context)},
        sampled=False,
        table=table,
        conclusions=conclusions,
    )  # fmt: skip


class RadianceContender(equal_memory.Contender):
    """Radiance field of a method, at a compression ratio against the dense float32 grid."""

    labels, families, budget_text = KINDS, FAMILIES, staticmethod(ratio_text)

    @staticmethod
    def of(method: str, ratio: float, context: RadianceStudyContext) -> RadianceContender:
        """Return the contender of a method at a ratio."""
        other = FieldPresetContender if method in PRESETS else NodesContender
        return {"planes": PlanesContender, "hash": HashContender}.get(method, other)(method, ratio, context)

    def record(self, nbytes: int, file_bytes: int, seconds: float, **details) -> dict:
        details |= {"memory_bytes": nbytes, "file_bytes": file_bytes, "dense_bytes": self.context.dense_bytes}
        counted = nbytes if self.method in IN_MEMORY else file_bytes
        return {"bytes": counted, "seconds": seconds, "errors": self.context.errors(self.model), "details": details}

    @property
    def budget_bytes(self) -> int:
        """The budget in bytes."""
        return round(self.context.dense_bytes / self.budget)


class FieldPresetContender(equal_memory.PresetContender, RadianceContender):
    """Contender trained from the grid by a preset of ``fit field``."""

    task_name = "field"

    @property
    def preset(self) -> str:
        return PRESETS[self.method]

    def arguments(self) -> dict:
        context = self.context
        return {
            "source": context.source, "grid": str(context.jobs[GRID].file), "bytes": str(self.budget_bytes),
            "steps": context.settings.steps,
        }  # fmt: skip

    def fit_record(self, task_model, fitted, seconds: float) -> dict:
        details = {"steps": fitted.result.steps, "nodes": task_model.field.nodes.count}
        return self.record(task_model.memory_nbytes, self.file.stat().st_size, seconds, **details)


class GridReference(FieldPresetContender):
    """Reference: the grid that all contenders begin with."""

    preset = "grid"

    def candidate(self) -> Candidate:
        return Candidate(self.name, "reference", job=self.name, is_reference=True, details={"kind": self.method})

    def arguments(self) -> dict:
        settings = self.context.settings
        steps = {"steps": settings.grid_steps} if settings.grid_steps else {}
        # The other methods store numbers of directions
        return {"source": self.context.source, "resolution": settings.resolution, "colours": "directions", **steps}


class TrainedOnReference(GridReference):
    """Reference: the grid after as many more steps as the contenders have."""

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, steps = time.perf_counter(), self.context.settings.steps
        problem = grids.GridProblem(self.context.node_grid, self.context.session)
        problem.measure = lambda net: {"step": 0.0}
        settings = replace(SETTINGS, steps=steps, measure_every=steps)
        if fit(problem, settings, progress=progress, title=self.name).interrupted:
            return None
        grid = problem.trained()
        self.save_arrays(density=grid.density, colour=grid.colour)
        self.model = grid.field()
        nbytes = 52 * grid.nodes.count
        return self.record(nbytes, nbytes, time.perf_counter() - start, steps=steps)

    def load(self, path: Path) -> VolumeField:
        return grids.NodeGrid(self.context.node_grid.nodes, **equal_memory.load_arrays(path)).field()


class BaselineContender(RadianceContender):
    """Contender of :mod:`..baselines`; ``CLASS`` is the class of its fit."""

    CLASS: type

    def finish(self, trained_fit, seconds: float, **details) -> dict:
        """Store a trained fit, set the model and return the record."""
        state = trained_fit.state()
        self.save_arrays(**state)
        self.model = self.CLASS.field(self.context.types, state)
        details["deflated_bytes"] = self.CLASS.file_bytes(state, False)
        return self.record(self.model.nbytes, self.CLASS.file_bytes(state), seconds, **details)

    def load(self, path: Path) -> VolumeField:
        return self.CLASS.field(self.context.types, equal_memory.load_arrays(path))


class NodesContender(BaselineContender):
    """Baseline on nodes: a grid, components or a codebook."""

    CLASS = fits.NodesFit

    def makers(self) -> list[Callable[[fits.WeightedGrid], fits.NodesFit]]:
        """Return functions that make a fit of a grid, in order of decreasing quality."""
        if self.method == "codebook":
            return [functools.partial(fits.codebook, count=n) for n in COUNTS]
        if self.method == "components":
            return [functools.partial(fits.components, width=w) for w in WIDTHS]
        return [functools.partial(fits.plain, levels=64 if self.method == "sparse6" else 256)]

    def bytes_of(self, nodes_fit: fits.NodesFit) -> int:
        """Return the bytes of a fit that count against the budget."""
        if self.method == "dense":
            return 13 * nodes_fit.nodes.count
        return nodes_fit.file_bytes(nodes_fit.state())

    @property
    def room(self) -> float:
        """Bytes that an untrained fit may take."""
        return self.budget_bytes * {"dense": 1.0, "components": ROOM_COMPONENTS}.get(self.method, ROOM)

    def initial(self) -> tuple[fits.WeightedGrid, Callable, float]:
        """Return the grid to begin with, the function that makes its fit, and the ratio of its node distances."""
        whole, room, makers = self.context.grid, self.room, self.makers()
        if self.method == "dense":
            shape = np.array(whole.nodes.shape)
            scale = (13 * shape.prod() / room) ** (1 / 3)
            while 13 * np.prod(np.ceil((shape - 1) / scale - 1e-6) + 1) > room:
                scale *= 1.01
            return whole.resampled(scale, sparse=False), makers[0], scale
        for make in makers:
            nbytes = self.bytes_of(make(whole))
            if nbytes <= room:
                return whole, make, 1.0
        make = makers[min(1, len(makers) - 1)]
        nbytes = self.bytes_of(make(whole)) if len(makers) > 1 else nbytes
        rate, low, high = SHRINK * nbytes / whole.nodes.count, 1.0, COARSEST
        for _ in range(12):
            scale = math.sqrt(low * high)
            fits_in = rate * np.count_nonzero(whole.coarser(scale)) <= room
            low, high = (low, scale) if fits_in else (scale, high)
        return whole.resampled(high), make, high

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, context = time.perf_counter(), self.context
        grid, make, scale = self.initial()
        steps = rest = context.settings.steps
        if scale > 1:
            first, rest = fits.plain(grid), steps - steps // 2
            if context.train(first, "coarser", steps - rest, progress, f"{self.name}, at first").interrupted:
                return None
            stored = make(first.grid(grid.seen))
            for least in LADDER if self.method != "dense" else ():
                stored = make(context.visible(first.field_of(first.net), least))
                if self.bytes_of(stored) <= self.room:
                    break
        else:
            stored = make(grid)
        if context.train(stored, "coarser, stored" if scale > 1 else "", rest, progress, self.name).interrupted:
            return None
        colours = len(stored.state()["colour"]) if self.method == "codebook" else 0
        return self.finish(
            stored, time.perf_counter() - start, steps=steps, coarser=scale, nodes=stored.nodes.count, entries=colours
        )


class PlanesContender(BaselineContender):
    """Baseline of planes and lines."""

    CLASS = factors.PlanesFit

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, grid = time.perf_counter(), self.context.grid
        longest = max(b - a for a, b in zip(grid.nodes.lower, grid.nodes.upper, strict=True))
        low, high = longest / 2000, longest / 4
        for _ in range(30):
            spacing = math.sqrt(low * high)
            rows = factors.rows_of(factors.sides_of(grid.nodes, spacing))
            low, high = (low, spacing) if sum(RANKS) * rows <= 0.97 * self.budget_bytes else (spacing, high)
        planes, steps = factors.PlanesFit(grid, RANKS, high), 0
        for share, title in ((0.7, f"{self.name}, at first"), (0.3, self.name)):
            seconds = share * self.context.settings.seconds
            result = self.context.train(planes, self.method, 10**6, progress, title, seconds)
            if result.interrupted:
                return None
            steps += result.steps
            if planes.steps is None:
                planes.round()
        return self.finish(planes, time.perf_counter() - start, steps=steps)


class HashContender(BaselineContender):
    """Baseline of a hash grid and a network."""

    CLASS = factors.HashVolumeFit

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, context, room = time.perf_counter(), self.context, 0.97 * self.budget_bytes
        finest = float(max(context.grid.nodes.shape))
        sizes = (int(2**power) // 16 * 16 for power in np.arange(8, 24, 0.1))
        entries = max((size for size in sizes if 2 * factors.parameters(size, finest) <= room), default=256)
        hash_fit = factors.HashVolumeFit(context.grid, entries, finest)
        result = context.train(hash_fit, self.method, 10**6, progress, self.name, context.settings.seconds)
        if result.interrupted:
            return None
        return self.finish(hash_fit, time.perf_counter() - start, steps=result.steps)


def _reads(context: RadianceStudyContext, names, lanes: int) -> dict:
    """Return queries of density, and of density and colour, at random points of the visible cells."""
    types, nodes = context.types, context.grid.nodes
    rng = np.random.default_rng(1)
    cells = np.argwhere(context.grid.cells())
    places = cells[rng.integers(len(cells), size=lanes)] + rng.random((lanes, 3))
    points = np.float32(np.array(nodes.lower) + places * nodes.spacing)
    p = types.Array3f(*(types.Float(np.ascontiguousarray(v)) for v in points.T))
    away = rng.normal(size=(lanes, 3))
    away = np.float32(away / np.linalg.norm(away, axis=1, keepdims=True))
    d = types.Array3f(*(types.Float(np.ascontiguousarray(v)) for v in away.T))
    dr.make_opaque(p, d)
    density = {FLOOR: lambda: [*p, *d]}
    both = {FLOOR: lambda: [*p, *d]}
    for name in names:
        model = context.jobs[name].model
        density[name] = lambda f=model: [f.density_at(p)[0]]
        both[name] = lambda f=model: _density_and_colour(f, p, d)
    return {"density": density, "both": both}


def _density_and_colour(model: VolumeField, p, d) -> list:
    density, point_data = model.density_at(p)
    return [density, *model.radiance_at(point_data, p, d)]


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
