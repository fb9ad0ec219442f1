"""Ablation: contenders that leave out or change a part of our layout, in equal bytes.

The parts: the training, so that distances and normals stay as they were sampled; and indirection, so that the 16 bits
of a node hold its distance and normal, without frames and cascaded array (:mod:`..baselines.direct_nodes`).
"""

from __future__ import annotations

import time
from pathlib import Path

from ...fitting import task
from ...fitting.loop import FitResult, FitSettings, fit
from ...tasks.sdf.encoding import sample
from ...tasks.sdf.evaluation import HeldOut
from ...tasks.sdf.fit import NodeProblem
from ...tasks.sdf.nodes import SparseNodes
from ..baselines import volumes
from ..baselines.direct_nodes import DirectCoding, DirectNodes
from .contenders import DistanceContender, DistancePresetContender

#: Name of our preset.
SPARSE = "sparse"

#: Result of a training that is left out.
NO_TRAINING = FitResult({}, 0, 0, 0.0, False, 0)


def settings_of(context) -> FitSettings:
    """Return the settings by which ours is trained."""
    steps = {"steps": context.settings.steps} if context.settings.steps else {}
    return task.tasks()["sdf"].settings(SPARSE, {"deterministic": False, **steps}, {})


class UntrainedRequest(task.FitRequest):
    """Request of a fit without training: nodes keep their sampled values."""

    def train(self, problem, title: str | None = None) -> FitResult:
        return NO_TRAINING


class UntrainedContender(DistancePresetContender):
    """Our preset without training."""

    def fit(self, progress: bool) -> task.Fitted:
        sdf, arguments = task.tasks()["sdf"], self.arguments()
        options = {a.name: arguments.get(a.name, a.default) for a in sdf.arguments}
        request = UntrainedRequest(
            SPARSE, settings_of(self.context), self.context.types, options=options, progress=progress, output=self.file
        )
        return sdf.fit(request)


class DirectContender(DistanceContender):
    """A distance and a normal in the 16 bits of each node."""

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        context = self.context
        types, distances = context.types, context.distances
        start = time.perf_counter()
        coding = volumes.fit_bytes(lambda h: DirectCoding(sample(distances, h)), self.budget)
        structure = coding.sampled.structure
        held_out = HeldOut(distances, types, structure.spacing)
        nodes = SparseNodes(types, structure, 1.0)
        problem = NodeProblem(nodes, distances.surface, coding.sampled, coding.bits, held_out)
        result = NO_TRAINING
        if self.method == "direct":
            result = fit(problem, settings_of(context), progress=progress, title=self.name)
            if result.interrupted:
                return None
        coding.encode(problem.values())
        model = coding.field(types)
        file_bytes = volumes.save(self.file, model)
        return self.record(model, model.nbytes, time.perf_counter() - start, file_bytes, steps=result.steps)

    def load(self, path: Path) -> DirectNodes:
        return volumes.load(path, self.context.types, DirectNodes)


#: Method → class of its contender.
CONTENDERS = {"untrained": UntrainedContender, "direct": DirectContender, "direct-untrained": DirectContender}
