"""
What the study of radiance fields compares, all made of one grid that was trained before, and then trained through the
same images for as many steps as each other.

*Dense* and *sparse* grids have thirteen numbers of 8 bits at a node, or 6 bits for colours; *components* are principal
ones of the colours, in steps that change a screen equally; a *codebook* holds colours found by k-means of what is seen
(the idea of VQRF); *planes* are TensoRF's, the *hash grid* is that of ``drjit.nn`` with a network behind it. *Paper*
and *ours* are presets of ``fit field``. Cells that no ray sees are left out of all by the same rule.

Equal bytes: ours and dense grids have them in memory, index and all; all others on disk, the numbers of grids predicted
from their neighbours and deflated. Grids are as fine as fits: a coarser one is trained by half of the steps, then loses
what is not seen, and is trained, as it is stored, by the other half. Planes and networks, whose steps take longer, have
:attr:`Request.seconds`.

Errors are PSNR of sRGB values before white in views that were not trained by: of pixels in which something is
(``psnr_foreground_db``), and of all (``psnr_white_db``), which flatters.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...files import replacing
from ...fitting import FitSettings, fit
from ...measure.store import fingerprint
from ...measure.study import FLOOR, Candidate, Case, Plan
from ...runtime import array_module
from ...tasks.radiance import grid as grids
from ...tasks.radiance.field import VolumeField
from ...tasks.radiance.files import load
from ...tasks.radiance.fit import grid_of
from ...tasks.radiance.march import march
from ...tasks.radiance.presets import dense_bytes
from ...tasks.radiance.training import Images, ImagesProblem, evaluate
from ...tasks.radiance.views import Views
from .. import equal_memory
from ..baselines import radiance_factors as factors
from ..baselines import radiance_fits as fits
from . import pictures
from .conclusions import conclusions, ratio_text, table

#: Kind → its label. Those of :data:`ONCE` are made of the first size only.
KINDS = {
    "dense": "dense grid, 8 bits",
    "sparse": "sparse grid, 8 bits",
    "sparse6": "sparse grid, 6-bit colours",
    "components": "principal components",
    "codebook": "codebook",
    "planes": "planes and lines",
    "hash": "hash grid + network",
    "paper": "paper",
    "ours": "ours",
}
ONCE = ("dense", "planes", "hash")

#: Kind → what it is a kind of, for pictures.
FAMILIES = {
    "dense": "grid", "sparse": "grid", "sparse6": "grid", "components": "codes", "codebook": "codes",
    "planes": "planes", "hash": "network", "paper": "supplement's arrays", "ours": "ours",
}  # fmt: skip

#: Kind → preset, of those that ``fit field`` makes.
PRESETS = {"ours": "sparse", "paper": "paper"}

#: Kinds whose bytes are those in memory; those of all others are on disk.
IN_MEMORY = ("dense", "ours")

#: Kinds that the times of ours are divided by.
AGAINST = ("sparse", "codebook", "paper")

#: References: the grid that all begin with, and what becomes of it in as many steps as the others have.
GRID, LONGER = "grid", "grid, trained on"

#: How a field is trained through images.
SETTINGS = FitSettings(seed=1, batch=8192, lr=2e-3, loss="mse", schedule="cosine", check_every=50, deterministic=False)

#: Rates of what does not begin near its end. At them, a trained grid gets worse in test views.
RATES = {"coarser": 5e-3, "coarser, stored": 5e-3, "planes": 2e-2, "hash": 1e-2}

#: What training is expected to leave room for: numbers that are trained deflate less.
ROOM, ROOM_COMPONENTS = 0.97, 0.84

#: What a coarser grid is expected to lose of its bytes when cells that are not seen are left out.
SHRINK = 0.8

#: Weights in a ray, in units of the usual one, below which cells of a coarser grid are left out: the first that fits.
LADDER = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.5, 4.0, 6.0, 9.0)

#: Entries of a codebook, and steps of components, in the order in which they are tried.
COUNTS, WIDTHS = (2**14, 2**12, 2**10), (0.03, 0.05, 0.08)

#: A grid is never coarser than this.
COARSEST = 6.0

#: Channels of planes and lines, of density and of colour: more of them take minutes to compile.
RANKS = (8, 16)


@dataclass(frozen=True)
class Request:
    """
    ``ratios``, how many times smaller than a dense grid of float32, the first of which is shown most; kinds left out
    (``without``); ``resolution`` of the grid that all begin with; ``grid_steps`` of its training (0: the preset's);
    ``steps`` of each training from there, or ``seconds`` where those take longer; ``film``, pixels along the sides of
    the picture that is timed.
    """

    ratios: tuple[float, ...]
    without: tuple[str, ...] = ()
    resolution: int = 128
    grid_steps: int = 0
    steps: int = 500
    seconds: float = 90.0
    film: int = 200


@dataclass
class Setting:
    """What all candidates share: views, of the folder ``source``, and the grid that they begin with."""

    views: Views
    held: Views
    source: str
    request: Request
    types: object
    jobs: dict[str, RadianceContender] = field(default_factory=dict)

    @functools.cached_property
    def images(self) -> Images:
        return Images(self.types, self.views)

    @functools.cached_property
    def tests(self) -> Images:
        return Images(self.types, self.held)

    @functools.cached_property
    def target(self) -> grids.Grid:
        """The trained grid."""
        return grid_of(load(self.jobs[GRID].file), self.types)

    @functools.cached_property
    def grid(self) -> fits.Grid:
        """What is seen of it."""
        return self.seen(self.target.field())

    def seen(self, found: VolumeField, least: float = 1.0) -> fits.Grid:
        """
        What is left of a grid without the cells that have less than so many times :data:`.target.VISIBLE` of any ray.
        """
        grid = fits.Grid.of(found, fits.visibility(found, self.images))
        return grid.kept(grids.weights(found, self.images) >= least * grids.VISIBLE)

    @functools.cached_property
    def dense_bytes(self) -> int:
        """What ratios refer to."""
        return dense_bytes(self.target.nodes.shape)

    def asked(self, ratio: float) -> int:
        return round(self.dense_bytes / ratio)

    def train(self, made, kind: str, steps: int, progress: bool, title: str, seconds: float | None = None):
        """Train a fit in place. Returns the result, of as many steps as there were."""
        problem = Unmeasured(self.types, made.net, made.field_of, self.views)
        settings = FitSettings(**{
            **asdict(SETTINGS), "lr": RATES.get(kind, SETTINGS.lr), "steps": steps, "measure_every": steps,
        })  # fmt: skip
        result = fit(problem, settings, progress=progress, title=title, seconds=seconds)
        made.net = problem.net
        return result

    def errors(self, found: VolumeField) -> dict[str, float]:
        return evaluate(found, self.tests)


class Unmeasured(ImagesProblem):
    """Nothing is measured on the way: what counts is the end, of all alike."""

    def measure(self, net):
        return {"step": 0.0}


def plan(views: Views, held: Views, source: str, request: Request) -> Plan:
    """What is measured of the views in the folder ``source``, in the variant that is set."""
    setting = Setting(views, held, source, request, array_module(mi.variant()))
    first = request.ratios[0]
    jobs = setting.jobs
    jobs[GRID] = Gridded("grid", 1.0, setting, GRID)
    jobs[LONGER] = Longer("longer", 1.0, setting, LONGER)
    for kind, ratio in equal_memory.combinations(KINDS, request.ratios, ONCE, request.without):
        made = RadianceContender.of(kind, ratio, setting)
        jobs[made.name] = made
    candidates = [job.candidate() for job in jobs.values()]
    shown = [name for name, job in jobs.items() if job.budget == first and job.method in KINDS]
    ours = next((n for n in shown if jobs[n].method == "ours"), "")
    timed = tuple([GRID, *shown])
    cases = [
        Case("reads", lambda lanes: _reads(setting, timed, lanes), lambda: _renders(setting, timed), candidates=timed,
             query_names=("density", "both")),
    ]  # fmt: skip
    package = Path(__file__).resolve().parents[2]
    made_by = [*(package / "tasks" / "field").glob("*.py"), package / "fitting.py", Path(__file__)]
    made_by += (package / "studies" / "baselines").glob("radiance*.py")
    made_by.append(package / "studies" / "baselines" / "node_codes.py")
    return Plan(
        study="field",
        title=f"Radiance field: {Path(source).name}",
        variant=mi.variant(),
        candidates=candidates,
        cases=cases,
        queries=("density",),
        accuracy="psnr_foreground_db",
        accuracy_label="PSNR of the foreground in test views, dB",
        ratios=[(ours, n) for n in shown if jobs[n].method in AGAINST] if ours else [],
        details={
            "source": source, "source_digest": views.digest + held.digest, "views": [len(views), len(held)],
            "pixels": [views.width, views.height], "request": asdict(request), "first": first,
        },
        notes=[
            f"{Path(source).name}, {len(views)} views of {views.width} × {views.height} and {len(held)} to test. Equal "
            "bytes: ours and dense grids in memory, the others on disk, deflated.",
        ],
        jobs=list(jobs.values()),
        jobs_fingerprint=fingerprint(made_by) + views.digest[:16],
        pictures=pictures.of(setting),
        sampled=False,
        table=table,
        conclusions=conclusions,
    )  # fmt: skip


# -- jobs -------------------------------------------------------------------------------------------------------------


class RadianceContender(equal_memory.Contender):
    """A field of a kind, so many times smaller than a dense grid."""

    labels, families, budget_text = KINDS, FAMILIES, staticmethod(ratio_text)

    @staticmethod
    def of(kind: str, ratio: float, setting: Setting) -> RadianceContender:
        own = {"planes": Planes, "hash": Hashed}.get(kind, Preset if kind in PRESETS else OnNodes)
        return own(kind, ratio, setting)

    def record(self, nbytes: int, file_bytes: int, seconds: float, **details) -> dict:
        details |= {"memory_bytes": nbytes, "file_bytes": file_bytes, "dense_bytes": self.context.dense_bytes}
        counted = nbytes if self.method in IN_MEMORY else file_bytes
        return {"bytes": counted, "seconds": seconds, "errors": self.context.errors(self.model), "details": details}

    @property
    def asked(self) -> int:
        return self.context.asked(self.budget)


class Preset(equal_memory.PresetContender, RadianceContender):
    """By a preset of ``fit field``, from the grid."""

    task_name = "field"

    @property
    def preset(self) -> str:
        return PRESETS[self.method]

    def arguments(self) -> dict:
        setting = self.context
        return {
            "source": setting.source, "grid": str(setting.jobs[GRID].file), "bytes": str(self.asked),
            "steps": setting.request.steps,
        }  # fmt: skip

    def fit_record(self, task_model, fitted, seconds: float) -> dict:
        details = {"steps": fitted.result.steps, "nodes": task_model.field.nodes.count}
        return self.record(task_model.memory_nbytes, self.file.stat().st_size, seconds, **details)


class Gridded(Preset):
    """The grid that all begin with."""

    preset = "grid"

    def candidate(self) -> Candidate:
        return Candidate(self.name, "reference", job=self.name, is_reference=True, details={"kind": self.method})

    def arguments(self) -> dict:
        request = self.context.request
        steps = {"steps": request.grid_steps} if request.grid_steps else {}
        return {"source": self.context.source, "resolution": request.resolution, **steps}


class Longer(Gridded):
    """The grid after as many more steps as the others have."""

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        setting = self.context
        start = time.perf_counter()
        problem = grids.GridProblem(setting.target, setting.views)
        problem.measure = lambda net: {"step": 0.0}
        steps = setting.request.steps
        settings = FitSettings(**{**asdict(SETTINGS), "steps": steps, "measure_every": steps})
        if fit(problem, settings, progress=progress, title=self.name).interrupted:
            return None
        found = problem.trained()
        if self.file:
            with replacing(self.file) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, density=found.density, colour=found.colour)
        self.model = found.field()
        nbytes = 52 * found.nodes.count
        return self.record(nbytes, nbytes, time.perf_counter() - start, steps=steps)

    def load(self, path: Path) -> VolumeField:
        with np.load(path) as data:
            return grids.Grid(self.context.target.nodes, data["density"], data["colour"]).field()


class Fitted(RadianceContender):
    """What :mod:`..baselines` make; ``CLASS`` is that of the fits."""

    CLASS: type

    def finish(self, made, seconds: float, **details) -> dict:
        state = made.state()
        if self.file:
            with replacing(self.file) as temporary, open(temporary, "wb") as stream:
                np.savez_compressed(stream, **state)
        self.model = self.CLASS.field(self.context.types, state)
        details["deflated_bytes"] = self.CLASS.file_bytes(state, False)
        return self.record(self.model.nbytes, self.CLASS.file_bytes(state), seconds, **details)

    def load(self, path: Path) -> VolumeField:
        with np.load(path) as data:
            return self.CLASS.field(self.context.types, {name: data[name] for name in data})


class OnNodes(Fitted):
    """A grid, components or a codebook."""

    CLASS = fits.NodesFit

    def makers(self) -> list[Callable[[fits.Grid], fits.NodesFit]]:
        """What can be made of a grid, the best first."""
        if self.method == "codebook":
            return [functools.partial(fits.codebook, count=n) for n in COUNTS]
        if self.method == "components":
            return [functools.partial(fits.components, width=w) for w in WIDTHS]
        return [functools.partial(fits.plain, levels=64 if self.method == "sparse6" else 256)]

    def bytes_of(self, made: fits.NodesFit) -> int:
        # What is everywhere has no need to be predicted, and no place for it
        return made.file_bytes(made.state()) if self.method != "dense" else 13 * made.nodes.count

    @property
    def room(self) -> float:
        return self.asked * {"dense": 1.0, "components": ROOM_COMPONENTS}.get(self.method, ROOM)

    def beginning(self) -> tuple[fits.Grid, Callable, float]:
        """The grid to begin with, what is made of it in the end, and how much coarser it is."""
        whole, asked, makers = self.context.grid, self.room, self.makers()
        if self.method == "dense":
            shape = np.array(whole.nodes.shape)
            scale = (13 * shape.prod() / asked) ** (1 / 3)
            while 13 * np.prod(np.ceil((shape - 1) / scale - 1e-6) + 1) > asked:
                scale *= 1.01
            return whole.resampled(scale, sparse=False), makers[0], scale
        for make in makers:
            nbytes = self.bytes_of(make(whole))
            if nbytes <= asked:
                return whole, make, 1.0
        make = makers[min(1, len(makers) - 1)]
        nbytes = self.bytes_of(make(whole)) if len(makers) > 1 else nbytes
        rate, low, high = SHRINK * nbytes / whole.nodes.count, 1.0, COARSEST
        for _ in range(12):
            scale = math.sqrt(low * high)
            fits_in = rate * np.count_nonzero(whole.coarser(scale)) <= asked
            low, high = (low, scale) if fits_in else (scale, high)
        return whole.resampled(high), make, high

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, setting = time.perf_counter(), self.context
        grid, make, scale = self.beginning()
        steps = rest = setting.request.steps
        if scale > 1:
            first, rest = fits.plain(grid), steps - steps // 2
            if setting.train(first, "coarser", steps - rest, progress, f"{self.name}, at first").interrupted:
                return None
            made = make(first.grid(grid.seen))
            for least in LADDER if self.method != "dense" else ():
                made = make(setting.seen(first.field_of(first.net), least))
                if self.bytes_of(made) <= self.room:
                    break
        else:
            made = make(grid)
        if setting.train(made, "coarser, stored" if scale > 1 else "", rest, progress, self.name).interrupted:
            return None
        colours = len(made.state()["colour"]) if self.method == "codebook" else 0
        return self.finish(
            made, time.perf_counter() - start, steps=steps, coarser=scale, nodes=made.nodes.count, entries=colours
        )


class Planes(Fitted):
    """Planes and lines."""

    CLASS = factors.PlanesFit

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, setting = time.perf_counter(), self.context
        grid = setting.grid
        longest = max(b - a for a, b in zip(grid.nodes.lower, grid.nodes.upper, strict=True))
        low, high = longest / 2000, longest / 4
        for _ in range(30):
            spacing = math.sqrt(low * high)
            rows = factors.rows_of(factors.sides_of(grid.nodes, spacing))
            low, high = (low, spacing) if sum(RANKS) * rows <= 0.97 * self.asked else (spacing, high)
        made = factors.PlanesFit(grid, RANKS, high)
        steps = 0
        for share, title in ((0.7, f"{self.name}, at first"), (0.3, self.name)):
            seconds = share * setting.request.seconds
            result = setting.train(made, self.method, 10**6, progress, title, seconds)
            if result.interrupted:
                return None
            steps += result.steps
            if made.steps is None:
                made.round()
        return self.finish(made, time.perf_counter() - start, steps=steps)


class Hashed(Fitted):
    """A hash grid and a network."""

    CLASS = factors.HashFit

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, setting = time.perf_counter(), self.context
        finest = float(max(setting.grid.nodes.shape))
        powers = np.arange(8, 24, 0.1)
        fitting = [2**p for p in powers if 2 * factors.parameters(int(2**p) // 16 * 16, finest) <= 0.97 * self.asked]
        made = factors.HashFit(setting.grid, int(max(fitting, default=256)) // 16 * 16, finest)
        result = setting.train(made, self.method, 10**6, progress, self.name, setting.request.seconds)
        if result.interrupted:
            return None
        return self.finish(made, time.perf_counter() - start, steps=result.steps)


# -- time -------------------------------------------------------------------------------------------------------------


def _reads(setting: Setting, names, lanes: int) -> dict:
    """Densities, and densities with colours, at random points of the cells that are seen, in random directions."""
    types, nodes = setting.types, setting.grid.nodes
    rng = np.random.default_rng(1)
    cells = np.argwhere(setting.grid.cells())
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
        own = setting.jobs[name].model
        density[name] = lambda f=own: [f.look(p)[0]]
        both[name] = lambda f=own: _both(f, p, d)
    return {"density": density, "both": both}


def _both(found: VolumeField, p, d) -> list:
    density, latent = found.look(p)
    return [density, *found.colour(latent, p, d)]


def _renders(setting: Setting, names) -> dict:
    """A picture of one of the test views, one ray a pixel."""
    types, side = setting.types, setting.request.film
    images = setting.tests
    lane = dr.arange(types.UInt32, side * side)
    tile, pixel = lane // 16, lane % 16
    across = side // 4
    x, y = (tile % across) * 4 + pixel % 4, (tile // across) * 4 + pixel // 4
    scale = [images.views.width / side, images.views.height / side]
    o, d = images.rays(
        types.UInt32(0), (types.Float(x) + 0.5) * scale[0] - 0.5, (types.Float(y) + 0.5) * scale[1] - 0.5
    )
    dr.make_opaque(o, d)

    def render(own):
        seen = march(own, o, d, 0, dr.inf)
        return [*seen.colour, seen.transmittance]

    return {name: lambda k, f=setting.jobs[name].model: render(f) for name in names}
