"""The task as it declares itself. Light to import: what trains and reads is imported by the methods."""

from __future__ import annotations

import os
from pathlib import Path

from mi_diffind.core.arguments import Argument, positive
from mi_diffind.core.errors import UsageError
from mi_diffind.fitting.task import FitRequest, FitSettings, Task

_FIT = FitSettings(steps=600, batch=4096, lr=3e-2, loss="mse", seed=1)

#: Entries of the primary and of the cascaded array of each preset.
SIZES = {"default": (16, 64), "small": (8, 24)}


class Profile(Task):
    """How bright a luminaire is over the angle from its axis."""

    name = "profile"
    title = "a goniometric profile"
    presets = dict.fromkeys(SIZES, _FIT)
    arguments = (Argument("source", metavar="PROFILE.csv", help="angles from the axis, and intensities"),)
    decode_arguments = (
        Argument("--samples", type=positive, metavar="N", help="number of angles from 0° to 90° (default: 181)"),
    )

    def check(self, request: FitRequest) -> None:
        if request.options["source"] is None:
            raise UsageError("source: not given, a file of angles and intensities is needed")

    def problem(self, request: FitRequest):
        from . import measurement
        from .training import ProfileProblem, arrays

        truth = measurement.read(request.options["source"])
        return ProfileProblem(arrays(*SIZES[request.preset]).alloc(request.types.TensorXf), truth, request.types)

    def table(self, problem, request: FitRequest):
        from mi_diffind.arrays.tables import StoredArray, Table

        folder = (request.output or Path("x")).resolve().parent
        about = {
            "peak_cd": problem.truth.peak,
            "source": problem.truth.digest,
            "source_path": os.path.relpath(Path(request.options["source"]).resolve(), folder),
        }
        net = problem.net
        stored = {"primary": StoredArray.of(net.primary[0]), "cascaded": StoredArray.of(net.cascaded)}
        return Table(self.name, stored, settings=about, path=folder / (request.output or Path("x")).name)

    def load(self, path):
        from mi_diffind.arrays.tables import TableError, check_ranges, load_table

        table = load_table(path, self.name, {"primary": (None, 1), "cascaded": (None, 1)})
        check_ranges(table, {"primary": (0.0, 1.0)})
        peak = table.settings.get("peak_cd")
        if not isinstance(peak, float) or peak <= 0:
            raise TableError(f"{path}: its settings name no peak, found {peak!r}")
        return table


TASK = Profile()
