"""``mi-diffind render``: an image or an orbit of a scene that names learned plugins."""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path

from ..arguments import proper_fraction
from ..files import writable_file
from ..interrupt import interruptible
from .common import UsageError, learn_option, positive, require_scene, scene_options, set_variant, verb

HELP = "render a scene that names learned plugins"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "render", run, HELP)
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument(
        "-o", "--output", metavar="FILE",
        help="image, .exr or .png, or with --orbit a film, .webp or .gif (default: SCENE.exr)",
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
    """Render the scene and write the image.

    Returns what is printed, the learned plugins of the scene and the times; after Ctrl-C, of the passes that are done.
    Raises :class:`UsageError`, and as :mod:`mi_diffind.scenes` does.
    """
    from tqdm import tqdm

    require_scene(arguments.scene)
    output = Path(arguments.output or Path(arguments.scene).with_suffix(".exr").name)
    films = (".webp", ".gif") if arguments.orbit else ()
    if output.suffix.lower() not in (".exr", ".png", *films):
        allowed = " and ".join((".exr", ".png")) if not films else ", ".join((".exr", ".png", *films))
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are {allowed}')
    if arguments.centre is not None and not arguments.orbit:
        raise UsageError("--centre needs --orbit")
    if arguments.depth_tolerance is not None and arguments.depth != "auto":
        raise UsageError("--depth-tolerance needs --depth auto")
    writable_file(output)
    set_variant(arguments.variant)
    import mitsuba as mi

    from .. import conversion, scenes

    parsed = scenes.ParsedScene(arguments.scene, dict(arguments.defines))
    conversions = conversion.convert(parsed, arguments.learn) if arguments.learn else []
    for line in conversion.summary(conversions):
        print(line, flush=True)
    depth = _choose_depth(arguments, parsed)
    start = time.perf_counter()
    learned = parsed.learned_plugins()
    changed = depth["chosen"] != depth["scene"]
    scene = parsed.load(longest_path=depth["chosen"] if changed else None)
    loaded = time.perf_counter()
    spp = arguments.spp or scene.sensors()[0].sampler().sample_count()
    if arguments.orbit:
        return _orbit(arguments, output, scene, spp)
    passes = max(1, spp // 16)
    with interruptible() as stop, tqdm(total=passes, desc="render", unit="pass", disable=None) as bar:
        image, seconds = scenes.render(scene, spp, arguments.seed, passes, bar.update, stop)
    rendered = time.perf_counter()
    scenes.write_image(output, image)
    done = len(seconds) * spp // passes
    kept = f"interrupted, kept {done} of {spp}" if done < spp else f"{spp}"
    size = f"{image.shape[1]} x {image.shape[0]}"
    print(f"{output}: {size}, {kept} spp, {rendered - loaded:.1f} s in {mi.variant()}")
    return {
        "interrupted": done < spp,
        "scene": arguments.scene,
        "output": str(output),
        "variant": mi.variant(),
        "width": image.shape[1],
        "height": image.shape[0],
        "spp": done,
        "seed": arguments.seed,
        "depth": depth,
        "seconds_load": loaded - start,
        "seconds_render": rendered - loaded,
        "learned_plugins": learned,
        "conversions": [vars(c) for c in conversions],
        "reports": scenes.reports(scene) if arguments.json is not None else [],
        "table_bytes": parsed.table_bytes(learned),
    }


def _orbit(arguments, output: Path, scene, spp: int) -> dict:
    """Render and write the frames of an orbit; after Ctrl-C, those that are done."""
    import mitsuba as mi
    from tqdm import tqdm

    from .. import orbit

    start = time.perf_counter()
    with interruptible() as stop, tqdm(total=arguments.orbit, desc="orbit", unit="frame", disable=None) as bar:
        frames = orbit.orbit(
            scene, arguments.orbit, arguments.centre, spp=spp, seed=arguments.seed, on_frame=bar.update, stop=stop
        )
    seconds = time.perf_counter() - start
    orbit.write(output, frames)
    height, width = frames[0].shape[:2]
    kept = f"interrupted, kept {len(frames)} of {arguments.orbit}" if len(frames) < arguments.orbit else len(frames)
    print(f"{output}: {kept} frames of {width} x {height}, {spp} spp, {seconds:.1f} s in {mi.variant()}")
    return {
        "interrupted": len(frames) < arguments.orbit,
        "scene": arguments.scene,
        "output": str(output),
        "variant": mi.variant(),
        "width": width,
        "height": height,
        "spp": spp,
        "seed": arguments.seed,
        "frames": len(frames),
        "seconds_render": seconds,
    }


def _choose_depth(arguments, parsed) -> dict:
    """Choose the depth to render to and say why; what was not measured is None."""
    from .. import depth, scenes

    if arguments.depth == "auto":
        tolerance = arguments.depth_tolerance or depth.TOLERANCE
        probe = depth.auto_depth(parsed, tolerance, arguments.seed)
        print("\n".join(depth.summary(probe)))
        return {"requested": "auto", **probe}
    scene_depth = None
    with contextlib.suppress(scenes.SceneError):  # no integrator with a depth: fine, unless one is asked for
        scene_depth = parsed.path_integrator()[1]
    chosen = scene_depth if arguments.depth == "scene" else arguments.depth
    unknown = ("tolerance", "shares", "left_out", "left_out_in_a_tile", "probe_seconds")
    return {"requested": arguments.depth, "chosen": chosen, "scene": scene_depth, **dict.fromkeys(unknown)}


def _depth(text: str) -> int | str:
    if text in ("auto", "scene"):
        return text
    try:
        return positive(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"found {text}, allowed are auto, scene and whole numbers ≥ 1") from None
