"""Every plugin under every integrator of Mitsuba: the picture is right, or a warning names the plugin."""

from pathlib import Path

import numpy as np
import pytest
from radiance_fields import Fog, register

from mi_diffind.core import compat

ASSETS = Path(__file__).resolve().parents[2] / "scenes" / "assets"


def texture(name, file, **more):
    return {"type": name, "filename": str(ASSETS / file), **more}


def diffuse(reflectance):
    return {"bsdf": {"type": "diffuse", "reflectance": reflectance}}


def shining(radiance):
    return {"emitter": {"type": "area", "radiance": radiance}}


DISNEY = {"base_color": {"type": "rgb", "value": [0.7, 0.3, 0.2]}, "roughness": 0.6, "metallic": 0.3, "spec_tint": 0.4}
METAL = {"material": "Au", "alpha": 0.4}
IMAGE = texture("neural_image", "tiles.npz", channels="albedo")
BITMAP = texture("bitmap", "tiles_albedo.png")

#: Plugin → parts of a square with it, and parts with plugins of Mitsuba that it has to equal.
PAIRS = {
    "disney": ({"bsdf": {"type": "disney", **DISNEY}}, {"bsdf": {"type": "principled", **DISNEY}}),
    "neural_disney": ({"bsdf": {"type": "neural_disney", **DISNEY}}, {"bsdf": {"type": "principled", **DISNEY}}),
    "neural_ggx": (
        {"bsdf": {"type": "neural_ggx", **METAL}},
        {"bsdf": {"type": "roughconductor", "distribution": "ggx", **METAL}},
    ),
    "neural_image": (diffuse(IMAGE), diffuse(BITMAP)),
    "neural_image, shining": (shining(IMAGE), shining(BITMAP)),
    "neural_texture": (diffuse(texture("neural_texture", "tiles_filtered.npz", channels="albedo")), diffuse(BITMAP)),
    "mipmap": (diffuse(texture("mipmap", "tiles_albedo.png")), diffuse(BITMAP)),
    "neural_material": (
        {"bsdf": texture("neural_material", "tiles_filtered.npz")},
        {"bsdf": {
            "type": "normalmap", "normalmap": texture("bitmap", "tiles_normal.png", raw=True),
            "inner": {
                "type": "principled", "base_color": BITMAP,
                "roughness": texture("bitmap", "tiles_roughness.png", raw=True),
            },
        }},
    ),
}  # fmt: skip

#: Pixels along a square, and the distance of the eye, in units of half a square.
SIDE, DISTANCE = 8, 400

CHANNELS = "albedo:albedo,depth:depth,normal:sh_normal,uv:uv"

#: Integrators of Mitsuba 3.9, and parameters.
INTEGRATORS = {
    "direct": {},
    "path": {"max_depth": 3},
    "volpath": {"max_depth": 3},
    "volpathmis": {"max_depth": 3},
    "prb": {"max_depth": 3},
    "prb_basic": {"max_depth": 3},
    "prbvolpath": {"max_depth": 3},
    "direct_projective": {},
    "prb_projective": {"max_depth": 3},
    "ptracer": {"max_depth": 3},
    "depth": {},
    "aov": {"aovs": CHANNELS},
    "moment": {"inner": {"type": "direct"}},
}


@pytest.fixture
def squares(mi):
    """Squares side by side, in uniform light: the plugins in the upper row, Mitsuba's in the lower one."""
    at = mi.ScalarTransform4f
    shapes = {}
    for i, pair in enumerate(PAIRS.values()):
        for row, parts in zip(("upper", "lower"), pair, strict=True):
            place = at().translate([2 * i + 1 - len(PAIRS), 1 if row == "upper" else -1, 0])
            shapes[f"{row}{i}"] = {"type": "rectangle", "to_world": place, **parts}
    film = {"type": "hdrfilm", "width": SIDE * len(PAIRS), "height": 2 * SIDE, "rfilter": {"type": "box"}}
    fov = 2 * np.degrees(np.arctan(len(PAIRS) / DISTANCE))
    eye = at().look_at([0, 0, DISTANCE], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "film": film, "to_world": eye, "fov": fov, "fov_axis": "x"},
        "sky": {"type": "constant", "radiance": 0.5},
        "solid": {"type": "neural_sdf", "filename": str(ASSETS / "suzanne.npz")},
        **shapes,
    }  # fmt: skip


@pytest.mark.parametrize("name", INTEGRATORS)
def test_pictures_are_right_or_warned_of(mi, squares, capsys, name):
    """Each square equals that of Mitsuba's plugin; of what is left out, a shape and filters, one warning each tells."""
    integrator = mi.load_dict({"type": name, **INTEGRATORS[name]})
    samples, limit = (1024, 0.08) if name == "ptracer" else (256, 0.01)
    image = np.array(mi.render(mi.load_dict(squares), integrator=integrator, spp=samples), np.float64)
    warnings = capsys.readouterr().err.splitlines()
    expected = {"neural_sdf", *(() if name == "depth" else ("neural_texture", "mipmap", "neural_material"))}
    for plugin in expected:
        assert [f"({plugin}" in line for line in warnings].count(True) == 1
    assert len(warnings) == len(expected)

    if name == "moment":
        image = image[..., :6]  # second moments are those of the samples, which differ
    assert np.isfinite(image).all() and image[..., :3].mean() > 0.1
    for i, key in enumerate(PAIRS):
        if (name, key) == ("aov", "neural_material"):
            continue  # the frame that a BSDF turns to is known of Mitsuba's own plugins only
        ours, theirs = (
            rows[:, i * SIDE : (i + 1) * SIDE].reshape(SIDE**2, -1) for rows in (image[:SIDE], image[SIDE:])
        )
        # Pixels of a pair see the same places of their squares, so that a difference is noise, or the error of tables
        size, noise = np.abs(theirs).mean(0), (ours - theirs).std(0) / SIDE
        error = np.abs(ours.mean(0) - theirs.mean(0))
        assert (error <= 4 * noise + 0.01 * size + 1e-6).all(), key
        assert (noise <= limit * size + 1e-6).all(), key


#: Integrators that a radiance field does not take as that of the surfaces → a part of the error.
REFUSED = {
    "ptracer": "does not follow rays from a camera",
    "aov": "has AOVs of its own",
    "moment": "has AOVs of its own",
}


@pytest.mark.parametrize("name", INTEGRATORS)
def test_radiance_fields_around_each_integrator(mi, name):
    """Uniform fog before a sky: what is seen is the formula's mixture of both."""
    colour, density = np.array([0.2, 0.5, 0.8]), 0.8
    register(mi, {"fog": Fog(compat.backend_module(mi.Float), density, colour)})
    field = {"type": "test_field", "field": "fog", "surfaces": {"type": name, **INTEGRATORS[name]}}
    if name in REFUSED:
        with pytest.raises(RuntimeError, match=REFUSED[name]):
            mi.load_dict(field)
        return
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    eye = mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene",
        "integrator": field,
        "sensor": {"type": "perspective", "film": film, "to_world": eye, "fov": 0.1},
        "sky": {"type": "constant", "radiance": 0.5},
    })  # fmt: skip
    through = np.exp(-2 * density)  # the box is 2 long
    sky = 0 if name == "depth" else 0.5  # a distance is 0 where there is no surface
    image = np.array(mi.render(scene, spp=4))
    assert np.allclose(image[0, 0, :3], (1 - through) * colour + through * sky, rtol=1e-3)
