"""Measured materials in tensor files whose values are spectra, as colours under an illuminant.

Files of Mitsuba's ``measured`` (Dupuy and Jakob 2018) and ``measured_polarized`` (Baek et al., *Image-Based Acquisition
and Modeling of Polarimetric Reflectance*, SIGGRAPH 2020). Spectra are integrated with the CIE 1931 observer and the
spectrum of the illuminant, and scaled so that a perfect reflector has the luminance 1. Under ``D65`` it is white: this
is what spectral variants of Mitsuba show in the light of RGB emitters. ``E`` is the light of equal energy.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp
from ...core import tensor_files
from ...core.errors import UsageError
from .source import Truth

#: Illuminants, the first is the default.
ILLUMINANTS = ("D65", "E")


def colour_weights(wavelengths: np.ndarray, illuminant: str) -> np.ndarray:
    """Return the weights ``(n, 3)`` of values at ``n`` wavelengths (nm) in a colour of linear sRGB.

    Values are interpolated linearly between wavelengths, and constant beyond the first and last one.
    """
    import mitsuba as mi

    grid = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + 0.5)
    nodes = mi.Float(grid.astype(np.float32))
    observer = mi.cie1931_xyz(nodes)
    colours = np.stack([c.numpy() for c in mi.xyz_to_srgb(observer)], axis=1).astype(np.float64)
    light = mi.cie_d65(nodes).numpy().astype(np.float64) if illuminant == "D65" else np.ones(len(grid))
    density = light[:, None] * colours / (light @ observer.y.numpy().astype(np.float64))
    order = np.argsort(wavelengths)
    hats = np.stack([np.interp(grid, wavelengths[order], row) for row in np.eye(len(wavelengths))[:, order]])
    return hats @ density


def in_colours(fields: dict, illuminant: str) -> dict:
    """Return the fields of a spectral file of ``measured`` as those of an RGB one."""
    weights = colour_weights(np.asarray(fields["wavelengths"], np.float64), illuminant)
    spectra = np.asarray(fields["spectra"])
    rgb = np.einsum("ptwyx,wc->ptcyx", spectra, weights.astype(np.float32))
    kept = {name: np.asarray(value) for name, value in fields.items() if name not in ("spectra", "wavelengths")}
    return {**kept, "rgb": np.ascontiguousarray(rgb, np.float32)}


def measured_bsdf(path: Path, illuminant: str):
    """Return Mitsuba's ``measured`` of a file in an RGB variant, and a remark about colours ("" for an RGB file).

    Raises :class:`UsageError`, and as Mitsuba does.
    """
    import mitsuba as mi

    fields = tensor_files.read(path)
    tensor_files.check(path, fields)
    if "wavelengths" not in fields or mi.is_spectral:
        return mi.load_dict({"type": "measured", "filename": str(path)}), ""
    fields = in_colours(fields, illuminant)
    with tempfile.TemporaryDirectory() as folder:
        converted = os.path.join(folder, path.name)
        tensor_files.write(converted, fields)
        return mi.load_dict({"type": "measured", "filename": converted}), _remark(illuminant)


def _remark(illuminant: str) -> str:
    return f"spectra as linear sRGB under the illuminant {illuminant}"


class PolarisedTruth(Truth):
    """Isotropic measurement of Mueller matrices, as of unpolarised light: their first entry.

    Angles are φ_d, θ_d and θ_h; values are interpolated linearly, and 0 beside invalid ones (NaN). Raises
    :class:`UsageError`.
    """

    isotropic = True

    def __init__(self, path: Path, illuminant: str):
        import mitsuba as mi

        fields = tensor_files.read(path)
        if "M" not in fields:
            raise UsageError(f'{path}: is no file of measured Mueller matrices: has no field "M"')
        tensor_files.check(path, fields)
        nodes = fields["M"].shape
        weights = colour_weights(np.asarray(fields["wvls"], np.float64), illuminant)
        colours = np.asarray(fields["M"][..., 0, 0], np.float32) @ weights.astype(np.float32)
        grid = np.zeros((*nodes[:3], 2, 2), np.float32)  # Mitsuba interpolates pictures, here of 2 x 2 numbers
        grid.reshape(*nodes[:3], 4)[..., :3] = colours
        angles = [np.ravel(fields[name]).astype(float).tolist() for name in ("phi_d", "theta_d", "theta_h")]
        self.mi, self.grid = mi, mi.MarginalContinuous2D3(grid, angles, False, False)
        self.name, self.remark = path.name, _remark(illuminant)
        digest = hashlib.sha256(illuminant.encode())
        with open(path, "rb") as stream:
            while block := stream.read(2**24):
                digest.update(block)
        self.digest = digest.hexdigest()

    def value(self, wi, wo):
        half = wi + wo
        half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
        sin = dr.sqrt(dr.maximum(dr.square(half.x) + dr.square(half.y), 1e-20))
        cos_d = dr.clip(dr.dot(wo, half), 0, 1)
        # Components of wo along the tangents of h: towards the normal, and perpendicular to both
        along, across = (half.z * cos_d - wo.z) / sin, (half.x * wo.y - half.y * wo.x) / sin
        angles = [dr.atan2(across, along), dr.acos(cos_d), dr.atan2(sin, half.z)]
        corners = ((0, 0), (1, 0), (0, 1))
        values = [self.grid.eval(self.mi.Point2f(x, y), angles) for x, y in corners]
        return [wo.z * dr.select(dr.isnan(v), 0, clamp(v, 0, 1e8)) for v in values]
