"""
Task 1: the isotropic GGX distribution of normals, read from arrays (METHOD task 1, supplemental 1.1).

The truth is Trowbridge and Reitz's distribution (Walter et al. 2007, equation 33) with the normal (0, 0, 1),

    D(h) = α² / (π q²),   q = sin²θ_h + α² cos²θ_h,

whose peak 1/(π α²) is unbounded: 0.3 at α = 1, 318,310 at α = 0.001. Between entries and D stands therefore an
:class:`Encoding`, and which one it is matters more than how the arrays are made:

``"tables"`` (default)
    *Inputs* on logarithmic axes: v = 1 + log α / log(1/α_min) and u = 1 + log(sin²θ_h (1 − ε) + ε) / log(1/ε) with ε =
    α_min²/4. Every decade of roughness gets the same number of entries, and the same resolution within its peak: in
    units of α, all peaks look alike. *Output* y = (D / D_peak)^¼ = α/√q, which lies in (0, 1]: the peak is 1 whatever
    α is, so the relative error of D at the peak is 4 times the error of an entry, at any roughness. The error measure
    is the mean absolute error of y. Half of the training samples follow the cosine-weighted hemisphere, three
    eighths are distributed as the peak itself, and one eighth lies at its very centre, which a cosine-weighted draw
    never sees (at α = 0.001 one sample in a million comes close).

``"paper"``
    *Inputs* cos θ_h and α as they are, *output* D as it is, mean absolute error, cosine-weighted samples: the
    supplement's recipe. It misses the peak at low roughness: an entry is 1/15 wide, the peak α².

Roughness is drawn from an exponential-like distribution, as for the Disney BRDF, and clamped to α ≥ 0.001.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr

from ..fitting import FitResult, FitSettings, fit
from ..indirection import DifferentiableArray, Indirection
from ..lookup import STORAGES, clamp
from ..runtime import array_module
from ..tables import Table, TableError, load_table
from .distributions import exponential_like

TASK = "ggx"

#: Least roughness that is learned. Below it, the distribution is read there, at an angle that is scaled accordingly.
ALPHA_MIN = 1e-3

#: Least roughness of all: that of Mitsuba's ``MicrofacetDistribution``.
ALPHA_FLOOR = 1e-4

#: Bands of roughness for which errors are reported.
BANDS = ((0.001, 0.01), (0.01, 0.1), (0.1, 0.5), (0.5, 1.0))

INPUTS, OUTPUTS = ("logarithmic", "plain"), ("root", "raw")

_FOLDER = Path(__file__).resolve().parents[1] / "data"


def ggx(sin2, alpha):
    """D per solid angle of normals, from sin²θ_h and α (both in [0, 1], α > 0); exact also next to the peak."""
    a2 = dr.square(alpha)
    q = dr.fma(1 - sin2, a2, sin2)
    return a2 / (dr.pi * dr.square(q))


@dataclass(frozen=True)
class Encoding:
    """
    What stands between (θ_h, α) and the coordinates at which arrays are read (``inputs``: ``"logarithmic"`` or
    ``"plain"``), and between what is read and D (``output``: ``"root"`` or ``"raw"``). See the module.
    """

    inputs: str = "logarithmic"
    output: str = "root"

    def __post_init__(self):
        if self.inputs not in INPUTS or self.output not in OUTPUTS:
            raise ValueError(f"found the encoding {self}, allowed are inputs {INPUTS} and outputs {OUTPUTS}")

    def coordinate_alpha(self, alpha):
        """The coordinate in [0, 1] that belongs to α ≥ :data:`ALPHA_FLOOR`."""
        if self.inputs == "plain":
            return alpha
        return dr.fma(dr.log2(dr.maximum(alpha, ALPHA_MIN)), -1 / math.log2(ALPHA_MIN), 1)

    def stretch(self, alpha):
        """By how much sin²θ_h is stretched, since nothing below :data:`ALPHA_MIN` is learned; at least 1."""
        if self.inputs == "plain":
            return 1
        return dr.square(dr.maximum(ALPHA_MIN * dr.rcp(alpha), 1))

    def coordinate_normal(self, cos, sin2, stretch=1):
        """The coordinate in [0, 1] that belongs to the angle of the half vector (cos θ_h ≥ 0 and sin²θ_h)."""
        if self.inputs == "plain":
            return cos
        ε = ALPHA_MIN**2 / 4
        return dr.fma(dr.log2(dr.fma(dr.minimum(sin2 * stretch, 1), 1 - ε, ε)), -1 / math.log2(ε), 1)

    def coordinates(self, cos, sin2, alpha) -> list:
        """Both coordinates: of the normal and of α."""
        return [self.coordinate_normal(cos, sin2, self.stretch(alpha)), self.coordinate_alpha(alpha)]

    def encode(self, d, alpha):
        """What arrays are to hold where the distribution is ``d``."""
        return d if self.output == "raw" else dr.sqrt(dr.sqrt(d * self.peak_inverse(alpha)))

    def peak_inverse(self, alpha):
        """1/D_peak = π α²."""
        return dr.pi * dr.square(alpha)

    def decode(self, y, peak):
        """D from what was read, and from ``peak`` = 1/(π α²), which depends on α alone. Never negative."""
        return dr.maximum(y, 0) if self.output == "raw" else dr.square(dr.square(y)) * peak


#: The encoding of each level of quality.
ENCODINGS = {"tables": Encoding(), "paper": Encoding("plain", "raw")}

#: The tables that ship; ``mi_diffind/data/README.md`` holds the commands that made them.
SHIPPED = {quality: _FOLDER / f"ggx_{quality}.npz" for quality in ENCODINGS}

#: The settings that made the shipped tables.
DEFAULT_SETTINGS = {
    "tables": FitSettings(steps=4000, batch=65536, lr=1e-2, schedule="cosine", seed=1, quality_every=200),
    "paper": FitSettings(steps=3000, batch=65536, lr=1e-3, schedule="constant", seed=1, quality_every=200),
}


@dataclass
class Roughness:
    """
    What a read of the distribution needs to know about α: ``alpha2`` = α², ``peak`` = 1/(π α²), by how much sin²θ_h is
    to be stretched, and the coordinate of α, or the function of the other coordinate that remains once it is known
    (``net``).
    """

    alpha2: Any
    peak: Any
    stretch: Any
    coordinate: Any = None
    net: Callable | None = None


class LearnedGGX:
    """
    The distribution as ``net`` has it, any function from a list of two coordinates in [0, 1] to a list of one array:
    an :class:`~mi_diffind.indirection.Indirection`, a single array, a network.
    """

    def __init__(self, net: Callable, encoding: Encoding):
        self.net, self.encoding = net, encoding

    def roughness(self, alpha) -> Roughness:
        """Whatever depends on α alone; α is limited to [:data:`ALPHA_FLOOR`, 1], NaN becomes the former."""
        alpha = clamp(alpha, ALPHA_FLOOR, 1)
        alpha2, e = dr.square(alpha), self.encoding
        return Roughness(alpha2, dr.rcp(dr.pi * alpha2), e.stretch(alpha), e.coordinate_alpha(alpha))

    def constant_roughness(self, alpha) -> Roughness:
        """
        The same for an α that is one number: what remains of an indirection's primary array is a row of it, two
        entries to read instead of four.
        """
        found = self.roughness(alpha)
        if isinstance(self.net, Indirection):
            row = self.net.primary[0].at(found.coordinate)
            found.net, found.coordinate = Indirection(row, self.net.cascaded), None
        return found

    def read(self, r: Roughness, cos, sin2, active=True):
        """D per solid angle of normals, from cos θ_h ≥ 0 and sin²θ_h."""
        x = [self.encoding.coordinate_normal(cos, sin2, r.stretch)]
        y = self.net([*x, r.coordinate], active) if r.net is None else r.net(x, active)
        return self.encoding.decode(y[0], r.peak)

    def __call__(self, cos, sin2, alpha):
        """D per solid angle of normals, from cos θ_h, sin²θ_h and α."""
        return self.read(self.roughness(alpha), cos, sin2)


def indirection(primary: int = 16, cascaded: int = 8) -> Indirection:
    """
    The arrays of task 1, not yet allocated: a primary of ``primary``² × 2 entries, the undistorted uv ramp, and a
    cascaded one of ``cascaded``² × 1, constant 0.5, with no non-linearity on its output. Raises ``ValueError``.
    """
    for name, n in (("primary", primary), ("cascaded", cascaded)):
        if not 2 <= n <= 4096:
            raise ValueError(f"{name}: found {n}, allowed are 2 to 4096 entries a side")
    return Indirection(
        DifferentiableArray((primary, primary), 2, "ramp", fold=True),
        DifferentiableArray((cascaded, cascaded), 1, "constant", 0.5),
    )


# -- samples and errors -----------------------------------------------------------------------------------------------


def draw(rng, types, size: int, quality: str = "paper"):
    """
    ``(cos θ_h, sin²θ_h, α)``, each ``size`` long: cosine-weighted normals and exponential-like roughness (``"paper"``),
    or with half of the normals from the peak (``"tables"``), see the module.
    """
    u, v = (rng.random(types.Float, size) for _ in range(2))
    alpha = dr.maximum(exponential_like(v), ALPHA_MIN)
    sin2 = u
    if quality == "tables":
        which, a2 = rng.random(types.Float, size), dr.square(alpha)
        peak = dr.select(which < 0.125, 0, u * a2 / (dr.fma(u, a2, 1 - u)))  # of density D cos θ_h
        sin2 = dr.select(which < 0.5, peak, sin2)
    return dr.sqrt(1 - sin2), sin2, alpha


def measure(distribution: Callable, types, samples: int = 10**6, seed: int = 2023) -> dict[str, float]:
    """
    Errors of ``distribution(cos, sin2, alpha)`` against :func:`ggx`.

    On the bounded range: ``psnr_db`` and ``mae`` of D clipped to [0, 1], over ``samples`` of :func:`draw`. On the peak,
    for each of :data:`BANDS`: ``peak_error_LOW_HIGH``, the largest of |D̂/D − 1| at the normal itself over 64
    roughnesses of the band, and ``lobe_error_LOW_HIGH``, the 99th percentile of it where D is at least a tenth of the
    peak's (16,384 samples).
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    cos, sin2, alpha = draw(rng, types, samples)
    error = dr.clip(distribution(cos, sin2, alpha), 0, 1) - dr.clip(ggx(sin2, alpha), 0, 1)
    found = {
        "psnr_db": -10 * math.log10(max(dr.mean(dr.square(error))[0], 1e-20)),
        "mae": float(dr.mean(dr.abs(error))[0]),
    }
    # D ≥ D_peak/10 where q ≤ √10 α², that is, where sin² ≤ (√10 − 1) α² / (1 − α²)
    n, m = 64, 256
    index = dr.arange(types.UInt32, n * m)
    i, j = types.Float(index // m) / (n - 1), types.Float(index % m) / (m - 1)
    for low, high in BANDS:
        alpha = low * dr.power(high / low, i)
        a2 = dr.square(alpha)
        limit = dr.minimum((math.sqrt(10) - 1) * a2 / dr.maximum(1 - a2, 1e-6), 1)
        sin2 = limit * j
        relative = dr.abs(distribution(dr.sqrt(1 - sin2), sin2, alpha) / ggx(sin2, alpha) - 1).numpy().reshape(n, m)
        name = f"{low:g}_{high:g}"
        found[f"peak_error_{name}"] = float(relative[:, 0].max())
        found[f"lobe_error_{name}"] = float(sorted(relative.ravel())[int(0.99 * n * m)])
    return found


# -- training ---------------------------------------------------------------------------------------------------------


class GGXProblem:
    """
    The training problem of :mod:`mi_diffind.fitting` for any representation: ``net`` maps two coordinates to one
    output. ``quality`` names the samples to draw, ``encoding`` (default: that of the quality) what they become.
    """

    weights: dict[str, float] = {}  # noqa: RUF012

    #: dB. The peak gains after the mean has settled.
    tolerance = 0.1

    def __init__(self, net, types, quality: str = "tables", encoding: Encoding | None = None):
        self.net, self.types, self.samples = net, types, quality
        self.encoding = encoding or ENCODINGS[quality]
        self.about = {"samples": quality, **asdict(self.encoding)}

    def batch(self, rng, size: int):
        cos, sin2, alpha = draw(rng, self.types, size, self.samples)
        target = self.encoding.encode(ggx(sin2, alpha), alpha)
        return self.encoding.coordinates(cos, sin2, alpha), {"d": [target]}

    def predict(self, net, inputs) -> dict[str, list]:
        return {"d": net(inputs)}

    def quality(self, net) -> dict[str, float]:
        return measure(LearnedGGX(net, self.encoding), self.types, 2**18)


def fit_ggx(
    settings: FitSettings | None = None,
    backend: str | None = None,
    quality: str = "tables",
    storage: str = "float32",
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: bool = True,
    primary: int = 16,
    cascaded: int = 8,
) -> tuple[Table, FitResult]:
    """
    Train the arrays of a level of quality, of ``primary``² × 2 and ``cascaded``² × 1 entries, and return them with
    their errors (:func:`measure`, in the storage form) and the run's record. ``settings`` are those of
    :data:`DEFAULT_SETTINGS` unless given. Raises ``ValueError`` for a quality, storage form or size that is unknown.
    """
    _check(quality, storage)
    settings = settings or DEFAULT_SETTINGS[quality]
    types = array_module(backend)
    net = indirection(primary, cascaded).alloc(types.TensorXf)
    result = fit(GGXProblem(net, types, quality), settings, checkpoint, resume, progress)
    encoding = ENCODINGS[quality]
    about = {**asdict(settings), "quality": quality, **asdict(encoding)}
    arrays = {"primary": net.primary[0], "cascaded": net.cascaded}
    table = Table(
        TASK,
        {name: array.numpy() for name, array in arrays.items()},
        borders={name: array.border for name, array in arrays.items()},
        settings=about,
        seed=settings.seed,
    ).to(storage)
    stored = to_indirection(table, types.TensorXf)
    table.quality = {k: float(f"{v:.5g}") for k, v in measure(LearnedGGX(stored, encoding), types).items()}
    return table, result


# -- files ------------------------------------------------------------------------------------------------------------


def to_indirection(table: Table, dtype, storage: str = "") -> Indirection:
    """The arrays of a table file for the tensor type ``dtype``; ``storage`` "" means the file's own."""
    form = table.to(storage or table.storage)
    arrays = {}
    for name in ("primary", "cascaded"):
        arrays[name] = DifferentiableArray.from_numpy(
            form.arrays[name], dtype, form.borders[name], form.storage, quantization=form.quantization.get(name)
        )
    arrays["primary"].folded = form.storage == "float32"  # an optimiser may leave the range
    return Indirection(arrays["primary"], arrays["cascaded"])


def load_ggx_table(path: str | os.PathLike) -> tuple[Table, Encoding]:
    """Read and check a table file of this task. Raises :class:`~mi_diffind.tables.TableError`."""
    table = load_table(path, TASK, {"primary": (None, None, 2), "cascaded": (None, None, 1)})
    try:
        encoding = Encoding(table.settings["inputs"], table.settings["output"])
    except (KeyError, TypeError, ValueError) as e:
        raise TableError(f"{path}: its settings name no encoding that is known ({e})") from None
    ranges = {"primary": (0.0, 1.0)}
    if encoding.output == "root":
        ranges["cascaded"] = (-0.5, 1.5)
    for name, (low, high) in ranges.items():
        values = table.values(name)
        if values.min() < low - 1e-3 or values.max() > high + 1e-3:
            raise TableError(
                f'{path}: entries of "{name}" lie in [{values.min():.4g}, {values.max():.4g}], '
                f"allowed is [{low:g}, {high:g}]"
            )
    return table, encoding


def table_file(filename: str | os.PathLike, quality: str = "") -> Path:
    """The file that is read: ``filename``, or the one that ships for ``quality`` ("": the default)."""
    return Path(filename) if str(filename) else SHIPPED[quality or "tables"]


def load_ggx(filename: str | os.PathLike, dtype, storage: str = "", quality: str = "") -> tuple[LearnedGGX, str]:
    """
    The distribution of a table file ("": the shipped one of ``quality``) for the tensor type ``dtype``, in the given
    storage form ("": the file's own), and the quality that it has. Raises ``TableError`` or ``ValueError``.

    A file is read and checked once, and what is returned shares its memory; assigning to one copy does not change
    another.
    """
    _check(quality, storage)
    path = table_file(filename, quality)
    net, encoding = _load(path, path.stat().st_mtime_ns if path.is_file() else 0, dtype, storage)
    has = next((name for name, e in ENCODINGS.items() if e == encoding), "tables")
    if quality not in ("", has):
        raise TableError(f'{path}: holds tables of the preset "{has}", "{quality}" was asked for')
    copies = []
    for array in (*net.primary, net.cascaded):
        copies.append(array._like())
        copies[-1].data = type(array.data)(array.data)
    return LearnedGGX(Indirection(*copies), encoding), has


def _check(quality: str, storage: str) -> None:
    for name, found, allowed in (("preset", quality, tuple(ENCODINGS)), ("storage", storage, STORAGES)):
        if found and found not in allowed:
            raise ValueError(f'parameter "{name}": found "{found}", allowed are {", ".join(allowed)}')


@functools.lru_cache(maxsize=64)
def _load(path: Path, stamp: int, dtype, storage: str) -> tuple[Indirection, Encoding]:
    table, encoding = load_ggx_table(path)
    return to_indirection(table, dtype, storage), encoding
