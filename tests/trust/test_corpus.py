"""Everything that ever failed: each file and command line is refused in one sentence, or does as it should."""

import pytest
from hostile_corpus import CASES
from limited_child import LimitedChild

#: Cases that fail today.
MENDED_NEXT = set()


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    with LimitedChild(tmp_path_factory.mktemp("corpus")) as limited:
        yield limited


def marked(name):
    mending = pytest.mark.xfail(strict=True, reason="being mended")
    return pytest.param(name, marks=[mending] if name in MENDED_NEXT else [])


@pytest.mark.parametrize("name", [*map(marked, CASES)])
def test_what_once_failed(child, name):
    probe, arguments = CASES[name].write(child.folder)
    answer = child.check(probe, **arguments)
    assert answer["outcome"] in CASES[name].outcomes, answer
