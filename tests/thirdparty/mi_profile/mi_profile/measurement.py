"""The truth: intensities of a luminaire over the angle from its axis, as a file has them."""

from __future__ import annotations

import csv
import hashlib
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_diffind.core.errors import DiffindError


class ProfileError(DiffindError):
    """A file of a profile cannot be used; the message is one sentence that names it and the fault."""


@dataclass(frozen=True)
class Measurement:
    """``intensity`` in cd at equally spaced angles from 0° to 90° from the axis, float64, and linear in between;
    ``digest`` tells whether another one is the same.
    """

    intensity: np.ndarray

    @property
    def peak(self) -> float:
        """The largest intensity, in cd."""
        return float(self.intensity.max())

    @property
    def relative(self) -> np.ndarray:
        """Intensities relative to the peak, float32, as tables hold them."""
        return (self.intensity / self.peak).astype(np.float32)

    @property
    def digest(self) -> str:
        return hashlib.sha256(self.intensity.astype("<f8").tobytes()).hexdigest()[:16]


def read(path: str | os.PathLike) -> Measurement:
    """Read a CSV file of two columns, ``angle_deg,intensity_cd``, that may have comments (``#``). Raises
    :class:`ProfileError`.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise ProfileError(f"{path}: cannot be read ({getattr(e, 'strerror', None) or 'not a text'})") from None
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    rows = list(csv.reader(lines))
    if not rows or rows[0] != ["angle_deg", "intensity_cd"]:
        found = ",".join(rows[0])[:40] if rows else "nothing"
        raise ProfileError(f'{path}: begins with "{found}", the columns have to be angle_deg,intensity_cd')
    try:
        angles, intensity = np.array([[float(a), float(i)] for a, i in rows[1:]]).T
    except ValueError:
        raise ProfileError(f"{path}: has a line that is not two numbers") from None
    if len(angles) < 2 or not np.allclose(angles, np.linspace(0, 90, len(angles)), atol=1e-6):
        raise ProfileError(f"{path}: the angles have to go from 0 to 90 in equal steps")
    if not all(map(math.isfinite, intensity)) or intensity.min() < 0 or intensity.max() <= 0:
        raise ProfileError(f"{path}: intensities have to be finite and not negative, and one of them positive")
    return Measurement(intensity)


def write(path: str | os.PathLike, angles: np.ndarray, intensity: np.ndarray) -> None:
    """Write such a file, in one piece. Raises :class:`.OutputError`."""
    from mi_diffind.core.files import replacing

    rows = [f"{a:g},{i:.6g}" for a, i in zip(angles, intensity, strict=True)]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(["angle_deg,intensity_cd", *rows]) + "\n", encoding="utf-8")
