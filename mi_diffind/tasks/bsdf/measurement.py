"""Errors of a learned BSDF against its source."""

from __future__ import annotations

import drjit as dr
import numpy as np

from . import energy, mixture
from .model import LearnedBSDF
from .source import FunctionTruth, Truth
from .view import SphereView


def cosine(bsdf: LearnedBSDF):
    """Return the function f cos θ_o of a learned BSDF."""
    return lambda wi, wo: [v * wo.z for v in bsdf.value(wi, wo)]


def measure(model, truth: Truth, view: SphereView) -> dict[str, float]:
    """Return figures of a model: PSNR, albedo and sampling.

    ``psnr_db`` is that of the picture of :mod:`.view`; ``albedo_excess`` the largest relative difference by which a
    directional albedo, from 0° to 89°, lies above the source's; ``sample_weight_moment`` the mean of E[w²]/E[w]² of the
    weights of samples at 0°, 45° and 80°.
    """
    types, value = model.types, cosine(model.bsdf)
    cos = np.cos(np.radians([0, 15, 30, 45, 60, 70, 80, 85, 89]))
    source, learned = energy.albedos([truth.value, value], truth, types, cos)
    moments = [mixture.second_moment(truth.value, model.mixture, truth, types, float(c)) for c in cos[[0, 3, 6]]]
    return {
        "psnr_db": view.psnr(value),
        "albedo_excess": float(((learned - source) / np.maximum(source, 1e-3)).max()),
        "sample_weight_moment": float(np.mean(moments)),
    }


def measure_samples(model, samples) -> dict[str, float]:
    """Return figures of a model of which only samples are known (:class:`.pool.Samples`).

    ``relative_error`` is the weighted mean of |f̂ − f| cos θ_o over that of f cos θ_o, ``albedo_largest`` the largest
    directional albedo from 0° to 89°, ``sample_weight_moment`` as in :func:`measure`, of f̂.
    """
    types, value = model.types, cosine(model.bsdf)
    with dr.suspend_grad():
        pairs = list(zip(value(samples.wi, samples.wo), samples.value, strict=True))
        error = sum(dr.sum(samples.weight * dr.abs(v - t)) for v, t in pairs)
        total = sum(dr.sum(samples.weight * t) for _, t in pairs)
    fitted = FunctionTruth("", value)
    albedo = energy.albedos([value], fitted, types, np.cos(np.radians([0, 15, 30, 45, 60, 70, 80, 85, 89])))
    cosines = np.cos(np.radians([0, 45, 80]))
    moments = [mixture.second_moment(value, model.mixture, fitted, types, float(c)) for c in cosines]
    return {
        "relative_error": float((error / total)[0]),
        "albedo_largest": float(albedo.max()),
        "sample_weight_moment": float(np.mean(moments)),
    }
