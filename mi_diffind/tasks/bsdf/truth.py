"""Sources of BSDFs: plugins of Mitsuba, scenes, measured files."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp
from ...arrays.tables import Table, TableError
from ...core.compat import one_sentence
from ...core.errors import UsageError, reason
from ...core.files import irregular, shown
from ...core.units import memory
from .directions import incident, outgoing
from .functions import FUNCTION, NetworkTruth, PythonTruth, import_function, open_networks
from .measured import (
    ILLUMINANTS,
    LARGEST,
    GridTruth,
    PolarisedTruth,
    ScatteredTruth,
    Truth,
    has_one_azimuth,
    measure_symmetry,
    measured_bsdf,
    value_remarks,
)
from .model import MOST_PARAMETERS, Parameter, points, turn
from .shifted_gamma import ShiftedGammaTruth, read_fits

#: Extensions of files that are sources.
SUFFIXES = (".xml", ".bsdf", ".pbsdf", ".mbsdf", ".binary", ".csv", ".npz", ".json")

#: Beginning of an error of ``mi.load_dict``, which names the plugin of a source.
NODE = re.compile(r'At dictionary node "root": failed to instantiate bsdf plugin of type "\w+": ')


class MitsubaTruth(Truth):
    """BSDF of the Mitsuba variant that is set, at the point ``uv`` of its textures. Raises :class:`UsageError`."""

    samples = True

    def __init__(self, bsdf, name: str, digest: str, uv: tuple[float, float] = (0.5, 0.5)):
        import mitsuba as mi

        self.bsdf, self.name, self.digest, self.uv = bsdf, name, digest, uv
        self.mi, self.context = mi, mi.BSDFContext()
        flags = bsdf.flags()
        if mi.has_flag(flags, mi.BSDFFlags.Transmission) or mi.has_flag(flags, mi.BSDFFlags.Null):
            raise UsageError(f"{name}: transmits light, only BSDFs that reflect can be fitted")
        if mi.has_flag(flags, mi.BSDFFlags.Delta):
            raise UsageError(f"{name}: reflects into single directions, only BSDFs without delta lobes can be fitted")
        if mi.is_spectral or mi.is_monochromatic:
            raise UsageError(f"{name}: the variant {mi.variant()} is set, a variant with RGB colours is needed")

    def _interaction(self, wi):
        mi = self.mi
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
        si.t, si.wi, si.uv = 1.0, mi.Vector3f(wi), mi.Point2f(*self.uv)
        si.n = mi.Normal3f(0, 0, 1)
        si.sh_frame = mi.Frame3f(si.n)
        si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
        return si

    def value(self, wi, wo):
        return [clamp(channel, 0, LARGEST) for channel in self._colour(wi, wo)]

    def _colour(self, wi, wo):
        """Return the BSDF's values as they are: also negative, infinite or NaN."""
        spectrum = self.bsdf.eval(self.context, self._interaction(wi), self.mi.Vector3f(wo))
        return self.mi.unpolarized_spectrum(spectrum)

    def remarks(self, samples) -> list[str]:
        wi, wo = samples.wi, samples.wo
        with dr.suspend_grad():
            below = [type(w)(w.x, w.y, -w.z) for w in (wi, wo)]
            sides = [list(self._colour(*pair)) for pair in ((wi, wo), below)]
            dr.eval(sides)
        front, back = (np.stack([channel.numpy() for channel in side]) for side in sides)
        remarks = value_remarks(self.name, front)
        front, back = np.nan_to_num(front), np.nan_to_num(back)
        if np.abs(back).max() > 0:
            other = np.abs(back - front).mean() > 1e-3 * np.abs(front).mean()
            remarks.append(
                "its back is another material, which is left out: fit that one by itself" if other else
                "it reflects on both sides: neural_bsdf does so with two_sided"
            )  # fmt: skip
        return remarks

    def sample(self, wi, w, u, v):
        bs, _ = self.bsdf.sample(self.context, self._interaction(wi), w, self.mi.Point2f(u, v))
        return type(wi)(bs.wo)

    def density(self, wi, wo):
        return clamp(self.bsdf.pdf(self.context, self._interaction(wi), self.mi.Vector3f(wo)), 0, LARGEST)


class MeasuredTruth(MitsubaTruth):
    """Mitsuba's ``measured`` of a file with one azimuth of incidence, which is isotropic.

    Mitsuba 3.9 leaves a number unset for such files, by which it may mirror the directions of some quadrants
    (mitsuba3#1850). Directions are therefore turned until the azimuth of ``wi`` is −135°, where nothing is mirrored.
    """

    isotropic = True

    def _interaction(self, wi):
        return super()._interaction(self._turn(wi, wi))

    @staticmethod
    def _turn(wi, w, back: bool = False):
        """Return ``w`` after the rotation about the normal that turns ``wi``, or ``back``."""
        r2 = dr.square(wi.x) + dr.square(wi.y)
        inverse = -math.sqrt(0.5) * dr.rsqrt(dr.maximum(r2, 1e-20))
        sin, cos = (wi.x - wi.y) * inverse, (wi.x + wi.y) * inverse
        sin, cos = dr.select(r2 > 1e-20, sin, 0), dr.select(r2 > 1e-20, cos, 1)
        return turn(w, -sin if back else sin, cos)

    def _colour(self, wi, wo):
        return super()._colour(wi, self._turn(wi, wo))

    def sample(self, wi, w, u, v):
        return self._turn(wi, super().sample(wi, w, u, v), back=True)

    def density(self, wi, wo):
        return super().density(wi, self._turn(wi, wo))


class MERLTruth(Truth):
    """Isotropic measurement of the MERL database (Matusik et al. 2003): a ``.binary`` file of 90 × 90 × 180 numbers.

    Angles are θ_h (by its square root), θ_d and φ_d; values are interpolated linearly. Raises :class:`UsageError`.
    """

    isotropic = True
    SIZES, SCALES = (90, 90, 180), (1.0 / 1500, 1.15 / 1500, 1.66 / 1500)

    def __init__(self, path: Path, types):
        count = int(np.prod(self.SIZES))
        try:
            content = path.read_bytes()
        except OSError as e:
            raise UsageError(f"{path}: cannot be read ({reason(e)})") from None
        if len(content) != 12 + 24 * count or tuple(np.frombuffer(content, "<i4", 3)) != self.SIZES:
            raise UsageError(f"{path}: is no measurement of the MERL database, which has {12 + 24 * count:,} bytes")
        numbers = np.frombuffer(content, "<f8", offset=12).reshape(3, count)
        self._remarks = value_remarks(path.name, numbers)
        scaled = np.maximum(numbers * np.array(self.SCALES)[:, None], 0).astype(np.float32)
        self.name, self.digest = path.name, hashlib.sha256(content).hexdigest()
        self.channels = [types.Float(np.ascontiguousarray(c)) for c in scaled]

    def remarks(self, samples):
        return self._remarks

    def value(self, wi, wo):
        half = wi + wo
        half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
        cos_d = dr.clip(dr.dot(wi, half), 0, 1)
        theta_h = dr.atan2(dr.sqrt(dr.square(half.x) + dr.square(half.y)), half.z)
        theta_d = dr.acos(cos_d)
        along = wo.z - wi.z
        across = (wo.x * wi.y - wo.y * wi.x) * dr.rcp(dr.maximum(cos_d, 1e-6))
        phi_d = dr.atan2(across, along)
        phi_d = dr.select(phi_d < 0, phi_d + dr.pi, phi_d)
        positions = [dr.sqrt(theta_h * 2 * dr.inv_pi) * 90, theta_d * 2 * dr.inv_pi * 90, phi_d * dr.inv_pi * 180]
        return [wo.z * channel for channel in self._read(positions)]

    def _read(self, positions):
        axes = []
        for x, n in zip(positions, self.SIZES, strict=True):
            x = dr.clip(x, 0, n - 1)
            index = dr.minimum(dr.uint32_array_t(type(x))(x), n - 2)
            axes.append((index, x - type(x)(index)))
        result = [0, 0, 0]
        for corner in range(8):
            index, weight = 0, 1
            for k, ((i, f), n) in enumerate(zip(axes, self.SIZES, strict=True)):
                up = corner >> k & 1
                index, weight = index * n + i + up, weight * (f if up else 1 - f)
            result = [
                r + weight * dr.gather(type(weight), c, index) for r, c in zip(result, self.channels, strict=True)
            ]
        return result


def parameter_ranges(over) -> dict[str, tuple[float, float]]:
    """Return the ranges of parameters by name, from a dictionary or pairs. Raises :class:`UsageError`."""
    ranges = dict(over)
    if not 1 <= len(ranges) <= MOST_PARAMETERS:
        raise UsageError(f"over: found {len(ranges)} parameters, allowed are 1 to {MOST_PARAMETERS}")
    for name, ends in ranges.items():
        try:
            low, high = map(float, ends)
        except (TypeError, ValueError):
            low = high = math.nan
        if not (low < high and math.isfinite(low) and math.isfinite(high)):
            raise UsageError(f"over: found {name} = {ends!r}, a pair of finite numbers (low, high) is needed")
        ranges[name] = (low, high)
    return ranges


class FamilyTruth:
    """BSDF of Mitsuba whose ``parameters`` are set. Raises :class:`UsageError`.

    ``over`` maps names to ranges; a name is the key of ``mi.traverse``, with or without a last ``.value``, or its end.
    """

    def __init__(self, truth: Truth, over: dict[str, tuple[float, float]]):
        if not isinstance(truth, MitsubaTruth):
            raise UsageError(f"over: {truth.name} has no parameters, a BSDF of Mitsuba is needed")
        import mitsuba as mi

        self.truth, self.scene = truth, mi.traverse(truth.bsdf)
        scalars = [key for key in self.scene.keys() if type(self.scene[key]) is mi.Float]
        self.scalars = {key.removesuffix(".value"): key for key in scalars}
        self.keys, self.parameters = [], []
        for name, (low, high) in over.items():
            key = self._key(name)
            self.keys.append(self.scalars[key])
            self.parameters.append(Parameter(name.removesuffix(".value").replace(".", "_"), low, high))
        if len(set(self.keys)) < len(self.keys):
            raise UsageError(f"over: found {', '.join(over)}, which name a parameter twice")
        self.before = [mi.Float(self.scene[key]) for key in self.keys]

    def _key(self, name: str) -> str:
        name = name.removesuffix(".value")
        matching = [name] if name in self.scalars else [key for key in self.scalars if key.endswith("." + name)]
        if len(matching) != 1:
            allowed = ", ".join(matching or self.scalars) or "none"
            raise UsageError(f'over: found "{name}", the parameters of {self.truth.name} are {allowed}')
        return matching[0]

    def at(self, coordinates) -> MitsubaTruth:
        """Return the source at coordinates in [0, 1], one for each parameter. It is the same object for all."""
        self._set([p.value(float(x)) for p, x in zip(self.parameters, coordinates, strict=True)])
        return self.truth

    def _set(self, values: list) -> None:
        for key, value in zip(self.keys, values, strict=True):
            self.scene[key] = type(self.scene[key])(value)
        self.scene.update()

    def restore(self) -> None:
        """Give the source the parameters that it had."""
        self._set(self.before)

    def check_effects(self, types) -> None:
        """Raise :class:`UsageError` if a parameter changes nothing."""
        rng = dr.rng(seed=dr.opaque(types.UInt64, 1))
        samples = outgoing(rng, types, incident(rng, types, 2**10, False))
        for k, parameter in enumerate(self.parameters):
            ends = []
            for end in (0.0, 1.0):
                coordinates = [0.5] * len(self.parameters)
                coordinates[k] = end
                value = self.at(coordinates).value(samples.wi, samples.wo)
                ends.append(np.stack([(samples.weight * v).numpy() for v in value]))
            if np.abs(ends[1] - ends[0]).sum() <= 1e-5 * np.abs(ends[0]).sum():
                raise UsageError(
                    f"over: {parameter.name} changes nothing of {self.truth.name}, which may need it in the source, too"
                )

    def symmetries(self, types) -> dict[str, float]:
        """Return the largest relative differences of some members (:func:`.measured.measure_symmetry`)."""
        measured = [measure_symmetry(self.at(x), types, 2**14) for x in points(6, len(self.parameters), seed=9)]
        return {name: max(m[name] for m in measured) for name in measured[0]}


def truth_of(
    source, types, material: str = "", uv: tuple[float, float] = (0.5, 0.5), angles: str = "", illuminant: str = ""
) -> Truth:
    """Return the source of a BSDF.

    ``source`` is a scene or a single BSDF as a file (``.xml``) or as a dictionary of ``mi.load_dict``, a ``mi.BSDF``,
    a Python function or its name ``module:function``, a file of networks (``.npz``, :mod:`.functions`) or of fits
    (``.json``, :mod:`.shifted_gamma`), a measured file (``.bsdf``, ``.pbsdf``, ``.mbsdf``, ``.binary``), or a table of
    measurements (``.csv``), whose ``angles`` are degrees or radians ("": as its angles say). ``material`` is the id of
    a BSDF of a scene, or the name of a network or fit. Spectra of measured files have colours under an ``illuminant``
    (:mod:`.measured`; "": D65). Raises :class:`.UsageError`.
    """
    import mitsuba as mi

    if isinstance(source, mi.BSDF):
        return MitsubaTruth(source, source.class_name(), hashlib.sha256(str(source).encode()).hexdigest(), uv)
    if isinstance(source, dict):
        name, content = str(source.get("type", "dictionary")), repr(sorted(source.items(), key=str)).encode()
        bsdf = _choose(_load(name, lambda: mi.load_dict(source)), name, material)
        return MitsubaTruth(bsdf, name, _hash(content), uv)
    if callable(source):
        return PythonTruth(source)
    if is_function(source):
        return import_function(source)
    path = Path(os.fspath(source))
    if fault := irregular(path, memory() // 4):
        raise UsageError(f"{shown(path)}: {fault}")
    if not path.is_file():
        hint = ", and no Python function, module:function" if ":" in str(source) else ""
        raise UsageError(f"{path}: no such file{hint}")
    suffix = path.suffix.lower()
    if suffix == ".binary":
        return MERLTruth(path, types)
    if suffix == ".csv":
        return ScatteredTruth(path, angles)
    if suffix == ".mbsdf":
        return GridTruth(path)
    if suffix == ".npz":
        return NetworkTruth(path, material, types)
    if suffix == ".json":
        return ShiftedGammaTruth(path, material, types)
    illuminant = illuminant or ILLUMINANTS[0]
    if suffix == ".pbsdf":
        return PolarisedTruth(path, illuminant)
    if suffix == ".bsdf":
        bsdf, remark = _load(path, lambda: measured_bsdf(path, illuminant))
        truth = (MeasuredTruth if has_one_azimuth(path) else MitsubaTruth)(
            bsdf, path.name, _hash(path.read_bytes() + (illuminant.encode() if remark else b"")), uv
        )
        truth.remark = remark
        return truth
    if suffix != ".xml":
        raise UsageError(f'{path}: found the extension "{path.suffix}", allowed are {", ".join(SUFFIXES)}')
    loaded = _load(path, lambda: mi.load_file(str(path), optimize=False))
    bsdf = _choose(loaded, path, material)
    return MitsubaTruth(bsdf, bsdf.id() or path.name, _hash(path.read_bytes() + material.encode()), uv)


def is_function(source) -> bool:
    """Return whether a source is the name of a Python function, ``module:function``, and no file."""
    return isinstance(source, str) and bool(FUNCTION.fullmatch(source)) and not os.path.exists(source)


def recorded_source(options) -> dict:
    """Return what a table file keeps of a source beside the path of its file, so that it can be opened again.

    The name of a Python function is not kept: opening a file would import what it names.
    """
    source, recorded = options["source"], {name: options[name] for name in ("material", "uv", "angles", "illuminant")}
    recorded["uv"] = [float(x) for x in recorded["uv"]]
    try:
        if isinstance(source, dict) and json.loads(json.dumps(source)) == source:
            recorded["dictionary"] = source
    except (TypeError, ValueError):
        pass  # it holds objects
    return recorded


def recorded_truth(table: Table, types) -> Truth:
    """Return the source that a table file was fitted to.

    Raises :class:`TableError` if it cannot be opened again, or has changed since.
    """
    settings, name = table.settings, table.path or "BSDF"
    if "dictionary" in settings:
        source = settings["dictionary"]
    elif "source_path" in settings:
        source = Path(table.path or "x").resolve().parent / str(settings["source_path"])
    else:
        raise TableError(f"{name}: was fitted to an object in memory, which cannot be opened again")
    try:
        u, v = settings.get("uv", (0.5, 0.5))
        texts = {name: str(settings.get(name, "")) for name in ("material", "angles", "illuminant")}
        truth = truth_of(source, types, uv=(float(u), float(v)), **texts)
    except (TypeError, ValueError, UsageError) as e:
        raise TableError(f"{name}: its source cannot be opened again: {reason(e)}") from None
    if settings.get("source") not in (None, truth.digest):
        raise TableError(f"{name}: its source, {truth.name}, has changed since")
    return truth


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _load(name, load):
    try:
        return load()
    except UsageError:
        raise
    except Exception as e:  # Mitsuba raises several types
        raise UsageError(f"{name}: cannot be loaded ({reason(RuntimeError(NODE.sub('', one_sentence(e))))})") from None


def _choose(loaded, name, material: str):
    """Return the BSDF of what was loaded: itself, or that of a scene with the id ``material``."""
    import mitsuba as mi

    if isinstance(loaded, mi.BSDF):
        return loaded
    if not isinstance(loaded, mi.Scene):
        raise UsageError(f"{name}: is a {type(loaded).__name__}, a BSDF or a scene is needed")
    bsdfs = _bsdfs(loaded)
    chosen = [b for b in bsdfs if material in ("", b.id())]
    if len(chosen) == 1:
        return chosen[0]
    ids = sorted({b.id() for b in bsdfs if b.id()})
    names = ", ".join([*ids[:8], *(["…"] if len(ids) > 8 else [])]) or "none"
    if len(chosen) > 1:
        raise UsageError(
            f"{name}: has {len(chosen)} materials: name one by its id (material), those with ids are {names}"
        )
    raise UsageError(f'material: found "{material}", the materials of {name} with ids are {names}')


def _bsdfs(scene) -> list:
    """Return the BSDFs of a scene's shapes, each once."""
    return list({id(b): b for b in (shape.bsdf() for shape in scene.shapes()) if b is not None}.values())


def material_ids(path) -> list[str]:
    """Return the ids of the materials of a scene file, sorted, or the names of networks or fits.

    Those of a single BSDF are ``[""]``. Raises :class:`.UsageError`.
    """
    import mitsuba as mi

    if path.suffix.lower() == ".npz":
        with open_networks(path) as archive:
            return list(archive.members)
    if path.suffix.lower() == ".json":
        return list(read_fits(path))
    loaded = _load(path, lambda: mi.load_file(str(path), optimize=False))
    ids = sorted({b.id() for b in _bsdfs(loaded) if b.id()}) if isinstance(loaded, mi.Scene) else [""]
    if not ids:
        raise UsageError(f"{path}: its materials have no ids")
    return ids
