"""Families in the plugin ``neural_bsdf``: parameters as numbers and textures, sampling, derivatives."""

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


def test_changed_tables_are_saved(mi_rgb, file, tmp_path):
    mi = mi_rgb
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": file, "storage": "float32"})
    params = mi.traverse(bsdf)
    params["tables.proxy"] = params["tables.proxy"] - 0.05
    params.update()
    mi_diffind.save(bsdf, tmp_path / "saved.npz")
    before, after = (load_table(path).arrays["proxy"].values for path in (file, tmp_path / "saved.npz"))
    np.testing.assert_allclose(after, before - 0.05, atol=5e-3)
