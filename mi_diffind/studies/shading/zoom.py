"""Zoom of the shading study: a shaded plane that a camera moves towards.

The camera looks straight down, so a pixel's footprint is a square, as levels of detail assume, and each pixel is seen
from its own direction under one light. Images are those of a reader, without a renderer and its noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...images import srgb
from ...maps.pyramid import Pyramid
from ...measure.flicker import POINTS, MovingView
from ...tasks.disney.model import Effects
from ...tasks.shading.evaluation import ShadedReader, reference

#: Texels along a pixel in the first and in the last frame.
FAR, NEAR = 12.0, 3.0

#: Field of view in degrees, and the direction to the light.
FOV, LIGHT = 50.0, (0.45, 0.25, 0.86)


@dataclass(frozen=True)
class ShadedZoom(MovingView):
    """A zoom into a material: ``frames`` of ``side`` × ``side`` pixels."""

    pyramid: Pyramid
    effects: Effects
    frames: int = 60
    side: int = 96

    @cached_property
    def spacings(self) -> np.ndarray:
        """Texels along a pixel, for each frame."""
        return FAR * (NEAR / FAR) ** (np.arange(self.frames) / max(self.frames - 1, 1))

    def lanes(self, frame: int) -> tuple:
        """Return ``(u, v, level, wi, wo)`` of the pixels of a frame, row by row."""
        types, layout = self.pyramid.types, self.pyramid.layout
        spacing = self.spacings[frame]
        offset = np.arange(self.side) + 0.5 - self.side / 2
        x, y = (a.ravel() for a in np.meshgrid(offset, offset))
        distance = 0.5 * self.side / np.tan(np.radians(FOV) / 2)
        view = np.stack([-x, -y, np.full_like(x, distance)])
        view /= np.linalg.norm(view, axis=0)
        u, v = 0.5 + x * spacing / layout.width, 0.5 + y * spacing / layout.height
        u, v = (types.Float(aligned_copy(a - np.floor(a), np.float32)) for a in (u, v))
        light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
        wo = types.Array3f(*(dr.opaque(types.Float, float(c), len(x)) for c in light))
        level = dr.opaque(types.Float, float(np.log2(spacing)), len(x))
        wi = types.Array3f(*(types.Float(aligned_copy(c, np.float32)) for c in view))
        lanes = (u, v, level, wi, wo)
        dr.eval(lanes)
        return lanes

    def render(self, read: ShadedReader) -> np.ndarray:
        """Return the frames as displayed, ``(frames, side, side, 3)``."""
        images = []
        for frame in range(self.frames):
            with dr.suspend_grad():
                value = read(*self.lanes(frame))
                dr.eval(value)
                image = np.stack([c.numpy() for c in value], axis=-1)
            images.append(srgb.for_display(image.reshape(self.side, self.side, 3)).astype(np.float32))
        return np.stack(images)

    @cached_property
    def truth(self) -> np.ndarray:
        """The converged frames, as displayed."""
        return self.render(lambda *lanes: reference("converged", self.pyramid, *lanes, self.effects))

    def places(self, frame: int) -> np.ndarray:
        extent = 0.47 * self.side * NEAR
        x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-extent, extent, POINTS)] * 2))
        return np.stack([x, y], axis=-1) / self.spacings[frame] + self.side / 2
