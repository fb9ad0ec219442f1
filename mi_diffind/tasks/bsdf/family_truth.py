"""Source of a family: a BSDF of Mitsuba whose scalar parameters are set, and its samples."""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...core.errors import UsageError
from . import symmetry, training
from .family import MOST, Parameter
from .pool import Samples
from .truth import MitsubaTruth, Truth

#: Members of the family from which samples are drawn.
MEMBERS = 128

#: Relative difference of f below which a parameter has no effect.
EFFECT = 1e-5


def parameters_of(over) -> dict[str, tuple[float, float]]:
    """Return the ranges of parameters by name, from a dictionary or pairs. Raises :class:`UsageError`."""
    ranges = dict(over)
    if not 1 <= len(ranges) <= MOST:
        raise UsageError(f"over: found {len(ranges)} parameters, allowed are 1 to {MOST}")
    for name, ends in ranges.items():
        try:
            low, high = map(float, ends)
        except (TypeError, ValueError):
            low = high = math.nan
        if not (low < high and math.isfinite(low) and math.isfinite(high)):
            raise UsageError(f"over: found {name} = {ends!r}, a pair of finite numbers (low, high) is needed")
        ranges[name] = (low, high)
    return ranges


class FamilyTruth:
    """BSDF of Mitsuba whose ``parameters`` are set. Raises :class:`UsageError`.

    ``over`` maps names to ranges; a name is the key of ``mi.traverse``, with or without a last ``.value``, or its end.
    """

    def __init__(self, truth: Truth, over: dict[str, tuple[float, float]]):
        if not isinstance(truth, MitsubaTruth):
            raise UsageError(f"over: {truth.name} has no parameters, a BSDF of Mitsuba is needed")
        import mitsuba as mi

        self.truth, self.scene = truth, mi.traverse(truth.bsdf)
        scalars = [key for key in self.scene.keys() if type(self.scene[key]) is mi.Float]
        self.scalars = {key.removesuffix(".value"): key for key in scalars}
        self.keys, self.parameters = [], []
        for name, (low, high) in over.items():
            key = self._key(name)
            self.keys.append(self.scalars[key])
            self.parameters.append(Parameter(name.removesuffix(".value").replace(".", "_"), low, high))
        if len(set(self.keys)) < len(self.keys):
            raise UsageError(f"over: found {', '.join(over)}, which name a parameter twice")
        self.before = [mi.Float(self.scene[key]) for key in self.keys]

    def _key(self, name: str) -> str:
        name = name.removesuffix(".value")
        matching = [name] if name in self.scalars else [key for key in self.scalars if key.endswith("." + name)]
        if len(matching) != 1:
            allowed = ", ".join(matching or self.scalars) or "none"
            raise UsageError(f'over: found "{name}", the parameters of {self.truth.name} are {allowed}')
        return matching[0]

    def at(self, coordinates) -> MitsubaTruth:
        """Return the source at coordinates in [0, 1], one for each parameter. It is the same object for all."""
        self._set([p.value(float(x)) for p, x in zip(self.parameters, coordinates, strict=True)])
        return self.truth

    def _set(self, values: list) -> None:
        for key, value in zip(self.keys, values, strict=True):
            self.scene[key] = type(self.scene[key])(value)
        self.scene.update()

    def restore(self) -> None:
        """Give the source the parameters that it had."""
        self._set(self.before)

    def check_effects(self, types) -> None:
        """Raise :class:`UsageError` if a parameter changes nothing."""
        from .pool import incident, outgoing

        rng = dr.rng(seed=dr.opaque(types.UInt64, 1))
        samples = outgoing(rng, types, incident(rng, types, 2**10, False))
        for k, parameter in enumerate(self.parameters):
            ends = []
            for end in (0.0, 1.0):
                coordinates = [0.5] * len(self.parameters)
                coordinates[k] = end
                value = self.at(coordinates).value(samples.wi, samples.wo)
                ends.append(np.stack([(samples.weight * v).numpy() for v in value]))
            if np.abs(ends[1] - ends[0]).sum() <= EFFECT * np.abs(ends[0]).sum():
                raise UsageError(
                    f"over: {parameter.name} changes nothing of {self.truth.name}, which may need it in the source, too"
                )

    def symmetries(self, types) -> dict[str, float]:
        """Return the largest relative differences of some members (:func:`.symmetry.measured_symmetry`)."""
        measured = [
            symmetry.measured_symmetry(self.at(x), types, 2**14) for x in points(6, len(self.parameters), seed=9)
        ]
        return {name: max(m[name] for m in measured) for name in measured[0]}


def points(count: int, dims: int, seed: int) -> np.ndarray:
    """Return well-distributed coordinates in [0, 1], ``(count, dims)``; some lie on the ends."""
    root = (1.6180339887, 1.3247179572, 1.2207440846)[dims - 1]  # the R sequence (Roberts 2018)
    steps = root ** -np.arange(1.0, dims + 1)
    x = (np.random.default_rng(seed).random(dims) + np.arange(1, count + 1)[:, None] * steps) % 1
    return np.clip(1.08 * x - 0.04, 0, 1)


def constants(types, numbers) -> list:
    """Return numbers, as of the parameters of one member, as arrays that no kernel contains."""
    return [dr.opaque(types.Float, float(x)) for x in numbers]


class FamilySamples(Samples):
    """Samples of members of a family; ``coordinates`` are those of their parameters."""

    coordinates: list

    def at(self, index) -> FamilySamples:
        s = super().at(index)
        result = FamilySamples(s.wi, s.wo, s.weight, s.value)
        result.coordinates = [dr.gather(type(c), c, index) for c in self.coordinates]
        return result


def draw(truth: FamilyTruth, types, size: int, members: int, seed: int, isotropic: bool) -> FamilySamples:
    """Return ``size`` samples of ``members`` of a family, in random order."""
    each, columns = size // members, []
    for k, coordinates in enumerate(points(members, len(truth.parameters), seed)):
        s = training.draw(truth.at(coordinates), types, each, 1000 * seed + k, isotropic)
        arrays = [c.numpy() for c in (*s.wi, *s.wo, s.weight, *s.value)]
        columns.append(np.stack([np.broadcast_to(a, each) for a in (*arrays, *coordinates)]))
    joined = np.concatenate(columns, axis=1, dtype=np.float32)
    joined = joined[:, np.random.default_rng(seed).permutation(joined.shape[1])]
    arrays = [device_array(types.Float, column) for column in joined]
    samples = FamilySamples(types.Array3f(*arrays[:3]), types.Array3f(*arrays[3:6]), arrays[6], arrays[7:10])
    samples.coordinates = arrays[10:]
    return samples
