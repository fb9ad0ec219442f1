"""Family of BSDFs: a learned BSDF that depends on up to three parameters, such as roughness and metallic.

For parameters p, each in its coordinate in [0, 1],

    f(wi, wo; p) = proxy(wi, wo; p) · (1 + Σ_r m_r(p) L_r[P₁(u, v), P₂(v, w)])⁴.

- The *proxy* (:mod:`.model`) has a table over the parameters: colours, and logarithms of roughnesses, exponents and
  edges, are interpolated linearly. So are the logarithms of the roughnesses a by which u is scaled: entries of the
  residual are dense in the peak of each member.
- The *residual* is a sum of R terms. The cascaded array holds all of them, 3R channels, and a table over the
  parameters their factors m ∈ [-1, 1].

At fixed parameters, a family is a :class:`.model.LearnedBSDF` whose numbers may differ from lane to lane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays.indirection import DifferentiableArray, Indirection, device_array, rounded, unfolded
from ...arrays.lookup import clamp
from .model import (
    ALPHA_MIN,
    LOBE,
    LOGARITHMS,
    PARAMETERS,
    TERMS,
    DirectionPair,
    Form,
    LearnedBSDF,
    Proxy,
    ProxyLobe,
    fourth_roots,
)
from .model import ResidualSizes as Sizes

#: Most parameters of a family.
MOST = 3

#: Ratio of the ends of a range from which on its coordinate is logarithmic.
LOGARITHMIC = 4.0

#: Nodes of a coordinate (linear, logarithmic), for one, two and three parameters: in the table of the proxy,
#: and in those of sampling and energy.
PROXY_NODES, SAMPLING_NODES = ((9, 9), (5, 9), (3, 8)), ((5, 9), (3, 7), (3, 5))

#: Number of terms R of a residual, and default size of its arrays in bytes, for one, two and three parameters.
RANKS, SIZES = (4, 4, 5), ("4k", "9k", "12k")

#: Channels of the proxy's table: its parameters, and the logarithms of (a_x, a_y).
CHANNELS, SCALE = PARAMETERS + 2, PARAMETERS

#: Channels that are interpolated as logarithms.
LOGARITHMIC_CHANNELS = (3, *(4 + k * LOBE + i for k in range(2) for i in range(3)), SCALE, SCALE + 1)


@dataclass(frozen=True)
class Parameter:
    """Parameter of a family: its ``name`` as a property of the plugin, and its range.

    Its coordinate in [0, 1] is logarithmic if the range spans a ratio of at least :data:`LOGARITHMIC`, else linear.
    """

    name: str
    low: float
    high: float

    @property
    def is_logarithmic(self) -> bool:
        """Whether the coordinate is logarithmic."""
        return self.low > 0 and self.high / self.low >= LOGARITHMIC

    @property
    def middle(self) -> float:
        """Value whose coordinate is 0.5."""
        return self.value(0.5)

    def value(self, coordinate: float) -> float:
        """Return the value of a coordinate."""
        if self.is_logarithmic:
            return self.low * (self.high / self.low) ** coordinate
        return self.low + (self.high - self.low) * coordinate

    def coordinate(self, value):
        """Return the coordinate of an array of values; values outside the range count as its ends, NaN as the lower."""
        if self.is_logarithmic:
            position = dr.log2(value * (1 / self.low)) * (1 / math.log2(self.high / self.low))
        else:
            position = (value - self.low) * (1 / (self.high - self.low))
        return clamp(position, 0.0, 1.0)

    def to_json(self) -> dict:
        """Return the parameter as JSON."""
        return {"name": self.name, "low": self.low, "high": self.high}


def nodes_of(parameters: list[Parameter], nodes: tuple) -> tuple[int, ...]:
    """Return the nodes of a table over parameters, of :data:`PROXY_NODES` or :data:`SAMPLING_NODES`."""
    linear, logarithmic = nodes[len(parameters) - 1]
    return tuple(logarithmic if p.is_logarithmic else linear for p in parameters)


def grid(nodes: tuple[int, ...]) -> np.ndarray:
    """Return the coordinates of all nodes, ``(N, d)``, the last axis fastest."""
    axes = np.meshgrid(*(np.linspace(0, 1, n) for n in nodes), indexing="ij")
    return np.stack([a.ravel() for a in axes], axis=-1)


def interpolation(coordinates, nodes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the nodes around coordinates, the last axis fastest, and their weights above 0."""
    index, weight = np.zeros(1, int), np.ones(1)
    for x, n in zip(coordinates, nodes, strict=True):
        position = float(x) * (n - 1)
        lower = min(int(position), n - 2)
        ends = np.array([1 - (position - lower), position - lower])
        index = (index[:, None] * n + lower + np.arange(2)).ravel()
        weight = (weight[:, None] * ends).ravel()
    return index[weight > 0], weight[weight > 0]


@dataclass(frozen=True)
class FamilySizes:
    """Sizes of the arrays of a residual: P₁, P₂ and one of the R terms; and nodes of the table of factors."""

    sizes: Sizes
    mixing: tuple[int, ...]
    rank: int

    @property
    def nbytes(self) -> int:
        """Bytes of all entries."""
        s = self.sizes
        primaries = 2 * math.prod(s.first) + math.prod(s.second)
        return primaries + self.rank * (3 * math.prod(s.cascaded) + math.prod(self.mixing))

    def arrays(self, start: float, azimuth: str) -> tuple[Indirection, DifferentiableArray]:
        """Return the residual's indirection and the factors, not yet allocated: nearly zero everywhere."""
        s = self.sizes.residual(start, azimuth)
        rng = np.random.default_rng(0)
        shape = (*s.cascaded.resolution, 3 * self.rank)
        entries = (start + rng.uniform(-0.05, 0.05, shape)).astype(np.float32)
        cascaded = DifferentiableArray(s.cascaded.resolution, shape[-1], entries, fold=True, border=s.cascaded.border)
        factors = 0.5 + 0.15 * rng.standard_normal((*self.mixing, self.rank))
        factors[..., 0] = 0.9
        mixing = DifferentiableArray(
            self.mixing, self.rank, np.clip(factors, 0.05, 0.95).astype(np.float32), fold=True
        )  # fmt: skip
        return Indirection(s.primary, cascaded, s.inputs), mixing


def sizes_of(nbytes: int, parameters: list[Parameter]) -> FamilySizes:
    """Return the largest arrays within ``nbytes``. Raises ``ValueError``."""
    mixing, rank, best = nodes_of(parameters, PROXY_NODES), RANKS[len(parameters) - 1], None
    for step in range(400):
        scale = 0.15 * 1.02**step
        cascaded = tuple(max(2, round(n * scale)) for n in (14, 8, 6))
        first, second = (tuple(max(2, round(n * scale**0.5)) for n in pair) for pair in ((14, 9), (8, 6)))
        sizes = FamilySizes(Sizes(first, second, cascaded), mixing, rank)
        if sizes.nbytes <= nbytes:
            best = sizes
        elif best is None:
            raise ValueError(f"found {nbytes} bytes, the smallest arrays of this family need {sizes.nbytes}")
    return best


class FamilyArrays(nn.Module):
    """Arrays of a family, for training.

    ``proxy`` is a table over the parameters with :data:`CHANNELS` logarithms, divided by ``rate``; ``residual`` and
    ``mixing`` are those of :meth:`FamilySizes.arrays` (``None``: the proxy alone).
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "proxy": DifferentiableArray, "residual": nn.Module, "mixing": DifferentiableArray, "rate": float,
    }  # fmt: skip

    def __init__(self, proxy=None, residual=None, mixing=None, rate: float = 1.0):
        self.proxy, self.residual, self.mixing, self.rate = proxy, residual, mixing, rate

    def _alloc(self, dtype, size=-1, rng=None):
        parts = [None if p is None else p._alloc(dtype)[0] for p in (self.proxy, self.residual, self.mixing)]
        return FamilyArrays(*parts, self.rate), 3

    def proxy_table(self) -> DifferentiableArray:
        """Return the table of the proxy as it is interpolated: colours, and logarithms of all else."""
        entries, stored = self.proxy.data.array * self.rate, self.proxy.data.shape[-1]
        flags = np.resize([channel in LOGARITHMIC_CHANNELS for channel in range(stored)], len(entries))
        logarithmic = device_array(dr.uint32_array_t(type(entries)), flags) > 0
        result = self.proxy.copy()
        values = dr.select(logarithmic, entries, dr.exp(clamp(entries, *LOGARITHMS)))
        result.data = type(self.proxy.data)(values, self.proxy.data.shape)
        return result

    def at(self, form: Form, coordinates: list, is_rounded: bool) -> LearnedBSDF:
        """Return the members of the family at ``coordinates``, with entries that are rounded to bytes, or folded."""
        residual, mixing = self.residual, self.mixing
        if residual is not None:
            residual = rounded(residual) if is_rounded else unfolded(residual)
            mixing = mixing.rounded(8) if is_rounded else mixing.unfolded()
        return member(form, self.proxy_table(), residual, mixing, None, coordinates)


class FamilyMember(LearnedBSDF):
    """Learned BSDF whose u is scaled by roughnesses ``scale``, (a_x, a_y) or one for both, arrays."""

    def __init__(self, form: Form, residual, proxy: Proxy, energy, scale: tuple):
        super().__init__(form, residual, proxy, energy)
        self.scale = scale
        x, y = (dr.rcp(dr.square(a)) for a in (scale[0], scale[-1]))
        #: Terms of u that the scale determines.
        self.terms = x, y, dr.rcp(dr.log2(1 + dr.maximum(x, y)))

    def coordinates(self, g: DirectionPair) -> list:
        _, v, w = super().coordinates(g)
        x, y, inverse = self.terms
        t = dr.fma(g.hx2, x, g.hy2 * y)
        return [dr.minimum(dr.log2(1 + t) * inverse, 1), v, w]


def member(form: Form, table, residual, mixing, energy, coordinates: list, active=True) -> FamilyMember:
    """Return the members of a family at ``coordinates``, arrays.

    ``table`` is that of the proxy, ``mixing`` the factors of the residual's terms, and ``energy`` an array of the
    scale of energy over the cosine's coordinate and those of the parameters (``None``: 1).
    """
    numbers = table(coordinates, active)
    proxy, scale = proxy_of(numbers, form)

    def combined(x, active=True):
        low, step = fourth_roots(form.range)
        start = (1 - low) / step
        factors = [2 * m - 1 for m in mixing(coordinates, active)]
        values, result = residual(x, active), []
        for k in range(3):
            terms = zip(factors, values[k::3], strict=True)
            result.append(clamp(sum((m * (value - start) for m, value in terms), start), 0, 1))
        return result

    def limit(x, active=True):
        return energy([*x, *coordinates], active)

    return FamilyMember(
        form, None if residual is None else combined, proxy, None if energy is None else limit, scale
    )  # fmt: skip


def proxy_of(numbers: list, form: Form) -> tuple[Proxy, tuple]:
    """Return the proxy and the scale (a_x, a_y) of :data:`CHANNELS` numbers of a proxy's table, limited to finite."""
    low, high = (math.exp(x) for x in LOGARITHMS)

    def roughness(channel):
        channels = (channel,) if form.isotropic else (channel, channel + 1)
        return tuple(dr.exp(clamp(numbers[c], math.log(ALPHA_MIN), 0.0)) for c in channels)

    def shape(channel):
        return dr.exp(clamp(numbers[channel], *LOGARITHMS))

    lobes = {}
    for k, name in enumerate(TERMS[1:]):
        a = 4 + k * LOBE
        if name in form.terms:
            colours = [[clamp(c, low, high) for c in numbers[i : i + 3]] for i in (a + 3, a + 6)]
            lobes[name] = ProxyLobe(roughness(a), 2 * shape(a + 2), *colours)
    diffuse = [clamp(c, low, high) for c in numbers[:3]] if "diffuse" in form.terms else None
    return Proxy.of_parts(diffuse, shape(3), lobes), roughness(SCALE)


def widths(proxy: Proxy, scale: tuple) -> list:
    """Return the roughness of GGX lobes about as wide as both lobes of a proxy; a missing one: 4 times ``scale``."""
    result = []
    for name in TERMS[1:]:
        lobe = proxy.lobes.get(name)
        wide = dr.minimum(4 * scale[0], 1) if lobe is None else dr.sqrt(lobe.squares[0])
        result.append(dr.detach(clamp(wide, ALPHA_MIN, 1.0)))
    return result
