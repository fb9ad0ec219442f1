"""The Disney BRDF by arithmetic."""

from __future__ import annotations  # Delayed parsing of type annotations

import drjit as dr
import mitsuba as mi

from mi_diffind.tasks.disney import model, sampling
from mi_diffind.tasks.disney.decoder import GROUPS, Decoder, Lobe
from mi_diffind.tasks.disney.model import LOBES, Effects, find_effects

from . import Counterpart, Plugin, Stock
from .support import properties
from .support.bsdfs import TrackedParameter, are_directions, when_outermost
from .support.manual import shared_parts
from .support.properties import Kept, StockNode
from .support.tables import Tables, arrays_of, frozen_key, make_opaque

_DIFFERENTIABLE = mi.ParamFlags.Differentiable
_DISCONTINUOUS = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous

#: Largest index of refraction whose reflectance the model is asked to express (``specular`` = 3.1).
ETA_MAX = 3.0

#: Largest sampling rate of a lobe; sums of rates fit single precision.
LARGEST_RATE = 1e30

#: Samples of a smaller density count as failed. They are next to none, 10⁻¹¹ of all, at the very horizon, and the
#: derivative of a value, multiplied by the density's inverse, would leave the range of floats.
_SMALLEST_DENSITY = 1e-12


@shared_parts
class Disney(mi.BSDF):
    r"""
    .. _bsdf-disney:

    Disney BRDF (:monosp:`disney`)
    ------------------------------

    .. pluginparameters::

     * - base_color
       - |spectrum| or |texture|
       - The albedo of the material. (Default: 0.5)
       - |exposed|, |differentiable|

     * - roughness
       - |float| or |texture|
       - Roughness of the diffuse and of the specular lobe; GGX :math:`\alpha = \mathrm{roughness}^2`, at least
         :math:`10^{-3}`. (Default: 0.5)
       - |exposed|, |differentiable|, |discontinuous|

     * - anisotropic
       - |float| or |texture|
       - Stretches the highlight along the tangent. (Default: 0.0)
       - |exposed|, |differentiable|

     * - metallic
       - |float| or |texture|
       - Blends from a dielectric with diffuse reflection to a metal coloured by the albedo. (Default: 0.0)
       - |exposed|, |differentiable|

     * - specular
       - |float| or |texture|
       - Reflectance of the dielectric at normal incidence, as a fraction of 0.08. (Default: 0.5)
       - |exposed|, |differentiable|, |discontinuous|

     * - eta
       - |float| or |texture|
       - Relative index of refraction in [1, 3], in place of ``specular``: reflectance
         :math:`((\eta - 1)/(\eta + 1))^2`.
       - |exposed|, |differentiable|, |discontinuous|

     * - spec_tint
       - |float| or |texture|
       - Tints the dielectric's specular reflection with the albedo's hue. (Default: 0.0)
       - |exposed|, |differentiable|

     * - sheen
       - |float| or |texture|
       - An additional grazing reflection, for cloth. (Default: 0.0)
       - |exposed|, |differentiable|

     * - sheen_tint
       - |float| or |texture|
       - Tints the sheen with the albedo's hue. (Default: 0.0)
       - |exposed|, |differentiable|

     * - flatness
       - |float| or |texture|
       - Blends the diffuse lobe to an approximation of subsurface scattering. Also accepted as ``subsurface``.
         (Default: 0.0)
       - |exposed|, |differentiable|

     * - clearcoat
       - |float| or |texture|
       - Strength of a second, colourless specular lobe. (Default: 0.0)
       - |exposed|, |differentiable|

     * - clearcoat_gloss
       - |float| or |texture|
       - Gloss of the clearcoat, from satin (0) to gloss (1). (Default: 0.0)
       - |exposed|, |differentiable|

     * - spec_trans
       - |float|
       - Accepted if 0, so that scenes for :monosp:`principled` can be kept: the model has no transmission.
         (Default: 0.0)
       - --

     * - effects
       - |string|
       - ``used``: only the parts of the model that the material makes use of are traced and sampled; ``all``: all of
         them. (Default: ``used``)
       - --

     * - diffuse_reflectance_sampling_rate, main_specular_sampling_rate, clearcoat_sampling_rate
       - |float|
       - Factors on the share of samples that each lobe gets. (Default: 1.0)
       - |exposed|

    The reflection model of *Physically Based Shading at Disney* (Burley 2012), rearranged for speed: equal to the
    published formulas up to rounding (159 dB). It is the exact counterpart of
    :ref:`neural_disney <bsdf-neural_disney>`. Names and meaning of the parameters follow Mitsuba's
    :monosp:`principled`: to switch, change ``type``. All parameters but ``eta`` are in [0, 1]: numbers outside are
    refused, textures are clamped.

    **The model differs from** :monosp:`principled`: it has Schlick's Fresnel term in place of the dielectric one, which
    makes images of two scenes 0.1% and 0.8% darker, and a polished floor of ``specular`` 0.1 15% brighter at 11°; it
    has no transmission; and ``eta`` is limited to 1 to 3.
    ``mi-diffind compare --against principled`` shows a scene with both.

    **Only the effects in use are computed.** A part of the model that the parameters make zero (``clearcoat`` 0,
    ``metallic`` 1, a black texture, the tint of a grey albedo, …) is neither traced nor sampled. The effects in use are
    determined when the scene is loaded and whenever parameters change. A parameter with gradients enabled always counts
    as in use, and so does a texture whose bounds are unknown. Known are those of constants and bitmaps, and the
    constant maps of compressed files.
    ``mi-diffind inspect SCENE.xml`` lists the other effects and the reasons. Terms that depend on constant parameters
    alone are evaluated once, not for each sample.

    The material reflects on the front side only; nest it in :monosp:`twosided` for both sides. Components: 0 diffuse
    and sheen, 1 specular, 2 clearcoat.

    Values and gradients are finite for every input: grazing directions, roughness 0, black albedo. Sampling is
    detached: gradients flow through the value of a sample, not through its position or density, which keeps them
    unbiased where the choice of a lobe depends on a parameter.

    {executable}

    {example bsdf disney: base_color=[0.8, 0.2, 0.1], roughness=0.3, clearcoat=1.0, clearcoat_gloss=0.9}
    """

    #: Parameter → default, in the order of the manual page.
    DEFAULTS = {  # noqa: RUF012
        "roughness": 0.5, "anisotropic": 0.0, "metallic": 0.0, "spec_tint": 0.0, "sheen": 0.0, "sheen_tint": 0.0,
        "flatness": 0.0, "clearcoat": 0.0, "clearcoat_gloss": 0.0,
    }  # fmt: skip

    RATES = {  # noqa: RUF012
        "diffuse": "diffuse_reflectance_sampling_rate",
        "specular": "main_specular_sampling_rate",
        "clearcoat": "clearcoat_sampling_rate",
    }

    def __init__(self, props: mi.Properties):
        super().__init__(props)

        if "subsurface" in props and "flatness" in props:
            raise RuntimeError('parameter "subsurface": is another name of "flatness", give only one of the two')
        aliases = {"flatness": "subsurface"} if "subsurface" in props else {}
        self.base_color = props.get_texture("base_color", 0.5)
        properties.check_range(props, "base_color", 0, 1)
        self.scalars = {}
        for name, default in self.DEFAULTS.items():
            given = aliases.get(name, name)
            self.scalars[name] = props.get_texture(given, default)
            properties.check_range(props, given, 0, 1)

        # As in `principled`, a constant is exposed under its own name and not as a texture's value
        if "eta" in props and "specular" in props:
            raise RuntimeError('parameter "eta": sets the same reflectance as "specular", give only one of the two')
        self.reflectance_name = "eta" if "eta" in props else "specular"
        low, high = (1, ETA_MAX) if self.reflectance_name == "eta" else (0, 1)
        name = self.reflectance_name
        properties.check_range(props, name, low, high)
        if name not in props or properties.is_number(props, name):
            self.reflectance = mi.Float(float(props.get(name, 0.5)))
            dr.make_opaque(self.reflectance)
        else:
            self.reflectance = props.get_texture(name)

        if "spec_trans" in props:
            given = f"{float(props['spec_trans']):g}" if properties.is_number(props, "spec_trans") else "a texture"
            props.get_texture("spec_trans", 0.0)
            if given != "0":
                raise RuntimeError(
                    f'parameter "spec_trans": found {given}, but this model has no transmission, only 0 is allowed; '
                    'use Mitsuba\'s "principled" for it'
                )

        self.rates = {}
        for lobe, name in self.RATES.items():
            rate = float(props.get(name, 1.0))
            if not 0 <= rate <= LARGEST_RATE:  # NaN, too
                raise RuntimeError(f'parameter "{name}": found {rate:g}, allowed is [0, {LARGEST_RATE:g}]')
            self.rates[lobe] = mi.Float(rate)
            dr.make_opaque(self.rates[lobe])

        number = "anisotropic" not in props or properties.is_number(props, "anisotropic")
        self._is_anisotropic = not number or float(props.get("anisotropic", 0.0)) > 0
        self._set_flags(any(t.is_spatially_varying() for t in self._textures().values()), self._is_anisotropic)

        self.effects = properties.one_of(props, "effects", ("used", "all"))
        #: The form of the model that computes coefficients and values, by arithmetic or from tables.
        self.decoder, self.tables = Decoder(), Tables({})
        #: Name of a parameter of the model → its bounds and changes.
        self._tracked = {
            "base_color": TrackedParameter(self.base_color, colour=True),
            **{name: TrackedParameter(texture) for name, texture in self.scalars.items()},
            "specular": TrackedParameter(self.reflectance, is_eta=self.reflectance_name == "eta"),
        }
        self._set_up(props)
        #: Coefficients that depend on constants alone, evaluated, and the effects that they are for.
        self._constant: dict[str, dict] = {}
        self._constant_for: Effects | None = None
        when_outermost(self._prepare_constants)

    def _set_up(self, props: mi.Properties) -> None:
        """Read the properties of a learned form, before anything is evaluated."""

    def _set_flags(self, varies: bool, is_anisotropic: bool, sides=mi.BSDFFlags.FrontSide) -> None:
        if varies:
            sides = sides | mi.BSDFFlags.SpatiallyVarying
        glossy = mi.BSDFFlags.GlossyReflection | sides
        anisotropic = glossy | mi.BSDFFlags.Anisotropic
        self.m_components = [mi.BSDFFlags.DiffuseReflection | sides, anisotropic if is_anisotropic else glossy, glossy]
        self.m_flags = self.m_components[0] | self.m_components[1] | self.m_components[2]

    def _parameters(self) -> dict:
        """Return the textures and numbers of the model that the material has itself, by name."""
        given = {"base_color": self.base_color, **self.scalars, self.reflectance_name: self.reflectance}
        return {name: value for name, value in given.items() if value is not None}

    def _textures(self) -> dict[str, mi.Texture]:
        return {name: v for name, v in self._parameters().items() if not isinstance(v, dr.ArrayBase)}

    def traverse(self, cb: mi.TraversalCallback):
        for name, value in self._parameters().items():
            cb.put(name, value, _DISCONTINUOUS if name in ("roughness", "specular", "eta") else _DIFFERENTIABLE)
        for lobe, name in self.RATES.items():
            cb.put(name, self.rates[lobe], mi.ParamFlags.NonDifferentiable)
        self.tables.traverse(cb)

    def parameters_changed(self, keys: list[str] = ()):
        self.tables.accept()
        rates = {name: self.rates[lobe] for lobe, name in self.RATES.items()}
        make_opaque(rates | {name: v for name, v in self._parameters().items() if isinstance(v, dr.ArrayBase)})
        self._prepare_constants()

    def _find_effects(self) -> tuple[Effects, dict[str, str]]:
        """Return the parts of the model in use, and the reasons for the others, from the bounds last determined."""
        if self.effects == "all":
            return Effects(), {}
        return find_effects({name: parameter.bounds() for name, parameter in self._tracked.items()})

    def _effects(self) -> Effects:
        """Return the parts of the model in use at present."""
        parameters = self._tracked.values()
        stale = self.effects == "used" and not dr.flag(dr.JitFlag.SymbolicScope)
        if stale and any(p.changed() and not p.optimised() for p in parameters):
            self._prepare_constants()  # a texture was updated without a notification
        return self._find_effects()[0]

    def _is_constant(self, group: str) -> bool:
        """Return whether a group of coefficients depends on constants alone, neither optimised nor changed."""
        reads_optimised_tables = group not in GROUPS and self.tables.optimised()
        return not reads_optimised_tables and all(self._tracked[p].is_fixed() for p in self.decoder.groups[group])

    def _prepare_constants(self) -> None:
        """Determine the parameters' bounds, and evaluate the groups of coefficients that depend on constants alone."""
        for parameter in self._tracked.values():
            parameter.update()
        effects, _ = self._find_effects()
        groups = sorted({*self.decoder.required(effects), *sampling.required(effects)})
        parameters = self._point(mi.BSDFContext(), dr.zeros(mi.SurfaceInteraction3f), True).parameters
        with dr.suspend_grad():
            constant = {
                group: self.decoder.coefficients(group, parameters, effects)
                for group in groups
                if self._is_constant(group)
            }
        dr.make_opaque(constant)
        self._constant, self._constant_for = constant, effects
        key = frozen_key(effects.names, sorted(constant), self.tables.shapes())
        self.held = [key, arrays_of([constant, self.tables.arrays])]

    def report(self) -> dict:
        """Return a description of this instance, for ``mi-diffind inspect``.

        Keys: ``preset`` of its tables ("" without tables), ``effects_in_use``, ``effects_left_out`` (effect → reason),
        ``evaluated_once`` (groups of coefficients), ``storage`` and ``table_bytes``.
        """
        effects, reasons = self._find_effects()
        return {
            **self.tables.report(),
            "effects_in_use": list(effects.names),
            "effects_left_out": reasons,
            "evaluated_once": sorted(self._constant),
        }

    def _read(self, name: str, si: mi.SurfaceInteraction3f, active: mi.Bool):
        """Return a parameter at ``si``, clamped to its range (NaN → 0), since textures and optimisers overshoot."""
        if name == "base_color":
            return mi.UnpolarizedSpectrum(model.clamp(self.base_color.eval(si, active), 0.0, 1.0))
        if name != "specular":
            return model.clamp(self.scalars[name].eval_1(si, active), 0.0, 1.0)
        texture = isinstance(self.reflectance, mi.Texture)
        value = self.reflectance.eval_1(si, active) if texture else self.reflectance
        if self.reflectance_name == "eta":
            value = model.specular_from_eta(value)
        return model.clamp(value, 0.0, model.specular_from_eta(ETA_MAX))

    def _rates(self, ctx: mi.BSDFContext, effects: Effects) -> dict[str, mi.Float]:
        """Return the sampling rates of the lobes that are in use and enabled in the context."""
        flags = (mi.BSDFFlags.DiffuseReflection, mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.GlossyReflection)
        return {
            lobe: model.clamp(self.rates[lobe], 0.0, 1e6)
            for component, (lobe, flag) in enumerate(zip(LOBES, flags, strict=True))
            if lobe in effects.lobes and ctx.is_enabled(flag, component)
        }

    def _point(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, active: mi.Bool) -> ShadedPoint:
        """Return the parameters and the frame at a hit."""
        return ShadedPoint(Parameters(self, si, active), si.wi)

    def _surface(self, point: ShadedPoint, effects: Effects, value: bool = True, density: bool = True) -> dict:
        """Return the coefficients that values and densities need.

        All coefficients are computed here: at their first use, derivatives may be suspended.
        """
        groups = (*(self.decoder.required(effects) if value else ()), *(sampling.required(effects) if density else ()))
        usable = self._constant if effects == self._constant_for else {}
        coefficients = {}
        for group in dict.fromkeys(groups):
            # Gradients may have been enabled, and textures updated, since
            if group in usable and self._is_constant(group):
                coefficients[group] = usable[group]
            else:
                coefficients[group] = self.decoder.coefficients(group, point.parameters, effects)
        return coefficients

    def _prepare(self, point: ShadedPoint, wo, active):
        """Return both directions in the point's frame, and the mask of lanes whose result counts.

        Directions are safe to compute with in every lane.
        """
        inside, above = point.enter(wo)
        active = active & point.above & above & are_directions(point.wi, inside)
        up = mi.Vector3f(0, 0, 1)
        return dr.select(active, point.wi, up), dr.select(active, inside, up), active

    def _value(self, point, coefficients, effects, lobes, wo, directions):
        wi, inside, active = directions
        value = self.decoder.value(coefficients, effects, lobes, point.parameters, wi, inside)
        value = mi.UnpolarizedSpectrum(value) * point.factor(wo, active)
        return mi.depolarizer(mi.Spectrum(dr.select(active, value, 0)))

    def _density(self, point, coefficients, effects, rates, directions):
        wi, inside, active = directions
        # Detached, see the manual page
        with dr.suspend_grad():
            probabilities = sampling.lobe_probabilities(coefficients, effects, wi.z, rates)
            pdf = sampling.density(coefficients, effects, probabilities, wi, inside)
            return dr.detach(dr.select(active, mi.Float(pdf) * point.share, 0))

    def eval(self, ctx, si, wo, active=True):
        return self._answer(ctx, si, wo, active, density=False)[0]

    def pdf(self, ctx, si, wo, active=True):
        return self._answer(ctx, si, wo, active, value=False)[1]

    def eval_pdf(self, ctx, si, wo, active=True):
        return self._answer(ctx, si, wo, active)

    def _answer(self, ctx, si, wo, active, value: bool = True, density: bool = True) -> tuple:
        """Return the value and the density, ``None`` for the one that is not asked for."""
        point, effects = self._point(ctx, si, active), self._effects()
        coefficients, rates = self._surface(point, effects, value, density), self._rates(ctx, effects)
        return self._eval_pdf(point, coefficients, effects, rates, wo, active, value, density)

    def _eval_pdf(self, point, coefficients, effects, rates, wo, active, value=True, density=True) -> tuple:
        directions = self._prepare(point, wo, active)
        return (
            self._value(point, coefficients, effects, tuple(rates), wo, directions) if value else None,
            self._density(point, coefficients, effects, rates, directions) if density else None,
        )

    def sample(self, ctx, si, sample1, sample2, active=True):
        return self._sample(ctx, self._point(ctx, si, active), sample1, sample2, active)

    def _sample(self, ctx, point: ShadedPoint, sample1, sample2, active):
        """Return :meth:`sample` at a point."""
        effects = self._effects()
        rates = self._rates(ctx, effects)
        active = active & point.above
        wi = dr.select(active, point.wi, mi.Vector3f(0, 0, 1))
        c = self._surface(point, effects)

        bs = dr.zeros(mi.BSDFSample3f)
        with dr.suspend_grad():
            # The specular lobe is what remains: it is also what a context without any lobe "samples", with density 0
            p = sampling.lobe_probabilities(c, effects, wi.z, rates)
            half = _visible_normal(c["ggx"]["alpha"], wi, sample2)
            component = mi.UInt32(1)
            threshold = mi.Float(0)
            if "diffuse" in p:
                threshold = p["diffuse"]
                is_diffuse = sample1 < threshold
                component = dr.select(is_diffuse, 0, component)
            if "clearcoat" in p:
                is_coat = (sample1 >= threshold) & (sample1 < threshold + p["clearcoat"])
                component = dr.select(is_coat, 2, component)
                coat_half = mi.Normal3f(*sampling.sample_gtr1(c["coat"]["a2"], c["coat"]["log"], sample2))
                half = dr.select(is_coat, coat_half, half)
            wo = mi.reflect(wi, half)
            if "diffuse" in p:
                wo = dr.select(is_diffuse, mi.warp.square_to_cosine_hemisphere(sample2), wo)
            active &= dr.isfinite(wo.z) & (wo.z > 0)
            wo = dr.detach(point.leave(dr.select(dr.isfinite(wo.z), wo, mi.Vector3f(0, 0, 1))))

        bs.wo = wo
        bs.eta = 1.0
        bs.sampled_component = component
        bs.sampled_type = dr.select(
            component == 0, mi.UInt32(+mi.BSDFFlags.DiffuseReflection), mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        )

        value, pdf = self._eval_pdf(point, c, effects, rates, wo, active)
        active &= pdf > _SMALLEST_DENSITY
        bs.pdf = dr.select(active, pdf, 0)
        return bs, dr.select(active, value / dr.select(active, bs.pdf, 1), 0)

    def eval_diffuse_reflectance(self, si, active=True):
        return mi.depolarizer(mi.Spectrum(self.base_color.eval(si, active)))

    def to_string(self):
        lines, report = [f"{name} = {value}" for name, value in self._parameters().items()], self.report()
        if report["storage"]:
            lines.append(f"preset = {report['preset']}, {report['table_bytes']} bytes as {report['storage']}")
        lines.append(f"effects = {', '.join(report['effects_in_use'])}")
        return f"{type(self).__name__}[\n  " + ",\n".join(lines).replace("\n", "\n  ") + "\n]"


def _visible_normal(alpha: tuple, wi: mi.Vector3f, sample: mi.Point2f) -> mi.Normal3f:
    """Return a visible normal of GGX: ``alpha`` has α along both axes, or the three of :func:`.decoder.sheared_ggx`.

    The latter stretch a surface of α = 1, seen from a direction that is stretched likewise.
    """
    if len(alpha) == 2:
        return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, *alpha, True).sample(wi, sample)[0]
    xx, yx, yy = alpha
    wi = dr.normalize(mi.Vector3f(dr.fma(xx, wi.x, yx * wi.y), yy * wi.y, wi.z))
    half, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, 1.0, 1.0, True).sample(wi, sample)
    return dr.normalize(mi.Normal3f(xx * half.x, dr.fma(yx, half.x, yy * half.y), half.z))


class ShadedPoint:
    """Surface point as the lobes see it: parameters, and the direction ``wi`` in the frame that they reflect in.

    ``above``: lanes in which the viewer is on the front side; ``share``: probability that sampling chooses a lobe. This
    frame is that of the surface.
    """

    share: mi.Float | float = 1.0

    def __init__(self, parameters: Parameters, wi: mi.Vector3f):
        self.parameters, self.wi, self.above = parameters, wi, wi.z > 0

    def enter(self, wo: mi.Vector3f) -> tuple[mi.Vector3f, mi.Bool]:
        """Return a direction of the surface's frame in this one, and the lanes in which it leaves the front side."""
        return wo, wo.z > 0

    def leave(self, wo: mi.Vector3f) -> mi.Vector3f:
        """Return a direction of this frame in that of the surface."""
        return wo

    def factor(self, wo: mi.Vector3f, active: mi.Bool) -> mi.Float | float:
        """Return a factor on the values towards a direction of the surface's frame, in active lanes."""
        return 1.0


class Parameters:
    """Parameters of a material at a surface interaction: ``roughness``, …, ``specular``, ``albedo``, ``luminance``.

    Each is read at its first use, so unused parameters are not read. ``lobe`` is the shape of the specular lobe
    (:class:`.decoder.Lobe`), ``None`` if ``anisotropic`` shapes it.
    """

    lobe: Lobe | None = None

    def __init__(self, bsdf: Disney, si: mi.SurfaceInteraction3f, active: mi.Bool):
        self._bsdf, self._si, self._active = bsdf, si, active

    def __getattr__(self, name: str):
        if name.startswith("_"):
            raise AttributeError(name)
        if name == "luminance":
            value = luminance(self.albedo, self._si)
        else:
            value = self._bsdf._read("base_color" if name == "albedo" else name, self._si, self._active)
        setattr(self, name, value)
        return value


def luminance(albedo, si: mi.SurfaceInteraction3f):
    """Return the luminance of an albedo, 1 for white."""
    if mi.is_monochromatic:
        return albedo[0]
    if mi.is_rgb:
        return mi.luminance(albedo)
    # Mean over the sampled wavelengths, weighted by the luminous efficiency: 1 for a white albedo at any wavelengths
    # (Mitsuba's `luminance` alone varies with them)
    weight = mi.luminance(mi.UnpolarizedSpectrum(1), si.wavelengths) + 1e-6
    return (mi.luminance(albedo, si.wavelengths) + 1e-6 * dr.mean(albedo)) / weight


def to_principled(props: mi.Properties) -> None:
    """Change properties to those of ``principled``, which takes no textures for ``specular`` and ``eta``."""
    for name in ("specular", "eta"):
        if name in props and not properties.is_number(props, name):
            raise RuntimeError(f'parameter "{name}": is a texture, but "principled" takes only a number')
    if "subsurface" in props:
        props["flatness"] = props["subsurface"]
        del props["subsurface"]


#: Mitsuba's own model with the same parameters.
PRINCIPLED = Counterpart("principled", ("effects", "preset", "filename", "storage"), convert=to_principled)

#: Least ``specular`` and ``eta`` of a metal. Where the dielectric Fresnel term is 0, ``principled`` leaves out the
#: metal's reflection, too; of a material that transmits light, it replaces 0 and 1 by these values itself.
METALS = {"specular": 1e-3, "eta": 1.001}

#: Least values for dielectrics. Schlick's term of the Disney BRDF is 1 at grazing angles; the dielectric one is less,
#: the nearer the index of refraction is to 1. A floor of roughness 0.1 seen at 11° is 76% brighter with ``specular`` 0,
#: 15% with 0.1 and 2% with 0.5.
DIELECTRICS = {"specular": 0.1, "eta": 1.2}


def check_principled(node: StockNode) -> None:
    """Raise :class:`.Kept` for a ``principled`` that is not within the model, whose parameters have the same names."""
    props = node.props
    if "spec_trans" in props and not (properties.is_number(props, "spec_trans") and float(props["spec_trans"]) == 0):
        raise Kept("transmits light (spec_trans), which the Disney BRDF does not")
    unit = ("base_color", *Disney.DEFAULTS, "specular")
    node.allow(*unit, "eta", "spec_trans", *Disney.RATES.values())
    for name, low, high in (*((name, 0, 1) for name in unit), ("eta", 1, ETA_MAX)):
        if name in props and properties.is_number(props, name) and not low <= float(props[name]) <= high:
            raise Kept(f'has the parameter "{name}" {float(props[name]):g}, the Disney BRDF allows {low} to {high:g}')
    textured = "metallic" in props and not properties.is_number(props, "metallic")
    share = 0.5 if textured else float(props.get("metallic", 0))
    for name, least in (METALS if share == 1 else DIELECTRICS).items():
        if name in props and properties.is_number(props, name) and float(props[name]) < least:
            value = f'"{name}" {float(props[name]):g}'
            if share and float(props[name]) < METALS[name]:
                raise Kept(f"is a metal with {value}, whose reflection Mitsuba leaves out")
            raise Kept(f"has the {value}, below {least:g} the Disney BRDF reflects more at grazing angles")


PLUGIN = Plugin(
    "disney", "bsdf", Disney, others=(PRINCIPLED,),
    stock=Stock("disney", ("principled",), lambda node: check_principled(node) or ""),
)  # fmt: skip
