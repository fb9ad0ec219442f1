"""Tensor files of measured materials, as Mitsuba's plugin ``measured`` reads them: learned BSDFs are written as one.

The format is that of Dupuy and Jakob, *An Adaptive Parameterization for Efficient Material Acquisition and Rendering*
(SIGGRAPH Asia 2018). For each direction of incidence, the unit square is warped to half vectors by the density of
visible normals (``vndf``), that of a distribution of normals D (``ndf``) of projected area σ (``sigma``). ``rgb`` is
f cos θ_o · 4σ/D on a grid of the square, and ``luminance`` draws samples.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from .model import LearnedBSDF

#: Nodes of a file: angles θ_i; azimuths φ_i of a quarter turn, of anisotropic files; sides of the warped square and of
#: the table of projected areas; azimuths and angles of normals.
THETAS, PHIS, SIDE, AREAS, NORMALS = 32, 5, 32, 64, (33, 128)

#: Smallest cosine that counts in a density, and smallest luminance of a density relative to the mean.
LEAST = 1e-3

#: Smallest cosine of a normal at which the light that returns is read, and below which D falls with its square.
HORIZON = 0.02, 0.05

#: Weights of linear sRGB in the luminance.
LUMINANCE = (0.212671, 0.715160, 0.072169)


def fields(bsdf: LearnedBSDF, types, description: str) -> dict:
    """Return the fields of the file of a learned BSDF, in linear sRGB, in the active variant of Mitsuba."""
    import mitsuba as mi

    isotropic = bsdf.form.isotropic
    theta = np.pi / 2 * (1 - (1 - np.linspace(0, 1, THETAS)) ** 1.5)  # dense near the horizon
    theta[-1] *= 0.9999
    phi = np.zeros(1)
    if not isotropic:
        # The plugin mirrors wi into the range: of a quarter turn if f is symmetric about both axes, else of half a turn
        quarters = 1 if bsdf.form.azimuth == "mirror" and not bsdf.form.angle else 2
        phi = np.linspace(-np.pi, (quarters / 2 - 1) * np.pi, quarters * (PHIS - 1) + 1)
    normals = direction(np.linspace(0, 1, NORMALS[1]), np.linspace(0, 1, NORMALS[0])[:, None])
    ndf = distribution_of_normals(bsdf, types, normals)
    # Area of normals in a step of both coordinates, but for a factor: sin θ dθ, θ ∝ u²
    area = np.linspace(0, 1, NORMALS[1]) * np.sqrt(np.maximum(1 - normals[..., 2] ** 2, 0))

    def visible(wi: np.ndarray) -> np.ndarray:
        """Return the densities of the normals that directions ``(…, 3)`` see, ``(…, *NORMALS)``."""
        return ndf * area * np.maximum(np.einsum("...k,abk->...ab", wi, normals), LEAST)

    u = np.linspace(0, 1, AREAS)
    ends = [np.where(np.arange(n) % (n - 1) == 0, 0.5, 1) / (n - 1) for n in NORMALS]  # trapezoids
    sigma = np.stack([2 * np.pi**2 * np.einsum("xab,a,b->x", visible(direction(u, v)), *ends) for v in u])
    sigma = np.broadcast_to(sigma.mean(axis=0), sigma.shape) if isotropic else sigma
    vndf = visible(_vector(theta, phi[:, None]))
    vndf /= vndf.mean(axis=(2, 3), keepdims=True)
    theta, phi, ndf, sigma, vndf = (np.ascontiguousarray(a, np.float32) for a in (theta, phi, ndf, sigma, vndf))

    # What the plugin will compute at the nodes of the square, and what is left for the spectra
    p, t, y, x = (a.ravel() for a in np.meshgrid(phi, theta, *2 * [np.linspace(0, 1, SIDE)], indexing="ij"))
    warp = mi.MarginalContinuous2D2(vndf, [phi.tolist(), theta.tolist()])
    u_m, _ = warp.sample(mi.Point2f(_float(mi, x), _float(mi, y)), [_float(mi, p), _float(mi, t)])
    u_wi = mi.Point2f(_float(mi, np.sqrt(t * 2 / np.pi)), _float(mi, (p + np.pi) / (2 * np.pi)))
    sigma_read, ndf_read = (mi.MarginalContinuous2D0(a, [], False, False) for a in (sigma, ndf))
    factor = (4 * sigma_read.eval(u_wi) / ndf_read.eval(u_m)).numpy()
    wi, m = _vector(t, p), direction(u_m.x.numpy(), u_m.y.numpy(), p if isotropic else 0)
    wo = 2 * np.sum(wi * m, axis=1, keepdims=True) * m - wi
    rgb = (values(bsdf, types, wi, wo) * factor[:, None]).reshape(-1, SIDE, 3)
    shape = len(phi), len(theta), SIDE, SIDE
    luminance = (rgb @ LUMINANCE).reshape(shape)
    luminance = np.maximum(luminance, LEAST * luminance.mean(axis=(2, 3), keepdims=True) + 1e-12)
    # Interpolation reads nodes below the horizon: there, the last value of the row that lies above it goes on
    last = np.maximum.accumulate(np.where((wo[:, 2] > 0).reshape(-1, SIDE), np.arange(SIDE), 0), axis=1)
    rgb = np.moveaxis(np.take_along_axis(rgb, last[..., None], axis=1).reshape(*shape, 3), -1, 2)
    arrays = {"phi_i": phi, "theta_i": theta, "ndf": ndf, "sigma": sigma, "vndf": vndf, "luminance": luminance}
    return {
        **{name: np.ascontiguousarray(a, np.float32) for name, a in {**arrays, "rgb": rgb}.items()},
        "jacobian": np.ones(1, np.uint8),
        "description": description,
    }


def distribution_of_normals(bsdf: LearnedBSDF, types, normals: np.ndarray) -> np.ndarray:
    """Return D of ``normals``, but for a factor, from the light that returns along them."""
    lowest, flat = HORIZON
    raised = np.concatenate([normals[..., :2], np.maximum(normals[..., 2:], lowest)], axis=-1).reshape(-1, 3)
    raised /= np.linalg.norm(raised, axis=1, keepdims=True)
    returned = (values(bsdf, types, raised, raised) @ LUMINANCE / raised[:, 2]).reshape(normals.shape[:-1])
    ndf = returned * np.maximum(normals[..., 2], flat) ** 2
    ndf = np.maximum(ndf, 1e-8 * ndf.max() + 1e-12)
    return np.broadcast_to(ndf.mean(axis=0), ndf.shape) if bsdf.form.isotropic else ndf


def values(bsdf: LearnedBSDF, types, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return f cos θ_o, ``(n, 3)``, of directions ``(n, 3)``; 0 below the horizon."""
    above = ((wi[:, 2] > 0) & (wo[:, 2] > 0))[:, None]
    wi, wo = (
        types.Array3f(*(types.Float(np.ascontiguousarray(c, np.float32)) for c in np.where(above, w, [0, 0, 1]).T))
        for w in (wi, wo)
    )
    with dr.suspend_grad():
        columns = [v * wo.z for v in bsdf.value(wi, wo)]
        dr.eval(columns)
    return np.where(above, np.stack([c.numpy() for c in columns], axis=1), 0)


def direction(u, v, turn=0) -> np.ndarray:
    """Return the unit vectors ``(…, 3)`` of coordinates √(2θ/π) and (φ + π)/2π, turned about the normal."""
    return _vector(np.square(u) * np.pi / 2, (2 * np.asarray(v) - 1) * np.pi + turn)


def _vector(theta, phi) -> np.ndarray:
    sin = np.sin(theta)
    return np.stack(np.broadcast_arrays(sin * np.cos(phi), sin * np.sin(phi), np.cos(theta)), axis=-1)


def _float(mi, values: np.ndarray):
    return mi.Float(np.ascontiguousarray(values, np.float32))
