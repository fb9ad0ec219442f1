"""Plan of the study of learned BSDFs: the fits of each material, and the times of its methods."""

from __future__ import annotations

import functools
import time
from pathlib import Path

import mitsuba as mi

from ...measure.bsdf import QUERIES, bsdf_queries, directions
from ...measure.formatting import grid
from ...measure.store import file_name, fingerprint
from ...measure.study import Candidate, Case, Job, Plan
from ...task import fit, load_model
from ...tasks.bsdf import fit as fitting
from ...tasks.bsdf import mixture
from ...tasks.bsdf.model import LearnedBSDF
from ...tasks.bsdf.truth import truth_of
from ...tasks.bsdf.view import SphereView
from .materials import MATERIALS, QUICK

#: Presets, the first is compared with the others.
PRESETS = ("ours", "table", "paper")

#: Steps and batch of the fits of a quick study.
QUICK_FIT = {"steps": 40, "batch": 2**11, "measure_every": 40}

#: Cosines of the angles of incidence at which the noise of sampling is measured.
COSINES = (1.0, 0.7, 0.2)

#: Plugin beside which all are timed.
PEER = {"type": "principled", "roughness": 0.35, "clearcoat": 1.0, "sheen": 0.6}


class BSDFTraining(Job):
    """Fit of one material with one preset, whose table file is kept."""

    separable = True

    def __init__(self, material: str, preset: str, quick: bool):
        self.material, self.preset, self.quick = material, preset, quick
        self.name = f"{material}, {preset}"
        self.path: Path | None = None

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        """Return the record if the folder holds the file of an uninterrupted fit; without ``record``, measure it."""
        if folder is None or not self._file(folder).is_file():
            return None
        self.path = self._file(folder)
        return record or {"seconds": None, **self._measured()}

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        """Fit, write the file, and return the record; ``None`` after Ctrl-C."""
        source, nbytes = MATERIALS[self.material]
        start = time.perf_counter()
        options = QUICK_FIT if self.quick else {}
        fitted = fit("bsdf", source, preset=self.preset, bytes=nbytes, progress=progress, **options)
        if fitted.result.interrupted:
            return None
        seconds = time.perf_counter() - start
        self.path = self._file(Path(folder or "."))
        fitted.save(self.path)
        return {"seconds": seconds, **self._measured()}

    def _measured(self) -> dict:
        """Return bytes, errors and details of the file: also the errors of the proxy alone and of both samplings."""
        model = load_model(self.path, mi.TensorXf)
        truth = truth_of(MATERIALS[self.material][0], model.types)
        errors = dict(model.table.measured)
        if model.bsdf.proxy is not None:
            proxy = LearnedBSDF(model.form, None, model.bsdf.proxy)
            errors["psnr_proxy_db"] = SphereView(truth, model.types).psnr(fitting.cosine(proxy))
        for name, sampled in (("learned", model.mixture), ("native", truth)):
            moments = [mixture.second_moment(truth.value, sampled, truth, model.types, cos) for cos in COSINES]
            errors[f"moment_{name}"] = sum(moments) / len(moments)
        settings = model.table.settings
        details = {key: settings[key] for key in ("form", "symmetry", "steps")}
        return {"bytes": model.table.nbytes, "errors": errors, "details": details}

    def _file(self, folder: Path) -> Path:
        return Path(folder) / f"{file_name(self.name)}.npz"

    def load(self):
        """Return the plugin that reads the file."""
        return mi.load_dict({"type": "neural_bsdf", "filename": str(self.path)})


def plan(materials: tuple[str, ...] = (), quick: bool = False) -> Plan:
    """Return the plan for some materials (default: all), in the current variant."""
    names = materials or (QUICK if quick else tuple(MATERIALS))
    candidates, cases, jobs, ratios = [], [], [], []
    for material in names:
        source = f"{material}: source"
        peer = f"{material}: principled"
        trainings = [BSDFTraining(material, preset, quick) for preset in (PRESETS[:1] if quick else PRESETS)]
        jobs += trainings
        candidates.append(Candidate(source, "source", is_truth=True, in_passes=False, label="source"))
        candidates.append(
            Candidate(
                peer, "Mitsuba", is_reference=True, in_passes=False, label="principled", note="another material"
            )
        )  # fmt: skip
        for job in trainings:
            candidate = Candidate(
                f"{material}: {job.preset}", "learned", job.preset, job=job.name, in_passes=False, label=job.preset
            )
            candidates.append(candidate)
            ratios += [(candidate.name, source), (candidate.name, peer)]
        members = (source, peer, *(f"{material}: {job.preset}" for job in trainings))
        details = {"material": MATERIALS[material][0]}
        queries = functools.partial(_queries, material, trainings)
        cases.append(Case(material, queries, None, details, members, QUERIES))
    package = Path(__file__).resolve().parents[2]
    code = [package / f"{name}.py" for name in ("lookup", "indirection", "fitting")]
    code += [*(package / "tasks" / "bsdf").glob("*.py"), Path(__file__).with_name("materials.py")]
    return Plan(
        study="bsdf",
        title="Learned BSDFs: accuracy against time and bytes",
        candidates=candidates,
        cases=cases,
        queries=QUERIES,
        accuracy="psnr_db",
        accuracy_label="PSNR of a lit sphere, dB",
        ratios=ratios,
        jobs=jobs,
        jobs_fingerprint=fingerprint(code),
        bytes_by_case=True,
        sampled=False,
        table=rows,
    )


def _queries(material: str, trainings: list[BSDFTraining], lanes: int) -> dict:
    bsdfs = {f"{material}: source": mi.load_dict(MATERIALS[material][0]), f"{material}: principled": mi.load_dict(PEER)}
    bsdfs |= {f"{material}: {job.preset}": job.load() for job in trainings}
    return bsdf_queries(bsdfs, directions(lanes), False)


def rows(result: dict) -> list[str]:
    """Return the errors of all fits as lines."""
    cells = [["", "bytes", "PSNR, dB", "proxy, dB", "albedo", "E[w²]/E[w]²", "source's"]]
    for name, candidate in result["candidates"].items():
        e = candidate["errors"]
        if "albedo_excess" not in e:
            continue
        proxy = f"{e['psnr_proxy_db']:.1f}" if "psnr_proxy_db" in e else "–"
        cells.append(
            [name, f"{candidate['bytes']:,}", f"{e['psnr_db']:.1f}", proxy, f"{100 * e['albedo_excess']:.2f}%",
             f"{e['moment_learned']:.2f}", f"{e['moment_native']:.2f}"]
        )  # fmt: skip
    return grid(cells) if len(cells) > 1 else []
