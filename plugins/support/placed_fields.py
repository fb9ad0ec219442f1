"""Radiance fields in a scene: their placement, their light in each variant, and the grid of their counterpart."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.tables import TableError
from mi_diffind.core import compat
from mi_diffind.tasks.radiance import march as marching
from mi_diffind.tasks.radiance.files import load

from . import properties, textures
from .placement import Placement, PlacementParameter
from .tables import arrays_of

#: Luminance of linear sRGB, the same as in Mitsuba.
LUMINANCE = (0.212671, 0.715160, 0.072169)


class PlacedField:
    """Radiance field (:class:`mi_diffind.tasks.radiance.volume_field.VolumeField`) in a scene, placed by ``to_world``.

    The transform is a similarity. Densities are per unit of length in the field's frame, so that a scaled field keeps
    its appearance.
    """

    def __init__(self, field, to_world):
        self.field, self.position = field, PlacementParameter(Placement.of(to_world, 1.0, (0, 0, 0)))
        self._turn = None
        self._place()

    def _place(self) -> None:
        self.axes, self.origin, self.size = self.position.axes, self.position.origin, self.position.size

    def update(self) -> None:
        """Follow a change of the parameter ``to_world``. Raises ``RuntimeError`` unless it is a similarity."""
        self.position.update()
        self._place()

    @property
    def placement(self) -> Placement:
        """Placement of the field's frame in the world."""
        return self.position.placement

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
        return self.position.moving() or any(compat.has_gradient(values) for values in self.exposed.values())

    def _local(self, ray, far, active) -> tuple:
        """Return the arguments of the functions of :mod:`.march` after the field."""
        o = mi.Point3f(self.axes.to_local(mi.Vector3f(ray.o - self.origin)) / self.size)
        return o, self.axes.to_local(ray.d), mi.Float(0), far / self.size, active

    @staticmethod
    def _seen_from(numbers: list, ray, far, active) -> tuple:
        """Return :meth:`_local` for a placement that is attached: ``numbers`` are those of :meth:`_numbers`."""
        axes = mi.Frame3f(*(mi.Vector3f(*numbers[i : i + 3]) for i in (0, 3, 6)))
        origin, size = mi.Point3f(*numbers[9:12]), numbers[12]
        o = mi.Point3f(axes.to_local(mi.Vector3f(ray.o - origin)) / size)
        # Infinity over the size has no derivative
        return o, axes.to_local(ray.d), mi.Float(0), dr.minimum(far, 1e18) / size, active

    def enters(self, ray, far, active=True) -> tuple:
        """Return the distance at which rays enter the field's box, and whether they do so before ``far``."""
        with dr.suspend_grad():
            _, near, _, crossing = marching.box(self.field, *self._local(ray, far, active))
            return near * self.size, crossing

    def overlaps(self, other: PlacedField) -> bool:
        """Return whether the boxes of two fields have a volume in common, by the separating axis theorem."""
        points = corners(self), corners(other)
        axes = [self.placement.rotation.T, other.placement.rotation.T]
        crossed = np.cross(axes[0][:, None], axes[1][None]).reshape(-1, 3)
        for axis in (*axes[0], *axes[1], *crossed[np.linalg.norm(crossed, axis=1) > 1e-6]):
            a, b = (p @ axis for p in points)
            if min(a.max(), b.max()) - max(a.min(), b.min()) <= 1e-5 * (a.max() - a.min()):
                return False
        return True

    def march(self, ray, far, active=True) -> marching.Marched:
        """March rays up to the distance ``far``; the resulting ``depth`` is in units of the field's frame."""
        return marching.march(self.field, *self._local(ray, far, active))

    def count(self, ray, far, active=True) -> marching.RayCounts:
        """Return the counts of the reads of :meth:`march`."""
        return marching.count(self.field, *self._local(ray, far, active))

    def replay(self, ray, far, active, marched, d_colour, d_transmittance, d_depth) -> None:
        """Call :func:`.march.replay`; ``depth`` is in units of the world."""
        moving = self.position.moving()
        with dr.resume_grad(when=moving):
            if moving:
                # Gathered, so that the kernel of the rays sums the gradients: sums of a width of 1 are kernels each
                first = dr.minimum(dr.arange(mi.UInt32, dr.width(ray.o)), 0)
                numbers = [dr.gather(mi.Float, v, first) for v in self._numbers()]
                local = self._seen_from(numbers, ray, far, active)
            else:
                local = self._local(ray, far, active)
        d_inside = d_depth * dr.detach(self.size)
        marching.replay(self.field, *local, 0.5, marched, d_colour, d_transmittance, d_inside, moving)
        if moving:
            with dr.resume_grad():
                depth = dr.select(active, d_depth * dr.detach(marched.depth), 0)
                dr.backward_from(depth * dr.gather(mi.Float, self.size, first), marching.ANY)

    def start_forward(self) -> None:
        """Determine the tangents of the placement, once before :meth:`tangent`."""
        self._turn = None
        if self.position.moving():
            with dr.resume_grad():
                self._turn = dr.forward_to(*self._numbers(), flags=marching.ANY)

    def _numbers(self) -> list:
        return [*self.axes.s, *self.axes.t, *self.axes.n, *self.origin, self.size]

    def tangent(self, ray, far, active, marched) -> tuple:
        """Call :func:`.march.tangent`; ``depth`` is in units of the world."""
        moving = self._turn is not None
        if not moving:
            local, size = self._local(ray, far, active), self.size
        else:
            with dr.resume_grad():
                # Numbers of their own: tangents pass through these more than once
                numbers = [mi.Float(dr.detach(v)) for v in self._numbers()]
                for number, change in zip(numbers, self._turn, strict=True):
                    dr.enable_grad(number)
                    dr.set_grad(number, change)
                size, local = numbers[12], self._seen_from(numbers, ray, far, active)
        colour, transmittance, depth = marching.tangent(self.field, *local, 0.5, marched, moving)
        depth = depth * dr.detach(size)
        if moving:
            depth += dr.select(active, dr.detach(marched.depth) * self._turn[12], 0)
        return colour, transmittance, depth


def corners(placed: PlacedField) -> np.ndarray:
    """Return the corners ``(8, 3)`` of a field's box in the world."""
    field = placed.field
    return placed.placement.world(np.array(list(product(*zip(field.lower, field.upper, strict=True)))))


class VariantLight:
    """Conversion of linear RGB radiance to the light of the current variant: RGB, luminance or a spectrum.

    The spectrum is that of Mitsuba's emitters: the upsampled colour, of at most ½, times that of the illuminant D65.
    """

    def __init__(self):
        self.illuminant = mi.load_dict({"type": "d65"}, parallel=False) if mi.is_spectral else None

    def of(self, colour, wavelengths, active=True):
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
        """Return the derivative of ``dot(weight, of(colour))`` with respect to ``colour``: three floats."""
        if mi.is_monochromatic:
            return mi.Array3f(*(w * weight.x for w in LUMINANCE))
        if not mi.is_spectral:
            return mi.Array3f(*weight)
        with dr.resume_grad():
            free = mi.Array3f(dr.detach(colour))
            dr.enable_grad(free)
            dr.backward_from(dr.dot(weight, self.of(free, wavelengths, active)))
            return dr.select(active & _coloured(colour), dr.grad(free), 0)

    def tangent(self, colour, change, wavelengths, active=True):
        """Return the derivative of the light of ``colour`` along ``change``."""
        if not mi.is_spectral:
            return self.of(change, wavelengths, active)
        with dr.resume_grad():
            free = mi.Array3f(dr.detach(colour))
            dr.enable_grad(free)
            dr.set_grad(free, mi.Array3f(change))
            return dr.select(active & _coloured(colour), dr.forward_to(self.of(free, wavelengths, active)), 0)


def _coloured(colour):
    """Return whether a colour is not black; black has no derivative, since its spectrum depends on its hue."""
    return dr.max(mi.Array3f(dr.detach(colour))) > 0


def to_grid(props: mi.Properties) -> None:
    """Replace the compressed field in ``filename`` by the grid that it was made from, its exact counterpart.

    Raises ``RuntimeError`` if the grid was not kept or its file does not exist.
    """
    path = Path(properties.filename(props))
    try:
        table = load(path)
    except TableError as e:
        raise RuntimeError(str(e)) from None
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
    if "storage" in props:
        del props["storage"]
