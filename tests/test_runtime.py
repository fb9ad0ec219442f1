"""The choice of LLVM: as a function, and in fresh processes, which alone show that a wrong one does not abort."""

import contextlib
import glob
import os
import signal
import subprocess
import sys
import textwrap
import threading
from pathlib import Path

import drjit as dr
import pytest

import mi_diffind as md
from mi_diffind.core import runtime, threads
from mi_diffind.core.errors import DiffindError, UsageError
from mi_diffind.core.runtime import ENV, MIN_LLVM, choose_llvm, library_version, system_libraries

ROOT = Path(__file__).resolve().parents[1]

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="LLVM is searched for on Linux only")

VERSIONS = {"/new": 20, "/newer": 21, "/minimum": MIN_LLVM, "/old": 18, "/ancient": 15, "/broken": None}

#: Uses a minimum and a maximum, on which an old LLVM aborts.
KERNEL = """
import drjit as dr, drjit.llvm.ad as ad
x = dr.arange(ad.Float, 3)
x = dr.minimum(x, 1) + dr.maximum(x, 1)
assert x.numpy().tolist() == [1, 2, 3], x
"""

#: The kernel, refused by an exception or computed.
TRY_KERNEL = f"""
try:
{textwrap.indent(KERNEL.strip(), "    ")}
except Exception as e:
    print("refused:", str(e)[:200])
else:
    print("computed")
"""

RENDER = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "direct"}, "emitter": {"type": "constant"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
    "shape": {"type": "sphere", "center": [0, 0, 5], "bsdf": {"type": "neural_disney"}},
})
import numpy as np
image = np.array(mi.render(scene, spp=1))
assert image.shape == (4, 4, 3) and np.isfinite(image).all() and image.max() > 0
"""

PRINT_VERSION = "import drjit as dr; print('LLVM', dr.detail.llvm_version()[0])\n"


def choose(environ=None, pip=(), system=()):
    return choose_llvm(environ or {}, lambda: list(pip), lambda: list(system), VERSIONS.get)


@linux
def test_order_of_the_search():
    for path in ("/new", "/minimum"):
        assert choose({ENV: path}, pip=["/newer"], system=["/newer"]) == (path, None)
    assert choose(pip=["/new"], system=["/newer"]) == ("/new", None)
    assert choose(pip=["/newer", "/new"]) == ("/newer", None)
    assert choose(pip=["/broken", "/old", "/new"]) == ("/new", None)
    assert choose(system=["/old", "/minimum"]) == ("/minimum", None)
    assert choose({ENV: ""}, pip=["/new"]) == ("/new", None)  # set to nothing is not set


@linux
@pytest.mark.parametrize(("system", "mentioned"), [([], "none was found"), (["/old", "/ancient"], "/old")])
def test_nothing_usable_says_what_to_install(system, mentioned):
    path, problem = choose(system=system)
    assert path is None and mentioned in problem and "pip install karellen-llvm-core" in problem
    assert f"LLVM {MIN_LLVM} or newer" in problem and ENV in problem
    one_sentence(problem)


@pytest.mark.parametrize(
    ("path", "mentioned"),
    [("/old", "LLVM 18"), ("/ancient", "15 or older"), ("/broken", "not a loadable"), ("/missing", "not a loadable")],
)
def test_an_unusable_explicit_setting_is_refused(path, mentioned):
    """Not silently replaced by another: the user said so."""
    _, problem = choose({ENV: path}, pip=["/new"], system=["/new"])
    assert mentioned in problem and path in problem and "pip install karellen-llvm-core" in problem
    one_sentence(problem)


def test_elsewhere_the_search_is_left_to_drjit(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert choose(pip=["/new"]) == (None, None) and choose({ENV: "/old"})[1] is not None


def one_sentence(text):
    assert text.endswith(".") and ". " not in text and "\n" not in text


def test_names_of_libraries(tmp_path):
    """Which files count as LLVM, and which is the newest: the number in the name, wherever it stands."""
    names = {
        "libLLVM-15.so": 15, "libLLVM-15.so.1": 15, "libLLVM.so.20.1": 20, "libLLVM-9.so": 9, "libLLVM.so.19.1": 19,
        "libLLVM.so": 0, "libLLVM-14.0.6.so.1": 14, "libLLVM.so.23": 23,
    }  # fmt: skip
    others = ("libLLVMSupport.a", "libLLVM-C.so.20", "libLLVM-18.so.bak", "libclang.so.20", "libLLVMCore.so")
    for name in (*names, *others):
        (tmp_path / name).write_text("")
    (tmp_path / "libLLVM.so.99").symlink_to(tmp_path / "missing")
    found = [os.path.basename(p) for p in system_libraries([str(tmp_path / "*")])]
    assert set(found) == set(names)
    assert [names[n] for n in found] == sorted(names.values(), reverse=True)
    assert system_libraries([str(tmp_path / "nothing*")]) == []
    assert all(runtime._named_version(name) == version for name, version in names.items())


def test_version_of_a_library(tmp_path):
    fake = tmp_path / "libLLVM.so.20"
    fake.write_text("not a library")
    assert library_version(str(fake)) is None
    assert library_version(str(tmp_path / "missing.so")) is None
    assert library_version(str(tmp_path)) is None
    assert library_version("libc.so.6") is None  # a library, but another one


def test_array_module():
    for name in ("metal", "scalar_rgb"):
        with pytest.raises(UsageError, match=f'the variant "{name}" is not vectorised'):
            runtime.array_module(name)
    for name in ("llvm", "llvm_ad_rgb", "llvm_ad_spectral_double"):
        assert runtime.array_module(name).__name__ == "drjit.llvm.ad"
    if not dr.has_backend(dr.JitBackend.CUDA):
        assert runtime.array_module() is runtime.array_module("llvm")
        for name in ("cuda", "cuda_ad_rgb"):
            with pytest.raises(DiffindError, match=f'the variant "{name}" needs an NVIDIA GPU'):
                runtime.array_module(name)


def python(code, setting=None, arguments=(), **extra):
    """Run ``code``; never accept that the process was killed by a signal."""
    environ = {k: v for k, v in os.environ.items() if k != ENV} | extra
    if setting is not None:
        environ[ENV] = setting
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode >= 0, f"killed by signal {-done.returncode}:\n{done.stderr}"
    return done


def succeeds(code, setting=None, arguments=(), **extra):
    done = python(code, setting, arguments, **extra)
    assert done.returncode == 0, done.stderr
    return done


def old_library(*versions):
    """An LLVM of one of the given versions on this machine, or skip."""
    for version in versions:
        for pattern in (f"/usr/lib/*-linux-gnu/libLLVM-{version}.so*", f"/usr/lib/llvm-{version}/lib/libLLVM*.so*"):
            for path in sorted(glob.glob(pattern)):
                if (library_version(path) or MIN_LLVM) < MIN_LLVM:
                    return path
    pytest.skip(f"no LLVM {' or '.join(map(str, versions))} on this machine")


@pytest.fixture
def aborting():
    """An old LLVM that Dr.Jit loads all the same, and with which it would abort."""
    return old_library(15, 16, 17, 18)


#: EXR files in a process of one core: by Mitsuba alone, where only one thread computes, and by commands.
ONE_CORE = """
import faulthandler, os, sys
faulthandler.dump_traceback_later(120, exit=True)
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
import mi_diffind, drjit as dr, mitsuba as mi, numpy as np
from mi_diffind.commands import cli
from mi_diffind.fitting import loop as fitting
from mi_diffind.scenes import loading as scenes
from mi_diffind.maps.source import load_source
assert dr.thread_count() == 2
scene, table, folder = sys.argv[1:]
os.chdir(folder)
values = np.random.default_rng(1).random((40, 3, 3), np.float32)
mi.Bitmap(values).write("stock.exr")
assert np.array_equal(np.array(mi.Bitmap("stock.exr")), values)
mi.set_variant("llvm_ad_rgb")
with fitting.cores(True):
    scenes.write_image("ours.exr", values)
    assert np.array_equal(next(iter(load_source("ours.exr").maps)).values, values)
    bitmap = {"type": "bitmap", "filename": "ours.exr", "raw": True}
    assert scenes.load_dict({"type": "diffuse", "reflectance": bitmap}, parallel=False) is not None
    assert dr.thread_count() == 1
    with fitting.all_cores():
        assert dr.thread_count() == 2
    assert dr.thread_count() == 1
assert dr.thread_count() == 2
assert cli.main(["render", scene, "-D", "width=8", "-D", "height=8", "--spp", "1", "-o", "render.exr"]) == 0
assert cli.main(["decode", table, "-o", "decoded.exr", "--map", "roughness"]) == 0
"""

#: Kernels of threads that load a scene cannot be stored: files have at most 16 bytes, as on a full disk.
FULL_DISK = """
import faulthandler, resource, sys
faulthandler.dump_traceback_later(60, exit=True)
resource.setrlimit(resource.RLIMIT_FSIZE, (16, resource.RLIM_INFINITY))
import mi_diffind, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
mi.load_file(sys.argv[1])
print("loaded")
"""

LIGHT = """
import sys
before = set(sys.meta_path)
import mi_diffind
assert not {"drjit", "mitsuba", "numpy"} & set(sys.modules), sorted(sys.modules)
assert len(set(sys.meta_path) - before) == 1
assert mi_diffind.core.runtime.llvm_problem() is None
"""


def test_each_import_is_met_once():
    """A question about an import is none; the finder steps aside after both; what is not there is not there."""
    succeeds(f"""{LIGHT}
import importlib.util, os
chosen, registered = [], []
original = mi_diffind.core.runtime.choose_llvm
mi_diffind.core.runtime.choose_llvm = lambda *a: chosen.append(a) or original(*a)
sys.modules["mi_diffind.plugins"] = plugins = type(sys)("mi_diffind.plugins")
plugins.install = lambda: registered.append(1)
assert importlib.util.find_spec("no_such_module_anywhere") is None
assert importlib.util.find_spec("drjit") is not None and "drjit" not in sys.modules
import drjit
assert len(chosen) == 1 and not registered
import mitsuba
import mitsuba, drjit
assert len(chosen) == 1 and len(registered) == 1
finder = next(f for f in sys.meta_path if f not in before)
assert finder.contexts == {{}}
assert mitsuba.variants() and drjit.detail.llvm_version()[0] >= {MIN_LLVM}
assert os.environ["{ENV}"] or sys.platform != "linux"
{KERNEL}""")


@pytest.mark.parametrize(
    "imports",
    ["import mi_diffind", "import mitsuba, mi_diffind", "import drjit, mi_diffind",
     "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import mi_diffind",
     "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi.set_variant('llvm_ad_spectral'); import mi_diffind"],
    ids=["alone", "after mitsuba", "after drjit", "after a variant", "after two variants"],
)  # fmt: skip
def test_any_order_of_imports(imports):
    done = succeeds(f"{imports}\n{KERNEL}{RENDER}{PRINT_VERSION}")
    assert int(done.stdout.split()[-1]) >= MIN_LLVM
    assert "RuntimeWarning" not in done.stderr


def test_the_old_library_would_abort(aborting):
    """Without this package, the kernel of these tests ends the process."""
    environ = {**os.environ, ENV: aborting}
    done = subprocess.run([sys.executable, "-c", KERNEL], env=environ, capture_output=True, text=True, timeout=300)
    assert done.returncode != 0


@pytest.mark.parametrize(
    "which, first",
    [
        *(("aborting", first) for first in ("", "import drjit; ", "import mitsuba; ")),
        # These load no library that could abort, so what is imported first changes little
        ("missing", ""), ("missing", "import drjit; "), ("damaged", "import mitsuba; "),
        ("14", ""), ("14", "import mitsuba; "),
    ],
)  # fmt: skip
def test_an_unusable_explicit_library_never_aborts(which, first, tmp_path, request):
    """A warning that says what to do, an exception where LLVM is then used, no abort; the setting is left alone."""
    path = str(tmp_path / "libLLVM.so.20")
    if which == "damaged":
        (tmp_path / "libLLVM.so.20").write_text("not a library")
    elif which != "missing":
        path = request.getfixturevalue("aborting") if which == "aborting" else old_library(14)
    code = f"""
{first}import mi_diffind, mitsuba as mi, os, numpy, drjit.llvm.ad
assert os.environ["{ENV}"] == {path!r}
assert "karellen" in mi_diffind.core.runtime.llvm_problem()
mi.set_variant("scalar_rgb")
print("went on")
{TRY_KERNEL}
TensorXf, Array = drjit.llvm.ad.TensorXf, mi_diffind.DifferentiableArray
for use in (
    lambda: mi_diffind.core.runtime.array_module("llvm"),
    lambda: Array((4, 4), 3).alloc(TensorXf),
    lambda: Array.from_numpy(numpy.zeros((4, 1)), TensorXf, storage="uint8"),
):
    try:
        use()
    except (RuntimeError, mi_diffind.DiffindError) as e:
        print("use:", e)
try:
    mi.set_variant("llvm_ad_rgb")
except ImportError as e:
    print("set_variant:", e)
"""
    done = succeeds(code, path)
    warnings = [line for line in done.stderr.splitlines() if "RuntimeWarning" in line]
    assert len(warnings) == 1 and path in warnings[0] and "pip install karellen-llvm-core" in warnings[0]
    assert "went on" in done.stdout and "refused:" in done.stdout and "computed" not in done.stdout
    uses = [line for line in done.stdout.splitlines() if line.startswith("use: ")]
    assert len(uses) == 3 and all(path in line for line in uses)
    assert "set_variant: " in done.stdout


def test_an_unusable_library_behind_a_variant_that_is_set(aborting):
    """Mitsuba has begun to use a library that would abort, and there is no other: exceptions from then on."""
    code = f"""
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import mi_diffind
for make in (lambda: {{"type": "neural_disney"}}, mi.cornell_box, lambda: {{"type": "scene"}}):
    try:
        mi.load_dict(make())
    except Exception as e:
        print("refused:")
{TRY_KERNEL}
"""
    done = succeeds(code, aborting)
    assert (
        done.stdout.count("refused:") == 4
        and "computed" not in done.stdout
        and done.stderr.count("RuntimeWarning") == 1
    )


KERNEL_THAT_RUNS = (
    "import drjit as dr, drjit.llvm as ll; assert (dr.arange(ll.Float, 3) + 1).numpy().tolist() == [1, 2, 3]"
)


@pytest.mark.parametrize(
    "begun, fault",
    [
        (KERNEL_THAT_RUNS, "has run kernels on it"),
        (f"import mitsuba; {KERNEL_THAT_RUNS}", "has run kernels on it"),
        ("import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); b = mi.load_dict({'type': 'diffuse'})", "holds scene"),
    ],
)
def test_too_late(aborting, begun, fault):
    """A kernel has run on an old LLVM, whose code cannot be taken back, or there are objects: importing says so."""
    # Without a setting, Dr.Jit would have to find the old library by itself: the setting is removed after its start.
    code = f"import os, drjit; drjit.detail.llvm_version(); del os.environ['{ENV}']\n"
    done = python(f"{code}{begun}\nprint('ran')\nimport mi_diffind\n", aborting)
    assert "ran" in done.stdout and done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("ImportError: ") and fault in last and "import mi_diffind before" in last


@pytest.mark.parametrize("first", ["drjit", "mitsuba"])
def test_an_old_library_that_drjit_found_is_replaced(aborting, first):
    """Dr.Jit, imported first on Debian 12, takes the system's LLVM 15; it is replaced before anything runs."""
    code = f"import {first}, drjit, os\nprint('first', drjit.detail.llvm_version()[0])\ndel os.environ['{ENV}']\n"
    kept = "import drjit.llvm\nkept = drjit.llvm.Float([1, 2, 3])\n"  # arrays that are made, not computed
    check = "assert drjit.minimum(kept, 2).numpy().tolist() == [1, 2, 2]\n"
    done = succeeds(f"{code}{kept}import mi_diffind\n{check}{KERNEL}{RENDER}{PRINT_VERSION}", aborting)
    lines = done.stdout.split()
    assert int(lines[1]) < MIN_LLVM <= int(lines[-1])


@pytest.mark.parametrize("first", ["", "import drjit", "import mitsuba"])
def test_a_machine_without_any_usable_library(aborting, first):
    """No setting, nothing from pip, an old one in the system: a warning, no abort, other variants work."""
    # The searches are replaced before the package is initialised: its runtime module is loaded on its own first.
    code = f"""
import sys, types
{first}
package = types.ModuleType("mi_diffind")
package.__path__ = [{os.path.dirname(runtime.__file__)!r}]
sys.modules["mi_diffind"] = package
import mi_diffind.core.runtime as runtime
runtime.choose_llvm.__defaults__ = ({{}}, lambda: [], lambda: [{aborting!r}], runtime.library_version)
del sys.modules["mi_diffind"]

import mi_diffind, mitsuba as mi
assert {aborting!r} in runtime.llvm_problem()
mi.set_variant("scalar_rgb")
{TRY_KERNEL}
"""
    done = succeeds(code)
    assert done.stdout.startswith("refused:")
    assert done.stderr.count("RuntimeWarning") == 1 and "pip install karellen-llvm-core" in done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores of a process can be limited on Linux only")
def test_one_core(tmp_path):
    """Mitsuba waits for ever for the content of an EXR file if there is no second thread."""
    tables = ROOT / "scenes" / "assets" / "tiles_filtered.npz"
    done = succeeds(ONE_CORE, arguments=[ROOT / "tests" / "lamp.xml", tables, tmp_path], **{threads.ONE_CORE: ""})
    assert done.stderr.count("this process has one core") == 1


@linux
def test_kernels_that_cannot_be_stored(tmp_path):
    """Dr.Jit's warning waits neither for Python nor for a thread that holds it."""
    done = succeeds(FULL_DISK, arguments=[ROOT / "scenes" / "rust.xml"], DRJIT_CACHE_DIR=str(tmp_path))
    assert done.stdout.split() == ["loaded"] and "I/O error while writing" in done.stderr


def test_loads_and_renders_wait(mi_rgb):
    loaded = md.load_dict(mi_rgb.cornell_box())
    for work in (lambda: mi_rgb.render(loaded, spp=1), lambda: md.load_dict(mi_rgb.cornell_box())):
        done = threading.Event()
        thread = threading.Thread(target=lambda work=work, done=done: (work(), done.set()))
        with threads.LOCK:
            thread.start()
            assert not done.wait(0.3)
            mi_rgb.render(loaded, spp=1)  # the thread that holds the lock goes on
        thread.join()
        assert done.is_set()


def test_scenes_of_threads_end_in_a_turn(mi_rgb):
    """A scene of a thread that nothing refers to ends at the next load or render; one of the main thread at once."""
    kept = []

    def load():
        kept.append(md.load_dict(mi_rgb.cornell_box()))
        mi_rgb.render(kept[-1], spp=1)

    with threads.turn():
        before = len(threads._scenes)
    load()
    assert len(threads._scenes) == before
    thread = threading.Thread(target=load)
    thread.start()
    thread.join()
    for count in (before + 1, before):
        with threads.turn():
            assert len(threads._scenes) == count
        kept.clear()
        assert len(threads._scenes) == count


def test_ctrl_c_while_a_variant_is_imported(monkeypatch):
    """Mitsuba's import loses the exception: the command ends all the same, with one sentence."""

    def import_variant(name):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(runtime.mi, "variant", lambda: None)
    monkeypatch.setattr(runtime.mi, "set_variant", import_variant)
    with pytest.raises(KeyboardInterrupt):
        runtime.use_variant("llvm_ad_rgb")
