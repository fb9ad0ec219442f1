"""Properties that every plugin is measured for in a variant: energy, reciprocity, χ², furnace, gradients.

The plugins are those of the registry, and their examples those of :mod:`plugin_examples`. Each property is a function
of ``mitsuba``, a plugin's name and :class:`Effort`, and returns a :class:`Cell`.
"""

from __future__ import annotations

import dataclasses
import math

import drjit as dr
import numpy as np
import plugin_examples as examples
import radiance_fields
from arrays import aligned, numpy_of
from bsdf_queries import random_directions, uniform, vectors

from mi_diffind import plugins
from mi_diffind.core import compat

HOLDS, FAILS, NOT_APPLICABLE, NOT_RUN = "holds", "fails", "does not apply", "not run"


@dataclasses.dataclass(frozen=True)
class Cell:
    """Result of a property: ``figure`` is held against ``limit``; ``reason`` says what was measured, or why not."""

    result: str
    figure: float | None = None
    limit: float | None = None
    reason: str = ""


@dataclasses.dataclass(frozen=True)
class Effort:
    """Numbers of samples: lanes of directions, samples of a χ² test, samples in a pixel, pixels along a side."""

    lanes: int = 2**16
    chi2_samples: int = 500_000
    spp: int = 64
    side: int = 24
    angles: tuple = (5, 50, 80)


QUICK = Effort(2**13, 200_000, 16, 8, (50,))

#: Plugin → parameters of the materials whose energy and furnace are measured: those that lose least.
BRIGHT = {
    "disney": [
        {"base_color": 1.0, "roughness": r, "metallic": m, "sheen": 0.0, "clearcoat": 0.0}
        for r, m in ((0.3, 1.0), (0.6, 0.0), (1.0, 0.0))
    ],
    "neural_ggx": [{"alpha": a, "eta": 0.0, "k": 1.0} for a in (0.05, 0.3, 1.0)],
    "neural_bsdf": [{"filename": f"library/{name}.npz"} for name in ("copper", "pearl", "ceramic")],
}
BRIGHT["neural_disney"] = BRIGHT["disney"]

#: Plugin → parameters of the material of the χ² test, whose lobes are wider than a cell of its histogram.
SMOOTH = {"neural_bsdf": {"filename": "library/rubber.npz"}}


def judged(figure: float, limit: float, reason: str) -> Cell:
    """Return the cell of a figure that must not be above a limit."""
    holds = math.isfinite(figure) and figure <= limit
    return Cell(HOLDS if holds else FAILS, float(f"{figure:.4g}"), limit, reason)


def kept_away(mi, name: str, types: tuple[str, ...], reason: str) -> Cell | None:
    """Return the cell of a property that is not one of the plugin's, ``None`` if it is."""
    if plugins.declared()[name].object_type not in types:
        return Cell(NOT_APPLICABLE, reason=reason)
    refusal = examples.refusal(mi, name)
    return Cell(NOT_APPLICABLE, reason=refusal) if refusal else None


def directions(mi, rng, count: int, low: float = 0.05):
    """Return random directions of the upper hemisphere."""
    return vectors(mi, random_directions(rng, count, low))


def hits(mi, wi, uv=None, count: int = 0):
    """Return ``count`` surface interactions with ``wi``, and wavelengths in spectral variants."""
    si = dr.zeros(mi.SurfaceInteraction3f, count or dr.width(wi))
    si.wi, si.uv = wi, mi.Point2f(0.3, 0.6) if uv is None else uv
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    return si


def incident(mi, degrees: float):
    """Return a direction at an angle to the normal, opaque: one kernel serves all angles."""
    angle = math.radians(degrees)
    return dr.opaque(mi.Vector3f, [math.sin(angle), 0, math.cos(angle)])


def energy(mi, name: str, effort: Effort) -> Cell:
    """Directional albedo of bright materials: the largest of all angles and channels, by importance sampling."""
    if cell := kept_away(mi, name, ("bsdf",), "only materials scatter light"):
        return cell
    rng, ctx, largest = np.random.default_rng(1), mi.BSDFContext(), (-math.inf, 0.0, 0.0)
    for more in BRIGHT.get(name, [{}]):
        bsdf = mi.load_dict(examples.example(name, **more))
        for degrees in (0, 30, 60, 80, 88):
            si = hits(mi, incident(mi, degrees), count=effort.lanes)
            _, weight = bsdf.sample(ctx, si, *uniform(mi, rng, effort.lanes))
            values = numpy_of(mi.unpolarized_spectrum(weight))
            error = values.std(axis=0) / math.sqrt(effort.lanes)
            largest = max(largest, *zip(values.mean(axis=0), error, [degrees] * len(error), strict=True))
    albedo, error, degrees = largest
    reason = f"largest directional albedo, at {degrees} degrees, standard error {error:.1g}"
    return judged(albedo, round(1.001 + 4 * error, 4), reason)


def reciprocity(mi, name: str, effort: Effort) -> Cell:
    """Relative difference of f(wi, wo) and f(wo, wi): the 99.9% quantile over random directions."""
    if cell := kept_away(mi, name, ("bsdf",), "only materials scatter light"):
        return cell
    rng, ctx = np.random.default_rng(2), mi.BSDFContext()
    bsdf = mi.load_dict(examples.example(name))
    a, b = (directions(mi, rng, effort.lanes) for _ in range(2))
    values = [
        numpy_of([v / wo.z for v in mi.unpolarized_spectrum(bsdf.eval(ctx, hits(mi, wi), wo))])
        for wi, wo in ((a, b), (b, a))
    ]
    size = np.maximum(np.abs(values[0]), np.abs(values[1])) + 1e-4
    figure = np.quantile(np.abs(values[0] - values[1]) / size, 0.999)
    return judged(figure, 2e-3, "99.9% quantile of the relative difference of f after exchange of directions")


def chi2(mi, name: str, effort: Effort) -> Cell:
    """Mitsuba's χ² test of what is sampled: directions of materials, positions of textures.

    The figure is the number of rejected tests. ``mi.chi2.BSDFAdapter`` gives no wavelengths, hence the functions here.
    """
    from mitsuba.chi2 import ChiSquareTest, PlanarDomain, SphericalDomain

    if cell := kept_away(mi, name, ("bsdf", "texture"), "samples no directions or positions of its own"):
        return cell
    subject = mi.load_dict(examples.example(name, **SMOOTH.get(name, {})))
    tests, ctx = [], mi.BSDFContext()
    if plugins.declared()[name].object_type == "texture":
        domain = PlanarDomain(mi.ScalarBoundingBox2f([0, 0], [1, 1]))
        sample, density = lambda u: subject.sample_position(u)[0], subject.pdf_position
        tests.append(ChiSquareTest(domain, sample, density, 2, effort.chi2_samples, res=21, ires=32))
    else:
        for degrees in effort.angles:

            def sample(u, degrees=degrees):
                si = hits(mi, incident(mi, degrees), count=dr.width(u))
                bs, _ = subject.sample(ctx, si, u.x, mi.Point2f(u.y, u.z))
                return bs.wo, dr.select(bs.pdf > 0, mi.Float(1), 0)

            def density(wo, degrees=degrees):
                return subject.pdf(ctx, hits(mi, incident(mi, degrees), count=dr.width(wo)), wo)

            tests.append(ChiSquareTest(SphericalDomain(), sample, density, 3, effort.chi2_samples, res=61, ires=16))
    rejected = [t for t in tests if not t.run(significance_level=0.01, test_count=len(tests), quiet=True)]
    reason = f"rejected of {len(tests)} at 1%, smallest p-value {min(t.p_value for t in tests):.2g}"
    return judged(len(rejected), 0, reason)


def rendered(mi, parts: dict, effort: Effort) -> np.ndarray:
    """Return the image of a scene with one sensor; all paths end by leaving the scene."""
    parts = {**parts, "sensor": examples.sensor(mi, size=effort.side)}
    scene = mi.load_dict({k: v for k, v in parts.items() if k != "lamp"}, parallel=False)
    return np.array(mi.render(scene, spp=effort.spp, seed=mi.UInt32(0)), np.float64)


def furnace(mi, name: str, effort: Effort) -> Cell:
    """Render in an even light of radiance 1: materials gain nothing, and shapes and integrators lose nothing."""
    types = ("bsdf", "shape", "integrator")
    if cell := kept_away(mi, name, types, "a texture is no scene; its materials are measured"):
        return cell
    if mi.is_spectral:
        return Cell(NOT_RUN, reason="a film of random wavelengths does not show an even light as 1")
    object_type = plugins.declared()[name].object_type
    sky = {"type": "constant", "radiance": 1.0}
    parts = {**examples.scene_parts(mi, name), "sky": sky}
    paths = {"max_depth": 64, "rr_depth": 1000}
    if object_type == "bsdf":
        parts["integrator"] |= paths
        brightest = (-math.inf, 0.0)
        for more in BRIGHT.get(name, [{}]):
            image = rendered(mi, {**parts, "shape": {**parts["shape"], "bsdf": examples.example(name, **more)}}, effort)
            middle = image[effort.side // 4 : -effort.side // 4, effort.side // 4 : -effort.side // 4].reshape(-1)
            brightest = max(brightest, (middle.mean(), middle.std() / math.sqrt(middle.size)))
        return judged(brightest[0], round(1.001 + 4 * brightest[1], 4), "mean radiance of a bright ball")
    parts["integrator"] |= paths
    bsdfs = {"diffuse": {"type": "diffuse", "reflectance": 1.0}, "mirror": {"type": "conductor", "material": "none"},
             "glass": {"type": "dielectric"}}  # fmt: skip
    if parts["shape"]["type"] != "neural_sdf":
        what = "a white ball"
        if name == "neural_field":
            what = "fog around a white ball"
            fog = radiance_fields.Fog(compat.backend_module(mi.Float), 0.8, (1.0, 1.0, 1.0))
            radiance_fields.register(mi, {"white": fog}, "furnace_field")
            parts["integrator"] = {"type": "furnace_field", "field": "white", **paths}
        values = rendered(mi, {**parts, "shape": {**parts["shape"], "bsdf": bsdfs["diffuse"]}}, effort).mean(axis=-1)
        limit = round(1e-3 + 4 * values.std() / math.sqrt(values.size), 5)
        return judged(abs(values.mean() - 1), limit, f"difference of the mean radiance from 1, {what}")
    # Another surface as reference: the mesh that the field was fitted to
    mesh = {"type": "ply", "filename": str(examples.ASSETS / "knot.ply")}
    off, texts = [], []
    for word, bsdf in bsdfs.items():
        images = [rendered(mi, {**parts, "shape": {**shape, "bsdf": bsdf}}, effort)
                  for shape in (parts["shape"], mesh)]  # fmt: skip
        counts = [int((np.abs(image - 1).max(axis=-1) > 0.01).sum()) for image in images]
        off.append(counts[0] - counts[1])
        texts.append(f"{word} {counts[0]} (mesh {counts[1]})")
    reason = f"pixels of {effort.side**2} that differ from 1 by over 1%: {', '.join(texts)}"
    return judged(max(off), 0, f"{reason}; the figure is the largest excess over the mesh")


def through(result) -> None:
    """Propagate derivatives back to the parameters, unless the result depends on none of them."""
    if dr.grad_enabled(result):
        dr.backward(result)


def compared(loss, params, keys, rng, back=through, spectral=False) -> tuple[float, list[str]]:
    """Return the largest relative difference of derivatives from central differences, and what was compared.

    ``loss()`` returns an array that depends on the parameters ``keys``, ``back(mean)`` propagates derivatives to
    them. A tensor changes along a random direction of positive numbers, so that its derivative is far above rounding.
    """
    worst, names = 0.0, []
    for key in keys:
        value = params[key]
        before = start = np.float64(value.numpy()).ravel()
        if dr.is_tensor_v(value) and start.min() >= 0 and start.max() <= 1:
            # Entries at the ends of their range, or that name a node of another array, are kinks
            start = 0.9 * start + 0.0371
        along = rng.uniform(0.5, 1.5, start.size)
        if dr.depth_v(value) > 1 and spectral:
            along = np.array([0.0, 0.0, 1.0])  # of a colour's polynomial of wavelengths, the constant

        def at(offset, key=key, value=value, start=start, along=along, grad=False):
            params[key] = shaped(value, start + offset * along)
            if grad:
                dr.enable_grad(params[key])
            params.update()
            return loss()

        result = at(0.0, grad=True)
        back(dr.mean(result))
        derivative = float(np.dot(np.float64(dr.grad(params[key]).numpy()).ravel(), along))
        errors, size = [], max(float(np.abs(start).mean()), 1e-2)
        for step in (4e-3 * size, 1e-3 * size, 2.5e-4 * size):
            # In double precision: what is left is the rounding of single precision in each lane
            ahead, behind = (np.mean(at(offset).numpy(), dtype=np.float64) for offset in (step, -step))
            difference, noise = (ahead - behind) / (2 * step), 2e-7 * abs(ahead) / step
            if abs(difference) > 200 * noise:
                errors.append(abs(derivative - difference) / abs(difference))
        params[key] = shaped(value, before)
        params.update()
        if errors:  # a longer step has less rounding, a shorter one less curvature
            worst = max(worst, min(errors))
            names.append(key)
    return worst, names


def shaped(value, numbers: np.ndarray):
    """Return an array of the type and shape of ``value``."""
    if dr.is_tensor_v(value):
        return type(value)(aligned(numbers.reshape(value.shape)))
    return type(value)(*map(float, numbers)) if dr.depth_v(value) > 1 else type(value)(aligned(numbers))


def gradients(mi, name: str, effort: Effort, storage: str = "") -> Cell:
    """Derivatives in reverse mode against central differences in single precision, with the default storage form."""
    if cell := kept_away(mi, name, tuple(plugins.OBJECT_TYPES), ""):
        return cell
    rng, object_type = np.random.default_rng(3), plugins.declared()[name].object_type
    if object_type == "texture":
        return texture_gradients(mi, name, effort, storage)
    back = through
    if object_type == "bsdf":
        subject, ctx = mi.load_dict(examples.example(name, storage)), mi.BSDFContext()
        params = mi.traverse(subject)
        keys = [key for key in params.keys() if dr.is_diff_v(params[key]) and "sampling_rate" not in key]
        # A map of normals turns directions below its horizon, where the value jumps
        least = 0.7 if name == "neural_material" else 0.2
        wi, wo = (directions(mi, rng, effort.lanes, least) for _ in range(2))
        uv = mi.Point2f(*[mi.Float(aligned(rng.random(effort.lanes))) for _ in range(2)])

        def loss():
            return dr.sum(mi.unpolarized_spectrum(subject.eval(ctx, hits(mi, wi, uv), wo)))

    else:
        scene = examples.load(mi, name, storage)
        params, keys = examples.exposed(mi, scene, name)
        if object_type == "integrator" and name != "neural_field":
            params = mi.traverse(scene)
            keys = [key for key in params.keys() if key.endswith("reflectance.value")]
        # Outlines move with the place and the arrays of a solid; this part of the derivative is missing by design
        keys = [key for key in keys if "to_world" not in key and not key.endswith(("tables.nodes", "shape.grid"))]
        keys = [key for key in keys if dr.is_diff_v(params[key])]

        def loss():
            return dr.detach(mi.render(scene, spp=4, seed=1)).array

        def back(_):
            # The random numbers of the render itself: no noise in the difference
            shape = mi.render(scene, spp=4, seed=1).shape
            weights = dr.full(mi.TensorXf, 1 / math.prod(shape), shape)
            scene.integrator().render_backward(scene, params, weights, spp=4, seed=1)

    bytes_only = plugins.declared()[name].task and not any("tables." in key for key in keys)
    reason = "tables: none by design, they are constant bytes; " * bool(bytes_only and not storage)
    if not keys:
        return Cell(NOT_APPLICABLE, reason=reason + "no other differentiable parameter but the place")
    worst, names = compared(loss, params, keys, rng, back, mi.is_spectral)
    if not names:
        return Cell(NOT_RUN, reason="no parameter changes the result by more than rounding does")
    return judged(worst, 0.02, f"{reason}largest relative error of {len(names)} parameters: {', '.join(names)}")


def texture_gradients(mi, name: str, effort: Effort, storage: str) -> Cell:
    """Return the cell of the derivative by the coordinate, of a texture whose tables are bytes, and by its tables."""
    rng = np.random.default_rng(3)
    subject = mi.load_dict(examples.example(name, storage))
    start = [aligned(rng.random(effort.lanes)) for _ in range(2)]
    (u, v), wi = map(mi.Float, start), directions(mi, rng, effort.lanes)

    def brightness(u):
        return dr.sum(subject.eval(hits(mi, wi, mi.Point2f(u, v))))

    if storage or name == "mipmap":
        params = mi.traverse(subject)
        keys = [key for key in params.keys() if dr.is_diff_v(params[key])]
        worst, names = compared(lambda: brightness(u), params, keys, rng, spectral=mi.is_spectral)
        return judged(worst, 0.02, f"largest relative error of {len(names)} parameters: {', '.join(names)}")
    dr.enable_grad(u)
    dr.backward(brightness(u))
    derivative, step = dr.grad(u).numpy(), 2e-4
    ahead, behind = (brightness(mi.Float(aligned(start[0] + s))).numpy() for s in (step, -step))
    difference = (ahead.astype(np.float64) - behind) / (2 * step)
    figure = np.median(np.abs(derivative - difference)) / np.abs(difference).mean()
    return judged(figure, 0.02, "tables: none by design, they are constant bytes; coordinate: median error over mean")


def gradients_float32(mi, name: str, effort: Effort) -> Cell:
    """Derivatives with the storage form float32, whose tables can be optimised."""
    if not plugins.declared()[name].task:
        return Cell(NOT_APPLICABLE, reason="reads no table")
    if plugins.declared()[name].object_type == "shape" and "polarized" in mi.variant():
        return Cell(NOT_APPLICABLE, reason="a polarised variant renders a grid that was decoded from the tables")
    return gradients(mi, name, effort, "float32")


#: Name of a property → function of ``mitsuba``, the name of a plugin, and the effort.
PROPERTIES = {f.__name__: f for f in (energy, reciprocity, chi2, furnace, gradients, gradients_float32)}
