from __future__ import annotations  # Delayed parsing of type annotations

import mitsuba as mi

from mi_diffind.tasks.disney.arrays import SHAPES
from mi_diffind.tasks.disney.library import load_arrays

from .disney import Disney


class NeuralDisney(Disney):
    r"""
    .. _bsdf-neural_disney:

    Disney BRDF from tables (:monosp:`neural_disney`)
    -------------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - Tables of one's own, as written by ``mi-diffind fit disney``. (Default: the tables that ship with the package)
       - --

     * - storage
       - |string|
       - Storage form of the tables: ``float32``, ``float16`` or ``uint8``. The tables are exposed as parameters only
         in the first. (Default: the file's own, ``float32`` for those that ship)
       - --

     * - tables.ggx, tables.masking, tables.diffuse, tables.fresnel, tables.coat, tables.encoder_roughness,
         tables.encoder_anisotropic
       - |tensor|
       - The entries of the tables, in the file's shapes, or with channels padded to 1, 2 or a multiple of 4, as they
         are to begin with (``tables.ggx``: 16 × 16 × 4, the last unused).
       - |exposed|, |differentiable|

     * - base_color, roughness, anisotropic, metallic, specular, eta, spec_tint, sheen, sheen_tint, flatness,
         clearcoat, clearcoat_gloss, spec_trans, …
       - |float| or |texture|
       - All parameters of :ref:`disney <bsdf-disney>`, with the same names, meaning and defaults.
       - |exposed|, |differentiable|

    The Disney BRDF by *differentiable indirection* (Datta et al., *Efficient Graphics Representation with
    Differentiable Indirection*, SIGGRAPH Asia 2023): a small encoder turns the material into coordinates, and five
    learned tables of together 12 KB, the layout of the paper's Table 1, replace the arithmetic of its lobes. The exact
    counterpart is :ref:`disney <bsdf-disney>`, from which this plugin differs in nothing but the value: sampling and
    densities are analytic, so they stay normalised although the tables are approximate.

    .. tabs::
        .. code-tab:: xml
            :name: neural_disney

            <bsdf type="neural_disney">
                <rgb name="base_color" value="0.8, 0.2, 0.1"/>
                <float name="roughness" value="0.3"/>
                <float name="clearcoat" value="1.0"/>
                <float name="clearcoat_gloss" value="0.9"/>
            </bsdf>

        .. code-tab:: python

            'type': 'neural_disney',
            'base_color': {
                'type': 'rgb',
                'value': [0.8, 0.2, 0.1]
            },
            'roughness': 0.3,
            'clearcoat': 1.0,
            'clearcoat_gloss': 0.9
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        filename = str(props.get("filename", ""))
        if filename:
            filename = str(mi.file_resolver().resolve(filename))
        self.arrays = load_arrays(filename, mi.TensorXf, str(props.get("storage", "")))

    def factors(self, material, wi, wo, active):
        return self.arrays.factors(material, wi, wo, active)

    def traverse(self, cb: mi.TraversalCallback):
        super().traverse(cb)
        for name in SHAPES:
            array = getattr(self.arrays, name)
            if array.storage == "float32":
                cb.put(f"tables.{name}", array.data, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()):
        super().parameters_changed(keys)
        for name in SHAPES:
            array = getattr(self.arrays, name)
            if array.storage == "float32":
                try:
                    array.check_shape()
                except ValueError as e:
                    raise RuntimeError(f'parameter "tables.{name}": {e}') from None

    def to_string(self):
        tables = f"  tables = {self.arrays.nbytes} bytes as {self.arrays.ggx.storage},\n"
        return super().to_string()[:-1] + tables + "]"


mi.register_bsdf("neural_disney", NeuralDisney)
