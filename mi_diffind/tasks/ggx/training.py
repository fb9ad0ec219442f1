"""Training of task 1: samples, errors, the training problem, and table files."""

import math
import os
from collections.abc import Callable
from dataclasses import asdict

import drjit as dr
import numpy as np

from ...arrays.indirection import Indirection
from ...arrays.lookup import STORAGES
from ...arrays.tables import Table, TableError, check_ranges, load_table
from ...fitting.loop import Problem, exponential_like
from ...fitting.task import Model
from .model import ALPHA_MIN, ENCODINGS, Encoding, LearnedGGX, ggx

#: Ranges of roughness for which errors are reported.
BANDS = ((0.001, 0.01), (0.01, 0.1), (0.1, 0.5), (0.5, 1.0))


def draw(rng, types, size: int, preset: str = "paper"):
    """Draw ``size`` samples ``(cos θ_h, sin²θ_h, α)``: cosine-weighted normals and exponential-like roughness.

    For the preset ``"tables"``, half of the normals are drawn from the peak (:mod:`.model`).
    """
    u, v = (rng.random(types.Float, size) for _ in range(2))
    alpha = dr.maximum(exponential_like(v), ALPHA_MIN)
    sin2 = u
    if preset == "tables":
        choice, a2 = rng.random(types.Float, size), dr.square(alpha)
        peak = dr.select(choice < 0.125, 0, u * a2 / (dr.fma(u, a2, 1 - u)))  # of density D cos θ_h
        sin2 = dr.select(choice < 0.5, peak, sin2)
    return dr.sqrt(1 - sin2), sin2, alpha


def measure(distribution: Callable, types, samples: int = 10**6, seed: int = 2023) -> dict[str, float]:
    """Measure the errors of ``distribution(cos, sin2, alpha)`` against :func:`ggx`.

    On the bounded range: ``psnr_db`` and ``mae`` of D clipped to [0, 1], over ``samples`` of :func:`draw`. On the peak,
    for each of :data:`BANDS`: ``peak_error_LOW_HIGH``, the largest of |D̂/D − 1| at the normal itself over 64
    roughnesses of the band, and ``lobe_error_LOW_HIGH``, the 99th percentile of it where D is at least a tenth of the
    peak's (16,384 samples).
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    cos, sin2, alpha = draw(rng, types, samples)
    error = dr.clip(distribution(cos, sin2, alpha), 0, 1) - dr.clip(ggx(sin2, alpha), 0, 1)
    dr.eval(error)
    errors = {
        "psnr_db": -10 * math.log10(max(dr.mean(dr.square(error))[0], 1e-20)),
        "mae": float(dr.mean(dr.abs(error))[0]),
    }
    # D ≥ D_peak/10 where q ≤ √10 α², that is, where sin² ≤ (√10 − 1) α² / (1 − α²)
    n, m = 64, 256
    rank = int(0.99 * n * m)
    index = dr.arange(types.UInt32, n * m)
    i, j = types.Float(index // m) / (n - 1), types.Float(index % m) / (m - 1)
    for low, high in BANDS:
        alpha = low * dr.power(high / low, i)
        a2 = dr.square(alpha)
        limit = dr.minimum((math.sqrt(10) - 1) * a2 / dr.maximum(1 - a2, 1e-6), 1)
        sin2 = limit * j
        relative = dr.abs(distribution(dr.sqrt(1 - sin2), sin2, alpha) / ggx(sin2, alpha) - 1).numpy().reshape(n, m)
        name = f"{low:g}_{high:g}"
        errors[f"peak_error_{name}"] = float(relative[:, 0].max())
        errors[f"lobe_error_{name}"] = float(np.partition(relative.ravel(), rank)[rank])
    return errors


class GGXProblem(Problem):
    """Training problem of the distribution for any representation ``net``, which maps two coordinates to one output.

    ``preset`` selects the samples (:func:`draw`); ``encoding`` defaults to that of the preset.
    """

    #: In dB. The peak still improves when the mean has settled.
    tolerance = 0.1

    def __init__(self, net, types, preset: str = "tables", encoding: Encoding | None = None):
        self.net, self.types, self.samples = net, types, preset
        self.encoding = encoding or ENCODINGS[preset]
        self.identity = {"samples": preset, **asdict(self.encoding)}

    def batch(self, rng, size: int):
        cos, sin2, alpha = draw(rng, self.types, size, self.samples)
        target = self.encoding.encode(ggx(sin2, alpha), alpha)
        return self.encoding.coordinates(cos, sin2, alpha), {"d": [target]}

    def predict(self, net, inputs) -> dict[str, list]:
        return {"d": net(inputs)}

    def measure(self, net) -> dict[str, float]:
        return measure(LearnedGGX(net, self.encoding, tail=False), self.types, 2**18)


class GGXModel(Model):
    """A table file as a ``distribution`` (:class:`.model.LearnedGGX`)."""

    forms = STORAGES

    def build(self):
        net = Indirection(self.arrays["primary"], self.arrays["cascaded"])
        self.distribution = LearnedGGX(net, table_encoding(self.table))

    def measure(self, samples: int = 10**6) -> dict[str, float]:
        """Measure errors (:func:`measure`)."""
        return measure(self.distribution, self.types, samples)


def table_encoding(table: Table) -> Encoding:
    """Return the encoding that a table's settings name. Raises :class:`TableError`."""
    try:
        return Encoding(table.settings["inputs"], table.settings["output"])
    except (KeyError, TypeError, ValueError) as e:
        raise TableError(f"{table.path}: the settings name no known encoding ({e})") from None


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`TableError`."""
    table = load_table(path, "ggx", {"primary": (None, None, 2), "cascaded": (None, None, 1)})
    bounded = table_encoding(table).output == "root"
    check_ranges(table, {"primary": (0.0, 1.0), **({"cascaded": (-0.5, 1.5)} if bounded else {})})
    return table


MODEL = GGXModel
