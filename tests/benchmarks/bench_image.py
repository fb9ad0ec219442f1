"""
A training step of task 3 in Dr.Jit beside the same step in PyTorch: the same arrays, batch, loss and optimiser.

    pip install torch && python tests/benchmarks/bench_image.py

2²⁰ samples of an image of 3 channels, a primary of 496² × 4 entries, a cascaded array of 12⁴ × 3, MAE, Adam; the steps
alternate, on all cores. PyTorch runs the model as one writes it there: gathers by index, weights, autograd, with
``torch.compile`` where it works. It is needed for this comparison only.
"""

from __future__ import annotations

import argparse
import statistics
import time

import drjit as dr
import numpy as np

import mi_diffind  # noqa: F401
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import FitSettings, _Trainer
from mi_diffind.maps import source
from mi_diffind.tasks.image import PRESETS, replaced, training
from mi_diffind.tasks.image.arrays import ImageBudget

PRIMARY, CASCADED, SAMPLES, SIDE = 496, 12, 2**20, 1024


def drjit_step(image: np.ndarray):
    """A function that makes a step by the paper's recipe, and waits for it."""
    recipe = replaced(PRESETS["paper"], batch=SAMPLES, deterministic=False)
    size = ImageBudget(PRIMARY, PRIMARY, CASCADED, 3)
    problem = training.problem_of(source.from_arrays({"albedo": image}), size, recipe, array_module("llvm"))
    trainer = _Trainer(problem, FitSettings(batch=SAMPLES, lr=1e-3, schedule="constant", loss="mae"))

    def step() -> float:
        loss = trainer.take_step()
        dr.sync_thread()
        return float(loss[0])

    return step


def torch_step(image: np.ndarray, compiled: bool):
    """The same in PyTorch."""
    import torch

    texels = torch.from_numpy(image.astype(np.float32) / 255).reshape(-1, 3)
    grid = torch.arange(PRIMARY, dtype=torch.float32) / (PRIMARY - 1)
    v, u = torch.meshgrid(grid, grid, indexing="ij")
    primary = torch.stack([v, u, v, u], -1).reshape(-1, 4).clone().requires_grad_()
    cascaded = torch.full((CASCADED**4, 3), 0.5).requires_grad_()
    optimizer = torch.optim.Adam([primary, cascaded], lr=1e-3)

    def fold(x):
        t = x - 2 * torch.floor(x * 0.5)
        return torch.where(t < 1, t, torch.clamp(2 - 2**-23 - t, min=0))

    def read(table, coordinates, n):
        lower, weights = [], []
        for x in coordinates:
            position = x.clamp(0, 1) * (n - 1)
            cell = position.detach().long().clamp(max=n - 2)
            lower.append(cell)
            weights.append(position - cell)
        total = 0
        for corner in range(2 ** len(lower)):
            index, weight = 0, 1
            for axis, (cell, w) in enumerate(zip(lower, weights, strict=True)):
                upper = corner >> axis & 1
                index = index * n + cell + upper
                weight = weight * (w if upper else 1 - w)
            total = total + weight[:, None] * table[index]
        return total

    def target(y, x):
        total = 0
        y0, x0 = torch.floor(y - 0.5), torch.floor(x - 0.5)
        for dy in (0, 1):
            for dx in (0, 1):
                row, column = (y0 + dy).long().clamp(0, SIDE - 1), (x0 + dx).long().clamp(0, SIDE - 1)
                weight = (1 - torch.abs(y - 0.5 - (y0 + dy))) * (1 - torch.abs(x - 0.5 - (x0 + dx)))
                total = total + weight[:, None] * texels[row * SIDE + column]
        return total

    def error(y, x):
        pointer = read(fold(primary), [y / SIDE, x / SIDE], PRIMARY)
        return (read(fold(cascaded), pointer.unbind(-1), CASCADED) - target(y, x)).abs().mean()

    error = torch.compile(error) if compiled else error
    index = torch.arange(SAMPLES)

    def step() -> float:
        y = (index // SIDE) % SIDE + torch.rand(SAMPLES)
        x = index % SIDE + torch.rand(SAMPLES)
        optimizer.zero_grad()
        loss = error(y, x)
        loss.backward()
        optimizer.step()
        return float(loss)

    return step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    random = np.random.default_rng(1)
    image = random.integers(0, 255, (SIDE // 8, SIDE // 8, 3)).repeat(8, 0).repeat(8, 1).astype(np.uint8)
    steps = {"Dr.Jit": drjit_step(image)}
    try:
        steps["PyTorch"] = torch_step(image, False)
        compiled = torch_step(image, True)
        compiled()
        steps["PyTorch, compiled"] = compiled
    except Exception as e:
        what = "torch.compile does not work" if "PyTorch" in steps else "PyTorch is not"
        print(f"{what} here ({type(e).__name__}): left out")
    for step in steps.values():
        for _ in range(2):
            step()
    times = {name: [] for name in steps}
    for _ in range(rounds):
        for name, step in steps.items():
            start = time.perf_counter()
            step()
            times[name].append(time.perf_counter() - start)
    for name, values in times.items():
        ratio = statistics.median(b / a for a, b in zip(times["Dr.Jit"], values, strict=True))
        print(f"{name:20}{1e3 * statistics.median(values):>9.1f} ms a step{ratio:>8.1f}x")


if __name__ == "__main__":
    main()
