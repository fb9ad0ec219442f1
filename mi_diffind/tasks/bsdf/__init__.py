"""Learned BSDFs: any reflecting BSDF as an analytic proxy times a learned residual.

- :mod:`.model`: the form of a learned BSDF, its proxy and coordinates;
- :mod:`.truth`: sources: plugins of Mitsuba, scenes, measured files; :mod:`.symmetry`: symmetries, measured;
- :mod:`.pool`: directions at which a source is sampled; :mod:`.view`: the picture that measures;
- :mod:`.training`: samples, proxy and residual; :mod:`.fit`: ``fit bsdf``;
- :mod:`.mixture`: importance sampling; :mod:`.energy`: the limit of the albedo; :mod:`.files`: table files;
- :mod:`.family`: BSDFs that depend on parameters, :mod:`.family_truth`, :mod:`.family_fit`, :mod:`.family_sampling` and
  :mod:`.family_files`: their sources, training, sampling and files.
"""

from __future__ import annotations

import argparse

from ...arguments import Argument, checked
from ...settings import FitSettings
from ...task import Task
from ...units import parse_bytes


def _coordinate(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, a number is needed") from None


def _range(text: str) -> tuple[str, tuple[float, float]]:
    name, _, ends = text.partition("=")
    low, _, high = ends.partition(":")
    try:
        return name, (float(low), float(high))
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected NAME=LOW:HIGH, as in roughness=0.05:1") from None


class BSDFTask(Task):
    """The task. ``ours``: proxy × indirection; ``table``: proxy × one array; ``paper``: indirection alone."""

    name = "bsdf"
    title = "any reflecting BSDF"
    example = "scene.xml --material wood"
    plugin = ("bsdf", "neural_bsdf")
    presets = {  # noqa: RUF012
        name: FitSettings(steps=1500, batch=2**14, lr=2e-2, schedule="cosine", seed=1, measure_every=150)
        for name in ("ours", "table", "paper")
    }
    storages = ()
    arguments = (
        Argument("source", metavar="SOURCE", help="scene or BSDF (.xml), or measured file (.bsdf, .pbsdf, .binary)"),
        Argument("--material", default="", metavar="ID", help="id of a BSDF of the scene"),
        Argument(
            "--uv", nargs=2, type=_coordinate, default=(0.5, 0.5), metavar=("U", "V"),
            help="point of the textures at which the BSDF is fitted (default: 0.5 0.5)",
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
    )  # fmt: skip

    def fit(self, request):
        if not request.options["over"]:
            return super().fit(request)
        from .family_fit import fit_family

        return fit_family(request)

    def load(self, path):
        from ...tables import load_table

        if "family" not in load_table(path, self.name).settings:
            return super().load(path)
        from .family_files import load

        return load(path)

    def model(self, table, dtype, storage=""):
        if "family" not in table.settings:
            return super().model(table, dtype, storage)
        from .family_files import FamilyModel

        return FamilyModel(table, self.allocate(table, dtype, storage), dtype, storage)


TASK = BSDFTask()
