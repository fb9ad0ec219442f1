"""Plugins that declare themselves: found here and in other packages, checked, and known by what they were made from."""

import subprocess
import sys
import textwrap
from importlib import metadata
from pathlib import Path

import pytest

from mi_diffind import plugins
from mi_diffind.scenes import loading

#: A learned shape whose factory returns a native object, and factories that fail.
MODULES = {
    "toy_ball": """
        import mitsuba as mi
        from mi_diffind.plugins import Counterpart, Plugin, reports_as

        def make(props):
            native = mi.Properties("sphere")
            native.set_id(props.id())
            size = float(props.get("size", 0.5))
            native["radius"] = size
            made = mi.PluginManager.instance().create_object(native)
            preset = str(props.get("preset", "tables"))
            reports_as(made, lambda: {"preset": preset, "size": size, "storage": "uint8", "table_bytes": 12})
            return made

        def to_sphere(props):
            props["radius"] = float(props.get("size", 0.5))

        PLUGIN = Plugin("toy_ball", "shape", make, exact=Counterpart("sphere", ("preset", "size"), convert=to_sphere))
    """,
    "toy_nothing": """
        from mi_diffind.plugins import Plugin
        PLUGIN = Plugin("toy_nothing", "bsdf", lambda props: None)
    """,
    "toy_wrong": """
        import mitsuba as mi
        from mi_diffind.plugins import Plugin
        PLUGIN = Plugin("toy_wrong", "bsdf", lambda props: mi.load_dict({"type": "sphere"}))
    """,
}


@pytest.fixture(scope="module")
def package(tmp_path_factory):
    """A package of its own that names plugins as entry points; every variant is registered anew."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "toys").mkdir()
    (folder / "toys" / "__init__.py").write_text("")
    for name, text in MODULES.items():
        (folder / "toys" / f"{name}.py").write_text(textwrap.dedent(text))
    info = folder / "toys-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toys\nVersion: 1.0\n")
    names = "".join(f"{name} = toys.{name}\n" for name in MODULES)
    (info / "entry_points.txt").write_text(f"[{plugins.__name__}]\n{names}broken = toys.missing\n")
    before = dict(plugins._declared)
    sys.path.insert(0, str(folder))
    plugins._declared.clear()
    yield folder
    sys.path.remove(str(folder))
    plugins._declared.clear()
    plugins._declared.update(before)


@pytest.fixture(params=["llvm_ad_rgb", "scalar_rgb"])
def mi_toys(request, package):
    import mitsuba as mi

    with pytest.warns(RuntimeWarning, match=r'"broken" \(toys.missing\) is left out: ModuleNotFoundError'):
        plugins._declared.pop(request.param, None)
        mi.set_variant("llvm_ad_mono")
        plugins._declared.pop(request.param, None)
        mi.set_variant(request.param)
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def test_plugins_of_this_package_say_what_they_are(mi):
    declared = plugins.declared()
    assert {name: p.object_type for name, p in declared.items()} == {
        "disney": "bsdf", "mipmap": "texture", "neural_bsdf": "bsdf", "neural_disney": "bsdf", "neural_ggx": "bsdf",
        "neural_field": "integrator", "neural_image": "texture", "neural_material": "bsdf",
        "neural_sdf": "shape", "neural_texture": "texture", "path_footprint": "integrator",
        "path_sdf": "integrator",
    }  # fmt: skip
    assert plugins.with_counterpart() == tuple(name for name in sorted(declared) if name.startswith("neural_"))
    assert plugins.with_counterpart("mipmap") == ("neural_material", "neural_texture")
    assert plugins.with_counterpart("principled") == ("disney", "neural_disney", "neural_material")


def test_program_of_mitsuba_loads_no_plugins(mi, tmp_path):
    """Mitsuba's program loads no Python plugins; manual pages and the README change when this fails."""
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"><bsdf type="neural_disney"/></scene>')
    program = Path(mi.__file__).parent / ("mitsuba.exe" if sys.platform == "win32" else "mitsuba")
    command = [str(program), "-m", "scalar_rgb", str(tmp_path / "scene.xml")]
    output = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert 'Plugin "neural_disney" not found!' in output.stdout + output.stderr


def test_each_variant_has_classes_of_its_own():
    import mitsuba as mi

    found = []
    for variant in ("llvm_ad_rgb", "llvm_ad_mono"):
        mi.set_variant(variant)
        found.append(plugins.declared()["neural_disney"].factory)
        assert issubclass(found[-1], mi.BSDF) and issubclass(found[-1], plugins.declared()["disney"].factory)
    assert found[0] is not found[1] and found[0].__init__.__globals__ is not found[1].__init__.__globals__


def test_after_a_purge_of_modules():
    """Variants may be set before and after the package is imported anew, which registers its plugins."""
    code = (
        "import sys, mi_diffind, mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        "def purge():\n"
        "    for name in [n for n in sys.modules if n.split('.')[0] == 'mi_diffind']: del sys.modules[name]\n"
        "purge(); mi.set_variant('llvm_ad_spectral'); import mi_diffind\n"
        "print(type(mi_diffind.load_dict({'type': 'disney'})).__name__)\n"
        "mi.set_variant('llvm_ad_rgb'); print(type(mi.load_dict({'type': 'neural_disney'})).__name__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.split() == ["Disney", "NeuralDisney"], done.stderr


def test_plugins_of_other_packages(mi_toys):
    """Shapes whose factories return native objects are found, compared and inspected; also by scalar variants."""
    assert {"toy_ball", "neural_disney"} <= set(plugins.declared())
    balls = {"ball": {"type": "toy_ball", "preset": "paper"}, "other": {"type": "toy_ball", "size": 0.25}}
    parsed = loading.ParsedScene({"type": "scene", "sky": {"type": "constant"}, **balls})
    assert [(e["plugin"], e["id"], e.get("preset")) for e in parsed.learned_plugins()] == [
        ("toy_ball", "ball", "paper"), ("toy_ball", "other", None)
    ]  # fmt: skip
    exact = parsed.load(exact=True, needs=())
    assert [shape.class_name() for shape in exact.shapes()] == ["Sphere", "Sphere"]
    assert loading.instances(exact) == []
    if not plugins.supported(mi_toys.variant()):
        with pytest.raises(loading.SceneError, match='"toy_ball" does not run in the variant "scalar_rgb"'):
            parsed.load(needs=())
        return
    reports = loading.reports(parsed.load(needs=()))
    assert [(r["plugin"], r["id"], r["preset"], r["size"]) for r in reports] == [
        ("toy_ball", "ball", "paper", 0.5), ("toy_ball", "other", "tables", 0.25)
    ]  # fmt: skip


def test_native_objects_are_forgotten(mi_toys):
    """Native objects cannot be referenced weakly: those that nobody else holds are dropped with the next one."""
    mi = mi_toys
    if not plugins.supported(mi.variant()):
        return
    plugins._forget_dead()
    before = len(plugins._native)
    balls = [mi.load_dict({"type": "toy_ball", "size": 0.1 * i}) for i in (1, 2, 3)]
    assert len(plugins._native) == before + 3 and plugins.report(balls[1])["size"] == pytest.approx(0.2)
    del balls
    mi.load_dict({"type": "toy_ball"})
    plugins._forget_dead()
    assert len(plugins._native) == before


@pytest.mark.parametrize("name, found", [("toy_nothing", "nothing"), ("toy_wrong", "a Shape")])
def test_factories_that_return_something_else(mi_toys, name, found):
    """Mitsuba would crash, or speak of a bad cast."""
    if plugins.supported(mi_toys.variant()):
        with pytest.raises(RuntimeError, match=f'"{name}": the factory returned {found}, a bsdf is needed'):
            mi_toys.load_dict({"type": name})


def test_two_plugins_of_one_name(mi, monkeypatch):
    """The plugin of this package stays; a warning names the other one."""
    variant, theirs = mi.variant(), metadata.EntryPoint("disney", "theirs.disney", plugins.__name__)
    monkeypatch.setattr(metadata, "entry_points", lambda group: [theirs] if group == plugins.__name__ else [])
    monkeypatch.setitem(plugins._declared, variant, {})
    plugins._declared.pop(variant)
    with pytest.warns(RuntimeWarning, match=r'"disney" \(theirs.disney\) is left out: .* mi_diffind.plugins.disney'):
        plugins.register(variant)
    assert plugins.declared()["disney"].factory.__module__ == "mi_diffind.plugins.disney"
