"""Meshes of a Mitsuba scene file, in the world."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core import compat
from ...core.runtime import use_variant


def read(path: Path, name: str = "") -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the meshes of a scene, or the one whose id is ``name``: vertices ``(V, 3)`` and faces ``(F, 3)``.

    The scene is loaded in the variant that is set. Raises ``ValueError`` for another name, and ``RuntimeError`` as
    Mitsuba does.
    """
    use_variant()
    import mitsuba as mi

    shapes = [shape for shape in mi.load_file(str(path), optimize=False).shapes() if shape.is_mesh()]
    chosen = [shape for shape in shapes if name in ("", shape.id())]
    if not chosen:
        names = ", ".join(f'"{shape.id()}"' for shape in shapes) or "none"
        raise ValueError(f'holds no mesh "{name}", found {names}')
    return [compat.triangles(shape) for shape in chosen]
