"""Memory budgets: the largest arrays of a family that fit into a number of bytes.

A family is a function of a size, such as the side of an array, that returns bytes, or the arrays themselves as pairs of
a shape and bits an entry (:func:`array_bytes`). Bytes never shrink as the size grows, so that a bisection finds the
largest size that fits::

    budget = Budget(2**20)
    side = budget.largest(lambda n: [((n, n, 4), 8), ((8, 8, 8, 8, 3), 8)], range(1, 4096))
"""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

#: Relative difference between requested and actual bytes that needs no explanation.
TOLERANCE = 0.05

#: Size of a family: a number, or an element of any sequence in the order of bytes.
Size = TypeVar("Size")

#: Member of a family: an object with ``nbytes``.
Member = TypeVar("Member")


class BudgetError(ValueError):
    """No member of a family fits into a budget."""


def array_bytes(arrays: Iterable[tuple[Sequence[int], int]]) -> int:
    """Return the bytes of arrays, given as pairs of a shape (with channels) and the bits of an entry.

    Entries lie without gaps; each array begins at a byte.
    """
    return sum((math.prod(map(int, shape)) * bits + 7) // 8 for shape, bits in arrays)


def proportional_shape(n: float, extent: Sequence[float], least: int = 2) -> tuple[int, ...]:
    """Return the shape of a grid with ``n`` entries along the longest axis of ``extent`` and the others in proportion.

    Each axis has at least ``least`` entries.
    """
    extent = np.asarray(extent, np.float64)
    return tuple(np.maximum(least, np.round(n * (extent / extent.max())).astype(int)).tolist())


@dataclass(frozen=True)
class Budget:
    """Number of bytes that arrays may take, and the relative ``tolerance`` within which a request is met."""

    nbytes: float
    tolerance: float = TOLERANCE

    def is_met(self, nbytes: float) -> bool:
        """Return whether ``nbytes`` are the requested bytes, within the tolerance."""
        return abs(nbytes / self.nbytes - 1) <= self.tolerance

    def largest(self, family: Callable[[Size], object], sizes: Sequence[Size], strict: bool = True) -> Size:
        """Return the last of ``sizes`` whose arrays fit, by bisection.

        ``sizes`` is a range or a sequence in the order of bytes; about log₂ of its length of them are tried. Raises
        :class:`BudgetError` if none fits; with ``strict=False`` the first one is returned then.
        """
        index = bisect_right(sizes, self.nbytes, key=lambda size: _nbytes(family(size)))
        if index or not strict:
            return sizes[max(0, index - 1)]
        raise BudgetError(f"found {self.nbytes:,.0f} bytes, the smallest arrays need {_nbytes(family(sizes[0])):,}")

    def nearest(self, family: Callable[[Size], object], sizes: Sequence[Size], source_bytes: float) -> Size:
        """Return the one of ``sizes`` whose compression of ``source_bytes`` is nearest to the requested one.

        This is the linear search of the paper's supplement (section 1.3), by bisection: larger arrays than the first
        ones beyond the budget only increase the difference. The first of two equally near ones is returned.
        """
        size = self.largest(family, sizes, strict=False)
        following = sizes[sizes.index(size) + 1 :][:1]
        wanted = source_bytes / self.nbytes
        return min((size, *following), key=lambda size: abs(wanted - source_bytes / _nbytes(family(size))))

    def paper_side(
        self, family: Callable[[int], Member], cells: int, dims: int, source_bytes: float, step: int = 4
    ) -> tuple[int, bool]:
        """Return the side of the paper's cascaded array for this budget, and whether its member meets the request.

        The search (supplement, section 1.3) is :meth:`nearest` over the sides in multiples of ``step``; the array has
        ``cells`` · side^``dims`` bytes. If the request is not met, the side is reduced until it takes at most half of
        the budget, so that the primary array can be resized beside it.
        """
        most = int((self.nbytes / cells) ** (1 / dims)) + 2 * step  # takes more than all bytes
        side = self.nearest(family, range(step, most + 1, step), source_bytes)
        if met := self.is_met(_nbytes(family(side))):
            return side, met
        while side > step and cells * side**dims > self.nbytes / 2:
            side -= step
        return side, met

    def approach(
        self, make: Callable[[float], Member], first: float, following: Callable[[float, Member], float],
        attempts: int = 8,
    ) -> Member:  # fmt: skip
        """Return the largest of a few members that fit, for a family that is costly to make.

        ``make(size)`` is called first with the size ``first``, then with ``following(size, member)`` of the one before.
        The search ends when a member fits within the tolerance, when a size comes again, or after ``attempts``. Raises
        :class:`BudgetError` if no member fits.
        """
        fitting, tried, size = [], {}, first
        while len(tried) < attempts and size not in tried:
            member = make(size)
            tried[size] = nbytes = _nbytes(member)
            if nbytes <= self.nbytes:
                fitting.append(member)
                if nbytes >= (1 - self.tolerance) * self.nbytes:
                    break
            size = following(size, member)
        if not fitting:
            least = min(tried.values())
            raise BudgetError(f"found {self.nbytes:,.0f} bytes, the smallest of {len(tried)} tried needs {least:,}")
        return max(fitting, key=_nbytes)


def _nbytes(member) -> float:
    """Return the bytes of a member of a family: a number, an object with ``nbytes``, or pairs of shape and bits."""
    if isinstance(member, (int, float, np.number)):
        return member
    return member.nbytes if hasattr(member, "nbytes") else array_bytes(member)
