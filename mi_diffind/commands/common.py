"""Options that several verbs have, and checks before the work starts."""

import argparse

from ..core import runtime
from ..core.arguments import define, natural, positive
from ..core.errors import printable
from ..core.files import check_distinct


def verb(
    commands, name: str, run, help: str, example: str, reads: tuple[str, ...] = (), writes: tuple[str, ...] = ()
) -> argparse.ArgumentParser:
    """Add a verb to ``commands`` and return its parser; ``--json`` writes what ``run(arguments)`` returns.

    The help ends in the ``example``. ``reads`` and ``writes`` name the arguments that are paths of files.
    """
    sub = commands.add_parser(name, help=help, description=help, epilog=f"example: {example}")
    sub.set_defaults(run=run, reads=reads, writes=writes)
    _json_option(sub, None)
    return sub


def alternatives(sub: argparse.ArgumentParser, name: str):
    """Add subparsers to a verb, one for each ``name`` (a task, a study), to be filled by :func:`alternative`."""
    return sub.add_subparsers(dest=name, required=True, metavar=name.upper())


def alternative(parsers, name: str, help: str, example: str) -> argparse.ArgumentParser:
    """Add the parser of one task or study to those of a verb; the help ends in the ``example``."""
    sub = parsers.add_parser(name, help=help, description=help, epilog=f"example: {example}")
    _json_option(sub, argparse.SUPPRESS)  # a default would replace what was given before the task
    return sub


def check_files(arguments: argparse.Namespace) -> None:
    """Raise :class:`UsageError` if an argument that is written, as ``--json``, is the file of another argument."""
    writes = {**dict.fromkeys(arguments.writes), "json": None}
    outputs = {_label(name): getattr(arguments, name, None) for name in writes}
    check_distinct(outputs, {_label(name): getattr(arguments, name, None) for name in arguments.reads})


def _label(name: str) -> str:
    """Return the name of an argument for a sentence."""
    names = {"output": "-o", "scene": "the scene", "scenes": "a scene", "file": "the file to read", "source": "source"}
    return names.get(name, f"--{name.replace('_', '-')}")


def _json_option(sub: argparse.ArgumentParser, default: str | None) -> None:
    sub.add_argument("--json", metavar="FILE", default=default, help="also write what is printed to FILE")


def variant_option(sub: argparse.ArgumentParser) -> None:
    """Add ``--variant``, for :func:`set_variant`."""
    sub.add_argument("--variant", help="Mitsuba variant (default: cuda_ad_rgb with a GPU, else llvm_ad_rgb)")


def scene_options(sub: argparse.ArgumentParser, rendering: bool = True) -> None:
    """Add ``--variant``, ``-D`` (``defines``: pairs of strings) and, with ``rendering``, ``--spp`` and ``--seed``."""
    variant_option(sub)
    sub.add_argument(
        "-D", dest="defines", action="append", type=define, default=[], metavar="NAME=VALUE",
        help="set a <default> of the scene",
    )  # fmt: skip
    if rendering:
        sub.add_argument("--spp", type=positive, help="samples per pixel (default: the scene's)")
        sub.add_argument("--seed", type=natural, default=0, help="seed of the random numbers (default: 0)")


def learn_option(sub: argparse.ArgumentParser, default: str) -> None:
    """Add ``--learn`` (``learn``: a list of groups of stock plugins, empty without the option)."""
    sub.add_argument(
        "--learn",
        type=lambda text: text.split(","),
        default=[],
        metavar="GROUP,…",
        help="replace Mitsuba's plugins of these groups by learned ones, fitted if need be and kept for the next time: "
        f"material, bitmap, mesh, disney (default: {default})",
    )


def say(text) -> None:
    """Print a text of one or more lines; control characters, which strings of files may hold, are escaped."""
    for line in str(text).splitlines():
        print(printable(line))


def set_variant(name: str | None) -> None:
    """Set the Mitsuba variant ``name``; ``None``: the RGB variant of the GPU if there is one, else of the CPU.

    Raises :class:`UsageError` if it cannot run here.
    """
    import drjit as dr
    import mitsuba as mi

    runtime.use_variant(name or ("cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"))
    mi.set_log_level(mi.LogLevel.Error)
