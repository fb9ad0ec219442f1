"""``fit field``, ``inspect`` and ``decode``: presets, sizes, interruptions, damaged files, and how they refuse."""

import dataclasses
import json

import captures
import numpy as np
import pytest
from commands import refused
from PIL import Image

from mi_diffind.arrays import sparse_grid
from mi_diffind.arrays.tables import StoredArray, TableError, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.core.progress import Deadline
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import loop
from mi_diffind.fitting.loop import fit as train
from mi_diffind.fitting.task import fit, tasks
from mi_diffind.images import metrics
from mi_diffind.tasks.radiance import compression, files, nodes
from mi_diffind.tasks.radiance import fit as field_fit
from mi_diffind.tasks.radiance import grid as grids
from mi_diffind.tasks.radiance import views as view_files
from mi_diffind.tasks.radiance.session import FieldSession, ViewImages, displayed, scores
from mi_diffind.tasks.radiance.views import load_views

SIZE = 40
SHORT = ["--resolution", "24", "--batch", "1024", "--variant", "llvm_ad_rgb", "--colours", "directions"]


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


@pytest.fixture(scope="module", autouse=True)
def short_grids():
    patch = pytest.MonkeyPatch()
    short = dataclasses.replace(field_fit.PRESETS["grid"], steps=60, batch=1024)
    patch.setitem(field_fit.PRESETS, "grid", short)
    patch.setattr(field_fit, "scale_steps", lambda preset, settings, views: settings)
    patch.setattr(field_fit, "VALUE_STEPS", 20)
    patch.setattr(view_files, "SEARCH", 32)
    yield
    patch.undo()


def ball(pose, side):
    """A ball whose colour follows its normal."""
    return captures.ball(pose, side, (0.2, 0, 0), 0.5, lambda d, n: np.clip(0.5 + 0.4 * n, 0, 1))


def run(source, output, *options, grid=None):
    """The exit code of a fit to a capture with the options, by the capture's ``grid.npz``."""
    grid = source / "grid.npz" if grid is None else grid
    args = ["fit", "field", source, "-o", output, "--grid", grid, *options]
    return main([*map(str, args), *SHORT])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A capture, its grid ``grid.npz``, and ``ball.npz``."""
    path = captures.write(tmp_path_factory.mktemp("field"), 16, 3, SIZE, ball)
    assert run(path, path / "ball.npz", "--json", path / "fit.json", "--steps", 60) == 0
    return path


def test_fit_meets_views_it_has_not_seen(folder, ad):
    """The figures are those of the stored field, which is better than a grey ball."""
    figures = json.loads((folder / "fit.json").read_text())
    table = load_table(folder / "ball.npz", "field")
    assert table.preset == "sparse" and table.settings["capture_path"] == "."
    assert 0.5 < table.measured["ssim_white"] < 1
    # A grey ball in its place, the mean of all pixels, has 13 dB
    assert table.measured["psnr_foreground_db"] > 17.5 and table.measured["psnr_white_db"] > 23
    assert figures["memory_bytes"] < figures["dense_bytes"] / 10
    measured = tasks()["field"].open(ad.TensorXf, folder / "ball.npz").measure()
    assert measured["psnr_white_db"] == pytest.approx(table.measured["psnr_white_db"], abs=1e-3)


@pytest.mark.parametrize("option, limits", [("--bytes", (24_000, 40_000)), ("--disk", (5_000, 9_000))])
def test_bytes_are_kept(folder, tmp_path, option, limits):
    """Bytes in memory, or of the file, which more are allowed for."""
    sizes, out = [], tmp_path / "f.npz"
    for nbytes in limits:
        assert run(folder, out, option, nbytes, "--steps", 4, "--json", tmp_path / "f.json") == 0
        figures = json.loads((tmp_path / "f.json").read_text())
        sizes.append(out.stat().st_size if option == "--disk" else figures["memory_bytes"])
        assert sizes[-1] <= nbytes
    assert sizes[1] > 1.2 * sizes[0]


def test_a_trial_with_a_part_of_the_nodes_can_be_coded(folder, ad, monkeypatch):
    monkeypatch.setattr(compression, "TRIAL_NODES", 300)
    monkeypatch.setattr(compression, "COLUMN", 3)
    grid = files.grid_of(files.load(folder / "grid.npz"), ad)
    rows = np.arange(1.0, grid.nodes.count + 1)
    part, weights = compression.trial_part(grid, compression.Importance(rows, rows, np.ones(12), 1.0))
    assert 0 < part.nodes.count < 0.7 * grid.nodes.count
    assert len(part.density) == part.nodes.entries == len(weights.density) + 1 == len(weights.colour) + 1
    np.testing.assert_array_equal(part.density[1:], grid.density[1:][weights.density.astype(int) - 1])
    assert (sparse_grid.cell_corners(sparse_grid.complete_cells(part.nodes.stored)) == part.nodes.stored).all()


def test_paper_preset(folder, tmp_path, ad):
    out = tmp_path / "paper.npz"
    assert run(folder, out, "--preset", "paper", "--compression", 20, "--steps", 30) == 0
    table = load_table(out)
    assert table.settings["layout"] == "pairs" and table.measured["psnr_white_db"] > 18
    arrays = sum(a.nbytes for n, a in table.arrays.items() if n != "cells")
    dense = 52 * np.prod(table.settings["shape"])
    assert 0.7 * dense / 20 < arrays <= dense / 20
    field = tasks()["field"].open(ad.TensorXf, out).field
    again = FieldSession.load(ad, folder).held_out_images.evaluate(field)
    assert again["psnr_white_db"] == pytest.approx(table.measured["psnr_white_db"], abs=0.05)


def test_inspect_says_what_rays_leave_out(folder, capsys):
    assert main(["inspect", str(folder / "ball.npz"), "--json", str(folder / "inspect.json")]) == 0
    said = capsys.readouterr().out
    assert "skipped as empty" in said and "read no colour" in said and "on disk" in said
    text = (folder / "inspect.json").read_text()
    assert all(f'"{name}"' in text for name in ("memory_bytes", "skipped", "hidden", "colours"))


def test_numbers_limit_the_resolution(folder, monkeypatch, capsys):
    """All stages stay below the limit; a resolution that is given is kept."""
    trained = []
    train_all = loop.fit
    monkeypatch.setattr(loop, "fit", lambda p, *a, **k: trained.append(p.nodes) or train_all(p, *a, **k))
    options = {"source": str(folder), "batch": 256, "steps": 40, "variant": "llvm_ad_rgb", "colours": "directions"}
    sizes = {}
    for limit in (10**9, 100_000):
        monkeypatch.setattr(field_fit, "MOST_NUMBERS", limit)
        trained.clear()
        fit("field", preset="grid", progress=False, **options)
        sizes[limit] = trained[-1].shape[0]
        assert max(13 * nodes.count for nodes in trained[1:]) < 1.1 * limit
        assert ("more than 100,000 numbers" in capsys.readouterr().err) == (limit == 100_000)
    assert 16 < sizes[100_000] < 0.8 * sizes[10**9]
    fit("field", preset="grid", progress=False, **options, resolution=40)
    assert 36 <= trained[-1].shape[0] <= 44


def test_a_stopped_training_goes_on(folder, tmp_path, monkeypatch):
    """A run that is stopped in the trial of colours does not repeat the first stage, and ends as an unbroken run."""
    options = {"source": str(folder), "resolution": 24, "batch": 512, "steps": 40, "variant": "llvm_ad_rgb"}
    whole = fit("field", preset="grid", progress=False, **options).table
    stages, ended = [], []

    def stopping(problem, settings, *args, **kwargs):
        stages.append(problem.nodes.shape)
        if len(stages) == 2 and not ended:
            ended.append(True)
            raise KeyboardInterrupt
        return train(problem, settings, *args, **kwargs)

    monkeypatch.setattr(loop, "fit", stopping)
    checkpoint = tmp_path / "state"
    with pytest.raises(KeyboardInterrupt):
        fit("field", preset="grid", progress=False, checkpoint=checkpoint, **options)
    stages.clear()
    again = fit("field", preset="grid", progress=False, checkpoint=checkpoint, resume=True, **options).table
    assert len(stages) == 2 + len(field_fit.STAGES) - 2
    assert again.arrays["density"].shape == whole.arrays["density"].shape
    np.testing.assert_array_equal(again.arrays["density"].values, whole.arrays["density"].values)


@pytest.mark.parametrize("late", [False, True])
def test_ctrl_c_keeps_what_there_is(folder, tmp_path, monkeypatch, late):
    """Ctrl-C in the first stage of the grid, or just after it; the resumed training continues with the grid."""
    stages = []

    def stopping(problem, settings, *args, **kwargs):
        stages.append(settings.steps)
        result = train(problem, settings, *args, **kwargs)
        result.interrupted, result.asked_to_stop = not late, True
        return result

    checkpoint = tmp_path / "state"
    options = {"source": str(folder), "resolution": 24, "batch": 512, "steps": 4, "variant": "llvm_ad_rgb"}
    with monkeypatch.context() as patch:
        patch.setattr(loop, "fit", stopping)
        kept = tmp_path / "grid.npz"
        found = fit("field", progress=False, checkpoint=checkpoint, grid=str(kept), **options)
    assert not kept.exists()
    assert len(stages) == 1 and found.result.interrupted and found.table.settings["layout"] == "coded"
    assert not checkpoint.exists()
    assert not fit("field", progress=False, checkpoint=checkpoint, resume=True, **options).result.interrupted
    assert checkpoint.exists()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--preset", "grid", "--bytes", "1M"], "--bytes is an option of the presets sparse and paper, found the pres"),
        (["--preset", "paper", "--background", "surroundings"], "found surroundings with the preset paper"),
        (["--preset", "paper", "--disk", "9k"], "--disk is an option of the preset sparse, found the preset paper"),
        (["--bytes", "100"], "--bytes: 100 bytes are fewer than the smallest field needs"),
        (["--disk", "100"], "--disk: 100 bytes are fewer than a file needs"),
        (["--disk", "9k", "--bytes", "9k"], "not allowed with argument"),
        (["--compression", "1e5"], "--compression: "),
        (["--bytes", "many"], "many"),
    ],
)
def test_options_that_do_not_go_together(folder, tmp_path, capsys, more, message):
    with_grid = [] if "grid" in more else ["--grid", folder / "grid.npz"]
    assert message in refused(capsys, "fit", "field", folder, "-o", tmp_path / "x.npz", *with_grid, *more, *SHORT)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["state.grid.npz", "state.stage0"])
def test_files_beside_a_checkpoint_are_not_replaced(folder, tmp_path, name):
    given = {"grid": str(tmp_path / name)} if name != "state.grid.npz" else {"output": tmp_path / name}
    with pytest.raises(UsageError, match=f'{name}", the same file as a file beside --checkpoint'):
        fit("field", str(folder), checkpoint=tmp_path / "state", progress=False, **given)


def test_a_grid_of_other_views_is_refused(folder, tmp_path, capsys):
    captures.write(tmp_path, 4, 2, SIZE, ball)
    assert run(tmp_path, tmp_path / "x.npz", grid=folder / "grid.npz") == 2
    assert "was fitted to other views" in capsys.readouterr().err
    assert run(folder, tmp_path / "x.npz", grid=folder / "ball.npz") == 2
    assert 'has the layout "coded", a grid is needed' in capsys.readouterr().err


def shorter(table, name):
    table.arrays[name] = files.byte_array(table.arrays[name].entries[:-20])


def full(table, name):
    table.arrays[name] = files.byte_array(np.full_like(table.arrays[name].entries, 255))


@pytest.mark.parametrize(
    ("earlier", "damage"),
    [
        (False, lambda table: table.settings.update(layout="cube")),
        (False, lambda table: table.settings.update(shape=[1, 2, 3])),
        (False, lambda table: table.settings.update(spacing=-1.0)),
        (False, lambda table: table.settings.update(density_bits=7)),
        (False, lambda table: shorter(table, "nodes")),
        (False, lambda table: shorter(table, "probabilities")),
        (True, lambda table: full(table, "cells")),
        (True, lambda table: full(table, "index")),
        (True, lambda table: table.settings.update(index_bits=11)),
    ],
)
def test_damaged_files_are_refused(folder, tmp_path, earlier, damage):
    table, path = load_table(folder / "ball.npz"), tmp_path / "damaged.npz"
    table = earlier_layout(table) if earlier else table
    damage(table)
    save_table(path, table)
    with pytest.raises(TableError, match="damaged"):
        files.load(path)


def earlier_layout(table):
    """A table in the layout of earlier versions: six bits a level, and indices that are not packed."""
    flags, numbers = files.palette_arrays(table)
    index = numbers.index.astype("<u2").view(np.uint8).reshape(-1, 2)
    arrays = {
        "cells": files.byte_array(flags[:, None]), "palette": numbers.palette, "index": files.byte_array(index),
        "density": files.byte_array(4 * numbers.levels[:, None], 0.25, numbers.density_range[0]),
    }  # fmt: skip
    settings = {name: value for name, value in table.settings.items() if not name.startswith("density_")}
    return dataclasses.replace(table, arrays=arrays, settings={**settings, "layout": "sparse", "index_bits": 12})


def test_files_with_a_density_curve_are_refused(folder, tmp_path):
    """Files of the version with a learned density curve; the message says how to make them again."""
    table, path = load_table(folder / "ball.npz"), tmp_path / "old.npz"
    table.arrays["curve"] = StoredArray(np.linspace(-7, 12, 64, dtype=np.float32)[:, None])
    save_table(path, table)
    with pytest.raises(TableError, match=r'has a density curve, .* "mi-diffind fit field FOLDER -o old\.npz"$'):
        files.load(path)


# -- the parts --------------------------------------------------------------------------------------------------------


def test_hull_and_box(tmp_path, monkeypatch):
    """Hull and box of a ball of diameter 1 that is seen from 60 sides."""
    monkeypatch.setattr(view_files, "SEARCH", 64)
    views = load_views(captures.write(tmp_path, 60, 1, SIZE, ball))
    lower, upper = view_files.object_box(views)
    assert np.all(lower < [-0.3, -0.5, -0.5]) and np.all(upper > [0.7, 0.5, 0.5])
    assert np.all(upper - lower < 1.4)
    shape = np.ceil((upper - lower) / 0.05).astype(int) + 1
    inside = view_files.hull(views, lower, 0.05, shape)
    distance = np.linalg.norm(lower + 0.05 * np.argwhere(np.ones(shape, bool)) - [0.2, 0, 0], axis=1).reshape(shape)
    assert inside[distance < 0.5].all() and inside[distance > 0.75].mean() < 0.01


def test_index_by_masks_is_the_index(ad, rng):
    for shape in ((9, 7, 33), (6, 8, 32), (4, 5, 70), (12, 9, 2)):
        stored = sparse_grid.cell_corners(rng.random(tuple(n - 1 for n in shape)) < 0.1)
        made = [nodes.Nodes(ad, (0, 0, 0), 0.1, shape, stored, packed=packed) for packed in (False, True)]
        p = ad.Array3f((rng.random((3, 4096)) * (np.array(shape)[:, None] - 1) * 0.1).astype(np.float32))
        (first, seen), (second, again) = (n.corners(p) for n in made)
        np.testing.assert_array_equal(seen.numpy(), again.numpy())
        assert 0.02 < seen.numpy().mean() < 0.9
        for (_, a), (_, b) in zip(first, second, strict=True):
            np.testing.assert_array_equal(a.numpy()[seen.numpy()], b.numpy()[seen.numpy()])
        # Against NumPy: numbers of nodes in lexicographic order
        numbers = np.zeros(shape, int)
        numbers[stored] = np.arange(1, stored.sum() + 1)
        i, j, k = np.minimum((p.numpy() / np.float32(0.1)).astype(int), np.array(shape)[:, None] - 2)
        assert (numbers[i, j, k] == first[0][1].numpy())[seen.numpy()].mean() > 0.999
        assert (numbers[i + 1, j + 1, k + 1] == first[7][1].numpy())[seen.numpy()].mean() > 0.999


def test_clusters(rng):
    centres = rng.normal(size=(8, 12))
    which = rng.integers(0, 8, 4000)
    points = centres[which] + 0.01 * rng.normal(size=(4000, 12))
    entries = compression.clusters(points, np.ones(4000), 64, 0)
    assert np.abs(entries[:, None] - points).max(axis=2).min(axis=0).max() < 0.2
    # One centre goes where the weight is
    weight = np.where(which == 3, 1e4, 1.0)
    assert np.abs(compression.clusters(points, weight, 1, 0)[0] - centres[3]).max() < 0.02
    # Without time for a round, the centres are points
    entries = compression.clusters(points, np.ones(4000), 64, 0, Deadline(1e-9))
    assert np.abs(entries[:, None] - points).max(axis=2).min(axis=1).max() < 1e-6


def test_importance_is_what_a_change_costs(folder, ad, rng):
    """Changes of important and of other nodes change rendered images as their importance predicts."""
    grid = files.grid_of(files.load(folder / "grid.npz"), ad)
    session = FieldSession.load(ad, folder)
    weights, images = compression.importance(grid, session, 0), session.images
    order, ratios = np.argsort(weights.colour), []
    before = [displayed(images.render(grid.field(), v)) for v in range(len(images.views))]
    for nodes_of in (order[-40:], order[len(order) // 2 :][:40]):
        changed = grids.NodeGrid(grid.nodes, grid.density, grid.colour.copy())
        changed.colour[nodes_of + 1, ::4] += 0.05 * rng.choice([-1, 1], (40, 1))
        after = [displayed(images.render(changed.field(), v)) for v in range(len(images.views))]
        error = np.mean(np.square(np.subtract(after, before)))
        # The three channels' mean colours, each with its column's weight
        ratios.append(weights.colour[nodes_of].sum() * weights.metric[::4].sum() * 0.05**2 / error)
    # Training pixels lie where something is seen, which raises both
    assert 0.5 < ratios[0] < 4 and ratios[0] == pytest.approx(ratios[1], rel=0.5)


def test_scores_of_a_known_error(folder):
    views = load_views(folder, "test")
    truth = captures.images_of(views)
    pictures = truth.copy()
    assert scores(pictures, views)["psnr_white_db"] > 100
    covered = truth[..., 3] > 0
    share = covered.mean(axis=(1, 2))
    for image, where in zip(pictures, covered, strict=True):
        image[where] = [0, 0, 0, 1]
    found = scores(pictures, views)
    black = [np.square(displayed(v))[c].mean() for v, c in zip(truth, covered, strict=True)]
    assert found["psnr_foreground_db"] == pytest.approx(np.mean(-10 * np.log10(black)), abs=1e-3)
    assert found["psnr_white_db"] == pytest.approx(np.mean(-10 * np.log10(black * share)), abs=1e-3)


def test_structural_similarity(rng):
    """SSIM equals its definition by means, variances and covariance under a Gaussian of 11 × 11 pixels."""
    truth = rng.random((24, 20, 3))
    image, counted = np.clip(truth + rng.normal(0, 0.2, truth.shape), 0, 1), rng.random((24, 20)) < 0.5
    window = np.exp(-np.square(np.arange(-5, 6) / 1.5) / 2)
    window = np.outer(window, window) / window.sum() ** 2
    pieces = [np.lib.stride_tricks.sliding_window_view(v, (11, 11), axis=(0, 1)) for v in (truth, image)]
    a, b = (np.einsum("yxcij,ij->yxc", v, window) for v in pieces)
    aa, bb, ab = (
        np.einsum("yxcij,yxcij,ij->yxc", pieces[i], pieces[j], window) - m
        for i, j, m in ((0, 0, a * a), (1, 1, b * b), (0, 1, a * b))
    )
    expected = (2 * a * b + 1e-4) * (2 * ab + 9e-4) / ((a * a + b * b + 1e-4) * (aa + bb + 9e-4))
    assert metrics.ssim_published(truth, image) == pytest.approx(expected.mean(), abs=1e-6)
    inside = counted[5:-5, 5:-5]
    assert metrics.ssim_published(truth, image, counted) == pytest.approx(expected[inside].mean(), abs=1e-6)
    assert metrics.ssim_published(truth[:10], image[:10]) is None


def test_refined_grids_are_what_they_were(folder, ad, rng):
    grid = files.grid_of(files.load(folder / "grid.npz"), ad)
    images = ViewImages(ad, load_views(folder, "train"))
    finer = grids.refine(grid, grids.dilate(grids.visible(grid, images)), 2)
    cells = sparse_grid.complete_cells(finer.nodes.stored)
    places = np.argwhere(cells)[rng.choice(cells.sum(), 500)] + 0.5
    p = ad.Array3f((np.array(finer.nodes.lower) + finer.nodes.spacing * places).T.astype(np.float32))
    (before, both), (after, _) = grid.nodes.corners(p), finer.nodes.corners(p)
    np.testing.assert_allclose(sum(w.numpy() for w, _ in after), 1, atol=1e-5)
    raws = [
        sum(w.numpy() * g.density[s.numpy()] for w, s in corners)
        for g, corners in ((grid, before), (finer, after))
    ]  # fmt: skip
    both = both.numpy()
    assert both.mean() > 0.5
    np.testing.assert_allclose(raws[0][both], raws[1][both], atol=2e-2)


def test_nothing_in_view_is_said(tmp_path, capsys):
    captures.write(tmp_path, 4, 2, SIZE, ball)
    for image in tmp_path.glob("*.png"):
        Image.fromarray(np.zeros((SIZE, SIZE, 4), np.uint8)).save(image)
    assert run(tmp_path, tmp_path / "x.npz") == 2
    assert "the views show nothing" in capsys.readouterr().err


def test_views_without_alpha(tmp_path, capsys):
    """Views without alpha are trained in the whole box, with a warning."""
    captures.write(tmp_path, 3, 2, SIZE, ball)
    for path in tmp_path.glob("*.png"):
        Image.open(path).convert("RGB").save(path)
    captures.change(tmp_path, aabb=[[-0.6, -0.8, -0.8], [1, 0.8, 0.8]])
    assert run(tmp_path, tmp_path / "x.npz", "--steps", 5) == 0
    assert "no alpha" in capsys.readouterr().err


def test_the_layout_of_before(folder, tmp_path, ad):
    """A file of the earlier layout has the field of the coded one, and optimised arrays are written as coded ones."""
    coded, path = folder / "ball.npz", tmp_path / "sparse.npz"
    save_table(path, earlier_layout(load_table(coded)))
    table = files.load(path)
    assert table.settings["layout"] == "sparse" and files.palette_arrays(table)[1].density_range[1] == 0.25
    optimised, again = files.stored(table, files.field_of(table, ad, "float32").arrays), tmp_path / "again.npz"
    save_table(again, optimised)
    assert files.load(again).settings["layout"] == "coded"
    held_out = ViewImages(ad, load_views(folder, "test"))
    first, *others = (held_out.render(tasks()["field"].open(ad.TensorXf, p).field, 0) for p in (coded, path, again))
    for picture in others:
        np.testing.assert_allclose(picture, first, atol=1e-6)


def test_a_view_that_sees_nothing(folder):
    """An empty view that looks elsewhere takes nothing from the hull."""
    views = load_views(folder, "train")
    away = captures.look_at(np.array([0, 0.1, 2.0]))
    away[:3, :3] = away[:3, :3] @ np.diag([-1, 1, -1])
    more = dataclasses.replace(
        views, pixels=np.concatenate([views.pixels, np.zeros((SIZE**2, 1), np.uint32)]),
        offsets=np.append(views.offsets, len(views.pixels)), sizes=np.append(views.sizes, views.sizes[:1], axis=0),
        poses=np.concatenate([views.poses, away[None]]), focal=np.concatenate([views.focal, views.focal[:1]]),
        centre=np.concatenate([views.centre, views.centre[:1]]), names=(*views.names, "away.png"),
    )  # fmt: skip
    made = [view_files.hull(v, (-0.5, -0.7, -0.7), 0.07, (18, 20, 20)) for v in (views, more)]
    assert made[0].sum() > 500 and (made[0] & ~made[1]).sum() < 0.02 * made[0].sum()
