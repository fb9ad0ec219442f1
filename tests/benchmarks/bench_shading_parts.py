"""Parts of the error of compressed materials as they are shaded, in dB: run it, it only measures.

    python tests/benchmarks/bench_shading_parts.py MATERIAL.json FILE.npz [MATERIAL.json FILE.npz …] [--json FILE]

Each FILE.npz is a texture of the material, trained for its values (``fit texture --shading off``). Shaded values are
those of held-out footprints, read with each number of samples; gains are means of these.

*exact*: gain over the file, by level of detail, if the maps of normals, or all other maps, are exact. *broadened*: gain
over the uncompressed maps, in the mean of levels, with a share of the way to Toksvig's α². *finer*: the same with maps
that are read a level finer.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from frame import VARIANT, parser, write

mi.set_variant(VARIANT)

from mi_diffind.maps.layout import Layout  # noqa: E402
from mi_diffind.maps.pyramid import FilteredMaps, Pyramid  # noqa: E402
from mi_diffind.maps.source import load_source  # noqa: E402
from mi_diffind.measure.clock import machine  # noqa: E402
from mi_diffind.studies.baselines import normals  # noqa: E402
from mi_diffind.tasks.texture.appearance import reader  # noqa: E402
from mi_diffind.tasks.texture.compressed import CompressedTexture, load  # noqa: E402
from mi_diffind.tasks.texture.heldout import HeldOutFootprints, compared  # noqa: E402
from mi_diffind.tasks.texture.surface import maps_of, material_effects  # noqa: E402

#: Shares of the way to Toksvig's α².
SHARES = (0.05, 0.1, 0.2, 0.4)


class MixedMaps(FilteredMaps):
    """Filtered maps whose ``channels`` are those of a pyramid; the others are those of a texture."""

    def __init__(self, texture: FilteredMaps, pyramid: Pyramid, channels: set[int]):
        self.texture, self.pyramid, self.channels, self.layout = texture, pyramid, channels, pyramid.layout

    def filtered(self, u, v, level, active=True):
        """Return the stored channels."""
        values = zip(
            self.texture.filtered(u, v, level, active), self.pyramid.filtered(u, v, level, active), strict=True
        )
        return [exact if i in self.channels else read for i, (read, exact) in enumerate(values)]

    def extra(self, u, v, level, active=True):
        """Return ``None``: there are no extras."""


def stored_channels(layout: Layout, is_normal: bool) -> set[int]:
    """Return the stored channels of the map of normals, or of all other maps that shading reads."""
    maps = [m for role, m in maps_of(layout).items() if (role == "normal") == is_normal]
    return {w for m in maps for w in m.where if isinstance(w, int)}


def broadened(pyramid: Pyramid, share: float) -> Pyramid:
    """Return a pyramid whose α² is a share of the way to Toksvig's."""
    levels = zip(normals.roughness_levels(pyramid), normals.toksvig_levels(pyramid), strict=True)
    return normals.with_roughness(pyramid, [((1 - share) * a**4 + share * b**4) ** 0.25 for a, b in levels])


def measure(material: str, file: str) -> dict:
    """Return the gains of a material and its texture."""
    texture = CompressedTexture.from_table(load(file), mi.TensorXf)
    pyramid = Pyramid.from_source(load_source(material), texture.layout, texture.types, texture.border)
    effects = material_effects(pyramid.layout)[0]
    held_out = HeldOutFootprints(pyramid, effects)

    def errors(maps: FilteredMaps) -> list:
        return held_out.errors(reader(maps, effects))

    def gains(base: list, maps: FilteredMaps) -> np.ndarray:
        return compared(base, errors(maps))[0].mean(axis=(1, 2))

    base, uncompressed = errors(texture), errors(pyramid)
    return {
        "exact": {
            name: gains(base, MixedMaps(texture, pyramid, stored_channels(pyramid.layout, name == "normals"))).tolist()
            for name in ("normals", "others")
        },
        "broadened": {f"{s:g}": float(gains(uncompressed, broadened(pyramid, s)).mean()) for s in SHARES},
        "finer": float(gains(uncompressed, normals.ReadMaps(pyramid, [-1.0])).mean()),
    }


def main() -> None:
    command = parser(__doc__, rounds=1)
    command.add_argument("files", nargs="+", metavar="MATERIAL.json FILE.npz")
    options = command.parse_args()
    pairs = zip(options.files[::2], options.files[1::2], strict=True)
    result = {"machine": machine(VARIANT), "materials": {}}
    for material, file in pairs:
        name = material.rpartition("/")[2].removesuffix(".json")
        result["materials"][name] = figures = measure(material, file)
        print(name, figures)
    write(options.json, result)


if __name__ == "__main__":
    main()
