"""What is timed of BSDFs: their methods at random directions and places."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .study import FLOOR

#: The methods that are timed.
QUERIES = ("eval", "sample", "pdf")

#: Texels of a side of the textures; read at random, they come from the cache, and what they cost is the reading itself.
TEXTURE_SIZE = 64


def directions(lanes: int, seed: int = 7):
    """
    So many interactions ``si`` with ``wi`` uniform over the hemisphere and ``uv`` uniform, as many ``wo`` like ``wi``,
    and random numbers for ``sample``: ``(si, wo, sample1, sample2)``, all evaluated.
    """
    rng = dr.rng(seed=dr.opaque(mi.UInt64, seed))
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    random = [rng.random(mi.Float, lanes) for _ in range(9)]
    si.wi, wo = (mi.warp.square_to_uniform_hemisphere(mi.Point2f(random[k : k + 2])) for k in (0, 2))
    si.uv, sample1, sample2 = mi.Point2f(random[4:6]), random[6], mi.Point2f(random[7:])
    if mi.is_spectral:
        si.wavelengths = 400 + 300 * rng.random(type(si.wavelengths), (dr.size_v(si.wavelengths), lanes))
    dr.make_opaque(si.wi, si.uv, si.wavelengths, wo, sample1, sample2)
    return si, wo, sample1, sample2


def bsdf_queries(bsdfs: dict[str, object], inputs: tuple, textured: bool) -> dict[str, dict]:
    """
    The queries (:data:`QUERIES`) of BSDFs by name; ``inputs`` are those of :func:`directions`.
    The floor has as many inputs, ``uv`` among them if the materials are ``textured``.
    """
    si, wo, sample1, sample2 = inputs
    context = mi.BSDFContext()
    uv, wavelengths = [si.uv] if textured else [], [si.wavelengths] if mi.is_spectral else []
    floors = {
        "eval": [si.wi, wo, *uv, *wavelengths],
        "sample": [si.wi, sample1, sample2, *uv, *wavelengths],
        "pdf": [si.wi, wo, *uv],
    }
    found = {query: {FLOOR: lambda values=values: values} for query, values in floors.items()}

    def sample(bsdf):
        bs, weight = bsdf.sample(context, si, sample1, sample2)
        return [bs.wo, bs.pdf, mi.Float(bs.sampled_component), weight]

    for name, bsdf in bsdfs.items():
        found["eval"][name] = lambda b=bsdf: b.eval(context, si, wo)
        found["sample"][name] = lambda b=bsdf: sample(b)
        found["pdf"][name] = lambda b=bsdf: b.pdf(context, si, wo)
    return found


def noise_texture(values: Sequence[float], rng: np.random.Generator) -> dict:
    """A bitmap (for ``mi.load_dict``) that varies around ``values``, of its channels, by 0.1 at most; a new tensor."""
    noise = rng.uniform(-0.1, 0.1, (TEXTURE_SIZE, TEXTURE_SIZE, len(values)))
    data = np.clip(np.asarray(values) + noise, 0.01, 0.99).astype(np.float32)
    return {"type": "bitmap", "data": mi.TensorXf(data), "raw": not mi.is_spectral or len(values) == 1}
