"""The test of blocks and stops, and of small pictures: windows, t-tests against SciPy's, false alarms, the power."""

import numpy as np
import pytest
from scipy import stats

from mi_diffind.scenes import block_test, loading
from mi_diffind.scenes.block_test import PICTURE_PASSES, BlockReference, block_means, check_picture, compare_passes

HEIGHT, WIDTH = 46, 70  # no multiples of 4


def passes(rng, count, truth, noise):
    """Block means of passes whose pixels have independent normal noise."""
    pixels = block_means(truth)
    return pixels + noise / 4 * rng.standard_normal((count, *pixels.shape))


def reference(rng, truth, noise):
    """A reference, and the change that it promises to see."""
    blocks = passes(rng, 128, truth, noise)
    groups = blocks.reshape(16, 8, *blocks.shape[1:])
    known = BlockReference.from_groups(blocks[:16], groups.mean(axis=1), *truth.shape[:2])
    return known, known.visible_change(groups[2:])


@pytest.fixture
def truth():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (0.6 + 0.3 * np.sin(rows / 9) * np.cos(columns / 13))[..., None] * [1, 0.8, 0.5]


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 100), (5, 4), (9, 9), (46, 70)])
def test_windows_are_means_of_the_picture(rng, size):
    """Each value of t is that of SciPy's test of the means of the pixels in its window; the largest is everything."""
    before, after = rng.random((16, *size, 3)), rng.random((8, *size, 3))
    blocks = [np.stack([block_means(image) for image in side]) for side in (before, after)]
    test = BlockReference(blocks[0], blocks[0].mean(axis=0), np.linspace(0, 9, 16), *size).test(blocks[1])
    for level in test.levels:
        shape = np.array(level.t.shape[:2])
        assert ((shape - 1) * level.stride + level.side >= size).all()  # nothing is left out
        for row, column in np.ndindex(*shape):
            y, x = row * level.stride, column * level.stride
            window = np.s_[:, y : y + level.side, x : x + level.side]
            expected = stats.ttest_ind(after[window].mean(axis=(1, 2)), before[window].mean(axis=(1, 2))).statistic
            assert np.allclose(level.t[row, column], expected, rtol=1e-6)
    assert (
        test.levels[-1].t.shape == (1, 1, 3) and [level.side for level in test.levels][:2] == [4, 8][: len(test.levels)]
    )
    chances = [level.t.size * 2 * stats.t.sf(level.threshold, 22) for level in test.levels]
    assert np.allclose(chances, 0.008 / len(test.levels), rtol=0.005)


def test_alarms_of_nothing(rng, truth):
    """One check in a hundred, if no more than the noise differs; 8.6 expected of 860, two of them by stops."""
    alarms, by_stops = 0, 0
    for _ in range(4):
        known, _ = reference(rng, truth, 0.3)
        for _ in range(215):
            test = known.test(passes(rng, 8, truth, 0.3))
            alarms, by_stops = alarms + (not test.passed), by_stops + (test.stops > test.stops_threshold)
    assert alarms <= 17 and by_stops <= 6


def test_rare_bright_samples_make_no_alarm(rng, truth):
    """A pixel in a thousand is a hundred times too bright, in the check as in the reference."""
    alarms = 0
    for _ in range(3):
        rendered = [np.where(rng.random(truth.shape[:2]) < 1e-3, 100, 1)[..., None] * truth for _ in range(128 + 320)]
        blocks = np.stack([block_means(image) for image in rendered])
        groups = blocks[:128].reshape(16, 8, *blocks.shape[1:]).mean(axis=1)
        known = BlockReference.from_groups(blocks[:16], groups, HEIGHT, WIDTH)
        alarms += sum(not known.test(blocks[i : i + 8]).passed for i in range(128, 448, 8))
    assert alarms <= 5


def test_the_power_is_as_promised(rng, truth):
    """Tiles at random places, brighter by the change that is found nine times of ten; half of the change is not."""
    found = {1.0: 0, 0.5: 0}
    for _ in range(4):
        known, change = reference(rng, truth, 0.3)
        for factor in found:
            for _ in range(75):
                y, x = rng.integers(HEIGHT - 15), rng.integers(WIDTH - 15)
                changed = truth.copy()
                changed[y : y + 16, x : x + 16] *= 1 + factor * change
                found[factor] += not known.test(passes(rng, 8, changed, 0.3)).passed
    assert 0.86 <= found[1.0] / 300 <= 0.94 and found[0.5] / 300 < 0.5


def test_the_worst_block_is_named(rng, truth):
    known, _ = reference(rng, truth, 0.1)
    changed = truth.copy()
    changed[16:32, 24:40, 1] *= 0.9
    worst = known.test(passes(rng, 8, changed, 0.1)).worst
    assert (worst.x, worst.y, worst.width, worst.height, worst.side) == (24, 16, 16, 16, 16)
    assert worst.channel == "green" and worst.change == pytest.approx(-0.1, abs=0.02) and worst.t < -worst.threshold
    changed = truth[..., :1].copy()
    changed[40:, 64:] *= 1.5  # windows that the edges crop: 6 × 6 pixels
    worst = reference(rng, truth[..., :1], 0.1)[0].test(passes(rng, 8, changed, 0.1)).worst
    assert (worst.x + worst.width, worst.y + worst.height) == (WIDTH, HEIGHT) and worst.width < worst.side
    assert worst.channel == "brightness" and worst.t > worst.threshold


def test_changes_that_cancel_out_are_seen_in_stops(rng, truth):
    """More and less light in turn, pixel block by pixel block: no block of its own, the picture as a whole."""
    known, _ = reference(rng, truth, 0.3)
    pattern = np.where(np.add.outer(np.arange(HEIGHT) // 4, np.arange(WIDTH) // 4) % 2, 1.1, 0.9)[..., None]
    tests = [known.test(passes(rng, 8, truth * pattern, 0.3)) for _ in range(20)]
    assert all(test.stops > test.stops_threshold for test in tests)
    assert sum(test.failing_blocks > 0 for test in tests) < 15


def test_pictures_without_noise(truth):
    """Rounding passes, a change of a thousandth does not; black is compared with black only."""
    rows, columns = block_means(truth).shape[:2]
    known, change = reference(np.random.default_rng(0), truth, 0)
    assert known.test(np.stack([block_means(truth * (1 + 5e-5))] * 8)).passed
    assert not known.test(np.stack([block_means(truth * 1.001)] * 8)).passed
    assert 1e-4 < change < 1e-3
    black = BlockReference(np.zeros((16, rows, columns, 3)), np.zeros((rows, columns, 3)), np.zeros(16), HEIGHT, WIDTH)
    check = np.zeros((8, rows, columns, 3))
    assert black.test(check).passed and black.visible_change(check[None]) == np.inf
    check[:, 3, 2] = 1e-3
    test = black.test(check)
    assert not test.passed and test.worst.change is None


def test_values_that_are_not_finite_fail_alone(rng, truth):
    """They are counted, and spoil no other window; negative values, as Mitchell's filter has, are values."""
    known, _ = reference(rng, truth, 0.3)
    check = passes(rng, 8, truth, 0.3)
    check[2, 5, 6, 0] = np.nan
    test = known.test(check, not_finite=1)
    assert not test.passed and test.failing_blocks == 0 and np.isfinite(test.stops) and np.isfinite(test.worst.t)
    check[:, 8, 9] = 50
    assert known.test(check, not_finite=1).failing_blocks > 0
    assert block_test.mean_stops(np.array([-1.0, 1.0]), np.array([0.0, 3.0]), 1.0) == pytest.approx(0.5)


SCENE = """<scene version="3.0.0"><integrator type="direct"/>
    <sensor type="perspective"><float name="fov" value="60"/><transform name="to_world">
        <lookat origin="0,0,2" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="WIDTH"/><integer name="height" value="48"/></film></sensor>
    <emitter type="constant"><rgb name="radiance" value="LIGHT"/></emitter>
    <shape type="rectangle"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
    <shape type="rectangle"><transform name="to_world"><scale value="0.15"/><translate x="-0.7" y="0.6" z="0.05"/>
        </transform><bsdf type="diffuse"><rgb name="reflectance" value="PATCH"/></bsdf></shape></scene>"""


def load(width=64, light=1.0, patch=0.5):
    return loading.load_string(
        SCENE.replace("WIDTH", f"{width}").replace("LIGHT", f"{light}").replace("PATCH", f"{patch}")
    )


@pytest.fixture
def same(mi_rgb):
    return load()


def test_equal_scenes(same):
    """No block differs, and the sentence states the power."""
    check = check_picture(same, same)
    assert not check.differs and (check.width, check.height, check.spp) == (64, 48, 64)
    assert str(check) == (
        f"equal within noise (64 x 48 pixels, 64 spp), which would have shown a difference of {check.seen[0]:.1%} "
        f"in a tile of 16 x 16, of {check.seen[1]:.1%} in the whole"
    )


def test_a_patch_and_the_whole(same):
    """A patch by its tile, by how much and where; a light of which every tile has too little, by the whole picture."""
    patch = check_picture(same, load(patch=0.4))
    worst = patch.worst
    assert patch.differs and worst.change == pytest.approx(-0.2, abs=0.08) and max(worst.width, worst.height) <= 32
    assert max(worst.x, worst.y) < 24 and f"pixels at ({worst.x}, {worst.y})" in str(patch)
    assert str(patch).endswith("% darker")
    quiet = check_picture(same, same)
    light = check_picture(same, load(light=1 + 1.2 * quiet.seen[1]))
    assert light.differs and light.worst.change > 0 and str(light).endswith("% brighter")


def test_large_pictures_and_numbers_that_are_not_finite(same, monkeypatch):
    """Films are rendered with at most 128 pixels a side, and keep their size; a pixel that became NaN is said."""
    large = load(width=640)
    check = check_picture(large, large)
    assert (check.width, check.height) == (128, 10) and loading.film_size(large) == (640, 48)
    small_pass = block_test._small_pass

    def broken(scene, seed):
        image = small_pass(scene, seed)
        image[3, 4] = np.nan if seed >= PICTURE_PASSES else image[3, 4]
        return image

    monkeypatch.setattr(block_test, "_small_pass", broken)
    check = check_picture(same, same)
    assert str(check) == "differs: values are not finite in 1 pixels, were not in 0 before (64 x 48 pixels, 64 spp)"


def test_rounding_is_no_difference():
    """Two pictures without noise that differ by less than 8 bits show; the power is then stated as that."""
    old = np.ones((PICTURE_PASSES, 9, 9))
    check = compare_passes(old, 1.0009 * old)
    assert not check.differs and check.seen == pytest.approx((1e-3, 1e-3), rel=0.5)
    assert compare_passes(old, 1.0011 * old).differs


def test_black_pictures():
    """Nothing can be seen in them; light where there was none is a difference without a relative change."""
    old = np.zeros((PICTURE_PASSES, 9, 9))
    black, lit = compare_passes(old, old), compare_passes(old, old + 1)
    assert not black.differs and black.seen is None and "too dark" in str(black)
    assert lit.differs and lit.worst.change is None and str(lit).endswith(": no longer black")
    assert str(compare_passes(old + 1, old)).endswith(": 100% darker")
    dot = np.zeros((PICTURE_PASSES, 128, 128))
    dot[:, 127, 0] = 1  # where hardly a tile lies
    assert compare_passes(dot, dot).seen is None


def noise(rng, light=1.0):
    """Passes with the noise of lamps: lognormal, with correlated neighbours."""
    passes = rng.lognormal(0, 1, (PICTURE_PASSES, 33, 40))
    return light * (passes + np.roll(passes, 1, axis=1) + np.roll(passes, 1, axis=2)) / 3


def test_false_alarms_and_power(rng, monkeypatch):
    """Few of 300 equal pairs seem to differ; of changes of the whole that are said to be seen, nine of ten do."""
    change = np.median([compare_passes(noise(rng), noise(rng)).seen[1] for _ in range(10)])
    monkeypatch.setattr(block_test, "EXCHANGES", 1)  # the power takes most of the time

    def seen(change, count):
        pairs = ((noise(rng), noise(rng, 1 + change)) for _ in range(count))
        return sum(compare_passes(*pair).differs for pair in pairs)

    assert seen(0, 300) <= 8
    assert seen(change / 2, 50) < 25 and 35 <= seen(change, 50) <= 49 and seen(1.5 * change, 50) >= 47
