"""Levels of detail as images: what a codec is given, what it makes a pyramid of, and the error of each level."""

from __future__ import annotations

import numpy as np

from ...maps.layout import Layout
from ...maps.pyramid import Pyramid
from .test_scenes import decibel


def images(pyramid: Pyramid) -> dict[str, list[np.ndarray]]:
    """All levels of each map, ``(height, width, channels)``, clipped to the [0, 1] that codecs of 8 bits can hold."""
    layout, found = pyramid.layout, {name: [] for name in pyramid.layout.names}
    for values in pyramid.values:
        stored = [values[..., c] for c in range(layout.stored)]
        for name in layout.names:
            channels = [np.broadcast_to(np.float32(c), values.shape[:2]) for c in layout.decode(name, stored)]
            found[name].append(np.clip(np.stack(channels, -1), 0, 1))
    return found


def pyramid_of(maps: dict[str, list[np.ndarray]], like: Pyramid) -> Pyramid:
    """The pyramid of levels that were decoded, with the layout of another."""
    layout: Layout = like.layout
    levels = []
    for i, values in enumerate(like.values):
        found = np.zeros_like(values)
        for m in layout.maps:
            for c, where in enumerate(m.where):
                if isinstance(where, int):
                    found[..., where] = m.encode(maps[m.name][i][..., c])
        levels.append(found)
    return Pyramid(layout, levels, like.types, like.border)


def errors(truth: dict[str, list[np.ndarray]], found: dict[str, list[np.ndarray]]) -> dict[str, list[float]]:
    """
    PSNR in dB of each level, at its texel centres: ``all`` channels together and each map, values as the source's files
    have them.
    """
    result: dict[str, list[float]] = {"all": []}
    for i in range(len(next(iter(truth.values())))):
        squares, channels = 0.0, 0
        for name, levels in truth.items():
            mse = float(np.mean((levels[i].astype(np.float64) - np.clip(found[name][i], 0, 1)) ** 2))
            result.setdefault(name, []).append(decibel(mse))
            squares += mse * levels[i].shape[-1]
            channels += levels[i].shape[-1]
        result["all"].append(decibel(squares / channels))
    return result


def decoded(image, names, levels: int) -> dict[str, list[np.ndarray]]:
    """All levels of what can be read at a level of detail (``FilteredMaps``), at texel centres."""
    found = {name: [] for name in names}
    for level in range(levels):
        for name, values in image.decode(names, level=level).items():
            found[name].append(values)
    return found
