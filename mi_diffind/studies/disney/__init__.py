"""Study ``tradeoff disney``: accuracy of the Disney BRDF against time.

Candidates are ``disney``, ``neural_disney`` with each preset and in each storage form, and Mitsuba's ``principled``,
with constant and with textured materials. :mod:`.plan` describes them.
"""

from __future__ import annotations

from ...measure.study import Plan, Study


class DisneyStudy(Study):
    """Accuracy of the Disney BRDF against time."""

    name = "disney"
    title = "all forms of the Disney BRDF"

    def plan(self, arguments) -> Plan:
        from .plan import plan

        return plan(arguments.quick)


STUDY = DisneyStudy()
