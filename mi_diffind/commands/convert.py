"""``mi-diffind convert``: a scene with learned plugins in place of Mitsuba's."""

from __future__ import annotations

from pathlib import Path

from ..errors import UsageError
from ..files import writable_file
from .common import learn_option, require_scene, scene_options, set_variant, verb

HELP = "write a scene with learned plugins in place of Mitsuba's, fitted to what they show"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "convert", run, HELP)
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument("-o", "--output", required=True, metavar="NEW.xml", help="scene file to write")
    sub.add_argument("--tables", metavar="DIR", help="folder of the table files (default: NEW_tables beside NEW.xml)")
    learn_option(sub, "all of them")
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """Convert the scene, write it, and return the ``output`` and the ``conversions``.

    Raises :class:`~mi_diffind.errors.UsageError`, and as :mod:`mi_diffind.conversion` does.
    """
    require_scene(arguments.scene)
    output = Path(arguments.output)
    if output.suffix.lower() != ".xml":
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .xml')
    if output.resolve() == Path(arguments.scene).resolve():
        raise UsageError(f'output "{output}": is the scene itself')
    writable_file(output)
    set_variant(arguments.variant)
    from .. import conversion, scenes

    parsed = scenes.ParsedScene(arguments.scene, dict(arguments.defines))
    folder = Path(arguments.tables or output.with_name(f"{output.stem}_tables"))
    conversions = conversion.convert(parsed, arguments.learn or list(conversion.words()), folder)
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
    conversion.write_scene(parsed, output)
    print("\n".join([*conversion.summary(conversions), f"scene       {output}"]))
    return {"output": str(output), "conversions": [vars(c) for c in conversions]}
