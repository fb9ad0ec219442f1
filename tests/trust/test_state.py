"""State of a scene: several sensors, numbers of threads, and what is left when it dies.

The plugins are those of the registry, in each storage form, and the scenes those of ``helpers/plugin_examples.py``.
Films have a box filter: with any other, two renders of one scene differ in the last digits.
"""

import gc

import drjit as dr
import numpy as np
import plugin_examples as examples
import pytest
from variants import VARIANTS, set_variant

from mi_diffind import plugins
from mi_diffind.plugins.support import footprint

#: Variants of the tests that always run.
QUICK = tuple(variant for variant in VARIANTS if variant.endswith("_ad_rgb"))

#: Samples in a pixel.
SPP = 4

#: Variant × plugin × storage form ("": the default form).
CASES = [
    pytest.param(variant, name, storage, id=f"{variant}-{name}-{storage or 'default'}",
                 marks=() if variant in QUICK else pytest.mark.slow)
    for variant in VARIANTS for name in examples.names()
    for storage in ("", "float32")[: 1 + name.startswith("neural_")]  # these read tables
]  # fmt: skip


def loaded(variant: str, name: str, storage: str):
    """Return ``mitsuba`` with the variant set; skip the test if the plugin refuses the variant."""
    mi = set_variant(variant)
    if refusal := examples.refusal(mi, name, storage):
        pytest.skip(refusal)
    return mi


def render(mi, scene, seed=3, **more) -> np.ndarray:
    """Return an image."""
    return np.array(mi.render(scene, spp=SPP, seed=mi.UInt32(seed), **more))


@pytest.mark.parametrize("variant, name, storage", CASES)
def test_several_sensors(variant, name, storage):
    """Each of two sensors of a scene sees what it sees alone, in any order."""
    mi = loaded(variant, name, storage)
    angles = (20.0, 200.0)
    alone = [render(mi, examples.load(mi, name, storage, [angle])) for angle in angles]
    assert not np.array_equal(*alone)
    scene = examples.load(mi, name, storage, angles)
    for sensor in (1, 0, 1):
        np.testing.assert_array_equal(render(mi, scene, sensor=sensor), alone[sensor], err_msg=f"sensor {sensor}")


@pytest.mark.parametrize("variant, name, storage", [c for c in CASES if c.values[0].startswith("llvm")])
def test_numbers_of_threads(variant, name, storage):
    """A scene that is loaded and rendered by one, two or five threads is the same image."""
    mi, before, images = loaded(variant, name, storage), dr.thread_count(), []
    try:
        for number in (1, 2, 5):
            dr.eval()
            dr.sync_thread()
            dr.set_thread_count(number)
            images.append(render(mi, examples.load(mi, name, storage)))
    finally:
        dr.set_thread_count(before)
    for image in images[1:]:
        np.testing.assert_array_equal(image, images[0])


def alive() -> int:
    """Return the number of objects of this package's plugins."""
    return sum(str(type(o).__module__).startswith(plugins.__name__) for o in gc.get_objects())


@pytest.mark.parametrize("name", examples.names())
def test_objects_die_with_their_scene(mi, no_garbage_collection, name):
    """Without waiting for the garbage collector: Dr.Jit refuses to freeze a function, and may crash in the middle of a
    render, if instances that nobody holds any more are in its registry.
    """
    storage = "float32" if plugins.declared()[name].task else ""
    examples.load(mi, name, storage)  # arrays of files are kept
    before = alive()
    scene = examples.load(mi, name, storage)
    footprint.attach(scene)
    params, keys = examples.exposed(mi, scene, name)
    for key in keys[:1]:
        dr.enable_grad(params[key])
    params.update()
    loss = dr.sum(mi.render(scene, params, spp=1).array)
    if dr.grad_enabled(loss):
        dr.backward(loss)
    assert alive() > before
    del scene, params, loss
    assert alive() == before


def test_scalar_variants_are_refused():
    mi = set_variant("scalar_rgb")
    for name in plugins.declared():
        with pytest.raises(RuntimeError, match=f'"{name}" does not run in the variant "scalar_rgb"; use one of llvm'):
            mi.load_dict({"type": name})


def test_each_plugin_has_an_example():
    """A plugin is found by its registration; its example needs an entry only if it needs parameters."""
    set_variant(QUICK[0])
    assert set(examples.names()) == set(plugins.declared()) >= set(examples.PARAMETERS)
