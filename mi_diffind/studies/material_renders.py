"""Whole renders of a material: errors of pictures against time and bytes, and the time of a training step.

A slanted plane, a plane to the horizon and a sphere have one material, in the sun, which adds no noise, and the sphere
also in the sun and a sky. Contenders are
``principled`` and ``disney`` with bitmaps, with uncompressed mip maps, with mip maps of LEAN's roughness (isotropic:
neither BSDF turns its axes from texel to texel), also those of ASTC in the bytes of the trained file, and the trained
files, read by separate textures and by ``neural_material``. The truth is a converged render of the bitmaps with the
contender's BSDF; errors are those of linear values clipped to [0, 1], in pixels that are minified and on the surface.
Each contender is rendered by a process of its own, since Dr.Jit compiles the materials of all scenes that a process
holds into each kernel. They take turns, on one core; times are medians of the time of the processor, which depends less
on what else the machine does.
"""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
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
from ..measure.report import figure_caption, grid, publish, write_files
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


def mip_maps(source: Source, nbytes: int) -> dict[str, tuple[Pyramid, int]]:
    """Return uncompressed levels of a material, those of LEAN, and these in ASTC in ``nbytes``, with their bytes."""
    pyramid = Pyramid.from_source(source, types=array_module(mi.variant()), border=("repeat", "repeat"))
    lean = normals.with_roughness(pyramid, normals.lean_levels(pyramid))
    pyramids = {"mip maps": (pyramid, pyramid.nbytes), "LEAN mip maps": (lean, lean.nbytes)}
    if "astc" in codecs.available():
        names = [m.name for m in source.maps if m.role == "normal"]
        coded, size = codecs.astc_levels(level_images(lean), nbytes, "thorough", names)
        pyramids["LEAN mip maps, ASTC"] = level_pyramid({name: e.levels for name, e in coded.items()}, lean), size
    return pyramids


def rendered_materials(source: Source, tables: Sequence[Table], quick: bool) -> list[RenderedMaterial]:
    """Return the contenders for a material and textures that were trained on it; ``quick``: without mip maps."""
    size, few = (source.width, source.height), (1, 4)
    peer = RenderedMaterial(PEER, "principled", "bitmap", source, size, source.nbytes, COUNTS)
    materials = [
        peer, dataclasses.replace(peer, name=MULTIJITTERED, counts=STRATIFIED, sampler="multijitter"),
        dataclasses.replace(peer, name="disney + bitmaps", bsdf="disney", counts=COUNTS[::2]),
    ]  # fmt: skip
    for name, (levels_of, nbytes) in ({} if quick else mip_maps(source, tables[0].nbytes)).items():
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


# -- Processes ---------------------------------------------------------------------------------------------------------


def _load(variant: str, material: RenderedMaterial, case: str, film: tuple[int, int], trains: bool) -> None:
    """Load the scene of a contender, in a process of its own."""
    global _scene
    mi.set_variant(variant)
    use_threads(1)  # threads that wait for each other count as time of the processor
    mi.set_log_level(mi.LogLevel.Error)
    _scene = material.load(textured_scene(case), film, SCENES[case][2], trains)


def _pass(spp: int, seed: int, trains: bool) -> tuple[np.ndarray | None, float]:
    """Return an image of the process's scene, or none of a training step, and its time of the processor in ms."""
    seed = dr.opaque(mi.UInt32, seed)
    dr.sync_thread()
    start = time.process_time()
    result = _step(_scene, seed) if trains else mi.render(_scene, spp=spp, seed=seed)
    dr.eval(result)
    dr.sync_thread()
    elapsed = 1e3 * (time.process_time() - start)
    return None if trains else np.array(result), elapsed


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


@contextlib.contextmanager
def _processes(materials: Iterable[RenderedMaterial], case: str, film: tuple[int, int], trains: bool = False):
    """Start a process for each contender; yield the function that does a pass ``(name, spp, seed)`` in its process."""
    context = multiprocessing.get_context("spawn")
    with contextlib.ExitStack() as stack:
        pools = {
            m.name: stack.enter_context(
                ProcessPoolExecutor(1, context, _load, (mi.variant(), m, case, film, trains))
            ) for m in materials
        }  # fmt: skip
        wait([pool.submit(_pass, 1, 0, trains) for pool in pools.values()])  # all compile at the same time
        yield lambda name, spp, seed: pools[name].submit(_pass, spp, seed, trains).result()


# -- Measurement -------------------------------------------------------------------------------------------------------


def run_renders(name: str, source: Source, tables: Sequence[Table], settings: RenderSettings, folder: str) -> Tradeoff:
    """Measure renders of a material with a name, write the files into ``folder`` and return the result.

    ``scenes``: name → ``points``, a list of ``name``, ``spp``, ``psnr_db`` and ``cpu_ms`` with quartiles, and
    ``equal_error`` (:func:`equal_errors`). ``steps``: name → ``cpu_ms``, ``ratio`` (to :data:`PEER`). ``bytes``: name →
    bytes.
    """
    materials = rendered_materials(source, tables, settings.quick)
    result = {
        "task": "shading_renders", "title": f"Whole renders: {name}", "interrupted": False,
        "machine": clock.machine(mi.variant()), "date": time.strftime("%Y-%m-%d"),
        "settings": dataclasses.asdict(settings), "tables": [Path(t.path).name for t in tables],
        "notes": [f"{name}, {source.width} × {source.height}; {settings.film[0]} × {settings.film[1]} pixels; "
                  "times of the processor, one core.", *codecs.install_notes(["astc"])],
        "bytes": {m.name: m.nbytes for m in materials},
        "scenes": {case: _measure(materials, case, settings) for case in list(SCENES)[: 1 if settings.quick else None]},
        "steps": _steps(materials, settings),
    }  # fmt: skip
    table = [
        {"scene": case, **point, "cpu_ms": point["cpu_ms"]["median"], "bytes": result["bytes"][point["name"]]}
        for case, scene in result["scenes"].items() for point in scene["points"]
    ]  # fmt: skip
    shares = [["at equal error, time over that of", PEER, "multijittered"]] + [
        [f"{case}, {name}", *(f"{'below ' * s['bound']}{s['share']:.2f}" for s in shares.values())]
        for case, scene in result["scenes"].items() for name, shares in scene["equal_error"].items()
    ]  # fmt: skip
    files = write_files(result["task"], folder, result, table, {"png": lambda: draw(result)})
    return publish(result, files, grid(shares))


def _measure(materials: list[RenderedMaterial], case: str, settings: RenderSettings) -> dict:
    """Return the errors and times of all contenders in a scene."""
    mask, truths = textured_scene(case).counted(settings.film, materials[0].size), {}
    records = {(m.name, spp): [] for m in materials for spp in m.counts}
    with _processes(materials, case, settings.film) as render:
        for bsdf, name in (("principled", MULTIJITTERED), ("disney", "disney + bitmaps")):
            images = [render(name, 64, 1000 + i)[0] for i in range(settings.truth)]
            truths[bsdf] = np.mean(images, axis=0, dtype=np.float64)[mask].clip(0, 1)
        for i in tqdm(range(settings.rounds + 1), desc=case, unit="round"):
            for m in materials if i % 2 == 0 else reversed(materials):
                for spp in m.counts:
                    image, cpu_ms = render(m.name, spp, 1 + i)
                    if i:  # the first one compiles
                        mse = np.mean((image[mask].astype(np.float64).clip(0, 1) - truths[m.truth]) ** 2)
                        records[m.name, spp].append((float(mse), cpu_ms))
    points = [
        {"name": name, "spp": spp, "psnr_db": decibel(float(np.mean([mse for mse, _ in values]))),
         "cpu_ms": spread(ms for _, ms in values)}
        for (name, spp), values in records.items()
    ]  # fmt: skip
    return {"points": points, "equal_error": equal_errors(points)}


def _steps(materials: list[RenderedMaterial], settings: RenderSettings) -> dict:
    """Return the times of a training step on the sphere, with trilinear filters: one for each form of material."""
    chosen = {(m.bsdf, m.texture): dataclasses.replace(m, options={}) for m in reversed(materials)}.values()
    times: dict[str, list] = {m.name: [] for m in chosen}
    with _processes(chosen, "sphere", settings.step_film, True) as step:
        for i in tqdm(range(settings.rounds + 2), desc="training step", unit="round"):
            for m in chosen:
                cpu_ms = step(m.name, 1, i)[1]
                if i > 1:
                    times[m.name].append(cpu_ms)
    return {name: {"cpu_ms": spread(ms), "ratio": spread(np.divide(ms, times[PEER]))} for name, ms in times.items()}


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


def draw(result: dict):
    """Draw the error against the time of a render in each scene; the legend has the bytes."""
    ways = ({"linestyle": "-"}, {"linestyle": ":", "markerfacecolor": "white"})
    styles = [{"color": colour, "marker": marker, **way} for way in ways for colour, marker in plot.STYLES]
    panels = {case: [] for case in result["scenes"]}
    for case, scene in result["scenes"].items():
        for (name, nbytes), style in zip(result["bytes"].items(), styles, strict=False):
            points = [p for p in scene["points"] if p["name"] == name]
            at, psnr = [p["cpu_ms"]["median"] for p in points], [p["psnr_db"] for p in points]
            panels[case].append(plot.Curve(f"{name}, {nbytes / 1e3:,.0f} kB", at, psnr, style=style))
    labels = "ms of a render, 1 to 64 samples a pixel", "PSNR, dB"
    return plot.draw_curves(result["title"], figure_caption(result), panels, *labels, "x", height=4.6)
