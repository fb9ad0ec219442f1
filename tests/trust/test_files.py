"""
Damaged files of every task and every reader: each is refused in one sentence, or it loads, and then arrays that nothing
was done to are unchanged and everything that is computed from it is finite. No read leaves an array, no mutant takes
more memory or time than its size allows.

A task gets its part of this suite by fits of seconds, whose files are damaged (``trial_files.TRIALS``).
"""

import json

import campaigns
import pytest
import trial_files
from damage import MUTANTS, Archive, Mutant
from limited_child import FAULTS, LimitedChild

from mi_diffind.fitting.task import tasks


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    with LimitedChild(tmp_path_factory.mktemp("mutants")) as limited:
        yield limited


@pytest.mark.parametrize("name", [name for name, task in tasks().items() if trial_files.has_files(task)])
def test_every_task_has_small_files(name):
    """Where they are missing or out of date: ``python tests/trust/run.py --seeds NAME``."""
    assert trial_files.seeds(tasks()[name]), "the task has no file to damage: give it trials (trial_files.TRIALS)"


@pytest.mark.parametrize(
    "structured, raw, share",
    # As many as the environment variable MI_DIFFIND_MUTANTS says (default: 2000)
    [(6, 2, 4), pytest.param(MUTANTS, 10 * MUTANTS, 1, marks=pytest.mark.slow)],
    ids=["few", "many"],
)
@pytest.mark.parametrize("name", [*campaigns.TABLES, *campaigns.OTHERS])
def test_damaged_files(child, name, structured, raw, share):
    """Mutants by structure and by bytes; of the tables that load, one in ``share`` is decoded and rendered."""
    target = campaigns.target(name, child)
    for form, count in (("structured", structured), ("raw", raw)):
        figures = campaigns.run(child, name, target, form, count, share=share)
        assert figures["mutants"] >= min(count, 2)
        assert not any(figures[fault] for fault in FAULTS), json.dumps(figures["faults"], indent=1, default=repr)


@pytest.mark.parametrize("name", [*campaigns.TABLES, *campaigns.OTHERS])
def test_undamaged_files_load(child, name):
    """An archive that is written again without a lie has the same arrays and description."""
    target = campaigns.target(name, child)
    file, _ = target.mutants["raw"]
    data = target.files[file]
    answer = child.check(target.probe, **target.write(child.folder, file, Mutant(data, [])))
    assert answer["outcome"] == "loaded", answer
    if file.endswith(".npz"):
        archive = Archive(data)
        copy = Archive(archive.write())
        assert copy.members() == archive.members() and list(copy.arrays) == list(archive.arrays)


@pytest.mark.slow
@pytest.mark.parametrize("name", trial_files.NAMES)
def test_trials_have_the_arrays_of_the_kept_files(mi_rgb, tmp_path, name):
    """The files in ``corpus/seeds`` are what the trials still give."""
    task, trial = name.split("/")
    trained = trial_files.make(tasks()[task], trial, tmp_path, tmp_path / "trial.npz")
    kept = tasks()[task].load(trial_files.SEEDS / f"{task}_{trial}.npz")
    assert set(tasks()[task].load(trained).arrays) == set(kept.arrays)
