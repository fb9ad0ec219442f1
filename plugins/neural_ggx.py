"""Rough conductor whose distribution of normals is read from tables."""

from __future__ import annotations  # Delayed parsing of type annotations

import drjit as dr
import mitsuba as mi

from mi_diffind.tasks.ggx import TASK
from mi_diffind.tasks.ggx.model import Roughness

from . import Counterpart, Plugin
from .support import properties
from .support.bsdfs import TrackedParameter, glossy_directions, when_outermost
from .support.manual import shared_parts
from .support.tables import Tables, arrays_of, frozen_key, open_tables


@shared_parts
class NeuralGGX(mi.BSDF):
    r"""
    .. _bsdf-neural_ggx:

    Rough conductor from tables (:monosp:`neural_ggx`)
    --------------------------------------------------

    .. pluginparameters::

     * - material
       - |string|
       - Name of the material preset, as for :monosp:`roughconductor`. (Default: none)
       - --

     * - eta, k
       - |spectrum| or |texture|
       - Real and imaginary components of the material's index of refraction. (Default: those of ``material``; without
         a material 0 and 1, which reflects all light)
       - |exposed|, |differentiable|, |discontinuous|

     * - specular_reflectance
       - |spectrum| or |texture|
       - Factor on the reflected light. (Default: 1.0)
       - |exposed|, |differentiable|

     * - alpha
       - |float| or |texture|
       - Roughness, 0 to 1: numbers outside are refused, textures are clamped. As in :monosp:`roughconductor`, values
         below 0.0001 are raised to 0.0001. (Default: 0.1)
       - |exposed|, |differentiable|, |discontinuous|

     * - preset
       - |string|
       - ``tables``: logarithmic inputs and a bounded output, accurate also in the peak of smooth surfaces; ``paper``:
         the supplement's recipe, for comparison, which misses the peak below a roughness of about 0.5. (Default: that
         of the file, if ``filename`` is given, else ``tables``)
       - --

     * - filename
       - |string|
       - A table file, written by ``mi-diffind fit ggx``. (Default: the file that ships with the package)
       - --

     * - storage
       - |string|
       - Storage form of the tables: ``float32``, ``float16`` or ``uint8``. Only ``float32`` tables are exposed as
         parameters. (Default: that of the file; ``float32`` for files that ship)
       - --

     * - distribution, sample_visible
       - |string|, |bool|
       - Accepted so that the parameters of :monosp:`roughconductor` can be kept: only ``ggx`` and ``true`` are allowed.
         (Default: these)
       - --

     * - tables.primary, tables.cascaded
       - |tensor|
       - The entries of the two arrays.
       - |exposed|, |differentiable|

    A rough conductor whose distribution of normals D is read by *differentiable indirection* (Datta et al., *Efficient
    Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023, task 1): a primary array of 16 × 16
    × 2 entries, read at the angle of the half vector and the roughness, points into a cascaded one of 8 × 8. The exact
    counterpart is Mitsuba's :monosp:`roughconductor` with ``distribution`` ``ggx``: to switch, change ``type``. Masking
    and Fresnel terms are those of the counterpart.

    **The sampling density is normalised** although the table is approximate: directions are sampled from the visible
    normals of the *analytic* distribution, and ``pdf`` is their analytic density. Only the value is read, so an error
    of the table is an error of the image and never one of the estimator: the weight of a sample is D̂/D times that of
    the exact plugin.

    With ``tables``, D̂/D lies between 0.9 and 1.1 at any angle and roughness, in every storage form, and the mean weight
    is at most 0.02 (bytes: 0.035) above the exact one: the tail, beyond 8/9 of the projected area of the normals, is
    not read but continued by its analytic form. ``paper`` reads all of D. It underestimates the peak and overestimates
    the tail: close to the horizon, where the exact mean weight is below 1, its mean weight grows to 29 at ``alpha``
    0.0001, and single weights reach thousands.

    **Derivatives are less accurate than values**, since the slope of a bilinear read is constant between entries:
    derivatives with respect to ``alpha`` have errors of several percent on average, and close to ``alpha`` 1 may have
    the wrong sign. Fits of ``alpha`` from images still converge.

    Sampling is detached, as in ``disney``: gradients flow through the value of a sample, not through its position or
    density. Like its counterpart, the material reflects on the front side only; nest it in :monosp:`twosided` for both.

    **Only the effects in use are computed.** If ``alpha`` is constant, all terms that depend on it are evaluated once,
    and the primary array is reduced to one row, read at one coordinate. Without a metal (``eta`` 0, ``k`` 1) no Fresnel
    term is traced, and without ``specular_reflectance`` no factor.

    {executable}

    {example bsdf neural_ggx: material="Cu", alpha=0.15}
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        for name, allowed in (("distribution", "ggx"), ("sample_visible", True)):
            given = props.get(name, allowed)
            given = given.lower() if isinstance(given, str) else given
            if given != allowed:
                given, allowed = (str(v).lower() for v in (given, allowed))
                raise RuntimeError(f'parameter "{name}": found {given}, only {allowed} is allowed')
        for name in ("alpha_u", "alpha_v"):
            if name in props:
                raise RuntimeError(f'parameter "{name}": the tables are isotropic, give "alpha"')

        properties.check_range(props, "alpha", 0, 1)
        self.alpha = props.get_unbounded_texture("alpha", 0.1)
        self.eta, self.k = _index_of_refraction(props)
        has_factor = "specular_reflectance" in props
        self.specular_reflectance = props.get_texture("specular_reflectance") if has_factor else None

        opened = open_tables(props, TASK)
        self.distribution, net = opened.distribution, opened.distribution.net
        self.tables = Tables({"primary": net.primary[0], "cascaded": net.cascaded}, opened.table)

        self._tracked = {name: TrackedParameter(t, colour=name != "alpha") for name, t in self._textures().items()}
        #: Evaluated terms of a constant roughness.
        self._constant: Roughness | None = None

        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if any(texture.is_spatially_varying() for texture in self._textures().values()):
            flags = flags | mi.BSDFFlags.SpatiallyVarying
        self.m_components = [flags]
        self.m_flags = flags
        when_outermost(self._prepare_constants)

    def _textures(self) -> dict[str, mi.Texture]:
        factor = {} if self.specular_reflectance is None else {"specular_reflectance": self.specular_reflectance}
        return {"alpha": self.alpha, "eta": self.eta, "k": self.k, **factor}

    def trained(self) -> tuple:
        """Return the table of the file, and the arrays that can be optimised, by name."""
        return self.tables.table, self.tables.exposed

    def traverse(self, cb: mi.TraversalCallback):
        discontinuous = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name, texture in self._textures().items():
            flags = mi.ParamFlags.Differentiable if name == "specular_reflectance" else discontinuous
            cb.put(name, texture, flags)
        self.tables.traverse(cb)

    def parameters_changed(self, keys: list[str] = ()):
        self.tables.accept()
        self._prepare_constants()

    def _prepare_constants(self) -> None:
        for parameter in self._tracked.values():
            parameter.update()
        self._constant = None
        if self._is_constant():
            with dr.suspend_grad():
                alpha = mi.Float(self.alpha.eval_1(dr.zeros(mi.SurfaceInteraction3f)))
                constant = self.distribution.constant_roughness(alpha)
            dr.make_opaque(constant)
            self._constant = constant
        key = frozen_key(self._constant is None, self._reflects_all(), self._has_factor(), self.tables.shapes())
        self.held = [key, arrays_of([self.distribution, self._constant])]

    def _is_constant(self) -> bool:
        """Return whether the roughness is constant, and neither changed nor, like the tables, being optimised."""
        return self._tracked["alpha"].is_fixed() and not self.tables.optimised()

    def _roughness(self, si, active) -> Roughness:
        if self._constant is not None and self._is_constant():
            return self._constant
        return self.distribution.roughness(self.alpha.eval_1(si, active))

    def _reflects_all(self) -> bool:
        """Return whether the index of refraction is 0 + 1i, which reflects all light."""
        return self._tracked["eta"].bounds().is_always(0) and self._tracked["k"].bounds().is_always(1)

    def _has_factor(self) -> bool:
        factor = self._tracked.get("specular_reflectance")
        return factor is not None and not factor.bounds().is_always(1)

    def _value(self, ctx, si, r: Roughness, wi, wo, active):
        """Return f · cos = F D̂ (n·o) / (d(n·i) d(n·o)).

        Smith's masking is 2c/d(c), so that no cosine is divided by at the horizon.
        """
        h, h2, sin2 = _half_vector(wi, wo)
        cos = h.z * dr.rsqrt(h2) if self.distribution.encoding.inputs == "plain" else None
        d = self.distribution.read(r, cos, sin2, active)
        factor = mi.UnpolarizedSpectrum(d * wo.z / (_masking(r, wi.z) * _masking(r, wo.z)))
        if self._has_factor():
            factor *= mi.UnpolarizedSpectrum(self.specular_reflectance.eval(si, active))
        return dr.select(active, _scaled(self._fresnel(ctx, si, h, h2, wi, wo, active), factor), 0)

    def _fresnel(self, ctx, si, h, h2, wi, wo, active):
        """Return the reflectance of the microfacets: a colour, or a Mueller matrix."""
        if self._reflects_all() and not mi.is_polarized:
            return mi.Spectrum(1)
        cos = 0.5 * dr.sqrt(h2)  # of the angle between wi and the half vector
        # At normal incidence, the reflectance of eta = k = 0 is 0 / 0
        eta = dr.maximum(mi.UnpolarizedSpectrum(self.eta.eval(si, active)), 1e-6)
        k = mi.UnpolarizedSpectrum(self.k.eval(si, active))
        if mi.is_polarized:
            return _polarised(ctx, eta, k, h * dr.rsqrt(h2), cos, wi, wo)
        channels = range(dr.size_v(eta))
        return mi.Spectrum([mi.fresnel_conductor(cos, mi.Complex2f(eta[i], k[i])) for i in channels])

    def _density(self, r: Roughness, wi, wo, active):
        """Return the analytic density of visible normals mapped to directions, D G₁(n·i) / (4 n·i), detached."""
        with dr.suspend_grad():
            _, _, sin2 = _half_vector(wi, wo)
            q = dr.fma(1 - sin2, r.alpha2, sin2)
            pdf = r.alpha2 / (2 * dr.pi * dr.square(q) * _masking(r, wi.z))
            return dr.detach(dr.select(active, pdf, 0))

    def eval(self, ctx, si, wo, active=True):
        wi, wo, active = glossy_directions(ctx, si.wi, wo, active)
        return self._value(ctx, si, self._roughness(si, active), wi, wo, active)

    def pdf(self, ctx, si, wo, active=True):
        wi, wo, active = glossy_directions(ctx, si.wi, wo, active)
        return self._density(self._roughness(si, active), wi, wo, active)

    def eval_pdf(self, ctx, si, wo, active=True):
        wi, wo, active = glossy_directions(ctx, si.wi, wo, active)
        r = self._roughness(si, active)
        return self._value(ctx, si, r, wi, wo, active), self._density(r, wi, wo, active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        up = mi.Vector3f(0, 0, 1)
        wi, _, active = glossy_directions(ctx, si.wi, up, active)
        r = self._roughness(si, active)
        with dr.suspend_grad():
            alpha = dr.sqrt(dr.detach(r.alpha2))
            half, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(wi, sample2)
            wo = dr.detach(mi.reflect(wi, half))
            wo = dr.select(dr.squared_norm(wo) < 100, wo, -wi)  # replaces NaN and infinities

        bs = dr.zeros(mi.BSDFSample3f)
        bs.wo = wo
        bs.eta = 1.0
        bs.sampled_component = 0
        bs.sampled_type = mi.UInt32(+mi.BSDFFlags.GlossyReflection)
        active &= wo.z > 0
        safe = dr.select(active, wo, up)
        bs.pdf = self._density(r, wi, safe, active)
        active &= bs.pdf > 0
        value = self._value(ctx, si, r, wi, safe, active)
        return bs, dr.select(active, value * dr.rcp(dr.select(active, bs.pdf, 1)), 0)

    def report(self) -> dict:
        """Return a description of this instance, for ``mi-diffind inspect``.

        Keys: ``preset``, ``effects_in_use``, ``effects_left_out`` (effect → reason), ``evaluated_once``, ``storage``
        and ``table_bytes``.
        """
        left_out = {}
        if self._reflects_all() and not mi.is_polarized:
            left_out["fresnel"] = "eta is 0 and k is 1"
        if not self._has_factor():
            left_out["specular_reflectance"] = "is 1" if self.specular_reflectance else "is not given"
        effects = ("distribution", "masking", "fresnel", "specular_reflectance")
        return {
            **self.tables.report(),
            "effects_in_use": [name for name in effects if name not in left_out],
            "effects_left_out": left_out,
            "evaluated_once": [] if self._constant is None else ["roughness"],
        }

    def to_string(self):
        lines = [f"  {name} = {t!s}," for name, t in self._textures().items()]
        preset, storage, nbytes = self.tables.report().values()
        lines.append(f"  preset = {preset}, {nbytes} bytes as {storage},")
        return "NeuralGGX[\n" + "\n".join(line.replace("\n", "\n  ") for line in lines) + "\n]"


def _half_vector(wi, wo):
    """Return ``h = wi + wo``, its squared length (positive, also for opposite directions), and sin²θ_h."""
    h = wi + wo
    h2 = dr.maximum(dr.squared_norm(h), 1e-16)
    return h, h2, (dr.square(h.x) + dr.square(h.y)) * dr.rcp(h2)


def _masking(r: Roughness, c):
    """Return d(c) = c + √(c² + α² (1 − c²)); Smith's masking is 2c/d(c)."""
    c2 = dr.square(c)
    return c + dr.sqrt(dr.fma(r.alpha2, 1 - c2, c2))


def _index_of_refraction(props: mi.Properties) -> tuple[mi.Texture, mi.Texture]:
    """Return the textures ``eta`` and ``k``, given as properties or by the name of a material, as in Mitsuba."""
    material = str(props.get("material", "none"))
    if material != "none" and ("eta" in props or "k" in props):
        raise RuntimeError('parameter "material": sets "eta" and "k", give either a material or these')
    if material == "none":
        return props.get_unbounded_texture("eta", 0.0), props.get_unbounded_texture("k", 1.0)
    children = {}

    class Children(mi.TraversalCallback):
        def put(self, name, value, flags):
            children[name] = value

    try:
        mi.load_dict({"type": "roughconductor", "material": material}).traverse(Children())
    except RuntimeError as e:
        if "does not exist" not in str(e):
            raise
        raise RuntimeError(f'parameter "material": found "{material}", Mitsuba has no such preset') from None
    return children["eta"], children["k"]


def _polarised(ctx, eta, k, h, cos, wi, wo):
    """Return the Mueller matrix of a reflection by microfacets of normal ``h``, in both directions' Stokes bases.

    Light arrives along ``-wo_hat`` and leaves along ``wi_hat``.
    """
    wo_hat, wi_hat = (wo, wi) if ctx.mode == mi.TransportMode.Radiance else (wi, wo)
    channels = [mi.mueller.specular_reflection(cos, mi.Complex2f(eta[i], k[i])) for i in range(dr.size_v(eta))]
    mueller = mi.Spectrum([[mi.UnpolarizedSpectrum([m[i, j] for m in channels]) for j in range(4)] for i in range(4)])
    into, out = dr.cross(h, -wo_hat), dr.cross(h, wi_hat)  # perpendicular to the plane of reflection
    collinear = (dr.squared_norm(into) == 0) | (dr.squared_norm(out) == 0)
    axis = mi.Vector3f(1, 0, 0)
    into, out = (dr.normalize(dr.select(collinear, axis, v)) for v in (into, out))
    return mi.mueller.rotate_mueller_basis(
        mueller, -wo_hat, into, mi.mueller.stokes_basis(-wo_hat), wi_hat, out, mi.mueller.stokes_basis(wi_hat)
    )


def _scaled(reflectance, factor):
    """Return ``reflectance``, a colour or a Mueller matrix of colours, times a colour."""
    if not mi.is_polarized:
        return mi.Spectrum(reflectance * factor)
    return mi.Spectrum([[reflectance[i, j] * factor for j in range(4)] for i in range(4)])


PLUGIN = Plugin(
    "neural_ggx",
    "bsdf",
    NeuralGGX,
    task="ggx",
    exact=Counterpart("roughconductor", ("preset", "filename", "storage"), {"distribution": "ggx"}),
)
