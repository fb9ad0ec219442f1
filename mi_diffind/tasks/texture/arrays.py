"""
The arrays of task 4, untrained: the paper's start from ramps and a constant for each kind of map, ours from the
principal components of the texture's levels, so that at step 0 they are smaller pictures of fewer channels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...indirection import DifferentiableArray
from ...maps.layout import Layout
from .nets import Layer, LayeredForm, LayeredNet, PaperForm, PaperNet
from .sizing import Components, PaperSize, Size, enlarged

#: Of the differences of two levels, by bits of an entry (8: and more): the share that lies within its range.
WITHIN = {1: 0.7, 2: 0.97, 3: 0.99, 4: 0.998, 5: 0.998, 6: 0.998, 7: 0.998, 8: 0.998}

#: The smallest range, lest a flat component be held for good.
SMALLEST = 0.02


def from_ramps(layout: Layout, size: PaperSize, border: tuple[str, str], levels: int, axis: str) -> PaperNet:
    """The supplement's initial values; not allocated."""
    primary0 = DifferentiableArray((size.rows, size.columns), 3, "ramp", fold=True, border=border)
    primary1 = DifferentiableArray((4 * size.lods,), 1, "ramp", fold=True)
    shape = (size.lods, *[size.cascaded] * 3)
    cascaded = DifferentiableArray(shape, layout.stored, "constant", layout.initial, fold=True)
    return PaperNet(primary0, primary1, cascaded, PaperForm(levels, axis))


def from_components(values: Sequence[np.ndarray], size: Size, border: tuple[str, str]) -> LayeredNet:
    """
    Initial values from the levels ``values`` of a texture, each ``(height, width, k)`` in [0, 1]; not allocated. From
    the coarsest fine array on each holds the difference between the components of its level and what the coarser ones
    say of them.
    """
    found = Components.of(values[0], size.dims)
    pointers = [found.pointers(level) for level in values]
    # A texture has no more components than channels
    pointers = [np.pad(p, [(0, 0), (0, 0), (0, size.dims - found.dims)], constant_values=0.5) for p in pointers]
    reached, level = pointers[size.skip], size.skip
    layers, fine = [], []
    for i in reversed(range(len(size.fine))):
        wanted = size.fine[i]
        rows, columns = values[wanted.level].shape[:2]
        while level > wanted.level:
            level -= 1
            reached = enlarged(reached, *values[level].shape[:2], border)
        rest = (pointers[level] - reached)[..., : wanted.channels]
        within = np.quantile(np.abs(rest).reshape(-1, wanted.channels), WITHIN[wanted.bits], axis=0)
        scale = np.maximum(2 * within, SMALLEST)
        until = (size.fine[i + 1].level if i + 1 < len(size.fine) else size.skip) - 1
        layer = Layer(level, until, wanted.bits, tuple(float(f"{s:.6g}") for s in scale))
        entries = np.clip(rest / np.array(layer.scale) + layer.zero, 0, 1).astype(np.float32)
        layers.insert(0, layer)
        fine.insert(0, DifferentiableArray((rows, columns), wanted.channels, entries, fold=True, border=border))
        reached = reached.copy()
        reached[..., : wanted.channels] += ((entries - layer.zero) * layer.scale).astype(np.float32)
    coarse = np.concatenate([p.reshape(-1, size.dims) for p in pointers[size.skip :]])
    coarse = DifferentiableArray((len(coarse),), size.dims, np.clip(coarse, 1e-3, 1 - 1e-3), fold=True)
    shape = (size.knots,) * (size.knots > 1) + (size.cascaded,) * size.dims
    back = found.back(size.cascaded)
    back = back.reshape(*back.shape[:-1], *[1] * (size.dims - found.dims), back.shape[-1])
    cascaded = np.broadcast_to(back, (*shape, size.channels)).astype(np.float32)
    cascaded = DifferentiableArray(shape, size.channels, cascaded, fold=True)
    form = LayeredForm(size.height, size.width, tuple(layers), size.skip, size.bits)
    return LayeredNet(fine, coarse, cascaded, form, border)
