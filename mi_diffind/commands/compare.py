"""``mi-diffind compare``: a scene as written beside the same scene with other plugins, by default exact ones."""

from ..core.files import check_scene_file, writable_folder
from .common import learn_option, positive, say, scene_options, set_variant, verb

HELP = "render a scene as written and with exact plugins, and show the difference"

EXAMPLE = "mi-diffind compare scene.xml --spp 64 --out out"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "compare", run, HELP, EXAMPLE, reads=("scene",))
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument("--out", default="out", metavar="DIR", help="folder for pictures (default: out)")
    sub.add_argument(
        "--passes", type=positive, default=5, help="passes to split the samples into, at least 2 (default: 5)"
    )
    sub.add_argument(
        "--against",
        metavar="NAME",
        help="compare with one counterpart: exact, or another one, such as Mitsuba's principled (default: those that "
        "the plugins declare as truths: exact, for filtered textures mipmap, too)",
    )
    sub.add_argument(
        "--equal-time",
        action="store_true",
        help="compare at equal time instead of equal samples: --spp is that of a pass of the exact scene; errors are "
        "against a render of many samples, noise and bias apart",
    )
    learn_option(sub, "none")
    scene_options(sub)


def run(arguments) -> dict:
    """Render the scene twice or more, write the pictures, and return the figures and the ``files``.

    ``further`` are the figures against further truths.

    Raises :class:`.UsageError`, and as :mod:`mi_diffind.scenes.comparison` does.
    """
    check_scene_file(arguments.scene)
    writable_folder(arguments.out, create=True)
    set_variant(arguments.variant)
    from ..scenes import comparison, equal_time

    given = {name: getattr(arguments, name) for name in ("spp", "seed", "passes", "against", "learn")}
    if arguments.equal_time:
        result = equal_time.compare_at_equal_time(arguments.scene, defines=dict(arguments.defines), **given)
        paths = result.save(arguments.out)
        say(result)
        say(f"picture     {paths['figure']}")
        return {**result.figures, "files": paths}
    result = comparison.compare(arguments.scene, defines=dict(arguments.defines), **given)
    paths = result.save(arguments.out)
    say(result)
    say(f"picture     {paths['figure']}")
    return {**result.figures, "further": [one.figures for one in result.further], "files": paths}
