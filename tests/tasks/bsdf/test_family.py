"""Families of learned BSDFs: parameters, their formula, sources, files, and a training."""

import dataclasses

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of

import mi_diffind
from mi_diffind.arrays.tables import TableError
from mi_diffind.commands import cli
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import TASK, energy, evaluation, mixture, training
from mi_diffind.tasks.bsdf import fit as fitting
from mi_diffind.tasks.bsdf.model import Parameter, points
from mi_diffind.tasks.bsdf.truth import FamilyTruth, truth_of


@pytest.fixture
def types(mi_rgb):
    return array_module()


def test_coordinates(types):
    """Wide ranges of positive numbers are logarithmic; numbers outside and NaN count as the ends."""
    values = types.Float(aligned(np.float32([0.05, 0.2, 0.8, 3, -1, np.inf, np.nan])))
    rough, metal = Parameter("roughness", 0.05, 0.8), Parameter("metallic", -1.0, 3.0)
    np.testing.assert_allclose(rough.coordinate(values), [0, 0.5, 1, 1, 0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(metal.coordinate(values), [0.2625, 0.3, 0.45, 1, 0, 1, 0], atol=1e-6)
    assert rough.middle == pytest.approx(0.2) and metal.middle == 1


REFUSED = {
    "unknown": ({"rough": (0, 1)}, 'found "rough", the parameters of principled are .*roughness'),
    "order": ({"roughness": (1, 0)}, r"found roughness = \(1, 0\), a pair of finite numbers \(low, high\) is needed"),
    "number": ({"roughness": 3}, "found roughness = 3, a pair"),
    "twice": ({"roughness": (0, 1), "roughness.value": (0, 1)}, "which name a parameter twice"),
    "four": (dict.fromkeys("abcd", (0, 1)), "found 4 parameters, allowed are 1 to 3"),
    "idle": ({"sheen_tint": (0, 1)}, "sheen_tint changes nothing of principled, which may need it in the source, too"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_parameters_that_are_refused(mi_rgb, case):
    over, message = REFUSED[case]
    with pytest.raises(UsageError, match=message):
        mi_diffind.fit("bsdf", {"type": "principled"}, over=over, progress=False)


def test_the_command_line_names_ranges(capsys):
    with pytest.raises(SystemExit):
        cli.main(["fit", "bsdf", "a.xml", "--over", "roughness=1", "-o", "a.npz"])
    assert "found 'roughness=1', expected NAME=LOW:HIGH" in capsys.readouterr().err


def test_a_family_of_conductors_is_fitted(types, monkeypatch, tmp_path):
    """A file stands for all roughnesses of its range, and the source is left as it was."""
    for module, name, value in (
        (training, "SAMPLES", 2**15), (training, "VALIDATION", 2**13), (training, "MEMBERS", 16),
        (fitting, "VIEWS", 2), (evaluation, "MEMBERS", 3), (training, "STARTS", 1),
        (energy, "BETWEEN", 1), (energy, "MEMBER_SAMPLES", 512),
        (mixture, "MEMBER_SAMPLES", 256), (mixture, "FACTORS", (0.7, 1.0)),
        (training, "PROXY", dataclasses.replace(training.PROXY, steps=60, batch=2**11)),
        (training, "FAMILY_PROXY", dataclasses.replace(training.FAMILY_PROXY, steps=150, batch=2**11)),
    ):  # fmt: skip
        monkeypatch.setattr(module, name, value)
    import mitsuba as mi

    source = mi.load_dict({"type": "roughconductor", "material": "Cu", "alpha": 0.2, "distribution": "ggx"})
    over = {"alpha": (0.1, 0.4)}
    fitted = mi_diffind.fit("bsdf", source, over=over, steps=100, batch=2**12, measure_every=50, progress=False)
    measured = fitted.table.measured
    assert measured["psnr_minimum_db"] > 45 and measured["psnr_db"] >= measured["psnr_minimum_db"]
    assert measured["albedo_excess"] < 5e-3 and measured["sample_weight_moment"] < 1.2
    assert float(mi.traverse(source)["alpha.value"][0]) == pytest.approx(0.2)
    assert '<float name="alpha" value="0.1"/>  <!-- or a texture, 0.1 to 0.4 -->' in "\n".join(fitted.summary())
    with pytest.raises(TableError, match="was fitted to an object in memory"):
        mi_diffind.open(fitted.save(tmp_path / "a.npz")).measure()
    saved = TASK.load(tmp_path / "a.npz")
    assert saved.nbytes < 6000 and saved.settings["family"] == [{"name": "alpha", "low": 0.1, "high": 0.4}]


def test_members_are_sampled_evenly():
    """Coordinates of members fill the square, and reach its ends."""
    x = points(64, 2, 3)
    counts, _, _ = np.histogram2d(*x.T, bins=4)
    assert counts.min() >= 2 and x.min() == 0 and x.max() == 1


def test_samples_are_those_of_their_members(types):
    """Each sample has the value of the source at its own parameters."""
    truth = FamilyTruth(
        truth_of({"type": "roughconductor", "alpha": 0.2}, types), {"alpha": (0.05, 0.8)}
    )  # fmt: skip
    samples = training.draw_members(truth, types, 2**10, 4, 2, True)
    x = samples.coordinates[0].numpy()
    for coordinate in np.unique(x):
        lanes = types.UInt32(np.flatnonzero(x == coordinate).astype(np.uint32))
        s = samples.at(lanes)
        expected = truth.at([coordinate]).value(s.wi, s.wo)
        np.testing.assert_allclose(numpy_of(s.value), numpy_of(expected), rtol=1e-4)
    assert len(np.unique(x)) == 4 and dr.width(samples.weight) == 2**10
