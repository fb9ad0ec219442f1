"""Regression checks of scenes against stored renderings: changes that sampling noise does not explain.

A reference shows the scene as written, learned plugins included. A check finds changes; the distance of an
approximation from the truth is measured by :mod:`.comparison`. Statistics: :mod:`.z_test`; files:
:mod:`.reference_files`.
"""

from __future__ import annotations

import contextlib
import math
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import __version__, compat, scenes
from .errors import UsageError
from .files import writable_file, writable_folder
from .interrupt import interruptible
from .measure import figure_grid
from .measure.store import fingerprint, sources
from .progress import progress_bar
from .reference_files import (
    BadReference,
    Reference,
    read_partial,
    read_reference,
    reference_path,
    write_partial,
    write_reference,
)
from .runtime import use_variant
from .z_test import REQUIRED, VARIANCE_FLOOR, PassMoments, ZTest, pixel_threshold, z_test

#: Samples of the whole image in a check, by default.
BUDGET = 2_000_000
#: A reference has at least this many times the samples of a check …
REFERENCE_FACTOR = 16
#: … in this many independent passes, whose scatter gives its variance.
REFERENCE_PASSES = 128

#: Passes of a probe, which predicts within seconds whether a reference will pass its own check. Each pair of passes of
#: a smaller image is checked against all others, with as many samples a pixel as check and reference will have.
PROBE_PASSES = 2 * (1 + REFERENCE_FACTOR)
#: Samples of all passes of a probe together, about …
PROBE_SAMPLES = 1 << 22
#: … and the range of its number of pixels.
PROBE_PIXELS = (256, 1 << 14)
#: A scene is refused if a probe predicts more than this many times the failing pixels that are allowed, and this many
#: pixels of the image more; a smaller excess is too close to call.
_HOPELESS, _CHANCE = 2, 3
#: Factors of the samples that are tried in search of a sufficient number.
_FACTORS = (2, 4, 8, 16)

#: Of Mitsuba's seeds ``(seed << 16) + i``, checks use those with ``i`` below, references those from here on.
_REFERENCE_SEEDS = 1 << 15
#: Samples of the whole image in one pass of a check, a bound of its memory.
_PASS = 1 << 22
#: First seed of the passes of a probe.
_PROBE_SEEDS = (1 << 16) - PROBE_PASSES
#: Seed of the check that a new reference has to pass.
_OWN_CHECK = (1 << 16) - 1


def render_with_variance(
    scene,
    spp: int,
    seed: int = 0,
    passes: int = REFERENCE_PASSES,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
    moments: PassMoments | None = None,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Render ``passes`` (at least 2) independent images, and return mean, variance and number of samples.

    A pass has ``spp / passes`` samples a pixel, rounded up to a power of two: then no pixel is shared by two threads,
    which would add up its samples in any order, and the same arguments give the same bits. ``moments`` holds passes
    that were rendered before with the same seed: only the missing ones are rendered, and added to them.

    Returns the mean of the passes and the variance of one sample (the variance of the passes, times the samples of a
    pass), both ``(height, width, channels)``, float32, with 3 channels or 1, and the samples per pixel.
    ``on_pass()`` is called after each pass; once ``stop`` is set, the running pass is the last.

    Mitsuba's ``moment`` integrator is no alternative: it squares each sample, so it returns XYZ only, gives spectral
    and RGB variants different meanings of a channel, accepts no integrator that is not a ``SamplingIntegrator``, and
    overestimates the noise of stratified samplers. The price of passes is a relative error of sqrt(2 / passes) of the
    variance, 12% for 128 passes. Raises :class:`~mi_diffind.scenes.SceneError`.
    """
    if passes < 2:
        raise ValueError(f"passes: found {passes}, at least 2 are needed")
    moments = PassMoments() if moments is None else moments
    n = _samples_of_a_pass(spp, passes)
    for _ in range(passes - moments.samples // n):
        image = scenes.render_pass(scene, n, (seed << 16) + _REFERENCE_SEEDS + moments.passes)
        moments.add(scenes.colour_channels(image), n)
        if on_pass is not None:
            on_pass()
        if stop is not None and stop.is_set():
            break
    return np.float32(moments.mean), np.float32(moments.variance), moments.samples


def _samples_of_a_pass(spp: int, passes: int) -> int:
    return 1 << (-(-spp // passes) - 1).bit_length()


def probe(
    scene,
    spp: int,
    seed: int = 0,
    on_pass: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
    samples: int = PROBE_SAMPLES,
) -> float:
    """Return the part of the pixels, 0 to 1, that would fail a check at ``spp`` samples a pixel if nothing has changed.

    The estimate comes from an image of fewer pixels that each see more of the scene, with the samples a pixel of a
    check and of its reference: ``samples`` altogether, unless 256 pixels need more. Of 34 passes, each pair in turn is
    the check, and the others are its reference. Once ``stop`` is set, the running pass is the last, and the result is
    not a number. Raises :class:`~mi_diffind.scenes.SceneError`, also for pixels that are not finite.
    """
    n = max(1, spp // 2)
    pixels = math.prod(scenes.film_size(scene))
    size = min(max(samples // (n * PROBE_PASSES), PROBE_PIXELS[0]), PROBE_PIXELS[1])
    images = []
    with _smaller(scene, size):
        for i in range(PROBE_PASSES):
            image = scenes.render_pass(scene, n, (seed << 16) + _PROBE_SEEDS + i)
            images.append(scenes.colour_channels(image))
            if on_pass is not None:
                on_pass()
            if stop is not None and stop.is_set():
                return math.nan
    images = np.stack(images)
    bad = int((~np.isfinite(images)).any(axis=(0, -1)).sum())
    if bad:
        size = f"{images.shape[2]} x {images.shape[1]}"
        raise scenes.SceneError(f"{bad} pixel(s) are not finite in a probe of {size}, so this cannot be a reference")
    threshold, parts = statistics.NormalDist().inv_cdf(1 - pixel_threshold(pixels) / 2), []
    for i in range(0, PROBE_PASSES, 2):
        check, others = images[i : i + 2].mean(axis=0), np.delete(images, (i, i + 1), axis=0)
        variance = np.maximum(n * others.var(axis=0, ddof=1), VARIANCE_FLOOR)
        deviation = np.sqrt(variance * (1 / (2 * n) + 1 / (n * len(others))))
        parts.append(float((np.abs(check - others.mean(axis=0)) > threshold * deviation).any(axis=-1).mean()))
    return statistics.fmean(parts)


@contextlib.contextmanager
def _smaller(scene, pixels: int):
    """Give the scene's film the same shape with at most so many pixels, if its size can be changed."""
    sensor = scene.sensors()[0]
    width, height = (int(v) for v in sensor.film().size())
    scale = min(1.0, math.sqrt(pixels / (width * height)))
    size = max(1, int(width * scale)), max(1, int(height * scale))
    with compat.film_size(sensor, *size) if scale < 1 else contextlib.nullcontext():
        yield


def update_reference(
    path: str | os.PathLike,
    references: str | os.PathLike | None = None,
    spp: int | None = None,
    seed: int | None = None,
    progress: bool = True,
    defines: dict[str, str] | None = None,
    probe_samples: int = PROBE_SAMPLES,
    source: str | os.PathLike | dict | mi.Scene | None = None,
) -> dict:
    """Render a reference of the scene file ``path`` in the current variant and store it (:func:`reference_path`).

    Of a scene in memory, ``source``, the path is a name.

    ``spp`` are the samples per pixel of a check; the reference gets 16 times as many or more. Settings that are not
    given are those of the reference that is replaced: ``spp`` (else two million samples of the image), ``seed`` (else
    0) and each of ``defines``, which replace the scene's ``<default>`` values. If the scene's filter is a box, the same
    arguments give the same bytes on the same machine, interrupted or not, unless some passes were rendered with another
    ``spp``.

    The reference is checked once against another render; one that fails although nothing has changed is not stored.
    A probe (:func:`probe`) of a few seconds, of ``probe_samples``, predicts this check: a scene without a chance is
    refused at once, with the number of samples that would suffice, found by further probes. Rendered passes are kept in
    a file ``SCENE.VARIANT.partial.npz`` beside the reference after Ctrl-C, and after a check that fails nevertheless:
    the same command, also with another ``spp``, continues from there, unless the scene, its files, or this package have
    changed.

    Returns ``scene``, ``reference`` (the file), ``variant``, ``width``, ``height``, ``budget``, ``spp``, ``seed``,
    ``defines``, ``seconds``, ``bytes``, ``failing_pixels`` and ``fraction`` (of pixels that pass) of that check,
    ``expected_fraction`` (predicted by the probe, ``None`` without one), ``reused_spp`` (samples of ``spp`` that had
    been kept), and ``interrupted``: after Ctrl-C no reference has been written, and ``partial`` is the file of kept
    passes (else ``None``). Raises :class:`~mi_diffind.scenes.SceneError` and :class:`~mi_diffind.files.OutputError`.
    """
    output, stem = reference_path(path, references), Path(path).stem
    before = read_reference(path, references).about if output.is_file() else {}
    parsed = _parsed(path if source is None else source, {**before.get("defines", {}), **(defines or {})})
    scene = parsed.load()
    writable_folder(output.parent, create=True)
    writable_file(output)
    width, height = scenes.film_size(scene)
    budget = spp or before.get("budget") or max(1, BUDGET // (width * height))
    seed = before.get("seed", 0) if seed is None else seed
    partial = output.with_suffix(".partial.npz")
    key = {"scene": stem, "variant": mi.variant(), "defines": parsed.defines, "seed": seed}
    key["sources"] = fingerprint(sources() | set(parsed.files())) + mi.__version__ + parsed.description
    moments = read_partial(partial, key)
    start, wanted = time.perf_counter(), REFERENCE_FACTOR * budget
    result = {
        **_facts(path, str(output), width, height, seed, parsed.defines),
        "budget": budget, "spp": moments.samples, "reused_spp": moments.samples, "expected_fraction": None,
        "partial": None,
    }  # fmt: skip

    with interruptible() as stop:

        def failing_part(spp: int) -> float:
            title = f"{stem}: probe at {spp} spp"
            with progress_bar(title, PROBE_PASSES, progress=progress) as bar, scenes.scene_errors(path):
                return probe(scene, spp, seed, bar.update, stop, probe_samples)

        def refusal(verdict: str, failing: str, more: str = "") -> scenes.SceneError:
            return scenes.SceneError(
                f"{path}: {verdict} the check at {budget} samples a pixel although nothing has changed ({failing}, "
                f"{1 - REQUIRED:.2%} may): bright paths are too rare; {_advice(budget, failing_part, stop)}{more}"
            )

        failing = failing_part(budget)
        if not stop.is_set():
            result["expected_fraction"] = 1 - failing
            if failing > _HOPELESS * (1 - REQUIRED) + _CHANCE / (width * height):
                raise refusal("would fail", f"about {failing:.2%} of the pixels")
            missing = REFERENCE_PASSES - moments.samples // _samples_of_a_pass(wanted, REFERENCE_PASSES)
            with progress_bar(f"{stem}: reference", max(0, missing), progress=progress) as bar:
                image, variance, result["spp"] = render_with_variance(
                    scene, wanted, seed, REFERENCE_PASSES, bar.update, stop, moments
                )
            bad = int((~np.isfinite(image + variance)).any(axis=-1).sum())
            if bad:
                raise scenes.SceneError(f"{path}: {bad} pixel(s) are not finite, so this cannot be a reference")
        if not stop.is_set():
            again = _render_check(scene, budget, _OWN_CHECK, f"{stem}: check", progress, stop)
        result |= {"seconds": time.perf_counter() - start, "interrupted": stop.is_set()}
        if stop.is_set():
            if moments.passes:
                write_partial(partial, moments, key)
                result["partial"] = str(partial)
            return result
        test = z_test(again, image, variance, budget, moments.samples)
        result |= {"failing_pixels": int(test.failing.sum()), "fraction": test.fraction}
        if not test.passed:
            write_partial(partial, moments, key)
            kept = f"; the same command continues from {partial.name} beside the reference"
            raise refusal("fails", f"{result['failing_pixels']} of {test.failing.size} pixels", kept)
    del key["sources"]
    versions = {"mi_diffind": __version__, "mitsuba": mi.__version__}
    about = {**key, "budget": budget, "spp": moments.samples, "versions": versions}
    write_reference(output, Reference(image, variance, about))
    partial.unlink(missing_ok=True)
    return {**result, "bytes": output.stat().st_size}


def _parsed(scene, defines: dict) -> scenes.ParsedScene:
    """Return a scene file or a dictionary parsed, or a loaded scene in their place."""
    if not isinstance(scene, mi.Scene):
        return scenes.ParsedScene(scene, defines)
    if defines:
        raise UsageError("defines: given with a scene in memory, allowed are scene files")
    return scenes.LoadedScene(scene)


def _advice(spp: int, failing_part: Callable[[int], float], stop: threading.Event) -> str:
    """Return a sentence on how many samples would suffice where ``spp`` do not, found by further probes."""
    for factor in _FACTORS:
        failing = failing_part(factor * spp)
        if failing <= 1 - REQUIRED:
            return f"--spp {factor * spp} should do, or a lower max_depth"
        if stop.is_set():
            return "more samples (--spp) or a lower max_depth are needed"
    return f"not even {factor} times the samples would do: give a lower max_depth"


def _render_check(scene, spp: int, seed: int, title: str, progress: bool, stop: threading.Event) -> np.ndarray:
    """Render the image of a check, in passes of bounded memory."""
    width, height = scenes.film_size(scene)
    passes = min(spp, -(-spp * width * height // _PASS))
    with progress_bar(title, passes, progress=progress) as bar:
        return scenes.colour_channels(scenes.render(scene, spp, seed, passes, bar.update, stop)[0])


def _facts(path, reference: str, width: int, height: int, seed: int, defines: dict) -> dict:
    """Return the entries that the results of a check and of an update share."""
    return {
        "scene": str(path), "reference": reference, "variant": mi.variant(), "width": width, "height": height,
        "seed": seed, "defines": defines,
    }  # fmt: skip


@dataclass
class Regression:
    """Result of :func:`regress`: its ``figures``, and ``images``, linear ``(height, width, channels)``.

    The images of a check are ``image``, ``reference``, ``error`` (absolute difference) and ``p_value``; of an
    interrupted check, or of an update of a reference, there are none.
    """

    figures: dict
    images: dict[str, np.ndarray] = field(default_factory=dict, repr=False)
    test: ZTest | None = None

    @property
    def passed(self) -> bool | None:
        """Whether the check passed; ``None`` without a verdict."""
        return self.figures.get("passed")

    def __str__(self) -> str:
        return "\n".join(update_summary(self.figures) if "budget" in self.figures else summary([self.figures]))

    def _repr_png_(self) -> bytes | None:
        if self.test is None:
            return None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "check.png"
            _write_figure(str(path), self.images, self.test, self.figures)
            return path.read_bytes()


def regress(
    scene: str | os.PathLike | dict | mi.Scene,
    *,
    name: str | None = None,
    update: bool = False,
    references: str | os.PathLike | None = None,
    out: str | os.PathLike | None = None,
    spp: int | None = None,
    seed: int | None = None,
    defines: Mapping[str, object] | None = None,
    progress: bool = True,
) -> Regression:
    """Render the ``scene`` in the variant that is set and test it against its reference (:func:`.z_test.z_test`).

    The scene is a file, a dictionary as of ``mi.load_dict``, or a loaded ``mi.Scene``. A scene in memory needs a
    ``name`` for its reference, ``references/NAME.VARIANT.exr`` in the current folder, and has no ``defines``.
    ``spp`` and ``defines`` are the reference's unless given, ``seed`` is 0; every seed is independent of the reference.
    If the check fails and ``out`` names a folder, the images are written there (:func:`write_failure`). With
    ``update``, the reference is rendered again instead and stored (:func:`update_reference`).

    The figures are ``scene``, ``reference`` (the file's name), ``variant``, ``width``, ``height``, ``spp``,
    ``reference_spp``, ``seed``, ``passed``, ``failing_pixels``, ``fraction`` (of pixels that pass), ``smallest_p``,
    ``alpha``, ``defines``, ``seconds``, ``files`` (written paths) and ``interrupted``: after Ctrl-C there is no
    verdict, and ``passed`` is ``None``. Raises :class:`~mi_diffind.scenes.SceneError`, among them
    :class:`BadReference`, :class:`~mi_diffind.errors.UsageError` and :class:`~mi_diffind.files.OutputError`.
    """
    use_variant()
    seed_of_check, path = seed or 0, scene
    if not isinstance(scene, (str, os.PathLike)):
        if not name:
            raise UsageError("name: not given, a scene in memory needs one, after which its reference is called")
        path = f"{name}.xml"
    if update:
        return Regression(update_reference(path, references, spp, seed, progress, dict(defines or {}), source=scene))
    reference = read_reference(path, references)
    about = reference.about
    parsed = _parsed(scene, {**about["defines"], **(defines or {})})
    loaded = parsed.load()
    width, height = scenes.film_size(loaded)
    _check_size(path, reference, height, width)
    spp, start = spp or about["budget"], time.perf_counter()
    with interruptible() as stop:
        image = _render_check(loaded, spp, seed_of_check, Path(path).stem, progress, stop)
    result = {
        **_facts(path, f"{about['scene']}.{about['variant']}.exr", width, height, seed_of_check, parsed.defines),
        "spp": spp, "reference_spp": about["spp"], "seconds": time.perf_counter() - start,
        "interrupted": stop.is_set(), "passed": None, "files": {},
    }  # fmt: skip
    if result["interrupted"]:
        return Regression(result)
    _check_size(path, reference, *image.shape)
    test = z_test(image, reference.image, reference.variance, spp, about["spp"])
    result |= {
        "passed": test.passed, "failing_pixels": int(test.failing.sum()), "fraction": test.fraction,
        "smallest_p": float(test.p_values.min()), "alpha": test.alpha,
    }  # fmt: skip
    if not test.passed and out is not None:
        result["files"] = write_failure(out, image, reference, test, result)
    return Regression(result, _images(image, reference, test), test)


def _images(image: np.ndarray, reference: Reference, test: ZTest) -> dict[str, np.ndarray]:
    error = np.abs(image - reference.image)
    return {"image": image, "reference": reference.image, "error": error, "p_value": test.p_values}


def _check_size(path, reference: Reference, height: int, width: int, channels: int | None = None) -> None:
    expected = reference.image.shape
    if (height, width, expected[2] if channels is None else channels) != expected:
        rendered = f"{width} x {height} pixels" + ("" if channels is None else f" of {channels} channel(s)")
        raise BadReference(
            f"{path}: renders {rendered}, its reference has {expected[1]} x {expected[0]} of {expected[2]} channel(s); "
            "leave the size to the reference, or render it again with --update"
        )


def write_failure(
    folder: str | os.PathLike, image: np.ndarray, reference: Reference, test: ZTest, result: dict
) -> dict[str, str]:
    """Write the images of a failed check into ``folder``, which is created if its parent exists, and return the paths.

    These are ``SCENE.VARIANT.image.exr``, ``….reference.exr``, ``….error.exr`` (absolute difference),
    ``….p_value.exr`` and a picture of all, ``….png``. Raises :class:`~mi_diffind.files.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    stem = f"{Path(result['scene']).stem}.{result['variant']}"
    images = _images(image, reference, test)
    paths = {name: str(folder / f"{stem}.{name}.exr") for name in images}
    for name, content in images.items():
        scenes.write_image(paths[name], content)
    paths["figure"] = str(folder / f"{stem}.png")
    _write_figure(paths["figure"], images, test, result)
    return paths


def verdict(result: dict) -> str:
    """Return the outcome of :func:`regress` in one word: ``passed``, ``FAILED`` or ``interrupted``."""
    return "interrupted" if result["interrupted"] else "passed" if result["passed"] else "FAILED"


def summary(results: list[dict]) -> list[str]:
    """Return the results of :func:`regress` as lines of text: one for each scene, and the picture of each failure."""
    names = [Path(r["scene"]).stem for r in results]
    width = max((len(n) for n in names), default=0)
    lines = []
    for name, r in zip(names, results, strict=True):
        line = f"{verdict(r):11} {name:{width}}  {r['variant']}, {r['width']} x {r['height']}, {r['spp']} spp"
        if not r["interrupted"]:
            pixels = r["width"] * r["height"]
            line += f": {r['failing_pixels']} of {pixels} pixels fail, smallest p {r['smallest_p']:.1e}"
        lines.append(line)
        if r["files"]:
            lines.append(f"{'':11} {'':{width}}  see {r['files']['figure']}")
    return lines


def update_summary(result: dict) -> list[str]:
    """Return the result of :func:`update_reference` as lines of text."""
    if result["interrupted"]:
        text = "{partial}: {spp} samples a pixel are kept, the same command goes on"
        return [text.format(**result)] if result["partial"] else []
    text = "{reference}: {width} x {height}, {spp} spp, {bytes:,} bytes; "
    return [(text + "failing pixels in a check at {budget} spp: {failing_pixels}").format(**result)]


def _write_figure(path: str, images: dict[str, np.ndarray], test: ZTest, result: dict) -> None:
    """Write one picture: image, reference and figures above; error, p-values and failing pixels below."""
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
    title = f"log10 of p, smallest of the channels (threshold {threshold:.1f})"
    cells = [
        figure_grid.picture("image", images["image"]),
        figure_grid.picture("reference", images["reference"]),
        figure_grid.text(lines),
        figure_grid.error_map(np.nan_to_num(images["error"].mean(axis=-1))),
        figure_grid.colour_map(title, exponent, "min", cmap="magma_r", vmin=3 * threshold, vmax=0),
        figure_grid.picture("failing pixels, over the reference", marked),
    ]
    figure_grid.write(path, cells, 3, exponent.shape)
