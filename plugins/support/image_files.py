"""Files of maps as textures share them, and the originals that compressed ones were made from."""

from __future__ import annotations

import dataclasses
import threading
import weakref
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind import compat
from mi_diffind.compat import module_of
from mi_diffind.maps.compressed import CompressedMaps
from mi_diffind.maps.layout import Layout, MapLayout
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import Source, SourceError, from_arrays, load_source
from mi_diffind.tables import TableError
from mi_diffind.task import Task, stamp

from . import properties
from .tables import exposed

STORAGES = ("uint8", "float32")

#: Kinds of maps that hold data, not colours.
DATA_ROLES = ("normal", "roughness", "ao", "metallic")

#: Pyramids that a texture may name: name → :class:`~mi_diffind.maps.pyramid.Pyramid`. (No property can hold one.)
PYRAMIDS: dict[str, Pyramid] = {}

_cache: weakref.WeakValueDictionary = weakref.WeakValueDictionary()
_lock = threading.RLock()  # a thread that waits for a kernel may go on with another constructor


class SharedMaps:
    """
    Maps and the arrays that hold them (name → ``DifferentiableArray``), the same Dr.Jit variables for all textures that
    read them, and what else these share.
    """

    def __init__(self, image: CompressedMaps, arrays: dict, preset: str):
        self.image, self.arrays, self.preset = image, arrays, preset
        self._loaded = self.state()
        self._transforms = {}

    @property
    def tables(self) -> dict:
        """The arrays that can be optimised, by name."""
        return exposed(self.arrays)

    def state(self) -> list:
        """What the arrays hold at present; keeps it alive, so that nothing else gets its index."""
        return [dr.detach(array.data.array) for array in self.tables.values()]

    def unchanged(self, state: list) -> bool:
        """Do the arrays hold what they held then?"""
        return [*map(compat.identity, state)] == [*map(compat.identity, self.state())]

    def as_loaded(self) -> bool:
        """Do the arrays hold what the file holds, and is nobody about to change that?"""
        return self.unchanged(self._loaded) and not any(compat.has_gradient(a.data) for a in self.tables.values())

    def transform(self, matrix: list):
        """
        The transformation by a 3×3 ``matrix``: one and the same variable for equal ones, so that the reads of several
        textures are recognised as one.
        """
        key = (mi.variant(), tuple(map(tuple, matrix)))
        with _lock:
            if key not in self._transforms:
                found = mi.AffineTransform3f(mi.ScalarAffineTransform3f(matrix))
                dr.make_opaque(found)
                self._transforms[key] = found
            return self._transforms[key]


def open_file(task: Task, path: str | Path, storage: str) -> SharedMaps:
    """
    The maps in a file of a task whose models have an ``image``, shared with everybody who has them open, unless they
    have been changed since. Raises ``TableError``.
    """
    path = Path(path)

    def load():
        model = task.model(task.load(path), mi.TensorXf, storage)
        return SharedMaps(model.image, model.arrays, model.table.preset)

    return shared((task.name, str(path.resolve()), *stamp(path), storage, mi.TensorXf), load)


def shared(key: tuple, load: Callable[[], SharedMaps]) -> SharedMaps:
    """What ``load()`` made for this ``key``, as long as somebody has it and has not changed it."""
    with _lock:
        found = _cache.get(key)
        if found is None or not found.as_loaded():
            found = _cache[key] = load()
        return found


def open_compressed(task: Task, props: mi.Properties) -> tuple[SharedMaps, str]:
    """The maps that the properties ``filename`` and ``storage`` of a texture name, and the path of the file."""
    path = properties.filename(props)
    if not path:
        raise RuntimeError('parameter "filename": not given, a compressed image (.npz) is needed')
    storage = properties.one_of(props, "storage", STORAGES)
    props.get("source", "")  # of use to the exact counterpart only
    try:
        return open_file(task, path, storage), path
    except TableError as e:
        raise RuntimeError(f'parameter "filename": {e}') from None


def open_uncompressed(props: mi.Properties, wrap_mode: str) -> tuple[SharedMaps, str]:
    """
    The mip pyramid of what the property ``filename`` names, an image or a manifest, of the object ``bitmap``, or that
    one of :data:`PYRAMIDS` that ``pyramid`` names; and the path of the file, "" without. With ``raw``, nothing is taken
    for sRGB.
    """
    given = [name for name in ("filename", "bitmap", "pyramid") if name in props]
    if len(given) != 1:
        found = " and ".join(f'"{name}"' for name in given) or "none"
        raise RuntimeError(f'parameters "filename", "bitmap" and "pyramid": found {found}, one of them is needed')
    raw = props.get("raw", False) is True
    types, border = module_of(mi.TensorXf), ("repeat" if wrap_mode == "repeat" else "clamp",) * 2
    if given == ["pyramid"]:
        name = str(props["pyramid"])
        if name not in PYRAMIDS:
            known = ", ".join(f'"{n}"' for n in PYRAMIDS) or "none"
            raise RuntimeError(f'parameter "pyramid": found "{name}", there are {known} (support.image_files.PYRAMIDS)')
        pyramid = PYRAMIDS[name]
        if pyramid.types is not types:
            pyramid = Pyramid(pyramid.layout, pyramid.values, types, pyramid.border)
        return shared(("pyramid", id(pyramid)), lambda: SharedMaps(pyramid, {}, "")), ""

    def load() -> SharedMaps:
        source = load_source(path, nonfinite="clean") if path else _source_of(props["bitmap"])
        if raw:
            maps = tuple(dataclasses.replace(m, color_space="linear") for m in source.maps)
            source = dataclasses.replace(source, maps=maps)
        return SharedMaps(Pyramid.of(source, types=types, border=border), {}, "")

    path = properties.filename(props)
    try:
        if not path:
            return load(), ""
        return shared((str(Path(path).resolve()), *stamp(Path(path)), raw, border, mi.TensorXf), load), path
    except SourceError as e:
        raise RuntimeError(f'parameter "{given[0]}": {e}') from None


def _source_of(bitmap) -> Source:
    """A ``mi.Bitmap`` as a source of one map, ``image``."""
    if not isinstance(bitmap, mi.Bitmap):
        raise RuntimeError(f'parameter "bitmap": found a {type(bitmap).__name__}, a Bitmap is needed')
    values = np.array(bitmap)
    values = values.reshape(*values.shape[:2], -1)
    values = values[..., : 3 if values.shape[2] > 3 else 1 if values.shape[2] == 2 else None]  # without alpha
    return from_arrays({"image": values}, {"image": "srgb" if bitmap.srgb_gamma() else "linear"}, nonfinite="clean")


def map_of(layout: Layout, channels: str) -> MapLayout:
    """The map called ``channels``; if that is empty, the only one, or the only one that holds colours."""
    if channels and channels not in layout.names:
        raise RuntimeError(f'parameter "channels": found "{channels}", the file holds {", ".join(layout.names)}')
    if channels:
        found = layout[channels]
    else:
        candidates = layout.maps if len(layout.maps) == 1 else [m for m in layout.maps if m.role == "albedo"]
        if len(candidates) != 1:
            names = ", ".join(layout.names)
            raise RuntimeError(f'parameter "channels": not given, and the file holds several maps: {names}')
        found = candidates[0]
    if found.channels not in (1, 3):
        raise RuntimeError(
            f'parameter "channels": the map "{found.name}" has {found.channels} channels, a texture has 1 or 3'
        )
    return found


def is_data(layout: MapLayout) -> bool:
    """Does a map hold data that are never converted, so that ``raw`` is its default?"""
    return layout.role in DATA_ROLES and layout.color_space == "linear"


# -- the exact counterpart ---------------------------------------------------------------------------------------------


def to_bitmap(task: Task, props: mi.Properties) -> None:
    """Give the properties of a texture of a task's file what a ``bitmap`` needs to show the original of its map."""
    original, found = original_of(task, props)
    try:
        values = _values(original, found)
    except SourceError as e:
        raise RuntimeError(str(e)) from None
    # A byte is what it was; of half precision, which "bitmap" would make of 16 bits, the texture knows nothing
    bitmap = mi.Bitmap(np.rint(values * 255).astype(np.uint8) if found.depth == 1 else np.ascontiguousarray(values))
    bitmap.set_srgb_gamma(found.color_space == "srgb")
    props["bitmap"] = bitmap
    props["raw"] = bool(props.get("raw", is_data(found)))


def to_mipmap(task: Task, props: mi.Properties) -> None:
    """Give the properties of a texture of a task's file what a ``mipmap`` of the original of its map needs."""
    original, found = original_of(task, props)
    props["filename"] = str(original)
    if original.suffix.lower() == ".json":
        props["channels"] = found.name
    elif "channels" in props:
        del props["channels"]
    if "raw" not in props and is_data(found):
        props["raw"] = True


def original_of(task: Task, props: mi.Properties) -> tuple[Path, MapLayout]:
    """The image or manifest that a task's file was made from, and the map of it that the properties mean."""
    path = Path(properties.filename(props))
    try:
        table = task.load(path)
    except TableError as e:
        raise RuntimeError(str(e)) from None
    found = map_of(Layout.from_json(table.settings["layout"]), str(props.get("channels", "")))
    return _original(props, path, table.settings), found


def _original(props, path: Path, settings: dict) -> Path:
    given, recorded = str(props.get("source", "")), str(settings.get("source_path", ""))
    if given:
        found = Path(str(mi.file_resolver().resolve(given)))
    elif recorded:
        found = path.parent / recorded
    else:
        raise RuntimeError(f'{path}: does not say what it was made from, which is what the parameter "source" is for')
    if not found.is_file():
        advice = "" if given else '; the parameter "source" may say where it is now'
        raise RuntimeError(f"{found}: no such file, {path.name} was made from it{advice}")
    return found


def _values(original: Path, layout: MapLayout) -> np.ndarray:
    """The map as it is in its source, ``(height, width, channels)``."""
    maps = load_source(original, nonfinite="clean").maps
    named = [m for m in maps if m.name == layout.name]
    if original.suffix.lower() == ".json" and not named:
        raise RuntimeError(f'{original}: holds no map "{layout.name}", only {", ".join(m.name for m in maps)}')
    values = (named or maps)[0].values
    if layout.channels == 1 and values.shape[2] == 3 and (values == values[..., :1]).all():
        values = values[..., :1]
    if values.shape[2] != layout.channels:
        raise RuntimeError(
            f'{original}: has {values.shape[2]} channel(s), the map "{layout.name}" has {layout.channels}'
        )
    return values
