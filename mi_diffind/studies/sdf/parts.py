"""
What the parts of our layout are worth, in equal bytes: other bits of a pointer; pointers that are all decided on at the
end; distances and normals as they were sampled, not trained; and all of these in 16 bits of each node, without frames
and cascaded array (:mod:`..baselines.direct_nodes`).
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from ... import task
from ...fitting import FitResult, FitSettings, fit
from ...tasks.sdf import training
from ...tasks.sdf.encoding import sample
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


class AtOnce(task.FitRequest):
    """No node has a code until the end of the training."""

    def train(self, problem, title: str | None = None) -> FitResult:
        problem.stage = len(training.COMMITTED)
        return super().train(problem, title)


class Untrained(task.FitRequest):
    """The nodes stay what they begin with."""

    def train(self, problem, title: str | None = None) -> FitResult:
        return NOTHING


class Changed(Fitted):
    """By our preset, trained as a request of another class has it."""

    def fit(self, progress: bool) -> task.Fitted:
        own, given = task.tasks()["sdf"], self.arguments()
        options = {a.name: given.get(a.name, a.default) for a in own.arguments}
        request = REQUESTS[self.method](
            SPARSE, settings_of(self.context), self.context.types, options=options, progress=progress, output=self.file
        )
        return own.fit(request)


REQUESTS = {"at-once": AtOnce, "untrained": Untrained}

# -- nodes that hold it all -------------------------------------------------------------------------------------------


class Direct(DistanceContender):
    """A distance and a normal a node."""

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        setting = self.context
        types, distances = setting.types, setting.distances
        start = time.perf_counter()
        coding = volumes.fitted(lambda h: DirectCoding(sample(distances, h)), self.budget)
        structure = coding.sampled.structure
        held_out = training.HeldOut(distances, types, structure.spacing)
        problem = training.NodeProblem(SparseNodes(types, structure, 1.0), distances.surface, coding, held_out)
        result = NOTHING
        if self.method == "direct":
            result = fit(problem, settings_of(setting), progress=progress, title=self.name)
            if result.interrupted:
                return None
        coding.commit(problem.net.unit(types).numpy().astype(np.float64), 1.0)
        found = coding.field(types)
        if self.file:
            volumes.save(self.file, found)
        seconds = time.perf_counter() - start
        return self.record(found, found.nbytes, seconds, volumes.file_bytes(found), steps=result.steps)

    def load(self, path: Path) -> DirectNodes:
        return volumes.load(path, self.context.types, DirectNodes)


#: Kind → what makes it.
MADE = {"at-once": Changed, "untrained": Changed, "direct": Direct, "direct-untrained": Direct}
