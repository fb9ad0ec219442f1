"""Study ``tradeoff ggx``: accuracy of the GGX distribution of normals against time and bytes.

Candidates are indirection at several sizes and in each storage form, single tables, networks and the formula, all
trained to convergence, and the rough conductor that uses the distribution. :mod:`.plan` describes them.
"""

from __future__ import annotations

from ...measure.study import Plan, Study


class GGXStudy(Study):
    """Accuracy of the GGX distribution against time and bytes."""

    name = "ggx"
    title = "all forms of the GGX distribution"

    def plan(self, arguments) -> Plan:
        from .plan import plan

        return plan(arguments.quick)


STUDY = GGXStudy()
