"""Filtered maps of a material as a hash grid and a network, in as many bytes as a filtered texture.

The hash grid encodes uv. Features of a grid level that is finer than the texels of the level of detail fade out over
one octave, and the level of detail is a further input of the network; without the fading, a network was 2 dB worse
after 400 steps. It is trained as our textures are: on the same pyramid, with the same samples and the same loss.

Sources: Müller et al., *Instant Neural Graphics Primitives with a Multiresolution Hash Encoding*, 2022; Barron et al.,
*Zip-NeRF: Anti-Aliased Grid-Based Neural Radiance Fields*, 2023, for features that fade with the footprint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import ModuleType

import drjit as dr

from ...arrays.lookup import clamp
from ...fitting.settings import FitSettings
from ...maps.compressed import FilteredMaps, decibel
from ...maps.layout import Layout
from ...maps.pyramid import Pyramid, level_sizes
from ...maps.source import Source
from ...tasks.texture import PRESETS
from ...tasks.texture.training import TextureProblem
from ..baselines import image_networks
from ..baselines.networks import Network

#: Steps of the first training, and of the longest as a multiple.
STEPS, LONGEST = 1000, 16

#: Samples of a measurement during training.
MEASURED = 2**17


def settings(steps: int) -> FitSettings:
    """Return the settings of a training of ``steps``."""
    return FitSettings(steps=steps, batch=2**14, lr=1e-2, schedule="cosine", loss="mse", seed=1)


class FilteredNetwork(Network):
    """Network of (u, v, level of detail), all in [0, 1], from a hash grid of uv of ``size`` texels at level 0."""

    def __init__(self, size: int, levels: int, grid: dict, outputs: int):
        super().__init__(2, image_networks.WIDTH, image_networks.LAYERS, grid, outputs=outputs, direct=1)
        self.size, self.levels = size, levels

    def features(self, x: list) -> list:
        features, level = super().features(x), x[2] * (self.levels - 1)
        count = self.grid["n_features_per_level"]
        for i in range(self.grid["n_levels"]):
            side = self.grid["base_resolution"] * self.grid["per_level_scale"] ** i
            weight = clamp(1 + math.log2(self.size / side) - level, 0.0, 1.0)
            for k in range(i * count, (i + 1) * count):
                features[k] = features[k] * weight
        return features


def network(source: Source, layout: Layout, nbytes: float) -> FilteredNetwork:
    """Return the largest network of ``nbytes``, 2 bytes a parameter, not yet allocated.

    Raises ``ValueError`` if the bytes are too few for a hash grid and a network.
    """
    grid, sizes = image_networks.hash_grid(source, nbytes, layout.stored, 1), level_sizes(source.height, source.width)
    return FilteredNetwork(max(sizes[0]), len(sizes), grid, layout.stored)


class NetworkMaps(FilteredMaps):
    """Maps that a network holds; if ``cooperative``, the plugin ``mipmap`` can read them as it reads a pyramid.

    Without ``cooperative``, reads have derivatives, but cannot be part of the loops of a render.
    """

    def __init__(
        self, net: Network, layout: Layout, types: ModuleType, border: Sequence[str], cooperative: bool = False
    ):
        self.net, self.layout, self.types, self.border = net, layout, types, tuple(border)
        self.reading = net.cooperative() if cooperative else net
        self.levels = len(level_sizes(layout.height, layout.width))

    @property
    def arrays(self) -> dict:
        """Dr.Jit arrays of a read, by name."""
        return {key: self.net[key] for key in self.net}

    @property
    def memory_nbytes(self) -> int:
        """Bytes of all parameters in single precision."""
        return self.net.nbytes

    def stored(self, u, v, active=True) -> list:
        return self.filtered(u, v, type(u)(0), active)

    def filtered(self, u, v, level, active=True) -> list:
        place = [
            x - dr.floor(x) if border == "repeat" else clamp(x, 0.0, 1.0)
            for x, border in ((u, self.border[1]), (v, self.border[0]))
        ]
        return self.reading([*place, self.clamped(level, type(u)) / (self.levels - 1)])

    def interpolated(self, u, v, level, active=True, whole: bool = False) -> list:
        """Return :meth:`filtered`."""
        return self.filtered(u, v, level, active)

    def interpolated_texels(self, index, active=True) -> list:
        """Return the stored channels at texel centres of level 0, given their ``index``, row by row."""
        Float, width = self.types.Float, self.layout.width
        u, v = (Float(index % width) + 0.5) / width, (Float(index // width) + 0.5) / self.layout.height
        return self.stored(u, v, active)

    def encoded(self, values: list) -> list:
        """Return ``values``: a network returns stored channels."""
        return values

    def is_linear(self, name: str) -> bool:
        """Return False: sRGB values are interpolated as they are stored."""
        return False


class TextureNetworkProblem(TextureProblem):
    """Training problem of a network on a pyramid, with the samples of our textures."""

    tolerance = 0.0

    def __init__(self, net: FilteredNetwork, pyramid: Pyramid, digest: str):
        types = pyramid.types
        net = net.alloc(types.TensorXf, rng=dr.rng(seed=dr.opaque(types.UInt64, 1)))
        super().__init__(net, pyramid, PRESETS["ours"], digest)

    @staticmethod
    def form(net) -> dict:
        return {"network": net.grid, "width": net.width, "layers": net.layers}

    def maps(self, net) -> NetworkMaps:
        """Return the maps that a network holds."""
        return NetworkMaps(net, self.pyramid.layout, self.types, self.pyramid.border)

    def predict(self, net, inputs) -> dict[str, list]:
        u, v, level, _ = inputs
        return self._grouped(self.maps(net).filtered(u, v, level))

    def measure(self, net) -> dict[str, float]:
        """Return the PSNR of the stored channels at held-out samples between texels and levels."""
        jittered, self.jittered = self.jittered, True
        with dr.suspend_grad():
            inputs, targets = self.batch(dr.rng(seed=dr.opaque(self.types.UInt64, 2023)), MEASURED)
            outputs = self.predict(net, inputs)
            pairs = [pair for name in targets for pair in zip(outputs[name], targets[name], strict=True)]
            squares = [dr.square(a - b) for a, b in pairs]
            dr.eval(squares)
        self.jittered = jittered
        return {"psnr_db": decibel(sum(float(dr.mean(s)[0]) for s in squares) / len(squares))}
