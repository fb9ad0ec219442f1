"""Errors of learned BSDFs against their sources, and learned BSDFs in ordinary formats: tables of numbers, pictures."""

from __future__ import annotations

import math
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.tables import TableError
from ...core.errors import UsageError
from ...core.files import replacing
from ...core.threads import threads_for_files
from . import energy, mixture
from .directions import Samples, SphereView, incident, outgoing
from .measured import FunctionTruth, Truth, fitted_part, measure_symmetry
from .model import opaque_numbers
from .truth import FamilyTruth

#: Cosines of the angles of incidence at which albedos are compared.
ALBEDO_COSINES = np.cos(np.radians((0, 15, 30, 45, 60, 70, 80, 85, 89)))

#: Members of a family that are measured.
MEMBERS = 24

#: Extensions of the outputs.
EXTENSIONS = (".csv", ".exr")

#: Columns of a table of numbers; angles in degrees.
COLUMNS = ("theta_i", "phi_i", "theta_o", "phi_o", "r", "g", "b", "solid_angle")

#: Rows of a table of numbers.
ROWS = 10_000

#: Side of a picture, pixels.
SIDE = 256

#: Passes of a picture, of 64 samples a pixel each.
PASSES = 8

#: Factor on the differences from the source in a picture.
ENLARGED = 8


def albedo_figures(truth: Truth, value, types) -> dict[str, float]:
    """Return figures of the directional albedo of f cos θ_o, from 0° to 89°.

    ``albedo_excess`` is the largest relative difference by which it lies above the source's, ``albedo_largest`` the
    largest of all, ``albedo_largest_source`` that of the source.
    """
    source, learned = energy.albedos([truth.value, value], truth, types, ALBEDO_COSINES)
    excess = (learned - source) / np.maximum(source, 1e-3)
    largest = {"albedo_largest": float(learned.max()), "albedo_largest_source": float(source.max())}
    return {"albedo_excess": float(excess.max()), **largest}


def weight_moments(truth: Truth, sampling, types, *size: int) -> list[float]:
    """Return :func:`.mixture.second_moment` of samples of a source by a mixture, at 0°, 45° and 80°."""
    return [mixture.second_moment(truth, sampling, types, float(c), *size) for c in np.cos(np.radians((0, 45, 80)))]


def measure(model, truth: Truth, view: SphereView) -> dict[str, float]:
    """Return figures of a model: PSNR, albedo and sampling.

    ``psnr_db`` is that of the picture of a sphere; albedos are those of :func:`albedo_figures`, beside those of the
    part of the source that is fitted (:func:`.measured.fitted_part`); ``sample_weight_moment`` is the mean of
    E[w²]/E[w]² of the weights of samples at 0°, 45° and 80°.
    """
    fitted = fitted_part(truth, measure_symmetry(truth, model.types), model.form.azimuth == "mirror")
    return {
        "psnr_db": view.psnr(model.bsdf.cosine_value),
        **albedo_figures(fitted, model.bsdf.cosine_value, model.types),
        "sample_weight_moment": float(np.mean(weight_moments(truth, model.mixture, model.types))),
    }


def measure_samples(model, samples: Samples) -> dict[str, float]:
    """Return figures of a model of which only samples are known.

    ``relative_error`` is the weighted mean of |f̂ − f| cos θ_o over that of f cos θ_o, ``albedo_largest`` the largest
    directional albedo from 0° to 89°, ``sample_weight_moment`` as in :func:`measure`, of f̂.
    """
    types, value = model.types, model.bsdf.cosine_value
    with dr.suspend_grad():
        pairs = list(zip(value(samples.wi, samples.wo), samples.value, strict=True))
        error = sum(dr.sum(samples.weight * dr.abs(v - t)) for v, t in pairs)
        total = sum(dr.sum(samples.weight * t) for _, t in pairs)
    fitted = FunctionTruth("", value)
    return {
        "relative_error": float((error / total)[0]),
        "albedo_largest": float(energy.albedos([value], fitted, types, ALBEDO_COSINES).max()),
        "sample_weight_moment": float(np.mean(weight_moments(fitted, model.mixture, types))),
    }


def measure_family(model, truth: FamilyTruth) -> dict[str, float]:
    """Return figures of a family at random parameters, as :func:`measure` does.

    ``psnr_db``, ``psnr_median_db`` and ``psnr_minimum_db`` are those of smaller pictures; ``albedo_excess`` is the
    largest one.
    """
    types, psnr, excess, moments = model.types, [], [], []
    for coordinates in np.random.default_rng(17).random((MEMBERS, len(truth.parameters))):
        values = [p.value(x) for p, x in zip(truth.parameters, coordinates, strict=True)]
        source, (bsdf, sampling) = truth.at(coordinates), model.at(opaque_numbers(types, values))
        psnr.append(SphereView(source, types, side=48, samples=32).psnr(bsdf.cosine_value))
        excess.append(albedo_figures(source, bsdf.cosine_value, types)["albedo_excess"])
        moments += weight_moments(source, sampling, types, 2**13)
    return {
        "psnr_db": float(np.mean(psnr)),
        "psnr_median_db": float(np.median(psnr)),
        "psnr_minimum_db": float(np.min(psnr)),
        "albedo_excess": float(np.max(excess)),
        "sample_weight_moment": float(np.mean(moments)),
    }


def learned_truth(model) -> Truth:
    """Return a model in the place of a source."""
    truth = FunctionTruth(str(model.table.settings.get("name", "")), model.bsdf.cosine_value, model.mixture)
    truth.isotropic = model.form.isotropic or None
    return truth


def write(model, output: Path, source, rows: int | None = None, seed: int | None = None) -> list[tuple[Path, str]]:
    """Write a model as a ``.csv`` or ``.exr`` file, and return the file with a line about it.

    ``source()`` returns the source (:class:`.measured.Truth`), or raises a ``TableError``. ``rows`` and ``seed`` are
    those of a ``.csv`` file. Raises :class:`.UsageError` for another extension.
    """
    suffix = output.suffix.lower()
    if suffix not in EXTENSIONS:
        allowed = " and ".join(EXTENSIONS)
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are {allowed}')
    if suffix == ".csv":
        table = sample_rows(model, rows or ROWS, seed or 0)
        with replacing(output) as temporary:
            np.savetxt(temporary, table, "%.9g", ",", header=",".join(COLUMNS), comments="")
        return [(output, f"{len(table):,} rows: f in linear sRGB, angles in degrees")]
    if rows is not None or seed is not None:
        raise UsageError(f'output "{output}": --rows and --seed need the extension .csv')
    import mitsuba as mi

    image, line = picture(model, source)
    with replacing(output) as temporary, threads_for_files():
        mi.Bitmap(np.ascontiguousarray(image, np.float32)).write(str(temporary))
    return [(output, line)]


def sample_rows(model, rows: int, seed: int) -> np.ndarray:
    """Return values of a model at random directions, ``(rows, 8)`` in the order of :data:`COLUMNS`.

    Directions of incidence are those of trainings; ``wo`` is drawn from the lobes that sample the model, from wider and
    from narrower ones. The solid angle is the inverse of its density.
    """
    types, truth, parts, count = model.types, learned_truth(model), [], 0
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
    try:
        truth, alone = source(), ""
        if not truth.function:
            raise TableError(f"{truth.name}: its rows show no picture")
    except TableError as e:
        truth, alone = learned_truth(model), str(e)
    learned, exact = 0, 0
    for seed in range(PASSES):
        view = SphereView(truth, model.types, seed, SIDE)
        learned = learned + view.images(model.bsdf.cosine_value).mean(axis=0) / PASSES
        exact = exact + view.halves.mean(axis=0) / PASSES
    if alone:
        return learned, f"lit sphere; without its source beside it: {alone}"
    image = np.concatenate([learned, exact, ENLARGED * np.abs(learned - exact)], axis=1)
    return image, f"lit sphere, its source, and {ENLARGED} times the difference"
