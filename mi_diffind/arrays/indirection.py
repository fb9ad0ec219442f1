"""Differentiable arrays, and the indirection: one read with the output of another.

Datta et al., *Efficient Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023. Both classes are
``drjit.nn`` modules: PyTrees with dotted parameter names, so that ``opt.update(net)`` hands the tables to an optimiser,
``net.update(opt)`` takes them back, and ``nn.Sequential``, hash grids and MLPs compose with them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import drjit as dr
import numpy as np
from drjit import nn

from ..core.compat import backend_module, owned
from ..core.runtime import llvm_problem
from . import lookup
from .lookup import as_words, pack_bits, unpack_bits

__all__ = ["DifferentiableArray", "Indirection", "fold"]

INITIALISATIONS = ("ramp", "constant", "random")


def fold(x):
    """Fold any real number into ``[0, 1)`` by a triangle wave of period 2 and slope ±1.

    ``fold(x) = x`` on ``[0, 1)``, ``fold(1) = 1 − 2⁻²³``, ``fold(−x) = fold(x)`` up to rounding. NaN and infinities
    become 0.

    The result stays below 1 so that a coordinate made of it never wraps around a ``"repeat"`` border. The slope at
    exactly 1 is −1, not 0: the last entry of a ramp can be trained.
    """
    t = x - 2 * dr.floor(x * 0.5)
    down = (2 - 2**-23) - t
    return dr.select(t < 1, t, dr.select(down > 0, down, 0))


class DifferentiableArray(nn.Module):
    """Table that is read at a continuous coordinate by multilinear interpolation.

    It is differentiable with respect to its entries and to the coordinate.

    Parameters:
        resolution: entries along each of the 1 to 4 input dimensions, ``(N_1, …, N_d)``; an ``int`` means 1D.
        channels: values per entry, any number ≥ 1.
        init: ``"ramp"`` (entry = its own normalised position; channel ``k`` runs along axis ``k mod d``),
            ``"constant"`` (``value``), ``"random"`` (uniform in ``value = (low, high)``, from the generator passed to
            ``alloc``), or a NumPy array / tensor of shape ``(N_1, …, N_d, channels)``.
        value: see ``init``; defaults to 0.5, or to (0, 1) for ``"random"``.
        fold: pass the *stored entries* through :func:`fold` before interpolating. A primary array always does, a
            cascaded array does if its output is bounded to [0, 1).
        border: ``"clamp"`` or ``"repeat"``, one for all axes or one an axis.

    Like every ``drjit.nn`` module, it has to be allocated before use: ``array = DifferentiableArray(…).alloc(dtype)``
    with a tensor type such as ``mi.TensorXf``. Then ``array(x)`` reads it, where ``x`` is a sequence of ``d`` arrays
    (``Point2f``, a list of ``Float``, a single ``Float`` in 1D) or a ``nn.CoopVec``. It returns a list of ``channels``
    arrays, or a ``nn.CoopVec`` if it was given one. :mod:`.lookup` defines texel positions, borders and what
    coordinates outside [0, 1] and NaN mean.

    There is one trainable parameter, ``data``, a tensor of shape ``(N_1, …, N_d, padded)``, where ``padded`` is
    ``channels`` rounded up to 1, 2 or a multiple of 4: padding makes gathers and scatters packets, 2.7 times faster in
    training. Padding entries have no influence. :meth:`numpy` returns the entries without it, and ``data`` may be set
    to a tensor without it, which is read channel by channel.

    :meth:`to` converts to another storage form: ``"float32"`` for training, ``"float16"`` for storing, ``"uint8"``
    (packed in ``UInt32``) for inference. Raises ``ValueError`` for impossible settings.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "resolution": tuple, "channels": int, "border": tuple, "folded": bool, "storage": str, "bits": int,
        "scale": tuple, "offset": tuple, "init": object, "value": object, "data": dr.ArrayBase,
    }  # fmt: skip

    def __init__(self, resolution=(2,), channels=1, init="constant", value=None, fold=False, border="clamp"):
        resolution = tuple(int(n) for n in np.atleast_1d(resolution))
        border = (border,) * len(resolution) if isinstance(border, str) else tuple(border)
        if not 1 <= len(resolution) <= 4 or min(resolution) < 1:
            raise ValueError(f"resolution: found {resolution}, allowed are 1 to 4 dimensions of at least 1 entry each")
        if channels < 1:
            raise ValueError(f"channels: found {channels}, at least 1 is needed")
        if len(border) != len(resolution) or any(b not in lookup.BORDERS for b in border):
            raise ValueError(f"border: found {border}, allowed are {lookup.BORDERS}, one for each axis")
        if isinstance(init, str):
            if init not in INITIALISATIONS:
                raise ValueError(f'init: found "{init}", allowed are {INITIALISATIONS} or an array of entries')
        elif tuple(np.shape(init)) != (*resolution, channels):
            raise ValueError(f"init: found shape {tuple(np.shape(init))}, expected {(*resolution, channels)}")
        self.resolution, self.channels, self.border, self.folded = resolution, int(channels), border, bool(fold)
        self.storage, self.bits, self.scale, self.offset = "float32", 8, (), ()
        self.init, self.data = init, None
        random = isinstance(init, str) and init == "random"
        self.value = value if value is not None else (0.0, 1.0) if random else 0.5
        if random and np.shape(self.value) != (2,):
            raise ValueError(f'value: found {value}, init="random" needs a pair (low, high)')
        if isinstance(init, str) and init == "constant" and np.shape(self.value) not in ((), (1,), (self.channels,)):
            raise ValueError(f"value: found {value}, one number or {self.channels} are needed, one a channel")

    def _alloc(self, dtype, size=-1, rng=None):
        if size not in (-1, self.dims):
            raise ValueError(f"an array of {self.dims} dimension(s) was given {size} input(s)")
        values = self._initial_values(dtype, rng)
        return self._replace()._hold(values, dtype, "float16" if dr.is_half_v(dtype) else "float32"), self.channels

    def _initial_values(self, dtype, rng) -> np.ndarray:
        shape = (*self.resolution, self.channels)
        if not isinstance(self.init, str):
            return np.asarray(self.init, dtype=np.float32)
        if self.init == "ramp":
            return ramp(self.resolution, self.channels, self.border)
        if self.init == "constant":
            return np.broadcast_to(np.asarray(self.value, dtype=np.float32), shape)
        rng = rng if rng is not None else dr.rng(seed=0)
        low, high = self.value
        drawn = rng.random(backend_module(dtype).Float, int(np.prod(shape)))
        return low + (high - low) * drawn.numpy().reshape(shape)

    def _require_entries(self) -> None:
        if self.data is None:
            raise RuntimeError("this DifferentiableArray has no entries yet: call .alloc(tensor type) first")

    def _replace(self, **changes) -> DifferentiableArray:
        """Return a copy with other attributes, which shares everything else but the cache of parameter names."""
        result = type(self)()
        for name in self.DRJIT_STRUCT:
            setattr(result, name, changes[name] if name in changes else getattr(self, name))
        return result

    def copy(self) -> DifferentiableArray:
        """Return a copy that shares the entries; assigning to one does not change the other."""
        self._require_entries()
        return self._replace(data=type(self.data)(self.data))

    def unfolded(self, change=None) -> DifferentiableArray:
        """Return a copy that holds its entries folded already, after ``change`` (a function of a flat array) if given.

        It is differentiable with respect to the entries of this array. For floats.
        """
        self._require_entries()
        entries = fold(self.data.array) if self.folded else self.data.array
        entries = entries if change is None else change(entries)
        return self._replace(data=type(self.data)(entries, self.data.shape), folded=False)

    def rounded(self, bits: int) -> DifferentiableArray:
        """Return a copy whose entries in [0, 1], after the fold, are rounded as :meth:`quantised` stores them.

        Gradients are those of the unrounded entries (straight-through estimation): training takes rounding into
        account.
        """
        steps = 2**bits - 1

        def change(entries):
            exact = dr.detach(entries)
            return entries + dr.detach(dr.round(exact * steps) / steps - exact)

        return self.unfolded(change)

    def quantised(self, bits: int) -> DifferentiableArray:
        """Return a copy in ``"uint8"`` storage, of entries that are numbers in [0, 1] after the fold.

        Each entry is stored in ``bits`` bits, 1 to 8, which stand for multiples of ``1 / (2^bits − 1)``, whatever range
        is used; :attr:`is_pointer` holds.
        """
        steps = 2**bits - 1
        codes = np.rint(self.numpy().astype(np.float64) * steps).astype(np.uint8)
        affine = ((1 / steps,) * self.channels, (0.0,) * self.channels)
        return self._replace(folded=False)._hold(codes, type(self.data), "uint8", affine, bits)

    def to(self, storage: str) -> DifferentiableArray:
        """Return a copy in another storage form.

        Leaving ``"float32"`` applies the fold for good: quantised entries are ``fold(entry)``, and inference needs no
        non-linearity. ``"uint8"`` is for reading only.
        """
        check_storage(storage)
        if storage == self.storage:
            return self._replace()
        return self._replace(folded=False)._hold(self.numpy(), type(self.data), storage)

    @classmethod
    def from_numpy(cls, values, dtype, border="clamp", storage="float32", fold=False, quantization=None, bits=8):
        """Return an allocated array holding ``values`` of shape ``(N_1, …, N_d, channels)``.

        With ``storage="uint8"``, ``quantization = (scale, offset)`` says that ``values`` are already bytes, and
        ``bits`` < 8 that they need only so many bits each in memory.
        """
        values = np.asarray(values)
        check_storage(storage)
        if values.ndim < 2:
            raise ValueError(f"values: found shape {values.shape}, the last axis has to be the channels")
        result = cls(values.shape[:-1], values.shape[-1], "constant", None, fold, border)
        return result._hold(values, dtype, storage, quantization, bits)

    def _hold(self, values, dtype, storage: str, quantization=None, bits: int = 8) -> DifferentiableArray:
        """Take ``values`` as entries, as :meth:`from_numpy` does, and return the array itself."""
        require_backend(dtype)
        self.storage, self.scale, self.offset, self.bits = storage, (), (), 8
        if storage != "uint8":
            self.data = padded_tensor(_tensor_type(dtype, storage), values, self._shape, self.channels)
            return self
        codes, affine = values, quantization
        if quantization is None:
            codes, *affine = lookup.quantize(values, self.channels)
        self.scale, self.offset = (tuple(map(float, numbers)) for numbers in affine)
        self.bits = bits
        self.data = owned(device_array(backend_module(dtype).UInt32, self._pack(codes, bits)))
        return self

    def _pack(self, codes: np.ndarray, bits: int) -> np.ndarray:
        """Return the words that hold the numbers ``codes``, ``(*shape, channels)``, of ``bits`` bits."""
        if bits == 8:
            return lookup.pack(codes, self.border)
        more = lookup.resolution_in_memory(self.resolution, self.border)[-1] - codes.shape[-2]
        return as_words(pack_bits(np.concatenate([codes, codes[..., :more, :]], axis=-2), bits), spare=2)

    def numpy(self) -> np.ndarray:
        """Return the entries as they are interpolated (folded, dequantised), float32, ``(N_1, …, N_d, channels)``."""
        self._require_entries()
        if self.storage == "uint8":
            codes = self.codes().astype(np.float64)
            return (np.asarray(self.offset) + np.asarray(self.scale) * codes).astype(np.float32)
        data = dr.detach(self.data)
        data = fold(data) if self.folded else data
        return data.numpy().astype(np.float32)[..., : self.channels]

    def codes(self) -> np.ndarray:
        """Return the bytes of an array in ``"uint8"`` storage, shape ``(N_1, …, N_d, channels)``."""
        if self.storage != "uint8":
            raise ValueError(f'only "uint8" storage has codes, this array is stored as "{self.storage}"')
        return self._unpack(self.data.numpy())

    def _unpack(self, words: np.ndarray) -> np.ndarray:
        """Return the numbers of :meth:`_pack` words."""
        if self.bits == 8:
            return lookup.unpack(words, self.resolution, self.channels)
        shape = (*lookup.resolution_in_memory(self.resolution, self.border), self.channels)
        codes = unpack_bits(words.view(np.uint8), math.prod(shape), self.bits)
        return codes.reshape(shape)[..., : self.resolution[-1], :]

    def at(self, x) -> DifferentiableArray:
        """Fix the *last* coordinate at ``x``, an array of size 1, and return the array of one dimension less.

        ``array.at(x)([a]) == array([a, x])`` up to rounding. The result is in single precision, its entries folded
        already, differentiable with respect to the entries and to ``x``. Raises ``ValueError`` for an array of one
        dimension or several numbers.
        """
        self._require_entries()
        if self.dims < 2:
            raise ValueError("an array of 1 dimension has no coordinate to fix but its only one")
        if dr.width(x) != 1:
            raise ValueError(f"x: found {dr.width(x)} numbers, 1 is needed")
        module, (*resolution, _) = backend_module(self.data), self.resolution
        index = dr.arange(module.UInt32, math.prod(resolution))
        positions = []
        for n, border in reversed(list(zip(resolution, self.border, strict=False))):
            positions.insert(0, module.Float(index % n) / max(1, n if border == "repeat" else n - 1))
            index = index // n
        values = self([*positions, x])
        stored = lookup.padded_channels(self.channels)
        flat = dr.zeros(module.Float, math.prod(resolution) * stored)
        index = dr.arange(module.UInt32, math.prod(resolution)) * stored
        for k, value in enumerate(values):
            dr.scatter(flat, value, index + k)
        result = DifferentiableArray(resolution, self.channels, border=self.border[:-1])
        return result._replace(data=module.TensorXf(flat, (*resolution, stored)))

    def blend(self, corners, active=True) -> list:
        """Return the channels of a weighted sum of entries, folded, without interpolation.

        ``corners`` are pairs: the number of an existing entry, the last axis fastest, and its weight; the weights sum
        to 1. Differentiable with respect to the weights and to the entries of float storage.
        """
        self._require_entries()
        if self.storage != "uint8":
            return self._read_floats(lambda: corners, active)
        words, runs = (self.data, self.scale, self.offset), [(index, (weight,)) for index, weight in corners]
        packed = self.resolution if self.bits == 8 else None
        return lookup.read_words(*words, self.channels, runs, active, self.bits, packed)

    def _read_floats(self, corners, active) -> list:
        """Return the weighted sum of the entries that the function ``corners`` returns."""
        self.check_shape()
        # Folding the whole table once is cheaper, but a loop or call that is being recorded can only gather from (and
        # send gradients to) what exists already.
        entries, transform = self.data.array, fold if self.folded else None
        if self.folded and not dr.flag(dr.JitFlag.SymbolicScope):
            entries, transform = fold(entries), None
        return lookup.read_floats(entries, self.channels, self.data.shape[-1], corners(), active, transform)

    @property
    def is_pointer(self) -> bool:
        """Whether all entries are bytes that stand for numbers in [0, 1], so that every read is a coordinate."""
        if self.storage != "uint8":
            return False
        pairs = list(zip(self.scale, self.offset, strict=True))
        return all(offset >= 0 and scale >= 0 and offset + (2**self.bits - 1) * scale <= 1 for scale, offset in pairs)

    @property
    def _shape(self) -> tuple[int, ...]:
        """Shape of the entries, without the channels."""
        return self.resolution

    def check_shape(self) -> None:
        """Raise ``ValueError`` if ``data`` is a tensor of any shape but the two that can be read."""
        allowed = [(*self._shape, n) for n in (self.channels, lookup.padded_channels(self.channels))]
        if self.data.shape not in allowed:
            raise ValueError(f'"data" has the shape {self.data.shape}, expected {allowed[0]}')

    @property
    def dims(self) -> int:
        """Number of input dimensions."""
        return len(self.resolution)

    @property
    def nbytes(self) -> int:
        """Bytes of the entries in their storage form, without padding: what a file has to hold."""
        bits = {"float32": 32, "float16": 16, "uint8": self.bits}[self.storage]
        return (math.prod(self._shape) * self.channels * bits + 7) // 8

    @property
    def memory_nbytes(self) -> int:
        """Bytes in memory, with padded channels, and entries that packed tables repeat (:func:`.packed_layout`)."""
        self._require_entries()
        return dr.width(self.data) * (2 if self.storage == "float16" else 4)

    def __repr__(self) -> str:
        size = "x".join(map(str, self.resolution))
        return f"DifferentiableArray({size}, channels={self.channels}, storage={self.storage}, fold={self.folded})"

    def __call__(self, x, active=True, inside=False):
        """Read at ``x`` (see the class).

        ``active`` masks lanes that must not access memory; they return 0. ``inside``: all coordinates are known to lie
        in [0, 1], as those from bytes may be.
        """
        self._require_entries()
        coordinates, is_coopvec = as_coordinates(x, backend_module(self.data).Float)
        if len(coordinates) != self.dims:
            raise ValueError(f"an array of {self.dims} dimension(s) was read at {len(coordinates)} coordinate(s)")
        values = self._read(coordinates, active, inside)
        return nn.CoopVec(*values) if is_coopvec else values

    def _read(self, x: list, active, inside: bool) -> list:
        if self.storage != "uint8":
            return self._read_floats(lambda: lookup.corners(x, self.resolution, self.border), active)
        words = self.data, self.scale, self.offset
        if self.bits == 8:
            return lookup.read_packed(*words, self.resolution, self.channels, x, self.border, active, inside)
        runs = lookup.neighbour_pairs(x, self.resolution, self.border, inside)
        return lookup.read_words(*words, self.channels, runs, active, self.bits)


class Indirection(nn.Module):
    """Differentiable indirection, ``y = C[fold(P)[x]]``.

    A read of the primary arrays ``P`` gives the coordinate at which the cascaded array ``C`` is read.

    Parameters:
        primary: one :class:`DifferentiableArray` or several, whose outputs are concatenated. Their entries are folded
            (``fold=True``), because they are coordinates.
        cascaded: the :class:`DifferentiableArray` that holds the answer, with as many dimensions as the primaries have
            channels together.
        inputs: for each primary, the indices of the inputs that it reads. By default consecutive ones: the first
            primary takes the first ``dims`` inputs, the next the following.

    Parameter names are ``primary.0.data``, ``primary.1.data``, …, ``cascaded.data``. With a ramp in the primary and a
    constant in the cascaded array, it starts as the identity followed by an ordinary grid lookup.
    """

    DRJIT_STRUCT = {"primary": tuple, "cascaded": DifferentiableArray, "inputs": tuple}  # noqa: RUF012

    def __init__(self, primary=(), cascaded=None, inputs: Sequence[Sequence[int]] | None = None):
        self.primary = (primary,) if isinstance(primary, DifferentiableArray) else tuple(primary)
        self.cascaded = cascaded
        self.inputs = ()
        if cascaded is None:  # as a PyTree, it is made empty and then filled
            return
        pointers = sum(p.channels for p in self.primary)
        if pointers != cascaded.dims:
            raise ValueError(
                f"the primary arrays have {pointers} channel(s) together, but the cascaded array has "
                f"{cascaded.dims} dimension(s): a pointer needs one channel for each"
            )
        if inputs is None:
            starts = np.cumsum([0] + [p.dims for p in self.primary])
            inputs = [range(a, a + p.dims) for a, p in zip(starts, self.primary, strict=False)]
        self.inputs = tuple(tuple(int(i) for i in group) for group in inputs)
        if [len(group) for group in self.inputs] != [p.dims for p in self.primary]:
            raise ValueError(f"inputs: found {self.inputs}, but the primaries have {[p.dims for p in self.primary]}")
        if min(i for group in self.inputs for i in group) < 0:
            raise ValueError(f"inputs: found {self.inputs}, an index is at least 0")

    @property
    def dims(self) -> int:
        """Number of inputs."""
        return 1 + max(i for group in self.inputs for i in group)

    def _alloc(self, dtype, size=-1, rng=None):
        if size not in (-1, self.dims):
            raise ValueError(f"an indirection of {self.dims} input(s) was given {size}")
        primary = [p._alloc(dtype, p.dims, rng)[0] for p in self.primary]
        cascaded, channels = self.cascaded._alloc(dtype, self.cascaded.dims, rng)
        return Indirection(primary, cascaded, self.inputs), channels

    def to(self, storage: str, cascaded: str | None = None) -> Indirection:
        """Return a copy with other storage forms of the primaries and of the cascaded array (default: the same)."""
        return Indirection([p.to(storage) for p in self.primary], self.cascaded.to(cascaded or storage), self.inputs)

    @property
    def nbytes(self) -> int:
        """Bytes of all entries in their storage form, without padding."""
        return sum(p.nbytes for p in self.primary) + self.cascaded.nbytes

    def pointer(self, x, active=True) -> list:
        """Return the coordinate at which the cascaded array is read for the inputs ``x``."""
        x, _ = as_coordinates(x)
        if len(x) != self.dims:
            raise ValueError(f"an indirection of {self.dims} input(s) was read at {len(x)} coordinate(s)")
        result = []
        for array, group in zip(self.primary, self.inputs, strict=True):
            result += array([x[i] for i in group], active)
        return result

    def __call__(self, x, active=True):
        """Read at the inputs ``x``; returns a list of channels, or a ``nn.CoopVec`` if given one."""
        inside = all(p.is_pointer for p in self.primary)
        values = self.cascaded(self.pointer(x, active), active, inside)
        return nn.CoopVec(*values) if isinstance(x, nn.CoopVec) else values

    def __repr__(self) -> str:
        return f"Indirection({', '.join(map(repr, self.primary))} -> {self.cascaded!r})"


def unfolded(net):
    """Return a copy of a module, tuple or list of modules whose arrays are :meth:`.DifferentiableArray.unfolded`.

    For training: if all entries are folded before anything is read, a backward pass comes to all reads before it comes
    to a fold, and one kernel sums all gradients. Otherwise the pass through a fold waits for the sums behind it, and
    what follows repeats the reads.
    """
    if isinstance(net, DifferentiableArray):
        return net if net.storage == "uint8" else net.unfolded()
    if isinstance(net, (tuple, list)):
        return type(net)(map(unfolded, net))
    if not isinstance(net, nn.Module):
        return net
    result = copy.copy(net)
    for name in getattr(net, "DRJIT_STRUCT", ()):
        setattr(result, name, unfolded(getattr(net, name)))
    return result


def rounded(net: Indirection, bits: Sequence[int] | None = None) -> Indirection:
    """Return a copy of ``net`` for training that takes rounding into account (:meth:`.DifferentiableArray.rounded`).

    Entries of each primary are rounded to its ``bits`` (default: 8), the cascaded array's to 8.
    """
    return _each_array(net, bits, DifferentiableArray.rounded)


def stored_form(net: Indirection, bits: Sequence[int] | None = None) -> Indirection:
    """Return the arrays of ``net`` as they are stored, as bytes; :func:`rounded` predicts their values."""
    return _each_array(net, bits, DifferentiableArray.quantised)


def _each_array(net: Indirection, bits: Sequence[int] | None, change) -> Indirection:
    widths = bits or [8] * len(net.primary)
    primary = [change(array, width) for array, width in zip(net.primary, widths, strict=True)]
    return Indirection(primary, change(net.cascaded, 8), net.inputs)


def ramp(resolution: Sequence[int], channels: int, border: Sequence[str]) -> np.ndarray:
    """Return entries equal to their own position, ``(N_1, …, N_d, channels)``.

    Channel ``k`` runs along axis ``k mod d``.
    """
    grids = np.meshgrid(
        *[
            np.arange(n, dtype=np.float32) / max(1, n if b == "repeat" else n - 1)
            for n, b in zip(resolution, border, strict=True)
        ],
        indexing="ij",
    )
    return np.stack([grids[k % len(grids)] for k in range(channels)], axis=-1)


def check_storage(storage: str) -> None:
    """Raise ``ValueError`` for a word that is no storage form."""
    if storage not in lookup.STORAGES:
        raise ValueError(f'storage: found "{storage}", allowed are {lookup.STORAGES}')


def _tensor_type(dtype, storage: str):
    """Return the tensor type of a float storage form: never double, also in such variants."""
    return backend_module(dtype).TensorXf16 if storage == "float16" else backend_module(dtype).TensorXf


def require_backend(dtype) -> None:
    # Without LLVM, Dr.Jit takes the whole process down when it makes an array from NumPy's (SIGFPE).
    if not dr.has_backend(dr.backend_v(dtype)):
        raise RuntimeError(llvm_problem() or f"the Dr.Jit backend of {dtype.__module__} cannot run here")


def padded_tensor(dtype, values: np.ndarray, resolution, channels: int):
    """Return ``values``, ``(*resolution, channels)``, as a tensor with padded channels, which are 0."""
    require_backend(dtype)
    half = dr.is_half_v(dtype)
    dtype = _tensor_type(dtype, "float16" if half else "float32")
    shape = (*resolution, lookup.padded_channels(channels))
    stored = aligned(shape, np.float16 if half else np.float32)
    stored[..., :channels] = values
    stored[..., channels:] = 0
    return dtype(owned(dtype(stored).array), shape)


def aligned(shape, dtype) -> np.ndarray:
    """Return an uninitialised NumPy array that starts at a multiple of 64 bytes.

    On the CPU, Dr.Jit uses NumPy's memory as it is, and from memory that is aligned less it gathers number by number
    instead of packet by packet: half the speed in single precision, a fifth in half precision.
    """
    count, size = math.prod(shape), np.dtype(dtype).itemsize
    memory = np.empty(count * size + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + count * size].view(dtype).reshape(shape)


def aligned_copy(values, dtype=None) -> np.ndarray:
    """Return a contiguous copy of ``values`` that starts at a multiple of 64 bytes (:func:`aligned`).

    Dr.Jit compiles another kernel for each combination of aligned and other inputs, and NumPy aligns at random.
    """
    values = np.asarray(values, dtype)
    copy = aligned(values.shape, values.dtype)
    copy[...] = values
    return copy


def device_array(dtype, values) -> dr.ArrayBase:
    """Return a flat Dr.Jit array of a 32-bit type with the numbers of a NumPy array, an :func:`aligned_copy`."""
    return dtype(aligned_copy(values, np.float32 if dr.is_float_v(dtype) else np.uint32).reshape(-1))


def device_tensor(dtype, values) -> dr.ArrayBase:
    """Return a Dr.Jit tensor of a 32-bit type with the numbers of a NumPy array, copied by :func:`device_array`."""
    return dtype(device_array(dr.array_t(dtype), values), np.shape(values))


def as_coordinates(x, default=None):
    """Return coordinates as a list of single-precision arrays, and whether they were a cooperative vector.

    Numbers become arrays like the others, or like ``default``.
    """
    is_coopvec = isinstance(x, nn.CoopVec)
    if not is_coopvec and not isinstance(x, (list, tuple)) and dr.depth_v(x) <= 1:
        x = [x]
    x = list(x)
    Float = next((dr.float32_array_t(type(v)) for v in x if dr.is_jit_v(v)), default)
    return [v if Float is None or type(v) is Float else Float(v) for v in x], is_coopvec
