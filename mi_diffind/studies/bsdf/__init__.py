"""Study ``tradeoff bsdf``: learned BSDFs against their sources, in accuracy, time, bytes and noise.

Each material is fitted with a proxy times an indirection (``ours``), a proxy times one array (``table``), an
indirection alone (``paper``), one array alone (``plain``), and networks (:mod:`.networks`). Timed beside them are the
material itself, ``principled``, and ``measured`` with a file of the first. :mod:`.plan` describes them,
:mod:`.materials` lists the materials.
"""

from __future__ import annotations

import argparse

from ...measure.study import Plan, Study


class BSDFStudy(Study):
    """Accuracy of learned BSDFs against time and bytes."""

    name = "bsdf"
    title = "learned BSDFs of several materials"
    example = '"plastic, nonlinear"'

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("materials", nargs="*", metavar="MATERIAL", help="materials of the study (default: all)")

    def check(self, arguments) -> None:
        from .materials import MATERIALS

        for name in arguments.materials:
            if name not in MATERIALS:
                raise ValueError(f'found the material "{name}", allowed are {", ".join(map(repr, MATERIALS))}')

    def plan(self, arguments) -> Plan:
        from .plan import plan

        return plan(tuple(arguments.materials), arguments.quick)


STUDY = BSDFStudy()
