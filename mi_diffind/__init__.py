"""Differentiable indirection (Datta et al. 2023) as Mitsuba 3 plugins: learned lookup tables.

``import mi_diffind`` makes the plugins (``neural_disney``, ``disney``, ``neural_ggx``, ``neural_image``, …) known to
``mi.load_file``, ``mi.load_string`` and ``mi.load_dict`` in every variant, whichever of ``mitsuba`` and ``mi_diffind``
is imported first, and makes sure that Dr.Jit runs on an LLVM that does not abort (:mod:`mi_diffind.core.runtime`). It
imports neither of them itself; each name below is imported when it is asked for.
"""

import importlib as _importlib
from pathlib import Path as _Path

from .core import runtime as _runtime
from .core.errors import DiffindError

__version__ = "0.2.0"

_here = _Path(__file__).resolve().parent
if not (_here / "plugins").is_dir():  # a checkout has the folder `plugins` beside this one, an installation inside
    __path__.append(str(_here.parent))

#: Public name → the module that holds it, and its name there if it is another one; ":" ends the name of a module.
_NAMES = {
    # Training, table files
    "fit": "fitting.task",
    "open": "fitting.task:open_model",
    "save": "scenes.conversion",
    "from_arrays": "maps.source",
    "load_source": "maps.source",
    "example_maps": "studies.example_maps",
    # Scenes
    "load_file": "scenes.loading",
    "load_dict": "scenes.loading",
    "load_string": "scenes.loading",
    "attach": "scenes.loading",
    "capture": "scenes.capture",
    "compare": "scenes.comparison",
    "compare_at_equal_time": "scenes.equal_time",
    "convert": "scenes.conversion",
    "inspect": "scenes.inspection",
    "regress": "scenes.regression",
    "render": "scenes.rendering",
    "examples": "scenes.examples",
    "fetch": "scenes.examples",
    "view": "scenes.viewer",
    # Measurements
    "tradeoff": "studies",
    # Errors between images, and images as displayed
    "metrics": "images.metrics:",
    "srgb": "images.srgb:",
    # Building blocks of other networks
    "DifferentiableArray": "arrays.indirection",
    "Indirection": "arrays.indirection",
    "PagedArray": "arrays.pages",
    "fold": "arrays.indirection",
    "StoredArray": "arrays.tables",
    "Table": "arrays.tables",
    "TableError": "arrays.tables",
    "load_table": "arrays.tables",
    "save_table": "arrays.tables",
    "load_model": "fitting.task",
}

__all__ = ["DiffindError", "__version__", *_NAMES]


def __getattr__(name: str):
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, colon, other = _NAMES[name].partition(":")
    module = _importlib.import_module(f".{module}", __name__)
    return module if colon and not other else getattr(module, other or name)


def __dir__():
    return sorted({*globals(), *__all__})


_runtime.install(lambda: _importlib.import_module(".plugins", __name__).install())
