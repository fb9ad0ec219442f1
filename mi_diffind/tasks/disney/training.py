"""Training of the Disney tables: distributions, per-factor targets, errors, and table files.

Each factor is learned against its own analytic target, because the product of all of them is unbounded and dominated
by the specular peak (supplemental 1.2). View and light directions are uniform over the hemisphere,
metallic and roughness exponential-like (many low values), the rest uniform.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...arrays.lookup import STORAGES
from ...arrays.tables import Table, TableError, check_ranges, load_table
from ...fitting.loop import Problem, exponential_like
from ...fitting.task import Model
from . import model
from .arrays import DisneyArrays
from .decoder import Decoder, Lobe
from .factored import FactoredArrays, FactoredDecoder
from .model import PARAMETERS, Effects, Material, compose, exact_factors
from .paper import PaperArrays, PaperDecoder

#: Luminance weights of linear sRGB, as ``mi.luminance``.
LUMINANCE = (0.212671, 0.715160, 0.072169)


def uniform_hemisphere(types, u, v):
    """Return a unit vector (``Array3f``) uniform over the upper hemisphere, from two uniform numbers."""
    r = dr.sqrt(dr.maximum(1 - u * u, 0))
    sin, cos = dr.sincos(2 * dr.pi * v)
    return types.Array3f(r * cos, r * sin, u)


def random_materials(rng, types, size: int, distribution: str = "training") -> Material:
    """Draw ``size`` materials.

    ``distribution``: ``"training"`` (metallic and roughness exponential-like, others uniform) or ``"uniform"``.
    """
    drawn = {name: rng.random(types.Float, size) for name in PARAMETERS}
    if distribution == "training":
        for name in ("metallic", "roughness"):
            drawn[name] = exponential_like(drawn[name])
    return Material(**drawn)


def random_directions(rng, types, size: int):
    """Draw ``size`` pairs ``(wi, wo)``, both uniform over the hemisphere."""
    u = [rng.random(types.Float, size) for _ in range(4)]
    return uniform_hemisphere(types, u[0], u[1]), uniform_hemisphere(types, u[2], u[3])


@dataclass
class Shaded(Material):
    """A material with its ``albedo``, a colour, the albedo's ``luminance``, and the shape of its specular ``lobe``.

    Without a ``lobe``, ``anisotropic`` shapes it.
    """

    albedo: Any
    luminance: Any
    lobe: Lobe | None = None

    @classmethod
    def of(cls, material: Material, albedo, lobe: Lobe | None = None) -> Shaded:
        luminance = sum(w * c for w, c in zip(LUMINANCE, albedo, strict=True))
        return cls(**{n: getattr(material, n) for n in PARAMETERS}, albedo=albedo, luminance=luminance, lobe=lobe)


def shade(
    decoder: Decoder | None, m: Material, albedo, wi, wo, effects: Effects = Effects(), lobes=None,  # noqa: B008
    lobe: Lobe | None = None,
):  # fmt: skip
    """Return BRDF · cosine in RGB, from ``decoder``, or by the published formulas if it is ``None``.

    ``lobes`` names the lobes to sum; by default, all that are in use. ``lobe`` is the shape of the specular one, which
    the published formulas do not know.
    """
    p, lobes = Shaded.of(m, albedo, lobe), lobes or effects.lobes
    if decoder is None:
        return model.colour(compose(p, exact_factors(p, wi, wo), lobes).values(), albedo, p.luminance)
    c = {group: decoder.coefficients(group, p, effects) for group in decoder.required(effects)}
    return decoder.value(c, effects, lobes, p, wi, wo)


class DisneyProblem(Problem):
    """Training problem of a layout ``net``, which is read by ``decoder``, a class.

    ``psnr_db`` is measured at ``samples`` random directions and materials, seeded and held out: PSNR of BRDF · cosine,
    clipped to [0, 1], against the analytic model.
    """

    #: In dB. The peak of a smooth surface still improves when the mean over random directions has settled.
    tolerance = 0.2

    def __init__(self, net: DisneyArrays, decoder: type[Decoder], types, samples: int = 2**18):
        self.net, self.decoder, self.types, self.samples = net, decoder, types, samples

    def batch(self, rng, size: int):
        m, (wi, wo) = random_materials(rng, self.types, size), random_directions(rng, self.types, size)
        uniform = [rng.random(self.types.Float, size) for _ in range(2)]
        return (m, wi, wo, uniform), self.net.targets(m, wi, wo, uniform)

    def predict(self, net: DisneyArrays, inputs) -> dict[str, list]:
        return net.predict(*inputs)

    def measure(self, net: DisneyArrays) -> dict[str, float]:
        return measure(self.decoder(net), self.types, self.samples)


def measure(
    decoder: Decoder, types, samples: int = 10**6, distribution: str = "training", seed: int = 2023
) -> dict[str, float]:
    """Measure the accuracy of a decoder over random materials and directions (uniform over the hemisphere).

    Returns ``psnr_db`` of BRDF · cosine clipped to [0, 1], ``psnr_brdf_db`` of the BRDF without the cosine, clipped
    likewise, and ``mae``.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    m, (wi, wo) = random_materials(rng, types, samples, distribution), random_directions(rng, types, samples)
    albedo = types.Array3f([rng.random(types.Float, samples) for _ in range(3)])
    truth, decoded = shade(None, m, albedo, wi, wo), shade(decoder, m, albedo, wi, wo)

    def squares(a, b):
        return [dr.square(dr.clip(u, 0, 1) - dr.clip(v, 0, 1)) for u, v in zip(a, b, strict=True)]

    cosine = dr.maximum(wo.z, 1e-6)
    errors = {
        "psnr_db": squares(truth, decoded),
        "psnr_brdf_db": squares(truth / cosine, decoded / cosine),
        "mae": [dr.abs(dr.clip(u, 0, 1) - dr.clip(v, 0, 1)) for u, v in zip(truth, decoded, strict=True)],
    }
    dr.eval(errors)  # one kernel in place of one for each mean
    means = {name: sum(dr.mean(e)[0] for e in channels) / 3 for name, channels in errors.items()}
    return {name: float(v) if name == "mae" else -10 * math.log10(v) for name, v in means.items()}


#: Preset → the layout of its tables, and the decoder that reads them.
LAYOUTS: dict[str, tuple[type[DisneyArrays], type[Decoder]]] = {
    "tables": (FactoredArrays, FactoredDecoder),
    "paper": (PaperArrays, PaperDecoder),
}


class DisneyModel(Model):
    """A table file as a module ``layout`` of its arrays, and the ``decoder`` that reads it."""

    forms = STORAGES

    def build(self):
        layout, decoder = LAYOUTS[self.table.preset]
        self.layout = layout(self.arrays)
        self.decoder = decoder(self.layout)

    def measure(self, samples: int = 10**6) -> dict[str, float]:
        """Measure errors (:func:`measure`): for training materials, and (``…_uniform_db``) uniform ones."""
        trained = measure(self.decoder, self.types, samples)
        uniform = measure(self.decoder, self.types, samples, "uniform")
        return {**trained, **{f"{k[:-3]}_uniform_db": v for k, v in uniform.items() if k.endswith("_db")}}


def load(path: str | os.PathLike) -> Table:
    """Read a table file of this task and check its layout, sizes and ranges. Raises :class:`TableError`."""
    table = load_table(path, task="disney")
    if table.preset not in LAYOUTS:
        raise TableError(f'{path}: holds tables of the preset "{table.preset}", allowed are {", ".join(LAYOUTS)}')
    layout, _ = LAYOUTS[table.preset]
    table = load_table(path, task="disney", shapes=layout.SHAPES)
    check_ranges(table, layout.RANGES)
    return table


MODEL = DisneyModel
