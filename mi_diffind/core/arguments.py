"""Command-line arguments that tasks and studies declare, and parsers of their values."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping

from .errors import UsageError
from .files import check_distinct

#: Largest size or count, and largest seed: Dr.Jit and Mitsuba hold them in 32 bits.
MOST, MOST_NATURAL = 2**31 - 1, 2**32 - 1


class Argument:
    """Argument of ``fit`` or ``decode`` that a task adds.

    Flags and options are those of ``argparse.ArgumentParser.add_argument``; of the arguments of one ``group``, at most
    one may be given. ``file`` is "read" or "written" for the path of a file (which a command may read, too), lest two
    arguments name the same file.
    """

    def __init__(self, *flags: str, group: str = "", file: str = "", **options):
        self.flags, self.group, self.file, self.options = flags, group, file, options

    @property
    def name(self) -> str:
        """Name in Python, and key in :attr:`.task.FitRequest.options`."""
        return self.options.get("dest", self.flags[0].lstrip("-").replace("-", "_"))

    @property
    def default(self):
        """Value if the argument is not given."""
        return self.options.get("default", False if self.options.get("action") == "store_true" else None)

    def parsed(self, value):
        """Return a value from Python as the command line would pass it on.

        Text and numbers are checked by the option's parser and its choices; other objects stay as they are. Raises
        :class:`.UsageError`.
        """
        choices = self.options.get("choices")
        if choices and value not in (self.default, *choices) and not isinstance(value, (list, tuple)):
            raise UsageError(f"{self.name}: found {value!r}, allowed are {', '.join(map(str, choices))}")
        parse, plain = self.options.get("type"), isinstance(value, (str, int, float)) and not isinstance(value, bool)
        if parse is None or not plain or value in (self.default, math.inf):
            return value
        try:
            return parse(str(value))
        except (argparse.ArgumentTypeError, ValueError) as e:
            raise UsageError(f"{self.name}: {e}") from None


def add_arguments(parser: argparse.ArgumentParser, arguments: tuple[Argument, ...]) -> None:
    """Add arguments to a parser; positional ones come first, as they stand."""
    groups = {name: parser.add_mutually_exclusive_group() for name in dict.fromkeys(a.group for a in arguments) if name}
    for argument in arguments:
        groups.get(argument.group, parser).add_argument(*argument.flags, **argument.options)


def check_files(arguments: tuple[Argument, ...], options: Mapping, outputs: Mapping) -> None:
    """Refuse ``outputs`` or files of ``arguments`` to write that are another one of them, or a file to read.

    ``options`` are the values of the arguments by name. Raises :class:`.UsageError`.
    """
    files = {use: {a.flags[0]: options[a.name] for a in arguments if a.file == use} for use in ("read", "written")}
    check_distinct({**outputs, **files["written"]}, files["read"])


def positive(text: str) -> int:
    """Return a whole number from 1 to :data:`MOST`. Raises ``ArgumentTypeError``."""
    value = natural(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    if value > MOST:
        raise argparse.ArgumentTypeError(f"found {text:.40}, allowed are whole numbers up to {MOST:,}")
    return value


def natural(text: str) -> int:
    """Return a whole number from 0 to :data:`MOST_NATURAL`. Raises ``ArgumentTypeError``."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text:.40} is not a whole number ≥ 0")
    if value > MOST_NATURAL:
        raise argparse.ArgumentTypeError(f"found {text:.40}, allowed are whole numbers up to {MOST_NATURAL:,}")
    return value


def between(low: float, high: float):
    """Return a parser of numbers from ``low`` to ``high``, which raises ``ArgumentTypeError``."""

    def parsed(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"found {text!r}, allowed are numbers from {low:g} to {high:g}")
        return value

    return parsed


#: A number from 0 to 1.
fraction = between(0, 1)


def proper_fraction(text: str) -> float:
    """Return a number greater than 0 and less than 1. Raises ``ArgumentTypeError``."""
    try:
        value = fraction(text)
    except argparse.ArgumentTypeError:
        value = 0.0
    if value in (0, 1):
        raise argparse.ArgumentTypeError(f"found {text}, allowed is more than 0 and less than 1")
    return value


def positive_or_none(text: str) -> float:
    """Return a positive number, or infinity for ``none``. Raises ``ArgumentTypeError``."""
    try:
        value = math.inf if text == "none" else float(text)
    except ValueError:
        value = math.nan
    if not value > 0 or (math.isinf(value) and text != "none"):
        raise argparse.ArgumentTypeError(f"found {text!r}, expected a positive number or none")
    return value


def define(text: str) -> tuple[str, str]:
    """Return the name and the value of ``NAME=VALUE``, a ``<default>`` of a scene. Raises ``ArgumentTypeError``."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'found {text!r}, expected NAME=VALUE, as in "-D width=320"')
    return name, value


def checked(parse):
    """Make a type of ``argparse`` from a parser that raises ``ValueError``, so that its message is shown.

    The type returns the text itself.
    """

    def parsed(text: str):
        try:
            parse(text)
        except ValueError as e:
            raise argparse.ArgumentTypeError(str(e)) from None
        return text

    return parsed


def decibels(text: str) -> float:
    """Return a PSNR in dB. Raises ``ValueError``."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 120:
        raise ValueError(f"{text!r} is no PSNR, allowed are numbers of dB between 0 and 120")
    return value


#: Options of work that falls apart into jobs (:mod:`.jobs`).
WORKER_ARGUMENTS = (
    Argument(
        "--workers", type=positive, metavar="N", help="share the work among N processes (default: this process alone)"
    ),
    Argument(
        "--scheduler", default="", metavar="ADDRESS",
        help="share the work among the workers of a Dask cluster, as in tcp://host:8786, with the same folders",
    ),
)  # fmt: skip
