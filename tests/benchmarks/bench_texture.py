"""What a filtered read of a texture costs, as a multiple of a bitmap's bilinear read: run it, it only measures.

    python tests/benchmarks/bench_texture.py [--table FILE.npz] [--json FILE]

Read are the maps of a material, each by a texture, from hits that lie in memory: position in uv and its derivatives for
a pixel. The hits are ``random`` (any place, any footprint up to the whole image), or those of a ``plane`` to the
horizon, pixel by pixel. The bitmaps hold the decoded maps and do not read the derivatives. Times are those of the
kernels, one of each texture before the next of any; ratios are medians of the rounds.

Then whole renders of the plane in a constant light, ``path_footprint`` against ``path``.
"""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import ASSETS, VARIANT, against, by_turns, parser, write

import mi_diffind
from mi_diffind.core.compat import use_threads
from mi_diffind.measure.clock import count_query, machine, timed, total

TILES = ASSETS / "tiles_filtered.npz"
WIDTH, HEIGHT = 128, 128


def hits(coherent: bool, size: tuple[int, int]):
    """Return hits with ``uv``, ``duv_dx`` and ``duv_dy``, evaluated; the plane is repeated 40 times in uv."""
    count = WIDTH * HEIGHT
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    if coherent:
        index = dr.arange(mi.UInt32, count)
        x, y = mi.Float(index % WIDTH) / WIDTH - 0.5, (mi.Float(index // WIDTH) + 1) / HEIGHT
        depth = dr.rcp(y)
        si.uv = 2 * mi.Point2f(x * depth, depth)
        si.duv_dx = 2 * mi.Vector2f(depth / WIDTH, 0 * depth)
        si.duv_dy = 2 * mi.Vector2f(-x * depth * depth, -depth * depth) / HEIGHT
    else:
        rng = dr.rng(seed=0)
        u, v, side, turn, ratio = (rng.random(mi.Float, count) for _ in range(5))
        side = dr.exp2(side * np.log2(max(size))) / max(size)
        x, y = dr.cos(dr.two_pi * turn), dr.sin(dr.two_pi * turn)
        si.uv = mi.Point2f(u, v)
        si.duv_dx, si.duv_dy = side * mi.Vector2f(x, y), side * ratio * mi.Vector2f(-y, x)
    dr.make_opaque(si.uv, si.duv_dx, si.duv_dy)
    return si


def textures(path: Path) -> tuple[dict[str, list], list[int]]:
    """Return name → textures of all maps of a file (bitmaps of the decoded maps, and each filter), and channels."""
    image = mi_diffind.open(path).image
    maps, decoded = image.layout.maps, image.decode()
    bitmap, learned = {"type": "bitmap", "wrap_mode": "repeat"}, {"type": "neural_texture", "filename": str(path)}
    plugins = {"bitmap": lambda name: {**bitmap, "data": mi.TensorXf(decoded[name])}}
    for f in ("off", "trilinear", "anisotropic"):
        plugins[f"neural_texture, {f}"] = lambda name, f=f: {**learned, "channels": name, "filter": f}
    loaded = {key: [mi.load_dict({**plugin(m.name), "raw": True}) for m in maps] for key, plugin in plugins.items()}
    return loaded, [m.channels for m in maps]


def rounds(functions: dict, number: int) -> dict[str, np.ndarray]:
    """Return the seconds of the kernels of each function, by turns."""
    measured = {name: lambda f=function: timed(lambda: total(f())[0]) for name, function in functions.items()}
    return {name: np.array(values) for name, values in by_turns(measured, number).items()}


def reads(path: Path, number: int) -> list[dict]:
    """Return the costs of reads of the first map and of all maps."""
    by_name, channels = textures(path)
    size = by_name["bitmap"][0].resolution()
    rows = []
    for coherent in (False, True):
        si = hits(coherent, tuple(size))
        for maps in (1, len(channels)):

            def read(used, maps=maps, si=si):
                return [(t.eval_3(si) if c == 3 else t.eval_1(si)) for t, c in zip(used[:maps], channels, strict=False)]

            functions = {name: lambda used=used: read(used) for name, used in by_name.items()}
            row = {"table": path.name, "hits": "plane" if coherent else "random", "maps": maps}
            costs = against(rounds(functions, number), "bitmap", WIDTH * HEIGHT)
            for name, function in functions.items():
                operations = count_query(function)
                costs[name] |= {"instructions": operations.instructions, "gathers": operations.gathers}
            rows.append({**row, "textures": costs})
    return rows


def renders(path: Path, number: int) -> dict[str, dict]:
    """Return the costs of whole renders of a plane to the horizon at one sample a pixel."""
    T, place = mi.ScalarTransform4f, mi.ScalarTransform3f().scale(40)
    texture = {"type": "neural_texture", "filename": str(path), "to_uv": place, "channels": "albedo"}
    bsdf = {"type": "diffuse", "reflectance": texture}
    film = {"type": "hdrfilm", "width": 192, "height": 128}
    view = T().look_at([0, 1, 6], [0, 0.3, 0], [0, 1, 0])
    scenes = {
        integrator: mi_diffind.load_dict({
            "type": "scene", "integrator": {"type": integrator, "max_depth": 4}, "sky": {"type": "constant"},
            "sensor": {"type": "perspective", "to_world": view, "film": film, "sampler": {"type": "independent"}},
            "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(40), "bsdf": bsdf},
            "ball": {"type": "sphere", "center": [0, 1, 0], "bsdf": bsdf},
        })
        for integrator in ("path", "path_footprint")
    }  # fmt: skip
    functions = {name: lambda s=scene: [mi.render(s, spp=1).array] for name, scene in scenes.items()}
    return against(rounds(functions, number), "path", 192 * 128)


def main() -> None:
    command = parser(__doc__, rounds=101)
    command.add_argument("--table", action="append", type=Path, metavar="FILE", help="texture (default: tiles)")
    options = command.parse_args()
    mi.set_variant(VARIANT)
    use_threads(1)
    result = {"machine": machine(VARIANT), "rounds": options.rounds}
    with dr.suspend_grad():
        result["reads"] = [row for path in options.table or [TILES] for row in reads(path, options.rounds)]
        result["renders"] = renders(TILES, options.rounds)
    for row in result["reads"]:
        print(f"{row['table']}, {row['hits']}, {row['maps']} map(s)")
        show(row["textures"])
    print("renders")
    show(result["renders"])
    write(options.json, result)


def show(costs: dict[str, dict]) -> None:
    for name, cost in costs.items():
        counts = f", {cost['instructions']} instructions, {cost['gathers']} gathers" if "gathers" in cost else ""
        low, high = cost["quartiles"]
        print(f"  {name:28}{cost['ratio']:6.2f} ({low:.2f} to {high:.2f}), {cost['ns']:.1f} ns{counts}")


if __name__ == "__main__":
    main()
