"""A texture that is a goniometric profile, learned by a 1D indirection."""

from __future__ import annotations  # Delayed parsing of type annotations

import mitsuba as mi

from mi_diffind.arrays.tables import TableError
from mi_diffind.plugins import Counterpart, Plugin

from .profile import Profile
from .task import TASK


class NeuralProfile(Profile):
    r""".. _texture-neural_profile:

    Learned goniometric profile (:monosp:`neural_profile`)
    ------------------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - Tables, as ``mi-diffind fit profile`` writes them.

     * - storage
       - |string|
       - Their storage form in memory, ``float32``, ``float16`` or ``uint8``. (Default: that of the file)

     * - source, fov
       - |string|, |float|
       - See :ref:`profile <texture-profile>`; the measurement is what ``mi-diffind compare`` puts in the place of the
         tables.

     * - tables.primary, tables.cascaded
       - |tensor|
       - Their entries, in single precision.
       - |exposed|, |differentiable|
    """

    def opened(self, props: mi.Properties):
        filename, storage = str(props.get("filename", "")), str(props.get("storage", ""))
        props.get("source", "")  # of no use here
        if not filename:
            raise RuntimeError('parameter "filename": not given, tables of a profile (.npz) are needed')
        try:
            path = mi.file_resolver().resolve(filename)
            self.model = TASK.open(mi.TensorXf, str(path), storage=storage)
        except TableError as e:
            raise RuntimeError(f'parameter "filename": {e}') from None
        except ValueError as e:
            raise RuntimeError(str(e)) from None
        return self.model.net

    def traverse(self, cb: mi.TraversalCallback):
        for name, array in self.model.arrays.items():
            if array.storage == "float32":
                cb.put(f"tables.{name}", array.data, mi.ParamFlags.Differentiable)

    def report(self) -> dict:
        """The report for ``mi-diffind inspect``."""
        model = self.model
        return {"preset": model.table.preset, "storage": model.storage, "table_bytes": model.nbytes}


PLUGIN = Plugin(
    "neural_profile",
    "texture",
    NeuralProfile,
    task="profile",
    exact=Counterpart("profile", learned_only=("filename", "storage")),
)
