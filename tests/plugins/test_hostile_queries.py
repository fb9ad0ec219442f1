"""Materials and textures answer queries that no ray makes with finite numbers, of which none is negative."""

import hostile_queries
import plugin_examples
import pytest


@pytest.mark.parametrize("count", [50_000, pytest.param(10**7, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", plugin_examples.names())
def test_hostile_queries(mi_rgb, name, count):
    if not hostile_queries.is_queried(name):
        pytest.skip("neither a material nor a texture")
    assert not hostile_queries.faults(mi_rgb, name, count)


def test_faults_are_seen(mi_rgb, monkeypatch):
    """Mitsuba's own conductor has a density that is no number in some directions."""
    stock = {"type": "roughconductor", "distribution": "ggx", "eta": 0.0, "k": 0.0, "alpha": 1.0}
    monkeypatch.setattr(hostile_queries, "materials", lambda mi, name: [mi.load_dict(stock)])
    number, values, query = hostile_queries.faults(mi_rgb, "neural_ggx", 50_000)["0: eval"]
    assert number > 100 and values[0] != values[0] and len(query["wi"]) == 3
