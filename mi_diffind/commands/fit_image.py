"""``mi-diffind fit image``: compress an image, or the maps of a material, into a pair of arrays."""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path

from .. import sizing
from ..files import writable_file
from ..fitting import LOSSES, SCHEDULES, FittingError
from ..runtime import array_module
from ..tables import MAX_BYTES
from ..tasks.image import search, training
from ..tasks.image.source import NONFINITE, Source, load_source
from .common import UsageError, natural, positive, task


def add(tasks) -> None:
    """Add the task and its options to ``tasks``, the subparsers of the verb."""
    sub = task(tasks, "image", "compress an image or the maps of a material")
    sub.set_defaults(run=run)
    sub.add_argument("source", metavar="IMAGE|MATERIAL.json", help="an image, or a manifest of the maps of a material")
    sub.add_argument("-o", "--output", required=True, metavar="FILE.npz", help="file to write")
    size = sub.add_mutually_exclusive_group()
    for option, kind, about in (
        (
            "compression",
            sizing.parse_compression,
            "how many times smaller than the source, uncompressed (default: 12x)",
        ),
        ("bytes", sizing.parse_bytes, "size of the arrays, as in 256k or 1.5M"),
        ("bpp", sizing.parse_bpp, "bits a texel of the image, all channels together"),
        ("psnr", _decibels, "the smallest file of this quality (several trainings)"),
    ):
        size.add_argument(f"--{option}", type=_argument(kind), metavar="N", help=about)
    sub.add_argument(
        "--ratio-search", action="store_true", help="find sides, bits and dimensions of the arrays by short trainings"
    )
    sub.add_argument("--recipe", choices=list(training.RECIPES), default="ours", help="ours (default), or the paper's")
    sub.add_argument(
        "--without",
        action="append",
        default=[],
        choices=list(training.IMPROVEMENTS),
        help="switch one of the improvements of our recipe off; may be repeated",
    )
    sub.add_argument(
        "--structure",
        choices=["auto", *training.STRUCTURES],
        help="bits of an entry of the primary array, or of two (default: auto for ours, 8 bits for the paper's)",
    )
    sub.add_argument("--dims", type=positive, choices=range(1, 5), help="dimensions of the cascaded array")
    sub.add_argument("--cascaded", type=positive, metavar="N", help="entries along each side of the cascaded array")
    sub.add_argument(
        "--border",
        choices=["auto", "repeat", "clamp"],
        default="auto",
        help="does the image go on at its other side? (default: auto, along u and v each)",
    )
    sub.add_argument(
        "--nonfinite",
        choices=NONFINITE,
        default="error",
        help="NaN and infinity in the source: refuse (default), or replace by 0 and the largest value",
    )
    sub.add_argument("--backend", choices=["llvm", "cuda"], help="where to train (default: the GPU if there is one)")
    length = sub.add_mutually_exclusive_group()
    length.add_argument("--steps", type=positive, help="optimisation steps")
    length.add_argument("--seconds", type=positive, help="time of the training, in place of steps")
    for option, about, kind in (
        ("batch", "samples a step", {"type": positive}),
        ("lr", "Adam's learning rate", {"type": float}),
        ("loss", "what is minimised", {"choices": LOSSES}),
        ("schedule", "of the learning rate", {"choices": SCHEDULES}),
        ("seed", "seed of the random numbers", {"type": natural}),
    ):
        values = ", ".join(f"{getattr(r.settings, option)} for {n}" for n, r in training.RECIPES.items())
        sub.add_argument(f"--{option}", **kind, help=f"{about} (default: {values})")
    sub.add_argument("--all-cores", action="store_true", help="faster, but not the same bytes each time")
    sub.add_argument("--checkpoint", metavar="FILE", help="keep the state of the training in FILE")
    sub.add_argument("--resume", action="store_true", help="go on from --checkpoint, with the same settings and source")


def _argument(parse):
    """A parser of ours as a type of ``argparse``, which shows the message of its own exception only."""

    def parsed(text: str):
        try:
            parse(text)
        except ValueError as e:
            raise argparse.ArgumentTypeError(str(e)) from None
        return text

    return parsed


def _decibels(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 120:
        raise ValueError(f"{text!r} is no quality, allowed are numbers of dB between 0 and 120")
    return value


def run(arguments) -> dict:
    """
    Train and write the file. Returns its size, ratio, accuracy and how the training went; after Ctrl-C, of the best so
    far. Raises :class:`UsageError`, :class:`~mi_diffind.tasks.image.source.SourceError`,
    :class:`~mi_diffind.fitting.FittingError` and :class:`~mi_diffind.files.OutputError`.
    """
    output = Path(arguments.output)
    _check(arguments, output)
    writable_file(output)
    from ..tables import save_table

    source = load_source(arguments.source, nonfinite=arguments.nonfinite)
    recipe = _recipe(arguments)
    try:
        array_module(arguments.backend)  # says what is missing before anything else does
        table, result, tried, asked = _train(arguments, source, recipe)
    except RuntimeError as e:
        raise FittingError(str(e)) from e
    table.settings |= {"recipe": arguments.recipe, "source_path": _relative(arguments.source, output)}
    save_table(output, table)
    return _report(output, source, table, result, tried, asked)


def _check(arguments, output: Path) -> None:
    if output.suffix.lower() != ".npz":
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .npz')
    if arguments.checkpoint is not None and Path(arguments.checkpoint).resolve() == output.resolve():
        raise UsageError(f'"{output}" cannot be the output and the checkpoint')
    if arguments.checkpoint is not None and (arguments.ratio_search or arguments.psnr):
        raise UsageError(
            "--checkpoint keeps one training, --ratio-search and --psnr make several: give only one of them"
        )
    if arguments.resume and arguments.seconds:
        raise UsageError("--resume needs the --steps of the run that it goes on with: leave out --seconds")
    if arguments.ratio_search and (arguments.psnr or arguments.cascaded):
        raise UsageError("--ratio-search finds the sides of arrays of a given size: leave out --psnr and --cascaded")
    if arguments.psnr and arguments.cascaded:
        raise UsageError("--psnr chooses the sides of the arrays: leave out --cascaded")
    if arguments.recipe == "paper" and arguments.without:
        raise UsageError("--without switches off what the paper's recipe does not have: leave it out")


def _recipe(arguments) -> training.Recipe:
    recipe = training.without(training.RECIPES[arguments.recipe], arguments.without)
    given = {k: getattr(arguments, k) for k in ("structure", "dims") if getattr(arguments, k) is not None}
    recipe = dataclasses.replace(recipe, **given)
    if training.STRUCTURES.get(recipe.structure, (8, None))[1] and recipe.dims < 3:
        raise UsageError(f'--structure "{recipe.structure}" has two primary arrays and needs --dims 3 or 4')
    given = {k: getattr(arguments, k) for k in ("steps", "batch", "lr", "loss", "schedule", "seed")}
    given = {k: v for k, v in given.items() if v is not None}
    steps = given.get("steps", recipe.settings.steps)
    return training.replaced(recipe, deterministic=not arguments.all_cores, quality_every=max(1, steps // 10), **given)


def _train(arguments, source: Source, recipe: training.Recipe):
    """The table, the record of its training, what searches have tried, and the bytes that were asked for."""
    border = None if arguments.border == "auto" else (arguments.border,) * 2
    options = {"backend": arguments.backend, "border": border}
    timed = {**options, "seconds": arguments.seconds}
    tried = []
    if not training.layout_of(source, recipe).stored:  # of one colour: nothing to choose
        table, result = training.fit_image(source, None, recipe, **options)
        return table, result, tried, None
    asked = None
    if arguments.psnr is None:
        given = {"compression": arguments.compression, "nbytes": arguments.bytes, "bpp": arguments.bpp}
        if not any(given.values()):
            given["compression"] = 12
        try:
            asked = sizing.parse_size(source.nbytes, source.texels, **given)
        except ValueError as e:
            raise UsageError(str(e)) from None
    if arguments.ratio_search:
        found = search.ratio_search(source, asked, recipe, arguments.recipe != "paper", **options)
        tried, recipe, size = found.tried, found.recipe, found.size
        for t in tried:
            print(
                f"  tried {t['columns']} x {t['rows']} x {t['dims']} of {t['structure']} → {t['cascaded']}: "
                f"{t['psnr_db']:.2f} dB at texels, {t['psnr_between_db']:.2f} between"
            )
        if found.interrupted:
            return *found.best, tried, asked
    elif arguments.psnr is not None:
        return _train_for_quality(arguments, source, recipe, timed)
    elif arguments.cascaded:
        size = search.sized(source, asked, recipe, arguments.cascaded)
        if size.nbytes > MAX_BYTES:
            raise UsageError(
                f"--cascaded: found {arguments.cascaded}, which makes {size.nbytes:,} bytes of {size.dims} dimensions, "
                f"allowed are {MAX_BYTES:,}"
            )
    else:
        size = search.default_size(source, asked, recipe)
    table, result = training.fit_image(
        source, size, recipe, checkpoint=arguments.checkpoint, resume=arguments.resume, **timed
    )
    _, sentence = sizing.explain(size, source.nbytes, asked)
    if sentence:
        print(sentence)
    return table, result, tried, asked


def _train_for_quality(arguments, source: Source, recipe: training.Recipe, options):
    goal = float(arguments.psnr)
    table, result, tried = search.psnr_search(source, goal, recipe, **options)
    if table is None:
        best = max(tried, key=lambda t: t["psnr_db"])
        raise FittingError(
            f"{arguments.source}: {goal:g} dB were not reached; the best of {len(tried)} sizes had "
            f"{best['psnr_db']:.2f} dB in {best['bytes']:,} bytes: give more --steps or a lower --psnr"
        )
    return table, result, tried, None


def _relative(source: str, output: Path) -> str:
    """The path of the source as seen from the file's folder."""
    return os.path.relpath(Path(source).resolve(), output.resolve().parent)


def _report(output: Path, source: Source, table, result, tried: list, asked: float | None) -> dict:
    achieved = source.nbytes / table.nbytes if table.nbytes else None
    state = f"interrupted at step {result.steps}, kept" if result.interrupted else "best"
    ratio = f"{achieved:.2f}x" if achieved else "of one colour"
    wanted = f" ({source.nbytes / asked:.2f}x asked for)" if asked else ""
    print(f"{output}: {table.nbytes:,} bytes, {ratio}{wanted}; {state} step {result.step}")
    print("  " + ", ".join(f"{_words(k)} {v:.2f} dB" for k, v in table.quality.items()))
    return {
        "interrupted": result.interrupted,
        "output": str(output),
        "bytes": table.nbytes,
        "source_bytes": source.nbytes,
        "compression": achieved,
        "compression_asked": source.nbytes / asked if asked else None,
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: table.bits.get(name, 8) for name in table.arrays},
        "settings": table.settings,
        "quality": table.quality,
        "tried": tried,
        "step": result.step,
        "seconds": result.seconds,
        "restarts": result.restarts,
        "history": result.history,
    }


def _words(key: str) -> str:
    """``psnr_albedo_db`` → ``albedo``."""
    name = key.removeprefix("psnr_").removesuffix("_db")
    return {"psnr_db": "all channels", "psnr_mean_db": "mean of maps", "psnr_between_db": "between texels"}.get(
        key, name
    )
