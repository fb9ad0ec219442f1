"""Maps of a material as a hash grid and a network (``drjit.nn``), in as many bytes as an indirection.

Source: Müller et al., *Instant Neural Graphics Primitives with a Multiresolution Hash Encoding*, 2022.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...core.units import largest_fitting
from ...fitting.loop import Problem
from ...maps.source import Source
from .networks import Network

#: Width and hidden layers of the network, levels of the grid, features of a level, its coarsest resolution.
WIDTH, LAYERS, LEVELS, FEATURES, COARSEST = 32, 2, 8, 2, 8

#: Texels that are drawn for a measurement during training.
MEASURED = 2**16


def network(source: Source, nbytes: float) -> Network:
    """Return the largest network with hash grid of ``nbytes``, 2 bytes a parameter, not yet allocated.

    Raises ``ValueError`` if the bytes are too few for a hash grid and a network.
    """
    return Network(2, WIDTH, LAYERS, hash_grid(source, nbytes, source.channels), outputs=source.channels)


def hash_grid(source: Source, nbytes: float, outputs: int, direct: int = 0) -> dict:
    """Return the options of the largest hash grid with which a network takes ``nbytes``, as :func:`network` raises.

    The network has ``outputs``, and ``direct`` inputs beside the features of the grid.
    """
    finest = max(2 * COARSEST, max(source.width, source.height))
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    units = FEATURES * LEVELS + direct + (LAYERS - 1) * WIDTH + outputs
    weights = WIDTH * units + LAYERS * WIDTH + outputs
    resolutions = [math.ceil(COARSEST * scale**level) for level in range(LEVELS)]
    sizes = [int(2**power) // 16 * 16 for power in np.arange(6, 24, 0.05)]

    def fits(index: int) -> bool:
        entries = sum(min(sizes[index], (n + 1) ** 2) for n in resolutions)
        return 2 * (FEATURES * entries + weights) <= nbytes

    largest = largest_fitting(fits, -1, len(sizes))
    if largest < 0:
        raise ValueError(f"{nbytes:,.0f} bytes are too few for a hash grid of {LEVELS} levels")
    return {"n_levels": LEVELS, "n_features_per_level": FEATURES, "hashmap_size": sizes[largest],
            "base_resolution": COARSEST, "per_level_scale": scale, "align_corners": True,
            "init_scale": 1e-4}  # fmt: skip


class ImageNetworkProblem(Problem):
    """Training of a :class:`Network` on the texels of ``source``, all channels together, drawn at random."""

    def __init__(self, net: Network, types, source: Source):
        self.net, self.types, self.source = net.alloc(types.TensorXf, 2, dr.rng(seed=1)), types, source
        values = np.concatenate([np.clip(m.values, 0, 1) for m in source.maps], axis=-1).reshape(source.texels, -1)
        self.values = [types.Float(np.ascontiguousarray(channel, np.float32)) for channel in values.T]
        self.held = types.UInt32(np.random.default_rng(2).integers(0, source.texels, min(MEASURED, source.texels)))
        self.identity = {"source": source.digest, "network": net.grid, "seed": 1}

    def _at(self, index):
        x, y = index % self.source.width, index // self.source.width
        uv = [(self.types.Float(x) + 0.5) / self.source.width, (self.types.Float(y) + 0.5) / self.source.height]
        return uv, {"maps": [dr.gather(self.types.Float, channel, index) for channel in self.values]}

    def batch(self, rng, size: int):
        count = self.source.texels
        return self._at(dr.minimum(self.types.UInt32(rng.random(self.types.Float, size) * count), count - 1))

    def predict(self, net, inputs) -> dict[str, list]:
        return {"maps": net(inputs)}

    def measure(self, net) -> dict[str, float]:
        uv, targets = self._at(self.held)
        pairs = zip(net(uv), targets["maps"], strict=True)
        squares = [float(dr.mean(dr.square(dr.clip(value, 0, 1) - target))[0]) for value, target in pairs]
        return {"psnr_db": -10 * math.log10(max(sum(squares) / len(squares), 1e-12))}

    def decode(self, net) -> dict[str, np.ndarray]:
        """Return the maps that a network holds, ``(height, width, channels)`` in [0, 1], by name."""
        uv, _ = self._at(dr.arange(self.types.UInt32, self.source.texels))
        values = np.stack([np.clip(np.array(value), 0, 1) for value in net(uv)], axis=-1)
        values = values.reshape(self.source.height, self.source.width, -1)
        ends = np.cumsum([m.channels for m in self.source.maps])
        return {m.name: values[..., end - m.channels : end] for m, end in zip(self.source.maps, ends, strict=True)}
