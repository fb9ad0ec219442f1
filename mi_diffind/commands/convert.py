"""``mi-diffind convert``: a scene with learned plugins in place of Mitsuba's."""

import dataclasses

from ..core.files import check_scene_file
from .common import learn_option, say, scene_options, set_variant, verb

HELP = "write a scene or model with learned materials and textures in place of Mitsuba's, fitted to what they show"

EXAMPLE = "mi-diffind convert scene.xml -o learned.xml"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "convert", run, HELP, EXAMPLE, reads=("scene",), writes=("output",))
    sub.add_argument("scene", metavar="SCENE.xml|MODEL.glb")
    sub.add_argument("-o", "--output", required=True, metavar="NEW.xml", help="scene file to write")
    sub.add_argument("--tables", metavar="DIR", help="folder of the table files (default: NEW_tables beside NEW.xml)")
    learn_option(sub, "material,bitmap")
    sub.add_argument(
        "--no-check",
        dest="check",
        action="store_false",
        help="do not render the scene before and after: 2 pictures of at most 128 pixels",
    )
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """Convert the scene, write it, and return the ``output``, the ``conversions``, the ``check`` and the bytes.

    Raises :class:`.UsageError`, and as :mod:`mi_diffind.scenes.conversion` does.
    """
    check_scene_file(arguments.scene)
    set_variant(arguments.variant)
    from ..scenes.conversion import convert

    conversions = convert(
        arguments.scene, arguments.output, learn=arguments.learn or None, tables=arguments.tables,
        defines=dict(arguments.defines), check=arguments.check,
    )  # fmt: skip
    say(conversions)
    say(f"scene       {arguments.output}")
    check = conversions.check and dataclasses.asdict(conversions.check)
    sizes = {name: getattr(conversions, name) for name in ("disk_bytes", "memory_bytes", "image_bytes")}
    return {"output": arguments.output, "conversions": [vars(c) for c in conversions], "check": check, **sizes}
