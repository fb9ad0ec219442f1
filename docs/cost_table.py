"""Cost of accuracy, task by task: ours, what a user would take instead, the paper's recipe, from ``docs/measured``.

:func:`rows` reads the JSON of the studies and of ``bench_backward``. :func:`tables` makes the tables of ``cost.md`` for
``make_tables.py``; ``make_cost.py`` draws ``cost.jpg`` from the same rows.
"""

from __future__ import annotations

import math
import re
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, field

from figures import commands, measured

#: Of which training the bytes on disk of the paper's recipe are.
TRAINED = "Bytes on disk of the paper's recipe are those after two minutes of training."

#: Error of a contender that defines the truth of its row.
EXACT = math.inf

MISSING = "not measured"

#: End of a line within a cell, and the names of the lines.
LINE = "<br>"
NAMES = LINE.join(("**ours**", "instead", "paper"))

#: JSON file → command that wrote it, without the file's name.
COMMANDS = {name: re.sub(r" --json docs/measured/\S+", "", command) for name, command in commands().items()}


@dataclass(frozen=True)
class Contender:
    """Figures of a contender; ``None``: not measured.

    ``error`` in the unit of its row; ``render`` and ``step``: times over those of what a user would take instead;
    ``memory`` and ``disk`` in bytes.
    """

    error: float | None = None
    render: float | None = None
    step: float | None = None
    memory: float | None = None
    disk: float | None = None


@dataclass(frozen=True)
class Row:
    """A task: names of what a user would take instead, unit of the error, contenders.

    ``better``: whether a larger ``error`` is better, as for a PSNR. ``others`` are shown in the picture alone.
    ``sources``: figures and the JSON files that they come from. ``note``: why cells are not
    measured, and what else a reader should know. ``cells``: texts in place of cells. ``behind``: where ours loses
    beyond the figures of the row.
    """

    task: str
    page: str
    instead: str
    error: str
    unit: str
    ours: Contender
    theirs: Contender
    paper: Contender
    sources: dict[str, str]
    note: str = ""
    better: bool = True
    others: dict[str, Contender] = field(default_factory=dict)
    cells: dict[str, str] = field(default_factory=dict)
    behind: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The task beside what a user would take instead."""
        return f"{self.task} beside {self.instead}"


def size_text(nbytes: float) -> str:
    """Return a number of bytes with three digits."""
    for unit, scale in (("MB", 1e6), ("kB", 1e3)):
        if nbytes >= scale:
            return f"{nbytes / scale:.3g} {unit}"
    return f"{nbytes:.0f} B" if nbytes else "none"


def times(task: str, contender: str, base: str = "") -> dict[str, float | None]:
    """Return ``render`` and ``step`` of a contender of ``bench_backward``, over those of the first contender.

    Over those of ``base``, if it is given, as a ratio of medians. A step without a finite derivative that differs from
    zero is not measured.
    """
    result, ratios = measured("bench_backward")["tasks"][task], {}
    for size in ("render", "step"):
        figures, of_base = result[size][contender], result[size].get(base or contender, {})
        if base and "cpu_ms" in figures and "cpu_ms" in of_base:
            ratios[size] = figures["cpu_ms"]["median"] / of_base["cpu_ms"]["median"]
        else:
            ratios[size] = figures["ratio"]["median"] if "ratio" in figures and not base else None
    return ratios | ({} if result["step"][contender].get("parameters") else {"step": None})


def benched(error: float | None, task: str, contender: str, base: str = "", **sizes) -> Contender:
    """Return a contender with times and bytes of ``bench_backward``; ``sizes`` take the place of its bytes."""
    known = measured("bench_backward")["bytes"][task].get(contender, {})
    return Contender(error, **times(task, contender, base), **{**known, **sizes})


def beside(
    task: str,
    page: str,
    instead: str,
    error: str,
    unit: str,
    bench: str,
    errors: dict,
    sources: dict,
    note="",
    base="",
    **more,
) -> Row:
    """Return a row whose times and bytes are those of ``bench_backward``.

    ``errors``: name of ours, theirs and the paper's recipe there → error.
    """
    contenders = (benched(value, bench, name, base) for name, value in errors.items())
    return Row(task, page, instead, error, unit, *contenders, sources, note, **more)


def rows_of_bsdfs() -> Iterator[Row]:
    """Yield the rows of the distribution of normals, of the Disney BRDF, and of learned BSDFs."""
    bench = {"all others": "bench_backward"}
    study = measured("tradeoff_ggx").candidates
    errors = {"ours": study["neural_ggx"].errors.psnr_db, "roughconductor": EXACT,
              "paper": study["16→8 raw"].errors.psnr_db}  # fmt: skip
    yield beside("`neural_ggx`", "ggx", "`roughconductor`", "PSNR of D", "dB", "ggx", errors,
                 {"errors": "tradeoff_ggx", **bench})  # fmt: skip

    study = measured("tradeoff_disney").candidates
    errors = {"ours": study["tables, uint8"].errors.psnr_db_training, "principled": EXACT,
              "paper": study["paper, uint8"].errors.psnr_db_training}  # fmt: skip
    networks = measured("tradeoff_disney_network").candidates.values()
    texts = [f"{size_text(c.bytes)} has {c.errors.psnr_db_training:.1f} dB" for c in networks]
    yield beside(
        "`neural_disney`", "disney", "`principled`", "PSNR of BRDF · cosine", "dB", "disney", errors,
        {"errors": "tradeoff_disney", **bench, "the networks": "tradeoff_disney_network"},
        f"A network in {texts[0]}, one in {texts[1]}, in half precision and with the coordinates of the formulas as "
        "inputs; Mitsuba has no plugin that evaluates it.",
        others={"disney, exact": benched(EXACT, "disney", "disney")},
    )  # fmt: skip
    yield Row(
        "`disney`", "disney", "`principled`", "a formula, as `principled` is", "",
        benched(None, "disney", "disney"), benched(None, "disney", "principled"), Contender(),
        {"all": "bench_backward"}, "The paper has no such row: not measured.", cells={"error": "exact"},
    )  # fmt: skip

    study = measured("tradeoff_bsdf")
    errors = {
        name: statistics.median(study.candidates[f"{m}: {name}"].errors.psnr_db for m in study.cases)
        for name in ("ours", "measured", "paper")
    }
    yield beside(
        "`neural_bsdf`", "bsdf", "`measured`", "PSNR, median of materials", "dB", "bsdf", errors,
        {"errors": "tradeoff_bsdf", **bench}, "`measured` has no parameters that a step could optimise.",
        cells={"step": "none"}, others={"roughconductor, exact": benched(EXACT, "bsdf", "roughconductor")},
    )  # fmt: skip
    material, base = "GGX copper, α 0.01", "roughconductor"
    ours, paper = (study.candidates[f"{material}: {name}"].errors.psnr_db for name in ("ours", "paper"))
    yield Row(
        "`neural_bsdf`", "bsdf", "its source, `roughconductor`", "PSNR, copper", "dB",
        benched(ours, "bsdf", "ours", base), benched(EXACT, "bsdf", base, base, memory=0, disk=0),
        benched(paper, "bsdf", "paper", base), {"errors": "tradeoff_bsdf", **bench},
        "A step of ours has the derivatives of all parameters of the proxy; the paper's form has no proxy, and `scale` "
        "alone.",
    )  # fmt: skip


def rows_of_images() -> Iterator[Row]:
    """Yield the rows of compressed maps of a material, of 1024² and of 4096² texels."""
    study = measured("tradeoff_image").candidates
    ours, paper = (
        next(c for name, c in study.items() if name.startswith(f"{preset} 12x ")) for preset in ("ours", "paper")
    )
    codec, decoded = study["ASTC 12x, each map its own"], measured("bench_backward").bytes.image.bitmap.memory
    again = measured("tradeoff_image_network").candidates
    network = next(c for name, c in again.items() if name.startswith("hash grid + network"))
    yield Row(
        "`neural_image`", "image", "`bitmap`, decoded from ASTC", "PSNR of 4 maps", "dB",
        benched(ours.errors.psnr_db, "image", "ours"),
        benched(codec.errors.psnr_db, "image", "bitmap", memory=decoded, disk=codec.bytes),
        benched(paper.errors.psnr_db, "image", "paper"),
        {"errors, bytes of ASTC": "tradeoff_image", "all others": "bench_backward",
         "the network": "tradeoff_image_network"},
        f"A hash grid with a network in {size_text(network.bytes)} has {network.errors.psnr_db:.1f} dB after "
        f"{network.training_seconds:.0f} s; Mitsuba has no plugin that renders it. {TRAINED}",
    )  # fmt: skip

    study = measured("bench_large_material")
    ours, paper = (
        benched(c.psnr_db, "large", name, memory=c.memory_bytes, disk=c.file_bytes)
        for name, c in study.items() if name in ("ours", "paper")
    )  # fmt: skip
    codec = study["ASTC"]
    yield Row(
        f"`neural_image`, {study.side}²", "image", "`bitmap`, decoded from ASTC", "PSNR of 3 maps", "dB", ours,
        benched(codec.psnr_db, "large", "bitmap", memory=study.raw.bytes, disk=codec.bytes), paper,
        {"errors, bytes": "bench_large_material", "times": "bench_backward"},
        f"Trained for {study.ours.seconds / 60:.0f} minutes each. The cascaded array takes "
        f"{size_text(study.ours.cascaded_bytes)} "
        f"(the paper's recipe: {size_text(study.paper.cascaded_bytes)}), the bound of the paper's equation 1 is 1 MB. "
        f"ASTC has blocks of {codec.block} for all maps, encoded by the preset `fast`.",
    )  # fmt: skip


#: What a user would take instead of a filtered texture, in the study and in words.
SAMPLES, OF_SAMPLES = "bitmap, 4 spp, multijittered", "`bitmap`, 4 samples beside 1"


def plane(name: str, **sizes) -> Contender:
    """Return a contender of the study of filtered textures, with errors and times of its renders of a plane."""
    study = measured("tradeoff_texture")
    ratios = study.cases.plane.ratios.render
    times = [ratios[f"{contender} / bitmap, 1 spp"].median for contender in (name, SAMPLES)]
    return Contender(study.candidates[name].errors.psnr_plane_db, times[0] / times[1], **sizes)


def rows_of_textures() -> Iterator[Row]:
    """Yield the rows of filtered textures, of renders of a plane, and of uncompressed mip maps.

    Mip maps are floats, of which the study counts 8 bits each.
    """
    study, stored = measured("tradeoff_texture"), measured("bench_backward").bytes.texture
    network = measured("tradeoff_texture_network").candidates["network 12x, trilinear"]
    same, sources = plane("ours 12x, trilinear").error, {"errors, renders": "tradeoff_texture"}
    step = ("A step is not measured with these samples: 4 beside 16 of the bitmap take {:.2f} of the time.").format
    steps = {name: step(times("texture", name)["step"]) for name in ("ours", "mipmap")}
    yield Row(
        "`neural_texture`", "texture", OF_SAMPLES, "PSNR of a plane", "dB",
        plane("ours 12x, anisotropic, centred", **stored.ours), plane(SAMPLES, **stored.bitmap), Contender(),
        {**sources, "steps, bytes": "bench_backward", "the network": "tradeoff_texture_network"},
        f"A hash grid with a network in {size_text(network.bytes)} has {network.errors.psnr_plane_db:.1f} dB, "
        f"ours with the same filter, trilinear, {same:.1f} dB; Mitsuba has no plugin that renders it. "
        f"{steps['ours']} The paper's recipe had {study.details.request.seconds:.0f} "
        "s there, too few to converge: not measured.",
    )  # fmt: skip
    memory = 4 * study.candidates["mipmap, trilinear"].bytes
    yield Row(
        "`mipmap`", "texture", OF_SAMPLES, "PSNR of a plane", "dB",
        plane("mipmap, trilinear", memory=memory, disk=stored.bitmap.disk), plane(SAMPLES, **stored.bitmap),
        Contender(), {**sources, "steps, bytes": "bench_backward"}, steps["mipmap"],
    )  # fmt: skip


def rows_of_shading() -> Iterator[Row]:
    """Yield the rows of textures trained for shaded values, of a material in one plugin, and of training in a scene."""
    material = "weave"
    study = measured("tradeoff_shading").candidates
    mine = {name.removeprefix(f"{material}, "): c for name, c in study.items() if name.startswith(f"{material}, ")}
    psnr = {name: c.errors.c_mean_db for name, c in mine.items()}
    best = max((name for name in psnr if name.endswith((", ASTC", ", compressed"))), key=psnr.get)
    best_text = best.replace(", ASTC", " filters in ASTC").replace(", compressed", " filters, compressed")
    yield Row(
        "`fit shading`", "shading", f"classical filters in equal bytes ({best_text})", f"PSNR of shaded {material}",
        "dB", Contender(psnr["lambda 0.9, clip, schedule"]), Contender(psnr[best]), Contender(),
        {"errors": "tradeoff_shading"},
        "No plugin of Mitsuba reads the mip maps of classical filters. The paper's recipe: not measured.",
        cells={"render": "no plugin", "step": "no plugin", "memory": "equal", "disk": "equal"},
    )  # fmt: skip

    shares = [
        scene.equal_error["neural_material, trained, trilinear"]["principled + bitmaps, multijittered"].share
        for scene in measured("tradeoff_shading_renders").scenes.values()
    ]
    yield beside(
        "`neural_material`", "shading", "`normalmap`, `principled`, 4 bitmaps", "maps of rust", "", "shading",
        dict.fromkeys(("ours", "normalmap + principled + bitmaps", "paper")), {"all": "bench_backward"},
        f"At equal error of whole renders, ours with its default filter takes {min(shares):.2f} to {max(shares):.2f} "
        f"of the time of multijittered bitmaps (`tradeoff_shading_renders.json`). {TRAINED}",
        cells={"error": "not compared"},
    )  # fmt: skip

    floor, balls = (
        {r.details.way: r.details.psnr_db for r in measured(f"tradeoff_scene_training_{scene}").jobs.values()}
        for scene in ("floor", "balls")
    )
    yield Row(
        "`fit scene`", "shading", "`fit shading`, as long", "PSNR of held-out views, floor", "dB",
        Contender(floor["scene"]), Contender(floor["hemisphere"]), Contender(),
        {"errors": "tradeoff_scene_training_floor", "balls": "tradeoff_scene_training_balls"},
        f"On the scene of balls, training inside the scene alone has {balls['scene']:.1f} dB, over the hemisphere "
        f"{balls['hemisphere']:.1f} dB, one after the other {balls['hemisphere, then scene']:.1f} dB. "
        "The paper's recipe is not measured: it does not train inside scenes.",
        cells=dict.fromkeys(("render", "step", "memory", "disk"), "equal"),
        behind=(f"error {balls['scene'] - balls['hemisphere']:+.1f} dB on the scene of balls",),
    )  # fmt: skip


def rows_of_fields() -> Iterator[Row]:
    """Yield the rows of distance fields, and of radiance fields 75 times smaller than a dense grid."""
    study, base = measured("tradeoff_sdf_suzanne").candidates, "sdfgrid"
    ours, paper = (study[f"{name} 1 MiB"].errors.normal_deg for name in ("ours", "paper"))
    yield Row(
        "`neural_sdf`", "sdf", "mesh, Embree", "mean angle of normals", "°", benched(ours, "sdf", "ours"),
        benched(EXACT, "sdf", "mesh", memory=study["mesh (Embree)"].bytes), benched(paper, "sdf", "paper"),
        {"errors, bytes of the mesh": "tradeoff_sdf_suzanne", "all others": "bench_backward"}, better=False,
    )  # fmt: skip
    yield beside(
        "`neural_sdf`", "sdf", "`sdfgrid`, 128 cells along the longest side", "mean angle of normals", "°", "sdf",
        {"ours": ours, base: measured("bench_backward").errors[base], "paper": paper},
        {"errors": "tradeoff_sdf_suzanne", "all others": "bench_backward"},
        "The grid has the exact distances of the mesh, and no file on disk. "
        "Its bytes are those of its values; Mitsuba holds a box of each cell besides.", base, better=False,
    )  # fmt: skip

    study, base = measured("tradeoff_field"), "codebook 75×"
    passes = study.cases.reads.passes.render

    def contender(name: str) -> Contender:
        c = study.candidates[name]
        render = passes[name].time / passes[base].time if name in passes else None
        sizes = (c.details.get(key) for key in ("memory_bytes", "file_bytes"))
        return Contender(c.errors.psnr_foreground_db, render, None, *sizes)

    compared_ones = ("ours 75×", base, "paper 75×")
    left_out = (*compared_ones, "hash grid + network 75×")  # its colours were not trained in this run
    steps = [times("field", name)["step"] for name in ("ours", "paper")]
    yield Row(
        "`neural_field`", "field", "codebook (VQRF)", "PSNR of the foreground", "dB", *map(contender, compared_ones),
        {"all": "tradeoff_field"},
        "The codebook is the best contender of the study in equal bytes of memory. It is no plugin that could take a "
        f"step; a step of ours takes {steps[0]:.2f} (the paper's recipe: {steps[1]:.2f}) of that of a grid in "
        "single precision (`bench_backward.json`). Mitsuba's `volprim_rf_basic` is not measured: it needs 3D "
        "Gaussians of the capture.",
        others={name: contender(name) for name in study.candidates if name not in left_out}, cells={"step": "none"},
    )  # fmt: skip


def rows() -> list[Row]:
    """Return all rows."""
    makers = (rows_of_bsdfs, rows_of_images, rows_of_textures, rows_of_shading, rows_of_fields)
    return [row for make in makers for row in make()]


def three(row: Row, text, key: str) -> str:
    """Return the cell of ours, theirs and the paper's recipe, one a line."""
    values = [getattr(c, key) for c in (row.ours, row.theirs, row.paper)]
    if key in row.cells:
        return row.cells[key]
    if all(v is None for v in values):
        return MISSING
    return LINE.join("–" if v is None else text(v).replace(" ", "\N{NO-BREAK SPACE}") for v in values)


def cost(table) -> str:
    """Return errors, times and bytes of all tasks, as a table."""
    lines = []
    for row in rows():

        def error(value, row=row):
            return "exact" if value == EXACT else f"{value:.2f}°" if row.unit == "°" else f"{value:.1f}"

        lines.append([
            f"[{row.task}]({row.page}.md)", row.instead, f"{row.error}, {row.unit}" if row.unit == "dB" else row.error,
            NAMES, three(row, error, "error"), *(three(row, lambda v: f"{v:.2f}", key) for key in ("render", "step")),
            *(three(row, size_text, key) for key in ("memory", "disk")),
        ])  # fmt: skip
    head = ["task", "instead", "measure", "", "error", "a render", "a step", "in memory", "on disk"]
    return table(head, lines)


#: Figure → its name in a list of losses, and the text of ours and another contender's.
COMPARED = {
    "error": ("error", ""), "render": ("a render", " of the time"), "step": ("a step", " of the time"),
    "memory": ("memory", ""), "disk": ("disk", ""),
}  # fmt: skip


#: Unit of an error → differences below which two errors are equal.
SAME = {"dB": 0.1, "°": 0.02}


def compared(row: Row, other: Contender) -> tuple[list[str], list[str]]:
    """Return texts of the figures in which ours is better and worse than ``other``; 5% of a ratio are equal."""
    wins, losses = [], []
    for key, (name, unit) in COMPARED.items():
        a, b = getattr(row.ours, key), getattr(other, key)
        if a is None or b is None:
            continue
        if key == "error":
            text = "not exact" if b == EXACT else f"{name} {a - b:+.{2 if row.unit == '°' else 1}f} {row.unit}"
            if b == EXACT or abs(a - b) > SAME[row.unit]:
                (wins if (a > b) == row.better and b != EXACT else losses).append(text)
        elif b == 0:
            losses.append(f"{name} {size_text(a)}")
        elif not 0.95 < a / b < 1.05:
            (wins if a < b else losses).append(f"{name} {a / b:.2g}{unit or ' of the bytes'}")
    return wins, losses


def cost_losses(table) -> str:
    """Return where ours is better and worse than what a user would take instead, and worse than the paper's recipe."""
    lines = []
    for row in rows():
        (wins, losses), (_, behind) = (compared(row, other) for other in (row.theirs, row.paper))
        losses.extend(row.behind)
        lines.append([row.title, *("; ".join(texts) or "–" for texts in (wins, losses, behind))])
    return table(["task", "better", "worse", "worse than the paper's recipe"], lines)


def cost_sources(table) -> str:
    """Return the commands behind each row, and why cells are missing, as a table."""
    lines = []
    for row in rows():
        sources = [f"{figures}: `{COMMANDS[name]}`" for figures, name in row.sources.items()]
        lines.append([row.title, "; ".join(sources), row.note])
    return table(["task", "commands", "notes"], lines)


def tables(table) -> dict:
    """Return the functions of the tables by name; ``table(head, rows)`` writes a table in Markdown."""
    return {f.__name__: lambda f=f: f(table) for f in (cost, cost_losses, cost_sources)}
