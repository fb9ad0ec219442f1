"""Radiance fields: the interface of all of them, and those whose numbers lie on the nodes of a grid.

A field fills a box. Each point has a density σ per unit of length and, in each direction, a radiance (linear RGB, never
negative), so that a ray sees ``Σ T_i (1 − exp(−σ_i δ_i)) c_i`` (:mod:`.march`).

Colours with reflections have numbers of directions and an environment in the mirrored direction. The reflection of a
distant environment depends on the mirrored direction alone. So all nodes share one table of the environment, and each
has a normal, by which it finds its place there: an indirection of directions. With the interpolated numbers of a point,
the radiance in direction d is

    exp(a + b·d) + exp(s + E(d − 2 (d·n) n)).

Here a and b are those of :func:`colour_of` and s is the tint of the reflection (logarithms, for red, green and blue); n
is the unit normal. E is the logarithm of the environment, interpolated between a fine and a coarse table by the
sharpness of the point.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.lookup import as_words, pack_bits
from ...arrays.tables import StoredArray
from .nodes import HORIZON, EqualSteps, Nodes

#: Sides of the squares of the fine and the coarse table; each holds all directions, by an octahedron that is unfolded.
SIDES = (64, 16)

#: Entries of both tables.
ENTRIES = sum(side**2 for side in SIDES)

#: Columns of the numbers of a node: normal, tint and sharpness follow those of directions; the last is unused.
DIRECTIONS, NORMAL, TINT, SHARPNESS, COLUMNS = 12, slice(12, 15), slice(15, 18), 18, 20

#: Upper limit of the logarithm of a radiance.
BRIGHTEST = 12.0


def unfolded(d) -> tuple:
    """Return the place of the directions ``d`` on the unfolded octahedron: two coordinates in [−1, 1]."""
    inverse = dr.rcp(dr.abs(d.x) + dr.abs(d.y) + dr.abs(d.z))
    u, v = d.x * inverse, d.y * inverse
    below = d.z < 0
    return dr.select(below, dr.mulsign(1 - dr.abs(v), u), u), dr.select(below, dr.mulsign(1 - dr.abs(u), v), v)


def environment_at(types, entry, d, sharpness, active=True) -> list:
    """Return the logarithms of red, green and blue of the environment in the directions ``d``.

    ``entry(number, active)`` returns three numbers of an entry of the tables. ``sharpness`` in [0, 1] is the share of
    the fine one.
    """
    place, seen, first = unfolded(d), [types.Float(0)] * 3, 0
    for side, share in zip(SIDES, (sharpness, 1 - sharpness), strict=True):
        x, y = (dr.clip(dr.fma(0.5 * side, t, 0.5 * side - 0.5), -0.5, side - 0.5) for t in place)
        column, row = (types.Int32(dr.floor(dr.detach(t))) for t in (x, y))
        x, y = x - types.Float(column), y - types.Float(row)
        for j in (0, 1):
            for i in (0, 1):
                number = first + _number(column + i, row + j, side)
                weight = share * (x if i else 1 - x) * (y if j else 1 - y)
                seen = [dr.fma(weight, value, s) for value, s in zip(entry(number, active), seen, strict=True)]
        first += side**2
    return seen


def _number(column, row, side: int):
    """Return the number of an entry of a square; those beyond a border are the mirrored ones along the same border."""
    inner = [dr.clip(t, 0, side - 1) for t in (column, row)]
    column, row = (
        dr.select(other == kept, t, side - 1 - t)
        for t, other, kept in ((inner[0], row, inner[1]), (inner[1], column, inner[0]))
    )
    return dr.fma(row, side, column)


def radiance_of(types, numbers: list, d, entry=None, active=True) -> list:
    """Return the radiance [r, g, b] in direction ``d``, from the ``numbers`` of a point.

    With reflections, ``entry`` is that of :func:`environment_at`.
    """
    radiance = colour_of(numbers, d)
    if entry is None:
        return radiance
    return [a + b for a, b in zip(radiance, reflection(types, numbers, d, entry, active), strict=True)]


def reflection(types, numbers: list, d, entry, active=True) -> list:
    """Return the reflection [r, g, b] in direction ``d``, from the ``numbers`` of a point and the tables' ``entry``."""
    n = types.Array3f(*numbers[NORMAL])
    n *= dr.rsqrt(dr.squared_norm(n) + 1e-6)
    mirrored = dr.fma(-2 * dr.dot(d, n), n, d)
    sharpness = dr.rcp(1 + dr.exp(-dr.clip(numbers[SHARPNESS], -30, 30)))
    seen = environment_at(types, entry, mirrored, sharpness, active)
    return [dr.exp(dr.minimum(s + light, BRIGHTEST)) for s, light in zip(numbers[TINT], seen, strict=True)]


def add_reflections(colour: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the numbers of nodes, ``(n, 20)``, before reflections are trained, from those of directions."""
    numbers = np.zeros((len(colour), COLUMNS), np.float32)
    numbers[:, :DIRECTIONS] = colour
    numbers[:, NORMAL] = normals
    numbers[:, TINT] = -3.0  # as a logarithm
    return numbers


#: Optical depth of a voxel below which its density counts as zero.
FAINT = 2e-3


class VolumeField:
    """Radiance field in the box from ``lower`` to ``upper``: the base class.

    ``voxel`` is the side of a voxel. Rays take steps of length ``step``, half a voxel, and read no radiance where a
    step weighs less than ``least_weight``. ``arrays`` maps names to the tensors that can be differentiated. A field
    that is ``unbounded`` has surroundings (:class:`.nodes.Contraction`): rays are marched in the larger ``box``.
    """

    unbounded = False

    def __init__(self, types, lower, upper, voxel: float, arrays: dict):
        self.types = types
        self.lower, self.upper = tuple(map(float, lower)), tuple(map(float, upper))
        self.voxel, self.step = float(voxel), 0.5 * float(voxel)
        self.least_weight = 2e-7  # lighter steps read no radiance
        self.arrays = dict(arrays)
        # Opaque: fields of another size use the same kernels
        self.box = tuple(dr.opaque(types.Array3f, corner) for corner in (self.lower, self.upper))
        self.per_voxel = dr.opaque(types.Float, 1 / self.voxel)

    def with_arrays(self, arrays: dict) -> VolumeField:
        """Return a copy of the field with other tensors in ``arrays``."""
        result = copy.copy(self)
        result.arrays = dict(arrays)
        return result

    def for_training(self) -> VolumeField:
        """Return a copy with steps of a voxel, which reads the radiance of steps with a weight of at least 1e-3."""
        result = copy.copy(self)
        result.step, result.least_weight = self.voxel, 1e-3
        return result

    def density_at(self, p, active=True) -> tuple:
        """Return the density at the points ``p`` of the box, at least 0, and the data that :meth:`radiance_at` needs.

        The data are a list of arrays that carry no derivatives, such as the weights and numbers of nearby nodes.
        """
        raise NotImplementedError

    def radiance_at(self, point_data: list, p, d, active=True) -> list:
        """Return the radiance [r, g, b] that leaves the points ``p`` towards −``d``.

        ``d`` has unit length; ``point_data`` is what :meth:`density_at` returned for the same points.
        """
        raise NotImplementedError

    def free_distance(self, p, d, active=True):
        """Return a length from ``p`` along ``d`` that is certainly empty; 0 where the density has to be read."""
        return self.types.Float(0)

    def along(self, o, d) -> EqualSteps:
        """Return the distances of steps on the rays from ``o`` along ``d``."""
        return EqualSteps()


class NodeVolume(VolumeField):
    """Radiance field whose numbers lie on :class:`.nodes.Nodes`: the base class."""

    def __init__(self, nodes: Nodes, arrays: dict):
        self.nodes, contraction = nodes, nodes.contraction
        lower, upper = (nodes.lower, nodes.upper) if contraction is None else contraction.box(1)
        super().__init__(nodes.types, lower, upper, nodes.spacing, arrays)
        self.unbounded = contraction is not None
        if self.unbounded:
            self.box = tuple(dr.opaque(self.types.Array3f, corner) for corner in contraction.box(HORIZON))

    def without_surroundings(self) -> NodeVolume:
        """Return a copy of the field in the box from ``lower`` to ``upper`` alone."""
        result = copy.copy(self)
        result.unbounded = False
        result.box = tuple(dr.opaque(self.types.Array3f, corner) for corner in (self.lower, self.upper))
        return result

    def free_distance(self, p, d, active=True):
        return self.nodes.free_distance(p, d, active)

    def along(self, o, d) -> EqualSteps:
        return self.nodes.contraction.along(o, d) if self.unbounded else super().along(o, d)

    def interpolated_density(self, node_density, p, active, low=None, step=None) -> tuple:
        """Return what :meth:`density_at` does, from ``node_density(number, active)``, the raw density of a node.

        With ``low`` and ``step``, it is a level that stands for the raw density ``low`` + ``step`` · level. The data of
        a point are its eight weights and then its eight node numbers.
        """
        corners, active = self.nodes.corners(p, active)
        raw = self.types.Float(0)
        for weight, number in corners:
            raw = dr.fma(weight, node_density(number, active), raw)
        raw = raw if step is None else dr.fma(raw, step, low)
        contraction, per_voxel = self.nodes.contraction, self.per_voxel
        if contraction is not None:
            per_voxel = per_voxel / contraction.growth(p)
        density = dr.select(active, density_of(raw, per_voxel), 0)
        return density, [w for w, _ in corners] + [n for _, n in corners]


def density_of(raw, per_voxel):
    """Return the density σ of a raw number: softplus(raw) − :data:`FAINT` per voxel, never negative.

    ``per_voxel`` is one over the side of a voxel. A raw number below about −6 is exactly empty, 10 is opaque.
    """
    soft = dr.maximum(raw, 0) + dr.log(1 + dr.exp(-dr.abs(raw)))
    return dr.maximum(soft - FAINT, 0) * per_voxel


def colour_of(coefficients: list, d) -> list:
    """Return the radiance [r, g, b] in direction ``d``: exp(a + b·d), clamped at exp(:data:`BRIGHTEST`).

    ``coefficients`` begin with twelve numbers, a and b for each of red, green and blue. The exponent is linear in them.
    """
    radiance = []
    for c in range(3):
        a, x, y, z = coefficients[4 * c : 4 * c + 4]
        radiance.append(dr.exp(dr.minimum(dr.fma(x, d.x, dr.fma(y, d.y, dr.fma(z, d.z, a))), BRIGHTEST)))
    return radiance


class NodeField(NodeVolume):
    """Radiance field of numbers at nodes, interpolated trilinearly.

    ``density`` ``(n,)`` holds raw densities (:func:`density_of`), ``colour`` ``(m, 12)`` the coefficients of
    :func:`colour_of`; both are float tensors. ``palette_index`` ``(n,)``, uint32, names the row of ``colour`` of each
    node; without it, node i has row i. A pointer that is an index cannot be interpolated, so rows are read at the eight
    corners of a cell and blended there.

    With an ``environment`` ``(e, 4)``, of which the last column is unused, ``colour`` ``(m, 20)`` holds the numbers of
    :mod:`.volume_field`.
    """

    def __init__(self, nodes: Nodes, density, colour, palette_index=None, environment=None):
        shared = {} if environment is None else {"environment": environment}
        super().__init__(nodes, {"density": density, "colour": colour, **shared})
        self.palette_index = palette_index

    def density_at(self, p, active=True):
        Float, density = self.types.Float, self.arrays["density"].array
        return self.interpolated_density(lambda number, seen: dr.gather(Float, density, number, seen), p, active)

    def radiance_at(self, point_data, p, d, active=True):
        entry = None
        if "environment" in self.arrays:
            Array4f, environment = self.types.Array4f, self.arrays["environment"].array

            def entry(number, seen):
                return list(dr.gather(Array4f, environment, number, seen))[:3]

        return radiance_of(self.types, self.coefficients(point_data, active), d, entry, active)

    def coefficients(self, point_data, active) -> list:
        """Return the blended columns of ``colour`` at points."""
        rows, table = point_data[8:], self.arrays["colour"]
        if self.palette_index is not None:
            rows = [dr.gather(self.types.UInt32, self.palette_index, number, active) for number in rows]
        return blended(self.types, table.array, table.shape[1] // 4, point_data[:8], rows, active)


def blended(types, flat, packets: int, weights: list, rows: list, active) -> list:
    """Return the weighted sum of rows of ``flat``, ``(m, 4 · packets)``; four columns are read at once."""
    sums = [types.Float(0)] * (4 * packets)
    for weight, row in zip(weights, rows, strict=True):
        for j in range(packets):
            four = dr.gather(types.Array4f, flat, dr.fma(row, packets, j), active)
            for k in range(4):
                sums[4 * j + k] = dr.fma(weight, four[k], sums[4 * j + k])
    return sums


@dataclass
class PaletteArrays:
    """Numbers of the nodes of a compressed field; the first entry of ``levels`` and ``index`` stands for no node.

    ``levels`` ``(n,)``, uint8, have ``density_bits`` bits; a level ℓ stands for the raw density ``density_range[0]`` +
    ``density_range[1]`` · ℓ. ``index`` ``(n,)`` names a row of ``palette`` ``(P, columns)``, bytes. Colours with
    reflections have an ``environment`` ``(e, 3)``, bytes.
    """

    levels: np.ndarray
    density_bits: int
    density_range: tuple[float, float]
    index: np.ndarray
    palette: StoredArray
    environment: StoredArray | None = None

    @property
    def index_bits(self) -> int:
        """Bits of an index."""
        return max(1, (len(self.palette.entries) - 1).bit_length())


class PackedPaletteField(NodeVolume):
    """Compressed field in its form for rendering: the bits of density level and palette index at each node.

    Entries of the palette take a multiple of 16 bytes in memory, those of the environment four.
    """

    def __init__(self, nodes: Nodes, numbers: PaletteArrays):
        super().__init__(nodes, {})
        types = nodes.types
        self.density_bits, self.index_bits = numbers.density_bits, numbers.index_bits
        self.density_range = numbers.density_range
        # Level and index of each node without gaps, and one more word
        joined = numbers.levels.astype(np.uint32) | (numbers.index.astype(np.uint32) << self.density_bits)
        self.words = device_array(
            types.UInt32, as_words(pack_bits(joined, self.density_bits + self.index_bits), spare=1)
        )
        entries = numbers.palette.entries
        entries = np.pad(entries, ((0, 0), (0, -entries.shape[1] % 16)))
        self.packets = entries.shape[1] // 16
        self.palette = device_array(types.UInt32, entries.view("<u4"))
        self.scale, self.offset = numbers.palette.scale, numbers.palette.offset
        self.environment = None
        if (environment := numbers.environment) is not None:
            words = np.pad(environment.entries, ((0, 0), (0, 1))).view("<u4")
            self.environment = device_array(types.UInt32, words)
            self.environment_range = environment.scale, environment.offset

    @property
    def nbytes(self) -> int:
        """Bytes in memory, including the index of the nodes."""
        words = (self.words, self.palette, *([] if self.environment is None else [self.environment]))
        return 4 * sum(map(dr.width, words)) + self.nodes.nbytes

    def density_at(self, p, active=True):
        UInt32, width, indices = self.types.UInt32, self.density_bits + self.index_bits, []

        def level(number, seen):
            start = number * width
            first, shift = start >> 5, start & 31
            word = dr.gather(UInt32, self.words, first, seen) >> shift
            if 32 % width:  # the bits of a node may begin in one word and end in the next
                following = dr.gather(UInt32, self.words, first + 1, seen)
                word |= (following << (31 - shift)) << 1
            indices.append((word >> self.density_bits) & (2**self.index_bits - 1))
            return self.types.Float(word & (2**self.density_bits - 1))

        density, point_data = self.interpolated_density(level, p, active, *self.density_range)
        return density, point_data[:8] + indices

    def radiance_at(self, point_data, p, d, active=True):
        types = self.types
        sums = [types.Float(0)] * len(self.scale)
        for weight, index in zip(point_data[:8], point_data[8:], strict=True):
            words = []
            for j in range(self.packets):
                words += list(dr.gather(types.Array4u, self.palette, dr.fma(index, self.packets, j), active))
            for k in range(len(sums)):
                # The byte as the mantissa of a number in [1, 2): no conversion, and the weights sum to 1
                byte = (words[k // 4] << 15 - 8 * (k % 4)) if k % 4 < 2 else (words[k // 4] >> 8 * (k % 4) - 15)
                number = dr.reinterpret_array(types.Float, (byte & 0x7F8000) | 0x3F800000)
                sums[k] = dr.fma(weight, number, sums[k])
        numbers = [dr.fma(s - 1, 256 * a, b) for s, a, b in zip(sums, self.scale, self.offset, strict=True)]

        def entry(number, seen):
            word = dr.gather(types.UInt32, self.environment, number, seen)
            scale, offset = self.environment_range
            return [dr.fma(types.Float((word >> 8 * c) & 255), scale[c], offset[c]) for c in range(3)]

        return radiance_of(types, numbers, d, None if self.environment is None else entry, active)
