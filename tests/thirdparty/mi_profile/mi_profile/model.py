"""The profile that a file of tables stands for: it can be read, measured and written as a file again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_diffind import Indirection
from mi_diffind.arrays.lookup import STORAGES
from mi_diffind.arrays.tables import TableError
from mi_diffind.core.errors import UsageError
from mi_diffind.fitting.task import Model

from . import measurement
from .training import errors


class ProfileModel(Model):
    """``net`` maps the angle over 90° to the intensity relative to the ``peak``, which is in cd."""

    forms = STORAGES

    def build(self):
        self.net = Indirection(self.arrays["primary"], self.arrays["cascaded"])
        self.peak = self.table.settings["peak_cd"]

    def describe(self):
        return {"peak_cd": self.peak}, [f"peak {self.peak:,.1f} cd, of {self.table.settings['source_path']}"]

    def measure(self) -> dict[str, float]:
        """See :func:`.training.errors`; the measurement is looked for where it was."""
        path = Path(self.table.path or "").parent / str(self.table.settings["source_path"])
        truth = measurement.read(path)
        if truth.digest != self.table.settings["source"]:
            raise TableError(f"{self.table.path}: its source {path} has changed since")
        return errors(self.net, truth, self.types)

    def decode(self, output: Path, samples: int = 181):
        if output.suffix.lower() != ".csv":
            raise UsageError(f'output "{output}": found the extension "{output.suffix}", allowed is .csv')
        x = np.linspace(0, 1, max(2, samples), dtype=np.float32)
        found = self.net([self.types.Float(x)])[0].numpy()
        measurement.write(output, 90 * x, np.maximum(found, 0) * self.peak)
        return [(output, f"{len(x)} angles, peak {self.peak:,.1f} cd")]


MODEL = ProfileModel
