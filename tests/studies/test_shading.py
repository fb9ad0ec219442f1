"""Generated materials of ``tradeoff shading``."""

import numpy as np
import pytest

from mi_diffind.maps.source import load_source
from mi_diffind.studies.example_maps import MATERIALS, example_maps


def test_generated_materials():
    """They repeat, have unit normals and are what they are called."""
    for name in MATERIALS:
        found = {m.name: m for m in load_source(example_maps(name, 64)).maps}
        normal = 2 * found["normal"].values - 1
        assert np.linalg.norm(normal, axis=-1) == pytest.approx(1, abs=0.02)
        assert found["albedo"].color_space == "srgb" and found["albedo"].values.std() > 0.02
        for axis in (0, 1):
            inside = np.abs(np.diff(normal, axis=axis)).mean()
            across = np.abs(np.take(normal, 0, axis) - np.take(normal, -1, axis)).mean()
            assert across < 1.5 * inside
        assert ("metallic" in found) == (name == "hammered")
    lacquer = load_source(example_maps("lacquer", 64))
    assert load_source(example_maps("lacquer", 64)).digest == lacquer.digest
    assert {m.name: m.values.mean() for m in lacquer.maps}["roughness"] < 0.35
