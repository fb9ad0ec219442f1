"""Comparisons of scenes: the noise in an error, the worst place, the truths, and refusals to state a time."""

import json
import signal
from pathlib import Path
from unittest import mock

import mitsuba as mi
import numpy as np
import pytest

import mi_diffind
from mi_diffind.commands import cli
from mi_diffind.images import metrics
from mi_diffind.scenes import comparison, equal_time, loading

ASSETS = Path(__file__).resolve().parents[1] / "scenes" / "assets"


def halves(rng, mean, shared, deviation, samples):
    """Sums of the samples of each half: an image, noise that both sides share, and noise of one side."""
    return [n * mean + np.sqrt(n) * s + np.sqrt(n) * rng.normal(0, deviation, mean.shape)
            for n, s in zip(samples, shared, strict=True)]  # fmt: skip


@pytest.mark.parametrize("samples", [[32, 32], [48, 16]])
@pytest.mark.parametrize("bias", [0.0, 0.01])
def test_noise_of_a_difference(rng, samples, bias):
    """Independent noise of 0.1 a sample on each side makes sqrt(2/64) 0.1; shared noise is no error at all."""
    mean = rng.uniform(0.3, 0.6, (80, 60, 3))
    shared = [rng.normal(0, 0.3, mean.shape) for _ in samples]
    written = halves(rng, mean + bias, shared, 0.1, samples)
    truth = halves(rng, mean, shared, 0.1, samples)
    found = comparison.noise(written, truth, samples)
    assert found["noise_db"] == pytest.approx(-10 * np.log10(2 * 0.1**2 / sum(samples)), abs=0.15)
    if bias:
        assert found["psnr_without_noise_db"] == pytest.approx(-20 * np.log10(bias), abs=0.3)
    else:
        assert found["psnr_without_noise_db"] is None
    # Together they are the error of the image, since no mean leaves [0, 1]
    parts = 10 ** (-found["noise_db"] / 10) + bias**2
    assert metrics.psnr(sum(truth) / 64, sum(written) / 64) == pytest.approx(-10 * np.log10(parts), abs=0.15)


def test_noise_where_nothing_is_random_or_visible(rng):
    mean = rng.uniform(0.3, 0.6, (8, 8, 3))
    still = comparison.noise([4 * mean, 4 * mean], [4 * mean - 0.04, 4 * mean - 0.04], [4, 4])
    assert still["noise_db"] > 200 and still["psnr_without_noise_db"] == pytest.approx(40)
    wide = [rng.exponential(0.8, (9, 7, 3)) for _ in range(4)]  # many values are clipped
    found = comparison.noise(wide[:2], wide[2:], [1, 1])
    error = 10 ** (-metrics.psnr(sum(wide[2:]) / 2, sum(wide[:2]) / 2) / 10)
    assert 0.5 * error < 10 ** (-found["noise_db"] / 10) < 2 * error
    bright = [rng.uniform(2, 3, (8, 8, 3)) for _ in range(4)]
    assert comparison.noise(bright[:2], bright[2:], [1, 1]) == {"noise_db": np.inf, "psnr_without_noise_db": np.inf}
    assert set(comparison.noise([mean, 0], [mean, 0], [1, 0]).values()) == {None}


@pytest.mark.parametrize("shape", [(40, 90), (5, 30), (8, 8)])
def test_worst_window(rng, shape):
    error = rng.random(shape) ** 20
    x, y, width, height = comparison.worst_window(error)
    assert (width, height) == (min(shape[1], max(8, round(shape[1] / 8))), min(shape[0], 8))
    windows = np.lib.stride_tricks.sliding_window_view(error, (height, width)).mean(axis=(-1, -2))
    assert windows[y, x] == pytest.approx(windows.max())


TEXTURED = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="24"/>
        <integer name="height" value="16"/><rfilter type="box"/></film>
        <transform name="to_world"><lookat origin="0,-2,0.4" target="0,0,0" up="0,0,1"/></transform></sensor>
    <emitter type="constant"/>
    <shape type="rectangle"><transform name="to_world"><scale value="9"/></transform>
        <bsdf type="neural_disney"><texture name="base_color" type="neural_texture">
            <string name="filename" value="FILE"/><string name="channels" value="albedo"/></texture></bsdf></shape>
</scene>
"""


def test_a_filtered_texture_has_two_truths(mi_rgb, tmp_path):
    """The mip map at equal samples and the bitmap at eight times as many; other learned plugins are exact in both.

    The figure has the truth on the left.
    """
    path = tmp_path / "scene.xml"
    path.write_text(TEXTURED.replace("FILE", str(ASSETS / "tiles_filtered.npz")))
    first = comparison.compare(path, spp=8, passes=2, progress=False)
    (second,) = first.further
    assert [one.truth for one in (first, second)] == [
        "mipmap (disney, mipmap), 8 spp", "exact (disney, bitmap), 64 spp",
    ]  # fmt: skip
    exact = loading.load(path, exact=True)
    np.testing.assert_allclose(second.reference, loading.render(exact, 2048)[0], atol=0.15)
    assert second.figures["noise_db"] < first.figures["noise_db"]  # other random numbers: all of the noise is there
    text = str(first)
    assert "against     mipmap (disney, mipmap), 8 spp" in text
    assert "against     exact (disney, bitmap), 64 spp" in text
    with mock.patch.object(comparison.figure_grid, "picture", wraps=comparison.figure_grid.picture) as cell:
        paths = first.save(tmp_path / "out")
    drawn = [call.args[1].mean() for call in cell.call_args_list]
    assert drawn[::4] == [first.reference.mean(), second.reference.mean()] and drawn[1] == first.written.mean()
    assert sorted(paths) == ["error_exact", "error_mipmap", "exact", "figure", "mipmap", "written"]
    alone = mi_diffind.compare(path, spp=2, passes=1, progress=False, against="mipmap")
    picture = Path(alone.save(tmp_path / "alone")["figure"]).read_bytes()
    assert alone._repr_png_() == picture and picture.startswith(b"\x89PNG")
    assert alone.figures["counterparts"] == ["mipmap"] and alone.further == ()
    assert alone.figures["replaced_plugins"] == 1 and alone.figures["passes"] == 2


def side(seconds, compiled):
    it = comparison._Side(None)
    it.seconds, it.compiled = seconds, compiled
    return it


@pytest.mark.parametrize(
    "written, compiled, text",
    [
        ([9, 1.1, 1.2, 1.3, 1.4, 1.5], [1], "1.30 times that of exact at 8 spp (1 s a pass)"),
        ([9, 1.2], [1], "not measured: 1 pair of passes without compilation,"),
        ([9, 1.2, 1.4, 1.3], [1, 0, 1], "not measured: 2 pairs of passes without compilation,"),
        ([9, 40, 126, 200], [1], "not measurable here: quartiles 83.00 to 163.00"),
    ],
)
def test_times_that_say_nothing_are_refused(written, compiled, text):
    """Compilation on one side only, too few pairs, and quartiles as wide as their median."""
    count = len(written)
    flags = [bool(i < len(compiled) and compiled[i]) for i in range(count)]
    times = comparison._times(side(written, flags), side([1.0] * count, [False] * count), "exact")
    assert (times["time_ratio"]["median"] is None) == ("not" in text)
    assert times["seconds_first_pass"] == {"written": 9, "exact": 1.0}
    assert text in comparison._time_lines({**times, "against": "exact", "spp": 8})[0]


@pytest.mark.parametrize("bias", [0.0, 0.1])
def test_parts_of_an_error(rng, bias):
    """Known parts: noise of deviation 0.2 a pass, a bias, and a reference that is noisy itself."""
    mean = rng.uniform(0.2, 2, (90, 80, 3))
    weight = np.mean(1 / (mean**2 + equal_time.EPSILON))
    passes = [mean + bias + rng.normal(0, 0.2, mean.shape) for _ in range(4)]
    halves = [mean + rng.normal(0, 0.05, mean.shape) for _ in range(2)]
    found = equal_time.errors(passes, halves)
    assert found["noise"] == pytest.approx(weight * 0.2**2, rel=0.05)
    assert found["error"] == pytest.approx(weight * (0.2**2 + bias**2), rel=0.05)
    assert found["bias"] is None if bias == 0 else found["bias"] == pytest.approx(weight * bias**2, rel=0.15)
    assert found["bias_resolution"] < 0.1 * found["error"] and len(found["errors"]) == 4


def contender(rng, spp, seconds, bias, passes=6, deviation=0.4):
    """Passes of known noise a sample and bias, with their parts as ``compare_at_equal_time`` has them."""
    mean = np.linspace(0.2, 2, 24_000).reshape(100, 80, 3)
    images = [mean + bias + rng.normal(0, deviation / np.sqrt(spp), mean.shape) for _ in range(passes)]
    return {"spp": spp, "seconds": {"median": seconds}, **equal_time.errors(images, [mean, mean])}


def test_crossover(rng):
    """The exact scene takes 4 samples in the time of 16: 0.4² / n = 0.05² at 64, the sides are equal at 24 s."""
    fast, exact = contender(rng, 16, 2.0, 0.05), contender(rng, 4, 2.0, 0.0)
    at = equal_time.crossover(fast, exact)
    assert at["spp"] == pytest.approx(64, rel=0.1) and at["seconds"] == pytest.approx(64 / 8, rel=0.1)
    expected = 0.4**2 * (2 / 4 - 2 / 16) / 0.05**2
    assert at["reference_better_seconds"] == pytest.approx(expected, rel=0.1) and at["spp_above"] is None
    assert at["reference_better_spp"] == pytest.approx(8 * expected, rel=0.1)
    # Passes of so many samples: half of the error is bias, and both errors are equal
    half = contender(rng, round(at["spp"]), 1, 0.05)
    assert half["bias"] == pytest.approx(half["error"] / 2, rel=0.2)
    long = [contender(rng, round(n * at["reference_better_seconds"]), 1, b)["error"] for n, b in ((8, 0.05), (2, 0.0))]
    assert long[0] == pytest.approx(long[1], rel=0.1)
    # A slow contender is never better, one without a bias never worse
    slow = {**fast, "crossover": equal_time.crossover(fast, {**exact, "noise": 0})}
    text = equal_time._crossover_text(slow, "exact")
    assert text.startswith("bias equals noise at ") and text.endswith("better at equal time from the first sample on")
    none = contender(rng, 16, 2.0, 0.0)
    at = equal_time.crossover(none, exact)
    assert at.pop("spp_above") > 1000 and set(at.values()) == {None}
    assert "no bias above" in equal_time._crossover_text({**none, "crossover": {**at, "spp_above": 1234}}, "exact")


PAPER = """
<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="48"/>
        <integer name="height" value="36"/><rfilter type="box"/></film>
        <transform name="to_world"><lookat origin="0,1,5" target="0,0,0" up="0,1,0"/></transform></sensor>
    <emitter type="constant"/>
    <shape type="sphere"><bsdf type="neural_disney"><string name="preset" value="paper"/>
        <rgb name="base_color" value="0.5,0.3,0.2"/><float name="roughness" value="0.4"/>
        <float name="metallic" value="1"/><float name="anisotropic" value="0.9"/></bsdf></shape>
</scene>
"""


def test_bias_of_a_scene(mi_rgb, tmp_path):
    """The bias is that of converged renders; a pass with the samples of the crossover has twice the bias as error."""
    path = tmp_path / "ball.xml"
    path.write_text(PAPER)
    result = equal_time.compare_at_equal_time(path, spp=16, passes=8, progress=False)
    written = result.figures["contenders"]["as written"]
    images = [loading.render(loading.load(path, exact=exact), 2**11, 77)[0] for exact in (False, True)]
    bias = equal_time._weighted((images[0] - images[1]) ** 2, images[1]).mean()
    assert written["bias"] == pytest.approx(bias, rel=0.3)
    spp = round(written["crossover"]["spp"])
    assert f"as written: bias equals noise at {spp} samples a pixel" in str(result)
    image = loading.render(loading.load(path), spp, 78)[0]
    assert equal_time._weighted((image - images[1]) ** 2, images[1]).mean() == pytest.approx(2 * bias, rel=0.4)


@pytest.mark.parametrize("stop_at, spp, passes", [(3, 3 * 2, 2), (37, 32 * 2, 3)])
def test_equal_time_is_interrupted(mi_rgb, tmp_path, monkeypatch, stop_at, spp, passes):
    """Ctrl-C in the reference, which then has so many samples, after which two passes are made; and in the passes."""
    path, original, seeds = tmp_path / "ball.xml", loading.render_pass, []
    path.write_text(PAPER)

    def render_pass(scene, spp, seed):
        seeds.append(seed)
        if len(seeds) == stop_at:
            signal.raise_signal(signal.SIGINT)
        return original(scene, spp, seed)

    monkeypatch.setattr(loading, "render_pass", render_pass)
    monkeypatch.setattr(equal_time._EqualSide, "fill", lambda contender, exact: None)
    result = equal_time.compare_at_equal_time(path, spp=2, passes=4, progress=False)
    figures = result.figures
    assert (figures["interrupted"], figures["reference_spp"], figures["passes"]) == (True, spp, passes)
    assert "interrupted" in str(result)


def test_equal_time(mi_rgb, tmp_path, capsys):
    """Figures and picture of both truths; the exact scene has the asked samples, no bias and a ratio of one."""
    path = tmp_path / "scene.xml"
    path.write_text(TEXTURED.replace("FILE", str(ASSETS / "tiles_filtered.npz")))
    assert cli.main(["compare", str(path), "--equal-time", "--spp", "4", "--passes", "3",
                     "--out", str(tmp_path / "out"), "--json", str(tmp_path / "figures.json")]) == 0  # fmt: skip
    figures = json.loads((tmp_path / "figures.json").read_text())
    contenders = figures["contenders"]
    assert list(contenders) == ["as written", "mipmap", "exact"] and figures["reference"] == "exact"
    exact = contenders["exact"]
    assert exact["spp"] == 4 and exact["plugins"] == ["disney", "bitmap"] and exact["bias"] is None
    assert exact["error_ratio"]["median"] == 1 and figures["reference_spp"] == 4 * 3 * equal_time.REFERENCE
    for c in contenders.values():
        assert c["spp"] >= 1 and c["error"] > 0 and c["noise"] > 0 and c["seconds"]["median"] > 0
    out = capsys.readouterr().out
    assert "of it bias" in out and Path(figures["files"]["figure"]).read_bytes().startswith(b"\x89PNG")


def test_equal_time_without_noise(mi_rgb, tmp_path):
    """Nothing of the scene is random or wrong: no ratio, and no NaN in JSON or text."""
    path = tmp_path / "scene.xml"
    seen = TEXTURED.replace("FILE", str(ASSETS / "tiles_filtered.npz"))
    path.write_text(seen.replace('origin="0,-2,0.4" target="0,0,0"', 'origin="0,0,1" target="0,-1,3"'))
    result = equal_time.compare_at_equal_time(path, spp=4, passes=2, progress=False)
    assert {c["error_ratio"]["median"] for c in result.figures["contenders"].values()} == {None}
    assert all(c["error"] == 0 and c["bias"] is None for c in result.figures["contenders"].values())
    assert "nan" not in str(result).lower() and "NaN" not in json.dumps(result.figures)


def test_a_slow_contender_takes_fewer_samples(mi_rgb, monkeypatch):
    """Four times the time at equal samples: a quarter of the samples, of those that the sampler allows."""
    scene = mi.load_dict({"type": "scene", "sensor": {
        "type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4},
        "sampler": {"type": "multijitter", "sample_count": 64}}})  # fmt: skip
    slow, exact = (equal_time._EqualSide(scene, [], spp) for spp in (64, 64))
    monkeypatch.setattr(slow, "render", lambda seed: (None, 4.0 * slow.spp))
    monkeypatch.setattr(exact, "render", lambda seed: (None, 1.0 * exact.spp))
    slow.fill(exact)
    assert slow.spp == 16 and exact.spp == 64
