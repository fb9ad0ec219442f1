"""Table files of learned BSDFs."""

from __future__ import annotations

import math
import os
from dataclasses import astuple
from pathlib import Path

import numpy as np

from ...arrays.indirection import DifferentiableArray, Indirection
from ...arrays.tables import StoredArray, Table, TableError, byte_array, check_ranges, load_table
from ...fitting.task import Model
from . import measurement, outputs, scattered, tensor_file
from .mixture import Mixture, SampledLobe, TurnedMixture
from .model import AZIMUTHS, PARAMETERS, TERMS, BSDFArrays, Form, LearnedBSDF, Proxy
from .source import Truth
from .training import LIMIT
from .truth import recorded_truth
from .view import SphereView

#: Arrays of the residual.
RESIDUAL = ("primary_uv", "primary_vw", "cascaded")

#: Limit of the range of residuals, natural logarithms.
WIDEST = 40.0


def to_table(
    net: BSDFArrays, form: Form, lobes, weights: np.ndarray, scale: np.ndarray | None, settings: dict
) -> Table:
    """Return the table of trained arrays: residual, weights and scale as bytes, the proxy in single precision."""
    arrays = {}
    residual = net.residual
    if isinstance(residual, Indirection):
        parts = dict(zip(RESIDUAL, (*residual.primary, residual.cascaded), strict=True))
    else:
        parts = {"cascaded": residual}
    arrays |= {name: StoredArray.of(array.quantised(8)) for name, array in parts.items()}
    if net.proxy is not None:
        logarithms = net.rate * net.proxy.numpy()
        arrays["proxy"] = StoredArray(logarithms.astype(np.float32))
    arrays["weights"] = byte_array(np.rint(weights * 255), 1 / 255)
    if scale is not None:
        low = min(float(scale.min()), 1 - 1e-6)
        step = (1 - low) / 255
        arrays["energy"] = byte_array(np.floor((scale[:, None] - low) / step + 1e-9), step, low)
    return Table(
        "bsdf", arrays, settings={"form": form.to_json(), "lobes": list(map(list, map(astuple, lobes))), **settings}
    )


def form_of(table: Table) -> Form:
    """Return the form in a table's settings. Raises :class:`TableError`."""
    given = table.settings.get("form")
    try:
        form = Form(
            tuple(given["terms"]), given["isotropic"], given["azimuth"],
            tuple(map(float, given["scale"])), tuple(map(float, given["range"])), float(given.get("angle", 0)),
        )  # fmt: skip
        low, high = form.range
        valid = (
            set(form.terms) <= set(TERMS)
            and isinstance(form.isotropic, bool)
            and form.azimuth in AZIMUTHS
            and len(form.scale) == 2
            and all(1e-3 <= a <= 1 for a in form.scale)
            and -WIDEST <= low < high <= WIDEST
            and abs(form.angle) <= math.pi
        )
    except (KeyError, TypeError, ValueError):
        valid = False
    if not valid:
        raise TableError(f'{table.path}: its setting "form" is {str(given)[:80]!r}, which is no form of a BSDF')
    return form


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`TableError`."""
    table = load_table(path, "bsdf")
    form = form_of(table)
    dims = {"cascaded": (3, 3), "weights": (1, 3)}
    if "primary_uv" in table.arrays or "primary_vw" in table.arrays:
        dims |= {"primary_uv": (2, 2), "primary_vw": (2, 1)}
    if form.terms:
        dims["proxy"] = (1, 1)
    if "energy" in table.arrays:
        dims["energy"] = (1, 1)
    check_arrays(table, dims)
    if form.terms and table.arrays["proxy"].shape != (PARAMETERS, 1):
        raise TableError(f'{path}: the array "proxy" has the shape {table.arrays["proxy"].shape}, expected (22, 1)')
    unit = (0.0, 1.0)
    check_ranges(table, {n: unit for n in table.arrays if n != "proxy"})
    lobes_of(table)
    return table


def check_arrays(table: Table, dims: dict[str, tuple[int, int | None]]) -> None:
    """Raise :class:`TableError` unless a table has the arrays ``dims`` and no others.

    ``dims`` maps names to numbers of dimensions and of channels (``None``: any).
    """
    for name in dims:
        if name not in table.arrays:
            raise TableError(f'{table.path}: the array "{name}" is missing')
    for name, array in table.arrays.items():
        if name not in dims:
            raise TableError(f'{table.path}: has an unexpected array "{name}"')
        expected, channels = dims[name]
        if len(array.shape) - 1 != expected or channels not in (None, array.shape[-1]):
            raise TableError(
                f'{table.path}: the array "{name}" has the shape {array.shape}, expected {expected} dimension(s)'
                + (f" and {channels} channel(s)" if channels else "")
            )


def lobes_of(table: Table) -> tuple[SampledLobe, SampledLobe]:
    """Return the lobes that sample, in a table's settings. Raises :class:`TableError`."""
    given = table.settings.get("lobes")
    limits = ((1e-3, 1), (1e-3, 1), (2, 200))
    valid = (
        isinstance(given, list)
        and len(given) == 2
        and all(isinstance(lobe, list) and len(lobe) == 3 for lobe in given)
        and all(_in_range(x, *limit) for lobe in given for x, limit in zip(lobe, limits, strict=True))
    )
    if not valid:
        raise TableError(
            f'{table.path}: its setting "lobes" is {str(given)[:80]!r}, expected 2 lists of two roughnesses from 0.001 '
            "to 1 and an exponent from 2 to 200"
        )
    return tuple(SampledLobe(*map(float, lobe)) for lobe in given)


def _in_range(value, low: float, high: float) -> bool:
    return isinstance(value, (int, float)) and low <= value <= high


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """Return the arrays; ``storage`` is the form of those of the residual, ``proxy`` is always in single precision."""
    result = {}
    for name, array in table.arrays.items():
        form = storage if name in RESIDUAL else "float32"
        result[name] = array.allocate(dtype, form, fold=name in RESIDUAL)
    return result


class BSDFModel(Model):
    """A table file as a ``bsdf`` (:class:`.model.LearnedBSDF`) and a ``mixture`` that samples it."""

    forms = ("float32", "uint8")

    def build(self):
        self.form = form_of(self.table)
        self.mixture = Mixture(self.arrays["weights"], lobes_of(self.table))
        if self.form.angle:
            self.mixture = TurnedMixture(self.mixture, self.form.angle)
        self.refresh()

    def refresh(self) -> None:
        """Build the BSDF anew from its arrays, after some of them have changed."""
        parts = [self.arrays.get(name) for name in RESIDUAL]
        residual = parts[2] if parts[0] is None else Indirection(parts[:2], parts[2], [(0, 1), (1, 2)])
        proxy = self.arrays.get("proxy")
        proxy = None if proxy is None else Proxy.of(BSDFArrays(None, proxy).logarithms(), self.form)
        self.bsdf = LearnedBSDF(self.form, residual, proxy, self.arrays.get("energy"))

    def entries(self) -> dict:
        """Return what can be optimised: the residual's arrays in single precision, and the proxy."""
        return {n: a for n, a in self.arrays.items() if a.storage == "float32" and n in (*RESIDUAL, "proxy")}

    def source(self) -> Truth:
        """Return the source that the file was fitted to. Raises :class:`TableError` if it cannot be opened again."""
        return recorded_truth(self.table, self.types)

    def measure(self) -> dict[str, float]:
        """Return errors against the source (:func:`.measurement.measure`)."""
        truth = self.source()
        if not truth.function:
            rows = scattered.split(truth, self.types, self.form.isotropic, LIMIT, self.table.seed or 0)[1]
            return measurement.measure_samples(self, scattered.without_outliers(rows, self.form, self.bsdf)[0])
        return measurement.measure(self, truth, SphereView(truth, self.types))

    def decode(self, output: str | os.PathLike | None = None, rows: int | None = None, seed: int | None = None):
        """Write a ``.bsdf``, ``.csv`` or ``.exr`` file (:mod:`.outputs`); without an ``output``, return its fields.

        ``rows`` and ``seed``: number of rows of a ``.csv`` file, and seed of its random directions. Raises
        :class:`.UsageError`.
        """
        if output is None:
            return tensor_file.fields(self.bsdf, self.types, str(self.table.settings.get("name", "")))
        return outputs.write(self, Path(output), self.source, rows, seed)


MODEL = BSDFModel
