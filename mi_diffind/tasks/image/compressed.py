"""
An image or a material as a table file holds it: a layout of its maps, and the arrays that hold its channels.
"""

from __future__ import annotations

import os

from ...compat import module_of
from ...indirection import DifferentiableArray, Indirection
from ...maps.compressed import CompressedMaps
from ...maps.layout import Layout
from ...pages import SIDE_BITS, page_counts, page_shift
from ...tables import PAGES, Table, TableError, allocate_pages, load_table, page_sides, stored_arrays
from .arrays import joined

#: Names of the primary arrays: the second is of lower resolution, and not always there. The first may have pages.
PRIMARIES = ("primary", "coarse")
PRIMARY_PAGES = PRIMARIES[0] + PAGES


class CompressedImage(CompressedMaps):
    """
    A compressed image or material: ``layout`` says which maps there are, ``net`` maps (v, u) in [0, 1]² to the stored
    channels; v runs down, (0, 0) is the upper left corner of the first texel. ``net`` is ``None`` if no channel is
    stored, since all are constant.
    """

    def __init__(self, layout: Layout, net: Indirection | None):
        self.layout, self.net = layout, net
        self.types = None if net is None else module_of(net.cascaded.data)
        self.border = ("clamp", "clamp") if net is None else net.primary[0].border

    @staticmethod
    def of(table: Table, dtype, storage: str = "") -> CompressedImage:
        """The image of a checked table, see :func:`allocate`."""
        return CompressedImage(Layout.from_json(table.settings["layout"]), joined_of(allocate(table, dtype, storage)))

    def stored(self, u, v, active=True) -> list:
        """The stored channels at (u, v)."""
        return [] if self.net is None else self.net([v, u], active)


# -- files ------------------------------------------------------------------------------------------------------------


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """
    The arrays of a checked table for the tensor type ``dtype``: as bytes, if it has them as bytes, which can be read
    only; with the ``storage`` ``"float32"``, as floats that pass through the fold, which can be optimised.
    """
    as_bytes = storage != "float32" and table.storage == "uint8"
    form = "uint8" if as_bytes else "float32"
    stored, found = dict(table.arrays), {}
    pages = stored.pop(PRIMARY_PAGES, None)
    if pages is not None:
        layout = Layout.from_json(table.settings["layout"])
        shift = page_shift((layout.height, layout.width))
        found["primary"] = allocate_pages(stored.pop("primary"), pages, dtype, shift, form, fold=True)
    return {**found, **{name: array.allocate(dtype, form, fold=True) for name, array in stored.items()}}


def joined_of(found: dict[str, DifferentiableArray]) -> Indirection | None:
    """The indirection of named arrays; ``None`` of none."""
    return joined([found[name] for name in PRIMARIES if name in found], found["cascaded"]) if found else None


def to_table(image: CompressedImage, settings: dict) -> Table:
    """The table file of an image."""
    named = []
    if image.net is not None:
        named = [*zip(PRIMARIES, image.net.primary, strict=False), ("cascaded", image.net.cascaded)]
    stored = {}
    for name, array in named:
        stored |= stored_arrays(name, array)
    return Table("image", stored, settings={**settings, "layout": image.layout.to_json()})


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`~mi_diffind.tables.TableError`."""
    table = load_table(path, "image")
    try:
        layout = Layout.from_json(table.settings["layout"])
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise TableError(f"{path}: its settings describe no image ({e})") from None
    found = set(table.arrays) - {PRIMARY_PAGES}
    expected = [{"primary", "cascaded"}, {*PRIMARIES, "cascaded"}] if layout.stored else [set()]
    if found not in expected:
        names = " or ".join(", ".join(sorted(e)) or "none" for e in expected)
        raise TableError(f"{path}: holds the arrays {', '.join(sorted(found)) or 'none'}, expected {names}")
    if not layout.stored:
        return table
    shapes = {name: array.shape for name, array in table.arrays.items() if name != PRIMARY_PAGES}
    if PRIMARY_PAGES in table.arrays:
        shapes["primary"] = _paged_shape(table, layout)
    cascaded = shapes.pop("cascaded")
    pointers = sum(shape[-1] for shape in shapes.values())
    if any(len(s) != 3 for s in shapes.values()) or len(cascaded) != pointers + 1 or cascaded[-1] != layout.stored:
        raise TableError(
            f"{path}: primary arrays of the shapes {', '.join(map(str, shapes.values()))} and a cascaded one of "
            f"{cascaded} make no image of {layout.stored} stored channel(s)"
        )
    for name, array in table.arrays.items():
        if name != PRIMARY_PAGES and not array.is_pointer:
            raise TableError(f'{path}: array "{name}" has entries outside of [0, 1]')
    return table


def _paged_shape(table: Table, layout: Layout) -> tuple:
    """The shape that the primary would have if each of its pages were an entry, after they were checked."""
    entries, pages = table.arrays["primary"], table.arrays[PRIMARY_PAGES]
    counts = page_counts((layout.height, layout.width))
    try:
        sides = page_sides(pages)
    except ValueError as e:
        raise TableError(f'{table.path}: array "{PRIMARY_PAGES}": {e}') from None
    if sides.shape != (*counts, 2) or sides.max() > 2 ** SIDE_BITS[1]:
        raise TableError(f"{table.path}: has {sides.shape} pages, an image of this size has {counts}")
    if len(entries.shape) != 2 or sides.prod(axis=2).sum() != entries.shape[0]:
        raise TableError(f"{table.path}: its pages do not have the {entries.shape[0]} entries that it holds")
    return (*counts, entries.shape[-1])
