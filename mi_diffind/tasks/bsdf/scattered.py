"""Sources that are rows of measured values: scattered, noisy, and weighted.

A ``.csv`` file has a header of names (:data:`NAMES`, in any order) and one row for each measurement: two directions by
their angles, and f without the cosine in linear sRGB. Lines that start with # are comments.

Nothing is known between the rows: proxy and residual are trained on nine tenths of them and measured on the rest, and
sampling and the limit of the albedo follow from the fitted BSDF. The loss is a weighted mean of absolute differences,
so that noise and outliers move it little.
"""

from __future__ import annotations

import copy
import csv
import dataclasses
import hashlib
import math
import warnings
from pathlib import Path

import drjit as dr
import numpy as np

from ...core.errors import UsageError, reason
from .model import BSDFArrays, DirectionPair, Form, LearnedBSDF, turned
from .pool import Samples
from .source import Truth
from .symmetry import TOLERANCE
from .training import module_types, proxy_array, residual_range

#: Columns of angles and values that a file needs, and columns that it may have.
ANGLES, VALUES, OPTIONAL = ("theta_i", "phi_i", "theta_o", "phi_o"), ("r", "g", "b"), ("solid_angle", "weight")

#: Smallest number of rows, and the share of rows that measure the result.
LEAST, VALIDATION = 200, 0.1

#: Smallest cosine of a direction that counts.
HORIZON = 1e-3

#: Neighbours that determine the density of rows, and those that a row is compared with.
DENSITY, NEIGHBOURS = 8, 16

#: A row is an outlier if its logarithm differs from its neighbours' median by this many times the usual difference, and
#: by more than this.
OUTLIER, FAR = 6.0, 0.4

#: Number of rows whose neighbours measure symmetries; azimuths that count as equal and as different.
PAIRS, SAME, OTHER = 20_000, math.radians(15), math.radians(30)

#: Factors of :func:`places` of an isotropic material that give the mirror image at the plane of incidence.
MIRROR = np.array([1, 1, -1, 1])

#: Distance of two rows below which they have the same directions.
EXACT = 1e-4

#: Quantile of f cos θ_i cos θ_o above which rows count the same where symmetries are measured.
BRIGHT = 0.9

#: Difference under a symmetry that neighbours have, too, relative to that of neighbours without it.
USUAL = 1.5


class ScatteredTruth(Truth):
    """Rows of a ``.csv`` file. Raises :class:`UsageError`, with file and line.

    ``wi``, ``wo`` and ``f`` are arrays ``(n, 3)``; ``solid_angle``: that for which each row stands (``None``: not
    given); ``weight``: factor on it. ``angles``: unit of the angles ("": that of the file).
    """

    function = False

    def __init__(self, path: Path, angles: str = ""):
        names, rows = read_rows(path)
        columns = dict(zip(names, rows.T, strict=True))
        unit = angles or _unit(path, [columns[name] for name in ANGLES])
        if unit == "degrees":
            columns |= {name: np.radians(columns[name]) for name in ANGLES}
        for name in ("theta_i", "theta_o"):
            wrong = np.flatnonzero((columns[name] < 0) | (columns[name] > math.pi / 2 * (1 + 1e-6)))
            if len(wrong):
                value = rows[wrong[0], names.index(name)]
                limit = "90 degrees" if unit == "degrees" else "π/2"
                raise UsageError(f"{path}:{_line(path, wrong[0])}: {name} is {value:g}, allowed is 0 to {limit}")
        self.wi, self.wo = (_direction(columns[f"theta_{k}"], columns[f"phi_{k}"]) for k in "io")
        self.f = np.stack([columns[name] for name in VALUES], axis=1)
        self.weight = columns.get("weight", np.ones(len(rows)))
        self.solid_angle = columns.get("solid_angle")
        for name in OPTIONAL:
            wrong = np.flatnonzero(columns.get(name, np.zeros(1)) < 0)
            if len(wrong):
                raise UsageError(f"{path}:{_line(path, wrong[0])}: {name} is negative, allowed are numbers ≥ 0")
        counts = (self.wi[:, 2] > HORIZON) & (self.wo[:, 2] > HORIZON) & (self.weight > 0)
        if counts.sum() < LEAST:
            raise UsageError(f"{path}: has {counts.sum()} rows above the horizon, at least {LEAST} are needed")
        self.left_out = int((~counts).sum())
        self.wi, self.wo, self.f, self.weight = (a[counts] for a in (self.wi, self.wo, self.f, self.weight))
        self.solid_angle = None if self.solid_angle is None else self.solid_angle[counts]
        self.name, self.digest = path.name, hashlib.sha256(path.read_bytes() + unit.encode()).hexdigest()


def read_rows(path: Path) -> tuple[list[str], np.ndarray]:
    """Return the names and the numbers of a file, ``(rows, names)``. Raises :class:`UsageError`, with file and line."""
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            header = next((line for line in stream if line.strip() and not line.startswith("#")), "")
            names = [name.strip().lower() for name in next(csv.reader([header]), [])]
            _check_names(path, names)
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of no rows
                    rows = np.loadtxt(stream, delimiter=",", comments="#", ndmin=2)
            except ValueError:
                rows = None
    except (OSError, UnicodeDecodeError) as e:
        raise UsageError(f"{path}: cannot be read ({reason(e)})") from None
    if rows is None or (rows.size and rows.shape[1] != len(names)):
        _refuse_line(path, len(names))
    if not rows.size:
        raise UsageError(f"{path}: has no rows below its header")
    wrong = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if len(wrong):
        raise UsageError(f"{path}:{_line(path, wrong[0])}: holds a number that is not finite")
    return names, rows


def _check_names(path: Path, names: list[str]) -> None:
    needed, known = (*ANGLES, *VALUES), (*ANGLES, *VALUES, *OPTIONAL)
    for name in names:
        if name not in known or names.count(name) > 1:
            fault = "twice" if name in known else f", allowed are {', '.join(known)}"
            raise UsageError(f'{path}: its header has the column "{name}"{" " * (fault == "twice")}{fault}')
    missing = [name for name in needed if name not in names]
    if missing:
        raise UsageError(f"{path}: its header has no {', '.join(missing)}, needed are {', '.join(needed)}")


def _rows_of_text(path: Path):
    """Yield the line number and the text of each row below the header."""
    header = False
    with open(path, encoding="utf-8-sig") as stream:
        for number, line in enumerate(stream, 1):
            if line.strip() and not line.lstrip().startswith("#"):
                if header:
                    yield number, line
                header = True


def _line(path: Path, row: int) -> int:
    """Return the line of a row."""
    return next(number for k, (number, _) in enumerate(_rows_of_text(path)) if k == row)


def _refuse_line(path: Path, count: int):
    for number, line in _rows_of_text(path):
        cells = line.partition("#")[0].split(",")
        if len(cells) != count:
            raise UsageError(f"{path}:{number}: has {len(cells)} columns, its header has {count}")
        for cell in cells:
            try:
                float(cell)
            except ValueError:
                raise UsageError(f'{path}:{number}: found "{cell.strip()[:40]}", a number is needed') from None
    raise UsageError(f"{path}: is no table of numbers separated by commas")


def _unit(path: Path, angles: list[np.ndarray]) -> str:
    """Return the unit of angles: degrees, unless all are so small that they may be radians."""
    if max(np.abs(a).max() for a in angles) <= 2 * math.pi * (1 + 1e-6):
        raise UsageError(f"{path}: its angles are all below 2π: say whether they are degrees or radians (--angles)")
    return "degrees"


def _direction(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    sin = np.sin(theta)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), np.cos(theta)], axis=1)


def along_x(truth: ScatteredTruth) -> np.ndarray:
    """Return ``wo`` after a rotation about the normal that brings ``wi`` to the azimuth 0."""
    x, y = truth.wi[:, 0], truth.wi[:, 1]
    r = np.hypot(x, y)
    cos, sin = np.where(r > 1e-9, x, 1) / np.maximum(r, 1e-9), y / np.maximum(r, 1e-9)
    cos = np.where(r > 1e-9, cos, 1)
    wo = truth.wo
    return np.stack([cos * wo[:, 0] + sin * wo[:, 1], cos * wo[:, 1] - sin * wo[:, 0], wo[:, 2]], axis=1)


def places(truth: ScatteredTruth, isotropic: bool) -> np.ndarray:
    """Return points whose distances are those of rows, ``(n, 4)`` of isotropic and ``(n, 6)`` of other materials."""
    if not isotropic:
        return np.concatenate([truth.wi, truth.wo], axis=1)
    return np.concatenate([np.arccos(np.clip(truth.wi[:, 2:], -1, 1)), along_x(truth)], axis=1)


# -- symmetries --------------------------------------------------------------------------------------------------------


def measured_symmetry(truth: ScatteredTruth, seed: int = 1) -> dict[str, float | None]:
    """Return the relative difference of f that each symmetry would hide (:mod:`.symmetry`), from pairs of rows.

    Reciprocity is measured by :func:`irreciprocal_share` where rows have exact images. Else a row is compared with the
    row that is nearest to its image, and what neighbours without the symmetry differ by, through noise and their
    distance, is subtracted. ``None``: there are no such pairs.
    """
    from scipy.spatial import cKDTree

    points, f = places(truth, True), truth.f.mean(axis=1)
    rows = np.random.default_rng(seed).permutation(len(f))[:PAIRS]
    light = np.maximum(f * truth.wi[:, 2] * truth.wo[:, 2], 1e-12)
    bright = np.quantile(light, BRIGHT)
    tree, azimuth = cKDTree(points), np.arctan2(truth.wi[:, 1], truth.wi[:, 0])
    near, neighbours = (a[:, 1:] for a in tree.query(points[rows], NEIGHBOURS + 1))
    angle = np.abs((azimuth[rows, None] - azimuth[neighbours] + math.pi / 2) % math.pi - math.pi / 2)

    def difference(others: np.ndarray, chosen: np.ndarray) -> float | None:
        """Return the mean of relative differences of f; ``None`` if too few rows are chosen."""
        if chosen.sum() < LEAST:
            return None
        a, b = light[rows[chosen]], light[others[chosen]]
        weight = np.minimum(np.maximum(a, b), bright)  # bright rows count more, outliers little
        return float((weight * np.abs(a - b) / (a + b)).sum() / weight.sum())

    def first(condition: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest neighbour that meets a condition, and whether there is one."""
        return neighbours[np.arange(len(rows)), condition.argmax(axis=1)], condition.any(axis=1)

    def excess(images: np.ndarray, informative: np.ndarray | bool = True) -> float | None:
        """Return the difference from the rows nearest to images, no further than neighbours are."""
        distance, nearest = tree.query(images[rows])
        close = (distance <= 1.5 * near[:, 0]) & (nearest != rows) & informative
        return _excess(difference(nearest, close), difference(neighbours[:, 0], close))

    result: dict[str, float | None] = {}
    same, other = first(angle < SAME), first(angle > OTHER)
    both = same[1] & other[1]
    result["isotropy"] = _excess(difference(other[0], both), difference(same[0], both))
    # Rows in the plane of incidence say nothing about the mirror image
    result["mirror"] = excess(points * MIRROR, np.abs(points[rows, 2]) > 0.02)
    isotropic = (result["isotropy"] or 0) <= TOLERANCE
    if not isotropic:  # the plane of incidence of a row then means another material each time
        result["mirror"] = result["isotropy"]
    share = irreciprocal_share(truth, isotropic, (result["mirror"] or 0) <= TOLERANCE)
    result["reciprocity"] = excess(places(exchanged(truth), True)) if share is None else share
    return result


def exchanged(truth: ScatteredTruth) -> ScatteredTruth:
    """Return the rows with their directions exchanged."""
    result = copy.copy(truth)
    result.wi, result.wo = truth.wo, truth.wi
    return result


def irreciprocal_share(truth: ScatteredTruth, isotropic: bool, mirror: bool) -> float | None:
    """Return the share of the light that no reciprocal model can reproduce; ``None`` if too few rows have images.

    It is the sum of ``|f(i, o) − f(o, i)| / 2`` over that of ``|f|``, weighted by both solid angles and cosines, of
    all rows whose directions exchanged are those of another row. Rows that are their own images (mirror directions)
    count as they do among all rows. With ``mirror``, images at the plane of incidence count, too.
    """
    from scipy.spatial import cKDTree

    points, images = places(truth, isotropic), places(exchanged(truth), isotropic)
    if isotropic and mirror:
        points[:, 2], images[:, 2] = np.abs(points[:, 2]), np.abs(images[:, 2])
    symmetric = np.linalg.norm(points - images, axis=1) < EXACT
    image = cKDTree(points).query(images, distance_upper_bound=EXACT)[1]
    image[symmetric] = np.flatnonzero(symmetric)
    paired = image < len(points)
    others = (paired & ~symmetric).sum()
    if others < LEAST:
        return None
    rows = np.flatnonzero(paired)
    image, wi, wo = image[rows], truth.wi[rows], truth.wo[rows]
    if truth.solid_angle is None:
        weight = cells(np.arccos(np.stack([wi[:, 2], wo[:, 2]], axis=1)))
        weight *= np.prod(np.hypot(*np.stack([wi, wo])[:, :, :2].T), axis=1)
        azimuths = [np.arctan2(w[:, 1], w[:, 0]) for w in ([along_x(truth)[rows]] if isotropic else [wi, wo])]
        weight *= cells(np.abs(np.stack(azimuths, axis=1)))
    else:
        weight = truth.solid_angle[rows] * truth.solid_angle[image]
    weight *= np.where(symmetric[rows], 1, (~symmetric).sum() / others)
    weight = (weight * (truth.weight[rows] + truth.weight[image]) * wi[:, 2] * wo[:, 2])[:, None]
    difference = (weight * np.abs(truth.f[rows] - truth.f[image])).sum() / 2
    return float(difference / max((weight * np.abs(truth.f[rows])).sum(), 1e-20))


def cells(angles: np.ndarray) -> np.ndarray:
    """Return products of the widths for which angles ``(n, k)`` stand on the axis that their ``k`` columns share."""
    values, index = np.unique(np.round(angles, 5), return_inverse=True)
    widths = np.gradient(values) if len(values) > 1 else np.ones(1)
    return widths[index.reshape(angles.shape)].prod(axis=1)


def _excess(difference: float | None, usual: float | None) -> float | None:
    return None if difference is None or usual is None else max(0.0, difference - USUAL * usual)


# -- samples -----------------------------------------------------------------------------------------------------------


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

    Their weights are solid angles, limited so that a row contributes at most ``limit``. Smoothed values are medians of
    three neighbours: a start is found by least squares, which outliers would rule.
    """
    from scipy.spatial import cKDTree

    weight = solid_angles(truth, isotropic) if truth.solid_angle is None else truth.solid_angle
    weight = weight * truth.weight / truth.weight.mean()
    value = truth.f * truth.wo[:, 2:]
    weight = np.minimum(weight, limit / np.maximum(value.max(axis=1), 1e-6))
    points = places(truth, isotropic)
    smooth = np.median(value[cKDTree(points).query(points, 3)[1]], axis=1)
    wi, wo = truth.wi, truth.wo
    if isotropic:
        wi = np.stack([np.sqrt(np.maximum(1 - wi[:, 2] ** 2, 0)), 0 * wi[:, 2], wi[:, 2]], axis=1)
        wo = along_x(truth)
    order = np.random.default_rng(seed).permutation(len(value))
    measured = max(1, round(VALIDATION * len(value)))

    def samples(rows: np.ndarray, values: np.ndarray) -> Samples:
        def columns(a):
            return [types.Float(np.ascontiguousarray(c, np.float32)) for c in a[rows].T]

        return Samples(
            types.Array3f(*columns(wi)), types.Array3f(*columns(wo)), columns(weight[:, None])[0], columns(values)
        )

    return samples(order[measured:], value), samples(order[:measured], value), samples(order, smooth)


def without_outliers(samples: Samples, form: Form, proxy: LearnedBSDF) -> tuple[Samples, int]:
    """Return samples whose outliers weigh nothing, and their number.

    Logarithms of f over the proxy are compared with those of the nearest samples, in the coordinates of the residual.
    """
    from scipy.spatial import cKDTree

    with dr.suspend_grad():
        g = DirectionPair.of(*(turned(w, -form.angle) for w in (samples.wi, samples.wo)))
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
    outlier = difference > max(FAR, OUTLIER * float(np.median(difference)))
    kept = type(samples.weight)(np.ascontiguousarray(~outlier, np.float32))
    return Samples(samples.wi, samples.wo, samples.weight * kept, samples.value), int(outlier.sum())


def cleaned(
    truth: ScatteredTruth, parts: list[Samples], form: Form, logarithms: np.ndarray
) -> tuple[list[Samples], Form, str]:
    """Return samples without outliers from a fitted proxy, the form with the range of the first, and a line of text."""
    types = module_types(parts[0])
    net = BSDFArrays(None, proxy_array(logarithms, 1.0) if form.terms else None).alloc(types.TensorXf)
    parts, outliers = zip(*(without_outliers(s, form, LearnedBSDF.of(form, net)) for s in parts), strict=True)
    form = dataclasses.replace(form, range=residual_range(form, logarithms, parts[0]))
    left_out = f", {truth.left_out:,} at the horizon or of no weight" if truth.left_out else ""
    line = f"{len(truth.f):,} rows; left out: {sum(outliers):,} unlike their neighbours{left_out}"
    return list(parts), form, line
