"""Rays through radiance fields: against formulas, NumPy and finite differences, and where it is hard."""

from types import SimpleNamespace

import drjit as dr
import numpy as np
import pytest
from radiance_fields import Bumps, Fog, haze

from mi_diffind.core import compat
from mi_diffind.tasks.radiance import march as marching


def types_of(mi):
    return compat.backend_module(mi.Float)


def rays(mi, o, d):
    """Origins and unit directions of arrays ``(n, 3)``."""
    d = np.asarray(d, np.float64)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    made = [np.ascontiguousarray(np.asarray(v, np.float32).T) for v in (o, d)]
    return mi.Point3f(made[0]), mi.Vector3f(made[1])


def around(rng, n, distance=3.0, aim=0.5):
    """Rays from a sphere towards somewhere near the centre."""
    o = rng.normal(size=(n, 3))
    o *= distance / np.linalg.norm(o, axis=1, keepdims=True)
    return o, rng.uniform(-aim, aim, (n, 3)) - o


def numbers(found):
    return np.array(found.colour).T, found.transmittance.numpy(), found.depth.numpy()


def chord(o, d, half=1.0, far=np.inf):
    """Distances at which rays enter and leave the box from −``half`` to ``half``, in NumPy."""
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    with np.errstate(divide="ignore"):
        a, b = (-half - o) / d, (half - o) / d
    near = np.maximum(np.minimum(a, b).max(1), 0)
    return near, np.maximum(np.minimum(np.maximum(a, b).min(1), far), near)


@pytest.mark.parametrize("density", [0.0, 1e-3, 1.0, 3.0, 6.0, 1e3, 1e30])
@pytest.mark.parametrize("offset", [0.5, 0.1])
def test_a_constant_medium_is_beer_lambert(mi_rgb, rng, density, offset):
    mi = mi_rgb
    field = Fog(types_of(mi), density)
    o, d = around(rng, 500)
    near, far = chord(o, d, far=3.2)
    found = marching.march(field, *rays(mi, o, d), 0, 3.2, True, offset)
    colour, transmittance, depth = numbers(found)
    expected = np.exp(-density * (far - near))
    assert np.abs(transmittance - expected).max() < 1e-4
    assert np.abs(colour - (1 - expected)[:, None] * [0.2, 0.5, 0.8]).max() < 1e-4
    if 0 < density < 10 and offset == 0.5:
        along = near + 1 / density - (far - near) * expected / np.maximum(1 - expected, 1e-9)
        assert np.abs(depth - (1 - expected) * along).max() < 0.01
    if density == 1e30:
        assert np.abs(depth - near).max() < field.step


def test_against_numpy(mi_rgb, rng):
    """The sum over steps of a field that varies, and the same with all that is empty looked at."""
    mi = mi_rgb
    types = types_of(mi)
    o, d = around(rng, 40)
    near, far = chord(o, d)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    known, blind = Bumps(types, empty=True), Bumps(types, empty=True, blind=True)
    found, slow = (numbers(marching.march(f, *rays(mi, o, d), 0, np.inf)) for f in (known, blind))
    for a, b in zip(found, slow, strict=True):
        assert np.allclose(a, b, atol=2e-6)
    heights, hues = (known.arrays[name].numpy() for name in ("density", "colour"))
    for i in range(len(o)):
        begins = np.arange(near[i], far[i], known.step)
        ends = np.minimum(begins + known.step, far[i])
        at = (begins + ends) / 2
        p = o[i] + at[:, None] * d[i]
        shapes = np.exp(-8 * ((p[:, None] - known.CENTRES) ** 2).sum(-1))
        passed = np.exp(-np.cumsum(np.where(p[:, 0] < 0, shapes @ heights, 0) * (ends - begins)))
        weights = -np.diff(passed, prepend=1)
        hue = shapes @ hues
        colour = hue[:, :3] * (1 + 0.5 * hue[:, 3:] * d[i])
        assert np.allclose(found[0][i], weights @ colour, atol=3e-4)
        assert found[1][i] == pytest.approx(passed[-1], abs=marching.OPAQUE)
        assert found[2][i] == pytest.approx(weights @ at, abs=5e-3)


def test_nothing_is_read_that_does_not_count(mi_rgb):
    """Steps that a field says to be empty are not looked at, and rays that are opaque end."""
    mi = mi_rgb
    types = types_of(mi)
    across = [[-3, 0.01 * i, 0.02] for i in range(20)], [[1, 0, 0]] * 20

    def counted(o, d, **more):
        return SimpleNamespace(**marching.count(Bumps(types, **more), *rays(mi, o, d), 0, np.inf))

    whole = counted(*across, empty=True, blind=True, height=0.1)
    assert (whole.rays, whole.crossing, whole.opaque, whole.hidden, whole.skipped) == (20, 20, 0, 0, 0)
    # The last step of 80 may leave a sliver, of rounding
    assert whole.steps == 20 * 80 and 0 <= whole.looks - whole.steps <= 20 and whole.colours <= 0.52 * whole.steps
    known = counted(*across, empty=True, height=0.1)
    assert known.steps == whole.steps and known.skipped == pytest.approx(20 * 40, abs=40)
    assert known.looks + known.skipped == whole.looks and known.colours == whole.colours
    thick = counted(*across, height=1e4)
    assert thick.opaque == 20 and thick.looks < 0.5 * thick.steps and thick.looks + thick.hidden == thick.steps
    missing = counted([[-3, 2, 0], [5, 0, 0], [0, 0, np.nan]], [[1, 0, 0]] * 3)
    assert missing.rays == 3 and sum(vars(missing).values()) == 3


def test_hard_rays(mi_rgb):
    """Cameras within, rays along axes and faces, past the box, behind it, from afar, or not a number."""
    mi = mi_rgb
    nan, inf, e = np.nan, np.inf, np.exp
    cases = [
        ((0, 0, 0), (1, 0, 0), inf, e(-1)),  # from within
        ((0.5, 0.2, 0), (-1, 0, 0), inf, e(-1.5)),
        ((0.3, 0.3, -4), (0, 0, 1), inf, e(-2)),  # two components are zero, of either sign
        ((0.3, 0.3, 4), (-0.0, 0, -1), inf, e(-2)),
        ((1, 0, -3), (0, 0, 1), inf, e(-2)),  # in a face
        ((1.001, 0, -3), (0, 0, 1), inf, 1),  # past it
        ((3, 0, 0), (1, 0, 0), inf, 1),  # behind
        ((-3, 0, 0), (1, 0, 0), 2.5, e(-0.5)),  # a surface within
        ((-3, 0, 0), (1, 0, 0), 2.0, 1),  # and before
        ((-3, 0, 0), (1, 0, 0), 0.0, 1),
        ((-3, -1, 0), (1, 1, 0), inf, 1),  # touching an edge
        ((-1e4, 0, 0), (1, 0, 0), inf, e(-2)),
        ((-1e6, 0.1, 0.2), (1, 0, 0), inf, e(-2)),  # a step is less than the last digit of the distance
        ((nan, 0, 0), (1, 0, 0), inf, 1),
        ((-3, 0, 0), (nan, 0, 0), inf, 1),
        ((-3, 0, 0), (1, 0, 0), nan, 1),
        ((inf, 0, 0), (-1, 0, 0), inf, 1),
        ((0, 0, 0), (0, 0, 0), inf, 1),
    ]
    o, d, far, expected = (np.array([case[i] for case in cases], np.float32) for i in range(4))
    field = Fog(types_of(mi), 1.0)
    points = mi.Point3f(np.ascontiguousarray(o.T)), mi.Vector3f(np.ascontiguousarray(d.T))
    found = numbers(marching.march(field, *points, 0, mi.Float(far)))
    assert np.isfinite(np.concatenate([v.ravel() for v in found])).all()
    scale = np.abs(o).max(1, initial=1, where=np.isfinite(o))
    wrong = np.flatnonzero(~(np.abs(found[1] - expected) < 1e-4 + 1e-7 * scale))
    assert not len(wrong), (wrong, found[1][wrong], expected[wrong])
    assert np.allclose(found[0], (1 - found[1])[:, None] * [0.2, 0.5, 0.8], atol=1e-5)
    nothing = marching.march(field, *points, 0, mi.Float(far), mi.Bool(False))
    assert (nothing.transmittance.numpy() == 1).all() and (nothing.depth.numpy() == 0).all()


def attached(field, direction, step):
    """The field with its arrays moved along ``direction``."""
    return field.with_arrays(
        {name: type(v)(np.float32(v.numpy() + step * direction[name])) for name, v in field.arrays.items()}
    )


@pytest.mark.parametrize("kind", ["fog", "bumps", "opaque", "surroundings"])
def test_derivatives(mi_rgb, rng, kind):
    """Replay, tangent and the differentiable operation, against finite differences and one another."""
    mi = mi_rgb
    types = types_of(mi)
    field = {
        "fog": lambda: Fog(types, 0.7), "bumps": lambda: Bumps(types, 3.0),
        "opaque": lambda: Bumps(types, 40.0, empty=True), "surroundings": lambda: haze(types, rng),
    }[kind]()  # fmt: skip
    o, d = around(rng, 300)
    at = (*rays(mi, o, d), mi.Float(0), mi.Float(np.inf), mi.Bool(True), mi.Float(np.float32(rng.random(300))))
    direction = {name: rng.normal(size=values.shape) for name, values in field.arrays.items()}
    weights = [rng.normal(size=300).astype(np.float32) for _ in range(5)]

    def loss(step, only):
        moved = attached(field, {n: v if n == only else 0 * v for n, v in direction.items()}, step)
        colour, transmittance, depth = numbers(marching.march(moved, *at))
        return np.float64([*colour.T, transmittance, depth])

    found = marching.march(field, *at)
    adjoint = [mi.Array3f(*map(mi.Float, weights[:3])), mi.Float(weights[3]), mi.Float(weights[4])]
    fresh = attached(field, direction, 0)
    dr.enable_grad(fresh.arrays)
    marching.replay(fresh, *at, found, *adjoint)
    gradients = {name: dr.grad(values).numpy() for name, values in fresh.arrays.items()}
    for name in field.arrays:
        fresh = attached(field, direction, 0)
        dr.enable_grad(fresh.arrays[name])
        dr.set_grad(fresh.arrays[name], type(fresh.arrays[name])(np.float32(direction[name])))
        others = [other for other in field.arrays if other != name]
        dr.enable_grad([fresh.arrays[other] for other in others])
        colour, transmittance, depth = marching.tangent(fresh, *at, found)
        tangent = np.array([*np.array(colour), transmittance.numpy(), depth.numpy()])
        step = 1e-2
        differences = (loss(step, name) - loss(-step, name)) / (2 * step)
        for a, b in zip(tangent, differences, strict=True):
            # A few rays end a step sooner or later, or read a radiance more, within the difference
            error = np.sort((a - b) ** 2)[:285]
            assert np.sqrt(error.mean()) < 0.01 * np.sqrt((b**2).mean()) + 1e-5
        back = float((gradients[name] * direction[name]).sum())
        assert back == pytest.approx(float((tangent * np.array(weights)).sum()), rel=1e-3, abs=1e-3)

    arrays = {name: type(v)(v) for name, v in field.arrays.items()}
    dr.enable_grad(arrays)
    made = marching.differentiable(field.with_arrays(arrays), *at)
    total = dr.dot(made.colour, adjoint[0]) + made.transmittance * adjoint[1] + made.depth * adjoint[2]
    dr.backward(dr.sum(total))
    for name, values in arrays.items():
        assert np.allclose(dr.grad(values).numpy(), gradients[name], rtol=1e-3, atol=1e-3)
