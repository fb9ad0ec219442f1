"""Tasks: found, never listed; light to declare; and one sentence for whatever they are asked in vain."""

import ast
import dataclasses
import os
import signal
import sys
import warnings
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest

import mi_diffind
from mi_diffind import DifferentiableArray, DiffindError, StoredArray, TableError, load_model, save_table
from mi_diffind.arrays.lookup import STORAGES
from mi_diffind.arrays.tables import Table
from mi_diffind.core import discovery
from mi_diffind.core.arguments import Argument
from mi_diffind.core.errors import UsageError
from mi_diffind.core.progress import Deadline
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import task as task_module
from mi_diffind.fitting.loop import FitSettings, Problem
from mi_diffind.fitting.task import FitRequest, Model, Stage, Task, find_task, fit, tasks

ROOT = Path(__file__).resolve().parents[1]
BUILT_IN = ("bsdf", "disney", "field", "ggx", "image", "scene", "sdf", "texture")


LINE = """
from mi_diffind.fitting.task import FitSettings
from mi_diffind.fitting.task import Task

class Line(Task):
    name, title = "line", "a straight line"
    presets = {"default": FitSettings(steps=3, batch=16)}

TASK = Line()
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """A function that adds entry points of tasks, as an installed package has them, and modules by their text."""

    def add(entry_points: dict, **modules) -> None:
        for name, text in modules.items():
            (tmp_path / f"{name}.py").write_text(text)
            monkeypatch.delitem(sys.modules, name, raising=False)
        before, added = (
            metadata.entry_points,
            [metadata.EntryPoint(*e, "mi_diffind.tasks") for e in entry_points.items()],
        )
        tasks_only = {"group": "mi_diffind.tasks"}
        monkeypatch.setattr(metadata, "entry_points", lambda **k: [*before(**k), *(added if k == tasks_only else ())])
        tasks.cache_clear()

    monkeypatch.syspath_prepend(tmp_path)
    yield add
    monkeypatch.undo()
    tasks.cache_clear()


def test_what_ships_is_found():
    """Each folder of the package is one, and nothing else; nowhere is there a list of them."""
    folders = {p.parent.name for p in (ROOT / "mi_diffind" / "tasks").glob("*/__init__.py")}
    names = {"field" if folder == "radiance" else folder for folder in folders} | {"scene"}
    assert names == set(BUILT_IN) and tuple(tasks())[: len(BUILT_IN)] == BUILT_IN
    assert {name: task.name for name, task in tasks().items()} == {name: name for name in tasks()}
    assert all(isinstance(task, Task) for task in tasks().values())


BROKEN = {
    "no such module": ({"x": "no_module_of_theirs"}, {}, "ModuleNotFoundError: No module named"),
    "an exception": ({"x": "their_x"}, {"their_x": "1 / 0"}, "ZeroDivisionError: division by zero"),
    "no task": ({"x": "their_x"}, {"their_x": "TASKS = []"}, "AttributeError: .*'TASK'"),
    "no Task": ({"x": "their_x"}, {"their_x": "TASK = 5"}, "TypeError: its TASK is a int, a Task is needed"),
    "another name": ({"x": "their_x"}, {"their_x": LINE}, 'ValueError: its TASK is called "line"'),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_broken_tasks_of_others_are_left_out(install, fault):
    """With a warning that says whose; all others work."""
    entry_points, modules, why = BROKEN[fault]
    install({**entry_points, "line": "their_line:TASK"}, their_line=LINE, **modules)
    with pytest.warns(RuntimeWarning, match=rf'^"x" \({entry_points["x"]}\) is left out: {why}') as caught:
        assert tuple(tasks()) == (*BUILT_IN, "line")
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert tuple(tasks()) == (*BUILT_IN, "line") and tasks()["line"].title == "a straight line"  # said once


def test_a_name_that_is_taken(install):
    """The first task of a name is kept: that of this package, or the first on the path."""
    install({"ggx": "their_ggx"}, their_ggx=LINE)
    with pytest.warns(RuntimeWarning, match=r'^"ggx" \(their_ggx\) is left out: mi_diffind\.tasks has mi_diffind'):
        assert tuple(tasks()) == BUILT_IN and tasks()["ggx"].title == "the GGX distribution of normals"
    install({"line": "their_line"}, their_line=LINE)
    install({"line": "another_line"}, another_line=LINE)
    with pytest.warns(RuntimeWarning) as caught:
        assert tuple(tasks()) == (*BUILT_IN, "line")
    assert sum("is left out: mi_diffind.tasks has" in str(w.message) for w in caught) == 2


@pytest.mark.parametrize("name", BUILT_IN)
def test_what_a_task_declares(name):
    """Enough for the help and the documentation; a file that ships for each preset that says so."""
    task = tasks()[name]
    assert (task.title and task.title[0].islower()) or task.title.split()[0].isupper()
    assert sys.modules[type(task).__module__].__doc__.strip()
    assert task.presets and all(isinstance(s, FitSettings) for s in task.presets.values())
    assert set(task.storages) <= set(STORAGES) == set(task_module.STORAGES)
    assert set(task.shipped) <= set(task.presets)
    for preset in task.shipped:
        table = task.load(task.file(preset=preset))
        assert (table.task, table.preset) == (name, preset) and find_task(table) is task
        assert {k: table.settings[k] for k in ("steps", "lr", "batch")} == {
            k: getattr(task.presets[preset], k) for k in ("steps", "lr", "batch")
        }
    names = [a.name for a in task.arguments]
    assert len(set(names)) == len(names) and not set(names) & {f.name for f in dataclasses.fields(FitSettings)}
    assert all(a.options.get("help") for a in (*task.arguments, *task.decode_arguments))


def score(entries):
    return -float(np.abs(entries[:, 0] - [0, 0.5, 1]).max())


class LineProblem(Problem):
    def __init__(self, types):
        self.types, self.net = types, DifferentiableArray(3, 1, value=0.0).alloc(types.TensorXf)

    def batch(self, rng, size):
        x = rng.random(self.types.Float, size)
        return [x], {"y": [x]}

    def predict(self, net, inputs):
        return {"y": net(inputs)}

    def measure(self, net):
        return {"score": score(net.numpy())}


class LineModel(Model):
    def measure(self):
        return {"score": score(self.arrays["line"].numpy())}


class LineTask(Task):
    name, title = "line", "a straight line"
    presets = {  # noqa: RUF012
        "default": FitSettings(steps=60, batch=256, lr=0.05, measure_every=20),
        "short": FitSettings(steps=5, batch=16),
    }
    arguments = (Argument("--slope", type=float, default=1.0), Argument("--steep", action="store_true"))

    def check(self, request):
        if request.options["slope"] != 1:
            raise UsageError(f"slope: found {request.options['slope']:g}, allowed is 1")

    def problem(self, request):
        self.request = request
        return LineProblem(request.types)

    def table(self, problem, request):
        return Table(self.name, {"line": StoredArray.of(problem.net)}, settings={"own": 1})

    def model_class(self):
        return LineModel


@pytest.fixture
def line(monkeypatch):
    task = LineTask()
    monkeypatch.setattr(task_module, "tasks", lambda: {"line": task})
    return task


def run(**options):
    return fit("line", variant="llvm", progress=False, **options)


def test_fit(line, tmp_path):
    """The base class trains, records the settings, converts to the storage and measures."""
    fitted = run(seed=4, lr=0.1, storage="uint8", output=tmp_path / "line.npz")
    table, request = fitted.table, line.request
    assert (table.task, table.preset, table.seed, table.storage) == ("line", "default", 4, "uint8")
    expected = dataclasses.asdict(dataclasses.replace(LineTask.presets["default"], seed=4, lr=0.1))
    assert table.settings == {**expected, "own": 1} and fitted.result.steps == 60
    assert request.options == {"slope": 1.0, "steep": False} and request.output == tmp_path / "line.npz"
    # Measured in the storage form that is written, in five digits
    found = score(table.arrays["line"].values)
    assert table.measured == {"score": float(f"{found:.5g}")} and found > -0.1
    assert run(preset="short").table.settings["steps"] == 5 and run(steep=True) and line.request.options["steep"]
    assert run().table.storage == "float32"


def test_stages(line, tmp_path):
    """A fit in stages: each has its settings, its checkpoint, and what the ones before have trained."""
    types, trained = array_module("llvm"), []
    request = FitRequest("", LineTask.presets["short"], types, progress=False, checkpoint=tmp_path / "line.ckpt")

    def second():
        assert trained[0].net.numpy().max() > 0
        trained.append(LineProblem(types))
        return trained[-1]

    trained.append(LineProblem(types))
    long = LineTask.presets["default"]
    stages = [Stage("first", trained[0], 0.5, long), Stage("none", lambda: None), Stage("", second)]
    assert [result.steps for result in request.run(stages)] == [60, 5]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["line.ckpt", "line.ckpt.first"]
    again = dataclasses.replace(request, resume=True)
    trained[:] = [LineProblem(types)]
    stages[0] = dataclasses.replace(stages[0], problem=trained[0])
    assert [result.steps for result in again.run(stages)] == [60, 5]
    limited = dataclasses.replace(request, checkpoint=None, deadline=Deadline(8))
    part = limited._stage_request(stages[0])
    assert part.settings is long and part.deadline.seconds < 4 and part.recorded()["seconds"] == 8


def test_no_stage_begins_after_an_interrupt(line):
    class Interrupted(LineProblem):
        def measure(self, net):
            os.kill(os.getpid(), signal.SIGINT)
            return super().measure(net)

    types = array_module("llvm")
    request = FitRequest("", LineTask.presets["short"], types, progress=False)
    results = request.run([Stage("a", Interrupted(types)), Stage("b", LineProblem(types))])
    assert len(results) == 1 and results[0].interrupted


def test_models_of_any_task(line, tmp_path):
    """Read by the file alone, and by the task, which reads a file once."""
    dtype, path = array_module("llvm").TensorXf, tmp_path / "line.npz"
    save_table(path, run(preset="short").table)
    model = load_model(path, dtype)
    assert type(model) is LineModel and model.table.path == path and model.types is array_module("llvm")
    assert model.storage == "float32" and model.nbytes == 12 <= model.memory_nbytes
    assert load_model(path, dtype, "float16").storage == "float16"
    opened = line.open(dtype, path, storage="uint8")
    assert opened.storage == "uint8" and opened.table.storage == "float32"
    with pytest.raises(ValueError, match='parameter "filename": not given, and no tables ship for this task'):
        line.open(dtype)
    with pytest.raises(TableError, match='holds tables of the preset "short", "default" was asked for'):
        line.open(dtype, path, "default")
    save_table(path, Table("cloth", {}))
    with pytest.raises(TableError, match=r'line\.npz: holds tables for the task "cloth", installed are line'):
        load_model(path, dtype)


@pytest.mark.parametrize("method", ["measure", "decode"])
def test_what_a_model_leaves_out_is_refused(method, tmp_path):
    table = Table("line", {"a": StoredArray(np.zeros((2, 1), np.float32))}, path=tmp_path / "line.npz")
    model = Task().model(table, array_module("llvm").TensorXf)
    assert type(model) is Model and model.describe() == ({}, []) and model.forms == ("",)
    with pytest.raises(TableError) as caught:
        model.measure() if method == "measure" else model.decode(tmp_path / "x.csv")
    what = {"measure": "cannot be measured", "decode": "stand for nothing that could be decoded"}[method]
    assert str(caught.value) == f'{tmp_path / "line.npz"}: holds tables for the task "line", which {what}'


REFUSED = {
    "task": (("nothing",), {}, 'found the task "nothing", installed are line'),
    "preset": (("line",), {"preset": "best"}, 'line: found the preset "best", allowed are default, short'),
    "storage": (("line",), {"storage": "int4"}, 'line: found the storage "int4", allowed are float32, float16, uint8'),
    "argument": (("line",), {"stepz": 3}, 'line: found the argument "stepz", allowed are batch, check_every, '),
    "own argument": (("line",), {"slope": 2.0}, "slope: found 2, allowed is 1"),
    "resume": (("line",), {"resume": True, "seconds": 3}, "--resume needs the --steps of the run"),
    "setting": (("line",), {"lr": -1.0}, "lr: found -1.0, a positive number is needed"),
    "variant": (("line",), {"variant": "scalar_rgb"}, 'the variant "scalar_rgb" is not vectorised'),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_fit_refuses(line, what):
    """In one sentence, before anything is made."""
    arguments, options, sentence = REFUSED[what]
    with pytest.raises(DiffindError) as caught:
        fit(*arguments, **{"variant": "llvm", "progress": False, **options})
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)
    assert not hasattr(line, "request")


def test_a_task_without_storage_forms(line):
    line.storages = ()
    with pytest.raises(UsageError, match='line: found the storage "uint8", allowed are none'):
        run(storage="uint8")
    assert run(preset="short").table.storage == "float32" and line.request.storage == ""


def test_all_errors_have_one_base_class():
    """Each error of the library derives from ``DiffindError``, which the command line catches."""
    files = [*(ROOT / "mi_diffind").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    nodes = [node for path in files for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    bases = {n.name: [ast.unparse(b).split(".")[-1] for b in n.bases] for n in nodes if isinstance(n, ast.ClassDef)}
    errors = {name for name, above in bases.items() if any(b.endswith(("Error", "Exception")) for b in above)}
    assert {"TableError", "OutputError", "FittingError", "SourceError", "SceneError", "UsageError"} <= errors

    def derives(name):
        return name == "DiffindError" or any(derives(base) for base in bases.get(name, []))

    # No errors: how a loop is left, what keeps a plugin or waits for a fit, and what a decoder tells its reader
    assert {name for name in errors if not derives(name)} <= {
        "Stopped",
        "Kept",
        "_Waiting",
        "TooManyNodes",
        "BudgetError",
    }


def test_what_can_be_asked_of_the_package():
    """Its face, without a task or a variant: each name is there, and imported when it is asked for."""
    for name in mi_diffind.__all__:
        assert getattr(mi_diffind, name) is not None and name in dir(mi_diffind)
    assert mi_diffind.fit is fit and mi_diffind.DiffindError is DiffindError
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        mi_diffind.nothing  # noqa: B018


def test_a_broken_module_of_ours_is_an_error(tmp_path, monkeypatch):
    """Left out is only what does not claim to be one, or what is not asked for."""
    (tmp_path / "its_package").mkdir()
    for name, text in {"__init__": "", "one": "THING = 1", "none": "", "broken": "1 / 0"}.items():
        (tmp_path / "its_package" / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    known = {name: f"its_package.{name}" for name in ("one", "none")}
    assert discovery.load("its_package", "THING", known=known, expected=int) == {"one": 1}
    with pytest.raises(ZeroDivisionError):
        discovery.load("its_package", "THING")
    with pytest.raises(TypeError, match="its THING is a int, a str is needed"):
        discovery.load("its_package", "THING", known={"one": known["one"]}, expected=str)
