"""The study ``mi-diffind tradeoff profile``, as it declares itself. Light to import."""

from __future__ import annotations

from pathlib import Path

from mi_diffind.core.errors import UsageError
from mi_diffind.measure.study import Plan, Study

DOWNLIGHT = Path(__file__).resolve().parent / "data" / "downlight.csv"


class ProfileStudy(Study):
    """Accuracy of a profile against time and bytes."""

    name = "profile"
    title = "all forms of a goniometric profile"

    def add_arguments(self, parser) -> None:
        parser.add_argument("--source", default=str(DOWNLIGHT), metavar="PROFILE.csv", help="what is learned")

    def check(self, arguments) -> None:
        if not Path(arguments.source).is_file():
            raise UsageError(f"{arguments.source}: no such file")

    def plan(self, arguments) -> Plan:
        from .candidates import plan

        return plan(arguments.source, arguments.quick)


STUDY = ProfileStudy()
