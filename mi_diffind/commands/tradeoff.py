"""``mi-diffind tradeoff``: time against accuracy of all forms of a task, or of a scene."""

from __future__ import annotations

from ..errors import UsageError
from ..files import writable_folder
from ..studies import studies
from .common import alternative, alternatives, require_scene, scene_options, set_variant, variant_option, verb

HELP = "measure time against accuracy, of all forms of a task or of a scene"

EXAMPLE = "mi-diffind tradeoff ggx --quick --out out"


def add(commands) -> None:
    """Add the verb and the studies that are found to ``commands``, the subparsers of the command line."""
    parsers = alternatives(verb(commands, "tradeoff", run, HELP, EXAMPLE), "study")
    for name, study in studies().items():
        words = " ".join(filter(None, ("mi-diffind tradeoff", name, study.example, "--quick --out out")))
        sub = alternative(parsers, name, f"measure time against accuracy of {study.title}", words)
        sub.add_argument("--out", default="out", metavar="DIR", help="folder for table and plot (default: out)")
        sub.add_argument("--quick", action="store_true", help="smoke run: less of everything, times not to be quoted")
        if study.of_scene:
            sub.add_argument("scene", metavar="SCENE.xml")
            scene_options(sub, rendering=False)
        else:
            variant_option(sub)
        study.add_arguments(sub)


def run(arguments) -> dict:
    """Measure, write table and plot, and return the result with its ``files``; after Ctrl-C, the part that is done.

    Raises :class:`UsageError`, :class:`~mi_diffind.files.OutputError`, and what the study's own input raises
    (:class:`~mi_diffind.maps.source.SourceError`, :class:`~mi_diffind.scenes.SceneError`).
    """
    study = studies()[arguments.study]
    if study.of_scene:
        require_scene(arguments.scene)
        arguments.defines = dict(arguments.defines)
    try:
        study.check(arguments)
    except ValueError as e:
        raise UsageError(str(e)) from None
    writable_folder(arguments.out, create=True)
    set_variant(arguments.variant)
    import mitsuba as mi

    from .. import plugins

    if not plugins.supported(mi.variant()):
        usable = ", ".join(v for v in mi.variants() if plugins.supported(v))
        raise UsageError(f'the plugins do not run in the variant "{mi.variant()}"; use one of {usable}')
    return study.run(arguments) or _measure(study.plan(arguments), arguments)


def _measure(plan, arguments) -> dict:
    from ..measure import benchmark, report

    result = benchmark.measure(plan, benchmark.BenchmarkSettings.choose(plan.variant, arguments.quick), arguments.out)
    return report.publish(result, report.write(result, arguments.out, plan), report.summary(result, plan))
