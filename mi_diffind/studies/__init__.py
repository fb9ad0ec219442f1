"""
What is measured by ``mi-diffind tradeoff``: each module here, and each that an entry point of the group
``mi_diffind.studies`` names, declares a study as its ``STUDY`` (:class:`mi_diffind.measure.study.Study`). A study makes
its candidates with the plugins, so this package lies above them; :mod:`.baselines` are what tables compete with,
:mod:`.equal_memory` what studies of several kinds in equal bytes share.
"""

from __future__ import annotations

import functools

from .. import discovery
from ..measure.study import Study


@functools.lru_cache
def studies() -> dict[str, Study]:
    """All studies by name: those of this package, then those that entry points add."""
    return discovery.load(__name__, "STUDY", ignored=("baselines", "equal_memory"), expected=Study)
