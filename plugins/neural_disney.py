"""The Disney BRDF from tables."""

from __future__ import annotations  # Delayed parsing of type annotations

from mi_diffind.tasks.disney import TASK

from . import Counterpart, Plugin
from .disney import PRINCIPLED, Disney
from .support.manual import shared_parts
from .support.tables import Tables, open_tables

#: Default storage form: the fastest to read; 82 dB against the formulas, for uniform materials.
STORAGE = "uint8"


@shared_parts
class NeuralDisney(Disney):
    r"""
    .. _bsdf-neural_disney:

    Disney BRDF from tables (:monosp:`neural_disney`)
    -------------------------------------------------

    .. pluginparameters::

     * - preset
       - |string|
       - ``tables``: 384 bytes of tables, in a factorisation that stays accurate at the horizon (85 dB against the
         formulas); ``paper``: the layout of the paper's Table 1, for comparison (39 dB). (Default: that of the file, if
         ``filename`` is given, else ``tables``)
       - --

     * - filename
       - |string|
       - A table file, written by ``mi-diffind fit disney``. (Default: the file that ships with the package)
       - --

     * - storage
       - |string|
       - Storage form of the tables: ``float32``, ``float16`` or ``uint8``. Only ``float32`` tables are exposed as
         parameters and can be optimised. (Default: ``uint8``, the fastest, for any file)
       - --

     * - tables.alpha, tables.aspect, tables.masking, tables.coat, tables.encoder_roughness,
         tables.encoder_anisotropic; or tables.ggx, tables.masking, tables.diffuse, tables.fresnel, … (``paper``)
       - |tensor|
       - The entries of the tables, exposed if ``storage`` is ``float32``; channels are padded to 1, 2 or a multiple of
         4, and may be assigned without the padding.
       - |exposed|, |differentiable|

     * - base_color, roughness, anisotropic, metallic, specular, eta, spec_tint, sheen, sheen_tint, flatness,
         clearcoat, clearcoat_gloss, spec_trans, …
       - |float| or |texture|
       - All parameters of :ref:`disney <bsdf-disney>`, with the same names, meaning and defaults.
       - |exposed|, |differentiable|

    The Disney BRDF by *differentiable indirection* (Datta et al., *Efficient Graphics Representation with
    Differentiable Indirection*, SIGGRAPH Asia 2023): a small encoder turns the material into coordinates, and learned
    tables replace the arithmetic of its lobes. The exact counterpart is :ref:`disney <bsdf-disney>`, which computes the
    same model without tables, in less time on the CPUs that we measured. Only values differ from it: sampling and
    densities are analytic, so they stay normalised although tables are approximate. Only the effects in use are traced,
    read and sampled.

    **Energy**: the Disney model itself reflects more than it receives at grazing angles, if it is bright, and so does
    this plugin, as :monosp:`disney` does. The preset ``paper`` gains more, since its masking is inaccurate at the
    horizon; ``tables`` does not.

    {executable}

    {example bsdf neural_disney: base_color=[0.8, 0.2, 0.1], roughness=0.3, clearcoat=1.0, clearcoat_gloss=0.9}
    """

    def _set_up(self, props):
        opened = open_tables(props, TASK, STORAGE)
        self.decoder, arrays = opened.decoder, opened.decoder.arrays
        self.tables = Tables({name: getattr(arrays, name) for name in arrays.SHAPES}, opened.table)

    def trained(self) -> tuple:
        """Return the table of the file, and the arrays that can be optimised, by name."""
        return self.tables.table, self.tables.exposed


PLUGIN = Plugin(
    "neural_disney",
    "bsdf",
    NeuralDisney,
    task="disney",
    storage=STORAGE,
    exact=Counterpart("disney", ("preset", "filename", "storage")),
    others=(PRINCIPLED,),
)
