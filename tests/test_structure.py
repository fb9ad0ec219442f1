"""The plan of the house: nine floors, imports that point down, no circles, plain names, one meaning a class name."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Floors, from the lowest one up. Rooms on the same floor may import one another, without a circle.
FLOORS = (
    ("core",),
    ("arrays", "images"),
    ("fitting",),
    ("maps", "measure"),
    ("tasks",),
    ("plugins",),
    ("scenes",),
    ("studies",),
    ("commands",),
)

#: What the folder of the package holds, beside the folders of the floors.
ENTRIES = {"__init__.py", "data"}

#: Names that say how a value came about, or nothing, in place of what it is.
FORBIDDEN = {"told", "made", "found", "own", "said", "kind", "look", "course", "hair"}

#: The face of the package, which asks for what lies below it by name, when it is asked.
FACE = "mi_diffind"


@functools.lru_cache
def modules() -> dict[str, Path]:
    """Full name → file, of all modules of the library."""
    found = {}
    for folder, package in ((ROOT / "mi_diffind", "mi_diffind"), (ROOT / "plugins", "mi_diffind.plugins")):
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join((package, *parts))] = path
    return found


@functools.lru_cache
def tree(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(name: str, path: Path, known: dict) -> set[str]:
    """The modules of the library that one imports: at its top, in functions, for types, and by name with importlib."""
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    found = set()

    def absolute(level: int, module: str | None) -> str:
        base = package.split(".")[: len(package.split(".")) - level + 1] if level else []
        return ".".join([*base, *filter(None, [module])])

    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = absolute(node.level, node.module)
            for alias in node.names:
                inside = f"{base}.{alias.name}"
                found.add(inside if inside in known else base)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module") and node.args:
            literal = getattr(node.args[0], "value", None)
            if isinstance(literal, str):
                level = len(literal) - len(literal.lstrip("."))
                found.add(absolute(level, literal.lstrip(".")))
    return {other for other in found if other in known and other != name}


def floor(name: str) -> int:
    """The number of the floor that a module stands on."""
    room = name.split(".")[1]
    places = [i for i, rooms in enumerate(FLOORS) if room in rooms]
    assert places, f"{name} stands on no floor: say in {Path(__file__).name} on which"
    return places[0]


@functools.lru_cache
def graph() -> dict[str, set[str]]:
    known = modules()
    found = {name: imports(name, path, known) for name, path in known.items() if name != FACE}
    return {name: others - {FACE} for name, others in found.items()}


def test_every_module_has_its_floor():
    assert len(modules()) > 50
    for name in modules():
        assert name == FACE or floor(name) >= 0
    entries = {path.name for path in (ROOT / "mi_diffind").iterdir() if path.name != "__pycache__"}
    assert entries == ENTRIES | {room for rooms in FLOORS for room in rooms} - {"plugins"}


def test_imports_point_down():
    """Imports inside of functions count, too: they are deferred for speed, not to go around the plan."""
    wrong = [
        f"{name} imports {other}" for name, others in graph().items() for other in others if floor(other) > floor(name)
    ]
    assert not wrong, "\n".join(sorted(wrong))


#: A task → those that it is made of: a texture is trained for its shading through the tables of another task.
MADE_OF = {"texture": ("disney",)}


def task_of(name: str) -> str:
    """The task in whose folder a module is, "" for those that tasks share, and for others."""
    room, folder = [*name.split("."), "", ""][1:3]
    return folder if room == "tasks" and (ROOT / "mi_diffind" / "tasks" / folder).is_dir() else ""


def test_tasks_know_nothing_of_each_other():
    """A task may use the tasks' common modules, and no other task but those that it is made of."""
    pairs = [(name, other) for name, others in graph().items() for other in others if task_of(name) and task_of(other)]
    wrong = [
        f"{name} imports {other}"
        for name, other in pairs
        if task_of(other) not in (task_of(name), *MADE_OF.get(task_of(name), ()))
    ]
    assert len({task_of(name) for name, _ in pairs}) >= 3 and not wrong, "\n".join(sorted(wrong))


def test_general_rooms_know_no_task():
    """Nothing outside of a task's folder, its plugins and its study names it: tasks are found."""
    rooms = {"core", "arrays", "images", "fitting", "measure", "scenes", "commands"}
    # The task that is fitted through renders of a scene trains the arrays of others
    training = "mi_diffind.scenes.training"
    general = [n for n in graph() if n.split(".")[1] in rooms and not n.startswith(training)]
    general += ["mi_diffind.plugins", "mi_diffind.studies"]
    wrong = [f"{name} imports {other}" for name in general for other in graph()[name] if task_of(other)]
    assert len(general) > 20 and not wrong, "\n".join(sorted(wrong))


def circle(known: dict[str, set[str]]) -> str:
    """A circle in a graph, "" if there is none."""
    done, path = set(), []

    def visit(name: str) -> str:
        if name in path:
            return " → ".join([*path[path.index(name) :], name])
        if name in done:
            return ""
        path.append(name)
        found = next(filter(None, map(visit, sorted(known.get(name, ())))), "")
        path.pop()
        done.add(name)
        return found

    return next(filter(None, map(visit, sorted(known))), "")


def room(name: str) -> str:
    """The module or package on its floor that a module belongs to; each task and study is a room of its own."""
    parts = name.split(".")
    return ".".join(parts[: 3 if parts[1] in ("tasks", "studies") else 2])


def test_no_circles():
    """Among modules and among rooms. Imports inside of functions count: a circle is one whenever it is closed."""
    known = graph()
    # A package's __init__ and its modules are one thing to Python: who imports a module, imports its package
    assert circle(known) == ""
    rooms: dict[str, set[str]] = {}
    for name, others in known.items():
        rooms.setdefault(room(name), set()).update(map(room, others))
    assert circle({name: others - {name} for name, others in rooms.items()}) == ""
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == "b → c → b" and circle({"a": {"b", "c"}, "b": {"c"}}) == ""


#: Flow → the modules that it begins with (those that exist), and the most files that it reaches by imports of any kind.
#: The aim: 25 files to read a texture, 40 to fit one, with the BRDF that shades it, or a field.
FLOWS = {
    "fit texture": (("tasks.texture", "tasks.texture.fit", "tasks.texture.model", "tasks.texture.compressed"), 48),
    "read neural_texture": (("plugins.neural_texture",), 37),
    "fit field": (("tasks.radiance", "tasks.radiance.fit", "tasks.radiance.model", "tasks.radiance.files"), 38),
}


def closure(roots: tuple[str, ...]) -> set[str]:
    """The modules that some modules reach by imports, themselves included, without packages that hold no code."""
    reached, waiting = set(), [f"mi_diffind.{root}" for root in roots if f"mi_diffind.{root}" in modules()]
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += graph()[name]
    return {name for name in reached if len(tree(modules()[name]).body) > 1}


@pytest.mark.parametrize("flow", FLOWS)
def test_flows_pass_through_few_files(flow):
    """Imports inside of functions, for types and by name count, too."""
    roots, most = FLOWS[flow]
    reached = closure(roots)
    assert len(reached) <= most, "\n".join(sorted(reached))


def names_given(syntax: ast.AST) -> list[tuple[str, int]]:
    """The names that a file gives, with their lines: variables, attributes, parameters, functions and classes."""
    fields, names = {ast.arg: "arg", ast.Name: "id", ast.Attribute: "attr"}, []
    fields |= dict.fromkeys((ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef), "name")
    for node in ast.walk(syntax):
        if type(node) in fields and isinstance(getattr(node, "ctx", ast.Store()), ast.Store):
            names.append((getattr(node, fields[type(node)]), node.lineno))
    return names


def test_names_say_what_things_are():
    def wrong(syntax):
        return [(name, line) for name, line in names_given(syntax) if name.strip("_").lower() in FORBIDDEN]

    given = [f"{module}, line {line}: {name}" for module, path in modules().items() for name, line in wrong(tree(path))]
    assert not given, "\n".join(given)
    example = "found = 1\nclass Course:\n    def look(self, own, *said, kind=0):\n        self._made, x = own, told"
    names = [name for name, _ in wrong(ast.parse(example))]
    assert sorted(names) == ["Course", "_made", "found", "kind", "look", "own", "said"]


def test_a_class_name_has_one_meaning():
    places: dict[str, list[str]] = {}
    for module, path in modules().items():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name.strip("_"), []).append(f"{module}, line {node.lineno}")
    twice = [f"{name}: {'; '.join(where)}" for name, where in sorted(places.items()) if len(where) > 1]
    assert len(places) > 100 and not twice, "\n".join(twice)


def test_a_wrong_import_would_be_noticed(tmp_path):
    """The reader of imports: relative and absolute ones, of modules and of names, in functions, for types, by name."""
    names = ("arrays.tables", "arrays.lookup", "tasks", "tasks.ggx", "tasks.task", "commands.cli", "scenes")
    known = {f"mi_diffind.{name}": tmp_path for name in names}
    file, package = tmp_path / "file.py", tmp_path / "__init__.py"
    file.write_text(
        "from __future__ import annotations\nimport importlib\nfrom typing import TYPE_CHECKING\nimport numpy\n"
        "from ..arrays.lookup import clamp\nfrom . import task\n"
        "if TYPE_CHECKING:\n    from .ggx import GGX\n"
        "def f():\n    from mi_diffind.arrays import tables\n    import mi_diffind.commands.cli\n"
        "    return importlib.import_module('..scenes', __package__)\n"
    )
    assert imports("mi_diffind.tasks.file", file, known) == known.keys() - {"mi_diffind.tasks"}
    package.write_text("from .task import Task\nfrom ..arrays import lookup\n")
    assert imports("mi_diffind.tasks", package, known) == {"mi_diffind.arrays.lookup", "mi_diffind.tasks.task"}
    rising = ("core.files", "arrays.lookup", "fitting.loop", "maps.layout", "tasks.ggx.model", "plugins.disney",
              "scenes.loading", "studies.ggx", "commands.cli")  # fmt: skip
    assert [floor(f"mi_diffind.{name}") for name in rising] == list(range(9))


def test_a_checkout_has_its_plugins():
    """Without an editable installation, too, as for a script that is started in the folder of a clone."""
    code = (
        "import sys; sys.meta_path[:] = [f for f in sys.meta_path if 'Editable' not in getattr(f, '__name__', '')]\n"
        f"sys.path.insert(0, {str(ROOT)!r}); import importlib.util\n"
        "print(importlib.util.find_spec('mi_diffind.plugins').origin)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert Path(done.stdout.strip()) == ROOT / "plugins" / "__init__.py", done.stderr
