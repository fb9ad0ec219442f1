"""``mi-diffind inspect``: the content of a table file, or the learned plugins of a scene."""

from __future__ import annotations

from pathlib import Path

from ..errors import UsageError
from ..runtime import array_module
from ..task import task_of
from .common import scene_options, set_variant, verb

#: What there is to say about how rays meet a shape: keys of its report.
_RAYS = {
    "trace": "traced through", "index_bytes": "bytes of index beside the arrays:", "decoded": "",
}  # fmt: skip

HELP = "say what is in a table file, or which learned plugins a scene uses"


def add(commands) -> None:
    """Add the verb and its options to ``commands``, the subparsers of the command line."""
    sub = verb(commands, "inspect", run, HELP)
    sub.add_argument("file", metavar="FILE.npz|SCENE.xml")
    sub.add_argument("--measure", action="store_true", help="measure the accuracy of tables in each storage form")
    scene_options(sub, rendering=False)


def run(arguments) -> dict:
    """Print what the file holds and return it.

    Raises :class:`UsageError`, and :class:`~mi_diffind.tables.TableError` or :class:`~mi_diffind.scenes.SceneError` for
    a file that cannot be read.
    """
    if Path(arguments.file).suffix.lower() == ".xml":
        if arguments.measure:
            raise UsageError(f"{arguments.file}: --measure needs a table file (.npz)")
        return _inspect_scene(arguments)
    if arguments.defines:
        raise UsageError(f"{arguments.file}: -D needs a scene file (.xml)")
    return _inspect_table(arguments)


def _inspect_table(arguments) -> dict:
    from ..tables import gathers_of, load_table

    task = task_of(load_table(arguments.file))
    table = task.load(arguments.file)
    set_variant(arguments.variant)
    dtype = array_module(arguments.variant).TensorXf
    preset = f', preset "{table.preset}"' if table.preset else ""
    print(f'{arguments.file}: tables for the task "{task.name}"{preset}, {table.nbytes:,} bytes as {table.storage}')
    arrays = {}
    for name, array in table.arrays.items():
        values, (*resolution, channels) = array.values, array.shape
        arrays[name] = {
            "resolution": resolution,
            "channels": channels,
            "storage": array.storage,
            "bytes": array.nbytes,
            "bits": 8 * array.entries.itemsize if array.bits == 8 else array.bits,
            "gathers_per_read": gathers_of(table, name),
            "min": float(values.min()),
            "max": float(values.max()),
        }
        size = " x ".join(map(str, resolution))
        print(
            f"  {name:22} {size:>9}, {channels} channels, {array.nbytes:6,} bytes as {array.storage}, "
            f"{arrays[name]['gathers_per_read']} gathers a read, values {values.min():.4g} to {values.max():.4g}"
        )
    model = task.model(table, dtype)
    figures, lines = model.describe()
    settings = {k: v for k, v in table.settings.items() if not isinstance(v, (dict, list))}
    for title, content in (("trained with", {**settings, "seed": table.seed}), ("measured", table.measured)):
        lines.append(f"{title}: " + ", ".join(f"{k} {v}" for k, v in content.items()))
    print("\n".join(f"  {line}" for line in lines))
    measured = {}
    for form in model.forms if arguments.measure else ():
        model = task.model(table, dtype, form)
        figures_of_form = model.measure()
        measured[model.storage] = {"bytes": model.nbytes, "memory_bytes": model.memory_nbytes, **figures_of_form}
        print(f"  as {model.storage}: {model.nbytes:,} bytes ({model.memory_nbytes:,} in memory)")
        for key, value in figures_of_form.items():
            print(f"    {key:28} {value:.5g}")
    return {
        "file": arguments.file,
        "task": table.task,
        "preset": table.preset,
        "storage": table.storage,
        "bytes": table.nbytes,
        "arrays": arrays,
        "settings": table.settings,
        "seed": table.seed,
        "measured": table.measured,
        **figures,
        **({"measured_in_each_form": measured} if measured else {}),
    }


def _print_rays(n: dict) -> None:
    """Print what camera rays read of a radiance field (:class:`mi_diffind.tasks.radiance.march.RayCounts`)."""
    total = max(1, n["steps"])
    print(
        f"    rays      {n['crossing']:,} of {n['rays']:,} cross the field, {n['opaque']:,} of them end opaque\n"
        f"    steps     {n['steps']:,}: {n['hidden'] / total:.0%} hidden, {n['skipped'] / total:.0%} skipped as empty, "
        f"{n['looks'] / total:.0%} read; the radiance at {n['colours'] / total:.0%}"
    )


def _inspect_scene(arguments) -> dict:
    set_variant(arguments.variant)
    from .. import scenes

    parsed = scenes.ParsedScene(arguments.file, dict(arguments.defines))
    learned = parsed.learned_plugins()
    tables = parsed.tables(learned)
    reports = scenes.reports(parsed.load())
    total = sum(t.nbytes for t in tables.values())
    print(f"{arguments.file}: {len(learned)} learned plugin(s), {total:,} bytes of tables in {len(tables)} file(s)")
    for report in reports:
        given = {k: report[k] for k in ("filename", "channels") if k in report} | report["parameters"]
        given = (f"{k} {v:g}" if isinstance(v, float) else f"{k} {v}" for k, v in given.items())
        stored = f", {report['table_bytes']:,} bytes as {report['storage']}" if report.get("storage") else ""
        print(f"  {report['id'] or '(no id)'}: {report['plugin']}, {', '.join(given) or 'defaults'}")
        print(f"    preset    {report.get('preset') or '(unknown)'}{stored}")
        if "rays" in report:
            _print_rays(report["rays"])
        elif report["kind"] == "shape":
            facts = (f"{text} {report[key]}".strip() for key, text in _RAYS.items() if key in report)
            print("    rays      " + ", ".join(facts))
        else:
            print(f"    in use    {', '.join(report.get('effects_in_use', ())) or 'grazing reflection only'}")
            left_out = ", ".join(f"{k} ({v})" for k, v in report.get("effects_left_out", {}).items())
            print(f"    left out  {left_out or 'nothing'}")
        for method, n in report["operations"].items():
            print(
                f"    {method:9} {n['gathers']} reads of {n['bytes_gathered']} bytes, {n['flops']} flops "
                f"({n['add']} add, {n['mul']} mul, {n['div']} div, {n['sqrt']} sqrt), {n['instructions']} instructions"
            )
    return {
        "file": arguments.file,
        "learned_plugins": learned,
        "reports": reports,
        "table_bytes": total,
        "tables": [{"file": f, "storage": s, "bytes": t.nbytes} for (f, s), t in tables.items()],
    }
