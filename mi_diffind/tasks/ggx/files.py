"""Table files of task 1."""

from __future__ import annotations

import os

from ...arrays.indirection import Indirection
from ...arrays.lookup import STORAGES
from ...arrays.tables import Table, TableError, check_ranges, load_table
from ...fitting.task import Model
from . import training
from .model import Encoding, LearnedGGX


class GGXModel(Model):
    """A table file as a ``distribution`` (:class:`.model.LearnedGGX`)."""

    forms = STORAGES

    def build(self):
        net = Indirection(self.arrays["primary"], self.arrays["cascaded"])
        self.distribution = LearnedGGX(net, encoding_of(self.table))

    def measure(self, samples: int = 10**6) -> dict[str, float]:
        """Measure errors (:func:`.training.measure`)."""
        return training.measure(self.distribution, self.types, samples)


def encoding_of(table: Table) -> Encoding:
    """Return the encoding that a table's settings name. Raises :class:`TableError`."""
    try:
        return Encoding(table.settings["inputs"], table.settings["output"])
    except (KeyError, TypeError, ValueError) as e:
        raise TableError(f"{table.path}: the settings name no known encoding ({e})") from None


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`TableError`."""
    table = load_table(path, "ggx", {"primary": (None, None, 2), "cascaded": (None, None, 1)})
    bounded = encoding_of(table).output == "root"
    check_ranges(table, {"primary": (0.0, 1.0), **({"cascaded": (-0.5, 1.5)} if bounded else {})})
    return table


MODEL = GGXModel
