"""The plugins ``disney`` and ``neural_disney`` inside Mitsuba."""

import functools

import disney_formulas
import drjit as dr
import numpy as np
import pytest
import spheres
from arrays import aligned
from gradients import gradients_enabled
from variants import set_variant

from mi_diffind import StoredArray
from mi_diffind.arrays.tables import save_table
from mi_diffind.tasks.disney import TASK

#: Every version of the model in Mitsuba.
PLUGINS = {
    "disney": {"type": "disney"},
    "tables": {"type": "neural_disney"},
    "paper": {"type": "neural_disney", "preset": "paper", "storage": "float32"},
}

#: Everything on, nothing at a limit or at a texel of the tables, where their slope changes.
RICH = {
    "roughness": 0.43, "anisotropic": 0.5, "metallic": 0.3, "specular": 0.6, "spec_tint": 0.4, "sheen": 0.5,
    "sheen_tint": 0.6, "flatness": 0.3, "clearcoat": 0.7, "clearcoat_gloss": 0.63,
}  # fmt: skip

MATERIALS = {
    "rich": RICH,
    "diffuse": {"roughness": 1.0, "specular": 0.0},
    "sheen_only": {"base_color": 0.0, "sheen": 1.0, "roughness": 1.0, "specular": 0.0},
    "coat_only": {
        "base_color": 0.0,
        "specular": 0.0,
        "roughness": 1.0,
        "clearcoat": 1.0,
        "clearcoat_gloss": 0.3,
    },
    "metal": {"metallic": 1.0, "roughness": 0.3},
    "smooth_metal": {"metallic": 1.0, "roughness": 0.2},
    "anisotropic": {"metallic": 1.0, "roughness": 0.5, "anisotropic": 1.0},
    "rough_metal": {"metallic": 1.0, "roughness": 1.0},
}


def interactions(mi, wi, n=None):
    si = dr.zeros(mi.SurfaceInteraction3f, n or dr.width(wi))
    si.wi = wi
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    return si


def directions(mi, rng, n, low_cosine=0.0):
    z = low_cosine + (1 - low_cosine) * rng.random(n)
    phi = 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - z * z)
    return mi.Vector3f(*(aligned(v) for v in (r * np.cos(phi), r * np.sin(phi), z)))


def sphere_scene(mi, bsdf, integrator="path", size=16, **extra):
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": integrator, **({"max_depth": 3} if integrator != "direct" else {})},
        "sensor": {
            "type": "perspective", "fov": 45.0,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "light": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "point", "position": [2.0, 3.0, 4.0], "intensity": 20.0},
        "shape": {"type": "sphere", "bsdf": bsdf},
        **extra,
    })  # fmt: skip


# -- values ------------------------------------------------------------------------------------------------------------


def textured(mi, name, color, m, **more):
    """A BSDF with one random material a texel, and the interactions that hit each texel's centre."""
    n = int(np.sqrt(len(color)))

    def texture(values):
        data = mi.TensorXf(aligned(np.asarray(values, np.float32).reshape(n, n, -1)))
        return {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest", "format": "variant"}

    return mi.load_dict(
        {**PLUGINS[name], "base_color": texture(color), **{k: texture(v) for k, v in m.items()}, **more}
    )


def texel_interactions(mi, wi):
    n = int(np.sqrt(len(wi)))
    si = interactions(mi, mi.Vector3f(aligned(wi.T)))
    index = np.arange(n * n)
    si.uv = mi.Point2f(aligned((index % n + 0.5) / n), aligned((index // n + 0.5) / n))
    return si


def test_disney_is_burley(mi_rgb, rng):
    color, m, wi, wo = disney_formulas.random_case(rng, 64 * 64, low_cosine=0.02)
    m["roughness"] = 0.1 + 0.9 * m["roughness"]
    color, m = color.astype(np.float32), {k: v.astype(np.float32) for k, v in m.items()}
    wo_ = mi_rgb.Vector3f(wo.T.astype(np.float32))
    bsdf = textured(mi_rgb, "disney", color, m)
    found = bsdf.eval(mi_rgb.BSDFContext(), texel_interactions(mi_rgb, wi), wo_).numpy().T
    reference = disney_formulas.brdf(color, m, wi.astype("f4"), wo.astype("f4")) * wo[:, 2:3]
    error = np.abs(found - reference) / (reference + 1e-2)
    assert np.quantile(error, 0.99) < 1e-5 and error.max() < 2e-4


#: What differs between plugins is the value, not what sampling does with it: not all pairs.
SAMPLED = [(name, m) for m in MATERIALS for name in PLUGINS if name == "disney" or m in ("rich", "coat_only", "metal")]


@pytest.mark.parametrize("name, material", SAMPLED)
def test_sample_eval_and_pdf_agree(mi_rgb, rng, name, material):
    bsdf = mi_rgb.load_dict({**PLUGINS[name], **MATERIALS[material]})
    ctx, n = mi_rgb.BSDFContext(), 20_000
    si = interactions(mi_rgb, directions(mi_rgb, rng, n))
    uniform = [mi_rgb.Float(aligned(rng.random(n))) for _ in range(3)]
    bs, weight = bsdf.sample(ctx, si, uniform[0], mi_rgb.Point2f(uniform[1], uniform[2]))
    value, pdf, both = bsdf.eval(ctx, si, bs.wo), bsdf.pdf(ctx, si, bs.wo), bsdf.eval_pdf(ctx, si, bs.wo)
    dr.eval(bs, weight, value, pdf, both)
    valid = (bs.pdf.numpy() > 0) & (bs.wo.z.numpy() > 0)
    assert valid.mean() > 0.5
    value, pdf = value.numpy(), pdf.numpy()
    assert np.allclose(both[0].numpy(), value, rtol=1e-5)
    assert np.allclose(both[1].numpy(), pdf, rtol=1e-5)
    assert np.allclose(bs.pdf.numpy()[valid], pdf[valid], rtol=2e-3)
    assert np.allclose(weight.numpy()[:, valid], (value / np.maximum(pdf, 1e-30))[:, valid], rtol=2e-3, atol=1e-5)
    assert (weight.numpy()[:, ~valid] == 0).all()
    # A density that misses where the energy is shows up as a huge weight
    assert weight.numpy().max() < 60
    assert np.quantile(weight.numpy(), 0.999) < 8


@pytest.mark.parametrize(
    "name, n, rounds",
    [(n, 50_000, 8) for n in PLUGINS] + [pytest.param(n, 500_000, 20, marks=pytest.mark.slow) for n in PLUGINS],
)
def test_finite_and_non_negative_over_many_inputs(mi_rgb, rng, name, n, rounds):
    """Random and adversarial directions × random and extreme materials: eval, pdf, sampling weight; up to 10⁷."""
    mi = mi_rgb
    special = np.array([0, 1e-38, 1e-30, 1e-20, 1e-12, 1e-8, 1e-6, 1e-4, 1e-2, 0.5, 1 - 1e-7, 1])
    params_rng = np.random.default_rng(7)
    bsdf = mi.load_dict({**PLUGINS[name], "base_color": {"type": "rgb", "value": 0.5}})
    params = mi.traverse(bsdf)
    keys = [k for k in params.keys() if k.endswith(".value") and k != "base_color.value"] + ["specular"]
    for i in range(rounds):

        def value(shape):
            draw = params_rng.random(shape)
            extreme = params_rng.random(shape) < 0.4
            return np.where(extreme, params_rng.integers(0, 2, shape), draw).astype(np.float32)

        for key in keys:
            params[key] = mi.Float(float(value(())))
        params["base_color.value"] = mi.Color3f(*map(float, value(3)))
        params.update()

        z = np.where(rng.random((2, n)) < 0.3, rng.choice(special, (2, n)), rng.random((2, n)))
        phi = 2 * np.pi * rng.random((2, n))
        r = np.sqrt(1 - z * z)
        w = np.stack([r * np.cos(phi), r * np.sin(phi), z * np.where(rng.random((2, n)) < 0.05, -1, 1)], axis=1)
        kind = rng.integers(0, 8, n)
        w[1] = np.where(kind == 0, w[0], w[1])  # wi = wo
        w[1] = np.where(kind == 1, -w[0], w[1])  # opposite
        w[1] = np.where(kind == 2, w[0] * [[-1], [-1], [1]], w[1])  # mirrored
        w[1] = np.where(kind == 3, w[0] * [[-1], [-1], [1]] + 1e-6 * rng.standard_normal((3, n)), w[1])
        wi, wo = (mi.Vector3f(aligned(v)) for v in w)
        si, ctx = interactions(mi, wi), mi.BSDFContext()
        f, pdf = bsdf.eval_pdf(ctx, si, wo)
        u = [mi.Float(aligned(rng.random(n))) for _ in range(3)]
        if i % 2:
            u = [mi.Float(aligned(rng.choice(np.array([0, 1 - 2**-24, 0.5]), n))) for _ in range(3)]
        bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
        dr.eval(f, pdf, bs, weight)
        for what, v in (("eval", f), ("pdf", pdf), ("weight", weight), ("sample pdf", bs.pdf)):
            v = v.numpy()
            assert np.isfinite(v).all() and v.min() >= 0, (what, i, v.min(), v.max(), dict(params.items()))
        below = (wi.z.numpy() <= 0) | (wo.z.numpy() <= 0)
        assert (f.numpy()[:, below] == 0).all() and (pdf.numpy()[below] == 0).all()


def test_gradients_are_finite_for_adversarial_inputs(mi_rgb, rng):
    mi, n = mi_rgb, 100_000
    z = rng.choice(np.array([0, 1e-38, 1e-20, 1e-8, 1e-4, 0.5, 1, -0.5]), (2, n))
    phi = rng.choice(np.array([0, 1.0, np.pi]), (2, n))
    r = np.sqrt(1 - z * z)
    wi, wo = (mi.Vector3f(aligned([r[i] * np.cos(phi[i]), r[i] * np.sin(phi[i]), z[i]])) for i in (0, 1))
    for name in PLUGINS:
        for end in (0.0, 1.0):
            bsdf = mi.load_dict({**PLUGINS[name], "base_color": {"type": "rgb", "value": end}})
            params = mi.traverse(bsdf)
            keys = [k for k in params.keys() if not k.endswith("rate")]
            for key in keys:
                if not key.startswith("tables") and key != "base_color.value":
                    params[key] = mi.Float(end)
            with gradients_enabled(mi, params, keys, n):
                value = bsdf.eval(mi.BSDFContext(), interactions(mi, wi), wo)
                dr.backward(value.x + value.y + value.z)
                gradients = {key: dr.grad(params[key]) for key in keys}
                dr.eval(gradients)
            for key, gradient in gradients.items():
                assert np.isfinite(gradient.numpy()).all(), (name, end, key)


def test_gradient_at_a_black_albedo(mi_rgb, rng):
    """Each channel of a black albedo has the derivative of that channel, not that of the luminance."""
    mi = mi_rgb
    for name in PLUGINS:
        bsdf = mi.load_dict({**PLUGINS[name], "base_color": {"type": "rgb", "value": 0.0}, "metallic": 0.5})
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


def test_nan_textures_do_not_spread(mi_rgb, rng):
    mi = mi_rgb
    nan = {
        "type": "bitmap",
        "data": mi.TensorXf(aligned(np.full((4, 4, 1), np.nan, np.float32))),
        "raw": True,
        "format": "variant",
    }
    bsdf = mi.load_dict({**PLUGINS["tables"], "roughness": nan, "base_color": nan, "clearcoat": nan})
    si = interactions(mi, directions(mi, rng, 100))
    value = bsdf.eval(mi.BSDFContext(), si, directions(mi, rng, 100)).numpy()
    assert np.isfinite(value).all() and value.min() >= 0


# -- the tables against the formulas -----------------------------------------------------------------------------------


@functools.lru_cache
def random_texels(variant):
    """Colours and parameters of 512² materials, directions for each, and value and density of the exact plugin."""
    mi = set_variant(variant)
    color, m, wi, wo = disney_formulas.random_case(np.random.default_rng(20231212), 512 * 512)
    color, m = color.astype("f4"), {name: values.astype("f4") for name, values in m.items()}
    si, wo = texel_interactions(mi, wi), mi.Vector3f(aligned(wo.T))
    value, pdf = textured(mi, "disney", color, m).eval_pdf(mi.BSDFContext(), si, wo)
    dr.eval(value, pdf)
    return color, m, si, wo, value.numpy(), pdf.numpy()


@pytest.mark.parametrize(
    "name, storage, decibels",
    [
        *(("tables", storage, bar) for storage, bar in (("float32", 86), ("float16", 82), ("uint8", 80), (None, 80))),
        *(("paper", storage, 34) for storage in ("float32", "float16", "uint8")),
    ],
)
def test_learned_and_exact_plugins_agree(mi_rgb, name, storage, decibels):
    mi = mi_rgb
    color, m, si, wo, exact, exact_pdf = random_texels(mi.variant())
    learned = textured(mi, name, color, m, **({"storage": storage} if storage else {}))
    value, pdf = learned.eval_pdf(mi.BSDFContext(), si, wo)
    dr.eval(value, pdf)
    mse = np.mean((np.clip(exact, 0, 1) - np.clip(value.numpy(), 0, 1)) ** 2, dtype=np.float64)
    assert -10 * np.log10(mse) >= decibels
    assert np.array_equal(exact_pdf, pdf.numpy())


def test_disney_is_what_the_formulas_say(mi_rgb, rng):
    """Rearranged, with coefficients of constants evaluated once, and from textures: equal up to rounding."""
    from mi_diffind.tasks.disney import model
    from mi_diffind.tasks.disney.training import Shaded

    mi, ctx = mi_rgb, mi_rgb.BSDFContext()

    def formulas(color, m, wi, wo):
        p = Shaded.of(model.Material(**{k: mi.Float(v) for k, v in m.items()}), mi.Color3f(color))
        return model.colour(model.compose(p, model.exact_factors(p, wi, wo)).values(), p.albedo, p.luminance).numpy()

    def decibels(a, b):
        return -10 * np.log10(np.mean(np.square(np.clip(a, 0, 1) - np.clip(b, 0, 1)), dtype=np.float64))

    color, m, wi, wo = disney_formulas.random_case(rng, 256 * 256)
    color, m = color.astype("f4"), {k: v.astype("f4") for k, v in m.items()}
    si, wo = texel_interactions(mi, wi), mi.Vector3f(wo.T.astype("f4"))
    found = textured(mi, "disney", color, m).eval(ctx, si, wo).numpy()
    assert decibels(found, formulas(color.T, m, si.wi, wo)) >= 150
    for material in MATERIALS.values():
        full = {**dict.fromkeys(disney_formulas.NAMES, 0.0), "roughness": 0.5, "specular": 0.5, **material}
        albedo = 3 * [full.pop("base_color", 0.5)]
        found = mi.load_dict({"type": "disney", **material}).eval(ctx, si, wo).numpy()
        assert decibels(found, formulas(albedo, full, si.wi, wo)) >= 150, material


def test_own_tables(mi_rgb, rng, tmp_path):
    """``filename`` is read, relative to the scene, and two instances with different tables stay apart."""
    mi = mi_rgb
    table = TASK.load(TASK.file(preset="paper")).to("float32")
    table.arrays["masking"] = StoredArray(2 * table.arrays["masking"].values)  # a quarter of the specular reflection
    save_table(tmp_path / "own.npz", table)
    (tmp_path / "m.xml").write_text(
        '<bsdf version="3.0.0" type="neural_disney"><string name="filename" value="own.npz"/>'
        '<string name="storage" value="float32"/>'
        '<float name="metallic" value="1"/></bsdf>'
    )
    own = mi.load_file(str(tmp_path / "m.xml"))
    shipped = mi.load_dict({**PLUGINS["paper"], "metallic": 1.0})
    si, wo = interactions(mi, directions(mi, rng, 1000, 0.2)), directions(mi, rng, 1000, 0.2)
    a, b = (x.eval(mi.BSDFContext(), si, wo).numpy() for x in (own, shipped))
    assert np.allclose(a, b / 4, rtol=1e-3)


def test_assigning_tables_changes_one_instance_only(mi_rgb, rng):
    mi = mi_rgb
    first, second = (mi.load_dict({**PLUGINS["paper"], "metallic": 1.0}) for _ in range(2))
    si, wo = interactions(mi, directions(mi, rng, 1000, 0.2)), directions(mi, rng, 1000, 0.2)
    before = second.eval(mi.BSDFContext(), si, wo).numpy()
    params = mi.traverse(first)
    params["tables.masking"] = params["tables.masking"] * 2
    params.update()
    assert np.allclose(first.eval(mi.BSDFContext(), si, wo).numpy(), before / 4, rtol=1e-3)
    assert np.array_equal(second.eval(mi.BSDFContext(), si, wo).numpy(), before)


def test_tables_of_the_file_can_be_assigned(mi_rgb, rng):
    """Entries may have the file's shape as well as the padded one; any other is refused in a sentence."""
    mi = mi_rgb
    bsdf = mi.load_dict({**PLUGINS["paper"], **RICH})
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
    params["tables.ggx"] = mi.TensorXf(aligned(np.zeros((4, 4, 3), np.float32)))
    with pytest.raises(RuntimeError, match=r'"tables.ggx": "data" has the shape \(4, 4, 3\), expected \(16, 16, 3\)'):
        params.update()
    params["tables.ggx"] = mi.TensorXf(table.arrays["ggx"].values)
    params.update()


def test_a_file_is_read_as_bytes_or_as_asked_for(mi_rgb, tmp_path):
    save_table(tmp_path / "own.npz", TASK.load(TASK.file(preset="tables")))
    own = {"type": "neural_disney", "filename": str(tmp_path / "own.npz")}
    assert "preset = tables, 384 bytes as uint8" in str(mi_rgb.load_dict(own))
    assert "preset = tables, 1536 bytes as float32" in str(mi_rgb.load_dict({**own, "storage": "float32"}))


# -- parameters --------------------------------------------------------------------------------------------------------


def test_changing_type_from_principled_is_all_it_takes(mi_rgb):
    scene = {
        "type": "principled", "base_color": {"type": "rgb", "value": [0.8, 0.3, 0.2]}, **RICH, "spec_trans": 0.0,
        "diffuse_reflectance_sampling_rate": 1.0, "main_specular_sampling_rate": 0.5, "clearcoat_sampling_rate": 2.0,
    }  # fmt: skip
    keys = set(mi_rgb.traverse(mi_rgb.load_dict(scene)).keys())
    for name in PLUGINS:
        found = set(mi_rgb.traverse(mi_rgb.load_dict({**scene, **PLUGINS[name]})).keys())
        assert keys - found <= {"spec_trans.value"}, keys - found


@pytest.mark.parametrize("name", list(PLUGINS))
def test_updated_parameters_show(mi_rgb, name):
    mi = mi_rgb
    scene = sphere_scene(mi, {**PLUGINS[name], "id": "m", "base_color": {"type": "rgb", "value": [0.1, 0.1, 0.1]}})
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("base_color.value"))
    before = mi.render(scene, params, spp=32).numpy()[4:12, 4:12].mean(axis=(0, 1))
    params[key] = mi.Color3f(0.9, 0.1, 0.1)
    params.update()
    after = mi.render(scene, params, spp=32).numpy()[4:12, 4:12].mean(axis=(0, 1))
    assert after[0] > 3 * before[0]
    assert np.allclose(after[1:], before[1:], rtol=0.05)


def test_aliases_and_indices_of_refraction(mi_rgb, rng):
    mi, ctx = mi_rgb, mi_rgb.BSDFContext()
    si, wo = interactions(mi, directions(mi, rng, 100)), directions(mi, rng, 100)

    def value(**parameters):
        return mi.load_dict({"type": "disney", **parameters}).eval(ctx, si, wo).numpy()

    assert np.array_equal(value(flatness=0.7), value(subsurface=0.7))
    eta = 1.5
    assert np.allclose(value(eta=eta), value(specular=((eta - 1) / (eta + 1)) ** 2 / 0.08), rtol=1e-5)
    texture = {"type": "uniform", "value": 0.25}
    assert np.allclose(value(specular=texture), value(specular=0.25), rtol=1e-6)
    assert not np.allclose(value(eta=2.5), value(eta=1.5))


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


@pytest.mark.parametrize(
    "parameters, sentence",
    [
        ({"roughness": 1.5}, 'parameter "roughness": found 1.5, allowed is [0, 1]'),
        ({"metallic": -0.1}, 'parameter "metallic": found -0.1, allowed is [0, 1]'),
        ({"sheen": float("nan")}, 'parameter "sheen": found nan'),
        ({"specular": 2.0}, 'parameter "specular": found 2, allowed is [0, 1]'),
        ({"eta": 0.5}, 'parameter "eta": found 0.5, allowed is [1, 3.0]'),
        ({"eta": 1.5, "specular": 0.5}, 'parameter "eta": sets the same reflectance as "specular"'),
        ({"flatness": 0.5, "subsurface": 0.5}, 'parameter "subsurface": is another name of "flatness"'),
        ({"spec_trans": 0.5}, 'parameter "spec_trans": found 0.5'),
        ({"clearcoat_sampling_rate": -1.0}, 'parameter "clearcoat_sampling_rate": found -1'),
        ({"roughnes": 0.5}, '"roughnes"'),
    ],
)
@pytest.mark.parametrize("name", list(PLUGINS))
def test_bad_parameters_are_refused(mi_rgb, name, parameters, sentence):
    with pytest.raises(RuntimeError) as caught:
        mi_rgb.load_dict({**PLUGINS[name], **parameters})
    assert sentence in str(caught.value)


@pytest.mark.parametrize(
    "parameters, sentence",
    [
        ({"storage": "float8"}, 'parameter "storage": found "float8", allowed are float32, float16, uint8'),
        ({"filename": "nowhere.npz"}, "nowhere.npz: no such file"),
        ({"preset": "best"}, 'parameter "preset": found "best", allowed are tables, paper'),
        ({"quality": "paper"}, '"quality"'),
        ({"effects": "some"}, 'parameter "effects": found "some", allowed are used, all'),
    ],
)
def test_bad_tables_are_refused(mi_rgb, parameters, sentence):
    with pytest.raises(RuntimeError) as caught:
        mi_rgb.load_dict({"type": "neural_disney", **parameters})
    assert sentence in str(caught.value)


def test_scalar_variants_are_refused():
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    for name in PLUGINS:
        with pytest.raises(RuntimeError, match='does not run in the variant "scalar_rgb"; use one of llvm_ad_rgb'):
            mi.load_dict(PLUGINS[name])


@pytest.mark.parametrize("name", list(PLUGINS))
def test_flags_and_components(mi_rgb, rng, name):
    mi = mi_rgb
    bsdf = mi.load_dict({**PLUGINS[name], **RICH})
    assert bsdf.component_count() == 3
    assert mi.has_flag(bsdf.flags(0), mi.BSDFFlags.DiffuseReflection)
    assert mi.has_flag(bsdf.flags(1), mi.BSDFFlags.GlossyReflection)
    assert mi.has_flag(bsdf.flags(1), mi.BSDFFlags.Anisotropic)
    assert mi.has_flag(bsdf.flags(2), mi.BSDFFlags.GlossyReflection)
    assert not mi.has_flag(bsdf.flags(), mi.BSDFFlags.BackSide)
    assert not mi.has_flag(mi.load_dict(PLUGINS[name]).flags(), mi.BSDFFlags.Anisotropic)

    si, wo = interactions(mi, directions(mi, rng, 1000)), directions(mi, rng, 1000)
    total = bsdf.eval(mi.BSDFContext(), si, wo).numpy()
    parts = 0
    for component, expected in enumerate(("DiffuseReflection", "GlossyReflection", "GlossyReflection")):
        ctx = mi.BSDFContext()
        ctx.component = component
        parts = parts + bsdf.eval(ctx, si, wo).numpy()
        bs, _ = bsdf.sample(ctx, si, mi.Float(0.4), mi.Point2f(0.3, 0.6))
        valid = bs.pdf.numpy() > 0
        assert (np.broadcast_to(bs.sampled_component.numpy(), len(valid))[valid] == component).all()
        assert (
            np.broadcast_to(bs.sampled_type.numpy(), len(valid))[valid] == int(getattr(mi.BSDFFlags, expected))
        ).all()
    assert np.allclose(parts, total, rtol=1e-4, atol=1e-6)
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.DiffuseReflection
    diffuse_only = mi.BSDFContext()
    diffuse_only.component = 0
    assert np.array_equal(bsdf.eval(ctx, si, wo).numpy(), bsdf.eval(diffuse_only, si, wo).numpy())


def test_diffuse_reflectance_and_text(mi_rgb):
    mi = mi_rgb
    for name in PLUGINS:
        bsdf = mi.load_dict({**PLUGINS[name], "base_color": {"type": "rgb", "value": [0.1, 0.2, 0.3]}})
        si = interactions(mi, mi.Vector3f(0, 0, 1), 1)
        assert np.allclose(bsdf.eval_diffuse_reflectance(si).numpy().ravel(), [0.1, 0.2, 0.3])
        text = str(bsdf)
        assert text.startswith("Disney[" if name == "disney" else "NeuralDisney[")
        assert "roughness" in text and "specular = [0.5]" in text
    assert "preset = paper, 12480 bytes as float32" in text and "effects = diffuse, dielectric" in text


# -- scenes, variants, wrappers ----------------------------------------------------------------------------------------


def test_every_variant_renders(mi_any):
    """A sphere for each plugin, none of which lights another, next to those of ``principled``."""
    mi, m = mi_any, {"base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}, **RICH}
    image, reference = (
        mi.render(spheres.sphere_scene(mi, [{**form, **m} for form in forms], size=32, depth=2), spp=64).numpy()
        for forms in (PLUGINS.values(), [{"type": "principled"}] * len(PLUGINS))
    )
    assert np.isfinite(image).all() and image.min() >= 0
    for i, name in enumerate(PLUGINS):
        where = np.s_[16 * (i // 2) : 16 * (i // 2) + 16, 16 * (i % 2) : 16 * (i % 2) + 16, :3]
        # Another Fresnel term, otherwise the same model: close, not equal
        assert abs(image[where].mean() / reference[where].mean() - 1) < 0.06, name


@pytest.mark.parametrize("kind", ["llvm_ad_spectral", "llvm_ad_mono"])
def test_white_is_white_in_every_colour_mode(kind):
    """A grey material has the same luminance in RGB and in other colour modes, tints included."""
    import mitsuba as mi

    means = []
    for variant in ("llvm_ad_rgb", kind):
        mi.set_variant(variant)
        bsdf = {"type": "disney", "base_color": {"type": "uniform", "value": 0.5}, **RICH}
        means.append(mi.render(sphere_scene(mi, bsdf), spp=256).numpy()[4:12, 4:12, :3].mean(axis=(0, 1)))
    assert np.allclose(means[0], means[1], rtol=0.03), means


def test_wrappers(mi_rgb):
    mi, name = mi_rgb, "disney"
    inner = {**PLUGINS[name], **RICH}
    flat = mi.TensorXf(aligned(np.tile(np.array([0.5, 0.5, 1.0], "f4"), (4, 4, 1))))
    wrapped = {
        "twosided": {"type": "twosided", "bsdf": inner},
        "blendbsdf": {"type": "blendbsdf", "weight": 0.5, "a": inner, "b": {**PLUGINS[name], **RICH}},
        "mask": {"type": "mask", "opacity": 1.0, "bsdf": inner},
        "normalmap": {
            "type": "normalmap", "bsdf": inner,
            "normalmap": {"type": "bitmap", "data": flat, "raw": True, "format": "variant"},
        },
        "bumpmap": {
            "type": "bumpmap", "bsdf": inner,
            "arbitrary": {"type": "bitmap", "data": mi.TensorXf(aligned(np.zeros((4, 4, 1), "f4"))), "raw": True},
        },
    }  # fmt: skip
    # A sphere for each, none of which lights another
    images, plain = (
        mi.render(spheres.sphere_scene(mi, bsdfs, size=48, columns=3, depth=2), spp=32).numpy()
        for bsdfs in (list(wrapped.values()), [inner] * len(wrapped))
    )
    assert np.isfinite(images).all()
    for i, kind in enumerate(wrapped):
        where = np.s_[16 * (i // 3) : 16 * (i // 3) + 16, 16 * (i % 3) : 16 * (i % 3) + 16]
        assert np.allclose(images[where].mean(axis=(0, 1)), plain[where].mean(axis=(0, 1)), rtol=0.03), kind


def test_one_instance_on_many_shapes(mi_rgb):
    mi = mi_rgb
    extra = {
        f"s{i}": {
            "type": "sphere", "radius": 0.2, "center": [0.5 * i - 1, 1.2, 0.0], "bsdf": {"type": "ref", "id": "m"}
        }
        for i in range(5)
    }  # fmt: skip
    scene = sphere_scene(mi, {"type": "neural_disney", "id": "m", **RICH}, **extra)
    assert np.isfinite(mi.render(scene, spp=4).numpy()).all()


# -- gradients through the renderer ------------------------------------------------------------------------------------


def mean_and_error(samples):
    samples = np.asarray(samples)
    return samples.mean(axis=0), samples.std(axis=0, ddof=1) / np.sqrt(len(samples))


def finite_difference(params, key, step, render):
    original = type(params[key])(params[key])
    totals = []
    for sign in (1, -1):
        params[key] = original + sign * step
        params.update()
        totals.append(float(render().array[0]))
    params[key] = original
    params.update()
    return (totals[0] - totals[1]) / (2 * step)


KEYS = {
    "base_color.value": 0.02, "roughness.value": 0.01, "metallic.value": 0.02, "clearcoat.value": 0.05,
    "sheen.value": 0.05, "anisotropic.value": 0.05, "specular": 0.05, "flatness.value": 0.05,
    "spec_tint.value": 0.05, "sheen_tint.value": 0.05, "clearcoat_gloss.value": 0.02,
}  # fmt: skip


#: Each plugin, and each integrator; all pairs of them in the slow run.
RENDERED = {("prb", "tables"), ("direct", "paper"), ("path", "disney")}


@pytest.mark.parametrize(
    "integrator, name",
    [
        pytest.param(integrator, name, marks=() if (integrator, name) in RENDERED else pytest.mark.slow)
        for integrator in ("prb", "direct", "path")
        for name in PLUGINS
    ],
)
def test_gradients_through_render(mi_rgb, integrator, name):
    """
    Reverse mode through each integrator against finite differences of a weighted mean of the image (the highlight once,
    the shaded side three times, so that no parameter's influence cancels). Both are Monte Carlo estimates: they have to
    agree within 4 standard errors (4 seeds) and 2%. With respect to every parameter through one of the integrators, and
    to some of each lobe and the tables through the others.
    """
    mi = mi_rgb
    bsdf = {**PLUGINS[name], "base_color": {"type": "rgb", "value": [0.6, 0.4, 0.3]}, **RICH}
    if name != "disney":
        bsdf["storage"] = "float32"
    scene = sphere_scene(mi, bsdf, integrator, size=8)
    params = mi.traverse(scene)
    prefix = next(k for k in params.keys() if k.endswith("roughness.value"))[: -len("roughness.value")]
    keys = [
        *(KEYS if integrator == "prb" else ("base_color.value", "roughness.value", "clearcoat.value")),
        *{"tables": ("tables.masking", "tables.alpha"), "paper": ("tables.masking", "tables.ggx")}.get(name, ()),
    ]
    found, expected = [], []
    for seed in range(4):

        def render(seed=seed):
            image = mi.render(scene, params, spp=2048, seed=seed)
            return dr.mean(image[1:4, 4:6], axis=None) + 3 * dr.mean(image[4:7, 1:4], axis=None)

        # Only unrolled loops can be differentiated in reverse by plain automatic differentiation
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, integrator == "prb"):
            for key in keys:
                dr.enable_grad(params[prefix + key])
            params.update()
            dr.backward(render())
            gradients = [dr.grad(params[prefix + key]) for key in keys]
            dr.eval(gradients)
            found.append([float(gradient.numpy().sum()) for gradient in gradients])
            for key in keys:
                dr.disable_grad(params[prefix + key])
        expected.append([finite_difference(params, prefix + key, KEYS.get(key, 0.01), render) for key in keys])
    found, found_error = mean_and_error(found)
    expected, expected_error = mean_and_error(expected)
    for key, a, b, error in zip(keys, found, expected, np.hypot(found_error, expected_error), strict=True):
        assert abs(a - b) <= 4 * error + 0.02 * abs(b), (key, a, b, error)
        assert error < 0.3 * abs(b), (key, a, b, error)  # or the comparison would say nothing


def test_optimisation_recovers_a_colour(mi_rgb):
    mi = mi_rgb
    target = mi.render(
        sphere_scene(mi, {"type": "disney", "base_color": {"type": "rgb", "value": [0.7, 0.2, 0.1]}}, "prb"),
        spp=64,
    )
    scene = sphere_scene(mi, {"type": "neural_disney", "base_color": {"type": "rgb", "value": 0.5}}, "prb")
    params = mi.traverse(scene)
    key = next(k for k in params.keys() if k.endswith("base_color.value"))
    opt = mi.ad.Adam(lr=0.05)
    opt[key] = params[key]
    for i in range(40):
        params[key] = opt[key]
        params.update()
        dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=8, seed=i) - target), axis=None))
        opt.step()
        opt[key] = dr.clip(opt[key], 0, 1)
    assert np.allclose(opt[key].numpy().ravel(), [0.7, 0.2, 0.1], atol=0.05)
