"""Base class of the tables of the Disney BRDF.

A layout (:class:`.paper.PaperArrays`, :class:`.factored.FactoredArrays`) is a ``drjit.nn`` module of named
:class:`.DifferentiableArray` s. It declares their sizes and the range of their entries, and
defines their training: initial values, targets and predictions. Its decoder reads it.
"""

import numpy as np
from drjit import nn

from ...arrays.indirection import DifferentiableArray
from ...arrays.lookup import clamp
from ...arrays.tables import StoredArray, Table
from .decoder import warp_roughness


class DisneyArrays(nn.Module):
    """Base class of the layouts.

    ``Layout().alloc(TensorXf)`` starts from ramps and coarse samples of the target functions. Parameters are called
    ``NAME.data``.
    """

    #: The preset of this layout.
    PRESET = ""

    #: Name of a table → its shape, channels last.
    SHAPES: dict[str, tuple] = {}  # noqa: RUF012

    #: Name of a table → the range of its entries; outside of it the BRDF could become negative or infinite.
    RANGES: dict[str, tuple] = {}  # noqa: RUF012

    def __init_subclass__(cls):
        cls.DRJIT_STRUCT = {name: DifferentiableArray for name in cls.SHAPES}

    def __init__(self, arrays: dict[str, DifferentiableArray] | None = None):
        arrays = arrays or {}
        for name in self.SHAPES:
            setattr(self, name, arrays.get(name))

    def _alloc(self, dtype, size=-1, rng=None):
        arrays = {}
        for name, shape in self.SHAPES.items():
            is_encoder = name.startswith("encoder")
            init = np.clip(self.initial(name), *self.RANGES[name]).astype(np.float32)
            arrays[name] = DifferentiableArray(shape[:-1], shape[-1], init, fold=is_encoder)._alloc(dtype)[0]
        return type(self)(arrays), 2

    @classmethod
    def initial(cls, name: str) -> np.ndarray:
        """Return the initial entries: coarse samples of the target function at the positions of the entries."""
        raise NotImplementedError

    @classmethod
    def axes(cls, name: str) -> list[np.ndarray]:
        """Return the positions of a table's entries in [0, 1], one array of the table's size for each axis."""
        return np.meshgrid(*(np.linspace(0, 1, n) for n in cls.SHAPES[name][:-1]), indexing="ij")

    def to_table(self) -> Table:
        """Return the table to store: the entries, clamped to their ranges, in single precision."""
        arrays = {name: np.clip(getattr(self, name).numpy(), *self.RANGES[name]) for name in self.SHAPES}
        stored = {name: StoredArray(values.astype(np.float32)) for name, values in arrays.items()}
        return Table("disney", stored, self.PRESET)

    def clamp_values(self, name: str, values: list) -> list:
        """Clamp values read from a table to its range, NaN included; bytes cannot leave the range."""
        if getattr(self, name).storage == "uint8":
            return values
        return [clamp(v, *self.RANGES[name]) for v in values]

    def encode(self, material, active=True) -> tuple:
        """Return the encoder's coordinates, each in [0, 1], of a material's roughness and anisotropy."""
        return (
            sum(self.encoder_roughness([warp_roughness(material.roughness)], active)),
            sum(self.encoder_anisotropic([material.anisotropic], active)),
        )

    @classmethod
    def targets(cls, m, wi, wo, uniform) -> dict[str, list]:
        """Return the exact values, name of a table → its channels.

        ``m`` are materials, ``wi`` and ``wo`` directions, ``uniform`` two arrays of uniform random numbers.
        """
        raise NotImplementedError

    def predict(self, m, wi, wo, uniform) -> dict[str, list]:
        """Return the values that the tables yield, in the form of :meth:`targets`."""
        raise NotImplementedError
