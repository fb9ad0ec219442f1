"""
The GGX distribution of normals: indirection at several sizes and in each storage form, single tables, networks and the
formula, trained until that has converged; and the rough conductor that is made of it. :mod:`.candidates` says more.
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
