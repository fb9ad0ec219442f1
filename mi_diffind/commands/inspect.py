"""``mi-diffind inspect``: the content of a table file, or the plugins of this package in a scene."""

from pathlib import Path

from ..core.files import check_scene_file
from .common import say, scene_options, set_variant, verb

HELP = "describe a table file, or the plugins of this package in a scene"

EXAMPLE = "mi-diffind inspect material.npz --measure"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "inspect", run, HELP, EXAMPLE, reads=("file",))
    sub.add_argument("file", metavar="FILE.npz|SCENE.xml")
    sub.add_argument("--measure", action="store_true", help="measure the accuracy of tables in each storage form")
    sub.add_argument(
        "--verbose", action="store_true", help="also print arrays, settings of the training and counts of operations"
    )
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """Print the description of the file and return its figures (:func:`mi_diffind.scenes.inspection.inspect`)."""
    if Path(arguments.file).suffix.lower() == ".xml":
        check_scene_file(arguments.file)
    set_variant(arguments.variant)
    from ..scenes.inspection import inspect

    inspection = inspect(arguments.file, arguments.measure, defines=dict(arguments.defines))
    say("\n".join(inspection.lines(arguments.verbose)))
    return inspection.figures
