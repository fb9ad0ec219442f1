"""A small material, fitted, and a scene of it."""

import dataclasses
from pathlib import Path

import numpy as np
from texture_files import write_manifest

from mi_diffind.arrays.tables import save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import load_source
from mi_diffind.tasks.texture import PRESETS, training
from mi_diffind.tasks.texture.arrays import TextureBudget, parse_structure


def material(folder: Path) -> Path:
    """A manifest of a repeating material: waves with noise, and gloss that follows the colour."""
    side = 32
    y, x = 2 * np.pi * (np.mgrid[0:side, 0:side] + 0.5) / side
    waves = [np.sin(2 * x), np.cos(y), np.sin(x + 3 * y)]
    noise = 0.06 * np.random.default_rng(0).standard_normal((side, side))
    maps = {
        "albedo": np.stack([0.5 + 0.3 * w + noise for w in waves], axis=-1),
        "roughness": 0.55 + 0.2 * waves[0] + noise,
    }
    maps = {name: np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8) for name, values in maps.items()}
    return write_manifest(folder, maps, "material.json")


def fitted(manifest: Path) -> Path:
    """A table file of a material beside its manifest, after two steps."""
    source, types = load_source(manifest), array_module("llvm")
    recipe = dataclasses.replace(PRESETS["ours"], steps=2, batch=2048, measure_every=2)
    layout = training.source_layout(source, recipe)
    size = TextureBudget(source.height, source.width, layout.stored, parse_structure("0:2:4"), 2, 3, 5, 3)
    pyramid = Pyramid.from_source(source, layout, types, ("repeat", "repeat"))
    table, _ = training.fit_texture(source, size, recipe, FitRequest("ours", recipe, types, progress=False), pyramid)
    table.settings["source_path"] = manifest.name
    output = manifest.with_suffix(".npz")
    save_table(output, table)
    return output


def scene_file(file: Path) -> Path:
    """A scene beside a table file: a rectangle with its maps under a sun, seen from above at an angle; z is up."""

    def texture(parameter, name):
        return (
            f'<texture type="neural_texture" name="{parameter}"><string name="filename" value="{file.name}"/>'
            f'<string name="channels" value="{name}"/></texture>'
        )

    maps = texture("base_color", "albedo") + texture("roughness", "roughness")
    path = file.with_name(f"{file.stem}_directional.xml")
    path.write_text(f"""<scene version="3.0.0">
    <default name="film" value="24"/>
    <integrator type="path"><integer name="max_depth" value="2"/></integrator>
    <sensor type="perspective">
        <string name="fov_axis" value="x"/><float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="0, -2.2, 1.8" target="0, 0, 0" up="0, 0, 1"/></transform>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="$film"/><integer name="height" value="$film"/>
            <string name="pixel_format" value="rgb"/><rfilter type="box"/>
        </film>
    </sensor>
    <emitter type="directional" id="sun">
        <vector name="direction" x="0.3" y="0.5" z="-1"/><rgb name="irradiance" value="2.5, 2.4, 2.2"/>
    </emitter>
    <shape type="rectangle"><bsdf type="neural_disney">{maps}</bsdf></shape>
</scene>
""")
    return path
