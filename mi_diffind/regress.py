"""
A scene beside a stored rendering of itself: has anything changed that sampling noise does not explain?

The statistics are those of Mitsuba's ``src/render/tests/test_renders.py``: each pixel of a render within a fixed sample
budget is held against a reference and its variance by a z-test. The reference comes from the scene as written, learned
plugins included: this finds changes, and how far an approximation is from the truth is for :mod:`.compare` to say.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import statistics
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from . import __version__, compat, plugins, scenes
from .files import OutputError, replacing, writable_file, writable_folder
from .interrupt import interruptible
from .measure import figure_grid

#: Chance that a scene in which nothing has changed has a pixel below the threshold, were all pixels independent.
SIGNIFICANCE = 0.01
#: The variance of a sample is taken to be at least this (linear radiance, squared).
VARIANCE_FLOOR = 1e-4
#: The part of the pixels that has to pass.
REQUIRED = 0.9975
#: Samples of the whole image that a check takes if nobody says otherwise.
BUDGET = 2_000_000
#: A reference has at least this many times the samples of a check …
REFERENCE_FACTOR = 16
#: … in this many independent passes, whose scatter is its variance.
REFERENCE_PASSES = 128

#: A probe finds out in seconds whether a reference will pass its own check: of a smaller image, it takes as many
#: samples a pixel as both would, in so many passes, each pair of which is checked against the others.
PROBE_PASSES = 2 * (1 + REFERENCE_FACTOR)
#: All samples of a probe are about so many …
PROBE_SAMPLES = 1 << 22
#: … and its pixels within these.
PROBE_PIXELS = (256, 1 << 14)
#: A scene is refused if a probe finds more than so many times the pixels that may fail, and so many pixels of the image
#: more. Less is too close to call.
_HOPELESS, _CHANCE = 2, 3
#: How many times the samples are tried to say how many would do.
_FACTORS = (2, 4, 8, 16)

#: Of Mitsuba's seeds ``(seed << 16) + i``, checks use those with ``i`` below, references those from here on.
_REFERENCE_SEEDS = 1 << 15
#: Samples of the whole image in one pass of a check, to bound the memory it takes.
_PASS = 1 << 22
#: Where the passes of a probe begin.
_PROBE_SEEDS = (1 << 16) - PROBE_PASSES
#: The seed of the check that a new reference has to pass.
_OWN_CHECK = (1 << 16) - 1
_ATTRIBUTE = "mi_diffind"
_REMEDY = "remove it and make it again with --update"
_ABOUT = {"scene": str, "variant": str, "defines": dict, "budget": int, "spp": int, "seed": int}


class BadReference(scenes.SceneError):
    """A stored reference is missing, damaged, or of another size; the message is one sentence that names it."""


@dataclass(frozen=True)
class Reference:
    """
    A stored rendering: ``image`` and the ``variance`` of one sample, both ``(height, width, channels)``, float32,
    linear, of 3 channels (red, green, blue) or 1 (mono variants); and ``about``: ``scene`` (file name without its
    extension), ``variant``, ``defines`` (texts for the scene's ``<default>`` values), ``budget`` (samples per pixel of
    a check), ``spp`` (samples per pixel of the reference), ``seed``, and the ``versions`` of mi_diffind and Mitsuba
    that rendered it.
    """

    image: np.ndarray
    variance: np.ndarray
    about: dict


@dataclass(frozen=True)
class ZTest:
    """
    What :func:`z_test` found: ``p_values`` ``(height, width, channels)``; ``alpha``, the threshold for each;
    ``failing`` pixels ``(height, width)``, which have a channel at or below it; the ``fraction`` of pixels that pass;
    and whether that is enough (``passed``).
    """

    p_values: np.ndarray
    alpha: float
    failing: np.ndarray
    fraction: float
    passed: bool


def z_test(
    image: np.ndarray, reference: np.ndarray, variance: np.ndarray, spp: int, reference_spp: float = math.inf
) -> ZTest:
    """
    Is ``image`` (``spp`` samples a pixel) a rendering of what ``reference`` shows (``reference_spp`` samples a pixel)?

    All three arrays are ``(height, width, channels)``, linear; ``variance`` is that of one sample. For each value,

        z = |image − reference| / sqrt(max(variance, 1e-4) · (1/spp + 1/reference_spp)),    p = erfc(z / √2),

    and a pixel passes if p > α = 1 − (1 − 0.01)^(1/pixels) in each channel (Šidák's correction of a significance of
    1%). 99.75% of the pixels have to. The rest is allowed since the means of few samples have longer tails than a
    normal distribution where bright paths are rare. Values that are not finite fail.

    Mitsuba's ``test_renders.py`` differs in two points: it counts passing channels instead of pixels, and takes the
    reference to be free of noise. Raises ``ValueError`` for arrays of different shapes.
    """
    if not image.shape == reference.shape == variance.shape:
        raise ValueError(f"shapes differ: image {image.shape}, reference {reference.shape}, variance {variance.shape}")
    with np.errstate(invalid="ignore", over="ignore"):
        spread = np.maximum(variance.astype(np.float64), VARIANCE_FLOOR) * (1 / spp + 1 / reference_spp)
        z = np.abs(image.astype(np.float64) - reference) / np.sqrt(spread)
    p_values = np.array([math.erfc(v) if v == v else 0.0 for v in (z / math.sqrt(2)).flat]).reshape(image.shape)
    pixels = image.shape[0] * image.shape[1]
    alpha = _alpha(pixels)
    failing = (p_values <= alpha).any(axis=-1)
    fraction = 1 - int(failing.sum()) / pixels
    return ZTest(p_values, alpha, failing, fraction, fraction >= REQUIRED)


def _alpha(pixels: int) -> float:
    """Šidák's threshold of the p-value of one of so many pixels."""
    return -math.expm1(math.log1p(-SIGNIFICANCE) / pixels)


@dataclass
class PassMoments:
    """
    Passes of a render that were added up so far: the ``mean`` of all ``samples`` of a pixel, ``(height, width,
    channels)``, float64; ``squares``, the sum over the ``passes`` of their samples times their squared deviation from
    it.
    """

    mean: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0
    samples: int = 0
    passes: int = 0

    def add(self, image: np.ndarray, samples: int) -> None:
        """One more pass, of so many samples a pixel."""
        self.samples, self.passes = self.samples + samples, self.passes + 1
        deviation = image - self.mean  # West's recurrence: no difference of large numbers
        self.mean = self.mean + deviation / (self.samples / samples)
        self.squares = self.squares + samples * (deviation * (image - self.mean))

    @property
    def variance(self) -> np.ndarray:
        """The variance of one sample, found from the scatter of the passes."""
        return self.squares / max(self.passes - 1, 1)


def render_with_variance(
    scene,
    spp: int,
    seed: int = 0,
    passes: int = REFERENCE_PASSES,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
    moments: PassMoments | None = None,
) -> tuple[np.ndarray, np.ndarray, int]:
    """
    Render ``passes`` (at least 2) independent images of ``spp / passes`` samples a pixel, rounded up to a power of two:
    then no pixel is shared by two threads, which would add up its samples in any order, and the same arguments give the
    same bits. ``moments`` holds passes that were rendered before with the same seed: only what is missing is rendered,
    and added to them.

    Returns their mean and the variance of one sample (that of the passes, times the samples of a pass), both
    ``(height, width, channels)``, float32, with 3 channels or 1, and the samples per pixel that were taken.
    ``on_pass()`` is called after each pass; once ``stop`` is set, the pass that is running is the last.

    The scatter of passes, rather than Mitsuba's ``moment`` integrator: that one squares each sample, so it knows XYZ
    only, gives spectral and RGB variants different meanings of a channel, accepts no integrator that is not a
    ``SamplingIntegrator``, and overestimates the noise of stratified samplers. The price is a relative error of
    sqrt(2 / passes) of the variance, 12% for 128 passes. Raises :class:`~mi_diffind.scenes.SceneError`.
    """
    if passes < 2:
        raise ValueError(f"passes: found {passes}, at least 2 are needed")
    moments = PassMoments() if moments is None else moments
    n = _samples_of_a_pass(spp, passes)
    for _ in range(_missing(moments, spp, passes)):
        moments.add(_colour(scenes.render_pass(scene, n, (seed << 16) + _REFERENCE_SEEDS + moments.passes)), n)
        if on_pass is not None:
            on_pass()
        if stop is not None and stop.is_set():
            break
    return np.float32(moments.mean), np.float32(moments.variance), moments.samples


def _samples_of_a_pass(spp: int, passes: int) -> int:
    return 1 << (-(-spp // passes) - 1).bit_length()


def _missing(moments: PassMoments, spp: int, passes: int) -> int:
    """Passes that are still to be rendered."""
    n = _samples_of_a_pass(spp, passes)
    return max(0, passes - moments.samples // n)


# -- will a new reference pass its own check? --------------------------------------------------------------------------


def probe(
    scene,
    spp: int,
    seed: int = 0,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> float:
    """
    The part of the pixels that would fail a check at ``spp`` samples a pixel although nothing has changed, 0 to 1.

    It is tried out, with the samples a pixel of a check and of its reference, on an image of fewer pixels that see more
    of the scene each: four million samples altogether, unless 256 pixels need more. Of 34 passes, each pair in turn is
    the check, and the others are its reference. Once ``stop`` is set, the pass that is running is the last, and the
    result is not a number. Raises :class:`~mi_diffind.scenes.SceneError`, also for pixels that are not finite.
    """
    n = max(1, spp // 2)
    pixels = math.prod(map(int, scene.sensors()[0].film().crop_size()))
    size = min(max(PROBE_SAMPLES // (n * PROBE_PASSES), PROBE_PIXELS[0]), PROBE_PIXELS[1])
    images = []
    with _smaller(scene, size):
        for i in range(PROBE_PASSES):
            images.append(_colour(scenes.render_pass(scene, n, (seed << 16) + _PROBE_SEEDS + i)))
            if on_pass is not None:
                on_pass()
            if stop is not None and stop.is_set():
                return math.nan
    images = np.stack(images)
    bad = int((~np.isfinite(images)).any(axis=(0, -1)).sum())
    if bad:
        size = f"{images.shape[2]} x {images.shape[1]}"
        raise scenes.SceneError(f"{bad} pixel(s) are not finite in a probe of {size}, so this cannot be a reference")
    threshold, parts = statistics.NormalDist().inv_cdf(1 - _alpha(pixels) / 2), []
    for i in range(0, PROBE_PASSES, 2):
        check, others = images[i : i + 2].mean(axis=0), np.delete(images, (i, i + 1), axis=0)
        variance = np.maximum(n * others.var(axis=0, ddof=1), VARIANCE_FLOOR)
        spread = np.sqrt(variance * (1 / (2 * n) + 1 / (n * len(others))))
        parts.append(float((np.abs(check - others.mean(axis=0)) > threshold * spread).any(axis=-1).mean()))
    return statistics.fmean(parts)


def _probe(scene, spp: int, seed: int, path, progress: bool, stop: threading.Event) -> float:
    """A probe with its bar."""
    with _bar(f"{Path(path).stem}: probe at {spp} spp", PROBE_PASSES, progress) as bar, scenes.scene_errors(path):
        return probe(scene, spp, seed, bar.update, stop)


def _advice(scene, spp: int, seed: int, path, progress: bool, stop: threading.Event) -> str:
    """How many samples would do, if ``spp`` are too few, found by trying; or that 16 times as many would not."""
    for factor in _FACTORS:
        failing = _probe(scene, factor * spp, seed, path, progress, stop)
        if failing <= 1 - REQUIRED:
            return f"--spp {factor * spp} should do, or fewer bounces (the scene's max_depth)"
        if stop.is_set():
            return "more samples (--spp) or fewer bounces (the scene's max_depth) are needed"
    return f"not even {factor} times the samples would do: give fewer bounces (the scene's max_depth)"


@contextlib.contextmanager
def _smaller(scene, pixels: int):
    """Give the scene's film the same shape with at most so many pixels, if it can be given another size."""
    sensor = scene.sensors()[0]
    width, height = (int(v) for v in sensor.film().size())
    scale = min(1.0, math.sqrt(pixels / (width * height)))
    size = max(1, int(width * scale)), max(1, int(height * scale))
    with compat.film_size(sensor, *size) if scale < 1 else contextlib.nullcontext():
        yield


# -- references --------------------------------------------------------------------------------------------------------


def reference_path(path: str | os.PathLike, references: str | os.PathLike | None = None) -> Path:
    """Where the reference of a scene file in this variant is kept: ``references/SCENE.VARIANT.exr`` beside it."""
    folder = Path(path).parent / "references" if references is None else Path(references)
    return folder / f"{Path(path).stem}.{mi.variant()}.exr"


def read_reference(path: str | os.PathLike, references: str | os.PathLike | None = None) -> Reference:
    """
    The stored reference of a scene file in the current variant, or in its twin for the other backend (``llvm_…`` for
    ``cuda_…``), since they render the same. Raises :class:`BadReference`.
    """
    wanted = reference_path(path, references)
    backend, _, mode = mi.variant().partition("_")
    twins = [wanted.with_name(f"{Path(path).stem}.{b}_{mode}.exr") for b in ("llvm", "cuda") if b != backend]
    found = next((file for file in (wanted, *twins) if file.is_file()), None)
    if found is None:
        raise BadReference(f'{path}: has no reference "{wanted}"; run the same command with --update to make it')
    reference = _read(found)
    about = reference.about
    if (about["scene"], f"{about['scene']}.{about['variant']}.exr") != (Path(path).stem, found.name):
        raise BadReference(f'{found}: is the reference of the scene "{about["scene"]}" in {about["variant"]}')
    return reference


def update_reference(
    path: str | os.PathLike,
    references: str | os.PathLike | None = None,
    spp: int | None = None,
    seed: int | None = None,
    progress: bool = True,
    defines: dict[str, str] | None = None,
) -> dict:
    """
    Render a reference of the scene file ``path`` in the current variant and store it (:func:`reference_path`), in one
    piece; ``spp`` are the samples per pixel that a check will take, and the reference gets 16 times as many or more.

    The reference is checked once against another render; one that fails though nothing has changed is not stored. That
    is found out early: a probe (:func:`probe`) of a few seconds estimates how many pixels will fail, and a scene that
    has no chance is refused, with the samples that would do, found by further probes. What was rendered is kept in a
    file ``SCENE.VARIANT.partial.npz`` beside the reference after Ctrl-C, and after a check that fails nevertheless: the
    same command, also with another ``spp``, goes on from there, unless the scene, its files, or this package have
    changed.

    What is not given is as in the reference that is being replaced: ``spp`` (else two million samples of the image),
    ``seed`` (else 0) and each of ``defines``, which replace the scene's ``<default>`` values. If the scene's filter is
    a box, the same arguments give the same bytes on the same machine, whether interrupted in between or not; not so if
    passes were rendered with another ``spp``.

    Returns ``scene``, ``reference`` (the file), ``variant``, ``width``, ``height``, ``budget``, ``spp``, ``seed``,
    ``defines``, ``seconds``, ``bytes``, ``failing_pixels`` and ``fraction`` (of pixels that pass) of that check,
    ``expected_fraction`` (what the probe expected, ``None`` without one), ``reused_spp`` (of ``spp``, those that had
    been kept), and ``interrupted``: after Ctrl-C no reference has been written, and ``partial`` is the file that keeps
    what there is (else ``None``). Raises :class:`~mi_diffind.scenes.SceneError` and
    :class:`~mi_diffind.files.OutputError`.
    """
    output = reference_path(path, references)
    before = read_reference(path, references).about if output.is_file() else {}
    defines = {**before.get("defines", {}), **{k: str(v) for k, v in (defines or {}).items()}}
    scene = scenes.load(path, defines=defines)
    writable_folder(output.parent, create=True)
    writable_file(output)
    width, height = (int(v) for v in scene.sensors()[0].film().crop_size())
    budget = spp or before.get("budget") or max(1, BUDGET // (width * height))
    seed = before.get("seed", 0) if seed is None else seed
    partial = output.with_suffix(".partial.npz")
    key = {"scene": Path(path).stem, "variant": mi.variant(), "defines": defines, "seed": seed}
    key["sources"] = _fingerprint(path, defines)
    moments = _read_partial(partial, key)
    start, reused = time.perf_counter(), moments.samples
    result = {
        "scene": str(path),
        "reference": str(output),
        "variant": mi.variant(),
        "width": width,
        "height": height,
        "budget": budget,
        "spp": reused,
        "reused_spp": reused,
        "seed": seed,
        "defines": defines,
        "expected_fraction": None,
        "partial": None,
    }
    with interruptible() as stop:
        trying = (scene, budget, seed, path, progress, stop)
        failing = _probe(*trying)
        if not stop.is_set():
            result["expected_fraction"] = 1 - failing
            if failing > _HOPELESS * (1 - REQUIRED) + _CHANCE / (width * height):
                raise scenes.SceneError(
                    f"{path}: would fail the check at {budget} samples a pixel although nothing has changed (about "
                    f"{failing:.2%} of the pixels, {1 - REQUIRED:.2%} may), since bright paths are too rare; "
                    f"{_advice(*trying)}"
                )
            missing = _missing(moments, REFERENCE_FACTOR * budget, REFERENCE_PASSES)
            with _bar(f"{Path(path).stem}: reference", missing, progress) as bar:
                image, variance, result["spp"] = render_with_variance(
                    scene, REFERENCE_FACTOR * budget, seed, REFERENCE_PASSES, bar.update, stop, moments
                )
            bad = int((~np.isfinite(image + variance)).any(axis=-1).sum())
            if bad:
                raise scenes.SceneError(f"{path}: {bad} pixel(s) are not finite, so this cannot be a reference")
        if not stop.is_set():
            passes = _passes(scene, budget)
            with _bar(f"{Path(path).stem}: check", passes, progress) as bar:
                again = _colour(scenes.render(scene, budget, _OWN_CHECK, passes, bar.update, stop)[0])
        result |= {"seconds": time.perf_counter() - start, "interrupted": stop.is_set()}
        if stop.is_set():
            if moments.passes:
                _write_partial(partial, moments, key)
                result["partial"] = str(partial)
            return result
        test = z_test(again, image, variance, budget, moments.samples)
        result |= {"failing_pixels": int(test.failing.sum()), "fraction": test.fraction}
        if not test.passed:
            _write_partial(partial, moments, key)
            raise scenes.SceneError(
                f"{path}: fails the check at {budget} samples a pixel although nothing has changed "
                f"({result['failing_pixels']} of {test.failing.size} pixels, {1 - REQUIRED:.2%} may), since bright "
                f'paths are too rare; {_advice(*trying)}; what was rendered is kept in "{partial}", and the same '
                "command goes on from there"
            )
    about = {
        "scene": Path(path).stem,
        "variant": mi.variant(),
        "defines": defines,
        "budget": budget,
        "spp": moments.samples,
        "seed": seed,
        "versions": {"mi_diffind": __version__, "mitsuba": mi.__version__},
    }
    _write(output, Reference(image, variance, about))
    partial.unlink(missing_ok=True)
    return {**result, "bytes": output.stat().st_size}


def _fingerprint(path, defines: dict[str, str]) -> str:
    """What a render depends on: the files that the scene consists of, this package with its tables, Mitsuba."""
    package = Path(__file__).resolve().parent
    folders = {package, *map(Path, plugins.__path__)}
    files = {file for folder in folders for kind in ("*.py", "*.npz") for file in folder.rglob(kind)}
    digest = hashlib.sha256(mi.__version__.encode())
    for file in sorted(files | set(scenes.files_of(path, defines))):
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()


def _write_partial(path: Path, moments: PassMoments, key: dict) -> None:
    about = json.dumps({**key, "samples": moments.samples, "passes": moments.passes}).encode()
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, mean=moments.mean, squares=moments.squares, about=np.frombuffer(about, np.uint8))


def _read_partial(path: Path, key: dict) -> PassMoments:
    """What was kept of the same render; nothing if there is none, or it is damaged."""
    with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as data:
        about = json.loads(data["about"].tobytes())
        moments = PassMoments(data["mean"], data["squares"], about.pop("samples"), about.pop("passes"))
        if about == key and np.isfinite(moments.mean + moments.squares).all():
            return moments
    return PassMoments()


def regress(
    path: str | os.PathLike,
    references: str | os.PathLike | None = None,
    out: str | os.PathLike | None = None,
    spp: int | None = None,
    seed: int = 0,
    progress: bool = True,
    defines: dict[str, str] | None = None,
) -> dict:
    """
    Render the scene file ``path`` in the current variant and hold it against its reference (:func:`z_test`).

    ``spp`` and ``defines`` are the reference's unless given. Every ``seed`` is independent of the reference. If the
    check fails and ``out`` names a folder, the result is written there (:func:`write_failure`).

    Returns ``scene``, ``reference`` (the file's name), ``variant``, ``width``, ``height``, ``spp``, ``reference_spp``,
    ``seed``, ``passed``, ``failing_pixels``, ``fraction`` (of pixels that pass), ``smallest_p``, ``alpha``,
    ``defines``, ``seconds``, ``files`` (what was written) and ``interrupted``: after Ctrl-C there is no verdict, and
    ``passed`` is ``None``. Raises :class:`~mi_diffind.scenes.SceneError`, among them :class:`BadReference`, and
    :class:`~mi_diffind.files.OutputError`.
    """
    reference = read_reference(path, references)
    about = reference.about
    defines = {**about["defines"], **{k: str(v) for k, v in (defines or {}).items()}}
    scene = scenes.load(path, defines=defines)
    width, height = (int(v) for v in scene.sensors()[0].film().crop_size())
    _same_size(path, reference, height, width)
    spp = spp or about["budget"]
    passes = _passes(scene, spp)
    start = time.perf_counter()
    with interruptible() as stop, _bar(Path(path).stem, passes, progress) as bar:
        image, _ = scenes.render(scene, spp, seed, passes, bar.update, stop)
    image = _colour(image)
    result = {
        "scene": str(path),
        "reference": f"{about['scene']}.{about['variant']}.exr",
        "variant": mi.variant(),
        "width": width,
        "height": height,
        "spp": spp,
        "reference_spp": about["spp"],
        "seed": seed,
        "defines": defines,
        "seconds": time.perf_counter() - start,
        "interrupted": stop.is_set(),
        "passed": None,
        "files": {},
    }
    if result["interrupted"]:
        return result
    _same_size(path, reference, *image.shape)
    test = z_test(image, reference.image, reference.variance, spp, about["spp"])
    result |= {
        "passed": test.passed,
        "failing_pixels": int(test.failing.sum()),
        "fraction": test.fraction,
        "smallest_p": float(test.p_values.min()),
        "alpha": test.alpha,
    }
    if not test.passed and out is not None:
        result["files"] = write_failure(out, image, reference, test, result)
    return result


def write_failure(
    folder: str | os.PathLike, image: np.ndarray, reference: Reference, test: ZTest, result: dict
) -> dict[str, str]:
    """
    Write what a failed check saw into ``folder``, which is made if its parent exists: ``SCENE.VARIANT.image.exr``,
    ``….reference.exr``, ``….error.exr`` (absolute difference), ``….p_value.exr`` and a picture of all, ``….png``.
    Returns the paths. Raises :class:`~mi_diffind.files.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    stem = f"{Path(result['scene']).stem}.{result['variant']}"
    images = {
        "image": image,
        "reference": reference.image,
        "error": np.abs(image - reference.image),
        "p_value": test.p_values,
    }
    paths = {}
    for name, content in images.items():
        paths[name] = str(folder / f"{stem}.{name}.exr")
        scenes.write_image(paths[name], content)
    paths["figure"] = str(folder / f"{stem}.png")
    _figure(paths["figure"], images, test, result)
    return paths


def verdict(result: dict) -> str:
    """What :func:`regress` returned, in one word: ``passed``, ``FAILED`` or ``interrupted``."""
    return "interrupted" if result["interrupted"] else "passed" if result["passed"] else "FAILED"


def summary(results: list[dict]) -> list[str]:
    """A table of what :func:`regress` returned: a line for each scene, and for each that failed where to look."""
    names = [Path(r["scene"]).stem for r in results]
    width = max((len(n) for n in names), default=0)
    lines = []
    for name, r in zip(names, results, strict=True):
        line = f"{verdict(r):11} {name:{width}}  {r['variant']}, {r['width']} x {r['height']}, {r['spp']} spp"
        if not r["interrupted"]:
            line += (
                f": {r['failing_pixels']} of {r['width'] * r['height']} pixels fail, smallest p {r['smallest_p']:.1e}"
            )
        lines.append(line)
        if r["files"]:
            lines.append(f"{'':11} {'':{width}}  see {r['files']['figure']}")
    return lines


def _figure(path: str, images: dict[str, np.ndarray], test: ZTest, result: dict) -> None:
    """Image, reference and numbers above; error, p-values and failing pixels below."""
    error = np.nan_to_num(images["error"].mean(axis=-1))
    top = max(float(np.quantile(error, 0.995)), 1e-6)
    exponent = np.log10(np.maximum(test.p_values.min(axis=-1), 1e-300))
    threshold = math.log10(test.alpha)
    marked = np.repeat(np.clip(images["reference"], 0, 1).mean(axis=-1, keepdims=True) * 0.3, 3, axis=-1)
    marked[test.failing] = (1, 0.1, 0.6)
    lines = [
        f"scene       {Path(result['scene']).name}, {result['width']} x {result['height']}",
        f"variant     {result['variant']}",
        f"samples     {result['spp']} a pixel, seed {result['seed']}",
        f"reference   {result['reference_spp']} samples a pixel",
        "",
        f"{verdict(result):11} {100 * result['fraction']:.2f}% of the pixels pass, {100 * REQUIRED}% have to",
        f"failing     {result['failing_pixels']} pixels",
        f"threshold   p = {test.alpha:.2e}, smallest found {result['smallest_p']:.2e}",
    ]
    cells = [
        figure_grid.picture("image", images["image"]),
        figure_grid.picture("reference", images["reference"]),
        figure_grid.text(lines),
        figure_grid.colour_map(
            "absolute difference, mean of the channels (linear)", error, "max", cmap="magma", vmin=0, vmax=top
        ),
        figure_grid.colour_map(
            f"log10 of p, smallest of the channels (threshold {threshold:.1f})",
            exponent,
            "min",
            cmap="magma_r",
            vmin=3 * threshold,
            vmax=0,
        ),
        figure_grid.picture("failing pixels, over the reference", marked),
    ]
    figure_grid.write(path, cells, 3, error.shape)


def _colour(image: np.ndarray) -> np.ndarray:
    """Without alpha and other channels that are not colour."""
    return image[..., : 3 if image.shape[-1] >= 3 else 1]


def _passes(scene, spp: int) -> int:
    width, height = (int(v) for v in scene.sensors()[0].film().crop_size())
    return min(spp, -(-spp * width * height // _PASS))


def _same_size(path, reference: Reference, height: int, width: int, channels: int | None = None) -> None:
    expected = reference.image.shape
    if (height, width, expected[2] if channels is None else channels) != expected:
        found = f"{width} x {height} pixels" + ("" if channels is None else f" of {channels} channel(s)")
        raise BadReference(
            f"{path}: renders {found}, its reference has {expected[1]} x {expected[0]} of {expected[2]} channel(s); "
            "leave the size to the reference, or render it again with --update"
        )


def _bar(title: str, passes: int, progress: bool) -> tqdm:
    return tqdm(total=passes, desc=title, unit="pass", disable=None if progress else True)


def _channels(count: int) -> Iterator[str]:
    return iter("RGB" if count == 3 else "Y")


def _write(path: Path, reference: Reference) -> None:
    import OpenEXR

    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        _ATTRIBUTE: json.dumps(reference.about, sort_keys=True),
    }
    channels = {}
    for i, name in enumerate(_channels(reference.image.shape[-1])):
        channels[name] = np.ascontiguousarray(reference.image[..., i])
        channels[f"variance.{name}"] = np.ascontiguousarray(reference.variance[..., i])
    with replacing(path) as temporary:
        try:
            with OpenEXR.File(header, channels) as file:
                file.write(str(temporary))
        except RuntimeError as e:
            raise OutputError(f'reference "{path}" cannot be written: {e}') from None


def _read(path: Path) -> Reference:
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            # copies: closing the file empties its dictionaries
            header, channels = dict(file.header()), {k: v.pixels.copy() for k, v in file.channels().items()}
    except (RuntimeError, ValueError) as e:
        raise BadReference(f"{path}: cannot be read as an EXR image; {_REMEDY}") from e
    try:
        about = json.loads(header[_ATTRIBUTE])
        good = all(isinstance(about[key], kind) for key, kind in _ABOUT.items())
        names = list(_channels(3 if "R" in channels else 1))
        image, variance = (
            np.stack([channels[prefix + name] for name in names], -1).astype(np.float32) for prefix in ("", "variance.")
        )
    except (KeyError, TypeError, ValueError) as e:
        raise BadReference(f"{path}: is an EXR image, but no reference; {_REMEDY}") from e
    if not (good and about["budget"] > 0 and about["spp"] > 0 and np.isfinite(image + variance).all()):
        raise BadReference(f"{path}: is a damaged reference; {_REMEDY}")
    return Reference(image, variance, about)
