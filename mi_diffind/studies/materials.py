"""Contenders of studies of images and textures: maps of a material, by several methods in equal bytes.

Ours is trained by the default preset of a task. Its rivals are codecs (:mod:`.baselines.codecs`), and a hash grid with
a network, trained to convergence. All are measured by their *levels*: name of a map → images, finest first, of the
values in the source's files, clipped to the [0, 1] of 8-bit codecs.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import ClassVar

import numpy as np

from ..core.arguments import positive
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting.task import FitSettings
from ..maps.model import requested_border
from ..maps.pyramid import CompressedMaps, FilteredMaps, Pyramid, decibel
from ..maps.source import Source, load_source
from ..measure.study import Study
from ..measure.training import Contender, NetworkContender
from . import equal_memory
from .baselines import codecs, networks

#: Levels of the maps of a material by name.
Levels = dict[str, list[np.ndarray]]


class MaterialStudy(Study):
    """Base class of studies of the maps of an image or material; ``ratios`` are the default compression ratios."""

    example = "material.json"
    ratios = (12.0,)

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/tiles.json", metavar="IMAGE|MATERIAL.json",
            help="image, or maps of a material (default: scenes/assets/tiles.json)",
        )  # fmt: skip
        default = ", ".join(f"{ratio:g}x" for ratio in self.ratios)
        parser.add_argument("--compression", action="append", default=[], metavar="N",
                            help=f"compression ratio; may be repeated (default: {default}; --quick: 12x)")  # fmt: skip
        parser.add_argument("--seconds", type=positive, metavar="N",
                            help="seconds of each training of ours (default: steps of fit; --quick: 2)")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the source; raise as :func:`.load_source` does."""
        default = self.ratios[:1] if arguments.quick else self.ratios
        arguments.ratios = tuple(dict.fromkeys(map(parse_compression, arguments.compression))) or default
        arguments.loaded = load_source(arguments.source)

    @staticmethod
    def settings(arguments) -> SimpleNamespace:
        """Return the settings of contenders; ``network_steps``: of the first and of the longest training."""
        quick = arguments.quick
        return SimpleNamespace(
            compressions=arguments.ratios,
            seconds=arguments.seconds or (2 if quick else None),
            astc="fast" if quick else "thorough",  # "exhaustive" takes many times as long
            network_steps=(10, 20) if quick else (1000, 16000),
        )


# -- Levels ------------------------------------------------------------------------------------------------------------


def level_images(maps: CompressedMaps) -> Levels:
    """Return all levels of detail of maps, or the one of maps that have no others."""
    count = range(maps.levels) if isinstance(maps, FilteredMaps) else ()
    levels = [maps.decode(level=level) for level in count] or [maps.decode()]
    return {name: [np.clip(decoded[name], 0, 1) for decoded in levels] for name in maps.layout.names}


def level_pyramid(maps: Levels, like: Pyramid) -> Pyramid:
    """Return the pyramid of decoded levels, with the layout and border of ``like``."""
    levels = [np.zeros_like(values) for values in like.values]
    for m in like.layout.maps:
        for c, channel in enumerate(m.where):
            if isinstance(channel, int):
                for values, decoded_level in zip(levels, maps[m.name], strict=True):
                    values[..., channel] = m.encode(decoded_level[..., c])
    return Pyramid(like.layout, levels, like.types, like.border)


def level_errors(truth: Levels, maps: Levels) -> list[float]:
    """Return the PSNR of all channels of the maps of ``truth``, in dB, of each level at its texel centres."""
    mse = [
        [float(np.mean((a.astype(np.float64) - b) ** 2)) for a, b in zip(levels, maps[name], strict=True)]
        for name, levels in truth.items()
    ]
    mean = np.average(mse, axis=0, weights=[levels[0].shape[-1] for levels in truth.values()])
    return [decibel(float(e)) for e in mean]


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class MaterialContenders:
    """Contenders of a ``source``, read from the file ``name``.

    Subclasses name the ``task`` that trains ours, further ``options`` of it and the ``border`` of the maps, and define
    :meth:`record`.
    """

    source: Source
    name: str
    settings: SimpleNamespace

    task = ""
    options: ClassVar[dict] = {}
    border = "auto"

    def __post_init__(self):
        self.normals = [m.name for m in self.source.maps if m.role == "normal"]
        self.codecs = codecs.available() if all(m.channels <= 4 for m in self.source.maps) else ()
        self.encodings = {}  # of ASTC, shared by all ratios

    @cached_property
    def pyramid(self) -> Pyramid:
        """The uncompressed levels."""
        border = requested_border({"border": self.border})
        return Pyramid.from_source(self.source, types=array_module(), border=border)

    @cached_property
    def levels(self) -> Levels:
        """The uncompressed levels; components that others determine are computed from them."""
        return level_images(self.pyramid)

    @property
    def details(self) -> dict:
        """Source and settings, for the ``details`` of a result."""
        s = self.source
        sizes = {"source_digest": s.digest, "source_bytes": s.nbytes}
        return {"source": self.name, **sizes, "request": vars(self.settings)}

    @property
    def note(self) -> str:
        s = self.source
        return f"{self.name}, {s.width} × {s.height}, {len(s.maps)} map(s), {s.nbytes:,} bytes."

    def record(self, nbytes: int, seconds: float | None, levels: Levels, **details) -> dict:
        """Return the record of decoded levels in ``nbytes``, with their errors."""
        raise NotImplementedError

    def trained(self, compression: float) -> Contender:
        """Return the contender that the default preset of the task trains."""

        def fit(job: Contender, progress: bool) -> dict | None:
            arguments = {"source": self.name, "compression": compression, "seconds": self.settings.seconds,
                         "border": self.border, **self.options}  # fmt: skip
            trained = equal_memory.fit_preset(job, progress, self.task, "image", "", arguments)
            if trained is None:
                return None
            model, fitted = trained
            seconds, steps = fitted.result.seconds, fitted.result.steps
            return self.record(fitted.table.nbytes, seconds, level_images(model.image), steps=steps)

        name = f"ours {compression:g}x"
        return Contender(name, "ours", compression, fit, lambda job: equal_memory.open_preset(job, self.task).image)

    def astc(self, levels: Levels, nbytes: float, mip_maps: bool) -> dict[str, codecs.Encoded]:
        """Return the levels, always the same ones, in ASTC, with or without mip maps."""
        settings = self.settings.astc, self.normals, mip_maps, self.encodings
        return codecs.astc_levels(levels, nbytes, *settings)[0]

    def encoded(self, name: str, method: str, budget: float, encode: Callable[[], dict], label: str = "") -> Contender:
        """Return the contender of a codec; ``encode()`` returns the maps by name (:class:`.codecs.Encoded`)."""

        def fit(job: Contender, progress: bool) -> dict:
            maps = encode()
            how, nbytes = ", ".join(f"{n} {e.codec}" for n, e in maps.items()), sum(e.nbytes for e in maps.values())
            return self.record(nbytes, None, {n: e.levels for n, e in maps.items()}, how=how)

        def read(job: Contender) -> Pyramid:
            return level_pyramid({n: e.levels for n, e in encode().items()}, self.pyramid)

        return Contender(name, method, budget, fit, read, label, has_file=False)

    def network_contenders(self, levels: int) -> list[NetworkContender]:
        """Return, in a list, a network with the first ``levels`` of the pyramid; an empty list if bytes are too few.

        The network is in half precision; it has the bytes of the first compression ratio. Its model is the pyramid of
        its levels.
        """
        compression, (steps, longest) = self.settings.compressions[0], self.settings.network_steps
        try:
            net = networks.texture_network(self.pyramid.layout, self.source.nbytes / compression, levels)
        except ValueError:
            return []
        settings = FitSettings(steps=steps, batch=2**14, lr=1e-2, schedule="cosine", loss="mse", seed=1)

        def decode(trained) -> Levels:
            return level_images(networks.NetworkMaps(trained, self.pyramid))

        def finish(trained, trainings: dict) -> dict:
            seconds, details = sum(run["seconds"] for run in trainings["runs"]), {"steps_longest": longest}
            nbytes = 2 * trainings["entries"]
            return self.record(nbytes, seconds, decode(trained), steps=trainings["steps"], **details)

        return [NetworkContender(
            f"network {compression:g}x", "network", compression, "network", "",
            lambda trained: level_pyramid(decode(trained), self.pyramid),
            lambda: networks.TextureNetworkProblem(net, self.pyramid, self.source.digest), settings, longest, 5, True,
            finish,
        )]  # fmt: skip
