"""Files of the task ``texture`` without a training."""

import json

import numpy as np
from arrays import aligned
from scipy.ndimage import gaussian_filter

from mi_diffind.arrays.tables import save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks import image
from mi_diffind.tasks.image import arrays as image_arrays
from mi_diffind.tasks.image import training as image_training
from mi_diffind.tasks.texture import PRESETS, arrays, training
from mi_diffind.tasks.texture.compressed import CompressedTexture, neutral_extras, to_table


def smooth(height, width, channels, seed=0):
    """Return bytes of an image that repeats, without edges."""
    random = np.random.default_rng(seed).random((height, width, channels))
    values = gaussian_filter(random, (3, 3, 0), mode="wrap")
    values = (values - values.min()) / (values.max() - values.min())
    return np.rint(255 * values).astype(np.uint8)


def material(width, height):
    """Smooth maps of every kind, bytes, that repeat along both axes."""
    y, x = np.mgrid[0:height, 0:width] / [[[height]], [[width]]]
    wave = 0.5 + 0.35 * np.sin(2 * np.pi * np.stack([x + k * y for k in range(4)], axis=-1) + np.arange(4))
    xy = 0.6 * (wave[..., :2] - 0.5)
    normal = 0.5 + 0.5 * np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=-1, keepdims=True))], axis=-1)
    maps = {"albedo": wave[..., :3], "normal": normal, "roughness": wave[..., 3:]}
    return {name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()}


def bumpy(size=32, metallic=1.0, roughness=0.25, seed=3):
    """Maps of a material, bytes, whose normals differ from texel to texel."""
    rng = np.random.default_rng(seed)
    xy = 0.5 * rng.uniform(-1, 1, (size, size, 2))
    normal = 0.5 + 0.5 * np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=-1, keepdims=True))], axis=-1)
    albedo = np.clip(0.7 + 0.1 * rng.standard_normal((size, size, 3)), 0, 1)
    rough = np.clip(roughness + 0.05 * rng.standard_normal((size, size, 1)), 0, 1)
    maps = {"albedo": albedo, "normal": normal, "roughness": rough, "metallic": np.full((size, size, 1), metallic)}
    return {name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()}


def pyramid_of(maps, types):
    """Return the source of maps and their pyramid as ``fit texture`` has them; they repeat."""
    source = from_arrays(maps)
    layout = training.source_layout(source, PRESETS["ours"])
    return source, Pyramid.from_source(source, layout, types, ("repeat", "repeat"))


def write_manifest(folder, maps, name="m.json"):
    """Write maps of bytes as PNG files beside a manifest that names them; return the manifest's path."""
    import mitsuba as mi

    for map_name, values in maps.items():
        values = values[..., 0] if values.shape[2:] == (1,) else values
        mi.Bitmap(np.ascontiguousarray(values)).write(str(folder / f"{map_name}.png"))
    (folder / name).write_text(json.dumps({map_name: f"{map_name}.png" for map_name in maps}))
    return folder / name


def make(path, source, preset="ours", border="repeat", extras=None, **settings):
    """A file of arrays as a training starts with them, almost without loss; the paper's are random.

    ``extras``: a function that returns entries from their shape.
    """
    recipe, types = PRESETS[preset], array_module("llvm")
    pyramid = Pyramid.from_source(source, training.source_layout(source, recipe), types, (border, border))
    stored = pyramid.layout.stored
    if preset == "paper":
        size = arrays.PaperBudget(9, 12, 4, 4, stored)
    else:
        dims = min(3, stored)
        size = arrays.TextureBudget(source.height, source.width, stored, (arrays.FineArray(0, dims, 8),), 1, dims, 12)
    net, rng = training.build_problem(source, size, recipe, pyramid).net, np.random.default_rng(7)
    if preset == "paper":
        for array in net.arrays.values():
            array.data = types.TensorXf(aligned(rng.random(array.data.shape)))
    if extras is not None:
        net.extras = neutral_extras(source.height, source.width, net.border).alloc(types.TensorXf)
        net.extras.data = types.TensorXf(aligned(extras(net.extras.numpy().shape)))
    save_table(path, to_table(CompressedTexture(pyramid.layout, training.stored_form(net)), settings))
    return str(path)


def make_image(path, source, border="repeat", **settings):
    """Write a file of the task ``image`` whose arrays are those at the start of a training, almost without loss."""
    recipe, types = image.PRESETS["ours"], array_module("llvm")
    stored = image_training.source_layout(source, recipe).stored
    dims = min(3, stored)
    size = image_arrays.ImageBudget(source.height, source.width, 8, stored, dims, 8)
    problem = image_training.build_problem(source, size, recipe, types, border=(border, border))
    stored_net = image_training.stored_form(problem.net, problem.bits)
    save_table(path, image_arrays.to_table(image_arrays.CompressedImage(problem.layout, stored_net), settings))
    return str(path)
