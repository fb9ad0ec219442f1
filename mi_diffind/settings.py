"""Settings of a training that every task shares. Importing this imports no Dr.Jit."""

from __future__ import annotations

import math
from dataclasses import dataclass

from .errors import DiffindError

SCHEDULES = ("constant", "cosine", "plateau")
LOSSES = ("mae", "mse")


class FittingError(DiffindError, RuntimeError):
    """A training cannot go on; the message is one sentence."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of a training.

    ``lr`` is Adam's learning rate; ``schedule`` changes it: ``"constant"``, ``"cosine"`` (to zero) or ``"plateau"``
    (halved when the loss has not improved for a tenth of the steps). ``measure_every`` and ``check_every`` are the
    numbers of steps between two measurements and between two checks of the loss.

    With ``deterministic``, the same settings give the same bytes: the LLVM backend then trains on one core, because the
    last digits of a sum over several cores depend on their order. It has no effect on CUDA, which sums by atomics.
    """

    steps: int = 2000
    batch: int = 65536
    lr: float = 1e-3
    schedule: str = "cosine"
    loss: str = "mae"
    seed: int = 0
    measure_every: int = 200
    check_every: int = 20
    deterministic: bool = True

    def __post_init__(self):
        for name, low in (("steps", 1), ("batch", 1), ("measure_every", 1), ("check_every", 1), ("seed", 0)):
            if getattr(self, name) < low:
                raise FittingError(f"{name}: found {getattr(self, name)}, at least {low} is needed")
        if not (math.isfinite(self.lr) and self.lr > 0):
            raise FittingError(f"lr: found {self.lr}, a positive number is needed")
        if self.schedule not in SCHEDULES:
            raise FittingError(f'schedule: found "{self.schedule}", allowed are {SCHEDULES}')
        if self.loss not in LOSSES:
            raise FittingError(f'loss: found "{self.loss}", allowed are {LOSSES}')
