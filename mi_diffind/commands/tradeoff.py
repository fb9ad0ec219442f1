"""``mi-diffind tradeoff``: time against accuracy of the contenders of a task."""

from ..studies import run as run_study
from ..studies import studies
from .common import alternative, alternatives, say, set_variant, variant_option, verb

HELP = "measure time against accuracy of the contenders of a task"

#: Arguments of studies that are files, as far as a study has them.
READS = ("source", "scenes", "materials", "measured")

EXAMPLE = "mi-diffind tradeoff ggx --quick --out out"


def add(commands) -> None:
    """Add the verb to ``commands``, the subparsers of the command line.

    Studies that are not in its ``words``, those of the command line, are only named; without ``words``, all are added.
    """
    asked = getattr(commands, "words", studies())
    parsers = alternatives(verb(commands, "tradeoff", run, HELP, EXAMPLE, reads=READS), "study")
    for name in studies():
        title = f"measure time against accuracy of {studies().title(name)}"
        if name not in asked:
            parsers.add_parser(name, help=title)
            continue
        study = studies()[name]
        words = " ".join(filter(None, ("mi-diffind tradeoff", name, study.example, "--quick --out out")))
        sub = alternative(parsers, name, title, words)
        sub.add_argument("--out", default="out", metavar="DIR", help="folder for table and plot (default: out)")
        sub.add_argument("--quick", action="store_true", help="smoke run: less of everything, times not to be quoted")
        variant_option(sub)
        study.add_arguments(sub)


def run(arguments) -> dict:
    """Measure, write table and plot, and return the result with its ``files``; after Ctrl-C, the part that is done.

    Raises as :func:`mi_diffind.tradeoff` does.
    """
    result = run_study(studies()[arguments.study], arguments, lambda: set_variant(arguments.variant))
    say(result)
    return result.figures
