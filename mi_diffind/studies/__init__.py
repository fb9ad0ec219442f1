"""
What is measured by ``mi-diffind tradeoff``: each module here, and each that an entry point of the group
``mi_diffind.studies`` names, declares a study as its ``STUDY`` (:class:`mi_diffind.measure.study.Study`). A study makes
its candidates with the plugins, so this package lies above them; :mod:`.baselines` are what tables compete with.
"""

from __future__ import annotations

from ..found import find
from ..measure.study import Study


def studies() -> dict[str, Study]:
    """All studies by name, sorted."""
    found = [getattr(load(), "STUDY", None) for load in find(__name__, "mi_diffind.studies").values()]
    return {study.name: study for study in sorted(filter(None, found), key=lambda study: study.name)}
