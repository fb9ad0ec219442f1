"""Procedural materials of the shading study, computed from a seed.

All maps are 8-bit, as in files, and repeat. ``hammered`` is a metal with texel-scale normals and dielectric rust;
``weave`` is a fabric of two colours of yarn; ``lacquer`` is a glossy dielectric with a pattern under a slightly uneven
coat.
"""

import numpy as np

from ..core.errors import UsageError
from ..images.srgb import for_display


def noise(rng, side: int, slope: float, low: float = 1.0, high: float = 1e9) -> np.ndarray:
    """Return a random field that repeats, mean 0 and variance 1, ``(side, side)``.

    Amplitudes are proportional to the frequency to the power of −``slope``, between ``low`` and ``high`` periods along
    the side, and zero elsewhere.
    """
    f = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None]) * side
    spectrum = np.where((f >= low) & (f <= high), np.maximum(f, 1) ** -slope, 0)
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) * spectrum, (side, side))
    return (field - field.mean()) / field.std()


def normals(height: np.ndarray, strength: float) -> np.ndarray:
    """Return unit normals, ``(side, side, 3)``, of a repeating height; ``strength`` is the slopes' deviation."""
    rows = 0.5 * (np.roll(height, -1, 0) - np.roll(height, 1, 0))
    columns = 0.5 * (np.roll(height, -1, 1) - np.roll(height, 1, 1))
    scale = strength / max(np.sqrt(0.5 * (rows.var() + columns.var())), 1e-9)
    n = np.stack([-scale * columns, -scale * rows, np.ones_like(height)], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def _step(x: np.ndarray, at: float, width: float) -> np.ndarray:
    t = np.clip((x - at) / width + 0.5, 0, 1)
    return t * t * (3 - 2 * t)


def _mixed(a, b, share: np.ndarray) -> np.ndarray:
    return np.asarray(a) * (1 - share[..., None]) + np.asarray(b) * share[..., None]


def hammered(side: int, seed: int = 1) -> dict[str, np.ndarray]:
    """Return maps of a metal with bumps down to the size of a texel, scratches along one axis, and rust in places."""
    rng = np.random.default_rng(seed)
    rust = _step(noise(rng, side, 1.6, 2, side / 8), 1.0, 0.5)
    scratches = np.tile(noise(rng, side, 0.3, 4)[:1], (side, 1)) * _step(noise(rng, side, 1.5, 2, 24), 0.0, 1.0)
    grain = noise(rng, side, 0.2, side / 6)
    bumps = noise(rng, side, 2.2, 3, side / 6)
    height = bumps * side / 60 + 0.35 * scratches + (0.5 + 0.7 * rust) * grain
    tone = 1 + 0.08 * noise(rng, side, 1.0, 2)
    colour = _mixed([0.86, 0.72, 0.48], [0.42, 0.20, 0.10], rust) * tone[..., None]
    roughness = 0.40 + 0.06 * noise(rng, side, 1.2, 2) + 0.35 * rust
    return {"albedo": colour, "normal": normals(height, 0.2), "roughness": roughness, "metallic": 1 - rust}


def weave(side: int, seed: int = 2) -> dict[str, np.ndarray]:
    """Return maps of a plain weave, eight texels a yarn: round yarns over and under each other, with fibres."""
    rng = np.random.default_rng(seed)
    yarn = 8
    y, x = np.mgrid[:side, :side] + 0.5 + yarn / 2
    phase_x, phase_y = np.pi * x / yarn, np.pi * y / yarn
    across, along = np.abs(np.sin(phase_x)) ** 0.7, np.abs(np.sin(phase_y)) ** 0.7
    odd = ((x // yarn + y // yarn) % 2).astype(float)
    over = _step(odd + 0.3 * (along - across), 0.5, 0.4)
    fibres = noise(rng, side, 0.2, side / 8)
    height = yarn * 0.35 * np.where(over > 0.5, across, along) + 0.4 * fibres
    pattern = (((x // (8 * yarn)) + (y // (8 * yarn))) % 2).astype(float)
    warp = _mixed([0.14, 0.20, 0.42], [0.45, 0.10, 0.12], pattern)
    colour = warp * (1 - over[..., None]) + np.array([0.78, 0.74, 0.64]) * over[..., None]
    colour = colour * (1 + 0.12 * fibres + 0.06 * noise(rng, side, 1.0, 2))[..., None]
    roughness = 0.62 + 0.06 * noise(rng, side, 0.8, 4) + 0.12 * (1 - over)
    return {"albedo": colour, "normal": normals(height, 0.5), "roughness": roughness}


def lacquer(side: int, seed: int = 3) -> dict[str, np.ndarray]:
    """Return maps of dark wood with rings under a gloss with orange peel and dust."""
    rng = np.random.default_rng(seed)
    rings = 0.5 + 0.5 * np.sin(10 * noise(rng, side, 2.2, 1, 12) + 0.6 * noise(rng, side, 1.0, 4))
    colour = _mixed([0.30, 0.13, 0.06], [0.58, 0.34, 0.16], rings)
    dust = _step(noise(rng, side, 0.0, side / 8), 2.2, 0.6)
    height = noise(rng, side, 1.0, side / 24, side / 5) + 2 * dust
    roughness = 0.28 + 0.04 * noise(rng, side, 1.0, 2) + 0.25 * dust
    return {"albedo": colour, "normal": normals(height, 0.2), "roughness": roughness}


#: Name → function that returns the maps, linear floats, for a side.
MATERIALS = {"hammered": hammered, "weave": weave, "lacquer": lacquer}


def example_maps(name: str = "hammered", side: int = 512) -> dict[str, np.ndarray]:
    """Return the maps of one of :data:`MATERIALS`: name → ``(side, side, channels)`` or ``(side, side)``, bytes.

    Albedos are sRGB-encoded, normals are (n + 1)/2. Maps repeat. The same arguments give the same bytes. Raises
    :class:`.UsageError` for another name.
    """
    if name not in MATERIALS:
        raise UsageError(f'name: found the material "{name}", allowed are {", ".join(MATERIALS)}')
    maps = {}
    for key, values in MATERIALS[name](side).items():
        values = for_display(values) if key == "albedo" else 0.5 + 0.5 * values if key == "normal" else values
        maps[key] = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return maps
