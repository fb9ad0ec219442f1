"""
Runs that are killed (SIGKILL) at drawn moments and gone on with: the bytes of an undisturbed run, and no file beside
them.
"""

import json
import random
from pathlib import Path

import killed_runs
import numpy as np
import pytest
import trial_files

from mi_diffind.fitting.task import tasks

SCENE = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <shape type="sphere"><float name="radius" value="0.5"/></shape>
</scene>
"""


#: Name of all checkpoints here.
STATE = "state.npz"


def kill_and_go_on(command, folder, whole, kills, prepare="", resume=(), seed=1):
    """Kill a command ``kills`` times at drawn moments, each time going on; then let it end."""
    rng, killed = random.Random(seed), 0
    for _ in range(kills):
        calls = rng.randrange(whole["calls"] // 3, whole["calls"])
        again = [*command, *resume] if (folder / STATE).exists() else command
        killed += killed_runs.run(again, folder, str(calls), prepare) is None
    assert killed >= 1, "the moments lie after the end of the run"
    # A run that was killed before its first checkpoint has none to go on from
    return killed_runs.run([*command, *(resume if (folder / STATE).exists() else ())], folder, prepare=prepare)


def test_a_training(tmp_path):
    command = ["fit", "ggx", "-o", "own.npz", "--checkpoint", "state.npz", "--steps", "401", "--batch", "64",
               "--primary", "4", "--cascaded", "3", "--variant", "llvm_ad_rgb"]  # fmt: skip
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    prepare = "killed_runs:measure_little"
    whole = killed_runs.run(command, tmp_path / "whole", prepare=prepare)
    kill_and_go_on(command, tmp_path / "killed", whole, 1, prepare, ["--resume"])
    assert_same(tmp_path / "whole", tmp_path / "killed", differing={"state.npz"})


def test_a_capture(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    command = ["capture", "../scene.xml", "-o", "views", "--views", "3", "--test", "1", "--resolution", "8",
               "--spp", "2", "--variant", "llvm_ad_rgb"]  # fmt: skip
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    whole = killed_runs.run(command, tmp_path / "whole")
    kill_and_go_on(command, tmp_path / "killed", whole, 1)
    assert_same(tmp_path / "whole", tmp_path / "killed")


def test_a_study(tmp_path):
    """Times differ from run to run, trained parameters and their errors do not."""
    command = ["tradeoff", "killed", "--quick", "--out", "out", "--variant", "llvm_ad_rgb"]
    for name in ("whole", "killed"):
        (tmp_path / name).mkdir()
    prepare = "killed_runs:small_study"
    whole = killed_runs.run(command, tmp_path / "whole", prepare=prepare)
    kill_and_go_on(command, tmp_path / "killed", whole, 1, prepare)
    first, second = (killed_runs.files(tmp_path / name) for name in ("whole", "killed"))
    assert list(first) == list(second)
    results = [json.loads(files["out/tradeoff_killed.json"]) for files in (first, second)]
    records = [result["jobs"]["training"] for result in results]
    for key in ("steps", "psnr_db", "gain_db", "converged", "entries"):
        assert records[0][key] == records[1][key]
    models = [next(p for p in (tmp_path / n).rglob("training.npz")) for n in ("whole", "killed")]
    with np.load(models[0]) as a, np.load(models[1]) as b:
        names = [name for name in a.files if name.startswith("parameter/")]
        assert names and all(a[name].tobytes() == b[name].tobytes() for name in names)


def test_no_temporary_file_outlives_the_next_run(tmp_path):
    """A run that is killed before its file has its name leaves a temporary one, which the next run removes."""
    command = ["inspect", str(next(iter(trial_files.seeds(tasks()["ggx"]).values()))), "--json", "report.json"]
    assert killed_runs.run(command, tmp_path, "replace 1") is None
    assert len(list(tmp_path.iterdir())) == 1
    killed_runs.run(command, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["report.json"]


def assert_same(first: Path, second: Path, differing=frozenset()):
    """Assert that two folders hold the same files, with the same bytes but for those that hold times."""
    first, second = killed_runs.files(first), killed_runs.files(second)
    assert list(first) == list(second)
    for name, content in first.items():
        assert content == second[name] or name in differing, name


# -- all tasks ---------------------------------------------------------------------------------------------------------

#: Tasks whose command line needs a source, as a file.
SOURCES = {"maps": "maps.json", "mesh": "ball.ply", "bsdf": "scene.xml", "views": "views"}

BSDF = """
<scene version="3.0.0"><bsdf type="roughplastic" id="paint"><float name="alpha" value="0.2"/></bsdf></scene>
"""


def write_source(name, folder):
    """Write the small source of a trial as a file; returns its name."""
    source = trial_files.sources(folder)[name]()
    if name == "bsdf":
        (folder / "scene.xml").write_text(BSDF)
    if name == "maps":
        from PIL import Image

        for map_name, values in source.items():
            Image.fromarray(np.uint8(255 * values)).save(folder / f"{map_name}.png")
        (folder / "maps.json").write_text(json.dumps({map_name: f"{map_name}.png" for map_name in source}))
    return SOURCES[name]


def words_of(options):
    """Return options of Python as words of the command line."""
    words = []
    for key, value in options.items():
        if key == "over":
            words += ["--over", *(f"{name}={low}:{high}" for name, (low, high) in value)]
        else:
            words += [f"--{key.replace('_', '-')}", str(value)]
    return words


@pytest.mark.slow
@pytest.mark.parametrize("trial", trial_files.NAMES)
def test_every_task(tmp_path, trial):
    """Five kills of each declared fit."""
    name, _, which = trial.partition("/")
    options = {**trial_files.TRIALS[name][which], "steps": 30}
    source = options.pop("source", None)
    command = ["fit", name, *([f"../{write_source(source, tmp_path)}"] if source else []), "-o", "own.npz",
               "--checkpoint", "state.npz", "--variant", "llvm_ad_rgb", *words_of(options)]  # fmt: skip
    for folder in ("whole", "killed"):
        (tmp_path / folder).mkdir()
    prepare = "killed_runs:measure_little"
    whole = killed_runs.run(command, tmp_path / "whole", prepare=prepare)
    kill_and_go_on(command, tmp_path / "killed", whole, 5, prepare, ["--resume"])
    first, second = (killed_runs.files(tmp_path / n) for n in ("whole", "killed"))
    assert first["own.npz"] == second["own.npz"]
    hidden = [path for path in second if Path(path).name.startswith(".")]
    assert not hidden, "temporary files of killed runs"
