"""Table files of families."""

from __future__ import annotations

import math
import os

import drjit as dr
import numpy as np

from ...arrays.indirection import DifferentiableArray, Indirection
from ...arrays.tables import StoredArray, Table, TableError, byte_array, check_ranges, load_table
from ...core.errors import UsageError, reason
from . import family_measurement
from .family import CHANNELS, MOST, FamilyArrays, FamilyMember, Parameter, member, proxy_of, widths
from .family_truth import FamilyTruth
from .files import RESIDUAL, BSDFModel, check_arrays, form_of
from .mixture import Mixture, SampledLobe
from .model import Form, LearnedBSDF, fourth_roots

#: Arrays of a residual: those of one material, and the factors of its terms.
ARRAYS = (*RESIDUAL, "mixing")

#: Tables over the parameters.
TABLES = ("proxy", "mixing", "weights", "energy")


def to_table(
    net: FamilyArrays, form: Form, parameters: list[Parameter], factors, weights, scale, settings: dict
) -> Table:
    """Return the table of trained arrays: the proxy in half precision, all else as bytes."""
    parts = (*net.residual.primary, net.residual.cascaded, net.mixing)
    arrays = {name: StoredArray.of(part.quantised(8)) for name, part in zip(ARRAYS, parts, strict=True)}
    arrays["proxy"] = StoredArray(net.proxy_table().numpy().astype(np.float16))
    arrays["weights"] = byte_array(np.rint(weights * 255), 1 / 255)
    if scale is not None:
        low = min(float(scale.min()), 1 - 1e-6)
        step = (1 - low) / 255
        arrays["energy"] = byte_array(np.floor((scale - low) / step + 1e-9), step, low)
    family = [p.to_json() for p in parameters]
    return Table(
        "bsdf", arrays, settings={"form": form.to_json(), "family": family, "factors": list(factors), **settings}
    )


def parameters_of(table: Table) -> list[Parameter]:
    """Return the parameters in a table's settings. Raises :class:`TableError`."""
    given = table.settings.get("family")
    try:
        parameters = [Parameter(str(p["name"]), float(p["low"]), float(p["high"])) for p in given]
        valid = 1 <= len(parameters) <= MOST and all(
            p.name.isidentifier() and -math.inf < p.low < p.high < math.inf for p in parameters
        )
    except (KeyError, TypeError, ValueError):
        valid = False
    if not valid:
        raise TableError(f'{table.path}: its setting "family" is {str(given)[:80]!r}, which are no parameters')
    return parameters


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of a family. Raises :class:`TableError`."""
    table = load_table(path, "bsdf")
    form, count = form_of(table), len(parameters_of(table))
    dims = {"primary_uv": (2, 2), "primary_vw": (2, 1), "mixing": (count, None), "cascaded": (3, None)}
    dims |= {"proxy": (count, CHANNELS), "weights": (count + 1, 3)}
    if "energy" in table.arrays:
        dims["energy"] = (count + 1, 1)
    check_arrays(table, dims)
    rank = table.arrays["mixing"].shape[-1]
    if table.arrays["cascaded"].shape[-1] != 3 * rank:
        raise TableError(
            f'{path}: the array "cascaded" has {table.arrays["cascaded"].shape[-1]} channels, expected {3 * rank}'
        )
    if not form.terms:
        raise TableError(f'{path}: its setting "form" has no terms, a family needs a proxy')
    check_ranges(table, dict.fromkeys((name for name in table.arrays if name != "proxy"), (0.0, 1.0)))
    factors = table.settings.get("factors")
    if not (isinstance(factors, list) and len(factors) == 2 and all(_is_factor(f) for f in factors)):
        raise TableError(f'{path}: its setting "factors" is {factors!r}, expected 2 numbers from 0.1 to 10')
    return table


def _is_factor(value) -> bool:
    return isinstance(value, (int, float)) and math.isfinite(value) and 0.1 <= value <= 10


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """Return the arrays; ``storage`` is the form of those of the residual, ``proxy`` is always in single precision."""
    result = {}
    for name, array in table.arrays.items():
        form = "float32" if name == "proxy" else storage if name in ARRAYS else ""
        result[name] = array.allocate(dtype, form, fold=name in ARRAYS)
    return result


class FamilyModel(BSDFModel):
    """A table file of a family, whose members :meth:`at` returns; ``bsdf`` and ``mixture`` are the middle's.

    So is what :meth:`decode` writes.
    """

    def build(self):
        self.form, self.parameters = form_of(self.table), parameters_of(self.table)
        self.refresh()

    def refresh(self) -> None:
        """Build the middle anew from the arrays, after some of them have changed."""
        Float = self.types.Float
        self.bsdf, self.mixture = self.at([Float(p.middle) for p in self.parameters])

    def at(self, values: list, active=True):
        """Return the BSDF and the mixture that samples it for ``values`` of the parameters, arrays of any width."""
        x = [p.coordinate(v) for p, v in zip(self.parameters, values, strict=True)]
        arrays = self.arrays
        residual = Indirection([arrays[n] for n in RESIDUAL[:2]], arrays["cascaded"], [(0, 1), (1, 2)])
        bsdf = member(self.form, arrays["proxy"], residual, arrays["mixing"], arrays.get("energy"), x, active)

        def weights(angle, active=True):
            return arrays["weights"]([*angle, *x], active)

        factors = self.table.settings["factors"]
        alphas = [f * w for f, w in zip(factors, widths(bsdf.proxy, bsdf.scale), strict=True)]
        return bsdf, Mixture(weights, tuple(SampledLobe(a, a) for a in alphas))

    def fixed(self, values: list[float]) -> tuple[LearnedBSDF, Mixture]:
        """Return the BSDF and the mixture of one member, a single material, without derivatives.

        What the parameters determine is computed once, so that it takes no more time than any learned BSDF.
        """
        at = {name: self._interpolated(name, values) for name in TABLES if name in self.arrays}
        Float = self.types.Float
        with dr.suspend_grad():
            numbers = [dr.opaque(Float, float(v)) for v in at["proxy"]]
            proxy, scale = proxy_of(numbers, self.form)
            factors = self.table.settings["factors"]
            lobes = tuple(f * w for f, w in zip(factors, widths(proxy, scale), strict=True))
            dr.make_opaque(proxy, lobes, scale)
        low, step = fourth_roots(self.form.range)
        start, cascaded = (1 - low) / step, self.arrays["cascaded"].numpy().astype(np.float64)
        terms = cascaded.reshape(*cascaded.shape[:3], -1, 3) - start
        combined = np.clip(start + np.einsum("r,uvwrc->uvwc", 2 * at["mixing"] - 1, terms), 0, 1)
        parts = [self.arrays[n] for n in RESIDUAL[:2]]
        residual = Indirection(parts, self._array(combined, self.arrays["cascaded"].border), [(0, 1), (1, 2)])
        energy = self._array(at["energy"]) if "energy" in at else None
        mixture = Mixture(self._array(at["weights"]), tuple(SampledLobe(a, a) for a in lobes))
        with dr.suspend_grad():
            bsdf = FamilyMember(self.form, residual, proxy, energy, scale)
            dr.make_opaque(bsdf.terms)  # not numbers of Python, which would be part of kernels
        return bsdf, mixture

    def reduced(self, values: list[float | None]) -> FamilyModel:
        """Return the family of the parameters whose value is ``None``, for ``values`` of the others."""
        result = self.copy()
        for name in TABLES:
            if name in self.arrays:
                result.arrays[name] = self._array(self._interpolated(name, values))
        result.parameters = [p for p, v in zip(self.parameters, values, strict=True) if v is None]
        return result

    def _array(self, values: np.ndarray, border="clamp") -> DifferentiableArray:
        return DifferentiableArray.from_numpy(values.astype(np.float32), self.dtype, border)

    def _interpolated(self, name: str, values: list[float | None]) -> np.ndarray:
        """Return a table without the axes of parameters that have a value."""
        array, first = self.arrays[name].numpy().astype(np.float64), name in ("weights", "energy")
        for k, value in reversed(list(enumerate(values))):
            if value is not None:
                axis = first + k
                position = float(self.parameters[k].coordinate(float(value))) * (array.shape[axis] - 1)
                lower = min(int(position), array.shape[axis] - 2)
                ends = [np.take(array, lower + end, axis) for end in (0, 1)]
                array = ends[0] + (position - lower) * (ends[1] - ends[0])
        return array

    def entries(self) -> dict:
        """Return what can be optimised: the residual's arrays and the proxy's, in single precision."""
        return {n: a for n, a in self.arrays.items() if a.storage == "float32" and n in (*ARRAYS, "proxy")}

    def family(self) -> FamilyTruth:
        """Return the source of all members. Raises :class:`TableError` if it cannot be opened again."""
        try:
            return FamilyTruth(super().source(), self.table.settings["over"])
        except (KeyError, UsageError) as e:
            raise TableError(f"{self.table.path}: its source cannot be opened again: {reason(e)}") from None

    def source(self):
        return self.family().at([0.5] * len(self.parameters))

    def measure(self) -> dict[str, float]:
        """Return errors against the source (:func:`.family_measurement.measure`)."""
        return family_measurement.measure(self, self.family())
