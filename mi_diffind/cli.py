"""
``mi-diffind``: render, compare, regress, inspect, tradeoff, encode, decode, fit (:mod:`mi_diffind.commands`).

Exit codes: 0 done, 1 a check failed, 2 bad usage or bad input, 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys

from . import __version__
from .commands import compare, decode, encode, fit, inspect, regress, render, tradeoff
from .commands.common import UsageError
from .files import OutputError, writable_file, write_json
from .fitting import FittingError
from .tables import TableError
from .tasks.image.source import SourceError

#: In the order of the help.
VERBS = (render, compare, regress, inspect, tradeoff, encode, decode, fit)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    from .scenes import SceneError  # imports Mitsuba

    try:
        if arguments.json is not None:
            writable_file(arguments.json)
        result = arguments.run(arguments)
        if arguments.json is not None:
            write_json(arguments.json, result)
        return 130 if result.get("interrupted") else 1 if result.get("failed") else 0
    except (UsageError, OutputError, TableError, FittingError, SourceError, SceneError) as e:
        print(f"mi-diffind: error: {e}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("mi-diffind: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader of a pipe has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mi-diffind", description="Learned lookup tables for Mitsuba 3: differentiable indirection."
    )
    parser.add_argument("--version", action="version", version=f"mi-diffind {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for verb in VERBS:
        verb.add(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
