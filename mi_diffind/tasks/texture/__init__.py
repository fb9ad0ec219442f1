"""Compressed textures and materials that are filtered as they are read (tasks 4 and 5), and recipes of their fits.

Sources, stored channels and the reference, a mip pyramid, are in :mod:`mi_diffind.maps`. :mod:`.arrays`: resolutions
and initial entries; :mod:`.compressed`: reads of the arrays, files and models; :mod:`.training`: training for the
values of the maps; :mod:`.shading`: training for shaded appearance; :mod:`.heldout`: footprints that decide what it
keeps; :mod:`.surface`: maps as parameters of the BRDF, and shading; :mod:`.appearance`: references, images that
measure, and a preview; :mod:`.fit`: the command ``fit texture``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

from ...core.arguments import Argument, between, checked, fraction, natural, positive
from ...fitting.task import FitSettings, Task
from ...maps.arguments import BIAS_RANGE, DECODED, PREVIEW, SIZES, SOURCE, SOURCES


@dataclass(frozen=True)
class TextureSettings(FitSettings):
    """Storage and training of a texture; the defaults are those of the preset ``ours``.

    - ``layered``: our arrays, on the grids of levels of detail, which start from principal components; else the
      paper's arrays, which start from ramps.
    - ``once``: store channels only once that are equal or constant at every level; not so without a training, whose
      arrays are to be optimised in a scene.
    - ``normals``: leave out the third component of normals where it follows from the others.
    - ``jitter``: share of the steps whose samples lie between texels and levels; the others lie at texel centres of
      whole levels.
    - ``rounded``: train with entries rounded as they will be stored.
    - ``samples``: distribution of levels of detail, ``"levels"`` (one half on level 0, one quarter on level 1, …) or
      one of :data:`.compressed.FOOTPRINTS`.
    """

    steps: int = 1500
    batch: int = 2**18
    lr: float = 3e-2
    loss: str = "mse"
    measure_every: int = 150
    layered: bool = True
    once: bool = True
    normals: bool = True
    jitter: float = 0.5
    rounded: bool = True
    samples: str = "levels"

    fewest_steps: ClassVar[int] = 0


#: Settings by preset; the first is the default.
PRESETS = {
    "ours": TextureSettings(),
    "paper": TextureSettings(
        steps=375, batch=2**20, lr=1e-3, schedule="constant", loss="mae", layered=False, once=False, normals=False,
        jitter=1.0, rounded=False, samples="power",
    ),
}  # fmt: skip


#: Sample patterns of the reference (:data:`.appearance.SAMPLES_PER_SIDE`).
REFERENCES = ("jittered", "prefiltered", "converged")


@dataclass(frozen=True)
class ShadingSettings(FitSettings):
    """Training for shaded appearance, which starts from a trained texture; the defaults are those of ``ours``.

    - ``steps``: those of all its trainings together (:mod:`.shading`); ``loss``: that of shaded values.
    - ``share``: λ, the share of the loss of shaded values.
    - ``clip``: bound of the derivatives of a sample's error through the specular lobe (``None``: unlimited).
    - ``reference``: sample pattern of the reference.
    - ``bounded``: whether values above white are compared in log space.
    - ``level_bias``: levels by which a footprint's level of detail is read finer (negative), stored in the file
      (``None``: chosen by held-out footprints).
    - ``extras``: whether the shape and weight of the specular lobe are trained as coarse extras, which
      ``neural_material`` alone reads.
    - ``mirrored``: share of the lights that are drawn about the mirror direction.
    - ``skies``: share of the pairs that are of a uniform sky.
    - ``rendered``: whether pairs are drawn as renders read them: footprints are stretched, and views follow from it,
      as on flat surfaces; each second step is of pixels with four samples; exposures are those of held-out footprints,
      and errors of levels and kinds of lights, relative to those of the start, count the same.
    - ``tables``: whether arrays are shaded by the frozen tables of task 2, in place of the formulas that
      ``neural_material`` evaluates by default.
    - ``beta_2``: Adam's decay of squared gradients. Highlights are rare: with 0.999, single ones tilt normals of
      glossy, flat pages by degrees.
    - ``texture``: preset of task 4 that defines the samples and the loss of the texture.
    """

    steps: int = 2000
    batch: int = 2**16
    lr: float = 1e-3
    loss: str = "mse"
    measure_every: int = 150
    share: float = 0.5
    clip: float | None = None
    reference: str = "jittered"
    bounded: bool = True
    level_bias: float | None = None
    extras: bool = False
    mirrored: float = 0.5
    skies: float = 0.25
    rendered: bool = True
    tables: bool = False
    beta_2: float = 0.99
    texture: str = "ours"


#: Settings of the training for shading by preset. The paper's λ is 0.1 or 0.25, by its scene.
SHADING_PRESETS = {
    "ours": ShadingSettings(),
    "paper": ShadingSettings(
        lr=1e-3, schedule="constant", loss="mae", share=0.25, clip=0.1, reference="prefiltered", bounded=False,
        level_bias=0.0, mirrored=0.0, skies=0.0, rendered=False, tables=True, beta_2=0.999,
        texture="paper",
    ),
}  # fmt: skip


class FineArray(NamedTuple):
    """A fine array on the grid of a ``level`` of detail, with so many ``channels`` of ``bits`` bits."""

    level: int
    channels: int
    bits: int


def parse_structure(text: str) -> str | tuple[FineArray, ...]:
    """Return ``"auto"``, ``"pages"``, or the fine arrays of a text such as ``0:1:2,1:2:4`` (level, channels, bits).

    Raises ``ValueError``.
    """
    if text in ("auto", "pages"):
        return text
    if not re.fullmatch(r"\d+:\d+:\d+(,\d+:\d+:\d+)*", text, re.ASCII):
        raise ValueError(f'structure: found {text!r}, allowed are LEVEL:CHANNELS:BITS,… as in 0:1:2,1:2:4, and "auto"')
    fine = tuple(FineArray(*map(int, part.split(":"))) for part in text.split(","))
    if [f.level for f in fine] != sorted({f.level for f in fine}):
        raise ValueError(f"structure: found {text!r}, levels have to grow from array to array")
    if not all(1 <= f.channels <= 4 and 1 <= f.bits <= 8 for f in fine):
        raise ValueError(f"structure: found {text!r}, allowed are 1 to 4 channels and 1 to 8 bits")
    return fine


def bias_or_auto(text: str) -> float | str:
    """Return a bias of the level of detail (:data:`.BIAS_RANGE`), or ``auto``. Raises ``ArgumentTypeError``."""
    return text if text == "auto" else between(*BIAS_RANGE)(text)


class Texture(Task):
    """Task of filtered textures; presets are :data:`PRESETS`, entries have 8 bits or fewer.

    The training has two stages: for the values of the maps (:class:`TextureSettings`), and for the shading of materials
    (:class:`ShadingSettings`).
    """

    name = "texture"
    title = "a texture or the maps of a material at every level of detail"
    files = "compressed"
    section = "supplemental 1.4 and 1.5"
    former = {"shading": "materials are trained for their shading by fit texture, see its --shading"}  # noqa: RUF012
    example = "material.json --compression 12x"
    plugin = ("texture", "neural_texture")
    presets = PRESETS
    storages = ()
    measurements = 10
    arguments = (
        SOURCE,
        *SIZES,
        Argument(
            "--structure", type=checked(parse_structure), metavar="L:C:B,…",
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
            "--separate", action="store_true",
            help="constant and equal channels have entries of their own, to be optimised in a scene (always so without "
            "a training, --steps 0)",
        ),
        Argument(
            "--shading", choices=("auto", "on", "off"), default="auto",
            help="a last stage that trains a material for its shaded appearance; auto: with a map of normals or "
            "roughness, but not for paper (default: auto)",
        ),
        Argument(
            "--start", file="read", metavar="FILE.npz",
            help="arrays that the last stage begins with, as written by fit texture, in place of the first stage",
        ),
        Argument(
            "--lambda", dest="share", type=fraction, metavar="L",
            help="share of the loss of shaded values in the last stage, 0 to 1 "
            f"(default: {', '.join(f'{r.share} for {name}' for name, r in SHADING_PRESETS.items())})",
        ),
        Argument(
            "--extras", choices=("auto", "off"), default="off",
            help="shape and weight of the highlight in coarse grids beside the maps, read by neural_material alone; "
            "auto keeps them if held-out footprints gain (default: off)",
        ),
        Argument(
            "--level-bias", type=bias_or_auto, default="auto", metavar="auto|N",
            help="levels by which the texture is read finer than a round footprint, as in -0.5 (default: auto, chosen "
            "by held-out footprints in the last stage, 0 without it and for paper)",
        ),
        *SOURCES,
        PREVIEW,
    )  # fmt: skip
    decode_arguments = (
        *DECODED,
        Argument("--level", type=natural, metavar="N", help="level of detail (default: 0, the source's)"),
    )

    def settings(self, preset, given, options):
        samples = options["footprint_samples"] or PRESETS[preset].samples
        once = PRESETS[preset].once and not options["separate"] and given.get("steps") != 0
        return self.change_settings(PRESETS[preset], {"samples": samples, "once": once, **given})

    def shading_settings(self, preset: str, settings: TextureSettings, options: Mapping) -> ShadingSettings:
        """Return the settings of the training for shading beside those of the texture.

        Number of steps, unless it is that of the preset, and seed are those of the texture's ``settings``.
        """
        given = {"seed": settings.seed, "deterministic": settings.deterministic, "share": options["share"]}
        given["steps"] = settings.steps if settings.steps != PRESETS[preset].steps else None
        given["level_bias"] = options["level_bias"] if options["level_bias"] != "auto" else None
        given["extras"] = options["extras"] == "auto" and PRESETS[preset].layered
        given = {name: value for name, value in given.items() if value is not None}
        return self.change_settings(SHADING_PRESETS[preset], given)

    def usage(self, table, file):
        lines = super().usage(table, file)
        if len(table.settings["layout"]["maps"]) > 1:
            lines += [
                "<!-- or all maps -->",
                f'<bsdf type="neural_material"><string name="filename" value="{file}"/></bsdf>',
            ]
        return lines


TASK = Texture()
