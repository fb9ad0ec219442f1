from __future__ import annotations  # Delayed parsing of type annotations

from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind import metrics
from mi_diffind.lookup import clamp
from mi_diffind.tables import TableError

from . import Counterpart, Plugin
from .support import properties, tables, textures, upsampling
from .support.image_files import STORAGES, is_data, map_of, open_image, to_bitmap
from .support.textures import WRAP_MODES, Positions, luminance

#: Texels, at most, that are decoded for the mean, the maximum and the sampling of positions; larger images are reduced.
DECODED = 2**22


class NeuralImage(mi.Texture):
    r"""
    .. _texture-neural_image:

    Compressed image (:monosp:`neural_image`)
    -----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A compressed image or material, as written by ``mi-diffind fit image``.
       - --

     * - channels
       - |string|
       - Name of the map that is meant, such as ``albedo``, of 1 or 3 channels. (Default: the only map of the file, or
         its only albedo)
       - --

     * - raw
       - |bool|
       - Leave values as they are in the image, which is what data want: no conversion from sRGB, no spectral
         upsampling. (Default: false for colours; true for maps that hold data: ``normal``, ``roughness``, ``ao``,
         ``metallic``)
       - --

     * - wrap_mode
       - |string|
       - Outside of [0, 1] as for :monosp:`bitmap`: ``repeat``, ``mirror`` or ``clamp``. (Default: ``repeat``)
       - --

     * - to_uv
       - |transform|
       - Transformation of the texture coordinates, as for :monosp:`bitmap`. (Default: none)
       - |exposed|

     * - storage
       - |string|
       - ``uint8``, which is the fastest to read, or ``float32``, which can be optimised. (Default: ``uint8``)
       - --

     * - source
       - |string|
       - The image or the manifest that the file was made from; only the exact counterpart reads it. (Default: what the
         file says)
       - --

     * - filter_type, accel
       - |string|, |bool|
       - Accepted for the sake of exchange with :monosp:`bitmap`: of filters only ``bilinear`` is allowed, ``accel`` has
         no effect. (Default: these)
       - --

     * - tables.primary, tables.coarse, tables.cascaded
       - |tensor|
       - The entries of the arrays, with ``storage`` ``float32``: of the primary, of its pages one after the other if it
         has pages; of the second, coarser primary, if there is one.
       - |exposed|, |differentiable|

    An image that is stored as a pair of small arrays and read by *differentiable indirection* (Datta et al., *Efficient
    Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023, task 3): a primary array, read at uv,
    points into a cascaded one, whose entries are the channels of all maps of a material. The exact counterpart is
    :monosp:`bitmap` with the image that was compressed. Any BSDF and emitter can use it.

    **Several textures of one file are decoded once**, if their ``to_uv``, ``wrap_mode`` and ``storage`` are equal: they
    read the same arrays at the same place, which Dr.Jit recognises. The arrays of ``float32`` storage are parameters
    that such textures share, across scenes, too: what an optimiser does to one of them it does to all. A texture that
    is loaded after such a change starts from the file.

    **Between texels** values are interpolated as the image has them, sRGB-encoded where it is, and converted
    afterwards, which :monosp:`bitmap` does first; at texel centres this makes no difference. ``mirror`` and ``clamp``
    read nothing beyond the outermost texel centres. Where the image was found not to wrap around, ``repeat`` jumps at
    the seam, where :monosp:`bitmap` blends over the width of a texel.

    **Spectral variants** upsample the colour that was read to a spectrum by Jakob and Hanika's model, from the table of
    coefficients that :monosp:`bitmap` uses when it is loaded: the same spectra at texel centres (114 dB), and 52 dB
    between those of smooth colours, 48 × 64 texels, at 400 to 700 nm. As in :monosp:`bitmap`, colours are clamped to
    [0, 1] for that, also those of emitters, and a map of three channels answers for spectra only if it is not ``raw``,
    for numbers only if it is.

    The gradient that :monosp:`bumpmap` asks for is that of the image at its own resolution, from the four texels around
    the place, each decoded. Positions on an emitter are sampled by the decoded image, or uniformly if ``to_uv`` does
    not map the unit square to itself. This, ``mean`` and ``max`` reduce images of more than 2²² texels.

    .. tabs::
        .. code-tab:: xml
            :name: neural_image

            <texture type="neural_image">
                <string name="filename" value="wall.npz"/>
                <string name="channels" value="albedo"/>
            </texture>

        .. code-tab:: python

            'type': 'neural_image',
            'filename': 'wall.npz',
            'channels': 'albedo'
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self._path, channels = properties.filename(props), str(props.get("channels", ""))
        if not self._path:
            raise RuntimeError('parameter "filename": not given, a compressed image (.npz) is needed')
        storage = properties.one_of(props, "storage", STORAGES)
        self.wrap_mode = properties.one_of(props, "wrap_mode", WRAP_MODES)
        properties.one_of(props, "filter_type", ("bilinear",))
        props.get("accel", True), props.get("source", "")  # of no use here

        try:
            self._shared = open_image(self._path, storage)
        except TableError as e:
            raise RuntimeError(f'parameter "filename": {e}') from None
        self.image = self._shared.image
        #: For functions that are frozen, which look for the arrays that they read in here.
        self.net = self.image.net
        self.map = map_of(self.image.layout, channels)
        raw = props.get("raw", is_data(self.map))
        if not isinstance(raw, bool):
            raise RuntimeError(f'parameter "raw": found {raw}, allowed are true and false')
        self.raw = raw
        self.to_uv = textures.transformation(props)
        self._look_at_transformation()
        self._forget()

    # -- parameters -------------------------------------------------------------------------------------------------

    def traverse(self, cb: mi.TraversalCallback):
        tables.traverse(cb, self._shared.tables)
        cb.put("to_uv", self.to_uv, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str] = ()):
        tables.check_shapes(self._shared.tables)
        self._look_at_transformation()
        self._forget()

    def _look_at_transformation(self) -> None:
        m = self.to_uv.matrix
        matrix = [[float(m[i, j]) for j in range(3)] for i in range(3)]
        identity = matrix == [[float(i == j) for j in range(3)] for i in range(3)]
        self._transform = None if identity else self._shared.transform(matrix)
        self._permutes = textures.permutes_corners(matrix)

    def _forget(self) -> None:
        """Of what was found out by decoding."""
        self._state, self._mean, self._max, self._positions = self._shared.state(), None, None, None

    def _remember(self) -> None:
        """What was found out is still true, or forgotten: another texture may have changed the arrays."""
        if not self._shared.unchanged(self._state):
            self._forget()

    # -- reading ----------------------------------------------------------------------------------------------------

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.image.layout.width, self.image.layout.height

    def _uv(self, si) -> mi.Point2f:
        return si.uv if self._transform is None else self._transform @ si.uv

    def _wrapped(self, uv) -> list:
        """The coordinates u and v to read at."""
        borders = [] if self.net is None else [reversed(array.border) for array in self.net.primary]
        repeats = ["clamp" not in along for along in zip(*borders, strict=True)] or [True, True]
        return textures.wrapped(uv, self.wrap_mode, self._size, repeats)

    def _read(self, uv) -> list[mi.Float]:
        """
        The channels of the map at ``uv``, as they are used. In lanes that are not active, too: no place is out of
        bounds, and what is masked differently is not recognised as the same read.
        """
        stored = self.image.stored(*self._wrapped(uv))
        values = self.image.maps(stored, [self.map.name])[self.map.name]
        values = [mi.Float(v) for v in values]
        if not self._is_encoded():
            return values
        bounded = self.map.low >= 0 and self.map.high <= 1 and self.map.knee == 0
        return [textures.linear(v, bounded) for v in values]

    def _is_encoded(self) -> bool:
        """Are values in the file sRGB, and to be converted?"""
        return not self.raw and self.map.color_space == "srgb"

    def _is_upsampled(self) -> bool:
        """Is this a colour that stands for a spectrum?"""
        return mi.is_spectral and not self.raw and self.map.channels == 3

    def _refuse(self, method: str, wanted: str):
        raise RuntimeError(
            f'{method}: the map "{self.map.name}" was asked for {wanted}, but it is a colour that is converted to a '
            f"spectrum (raw = false)"
        )

    def eval(self, si, active=True):
        if mi.is_spectral and self.raw and self.map.channels == 3:
            raise RuntimeError(
                f'eval: the map "{self.map.name}" was asked for a spectrum, but conversion is switched off (raw = true)'
            )
        return textures.spectrum(self._read(self._uv(si)), si.wavelengths, self._is_upsampled())

    def eval_1(self, si, active=True):
        if self._is_upsampled():
            self._refuse("eval_1", "a number")
        return luminance(self._read(self._uv(si)))

    def eval_3(self, si, active=True):
        if self.map.channels != 3:
            raise RuntimeError(f'eval_3: the map "{self.map.name}" was asked for a colour, but it has 1 channel')
        if self._is_upsampled():
            self._refuse("eval_3", "a colour")
        return mi.Color3f(*self._read(self._uv(si)))

    def eval_1_grad(self, si, active=True):
        if self._is_upsampled():
            self._refuse("eval_1_grad", "a gradient")
        uv, (width, height) = self._uv(si), self._size
        x, y = dr.fma(uv.x, width, -0.5), dr.fma(uv.y, height, -0.5)
        i, j = dr.floor(x), dr.floor(y)
        a, b = clamp(x - i, 0.0, 1.0), clamp(y - j, 0.0, 1.0)

        def texel(right, down):
            return luminance(self._read(mi.Point2f((i + right + 0.5) / width, (j + down + 0.5) / height)))

        f00, f10, f01, f11 = texel(0, 0), texel(1, 0), texel(0, 1), texel(1, 1)
        du = width * dr.lerp(f10 - f00, f11 - f01, b)
        dv = height * dr.lerp(f01 - f00, f11 - f10, a)
        if self._transform is not None:
            m = self._transform.matrix
            du, dv = m[0, 0] * du + m[1, 0] * dv, m[0, 1] * du + m[1, 1] * dv
        return mi.Vector2f(du, dv)

    def sample_spectrum(self, si, sample, active=True):
        if not mi.is_spectral:
            return dr.zeros(type(si.wavelengths)), self.eval(si, active)
        extent = mi.MI_CIE_MAX - mi.MI_CIE_MIN
        si = mi.SurfaceInteraction3f(si)
        si.wavelengths = mi.MI_CIE_MIN + extent * sample
        return si.wavelengths, self.eval(si, active) * extent

    # -- what is known of the whole -----------------------------------------------------------------------------------

    def is_spatially_varying(self):
        return any(not isinstance(where, tuple) for where in self.map.where)

    def resolution(self):
        return mi.ScalarVector2i(*self._size)

    def _decoded_size(self) -> tuple[int, int]:
        """Width and height of what is decoded."""
        width, height = self._size
        while width * height > DECODED:
            width, height = (width + 1) // 2, (height + 1) // 2
        return width, height

    def mean(self):
        self._remember()
        if self._mean is None:
            with dr.suspend_grad():
                self._mean = self._compute_mean()
        return self._mean

    def _compute_mean(self):
        """Nothing here waits for a kernel: materials ask for it while they are constructed."""
        width, height = self._decoded_size() if self.is_spatially_varying() else (1, 1)
        index = dr.arange(mi.UInt32, width * height)
        uv = mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height)
        values = self._read(uv)
        value = upsampling.mean(values) if self._is_upsampled() else luminance(values)
        return dr.mean(value)

    def max(self):
        self._remember()
        if self._max is None:
            self._max = float(self._decoded().max())
        return self._max

    def _decoded(self) -> np.ndarray:
        """
        The image as its values are used, float32, ``(height, width, channels)``. From another thread: this one may be
        recording a loop or a call, in which nothing can be evaluated.
        """

        def decode():
            with dr.suspend_grad():
                return self.image.decode([self.map.name], *self._decoded_size())[self.map.name]

        with ThreadPoolExecutor(1) as pool:
            values = pool.submit(decode).result()
        return metrics.linear(values) if self._is_encoded() else values

    # -- sampling of positions ----------------------------------------------------------------------------------------

    def _sampled(self) -> Positions:
        self._remember()
        if self._positions is None:
            self._positions = Positions.of(self._decoded(), self.wrap_mode)
        return self._positions

    def sample_position(self, sample, active=True):
        if not (self._permutes and self.is_spatially_varying()):
            return sample, mi.Float(1)
        uv, pdf = self._sampled().sample(sample, active)
        return (uv if self._transform is None else self._transform.inverse() @ uv), pdf

    def pdf_position(self, pos, active=True):
        if not (self._permutes and self.is_spatially_varying()):
            return mi.Float(1)
        return self._sampled().density(pos if self._transform is None else self._transform @ pos, active)

    # -- what it does -------------------------------------------------------------------------------------------------

    def report(self) -> dict:
        """
        What this instance does: ``preset``, ``map``; ``channels_read`` and ``channels_left_out``, numbers of the
        channels that the file stores; ``effects_in_use`` and ``effects_left_out`` (→ reason), the maps of the file
        among them; ``evaluated_once``, ``storage`` and ``table_bytes``.
        """
        left_out = {name: "is another map of the file" for name in self.image.layout.names if name != self.map.name}
        if not self._is_encoded():
            left_out["srgb"] = "raw is true" if self.raw else "the map is linear"
        if not self._is_upsampled():
            left_out["upsampling"] = "raw is true" if self.raw else "a number or a colour is asked for"
        if self._transform is None:
            left_out["to_uv"] = "is the identity"
        layout = self.image.layout
        read = list(layout.needed(self.map.name))
        return {
            **tables.described(self._shared.preset, self._shared.arrays),
            "map": self.map.name,
            "channels_read": read,
            "channels_left_out": [i for i in range(layout.stored) if i not in read],
            "effects_in_use": [n for n in (self.map.name, "srgb", "upsampling", "to_uv") if n not in left_out],
            "effects_left_out": left_out,
            "evaluated_once": [],
        }

    def to_string(self):
        layout, lines = self.image.layout, []
        lines.append(f'filename = "{self._path}"')
        lines.append(f"map = {self.map.name} of {', '.join(layout.names)}")
        lines.append(f"resolution = {layout.width} x {layout.height}")
        lines.append(f"channels = {self.map.channels}, {self.map.color_space}, raw = {str(self.raw).lower()}")
        lines.append(f"wrap_mode = {self.wrap_mode}")
        if self.net is not None:
            storage = self.net.cascaded.storage
            lines.append(f"arrays = {self.net.nbytes} bytes as {storage}")
        return "NeuralImage[\n  " + ",\n  ".join(lines) + "\n]"


PLUGIN = Plugin(
    "neural_image",
    "texture",
    NeuralImage,
    task="image",
    exact=Counterpart("bitmap", ("filename", "channels", "storage", "source"), convert=to_bitmap),
)
