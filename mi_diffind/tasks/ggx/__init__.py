"""Task 1: the isotropic GGX distribution of normals (:mod:`.model`, :mod:`.training`)."""

import argparse
from dataclasses import asdict

from ...fitting.task import Argument, FitRequest, FitSettings, Task


def _side(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 2 <= value <= 4096:
        raise argparse.ArgumentTypeError(f"found {text}, allowed are 2 to 4096 entries a side")
    return value


class GGX(Task):
    """The task; :mod:`.model` explains its presets."""

    name = "ggx"
    title = "the GGX distribution of normals"
    section = "supplemental 1.1"
    plugin = ("bsdf", "neural_ggx")
    presets = {  # noqa: RUF012
        "tables": FitSettings(steps=4000, batch=65536, lr=1e-2, schedule="cosine", seed=1),
        "paper": FitSettings(steps=3000, batch=65536, lr=1e-3, schedule="constant", seed=1),
    }
    files = "training"
    shipped = {"tables": "ggx_tables.npz", "paper": "ggx_paper.npz"}  # noqa: RUF012
    arguments = tuple(
        Argument(
            f"--{name}", type=_side, default=side, metavar="N",
            help=f"entries along each side of the {name} array (default: {side})",
        )
        for name, side in (("primary", 16), ("cascaded", 8))
    )  # fmt: skip

    def problem(self, request: FitRequest):
        from .model import indirection
        from .training import GGXProblem

        net = indirection(request.options["primary"], request.options["cascaded"])
        return GGXProblem(net.alloc(request.types.TensorXf), request.types, request.preset)

    def table(self, problem, request: FitRequest):
        from ...arrays.tables import StoredArray, Table

        net = problem.net
        arrays = {"primary": StoredArray.of(net.primary[0]), "cascaded": StoredArray.of(net.cascaded)}
        return Table(self.name, arrays, settings=asdict(problem.encoding))

    def allocate(self, table, dtype, storage=""):
        arrays = super().allocate(table, dtype, storage)
        arrays["primary"].folded = arrays["primary"].storage == "float32"  # an optimiser may leave the range
        return arrays


TASK = GGX()
