"""Write ``data/downlight.csv``: intensities of a downlight that does not exist, over the angle from its axis. They are
the values of a formula, in the public domain (CC0): a reflector's lobe with a ripple, its cut-off, and stray light.

    python -m mi_profile.make_downlight
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

FILE = Path(__file__).resolve().parent / "data" / "downlight.csv"


def downlight(degrees: np.ndarray) -> np.ndarray:
    """Intensities, in cd."""
    angle = np.radians(degrees)
    lobe = 1450 * np.cos(angle) ** 3 * (1 + 0.06 * np.cos(22 * angle))
    cut_off = 1 / (1 + np.exp((degrees - 41) / 1.3))
    stray = 35 * np.cos(angle) ** 0.7 * np.exp(-(((degrees - 58) / 17) ** 2))
    return np.maximum(lobe * cut_off + stray, 0)


def main() -> None:
    """Write the file."""
    degrees = np.linspace(0, 90, 181)
    rows = [f"{a:g},{i:.3f}" for a, i in zip(degrees, downlight(degrees), strict=True)]
    FILE.write_text("\n".join(["# made by make_downlight.py, CC0", "angle_deg,intensity_cd", *rows]) + "\n")


if __name__ == "__main__":
    main()
