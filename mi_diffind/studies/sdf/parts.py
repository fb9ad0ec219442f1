"""
What the parts of our layout are worth, in equal bytes: other bits of a pointer; distances and normals as they were
sampled, not trained; and all of these in 16 bits of each node, without frames and cascaded array
(:mod:`..baselines.direct_nodes`).
"""

from __future__ import annotations

import time
from pathlib import Path

from ... import task
from ...fitting import FitResult, FitSettings, fit
from ...tasks.sdf.encoding import sample
from ...tasks.sdf.evaluation import HeldOut
from ...tasks.sdf.fit import NodeProblem
from ...tasks.sdf.nodes import SparseNodes
from ..baselines import volumes
from ..baselines.direct_nodes import DirectCoding, DirectNodes
from .plan import DistanceContender, Fitted

#: Our preset.
SPARSE = "sparse"

#: The result of no training.
NOTHING = FitResult({}, 0, 0, 0.0, False, 0)


def settings_of(setting) -> FitSettings:
    """How ours is trained."""
    steps = {"steps": setting.request.steps} if setting.request.steps else {}
    return task.tasks()["sdf"].settings(SPARSE, {"deterministic": False, **steps}, {})


# -- ours, trained in other ways --------------------------------------------------------------------------------------


class Untrained(task.FitRequest):
    """The nodes stay what they begin with."""

    def train(self, problem, title: str | None = None) -> FitResult:
        return NOTHING


class Changed(Fitted):
    """By our preset, trained as a request of another class has it."""

    def fit(self, progress: bool) -> task.Fitted:
        own, given = task.tasks()["sdf"], self.arguments()
        options = {a.name: given.get(a.name, a.default) for a in own.arguments}
        request = Untrained(
            SPARSE, settings_of(self.context), self.context.types, options=options, progress=progress, output=self.file
        )
        return own.fit(request)


# -- nodes that hold it all -------------------------------------------------------------------------------------------


class Direct(DistanceContender):
    """A distance and a normal a node."""

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        setting = self.context
        types, distances = setting.types, setting.distances
        start = time.perf_counter()
        coding = volumes.fitted(lambda h: DirectCoding(sample(distances, h)), self.budget)
        structure = coding.sampled.structure
        held_out = HeldOut(distances, types, structure.spacing)
        nodes = SparseNodes(types, structure, 1.0)
        problem = NodeProblem(nodes, distances.surface, coding.sampled, coding.bits, held_out)
        result = NOTHING
        if self.method == "direct":
            result = fit(problem, settings_of(setting), progress=progress, title=self.name)
            if result.interrupted:
                return None
        coding.encode(problem.values())
        found = coding.field(types)
        if self.file:
            volumes.save(self.file, found)
        seconds = time.perf_counter() - start
        return self.record(found, found.nbytes, seconds, volumes.file_bytes(found), steps=result.steps)

    def load(self, path: Path) -> DirectNodes:
        return volumes.load(path, self.context.types, DirectNodes)


#: Kind → what makes it.
MADE = {"untrained": Changed, "direct": Direct, "direct-untrained": Direct}
