"""Discovery of tasks, plugins and studies, which are never listed.

A part that ships is found by its place, a module of a package (``mi_diffind.tasks``, ``mi_diffind.plugins``,
``mi_diffind.studies``); a part of another package by an entry point of the group of that name, in its
``pyproject.toml``::

    [project.entry-points."mi_diffind.tasks"]
    profile = "their_package.profile"
"""

import importlib
import importlib.metadata
import pkgutil
import warnings
from collections.abc import Mapping


def modules(package: str, ignored: tuple[str, ...] = ()) -> dict[str, str]:
    """Return name → full name of the modules of ``package`` and of the entry points of the group ``package``.

    The package's own modules come first, in alphabetical order, without the ``ignored`` ones and those that begin with
    an underscore. Nothing is imported but the package itself. A name that exists already is left out with a warning.
    """
    path = importlib.import_module(package).__path__
    names = sorted(m.name for m in pkgutil.iter_modules(path))
    named = {n: f"{package}.{n}" for n in names if n not in ignored and not n.startswith("_")}
    for entry in sorted(importlib.metadata.entry_points(group=package), key=lambda e: e.name):
        if entry.name in named:
            if named[entry.name] != entry.module:
                _warn(f'"{entry.name}" ({entry.module}) is left out: {package} has {named[entry.name]} of that name')
        else:
            named[entry.name] = entry.module
    return named


def load(
    package: str,
    attribute: str,
    ignored: tuple[str, ...] = (),
    known: Mapping[str, str] | None = None,
    expected: type = object,
) -> dict:
    """Import :func:`modules` (or the ``known`` ones) and return name → the ``attribute`` that each declares.

    A declaration is an instance of ``expected``; its ``name`` counts, if it has one, and has to be that of the entry
    point. A module of another package that cannot be imported, lacks the attribute or declares a name of this package
    is left out with a warning; a module of this package that lacks the attribute declares nothing.
    """
    shipped, others, known = {}, {}, modules(package, ignored) if known is None else known
    for name in known:
        ours = known[name].startswith(f"{package.partition('.')[0]}.")
        try:
            module = importlib.import_module(known[name])
            if ours and not hasattr(module, attribute):
                continue
            declared = getattr(module, attribute)
            if not isinstance(declared, expected):
                raise TypeError(f"its {attribute} is a {type(declared).__name__}, a {expected.__name__} is needed")
            declared_name = getattr(declared, "name", name)
            if not ours and declared_name != name:
                raise ValueError(f'its {attribute} is called "{declared_name}"')
            (shipped if ours else others)[declared_name] = declared
        except Exception as e:
            if ours:
                raise
            _warn(f'"{name}" ({known[name]}) is left out: {type(e).__name__}: {e}')
    for name in shipped.keys() & others.keys():
        _warn(f'"{name}" ({known[name]}) is left out: {package} has one of that name')
    return {**dict(sorted(shipped.items())), **{name: each for name, each in others.items() if name not in shipped}}


def _warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=3)
