"""
The paper's material encoding: the parameter textures of a material become *latent* textures that the decoder reads
directly.

A latent texture holds three parameters in its channels, so that one read brings three of them. Roughness and anisotropy
are stored as the encoder's coordinates (of the material's quality level), where bytes are spaced as the decoder needs
them, and the encoder need not be read when rendering; the others as they are. Only textures that have an effect are
stored; constants remain parameters. The last texture has one channel if one is enough.
"""

from __future__ import annotations

import os
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from . import metrics, scenes
from .files import replacing, writable_folder
from .measure.clock import kernel_seconds, total
from .measure.statistics import spread
from .tasks.disney.model import SPECULAR_SCALE

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
    scene = scenes.load(path, defines=defines)
    found = {m.id(): m for m in scenes.learned_materials(scene)}
    if material not in found:
        raise scenes.SceneError(f'{path}: has no learned material "{material}"; there are {", ".join(sorted(found))}')
    bsdf = found[material]
    if bsdf.latents:
        raise scenes.SceneError(f'{path}: the parameters of "{material}" are encoded already')
    names = bsdf.textured()
    if not names:
        raise scenes.SceneError(f'{path}: no parameter of "{material}" is a texture, so there is nothing to encode')
    if bsdf.reflectance_name == "eta" and "specular" in names:
        raise scenes.SceneError(f'{path}: "{material}" has a texture for eta, only one for specular can be encoded')
    to_uv = _common_transform(path, {name: bsdf.parameter(name) for name in names})
    sizes = [bsdf.parameter(name).resolution() for name in names]
    width, height = (resolution, resolution) if resolution else (max(int(s[i]) for s in sizes) for i in (0, 1))
    with dr.suspend_grad():
        si = _texels(width, height, to_uv)
        colour = [np.stack([c.numpy() for c in _rgb(bsdf.parameter("base_color"), si)], -1)] * ("base_color" in names)
        names = [name for name in names if name != "base_color"]
        channels = [np.asarray(bsdf.encoded(name, si).numpy()) for name in names]
    folder = writable_folder(folder, create=True)
    suffix, textures, size = {"uint8": ".png", "float16": ".exr"}[storage], {}, 0
    per_channel = width * height * {"uint8": 1, "float16": 2}[storage]
    for i in range(0, len(channels), 3):
        group = channels[i : i + 3]
        group += [np.zeros_like(group[0])] * (0 if len(group) == 1 else 3 - len(group))
        textures[f"latents_{i // 3}"] = np.stack(group, -1)
    for name, values in (*textures.items(), *(("base_color", c) for c in colour)):
        values = values.reshape(height, width, -1)
        size += per_channel * values.shape[-1]
        with replacing(folder / f"{name}{suffix}") as temporary:
            _write(temporary, values, storage, name == "base_color")
    snippet = _snippet(bsdf, names, textures, bool(colour), suffix, to_uv)
    with replacing(folder / "material.xml") as temporary:
        temporary.write_text(snippet, encoding="utf-8")
    result = mi.load_file(str(folder / "material.xml"))
    return {
        "scene": str(path),
        "material": material,
        "quality": bsdf.report()["quality"],
        "layout": names,
        "base_color": bool(colour),
        "width": width,
        "height": height,
        "storage": storage,
        "bytes": size,
        "bytes_before": sum(_bytes(bsdf.parameter(n)) for n in (*names, *(["base_color"] if colour else []))),
        "files": [str(folder / "material.xml"), *(str(folder / f"{n}{suffix}") for n in textures)],
        **measure(bsdf, result),
    }


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


def _common_transform(path, textures: dict):
    found = {name: mi.traverse(texture).get("to_uv") for name, texture in textures.items()}
    distinct = {str(transform.matrix) for transform in found.values() if transform is not None}
    if len(distinct) != 1 or None in found.values():
        raise scenes.SceneError(
            f"{path}: the textures {', '.join(textures)} have to be bitmaps with the same to_uv to be encoded together"
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
        raise scenes.SceneError(f"the variant {mi.variant()} cannot encode colours; use an RGB variant")
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


def _snippet(bsdf, names, textures, colour: bool, suffix: str, to_uv) -> str:
    """The XML of the encoded material: its constants, and the textures."""
    m = np.array(to_uv.matrix, np.float64).reshape(3, 3)
    transform = ""
    if not np.allclose(m, np.eye(3)):
        full = np.eye(4)
        full[:2, :2], full[:2, 3] = m[:2, :2], m[:2, 2]
        matrix = " ".join(f"{v:.9g}" for v in full.ravel())
        transform = f'<transform name="to_uv"><matrix value="{matrix}"/></transform>'
    lines = [f'<bsdf version="3.0.0" type="neural_disney" id="{bsdf.id()}">']
    lines.append(f'    <string name="quality" value="{bsdf.report()["quality"]}"/>')
    constants = bsdf.constants()
    if bsdf.reflectance_name == "eta" and "specular" in constants:
        root = float(np.sqrt(SPECULAR_SCALE * constants.pop("specular")))
        constants["eta"] = (1 + root) / (1 - root)
    for name, value in constants.items():
        if name == "base_color":
            rgb = ", ".join(f"{v:.9g}" for v in value)
            lines.append(f'    <rgb name="base_color" value="{rgb}"/>')
        elif name not in names:
            lines.append(f'    <float name="{name}" value="{value:.9g}"/>')
    if names:
        lines.append(f'    <string name="latents" value="{" ".join(names)}"/>')
    files = [(name, True) for name in textures] + ([("base_color", False)] if colour else [])
    for name, raw in files:
        lines.append(f'    <texture name="{name}" type="bitmap">')
        lines.append(f'        <string name="filename" value="{name}{suffix}"/>')
        if raw:
            lines.append('        <boolean name="raw" value="true"/>')
        if transform:
            lines.append(f"        {transform}")
        lines.append("    </texture>")
    lines.append("</bsdf>")
    return "\n".join(lines) + "\n"
