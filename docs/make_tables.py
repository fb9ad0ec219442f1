"""
Write the tables and the figures of the documentation.

    python docs/make_tables.py [--check]

``tasks.md`` is made from the declarations of tasks. In the other pages, the text between ``<!-- table NAME -->`` and
``<!-- end -->`` is made from JSON in ``docs/measured/``, which ``mi-diffind … --json docs/measured/NAME.json`` wrote;
the pages show the commands. Figures in sentences are inserted from the same files, as ``claims.toml`` says
(``claims.py``). A table that shows some of its rows has all of them in ``docs/measured/NAME.csv``. With ``--check``
nothing is written, and the exit code is 1 if a page or a CSV file would change.
"""

from __future__ import annotations

import csv
import importlib
import io
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from claims import ClaimError, claims, commands, files
from claims import measured as node
from derived import RATIO_FIGURES, equal_samples, ratio_best, ratio_loss, ratio_rows
from list_numbers import headlines

import mi_diffind
from mi_diffind.fitting.task import tasks
from mi_diffind.tasks import radiance as field_presets
from mi_diffind.tasks.image import arrays as image_budget
from mi_diffind.tasks.sdf import paper as sdf_paper
from mi_diffind.tasks.texture import arrays as texture_budget

DOCS = Path(__file__).resolve().parent


def measured(name: str) -> dict:
    """Return the JSON that a command wrote."""
    return json.loads((DOCS / "measured" / f"{name}.json").read_text(encoding="utf-8"))


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


def table(head: list[str], rows: list[list], shown: Callable[[list], bool] | None = None) -> Table:
    """Return a table; ``shown`` tells the rows that a page shows where there are more than ten."""
    return Table(head, rows, shown)


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
        parts.append(f"{table(['preset', 'steps', 'samples a step', 'learning rate', 'schedule', 'loss'], rows)}\n")
        if task.shipped:
            rows = []
            for preset in task.shipped:
                shipped = task.load(task.file(preset=preset))
                rows.append([
                    f"`{shipped.path.name}`", f"`{preset}`", f"{shipped.nbytes:,}",
                    f"{shipped.measured['psnr_db']:.1f}",
                    f"`mi-diffind fit {task.name} --preset {preset} -o {shipped.path.name}`",
                ])  # fmt: skip
            parts.append(f"{table(['file that ships', 'preset', 'bytes of entries', 'PSNR, dB', 'made by'], rows)}\n")
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
        names = sorted(set().union(*(files(e) for e in [*claim.values.values(), *filter(None, [claim.holds])])))
        sources = ", ".join(f"[{n}](measured/{n}.json)" for n in names) or "files that ship"
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
        "This page is made by `python docs/make_tables.py`; `python docs/list_numbers.py` lists the "
        "numbers that no file backs.",
        "## Headlines",
        "Tables and lists of the README, and the first paragraph of each page.",
        table(head, top),
        "## Files and commands",
        table(["file", "command"], written_by),
        "## Other sentences",
        table(head, rest),
    ]
    return "\n\n".join(map(str, parts)) + "\n"


def disney_forms() -> Table:
    """Return accuracy, bytes and time of each form of the Disney BRDF; times of networks are not measured."""
    study = measured("tradeoff_disney")
    columns = {
        "constant, all lobes": ("eval",),
        "constant, diffuse + specular": ("eval",),
        "textured, diffuse + specular": ("eval", "pdf"),
    }
    cases = study["cases"]
    timings = {f"{q}: {case}": cases[case]["queries"][q] for case, queries in columns.items() for q in queries}
    rows = []
    for name, candidate in {**study["candidates"], **measured("tradeoff_disney_network")["candidates"]}.items():
        if candidate["representation"] == "one table":
            continue
        errors = candidate["errors"]
        accuracy = " / ".join(f"{errors[k]:.1f}" for k in ("psnr_db_training", "psnr_db_uniform") if k in errors)
        times = [f"{t[name]['time'] / t['principled']['time']:.2f}" if name in t else "–" for t in timings.values()]
        rows.append([f"`{name}`", f"{candidate['bytes']:,}", accuracy or "–", *times])
    head = ["form", "bytes", "PSNR, dB: training / uniform", *timings]
    return table(head, rows, lambda row: row[0] != "`paper, float16`")


def _decibel(value: float | None) -> str:
    return "all is noise" if value is None else f"{value:.1f}"


def comparisons() -> Table:
    """Return errors and time ratios of the scenes by ``compare``, each against its truths."""
    rows = []
    for path in sorted((DOCS / "measured").glob("compare_*.json")):
        first = measured(path.stem)
        for f in (first, *first.get("further", ())):
            ratio = f["time_ratio"]
            uncertain = ratio["median"] is None or ratio["q3"] > 1.5 * ratio["q1"]
            rows.append([
                f"`{Path(f['scene']).name}`", f"{f['against']}, {f['truth_spp']} samples", f"{f['psnr_db']:.1f}",
                _decibel(f['psnr_without_noise_db']), f"{f['flip']:.4f}",
                "–" if f["truth_spp"] != f["spp"] else "not measurable" if uncertain else f"{ratio['median']:.2f}",
            ])  # fmt: skip
    columns = ["scene", "against", "PSNR, dB", "without noise", "FLIP", "time of a pass over that of the other"]
    return table(columns, rows)


def ggx_quality() -> Table:
    """Return costs of each family at the quality of an indirection, as multiples of it, beside the paper's."""
    from mi_diffind.studies.ggx.conclusions import equal_quality

    study, reference = measured("tradeoff_ggx"), "16→8"
    goal, rows = study["candidates"][reference]["errors"]["psnr_db"], []
    for row in equal_quality(study, reference):
        paper = [f" ({value:g})" for value in row.paper or ()] or [""] * 3
        ratios = [f"{ratio:.3g}{note}" for ratio, note in zip(row.ratios, [*paper, ""], strict=True)]
        rows.append([f"{row.family}: {row.name}", *ratios, f"{row.psnr_db - goal:+.1f}"])
    return table(["", "flops", "bytes read", "bytes stored", "time", "PSNR beside it, dB"], rows)


def ggx_candidates() -> Table:
    """Return bytes, PSNR and times of the float32 candidates for both kinds of inputs, without tensor networks."""
    study, rows = measured("tradeoff_ggx"), []
    for case, timings in ((name, case["queries"].get("read", {})) for name, case in study["cases"].items()):
        for name, timing in timings.items():
            c = study["candidates"][name]
            psnr = f"{c['errors']['psnr_db']:.1f}" if "psnr_db" in c["errors"] else "exact"
            rows.append([
                case, name.removesuffix(", log"), f"{c['bytes']:,}", psnr, f"{timing['time']:.2f}",
                "–" if psnr == "exact" else "yes" if c["converged"] else "no",
            ])  # fmt: skip
    head = ["inputs", "", "bytes", "PSNR, dB", "a read, ns", "converged"]
    return table(head, rows, lambda row: row[1] in GGX_CANDIDATES[row[0]])


#: Rows of the page's table of GGX, by the inputs.
GGX_CANDIDATES = {
    "inputs as in the paper": ("16→8", "16→8 u8", "24²", "96²", "192²", "MLP 32x3"),
    "logarithmic inputs": ("16→8", "16→8 u8", "24²", "MLP 32x3"),
}


def scenes_bias() -> Table:
    """Return bias of the tables, the samples at which noise equals it, and times of scenes, learned over exact."""
    rows = []
    for name, tables in (
        ("materials_paper", "`neural_disney`, `-D preset=paper`"), ("metals", "`neural_ggx`"),
        ("still_life", "`neural_disney`"),
    ):  # fmt: skip
        if not (DOCS / "measured" / f"tradeoff_scene_{name}.json").is_file():
            continue
        study = measured(f"tradeoff_scene_{name}")
        bias, spp = study["bias"], study["crossover"]["spp"]
        times = [ratio["median"] for ratio in study["ratios"]]
        rows.append([
            f"`{Path(study['scene']).name}`, {study['width']} × {study['height']}", tables,
            f"{100 * bias['rmse']:.2g}%, {bias['psnr_db']:.1f} dB", f"{float(f'{spp:.2g}'):,.0f} spp",
            f"{min(times):.2f} to {max(times):.2f}",
        ])  # fmt: skip
    return table(["scene", "tables", "bias", "the noise equals it at", "time, learned / exact"], rows)


def regress_power() -> Table:
    """Return alarms of regression checks of changed and unchanged scenes, and how often a promised change is found."""
    changes = ("unchanged", "colour −3%", "roughness +10%", "moved by 0.2%", "lamp −1%", "lamp −2%")
    rows = []
    for row in measured("regress_power")["rows"]:
        power, mode = row["power"], row["variant"].removeprefix("llvm_ad_")
        rows.append([
            f"{row['scene']}, {mode}, `{row['sampler']}`, {row['spp']}",
            *(f"{row['percent'][c]:.3g}% of {row['checks'][c]}" for c in changes),
            f"{100 * power['predicted_change']:.2g}%: {power['measured_percent']:.0f}%",
        ])  # fmt: skip
    return table(["scene, variant, sampler, spp", *changes, "tile: found"], rows)


def image_contenders() -> Table:
    """Return quality of a compressed material beside that of codecs in as many bytes."""
    rows = []
    for name, c in measured("tradeoff_image")["candidates"].items():
        e = c["errors"]
        if e and not name.startswith("bitmap"):
            steps = c["details"].get("steps")
            rows.append([
                name + (f", {steps:,} steps" if steps else ""), f"{c['bytes']:,}", f"{e['psnr_db']:.1f}",
                f"{e['psnr_between_db']:.1f}", f"{e['flip']:.4f}", f"{e['seen_db']:.1f}",
            ])  # fmt: skip
    return table(["", "bytes", "PSNR at texels, dB", "between texels", "FLIP", "as seen, dB"], rows)


def image_pages() -> Table:
    """Return PSNR of images and materials as one grid and as pages, in equal bytes and seconds."""
    rows = []
    for source in ("boombox", "tiles", "wood_color", "vase_color", "hammered_normal"):
        grid, pages = (measured(f"fit_image_{source}_{structure}") for structure in ("grid", "auto"))
        cells = [f"{f['measured']['psnr_db']:.1f} / {f['measured']['psnr_between_db']:.1f}" for f in (grid, pages)]
        structures = [f["settings"]["structure"] for f in (grid, pages)]
        rows.append([source, *(f"{c} ({n})" for c, n in zip(cells, structures, strict=True))])
    return table(["source", "one grid, the better of two", "what auto chooses"], rows)


def image_seen() -> Table:
    """Return errors as seen of materials with equal weights, and with those that ``--weights auto`` chooses."""
    rows = []
    for source, weights in (("boombox", ""), ("tiles", ""), ("rust", "auto"), ("brick", "auto")):
        equal = measured(f"fit_image_{source}_seen_equal")["measured"]
        auto = measured(f"fit_image_{source}_seen_{weights}")["measured"] if weights else equal
        ways = ("seen_glossy_near_db", "seen_glossy_far_db", "seen_rough_near_db", "seen_rough_far_db")
        maps = [n for n in equal if n.startswith("psnr_") and n not in ("psnr_db", "psnr_mean_db", "psnr_between_db")]
        worst = min(maps, key=lambda n: auto[n] - equal[n])
        lost = f"{worst[5:-3]} {auto[worst] - equal[worst]:+.2f}" if weights else "weights are equal"
        rows.append([
            source, f"{equal['psnr_db']:.1f}", f"{equal['angle_normal_deg']:.2f}",
            *(f"{equal[way]:.1f} / {auto[way]:.1f}" for way in ways), f"{equal['seen_db']:.1f} / {auto['seen_db']:.1f}",
            f"{100 * (equal['seen_brightness'] - 1):+.2f}%", lost,
        ])  # fmt: skip
    head = ["source", "PSNR of maps", "normals, °", "glossy near", "glossy far", "rough near", "rough far", "all"]
    return table([*head, "brightness", "auto: the map that loses most"], rows)


def image_bytes() -> Table:
    """Sizes of the sources: raw, as the PNG files of the repository, and compressed."""
    assets, rows = DOCS.parent / "scenes" / "assets", []
    for source in ("tiles", "wood_color", "vase_color", "hammered_normal"):
        fit = measured(f"fit_image_{source}_auto")
        files = [assets / f"{source}.png"] if source != "tiles" else sorted(assets.glob("tiles_*.png"))
        sizes = (fit["source_bytes"], sum(f.stat().st_size for f in files), fit["bytes"])
        rows.append([source, *(f"{n:,}" for n in sizes), f"{sizes[1] / sizes[2]:.1f}x"])
    return table(["source", "raw bytes", "bytes of the PNG files", "bytes at 12x", "of PNG"], rows)


#: Rows of the pages' tables of renders.
RENDERS = (
    "bitmap, 1 spp", "bitmap, 4 spp", "bitmap, 4 spp, multijittered", "bitmap, 16 spp, multijittered",
    "mipmap, trilinear", "ours 12x, trilinear", "ours 12x, anisotropic, centred", "ASTC 12x, trilinear",
    "ASTC 12x, anisotropic, centred", "network 12x, trilinear",
)  # fmt: skip


def with_network(study: dict) -> dict:
    """Return the study of filtered tiles with the network of ``tradeoff_texture_network``, whose times are not used."""
    network = measured("tradeoff_texture_network")
    return {**study, **{key: {**study[key], **network[key]} for key in ("candidates", "jobs")}}


def texture_renders(study: dict) -> Table:
    """Return errors, flicker and times of renders with filtered textures; "–": a time is not measured."""
    stages, base, steady = list(study["details"]["counted"]), "bitmap, 1 spp", "bitmap, 4 spp"
    flicker = study["candidates"][steady]["errors"]["flicker_error"]
    rows = []
    for name, c in study["candidates"].items():
        if "flicker" not in c["errors"]:
            continue
        e = c["errors"]
        ratios = [study["cases"][s]["ratios"]["render"].get(f"{name} / {base}", {}).get("median") for s in stages]
        times = ["1.00" if name == base else "–" if ratio is None else f"{ratio:.2f}" for ratio in ratios]
        rows.append([
            f"`{name}`", f"{c['bytes']:,}", *(f"{e[f'psnr_{s}_db']:.1f} / {e[f'flip_{s}']:.4f}" for s in stages),
            f"{e['flicker_error'] / flicker:.2f}", " / ".join(times),
        ])  # fmt: skip
    head = ["", "bytes, 8 bits a number"]
    head += [*(f"{s}: PSNR, dB / FLIP" for s in stages), "flicker", f"time: {' / '.join(stages)}"]
    return table(head, rows, lambda row: row[0].strip("`") in RENDERS)


def texture_factors(study: dict) -> Table:
    """Return how many times as long a bitmap takes for the same error."""
    from mi_diffind.studies.texture.conclusions import speed

    stages, rows = [s for s, c in study["cases"].items() if c["in_picture"]], []
    for name, c in study["candidates"].items():
        if c["representation"].startswith("bitmap") or not c["errors"]:
            continue
        cells = []
        for stage in stages:
            speeds = [speed(study, stage, name, against) for against in ("bitmap", "bitmap, multijittered")]
            cells.append(" / ".join(f"{'> ' * more}{value:.1f}" for value, more in speeds))
        rows.append([f"`{name}`", *cells])
    head = ["", *(f"{s}: independent / multijittered" for s in stages)]
    return table(head, rows, lambda row: row[0].strip("`") in RENDERS)


def texture_levels(study: dict) -> Table:
    """Return PSNR of each level of detail."""
    from mi_diffind.studies.texture.conclusions import levels

    by_name = levels(study)
    count = max(len(v["all"]) for v in by_name.values())
    rows = [
        [name, f"{study['jobs'][name]['details']['ratio']:.1f}x", *(f"{v:.1f}" for v in values["all"])]
        for name, values in by_name.items()
    ]
    return table(["", "ratio", *(f"L{i}" for i in range(count))], rows)


def texture_presets() -> Table:
    """Return PSNR of our preset and of the paper's, trained as long."""
    rows = []
    for source in ("boombox", "boombox_albedo"):
        for preset in ("ours", "paper"):
            f = measured(f"fit_texture_{source}_{preset}")
            by_level = [v for k, v in f["measured"].items() if re.fullmatch(r"psnr_l\d+_db", k)]
            mean = 100 * f["measured"]["mean_error"]
            rows.append(
                [source, preset, f"{f['bytes']:,}", f"{f['step']:,}", *(f"{v:.1f}" for v in by_level), f"{mean:.2f}%"]
            )
    head = ["source", "preset", "bytes", "best step", *(f"L{i}" for i in range(len(by_level))), "mean off by"]
    return table(head, rows)


def texture_footprints() -> Table:
    """Return relative errors of footprints, medians and 90th percentiles, of the side and of the major axis."""
    rows = [
        [name, *(f"{100 * median:.2g}, {100 * worst:.2g}%" for median, worst in errors)]
        for name, errors in measured("bench_footprint")["rows"].items()
    ]
    easy = ("plane, field of view 60°", "sphere, field of view 60°", "vase, field of view 90°")
    easy += ("knot, field of view 60°", "flat mirror")
    return table(["", "side", "major axis"], rows, lambda row: row[0] not in easy)


def texture_equal_samples() -> Table:
    """Return how many samples of a bitmap have the error of one filtered sample, on the plane of boombox."""
    study, rows = node("tradeoff_texture_boombox"), []
    for name, label in (
        ("ours 12x, trilinear", "`trilinear`, the default"),
        ("ours 12x, anisotropic, centred", "`anisotropic`, `jitter` false (centred)"),
    ):  # fmt: skip
        psnr = study.candidates[name].errors.psnr_plane_db
        counts = [equal_samples(study, "plane", name, sampling) for sampling in ("", "multijittered")]
        rows.append([label, f"{psnr:.1f} dB", *(f"{count:.0f}" for count in counts)])
    return table(["filter", "PSNR", "independent samples", "multijittered samples"], rows)


def texture_memory() -> Table:
    """Return the resident memory of a scene with many textures."""
    memory = measured("texture_memory")
    rows = [
        [f"`{name}`", f"{row['bytes'] / 2**20:.1f}", f"{row['times_less']:.1f}"]
        for name, row in memory["textures"].items()
    ]
    return table([f"{memory['count']} textures of {memory['side']}²", "MiB", "times less"], rows)


def texture_reads() -> Table:
    """Return the times of filtered reads, as multiples of those of bitmaps, before this version's reads and now."""
    before, now = (measured(name)["reads"] for name in ("bench_texture_before", "bench_texture"))
    head = ["table", "hits", "maps", "`off`", "`trilinear`", "`anisotropic`"]
    rows = []
    for old, new in zip(before, now, strict=True):
        costs = [
            f"{old['textures'][name]['ratio']:.2f} → **{new['textures'][name]['ratio']:.2f}**"
            for name in new["textures"]
            if name != "bitmap"
        ]
        rows.append([new["table"].removesuffix(".npz"), new["hits"], new["maps"], *costs])
    return table(head, rows)


def shading_curves(*studies: str) -> dict:
    """Return the results of the study of shading by material."""
    from mi_diffind.studies.shading.conclusions import curves

    return {name: material for study in studies for name, material in curves(measured(study)).items()}


def with_spread(values: list[float]) -> str:
    """Return a mean with half the range, if there are several values."""
    return f"{mean(values):.2f}" + (f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else "")


def shading_best(*studies: str) -> Table:
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
            cells = [with_spread([d["C"]["mean_db"] for d in runs])]
            cells += [f"{mean(mean(d['C']['flip']) for d in runs):.3f}"]
            cells += [f"{mean(d['C']['psnr_db'][level] for d in runs):.1f}" for level in range(6)]
            rows.append([name, label, *cells, f"{mean(d['P']['mean_db'] for d in runs):.2f}"])
    head = ["material", "", "C, dB", "FLIP", *(f"L{i}" for i in range(6)), "P, dB"]
    return table(head, rows)


def shading_shares(*studies: str) -> Table:
    """Return the paper's figure 2 as a table: quality by λ, with the spread over seeds."""
    from mi_diffind.studies.shading.conclusions import trouble

    rows, materials = [], shading_curves(*studies)
    shares = sorted({share for material in materials.values() for _, share in material.runs})
    for name, material in materials.items():
        for way in material.remedies:
            met = trouble([d for share in shares if share for d in material.runs.get((way, share), [])])
            for letter in "CP":
                values = [material.values(way, share, letter) for share in shares]
                rows.append([name, way, letter, *(with_spread(v) if v else "–" for v in values), met or "none"])
    return table(["material", "", "", *(f"λ {share:g}" for share in shares), "trouble"], rows)


def shading_extras(study: str) -> Table:
    """Return errors of textures of the first seed, trained for shading without and with extras."""
    jobs, rows = measured(study)["jobs"], []
    for name, material in shading_curves(study).items():
        without = f"lambda 0.9, {material.remedies[0]}, seed 0"
        for label, job in (("without", without), ("with", "extras, seed 0")):
            record = jobs[f"{name}, {job}"]
            c = record["details"]["C"]
            rows.append([name, label, f"{record['bytes']:,}", f"{c['mean_db']:.2f}", f"{mean(c['flip']):.3f}",
                         *(f"{psnr:.1f}" for psnr in c["psnr_db"])])  # fmt: skip
    return table(["material", "extras", "bytes", "C, dB", "FLIP", *(f"L{i}" for i in range(6))], rows)


def shading_renders() -> Table:
    """Return errors and times of whole renders, bytes, and the time of a training step over that of the first row."""
    study = measured("tradeoff_shading_renders")
    left_out = ("principled + bitmaps, multijittered, 1 spp", "disney + bitmaps, 1 spp", "disney + mip maps, 1 spp")
    kept = ("principled + bitmaps, multijittered, 4 spp", "principled + bitmaps, multijittered, 16 spp")
    rows = []
    for points in zip(*(scene["points"] for scene in study["scenes"].values()), strict=True):
        name, spp = points[0]["name"], points[0]["spp"]
        cells = (f"{p['psnr_db']:.1f} / {p['cpu_ms']['median']:.0f}" for p in points)
        step = study["steps"].get(name)
        rows.append([f"{name}, {spp} spp", f"{study['bytes'][name]:,}", *cells,
                     f"{step['ratio']['median']:.2f}" if step and spp == 1 else ""])  # fmt: skip
    head = ["", "bytes", *study["scenes"], "training step"]
    return table(head, rows, lambda row: row[0] in kept or (row[0].endswith(", 1 spp") and row[0] not in left_out))


def material_times() -> Table:
    """Return the cost of a pass with each form of a material, as multiples of separate plugins."""
    study = measured("bench_material")
    separate = study["frame"]["normalmap + disney + 4 neural_texture"]["operations"]
    rows = []
    for name, figures in study["frame"].items():
        counts = (figures["operations"][key] / separate[key] for key in ("instructions", "flops", "gathers"))
        ratios = (study[size].get(name, {}).get("ratio") for size in ("fixed", "frame", "step"))
        times = (f"{r['median']:.2f} ({r['q1']:.2f} to {r['q3']:.2f})" if r else "–" for r in ratios)
        rows.append([f"`{name}`", *(f"{count:.2f}" for count in counts), *times])
    return table(["material", "instructions", "flops", "reads", "8 × 8 pixels", "960 × 640", "training step"], rows)


#: Contenders of the study of learned BSDFs, in columns.
BSDF_CONTENDERS = ("ours", "table", "plain", "paper", "network, warped", "network, raw", "measured")


def bsdf() -> Table:
    """Return the PSNR of learned BSDFs and of what they are compared with."""
    candidates, rows = measured("tradeoff_bsdf")["candidates"], []
    for material in measured("tradeoff_bsdf")["cases"]:
        by_name = {name: candidates.get(f"{material}: {name}") for name in BSDF_CONTENDERS}
        psnr = [f"{c['errors']['psnr_db']:.1f}" if c else "–" for c in by_name.values()]
        proxy = f"{by_name['ours']['errors']['psnr_proxy_db']:.1f}"
        rows.append([material, f"{by_name['ours']['bytes']:,}", proxy, *psnr])
    return table(["material", "bytes", "proxy alone", *BSDF_CONTENDERS], rows)


def bsdf_times() -> Table:
    """Return albedo, noise of sampling and times of learned BSDFs."""
    result, rows = measured("tradeoff_bsdf"), []
    for material, case in result["cases"].items():
        name = f"{material}: ours"
        errors = result["candidates"][name]["errors"]

        def ratio(query, other, case=case, name=name, material=material):
            times = case["ratios"][query].get(f"{name} / {material}: {other}")
            return f"{times['median']:.2f}" if times else "–"

        queries = ("eval", "eval_pdf", "sample")
        rows.append([
            material, f"{100 * errors['albedo_excess']:.2f}%",
            f"{errors['moment_learned']:.2f} / {errors['moment_native']:.2f}",
            " / ".join(ratio(query, "principled") for query in queries),
            " / ".join(ratio(query, "source") for query in queries),
            " / ".join(ratio(query, "measured") for query in queries),
        ])  # fmt: skip
    head = ["material", "albedo", "moment", "of `principled`'s time", "of the source's", "of `measured`'s"]
    return table(head, rows)


def bsdf_families() -> Table:
    """Return the errors of learned families at random members."""
    rows = []
    for name, label in (
        ("plastic", "`roughplastic`, nonlinear, alpha from 0.02 to 0.8"),
        ("principled", "`principled`, roughness from 0.05 to 1, metallic from 0 to 1"),
    ):  # fmt: skip
        if not (DOCS / "measured" / f"inspect_family_{name}.json").is_file():
            continue
        f = measured(f"inspect_family_{name}")
        e = f["measured"]
        psnr = (e[key] for key in ("psnr_db", "psnr_median_db", "psnr_minimum_db"))
        rows.append([
            label, f"{f['bytes']:,}", " / ".join(f"{value:.1f}" for value in psnr), f"{100 * e['albedo_excess']:.2f}%",
            f"{e['sample_weight_moment']:.2f}",
        ])  # fmt: skip
    return table(["family", "bytes", "PSNR, dB: mean / median / least", "albedo", "moment"], rows)


def shading_distances() -> Table:
    """Return the PSNR of materials before and after training for their shading, as seen from three distances."""
    rows = []
    for name, study in measured("bench_shading_distances").items():
        pairs = ((f["before"]["psnr_db"], f["after"]["psnr_db"]) for f in study["seen"].values())
        figures = (f"{before:.1f} → {after:.1f}" for before, after in pairs)
        rows.append([name, f"{study['level_bias']:g}", "yes" if study["fixed"] else "no", *figures])
    return table(["material", "level bias", "fine levels fixed", "near, dB", "middle, dB", "far, dB"], rows)


def rust() -> Table:
    """Return the errors of the scene rust at one sample a pixel, before and after training for its shading."""
    figures, rows = measured("rust"), []
    for name in ("rust_plain.npz", "rust_shaded.npz"):
        f = figures[name]
        brightness = f"{100 * (f['brightness'] - 1):+.1f}%"
        rows.append([f"`{name}`", f"{f['bytes']:,}", f"{f['psnr_db']:.1f}", f"{f['flip']:.3f}", brightness])
    return table(["texture", "bytes", "PSNR, dB", "FLIP", "brightness"], rows)


def scene_training() -> Table:
    """Return errors of held-out views and lights after training inside a scene and over the hemisphere."""
    rows = []
    for path in sorted((DOCS / "measured").glob("tradeoff_scene_training_*.json")):
        runs = [record["details"] for record in measured(path.stem)["jobs"].values()]
        weights = [d["lambda"] for d in runs if d["lambda"] is not None]
        for d in runs:
            name = d["way"]
            name += f", λ {d['lambda']:g}" if d["lambda"] not in (None, *weights[:1]) else ""
            name += f", {d['spp']} samples a pixel" if d["spp"] != runs[0]["spp"] else ""
            times = [f"{d[key]:.{digits}f}" if key in d else "–" for key, digits in TRAINING_FIGURES.items()]
            rows.append([d["scene"], name, f"{d['psnr_db']:.2f}", f"{d['flip']:.3f}", *times])
    head = ["scene", "run", "PSNR, dB", "FLIP", "steps", "processor s", "level bias"]
    return table(head, rows, lambda row: row[1] in SCENE_RUNS[row[0]])


#: Runs of the page's table of trainings inside a scene, by the scene.
SCENE_RUNS = {
    "balls": ("scene", "hemisphere", "hemisphere, then scene", "another material, then scene"),
    "corner": ("scene", "hemisphere", "hemisphere, then scene"),
    "floor": ("scene", "hemisphere, longer", "hemisphere, then scene"),
}

#: Figures of a training in the table above, and their digits.
TRAINING_FIGURES = {"steps": 0, "processor_seconds": 0, "level_bias": 1}


def sdf_errors(study: str) -> Table:
    """Return errors of distance fields in equal bytes: IoU, IoU near the surface, normals."""
    from mi_diffind.studies.equal_memory import candidates_by_budget
    from mi_diffind.studies.sdf.conclusions import size_text

    sizes = candidates_by_budget(measured(study))
    rows: dict[str, dict[int, str]] = {}
    for size, candidates in sizes.items():
        for c in candidates.values():
            e = c["errors"]
            cell = f"{e['iou']:.4f} / {e['iou_near']:.4f} / {e['normal_deg']:.2f}°"
            rows.setdefault(c["label"], {})[size] = cell
    lines = [[name, *(row.get(s, "") for s in sizes)] for name, row in rows.items()]
    shown = (lambda row: row[0] != "8³ bricks") if len(lines) > 10 else None
    return table(["", *map(size_text, sizes)], lines, shown)


def sdf_times(study: str) -> Table:
    """Return times of distance fields of one size: seconds of the fit, reads, rays, renders."""
    result = measured(study)
    reads, rays = (result["cases"][case] for case in ("reads", "rays"))
    rows = []
    for name, c in result["candidates"].items():
        if name not in rays["queries"]["ray"] and name not in reads["queries"]["value"]:
            continue
        cells = [reads["queries"][q].get(name) for q in ("value", "normal")]
        cells += [rays["queries"]["ray"].get(name), rays["passes"].get("render", {}).get(name)]
        seconds = "" if c["is_reference"] else f"{c['training_seconds']:.0f}"
        rows.append([c["label"], f"{c['bytes']:,}", seconds, *("" if t is None else f"{t['time']:.3g}" for t in cells)])
    head = ["", "bytes", "seconds", "a distance, ns", "a gradient, ns", "a primary ray, ns", "a render, ms"]
    trained = ("dense grid", "8³ bricks", "sparse distances")  # their trained or finer forms stay
    return table(head, rows, lambda row: row[0] not in trained)


def sdf_parts(study: str) -> Table:
    """Return errors of distance fields with parts of ours left out or changed, in equal bytes."""
    rows = []
    for c in measured(study)["candidates"].values():
        e = c["errors"]
        rows.append([
            c["label"], f"{c['bytes']:,}", f"{e['iou']:.4f} / {e['iou_near']:.4f}",
            f"{e['normal_deg']:.2f}° / {e['normal_p95_deg']:.1f}°", f"{e['components']:,}" if "components" in e else "",
        ])  # fmt: skip
    head = ["", "bytes", "IoU / within 0.01", "normals: mean / 95%", "pieces"]
    return table(head, rows, lambda row: row[0] != "16 bits a node, not trained")


def sdf_rays() -> Table:
    """Return times of rays through the arrays of distance fields and through ``sdfgrid``, beside Embree."""
    rows = []
    for file in measured("bench_sdf")["files"]:
        for rays in ("primary", "random"):
            mesh, *others = (row for row in file["rows"] if row["rays"] == rays)
            arrays = others.pop()
            rows.append([
                f"{file['name']}, {file['triangles']:,} triangles", rays, f"{mesh['ns']:.0f}", f"{arrays['ratio']:.1f}",
                *(f"{row['ratio']:.1f}" for row in others), f"{100 * arrays['hits_differ']:.3f}%",
            ])  # fmt: skip
    times = (f"{row['name']}, times that" for row in (arrays, *others))
    return table(["mesh", "rays", "Embree, ns", *times, "hits that differ"], rows)


#: Studies of radiance fields whose network trained its density alone, by an error that is mended; left out.
UNTRAINED = ("tradeoff_field", "tradeoff_field_50")


def method_of(candidate: dict) -> str:
    """Return the method of a contender."""
    return candidate["details"].get("kind", "")


def field_longer() -> Table:
    """Return planes and the network of the radiance-field study after a longer training, beside their grid."""
    rows = []
    for c in measured("tradeoff_field_long")["candidates"].values():
        e, d = c["errors"], c["details"]
        seconds = "" if c["is_reference"] else f"{c['training_seconds']:.0f}"
        rows.append([
            c["label"], seconds, f"{d['steps']:,}", f"{d['memory_bytes'] / 1e6:.2f}", f"{d['file_bytes'] / 1e6:.2f}",
            f"{e['psnr_white_db']:.2f}", f"{e['psnr_foreground_db']:.2f}",
        ])  # fmt: skip
    return table(["", "seconds", "steps", "MB in memory", "MB on disk", "dB, white", "dB, foreground"], rows)


def field_errors(study: str) -> Table:
    """Return PSNR of radiance fields by how many times smaller than a dense grid they are."""
    from mi_diffind.studies.equal_memory import candidates_by_budget
    from mi_diffind.studies.radiance.conclusions import ratio_text, references

    result = measured(study)
    rows = []
    for candidates in (references(result), *candidates_by_budget(result).values()):
        for c in candidates.values():
            if study in UNTRAINED and method_of(c) == "hash":
                continue
            e, d = c["errors"], c["details"]
            rows.append([
                c["label"], ratio_text(d["asked"]) if d.get("asked") else "", f"{d['memory_bytes'] / 1e6:.2f}",
                f"{d['file_bytes'] / 1e6:.2f}", f"{e['psnr_white_db']:.2f}", f"{e['psnr_foreground_db']:.2f}",
            ])  # fmt: skip
    head = ["", "asked for", "MB in memory", "MB on disk", "dB, white", "dB, foreground"]
    shown = (lambda row: (row[0], row[1]) in FIELD_CONTENDERS) if len(rows) > 10 else None
    return table(head, rows, shown)


#: Rows of the page's table of radiance fields: those that are as good as ours or better, and the paper's.
FIELD_CONTENDERS = [("grid", ""), ("paper", "75×")] + [
    (name, ratio)
    for name in ("sparse grid, 6-bit colours", "principal components", "codebook", "ours")
    for ratio in ("75×", "200×")
]


def field_times(study: str) -> Table:
    """Return times of radiance fields of one size: seconds of training, a sample, a picture."""
    result = measured(study)
    reads = result["cases"]["reads"]
    both, passes = reads["queries"]["both"], next(iter(reads["passes"].values()), {})
    rows = []
    for name, c in result["candidates"].items():
        if (name in both or name in passes) and not (study in UNTRAINED and method_of(c) == "hash"):
            cells = [both.get(name), passes.get(name)]
            texts = ["" if t is None else f"{t['time']:.3g}" for t in cells]
            rows.append([c["label"], "" if c["is_reference"] else f"{c['training_seconds']:.0f}", *texts])
    side = result["details"]["request"]["film"]
    return table(["", "seconds", "a sample, ns", f"{side}², ms"], rows)


def field_parts() -> Table:
    """Return errors of radiance fields with parts of the compression left out."""
    rows = [
        [
            row["name"], f"{row['bytes'] / 1e6:.2f}" if "bytes" in row else "", f"{row['psnr_white_db']:.2f}",
            f"{row['psnr_foreground_db']:.2f}",
        ]
        for row in measured("bench_field")["rows"]
    ]  # fmt: skip
    return table(["", "MB in memory", "dB, white", "dB, foreground"], rows)


def field_captures() -> Table:
    """Return errors and bytes of three captures, as a grid and compressed."""
    rows = []
    for name, content in (
        ("group", "Suzanne, a painted vase, a knot, a pear"), ("thin", "a plant in a globe of wires"),
        ("glossy", "clear-coated, golden, steel and plastic things"),
    ):  # fmt: skip
        grid, compressed = measured(f"inspect_field_{name}_grid"), measured(f"inspect_field_{name}")
        figures = [
            f"{f['measured']['psnr_white_db']:.2f} / {f['measured']['psnr_foreground_db']:.2f}"
            for f in (grid, compressed)
        ]
        sizes = [
            f"{nbytes / 1e6:.2f} ({compressed['dense_bytes'] / nbytes:.0f}x)"
            for nbytes in (compressed["memory_bytes"], compressed["file_bytes"])
        ]
        rows.append([f"{name}: {content}", *figures, *sizes])
    return table(["", "grid, dB", "compressed, dB", "MB in memory", "MB on disk"], rows)


def field_surroundings() -> Table:
    """Return figures of a capture without alpha, with and without surroundings."""
    rows = []
    for name, row in measured("bench_surroundings")["rows"].items():
        rows.append([
            name, f"{row['psnr_white_db']:.2f}", f"{row['ssim_white']:.3f}", f"{row['file_bytes'] / 1e6:.1f}",
            f"{row['cpu_minutes']:.1f}",
        ])  # fmt: skip
    return table(["", "dB", "SSIM", "MB on disk", "minutes of a core"], rows)


#: Figures for NeRF's synthetic scene lego at 800²: method, paper, dB before white, MB on disk as far as it is stated.
PUBLISHED_LEGO = (
    ("DVGO", "Sun et al. 2022", "34.6", ""),
    ("Plenoxels", "Fridovich-Keil et al. 2022", "34.1", ""),
    ("TensoRF-VM", "Chen et al. 2022", "36.5", ""),
    ("Instant-NGP", "Müller et al. 2022", "36.4", ""),
    ("VQRF", "Li et al. 2023", "about 34", ""),
    ("CNC, HAC++", "Chen et al. 2024, 2025", "33 to 36", "0.4 to 2"),
)


def field_nerf() -> Table:
    """Return figures of NeRF's synthetic scenes: as measured here, and as published for lego."""
    rows, path = [], DOCS / "measured" / "nerf_scenes.json"
    for row in measured(path.stem)["rows"] if path.is_file() else ():
        rows.append([
            f"{row['scene']}, {row['side']}²", f"{row['method']}, measured", f"{row['psnr_white_db']:.2f}",
            f"{row['ssim_white']:.3f}", f"{row['file_bytes'] / 1e6:.2f}", f"{row['minutes']:.0f}",
            f"{row['peak_bytes'] / 1e9:.1f}", f"{row['machine']['cores']} cores, {row['machine']['cpu']}",
        ])  # fmt: skip
    for method, paper, decibels, megabytes in PUBLISHED_LEGO:
        rows.append(["lego, 800²", f"{method} ({paper}), claimed", decibels, "", megabytes, "", "", ""])
    return table(["scene", "method", "dB, white", "SSIM", "MB on disk", "minutes", "peak memory, GB", "machine"], rows)


def ratios(task: str) -> Table:
    """Return errors of a sweep of ρ at equal bytes, the best in bold, beside the paper's best ρ."""
    study, figure, rows = node("bench_ratio"), RATIO_FIGURES[task], []
    tables = {"image": image_budget.RATIOS, "texture": texture_budget.RATIOS, "sdf": sdf_paper.RATIOS}
    digits, unit = (2, " °") if task == "sdf" else (1, " dB")
    of_task = [row for row in study.content["rows"] if row["task"] == task]
    for preset, budget, part in dict.fromkeys(
        (row["preset"], row["budget"], row["part"]) for row in of_task if row["default"]
    ):
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
    names = {"image": "PSNR at texels", "texture": "mean PSNR of levels", "sdf": "angle", "field": "PSNR of foreground"}
    head = ["preset, budget", f"ρ: {names[task]},{unit}", "default ρ"]
    return table([*head, "behind the best by", "paper's best ρ"], rows)


def trust() -> Table:
    """Return one row a plugin: the worst figure of each property over the variants that were measured."""
    rows = []
    for name, by_variant in measured("trust")["cells"].items():
        row = [f"`{name}`"]
        for prop in next(iter(by_variant.values())):
            cells = [by_variant[variant][prop] for variant in by_variant]
            failed, held = ([c for c in cells if c["result"] == word] for word in ("fails", "holds"))
            figures = [c["figure"] for c in failed or held if c["figure"] is not None]
            text = f"{max(figures):.3g}" if figures else "error" if failed else ""
            if failed:
                text = f"**fails: {text}** ({len(failed)} of {len(failed) + len(held)})"
            elif not held:
                text = "–" if any(c["result"] == "does not apply" for c in cells) else "not run"
            row.append(text if failed or not held else f"{text} ({len(held)})")
        rows.append(row)
    head = ["plugin", "albedo, at most", "reciprocity", "χ² rejected", "furnace", "gradients", "gradients, float32"]
    return table(head, rows)


def viewer() -> Table:
    """Return pictures a second of the viewer."""
    rows = []
    for row in measured("bench_view")["rows"]:
        sides, (width, height) = "" if row["sides"] == 2 else ", learned side only", row["size"]
        rows.append([
            f"`{row['scene']}.xml`{sides}", f"{width} x {height}", f"{row['pictures_a_second']:.1f}",
            f"{row['speedup']:.1f}", f"{row['seconds_changed']['median']:.2f}",
        ])  # fmt: skip
    return table(["scene", "pixels", "pictures a second", "speedup", "s after a slider moved"], rows)


def mean(values) -> float:
    """Return the mean of an iterable."""
    values = list(values)
    return sum(values) / len(values)


TABLES = {
    f.__name__: f
    for f in (
        disney_forms,
        comparisons,
        ggx_candidates,
        ggx_quality,
        scenes_bias,
        regress_power,
        image_contenders,
        image_bytes,
        image_pages,
        image_seen,
        material_times,
        bsdf,
        bsdf_families,
        bsdf_times,
        shading_distances,
        scene_training,
        texture_equal_samples,
        texture_footprints,
        texture_memory,
        texture_presets,
        texture_reads,
        trust,
    )
}
for source in ("", "_boombox"):
    for make in (texture_renders, texture_factors):
        TABLES[make.__name__ + source] = lambda make=make, source=source: make(measured(f"tradeoff_texture{source}"))
TABLES |= {
    "rust": rust,
    "shading_best": lambda: shading_best("tradeoff_shading", "tradeoff_shading_boombox"),
    "shading_shares": lambda: shading_shares("tradeoff_shading_lambda"),
    "shading_extras": lambda: shading_extras("tradeoff_shading_lambda"),
    "shading_shares_paper": lambda: shading_shares("tradeoff_shading_paper"),
    "shading_renders": shading_renders,
}
for source in ("suzanne", "armadillo", "bunny"):
    for make in (sdf_errors, sdf_times):
        TABLES[f"{make.__name__}_{source}"] = lambda make=make, source=source: make(f"tradeoff_sdf_{source}")
TABLES |= {"sdf_parts": lambda: sdf_parts("tradeoff_sdf_parts_armadillo"), "sdf_rays": sdf_rays}
TABLES |= {
    "field_errors": lambda: field_errors("tradeoff_field"),
    "field_longer": field_longer,
    "field_times": lambda: field_times("tradeoff_field"),
    "field_parts": field_parts, "field_captures": field_captures, "field_nerf": field_nerf,
    "field_surroundings": field_surroundings,
}  # fmt: skip
for source, study in (("", "tradeoff_texture"), ("_boombox", "texture_levels_boombox")):
    TABLES["texture_levels" + source] = lambda study=study: texture_levels(measured(study))
TABLES["texture_renders"] = lambda: texture_renders(with_network(measured("tradeoff_texture")))
TABLES["texture_levels"] = lambda: texture_levels(with_network(measured("tradeoff_texture")))
TABLES["viewer"] = viewer
TABLES |= {f"ratios_{task}": lambda task=task: ratios(task) for task in RATIO_FIGURES}


def film_errors() -> Table:
    """PSNR of the panels of films against their truth."""
    figures = {f"`{name}`": measured(f"film_{name}")["psnr_db"] for name in ("zoom", "orbit", "shading")}
    return table(
        ["film", "panel", "PSNR, dB"],
        [[name, label, f"{db:.1f}"] for name, panels in figures.items() for label, db in panels.items()],
    )


def film_bytes() -> Table:
    """Sizes of films in three formats."""
    films = {name: measured(f"film_{name}") for name in ("suite", "zoom", "orbit", "shading")}
    return table(
        ["film", "pixels", "frames", "WebP, kB", "GIF, kB", "H.264, kB"],
        [
            [f"`{name}`", f"{f['width']} × {f['height']}", f["frames"],
             *(f"{f['bytes'][extension] / 1000:,.0f}" for extension in ("webp", "gif", "mp4"))]
            for name, f in films.items()
        ],
    )  # fmt: skip


TABLES |= {f.__name__: f for f in (film_errors, film_bytes)}
sys.path.insert(0, str(DOCS))
TABLES |= importlib.import_module("cost_table").tables(table)


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
