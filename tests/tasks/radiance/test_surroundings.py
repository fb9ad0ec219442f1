"""Fields with surroundings: contraction, steps, derivatives, files and scenes."""

import dataclasses

import captures
import drjit as dr
import numpy as np
import pytest
from PIL import Image
from radiance_fields import haze
from scipy.ndimage import map_coordinates

from mi_diffind.arrays import sparse_grid
from mi_diffind.arrays.tables import TableError, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core import compat
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.radiance import files, march, nodes
from mi_diffind.tasks.radiance import fit as field_fit
from mi_diffind.tasks.radiance import grid as grids
from mi_diffind.tasks.radiance.views import load_views

CENTRE, HALF, SIDE = np.array([0.2, -0.1, 0.3]), 0.7, 13
SPACING = 4 * HALF / (SIDE - 1)


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


def contracted_nodes(types, stored):
    return nodes.Nodes(
        types, CENTRE - 2 * HALF, SPACING, (SIDE,) * 3, stored, inner=(*CENTRE, HALF)
    )  # fmt: skip


def contracted(p):
    """Places ``(n, 3)`` in the grid, in NumPy."""
    v = (p - CENTRE) / HALF
    r = np.maximum(np.abs(v).max(axis=-1, keepdims=True), 1)
    return (v * (2 - 1 / r) / r + 2) * HALF / SPACING


def rays(types, rng, n):
    """Origins and directions in NumPy, and both as arrays."""
    o, d = CENTRE + 2 * HALF * rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return o, d, types.Array3f(np.float32(o.T)), types.Array3f(np.float32(d.T))


@pytest.fixture
def field(ad, rng):
    return haze(ad, rng, CENTRE, HALF, SIDE)


def test_steps_grow_with_the_distance(ad, rng):
    o, d, *arrays = rays(ad, rng, 200)
    along, t = nodes.Contraction(ad, (*CENTRE, HALF)).along(*arrays), rng.uniform(0, 20, 200)
    s = along.in_steps(ad.Float(np.float32(t)))
    assert np.allclose(along.of_steps(s), t, atol=1e-4) and np.allclose(along.of_steps(ad.Float(0)), 0, atol=1e-6)
    growth = np.sqrt(1 + (np.linalg.norm(o + t[:, None] * d - CENTRE, axis=1) / (2 * HALF)) ** 2)
    slope = (along.of_steps(s + 0.05).numpy() - along.of_steps(s - 0.05).numpy()) / 0.1
    assert np.allclose(slope, growth, rtol=2e-3)


def test_what_is_skipped_is_empty(ad, rng):
    stored = sparse_grid.cell_corners(rng.random((SIDE - 1,) * 3) < 0.003)
    grid, cells = contracted_nodes(ad, stored), sparse_grid.complete_cells(stored)
    o, d, *arrays = rays(ad, rng, 4000)
    free = grid.free_distance(*arrays).numpy()
    assert 0.5 < (free > 0).mean() < 1 and (free > HALF).any()
    for share in np.linspace(0, 0.999, 40):
        place = np.clip(contracted(o + (share * free)[:, None] * d).astype(int), 0, SIDE - 2)
        assert not cells[tuple(place[free > 0].T)].any()


def test_rays_against_numpy(field, ad, rng):
    """The integral over fine steps of another kind, up to the horizon, with trilinear reads by SciPy."""
    o, d, *arrays = rays(ad, rng, 24)
    fine = field.for_training()
    fine.step, fine.least_weight = 0.02, 0
    found = march.march(fine, *arrays, 0, np.inf)
    numbers = [v.numpy()[1:].reshape(SIDE, SIDE, SIDE, -1) for v in field.arrays.values()]
    grown = np.sinh(np.linspace(0, 6, 4001))
    grown, middle = 2 * grown, np.add(grown[1:], grown[:-1])
    for i in range(len(o)):
        t, steps = middle, np.diff(grown)
        p = o[i] + t[:, None] * d[i]
        inside = np.abs(p - CENTRE).max(axis=1) < 32 * HALF
        raw, *colour = (
            map_coordinates(a, contracted(p).T, order=1) for n in numbers for a in np.moveaxis(n, -1, 0)
        )  # fmt: skip
        growth = np.sqrt(1 + (np.linalg.norm(p - CENTRE, axis=1) / (2 * HALF)) ** 2)
        density = np.maximum(np.logaddexp(0, raw) - 2e-3, 0) / (SPACING * growth)
        passed = np.exp(-np.cumsum(np.where(inside, density * steps, 0)))
        weights = -np.diff(passed, prepend=1)
        seen = [weights @ np.exp(colour[4 * c] + np.dot(d[i], colour[4 * c + 1 : 4 * c + 4])) for c in range(3)]
        assert found.transmittance.numpy()[i] == pytest.approx(passed[-1], abs=5e-3)
        assert np.allclose(np.array(found.colour)[:, i], seen, atol=1e-2)


# -- captures ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Views without alpha, and a short training with surroundings."""
    path, patch = tmp_path_factory.mktemp("around"), pytest.MonkeyPatch()
    captures.write(path, 4, 2)
    for image in path.glob("*.png"):
        grey, picture = Image.new("RGBA", (24, 24), (150, 140, 130, 255)), Image.open(image)
        Image.alpha_composite(grey, picture).convert("RGB").save(image)
    short = dataclasses.replace(field_fit.PRESETS["grid"], steps=80, batch=1024)
    patch.setitem(field_fit.PRESETS, "grid", short)
    options = ["--steps", "5", "--batch", "1024", "--resolution", "20", "--variant", "llvm_ad_rgb"]
    assert main(["fit", "field", str(path), "-o", str(path / "x.npz"), "--background", "surroundings",
                 "--grid", str(path / "grid.npz"), *options]) == 0  # fmt: skip
    patch.undo()
    return path


def test_a_file_keeps_its_surroundings(folder, ad, rng):
    """The cube that is not contracted, in the grid, in its compressed form and in its trainable form."""
    views = load_views(folder, "train", background="surroundings")
    centre, half = grids.inner_cube(views)
    assert np.allclose(centre, 0, atol=1e-3) and half == pytest.approx(1.1, rel=1e-3)
    table = files.load(folder / "x.npz")
    assert np.allclose(table.settings["inner"], [*centre, half])
    fields = [files.field_of(table, ad, form) for form in ("", "float32")]
    assert all(f.unbounded and np.allclose([f.lower, f.upper], [centre - half, centre + half]) for f in fields)
    *_, o, d = rays(ad, rng, 100)
    a, b = (march.march(f, o, d, 0, np.inf) for f in fields)
    assert np.allclose(a.transmittance.numpy(), b.transmittance.numpy(), atol=2e-3)
    assert (a.transmittance.numpy() < 0.9).any()


def test_damaged_cubes_are_refused(folder, tmp_path):
    table = load_table(folder / "x.npz")
    for inner in ([0, 0, 0], [0, 0, 0, -1.0], "cube"):
        table.settings["inner"] = inner
        save_table(tmp_path / "x.npz", table)
        with pytest.raises(TableError, match="inner"):
            files.load(tmp_path / "x.npz")


def test_surroundings_in_a_scene(field, tmp_path, mi_rgb):
    """Surroundings fill the picture or are switched off; combinations that are not supported are refused."""
    mi = mi_rgb
    density, colour = (values.numpy() for values in field.arrays.values())
    save_table(tmp_path / "x.npz", files.grid_table(grids.NodeGrid(field.nodes, density + 4, colour)))

    def integrator(**more):
        return {"type": "neural_field", "filename": str(tmp_path / "x.npz"), **more}

    def rendered(**more):
        film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgba", "rfilter": {"type": "box"}}
        away = mi.ScalarTransform4f().look_at([3, 0, 0], [6, 0, 0], [0, 1, 0])
        camera = {"type": "perspective", "to_world": away, "film": film}
        return mi.load_dict({"type": "scene", "integrator": integrator(**more), "camera": camera})

    assert mi.render(rendered(), spp=1).numpy()[..., 3].min() > 0.9
    assert mi.render(rendered(surroundings=False), spp=1).numpy()[..., 3].max() == 0
    with pytest.raises(RuntimeError, match='parameter "surroundings": true for a field among nested ones'):
        rendered(inner=integrator(surroundings=False))
    rendered(surroundings=False, inner=integrator(surroundings=False))
    scene = rendered()
    params = mi.traverse(scene)
    dr.enable_grad(params["integrator.to_world"])
    params.update()
    with pytest.raises(RuntimeError) as raised:
        dr.backward(dr.sum(mi.render(scene, params, spp=1), axis=None))
    assert "has no derivatives for a field with surroundings" in compat.one_sentence(raised.value)


def test_surroundings_light_a_ball(ad, tmp_path, mi_rgb):
    """A white ball in surroundings of radiance 1 is white, and hides none of them."""
    mi = mi_rgb
    place = np.abs(np.indices((SIDE,) * 3) - SIDE // 2).max(axis=0) / (SIDE // 4)
    grid = contracted_nodes(ad, np.ones((SIDE,) * 3, bool))
    density = np.append(-9, np.where(place > 1.3, 8.0, -9.0).reshape(-1))
    save_table(tmp_path / "x.npz", files.grid_table(grids.NodeGrid(grid, density, np.zeros((grid.entries, 12)))))
    film = {"type": "hdrfilm", "width": 8, "height": 8, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    at, white = mi.ScalarTransform4f().look_at([0.2, -0.1, 0.9], list(CENTRE), [0, 1, 0]), {"type": "diffuse"}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": "neural_field", "filename": str(tmp_path / "x.npz"), "lit": True, "max_depth": 2},
        "camera": {"type": "perspective", "fov": 60, "to_world": at, "film": film},
        "ball": {"type": "sphere", "center": list(CENTRE), "radius": 0.2, "bsdf": {**white, "reflectance": 1.0}},
    })  # fmt: skip
    image = mi.render(scene, spp=256).numpy()
    assert np.allclose(image[..., 3], 1, atol=1e-3)
    assert np.allclose(image[[0, 0, -1, -1], [0, -1, 0, -1], :3], 1, atol=1e-3)  # past the ball
    assert np.allclose(image[3:5, 3:5, :3].mean(), 1, atol=0.02)
