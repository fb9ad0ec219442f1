"""
Rays that no camera sends, in a child process with a limit of time, so that a ray that never ends fails a test and hangs
nothing: ``python hostile_rays.py COUNT FOLDER`` traces COUNT rays through every field of FOLDER (``*.npz``) and prints
a report as JSON.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

#: Numbers that replace one component of an origin or a direction.
WRONG = np.float32([
    np.nan, np.inf, -np.inf, 0.0, -0.0, 1e-45, -1e-45, 1e-38, -1e-30, 1e-12, 1e-6, 1e6, 1e19, 1e30, -1e30, 3.4e38,
    -3.4e38,
])  # fmt: skip

PART = 10**6


def unit(v):
    with np.errstate(all="ignore"):
        return v / np.linalg.norm(v, axis=1, keepdims=True)


def hostile_rays(rng, count: int, lower, upper, spacing: float):
    """Origins and directions ``(count, 3)`` and lengths ``(count,)``, float32, for a field in this box."""
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    centre, half = (lower + upper) / 2, (upper - lower) / 2
    o, d = rng.uniform(lower - 0.2 * half, upper + 0.2 * half, (count, 3)), unit(rng.normal(size=(count, 3)))

    def some(share):
        return rng.random(count) < share

    # On the planes of cells and on the sides of the box, along axes and almost so
    place = some(0.2)
    o[place] = lower + spacing * np.round((o[place] - lower) / spacing)
    side = rng.integers(0, 3, count)
    place = np.flatnonzero(some(0.1))
    o[place, side[place]] = np.where(rng.random(len(place)) < 0.5, lower[side[place]], upper[side[place]])
    place = np.flatnonzero(some(0.2))
    d[place] *= 10.0 ** rng.integers(-45, 1, (len(place), 3))
    d[place, side[place]] = np.where(rng.random(len(place)) < 0.5, -1, 1)
    # From afar, towards the field
    place = np.flatnonzero(some(0.2))
    aim = rng.uniform(lower, upper, (len(place), 3))
    o[place] = aim - d[place] * 10.0 ** rng.uniform(0, 30, (len(place), 1))
    # Grazing the sides and the inscribed ellipsoid
    place = np.flatnonzero(some(0.1))
    normal = unit(rng.normal(size=(len(place), 3)))
    d[place] = unit(np.cross(normal, d[place]))
    o[place] = centre + 0.8 * half * normal - d[place] * half.max() * rng.choice([0, 1, 3], (len(place), 1))
    # Directions of other lengths, and of none
    place = np.flatnonzero(some(0.1))
    d[place] *= 10.0 ** rng.integers(-45, 39, (len(place), 1))
    d[some(0.02)] = 0
    with np.errstate(over="ignore"):
        o, d = o.astype(np.float32), d.astype(np.float32)
    for values, share in ((o, 0.1), (d, 0.1)):
        place = np.flatnonzero(some(share))
        values[place, rng.integers(0, 3, len(place))] = rng.choice(WRONG, len(place))
    length = np.full(count, np.inf, np.float32)
    place = some(0.3)
    length[place] = rng.choice(np.append(WRONG, np.float32([-1, 0.5, 1, 3])), place.sum())
    return o, d, length


def trace(folder: Path, count: int) -> dict:
    """Return the numbers of rays, of those that meet a field, and of results that are not finite.

    Keys are the names of files, for the field alone, and the same followed by "in a scene".
    """
    import drjit as dr
    import mitsuba as mi

    import mi_diffind  # noqa: F401

    mi.set_variant("llvm_ad_rgb")
    report = {}
    for path in sorted(folder.glob("*.npz")):
        box, followed = opened(mi, path)
        for name, follow in followed.items():
            rng, numbers = np.random.default_rng(7), dict.fromkeys(("rays", "met", "not_finite"), 0)
            for first in range(0, count, PART):
                size = min(PART, count - first)
                o, d, length = hostile_rays(rng, size, *box)
                o, d = mi.Point3f(np.ascontiguousarray(o.T)), mi.Vector3f(np.ascontiguousarray(d.T))
                met, values = follow(o, d, mi.Float(length))
                finite = mi.Bool(True)
                for value in values:
                    finite &= dr.isfinite(value)
                dr.eval(met, finite)
                numbers["rays"] += size
                numbers["met"] += int(dr.count(met)[0])
                numbers["not_finite"] += int(dr.count(~finite)[0])
            report[name] = numbers
    return report


def write_fields(folder: Path) -> None:
    """Write small fields, each to a file of ``folder``."""
    from radiance_fields import ball_table
    from sdf_fields import dense_table, sparse_table

    from mi_diffind.arrays.tables import save_table

    tables = {
        "sparse": sparse_table(), "sparse_float32": sparse_table(), "dense": dense_table(), "field": ball_table(),
        "surroundings": ball_table((0, 0, 0, 0.6)),
    }  # fmt: skip
    for name, table in tables.items():
        save_table(folder / f"{name}.npz", table)


def opened(mi, path: Path) -> tuple:
    """The box of a field (corners, spacing), and functions that follow rays (origins, directions, lengths), by name.

    A function returns whether rays meet the field, and numbers that have to be finite.
    """
    import drjit as dr

    from mi_diffind.arrays.tables import load_table
    from mi_diffind.tasks.radiance import TASK as RADIANCE
    from mi_diffind.tasks.radiance import march
    from mi_diffind.tasks.sdf import TASK as SDF
    from mi_diffind.tasks.sdf import marching

    def through(scene):
        """Follow rays in a scene, in which the unit frame is the world."""
        loaded = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, **scene})
        integrator, sampler = loaded.integrator(), mi.load_dict({"type": "independent"})

        def follow(o, d, length):
            sampler.seed(dr.opaque(mi.UInt32, 3), dr.width(o))
            ray = mi.Ray3f(o, d)
            ray.maxt = length
            light, valid, *_ = integrator.sample(dr.ADMode.Primal, loaded, sampler, ray)
            return valid, list(light)

        return follow

    if load_table(path).task == "sdf":
        storage = "float32" if "float32" in path.stem else "uint8"
        model = SDF.open(mi.TensorXf, path, storage=storage)
        field = model.field

        def follow(o, d, length):
            hit = marching.intersect(field, o, d, length)
            blocked = marching.occluded(field, o, d, length)
            value, slope = field.gradient(hit.p, hit.hit)
            return hit.hit | blocked, [dr.select(hit.hit, v, 0) for v in (hit.t, *hit.p, value, *slope)]

        at = mi.ScalarTransform4f
        place = at().scale(1 / model.scale).translate([-x for x in model.centre])
        shape = {"type": "neural_sdf", "filename": str(path), "storage": storage, "to_world": place}
        tracer = {"type": "path_sdf", "max_depth": 4}
        scene = {"integrator": tracer, "solid": {**shape, "bsdf": {"type": "plastic"}}}
        followed = {path.name: follow, f"{path.name} in a scene": through(scene)}
        return (field.lower, field.upper, field.spacing), followed
    field = RADIANCE.open(mi.TensorXf, path).field

    def follow(o, d, length):
        seen = march.march(field, o, d, mi.Float(0), length)
        return seen.transmittance < 1, [*seen.colour, seen.transmittance, seen.depth]

    ball = {"type": "sphere", "radius": 0.3, "bsdf": {"type": "dielectric"}}
    tracer = {"type": "neural_field", "filename": str(path), "max_depth": 4, "lit": True}
    followed = {path.name: follow, f"{path.name} in a scene": through({"integrator": tracer, "ball": ball})}
    return (field.lower, field.upper, field.voxel), followed


def report_of(folder, count: int, seconds: float) -> dict:
    """Trace ``count`` rays through every field of a folder in a child; it is killed after some ``seconds``."""
    command = [sys.executable, __file__, str(count), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    print(json.dumps(trace(Path(sys.argv[2]), int(sys.argv[1]))))
