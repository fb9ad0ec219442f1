"""
Errors of footprints against rays through the edges of a pixel:

    python tests/benchmarks/bench_footprint.py --json docs/measured/bench_footprint.json

Shapes that the camera sees directly, with footprints of a texture that knows the sensor, and a room that is seen in
mirrors and through glass, with those of ``path_footprint``. Of the side and the major axis, the median and the 90th
percentile of the relative error. The scenes and the finite differences are those of the tests.
"""

import sys
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(TESTS / "helpers"), str(TESTS / "plugins"), str(TESTS / "plugins" / "support")]

import footprints as fp  # noqa: E402
import mitsuba as mi  # noqa: E402
import test_footprint as direct  # noqa: E402
import test_path_footprint as traced  # noqa: E402
from frame import VARIANT, parser, write  # noqa: E402

import mi_diffind  # noqa: E402, F401


def seen_directly(kind: str, fov: float) -> list:
    """Return the errors of a shape before the camera."""
    shape, place, _ = direct.scene_of(mi, kind)
    scene = mi.load_dict({"type": "scene", "shape": shape, "sensor": fp.sensor(to_world=place, fov=fov)})
    return fp.errors(*direct.measured(mi, scene)).tolist()


def seen_in(shapes: dict, chain: tuple, size: tuple[int, int]) -> list:
    """Return the errors of a room that is seen in mirrors or through glass."""
    fp.WIDTH, fp.HEIGHT = size
    fp.register_probe()
    scene, found, seen = traced.shown(mi, shapes)
    return fp.errors(found, *traced.trusted(scene, chain, seen)).tolist()


def main():
    command = parser(__doc__)
    command.add_argument("--variant", default=VARIANT)
    arguments = command.parse_args()
    mi.set_variant(arguments.variant)
    small, large = (fp.WIDTH, fp.HEIGHT), (8 * fp.WIDTH, 8 * fp.HEIGHT)
    rows = {}
    for kind in ("plane", "sphere", "vase", "knot"):
        for fov in (60, 90):
            rows[f"{kind}, field of view {fov}°"] = seen_directly(kind, fov)
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], -60) @ traced.scaled(mi, 2)
    flat = {"type": "rectangle", "to_world": turn, "bsdf": traced.MIRROR}
    ball = {"type": "sphere", "to_world": traced.scaled(mi, 1.4), "bsdf": traced.MIRROR}
    rows["flat mirror"] = seen_in({"m": flat}, (fp.mirrored,), small)
    rows["ball as a mirror"] = seen_in({"m": ball}, (fp.mirrored,), small)
    for kind in ("vase", "knot"):
        for size in (small, large):
            shape = traced.mesh(mi, kind, bsdf=traced.MIRROR)
            rows[f"{kind} as a mirror, {size[0]} × {size[1]} pixels"] = seen_in({"m": shape}, (fp.mirrored,), size)
    follow = fp.refracted(1.5)
    rows["glass ball"] = seen_in({"m": {"type": "sphere", "bsdf": traced.GLASS}}, (follow, follow), small)
    result = {"variant": arguments.variant, "size": small, "rows": rows}
    for name, ((side, side_worst), (axis, axis_worst)) in rows.items():
        print(f"{name:40} side {side:8.2%} {side_worst:8.2%}   major axis {axis:8.2%} {axis_worst:8.2%}")
    write(arguments.json, result)


if __name__ == "__main__":
    main()
