"""Task 4: compressed textures and materials that are filtered as they are read, at a place and a level of detail.

Sources, stored channels and the reference, a mip pyramid, are in :mod:`mi_diffind.maps`.

- :mod:`.nets`: reads of the arrays, the paper's structure and ours; :mod:`.arrays`: initial arrays.
- :mod:`.memory_budget`: resolutions; :mod:`.sampling`: footprints, equations 3 to 9.
- :mod:`.presets`, :mod:`.training`, :mod:`.fit`: recipes, the training problem, the command ``fit texture``.
- :mod:`.compressed`: the result as a texture, as a table file and as a model.
"""

from __future__ import annotations

from ...core.arguments import Argument, between, checked, natural, positive
from ...fitting.task import Task
from ...maps.arguments import BIAS_RANGE, DECODED, SIZES, SOURCE, SOURCES
from .presets import PRESETS


def _parse_structure(text: str) -> None:
    """Raise ``ValueError`` for a text that names no structure of arrays."""
    from .memory_budget import parse_structure

    if text not in ("auto", "pages"):
        parse_structure(text)


class Texture(Task):
    """Task of filtered textures; presets are the recipes of :mod:`.presets`, entries have 8 bits or fewer."""

    name = "texture"
    title = "a texture or the maps of a material at every level of detail"
    files = "compressed"
    section = "supplemental 1.4"
    example = "material.json --compression 12x"
    plugin = ("texture", "neural_texture")
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    measurements = 10
    arguments = (
        SOURCE,
        *(size for size in SIZES if size.name != "psnr"),
        Argument(
            "--structure", type=checked(_parse_structure), metavar="L:C:B,…",
            help="pages, or level, channels and bits of each fine array, as in 0:1:2,1:2:4 (default: auto)",
        ),
        Argument(
            "--skip", type=natural, metavar="LEVEL",
            help="first level of detail of the coarse array (default: chosen)",
        ),
        Argument(
            "--cascaded", type=positive, metavar="N", help="entries along each side of the cascaded array"
        ),
        Argument(
            "--ratio", type=between(1, 1024), metavar="N",
            help="for paper: side of the primary over side of the cascaded array (default: by the compression)",
        ),
        Argument(
            "--footprint-samples", choices=["levels", "power", "exponential"],
            help="distribution of levels of detail in training (default: levels for ours, power for paper)",
        ),
        Argument(
            "--level-bias", type=between(*BIAS_RANGE), default=0.0, metavar="N",
            help="levels by which the texture is read finer than the footprint, as in -0.5 (default: 0)",
        ),
        *SOURCES,
    )  # fmt: skip
    decode_arguments = (
        *DECODED,
        Argument("--level", type=natural, metavar="N", help="level of detail (default: 0, the source's)"),
    )

    def usage(self, table, file):
        lines = super().usage(table, file)
        if len(table.settings["layout"]["maps"]) > 1:
            lines += [
                "<!-- or all maps -->",
                f'<bsdf type="neural_material"><string name="filename" value="{file}"/></bsdf>',
            ]
        return lines


TASK = Texture()
