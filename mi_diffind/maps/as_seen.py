"""Materials as they are seen: shaded pictures of the maps of a source and of decoded maps, and their differences.

A floor and a ball stand under a sky with a window and lamps. They are rendered with Mitsuba's ``principled`` and
``normalmap`` in four ways (:data:`WAYS`): glossy and rough, near and far. The pictures of two materials take the same
random numbers, so that maps without errors give a difference of 0. Each picture is rendered twice, with independent
random numbers: the mean product of both differences is the squared error without the noise of the renders.
"""

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType

import numpy as np

from ..images import metrics, srgb
from .pyramid import CompressedMaps, decibel
from .source import Map, Source

#: Share of the way from the roughness of the map to 1, by the name of a surface.
SURFACES = {"glossy": 0.0, "rough": 0.5}

#: Side of the shown texture and of its patches, both in texels, and samples a pixel of each render, by the distance.
DISTANCES = {"near": (192, 8, 16), "far": (768, 48, 16)}

#: Factor of all radiance, which brings a picture of grey maps to about 0.3.
EXPOSURE = 1.2

#: Names of the four pictures.
WAYS = tuple(f"{surface}_{distance}" for surface in SURFACES for distance in DISTANCES)

#: Names of those from near, which take less time.
NEAR = tuple(way for way in WAYS if way.endswith("near"))

#: Columns and rows of a picture.
SIZE = (192, 144)

#: Values of maps that a material lacks, by role.
DEFAULTS = {"albedo": (0.5, 0.5, 0.5), "normal": (0.5, 0.5, 1.0), "roughness": (0.4,), "metallic": (0.0,)}

#: Error of a channel by which sensitivities are measured.
NOISE = 0.01

#: Samples a pixel of the renders of sensitivities.
FEW_SAMPLES = 4

_references: dict[tuple, dict[str, np.ndarray]] = {}  # pictures of the latest source


def shows(source: Source) -> bool:
    """Return whether pictures say more than the errors of the maps: with a map of normals or of roughness."""
    return not {"normal", "roughness"}.isdisjoint(_roles(source))


def measure(source: Source, image: CompressedMaps, ways: Sequence[str] = WAYS) -> dict[str, float]:
    """Return errors of the decoded maps of ``image`` against those of the ``source``, as :func:`compare` does."""
    names = [m.name for m in (*_normals(source), *(_roles(source).values() if shows(source) else ()))]
    decoded = image.decode(tuple(dict.fromkeys(names))) if names else {}
    return compare(source, decoded, image.types, ways)


def compare(
    source: Source, decoded: Mapping[str, np.ndarray], types: ModuleType | None, ways: Sequence[str] = WAYS
) -> dict[str, float]:
    """Return errors of ``decoded`` maps, by name, against those of the ``source``, in degrees and in pictures.

    - ``angle_MAP_deg``: the mean angle between normals, in degrees.
    - ``seen_WAY_db``: the PSNR of each of ``ways``, of linear values clipped to [0, 1]; ``seen_db``: that of all.
    - ``seen_brightness``: the mean of a picture relative to the source's, where it differs most.

    There are no pictures unless :func:`shows`, nor if ``types``, the module of Dr.Jit types whose device renders, is
    ``None``, as it is for maps of one colour each.
    """
    angles = {f"angle_{m.name}_deg": metrics.angle(m.values, decoded[m.name]) for m in _normals(source)}
    if types is None or not shows(source):
        return angles
    references = reference(source, types, ways)
    pictures = render(by_role(source, decoded), types, ways)
    squares = {way: squared_error(references[way], pictures[way]) for way in ways}
    ratios = [float(pictures[way].mean() / references[way].mean()) for way in ways]
    return {
        **angles,
        "seen_db": decibel(sum(squares.values()) / len(squares)),
        **{f"seen_{way}_db": decibel(square) for way, square in squares.items()},
        "seen_brightness": max(ratios, key=lambda ratio: abs(ratio - 1)),
    }


def reference(source: Source, types: ModuleType, ways: Sequence[str] = WAYS) -> dict[str, np.ndarray]:
    """Return the pictures of the maps of a source; the latest ones are kept.

    ``types`` is the module of Dr.Jit types whose device renders.
    """
    key = (source.digest, types.__name__, tuple(ways))
    if key not in _references:
        _references.clear()
        _references[key] = render(by_role(source, {m.name: m.values for m in source.maps}), types, ways)
    return _references[key]


def sensitivities(source: Source, types: ModuleType) -> dict[str, float]:
    """Return the squared error of pictures that a squared error of 1 in a channel would cause, by the name of a map.

    A little noise (:data:`NOISE`) is added to one map after the other, and pictures from near, of few samples, are
    compared with those of the source. A map that is not shown has 0.
    """
    truth = {m.name: m.values for m in source.maps}
    rng = np.random.default_rng(2023)
    squares = dict.fromkeys(truth, 0.0)
    references = render(by_role(source, truth), types, NEAR, FEW_SAMPLES)
    for m in _roles(source).values():
        change = NOISE * rng.choice(np.float32([-1, 1]), m.values.shape)
        pictures = render(by_role(source, truth | {m.name: m.values + change}), types, NEAR, FEW_SAMPLES)
        errors = [squared_error(references[way], pictures[way]) for way in NEAR]
        squares[m.name] = float(np.mean(errors)) / (NOISE**2 * m.channels)
    return squares


def by_role(source: Source, maps: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the maps that a picture shows, ``(height, width, channels)`` linear in [0, 1], by role."""
    shown = {}
    for role, m in _roles(source).items():
        values = np.clip(maps[m.name], 0, 1).astype(np.float32)
        if m.color_space == "srgb":
            values = srgb.to_linear(values)
        shown[role] = values if values.shape[2] == len(DEFAULTS[role]) else np.repeat(values[..., :1], 3, axis=2)
    return shown


def _normals(source: Source) -> list[Map]:
    """Return the maps of normals of three channels."""
    return [m for m in source.maps if m.role == "normal" and m.channels == 3]


def _roles(source: Source) -> dict[str, Map]:
    """Return the first map of each role in :data:`DEFAULTS` that has its channels, or one channel."""
    shown = {}
    for m in source.maps:
        channels = len(DEFAULTS.get(m.role, ()))
        if m.channels == channels or (m.channels == 1 and m.role == "albedo"):
            shown.setdefault(m.role, m)
    return shown


def render(
    maps: Mapping[str, np.ndarray], types: ModuleType, ways: Sequence[str] = WAYS, spp: int = 0
) -> dict[str, np.ndarray]:
    """Return the pictures of maps by role (:func:`by_role`): two renders each, ``(2, rows, columns, 3)``, linear.

    ``spp`` are the samples a pixel, by default those of the distance.
    """
    import mitsuba as mi

    pictures = {}
    with _variant(types):
        for distance, (side, patch, samples) in DISTANCES.items():
            if not any(way.endswith(distance) for way in ways):
                continue
            patches = {role: patchwork(values, side, patch) for role, values in maps.items()}
            for surface, share in SURFACES.items():
                if f"{surface}_{distance}" in ways:
                    scene = mi.load_dict(_scene(patches, share))
                    renders = [mi.render(scene, spp=spp or samples, seed=seed).numpy() for seed in range(2)]
                    pictures[f"{surface}_{distance}"] = np.stack(renders)
                    del scene
    return pictures


def squared_error(reference: np.ndarray, picture: np.ndarray) -> float:
    """Return the mean squared error of a picture, without the noise of its two renders, values clipped to [0, 1]."""
    first, second = (np.clip(picture, 0, 1) - np.clip(reference, 0, 1)).astype(np.float64)
    return max(0.0, float(np.mean(first * second)))


def patchwork(values: np.ndarray, side: int, patch: int) -> np.ndarray:
    """Return at most ``side`` × ``side`` texels of a map: square patches, one from each cell of a grid.

    Along an axis of no more than ``side`` texels, all of them are shown. The places are the same for all maps.
    """
    rng = np.random.default_rng(2023)
    height, width = values.shape[:2]
    rows, columns = (max(1, -(-min(n, side) // patch)) for n in (height, width))
    jitter = rng.random((2, rows, columns))
    index = []
    for axis, (n, cells) in enumerate(((height, rows), (width, columns))):
        count = min(n, side)
        start = np.arange(count) // patch  # the cell of a texel
        room = max(0.0, n / cells - patch) if n > side else 0.0
        first = np.arange(cells) * (n / cells if n > side else patch)
        first = first[:, None] if axis == 0 else first[None]
        index.append((np.int64(first + jitter[axis] * room), start, np.arange(count) % patch))
    (down, i, y), (across, j, x) = index
    along_v = np.minimum(down[i[:, None], j[None]] + y[:, None], height - 1)
    along_u = np.minimum(across[i[:, None], j[None]] + x[None], width - 1)
    return values[along_v, along_u]


def sky(rows: int = 64) -> np.ndarray:
    """Return the environment, ``(rows, 2·rows, 3)``: a room with a dark ground, windows with panes, and lamps."""
    v, u = np.mgrid[0:rows, 0 : 2 * rows].astype(np.float32) + 0.5
    v, u = v / rows, u / (2 * rows)
    up = np.cos(np.pi * v)[..., None]
    values = np.where(up > 0, 0.3 + 0.4 * up * np.float32([0.8, 0.9, 1.1]), np.float32([0.12, 0.1, 0.08]))
    panes = (np.abs(24 * u % 1 - 0.5) < 0.38) & (np.abs(14 * v % 1 - 0.5) < 0.4)
    window = panes & (np.abs(v - 0.36) < 0.107) & (np.abs(np.abs(u - 0.5) - 0.21) < 0.083)
    lamps = (np.abs(v - 0.14) < 0.03) & (np.abs(8 * u % 1 - 0.5) < 0.2)
    values = values + window[..., None] * np.float32([5, 5.5, 6.5]) + lamps[..., None] * np.float32([9, 8, 6])
    return np.ascontiguousarray(EXPOSURE * values, dtype=np.float32)


def _scene(maps: Mapping[str, np.ndarray], share: float) -> dict:
    """Return the scene for ``mi.load_dict``; ``share`` is one of :data:`SURFACES`."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f
    values = {role: maps.get(role, np.float32([[constant]])) for role, constant in DEFAULTS.items()}
    values["roughness"] = values["roughness"] + share * (1 - values["roughness"])
    textures = {
        role: {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(v, np.float32)), "raw": True}
        for role, v in values.items()
    }
    bsdf = mi.load_dict({
        "type": "normalmap", "normalmap": textures["normal"],
        "bsdf": {"type": "principled", "base_color": textures["albedo"],
                 "roughness": textures["roughness"], "metallic": textures["metallic"]},
    })  # fmt: skip
    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 35, "film": film, "sampler": {"type": "multijitter"},
                   "to_world": transform().look_at([0, -2.6, 2.2], [0, 0, 0.2], [0, 0, 1])},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(sky()), "to_world": transform().rotate([1, 0, 0], 90)},
        "floor": {"type": "rectangle", "bsdf": bsdf},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5, "bsdf": bsdf},
    }  # fmt: skip


@contextlib.contextmanager
def _variant(types: ModuleType) -> Iterator[None]:
    """Set the variant of Mitsuba of RGB colours on the device of ``types``, and afterwards the earlier one again."""
    import mitsuba as mi

    before = mi.variant()
    mi.set_variant(f"{types.__name__.split('.')[1]}_ad_rgb")
    try:
        yield
    finally:
        if before is not None:
            mi.set_variant(before)
