"""``mi-diffind decode``: the content of a table file in an ordinary format."""

from pathlib import Path

from ..core.arguments import add_arguments
from ..core.errors import UsageError
from ..core.files import writable_file
from ..fitting.task import find_task, load_model, tasks
from .common import say, set_variant, variant_option, verb

HELP = "turn a table file back into ordinary files, as images"

EXAMPLE = "mi-diffind decode material.npz -o material.png"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "decode", run, HELP, EXAMPLE, reads=("file",), writes=("output",))
    sub.add_argument("file", metavar="FILE.npz")
    sub.add_argument(
        "-o", "--output", required=True, metavar="OUT", help="file to write; several parts become OUT_NAME each"
    )
    variant_option(sub)
    add_arguments(sub, tuple({a.name: a for task in tasks().values() for a in task.decode_arguments}.values()))


def run(arguments) -> dict:
    """Write the files and return their names as ``files``.

    Raises :class:`UsageError`, :class:`.TableError` and :class:`.OutputError`.
    """
    output = writable_file(arguments.output)
    from ..arrays.tables import load_table
    from ..core.runtime import array_module

    accepted = {argument.name for argument in find_task(load_table(arguments.file)).decode_arguments}
    given = {a.name: getattr(arguments, a.name) for task in tasks().values() for a in task.decode_arguments}
    given = {name: value for name, value in given.items() if value is not None}
    for name in given:
        if name not in accepted:
            raise UsageError(f"{arguments.file}: --{name.replace('_', '-')} does not apply to this file")
    set_variant(arguments.variant)
    model = load_model(arguments.file, array_module(arguments.variant).TensorXf)
    files = model.decode(Path(output), **given)
    for path, line in files:
        say(f"{path}: {line}")
    return {"file": arguments.file, "files": [str(path) for path, _ in files]}
