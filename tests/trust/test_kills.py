"""
Runs that are killed (SIGKILL) at drawn moments and gone on with: the bytes of an undisturbed run, and no file beside
them.
"""

import json
import random

import killed_runs
import numpy as np
import trial_files

from mi_diffind.fitting.task import tasks

SCENE = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <shape type="sphere"><float name="radius" value="0.5"/></shape>
    <bsdf type="roughplastic" id="paint"><float name="alpha" value="0.2"/></bsdf>
</scene>
"""

#: Name of all checkpoints here.
STATE = "state.npz"

#: Words of a fit with a checkpoint.
FIT = ["-o", "own.npz", "--checkpoint", STATE, "--variant", "llvm_ad_rgb"]


def kill_and_go_on(command, folder, kills=1, prepare="", resume=()):
    """Run a command in ``folder / "whole"``; in ``folder / "killed"``, kill it at drawn moments, each time going on.

    Returns the files of both folders.
    """
    whole, killed = (folder / name for name in ("whole", "killed"))
    for each in (whole, killed):
        each.mkdir()
    calls, rng = killed_runs.run(command, whole, prepare=prepare), random.Random(1)

    def again():  # a run that was killed before its first checkpoint has none to go on from
        return [*command, *(resume if (killed / STATE).exists() else ())]

    moments = [str(rng.randrange(calls // 3, calls)) for _ in range(kills)]
    ended = [killed_runs.run(again(), killed, moment, prepare) for moment in moments]
    assert None in ended, "the moments lie after the end of the run"
    killed_runs.run(again(), killed, prepare=prepare)
    return killed_runs.files(whole), killed_runs.files(killed)


def assert_same(first, second, differing=()):
    """Assert that two folders hold the same files, with the same bytes but for those that hold times."""
    assert list(first) == list(second)
    assert [name for name, content in first.items() if content != second[name] and name not in differing] == []


def test_a_training(tmp_path):
    command = ["fit", "ggx", *FIT, "--steps", "401", "--batch", "64", "--primary", "4", "--cascaded", "3"]
    files = kill_and_go_on(command, tmp_path, 1, "measure_little", ["--resume"])
    assert_same(*files, differing={STATE})


def test_a_capture(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    command = ["capture", "../scene.xml", "-o", "views", "--views", "3", "--test", "1", "--resolution", "8",
               "--spp", "2", "--variant", "llvm_ad_rgb"]  # fmt: skip
    assert_same(*kill_and_go_on(command, tmp_path))


def test_a_study(tmp_path):
    """Times differ from run to run, trained parameters and their errors do not."""
    command = ["tradeoff", "killed", "--quick", "--out", "out", "--variant", "llvm_ad_rgb"]
    first, second = kill_and_go_on(command, tmp_path, prepare="small_study")
    assert list(first) == list(second)
    records = [json.loads(files["out/tradeoff_killed.json"])["jobs"]["training"] for files in (first, second)]
    for key in ("steps", "psnr_db", "gain_db", "converged", "entries"):
        assert records[0][key] == records[1][key]
    models = [next(p for p in (tmp_path / n).rglob("training.npz")) for n in ("whole", "killed")]
    with np.load(models[0]) as a, np.load(models[1]) as b:
        assert a.files and all(a[name].tobytes() == b[name].tobytes() for name in a.files)


def test_no_temporary_file_outlives_the_next_run(tmp_path):
    """A run that is killed before its file has its name leaves a temporary one, which the next run removes."""
    command = ["inspect", str(next(iter(trial_files.seeds(tasks()["ggx"]).values()))), "--json", "report.json"]
    assert killed_runs.run(command, tmp_path, "replace 1") is None
    assert len(list(tmp_path.iterdir())) == 1
    killed_runs.run(command, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]
