"""Compressed images: reading, and their table files."""

from __future__ import annotations

import os

from ...arrays.indirection import DifferentiableArray, Indirection
from ...arrays.pages import page_counts
from ...arrays.tables import PAGES, Table, TableError, load_table, stored_arrays
from ...core.compat import module_of
from ...maps.compressed import CompressedMaps
from ...maps.layout import Layout
from ...maps.model import MapsModel, allocate_maps, page_entries
from .arrays import joined

#: Names of the primary arrays: the second, of lower resolution, is optional. The first may consist of pages.
PRIMARIES = ("primary", "coarse")
PRIMARY_PAGES = PRIMARIES[0] + PAGES


class CompressedImage(CompressedMaps):
    """A compressed image or material.

    ``layout`` lists the maps, ``net`` maps (v, u) in [0, 1]² to the stored channels. ``net`` is ``None`` if all
    channels are constant.
    """

    def __init__(self, layout: Layout, net: Indirection | None):
        self.layout, self.net = layout, net
        self.types = None if net is None else module_of(net.cascaded.data)
        self.border = ("clamp", "clamp") if net is None else net.primary[0].border

    @staticmethod
    def of(table: Table, dtype, storage: str = "") -> CompressedImage:
        """Return the image of a checked table, in a storage form (:func:`allocate`)."""
        return CompressedImage(Layout.from_json(table.settings["layout"]), joined_of(allocate(table, dtype, storage)))

    def stored(self, u, v, active=True) -> list:
        """Return the stored channels at (u, v)."""
        return [] if self.net is None else self.net([v, u], active)


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """Return the arrays of a checked table: :func:`~mi_diffind.maps.model.allocate_maps` of this task."""
    layout = Layout.from_json(table.settings["layout"])
    return allocate_maps(table, dtype, storage, lambda name: (layout.height, layout.width))


def joined_of(arrays: dict[str, DifferentiableArray]) -> Indirection | None:
    """Return the indirection of named arrays; ``None`` for no arrays."""
    return joined([arrays[name] for name in PRIMARIES if name in arrays], arrays["cascaded"]) if arrays else None


def to_table(image: CompressedImage, settings: dict) -> Table:
    """Return the table file of an image, with ``settings``."""
    named = []
    if image.net is not None:
        named = [*zip(PRIMARIES, image.net.primary, strict=False), ("cascaded", image.net.cascaded)]
    stored = {}
    for name, array in named:
        stored |= stored_arrays(name, array)
    return Table("image", stored, settings={**settings, "layout": image.layout.to_json()})


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`.TableError`."""
    table = load_table(path, "image")
    try:
        layout = Layout.from_json(table.settings["layout"])
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise TableError(f"{path}: its settings describe no image ({e})") from None
    names = set(table.arrays) - {PRIMARY_PAGES}
    expected = [{"primary", "cascaded"}, {*PRIMARIES, "cascaded"}] if layout.stored else [set()]
    if names not in expected:
        allowed = " or ".join(", ".join(sorted(e)) or "none" for e in expected)
        raise TableError(f"{path}: holds the arrays {', '.join(sorted(names)) or 'none'}, expected {allowed}")
    if not layout.stored:
        return table
    shapes = {name: array.shape for name, array in table.arrays.items() if name != PRIMARY_PAGES}
    if PRIMARY_PAGES in table.arrays:
        entries, size = shapes["primary"], (layout.height, layout.width)
        count = page_entries(table, "primary", size)
        if len(entries) != 2 or entries[0] != count:
            raise TableError(f'{path}: array "primary" has the shape {entries}, expected {count} entries of its pages')
        shapes["primary"] = (*page_counts(size), entries[-1])
    cascaded = shapes.pop("cascaded")
    pointers = sum(shape[-1] for shape in shapes.values())
    if any(len(s) != 3 for s in shapes.values()) or len(cascaded) != pointers + 1 or cascaded[-1] != layout.stored:
        raise TableError(
            f"{path}: primary arrays of the shapes {', '.join(map(str, shapes.values()))} and a cascaded array of "
            f"{cascaded} do not fit an image of {layout.stored} stored channel(s)"
        )
    for name, array in table.arrays.items():
        if name != PRIMARY_PAGES and not array.is_pointer:
            raise TableError(f'{path}: array "{name}" has entries outside of [0, 1]')
    return table


class ImageModel(MapsModel):
    """Model of an image file; ``image`` is a :class:`CompressedImage`."""

    def build(self):
        self.image = CompressedImage(Layout.from_json(self.table.settings["layout"]), joined_of(self.arrays))


MODEL = ImageModel
