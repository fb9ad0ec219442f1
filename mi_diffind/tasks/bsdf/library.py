"""Fit of a library: a folder of sources, or all materials of a scene, one table file for each."""

from __future__ import annotations

import dataclasses
import gc
import hashlib
import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

from ... import __version__
from ...arrays.tables import load_table
from ...core import compat
from ...core.errors import DiffindError, UsageError
from ...core.files import irregular, relative_path, shown, writable_folder, write_json
from ...core.jobs import run_jobs
from ...core.runtime import use_variant
from ...core.units import memory
from ...fitting.task import FitRequest, Fitted, Model, fit, load_model
from ...measure.report import grid
from .files import load
from .fit import use_rgb_variant
from .functions import is_table
from .shifted_gamma import may_hold_fits
from .truth import SUFFIXES, material_ids

#: Material that stands for all of a scene.
ALL = "all"

#: Columns of the printed table: heading → text of a material's record.
COLUMNS = {
    "bytes": lambda m: f"{m['bytes']:,}",
    "accuracy": lambda m: f"{m['psnr_db']:.1f} dB" if "psnr_db" in m else f"error {100 * m['relative_error']:.2g}%",
    "floor": lambda m: (
        f"{m['psnr_symmetric_part_db']:.1f} dB" if "psnr_symmetric_part_db" in m
        else f"{100 * m['relative_error_floor']:.2g}%" if "relative_error_floor" in m else "–"
    ),
    "albedo": lambda m: f"{100 * m['albedo_excess']:+.2f}%" if "albedo_excess" in m else "–",
    "moment": lambda m: f"{m['sample_weight_moment']:.2f}",
    "seconds": lambda m: "" if m["seconds"] is None else f"{m['seconds']:.0f}",
}  # fmt: skip


@dataclass(frozen=True)
class LibraryMaterial:
    """Material of a library: its source, and how it is to be fitted.

    ``options`` are those of :func:`.task.fit`; ``identity`` stands for the content of the source and all
    options, "" if the source cannot be read.
    """

    source: str
    material: str
    path: str
    preset: str
    variant: str
    options: dict
    identity: str = ""


@dataclass(repr=False)
class FittedLibrary(Fitted):
    """Result of a library: one table file in ``folder`` for each of the ``materials`` (name → figures) that succeeded.

    The files are written already. ``interrupted``: by Ctrl-C; the same call continues.
    """

    folder: Path = Path()
    materials: dict[str, dict] = field(default_factory=dict)
    seconds: float = 0.0
    interrupted: bool = False

    @property
    def models(self) -> dict[str, Model]:
        """Model of each file."""
        types = self.request.types
        files = {name: m["file"] for name, m in self.materials.items() if m["file"]}
        return {name: load_model(self.folder / file, types.TensorXf) for name, file in files.items()}

    @property
    def model(self) -> Model:
        """Raise :class:`UsageError`: there are several (:attr:`models`)."""
        raise UsageError(f"model: {len(self.materials)} materials were fitted, models has one for each")

    @property
    def history(self) -> list[dict]:
        """An empty list: the histories of the trainings are not kept."""
        return []

    @property
    def report(self) -> dict:
        """All figures of the library; ``failed`` is the number of materials that have no file."""
        count = {s: sum(m["status"] == s for m in self.materials.values()) for s in ("fitted", "kept", "failed")}
        return {
            "interrupted": self.interrupted,
            "task": "bsdf",
            **count,
            "bytes": sum(m["bytes"] for m in self.materials.values() if m["file"]),
            "seconds": self.seconds,
            "materials": self.materials,
        }

    def save(self, path: str | os.PathLike) -> Path:
        """Return the folder: all files are written as soon as they are fitted."""
        return self.folder

    def summary(self, path: str | os.PathLike = "FOLDER") -> list[str]:
        """Return the result as lines of text: a table of the materials, and the sentences of those that failed."""
        report, left = self.report, sum(m["status"] == "left" for m in self.materials.values())
        counts = [f"{report['fitted']} fitted", f"{report['kept']} kept from before", f"{report['failed']} failed"]
        counts += [f"{left} left: the same command continues"] if left else []
        lines = [f"{path}: {len(self.materials)} materials: {', '.join(counts)}; {self.seconds:.0f} s"]
        cells = [[text(m) if m["file"] else "–" for text in COLUMNS.values()] for m in self.materials.values()]
        rows = [[name, m["status"], *row] for (name, m), row in zip(self.materials.items(), cells, strict=True)]
        lines += grid([["material", "status", *COLUMNS], *rows])
        lines += [f"  {name}: {m['failure']}" for name, m in self.materials.items() if m["failure"]]
        lines += [f"  {name}: {remark}" for name, m in self.materials.items() for remark in m.get("remarks", ())]
        return lines


def is_library(request: FitRequest) -> bool:
    """Return whether the source of a request is a folder, or all materials of a scene are asked for."""
    source = request.options["source"]
    return request.options["material"] == ALL or (isinstance(source, (str, os.PathLike)) and Path(source).is_dir())


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not suit a library, or are only those of one."""
    if not is_library(request):
        for name in ("workers", "scheduler"):
            if request.options[name]:
                raise UsageError(
                    f'{name}: given for a single BSDF; a library is a folder, or a scene with material "{ALL}"'
                )
        if request.output is not None and request.output.suffix.lower() != ".npz":
            raise UsageError(f'output "{request.output}": found a folder for a single BSDF, a .npz file is needed')
        return
    if request.output is None or request.output.suffix.lower() == ".npz":
        raise UsageError(f"output: found {request.output or 'none'}, a library is written to a folder")
    if request.options["over"]:
        raise UsageError("over: given for a library, a family is fitted to a single BSDF")
    if request.checkpoint is not None:
        raise UsageError("checkpoint: given for a library, which the same command continues without one")
    if request.deadline is not None:
        raise UsageError("seconds: given for a library, which is limited by steps alone")


def fit_library(request: FitRequest) -> FittedLibrary:
    """Fit all materials of a library that its folder does not hold yet, and write its report.

    Raises :class:`UsageError` and :class:`.OutputError`.
    """
    use_rgb_variant(request)
    start, options = time.perf_counter(), request.options
    folder = writable_folder(request.output, create=True)
    materials, broken = find_materials(request, folder)
    records = {name: _record(m, folder, "left") for name, m in materials.items()}
    records |= {name: _record(None, folder, "failed", failure) for name, failure in broken.items()}
    for name, material in materials.items():
        if _is_fitted(material):
            records[name] = _record(material, folder, "kept")
    todo = {name: m for name, m in materials.items() if records[name]["status"] == "left"}
    outcomes = run_jobs(
        fit_material, todo, options["workers"], options["scheduler"], request.progress,
        "materials", "material", len(materials) - len(todo),
    )  # fmt: skip
    for outcome in outcomes:
        status = "failed" if outcome.failure else "fitted"
        records[outcome.name] = _record(todo[outcome.name], folder, status, outcome.failure, outcome.value)
    interrupted = any(r["status"] == "left" for r in records.values())
    library = FittedLibrary(None, None, request=request, folder=folder, materials=records, interrupted=interrupted)
    library.seconds = time.perf_counter() - start
    write_json(folder / "report.json", library.report)
    return library


def find_materials(request: FitRequest, folder: Path) -> tuple[dict[str, LibraryMaterial], dict[str, str]]:
    """Return the materials of a library by name, and the sentences of sources without any.

    Names are those of the files, of the ids of a scene's materials or of networks, or of both, in letters that all file
    systems take. Table files in a folder are no sources.
    Raises :class:`UsageError` if there are none.
    """
    import mitsuba as mi

    source, every = Path(request.options["source"]), request.options["material"] == ALL
    files = [source]
    if source.is_dir():
        files = (f for f in source.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
        files = sorted(f for f in files if not f.is_dir() and _may_be_source(f))
        if not files:
            raise UsageError(f"{source}: holds no sources, allowed are files that end in {', '.join(SUFFIXES)}")
    given = {**request.options, **dataclasses.asdict(request.settings)}
    for name in ("source", "material", "workers", "scheduler"):  # where and how a library is fitted, and not what
        del given[name]
    common = [given, request.preset, mi.variant(), __version__, mi.__version__]
    names: set[str] = set()
    materials, broken = {}, {}
    for file in files:
        try:
            if fault := irregular(file, memory() // 4):
                raise UsageError(f"{shown(file)}: {fault}")
            ids = material_ids(file) if file.suffix.lower() in (".npz", ".json", ".xml" if every else "") else [""]
        except DiffindError as e:
            broken[_free_name(file.stem, names)] = str(e)
            continue
        content = _content(file)
        for material in ids:
            parts = [file.stem] if len(files) > 1 or not material else []
            name = _free_name("_".join([*parts, *filter(None, [material])]), names)
            chosen = material or (request.options["material"] if not every else "")
            materials[name] = LibraryMaterial(
                str(file.resolve()), chosen, str(folder.resolve() / f"{name}.npz"), request.preset, mi.variant(),
                given, _identity(content, [chosen, *common]),
            )  # fmt: skip
    return materials, broken


def _may_be_source(file: Path) -> bool:
    """Return whether a file with an extension of sources is neither a table file nor JSON of something else."""
    if file.suffix.lower() == ".npz":
        return not is_table(file)
    return file.suffix.lower() != ".json" or may_hold_fits(file)


def _free_name(text: str, names: set[str]) -> str:
    """Return a name for a file, and add it to the ``names``, which are compared without their case."""
    safe = "".join(c if c.isascii() and (c.isalnum() or c in "-_.") else "_" for c in text).strip(".")[:80] or "_"
    name, k = safe, 2
    while name.lower() in names:
        name, k = f"{safe}-{k}", k + 1
    names.add(name.lower())
    return name


def _identity(content: str, options: list) -> str:
    """Return a hash of a ``content`` and of ``options``, "" for none."""
    text = json.dumps([content, *options], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest() if content else ""


def _content(file: Path) -> str:
    """Return a hash of the content of a source, and of the files that XML includes or names, "" on any error."""
    digest, files = hashlib.sha256(), [file]
    try:
        if file.suffix.lower() == ".xml":
            _, state = compat.parse_file(file)
            properties = compat.parsed_properties(state)
            texts = {props[k] for props in properties for k in props if compat.property_kind(props, k) == "text"}
            named = (file.parent / text for text in sorted(texts) if 0 < len(text) < 1000)
            files = [*map(Path, compat.parsed_files(state)), *(path for path in named if path.is_file())]
        for one in dict.fromkeys(files):
            digest.update(one.name.encode() + b"\0" + one.read_bytes() + b"\0")
    except Exception:  # Mitsuba raises several types; the fit says what is wrong
        return ""
    return digest.hexdigest()


def _is_fitted(material: LibraryMaterial) -> bool:
    """Return whether the file of a material exists, was fitted to the same source, and can be read."""
    try:
        identity = load(material.path).settings.get("identity")
    except DiffindError:
        return False
    return bool(material.identity) and identity == material.identity


def fit_material(material: LibraryMaterial) -> float:
    """Fit a material and write its file, in the variant that it names.

    Returns the duration in seconds. Raises ``KeyboardInterrupt`` if Ctrl-C interrupted the training.
    """
    use_variant(material.variant)
    start, path = time.perf_counter(), Path(material.path)
    fitted = fit(
        "bsdf", material.source, preset=material.preset, material=material.material, progress=False, output=path,
        **material.options,
    )  # fmt: skip
    if fitted.result.asked_to_stop:
        raise KeyboardInterrupt
    fitted.table.settings["identity"] = material.identity
    fitted.save(path)
    del fitted
    gc.collect()
    return time.perf_counter() - start


def _record(material: LibraryMaterial | None, folder: Path, status: str, failure: str = "", seconds=None) -> dict:
    record = {"status": status, "failure": failure, "source": "", "material": "", "file": "", "bytes": 0}
    if material is not None:
        record |= {"source": relative_path(material.source, folder), "material": material.material}
        if status in ("fitted", "kept"):
            table = load_table(material.path)
            record |= {"file": Path(material.path).name, "bytes": table.nbytes, **table.measured, "seconds": seconds}
            record["remarks"] = table.settings.get("remarks", [])
    return record
