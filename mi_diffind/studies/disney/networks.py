"""Networks in place of the factors of the Disney BRDF, in as many bytes as tables.

A network returns the four factors (:class:`~mi_diffind.tasks.disney.model.Factors`) that are no polynomial of cosines
and parameters: specular and clearcoat as logarithms, both diffuse terms as they are. The model composes the colour of
them. In trials of 1000 steps, networks that return the three scalars of the colour or RGB were 9 and 13 dB worse.
"""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi

from ...arrays.lookup import clamp
from ...core.runtime import array_module
from ...core.units import largest_fitting
from ...fitting.loop import Problem
from ...fitting.settings import FitSettings
from ...measure.training import ConvergenceTraining
from ...tasks.disney import model
from ...tasks.disney.decoder import Decoder
from ...tasks.disney.model import TINY, Factors, compose, geometry
from ...tasks.disney.training import measure, random_directions, random_materials, shade
from ..baselines.hash_grids import halved
from ..baselines.networks import Network

#: Inputs and outputs of a network, and its hidden layers.
INPUTS, OUTPUTS, LAYERS = 10, 4, 2

#: Settings of the shortest training, and steps of the longest. The loss of longer ones is so small that a rare
#: highlight in a batch looks like a divergence.
SETTINGS, LONGEST = FitSettings(steps=2000, batch=2**12, lr=1e-2, loss="mse", seed=1), 16000

#: Steps of the first training of a quick study; the longest takes twice as many.
QUICK_STEPS = 50

#: Samples of a measurement during training.
MEASURED = 2**17

#: Limits of a logarithm before its exponential.
LIMITS = (-30.0, 20.0)

#: Scale of inputs that are logarithms.
LOGARITHM_SCALE = 0.2


def network(nbytes: int) -> Network:
    """Return the widest network of ``nbytes``, 2 bytes a parameter, not yet allocated."""

    def parameters(width: int) -> int:
        return (INPUTS + 1) * width + (LAYERS - 1) * (width + 1) * width + (width + 1) * OUTPUTS

    width = largest_fitting(lambda width: 2 * parameters(width) <= nbytes, 0, 4096)
    if not width:
        raise ValueError(f"{nbytes:,} bytes are too few for a network of {LAYERS} hidden layers")
    return Network(INPUTS, width, LAYERS, outputs=OUTPUTS)


def coordinates(p, wi, wo) -> list:
    """Return the inputs of a network: numbers that the formulas contain.

    They are roughness, clearcoat gloss, cos θ_i, cos θ_o and cos θ_d; the logarithms of the denominators of both
    distributions (h stretched by α_x and α_y; sin² θ_h + α² cos² θ_h of the clearcoat) and of α_x α_y; and the
    logarithm of the masking denominator of each direction.
    """
    g = geometry(wi, wo)
    h = g.h * dr.rsqrt(g.h2 + TINY)
    ax, ay = model.roughness_to_alpha(p.roughness, p.anisotropic)
    sine2, cosine2 = dr.square(h.x) + dr.square(h.y), dr.square(h.z)
    stretched = dr.square(h.x / ax) + dr.square(h.y / ay) + cosine2
    coat = sine2 + dr.square(model.coat_alpha(p.clearcoat_gloss)) * cosine2
    logarithms = [LOGARITHM_SCALE * dr.log(x + TINY) for x in (stretched, ax * ay, coat)]
    masking = [dr.log(model.masking_denominator(w, ax, ay)) for w in (wi, wo)]
    return [p.roughness, p.clearcoat_gloss, wi.z, wo.z, g.cos_d, *logarithms, *masking]


class NetworkDecoder(Decoder):
    """Form of the model whose factors a ``network`` returns; it needs no coefficients."""

    def __init__(self, network: Network):
        self.network = network

    def required(self, e):
        return ()

    def value(self, c, e, lobes, p, wi, wo, active=True):
        specular, diffuse, flat, clearcoat = self.network(coordinates(p, wi, wo))
        s = model.schlick(geometry(wi, wo).cos_d)
        specular, clearcoat = (dr.exp(clamp(v, *LIMITS)) for v in (specular, clearcoat))
        factors = Factors(
            specular=specular,
            metal_base=p.metallic * (1 - s),
            base=(1 - p.metallic) * (1 - s),
            sheen=(1 - p.metallic) * s * wo.z,
            grazing=s,
            diffuse=diffuse * wo.z,
            flat=flat * wo.z,
            clearcoat=clearcoat * wo.z,
        )
        return model.colour(compose(p, factors, lobes).values(), p.albedo, p.luminance)


def squared_errors(value, truth) -> list:
    """Return the squared errors of each channel, for training.

    Truth above 1 counts as 1, as in the measurement; values above 1 count as 1 there and as 1 + log(value) elsewhere,
    so that their gradients stay finite and do not vanish.
    """
    errors = []
    for v, t in zip(value, truth, strict=True):
        compressed = dr.select(v > 1, 1 + dr.log(dr.maximum(v, 1)), v)
        errors.append(dr.select(t >= 1, dr.minimum(v, 1) - 1, compressed - t))
    return [dr.square(error) for error in errors]


class DisneyNetworkProblem(Problem):
    """Training problem of a network: BRDF · cosine in RGB, of the materials and directions of tables' trainings."""

    def __init__(self, net: Network, types):
        self.net = net.alloc(types.TensorXf, rng=dr.rng(seed=dr.opaque(types.UInt64, SETTINGS.seed)))
        self.types, self.identity = types, {"width": net.width, "layers": net.layers}

    def loss(self, net, rng, size: int):
        m, (wi, wo) = random_materials(rng, self.types, size), random_directions(rng, self.types, size)
        albedo = self.types.Array3f([rng.random(self.types.Float, size) for _ in range(3)])
        value = shade(NetworkDecoder(net), m, albedo, wi, wo)
        return sum(squared_errors(value, shade(None, m, albedo, wi, wo))) * (1 / (3 * size))

    def measure(self, net) -> dict[str, float]:
        with dr.suspend_grad():
            return measure(NetworkDecoder(net), self.types, MEASURED)


class DisneyNetworkTraining(ConvergenceTraining):
    """Training to convergence of the widest network of ``nbytes``; :attr:`decoder` has half-precision parameters."""

    def __init__(self, name: str, nbytes: int, quick: bool = False):
        self.nbytes, self.types = nbytes, array_module(mi.variant())
        settings = FitSettings(QUICK_STEPS, SETTINGS.batch, SETTINGS.lr, loss="mse", seed=1) if quick else SETTINGS
        longest = 2 * QUICK_STEPS if quick else LONGEST
        super().__init__(name, lambda: DisneyNetworkProblem(network(nbytes), self.types), settings, longest, 10)

    def cached_record(self, folder: Path | None, record: dict | None = None) -> dict | None:
        return self._completed(super().cached_record(folder, record))

    def run(self, folder: Path | None = None, progress: bool = True) -> dict | None:
        return self._completed(super().run(folder, progress))

    def _completed(self, record: dict | None) -> dict | None:
        """Round the parameters and return the record with bytes and with the rule that ended the training."""
        if record is None:
            return None
        halved(self.net)
        rule = {"steps_first": self.settings.steps, "steps_longest": self.longest, "batch": self.settings.batch}
        shape = {"inputs": INPUTS, "width": self.net.width, "layers": LAYERS, "outputs": "four factors"}
        return {**record, "bytes": 2 * record["entries"], "details": {**shape, **rule, "steps": record["steps"]}}

    @property
    def decoder(self) -> NetworkDecoder:
        """The trained form."""
        return NetworkDecoder(self.net)

    def cooperative(self) -> NetworkDecoder:
        """Return the trained form in cooperative vectors, for inference."""
        return NetworkDecoder(self.net.cooperative())
