"""Queries of BSDFs for the benchmark: their methods at random directions and texture coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from .study import FLOOR

#: Methods of a BSDF that are timed.
QUERIES = ("eval", "sample", "pdf")

#: Texels along a side of textures: small enough for the cache, so that the lookup itself is timed.
TEXTURE_SIZE = 64


def directions(lanes: int, seed: int = 7):
    """Return random inputs of BSDFs, ``(si, wo, sample1, sample2)``, for so many ``lanes``, evaluated.

    ``si.wi`` and ``wo`` are uniform over the hemisphere, ``si.uv`` and the random numbers over [0, 1].
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
    """Return query (:data:`QUERIES`, ``eval_pdf``) → name of a BSDF → function.

    ``inputs`` are those of :func:`directions`. The floor has the same inputs, ``uv`` among them if the materials are
    ``textured``.
    """
    si, wo, sample1, sample2 = inputs
    context = mi.BSDFContext()
    uv, wavelengths = [si.uv] if textured else [], [si.wavelengths] if mi.is_spectral else []
    floors = {
        "eval": [si.wi, wo, *uv, *wavelengths],
        "sample": [si.wi, sample1, sample2, *uv, *wavelengths],
        "pdf": [si.wi, wo, *uv],
    }
    floors["eval_pdf"] = floors["eval"]
    queries = {query: {FLOOR: lambda values=values: values} for query, values in floors.items()}

    def sample(bsdf):
        bs, weight = bsdf.sample(context, si, sample1, sample2)
        return [bs.wo, bs.pdf, mi.Float(bs.sampled_component), weight]

    for name, bsdf in bsdfs.items():
        queries["eval"][name] = lambda b=bsdf: b.eval(context, si, wo)
        queries["eval_pdf"][name] = lambda b=bsdf: list(b.eval_pdf(context, si, wo))
        queries["sample"][name] = lambda b=bsdf: sample(b)
        queries["pdf"][name] = lambda b=bsdf: b.pdf(context, si, wo)
    return queries


def noise_texture(values: Sequence[float], rng: np.random.Generator) -> dict:
    """Return a bitmap (for ``mi.load_dict``) whose channels vary around ``values`` by at most 0.1."""
    noise = rng.uniform(-0.1, 0.1, (TEXTURE_SIZE, TEXTURE_SIZE, len(values)))
    data = np.clip(np.asarray(values) + noise, 0.01, 0.99).astype(np.float32)
    return {"type": "bitmap", "data": mi.TensorXf(data), "raw": not mi.is_spectral or len(values) == 1}
