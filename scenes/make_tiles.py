"""Write the maps of a floor of glazed tiles, 384², periodic: albedo, normal, roughness, occlusion, and their manifest.

They are compressed by ``mi-diffind fit image scenes/assets/tiles.json -o scenes/assets/tiles.npz``.
"""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np

SIDE, TILES = 384, 4
FOLDER = Path(__file__).resolve().parent / "assets"


def noise(random, octaves, falloff=0.55) -> np.ndarray:
    """Periodic noise, (SIDE, SIDE) in about [-1, 1], of octaves given as waves along a side."""
    f = np.fft.fftfreq(SIDE, 1 / SIDE)
    radius = np.hypot(f[:, None], f[None])
    spectrum = np.fft.fft2(random.standard_normal((SIDE, SIDE)))
    total, weight = np.zeros((SIDE, SIDE)), 1.0
    for waves in octaves:
        band = np.fft.ifft2(spectrum * np.exp(-(((radius - waves) / (0.4 * waves)) ** 2))).real
        total += weight * band / np.abs(band).max()
        weight *= falloff
    return total / np.abs(total).max()


def smoothstep(low, high, x):
    """Return the smooth step from 0 at ``low`` to 1 at ``high``."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def main() -> None:
    """Write the files."""
    mi.set_variant("scalar_rgb")
    random = np.random.default_rng(7)
    x = (np.arange(SIDE) + 0.5) / SIDE * TILES
    v, u = np.meshgrid(x, x, indexing="ij")
    wobble = noise(random, (6, 12, 24))
    column, row = np.floor(u).astype(int) % TILES, np.floor(v).astype(int) % TILES
    edge = np.minimum(np.minimum(u % 1, 1 - u % 1), np.minimum(v % 1, 1 - v % 1)) + 0.006 * wobble
    tile = smoothstep(0.035, 0.05, edge)  # 0: grout, 1: glaze
    bevel = smoothstep(0.04, 0.12, edge)

    shade = random.uniform(-1, 1, (TILES, TILES))[row, column]
    checker = (row + column) % 2
    stains, grain, scratches = (
        noise(random, (3, 6, 12, 24)),
        noise(random, (40, 80, 120), 0.9),
        noise(random, (60, 110)),
    )
    light = np.stack([0.62 + 0.05 * shade, 0.6 + 0.04 * shade, 0.53 + 0.02 * shade], -1)
    dark = np.stack([0.08 + 0.03 * shade, 0.22 + 0.04 * shade, 0.27 + 0.05 * shade], -1)
    glaze = np.where(checker[..., None] == 1, dark, light) * (1 + 0.22 * stains + 0.05 * grain)[..., None]
    grout = np.stack([0.36, 0.33, 0.3], -1) * (1 + 0.25 * grain + 0.2 * stains)[..., None]
    albedo = np.clip(grout + (glaze - grout) * tile[..., None], 0.01, 0.9)
    srgb = np.where(albedo <= 0.0031308, 12.92 * albedo, 1.055 * albedo ** (1 / 2.4) - 0.055)

    height = 0.02 * bevel + 0.0012 * stains * tile + 0.002 * grain * (1 - tile)
    slope = [(np.roll(height, -1, a) - np.roll(height, 1, a)) * SIDE / 2 for a in (1, 0)]
    normal = np.stack([-slope[0] * 0.6, -slope[1] * 0.6, np.ones_like(height)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)

    roughness = np.clip(0.16 + 0.1 * np.maximum(stains, 0) + 0.05 * np.maximum(scratches, 0), 0, 1)
    roughness = 0.85 + (roughness - 0.85) * tile
    ao = 1 - 0.45 * (1 - bevel) ** 2

    maps = {"albedo": srgb, "normal": 0.5 + 0.5 * normal, "roughness": roughness, "ao": ao}
    for name, values in maps.items():
        data = np.ascontiguousarray(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8))
        mi.Bitmap(data).write(str(FOLDER / f"tiles_{name}.png"))
    manifest = {"maps": {name: f"tiles_{name}.png" for name in maps}}
    (FOLDER / "tiles.json").write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
