"""Command-line arguments that tasks and studies declare, and parsers of their values."""

import argparse
import math
from collections.abc import Mapping

from .errors import UsageError, raised_as
from .files import check_distinct

#: Largest size or count: Dr.Jit and Mitsuba hold them in 32 bits.
MOST = 2**31 - 1

#: Largest seed.
MOST_NATURAL = 2**32 - 1


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
        with raised_as(UsageError, argparse.ArgumentTypeError, ValueError, at=self.name):
            return parse(str(value))


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


def natural(text: str, least: int = 0, most: int = MOST_NATURAL) -> int:
    """Return a whole number from ``least`` to ``most``. Raises ``ArgumentTypeError``."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < least:
        wanted = "a positive number" if least else "a whole number ≥ 0"
        raise argparse.ArgumentTypeError(f"{text:.40} is not {wanted}")
    if value > most:
        raise argparse.ArgumentTypeError(f"found {text:.40}, allowed are whole numbers up to {most:,}")
    return value


def positive(text: str) -> int:
    """Return a whole number from 1 to :data:`MOST`. Raises ``ArgumentTypeError``."""
    return natural(text, 1, MOST)


def between(low: float, high: float, exclusive: bool = False, none: bool = False):
    """Return a parser of numbers from ``low`` to ``high``, which raises ``ArgumentTypeError``.

    ``exclusive``: the two bounds themselves are refused. ``none``: infinity stands for the word "none".
    """
    allowed = f"numbers from {low:g} to {high:g}"
    if exclusive:
        allowed = f"numbers above {low:g}" + ("" if math.isinf(high) else f" and below {high:g}")
    allowed += " and none" if none else ""

    def parse(text: str) -> float:
        if none and text == "none":
            return math.inf
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (low < value < high if exclusive else low <= value <= high):
            raise argparse.ArgumentTypeError(f"found {text!r}, allowed are {allowed}")
        return value

    return parse


#: A number from 0 to 1.
fraction = between(0, 1)

#: A number above 0 and below 1.
proper_fraction = between(0, 1, exclusive=True)

#: A positive number, or infinity for "none".
positive_or_none = between(0, math.inf, exclusive=True, none=True)

#: A PSNR in dB.
decibels = between(0, 120, exclusive=True)


def define(text: str) -> tuple[str, str]:
    """Return the name and the value of ``NAME=VALUE``, a ``<default>`` of a scene. Raises ``ArgumentTypeError``."""
    name, equals, value = text.partition("=")
    if not (name and equals):
        raise argparse.ArgumentTypeError(f'found {text!r}, expected NAME=VALUE, as in "-D width=320"')
    return name, value


def checked(parse):
    """Make a type of ``argparse`` from a parser that raises ``ValueError``, so that its message is shown."""

    def parsed(text: str):
        with raised_as(argparse.ArgumentTypeError, ValueError):
            return parse(text)

    return parsed


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
