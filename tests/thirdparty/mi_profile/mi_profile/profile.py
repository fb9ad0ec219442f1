"""A texture that is a measured goniometric profile, linear between its angles."""

from __future__ import annotations  # Delayed parsing of type annotations

import math

import drjit as dr
import mitsuba as mi

from mi_diffind.plugins import Plugin

from . import measurement
from .training import exact


class Profile(mi.Texture):
    r""".. _texture-profile:

    Goniometric profile (:monosp:`profile`)
    ---------------------------------------

    .. pluginparameters::

     * - source
       - |string|
       - A file of angles from the axis and intensities, ``angle_deg,intensity_cd``.

     * - fov
       - |float|
       - The angle of view, in degrees, of what is projected: that between the directions of :math:`u = 0` and
         :math:`u = 1`. (Default: 90)

    The intensity, relative to the largest one, in the direction of a place on the image plane: the axis passes through
    its middle. Meant for the :monosp:`projector`, with the same ``fov``.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        fov = float(props.get("fov", 90.0))
        if not 0 < fov < 180:
            raise RuntimeError(f'parameter "fov": found {fov:g}, allowed are 0° to 180°')
        self.slope = 2 * math.tan(math.radians(fov) / 2)
        self.net = self.opened(props)

    def opened(self, props: mi.Properties):
        """Return the intensity, relative to the peak, as a function of the angle over 90°."""
        source = str(props.get("source", ""))
        if not source:
            raise RuntimeError('parameter "source": not given, a file of angles and intensities is needed')
        try:
            return exact(measurement.read(str(mi.file_resolver().resolve(source))), mi.TensorXf)
        except measurement.ProfileError as e:
            raise RuntimeError(f'parameter "source": {e}') from None

    def traverse(self, cb: mi.TraversalCallback):
        cb.put("data", self.net.data, mi.ParamFlags.Differentiable)

    def value(self, uv) -> mi.Float:
        """The intensity at a place, relative to the peak."""
        angle = dr.atan(self.slope * dr.norm(uv - 0.5))
        return dr.maximum(self.net([angle * (2 / dr.pi)])[0], 0)

    def eval(self, si, active=True):
        return mi.UnpolarizedSpectrum(self.value(si.uv))

    def eval_1(self, si, active=True):
        return self.value(si.uv)

    def eval_3(self, si, active=True):
        return mi.Color3f(self.value(si.uv))

    def mean(self):
        n = 64
        i = dr.arange(mi.UInt32, n * n)
        return dr.mean(self.value(mi.Point2f((mi.Float(i % n) + 0.5) / n, (mi.Float(i // n) + 0.5) / n)))

    def max(self):
        return 1.0

    def is_spatially_varying(self):
        return True

    def resolution(self):
        return mi.ScalarVector2i(256, 256)

    def sample_position(self, sample, active=True):
        return sample, mi.Float(1)

    def pdf_position(self, pos, active=True):
        return mi.Float(1)

    def to_string(self):
        return f"{type(self).__name__}[slope = {self.slope:g}]"


PLUGIN = Plugin("profile", "texture", Profile)
