"""Studies of ``mi-diffind tradeoff``: each compares candidates by accuracy, bytes and time; ``mi_diffind.tradeoff``.

Each module here that has a ``STUDY`` (:class:`mi_diffind.measure.study.Study`), and each that an entry point of the
group ``mi_diffind.studies`` names, declares one. Studies load plugins, so this package lies above them.
:mod:`.baselines` are the methods that tables compete with, :mod:`.equal_memory` and :mod:`.materials` the contenders of
comparisons in equal bytes, :mod:`.shaded_scenes` the renders of a study.
"""

import argparse
import functools
import importlib
import os
import re
from collections import UserDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..core import discovery
from ..core.errors import UsageError, raised_as
from ..core.files import writable_folder
from ..core.runtime import use_variant
from ..measure.study import Study, Tradeoff


@dataclass
class _Unread:
    """Study of a module of this package that is not imported yet."""

    module: str
    title: str


class Studies(UserDict):
    """Studies by name. Those of this package, which load plugins, are imported when they are looked up."""

    def __getitem__(self, name: str) -> Study:
        if isinstance(self.data[name], _Unread):
            self.data[name] = importlib.import_module(self.data[name].module).STUDY
        return self.data[name]

    def title(self, name: str) -> str:
        """Return the title of a study, without an import."""
        return self.data[name].title


#: Name and title in the class of a study.
_DECLARATION = re.compile('^    name = "(.+)"\n    title = "(.+)"$', re.MULTILINE)


@functools.lru_cache
def studies() -> Studies:
    """Return all studies by name: those of this package, then those of entry points."""
    ours, others = {}, {}
    for name, module in discovery.modules(__name__, ignored=("baselines",)).items():
        if module == f"{__name__}.{name}":
            text = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
            ours |= {n: _Unread(module, title) for n, title in _DECLARATION.findall(text)}
        else:
            others[name] = module
    others = discovery.load(__name__, "STUDY", known=others, expected=Study)
    return Studies({**dict(sorted(ours.items())), **{n: study for n, study in others.items() if n not in ours}})


def tradeoff(
    study: str,
    *sources: str | os.PathLike,
    out: str | os.PathLike = "out",
    quick: bool = False,
    **options,
) -> Tradeoff:
    """Measure time against accuracy, in the variant that is set: ``mi-diffind tradeoff`` in Python.

    - ``study``: ``"disney"``, ``"image"``, ``"sdf"``, … (``mi-diffind tradeoff --help``); ``sources``: its
      positional arguments, as an image or a mesh.
    - ``out``: folder for the table and the pictures; ``quick``: less of everything, times not to be quoted.
    - ``options``: options of the command as keywords, one of several values as a list (``compression=[6, 12]``). An
      option that is a word of Python ends in an underscore (``lambda_=0.5``).

    The result holds figures, lines of text and the paths of the files, and notebooks show its picture. After Ctrl-C, it
    is incomplete. Raises :class:`.UsageError`, :class:`.OutputError`, and what the study's own input raises.
    """
    if study not in studies():
        raise UsageError(f'found the study "{study}", allowed are {", ".join(studies())}')
    chosen = studies()[study]
    parser = _Keywords(prog=f"tradeoff {study}", allow_abbrev=False, add_help=False)
    chosen.add_arguments(parser)
    arguments = parser.parse_args([*map(str, sources), *_words(options)])
    arguments.out, arguments.quick = str(out), quick
    return run(chosen, arguments)


class _Keywords(argparse.ArgumentParser):
    def error(self, message: str):
        raise UsageError(f"{self.prog}: {message}")


def _words(options: dict) -> list[str]:
    """Return keywords as words of the command line."""
    words = []
    for name, value in options.items():
        option = "--" + name.rstrip("_").replace("_", "-")
        for one in value if isinstance(value, (list, tuple)) else [value]:
            if one is True:
                words.append(option)
            elif one is not None and one is not False:
                words.append(f"{option}={one}")
    return words


def run(study: Study, arguments, set_variant: Callable[[], object] = use_variant) -> Tradeoff:
    """Run a study with the arguments of its command, see :func:`tradeoff`.

    ``set_variant()`` sets the variant once the arguments are checked.
    """
    with raised_as(UsageError, ValueError):
        study.check(arguments)
    writable_folder(arguments.out, create=True)
    set_variant()
    import mitsuba as mi

    from .. import plugins
    from ..measure import benchmark, report

    if not plugins.supported(mi.variant()):
        usable = ", ".join(v for v in mi.variants() if plugins.supported(v))
        raise UsageError(f'the plugins do not run in the variant "{mi.variant()}"; use one of {usable}')
    result = study.run(arguments)
    if result is None:
        plan, settings = study.plan(arguments), benchmark.BenchmarkSettings.choose(arguments.quick)
        figures = benchmark.measure(plan, settings, arguments.out)
        result = report.publish(figures, report.write(figures, arguments.out, plan), report.summary(figures))
    return result
