"""The plugins ``disney`` and ``neural_disney`` inside Mitsuba; what holds of every BSDF: ``test_bsdf_contract.py``."""

import disney_formulas
import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from bsdf_queries import bitmap, gradients_enabled, interactions, random_directions, texels, vectors
from disney_materials import FORMS
from disney_materials import RICH as COLOURED
from variants import set_variant

from mi_diffind.tasks.disney import TASK

#: Everything on but colours.
RICH = {name: value for name, value in COLOURED.items() if name != "base_color"}


def directions(mi, rng, n, low=0.0):
    return vectors(mi, random_directions(rng, n, low))


@pytest.mark.parametrize("name, decibels", [("disney", 120), ("tables", 84), ("paper", 34)])
def test_values_are_burleys(mi, rng, name, decibels):
    """Values for random texels; densities are those of the exact plugin."""
    n, ctx = 2**14, mi.BSDFContext()
    color, m, wi, wo = disney_formulas.random_case(rng, n, low_cosine=1e-3)
    color, m = color.astype(np.float32), {k: v.astype(np.float32) for k, v in m.items()}
    exact, bsdf = (  # each with textures of its own: loading takes their data
        mi.load_dict({**FORMS[form], **{k: texels(mi, v) for k, v in {**m, "base_color": color}.items()}})
        for form in ("disney", name)
    )
    si, towards = interactions(mi, wi, np.arange(n), n), vectors(mi, wo)
    value, pdf = bsdf.eval_pdf(ctx, si, towards)
    reference = disney_formulas.brdf(color, m, wi.astype("f4"), wo.astype("f4")) * wo[:, 2:3]
    error = np.clip(value.numpy().T, 0, 1) - np.clip(reference, 0, 1)
    assert -10 * np.log10(np.mean(error**2)) >= decibels
    assert np.array_equal(pdf.numpy(), exact.pdf(ctx, si, towards).numpy())


def test_gradient_at_a_black_albedo(mi, rng):
    """Each channel of a black albedo has the derivative of that channel, not that of the luminance."""
    for name in FORMS:
        bsdf = mi.load_dict({**FORMS[name], "base_color": {"type": "rgb", "value": 0.0}, "metallic": 0.5})
        params = mi.traverse(bsdf)
        si, wo = interactions(mi, directions(mi, rng, 1000, 0.2)), directions(mi, rng, 1000, 0.2)
        with gradients_enabled(mi, params, ["base_color.value"], 1000):
            value = bsdf.eval(mi.BSDFContext(), si, wo)
            dr.backward(value.x)
            gradient = params["base_color.value"].grad
            dr.eval(value, gradient)
        red, green, blue = gradient.numpy().sum(axis=1)
        params["base_color.value"] = mi.Color3f(1e-2, 0, 0)
        params.update()
        change = bsdf.eval(mi.BSDFContext(), si, wo).x.numpy() - dr.detach(value).x.numpy()
        assert red == pytest.approx(change.sum() / 1e-2, rel=1e-3)
        assert green == blue == 0


def test_tables_of_the_file_can_be_assigned(mi, rng):
    """Entries may have the file's shape as well as the padded one."""
    bsdf = mi.load_dict({**FORMS["paper"], **RICH})
    si, wo = interactions(mi, directions(mi, rng, 1000)), directions(mi, rng, 1000)
    before = bsdf.eval(mi.BSDFContext(), si, wo).numpy()
    params, table = mi.traverse(bsdf), TASK.load(TASK.file(preset="paper"))
    for name in ("ggx", "masking", "coat"):
        params[f"tables.{name}"] = mi.TensorXf(table.arrays[name].values)
    params.update()
    assert np.array_equal(bsdf.eval(mi.BSDFContext(), si, wo).numpy(), before)
    params["tables.ggx"] = mi.TensorXf(table.arrays["ggx"].values + 0.1)  # once more: the parameter is still the table
    params.update()
    assert not np.allclose(bsdf.eval(mi.BSDFContext(), si, wo).numpy(), before)


def one_value(mi, bsdf, wi, wo, **si_fields):
    si = interactions(mi, mi.Vector3f(*wi))
    for name, value in si_fields.items():
        setattr(si, name, value)
    return bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*wo)).numpy().ravel()


TILTED = (0.0, 0.6, 0.8), (0.6, 0.0, 0.8)


def test_changing_type_from_principled_is_all_it_takes(mi):
    scene = {
        "type": "principled", "base_color": {"type": "rgb", "value": [0.8, 0.3, 0.2]}, **RICH, "spec_trans": 0.0,
        "diffuse_reflectance_sampling_rate": 1.0, "main_specular_sampling_rate": 0.5, "clearcoat_sampling_rate": 2.0,
    }  # fmt: skip
    keys = set(mi.traverse(mi.load_dict(scene)).keys())
    for name in FORMS:
        found = set(mi.traverse(mi.load_dict({**scene, **FORMS[name]})).keys())
        assert keys - found <= {"spec_trans.value"}, keys - found


def test_aliases_and_indices_of_refraction(mi, rng):
    ctx = mi.BSDFContext()
    si, wo = interactions(mi, directions(mi, rng, 100)), directions(mi, rng, 100)

    def value(**parameters):
        return mi.load_dict({"type": "disney", **parameters}).eval(ctx, si, wo).numpy()

    assert np.array_equal(value(flatness=0.7), value(subsurface=0.7))
    eta = 1.5
    assert np.allclose(value(eta=eta), value(specular=((eta - 1) / (eta + 1)) ** 2 / 0.08), rtol=1e-5)
    texture = {"type": "uniform", "value": 0.25}
    assert np.allclose(value(specular=texture), value(specular=0.25), rtol=1e-6)
    assert not np.allclose(value(eta=2.5), value(eta=1.5))


def test_eta_out_of_its_range_is_not_taken_for_one_without_reflection(mi):
    """The reflectance of 0 is that of infinity, and limited to that of 3; only 1 reflects nothing."""
    for eta, meant in ((0.0, {"eta": 3.0}), (1.0, {"specular": 0.0})):
        bsdfs = [mi.load_dict({**FORMS["disney"], **p}) for p in ({"eta": bitmap(mi, np.full((4, 4), eta))}, meant)]
        assert np.allclose(*(one_value(mi, bsdf, *TILTED) for bsdf in bsdfs), rtol=1e-4), eta


def test_a_texture_of_ones_own_is_not_taken_for_a_bitmap(mi):
    """A Python texture whose parameter ``data`` is a tensor, but not what the texture gives."""

    class Inverted(mi.Texture):
        def __init__(self, props):
            super().__init__(props)
            self.data = mi.TensorXf(aligned(np.zeros((2, 2, 1), np.float32)))

        def traverse(self, cb):
            cb.put("data", self.data, mi.ParamFlags.Differentiable)

        def eval_1(self, si, active=True):
            return 1 - dr.gather(mi.Float, self.data.array, dr.zeros(mi.UInt32, dr.width(si.uv)))

        def is_spatially_varying(self):
            return True

        def to_string(self):
            return "Inverted[]"

    mi.register_texture("inverted_for_tests", Inverted)
    found, expected = (
        one_value(mi, mi.load_dict({**FORMS["disney"], "clearcoat": value}), *TILTED)
        for value in ({"type": "inverted_for_tests"}, 1.0)
    )
    assert np.allclose(found, expected, rtol=1e-5)


def test_a_narrow_line_of_a_spectrum_is_not_black():
    mi = set_variant("llvm_ad_spectral")
    line = {"type": "irregular", "wavelengths": "400, 553, 555, 557, 700", "values": "0, 0, 1, 0, 0"}
    values = []
    for effects in ("all", "used"):
        si = interactions(mi, mi.Vector3f(0, 0, 1))
        si.wavelengths = mi.UnpolarizedSpectrum(500, 554, 555, 556)
        bsdf = mi.load_dict({**FORMS["disney"], "base_color": line, "effects": effects})
        values.append(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1)).numpy().ravel())
    assert np.allclose(*values, rtol=1e-4)


def test_parameters_may_be_colours(mi_any, rng):
    """A scalar parameter given as a colour reads as its mean, as Mitsuba's ``eval_1`` says."""
    mi = mi_any
    color, grey = {"type": "rgb", "value": [0.6, 0.3, 0.2]}, {"type": "rgb", "value": [0.3, 0.3, 0.3]}
    names = ("roughness", "specular", "clearcoat")
    with_colors = mi.load_dict({"type": "disney", "base_color": color, **{k: grey for k in names}})
    plain = mi.load_dict({"type": "disney", "base_color": color, **{k: 0.3 for k in names}})
    si, wo = interactions(mi, directions(mi, rng, 100)), directions(mi, rng, 100)
    a, b = (x.eval(mi.BSDFContext(), si, wo).numpy() for x in (with_colors, plain))
    assert np.allclose(a, b, rtol=1e-4)


@pytest.mark.parametrize("name", list(FORMS))
def test_flags_reflectance_and_text(mi, name):
    bsdf = mi.load_dict({**FORMS[name], **RICH, "base_color": {"type": "rgb", "value": [0.1, 0.2, 0.3]}})
    assert bsdf.component_count() == 3
    flags, glossy = mi.BSDFFlags, mi.BSDFFlags.GlossyReflection
    for component, flag in ((0, flags.DiffuseReflection), (1, glossy), (1, flags.Anisotropic), (2, glossy)):
        assert mi.has_flag(bsdf.flags(component), flag)
    assert not mi.has_flag(bsdf.flags(), flags.BackSide)
    assert not mi.has_flag(mi.load_dict(FORMS[name]).flags(), flags.Anisotropic)
    reflectance = bsdf.eval_diffuse_reflectance(interactions(mi, mi.Vector3f(0, 0, 1)))
    assert np.allclose(reflectance.numpy().ravel(), [0.1, 0.2, 0.3])
    text = str(bsdf)
    assert text.startswith("Disney[" if name == "disney" else "NeuralDisney[") and "roughness" in text
    assert name != "paper" or "preset = paper, 12480 bytes as float32" in text
