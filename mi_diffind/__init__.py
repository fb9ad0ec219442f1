"""Learned lookup tables for Mitsuba 3, by differentiable indirection.

``import mi_diffind`` makes the plugins (``neural_disney``, ``disney``, ``neural_ggx``, ``neural_image``, …) known to
``mi.load_file``, ``mi.load_string`` and ``mi.load_dict`` in every variant, whichever of ``mitsuba`` and ``mi_diffind``
is imported first, and makes sure that Dr.Jit runs on an LLVM that does not abort (:mod:`mi_diffind.runtime`). It
imports neither of them itself: what is listed below is imported when it is asked for.
"""

import importlib as _importlib
from pathlib import Path as _Path

from . import runtime as _runtime
from .errors import DiffindError

__version__ = "0.2.0"

_here = _Path(__file__).resolve().parent
if not (_here / "plugins").is_dir():  # a checkout has the folder `plugins` beside this one, an installation inside
    __path__.append(str(_here.parent))

#: Public name → the module that holds it, and its name there if it is another one; "" if it is a module.
_NAMES = {
    # Training, table files
    "fit": "task",
    "open": "task:open_model",
    "save": "saving",
    "from_arrays": "maps.source",
    "example_maps": "studies.shading.materials",
    # Scenes
    "load_file": "scenes",
    "load_dict": "scenes",
    "load_string": "scenes",
    "attach": "scenes",
    "capture": "view_capture",
    "compare": "comparison",
    "convert": "conversion",
    "inspect": "inspection",
    "regress": "regression",
    "render": "rendering",
    "examples": "example_files",
    "fetch": "downloads",
    "view": "viewer",
    # Measurements
    "tradeoff": "tradeoffs",
    # Errors between images, and images as displayed
    "metrics": "",
    "srgb": "",
    # Building blocks of other networks
    "DifferentiableArray": "indirection",
    "Indirection": "indirection",
    "PagedArray": "pages",
    "fold": "indirection",
    "StoredArray": "tables",
    "Table": "tables",
    "TableError": "tables",
    "load_table": "tables",
    "save_table": "tables",
    "load_model": "task",
}

__all__ = ["DiffindError", "__version__", *_NAMES]


def __getattr__(name: str):
    if name not in _NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, other = _NAMES[name].partition(":")
    if not module:
        return _importlib.import_module(f".{name}", __name__)
    return getattr(_importlib.import_module(f".{module}", __name__), other or name)


def __dir__():
    return sorted({*globals(), *__all__})


_runtime.install(lambda: _importlib.import_module(".plugins", __name__).install())
