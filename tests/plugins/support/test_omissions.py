"""Warnings of what renders leave out: in scenes of plain Mitsuba, once each, and in no others."""

import inspect
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
from radiance_fields import Fog
from radiance_fields import register as register_field

import mi_diffind
from mi_diffind.core import compat
from mi_diffind.plugins.support import footprint

SOLID = str(Path(__file__).resolve().parents[3] / "scenes" / "assets" / "suzanne.npz")


def textured(mi, **more) -> dict:
    """Two textures that filter themselves, one for each of two shapes."""
    shapes = {}
    for name, side in (("rectangle", 16), ("cylinder", 8)):
        values = np.random.default_rng(3).random((side, side, 3)).astype(np.float32)
        texture = {"type": "mipmap", "bitmap": mi.Bitmap(values), **more}
        bsdf = {"type": "twosided", "inner": {"type": "diffuse", "reflectance": texture}}
        shapes[name] = {"type": name, "bsdf": bsdf}
    return shapes


def scene(mi, **content) -> dict:
    at = mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 4, "height": 4}
    return {
        "type": "scene",
        "sensor": {"type": "perspective", "to_world": at, "film": film},
        "sky": {"type": "constant"},
        **content,
    }  # fmt: skip


@pytest.fixture
def warned(capsys):
    """The warnings since the last call, as lines."""
    return lambda: [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]


def render(mi, loaded, integrator=None, **more):
    """A render that is traced, which is when warnings come; only the conversion to an array would compute it."""
    if isinstance(integrator, str):
        integrator = mi.load_dict({"type": integrator, **more})
    return mi.render(loaded, integrator=integrator, spp=1)


def test_shapes_that_the_integrator_does_not_trace(mi, warned):
    shapes = {name: {"type": "neural_sdf", "filename": SOLID} for name in ("first", "second")}
    shapes["second"]["normals"] = "smooth"  # Mitsuba merges equal shapes
    loaded = mi.load_dict(scene(mi, **shapes))
    render(mi, loaded, "path_sdf", max_depth=2)
    assert not warned()
    direct = mi.load_dict({"type": "direct"})
    empty = render(mi, loaded, direct)
    (line,) = warned()
    assert np.allclose(empty.numpy(), 1) and "(1 more likewise)" in line
    for words in ('"first" (neural_sdf)', "DirectIntegrator", "path_sdf", 'trace="grid"', "mi_diffind.load_file"):
        assert words in line
    render(mi, loaded, direct)
    render(mi, loaded, "depth")
    assert not warned()
    again = mi.load_dict(scene(mi, **shapes, integrator={"type": "path_footprint", "max_depth": 2}))
    again.integrator().render(again, spp=1)  # not by mi.render: integrators of this package check, too
    assert len(warned()) == 1
    grouped = {"group": {"type": "shapegroup", "solid": shapes["first"]}}
    render(mi, mi.load_dict(scene(mi, **grouped)), direct)
    assert len(warned()) == 1
    optimised = mi.load_dict(scene(mi, solid={**shapes["first"], "storage": "float32"}))
    render(mi, optimised, direct)
    (line,) = warned()
    assert "path_sdf" in line and "grid" not in line  # which float32 cannot become


def test_scenes_that_were_prepared(mi, warned):
    """``mi_diffind.load_dict`` decodes and attaches, ``mi_diffind.attach`` warns: either way, renders are silent."""
    solid = {"type": "neural_sdf", "filename": SOLID}
    content = {"solid": {**solid, "resolution": 24}, "integrator": {"type": "direct"}, **textured(mi)}
    loaded = mi_diffind.load_dict(scene(mi, **content))
    assert ["decoded to a grid" in line for line in warned()] == [True]
    render(mi, loaded)
    assert not warned()
    loaded = mi.load_dict(scene(mi, **{**content, "solid": solid}))
    assert mi_diffind.attach(loaded) is loaded
    assert ['"solid" (neural_sdf)' in line for line in warned()] == [True]
    render(mi, loaded)
    assert not warned()
    loaded = mi.load_dict(scene(mi, solid=solid))
    mi_diffind.attach(loaded)  # without an integrator: any may render it
    render(mi, loaded, "path_sdf", max_depth=2)
    assert not warned()


def test_integrators_around_the_one_that_traces(mi, warned):
    """Channels of ``aov`` come from rays of its own."""
    shapes = {"solid": {"type": "neural_sdf", "filename": SOLID}}
    inner = {"type": "path_sdf", "max_depth": 2}
    render(mi, mi.load_dict(scene(mi, **shapes)), "moment", inner=inner)
    assert not warned()
    image = render(mi, mi.load_dict(scene(mi, **shapes)), "aov", aovs="d:depth", inner=inner)
    assert (image.numpy()[..., -1] == 0).all() and "AOVIntegrator" in warned()[0]


@pytest.mark.parametrize("integrator", ["path", "path_sdf"])
def test_textures_that_nothing_filters(mi, warned, integrator):
    """One warning, at the first render; beside a distance field that is rendered, too."""
    solid = {"solid": {"type": "neural_sdf", "filename": SOLID}} if integrator == "path_sdf" else {}
    loaded = mi.load_dict(scene(mi, **textured(mi), **solid))
    render(mi, loaded, integrator, max_depth=2)
    (line,) = warned()
    for words in ("(mipmap) is not filtered", "mi_diffind.load_file", "mi_diffind.attach(scene)", "path_footprint"):
        assert words in line
    render(mi, loaded, integrator, max_depth=2)
    assert not warned()


def test_textures_that_are_filtered_or_not_read(mi, warned):
    render(mi, mi.load_dict(scene(mi, **textured(mi))), "path_footprint", max_depth=2)
    render(mi, mi.load_dict(scene(mi, **textured(mi))), "moment", inner={"type": "path_footprint", "max_depth": 2})
    render(mi, mi.load_dict(scene(mi, **textured(mi))), "depth")
    render(mi, mi.load_dict(scene(mi, **textured(mi, filter="off"))), "direct")
    at = mi.ScalarTransform4f().look_at([0, 0, -4], [0, 0, 0], [0, 1, 0])
    sensor = {"sensor_to_world": at, "fov": 40, "resolution": 4}
    render(mi, mi.load_dict(scene(mi, **textured(mi, **sensor))), "direct")
    attached = mi.load_dict(scene(mi, **textured(mi)))
    assert footprint.attach(attached) == 2
    render(mi, attached, "volpath", max_depth=2)
    texture = footprint.textures(mi.load_dict(scene(mi, **textured(mi))))[0]
    texture.eval(dr.zeros(mi.SurfaceInteraction3f, 4))  # by hand
    assert not warned()


def test_scenes_without_a_sensor(mi, warned, tmp_path):
    """``mi_diffind.load_file`` has no sensor to take; the one that renders is not known."""
    path = tmp_path / "scene.xml"
    mi.Bitmap(np.random.default_rng(3).random((8, 8, 3)).astype(np.float32)).write(str(tmp_path / "image.exr"))
    path.write_text("""<scene version="3.0.0"><shape type="rectangle"><bsdf type="diffuse">
        <texture type="mipmap" name="reflectance"><string name="filename" value="image.exr"/></texture></bsdf></shape>
        <emitter type="constant"/></scene>""")
    loaded, film = mi_diffind.load_file(path), {"type": "hdrfilm", "width": 4, "height": 4}
    at = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sensor = mi.load_dict({"type": "perspective", "to_world": at, "film": film})
    mi.render(loaded, sensor=sensor, integrator=mi.load_dict({"type": "direct"}), spp=1)
    assert len(warned()) == 1
    odd = mi.load_dict({"type": "radiancemeter", "film": {**film, "width": 1, "height": 1}})
    loaded = mi_diffind.load_file(path)
    footprint.attach(loaded, odd)  # this has its own warning
    mi.render(loaded, sensor=sensor, integrator=mi.load_dict({"type": "direct"}), spp=1)
    assert not warned()


def test_sensors_that_textures_do_not_know(mi, warned):
    """A loop over sensors has to attach each; ``path_footprint`` knows them all."""
    content = scene(mi, **textured(mi))
    content |= {
        "left": content.pop("sensor"),
        "right": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4}},
    }
    loaded, direct = mi_diffind.load_dict(content), mi.load_dict({"type": "direct"})
    left, right = loaded.sensors()
    mi.render(loaded, sensor=1, integrator=mi.load_dict({"type": "path_footprint", "max_depth": 2}), spp=1)
    for sensor in (0, left):
        mi.render(loaded, sensor=sensor, integrator=direct, spp=1)
    for i, sensor in enumerate((left, right)):
        mi_diffind.attach(loaded, i)
        mi.render(loaded, sensor=sensor, integrator=direct, spp=1)
    assert not warned()
    mi.render(loaded, sensor=0, integrator=direct, spp=1)
    (line,) = warned()
    assert 'for the sensor "right", found "left"' in line and "mi_diffind.attach(scene, sensor)" in line
    mi.render(loaded, sensor=0, integrator=direct, spp=1)
    assert not warned()


def test_fields_that_another_integrator_leaves_out(mi, warned):
    register_field(mi, {"fog": Fog(compat.backend_module(mi.Float))})
    field = {"type": "test_field", "field": "fog"}
    loaded = mi.load_dict(scene(mi, integrator={**field, "inner": {"type": "direct"}}))
    render(mi, loaded)
    render(mi, loaded, mi.load_dict({**field, "max_depth": 2}))
    assert not warned()
    render(mi, loaded, "direct")
    (line,) = warned()
    assert "neural_field" in line and "DirectIntegrator" in line


def test_render_stays_as_it_is(mi, warned, monkeypatch):
    """Its signature and its errors; after the first render, nothing is traversed."""
    assert list(inspect.signature(mi.render).parameters) == [
        "scene", "params", "sensor", "integrator", "seed", "seed_grad", "spp", "spp_grad"
    ]  # fmt: skip
    assert mi.render is mi.util.render and "differentiable" in mi.render.__doc__
    for arguments in ((), ("scene",)):
        with pytest.raises((TypeError, AssertionError)):
            mi.render(*arguments)
    plain = mi.load_dict(scene(mi, ball={"type": "sphere"}, integrator={"type": "direct"}))
    mi.render(plain, None, 0, None, 1, spp=1)

    def traversed(*objects):
        raise AssertionError("a scene was traversed")

    monkeypatch.setattr(compat, "scene_objects", traversed)
    assert np.array(mi.render(scene=plain, spp=1, seed=0, sensor=0)).shape == (4, 4, 3) and not warned()
