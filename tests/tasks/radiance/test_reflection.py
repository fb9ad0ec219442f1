"""Colours with reflections: against NumPy and finite differences, in files, and trained on a mirror."""

import dataclasses

import captures
import drjit as dr
import numpy as np
import pytest

from mi_diffind.arrays.tables import StoredArray, TableError, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.radiance import compression, files, fit, volume_field
from mi_diffind.tasks.radiance.grid import NodeGrid
from mi_diffind.tasks.radiance.march import march
from mi_diffind.tasks.radiance.nodes import Nodes


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


def directions(rng, n):
    d = rng.normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def texels(side):
    """Directions of the middles of the texels of a table, row by row."""
    t = (np.arange(side) + 0.5) / side * 2 - 1
    v, u = np.meshgrid(t, t, indexing="ij")
    z = 1 - np.abs(u) - np.abs(v)
    fold = np.maximum(-z, 0)
    d = np.stack([u - np.copysign(fold, u), v - np.copysign(fold, v), z], axis=-1).reshape(-1, 3)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def light(d):
    """Logarithms of red, green and blue from directions."""
    return np.stack([0.3 + 0.5 * d[:, 0], -0.2 * d[:, 1], 0.4 * d[:, 2] - 1], axis=1)


@pytest.fixture
def environment():
    table = np.concatenate([light(texels(side)) for side in volume_field.SIDES])
    return np.pad(table, ((0, 0), (0, 1))).astype(np.float32)


def grid_of(types, rng, environment, side=5):
    """A cube of random numbers, without empty nodes."""
    nodes = Nodes(types, (-1, -1, -1), 2 / (side - 1), (side,) * 3, np.ones((side,) * 3, bool))
    colour = rng.normal(0, 0.3, (nodes.entries, volume_field.COLUMNS)).astype(np.float32)
    colour[:, volume_field.NORMAL] = rng.normal((0, 0.6, 0.8), 0.1, (nodes.entries, 3))
    return NodeGrid(nodes, rng.uniform(-3, 1, nodes.entries).astype(np.float32), colour, environment)


@pytest.mark.parametrize(("sharpness", "tolerance"), [(30, 0.02), (-30, 0.08), (0, 0.05)])
def test_the_environment_in_the_mirrored_direction(ad, rng, environment, sharpness, tolerance):
    d, n, s = directions(rng, 4000), directions(rng, 4000), rng.normal(size=(4000, 3))
    arrays = [ad.Float(np.float32(column)) for column in np.concatenate([n * 3, s], axis=1).T]
    numbers = [ad.Float(0)] * 12 + arrays + [ad.Float(sharpness), ad.Float(0)]
    table = ad.Float(environment.reshape(-1))

    def entry(number, active):
        return list(dr.gather(ad.Array4f, table, number, active))[:3]

    found = volume_field.reflection(ad, numbers, ad.Array3f(*np.float32(d.T)), entry)
    mirrored = d - 2 * (d * n).sum(axis=1, keepdims=True) * n
    assert np.abs(np.log(np.array(found).T) - s - light(mirrored)).max() < tolerance


def test_hard_numbers_are_finite(ad, environment):
    """No normal, normals of any length, directions along the axes, and tints beyond all bounds."""
    axes = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 0] / np.sqrt(2)]]).astype(np.float32)
    table = ad.Float(environment.reshape(-1))
    for normal in ([0, 0, 0], [1e-20, 0, 0], [1e15, 0, 0], [0, 0, -1]):
        for tint in (-1e4, 0, 1e4):
            values = [*[0] * 12, *normal, tint, tint, tint, 1e4, 0]
            d = ad.Array3f(*axes.T)
            numbers = [ad.Float(v) for v in values]
            dr.enable_grad(numbers, d)
            found = volume_field.reflection(ad, numbers, d, lambda i, a: list(dr.gather(ad.Array4f, table, i, a))[:3])
            dr.backward(sum(found))
            assert np.isfinite(np.array(found)).all()
            assert all(np.isfinite(dr.grad(v).numpy()).all() for v in [*numbers, *d])


def pictures(field, ad):
    o = directions(np.random.default_rng(5), 200) * 4
    seen = march(field, ad.Array3f(*np.float32(o.T)), dr.normalize(ad.Array3f(*np.float32(-o.T))), 0, dr.inf)
    return np.array(seen.colour)


def test_files_keep_reflections(ad, rng, environment, tmp_path):
    """Grids and palettes, packed and in single precision; optimised arrays; files that contradict themselves."""
    grid = grid_of(ad, rng, environment)
    nodes = grid.nodes
    save_table(tmp_path / "grid.npz", files.grid_table(grid))
    expected = pictures(grid.field(), ad)
    table = files.load(tmp_path / "grid.npz")
    assert np.abs(pictures(files.field_of(table, ad), ad) / expected - 1).max() < 0.01

    levels = np.clip(np.rint((grid.density - compression.EMPTIEST) / compression.LEVEL_STEP), 0, 15).astype(np.uint8)
    shared = [compression.to_bytes(values) for values in (grid.colour[1:], environment[:, :3])]
    index, range_ = np.append(0, np.arange(125)).astype(np.uint32), (compression.EMPTIEST, compression.LEVEL_STEP)
    numbers = volume_field.PaletteArrays(levels, 4, range_, index, *shared)
    save_table(tmp_path / "palette.npz", files.palette_table(nodes, numbers))
    table = files.load(tmp_path / "palette.npz")
    assert table.settings["layout"] == "coded" and table.settings["colours"] == "reflections"
    packed, floats = (pictures(files.field_of(table, ad, storage), ad) for storage in ("", "float32"))
    assert np.abs(packed / floats - 1).max() < 1e-4
    arrays = files.field_of(table, ad, "float32").arrays
    arrays["environment"] = ad.TensorXf(arrays["environment"].numpy() + np.float32(np.log(2)))
    brighter = pictures(files.field_of(files.stored(table, arrays), ad), ad)
    base = {name: v for name, v in arrays.items() if name != "environment"}
    dark = dataclasses.replace(grid, environment=environment - 30).tensors()["environment"]
    diffuse = pictures(files.field_of(files.stored(table, {**base, "environment": dark}), ad), ad)
    assert np.abs((brighter - diffuse) / (packed - diffuse) - 2).max() < 0.05

    for change in ("colours", "short", "missing"):
        broken = load_table(tmp_path / "palette.npz")
        if change == "colours":
            broken.settings["colours"] = "mirrors"
        elif change == "short":
            array = broken.arrays["environment"]
            broken.arrays["environment"] = StoredArray(array.entries[:-1], (), array.scale, array.offset)
        else:
            del broken.arrays["environment"]
        save_table(tmp_path / "broken.npz", broken)
        with pytest.raises(TableError, match="mirrors" if change == "colours" else "an environment of the shape"):
            files.load(tmp_path / "broken.npz")


def mirror(pose, side):
    """A ball that mirrors stripes."""

    def stripes(d, n):
        return 0.4 + 0.35 * np.sin(5 * (d - 2 * (d * n).sum(axis=-1, keepdims=True) * n) + [0, 1, 2])

    return captures.ball(pose, side, (0, 0, 0), 0.6, stripes)


def test_a_mirror_is_fitted_by_reflections(tmp_path, capsys):
    """Held-out views gain, and the compressed file keeps the gain."""
    captures.write(tmp_path, 24, 4, 48, mirror)
    options = ["--resolution", "32", "--batch", "2048", "--variant", "llvm_ad_rgb"]
    reached = {}
    for name in fit.COLOURS:
        args = ["fit", "field", str(tmp_path), "--preset", "grid", "--steps", "250", "--colours", name, *options]
        assert main([*args, "-o", str(tmp_path / f"{name}.npz")]) == 0
        reached[name] = load_table(tmp_path / f"{name}.npz").measured["psnr_foreground_db"]
    assert reached["reflections"] > reached["directions"] + 0.7
    args = ["fit", "field", str(tmp_path), "--grid", str(tmp_path / "reflections.npz"), "--steps", "60", *options]
    assert main([*args, "-o", str(tmp_path / "small.npz")]) == 0
    assert load_table(tmp_path / "small.npz").measured["psnr_foreground_db"] > reached["reflections"] - 1
    capsys.readouterr()
    assert main([*args, "--preset", "paper", "-o", str(tmp_path / "paper.npz")]) == 2
    assert "fit a grid with --colours directions" in capsys.readouterr().err


@pytest.mark.parametrize(("worth", "chosen"), [(-100, "reflections"), (100, "directions")])
def test_the_colours_that_show_left_out_views(tmp_path, capsys, monkeypatch, worth, chosen):
    captures.write(tmp_path, 24, 2, 48, mirror)
    monkeypatch.setattr(fit, "WORTH", worth)
    path = tmp_path / "x.npz"
    options = ["--resolution", "20", "--batch", "512", "--variant", "llvm_ad_rgb", "--steps", "40"]
    assert main(["fit", "field", str(tmp_path), "--preset", "grid", "-o", str(path), *options]) == 0
    assert f"colours: {chosen} (left-out views have" in capsys.readouterr().err
    assert ("environment" in load_table(path).arrays) == (chosen == "reflections")
