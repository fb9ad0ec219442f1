"""Base classes of tasks, the registry of all tasks, and the function ``fit``.

A task is a ground truth, arrays that are fitted to it, and a table file that holds them. It declares itself as
``TASK``, a :class:`Task`, in the package ``mi_diffind/tasks/NAME`` or in a module that an entry point of the group
``mi_diffind.tasks`` names; :func:`tasks` finds them. A declaration imports neither Dr.Jit nor Mitsuba. Code that needs
them lies in other modules of the task's package, where :class:`Task` looks for it by name:

=============  =====================================================================================
``fit.py``     ``check(request)`` and ``fit(request)``
``files.py``   ``load(path)``, ``allocate(table, dtype, storage)``, ``stored(table, entries, storage)``, ``MODEL``
``model.py``   ``MODEL``, the class of the task's :class:`Model`, if ``files.py`` has none
=============  =====================================================================================

A task that needs more than that overrides the methods of :class:`Task`.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import math
import numbers
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

from ..core import discovery
from ..core.arguments import MOST, MOST_NATURAL, Argument, check_files
from ..core.compat import backend_module
from ..core.errors import DiffindError, UsageError
from ..core.files import read_once
from ..core.progress import Deadline, interruptible
from ..core.units import check_memory, figure_lines

if TYPE_CHECKING:
    from ..arrays.indirection import DifferentiableArray
    from ..arrays.tables import Table

#: Storage forms that a training may end in (:data:`.lookup.STORAGES`, without importing Dr.Jit).
STORAGES = ("float32", "float16", "uint8")

#: Ratio of the duration and the limit of time beyond which the result says how long it took.
OVERRUN = 1.15

#: Folder of the tables that ship.
DATA = Path(__file__).resolve().parents[1] / "data"


#: Memory that a step takes for each sample of its batch, in bytes: 4 to 80 were measured.
SAMPLE_BYTES = 64

SCHEDULES = ("constant", "cosine", "plateau")
LOSSES = ("mae", "mse")


class FittingError(DiffindError, RuntimeError):
    """A training cannot go on; the message is one sentence."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of a training.

    ``lr`` is Adam's learning rate; ``schedule`` changes it: ``"constant"``, ``"cosine"`` (to zero) or ``"plateau"``
    (halved when the loss has not improved for a tenth of the steps). ``measure_every`` and ``check_every`` are the
    numbers of steps between two measurements and between two checks of the loss.

    With ``deterministic``, the same settings give the same bytes: the LLVM backend then trains on one core, because the
    last digits of a sum over several cores depend on their order. It has no effect on CUDA, which sums by atomics.

    A task that has further settings derives a class of its own, whose defaults are those of its first preset.
    """

    steps: int = 2000
    batch: int = 65536
    lr: float = 1e-3
    schedule: str = "cosine"
    loss: str = "mae"
    seed: int = 0
    measure_every: int = 200
    check_every: int = 20
    deterministic: bool = True

    #: Fewest steps: 0 for a task that writes the arrays that a training begins with.
    fewest_steps: ClassVar[int] = 1

    def __post_init__(self):
        least = {"seed": 0, "steps": self.fewest_steps}
        for name in ("steps", "batch", "measure_every", "check_every", "seed"):
            value, low, most = getattr(self, name), least.get(name, 1), MOST_NATURAL if name == "seed" else MOST
            whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
            if not whole or not low <= value <= most:
                raise FittingError(f"{name}: found {value!s:.40}, a whole number from {low} to {most:,} is needed")
        if not (isinstance(self.lr, numbers.Real) and math.isfinite(self.lr) and self.lr > 0):
            raise FittingError(f"lr: found {self.lr}, a positive number is needed")
        if self.schedule not in SCHEDULES:
            raise FittingError(f'schedule: found "{self.schedule}", allowed are {SCHEDULES}')
        if self.loss not in LOSSES:
            raise FittingError(f'loss: found "{self.loss}", allowed are {LOSSES}')

    @property
    def common(self) -> dict:
        """The settings that all tasks share, by name."""
        return {f.name: getattr(self, f.name) for f in fields(FitSettings)}

    @property
    def further(self) -> dict:
        """The settings of the task alone, by name."""
        return {name: value for name, value in asdict(self).items() if name not in self.common}


@dataclass
class FitResult:
    """Record of a training: the best state and the history.

    ``measured`` are the figures of the best state, reached at ``step`` of ``steps``. ``history`` lists the figures of
    all measurements with the loss (``None`` if it was not known).
    """

    measured: dict[str, float]
    step: int
    steps: int
    seconds: float
    interrupted: bool
    restarts: int
    history: list[dict] = field(default_factory=list)
    asked_to_stop: bool = False  # by Ctrl-C, which may have come too late to interrupt it
    unfinished: bool = False  # the time was too short

    @property
    def outcome(self) -> str:
        """State that was kept and, after Ctrl-C, why it is not the last one: for a sentence."""
        if not self.steps and not self.interrupted:
            return "untrained"
        if not self.interrupted:
            steps = f"{self.steps} step{'s' if self.steps != 1 else ''}: unfinished, " if self.unfinished else ""
            return f"{steps}best step {self.step}"
        name, value = next(iter(self.measured.items()))
        last = next((h for h in reversed(self.history) if h["step"] == self.steps), None)
        if self.step == self.steps or last is None:
            return f"interrupted at step {self.steps}, kept step {self.step}"
        return (
            f"interrupted at step {self.steps}, kept step {self.step}, which was better ({name} {value:.2f} against "
            f"{last[name]:.2f})"
        )


@dataclass(frozen=True)
class Stage:
    """One training of a fit. A fit is a list of stages, which :meth:`FitRequest.run` carries out in turn.

    - ``name``: a stage with a ``name`` keeps its checkpoint in the file ``CHECKPOINT.name`` beside that of the request,
      one without in the request's own. ``title`` stands before the progress bar (default: the name).
    - ``problem``: what is trained, a :class:`.loop.Problem`, or a function that returns it when the stage begins, from
      what earlier stages have trained. The stage is left out if it returns ``None``.
    - ``share``: part of the time that is left when the stage begins, from 0 to 1. Without a limit of time it does
      nothing: the ``settings`` of the stage (default: those of the request) say how many steps there are.
    - ``finish``: what follows the training, such as the measurement of the table, and takes ``times`` as long. With a
      limit of time it is carried out once before, so that time is left for it.
    - ``least``: steps that are taken however little time is left.
    - ``resumable``: keep a checkpoint, if the request asks for one.

    Example: a proxy in 30% of the time, then a residual on top of it::

        def stages():
            proxy = ProxyProblem(samples)
            yield Stage("proxy", proxy, share=0.3, settings=PROXY_SETTINGS)
            yield Stage("", ResidualProblem(samples, proxy.net), finish=stored)

        first, last = request.run(stages())
    """

    name: str
    problem: Any
    share: float = 1.0
    settings: FitSettings | None = None
    title: str | None = None
    finish: Callable[[], object] | None = None
    times: float = 1.0
    least: int = 1
    resumable: bool = True


@dataclass
class FitRequest:
    """Request for a fit, complete before it is checked, and never changed afterwards.

    ``preset`` and its ``settings`` as the user changed them, the module of Dr.Jit ``types`` to train with, the
    ``storage`` form of the result ("": the task's own), and the task's own arguments (``options``, all of them). The
    ``deadline`` limits the time of all that is left to do, in place of the steps of the settings. ``output`` is the
    file for the result, if it is known, and ``task`` the name of the task.
    """

    preset: str
    settings: FitSettings
    types: ModuleType
    storage: str = ""
    options: Mapping[str, Any] = field(default_factory=dict)
    checkpoint: str | os.PathLike | None = None
    resume: bool = False
    progress: bool = True
    output: Path | None = None
    deadline: Deadline | None = None
    task: str = ""

    def run(self, stages: Iterable[Stage]) -> list[FitResult]:
        """Train the ``stages`` (:class:`Stage`), one after the other, and return the record of each.

        ``stages`` may be a generator, which decides on a stage when the one before has ended. After Ctrl-C no further
        stage begins, and the last record is ``interrupted``.
        """
        results: list[FitResult] = []
        with interruptible() as stop:
            for stage in stages:
                if results and stop.is_set():
                    results[-1] = dataclasses.replace(results[-1], interrupted=True)
                    break
                problem = stage.problem() if callable(stage.problem) else stage.problem
                if problem is None:
                    continue
                request, title = self._stage_request(stage), stage.title or stage.name or None
                results.append(request.train(problem, title, stage.finish, stage.times, stage.least))
                if results[-1].interrupted:
                    break
        return results

    def _stage_request(self, stage: Stage) -> FitRequest:
        checkpoint, resume = self.checkpoint if stage.resumable else None, self.resume and stage.resumable
        if checkpoint is not None and stage.name:
            checkpoint = f"{checkpoint}.{stage.name}"
            resume = resume and os.path.exists(checkpoint)
        request = self.part(stage.share) if stage.share < 1 else self
        settings = stage.settings or self.settings
        return dataclasses.replace(request, settings=settings, checkpoint=checkpoint, resume=resume)

    def train(
        self,
        problem,
        title: str | None = None,
        finish: Callable[[], object] | None = None,
        times: float = 1.0,
        least: int = 1,
    ) -> FitResult:
        """Train one :class:`.loop.Problem` with these settings. Other parameters are those of :class:`Stage`."""
        if finish is not None and self.deadline is not None:
            self.deadline.rehearse(finish, times)
        return problem.train(
            self.settings, self.checkpoint, self.resume, self.progress, title=title, deadline=self.deadline, least=least
        )

    def rehearse(self, finish: Callable[[], Any], times: float = 1.0) -> Any:
        """Carry out ``finish`` and return its result; with a limit of time, ``times`` as long is kept for it."""
        return finish() if self.deadline is None else self.deadline.rehearse(finish, times)

    def part(self, share: float) -> FitRequest:
        """Return the request for a stage that takes a ``share`` of the time that is left, if time is limited."""
        return self if self.deadline is None else dataclasses.replace(self, deadline=self.deadline.part(share))

    def recorded(self, result: FitResult | None = None) -> dict:
        """Return the settings as a table file keeps them: with a limit of time, the steps are those of the result."""
        if self.deadline is None:
            return self.settings.common
        steps = {} if result is None else {"steps": result.steps}
        return {**self.settings.common, **steps, "seconds": self.deadline.total}

    @property
    def folder(self) -> Path:
        """Folder of the output, by default the current one."""
        return (self.output or Path("x")).resolve().parent

    def paths(self, **sources) -> dict[str, str]:
        """Return those of the ``sources`` that are files, as a table file keeps them: relative to :attr:`folder`.

        Arrays, meshes and other objects in memory are left out.
        """
        files = {name: file for name, file in sources.items() if isinstance(file, (str, os.PathLike))}
        return {k: Path(os.path.relpath(Path(file).resolve(), self.folder)).as_posix() for k, file in files.items()}


@dataclass(repr=False)
class Fitted:
    """Result of a training, as :func:`fit` returns it.

    The ``table`` holds the arrays, ``result`` is the record of the training, ``lines`` are remarks to print and
    ``figures`` further numbers of the :attr:`report`. ``request`` is the request that was carried out.
    """

    table: Table
    result: FitResult
    lines: list[str] = field(default_factory=list)
    figures: dict = field(default_factory=dict)
    request: FitRequest | None = None

    @functools.cached_property
    def model(self) -> Model:
        """Model of the result, ready to be evaluated, measured and decoded."""
        return find_task(self.table).model(self.table, self.request.types.TensorXf)

    @property
    def history(self) -> list[dict]:
        """Figures of all measurements during the training, with the step and the loss."""
        return self.result.history

    @property
    def report(self) -> dict:
        """All figures of the result, as ``mi-diffind fit --json`` writes them."""
        table, result = self.table, self.result
        training = ("step", "seconds", "unfinished", "restarts", "history")
        return {
            "interrupted": result.interrupted, "task": (self.request and self.request.task) or table.task,
            "preset": table.preset, "bytes": table.nbytes, "storage": table.storage, "settings": table.settings,
            "measured": table.measured, **{name: getattr(result, name) for name in training}, **self.figures,
        }  # fmt: skip

    def save(self, path: str | os.PathLike) -> Path:
        """Write the table file ``path`` (``.npz``) and return its path.

        Files that the table names, such as its source, are named relative to the new file's folder. Raises
        :class:`.UsageError` for another extension and :class:`.OutputError`.
        """
        from ..arrays.tables import move_paths, save_table

        path, table = table_path(path), self.table
        if self.request is not None:
            settings = move_paths(table.settings, self.request.folder, path.resolve().parent)
            table = dataclasses.replace(table, settings=settings)
        save_table(path, table)
        return path

    def summary(self, path: str | os.PathLike = "FILE.npz") -> list[str]:
        """Return the result as lines of text: bytes, accuracy, remarks, and how a scene names the file ``path``."""
        table = self.table
        lines = [f"{path}: {table.nbytes:,} bytes as {table.storage}; {self.result.outcome}"]
        lines += [f"  {line}" for line in (*figure_lines(table.measured), *self.lines)]
        usage = tasks()[table.task].usage(table, Path(path).name) if table.task in tasks() else []
        return [*lines, *(["in a scene:"] if usage else []), *(f"  {line}" for line in usage)]

    def __repr__(self) -> str:
        return "\n".join(self.summary())

    def _repr_html_(self) -> str:
        from html import escape

        return f"<pre>{escape(repr(self))}</pre>"


def significant(figures: Mapping[str, float]) -> dict[str, float]:
    """Return figures with five digits, as a table file holds them."""
    return {name: float(f"{value:.5g}") for name, value in figures.items()}


def table_path(path: str | os.PathLike) -> Path:
    """Return the path of a table file to write. Raises :class:`UsageError` if its extension is not ``.npz``."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise UsageError(f'output "{path}": found the extension "{path.suffix}", allowed is .npz')
    return path


class Model:
    """Base class of the content of a table file, ready to be evaluated.

    ``table`` is what was read and checked, ``arrays`` its arrays by name, allocated for the tensor type ``dtype``. A
    task's own class builds from them what can be evaluated (:meth:`build`). ``form`` is the requested storage form, ""
    for the file's own.
    """

    #: Storage forms that ``inspect --measure`` compares; "" means the file's own.
    forms: tuple[str, ...] = ("",)

    def __init__(self, table: Table, arrays: dict[str, DifferentiableArray], dtype, form: str = ""):
        self.table, self.arrays, self.dtype, self.form = table, arrays, dtype, form
        self.build()

    @property
    def types(self) -> ModuleType:
        """Module of the Dr.Jit types to compute with."""
        return backend_module(self.dtype)

    def copy(self) -> Model:
        """Return another model that shares the memory of this one's arrays."""
        arrays = {name: array.copy() for name, array in self.arrays.items()}
        return type(self)(self.table, arrays, self.dtype, self.form)

    def build(self) -> None:
        """Build what can be evaluated from ``arrays``."""

    @property
    def storage(self) -> str:
        """Storage form of the arrays; several are joined with a "/", "" stands for no arrays."""
        return "/".join(dict.fromkeys(array.storage for array in self.arrays.values()))

    @property
    def nbytes(self) -> int:
        """Bytes of all entries in their storage forms."""
        return sum(array.nbytes for array in self.arrays.values())

    @property
    def memory_nbytes(self) -> int:
        """Bytes in memory, with padding and repeated entries."""
        return sum(array.memory_nbytes for array in self.arrays.values())

    def entries(self) -> dict:
        """Return what can be optimised, by name: arrays in single precision, or tensors."""
        return {name: array for name, array in self.arrays.items() if array.storage == "float32"}

    def describe(self) -> tuple[dict, list[str]]:
        """Return figures for ``--json``, and lines of text, beyond the arrays and the training."""
        return {}, []

    def measure(self, **options) -> dict[str, float]:
        """Return errors against the truth, with units in the names (``psnr_db``).

        Raises :class:`.TableError` if there is no truth at hand.
        """
        self._refuse("cannot be measured")

    def decode(self, output: str | os.PathLike | None = None, **options):
        """Write the content in an ordinary format, and return each file with a line about it.

        Without an ``output``, the content is returned: of maps a dictionary of arrays, of a distance field a
        ``trimesh.Trimesh``. Raises :class:`.TableError` if there is no such format, and :class:`.UsageError`.
        """
        self._refuse("stand for nothing that could be decoded")

    def _refuse(self, fault: str):
        from ..arrays.tables import TableError

        raise TableError(f'{self.table.path}: holds tables for the task "{self.table.task}", which {fault}')


class Task:
    """Base class of tasks. Class attributes describe the task, methods carry it out.

    A task has to have a ``name``, a ``title``, ``presets``, and either :meth:`problem` and :meth:`table` or a
    ``fit.py``.
    """

    #: Word for the task on the command line and in table files, and name of its entry point, if any.
    name: str
    #: Content of the tables: "the GGX distribution of normals".
    title: str
    #: Section of the paper.
    section: str = ""
    #: Source and options of the example in the help of ``fit``.
    example: str = ""
    #: Name → settings of a training; the first is the default.
    presets: Mapping[str, FitSettings]
    #: Preset → the table file that ships, relative to ``mi_diffind/data`` unless absolute.
    shipped: Mapping[str, str | os.PathLike] = {}
    #: Storage forms of a training's result, the first is the default; none: the task chooses.
    storages: tuple[str, ...] = STORAGES
    #: Arguments of ``fit`` that only this task adds.
    arguments: tuple[Argument, ...] = ()
    #: Arguments of ``decode`` that only this task adds.
    decode_arguments: tuple[Argument, ...] = ()
    #: Name of the submodule with ``load``, ``allocate``, ``stored`` and ``MODEL``.
    files: str = "files"
    #: Measurements during a training; 0: one each ``measure_every`` steps of the preset.
    measurements: int = 0
    #: Former names of tasks that this one carries out → a sentence that says how.
    former: Mapping[str, str] = {}
    #: Object type and name of the plugin that reads the tables ("texture", "neural_image"); none: no plugin does.
    plugin: tuple[str, str] | None = None

    def settings(self, preset: str, given: Mapping, options: Mapping) -> FitSettings:
        """Return the settings of a preset with the ``given`` ones in place; ``options`` are the task's own."""
        return self.change_settings(self.presets[preset], given)

    def change_settings(self, defaults: FitSettings, given: Mapping) -> FitSettings:
        """Return ``defaults`` with the ``given`` settings in place, and so many :attr:`measurements`."""
        if self.measurements:
            steps = given.get("steps", defaults.steps)
            defaults = dataclasses.replace(defaults, measure_every=max(1, steps // self.measurements))
        return dataclasses.replace(defaults, **given)

    def usage(self, table: Table, file: str) -> list[str]:
        """Return the lines of XML by which a scene reads the table file ``file``; none if no plugin does."""
        if self.plugin is None:
            return []
        tag, name = self.plugin
        layout = table.settings.get("layout")
        maps = [entry["name"] for entry in layout["maps"]] if isinstance(layout, dict) else []
        lines = [f'    <string name="filename" value="{file}"/>']
        if len(maps) > 1:
            lines.append(f'    <string name="channels" value="{maps[0]}"/>  <!-- or {", ".join(maps[1:])} -->')
        return [f'<{tag} type="{name}">', *lines, f"</{tag}>"]

    def output_path(self, path: str | os.PathLike) -> Path:
        """Return the path of the output. Raises :class:`UsageError` if it is no table file."""
        return table_path(path)

    def check(self, request: FitRequest) -> None:
        """Raise :class:`.UsageError` for options that exclude each other, before any work.

        Calls ``check`` of the task's ``fit.py`` if there is one.
        """
        if check := self._implementation("check", "fit"):
            check(request)

    def problem(self, request: FitRequest):
        """Return the problem to train (:class:`.loop.Problem`), with its arrays allocated."""
        raise NotImplementedError

    def table(self, problem, request: FitRequest) -> Table:
        """Return the arrays of a problem as a file holds them: in single precision, or as the task stores them."""
        raise NotImplementedError

    def fit(self, request: FitRequest) -> Fitted:
        """Train, and measure the result in its storage form.

        Calls ``fit`` of the task's ``fit.py`` if there is one, else trains :meth:`problem` once.
        """
        if fit := self._implementation("fit", "fit"):
            return fit(request)
        problem = self.problem(request)

        def stored() -> tuple[Table, dict[str, float]]:
            table = self.table(problem, request)
            table.preset, table.seed = request.preset, request.settings.seed
            table = table.to(request.storage) if request.storage else table
            return table, self.model(table, request.types.TensorXf).measure()

        result = request.train(problem, finish=stored)
        table, measured = stored()
        table.settings = {**request.recorded(result), **table.settings}
        table.measured = significant(measured)
        return Fitted(table, result)

    def load(self, path: str | os.PathLike) -> Table:
        """Read and check a file of this task, by ``load`` of ``files.py`` if there is one.

        Raises :class:`.TableError`.
        """
        from ..arrays.tables import load_table

        load = self._implementation("load", self.files)
        return load(path) if load else load_table(path, self.name)

    def model_class(self) -> type[Model]:
        """Return ``MODEL`` of ``files.py`` or ``model.py``, the class that :meth:`model` makes an instance of."""
        return self._implementation("MODEL", self.files, "model") or Model

    def allocate(self, table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
        """Return the arrays of a checked table for the tensor type ``dtype``, by ``allocate`` of ``files.py`` if any.

        ``storage`` is the storage form ("": the file's own).
        """
        if allocate := self._implementation("allocate", self.files):
            return allocate(table, dtype, storage)
        return {name: array.allocate(dtype, storage) for name, array in table.arrays.items()}

    def stored(self, table: Table, entries: dict, storage: str = "") -> Table:
        """Return a table with optimised ``entries`` (name → array) in a storage form ("": that of the table).

        Calls ``stored`` of ``files.py`` if there is one. Raises ``ValueError`` for a form that the task does not have.
        """
        from ..arrays.tables import restored

        return (self._implementation("stored", self.files) or restored)(table, entries, storage)

    def _implementation(self, name: str, *modules: str) -> Any:
        """Return ``name`` of the first of the package's ``modules`` that has it, ``None`` if none has."""
        for cls in type(self).__mro__[: type(self).__mro__.index(Task)]:
            package = sys.modules[cls.__module__].__package__
            for module in modules if package else ():
                if importlib.util.find_spec(f"{package}.{module}") is not None:
                    implementation = getattr(importlib.import_module(f"{package}.{module}"), name, None)
                    if implementation is not None:
                        return implementation
        return None

    def model(self, table: Table, dtype, storage: str = "") -> Model:
        """Return the model of a checked table. Raises :class:`.TableError`."""
        return self.model_class()(table, self.allocate(table, dtype, storage), dtype, storage)

    def read(self, path: str | os.PathLike, dtype, storage: str = "") -> Model:
        """Return the model of a file of this task for the tensor type ``dtype``. Raises :class:`.TableError`."""
        return self.model(self.load(path), dtype, storage)

    def file(self, filename: str | os.PathLike = "", preset: str = "") -> Path:
        """Return the path ``filename``, or of the file that ships for ``preset`` ("": the default).

        Raises ``ValueError`` if no such file ships.
        """
        if str(filename):
            return Path(filename)
        if not self.shipped:
            raise ValueError('parameter "filename": not given, and no tables ship for this task')
        if preset and preset not in self.shipped:
            raise ValueError(f'parameter "preset": found "{preset}", allowed are {", ".join(self.shipped)}')
        return DATA / self.shipped[preset or next(iter(self.shipped))]

    def open(self, dtype, filename: str | os.PathLike = "", preset: str = "", storage: str = "") -> Model:
        """Return the model of ``filename``, or of the shipped tables of ``preset``, for the tensor type ``dtype``.

        ``storage`` is the storage form ("": the file's own). A file is read and checked once; models share its memory,
        yet assigning to the arrays of one does not change another. Raises :class:`.TableError` or ``ValueError``.
        """
        if storage and storage not in STORAGES:
            raise ValueError(f'parameter "storage": found "{storage}", allowed are {", ".join(STORAGES)}')
        path = self.file(filename, preset)
        original = read_once(self.read, path, dtype, storage)
        if preset and original.table.preset != preset:
            from ..arrays.tables import TableError

            raise TableError(f'{path}: holds tables of the preset "{original.table.preset}", "{preset}" was asked for')
        return original.copy()


@functools.lru_cache
def tasks() -> dict[str, Task]:
    """Return all tasks by name: the package's own first, then those of entry points."""
    return discovery.load("mi_diffind.tasks", "TASK", expected=Task)


def former_tasks() -> dict[str, str]:
    """Return the names of tasks that are parts of others now, each with a sentence that says what to use."""
    return {name: sentence for task in tasks().values() for name, sentence in task.former.items()}


def find_task(table: Table) -> Task:
    """Return the task of a table that was read.

    Raises :class:`.TableError` if it is not installed.
    """
    from ..arrays.tables import TableError

    if table.task not in tasks():
        known = ", ".join(tasks())
        raise TableError(f'{table.path}: holds tables for the task "{table.task}", installed are {known}')
    return tasks()[table.task]


def load_model(path: str | os.PathLike, dtype, storage: str = "") -> Model:
    """Return the model of a table file of any task. Raises :class:`.TableError`."""
    from ..arrays.tables import load_table

    return find_task(load_table(path)).read(path, dtype, storage)


def open_model(path: str | os.PathLike = "", storage: str = "", *, task: str = "", preset: str = "") -> Model:
    """Open a table file of any task, or the tables that ship for a ``task`` and its ``preset``: ``mi_diffind.open``.

    ``storage`` is the storage form of the arrays, ``"float32"``, ``"float16"`` or ``"uint8"`` ("": the file's own). The
    model computes on the device of the Mitsuba variant that is set. Raises :class:`.TableError` and ``ValueError``.
    """
    from ..core.runtime import array_module

    if storage and storage not in STORAGES:
        raise UsageError(f'storage: found "{storage}", allowed are {", ".join(STORAGES)}')
    if not str(path):
        shipping = [name for name, known in tasks().items() if known.shipped]
        if task not in shipping:
            raise UsageError(f'open: found no file and the task "{task}", tables ship for {", ".join(shipping)}')
        path = tasks()[task].file("", preset)
    return load_model(path, array_module().TensorXf, storage)


def fit(
    task: str,
    source: Any = None,
    *,
    preset: str = "",
    variant: str | None = None,
    storage: str = "",
    seconds: float | Deadline | None = None,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    progress: bool = True,
    output: str | os.PathLike | None = None,
    **given,
) -> Fitted:
    """Train the tables of a ``task`` (``"texture"``, ``"sdf"``, …): ``mi-diffind fit`` in Python.

    - ``source``: what the tables are fitted to, as a file or as an object in memory. Of ``bsdf``: a scene or BSDF as a
      file, a dictionary as of ``mi.load_dict``, a ``mi.BSDF``, or a measured file. Of ``image`` and
      ``texture``: an image file or a manifest, an array ``(height, width, channels)``, a ``mi.Bitmap``, or a dictionary
      of such maps by name. Of ``sdf``: a mesh file, a ``trimesh.Trimesh`` or a ``mi.Mesh``. Of ``field``: a folder of
      views. Of ``scene``: a scene file or dictionary. ``ggx`` and ``disney`` have none.
    - ``preset``: layout and training ("": the task's default).
    - ``variant``: variant of Mitsuba on whose device to train (``None``: the one that is set; the GPU if none is set
      and there is one).
    - ``storage``: storage form of the result ("": the task's default).
    - ``seconds``: duration of everything in place of ``steps``: reading, preparation, training and measurement.
    - ``checkpoint``: file that keeps the state of the training, with which ``resume`` continues it.
    - ``progress``: show a progress bar in a terminal.
    - ``output``: file in which the table will be saved, a folder for several textures of a scene; nothing is written.
    - ``given``: the other options of the command line as keywords (``mi-diffind fit TASK --help``): settings of the
      training (``steps``, ``lr``, ``batch``, ``seed``, …) and the task's own (``compression=12``).

    Raises :class:`.UsageError` for an unknown name or value, and as the training does.
    """
    from ..core.runtime import array_module

    if task not in tasks():
        if task in former_tasks():
            raise UsageError(f'the task "{task}" is no more: {former_tasks()[task]}')
        raise UsageError(f'found the task "{task}", installed are {", ".join(tasks())}')
    chosen = tasks()[task]
    preset = preset or next(iter(chosen.presets))
    if preset not in chosen.presets:
        raise UsageError(f'{task}: found the preset "{preset}", allowed are {", ".join(chosen.presets)}')
    if storage and storage not in chosen.storages:
        raise UsageError(f'{task}: found the storage "{storage}", allowed are {", ".join(chosen.storages) or "none"}')
    if source is not None:
        given["source"] = source
    deadline = Deadline(seconds) if isinstance(seconds, (int, float)) else seconds
    arguments = {argument.name: argument for argument in chosen.arguments}
    options, names = {k: a.default for k, a in arguments.items()}, {f.name for f in fields(FitSettings)}
    for key, value in given.items():
        if key == "source" and key not in options:
            raise UsageError(f"{task}: found a source, but this task has none")
        if key not in options and key not in names:
            allowed = ", ".join(sorted({*options, *names}))
            raise UsageError(f'{task}: found the argument "{key}", allowed are {allowed}')
        options |= {key: arguments[key].parsed(value)} if key in options else {}
    settings = chosen.settings(preset, {k: v for k, v in given.items() if k in names}, options)
    # Dr.Jit ends the process where memory cannot be allocated
    check_memory("batch", settings.batch, SAMPLE_BYTES * settings.batch)
    output = None if output is None else chosen.output_path(output)
    check_files(chosen.arguments, options, {"-o": output, "--checkpoint": checkpoint})
    if resume and deadline is not None:
        raise UsageError("--resume needs the --steps of the run that it goes on with: leave out --seconds")
    storage = storage or next(iter(chosen.storages), "")
    request = FitRequest(
        preset, settings, array_module(variant), storage, options, checkpoint, resume, progress, output, deadline, task
    )
    chosen.check(request)
    fitted = chosen.fit(request)
    fitted.request = request
    if deadline is not None and deadline.spent() > OVERRUN * deadline.seconds:
        fitted.lines.append(f"took {deadline.spent():.0f} s of the {deadline.seconds:g} s that were given")
    return fitted
