"""Files of maps, shared between textures, and the original images of compressed files."""

from __future__ import annotations

import dataclasses
import hashlib
import shutil
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.tables import Table
from mi_diffind.core import compat
from mi_diffind.core.compat import backend_module
from mi_diffind.core.files import OutsideError, is_within, path_within, read_once, relative_path, stamp, write_json
from mi_diffind.fitting.task import Task
from mi_diffind.images.reader import PictureError, read_picture
from mi_diffind.maps.entries import IDENTITY, equal, has_maps, split_material
from mi_diffind.maps.layout import Layout, MapLayout
from mi_diffind.maps.pyramid import CompressedMaps, Pyramid
from mi_diffind.maps.source import Source, from_arrays, load_source

from .. import warn
from . import properties
from .properties import Kept, StockNode, refused_as, remove
from .tables import Tables, lock, shared
from .textures import TYPES, after_transform, transformation

STORAGES = ("uint8", "float32")

#: Task → the option that makes arrays of constants.
HOW_TO_SEPARATE = {"texture": ": fit texture --separate makes some"}

#: Kinds of maps that hold data, not colours.
DATA_ROLES = ("normal", "roughness", "ao", "metallic")

#: Steps of the fit that images of a scene get: within 2 dB of the default training.
STEPS = 300

#: Least PSNR of that fit, in dB: an RMS error of 5.6% of the range of values.
LEAST_DB = 25.0

#: Least texels along a side of an image with the filter "nearest": edges of fewer texels are seen in pictures.
LEAST_NEAREST = 256

#: Bytes of an image below which a scene's bitmap is kept: a table file takes 1 to 3 kB itself, and the training of so
#: few texels ends anywhere between 6 and 32 dB.
LEAST_BYTES = 2**12

#: Name → :class:`~mi_diffind.maps.pyramid.Pyramid`, for textures that name one (no property can hold a pyramid).
PYRAMIDS: dict[str, Pyramid] = {}


class SharedMaps:
    """Maps and their arrays (name → ``DifferentiableArray``), shared by all textures that read them.

    ``table`` is the table that they were read from, if any.
    """

    def __init__(self, image: CompressedMaps, arrays: dict, table: Table | None = None):
        self.image, self.tables = image, Tables(arrays, table)
        self._loaded = self.state()
        self._transforms = {}

    def state(self) -> list:
        """Return the present variables of the arrays; a reference keeps their indices from being used again."""
        return [dr.detach(array.data.array) for array in self.tables.exposed.values()]

    def unchanged(self, state: list) -> bool:
        """Return whether the arrays are still those of ``state``."""
        return [*map(compat.identity, state)] == [*map(compat.identity, self.state())]

    def as_loaded(self) -> bool:
        """Return whether the arrays are those of the file, and no gradient of them is enabled."""
        return self.unchanged(self._loaded) and not self.tables.optimised()

    def transform(self, matrix: list):
        """Return the transformation by a 3×3 ``matrix``, the same variable for equal matrices."""
        key = (mi.variant(), tuple(map(tuple, matrix)))
        with lock:
            if key not in self._transforms:
                self._transforms[key] = mi.AffineTransform3f(mi.ScalarAffineTransform3f(matrix))
                dr.make_opaque(self._transforms[key])
            return self._transforms[key]


def open_compressed(task: Task, props: mi.Properties) -> tuple[SharedMaps, str]:
    """Return the maps that the properties ``filename`` and ``storage`` name, and the path of the file.

    ``task`` is one whose models have an ``image``. The maps are shared by all textures that have the file open, unless
    their arrays have been changed since. Raises ``RuntimeError``.
    """
    path = properties.filename(props)
    if not path:
        raise RuntimeError('parameter "filename": not given, a compressed image (.npz) is needed')
    storage = properties.one_of(props, "storage", STORAGES)
    props.get("source", "")  # only the exact counterpart needs it

    def load() -> SharedMaps:
        model = task.read(path, mi.TensorXf, storage)
        constant = [m.name for m in model.image.layout.maps if not m.varies]
        if storage == "float32" and constant:
            warn(
                f'parameter "storage": found "float32", but {path} has constants in place of the maps '
                f"{', '.join(constant)}, no arrays to optimise{HOW_TO_SEPARATE.get(task.name, '')}"
            )
        return SharedMaps(model.image, model.arrays, model.table)

    with refused_as("filename"):
        key = task.name, str(Path(path).resolve()), *stamp(path), storage, mi.TensorXf
        return shared(key, load, SharedMaps.as_loaded), path


def open_uncompressed(props: mi.Properties, wrap_mode: str) -> tuple[SharedMaps, str]:
    """Return the mip pyramid that the properties name, and the path of its file ("" without a file).

    ``filename`` names an image or a manifest, ``bitmap`` is an object, ``pyramid`` names one of :data:`PYRAMIDS`. With
    ``raw``, sRGB values are not converted. Raises ``RuntimeError``.
    """
    path = properties.filename(props)
    given = [name for name in ("filename", "bitmap", "pyramid") if name in props and (name != "filename" or path)]
    if len(given) != 1:
        names = " and ".join(f'"{name}"' for name in given) or "none"
        raise RuntimeError(f'parameters "filename", "bitmap" and "pyramid": found {names}, exactly one is needed')
    raw = props.get("raw", False) is True
    types, border = backend_module(mi.TensorXf), ("repeat" if wrap_mode == "repeat" else "clamp",) * 2
    if given == ["pyramid"]:
        name = str(props["pyramid"])
        if name not in PYRAMIDS:
            names = ", ".join(f'"{n}"' for n in PYRAMIDS) or "none"
            raise RuntimeError(f'parameter "pyramid": found "{name}", allowed are the keys of PYRAMIDS: {names}')
        pyramid = PYRAMIDS[name]
        if pyramid.types is not types:
            pyramid = Pyramid(pyramid.layout, pyramid.values, types, pyramid.border)
        return shared(("pyramid", id(pyramid)), lambda: SharedMaps(pyramid, {}), SharedMaps.as_loaded), ""

    def load() -> SharedMaps:
        # A single image without "raw" is colours, whatever its name, as for Mitsuba's "bitmap"
        source = load_source(path, nonfinite="clean", named=raw) if path else _from_bitmap_object(props["bitmap"])
        for note in source.notes if has_maps(path) else ():
            warn(note)
        if raw:
            maps = tuple(dataclasses.replace(m, color_space="linear") for m in source.maps)
            source = dataclasses.replace(source, maps=maps)
        return SharedMaps(Pyramid.from_source(source, types=types, border=border), {})

    with refused_as(given[0]):
        key = str(Path(path).resolve()), *stamp(split_material(path)[0]), raw, border, mi.TensorXf
        return shared(key, load, SharedMaps.as_loaded) if path else load(), path


def _from_bitmap_object(bitmap) -> Source:
    """Return a ``mi.Bitmap`` as a source of one map, ``image``, without alpha."""
    if not isinstance(bitmap, mi.Bitmap):
        raise RuntimeError(f'parameter "bitmap": found a {type(bitmap).__name__}, a Bitmap is needed')
    values = np.array(bitmap)
    values = values.reshape(*values.shape[:2], -1)
    values = values[..., : 3 if values.shape[2] > 3 else 1 if values.shape[2] == 2 else None]
    return from_arrays({"image": values}, {"image": "srgb" if bitmap.srgb_gamma() else "linear"}, nonfinite="clean")


def choose_map(layout: Layout, channels: str) -> MapLayout:
    """Return the map called ``channels``; if that is empty, the only map, or the only albedo."""
    names = ", ".join(layout.names)
    candidates = [m for m in layout.maps if m.name == channels or not channels]
    if not candidates:
        raise RuntimeError(f'parameter "channels": found "{channels}", the file holds {names}')
    if len(candidates) > 1:
        candidates = [m for m in candidates if m.role == "albedo"]
    if len(candidates) != 1:
        raise RuntimeError(f'parameter "channels": not given, and the file holds several maps: {names}')
    (chosen,) = candidates
    if chosen.channels not in (1, 3):
        raise RuntimeError(
            f'parameter "channels": the map "{chosen.name}" has {chosen.channels} channels, a texture has 1 or 3'
        )
    return chosen


def is_data(layout: MapLayout) -> bool:
    """Return whether a map holds data, which are never converted; ``raw`` is then true by default."""
    return layout.role in DATA_ROLES and layout.color_space == "linear"


def to_bitmap(task: Task, props: mi.Properties) -> None:
    """Add the properties that a ``bitmap`` needs to show the original of the map."""
    original, layout = find_original(task, props)
    values = _values(original, layout)
    # Bytes stay bytes; 16 bits become float32, since "bitmap" would reduce them to half precision
    bitmap = mi.Bitmap(np.rint(values * 255).astype(np.uint8) if layout.depth == 1 else np.array(values, order="C"))
    bitmap.set_srgb_gamma(layout.color_space == "srgb")
    props["bitmap"] = bitmap
    if layout.transform != IDENTITY:
        props["to_uv"] = mi.ScalarAffineTransform3f(after_transform(layout.transform, transformation(props)))
    props["raw"] = bool(props.get("raw", is_data(layout)))


def to_mipmap(task: Task, props: mi.Properties) -> None:
    """Add the properties that a ``mipmap`` needs to show the original of the map."""
    original, layout = find_original(task, props)
    manifest = has_maps(original)
    if not manifest and layout.role == "other":  # linear by the name of its file
        to_bitmap(task, props)
        remove(props, "filename", "channels")
        return
    props["filename"] = str(original)
    remove(props, "channels")
    if manifest:
        props["channels"] = layout.name
    if "raw" not in props and is_data(layout):
        props["raw"] = True


def find_original(task: Task, props: mi.Properties) -> tuple[Path, MapLayout]:
    """Return the path of the image or manifest that a task's file was made from, and the map that is shown.

    The property ``source`` names the original, else the settings of the file do. Raises ``RuntimeError``.
    """
    chosen = choose_map(file_layout(task, props), str(props.get("channels", "")))
    path = Path(properties.filename(props))
    settings = task.load(path).settings
    given, recorded = str(props.get("source", "")), str(settings.get("source_path", ""))
    if not given and not recorded:
        raise RuntimeError(f'{path}: does not record its original image, give it as the parameter "source"')
    original = Path(str(mi.file_resolver().resolve(given))) if given else path.parent / recorded
    if not split_material(original)[0].exists():
        advice = "" if given else '; if it was moved, give its path as the parameter "source"'
        raise RuntimeError(f"{original}: no such file, {path.name} was made from it{advice}")
    # A stranger's file must not show any file of this machine
    outside = not given and not is_within(path.parent, recorded)
    if outside and read_once(_digest, original) != settings.get("source"):
        raise RuntimeError(f"{original}: has changed since {path.name} was made from it")
    return original, chosen


def file_layout(task: Task, props: mi.Properties) -> Layout:
    """Return the layout of the file that the property ``filename`` names."""
    with refused_as():
        return Layout.from_json(task.load(properties.filename(props)).settings["layout"])


def fit_images(
    task: Task, node: StockNode, images: dict[str, StockNode], numbers: tuple[str, ...] = (), **options
) -> tuple[Table, str]:
    """Fit the ``bitmap`` of each map, by its name, together; return the table and a text about it.

    The properties ``wrap_mode`` of all are equal. Maps of ``numbers`` have one channel. Raises :class:`.Kept`.
    """
    maps, nearest = {}, False
    for name, image in images.items():
        image.allow("filename", "raw", "to_uv", "wrap_mode", "filter_type", "format", "accel")
        filter_type = str(image.props.get("filter_type", "bilinear"))
        if filter_type not in (*TYPES, "nearest"):
            raise Kept(f'has the filter_type "{filter_type}", allowed are {", ".join(TYPES)}')
        least = LEAST_NEAREST if filter_type == "nearest" else 1
        maps[name] = image.file(), image.props.get("raw", False) is True, least
        nearest |= least > 1
    source, first = write_manifest(node.folder, maps, numbers), next(iter(images.values())).props
    border = "repeat" if str(first.get("wrap_mode", "repeat")) == "repeat" else "clamp"
    table = node.fit(task.name, source, steps=STEPS, border=border, **options)
    quality = f"{table.measured['psnr_db']:.1f} dB{', nearest texels are interpolated' if nearest else ''}"
    if table.measured["psnr_db"] < LEAST_DB:
        names = ", ".join(dict.fromkeys(file.name for file, *_ in maps.values()))
        raise Kept(f"{names} would have {quality}, at least {LEAST_DB:g} are needed: fit it by hand, with more bytes")
    return table, f"{table.path.name}, {quality}"


def write_manifest(folder: Path, maps: dict[str, tuple[Path, bool, int]], numbers: tuple[str, ...] = ()) -> Path:
    """Write a manifest of images as ``bitmap`` reads them, and return its path.

    ``maps``: name of a map → its image, whether its values are left as they are (``raw``), and the least number of
    texels along a side; maps of ``numbers`` have one channel. Raises :class:`.Kept` for a picture that cannot be read,
    for colours in place of numbers, and for fewer bytes than :data:`LEAST_BYTES`.
    """
    entries, nbytes = {}, 0
    for name, (image, raw, least) in maps.items():
        try:
            picture = read_picture(image)
        except PictureError as e:
            raise Kept(f"{image.name}: {str(e).removeprefix(f'{image}: ')}") from None
        if min(picture.values.shape[:2]) < least:
            raise Kept(f'has the filter_type "nearest" and fewer than {least} texels a side, whose edges would be lost')
        nbytes += picture.values.nbytes
        space = "srgb" if picture.srgb and not raw else "linear"
        entries[name] = {"file": relative_path(image, folder), "color_space": space}
        colours = picture.values[:, :, : picture.colors]
        if name in numbers and picture.colors > 1 and not equal(colours):
            raise Kept(f'has the image {image.name} with colours for "{name}", which is a number')
        if picture.has_alpha or name in numbers:
            entries[name]["channels"] = "rgb" if picture.colors == 3 and name not in numbers else "r"
    image = next(iter(maps.values()))[0]
    if nbytes < LEAST_BYTES:
        raise Kept(f"{image.name} has {nbytes:,} bytes, of which no fit would save any")
    digest = hashlib.sha256(str(entries).encode()).hexdigest()[:12]
    path = folder / f"{image.stem}_{digest}.json"
    for name, entry in entries.items():
        try:
            path_within(folder, entry["file"], path)
        except OutsideError:
            link = folder / f"{image.stem}_{digest}_{name}{maps[name][0].suffix}"
            _link(link, entry["file"])
            entry["file"] = link.name
    write_json(path, {"maps": entries})
    return path


def _link(link: Path, target: str) -> None:
    """Make a symbolic link to a file at ``target``, relative to the link's folder; a copy where there are no links."""
    link.unlink(missing_ok=True)
    try:
        link.symlink_to(target)
    except OSError:
        shutil.copyfile(link.parent / target, link)


def _digest(path: Path) -> str:
    """Return the digest of an image or manifest."""
    with refused_as():
        return load_source(path, nonfinite="clean").digest


def _values(original: Path, layout: MapLayout) -> np.ndarray:
    """Return the values of the map in its source, ``(height, width, channels)``."""
    with refused_as():
        maps = load_source(original, nonfinite="clean").maps
    named = [m for m in maps if m.name == layout.name]
    if has_maps(original) and not named:
        raise RuntimeError(f'{original}: holds no map "{layout.name}", only {", ".join(m.name for m in maps)}')
    values = (named or maps)[0].values
    if layout.channels == 1 and values.shape[2] == 3 and (values == values[..., :1]).all():
        values = values[..., :1]
    if values.shape[2] != layout.channels:
        raise RuntimeError(
            f'{original}: has {values.shape[2]} channel(s), the map "{layout.name}" has {layout.channels}'
        )
    return values
