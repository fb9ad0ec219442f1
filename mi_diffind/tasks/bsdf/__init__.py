"""Learned BSDFs: any reflecting BSDF as an analytic proxy times a learned residual.

- :mod:`.model`: the form of a learned BSDF, and of a family that depends on parameters;
- :mod:`.truth`: sources: plugins of Mitsuba, scenes, measured files; :mod:`.measured`: symmetries, spectra, rows;
  :mod:`.functions`: Python functions and networks; :mod:`.pairs`: the error that symmetries impose on measurements;
- :mod:`.directions`: directions at which a source is sampled, and the picture that measures;
- :mod:`.training`: samples, proxy and residual; :mod:`.fit`: ``fit bsdf``; :mod:`.library`: many sources at once;
- :mod:`.mixture`: importance sampling; :mod:`.energy`: the limit of the albedo;
- :mod:`.files`: table files; :mod:`.evaluation`: errors against a source, and other formats.
"""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path

from ...core.arguments import WORKER_ARGUMENTS, Argument, between, checked, natural, positive
from ...core.units import parse_bytes
from ...fitting.task import FitRequest, FitSettings, Fitted, Task, table_path


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, _, ends = text.partition("=")
    low, _, high = ends.partition(":")
    try:
        return name, (float(low), float(high))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected NAME=LOW:HIGH, as in roughness=0.05:1") from None


class BSDFTask(Task):
    """The task.

    ``ours``: proxy × indirection; ``table``: proxy × one array; ``paper``: indirection alone; ``plain``: one array.
    """

    name = "bsdf"
    title = "any reflecting BSDF"
    example = "scene.xml --material wood"
    plugin = ("bsdf", "neural_bsdf")
    presets = {  # noqa: RUF012
        name: FitSettings(steps=1500, batch=2**14, lr=2e-2, schedule="cosine", seed=1, measure_every=150)
        for name in ("ours", "table", "paper", "plain")
    }
    storages = ()
    arguments = (
        Argument(
            "source", file="read", metavar="SOURCE",
            help="scene or BSDF (.xml), measured file (.bsdf, .pbsdf, .mbsdf, .binary), table of measurements (.csv), "
            "networks of Neural-BRDF (.npz), a folder of such files, or a Python function (module:function)",
        ),
        Argument(
            "--material", default="", metavar="ID", help="id of a BSDF of the scene, or name of a network; all: each"
        ),
        Argument(
            "--uv", nargs=2, type=between(-math.inf, math.inf), default=(0.5, 0.5), metavar=("U", "V"),
            help="point of the textures at which the BSDF is fitted (default: 0.5 0.5)",
        ),
        Argument(
            "--illuminant", choices=("D65", "E"), default="D65",
            help="light in which spectra of measured files have their colours (default: D65)",
        ),
        Argument(
            "--angles", choices=("degrees", "radians"), default="",
            help="unit of the angles of a .csv file (default: degrees, if any is above 2π)",
        ),
        Argument(
            "--bytes", type=checked(parse_bytes), metavar="SIZE",
            help="size of the residual's arrays (default: 2k; of families of 1, 2 and 3 parameters 4k, 9k and 12k)",
        ),
        Argument(
            "--over", nargs="+", type=_range, metavar="NAME=LOW:HIGH",
            help="fit a family over up to three parameters of the source, such as roughness=0.05:1 metallic=0:1",
        ),
        Argument(
            "--energy", choices=("source", "raw"), default="source",
            help="limit the albedo to the source's, or leave it as it was fitted (default: source)",
        ),
        *WORKER_ARGUMENTS,
    )  # fmt: skip
    decode_arguments = (
        Argument("--rows", type=positive, metavar="N", help="rows of a .csv file (default: 10000)"),
        Argument("--seed", type=natural, help="seed of the random directions of a .csv file (default: 0)"),
    )

    def output_path(self, path: str | os.PathLike) -> Path:
        """Return the path of the output: a table file, or a folder for a library, which exists or has no extension."""
        is_folder = Path(path).is_dir() or not Path(path).suffix
        return Path(path).absolute() if is_folder else table_path(path)

    def check(self, request: FitRequest) -> None:
        super().check(request)
        from .library import check

        check(request)

    def fit(self, request: FitRequest) -> Fitted:
        """Fit a BSDF, a family, or all BSDFs of a library."""
        from .library import fit_library, is_library

        return fit_library(request) if is_library(request) else super().fit(request)

    def usage(self, table, file):
        lines = super().usage(table, file)
        for parameter in table.settings.get("family", ()):
            low, high = parameter["low"], parameter["high"]
            comment = f"<!-- or a texture, {low:g} to {high:g} -->"
            lines.insert(-1, f'    <float name="{parameter["name"]}" value="{low:g}"/>  {comment}')
        return lines


TASK = BSDFTask()
