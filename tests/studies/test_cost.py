"""Study of cost: scenes, steps, sizes and the order of passes of each row."""

import mitsuba as mi
import numpy as np
import pytest

from mi_diffind import inspect
from mi_diffind.studies import cost

SMALL = cost.CostSettings(1, 1, 16, 8)

#: The rows, and a scene under a sun, whose floor and objects have the materials of a row.
BOTH = {name: {"floor": bsdf, "objects": bsdf} for name, bsdf in cost.ROWS["image"].contenders.items()}
ROWS = cost.ROWS | {"sunlit": cost.Row("sunlit", "scene", BOTH, r".*(data|tables\..*)", light="sun")}


@pytest.mark.long
@pytest.mark.parametrize("name", ROWS)
def test_rows(name, mi_rgb):
    """Contenders of a row show the same scene; each has a step, whose derivatives are finite and not all zero."""
    row = ROWS[name]
    images = {}
    for contender in row.contenders:
        assert row.reference(contender) in row.contenders
        scene = cost.load_scene(row, contender, False, SMALL)
        images[contender] = np.array(mi.render(scene, spp=64, seed=1))
        if contender != "neural_sdf, decoded":  # decodes a second time
            step = cost._step(cost.load_scene(row, contender, True, SMALL), row.keys)
            derivatives = [np.array(d).ravel() for d in step(1, mi.UInt32(3))]
            assert all(np.isfinite(d).all() for d in derivatives) and any(np.any(d) for d in derivatives), contender
    for contender, image in images.items():
        reference = images[row.reference(contender)]
        allowed = 0.3 if "paper" in contender else 0.2  # tables of materials filter tiny films
        assert np.mean(np.abs(image - reference)) < allowed * np.mean(reference), contender


def test_sizes(mi_rgb):
    """Bytes of plugins of Mitsuba are those of their arrays, of a grid with its boxes; of tables, those of the file."""
    row = cost.ROWS["image"]
    scene = cost.load_scene(row, "bitmap", False, SMALL)
    texels = sum(
        np.prod(mi.traverse(scene)[key].shape)
        for key in mi.traverse(scene).keys()
        if key.endswith("data") and "floor" in key
    )
    assert cost.array_bytes(scene, "floor") in (texels, 2 * texels, 4 * texels)
    grid = cost.load_scene(cost.ROWS["solid"], "sdfgrid", False, SMALL)
    cells = np.prod(mi.traverse(grid)["shape.grid"].shape)
    assert cost.array_bytes(grid, "shape") == 40 * cells
    files = {name: cost.file_sizes(description, 7) for name, description in row.contenders.items()}
    pictures = [cost.ASSETS / f"tiles_{role}.png" for role in ("albedo", "normal", "roughness")]
    assert files["bitmap"] == {"memory_bytes": 7, "disk_bytes": sum(path.stat().st_size for path in pictures)}
    assert files["neural_image"]["disk_bytes"] == (cost.ASSETS / "tiles.npz").stat().st_size
    solid = cost.file_sizes(cost.ROWS["solid"].contenders["neural_sdf"], 7)
    report = inspect(cost.load_scene(cost.ROWS["solid"], "neural_sdf", False, SMALL)).figures["reports"][1]
    assert solid["memory_bytes"] == report["table_bytes"] + report["index_bytes"]
