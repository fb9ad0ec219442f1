"""Layouts of ``bench_ratio.py``, the sweep of ρ = N_p / N_c at equal bytes, and the options ``--ratio`` of presets."""

import dataclasses
import importlib.util
import math
import sys
from pathlib import Path

import drjit.llvm.ad as T
import numpy as np
import pytest
import trimesh

from mi_diffind.core.errors import UsageError
from mi_diffind.fitting.task import FitRequest, FitSettings, tasks
from mi_diffind.tasks.image import arrays as image_budget
from mi_diffind.tasks.radiance import dense_bytes
from mi_diffind.tasks.radiance import fit as field_fit
from mi_diffind.tasks.texture import arrays as texture_budget

PATH = Path(__file__).resolve().parent / "benchmarks" / "bench_ratio.py"


@pytest.fixture(scope="module")
def bench():
    """The benchmark as a module."""
    sys.path.insert(0, str(PATH.parent))
    spec = importlib.util.spec_from_file_location("bench_ratio", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules["bench_ratio"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def checked(layouts, nbytes: float, tolerance: float = 0.05) -> None:
    """Assert that layouts have equal bytes, different ratios, and one default of each part."""
    assert len(layouts) >= 3
    for layout in layouts:
        assert layout.nbytes == pytest.approx(nbytes, rel=tolerance), layout
    for part in {layout.part for layout in layouts}:
        of_part = [layout for layout in layouts if layout.part == part]
        assert sum(layout.default for layout in of_part) == 1
        assert len({layout.ratio for layout in of_part}) == len(of_part) >= 3


@pytest.mark.parametrize("task", ["image", "texture"])
def test_sides_of_images_and_textures_are_those_of_the_supplements_search(bench, task):
    for budget in bench.BUDGETS[task]:
        layouts = bench.planar_layouts(task, budget)
        checked(layouts, bench.SIDE**2 * bench.CHANNELS / budget)
        for layout in layouts:
            assert layout.primary % 8 == 0 and layout.cascaded % 4 == 0
            # The preset takes the very layout, given its ratio and bytes
            side, uncompressed = bench.SIDE, bench.SIDE**2 * bench.CHANNELS
            if task == "image":
                compression = uncompressed / layout.nbytes
                size = image_budget.search(uncompressed, compression, bench.CHANNELS, side, side, ratio=layout.ratio)
            else:
                size = texture_budget.paper_size(layout.nbytes, uncompressed, 3, side, side, layout.ratio)
            assert (size.rows, size.columns, size.cascaded) == (layout.primary, layout.primary, layout.cascaded)
            assert size.nbytes == layout.nbytes


def test_distance_fields_have_equal_bytes(bench):
    extent = np.ptp(trimesh.load_mesh(PATH.parents[2] / "scenes" / "assets" / "suzanne.ply").vertices, axis=0)
    for budget in bench.BUDGETS["sdf"]:
        layouts = bench.sdf_layouts(budget, extent)
        checked(layouts, budget, 0.07)
        for layout in layouts:
            assert layout.primary / layout.cascaded == pytest.approx(layout.ratio, rel=0.05)


def test_radiance_fields_have_equal_bytes(bench):
    shape = (73, 53, 64)
    for budget in bench.BUDGETS["field"]:
        layouts = bench.field_layouts(budget, shape, np.array(shape) - 1.0)
        checked(layouts, dense_bytes(shape) / budget)
        assert {layout.part for layout in layouts} == {"density", "colour"}


def test_identities_differ(bench):
    layouts = [x for task in ("image", "texture") for b in bench.BUDGETS[task] for x in bench.planar_layouts(task, b)]
    layouts += bench.our_layouts(12)
    keys = {(layout.key, layout.cascaded) for layout in layouts}
    assert len(keys) == len(layouts)
    assert all(math.isnan(layout.primary) == (layout.preset == "ours") for layout in layouts)


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
