"""Plan of the study of learned BSDFs: the fits of each material, and the times of its methods."""

from __future__ import annotations

import time
from pathlib import Path

import mitsuba as mi

from ...fitting.task import fit, load_model
from ...measure.bsdf import bsdf_queries, directions
from ...measure.formatting import grid
from ...measure.store import file_name, fingerprint
from ...measure.study import Candidate, Case, Job, Plan
from ...tasks.bsdf import mixture
from ...tasks.bsdf.directions import SphereView
from ...tasks.bsdf.model import LearnedBSDF
from ...tasks.bsdf.truth import truth_of
from .materials import MATERIALS, QUICK
from .networks import INPUTS, NetworkTraining

#: Presets, the first is compared with the others.
PRESETS = ("ours", "table", "paper", "plain")

#: Methods that are timed.
QUERIES = ("eval", "eval_pdf", "sample")

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
            errors["psnr_proxy_db"] = SphereView(truth, model.types).psnr(proxy.cosine_value)
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

    def scale(self) -> tuple[float, float]:
        """Return the scale of the coordinate u of the fitted file."""
        return load_model(self.path, mi.TensorXf).form.scale


def plan(materials: tuple[str, ...] = (), quick: bool = False) -> Plan:
    """Return the plan for some materials (default: all), in the current variant."""
    names = materials or (QUICK if quick else tuple(MATERIALS))
    candidates, cases, jobs, ratios = [], [], [], []
    for material in names:
        case, its_candidates, its_jobs = _material(material, quick)
        cases.append(case)
        candidates += its_candidates
        jobs += its_jobs
        references = [c.name for c in its_candidates if c.is_truth or c.is_reference]
        learned = [c.name for c in its_candidates if c.name not in references]
        ratios += [(name, reference) for name in learned for reference in references]
    package = Path(__file__).resolve().parents[2]
    code = [package / f"{name}.py" for name in ("arrays/lookup", "arrays/indirection", "fitting/loop")]
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


def _material(material: str, quick: bool) -> tuple[Case, list[Candidate], list[Job]]:
    """Return the case of a material, its candidates and their jobs."""
    source, nbytes = MATERIALS[material]
    trainings = [BSDFTraining(material, preset, quick) for preset in (PRESETS[:1] if quick else PRESETS)]
    networks = []
    if not quick and nbytes == "2k":
        networks = [NetworkTraining(material, source, inputs, trainings[0].scale) for inputs in INPUTS]

    def learned(job, label: str, representation: str, **options) -> Candidate:
        return Candidate(
            f"{material}: {label}", representation, label, job=job.name, in_passes=False, label=label, **options
        )

    candidates = [
        Candidate(f"{material}: source", "source", is_truth=True, in_passes=False, label="source"),
        Candidate(
            f"{material}: principled", "Mitsuba", is_reference=True, in_passes=False, label="principled",
            note="another material",
        ),
        *(learned(job, job.preset, "learned") for job in trainings),
        *(
            learned(job, f"network, {inputs}", "network", queries=("eval",))
            for job, inputs in zip(networks, INPUTS, strict=False)
        ),
    ]  # fmt: skip

    def queries(lanes: int) -> dict:
        bsdfs = {f"{material}: source": mi.load_dict(source), f"{material}: principled": mi.load_dict(PEER)}
        bsdfs |= {f"{material}: {job.preset}": job.load() for job in trainings}
        bsdfs |= {f"{material}: network, {i}": job.bsdf() for job, i in zip(networks, INPUTS, strict=False)}
        return bsdf_queries(bsdfs, directions(lanes), False)

    members = tuple(candidate.name for candidate in candidates)
    return (
        Case(material, queries, None, {"material": source}, members, QUERIES),
        candidates,
        [*trainings, *networks],
    )


def rows(result: dict) -> list[str]:
    """Return the errors of all fits as lines."""
    cells = [["", "bytes", "PSNR, dB", "proxy, dB", "albedo", "E[w²]/E[w]²", "source's"]]
    for name, candidate in result["candidates"].items():
        e = candidate["errors"]
        if "psnr_db" not in e:
            continue
        cells.append([
            name, f"{candidate['bytes']:,}", f"{e['psnr_db']:.1f}",
            f"{e['psnr_proxy_db']:.1f}" if "psnr_proxy_db" in e else "–",
            f"{100 * e['albedo_excess']:.2f}%" if "albedo_excess" in e else "–",
            *(f"{e[m]:.2f}" if m in e else "–" for m in ("moment_learned", "moment_native")),
        ])  # fmt: skip
    return grid(cells) if len(cells) > 1 else []
