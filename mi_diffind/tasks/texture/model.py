"""What a table file of task 4 stands for."""

from __future__ import annotations

from pathlib import Path

from ...errors import UsageError
from ...maps.model import MapsModel
from .compressed import assembled


class TextureModel(MapsModel):
    """The texture in a file, ``image`` (:class:`.compressed.CompressedTexture`)."""

    def build(self):
        self.image = assembled(self.table, self.arrays)

    def describe(self):
        figures, lines = super().describe()
        image, measured = self.image, self.table.measured
        by_level = [measured.get(f"psnr_l{i}_db") for i in range(image.levels)]
        figures = {**figures, "levels": image.levels, "psnr_by_level_db": by_level}
        if all(value is not None for value in by_level):
            found = ", ".join(f"{value:.1f}" for value in by_level)
            lines.append(f"  {image.levels} levels of detail: {found} dB")
        return figures, lines

    def decode(self, output: Path, map=None, width=None, height=None, level: int = 0):
        """As of any maps, at the level of detail ``level``, in its own size unless another is given."""
        image = self.image
        if not 0 <= level < image.levels:
            raise UsageError(f"{self.table.path}: --level: found {level}, the file has levels 0 to {image.levels - 1}")
        rows, columns = image.level_size(level)
        return super().decode(output, map, width or columns, height or rows, level=level)


MODEL = TextureModel
