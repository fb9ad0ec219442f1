"""``mi-diffind encode``: the parameter textures of a material as latent textures."""

from __future__ import annotations

from pathlib import Path

from ..files import writable_folder
from .common import positive, require_scene, scene_options, set_variant, verb

HELP = "turn the parameter textures of a material into latent textures"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "encode", run, HELP)
    sub.add_argument("scene", metavar="SCENE.xml")
    sub.add_argument("--material", required=True, metavar="ID", help="id of the material")
    sub.add_argument("-o", "--output", required=True, metavar="DIR", help="folder for textures and material.xml")
    sub.add_argument(
        "--storage", choices=["uint8", "float16"], default="uint8", help="PNG or EXR (default: uint8, PNG)"
    )
    sub.add_argument("--resolution", type=positive, help="side in texels (default: that of the largest texture)")
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """
    Write the latent textures and what reads them. Returns what :func:`mi_diffind.encode.encode` found. Raises
    :class:`~mi_diffind.commands.common.UsageError`, and as that does.
    """
    require_scene(arguments.scene)
    writable_folder(Path(arguments.output).parent)
    set_variant(arguments.variant)
    from ..encode import encode

    found = encode(
        arguments.scene,
        arguments.material,
        arguments.output,
        arguments.storage,
        arguments.resolution,
        dict(arguments.defines),
    )
    layout = [found["layout"][i : i + 3] for i in range(0, len(found["layout"]), 3)]
    print(f"{found['files'][0]}: {found['width']} x {found['height']}, preset {found['preset']}")
    for i, names in enumerate(layout):
        print(f"  latents_{i}   {', '.join(names)}")
    for name in found["colours"]:
        print(f"  {name:11} a colour")
    ratio = found["time_ratio"]
    print(
        f"  {found['bytes']:,} bytes ({found['bytes_before']:,} before), PSNR {found['psnr_db']:.2f} dB, "
        f"time of an eval {ratio['median']:.2f} of that before ({ratio['q1']:.2f} to {ratio['q3']:.2f})"
    )
    return found
