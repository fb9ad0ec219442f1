"""``mi-diffind tradeoff``: time against accuracy, of all forms of a task or of a scene."""

from __future__ import annotations

import argparse
import importlib

from ..files import writable_folder
from ..tradeoffs import TASKS
from .common import (
    UsageError,
    defines_of,
    natural,
    positive,
    require_scene,
    scene_options,
    set_variant,
    variant_option,
    verb,
)
from .common import (
    alternative as task,
)
from .common import (
    alternatives as tasks_of,
)

HELP = "measure time against accuracy, of all forms of a task or of a scene"


def add(commands) -> None:
    """Add the verb, its tasks and their options to ``commands``, the subparsers of the command line."""
    tasks = tasks_of(verb(commands, "tradeoff", run, HELP), "task")
    for name, about in TASKS.items():
        sub = task(tasks, name, f"measure time against accuracy of {about}")
        _add_common(sub)
        variant_option(sub)
    sub = task(tasks, "image", "measure bytes, training and time against quality of a compressed image or material")
    sub.add_argument("source", metavar="IMAGE|MATERIAL.json")
    sub.add_argument("--compression", action="append", default=[], metavar="N", help="12x (default); may be repeated")
    for option, about, kind in (
        ("--seconds", "of each training by our recipe (default: 60; --quick: 2)", positive),
        ("--paper-seconds", "of each by the paper's recipe (default: the longest of --seconds)", positive),
        ("--dims", "dimensions of the cascaded array, 2, 3 or 4 (default: all)", positive),
    ):
        choices = (2, 3, 4) if option == "--dims" else None
        sub.add_argument(
            option,
            action="append",
            default=[],
            type=kind,
            choices=choices,
            metavar="N",
            help=f"{about}; may be repeated",
        )
    sub.add_argument(
        "--astc",
        choices=("fastest", "fast", "medium", "thorough", "verythorough", "exhaustive"),
        default="exhaustive",
        help="preset of the ASTC encoder (default: exhaustive; faster ones are up to several dB worse)",
    )
    sub.add_argument("--ablation", action="store_true", help="also switch off each improvement of our recipe")
    _add_common(sub)
    variant_option(sub)
    sub = task(tasks, "scene", "measure time against accuracy of a scene, learned and exact, at several sample counts")
    sub.add_argument("scene", metavar="SCENE.xml")
    _add_common(sub)
    scene_options(sub, rendering=False)
    sub.add_argument("--spp", type=positive, help="most samples per pixel (default: the scene's; --quick: at most 4)")
    sub.add_argument("--seed", type=natural, default=0, help="seed of the random numbers (default: 0)")


def _add_common(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--out", default="out", metavar="DIR", help="folder for table and plot (default: out)")
    sub.add_argument("--quick", action="store_true", help="smoke run: less of everything, times not to be quoted")


def run(arguments) -> dict:
    """
    Measure and write table and plot. Returns the result with its ``files``; after Ctrl-C, what there is up to then.
    Raises :class:`UsageError`, :class:`~mi_diffind.files.OutputError`,
    :class:`~mi_diffind.tasks.image.source.SourceError` and :class:`~mi_diffind.scenes.SceneError`.
    """
    if arguments.task == "scene":
        require_scene(arguments.scene)
    if arguments.task == "image":
        from ..tasks.image.source import load_source

        source = load_source(arguments.source)
    writable_folder(arguments.out, create=True)
    set_variant(arguments.variant)
    import mitsuba as mi

    from .. import plugins

    if not plugins.supported(mi.variant()):
        usable = ", ".join(v for v in mi.variants() if plugins.supported(v))
        raise UsageError(f'the plugins do not run in the variant "{mi.variant()}"; use one of {usable}')
    if arguments.task == "image":
        return _image(arguments, source)
    return _scene(arguments) if arguments.task == "scene" else _study(arguments)


def _image(arguments, source) -> dict:
    from .. import report
    from ..tradeoffs import image

    try:
        settings = image.request(
            arguments.compression, arguments.seconds, arguments.paper_seconds, arguments.dims, arguments.astc,
            arguments.ablation,
            arguments.quick,
        )  # fmt: skip
    except ValueError as e:
        raise UsageError(str(e)) from None
    result = image.measure(source, arguments.source, settings, arguments.out)
    paths = image.write(result, arguments.out)
    print("\n".join(image.summary(result)))
    print("\nwritten     " + ", ".join(paths.values()))
    return {**report.finite(result), "files": paths}


def _study(arguments) -> dict:
    import mitsuba as mi

    from .. import report, tradeoff

    study = importlib.import_module(f"..tradeoffs.{arguments.task}", __package__).study(arguments.quick)
    result = tradeoff.measure(study, tradeoff.Settings.choose(mi.variant(), arguments.quick), arguments.out)
    paths = report.write(result, arguments.out)
    print("\n".join(report.summary(result)))
    print("\nwritten     " + ", ".join(paths.values()))
    return {**report.finite(result), "files": paths}


def _scene(arguments) -> dict:
    from .. import budget

    settings = budget.Settings.choose(arguments.quick, arguments.spp)
    result = budget.measure(arguments.scene, settings, arguments.out, arguments.seed, defines_of(arguments))
    paths = budget.write(result, arguments.out)
    print("\n".join(budget.summary(result)))
    print("\nwritten     " + ", ".join(paths.values()))
    return {**result, "files": paths}
