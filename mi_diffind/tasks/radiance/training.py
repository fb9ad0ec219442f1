"""Training of a radiance field through images: rays of random patches of the views, in front of random greys."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np

from ...arrays.indirection import device_tensor
from ...fitting.loop import Problem
from ...images import srgb
from .march import differentiable
from .session import PATCH, SIDE, FieldSession
from .volume_field import VolumeField

#: Largest difference of the exposure of a view from the mean, in stops.
MOST_STOPS = 3.0


class ImagesProblem(Problem):
    """Training of a field through the images of a session.

    ``net`` maps names to tensors (a dictionary or a module); ``field_of`` makes a :class:`.VolumeField` of them,
    differentiably. The loss is the mean squared difference of sRGB values in front of random greys, which trains the
    opacity, too, or in front of the background of views that have one.

    A pixel is the mean of ``side``² rays; a step has as many rays whatever that is.

    If the session has ``exposures`` (in stops), they are trained, too; their mean stays 0.
    """

    side = SIDE

    #: Chances of tiles by the errors of the field at the beginning (:meth:`.ViewImages.cumulative_errors`), if rays are
    #: drawn by them.
    cumulative = None

    def __init__(self, session: FieldSession, net, field_of: Callable[..., VolumeField]):
        if session.exposures is not None:
            net = {**net, "exposures": device_tensor(session.types.TensorXf, session.exposures)}
        self.session, self.net, self.field_of = session, net, field_of
        self.identity = {"source": session.views.digest}

    def loss(self, net, rng, size: int):
        types, images = self.session.types, self.session.images
        rays = self.side**2
        view, x, y = images.random_pixels(rng, size // rays, PATCH * SIDE // self.side, self.cumulative)
        count = dr.width(view)
        o, d = images.pixel_rays(view, x, y, self.side)
        offset = rng.random(types.TensorXf, (dr.width(o),)).array
        behind = images.behind(rng, count)
        truth = images.colours(view, x, y)
        seen = differentiable(self.field_of(net).for_training(), o, d, images.near, dr.inf, True, offset)
        dr.schedule(seen.colour, seen.transmittance)  # at once: each sum evaluates what it adds up
        *colour, transmittance = (dr.block_sum(v, rays) / rays for v in (*seen.colour, seen.transmittance))
        gain, total = self.gain(net, view), types.Float(0)
        for c in range(3):
            reference = srgb.from_linear(dr.clip(truth[c] + (1 - truth[3]) * behind[c], 0, 1), fused=False)
            # The prediction is not clamped at white: its slope leads back into the range
            shown = srgb.from_linear(gain * colour[c] + transmittance * behind[c], fused=False)
            total += dr.square(shown - reference)
        return dr.select(images.counted(view, x, y), total, 0) * (1 / (3 * count))

    def draw_by_errors(self) -> None:
        """Draw rays by the errors of the present state from now on, unless exposures are trained."""
        if self.session.exposures is None:
            self.cumulative = self.session.images.cumulative_errors(self.field_of(self.net))

    def gain(self, net, view):
        """Return the factor of the colours of the field in a view."""
        types = self.session.types
        if self.session.exposures is None:
            return types.Float(1)
        stops = net["exposures"].array
        stops = dr.gather(types.Float, stops, view) - dr.sum(stops) * (1 / len(self.session.exposures))
        return dr.exp2(dr.clip(stops, -MOST_STOPS, MOST_STOPS))

    def keep_exposures(self) -> None:
        """Let the next training of the session begin with the exposures of this one."""
        if self.session.exposures is not None:
            stops = self.net["exposures"].numpy()
            self.session.exposures = np.float32(np.clip(stops - stops.mean(), -MOST_STOPS, MOST_STOPS))

    def measure(self, net):
        return self.session.watched_images.evaluate(self.field_of(net))
