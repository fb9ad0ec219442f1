"""
Flicker of a shaded plane that a camera moves towards: what the same points look like meanwhile.

The camera looks straight down, so a pixel's footprint is the square that levels of detail stand for, and each pixel is
seen from its own direction under one light. The images are those of a reader, without a renderer and its noise. Frames
are aligned and flicker is measured as in the study of filtered textures (:mod:`..texture.zoom`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import numpy as np

from ... import srgb
from ...maps.pyramid import Pyramid
from ...tasks.disney.effects import Effects
from ...tasks.shading.evaluation import ShadedReader
from ...tasks.shading.reference import reference
from ..texture.zoom import bilinear, flicker

#: Texels along a pixel in the first and in the last frame.
FAR, NEAR = 12.0, 3.0

#: Width of the view in degrees, and where light comes from.
FOV, LIGHT = 50.0, (0.45, 0.25, 0.86)

#: Points of the plane along each side that are looked at.
GRID = 96


@dataclass(frozen=True)
class Motion:
    """``frames`` of ``side`` × ``side`` pixels of a material."""

    pyramid: Pyramid
    effects: Effects
    frames: int = 60
    side: int = 96

    @cached_property
    def spacings(self) -> np.ndarray:
        """Texels along a pixel, of each frame."""
        return FAR * (NEAR / FAR) ** (np.arange(self.frames) / max(self.frames - 1, 1))

    def lanes(self, frame: int) -> tuple:
        """``(u, v, level, wi, wo)`` of the pixels of a frame, row by row."""
        types, layout = self.pyramid.types, self.pyramid.layout
        spacing = self.spacings[frame]
        offset = np.arange(self.side) + 0.5 - self.side / 2
        x, y = (a.ravel() for a in np.meshgrid(offset, offset))
        distance = 0.5 * self.side / np.tan(np.radians(FOV) / 2)
        towards = np.stack([-x, -y, np.full_like(x, distance)])
        towards /= np.linalg.norm(towards, axis=0)
        u, v = 0.5 + x * spacing / layout.width, 0.5 + y * spacing / layout.height
        u, v = (types.Float((a - np.floor(a)).astype(np.float32)) for a in (u, v))
        light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
        wo = types.Array3f(*(dr.opaque(types.Float, float(c), len(x)) for c in light))
        level = dr.opaque(types.Float, float(np.log2(spacing)), len(x))
        found = (u, v, level, types.Array3f(*(types.Float(c.astype(np.float32)) for c in towards)), wo)
        dr.eval(found)
        return found

    def render(self, read: ShadedReader) -> np.ndarray:
        """The frames as displayed, ``(frames, side, side, 3)``."""
        return np.stack([self._shown(read(*self.lanes(k))) for k in range(self.frames)])

    @cached_property
    def truth(self) -> np.ndarray:
        """The converged frames, as displayed."""
        return self.render(lambda *lanes: reference("converged", self.pyramid, *lanes, self.effects))

    def _shown(self, value) -> np.ndarray:
        dr.eval(value)
        with dr.suspend_grad():
            image = np.stack([c.numpy() for c in value], axis=-1)
        return srgb.for_display(image.reshape(self.side, self.side, 3)).astype(np.float32)

    def aligned(self, frames: np.ndarray) -> np.ndarray:
        """What points of the plane look like that all frames show, ``(frames, n, 3)``."""
        extent = 0.47 * self.side * NEAR
        x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-extent, extent, GRID)] * 2))
        found = []
        for image, spacing in zip(frames, self.spacings, strict=True):
            found.append(bilinear(image, np.stack([x, y], axis=-1) / spacing + self.side / 2))
        return np.stack(found)

    def errors(self, read: ShadedReader) -> dict[str, float]:
        """``flicker``, and ``flicker_error``, that of the difference to the truth."""
        frames, truth = self.aligned(self.render(read)), self.aligned(self.truth)
        return {"flicker": flicker(frames), "flicker_error": flicker(frames - truth)}
