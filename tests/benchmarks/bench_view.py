"""
Measure how many pictures a second the viewer shows while the camera moves, and how long a change takes.

    python tests/benchmarks/bench_view.py --json docs/measured/bench_view.json

Each scene is shown side by side at 320 pixels of width, one sample per pixel, while the camera turns. Times are those
of the viewer's session and of the JPEG that it would send, without a browser. ``fixed`` keeps the full size,
``adapted`` lets the viewer reduce it. ``mitsuba``: the same pictures by ``mi.render`` of both scenes, as far as there
are two, interleaved with those of the viewer, so that ``speedup`` is a ratio of one run.
"""

import json
import os
import statistics
import time
from io import BytesIO

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import ROOT, VARIANT, parser, spread, write
from PIL import Image

from mi_diffind.core.runtime import use_variant
from mi_diffind.scenes import loading
from mi_diffind.scenes.poses import rotation
from mi_diffind.scenes.viewer import session as viewer
from mi_diffind.scenes.viewer.page import MOVING_QUALITY

SCENES = ("materials", "solids", "field")


def turned(pose, centre, up, degrees):
    return rotation(up, degrees, centre) @ pose


def shown(session, pose) -> tuple[float, tuple[int, int]]:
    """Seconds of a picture from a pose, and its size."""
    start = time.perf_counter()
    session.move_camera(pose)
    picture = session.moving_picture()
    Image.fromarray(picture).save(BytesIO(), "JPEG", quality=MOVING_QUALITY)
    return time.perf_counter() - start, picture.shape[1::-1]


def by_mitsuba(session, pose, seed) -> float:
    """Seconds of the same picture by ``mi.render``, both sides as a whole."""
    start = time.perf_counter()
    session.move_camera(pose)
    session._place()
    images = [loading.render_pass(side.scene, 1, seed) for side in (session.learned, session.exact) if side]
    for image in images:
        viewer.displayed(image.astype(np.float32))
    return time.perf_counter() - start


def measure(name: str, pictures: int) -> dict:
    start = time.perf_counter()
    session = viewer.Session(ROOT / "scenes" / f"{name}.xml")
    loaded = time.perf_counter()
    session.refine()
    first = time.perf_counter()
    centre, up, step = session.target(), session.up(), 0
    viewer.SLOW, viewer.FAST = np.inf, 0.0  # no other size
    fixed, mitsuba = [], []
    for i in range(pictures + 4):
        step += 1
        seconds, size = shown(session, turned(session.start, centre, up, 0.7 * step))
        step += 1
        other = by_mitsuba(session, turned(session.start, centre, up, 0.7 * step), i)
        if i >= 4:
            fixed.append(seconds)
            mitsuba.append(other)
    viewer.SLOW, viewer.FAST = 0.18, 0.04
    adapted, sizes = [], []
    for _ in range(2 * pictures):
        step += 1
        seconds, adapted_size = shown(session, turned(session.start, centre, up, 0.7 * step))
        adapted.append(seconds)
        sizes.append(list(adapted_size))
    path = next(path for path in session.parameters if path.endswith("roughness"))
    changes = []
    for i in range(6):
        start_change = time.perf_counter()
        session.set({path: 0.3 + 0.05 * i})
        session.refine()
        changes.append(time.perf_counter() - start_change)
    return {
        "scene": name,
        "sides": 2 if session.exact else 1,
        "size": list(size),
        "seconds_load": loaded - start,
        "seconds_first_picture": first - loaded,
        "seconds_a_picture": spread(fixed),
        "pictures_a_second": 1 / statistics.median(fixed),
        "seconds_by_mitsuba": spread(mitsuba),
        "speedup": statistics.median(b / a for a, b in zip(fixed, mitsuba, strict=True)),
        "adapted": {
            "seconds_a_picture": spread(adapted),
            "pictures_a_second": len(adapted) / sum(adapted),
            "last_size": sizes[-1],
        },
        "changed_parameter": path,
        "seconds_changed": spread(changes[1:]),
        "first_change": changes[0],
    }


def main() -> None:
    command = parser(__doc__)
    command.add_argument("scenes", nargs="*", default=SCENES)
    command.add_argument("--pictures", type=int, default=20)
    command.add_argument("--variant", default=VARIANT)
    arguments = command.parse_args()
    use_variant(arguments.variant)
    mi.set_log_level(mi.LogLevel.Error)
    load = os.getloadavg()[0]
    rows = []
    for name in arguments.scenes:
        rows.append(measure(name, arguments.pictures))
        print(json.dumps(rows[-1]), flush=True)
    result = {"variant": mi.variant(), "threads": dr.thread_count(), "load_before": load, "rows": rows}
    write(arguments.json, {**result, "load_after": os.getloadavg()[0]})


if __name__ == "__main__":
    main()
