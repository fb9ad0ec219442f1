"""
Rays that no camera sends (NaN, infinity, no direction, denormals, from 10³⁰ away, along sides and cells, from within)
through everything that is traced: every one ends, and no result is NaN or infinite.
"""

import pytest
from hostile_rays import report_of, write_fields


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("hostile")
    write_fields(path)
    return path


def check(folder, count: int, seconds: float):
    report = report_of(folder, count, seconds)
    assert len(report) == 10
    for name, numbers in report.items():
        assert numbers["rays"] == count and numbers["not_finite"] == 0, (name, numbers)
        assert numbers["met"] > 0.03 * count, (name, numbers)


def test_hostile_rays(folder):
    """The limit of time is that of a ray that never ends, far above the seconds that these take."""
    check(folder, 20_000, 300)


@pytest.mark.slow
def test_ten_million_hostile_rays(folder):
    check(folder, 10**7, 7200)
