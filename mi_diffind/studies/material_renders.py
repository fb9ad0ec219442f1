"""Whole renders of a material: errors of pictures against time and bytes, and the time of a training step.

A slanted plane, a plane to the horizon and a
sphere have one material, in the sun, which adds no noise, and the sphere also in the sun and a sky. Contenders are
``principled`` and ``disney`` with bitmaps, with uncompressed mip maps, with mip maps of LEAN's roughness (isotropic:
neither BSDF turns its axes from texel to texel), also those of ASTC in the bytes of the trained file, and the trained
files, read by separate textures and by ``neural_material``. The truth is a converged render of the bitmaps with the
contender's BSDF; errors are those of linear values clipped to [0, 1], in pixels that are minified and on the surface.
Each contender is rendered by a process of its own, since Dr.Jit compiles the materials of all scenes that a process
holds into each kernel. They take turns, on one core; times are medians, of a clock (``ms``) and of the processor
(``cpu_ms``), which depends less on what else the machine does.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from ..arrays.tables import Table
from ..core.compat import use_threads
from ..core.runtime import array_module
from ..fitting import task
from ..maps.pyramid import Pyramid, decibel
from ..maps.source import Source
from ..measure import clock, plot
from ..measure.renders import TextureScene, still_scenes, to_uv, zoom_scene
from ..measure.report import figure_caption, publish, write_files
from ..measure.statistics import spread
from ..measure.study import Tradeoff
from ..plugins.support.image_files import PYRAMIDS
from ..scenes import loading
from .baselines import codecs, normals
from .texture import level_images, level_pyramid

#: Parameter of the BSDF → role of a map.
PARAMETERS = {"base_color": "albedo", "roughness": "roughness", "metallic": "metallic"}


#: Scenes: name → shape, direction to the sun, radiance of the sky.
SCENES = {
    "plane": ("slanted", (0.3, 0.7, -0.3), 0.0),
    "plane to the horizon": ("plane", (0.3, 0.7, -0.8), 0.0),
    "sphere": ("sphere", (0.3, 0.6, 1.0), 0.0),
    "sphere, sky": ("sphere", (0.3, 0.6, 1.0), 0.4),
}


#: Sample counts of bitmaps, and those of stratified samples.
COUNTS = (1, 2, 4, 8, 16, 32, 64)
STRATIFIED = (1, 4, 16, 64)


#: The contender that ratios and equal errors are to, and the same with stratified samples.
PEER = "principled + bitmaps"
MULTIJITTERED = "principled + bitmaps, multijittered"


#: Filter of textures that filter themselves.
ANISOTROPIC = {"filter": "anisotropic", "max_anisotropy": 4}


def textured_scene(case: str) -> TextureScene:
    """Return the surface and the camera of a scene; the slanted plane has 16 texels a pixel in the middle."""
    shape, sun, _ = SCENES[case]
    shapes = {**still_scenes(), "slanted": dataclasses.replace(zoom_scene(), texels=16.0)}
    return dataclasses.replace(shapes[shape], towards_light=sun)


@dataclass(frozen=True)
class RenderSettings:
    """``film``: width and height; ``rounds`` of timed renders; ``truth``: renders of 64 samples, their mean is it."""

    film: tuple[int, int] = (360, 240)
    rounds: int = 5
    truth: int = 16
    step_film: tuple[int, int] = (128, 128)
    quick: bool = False


@dataclass(frozen=True)
class RenderedMaterial:
    """Material of a contender: a BSDF, the plugin of its textures, and its samples per pixel.

    ``source`` is a manifest for bitmaps, ``(layout, values, border)`` of levels for mip maps, or a trained file;
    ``options`` are parameters of the textures.
    """

    name: str
    bsdf: str
    texture: str
    source: object
    size: tuple[int, int]
    nbytes: int
    counts: tuple[int, ...]
    options: dict = dataclasses.field(default_factory=dict)
    sampler: str = "independent"

    @property
    def truth(self) -> str:
        """BSDF of the truth."""
        return "principled" if self.bsdf == "principled" else "disney"

    def load(self, scene: TextureScene, film: tuple[int, int], sky: float, trains: bool):
        """Return the loaded scene; ``trains``: for ``prb``, with texels or arrays that can be changed."""
        integrator = {"type": "prb" if trains else "path"}
        described = scene.scene({"type": "rgb", "value": 0.5}, film, 1, self.sampler, integrator)
        described["surface"]["bsdf"] = self.plugin(scene.repeats(film, self.size), trains)
        if sky:
            described |= {"sky": {"type": "constant", "radiance": sky}}
            described["integrator"]["max_depth"] = 3
        return loading.load_dict(described)

    def plugin(self, repeats: tuple[float, float], trains: bool) -> dict:
        """Return the BSDF."""
        common = {"to_uv": to_uv(repeats), **self.options}
        if self.texture == "neural_texture":
            common |= {"filename": self.source, "storage": "float32" if trains else "uint8"}
        if self.bsdf == "neural_material":
            return {"type": self.bsdf, **common}
        maps = dict(self._textures(common, trains))
        inner = {"type": self.bsdf, **{p: maps[role] for p, role in PARAMETERS.items() if role in maps}}
        return {"type": "normalmap", "normalmap": maps["normal"], "nested": inner} if "normal" in maps else inner

    def _textures(self, common: dict, trains: bool):
        """Yield the roles of the maps, each with its texture."""
        if self.texture == "bitmap":
            for m in self.source.maps:
                values = np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8))
                data, raw = mi.Bitmap(values), m.color_space != "srgb"
                yield m.role, {"type": "bitmap", "bitmap": data, "raw": raw, "format": "variant" if trains else "auto",
                               **common}  # fmt: skip
            return
        if self.texture == "mipmap":
            layout, values, border = self.source
            PYRAMIDS[self.name] = Pyramid(layout, values, array_module(mi.variant()), border)
            common = {**common, "pyramid": self.name}
        else:
            layout = task.tasks()["texture"].open(mi.TensorXf, str(self.source)).image.layout
        for m in layout.maps:
            yield m.role, {"type": self.texture, "channels": m.name, **common}


def rendered_materials(source: Source, tables: Sequence[Table]) -> list[RenderedMaterial]:
    """Return the contenders for a material and textures that were trained on it, the first one in the tables' bytes."""
    types = array_module(mi.variant())
    pyramid = Pyramid.from_source(source, types=types, border=("repeat", "repeat"))
    lean = normals.with_roughness(pyramid, normals.lean_levels(source, pyramid))
    pyramids = {"mip maps": (pyramid, pyramid.nbytes), "LEAN mip maps": (lean, lean.nbytes)}
    if "astc" in codecs.available():
        names = [m.name for m in source.maps if m.role == "normal"]
        coded, nbytes = codecs.astc_levels(level_images(lean), tables[0].nbytes, "thorough", names)
        pyramids["LEAN mip maps, ASTC"] = (
            level_pyramid({name: e.levels for name, e in coded.items()}, lean), nbytes
        )  # fmt: skip
    size, few = (source.width, source.height), (1, 4)
    peer = RenderedMaterial(PEER, "principled", "bitmap", source, size, source.nbytes, COUNTS)
    materials = [
        peer, dataclasses.replace(peer, name=MULTIJITTERED, counts=STRATIFIED, sampler="multijitter"),
        dataclasses.replace(peer, name="disney + bitmaps", bsdf="disney", counts=COUNTS[::2]),
    ]  # fmt: skip
    for name, (levels_of, nbytes) in pyramids.items():
        values = (levels_of.layout, levels_of.values, levels_of.border)
        for bsdf in ("principled", "disney") if name == "mip maps" else ("principled",):
            materials.append(
                RenderedMaterial(f"{bsdf} + {name}", bsdf, "mipmap", values, size, nbytes, few, ANISOTROPIC)
            )
    for i, table in enumerate(tables):
        stem, path = Path(table.path).stem, str(table.path)
        trained = RenderedMaterial("", "neural_material", "neural_texture", path, size, table.nbytes, few, ANISOTROPIC)
        if not i:
            materials.append(dataclasses.replace(trained, name=f"disney + neural_texture, {stem}", bsdf="disney"))
            materials.append(dataclasses.replace(trained, name=f"neural_material, {stem}, trilinear", options={}))
        materials.append(dataclasses.replace(trained, name=f"neural_material, {stem}"))
    return materials


def _worker(material: RenderedMaterial, case: str, film, trains: bool, pipe) -> None:
    """Process of a contender in a scene: answer a pass ``(spp, seed)`` with an image and two times in ms."""
    mi.set_variant(pipe.recv())
    use_threads(1)  # threads that wait for each other count as time of the processor
    mi.set_log_level(mi.LogLevel.Error)
    loaded = material.load(textured_scene(case), film, SCENES[case][2], trains)
    while (request := pipe.recv()) is not None:
        spp, seed = request[0], dr.opaque(mi.UInt32, request[1])
        dr.sync_thread()
        start, start_cpu = time.perf_counter(), time.process_time()
        result = _step(loaded, seed) if trains else mi.render(loaded, spp=spp, seed=seed)
        dr.eval(result)
        dr.sync_thread()
        times = 1e3 * (time.perf_counter() - start), 1e3 * (time.process_time() - start_cpu)
        pipe.send((None if trains else np.array(result), *times))


def _step(scene, seed):
    """Return the derivatives of a render with respect to all texels or arrays."""
    parameters = mi.traverse(scene)
    parameters.keep([r".*\.(data|tables\..*)$"])
    for key in parameters.keys():
        dr.enable_grad(parameters[key])
        dr.set_grad(parameters[key], 0)
    parameters.update()
    dr.backward(dr.mean(mi.render(scene, parameters, spp=1, seed=seed, seed_grad=seed + 10_000), axis=None))
    return [parameters[key].grad for key in parameters.keys()]


class _Contenders:
    """Processes of all contenders of a scene."""

    def __init__(self, materials, case: str, film, trains: bool = False):
        context, self.pipes = multiprocessing.get_context("spawn"), {}
        for material in materials:
            self.pipes[material.name], other = context.Pipe()
            arguments = (material, case, film, trains, other)
            context.Process(target=_worker, args=arguments, daemon=True).start()
            self.pipes[material.name].send(mi.variant())

    def run(self, name: str, spp: int, seed: int) -> tuple:
        self.pipes[name].send((spp, seed))
        return self.pipes[name].recv()

    def close(self) -> None:
        for pipe in self.pipes.values():
            pipe.send(None)


def measure(name: str, source: Source, tables: Sequence[Table], settings: RenderSettings) -> dict:
    """Measure renders of a material with a name; return the result, a tree of numbers and strings (JSON).

    ``scenes``: name → ``points``, a list of ``name``, ``sampler``, ``spp``, ``psnr_db``, ``brightness`` (over the
    truth's), ``ms`` and ``cpu_ms`` with quartiles; ``models_db``, the PSNR of one truth against the other;
    ``equal_error`` (:func:`equal_errors`). ``steps``: name → ``ms``, ``cpu_ms``, ``ratio`` (to :data:`PEER`).
    ``bytes``: name → bytes.
    """
    materials = rendered_materials(source, tables)
    cases = {name: _scene(materials, name, settings) for name in list(SCENES)[: 1 if settings.quick else None]}
    result = {
        "task": "shading_renders", "title": f"Whole renders: {name}", "interrupted": False,
        "machine": clock.machine(mi.variant()), "date": time.strftime("%Y-%m-%d"),
        "settings": dataclasses.asdict(settings), "tables": [Path(t.path).name for t in tables],
        "notes": [f"{name}, {source.width} × {source.height}; {settings.film[0]} × {settings.film[1]} pixels; "
                  "times of the processor, one core.", *codecs.install_notes(["astc"])],
        "bytes": {m.name: m.nbytes for m in materials}, "scenes": cases,
        "steps": _steps(materials, settings),
    }  # fmt: skip
    result["conclusions"] = [
        f"{case}, {name}: {'below ' * s['bound']}{s['share']:.2f} of the time of {peer} at equal error"
        for case, scene in cases.items()
        for name, shares in scene["equal_error"].items()
        for peer, s in shares.items()
    ]
    return result


def _scene(materials: list[RenderedMaterial], case: str, settings: RenderSettings) -> dict:
    contenders, film = _Contenders(materials, case, settings.film), settings.film
    mask = textured_scene(case).counted(film, materials[0].size)
    truths = {}
    for bsdf, name in (("principled", MULTIJITTERED), ("disney", "disney + bitmaps")):
        images = [contenders.run(name, 64, 1000 + i)[0] for i in range(settings.truth)]
        truths[bsdf] = np.mean(images, axis=0, dtype=np.float64)[mask]
    records = {(m.name, spp): [] for m in materials for spp in m.counts}
    for i in tqdm(range(settings.rounds + 1), desc=case, unit="round"):
        for m in materials if i % 2 == 0 else reversed(materials):
            for spp in m.counts:
                image, *times = contenders.run(m.name, spp, 1 + i)
                if i:  # the first one compiles
                    truth, shown = truths[m.truth], image[mask].astype(np.float64)
                    mse = float(np.mean((shown.clip(0, 1) - truth.clip(0, 1)) ** 2))
                    records[m.name, spp].append((mse, shown.mean() / truth.mean(), *times))
    contenders.close()
    points = []
    for (name, spp), values in records.items():
        mse, brightness, ms, cpu_ms = np.array(values).T
        points.append({"name": name, "spp": spp, "psnr_db": decibel(float(mse.mean())),
                       "brightness": float(brightness.mean()), "ms": spread(ms), "cpu_ms": spread(cpu_ms)})  # fmt: skip
    models = decibel(float(np.mean((truths["principled"].clip(0, 1) - truths["disney"].clip(0, 1)) ** 2)))
    return {"points": points, "models_db": models, "equal_error": equal_errors(points)}


def _steps(materials: list[RenderedMaterial], settings: RenderSettings) -> dict:
    """Return the times of a training step on the sphere, with trilinear filters: one for each form of material."""
    chosen = {(m.bsdf, m.texture): dataclasses.replace(m, options={}) for m in reversed(materials)}.values()
    contenders = _Contenders(chosen, "sphere", settings.step_film, True)
    times: dict[str, list] = {m.name: [] for m in chosen}
    for i in tqdm(range(settings.rounds + 2), desc="training step", unit="round"):
        for m in chosen:
            both = contenders.run(m.name, 1, i)[1:]
            if i > 1:
                times[m.name].append(both)
    contenders.close()
    ms, cpu = ({name: np.array(both)[:, k] for name, both in times.items()} for k in (0, 1))
    return {name: {"ms": spread(ms[name]), "cpu_ms": spread(cpu[name]), "ratio": spread(cpu[name] / cpu[PEER])}
            for name in times}  # fmt: skip


def equal_errors(points: list[dict]) -> dict:
    """Return, for each contender of one sample a pixel, the share of the peers' time for an equal error.

    Name → :data:`PEER` or :data:`MULTIJITTERED` → ``share`` of the processor's time, ``spp`` of the peer, and
    ``bound``: the peer's most samples have a larger error, so the share is smaller still. Between two points, time and
    samples follow a power of the squared error.
    """
    shares: dict[str, dict] = {}
    for name in (PEER, MULTIJITTERED):
        peers = sorted((p for p in points if p["name"] == name), key=lambda p: p["psnr_db"])
        psnr, logs = [p["psnr_db"] for p in peers], np.log([(p["cpu_ms"]["median"], p["spp"]) for p in peers])
        for p in points:
            if p["spp"] == 1 and p["name"] not in (PEER, MULTIJITTERED):
                cpu, spp = (float(np.exp(np.interp(p["psnr_db"], psnr, column))) for column in logs.T)
                shares.setdefault(p["name"], {})[name] = {
                    "share": p["cpu_ms"]["median"] / cpu, "spp": spp, "bound": p["psnr_db"] > psnr[-1],
                }  # fmt: skip
    return shares


def rows(result: dict) -> list[dict]:
    """Return a row for each scene, contender and number of samples."""
    return [
        {"scene": case, **point, "ms": point["ms"]["median"], "cpu_ms": point["cpu_ms"]["median"],
         "bytes": result["bytes"][point["name"]]}
        for case, scene in result["scenes"].items() for point in scene["points"]
    ]  # fmt: skip


def draw(result: dict):
    """Draw the error against the time of a render in each scene, and against bytes in the first."""
    panels, first = {}, next(iter(result["scenes"]))
    styles = [{"linestyle": line, "color": c, "marker": m} for line in ("-", ":") for c, m in plot.STYLES]
    for case, scene in [*result["scenes"].items(), (f"{first}, one sample a pixel: bytes", result["scenes"][first])]:
        panels[case] = []
        for (name, nbytes), style in zip(result["bytes"].items(), styles, strict=False):
            points = [p for p in scene["points"] if p["name"] == name]
            at, psnr = [p["cpu_ms"]["median"] for p in points], [p["psnr_db"] for p in points]
            if case.endswith("bytes"):
                at, psnr = [nbytes], psnr[:1]
            panels[case].append(plot.Curve(name, at, psnr, style=style))
    caption = figure_caption(result)
    return plot.draw_curves(
        result["title"], caption, panels, "ms of a render (last: bytes)", "PSNR, dB", True, columns=3, height=4.2
    )


def run_renders(name: str, source: Source, tables: Sequence[Table], settings: RenderSettings, folder: str) -> Tradeoff:
    """Measure, write the files into ``folder`` and return the result."""
    result = measure(name, source, tables, settings)
    table = rows(result)
    files = write_files(result["task"], folder, result, table, table[0], {"png": lambda: draw(result)})
    return publish(result, files, result["conclusions"])
