"""Training of a radiance field through images: rays of random patches of the views, in front of random greys."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from ... import srgb
from ...fitting import Problem
from .march import differentiable
from .session import RAYS, FieldSession
from .volume_field import VolumeField


class ImagesProblem(Problem):
    """Training of a field through the images of a session.

    ``net`` maps names to tensors (a dictionary or a module); ``field_of`` makes a :class:`.VolumeField` of them,
    differentiably. The loss is the mean squared difference of sRGB values in front of random greys, which trains the
    opacity, too, or in front of the background of views that have one.
    """

    def __init__(self, session: FieldSession, net, field_of: Callable[..., VolumeField]):
        self.session, self.net, self.field_of = session, net, field_of
        self.identity = {"source": session.views.digest}

    def loss(self, net, rng, size: int):
        types, images = self.session.types, self.session.images
        view, x, y = images.random_pixels(rng, size // RAYS)
        count = dr.width(view)
        o, d = images.pixel_rays(view, x, y)
        offset = rng.random(types.TensorXf, (dr.width(o),)).array
        behind = images.behind(rng, count)
        truth = images.colours(view, x, y)
        seen = differentiable(self.field_of(net).for_training(), o, d, 0, dr.inf, True, offset)
        dr.schedule(seen.colour, seen.transmittance)  # at once: each sum evaluates what it adds up
        *colour, transmittance = (dr.block_sum(v, RAYS) / RAYS for v in (*seen.colour, seen.transmittance))
        total = types.Float(0)
        for c in range(3):
            reference = srgb.from_linear(dr.clip(truth[c] + (1 - truth[3]) * behind[c], 0, 1), fused=False)
            # The prediction is not clamped at white: its slope leads back into the range
            shown = srgb.from_linear(colour[c] + transmittance * behind[c], fused=False)
            total += dr.square(shown - reference)
        return dr.select(images.counted(view, x, y), total, 0) * (1 / (3 * count))

    def measure(self, net):
        return self.session.watched_images.evaluate(self.field_of(net))
