"""``mi-diffind fit``: train the tables of a task."""

from ..core.arguments import add_arguments, natural, positive
from ..core.files import writable_file, writable_folder
from ..core.progress import Deadline
from ..fitting.task import LOSSES, SCHEDULES, FittingError, Task, fit, former_tasks, tasks
from .common import alternative, alternatives, say, set_variant, variant_option, verb

#: Settings of a training that every task has: what they are, and the options of their parsers.
SETTINGS = (
    ("batch", "samples a step", {"type": positive}),
    ("lr", "Adam's learning rate", {"type": float}),
    ("loss", "error to minimise", {"choices": LOSSES}),
    ("schedule", "schedule of the learning rate", {"choices": SCHEDULES}),
    ("seed", "seed of the random numbers", {"type": natural}),
)

HELP = "train the tables of a task, and write them to a table file"

EXAMPLE = "mi-diffind fit image photo.png -o photo.npz"


def add(commands) -> None:
    """Add the verb, its tasks and their options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "fit", run, HELP, EXAMPLE)
    for word in [word for word in getattr(commands, "words", ()) if not word.startswith("-")][1:2]:
        if word in former_tasks():
            sub.error(f'the task "{word}" is no more: {former_tasks()[word]}')
    parsers = alternatives(sub, "task")
    for task in tasks().values():
        section = f" ({task.section})" if task.section else ""
        words = " ".join(filter(None, ("mi-diffind fit", task.name, task.example, f"-o {task.name}.npz")))
        _add(alternative(parsers, task.name, f"train tables of {task.title}{section}", words), task)


def _add(sub, task: Task) -> None:
    add_arguments(sub, task.arguments)
    files = {use: tuple(a.name for a in task.arguments if a.file == use) for use in ("read", "written")}
    sub.set_defaults(reads=files["read"], writes=("output", "checkpoint", *files["written"]))
    sub.add_argument("-o", "--output", required=True, metavar="FILE.npz", help="table file to write")
    preset = next(iter(task.presets))
    sub.add_argument(
        "--preset", choices=list(task.presets), default=preset, help=f"layout and training (default: {preset})"
    )
    if task.storages:
        default = task.storages[0]
        sub.add_argument("--storage", choices=task.storages, default=default, help=f"storage form (default: {default})")
    variant_option(sub)
    length = sub.add_mutually_exclusive_group()
    untrained = not task.presets[preset].fewest_steps
    steps = f"optimisation steps{', 0: no training' * untrained} (default: {_default(task, 'steps')})"
    length.add_argument("--steps", type=natural if untrained else positive, help=steps)
    length.add_argument("--seconds", type=positive, help="duration of the command in seconds, in place of steps")
    for name, text, options in SETTINGS:
        sub.add_argument(f"--{name}", **options, help=f"{text} (default: {_default(task, name)})")
    sub.add_argument(
        "--all-cores", action="store_true", help="train on all cores: faster, but the bytes differ from run to run"
    )
    sub.add_argument("--checkpoint", metavar="FILE", help="keep the state of the training in FILE")
    sub.add_argument("--resume", action="store_true", help="continue from --checkpoint, with the same settings")


def _default(task: Task, name: str) -> str:
    """For a help text: the setting of each preset, or one for all if they agree."""
    values = {preset: str(getattr(settings, name)) for preset, settings in task.presets.items()}
    if len(set(values.values())) == 1:
        return next(iter(values.values()))
    return ", ".join(f"{value} for {preset}" for preset, value in values.items())


def run(arguments) -> dict:
    """Train, write the table file, and return its size, its accuracy and the history of the training.

    After Ctrl-C, these are of the best state so far. Raises :class:`.UsageError`,
    :class:`.OutputError`, :class:`FittingError` and what the task's own input raises.
    """
    deadline = None if arguments.seconds is None else Deadline(arguments.seconds)
    task = tasks()[arguments.task]
    output = task.output_path(arguments.output)
    if output.suffix.lower() == ".npz":
        writable_file(output)
    else:  # a folder, for the tables of several files
        writable_folder(output if output.exists() else output.parent)
    given = {name: getattr(arguments, name) for name in ("steps", *(name for name, *_ in SETTINGS))}
    given = {name: value for name, value in given.items() if value is not None}
    given |= {argument.name: getattr(arguments, argument.name) for argument in task.arguments}
    set_variant(arguments.variant)
    try:
        fitted = fit(
            task.name, preset=arguments.preset, storage=getattr(arguments, "storage", ""), seconds=deadline,
            checkpoint=arguments.checkpoint, resume=arguments.resume, output=output,
            deterministic=not arguments.all_cores, **given,
        )  # fmt: skip
    except RuntimeError as e:
        raise FittingError(str(e)) from e
    fitted.save(output)
    say("\n".join(fitted.summary(output)))
    return {"output": str(output), **fitted.report, "task": task.name}
