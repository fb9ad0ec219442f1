from __future__ import annotations  # Delayed parsing of type annotations

import math

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.tasks.disney import TASK, model, sampling
from mi_diffind.tasks.disney.decoder import GROUPS, Decoder
from mi_diffind.tasks.disney.model import SPECULAR_SCALE

from . import Counterpart, Plugin
from .disney import PRINCIPLED, Disney, Parameters, refuse_latents
from .support import properties, tables
from .support.tracked_parameter import TrackedChannel

#: The fastest form to read; 82 dB or more from the formulas.
STORAGE = "uint8"


class NeuralDisney(Disney):
    r"""
    .. _bsdf-neural_disney:

    Disney BRDF from tables (:monosp:`neural_disney`)
    -------------------------------------------------

    .. pluginparameters::

     * - preset
       - |string|
       - ``tables``: tables of together 384 bytes, in a factorisation that stays accurate at the horizon (85 dB from the
         formulas); ``paper``: the layout of the paper's Table 1, for comparison (39 dB). (Default: that of the file, if
         ``filename`` is given, else ``tables``)
       - --

     * - filename
       - |string|
       - Tables of one's own, as written by ``mi-diffind fit disney``. (Default: those that ship with the package)
       - --

     * - storage
       - |string|
       - Storage form of the tables: ``float32``, ``float16`` or ``uint8``. The tables are exposed as parameters, and
         can be optimised, only in the first. (Default: ``uint8``, the fastest, whatever that of the file)
       - --

     * - latents
       - |string|
       - Names of parameters (``roughness``, ``metallic``, …; not ``base_color``) that are stored three to a texture, in
         this order, in ``latents_0``, ``latents_1``, …, as written by ``mi-diffind encode``. Of them, roughness and
         anisotropic are *encoded*: they hold the encoder's coordinates for this preset, which the decoder reads
         directly. (Default: none)
       - --

     * - latents_0, latents_1, latents_2, latents_3
       - |texture|
       - Textures of three channels each, with values in [0, 1]; of one channel if it holds the last parameter alone.
       - |exposed|, |differentiable|

     * - tables.alpha, tables.aspect, tables.masking, tables.coat, tables.encoder_roughness,
         tables.encoder_anisotropic; or tables.ggx, tables.masking, tables.diffuse, tables.fresnel, … (``paper``)
       - |tensor|
       - With ``storage`` ``float32``: the entries of the tables, in the file's shapes, or with channels padded to 1, 2
         or a multiple of 4, as they are to begin with.
       - |exposed|, |differentiable|

     * - base_color, roughness, anisotropic, metallic, specular, eta, spec_tint, sheen, sheen_tint, flatness,
         clearcoat, clearcoat_gloss, spec_trans, …
       - |float| or |texture|
       - All parameters of :ref:`disney <bsdf-disney>`, with the same names, meaning and defaults.
       - |exposed|, |differentiable|

    The Disney BRDF by *differentiable indirection* (Datta et al., *Efficient Graphics Representation with
    Differentiable Indirection*, SIGGRAPH Asia 2023): a small encoder turns the material into coordinates, and learned
    tables replace the arithmetic of its lobes. The exact counterpart is :ref:`disney <bsdf-disney>`, which computes the
    same without any table, and on the CPUs that we measured in less time. This plugin differs from it in nothing but
    the value: sampling and densities are analytic, so they stay normalised although tables are approximate, and only
    the effects in use are traced, read and sampled.

    **``paper`` gains energy** at the horizon, where its masking is off: at roughness 0.2, ``anisotropic`` 1 and an
    angle of 89° the mean weight of a sample reaches 2.44, where the exact one stays below 1. ``tables`` does not.

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

    def _set_up(self, props):
        opened = tables.open_tables(props, TASK, STORAGE)
        self.decoder, self.preset = opened.decoder, opened.table.preset
        #: What the encoded form of this material has to say of its tables, too.
        self._opened = {name: str(props[name]) for name in ("storage", "effects") if name in props}
        if "filename" in props:
            self._opened["filename"] = properties.filename(props)

        #: Textures of several parameters each, and for each of these its texture and channel.
        self.latents: list[mi.Texture] = []
        self._latent_channels: dict[str, tuple[int, int]] = {}
        self._take_latents(props)
        self._watched |= {name: TrackedChannel(self.latents[i]) for name, (i, _) in self._latent_channels.items()}

    def _take_latents(self, props: mi.Properties) -> None:
        names = str(props.get("latents", "")).split()
        for i in range(math.ceil(len(names) / 3)):
            self.latents.append(props.get_texture(f"latents_{i}"))
        for i, name in enumerate(names):
            allowed = (*self.DEFAULTS, "specular")
            if name not in allowed or name in names[:i]:
                fault = "twice" if name in names[:i] else f"allowed are {', '.join(allowed)}"
                raise RuntimeError(f'parameter "latents": found "{name}", {fault}')
            for alias in (name, {"flatness": "subsurface", "specular": "eta"}.get(name, name)):
                if alias in props:
                    raise RuntimeError(f'parameter "{alias}": is given by "latents", too')
            self._latent_channels[name] = divmod(i, 3)
            if name == "specular":
                self.reflectance = None
            else:
                del self.scalars[name]
        if names:
            anisotropic = self.scalars.get("anisotropic")
            self._set_flags(True, self._is_anisotropic or anisotropic is None)

    def _read(self, name, parameters, si, active):
        if name == "latent":
            return self._read_latent(parameters, si, active)
        if name.startswith("latents_"):
            i = int(name[len("latents_") :])
            if len(self._latent_channels) == 3 * i + 1:  # the only one in its texture
                return (self.latents[i].eval_1(si, active),)
            return self.latents[i].eval_3(si, active)
        if name in ("roughness", "anisotropic") and parameters.latent is not None:
            roughness, anisotropic = self.decoder.decode(parameters.latent, active)
            return roughness if name == "roughness" else anisotropic
        if name in self._latent_channels:
            return self._channel(name, parameters)
        return super()._read(name, parameters, si, active)

    def _channel(self, name, parameters):
        texture, channel = self._latent_channels[name]
        return model.clamp(getattr(parameters, f"latents_{texture}")[channel], 0.0, 1.0)

    def _read_latent(self, parameters, si, active):
        """The encoded roughness and anisotropy, if at least one of them is stored encoded."""
        if not {"roughness", "anisotropic"} & set(self._latent_channels):
            return None
        read = super()._read  # not by the name of the class, which means another one once the variant has changed
        return tuple(
            self._channel(name, parameters)
            if name in self._latent_channels
            else encode(read(name, parameters, si, active), active)
            for name, encode in (
                ("roughness", self.decoder.encode_roughness),
                ("anisotropic", self.decoder.encode_anisotropic),
            )
        )

    # -- parameters -------------------------------------------------------------------------------------------------

    def _arrays(self) -> dict:
        return {name: getattr(self.decoder.arrays, name) for name in self.decoder.arrays.SHAPES}

    def _tables(self) -> dict:
        """The tables that are exposed."""
        return tables.exposed(self._arrays())

    def _is_constant(self, group):
        reads_tables = group not in GROUPS
        return super()._is_constant(group) and not (reads_tables and tables.optimised(self._tables()))

    def traverse(self, cb: mi.TraversalCallback):
        super().traverse(cb)
        for i, texture in enumerate(self.latents):
            cb.put(f"latents_{i}", texture, mi.ParamFlags.Differentiable)
        tables.traverse(cb, self._tables())

    def parameters_changed(self, keys: list[str] = ()):
        tables.check_shapes(self._tables())
        super().parameters_changed(keys)

    # -- what :mod:`mi_diffind.encode` needs --------------------------------------------------------------------------

    #: What is stored as a colour, by itself.
    ENCODED_AS_COLOUR = ("base_color",)

    def encodable(self) -> dict[str, mi.Texture]:
        """
        The parameters that are textures and have an effect at present, by name. Raises ``RuntimeError`` if they cannot
        be encoded.
        """
        if self.latents:
            raise RuntimeError(f'the parameters of "{self.id()}" are encoded already')
        effects, analytic = self._effects(), Decoder()
        parameters = Parameters(self, dr.zeros(mi.SurfaceInteraction3f), True)
        for group in (*analytic.required(effects), *sampling.required(effects)):
            analytic.coefficients(group, parameters, effects)
        read = {"base_color" if name == "albedo" else name for name in vars(parameters)}
        found = {n: w.texture for n, w in self._watched.items() if n in read and not w.constant}
        if self.reflectance_name == "eta" and "specular" in found:
            raise RuntimeError(f'"{self.id()}" has a texture for eta, only one for specular can be encoded')
        return found

    def encoded(self, name: str, si: mi.SurfaceInteraction3f):
        """A parameter at ``si``, as ``latents`` hold it."""
        value = getattr(Parameters(self, si, True), name)
        encode = {"roughness": self.decoder.encode_roughness, "anisotropic": self.decoder.encode_anisotropic}.get(name)
        return value if encode is None else encode(value)

    def encoded_as(self, names: list[str]) -> dict:
        """What ``mi.load_dict`` needs besides the textures for the parameters ``names`` to be read from ``latents``."""
        parameters, found = Parameters(self, dr.zeros(mi.SurfaceInteraction3f), True), {}
        for name, watched in self._watched.items():
            if watched.constant and name not in names:
                value = dr.detach(getattr(parameters, "albedo" if name == "base_color" else name)).numpy().ravel()
                found[name] = {"type": "rgb", "value": value.tolist()} if name == "base_color" else float(value[0])
        if self.reflectance_name == "eta" and "specular" in found:
            root = float(np.sqrt(SPECULAR_SCALE * found.pop("specular")))
            found["eta"] = (1 + root) / (1 - root)
        latents = {"latents": " ".join(names)} if names else {}
        return {"type": "neural_disney", "preset": self.preset, **self._opened, **found, **latents}


def _to_disney(props: mi.Properties) -> None:
    refuse_latents(props, "disney")


PLUGIN = Plugin(
    "neural_disney",
    "bsdf",
    NeuralDisney,
    task="disney",
    storage=STORAGE,
    exact=Counterpart("disney", ("preset", "filename", "storage"), convert=_to_disney),
    others=(PRINCIPLED,),
)
