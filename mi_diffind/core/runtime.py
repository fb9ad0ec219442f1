"""Choice of the LLVM library that Dr.Jit loads, and registration of the plugins.

On a CPU, Dr.Jit compiles through LLVM, which it looks for the moment ``drjit`` is imported. Dr.Jit 1.5 accepts LLVM 15
to 18, but the first kernel with a minimum or maximum then aborts the whole process (``Cannot select: fminimum``), which
no ``try`` can catch. :func:`install` therefore chooses the library before that:

1. ``DRJIT_LIBLLVM_PATH``, if the user has set it; 2. the library that pip installed (``karellen-llvm-core``); 3. the
system's, if it is new enough.

If ``drjit`` was imported first and has loaded an unusable version, the choice is made again, as long as no kernel has
run and no scene object exists. If no usable library exists, the LLVM backend is switched off, so that
``mi.set_variant("llvm_…")`` raises instead of aborting later; CUDA variants are not concerned.
"""

import contextlib
import ctypes
import functools
import glob
import importlib.abc
import importlib.metadata
import os
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

from . import compat, threads
from .compat import dr, mi
from .errors import UsageError, raised_as
from .progress import interruptible

ENV = "DRJIT_LIBLLVM_PATH"

#: The oldest LLVM whose code generator knows every instruction that Dr.Jit 1.5 emits.
MIN_LLVM = 19

_SYSTEM_PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
)

_ADVICE = "install one without root by 'pip install karellen-llvm-core' or point DRJIT_LIBLLVM_PATH to one"
_CORRECT = "correct the path, or unset the variable to use the one of 'pip install karellen-llvm-core'"


def library_version(path: str) -> int | None:
    """Return the major version of the LLVM library at ``path``.

    15 if it is older than 16 (when ``LLVMGetVersion`` was added), ``None`` if it is no loadable LLVM library.
    """
    try:
        library = ctypes.CDLL(path)  # RTLD_LOCAL: Dr.Jit's own search does not see it
    except OSError:
        return None
    if not hasattr(library, "LLVMDisposeMessage"):
        return None
    if not hasattr(library, "LLVMGetVersion"):
        return 15
    version = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, version))
    return version[0].value


def pip_libraries() -> list[str]:
    """Return the paths of the LLVM libraries that pip installed into this environment, newest first."""
    paths = []
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        files = importlib.metadata.distribution("karellen-llvm-core").files or ()
        paths += [str(Path(f.locate()).resolve()) for f in files if _named_version(f.name) is not None]
    paths += glob.glob(os.path.join(sys.prefix, "lib", "libLLVM*.so*"))
    return _newest_first(paths)


def system_libraries(patterns=_SYSTEM_PATTERNS) -> list[str]:
    """Return the paths of the LLVM libraries of the operating system, newest first."""
    return _newest_first(path for pattern in patterns for path in glob.glob(pattern))


def _named_version(name: str) -> int | None:
    match = re.fullmatch(r"libLLVM(?:-(\d+))?[\d.]*\.so(?:\.(\d+))?[\d.]*", name)
    return int(match[1] or match[2] or 0) if match else None


def _newest_first(paths) -> list[str]:
    usable = {p for p in paths if _named_version(os.path.basename(p)) is not None and os.path.exists(p)}
    return sorted(usable, key=lambda p: (_named_version(os.path.basename(p)), p), reverse=True)


def choose_llvm(
    environ=os.environ, pip=pip_libraries, system=system_libraries, version=library_version
) -> tuple[str | None, str | None]:
    """Choose the LLVM library: an explicit setting wins, then pip's, then the system's. Changes nothing.

    Returned are its path (``None``: the search is left to Dr.Jit) and, if none is usable, a sentence for the user. The
    arguments exist for tests: the environment, the two searches and the function that reads a version.
    """
    if explicit := environ.get(ENV):
        major, problem = version(explicit), None
        if major is None:
            problem = f"{ENV}={explicit} is not a loadable LLVM library: {_CORRECT}."
        elif major < MIN_LLVM:
            problem = (
                f"{ENV}={explicit} is LLVM {major if major > 15 else '15 or older'}, with which Dr.Jit aborts: "
                f"version {MIN_LLVM} or newer is needed: {_CORRECT}."
            )
        return explicit, problem
    if not sys.platform.startswith("linux"):
        return None, None
    libraries = [*pip(), *system()]
    for path in libraries:
        if (version(path) or 0) >= MIN_LLVM:
            return path, None
    seen = f" (found only {libraries[0]}, which is too old)" if libraries else ""
    return None, f"Dr.Jit's CPU variants need LLVM {MIN_LLVM} or newer and none was found{seen}: {_ADVICE}."


_problem: str | None = None


def llvm_problem() -> str | None:
    """Return the sentence that says why LLVM variants cannot run here, or ``None`` if they can."""
    return _problem


def install(register_plugins: Callable[[], None]) -> None:
    """Make Dr.Jit start with a usable LLVM, and register the plugins as soon as Mitsuba is imported.

    ``import mi_diffind`` calls this, whether Dr.Jit and Mitsuba have been imported already or will be; it imports
    neither.
    """
    hooks = {}
    if "drjit" in sys.modules:
        _correct_llvm()
        threads.settle()
    else:
        hooks["drjit"] = _starting_drjit
    if "mitsuba" in sys.modules:
        register_plugins()
    else:
        hooks["mitsuba"] = functools.partial(_followed_by, register_plugins)
    if hooks:
        sys.meta_path.insert(0, _Hook(hooks))


class _Hook(importlib.abc.MetaPathFinder):
    """Context around the first import of each of some packages.

    A search for a package (``importlib.util.find_spec``) is no import, and an import that fails may be tried again.
    """

    def __init__(self, contexts: dict):
        self.contexts = contexts

    def find_spec(self, name, path=None, target=None):
        if name not in self.contexts:
            return None
        others = (finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self)
        spec = next(filter(None, others), None)
        if spec is None:
            return None
        execute = spec.loader.exec_module

        def exec_module(module):
            with self.contexts.get(name, contextlib.nullcontext)():
                execute(module)
            self.contexts.pop(name, None)

        spec.loader.exec_module = exec_module
        return spec


@contextlib.contextmanager
def _followed_by(action: Callable[[], None]):
    yield
    action()


@contextlib.contextmanager
def _starting_drjit():
    """Surround the import of Dr.Jit, which then uses the library that :func:`choose_llvm` names, or none."""
    path, problem = choose_llvm()
    if problem is None and path is not None:
        os.environ[ENV] = path
    yield
    _correct_llvm()
    threads.settle()


def _correct_llvm() -> None:
    """Make Dr.Jit, which has been imported, use the library that :func:`choose_llvm` names.

    Raises ``ImportError`` with one sentence if Dr.Jit already runs kernels on, or holds objects of, an LLVM that would
    abort. Warns (``RuntimeWarning``) and switches the LLVM backend off if there is no usable library.
    """
    global _problem
    running = compat.llvm_version()  # waits for the asynchronous start
    if running[0] >= MIN_LLVM:
        return
    path, _problem = choose_llvm()
    if _problem is None and path is not None:
        _restart_llvm(path)
    elif running[0] >= 0:
        _problem = _problem or f"Dr.Jit found LLVM {running[0]}, with which it aborts: {_ADVICE}."
        _restart_llvm(None)
    _warn()


def _warn() -> None:
    if _problem:
        warnings.warn(f"LLVM variants are switched off: {_problem}", RuntimeWarning, stacklevel=4)


@contextlib.contextmanager
def _hidden_llvm():
    """Make Dr.Jit's search for LLVM fail while the context is open: an inactive backend raises, an old one aborts."""
    before = dict(os.environ)
    os.environ[ENV] = "(switched off by mi_diffind: no usable LLVM)"
    try:
        yield
    finally:
        os.environ.pop(ENV)
        if ENV in before:
            os.environ[ENV] = before[ENV]


def _restart_llvm(path: str | None) -> None:
    """Stop Dr.Jit's LLVM backend and start it again with the library at ``path`` (``None``: leave it off).

    Dr.Jit has no Python function for this, its library has (:class:`.compat.JitCore`). Variables survive the restart,
    registered scene objects and kernels do not.
    """
    version = compat.llvm_version()
    active = version[0] >= 0
    too_late = (
        f"Dr.Jit already uses LLVM {version[0]}, with which it aborts, and {{}}: import mi_diffind before loading "
        f"a scene or computing anything" + (f", or set {ENV}={path} beforehand." if path else f"; {_ADVICE}.")
    )
    try:
        core = compat.JitCore()
    except (OSError, AttributeError):
        if not active:
            return
        raise ImportError(too_late.format("this version of it cannot be restarted")) from None

    if active:
        if core.launches():
            raise ImportError(too_late.format("has run kernels on it"))
        variants = getattr(sys.modules.get("mitsuba"), "variants", tuple)()  # which may be about to be imported
        if any(core.holds_objects(v) for v in variants if v.startswith("llvm")):
            raise ImportError(too_late.format("holds scene objects"))

    core.shutdown()
    with contextlib.nullcontext() if path else _hidden_llvm():
        if path:
            os.environ[ENV] = path
        core.init(core.LLVM)
    core.init(core.CUDA)


def use_variant(name: str | None = None) -> str:
    """Set the Mitsuba variant ``name`` and return its name.

    ``None`` keeps the variant that is set; if none is set, it is the RGB variant of the GPU if there is one, else of
    the CPU. Raises :class:`.UsageError` if the variant cannot run here.
    """
    default = "cuda_ad_rgb" if dr.has_backend(dr.JitBackend.CUDA) else "llvm_ad_rgb"
    name = name or mi.variant() or default
    if name == mi.variant():
        return name
    if name not in mi.variants():
        raise UsageError(f'the variant "{name}" does not exist; available are {", ".join(mi.variants())}')
    if name.startswith("llvm") and llvm_problem():
        raise UsageError(llvm_problem())
    if name.startswith("cuda"):
        _require_gpu(name)
    problem = f'the variant "{name}" cannot run here'
    # The native import loses a KeyboardInterrupt
    with interruptible() as stop, raised_as(UsageError, ImportError, at=problem):
        mi.set_variant(name)
    if stop.is_set():
        raise KeyboardInterrupt
    return name


def _require_gpu(variant: str) -> None:
    if not dr.has_backend(dr.JitBackend.CUDA):
        raise UsageError(f'the variant "{variant}" needs an NVIDIA GPU and its driver, and none was found')


def array_module(variant: str | None = None):
    """Return the module of differentiable Dr.Jit types to compute with outside of Mitsuba.

    It is ``drjit.llvm.ad`` or ``drjit.cuda.ad``, that of a Mitsuba ``variant``. ``None`` means the variant that is set
    if it is vectorised, else the GPU if there is one. Raises :class:`.UsageError` if that cannot run here.
    """
    if variant is None:
        active = ("mitsuba" in sys.modules and sys.modules["mitsuba"].variant()) or ""
        default = "cuda" if dr.has_backend(dr.JitBackend.CUDA) else "llvm"
        variant = active if active.startswith(("cuda", "llvm")) else default
    if variant.startswith("cuda"):
        _require_gpu(variant)
        import drjit.cuda.ad as module
    elif variant.startswith("llvm"):
        if not dr.has_backend(dr.JitBackend.LLVM):
            raise UsageError(llvm_problem() or f"Dr.Jit could not start its LLVM backend: {_ADVICE}.")
        import drjit.llvm.ad as module
    else:
        raise UsageError(f'the variant "{variant}" is not vectorised; use one that begins with "llvm" or "cuda"')
    return module
