"""Studies of ``mi-diffind tradeoff``: each compares candidates by accuracy, bytes and time.

Each module here, and each that an entry point of the group ``mi_diffind.studies`` names, declares a study as its
``STUDY`` (:class:`mi_diffind.measure.study.Study`). Studies load plugins, so this package lies above them.
:mod:`.baselines` are the methods that tables compete with, :mod:`.equal_memory` the contenders of comparisons in equal
bytes, :mod:`.maps` the shared parts of studies of maps.
"""

from __future__ import annotations

import functools

from ..core import discovery
from ..measure.study import Study


@functools.lru_cache
def studies() -> dict[str, Study]:
    """Return all studies by name: those of this package, then those of entry points."""
    return discovery.load(__name__, "STUDY", ignored=("baselines", "equal_memory", "maps"), expected=Study)
