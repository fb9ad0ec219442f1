"""Rays that no camera sends end, with finite numbers. (Queries of materials and textures: their contracts.)"""

import hostile_inputs
import pytest
from limited_child import LimitedChild


@pytest.mark.parametrize("count, seconds", [(20_000, 300), pytest.param(10**6, 7200, marks=pytest.mark.slow)])
def test_rays(tmp_path, count, seconds):
    """The limit of time is that of a ray that never ends, far above the seconds that these take."""
    hostile_inputs.write_fields(tmp_path)
    with LimitedChild(tmp_path, seconds, seconds) as child:
        report = child.check("rays", folder=str(tmp_path), count=count)
    assert report["outcome"] == "loaded" and len(report["fields"]) == 10, report
    for name, (met, wrong) in report["fields"].items():
        assert wrong == 0 and met > 0.03, (name, met, wrong)
