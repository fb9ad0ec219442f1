"""``mi-diffind examples``: the example scenes, for an installation without a checkout."""

from .common import say, verb

HELP = "copy the example scenes, and what they read, to a folder"

EXAMPLE = "mi-diffind examples scenes && mi-diffind compare scenes/materials.xml"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "examples", run, HELP, EXAMPLE)
    sub.add_argument("folder", metavar="FOLDER", help="folder to copy to; files that differ are never replaced")


def run(arguments) -> dict:
    """Copy the scenes and return what is printed.

    Raises :class:`.UsageError` and :class:`.OutputError`.
    """
    from ..scenes.examples import examples

    written = examples(arguments.folder)
    say(written)
    for path in written.figures["scenes"]:
        say(path)
    return written.figures
