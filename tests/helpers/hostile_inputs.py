"""Rays that no camera sends, and queries that no ray makes: NaN, infinity, no direction, denormals, horizons.

:func:`trace` sends rays through fields, alone and in a scene; :func:`faults` asks materials and textures for values,
densities and samples. Both count answers that are not finite.
"""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import plugin_examples as examples

from mi_diffind import plugins
from mi_diffind.arrays.tables import load_table, save_table

#: Numbers that replace one component of an origin, a direction, a coordinate or a footprint.
WRONG = np.float32([
    np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, -1e-45, 1e-38, -1e-30, 1e-12, 1e-6, 1e6, 1e19, 1e30, -1e30, 3.4e38,
    -3.4e38,
])  # fmt: skip

#: Components of directions of no length, or of almost none.
NO_DIRECTION = WRONG[~(np.abs(WRONG) > 1) | np.isinf(WRONG)]

#: Rays or queries of one kernel.
PART = 250_000


def unit(v):
    """Return vectors of length 1, NaN for those of length 0."""
    with np.errstate(all="ignore"):
        return v / np.linalg.norm(v, axis=1, keepdims=True)


def some(rng, count: int, share: float) -> np.ndarray:
    """Draw the indices of a share of ``count`` rows."""
    return np.flatnonzero(rng.random(count) < share)


def replace_component(rng, values: np.ndarray, share: float, numbers=WRONG) -> None:
    """Replace one component of a share of vectors."""
    place = some(rng, len(values), share)
    values[place, rng.integers(0, values.shape[1], len(place))] = rng.choice(numbers, len(place))


def rows(array_type, values: np.ndarray):
    """Return float32 rows ``(count, n)`` as a Dr.Jit vector."""
    return array_type(*(mi.Float(np.ascontiguousarray(v)) for v in values.T))


def parts(count: int):
    """Yield the sizes of the kernels of ``count`` rays or queries."""
    for first in range(0, count, PART):
        yield min(PART, count - first)


# -- rays --------------------------------------------------------------------------------------------------------------


def rays(rng, count: int, lower, upper, spacing: float):
    """Origins and directions ``(count, 3)`` and lengths ``(count,)``, float32, for a field in this box."""
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    o, d = rng.uniform(lower - 0.2 * half, upper + 0.2 * half, (count, 3)), unit(rng.normal(size=(count, 3)))
    # On the planes of cells and on the sides of the box, along axes and almost so
    place = some(rng, count, 0.2)
    o[place] = lower + spacing * np.round((o[place] - lower) / spacing)
    side, place = rng.integers(0, 3, count), some(rng, count, 0.1)
    o[place, side[place]] = np.where(rng.random(len(place)) < 0.5, lower[side[place]], upper[side[place]])
    place = some(rng, count, 0.2)
    d[place] *= 10.0 ** rng.integers(-45, 1, (len(place), 3))
    d[place, side[place]] = np.where(rng.random(len(place)) < 0.5, -1, 1)
    # From afar, towards the field
    place = some(rng, count, 0.2)
    o[place] = rng.uniform(lower, upper, (len(place), 3)) - d[place] * 10.0 ** rng.uniform(0, 30, (len(place), 1))
    # Grazing the sides and the inscribed ellipsoid
    place = some(rng, count, 0.1)
    normal = unit(rng.normal(size=(len(place), 3)))
    d[place] = unit(np.cross(normal, d[place]))
    o[place] = centre + 0.8 * half * normal - d[place] * half.max() * rng.choice([0, 1, 3], (len(place), 1))
    # Directions of other lengths, and of none
    place = some(rng, count, 0.1)
    d[place] *= 10.0 ** rng.integers(-45, 39, (len(place), 1))
    d[some(rng, count, 0.02)] = 0
    with np.errstate(over="ignore"):
        o, d = o.astype(np.float32), d.astype(np.float32)
    for values in (o, d):
        replace_component(rng, values, 0.1)
    length, place = np.full(count, np.inf, np.float32), some(rng, count, 0.3)
    length[place] = rng.choice(np.append(WRONG, np.float32([-1, 0.5, 1, 3])), len(place))
    return o, d, length


def write_fields(folder: Path) -> None:
    """Write small fields, each to a file of ``folder``."""
    from radiance_fields import ball_table
    from sdf_fields import sparse_table
    from trial_files import SEEDS

    tables = {
        "sparse": sparse_table(), "sparse_float32": sparse_table(), "dense": load_table(SEEDS / "sdf_paper.npz"),
        "field": ball_table(), "surroundings": ball_table((0, 0, 0, 0.6)),
    }  # fmt: skip
    for name, table in tables.items():
        save_table(folder / f"{name}.npz", table)


def is_wrong(values, least=-np.inf):
    """Return where one of several arrays is not finite, or less than ``least``."""
    wrong = mi.Bool(False)
    for value in values:
        wrong |= ~dr.isfinite(value) | (value < least)
    return wrong


def in_scene(scene: dict):
    """Return a function that follows rays in a scene."""
    loaded = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **scene})
    integrator, sampler = loaded.integrator(), mi.load_dict({"type": "independent"})

    def follow(o, d, length):
        sampler.seed(dr.opaque(mi.UInt32, 3), dr.width(o))
        ray = mi.Ray3f(o, d)
        ray.maxt = length
        light, valid, *_ = integrator.sample(dr.ADMode.Primal, loaded, sampler, ray)
        return valid, list(light)

    return follow


def distance_field(path: Path) -> tuple:
    """Return the box of a distance field (corners, spacing), and functions that follow rays alone and in a scene.

    A function returns whether rays meet the field, and numbers that have to be finite.
    """
    from mi_diffind.tasks.sdf import TASK, marching

    storage = "float32" if "float32" in path.stem else "uint8"
    model = TASK.open(mi.TensorXf, path, storage=storage)
    field = model.field

    def follow(o, d, length):
        hit = marching.intersect(field, o, d, length)
        blocked = marching.occluded(field, o, d, length)
        value, slope = field.gradient(hit.p, hit.hit)
        return hit.hit | blocked, [dr.select(hit.hit, v, 0) for v in (hit.t, *hit.p, value, *slope)]

    # The unit frame is the world
    place = mi.ScalarTransform4f().scale(1 / model.scale).translate([-x for x in model.centre])
    shape = {"type": "neural_sdf", "filename": str(path), "storage": storage, "to_world": place}
    scene = {"integrator": {"type": "path_sdf", "max_depth": 4}, "solid": {**shape, "bsdf": {"type": "plastic"}}}
    return (field.lower, field.upper, field.spacing), (follow, in_scene(scene))


def radiance_field(path: Path) -> tuple:
    """Return the same of a radiance field, which has a glass ball within in the scene."""
    from mi_diffind.tasks.radiance import TASK, march

    field = TASK.open(mi.TensorXf, path).field

    def follow(o, d, length):
        seen = march.march(field, o, d, mi.Float(0), length)
        return seen.transmittance < 1, [*seen.colour, seen.transmittance, seen.depth]

    ball = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric"}}
    tracer = {"type": "neural_field", "filename": str(path), "max_depth": 4, "lit": True}
    return (field.lower, field.upper, field.voxel), (follow, in_scene({"integrator": tracer, "ball": ball}))


def trace(folder: str, count: int) -> dict:
    """Return the numbers of rays, of those that meet a field, and of results that are not finite.

    Keys are the names of files, for the field alone, and the same followed by "in a scene".
    """
    report = {}
    for path in sorted(Path(folder).glob("*.npz")):
        box, follows = (distance_field if load_table(path).task == "sdf" else radiance_field)(path)
        for name, follow in zip((path.name, f"{path.name} in a scene"), follows, strict=True):
            rng, numbers = np.random.default_rng(7), dict.fromkeys(("rays", "met", "not_finite"), 0)
            for size in parts(count):
                o, d, length = rays(rng, size, *box)
                met, values = follow(rows(mi.Point3f, o), rows(mi.Vector3f, d), mi.Float(length))
                wrong = is_wrong(values)
                dr.eval(met, wrong)
                for key, number in (("rays", size), ("met", dr.count(met)[0]), ("not_finite", dr.count(wrong)[0])):
                    numbers[key] += int(number)
            report[name] = numbers
    return report


# -- queries -----------------------------------------------------------------------------------------------------------

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


def directions(rng, count: int) -> np.ndarray:
    """Return directions, some on the horizon and almost so, at the normal, and some that are none."""
    d = unit(rng.normal(size=(count, 3)))
    place = some(rng, count, 0.2)
    d[place, 2] = rng.choice([0, -0.0, 1e-45, 1e-30, 1e-8, -1e-8, 1e-4], len(place))
    d[some(rng, count, 0.1)] = [0, 0, 1]
    replace_component(rng, d, 0.1, NO_DIRECTION)
    d[some(rng, count, 0.01)] = 0
    return d


def queries(rng, count: int) -> dict[str, np.ndarray]:
    """Return hostile inputs by name, float32, ``(count, n)``."""
    wi, wo = directions(rng, count), directions(rng, count)
    place = some(rng, count, 0.1)
    wo[place] = wi[place] * rng.choice([-1, 1], (len(place), 1))  # retro-reflection, and transmission
    place = some(rng, count, 0.1)
    wo[place] = wi[place] * [-1, -1, 1]  # mirrored
    uv, place = rng.uniform(-2, 3, (count, 2)), some(rng, count, 0.2)
    uv[place] = np.round(uv[place] * 256) / 256  # borders of the unit square and of texels
    place = some(rng, count, 0.1)
    uv[place] *= 10.0 ** rng.integers(0, 38, (len(place), 1))
    footprint = rng.normal(size=(count, 4)) * 10.0 ** rng.uniform(-6, 1, (count, 1))
    place = some(rng, count, 0.2)
    footprint[place] *= 10.0 ** rng.integers(-45, 38, (len(place), 1))
    footprint[some(rng, count, 0.1)] = 0
    random = rng.random((count, 3))
    replace_component(rng, random, 0.2, [0, 1e-45, 0.5, 1 - 2**-24])
    values = {"wi": wi, "wo": wo, "uv": uv, "footprint": footprint, "random": np.minimum(random, 1 - 2**-24)}
    with np.errstate(over="ignore"):
        values = {name: array.astype(np.float32) for name, array in values.items()}
    for name in ("uv", "footprint"):
        replace_component(rng, values[name], 0.1)
    return values


def is_queried(name: str) -> bool:
    """Return whether a plugin is a material or a texture; a variant is set."""
    return plugins.declared()[name].object_type in ("bsdf", "texture")


def answers(plugin, given: dict[str, np.ndarray]) -> dict[str, list]:
    """Return what a plugin answers, by name: numbers that have to be finite."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(given["wi"]))
    si.wi, si.uv = rows(mi.Vector3f, given["wi"]), rows(mi.Point2f, given["uv"])
    si.duv_dx, si.duv_dy = (rows(mi.Vector2f, given["footprint"][:, k : k + 2]) for k in (0, 2))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.dp_du, si.dp_dv, si.n = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Normal3f(0, 0, 1)
    si.t = mi.Float(1)
    u, wo, ctx = rows(mi.Point3f, given["random"]), rows(mi.Vector3f, given["wo"]), mi.BSDFContext()
    if isinstance(plugin, mi.BSDF):
        value, pdf = plugin.eval_pdf(ctx, si, wo)
        sampled, weight = plugin.sample(ctx, si, u.x, mi.Point2f(u.y, u.z))
        return {
            "eval": list(plugin.eval(ctx, si, wo)), "pdf": [plugin.pdf(ctx, si, wo)], "eval_pdf": [*value, pdf],
            "weight": list(weight), "sample": [*sampled.wo, sampled.pdf, sampled.eta],
        }  # fmt: skip
    return {"eval": list(plugin.eval(si)), "eval_3": list(plugin.eval_3(si)), "eval_1": [plugin.eval_1(si)]}


def materials(name: str) -> list:
    """Return a plugin's example and further ones, loaded; an RGB variant is set."""
    return [mi.load_dict(examples.example(name, **more)) for more in ({}, *FURTHER.get(name, ()))]


def faults(name: str, count: int) -> dict[str, list]:
    """Return the answers of a plugin that are not finite or negative: their number, and the values of one query."""
    result = {}
    for number, plugin in enumerate(materials(name)):
        rng = np.random.default_rng(11)
        for size in parts(count):
            given = queries(rng, size)
            for answer, values in answers(plugin, given).items():
                where = np.flatnonzero(np.broadcast_to(is_wrong(values, -np.inf if answer == "sample" else 0), size))
                if len(where):
                    at = where[0]
                    numbers = [float(np.broadcast_to(np.array(v), size)[at]) for v in values]
                    case = {key: array[at].tolist() for key, array in given.items()}
                    result.setdefault(f"{number}: {answer}", [len(where), numbers, case])
    return result
