"""
Studies of ``mi-diffind tradeoff``: comparisons of accuracy, time and memory.

Each module here, and each that an entry point of the group ``mi_diffind.studies`` names, declares a study as its
``STUDY`` (:class:`mi_diffind.measure.study.Study`). Studies use the plugins, so this package lies above them;
:mod:`.baselines` are other methods that tables are compared with, :mod:`.equal_memory` compares methods in equal bytes.
"""

from __future__ import annotations

import functools

from .. import discovery
from ..measure.study import Study


@functools.lru_cache
def studies() -> dict[str, Study]:
    """Return all studies by name: those of this package, then those that entry points add."""
    return discovery.load(__name__, "STUDY", ignored=("baselines", "equal_memory"), expected=Study)
