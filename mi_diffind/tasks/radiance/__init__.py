"""Task 7: radiance fields from images of a scene.

- :mod:`.transforms`, :mod:`.colmap`, :mod:`.image_files`, :mod:`.lenses`, :mod:`.background`, :mod:`.views`: captured
  images with cameras;
- :mod:`.visual_hull`, :mod:`.surroundings`: the space that captured objects may occupy, and the space around it;
- :mod:`.volume_field`, :mod:`.nodes`, :mod:`.march`: fields, the nodes that hold their numbers, and ray marching;
- :mod:`.reflection`: colours by the reflection of an environment that all nodes share;
- :mod:`.session`, :mod:`.training`, :mod:`.grid`: training through images, and the grid that is compressed;
- :mod:`.compression`, :mod:`.paper`: our compressed layout, and that of the supplement;
- :mod:`.presets`, :mod:`.fit`, :mod:`.files`, :mod:`.model`, :mod:`.decode`: the steps of ``fit field`` and its result.
"""

from __future__ import annotations

from ...core import units
from ...core.arguments import Argument, between, checked, decibels, positive
from ...fitting.task import Task
from .presets import BACKGROUNDS, COLOURS, PRESETS


def resolution(text: str) -> int | None:
    """Return a whole number ≥ 1, or ``None`` for ``auto``. Raises ``ArgumentTypeError``."""
    return None if text == "auto" else positive(text)


class RadianceField(Task):
    """Task 7, ``fit field``. The layout fixes the storage: bytes, or half precision for the preset ``grid``."""

    name = "field"
    title = "a radiance field, from images of a scene"
    section = "supplemental 1.7"
    example = "views --bytes 600k"
    plugin = ("integrator", "neural_field")
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    measurements = 2
    arguments = (
        Argument(
            "source", file="read", metavar="FOLDER",
            help="folder of views of mi-diffind capture, Blender, nerfstudio, instant-ngp (transforms*.json), COLMAP, "
            "or SPLATS.ply: 3D Gaussians, of which views are rendered first"
        ),
        Argument(
            "--bytes", group="size", type=checked(units.parse_bytes), metavar="N",
            help="size in memory, such as 512k or 1.5M",
        ),
        Argument(
            "--disk", group="size", type=checked(units.parse_bytes), metavar="N",
            help="size of the file, such as 700k or 1.5M: colours, precision and resolution by rate and distortion",
        ),
        Argument(
            "--compression", group="size", type=checked(units.parse_compression), metavar="N",
            help="ratio of the bytes of a dense float32 grid to those of the field (default of paper: 50)",
        ),
        Argument(
            "--psnr", group="size", type=checked(decibels), metavar="N",
            help="PSNR over white, in dB: the smallest of eight sizes that reaches it (three trainings)",
        ),
        *(
            Argument(
                f"--{quantity}-ratio", type=between(1, 16), metavar="N",
                help=f"for paper: side of the primary over side of the cascaded array of the {quantity} (default: by "
                "the compression)",
            )
            for quantity in ("density", "colour")
        ),
        Argument(
            "--resolution", type=resolution, metavar="N",
            help="resolution of the grid: nodes along the side of a cube of the same volume, or auto: a voxel has "
            "0.8 of the width of a pixel (default: auto)",
        ),
        Argument(
            "--background", choices=BACKGROUNDS,
            help="background of images without alpha: a colour, scene (a box around everything), or surroundings "
            "(coarser with the distance, without an end) (default: the colour of their borders if it is one, else "
            "scene)"
        ),
        Argument(
            "--exposures", action="store_true",
            help="train an exposure for each view, in stops with the mean 0: photographs of automatic exposure"
        ),
        Argument(
            "--colours", choices=COLOURS,
            help="how colours change with the direction: reflections of an environment that all nodes share, or a "
            "degree of directions for red, green and blue (default: what shows views best that a trial leaves out)"
        ),
        Argument(
            "--downscale", type=positive, metavar="N",
            help="factor by which the sides of images are reduced (default: the least at which they have 1600 pixels)"
        ),
        Argument(
            "--grid", file="written", metavar="FILE", help="grid to compress; if the file does not exist, it is made"
        ),
    )  # fmt: skip
    decode_arguments = (
        Argument(
            "--resolution", type=positive, metavar="N", help="nodes along the longest side (default: the field's)"
        ),
    )

    def allocate(self, table, dtype, storage=""):
        return {}


TASK = RadianceField()
