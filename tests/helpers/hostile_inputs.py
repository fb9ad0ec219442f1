"""Rays that no camera sends (NaN, infinity, no direction, denormals) through fields, alone and in a scene."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.tables import load_table, save_table

#: Numbers that replace one component of an origin or a direction.
WRONG = np.float32([
    np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, -1e-45, 1e-38, -1e-30, 1e-12, 1e-6, 1e6, 1e19, 1e30, -1e30, 3.4e38,
    -3.4e38,
])  # fmt: skip


def unit(v):
    """Return vectors of length 1, NaN for those of length 0."""
    with np.errstate(all="ignore"):
        return v / np.linalg.norm(v, axis=1, keepdims=True)


def some(rng, count: int, share: float) -> np.ndarray:
    """Draw the indices of a share of ``count`` rows."""
    return np.flatnonzero(rng.random(count) < share)


def rows(array_type, values: np.ndarray):
    """Return float32 rows ``(count, n)`` as a Dr.Jit vector."""
    return array_type(*(mi.Float(np.ascontiguousarray(v)) for v in values.T))


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
        place = some(rng, count, 0.1)
        values[place, rng.integers(0, 3, len(place))] = rng.choice(WRONG, len(place))
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
    """Return the shares of rays that meet a field, and of results that are not finite.

    Keys are the names of files, for the field alone, and the same followed by "in a scene".
    """
    report = {}
    for path in sorted(Path(folder).glob("*.npz")):
        box, follows = (distance_field if load_table(path).task == "sdf" else radiance_field)(path)
        o, d, length = rays(np.random.default_rng(7), count, *box)
        for name, follow in zip((path.name, f"{path.name} in a scene"), follows, strict=True):
            met, values = follow(rows(mi.Point3f, o), rows(mi.Vector3f, d), mi.Float(length))
            finite = dr.all([dr.isfinite(value) for value in values], axis=0)
            dr.eval(met, finite)
            report[name] = dr.count(met)[0] / count, 1 - dr.count(finite)[0] / count
    return report
