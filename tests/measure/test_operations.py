"""Counts of operations of expressions counted by hand, and of BSDFs with and without effects."""

import drjit as dr
import pytest

from mi_diffind.measure.clock import Operations, bsdf_operations, count

LANES = 64

USED = {"roughness": 0.4, "specular": 0.6, "base_color": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}


def floats(ad, number):
    """That many opaque arrays."""
    found = [dr.arange(ad.Float, LANES) + k + 1 for k in range(number)]
    dr.make_opaque(found)
    return found


#: Function of three arrays → add, mul, div, sqrt of it.
BY_HAND = {
    "all": (lambda x, y, z: (x * y + dr.sqrt(z)) / (x - y), (2, 1, 1, 1)),
    "two outputs that share": (lambda x, y, z: [x * y + z, x * y - z], (2, 1, 0, 0)),
    "fma of three, and a dot product": (lambda x, y, z: dr.fma(x, x, dr.fma(y, y, z * z)), (2, 3, 0, 0)),
    "minima and selections": (
        lambda x, y, z: dr.select(x < y, dr.maximum(x, z), dr.minimum(dr.abs(x), -z)),
        (0, 0, 0, 0),
    ),
}


@pytest.mark.parametrize("name", BY_HAND)
def test_against_expressions_counted_by_hand(ad, name):
    function, expected = BY_HAND[name]
    inputs = floats(ad, 3)
    found = count(lambda: function(*inputs))
    assert (found.add, found.mul, found.div, found.sqrt) == expected
    assert found.gathers == found.bytes_gathered == 0
    assert found.flops == expected[0] + expected[1] + 2 * expected[2] + 4 * expected[3]


def test_inputs_and_outputs_are_not_counted(ad):
    x, y, _ = floats(ad, 3)
    scalar = ad.Float(3)
    dr.make_opaque(scalar)
    assert count(lambda: scalar * x + y * 2) == Operations(add=1, mul=2, instructions=3)
    assert count(lambda: x) == Operations()
    assert count(lambda: ad.Float(2) * 3) == Operations()


def test_integers_are_no_flops(ad):
    i = dr.arange(ad.UInt32, LANES)
    dr.make_opaque(i)
    found = count(lambda: (i + 3) * i - (i >> 2))
    assert found.flops == 0 and found.instructions == 4


@pytest.mark.parametrize(
    "kind, size", [("Float", 4), ("UInt32", 4), ("Float16", 2), ("Array2f", 8), ("Array4f", 16), ("Array4f16", 8)]
)
def test_gathers(ad, kind, size):
    """A packet of neighbours is one gather; its bytes are those that a lane gets."""
    dtype = getattr(ad, kind)
    source = (dr.value_t(dtype) if dr.depth_v(dtype) > 1 else dtype)(dr.arange(ad.Float, 4 * LANES))
    index = dr.arange(ad.UInt32, LANES) % 4
    dr.make_opaque(source, index)
    found = count(lambda: dr.gather(dtype, source, index))
    assert (found.gathers, found.bytes_gathered, found.flops) == (1, size, 0)
    assert found.instructions == 1  # neither the address nor the mask
    twice = count(lambda: dr.gather(dtype, source, index) + dr.gather(dtype, source, index ^ 1))
    assert (twice.gathers, twice.bytes_gathered) == (2, 2 * size)


def test_calls_are_counted(ad):
    """The functions of a dispatch, all of them; not the helpers that Dr.Jit adds to a kernel."""
    x, _, _ = floats(ad, 3)
    index = dr.arange(ad.UInt32, LANES) % 2
    dr.make_opaque(index)
    found = count(lambda: dr.switch(index, [lambda v: dr.sqrt(v) * v, lambda v: v / (v + 1)], x))
    assert (found.add, found.mul, found.div, found.sqrt) == (1, 1, 1, 1)


# -- materials --------------------------------------------------------------------------------------------------------


def load(mi, **parameters):
    return mi.load_dict({"type": "disney", **USED, **parameters})


def test_effects_that_are_not_in_use_cost_nothing(mi_rgb):
    used, everything = (bsdf_operations(load(mi_rgb, effects=e)) for e in ("used", "all"))
    for method in ("eval", "pdf", "sample"):
        assert used[method].flops < 0.8 * everything[method].flops
        assert used[method].instructions < everything[method].instructions
    with_coat = bsdf_operations(load(mi_rgb, clearcoat=0.5))
    metal = bsdf_operations(load(mi_rgb, metallic=1.0))
    for method in ("eval", "pdf", "sample"):
        assert used[method].flops < with_coat[method].flops < everything[method].flops
        assert metal[method].flops < used[method].flops  # no diffuse lobe


@pytest.mark.parametrize("preset", ["tables", "paper"])
def test_reads_of_tables(mi_rgb, preset):
    found = bsdf_operations(load(mi_rgb, type="neural_disney", preset=preset, storage="float32"))
    assert found["eval"].gathers > 0
    assert found["pdf"].gathers == 0  # analytic
    assert found["sample"].gathers == found["eval"].gathers
    if preset == "tables":
        small = bsdf_operations(load(mi_rgb, type="neural_disney", preset=preset, storage="uint8"), methods=("eval",))
        assert list(small) == ["eval"]
        assert small["eval"].bytes_gathered < found["eval"].bytes_gathered
