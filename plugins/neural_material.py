"""Material whose maps come from one compressed file: normal map, Disney BRDF and opacity in one BSDF."""

from __future__ import annotations  # Delayed parsing of type annotations

import functools

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat
from mi_diffind.maps.layout import Layout, MapLayout, different_transforms
from mi_diffind.tasks.disney import TASK as DISNEY
from mi_diffind.tasks.disney.decoder import Lobe
from mi_diffind.tasks.disney.model import PARAMETERS, clamp
from mi_diffind.tasks.texture import TASK
from mi_diffind.tasks.texture.surface import frame, shadowing, specular_lobe

from . import Counterpart, Plugin, Stock
from .disney import Disney, Parameters, ShadedPoint, check_principled, to_principled
from .support import properties, textures
from .support.bsdfs import TrackedParameter
from .support.image_files import SharedMaps, file_layout, fit_images, open_compressed, remove, to_bitmap, to_mipmap
from .support.manual import shared_parts
from .support.map_textures import FilteredTexture
from .support.properties import Kept, StockNode
from .support.textures import PROPERTIES as FILTERING
from .support.textures import anisotropic, isotropic

#: Forms of the lobes.
LOBES = ("exact", "tables")

#: Index of the component that lets light through, where there is an opacity.
NULL = 3


#: Role of a map → the parameter that it is of.
ROLES = {"albedo": "base_color", "normal": "normal", "roughness": "roughness", "metallic": "metallic"}

#: Other name of a map → the parameter that it is of.
NAMES = {**{name: name for name in PARAMETERS}, "subsurface": "flatness", "opacity": "opacity", "alpha": "opacity"}

#: Role or name of a map that a BSDF does not read → the reason.
UNREAD = {
    "ao": "the BRDF has no such parameter",
    "emission": "a BSDF emits no light: give the shape an area emitter with a neural_texture",
}
UNREAD["emissive"] = UNREAD["emission"]

#: Parameter → allowed numbers of channels; (1,) for all others.
CHANNELS = {"base_color": (1, 3), "normal": (3,)}


def material_maps(layout: Layout, ignored: tuple[str, ...] = ()) -> tuple[dict[str, MapLayout], dict[str, str]]:
    """Return the maps of a material by parameter, and for each of the others the reason why it is not read.

    Raises ``RuntimeError`` for maps that are no parameters, and for names of ``ignored`` that the file lacks.
    """
    for name in ignored:
        if name not in layout.names:
            raise RuntimeError(f'parameter "ignore": found "{name}", the file holds {", ".join(layout.names)}')
    maps, left_out = {}, {}
    for m in layout.maps:
        name = m.name.lower()
        parameter = ROLES.get(m.role) or NAMES.get(name)
        if m.name in ignored:
            left_out[m.name] = "is ignored"
        elif m.role in UNREAD or name in UNREAD:
            left_out[m.name] = UNREAD.get(m.role) or UNREAD[name]
        elif parameter is None:
            allowed = ", ".join(dict.fromkeys((*ROLES.values(), *NAMES)))
            raise RuntimeError(
                f'parameter "filename": the map "{m.name}" is no parameter of the material, allowed are {allowed}; or '
                f'name it in the parameter "ignore"'
            )
        elif parameter in maps:
            raise RuntimeError(
                f'parameter "filename": the maps "{maps[parameter].name}" and "{m.name}" are both the parameter '
                f'"{parameter}", name one of them in the parameter "ignore"'
            )
        elif m.channels not in CHANNELS.get(parameter, (1,)):
            allowed = " or ".join(map(str, CHANNELS.get(parameter, (1,))))
            raise RuntimeError(
                f'parameter "filename": the map "{m.name}" has {m.channels} channels, the parameter "{parameter}" '
                f"needs {allowed}"
            )
        else:
            maps[parameter] = m
    if not maps:
        raise RuntimeError(f'parameter "filename": no map is left to read, the file holds {", ".join(layout.names)}')
    if fault := different_transforms(maps.values()):
        raise RuntimeError(f'parameter "filename": {fault}: read each by a neural_texture')
    return maps, left_out


def ignored(props: mi.Properties) -> tuple[str, ...]:
    """Return the property ``ignore``, names of maps between commas."""
    return tuple(name.strip() for name in str(props.get("ignore", "")).split(",") if name.strip())


class MaterialMaps(FilteredTexture):
    """Maps of a material: ``maps``, by parameter, and ``left_out``, the names of the others with reasons.

    It takes the properties of its BSDF, which shows itself as ``owner`` in warnings.
    """

    def __init__(self, props: mi.Properties):
        self._owner = props.id()
        super().__init__(props)
        self.set_id("")  # the scene's names of parameters are those of the BSDF

    def _open(self, props: mi.Properties) -> SharedMaps:
        shared, self._path = open_compressed(TASK, props)
        return shared

    def _choose(self, props):
        self.maps, self.left_out = material_maps(self.image.layout, ignored(props))
        return next((m for m in self.maps.values() if m.varies), next(iter(self.maps.values()))), False

    def _shown(self):
        return list(self.maps.values())

    def read(self, si: mi.SurfaceInteraction3f) -> dict[str, list[mi.Float]]:
        """Return the channels of each map at a hit, linear, by parameter."""
        values = iter(self._values(si))
        return {parameter: [next(values) for _ in range(m.channels)] for parameter, m in self.maps.items()}

    def lobe(self, si: mi.SurfaceInteraction3f) -> Lobe | None:
        """Return the shape of the specular lobe at a hit, from the extras of the file; ``None`` without extras.

        They are coarse: one place is read, whatever the filter.
        """
        if not self.image.has_extras:
            return None
        uv, level = self._uv(si), mi.Float(0)
        if self.filter.name != "off":
            ddx, ddy = self._footprint(si)
            taps, bias = self.filter.taps, self.image.level_bias
            level = isotropic(ddx, ddy, bias) if self.filter.name == "trilinear" else anisotropic(ddx, ddy, taps)[0]
        return specular_lobe(self.image.extra(*self._wrapped_at(uv, self.image.biased(level)), level))

    def is_constant(self, parameter: str) -> bool:
        """Return whether the map of a parameter is one colour or number."""
        return not self.maps[parameter].varies

    def _title(self):
        return f'the material "{self._owner}" (neural_material, {self._path})'

    def report(self):
        description, layout = super().report(), self.image.layout
        needed = {i for m in self.maps.values() for i in layout.needed(m.name)}
        kept = {k: v for k, v in description["effects_left_out"].items() if k in ("footprint", "sensor", "to_uv")}
        return {
            **description,
            "map": ", ".join(m.name for m in self.maps.values()),
            "channels_read": sorted(needed),
            "channels_left_out": [i for i in range(layout.stored) if i not in needed],
            "extras": self.image.has_extras,
            "effects_left_out": {**kept, **self.left_out},
        }


@shared_parts
class NeuralMaterial(Disney):
    r"""
    .. _bsdf-neural_material:

    Material from a compressed file (:monosp:`neural_material`)
    -----------------------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - The maps of a material, written by ``mi-diffind fit texture``. A map with linear values beyond
         :math:`\pm 10^9` is refused.
       - --

     * - ignore
       - |string|
       - Names of maps that are not read, separated by commas. (Default: none)
       - --

     * - lobes
       - |string|
       - ``exact``: the formulas of :ref:`disney <bsdf-disney>`; ``tables``: the tables of
         :ref:`neural_disney <bsdf-neural_disney>`, which ``fit texture`` trains with. (Default: ``exact``)
       - --

     * - two_sided
       - |bool|
       - Reflect on both sides, as a material in :monosp:`twosided` does. (Default: that of the file, else false)
       - --

     * - base_color, roughness, anisotropic, metallic, specular, eta, spec_tint, sheen, sheen_tint, flatness,
         clearcoat, clearcoat_gloss
       - |float|, |spectrum|
       - Constants of :ref:`disney <bsdf-disney>`, with its defaults, for parameters without a map.
       - |exposed|, |differentiable|

     * - effects, diffuse_reflectance_sampling_rate, main_specular_sampling_rate, clearcoat_sampling_rate
       - |string|, |float|
       - As for :ref:`disney <bsdf-disney>`.
       - --

     {wrap_mode}

     {to_uv}

     {filtering}

     {compressed}

     * - maps.tables.NAME, maps.to_uv
       - |tensor|, |transform|
       - The entries of each array, exposed if ``storage`` is ``float32``; the transformation.
       - |exposed|, |differentiable|

    A material in one plugin and one file. It renders as a :monosp:`normalmap` around a :ref:`disney <bsdf-disney>` with
    a :ref:`neural_texture <texture-neural_texture>` for each parameter does, and takes less time: the footprint is
    computed once, and one chain of lookups reads all maps. Its exact counterpart are these two plugins with bitmaps of
    the file's source, :monosp:`principled` is another; ``mi-diffind compare`` shows a scene beside them.

    With ``storage`` ``float32`` all maps are one set of parameters, which other textures of the file share. Maps that
    are constants in the file have no entries there; ``mi-diffind fit texture --separate``, or ``--steps 0`` without a
    training, gives them some.

    **Maps** are recognised by their names: ``base_color`` (``albedo``, ``diffuse``, ``color``), ``normal``,
    ``roughness``, ``metallic`` (``metalness``), ``opacity`` (``alpha``), and the constants above. A map that is
    constant in the file is a constant here, and **lobes that it rules out are not traced**: without clearcoat, without
    metal, without hue. ``mi-diffind inspect SCENE.xml`` lists them. Any other map is refused unless ``ignore`` names
    it. Ambient occlusion is not read, as the BRDF has no such parameter.

    **Normals** turn the frame as :monosp:`normalmap` does, with its shadowing function. A direction counts if it is
    above the surface and above the turned horizon. A normal that faces away from the viewer is mirrored at the
    surface's normal. The AOV ``sh_normal`` is the surface's normal: Mitsuba 3.9 asks its own plugins alone for another.

    **Extras**, which ``mi-diffind fit texture`` may add to a file, shape the highlight at each level of
    detail: α² of the specular lobe becomes a symmetric 2×2 matrix, and a weight from 0 to 1 multiplies its values.
    ``anisotropic`` is then not allowed. No other plugin reads them.

    **Opacity** lets rays pass straight on, as :monosp:`mask` does: component 3. **Emission is left out**: light of a
    surface comes from an area emitter of its shape. Give the shape one, with a :monosp:`neural_texture` of the same
    file as its radiance.

    {footprint}

    Without ``two_sided``, which the file of a glTF material with ``doubleSided`` contains, the material reflects on the
    front side only. Components are those of :ref:`disney <bsdf-disney>`. Sampling is detached, as there.

    {executable}

    {example bsdf neural_material: filename="wall.npz", clearcoat=0.5}
    """

    def _set_up(self, props):
        lobes = properties.one_of(props, "lobes", LOBES)
        if lobes != "exact":
            self.decoder = DISNEY.open(mi.TensorXf, preset=lobes, storage="uint8").decoder
        self.lobes = lobes
        self.maps = MaterialMaps(props)
        self.two_sided = properties.flag(props, "two_sided", self.maps.image.layout.double_sided)
        for name in ("base_color", *self.scalars, "subsurface", "specular", "eta"):
            if name in props and isinstance(props[name], mi.Texture) and not compat.is_constant_texture(props[name]):
                raise RuntimeError(f'parameter "{name}": found a texture, allowed are numbers: maps come from the file')
        for name, m in self.maps.maps.items():
            others = {"flatness": ("subsurface",), "specular": ("eta",)}.get(name, ())
            for given in (name, *others):
                if given in props:
                    raise RuntimeError(
                        f'parameter "{given}": given, but the file holds the map "{m.name}"; name the map in the '
                        f'parameter "ignore" or leave the constant out'
                    )
            if name not in self._tracked:
                continue
            self._tracked[name] = TrackedParameter(self.maps, known=self.maps.layout_bounds(m))
            self._tracked[name].constant = self.maps.is_constant(name) and not (name == "base_color" and mi.is_spectral)
            if name == "base_color":
                self.base_color = None
            elif name == "specular":
                self.reflectance = None
            else:
                del self.scalars[name]
        self._upsampled = (
            mi.is_spectral and "base_color" in self.maps.maps and self.maps.maps["base_color"].channels == 3
        )
        extras = self.maps.image.has_extras
        if extras and (self._is_anisotropic or "anisotropic" in self.maps.maps):
            raise RuntimeError(
                'parameter "anisotropic": found one above 0 or a map, but the extras of the file shape the highlight'
            )
        self._is_anisotropic |= extras or "anisotropic" in self.maps.maps
        sides = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide if self.two_sided else mi.BSDFFlags.FrontSide
        self._set_flags(self.maps.is_spatially_varying(), self._is_anisotropic, sides)
        if "opacity" in self.maps.maps:
            self.m_components = [*self.m_components, mi.BSDFFlags.Null | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
            self.m_flags = self.m_flags | self.m_components[NULL]

    def _is_constant(self, group):
        shaped = self.maps.image.has_extras and "anisotropic" in self.decoder.groups[group]
        return not shaped and super()._is_constant(group)

    @property
    def net(self):
        """The arrays of the maps, ``None`` if all are constant."""
        return self.maps.net

    def traverse(self, cb: mi.TraversalCallback):
        super().traverse(cb)
        cb.put("maps", self.maps, mi.ParamFlags.Differentiable)

    def trained(self) -> tuple:
        """Return the table of the file, and the arrays that can be optimised, by name."""
        return self.maps.trained()

    def _point(self, ctx, si, active):
        parameters, maps = Parameters(self, si, active), self.maps.read(si)
        parameters.lobe = self.maps.lobe(si)
        normal, opacity = maps.pop("normal", None), maps.pop("opacity", None)
        for name, values in maps.items():
            if name == "base_color":
                parameters.albedo = mi.UnpolarizedSpectrum(
                    clamp(textures.spectrum(values, si.wavelengths, self._upsampled), 0.0, 1.0)
                )
            else:
                setattr(parameters, name, clamp(values[0], 0.0, 1.0))
        if normal is not None:
            normal = mi.Vector3f(*normal)
            normal = normal if self.maps.maps["normal"].low < 0 else dr.fma(normal, 2, -1)
        if opacity is not None:
            opacity = clamp(opacity[0], 0.0, 1.0)
        return MapPoint(parameters, si.wi, self.two_sided, normal, opacity, ctx.is_enabled(mi.BSDFFlags.Null, NULL))

    def sample(self, ctx, si, sample1, sample2, active=True):
        point = self._point(ctx, si, active)
        if point.opacity is None:
            return self._sample(ctx, point, sample1, sample2, active)
        passes, opacity = ctx.is_enabled(mi.BSDFFlags.Null, NULL), dr.detach(point.opacity)
        if not self._rates(ctx, self._effects()):
            opacity = mi.Float(0)
        chosen = (sample1 < opacity) if passes else mi.Bool(True)
        rescaled = sample1 / dr.maximum(opacity, 1e-20) if passes else sample1
        bs, weight = self._sample(ctx, point, rescaled, sample2, active & chosen)
        clear = (1 - point.opacity) / dr.select(opacity < 1, 1 - dr.detach(point.opacity), 1)
        bs.wo = dr.select(chosen, bs.wo, -si.wi)
        bs.pdf = dr.select(chosen, bs.pdf, 1 - opacity)
        bs.sampled_component = dr.select(chosen, bs.sampled_component, NULL)
        bs.sampled_type = dr.select(chosen, bs.sampled_type, mi.UInt32(+mi.BSDFFlags.Null))
        return bs, dr.select(chosen, weight, mi.depolarizer(mi.Spectrum(clear)))

    def eval_null_transmission(self, si, active=True):
        if "opacity" not in self.maps.maps:
            return mi.depolarizer(mi.Spectrum(0))
        return mi.depolarizer(mi.Spectrum(1 - clamp(self.maps.read(si)["opacity"][0], 0.0, 1.0)))

    def eval_diffuse_reflectance(self, si, active=True):
        return mi.depolarizer(mi.Spectrum(self._point(mi.BSDFContext(), si, active).parameters.albedo))

    def report(self) -> dict:
        """Return the description of :meth:`.Disney.report`, with that of the maps (:meth:`.MaterialMaps.report`)."""
        lobes, maps = super().report(), self.maps.report()
        given = [name for name in ("normal", "opacity") if name in self.maps.maps]
        given += ["extras"] if self.maps.image.has_extras else []
        missing = {name: "the file has no such map" for name in ("normal", "opacity") if name not in self.maps.maps}
        return {
            **maps,
            "lobes": self.lobes,
            "maps": {name: m.name for name, m in self.maps.maps.items()},
            "effects_in_use": [*lobes["effects_in_use"], *given],
            "effects_left_out": {**lobes["effects_left_out"], **missing, **maps["effects_left_out"]},
            "evaluated_once": lobes["evaluated_once"],
        }

    def to_string(self):
        lines = str(self.maps).split("[\n  ", 1)[1].rsplit("\n]", 1)[0]
        return f"NeuralMaterial[\n  {lines},\n  lobes = {self.lobes}\n]"


class MapPoint(ShadedPoint):
    """Point of a material with maps: a side, the frame of a normal (``None``: the surface's), and an opacity."""

    def __init__(self, parameters, wi, two_sided: bool, normal, opacity, passes: bool):
        self._side = wi.z if two_sided else None
        self._frame, self.opacity = None, opacity
        if two_sided:
            wi = mi.Vector3f(wi.x, wi.y, dr.abs(wi.z))
        if normal is not None:
            self._frame = frame(normal, wi)
        super().__init__(parameters, self._turned(wi))
        self.above &= wi.z > 0
        if opacity is not None and passes:
            self.share = dr.detach(opacity)

    def _turned(self, w):
        return w if self._frame is None else mi.Vector3f(*(dr.dot(w, axis) for axis in self._frame))

    def _flipped(self, w):
        return w if self._side is None else mi.Vector3f(w.x, w.y, dr.mulsign(w.z, self._side))

    def enter(self, wo):
        wo = self._flipped(wo)
        inside = self._turned(wo)
        return inside, (wo.z > 0) & (inside.z > 0)

    def leave(self, wo):
        if self._frame is not None:
            s, t, n = self._frame
            wo = s * wo.x + t * wo.y + n * wo.z
        return self._flipped(wo)

    def factor(self, wo, active):
        factor = 1.0
        if self._frame is not None:
            # The derivative with respect to the normal is 0 in other lanes, times a number
            factor = shadowing(self._frame[2], dr.select(active, self._flipped(wo), mi.Vector3f(0, 0, 1)))
        return factor if self.opacity is None else factor * self.opacity


def _convert(props: mi.Properties, bsdf: str, texture: str) -> str:
    """Change properties to those of Mitsuba's plugins, nested, and return the name of the outermost one."""
    layout = file_layout(TASK, props)
    maps, _ = material_maps(layout, ignored(props))
    sides = props.get("two_sided", layout.double_sided)

    def shown(name: str) -> mi.Texture:
        image = mi.Properties(texture)
        for key in ("filename", "source", "wrap_mode", "to_uv", *(FILTERING if texture == "mipmap" else ())):
            if key in props:
                image[key] = props[key]
        image["channels"] = name
        (to_mipmap if texture == "mipmap" else to_bitmap)(TASK, image)
        dropped = ("source", *(() if texture == "mipmap" else ("filename", "channels")))
        return mi.load_dict({"type": texture, **{key: image[key] for key in image if key not in dropped}})

    inner = mi.Properties(bsdf)
    for key in props:
        if key in (*Disney.DEFAULTS, "base_color", "subsurface", "specular", "eta", "effects", *Disney.RATES.values()):
            inner[key] = props[key]
    for parameter, m in maps.items():
        if parameter not in ("normal", "opacity"):
            inner[parameter] = shown(m.name)
    if bsdf == "principled":
        to_principled(inner)
        remove(inner, "effects")
    if "normal" in maps and maps["normal"].low < 0:
        raise RuntimeError(f'{props["filename"]}: the map "normal" has negative values, which normalmap does not take')
    outer = {"normalmap": "normal" in maps, "twosided": sides, "mask": "opacity" in maps}
    for name in (name for name, needed in outer.items() if needed):
        around = mi.Properties(name)
        around["nested"] = mi.PluginManager.instance().create_object(inner)
        if name == "normalmap":
            around["normalmap"] = shown(maps["normal"].name)
        if name == "mask":
            around["opacity"] = shown(maps["opacity"].name)
        inner = around
    remove(props, *list(props))
    for key in inner:
        props[key] = inner[key]
    return inner.plugin_name()


def _counterpart(name: str, bsdf: str, texture: str, oversampling: int) -> Counterpart:
    """Return a counterpart that reads the file's source."""
    learned_only = ("filename", "storage", "source", "lobes", "ignore")
    convert = functools.partial(_convert, bsdf=bsdf, texture=texture)
    return Counterpart(name, learned_only, convert=convert, oversampling=oversampling)


#: Plugins around a ``principled`` that a material takes in, from the outermost to the innermost one, and the parameters
#: that they may have, each a map.
AROUND = {"mask": "opacity", "twosided": "", "normalmap": "normalmap"}


def _from_stock(node: StockNode) -> str | None:
    """Replace a ``principled`` with images, and what is around it, by a material of one file."""
    if node.parents and all(parent.plugin_name() in AROUND for parent in node.parents):
        return None
    images, around, inner, constants = {}, list(AROUND), node, {}
    while inner.name != "principled":
        nested = [child for child in inner.children.values() if child.object_type == mi.ObjectType.BSDF]
        if inner.name not in AROUND or len(nested) != 1:
            return None
        if inner.name not in around:
            raise Kept(f"has a {inner.name} within, allowed is the order {', '.join((*AROUND, 'principled'))}")
        around = around[around.index(inner.name) + 1 :]
        constants |= {"two_sided": True} if inner.name == "twosided" else {}
        if parameter := AROUND[inner.name]:
            images[{"normalmap": "normal"}.get(parameter, parameter)] = inner.children.get(parameter)
        inner.allow(parameter)
        (inner,) = nested
    images = {**inner.children, **images}
    if "bitmap" not in node.nested_types(mi.ObjectType.Texture):
        return None
    check_principled(inner)
    for child in (inner, *filter(None, images.values())):
        if child.shared:
            raise Kept(f"holds a {child.name} to which other objects refer")
    for name, image in images.items():
        if image is None or image.name != "bitmap":
            described = f'the texture "{image.name}"' if image else "a number"
            raise Kept(f'has {described} for "{name}", allowed are bitmaps')
    for key in inner.props:
        if compat.property_kind(inner.props, key) not in ("number", "colour", "object"):
            raise Kept(f'has a spectrum for "{key}", allowed are numbers, colours and bitmaps')
    first = next(iter(images.values())).props
    for key in ("to_uv", "wrap_mode"):
        pair = {str(image.props.get(key, "repeat" if key == "wrap_mode" else "")) for image in images.values()}
        if len(pair) > 1:
            raise Kept(f'has images that differ in "{key}", which are of one file')
    table, quality = fit_images(TASK, node, images, (*PARAMETERS, "opacity"), shading="off")
    constants |= {key: inner.props[key] for key in inner.props if key not in (*inner.children, "spec_trans")}
    constants |= {key: first[key] for key in ("to_uv", "wrap_mode") if key in first}
    remove(node.props, *list(node.props))
    for key, value in {"filename": str(table.path), **constants}.items():
        node.props[key] = value
    return quality


PLUGIN = Plugin(
    "neural_material",
    "bsdf",
    NeuralMaterial,
    task=TASK.name,
    exact=_counterpart("disney", "disney", "bitmap", 8),
    others=(_counterpart("mipmap", "disney", "mipmap", 1), _counterpart("principled", "principled", "bitmap", 8)),
    truths=("mipmap", "exact"),
    stock=Stock("material", (*AROUND, "principled"), _from_stock, advised=True),
)
