"""Arguments of tasks that store maps."""

from ..core import units
from ..core.arguments import Argument, checked, decibels, positive
from .source import NONFINITE

_SIZES = (
    ("compression", units.parse_compression, "how many times smaller than the source, uncompressed (default: 12x)"),
    ("bytes", units.parse_bytes, "size of the arrays, as in 256k or 1.5M"),
    ("bpp", units.parse_bpp, "bits a texel of the image, all channels together"),
    ("psnr", decibels, "the smallest file of at least so many dB (several trainings)"),
)

SOURCE = Argument(
    "source",
    file="read",
    metavar="IMAGE|FOLDER|MATERIAL",
    help="an image, a folder of maps, a manifest (.json), or FILE.gltf, .glb or .mtlx with #NAME of a material",
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

#: Options of decoding maps.
DECODED = (
    Argument("--map", action="append", metavar="NAME", help="only this map; may be repeated (default: all)"),
    Argument("--width", type=positive, help="width in texels (default: the source's)"),
    Argument("--height", type=positive, help="height in texels (default: the source's)"),
)
