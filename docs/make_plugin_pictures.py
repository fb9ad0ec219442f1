"""Pictures of the plugins' manual pages: renders of the scenes that ship, ``docs/pictures/NAME.jpg``.

    python docs/make_plugin_pictures.py [NAME…]

Each takes seconds. Seeds are fixed.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

import mi_diffind as md
from mi_diffind.core.files import replacing
from mi_diffind.scenes import loading

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "pictures"

#: Width and height in pixels, and the largest size of a file in bytes.
WIDTH, HEIGHT, LARGEST = 384, 240, 25_000

#: Plugin → scene of ``scenes/``, samples a pixel, counterpart that replaces its learned plugins ("": none), caption.
PICTURES = {
    "disney": ("still_life", 64, "exact", "A still life of constant and textured materials, by the formulas."),
    "mipmap": ("horizon", 1, "mipmap", "One sample a pixel: ``bitmap`` on the left, ``mipmap`` with ``filter`` "
               "``anisotropic`` on the right."),
    "neural_bsdf": ("library", 96, "", "Twelve materials: left of each pair the source, right a file of four "
                    "kilobytes."),
    "neural_disney": ("still_life", 64, "", "The still life of the picture of ``disney``, from 384 bytes of tables."),
    "neural_field": ("field", 96, "", "A captured field of 0.6 MB on a mirror, among meshes."),
    "neural_ggx": ("metals", 96, "", "Metals of many roughnesses, ``scenes/metals.xml``."),
    "neural_image": ("tiles", 128, "", "Albedo, normal and roughness of glazed tiles from one file of 98 kB."),
    "neural_material": ("rust", 64, "", "Hammered metal with rust from one file of 40 kB, trained for its shading."),
    "neural_sdf": ("solids", 512, "", "Suzanne as a mesh and as a field of 256 kB, and knots as fields of 128 kB."),
    "neural_texture": ("horizon", 1, "", "One sample a pixel: ``bitmap`` on the left, ``neural_texture`` with "
                       "``filter`` ``anisotropic`` on the right, a twelfth of the bytes."),
    "path_footprint": ("horizon", 1, "", "Tiles in a mirror, one sample a pixel: ``path`` on the left, "
                       "``path_footprint`` on the right."),
    "path_sdf": ("solids", 512, "", "Fields of glass and gold among meshes: they refract, reflect and cast shadows."),
}  # fmt: skip

#: Depth of renders with one sample a pixel, whose error is mostly that of textures, and the column between the halves.
DEPTH, SPLIT = 3, 130


def render(name: str, spp: int, against: str, integrator: str = "") -> np.ndarray:
    """Return a linear render ``(HEIGHT, WIDTH, 3)`` of a scene, with another integrator if one is given."""
    defines = {"width": WIDTH, "height": HEIGHT} | ({"max_depth": DEPTH} if spp == 1 else {})
    options = {"exact": True, "against": against} if against else {}
    scene = loading.load(ROOT / "scenes" / f"{name}.xml", defines, **options)
    other = mi.load_dict({"type": integrator, "max_depth": DEPTH}) if integrator else None
    return np.array(mi.render(scene, integrator=other, spp=spp, seed=7))[..., :3]


def picture(name: str) -> np.ndarray:
    """Return the picture of a plugin; with one sample a pixel, its left part shows what the plugin improves."""
    scene, spp, against, _ = PICTURES[name]
    image = render(scene, spp, against)
    if spp == 1:
        left = render(scene, spp, "", "path") if name == "path_footprint" else render(scene, spp, "exact")
        image[:, :SPLIT] = left[:, :SPLIT]
        image[:, SPLIT - 1 : SPLIT + 1] = 1
    return image


def jpeg(image: np.ndarray) -> bytes:
    """Return an image as JPEG of at most :data:`LARGEST` bytes."""
    shown = Image.fromarray(np.uint8(np.round(255 * np.asarray(md.srgb.for_display(image)))))
    for quality in range(92, 20, -4):
        shown.save(buffer := io.BytesIO(), "jpeg", quality=quality, optimize=True)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getvalue()


def main() -> None:
    """Write the pictures of the plugins that are named, or of all."""
    parser = argparse.ArgumentParser(description="Render the pictures of the plugins' manual pages.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"plugins (default: all): {', '.join(PICTURES)}")
    names = parser.parse_args().names or list(PICTURES)
    if unknown := set(names) - PICTURES.keys():
        parser.error(f"NAME: found {', '.join(sorted(unknown))}, allowed are {', '.join(PICTURES)}")
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    for name in names:
        data = jpeg(picture(name))
        with replacing(FOLDER / f"{name}.jpg") as temporary:
            Path(temporary).write_bytes(data)
        print(f"{name}.jpg: {len(data):,} bytes", file=sys.stderr)


if __name__ == "__main__":
    main()
