"""Task 1: the isotropic GGX distribution of normals, read from arrays (supplemental 1.1).

The reference is Trowbridge and Reitz's distribution (Walter et al. 2007, equation 33) with the normal (0, 0, 1),

    D(h) = α² / (π q²),   q = sin²θ_h + α² cos²θ_h,

whose peak 1/(π α²) is unbounded: 0.3 at α = 1, 318,310 at α = 0.001. An :class:`Encoding` therefore maps entries to D.
Its choice matters more than the sizes and the training of the arrays:

``"tables"`` (default)
    *Inputs* on logarithmic axes: v = 1 + log α / log(1/α_min) and u = 1 + log(sin²θ_h (1 − ε) + ε) / log(1/ε) with ε =
    α_min²/4. Every decade of roughness gets the same number of entries, and the same resolution within its peak: in
    units of α, all peaks look alike. *Output* y = (D / D_peak)^¼ = α/√q, which lies in (0, 1]: the peak is 1 whatever
    α is, so the relative error of D at the peak is 4 times the error of an entry, at any roughness. The error measure
    is the mean absolute error of y. Half of the training samples follow the cosine-weighted hemisphere, three
    eighths are distributed as the peak itself, and one eighth lies at its very centre, which a cosine-weighted draw
    never sees (at α = 0.001 one sample in a million comes close).

    *The tail* is continued: an error of 0.005 in y says nothing about a D of 10⁻⁹ D_peak, which is what most of the
    hemisphere sees of a narrow lobe. But all tails fall alike. Where sin²θ_h > 8 α², beyond 8/9 of the projected area
    of the normals, D is what is read at 8 α², times the ratio of the 1/q²; also below α_min, where nothing was learned.
    D is then nowhere more than 1.1 times what it should be, and the PSNR rises from 52.4 to 58.2 dB.

``"paper"``
    *Inputs* cos θ_h and α as they are, *output* D as it is, mean absolute error, cosine-weighted samples: the
    supplement's recipe. It misses the peak at low roughness: an entry is 1/15 wide, the peak α².

Roughness is drawn from an exponential-like distribution, as for the Disney BRDF, and clamped to α ≥ 0.001.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...arrays.indirection import DifferentiableArray, Indirection
from ...arrays.lookup import clamp

#: Smallest roughness that is learned. A smaller one is read here, at an angle that is scaled accordingly.
ALPHA_MIN = 1e-3

#: Smallest roughness that is accepted, as in Mitsuba's ``MicrofacetDistribution``.
ALPHA_FLOOR = 1e-4

#: Multiple of α² beyond which, in sin²θ_h, the distribution is not read but continued: it falls like 1/q².
TAIL = 8

#: Largest value that a table can yield, as a multiple of the peak, whatever its entries.
PEAKS = 16

INPUTS, OUTPUTS = ("logarithmic", "plain"), ("root", "raw")


def ggx(sin2, alpha):
    """Return D per solid angle of normals, from sin²θ_h and α in [0, 1] (α > 0); exact also next to the peak."""
    a2 = dr.square(alpha)
    q = dr.fma(1 - sin2, a2, sin2)
    return a2 / (dr.pi * dr.square(q))


@dataclass(frozen=True)
class Encoding:
    """Mapping of (θ_h, α) to the coordinates of a read, and of the value that is read to D; see the module.

    ``inputs`` is ``"logarithmic"`` or ``"plain"``, ``output`` is ``"root"`` or ``"raw"``.
    """

    inputs: str = "logarithmic"
    output: str = "root"

    def __post_init__(self):
        if self.inputs not in INPUTS or self.output not in OUTPUTS:
            raise ValueError(f"found the encoding {self}, allowed are inputs {INPUTS} and outputs {OUTPUTS}")

    def coordinate_alpha(self, alpha):
        """Return the coordinate in [0, 1] of α ≥ :data:`ALPHA_FLOOR`."""
        if self.inputs == "plain":
            return alpha
        return dr.fma(dr.log2(dr.maximum(alpha, ALPHA_MIN)), -1 / math.log2(ALPHA_MIN), 1)

    def stretch(self, alpha):
        """Return the factor ≥ 1 by which sin²θ_h is stretched, since nothing below :data:`ALPHA_MIN` is learned."""
        if self.inputs == "plain":
            return 1
        return dr.square(dr.maximum(ALPHA_MIN * dr.rcp(alpha), 1))

    def coordinate_normal(self, cos, sin2, stretch=1, limit=1):
        """Return the coordinate in [0, 1] of the half vector's angle, from cos θ_h ≥ 0 and sin²θ_h.

        The stretched squared sine is limited to ``limit``.
        """
        if self.inputs == "plain":
            return cos
        ε = ALPHA_MIN**2 / 4
        return dr.fma(dr.log2(dr.fma(dr.minimum(sin2 * stretch, limit), 1 - ε, ε)), -1 / math.log2(ε), 1)

    def coordinates(self, cos, sin2, alpha) -> list:
        """Return both coordinates: of the normal and of α."""
        return [self.coordinate_normal(cos, sin2, self.stretch(alpha)), self.coordinate_alpha(alpha)]

    def encode(self, d, alpha):
        """Return the value that arrays should hold for the distribution ``d``."""
        return d if self.output == "raw" else dr.sqrt(dr.sqrt(d * (dr.pi * dr.square(alpha))))

    def decode(self, y, peak):
        """Return D for the value ``y`` that was read and ``peak`` = 1/(π α²).

        D is limited to 0 to :data:`PEAKS` times ``peak``; NaN becomes 0.
        """
        if self.output == "raw":
            return clamp(y, 0, PEAKS * peak)
        return dr.square(dr.square(clamp(y, 0, PEAKS**0.25))) * peak


#: The encoding of each preset.
ENCODINGS = {"tables": Encoding(), "paper": Encoding("plain", "raw")}


@dataclass
class Roughness:
    """Terms of a read of the distribution that depend on α alone.

    ``alpha2`` = α²; ``peak`` = 1/(π α²); ``stretch`` and ``limit`` of sin²θ_h; ``tail``, the q at which the tail begins
    (``None``: no tail); and either ``coordinate``, that of α, or ``net``, the function of the other coordinate that
    remains for a constant α.
    """

    alpha2: Any
    peak: Any
    stretch: Any
    limit: Any = 1
    tail: Any = None
    coordinate: Any = None
    net: Callable | None = None


class LearnedGGX:
    """Distribution read from ``net``, any function from a list of two coordinates in [0, 1] to a list of one array.

    ``net`` may be an :class:`.Indirection`, a single array or a network. Without ``tail``, all
    of the distribution is read, as in training.
    """

    def __init__(self, net: Callable, encoding: Encoding, tail: bool = True):
        self.net, self.encoding = net, encoding
        self.tail = tail and encoding.inputs != "plain"

    def roughness(self, alpha) -> Roughness:
        """Return the terms that depend on α alone; α is clamped to [:data:`ALPHA_FLOOR`, 1], NaN to the lower end."""
        alpha = clamp(alpha, ALPHA_FLOOR, 1)
        alpha2, e = dr.square(alpha), self.encoding
        terms = Roughness(alpha2, dr.rcp(dr.pi * alpha2), e.stretch(alpha), coordinate=e.coordinate_alpha(alpha))
        if self.tail:
            reach = dr.minimum(TAIL * alpha2, 1)
            terms.limit, terms.tail = reach * terms.stretch, dr.fma(reach, 1 - alpha2, alpha2)
        return terms

    def constant_roughness(self, alpha) -> Roughness:
        """Return :meth:`roughness` of an α that is one number.

        An indirection's primary array is reduced to one row: two entries to read instead of four.
        """
        terms = self.roughness(alpha)
        if isinstance(self.net, Indirection):
            row = self.net.primary[0].at(terms.coordinate)
            terms.net, terms.coordinate = Indirection(row, self.net.cascaded), None
        return terms

    def read(self, r: Roughness, cos, sin2, active=True):
        """Return D per solid angle of normals, from cos θ_h ≥ 0 and sin²θ_h."""
        x = [self.encoding.coordinate_normal(cos, sin2, r.stretch, r.limit)]
        y = self.net([*x, r.coordinate], active) if r.net is None else r.net(x, active)
        d = self.encoding.decode(y[0], r.peak)
        if r.tail is None:
            return d
        q = dr.fma(1 - sin2, r.alpha2, sin2)
        return d * dr.select(q > r.tail, dr.square(r.tail * dr.rcp(q)), 1)

    def __call__(self, cos, sin2, alpha):
        """Return D per solid angle of normals, from cos θ_h, sin²θ_h and α."""
        return self.read(self.roughness(alpha), cos, sin2)


def indirection(primary: int = 16, cascaded: int = 8) -> Indirection:
    """Return the arrays of task 1, not yet allocated. Raises ``ValueError``.

    The primary array has ``primary``² × 2 entries and starts as the undistorted uv ramp; the cascaded array has
    ``cascaded``² × 1 entries, starts at 0.5 and has no non-linearity on its output.
    """
    for name, n in (("primary", primary), ("cascaded", cascaded)):
        if not 2 <= n <= 4096:
            raise ValueError(f"{name}: found {n}, allowed are 2 to 4096 entries a side")
    return Indirection(
        DifferentiableArray((primary, primary), 2, "ramp", fold=True),
        DifferentiableArray((cascaded, cascaded), 1, "constant", 0.5),
    )
