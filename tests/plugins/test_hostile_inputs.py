"""Rays that no camera sends end, and queries that no ray makes are answered, with finite numbers."""

import hostile_inputs
import plugin_examples
import pytest
from limited_child import LimitedChild


@pytest.mark.parametrize("count, seconds", [(20_000, 300), pytest.param(10**7, 7200, marks=pytest.mark.slow)])
def test_rays(tmp_path, count, seconds):
    """The limit of time is that of a ray that never ends, far above the seconds that these take."""
    hostile_inputs.write_fields(tmp_path)
    with LimitedChild(tmp_path, seconds, seconds) as child:
        report = child.check("rays", folder=str(tmp_path), count=count)
    assert report["outcome"] == "loaded" and len(report["fields"]) == 10, report
    for name, numbers in report["fields"].items():
        assert numbers["rays"] == count and numbers["not_finite"] == 0, (name, numbers)
        assert numbers["met"] > 0.03 * count, (name, numbers)


@pytest.mark.parametrize("count", [50_000, pytest.param(10**7, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", plugin_examples.names())
def test_queries(mi_rgb, name, count):
    """No answer of a material or texture is negative, either."""
    if not hostile_inputs.is_queried(name):
        pytest.skip("neither a material nor a texture")
    assert not hostile_inputs.faults(name, count)


def test_faults_are_seen(mi_rgb, monkeypatch):
    """Mitsuba's own conductor has a density that is no number in some directions."""
    stock = {"type": "roughconductor", "distribution": "ggx", "eta": 0.0, "k": 0.0, "alpha": 1.0}
    monkeypatch.setattr(hostile_inputs, "materials", lambda name: [mi_rgb.load_dict(stock)])
    number, values, query = hostile_inputs.faults("neural_ggx", 50_000)["0: eval"]
    assert number > 100 and values[0] != values[0] and len(query["wi"]) == 3
