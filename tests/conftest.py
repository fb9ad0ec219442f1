"""Fixtures shared by all tests: Mitsuba variants and seeded generators."""

import faulthandler
import gc

import numpy as np
import pytest
from _pytest.faulthandler import fault_handler_stderr_fd_key
from variants import BACKENDS, VARIANTS, set_variant

from mi_diffind.core.runtime import array_module

#: Seconds that a test marked ``slow`` or ``long`` may take; others have ``faulthandler_timeout`` of ``pyproject.toml``.
LONG_LIMIT = 3600


def pytest_runtest_setup(item):
    if any(item.get_closest_marker(name) for name in ("slow", "long")):
        faulthandler.dump_traceback_later(LONG_LIMIT, exit=True, file=item.config.stash[fault_handler_stderr_fd_key])


def pytest_collection_modifyitems(items):
    """Notebooks and tests of a finished run of a study are long. Within a file, tests of one variant follow each other:
    a switch costs a tenth of a second.
    """
    for item in items:
        if item.path.suffix == ".ipynb" or "finished" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.long)
    files, order = {}, {name: i for i, name in enumerate(VARIANTS)}

    def place(item):
        params = getattr(item, "callspec", None) and item.callspec.params
        named = [params[key] for key in ("mi_any", "mi_rgb", "variant") if params and key in params]
        return files.setdefault(item.path, len(files)), order.get(named[0] if named else "", 0)

    items.sort(key=place)


@pytest.fixture(params=BACKENDS)
def ad(request):
    """The Dr.Jit types of a backend with derivatives."""
    return array_module(request.param)


@pytest.fixture(params=[f"{backend}_ad_rgb" for backend in BACKENDS])
def mi_rgb(request):
    """``mitsuba`` with an RGB variant set."""
    return set_variant(request.param)


@pytest.fixture
def mi(mi_rgb):
    """``mitsuba`` with an RGB variant set, by its usual name."""
    return mi_rgb


@pytest.fixture(params=VARIANTS)
def mi_any(request):
    """``mitsuba`` with each supported variant set in turn."""
    return set_variant(request.param)


@pytest.fixture
def rng():
    return np.random.default_rng(20231212)


@pytest.fixture(scope="module", autouse=True)
def collect_garbage():
    """Scenes and optimisers die with their module, not at some point of a later test."""
    yield
    gc.collect()


@pytest.fixture
def few_samples(monkeypatch):
    """Final measurements of a training at fewer places than for a user."""
    from mi_diffind.tasks.disney.training import DisneyModel
    from mi_diffind.tasks.ggx.training import GGXModel
    from mi_diffind.tasks.image.arrays import CompressedImage

    for function, samples in (
        (CompressedImage._between, 2**13),
        (GGXModel.measure, 2**17),
        (DisneyModel.measure, 2**16),
    ):
        monkeypatch.setattr(function, "__defaults__", (samples,))


@pytest.fixture
def no_garbage_collection():
    """For frozen functions: Dr.Jit aborts if the collector frees its arrays while it records one."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()
