"""Families in the plugin ``neural_bsdf``: parameters as numbers and textures, sampling, derivatives."""

import drjit as dr
import numpy as np
import pytest
from arrays import numpy_of
from bsdf_queries import interactions, random_directions, uniform, vectors
from learned_bsdfs import formula, handmade_family, member

import mi_diffind
from mi_diffind.arrays.tables import load_table, save_table


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("families") / "family.npz"
    save_table(path, handmade_family())
    return str(path)


def row(mi, values):
    """A texture of a row of texels."""
    image = mi.Bitmap(np.float32(values).reshape(1, -1, 1))
    return {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "nearest"}


def test_numbers(mi_rgb, file, rng):
    """``eval`` is the formula of the member times the cosine; the default is the middle of the range."""
    mi, ctx = mi_rgb, mi_rgb.BSDFContext()
    wi, wo = random_directions(rng, 500, 0.05), random_directions(rng, 500, 0.05)
    for given, expected in (({"roughness": 0.1, "metallic": 0.25}, (0.1, 0.25)), ({}, (0.2, 0.5))):
        bsdf = mi.load_dict({"type": "neural_bsdf", "filename": file, **given})
        value = numpy_of(bsdf.eval(ctx, interactions(mi, wi), vectors(mi, wo)))
        truth = wo[:, 2:] * formula(member(load_table(file), *expected), wi.astype(float), wo.astype(float))
        np.testing.assert_allclose(value, truth, rtol=5e-3)


@pytest.mark.parametrize("is_textured", [False, True])
def test_textures(mi_rgb, file, rng, is_textured):
    """A texture is read at each point; values outside the range and NaN count as its ends. ``eval_pdf``, ``pdf`` and
    ``sample`` agree with ``eval``."""  # fmt: skip
    mi, n, ctx = mi_rgb, 2000, mi_rgb.BSDFContext()
    texels, meant = [0.1, 0.6, -3.0, 7.0, np.nan, np.inf], [0.1, 0.6, 0.05, 0.8, 0.05, 0.8]
    wi, wo = random_directions(rng, n, 0.05), random_directions(rng, n, 0.05)
    lane = np.arange(n) % len(texels)
    load = {"type": "neural_bsdf", "filename": file, "metallic": 0.3}
    more = {"metallic": row(mi, [0.3] * 6)} if is_textured else {}
    bsdf = mi.load_dict({**load, **more, "roughness": row(mi, texels)})
    assert bsdf.known == [False, not is_textured]
    assert mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy)
    si, towards = interactions(mi, wi, lane, len(texels)), vectors(mi, wo)
    value, pdf = bsdf.eval_pdf(ctx, si, towards)
    value, pdf = numpy_of(value), pdf.numpy()
    for k, roughness in enumerate(meant):
        lanes = lane == k
        one = mi.load_dict({**load, "roughness": roughness})
        expected = numpy_of(
            [*one.eval(ctx, interactions(mi, wi), towards), one.pdf(ctx, interactions(mi, wi), towards)]
        )
        np.testing.assert_allclose(value[lanes], expected[lanes, :3], rtol=2e-4)
        np.testing.assert_allclose(pdf[lanes], expected[lanes, 3], rtol=2e-4)
    bs, weight = bsdf.sample(ctx, si, *uniform(mi, rng, n))
    results = numpy_of([bs.pdf, bsdf.pdf(ctx, si, bs.wo), *weight, *bsdf.eval(ctx, si, bs.wo)])
    valid = results[:, 0] > 0
    assert 0.7 < valid.mean() <= 1 and np.isfinite(results).all()
    np.testing.assert_allclose(results[valid, 0], results[valid, 1], rtol=1e-4)
    np.testing.assert_allclose(results[valid, 2:5] * results[valid, :1], results[valid, 5:], rtol=1e-3, atol=1e-6)


def test_derivatives(mi_rgb, file, rng):
    """Derivatives by a texel and by a number agree with finite differences; tables can be optimised."""
    mi, ctx = mi_rgb, mi_rgb.BSDFContext()
    texture = row(mi, [0.1, 0.3, 0.6, 0.0])
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": file, "storage": "float32", "metallic": 0.3,
                         "roughness": texture})  # fmt: skip
    params = mi.traverse(bsdf)
    wi, wo = random_directions(rng, 300, 0.2), random_directions(rng, 300, 0.2)
    si, towards = interactions(mi, wi, np.arange(300) % 4, 4), vectors(mi, wo)

    def total():
        return dr.sum(sum(bsdf.eval(ctx, si, towards)))

    for key, index in (("roughness.data", 1), ("metallic.value", 0)):
        before, ends = type(params[key])(params[key]), []
        for sign in (1, -1):
            changed = before.numpy().copy()
            changed.reshape(-1)[index] += sign * 1e-3
            params[key] = type(before)(changed)
            params.update()
            ends.append(float(total()[0]))
        params[key] = before
        dr.enable_grad(params[key])
        params.update()
        dr.backward(total())
        slopes = dr.grad(params[key]).numpy().reshape(-1)
        slope = float(slopes[index])
        params[key] = dr.detach(before)
        params.update()
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=0.03, abs=1e-2), key
        assert np.isfinite(slopes).all() and (key == "metallic.value" or slopes[3] == 0)
    for key in ("tables.mixing", "tables.proxy"):
        dr.enable_grad(params[key])
    params.update()
    dr.backward(total())
    assert min(np.abs(dr.grad(params[key]).numpy()).max() for key in ("tables.mixing", "tables.proxy")) > 1e-3


def test_a_constant_member_is_computed_once(mi_rgb, file, rng):
    """A member of constant parameters has the values of the tables, follows changes, and is differentiable."""
    mi, ctx = mi_rgb, mi_rgb.BSDFContext()
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": file, "roughness": 0.2, "metallic": 0.3})
    wi, wo = random_directions(rng, 200, 0.2), random_directions(rng, 200, 0.2)
    si, towards = interactions(mi, wi), vectors(mi, wo)
    params, ends = mi.traverse(bsdf), []

    def value():
        return sum(bsdf.eval_pdf(ctx, si, towards)[0])

    for roughness in (0.151, 0.149):
        params["roughness.value"] = mi.Float(roughness)
        params.update()
        assert bsdf.known == [True, True]
        ends.append(value())
    params["roughness.value"] = mi.Float(0.15)
    dr.enable_grad(params["roughness.value"])
    params.update()
    assert bsdf.known == [False, True]
    attached = value()
    dr.backward(dr.sum(attached))
    slope = float(dr.grad(params["roughness.value"])[0])
    assert slope == pytest.approx(float(dr.sum(ends[0] - ends[1])[0]) / 2e-3, rel=0.02)
    middle = 0.5 * (ends[0] + ends[1])
    np.testing.assert_allclose(dr.detach(attached).numpy(), middle.numpy(), rtol=5e-3)


def test_changed_tables_are_saved(mi_rgb, file, tmp_path):
    mi = mi_rgb
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": file, "storage": "float32"})
    params = mi.traverse(bsdf)
    params["tables.proxy"] = params["tables.proxy"] - 0.05
    params.update()
    mi_diffind.save(bsdf, tmp_path / "saved.npz")
    before, after = (load_table(path).arrays["proxy"].values for path in (file, tmp_path / "saved.npz"))
    np.testing.assert_allclose(after, before - 0.05, atol=5e-3)
