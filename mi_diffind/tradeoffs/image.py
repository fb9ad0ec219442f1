"""
``tradeoff image``: quality of a compressed image or material against bytes, seconds of training and time of a read,
beside what codecs make of the same maps in the same bytes.

Three measurements. *Bytes*: at each compression ratio, indirection into cascaded arrays of 2, 3 and 4 dimensions by our
recipe and the paper's, and codecs (:mod:`mi_diffind.codecs`) at the largest size that is not above; ASTC with one block
size for all maps and with the best that can be had by giving each map its own. *Seconds*: both recipes, trainings of
several lengths, each with a schedule of its own. *Time*: kernels that read all maps of a material at random and at
coherent places, :class:`bitmap` with 8 bits and with floats beside ``neural_image``, in turn, medians of rounds.

Errors are those of values as they are in the source's files; FLIP and SSIM are means over maps, each shown as a
picture.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from .. import codecs, metrics, plot, report, sizing
from ..files import replacing, writable_folder, write_json
from ..interrupt import interruptible
from ..runtime import array_module
from ..tables import save_table
from ..tasks.image import search, training
from ..tasks.image.compressed import CompressedImage
from ..tasks.image.source import Source
from ..tradeoff import fingerprint, kernel_seconds, machine, spread, total

#: What verdicts are about: a name, the error, how it is written, whether more is better.
MEASURES = (
    ("PSNR", "psnr_db", ".2f", True),
    ("between texels", "psnr_between_db", ".2f", True),
    ("mean of maps", "psnr_mean_db", ".2f", True),
    ("FLIP", "flip", ".4f", False),
)

#: ns; what takes less, or less than the floor by noise, is drawn there.
SHORTEST = 0.01

#: What is measured of a candidate so far, until the result is written.
PARTIAL = "tradeoff_image.partial.json"


@dataclass(frozen=True)
class Settings:
    """
    ``compressions`` asked for, ``seconds`` of the trainings, ``paper_seconds`` of those by the paper's recipe, ``dims``
    of the cascaded arrays that are compared (4: all trainings, others: the shortest), ``astc`` the preset of its
    encoder; ``ablation``: also train our recipe with each of its improvements switched off; ``lanes`` and ``rounds`` of
    the reads.
    """

    compressions: tuple[float, ...] = (12.0,)
    seconds: tuple[float, ...] = (60.0,)
    paper_seconds: tuple[float, ...] = (60.0,)
    dims: tuple[int, ...] = (2, 3, 4)
    ablation: bool = False
    astc: str = "exhaustive"
    lanes: int = 2**20
    rounds: int = 21
    quick: bool = False


@dataclass
class _Job:
    """A candidate: a name, what it is, and how it is made; ``make()`` returns (bytes, seconds, maps, what is known)."""

    name: str
    representation: str
    compression: float
    make: object
    random_access: bool = True
    seconds_asked: float | None = None


class _Stopped(Exception):
    """Ctrl-C has been seen."""


def measure(source: Source, name: str, settings: Settings, folder: str | os.PathLike) -> dict:
    """
    Measure, or what is missing, if ``folder`` holds an interrupted run of the same source and settings. The trained
    files stay there, too.

    Returns the result (JSON): ``rows``, each with ``name``, ``representation``, ``compression`` (asked), ``bytes``,
    ``seconds``, ``random_access`` and ``errors`` (:func:`errors_of`); ``reads``: places → candidate → ``ns_per_read``
    with quartiles and ``ratio`` to the 8-bit bitmap; ``interrupted``. Raises
    :class:`~mi_diffind.files.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    here = Path(__file__).resolve().parents[1]
    sources = [*(here / "tasks" / "image").glob("*.py"), here / "fitting.py", here / "codecs.py", Path(__file__)]
    key = json.loads(json.dumps({
        "source": source.digest, "settings": asdict(settings), "machine": machine(mi.variant()),
        "fingerprint": fingerprint(sources),
    }))  # fmt: skip
    partial, rows, reads = folder / PARTIAL, {}, {}
    if partial.is_file():
        found = json.loads(partial.read_text(encoding="utf-8"))
        if found.get("key") == key:
            rows, reads = found["rows"], found["reads"]
            print(f"going on from {partial}", file=sys.stderr)
    jobs = _jobs(source, settings, folder)
    interrupted = False
    with interruptible() as stop:
        try:
            for i, job in enumerate(jobs):
                if job.name not in rows:
                    print(f"{i + 1} of {len(jobs)}: {job.name}", file=sys.stderr)
                    rows[job.name] = _row(job, source)
                    write_json(partial, {"key": key, "rows": rows, "reads": reads})
                if stop.is_set():
                    raise _Stopped
            if not reads:
                reads = _reads(source, settings, folder, rows, stop)
        except (_Stopped, _Interrupted):
            interrupted = True
    return {
        "task": "image", "source": name, "source_bytes": source.nbytes, "width": source.width, "height": source.height,
        "maps": {m.name: m.channels for m in source.maps}, "settings": asdict(settings), "machine": key["machine"],
        "date": time.strftime("%Y-%m-%d"), "rows": list(rows.values()), "reads": reads, "interrupted": interrupted,
    }  # fmt: skip


class _Interrupted(Exception):
    """A training was interrupted."""


# -- candidates -------------------------------------------------------------------------------------------------------


def _jobs(source: Source, settings: Settings, folder: Path) -> list[_Job]:
    jobs, cache = [], {}
    shortest, ours = min(settings.seconds), training.RECIPES["ours"]
    for compression in settings.compressions:
        mark, first = f"{compression:g}x", compression == settings.compressions[0]

        def train(name: str, recipe, seconds: float, kind="indirection", compression=compression, mark=mark):
            jobs.append(_trained(source, folder, compression, f"{name} {mark} {seconds:g} s", kind, recipe, seconds))

        for seconds in sorted(settings.seconds) if first else [shortest]:
            train("ours", ours, seconds)
        if first:
            for seconds in settings.paper_seconds:
                train("paper", training.RECIPES["paper"], seconds, "indirection, paper's recipe")
            for dims in set(settings.dims) - {4}:
                train(f"ours 2D→{dims}D", dataclasses.replace(ours, dims=dims), shortest)
        if first and settings.ablation:
            for name in training.IMPROVEMENTS:
                train(f"ours without {name}", training.without(ours, [name]), shortest)
        jobs.extend(_codecs(source, compression, settings, cache))
    return jobs


def _trained(source, folder: Path, compression: float, name: str, kind: str, recipe, seconds: float) -> _Job:
    """A training of so many seconds on all cores; its file stays in ``folder``."""
    path = folder / f"image_{''.join(c if c.isalnum() else '_' for c in name)}.npz"

    def make():
        types = array_module("cuda" if mi.variant().startswith("cuda") else "llvm")
        own = training.replaced(recipe, deterministic=False)
        size = search.default_size(source, source.nbytes / compression, own)
        table, result = training.fit_image(source, size, own, title=name, seconds=seconds)
        if result.interrupted:
            raise _Interrupted
        save_table(path, table)
        image = CompressedImage.from_table(table, types.TensorXf)
        structure = training.structure_of(source, own)
        known = {
            "file": str(path), "steps": result.steps, "structure": structure, "dims": size.dims, "rows": size.rows,
            "cascaded": size.cascaded, "errors_between": table.quality["psnr_between_db"],
            "memory_bytes": sum(a.memory_nbytes for a in (*image.net.primary, image.net.cascaded)),
            "course": [(h["step"] * result.seconds / result.steps, h["psnr_db"]) for h in result.history],
        }  # fmt: skip
        return table.nbytes, result.seconds, image.decode(), known

    return _Job(name, kind, compression, make, seconds_asked=seconds)


def _codecs(source: Source, compression: float, settings: Settings, cache: dict) -> list[_Job]:
    """What of the codecs is installed; all maps together take at most the bytes that are asked for."""
    budget, mark = source.nbytes / compression, f"{compression:g}x"
    values = {m.name: _shown(m.values) for m in source.maps}
    found = codecs.available()
    normals = [m.name for m in source.maps if m.kind == "normal"]
    choose = "fast" if settings.quick else "medium"  # presets differ by dB, and not by the same for each block size

    def blocks(uniform: bool):
        def make():
            start = time.perf_counter()
            encoded, nbytes = codecs.astc_material(
                values, budget, settings.astc, uniform, normals, (1, 2), choose, cache, split=False
            )
            known = {"how": {name: e.codec for name, e in encoded.items()}}
            return nbytes, time.perf_counter() - start, {name: e.image for name, e in encoded.items()}, known

        return make

    def files(codec: str):
        def make():
            start, parts = time.perf_counter(), {}
            for name, image in values.items():
                share = budget * image.shape[-1] / source.channels
                parts[name] = codecs.at_bytes(codec, image, int(share))[0]
            nbytes = sum(p.nbytes for p in parts.values())
            known = {"how": {name: p.codec for name, p in parts.items()}}
            return nbytes, time.perf_counter() - start, {name: p.image for name, p in parts.items()}, known

        return make

    def bc7():
        start = time.perf_counter()
        parts = {name: codecs.bc7(image) for name, image in values.items()}
        nbytes = sum(p.nbytes for p in parts.values())
        return nbytes, time.perf_counter() - start, {name: p.image for name, p in parts.items()}, {}

    jobs = []
    if any(v.shape[-1] > 4 for v in values.values()):
        return jobs
    if "astc" in found:
        jobs.append(_Job(f"ASTC {mark}, one block size", "ASTC", compression, blocks(True)))
        if len(values) > 1:
            jobs.append(_Job(f"ASTC {mark}, each map its own", "ASTC", compression, blocks(False)))
    if "bc7" in found and compression == settings.compressions[0]:
        jobs.append(_Job("BC7", "BC7", 0.0, bc7))
    for codec, name, access in (("jpeg", "JPEG", False), ("webp", "WebP", False), ("bicubic", "bicubic", True)):
        if codec in found:
            jobs.append(_Job(f"{name} {mark}", name, compression, files(codec), access))
    return jobs


def _shown(values: np.ndarray) -> np.ndarray:
    """What codecs of 8 bits can hold."""
    return np.clip(values, 0, 1).astype(np.float32)


def _row(job: _Job, source: Source) -> dict:
    nbytes, seconds, maps, known = job.make()
    errors = errors_of(source, maps)
    errors["psnr_between_db"] = known.pop("errors_between", None) or between(source, maps)
    return {
        "name": job.name, "representation": job.representation, "compression": job.compression or None,
        "bytes": nbytes, "ratio": source.nbytes / nbytes, "seconds": seconds, "seconds_asked": job.seconds_asked,
        "random_access": job.random_access, **known, "errors": errors,
    }  # fmt: skip


def errors_of(source: Source, maps: dict[str, np.ndarray]) -> dict:
    """
    ``psnr_db`` of all channels together, ``psnr_mean_db`` over maps, ``flip`` and ``ssim``, means over maps, and of
    each map ``psnr_NAME_db``, ``flip_NAME``, ``ssim_NAME``, of normal maps ``angle_NAME_deg``, the mean angle.
    """
    found, errors, weights = {}, [], []
    for m in source.maps:
        reference, image = _shown(m.values), _shown(np.round(np.clip(maps[m.name], 0, 1) * 255) / 255)
        errors.append(float(np.mean((reference - image) ** 2, dtype=np.float64)))
        weights.append(m.channels)
        found[f"psnr_{m.name}_db"] = -10 * math.log10(max(errors[-1], 1e-12))
        found[f"flip_{m.name}"] = metrics.flip_shown(_picture(reference), _picture(image))
        found[f"ssim_{m.name}"] = metrics.ssim(reference, image)
        if m.kind == "normal" and m.channels == 3:
            found[f"angle_{m.name}_deg"] = metrics.angle(reference, image)

    def mean(measure: str) -> float | None:
        values = [v for k, v in found.items() if k.startswith(f"{measure}_")]
        return float(np.mean(values)) if None not in values else None

    joint = float(np.average(errors, weights=weights))
    return {"psnr_db": -10 * math.log10(max(joint, 1e-12)), "psnr_mean_db": mean("psnr"), "flip": mean("flip"),
            "ssim": mean("ssim"), **found}  # fmt: skip


def between(source: Source, maps: dict[str, np.ndarray]) -> float:
    """PSNR, in dB, of all channels between texels, one place in each: bilinear interpolation of ``maps`` and source."""
    total, random = 0.0, np.random.default_rng(2023)
    a, b = random.random((2, source.height, source.width, 1), dtype=np.float32)
    for m in source.maps:
        e = _shown(maps[m.name]) - _shown(m.values)
        e = (1 - a) * e + a * np.roll(e, -1, axis=0)  # the interpolation of the difference
        e = (1 - b) * e + b * np.roll(e, -1, axis=1)
        total += float(np.mean(e**2, dtype=np.float64)) * m.channels / source.channels
    return -10 * math.log10(max(total, 1e-12))


def _picture(values: np.ndarray) -> np.ndarray:
    """Three channels to look at."""
    if values.shape[-1] >= 3:
        return values[..., :3]
    return np.repeat(values[..., :1], 3, axis=-1)


# -- time of a read ---------------------------------------------------------------------------------------------------


def _reads(source: Source, settings: Settings, folder: Path, rows: dict, stop) -> dict:
    """ns for all maps at a place, in turn: bitmaps of 8 bits and of floats, and the files that were trained."""
    readers = {"bitmap, 8 bits": _bitmaps(source, True), "bitmap, floats": _bitmaps(source, False)}
    for name, row in sorted(rows.items(), key=lambda item: -item[1]["errors"]["psnr_db"]):  # the best of each kind
        if "file" in row and row["compression"] == settings.compressions[0] and Path(row["file"]).is_file():
            key = f"neural_image 2D→{row['dims']}D, {row['structure']}, {row['cascaded']}"
            if key not in readers:
                readers[key] = [
                    (mi.load_dict({"type": "neural_image", "filename": row["file"], "channels": m.name, "raw": True}),
                     m.channels) for m in source.maps
                ]  # fmt: skip
                rows[name]["read"] = key
    n = settings.lanes
    rng = dr.rng(seed=dr.opaque(mi.UInt64, 3))
    index, side = dr.arange(mi.UInt32, n), 2 ** (round(math.log2(n)) // 2)
    places = {
        "random": mi.Point2f(rng.random(mi.Float, n), rng.random(mi.Float, n)),
        "coherent": mi.Point2f(mi.Float(index % side) / source.width, mi.Float(index // side) / source.height),
    }
    found = {}
    bar = tqdm(total=len(places) * settings.rounds, desc="reads", unit="round", disable=None)
    for place, uv in places.items():
        si = dr.zeros(mi.SurfaceInteraction3f, n)
        si.uv = uv
        dr.make_opaque(si.uv)

        def query(textures, si=si):
            return lambda: total([_evaluated(t, si, c) for t, c in textures])[0]

        queries = {"floor": lambda si=si: total([si.uv.x, si.uv.y])[0]} | {k: query(t) for k, t in readers.items()}
        times = {k: [] for k in queries}
        for q in queries.values():
            kernel_seconds(q)
        for i in range(settings.rounds):
            for k in queries if i % 2 == 0 else reversed(queries):
                times[k].append(kernel_seconds(queries[k]) * 1e9 / n)
            bar.update(1)
            if stop.is_set():
                raise _Stopped
        floor = spread(times.pop("floor"))["median"]
        base = times["bitmap, 8 bits"]
        found[place] = {}
        for k, v in times.items():
            s = spread(v)
            ratio = spread((a - floor) / max(b - floor, 1e-9) for a, b in zip(v, base, strict=True))["median"]
            found[place][k] = {
                "ns_per_read": s["median"] - floor, "q1": s["q1"] - floor, "q3": s["q3"] - floor, "ratio": ratio,
            }  # fmt: skip
    bar.close()
    return found


def _bitmaps(source: Source, eight: bool) -> list:
    """Mitsuba's textures of the maps, of those with 1 or 3 channels, or parts of them."""
    found = []
    for m in source.maps:
        values = _shown(m.values[..., :3] if m.channels >= 3 else m.values[..., :1])
        data = np.ascontiguousarray(np.rint(values * 255).astype(np.uint8) if eight else values)
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}
        found.append((mi.load_dict(bitmap), values.shape[-1]))
    return found


def _evaluated(texture, si, channels: int):
    if channels == 1:
        return texture.eval_1(si)
    return texture.eval_3(si) if channels == 3 else texture.eval(si)


# -- what it says -----------------------------------------------------------------------------------------------------


def write(result: dict, folder: str | os.PathLike) -> dict[str, str]:
    """Write ``tradeoff_image.json``, ``.csv``, ``.png``; an interrupted run keeps its partial file. Returns paths."""
    folder = Path(folder)
    paths = {kind: folder / f"tradeoff_image.{kind}" for kind in ("json", "csv", "png")}
    write_json(paths["json"], report.finite(result))
    names = list(dict.fromkeys(k for r in result["rows"] for k in r["errors"]))
    fields = ("name", "representation", "compression", "bytes", "ratio", "seconds", "random_access")
    with replacing(paths["csv"]) as temporary:
        lines = [",".join((*fields, *names))]
        for r in result["rows"]:
            cells = [r[f] for f in fields] + [r["errors"].get(k) for k in names]
            lines.append(",".join("" if c is None else f'"{c}"' if isinstance(c, str) else f"{c}" for c in cells))
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if result["rows"]:
        figure(result, paths["png"])
    else:
        del paths["png"]
    if not result["interrupted"]:
        (folder / PARTIAL).unlink(missing_ok=True)
    return {k: str(v) for k, v in paths.items()}


def figure(result: dict, path: str | os.PathLike) -> None:
    """Draw PSNR against bytes, against seconds of training, and against the time of a read."""
    rows = [r for r in result["rows"] if " without " not in r["name"]]
    panels = [
        plot.Panel("Quality against bytes", "bytes (log)", _points(rows, lambda r: r["bytes"]), ()),
        plot.Panel("Quality against training", "seconds of training (log)",
                   _points([r for r in rows if r["seconds_asked"]], lambda r: r["seconds"]), ()),
    ]  # fmt: skip
    reads = result["reads"].get("random", {})
    timed = [r for r in rows if r.get("read") in reads]
    if timed:
        lines = [
            plot.Line(k, max(v["ns_per_read"], SHORTEST), k == "bitmap, 8 bits")
            for k, v in reads.items()
            if "bitmap" in k
        ]
        points = _points(timed, lambda r: max(reads[r["read"]]["ns_per_read"], SHORTEST))
        panels.append(plot.Panel("Quality against time", "ns to read all maps, random places (log)", points, lines))
    caption = (
        f"{result['source']}, {result['width']} × {result['height']}, {len(result['maps'])} map(s), "
        f"{result['source_bytes']:,} bytes. PSNR of all channels together. JPEG and WebP have no random access. "
        + report.machine_line(result)
    )
    plot.write(path, f"Compressed image: {Path(result['source']).stem}", panels, "PSNR in dB", caption)


def _points(rows: list[dict], x) -> list:
    from ..tradeoff import pareto

    values = [(math.log(max(x(r), 1e-9)), -r["errors"]["psnr_db"]) for r in rows]
    competing = [v if r["random_access"] else (math.nan, math.nan) for v, r in zip(values, rows, strict=True)]
    front = pareto(competing) if rows else []
    return [
        plot.Point(r["name"], x(r), x(r), x(r), r["errors"]["psnr_db"],
                   r["representation"] + ("" if r["random_access"] else " (no random access)"), f)
        for r, f in zip(rows, front, strict=True)
    ]  # fmt: skip


def summary(result: dict) -> list[str]:
    """The tables that are printed."""
    maps = list(result["maps"])
    lines = [
        f"{result['source']}: {result['width']} x {result['height']}, " + ", ".join(
            f"{n} ({c})" for n, c in result["maps"].items()
        ) + f", {result['source_bytes']:,} bytes",
        report.machine_line(result),
        "",
        f"{'':38}{'bytes':>11}{'ratio':>8}{'seconds':>9}{'PSNR':>7}{'between':>9}{'mean':>7}{'FLIP':>8}{'SSIM':>7}"
        "   PSNR by map",
    ]  # fmt: skip
    for r in sorted(result["rows"], key=lambda r: (r["compression"] or 0, -r["errors"]["psnr_db"])):
        e = r["errors"]
        ssim = f"{e['ssim']:.3f}" if e["ssim"] is not None else "-"
        each = [", ".join(f"{n} {e[f'psnr_{n}_db']:.1f}" for n in maps)]
        each += [f"{e[f'angle_{n}_deg']:.2f}°" for n in maps if f"angle_{n}_deg" in e]
        access = "" if r["random_access"] else "; no random access"
        lines.append(
            f"{r['name']:38}{r['bytes']:>11,}{r['ratio']:>7.2f}x{r['seconds']:>9.1f}{e['psnr_db']:>7.2f}"
            f"{e['psnr_between_db']:>9.2f}{e['psnr_mean_db']:>7.2f}{e['flip']:>8.4f}{ssim:>7}   "
            f"{' '.join(each)}{access}"
        )
    for place, found in result["reads"].items():
        lines += ["", f"time to read all maps at {place} places (input and output subtracted)"]
        lines += [f"  {k:46}{v['ns_per_read']:>8.2f} ns{v['ratio']:>8.2f}x" for k, v in found.items()]
    return lines + _verdicts(result)


def _verdicts(result: dict) -> list[str]:
    """Ours against the best ASTC at each ratio, and our recipe against the paper's."""
    lines, rows = [""], result["rows"]
    for compression in dict.fromkeys(r["compression"] for r in rows if r["compression"]):
        here = [r for r in rows if r["compression"] == compression and " without " not in r["name"]]
        ours = [r for r in here if r["representation"] == "indirection"]
        blocks = [r for r in here if r["representation"] == "ASTC"]
        if not (ours and blocks):
            continue
        a = max(ours, key=lambda r: r["errors"]["psnr_db"])
        for b in blocks:
            texts = [
                f"{label} {a['errors'][k]:{form}} against {b['errors'][k]:{form}}: "
                f"{'ours' if (a['errors'][k] > b['errors'][k]) == more else 'ASTC'}"
                for label, k, form, more in MEASURES
            ]
            lines.append(f"{compression:g}x, {a['name']} and {b['name']}: " + "; ".join(texts))
    return lines


def request(compressions, seconds, paper_seconds, dims, astc: str, ablation: bool, quick: bool) -> Settings:
    """Settings from what the command line has, lists of which any may be empty; raises ``ValueError``."""
    found = tuple(sizing.parse_compression(c) for c in compressions) or (12.0,)
    seconds = tuple(seconds) or (2.0 if quick else 60.0,)
    about = {
        "seconds": seconds,
        "paper_seconds": tuple(paper_seconds) or (max(seconds),),
        "dims": tuple(dims) or (2, 3, 4),
    }
    if quick:
        return Settings(found[:1], **about, ablation=ablation, astc="fast", lanes=2**16, rounds=3, quick=True)
    return Settings(found, **about, ablation=ablation, astc=astc)
