"""Check of small pictures before and after: what it sees, what it says, and that it does not cry wolf."""

import numpy as np
import pytest

from mi_diffind.scenes import loading, picture_check

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
    check = picture_check.check_picture(same, same)
    assert not check.differs and (check.width, check.height, check.spp) == (64, 48, 64)
    assert str(check) == (
        f"equal within noise (64 x 48 pixels, 64 spp), which would have shown a difference of {check.seen[0]:.1%} "
        f"in a tile of 16 x 16, of {check.seen[1]:.1%} in the whole"
    )


def test_a_patch_and_the_whole(same):
    """A patch by its tile, by how much and where; a light of which every tile has too little, by the whole picture."""
    patch = picture_check.check_picture(same, load(patch=0.4))
    worst = patch.worst
    assert patch.differs and worst.change == pytest.approx(-0.2, abs=0.08) and max(worst.width, worst.height) <= 32
    assert max(worst.x, worst.y) < 24 and f"pixels at ({worst.x}, {worst.y})" in str(patch)
    assert str(patch).endswith("% darker")
    quiet = picture_check.check_picture(same, same)
    light = picture_check.check_picture(same, load(light=1 + 1.2 * quiet.seen[1]))
    assert light.differs and light.worst.change > 0 and str(light).endswith("% brighter")


def test_large_pictures_and_numbers_that_are_not_finite(same, monkeypatch):
    """Films are rendered with at most 128 pixels a side, and keep their size; a pixel that became NaN is said."""
    large = load(width=640)
    check = picture_check.check_picture(large, large)
    assert (check.width, check.height) == (128, 10) and loading.film_size(large) == (640, 48)
    passes = picture_check._passes

    def broken(scene, first):
        images = passes(scene, first)
        images[:, 3, 4] = np.nan if first else images[:, 3, 4]
        return images

    monkeypatch.setattr(picture_check, "_passes", broken)
    check = picture_check.check_picture(same, same)
    assert str(check) == "differs: values are not finite in 1 pixels, were not in 0 before (64 x 48 pixels, 64 spp)"


def test_rounding_is_no_difference():
    """Two pictures without noise that differ by less than 8 bits show; the power is then stated as that."""
    old = np.ones((picture_check.PASSES, 9, 9))
    check = picture_check.compare_passes(old, 1.0009 * old)
    assert not check.differs and check.seen == pytest.approx((1e-3, 1e-3), rel=0.5)
    assert picture_check.compare_passes(old, 1.0011 * old).differs


def test_black_pictures():
    """Nothing can be seen in them; light where there was none is a difference without a relative change."""
    old = np.zeros((picture_check.PASSES, 9, 9))
    black, lit = picture_check.compare_passes(old, old), picture_check.compare_passes(old, old + 1)
    assert not black.differs and black.seen is None and "too dark" in str(black)
    assert lit.differs and lit.worst.change is None and str(lit).endswith(": no longer black")
    assert str(picture_check.compare_passes(old + 1, old)).endswith(": 100% darker")
    dot = np.zeros((picture_check.PASSES, 128, 128))
    dot[:, 127, 0] = 1  # where hardly a tile lies
    assert picture_check.compare_passes(dot, dot).seen is None


def noise(rng, light=1.0):
    """Passes with the noise of lamps: lognormal, with correlated neighbours."""
    passes = rng.lognormal(0, 1, (picture_check.PASSES, 33, 40))
    return light * (passes + np.roll(passes, 1, axis=1) + np.roll(passes, 1, axis=2)) / 3


def test_false_alarms_and_power(rng, monkeypatch):
    """Few of 300 equal pairs seem to differ; of changes of the whole that are said to be seen, nine of ten do."""
    change = np.median([picture_check.compare_passes(noise(rng), noise(rng)).seen[1] for _ in range(10)])
    monkeypatch.setattr(picture_check, "EXCHANGES", 1)  # the power takes most of the time

    def seen(change, count):
        pairs = ((noise(rng), noise(rng, 1 + change)) for _ in range(count))
        return sum(picture_check.compare_passes(*pair).differs for pair in pairs)

    assert seen(0, 300) <= 8
    assert seen(change / 2, 50) < 25 and 35 <= seen(change, 50) <= 49 and seen(1.5 * change, 50) >= 47
