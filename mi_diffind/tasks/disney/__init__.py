"""Task 2: the Disney BRDF (Burley 2012), exact and as tables.

- :mod:`.model`: the reference model, parameters, factors and colours, and the parts that a material uses;
- :mod:`.decoder`: the model in two steps, per material and per direction, with methods that tables can replace;
- :mod:`.arrays`, :mod:`.factored`, :mod:`.paper_variants`: the tables, their base class and both layouts;
- :mod:`.sampling`: importance sampling and its density;
- :mod:`.training`: training distributions, errors, and table files.
"""

from ...fitting.task import FitRequest, FitSettings, Task


class DisneyTask(Task):
    """The task. Its presets are layouts: ``tables``, one coordinate per table; ``paper``, the paper's Table 1."""

    name = "disney"
    title = "the Disney BRDF"
    section = "supplemental 1.2"
    plugin = ("bsdf", "neural_disney")
    #: Tables of one coordinate start close to their optimum: ten times the rate costs 15 dB (75 in place of 90 dB).
    presets = {  # noqa: RUF012
        "tables": FitSettings(steps=2000, batch=65536, lr=3e-4, schedule="cosine", seed=1),
        "paper": FitSettings(steps=2000, batch=65536, lr=3e-3, schedule="cosine", seed=1),
    }
    files = "training"
    shipped = {"tables": "disney_tables.npz", "paper": "disney_paper.npz"}  # noqa: RUF012

    def problem(self, request: FitRequest):
        from .training import LAYOUTS, DisneyProblem

        layout, decoder = LAYOUTS[request.preset]
        return DisneyProblem(layout().alloc(request.types.TensorXf), decoder, request.types)

    def table(self, problem, request: FitRequest):
        return problem.net.to_table()


TASK = DisneyTask()
