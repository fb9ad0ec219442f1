"""Arrays whose resolution follows the content: pages of different resolutions behind a small index.

The domain is divided into ``A × B × …`` pages. Each has its own grid of entries, which includes the borders of the
page: one entry makes it constant, and two neighbouring pages both hold the values on their border, so that they join
where their entries agree. A word for each page says where its entries begin and how many it has; a read gathers it
first.

:func:`page_sizes` chooses the resolutions for data on a grid, :func:`page_entries` the entries.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import drjit as dr
import numpy as np

from ..core.compat import backend_module, owned
from . import lookup
from .indirection import DifferentiableArray, check_storage, device_array, require_backend
from .lookup import as_words, pack_bits, unpack_bits

#: Bits of an index word for the entries along a side of a page, by the number of dimensions; the rest counts entries.
SIDE_BITS = (8, 5, 4)

#: A page is at most so many texels wide: its resolution is chosen by the texels of its data and, behind them, the next.
SAMPLES = 16

#: Entries along a side of a page that :func:`page_sizes` chooses from.
SIDES = (1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 13, 15, SAMPLES + 1)
_OPTIONS = np.array([(rows, columns) for rows in SIDES for columns in SIDES])

#: Pages whose errors are computed at a time.
PART = 4096

#: Pages that an estimate looks at.
ESTIMATED = 1024


class PagedArray(DifferentiableArray):
    """A :class:`.DifferentiableArray` of 1 to 3 dimensions that consists of pages of different resolutions.

    Parameters:
        sizes: entries along each side of each page, whole numbers of shape ``(A, B, …, d)``, at most 256, 32 or 16 in
            1, 2 or 3 dimensions.
        channels: values per entry.
        init: the entries, ``(entries, channels)``: those of one page after the other, the last axis fastest; or a
            number for all.
        shift: start of the first page along each axis, in units of a page, from 0 to 1: half a texel, if entries are to
            lie at texel centres. Coordinates below ``shift`` read the last page (``"repeat"``), which then ends behind
            1, or clamp to the first one (``"clamp"``).
        fold, border: as for :class:`.DifferentiableArray`.

    ``resolution`` are the numbers of pages, ``data`` has the shape ``(entries, padded)``, ``index`` holds the words.
    It is read, trained and converted as the base class; :meth:`at` is not defined. Raises ``ValueError`` for impossible
    settings.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        **DifferentiableArray.DRJIT_STRUCT,
        "sizes": object,
        "shift": tuple,
        "index": tuple,  # in a tuple, it is no parameter
    }

    def __init__(self, sizes=((1,),), channels=1, init=0.5, shift=0.0, fold=False, border="clamp"):
        sizes = np.asarray(sizes)
        dims = sizes.shape[-1] if sizes.ndim else 0
        if not 1 <= dims <= len(SIDE_BITS) or sizes.ndim != dims + 1 or sizes.size == 0:
            raise ValueError(f"sizes: found the shape {sizes.shape}, allowed are (A, 1), (A, B, 2) and (A, B, C, 3)")
        if sizes.dtype.kind not in "iu" or sizes.min() < 1 or sizes.max() > 2 ** SIDE_BITS[dims - 1]:
            given = f"{sizes.min()} to {sizes.max()} of type {sizes.dtype}"
            raise ValueError(f"sizes: found {given}, allowed are whole numbers from 1 to {2 ** SIDE_BITS[dims - 1]}")
        shift = tuple(map(float, np.broadcast_to(shift, (dims,))))
        if not all(0 <= s <= 1 for s in shift):
            raise ValueError(f"shift: found {shift}, allowed are numbers from 0 to 1")
        super().__init__(sizes.shape[:-1], channels, "constant", None, fold, border)
        self.sizes, self.shift, self.index = sizes.astype(np.int64), shift, ()
        if self.entries > most_entries(dims):
            given = f"{self.entries:,} entries in all pages together"
            raise ValueError(f"sizes: found {given}, allowed are {most_entries(dims):,}")
        if np.shape(init) not in ((), (self.entries, self.channels)):
            raise ValueError(f"init: found shape {np.shape(init)}, expected {(self.entries, self.channels)}")
        self.init = np.asarray(init, np.float32)

    @property
    def entries(self) -> int:
        """Number of entries of all pages together."""
        return int(self.sizes.prod(axis=-1).sum())

    @property
    def _shape(self) -> tuple[int]:
        return (self.entries,)

    def _initial_values(self, dtype, rng) -> np.ndarray:
        return np.broadcast_to(self.init, (self.entries, self.channels))

    def _words(self, dtype):
        """Return the index: for each page, its first entry and, in the lower bits, its sides less one.

        The last side has the lowest bits.
        """
        flat, bits = self.sizes.reshape(-1, self.dims), SIDE_BITS[self.dims - 1]
        index = np.cumsum(flat.prod(axis=1)) - flat.prod(axis=1)
        for axis in range(self.dims):
            index = index << bits | (flat[:, axis] - 1)
        return owned(device_array(backend_module(dtype).UInt32, index))

    @classmethod
    def from_numpy(
        cls, values, dtype, border="clamp", storage="float32", fold=False, quantization=None, bits=8, *, sizes=None,
        shift=0.0,
    ):  # fmt: skip
        """Return an allocated array of pages of ``sizes`` that holds ``values``, ``(entries, channels)``.

        Other parameters are those of :meth:`.DifferentiableArray.from_numpy`. Bytes are never held several times.
        """
        values = np.asarray(values)
        check_storage(storage)
        if values.ndim != 2:
            raise ValueError(f"values: found shape {values.shape}, expected (entries, channels)")
        result = cls(sizes, values.shape[1], 0.0, shift, fold, border)
        if len(values) != result.entries:
            raise ValueError(f"values: found {len(values)} entries, the pages have {result.entries}")
        return result._hold(values, dtype, storage, quantization, bits)

    def _hold(self, values, dtype, storage: str, quantization=None, bits: int = 8) -> PagedArray:
        require_backend(dtype)
        self.index = (self._words(dtype),)
        return super()._hold(values, dtype, storage, quantization, bits)

    def _pack(self, codes: np.ndarray, bits: int) -> np.ndarray:
        return as_words(pack_bits(codes, bits), spare=2)

    def _unpack(self, words: np.ndarray) -> np.ndarray:
        codes = unpack_bits(words.view(np.uint8), self.entries * self.channels, self.bits)
        return codes.reshape(-1, self.channels)

    def at(self, x):
        raise NotImplementedError("an array of pages cannot be reduced by a dimension")

    @property
    def index_nbytes(self) -> int:
        """Bytes of the index: what a file has to hold."""
        return (self.sizes.size * SIDE_BITS[self.dims - 1] + 7) // 8

    @property
    def nbytes(self) -> int:
        """Bytes of the entries in their storage form, without padding, and of the index."""
        return super().nbytes + self.index_nbytes

    @property
    def memory_nbytes(self) -> int:
        """Bytes in memory, with padded channels; the index has a word a page."""
        return super().memory_nbytes + 4 * dr.width(self.index[0])

    def __repr__(self) -> str:
        pages = "x".join(map(str, self.resolution))
        return (
            f"PagedArray({pages} pages, {self.entries} entries, channels={self.channels}, storage={self.storage}, "
            f"fold={self.folded})"
        )

    def _read(self, x: list, active, inside: bool) -> list:
        corners = self._corners(x, active, inside)
        if self.storage != "uint8":
            return self._read_floats(lambda: corners, active)
        # The entries of a cell are neighbours along the last axis; a side of one entry reads the next by weight 0
        pairs = [(i, (v, w)) for (i, v), (_, w) in zip(corners[::2], corners[1::2], strict=True)]
        return lookup.read_words(self.data, self.scale, self.offset, self.channels, pairs, active, self.bits)

    def _corners(self, x: Sequence, active, inside: bool) -> list:
        """Return the ``2^d`` pairs (entry, weight) of a cell."""
        Float, UInt32 = type(x[0]), type(self.index[0])
        page, places = None, []
        for along, n, shift, border in zip(x, self.resolution, self.shift, self.border, strict=True):
            if border == "repeat" and not inside:
                along = along - dr.floor(along)
            t = along * n if shift == 0 else dr.fma(along, n, -shift)
            if border == "repeat" and shift != 0:
                t = dr.select(t < 0, t + n, t)
            t = lookup.clamp(t, 0.0, float(n))
            i = dr.minimum(UInt32(t), n - 1)
            page = i if page is None else dr.fma(page, n, i)
            places.append(t - Float(i))
        word, bits = dr.gather(UInt32, self.index[0], page, active), SIDE_BITS[self.dims - 1]
        sides = [(word >> bits * (self.dims - 1 - axis)) & (2**bits - 1) for axis in range(self.dims)]  # less one
        corners, stride = [(word >> bits * self.dims, None)], None
        for place, side in zip(reversed(places), reversed(sides), strict=True):
            position = place * Float(side)
            lower = dr.minimum(UInt32(position), dr.maximum(side, 1) - 1)
            weight = position - Float(lower)
            # A side of one entry has no next one: its own again
            step = dr.minimum(side, 1) if stride is None else dr.select(side > 0, stride, 0)
            ahead = lower if stride is None else lower * stride
            grown = []
            for offset, v in ((ahead, 1 - weight), (ahead + step, weight)):
                grown += [(index + offset, v if w is None else v * w) for index, w in corners]
            corners = grown
            stride = side + 1 if stride is None else stride * (side + 1)
        return corners


def most_entries(dims: int) -> int:
    """Return the largest number of entries that all pages of an array may have together."""
    return 2 ** (32 - dims * SIDE_BITS[dims - 1])


def page_counts(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the number of pages along each axis of data with these texels, each at most :data:`SAMPLES` wide."""
    return tuple(math.ceil(n / SAMPLES) for n in shape)


def page_sizes(values: np.ndarray, border: tuple[str, str], entries: float) -> np.ndarray:
    """Choose the resolutions, ``(A, B, 2)``, of the pages of an image ``values``, ``(height, width, k)``.

    All pages together have at most ``entries`` entries, but at least one each. The choice has the smallest squared
    error of all channels together, if entries are fitted to the image and read linearly.
    """
    return shared_page_sizes([values], border, entries)[0]


def shared_page_sizes(images: Sequence[np.ndarray], border: tuple[str, str], entries: float) -> list[np.ndarray]:
    """Choose the resolutions of the pages of several images that share the ``entries``.

    The choice has the smallest sum of the mean squared errors of the images; otherwise like :func:`page_sizes`.
    """
    errors = []
    for values in images:
        windows = _windows(values, border)
        parts = [_errors(windows[i : i + PART]) for i in range(0, len(windows), PART)]
        errors.append(np.concatenate(parts) / math.prod(values.shape[:2]))
    chosen = _OPTIONS[_allocate(np.concatenate(errors), entries)]
    parts = np.split(chosen, np.cumsum([len(e) for e in errors])[:-1])
    return [part.reshape(*page_counts(i.shape[:2]), 2) for part, i in zip(parts, images, strict=True)]


def page_gain(values: np.ndarray, border: tuple[str, str], entries: float, rest: float = 0.0) -> tuple[float, float]:
    """Estimate the gain of pages over one grid of as many ``entries``, in dB, and the PSNR of the pages.

    Entries of both are fitted to an image ``values``, ``(height, width, k)``, and read linearly. ``rest`` is a mean
    squared error that both have in addition. Errors are those of all channels together. The estimate uses at most 1024
    pages and no training.
    """
    windows = _windows(values, border)
    some = windows[np.random.default_rng(0).permutation(len(windows))[:ESTIMATED]]
    errors, share = _errors(some), len(some) / len(windows)
    texels = len(some) * SAMPLES**2
    paged = errors[np.arange(len(some)), _allocate(errors, share * entries)].sum() / texels + rest
    # The grid has as many cells a page wherever it is; what a page of its own does better at its border is little
    cells = SAMPLES * math.sqrt(entries / math.prod(values.shape[:2]))
    square = [i for i, (rows, columns) in enumerate(_OPTIONS) if rows == columns > 1]
    uniform = np.maximum(errors[:, square].sum(axis=0) / texels + rest, 1e-12)
    grid = np.interp(math.log(cells), np.log(_OPTIONS[square, 0] - 1), np.log(uniform))
    paged = math.log(max(paged, 1e-12))
    return 10 / math.log(10) * (float(grid) - paged), -10 / math.log(10) * paged


def _allocate(errors: np.ndarray, entries: float) -> np.ndarray:
    """Return the option that each page takes, by Lagrange's method.

    A page takes the option that minimises ``error + λ · entries``, with the smallest λ that leads to at most
    ``entries``. Where many equal pages want more at the same λ, the first of them get it.
    """
    cost = _OPTIONS.prod(axis=1)

    def best(exponent: float) -> np.ndarray:
        return np.argmin(errors + math.exp(exponent) * cost, axis=1)

    low, high = -40.0, 40.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if cost[best(middle)].sum() > entries else (low, middle)
    few, many = best(high), best(low)
    further = np.cumsum(np.maximum(cost[many] - cost[few], 0))
    return np.where(further <= entries - cost[few].sum(), many, few)


def page_entries(values: np.ndarray, border: tuple[str, str], sizes: np.ndarray) -> np.ndarray:
    """Return the entries, ``(entries, k)``, of pages of ``sizes``, ``(A, B, 2)``, that reproduce an image best.

    They have the smallest squared error to ``values``, ``(height, width, k)``, when they are read with a ``shift`` of
    half a texel (:func:`page_shift`).
    """
    windows, flat = _windows(values, border), np.asarray(sizes).reshape(-1, 2)
    ends = np.cumsum(flat.prod(axis=1))
    entries = np.empty((ends[-1], values.shape[2]), np.float32)
    inverse = {n: np.linalg.pinv(_ENDS[:, None] * _tents(n)) * _ENDS for n in SIDES}
    for rows, columns in np.unique(flat, axis=0):
        which = np.flatnonzero((flat == (rows, columns)).all(axis=1))
        fitted = inverse[rows] @ windows[which].astype(np.float64) @ inverse[columns].T
        where = (ends[which] - rows * columns)[:, None] + np.arange(rows * columns)
        entries[where] = fitted.transpose(0, 2, 3, 1).reshape(len(which), rows * columns, -1)
    return entries


def page_shift(shape: Sequence[int]) -> tuple[float, ...]:
    """Return half a texel, in units of a page: the ``shift`` that puts the first page's corner at a texel's centre."""
    return tuple(0.5 * pages / n for pages, n in zip(page_counts(shape), shape, strict=True))


def page_positions(sizes: np.ndarray, shift: Sequence[float]) -> np.ndarray:
    """Return the positions of the entries of pages of ``sizes``, ``(entries, d)``, from 0 to 1 plus the shift."""
    *counts, _ = np.shape(sizes)
    positions = []
    for page in np.ndindex(*counts):
        sides = [
            (i + shift[axis] + (np.linspace(0, 1, n) if n > 1 else np.array([0.5]))) / counts[axis]
            for axis, (i, n) in enumerate(zip(page, sizes[page], strict=True))
        ]
        positions.append(np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, len(sides)))
    return np.concatenate(positions)


#: A page shares what lies on its border with its neighbours: half the weight, here its root.
_ENDS = np.sqrt(np.r_[0.5, np.ones(SAMPLES - 1), 0.5])


def _tents(n: int) -> np.ndarray:
    """Return the weights of the ``n`` entries along a side in the samples of a page, ``(SAMPLES + 1, n)``."""
    if n == 1:
        return np.ones((SAMPLES + 1, 1))
    positions = np.arange(SAMPLES + 1) / SAMPLES * (n - 1)
    return np.maximum(1 - np.abs(positions[:, None] - np.arange(n)), 0)


def _windows(values: np.ndarray, border: tuple[str, str]) -> np.ndarray:
    """Return the samples of each page, its border included, ``(pages, k, SAMPLES + 1, SAMPLES + 1)``.

    They are texels, or interpolated between texels if pages are no whole number of texels wide.
    """
    for axis, pages in enumerate(page_counts(values.shape[:2])):
        n = values.shape[axis]
        at = np.arange(pages * SAMPLES + 1) * (n / (pages * SAMPLES))
        lower = np.floor(at).astype(np.int64)
        weight = np.reshape((at - lower).astype(np.float32), [-1 if a == axis else 1 for a in range(3)])
        both = (i % n if border[axis] == "repeat" else np.minimum(i, n - 1) for i in (lower, lower + 1))
        one, two = (np.take(values, i, axis=axis) for i in both)
        values = one + weight * (two - one)
    side = SAMPLES + 1
    windows = np.lib.stride_tricks.sliding_window_view(values, (side, side), axis=(0, 1))[::SAMPLES, ::SAMPLES]
    return windows.reshape(-1, values.shape[2], side, side)


def _errors(windows: np.ndarray) -> np.ndarray:
    """Return the squared errors, ``(pages, options)``, of the projections of the data onto all resolutions."""
    weighted = (windows * np.outer(_ENDS, _ENDS)).astype(np.float32)
    whole = np.einsum("pkij,pkij->p", weighted, weighted, dtype=np.float64)
    bases = [np.linalg.qr(_ENDS[:, None] * _tents(n))[0].astype(np.float32) for n in SIDES]
    errors = []
    for rows in bases:
        half = rows.T @ weighted
        for columns in bases:
            projected = half @ columns
            errors.append(whole - np.einsum("pkij,pkij->p", projected, projected, dtype=np.float64))
    return np.maximum(np.stack(errors, axis=1), 0)
