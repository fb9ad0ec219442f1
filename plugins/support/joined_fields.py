"""Radiance fields whose boxes overlap: a field that is the sum of others, and groups of fields."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.boxes import box_interval
from mi_diffind.tasks.radiance.volume_field import VolumeField

from .placed_fields import PlacedField, corners


class JoinedField(VolumeField):
    """Sum of placed radiance fields, in the frame of the world: densities add up, and so do their emissions.

    ``members`` are the :class:`.PlacedField`. The box holds all of theirs, and steps are half the smallest voxel.
    Placements are constants to derivatives.
    """

    def __init__(self, members: list):
        points = np.concatenate([corners(placed) for placed in members])
        voxel = min(placed.field.voxel * placed.placement.size for placed in members)
        super().__init__(members[0].field.types, points.min(axis=0), points.max(axis=0), voxel, {})
        self.members = members

    @property
    def arrays(self) -> dict:
        """Tensors of all members that can be differentiated."""
        return {f"{i}.{name}": v for i, placed in enumerate(self.members) for name, v in placed.field.arrays.items()}

    @arrays.setter
    def arrays(self, values: dict) -> None:
        """Ignore the arrays of the base class: those of the members count."""

    def density_at(self, p, active=True) -> tuple:
        return sum(density for density, *_ in self._densities(p, active)), []

    def radiance_at(self, point_data, p, d, active=True) -> list:
        # Densities are read again: derivatives with respect to them reach the shares of the members
        read = self._densities(p, active)
        total = sum(density for density, *_ in read)
        radiance = [self.types.Float(0)] * 3
        for placed, (density, data, place, inside) in zip(self.members, read, strict=True):
            _, way = _local(placed, p, d)
            share = dr.select(total > 0, density / total, 0)
            colours = placed.field.radiance_at(data, place, way, inside & (density > 0))
            radiance = [sum_ + dr.select(density > 0, share * c, 0) for sum_, c in zip(radiance, colours, strict=True)]
        return radiance

    def free_distance(self, p, d, active=True):
        nearest = self.types.Float(1e6)
        for placed in self.members:
            place, way = _local(placed, p, d)
            near, far, crossing = box_interval(place, way, *placed.field.box, 0, 1e6, self.types.Bool(active))
            crossing &= near <= far
            inside = crossing & (near == 0)
            free = dr.select(inside, placed.field.free_distance(place, way, inside), near)
            nearest = dr.select(crossing, dr.minimum(nearest, free * dr.detach(placed.size)), nearest)
        return nearest

    def _densities(self, p, active) -> list:
        """Return for each member its density in the world, its data, the point in its frame, and whether it is in."""
        read = []
        for placed in self.members:
            place, _ = _local(placed, p, p)
            inside = self.types.Bool(active)
            for x, low, high in zip(place, *placed.field.box, strict=True):
                inside &= (x >= low) & (x <= high)
            density, data = placed.field.density_at(place, inside)
            read.append((dr.select(inside, density / dr.detach(placed.size), 0), data, place, inside))
        return read


def _local(placed: PlacedField, p, d) -> tuple:
    """Return points and directions of the world in a field's frame."""
    axes, origin, size = (dr.detach(v) for v in (placed.axes, placed.origin, placed.size))
    return mi.Point3f(axes.to_local(mi.Vector3f(*p) - mi.Vector3f(origin)) / size), axes.to_local(mi.Vector3f(*d))


def grouped(fields: list) -> list:
    """Return placed fields without common volumes; those of ``fields`` whose boxes overlap are joined."""
    groups = [([placed], placed) for placed in fields]
    while True:
        pair = next(
            ((a, b) for i, a in enumerate(groups) for b in groups[i + 1 :] if a[1].overlaps(b[1])), None
        )  # fmt: skip
        if pair is None:
            return [placed for _, placed in groups]
        members = pair[0][0] + pair[1][0]
        joined = PlacedField(JoinedField(members), mi.ScalarTransform4f())
        # In place of the first, so that the order of the others stays
        groups = [(members, joined) if group is pair[0] else group for group in groups if group is not pair[1]]
