"""Levels of detail as images: the input of codecs, decoded pyramids, and the error of each level."""

from __future__ import annotations

import numpy as np

from ...maps.compressed import decibel
from ...maps.pyramid import Pyramid


def images(pyramid: Pyramid) -> dict[str, list[np.ndarray]]:
    """Return all levels of each map, ``(height, width, channels)``, clipped to the [0, 1] of 8-bit codecs."""
    layout, levels = pyramid.layout, {name: [] for name in pyramid.layout.names}
    for values in pyramid.values:
        stored = [values[..., c] for c in range(layout.stored)]
        for name in layout.names:
            channels = [np.broadcast_to(np.float32(c), values.shape[:2]) for c in layout.decode(name, stored)]
            levels[name].append(np.clip(np.stack(channels, -1), 0, 1))
    return levels


def pyramid_of(maps: dict[str, list[np.ndarray]], like: Pyramid) -> Pyramid:
    """Return the pyramid of decoded levels, with the layout and border of ``like``."""
    levels = [np.zeros_like(values) for values in like.values]
    for m in like.layout.maps:
        for c, channel in enumerate(m.where):
            if isinstance(channel, int):
                for values, decoded_level in zip(levels, maps[m.name], strict=True):
                    values[..., channel] = m.encode(decoded_level[..., c])
    return Pyramid(like.layout, levels, like.types, like.border)


def errors(truth: dict[str, list[np.ndarray]], maps: dict[str, list[np.ndarray]]) -> dict[str, list[float]]:
    """Return the PSNR, in dB, of each level at its texel centres: of ``all`` channels together and of each map.

    Values are those of the source's files, clipped to [0, 1].
    """
    result: dict[str, list[float]] = {"all": []}
    for i in range(len(next(iter(truth.values())))):
        squares, channels = 0.0, 0
        for name, levels in truth.items():
            mse = float(np.mean((levels[i].astype(np.float64) - np.clip(maps[name][i], 0, 1)) ** 2))
            result.setdefault(name, []).append(decibel(mse))
            squares += mse * levels[i].shape[-1]
            channels += levels[i].shape[-1]
        result["all"].append(decibel(squares / channels))
    return result


def decoded(image, names, levels: int) -> dict[str, list[np.ndarray]]:
    """Return all levels of maps that can be read at a level of detail (``FilteredMaps``), at texel centres."""
    maps = [image.decode(names, level=level) for level in range(levels)]
    return {name: [values[name] for values in maps] for name in names}
