"""Generated materials of ``tradeoff shading``."""

import numpy as np
import pytest

from mi_diffind.studies import example_maps


def test_generated_materials():
    """They repeat, have unit normals and are what they are called."""
    for name in example_maps.MATERIALS:
        found = {m.name: m for m in example_maps.generated_source(name, 64).maps}
        normal = 2 * found["normal"].values - 1
        assert np.linalg.norm(normal, axis=-1) == pytest.approx(1, abs=0.02)
        assert found["albedo"].color_space == "srgb" and found["albedo"].values.std() > 0.02
        for axis in (0, 1):
            inside = np.abs(np.diff(normal, axis=axis)).mean()
            across = np.abs(np.take(normal, 0, axis) - np.take(normal, -1, axis)).mean()
            assert across < 1.5 * inside
        assert ("metallic" in found) == (name == "hammered")
    assert example_maps.generated_source("lacquer", 64).digest == example_maps.generated_source("lacquer", 64).digest
    assert {m.name: m.values.mean() for m in example_maps.generated_source("lacquer", 64).maps}["roughness"] < 0.35
