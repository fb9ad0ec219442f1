"""What files of tasks that store maps stand for: maps that are read, measured against their source, decoded."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .. import srgb
from ..errors import UsageError
from ..files import replacing
from ..tables import TableError
from ..task import Model
from .compressed import CompressedMaps
from .source import Source, load_source


class MapsModel(Model):
    """The maps in a file: ``image`` (:class:`~mi_diffind.maps.compressed.CompressedMaps`)."""

    image: CompressedMaps

    @property
    def source_path(self) -> Path:
        """Where the source was when it was compressed. Raises :class:`TableError` if the file does not say."""
        recorded = self.table.settings.get("source_path")
        if recorded is None:
            raise TableError(f"{self.table.path}: does not say which image it was made from, so it cannot be measured")
        return Path(self.table.path or "").parent / str(recorded)

    def describe(self):
        layout, table, maps = self.image.layout, self.table, {}
        ratio = layout.source_nbytes / table.nbytes if table.nbytes else None
        size = f"{layout.width} x {layout.height}, {layout.stored} channel(s) stored of "
        size += f"{sum(m.channels for m in layout.maps)}, {layout.source_nbytes:,} bytes uncompressed: "
        lines = [size + (f"{ratio:.2f}x" if ratio else "of one colour"), f"{self.memory_nbytes:,} bytes in memory"]
        for m in layout.maps:
            psnr = table.measured.get(f"psnr_{m.name}_db")
            stored = [w if isinstance(w, int) else "from x and y" if w == "z" else f"is {w[1]:.4g}" for w in m.where]
            maps[m.name] = {"channels": m.channels, "color_space": m.color_space, "stored_as": stored, "psnr_db": psnr}
            error = f", {psnr:.2f} dB" if psnr is not None else ""
            kept = ", ".join(map(str, stored))
            lines.append(f"  {m.name:20} {m.channels} channel(s), {m.color_space}, stored as {kept}{error}")
        figures = {"width": layout.width, "height": layout.height, "source_bytes": layout.source_nbytes}
        return {**figures, "memory_bytes": self.memory_nbytes, "compression": ratio, "maps": maps}, lines

    def measure(self, source: Source | None = None) -> dict[str, float]:
        """See :meth:`.CompressedMaps.measure`; the source is looked for where it was, unless given."""
        if source is None:
            path = self.source_path
            source = load_source(path, nonfinite="clean")  # if it was not cleaned before either, the digest tells
            if source.digest != self.table.settings.get("source", source.digest):
                raise TableError(f"{self.table.path}: its source {path} has changed since it was compressed")
        return self.image.measure(source)

    def decode(
        self,
        output: Path,
        map: list[str] | None = None,
        width: int | None = None,
        height: int | None = None,
        **reading,
    ):
        """
        Write the maps (``map``: only those named) in ``width`` × ``height`` texels, those of the source unless given:
        ``.png``, 8 bits a channel, encoded as they are; ``.exr`` linear, in half precision unless numbers are beyond.
        ``reading``: what the maps have to be told beside.
        """
        layout, file = self.image.layout, self.table.path
        if output.suffix.lower() not in (".png", ".exr"):
            raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed are .png and .exr')
        names = tuple(map or layout.names)
        for name in names:
            if name not in layout.names:
                raise UsageError(f'{file}: --map: found "{name}", the file holds {", ".join(layout.names)}')
            if output.suffix.lower() == ".png" and layout[name].channels > 4:
                raise UsageError(f'{file}: "{name}" has {layout[name].channels} channels, PNG holds 4: use .exr')
        width, height = width or layout.width, height or layout.height
        try:
            if width * height >= 2**32:
                raise MemoryError
            decoded = self.image.decode(names, width, height, **reading)
        except MemoryError:
            raise UsageError(f"{file}: {width} x {height} texels are more than fit into memory") from None
        files = []
        for name, values in decoded.items():
            path = output if len(names) == 1 else output.with_name(f"{output.stem}_{name}{output.suffix}")
            _write(path, values, layout[name].color_space)
            files.append((path, f"{values.shape[1]} x {values.shape[0]}, {values.shape[2]} channel(s)"))
        return files


def _write(path: Path, values: np.ndarray, color_space: str) -> None:
    import mitsuba as mi

    with replacing(path) as temporary:
        if path.suffix.lower() == ".png":
            mi.Bitmap(np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)).write(str(temporary))
            return
        if color_space == "srgb":
            values = srgb.to_linear(values)
        form = np.float16 if np.abs(values).max() < 65520 else np.float32  # what rounds to a finite number
        mi.Bitmap(np.ascontiguousarray(values, dtype=form)).write(str(temporary))
