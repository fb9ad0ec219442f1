"""Networks of ``drjit.nn`` that tables are compared with, alone or after a hash grid.

Here are the networks in place of tables of textures (hash grids of uv). That of distance fields is in
:mod:`.distance_fields`.

Sources: Müller et al., *Instant Neural Graphics Primitives with a Multiresolution Hash Encoding*, 2022; Barron et al.,
*Zip-NeRF: Anti-Aliased Grid-Based Neural Radiance Fields*, 2023, for features that fade with the footprint.
"""

from __future__ import annotations

import copy
import math

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays.budget import Budget, BudgetError
from ...arrays.lookup import clamp
from ...core.compat import backend_module
from ...maps.layout import Layout
from ...maps.pyramid import FilteredMaps, Pyramid, decibel, mean_square
from ...measure.clock import Operations
from ...tasks.texture import PRESETS
from ...tasks.texture.training import TextureProblem

#: Hidden units of a layer of a network after a hash grid.
WIDTH = 32

#: Hidden layers of a network after a hash grid.
LAYERS = 2

#: Levels of a hash grid.
LEVELS = 8

#: Numbers at an entry of a level.
FEATURES = 2

#: Resolution of the coarsest level.
COARSEST = 8

#: Samples of a measurement during training.
MEASURED = 2**17


class Network(nn.Module):
    """Multilayer perceptron from ``inputs`` coordinates to as many numbers as ``outputs``.

    There are ``layers`` hidden layers of ``width`` units, by default leaky rectified. With ``grid``, the options of
    ``nn.HashGridEncoding``, a hash grid encodes the coordinates; ``direct`` further coordinates bypass it. A call with
    a list of coordinates returns a list of arrays. As allocated, the network computes with tensors, the faster form to
    train; :meth:`cooperative` returns it in cooperative vectors.
    """

    DRJIT_STRUCT = {"entries": object, "mlp": nn.Module}  # noqa: RUF012

    def __init__(
        self, inputs: int = 2, width: int = 16, layers: int = 2, grid: dict | None = None, outputs: int = 1,
        direct: int = 0, activation: type[nn.Module] = nn.LeakyReLU,
    ):  # fmt: skip
        self.inputs, self.width, self.layers, self.grid = inputs, width, layers, grid
        self.outputs, self.direct, self.activation = outputs, direct, activation
        self.entries = self.mlp = self.encoding = None
        self.is_cooperative = False

    def _alloc(self, dtype, size=-1, rng=None):
        result, size = copy.copy(self), self.inputs
        if self.grid:
            Float = backend_module(dtype).Float
            result.encoding = nn.HashGridEncoding(Float, self.inputs, rng=rng, **self.grid)
            result.entries = dtype(result.encoding.params)  # the encoding is no module: an optimiser sees these
            size = self.grid["n_levels"] * self.grid["n_features_per_level"] + self.direct
        hidden = []
        for _ in range(self.layers):
            hidden += [nn.Linear(-1, self.width), self.activation()]
        result.mlp = nn.Sequential(*hidden, nn.Linear(self.width, self.outputs)).alloc(dtype, size, rng)
        return result, self.outputs

    def __call__(self, x, active=True):
        n = max(dr.width(v) for v in x)
        if self.encoding is not None:
            self.encoding.data = self.entries.array
            x = [*self.features(list(x), active), *x[self.inputs :]]
        if self.is_cooperative:
            return list(self.mlp(nn.CoopVec(*x)))
        Tensor = dr.tensor_t(type(x[0]))
        rows = [Tensor(v, (1, n)) if dr.width(v) == n else dr.full(Tensor, v[0], (1, n)) for v in x]
        y = self.mlp(dr.concat(rows, axis=0))
        return [y.array] if y.shape[0] == 1 else [y[i, :].array for i in range(y.shape[0])]

    def features(self, x: list, active) -> list:
        """Return the features that the hash grid gives to the network at coordinates ``x``."""
        return list(self.encoding(x[: self.inputs], active))

    def cooperative(self) -> Network:
        """Return a copy in cooperative vectors, for reading."""
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


def hash_grid(dimensions: int, nbytes: float, finest: float, outputs: int, direct: int = 0) -> dict:
    """Return the options of the largest hash grid with which a network takes ``nbytes``, 2 bytes a parameter.

    ``finest`` is the resolution of the last level. The network has :data:`LAYERS` hidden layers of :data:`WIDTH` units,
    ``outputs``, and ``direct`` inputs beside the features of the grid. Raises ``ValueError`` if the bytes are too few.
    """
    scale = (max(2 * COARSEST, finest) / COARSEST) ** (1 / (LEVELS - 1))
    weights = WIDTH * (FEATURES * LEVELS + direct + (LAYERS - 1) * WIDTH + outputs) + LAYERS * WIDTH + outputs
    resolutions = [math.ceil(COARSEST * scale**level) for level in range(LEVELS)]
    sizes = [int(2**power) // 16 * 16 for power in np.arange(6, 24, 0.05)]

    def grid_bytes(size: int) -> int:
        return 2 * (FEATURES * sum(min(size, (n + 1) ** dimensions) for n in resolutions) + weights)

    try:
        largest = Budget(nbytes).largest(grid_bytes, sizes)
    except BudgetError:
        raise ValueError(f"{nbytes:,.0f} bytes are too few for a hash grid of {LEVELS} levels") from None
    return {"n_levels": LEVELS, "n_features_per_level": FEATURES, "hashmap_size": largest,
            "base_resolution": COARSEST, "per_level_scale": scale, "align_corners": True,
            "init_scale": 1e-4}  # fmt: skip


# -- Filtered textures -------------------------------------------------------------------------------------------------


class FilteredNetwork(Network):
    """Network of (u, v, level of detail), all in [0, 1], from a hash grid of uv of ``size`` texels at level 0.

    Features of a grid level that is finer than the texels of the level of detail fade out over one octave; without the
    fading, a network was 2 dB worse after 400 steps.
    """

    def __init__(self, size: int, levels: int, grid: dict, outputs: int):
        super().__init__(2, WIDTH, LAYERS, grid, outputs=outputs, direct=1)
        self.size, self.levels = size, levels

    def features(self, x: list, active) -> list:
        features, level = super().features(x, active), x[2] * (self.levels - 1)
        count = self.grid["n_features_per_level"]
        for i in range(self.grid["n_levels"]):
            side = self.grid["base_resolution"] * self.grid["per_level_scale"] ** i
            weight = clamp(1 + math.log2(self.size / side) - level, 0.0, 1.0)
            for k in range(i * count, (i + 1) * count):
                features[k] = features[k] * weight
        return features


def texture_network(layout: Layout, nbytes: float, levels: int) -> FilteredNetwork:
    """Return the largest network of ``nbytes`` for a number of levels of detail, not yet allocated.

    An image has one level. Raises as :func:`hash_grid`.
    """
    size = max(layout.height, layout.width)
    return FilteredNetwork(size, levels, hash_grid(2, nbytes, size, layout.stored, 1), layout.stored)


class NetworkMaps(FilteredMaps):
    """Maps of a material that a network holds, with the layout and the border of a ``pyramid``."""

    def __init__(self, net: FilteredNetwork, pyramid: Pyramid):
        self.net, self.levels = net, net.levels
        self.layout, self.types, self.border = pyramid.layout, pyramid.types, pyramid.border

    def stored(self, u, v, active=True) -> list:
        return self.filtered(u, v, type(u)(0), active)

    def filtered(self, u, v, level, active=True) -> list:
        place = [
            x - dr.floor(x) if border == "repeat" else clamp(x, 0.0, 1.0)
            for x, border in ((u, self.border[1]), (v, self.border[0]))
        ]
        return self.net([*place, self.clamped(level, type(u)) / max(self.levels - 1, 1)])


class TextureNetworkProblem(TextureProblem):
    """Training problem of a network on the levels of a pyramid that it has, with the samples of our textures."""

    tolerance = 0.0

    def __init__(self, net: FilteredNetwork, pyramid: Pyramid, digest: str):
        types = pyramid.types
        net = net.alloc(types.TensorXf, rng=dr.rng(seed=dr.opaque(types.UInt64, 1)))
        super().__init__(net, pyramid, PRESETS["ours"], digest)
        self.sizes = self.sizes[: net.levels]

    @staticmethod
    def form(net) -> dict:
        return {"network": net.grid, "width": net.width, "layers": net.layers}

    def predict(self, net, inputs) -> dict[str, list]:
        u, v, level, _ = inputs
        return self.by_map(NetworkMaps(net, self.pyramid).filtered(u, v, level))

    def measure(self, net) -> dict[str, float]:
        """Return the PSNR of the stored channels at held-out samples between texels and levels."""
        jittered, self.jittered = self.jittered, True
        with dr.suspend_grad():
            inputs, targets = self.batch(dr.rng(seed=dr.opaque(self.types.UInt64, 2023)), MEASURED)
            outputs = self.predict(net, inputs)
            values, truth = ([v for name in targets for v in maps[name]] for maps in (outputs, targets))
            result = {"psnr_db": decibel(mean_square(values, truth))}
        self.jittered = jittered
        return result
