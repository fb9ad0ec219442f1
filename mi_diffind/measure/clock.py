"""Clock of all studies: seconds of kernels by Dr.Jit's own measurement, and a description of the machine.

A time of kernels does not include tracing, code generation and compilation. No derivatives are computed.
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

from ..core import compat

#: Function to measure: its result, any tree of arrays, is evaluated.
Query = Callable[[], object]


@dataclass(frozen=True)
class Timed:
    """Result and times of a function.

    ``value``: its evaluated result; ``seconds`` of its kernels, ``seconds_wall`` from beginning to end; ``compiled``:
    whether a kernel was compiled or read from the cache on disk.
    """

    value: object
    seconds: float
    seconds_wall: float
    compiled: bool


def timed(function: Query) -> Timed:
    """Call ``function()``, evaluate its result and measure the time."""
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


def total(values) -> tuple[object, int]:
    """Return the sum of all numbers in a tree of arrays, a small output of equal size for all, and its additions."""
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
    """Return the machine and the versions that figures are quoted with."""
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
        match = re.search(pattern, path.read_text(encoding="utf-8"), re.MULTILINE)
        return match[1].strip() if match else None
    return None


def _target() -> str | None:
    """Return LLVM's name of the processor that Dr.Jit compiles for, and the vector width."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(dr.arange(dr.llvm.Float, 64) + 0.5)
        code = "".join(map(compat.kernel_code, dr.kernel_history([dr.KernelType.JIT])))
    target = compat.llvm_target(code)
    return f"{target[0]}, {target[1]} lanes a vector" if target else None
