"""
What a computation costs in operations, counted in the kernel that Dr.Jit makes of it.

The accounting is that of the paper's supplement (1.2.1): an addition or multiplication is 1 flop, a division 2, a
square root or logarithm 4; a fused multiply-add is an addition and a multiplication. What it does not count (minima,
comparisons, selections, conversions, integer arithmetic) is part of ``instructions``. Counts are for one lane and one
pass through the kernel: the body of a loop counts once, and where a call may go to several functions, all of them do.

Dr.Jit's CPU backend has no instruction for logarithms and exponentials and expands them into polynomials, which count
as the additions and multiplications that they are; a GPU has one, which counts as ``log``. Reading inputs and writing
outputs is not counted, and what is known before the kernel is made costs nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields

import drjit as dr

from ..compat import is_ptx, kernel_code
from .clock import Query, total

#: Flops of an operation in the paper's accounting.
FLOPS = {"add": 1, "mul": 1, "div": 2, "sqrt": 4, "log": 4}


@dataclass(frozen=True)
class Operations:
    """
    Operations of one lane: floating-point ``add`` (and subtract), ``mul``, ``div`` (and reciprocal), ``sqrt`` (and its
    reciprocal), ``log`` (and other transcendental functions that are one instruction); ``gathers``, reads of memory at
    a computed place (one that fetches several neighbours counts once), and ``bytes_gathered`` by them;
    ``instructions``, all that compute: the above with fused multiply-adds once, comparisons, selections, conversions,
    integer arithmetic, gathers.
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
        """All counts by name, ``flops`` included."""
        return {**asdict(self), "flops": self.flops}


def count(function: Callable[[], object]) -> Operations:
    """
    Count the operations of evaluating what ``function()`` returns, any tree of Dr.Jit arrays (one of the LLVM or CUDA
    backend): what the function itself evaluates on the way is counted, too.

    Whatever is not evaluated before becomes part of the count, and what is a literal is folded into the kernel, so
    inputs should be opaque (``dr.make_opaque``). Clears the kernel history.
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        dr.eval(function())
        history = dr.kernel_history([dr.KernelType.JIT])
    return sum((count_ir(kernel_code(entry)) for entry in history), Operations())


def count_query(function: Query) -> Operations:
    """The operations of a query, without the additions of :func:`.clock.total`."""
    with dr.suspend_grad():
        added = 0

        def summed():
            nonlocal added
            result, added = total(function())
            return result

        found = count(summed)
    return found + Operations(add=-added, instructions=-added)


def count_ir(text: str) -> Operations:
    """Count the operations of one kernel from its intermediate representation: LLVM's, or PTX (CUDA)."""
    counts = dict.fromkeys((f.name for f in fields(Operations)), 0)
    found = _ptx(text) if is_ptx(text) else _llvm(text)
    for names, size in found:
        counts["instructions"] += 1
        counts["bytes_gathered"] += size
        for name in names:
            counts[name] += 1
    return Operations(**counts)


#: What :func:`_llvm` and :func:`_ptx` yield for an instruction: the counts that it adds one to, and the bytes gathered.
Found = tuple[tuple[str, ...], int]

_LLVM_OPS = {"fadd": ("add",), "fsub": ("add",), "fmul": ("mul",), "fdiv": ("div",)}
_LLVM_CALLS = {"fma": ("add", "mul"), "fmuladd": ("add", "mul"), "sqrt": ("sqrt",)}
_LLVM_CALLS |= dict.fromkeys(("exp", "exp2", "log", "log2", "pow", "sin", "cos", "tanh"), ("log",))

#: Neither arithmetic nor a read: constants, addresses, input and output, flow of control.
_LLVM_IGNORED = {
    *("insertelement", "insertvalue", "extractelement", "extractvalue", "shufflevector", "bitcast"),
    *("getelementptr", "inttoptr", "ptrtoint", "alloca", "load", "phi"),
}

#: The number of a lane, and whether there is such a lane, which gathers are masked with; addresses of packets.
_LLVM_LANES = re.compile(r"add <\d+ x i32> %r\d+_2, <|icmp ult <\d+ x i32> %r\d+, %p\d+_2$|select .* x ptr>")

_BYTES = {"float": 4, "half": 2, "double": 8}


def _llvm(text: str) -> Iterator[Found]:
    counted = False
    for line in text.splitlines():
        if line.startswith("define"):
            # Kernels and the functions that they call; helpers of Dr.Jit (packet gathers) count where they are used
            counted = re.match(r"define .*?@(drjit_|func_)", line) is not None
        instruction = re.match(r"\s+%\S+ = (?:tail )?(\w+)( .*)", line)
        # Of one lane each; what is done once for all lanes (addresses, the loop over lanes) is not a vector
        if not counted or instruction is None or "<" not in line:
            continue
        name, rest = instruction.groups()
        if name in _LLVM_IGNORED or _LLVM_LANES.match(name + rest):
            continue
        if name != "call":
            yield _LLVM_OPS.get(name, ()), 0
            continue
        called = re.search(r"@([\w.]+)\(", rest)
        if called is None:  # a virtual function: it is counted itself
            continue
        called = called[1]
        if packet := re.fullmatch(r"gather_(\d+)x[a-z](\d+)", called):
            yield ("gathers",), int(packet[1]) * int(packet[2]) // 8
        elif called.startswith("llvm.masked.gather"):
            kind = re.search(r"x (\w+)>", rest)[1]
            yield ("gathers",), _BYTES.get(kind) or max(int(kind[1:]) // 8, 1)
        elif "rsqrt" in called:
            yield ("sqrt",), 0
        elif "rcp" in called:
            yield ("div",), 0
        else:
            yield _LLVM_CALLS.get(called.split(".")[1] if called.startswith("llvm.") else "", ()), 0


_PTX_OPS = {"add": ("add",), "sub": ("add",), "mul": ("mul",), "fma": ("add", "mul"), "mad": ("add", "mul")}
_PTX_OPS |= {"div": ("div",), "rcp": ("div",), "sqrt": ("sqrt",), "rsqrt": ("sqrt",)}
_PTX_OPS |= dict.fromkeys(("ex2", "lg2", "sin", "cos", "tanh"), ("log",))

_PTX_IGNORED = {"mov", "ld", "ldu", "st", "bra", "ret", "call", "cvta"}


def _ptx(text: str) -> Iterator[Found]:
    in_prologue = False
    for line in text.splitlines():
        if ".entry" in line:
            in_prologue = True  # the index of the lane
        if line.startswith("body:"):
            in_prologue = False
        match = re.match(r"\s+(?:@!?%\w+ )?([a-z]\w*)((?:\.\w+)*)\s", line)
        if match is None or in_prologue:
            continue
        name, kinds = match[1], match[2].split(".")[1:]
        if name == "ld" and kinds[:2] == ["global", "nc"]:
            lanes = next((int(k[1:]) for k in kinds if re.fullmatch(r"v\d", k)), 1)
            yield ("gathers",), lanes * int(kinds[-1][1:]) // 8
        elif name in ("tex", "tld4"):
            yield ("gathers",), 16
        elif name not in _PTX_IGNORED and not re.search(r"%rd[03], ", line):  # these two hold addresses
            floats = any(k in ("f16", "f32", "f64") for k in kinds)
            yield (_PTX_OPS.get(name, ()) if floats else ()), 0


def bsdf_operations(bsdf, methods: tuple[str, ...] = ("eval", "pdf", "sample")) -> dict[str, Operations]:
    """
    The operations of ``eval``, ``pdf`` and ``sample`` of a Mitsuba BSDF (``mi.BSDF``): one call each, all lobes asked
    for. Directions, position, frame and random numbers are inputs; reading textures is part of the count. Compiles a
    kernel for each of ``methods``, unless Dr.Jit has it in its cache. Raises ``ValueError`` for other methods.
    """
    import mitsuba as mi  # the rest of this module does not need it

    inputs = {"eval": lambda: (wo,), "pdf": lambda: (wo,), "sample": lambda: (sample1, sample2)}
    for method in methods:
        if method not in inputs:
            raise ValueError(f'found the method "{method}", allowed are {", ".join(inputs)}')
    lanes = 64  # more than one, or inputs are one number for all lanes; more than any vector has
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.sh_frame = mi.Frame3f(dr.zeros(mi.Vector3f, lanes))
    wo, sample1, sample2 = (dr.zeros(t, lanes) for t in (mi.Vector3f, mi.Float, mi.Point2f))
    # Not the shape: which one it is would become a choice between all that there are
    known = (si.t, si.time, si.wavelengths, si.p, si.n, si.uv, si.sh_frame, si.dp_du, si.dp_dv, si.wi)
    dr.make_opaque(known, wo, sample1, sample2)
    context = mi.BSDFContext()
    with dr.suspend_grad():
        return {m: count(lambda m=m: getattr(bsdf, m)(context, si, *inputs[m]())) for m in methods}
