"""Colours with reflections: numbers of directions, and an environment in the mirrored direction.

The reflection of a distant environment depends on the mirrored direction alone. So all nodes share one table of the
environment, and each has a normal, by which it finds its place there: an indirection of directions. With the
interpolated numbers of a point, the radiance in direction d is

    exp(a + b·d) + exp(s + E(d − 2 (d·n) n)).

Here a and b are those of :func:`.volume_field.colour_of` and s is the tint of the reflection (logarithms, for red,
green and blue); n is the unit normal. E is the logarithm of the environment, interpolated between a fine and a coarse
table by the sharpness of the point.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

#: Sides of the squares of the fine and the coarse table; each holds all directions, by an octahedron that is unfolded.
SIDES = (64, 16)

#: Entries of both tables.
ENTRIES = sum(side**2 for side in SIDES)

#: Columns of the numbers of a node: normal, tint and sharpness follow those of directions; the last is unused.
DIRECTIONS, NORMAL, TINT, SHARPNESS, COLUMNS = 12, slice(12, 15), slice(15, 18), 18, 20

#: Logarithm of the tint before the training.
BEGIN_TINT = -3.0

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


def reflected(types, numbers: list, d, entry, active=True) -> list:
    """Return the reflection [r, g, b] in direction ``d``, from the ``numbers`` of a point and the tables' ``entry``."""
    n = types.Array3f(*numbers[NORMAL])
    n *= dr.rsqrt(dr.squared_norm(n) + 1e-6)
    mirrored = dr.fma(-2 * dr.dot(d, n), n, d)
    sharpness = dr.rcp(1 + dr.exp(-dr.clip(numbers[SHARPNESS], -30, 30)))
    seen = environment_at(types, entry, mirrored, sharpness, active)
    return [dr.exp(dr.minimum(s + light, BRIGHTEST)) for s, light in zip(numbers[TINT], seen, strict=True)]


def begun(colour: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the numbers of nodes, ``(n, 20)``, before reflections are trained, from those of directions."""
    numbers = np.zeros((len(colour), COLUMNS), np.float32)
    numbers[:, :DIRECTIONS] = colour
    numbers[:, NORMAL] = normals
    numbers[:, TINT] = BEGIN_TINT
    return numbers
