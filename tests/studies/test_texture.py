"""``tradeoff texture``: what is seen, how errors, levels and flicker are measured, what is written and said."""

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from study_runs import quick_result

from mi_diffind.commands.cli import main
from mi_diffind.measure.report import panels
from mi_diffind.studies.baselines import codecs

ASSETS = Path(__file__).resolve().parents[2] / "scenes" / "assets"
FILM = (24, 16)

#: Steps of a training.
STEPS = 2


def smooth(height, width, channels, seed=0):
    random = np.random.default_rng(seed).random((height, width, channels))
    values = gaussian_filter(random, (2, 2, 0), mode="wrap")
    values = (values - values.min()) / (values.max() - values.min())
    return np.rint(255 * values).astype(np.uint8)


def directions(scene, film, x, y):
    """Rays through places of the image in [0, 1], by the rules of a pinhole camera: up is up, right is right."""
    forward = np.subtract(scene.target, scene.origin)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right = right / np.linalg.norm(right)
    tangent = math.tan(math.radians(scene.fov) / 2)
    across, down = (2 * x - 1) * tangent, (2 * y - 1) * tangent * film[1] / film[0]
    return forward + across[..., None] * right - down[..., None] * np.cross(right, forward)


def test_areas_of_pixels(mi_rgb):
    """Those of the plane, by hand: uv is 1 over the width of the square."""
    from mi_diffind.studies.texture.test_scenes import still_scenes

    scene = still_scenes()["plane"]
    area, inside = scene.pixel_areas(FILM)
    x, y = np.meshgrid(np.arange(FILM[0] + 1) / FILM[0], np.arange(FILM[1] + 1) / FILM[1])
    way = directions(scene, FILM, x, y)
    with np.errstate(divide="ignore"):
        places = scene.origin + way * (-scene.origin[1] / way[..., 1:2])
    ahead = way[..., 1] < 0
    near = ahead & (np.abs(places[..., [0, 2]]) < 900).all(axis=-1)
    corners = near[:-1, :-1] & near[1:, :-1] & near[:-1, 1:] & near[1:, 1:]
    assert inside[corners].all() and not inside[: FILM[1] // 8].any() and 0.5 < corners.mean() < 1
    p = places[..., [0, 2]] / 2000
    a, b = p[1:, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, 1:]
    expected = 0.5 * np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    rows = corners & (np.arange(FILM[1])[:, None] >= FILM[1] // 3)  # further away, single precision is not enough
    np.testing.assert_allclose(area[rows], expected[rows], rtol=0.02)
    repeats = scene.repeats(FILM, (64, 32))
    assert repeats[0] * 64 == pytest.approx(repeats[1] * 32)  # texels are square
    texels = expected * repeats[0] * 64 * repeats[1] * 32
    assert texels[-1, FILM[0] // 2] == pytest.approx(scene.texels, rel=0.02)
    far = rows & (np.abs(texels - 1) > 0.05)
    assert np.array_equal(scene.counted(FILM, (64, 32))[far], texels[far] >= 1)


def test_light_has_no_noise(mi_rgb):
    """A constant texture is shown as it is, whatever the seed; a sphere as bright as it faces the light."""
    from mi_diffind.studies.texture.test_scenes import TextureReader, still_scenes

    reader = TextureReader(lambda repeats: {"type": "rgb", "value": [0.8, 0.3, 0.1]})
    for name, scene in still_scenes().items():
        images = [reader.render(scene, FILM, (8, 8), seed) for seed in (0, 1)]
        inside = scene.pixel_areas(FILM)[1]
        if name == "sphere":
            assert images[0].max() <= 0.91 and images[0][inside].min() < 0.5
            continue
        np.testing.assert_array_equal(images[0][inside], images[1][inside])
        expected = 1.055 * np.array([0.8, 0.3, 0.1]) ** (1 / 2.4) - 0.055
        np.testing.assert_allclose(images[0][inside], np.broadcast_to(expected, (inside.sum(), 3)), atol=1e-5)


def test_errors_are_those_of_counted_pixels():
    from mi_diffind.studies.texture.test_scenes import errors

    truth = np.random.default_rng(1).random((12, 10, 3)).astype(np.float32)
    counted = np.zeros((12, 10), bool)
    counted[3:7, 2:8] = True
    image = np.where(counted[..., None], truth, 1 - truth)
    assert errors(truth, image, counted) == {"mse": 0, "flip": 0}
    image[4, 5, 1] += 0.25
    found = errors(truth, image, counted)
    assert found["mse"] == pytest.approx(0.25**2 / (24 * 3), rel=1e-4) and found["flip"] > 0


def test_points_stay_where_they_are(mi_rgb):
    """A ray of Mitsuba's through the place where a frame shows a point hits it; all are within all frames."""
    import mitsuba as mi

    from mi_diffind.studies.texture.test_scenes import zoom_scene
    from mi_diffind.studies.texture.zoom import NEARER, TextureZoom

    zoom = TextureZoom(zoom_scene(), FILM, (8, 8), 5)
    points, origins = zoom.points(), zoom.origins()
    distances = np.linalg.norm(origins - zoom.scene.target, axis=1)
    assert distances[0] / distances[-1] == pytest.approx(NEARER) and np.ptp(np.diff(np.log(distances))) < 1e-12
    assert np.abs(points[:, 1]).max() < 1e-9
    for frame in (0, 2, 4):
        places = zoom.places(frame)
        assert (places > 0.5).all() and (places < np.array(FILM) - 0.5).all()
        scene = zoom.scene.scene({"type": "rgb", "value": 0.5}, FILM)
        scene["sensor"]["to_world"] = zoom.scene.camera_at(origins[frame])
        si = zoom.scene.hits(mi.load_dict(scene), *(places / FILM).T)
        np.testing.assert_allclose(np.array(si.p).T, points, atol=2e-3)


def test_flicker():
    """Bilinear reads against SciPy's; the variance of what is known."""
    from mi_diffind.measure import flicker

    image = np.random.default_rng(2).random((9, 7, 3))
    places = np.random.default_rng(3).uniform([0.5, 0.5], [6.5, 8.5], (50, 2))
    expected = [map_coordinates(image[..., c], [places[:, 1] - 0.5, places[:, 0] - 0.5], order=1) for c in range(3)]
    np.testing.assert_allclose(flicker.bilinear(image, places), np.stack(expected, -1), atol=1e-12)
    frames = np.zeros((8, 4, 3))
    assert flicker.flicker(frames + image[0, :4]) < 1e-30
    frames[::2, 1] = 0.2  # one point of four, half of the time
    assert flicker.flicker(frames) == pytest.approx(0.01 / 4)


@pytest.mark.skipif("astc" not in codecs.available(), reason="needs astc-encoder-py")
def test_astc_with_mip_maps():
    maps = {"albedo": [], "ao": []}
    for i in range(6):
        maps["albedo"].append(smooth(32 >> i, 32 >> i, 3).astype(np.float32) / 255 if i < 5 else np.ones((1, 1, 3)))
        maps["ao"].append(smooth(32 >> i, 32 >> i, 1, 1).astype(np.float32) / 255 if i < 5 else np.ones((1, 1, 1)))
    options = {"quality": "fast", "choose": "fast", "cache": {}}
    errors = []
    for nbytes in (3000, 1200, 400):
        found, taken = codecs.astc_levels(maps, nbytes, **options)
        assert taken == sum(e.nbytes for e in found.values()) <= nbytes
        for name, e in found.items():
            block = e.codec.split()[1]
            drop = int(e.codec.split("level ")[1].split()[0]) if "level" in e.codec else 0
            assert e.nbytes == sum(codecs.astc_bytes(level.shape, block) for level in maps[name][drop:])
            assert [level.shape for level in e.levels] == [level.shape for level in maps[name]]
            alone = codecs.astc(maps[name][drop + 1], block, "fast")
            np.testing.assert_array_equal(e.levels[drop + 1], alone.image)
        errors.append(sum(float(((e.levels[0] - maps[n][0]) ** 2).sum()) for n, e in found.items()))
    assert errors == sorted(errors) and errors[0] < errors[-1]
    assert "level" in "".join(e.codec for e in found.values())  # so little takes less than all levels
    with pytest.raises(codecs.CodecError, match="100 bytes"):
        codecs.astc_levels(maps, 100, **options)


def test_levels(mi_rgb):
    """Errors of each level, and that what was decoded comes back in a pyramid of the same layout."""
    from mi_diffind.core.runtime import array_module
    from mi_diffind.maps.pyramid import Pyramid
    from mi_diffind.maps.source import from_arrays
    from mi_diffind.studies.texture import levels

    source = from_arrays({"albedo": smooth(8, 16, 3), "ao": smooth(8, 16, 1, 1)})
    pyramid = Pyramid.of(source, types=array_module("llvm_ad_rgb"))
    truth = levels.images(pyramid)
    np.testing.assert_allclose(truth["albedo"][0], source.maps[0].values, atol=1e-6)
    assert [v.shape for v in truth["ao"]] == [(8, 16, 1), (4, 8, 1), (2, 4, 1), (1, 2, 1), (1, 1, 1)]
    changed = {name: [v.copy() for v in values] for name, values in truth.items()}
    changed["albedo"][1][..., 2] = np.clip(changed["albedo"][1][..., 2] * 0.9, 0, 1)
    found = levels.errors(truth, changed)
    mse = np.mean((changed["albedo"][1][..., 2] - truth["albedo"][1][..., 2]) ** 2)
    assert found["albedo"][1] == pytest.approx(-10 * math.log10(mse / 3), abs=1e-3)
    assert found["all"][1] == pytest.approx(-10 * math.log10(mse / 4), abs=1e-3)
    assert found["all"][0] == found["ao"][1] == 120
    again = levels.pyramid_of(changed, pyramid)
    decoded = levels.decoded(again, ["albedo", "ao"], 5)
    for name, values in changed.items():
        for a, b in zip(values, decoded[name], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)


def result_of(times, errors):
    """A result with one case, candidates by name."""
    kind = {name: "ours" if "ours" in name else name.split(", ", 2)[-1] for name in times}
    candidates = {
        name: {"representation": "bitmap" if "spp" in kind[name] else kind[name], "in_picture": True,
               "errors": {"psnr_plane_db": errors[name], "flicker": 1e-3, "flicker_error": 2e-3}}
        for name in times
    }  # fmt: skip
    passes = {"render": {name: {"time": t} for name, t in times.items()}}
    case = {"accuracy": "psnr_plane_db", "passes": passes, "ratios": {}}
    return {"candidates": candidates, "cases": {"plane": case}}


def test_factor_at_equal_error():
    """An error that halves with each doubling of the time: the bitmap takes as long as the PSNR says."""
    from mi_diffind.studies.texture.conclusions import conclusions, speed

    times = {"bitmap, 1 spp": 2.0, "bitmap, 4 spp": 8.0, "bitmap, 16 spp": 32.0, "ours": 3.0, "ours, best": 4.0}
    errors = {"bitmap, 1 spp": 20, "bitmap, 4 spp": 20 + 20 * math.log10(2), "bitmap, 16 spp": 20 + 20 * math.log10(4),
              "ours": 29.0, "ours, best": 40.0}  # fmt: skip
    result = result_of(times, errors)
    assert speed(result, "plane", "ours") == (pytest.approx(2.0 * 10**0.9 / 3.0), False)
    assert speed(result, "plane", "ours, best") == (32.0 / 4.0, True)
    assert speed(result, "plane", "bitmap, 4 spp") == (pytest.approx(1), False)
    lines = conclusions(result)
    assert lines[0].startswith("plane, ours: +9.0 dB over bitmap, 1 spp")
    assert "flicker, ours: 1.00 of bitmap, 4 spp, beside the truth 1.00" in lines


def test_crops_show_what_differs():
    from mi_diffind.studies.texture.pictures import _busiest

    image = np.zeros((40, 60, 3))
    image[20:28, 40:48] = np.random.default_rng(4).random((8, 8, 3))
    top, left = _busiest(image, 16)
    assert top <= 20 and top + 16 >= 28 and left <= 40 and left + 16 >= 48
    image[:, 30:] = np.nan
    assert _busiest(image, 16)[1] <= 14


@pytest.fixture
def small(tmp_path, monkeypatch):
    """A material, whose trainings are all one training of :data:`STEPS` steps."""
    import mitsuba as mi

    import mi_diffind.commands.fit  # noqa: F401  (or it would import the replacement, and keep it)
    from mi_diffind.fitting import task

    mi.set_variant("llvm_ad_rgb")
    maps = {"albedo": smooth(32, 32, 3, 1), "roughness": smooth(32, 32, 1, 2)}
    for name, values in maps.items():
        mi.Bitmap(values if values.shape[-1] > 1 else values[..., 0]).write(str(tmp_path / f"{name}.png"))
    (tmp_path / "m.json").write_text(json.dumps({name: f"{name}.png" for name in maps}))
    fit, requests, fitted = task.fit, [], []

    def once(name, preset="", variant=None, seconds=None, **options):
        requests.append((name, preset, seconds))
        options.pop("footprint_samples")
        if not fitted:
            fitted.append(fit(name, variant=variant, steps=STEPS, batch=2**12, **options))
        return fitted[0]

    monkeypatch.setattr(task, "fit", once)
    return tmp_path, requests


@pytest.mark.long
def test_what_is_written(small):
    """One scene and one filter."""
    from mi_diffind.maps.source import load_source
    from mi_diffind.studies.texture import plan as plans
    from mi_diffind.studies.texture.test_scenes import still_scenes

    folder, requests = small
    settings = plans.TextureStudySettings("albedo", (12.0,), 3.0, "fast", "fast", FILM, FILM, 2, 64, 1)
    path, scenes = folder / "m.json", {"plane": still_scenes()["plane"]}
    plan = plans.plan(load_source(path), str(path), settings, reads=plans.READS[:1], more_reads=(), scenes=scenes)
    result, summary = quick_result(plan, folder / "out")
    assert requests == [("texture", "", 3), ("texture", "paper", 3)]
    candidates = result["candidates"]
    blocks = ["ASTC 12x, trilinear"] * ("astc" in codecs.available())
    filtered = ["mipmap, trilinear", "ours 12x, trilinear", "paper 12x, trilinear", *blocks]
    bitmaps = [f"bitmap, {n} spp" for n in (1, 4, 16, 64)] + [f"bitmap, {n} spp, multijittered" for n in (4, 16, 64)]
    assert set(candidates) == {*filtered, *bitmaps}
    assert candidates["mipmap, trilinear"]["bytes"] == 4 * sum(4**i for i in range(6))
    assert candidates["bitmap, 1 spp"]["bytes"] == 4 * 32 * 32
    for name in blocks:
        assert 0 < candidates[name]["bytes"] <= candidates["ours 12x, trilinear"]["bytes"]
    order = [candidates[f"bitmap, {n} spp"]["errors"]["psnr_plane_db"] for n in (1, 4, 16, 64)]
    assert order == sorted(order) and order[-1] - order[0] == pytest.approx(10 * math.log10(64), abs=5)
    flicker = [candidates[f"bitmap, {n} spp"]["errors"]["flicker_error"] for n in (1, 4, 16, 64)]
    assert flicker == sorted(flicker, reverse=True)
    assert candidates["mipmap, trilinear"]["errors"]["psnr_plane_db"] > order[0] + 1
    case = result["cases"]["plane"]
    assert set(case["passes"]["render"]) == set(candidates)
    assert set(case["queries"]["read"]) == {"bitmap, 1 spp", *filtered}
    for name in ("ours 12x", "paper 12x"):
        found = result["jobs"][name]["details"]["levels"]
        assert len(found["all"]) == len(found["albedo"]) == 6 and result["jobs"][name]["details"]["steps"] == STEPS
    (panel,) = [p for p in panels(result) if p.title == "plane"]
    assert panel.x_label == "time of one render, ms" and not panel.lines
    assert {p.name: p.accuracy for p in panel.points} == {
        n: c["errors"]["psnr_plane_db"] for n, c in candidates.items() if c["in_picture"]
    }
    fronts = {n: t["on_front"] for n, t in case["passes"]["render"].items() if candidates[n]["in_picture"]}
    assert {p.name: p.on_front for p in panel.points} == fronts and any(fronts.values())
    with open(folder / "out" / "tradeoff_texture.csv", encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    assert {(r["candidate"], r["query"]) for r in table} >= {(n, "render") for n in candidates}
    for kind in ("", "_crops", "_zoom", "_levels"):
        assert (folder / "out" / f"tradeoff_texture{kind}.png").stat().st_size > 10_000
    assert not list((folder / "out").glob("*.partial*"))
    assert "PSNR by level" in summary and "plane, ours 12x, trilinear:" in summary


def test_a_table_in_place_of_a_training(mi_rgb):
    from mi_diffind.maps.source import load_source
    from mi_diffind.studies.texture import plan as plans

    path = ASSETS / "tiles.json"
    source = load_source(path)
    tables = plans.tables_of([str(ASSETS / "tiles_filtered.npz")], source)
    settings = plans.TextureStudySettings("albedo", (), film=FILM, zoom_film=FILM, frames=2)
    plan = plans.plan(source, str(path), settings, tables)
    mark = f"ours {source.nbytes / tables[0].nbytes:.3g}x"
    assert [job.name for job in plan.jobs if "truth" not in job.name and "ASTC" not in job.name] == [mark]
    names = [c.name for c in plan.candidates if c.job == mark]
    ways = ("trilinear", "trilinear, centred", "anisotropic", "anisotropic, centred", "stochastic", "off")
    assert names == [f"{mark}, {way}" for way in ways]
    assert [c.name for c in plan.candidates if c.job == mark and not c.in_picture] == names[4:]
    assert {c.name for c in plan.candidates if c.queries == ()} >= {"bitmap, 4 spp", f"{mark}, trilinear, centred"}


@pytest.mark.parametrize(
    "options, message",
    [
        (["--compression", "0"], "0"),
        (["--map", "roughness"], "roughness"),
        (["--table", "missing.npz"], "missing.npz"),
        (["--table", str(ASSETS / "tiles_filtered.npz")], "not trained on this source"),
    ],
)
def test_bad_options(small, options, message, capsys):
    folder, requests = small
    assert main(["tradeoff", "texture", str(folder / "m.json"), "--out", str(folder / "out"), *options]) == 2
    assert message in capsys.readouterr().err and not requests
