"""3D Gaussians of "3D Gaussian Splatting" (Kerbl et al. 2023), and views of them for a field.

Files are PLY as the reference implementation writes it, text or binary. Mitsuba traces the Gaussians: the shape
``ellipsoidsmesh`` orders them along a ray, and the integrator ``volprim_rf_basic`` gives the transmittance and the
colour of each. Two things are added to that integrator. It has an alpha of 1 everywhere, here rays keep their
transmittance. And its rays go on 1e-4 behind each hit, whatever the scene's size, which skips Gaussians of a small
scene; here all scenes are traced at one size.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
import re
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from ..core import compat
from ..core.errors import UsageError, reason
from ..core.files import irregular, shown, unused_note
from ..core.units import check_memory, memory
from ..images.srgb import to_linear

#: Names of properties that every Gaussian of a PLY file has, in the order of the arrays that they become.
NAMES = (*"xyz", "scale_0", "scale_1", "scale_2", "rot_1", "rot_2", "rot_3", "rot_0", "opacity")
NAMES += ("f_dc_0", "f_dc_1", "f_dc_2")

#: Arrays of :class:`Splats`, in their order.
ARRAYS = ("centres", "scales", "quaternions", "opacities", "colours")

#: Numbers of further coefficients ``f_rest_*``: spherical harmonics of degree 0 to 3.
REST = (0, 9, 24, 45)

#: Ends of the names of files of 3D Gaussians. Only PLY is read.
EXTENSIONS = (".ply", ".sog", ".spz", ".splat", ".ksplat", ".lcc", "meta.json")

#: Largest coordinate and standard deviation.
FARTHEST = 1e18

#: Opacity below which a Gaussian is left out: it changes no 8-bit value.
FAINT = 1 / 255

#: Contribution to a ray at which a Gaussian ends, for boxes.
EDGE = 0.05

#: Share of opacity below and above the box of most Gaussians along an axis. Gaussians outside count as strays.
STRAY = 0.01

#: Part of the sides of the box of most Gaussians by which it is widened.
WIDER = 0.25

#: Half diagonal of the box of all Gaussians while they are traced.
SIZE = 100.0

#: Step behind a hit, at that size.
STEP = 1e-4

#: Transmittance at which a ray ends, and counts as stopped.
OPAQUE = 0.01

#: Samples of one pass.
PASS = 1 << 21

#: Bytes of memory for a Gaussian, roughly: a shell of 20 triangles.
GAUSSIAN_BYTES = 4096

#: Default number of samples a pixel.
SPP = 4


def is_splats(source) -> bool:
    """Return whether a source is the name of a file of Gaussians (:data:`EXTENSIONS`)."""
    return isinstance(source, (str, os.PathLike)) and os.fspath(source).lower().endswith(EXTENSIONS)


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians of a file, as arrays of float32.

    ``centres`` ``(N, 3)``; ``scales`` ``(N, 3)``, standard deviations along the axes that the ``quaternions``
    ``(N, 4)`` (x, y, z, w, of length 1) turn; ``opacities`` ``(N,)`` in [0, 1]; ``colours`` ``(N, K, 3)``, coefficients
    of spherical harmonics, whose sum plus 0.5 is the colour as displayed (sRGB). ``digest`` is the SHA-256 of the
    file, ``notes`` are sentences on what is not used of it.
    """

    path: Path
    centres: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    colours: np.ndarray
    digest: str
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.centres)

    @staticmethod
    def read(path: str | os.PathLike) -> Splats:
        """Read a PLY file. Raises :class:`.UsageError`."""
        path = Path(path)
        if fault := irregular(path, memory() // 4) or ("" if path.exists() else "no such file"):
            raise UsageError(f"{shown(path)}: {fault}")
        try:
            return _read_ply(path)
        except UsageError as e:
            raise UsageError(f"{path}: {e}") from None
        except Exception as e:  # trimesh and NumPy raise errors of their own for a damaged file
            raise UsageError(f"{path}: cannot be read as 3D Gaussians, or is damaged ({reason(e)})") from None

    def select(self, which: np.ndarray) -> Splats:
        """Return the Gaussians of a mask ``(N,)``."""
        return dataclasses.replace(self, **{name: getattr(self, name)[which] for name in ARRAYS})

    def crop(self, box=None) -> Splats:
        """Return the visible Gaussians whose centres lie in a ``box``: lower corner, upper corner.

        The default box holds 98% of the opacity along each axis, and a quarter more on both sides. Raises
        :class:`UsageError` if none is left.
        """
        visible = self.select(self.opacities >= FAINT)
        if not len(visible):
            raise UsageError(f"{self.path}: has {len(self):,} Gaussians, none with an opacity of 1/255 or more")
        most = visible._box_without_strays()
        box = most if box is None else np.array(box, np.float64).reshape(2, 3)
        inside = ((visible.centres >= box[0]) & (visible.centres <= box[1])).all(axis=1)
        if not inside.any():
            text = " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in most)
            raise UsageError(f"box: holds none of the {len(self):,} Gaussians of {self.path}, most lie in {text}")
        return visible.select(inside)

    def _box_without_strays(self) -> np.ndarray:
        """Return the box ``(2, 3)`` outside of which Gaussians count as strays."""
        box = []
        for values in self.centres.T.astype(np.float64):
            order = np.argsort(values)
            weight = np.cumsum(self.opacities[order], dtype=np.float64)
            box.append(values[order[np.searchsorted(weight, weight[-1] * np.array([STRAY, 1 - STRAY]))]])
        box = np.stack(box, axis=1)
        return box + np.array([[-WIDER], [WIDER]]) * (box[1] - box[0])

    def extents(self) -> np.ndarray:
        """Return half the sides ``(N, 3)`` of the box around each Gaussian, where it adds more than 5% to a ray."""
        rotations = Rotation.from_quat(self.quaternions).as_matrix()
        reach = np.sqrt(2 * np.log(np.maximum(self.opacities / EDGE, 1), dtype=np.float64))
        return reach[:, None] * np.sqrt(np.einsum("nij,nj->ni", np.square(rotations), np.square(self.scales)))

    def box(self) -> np.ndarray:
        """Return the corners ``(2, 3)`` of the box around all Gaussians."""
        extents = self.extents()
        return np.stack([(self.centres - extents).min(axis=0), (self.centres + extents).max(axis=0)])


def _read_ply(path: Path) -> Splats:
    """Return the Gaussians of a PLY file, which holds logarithms of scales and quaternions of any length."""
    from trimesh.exchange.ply import load_ply

    content = path.read_bytes()
    packed = re.search(rb"property\s+\w+\s+packed_position\s", content.partition(b"end_header")[0])
    if packed or path.suffix.lower() != ".ply":
        fault = "compressed Gaussians" if packed else "Gaussians in another format"
        advice = f'PlayCanvas\' splat-transform converts it ("splat-transform {path.name} OUTPUT.ply")'
        raise UsageError(f"holds {fault}, an uncompressed PLY file is needed: {advice}")
    elements = load_ply(io.BytesIO(content))["metadata"]["_ply_raw"]
    vertices = elements["vertex"]["data"]
    names = vertices.dtype.names if isinstance(vertices, np.ndarray) else tuple(vertices)
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in REST:
        raise UsageError(f"has {rest} properties f_rest_*, allowed are {', '.join(map(str, REST))}")
    used = (*NAMES, *(f"f_rest_{i}" for i in range(rest)))
    if missing := [name for name in used if name not in names]:
        raise UsageError(f"holds no 3D Gaussians, its vertices lack {', '.join(missing)}")
    columns = np.stack([np.asarray(vertices[name], np.float64).reshape(-1) for name in used], axis=1)
    if not len(columns):
        raise UsageError("holds no Gaussians")
    for name, values in zip(used, columns.T, strict=True):
        if not np.isfinite(values).all():
            raise UsageError(f"has {np.count_nonzero(~np.isfinite(values)):,} {name} that are NaN or infinite")
    centres, scales, quaternions, opacities, first, others = np.split(columns, (3, 6, 10, 11, 14), axis=1)
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not lengths.all():
        raise UsageError(f"has {np.count_nonzero(lengths == 0):,} rotations of length 0")
    with np.errstate(over="ignore"):
        scales, opacities = np.exp(scales), 1 / (1 + np.exp(-opacities[:, 0]))
    if scales.max() > FARTHEST or np.abs(centres).max() > FARTHEST:
        raise UsageError("has places or scales above 1e18, are the scales logarithms?")
    others = others.reshape(len(others), 3, rest // 3).swapaxes(1, 2)  # all of red first
    colours = np.concatenate([first[:, None], others], axis=1)
    # Normals are 0 in the files of the reference implementation
    unused = [name for name in names if name not in used and np.any(vertices[name])]
    note = unused_note(path, [], (*unused, *(name for name in elements if name != "vertex")))
    arrays = (centres, scales, quaternions / lengths, opacities, colours)
    digest = hashlib.sha256(content).hexdigest()
    return Splats(path, *(array.astype(np.float32) for array in arrays), digest, (note,) if note else ())


class SplatSubject:
    """Gaussians of a file as the subject of a capture, cropped to the ``box`` of the settings.

    ``settings`` are :class:`.capture.CaptureSettings`. Raises :class:`.UsageError`, also in a variant without RGB, and
    if the Gaussians need more memory than there is.
    """

    def __init__(self, path: str | os.PathLike, settings):
        self.path, self.settings = Path(path), settings
        if not mi.is_rgb:
            raise UsageError(f"{path}: the variant {mi.variant()} shows no Gaussians, one with rgb is needed")
        splats = Splats.read(path)
        self.splats, self.notes = splats.crop(settings.box), splats.notes
        check_memory(f"{path}: Gaussians", len(self.splats), GAUSSIAN_BYTES * len(self.splats))
        box = self.splats.box()
        self.centre, self.scale = box.mean(axis=0), SIZE / max(np.linalg.norm(box[1] - box[0]) / 2, 1e-30)

    def record(self) -> dict:
        """Return what the images depend on beside the settings."""
        return {"scene": self.path.name, "defines": {}, "digest": self.splats.digest}

    def bounds(self) -> np.ndarray:
        """Return the corners ``(2, 3)`` of the Gaussians' box."""
        return self.splats.box()

    def reach(self, centre: np.ndarray) -> float:
        """Return the radius of a sphere around a point that holds the Gaussians' box."""
        return float(np.linalg.norm(np.abs(self.bounds() - centre).max(axis=0)))

    def prepare(self) -> None:
        """Load the scene of the Gaussians, at the traced size."""
        splats = self.splats
        centres = (splats.centres - self.centre) * self.scale
        data = np.concatenate([centres, splats.scales * self.scale, splats.quaternions], axis=1)
        arrays = {
            "data": data, "opacities": splats.opacities[:, None], "sh_coeffs": splats.colours.reshape(len(splats), -1),
        }  # fmt: skip
        tensors = {name: mi.TensorXf(np.ascontiguousarray(array, np.float32)) for name, array in arrays.items()}
        self.scene = mi.load_dict({"type": "scene", "splats": {"type": "ellipsoidsmesh", **tensors}})
        self.integrator = mi.load_dict({"type": "volprim_rf_basic", "srgb_primitives": False})

    def render(self, pose: np.ndarray, seed: int) -> np.ndarray:
        """Render a view, ``(height, width, 4)``, float32: linear colours, multiplied by alpha, and alpha."""
        side, spp = self.settings.resolution, self.settings.spp
        rng = np.random.default_rng(seed)
        shift, total = rng.random((2, side * side)), np.zeros((side * side, 4))
        y, x = np.divmod(np.arange(side * side), side)
        slope = 2 * np.tan(np.radians(self.settings.fov) / 2) / side
        at_once = max(1, PASS // side**2)
        for first in range(0, spp, at_once):
            # Points of the sequence R2 (Roberts 2018), moved by a random offset in each pixel
            numbers = np.arange(first, min(spp, first + at_once))[:, None]
            u, v = ((numbers * step + s) % 1 for step, s in zip((0.7548776662, 0.5698402910), shift, strict=True))
            d = np.stack([(x + u - side / 2) * slope, (side / 2 - y - v) * slope, -np.ones_like(u)], axis=-1)
            d = (d / np.linalg.norm(d, axis=-1, keepdims=True)).reshape(-1, 3) @ pose[:3, :3].T
            total += self.trace((pose[:3, 3] - self.centre) * self.scale, d).reshape(len(numbers), -1, 4).sum(axis=0)
        image = (total / spp).reshape(side, side, 4)
        alpha = image[..., 3:]
        straight = np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
        return np.concatenate([to_linear(straight) * alpha, alpha], axis=-1).astype(np.float32)

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return sRGB multiplied by alpha, and alpha, ``(N, 4)``, along rays from one point, at the traced size."""
        ahead = np.maximum(0, -(directions @ origin) - 2 * SIZE)  # far origins are not exact enough
        points = origin + ahead[:, None] * directions
        p, d = (np.ascontiguousarray(v.T, np.float32) for v in (points, directions))
        colour, transmittance = composite(self.scene, self.integrator, mi.Point3f(p), mi.Vector3f(d))
        return np.concatenate([colour.numpy().T, 1 - transmittance.numpy()[:, None]], axis=1)


@compat.syntax
def composite(scene, integrator, p, d):
    """Return the colour (sRGB) of the Gaussians along rays, and the transmittance behind them.

    Where the transmittance falls below :data:`OPAQUE`, the ray ends, and the colour is divided by the opacity.
    """
    ray, p = mi.Ray3f(p, d), mi.Point3f(p)
    colour, transmittance, active = mi.Color3f(0), mi.Float(1), mi.Bool(True)
    while active:
        si = scene.ray_intersect(mi.Ray3f(p, d), mi.RayFlags.Minimal, False, active)
        active &= si.is_valid()
        passed = integrator.eval_transmission(si, ray, active)
        emitted = integrator.eval_sh_emission(si, ray, active)
        colour[active] = colour + transmittance * (1 - passed) * emitted
        transmittance[active] = transmittance * passed
        p[active] = p + (si.t + STEP) * d
        active &= transmittance > OPAQUE
    stopped = transmittance <= OPAQUE
    return colour * dr.select(stopped, dr.rcp(1 - transmittance), 1), dr.select(stopped, 0, transmittance)
