"""What tests and benchmarks of training inside a scene have in common: a small material, fitted, and scenes of it."""

import dataclasses
import json
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_diffind.arrays.tables import save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import load_source
from mi_diffind.tasks.texture import PRESETS, fit
from mi_diffind.tasks.texture.arrays import TextureBudget, parse_structure

#: Maps of a material, and the parameters of the BSDF that read them.
PARAMETERS = {"albedo": "base_color", "roughness": "roughness", "metallic": "metallic"}


def material(folder: Path, side=32, seed=0, names=("albedo", "normal", "roughness")) -> Path:
    """A manifest of a repeating material: waves with noise, dents, gloss that follows the colour, half of it metal."""
    rng = np.random.default_rng(seed)
    y, x = 2 * np.pi * (np.mgrid[0:side, 0:side] + 0.5) / side
    waves = [np.sin(2 * x), np.cos(y), np.sin(x + 3 * y)]
    noise = 0.06 * rng.standard_normal((side, side))
    albedo = np.stack([0.5 + 0.3 * w + noise for w in waves], axis=-1)
    bumps = 0.35 * np.stack([np.sin(6 * x) * np.cos(2 * y), np.cos(5 * y)], axis=-1)
    normal = np.concatenate([0.5 + 0.5 * bumps, 0.5 + 0.5 * np.sqrt(1 - (bumps**2).sum(-1, keepdims=True))], axis=-1)
    maps = {
        "albedo": albedo, "normal": normal, "roughness": 0.55 + 0.2 * waves[0] + noise,
        "metallic": np.where(waves[1] > 0, 1.0, 0.0),
    }  # fmt: skip
    for name in names:
        values = np.rint(255 * np.clip(maps[name], 0, 1)).astype(np.uint8)
        mi.Bitmap(np.ascontiguousarray(values)).write(str(folder / f"{name}.png"))
    manifest = folder / "material.json"
    manifest.write_text(json.dumps({"maps": {name: f"{name}.png" for name in names}}))
    return manifest


def fitted(manifest: Path, steps=2, fine="0:2:4", skip=2, cascaded=5, batch=2048, preset="ours", size=None) -> Path:
    """A table file of a material beside its manifest."""
    source, recipe = load_source(manifest), PRESETS[preset]
    recipe = dataclasses.replace(recipe, steps=steps, batch=batch, measure_every=steps)
    layout = fit.source_layout(source, recipe)
    arrays = parse_structure(fine) if fine else ()
    size = size or TextureBudget(source.height, source.width, layout.stored, arrays, skip, 3, cascaded, skip + 1)
    types = array_module("llvm")
    pyramid = Pyramid.from_source(source, layout, types, ("repeat", "repeat"))
    request = FitRequest(preset, recipe, types, progress=False)
    table, _ = fit.fit_texture(source, size, recipe, request, pyramid)
    table.settings["source_path"] = manifest.name
    output = manifest.with_suffix(".npz")
    save_table(output, table)
    return output


def scene_file(
    file: Path, names=("albedo", "normal", "roughness"), light="directional", film=24, depth=2, more=""
) -> Path:
    """A scene beside a table file: a rectangle with its maps, seen from above at an angle; z is up."""

    def texture(parameter, name):
        return (
            f'<texture type="neural_texture" name="{parameter}"><string name="filename" value="{file.name}"/>'
            f'<string name="channels" value="{name}"/></texture>'
        )

    maps = "".join(texture(PARAMETERS[name], name) for name in names if name in PARAMETERS)
    bsdf = f'<bsdf type="neural_disney">{maps}</bsdf>'
    if "normal" in names:
        bsdf = f'<bsdf type="normalmap">{texture("normalmap", "normal")}{bsdf}</bsdf>'
    lights = {
        "directional": '<emitter type="directional" id="sun"><vector name="direction" x="0.3" y="0.5" z="-1"/>'
        '<rgb name="irradiance" value="2.5, 2.4, 2.2"/></emitter>',
        "constant": '<emitter type="constant"><rgb name="radiance" value="0.6, 0.7, 0.8"/></emitter>',
    }
    path = file.with_name(f"{file.stem}_{light}.xml")
    path.write_text(f"""<scene version="3.0.0">
    <default name="film" value="{film}"/>
    <integrator type="path"><integer name="max_depth" value="{depth}"/></integrator>
    <sensor type="perspective">
        <string name="fov_axis" value="x"/><float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, -2.2, 1.8" target="0, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$film"/><integer name="height" value="$film"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/>
        </film>
    </sensor>
    {lights[light]}
    <shape type="rectangle">{bsdf}</shape>
</scene>
""")
    return path
