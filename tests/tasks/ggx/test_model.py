"""The GGX distribution, its encodings and the tables that stand in for it, against an independent implementation."""

import copy
import dataclasses
import os

import drjit as dr
import ggx_formulas
import numpy as np
import pytest
from arrays import aligned

from mi_diffind import fit as fit_task
from mi_diffind import load_model
from mi_diffind.arrays import lookup
from mi_diffind.arrays.tables import TableError, save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import EXPONENTIAL_RATE
from mi_diffind.fitting.task import FitRequest
from mi_diffind.tasks.ggx import TASK
from mi_diffind.tasks.ggx.model import ALPHA_FLOOR, ALPHA_MIN, ENCODINGS, LearnedGGX, ggx, indirection
from mi_diffind.tasks.ggx.training import BANDS, draw, measure, table_encoding

PRESETS = tuple(TASK.presets)


@pytest.fixture(scope="module")
def shipped():
    """Preset → (table, encoding)."""
    tables = {preset: TASK.load(TASK.file(preset=preset)) for preset in PRESETS}
    return {preset: (table, table_encoding(table)) for preset, table in tables.items()}


def stored(ad, shipped, preset, storage="float32"):
    return TASK.model(shipped[preset][0], ad.TensorXf, storage).distribution


def random_case(rng, n, low=ALPHA_FLOOR):
    """sin² and α in float32: half of the angles anywhere, half within the lobe, some at its very centre."""
    alpha = np.exp(rng.uniform(np.log(low), 0, n)).astype(np.float32)
    lobe = np.minimum(10 * alpha.astype(np.float64) ** 2 * rng.random(n), 1)
    sin2 = np.where(rng.random(n) < 0.5, rng.random(n), lobe)
    sin2[::100] = 0
    return np.minimum(sin2, 1 - 2**-24).astype(np.float32), alpha


def evaluate(ad, distribution, sin2, alpha):
    sin2 = ad.Float(aligned(sin2))
    alpha = ad.Float(aligned(alpha)) if np.ndim(alpha) else dr.opaque(ad.Float, alpha)  # one kernel for all numbers
    return distribution(dr.sqrt(1 - sin2), sin2, alpha).numpy().astype(np.float64)


# -- the truth ---------------------------------------------------------------------------------------------------------


def test_ggx_is_walters(ad, rng):
    sin2, alpha = random_case(rng, 100_000)
    expected = ggx_formulas.distribution(sin2, alpha)
    np.testing.assert_allclose(evaluate(ad, lambda _, *x: ggx(*x), sin2, alpha), expected, rtol=2e-6)


# -- encodings ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_the_tail_falls_as_that_of_the_distribution(ad, shipped, storage):
    """Nowhere more than a tenth above what it should be or below it, down to the horizon and to the least roughness."""
    alphas = np.exp(np.linspace(np.log(ALPHA_FLOOR), 0, 500)).astype(np.float32)[:, None]
    a, t = alphas.astype(np.float64), np.linspace(0, 1, 1000)
    sin2 = np.minimum(a * a * np.expm1(t * np.log1p(1 / a**2)), 1 - 2**-24).astype(np.float32)
    sin2, alphas = (v.ravel() for v in np.broadcast_arrays(sin2, alphas))
    found = evaluate(ad, stored(ad, shipped, "tables", storage), sin2, alphas)
    ratio = found / ggx_formulas.distribution(sin2, alphas)
    print(f"{storage}: {ratio.min():.3f} to {ratio.max():.3f} times")
    assert ratio.min() > 0.9 and ratio.max() < 1.1


# -- samples and errors ------------------------------------------------------------------------------------------------


def test_training_distributions(ad):
    n = 200_000
    generator = dr.rng(seed=3)
    cos, sin2, alpha = (v.numpy().astype(np.float64) for v in draw(generator, ad, n, "paper"))
    np.testing.assert_allclose(cos**2 + sin2, 1, atol=1e-6)
    assert alpha.min() == np.float32(ALPHA_MIN) and alpha.max() <= 1
    for t in (0.1, 0.5, 0.9):
        assert abs(np.mean(sin2 < t) - t) < 0.005  # cosine-weighted
        cdf = (1 - np.exp(-EXPONENTIAL_RATE * t)) / (1 - np.exp(-EXPONENTIAL_RATE))
        assert abs(np.mean(alpha < t) - cdf) < 0.005
    assert np.median(alpha) == pytest.approx(0.21, abs=0.005)

    cos, sin2, alpha = (v.numpy().astype(np.float64) for v in draw(generator, ad, n, "tables"))
    np.testing.assert_allclose(cos**2 + sin2, 1, atol=1e-6)
    assert abs(np.mean(sin2 == 0) - 0.125) < 0.005
    # Of those drawn from the peak, the share within an angle is the area of normals within it
    q = sin2 / (sin2 + alpha**2 * (1 - sin2))
    for t in (0.25, 0.5, 0.75):
        of_the_peak, of_the_rest = t, np.mean(t * alpha**2 / (t * alpha**2 + 1 - t))
        assert abs(np.mean(q <= t) - (0.125 + 0.375 * of_the_peak + 0.5 * of_the_rest)) < 0.005


#: Error → a distribution that has it, and its errors at the peak and in the lobe, by the band of the roughness.
KNOWN_ERRORS = {
    "scaled": (lambda d, alpha: 1.1 * d(alpha), lambda band: (0.1, 0.1)),
    # At the peak 1 − 1/1.03²; where D is a tenth of it, α²/q² gains 1.03² (q₁₀ / (q₁₀ + (1.03² − 1) α²))²
    "wider": (lambda d, alpha: d(1.03 * alpha), lambda band: (1 - 1.03**-2, pytest.approx(1 - 1.03**-2, rel=0.05))),
    "in a band": (
        lambda d, alpha: d(alpha) * dr.select((alpha > 0.02) & (alpha < 0.05), 0.5, 1),
        lambda band: (0.5, 0.5) if band == (0.01, 0.1) else (0, 0),
    ),
}


@pytest.mark.parametrize("what", KNOWN_ERRORS)
def test_measure_recognises_known_errors(ad, what):
    distribution, expected = KNOWN_ERRORS[what]
    errors = measure(lambda cos, sin2, alpha: distribution(lambda a: ggx(sin2, a), alpha), ad, 10_000)
    for low, high in BANDS:
        for name, error in zip(("peak", "lobe"), expected((low, high)), strict=True):
            error = pytest.approx(error, rel=1e-3, abs=1e-5) if isinstance(error, (int, float)) else error
            assert errors[f"{name}_error_{low:g}_{high:g}"] == error


# -- the tables that ship ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("preset", PRESETS)
def test_shipped_tables_are_what_their_files_say(ad, shipped, preset):
    table, encoding = shipped[preset]
    assert {name: a.shape for name, a in table.arrays.items()} == {"primary": (16, 16, 2), "cascaded": (8, 8, 1)}
    assert table.storage == "float32" and table.nbytes == 2304
    settings = dataclasses.asdict(TASK.presets[preset])
    assert table.settings == {**settings, **dataclasses.asdict(encoding)} and table.preset == preset
    assert encoding == ENCODINGS[preset]
    measured = measure(stored(ad, shipped, preset), ad)
    assert measured.keys() == table.measured.keys()
    for name, value in table.measured.items():
        assert measured[name] == pytest.approx(value, rel=2e-3, abs=1e-5), name


#: What is promised for each storage form, a little less than what is reached: PSNR in dB, largest error at the peak
#: and in the lobe.
PROMISED = {"float32": (57, 0.001, 0.03), "float16": (56.5, 0.002, 0.03), "uint8": (50, 0.01, 0.035)}


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("preset", PRESETS)
def test_accuracy_by_an_independent_reader(ad, shipped, rng, preset, storage):
    """Values equal those that NumPy and SciPy read, whose PSNR is that of a million other samples."""
    table, encoding = shipped[preset]
    independent = ggx_formulas.learned(table.to(storage), encoding.inputs, encoding.output)
    sin2, alpha = random_case(rng, 100_000)
    found, expected = evaluate(ad, stored(ad, shipped, preset, storage), sin2, alpha), independent(sin2, alpha)
    error = np.abs(found - expected) / (expected + 1e-3)
    # Bytes are read at 1/64 of a step of the primary array, which the cascaded one amplifies
    tolerance = {"float32": 2e-4, "float16": 2e-4, "uint8": 0.01 if preset == "tables" else 0.15}[storage]
    assert error.max() < tolerance and np.quantile(error, 0.99) < tolerance / 3

    sin2, alpha = rng.random(10**6), -np.log(1 - rng.random(10**6) * (1 - np.exp(-3))) / 3
    alpha = np.maximum(alpha, ALPHA_MIN)
    exact = ggx_formulas.distribution(sin2, alpha)
    psnr = -10 * np.log10(np.mean((independent(sin2, alpha).clip(0, 1) - exact.clip(0, 1)) ** 2))
    print(f"{preset} {storage}: {psnr:.2f} dB")
    assert psnr >= (PROMISED[storage][0] if preset == "tables" else 33)
    if storage == "float32":
        # Other samples of a heavy-tailed error: seeds differ by ± 0.4 dB
        assert psnr == pytest.approx(table.measured["psnr_db"], abs=1)


# -- training ----------------------------------------------------------------------------------------------------------


def run(preset, storage="float32", **changes):
    return fit_task("ggx", preset=preset, variant="llvm", storage=storage, progress=False, **changes)


#: Settings of a training that shows that it trains.
SHORT = {"steps": 60, "batch": 4096, "measure_every": 20}


@pytest.mark.parametrize("preset", PRESETS)
def test_fit_improves_and_is_repeatable(tmp_path, preset):
    start = indirection().alloc(array_module("llvm").TensorXf)
    start = measure(LearnedGGX(start, ENCODINGS[preset]), array_module("llvm"), 2**16)["psnr_db"]
    files = []
    for name, seed in (("first", 1), ("second", 1), ("other", 2)):
        fitted = run(preset, seed=seed, **{**SHORT, "lr": 1e-2})
        save_table(tmp_path / name, fitted.table)
        files.append((tmp_path / name).read_bytes())
        assert fitted.result.steps == SHORT["steps"] and fitted.table.seed == seed
        assert fitted.table.measured["psnr_db"] > start + 1
    assert files[0] == files[1] != files[2]
    read = TASK.load(tmp_path / "first")
    assert table_encoding(read) == ENCODINGS[preset] and read.preset == preset
    settings = dataclasses.asdict(dataclasses.replace(TASK.presets[preset], seed=1, lr=1e-2, **SHORT))
    assert read.settings == {**settings, **dataclasses.asdict(ENCODINGS[preset])}


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_fit_of_other_sizes(tmp_path, storage):
    ad = array_module("llvm")
    table = run("tables", storage, primary=9, cascaded=5, **{**SHORT, "steps": 20}).table
    assert {name: a.shape for name, a in table.arrays.items()} == {"primary": (9, 9, 2), "cascaded": (5, 5, 1)}
    assert table.storage == storage and table.nbytes == 187 * {"float32": 4, "float16": 2, "uint8": 1}[storage]
    save_table(tmp_path / "own.npz", table)
    model = TASK.open(ad.TensorXf, tmp_path / "own.npz")
    assert model.table.preset == "tables" and model.arrays["primary"].storage == storage
    assert model.storage == storage and model.nbytes == table.nbytes <= model.memory_nbytes
    measured = model.measure()
    assert measured == load_model(tmp_path / "own.npz", ad.TensorXf).measure()
    for name, value in table.measured.items():  # those of the storage form
        assert measured[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name


def test_what_a_checkpoint_has_to_agree_in():
    """Samples and encoding, besides the settings; entries of two forms are stored as they are."""
    ad = array_module("llvm")
    request = FitRequest("paper", TASK.presets["paper"], ad, options={"primary": 5, "cascaded": 4})
    problem = TASK.problem(request)
    assert problem.identity == {"samples": "paper", "inputs": "plain", "output": "raw"}
    problem.net = problem.net.to("uint8", "float16")
    table = TASK.table(problem, request)
    assert table.storage == "uint8/float16" and TASK.model(table, ad.TensorXf).storage == "uint8/float16"


@pytest.mark.parametrize("name, sides", [("primary", (1, 8)), ("cascaded", (8, 1)), ("primary", (5000, 8))])
def test_impossible_sizes_are_refused(name, sides):
    with pytest.raises(ValueError, match=f"{name}: found .*, allowed are 2 to 4096 entries a side"):
        indirection(*sides)


# -- files -------------------------------------------------------------------------------------------------------------


def set_pointer(table):
    table.arrays["primary"].entries.flat[3] = 1.5


BROKEN = {
    "no encoding": (lambda t: t.settings.pop("inputs"), "the settings name no known encoding"),
    "an unknown encoding": (lambda t: t.settings.update(output="cube"), "the settings name no known encoding"),
    "a pointer out of the table": (set_pointer, r'entries of "primary" lie in \[.*, 1.5\], allowed is'),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_wrong_file_is_refused(tmp_path, shipped, what):
    change, sentence = BROKEN[what]
    path, table = tmp_path / "own.npz", copy.deepcopy(shipped["tables"][0])
    change(table)
    save_table(path, table)
    dtype = array_module("llvm").TensorXf
    for read in (TASK.load, lambda p: TASK.open(dtype, p)):
        with pytest.raises(TableError, match=sentence) as caught:
            read(path)
        assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_a_file_that_was_replaced_is_read_again(tmp_path, shipped, ad):
    """A replaced file is read again, also within the resolution of its time if its size differs."""
    path = tmp_path / "own.npz"
    found = []
    for i, preset in enumerate(PRESETS):
        save_table(path, shipped[preset][0])
        os.utime(path, ns=(i, i))
        found.append(TASK.open(ad.TensorXf, path).table.preset)
    assert found == list(PRESETS)
    save_table(path, shipped["tables"][0].to("uint8"))
    os.utime(path, ns=(i, i))
    assert TASK.open(ad.TensorXf, path).storage == "uint8"
