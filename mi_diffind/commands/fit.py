"""``mi-diffind fit``: train the tables of a task."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..files import writable_file
from ..fitting import SCHEDULES, FitSettings, FittingError
from ..lookup import STORAGES
from ..tasks import ggx
from ..tasks.disney import training as disney
from . import fit_image
from .common import UsageError, natural, positive, task, tasks_of, verb


def add(commands) -> None:
    """Add the verb, its tasks and their options to ``commands``, the subparsers of the command line."""
    tasks = tasks_of(verb(commands, "fit", run, "train tables"))
    _add_task(tasks, "disney", "train the tables of the Disney BRDF", _fit_disney, disney.DEFAULT_SETTINGS)
    sub = _add_task(tasks, "ggx", "train the tables of the GGX distribution", _fit_ggx, ggx.DEFAULT_SETTINGS)
    for name, default in (("primary", 16), ("cascaded", 8)):
        sub.add_argument(
            f"--{name}",
            type=positive,
            default=default,
            metavar="N",
            help=f"entries along each side of the {name} array (default: {default})",
        )
    fit_image.add(tasks)


def _add_task(tasks, name: str, help: str, train, levels: dict[str, FitSettings]):
    """
    A task with the options that all have. ``train(arguments, settings)`` returns table and record; ``levels`` are its
    levels of quality, the default first.
    """
    sub = task(tasks, name, help)
    sub.set_defaults(train=train, levels=levels)
    quality = next(iter(levels))
    sub.add_argument("-o", "--output", required=True, metavar="FILE.npz", help="table file to write")
    sub.add_argument("--quality", choices=list(levels), default=quality, help=f"level of quality (default: {quality})")
    sub.add_argument("--storage", choices=STORAGES, default="float32", help="storage form (default: float32)")
    sub.add_argument("--backend", choices=["llvm", "cuda"], help="where to train (default: the GPU if there is one)")
    for option, about, kind in (
        ("steps", "optimisation steps", {"type": positive}),
        ("batch", "samples a step", {"type": positive}),
        ("lr", "Adam's learning rate", {"type": float}),
        ("schedule", "of the learning rate", {"choices": SCHEDULES}),
        ("seed", "seed of the random numbers", {"type": natural}),
    ):
        sub.add_argument(f"--{option}", **kind, help=f"{about} (default: {_default(levels, option)})")
    sub.add_argument("--all-cores", action="store_true", help="faster, but not the same bytes each time")
    sub.add_argument("--checkpoint", metavar="FILE", help="keep the state of the training in FILE")
    sub.add_argument("--resume", action="store_true", help="go on from --checkpoint, with the same settings")
    return sub


def _default(levels: dict[str, FitSettings], option: str) -> str:
    """For a help text: the setting of each level, or one for all if they agree."""
    values = {level: str(getattr(settings, option)) for level, settings in levels.items()}
    if len(set(values.values())) == 1:
        return next(iter(values.values()))
    return ", ".join(f"{value} for {level}" for level, value in values.items())


def run(arguments) -> dict:
    """
    Train and write the table file. Returns its size, accuracy and how the training went; after Ctrl-C, of the best so
    far. Raises :class:`UsageError`, :class:`~mi_diffind.fitting.FittingError` and
    :class:`~mi_diffind.files.OutputError`.
    """
    output = Path(arguments.output)
    if output.suffix.lower() != ".npz":
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .npz')
    if arguments.checkpoint is not None and Path(arguments.checkpoint).resolve() == output.resolve():
        raise UsageError(f'"{output}" cannot be the output and the checkpoint')
    writable_file(output)
    from ..tables import save_table

    given = {k: getattr(arguments, k) for k in ("steps", "batch", "lr", "schedule", "seed")}
    given = {k: v for k, v in given.items() if v is not None}
    settings = dataclasses.replace(arguments.levels[arguments.quality], deterministic=not arguments.all_cores, **given)
    try:
        table, result = arguments.train(arguments, settings)
    except RuntimeError as e:
        raise FittingError(str(e)) from e
    save_table(output, table)
    quality = ", ".join(f"{k} {v}" for k, v in table.quality.items())
    state = f"interrupted at step {result.steps}, kept" if result.interrupted else "best"
    print(f"{output}: {table.nbytes:,} bytes as {table.storage}; {state} step {result.step}; {quality}")
    return {
        "interrupted": result.interrupted,
        "output": str(output),
        "bytes": table.nbytes,
        "storage": table.storage,
        "settings": table.settings,
        "quality": table.quality,
        "step": result.step,
        "seconds": result.seconds,
        "restarts": result.restarts,
        "history": result.history,
    }


def _fit_disney(arguments, settings: FitSettings):
    return disney.fit_disney(settings, **_common(arguments))


def _fit_ggx(arguments, settings: FitSettings):
    sizes = {"primary": arguments.primary, "cascaded": arguments.cascaded}
    try:
        ggx.indirection(**sizes)  # nothing is allocated yet
    except ValueError as e:
        raise UsageError(str(e)) from None
    return ggx.fit_ggx(settings, **_common(arguments), **sizes)


def _common(arguments) -> dict:
    return {k: getattr(arguments, k) for k in ("backend", "quality", "storage", "checkpoint", "resume")}
