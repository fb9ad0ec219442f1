"""
The tables of the Disney BRDF: what both layouts have in common.

A layout (:class:`.paper.PaperArrays`, :class:`.factored.FactoredArrays`) is a ``drjit.nn`` module of named
:class:`~mi_diffind.indirection.DifferentiableArray` s. It says which sizes they have and which values may be in them,
and knows its training: targets, predictions, and where to start from. Its decoder reads it.
"""

from __future__ import annotations

import numpy as np
from drjit import nn

from ...indirection import DifferentiableArray
from ...lookup import clamp
from ...tables import StoredArray, Table
from .decoder import warp_roughness


class Arrays(nn.Module):
    """
    Base class of the layouts. ``Layout().alloc(TensorXf)`` starts from ramps and coarse samples of what the tables are
    to hold, :meth:`from_table` from trained ones. Parameters are called ``NAME.data``.
    """

    #: The preset that the layout stands for.
    PRESET = ""

    #: Sizes: name → shape with channels last.
    SHAPES: dict[str, tuple] = {}  # noqa: RUF012

    #: Values that entries may have; outside of them the BRDF could become negative or infinite.
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
        """Coarse samples of the truth at the entries' own positions: the approximate solution to start from."""
        raise NotImplementedError

    @classmethod
    def axes(cls, name: str) -> list[np.ndarray]:
        """The positions of a table's entries, one array of the table's size for each axis."""
        return np.meshgrid(*(np.linspace(0, 1, n) for n in cls.SHAPES[name][:-1]), indexing="ij")

    def to_table(self) -> Table:
        """The entries, limited to their ranges, in single precision."""
        arrays = {name: np.clip(getattr(self, name).numpy(), *self.RANGES[name]) for name in self.SHAPES}
        stored = {name: StoredArray(values.astype(np.float32)) for name, values in arrays.items()}
        return Table("disney", stored, self.PRESET)

    def bounded(self, name: str, values: list) -> list:
        """What was read from an array, limited to its range, NaN too: floats may have left it, bytes cannot."""
        if getattr(self, name).storage == "uint8":
            return values
        return [clamp(v, *self.RANGES[name]) for v in values]

    def encode(self, material, active=True) -> tuple:
        """Return the encoder's coordinates, each in [0, 1], of a material's roughness and anisotropy."""
        return (
            sum(self.encoder_roughness([warp_roughness(material.roughness)], active)),
            sum(self.encoder_anisotropic([material.anisotropic], active)),
        )

    # -- training ---------------------------------------------------------------------------------------------------

    @classmethod
    def targets(cls, m, wi, wo, uniform) -> dict[str, list]:
        """
        What the tables should give for these materials and directions, and two uniform numbers, straight from the
        formulas: name of a table → its channels.
        """
        raise NotImplementedError

    def predict(self, m, wi, wo, uniform) -> dict[str, list]:
        """What they give, in the form of the targets."""
        raise NotImplementedError
