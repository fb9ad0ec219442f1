"""``mi-diffind fetch``: data of the pages that do not ship, from where their makers publish them."""

from ..scenes.examples import DOWNLOADS
from .common import say, verb

HELP = "fetch data of the documentation that do not ship: materials and meshes"

EXAMPLE = "mi-diffind fetch boombox armadillo -o data"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "fetch", run, HELP, EXAMPLE)
    sub.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(DOWNLOADS)} (default: list them)")
    sub.add_argument("-o", "--output", default="data", metavar="FOLDER", help="folder to write to (default: data)")
    sub.add_argument("--from", dest="base", metavar="URL", help="address of a mirror: URL/NAME/FILE")


def run(arguments) -> dict:
    """Fetch the files, or list what there is, and return what is printed.

    Raises :class:`.UsageError` and as :mod:`mi_diffind.scenes.examples` does.
    """
    from ..scenes.examples import fetch

    if not arguments.names:
        for name, each in DOWNLOADS.items():
            say(f"{name:10} {each.size:>10,} bytes  {each.what} ({each.licence})")
        return {"available": {name: {"bytes": d.size, "licence": d.licence} for name, d in DOWNLOADS.items()}}
    fetched = fetch(arguments.names, arguments.output, arguments.base, progress=say)
    say(fetched)
    return fetched.figures
