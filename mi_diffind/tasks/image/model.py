"""What a table file of task 3 stands for."""

from __future__ import annotations

from ...maps.layout import Layout
from ...maps.model import MapsModel
from .compressed import CompressedImage, joined_of


class ImageModel(MapsModel):
    """The ``image`` in a file (:class:`.compressed.CompressedImage`)."""

    def build(self):
        self.image = CompressedImage(Layout.from_json(self.table.settings["layout"]), joined_of(self.arrays))


MODEL = ImageModel
