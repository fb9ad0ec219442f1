from __future__ import annotations  # Delayed parsing of type annotations

import drjit as dr
import mitsuba as mi

from mi_diffind.tasks.ggx import TASK
from mi_diffind.tasks.ggx.model import Roughness

from . import Counterpart, Plugin
from .support import properties, tables
from .support.tracked_parameter import TrackedParameter, when_outermost


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
         one 0 and 1, which reflects everything)
       - |exposed|, |differentiable|, |discontinuous|

     * - specular_reflectance
       - |spectrum| or |texture|
       - Factor on the reflection. (Default: 1.0)
       - |exposed|, |differentiable|

     * - alpha
       - |float| or |texture|
       - Roughness, 0 to 1: numbers outside are refused, textures are clamped. As in :monosp:`roughconductor`, less than
         0.0001 counts as 0.0001. (Default: 0.1)
       - |exposed|, |differentiable|, |discontinuous|

     * - preset
       - |string|
       - ``tables``: logarithmic inputs and a bounded output, accurate also in the peak of smooth surfaces; ``paper``:
         the paper's recipe, which misses the peak below a roughness of about 0.5, for comparison. (Default: that of
         the file, if ``filename`` is given, else ``tables``)
       - --

     * - filename
       - |string|
       - Tables of one's own, as written by ``mi-diffind fit ggx``. (Default: those that ship with the package)
       - --

     * - storage
       - |string|
       - Storage form of the tables: ``float32``, ``float16`` or ``uint8``. The tables are exposed as parameters only
         in the first. (Default: the file's own, ``float32`` for those that ship)
       - --

     * - distribution, sample_visible
       - |string|, |bool|
       - Accepted for the sake of exchange with :monosp:`roughconductor`: only ``ggx`` and ``true`` are allowed.
         (Default: these)
       - --

     * - tables.primary, tables.cascaded
       - |tensor|
       - The entries of the two arrays.
       - |exposed|, |differentiable|

    A rough conductor whose distribution of normals D is read by *differentiable indirection* (Datta et al., *Efficient
    Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023, task 1): a primary array of 16 × 16
    × 2 entries, read at the angle of the half vector and the roughness, points into a cascaded one of 8 × 8. The exact
    counterpart is Mitsuba's :monosp:`roughconductor` with ``distribution`` ``ggx``; changing ``type`` is all it
    takes. Masking and Fresnel terms are its, too.

    **The sampling density is normalised** although the table is approximate: directions are sampled from the visible
    normals of the *analytic* distribution, and ``pdf`` is the density of that, which knows no table. Only the value is
    read, so an error of the table is an error of the image and never one of the estimator: the weight of a sample is
    D̂/D times that of the exact plugin.

    With ``tables``, D̂/D lies between 0.9 and 1.1 at any angle and roughness, in every storage form, and the mean weight
    is at most 0.02 (bytes: 0.035) above the exact one. That is because the tail, beyond 8/9 of the projected area of
    the normals, is not read but continued by its analytic form. ``paper`` reads all of D, and what it misses of the
    peak it adds to the tail: at an angle of 89.999°, where 0.92 to 0.94 are exact, the mean weight is 1.3 at ``alpha``
    0.003, 3.5 at 0.001 and 29 at 0.0001, and single ones reach 600, 5,000 and 200,000.

    **Derivatives are coarser than values**, those of a bilinear read being constant from entry to entry: with respect
    to ``alpha`` they are off by 4% to 13% on average, and near 1 (from 0.95) may have the wrong sign. Fits of ``alpha``
    from images converge all the same.

    Sampling is detached, as in ``disney``: gradients flow through the value of a sample, not through its position or
    density. Like its counterpart it reflects on the front side only; put it into a :monosp:`twosided` for both.

    **Only the effects in use.** Where ``alpha`` is a constant, all that depends on it is evaluated once, and of the
    primary array there remains one row, read at one coordinate; without a metal (``eta`` 0, ``k`` 1) no Fresnel
    term is traced, and without ``specular_reflectance`` no factor.

    .. tabs::
        .. code-tab:: xml
            :name: neural_ggx

            <bsdf type="neural_ggx">
                <string name="material" value="Cu"/>
                <float name="alpha" value="0.15"/>
            </bsdf>

        .. code-tab:: python

            'type': 'neural_ggx',
            'material': 'Cu',
            'alpha': 0.15
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        for name, allowed in (("distribution", "ggx"), ("sample_visible", True)):
            found = props.get(name, allowed)
            found = found.lower() if isinstance(found, str) else found
            if found != allowed:
                found, allowed = (str(v).lower() for v in (found, allowed))
                raise RuntimeError(f'parameter "{name}": found {found}, only {allowed} is allowed')
        for name in ("alpha_u", "alpha_v"):
            if name in props:
                raise RuntimeError(f'parameter "{name}": the tables are isotropic, give "alpha"')

        properties.check_range(props, "alpha", 0, 1)
        self.alpha = props.get_unbounded_texture("alpha", 0.1)
        self.eta, self.k = _index_of_refraction(props)
        given = "specular_reflectance" in props
        self.specular_reflectance = props.get_texture("specular_reflectance") if given else None

        opened = tables.open_tables(props, TASK)
        self.distribution, self.preset = opened.distribution, opened.table.preset

        self._watched_alpha = TrackedParameter(self.alpha)
        self._watched_ior = [TrackedParameter(self.eta, colour=True), TrackedParameter(self.k, colour=True)]
        self._watched_factor = TrackedParameter(self.specular_reflectance, colour=True) if given else None
        #: What depends on a constant roughness alone, evaluated.
        self._constant: Roughness | None = None

        flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide
        if any(texture.is_spatially_varying() for texture in self._textures().values()):
            flags = flags | mi.BSDFFlags.SpatiallyVarying
        self.m_components = [flags]
        self.m_flags = flags
        when_outermost(self._prepare_constants)

    # -- parameters -------------------------------------------------------------------------------------------------

    def _textures(self) -> dict[str, mi.Texture]:
        found = {"alpha": self.alpha, "eta": self.eta, "k": self.k}
        if self.specular_reflectance is not None:
            found["specular_reflectance"] = self.specular_reflectance
        return found

    def _arrays(self) -> dict:
        net = self.distribution.net
        return {"primary": net.primary[0], "cascaded": net.cascaded}

    def _tables(self) -> dict:
        """The arrays that are exposed."""
        return tables.exposed(self._arrays())

    def traverse(self, cb: mi.TraversalCallback):
        discontinuous = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
        for name, texture in self._textures().items():
            flags = mi.ParamFlags.Differentiable if name == "specular_reflectance" else discontinuous
            cb.put(name, texture, flags)
        tables.traverse(cb, self._tables())

    def parameters_changed(self, keys: list[str] = ()):
        tables.check_shapes(self._tables())
        self._prepare_constants()

    # -- what is evaluated once ---------------------------------------------------------------------------------------

    def _watched(self) -> list[TrackedParameter]:
        return [self._watched_alpha, *self._watched_ior, *([self._watched_factor] if self._watched_factor else [])]

    def _prepare_constants(self) -> None:
        for watched in self._watched():
            watched.look()
        self._constant = None
        if self._is_constant():
            with dr.suspend_grad():
                alpha = mi.Float(self.alpha.eval_1(dr.zeros(mi.SurfaceInteraction3f)))
                found = self.distribution.constant_roughness(alpha)
            dr.make_opaque(found)
            self._constant = found

    def _is_constant(self) -> bool:
        """Is the roughness the same everywhere, and neither it nor a table being optimised or changed since?"""
        w = self._watched_alpha
        return w.constant and not w.optimised() and not w.changed() and not tables.optimised(self._tables())

    def _roughness(self, si, active) -> Roughness:
        if self._constant is not None and self._is_constant():
            return self._constant
        return self.distribution.roughness(self.alpha.eval_1(si, active))

    def _reflects_all(self) -> bool:
        """Is the index of refraction 0 + 1i, which reflects everything?"""
        eta, k = (watched.known() for watched in self._watched_ior)
        return eta.is_always(0) and k.is_always(1)

    def _has_factor(self) -> bool:
        return self._watched_factor is not None and not self._watched_factor.known().is_always(1)

    # -- evaluation ---------------------------------------------------------------------------------------------------

    def _prepare(self, ctx, si, wo, active):
        """Directions that are safe to compute with in every lane, and the lanes whose result counts."""
        # Directions have a length of 1; what is NaN or infinite has none below any bound
        active = active & (si.wi.z > 0) & (wo.z > 0) & (dr.squared_norm(si.wi) + dr.squared_norm(wo) < 100)
        if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
            active = mi.Bool(False)
        up = mi.Vector3f(0, 0, 1)
        return dr.select(active, si.wi, up), dr.select(active, wo, up), active

    def _value(self, ctx, si, r: Roughness, wi, wo, active):
        """f · cos = F D̂ (n·o) / (d(n·i) d(n·o)), with Smith's masking 2c/d(c): nothing to divide by at the horizon."""
        h, h2, sin2 = _half_vector(wi, wo)
        cos = h.z * dr.rsqrt(h2) if self.distribution.encoding.inputs == "plain" else None
        d = self.distribution.read(r, cos, sin2, active)
        factor = mi.UnpolarizedSpectrum(d * wo.z / (_masking(r, wi.z) * _masking(r, wo.z)))
        if self._has_factor():
            factor *= mi.UnpolarizedSpectrum(self.specular_reflectance.eval(si, active))
        return dr.select(active, _scaled(self._fresnel(ctx, si, h, h2, wi, wo, active), factor), 0)

    def _fresnel(self, ctx, si, h, h2, wi, wo, active):
        """Reflectance of the microfacets: a colour, or a Mueller matrix."""
        if self._reflects_all() and not mi.is_polarized:
            return mi.Spectrum(1)
        cos = 0.5 * dr.sqrt(h2)  # of the angle between wi and the half vector
        eta = mi.UnpolarizedSpectrum(self.eta.eval(si, active))
        k = mi.UnpolarizedSpectrum(self.k.eval(si, active))
        if mi.is_polarized:
            return _polarised(ctx, eta, k, h * dr.rsqrt(h2), cos, wi, wo)
        channels = range(dr.size_v(eta))
        return mi.Spectrum([mi.fresnel_conductor(cos, mi.Complex2f(eta[i], k[i])) for i in channels])

    def _density(self, r: Roughness, wi, wo, active):
        """Density of visible normals mapped to directions, D G₁(n·i) / (4 n·i), from formulas alone; detached."""
        with dr.suspend_grad():
            _, _, sin2 = _half_vector(wi, wo)
            q = dr.fma(1 - sin2, r.alpha2, sin2)
            pdf = r.alpha2 / (2 * dr.pi * dr.square(q) * _masking(r, wi.z))
            return dr.detach(dr.select(active, pdf, 0))

    def eval(self, ctx, si, wo, active=True):
        wi, wo, active = self._prepare(ctx, si, wo, active)
        return self._value(ctx, si, self._roughness(si, active), wi, wo, active)

    def pdf(self, ctx, si, wo, active=True):
        wi, wo, active = self._prepare(ctx, si, wo, active)
        return self._density(self._roughness(si, active), wi, wo, active)

    def eval_pdf(self, ctx, si, wo, active=True):
        wi, wo, active = self._prepare(ctx, si, wo, active)
        r = self._roughness(si, active)
        return self._value(ctx, si, r, wi, wo, active), self._density(r, wi, wo, active)

    def sample(self, ctx, si, sample1, sample2, active=True):
        up = mi.Vector3f(0, 0, 1)
        wi, _, active = self._prepare(ctx, si, up, active)
        r = self._roughness(si, active)
        with dr.suspend_grad():
            alpha = dr.sqrt(dr.detach(r.alpha2))
            half, _ = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha, True).sample(wi, sample2)
            wo = dr.detach(mi.reflect(wi, half))
            wo = dr.select(dr.squared_norm(wo) < 100, wo, -wi)  # of NaN and infinities

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
        """
        What this instance does: ``preset``, ``effects_in_use``, ``effects_left_out`` (effect → reason),
        ``evaluated_once``, ``storage`` and ``table_bytes``.
        """
        left_out = {}
        if self._reflects_all() and not mi.is_polarized:
            left_out["fresnel"] = "eta is 0 and k is 1"
        if not self._has_factor():
            left_out["specular_reflectance"] = "is 1" if self.specular_reflectance else "is not given"
        effects = ("distribution", "masking", "fresnel", "specular_reflectance")
        return {
            **tables.described(self.preset, self._arrays()),
            "effects_in_use": [name for name in effects if name not in left_out],
            "effects_left_out": left_out,
            "evaluated_once": [] if self._constant is None else ["roughness"],
        }

    def to_string(self):
        net = self.distribution.net
        lines = [f"  {name} = {t!s}," for name, t in self._textures().items()]
        lines.append(f"  preset = {self.preset}, {net.nbytes} bytes as {net.cascaded.storage},")
        return "NeuralGGX[\n" + "\n".join(line.replace("\n", "\n  ") for line in lines) + "\n]"


def _half_vector(wi, wo):
    """``h = wi + wo``, its squared length, not 0 where the directions are opposite either, and sin²θ_h."""
    h = wi + wo
    h2 = dr.maximum(dr.squared_norm(h), 1e-16)
    return h, h2, (dr.square(h.x) + dr.square(h.y)) * dr.rcp(h2)


def _masking(r: Roughness, c):
    """d(c) = c + √(c² + α² (1 − c²)), of which Smith's masking is 2c/d(c)."""
    c2 = dr.square(c)
    return c + dr.sqrt(dr.fma(r.alpha2, 1 - c2, c2))


class _Children(mi.TraversalCallback):
    """Collects the objects that a plugin is made of."""

    def __init__(self):
        super().__init__()
        self.found = {}

    def put(self, name, value, flags):
        self.found[name] = value


def _index_of_refraction(props: mi.Properties) -> tuple[mi.Texture, mi.Texture]:
    """The textures ``eta`` and ``k``, of the properties or of the preset that they name, as in Mitsuba's plugin."""
    material = str(props.get("material", "none"))
    if material != "none" and ("eta" in props or "k" in props):
        raise RuntimeError('"material" and "eta", "k" are two ways to say one thing, give only one')
    if material == "none":
        return props.get_unbounded_texture("eta", 0.0), props.get_unbounded_texture("k", 1.0)
    children, preset = _Children(), mi.Properties("roughconductor")
    preset["material"] = material
    try:
        mi.PluginManager.instance().create_object(preset).traverse(children)
    except RuntimeError as e:
        if "does not exist" not in str(e):
            raise
        raise RuntimeError(f'parameter "material": found "{material}", Mitsuba has no such preset') from None
    return children.found["eta"], children.found["k"]


def _polarised(ctx, eta, k, h, cos, wi, wo):
    """
    Mueller matrix of the reflection by microfacets of the normal ``h``, in the Stokes bases of both directions: light
    arrives along ``-wo_hat`` and leaves along ``wi_hat``.
    """
    wo_hat, wi_hat = (wo, wi) if ctx.mode == mi.TransportMode.Radiance else (wi, wo)
    channels = [mi.mueller.specular_reflection(cos, mi.Complex2f(eta[i], k[i])) for i in range(dr.size_v(eta))]
    found = mi.Spectrum([[mi.UnpolarizedSpectrum([m[i, j] for m in channels]) for j in range(4)] for i in range(4)])
    into, out = dr.cross(h, -wo_hat), dr.cross(h, wi_hat)  # perpendicular to the plane of reflection
    collinear = (dr.squared_norm(into) == 0) | (dr.squared_norm(out) == 0)
    axis = mi.Vector3f(1, 0, 0)
    into, out = (dr.normalize(dr.select(collinear, axis, v)) for v in (into, out))
    return mi.mueller.rotate_mueller_basis(
        found, -wo_hat, into, mi.mueller.stokes_basis(-wo_hat), wi_hat, out, mi.mueller.stokes_basis(wi_hat)
    )


def _scaled(reflectance, factor):
    """``reflectance``, a colour or a Mueller matrix of colours, times a colour."""
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
