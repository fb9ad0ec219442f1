"""Each hook into what Mitsuba and Dr.Jit do not promise: a failure says which one broke."""

import importlib
import importlib.metadata
import re
from pathlib import Path

import drjit as dr
import numpy as np
import pytest

from mi_diffind.core import compat, runtime

ROOT = Path(__file__).resolve().parents[1]
SCENE = ROOT / "tests" / "lamp.xml"


@pytest.fixture
def history():
    """A function that computes, and what Dr.Jit recorded of it."""

    def record(function):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.sync_thread()
            dr.kernel_history_clear()
            dr.eval(function())
            dr.sync_thread()
            return dr.kernel_history([dr.KernelType.JIT])

    return record


def test_functions_of_the_library(mi_rgb):
    """Starting LLVM again itself is tested in processes of their own (``test_runtime.py``)."""
    assert len(compat.llvm_version()) == 3 and compat.llvm_version()[0] >= runtime.MIN_LLVM
    assert Path(compat.core_library()).is_file(), compat.core_library()
    core = compat.JitCore()
    before = core.launches()
    dr.eval(dr.arange(mi_rgb.Float, 7) + 1)
    assert core.launches() == before + 1
    bsdf = mi_rgb.load_dict({"type": "diffuse"})
    assert bsdf is not None and core.holds_objects(mi_rgb.variant())
    assert not core.holds_objects("llvm_ad_rgb_double")


def test_kernels(mi_rgb, history):
    def compute():  # of other numbers than any other test
        x = dr.opaque(mi_rgb.Float, 0.1234, 1000)
        return x * x + 4.321

    kernels = history(compute)
    code = compat.kernel_code(kernels[0])
    assert "fmuladd" in code or "fma" in code
    if mi_rgb.variant().startswith("llvm"):
        name, lanes = compat.llvm_target(code)
        assert name and lanes in (1, 2, 4, 8, 16, 32)
    assert 0 < compat.kernel_seconds(kernels) < 60
    assert not compat.was_compiled(history(compute))
    assert compat.was_compiled([{"cache_hit": False}]) and compat.was_compiled([{"cache_disk": True}])
    assert {"cache_hit", "cache_disk"} <= set(kernels[0])


def test_scopes(mi_rgb, history):
    """Equal computations in different scopes are two computations."""
    x = dr.opaque(mi_rgb.Float, 0.5, 100)
    first, same = x + 1, x + 1
    compat.new_scope(mi_rgb.Float)
    other = x + 1
    assert first.index == same.index != other.index


def test_classes_of_textures(mi_any):
    bitmap = {"type": "bitmap", "raw": True}
    grey = {"type": "uniform", "value": 0.5}
    uniform, colour, float_, bytes_, other = map(mi_any.load_dict, (
        grey, grey if mi_any.is_monochromatic else {"type": "srgb", "color": [0.1, 0.2, 0.3]},
        {**bitmap, "data": mi_any.TensorXf(np.full((2, 2, 1), 0.5))},
        {**bitmap, "bitmap": mi_any.Bitmap(np.full((2, 2, 3), 128, np.uint8))}, {"type": "checkerboard"},
    ))  # fmt: skip
    assert compat.is_constant_texture(uniform) and compat.is_uniform_spectrum(uniform)
    assert "value" in mi_any.traverse(uniform).keys()
    assert compat.is_constant_texture(colour)
    assert compat.is_uniform_spectrum(colour) == mi_any.is_monochromatic
    assert compat.is_bitmap(float_) and compat.is_bitmap(bytes_)
    assert "data" in mi_any.traverse(bytes_).keys()
    assert not compat.is_bitmap(uniform) and not compat.is_bitmap(other) and not compat.is_constant_texture(other)

    class UniformSpectrum(mi_any.Texture):
        pass

    assert compat.texture_class(UniformSpectrum(mi_any.Properties())) == ""


def test_films(mi_rgb):
    """The size of a film is a parameter, which is set back; one with a crop window keeps its own."""
    film, sensor = {"type": "hdrfilm", "width": 20, "height": 12}, {"type": "perspective"}
    scene = mi_rgb.load_dict({"type": "scene", "sensor": {**sensor, "film": film}, "light": {"type": "constant"}})
    with compat.film_size(scene.sensors()[0], 10, 5) as possible:
        assert possible and mi_rgb.render(scene, spp=1, integrator=mi_rgb.load_dict({"type": "path"})).shape[:2] == (
            5,
            10,
        )
    assert tuple(scene.sensors()[0].film().size()) == (20, 12)
    cropped = {**film, "crop_width": 4, "crop_height": 4}
    with compat.film_size(mi_rgb.load_dict({**sensor, "film": cropped}), 2, 2) as possible:
        assert not possible


@pytest.mark.parametrize("name", ["Float", "UInt32"])
def test_copies_are_not_numpys_memory(mi_rgb, name):
    dtype = getattr(mi_rgb, name)
    numbers = {"Float": [0, -0.0, 1, 1e-37, np.nan, np.inf, -np.inf], "UInt32": [0, 1, 2**32 - 1]}[name]
    values = np.array(numbers, "f4" if name == "Float" else "u4")
    array, kept = dtype(values), values.copy()
    copy = compat.owned(array)
    dr.sync_thread()  # copies are made in the background
    assert copy.index != array.index
    if mi_rgb.variant().startswith("llvm"):
        values[:] = 3
        np.testing.assert_array_equal(array.numpy(), 3)  # what the copy is for
    np.testing.assert_array_equal(copy.numpy().view("u4"), kept.view("u4"))
    computed = array + 1
    assert compat.owned(computed) is computed


def test_assignments_are_seen_by_all(mi_rgb):
    tensor = mi_rgb.TensorXf(np.zeros((2, 2), np.float32))
    same = tensor
    compat.assign(tensor, mi_rgb.TensorXf(np.ones((1, 3), np.float32)))
    assert same.shape == (1, 3) and same.array.numpy().tolist() == [1, 1, 1]


def test_declared_entry_point():
    """The one that Mitsuba finds in an installation; a checkout that is not installed has ``pyproject.toml`` only."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '[project.entry-points.mitsuba]\nmi_diffind = "mi_diffind.plugins.mitsuba_entry"\n' in text
    for entry in importlib.metadata.entry_points(group="mitsuba"):
        if entry.name == "mi_diffind":
            assert entry.value == "mi_diffind.plugins.mitsuba_entry"


def test_entry_point_registers_what_is_missing(mi_any, monkeypatch):
    """Mitsuba loads the module anew after each change of variant; every plugin is registered once in each."""
    from mi_diffind import plugins
    from mi_diffind.plugins import mitsuba_entry

    registered = []
    monkeypatch.setattr(compat, "register", lambda kind, name, factory: registered.append(name))
    importlib.reload(mitsuba_entry)
    assert not registered and set(plugins.declared()) > {"disney", "neural_sdf", "mipmap", "path_sdf"}


def test_ray_flags(mi_rgb):
    """All of an interaction, and derivatives of normals on demand; other files name ``Minimal`` alone."""
    scene = mi_rgb.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    ray = mi_rgb.Ray3f([0.3, 0.2, -3], [0, 0, 1])
    for curvature in (False, True):
        si = scene.ray_intersect(ray, compat.ray_flags(curvature), True)
        assert dr.allclose(dr.norm(si.sh_frame.n), 1) and dr.norm(si.dp_du)[0] > 0.1
        assert (dr.norm(si.dn_du)[0] > 0.1) is curvature
    files = [*(ROOT / "mi_diffind").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    named = {f.name: set(re.findall(r"RayFlags\.(\w+)", f.read_text(encoding="utf-8"))) for f in files}
    assert {name for name, flags in named.items() if flags - {"Minimal"}} == {"compat.py"}


def test_meshes(mi_rgb):
    """A tetrahedron, set and read."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float64)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    mesh = mi_rgb.Mesh("tetrahedron", len(positions), len(faces), mi_rgb.Properties("tetrahedron"))
    params = mi_rgb.traverse(mesh)
    compat.set_triangles(params, positions, faces)
    params.update()
    for found, given in zip(compat.triangles(mesh), (positions, faces), strict=True):
        np.testing.assert_array_equal(found, given)
    scene = mi_rgb.load_dict({"type": "scene", "mesh": mesh})
    assert dr.allclose(scene.ray_intersect(mi_rgb.Ray3f([0.25, 0.25, -1], [0, 0, 1])).t, 1)
