"""
The paper's material encoding: the parameter textures of a material become *latent* textures that the decoder reads
directly.

A latent texture holds three parameters in its channels, so that one read brings three of them. Roughness and anisotropy
are stored as the encoder's coordinates (of the material's preset), where bytes are spaced as the decoder needs
them, and the encoder need not be read when rendering; the others as they are. Only textures that have an effect are
stored; constants remain parameters. The last texture has one channel if one is enough.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from . import metrics, plugins, scenes
from .files import replacing, writable_folder
from .measure.clock import kernel_seconds, total
from .measure.statistics import spread

#: How latent textures may be stored: bytes as PNG, or half precision as EXR.
STORAGES = ("uint8", "float16")


def encode(
    path: str | os.PathLike,
    material: str,
    folder: str | os.PathLike,
    storage: str = "uint8",
    resolution: int | None = None,
    defines: dict[str, str] | None = None,
) -> dict:
    """
    Encode the material with the id ``material`` of a scene file, and write ``latents_0.png``, …, ``base_color.png`` (if
    it is a texture) and ``material.xml``, which names them, to ``folder``.

    ``resolution`` is the side of the latent textures in texels; by default, they have the width and height of the
    largest texture. Returns ``layout`` (names in the order of the channels), ``width``, ``height``, ``bytes`` and
    ``bytes_before`` of all textures in memory, and what :func:`measure` finds. Raises
    :class:`~mi_diffind.scenes.SceneError`.
    """
    with scenes.scene_errors(path):
        bsdf = _material(scenes.load(path, defines=defines), material)
        before = bsdf.encodable()
        if not before:
            raise RuntimeError(f'no parameter of "{material}" is a texture, so there is nothing to encode')
        to_uv = _common_transform(before)
        sizes = [texture.resolution() for texture in before.values()]
        width, height = (resolution, resolution) if resolution else (max(int(s[i]) for s in sizes) for i in (0, 1))
        names = [name for name in before if name not in bsdf.ENCODED_AS_COLOUR]
        with dr.suspend_grad():
            si = _texels(width, height, to_uv)
            colours = {n: np.stack([c.numpy() for c in _rgb(t, si)], -1) for n, t in before.items() if n not in names}
            channels = [np.asarray(bsdf.encoded(name, si).numpy()) for name in names]
    folder = writable_folder(folder, create=True)
    suffix, textures, size = {"uint8": ".png", "float16": ".exr"}[storage], {}, 0
    per_channel = width * height * {"uint8": 1, "float16": 2}[storage]
    for i in range(0, len(channels), 3):
        group = channels[i : i + 3]
        group += [np.zeros_like(group[0])] * (0 if len(group) == 1 else 3 - len(group))
        textures[f"latents_{i // 3}"] = np.stack(group, -1)
    for name, values in (textures | colours).items():
        values = values.reshape(height, width, -1)
        size += per_channel * values.shape[-1]
        with replacing(folder / f"{name}{suffix}") as temporary:
            _write(temporary, values, storage, name in colours)
    files = {name: f"{name}{suffix}" for name in textures | colours}
    with replacing(folder / "material.xml") as temporary:
        temporary.write_text(_written(bsdf, names, files, set(textures), to_uv), encoding="utf-8")
    result = mi.load_file(str(folder / "material.xml"))
    return {
        "scene": str(path),
        "material": material,
        "preset": bsdf.report()["preset"],
        "layout": names,
        "colours": list(colours),
        "width": width,
        "height": height,
        "storage": storage,
        "bytes": size,
        "bytes_before": sum(_bytes(texture) for texture in before.values()),
        "files": [str(folder / file) for file in ("material.xml", *files.values())],
        **measure(bsdf, result),
    }


def _material(scene, material: str):
    """The material with an id, which can be encoded."""
    able = ", ".join(p.name for p in plugins.declared().values() if hasattr(p.factory, "encodable"))
    found = {node.id(): node for node in mi.traverse(scene).hierarchy if isinstance(node, mi.BSDF) and node.id()}
    if not hasattr(found.get(material), "encodable"):
        ids = ", ".join(sorted(name for name, node in found.items() if hasattr(node, "encodable"))) or "none"
        if material in found:
            raise RuntimeError(f'"{material}" has no latents, which only materials of {able} have; there are {ids}')
        raise RuntimeError(f'has no material "{material}"; only materials of {able} can be encoded: {ids}')
    return found[material]


def measure(before, after, samples: int = 2**20, rounds: int = 15, seed: int = 0) -> dict:
    """
    ``psnr_db`` of BRDF · cosine, clipped to [0, 1], of the BSDF ``after`` against ``before``, at random places and
    uniformly random directions; ``time_ratio``: the time that ``eval`` takes, after over before (``median``, ``q1``,
    ``q3`` over interleaved rounds, input and output included).
    """
    rng = np.random.default_rng(seed)
    si = dr.zeros(mi.SurfaceInteraction3f, samples)
    si.uv = mi.Point2f(rng.random((2, samples), dtype=np.float32))
    si.wi, wo = (_hemisphere(rng, samples) for _ in range(2))
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    with dr.suspend_grad():
        values = [np.asarray(bsdf.eval(mi.BSDFContext(), si, wo).numpy()) for bsdf in (before, after)]
    dr.eval(si, wo)
    seconds = [
        [kernel_seconds(lambda b=b: total(b.eval(mi.BSDFContext(), si, wo))[0]) for b in (before, after)]
        for _ in range(rounds + 2)
    ]
    return {"psnr_db": metrics.psnr(*values), "time_ratio": spread(b / a for a, b in seconds[2:])}


def _hemisphere(rng, n: int):
    z, phi = rng.random(n), 2 * np.pi * rng.random(n)
    r = np.sqrt(1 - z * z)
    return mi.Vector3f(np.stack([r * np.cos(phi), r * np.sin(phi), z]).astype(np.float32))


def _common_transform(textures: dict):
    found = {name: mi.traverse(texture).get("to_uv") for name, texture in textures.items()}
    distinct = {str(transform.matrix) for transform in found.values() if transform is not None}
    if len(distinct) != 1 or None in found.values():
        raise RuntimeError(
            f"the textures {', '.join(textures)} have to be bitmaps with the same to_uv to be encoded together"
        )
    return next(iter(found.values()))


def _texels(width: int, height: int, to_uv):
    """Interactions at the centres of all texels."""
    index = dr.arange(mi.UInt32, width * height)
    u = (mi.Float(index % width) + 0.5) / width
    v = (mi.Float(index // width) + 0.5) / height
    m = np.linalg.inv(np.array(to_uv.matrix, np.float64).reshape(3, 3)).tolist()
    si = dr.zeros(mi.SurfaceInteraction3f, width * height)
    si.uv = mi.Point2f(m[0][0] * u + m[0][1] * v + m[0][2], m[1][0] * u + m[1][1] * v + m[1][2])
    return si


def _rgb(texture, si):
    if mi.is_spectral:
        raise RuntimeError(f"the variant {mi.variant()} cannot encode colours; use an RGB variant")
    return texture.eval_3(si) if mi.is_rgb else texture.eval(si)


def _bytes(texture) -> int:
    data = mi.traverse(texture)["data"]
    return dr.width(data.array) * {dr.VarType.UInt8: 1, dr.VarType.Float16: 2}.get(dr.type_v(data), 4)


def _write(path: Path, values: np.ndarray, storage: str, is_colour: bool) -> None:
    if storage == "uint8":
        values = metrics.srgb(values) if is_colour else np.clip(values, 0, 1)
        mi.Bitmap(np.ascontiguousarray(np.round(255 * values).astype(np.uint8))).write(str(path))
    else:
        mi.Bitmap(np.ascontiguousarray(values.astype(np.float16))).write(str(path))


def _written(bsdf, names: list[str], files: dict[str, str], raw: set[str], to_uv) -> str:
    """The XML of the encoded material: what it says itself, and the textures, of which ``raw`` hold no colours."""
    m = np.array(to_uv.matrix, np.float64).reshape(3, 3)
    full = np.eye(4)
    full[:2, :2], full[:2, 3] = m[:2, :2], m[:2, 2]
    place = {} if np.allclose(m, np.eye(3)) else {"to_uv": mi.ScalarTransform4f(full)}
    textures = {
        name: {"type": "bitmap", "filename": file, **({"raw": True} if name in raw else {}), **place}
        for name, file in files.items()
    }
    state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), {**bsdf.encoded_as(names), **textures})
    state.root.type = mi.ObjectType.BSDF  # of plugins in Python it is not known yet
    root = ET.fromstring(mi.parser.write_string(state))
    root.set("id", bsdf.id())  # of the root, Mitsuba leaves it out
    ET.indent(root, "    ")
    return ET.tostring(root, encoding="unicode") + "\n"
