"""Reflecting BSDF as an analytic proxy times a learned residual.

In the local frame, with the normal (0, 0, 1), directions ``wi`` and ``wo`` above the surface, their half vector h, and
the angle θ_d between h and either direction,

    f(wi, wo) = proxy(wi, wo) · (a + b C[P₁(u, v), P₂(v, w)])⁴,

where a and b map the range [0, 1] of the residual to the fourth roots of its factors. (A fourth power is nearly an
exponential over one step of a byte, and takes two products. Without a proxy, the factor is an exponential.)

The *proxy* is the sum of a Lambertian lobe with an edge term, ρ/π (1 + (e − 1)(1 − cos θ_i)⁵)(1 + (e − 1)(1 − cos
θ_o)⁵), and of two microfacet lobes D V F. D ∝ cos⁻⁴θ_h (1 + 2 tan²θ_h/(γα²))^−γ is Student's distribution of slopes
(Ribardière et al. 2017): GGX of roughness α for γ = 2, Beckmann's of roughness α/√2 for large γ. V is Smith's masking
of GGX over 4 cos θ_i cos θ_o, and F = F₀ + (F₉₀ − F₀)(1 − cos θ_d)⁵ with free F₀ and F₉₀.

The *residual* is an indirection (two primary arrays, one cascaded array) in three coordinates in [0, 1]:

- u = log(1 + t) / log(1 + 1/a²), t = h_x²/a_x² + h_y²/a_y², where a = α of the narrowest lobe: entries are dense in the
  peak;
- v = √(1 − cos θ_d), nearly linear in θ_d;
- w = cos²φ_d = (cos θ_i − cos θ_o)² / (4 sin²θ_h sin²θ_d), φ_d the azimuth of ``wi`` about h (Rusinkiewicz 1998).

None of them changes when ``wi`` and ``wo`` are exchanged: f is reciprocal, bit for bit but for rounding. Exchanging
them also maps φ_d to φ_d + π, so that w assumes in addition that f is symmetric about the plane of incidence
(``azimuth="mirror"``). With ``azimuth="half"``, w = φ_d/π mod 1 assumes reciprocity alone.

A *family* depends on up to three parameters p, such as roughness and metallic, each in its coordinate in [0, 1]:

    f(wi, wo; p) = proxy(wi, wo; p) · (a + b Σ_r m_r(p) C_r[P₁(u, v), P₂(v, w)])⁴.

The proxy has a table over the parameters: colours, and logarithms of roughnesses, exponents and edges, are interpolated
linearly. So are the logarithms of the roughnesses a by which u is scaled: entries of the residual are dense in the peak
of each member. The residual is a sum of R terms: the cascaded array holds all of them, 3R channels, and a table over
the parameters their factors m ∈ [-1, 1]. At fixed parameters, a family is a :class:`LearnedBSDF` whose numbers may
differ from lane to lane. A single BSDF is a family of no parameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays import fast_math
from ...arrays.budget import Budget
from ...arrays.indirection import DifferentiableArray, Indirection, device_array, rounded, unfolded
from ...arrays.lookup import clamp

#: Smallest roughness of a lobe, and smallest scale of the coordinate u.
ALPHA_MIN = 1e-3

#: Parameters of the proxy: 3 of the diffuse colour, 1 edge, and for each of two lobes α_u, α_v, γ/2, F₀ and F₉₀ (RGB).
DIFFUSE, EDGE, LOBE, PARAMETERS = slice(0, 3), 3, 9, 22

#: Parameters of the proxy that are roughnesses.
ROUGHNESSES = (4, 5, 4 + LOBE, 5 + LOBE)

#: Names of the proxy's terms.
TERMS = ("diffuse", "first", "second")

#: Logarithm below which a colour of the proxy counts as black.
BLACK = -9.0

#: Logarithms of the proxy's parameters are limited to this range.
LOGARITHMS = (-14.0, 5.0)

#: Names of the assumptions on f when the directions are exchanged.
AZIMUTHS = ("mirror", "half")

#: Most parameters of a family.
MOST_PARAMETERS = 3

#: Nodes of a coordinate (linear, logarithmic) in the table of a family's proxy, for one, two and three parameters.
PROXY_NODES = ((9, 9), (5, 9), (3, 8))

#: Nodes of a coordinate in a family's tables of sampling and energy.
SAMPLING_NODES = ((5, 9), (3, 7), (3, 5))

#: Number of terms R of a family's residual, for one, two and three parameters.
RANKS = (4, 4, 5)

#: Default size of the residual's arrays, for no, one, two and three parameters.
BYTES = ("2k", "4k", "9k", "12k")

#: First of the channels of a family's proxy table that hold the logarithms of (a_x, a_y); those before are the proxy's.
SCALE = PARAMETERS

#: Channels of a family's proxy table.
CHANNELS = PARAMETERS + 2

#: Channels of a family's proxy table that are interpolated as logarithms.
LOGARITHMIC_CHANNELS = (3, *(4 + k * LOBE + i for k in range(2) for i in range(3)), SCALE, SCALE + 1)


@dataclass(frozen=True)
class Form:
    """Form of a learned BSDF: what a file's settings say beyond its arrays.

    ``terms`` are those of the proxy (:data:`TERMS`; none: the residual alone). ``scale`` = (a_x, a_y) of the coordinate
    u, ``range`` the residuals that 0 and 1 in the cascaded array stand for. ``isotropic``: α_v of the lobes is α_u.
    ``angle``: azimuth of the axes of an anisotropic material, radians.
    """

    terms: tuple[str, ...] = TERMS
    isotropic: bool = True
    azimuth: str = "mirror"
    scale: tuple[float, float] = (0.1, 0.1)
    range: tuple[float, float] = (-1.0, 1.0)
    angle: float = 0.0

    def numbers(self, Float) -> list:
        """Return (1/a_x², 1/a_y², 1/log₂(1 + 1/a²)) of u, and start and step of the factors, as opaque numbers.

        Kernels then do not contain them, so that all fits and materials of a form share their kernels.
        """
        x, y = (a**-2 for a in self.scale)
        low, high = self.range
        start, step = fourth_roots(self.range) if self.terms else (low, high - low)
        return [dr.opaque(Float, float(v)) for v in (x, y, 1 / math.log2(1 + max(x, y)), start, step)]

    def to_json(self) -> dict:
        """Return the form as JSON."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}


@dataclass
class DirectionPair:
    """Terms that the proxy and the coordinates share; all are even in exchanging ``wi`` and ``wo``.

    ``hx2``, ``hy2`` and ``hz2`` are the squared components of the half vector, which sum to 1, and ``inverse_hz2`` the
    reciprocal of the last; ``cos_d`` = cos θ_d; ``schlick`` = (1 − cos θ_d)⁵.
    """

    wi: object
    wo: object
    half: object
    hx2: object
    hy2: object
    hz2: object
    inverse_hz2: object
    cos_d: object
    schlick: object

    @classmethod
    def of(cls, wi, wo) -> DirectionPair:
        half = half_vector(wi, wo)
        h2 = dr.squared_norm(half)
        inverse = dr.rcp(h2)
        cos_d = dr.minimum(0.5 * dr.sqrt(h2), 1)
        x, y, z = (dr.square(c) * inverse for c in half)
        # Lobes with γ < 2 are infinite at 0
        return cls(wi, wo, half, x, y, z, dr.rcp(dr.maximum(z, 1e-6)), cos_d, _fifth(1 - cos_d))


def half_vector(wi, wo):
    """Return wi + wo, or a short normal where directions cancel, which they can at the horizon."""
    half = wi + wo
    return dr.select(dr.squared_norm(half) > 1e-12, half, type(wi)(0, 0, 1e-6))


def _fifth(x):
    return dr.square(dr.square(x)) * x


@dataclass
class ProxyLobe:
    """Constants of a microfacet lobe: α² and 2/(γα²), γ, 1/(π α_u α_v), F₀ and F₉₀ − F₀."""

    squares: tuple
    slopes: tuple
    gamma: object
    peak: object
    f0: list
    edge: list

    @classmethod
    def from_parameters(cls, alphas: tuple, gamma, f0: list, f90: list) -> ProxyLobe:
        """Return the lobe of one or two roughnesses, an exponent, and colours of three arrays each."""
        squares, peak = tuple(map(dr.square, alphas)), dr.inv_pi * dr.rcp(alphas[0] * alphas[-1])
        slopes = tuple(2 * dr.rcp(gamma * square) for square in squares)
        edge = [grazing - normal for normal, grazing in zip(f0, f90, strict=True)]
        return cls(squares, slopes, gamma, peak, f0, edge)

    def value(self, g: DirectionPair) -> list:
        """Return D V F, three arrays."""
        # D = cos⁻⁴θ_h (q / cos²θ_h)^−γ, where q / cos²θ_h = 1 + 2 tan²θ_h / (γα²)
        if len(self.slopes) == 1:
            q = dr.fma(g.hx2 + g.hy2, self.slopes[0], g.hz2)
        else:
            q = dr.fma(g.hx2, self.slopes[0], dr.fma(g.hy2, self.slopes[1], g.hz2))
        power = fast_math.exp2(-self.gamma * fast_math.log2(q * g.inverse_hz2))
        denominator = masking(g.wi, *self.squares) * masking(g.wo, *self.squares)
        d = power * dr.square(g.inverse_hz2) * self.peak * dr.rcp(denominator)
        return [d * dr.fma(edge, g.schlick, normal) for normal, edge in zip(self.f0, self.edge, strict=True)]


def masking(w, square_u, square_v=None):
    """Return d(w), the denominator of Smith's masking G₁(w) = 2 cos θ / d(w), for one or two squared roughnesses."""
    z2 = dr.square(w.z)
    if square_v is None:
        return w.z + dr.sqrt(dr.fma(z2, 1 - square_u, square_u))
    return w.z + dr.sqrt(dr.fma(square_u, dr.square(w.x), dr.fma(square_v, dr.square(w.y), z2)))


@dataclass
class Proxy:
    """Analytic proxy: ``diffuse`` (three arrays, over π) and ``edge`` less 1, and lobes by name."""

    diffuse: list | None
    edge: object
    lobes: dict[str, ProxyLobe]

    @classmethod
    def from_logarithms(cls, logarithms: list, form: Form) -> Proxy:
        """Return the proxy of :data:`PARAMETERS` logarithms, arrays."""
        values = [dr.exp(clamp(x, *LOGARITHMS)) for x in logarithms]
        return cls.from_values(
            [dr.clip(v, ALPHA_MIN, 1) if k in ROUGHNESSES else v for k, v in enumerate(values)], form
        )

    @classmethod
    def from_values(cls, values: list, form: Form) -> Proxy:
        """Return the proxy of :data:`PARAMETERS` numbers, arrays, within their ranges."""
        lobes = {}
        for k, name in enumerate(TERMS[1:]):
            a = 4 + k * LOBE
            if name in form.terms:
                alphas = tuple(values[a : a + (1 if form.isotropic else 2)])
                colours = values[a + 3 : a + 6], values[a + 6 : a + 9]
                lobes[name] = ProxyLobe.from_parameters(alphas, 2 * values[a + 2], *colours)
        return cls.from_parts(values[DIFFUSE] if "diffuse" in form.terms else None, values[EDGE], lobes)

    @classmethod
    def from_parts(cls, diffuse: list | None, edge, lobes: dict[str, ProxyLobe]) -> Proxy:
        """Return the proxy of an albedo (``None``: no diffuse lobe), its factor at the horizon, and lobes."""
        if diffuse is not None:
            diffuse, edge = [dr.inv_pi * c for c in diffuse], edge - 1
        return cls(diffuse, edge, lobes)

    def value(self, g: DirectionPair) -> list:
        """Return the proxy, without the cosine, three arrays."""
        result = [0, 0, 0]
        if self.diffuse is not None:
            shape = dr.fma(self.edge, _fifth(1 - g.wi.z), 1) * dr.fma(self.edge, _fifth(1 - g.wo.z), 1)
            result = [colour * shape for colour in self.diffuse]
        for lobe in self.lobes.values():
            result = [a + b for a, b in zip(result, lobe.value(g), strict=True)]
        return result


@dataclass(frozen=True)
class Parameter:
    """Parameter of a family: its ``name`` as a property of the plugin, and its range.

    Its coordinate in [0, 1] is logarithmic if the ends of the range have a ratio of at least 4, else linear.
    """

    name: str
    low: float
    high: float

    @property
    def is_logarithmic(self) -> bool:
        """Whether the coordinate is logarithmic."""
        return self.low > 0 and self.high / self.low >= 4.0

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


def table_nodes(parameters: Sequence[Parameter], nodes: tuple) -> tuple[int, ...]:
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


def points(count: int, dims: int, seed: int) -> np.ndarray:
    """Return well-distributed coordinates in [0, 1], ``(count, dims)``; some lie on the ends."""
    root = (1.6180339887, 1.3247179572, 1.2207440846)[dims - 1]  # the R sequence (Roberts 2018)
    steps = root ** -np.arange(1.0, dims + 1)
    x = (np.random.default_rng(seed).random(dims) + np.arange(1, count + 1)[:, None] * steps) % 1
    return np.clip(1.08 * x - 0.04, 0, 1)


def opaque_numbers(types, numbers) -> list:
    """Return numbers, as of the parameters of one member, as arrays that no kernel contains."""
    return [dr.opaque(types.Float, float(x)) for x in numbers]


class BSDFArrays(nn.Module):
    """Arrays of a learned BSDF, for training.

    ``residual`` is an :class:`.Indirection` of three coordinates, or one array that is read at them (``None``: the
    proxy alone); ``proxy`` holds the logarithms of the proxy's parameters, divided by ``rate``, as an array ``(22, 1)``
    (``None``: no proxy). Of a family, ``proxy`` is a table over the parameters with :data:`CHANNELS` logarithms, and
    ``mixing`` that of the factors of the residual's terms.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "residual": nn.Module, "proxy": DifferentiableArray, "mixing": DifferentiableArray, "rate": float,
    }  # fmt: skip

    def __init__(self, residual=None, proxy=None, mixing=None, rate: float = 1.0):
        self.residual, self.proxy, self.mixing, self.rate = residual, proxy, mixing, rate

    def _alloc(self, dtype, size=-1, rng=None):
        parts = [None if p is None else p._alloc(dtype)[0] for p in (self.residual, self.proxy, self.mixing)]
        return BSDFArrays(*parts, self.rate), 3

    def logarithms(self, lanes: int = 1) -> list:
        """Return the logarithms of the parameters of a single proxy, as arrays of ``lanes`` equal numbers each.

        With a number for each sample, one kernel sums all gradients; a number for all samples takes one each.
        """
        entries = self.proxy.data.array
        index = dr.uint32_array_t(type(entries))
        return [self.rate * dr.gather(type(entries), entries, dr.full(index, i, lanes)) for i in range(PARAMETERS)]

    def proxy_table(self) -> DifferentiableArray:
        """Return the table of a family's proxy as it is interpolated: colours, and logarithms of all else."""
        entries, stored = self.proxy.data.array * self.rate, self.proxy.data.shape[-1]
        flags = np.resize([channel in LOGARITHMIC_CHANNELS for channel in range(stored)], len(entries))
        logarithmic = device_array(dr.uint32_array_t(type(entries)), flags) > 0
        result = self.proxy.copy()
        values = dr.select(logarithmic, entries, dr.exp(clamp(entries, *LOGARITHMS)))
        result.data = type(self.proxy.data)(values, self.proxy.data.shape)
        return result

    def at(self, form: Form, coordinates: Sequence = (), is_rounded: bool = True, lanes: int = 1) -> LearnedBSDF:
        """Return the BSDF, or the members of the family at ``coordinates``.

        Entries of the residual are rounded to bytes, or only folded. ``lanes``: see :meth:`logarithms`.
        """
        residual, mixing = self.residual, self.mixing
        if residual is not None and not is_rounded:
            residual, mixing = unfolded(residual), unfolded(mixing)
        elif residual is not None:
            residual = rounded(residual) if isinstance(residual, Indirection) else residual.rounded(8)
            mixing = None if mixing is None else mixing.rounded(8)
        if len(coordinates):
            return member(form, self.proxy_table(), residual, mixing, None, coordinates)
        proxy = None if self.proxy is None else Proxy.from_logarithms(self.logarithms(lanes), form)
        return LearnedBSDF(form, residual, proxy)


class LearnedBSDF:
    """BSDF of arrays.

    ``residual`` is any function of a list of three coordinates, or ``None``; ``proxy`` may be ``None``, too. ``energy``
    is an array of s(θ) ≤ 1, read at √cos θ: f is multiplied by s(θ_i) s(θ_o), which limits the albedo and keeps
    reciprocity (``None``: 1). Of a family's members, ``scale`` has the roughnesses that scale u, (a_x, a_y) or one for
    both, arrays (``None``: those of the form). ``numbers`` are those of the form (:meth:`Form.numbers`; ``None``: made
    when they are needed, which a symbolic loop does not allow).
    """

    def __init__(
        self, form: Form, residual, proxy: Proxy | None, energy=None, scale: tuple | None = None,
        numbers: Sequence | None = None,
    ):  # fmt: skip
        self.form, self.residual, self.proxy, self.energy, self.scale = form, residual, proxy, energy, scale
        self.numbers = numbers
        #: Terms of u that the scale of a member determines.
        self.terms = None
        if scale is not None:
            x, y = (dr.rcp(dr.square(a)) for a in (scale[0], scale[-1]))
            self.terms = x, y, dr.rcp(dr.log2(1 + dr.maximum(x, y)))

    def coordinates(self, g: DirectionPair) -> list:
        """Return u, v and w."""
        x, y, inverse = self.terms or self._form_numbers(type(g.cos_d))[:3]
        u = dr.minimum(fast_math.log2(1 + dr.fma(g.hx2, x, g.hy2 * y)) * inverse, 1)
        return [u, dr.sqrt(1 - g.cos_d), coordinate_w(g, self.form)]

    def _form_numbers(self, Float) -> Sequence:
        self.numbers = self.numbers or self.form.numbers(Float)
        return self.numbers

    def cosine_value(self, wi, wo) -> list:
        """Return f cos θ_o, three arrays, for unit directions above the surface."""
        return [v * wo.z for v in self.value(wi, wo)]

    def value(self, wi, wo, active=True) -> list:
        """Return f without the cosine, three arrays, for unit directions above the surface."""
        g = DirectionPair.of(rotate(wi, -self.form.angle), rotate(wo, -self.form.angle))
        result = [1, 1, 1] if self.proxy is None else self.proxy.value(g)
        if self.energy is not None:
            scale = dr.prod([self.energy([dr.sqrt(w.z)], active)[0] for w in (wi, wo)])
            result = [scale * v for v in result]
        if self.residual is None:
            return result
        # Of families, range and factors are part of kernels
        low, step = fourth_roots(self.form.range) if self.terms else self._form_numbers(type(wi.z))[3:]
        numbers = [dr.fma(x, step, low) for x in self.residual(self.coordinates(g), active)]
        # Without a proxy a wide range, of which a fourth power would leave few steps to small values
        factors = [dr.exp(x) if self.proxy is None else dr.square(dr.square(x)) for x in numbers]
        return [a * b for a, b in zip(result, factors, strict=True)]


def member(form: Form, table, residual, mixing, energy, coordinates: list, active=True) -> LearnedBSDF:
    """Return the members of a family at ``coordinates``, arrays.

    ``table`` is that of the proxy, ``mixing`` the factors of the residual's terms, and ``energy`` an array of the
    scale of energy over the cosine's coordinate and those of the parameters (``None``: 1).
    """
    numbers = table(coordinates, active)
    proxy, scale = member_proxy(numbers, form)

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

    read = None if residual is None else combined
    return LearnedBSDF(form, read, proxy, None if energy is None else limit, scale)


def member_proxy(numbers: list, form: Form) -> tuple[Proxy, tuple]:
    """Return the proxy and the scale (a_x, a_y) of :data:`CHANNELS` numbers of a proxy's table, limited to finite."""
    low, high = (math.exp(x) for x in LOGARITHMS)
    values = [clamp(x, low, high) for x in numbers]
    for channel in LOGARITHMIC_CHANNELS:
        is_roughness = channel in ROUGHNESSES or channel >= SCALE
        limits = (math.log(ALPHA_MIN), 0.0) if is_roughness else LOGARITHMS
        values[channel] = dr.exp(clamp(numbers[channel], *limits))
    return Proxy.from_values(values, form), tuple(values[SCALE : SCALE + (1 if form.isotropic else 2)])


def widths(proxy: Proxy, scale: tuple) -> list:
    """Return the roughness of GGX lobes about as wide as both lobes of a proxy; a missing one: 4 times ``scale``."""
    result = []
    for name in TERMS[1:]:
        lobe = proxy.lobes.get(name)
        wide = dr.minimum(4 * scale[0], 1) if lobe is None else dr.sqrt(lobe.squares[0])
        result.append(dr.detach(clamp(wide, ALPHA_MIN, 1.0)))
    return result


def rotate(w, angle: float):
    """Return directions after a rotation about the normal."""
    if not angle:
        return w
    return turn(w, math.sin(angle), math.cos(angle))


def turn(w, sin, cos):
    """Return directions after a rotation about the normal by the angle of a sine and a cosine."""
    return type(w)(dr.fma(cos, w.x, -sin * w.y), dr.fma(sin, w.x, cos * w.y), w.z)


def fourth_roots(limits: tuple[float, float]) -> tuple[float, float]:
    """Return the fourth root of the least factor, and how much larger that of the largest is."""
    low, high = (math.exp(x / 4) for x in limits)
    return low, high - low


def coordinate_w(g: DirectionPair, form: Form):
    """Return w, the coordinate of the azimuth φ_d; where it is undefined, any number that reads as one in [0, 1]."""
    sin2_h, sin2_d = g.hx2 + g.hy2, 1 - dr.square(g.cos_d)
    if form.azimuth == "mirror":
        return dr.square(g.wi.z - g.wo.z) * dr.rcp(dr.maximum(4 * sin2_h * sin2_d, 1e-12))
    # tan φ_d from components of wi along the tangents of h: towards the normal, and perpendicular to both
    along = 0.5 * (g.wo.z - g.wi.z)
    across = (g.wo.x * g.wi.y - g.wo.y * g.wi.x) * 0.5 * dr.rcp(dr.maximum(g.cos_d, 1e-6))
    defined = (sin2_h > 1e-12) & (sin2_d > 1e-12)
    turn = dr.atan2(across, along) * dr.inv_pi
    turn = turn - dr.floor(turn)
    return dr.select(defined & (turn < 1), turn, 0)


@dataclass(frozen=True)
class ResidualSizes:
    """Sizes of the arrays: entries of P₁ (u, v), P₂ (v, w) and C; without primaries, of C (u, v, w) alone.

    Of a family, C has ``rank`` terms, and ``mixing`` has the nodes of the table of their factors.
    """

    first: tuple[int, int] | None = (14, 9)
    second: tuple[int, int] | None = (8, 6)
    cascaded: tuple[int, int, int] = (14, 8, 5)
    mixing: tuple[int, ...] = ()
    rank: int = 1

    @property
    def nbytes(self) -> int:
        """Bytes of all entries."""
        factors = math.prod(self.mixing) if self.mixing else 0
        total = self.rank * (3 * math.prod(self.cascaded) + factors)
        return total if self.first is None else total + 2 * math.prod(self.first) + math.prod(self.second)

    def to_json(self) -> dict:
        """Return the sizes as JSON."""
        sizes = {"first": self.first, "second": self.second, "cascaded": self.cascaded}
        return {"sizes": sizes, "mixing": self.mixing, "rank": self.rank} if self.mixing else sizes

    def arrays(self, start: float, azimuth: str = "mirror"):
        """Return the residual and the factors of its terms, not yet allocated.

        The primary arrays start as the identity, the cascaded one at ``start`` (in [0, 1]); of a family, nearly so.
        """
        border, cascaded, mixing = ("clamp", "clamp", "repeat" if azimuth == "half" else "clamp"), start, None
        if self.mixing:
            rng = np.random.default_rng(0)
            cascaded = start + rng.uniform(-0.05, 0.05, (*self.cascaded, 3 * self.rank))
            factors = 0.5 + 0.15 * rng.standard_normal((*self.mixing, self.rank))
            factors[..., 0] = 0.9
            factors = np.clip(factors, 0.05, 0.95).astype(np.float32)
            mixing = DifferentiableArray(self.mixing, self.rank, factors, fold=True)
        values = ("constant", start) if mixing is None else (cascaded.astype(np.float32),)
        cascaded = DifferentiableArray(self.cascaded, 3 * self.rank, *values, fold=True, border=border)
        if self.first is None:
            return cascaded, mixing
        second = np.broadcast_to(np.linspace(0, 1, self.second[1])[None, :, None], (*self.second, 1))
        if azimuth == "half":  # w wraps around: its primary stays below the end of the cascaded array's period
            second = second * (1 - 1 / self.second[1])
        primary = [
            DifferentiableArray(self.first, 2, "ramp", fold=True),
            DifferentiableArray(self.second, 1, second.astype(np.float32), fold=True, border=(border[0], border[2])),
        ]
        return Indirection(primary, cascaded, [(0, 1), (1, 2)]), mixing


def sizes_within(nbytes: int, parameters: Sequence[Parameter] = (), plain: bool = False) -> ResidualSizes:
    """Return the largest arrays of the default's proportions within ``nbytes``. Raises :class:`.BudgetError`.

    ``parameters`` are those of a family; ``plain``: a single array, without primaries.
    """
    mixing = table_nodes(parameters, PROXY_NODES) if parameters else ()
    rank = RANKS[len(parameters) - 1] if parameters else 1
    first_scale, power, proportions = (0.15, 0.5, (14, 8, 6)) if parameters else (0.2, 0.75, (14, 9 if plain else 8, 5))

    def sizes(step: int) -> ResidualSizes:
        scale = first_scale * 1.02**step
        cascaded = tuple(max(2, round(n * scale)) for n in proportions)
        first, second = (tuple(max(2, round(n * scale**power)) for n in pair) for pair in ((14, 9), (8, 6)))
        return ResidualSizes(*(None, None) if plain else (first, second), cascaded, mixing, rank)

    return sizes(Budget(nbytes).largest(sizes, range(400)))
