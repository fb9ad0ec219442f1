"""Table files of maps: their arrays, their pages, and the maps as a model that is measured and decoded."""

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType

import numpy as np

from ..arrays.budget import Budget
from ..arrays.indirection import DifferentiableArray
from ..arrays.pages import SIDE_BITS, page_counts, page_shift
from ..arrays.tables import MAX_BYTES, PAGES, Table, TableError, allocate_pages, page_sides
from ..core import units
from ..core.errors import UsageError, printable, raised_as
from ..core.files import replacing
from ..core.threads import threads_for_files
from ..fitting.loop import FitResult, Problem
from ..fitting.task import FitRequest, Fitted, Model, significant
from ..images import srgb
from . import as_seen
from .entries import describe_transform
from .layout import Layout
from .pyramid import CompressedMaps, map_figure
from .source import Source, load_source


def allocate_maps(
    table: Table, dtype, storage: str, size_of: Callable[[str], tuple[int, int]]
) -> dict[str, DifferentiableArray]:
    """Return the arrays of a checked table for the tensor type ``dtype``, by name.

    Arrays of bytes stay bytes, which can only be read; with the ``storage`` ``"float32"`` they become floats that pass
    through the fold and can be optimised. ``size_of(name)`` returns rows and columns of the image that an array of
    pages covers.
    """
    entry_type = "uint8" if storage != "float32" and table.storage == "uint8" else "float32"
    arrays = {}
    for name, array in table.arrays.items():
        pages = table.arrays.get(name + PAGES)
        if pages is not None:
            arrays[name] = allocate_pages(array, pages, dtype, page_shift(size_of(name)), entry_type, fold=True)
        elif not name.endswith(PAGES):
            arrays[name] = array.allocate(dtype, entry_type, fold=True)
    return arrays


def read_layout(table: Table) -> Layout:
    """Return the layout of the maps in a table. Raises :class:`TableError` for damaged settings."""
    try:
        return Layout.from_json(table.settings["layout"])
    except (KeyError, TypeError, ValueError, OverflowError) as e:
        raise TableError(f"{table.path}: its settings describe no {table.task} ({e})") from None


def check_arrays(table: Table, shapes: Mapping[str, tuple], pages: Mapping[str, tuple[int, int]]) -> None:
    """Raise :class:`TableError` unless a table holds arrays of these ``shapes``, of numbers in [0, 1].

    ``None`` in a shape stands for any number. ``pages`` maps the names of arrays of pages to the rows and columns of
    the image that they cover; the first number of their shapes is that of all their entries.
    """
    path, expected = table.path, {*shapes, *(name + PAGES for name in pages)}
    if set(table.arrays) != expected:
        names, wanted = (", ".join(sorted(n)) or "none" for n in (table.arrays, expected))
        raise TableError(f"{path}: holds the arrays {names}, expected {wanted}")
    for name, shape in shapes.items():
        array = table.arrays[name]
        if name in pages:
            shape = (_page_entries(table, name, pages[name]), shape[-1])
        if len(array.shape) != len(shape) or any(w not in (None, n) for n, w in zip(array.shape, shape, strict=True)):
            text = " x ".join("N" if n is None else str(n) for n in shape)
            raise TableError(f'{path}: array "{name}" has the shape {array.shape}, expected {text}')
        if not array.is_pointer:
            raise TableError(f'{path}: array "{name}" has entries outside of [0, 1]')


def _page_entries(table: Table, name: str, size: tuple[int, int]) -> int:
    """Return the number of entries of the pages of an array, on an image of ``size``. Raises :class:`TableError`."""
    pages, counts, largest = table.arrays[name + PAGES], page_counts(size), 2 ** SIDE_BITS[1]
    where = f'{table.path}: array "{name}{PAGES}"'
    with raised_as(TableError, ValueError, at=where):
        sides = page_sides(pages)
    if sides.shape != (*counts, 2):
        raise TableError(f"{where} has the shape {sides.shape}, expected {(*counts, 2)}")
    if sides.max() > largest:
        raise TableError(f"{where} has a page of {sides.max()} entries along an axis, allowed are {largest}")
    return int(sides.prod(axis=2).sum())


def requested_bytes(options, source: Source) -> int:
    """Return the bytes of the options :data:`SIZES`, by default a twelfth of the source's. Raises UsageError."""
    given = {name: options[name] for name in ("compression", "bytes", "bpp") if options[name] is not None}
    if len(given) > 1:
        raise UsageError(f"size: found {', '.join(given)}, give exactly one of compression, bytes and bpp")
    if "bytes" in given:
        units.check_size("--bytes", given["bytes"], MAX_BYTES)
        return given["bytes"]
    wanted = given["bpp"] * source.texels / 8 if "bpp" in given else source.nbytes / given.get("compression", 12)
    if not math.isfinite(wanted):
        name, value = next(iter(given.items()))
        raise UsageError(f"size: {name} {value} is out of range".replace("e+", "e"))
    return max(1, round(wanted))


def requested_border(options) -> tuple[str, str] | None:
    """Return the border along v and u of the options :data:`SOURCES`; ``None`` if it is chosen by the content."""
    return None if options["border"] == "auto" else (options["border"],) * 2


def size_figures(source: Source, table, requested: float | None, spare: float = 0) -> tuple[dict, list[str]]:
    """Return the sizes of a trained table for ``--json``, and lines of text; ``requested`` are the bytes wanted.

    ``spare`` bytes of these were for arrays that the table could have had.
    """
    achieved = source.nbytes / table.nbytes if table.nbytes else None
    figures = {
        "source_bytes": source.nbytes,
        "compression": achieved,
        "compression_asked": source.nbytes / requested if requested else None,
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
    }
    wanted = f" ({source.nbytes / requested:.2f}x requested)" if requested else ""
    figures["bits_per_texel"] = 8 * table.nbytes / source.texels
    size = f"{achieved:.2f}x" if achieved else "of one colour"
    lines = [f"{size}{wanted}, {figures['bits_per_texel']:.2f} bits a texel"]
    if 0 < source.file_nbytes < table.nbytes:
        lines.append(
            f"the files of the source have {source.file_nbytes:,} bytes, fewer than these arrays ({table.nbytes:,}); "
            f"in the memory of a renderer they take {source.nbytes:,}"
        )
    if requested and achieved and not Budget(requested).is_met(table.nbytes + spare):
        asked, actual = f"{round(requested):,} bytes were requested", f"{table.nbytes:,}"
        lines.append(f"{asked}, but {actual} are the nearest that the arrays of this image allow")
    return figures, lines


def preview_path(request) -> Path | None:
    """Return the file of :data:`PREVIEW`: the given one, or ``…_preview.png`` beside the output (``None`` without)."""
    if request.options["preview"] is not None:
        return Path(request.options["preview"])
    return None if request.output is None else request.output.with_name(f"{request.output.stem}_preview.png")


class MapsProblem(Problem):
    """Base class of training problems of maps.

    ``net`` returns the stored channels of ``layout``. ``weights`` are factors of the differences of maps, by name.
    """

    harmless = 1e-2  # of values in [0, 1]

    def __init__(self, net, layout: Layout, recipe, types: ModuleType, weights: Mapping[str, float] | None = None):
        self.net, self.layout, self.recipe, self.types = net, layout, recipe, types
        self.groups, factors = layout.channels_by_map(), weights or {}
        self.weights = {
            name: factors.get(name, 1.0) ** 2 * len(channels) / layout.stored for name, channels in self.groups.items()
        }
        self.jittered = False
        self._strata = {}  # by the size of a batch

    def begin(self, step: int, share: float) -> str:
        """Start a step: decide whether its samples are jittered. Returns a text that names the decision."""
        jitter = self.recipe.jitter
        self.jittered = int((step + 1) * jitter) > int(step * jitter)
        return f"jittered: {self.jittered}"

    def by_map(self, channels: list) -> dict[str, list]:
        """Return stored channels in groups, by the name of their map."""
        return {name: [channels[i] for i in indices] for name, indices in self.groups.items()}


def strata(texels: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first texel, and the number of texels, of each of ``samples`` equal parts of ``texels``."""
    edges = np.arange(samples + 1, dtype=np.uint64) * np.uint64(texels) // np.uint64(max(1, samples))
    return edges[:-1], np.maximum(np.diff(edges), 1)


def fit_maps(
    request: FitRequest,
    source: Source,
    problem: Problem | None,
    stored: Callable[[], CompressedMaps],
    to_table: Callable[[CompressedMaps, dict], Table],
    read: Callable[[Table, type], CompressedMaps],
    title: str | None = None,
    **more,
) -> tuple[Table, FitResult]:
    """Train a ``problem`` of maps and return the table, with its errors, and the record of the training.

    ``problem`` is ``None`` for maps of one colour each, which need no arrays. ``stored()`` returns the maps as they are
    stored, ``to_table(maps, settings)`` their table, and ``read(table, dtype)`` reads it. ``more`` are further settings
    of the table. Errors are those of :meth:`.CompressedMaps.measure`.
    """

    def errors(table: Table) -> dict[str, float]:
        return read(table, request.types.TensorXf).measure(source)

    if problem is None:
        table, result = to_table(stored(), {"source": source.digest}), FitResult({}, 0, 0, 0.0, False, 0)
    else:
        result = FitResult({}, 0, 0, 0.0, False, 0)
        if request.settings.steps:
            result = request.train(problem, title, lambda: errors(to_table(stored(), problem.identity)))
        table = to_table(stored(), {**request.recorded(result), **problem.identity, **more})
    table.preset, table.seed = request.preset, request.settings.seed
    table.measured = significant(errors(table))
    return table, result


def load_maps(request: FitRequest) -> Source:
    """Load the source of a request, and print of which files its maps are made. Raises :class:`.SourceError`."""
    source = load_source(request.options["source"], nonfinite=request.options["nonfinite"], outside=True)
    if request.progress and isinstance(request.options["source"], (str, os.PathLike)) and len(source.maps) > 1:
        print("\n".join(map(printable, origin_lines(source))))
    return source


def origin_lines(source: Source) -> list[str]:
    """Return a table of the file, channels, color space, factor and change of each map of a source."""
    rows = [[name.replace("_", " ") for name in source.origins[0]], *(list(row.values()) for row in source.origins)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:{n}}" for cell, n in zip(row, widths, strict=True)).rstrip() for row in rows]


def rehearse_pictures(request: FitRequest, source: Source) -> None:
    """Render the pictures of a source before a training whose time is limited: their measurement takes as long."""
    if request.deadline is not None and as_seen.shows(source):
        request.deadline.rehearse(lambda: as_seen.reference(source, request.types))


def complete(
    request: FitRequest, source: Source, fitted: Fitted, image: CompressedMaps, requested: float | None,
    spare: float = 0,
) -> Fitted:  # fmt: skip
    """Add to the result of a training what pictures, sizes (:func:`size_figures`) and the source say."""
    fitted.table.measured |= significant(as_seen.measure(source, image))
    fitted.table.settings |= request.paths(source_path=request.options["source"])
    figures, lines = size_figures(source, fitted.table, requested, spare)
    fitted.lines += [*lines, *source.notes]
    fitted.figures = {**figures, "origins": list(source.origins), **fitted.figures}
    return fitted


class MapsModel(Model):
    """Maps in a table file; ``image`` reads them. Base class of the models of image and texture files."""

    image: CompressedMaps

    @property
    def source_path(self) -> Path:
        """Path of the source when it was compressed. Raises :class:`TableError` if the file has none."""
        recorded = self.table.settings.get("source_path")
        if recorded is None:
            where = self.table.path or "the tables"
            raise TableError(f"{where}: no source file is recorded, so errors need a source: measure(source)")
        return Path(self.table.path or "").parent / str(recorded)

    def describe(self):
        layout, table, maps = self.image.layout, self.table, {}
        ratio = layout.source_nbytes / table.nbytes if table.nbytes else None
        size = f"{layout.width} x {layout.height}, {layout.stored} channel(s) stored of "
        size += f"{sum(m.channels for m in layout.maps)}, {layout.source_nbytes:,} bytes uncompressed: "
        lines = [size + (f"{ratio:.2f}x" if ratio else "of one colour"), f"{self.memory_nbytes:,} bytes in memory"]
        for m in layout.maps:
            psnr = table.measured.get(map_figure(m.name))
            stored = [w if isinstance(w, int) else "from x and y" if w == "z" else f"is {w[1]:.4g}" for w in m.where]
            content = {"role": m.role, "channels": m.channels, "color_space": m.color_space}
            content["transform"] = list(m.transform)
            maps[m.name] = {**content, "stored_as": stored, "psnr_db": psnr}
            error = f", {psnr:.2f} dB" if psnr is not None else ""
            kept = ", ".join(filter(None, (*map(str, stored), describe_transform(m.transform))))
            lines.append(f"  {m.name:20} {m.role}, {m.channels} channel(s), {m.color_space}, stored as {kept}{error}")
        lines += ["  the material is double-sided"] * layout.double_sided
        figures = {"width": layout.width, "height": layout.height, "source_bytes": layout.source_nbytes}
        figures["double_sided"] = layout.double_sided
        return {**figures, "memory_bytes": self.memory_nbytes, "compression": ratio, "maps": maps}, lines

    def measure(self, source=None) -> dict[str, float]:
        """Return the errors against ``source`` (default: the recorded file).

        They are those of :meth:`.CompressedMaps.measure` and of :func:`.as_seen.measure`.

        ``source`` is a file or maps in memory, as :func:`.source.load_source` takes them.
        """
        if source is not None:
            source = load_source(source, nonfinite="clean")
        else:
            path = self.source_path
            source = load_source(path, nonfinite="clean")  # cleaned values change the digest
            if source.digest != self.table.settings.get("source", source.digest):
                raise TableError(f"{self.table.path}: its source {path} has changed since it was compressed")
        return {**self.image.measure(source), **as_seen.measure(source, self.image)}

    def decode(
        self,
        output: str | os.PathLike | None = None,
        map: list[str] | str | None = None,
        width: int | None = None,
        height: int | None = None,
        **reading,
    ):
        """Write the maps (``map``: only those named) in ``width`` × ``height`` texels, by default the source's.

        ``.png`` has 8 bits a channel in the color space of the map; ``.exr`` is linear, in half precision unless its
        range is too small. ``reading`` is passed on to :meth:`.CompressedMaps.decode`. Returns each path with a line of
        text; without an ``output``, the maps by name, ``(height, width, channels)`` float32 in the encoding of the
        source. Raises :class:`UsageError`.
        """
        layout, file = self.image.layout, self.table.path
        output = None if output is None else Path(output)
        suffix = "" if output is None else output.suffix.lower()
        if output is not None and suffix not in (".png", ".exr"):
            raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are .png and .exr')
        names = (map,) if isinstance(map, str) else tuple(map or layout.names)
        for name in names:
            if name not in layout.names:
                raise UsageError(f'{file}: --map: found "{name}", the file holds {", ".join(layout.names)}')
            if suffix == ".png" and layout[name].channels > 4:
                raise UsageError(f'{file}: "{name}" has {layout[name].channels} channels, PNG holds 4: use .exr')
        width, height = width or layout.width, height or layout.height
        try:
            if width * height >= 2**32:
                raise MemoryError
            decoded = self.image.decode(names, width, height, **reading)
        except MemoryError:
            raise UsageError(f"{file}: {width} x {height} texels are more than fit into memory") from None
        if output is None:
            return decoded
        files = []
        for name, values in decoded.items():
            path = output if len(names) == 1 else output.with_name(f"{output.stem}_{name}{output.suffix}")
            _write(path, values, layout[name].color_space)
            files.append((path, f"{values.shape[1]} x {values.shape[0]}, {values.shape[2]} channel(s)"))
        return files


def _write(path: Path, values: np.ndarray, color_space: str) -> None:
    """Write a map as PNG or EXR."""
    import mitsuba as mi

    with replacing(path) as temporary, threads_for_files():
        if path.suffix.lower() == ".png":
            mi.Bitmap(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)).write(str(temporary))
            return
        if color_space == "srgb":
            values = srgb.to_linear(values)
        fits = np.abs(values).max() < 65520  # the limit of rounding to a finite half
        mi.Bitmap(np.ascontiguousarray(values, dtype=np.float16 if fits else np.float32)).write(str(temporary))
