"""Table files of task 2."""

from __future__ import annotations

import os

from ...arrays.lookup import STORAGES
from ...arrays.tables import Table, TableError, check_ranges, load_table
from ...fitting.task import Model
from . import training
from .arrays import DisneyArrays
from .decoder import Decoder
from .factored import FactoredArrays, FactoredDecoder
from .paper_variants import PaperArrays, PaperDecoder

#: Preset → the layout of its tables, and the decoder that reads them.
LAYOUTS: dict[str, tuple[type[DisneyArrays], type[Decoder]]] = {
    "tables": (FactoredArrays, FactoredDecoder),
    "paper": (PaperArrays, PaperDecoder),
}


class DisneyModel(Model):
    """A table file as a module ``layout`` of its arrays, and the ``decoder`` that reads it."""

    forms = STORAGES

    def build(self):
        layout, decoder = LAYOUTS[self.table.preset]
        self.layout = layout(self.arrays)
        self.decoder = decoder(self.layout)

    def measure(self, samples: int = 10**6) -> dict[str, float]:
        """Measure errors (:func:`.training.measure`): for training materials, and (``…_uniform_db``) uniform ones."""
        trained = training.measure(self.decoder, self.types, samples)
        uniform = training.measure(self.decoder, self.types, samples, "uniform")
        return {**trained, **{f"{k[:-3]}_uniform_db": v for k, v in uniform.items() if k.endswith("_db")}}


def load(path: str | os.PathLike) -> Table:
    """Read a table file of this task and check its layout, sizes and ranges. Raises :class:`TableError`."""
    table = load_table(path, task="disney")
    if table.preset not in LAYOUTS:
        raise TableError(f'{path}: holds tables of the preset "{table.preset}", allowed are {", ".join(LAYOUTS)}')
    layout, _ = LAYOUTS[table.preset]
    table = load_table(path, task="disney", shapes=layout.SHAPES)
    check_ranges(table, layout.RANGES)
    return table


MODEL = DisneyModel
