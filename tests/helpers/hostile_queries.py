"""Queries that no ray makes, of materials and textures: NaN, infinity, horizons, huge and empty footprints."""

import dataclasses

import drjit as dr
import numpy as np
import plugin_examples as examples
from hostile_rays import WRONG, unit

from mi_diffind import plugins

PART = 10**6

#: Components of directions of no length, or of almost none.
NO_DIRECTION = WRONG[~(np.abs(WRONG) > 1) | np.isinf(WRONG)]

#: Plugin → parameters besides those of its example, each a further material.
FURTHER = {
    "disney": [
        {"roughness": 0.0, "anisotropic": 1.0, "metallic": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 1.0},
        {"base_color": 0.0, "roughness": 0.0, "metallic": 0.0, "sheen": 1.0, "sheen_tint": 1.0, "flatness": 1.0},
    ],
    "neural_ggx": [{"alpha": 0.0, "eta": 0.0, "k": 1.0}, {"alpha": 1.0, "eta": 0.0, "k": 0.0}],
    "neural_bsdf": [{"filename": f"library/{name}.npz"} for name in ("pearl", "rubber")],
    "neural_texture": [{"filename": "tiles_filtered.npz", "channels": "normal"}],
}
FURTHER["neural_disney"] = FURTHER["disney"]


@dataclasses.dataclass(frozen=True)
class Queries:
    """Hostile inputs: float32, ``(count, n)``."""

    wi: np.ndarray
    wo: np.ndarray
    uv: np.ndarray
    footprint: np.ndarray
    random: np.ndarray

    @staticmethod
    def of(rng, count: int) -> "Queries":
        """Draw some queries."""

        def some(share):
            return np.flatnonzero(rng.random(count) < share)

        def direction():
            d = unit(rng.normal(size=(count, 3)))
            place = some(0.2)  # on the horizon and almost so
            d[place, 2] = rng.choice([0, -0.0, 1e-45, 1e-30, 1e-8, -1e-8, 1e-4], len(place))
            place = some(0.1)
            d[place] = [0, 0, 1]
            place = some(0.1)  # directions that are none
            d[place, rng.integers(0, 3, len(place))] = rng.choice(NO_DIRECTION, len(place))
            d[some(0.01)] = 0
            return d

        wi, wo = direction(), direction()
        place = some(0.1)
        wo[place] = wi[place] * rng.choice([-1, 1], (len(place), 1))  # retro-reflection, and transmission
        place = some(0.1)
        wo[place] = wi[place] * [-1, -1, 1]  # mirrored
        uv = rng.uniform(-2, 3, (count, 2))
        place = some(0.2)  # borders of the unit square and of texels
        uv[place] = np.round(uv[place] * 256) / 256
        place = some(0.1)
        uv[place] *= 10.0 ** rng.integers(0, 38, (len(place), 1))
        footprint = rng.normal(size=(count, 4)) * 10.0 ** rng.uniform(-6, 1, (count, 1))
        place = some(0.2)
        footprint[place] *= 10.0 ** rng.integers(-45, 38, (len(place), 1))
        footprint[some(0.1)] = 0
        random = rng.random((count, 3))
        place = some(0.2)
        random[place, rng.integers(0, 3, len(place))] = rng.choice([0, 1e-45, 0.5, 1 - 2**-24], len(place))
        with np.errstate(over="ignore"):
            arrays = [a.astype(np.float32) for a in (wi, wo, uv, footprint, random)]
        for array in arrays[2:4]:
            place = some(0.1)
            array[place, rng.integers(0, array.shape[1], len(place))] = rng.choice(WRONG, len(place))
        arrays[4] = np.minimum(arrays[4], np.float32(1 - 2**-24))
        return Queries(*arrays)


def is_queried(name: str) -> bool:
    """Return whether a plugin is a material or a texture; a variant is set."""
    return plugins.declared()[name].object_type in ("bsdf", "texture")


def answers(mi, plugin, queries: Queries) -> dict[str, list]:
    """Return what a plugin answers, by name: numbers that have to be finite."""

    def vector(of, values):
        return of(*(mi.Float(np.ascontiguousarray(v)) for v in values.T))

    si = dr.zeros(mi.SurfaceInteraction3f, len(queries.wi))
    si.wi, si.uv = vector(mi.Vector3f, queries.wi), vector(mi.Point2f, queries.uv)
    si.duv_dx, si.duv_dy = (vector(mi.Vector2f, queries.footprint[:, k : k + 2]) for k in (0, 2))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv, si.n = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Normal3f(0, 0, 1)
    si.t = mi.Float(1)
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    u, wo, ctx = vector(mi.Point3f, queries.random), vector(mi.Vector3f, queries.wo), mi.BSDFContext()
    if isinstance(plugin, mi.BSDF):
        value, pdf = plugin.eval_pdf(ctx, si, wo)
        sampled, weight = plugin.sample(ctx, si, u.x, mi.Point2f(u.y, u.z))
        return {
            "eval": list(mi.unpolarized_spectrum(plugin.eval(ctx, si, wo))), "pdf": [plugin.pdf(ctx, si, wo)],
            "eval_pdf": [*mi.unpolarized_spectrum(value), pdf], "weight": list(mi.unpolarized_spectrum(weight)),
            "sample": [*sampled.wo, sampled.pdf, sampled.eta],
        }  # fmt: skip
    return {"eval": list(plugin.eval(si)), "eval_3": list(plugin.eval_3(si)), "eval_1": [plugin.eval_1(si)]}


def materials(mi, name: str) -> list:
    """Return a plugin's example and further ones, loaded."""
    return [mi.load_dict(examples.example(name, **more)) for more in ({}, *FURTHER.get(name, ()))]


def faults(mi, name: str, count: int) -> dict[str, list]:
    """Return the kinds of answers of a plugin that are not finite or negative, each with queries of which they are."""
    result = {}
    for number, plugin in enumerate(materials(mi, name)):
        rng = np.random.default_rng(11)
        for first in range(0, count, PART):
            queries = Queries.of(rng, min(PART, count - first))
            for answer, values in answers(mi, plugin, queries).items():
                wrong = mi.Bool(False)
                for value in values:
                    wrong |= ~dr.isfinite(value)
                    if answer != "sample":
                        wrong |= value < 0
                where = np.flatnonzero(np.array(wrong) & np.ones(len(queries.wi), bool))
                if len(where):
                    at, numbers = where[0], [np.broadcast_to(np.array(v), len(queries.wi)) for v in values]
                    case = {f.name: getattr(queries, f.name)[at].tolist() for f in dataclasses.fields(queries)}
                    result.setdefault(f"{number}: {answer}", [len(where), [float(v[at]) for v in numbers], case])
    return result
