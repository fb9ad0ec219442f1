"""``mi-diffind render``: an image or an orbit of a scene that names learned plugins."""

import argparse
from pathlib import Path

from ..core.arguments import proper_fraction
from ..core.files import check_scene_file, writable_file
from .common import learn_option, positive, say, scene_options, set_variant, verb

HELP = "render a scene that names learned plugins, or a glTF model"

EXAMPLE = "mi-diffind render scene.xml -o image.png --spp 64"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "render", run, HELP, EXAMPLE, reads=("scene",), writes=("output",))
    sub.add_argument("scene", metavar="SCENE.xml|MODEL.glb")
    sub.add_argument(
        "-o", "--output", metavar="FILE",
        help="image, .exr or .png, or with --orbit a film, .mp4, .webp or .gif (default: SCENE.exr)",
    )  # fmt: skip
    sub.add_argument(
        "--orbit",
        type=positive,
        metavar="N",
        help="N frames of a camera that goes once around the scene: as a film, or side by side in an image",
    )
    sub.add_argument(
        "--centre", type=float, nargs=3, metavar=("X", "Y", "Z"),
        help="what --orbit goes around, about the vertical y (default: the middle of all that is no light)",
    )  # fmt: skip
    sub.add_argument(
        "--depth",
        type=_depth,
        default="scene",
        metavar="auto|N|scene",
        help="longest path, counted as max_depth: the scene's (default), N, or measured: where a probe finds the rest "
        "below a tolerance",
    )
    sub.add_argument(
        "--depth-tolerance",
        type=proper_fraction,
        metavar="T",
        help="part of the scattered light that --depth auto may leave out (default: 0.005)",
    )
    learn_option(sub, "none")
    scene_options(sub)


def run(arguments) -> dict:
    """Render the scene, write the image, and return the figures of :func:`mi_diffind.scenes.rendering.render`.

    Raises :class:`.UsageError`, and as :mod:`mi_diffind.scenes.loading` does.
    """
    check_scene_file(arguments.scene)
    output = Path(arguments.output or Path(arguments.scene).with_suffix(".exr").name)
    writable_file(output)
    set_variant(arguments.variant)
    from ..scenes import conversion, depth, loading
    from ..scenes.rendering import render

    names = ("spp", "seed", "depth", "depth_tolerance", "orbit", "centre", "learn")
    given = {name: getattr(arguments, name) for name in names}
    rendering = render(arguments.scene, defines=dict(arguments.defines), output=output, **given)
    figures = rendering.figures
    say("\n".join(conversion.summary(figures["conversions"])))
    if arguments.depth == "auto":
        say("\n".join(depth.summary(figures["depth"])))
    rendering.save(output)
    size = f"{figures['width']} x {figures['height']}"
    time = f"{figures['seconds_render']:.1f} s in {figures['variant']}"
    if arguments.orbit:
        count, wanted = figures["frames"], figures["frames_requested"]
        kept = f"interrupted, kept {count} of {wanted}" if figures["interrupted"] else count
        samples = loading.samples_text({**figures, "interrupted": False})
        say(f"{output}: {kept} frames of {size}, {samples}, {time}")
        if output.suffix.lower() == ".mp4" and (figures["width"] % 2 or figures["height"] % 2):
            say("H.264 needs an even width and height: the last column or row is there twice")
    else:
        say(f"{output}: {size}, {loading.samples_text(figures)}, {time}")
    reports = loading.reports(rendering.scene) if arguments.json is not None and not arguments.orbit else []
    return {**figures, "output": str(output), "reports": reports}


def _depth(text: str) -> int | str:
    if text in ("auto", "scene"):
        return text
    try:
        return positive(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"found {text}, allowed are auto, scene and whole numbers ≥ 1") from None
