"""``mi-diffind``: one verb a module of :mod:`mi_diffind.commands`.

Exit codes: 0 done, 1 a check failed, 2 bad usage or bad input, 130 interrupted.
"""

import argparse
import importlib
import os
import sys

from .. import __version__
from ..core.errors import DiffindError, printable, reason, shortened
from ..core.files import shown, writable_file, write_json
from .common import check_files

#: In the order of the help.
VERBS = (
    *("render", "view", "capture", "compare", "convert", "regress", "inspect", "tradeoff", "decode", "fit"),
    *("examples", "fetch"),
)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    argv = sys.argv[1:] if argv is None else argv
    arguments = _parser(argv).parse_args(argv)
    for stream in (sys.stdout, sys.stderr):  # names of files may hold bytes that are no text
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        check_files(arguments)
        if arguments.json is not None:
            writable_file(arguments.json)
        result = arguments.run(arguments)
        if arguments.json is not None:
            write_json(arguments.json, result)
        return 130 if result.get("interrupted") else 1 if result.get("failed") else 0
    except DiffindError as e:
        fault = shortened(str(e), 280)
    except KeyboardInterrupt:
        print("mi-diffind: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except MemoryError:
        fault = "the memory of this machine does not suffice"
    except OSError as e:  # a file that no reader refuses by itself, such as one that may not be read
        named = f'"{shown(e.filename)}": ' if isinstance(e.filename, (str, os.PathLike)) else ""
        fault = f"{named}{e.strerror or reason(e)}"
    print(f"mi-diffind: error: {fault}", file=sys.stderr)
    return 2


class _Parser(argparse.ArgumentParser):
    """Parser whose messages, which quote what was typed, are printable and short; so are those of its commands."""

    def error(self, message: str):
        super().error(shortened(printable(message), 240))


def _parser(argv: list[str]) -> argparse.ArgumentParser:
    """Build the parser of the verb in ``argv``; other verbs are only named, without imports of tasks."""
    parser = _Parser(prog="mi-diffind", description="Learned lookup tables for Mitsuba 3: differentiable indirection.")
    parser.add_argument("--version", action="version", version=f"mi-diffind {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    commands.words = argv  # of which a verb may need to know the study
    chosen = next((word for word in argv if not word.startswith("-")), None)
    for name in VERBS:
        module = importlib.import_module(f"{__package__}.{name}")
        if name == chosen:
            module.add(commands)
        else:
            commands.add_parser(name, help=module.HELP)
    return parser


if __name__ == "__main__":
    sys.exit(main())
