"""``mi-diffind decode``: what a table file stands for, as an ordinary image again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import metrics
from ..files import replacing, writable_file
from ..runtime import array_module
from ..tables import TableError
from .common import UsageError, positive, verb


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "decode", run, "turn a compressed image or material back into ordinary images")
    sub.add_argument("file", metavar="FILE.npz")
    sub.add_argument(
        "-o", "--output", required=True, metavar="OUT.exr|OUT.png",
        help="image to write; of several maps, one file each: OUT_albedo.png, …; .png: 8 bits; .exr: half precision, "
        "single if there are numbers beyond 65504",
    )  # fmt: skip
    sub.add_argument("--map", action="append", metavar="NAME", help="only this map; may be repeated (default: all)")
    sub.add_argument("--width", type=positive, help="width in texels (default: that of the source)")
    sub.add_argument("--height", type=positive, help="height in texels (default: that of the source)")


def run(arguments) -> dict:
    """
    Write the maps: PNG as they are encoded, 8 bits a channel; EXR linear (sRGB is decoded). Returns the ``files``.
    Raises :class:`UsageError`, :class:`~mi_diffind.tables.TableError` and :class:`~mi_diffind.files.OutputError`.
    """
    output = Path(arguments.output)
    if output.suffix.lower() not in (".png", ".exr"):
        raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are .png and .exr')
    writable_file(output)
    from ..tables import load_table
    from ..tasks.image.compressed import TASK, CompressedImage, load_image_table

    found = load_table(arguments.file)
    if found.task != TASK:
        raise UsageError(f'{arguments.file}: holds tables for the task "{found.task}", which stand for no image')
    table, layout = load_image_table(arguments.file)
    names = tuple(arguments.map or layout.names)
    for name in names:
        if name not in layout.names:
            raise UsageError(f'{arguments.file}: --map: found "{name}", the file holds {", ".join(layout.names)}')
    if output.suffix.lower() == ".png":
        for name in names:
            if layout[name].channels > 4:
                raise UsageError(
                    f'{arguments.file}: "{name}" has {layout[name].channels} channels, PNG holds 4: use .exr'
                )
    try:
        image = CompressedImage.from_table(table, array_module().TensorXf)
    except RuntimeError as e:
        raise TableError(f"{arguments.file}: {e}") from e
    width, height = arguments.width or layout.width, arguments.height or layout.height
    try:
        if width * height >= 2**32:
            raise MemoryError
        decoded = image.decode(names, width, height)
    except MemoryError:
        raise UsageError(f"{arguments.file}: {width} x {height} texels are more than fit into memory") from None
    files = []
    for name, values in decoded.items():
        path = output if len(names) == 1 else output.with_name(f"{output.stem}_{name}{output.suffix}")
        _write(path, values, layout[name].color_space)
        print(f"{path}: {values.shape[1]} x {values.shape[0]}, {values.shape[2]} channel(s)")
        files.append(str(path))
    return {"file": arguments.file, "files": files}


def _write(path: Path, values: np.ndarray, color_space: str) -> None:
    import mitsuba as mi

    with replacing(path) as temporary:
        if path.suffix.lower() == ".png":
            mi.Bitmap(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)).write(str(temporary))
            return
        if color_space == "srgb":
            values = metrics.linear(values)
        form = np.float16 if np.abs(values).max() < 65520 else np.float32  # what rounds to a finite number
        mi.Bitmap(np.ascontiguousarray(values, dtype=form)).write(str(temporary))
