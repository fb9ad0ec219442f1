"""Equal-memory comparison: each method is trained once per memory budget; trainings by presets of ``fit``."""

from collections.abc import Iterable, Sequence

import mitsuba as mi

from ..arrays.tables import save_table
from ..fitting import task
from ..measure.training import Contender


def combinations(methods: Iterable[str], budgets: Sequence, first_only: Iterable[str]) -> list[tuple]:
    """Return the pairs ``(method, budget)`` to train; those in ``first_only`` are trained at the first budget only."""
    return [(m, budget) for budget in budgets for m in methods if budget == budgets[0] or m not in first_only]


def open_preset(job: Contender, task_name: str) -> task.Model:
    """Return the task's model of the table file of a contender."""
    return task.tasks()[task_name].open(mi.TensorXf, str(job.file))


def fit_preset(
    job: Contender, progress: bool, task_name: str, part: str, preset: str, arguments: dict
) -> tuple[task.Model, task.Fitted] | None:
    """Train a contender by a task's preset (``""``: the default), as ``mi-diffind fit`` does; ``None`` after Ctrl-C.

    ``arguments`` are those of :func:`mi_diffind.fitting.task.fit`; the model of the contender is the attribute ``part``
    of the task's model. Returns the task's model and the result of the fit.
    """
    if not job.file:
        raise ValueError("presets are measured from their files: give a folder for them")
    fitted = task.fit(
        task_name, preset=preset, variant=mi.variant(), progress=progress, output=job.file, deterministic=False,
        **arguments,
    )  # fmt: skip
    if fitted.result.interrupted:
        return None
    save_table(job.file, fitted.table)
    model = open_preset(job, task_name)
    job.model = getattr(model, part)
    return model, fitted
