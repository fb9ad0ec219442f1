"""Sources of learned BSDFs as they were measured: their symmetries, spectra as colours, and rows of values.

- Symmetries are measured before they are assumed.
- Tensor files of Mitsuba's ``measured`` (Dupuy and Jakob 2018) and ``measured_polarized`` (Baek et al., *Image-Based
  Acquisition and Modeling of Polarimetric Reflectance*, SIGGRAPH 2020) hold spectra. These are integrated with the CIE
  1931 observer and the spectrum of the illuminant, and scaled so that a perfect reflector has the luminance 1. Under
  ``D65`` it is white: this is what spectral variants of Mitsuba show in the light of RGB emitters. ``E`` is the light
  of equal energy.
- A ``.csv`` file has a header of names (in any order) and one row for each measurement: two directions by angles, and
  f without the cosine in linear sRGB. Lines that start with # are comments. Nothing is known between the rows: proxy
  and residual are trained on nine tenths of them and measured on the rest, and sampling and the limit of the albedo
  follow from the fitted BSDF. The loss is a weighted mean of absolute differences, so that noise and outliers move it
  little.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp
from ...core import tensor_files
from ...core.archives import Allowance
from ...core.compat import backend_module
from ...core.errors import UsageError, reason
from .directions import Samples, incident, outgoing
from .mixture import TurnedMixture
from .model import BSDFArrays, DirectionPair, Form, LearnedBSDF, rotate, turn
from .pairs import LEAST_ROWS, along_x, exchange, irreciprocal_share, places
from .training import proxy_array, residual_range

#: Relative difference up to which a symmetry is assumed.
TOLERANCE = 0.01

#: That of an isotropic function about the plane of incidence: trained networks are off by up to 7%, and the arrays
#: have twice the entries for an azimuth then.
MIRROR_TOLERANCE = 0.1

#: Azimuth of the axes of a source below which they count as those of the surface, radians.
TURN = math.radians(0.5)

#: Share of a function, neither reciprocal nor symmetric, beyond which its symmetric part is fitted.
ASYMMETRY = 1e-3

#: Largest value f cos θ that counts; a source may exceed it next to the horizon.
LARGEST = 1e8

#: Illuminants, the first is the default.
ILLUMINANTS = ("D65", "E")

#: Line about the colours of a spectral file.
REMARK = "spectra as linear sRGB under the illuminant {}"

#: Columns of angles that a file needs.
ANGLES = ("theta_i", "phi_i", "theta_o", "phi_o")

#: Columns of values that a file needs.
VALUES = ("r", "g", "b")

#: Columns that a file may have.
OPTIONAL = ("solid_angle", "weight")

#: Share of the rows that measure the result.
VALIDATION = 0.1

#: Smallest cosine of a direction that counts.
HORIZON = 1e-3

#: Neighbours that determine the density of rows.
DENSITY = 8

#: Neighbours that a row is compared with.
NEIGHBOURS = 16


class Truth:
    """Base class of sources.

    ``name`` describes the source; ``digest`` changes when its content does; ``samples``: it samples directions itself;
    ``isotropic``: it is isotropic by its format (``None``: it has to be measured). ``function``: its values are known
    for all directions. ``remark``: line about how it was read, for people.
    """

    name: str
    digest: str
    samples, function, remark = False, True, ""
    isotropic: bool | None = None

    def value(self, wi, wo) -> list:
        """Return f cos θ_o in linear sRGB, three arrays, for unit directions above the surface."""
        raise NotImplementedError

    def remarks(self, samples) -> list[str]:
        """Return sentences about what a fit to the values of ``samples`` leaves out. Raises ``UsageError``."""
        return []

    def sample(self, wi, w, u, v):
        """Return directions ``wo`` from three uniform numbers each."""
        raise NotImplementedError

    def density(self, wi, wo):
        """Return the density of :meth:`sample` per solid angle."""
        raise NotImplementedError


def value_remarks(name: str, values: np.ndarray) -> list[str]:
    """Return sentences about values that are not finite or negative; ``values``: (3, n).

    Raises :class:`UsageError` if more than 1% are not finite.
    """
    if not values.size:
        raise UsageError(f"{name}: none of its values is valid")
    bad, remarks = float((~np.isfinite(values)).any(axis=0).mean()), []
    if bad > 0.01:  # a few are at the horizon
        raise UsageError(f"{name}: {bad:.1%} of its values are not finite, nothing can be fitted to them")
    if bad:
        remarks.append(f"{bad:.2g} of its values are not finite and count as 0")
    if large := float((values > LARGEST).mean()):
        remarks.append(f"{min(100 * large, 99):.2g}% of its values are above {LARGEST:g} and count as that")
    if negative := float((values < 0).mean()):
        if not (values > 0).any():
            raise UsageError(f"{name}: none of its values is above 0, nothing can be fitted to them")
        remarks.append(f"{min(100 * negative, 99):.2g}% of its values are negative, a learned BSDF has 0 there")
    return remarks


class FunctionTruth(Truth):
    """Source whose values f cos θ_o are those of a function ``value(wi, wo)``, sampled by a mixture, if any."""

    def __init__(self, name: str, value: Callable, mixture=None):
        self.name, self.digest, self.value = name, "", value
        if mixture is not None:
            self.samples, self.sample, self.density = True, mixture.sample, mixture.density


def rotate_truth(truth: Truth, angle: float) -> Truth:
    """Return a source after a rotation about the normal by ``angle``, radians."""

    def value(wi, wo) -> list:
        return truth.value(rotate(wi, -angle), rotate(wo, -angle))

    return FunctionTruth(truth.name, value, TurnedMixture(truth, angle) if truth.samples else None)


#: Diffuse source of albedo 1.
WHITE = FunctionTruth("white", lambda wi, wo: [wo.z * dr.inv_pi] * 3)


# -- symmetries --------------------------------------------------------------------------------------------------------


def axes_angle(samples: Samples, truth: Truth) -> float:
    """Return the azimuth of the axes of an anisotropic source, radians from −π/4 to π/4.

    They are the principal axes of the half vectors, weighted by the squares of contributions, most of which lie in the
    peak. The values of a function are averaged over four rotations of each sample, which removes their isotropic part.
    The result is 0 if it is below :data:`TURN`, or if halves of the samples disagree by more than 4 degrees.
    """
    index = dr.arange(dr.uint32_array_t(type(samples.weight)), min(2**18, dr.width(samples.weight)))
    samples, moments = samples.at(index), 0
    half = samples.wi + samples.wo
    half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
    for k in range(4 if truth.function else 1):
        angle = k * math.pi / 4
        value = truth.value(rotate(samples.wi, angle), rotate(samples.wo, angle)) if k else samples.value
        light, h = samples.weight * dr.square(value[0] + value[1] + value[2]), rotate(half, angle)
        if not truth.function:  # rows may be outliers
            light = dr.minimum(light, float(np.quantile(light.numpy(), 0.999)))
        columns = [light * (dr.square(h.x) - dr.square(h.y)), 2 * light * h.x * h.y]
        moments = moments + np.stack([dr.detach(c).numpy() for c in columns]).astype(np.float64)
    angles = [0.5 * math.atan2(*part.sum(axis=1)[::-1]) for part in (moments, moments[:, ::2], moments[:, 1::2])]
    apart = (angles[1] - angles[2] + math.pi / 2) % math.pi - math.pi / 2
    angle = angles[0] - round(angles[0] / (math.pi / 2)) * (math.pi / 2)
    return angle if abs(angle) > TURN and abs(apart) < math.radians(4) else 0.0


def reflect(w, wi):
    """Return directions after a reflection at the plane of ``wi`` and the normal; none at normal incidence."""
    r2 = dr.square(wi.x) + dr.square(wi.y)
    along, across = ((a / dr.maximum(r2, 1e-12)) for a in (w.x * wi.x + w.y * wi.y, w.y * wi.x - w.x * wi.y))
    return dr.select(r2 > 1e-12, type(w)(along * wi.x + across * wi.y, along * wi.y - across * wi.x, w.z), w)


def symmetric_part(truth: Truth, mirror: bool) -> FunctionTruth:
    """Return the reciprocal part of a source, with ``mirror`` symmetric about the plane of incidence, too.

    It is the mean over exchanged, and over mirrored directions: absolute errors alone allow any value between both.
    """

    def value(wi, wo) -> list:
        pairs = [(wi, wo), *([(wi, reflect(wo, wi))] if mirror else [])]
        terms = [truth.value(i, o) for i, o in pairs]
        terms += [[v * wo.z / wi.z for v in truth.value(o, i)] for i, o in pairs]
        return [sum(channel) / len(terms) for channel in zip(*terms, strict=True)]

    return FunctionTruth(truth.name, value, truth if truth.samples else None)


def fitted_part(truth: Truth, symmetries: dict[str, float | None], mirror: bool) -> Truth:
    """Return what is fitted of a source: its symmetric part, if the rest is more than :data:`ASYMMETRY`."""
    rest = max(symmetries["reciprocity"] or 0, (symmetries["mirror"] or 0) if mirror else 0)
    return symmetric_part(truth, mirror) if rest > ASYMMETRY else truth


def measure_symmetry(truth, types, size: int = 2**16) -> dict[str, float]:
    """Return the relative difference of f that each symmetry would hide.

    ``isotropy``: rotation about the normal; ``mirror``: reflection at the plane of incidence; ``reciprocity``: exchange
    of the directions. Each is a mean of absolute differences over the mean value, weighted by both cosines; that of
    reciprocity is halved, which no reciprocal model can be nearer than. At angles up to 85°; 0 for what the format
    implies.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, 1))
    samples = outgoing(rng, types, incident(rng, types, size, isotropic=False), truth)
    wi, wo = samples.wi, samples.wo
    weight = dr.select(dr.minimum(wi.z, wo.z) > 0.087, samples.weight, 0)
    sin, cos = dr.sincos(2 * dr.pi * rng.random(types.Float, size))

    value = truth.value(wi, wo)
    others = {
        "isotropy": truth.value(turn(wi, sin, cos), turn(wo, sin, cos)),
        "mirror": truth.value(wi, reflect(wo, wi)),
        "reciprocity": [v * wo.z / wi.z for v in truth.value(wo, wi)],
    }
    total = sum(dr.sum(weight * wi.z * v) for v in value)
    result = {}
    for name, other in others.items():
        difference = sum(dr.sum(weight * wi.z * dr.abs(a - b)) for a, b in zip(value, other, strict=True))
        result[name] = float((difference / dr.maximum(total, 1e-20))[0])
    result["reciprocity"] /= 2
    if truth.isotropic:
        result["isotropy"] = 0.0
    return result


# -- spectra -----------------------------------------------------------------------------------------------------------


def colour_weights(wavelengths: np.ndarray, illuminant: str) -> np.ndarray:
    """Return the weights ``(n, 3)`` of values at ``n`` wavelengths (nm) in a colour of linear sRGB.

    Values are interpolated linearly between wavelengths, and constant beyond the first and last one.
    """
    import mitsuba as mi

    grid = np.arange(mi.MI_CIE_MIN, mi.MI_CIE_MAX + 0.5)
    nodes = mi.Float(grid.astype(np.float32))
    observer = mi.cie1931_xyz(nodes)
    colours = np.stack([c.numpy() for c in mi.xyz_to_srgb(observer)], axis=1).astype(np.float64)
    light = mi.cie_d65(nodes).numpy().astype(np.float64) if illuminant == "D65" else np.ones(len(grid))
    density = light[:, None] * colours / (light @ observer.y.numpy().astype(np.float64))
    order = np.argsort(wavelengths)
    hats = np.stack([np.interp(grid, wavelengths[order], row) for row in np.eye(len(wavelengths))[:, order]])
    return hats @ density


def measured_bsdf(path: Path, illuminant: str):
    """Return Mitsuba's ``measured`` of a file in an RGB variant, and a remark about colours ("" for an RGB file).

    Raises :class:`UsageError`, and as Mitsuba does.
    """
    import mitsuba as mi

    fields = tensor_files.read(path)
    tensor_files.check(path, fields)
    if "wavelengths" not in fields or mi.is_spectral:
        return mi.load_dict({"type": "measured", "filename": str(path)}), ""
    fields = {name: np.asarray(value) for name, value in fields.items()}
    weights = colour_weights(fields.pop("wavelengths").astype(np.float64), illuminant).astype(np.float32)
    rgb = np.einsum("ptwyx,wc->ptcyx", fields.pop("spectra"), weights)
    fields["rgb"] = np.ascontiguousarray(rgb, np.float32)
    with tempfile.TemporaryDirectory() as folder:
        converted = os.path.join(folder, path.name)
        tensor_files.write(converted, fields)
        return mi.load_dict({"type": "measured", "filename": converted}), REMARK.format(illuminant)


def has_one_azimuth(path: Path) -> bool:
    """Return whether a file of ``measured`` holds one azimuth of incidence, or two with the same values.

    Mitsuba takes such files for isotropic. Raises :class:`UsageError` for one of two azimuths with different values,
    which it takes for isotropic, too.
    """
    fields = tensor_files.read(path)
    count = len(fields["phi_i"])
    if count == 2:
        for name in ("vndf", "luminance", "spectra", "rgb"):
            first, second = np.asarray(fields[name], np.float64) if name in fields else (0, 0)
            if np.abs(first - second).sum() > TOLERANCE * np.abs(first).sum():
                raise UsageError(
                    f'{path}: the field "{name}" differs between 2 azimuths, and Mitsuba takes files of at most 2 '
                    "azimuths for isotropic: one azimuth, or at least 3, are needed"
                )
    return count <= 2


class PolarisedTruth(Truth):
    """Isotropic measurement of Mueller matrices, as of unpolarised light: their first entry.

    Angles are φ_d, θ_d and θ_h; values are interpolated linearly, and 0 beside invalid ones (NaN). Raises
    :class:`UsageError`.
    """

    isotropic = True

    def __init__(self, path: Path, illuminant: str):
        import mitsuba as mi

        fields = tensor_files.read(path)
        if "M" not in fields:
            raise UsageError(f'{path}: is no file of measured Mueller matrices: has no field "M"')
        tensor_files.check(path, fields)
        nodes = fields["M"].shape
        weights = colour_weights(np.asarray(fields["wvls"], np.float64), illuminant)
        colours = np.asarray(fields["M"][..., 0, 0], np.float32) @ weights.astype(np.float32)
        self._remarks = value_remarks(path.name, colours[~np.isnan(colours).any(axis=-1)].T)
        grid = np.zeros((*nodes[:3], 2, 2), np.float32)  # Mitsuba interpolates pictures, here of 2 x 2 numbers
        grid.reshape(*nodes[:3], 4)[..., :3] = colours
        angles = [np.ravel(fields[name]).astype(float).tolist() for name in ("phi_d", "theta_d", "theta_h")]
        self.mi, self.grid = mi, mi.MarginalContinuous2D3(grid, angles, False, False)
        self.name, self.remark = path.name, REMARK.format(illuminant)
        digest = hashlib.sha256(illuminant.encode())
        with open(path, "rb") as stream:
            while block := stream.read(2**24):
                digest.update(block)
        self.digest = digest.hexdigest()

    def value(self, wi, wo):
        half = wi + wo
        half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
        sin = dr.sqrt(dr.maximum(dr.square(half.x) + dr.square(half.y), 1e-20))
        cos_d = dr.clip(dr.dot(wo, half), 0, 1)
        # Components of wo along the tangents of h: towards the normal, and perpendicular to both
        along, across = (half.z * cos_d - wo.z) / sin, (half.x * wo.y - half.y * wo.x) / sin
        angles = [dr.atan2(across, along), dr.acos(cos_d), dr.atan2(sin, half.z)]
        corners = ((0, 0), (1, 0), (0, 1))
        values = [self.grid.eval(self.mi.Point2f(x, y), angles) for x, y in corners]
        return [wo.z * dr.select(dr.isnan(v), 0, clamp(v, 0, LARGEST)) for v in values]

    def remarks(self, samples):
        return self._remarks


# -- rows of values ----------------------------------------------------------------------------------------------------


class ScatteredTruth(Truth):
    """Rows of a ``.csv`` file. Raises :class:`UsageError`, with file and line.

    ``wi``, ``wo`` and ``f`` are arrays ``(n, 3)``; ``solid_angle``: that for which each row stands (``None``: not
    given); ``weight``: factor on it; ``incidence``: projected solid angle of ``wi``. ``angles``: unit of the angles
    ("": that of the file). ``scattered``: rows may be unlike their neighbours by accident, and are then left out.
    """

    function, incidence, scattered = False, 1.0, True

    def __init__(self, path: Path, angles: str = ""):
        names, rows, lines = read_rows(path)
        columns = dict(zip(names, rows.T, strict=True))

        def refuse(wrong: np.ndarray, fault: str) -> None:
            if wrong.any():
                row = int(np.argmax(wrong))
                raise UsageError(f"{path}:{lines[row]}: {fault.format(*rows[row])}")

        refuse(~np.isfinite(rows).all(axis=1), "holds a number that is not finite")
        unit = angles or "degrees"
        if not angles and max(np.abs(columns[name]).max() for name in ANGLES) <= 2 * math.pi * (1 + 1e-6):
            raise UsageError(f"{path}: its angles are all below 2π: say whether they are degrees or radians (--angles)")
        if unit == "degrees":
            columns |= {name: np.radians(columns[name]) for name in ANGLES}
        limit = "90 degrees" if unit == "degrees" else "π/2"
        for name in ("theta_i", "theta_o"):
            wrong = (columns[name] < 0) | (columns[name] > math.pi / 2 * (1 + 1e-6))
            refuse(wrong, f"{name} is {{{names.index(name)}:g}}, allowed is 0 to {limit}")
        for name in OPTIONAL:
            refuse(columns.get(name, np.zeros(1)) < 0, f"{name} is negative, allowed are numbers ≥ 0")
        self.wi, self.wo = (unit_vectors(columns[f"theta_{k}"], columns[f"phi_{k}"]) for k in "io")
        self.f = np.stack([columns[name] for name in VALUES], axis=1)
        self.weight = columns.get("weight", np.ones(len(rows)))
        self.solid_angle = columns.get("solid_angle")
        counts = (self.wi[:, 2] > HORIZON) & (self.wo[:, 2] > HORIZON) & (self.weight > 0)
        if counts.sum() < LEAST_ROWS:
            raise UsageError(f"{path}: has {counts.sum()} rows above the horizon, at least {LEAST_ROWS} are needed")
        self.left_out = int((~counts).sum())
        self.wi, self.wo, self.f, self.weight = (a[counts] for a in (self.wi, self.wo, self.f, self.weight))
        self.solid_angle = None if self.solid_angle is None else self.solid_angle[counts]
        self.name, self.digest = path.name, hashlib.sha256(path.read_bytes() + unit.encode()).hexdigest()

    def remarks(self, samples):
        return value_remarks(self.name, self.f.T)


class GridTruth(ScatteredTruth):
    """Isotropic measurement as a ``.mbsdf`` file of NVIDIA's MDL, whose cells are rows. Raises :class:`UsageError`.

    The file has a header of text (MDL Specification, appendix on measured BSDFs), a line that ends in ``=``, three
    numbers (1: RGB, 0: grey; cells of both polar angles up to 90°; cells of the azimuth up to 180°), and the values of
    f without the cosine, the azimuth fastest, the polar angle of incidence slowest. Directions are the centres of
    cells, which count by the projected solid angles of both. All train and measure: highlights are a few cells wide.
    """

    scattered = False
    MAGIC, MARKS = b"NVIDIA ARC MBSDF V1\n", (b"MBSDF_DATA=\n", b"MBSDF_DATA_REFLECTION=\n")
    #: Longest header, bytes.
    HEADER = 2**16
    #: Memory of a row: directions, values, solid angle and weight as double precision.
    ROW_BYTES = 88

    def __init__(self, path: Path):
        try:
            content = path.read_bytes()
        except OSError as e:
            raise UsageError(f"{path}: cannot be read ({reason(e)})") from None
        ends = [content.find(b"\n" + mark, 0, self.HEADER) + 1 + len(mark) for mark in self.MARKS]
        ends = [end for end, mark in zip(ends, self.MARKS, strict=True) if end > len(mark)]
        if not content.startswith(self.MAGIC) or not ends or len(content) < ends[0] + 12:
            raise UsageError(f"{path}: is no measured BSDF of MDL that reflects (.mbsdf, version 1)")
        colours, polar, azimuths = (int(n) for n in np.frombuffer(content, "<u4", 3, ends[0]))
        count, channels = polar * polar * azimuths, 3 if colours else 1
        end = ends[0] + 12 + 4 * channels * count
        if colours > 1 or not count or len(content) < end:
            sizes = f"{polar} x {polar} x {azimuths} cells of type {colours}"
            raise UsageError(f"{path}: claims {sizes}, which its {len(content):,} bytes do not hold")
        if count < LEAST_ROWS:
            raise UsageError(f"{path}: has {count} cells, at least {LEAST_ROWS} are needed")
        Allowance(path).take(self.ROW_BYTES * count, f"{count:,} cells")
        f = np.frombuffer(content, "<f4", channels * count, ends[0] + 12).reshape(count, channels)
        if not np.isfinite(f).all():
            raise UsageError(f"{path}: has {f.size - np.isfinite(f).sum():,} values that are not finite")
        theta = (np.arange(polar) + 0.5) * (math.pi / 2 / polar)
        phi = (np.arange(azimuths) + 0.5) * (math.pi / azimuths)
        i, o, phi = (a.ravel() for a in np.meshgrid(theta, theta, phi, indexing="ij"))
        self.wi, self.wo, self.f = unit_vectors(i, 0 * i), unit_vectors(o, phi), np.broadcast_to(f, (count, 3))
        self.solid_angle = np.sin(o) * (2 * math.pi / np.sin(theta).mean())
        self.incidence = np.sin(2 * i) / np.sin(2 * theta).mean()
        self.weight, self.left_out = np.ones(count), 0
        self.name, self.digest = path.name, hashlib.sha256(content).hexdigest()
        self.remark = "the part that transmits light is left out" if len(content) > end else ""


def unit_vectors(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Return directions ``(n, 3)`` of polar angles and azimuths, radians."""
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)


def read_rows(path: Path) -> tuple[list[str], np.ndarray, list[int]]:
    """Return the names, the numbers, ``(rows, names)``, and the lines of the rows of a file.

    Raises :class:`UsageError`, with file and line.
    """
    try:
        texts = enumerate(path.read_text(encoding="utf-8-sig").splitlines(), 1)
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"{path}: cannot be read ({reason(e)})") from None
    (_, header), *body = [(k, t) for k, t in texts if t.strip() and not t.lstrip().startswith("#")] or [(0, "")]
    names = [name.strip().lower() for name in header.split(",")]
    needed = (*ANGLES, *VALUES)
    known = (*needed, *OPTIONAL)
    for name in names if header else ():
        if name not in known or names.count(name) > 1:
            fault = " twice" if name in known else f", allowed are {', '.join(known)}"
            raise UsageError(f'{path}: its header has the column "{name}"{fault}')
    missing = [name for name in needed if name not in names]
    if missing:
        raise UsageError(f"{path}: its header has no {', '.join(missing)}, needed are {', '.join(needed)}")
    rows = []
    for number, text in body:
        cells = text.partition("#")[0].split(",")
        if len(cells) != len(names):
            raise UsageError(f"{path}:{number}: has {len(cells)} columns, its header has {len(names)}")
        try:
            rows.append(list(map(float, cells)))
        except ValueError as e:
            cell = str(e).partition(": ")[2].strip("'\" ")[:40]
            raise UsageError(f'{path}:{number}: found "{cell}", a number is needed') from None
    if not rows:
        raise UsageError(f"{path}: has no rows below its header")
    return names, np.array(rows), [number for number, _ in body]


def measure_row_symmetry(truth: ScatteredTruth) -> dict[str, float | None]:
    """Return the relative difference of f that each symmetry would hide (:func:`measure_symmetry`), from pairs of rows.

    Reciprocity is measured by :func:`irreciprocal_share` where rows have exact images. Else a row is compared with the
    row that is nearest to its image, and what neighbours without the symmetry differ by, through noise and their
    distance, is subtracted. ``None``: there are no such pairs.
    """
    from scipy.spatial import cKDTree

    points, f = places(truth, True), truth.f.mean(axis=1)
    rows = np.random.default_rng(1).permutation(len(f))[:20_000]  # those that are compared
    light = np.maximum(f * truth.wi[:, 2] * truth.wo[:, 2], 1e-12)
    bright = np.quantile(light, 0.9)
    tree, azimuth = cKDTree(points), np.arctan2(truth.wi[:, 1], truth.wi[:, 0])
    near, neighbours = (a[:, 1:] for a in tree.query(points[rows], NEIGHBOURS + 1))
    angle = np.abs((azimuth[rows, None] - azimuth[neighbours] + math.pi / 2) % math.pi - math.pi / 2)

    def difference(others: np.ndarray, chosen: np.ndarray) -> float | None:
        """Return the mean of relative differences of f; ``None`` if too few rows are chosen."""
        if chosen.sum() < LEAST_ROWS:
            return None
        a, b = light[rows[chosen]], light[others[chosen]]
        weight = np.minimum(np.maximum(a, b), bright)  # bright rows count more, outliers little
        return float((weight * np.abs(a - b) / (a + b)).sum() / weight.sum())

    def difference_beyond(usual: float | None, other: float | None) -> float | None:
        return None if other is None or usual is None else max(0.0, other - 1.5 * usual)  # noise, distance

    def first(condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest neighbour that meets a condition, and whether there is one."""
        return neighbours[np.arange(len(rows)), condition.argmax(axis=1)], condition.any(axis=1)

    def excess(images: np.ndarray, informative: np.ndarray | bool = True) -> float | None:
        """Return the difference from the rows nearest to images, no further than neighbours are."""
        distance, nearest = tree.query(images[rows])
        close = (distance <= 1.5 * near[:, 0]) & (nearest != rows) & informative
        return difference_beyond(difference(neighbours[:, 0], close), difference(nearest, close))

    result: dict[str, float | None] = {}
    same, other = first(angle < math.radians(15)), first(angle > math.radians(30))
    both = same[1] & other[1]
    result["isotropy"] = difference_beyond(difference(same[0], both), difference(other[0], both))
    # Rows in the plane of incidence say nothing about the mirror image
    # The mirror image at the plane of incidence
    result["mirror"] = excess(points * np.array([1, 1, -1, 1]), np.abs(points[rows, 2]) > 0.02)
    isotropic = (result["isotropy"] or 0) <= TOLERANCE
    if not isotropic:  # the plane of incidence of a row then means another material each time
        result["mirror"] = result["isotropy"]
    share = irreciprocal_share(truth, isotropic, (result["mirror"] or 0) <= TOLERANCE)
    result["reciprocity"] = excess(places(exchange(truth), True)) if share is None else share
    return result


def solid_angles(truth: ScatteredTruth, isotropic: bool) -> np.ndarray:
    """Return the solid angles for which rows stand, 2π in the mean, from the distances of their neighbours.

    Where ``wi`` has few values, as of goniometers, each of them counts the same.
    """
    from scipy.spatial import cKDTree

    points = np.round(places(truth, isotropic), 6)
    points, index, count = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    index, split = index.ravel(), 1 if isotropic else 3
    groups, group, members = np.unique(np.round(points[:, :split], 4), axis=0, return_inverse=True, return_counts=True)
    group, area = group.ravel(), np.ones(len(points))
    if len(points) >= 4 * DENSITY * len(groups):
        for k in np.flatnonzero(members > DENSITY):
            inside = group == k
            distance = cKDTree(points[inside, split:]).query(points[inside, split:], DENSITY + 1)[0][:, -1]
            area[inside] = distance**2 / (distance**2).sum()
    else:
        area = cKDTree(points).query(points, min(DENSITY, len(points) - 1) + 1)[0][:, -1] ** (3 if isotropic else 4)
    area = (area / count)[index]
    return 2 * math.pi * area / area.mean()


def split(truth: ScatteredTruth, types, isotropic: bool, limit: float, seed: int) -> tuple[Samples, Samples, Samples]:
    """Return the rows for training, those that measure, and smoothed ones for the starts of the proxy.

    Cells of a grid do both. Weights are solid angles, limited so that a row contributes at most ``limit``. Smoothed
    values are medians of three neighbours: a start is found by least squares, which outliers would rule.
    """
    from scipy.spatial import cKDTree

    weight = solid_angles(truth, isotropic) if truth.solid_angle is None else truth.solid_angle
    weight = weight * (truth.weight / truth.weight.mean()) * truth.incidence
    value = truth.f * truth.wo[:, 2:]
    weight = np.minimum(weight, limit / np.maximum(value.max(axis=1), 1e-6))
    points = places(truth, isotropic)
    smooth = np.median(value[cKDTree(points).query(points, 3)[1]], axis=1)
    wi, wo = truth.wi, truth.wo
    if isotropic:
        wi = np.stack([np.sqrt(np.maximum(1 - wi[:, 2] ** 2, 0)), 0 * wi[:, 2], wi[:, 2]], axis=1)
        wo = along_x(truth)
    order = np.random.default_rng(seed).permutation(len(value))
    measured = max(1, round(VALIDATION * len(value))) if truth.scattered else 0

    def samples(rows: np.ndarray, values: np.ndarray) -> Samples:
        def columns(a):
            return [types.Float(np.ascontiguousarray(c, np.float32)) for c in a[rows].T]

        return Samples(
            types.Array3f(*columns(wi)), types.Array3f(*columns(wo)), columns(weight[:, None])[0], columns(values)
        )

    return samples(order[measured:], value), samples(order[: measured or None], value), samples(order, smooth)


def without_outliers(samples: Samples, form: Form, proxy: LearnedBSDF) -> tuple[Samples, int]:
    """Return samples whose outliers weigh nothing, and their number.

    Logarithms of f over the proxy are compared with those of the nearest samples, in the coordinates of the residual.
    """
    from scipy.spatial import cKDTree

    with dr.suspend_grad():
        g = DirectionPair.of(*(rotate(w, -form.angle) for w in (samples.wi, samples.wo)))
        columns = [*proxy.coordinates(g), *(v * samples.wo.z for v in proxy.value(samples.wi, samples.wo))]
        dr.eval(columns)
    u, v, w, *expected = (np.asarray(c.numpy(), np.float64) for c in columns)
    value = np.stack([c.numpy() for c in samples.value], axis=1).mean(axis=1)
    expected = np.mean(expected, axis=0)
    floor = 1e-3 * expected.mean()
    ratio = np.log(np.maximum(value, floor) / np.maximum(expected, floor))
    points = np.stack([u, v, 0.25 * w], axis=1)
    median = np.median(ratio[cKDTree(points).query(points, min(NEIGHBOURS, len(points) - 1) + 1)[1][:, 1:]], axis=1)
    difference = np.abs(ratio - median)
    outlier = difference > max(0.4, 6.0 * float(np.median(difference)))  # of logarithms
    kept = type(samples.weight)(np.ascontiguousarray(~outlier, np.float32))
    return Samples(samples.wi, samples.wo, samples.weight * kept, samples.value), int(outlier.sum())


def remove_outliers(
    truth: ScatteredTruth, parts: list[Samples], form: Form, logarithms: np.ndarray
) -> tuple[list[Samples], Form, str]:
    """Return samples without outliers from a fitted proxy, the form with the range of the first, and a line of text."""
    proxy, types = proxy_array(logarithms, 1.0) if form.terms else None, backend_module(parts[0].weight)
    net = BSDFArrays(None, proxy).alloc(types.TensorXf)
    parts, outliers = zip(*(without_outliers(s, form, net.at(form)) for s in parts), strict=True)
    form = dataclasses.replace(form, range=residual_range(form, logarithms, parts[0]))
    left_out = f", {truth.left_out:,} at the horizon or of no weight" if truth.left_out else ""
    line = f"{len(truth.f):,} rows; left out: {sum(outliers):,} unlike their neighbours{left_out}"
    return list(parts), form, line
