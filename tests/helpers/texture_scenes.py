"""What tests of textures that filter themselves have in common: hits with footprints, scenes that minify."""

import math

import drjit as dr
import numpy as np
import pytest
from arrays import aligned

from mi_diffind.core import compat

#: Components of a footprint that no render should produce, and some that are merely extreme.
WRONG = (0.0, 1.0, -1.0, 1e-20, -0.0, 1e20, 3e38, -3e38, math.nan, math.inf, -math.inf)


def linear(x):
    return np.where(x < 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def hits(mi, uv, ddx=(0, 0), ddy=(0, 0), p=None):
    """Hits at ``uv``, ``(2, n)``, with footprints that an integrator has filled in."""
    uv, ddx, ddy = (np.asarray(x, np.float32).reshape(2, -1) for x in (uv, ddx, ddy))
    n = max(x.shape[1] for x in (uv, ddx, ddy))
    si = dr.zeros(mi.SurfaceInteraction3f, n)

    def vector(kind, x):
        return kind(*[mi.Float(aligned(np.broadcast_to(row, n))) for row in x])

    si.uv, si.duv_dx, si.duv_dy = vector(mi.Point2f, uv), vector(mi.Vector2f, ddx), vector(mi.Vector2f, ddy)
    if p is not None:
        si.p = vector(mi.Point3f, np.asarray(p, np.float32).reshape(3, -1))
    if mi.is_spectral:
        wavelengths = np.random.default_rng(5).uniform(400, 700, (4, n)).astype(np.float32)
        si.wavelengths = type(si.wavelengths)(*map(mi.Float, wavelengths))
    dr.make_opaque(si.uv, si.duv_dx, si.duv_dy, si.p)
    return si


def footprints(rng, n, size, largest=5.0):
    """Footprints in uv, from a fraction of a texel of ``size`` (width, height) to ``2^largest`` of them."""
    scale = 2 ** rng.uniform(-1, largest, n)
    return [rng.normal(size=(2, n)) * scale / np.reshape(size, (2, 1)) for _ in range(2)]


def isotropic(ddx, ddy, size):
    """The level of an area: half the logarithm of the determinant in texels, at least 0."""
    area = np.abs(ddx[0] * ddy[1] - ddx[1] * ddy[0]) * size[0] * size[1]
    return 0.5 * np.log2(np.maximum(area, 1))


def ellipse(ddx, ddy, size):
    """Major and minor axis in texels, and the major one as a vector in uv, by singular values."""
    m = np.stack([ddx, ddy], axis=-1).transpose(1, 0, 2) * np.reshape(size, (1, 2, 1))
    u, s, _ = np.linalg.svd(m)
    return s[:, 0], s[:, 1], (u[:, :, 0] * s[:, :1] / np.reshape(size, (1, 2))).T


def emission(mi) -> dict:
    """An integrator that shows emitters alone, in the variant that is set: without a loop, it compiles fast."""

    class Emission(mi.SamplingIntegrator):
        def sample(self, scene, sampler, ray, medium=None, active=True):
            si = scene.ray_intersect(ray, active)
            return si.emitter(scene, active).eval(si, active), si.is_valid(), []

    mi.register_integrator("emission", Emission)
    return {"type": "emission"}


def plane(mi, texture, spp=1, sampler="stratified", size=48, shape=None):
    """A plane to the horizon that shines as its texture says, without any noise but that of the places in a pixel."""
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    jitter = {"jitter": False} if sampler == "stratified" else {}
    return mi.load_dict({
        "type": "scene",
        "integrator": emission(mi),
        "sensor": {
            "type": "perspective", "film": film,
            "sampler": {"type": sampler, "sample_count": spp, **jitter},
            "to_world": t.look_at([0, -2.5, 0.5], [0, 0, 0], [0, 0, 1]), "fov": 60,
        },
        "plane": shape or {
            "type": "rectangle", "to_world": t.scale(6), "emitter": {"type": "area", "radiance": texture}
        },
    })  # fmt: skip


def psnr(a, b):
    return -10 * np.log10(np.mean((a - b) ** 2, dtype=np.float64))


def refused(mi, wrong):
    """The sentence with which a plugin refuses its parameters."""
    with pytest.raises(RuntimeError) as e:
        mi.load_dict(wrong)
    text = compat.one_sentence(e.value)
    assert "Traceback" not in text and "\n" not in text and len(text) < 350, text
    return text
