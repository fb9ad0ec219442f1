"""Stored channels of a material, and the maps as functions of them.

The maps of a material (:mod:`.source`) have more channels than content: a grey base colour is one channel three times,
the third component of a normal follows from the other two, a metallic map may be black. A :class:`Layout` lists the
stored channels, each scaled to [0, 1], and the origin of each channel of each map.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from ..arrays.pages import page_gain
from .entries import IDENTITY, ROLES, describe_transform
from .source import MOST_FACTOR, Map, Source

#: Least PSNR, in dB, of the third component of a normal that is derived from the other two.
NORMAL_FLOOR_DB = 45.0

#: Largest magnitude of a value: half of the largest single-precision number, so that no difference overflows.
LARGEST = 1.7e38

#: Linear data of more than 8 bits with a narrower range than this is stored relative to its range.
NARROW = 0.25

#: Room between the range of components and the ends of [0, 1].
MARGIN = 0.02

#: Share of texels beyond the range of components at either end.
OUTSIDE = 1e-3

#: Origin of a channel that follows from the first two channels of a normal map.
FROM_NORMAL = "z"


@dataclass(frozen=True)
class MapLayout:
    """Origin and range of the channels of one map.

    ``where`` holds, for each channel, the index of a stored channel, or :data:`FROM_NORMAL`, the third component of a
    unit normal whose others are the map's first two channels, or ``("constant", value)``. A stored number s in [0, 1]
    means ``low + (high − low)·s``; with ``knee`` > 0, in high dynamic range, ``knee·((1 + high/knee)^s − 1)``. The
    other fields are those of :class:`.source.Map`.
    """

    name: str
    role: str
    color_space: str
    depth: int
    where: tuple
    low: float = 0.0
    high: float = 1.0
    knee: float = 0.0
    transform: tuple[float, ...] = IDENTITY

    @property
    def varies(self) -> bool:
        """Whether the map is not one colour or number."""
        return not all(isinstance(w, tuple) for w in self.where)

    @property
    def channels(self) -> int:
        """Number of channels of the map."""
        return len(self.where)

    def to_json(self) -> dict:
        """Return the entry of a table file's settings."""
        entry = {("kind" if k == "role" else k): v for k, v in asdict(self).items() if v != IDENTITY}
        entry["where"] = [list(w) if isinstance(w, tuple) else w for w in self.where]
        return entry

    def encode(self, values):
        """Return the stored numbers in [0, 1] of ``values``; values beyond the range of the map become its ends."""
        if self.knee > 0:
            s = np.log1p(np.maximum(values, 0) / self.knee) / math.log1p(self.high / self.knee)
        else:
            s = (np.clip(values, self.low, self.high) - self.low) / (self.high - self.low)
        return np.clip(s, 0, 1)

    def decode(self, s, exp2=np.exp2):
        """Return the values of stored numbers: the inverse of :meth:`encode`; ``exp2`` is NumPy's or Dr.Jit's."""
        if self.knee > 0:
            return self.knee * (exp2(s * math.log2(1 + self.high / self.knee)) - 1)
        return s if (self.low, self.high) == (0, 1) else self.low + (self.high - self.low) * s


@dataclass(frozen=True)
class Layout:
    """Size, maps and stored channels of a material.

    ``initial`` has the paper's initial value of each stored channel, ``groups`` the name of its map. ``double_sided``:
    the material reflects on both sides.
    """

    width: int
    height: int
    maps: tuple[MapLayout, ...]
    initial: tuple[float, ...]
    groups: tuple[str, ...]
    double_sided: bool = False

    @staticmethod
    def from_source(
        source: Source, once: bool = True, two_channel_normals: bool | None = None, filtered: bool = False
    ) -> Layout:
        """Return the layout of ``source``.

        - ``once``: store equal channels once, and constant channels as a number.
        - ``two_channel_normals``: leave out the third component of normal maps (``None``: where it follows from the
          other two to :data:`NORMAL_FLOOR_DB`).
        - ``filtered``: channels have to be equal, or constant, at every level of detail (:mod:`.pyramid`); only
          channels that are averaged alike are stored once.
        """
        maps, stored, initial, groups, averaged = [], [], [], [], []
        for m in source.maps:
            shell = _range(m)
            where = []
            vectors = filtered and m.role == "normal" and m.channels == 3
            keep = vectors and not all(m.values[..., c].min() == m.values[..., c].max() for c in range(3))
            averaging = (m.color_space, shell.knee, shell.low, shell.high, vectors and m.name) if filtered else ()
            for c in range(m.values.shape[-1]):
                values = shell.encode(m.values[..., c])
                low = float(values.min())
                if once and low == values.max() and not keep:
                    where.append(("constant", float(m.values[0, 0, c])))
                    continue
                if c == 2 and _drops_z(m, where, two_channel_normals):
                    where.append(FROM_NORMAL)
                    continue
                same = [
                    i for i, v in enumerate(stored) if once and averaged[i] == averaging and np.array_equal(v, values)
                ]
                if not same:
                    same = [len(stored)]
                    stored.append(values)
                    averaged.append(averaging)
                    # Initial values of the cascaded array (supplement 1.3): grey, white, light blue, grey; others 0
                    direction = 1.0 if c == 2 else 0.5
                    grey = {"albedo": 0.5, "ao": 1.0, "roughness": 0.5, "normal": direction}
                    initial.append(grey.get(m.role, 0.0))
                    groups.append(m.name)
                where.append(same[0])
            maps.append(replace(shell, where=tuple(where)))
        return Layout(source.width, source.height, tuple(maps), tuple(initial), tuple(groups), source.double_sided)

    @property
    def stored(self) -> int:
        """Number of stored channels."""
        return len(self.groups)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the maps."""
        return tuple(m.name for m in self.maps)

    def channels_by_map(self) -> dict[str, list[int]]:
        """Return the stored channels of each map, by :attr:`groups`."""
        channels = {}
        for i, name in enumerate(self.groups):
            channels.setdefault(name, []).append(i)
        return channels

    @property
    def source_nbytes(self) -> int:
        """Bytes of the source, uncompressed, at its own depth."""
        return self.width * self.height * sum(m.channels * m.depth for m in self.maps)

    def __getitem__(self, name: str) -> MapLayout:
        """Return the map called ``name``. Raises ``KeyError``."""
        for m in self.maps:
            if m.name == name:
                return m
        raise KeyError(f'found the map "{name}", the file holds {", ".join(self.names)}')

    def needed(self, name: str) -> tuple[int, ...]:
        """Return the stored channels of a map."""
        return tuple(dict.fromkeys(w for w in self[name].where if isinstance(w, int)))

    def encode(self, source: Source) -> np.ndarray:
        """Return the stored channels of ``source``, float32 in [0, 1], shape ``(height, width, stored)``."""
        stored = np.zeros((self.height, self.width, self.stored), np.float32)
        for m, layout in zip(source.maps, self.maps, strict=True):
            for c, where in enumerate(layout.where):
                if isinstance(where, int):
                    stored[..., where] = layout.encode(m.values[..., c])
        return stored

    def decode(self, name: str, stored: Sequence, exp2=np.exp2, root=None) -> list:
        """Return the channels of a map, in its color space, from the stored channels in [0, 1].

        Stored channels that the map does not need may be ``None``. ``exp2`` and ``root``, a square root that is 0 for
        negative numbers, are NumPy's unless given.
        """
        layout = self[name]
        root = root or (lambda v: np.sqrt(np.maximum(v, 0)))
        channels = []
        for where in layout.where:
            if isinstance(where, int):
                channels.append(layout.decode(stored[where], exp2))
            elif where == FROM_NORMAL:
                x, y = 2 * channels[0] - 1, 2 * channels[1] - 1
                channels.append(0.5 + 0.5 * root(1 - x * x - y * y))
            else:
                channels.append(where[1])
        return channels

    def to_json(self) -> dict:
        """Return the layout for the settings of a table file."""
        return {
            "width": self.width,
            "height": self.height,
            "maps": [m.to_json() for m in self.maps],
            "initial": list(self.initial),
            "groups": list(self.groups),
            **({"double_sided": True} if self.double_sided else {}),
        }

    @staticmethod
    def from_json(settings: dict) -> Layout:
        """Return the layout of :meth:`to_json`.

        Raises ``KeyError``, ``TypeError``, ``ValueError`` or ``OverflowError`` for damaged settings.
        """
        maps = []
        for entry in settings["maps"]:
            if not isinstance(entry["name"], str) or not entry["name"].isidentifier():
                raise ValueError(f"a map is called {entry['name']!r:.40}")
            where = tuple(_where(w, len(settings["groups"])) for w in entry["where"])
            role, color_space = str(entry["kind"]), str(entry["color_space"])
            low, high, knee = (float(entry[k]) for k in ("low", "high", "knee"))
            depth = int(entry["depth"])
            if not where or role not in ROLES or color_space not in ("srgb", "linear") or depth not in (0, 1, 2, 4):
                raise ValueError(f'the map "{entry["name"]}" has an unknown role, color space or depth')
            if FROM_NORMAL in where and (where.index(FROM_NORMAL) != 2 or where.count(FROM_NORMAL) != 1):
                raise ValueError(f'the map "{entry["name"]}" derives another channel than the third from a normal')
            finite = max(-low, high, knee) <= LARGEST
            if not (finite and low < high and knee >= 0) or (knee > 0 and not 0 < high <= 1e6 * knee):
                raise ValueError(f'the map "{entry["name"]}" has no range of values')
            transform = tuple(map(float, entry.get("transform", IDENTITY)))
            if len(transform) != 6 or not all(abs(number) <= MOST_FACTOR for number in transform):  # NaN, too
                raise ValueError(f'the map "{entry["name"]}" has no texture transform')
            maps.append(MapLayout(str(entry["name"]), role, color_space, depth, where, low, high, knee, transform))
        width, height = int(settings["width"]), int(settings["height"])
        initial, groups = tuple(map(float, settings["initial"])), tuple(map(str, settings["groups"]))
        if min(width, height) < 1 or width * height >= 2**32 or not maps or len(initial) != len(groups):
            raise ValueError("the size or the channels of the image are damaged")
        if len({m.name for m in maps}) != len(maps):
            raise ValueError("two maps have the same name")
        return Layout(width, height, tuple(maps), initial, groups, settings.get("double_sided", False) is True)


def different_transforms(maps: Iterable[MapLayout]) -> str:
    """Return a clause that names two of the maps which vary and have different texture transforms, "" without such."""
    for first, m in itertools.pairwise(m for m in maps if m.varies):
        if m.transform != first.transform:
            pair = " and ".join(f'"{x.name}" ({describe_transform(x.transform) or "none"})' for x in (first, m))
            return f"the maps {pair} differ in their texture transforms"
    return ""


def _where(w, stored: int):
    """Return the origin of a channel. Raises ``ValueError``."""
    if isinstance(w, int) and not isinstance(w, bool) and 0 <= w < stored:
        return w
    if w == FROM_NORMAL:
        return w
    if isinstance(w, (list, tuple)) and len(w) == 2 and w[0] == "constant":
        value = float(w[1])
        if not abs(value) <= LARGEST:  # NaN, too
            raise ValueError(
                f"a channel has the constant {value:g}, allowed are numbers from -{LARGEST:g} to {LARGEST:g}"
            )
        return ("constant", value)
    raise ValueError(f"a channel has the origin {w!r:.40}, allowed are stored channels, z and constants")


def _range(m: Map) -> MapLayout:
    """Return a layout without channels that has the range of values of a map."""
    low, high, knee = 0.0, 1.0, 0.0
    smallest, largest = (min(max(float(v), -LARGEST), LARGEST) for v in (m.values.min(), m.values.max()))
    if smallest >= 0 and largest > 1:
        # Logarithmic above the knee, linear below: constant relative precision for bright values only
        middle = float(np.median(np.minimum(m.values, largest)))
        knee, high = max(middle, 1e-3 * largest), largest
    elif smallest < 0 or (m.depth > 1 and m.color_space == "linear" and 0 < largest - smallest < NARROW):
        low, high = smallest, max(largest, smallest + 1e-6 * max(1.0, abs(smallest)))
    return MapLayout(m.name, m.role, m.color_space, m.depth, (), low, high, knee, m.transform)


def _drops_z(m: Map, where: list, wanted: bool | None) -> bool:
    """Return whether the third channel of a map is left out; ``where``: origins of the first two."""
    if m.role != "normal" or m.values.shape[-1] != 3 or wanted is False:
        return False
    if not all(isinstance(w, int) for w in where) or m.values.min() < 0 or m.values.max() > 1:
        return False
    if wanted:
        return True
    x, y = 2 * m.values[..., 0] - 1, 2 * m.values[..., 1] - 1
    z = 0.5 + 0.5 * np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return float(np.mean((z - m.values[..., 2]) ** 2)) <= 10 ** (-NORMAL_FLOOR_DB / 10)


#: Largest difference across a border that repeats, as a multiple of the differences between neighbours inside.
TILEABLE = 1.5


def choose_borders(values: np.ndarray) -> tuple[str, str]:
    """Return the borders along v and u of an image of shape ``(height, width, channels)``.

    ``"repeat"`` where the first row (or column) continues the last one (:data:`TILEABLE`), else ``"clamp"``.
    """
    along = []
    if not values.size:
        return ("repeat", "repeat")
    for axis in (0, 1):
        inside = np.abs(np.diff(values, axis=axis)).mean() if values.shape[axis] > 1 else 0.0
        first, last = np.take(values, 0, axis), np.take(values, -1, axis)
        across = np.abs(first - last).mean()
        along.append("repeat" if across <= TILEABLE * inside + 1e-6 else "clamp")
    return tuple(along)


def downscale(values: np.ndarray, rows: int, columns: int, border: tuple[str, str]) -> np.ndarray:
    """Return ``values``, ``(height, width, k)``, filtered at the entries of a ``rows`` × ``columns`` array, float32.

    The filter is a tent as wide as the distance of two entries, or of two texels if that is more.
    """
    height, width, k = values.shape
    down, across = _tent(rows, height, border[0]), _tent(columns, width, border[1])
    filtered = (down @ values.reshape(height, width * k)).reshape(rows, width, k)
    return np.einsum("cw,rwk->rck", across, filtered, optimize=True)


def _tent(entries: int, texels: int, border: str) -> np.ndarray:
    """Return the weights of a tent filter, ``(entries, texels)``; rows sum to 1."""
    step = 1 / max(1, entries if border == "repeat" else entries - 1)
    centres, positions = (np.arange(texels) + 0.5) / texels, np.arange(entries) * step
    distance = np.abs(positions[:, None] - centres[None])
    if border == "repeat":
        distance = np.minimum(distance, 1 - distance)
    weights = np.maximum(1 - distance / max(step, 1 / texels), 0)
    empty = weights.sum(axis=1) == 0  # a clamped end, outside of the outermost texel centres
    weights[empty, np.argmin(distance[empty], axis=1)] = 1
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def smoothness(values: np.ndarray) -> float:
    """Return the smoothness of an image, ``(height, width, k)`` in [0, 1], in dB.

    It is the PSNR of the image in which each texel is the mean of its four neighbours. Noise has 20, a photograph 40.
    """
    if min(values.shape[:2]) < 3:
        return 120.0
    inner = values[1:-1, 1:-1]
    mean = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    return -10 * math.log10(max(float(np.mean((inner - mean / 4) ** 2, dtype=np.float64)), 1e-12))


def channel_covariance(values: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the covariance, ``(k, k)``, of ``values``, ``(height, width, k)``, with the given ``mean``."""
    flat = values.reshape(-1, values.shape[-1]).astype(np.float64)
    return flat.T @ flat / len(flat) - np.outer(mean, mean)


def neighbour_covariance(values: np.ndarray) -> np.ndarray:
    """Return the covariance, ``(k, k)``, of the differences of neighbours in ``values``, ``(height, width, k)``."""
    k = values.shape[-1]
    flat = [np.diff(values, axis=axis).reshape(-1, k).astype(np.float64) for axis in (0, 1)]
    return sum(f.T @ f / max(len(f), 1) for f in flat)


def component_range(projected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper end of each component in ``projected``, ``(…, n)``, without :data:`OUTSIDE`."""
    *places, count = projected.shape
    low, high = np.quantile(projected.reshape(math.prod(places), count), [OUTSIDE, 1 - OUTSIDE], axis=0)
    return low, np.maximum(high, low + 1e-3)


def linear_in_pointer(
    channels: np.ndarray, directions: np.ndarray, low, high, sides: Sequence[int], axes: Iterable[int]
) -> np.ndarray:
    """Return ``channels`` plus components that grow along ``axes`` of a cascaded array: ``(*sides, k)``.

    Each of the ``directions``, ``(n, k)``, is multiplied by numbers from ``low`` to ``high`` along its axis, with room
    for :data:`MARGIN` at both ends.
    """
    for axis, direction, first, last in zip(axes, directions, low, high, strict=True):
        side = sides[axis]
        grid = (np.linspace(0, 1, side) - MARGIN) / (1 - 2 * MARGIN) if side > 1 else np.array([0.5])
        along = np.reshape(first + grid * (last - first), [-1 if d == axis else 1 for d in range(len(sides))])
        channels = channels + along[..., None] * direction
    return channels


def gain_of_pages(values: np.ndarray, dims: int, entries: float, border: tuple[str, str]) -> tuple[float, float]:
    """Return :func:`.page_gain` of the first ``dims`` components of an image, ``(height, width, k)``, in [0, 1].

    Pages and grid have ``entries`` entries. The PSNR is the mean of the channels.
    """
    k = values.shape[-1]
    mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
    covariance = channel_covariance(values, mean)
    directions = eigenvectors(covariance, min(dims, k))
    rest = np.trace(covariance) - np.trace(directions @ covariance @ directions.T)
    exact = ((values - mean) @ directions.T).astype(np.float32)
    gain, psnr = page_gain(exact, border, entries, max(float(rest), 0.0))
    return gain, psnr + 10 * math.log10(k)


def eigenvectors(covariance: np.ndarray, count: int) -> np.ndarray:
    """Return the eigenvectors of the largest eigenvalues, ``(count, k)``; the largest component of each is positive."""
    _, directions = np.linalg.eigh(covariance)
    directions = directions.T[::-1][:count]
    largest = np.argmax(np.abs(directions), axis=1)
    return directions * np.sign(directions[np.arange(count), largest])[:, None]
