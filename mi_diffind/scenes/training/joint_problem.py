"""Joint training problem of several textures, with the arrays of all of them."""

from __future__ import annotations

from collections.abc import Mapping

from drjit import nn

from ...arrays.indirection import DifferentiableArray
from ...fitting.loop import Problem
from ...tasks.texture.training import TextureProblem


def array_name(texture: str, array: str) -> str:
    """Return the name of an array of one of several textures."""
    return f"{texture}/{array}"


class JointNet(nn.Module):
    """Arrays of several textures; ``names`` are those of the textures, ``nets`` read their arrays."""

    DRJIT_STRUCT = {"nets": tuple, "names": object}  # noqa: RUF012

    def __init__(self, nets=(), names: tuple[str, ...] = ()):
        self.nets, self.names = tuple(nets), names

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name (:func:`array_name`)."""
        pairs = zip(self.names, self.nets, strict=True)
        return {array_name(name, key): array for name, net in pairs for key, array in net.arrays.items()}

    def changed(self, change) -> JointNet:
        """Return a copy with ``change(array, bits)`` in place of each array."""
        return JointNet([net.changed(change) for net in self.nets], self.names)


class JointProblem(Problem):
    """Training problem of several textures, by name: the sum of their losses.

    As the maps of one file, each texture has a share of the loss and of the samples: that of its stored channels.
    """

    def __init__(self, problems: Mapping[str, TextureProblem]):
        self.problems = list(problems.values())
        self.net = JointNet([problem.net for problem in self.problems], tuple(problems))
        channels = [problem.pyramid.layout.stored for problem in self.problems]
        self.shares = [count / sum(channels) for count in channels]
        identities = {name: problem.identity for name, problem in problems.items()}
        self.identity = {"source": [i["source"] for i in identities.values()], "textures": identities}

    def begin(self, step: int, share: float) -> str:
        """Start a step of each texture."""
        return ", ".join(problem.begin(step, share) for problem in self.problems)

    def loss(self, net: JointNet, rng, size: int) -> list:
        """Return the losses of all textures, each with its share of ``size`` samples."""
        parts = zip(self.problems, self.shares, net.nets, strict=True)
        return [
            share * values
            for problem, share, part in parts
            for values in problem.loss(part, rng, max(1, round(share * size)))
        ]

    def seen(self, net: JointNet) -> JointNet:
        """Return the folded arrays as training reads them (:meth:`.TextureProblem.seen`)."""
        pairs = zip(self.problems, net.nets, strict=True)
        return JointNet([problem.seen(part) for problem, part in pairs], net.names)

    def measure(self, net: JointNet) -> dict[str, float]:
        """Return the figures of each texture (:meth:`.TextureProblem.measure`), their names behind its own."""
        parts = zip(net.names, self.problems, net.nets, strict=True)
        return {f"{name}_{key}": v for name, problem, part in parts for key, v in problem.measure(part).items()}
