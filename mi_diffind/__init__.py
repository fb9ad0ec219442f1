"""
Learned lookup tables that a renderer trusts: differentiable indirection for Mitsuba 3.

``import mi_diffind`` makes the plugins (``neural_disney``, ``disney``, ``neural_ggx``, ``neural_image``) available to
``mi.load_file``, ``mi.load_string`` and ``mi.load_dict`` in every variant, whichever of ``mitsuba`` and ``mi_diffind``
is imported first, and makes sure that Dr.Jit runs on an LLVM that does not abort (:mod:`mi_diffind.runtime`).
"""

from pathlib import Path as _Path

from . import runtime as _runtime

_here = _Path(__file__).resolve().parent
if not (_here / "plugins").is_dir():  # a checkout has the folder `plugins` beside this one, an installation inside
    __path__.append(str(_here.parent))

_runtime.select_llvm()  # before Dr.Jit starts

from . import plugins as _plugins  # noqa: E402
from .indirection import DifferentiableArray, Indirection, fold  # noqa: E402
from .tables import TableError, load_table, save_table  # noqa: E402

_plugins.install()

__version__ = "0.1.0"

__all__ = [
    "DifferentiableArray",
    "Indirection",
    "TableError",
    "__version__",
    "fold",
    "load_table",
    "save_table",
]
