"""Rows of measured values: files, their faults, symmetries, solid angles, outliers, and a training."""

import dataclasses
import json
import math

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from learned_bsdfs import unit

import mi_diffind
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.scenes.inspection import inspect
from mi_diffind.tasks.bsdf import measured, training
from mi_diffind.tasks.bsdf.directions import SphereView
from mi_diffind.tasks.bsdf.truth import truth_of

HEADER = "theta_i,phi_i,theta_o,phi_o,r,g,b"


@pytest.fixture
def types(mi_rgb):
    return array_module()


def angles(rng, n, azimuth=True):
    """θ_i, φ_i, θ_o, φ_o of pairs, half of which are near the mirror direction."""
    theta, phi = 1.4 * rng.random(n), 2 * np.pi * rng.random(n) * azimuth
    near = np.arange(n) % 2 == 0
    other = np.where(near, np.clip(theta + 0.3 * rng.normal(size=n), 0, 1.5), 1.5 * np.sqrt(rng.random(n)))
    return np.stack([theta, phi, other, phi + np.pi + np.where(near, 0.5 * rng.normal(size=n), 7 * rng.random(n))], 1)


def lobe(wi, wo, anisotropy=0.0, skew=0.0, exchange=0.0):
    half = wi + wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    value = 0.1 + np.exp(-(half[:, 0] ** 2 + (1 + anisotropy) * half[:, 1] ** 2) / 0.3**2)
    raised = wi[:, 2] - wo[:, 2]
    skewed = 1 + skew * (wi[:, 0] * wo[:, 1] - wi[:, 1] * wo[:, 0]) * raised
    return value * np.maximum(skewed, 0.1) * (1 + exchange * raised)


def write(path, rows, header=HEADER):
    np.savetxt(path, rows, "%.7g", ",", header=header, comments="")
    return path


def rows_of(a, value):
    return np.column_stack([np.degrees(a), *3 * [np.broadcast_to(value, len(a))]])


FAULTS = {
    "no header": ("1,2,3,4,5,6,7\n", r'rows.csv: its header has the column "1", allowed are theta_i'),
    "a column is missing": ("theta_i,phi_i,theta_o,phi_o,r,g\n", "rows.csv: its header has no b, needed are"),
    "a column twice": (f"{HEADER},r\n", 'rows.csv: its header has the column "r" twice'),
    "no rows": (f"{HEADER}\n", "rows.csv: has no rows below its header"),
    "text": (f"# note\n{HEADER}\n\n1,2,3,4,5,6,7\n1,2,3,4,dark,6,7\n", r'rows.csv:5: found "dark", a number is needed'),
    "short": (f"{HEADER}\n1,2,3,4,5,6,7\n1,2,3\n", "rows.csv:3: has 3 columns, its header has 7"),
    "nan": (f"{HEADER}\n1,2,3,4,5,6,7\n1,2,3,4,nan,6,7\n", "rows.csv:3: holds a number that is not finite"),
    "below": (f"{HEADER}\n1,2,3,4,5,6,7\n1,2,95,4,5,6,7\n", "rows.csv:3: theta_o is 95, allowed is 0 to 90 degrees"),
    "units": (f"{HEADER}\n1,2,1,4,5,6,7\n", r"its angles are all below 2π: say whether .* \(--angles\)"),
    "weight": (f"{HEADER},weight\n1,2,3,4,5,6,7,-1\n1,2,80,4,5,6,7,1\n", "rows.csv:2: weight is negative"),
    "few": (f"{HEADER}\n1,2,80,4,5,6,7\n", "rows.csv: has 1 rows above the horizon, at least 200 are needed"),
    "binary": (b"\xff\xfe\x00\x01", r"rows.csv: cannot be read"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_named(tmp_path, fault):
    content, message = FAULTS[fault]
    path = tmp_path / "rows.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UsageError, match=message):
        measured.ScatteredTruth(path)


def test_files(tmp_path, rng):
    """Degrees and radians, columns in any order, weights and comments mean the same rows."""
    a, value = angles(rng, 300), rng.random((300, 3))
    first = measured.ScatteredTruth(write(tmp_path / "a.csv", np.column_stack([np.degrees(a), value])))
    np.testing.assert_allclose(first.wi, unit(*a[:, :2].T), atol=1e-5)
    np.testing.assert_allclose(first.wo, unit(*a[:, 2:].T), atol=1e-5)
    np.testing.assert_allclose(first.f, value, rtol=1e-5)
    weight = np.arange(300) % 3.0
    columns = np.column_stack([weight, value[:, ::-1], a])
    header = "# radians\n\nWeight, b,g,r,theta_i,phi_i,theta_o,phi_o"
    second = measured.ScatteredTruth(write(tmp_path / "b.csv", columns, header), "radians")
    assert second.left_out == 100 and second.digest != first.digest
    for name in ("wi", "wo", "f"):
        np.testing.assert_allclose(getattr(second, name), getattr(first, name)[weight > 0], atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "broken"), [({}, ()), ({"anisotropy": 8}, ("isotropy", "mirror")), ({"skew": 9}, ("mirror",)),
                            ({"exchange": 0.8}, ("reciprocity",))],
)  # fmt: skip
def test_symmetries_are_measured_from_neighbours(tmp_path, rng, changes, broken):
    """Noise and distance break no symmetry."""
    a = angles(rng, 8000)
    value = lobe(unit(*a[:, :2].T), unit(*a[:, 2:].T), **changes) * (1 + 0.05 * rng.normal(size=len(a)))
    truth = measured.ScatteredTruth(write(tmp_path / "rows.csv", rows_of(a, value)))
    for name, excess in measured.measure_row_symmetry(truth).items():
        assert (excess > 0.02) if name in broken else (excess < 0.01), (name, excess)


@pytest.mark.parametrize("every", [1, 3])
def test_reciprocity_is_measured_from_exact_pairs(tmp_path, every):
    """The light that no reciprocal model reproduces equals a quadrature over a grid of angles, or a part of it."""
    theta, phi = (np.arange(30) + 0.5) * np.pi / 60, (np.arange(40) + 0.5) * np.pi / 40
    i, o, k = np.meshgrid(theta, theta, phi, indexing="ij")
    rng = np.random.default_rng(2)
    symmetric, skew = np.exp(-3 * (i - o) ** 2 - (k - np.pi) ** 2), 0.4 * rng.normal(size=(30, 30, 1))
    f = symmetric * (1 + skew - skew.transpose(1, 0, 2))
    measure = np.sin(i) * np.cos(i) * np.sin(o) * np.cos(o)
    expected = (measure * np.abs(f - f.transpose(1, 0, 2))).sum() / 2 / (measure * np.abs(f)).sum()
    a = np.stack([i, 0 * i, o, k], axis=-1).reshape(-1, 4)
    chosen = rng.random(len(a)) < 1 / every
    truth = measured.ScatteredTruth(write(tmp_path / "rows.csv", rows_of(a[chosen], f.ravel()[chosen])))
    share = measured.measure_row_symmetry(truth)["reciprocity"]
    assert expected > 0.2 and share == pytest.approx(expected, rel=1e-3 if every == 1 else 0.05)
    truth.f = np.repeat(symmetric.ravel()[chosen, None], 3, axis=1)
    assert measured.measure_row_symmetry(truth)["reciprocity"] < 1e-6


def test_symmetries_without_pairs_are_assumed(tmp_path, rng):
    a = angles(rng, 2000, azimuth=False)
    truth = measured.ScatteredTruth(
        write(tmp_path / "rows.csv", rows_of(a, lobe(unit(*a[:, :2].T), unit(*a[:, 2:].T))))
    )
    assert measured.measure_row_symmetry(truth)["isotropy"] is None


def test_solid_angles(tmp_path, rng):
    """Estimated from neighbours, they are the inverse of the density; repeated rows share theirs."""
    n = 6000
    z = rng.random(n)
    theta_o = np.where(np.arange(n) % 2 == 0, np.arccos(z), 0.3 * np.sqrt(z))  # half of them in a cap
    a = np.stack([1.2 * rng.random(n), 0 * z, theta_o, 2 * np.pi * rng.random(n)], axis=1)
    truth = measured.ScatteredTruth(write(tmp_path / "rows.csv", rows_of(np.concatenate([a, a[:1000]]), 1.0)))
    density = 0.5 / (2 * np.pi) + np.where(truth.wo[:, 2] > math.cos(0.3), 0.5 / (math.pi * 0.3**2), 0)
    density[:1000], density[-1000:] = 2 * density[:1000], 2 * density[-1000:]
    estimated = measured.solid_angles(truth, True)
    inner = (truth.wi[:, 2] > math.cos(1.1)) & (truth.wi[:, 2] < math.cos(0.1))  # away from the ends of θ_i
    for chosen in (inner & (density > 1), inner & (density < 1)):
        share = (estimated * density)[chosen]
        assert 0.6 < np.median(share) / np.median((estimated * density)[inner]) < 1.6
    assert estimated.mean() == pytest.approx(2 * math.pi)


def test_goniometers(tmp_path, rng):
    """Each of a few directions of incidence has the same total solid angle."""
    parts = [np.stack([np.full(n, t), 0 * np.ones(n), 1.4 * np.sqrt(rng.random(n)), 6.2 * rng.random(n)], axis=1)
             for t, n in ((0.2, 100), (0.6, 800), (1.1, 300))]  # fmt: skip
    truth = measured.ScatteredTruth(write(tmp_path / "rows.csv", rows_of(np.concatenate(parts), 1.0)))
    area = measured.solid_angles(truth, True)
    sums = [area[np.abs(truth.wi[:, 2] - math.cos(t)) < 1e-4].sum() for t in (0.2, 0.6, 1.1)]
    np.testing.assert_allclose(sums, np.mean(sums), rtol=0.03)


def test_noisy_rows_are_fitted(types, tmp_path, monkeypatch):
    """Five percent of noise and one of outliers cost little against the source without them; the file says so."""
    monkeypatch.setattr(training, "STARTS", 1)
    monkeypatch.setattr(training, "PROXY", dataclasses.replace(training.PROXY, steps=60, batch=2**11))
    source = {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}
    truth, rng = truth_of(source, types), np.random.default_rng(1)
    a = angles(rng, 6000)
    a[:, 0], a[:, 2] = np.arccos(np.clip(np.cos(a[:, [0, 2]]), 0.02, 1)).T
    directions = [types.Array3f(aligned(unit(*a[:, k : k + 2].T).T)) for k in (0, 2)]
    f = numpy_of(truth.value(*directions)) / np.cos(a[:, 2:3])
    f *= 1 + 0.05 * rng.normal(size=f.shape)
    f[rng.random(len(f)) < 0.01] *= 50
    path = write(tmp_path / "rows.csv", np.column_stack([np.degrees(a), f]))
    fitted = mi_diffind.fit("bsdf", path, steps=80, batch=2**11, measure_every=40, progress=False)
    fitted.save(tmp_path / "a.npz")
    figures = fitted.table.measured
    assert 0.03 < figures["relative_error"] < 0.06 and 0.3 < figures["albedo_largest"] < 1.001
    assert figures["sample_weight_moment"] < 1.3
    assert "isotropic (0%), symmetric" in fitted.lines[0] and "6,000 rows; left out: " in fitted.lines[1]
    with dr.suspend_grad():
        assert SphereView(truth, types, side=32, samples=32).psnr(fitted.model.bsdf.cosine_value) > 45
    again = inspect(tmp_path / "a.npz", measure=True).figures["measured_in_each_form"]
    assert next(iter(again.values()))["relative_error"] == pytest.approx(figures["relative_error"], rel=0.1)
    json.dumps(fitted.report)
