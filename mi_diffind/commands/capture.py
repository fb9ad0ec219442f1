"""``mi-diffind capture``: views of a scene or of 3D Gaussians from all sides with their poses, for a radiance field."""

from pathlib import Path

from ..core.arguments import WORKER_ARGUMENTS, add_arguments
from ..core.files import check_scene_file, writable_folder
from .common import natural, positive, say, scene_options, set_variant, verb

HELP = "render views of a scene, or of 3D Gaussians, from all sides, with their poses"

EXAMPLE = "mi-diffind capture scene.xml -o views --objects statue --views 60"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "capture", run, HELP, EXAMPLE, reads=("scene",))
    sub.add_argument("scene", metavar="SCENE.xml", help="scene file, or 3D Gaussians: SPLATS.ply")
    sub.add_argument(
        "-o", "--output", required=True, metavar="FOLDER", help="folder of the views; an unfinished one is completed"
    )
    sub.add_argument("--views", type=positive, default=60, help="views for training (default: 60)")
    sub.add_argument("--test", type=natural, default=20, help="test views between them (default: 20)")
    sub.add_argument("--resolution", type=positive, default=160, metavar="N", help="side in pixels (default: 160)")
    sub.add_argument(
        "--path", choices=["sphere", "orbit"], default="sphere", help="path of the cameras (default: sphere)"
    )
    sub.add_argument(
        "--elevation", type=float, nargs=2, metavar=("LOW", "HIGH"),
        help="degrees above the horizon (default: -90 90 for a sphere, 20 20 for an orbit, which swings between both)",
    )  # fmt: skip
    sub.add_argument(
        "--radius", type=float, metavar="R", help="distance of the cameras (default: the whole box is visible)"
    )
    sub.add_argument(
        "--centre", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="point that the cameras face (default: the middle of the box)",
    )  # fmt: skip
    sub.add_argument(
        "--up", type=float, nargs=3, metavar=("X", "Y", "Z"), default=(0, 1, 0),
        help="upward direction (default: 0 1 0)",
    )  # fmt: skip
    sub.add_argument("--fov", type=float, default=40.0, help="field of view in degrees (default: 40)")
    sub.add_argument(
        "--objects", nargs="+", metavar="ID", default=(),
        help="shapes to capture (default: all but lights); the others only cast light and shadow",
    )  # fmt: skip
    sub.add_argument(
        "--box", type=float, nargs=6, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"),
        help="of 3D Gaussians, those inside, lower corner first (default: all but strays)",
    )  # fmt: skip
    sub.add_argument("--format", choices=["png", "exr"], default="png", help="8 bits, or linear (default: png)")
    add_arguments(sub, WORKER_ARGUMENTS)
    scene_options(sub, rendering=False)
    sub.add_argument("--spp", type=positive, help="samples per pixel (default: 256; of 3D Gaussians: 4)")
    sub.add_argument("--seed", type=natural, default=0, help="seed of the random numbers (default: 0)")


def run(arguments) -> dict:
    """Render the views that are missing and return what is printed.

    After Ctrl-C, the result lists the views that exist. Raises :class:`UsageError`, and as
    :mod:`mi_diffind.scenes.capture` does.
    """
    check_scene_file(arguments.scene)
    writable_folder(Path(arguments.output).parent)
    set_variant(arguments.variant)
    from ..scenes.capture import capture

    names = ("views", "test", "resolution", "spp", "fov", "radius", "path", "seed", "format", "workers", "scheduler")
    given = {name: getattr(arguments, name) for name in (*names, "centre", "elevation", "up", "objects", "box")}
    captured = capture(arguments.scene, arguments.output, defines=dict(arguments.defines), **given)
    say(captured)
    return {"scene": arguments.scene, **captured.figures}
