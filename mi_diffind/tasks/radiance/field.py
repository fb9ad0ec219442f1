"""
Radiance fields: what all of them offer, and the one that is a grid of plain numbers.

A field fills a box. At each point it has a density σ, per unit of length, and in each direction a radiance (linear RGB,
never negative), so that a ray sees ``Σ T_i (1 − exp(−σ_i δ_i)) c_i`` (:mod:`.march`).
"""

from __future__ import annotations

import copy

import drjit as dr
import numpy as np

from .nodes import Nodes

#: The optical depth of a voxel that counts as none.
FAINT = 2e-3

#: Most that the logarithm of a radiance may be.
BRIGHTEST = 12.0


class VolumeField:
    """
    A field in the box from ``lower`` to ``upper``, of voxels of side ``voxel``, marched in steps of length ``step``
    (default: half a voxel). ``arrays`` holds what can be differentiated, by name: tensors.
    """

    def __init__(self, types, lower, upper, voxel: float, arrays: dict, step: float | None = None):
        self.types = types
        self.lower, self.upper = tuple(map(float, lower)), tuple(map(float, upper))
        self.voxel, self.step = float(voxel), float(step if step is not None else 0.5 * voxel)
        self.arrays = dict(arrays)
        # Not part of kernels, so that those of one field serve another
        self.box = tuple(dr.opaque(types.Array3f, corner) for corner in (self.lower, self.upper))
        self.per_voxel = dr.opaque(types.Float, 1 / self.voxel)

    def with_arrays(self, arrays: dict) -> VolumeField:
        """The same field with other numbers in its arrays."""
        result = copy.copy(self)
        result.arrays = dict(arrays)
        return result

    def look(self, p, active=True) -> tuple:
        """
        The density at a point of the box, at least 0, and what :meth:`colour` needs to know of that point: a list of
        arrays that no derivatives are taken of.
        """
        raise NotImplementedError

    def colour(self, latent: list, p, d, active=True) -> list:
        """The radiance [r, g, b] that leaves the point towards −``d``, of unit length, by what was found there."""
        raise NotImplementedError

    def skip(self, p, d, active=True):
        """A length, from ``p`` along ``d``, in which there is certainly nothing; 0 where one has to look."""
        return self.types.Float(0)


def density_of(raw, per_voxel):
    """
    σ of a raw number: softplus(raw) less :data:`FAINT`, per voxel, never negative; ``per_voxel`` is one over its side.
    About −6 and less is nothing, exactly, 10 is opaque.
    """
    soft = dr.maximum(raw, 0) + dr.log(1 + dr.exp(-dr.abs(raw)))
    return dr.maximum(soft - FAINT, 0) * per_voxel


def raw_of(density: np.ndarray, voxel: float) -> np.ndarray:
    """The reverse, in NumPy: raw numbers of densities."""
    y = np.asarray(density, np.float64) * voxel + FAINT
    return y + np.log(-np.expm1(-y))


def colour_of(numbers: list, d) -> list:
    """
    The radiance in direction ``d`` of twelve numbers, four for each of red, green and blue: exp(a + b·d). Linear in
    what is stored, and never negative.
    """
    found = []
    for c in range(3):
        a, x, y, z = numbers[4 * c : 4 * c + 4]
        found.append(dr.exp(dr.minimum(dr.fma(x, d.x, dr.fma(y, d.y, dr.fma(z, d.z, a))), BRIGHTEST)))
    return found


class GridField(VolumeField):
    """
    Trilinear in a raw number of density (:func:`density_of`) and twelve of colour (:func:`colour_of`) at each of
    ``nodes``: arrays ``density`` ``(n,)`` and ``colour`` ``(n, 12)``, in the order of the nodes.
    """

    def __init__(self, nodes: Nodes, density, colour, step: float | None = None):
        super().__init__(
            nodes.types, nodes.lower, nodes.upper, nodes.spacing, {"density": density, "colour": colour}, step
        )
        self.nodes = nodes

    def look(self, p, active=True):
        corners, active = self.nodes.corners(p, active)
        density = self.arrays["density"].array
        raw = self.types.Float(0)
        for weight, slot in corners:
            raw = dr.fma(weight, dr.gather(self.types.Float, density, slot, active), raw)
        return dr.select(active, density_of(raw, self.per_voxel), 0), [w for w, _ in corners] + [s for _, s in corners]

    def colour(self, latent, p, d, active=True):
        weights, slots = latent[:8], latent[8:]
        return colour_of(blended(self.types, self.arrays["colour"].array, 3, weights, slots, active), d)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)


def blended(types, flat, packets: int, weights: list, slots: list, active) -> list:
    """``4 · packets`` numbers an entry of ``flat``, weighted over entries: packets of four are read at once."""
    sums = [types.Float(0)] * (4 * packets)
    for weight, slot in zip(weights, slots, strict=True):
        for j in range(packets):
            four = dr.gather(types.Array4f, flat, dr.fma(slot, packets, j), active)
            for k in range(4):
                sums[4 * j + k] = dr.fma(weight, four[k], sums[4 * j + k])
    return sums


class DenseField(GridField):
    """
    A :class:`GridField` with a number at every node of a box: ``density`` ``(X, Y, Z)`` raw numbers and ``colour``
    ``(X, Y, Z, 12)``, arrays of NumPy, on nodes from ``lower`` on, ``voxel`` apart.
    """

    def __init__(self, types, density, colour, lower, voxel: float, step: float | None = None):
        density = np.ascontiguousarray(density, np.float32)
        colour = np.ascontiguousarray(colour, np.float32)
        nodes = Nodes(types, lower, voxel, density.shape)
        tensor = types.TensorXf
        super().__init__(nodes, tensor(density.reshape(-1)), tensor(colour.reshape(-1, 12)), step)
