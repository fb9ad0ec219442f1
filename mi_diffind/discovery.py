"""
What can be added to this package without editing it: tasks, plugins and studies are found, never listed.

What ships is found by its place, a module of a package (``mi_diffind.tasks``, ``mi_diffind.plugins``,
``mi_diffind.studies``); what others add by an entry point of the group of that name, in their ``pyproject.toml``::

    [project.entry-points."mi_diffind.tasks"]
    profile = "their_package.profile"
"""

from __future__ import annotations

import importlib
import importlib.metadata
import pkgutil
import warnings
from collections.abc import Iterable


def modules(package: str, ignored: tuple[str, ...] = ()) -> dict[str, str]:
    """
    Name → full name of the module, in alphabetical order, those of ``package`` first: its own modules and packages but
    for the ``ignored`` ones and those whose name begins with an underscore, and what entry points of the group
    ``package`` name. Nothing is imported but the package itself. A name that is taken already is left out with a
    warning.
    """
    path = importlib.import_module(package).__path__
    names = sorted(m.name for m in pkgutil.iter_modules(path))
    found = {n: f"{package}.{n}" for n in names if n not in ignored and not n.startswith("_")}
    for entry in sorted(importlib.metadata.entry_points(group=package), key=lambda e: e.name):
        if entry.name in found:
            if found[entry.name] != entry.module:
                _warn(f'"{entry.name}" ({entry.module}) is left out: {package} has {found[entry.name]} of that name')
        else:
            found[entry.name] = entry.module
    return found


def load(
    package: str,
    attribute: str,
    ignored: tuple[str, ...] = (),
    only: Iterable[str] | None = None,
    kind: type = object,
) -> dict:
    """
    Name → what each of :func:`modules` (or ``only`` those of some names) calls ``attribute``, an instance of ``kind``
    of that ``name``. A module of somebody else's that cannot be imported, or lacks it, is left out with a warning; one
    of ours that lacks it is no such thing.
    """
    found, others, known = {}, {}, modules(package, ignored)
    for name in known if only is None else only:
        ours = known[name].startswith(f"{package.partition('.')[0]}.")
        try:
            module = importlib.import_module(known[name])
            if ours and not hasattr(module, attribute):
                continue
            declared = getattr(module, attribute)
            if not isinstance(declared, kind):
                raise TypeError(f"its {attribute} is a {type(declared).__name__}, a {kind.__name__} is needed")
            declared_name = getattr(declared, "name", name)
            if not ours and declared_name != name:
                raise ValueError(f'its {attribute} is called "{declared_name}"')
            (found if ours else others)[declared_name] = declared
        except Exception as e:
            if ours:
                raise
            _warn(f'"{name}" ({known[name]}) is left out: {type(e).__name__}: {e}')
    for name in found.keys() & others.keys():
        _warn(f'"{name}" ({known[name]}) is left out: {package} has one of that name')
    return {**dict(sorted(found.items())), **{name: each for name, each in others.items() if name not in found}}


def _warn(message: str) -> None:
    warnings.warn(message, RuntimeWarning, stacklevel=3)
