"""Small valid files of every task, from fits of seconds (:data:`TRIALS`).

Some of these fits take minutes: their files are kept in ``tests/trust/corpus/seeds``, which ``python
tests/helpers/trial_files.py TASK/NAME...`` writes anew.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path

import numpy as np

from mi_diffind.fitting.task import DATA, Task, tasks

CORPUS = Path(__file__).resolve().parents[1] / "trust" / "corpus"
SEEDS = CORPUS / "seeds"

#: Checkpoint of a training of two steps (``checkpoint`` of :mod:`hostile_probes`).
CHECKPOINT = CORPUS / "checkpoint.npz"

#: Task → name → keywords of :func:`mi_diffind.fit` for a fit of seconds, one for each layout of its files.
TRIALS = {
    "bsdf": {
        "single": {"source": "bsdf", "steps": 2, "batch": 256, "bytes": "1k"},
        "family": {"source": "bsdf", "steps": 2, "batch": 256, "over": [("alpha", (0.1, 0.5))]},
    },
    "field": {
        "coded": {"source": "views", "steps": 2, "batch": 256, "resolution": 10},
        "grid": {"source": "views", "steps": 2, "batch": 256, "resolution": 10, "preset": "grid"},
        "pairs": {"source": "views", "steps": 2, "batch": 256, "resolution": 10, "preset": "paper"},
    },
    "ggx": {"small": {"steps": 2, "batch": 256, "primary": 4, "cascaded": 3}},
    "image": {
        "indices": {"source": "maps", "steps": 2, "batch": 256, "compression": 2},
        "pages": {"source": "maps", "steps": 2, "batch": 256, "compression": 2, "structure": "pages of 5 bits"},
    },
    "sdf": {
        "sparse": {"source": "mesh", "steps": 2, "batch": 256, "bytes": "12k"},
        "paper": {"source": "mesh", "steps": 2, "batch": 256, "bytes": "4k", "preset": "paper"},
    },
    "texture": {
        "layers": {"source": "maps", "steps": 2, "batch": 256, "compression": 2},
        "pages": {"source": "maps", "steps": 2, "batch": 256, "compression": 2, "structure": "pages"},
        "paper": {"source": "maps", "steps": 2, "batch": 256, "compression": 2, "preset": "paper"},
    },
}

#: Names of all trials, as "ggx/small".
NAMES = [f"{task}/{name}" for task, trials in TRIALS.items() for name in trials]


def has_files(task: Task) -> bool:
    """Return whether a task has table files of its own: it reads them, or a plugin does."""
    return task.plugin is not None or task._implementation("load", task.files) is not None


def seeds(task: Task) -> dict[str, Path]:
    """Return the small files of a task by name: those of its trials, and those that ship."""
    trials = {f"{task.name}_{name}": SEEDS / f"{task.name}_{name}.npz" for name in TRIALS.get(task.name, ())}
    return {**trials, **{f"{task.name}_shipped_{name}": DATA / file for name, file in task.shipped.items()}}


def all_seeds() -> dict[str, Path]:
    """Return the small files of all tasks."""
    return {name: path for task in tasks().values() if has_files(task) for name, path in seeds(task).items()}


def sources(folder: Path) -> dict:
    """Return small sources by the names that trials use."""
    import captures
    import solid_meshes

    y, x = np.mgrid[:16, :24] / 16
    colour = np.stack([0.5 + 0.4 * np.sin(5 * x + 3 * y), 0.5 + 0.3 * np.cos(4 * y), x * y / 1.5], axis=-1)
    maps = {"base_color": colour.astype(np.float32), "roughness": (0.3 + 0.2 * np.sin(7 * x)).astype(np.float32)}
    return {
        "maps": lambda: maps,
        "mesh": lambda: solid_meshes.write(folder / "ball.ply", solid_meshes.sphere(8, 0.8)),
        "bsdf": lambda: {"type": "roughplastic", "alpha": 0.2},
        "views": lambda: captures.write(folder / "views", 8, 2, 16),
    }


def make(task: Task, name: str, folder: Path, output: Path) -> Path:
    """Carry out a trial of a task and write its file."""
    import mi_diffind

    options = dict(TRIALS[task.name][name])
    source = options.pop("source", None)
    source = sources(folder)[source]() if source else None
    with contextlib.redirect_stdout(None):
        fitted = mi_diffind.fit(task.name, source, variant="llvm_ad_rgb", progress=False, **options)
    for key in [key for key in fitted.table.settings if key.endswith("_path")]:
        del fitted.table.settings[key]  # a folder of this machine
    return fitted.save(output)


if __name__ == "__main__":
    for trial in sys.argv[1:] or NAMES:
        task, name = trial.split("/")
        with tempfile.TemporaryDirectory() as folder:
            print(make(tasks()[task], name, Path(folder), SEEDS / f"{task}_{name}.npz"))
