"""
Task 6: signed distance fields of meshes.

- :mod:`.mesh`, :mod:`.distances`, :mod:`.samples`: the truth;
- :mod:`.field`: what every field offers; :mod:`.nodes` (with :mod:`.structure`, :mod:`.codes`), :mod:`.pair`: ours and
  the supplement's;
- :mod:`.encoding`, :mod:`.training`, :mod:`.fit`, :mod:`.presets`: how they come about;
- :mod:`.tracing`, :mod:`.decode`, :mod:`.evaluation`: where rays meet them, as meshes and grids, how good they are;
- :mod:`.files`, :mod:`.model`: the result, as a file.
"""

from __future__ import annotations

import dataclasses

from ... import units
from ...arguments import Argument, between, checked, positive
from ...errors import UsageError
from ...task import FitRequest, Task
from .presets import PRESETS

#: Bits of a pointer that go into words evenly (:data:`.codes.POINTERS`, without importing Dr.Jit).
BITS = (4, 5, 6, 8, 10, 16)


class Sdf(Task):
    """The task. Its presets are the recipes of :mod:`.presets`; files are always stored as bytes."""

    name = "sdf"
    title = "the signed distance field of a mesh"
    section = "supplemental 1.6"
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    arguments = (
        Argument("source", metavar="MESH", help="a mesh that trimesh reads: ply, obj, stl, off, glb, …"),
        Argument(
            "--bytes", type=checked(units.parse_bytes), metavar="N",
            help="size in memory, as in 256k or 1.5M (default: 1M)",
        ),
        Argument(
            "--bits", type=int, choices=BITS, default=10,
            help="bits of a pointer of the sparse layout (default: 10)",
        ),
        Argument("--ratio", type=between(1, 16), help="of dense and paper: primary's side over cascaded array's side"),
        Argument(
            "--constant", action="store_true",
            help="of paper: begin with a constant cascaded array, not with the nearest samples",
        ),
    )  # fmt: skip
    decode_arguments = (
        Argument(
            "--resolution", type=positive, metavar="N", help="cells along the longest side (default: finer than it)"
        ),
    )

    def settings(self, preset, given, options):
        own = self.presets[preset]
        steps = given.get("steps", own.steps)
        return dataclasses.replace(own, measure_every=max(1, steps // 4), **given)

    def check(self, request: FitRequest) -> None:
        from .fit import asked_bytes

        options = request.options
        if options["source"] is None:
            raise UsageError("source: not given, a mesh is needed")
        asked_bytes(options)
        if options["constant"] and request.preset != "paper":
            raise UsageError(f"--constant is of the preset paper, found {request.preset}")
        if options["ratio"] is not None and PRESETS[request.preset].layout != "pair":
            raise UsageError(f"--ratio is of the presets dense and paper, found {request.preset}")

    def allocate(self, table, dtype, storage=""):
        return super().allocate(table, dtype, storage) if table.settings["layout"] == "pair" else {}

    def model(self, table, dtype, storage=""):
        return self.model_class()(table, self.allocate(table, dtype, storage), dtype, storage)


TASK = Sdf()
