"""Arguments of tasks that store maps, and the figures that their fits report."""

from __future__ import annotations

from pathlib import Path

from ..arrays.budget import Budget
from ..core import units
from ..core.arguments import Argument, between, checked, decibels, positive
from ..core.errors import UsageError
from .source import NONFINITE, Source

_SIZES = (
    ("compression", units.parse_compression, "how many times smaller than the source, uncompressed (default: 12x)"),
    ("bytes", units.parse_bytes, "size of the arrays, as in 256k or 1.5M"),
    ("bpp", units.parse_bpp, "bits a texel of the image, all channels together"),
    ("psnr", decibels, "the smallest file of at least so many dB (several trainings)"),
)

SOURCE = Argument(
    "source", file="read", metavar="IMAGE|MATERIAL.json", help="an image, or a manifest of the maps of a material"
)

#: Ways to give the size of the arrays, of which at most one is allowed.
SIZES = tuple(
    Argument(f"--{name}", group="size", type=checked(parse), metavar="N", help=text) for name, parse, text in _SIZES
)

#: Options of reading a source.
SOURCES = (
    Argument(
        "--border", choices=["auto", "repeat", "clamp"], default="auto",
        help="texels beyond the border: repeat the image, or its last texel (default: auto, along u and v each)",
    ),
    Argument(
        "--nonfinite", choices=NONFINITE, default="error",
        help="NaN and infinity in the source: refuse (default), or replace by 0 and the largest value",
    ),
)  # fmt: skip

#: Picture of a training that is written at each measurement.
PREVIEW = Argument(
    "--preview",
    file="written",
    metavar="FILE.png",
    help="write reference | render | 4x their difference at measurements",
)

#: Least and largest bias of the level of detail that a file may hold, in levels; a negative one reads finer.
BIAS_RANGE = (-4.0, 0.0)


def bias_or_auto(text: str) -> float | str:
    """Return a bias of the level of detail (:data:`BIAS_RANGE`), or ``auto``. Raises ``ArgumentTypeError``."""
    return text if text == "auto" else between(*BIAS_RANGE)(text)


#: Bias of the level of detail at which a texture is read.
LEVEL_BIAS = Argument(
    "--level-bias", type=bias_or_auto, metavar="auto|N",
    help="levels by which the texture is read finer than the footprint, as in -0.5; auto tries several and compares "
    "shaded images (default: auto, 0 for paper)",
)  # fmt: skip

#: Options of decoding maps.
DECODED = (
    Argument("--map", action="append", metavar="NAME", help="only this map; may be repeated (default: all)"),
    Argument("--width", type=positive, help="width in texels (default: the source's)"),
    Argument("--height", type=positive, help="height in texels (default: the source's)"),
)


def requested_bytes(options, source: Source) -> int:
    """Return the bytes of the options :data:`SIZES`, by default a twelfth of the source's. Raises UsageError."""
    from ..arrays.tables import MAX_BYTES

    given = {k: options[k] for k in ("compression", "bpp")} | {"nbytes": options["bytes"]}
    if not any(given.values()):
        given["compression"] = 12
    try:
        wanted = units.parse_size(source.nbytes, source.texels, **given)
    except ValueError as e:
        raise UsageError(str(e)) from None
    if options["bytes"] is not None:
        units.check_size("--bytes", wanted, MAX_BYTES)
    return wanted


def requested_border(options) -> tuple[str, str] | None:
    """Return the border along v and u of the options :data:`SOURCES`; ``None`` if it is chosen by the content."""
    return None if options["border"] == "auto" else (options["border"],) * 2


def size_figures(source: Source, table, requested: float | None) -> tuple[dict, list[str]]:
    """Return the sizes of a trained table for ``--json``, and lines of text; ``requested`` are the bytes wanted."""
    achieved = source.nbytes / table.nbytes if table.nbytes else None
    figures = {
        "source_bytes": source.nbytes,
        "compression": achieved,
        "compression_asked": source.nbytes / requested if requested else None,
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
    }
    wanted = f" ({source.nbytes / requested:.2f}x requested)" if requested else ""
    lines = [(f"{achieved:.2f}x" if achieved else "of one colour") + wanted]
    if requested and achieved and not Budget(requested).is_met(table.nbytes):
        asked, actual = f"{round(requested):,} bytes were requested", f"{table.nbytes:,}"
        lines.append(f"{asked}, but {actual} are the nearest that the arrays of this image allow")
    return figures, lines


def preview_path(request) -> Path | None:
    """Return the file of :data:`PREVIEW`: the given one, or ``…_preview.png`` beside the output (``None`` without)."""
    if request.options["preview"] is not None:
        return Path(request.options["preview"])
    return None if request.output is None else request.output.with_name(f"{request.output.stem}_preview.png")
