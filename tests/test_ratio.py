"""The options ``--ratio`` of presets, which set ρ = N_p / N_c."""

import dataclasses

import drjit.llvm.ad as T
import pytest

from mi_diffind.core.errors import UsageError
from mi_diffind.fitting.task import FitRequest, FitSettings, tasks
from mi_diffind.tasks.radiance import fit as field_fit


def request(task: str, preset: str, **options) -> FitRequest:
    """Return a request with a source that is not read."""
    given = {argument.name: argument.default for argument in tasks()[task].arguments}
    return FitRequest(preset, FitSettings(steps=2, batch=16), T, options={**given, "source": "none", **options})


@pytest.mark.parametrize(
    "task, preset, options, message",
    [
        ("image", "ours", {"ratio": 40.0}, "--ratio: for the preset paper with one primary array"),
        ("image", "paper", {"ratio": 40.0, "structure": "2 + 6 bits"}, "--ratio: for the preset paper with one"),
        ("image", "paper", {"ratio": 40.0, "cascaded": 8}, "leave out --ratio-search, --psnr and --cascaded"),
        ("texture", "ours", {"ratio": 40.0}, "--ratio: found the preset ours, allowed is paper"),
        ("field", "sparse", {"density_ratio": 2.0}, "--density-ratio: found the preset sparse, allowed is paper"),
        ("field", "grid", {"colour_ratio": 2.0}, "--colour-ratio: found the preset grid, allowed is paper"),
    ],
)
def test_presets_without_a_ratio_refuse_it(task, preset, options, message):
    with pytest.raises(UsageError, match=message):
        tasks()[task].check(request(task, preset, **options))


def test_ratios_have_a_range():
    for task, name, most in (("image", "ratio", 1024), ("texture", "ratio", 1024), ("field", "colour_ratio", 16)):
        (argument,) = [a for a in tasks()[task].arguments if a.name == name]
        assert argument.parsed(most) == most
        for wrong in (0.5, most + 1):
            with pytest.raises(UsageError, match=f"{name}: .*allowed are numbers from 1 to {most}"):
                argument.parsed(wrong)


def test_a_ratio_changes_the_arrays_of_a_radiance_field(monkeypatch):
    shapes = {}
    monkeypatch.setattr(field_fit.paper, "dense", lambda grid: None)

    def stop(values, given, types):
        shapes.update(given)
        raise StopIteration

    monkeypatch.setattr(field_fit.paper, "initial", stop)
    nodes = type("Nodes", (), {"shape": (60, 60, 60), "lower": (0, 0, 0), "upper": (1, 1, 1)})
    grid = type("Grid", (), {"nodes": nodes})
    for ratio in (2.0, 6.0):
        fit = field_fit.FieldFit(request("field", "paper", colour_ratio=ratio), None)
        with pytest.raises(StopIteration):
            fit.pairs_problem(grid, 200_000, 1)
        primary, cascaded = (sides[0] for sides in shapes["colour"])
        assert primary / cascaded == pytest.approx(ratio, rel=0.1)
    assert dataclasses.is_dataclass(fit)
