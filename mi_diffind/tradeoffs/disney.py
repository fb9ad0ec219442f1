"""
The Disney BRDF: ``neural_disney`` at each quality and in each storage form, the exact model straight from its formulas,
and Mitsuba's ``principled`` with the same parameters; with constant and with textured materials.
"""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import plugins as plugins_package
from .. import runtime, tradeoff
from ..lookup import STORAGES
from ..operations import FLOPS, Operations
from ..tasks.disney.decoder import Decoder
from ..tasks.disney.factored import FactoredDecoder
from ..tasks.disney.library import decoder_of, load_arrays, load_disney_table, table_file
from ..tasks.disney.training import measure, random_directions
from ..tradeoff import FLOOR, Candidate, Case, Study

#: A material that makes use of every part of the model, and one of the two lobes that most materials have.
ALL_LOBES = {
    "roughness": 0.43,
    "anisotropic": 0.5,
    "metallic": 0.3,
    "specular": 0.6,
    "spec_tint": 0.4,
    "sheen": 0.5,
    "sheen_tint": 0.6,
    "flatness": 0.3,
    "clearcoat": 0.7,
    "clearcoat_gloss": 0.63,
}
DIFFUSE_SPECULAR = {"roughness": 0.43, "specular": 0.6}
BASE_COLOR = (0.8, 0.3, 0.2)

#: Texels of a side of the textures; read at random, they come from the cache, and what they cost is the reading itself.
TEXTURE_SIZE = 64

#: The paper's count of operations of one evaluation (supplement, 1.2.1).
PAPER = {
    "exact, the paper's": Operations(add=92, mul=150, div=17, sqrt=5, log=1),
    "tables, the paper's": Operations(add=11, mul=26, div=2, gathers=5),
}

#: What the default has to be, with a constant material: at least so many times faster than `principled` with all lobes
#: and with two; at most so many times slower than the exact model.
BARS = {"all lobes": 1.5, "diffuse + specular": 1.3}
BAR_EXACT = 2.2

QUERIES = ("eval", "sample", "pdf")

#: Counts as printed: name → title.
_OPERATIONS = {
    **{name: name for name in ("add", "mul", "div", "sqrt", "log", "flops")},
    "gathers": "reads",
    "bytes_gathered": "bytes",
    "instructions": "instr.",
}


def study(quick: bool = False) -> Study:
    """The study of this task in the variant that is set; ``quick``: fewer cases, fewer and smaller pictures."""
    candidates, plugins = _candidates()
    lobes = {"all lobes": ALL_LOBES, "diffuse + specular": DIFFUSE_SPECULAR}
    combinations = [(m, l) for m in ("constant", "textured") for l in lobes]
    if quick:
        combinations = [("constant", "all lobes"), ("textured", "diffuse + specular")]
    if quick:
        for candidate in candidates:
            candidate.in_passes &= candidate.setting in ("", "float32")
    rendered = {c.name: plugins[c.name] for c in candidates if c.in_passes}
    cases = []
    for material, name in combinations:
        parameters = lobes[name]
        cases.append(
            Case(
                f"{material}, {name}",
                lambda lanes, m=material, p=parameters: _queries(plugins, m, p, lanes),
                None if quick and cases else lambda m=material, p=parameters: _passes(rendered, m, p, quick),
                {"material": material, "lobes": name, "base_color": BASE_COLOR, **parameters},
            )
        )
    package = Path(__file__).resolve().parents[1]
    plugin_files = Path(plugins_package.__file__).parent.glob("*.py")  # elsewhere in a checkout than if installed
    names = ("lookup.py", "indirection.py", "operations.py", "tradeoff.py", "tasks/distributions.py")
    sources = [package / name for name in names]
    sources += [Path(__file__), *(package / "tasks" / "disney").glob("*.py"), *(package / "data").glob("*.npz")]
    return Study(
        task="disney",
        title="Disney BRDF: accuracy against time",
        candidates=candidates,
        cases=cases,
        queries=QUERIES,
        accuracy="psnr_db_training",
        accuracy_label="PSNR of BRDF · cosine, dB",
        ratios=[
            ("principled", "fast"),
            ("fast", "disney"),
            ("principled", "disney"),
            *((q, "fast") for q in ("tables", "tables, uint8", "paper", "paper, uint8")),
        ],
        fingerprint=tradeoff.fingerprint([*sources, *plugin_files]),
        variant=mi.variant(),
        about={
            "paper_operations": {name: o.asdict() for name, o in PAPER.items()},
            "flops": FLOPS,
            "texture_size": TEXTURE_SIZE,
            "errors": "PSNR in dB and mean absolute error of BRDF · cosine, clipped to [0, 1], over random directions "
            "and materials with all lobes: distributed as in training, and uniformly",
        },
        conclusions=conclusions,
    )


# -- candidates -------------------------------------------------------------------------------------------------------


def _candidates() -> tuple[list[Candidate], dict]:
    """The candidates, and for each a function that makes its BSDF of parameters (as for ``mi.load_dict``)."""
    types = runtime.array_module(mi.variant().split("_")[0])

    def errors(decoder):
        def measured(samples: int) -> dict[str, float]:
            found = {}
            for distribution in ("training", "uniform"):
                m = measure(decoder(), types, samples, distribution)
                found |= {f"psnr_db_{distribution}": m["psnr_db"], f"mae_{distribution}": m["mae"]}
            return found

        return measured

    def loaded(**plugin):
        return lambda parameters: mi.load_dict({**plugin, **parameters})

    def with_decoder(decoder):
        def build(parameters):
            bsdf = mi.load_dict({"type": "neural_disney", "preset": "tables", "storage": "float32", **parameters})
            bsdf.decoder = decoder(bsdf.decoder.arrays)
            bsdf.parameters_changed()  # what is evaluated once depends on the decoder
            return bsdf

        return build

    candidates = [
        Candidate(
            "principled",
            "Mitsuba",
            is_reference=True,
            note="another model (full Fresnel terms, no flatness without `thin`): no error against this one",
        ),
        Candidate("disney", "formulas", is_truth=True),
        Candidate("fast", "arithmetic", errors=errors(Decoder)),
    ]
    plugins = {
        "principled": loaded(type="principled"),
        "disney": loaded(type="disney"),
        "fast": loaded(type="disney"),
    }
    for quality in ("tables", "paper"):
        table, _ = load_disney_table(table_file("", quality))
        seconds = table.settings.get("seconds")
        for storage in STORAGES:
            name = quality if storage == "float32" else f"{quality}, {storage}"
            decoder = lambda q=quality, s=storage: decoder_of(load_arrays("", types.TensorXf, s, q))  # noqa: E731
            candidates.append(Candidate(name, quality, storage, table.to(storage).nbytes, seconds, errors(decoder)))
            plugins[name] = loaded(type="neural_disney", preset=quality, storage=storage)
    table, _ = load_disney_table(table_file("", "tables"))
    seconds = table.settings.get("seconds")
    for factor in FactoredDecoder.FACTORS:
        name = f"only {factor} read"
        read = [n for n in table.arrays if n == factor or (factor == "alpha" and n.startswith("encoder"))]
        size = sum(table.arrays[n].nbytes for n in read)
        decoder = lambda f=factor: FactoredDecoder(load_arrays("", types.TensorXf, "", "tables"), read=(f,))  # noqa: E731
        once = "read once where the material is constant" if factor in ("alpha", "coat") else ""
        candidates.append(
            Candidate(name, "one table", factor, size, seconds, errors(decoder), in_passes=False, note=once)
        )
        plugins[name] = with_decoder(lambda arrays, f=factor: FactoredDecoder(arrays, read=(f,)))
    return candidates, plugins


def _material(material: str, parameters: dict) -> dict:
    """Parameters as ``mi.load_dict`` takes them: numbers, or textures that vary around these."""
    if material == "constant":
        return {"base_color": {"type": "rgb", "value": list(BASE_COLOR)}, **parameters}
    rng = np.random.default_rng(1)

    def texture(values):
        noise = rng.uniform(-0.1, 0.1, (TEXTURE_SIZE, TEXTURE_SIZE, len(values)))
        data = np.clip(np.asarray(values) + noise, 0.01, 0.99).astype(np.float32)
        return {"type": "bitmap", "data": mi.TensorXf(data), "raw": not mi.is_spectral or len(values) == 1}

    # `principled` takes no texture for `specular`, so it is a number for all
    return {
        "base_color": texture(BASE_COLOR),
        **{name: value if name == "specular" else texture([value]) for name, value in parameters.items()},
    }


# -- what is timed ----------------------------------------------------------------------------------------------------


def _queries(plugins: dict, material: str, parameters: dict, lanes: int) -> dict:
    rng = dr.rng(seed=dr.opaque(mi.UInt64, 7))
    types = runtime.array_module(mi.variant().split("_")[0])
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    wi, wo = random_directions(rng, types, lanes)
    si.wi, wo = mi.Vector3f(wi), mi.Vector3f(wo)
    random = [rng.random(mi.Float, lanes) for _ in range(5)]
    si.uv, sample1, sample2 = mi.Point2f(random[:2]), random[2], mi.Point2f(random[3:])
    wavelengths = []
    if mi.is_spectral:
        si.wavelengths = 400 + 300 * rng.random(type(si.wavelengths), (dr.size_v(si.wavelengths), lanes))
        wavelengths = [si.wavelengths]
    dr.make_opaque(si.wi, si.uv, si.wavelengths, wo, sample1, sample2)
    uv = [si.uv] if material == "textured" else []
    context = mi.BSDFContext()
    inputs = {
        "eval": [si.wi, wo, *uv, *wavelengths],
        "sample": [si.wi, sample1, sample2, *uv, *wavelengths],
        "pdf": [si.wi, wo, *uv],
    }
    found = {query: {FLOOR: lambda i=i: i} for query, i in inputs.items()}
    for name, build in plugins.items():
        bsdf = build(_material(material, parameters))

        def sample(bsdf=bsdf):
            bs, weight = bsdf.sample(context, si, sample1, sample2)
            return [bs.wo, bs.pdf, mi.Float(bs.sampled_component), weight]

        found["eval"][name] = lambda b=bsdf: b.eval(context, si, wo)
        found["sample"][name] = sample
        found["pdf"][name] = lambda b=bsdf: b.pdf(context, si, wo)
    return found


def _passes(plugins: dict, material: str, parameters: dict, quick: bool) -> dict:
    """A sphere on a plane, both of the material, in light from everywhere and from one lamp."""
    size, spp = (64, 4) if quick else (256, 16)
    place = mi.ScalarTransform4f
    found = {}
    for name, build in plugins.items():
        bsdf = build(_material(material, parameters))
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5, "rr_depth": 100},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": place().look_at(origin=[0, -4.5, 2.2], target=[0, 0, 0.8], up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": spp},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
            "lamp": {
                "type": "rectangle",
                "to_world": place().look_at(origin=[2, -2, 4], target=[0, 0, 0.5], up=[0, 1, 0]).scale(0.6),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
            },
            "floor": {"type": "rectangle", "to_world": place().scale(6), "bsdf": bsdf},
            "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": bsdf},
        })  # fmt: skip
        found[name] = lambda number, scene=scene: mi.render(scene, spp=spp, seed=number)
    return found


# -- what it says -----------------------------------------------------------------------------------------------------


def conclusions(result: dict) -> list[str]:
    """Operations beside the paper's, whether the bars hold, and whether a table earns its place."""
    lines = []
    for case, measured in result["cases"].items():
        about = measured["about"]
        if about["material"] != "constant":
            continue
        lines.append(f"operations of one eval, {case} (add, mul 1 flop; div 2; sqrt, log 4)")
        lines.append(f"  {'':24}" + "".join(f"{title:>9}" for title in _OPERATIONS.values()))
        found = {name: t["operations"] for name, t in measured["queries"]["eval"].items() if "float16" not in name}
        if about["lobes"] == "all lobes":
            unknown = dict.fromkeys(("bytes_gathered", "instructions"), "")
            found = {name: o.asdict() | unknown for name, o in PAPER.items()} | found
        lines += [f"  {name:24}" + "".join(f"{o[key]:>9}" for key in _OPERATIONS) for name, o in found.items()]
        lines.append("")
    return [*lines, *_bars(result), *_verdict(result)]


def _bars(result: dict) -> list[str]:
    lines = []
    for lobes, bar in BARS.items():
        measured = result["cases"].get(f"constant, {lobes}")
        if measured is None:
            continue
        ratios = measured["ratios"]["eval"]
        for pair, limit, least in (("principled / fast", bar, True), ("fast / disney", BAR_EXACT, False)):
            r = ratios[pair]
            values = (r["median"], r["with_floor"])
            holds = [v >= limit if least else v <= limit for v in values]
            verdict = "holds" if all(holds) else "does NOT hold" if not any(holds) else "holds in one of both ways"
            lines.append(
                f"bar, {lobes}: {pair} {'≥' if least else '≤'} {limit:g}: {values[0]:.2f} ({values[1]:.2f} with the "
                f"floor), {verdict}"
            )
    return lines


def _verdict(result: dict) -> list[str]:
    """Does any table give something that arithmetic does not give for less?"""
    lines = []
    accuracy = {name: c["errors"].get(result["accuracy"]) for name, c in result["candidates"].items()}
    for case, measured in result["cases"].items():
        timings = measured["queries"]["eval"]
        reads = {name: t["operations"]["gathers"] for name, t in timings.items()}
        # A table that is read once for a constant material is not read here
        learned = [name for name, a in accuracy.items() if a is not None and reads[name] > reads["fast"]]
        if not learned or timings["fast"]["time"] <= 0:
            continue
        best = min(learned, key=lambda name: timings[name]["time"])
        ratio = timings[best]["time"] / timings["fast"]["time"]
        if timings[best]["q1"] > timings["fast"]["q3"]:
            verdict = "arithmetic wins, at any accuracy"
        elif timings[best]["q3"] < timings["fast"]["q1"]:
            verdict = "a table saves time"
        else:
            verdict = "no difference beyond the noise between arithmetic and the fastest table"
        lines.append(
            f"{case}: {verdict}; of the forms that read a table, the fastest, {best}, takes {ratio:.2f} times the time "
            f"of fast, at {accuracy[best]:.0f} dB"
        )
    return lines
