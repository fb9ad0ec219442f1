"""Task 7: radiance fields from images of a scene.

- :mod:`.captures`, :mod:`.views`: captured images with cameras, and the space that captured objects may occupy;
- :mod:`.volume_field`, :mod:`.nodes`, :mod:`.march`: fields, the nodes that hold their numbers, in a box or in all
  space, and ray marching;
- :mod:`.session`, :mod:`.grid`: training through images, and the grid that is compressed;
- :mod:`.compression`, :mod:`.coding`, :mod:`.paper`: our compressed layout, and that of the supplement;
- :mod:`.fit`, :mod:`.files`, :mod:`.model`: the steps of ``fit field`` and its result.
"""

from dataclasses import replace
from math import log, prod

from ...core import units
from ...core.arguments import Argument, between, checked, positive
from ...fitting.task import FitSettings, Task

#: Range of the resolution that follows from the pixels of the views: nodes along each side of a cube with the volume of
#: the box.
RESOLUTIONS = (32, 352)

#: Ratio ρ of the sides of primary and cascaded array by compression (Table 6 of the supplement).
RATIOS = {
    "density": {5: 3.57, 10: 3.8, 25: 2.69, 50: 1.97, 75: 2.82, 100: 2.51},
    "colour": {5: 5.05, 10: 3.42, 25: 4.14, 50: 4.53, 75: 3.58, 100: 5.74},
}

#: Colours of a field that a user may choose: with reflections (:mod:`.volume_field`), or twelve numbers of directions.
COLOURS = ("reflections", "directions")

#: Bytes of a node of the uncompressed grid: a density and twelve numbers of colour in float32.
NODE_BYTES = 52


def dense_bytes(shape) -> int:
    """Return the bytes of an uncompressed grid of this ``shape``, to which compressions refer."""
    return NODE_BYTES * prod(map(int, shape))


#: Preset name → settings of the training; the first is the default.
PRESETS = {
    "sparse": FitSettings(steps=1000, batch=16384, lr=5e-3, loss="mse", check_every=50),
    "paper": FitSettings(steps=1000, batch=16384, lr=5e-3, loss="mse", check_every=50),
    "grid": FitSettings(steps=2000, batch=16384, lr=4e-2, loss="mse", check_every=50),
}


def scale_steps(preset: str, settings: FitSettings, views) -> FitSettings:
    """Return ``settings`` with steps for the pixels of all training ``views``, if they have the steps of the preset.

    Two rays are drawn for each pixel, twenty while a grid is trained, but not fewer than the settings say.
    """
    if settings.steps != PRESETS[preset].steps:
        return settings
    rays = (20 if preset == "grid" else 2) * (len(views) * views.mean_pixels)
    return replace(settings, steps=max(settings.steps, min(11_000, round(rays / settings.batch))))


def ratio_for(quantity: str, compression: float) -> float:
    """Return the ratio ρ of "density" or "colour" in Table 6 for the nearest compression, by logarithm."""
    table = RATIOS[quantity]
    return table[min(table, key=lambda c: abs(log(c / compression)))]


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
    presets = PRESETS
    storages = ()
    measurements = 2
    arguments = (
        Argument(
            "source", file="read", metavar="FOLDER",
            help="folder of views of mi-diffind capture, Blender, nerfstudio, instant-ngp (transforms*.json) or COLMAP"
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
            "--background", choices=("white", "black", "scene", "surroundings"),
            help="background of images without alpha: a colour, scene (a box around everything), or surroundings "
            "(coarser with the distance, without an end) (default: the colour of their borders if it is one, else "
            "scene)"
        ),
        Argument(
            "--colours", choices=COLOURS,
            help="view dependence: shared reflected environment, or per-node exponential of the direction (default: "
            "chosen by a short trial on left-out views)"
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
