"""The analytic Disney model, and the tables that stand in for it, against an independent implementation."""

import dataclasses

import disney_formulas
import drjit as dr
import drjit.llvm.ad as ad
import numpy as np
import pytest
from arrays import aligned

from mi_diffind import StoredArray
from mi_diffind import fit as fit_task
from mi_diffind.arrays.tables import TableError, save_table
from mi_diffind.fitting.loop import EXPONENTIAL_RATE
from mi_diffind.tasks.disney import TASK
from mi_diffind.tasks.disney.decoder import Decoder
from mi_diffind.tasks.disney.model import PARAMETERS, Effects, Material, ValueBounds, find_effects
from mi_diffind.tasks.disney.training import LAYOUTS, measure, shade

N = 100_000


def decoder_of(preset, storage=""):
    """Decoder of the tables that ship, or of the rearranged formulas."""
    return Decoder() if preset == "formulas" else TASK.open(ad.TensorXf, "", preset, storage).decoder


def to_drjit(case):
    color, m, wi, wo = case
    material = Material(**{k: ad.Float(aligned(m[k])) for k in PARAMETERS})
    return material, *(ad.Array3f(aligned(v.T)) for v in (color, wi, wo))


def shaded(decoder, case, effects=Effects()):  # noqa: B008
    material, color, wi, wo = to_drjit(case)
    return shade(decoder, material, color, wi, wo, effects).numpy().T.astype(np.float64)


@pytest.mark.parametrize("preset", list(LAYOUTS))
def test_shipped_tables_keep_their_promises(preset):
    table = TASK.load(TASK.file(preset=preset))
    layout, _ = LAYOUTS[preset]
    assert preset == layout.PRESET == table.preset and list(TASK.presets) == list(LAYOUTS)
    assert all(array.shape == layout.SHAPES[name] for name, array in table.arrays.items())
    assert table.nbytes <= 12_500
    if preset == "paper":
        decoder = sum(a.entries.size for n, a in table.arrays.items() if not n.startswith("encoder"))
        assert decoder == 3104  # the paper's Table 1
    assert table.settings == dataclasses.asdict(TASK.presets[preset])


@pytest.fixture(scope="module")
def million():
    """Distribution → 10⁶ random directions and materials with the value of the independent reference, in parts."""
    rng, found = np.random.default_rng(20231212), {}
    for distribution in ("training", "uniform"):
        parts = []
        for _ in range(4):
            rate = EXPONENTIAL_RATE if distribution == "training" else 0.0
            color, m, wi, wo = disney_formulas.random_case(rng, 250_000, rate=rate)
            wi, wo = (np.where(w[:, 2:3] > 1e-6, w, [0, 0, 1]) for w in (wi, wo))
            parts.append((to_drjit((color, m, wi, wo)), disney_formulas.brdf(color, m, wi, wo), wo[:, 2:3]))
        found[distribution] = parts
    return found


#: (BRDF · cosine, BRDF alone) in dB: what is promised, a little less than what is reached.
PROMISED = {
    "formulas": {"": (126, 120)},
    "tables": {"float32": (87, 83), "float16": (82, 79), "uint8": (77, 71)},
    "paper": dict.fromkeys(("float32", "float16", "uint8"), (38.5, 33)),
}


@pytest.mark.parametrize("distribution", ["training", "uniform"])
@pytest.mark.parametrize("preset, storage", [(preset, storage) for preset in PROMISED for storage in PROMISED[preset]])
def test_accuracy_over_a_million_samples(million, preset, storage, distribution):
    """PSNR over 10⁶ random directions and materials against the independent reference."""
    decoder = decoder_of(preset, storage)
    squared, count = np.zeros(2), 0
    for (material, color, wi, wo), reference, cosine in million[distribution]:
        found = shade(decoder, material, color, wi, wo).numpy().T.astype(np.float64)
        for i, (a, b) in enumerate(((reference * cosine, found), (reference, found / cosine))):
            squared[i] += np.sum((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2)
        count += found.size
    with_cosine, without = -10 * np.log10(squared / count)
    print(f"{preset} {storage} {distribution}: {with_cosine:.2f} dB (BRDF · cosine), {without:.2f} dB (BRDF)")
    promised = np.subtract(PROMISED[preset][storage], 4 if (preset, distribution) == ("paper", "uniform") else 0)
    assert with_cosine >= promised[0]
    assert without >= promised[1]


def test_measure_agrees_with_the_independent_reference(rng):
    decoder = decoder_of("paper")
    case = disney_formulas.random_case(rng, N, low_cosine=1e-4)
    exact, values = disney_formulas.brdf(*case) * case[3][:, 2:3], shaded(decoder, case)
    independent = -10 * np.log10(np.mean((exact.clip(0, 1) - values.clip(0, 1)) ** 2))
    # Other samples of a heavy-tailed error: seeds differ by ± 0.5 dB
    assert abs(measure(decoder, ad, 2**18, "uniform")["psnr_db"] - independent) < 1


@pytest.mark.parametrize("preset", list(LAYOUTS))
def test_fit_improves(preset, few_samples):
    layout, decoder = LAYOUTS[preset]
    start = measure(decoder(layout().alloc(ad.TensorXf)), ad, 2**16)["psnr_db"]
    short = {"steps": 30, "batch": 4096, "measure_every": 15, "seed": 1}
    table = fit_task("disney", preset=preset, variant="llvm", progress=False, **short).table
    assert table.measured["psnr_db"] > start + 1 and table.preset == preset and table.seed == 1
    assert {"psnr_db", "psnr_brdf_db", "psnr_uniform_db", "psnr_brdf_uniform_db", "mae"} <= set(table.measured)


@pytest.mark.parametrize("preset", list(LAYOUTS))
def test_masking_is_read_above_its_floor(rng, preset):
    """Entries that an optimiser makes 0 count as the least that masking may be."""
    decoder, case, values = decoder_of(preset), disney_formulas.random_case(rng, 1000, 0.01), []
    masking, (floor, _) = decoder.arrays.masking, decoder.arrays.RANGES["masking"]
    for entry in (0.0, floor):
        masking.data = dr.full(ad.TensorXf, entry, masking.data.shape)
        values.append(shaded(decoder, case))
    np.testing.assert_allclose(*values, rtol=1e-5)
    assert np.isfinite(values).all()


def test_files_of_no_preset_are_refused(tmp_path):
    """A file of another preset, and one with entries out of range."""
    table, path = TASK.load(TASK.file()), tmp_path / "own.npz"
    table.arrays["masking"] = StoredArray(-table.arrays["masking"].entries)
    for broken, sentence in (
        (dataclasses.replace(table, preset="best"), 'holds tables of the preset "best", allowed are tables, paper'),
        (table, 'entries of "masking" lie in .* allowed is'),
    ):
        save_table(path, broken)
        with pytest.raises(TableError, match=rf"own\.npz: {sentence}"):
            TASK.load(path)


# -- effects in use ----------------------------------------------------------------------------------------------------


def constant(value, **more):
    return ValueBounds(value, value, **more)


def test_effects_of_typical_materials():
    dielectric = dict.fromkeys(PARAMETERS, constant(0)) | {"roughness": constant(0.5), "specular": constant(0.5)}
    effects, reasons = find_effects({"base_color": ValueBounds(), **dielectric})
    assert effects.names == ("diffuse", "dielectric") and effects.lobes == ("diffuse", "specular")
    assert reasons["clearcoat"] == "clearcoat is 0" and reasons["subsurface"] == "flatness is 0"
    assert reasons["sheen_tint"] == "sheen_tint is 0"

    effects, reasons = find_effects({**dielectric, "metallic": constant(1), "sheen": constant(1)})
    assert effects.names == ("metal",) and effects.lobes == ("specular",)
    assert reasons["diffuse"] == reasons["sheen"] == reasons["dielectric"] == "metallic is 1"

    effects, reasons = find_effects({**dielectric, "base_color": constant(0, grey=True), "specular": constant(0)})
    assert effects.names == () and effects.lobes == ("specular",)
    assert reasons["diffuse"] == "base_color is black"

    assert find_effects({})[0] == Effects() and not find_effects({})[1]


def test_tints_of_a_grey_albedo_are_left_out():
    effects, reasons = find_effects({"base_color": ValueBounds(0.1, 0.9, grey=True)})
    assert not effects.spec_tint and not effects.sheen_tint and effects.sheen and effects.dielectric
    assert reasons["spec_tint"] == "base_color has no hue"
    assert find_effects({"base_color": ValueBounds(0.1, 0.9, grey=True, optimised=True)})[0].spec_tint


@pytest.mark.parametrize("storage", ["float32", "uint8"])
def test_the_coat_of_the_shipped_tables(storage):
    """Width and normalisation of GTR1 (Burley 2012), whose tables hold the error of their rounding besides."""
    gloss = np.linspace(0, 0.9, 181)
    alpha = 0.1 + gloss * (0.001 - 0.1)
    expected = alpha, (alpha**2 - 1) / (np.pi * np.log(alpha**2))
    arrays = TASK.open(ad.TensorXf, "", "tables", storage).decoder.arrays
    for found, value in zip(arrays.coat_values(ad.Float(aligned(gloss.astype(np.float32)))), expected, strict=True):
        np.testing.assert_allclose(found.numpy(), value, rtol=1e-3)
