"""Mitsuba 3.10, simulated: its loader of entry points, and what the functions of ``mitsuba_versions.py`` take from it.

What is simulated is described in ``docs/next_mitsuba.md``. Nothing here shows that Mitsuba 3.10 itself works.
"""

import enum
import importlib.metadata
import json
import re
import subprocess
import sys
import types
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from mi_diffind.core import compat

ROOT = Path(__file__).resolve().parents[1]

#: What Mitsuba does after each change of variant: the first time it imports the modules, later it loads them anew.
LOADER = """
import collections, importlib, json, sys
import mitsuba as mi

registered, modules, results, classes = collections.Counter(), [], [], set()
before = "mi_diffind" in sys.modules

def counted(function):
    def register(*arguments):
        registered[mi.variant(), arguments[-2]] += 1
        return function(*arguments)
    return register

def load_entry_points():
    if modules:
        modules[:] = [importlib.reload(module) for module in modules]
        return
    kinds = [name for name in dir(mi) if name.startswith("register_")]
    functions = {name: getattr(mi, name) for name in kinds}
    for name in kinds:
        setattr(mi, name, counted(functions[name]))
    modules.append(importlib.import_module(sys.argv[1]))
    for name in kinds:
        setattr(mi, name, functions[name])
    # Functions that register differ from variant to variant; from now on, count where all are called
    versions = sys.modules["mi_diffind.core.compat"]
    versions.register = counted(versions.register)

for variant in sys.argv[2:] * 2:
    mi.set_variant(variant)
    mi.set_log_level(mi.LogLevel.Error)
    load_entry_points()
    classes.add((variant, type(mi.load_dict({"type": "disney", "roughness": 0.3}))))
    image = mi.render(mi.load_dict({
        "type": "scene", "integrator": {"type": "direct"}, "light": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "ball": {"type": "sphere", "material": {"type": "neural_disney", "base_color": {"type": "rgb", "value": 0.5}}},
    }), spp=4)
    results.append(float(image.numpy().mean()))
print(json.dumps({"before": before, "results": results, "classes": len(classes),
                  "registered": [[*key, count] for key, count in registered.items()]}))
"""


def test_declared_entry_point():
    """The one that Mitsuba finds in an installation; a checkout that is not installed has ``pyproject.toml`` only."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '[project.entry-points.mitsuba]\nmi_diffind = "mi_diffind.plugins.mitsuba_entry"\n' in text
    for entry in importlib.metadata.entry_points(group="mitsuba"):
        if entry.name == "mi_diffind":
            assert entry.value == "mi_diffind.plugins.mitsuba_entry"


def test_entry_point_in_three_variants():
    """Imported once, loaded anew after each change, six changes: every plugin is registered once in each variant."""
    variants = ["llvm_ad_rgb", "llvm_ad_spectral", "llvm_ad_mono"]
    done = subprocess.run(
        [sys.executable, "-W", "error::UserWarning", "-c", LOADER, "mi_diffind.plugins.mitsuba_entry", *variants],
        capture_output=True, text=True, cwd=ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout[done.stdout.index("{") :])
    assert not found["before"] and found["classes"] == 3
    counts = {(variant, name): count for variant, name, count in found["registered"]}
    assert set(counts.values()) == {1}, counts
    names = [{name for v, name in counts if v == variant} for variant in variants]
    assert names[0] == names[1] == names[2] and {"disney", "neural_sdf", "mipmap", "path_sdf"} <= names[0]
    assert all(0.5 < value < 1 for value in found["results"])
    assert found["results"][:3] == pytest.approx(found["results"][3:], rel=1e-5)


# -- What differs ------------------------------------------------------------------------------------------------------


def test_footprints(mi_rgb, monkeypatch):
    """The columns of ``si.footprint`` are the diameters, and count before those of an integrator and a sensor."""
    from mi_diffind.plugins.support import footprint

    si = dr.zeros(mi_rgb.SurfaceInteraction3f, 3)
    si.duv_dx, si.duv_dy = mi_rgb.Vector2f(0.5, 0), mi_rgb.Vector2f(0, 0.25)
    assert not compat.has_footprints() and compat.footprint_of(si) is None
    ddx, ddy = (v.numpy() for v in footprint.footprint(si))
    np.testing.assert_allclose(ddx[0], 0.5)

    # The third lane has none, as after a bounce
    matrix = mi_rgb.Matrix2f([[mi_rgb.Float([1, 0.1, 0]), 3], [2, 4]]) * mi_rgb.Float(1, 1, 0)
    monkeypatch.setattr(mi_rgb.SurfaceInteraction3f, "footprint", matrix, raising=False)
    assert compat.has_footprints()
    ddx, ddy = (v.numpy() for v in footprint.footprint(si))
    np.testing.assert_allclose(ddx, [[1, 0.1, 0.5], [2, 2, 0]])
    np.testing.assert_allclose(ddy, [[3, 3, 0], [4, 4, 0.25]])


@pytest.mark.parametrize(("given", "expected"), [({}, True), ({"filter": "off"}, False), ({"constant": True}, False)])
def test_textures_ask_for_footprints(mi_rgb, given, expected):
    """Mitsuba 3.10 computes footprints if a texture of the scene says that it is filtered."""
    pixels = np.full((8, 8, 3), 0.5, np.float32)
    if not given.get("constant"):
        pixels[::2] = 0.1
    content = {"type": "mipmap", "bitmap": mi_rgb.Bitmap(pixels), "raw": True}
    content |= {k: v for k, v in given.items() if k != "constant"}
    assert mi_rgb.load_dict(content).filtered() is expected


def test_ray_flags(mi_rgb, monkeypatch):
    """All of an interaction, and derivatives of normals on demand: those of 3.9 in a scene, those of 3.10 by name."""
    scene = mi_rgb.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    ray = mi_rgb.Ray3f([0.3, 0.2, -3], [0, 0, 1])
    for curvature in (False, True):
        si = scene.ray_intersect(ray, compat.ray_flags(curvature), True)
        assert dr.allclose(dr.norm(si.sh_frame.n), 1) and dr.norm(si.dp_du)[0] > 0.1
        assert (dr.norm(si.dn_du)[0] > 0.1) is curvature

    class RayFlags(enum.IntFlag):
        """Flags of Mitsuba's main branch: ``All`` lacks the footprint, ``dNSdUV`` is gone."""

        Shading, NormalPartials, Footprint = 1, 2, 16
        All, Default = 1, 17

    monkeypatch.setitem(sys.modules, "mitsuba", types.SimpleNamespace(RayFlags=RayFlags))
    assert compat.ray_flags() == RayFlags.Shading | RayFlags.Footprint
    assert compat.ray_flags(curvature=True) == compat.ray_flags() | RayFlags.NormalPartials


def test_no_other_file_chooses_ray_flags():
    """Other files name ``Minimal`` alone, the same in both versions."""
    files = [*(ROOT / "mi_diffind").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    named = {f.name: set(re.findall(r"RayFlags\.(\w+)", f.read_text(encoding="utf-8"))) for f in files}
    assert len(files) > 100
    assert {name: flags for name, flags in named.items() if flags - {"Minimal"}} == {}


def test_normal_maps(mi_rgb, monkeypatch):
    """A material with a normal map asks meshes for frames along uv; directions and normals in them stay as they are."""
    path = str(ROOT / "scenes" / "assets" / "rust_shaded.npz")
    flag = 0x40000
    assert compat.normal_mapped() == 0

    def load(**more):
        return mi_rgb.load_dict({"type": "neural_material", "filename": path, **more})

    def has_flag(**more) -> bool:
        bsdf = load(**more)
        assert bool(bsdf.flags(1) & flag) == bool(bsdf.flags() & flag)
        return bool(bsdf.flags() & flag)

    assert not has_flag()
    module = type(
        load()
    )._is_constant.__globals__  # of the class that is registered, whichever variants were set before
    monkeypatch.setitem(module, "normal_mapped", lambda: flag)
    assert has_flag() and not has_flag(ignore="normal")
    newer = types.SimpleNamespace(BSDFFlags=types.SimpleNamespace(NormalMapped=flag))
    monkeypatch.setitem(sys.modules, "mitsuba", newer)
    assert compat.normal_mapped() == flag


def test_shapes_in_python(mi_rgb, monkeypatch):
    assert not compat.shapes_in_python()
    with pytest.raises(RuntimeError, match="no constructor"):  # what the answer is about
        mi_rgb.register_shape("unsupported", type("Unsupported", (mi_rgb.Shape,), {}))
        mi_rgb.load_dict({"type": "unsupported"})
    monkeypatch.setattr(mi_rgb, "Shape", type("Shape", (), {"__init__": mi_rgb.Mesh.__init__}))
    assert compat.shapes_in_python()


def test_lobe_rates(mi_rgb, monkeypatch):
    """Where ``principled`` chooses lobes itself, ``disney`` does not hand on its rates."""
    from mi_diffind.plugins.disney import to_principled

    rates = ("clearcoat_sampling_rate", "diffuse_reflectance_sampling_rate", "main_specular_sampling_rate")
    assert compat.lobe_rates() == rates

    def converted():
        props = mi_rgb.Properties("disney")
        props["roughness"] = 0.3
        for name in rates:
            props[name] = 2.0
        to_principled(props)
        return set(props.keys())

    assert converted() == {"roughness", *rates}
    stock = mi_rgb.traverse
    fewer = {"roughness.value": 0.5}
    monkeypatch.setattr(mi_rgb, "traverse", lambda node: fewer if "Principled" in node.class_name() else stock(node))
    assert compat.lobe_rates() == () and converted() == {"roughness"}


class Fields(types.SimpleNamespace):
    """Mitsuba with fields in place of textures and volumes, as the open pull request has it."""

    class Field:
        pass

    ObjectType = types.SimpleNamespace(BSDF="a BSDF", Field="a field")


def test_fields(mi_rgb, monkeypatch):
    assert compat.base_class("Texture") is mi_rgb.Texture
    assert compat.base_class("Volume") is mi_rgb.Volume
    assert compat.object_type("Texture") == mi_rgb.ObjectType.Texture

    registered = []
    fields = Fields(
        BSDF=mi_rgb.BSDF,
        register_bsdf=lambda *given: registered.append(("bsdf", *given)),
        register_field=lambda *given: registered.append(("field", *given)),
    )
    monkeypatch.setitem(sys.modules, "mitsuba", fields)
    assert compat.base_class("Texture") is compat.base_class("Volume") is Fields.Field
    assert compat.base_class("BSDF") is mi_rgb.BSDF
    assert compat.object_type("Volume") == "a field" and compat.object_type("BSDF") == "a BSDF"
    for kind in ("texture", "volume", "bsdf"):
        compat.register(kind, f"some {kind}", int)
    assert registered == [("field", "some texture", int), ("field", "some volume", int), ("bsdf", "some bsdf", int)]


def test_meshes(mi_rgb, monkeypatch):
    """A tetrahedron, set and read in both ways; the newer one by a stand-in for the tensors of Mitsuba 3.10."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    props = mi_rgb.Properties("tetrahedron")
    mesh = mi_rgb.Mesh(*compat.mesh_arguments(props, len(positions), len(faces)))
    params = mi_rgb.traverse(mesh)
    compat.set_triangles(params, positions, faces)
    params.update()
    for found, given in zip(compat.triangles(mesh), (positions, faces), strict=True):
        np.testing.assert_array_equal(found, given)
    scene = mi_rgb.load_dict({"type": "scene", "mesh": mesh})
    hit = scene.ray_intersect(mi_rgb.Ray3f([0.25, 0.25, -1], [0, 0, 1]))
    assert dr.allclose(hit.t, 1)

    newer = {"positions": None, "faces": None}
    compat.set_triangles(newer, positions, faces)
    assert newer["positions"].shape == (4, 3) and newer["faces"].shape == (4, 3)
    stand_in = types.SimpleNamespace(**{name: lambda name=name: newer[name] for name in newer})
    for found, given in zip(compat.triangles(stand_in), (positions, faces), strict=True):
        np.testing.assert_array_equal(found, given)
    monkeypatch.setattr(mi_rgb.Mesh, "from_fields", None, raising=False)
    assert compat.mesh_arguments(props, 4, 4) == (props,)
