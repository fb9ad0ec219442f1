"""``tradeoff field``: what radiance fields are compared with, against trilinear interpolation by NumPy and finite
differences; what the study makes, says and writes."""

import json
import zlib

import captures
import drjit as dr
import drjit.llvm.ad as T
import numpy as np
import pytest

from mi_diffind.commands.cli import main
from mi_diffind.measure import benchmark
from mi_diffind.studies.baselines import node_codes, radiance_factors, radiance_fits
from mi_diffind.studies.radiance import conclusions
from mi_diffind.studies.radiance import plan as plans
from mi_diffind.tasks.radiance import march
from mi_diffind.tasks.radiance import views as view_files
from mi_diffind.tasks.radiance.nodes import Nodes, cells_of, corners_of
from mi_diffind.tasks.radiance.session import FieldSession
from mi_diffind.tasks.radiance.volume_field import FAINT, NodeField

LOWER, SPACING, SHAPE = (-0.5, -0.3, 0.1), 0.05, (11, 9, 14)


@pytest.fixture
def grid(rng):
    stored = corners_of(rng.random([n - 1 for n in SHAPE]) < 0.25)
    count = np.count_nonzero(stored)
    density, colour = 3 * rng.normal(size=count), 0.7 * rng.normal(size=(count, 12))
    nodes = Nodes(T, LOWER, SPACING, SHAPE, stored)
    return radiance_fits.WeightedGrid(nodes, np.float32(density), np.float32(colour), rng.random(count))


FITS = {
    "sparse": radiance_fits.plain,
    "6 bits": lambda g: radiance_fits.plain(g, 64),
    "components": lambda g: radiance_fits.components(g, 0.02),
    "three components": lambda g: radiance_fits.components(g, 0.02, 3),
    "codebook": lambda g: radiance_fits.codebook(g, 50),
}


def rays(rng, count, grid):
    points = rng.uniform(grid.nodes.lower, grid.nodes.upper, (count, 3)).astype(np.float32)
    d = rng.normal(size=(count, 3))
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return points, d, *(T.Array3f(*(T.Float(np.ascontiguousarray(x)) for x in v.T)) for v in (points, d))


def interpolated(grid, numbers, points):
    """``numbers`` (n, C) of the stored nodes at ``points``, in double precision, and where all corners are stored."""
    dense = np.zeros((*SHAPE, numbers.shape[1]))
    dense[grid.nodes.stored] = numbers
    place = (points.astype(np.float64) - LOWER) / SPACING
    cell = np.minimum(np.floor(place).astype(int), np.array(SHAPE) - 2)
    found = 0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, place - cell, 1 - (place - cell)), axis=1)
        found = found + weight[:, None] * dense[tuple((cell + corner).T)]
    return found, cells_of(grid.nodes.stored)[tuple(cell.T)]


def numbers_of(state):
    """Density and twelve numbers of colour of each node, as a state means them."""
    kinds = [state[f"{k}_low"] + state[f"{k}_step"] * state[k].astype(np.float64) for k in ("density", "colour")]
    density, colour = kinds
    if "rows" in state:
        colour = colour[state["rows"]]
    if "matrix" in state:
        colour = colour @ state["matrix"][:-1] + state["matrix"][-1]
    return np.concatenate([density, colour], axis=1)


@pytest.mark.parametrize("name", FITS)
def test_bytes_are_read_as_they_are_meant(grid, name, rng):
    """Both forms, that which is trained and that of bytes, against NumPy."""
    made = FITS[name](grid)
    state = made.state()
    assert state["density"].dtype == state["colour"].dtype == np.uint8
    points, directions, p, d = rays(rng, 3000, grid)
    expected, inside = interpolated(grid, numbers_of(state), points)
    sigma = np.maximum(np.logaddexp(0, expected[:, 0]) - FAINT, 0) / SPACING * inside
    exponents = [
        expected[:, 1 + 4 * c] + np.sum(expected[:, 2 + 4 * c : 5 + 4 * c] * directions, axis=1) for c in range(3)
    ]
    for field in (made.field_of(made.net), made.field(T, state)):
        found, point_data = field.density_at(p)
        assert np.abs(found.numpy() - sigma).max() < 2e-3
        colour = np.array(field.radiance_at(point_data, p, d, found > 0))
        assert 0.1 < (sigma > 0).mean() < 0.9
        assert np.allclose(colour[:, sigma > 0], np.exp(exponents)[:, sigma > 0], rtol=2e-4)


def test_rounded_once(grid):
    """Rounding is within half a step of what it is of, and what is rounded stays."""
    made = radiance_fits.plain(grid)
    found = numbers_of(made.state())
    assert np.abs(found[:, 0] - np.clip(grid.density, *radiance_fits.RAW)).max() <= 0.51 * made.steps[0].step[0]
    inner = np.abs(found[:, 1:] - grid.colour) <= 0.51 * made.steps[1].step
    assert inner.mean() > 0.99  # all but the tails
    tensor = T.TensorXf(np.float32(found[:, 1:]))
    assert np.abs(made.steps[1].rounded(T, tensor).numpy() - found[:, 1:]).max() < 1e-6


def test_components_rebuild_colours(grid):
    """All twelve in fine steps are what they were made of, but for the tails; three are less."""
    errors = [np.abs(numbers_of(radiance_fits.components(grid, 1e-3, n).state())[:, 1:] - grid.colour) for n in (12, 3)]
    assert np.quantile(errors[0], 0.95) < 0.02 < np.quantile(errors[1], 0.5)


def test_codebook_has_the_nearest(grid):
    made = radiance_fits.codebook(grid, 50)
    centres = made.net["colour"].numpy() * radiance_fits.display(grid)
    points = grid.colour * radiance_fits.display(grid)
    distances = np.linalg.norm(points[:, None] - centres[None], axis=2)
    best = distances[np.arange(len(points)), made.rows]
    assert np.allclose(best, distances.min(axis=1), rtol=1e-4)
    random = np.linalg.norm(points[:, None] - points[None, :50], axis=2).min(axis=1)
    assert np.average(best**2, weights=grid.seen) < np.average(random**2, weights=grid.seen)


def unpacked(neighbours, stored, data, prediction):
    """The codes of a channel from its bytes, decoded in the order of sums of places: previous nodes have lower ones."""
    rest, total = np.frombuffer(zlib.decompress(data), np.uint8).astype(np.int64), np.argwhere(stored).sum(axis=1)
    codes = np.zeros_like(rest)
    for wave in (np.flatnonzero(total == n) for n in np.unique(total)):
        codes[wave] = (rest[wave] + neighbours.predicted(codes, prediction, wave)) & 255
    return codes.astype(np.uint8)


@pytest.mark.parametrize("kind", node_codes.PREDICTIONS)
def test_codes_come_back(kind, rng):
    """What zlib has of a channel, by each prediction, is undone; smooth ones are smaller predicted."""
    stored = rng.random((20, 15, 18)) < 0.9
    neighbours = node_codes.Neighbours(stored)
    place = np.argwhere(stored)
    smooth = np.uint8(place @ [5, 3, 4] + rng.integers(2, size=len(place)))
    noise = rng.integers(256, size=len(place)).astype(np.uint8)
    for codes in (smooth, noise):
        rest = np.uint8(codes - neighbours.predicted(codes.astype(np.int64), kind, np.arange(len(codes))) & 255)
        assert np.array_equal(unpacked(neighbours, stored, node_codes.deflated(rest.tobytes()), kind), codes)
    data, chosen = neighbours.packed(smooth)
    assert chosen == "mean" and len(data) < 0.8 * len(node_codes.deflated(smooth.tobytes()))
    assert len(neighbours.packed(noise)[0]) > 0.95 * len(noise)


def test_file_bytes_are_of_all_that_is_stored(grid):
    sizes = {name: make(grid) for name, make in FITS.items()}
    sizes = {name: made.file_bytes(made.state()) for name, made in sizes.items()}
    count = grid.nodes.count
    assert 10 * count < sizes["sparse"] < 14 * count + 500  # noise does not deflate
    assert sizes["6 bits"] < 0.9 * sizes["sparse"] and sizes["codebook"] < 0.4 * sizes["sparse"]


def test_coarser_grids_are_read_from_finer_ones():
    """Numbers that are linear in the place are met where nodes are inside; there is nothing outside."""
    cells = np.zeros((15, 15, 15), bool)
    cells[3:12, 3:12, 3:12] = True
    nodes = Nodes(T, LOWER, SPACING, (16, 16, 16), corners_of(cells))
    place = nodes.positions()
    colour = np.stack([place @ [k, 1, 2] for k in range(12)], axis=1)
    grid = radiance_fits.WeightedGrid(nodes, 0.3 * place[:, 0] - 0.1 * place[:, 2], colour, np.ones(len(place)))
    found = grid.resampled(1.4)
    assert found.nodes.spacing == pytest.approx(1.4 * SPACING) and found.nodes.shape == (12, 12, 12)
    place = 1.4 * found.nodes.positions()
    inside = ((place >= 3) & (place <= 12)).all(axis=1)
    assert inside.sum() == 6**3
    assert np.abs(found.density - 0.3 * place[:, 0] + 0.1 * place[:, 2])[inside].max() < 1e-4
    assert np.abs(found.colour - np.stack([place @ [k, 1, 2] for k in range(12)], axis=1))[inside].max() < 1e-3
    assert found.density[~inside].max() < 1.0 and not inside.all()
    dense = grid.resampled(1.4, sparse=False)
    assert dense.nodes.stored is None and len(dense.density) == 12**3 and dense.density[0] == radiance_fits.RAW[0]


@pytest.mark.parametrize("kind", ["planes", "hash"])
def test_derivatives_of_planes_and_networks(grid, kind, rng):
    """Of densities and colours with respect to each array, against finite differences."""
    made, step = radiance_factors.PlanesFit(grid, (4, 4), 0.07), 2e-3
    if kind == "hash":
        made, step = radiance_factors.HashVolumeFit(grid, 2**9, 16.0), 1e-4
    _, _, p, d = rays(rng, 2000, grid)

    def values(net):
        field = made.field_of(net)
        sigma, point_data = field.density_at(p)
        return sigma / 50 + sum(field.radiance_at(point_data, p, d, sigma > 0))

    net = {name: T.TensorXf(value) for name, value in made.net.items()}
    dr.enable_grad(net)
    dr.backward(values(net))
    gradients, net = dr.grad(net), dr.detach(net)
    for name in net:
        change = T.TensorXf(rng.exponential(size=net[name].shape).astype(np.float32))
        moved = [values({**net, name: net[name] + s * step * change}).numpy().astype(np.float64) for s in (1, -1)]
        found = np.sum(gradients[name].numpy().astype(np.float64) * change.numpy())
        assert found == pytest.approx(np.sum(moved[0] - moved[1]) / (2 * step), rel=0.01), name


def test_all_outputs_of_a_network_are_trained(grid, rng):
    """Derivatives of rays reach the density and all coefficients of the colours, as finite differences do."""
    made = radiance_factors.HashVolumeFit(grid, 2**9, 16.0)
    made.net["weights"] = made.net["weights"] * 1.5  # some density
    _, _, o, d = rays(rng, 500, grid)

    def total(net):
        seen = march.differentiable(made.field_of(net).for_training(), o, d, T.Float(0), T.Float(dr.inf))
        return sum(w * dr.sum(colour) for w, colour in zip((1, 2, 3), seen.colour, strict=True))

    net = {name: T.TensorXf(value) for name, value in made.net.items()}
    dr.enable_grad(net)
    dr.backward(total(net))
    gradient, net = dr.grad(net)["weights"].numpy().astype(np.float64), dr.detach(net)
    bias = made.network.layers[-1].bias
    for row in range(13):
        place, sums = bias.offset + row * bias.stride, []
        for sign in (1, -1):
            weights = net["weights"].numpy().copy()
            weights[place] += sign * 1e-2
            sums.append(float(total({**net, "weights": T.TensorXf(weights)})[0]))
        assert gradient[place] == pytest.approx((sums[0] - sums[1]) / 2e-2, rel=0.03, abs=1e-3), row
    assert np.abs(gradient[bias.offset + bias.stride :: bias.stride][:3]).min() > 0.01


def test_planes_are_sums_of_products(grid, rng):
    """Against NumPy, and what 8 bits leave of them."""
    made = radiance_factors.PlanesFit(grid, (4, 4), 0.07)
    made.round()
    state = made.state()
    points, _, p, _ = rays(rng, 500, grid)
    field = made.field(T, state)
    sides = np.array(state["sides"])
    table = state["density_planes_low"] + state["density_planes_step"] * state["density_planes"].astype(np.float64)
    u = (points - grid.nodes.lower) / (np.array(grid.nodes.upper) - grid.nodes.lower) * (sides - 1)
    cell = np.minimum(np.floor(u).astype(int), sides - 2)
    f = u - cell
    raw, start = radiance_factors.BEGIN, 0
    lines = sum(sides[a] * sides[b] for (a, b), _ in radiance_factors.PLANES)
    for (a, b), c in radiance_factors.PLANES:
        flat = 0
        for i, j in np.ndindex(2, 2):
            weight = (f[:, a] if i else 1 - f[:, a]) * (f[:, b] if j else 1 - f[:, b])
            flat = flat + weight[:, None] * table[start + (cell[:, a] + i) * sides[b] + cell[:, b] + j]
        line = table[lines + cell[:, c]] * (1 - f[:, c : c + 1]) + table[lines + cell[:, c] + 1] * f[:, c : c + 1]
        raw = raw + np.sum(flat * line, axis=1)
        start, lines = start + sides[a] * sides[b], lines + sides[c]
    sigma, _ = field.density_at(p)
    occupied = made.occupancy(p).numpy()
    expected = np.maximum(np.logaddexp(0, raw) - FAINT, 0) / SPACING * occupied
    assert np.abs(sigma.numpy() - expected).max() < 1e-3 and 0.2 < occupied.mean() <= 1
    trained, _ = made.field_of(made.net).density_at(p)
    assert np.abs(trained.numpy() - sigma.numpy()).max() < 1e-3
    assert field.nbytes > state["density_planes"].size + state["colour_planes"].size


def test_what_is_seen_is_where_rays_end(grid):
    """The shares of a ray that ends in one cell are those of its corners; a wall hides what is behind it."""
    nodes = Nodes(T, (0, 0, 0), 1.0, (4, 4, 4), np.ones((4, 4, 4), bool))
    density = np.full((4, 4, 4), -30.0)
    density[:, :, 2:] = 60.0
    arrays = [T.TensorXf(np.float32(np.append(0, density.ravel()))), T.TensorXf(np.zeros((65, 12), np.float32))]

    class ParallelRays:
        def __init__(self):
            self.views = type("Views", (), {"sizes": np.array([[4, 4]])})()

        def rays(self, view, x, y):
            o = T.Array3f(0.5 + 0.5 * T.Float(x), 0.5 + 0.5 * T.Float(y), 9.0)
            return o, T.Array3f(T.Float(0), T.Float(0), T.Float(-1))

    seen = radiance_fits.visibility(NodeField(nodes, *arrays), ParallelRays(), 1)[1:].reshape(4, 4, 4)
    assert seen.sum() == pytest.approx(16, rel=1e-3)
    assert seen[:, :, 3].sum() > 15.9 * 0.5 and seen[:, :, :2].sum() < 1e-3


# -- the study --------------------------------------------------------------------------------------------------------

MADE = ("sparse", "ours")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A capture of two balls, and the results of a quick run."""
    folder = tmp_path_factory.mktemp("field")
    captures.write(folder / "balls")
    with pytest.MonkeyPatch.context() as patch:
        small = benchmark.BenchmarkSettings(2**10, 2, 1, 2**10, True)
        patch.setattr(benchmark.BenchmarkSettings, "choose", classmethod(lambda cls, variant, quick=False: small))
        patch.setattr(view_files, "SEARCH", 32)
        assert main([*command(folder), "--json", str(folder / "r.json")]) == 0
    return folder


def command(folder, *more):
    left_out = [x for kind in plans.KINDS if kind not in MADE for x in ("--without", kind)]
    sizes = ["--quick", "--compression", "120", "--resolution", "16", "--steps", "10"]
    return ["tradeoff", "field", str(folder / "balls"), *sizes, *left_out, "--out", str(folder / "out"),
            "--variant", "llvm_ad_rgb", *more]  # fmt: skip


def test_what_is_written(finished):
    result = json.loads((finished / "r.json").read_text(encoding="utf-8"))
    made = {n: c for n, c in result["candidates"].items() if not c["is_reference"]}
    assert set(made) == {"sparse grid, 8 bits 120×", "ours 120×"}
    assert set(result["candidates"]) - set(made) == {"grid", "grid, trained on"}
    for name, c in result["candidates"].items():
        e = c["errors"]
        assert 8 < e["psnr_foreground_db"] < e["psnr_white_db"] < 45, name
    for name, c in made.items():
        d = c["details"]
        assert c["bytes"] == d["memory_bytes" if name.startswith("ours") else "file_bytes"]
        assert d.get("coarser", 2) > 1
        assert 0.1 * d["dense_bytes"] / 120 < c["bytes"] <= 1.02 * d["dense_bytes"] / 120, name
    assert set(result["cases"]["reads"]["queries"]) == {"density", "both"}
    assert set(result["cases"]["reads"]["passes"]["render"]) == {"grid", *made}
    out = finished / "out"
    assert (out / "tradeoff_field_views.png").stat().st_size > 20_000
    assert len(list((out / "tradeoff_field_models").glob("*.npz"))) == 4
    assert result["conclusions"][0].startswith("120×: ours is ")


def test_what_was_made_is_known(finished):
    result = json.loads((finished / "r.json").read_text(encoding="utf-8"))
    without = tuple(k for k in plans.KINDS if k not in MADE)
    source = str(finished / "balls")
    plan = plans.plan(FieldSession.load(T, source), source, plans.RadianceStudySettings((120.0,), without))
    assert [job.name for job in plan.jobs] == list(result["jobs"])
    models = finished / "out" / "tradeoff_field_models"
    for job in plan.jobs:
        record = result["jobs"][job.name]
        assert job.cached_record(models, None) is None and job.cached_record(None, record) is None
        assert job.cached_record(models, record) == record
    for name in ("sparse grid, 8 bits 120×", "grid, trained on"):
        job = next(job for job in plan.jobs if job.name == name)
        found = job.context.errors(job.model)
        assert found == pytest.approx(result["candidates"][name]["errors"], abs=0.01)


def test_conclusions():
    def candidate(kind, white, foreground, asked=75.0):
        details = {"kind": kind, "asked": asked} if kind not in ("grid", "longer") else {"kind": kind}
        errors = {"psnr_white_db": white, "psnr_foreground_db": foreground}
        return {"details": details, "errors": errors, "is_reference": "asked" not in details}

    result = {
        "candidates": {
            "grid, trained on": candidate("longer", 31.0, 26.0),
            "sparse grid, 8 bits 75×": candidate("sparse", 29.0, 24.0),
            "codebook 75×": candidate("codebook", 30.0, 25.5),
            "ours 75×": candidate("ours", 30.5, 25.25),
        },
        "details": {"first": 75.0, "request": {"film": 200}},
        "cases": {},
    }
    assert conclusions.conclusions(result) == [
        "75×: ours is not ahead, 30.50 dB over white and 25.25 dB of the foreground, against best of the others: "
        "30.00 / 25.50 dB, +0.50 / -0.25 (codebook); sparse grid, 8 bits, after zlib: 29.00 / 24.00 dB, +1.50 / +1.25; "
        "the grid, trained as long: 31.00 / 26.00 dB, -0.50 / -0.75."
    ]
    result["candidates"]["ours 75×"]["errors"]["psnr_foreground_db"] = 25.75
    assert conclusions.conclusions(result)[0].startswith("75×: ours is ahead of all others, 30.50 dB over white")
    render = {"ours 75×": {"time": 20.0}, "codebook 75×": {"time": 40.0}}
    ratios = {"render": {"ours 75× / codebook 75×": {"median": 0.5}}}
    result["cases"] = {"reads": {"queries": {"both": render}, "passes": {"render": render}, "ratios": ratios}}
    assert conclusions.conclusions(result)[1:] == [
        "A sample of ours 75×, density and colour, takes 20 ns; the fastest of the others is codebook 75×: 40 ns.",
        "A picture of 200² with ours 75× takes 20 ms: 0.50 times that of codebook 75×.",
    ]


@pytest.mark.parametrize(
    "options, message",
    [
        (["--compression", "0"], "0"),
        (["--without", "vq"], '--without: found "vq", allowed are dense, sparse'),
        (["--resolution", "4"], "--resolution: found 4, at least 8 is needed"),
        (["--steps", "1"], "--steps: found 1, at least 2 is needed"),
    ],
)
def test_bad_options(tmp_path, options, message, capsys):
    captures.write(tmp_path / "balls", 3, 1, 8)
    assert main(["tradeoff", "field", str(tmp_path / "balls"), "--out", str(tmp_path / "out"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_no_capture(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["tradeoff", "field", "nothing", "--out", "out"]) == 2
    assert "nothing: no such folder" in capsys.readouterr().err
    assert main(["tradeoff", "field", "--out", "out"]) == 2
    assert "make it by mi-diffind capture scenes/capture_group.xml -o captures/group" in capsys.readouterr().err
