"""What is found: modules of a package, then entry points; names that are taken, modules that are broken."""

import sys
import types
from importlib import metadata

import pytest

from mi_diffind.found import find

GROUP = "mi_diffind.tests"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with two modules and a package, of which one fails, and entry points that a test adds."""
    root = tmp_path / "its_package"
    (root / "inner").mkdir(parents=True)
    (root / "__init__.py").write_text("")
    (root / "one.py").write_text("NAME = 'one'")
    (root / "broken.py").write_text("1 / 0")
    (root / "inner" / "__init__.py").write_text("NAME = 'inner'")
    monkeypatch.syspath_prepend(tmp_path)
    yield []
    for name in [n for n in sys.modules if n.split(".")[0] == "its_package"]:
        del sys.modules[name]


def add(monkeypatch, *points):
    found = [metadata.EntryPoint(name, value, GROUP) for name, value in points]
    monkeypatch.setattr(metadata, "entry_points", lambda group: found if group == GROUP else [])


def test_modules_of_a_package(package):
    found = find("its_package", GROUP)
    assert sorted(found) == ["broken", "inner", "one"] and "its_package.one" not in sys.modules
    assert found["one"]().NAME == "one" and found["inner"]().NAME == "inner"
    with pytest.raises(ZeroDivisionError):  # a module of our own is not to be broken
        found["broken"]()


def test_entry_points(package, monkeypatch):
    module = types.ModuleType("of_others")
    module.THING = object()
    monkeypatch.setitem(sys.modules, "of_others", module)
    add(monkeypatch, ("module", "of_others"), ("object", "of_others:THING"))
    found = find("its_package", GROUP)
    assert list(found)[-2:] == ["module", "object"]
    assert found["module"]() is module and found["object"]() is module


def test_a_name_that_is_taken_is_refused(package, monkeypatch):
    add(monkeypatch, ("one", "of_others"), ("new", "of_others"), ("new", "of_yet_others"))
    with pytest.warns(UserWarning) as warned:
        found = find("its_package", GROUP)
    assert found["one"]().NAME == "one" and list(found)[-1] == "new"
    assert [str(w.message) for w in warned] == [
        f'the entry point "new" of {GROUP} (of_yet_others) is left out: the name is taken',
        f'the entry point "one" of {GROUP} (of_others) is left out: the name is taken',
    ]


@pytest.mark.parametrize(
    "value, reason",
    [("no_such_module", "No module named"), ("its_package.broken", "division"), ("sys:nothing", "nothing")],
)
def test_what_others_break_is_a_warning(package, monkeypatch, value, reason):
    add(monkeypatch, ("theirs", value))
    load = find("its_package", GROUP)["theirs"]
    with pytest.warns(UserWarning, match=rf'"theirs" of {GROUP} \({value}\) is left out: .*{reason}'):
        assert load() is None
