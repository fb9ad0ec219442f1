"""Study ``tradeoff disney``: accuracy of the Disney BRDF against time.

Candidates are ``disney``, ``neural_disney`` with each preset and in each storage form, networks of as many bytes, and
Mitsuba's ``principled``, with constant and with textured materials. :mod:`.plan` describes them.
"""

from __future__ import annotations

import argparse

from ...measure.study import Plan, Study

#: Representations of the candidates.
REPRESENTATIONS = ("Mitsuba", "formulas", "arithmetic", "tables", "paper", "one table", "network")


class DisneyStudy(Study):
    """Accuracy of the Disney BRDF against time."""

    name = "disney"
    title = "all forms of the Disney BRDF"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--only", action="append", default=[], choices=REPRESENTATIONS, metavar="REPRESENTATION",
            help=f"measure only one representation ({', '.join(REPRESENTATIONS)}); may be repeated",
        )  # fmt: skip

    def plan(self, arguments) -> Plan:
        from .plan import plan

        return plan(arguments.quick, arguments.only)


STUDY = DisneyStudy()
