"""``tradeoff scene-training``: its scenes and sentences."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mi_diffind
from mi_diffind.core.errors import UsageError
from mi_diffind.studies.scene_training import conclusions


def details(way, psnr, scene="room", spp=1):
    figures = {"scene": scene, "way": way, "spp": spp, "psnr_db": psnr, "flip": 0.1, "peak_mib": 300, "lambda": None}
    return {"details": figures}


def test_sentences_name_the_gain_over_the_hemisphere():
    ways = {"start": 20.0, "scene": 22.0, "hemisphere": 21.5, "hemisphere, then scene": 22.75}
    result = {"jobs": {way: details(way, psnr) for way, psnr in ways.items()}}
    line, alone, after = conclusions.conclusions(result)
    assert line == "room, over the start: scene +2.00 dB; hemisphere +1.50 dB; hemisphere, then scene +2.75 dB"
    assert "for the same seconds gains +0.50 to +0.50 dB: 0 of 1 scenes" in alone
    assert "with more seconds, gains +1.25 to +1.25 dB: 1 of 1 scenes" in after
    # Other samples per pixel than those of the first run do not count
    result["jobs"]["other"] = details("scene", 40.0, spp=4)
    assert conclusions.conclusions(result)[0] == line
    assert len(conclusions.table(result)) == 6
    # The control, and a wrong start
    result["jobs"]["longer"] = details(conclusions.LONGER, 21.75)
    result["jobs"]["wrong"] = details(f"{conclusions.OTHER}, then scene", 21.9)
    control, wrong = conclusions.conclusions(result)[3:]
    assert "to its end" in control and "gains +1.00 to +1.00 dB: 1 of 1 scenes" in control
    assert wrong == "a start from another material ends -0.10 to -0.10 dB from the right one"
    del result["jobs"]["hemisphere"]
    assert not any("for the same seconds" in line for line in conclusions.conclusions(result))


def test_a_scene_that_does_not_exist(tmp_path):
    with pytest.raises(UsageError, match=r"nowhere\.xml, which is no file"):
        mi_diffind.tradeoff("scene-training", tmp_path / "nowhere.xml")


def test_runs_that_start_from_one_that_is_left_out():
    from mi_diffind.studies.scene_training.plan import SceneTrainingSettings, planned_runs

    context = SimpleNamespace(name="room", settings=SceneTrainingSettings())
    runs = planned_runs(context, [])
    assert {run.method for run in runs} == set(conclusions.WAYS) and len({run.name for run in runs}) == len(runs)
    # λ, 0.9 unless it is left out, and samples a pixel are changed one at a time
    inside = [(run.share, run.budget) for run in runs if run.method == "scene"]
    assert inside == [(0.9, 1), (0.5, 1), (1.0, 1), (0.9, 4)]
    left = {run.method for run in planned_runs(context, ["hemisphere", "another material"])}
    assert left == {"start", "scene", conclusions.LONGER, "untrained, then scene", conclusions.FEW}


def test_maps_of_another_material():
    from mi_diffind.maps.source import load_source
    from mi_diffind.studies.scene_training.plan import other_maps

    path = Path(__file__).resolve().parents[2] / "scenes" / "assets" / "rust.json"
    other = other_maps(path)
    for entry in load_source(path).maps:
        values = np.round(255 * entry.values).astype(int)
        turned = values[:, ::-1].swapaxes(0, 1)
        assert np.array_equal(other[entry.name], turned if entry.name == "normal" else 255 - turned)
