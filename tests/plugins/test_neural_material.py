"""
The BSDF ``neural_material`` inside Mitsuba: against ``normalmap``, ``disney``, ``mask`` and ``twosided`` with a
``neural_texture`` for each map of the same file. (The lobes themselves: ``test_disney.py``; the maps:
``test_texture_contract.py``.)
"""

import gc

import drjit as dr
import numpy as np
import pytest
import texture_scenes
from bsdf_queries import random_directions, uniform, vectors
from texture_files import make, material, write_manifest

import mi_diffind
from mi_diffind import plugins
from mi_diffind.arrays.tables import save_table
from mi_diffind.maps.source import from_arrays
from mi_diffind.measure.clock import bsdf_operations
from mi_diffind.plugins.support import footprint
from mi_diffind.scenes import loading
from mi_diffind.tasks.texture import TASK

WIDTH, HEIGHT = 32, 16


def constant(*values):
    return np.full((HEIGHT, WIDTH, len(values)), values)


def stored(path, extras=None, **maps):
    maps = {name: v if v.dtype == np.uint8 else np.rint(255 * v).astype(np.uint8) for name, v in maps.items()}
    return make(path, from_arrays(maps), extras=extras)


def shapes(shape):
    """Extras of all shapes, weights from 0.4 to 1."""
    return np.random.default_rng(5).random(shape) * [1, 1, 0.6] + [0, 0, 0.4]


def neutral(shape):
    return np.broadcast_to([128 / 255, 128 / 255, 1.0], shape)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder, maps = tmp_path_factory.mktemp("materials"), material(WIDTH, HEIGHT)
    other = np.roll(maps["roughness"], 5, axis=1)
    metal = {**maps, "metallic": other}
    leaf = {"base_color": maps["albedo"], "normal": maps["normal"], "roughness": maps["roughness"], "opacity": other}
    # Nothing but the roughness varies, and no lobe but the specular one and the diffuse one is possible
    plain = {"albedo": constant(0.2, 0.2, 0.2), "roughness": maps["roughness"], "metallic": constant(0)}
    return {
        "metal": stored(folder / "metal.npz", **metal),
        "shaped": stored(folder / "shaped.npz", shapes, **metal),
        "round": stored(folder / "round.npz", neutral, **metal),
        "leaf": stored(folder / "leaf.npz", **leaf, ao=other[::-1]),
        "plain": stored(folder / "plain.npz", **plain, emission=constant(0.5, 0.2, 0.1)),
        "other": stored(folder / "other.npz", albedo=maps["albedo"], height=maps["roughness"]),
    }


#: Parameter of ``disney`` → map of ``metal``.
METAL = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}


def separate(file, maps, constants, **reading):
    """The same material as several plugins."""

    def texture(name):
        return {"type": "neural_texture", "filename": file, "channels": name, **reading}

    inner = {"type": "disney", **{parameter: texture(name) for parameter, name in maps.items()}, **constants}
    return {"type": "normalmap", "normalmap": texture("normal"), "inner": inner}


def directions(mi, rng, n, below=False):
    w = random_directions(rng, n)
    w[:, 2] *= rng.choice([-1, 1], n) if below else 1
    return vectors(mi, w)


def hits(mi, rng, n, below=False):
    """Hits with footprints of all sizes, seen from all sides."""
    ddx, ddy = texture_scenes.footprints(rng, n, (WIDTH, HEIGHT))
    si = texture_scenes.hits(mi, rng.random((2, n)), ddx, ddy)
    si.wi, si.sh_frame = directions(mi, rng, n, below), mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.dp_du, si.dp_dv, si.n = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Normal3f(0, 0, 1)
    return si


def assert_close(actual, desired, rtol, atol):
    """All but two lanes of a thousand are within the tolerances, and all within 100 times of them."""
    np.testing.assert_allclose(actual, desired, rtol=100 * rtol, atol=100 * atol)
    beyond = np.abs(actual - desired) > atol + rtol * np.abs(desired)
    assert beyond.reshape(-1, beyond.shape[-1]).any(axis=0).mean() < 2e-3


def assert_equal(mi, rng, ours, theirs, below):
    """Values, densities and samples of two materials are equal up to rounding."""
    n, ctx = 4000, mi.BSDFContext()
    si, wo, u = hits(mi, rng, n, below), directions(mi, rng, n, below), uniform(mi, rng, n)
    results = [(b.eval(ctx, si, wo), b.pdf(ctx, si, wo), b.eval_pdf(ctx, si, wo), *b.sample(ctx, si, *u))
               for b in (ours, theirs)]  # fmt: skip
    dr.eval(results)
    (value, pdf, both, bs, weight), (value_, pdf_, _, bs_, weight_) = results
    value, pdf, valid = value.numpy(), pdf.numpy(), bs_.pdf.numpy() > 0
    assert (pdf > 0).mean() > 0.15 and value.max() > 0.5
    np.testing.assert_allclose(value, value_.numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(pdf, pdf_.numpy(), rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(both[0].numpy(), value)
    np.testing.assert_array_equal(both[1].numpy(), pdf)
    valid &= (
        weight_.numpy().max(axis=tuple(range(weight_.numpy().ndim - 1))) > 0
    )  # normalmap leaves the density of a sample below the horizon
    assert valid.mean() > 0.3
    np.testing.assert_array_equal(valid, bs.pdf.numpy() > 0)
    # Where a lobe is narrow, rounding of a random number moves a direction: by processor, in a lane of a thousand
    assert_close(bs.wo.numpy()[:, valid], bs_.wo.numpy()[:, valid], 0, 1e-5)
    assert_close(bs.pdf.numpy()[valid], bs_.pdf.numpy()[valid], 1e-3, 0)
    assert_close(weight.numpy(), np.where(valid, weight_.numpy(), 0), 1e-3, 1e-5)
    np.testing.assert_array_equal(bs.sampled_component.numpy()[valid], bs_.sampled_component.numpy()[valid])


@pytest.mark.parametrize(
    "reading", [{}, {"filter": "anisotropic", "wrap_mode": "mirror"}, {"filter": "off", "storage": "float32"}]
)
@pytest.mark.parametrize("two_sided", [False, True])
def test_equals_separate_plugins(mi, files, rng, reading, two_sided):
    constants = {"clearcoat": 0.6, "anisotropic": 0.4, "specular": 0.7}
    reading = {**reading, "to_uv": mi.ScalarTransform4f().scale([2, 3, 1]).rotate([0, 0, 1], 30)}
    theirs = separate(files["metal"], METAL, constants, **reading)
    ours = {"type": "neural_material", "filename": files["metal"], "two_sided": two_sided, **constants, **reading}
    theirs = {"type": "twosided", "inner": theirs} if two_sided else theirs
    assert_equal(mi, rng, mi.load_dict(ours), mi.load_dict(theirs), two_sided)


@pytest.mark.parametrize("reading", [{}, {"filter": "anisotropic"}])
def test_transform_and_sides_of_the_file(mi, files, rng, tmp_path, reading):
    """The file's texture transform comes before ``to_uv``, and its two sides are those of ``twosided``."""
    turn = mi.ScalarTransform4f().translate([0.3, -0.2, 0]).rotate([0, 0, 1], 30).scale([1.5, -0.4, 1])
    place = mi.ScalarTransform4f().scale([2, 3, 1])
    table = TASK.load(files["metal"])
    layout, path = table.settings["layout"], str(tmp_path / "placed.npz")
    layout["double_sided"] = True
    for entry in layout["maps"]:
        entry["transform"] = [float(turn.matrix[i, j]) for i in (0, 1) for j in (0, 1, 3)]
    save_table(path, table)
    ours = {"type": "neural_material", "filename": path, "to_uv": place, **reading}
    theirs = {**ours, "filename": files["metal"], "to_uv": place @ turn}
    assert_equal(mi, rng, mi.load_dict(ours), mi.load_dict({"type": "twosided", "inner": theirs}), True)
    assert_equal(mi, rng, mi.load_dict({**ours, "two_sided": False}), mi.load_dict(theirs), False)
    del layout["maps"][1]["transform"]
    save_table(path, table)
    assert 'the maps "albedo" (uv transform [1.299 0.2 0.3, 0.75 -0.3464 -0.2]) and "normal" (none) differ in' in (
        texture_scenes.refused(mi, ours)
    )
    for name, to_uv in (("albedo", place @ turn), ("normal", place)):
        texture = {"type": "neural_texture", "channels": name, **reading}
        pair = {**texture, "filename": path, "to_uv": place}, {**texture, "filename": files["metal"], "to_uv": to_uv}
        a, b = (mi.load_dict(one).eval_3(hits(mi, np.random.default_rng(1), 500)).numpy() for one in pair)
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_equals_separate_plugins_in_every_variant(mi_any, files, rng):
    ours = mi_any.load_dict({"type": "neural_material", "filename": files["metal"]})
    assert_equal(mi_any, rng, ours, mi_any.load_dict(separate(files["metal"], METAL, {})), False)
    si = hits(mi_any, rng, 100)
    base_color = mi_any.load_dict({"type": "neural_texture", "filename": files["metal"], "channels": "albedo"})
    np.testing.assert_allclose(
        mi_any.unpolarized_spectrum(ours.eval_diffuse_reflectance(si)).numpy(), base_color.eval(si).numpy(), rtol=1e-5
    )


def test_opacity_is_that_of_mask(mi, files, rng):
    ctx, n = mi.BSDFContext(), 4000
    maps = {"base_color": "base_color", "roughness": "roughness"}
    opacity = {"type": "neural_texture", "filename": files["leaf"], "channels": "opacity"}
    theirs = {"type": "mask", "opacity": opacity, "inner": separate(files["leaf"], maps, {})}
    theirs = mi.load_dict(theirs)
    ours = mi.load_dict({"type": "neural_material", "filename": files["leaf"]})
    si, wo, u = hits(mi, rng, n, True), directions(mi, rng, n), uniform(mi, rng, n)
    results = [(b.eval(ctx, si, wo), b.pdf(ctx, si, wo), b.eval_null_transmission(si), *b.sample(ctx, si, *u))
               for b in (ours, theirs)]  # fmt: skip
    dr.eval(results)
    for a, b in zip(results[0][:3], results[1][:3], strict=True):
        np.testing.assert_allclose(a.numpy(), b.numpy(), rtol=1e-4, atol=1e-6)
    (bs, weight), (bs_, weight_) = (r[3:] for r in results)
    through = bs_.sampled_type.numpy() == int(mi.BSDFFlags.Null)
    assert 0.3 < through.mean() < 0.7 and (bs.sampled_component.numpy()[through] == 3).all()
    np.testing.assert_array_equal(bs.sampled_type.numpy() == int(mi.BSDFFlags.Null), through)
    np.testing.assert_allclose(bs.wo.numpy()[:, through], -si.wi.numpy()[:, through])
    np.testing.assert_allclose(bs.pdf.numpy()[through], bs_.pdf.numpy()[through], rtol=1e-5)
    np.testing.assert_allclose(weight.numpy(), weight_.numpy(), rtol=1e-3, atol=1e-5)
    pdf = ours.pdf(ctx, si, bs.wo)
    scattered = ~through & (bs.pdf.numpy() > 0)
    np.testing.assert_allclose(pdf.numpy()[scattered], bs.pdf.numpy()[scattered], rtol=1e-3)
    assert ours.component_count() == 4 and mi.has_flag(ours.flags(), mi.BSDFFlags.Null)
    opaque = mi.load_dict({"type": "neural_material", "filename": files["leaf"], "ignore": "opacity, ao"})
    assert opaque.component_count() == 3 and not mi.has_flag(opaque.flags(), mi.BSDFFlags.Null)


@pytest.mark.parametrize("reading", [{}, {"filter": "off", "lobes": "tables"}])
def test_neutral_extras_change_nothing(mi, files, rng, reading):
    ours, theirs = (mi.load_dict({"type": "neural_material", "filename": files[name], **reading})
                    for name in ("round", "metal"))  # fmt: skip
    assert_equal(mi, rng, ours, theirs, False)


def test_extras_shape_and_weigh_the_highlight(mi, files, rng):
    """The specular lobe is that of its matrix in NumPy, at the level and the place of the footprint."""
    n = 2000
    bsdf = mi.load_dict({
        "type": "neural_material", "filename": files["shaped"], "ignore": "albedo, normal", "base_color": 0.0,
        "specular": 1.0, "filter": "trilinear",
    })  # fmt: skip
    si, wo = hits(mi, rng, n), directions(mi, rng, n)
    ctx = mi.BSDFContext()
    ctx.component = 1
    values, maps = bsdf.eval(ctx, si, wo).numpy()[0], bsdf.maps.read(si)
    roughness, metallic = (maps[name][0].numpy() for name in ("roughness", "metallic"))
    lobe = bsdf.maps.lobe(si)
    c, s, weight = (np.asarray(v.numpy()) for v in (lobe.c, lobe.s, lobe.weight))
    assert np.hypot(c, s).max() > 0.8 and weight.min() < 0.6
    a = np.maximum(roughness**2, 1e-3)[:, None, None] ** 2 * np.moveaxis([[1 + c, s], [s, 1 - c]], 2, 0)
    wi, wo = si.wi.numpy().T, wo.numpy().T
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    slope = np.einsum("ni,nij,nj->n", h[:, :2], np.linalg.inv(a), h[:, :2])
    d = 1 / (np.pi * np.sqrt(np.linalg.det(a)) * (slope + h[:, 2] ** 2) ** 2)
    masked = [w[:, 2] + np.sqrt(w[:, 2] ** 2 + np.einsum("ni,nij,nj->n", w[:, :2], a, w[:, :2])) for w in (wi, wo)]
    schlick = (1 - np.einsum("ni,ni->n", h, wi)) ** 5
    f0 = 0.08 * (1 - metallic)
    expected = weight * (f0 + (1 - f0) * schlick) * d * wo[:, 2] / (masked[0] * masked[1])
    np.testing.assert_allclose(values, expected, rtol=2e-3, atol=1e-5)


def test_what_the_file_rules_out_is_not_traced(mi, files):
    """Lobes that a constant map rules out are not traced, here and in ``disney`` with textures of the same file."""
    file = files["plain"]
    ours = mi.load_dict({"type": "neural_material", "filename": file, "spec_tint": 0.5, "storage": "float32"})
    names = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}
    textures = separate(file, names, {"spec_tint": 0.5}, storage="float32")["inner"]
    theirs = mi.load_dict(textures)
    constants = {"base_color": {"type": "rgb", "value": 0.2}, "metallic": 0.0}
    known = mi.load_dict({**textures, **constants})
    assert not ours._is_anisotropic and ours._effects() == theirs._effects() == known._effects()
    for bsdf in (ours, theirs):
        report = bsdf.report()
        assert report["effects_left_out"]["metal"] == "metallic is 0"
        assert report["effects_left_out"]["spec_tint"] == "base_color has no hue"
        assert {"diffuse", "f0", "shares"} <= set(report["evaluated_once"])
        params = mi.traverse(bsdf)  # derivatives of entries change no constant
        for key in params.keys():
            if "tables." in key:
                dr.enable_grad(params[key])
        params.update()
        assert bsdf._effects() == known._effects()
    assert ours.report()["effects_left_out"]["emission"].startswith("a BSDF emits no light")
    counted = [bsdf_operations(b, ("eval",))["eval"].instructions for b in (ours, known)]
    assert counted[0] <= 1.1 * counted[1]


def test_report_and_text(mi, files):
    bsdf = mi.load_dict({"type": "neural_material", "filename": files["leaf"], "lobes": "tables"})
    (report,) = mi_diffind.inspect(bsdf).figures["reports"]
    assert report["learned"] and report["lobes"] == "tables" and report["table_bytes"] > 0
    assert report["maps"] == {name: name for name in ("base_color", "normal", "roughness", "opacity")}
    assert report["effects_left_out"]["ao"] == "the BRDF has no such parameter"
    assert {"normal", "opacity", "diffuse"} <= set(report["effects_in_use"]) and 7 in report["channels_left_out"]
    assert "filter = trilinear" in str(bsdf) and "lobes = tables" in str(bsdf)
    shaped = mi.load_dict({"type": "neural_material", "filename": files["shaped"]})
    assert shaped.report()["extras"] and "extras" in shaped.report()["effects_in_use"] and not report["extras"]
    assert mi.has_flag(shaped.flags(1), mi.BSDFFlags.Anisotropic)
    assert mi_diffind.inspect(files["shaped"]).figures["extras"] and "extras" in str(
        mi_diffind.inspect(files["shaped"])
    )
    assert mi_diffind.inspect(files["leaf"]).usage[-1].startswith('<bsdf type="neural_material">')


@pytest.mark.parametrize(
    "name, parameters, sentence",
    [
        ("other", {}, 'the map "height" is no parameter of the material, allowed are base_color, normal, roughness'),
        ("metal", {"roughness": 0.5}, 'parameter "roughness": given, but the file holds the map "roughness"'),
        ("shaped", {"anisotropic": 0.5}, 'parameter "anisotropic": found one above 0 or a map, but the extras of the'),
        ("metal", {"ignore": "rough"}, 'parameter "ignore": found "rough", the file holds albedo, normal, roughness'),
        ("metal", {"ignore": "albedo,normal,roughness,metallic"}, "no map is left to read"),
        ("metal", {"sheen": {"type": "checkerboard"}}, 'parameter "sheen": found a texture, allowed are numbers'),
        ("metal", {"lobes": "paper"}, 'parameter "lobes": found "paper", allowed are exact, tables'),
        ("metal", {"two_sided": 1}, 'parameter "two_sided": found 1, allowed are true and false'),
    ],
)
def test_refusals(mi, files, name, parameters, sentence):
    refusal = texture_scenes.refused(mi, {"type": "neural_material", "filename": files[name], **parameters})
    assert sentence in refusal


def wall(mi, bsdf):
    eye = mi.ScalarTransform4f().look_at([0, -2.5, 1], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 12, "height": 8, "rfilter": {"type": "box"}}
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 2}, "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": eye, "film": film},
        "wall": {"type": "rectangle", "bsdf": {**bsdf, "id": "paint"}},
    }  # fmt: skip


def test_footprints_reach_it(mi, files, capsys):
    """The sensor of a scene is attached, and shows in the picture; plain Mitsuba warns once."""
    gc.collect()  # what other tests left would be traced, too
    bsdf = {"type": "neural_material", "filename": files["metal"], "to_uv": mi.ScalarTransform4f().scale(8)}
    theirs = separate(files["metal"], METAL, {}, to_uv=mi.ScalarTransform4f().scale(8))
    scene = mi_diffind.load_dict(wall(mi, bsdf))
    assert len(footprint.textures(scene)) == 1 and footprint.textures(scene)[0].cone is not None
    assert "sensor" in mi_diffind.inspect(scene).figures["reports"][0]["footprint"]
    images = [mi.render(s, spp=16).numpy() for s in (scene, mi_diffind.load_dict(wall(mi, theirs)))]
    assert not capsys.readouterr().err
    sharp = mi.load_dict(wall(mi, bsdf))
    image = mi.render(sharp, spp=16).numpy()
    (line,) = capsys.readouterr().err.splitlines()
    assert 'the material "paint" (neural_material, ' in line and "is not filtered" in line
    error, unfiltered = (np.abs(images[0] - other).mean() for other in (images[1], image))
    assert error < 0.1 * unfiltered and unfiltered > 0.005


def test_counterparts(mi, rng, tmp_path):
    """Constants are exact in the file: pictures equal those of Mitsuba's plugins with the source."""
    normal = np.array([0.25, -0.15, 1]) / np.linalg.norm([0.25, -0.15, 1])
    maps = {
        "albedo": constant(0.8, 0.4, 0.2), "normal": constant(*(0.5 + 0.5 * normal)), "roughness": constant(0.6),
        "metallic": constant(1), "opacity": constant(0.8),
    }  # fmt: skip
    maps = {name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()}
    manifest = write_manifest(tmp_path, maps)
    mi_diffind.fit("texture", manifest, steps=1, progress=False).save(tmp_path / "paint.npz")
    given = {"type": "neural_material", "filename": str(tmp_path / "paint.npz"), "two_sided": True, "clearcoat": 0.5}
    lamp = {"type": "point", "position": [1, -1, 2], "intensity": 1.0}
    scene = {**wall(mi, {**given, "clearcoat_sampling_rate": 2.0}), "lamp": lamp}
    written = mi.render(loading.load_dict(scene), spp=64).numpy()
    for against in ("exact", "mipmap", "principled"):
        loaded = loading.ParsedScene(scene).load(exact=True, against=against)
        assert not [r for r in loading.reports(loaded) if r["plugin"].startswith("neural")]
        image = mi.render(loaded, spp=64).numpy()
        np.testing.assert_allclose(image, written, rtol=0.05 if against == "principled" else 2e-3)
    assert plugins.declared()["neural_material"].counterpart().oversampling == 8
