"""
Write the tables and the figures of the documentation.

    python docs/make_tables.py [--check]

``tasks.md`` is made from the declarations of tasks. In the other pages, the text between ``<!-- table NAME -->`` and
``<!-- end -->`` is made from JSON in ``docs/measured/``, which ``mi-diffind … --json docs/measured/NAME.json`` wrote;
the pages show the commands. Figures in sentences are inserted from the same files, as ``claims.toml`` says
(``figures.py``). A table that shows some of its rows has all of them in ``docs/measured/NAME.csv``. With ``--check``
nothing is written, and the exit code is 1 if a page or a CSV file would change.
"""

from __future__ import annotations

import csv
import io
import re
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from statistics import fmean as mean
from typing import Any, NamedTuple

import cost_table
from figures import (
    DOCS,
    RATIO_FIGURES,
    ClaimError,
    Entries,
    claims,
    commands,
    equal_samples,
    headlines,
    measured,
    ratio_best,
    ratio_loss,
    ratio_rows,
    time_at_equal_error,
)

import mi_diffind
from mi_diffind.fitting.task import tasks
from mi_diffind.tasks import radiance as field_presets
from mi_diffind.tasks.image import arrays as image_budget
from mi_diffind.tasks.sdf import paper as sdf_paper
from mi_diffind.tasks.texture import arrays as texture_budget


class Table(NamedTuple):
    """Table of a page: its head, its rows, and which of the rows the page shows (all if ``shown`` is ``None``)."""

    head: list[str]
    rows: list[list]
    shown: Callable[[list], bool] | None = None

    def __str__(self) -> str:
        """Return the rows that the page shows, in Markdown."""
        lines = [self.head, ["---"] * len(self.head), *filter(self.shown or (lambda row: True), self.rows)]
        return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)

    def of_page(self, name: str) -> str:
        """Return the rows that the page shows and, if these are not all, a link to ``measured/NAME.csv``."""
        link = f"\n\nAll {len(self.rows)} rows: [{name}.csv](measured/{name}.csv)" if self.shown else ""
        return f"{self}{link}"

    def csv(self) -> str:
        """Return all rows as comma-separated values, without marks of Markdown and separators of thousands."""
        marks = re.compile(r"`|\*\*|(?<=\d),(?=\d{3})")
        stream = io.StringIO()
        lines = ([marks.sub("", str(cell)) for cell in line] for line in (self.head, *self.rows))
        csv.writer(stream, lineterminator="\n").writerows(lines)
        return stream.getvalue()


#: Tables of the pages by name: functions without arguments.
TABLES: dict[str, Callable[[], Table]] = dict(cost_table.tables(Table))


def table_of(*versions: tuple) -> Callable:
    """Return a decorator that declares a function as a table of its name, or as tables of several endings.

    A version is the ending of the name and the names of the JSON files that are the function's arguments.
    """

    def declare(function: Callable) -> Callable:
        for ending, *names in versions or [("",)]:
            TABLES[function.__name__ + ending] = lambda names=names: function(*map(measured, names))
        return function

    return declare


def named(content: dict) -> list[Entries]:
    """Return the entries of a dictionary with their keys as ``name``."""
    return [Entries(value, name=key) for key, value in content.items()]


def filled(rows: Iterable[dict], columns: dict[str, Any], shown=None, missing: str = "") -> Table:
    """Return the table of rows: each column has a head and a cell, a text with fields of the row or a function of it.

    A cell whose fields the row lacks is ``missing``.
    """

    def cell(column, row):
        try:
            return column.format_map(row) if isinstance(column, str) else column(row)
        except (AttributeError, KeyError):
            return missing

    return Table(list(columns), [[cell(column, row) for column in columns.values()] for row in rows], shown)


def with_spread(values: list[float]) -> str:
    """Return a mean with half the range, if there are several values."""
    return f"{mean(values):.2f}" + (f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else "")


# -- ggx, disney, bsdf -------------------------------------------------------------------------------------------------


@table_of(("", "tradeoff_disney", "tradeoff_disney_network"))
def disney_forms(study: Entries, network: Entries) -> Table:
    """Return accuracy, bytes and time of each form of the Disney BRDF; times of networks are not measured."""
    columns = {"form": "`{name}`", "bytes": "{bytes:,}", "PSNR, dB: training / uniform": lambda c: " / ".join(
        f"{c.errors[k]:.1f}" for k in ("psnr_db_training", "psnr_db_uniform") if k in c.errors
    ) or "–"}  # fmt: skip
    for case, queries in {
        "constant, all lobes": ("eval",), "constant, diffuse + specular": ("eval",),
        "textured, diffuse + specular": ("eval", "pdf"),
    }.items():  # fmt: skip
        for query in queries:
            times = study.cases[case].queries[query]
            columns[f"{query}: {case}"] = lambda c, t=times: f"{t[c.name].time / t.principled.time:.2f}"
    rows = [c for c in named({**study.candidates, **network.candidates}) if c.representation != "one table"]
    return filled(rows, columns, lambda row: row[0] != "`paper, float16`", missing="–")


@table_of(("", "tradeoff_ggx"))
def ggx_quality(study: Entries) -> Table:
    """Return costs of each family at the quality of an indirection, as multiples of it, beside the paper's."""
    from mi_diffind.studies.ggx import equal_quality

    reference = "16→8"
    goal, rows = study.candidates[reference].errors.psnr_db, []
    for row in equal_quality(study, reference):
        paper = [f" ({value:g})" for value in row.paper or ()] or [""] * 3
        ratios = [f"{ratio:.3g}{note}" for ratio, note in zip(row.ratios, [*paper, ""], strict=True)]
        rows.append([f"{row.family}: {row.name}", *ratios, f"{row.psnr_db - goal:+.1f}"])
    return Table(["", "flops", "bytes read", "bytes stored", "time", "PSNR beside it, dB"], rows)


#: Rows of the page's table of GGX, by the inputs.
GGX_CANDIDATES = {
    "inputs as in the paper": ("16→8", "16→8 u8", "24²", "96²", "192²", "MLP 32x3"),
    "logarithmic inputs": ("16→8", "16→8 u8", "24²", "MLP 32x3"),
}


@table_of(("", "tradeoff_ggx"))
def ggx_candidates(study: Entries) -> Table:
    """Return bytes, PSNR and times of the float32 candidates for both kinds of inputs, without tensor networks."""
    rows = [
        Entries(study.candidates[name], case=case, name=name.removesuffix(", log"), time=timing.time)
        for case, content in study.cases.items()
        for name, timing in content.queries.get("read", {}).items()
    ]
    columns = {
        "inputs": "{case}", "": "{name}", "bytes": "{bytes:,}",
        "PSNR, dB": lambda c: f"{c.errors.psnr_db:.1f}" if "psnr_db" in c.errors else "exact",
        "a read, ns": "{time:.2f}",
        "converged": lambda c: "–" if "psnr_db" not in c.errors else "yes" if c.converged else "no",
    }  # fmt: skip
    return filled(rows, columns, lambda row: row[1] in GGX_CANDIDATES[row[0]])


#: Contenders of the study of learned BSDFs, in columns.
BSDF_CONTENDERS = ("ours", "table", "plain", "paper", "network, warped", "network, raw", "measured")


@table_of(("", "tradeoff_bsdf"))
def bsdf(study: Entries) -> Table:
    """Return the PSNR of learned BSDFs and of what they are compared with."""
    c = study.candidates
    columns = {
        "material": str, "bytes": lambda m: f"{c[f'{m}: ours'].bytes:,}",
        "proxy alone": lambda m: f"{c[f'{m}: ours'].errors.psnr_proxy_db:.1f}",
        **{name: lambda m, name=name: f"{c[f'{m}: {name}'].errors.psnr_db:.1f}" for name in BSDF_CONTENDERS},
    }  # fmt: skip
    return filled(study.cases, columns, missing="–")


@table_of(("", "tradeoff_bsdf"))
def bsdf_times(study: Entries) -> Table:
    """Return albedo, noise of sampling and times of learned BSDFs."""

    def times(other):
        def ratio(material, query):
            median = study.cases[material].ratios[query].get(f"{material}: ours / {material}: {other}")
            return f"{median.median:.2f}" if median else "–"

        return lambda material: " / ".join(ratio(material, query) for query in ("eval", "eval_pdf", "sample"))

    errors = {material: study.candidates[f"{material}: ours"].errors for material in study.cases}
    return filled(errors, {
        "material": str, "albedo": lambda m: f"{100 * errors[m].albedo_excess:.2f}%",
        "moment": lambda m: f"{errors[m].moment_learned:.2f} / {errors[m].moment_native:.2f}",
        "of `principled`'s time": times("principled"), "of the source's": times("source"),
        "of `measured`'s": times("measured"),
    })  # fmt: skip


@table_of(("", "inspect_family_plastic", "inspect_family_principled"))
def bsdf_families(plastic: Entries, principled: Entries) -> Table:
    """Return the errors of learned families at random members."""
    plastic = {**plastic, "label": "`roughplastic`, nonlinear, alpha from 0.02 to 0.8"}
    principled = {**principled, "label": "`principled`, roughness from 0.05 to 1, metallic from 0 to 1"}
    return filled([plastic, principled], {
        "family": "{label}", "bytes": "{bytes:,}", "PSNR, dB: mean / median / least":
        "{measured.psnr_db:.1f} / {measured.psnr_median_db:.1f} / {measured.psnr_minimum_db:.1f}",
        "albedo": lambda f: f"{100 * f['measured'].albedo_excess:.2f}%",
        "moment": "{measured.sample_weight_moment:.2f}",
    })  # fmt: skip


# -- scenes ------------------------------------------------------------------------------------------------------------


@table_of()
def comparisons() -> Table:
    """Return errors and time ratios of the scenes by ``compare``, each against its truths."""

    def time(f):
        ratio = f.time_ratio
        uncertain = ratio.median is None or ratio.q3 > 1.5 * ratio.q1
        return "–" if f.truth_spp != f.spp else "not measurable" if uncertain else f"{ratio.median:.2f}"

    files = [measured(path.stem) for path in sorted((DOCS / "measured").glob("compare_*.json"))]
    return filled([f for first in files for f in (first, *first.get("further", ()))], {
        "scene": lambda f: f"`{Path(f.scene).name}`", "against": "{against}, {truth_spp} samples",
        "PSNR, dB": "{psnr_db:.1f}", "without noise": lambda f: "all is noise" if f.psnr_without_noise_db is None
        else f"{f.psnr_without_noise_db:.1f}", "FLIP": "{flip:.4f}", "time of a pass over that of the other": time,
    })  # fmt: skip


@table_of(("", "tradeoff_scene_materials_paper", "tradeoff_scene_metals", "tradeoff_scene_still_life"))
def scenes_bias(*studies: Entries) -> Table:
    """Return bias of the tables, the samples at which noise equals it, and times of scenes, learned over exact."""
    tables = iter(("`neural_disney`, `-D preset=paper`", "`neural_ggx`", "`neural_disney`"))

    def times(study):
        medians = [ratio.median for ratio in study.ratios]
        return f"{min(medians):.2f} to {max(medians):.2f}"

    return filled(studies, {
        "scene": lambda s: f"`{Path(s.scene).name}`, {s.width} × {s.height}", "tables": lambda s: next(tables),
        "bias": lambda s: f"{100 * s.bias.rmse:.2g}%, {s.bias.psnr_db:.1f} dB",
        "the noise equals it at": lambda s: f"{float(f'{s.crossover.spp:.2g}'):,.0f} spp",
        "time, learned / exact": times,
    })  # fmt: skip


@table_of(("", "regress_power"))
def regress_power(study: Entries) -> Table:
    """Return alarms of regression checks of changed and unchanged scenes, and how often a promised change is found."""
    changes = ("unchanged", "colour −3%", "roughness +10%", "moved by 0.2%", "lamp −1%", "lamp −2%")
    return filled(study.rows, {
        "scene, variant, sampler, spp":
        lambda r: f"{r.scene}, {r.variant.removeprefix('llvm_ad_')}, `{r.sampler}`, {r.spp}",
        **{c: lambda r, c=c: f"{r.percent[c]:.3g}% of {r.checks[c]}" for c in changes},
        "tile: found": lambda r: f"{100 * r.power.predicted_change:.2g}%: {r.power.measured_percent:.0f}%",
    })  # fmt: skip


#: Runs of the page's table of trainings inside a scene, by the scene.
SCENE_RUNS = {
    "balls": ("scene", "hemisphere", "hemisphere, then scene", "another material, then scene"),
    "corner": ("scene", "hemisphere", "hemisphere, then scene"),
    "floor": ("scene", "hemisphere, longer", "hemisphere, then scene"),
}


@table_of()
def scene_training() -> Table:
    """Return errors of held-out views and lights after training inside a scene and over the hemisphere."""
    rows = []
    for path in sorted((DOCS / "measured").glob("tradeoff_scene_training_*.json")):
        runs = [record.details for record in measured(path.stem).jobs.values()]
        weights = [d["lambda"] for d in runs if d["lambda"] is not None]
        for d in runs:
            run = d.way
            run += f", λ {d['lambda']:g}" if d["lambda"] not in (None, *weights[:1]) else ""
            rows.append({**d, "run": run + (f", {d.spp} samples a pixel" if d.spp != runs[0].spp else "")})
    columns = {
        "scene": "{scene}", "run": "{run}", "PSNR, dB": "{psnr_db:.2f}", "FLIP": "{flip:.3f}", "steps": "{steps:.0f}",
        "processor s": "{processor_seconds:.0f}", "level bias": "{level_bias:.1f}",
    }  # fmt: skip
    return filled(rows, columns, lambda row: row[1] in SCENE_RUNS[row[0]], missing="–")


@table_of(("", "bench_view"))
def viewer(study: Entries) -> Table:
    """Return pictures a second of the viewer."""
    return filled(study.rows, {
        "scene": lambda r: f"`{r.scene}.xml`" + ("" if r.sides == 2 else ", learned side only"),
        "pixels": "{size[0]} x {size[1]}", "pictures a second": "{pictures_a_second:.1f}", "speedup": "{speedup:.1f}",
        "s after a slider moved": "{seconds_changed.median:.2f}",
    })  # fmt: skip


@table_of()
def film_errors() -> Table:
    """PSNR of the panels of films against their truth."""
    figures = {f"`{name}`": measured(f"film_{name}").psnr_db for name in ("zoom", "orbit", "shading")}
    rows = [[name, label, f"{db:.1f}"] for name, panels in figures.items() for label, db in panels.items()]
    return Table(["film", "panel", "PSNR, dB"], rows)


@table_of()
def film_bytes() -> Table:
    """Sizes of films in three formats."""
    columns = {"film": "`{name}`", "pixels": "{width} × {height}", "frames": "{frames}"}
    for head, ending in {"WebP, kB": "webp", "GIF, kB": "gif", "H.264, kB": "mp4"}.items():
        columns[head] = lambda f, ending=ending: f"{f.bytes[ending] / 1000:,.0f}"
    return filled(named({name: measured(f"film_{name}") for name in ("suite", "zoom", "orbit", "shading")}), columns)


# -- images ------------------------------------------------------------------------------------------------------------


@table_of(("", "tradeoff_image"))
def image_contenders(study: Entries) -> Table:
    """Return quality of a compressed material beside that of codecs in as many bytes."""
    return filled([c for c in named(study.candidates) if c.errors and not c.name.startswith("bitmap")], {
        "": lambda c: c.name + (f", {c.details.steps:,} steps" if c.details.get("steps") else ""),
        "bytes": "{bytes:,}", "PSNR at texels, dB": "{errors.psnr_db:.1f}",
        "between texels": "{errors.psnr_between_db:.1f}", "FLIP": "{errors.flip:.4f}",
        "as seen, dB": "{errors.seen_db:.1f}",
    })  # fmt: skip


@table_of()
def image_pages() -> Table:
    """Return PSNR of images and materials as one grid and as pages, in equal bytes and seconds."""
    cell = "{measured.psnr_db:.1f} / {measured.psnr_between_db:.1f} ({settings.structure})"

    def fitted(structure):
        return lambda source: cell.format_map(measured(f"fit_image_{source}_{structure}"))

    sources = ("boombox", "tiles", "wood_color", "vase_color", "hammered_normal")
    columns = {"source": str, "one grid, the better of two": fitted("grid"), "what auto chooses": fitted("auto")}
    return filled(sources, columns)


@table_of()
def image_seen() -> Table:
    """Return errors as seen of materials with equal weights, and with those that ``--weights auto`` chooses."""
    rows = []
    for source, weights in (("boombox", ""), ("tiles", ""), ("rust", "auto"), ("brick", "auto")):
        equal = measured(f"fit_image_{source}_seen_equal").measured
        auto = measured(f"fit_image_{source}_seen_{weights}").measured if weights else equal
        seen = [f"seen_{gloss}_{distance}_db" for gloss in ("glossy", "rough") for distance in ("near", "far")]
        maps = [n for n in equal if n.startswith("psnr_") and n not in ("psnr_db", "psnr_mean_db", "psnr_between_db")]
        worst = min(maps, key=lambda n: auto[n] - equal[n])
        rows.append([
            source, f"{equal.psnr_db:.1f}", f"{equal.angle_normal_deg:.2f}",
            *(f"{equal[n]:.1f} / {auto[n]:.1f}" for n in (*seen, "seen_db")),
            f"{100 * (equal.seen_brightness - 1):+.2f}%",
            f"{worst[5:-3]} {auto[worst] - equal[worst]:+.2f}" if weights else "weights are equal",
        ])  # fmt: skip
    head = ["source", "PSNR of maps", "normals, °", "glossy near", "glossy far", "rough near", "rough far", "all"]
    return Table([*head, "brightness", "auto: the map that loses most"], rows)


@table_of()
def image_bytes() -> Table:
    """Sizes of the sources: raw, as the PNG files of the repository, and compressed."""
    assets, rows = DOCS.parent / "scenes" / "assets", []
    for source in ("tiles", "wood_color", "vase_color", "hammered_normal"):
        fit = measured(f"fit_image_{source}_auto")
        files = [assets / f"{source}.png"] if source != "tiles" else sorted(assets.glob("tiles_*.png"))
        sizes = (fit.source_bytes, sum(f.stat().st_size for f in files), fit.bytes)
        rows.append([source, *(f"{n:,}" for n in sizes), f"{sizes[1] / sizes[2]:.1f}x"])
    return Table(["source", "raw bytes", "bytes of the PNG files", "bytes at 12x", "of PNG"], rows)


# -- textures ----------------------------------------------------------------------------------------------------------

#: Rows of the pages' tables of renders.
RENDERS = (
    "bitmap, 1 spp", "bitmap, 4 spp", "bitmap, 4 spp, multijittered", "bitmap, 16 spp, multijittered",
    "mipmap, trilinear", "ours 12x, trilinear", "ours 12x, anisotropic, centred", "ASTC 12x, trilinear",
    "ASTC 12x, anisotropic, centred", "network 12x, trilinear",
)  # fmt: skip


def with_network(study: Entries, *network: Entries) -> Entries:
    """Return the study of filtered tiles with the network of another study, whose times are not used."""
    return Entries(study, **{key: Entries(study[key], **n[key]) for n in network for key in ("candidates", "jobs")})


@table_of(("", "tradeoff_texture", "tradeoff_texture_network"), ("_boombox", "tradeoff_texture_boombox"))
def texture_renders(*studies: Entries) -> Table:
    """Return errors, flicker and times of renders with filtered textures; "–": a time is not measured."""
    study, base = with_network(*studies), "bitmap, 1 spp"
    stages, flicker = list(study.details.counted), study.candidates["bitmap, 4 spp"].errors.flicker_error

    def times(c):
        ratios = [study.cases[s].ratios.render.get(f"{c.name} / {base}", {}).get("median") for s in stages]
        return " / ".join("1.00" if c.name == base else "–" if ratio is None else f"{ratio:.2f}" for ratio in ratios)

    return filled([c for c in named(study.candidates) if "flicker" in c.errors], {
        "": "`{name}`", "bytes, 8 bits a number": "{bytes:,}",
        **{f"{s}: PSNR, dB / FLIP": f"{{errors.psnr_{s}_db:.1f}} / {{errors.flip_{s}:.4f}}" for s in stages},
        "flicker": lambda c: f"{c.errors.flicker_error / flicker:.2f}", f"time: {' / '.join(stages)}": times,
    }, lambda row: row[0].strip("`") in RENDERS)  # fmt: skip


@table_of(("", "tradeoff_texture"), ("_boombox", "tradeoff_texture_boombox"))
def texture_factors(study: Entries) -> Table:
    """Return how many times as long a bitmap takes for the same error."""

    def cell(name, stage):
        speeds = [time_at_equal_error(study, stage, name, against) for against in ("", ", multijittered")]
        return " / ".join(f"{'> ' * more}{value:.1f}" for value, more in speeds)

    stages = [s for s, c in study.cases.items() if c.in_picture]
    names = [n for n, c in study.candidates.items() if not c.representation.startswith("bitmap") and c.errors]
    return filled(names, {
        "": lambda name: f"`{name}`",
        **{f"{s}: independent / multijittered": partial(cell, stage=s) for s in stages},
    }, lambda row: row[0].strip("`") in RENDERS)  # fmt: skip


@table_of(("", "tradeoff_texture", "tradeoff_texture_network"), ("_boombox", "texture_levels_boombox"))
def texture_levels(*studies: Entries) -> Table:
    """Return PSNR of each level of detail."""
    study = with_network(*studies)
    by_name = {n: r["details"]["levels"]["all"] for n, r in study.jobs.items() if "levels" in r.get("details", {})}
    rows = [[n, f"{study.jobs[n].details.ratio:.1f}x", *(f"{v:.1f}" for v in db)] for n, db in by_name.items()]
    return Table(["", "ratio", *(f"L{i}" for i in range(max(map(len, by_name.values()))))], rows)


@table_of()
def texture_presets() -> Table:
    """Return PSNR of our preset and of the paper's, trained as long."""
    rows = []
    for source in ("boombox", "boombox_albedo"):
        for preset in ("ours", "paper"):
            f = measured(f"fit_texture_{source}_{preset}")
            levels = [f"{v:.1f}" for k, v in f.measured.items() if re.fullmatch(r"psnr_l\d+_db", k)]
            off = f"{100 * f.measured.mean_error:.2f}%"
            rows.append([source, preset, f"{f.bytes:,}", f"{f.step:,}", *levels, off])
    head = ["source", "preset", "bytes", "best step", *(f"L{i}" for i in range(len(levels))), "mean off by"]
    return Table(head, rows)


#: Rows of the table of footprints that its page leaves out.
EASY_FOOTPRINTS = (
    "plane, field of view 60°", "sphere, field of view 60°", "vase, field of view 90°", "knot, field of view 60°",
    "flat mirror",
)  # fmt: skip


@table_of(("", "bench_footprint"))
def texture_footprints(study: Entries) -> Table:
    """Return relative errors of footprints, medians and 90th percentiles, of the side and of the major axis."""
    rows = [
        [name, *(f"{100 * median:.2g}, {100 * worst:.2g}%" for median, worst in errors)]
        for name, errors in study.rows.items()
    ]
    return Table(["", "side", "major axis"], rows, lambda row: row[0] not in EASY_FOOTPRINTS)


@table_of(("", "tradeoff_texture_boombox"))
def texture_equal_samples(study: Entries) -> Table:
    """Return how many samples of a bitmap have the error of one filtered sample, on the plane of boombox."""

    def samples(sampling):
        return lambda name: f"{equal_samples(study, 'plane', name, sampling):.0f}"

    labels = {
        "ours 12x, trilinear": "`trilinear`, the default",
        "ours 12x, anisotropic, centred": "`anisotropic`, `jitter` false (centred)",
    }
    return filled(labels, {
        "filter": labels.get, "PSNR": lambda name: f"{study.candidates[name].errors.psnr_plane_db:.1f} dB",
        "independent samples": samples(""), "multijittered samples": samples("multijittered"),
    })  # fmt: skip


@table_of(("", "texture_memory"))
def texture_memory(memory: Entries) -> Table:
    """Return the resident memory of a scene with many textures."""
    return filled(named(memory.textures), {
        f"{memory.count} textures of {memory.side}²": "`{name}`", "MiB": lambda row: f"{row.bytes / 2**20:.1f}",
        "times less": "{times_less:.1f}",
    })  # fmt: skip


@table_of(("", "bench_texture_before", "bench_texture"))
def texture_reads(before: Entries, now: Entries) -> Table:
    """Return the times of filtered reads, as multiples of those of bitmaps, before this version's reads and now."""
    rows = []
    for old, new in zip(before.reads, now.reads, strict=True):
        names = [name for name in new.textures if name != "bitmap"]
        costs = [f"{old.textures[n].ratio:.2f} → **{new.textures[n].ratio:.2f}**" for n in names]
        rows.append([new.table.removesuffix(".npz"), new.hits, new.maps, *costs])
    return Table(["table", "hits", "maps", "`off`", "`trilinear`", "`anisotropic`"], rows)


# -- shading -----------------------------------------------------------------------------------------------------------


def shading_curves(*studies: Entries) -> dict:
    """Return the results of the study of shading by material."""
    from mi_diffind.studies.shading import curves

    return {name: material for study in studies for name, material in curves(study).items()}


@table_of(("", "tradeoff_shading", "tradeoff_shading_boombox"))
def shading_best(*studies: Entries) -> Table:
    """Return errors of textures trained for shading, beside the best classical filters and the texture before."""
    rows = []
    for name, material in shading_curves(*studies).items():
        (way,) = material.remedies
        methods = []
        for label, filters in (("uncompressed", material.classical), ("equal bytes", material.compressed)):
            best = max(filters, key=lambda key, filters=filters: filters[key]["C"]["mean_db"])
            methods.append((f"{best.removesuffix(', compressed')}, {label}", [filters[best]]))
        methods.append(("trained, λ = 0.9", material.runs[way, 0.9]))
        for label, runs in methods:
            levels = [f"{mean(d['C']['psnr_db'][level] for d in runs):.1f}" for level in range(6)]
            flip = f"{mean(mean(d['C']['flip']) for d in runs):.3f}"
            last = f"{mean(d['P']['mean_db'] for d in runs):.2f}"
            rows.append([name, label, with_spread([d["C"]["mean_db"] for d in runs]), flip, *levels, last])
    return Table(["material", "", "C, dB", "FLIP", *(f"L{i}" for i in range(6)), "P, dB"], rows)


@table_of(("", "tradeoff_shading_lambda"), ("_paper", "tradeoff_shading_paper"))
def shading_shares(study: Entries) -> Table:
    """Return the paper's figure 2 as a table: quality by λ, with the spread over seeds."""
    from mi_diffind.studies.shading import trouble

    rows, materials = [], shading_curves(study)
    shares = sorted({share for material in materials.values() for _, share in material.runs})
    for name, material in materials.items():
        for way in material.remedies:
            met = trouble([d for share in shares if share for d in material.runs.get((way, share), [])])
            for letter in "CP":
                values = [material.values(way, share, letter) for share in shares]
                rows.append([name, way, letter, *(with_spread(v) if v else "–" for v in values), met or "none"])
    return Table(["material", "", "", *(f"λ {share:g}" for share in shares), "trouble"], rows)


@table_of(("", "tradeoff_shading_lambda"))
def shading_extras(study: Entries) -> Table:
    """Return errors of textures of the first seed, trained for shading without and with extras."""
    rows = []
    for name, material in shading_curves(study).items():
        without = f"{name}, lambda 0.9, {material.remedies[0]}, seed 0"
        for label, job in (("without", without), ("with", f"{name}, extras, seed 0")):
            rows.append({"name": name, "label": label, **study.jobs[job]})
    return filled(rows, {
        "material": "{name}", "extras": "{label}", "bytes": "{bytes:,}", "C, dB": "{details.C.mean_db:.2f}",
        "FLIP": lambda r: f"{mean(r['details'].C.flip):.3f}",
        **{f"L{i}": f"{{details.C.psnr_db[{i}]:.1f}}" for i in range(6)},
    })  # fmt: skip


#: Rows of the table of renders of materials: those that its page leaves out, and those of more samples that it shows.
LEFT_OUT = ("principled + bitmaps, multijittered, 1 spp", "disney + bitmaps, 1 spp", "disney + mip maps, 1 spp")
KEPT = ("principled + bitmaps, multijittered, 4 spp", "principled + bitmaps, multijittered, 16 spp")


@table_of(("", "tradeoff_shading_renders"))
def shading_renders(study: Entries) -> Table:
    """Return errors and times of whole renders, bytes, and the time of a training step over that of the first row."""
    rows = []
    for points in zip(*(scene.points for scene in study.scenes.values()), strict=True):
        name, spp = points[0].name, points[0].spp
        cells = (f"{p.psnr_db:.1f} / {p.cpu_ms.median:.0f}" for p in points)
        step = study.steps.get(name)
        step = f"{step.ratio.median:.2f}" if step and spp == 1 else ""
        rows.append([f"{name}, {spp} spp", f"{study.bytes[name]:,}", *cells, step])
    head = ["", "bytes", *study.scenes, "training step"]
    return Table(head, rows, lambda row: row[0] in KEPT or (row[0].endswith(", 1 spp") and row[0] not in LEFT_OUT))


@table_of(("", "bench_material"))
def material_times(study: Entries) -> Table:
    """Return the cost of a pass with each form of a material, as multiples of separate plugins."""
    separate = study.frame["normalmap + disney + 4 neural_texture"].operations
    columns = {"material": "`{name}`"}
    for head, key in {"instructions": "instructions", "flops": "flops", "reads": "gathers"}.items():
        columns[head] = lambda f, key=key: f"{f.operations[key] / separate[key]:.2f}"
    for head, size in {"8 × 8 pixels": "fixed", "960 × 640": "frame", "training step": "step"}.items():
        ratio = "{ratio.median:.2f} ({ratio.q1:.2f} to {ratio.q3:.2f})"
        columns[head] = lambda f, size=size, ratio=ratio: ratio.format_map(study[size][f.name])
    return filled(named(study.frame), columns, missing="–")


@table_of(("", "bench_shading_distances"))
def shading_distances(studies: Entries) -> Table:
    """Return the PSNR of materials before and after training for their shading, as seen from three distances."""
    return filled(named(studies), {
        "material": "{name}", "level bias": "{level_bias:g}",
        "fine levels fixed": lambda s: "yes" if s.fixed else "no",
        **{f"{d}, dB": f"{{seen.{d}.before.psnr_db:.1f}} → {{seen.{d}.after.psnr_db:.1f}}"
           for d in ("near", "middle", "far")},
    })  # fmt: skip


@table_of(("", "rust"))
def rust(study: Entries) -> Table:
    """Return the errors of the scene rust at one sample a pixel, before and after training for its shading."""
    return filled(named({name: study[name] for name in ("rust_plain.npz", "rust_shaded.npz")}), {
        "texture": "`{name}`", "bytes": "{bytes:,}", "PSNR, dB": "{psnr_db:.1f}", "FLIP": "{flip:.3f}",
        "brightness": lambda f: f"{100 * (f.brightness - 1):+.1f}%",
    })  # fmt: skip


# -- distance fields ---------------------------------------------------------------------------------------------------

SOLIDS = [(f"_{name}", f"tradeoff_sdf_{name}") for name in ("suzanne", "armadillo", "bunny")]


@table_of(*SOLIDS)
def sdf_errors(study: Entries) -> Table:
    """Return errors of distance fields in equal bytes: IoU, IoU near the surface, normals."""
    from mi_diffind.measure.report import candidates_by_budget
    from mi_diffind.studies.sdf import size_text

    sizes, rows = candidates_by_budget(study), {}
    for size, candidates in sizes.items():
        for c in candidates.values():
            cell = "{iou:.4f} / {iou_near:.4f} / {normal_deg:.2f}°".format_map(c["errors"])
            rows.setdefault(c["label"], {})[size] = cell
    lines = [[name, *(row.get(s, "") for s in sizes)] for name, row in rows.items()]
    shown = (lambda row: row[0] != "8³ bricks") if len(lines) > 10 else None
    return Table(["", *map(size_text, sizes)], lines, shown)


@table_of(*SOLIDS)
def sdf_times(study: Entries) -> Table:
    """Return times of distance fields of one size: seconds of the fit, reads, rays, renders."""
    reads, rays = study.cases.reads.queries, study.cases.rays

    def time(times):
        return lambda c: f"{times[c.name].time:.3g}"

    measured_ones = [c for c in named(study.candidates) if c.name in rays.queries.ray or c.name in reads.value]
    return filled(measured_ones, {
        "": "{label}", "bytes": "{bytes:,}",
        "seconds": lambda c: "" if c.is_reference else f"{c.training_seconds:.0f}",
        "a distance, ns": time(reads.value), "a gradient, ns": time(reads.normal),
        "a primary ray, ns": time(rays.queries.ray), "a render, ms": time(rays.passes.get("render", {})),
    }, lambda row: row[0] not in ("dense grid", "8³ bricks", "sparse distances"))  # fmt: skip


@table_of(("", "tradeoff_sdf_parts_armadillo"))
def sdf_parts(study: Entries) -> Table:
    """Return errors of distance fields with parts of ours left out or changed, in equal bytes."""
    return filled(study.candidates.values(), {
        "": "{label}", "bytes": "{bytes:,}", "IoU / within 0.01": "{errors.iou:.4f} / {errors.iou_near:.4f}",
        "normals: mean / 95%": "{errors.normal_deg:.2f}° / {errors.normal_p95_deg:.1f}°",
        "pieces": "{errors.components:,}",
    }, lambda row: row[0] != "16 bits a node, not trained")  # fmt: skip


@table_of(("", "bench_sdf"))
def sdf_rays(study: Entries) -> Table:
    """Return times of rays through the arrays of distance fields and through ``sdfgrid``, beside Embree."""
    rows = []
    for file in study.files:
        for rays in ("primary", "random"):
            mesh, *others, arrays = (row for row in file.rows if row.rays == rays)
            rows.append([
                f"{file.name}, {file.triangles:,} triangles", rays, f"{mesh.ns:.0f}",
                *(f"{row.ratio:.1f}" for row in (arrays, *others)), f"{100 * arrays.hits_differ:.3f}%",
            ])  # fmt: skip
    times = (f"{row.name}, times that" for row in (arrays, *others))
    return Table(["mesh", "rays", "Embree, ns", *times, "hits that differ"], rows)


# -- radiance fields ---------------------------------------------------------------------------------------------------


def trained(study: Entries) -> list[Entries]:
    """Return the candidates of a study of radiance fields.

    Networks of this one, which trained their density alone by an error that is mended, are left out.
    """
    return [c for c in named(study.candidates) if c.details.get("kind") != "hash"]


#: Columns of contenders of a study of radiance fields.
FIELD_COLUMNS = {
    "MB in memory": lambda c: f"{c['details']['memory_bytes'] / 1e6:.2f}",
    "MB on disk": lambda c: f"{c['details']['file_bytes'] / 1e6:.2f}",
    "dB, white": "{errors[psnr_white_db]:.2f}", "dB, foreground": "{errors[psnr_foreground_db]:.2f}",
}  # fmt: skip

#: Seconds of the training of a contender.
TRAINING = {"seconds": lambda c: "" if c["is_reference"] else f"{c['training_seconds']:.0f}"}

#: Rows of the page's table of radiance fields: those that are as good as ours or better, and the paper's.
FIELD_CONTENDERS = [("grid", ""), ("paper", "75×")] + [
    (name, ratio)
    for name in ("sparse grid, 6-bit colours", "principal components", "codebook", "ours")
    for ratio in ("75×", "200×")
]


@table_of(("", "tradeoff_field_long"))
def field_longer(study: Entries) -> Table:
    """Return planes and the network of the radiance-field study after a longer training, beside their grid."""
    columns = {"": "{label}", **TRAINING, "steps": "{details.steps:,}", **FIELD_COLUMNS}
    return filled(study.candidates.values(), columns)


@table_of(("", "tradeoff_field"))
def field_errors(study: Entries) -> Table:
    """Return PSNR of radiance fields by how many times smaller than a dense grid they are."""
    from mi_diffind.measure.report import candidates_by_budget
    from mi_diffind.studies.field import ratio_text, references

    study = {**study, "candidates": {c.name: c for c in trained(study)}}
    rows = [c for each in (references(study), *candidates_by_budget(study).values()) for c in each.values()]
    asked = {"asked for": lambda c: ratio_text(c["details"]["asked"]) if c["details"].get("asked") else ""}
    return filled(rows, {"": "{label}", **asked, **FIELD_COLUMNS}, lambda row: (row[0], row[1]) in FIELD_CONTENDERS)


@table_of(("", "tradeoff_field"))
def field_times(study: Entries) -> Table:
    """Return times of radiance fields of one size: seconds of training, a sample, a picture."""
    both, passes, side = study.cases.reads.queries.both, study.cases.reads.passes.render, study.details.request.film
    return filled([c for c in trained(study) if c.name in both or c.name in passes], {
        "": "{label}", **TRAINING, "a sample, ns": lambda c: f"{both[c.name].time:.3g}",
        f"{side}², ms": lambda c: f"{passes[c.name].time:.3g}",
    })  # fmt: skip


@table_of(("", "bench_field"))
def field_parts(study: Entries) -> Table:
    """Return errors of radiance fields with parts of the compression left out."""
    return filled(study.rows, {
        "": "{name}", "MB in memory": lambda row: f"{row.bytes / 1e6:.2f}", "dB, white": "{psnr_white_db:.2f}",
        "dB, foreground": "{psnr_foreground_db:.2f}",
    })  # fmt: skip


@table_of()
def field_captures() -> Table:
    """Return errors and bytes of three captures, as a grid and compressed."""
    contents = {
        "group": "Suzanne, a painted vase, a knot, a pear", "thin": "a plant in a globe of wires",
        "glossy": "clear-coated, golden, steel and plastic things",
    }  # fmt: skip
    errors = "{measured.psnr_white_db:.2f} / {measured.psnr_foreground_db:.2f}"

    def size(key):
        def text(name):
            f = measured(f"inspect_field_{name}")
            return f"{f[key] / 1e6:.2f} ({f.dense_bytes / f[key]:.0f}x)"

        return text

    return filled(contents, {
        "": lambda name: f"{name}: {contents[name]}",
        "grid, dB": lambda name: errors.format_map(measured(f"inspect_field_{name}_grid")),
        "compressed, dB": lambda name: errors.format_map(measured(f"inspect_field_{name}")),
        "MB in memory": size("memory_bytes"), "MB on disk": size("file_bytes"),
    })  # fmt: skip


@table_of(("", "bench_surroundings"))
def field_surroundings(study: Entries) -> Table:
    """Return figures of a capture without alpha, with and without surroundings."""
    return filled(named(study.rows), {
        "": "{name}", "dB": "{psnr_white_db:.2f}", "SSIM": "{ssim_white:.3f}",
        "MB on disk": lambda row: f"{row.file_bytes / 1e6:.1f}", "minutes of a core": "{cpu_minutes:.1f}",
    })  # fmt: skip


#: Figures for NeRF's synthetic scene lego at 800²: method, paper, dB before white, MB on disk as far as it is stated.
PUBLISHED_LEGO = (
    ("DVGO", "Sun et al. 2022", "34.6", ""),
    ("Plenoxels", "Fridovich-Keil et al. 2022", "34.1", ""),
    ("TensoRF-VM", "Chen et al. 2022", "36.5", ""),
    ("Instant-NGP", "Müller et al. 2022", "36.4", ""),
    ("VQRF", "Li et al. 2023", "about 34", ""),
    ("CNC, HAC++", "Chen et al. 2024, 2025", "33 to 36", "0.4 to 2"),
)


@table_of(("", "nerf_scenes"))
def field_nerf(study: Entries) -> Table:
    """Return figures of NeRF's synthetic scenes: as measured here, and as published for lego."""
    ours = filled(study.rows, {
        "scene": "{scene}, {side}²", "method": "{method}, measured", "dB, white": "{psnr_white_db:.2f}",
        "SSIM": "{ssim_white:.3f}", "MB on disk": lambda r: f"{r.file_bytes / 1e6:.2f}", "minutes": "{minutes:.0f}",
        "peak memory, GB": lambda r: f"{r.peak_bytes / 1e9:.1f}", "machine": "{machine.cores} cores, {machine.cpu}",
    })  # fmt: skip
    theirs = [
        ["lego, 800²", f"{name} ({paper}), claimed", db, "", mb, "", "", ""] for name, paper, db, mb in PUBLISHED_LEGO
    ]
    return Table(ours.head, ours.rows + theirs)


# -- all tasks, all plugins --------------------------------------------------------------------------------------------

#: Task → what its sweeps of ρ are measured by.
RATIO_NAMES = {
    "image": "PSNR at texels", "texture": "mean PSNR of levels", "sdf": "angle", "field": "PSNR of foreground",
}  # fmt: skip


def ratios(task: str) -> Table:
    """Return errors of a sweep of ρ at equal bytes, the best in bold, beside the paper's best ρ."""
    study, figure, rows = measured("bench_ratio"), RATIO_FIGURES[task], []
    tables = {"image": image_budget.RATIOS, "texture": texture_budget.RATIOS, "sdf": sdf_paper.RATIOS}
    digits, unit = (2, " °") if task == "sdf" else (1, " dB")
    defaults = [row for row in study.rows if row.task == task and row.default]
    for preset, budget, part in dict.fromkeys((row.preset, row.budget, row.part) for row in defaults):
        sweep, best = ratio_rows(study, task, budget, preset, part), ratio_best(study, task, budget, preset, part)
        cells = [f"{row['ratio']:.3g}: {row[figure]:.{digits}f}" for row in sweep]
        cells = [f"**{cell}**" if row == best else cell for row, cell in zip(sweep, cells, strict=True)]
        default = next(row for row in sweep if row["default"])
        loss = ratio_loss(study, task, budget, preset, part)
        if preset != "paper":
            published = "–"
        elif task == "sdf":
            published = f"{min(tables[task].items())[1]:g} (6 MB)"
        else:
            published = f"{(field_presets.RATIOS[part] if part else tables[task])[budget]:g}"
        size = f"{budget / 1000:,.0f} kB" if task == "sdf" else f"{budget:g}x"
        rows.append([
            f"`{preset}`, {size}" + (f", {part}" if part else ""), ", ".join(cells), f"{default['ratio']:.3g}",
            f"{100 * loss:.1f}%" if task == "sdf" else f"{loss:.1f} dB", published,
        ])  # fmt: skip
    head = ["preset, budget", f"ρ: {RATIO_NAMES[task]},{unit}", "default ρ", "behind the best by", "paper's best ρ"]
    return Table(head, rows)


TABLES |= {f"ratios_{task}": partial(ratios, task) for task in RATIO_FIGURES}


@table_of(("", "trust"))
def trust(study: Entries) -> Table:
    """Return one row a plugin: the worst figure of each property over the variants that were measured."""

    def cell(plugin, prop):
        cells = [row[prop] for row in study.cells[plugin].values()]
        failed, held = ([c for c in cells if c.result == word] for word in ("fails", "holds"))
        figures = [c.figure for c in failed or held if c.figure is not None]
        text = f"{max(figures):.3g}" if figures else "error" if failed else ""
        if failed:
            return f"**fails: {text}** ({len(failed)} of {len(failed) + len(held)})"
        if held:
            return f"{text} ({len(held)})"
        return "–" if any(c.result == "does not apply" for c in cells) else "not run"

    heads = ("albedo, at most", "reciprocity", "χ² rejected", "furnace", "gradients", "gradients, float32")
    properties = next(iter(next(iter(study.cells.values())).values()))
    columns = {head: partial(cell, prop=prop) for head, prop in zip(heads, properties, strict=True)}
    return filled(study.cells, {"plugin": lambda plugin: f"`{plugin}`", **columns})


# -- pages -------------------------------------------------------------------------------------------------------------


def page_of_tasks() -> str:
    """Return the page of all tasks: their presets, and the files that ship."""
    parts = [
        "# All tasks and presets\n\nMade from the declarations of the tasks by `python docs/make_tables.py`: "
        "change those, not this page.\n"
    ]
    for task in tasks().values():
        page = {"scene": "shading"}.get(task.name, task.name)
        section = f"Paper: {task.section}. " if task.section else ""
        parts.append(f"## `{task.name}`: {task.title}\n\n{section}Page: [{page}]({page}.md).\n")
        rows = [
            [f"`{name}`" + (" (default)" if i == 0 else ""), s.steps, f"{s.batch:,}", f"{s.lr:g}", s.schedule, s.loss]
            for i, (name, s) in enumerate(task.presets.items())
        ]
        parts.append(f"{Table(['preset', 'steps', 'samples a step', 'learning rate', 'schedule', 'loss'], rows)}\n")
        if task.shipped:
            rows = []
            for preset in task.shipped:
                shipped = task.load(task.file(preset=preset))
                rows.append([
                    f"`{shipped.path.name}`", f"`{preset}`", f"{shipped.nbytes:,}",
                    f"{shipped.measured['psnr_db']:.1f}",
                    f"`mi-diffind fit {task.name} --preset {preset} -o {shipped.path.name}`",
                ])  # fmt: skip
            parts.append(f"{Table(['file that ships', 'preset', 'bytes of entries', 'PSNR, dB', 'made by'], rows)}\n")
        if task.arguments:
            parts.append(
                "Arguments of its own: " + ", ".join(f"`{a.flags[0]}`" for a in task.arguments) + "; see "
                f"`mi-diffind fit {task.name} --help`.\n"
            )
    return "\n".join(parts)


def page_of_figures(pages: dict[Path, str]) -> str:
    """Return the page that names file and command of each headline, and of each other sentence with figures.

    ``pages`` has the texts of the pages, with their figures.
    """
    made, top, rest = commands(), [], []
    for claim in claims():
        text = pages[claim.path]
        link = claim.page if claim.path.parent == DOCS else f"../{claim.page}"
        sources = ", ".join(f"[{n}](measured/{n}.json)" for n in claim.files) or "files that ship"
        spans = headlines(claim.page, text)
        matches = claim.matches(text)
        headline = any(a <= m.start() < b for m in matches for a, b in spans)
        sentence = re.sub(r"\s+", " ", matches[0][0]).replace("|", "\\|").replace("**", "") if matches else claim.text
        (top if headline else rest).append([f"[{claim.page}]({link})", sentence, sources])
    head = ["page", "sentence", "files"]
    written_by = [
        [f"[{name}](measured/{name}.json)", "`{}`".format(command.replace("|", "\\|"))]
        for name, command in sorted(made.items())
    ]
    parts = [
        "# Where the figures come from",
        "Each figure of the README and of the pages is inserted from a file in `docs/measured`, which the command "
        "below wrote. Files of version 0.1.0 were measured on the way to 0.2.0.\n"
        "This page is made by `python docs/make_tables.py`; `python docs/figures.py` lists the "
        "numbers that no file backs.",
        "## Headlines",
        "Tables and lists of the README, and the first paragraph of each page.",
        Table(head, top),
        "## Files and commands",
        Table(["file", "command"], written_by),
        "## Other sentences",
        Table(head, rest),
    ]
    return "\n\n".join(map(str, parts)) + "\n"


def written() -> dict[Path, str]:
    """Return the text of each page, and of each CSV file of a table that a page shortens, by its path."""
    pages, files = {DOCS / "tasks.md": page_of_tasks()}, {}

    def block(match: re.Match) -> str:
        begin, name, end = match.groups()
        content = TABLES[name]()
        if content.shown:
            files[DOCS / "measured" / f"{name}.csv"] = content.csv()
        return f"{begin}{content.of_page(name)}\n{end}"

    for path in sorted(DOCS.glob("*.md")):
        text = pages.get(path) or path.read_text(encoding="utf-8")
        pages[path] = re.sub(r"(<!-- table (\w+) -->\n)(?:(?:\|.*|All \d.*)?\n)*(<!-- end -->)", block, text)
    return pages | files


def figures(pages: dict[Path, str]) -> tuple[dict[Path, str], list[str]]:
    """Return the pages with the numbers of ``claims.toml``, and a sentence for each claim that cannot stand."""
    troubles = []
    for claim in claims():
        try:
            pages.setdefault(claim.path, claim.path.read_text(encoding="utf-8"))
            pages[claim.path] = claim.written(pages[claim.path])
        except FileNotFoundError:
            troubles.append(f"claims.toml: no page {claim.page!r}; allowed: README.md, pages of docs, paths of files")
        except ClaimError as error:
            troubles.append(str(error))
    if not troubles:
        pages[DOCS / "figures.md"] = page_of_figures(pages)
    return pages, troubles


def main(check: bool) -> int:
    """Write the pages that differ, or with ``check`` name them; return the exit code."""
    pages, troubles = figures(written())
    for path in sorted(set((DOCS / "measured").glob("*.csv")) - pages.keys()):
        troubles.append(f"measured/{path.name}: no page has a shortened table of this name; remove the file")
    differing = [p for p, text in pages.items() if not p.is_file() or p.read_text(encoding="utf-8") != text]
    for trouble in troubles:
        print(trouble, file=sys.stderr)
    for path in differing:
        print(f"{path.name}: {'would change' if check else 'written'} ({mi_diffind.__version__})")
        if not check:
            path.write_text(pages[path], encoding="utf-8")
    return int(bool(troubles) or (check and bool(differing)))


if __name__ == "__main__":
    sys.exit(main("--check" in sys.argv[1:]))
