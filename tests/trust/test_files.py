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
from hostile_corpus import tiny_files
from hostile_strategies import MUTANTS
from limited_child import FAULTS, LimitedChild

from mi_diffind.fitting.task import tasks

TABLES = campaigns.tables()

#: Structured mutants, and mutants by bytes, of each file in a default run.
STRUCTURED, RAW = 6, 2

#: One in so many of the table files that load is decoded and rendered in a default run.
SHARE = 4

#: Targets with faults that are being mended: no mutant of them may fail after that.
MENDED_NEXT = set()


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    with LimitedChild(tmp_path_factory.mktemp("mutants")) as limited:
        yield limited


def marked(name):
    mending = pytest.mark.xfail(strict=True, reason="being mended")
    return pytest.param(name, marks=[mending] if name in MENDED_NEXT else [])


def check(child, target, structured, raw, share=1):
    for recipes, count in ((target.structured, structured), (target.raw, raw)):
        campaign = campaigns.run(child, target, recipes, count, share=share)
        assert campaign.outcomes.total() >= min(count, 2)
        assert not any(campaign.outcomes[fault] for fault in FAULTS), json.dumps(campaign.faults, indent=1)


@pytest.mark.parametrize("name", [name for name, task in tasks().items() if trial_files.has_files(task)])
def test_every_task_declares_small_files(name):
    task = tasks()[name]
    files = trial_files.seeds(task)
    assert files, f"the task {name} has no file to damage: give it trials (trial_files.TRIALS)"
    for file in files.values():
        assert file.is_file(), f"{file} is missing: python tests/trust/run.py --seeds {file.stem}"
        assert task.load(file).arrays, f"{file} is out of date: python tests/trust/run.py --seeds {file.stem}"


@pytest.mark.parametrize("name", [*map(marked, TABLES)])
def test_damaged_tables(child, name):
    check(child, TABLES[name], STRUCTURED, RAW, SHARE)


@pytest.mark.parametrize("name", [*map(marked, campaigns.OTHERS)])
def test_damaged_inputs(child, name):
    check(child, campaigns.OTHERS[name](child), STRUCTURED, RAW)


@pytest.mark.parametrize("file", tiny_files(), ids=lambda file: file.stem)
def test_recipes_that_once_failed(child, file):
    """Files of ``corpus/*.json``, which ``run.py`` has found: target and recipe."""
    content = json.loads(file.read_text())
    target = TABLES.get(content["target"]) or campaigns.OTHERS[content["target"]](child)
    answer = child.check(target.probe, **target.write(child.folder, content["recipe"]))
    assert answer["outcome"] not in FAULTS, answer


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLES)
def test_many_damaged_tables(child, name):
    """As many as the environment variable MI_DIFFIND_MUTANTS says (default: 2000)."""
    check(child, TABLES[name], MUTANTS, 10 * MUTANTS)


@pytest.mark.slow
@pytest.mark.parametrize("name", campaigns.OTHERS)
def test_many_damaged_inputs(child, name):
    check(child, campaigns.OTHERS[name](child), MUTANTS, 10 * MUTANTS)


@pytest.mark.slow
@pytest.mark.parametrize("name", trial_files.NAMES)
def test_trials_have_the_arrays_of_the_kept_files(mi_rgb, tmp_path, name):
    """The files in ``corpus/seeds`` are what the trials still give."""
    task, trial = name.split("/")
    trained = trial_files.make(tasks()[task], trial, tmp_path, tmp_path / "trial.npz")
    kept = tasks()[task].load(trial_files.SEEDS / f"{task}_{trial}.npz")
    assert set(tasks()[task].load(trained).arrays) == set(kept.arrays)
