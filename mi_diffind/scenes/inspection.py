"""Description of a table file, or of all plugins of this package in a scene: ``mi_diffind.inspect``."""

import itertools
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

import mitsuba as mi

from .. import plugins
from ..arrays.tables import TableError, load_table, read_gathers
from ..core.errors import UsageError, printable
from ..core.runtime import array_module, use_variant
from ..core.units import figure_lines
from ..fitting.task import find_task
from . import loading

#: Facts about how rays meet a shape: key of its report → text.
_RAYS = {"trace": "traced through {}", "index_bytes": "{:,} bytes of index beside the arrays", "decoded": "{}"}


@dataclass
class Inspection:
    """Description of a table file or of a scene.

    ``figures`` are those of ``mi-diffind inspect --json``. Of a table file: ``task``, ``preset``, ``storage``,
    ``bytes``, ``arrays``, ``settings``, ``measured`` and more. Of a scene: ``reports``, one for each plugin of this
    package, with its ``owner`` (the path of its parameters in ``mi.traverse``) and whether it is ``learned``;
    ``learned_plugins``, ``tables`` and ``table_bytes``. ``remarks`` are further lines about a table file, and
    ``usage`` the XML by which a scene reads it.
    """

    figures: dict
    remarks: list[str] = field(default_factory=list)
    usage: list[str] = field(default_factory=list)

    def lines(self, verbose: bool = False) -> list[str]:
        """Return the description as lines of text.

        With ``verbose``, arrays, settings of the training, values of transforms and counts of operations are included.
        """
        lines = (_scene_lines if "reports" in self.figures else _table_lines)(self, verbose)
        return [printable(line) for line in lines]  # strings of the file are among them

    def __str__(self) -> str:
        return "\n".join(self.lines())

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def inspect(file_or_scene, measure: bool = False, *, defines: Mapping[str, object] | None = None) -> Inspection:
    """Describe a table file, or the plugins of this package in a scene, in the variant that is set.

    - ``file_or_scene``: a table file (``.npz``), a scene file (``.xml``), a dictionary, a loaded ``mi.Scene`` or
      another object of Mitsuba.
    - ``measure``: measure the accuracy of a table file in each storage form, against the truth that it was fitted to.
    - ``defines``: values of a scene file's ``<default>`` parameters.

    Raises :class:`.UsageError`, :class:`.TableError` and :class:`.SceneError`.
    """
    use_variant()
    is_file = isinstance(file_or_scene, (str, os.PathLike))
    is_scene_file = is_file and Path(file_or_scene).suffix.lower() == ".xml"
    if defines and not is_scene_file:
        raise UsageError(f"{file_or_scene if is_file else 'defines'}: -D needs a scene file (.xml)")
    if is_file and not is_scene_file:
        return _inspect_table(file_or_scene, measure)
    if measure:
        raise UsageError(f"{file_or_scene if is_file else 'measure'}: --measure needs a table file (.npz)")
    learned, tables, loaded = None, {}, file_or_scene
    if is_scene_file:
        parsed = loading.ParsedScene(file_or_scene, dict(defines or {}))
        learned = parsed.learned_plugins()
        tables = {key: table.nbytes for key, table in parsed.tables(learned).items()}
        loaded = parsed.load(needs=())
    elif isinstance(file_or_scene, dict):
        loaded = loading.load_dict(file_or_scene)
    if not isinstance(loaded, mi.Object):
        raise UsageError(f"inspect: found a {type(loaded).__name__}, allowed are a file, a dictionary and a scene")
    paths, counterparts, reports = object_paths(loaded), plugins.with_counterpart(), []
    owners = owner_names(paths)
    for path, node in paths.items():
        if plugins.origin(node) is not None:
            report = loading.instance_report(node, loaded)
            reports.append({"owner": owners[path], "learned": report["plugin"] in counterparts, **report})
    if learned is None:
        learned = [plugins.origin(instance) for instance in loading.learned_instances(loaded)]
        tables = {
            (r.get("filename") or r.get("preset", ""), r.get("storage", "")): r["table_bytes"]
            for r in reports if r["learned"] and r.get("table_bytes")
        }  # fmt: skip
    return Inspection({
        "file": str(file_or_scene) if is_scene_file else None,
        "learned_plugins": learned,
        "reports": reports,
        "table_bytes": sum(tables.values()),
        "tables": [{"file": name, "storage": storage, "bytes": size} for (name, storage), size in tables.items()],
    })  # fmt: skip


def object_paths(scene) -> dict[str, object]:
    """Return all objects of a loaded scene, each once, by the path of its parameters in ``mi.traverse``.

    The scene's own path is "". Mitsuba names objects without an id ``object_…``, by their address.
    """

    class Paths(mi.TraversalCallback):
        """Callback that holds what it visits: a class that did would keep the scene until garbage is collected."""

        def __init__(self, prefix: str, paths: dict, visited: set):
            super().__init__()
            self.prefix, self.paths, self.visited = prefix, paths, visited

        def put(self, name, value, flags, cpptype=None):
            if isinstance(value, mi.Object):
                self.put_object(name, value, flags)

        def put_value(self, name, value, flags, cpptype):
            pass

        def put_object(self, name, value, flags):
            if value is None or value in self.visited:
                return
            self.visited.add(value)
            path = f"{self.prefix}{name}"
            numbered = (f"{path}_{i}" for i in itertools.count(1))
            path = next(p for p in itertools.chain([path], numbered) if p not in self.paths)
            self.paths[path] = value
            value.traverse(Paths(f"{path}.", self.paths, self.visited))

    paths = {"": scene}
    scene.traverse(Paths("", paths, {scene}))
    return paths


def owner_names(paths: dict[str, object]) -> dict[str, str]:
    """Return the name of each path for people.

    A path that begins with an address begins instead with the first id on it, else with the plugin in parentheses.
    """
    owners: dict[str, str] = {}
    for path, node in paths.items():
        parent, _, name = path.rpartition(".")
        if not re.match(r"object_\d+|$", path):
            owners[path] = path
        elif node.id() and not node.id().startswith("_unnamed") and owners.get(parent, "(").startswith("("):
            owners[path] = node.id()
        elif parent:
            owners[path] = f"{owners[parent]}.{name}"
        else:
            label = plugins.origin(node)["plugin"] if plugins.origin(node) else node.class_name()
            numbered = (f"({label} {i})" for i in itertools.count(2))
            owners[path] = next(o for o in itertools.chain([f"({label})"], numbered) if o not in owners.values())
    return owners


def _inspect_table(file, measure: bool) -> Inspection:
    task = find_task(load_table(file))
    table = task.load(file)
    dtype = array_module().TensorXf
    arrays = {}
    for name, array in table.arrays.items():
        values, (*resolution, channels) = array.values, array.shape
        arrays[name] = {
            "resolution": resolution,
            "channels": channels,
            "storage": array.storage,
            "bytes": array.nbytes,
            "bits": 8 * array.entries.itemsize if array.bits == 8 else array.bits,
            "gathers_per_read": read_gathers(table, name),
            "min": float(values.min()),
            "max": float(values.max()),
        }
    figures, remarks = task.model(table, dtype).describe()
    measured = {}
    for form in task.model(table, dtype).forms if measure else ():
        model = task.model(table, dtype, form)
        size = {"bytes": model.nbytes, "memory_bytes": model.memory_nbytes}
        measured[model.storage] = {**size, **model.measure()}
        bad = [name for name, value in measured[model.storage].items() if value != value]
        if bad:
            raise TableError(f"{file}: as {model.storage}, {', '.join(bad)} is no number: values are not finite")
    figures = {
        "file": str(file), "task": table.task, "preset": table.preset, "storage": table.storage, "bytes": table.nbytes,
        "arrays": arrays, "settings": table.settings, "seed": table.seed, "measured": table.measured, **figures,
        **({"measured_in_each_form": measured} if measured else {}),
    }  # fmt: skip
    return Inspection(figures, remarks, task.usage(table, Path(file).name))


def _table_lines(inspection: Inspection, verbose: bool) -> list[str]:
    f = inspection.figures
    preset = f', preset "{f["preset"]}"' if f["preset"] else ""
    lines = [f'{f["file"]}: tables for the task "{f["task"]}"{preset}, {f["bytes"]:,} bytes as {f["storage"]}']
    for name, array in f["arrays"].items() if verbose else ():
        size = " x ".join(map(str, array["resolution"]))
        lines.append(
            f"  {name:22} {size:>9}, {array['channels']} channels, {array['bytes']:6,} bytes as {array['storage']}, "
            f"{array['gathers_per_read']} gathers a read, values {array['min']:.4g} to {array['max']:.4g}"
        )
    lines += [f"  {line}" for line in inspection.remarks]
    if verbose:
        settings = {k: v for k, v in f["settings"].items() if not isinstance(v, (dict, list))} | {"seed": f["seed"]}
        lines.append("  trained with: " + ", ".join(f"{k} {v}" for k, v in settings.items()))
    if f["measured"]:
        lines += ["  measured after the training:", *(f"    {line}" for line in figure_lines(f["measured"]))]
    for storage, measured in f.get("measured_in_each_form", {}).items():
        errors = {k: v for k, v in measured.items() if k not in ("bytes", "memory_bytes")}
        lines.append(f"  as {storage}: {measured['bytes']:,} bytes ({measured['memory_bytes']:,} in memory)")
        lines += [f"    {line}" for line in figure_lines(errors)]
    return [*lines, *(["in a scene:"] if inspection.usage else []), *(f"  {line}" for line in inspection.usage)]


def _scene_lines(inspection: Inspection, verbose: bool) -> list[str]:
    f = inspection.figures
    learned = sum(report["learned"] for report in f["reports"])
    others = len(f["reports"]) - learned
    counted = _count(learned, "learned plugin") + (f" and {_count(others, 'other')}" if others else "")
    files = _count(len(f["tables"]), "file")
    head = f"{f['file'] or 'scene'}: {counted}, {f['table_bytes']:,} bytes of tables in {files}"
    return [head, *(line for report in f["reports"] for line in _report_lines(report, verbose))]


def _report_lines(report: dict, verbose: bool) -> list[str]:
    given = {k: report[k] for k in ("filename", "channels") if k in report} | report["parameters"]
    lines = [f"  {report['owner']}: {report['plugin']}, {', '.join(_given(given, verbose)) or 'defaults'}"]
    facts = {}
    if report.get("storage"):
        preset = f"preset {report['preset']}, " if report.get("preset") else ""
        facts["table"] = [f"{preset}{report['table_bytes']:,} bytes as {report['storage']}"]
    if "rays" in report:
        facts["rays"], facts["steps"] = _ray_counts(report["rays"])
    elif traced := [text.format(report[key]) for key, text in _RAYS.items() if key in report]:
        facts["rays"] = [", ".join(traced)]
    if "effects_in_use" in report:
        facts["in use"] = [", ".join(report["effects_in_use"]) or "grazing reflection only"]
        by_reason: dict[str, list[str]] = {}
        for effect, reason in report.get("effects_left_out", {}).items():
            by_reason.setdefault(reason, []).append(effect)
        facts["left out"] = [", ".join(f"{', '.join(names)} ({why})" for why, names in by_reason.items()) or "nothing"]
    for method, n in report["operations"].items() if verbose else ():
        facts[method] = [
            f"{n['gathers']} reads of {n['bytes_gathered']} bytes, {n['flops']} flops "
            f"({n['add']} add, {n['mul']} mul, {n['div']} div, {n['sqrt']} sqrt), {n['instructions']} instructions"
        ]
    return lines + [f"    {name:9} {line}" for name, text in facts.items() for line in text]


def _given(parameters: dict, verbose: bool) -> list[str]:
    """Return parameters as text: numbers in short, of transforms and other lists the name alone."""

    def text(name: str, value) -> str:
        if isinstance(value, list) and isinstance(value[0], list) and not verbose:
            return name
        return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"

    return [text(name, value) for name, value in parameters.items()]


def _ray_counts(n: dict) -> tuple[list[str], list[str]]:
    """Return lines about what camera rays read of a field (:func:`mi_diffind.tasks.radiance.march.count`)."""
    total = max(1, n["steps"])
    return [f"{n['crossing']:,} of {n['rays']:,} cross the field, {n['opaque']:,} of them end opaque"], [
        f"{n['steps']:,}: {n['hidden'] / total:.0%} hidden, {n['skipped'] / total:.0%} skipped as empty, "
        f"{n['looks'] / total:.0%} read; the radiance at {n['colours'] / total:.0%}"
    ]


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
