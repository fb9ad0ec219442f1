"""Training of task 4: arrays of a texture, trained for the values of its channels at every level of detail."""

import dataclasses
from collections.abc import Mapping

import drjit as dr
import numpy as np

from ...arrays import lookup
from ...arrays.indirection import aligned_copy, unfolded
from ...arrays.tables import Table
from ...fitting.task import FitRequest, FitResult
from ...maps.layout import Layout
from ...maps.model import MapsProblem, fit_maps, strata
from ...maps.pyramid import Pyramid, decibel, mean_square
from ...maps.source import Source
from . import TextureSettings, arrays
from .arrays import PaperBudget, TextureBudget
from .compressed import CompressedTexture, PaperNet, footprint_level, footprints, to_table


def source_layout(source: Source, recipe: TextureSettings) -> Layout:
    """Return the layout of ``source`` by a recipe."""
    return Layout.from_source(source, recipe.once, None if recipe.normals else False, filtered=True)


def shares(levels: int) -> np.ndarray:
    """Return the share of samples on each level: one half, one quarter, …, but at least 0.02 / ``levels``."""
    halves = np.maximum(0.5 ** np.arange(1, levels + 1), 0.02 / levels)
    return halves / halves.sum()


class TextureProblem(MapsProblem):
    """Training problem of a texture: ``net`` (:mod:`.compressed`) against the reference ``pyramid``.

    ``weights`` are factors of the squared errors of maps, by name.
    """

    tolerance = 0.02

    def __init__(
        self, net, pyramid: Pyramid, recipe: TextureSettings, digest: str = "",
        weights: Mapping[str, float] | None = None,
    ):  # fmt: skip
        factors = {name: weight**0.5 for name, weight in (weights or {}).items()}
        super().__init__(net, pyramid.layout, recipe, pyramid.types, factors)
        self.pyramid = pyramid
        self.sizes = [level.shape[:2] for level in pyramid.values]
        self.starts = np.cumsum([0] + [rows * columns for rows, columns in self.sizes])
        self.identity = {"source": digest, **recipe.further, **self.form(net)}
        self.identity |= {"weights": {k: round(w, 6) for k, w in weights.items()}} if weights else {}

    @staticmethod
    def form(net) -> dict:
        """Return what identifies the arrays to train, as JSON."""
        return {"structure": dataclasses.asdict(net.structure), "border": list(net.border)}

    def _stratum(self, size: int) -> tuple:
        """Return the stratum of each of ``size`` samples, as arrays of whole numbers.

        Level of detail; first texel, and number of texels, that the sample may be in; columns and rows of the level;
        index of the level's first texel among those of all levels.
        """
        if size not in self._strata:
            share = shares(len(self.sizes)) if self.recipe.samples == "levels" else np.array([1.0])
            counts = np.floor(share * size).astype(np.int64)
            counts[0] += size - counts.sum()
            parts = []
            for level, count in enumerate(counts):
                rows, columns = self.sizes[level]
                ones, start = np.ones(count, np.int64), int(self.starts[level])
                parts.append((level * ones, *strata(rows * columns, count), columns * ones, rows * ones, start * ones))
            merged = (np.concatenate(part).astype(np.uint32) for part in zip(*parts, strict=True))
            self._strata = {size: tuple(self.types.UInt32(aligned_copy(part)) for part in merged)}
            dr.eval(self._strata)
        return self._strata[size]

    def batch(self, rng, size: int):
        Float, UInt32 = self.types.Float, self.types.UInt32
        level, first, count, columns, rows, start = self._stratum(size)
        index = first + dr.minimum(UInt32(rng.random(Float, size) * Float(count)), count - 1)
        # Lanes of a packet beyond the last sample hold zeros, and an integer division by zero ends the process
        columns, rows = dr.maximum(columns, 1), dr.maximum(rows, 1)
        x, y = Float(index % columns) + 0.5, Float(index // columns) + 0.5
        if self.recipe.samples != "levels":
            x, y = x + rng.random(Float, size) - 0.5, y + rng.random(Float, size) - 0.5
            layout, samples = self.layout, self.recipe.samples
            base = max(layout.height, layout.width)
            footprint = footprints(1 - rng.random(Float, size), samples, base)  # uniform in (0, 1]
            level = footprint_level(footprint, len(self.sizes))
            u, v = x / layout.width, y / layout.height
            return [u, v, level, footprint], self.by_map(self.pyramid.filtered(u, v, level))
        level = Float(level)
        if not self.jittered:
            target = self.pyramid.texels(start + index)
            return [x / Float(columns), y / Float(rows), level, None], self.by_map(target)
        x, y = x + rng.random(Float, size) - 0.5, y + rng.random(Float, size) - 0.5
        level = lookup.clamp(level + rng.random(Float, size) - 0.5, 0.0, float(len(self.sizes) - 1))
        u, v = x / Float(columns), y / Float(rows)
        return [u, v, level, None], self.by_map(self.pyramid.filtered(u, v, level))

    def predict(self, net, inputs) -> dict[str, list]:
        return self.read(self.seen(net), inputs)

    def seen(self, net):
        """Return the folded arrays as training reads them, rounded if the recipe says so."""
        return rounded(net) if self.recipe.rounded else net

    def read(self, net, inputs) -> dict[str, list]:
        """Return the outputs of arrays (:meth:`seen`) for the inputs of a batch, by map."""
        u, v, level, footprint = inputs
        if isinstance(net, PaperNet) and footprint is not None:
            return self.by_map(net.at_footprint(u, v, footprint))
        return self.by_map(net.filtered(u, v, level))

    def measure(self, net) -> dict[str, float]:
        """Return the PSNR of the stored channels at the centres of at most 2¹⁶ texels a level, entries rounded."""
        types, decibels = self.types, []
        net = rounded(unfolded(net))
        with dr.suspend_grad():
            for level, (rows, columns) in enumerate(self.sizes):
                texels = rows * columns
                count = min(texels, 2**16)
                index = np.random.default_rng(level).choice(texels, count, replace=False) if count < texels else None
                index = types.UInt32(aligned_copy(np.arange(texels) if index is None else index, np.uint32))
                # Opaque, so that one kernel reads all levels
                start, rows, columns = (dr.opaque(types.UInt32, int(n)) for n in (self.starts[level], rows, columns))
                u = (types.Float(index % columns) + 0.5) / types.Float(columns)
                v = (types.Float(index // columns) + 0.5) / types.Float(rows)
                actual = net.filtered(u, v, dr.opaque(types.Float, level, count))
                expected = self.pyramid.texels(index + start)
                decibels.append(decibel(mean_square(actual, expected)))
        return {"psnr_db": decibels[0], "psnr_worst_db": min(decibels)}


def build_problem(
    source: Source,
    size: TextureBudget | PaperBudget,
    recipe: TextureSettings,
    pyramid: Pyramid,
    weights: Mapping[str, float] | None = None,
) -> TextureProblem:
    """Return the problem of training ``source`` at a size by a recipe, with initial arrays.

    ``weights`` are factors of the squared errors of maps, by name; initial arrays know them, too.
    """  # fmt: skip
    if isinstance(size, PaperBudget):
        net = arrays.from_ramps(pyramid.layout, size, pyramid.border, pyramid.levels)
    else:
        net = arrays.from_components(pyramid.values, size, pyramid.border, channel_weights(pyramid.layout, weights))
    net = net.changed(lambda array, bits: array.alloc(pyramid.types.TensorXf))
    return TextureProblem(net, pyramid, recipe, source.digest, weights)


def channel_weights(layout: Layout, weights: Mapping[str, float] | None) -> np.ndarray | None:
    """Return the weights of stored channels, ``(channels,)``, from those of maps by name."""
    if weights is None:
        return None
    result = np.ones(layout.stored)
    for name, channels in layout.channels_by_map().items():
        result[list(channels)] = weights[name]
    return result


def fit_texture(
    source: Source,
    size: TextureBudget | PaperBudget | None,
    recipe: TextureSettings,
    request: FitRequest,
    pyramid: Pyramid,
    level_bias: float = 0.0,
    title: str | None = None,
) -> tuple[Table, FitResult]:
    """Train the arrays of ``source`` and return the table, with its errors, and the record of the training.

    ``size`` is ``None`` for a texture of one colour, which needs no arrays. ``request`` holds the Dr.Jit types, the
    time and the checkpoint; its settings are replaced by those of the ``recipe``. ``level_bias`` is stored in the file;
    levels are trained as they are stored. ``title`` stands before the progress bar. Errors are those of
    :meth:`.CompressedTexture.measure`.
    """
    request = dataclasses.replace(request, settings=recipe)
    problem = None if size is None else build_problem(source, size, recipe, pyramid)

    def stored() -> CompressedTexture:
        return CompressedTexture(pyramid.layout, problem and stored_form(problem.net), (problem and level_bias) or 0.0)

    return fit_maps(request, source, problem, stored, to_table, CompressedTexture.from_table, title)


def stored_form(net):
    """Return the arrays as they are stored, each entry rounded to its bits."""
    return net.changed(lambda array, bits: array.quantised(bits))


def rounded(net):
    """Return a copy of ``net`` whose reads round each entry (:meth:`.DifferentiableArray.rounded`)."""
    return net.changed(lambda array, bits: array.rounded(bits))
