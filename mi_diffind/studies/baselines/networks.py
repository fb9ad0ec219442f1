"""Networks of ``drjit.nn`` that tables are compared with: alone, after a hash grid, and in front of a table."""

from __future__ import annotations

import copy

import drjit as dr
from drjit import nn

from ...arrays.indirection import DifferentiableArray, fold
from ...core.compat import module_of
from ...measure.operations import Operations


class Network(nn.Module):
    """Multilayer perceptron from ``inputs`` coordinates to one number, or as many as ``outputs``.

    There are ``layers`` hidden layers of ``width`` leaky rectified units. With ``grid``, the options of
    ``nn.HashGridEncoding``, a hash grid encodes the coordinates; ``direct`` further coordinates bypass it. With
    ``table``, a number of entries on a side, the network's outputs point into a square
    :class:`.DifferentiableArray`, as the primary array of an indirection does. A call with a
    list of coordinates returns a list of arrays. As allocated, the network computes with tensors, the faster form to
    train; :meth:`cooperative` returns it in cooperative vectors.
    """

    DRJIT_STRUCT = {"entries": object, "mlp": nn.Module, "table": object}  # noqa: RUF012

    def __init__(
        self,
        inputs: int = 2,
        width: int = 16,
        layers: int = 2,
        grid: dict | None = None,
        table: int = 0,
        outputs: int = 1,
        direct: int = 0,
    ):
        self.inputs, self.width, self.layers, self.grid, self.table_size = inputs, width, layers, grid, table
        self.outputs, self.direct = 2 if table else outputs, direct
        self.entries = self.mlp = self.table = self.encoding = None
        self.is_cooperative = False

    def _alloc(self, dtype, size=-1, rng=None):
        result, size = copy.copy(self), self.inputs
        if self.grid:
            Float = module_of(dtype).Float
            result.encoding = nn.HashGridEncoding(Float, self.inputs, rng=rng, **self.grid)
            result.entries = dtype(result.encoding.params)
            size = self.grid["n_levels"] * self.grid["n_features_per_level"] + self.direct
        hidden = []
        for _ in range(self.layers):
            hidden += [nn.Linear(-1, self.width), nn.LeakyReLU()]
        result.mlp = nn.Sequential(*hidden, nn.Linear(self.width, self.outputs)).alloc(dtype, size, rng)
        if self.table_size:
            array = DifferentiableArray((self.table_size,) * 2, 1, "constant", 0.5)
            result.table = array.alloc(dtype)
        return result, self.outputs

    def __call__(self, x, active=True):
        n = max(dr.width(v) for v in x)
        if self.encoding is not None:
            self.encoding.data = self.entries.array
            x = [*self.features(list(x)), *x[self.inputs :]]
        if self.is_cooperative:
            y = list(self.mlp(nn.CoopVec(*x)))
        else:
            Tensor = dr.tensor_t(type(x[0]))
            rows = [Tensor(v, (1, n)) if dr.width(v) == n else dr.full(Tensor, v[0], (1, n)) for v in x]
            y = self.mlp(dr.concat(rows, axis=0))
            y = [y.array] if y.shape[0] == 1 else [y[i, :].array for i in range(y.shape[0])]
        return y if self.table is None else self.table([fold(v) for v in y], active)

    def features(self, x: list) -> list:
        """Return the features that the hash grid gives to the network at coordinates ``x``."""
        return list(self.encoding(x[: self.inputs]))

    def cooperative(self) -> Network:
        """Return a copy in cooperative vectors, for inference only."""
        result = copy.copy(self)
        result.mlp, result.is_cooperative = nn.pack(self.mlp, layout="inference"), True
        return result

    @property
    def parameters(self) -> int:
        """Numbers that are trained."""
        return sum(dr.width(self[key]) for key in self)

    @property
    def nbytes(self) -> int:
        """Bytes of all parameters in single precision."""
        return 4 * self.parameters

    def products(self) -> Operations:
        """Return the operations of the matrix products, which a kernel's code does not show: they are calls or loops.

        Each weight counts as one multiplication and one addition, each weight and bias as one read.
        """
        weights = [self.mlp[key] for key in self.mlp if key.endswith("weights")]
        macs = sum(dr.width(w) for w in weights)
        values = sum(dr.width(self.mlp[key]) for key in self.mlp)
        return Operations(add=macs, mul=macs, gathers=len(weights), bytes_gathered=4 * values, instructions=macs)
