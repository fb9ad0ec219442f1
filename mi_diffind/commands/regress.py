"""``mi-diffind regress``: a check that scenes still render like their stored references."""

from pathlib import Path

from ..core.errors import UsageError
from ..core.files import check_scene_file, writable_folder
from .common import natural, positive, say, scene_options, set_variant, verb

HELP = "check that scenes render as their stored references do"

EXAMPLE = "mi-diffind regress scene.xml --references references"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "regress", run, HELP, EXAMPLE, reads=("scenes",))
    sub.add_argument("scenes", nargs="+", metavar="SCENE.xml")
    sub.add_argument("--update", action="store_true", help="render the references again and store them")
    sub.add_argument(
        "--references", metavar="DIR", help='folder of the references (default: "references" by the scene)'
    )
    sub.add_argument(
        "--out", default="out", metavar="DIR", help="folder for the pictures of failed checks (default: out)"
    )
    sub.add_argument("--spp", type=positive, help="samples per pixel of a check, with --update")
    sub.add_argument("--seed", type=natural, help="seed of the random numbers (default: 0; --update: the reference's)")
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """Check each scene, or store its reference again.

    Returns the result of each in ``scenes`` and the number that ``failed``. Raises :class:`UsageError`, and as
    :mod:`mi_diffind.scenes.regression` does.
    """
    for path in arguments.scenes:
        check_scene_file(path)
    stems = [Path(path).stem for path in arguments.scenes]
    for stem in stems:
        if stems.count(stem) > 1:
            raise UsageError(f'{len(stems)} scenes, and more than one is called "{stem}": check them one at a time')
    set_variant(arguments.variant)
    from ..scenes import regression

    results, options = [], {"spp": arguments.spp, "seed": arguments.seed, "defines": dict(arguments.defines)}
    if not arguments.update:
        out = Path(arguments.out)
        writable_folder(out if out.exists() else out.parent)
        options["out"] = out
        for path in arguments.scenes:  # before the first is rendered
            regression.read_reference(path, arguments.references)
    try:
        for path in arguments.scenes:
            result = regression.regress(path, update=arguments.update, references=arguments.references, **options)
            results.append(result.figures)
            if arguments.update and str(result):
                say(result)
            if result.figures["interrupted"]:
                break
    finally:
        if results and not arguments.update:
            say("\n".join(regression.summary(results)))
    return {
        "interrupted": results[-1]["interrupted"],
        "failed": sum(r.get("passed") is False for r in results),
        "scenes": results,
    }
