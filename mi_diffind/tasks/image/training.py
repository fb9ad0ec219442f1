"""Training of images: samples, targets and the stored result.

A step draws a texel of the source for each sample, stratified. The target is the texel at its centre, or the bilinear
value at a jittered place within it. The supplement's recipe jitters all samples, which trains a bilinearly smoothed
picture. Half of the steps at centres and half jittered is better both at texels and between them.
"""

import dataclasses
import math

import drjit as dr
import numpy as np

from ...arrays import lookup
from ...arrays.indirection import aligned, aligned_copy, rounded, stored_form
from ...arrays.pages import most_entries, page_counts
from ...arrays.tables import Table
from ...fitting.task import FitRequest, FitResult
from ...maps.layout import Layout, choose_borders, gain_of_pages, smoothness
from ...maps.model import MapsProblem, fit_maps, strata
from ...maps.pyramid import decibel, mean_square, padded_texels
from ...maps.source import Source
from . import PAGED, STRUCTURES, ImageSettings, arrays
from .arrays import CompressedImage, ImageBudget, to_table

#: Least smoothness, in dB, of an image for one primary (:func:`~mi_diffind.maps.layout.smoothness`).
SMOOTH_DB = 28.0

#: Least gain of pages, in dB before training.
GAIN_DB = 0.5

#: Least PSNR of one primary of pages for a rough image, in dB before training.
FINE_DB = 29.0

#: Least entries a page.
ENTRIES = 3

_structures: dict[tuple, str] = {}  # structures of "auto" by source and recipe: the choice takes a second


def choose_structure(source: Source, recipe: ImageSettings, nbytes: float | None = None) -> str:
    """Return the structure of a recipe; ``"auto"`` is chosen by the image and ``nbytes`` (default: a twelfth)."""
    if recipe.structure != "auto":
        return recipe.structure
    nbytes = source.nbytes / 12 if nbytes is None else nbytes
    key = (source.digest, recipe.once, recipe.normals, recipe.components, recipe.dims, nbytes)
    if key not in _structures:
        _structures[key] = _suitable(source_layout(source, recipe).encode(source), recipe, nbytes)
    return _structures[key]


def pointer_dims(recipe: ImageSettings, structure: str, stored: int) -> int:
    """Return the dimensions of the cascaded array for ``stored`` channels.

    A single primary of pages has at most ``stored`` (at least 2): more entries gain more than more coordinates.
    """
    single = structure in PAGED and STRUCTURES[structure][1] is None
    return min(recipe.dims, max(stored, 2)) if single else recipe.dims


def _suitable(values: np.ndarray, recipe: ImageSettings, nbytes: float) -> str:
    """Return the structure for an image, ``(height, width, k)``, in ``nbytes`` bytes."""
    height, width, k = values.shape
    smooth = recipe.dims < 3 or smoothness(values) >= SMOOTH_DB
    if recipe.components and k:
        # More channels than dimensions need more precise pointers
        pages = "pages of 6 bits" if k > recipe.dims else "pages of 5 bits"
        dims = pointer_dims(recipe, pages, k)
        side = arrays.cascaded_side(nbytes, k, dims)
        size = arrays.fit_bytes(nbytes, k, height, width, side, dims, STRUCTURES[pages][0])
        fewest = ENTRIES * math.prod(page_counts((height, width)))
        entries = arrays.page_budget(size, values.shape)
        if fewest <= entries <= most_entries(2):
            gain, psnr = gain_of_pages(values, size.dims, entries, choose_borders(values))
            if gain >= GAIN_DB:
                return pages if smooth or psnr >= FINE_DB else "pages of 2 + 6 bits"
    return "6 bits" if smooth else "2 + 6 bits"


def source_layout(source: Source, recipe: ImageSettings) -> Layout:
    """Return the layout of ``source`` by a recipe."""
    return Layout.from_source(source, recipe.once, None if recipe.normals else False)


class ImageProblem(MapsProblem):
    """Training problem of an image.

    ``net`` maps (v, u) to the stored channels; ``bits`` are those of the entries of each primary; ``values`` are the
    stored channels, ``(height, width, stored)``; ``border`` is that of the image along v and u.
    """

    def __init__(
        self, net, bits, layout: Layout, values: np.ndarray, border, recipe: ImageSettings, types, digest: str = ""
    ):
        super().__init__(net, layout, recipe, types, recipe.weights)
        self.bits, self.border = tuple(bits), border
        self.height, self.width, self.channels = values.shape
        self.texels = self.height * self.width
        stored = lookup.padded_channels(self.channels)
        padded = aligned((self.height, self.width, stored), np.float32)
        padded[..., : self.channels] = values
        padded[..., self.channels :] = 0
        self.values = types.TensorXf(padded)
        recorded = {name: value for name, value in recipe.further.items() if name != "weights" or value}
        self.identity = {"source": digest, **recorded}
        self.rounded = False

    def begin(self, step: int, share: float) -> str:
        """Start a step: decide whether entries are rounded and samples jittered. Returns a text that names both."""
        self.rounded = share >= 1 - self.recipe.rounded
        return f"rounded: {self.rounded}, {super().begin(step, share)}"

    def _texel(self, rng, size: int):
        """Return the index of a texel for each sample: one in each of ``size`` equal stretches of the image."""
        UInt32, Float = self.types.UInt32, self.types.Float
        if size % self.texels == 0:
            return dr.arange(UInt32, size) % self.texels
        if size not in self._strata:
            self._strata[size] = [UInt32(aligned_copy(part, np.uint32)) for part in strata(self.texels, size)]
        first, count = self._strata[size]
        return first + dr.minimum(UInt32(rng.random(Float, size) * Float(count)), count - 1)

    def batch(self, rng, size: int):
        Float = self.types.Float
        index = self._texel(rng, size)
        x, y = Float(index % self.width) + 0.5, Float(index // self.width) + 0.5
        if self.jittered:
            x, y = x + rng.random(Float, size) - 0.5, y + rng.random(Float, size) - 0.5
            target = self.target(y, x)
        else:
            target = self._texels(index)
        return [y / self.height, x / self.width], self.by_map(target)

    def _texels(self, index) -> list:
        """Return the stored channels of texels, given their index row by row."""
        stored = self.values.shape[-1]
        return padded_texels(self.types, self.values.array, stored, index)[: self.channels]

    def target(self, y, x) -> list:
        """Return the stored channels at a place in texels from the corner of the image, bilinear as in ``bitmap``."""
        UInt32, Int32 = self.types.UInt32, self.types.Int32
        corners = []
        for position, n, border in ((y, self.height, self.border[0]), (x, self.width, self.border[1])):
            lower = dr.floor(position - 0.5)
            weight = position - 0.5 - lower
            i = Int32(lower)
            if border == "repeat":
                both = [dr.select(i < 0, i + n, i), dr.select(i + 1 >= n, i + 1 - n, i + 1)]
            else:
                both = [dr.clip(i, 0, n - 1), dr.clip(i + 1, 0, n - 1)]
            corners.append([(UInt32(both[0]), 1 - weight), (UInt32(both[1]), weight)])
        rows, columns = corners
        return lookup.weighted_sum((a * b, self._texels(row * self.width + x)) for row, a in rows for x, b in columns)

    def predict(self, net, inputs) -> dict[str, list]:
        return self.by_map((rounded(net, self.bits) if self.rounded else net)(inputs))

    def measure(self, net) -> dict[str, float]:
        """Return the PSNR of the stored channels, with rounded entries, at the centres of at most 2¹⁸ texels."""
        rng = dr.rng(seed=dr.opaque(self.types.UInt64, 2023))
        size = min(self.texels, 2**18)
        with dr.suspend_grad():
            index = self._texel(rng, size)
            x, y = self.types.Float(index % self.width) + 0.5, self.types.Float(index // self.width) + 0.5
            outputs = rounded(net, self.bits)([y / self.height, x / self.width])
            return {"psnr_db": decibel(mean_square(outputs, self._texels(index)))}


def build_problem(
    source: Source, size: ImageBudget, recipe: ImageSettings, types, layout: Layout | None = None, border=None
) -> ImageProblem:
    """Return the problem of training ``source`` at a size by a recipe, with initial arrays.

    Raises ``ValueError`` for pages without components, which their resolution follows.
    """
    if size.paged and not recipe.components:
        raise ValueError("size: found pages, which need a recipe with components")
    layout = layout or source_layout(source, recipe)
    values = layout.encode(source)
    border = border or choose_borders(values)
    if recipe.components:
        weights = [recipe.weights.get(name, 1.0) for name in layout.groups]
        net = arrays.from_components(values, size, border, weights)
    else:
        net = arrays.from_ramp(layout, size, border)
    bits = [bits for *_, bits in size.primaries]
    return ImageProblem(net.alloc(types.TensorXf), bits, layout, values, border, recipe, types, source.digest)


def fit_image(
    source: Source,
    size: ImageBudget | None,
    recipe: ImageSettings,
    request: FitRequest,
    border: tuple[str, str] | None = None,
    title: str | None = None,
) -> tuple[Table, FitResult]:
    """Train the arrays of ``source`` and return the table, with its errors, and the record of the training.

    ``size`` is ``None`` for an image of one colour, which needs no arrays. ``border`` along v and u is by default
    :func:`.layout.choose_borders`. ``request`` holds the Dr.Jit types, the time and the checkpoint; its settings are
    replaced by those of the ``recipe``. Errors are those of :meth:`.CompressedImage.measure`.
    """
    request, layout = dataclasses.replace(request, settings=recipe), source_layout(source, recipe)
    problem = build_problem(source, size, recipe, request.types, layout, border) if layout.stored else None
    more = {}
    if problem is not None:
        names = [n for n, s in STRUCTURES.items() if s == (size.bits, size.coarse) and size.paged == (n in PAGED)]
        names = [recipe.structure] if recipe.structure != "auto" else [*names, ""]
        more = {"ratio": size.ratio, "structure": names[0]}

    def stored() -> CompressedImage:
        return CompressedImage(layout, problem and stored_form(problem.net, problem.bits))

    return fit_maps(request, source, problem, stored, to_table, CompressedImage.from_table, title, **more)
