"""``mi-diffind view``: a scene or a table file in a browser, with learned plugins beside exact ones."""

import sys
from pathlib import Path

from ..core.files import check_scene_file
from .common import natural, positive, say, scene_options, set_variant, verb

HELP = "show a scene or a table file in a browser, learned plugins beside exact ones"

EXAMPLE = "mi-diffind view scene.xml"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "view", run, HELP, EXAMPLE, reads=("file",))
    sub.add_argument("file", metavar="SCENE.xml|MODEL.glb|FILE.npz")
    sub.add_argument("--host", default="127.0.0.1", help="address to serve the page at (default: 127.0.0.1)")
    sub.add_argument("--port", type=natural, default=8080, help="port of the page, 0: a free one (default: 8080)")
    sub.add_argument("--width", type=positive, default=320, metavar="N", help="of the picture, pixels (default: 320)")
    sub.add_argument("--against", default="exact", metavar="NAME", help="counterpart to compare with (default: exact)")
    sub.add_argument("--seconds", type=positive, help="end after so many seconds (default: at Ctrl-C)")
    scene_options(sub)


def run(arguments) -> dict:
    """Show the page until Ctrl-C, and return the figures of :func:`mi_diffind.view`.

    Raises :class:`.UsageError`, and as :mod:`mi_diffind.scenes.viewer` does.
    """
    if Path(arguments.file).suffix.lower() != ".npz":
        check_scene_file(arguments.file)
    set_variant(arguments.variant)
    from ..scenes.viewer import view

    names = ("host", "port", "width", "spp", "seed", "against", "seconds")
    given = {name: getattr(arguments, name) for name in names}
    return view(arguments.file, defines=dict(arguments.defines), announce=_announce, **given)


def _announce(text: str) -> None:
    """Print at once, also into a pipe."""
    say(text)
    sys.stdout.flush()
