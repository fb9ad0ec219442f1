"""Radiance fields in a scene: placed, joined where they overlap, and as light and shadow on segments of paths."""

from __future__ import annotations

from itertools import combinations, product
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.boxes import box_interval
from mi_diffind.core import compat
from mi_diffind.tasks.radiance import march as marching
from mi_diffind.tasks.radiance.files import load
from mi_diffind.tasks.radiance.volume_field import VolumeField

from . import properties, textures
from .placement import Placement
from .tables import arrays_of

#: Luminance of linear sRGB, the same as in Mitsuba.
LUMINANCE = (0.212671, 0.715160, 0.072169)


class PlacedField(Placement):
    """Radiance field (:class:`mi_diffind.tasks.radiance.volume_field.VolumeField`) in a scene, placed by ``to_world``.

    The transform is a similarity. Densities are per unit of length in the field's frame, so that a scaled field keeps
    its appearance.
    """

    def __init__(self, field, to_world):
        super().__init__(to_world)
        self.field, self._turn = field, None

    def held(self) -> list:
        """Return all arrays that rays read.

        A plugin keeps them as an attribute of its instance, since a frozen function (``dr.freeze``) does not traverse
        other objects.
        """
        return [self.axes, self.origin, self.size, *arrays_of(self.field)]

    @property
    def exposed(self) -> dict:
        """Arrays of the field that can be optimised: name → tensor."""
        return {name: values for name, values in self.field.arrays.items() if dr.is_float_v(values)}

    def optimised(self) -> bool:
        """Return whether a derivative with respect to the field's arrays or its place is requested."""
        return self.moving() or any(compat.has_gradient(values) for values in self.exposed.values())

    def _local(self, ray, far, active, numbers=None) -> tuple:
        """Return the arguments of the functions of :mod:`.march` after the field.

        ``numbers`` are those of :meth:`_numbers` for a placement that is attached.
        """
        axes, origin, size = self.axes, self.origin, self.size
        if numbers is not None:
            axes = mi.Frame3f(*(mi.Vector3f(*numbers[i : i + 3]) for i in (0, 3, 6)))
            origin, size = mi.Point3f(*numbers[9:12]), numbers[12]
            far = dr.minimum(far, 1e18)  # infinity over the size has no derivative
        o = mi.Point3f(axes.to_local(mi.Vector3f(ray.o - origin)) / size)
        return o, axes.to_local(ray.d), mi.Float(0), far / size, active

    def enters(self, ray, far, active=True) -> tuple:
        """Return the distance at which rays enter the field's box, and whether they do so before ``far``."""
        with dr.suspend_grad():
            _, near, _, crossing = marching.box(self.field, *self._local(ray, far, active))
            return near * self.size, crossing

    def overlaps(self, other: PlacedField) -> bool:
        """Return whether the boxes of two fields have a volume in common, by the separating axis theorem."""
        points = corners(self), corners(other)
        axes = [self.rotation.T, other.rotation.T]
        crossed = np.cross(axes[0][:, None], axes[1][None]).reshape(-1, 3)
        for axis in (*axes[0], *axes[1], *crossed[np.linalg.norm(crossed, axis=1) > 1e-6]):
            a, b = (p @ axis for p in points)
            if min(a.max(), b.max()) - max(a.min(), b.min()) <= 1e-5 * (a.max() - a.min()):
                return False
        return True

    def march(self, ray, far, active=True) -> tuple:
        """March rays up to the distance ``far``; return the result and the transmittance, 0 where a ray is opaque.

        The ``depth`` of the result is in units of the field's frame.
        """
        marched = marching.march(self.field, *self._local(ray, far, active))
        return marched, dr.select(marched.transmittance > marching.OPAQUE, marched.transmittance, 0)

    def count(self, ray, far, active=True) -> dict[str, int]:
        """Return the counts of the reads of :meth:`march`."""
        return marching.count(self.field, *self._local(ray, far, active))

    def replay(self, ray, far, active, marched, d_colour, d_transmittance, d_depth) -> None:
        """Call :func:`.march.replay`; ``depth`` is in units of the world."""
        moving, numbers = self.moving(), None
        with dr.resume_grad(when=moving):
            if moving:
                # Gathered, so that the kernel of the rays sums the gradients: sums of a width of 1 are kernels each
                first = dr.minimum(dr.arange(mi.UInt32, dr.width(ray.o)), 0)
                numbers = [dr.gather(mi.Float, v, first) for v in self._numbers()]
            local = self._local(ray, far, active, numbers)
        d_inside = d_depth * dr.detach(self.size)
        marching.replay(self.field, *local, 0.5, marched, d_colour, d_transmittance, d_inside, moving)
        if moving:
            with dr.resume_grad():
                depth = dr.select(active, d_depth * dr.detach(marched.depth), 0)
                dr.backward_from(depth * dr.gather(mi.Float, self.size, first), marching.ANY)

    def start_forward(self) -> None:
        """Determine the tangents of the placement, once before :meth:`tangent`."""
        self._turn = None
        if self.moving():
            with dr.resume_grad():
                self._turn = dr.forward_to(*self._numbers(), flags=marching.ANY)

    def _numbers(self) -> list:
        return [*self.axes.s, *self.axes.t, *self.axes.n, *self.origin, self.size]

    def tangent(self, ray, far, active, marched) -> tuple:
        """Call :func:`.march.tangent`; ``depth`` is in units of the world."""
        moving, numbers = self._turn is not None, None
        with dr.resume_grad(when=moving):
            if moving:
                # Numbers of their own: tangents pass through these more than once
                numbers = [mi.Float(dr.detach(v)) for v in self._numbers()]
                for number, change in zip(numbers, self._turn, strict=True):
                    dr.enable_grad(number)
                    dr.set_grad(number, change)
            local = self._local(ray, far, active, numbers)
        colour, transmittance, depth = marching.tangent(self.field, *local, 0.5, marched, moving)
        depth = depth * dr.detach(self.size)
        if moving:
            depth += dr.select(active, dr.detach(marched.depth) * self._turn[12], 0)
        return colour, transmittance, depth


def corners(placed: PlacedField) -> np.ndarray:
    """Return the corners ``(8, 3)`` of a field's box in the world."""
    field = placed.field
    return placed.world(np.array(list(product(*zip(field.lower, field.upper, strict=True)))))


class VariantLight:
    """Conversion of linear RGB radiance to the light of the current variant: RGB, luminance or a spectrum.

    The spectrum is that of Mitsuba's emitters: the upsampled colour, of at most ½, times that of the illuminant D65.
    """

    def __init__(self):
        self.illuminant = mi.load_dict({"type": "d65"}, parallel=False) if mi.is_spectral else None

    def convert(self, colour, wavelengths, active=True):
        """Return the light of RGB ``colour`` (three floats)."""
        if mi.is_monochromatic:
            return mi.Spectrum(sum(w * c for w, c in zip(LUMINANCE, colour, strict=True)))
        if not mi.is_spectral:
            return mi.Spectrum(*colour)
        scale = 2 * dr.maximum(dr.max(mi.Array3f(*colour)), 1e-20)
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wavelengths = wavelengths
        spectrum = textures.upsampled_spectrum([c / scale for c in colour], wavelengths)
        return mi.Spectrum(spectrum * scale * self.illuminant.eval(at, active))

    def adjoint(self, colour, wavelengths, weight, active=True):
        """Return the derivative of ``dot(weight, convert(colour))`` with respect to ``colour``: three floats."""
        if mi.is_monochromatic:
            return mi.Array3f(*(w * weight.x for w in LUMINANCE))
        if not mi.is_spectral:
            return mi.Array3f(*weight)
        with dr.resume_grad():
            free = _attached(colour)
            dr.backward_from(dr.dot(weight, self.convert(free, wavelengths, active)))
            return dr.select(active & _coloured(colour), dr.grad(free), 0)

    def tangent(self, colour, change, wavelengths, active=True):
        """Return the derivative of the light of ``colour`` along ``change``."""
        if not mi.is_spectral:
            return self.convert(change, wavelengths, active)
        with dr.resume_grad():
            free = _attached(colour)
            dr.set_grad(free, mi.Array3f(change))
            return dr.select(active & _coloured(colour), dr.forward_to(self.convert(free, wavelengths, active)), 0)


def _attached(colour):
    free = mi.Array3f(dr.detach(colour))
    dr.enable_grad(free)
    return free


def _coloured(colour):
    """Return whether a colour is not black; black has no derivative, since its spectrum depends on its hue."""
    return dr.max(mi.Array3f(dr.detach(colour))) > 0


def to_grid(props: mi.Properties) -> None:
    """Replace the compressed field in ``filename`` by the grid that it was made from, its exact counterpart.

    Raises ``RuntimeError`` if the grid was not kept or its file does not exist.
    """
    path = Path(properties.filename(props))
    with properties.refused_as():
        table = load(path)
    if table.settings["layout"] == "grid":
        return
    grid_path = table.settings.get("grid_path")
    if not grid_path:
        raise RuntimeError(
            f'parameter "filename": {path} was fitted without "--grid FILE": the grid to compare it with was not kept'
        )
    grid = path.resolve().parent / grid_path
    if not grid.is_file():
        raise RuntimeError(
            f'parameter "filename": {path} was made from the grid {grid}, which does not exist: "mi-diffind fit field '
            f'FOLDER --preset grid -o {grid.name}" makes it again'
        )
    props["filename"] = str(grid)
    properties.remove(props, "storage")


class JoinedField(VolumeField):
    """Sum of placed radiance fields, in the frame of the world: densities add up, and so do their emissions.

    ``members`` are the :class:`.PlacedField`. The box holds all of theirs, and steps are half the smallest voxel.
    Placements are constants to derivatives.
    """

    def __init__(self, members: list):
        points = np.concatenate([corners(placed) for placed in members])
        voxel = min(placed.field.voxel * placed.length for placed in members)
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


def join_overlapping(fields: list) -> list:
    """Return placed fields without common volumes; those of ``fields`` whose boxes overlap are joined."""
    groups = [([placed], placed) for placed in fields]
    while True:
        pair = next((pair for pair in combinations(groups, 2) if pair[0][1].overlaps(pair[1][1])), None)
        if pair is None:
            return [placed for _, placed in groups]
        members = pair[0][0] + pair[1][0]
        joined = PlacedField(JoinedField(members), mi.ScalarTransform4f())
        # In place of the first, so that the order of the others stays
        groups = [(members, joined) if group is pair[0] else group for group in groups if group is not pair[1]]


#: Spheres around the light of all fields of a scene.
SPHERES = 16

#: Lines through a field along which its light is searched.
LINES = 1 << 14


class FieldLight:
    """Radiance fields between surfaces: emitters and occluders on straight segments, and emitters to be sampled.

    ``fields`` are the :class:`.PlacedField` of a scene, without common volumes. If they are ``lit``, directions are
    sampled towards :data:`SPHERES` spheres around places that send light: a sphere by its mean radiance times its solid
    angle, and uniform directions to it. The spheres only guide samples. Light outside of them is left to samples of
    BSDFs.
    """

    def __init__(self, fields: list, light: VariantLight, lit: bool):
        self.fields, self.light, self.lit = fields, light, lit
        self.update()

    def update(self) -> None:
        """Follow a change of the fields."""
        rows = []
        for placed in self.fields if self.lit else ():
            bright = bright_spheres(placed.field, SPHERES // len(self.fields))
            rows.append(np.column_stack([placed.world(bright[:, :3]), bright[:, 3] * placed.length, bright[:, 4]]))
        rows = np.concatenate([*rows, np.zeros((SPHERES, 5))])[:SPHERES].astype(np.float32)
        # Always as many, so that a frozen function takes other ones
        self.spheres = mi.Float(np.ascontiguousarray(rows[:, :4]).reshape(-1))
        self.radiances = mi.Float(np.ascontiguousarray(rows[:, 4]))
        dr.eval(self.spheres, self.radiances)

    def optimised(self) -> bool:
        """Return whether a derivative with respect to a field is requested."""
        return any(placed.optimised() for placed in self.fields)

    def enters(self, ray, far, active=True) -> list:
        """Return, for each field, the distance at which rays enter its box, and whether they do so before ``far``."""
        return [placed.enters(ray, far, active) for placed in self.fields]

    def cross(self, ray, far, active=True, entered=None) -> tuple:
        """Return the light of the fields on rays up to the distance ``far``, their transmittance and their depth.

        The depth is the distance to the fields times the share of the light that they stop; ``entered`` is the result
        of :meth:`enters`.
        """
        L, through, depth = mi.Spectrum(0), mi.Float(1), mi.Float(0)
        for placed, crossed in in_order(self.fields, entered or self.enters(ray, far, active)):
            marched, passed = placed.march(ray, far, crossed)
            Le = self.light.convert(marched.colour, ray.wavelengths, crossed)
            L += dr.select(crossed, through * Le, 0)
            depth += through * marched.depth * placed.size
            through *= passed
        return L, through, depth

    def derive(self, mode, ray, far, active, δL, factor, total, entered=None, δlog=0, δdepth=0, depth=0) -> tuple:
        """Propagate derivatives of what rays see up to the distance ``far`` and beyond: ``(change, crossed)``.

        The light ``total`` is ``factor`` times that of :meth:`cross`, plus the light from beyond; ``depth`` likewise.
        ``Backward`` propagates their adjoints ``δL`` and ``δdepth``, and that of the logarithm of the transmittance,
        ``δlog``, to the fields. ``Forward`` returns as ``change`` the derivatives of light, logarithm and depth.
        ``crossed`` is the result of :meth:`cross`.
        """
        change, behind = [mi.Spectrum(0), mi.Float(0), mi.Float(0)], mi.Float(depth)
        L, before, beyond, seen_depth = mi.Spectrum(0), mi.Float(1), mi.Spectrum(total), mi.Float(0)
        for placed, crossed in in_order(self.fields, entered or self.enters(ray, far, active)):
            marched, through = placed.march(ray, far, crossed)
            share, at_depth = mi.Spectrum(factor) * before, before * marched.depth * placed.size
            Le = dr.select(crossed, self.light.convert(marched.colour, ray.wavelengths, crossed), 0)
            L, beyond = L + before * Le, beyond - share * Le
            seen_depth, behind = seen_depth + at_depth, behind - at_depth
            if placed.optimised():
                inverse = dr.select(through > 0, dr.rcp(through), 0)
                # The derivative by the logarithm of a transmittance is all that is transmitted
                if mode == dr.ADMode.Backward:
                    d_colour = self.light.adjoint(marched.colour, ray.wavelengths, δL * share, crossed)
                    d_through = (dr.sum(δL * beyond) + δlog + δdepth * behind) * inverse
                    placed.replay(ray, far, crossed, marched, d_colour, d_through, mi.Float(δdepth * before))
                else:
                    colour, transmittance, d_depth = placed.tangent(ray, far, crossed, marched)
                    dLe = self.light.tangent(marched.colour, colour, ray.wavelengths, crossed)
                    d_log = transmittance * inverse
                    change[0] += dr.select(crossed, share * dLe + beyond * d_log, 0)
                    change[1] += d_log
                    change[2] += before * d_depth + behind * d_log
            before *= through
        return change, (L, before, seen_depth)

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
    ranks = [mi.UInt32(0) for _ in fields]
    for i, (near, _) in enumerate(entered):
        for j, (other, crossed) in enumerate(entered):
            if j != i:
                ranks[i] += dr.select(crossed & ((other < near) | ((other == near) & (j < i))), mi.UInt32(1), 0)
    return [
        (field, crossed & (rank == place))
        for place in range(len(fields))
        for field, (_, crossed), rank in zip(fields, entered, ranks, strict=True)
    ]


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
