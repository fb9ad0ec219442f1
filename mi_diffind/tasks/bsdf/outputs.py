"""Learned BSDFs in ordinary formats: tensor files of Mitsuba's ``measured``, tables of numbers, pictures."""

from __future__ import annotations

import math
from pathlib import Path

import drjit as dr
import numpy as np

from ...core import tensor_files
from ...core.errors import UsageError
from ...core.files import replacing
from ...core.threads import threads_for_files
from . import tensor_file
from .measurement import cosine
from .pool import incident, outgoing
from .source import Truth
from .view import SphereView

#: Extensions of the outputs.
EXTENSIONS = (".bsdf", ".csv", ".exr")

#: Columns of a table of numbers; angles in degrees.
COLUMNS = ("theta_i", "phi_i", "theta_o", "phi_o", "r", "g", "b", "solid_angle")

#: Rows of a table of numbers; side of a picture in pixels, its passes of 64 samples a pixel, and factor on its errors.
ROWS, SIDE, PASSES, ENLARGED = 10_000, 256, 8, 8


class LearnedTruth(Truth):
    """Model of a table file in the place of a source."""

    samples = True

    def __init__(self, model):
        self.model, self.name, self.digest = model, str(model.table.settings.get("name", "")), ""
        self.isotropic = model.form.isotropic or None
        self.value = cosine(model.bsdf)
        self.sample, self.density = model.mixture.sample, model.mixture.density


def write(model, output: Path, source, rows: int | None = None, seed: int | None = None) -> list[tuple[Path, str]]:
    """Write a model as a ``.bsdf``, ``.csv`` or ``.exr`` file, and return the file with a line about it.

    ``source()`` returns the source (:class:`.truth.Truth`), or raises a ``TableError``. ``rows`` and ``seed`` are those
    of a ``.csv`` file. Raises :class:`.UsageError` for another extension.
    """
    suffix = output.suffix.lower()
    if suffix not in EXTENSIONS:
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are {_and(EXTENSIONS)}')
    if suffix != ".csv" and (rows is not None or seed is not None):
        raise UsageError(f'output "{output}": --rows and --seed need the extension .csv')
    if suffix == ".csv":
        table = samples(model, rows or ROWS, seed or 0)
        with replacing(output) as temporary:
            np.savetxt(temporary, table, "%.9g", ",", header=",".join(COLUMNS), comments="")
        return [(output, f"{len(table):,} rows: f in linear sRGB, angles in degrees")]
    if suffix == ".bsdf":
        fields = tensor_file.fields(model.bsdf, model.types, f"{model.table.settings.get('name', '')} (learned)")
        with replacing(output) as temporary:
            tensor_files.write(temporary, fields)
        shape = fields["rgb"].shape
        return [(output, f"{output.stat().st_size:,} bytes, {shape[1]} x {shape[0]} directions, for measured in RGB")]
    image, line = picture(model, source)
    with replacing(output) as temporary, threads_for_files():
        _bitmap(image).write(str(temporary))
    return [(output, line)]


def samples(model, rows: int, seed: int) -> np.ndarray:
    """Return values of a model at random directions, ``(rows, 8)`` in the order of :data:`COLUMNS`.

    Directions of incidence are those of trainings; ``wo`` is drawn from the lobes that sample the model, from wider and
    from narrower ones. The solid angle is the inverse of its density.
    """
    types, truth, parts, count = model.types, LearnedTruth(model), [], 0
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    while count < rows:
        s = outgoing(rng, types, incident(rng, types, 2 * rows, truth.isotropic), truth)
        with dr.suspend_grad():
            columns = [*_angles(s.wi), *_angles(s.wo), *model.bsdf.value(s.wi, s.wo), s.weight]
            dr.eval(columns)
        part = np.stack([np.asarray(c.numpy(), np.float64) for c in columns], axis=1)
        parts.append(part[(part[:, -1] > 0) & np.isfinite(part).all(axis=1)])
        count += len(parts[-1])
    return np.concatenate(parts)[:rows]


def _angles(w) -> tuple:
    """Return θ and φ of directions, in degrees."""
    theta = dr.atan2(dr.sqrt(dr.square(w.x) + dr.square(w.y)), w.z)
    return theta * (180 / math.pi), dr.atan2(w.y, w.x) * (180 / math.pi)


def picture(model, source) -> tuple[np.ndarray, str]:
    """Return a lit sphere of a model, beside it that of its source and the difference, and a line about them."""
    from ...arrays.tables import TableError

    try:
        truth, alone = source(), ""
        if not truth.function:
            raise TableError(f"{truth.name}: its rows show no picture")
    except TableError as e:
        truth, alone = LearnedTruth(model), str(e)
    learned, exact = 0, 0
    for seed in range(PASSES):
        view = SphereView(truth, model.types, seed, SIDE)
        learned = learned + view.images(cosine(model.bsdf)).mean(axis=0) / PASSES
        exact = exact + view.halves.mean(axis=0) / PASSES
    if alone:
        return learned, f"lit sphere; without its source beside it: {alone}"
    image = np.concatenate([learned, exact, ENLARGED * np.abs(learned - exact)], axis=1)
    return image, f"lit sphere, its source, and {ENLARGED} times the difference"


def _bitmap(image: np.ndarray):
    import mitsuba as mi

    return mi.Bitmap(np.ascontiguousarray(image, np.float32))


def _and(names) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"
