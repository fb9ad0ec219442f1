"""Settings of a capture: number and size of the views, samples, camera path."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..core.units import check_memory, check_samples
from .poses import orbit_directions, sphere_directions

#: Bytes of memory for a sample of a pass and for the camera of a view, roughly.
SAMPLE, VIEW = 512, 1024

#: Shapes of the camera path.
PATHS = ("sphere", "orbit")
#: Formats of the images.
FORMATS = ("png", "exr")


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of a capture: number and size of the views, samples, camera path.

    ``views`` are for training, ``test`` further ones for tests: square images of ``resolution`` pixels with a field of
    view ``fov`` (degrees) and ``spp`` samples a pixel. ``objects`` are the ids of the captured shapes (none: all
    surfaces that do not shine); all other shapes only cast light and shadow on them. Cameras look at ``centre``
    (default: the centre of the objects' box) from the distance ``radius`` (default: a sphere around the objects fills
    the image). ``path``: "sphere", all over it, or "orbit", once around the axis ``up``. ``elevation``: the lowest and
    the highest, degrees above the plane normal to ``up``; an orbit swings between them (default: −90, 90 for a sphere,
    20, 20 for an orbit). ``format``: "png", as displayed, 8 bits, or "exr", linear half floats. ``box``: of 3D
    Gaussians, the lower and the upper corner of what is captured (default: :meth:`.splats.Splats.cropped`).
    """

    views: int = 60
    test: int = 20
    resolution: int = 160
    spp: int = 256
    fov: float = 40.0
    centre: tuple[float, float, float] | None = None
    radius: float | None = None
    path: str = "sphere"
    elevation: tuple[float, float] | None = None
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    objects: tuple[str, ...] = ()
    seed: int = 0
    format: str = "png"
    box: tuple[float, ...] | None = None

    def check(self) -> None:
        """Raise ``ValueError`` for values that are not allowed."""
        if self.path not in PATHS:
            raise ValueError(f'path: found "{self.path}", allowed are {", ".join(PATHS)}')
        if self.format not in FORMATS:
            raise ValueError(f'format: found "{self.format}", allowed are {", ".join(FORMATS)}')
        for name, least in (("views", 1), ("test", 0), ("resolution", 1), ("spp", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}: found {getattr(self, name)}, allowed are whole numbers ≥ {least}")
        check_samples(self.spp)
        check_memory("resolution", self.resolution, SAMPLE * self.resolution**2)
        check_memory("views", self.views + self.test, VIEW * (self.views + self.test))
        if not 0 < self.fov < 170:
            raise ValueError(f"fov: found {self.fov:g}, allowed are degrees between 0 and 170")
        if self.radius is not None and not 0 < self.radius < math.inf:
            raise ValueError(f"radius: found {self.radius:g}, allowed are numbers > 0")
        if self.centre is not None and not np.isfinite(self.centre).all():
            raise ValueError("centre: found NaN or infinity, allowed are numbers")
        if not np.isfinite(self.up).all() or not np.any(self.up):
            raise ValueError("up: found no direction, allowed are three numbers that are not all 0")
        if self.box is not None and not (len(self.box) == 6 and np.less(self.box[:3], self.box[3:]).all()):
            raise ValueError("box: found no box, allowed are six numbers, those of the lower corner first")
        low, high = self.elevations
        if not -90 <= low <= high <= 90:
            raise ValueError(
                f"elevation: found {low:g} to {high:g}, allowed are degrees from −90 to 90, the lower first"
            )

    @property
    def elevations(self) -> tuple[float, float]:
        """Lowest and highest elevation, degrees: ``elevation`` or its default."""
        return self.elevation or ((20.0, 20.0) if self.path == "orbit" else (-90.0, 90.0))

    def directions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return unit vectors from the centre to the cameras, ``(views, 3)`` and ``(test, 3)``; z is up."""
        low, high = np.radians(self.elevations)
        if self.path == "orbit":
            return orbit_directions(self.views, self.test, low, high)
        return sphere_directions(self.views, self.test, low, high, self.seed)
