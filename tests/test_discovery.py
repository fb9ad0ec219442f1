"""What is found, of any package: its modules, then entry points of the group of its name; what is broken or missing."""

import sys
from importlib import metadata

import pytest

from mi_diffind.core import discovery


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A function that makes a package ``its_package`` of modules (name → text) and of entry points (name → module)."""

    def make(modules, points=()):
        root = tmp_path / "its_package"
        root.mkdir()
        for name, text in {"__init__": "", **modules}.items():
            (root / f"{name}.py").write_text(text)
        entries = [metadata.EntryPoint(name, value, "its_package") for name, value in dict(points).items()]
        monkeypatch.setattr(metadata, "entry_points", lambda group: entries if group == "its_package" else [])

    monkeypatch.syspath_prepend(tmp_path)
    yield make
    for name in [n for n in sys.modules if n.split(".")[0] == "its_package"]:
        del sys.modules[name]


def test_modules(package):
    package({"two": "", "one": "1 / 0", "_own": "", "shared": ""}, {"three": "theirs:THING", "two": "its_package.two"})
    names = discovery.modules("its_package", ignored=("shared",))
    assert names == {"one": "its_package.one", "two": "its_package.two", "three": "theirs"}
    assert list(names) == ["one", "two", "three"] and "its_package.two" not in sys.modules


def test_what_of_ours_is_broken_is_an_error(package):
    """Left out is only what does not claim to be one, or what is not asked for."""
    package({"one": "THING = 1", "none": "", "broken": "1 / 0"})
    assert discovery.load("its_package", "THING", only=("one", "none"), expected=int) == {"one": 1}
    with pytest.raises(ZeroDivisionError):
        discovery.load("its_package", "THING")
    with pytest.raises(TypeError, match="its THING is a int, a str is needed"):
        discovery.load("its_package", "THING", only=("one",), expected=str)
