"""Learned BSDF: an analytic proxy times a learned residual."""

from __future__ import annotations  # Delayed parsing of type annotations

import copy

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.indirection import DifferentiableArray
from mi_diffind.arrays.lookup import clamp
from mi_diffind.core import compat
from mi_diffind.core.errors import UsageError
from mi_diffind.tasks.bsdf import TASK
from mi_diffind.tasks.bsdf.files import RESIDUAL
from mi_diffind.tasks.bsdf.model import ALPHA_MIN, DIFFUSE, EDGE, LOBE, LOGARITHMS, PARAMETERS, TERMS, Proxy, ProxyLobe
from mi_diffind.tasks.bsdf.truth import MitsubaTruth

from . import Counterpart, Plugin
from .support import properties, textures
from .support.bsdfs import TrackedParameter, glossy_directions, when_outermost
from .support.manual import shared_parts
from .support.tables import Tables, arrays_of, frozen_key, make_opaque, open_tables

#: Smallest density of a sample that counts.
SMALLEST_DENSITY = 1e-20


@shared_parts
class NeuralBSDF(mi.BSDF):
    r"""
    .. _bsdf-neural_bsdf:

    Learned BSDF (:monosp:`neural_bsdf`)
    ------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A table file, written by ``mi-diffind fit bsdf``.
       - --

     * - scale
       - |float|
       - Factor on the reflected light, 0 to 1. (Default: 1)
       - |exposed|, |differentiable|

     * - two_sided
       - |bool|
       - Reflect on both sides, as a material in :monosp:`twosided` does. (Default: false)
       - --

     * - energy
       - |string|
       - ``source``: the directional albedo is at most 0.30% above the source's (that of its symmetric part, if it is
         not reciprocal), and limited to 1, by a factor s(θ_i) s(θ_o) of the file; ``raw``: as it was fitted.
         (Default: ``source``)
       - --

     * - evaluate
       - |string|
       - ``learned``, or ``source``: what the file was fitted to, if it can be opened again, as ``mi-diffind compare``
         shows it. (Default: ``learned``)
       - --

     * - storage
       - |string|
       - Storage form of the residual's arrays: ``float32``, ``float16`` or ``uint8``. Only ``float32`` arrays are
         exposed as parameters. (Default: that of the file, ``uint8``)
       - --

     * - diffuse, edge
       - |spectrum|, |float|
       - Albedo of the proxy's diffuse lobe (linear sRGB), and its factor at the horizon.
       - |exposed|, |differentiable|

     * - first.alpha_u, first.alpha_v, first.gamma, first.f0, first.f90; second.…
       - |float|, |float|, |float|, |spectrum|, |spectrum|
       - Roughness, exponent (2: GGX; large: Beckmann's), and reflectance at normal and grazing incidence of
         the proxy's microfacet lobes. Of isotropic files, ``alpha_u`` alone counts.
       - |exposed|, |differentiable|

     * - roughness, metallic, …
       - |float| or |texture|
       - Of a file that was fitted ``--over`` parameters: each of them by its name. Numbers outside of the range of the
         fit are refused, textures are clamped. (Default: the middle of the range)
       - |exposed|, |differentiable|

     * - tables.primary_uv, tables.primary_vw, tables.cascaded
       - |tensor|
       - The entries of the residual's arrays; of a family, also ``tables.mixing`` and ``tables.proxy``.
       - |exposed|, |differentiable|

    Any reflecting BSDF in a file of four kilobytes: an analytic proxy (a diffuse lobe and two microfacet lobes) times
    the fourth power of a residual that is read by *differentiable indirection* (Datta et al., *Efficient Graphics
    Representation with Differentiable Indirection*, SIGGRAPH Asia 2023). ``mi-diffind fit bsdf`` makes the file of a
    material of a scene, of any of Mitsuba's BSDFs, or of measured data.

    **Reciprocal**: exchanging both directions changes no coordinate of the residual and no term of the proxy.

    **Sampling** chooses between a cosine and two lobes of visible GGX normals, with probabilities that the file holds
    for each angle of incidence. ``pdf`` is exactly the density of this mixture. Sampling is detached: gradients flow
    through the value of a sample, not through its position or density.

    Colours are those of the file, in linear sRGB. In spectral variants they are upsampled, as those of textures are; in
    polarised variants, the material depolarises. Terms of the proxy that the source does not need are not computed.

    {executable}

    {example bsdf neural_bsdf: filename="paint.npz"}

    **Families**: a file that ``mi-diffind fit bsdf plastic.xml --over alpha=0.02:0.8 -o plastic.npz`` wrote holds a
    BSDF that depends on parameters. Each is a property, and may be a texture, also where the plugin that was fitted
    takes a number only, as ``roughplastic`` does. Its proxy is a table, not named parameters.

    .. tabs::
        .. code-tab:: xml
            :name: neural_bsdf-family

            <bsdf type="neural_bsdf">
                <string name="filename" value="plastic.npz"/>
                <texture name="alpha" type="bitmap">
                    <string name="filename" value="scratches.png"/>
                    <boolean name="raw" value="true"/>
                </texture>
            </bsdf>

        .. code-tab:: python

            'type': 'neural_bsdf',
            'filename': 'plastic.npz',
            'alpha': {'type': 'bitmap', 'filename': 'scratches.png', 'raw': True}
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        if "filename" not in props:
            raise RuntimeError('parameter "filename": not given, a table file is needed (mi-diffind fit bsdf)')
        properties.check_range(props, "scale", 0, 1)
        self.two_sided = properties.flag(props, "two_sided")
        self.energy = properties.one_of(props, "energy", ("source", "raw"))
        self.scale = dr.opaque(mi.Float, float(props.get("scale", 1.0)))
        self.model = open_tables(props, TASK)
        if self.energy == "raw":
            self.model.arrays.pop("energy", None)
            self.model.refresh()
        self.textures = {}
        for parameter in self.model.parameters:
            properties.check_range(props, parameter.name, parameter.low, parameter.high)
            self.textures[parameter.name] = props.get_unbounded_texture(parameter.name, parameter.middle)
        self.proxy = _parameters(self.model) if self.model.form.terms and not self.textures else {}
        self._tracked = [TrackedParameter(texture) for texture in self.textures.values()]
        self.known, self.member = [], None
        names = (*RESIDUAL, "proxy") if self.textures else RESIDUAL
        self.tables = Tables(self.model.arrays, self.model.table, names)
        self.parameters_changed()

        side = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide if self.two_sided else mi.BSDFFlags.FrontSide
        flags = mi.BSDFFlags.GlossyReflection | side
        if not self.model.form.isotropic:
            flags = flags | mi.BSDFFlags.Anisotropic
        if any(texture.is_spatially_varying() for texture in self.textures.values()):
            flags = flags | mi.BSDFFlags.SpatiallyVarying
        self.m_components = [flags]
        self.m_flags = flags

    def trained(self) -> tuple:
        """Return the table of the file, and the arrays that can be optimised, by name."""
        proxy = {"proxy": _proxy_array(self.proxy, self.model.form)} if self.proxy else {}
        return self.tables.table, {**self.tables.exposed, **proxy}

    def traverse(self, cb: mi.TraversalCallback):
        cb.put("scale", self.scale, mi.ParamFlags.Differentiable)
        for name, value in (*self.proxy.items(), *self.textures.items()):
            cb.put(name, value, mi.ParamFlags.Differentiable)
        self.tables.traverse(cb)

    def parameters_changed(self, keys: list[str] = ()):
        self.tables.accept()
        make_opaque({"scale": self.scale, **self.proxy})
        if self.proxy:  # what depends on its parameters alone, once for all lanes
            with dr.suspend_grad():
                self.constants = dr.detach(_proxy(self.proxy, self.model.form))
                dr.make_opaque(self.constants)
        if self.textures:
            when_outermost(self._compute_member)
        self._hold()

    def _hold(self) -> None:
        """Keep all arrays that are read as an attribute, for frozen functions."""
        parts = [self.model, self.member, getattr(self, "constants", None), getattr(self, "source", None)]
        self.held = [frozen_key(self.known, self.tables.shapes()), arrays_of(parts)]

    def _at(self, si, active):
        """Return the BSDF with its present parameters, and the mixture that samples it."""
        if self.textures:
            model, is_constant = self.model, self._constants()
            if any(is_constant) and is_constant == self.known:
                model = self.member
            else:
                is_constant = [False] * len(is_constant)
            textures = zip(self.textures.values(), is_constant, strict=True)
            values = [texture.eval_1(si, active) for texture, known in textures if not known]
            return model.at(values, active) if values else model
        bsdf = self.model.bsdf
        if self.proxy:
            attached = dr.grad_enabled(list(self.proxy.values()))
            bsdf = copy.copy(bsdf)  # what is traced here must not outlive the trace
            bsdf.proxy = _proxy(self.proxy, self.model.form) if attached else self.constants
        return bsdf, self.model.mixture

    def _constants(self) -> list[bool]:
        """Return which parameters of a family are constant, and neither changed nor, like the tables, optimised."""
        tables_fixed = not self.tables.optimised()
        return [tables_fixed and p.is_fixed() for p in self._tracked]

    def _compute_member(self):
        """Compute the family of the parameters that are not constant, or its member if all are."""
        for parameter in self._tracked:
            parameter.update()
        self.known, self.member, values = self._constants(), None, []
        si = dr.zeros(mi.SurfaceInteraction3f)
        with dr.suspend_grad():
            for texture, known in zip(self.textures.values(), self.known, strict=True):
                values.append(float(mi.Float(texture.eval_1(si))[0]) if known else None)
            if any(self.known):
                self.member = self.model.member(values) if all(self.known) else self.model.restrict(values)
        self._hold()

    def _prepare(self, ctx, wi, wo, active):
        """Return both directions on the front side, and the mask of lanes whose result counts."""
        if self.two_sided:
            wi, wo = mi.Vector3f(wi.x, wi.y, dr.abs(wi.z)), mi.Vector3f(wo.x, wo.y, dr.mulsign(wo.z, wi.z))
        return glossy_directions(ctx, wi, wo, active)

    def _value(self, bsdf, si, wi, wo, active):
        """Return f cos θ_o."""
        rgb = bsdf.value(wi, wo)
        factor = wo.z * clamp(self.scale, 0.0, 1.0)
        value = _spectrum([v * factor for v in rgb], si.wavelengths)
        return mi.depolarizer(mi.Spectrum(dr.select(active, value, 0)))

    @staticmethod
    def _density(mixture, wi, wo, active):
        with dr.suspend_grad():
            return dr.detach(dr.select(active, mixture.density(wi, wo), 0))

    def eval(self, ctx, si, wo, active=True):
        wi, wo, active = self._prepare(ctx, si.wi, wo, active)
        bsdf, _ = self._at(si, active)
        return self._value(bsdf, si, wi, wo, active)

    def pdf(self, ctx, si, wo, active=True):
        wi, wo, active = self._prepare(ctx, si.wi, wo, active)
        _, mixture = self._at(si, active)
        return self._density(mixture, wi, wo, active)

    def eval_pdf(self, ctx, si, wo, active=True):
        wi, wo, active = self._prepare(ctx, si.wi, wo, active)
        bsdf, mixture = self._at(si, active)
        return self._value(bsdf, si, wi, wo, active), self._density(mixture, wi, wo, active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        up = mi.Vector3f(0, 0, 1)
        wi, _, active = self._prepare(ctx, si.wi, dr.select(si.wi.z < 0, -up, up) if self.two_sided else up, active)
        bsdf, mixture = self._at(si, active)
        with dr.suspend_grad():
            wo = dr.detach(mixture.sample(wi, sample1, sample2.x, sample2.y))
            active = active & (wo.z > 0) & (dr.squared_norm(wo) < 2)
            wo = dr.select(active, wo, up)
        pdf = self._density(mixture, wi, wo, active)
        active = active & (pdf > SMALLEST_DENSITY)
        value = self._value(bsdf, si, wi, wo, active)
        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = mi.Vector3f(wo.x, wo.y, dr.mulsign(wo.z, si.wi.z)) if self.two_sided else wo
        bs.eta = 1.0
        bs.sampled_component = 0
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        bs.pdf = dr.select(active, pdf, 0)
        return bs, dr.select(active, value * dr.rcp(dr.select(active, pdf, 1)), 0)

    def report(self) -> dict:
        """Return a description of this instance, for ``mi-diffind inspect``.

        Keys: ``preset``, ``effects_in_use``, ``effects_left_out`` (effect → reason), ``storage`` and ``table_bytes``.
        """
        form, arrays = self.model.form, self.model.arrays
        left_out = {name: "the source does not need it" for name in TERMS if form.terms and name not in form.terms}
        if not form.terms:
            left_out = {"proxy": f"the preset {self.model.table.preset} has none"}
        if "energy" not in arrays:
            left_out["energy"] = "energy is raw" if "energy" in self.model.table.arrays else "the file has no limit"
        in_use = ["residual", *form.terms, *(["energy"] if "energy" in arrays else [])]
        return {
            **self.tables.report(),
            "effects_in_use": in_use,
            "effects_left_out": left_out,
        }

    def to_string(self):
        report = self.report()
        lines = (
            f"source = {self.model.table.settings.get('name', '')}",
            f"scale = {self.scale}",
            *(f"{name} = {texture!s}" for name, texture in self.textures.items()),
            f"{report['table_bytes']} bytes as {report['storage']}",
            f"effects = {', '.join(report['effects_in_use'])}",
        )
        return f"NeuralBSDF[\n  {(',' + chr(10) + '  ').join(lines)}\n]"


def _names(form) -> dict[str, tuple[slice, float]]:
    """Return name of a parameter of the proxy → its place in a file, and the factor on what the file holds there."""
    names = {"diffuse": (DIFFUSE, 1), "edge": (slice(EDGE, EDGE + 1), 1)} if "diffuse" in form.terms else {}
    axes = {"alpha_u": (0, 1, 1)} | ({} if form.isotropic else {"alpha_v": (1, 2, 1)})
    parts = {**axes, "gamma": (2, 3, 2), "f0": (3, 6, 1), "f90": (6, 9, 1)}
    for k, term in enumerate(TERMS[1:]):
        a = 4 + k * LOBE
        if term in form.terms:
            names |= {f"{term}.{n}": (slice(a + i, a + j), factor) for n, (i, j, factor) in parts.items()}
    return names


def _parameters(model) -> dict:
    """Return the proxy's parameters by name, in linear units."""
    values = np.exp(np.clip(model.arrays["proxy"].numpy().ravel().astype(np.float64), *LOGARITHMS))
    result = {}
    for name, (place, factor) in _names(model.form).items():
        numbers = [dr.opaque(mi.Float, float(factor * v)) for v in values[place]]
        result[name] = mi.Color3f(*numbers) if len(numbers) == 3 else numbers[0]
    return result


def _proxy(parameters: dict, form) -> Proxy:
    """Return the proxy of parameters by name, limited to what is finite."""
    low, high = (float(np.exp(x)) for x in LOGARITHMS)

    def limited(value):
        return clamp(value, low, high)

    lobes = {}
    for name in TERMS[1:]:
        if name in form.terms:
            axes = ("alpha_u",) if form.isotropic else ("alpha_u", "alpha_v")
            alphas = tuple(clamp(parameters[f"{name}.{axis}"], ALPHA_MIN, 1.0) for axis in axes)
            colours = [[limited(c) for c in parameters[f"{name}.{key}"]] for key in ("f0", "f90")]
            gamma = clamp(parameters[f"{name}.gamma"], 2 * low, 2 * high)  # files hold the logarithm of its half
            lobes[name] = ProxyLobe.from_parameters(alphas, gamma, *colours)
    if "diffuse" not in form.terms:
        return Proxy.from_parts(None, None, lobes)
    return Proxy.from_parts([limited(c) for c in parameters["diffuse"]], limited(parameters["edge"]), lobes)


def _proxy_array(parameters: dict, form) -> DifferentiableArray:
    """Return the logarithms of parameters as the array ``proxy`` of a file."""
    values = np.full(PARAMETERS, np.exp(LOGARITHMS[0]))
    for name, (place, factor) in _names(form).items():
        value = dr.detach(parameters[name])
        values[place] = np.ravel(value.numpy())[: place.stop - place.start] / factor
        if name.endswith("alpha_u"):  # of isotropic files, both
            values[place.start + 1] = values[place.start]
    logarithms = np.log(np.maximum(values, np.exp(LOGARITHMS[0]))).astype(np.float32)[:, None]
    return DifferentiableArray((PARAMETERS,), 1, logarithms).alloc(mi.TensorXf)


def _spectrum(rgb: list, wavelengths):
    """Return a spectrum for linear sRGB, whose components may exceed 1."""
    if mi.is_monochromatic:
        return mi.UnpolarizedSpectrum(mi.luminance(mi.Color3f(*rgb)))
    if not mi.is_spectral:
        return mi.UnpolarizedSpectrum(*rgb)
    largest = dr.maximum(dr.maximum(dr.maximum(rgb[0], rgb[1]), rgb[2]), 1e-20)
    return largest * textures.upsampled_spectrum([v / largest for v in rgb], wavelengths)


class SourceBSDF(NeuralBSDF):
    """Source of a table file in its place: at one point of its textures, or not a plugin of Mitsuba. The file samples.

    ``truth`` is a :class:`mi_diffind.tasks.bsdf.measured.Truth`.
    """

    def __init__(self, props: mi.Properties, truth):
        self.source = truth
        super().__init__(props)

    def value(self, wi, wo) -> list:
        """Return the source's f, without the cosine."""
        return [v / wo.z for v in self.source.value(wi, wo)]

    def _at(self, si, active):
        return self, super()._at(si, active)[1]


def _learned_or_source(props: mi.Properties):
    """Return the learned BSDF, or with ``evaluate="source"`` its source. Raises ``RuntimeError``."""
    if properties.one_of(props, "evaluate", ("learned", "source")) == "learned":
        return NeuralBSDF(props)
    learned = NeuralBSDF(props)  # checks the properties
    with properties.refused_as():
        truth = _source(learned, props)
    if isinstance(truth, MitsubaTruth) and not _is_textured(truth.bsdf):
        if learned.two_sided and not mi.has_flag(truth.bsdf.flags(), mi.BSDFFlags.BackSide):
            return mi.load_dict({"type": "twosided", "bsdf": truth.bsdf})
        return truth.bsdf
    return SourceBSDF(props, truth)


def _is_textured(bsdf) -> bool:
    """Return whether a BSDF differs from place to place; plugins of Mitsuba do not all set a flag."""
    nodes = compat.scene_objects(bsdf)
    varies = any(isinstance(node, mi.Texture) and node.is_spatially_varying() for node in nodes)
    return varies or mi.has_flag(bsdf.flags(), mi.BSDFFlags.SpatiallyVarying)


def _source(learned: NeuralBSDF, props: mi.Properties):
    """Return the source of a learned BSDF; of a family, with the parameters of the scene."""
    model, name = learned.model, learned.model.table.path
    if "scale" in props and props["scale"] != 1:
        raise UsageError(f'parameter "scale": found {props["scale"]:g}, the source of {name} has none')
    if not learned.textures:
        truth = model.source()
        if not truth.function:
            raise UsageError(f"{name}: its source, {truth.name}, is rows of measured values, which show no picture")
        return truth
    coordinates = []
    for p in model.parameters:
        if p.name in props and not properties.is_number(props, p.name):
            raise UsageError(f'parameter "{p.name}": found a texture, the source of {name} is compared at numbers')
        coordinates.append(float(p.coordinate(mi.Float(props.get(p.name, p.middle)))[0]))
    return model.family().at(coordinates)


def _to_source(props: mi.Properties) -> str:
    """Change the properties to those of the source, and return the name of its plugin."""
    props["evaluate"] = "source"
    return "neural_bsdf"


PLUGIN = Plugin(
    "neural_bsdf",
    "bsdf",
    _learned_or_source,
    task="bsdf",
    storage="uint8",
    exact=Counterpart("source", ("energy", "storage"), convert=_to_source),
)
