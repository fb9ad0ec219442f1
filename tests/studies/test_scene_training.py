"""``tradeoff scene-training``: its scenes, sentences, and a quick run."""

import csv

import pytest
from shading_scenes import fitted, material, scene_file

import mi_diffind
from mi_diffind.cli import main
from mi_diffind.errors import UsageError
from mi_diffind.studies.scene_training import conclusions


def details(way, psnr, scene="room", spp=1):
    figures = {"scene": scene, "way": way, "spp": spp, "psnr_db": psnr, "flip": 0.1, "peak_mib": 300, "lambda": None}
    return {"details": figures}


def test_sentences_name_the_gain_over_the_hemisphere():
    ways = {"start": 20.0, "scene": 22.0, "hemisphere": 21.5, "hemisphere, then scene": 22.75}
    result = {"jobs": {way: details(way, psnr) for way, psnr in ways.items()}}
    line, verdict = conclusions.conclusions(result)
    assert "inside the scene +2.00 dB, hemisphere +1.50 dB over the start; hemisphere, then scene +2.75 dB" in line
    assert "gains +1.25 to +1.25 dB" in verdict and "1 of 1 scenes" in verdict
    # Other samples per pixel than those of the first run do not count
    result["jobs"]["other"] = details("scene", 40.0, spp=4)
    assert conclusions.conclusions(result)[0] == line
    assert len(conclusions.table(result)) == 6
    del result["jobs"]["hemisphere"]
    assert conclusions.conclusions(result) == []


def test_a_scene_that_does_not_exist(tmp_path):
    with pytest.raises(UsageError, match=r"nowhere\.xml, which is no file"):
        mi_diffind.tradeoff("scene-training", tmp_path / "nowhere.xml")


@pytest.mark.long
def test_a_quick_run(tmp_path, mi_rgb):
    scene = scene_file(fitted(material(tmp_path)))
    text = scene.read_text().replace('value="$film"', 'value="16"')
    defaults = (
        '<default name="width" value="16"/><default name="height" value="9"/><default name="max_depth" value="2"/>'
    )
    scene.write_text(text.replace("<default", defaults + "<default", 1))
    out = tmp_path / "out"
    assert main(["tradeoff", "scene-training", str(scene), "--quick", "--out", str(out)]) == 0
    with open(out / "tradeoff_scene-training.csv", encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["representation"] for row in rows] == list(dict.fromkeys(row["representation"] for row in rows))
    assert {row["representation"] for row in rows} == set(conclusions.WAYS)
    assert all(5 < float(row["psnr_db"]) < 100 for row in rows)
