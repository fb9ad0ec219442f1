"""The integrator that shows a radiance field among surfaces: against formulas, ``volpath`` and finite differences."""

import drjit as dr
import numpy as np
import pytest
import sdf_fields
from radiance_fields import Bumps, Fog, ball_table, register
from scipy.ndimage import gaussian_filter
from texture_scenes import refused
from variants import set_variant

from mi_diffind import plugins
from mi_diffind.arrays.tables import save_table
from mi_diffind.core import compat
from mi_diffind.scenes import loading
from mi_diffind.tasks.radiance import TASK, files, volume_field

#: Density and radiance of the fog.
DENSITY, HUE = 0.8, np.array([0.2, 0.5, 0.8])

AXIS = [0.36, 0.48, 0.8]


@pytest.fixture
def fields(mi):
    return registered(mi)


def registered(mi):
    types = compat.backend_module(mi.Float)
    found = {"fog": Fog(types, DENSITY, HUE), "bumps": Bumps(types), "black": Fog(types, DENSITY, (0, 0, 0))}
    register(mi, found)
    return found


def lamp(mi, place, radiance, **more):
    """A square that shines towards −y, at ``place``."""
    at = mi.ScalarTransform4f().translate(place).rotate([1, 0, 0], 90).scale(0.7)
    value = {"type": "rgb", "value": radiance}
    return {"type": "rectangle", "to_world": at, "emitter": {"type": "area", "radiance": value}, **more}


def mirror(mi, bsdf, place=(1.2, 1.2, 0), angle=-25):
    at = mi.ScalarTransform4f().translate(place).rotate([0, 0, 1], angle).rotate([1, 0, 0], 90).scale(0.6)
    return {"type": "rectangle", "to_world": at, "bsdf": bsdf}


def surfaces(mi):
    """A lamp in front of the box, within it, and behind it."""
    return {
        "front": lamp(mi, [-0.9, -1.6, 0.7], [0.9, 0.1, 0.3]),
        "within": {"type": "sphere", "radius": 0.5, "emitter": {"type": "area", "radiance": 1.5}},
        "behind": lamp(mi, [0.8, 2.0, -0.6], [0.1, 0.9, 0.3]),
    }


def scene(mi, field="fog", size=(36, 24), **more):
    """A field, seen from −y, one sample in the middle of each pixel."""
    film = {"type": "hdrfilm", "width": size[0], "height": size[1], "pixel_format": "rgba", "rfilter": {"type": "box"}}
    at = mi.ScalarTransform4f().look_at([0.1, -5, 0.4], [0, 0, 0], [0, 0, 1])
    integrator = {"type": "test_field", "id": "it", "field": field, **more.pop("integrator", {})}
    if not any(isinstance(v, dict) for v in integrator.values()):
        integrator["jitter"] = False
    sensor = {"type": "perspective", "fov": 45, "to_world": at, "film": film}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **more})


def render(mi, made, spp=1, seed=0, **more):
    return np.array(mi.render(made, spp=spp, seed=seed, **more))


def pixel_rays(mi, made):
    """The rays through the middles of pixels, row by row."""
    width, height = (int(n) for n in made.sensors()[0].film().size())
    y, x = np.divmod(np.arange(width * height), width)
    place = mi.Point2f(mi.Float(np.float32((x + 0.5) / width)), mi.Float(np.float32((y + 0.5) / height)))
    ray, _ = made.sensors()[0].sample_ray_differential(0, 0, place, mi.Point2f(0.5))
    return mi.Ray3f(ray)


def inside(ray, far, to_world=None):
    """Return where rays enter the box from −1 to 1, and their length in it up to ``far``, by NumPy."""
    o, d = np.array(ray.o, np.float64), np.array(ray.d, np.float64)
    if to_world is not None:
        inverse = np.linalg.inv(to_world)
        o, d = inverse[:3, :3] @ o + inverse[:3, 3:], inverse[:3, :3] @ d
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-1 - o) / d, (1 - o) / d
    near = np.maximum(np.minimum(a, b).max(0), 0)
    return near, np.maximum(np.minimum(np.maximum(a, b).min(0), far) - near, 0)


def seen(made, ray, throughput=1.0):
    """Return light ``(n, 3)``, alpha, depth and opacity of the fog and the next surface along rays, by the formula."""
    si = made.ray_intersect(ray)
    hit = np.array(si.is_valid())
    near, length = inside(ray, np.where(hit, np.array(si.t), np.inf))
    through = np.exp(-DENSITY * length)
    behind = np.array(si.emitter(made).eval(si)).T * hit[:, None]
    light = (1 - through)[:, None] * HUE + through[:, None] * behind
    depth = near * (1 - through) + (1 - through * (1 + DENSITY * length)) / DENSITY
    depth = depth + np.where(hit, through * np.array(si.t), 0)
    return throughput * light, np.where(hit, 1, 1 - through), depth, 1 - through


def test_surfaces_within_before_and_behind(mi, fields):
    """Light, alpha and further channels are composited as by the formula."""
    made = scene(mi, integrator={"aovs": "depth, opacity"}, **surfaces(mi))
    assert made.integrator().aov_names() == ["depth", "opacity"]
    image = render(mi, made).reshape(-1, 6)
    light, alpha, depth, opacity = seen(made, pixel_rays(mi, made))
    assert len(np.unique(np.round(alpha, 2))) > 10 and (alpha == 1).sum() > 100
    assert np.abs(image[:, :3] - light).max() < 1e-4
    assert np.abs(image[:, 3] - alpha).max() < 1e-4
    assert np.abs(image[:, 4] - depth).max() < 2e-3
    assert np.abs(image[:, 5] - opacity).max() < 1e-4


@pytest.mark.parametrize("turn", ["turned", "mirrored"])
def test_to_world(mi, fields, turn):
    """A field that is moved, turned, made larger, or reflected: densities are per length of its own frame."""
    at = mi.ScalarTransform4f
    found = {
        "turned": at().translate([0.3, 1.0, -0.2]).rotate(AXIS, 40).scale(1.3),
        "mirrored": at().translate([-0.4, 0.5, 0.1]).rotate([0, 0, 1], 30) @ at().scale([-0.6, 0.6, 0.6]),
    }[turn]
    made = scene(mi, "fog", integrator={"to_world": found, "aovs": "depth"})
    image = render(mi, made).reshape(-1, 5)
    matrix = np.array(found.matrix, np.float64)
    size = np.abs(np.linalg.det(matrix[:3, :3])) ** (1 / 3)
    near, length = inside(pixel_rays(mi, made), np.inf, matrix)
    k = DENSITY / size
    through = np.exp(-k * length)
    assert np.abs(image[:, :3] - (1 - through)[:, None] * HUE).max() < 1e-4
    assert np.abs(image[:, 3] - (1 - through)).max() < 1e-4
    assert np.abs(image[:, 4] - near * (1 - through) - (1 - through * (1 + k * length)) / k).max() < 3e-3
    if turn == "mirrored":  # which cameras cannot be
        return
    # What depends on the direction turns, too
    turned = at().rotate(AXIS, 70)
    moved, straight = scene(mi, "bumps", integrator={"to_world": turned}), scene(mi, "bumps")
    params = mi.traverse(moved)
    camera = np.array(mi.traverse(straight)["sensor.to_world"].matrix)[..., 0]
    params["sensor.to_world"] = mi.AffineTransform4f(turned @ at(camera))
    params.update()
    assert np.abs(render(mi, moved) - render(mi, straight)).max() < 1e-3


def mirrored(mi, si):
    """Whether rays meet a mirror."""
    return np.array(si.is_valid()) & np.array(si.shape.bsdf().flags() & int(mi.BSDFFlags.DeltaReflection) != 0)


def test_field_in_a_mirror(mi, fields):
    """The mirror's image of the field and of what lies within, by the formula along the reflected rays."""
    glass = mirror(mi, {"type": "conductor", "specular_reflectance": 0.8})
    made = scene(mi, glass=glass, **surfaces(mi))
    ray = pixel_rays(mi, made)
    light, alpha, _, _ = seen(made, ray)
    si = made.ray_intersect(ray)
    met = mirrored(mi, si)
    on = si.spawn_ray(si.to_world(mi.reflect(si.wi)))
    again, _, _, opacity = seen(made, on)
    first = seen(made, ray)[3][:, None]
    light = np.where(met[:, None], first * HUE + (1 - first) * 0.8 * again, light)
    image = render(mi, made).reshape(-1, 4)
    assert met.sum() > 50 and opacity[met].max() > 0.5
    assert np.abs(image[:, :3] - light).max() < 1e-4
    assert np.abs(image[:, 3] - np.where(met, 1, alpha)).max() < 1e-4
    short = render(mi, scene(mi, integrator={"smooth_depth": 0}, glass=glass, **surfaces(mi))).reshape(-1, 4)
    differs = np.abs(short - image).max(1) > 1e-3
    assert differs[met].mean() > 0.5 and not differs[~met].any()


def test_mirrors_of_a_group(mi, fields):
    group = {"type": "shapegroup", "id": "group", "glass": mirror(mi, {"type": "conductor"})}
    one = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    expected = render(mi, scene(mi, glass=group["glass"]))
    assert np.abs(render(mi, scene(mi, group=group, one=one)) - expected).max() < 1e-5


@pytest.mark.parametrize("bsdf", ["null", "dielectric"])
def test_panes_that_do_nothing(mi, fields, bsdf):
    more = {"int_ior": 1.0, "ext_ior": 1.0} if bsdf == "dielectric" else {}
    pane = mirror(mi, {"type": bsdf, **more}, place=(0, -2, 0), angle=10)
    found = render(mi, scene(mi, pane=pane, **surfaces(mi)))
    expected = render(mi, scene(mi, **surfaces(mi)))
    # Rays go on from beside the surface, 3e-4 along its normal
    assert np.abs(found[..., :3] - expected[..., :3]).max() < 5e-4
    changed = np.abs(found[..., 3] - expected[..., 3]) > 1e-3
    # Glass is something, whatever is behind it
    assert changed.any() == (bsdf == "dielectric") and (found[..., 3][changed] == 1).all()


def test_through_glass_as_volpath(mi, fields):
    """A field that only absorbs is Mitsuba's absorbing medium, in front of and behind a ball of glass."""
    at = mi.ScalarTransform4f
    ball = {"type": "sphere", "center": [0.5, -2.2, 0.2], "radius": 0.5, "bsdf": {"type": "dielectric"}}
    glass = mirror(mi, {"type": "conductor"}, place=(-1.3, 1.3, 0), angle=35)
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.4, 0.7, 1.0]}}
    things = {"ball": ball, "glass": glass, "sky": sky, "behind": lamp(mi, [0.4, 1.6, 0], [2.0, 1.0, 0.5])}
    made = scene(mi, "black", integrator={"smooth_depth": 16, "c": {"type": "path", "max_depth": 16}}, **things)
    medium = {"type": "homogeneous", "albedo": 0.0, "sigma_t": DENSITY}
    box = {"type": "cube", "to_world": at(), "bsdf": {"type": "null"}, "interior": medium}
    other = scene(mi, "black", box=box, **things)
    volpath = mi.load_dict({"type": "volpath", "max_depth": 40, "rr_depth": 100})
    found = np.stack([render(mi, made, 64, seed)[..., :3] for seed in range(6)])
    expected = np.stack([render(mi, other, 64, seed + 50, integrator=volpath)[..., :3] for seed in range(6)])
    a, b = (v.reshape(6, 6, 4, 9, 4, 3).mean((2, 4)) for v in (found, expected))
    error = np.sqrt((a.var(0, ddof=1) + b.var(0, ddof=1)) / 6)
    z = (a.mean(0) - b.mean(0)) / np.maximum(error, 2e-3)
    assert np.abs(z).max() < 6 and abs(a.mean() / b.mean() - 1) < 5e-3


def test_hidden_emitters(mi, fields):
    """Emitters are hidden from the camera, in light and alpha, and visible in mirrors."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.4, 0.7, 1.0]}}
    glass = mirror(mi, {"type": "conductor", "material": "none"})
    more = {"glass": glass, "sky": sky, **surfaces(mi)}
    hidden, shown = (scene(mi, integrator={"hide_emitters": hide}, **more) for hide in (True, False))
    image, other = (render(mi, made).reshape(-1, 4) for made in (hidden, shown))
    alone, _, _, opacity = seen(scene(mi), pixel_rays(mi, hidden))
    si = hidden.ray_intersect(pixel_rays(mi, hidden))
    met = mirrored(mi, si)
    assert np.abs(image[met] - other[met]).max() < 1e-4 and met.sum() > 50
    # Behind the lamp in front there may be the mirror
    rest = ~met & (np.abs(image[:, 3] - 1) > 1e-6)
    assert rest.sum() > 400 and np.abs(image[rest, :3] - alone[rest]).max() < 1e-4
    assert np.abs(image[rest, 3] - opacity[rest]).max() < 1e-4


def beside(mi, place, angle=0.0, **more):
    """Bumps, half as large, and what is nested in them."""
    to_world = mi.ScalarTransform4f().translate(place).rotate([0, 0, 1], angle).scale(0.45)
    return {"type": "test_field", "field": "bumps", "to_world": to_world, **more}


def test_several_fields(mi, fields):
    """One after the other, whichever is in front, as seen one at a time."""
    inner = {"type": "path_footprint", "jitter": False}
    alone = {"aovs": "depth,opacity", "c": inner}
    front, back = beside(mi, [0.3, -1.7, 0.5], 20), beside(mi, [-0.9, 2.0, -0.6], 50, c=inner)
    fog = {"type": "test_field", "field": "fog", "c": back}
    things = surfaces(mi)
    found = scene(mi, "bumps", integrator={"to_world": front["to_world"], "aovs": "depth,opacity", "c": fog}, **things)
    image = render(mi, found)
    front, back = (scene(mi, "bumps", integrator={**alone, "to_world": f["to_world"]}) for f in (front, back))
    front, back = (render(mi, made) for made in (front, back))
    middle = render(mi, scene(mi, "fog", integrator=alone, **things))
    # The last field is seen where no surface is
    nowhere, before = hits_of(mi, found)
    back = np.where(nowhere[..., None], back, 0)
    through = (1 - front[..., 5:]) * (1 - middle[..., 5:])
    assert (back[..., 5] > 0.05).sum() > 5 and front[..., 5].max() > 0.3 and before.sum() < 400
    expected = front[..., :3] + (1 - front[..., 5:]) * middle[..., :3] + through * back[..., :3]
    assert np.abs(image[..., :3] - expected)[~before].max() < 1e-4
    opacity = 1 - through[..., 0] * (1 - back[..., 5])
    assert np.abs(image[..., 5] - opacity)[~before].max() < 1e-4
    depth = front[..., 4] + (1 - front[..., 5]) * middle[..., 4] + through[..., 0] * back[..., 4]
    assert np.abs(image[..., 4] - depth)[~before].max() < 2e-3


def test_fields_that_overlap(mi, fields):
    """Densities and emissions add up: a Riemann sum in NumPy, with surfaces before, within and behind."""
    types = compat.backend_module(mi.Float)
    colours = np.array([[0.2, 0.5, 0.8], [0.9, 0.3, 0.1]])
    register(mi, {"fine": Fog(types, 0.8, colours[0], voxel=0.02), "dense": Fog(types, 1.5, colours[1], voxel=0.05)})
    place = mi.ScalarTransform4f().translate([0.3, 0.7, -0.2]).rotate(AXIS, 30).scale(0.8)
    inner = {"type": "test_field", "field": "dense", "to_world": place, "jitter": False}
    made = scene(mi, "fine", integrator={"aovs": "opacity", "c": inner}, **surfaces(mi))
    assert len(made.integrator().fields) == 2 and len(made.integrator().groups) == 1
    image = render(mi, made).reshape(-1, 5)
    ray = pixel_rays(mi, made)
    si = made.ray_intersect(ray)
    hit = np.array(si.is_valid())
    o, d, far = np.array(ray.o).T, np.array(ray.d).T, np.where(hit, np.array(si.t), np.inf)
    inverse = np.linalg.inv(np.array(place.matrix, np.float64))
    through, light, step = np.ones(len(o)), np.zeros((len(o), 3)), 0.004
    for t in np.arange(3.5, 7.5, step):
        p = o + d * t
        boxes = p, p @ inverse[:3, :3].T + inverse[:3, 3]
        densities = np.stack(
            [(np.abs(q) < 1).all(1) * (t < far) * k for q, k in zip(boxes, (0.8, 1.875), strict=True)], 1
        )
        total = densities.sum(1)
        passed = through * np.exp(-total * step)
        light += ((through - passed) / np.maximum(total, 1e-9))[:, None] * (densities @ colours)
        through = passed
    light += through[:, None] * np.array(si.emitter(made).eval(si)).T * hit[:, None]
    assert np.abs(image[:, :3] - light).max() < 0.02 and np.abs(image[:, :3] - light).mean() < 5e-4
    assert np.abs(image[:, 4] - (1 - through)).max() < 0.02


@pytest.mark.parametrize("distance", [0.6, 2.0])
def test_derivatives_of_two_fields(mi, fields, distance):
    place = mi.ScalarTransform4f().translate([0, distance, 0]).scale(0.8)
    bumps = {"type": "test_field", "field": "bumps", "to_world": place}
    made = scene(
        mi, "fog", size=(16, 12), integrator={"aovs": "opacity" if distance < 1 else "depth,opacity", "c": bumps}
    )
    for ending in ("surfaces.tables.density", "it.tables.colour" if distance < 1 else "it.tables.density"):
        check(mi, made, ending)
    if distance > 1:
        return
    params = mi.traverse(made)
    dr.enable_grad(params["it.to_world"])
    params.update()
    with pytest.raises(RuntimeError) as raised:
        dr.backward(dr.sum(mi.render(made, params, spp=1), axis=None))
    assert "has no derivatives for a field that overlaps" in compat.one_sentence(raised.value)


def hits_of(mi, made):
    """The pixels in which no surface is, and those in which there is one before y = −1, ``(height, width)``."""
    width, height = (int(n) for n in made.sensors()[0].film().size())
    si = made.ray_intersect(pixel_rays(mi, made))
    hit, y = np.array(si.is_valid()), np.array(si.p.y)
    return ~hit.reshape(height, width), (hit & (y < -1)).reshape(height, width)


def test_solids_of_path_sdf(mi, fields):
    sdf_fields.register(mi, {"ball": sdf_fields.Ball(compat.backend_module(mi.Float))})
    ball = {"type": "test_solid", "field": "ball", "to_world": mi.ScalarTransform4f().scale(1.5)}
    integrator = {"aovs": "opacity,depth", "c": {"type": "path_sdf", "jitter": False, "max_depth": 2}}
    image = render(mi, scene(mi, integrator=integrator, ball=ball))
    integrator = {**integrator, "c": {"type": "path_footprint", "jitter": False, "max_depth": 2}}
    expected = render(mi, scene(mi, integrator=integrator, ball={"type": "sphere", "radius": 0.6}))
    # A pixel or two at the outline may see the one and not the other
    assert (np.abs(image - expected).max(-1) < 2e-3).mean() > 0.995


def test_rays_of_the_inner_integrator(mi, fields):
    """Rays that end in the field are not traced further; differentials go with rays, also over mirrors."""
    asked = []

    class Inner(mi.ad.integrators.common.RBIntegrator):
        def sample(self, mode, scene, sampler, ray, active=True, **kwargs):
            asked.extend(np.array(v) for v in (active, ray.o, ray.d_x - ray.d))
            return mi.Spectrum(1), mi.Bool(active), [], None

        def sample_rays(self, scene, sensor, sampler):
            ray, weight, place = super().sample_rays(scene, sensor, sampler)
            ray.has_differentials = True
            return ray, weight, place

    mi.register_integrator("test_inner", Inner)
    register(mi, {"dense": Fog(compat.backend_module(mi.Float), 20.0)}, "test_dense")
    made = scene(mi, glass=mirror(mi, {"type": "conductor"}, place=(1.6, 0.5, 0)))
    integrator = mi.load_dict({"type": "test_dense", "field": "dense", "c": {"type": "test_inner"}})
    render(mi, made, integrator=integrator, seed=1)
    active, o, d_x = asked
    assert 0.3 < active.mean() < 0.9
    turned = np.abs(o - o[:, :1]).max(0) > 1
    assert 20 < turned.sum() < active.sum() / 2
    # A plane mirror turns the differences between the directions of pixels, and keeps their lengths
    length = np.linalg.norm(d_x, axis=0)
    assert np.abs(length[turned] / length[~turned].mean() - 1).max() < 0.2


def test_counts(mi, fields):
    found = scene(mi, **surfaces(mi))
    counts = found.integrator().counts(found)
    ray = pixel_rays(mi, found)
    si = found.ray_intersect(ray)
    _, length = inside(ray, np.where(np.array(si.is_valid()), np.array(si.t), np.inf))
    steps = np.ceil(length / fields["fog"].step)
    assert counts["rays"] == len(length) and counts["crossing"] == (length > 0).sum() < len(length)
    assert counts["steps"] == pytest.approx(steps.sum(), rel=0.01) and counts["looks"] == counts["steps"]


def test_within_aov(mi, fields):
    made = scene(mi, integrator={"aovs": "depth,opacity"}, **surfaces(mi))
    outer = mi.load_dict({
        "type": "aov", "aovs": "dd:depth", "n": {"type": "test_field", "field": "fog", "aovs": "opacity"}
    })  # fmt: skip
    image = render(mi, made, 64, integrator=outer)
    expected = render(mi, made, 64)
    assert image.shape[2] >= 6
    assert np.abs(image[..., :3].mean((0, 1)) - expected[..., :3].mean((0, 1))).max() < 0.01


def test_variants(mi_any):
    """``mono`` shows the luminance, spectra have the colour that was asked for."""
    mi = mi_any
    registered(mi)
    if mi.is_polarized:
        with pytest.raises(RuntimeError, match="neural_field: does not run in polarised variants"):
            scene(mi, "bumps")
        return
    made = scene(mi, "bumps", size=(12, 8), integrator={"aovs": "opacity"})
    image = render(mi, made, 512 if mi.is_spectral else 1)
    mi.set_variant(mi.variant().replace("mono", "rgb").replace("spectral", "rgb"))
    registered(mi)
    expected = render(mi, scene(mi, "bumps", size=(12, 8), integrator={"aovs": "opacity"}))
    assert np.abs(image[..., -1] - expected[..., -1]).max() < 1e-5
    if image.shape[2] < expected.shape[2]:
        luminance = expected[..., :3] @ [0.212671, 0.71516, 0.072169]
        assert np.abs(image[..., 0] - luminance).max() < 1e-4
    else:
        assert np.abs(image[..., 3] - expected[..., 3]).max() < 1e-5
        assert np.abs(image - expected).max() < 0.15 and np.abs((image - expected).mean((0, 1))).max() < 0.01


def lit(mi, field="bumps", **more):
    """A field before a wall, under a point light, and a mirror that shows both."""
    at = mi.ScalarTransform4f().translate([-0.7, 0.3, 0]).rotate([1, 0, 0], 80)
    material = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.3, 0.2]}}
    things = {
        "wall": {"type": "rectangle", "to_world": at, "bsdf": material}, "glass": mirror(mi, {"type": "conductor"}),
        "light": {"type": "point", "position": [0, -5, 3], "intensity": 30.0},
        "sky": {"type": "constant", "radiance": 0.5},
    }  # fmt: skip
    return scene(mi, field, size=(16, 12), **things, **more)


def check_along(mi, made, key, moved, spp, step, tolerance):
    """Forward and backward derivatives along ``moved`` values of a parameter, against differences."""
    params = mi.traverse(made)

    def put(value, gradient=False):
        v = mi.Float(value)
        if gradient:
            dr.enable_grad(v)
        params[key] = moved(v)
        params.update()
        return v

    images = []
    for value in (step, -step):
        put(value)
        images.append(render(mi, made, spp, 8).astype(np.float64))
    differences = (images[0] - images[1]) / (2 * step)
    dr.forward(put(0, True), dr.ADFlag.ClearEdges)
    forward = np.array(made.integrator().render_forward(made, params, spp=spp, seed=8))
    weights = np.random.default_rng(3).normal(size=forward.shape).astype(np.float32)
    v = put(0, True)
    dr.backward(dr.sum(mi.render(made, params, spp=spp, seed=7, seed_grad=8) * mi.TensorXf(weights), axis=None))
    assert dr.grad(v)[0] == pytest.approx(float((weights * forward).sum()), rel=1e-3, abs=1e-3)
    put(0)
    assert forward.shape == differences.shape and np.abs(differences[..., :3]).max() > 1e-3
    for c in range(forward.shape[2]):
        size = np.sqrt((differences[..., c] ** 2).mean())
        assert np.sqrt(((forward - differences)[..., c] ** 2).mean()) < tolerance * size + 1e-6, (key, c)
    return differences


def check(mi, made, ending, spp=4, step=1e-2, tolerance=0.01):
    """Derivatives with respect to a parameter, along a random direction."""
    params = mi.traverse(made)
    key = next(key for key in params.keys() if key.endswith(ending))
    kind, start = type(params[key]), np.array(params[key], np.float32)
    direction = np.random.default_rng(4).normal(size=start.shape).astype(np.float32)

    def moved(v):
        if dr.is_tensor_v(kind):
            return kind(dr.fma(mi.Float(direction.ravel()), v, mi.Float(start.ravel())), start.shape)
        return kind(*(a + v * float(b) for a, b in zip(start.ravel().tolist(), direction.ravel(), strict=True)))

    return check_along(mi, made, key, moved, spp, step, tolerance)


def test_derivatives_of_the_field(mi, fields):
    """Light, alpha and further channels, seen directly, before surfaces, and in a mirror."""
    made = lit(mi, integrator={"aovs": "depth,opacity", "max_depth": 3, "hide_emitters": True})
    found = check(mi, made, "tables.density")
    assert (np.abs(found).max((0, 1)) > 1e-3).all()


def test_derivatives_before_an_integrator_in_cpp(mi, fields):
    """The inner integrator is constant."""
    made = lit(mi, integrator={"aovs": "opacity", "c": {"type": "path", "max_depth": 3, "hide_emitters": True}})
    found = check(mi, made, "tables.colour")
    assert np.abs(found[..., 3:]).max() == 0


def check_place(mi, made, key):
    """Derivatives along a move of a field, turned and scaled as well."""
    one = mi.AffineTransform4f
    start = one(mi.traverse(made)[key])

    def moved(v):
        turn = one().rotate(mi.Vector3f(0.6, 0, 0.8), 60 * v).scale(1 + 0.5 * v)
        return one().translate(v * mi.Vector3f(0.3, 0.7, -0.2)) @ turn @ start

    assert np.sqrt((check_along(mi, made, key, moved, 1, 1e-3, 5e-3) ** 2).mean((0, 1))).min() > 1e-2


def test_derivatives_of_the_place(mi, fields):
    """Fields before surfaces and in a mirror, whose box cuts bumps, and one of two fields."""
    at = mi.ScalarTransform4f
    place = at().translate([0.1, 0.2, -0.1]).rotate([0.8, 0.6, 0], 30).scale(0.9)
    options = {"aovs": "depth,opacity", "hide_emitters": True, "to_world": place}
    made = lit(mi, integrator={**options, "max_depth": 3})
    assert mi.traverse(made).flags("it.to_world") == mi.ParamFlags.Discontinuous
    check_place(mi, made, "it.to_world")
    inner = {"type": "test_field", "field": "bumps", "to_world": at().translate([0, 2.5, 0]).scale(0.8)}
    two = scene(mi, "fog", size=(16, 12), integrator={"aovs": "depth,opacity", "c": inner})
    for key in ("it.surfaces.to_world", "it.to_world"):
        check_place(mi, two, key)


def test_a_moved_field_is_that_of_a_new_scene(mi, fields):
    """Images are equal to the last bit, also if fields come to overlap; a refused transform changes nothing."""
    at = mi.ScalarTransform4f
    turn = at().translate([0.3, 0.2, -0.1]).rotate([0.6, 0, 0.8], 40).scale([-0.7, 0.7, 0.7])
    new, made = (scene(mi, "bumps", size=(16, 12), integrator=more) for more in ({"to_world": turn}, {}))
    expected, before = render(mi, new), render(mi, made)
    params = mi.traverse(made)
    for given, image in ((turn, expected), (at(), before)):
        params["it.to_world"] = given
        params.update()
        np.testing.assert_array_equal(render(mi, made), image)
    assert np.abs(before - expected).max() > 0.1
    params["it.to_world"] = at().scale([1, 2, 1])
    with pytest.raises(RuntimeError, match=r'parameter "to_world": found .* allowed are rotations'):
        params.update()
    fogs = ({"type": "test_field", "field": "fog", "to_world": at().translate([0, y, 0])} for y in (2.5, 1.5))
    apart, close = (scene(mi, "bumps", integrator={"c": fog}) for fog in fogs)
    params = mi.traverse(apart)
    assert len(apart.integrator().groups) == 2
    params["it.surfaces.to_world"] = at().translate([0, 1.5, 0])
    params.update()
    assert len(apart.integrator().groups) == 1
    np.testing.assert_array_equal(render(mi, apart), render(mi, close))


@pytest.mark.parametrize(
    ("ending", "more"),
    [
        ("bsdf.reflectance.value", {}), ("specular_reflectance.value", {}),
        ("sky.radiance.value", {"hide_emitters": True}), ("bsdf.reflectance.value", {"lit": True}),
    ],
)  # fmt: skip
def test_derivatives_of_surfaces(mi, fields, ending, more):
    """Surfaces behind the field and lit by it, mirrors, and lights that rays are followed to."""
    check(mi, lit(mi, integrator={"max_depth": 3, **more}), ending)


def test_derivatives_of_light_and_shadow(mi, fields):
    """Directions towards a field that lights and shadows are constants, as the derivatives take them."""
    made = lit(mi, integrator={"max_depth": 3, "lit": True, "hide_emitters": True})
    made.integrator()._group = made.integrator().field_light.update = lambda: None
    check(mi, made, "tables.density")
    check_place(mi, made, "it.to_world")


def test_derivatives_of_spectra():
    mi = set_variant("llvm_ad_spectral")
    registered(mi)
    made = scene(mi, "bumps", size=(12, 8))
    # The table of spectra has a kink at each of its entries
    check(mi, made, "tables.colour", spp=16, tolerance=0.03)


@pytest.mark.parametrize(
    "more, message",
    [
        ({"aovs": "depth,colour"}, 'parameter "aovs": found "depth,colour", allowed are depth, opacity'),
        ({"aovs": "depth,depth"}, "each once"),
        ({"smooth_depth": 65}, 'parameter "smooth_depth": found 65, allowed'),
        ({"smooth_depth": 1.5}, 'parameter "smooth_depth": found 1.5, allowed'),
        ({"max_depth": 3, "c": {"type": "path"}}, 'parameter "max_depth": belongs to the nested integrator'),
        ({"c": {"type": "path"}, "d": {"type": "path"}}, "found 2 nested integrators"),
        ({"c": {"type": "test_field", "field": "fog", "aovs": "depth"}}, "has AOVs of its own"),
        ({"to_world": [1.0, 1.0, 2.0]}, 'parameter "to_world": found'),
        ({"mistake": 1}, "mistake"),
    ],
)
def test_what_is_refused(mi, fields, more, message):
    if "to_world" in more:
        more = {"to_world": mi.ScalarTransform4f().scale(more["to_world"])}
    assert message in refused(mi, {"type": "test_field", "field": "fog", **more})


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A small field: a ball that is red to the left and blue to the right, in half precision."""
    path = tmp_path_factory.mktemp("field") / "ball.npz"
    save_table(path, ball_table())
    return path


def test_a_file_in_a_scene(mi, file):
    """Images are those of the field in the file; commands know path depths and the nested integrator."""
    tracer = {"type": "neural_field", "filename": str(file), "id": "it"}
    at = mi.ScalarTransform4f().look_at([0, -4, 0], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    sensor = {"type": "perspective", "fov": 40, "to_world": at, "film": film}
    inner = {
        "alone": {},
        "nested": {"inner": {"type": "prb", "max_depth": 3}},
        "two": {"inner": {**tracer, "id": "other", "to_world": mi.ScalarTransform4f().translate([0, 4, 0])}},
    }
    parsed = {name: loading.ParsedScene({"type": "scene", "integrator": {**tracer, **more}, "sensor": sensor})
              for name, more in inner.items()}  # fmt: skip
    found = {name: scene.path_integrator() for name, scene in parsed.items()}
    assert found == {"alone": ("neural_field", -1), "nested": ("prb", 3), "two": ("neural_field", -1)}
    loaded, two = (parsed[name].load(longest_path=2) for name in ("alone", "two"))
    nested = parsed["nested"].load()
    assert loaded.integrator().surfaces.max_depth == 2 and len(two.integrator().fields) == 2
    image = render(mi, loaded, 4)
    assert image[8, 8, 3] > 0.99 and image[0, 0, 3] == 0
    assert image[8, 5, 0] > 2 * image[8, 5, 2] > 0 and image[8, 10, 2] > 2 * image[8, 10, 0] > 0
    assert np.abs(render(mi, nested, 4) - image).max() < 1e-5
    report = plugins.report(loaded.integrator())
    assert report["table_bytes"] > 0 and report["surfaces"] == "PathFootprint"
    register(mi, {"file": TASK.open(mi.TensorXf, file).field})
    same = mi.load_dict({"type": "test_field", "field": "file"})
    assert np.abs(render(mi, loaded, 4, integrator=same) - image).max() < 1e-6


def test_reflections_of_a_file(mi, fields, file, tmp_path):
    """Derivatives reach the environment, the normals, and the place of the field."""
    rng = np.random.default_rng(8)
    grid = files.grid_of(files.load(file), compat.backend_module(mi.Float)).with_reflections()
    place = grid.nodes.positions() - (np.array(grid.nodes.shape) - 1) / 2
    grid.colour[1:, volume_field.NORMAL] = place / np.maximum(np.linalg.norm(place, axis=1, keepdims=True), 1)
    grid.colour[:, volume_field.TINT] = -0.5
    for part in np.split(grid.environment, [volume_field.SIDES[0] ** 2]):
        side = int(len(part) ** 0.5)
        smooth = gaussian_filter(rng.normal(0, 1, (side, side, 4)), (side / 8, side / 8, 0))
        part += (smooth / smooth.std()).reshape(-1, 4)
    path = tmp_path / "mirror.npz"
    save_table(path, files.grid_table(grid, np.float32))
    register(mi, {"mirror": TASK.open(mi.TensorXf, path, storage="float32").field})
    found = check(mi, lit(mi, "mirror"), "tables.environment", tolerance=0.02)
    assert np.abs(found[..., :3]).max() > 0.01
    check(mi, lit(mi, "mirror"), "tables.colour", step=5e-4, tolerance=0.01)
