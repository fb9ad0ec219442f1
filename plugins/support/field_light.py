"""Light and shadow of radiance fields on segments of paths, and directions towards the light of the fields."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.core import compat
from mi_diffind.tasks.radiance import march as marching

from .placed_fields import VariantLight

#: Spheres around the light of all fields of a scene.
SPHERES = 16

#: Lines through a field along which its light is searched.
LINES = 1 << 14


class FieldLight:
    """Radiance fields between surfaces: emitters and occluders on straight segments, and emitters to be sampled.

    ``fields`` are the :class:`.PlacedField` of a scene, without common volumes. Directions are sampled
    towards :data:`SPHERES` spheres around places that send light: a sphere by its mean radiance times its solid angle,
    and uniform directions to it. The spheres only guide samples. Light outside of them is left to samples of BSDFs.
    """

    def __init__(self, fields: list, light: VariantLight):
        self.fields, self.light = fields, light
        self.update()

    def update(self) -> None:
        """Follow a change of the fields."""
        rows = []
        for placed in self.fields:
            bright, placement = bright_spheres(placed.field, SPHERES // len(self.fields)), placed.placement
            rows.append(np.column_stack([placement.world(bright[:, :3]), bright[:, 3] * placement.size, bright[:, 4]]))
        rows = np.concatenate([*rows, np.zeros((SPHERES, 5))])[:SPHERES].astype(np.float32)
        # Always as many, so that a frozen function takes other ones
        self.spheres = mi.Float(np.ascontiguousarray(rows[:, :4]).reshape(-1))
        self.radiances = mi.Float(np.ascontiguousarray(rows[:, 4]))
        dr.eval(self.spheres, self.radiances)

    def cross(self, ray, far, active=True) -> tuple:
        """Return the light of the fields on rays up to the distance ``far``, and the transmittance of the fields."""
        light, through = mi.Spectrum(0), mi.Float(1)
        for placed, crossed in in_order(self.fields, [f.enters(ray, far, active) for f in self.fields]):
            marched = placed.march(ray, far, crossed)
            seen = self.light.of(marched.colour, ray.wavelengths, crossed)
            light += dr.select(crossed, through * seen, 0)
            through *= dr.select(marched.transmittance > marching.OPAQUE, marched.transmittance, 0)
        return light, through

    def optimised(self) -> bool:
        """Return whether a derivative with respect to a field is requested."""
        return any(placed.optimised() for placed in self.fields)

    def derive(self, mode, ray, far, active, δL, factor, total):
        """Propagate the derivatives of the light ``total`` that arrives along rays, up to the distance ``far``.

        ``total`` is ``factor`` times the light of :meth:`cross`, plus the light from beyond. ``Backward`` propagates
        the adjoint ``δL`` of ``total`` to the fields. ``Forward`` returns the derivative of ``total``.
        """
        change, before, beyond = mi.Spectrum(0), mi.Float(1), mi.Spectrum(total)
        for placed, crossed in in_order(self.fields, [f.enters(ray, far, active) for f in self.fields]):
            marched = placed.march(ray, far, crossed)
            through = dr.select(marched.transmittance > marching.OPAQUE, marched.transmittance, 0)
            share = mi.Spectrum(factor) * before
            beyond -= dr.select(crossed, share * self.light.of(marched.colour, ray.wavelengths, crossed), 0)
            if placed.optimised():
                inverse = dr.select(through > 0, dr.rcp(through), 0)
                if mode == dr.ADMode.Backward:
                    d_colour = self.light.adjoint(marched.colour, ray.wavelengths, δL * share, crossed)
                    d_through = dr.sum(δL * beyond) * inverse
                    placed.replay(ray, far, crossed, marched, d_colour, d_through, mi.Float(0))
                else:
                    colour, transmittance, _ = placed.tangent(ray, far, crossed, marched)
                    seen = self.light.tangent(marched.colour, colour, ray.wavelengths, crossed)
                    change += dr.select(crossed, share * seen + beyond * transmittance * inverse, 0)
            before *= through
        return change

    def transmittance(self, ray, far, active=True):
        """Return the transmittance of the fields on rays up to the distance ``far``."""
        through = mi.Float(1)
        for placed in self.fields:
            one = placed.march(ray, far, active).transmittance
            through *= dr.select(one > marching.OPAQUE, one, 0)
        return through

    def _sphere(self, i, p, active) -> tuple:
        """Return the vector from ``p`` to a sphere's centre, its radius, 1 − cos of its cone, and its weight."""
        x, y, z, radius = dr.gather(mi.Vector4f, self.spheres, i, active)
        to = mi.Vector3f(x, y, z) - mi.Vector3f(p)
        share = dr.square(radius) / dr.squared_norm(to)
        width = dr.select(share < 1, share / (1 + dr.sqrt(dr.maximum(1 - share, 0))), 2)
        return to, radius, width, dr.gather(mi.Float, self.radiances, i, active) * width

    @compat.syntax
    def sample(self, p, number, place, active=True):
        """Return directions from the points ``p`` towards the light, and their density by solid angle.

        ``number`` and the pair ``place`` are random, in [0, 1). The density is 0 where the fields send no light.
        """
        with dr.suspend_grad():
            p, active = mi.Point3f(p), mi.Bool(active)
            number, total = mi.Float(number), mi.Float(0)
            i, chosen = mi.UInt32(0), mi.UInt32(0)
            while i < SPHERES:
                _, _, _, weight = self._sphere(i, p, active)
                total += weight
                share = dr.select(weight > 0, weight / total, 0)
                taken = number < share
                rest = (number - share) / (1 - share)
                number = dr.select(taken, number / share, dr.select(share < 1, rest, number))
                chosen = dr.select(taken, i, chosen)
                i += 1
            to, _, width, _ = self._sphere(chosen, p, active)
            height = width * place.x  # 1 − cos of the direction's angle
            radius, angle = dr.sqrt(dr.maximum(height * (2 - height), 0)), dr.two_pi * place.y
            local = mi.Vector3f(radius * dr.cos(angle), radius * dr.sin(angle), 1 - height)
            axis = dr.select(dr.squared_norm(to) > 0, dr.normalize(to), mi.Vector3f(0, 0, 1))
            d = dr.normalize(mi.Frame3f(axis).to_world(local))
            return d, self.density(p, d, active & (total > 0))

    @compat.syntax
    def density(self, p, d, active=True):
        """Return the density by solid angle with which :meth:`sample` returns the directions ``d`` at ``p``."""
        with dr.suspend_grad():
            p, d, active = mi.Point3f(p), mi.Vector3f(d), mi.Bool(active)
            i, total, sent = mi.UInt32(0), mi.Float(0), mi.Float(0)
            while i < SPHERES:
                to, radius, width, weight = self._sphere(i, p, active)
                along = dr.dot(to, d)
                beside = dr.squared_norm(to - along * d)
                met = (width == 2) | ((along > 0) & (beside <= dr.square(radius)))
                sent += dr.select(met & (width > 0), weight / width, 0)
                total += weight
                i += 1
            return dr.select(active & (total > 0), sent / (dr.two_pi * total), 0)


def in_order(fields: list, entered: list) -> list:
    """Return pairs of a field and the rays that enter it at this place of the order along a ray.

    ``entered`` holds, for each of ``fields``, the distance at which rays enter it and whether they do.
    """
    if len(fields) == 1:
        return [(fields[0], entered[0][1])]
    ranks = []
    for i, (near, _) in enumerate(entered):
        rank = mi.UInt32(0)
        for j, (other, crossed) in enumerate(entered):
            if j != i:
                rank += dr.select(crossed & ((other < near) | ((other == near) & (j < i))), mi.UInt32(1), 0)
        ranks.append(rank)
    pairs = []
    for place in range(len(fields)):
        pairs += [(field, entered[i][1] & (ranks[i] == place)) for i, field in enumerate(fields)]
    return pairs


def bright_spheres(field, count: int) -> np.ndarray:
    """Return spheres around the places of a field that send light, ``(n ≤ count, 5)``, in the field's frame.

    Columns are centre, radius and mean radiance. The light is searched along random lines; the lines of a second pass
    cross the sphere around all light of the first.
    """
    lower, upper = np.array(field.lower), np.array(field.upper)
    centre, radius = (lower + upper) / 2, np.linalg.norm(upper - lower) / 2
    for _ in range(2):
        places, light = _lit_places(field, centre, radius)
        if not len(places):
            return np.zeros((0, 5))
        whole, (centre, radius) = radius, _around(places, field.voxel)
    light *= whole**2 / LINES
    groups = [np.arange(len(places))]
    while len(groups) < count:
        sizes = [np.ptp(places[group], axis=0).max() for group in groups]
        # The group that wastes most directions
        largest = max(range(len(groups)), key=lambda i: light[groups[i]].sum() * sizes[i])
        if sizes[largest] < field.voxel:
            break
        group = groups.pop(largest)
        along = places[group][:, np.ptp(places[group], axis=0).argmax()]
        below = along < (along.min() + along.max()) / 2
        groups += [group[below], group[~below]]
    spheres = []
    for group in groups:
        middle, size = _around(places[group], field.voxel)
        spheres.append([*middle, size, light[group].sum() / size**2])
    return np.array(spheres)


def _around(places: np.ndarray, margin: float) -> tuple:
    """Return centre and radius of a sphere around points, with a margin."""
    centre = (places.min(axis=0) + places.max(axis=0)) / 2
    return centre, np.linalg.norm(places - centre, axis=1).max() + margin


def _lit_places(field, centre, radius: float) -> tuple:
    """Return points ``(n, 3)`` where random lines through a sphere see light, and how much, ``(n,)``."""
    types, rng = field.types, np.random.default_rng(1)
    d = rng.normal(size=(LINES, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    # Uniform on the disc perpendicular to the line
    across = np.cross(d, rng.normal(size=(LINES, 3)))
    across *= (radius * np.sqrt(rng.random(LINES)) / np.linalg.norm(across, axis=1))[:, None]
    o = centre + across
    extent = 2 * float(np.linalg.norm(np.subtract(field.upper, field.lower)))
    rays = [types.Array3f(np.ascontiguousarray(v.T, np.float32)) for v in (o, d)]
    marched = marching.march(field, *rays, -extent, extent)
    dr.eval(marched.colour, marched.transmittance, marched.depth)
    light, opacity = np.array(marched.colour).mean(axis=0), 1 - np.array(marched.transmittance)
    seen = (light > 0) & (opacity > 1e-3)
    distance = np.array(marched.depth)[seen] / opacity[seen]
    return o[seen] + d[seen] * distance[:, None], light[seen].astype(np.float64)
