"""Start of the proxy's training: two lobes of fixed shape whose colours are fitted by non-negative least squares."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np

from .model import EDGE, LOBE, PARAMETERS, DirectionPair, ProxyLobe
from .pool import Samples

#: Shapes that are tried: roughness, and exponents of GGX, of a lobe with a shorter tail, and nearly Beckmann's.
ALPHAS, EXPONENTS = tuple(float(a) for a in np.geomspace(0.003, 0.9, 13)), (2.0, 6.0, 30.0)

#: Roughness below which a lobe is much narrower than those of a start, relative to the narrowest.
NARROW = 0.4

#: Samples, sweeps of the least squares, and the least colour of a term.
SAMPLES, SWEEPS, LEAST = 2**13, 60, 1e-5


def starts(samples: Samples, types, count: int) -> list[np.ndarray]:
    """Return the logarithms of the ``count`` best proxies, ``(22,)`` each, by their mean absolute error.

    The second is the best one with a lobe that is much narrower than those of the first, if there is room for one: a
    sharp coat of little light counts little in the error, but is seen.
    """
    index = dr.arange(types.UInt32, min(SAMPLES, dr.width(samples.weight)))
    s = samples.at(index)
    g = DirectionPair.of(s.wi, s.wo)
    shapes = list(itertools.product(ALPHAS, EXPONENTS))
    columns = [s.wo.z * dr.inv_pi]
    with dr.suspend_grad():
        for alpha, exponent in shapes:
            a, one = types.Float(alpha), [types.Float(1)] * 3
            value = s.wo.z * ProxyLobe((a,), types.Float(exponent), one, one).constants().value(g)[0]
            columns += [value * (1 - g.schlick), value * g.schlick]
        dr.eval(columns, s.weight, s.value)
    weight = s.weight.numpy().astype(np.float64)
    basis = np.stack([c.numpy() for c in columns], axis=-1) * weight[:, None]
    target = np.stack([v.numpy() for v in s.value], axis=-1) * weight[:, None]
    # Squares of contributions count bright ones most: rows are scaled towards their roots
    rows = 1 / np.sqrt(np.maximum(target.mean(axis=1, keepdims=True), max(1e-2 * target.mean(), 1e-20)))
    gram, right = (rows * basis).T @ (rows * basis), (rows * basis).T @ (rows * target)
    ranked = []
    for i, j in itertools.combinations(range(len(shapes)), 2):
        chosen = [0, 2 * i + 1, 2 * i + 2, 2 * j + 1, 2 * j + 2]
        colours = _non_negative(gram[np.ix_(chosen, chosen)], right[chosen])
        error = np.abs(basis[:, chosen] @ colours - target).mean()
        ranked.append((error, i, j, colours))
    ranked.sort(key=lambda entry: entry[0])
    narrowest = [min(shapes[i][0], shapes[j][0]) for _, i, j, _ in ranked]
    narrow = next((k for k, alpha in enumerate(narrowest) if alpha < NARROW * narrowest[0]), 1)
    ranked.insert(1, ranked.pop(narrow))
    return [_logarithms(shapes[i], shapes[j], colours) for _, i, j, colours in ranked[:count]]


def _non_negative(gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return x ≥ 0, ``(n, 3)``, that minimises |Ax − b|² by sweeps over its entries, from AᵀA and Aᵀb."""
    x = np.zeros_like(right)
    diagonal = np.maximum(np.diag(gram), 1e-30)
    for _ in range(SWEEPS):
        for k in range(len(x)):
            x[k] = np.maximum(x[k] + (right[k] - gram[k] @ x) / diagonal[k], 0)
    return x


def _logarithms(first: tuple[float, float], second: tuple[float, float], colours: np.ndarray) -> np.ndarray:
    result = np.zeros(PARAMETERS)
    colours = np.log(np.maximum(colours, LEAST))
    result[:3], result[EDGE] = colours[0], 0.0
    for k, (alpha, exponent) in enumerate((first, second)):
        a = 4 + k * LOBE
        result[a : a + 2] = np.log(alpha)
        result[a + 2] = np.log(exponent / 2)
        result[a + 3 : a + 6], result[a + 6 : a + 9] = colours[1 + 2 * k], colours[2 + 2 * k]
    return result
