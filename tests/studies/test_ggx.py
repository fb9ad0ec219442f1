"""The study of the GGX distribution: its networks, its candidates, and what it concludes."""

import copy
import csv
import os

import drjit as dr
import numpy as np
import pytest
from study_runs import quick_result
from variants import BACKENDS, VARIANTS

from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import FitSettings, fit
from mi_diffind.studies.baselines.networks import Network
from mi_diffind.studies.ggx import conclusions
from mi_diffind.studies.ggx import plan as plans
from mi_diffind.tasks.ggx.model import Encoding
from mi_diffind.tasks.ggx.training import GGXProblem

HASH_GRID = {**plans.HASH_GRID, "hashmap_size": 64}


@pytest.fixture
def ad():
    return array_module(BACKENDS[0])


def coordinates(ad, rng, n=500):
    x = rng.random((2, n)).astype(np.float32)
    return x, [ad.Float(v) for v in x]


# -- networks ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "layers"), [(8, 1), (16, 2)])
def test_network_is_what_numpy_computes(ad, rng, width, layers):
    net = Network(2, width, layers).alloc(ad.TensorXf, 2, dr.rng(seed=2))
    values, x = coordinates(ad, rng)
    weights = [net[k].numpy() for k in net if k.endswith("weights")]
    biases = [net[k].numpy() for k in net if k.endswith("bias")]
    y = values
    for k, (w, b) in enumerate(zip(weights, biases, strict=True)):
        y = w @ y + b[:, None]
        y = np.where(y < 0, 0.01 * y, y) if k < layers else y
    assert len(weights) == layers + 1 and y.shape[0] == 1
    assert net.parameters == sum(v.size for v in (*weights, *biases)) and net.nbytes == 4 * net.parameters
    for form in (net, net.cooperative()):
        (found,) = form(x)
        assert np.allclose(found.numpy(), y[0], atol=1e-5)


@pytest.mark.parametrize("options", [{"grid": HASH_GRID}, {"table": 8}, {"grid": HASH_GRID, "table": 8}])
def test_both_forms_agree(ad, rng, options):
    net = Network(2, 8, 1, **options).alloc(ad.TensorXf, 2, dr.rng(seed=2))
    if "table" in options:
        net.table.data = ad.TensorXf(rng.random((8, 8, 1)).astype(np.float32))
    _, x = coordinates(ad, rng)
    found = [form(x)[0].numpy() for form in (net, net.cooperative())]
    assert np.allclose(found[0], found[1], atol=1e-5) and np.ptp(found[0]) > 0


def test_all_parameters_are_trained(ad):
    """A hash grid keeps its entries to itself, so that an optimiser would not see them."""
    net = Network(2, 8, 1, HASH_GRID, table=8).alloc(ad.TensorXf, 2, dr.rng(seed=2))
    problem = GGXProblem(net, ad, "tables", Encoding())
    before = {key: net[key].numpy().copy() for key in net}
    assert {"entries", "table.data", "mlp.layers.0.weights", "mlp.layers.0.bias"} <= set(before)
    fit(problem, FitSettings(steps=20, batch=4096, lr=1e-2, measure_every=20), progress=False)
    for key, values in before.items():
        assert not np.array_equal(net[key].numpy(), values), key


def test_operations_of_products(ad):
    net = Network(2, 16, 2).alloc(ad.TensorXf, 2)
    n = net.products()
    assert n.add == n.mul == 2 * 16 + 16 * 16 + 16 and n.bytes_gathered == 4 * net.parameters


# -- the study --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Folder and result of a smoke run, of few steps."""
    import mitsuba as mi

    mi.set_variant(VARIANTS[0])
    folder = tmp_path_factory.mktemp("ggx") / "out"
    result, _ = quick_result(plans.plan(quick=True, quick_steps=10), folder)
    return folder, result


def test_quick_run_writes_what_it_promises(finished):
    folder, report = finished
    pictures = ["tradeoff_ggx.png", "tradeoff_ggx_training.png"]
    assert sorted(os.listdir(folder)) == sorted(
        [*pictures, "tradeoff_ggx.csv", "tradeoff_ggx.json", "tradeoff_ggx_models"]
    )
    assert all((folder / name).stat().st_size > 50_000 for name in pictures)
    with open(folder / "tradeoff_ggx.csv", encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert {row["case"] for row in table} == set(report["cases"])
    for row in table:
        assert float(row["time_with_floor"]) > 0
        if row["candidate"] not in ("formula", "roughconductor"):
            assert float(row["psnr_db"]) > 0 and float(row["bytes"]) > 0
            assert {f"peak_error_{band}" for band in ("0.001_0.01", "0.5_1")} <= set(row)
    trained = {row["candidate"]: row for row in table if row["converged"]}
    assert all(float(row["training_seconds"]) > 0 for row in trained.values())
    assert report["jobs"] and all(record["runs"] for record in report["jobs"].values())


def test_candidates_are_what_they_are_called(finished):
    _, report = finished
    c, plain = report["candidates"], report["cases"][conclusions.PLAIN]["queries"]["read"]
    assert c["16→8"]["bytes"] == c["24²"]["bytes"] == 4 * conclusions.ENTRIES == 2304  # equal bytes
    for name in ("16→8", "24²", "16→8, log"):
        label, mark = name.split(",")[0], ", log" * ("log" in name)
        assert c[name]["bytes"] == 2 * c[f"{label} f16{mark}"]["bytes"] == 4 * c[f"{label} u8{mark}"]["bytes"]
    # Reads: four corners in each of two arrays; all four in one word of bytes a channel
    assert plain["16→8"]["operations"]["gathers"] == 8 and plain["16→8"]["operations"]["bytes_gathered"] == 48
    assert plain["16→8 u8"]["operations"]["gathers"] == 3 and plain["24² u8"]["operations"]["gathers"] == 1
    assert plain["24²"]["operations"]["gathers"] == 4 and plain["formula"]["operations"]["gathers"] == 0
    network = plain["MLP 8x2"]["operations"]
    assert network == plain["MLP 8x2 tensor"]["operations"]
    assert network["mul"] >= 2 * 8 + 8 * 8 + 8 and network["bytes_gathered"] == c["MLP 8x2"]["bytes"] == 4 * 105
    assert c["MLP 8x2"]["errors"]["psnr_db"] == pytest.approx(c["MLP 8x2 tensor"]["errors"]["psnr_db"], abs=0.01)
    assert plain["formula"]["operations"]["flops"] < 15
    assert c["neural_ggx"]["errors"]["psnr_db"] > 50 and c["formula"]["is_truth"] and c["roughconductor"]["is_truth"]
    assert set(report["cases"]["conductor, constant roughness"]["queries"]) == {"eval", "sample", "pdf"}


def test_of_what_has_not_converged_nothing_is_claimed(finished):
    _, report = finished
    assert not report["candidates"]["16→8"]["converged"]
    assert any("16→8 has not converged: no statement is made" in line for line in report["conclusions"])
    assert not any("wins" in line for line in report["conclusions"])


def equal_quality_lines(report, **changes):
    """The lines about equal quality when candidates had the given accuracies; what is not given has converged."""
    result = copy.deepcopy(report)
    for name, c in result["candidates"].items():
        c["converged"] = True
        psnr = changes.get(name, c["errors"].get("psnr_db"))
        if psnr == "unconverged":
            c["converged"], psnr = False, 60.0
        if "psnr_db" in c["errors"]:
            c["errors"]["psnr_db"] = psnr
    lines = conclusions.conclusions(result, "16→8")
    return {line[2:22].strip(): line for line in lines if line.startswith("  ")}, lines


def test_equal_quality(finished):
    _, report = finished
    lines, everything = equal_quality_lines(
        report, **{"16→8": 40.0, "24²": 38.0, "48²": 45.0, "MLP 8x2": 20.0, "grid + MLP 16": "unconverged"}
    )
    assert "48²" in lines["single table"] and "4.00x" in lines["single table"] and "512x" in lines["single table"]
    assert "does NOT reach it" in lines["network"] and "113.7x, 256x, 4x" in lines["network"]
    assert "no statement" in lines["hash grid + network"]
    assert any("indirection 40.0 dB, single table 38.0 dB: indirection wins by 2.0 dB" in line for line in everything)
    lines, everything = equal_quality_lines(report, **{"16→8": 40.0, "24²": 41.0, "48²": 45.0})
    assert "24²" in lines["single table"] and "1.00x" in lines["single table"]
    assert any("the single table wins by 1.0 dB" in line for line in everything)
    lines, _ = equal_quality_lines(report, **{"16→8": 40.0, "24²": 39.8})  # equal, as far as that can be told
    assert "24²" in lines["single table"] and "NOT" not in lines["single table"]
