"""Errors of a family against its source."""

from __future__ import annotations

import numpy as np

from . import energy, mixture
from .family_truth import FamilyTruth, constants
from .measurement import cosine
from .view import SphereView

#: Members that are measured.
MEMBERS = 24


def measure(model, truth: FamilyTruth) -> dict[str, float]:
    """Return figures of a family (:class:`.family_files.FamilyModel`) at random parameters.

    ``psnr_db``, ``psnr_median_db`` and ``psnr_minimum_db`` are those of the pictures of :mod:`.view`; ``albedo_excess``
    the largest relative difference by which a directional albedo, from 0° to 89°, lies above the source's;
    ``sample_weight_moment`` the mean of E[w²]/E[w]² of the weights of samples at 0°, 45° and 80°.
    """
    types = model.types
    cos = np.cos(np.radians([0, 15, 30, 45, 60, 70, 80, 85, 89]))
    psnr, excess, moments = [], [], []
    for coordinates in np.random.default_rng(17).random((MEMBERS, len(truth.parameters))):
        values = [p.value(x) for p, x in zip(truth.parameters, coordinates, strict=True)]
        source, (bsdf, mixed) = truth.at(coordinates), model.at(constants(types, values))
        value = cosine(bsdf)
        psnr.append(SphereView(source, types, side=48, samples=32).psnr(value))
        albedo = energy.albedos([source.value, value], source, types, cos)
        excess.append(((albedo[1] - albedo[0]) / np.maximum(albedo[0], 1e-3)).max())
        moments += [mixture.second_moment(source.value, mixed, source, types, float(c), 2**13) for c in cos[[0, 3, 6]]]
    return {
        "psnr_db": float(np.mean(psnr)),
        "psnr_median_db": float(np.median(psnr)),
        "psnr_minimum_db": float(np.min(psnr)),
        "albedo_excess": float(np.max(excess)),
        "sample_weight_moment": float(np.mean(moments)),
    }
