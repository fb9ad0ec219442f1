"""Settings of a training that every task shares. Importing this imports no Dr.Jit."""

from __future__ import annotations

import math
import numbers
from dataclasses import dataclass

from ..core.arguments import MOST
from ..core.arguments import MOST_NATURAL as MOST_SEED
from ..core.errors import DiffindError
from ..core.units import check_memory

#: Memory that a step takes for each sample of its batch, in bytes: 4 to 80 were measured.
SAMPLE_BYTES = 64

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
            value, most = getattr(self, name), MOST_SEED if name == "seed" else MOST
            if isinstance(value, bool) or not isinstance(value, numbers.Integral):
                raise FittingError(f"{name}: found {value!r:.40}, a whole number is needed")
            if value < low:
                raise FittingError(f"{name}: found {value}, at least {low} is needed")
            if value > most:
                raise FittingError(f"{name}: found {value!s:.40}, at most {most:,} is allowed")
        if not (isinstance(self.lr, numbers.Real) and math.isfinite(self.lr) and self.lr > 0):
            raise FittingError(f"lr: found {self.lr}, a positive number is needed")
        if self.schedule not in SCHEDULES:
            raise FittingError(f'schedule: found "{self.schedule}", allowed are {SCHEDULES}')
        if self.loss not in LOSSES:
            raise FittingError(f'loss: found "{self.loss}", allowed are {LOSSES}')


def within_memory(settings: FitSettings) -> FitSettings:
    """Return the settings. Raises :class:`.UsageError` if their batch exceeds this machine's memory.

    Dr.Jit ends the process where memory cannot be allocated.
    """
    check_memory("batch", settings.batch, SAMPLE_BYTES * settings.batch)
    return settings
