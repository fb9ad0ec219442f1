"""How to train: settings that every task shares. Free of Dr.Jit, so that a command line can name the defaults."""

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
    """
    How to train. ``lr`` is Adam's learning rate, ``schedule`` its course: ``"constant"``, ``"cosine"`` (to zero) or
    ``"plateau"`` (halved when the loss has not improved for a tenth of the steps). ``measure_every`` and
    ``check_every`` are numbers of steps between measurements and between looks at the loss.

    With ``deterministic``, the same settings give the same bytes: the LLVM backend then trains on one core, since
    the sums that several make together depend on who comes first (in their last digits). No effect on CUDA, where
    sums are made by atomics.
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
