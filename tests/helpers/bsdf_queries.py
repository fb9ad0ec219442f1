"""Queries of BSDFs: interactions, directions, random numbers, contexts, textures with a texel for each, and scenes."""

import contextlib
import math

import drjit as dr
import numpy as np
from arrays import aligned

SPECIAL_COSINES = (0, 1e-40, 1e-38, 1e-30, 1e-20, 1e-8, 1e-4, 0.01, 0.5, 1 - 2**-24, 1, -1e-8, -0.5)


def bitmap(mi, values, **more):
    """Description of a texture of ``values``, (height, width[, channels]), read as they are."""
    values = np.asarray(values, np.float32)
    data = mi.TensorXf(aligned(values.reshape(*values.shape[:2], -1)))
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest", "format": "variant", **more}


def texels(mi, values):
    """Description of a texture of two or more ``values`` in a row, read at the ``uv`` of :func:`interactions`."""
    return bitmap(mi, [values] * 2)  # Mitsuba wants two rows


def interactions(mi, wi, texel=None, count=1):
    """Interactions that see ``wi``, (n, 3) or a vector, at the texels with the numbers ``texel`` (of ``count``)."""
    wi = vectors(mi, wi) if isinstance(wi, np.ndarray) else wi
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi, si.t = wi, mi.Float(1)
    si.n, si.dp_du, si.dp_dv = mi.Normal3f(0, 0, 1), mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    si.sh_frame = mi.Frame3f(si.n)
    if texel is not None:
        si.uv = mi.Point2f(mi.Float(aligned((np.asarray(texel) + 0.5) / count)), 0.5)
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    return si


def random_directions(rng, n, low=0.0):
    """Directions, (n, 3), uniform over the part of the hemisphere with cosines in [low, 1]."""
    return with_cosines(rng, low + (1 - low) * rng.random(n))


def with_cosines(rng, cosines):
    """Directions with given cosines, (n, 3) in float32, as exactly unit vectors as that allows."""
    phi = 2 * np.pi * rng.random(len(cosines))
    r = np.sqrt(1 - np.square(cosines))
    return np.stack([r * np.cos(phi), r * np.sin(phi), cosines], axis=1).astype(np.float32)


def extreme_directions(rng, n):
    """Pairs of unit vectors, (n, 3) each, some of them equal, opposite, mirrored, or nearly so."""
    z = np.where(
        rng.random((2, n)) < 0.6, rng.choice(np.array(SPECIAL_COSINES), (2, n)), 10.0 ** rng.uniform(-44, 0, (2, n))
    )
    phi = np.where(rng.random((2, n)) < 0.5, rng.choice([0, math.pi / 2, math.pi, 1.0], (2, n)), 6 * rng.random((2, n)))
    r = np.sqrt(1 - np.minimum(np.square(z), 1))
    w = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1)
    mirrored = w[0] * [-1, -1, 1]
    choices = (w[1], w[0], -w[0], mirrored, mirrored + 1e-6, w[0] + [1e-7, 0, 0])
    kind = rng.integers(0, len(choices), n)
    return w[0].astype(np.float32), np.select([(kind == k)[:, None] for k in range(6)], choices).astype(np.float32)


def vectors(mi, w):
    """Vector of Mitsuba for directions (n, 3)."""
    return mi.Vector3f(aligned(np.asarray(w, np.float32).T))


def uniform(mi, rng, n):
    """Random numbers of a sample of a BSDF."""
    u = [mi.Float(aligned(rng.random(n))) for _ in range(3)]
    return u[0], mi.Point2f(u[1], u[2])


def contexts(mi, bsdf):
    """Name → a context, and the components of a BSDF that it turns on."""
    every = range(bsdf.component_count())
    result = {"all": (mi.BSDFContext(), [*every])}
    for component in every:
        ctx = mi.BSDFContext()
        ctx.component = component
        result[f"component {component}"] = ctx, [component]
    for name in ("DiffuseReflection", "GlossyReflection", "DeltaReflection"):
        ctx, flag = mi.BSDFContext(), getattr(mi.BSDFFlags, name)
        ctx.type_mask = flag
        result[name] = ctx, [i for i in every if mi.has_flag(bsdf.flags(i), flag)]
    return result


def close(a, b, rtol=1e-5):
    """Whether values are equal up to rounding, relative to the value and to the largest value in its row."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return np.abs(a - b) <= rtol * np.maximum(np.abs(a), np.abs(b)) + rtol * 1e-5 * np.abs(b).max(initial=1e-3)


def equal_images(a, b):
    """Whether images are equal, but for a few paths that rounding sends elsewhere."""
    return (np.abs(a - b) <= 1e-4 * (np.abs(b) + 1e-2)).mean() > 0.99 and abs(a.mean() / b.mean() - 1) < 1e-3


def tile(image, i, columns, size):
    """Square ``i`` of an image of squares with a side of ``size``."""
    return image[size * (i // columns) : size * (i // columns + 1), size * (i % columns) : size * (i % columns + 1)]


@contextlib.contextmanager
def gradients_enabled(mi, params, keys, n):
    """Of several parameters, to be read in one kernel: numbers and colours are repeated for each of ``n`` lanes, since
    the gradient of a single number is a sum over all lanes, which is a kernel for each.
    """
    for key in keys:
        dr.enable_grad(params[key])
    params.update()
    given = {key: dr.detach(params[key]) for key in keys}
    for key, value in given.items():
        if not dr.is_tensor_v(value):
            params[key] = value + dr.opaque(mi.Float, 0, n)
            dr.enable_grad(params[key])
    yield
    for key, value in given.items():
        params[key] = value
    params.update()


def sphere_scene(mi, bsdfs, integrator="path", size=16, columns=None, light=0.5, depth=3, **extra):
    """Spheres in a square grid, one for each BSDF (or a single one), under an even sky and a lamp."""
    bsdfs = bsdfs if isinstance(bsdfs, list) else [bsdfs]
    columns = columns or math.ceil(math.sqrt(len(bsdfs)))
    spheres = {
        f"shape{i}": {
            "type": "sphere",
            "radius": 0.9 / columns,
            "center": [(2 * (i % columns) + 1) / columns - 1, 1 - (2 * (i // columns) + 1) / columns, 0],
            "bsdf": bsdf,
        }
        for i, bsdf in enumerate(bsdfs)
    }
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": integrator, **({"max_depth": depth} if integrator != "direct" else {})},
        "sensor": {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(1 / 20)),
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 20], [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            },
        },
        "light": {"type": "constant", "radiance": light},
        "lamp": {"type": "point", "position": [2.0, 3.0, 4.0], "intensity": 20.0},
        **spheres,
        **extra,
    })  # fmt: skip


def key_of(params, end):
    return next(k for k in params.keys() if k.endswith(end))
