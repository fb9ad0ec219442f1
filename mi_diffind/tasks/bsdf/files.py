"""Table files of learned BSDFs and of families."""

from __future__ import annotations

import functools
import math
import os
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.indirection import DifferentiableArray, Indirection
from ...arrays.tables import StoredArray, Table, TableError, byte_array, check_ranges, load_table
from ...core.errors import UsageError, reason
from ...fitting.task import Model
from . import evaluation, measured
from .directions import SphereView
from .measured import Truth
from .mixture import Mixture, SampledLobe, TurnedMixture
from .model import (
    AZIMUTHS,
    CHANNELS,
    MOST_PARAMETERS,
    PARAMETERS,
    TERMS,
    BSDFArrays,
    Form,
    LearnedBSDF,
    Parameter,
    Proxy,
    fourth_roots,
    member,
    member_proxy,
    widths,
)
from .training import LIMIT
from .truth import FamilyTruth, recorded_truth

#: Arrays of the residual; ``mixing`` has the factors of its terms in a family.
RESIDUAL = ("primary_uv", "primary_vw", "cascaded", "mixing")

#: Tables over the parameters of a family.
PARAMETER_TABLES = ("proxy", "mixing", "weights", "energy")

#: Largest entry that counts in an interpolation: assigned ones may be infinite.
LARGEST_ENTRY = 1e6

#: Limit of the range of residuals, natural logarithms.
WIDEST = 40.0


def to_table(
    net: BSDFArrays, form: Form, sampling: dict, weights: np.ndarray, scale: np.ndarray | None, settings: dict
) -> Table:
    """Return the table of trained arrays: residual, weights and scale as bytes, the proxy as floats.

    ``sampling`` are the settings of the mixture (``lobes``, or ``family`` and ``factors``), ``scale`` is that of the
    energy.
    """
    residual = net.residual
    parts = (*residual.primary, residual.cascaded) if isinstance(residual, Indirection) else (None, None, residual)
    parts = zip(RESIDUAL, (*parts, net.mixing), strict=True)
    arrays = {name: StoredArray.of(part.quantised(8)) for name, part in parts if part is not None}
    if net.mixing is not None:
        arrays["proxy"] = StoredArray(net.proxy_table().numpy().astype(np.float16))
    elif net.proxy is not None:
        arrays["proxy"] = StoredArray((net.rate * net.proxy.numpy()).astype(np.float32))
    arrays["weights"] = byte_array(np.rint(weights * 255), 1 / 255)
    if scale is not None:
        low = min(float(scale.min()), 1 - 1e-6)
        step = (1 - low) / 255
        scale = scale[:, None] if scale.ndim == 1 else scale
        arrays["energy"] = byte_array(np.floor((scale - low) / step + 1e-9), step, low)
    return Table("bsdf", arrays, settings={"form": form.to_json(), **sampling, **settings})


def table_form(table: Table) -> Form:
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


def table_parameters(table: Table) -> list[Parameter]:
    """Return the parameters of a family, none of a single BSDF. Raises :class:`TableError`."""
    if "family" not in table.settings:
        return []
    given = table.settings["family"]
    try:
        parameters = [Parameter(str(p["name"]), float(p["low"]), float(p["high"])) for p in given]
        valid = 1 <= len(parameters) <= MOST_PARAMETERS and all(
            p.name.isidentifier() and -math.inf < p.low < p.high < math.inf for p in parameters
        )
    except (KeyError, TypeError, ValueError):
        valid = False
    if not valid:
        raise TableError(f'{table.path}: its setting "family" is {str(given)[:80]!r}, which are no parameters')
    return parameters


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`TableError`."""
    table = load_table(path, "bsdf")
    form, family = table_form(table), (None,) * len(table_parameters(table))
    shapes: dict[str, tuple] = {"cascaded": (None, None, None, None if family else 3), "weights": (None, *family, 3)}
    if family or "primary_uv" in table.arrays or "primary_vw" in table.arrays:
        shapes |= {"primary_uv": (None, None, 2), "primary_vw": (None, None, 1)}
    if family:
        shapes |= {"mixing": (*family, None), "proxy": (*family, CHANNELS)}
    elif form.terms:
        shapes["proxy"] = (PARAMETERS, 1)
    if "energy" in table.arrays:
        shapes["energy"] = (None, *family, 1)
    table = load_table(path, "bsdf", shapes)
    if not family:
        lobes, limits = table.settings.get("lobes"), ((1e-3, 1), (1e-3, 1), (2, 200))
        if not (isinstance(lobes, list) and len(lobes) == 2 and all(_are_numbers(lobe, limits) for lobe in lobes)):
            raise TableError(
                f'{path}: its setting "lobes" is {str(lobes)[:80]!r}, expected 2 lists of two roughnesses from 0.001 '
                "to 1 and an exponent from 2 to 200"
            )
    else:
        expected, channels = 3 * table.arrays["mixing"].shape[-1], table.arrays["cascaded"].shape[-1]
        if channels != expected:
            raise TableError(f'{path}: the array "cascaded" has {channels} channels, expected {expected}')
        if not form.terms:
            raise TableError(f'{path}: its setting "form" has no terms, a family needs a proxy')
        factors = table.settings.get("factors")
        if not _are_numbers(factors, ((0.1, 10),) * 2):
            raise TableError(f'{path}: its setting "factors" is {factors!r}, expected 2 numbers from 0.1 to 10')
    check_ranges(table, {name: (0.0, 1.0) for name in table.arrays if name != "proxy"})
    return table


def _are_numbers(values, limits) -> bool:
    """Return whether ``values`` is a list of numbers, each within its limits."""
    if not isinstance(values, list) or len(values) != len(limits):
        return False
    pairs = zip(values, limits, strict=True)
    return all(isinstance(value, (int, float)) and low <= value <= high for value, (low, high) in pairs)


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """Return the arrays; ``storage`` is the form of those of the residual, all else is as floats or as in the file."""
    is_family, result = "family" in table.settings, {}
    for name, array in table.arrays.items():
        form = storage if name in RESIDUAL else "" if is_family and name != "proxy" else "float32"
        result[name] = array.allocate(dtype, form, fold=name in RESIDUAL)
    return result


class BSDFModel(Model):
    """A table file as a ``bsdf`` (:class:`.model.LearnedBSDF`) and a ``mixture`` that samples it.

    Of a family, they are those of the middle, and :meth:`at` returns its members.
    """

    forms = ("float32", "uint8")

    def build(self):
        self.form, self.parameters = table_form(self.table), table_parameters(self.table)
        self.refresh()

    def refresh(self) -> None:
        """Build the BSDF anew from its arrays, after some of them have changed."""
        if self.parameters:
            self.bsdf, self.mixture = self.at([self.types.Float(p.middle) for p in self.parameters])
            return
        proxy = self.arrays.get("proxy")
        proxy = None if proxy is None else Proxy.from_logarithms(BSDFArrays(None, proxy).logarithms(), self.form)
        numbers, opaque = self.form.numbers(self.types.Float), functools.partial(dr.opaque, self.types.Float)
        self.bsdf = LearnedBSDF(self.form, self._residual(), proxy, self.arrays.get("energy"), numbers=numbers)
        lobes = tuple(
            SampledLobe(opaque(float(u)), opaque(float(v)), 2.0 if gamma == 2 else opaque(float(gamma)))
            for u, v, gamma in self.table.settings["lobes"]
        )
        self.mixture = Mixture(self.arrays["weights"], lobes)
        if self.form.angle:
            self.mixture = TurnedMixture(self.mixture, self.form.angle)

    def _residual(self, cascaded: DifferentiableArray | None = None):
        primary = [self.arrays.get(name) for name in RESIDUAL[:2]]
        cascaded = cascaded or self.arrays["cascaded"]
        return cascaded if primary[0] is None else Indirection(primary, cascaded, [(0, 1), (1, 2)])

    def at(self, values: list, active=True):
        """Return the BSDF and the mixture that samples it for ``values`` of the parameters, arrays of any width."""
        if not self.parameters:
            return self.bsdf, self.mixture
        x = [p.coordinate(v) for p, v in zip(self.parameters, values, strict=True)]
        arrays = self.arrays
        bsdf = member(self.form, arrays["proxy"], self._residual(), arrays["mixing"], arrays.get("energy"), x, active)

        def weights(angle, active=True):
            return arrays["weights"]([*angle, *x], active)

        factors = self.table.settings["factors"]
        alphas = [f * w for f, w in zip(factors, widths(bsdf.proxy, bsdf.scale), strict=True)]
        return bsdf, Mixture(weights, tuple(SampledLobe(a, a) for a in alphas))

    def member(self, values: list[float]) -> tuple[LearnedBSDF, Mixture]:
        """Return the BSDF and the mixture of one member, a single material, without derivatives.

        The tables are interpolated once, so that it takes no more time than a single learned BSDF.
        """
        at = {name: self._interpolated(name, values) for name in PARAMETER_TABLES if name in self.arrays}
        Float = self.types.Float
        with dr.suspend_grad():
            numbers = [dr.opaque(Float, float(v)) for v in at["proxy"]]
            proxy, scale = member_proxy(numbers, self.form)
            factors = self.table.settings["factors"]
            lobes = tuple(f * w for f, w in zip(factors, widths(proxy, scale), strict=True))
            dr.make_opaque(proxy, lobes, scale)
        low, step = fourth_roots(self.form.range)
        start, cascaded = (1 - low) / step, self.arrays["cascaded"].numpy().astype(np.float64)
        terms = cascaded.reshape(*cascaded.shape[:3], -1, 3) - start
        combined = np.clip(start + np.einsum("r,uvwrc->uvwc", 2 * at["mixing"] - 1, terms), 0, 1)
        residual = self._residual(self._array(combined, self.arrays["cascaded"].border))
        energy = self._array(at["energy"]) if "energy" in at else None
        mixture = Mixture(self._array(at["weights"]), tuple(SampledLobe(a, a) for a in lobes))
        with dr.suspend_grad():
            bsdf = LearnedBSDF(self.form, residual, proxy, energy, scale)
            dr.make_opaque(bsdf.terms)  # not numbers of Python, which would be part of kernels
        return bsdf, mixture

    def restrict(self, values: list[float | None]) -> BSDFModel:
        """Return the family of the parameters whose value is ``None``, for ``values`` of the others."""
        result = self.copy()
        for name in PARAMETER_TABLES:
            if name in self.arrays:
                result.arrays[name] = self._array(self._interpolated(name, values))
        result.parameters = [p for p, v in zip(self.parameters, values, strict=True) if v is None]
        return result

    def _array(self, values: np.ndarray, border="clamp") -> DifferentiableArray:
        return DifferentiableArray.from_numpy(values.astype(np.float32), self.dtype, border)

    def _interpolated(self, name: str, values: list[float | None]) -> np.ndarray:
        """Return a table without the axes of parameters that have a value."""
        first = name in ("weights", "energy")
        array = np.clip(np.nan_to_num(self.arrays[name].numpy().astype(np.float64)), -LARGEST_ENTRY, LARGEST_ENTRY)
        for k, value in reversed(list(enumerate(values))):
            if value is not None:
                axis = first + k
                position = float(self.parameters[k].coordinate(float(value))) * (array.shape[axis] - 1)
                lower = min(int(position), array.shape[axis] - 2)
                ends = [np.take(array, lower + end, axis) for end in (0, 1)]
                array = ends[0] + (position - lower) * (ends[1] - ends[0])
        return array

    def entries(self) -> dict:
        """Return what can be optimised: the residual's arrays in single precision, and the proxy."""
        return {n: a for n, a in self.arrays.items() if a.storage == "float32" and n in (*RESIDUAL, "proxy")}

    def family(self) -> FamilyTruth:
        """Return the source of all members of a family. Raises :class:`TableError` if it cannot be opened again."""
        try:
            return FamilyTruth(recorded_truth(self.table, self.types), self.table.settings["over"])
        except (KeyError, UsageError) as e:
            raise TableError(f"{self.table.path}: its source cannot be opened again: {reason(e)}") from None

    def source(self) -> Truth:
        """Return the source, of a family that of its middle. Raises :class:`TableError` if it cannot be opened."""
        if self.parameters:
            return self.family().at([0.5] * len(self.parameters))
        return recorded_truth(self.table, self.types)

    def measure(self) -> dict[str, float]:
        """Return errors against the source (:mod:`.evaluation`)."""
        if self.parameters:
            return evaluation.measure_family(self, self.family())
        truth = self.source()
        if not truth.function:
            rows = measured.split(truth, self.types, self.form.isotropic, LIMIT, self.table.seed or 0)[1]
            if truth.scattered:
                rows, _ = measured.without_outliers(rows, self.form, self.bsdf)
            return evaluation.measure_samples(self, rows)
        return evaluation.measure(self, truth, SphereView(truth, self.types))

    def decode(self, output: str | os.PathLike | None = None, rows: int | None = None, seed: int | None = None):
        """Write a ``.csv`` or ``.exr`` file (:func:`.evaluation.write`); without an ``output``, return the rows.

        ``rows`` and ``seed``: number of rows of a ``.csv`` file, and seed of its random directions. Raises
        :class:`.UsageError`.
        """
        if output is None:
            return evaluation.sample_rows(self, rows or evaluation.ROWS, seed or 0)
        return evaluation.write(self, Path(output), self.source, rows, seed)


MODEL = BSDFModel
