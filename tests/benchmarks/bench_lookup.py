"""
What a table read costs in each storage form, and a training step: run it, it only measures.

    python tests/benchmarks/bench_lookup.py [--json FILE] [--quick] [--variant VARIANT]

Every kernel loads its coordinates from memory, reads the table, and adds up all channels into one number per block of
lanes, so that what it writes is little and the same for all. The *floor* is the same kernel without the read: the sum
of the coordinates. Forms are measured in turn, not one after the other, so that a change of clock or of load hits all
of them alike; given are medians, the spread is half the distance between the quartiles.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from pathlib import Path

import drjit as dr
import numpy as np

from mi_diffind import DifferentiableArray
from mi_diffind.arrays.lookup import STORAGES
from mi_diffind.core import compat
from mi_diffind.core.runtime import array_module

CASES = {
    "2D, 4 channels, 256²": ((256, 256), 4),
    "2D, 4 channels, 16²": ((16, 16), 4),
    "3D, 3 channels, 32³": ((32, 32, 32), 3),
    "4D, 3 channels, 16⁴": ((16, 16, 16, 16), 3),
    "4D, 4 channels, 16⁴": ((16, 16, 16, 16), 4),
}
BAR = 0.7


def coordinates(ad, dims: int, count: int, coherent: bool):
    """Uniform coordinates in random order, or those of a smooth walk: neighbours in the same cell or the next."""
    # Computed by Dr.Jit: memory that comes from NumPy is aligned by chance, and kernels differ with that.
    rng = dr.rng(seed=0)
    if coherent:
        t = dr.linspace(ad.Float, 0, 1, count)
        result = [0.5 + 0.5 * dr.sin(dr.two_pi * (7 * k + 3) * t + k) for k in range(dims)]
    else:
        result = [rng.random(ad.Float, count) for _ in range(dims)]
    dr.make_opaque(result)
    return result


def timed(function) -> float:
    dr.sync_thread()
    start = time.perf_counter()
    function()
    dr.sync_thread()
    return time.perf_counter() - start


def interleaved(functions: dict, repetitions: int) -> dict[str, list[float]]:
    """Seconds of each function, one repetition of all before the next of any."""
    for function in functions.values():  # compile
        function()
        function()
    times = {name: [] for name in functions}
    order = list(functions)
    for k in range(repetitions):
        for name in order if k % 2 == 0 else reversed(order):
            times[name].append(timed(functions[name]))
    return times


def summary(seconds, count: int) -> dict[str, float]:
    """Median and half the interquartile range, in ns per read."""
    ns = np.asarray(seconds) * 1e9 / count
    low, median, high = np.percentile(ns, [25, 50, 75])
    return {"ns": float(median), "spread": float((high - low) / 2)}


def total(values):
    """Add up all channels of blocks of 1024 lanes: a small output, the same for every form."""
    dr.eval(dr.block_sum(sum(values[1:], values[0]), 1024))


def measure_reads(ad, count: int, repetitions: int) -> list[dict]:
    rows = []
    for name, (resolution, channels) in CASES.items():
        rng = np.random.default_rng(1)
        entries = rng.random((*resolution, channels)).astype(np.float32)
        arrays = {s: DifferentiableArray.from_numpy(entries, ad.TensorXf, storage=s) for s in STORAGES}
        for coherent in (False, True):
            x = coordinates(ad, len(resolution), count, coherent)
            functions = {s: lambda a=a, x=x: total(a(x)) for s, a in arrays.items()}
            functions["floor"] = lambda x=x: total(x)
            times = interleaved(functions, repetitions)
            row = {"case": name, "coordinates": "coherent" if coherent else "random"}
            row |= {form: summary(t, count) for form, t in times.items()}
            # Ratios of neighbours in time: what disturbs one repetition disturbs both of its numbers.
            ratios = np.asarray(times["uint8"]) / np.asarray(times["float32"])
            floor = row["floor"]["ns"]
            row["ratio"] = float(np.median(ratios))
            row["ratio_spread"] = float(np.subtract(*np.percentile(ratios, [75, 25])) / 2)
            row["ratio_without_floor"] = (row["uint8"]["ns"] - floor) / max(row["float32"]["ns"] - floor, 1e-9)
            rows.append(row)
    return rows


def measure_training(ad, count: int, repetitions: int) -> list[dict]:
    """Forward and backward with respect to the table, and also to the coordinate."""
    rows = []
    for name, (resolution, channels) in CASES.items():
        rng = np.random.default_rng(2)
        entries = rng.random((*resolution, channels)).astype(np.float32)
        array = DifferentiableArray.from_numpy(entries, ad.TensorXf)
        x = coordinates(ad, len(resolution), count, coherent=False)

        def step(with_coordinate, array=array, x=x):
            point = [dr.detach(v) for v in x]
            array.data = dr.detach(array.data)
            dr.enable_grad(array.data)
            if with_coordinate:
                dr.enable_grad(point)
            values = array(point)
            loss = dr.sum(sum(dr.square(v - 0.5) for v in values))
            dr.backward(loss)
            gradients = [dr.sum(v.grad) for v in point] if with_coordinate else []
            dr.eval(array.data.grad, loss, gradients)

        def forward(array=array, x=x):
            dr.eval(dr.sum(sum(dr.square(v - 0.5) for v in array(x))))

        functions = {
            "forward": forward,
            "table": lambda step=step: step(False),
            "table and coordinate": lambda step=step: step(True),
        }
        times = interleaved(functions, repetitions)
        rows.append({"case": name} | {form: summary(t, count) for form, t in times.items()})
    return rows


def show(cell: dict) -> str:
    return f"{cell['ns']:6.2f} ±{cell['spread']:5.2f}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="also write the numbers to this file")
    parser.add_argument("--quick", action="store_true", help="fewer reads and repetitions: less exact")
    parser.add_argument("--variant", help="its backend counts (default: the GPU if there is one)")
    options = parser.parse_args()

    ad = array_module(options.variant)
    count, repetitions = (2**20, 5) if options.quick else (2**22, 15)
    llvm = ".".join(map(str, compat.llvm_version())) if ad.__name__.startswith("drjit.llvm") else None
    machine = {
        "backend": ad.__name__, "llvm": llvm, "threads": dr.thread_count(), "drjit": dr.__version__,
        "machine": platform.machine(), "reads": count, "repetitions": repetitions,
    }  # fmt: skip
    print(f"{ad.__name__}, LLVM {llvm}, {dr.thread_count()} threads, {count:,} reads, {repetitions} repetitions\n")

    reads = measure_reads(ad, count, repetitions)
    print("ns per read, forward (median ± half the interquartile range; the floor is input and output alone)")
    print(f"{'case':22}{'coordinates':13}{'float32':>15}{'float16':>15}{'packed':>15}{'floor':>15}   packed/float32")
    for row in reads:
        forms = "".join(f"{show(row[form]):>15}" for form in ("float32", "float16", "uint8", "floor"))
        ratio = f"{row['ratio']:.2f} ±{row['ratio_spread']:.2f} ({row['ratio_without_floor']:.2f} without the floor)"
        print(f"{row['case']:22}{row['coordinates']:13}{forms}   {ratio}")
    for key, what in (("ratio_without_floor", "without the floor"), ("ratio", "with the floor")):
        missed = [row for row in reads if row[key] > BAR]
        names = "; ".join(f"{row['case']} {row['coordinates']}: {row[key]:.2f}" for row in missed)
        verdict = (
            f"does NOT hold for {len(missed)} of {len(reads)}: {names}" if missed else f"holds for all {len(reads)}."
        )
        print(f"\nThe bar, packed ≤ {BAR} × float32, {what}: {verdict}")

    training = measure_training(ad, count // 4, max(5, repetitions // 2))
    print("\nns per sample of a training step (float32, random coordinates)")
    print(f"{'case':35}{'forward':>15}{'+ to the table':>18}{'+ to the coordinate':>22}")
    for row in training:
        cells = (show(row["forward"]), show(row["table"]), show(row["table and coordinate"]))
        print(f"{row['case']:35}{cells[0]:>15}{cells[1]:>18}{cells[2]:>22}")

    if options.json:
        content = {
            "machine": machine,
            "bar": BAR,
            "bar_holds": all(row["ratio_without_floor"] <= BAR for row in reads),
            "reads": reads,
            "training": training,
        }
        Path(options.json).write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
