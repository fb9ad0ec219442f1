"""
Task 2: the Disney BRDF (Burley 2012), exact and as tables.

- :mod:`.model`: the reference model and what both forms share: parameters, factors, how factors make a colour;
- :mod:`.effects`: which parts of the model a material makes use of;
- :mod:`.decoder`: the model in two steps, per material and per direction; what tables can replace;
- :mod:`.arrays`, :mod:`.paper`, :mod:`.factored`: the tables, in the paper's layout and in a better one;
- :mod:`.library`: table files;
- :mod:`.sampling`: importance sampling, and the density that goes with it;
- :mod:`.training`: training distributions, errors.
"""

from __future__ import annotations

from ...settings import FitSettings
from ...task import FitRequest, Task


class Disney(Task):
    """The task. Its presets are layouts: ``tables``, one coordinate a table; ``paper``, the paper's Table 1."""

    name = "disney"
    title = "the Disney BRDF"
    files = "library"
    section = "supplemental 1.2"
    #: Tables of one coordinate start close to their optimum: a large rate would only shake them (75 instead of 90 dB).
    presets = {  # noqa: RUF012
        "tables": FitSettings(steps=2000, batch=65536, lr=3e-4, schedule="cosine", seed=1),
        "paper": FitSettings(steps=2000, batch=65536, lr=3e-3, schedule="cosine", seed=1),
    }
    shipped = {"tables": "disney_tables.npz", "paper": "disney_paper.npz"}  # noqa: RUF012

    def problem(self, request: FitRequest):
        from .library import LAYOUTS
        from .training import DisneyProblem

        layout, decoder = LAYOUTS[request.preset]
        return DisneyProblem(layout().alloc(request.types.TensorXf), decoder, request.types)

    def table(self, problem, request: FitRequest):
        return problem.net.to_table()


TASK = Disney()
