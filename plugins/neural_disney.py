from __future__ import annotations  # Delayed parsing of type annotations

import math

import drjit as dr
import mitsuba as mi

from mi_diffind.tasks.disney import model, sampling
from mi_diffind.tasks.disney.decoder import GROUPS, Decoder
from mi_diffind.tasks.disney.effects import Effects, find_effects
from mi_diffind.tasks.disney.library import load_decoder

from . import knowledge
from .disney import Disney, Parameters
from .knowledge import Watched, WatchedChannel, when_outermost


class NeuralDisney(Disney):
    r"""
    .. _bsdf-neural_disney:

    Disney BRDF from tables (:monosp:`neural_disney`)
    -------------------------------------------------

    .. pluginparameters::

     * - quality
       - |string|
       - ``fast``: arithmetic wherever it takes less time than a table on a CPU, which on those we measured is
         everywhere; ``tables``: every factor is read from tables of together 2 KB, in a factorisation that stays
         accurate at the horizon; ``paper``: the layout of the paper's Table 1, for comparison. (Default: that of the
         file, if ``filename`` is given, else ``fast``)
       - --

     * - effects
       - |string|
       - ``used``: only the parts of the model that the material makes use of are traced, read and sampled; ``all``: all
         of them. (Default: ``used``)
       - --

     * - filename
       - |string|
       - Tables of one's own, as written by ``mi-diffind fit disney``. (Default: those that ship with the package)
       - --

     * - storage
       - |string|
       - Storage form of the tables: ``float32``, ``float16`` or ``uint8``. The tables are exposed as parameters only
         in the first. (Default: the file's own, ``float32`` for those that ship)
       - --

     * - latents
       - |string|
       - Names of parameters (``roughness``, ``metallic``, …; not ``base_color``) that are stored three to a texture, in
         this order, in ``latents_0``, ``latents_1``, …, as written by ``mi-diffind encode``. Of them, roughness and
         anisotropic are *encoded*: they hold the encoder's coordinates for this quality, which the decoder reads
         directly. (Default: none)
       - --

     * - latents_0, latents_1, latents_2, latents_3
       - |texture|
       - Textures of three channels each, with values in [0, 1]; of one channel if it holds the last parameter alone.
       - |exposed|, |differentiable|

     * - tables.alpha, tables.masking, tables.cosine, tables.coat, tables.encoder_roughness,
         tables.encoder_anisotropic; or tables.ggx, tables.masking, tables.diffuse, tables.fresnel, … (``paper``)
       - |tensor|
       - The entries of the tables, in the file's shapes, or with channels padded to 1, 2 or a multiple of 4, as they
         are to begin with.
       - |exposed|, |differentiable|

     * - base_color, roughness, anisotropic, metallic, specular, eta, spec_tint, sheen, sheen_tint, flatness,
         clearcoat, clearcoat_gloss, spec_trans, …
       - |float| or |texture|
       - All parameters of :ref:`disney <bsdf-disney>`, with the same names, meaning and defaults.
       - |exposed|, |differentiable|

    The Disney BRDF by *differentiable indirection* (Datta et al., *Efficient Graphics Representation with
    Differentiable Indirection*, SIGGRAPH Asia 2023): a small encoder turns the material into coordinates, and learned
    tables replace the arithmetic of its lobes, as far as they earn their place. The exact counterpart is
    :ref:`disney <bsdf-disney>`, from which this plugin differs in nothing but the value: sampling and densities are
    analytic, so they stay normalised although tables are approximate.

    **Only the effects in use.** A part of the model that the parameters make zero (``clearcoat`` 0, ``metallic`` 1, a
    black texture, the tint of a grey albedo, …) is neither traced nor read nor sampled. What is in use is found when
    the scene is loaded and again when parameters change; parameters with gradients enabled always count as in use, and
    so does a texture whose bounds are not known (constants and bitmaps are). ``mi-diffind inspect SCENE.xml`` lists
    what was left out, and why. Whatever depends on constant parameters alone is evaluated once, not for each sample.

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
        quality, storage = (str(props.get(name, "")) for name in ("quality", "storage"))
        self.decoder = load_decoder(filename, mi.TensorXf, storage, quality)
        self.effects = str(props.get("effects", "used"))
        if self.effects not in ("used", "all"):
            raise RuntimeError(f'parameter "effects": found "{self.effects}", allowed are used, all')

        #: Textures of several parameters each, and for each of these its texture and channel.
        self.latents: list[mi.Texture] = []
        self._latent_channels: dict[str, tuple[int, int]] = {}
        self._take_latents(props)

        #: What is known about the parameters of the model.
        self._watched = {
            "base_color": Watched(self.base_color, colour=True),
            **{name: Watched(texture) for name, texture in self.scalars.items()},
            **{name: WatchedChannel(self.latents[i]) for name, (i, _) in self._latent_channels.items()},
        }
        if "specular" not in self._watched:
            self._watched["specular"] = Watched(self.reflectance, is_eta=self.reflectance_name == "eta")
        #: Coefficients that depend on constants alone, evaluated, and the effects that they are for.
        self._constant: dict[str, dict] = {}
        self._constant_for: Effects | None = None
        when_outermost(self._prepare_constants)

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

    # -- effects in use, and what is evaluated once -------------------------------------------------------------------

    def _effects(self) -> Effects:
        if self.effects == "all":
            return Effects()
        watched = self._watched.values()
        if not dr.flag(dr.JitFlag.SymbolicScope) and any(w.changed() and not w.optimised() for w in watched):
            self._prepare_constants()  # a texture was updated, and we were not told
        return find_effects({name: watched.known() for name, watched in self._watched.items()})[0]

    def _is_constant(self, group: str) -> bool:
        """Does a group of coefficients depend on constants alone, none of which is being optimised or has changed?"""
        watched = [self._watched[name] for name in self.decoder.groups[group]]
        if not all(w.constant and not w.optimised() and not w.changed() for w in watched):
            return False
        reads_tables = group not in GROUPS
        return not (reads_tables and any(knowledge.has_gradient(a.data) for a in self._tables().values()))

    def _prepare_constants(self) -> None:
        """Look at the parameters, and evaluate every group of coefficients that depends on constants alone."""
        for watched in self._watched.values():
            watched.look()
        effects = find_effects({name: watched.known() for name, watched in self._watched.items()})[0]
        if self.effects == "all":
            effects = Effects()
        groups = sorted({*self.decoder.required(effects), *sampling.required(effects)})
        parameters = Parameters(self, dr.zeros(mi.SurfaceInteraction3f), True)
        with dr.suspend_grad():
            self._constant = {
                group: self.decoder.coefficients(group, parameters, effects)
                for group in groups
                if self._is_constant(group)
            }
        # A frozen function is recorded anew when the arrays that it finds here are others
        self._constant["effects"] = {name: mi.Float(0) for name in effects.names}
        dr.make_opaque(self._constant)
        self._constant_for = effects

    def _surface(self, si, active, effects, value=True, density=True):
        parameters = Parameters(self, si, active)
        groups = (*(self.decoder.required(effects) if value else ()), *(sampling.required(effects) if density else ()))
        usable = self._constant if effects == self._constant_for else {}
        coefficients = {}
        for group in dict.fromkeys(groups):
            # Gradients may have been enabled, and textures updated, since
            if group in usable and self._is_constant(group):
                coefficients[group] = usable[group]
            else:
                coefficients[group] = self.decoder.coefficients(group, parameters, effects)
        return parameters, coefficients

    def _reflected(self, parameters, coefficients, effects, lobes, wi, wo, active):
        return self.decoder.value(coefficients, effects, lobes, parameters, wi, wo, active)

    # -- parameters -------------------------------------------------------------------------------------------------

    def _tables(self) -> dict:
        """The tables that are exposed."""
        arrays = self.decoder.arrays
        if arrays is None:
            return {}
        tables = {name: getattr(arrays, name) for name in arrays.SHAPES}
        return {name: array for name, array in tables.items() if array.storage == "float32"}

    def traverse(self, cb: mi.TraversalCallback):
        super().traverse(cb)
        for i, texture in enumerate(self.latents):
            cb.put(f"latents_{i}", texture, mi.ParamFlags.Differentiable)
        for name, array in self._tables().items():
            cb.put(f"tables.{name}", array.data, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys: list[str] = ()):
        super().parameters_changed(keys)
        for name, array in self._tables().items():
            try:
                array.check_shape()
            except ValueError as e:
                raise RuntimeError(f'parameter "tables.{name}": {e}') from None
        self._prepare_constants()

    def textured(self) -> list[str]:
        """The parameters that are textures and have an effect at present."""
        effects, analytic = self._effects(), Decoder()
        parameters = Parameters(self, dr.zeros(mi.SurfaceInteraction3f), True)
        for group in (*analytic.required(effects), *sampling.required(effects)):
            analytic.coefficients(group, parameters, effects)
        read = {"base_color" if name == "albedo" else name for name in vars(parameters)}
        return [name for name, watched in self._watched.items() if name in read and not watched.constant]

    def parameter(self, name: str):
        """The texture (or number) of a parameter."""
        return self._watched[name].texture

    def constants(self) -> dict:
        """The parameters that are the same everywhere: name → number, or three of them for ``base_color``."""
        parameters = Parameters(self, dr.zeros(mi.SurfaceInteraction3f), True)
        found = {}
        for name, watched in self._watched.items():
            if watched.constant:
                value = dr.detach(getattr(parameters, "albedo" if name == "base_color" else name))
                found[name] = [float(v) for v in value.numpy().ravel()] if name == "base_color" else float(value[0])
        return found

    def encoded(self, name: str, si: mi.SurfaceInteraction3f):
        """A parameter at ``si``, as ``latents`` hold it."""
        value = getattr(Parameters(self, si, True), name)
        encode = {"roughness": self.decoder.encode_roughness, "anisotropic": self.decoder.encode_anisotropic}.get(name)
        return value if encode is None else encode(value)

    def report(self) -> dict:
        """
        What this instance does: ``quality``, ``effects_in_use``, ``effects_left_out`` (effect → reason),
        ``evaluated_once`` (groups of coefficients), ``storage`` and ``table_bytes``.
        """
        effects, reasons = find_effects({name: watched.known() for name, watched in self._watched.items()})
        if self.effects == "all":
            effects, reasons = Effects(), {}
        arrays = self.decoder.arrays
        return {
            "quality": "fast" if arrays is None else arrays.QUALITY,
            "effects_in_use": list(effects.names),
            "effects_left_out": reasons,
            "evaluated_once": sorted(group for group in self._constant if group != "effects"),
            "storage": None if arrays is None else arrays.storage,
            "table_bytes": 0 if arrays is None else arrays.nbytes,
        }

    def to_string(self):
        report = self.report()
        tables = f", {report['table_bytes']} bytes as {report['storage']}" if report["storage"] else ""
        effects = ", ".join(report["effects_in_use"])
        added = f"  quality = {report['quality']}{tables},\n  effects = {effects},\n"
        return super().to_string()[:-1] + added + "]"


mi.register_bsdf("neural_disney", NeuralDisney)
