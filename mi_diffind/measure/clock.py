"""Clock of all studies: seconds of kernels by Dr.Jit's own measurement, operations of kernels, the machine.

A time of kernels does not include tracing, code generation and compilation. No derivatives are computed.

The accounting of operations is that of the paper's supplement (1.2.1): an addition or multiplication is 1 flop, a
division 2, a square root or logarithm 4; a fused multiply-add is an addition and a multiplication. Minima, comparisons,
selections, conversions and integer arithmetic are no flops, but part of ``instructions``. Counts are for one lane and
one pass through the kernel: the body of a loop counts once; of a call with several possible functions, all count.
Inputs, outputs and constants are not counted. The counts are read from LLVM's representation of a kernel, where
logarithms and exponentials are polynomials; those of CUDA's kernels are 0.
"""

from __future__ import annotations

import contextlib
import platform
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path

import drjit as dr

from ..core import compat

#: Function to measure: its result, any tree of arrays, is evaluated.
Query = Callable[[], object]


def timed(function: Query) -> float:
    """Call ``function()``, evaluate its result, and return the seconds of the kernels."""
    with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        dr.eval(function())
        dr.sync_thread()
        return compat.kernel_seconds(dr.kernel_history())


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


#: Flops of an operation in the paper's accounting.
FLOPS = {"add": 1, "mul": 1, "div": 2, "sqrt": 4, "log": 4}


@dataclass(frozen=True)
class Operations:
    """Operations of one lane.

    Floating-point ``add`` (and subtract), ``mul``, ``div`` (and reciprocal), ``sqrt`` (and its reciprocal), ``log``
    (and other transcendental functions that are one instruction); ``gathers``, reads of memory at a computed place (one
    that fetches several neighbours counts once), and ``bytes_gathered`` by them; ``instructions``, all that compute:
    the above with fused multiply-adds once, comparisons, selections, conversions, integer arithmetic, gathers.
    """

    add: int = 0
    mul: int = 0
    div: int = 0
    sqrt: int = 0
    log: int = 0
    gathers: int = 0
    bytes_gathered: int = 0
    instructions: int = 0

    @property
    def flops(self) -> int:
        """Flops in the paper's accounting, :data:`FLOPS`."""
        return sum(weight * getattr(self, name) for name, weight in FLOPS.items())

    def __add__(self, other: Operations) -> Operations:
        return Operations(**{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)})

    def asdict(self) -> dict[str, int]:
        """Return all counts by name, ``flops`` included."""
        return {**asdict(self), "flops": self.flops}


def count(function: Callable[[], object]) -> Operations:
    """Count the operations of evaluating the result of ``function()``, a tree of LLVM or CUDA arrays of Dr.Jit.

    Kernels that the function launches itself are counted, too. Inputs should be evaluated and opaque
    (``dr.make_opaque``): pending computations become part of the count, and literals are folded into the kernel. Clears
    the kernel history.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        dr.eval(function())
        history = dr.kernel_history([dr.KernelType.JIT])
    return sum((count_ir(compat.kernel_code(entry)) for entry in history), Operations())


def count_query(function: Query) -> Operations:
    """Count the operations of a query, without the additions of :func:`.clock.total`."""
    additions = []

    def summed():
        result, added = total(function())
        additions.append(added)
        return result

    with dr.suspend_grad():
        return count(summed) + Operations(add=-additions[0], instructions=-additions[0])


#: Instruction of LLVM, or its function, → the counts that it adds one to.
_LLVM_OPS = {
    "fadd": ("add",), "fsub": ("add",), "fmul": ("mul",), "fdiv": ("div",), "fma": ("add", "mul"),
    "fmuladd": ("add", "mul"), "sqrt": ("sqrt",),
    **dict.fromkeys(("exp", "exp2", "log", "log2", "pow", "sin", "cos", "tanh"), ("log",)),
}  # fmt: skip

#: Instructions that are neither arithmetic nor a gather: constants, addresses, input and output, flow of control.
_LLVM_IGNORED = {
    *("insertelement", "insertvalue", "extractelement", "extractvalue", "shufflevector", "bitcast"),
    *("getelementptr", "inttoptr", "ptrtoint", "alloca", "load", "phi"),
}

#: Instructions of the lane's number, of the mask of existing lanes, and of addresses of packets, which do not count.
_LLVM_LANES = re.compile(r"add <\d+ x i32> %r\d+_2, <|icmp ult <\d+ x i32> %r\d+, %p\d+_2$|select .* x ptr>")

_BYTES = {"float": 4, "half": 2, "double": 8}


def count_ir(text: str) -> Operations:
    """Count the operations of one kernel in LLVM's intermediate representation."""
    counts, counted = Counter(), False
    for line in text.splitlines():
        if line.startswith("define"):
            # Kernels and the functions that they call; helpers of Dr.Jit (packet gathers) count at their call
            counted = re.match(r"define .*?@(drjit_|func_)", line) is not None
        instruction = re.match(r"\s+%\S+ = (?:tail )?(\w+)( .*)", line)
        # Vectors hold one value a lane; scalars (addresses, the loop over lanes) serve all lanes
        if not counted or instruction is None or "<" not in line:
            continue
        name, rest = instruction.groups()
        if name in _LLVM_IGNORED or _LLVM_LANES.match(name + rest):
            continue
        if name == "call":
            called = re.search(r"@([\w.]+)\(", rest)
            if called is None:  # a virtual function: it is counted itself
                continue
            name = called[1].removeprefix("llvm.")
        counts["instructions"] += 1
        if packet := re.fullmatch(r"gather_(\d+)x[a-z](\d+)", name):
            counts.update(gathers=1, bytes_gathered=int(packet[1]) * int(packet[2]) // 8)
        elif name.startswith("masked.gather"):
            type_name = re.search(r"x (\w+)>", rest)[1]
            counts.update(gathers=1, bytes_gathered=_BYTES.get(type_name) or max(int(type_name[1:]) // 8, 1))
        elif "rsqrt" in name or "rcp" in name:
            counts["sqrt" if "rsqrt" in name else "div"] += 1
        else:
            counts.update(_LLVM_OPS.get(name.split(".")[0], ()))
    return Operations(**counts)


def bsdf_operations(bsdf, methods: tuple[str, ...] = ("eval", "pdf", "sample")) -> dict[str, Operations]:
    """Count the operations of methods of a Mitsuba BSDF (``mi.BSDF``), one call each, with all lobes.

    Directions, position, frame and random numbers are inputs; texture lookups are part of the count. Compiles a kernel
    for each of ``methods``, unless Dr.Jit has it in its cache.
    """
    import mitsuba as mi  # the rest of this module does not need it

    inputs = {"eval": lambda: (wo,), "pdf": lambda: (wo,), "sample": lambda: (sample1, sample2)}
    lanes = 64  # more than any vector has; a single lane would be a constant
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.sh_frame = mi.Frame3f(dr.zeros(mi.Vector3f, lanes))
    wo, sample1, sample2 = (dr.zeros(t, lanes) for t in (mi.Vector3f, mi.Float, mi.Point2f))
    # Not the shape: an opaque one would become a call of all shapes
    inputs_of_si = (si.t, si.time, si.wavelengths, si.p, si.n, si.uv, si.sh_frame, si.dp_du, si.dp_dv, si.wi)
    dr.make_opaque(inputs_of_si, wo, sample1, sample2)
    context = mi.BSDFContext()
    with dr.suspend_grad():
        return {m: count(lambda m=m: getattr(bsdf, m)(context, si, *inputs[m]())) for m in methods}
