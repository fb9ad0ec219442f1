"""What declares itself is found here: modules of a package of ours, and modules that others add by an entry point."""

from __future__ import annotations

import importlib
import pkgutil
import sys
import warnings
from collections.abc import Callable
from functools import partial
from importlib import metadata
from types import ModuleType

#: Imports a module and returns it; ``None``, after a warning, if it is another package's and cannot be imported.
Loader = Callable[[], "ModuleType | None"]


def find(package: str, group: str) -> dict[str, Loader]:
    """
    The modules (and packages) in the package named ``package``, by their own names, then those of the entry points of
    ``group`` (an entry point may name a module or an object in one). Nothing is imported but ``package``: each value is
    a function that does it. An entry point whose name is taken is left out with a warning of one sentence; so is, when
    it is loaded, one that cannot be imported, for which the function returns ``None``.
    """
    inside = importlib.import_module(package)
    found: dict[str, Loader] = {
        module.name: partial(importlib.import_module, f"{package}.{module.name}")
        for module in pkgutil.iter_modules(inside.__path__)
    }
    for point in sorted(metadata.entry_points(group=group), key=lambda p: (p.name, p.value)):
        if point.name in found:
            warnings.warn(f'the entry point "{point.name}" of {group} ({point.value}) is left out: the name is taken',
                          stacklevel=2)  # fmt: skip
        else:
            found[point.name] = partial(_load, point)
    return found


def _load(point: metadata.EntryPoint) -> ModuleType | None:
    try:
        loaded = point.load()
    except Exception as e:
        reason = str(e).splitlines()[0] if str(e) else type(e).__name__
        warnings.warn(f'the entry point "{point.name}" of {point.group} ({point.value}) is left out: {reason}',
                      stacklevel=2)  # fmt: skip
        return None
    return loaded if isinstance(loaded, ModuleType) else sys.modules[point.module]
