"""
The clock, the same for all studies: seconds of kernels, as Dr.Jit's own clock has them, on a machine that is described.

Tracing, code generation and compilation are left out of a time of kernels; what was compiled on the way is said. No
derivatives are asked for.
"""

from __future__ import annotations

import contextlib
import platform
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import drjit as dr

from .. import compat

#: A function whose result, any tree of arrays, is evaluated to measure it.
Query = Callable[[], object]


@dataclass(frozen=True)
class Timed:
    """
    What a function returned, evaluated; ``seconds`` that its kernels took, and ``seconds_wall`` from beginning to end;
    whether any kernel was ``compiled``, or read from the cache on disk.
    """

    value: object
    seconds: float
    seconds_wall: float
    compiled: bool


def timed(function: Query) -> Timed:
    """Time ``function()`` and the evaluation of its result."""
    with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        start = time.perf_counter()
        value = function()
        dr.eval(value)
        dr.sync_thread()
        wall = time.perf_counter() - start
        history = dr.kernel_history()
    return Timed(value, compat.kernel_seconds(history), wall, compat.was_compiled(history))


def kernel_seconds(function: Query) -> float:
    """Seconds that the kernels take which ``function()`` and the evaluation of its result launch."""
    return timed(function).seconds


def total(values) -> tuple[object, int]:
    """
    The sum of all numbers in a tree of arrays, and how many additions it is: little output, and the same for all.
    """
    leaves = list(_leaves(values))
    result = leaves[0]
    for leaf in leaves[1:]:
        result = result + leaf
    return result, len(leaves) - 1


def _leaves(values):
    if isinstance(values, (list, tuple)) or dr.depth_v(values) > 1:
        for value in values:
            yield from _leaves(value)
    else:
        yield values if dr.is_float_v(values) else dr.float32_array_t(type(values))(values)


def machine(variant: str) -> dict:
    """The machine and the versions that figures are quoted with."""
    gpu = None
    for path in Path("/proc/driver/nvidia/gpus").glob("*/information"):
        gpu = _line(path, r"^Model:\s*(.+)$") or gpu
    return {
        "cpu": _line(Path("/proc/cpuinfo"), r"^model name\s*:\s*(.+)$") or platform.processor() or platform.machine(),
        "instructions": _target() if variant.startswith("llvm") else None,
        "cores": dr.thread_count(),
        "gpu": gpu,
        "variant": variant,
        "llvm": ".".join(map(str, compat.llvm_version())) if variant.startswith("llvm") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("mitsuba", "drjit", "numpy", "mi-diffind")},
    }


def _line(path: Path, pattern: str) -> str | None:
    with contextlib.suppress(OSError):
        found = re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
        return found[1].strip() if found else None
    return None


def _target() -> str | None:
    """The processor that Dr.Jit compiles for on the CPU, as LLVM calls it, and its vector width."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(dr.arange(dr.llvm.Float, 64) + 0.5)
        code = "".join(map(compat.kernel_code, dr.kernel_history([dr.KernelType.JIT])))
    found = compat.llvm_target(code)
    return f"{found[0]}, {found[1]} lanes a vector" if found else None
