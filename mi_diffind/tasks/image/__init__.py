"""Images and materials as a primary array that points into a cascaded one (task 3), and recipes of their fits.

Sources and stored channels are in :mod:`mi_diffind.maps`. :mod:`.arrays`: resolutions, initial arrays and files;
:mod:`.training`: the training problem; :mod:`.fit`: the command ``fit image``.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass

from ...core.arguments import Argument, between, checked, positive
from ...fitting.task import FitSettings, Task
from ...maps.arguments import DECODED, SIZES, SOURCE, SOURCES


@dataclass(frozen=True)
class CoarsePrimary:
    """A second primary array, of lower resolution.

    It holds ``dims`` coordinates of the pointer in ``bits`` bits; ``scale`` is its side as a multiple of the first's.
    """

    dims: int = 2
    bits: int = 6
    scale: float = 0.35


#: Structures of the primary: bits of an entry, and a second primary or ``None``. Fewer bits: more entries.
STRUCTURES: dict[str, tuple[int, CoarsePrimary | None]] = {
    **{f"{bits} bits": (bits, None) for bits in (8, 7, 6, 5, 4, 3)},
    "4 + 8 bits": (4, CoarsePrimary(2, 8, 0.5)),
    "3 + 6 bits": (3, CoarsePrimary(2, 6, 0.4)),
    "2 + 6 bits": (2, CoarsePrimary(2, 6, 0.35)),
    "pages of 5 bits": (5, None),
    "pages of 6 bits": (6, None),
    "pages of 2 + 6 bits": (2, CoarsePrimary(2, 6, 0.35)),
}

#: Structures whose first primary consists of pages, whose resolution follows the image (:mod:`~.arrays.pages`).
PAGED = ("pages of 5 bits", "pages of 6 bits", "pages of 2 + 6 bits")


@dataclass(frozen=True)
class ImageSettings(FitSettings):
    """Storage and training of an image; the defaults are those of the preset ``ours``.

    - ``once``: store equal channels once, and constant channels as numbers (:meth:`.Layout.of`).
    - ``normals``: leave out the third component of normals where it follows from the others.
    - ``components``: start from principal components, not from the ramp.
    - ``jitter``: share of the steps whose samples are jittered.
    - ``rounded``: share of the steps, the last ones, that read entries rounded to their stored values.
    - ``structure``: one of :data:`STRUCTURES`, or ``"auto"``; ``dims``: coordinates of a pointer.
    - ``weights``: name of a map → factor of its differences, wherever errors are compared; 1 for other maps.
    """

    steps: int = 1500
    batch: int = 2**18
    lr: float = 3e-2
    loss: str = "mse"
    measure_every: int = 150
    once: bool = True
    normals: bool = True
    components: bool = True
    jitter: float = 0.5
    rounded: float = 1.0
    structure: str = "auto"
    dims: int = 4
    weights: Mapping[str, float] = dataclasses.field(default_factory=dict)


#: Settings by preset; the first is the default.
PRESETS = {
    "ours": ImageSettings(),
    "paper": ImageSettings(
        steps=375, batch=2**20, lr=1e-3, schedule="constant", loss="mae", once=False, normals=False, components=False,
        jitter=1.0, rounded=0.0, structure="8 bits",
    ),
}  # fmt: skip

#: Largest weight of a map.
MOST_WEIGHT = 100

#: Improvements over the supplement that can be switched off: most are called like the setting that they change.
IMPROVEMENTS = {
    "once": "equal and constant channels are stored once",
    "normals": "normals as two channels where the third follows",
    "components": "arrays start from principal components",
    "jitter": "half of the samples at texel centres",
    "rounded": "training sees rounded entries",
    "structure": "pages, fewer bits an entry of the primary array, a second one for noisy images",
    "loss": "squared errors",
    "rate": "a higher rate that falls to zero",
    "batch": "steps of 262,144 samples",
}


def parse_weights(text: str) -> str | dict[str, float]:
    """Return ``"auto"``, ``"equal"``, or the numbers of ``MAP=W,…`` by the name of the map. Raises ``ValueError``."""
    if text in ("auto", "equal"):
        return text
    weights, allowed = {}, f"auto, equal, or maps with numbers from 0 to {MOST_WEIGHT} such as normal=2"
    for part in text.split(","):
        name, _, number = part.partition("=")
        try:
            weights[name.strip()] = float(number)
        except ValueError:
            weights[name.strip()] = 0.0
        if not 0 < weights[name.strip()] <= MOST_WEIGHT:
            raise ValueError(f'found "{part}", allowed are {allowed}')
    return weights


def without(settings: ImageSettings, names) -> ImageSettings:
    """Return ``settings`` with some of :data:`IMPROVEMENTS` switched off. Raises ``ValueError`` for an unknown name."""
    paper, changes = PRESETS["paper"], {}
    for name in names:
        if name not in IMPROVEMENTS:
            raise ValueError(f'found the improvement "{name}", allowed are {", ".join(IMPROVEMENTS)}')
        fields = ("lr", "schedule") if name == "rate" else (name,)
        changes |= {field: getattr(paper, field) for field in fields}
        if name == "batch":
            changes["steps"] = max(1, settings.steps // (paper.batch // settings.batch))
    return dataclasses.replace(settings, **changes)


class Image(Task):
    """Task of images; presets are :data:`PRESETS`, entries have 8 bits or fewer."""

    name = "image"
    title = "an image or the maps of a material"
    files = "arrays"
    section = "supplemental 1.3"
    example = "material.json --compression 12x"
    plugin = ("texture", "neural_image")
    presets = PRESETS
    storages = ()
    measurements = 10
    arguments = (
        SOURCE,
        *SIZES,
        Argument(
            "--ratio-search", action="store_true",
            help="choose sides, bits and dimensions of the arrays by short trainings",
        ),
        Argument(
            "--without", action="append", default=[], choices=list(IMPROVEMENTS),
            help="switch one of the improvements of our recipe off; may be repeated",
        ),
        Argument(
            "--structure", choices=["auto", *STRUCTURES],
            help="bits of an entry of one or two primary arrays, or pages (default: auto for ours, 8 bits for paper)",
        ),
        Argument("--dims", type=positive, choices=range(1, 5), help="dimensions of the cascaded array"),
        Argument(
            "--cascaded", type=positive, metavar="N", help="entries along each side of the cascaded array"
        ),
        Argument(
            "--ratio", type=between(1, 1024), metavar="N",
            help="for paper: side of the primary over side of the cascaded array (default: by size and compression)",
        ),
        Argument(
            "--weights", type=checked(parse_weights), metavar="equal|auto|MAP=W,…", default="equal",
            help="weight of each map's errors: equal (default), by what they do to a shaded picture (auto), or numbers",
        ),
        *SOURCES,
    )  # fmt: skip
    decode_arguments = DECODED

    def settings(self, preset, given, options):
        chosen = {name: options[name] for name in ("structure", "dims") if options[name] is not None}
        return self.change_settings(without(PRESETS[preset], options["without"]), {**chosen, **given})


TASK = Image()
