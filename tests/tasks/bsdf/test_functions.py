"""Sources that are functions, networks and grids of measurements, and the error that symmetries impose on them."""

import json
import os
import struct
import sys

import drjit as dr
import numpy as np
import pytest
import worker_jobs
from arrays import aligned, numpy_of
from bsdf_queries import random_directions
from learned_bsdfs import handmade, unit

import mi_diffind
from mi_diffind.arrays.tables import TableError, save_table
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import library, measured, pairs, training
from mi_diffind.tasks.bsdf.directions import Samples, SphereView
from mi_diffind.tasks.bsdf.truth import recorded_truth, truth_of


@pytest.fixture
def types(mi_rgb):
    return array_module()


def values(truth, types, wi, wo):
    """f cos θ_o of a source, ``(n, 3)``."""
    return numpy_of(truth.value(*(types.Array3f(aligned(w.T)) for w in (wi, wo))))


def lobe(wi, wo):
    """A grey lobe about the normal that is not reciprocal."""
    half = wi + wo
    return np.exp(-4 * (half[:, 0] ** 2 + half[:, 1] ** 2)) * (1 + 0.3 * (wi[:, 2] - wo[:, 2]))


def test_python_functions(types, rng):
    """Values are those of the function times the cosine, in each shape that it may return."""
    wi, wo = random_directions(rng, 500, 0.02), random_directions(rng, 500, 0.02)
    expected = np.repeat(lobe(wi, wo)[:, None] * wo[:, 2:], 3, axis=1)
    forms = (lobe, lambda i, o: lobe(i, o)[:, None], lambda i, o: np.stack([lobe(i, o)] * 3, axis=1))
    truths = [truth_of(form, types) for form in forms]
    for truth in truths:
        np.testing.assert_allclose(values(truth, types, wi, wo), expected, rtol=1e-5, atol=1e-7)
    assert truths[0].digest == truth_of(lobe, types).digest != truth_of(lambda i, o: 2 * lobe(i, o), types).digest
    samples = training.draw(truths[0], types, 4096, 1, True)
    assert truths[0].remarks(samples) == []
    share = truth_of(lambda i, o: np.where(o[:, 0] > 0.2, -1, lobe(i, o)), types).remarks(samples)
    expected = 100 * (samples.wo.x.numpy() > 0.2).mean()
    assert share == [f"{expected:.2g}% of its values are negative, a learned BSDF has 0 there"]
    with pytest.raises(UsageError, match=r"<lambda>: \d.*% of its values are not finite"):
        truth_of(lambda i, o: np.where(o[:, 0] > 0.5, np.nan, lobe(i, o)), types).remarks(samples)
    for wrong, message in (
        (lambda i, o: i[0], r"returned the shape \(3,\)"),
        (lambda i: i, "raised TypeError"),
        (lambda i, o: None, "values of the type object, real numbers are needed"),
        (lambda i, o: lobe(i, o) + 1j, "values of the type complex64, real numbers are needed"),
        (lambda i, o: sys.exit(3), r"<lambda>: raised SystemExit \(3\)"),
    ):
        with pytest.raises(UsageError, match=message):
            truth_of(wrong, types)
    share = truth_of(lambda i, o: np.where(o[:, 0] > 0.2, 1e30, lobe(i, o)), types).remarks(samples)
    assert share == [f"{expected:.2g}% of its values are above 1e+08 and count as that"]
    with pytest.raises(UsageError, match="<lambda>: none of its values is above 0"):
        truth_of(lambda i, o: -lobe(i, o), types).remarks(samples)
    assert "differ from call to call" in truth_of(lambda i, o: rng.random(len(i)), types).remarks(samples)[0]


def test_the_symmetric_part(types, rng):
    """It is the mean over both orders and over mirrored directions, also at normal incidence."""
    wi, wo = (random_directions(rng, 200, 0.05) for _ in range(2))
    wi[:3] = 0, 0, 1

    def skewed(i, o):
        return lobe(i, o) * (1 + 0.5 * (i[:, 0] * o[:, 1] - i[:, 1] * o[:, 0]))

    def mirrored(w):
        n = np.stack([-wi[:, 1], wi[:, 0]], axis=1) / np.maximum(np.hypot(wi[:, 0], wi[:, 1]), 1e-9)[:, None]
        return np.concatenate([w[:, :2] - 2 * n * np.einsum("ij,ij->i", n, w[:, :2])[:, None], w[:, 2:]], axis=1)

    pairs_of = [(wi, wo), (wo, wi), (wi, mirrored(wo)), (mirrored(wo), wi)]
    expected = np.mean([skewed(i, o) for i, o in pairs_of], axis=0) * wo[:, 2]
    symmetric = measured.symmetric_part(truth_of(skewed, types), True)
    np.testing.assert_allclose(values(symmetric, types, wi, wo)[:, 0], expected, rtol=1e-4, atol=1e-6)


MODULE = """
import numpy as np

def leaning(wi, wo):
    return 0.2 + 0.1 * (wi[:, 2] - wo[:, 2])

class Network:
    def forward(self, wi, wo):
        return leaning(wi, wo)

network = Network()
"""


def test_functions_by_name(types, tmp_path, monkeypatch):
    """A function of the current folder is fitted; a file does not name it, so that opening imports nothing.

    The figure beside the error is that of the mean over both orders of directions.
    """
    (tmp_path / "lobes_of_a_test.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "leaves_a_test.py").write_text("raise SystemExit(0)")
    for source, message in (
        ("lobes_of_a_test:red", r"the module lobes_of_a_test \(.*lobes_of_a_test.py\) has no function red"),
        ("no_such_module_here:f", "the module no_such_module_here cannot be imported"),
        ("leaves_a_test:f", r"the module leaves_a_test cannot be imported \(SystemExit: 0\)"),
        ("leaves-a-test:f", "leaves-a-test:f: no such file, and no Python function"),
    ):
        with pytest.raises(UsageError, match=message):
            truth_of(source, types)
    assert truth_of("lobes_of_a_test:network.forward", types).name == "lobes_of_a_test:network.forward"
    monkeypatch.setattr(training, "STARTS", 1)
    for (module, name), value in worker_jobs.QUICK.items():
        monkeypatch.setattr(module, name, value)
    fitted = mi_diffind.fit("bsdf", "lobes_of_a_test:leaning", steps=5, batch=512, progress=False)
    fitted.save("a.npz")
    settings, figures = fitted.table.settings, fitted.table.measured
    assert settings["name"] == "lobes_of_a_test:leaning" and "source_path" not in settings
    with pytest.raises(TableError, match="an object in memory"):
        recorded_truth(mi_diffind.open("a.npz").table, types)
    truth = truth_of("lobes_of_a_test:leaning", types)
    expected = SphereView(truth, types).psnr(lambda wi, wo: [0.2 * wo.z] * 3)
    assert list(figures)[:2] == ["psnr_db", "psnr_symmetric_part_db"]
    assert 20 < figures["psnr_db"] < 50 and figures["psnr_symmetric_part_db"] == pytest.approx(expected, abs=0.01)


# -- networks ----------------------------------------------------------------------------------------------------------


def network(weights, wi, wo):
    """f of a network, by matrices of rotations."""
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    theta, phi = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    c, s, o, z = np.cos(theta), np.sin(theta), np.ones_like(phi), np.zeros_like(phi)
    about_z = np.array([[np.cos(phi), np.sin(phi), z], [-np.sin(phi), np.cos(phi), z], [z, z, o]])
    about_y = np.array([[c, z, -s], [z, o, z], [s, z, c]])
    x = np.concatenate([np.stack([s, z, c], 1), np.einsum("ijn,jkn,nk->ni", about_y, about_z, wi)], axis=1)
    for k, (a, b) in enumerate(((6, 21), (21, 21), (21, 3))):
        matrix, bias, weights = weights[: a * b].reshape(a, b), weights[a * b : a * b + b], weights[a * b + b :]
        x = x @ matrix + bias
        x = np.maximum(x, 0) if k < 2 else x
    return np.maximum(np.exp(x) - 1, 0)


def materials_in(folder, types):
    """Materials of a library's folder, and its sources without any."""
    task = mi_diffind.fitting.task.tasks()["bsdf"]
    options = {argument.name: argument.default for argument in task.arguments} | {"source": folder}
    request = mi_diffind.fitting.task.FitRequest("ours", task.presets["ours"], types, options=options)
    return library.find_materials(request, folder)


def test_networks(types, tmp_path, rng):
    a, b = (0.4 * rng.normal(size=675).astype(np.float32) for _ in range(2))
    np.savez(tmp_path / "nets.npz", **{"x/first": a, "second": b})
    wi, wo = random_directions(rng, 800, 0.02), random_directions(rng, 800, 0.02)
    truth = truth_of(tmp_path / "nets.npz", types, "x/first")
    np.testing.assert_allclose(values(truth, types, wi, wo), network(a, wi, wo) * wo[:, 2:], rtol=2e-3, atol=1e-4)
    np.savez(tmp_path / "one.npz", weights=b)
    assert truth_of(tmp_path / "one.npz", types).name == "one" and truth.name == "x/first"
    np.savez(tmp_path / "short.npz", weights=b[:600])
    content = (tmp_path / "one.npz").read_bytes()
    (tmp_path / "flipped.npz").write_bytes(content[:900] + bytes([content[900] ^ 1]) + content[901:])
    np.savez(tmp_path / "large.npz", weights=1e300 * b.astype(float))
    save_table(tmp_path / "table.npz", handmade())
    (tmp_path / "text.npz").write_text("no archive")
    for name, material, message in (
        ("nets", "", "has 2 networks: name one .material., they are x/first, second"),
        ("nets", "third", 'found "third", .*nets.npz has no such network'),
        ("short", "", r"the array weights has the shape \(600,\), 675 finite floats are needed"),
        ("flipped", "", "flipped.npz: the array weights is damaged .Bad CRC-32"),
        ("large", "", "675 finite floats are needed"),
        ("table", "", "is a table file, which was fitted already"),
        ("text", "", "is no file of networks"),
    ):
        with pytest.raises(UsageError, match=message):
            truth_of(tmp_path / f"{name}.npz", types, material)
    os.mkfifo(tmp_path / "pipe.npz")
    (tmp_path / "folder.xml").mkdir()
    materials, broken = materials_in(tmp_path, types)
    names = {"nets_x_first", "nets_second", *(f"{file}_weights" for file in ("one", "short", "flipped", "large"))}
    assert set(materials) == names and materials["nets_x_first"].material == "x/first"
    assert set(broken) == {"text", "pipe"}


def shifted_gamma(numbers, wi, wo):
    """f of one channel, by the formulas of Bagher et al. 2012 in angles."""
    half = wi + wo
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    theta_h, theta_d = np.arccos(half[:, 2]), np.arccos(np.sum(wi * half, axis=1))
    fresnel = numbers["f0"] - numbers["f1"] * np.cos(theta_d) + (1 - numbers["f0"]) * (1 - np.cos(theta_d)) ** 5
    x = numbers["alpha"] + np.tan(theta_h) ** 2 / numbers["alpha"]
    slopes = numbers["kap"] * np.exp(-x) * x ** -numbers["p"] / (np.pi * np.cos(theta_h) ** 4)
    for w in (wi, wo):
        beyond = np.maximum(np.arccos(w[:, 2]) - numbers["theta0"], 0)
        masking = 1 + numbers["lambda"] * (1 - np.exp(numbers["c"] * beyond ** numbers["k"]))
        slopes = slopes * np.clip(masking, 0, 1) / w[:, 2]
    return (numbers["rhoD"] + numbers["rhoS"] * fresnel * slopes) / np.pi


def test_fits_of_the_shifted_gamma_distribution(types, tmp_path, rng):
    """Values are those of the published formulas; other JSON in a folder is no source, damaged fits are named."""
    channel = {"rhoD": 0.2, "rhoS": 0.4, "f0": 0.3, "f1": 0.2, "kap": 9.0, "alpha": 0.05, "p": 0.6, "lambda": 2.5,
               "c": 0.02, "k": 5.0, "theta0": 0.3}  # fmt: skip
    channels = [{k: v * factor for k, v in channel.items()} for factor in (0.8, 1, 1.1)]
    fit = {name: [c[name] for c in channels] for name in channel} | {"error": [0, 0, 0]}
    path = tmp_path / "fits.json"
    path.write_text(json.dumps({"paint": fit, "steel": fit}))
    wi, wo = random_directions(rng, 500, 0.05), random_directions(rng, 500, 0.05)
    expected = np.stack([shifted_gamma(c, wi, wo) for c in channels], axis=1) * wo[:, 2:]
    truth = truth_of(path, types, "paint")
    np.testing.assert_allclose(values(truth, types, wi, wo), np.maximum(expected, 0), rtol=2e-4, atol=1e-6)
    (tmp_path / "report.json").write_text('{"materials": {"a": {"psnr_db": 1}}}')
    (tmp_path / "cut.json").write_text(json.dumps({"paint": fit})[:-9])
    (tmp_path / "short.json").write_text(json.dumps({"paint": {"rhoD": fit["rhoD"]}}))
    os.mkfifo(tmp_path / "pipe.json")
    materials, broken = materials_in(tmp_path, types)
    assert {m.material for m in materials.values()} == {"paint", "steel"} and set(broken) == {"cut", "short", "pipe"}
    for content, material, message in (
        (json.dumps({"paint": fit, "steel": fit}), "", r"has 2 fits: name one \(material\), they are paint, steel"),
        (json.dumps({"paint": fit}), "gold", 'found "gold", .*fits.json has no such fit'),
        (json.dumps({"paint": fit | {"rhoD": [0.1]}}), "", "holds no fits of the shifted gamma distribution"),
        (json.dumps([1]), "", "holds no fits"),
        ("{", "", "cannot be read"),
    ):
        path.write_text(content)
        with pytest.raises(UsageError, match=message):
            truth_of(path, types, material)


# -- grids -------------------------------------------------------------------------------------------------------------


def grid_file(path, f, mark=b"MBSDF_DATA=\n", sizes=None):
    sizes = struct.pack("<III", *(sizes or (f.shape[3] > 1, f.shape[0], f.shape[2])))
    path.write_bytes(b'NVIDIA ARC MBSDF V1\nname="paint"\n' + mark + sizes + f.astype("<f4").tobytes())
    return path


@pytest.mark.parametrize("channels", [1, 3])
def test_grids(types, tmp_path, rng, channels):
    """Cells are the rows of a table by a script, and the floor is what a loop over pairs of cells finds."""
    f = rng.random((6, 6, 10, channels)) - 0.1
    truth = truth_of(grid_file(tmp_path / "a.mbsdf", f), types)
    rows = [
        ((i + 0.5) * 15, 0, (o + 0.5) * 15, (k + 0.5) * 18, *np.broadcast_to(f[i, o, k], 3))
        for i in range(6) for o in range(6) for k in range(10)
    ]  # fmt: skip
    np.savetxt(tmp_path / "a.csv", rows, "%.7g", ",", header="theta_i,phi_i,theta_o,phi_o,r,g,b", comments="")
    table = measured.ScatteredTruth(tmp_path / "a.csv")
    for name in ("wi", "wo", "f"):
        np.testing.assert_allclose(getattr(truth, name), getattr(table, name), atol=1e-6)
    share = f"{100 * (f < 0).mean():.2g}%"
    assert truth.remarks(None) == [f"{share} of its values are negative, a learned BSDF has 0 there"]

    weight, cos = rng.random((6, 6, 10)), np.cos((np.arange(6) + 0.5) * np.pi / 12)
    w = weight * cos[None, :, None]
    least = total = 0.0
    for i in range(6):
        for o in range(6):
            for k in range(10):
                for c in range(channels):
                    a, b = (f[i, o, k, c], w[i, o, k]), (f[o, i, k, c], w[o, i, k])
                    tried = [max(v, 0) for v, _ in (a, b)]
                    least += min(sum(weight * abs(v - x) for v, weight in (a, b)) for x in tried) / 2
                    total += a[0] * a[1]

    def columns(a):
        return [types.Float(np.ascontiguousarray(c, np.float32)) for c in a.T]

    parts = [
        Samples(types.Array3f(*columns(truth.wi[s])), types.Array3f(*columns(truth.wo[s])),
                columns(weight.reshape(-1, 1)[s])[0], columns((truth.f * truth.wo[:, 2:])[s]))
        for s in (slice(0, 100), slice(100, None))
    ]  # fmt: skip
    assert pairs.error_floor(parts, True, True) == pytest.approx(least / total, rel=1e-4)


GRID_FAULTS = {
    "other mark": ({"mark": b"MBSDF_DATA_TRANSMISSION=\n"}, "is no measured BSDF of MDL that reflects"),
    "type": ({"sizes": (2, 6, 10)}, "claims 6 x 6 x 10 cells of type 2"),
    "large": ({"sizes": (1, 2**20, 2**20)}, "which its .* bytes do not hold"),
    "few": ({"sizes": (1, 2, 10)}, "has 40 cells, at least 200 are needed"),
    "empty": ({"sizes": (1, 6, 0)}, "claims 6 x 6 x 0 cells"),
}


@pytest.mark.parametrize("fault", GRID_FAULTS)
def test_damaged_grids(types, tmp_path, fault):
    changes, message = GRID_FAULTS[fault]
    with pytest.raises(UsageError, match=message):
        truth_of(grid_file(tmp_path / "a.mbsdf", np.ones((6, 6, 10, 3)), **changes), types)


def test_repeated_rows_set_a_floor(tmp_path, rng):
    """Rows with the same directions differ by noise, which no model reproduces."""
    theta, phi = 1.4 * rng.random((2, 300)), 6 * rng.random((2, 300))
    truth = type("Rows", (), {"wi": unit(theta[0], phi[0]), "wo": unit(theta[1], phi[1])})()
    truth.wi, truth.wo = (np.concatenate([w, w]) for w in (truth.wi, truth.wo))
    f, noise = np.ones((600, 1)), 0.1 * np.repeat([[1], [-1]], 300, axis=0)
    orbits = pairs.Orbits(truth, False, False)
    assert orbits.paired == 600 and orbits.exchanged == 0
    assert orbits.least_error((f + noise)[orbits.rows], np.ones(600)) == pytest.approx(60)


# -- kernels -----------------------------------------------------------------------------------------------------------


def test_materials_of_a_form_share_kernels(types, tmp_path):
    """Scale, range and sampled lobes are data: another material of the form compiles nothing."""
    hashes = []
    for k, changes in enumerate(({}, {"scale": (0.03, 0.03), "range": (-0.3, 0.7)})):
        save_table(tmp_path / f"{k}.npz", handmade(**changes))
        model = mi_diffind.open(tmp_path / f"{k}.npz")
        w = types.Array3f(*(dr.full(types.Float, 0.5, 64) for _ in range(3)))
        dr.eval(w)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(model.bsdf.value(w, w), model.mixture.density(w, w))
            hashes.append([kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])])
    assert len(hashes[0]) == 1 and hashes[0] == hashes[1]
