"""Regression checks of scenes against stored renderings: changes that sampling noise does not explain.

A reference shows the scene as written, learned plugins included. A check finds changes; the distance of an
approximation from the truth is measured by :mod:`.comparison`. Statistics: :mod:`.block_test`.

A reference is kept beside its scene, as ``references/SCENE.VARIANT.exr``, an EXR file of two parts. The first is the
image in half floats (``R``, ``G``, ``B``, or ``Y`` in mono variants), with the settings of the render in its header.
The second has the means of blocks of 4 × 4 pixels: of 16 single passes (``pass00.R``, …) and of all 128 (``mean.R``).
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import tempfile
import textwrap
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np

from .. import __version__
from ..core.archives import Archive
from ..core.errors import UsageError, raised_as
from ..core.files import OutputError, replacing, writable_file, writable_folder
from ..core.progress import interruptible, progress_bar
from ..core.runtime import use_variant
from ..measure import plot as figure_grid
from ..measure.store import fingerprint, sources
from . import loading
from .block_test import (
    CHECK_PASSES,
    GROUPS,
    REFERENCE_PASSES,
    TILE,
    Block,
    BlockReference,
    BlockTest,
    Level,
    block_means,
)

#: Samples of the whole image in a check, by default at most, but at least one a pixel in each pass.
BUDGET = 2_000_000

#: Passes that a reference is rendered from.
PASSES = CHECK_PASSES * GROUPS

#: Samples of the whole image in one render, a bound of its memory; a pass of more is several renders.
_RENDER = 1 << 22

#: Seeds of one pass, and so the largest number of its renders. Of Mitsuba's seeds ``(seed << 16) + i``, the passes of
#: checks use those with ``i`` below :data:`PASSES` times this number, references those from there on.
_SEEDS = 1 << 8

#: Seeds of the check that a new reference has to pass, and of a second one, since one of a hundred fails by chance.
_OWN_CHECKS = ((1 << 16) - 1, (1 << 16) - 2)

#: Attribute of an EXR file that holds the settings of a reference, as JSON.
_ATTRIBUTE = "mi_diffind"

#: Settings of a reference, and their types.
_ABOUT = {"scene": str, "variant": str, "defines": dict, "budget": int, "spp": int, "seed": int}

#: Largest half float.
_LARGEST = 65504.0

_REMEDY = "remove it and make it again with --update"


# -- files ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reference:
    """A stored rendering: its ``image``, ``(height, width, channels)``, and its ``blocks``, for the test of a check.

    Values are linear, of 3 channels (red, green, blue) or 1 (mono variants); the image is for pictures, rounded to half
    floats. ``about`` holds ``scene`` (file name without its extension), ``variant``, ``defines`` (texts for the scene's
    ``<default>`` values), ``budget`` (samples per pixel of a check), ``spp`` (samples per pixel of the reference),
    ``seed``, ``visible_change`` (of :meth:`.block_test.BlockReference.visible_change`, ``None`` for infinity), and the
    ``versions`` of mi_diffind and Mitsuba that rendered it.
    """

    image: np.ndarray
    blocks: BlockReference
    about: dict


def reference_path(path: str | os.PathLike, references: str | os.PathLike | None = None) -> Path:
    """Return the file of a scene's reference in this variant: ``references/SCENE.VARIANT.exr`` beside the scene."""
    folder = Path(path).parent / "references" if references is None else Path(references)
    return folder / f"{Path(path).stem}.{mi.variant()}.exr"


def read_reference(path: str | os.PathLike, references: str | os.PathLike | None = None) -> Reference:
    """Return the stored reference of a scene file in the current variant, or in its twin for the other backend.

    ``llvm_…`` and ``cuda_…`` variants render the same. Raises :class:`.SceneError`.
    """
    wanted = reference_path(path, references)
    backend, _, mode = mi.variant().partition("_")
    twins = [wanted.with_name(f"{Path(path).stem}.{b}_{mode}.exr") for b in ("llvm", "cuda") if b != backend]
    stored = next((file for file in (wanted, *twins) if file.is_file()), None)
    if stored is None:
        raise loading.SceneError(f'{path}: has no reference "{wanted}"; run the same command with --update to make it')
    parts = _parts(stored)
    return _reference(stored, _about(stored, Path(path).stem, parts), parts[0][1], parts[-1][1])


def _names(channels: int) -> str:
    return "RGB" if channels == 3 else "Y"


def write_reference(path: Path, reference: Reference) -> None:
    """Write a reference in one piece. Raises :class:`.OutputError`."""
    import OpenEXR

    def part(title: str, values: dict[str, np.ndarray], dtype: type, **attributes) -> OpenEXR.Part:
        height, width, count = next(iter(values.values())).shape
        channels = {
            prefix + name: np.ascontiguousarray(value[..., i], dtype)
            for prefix, value in values.items() for i, name in enumerate(_names(count))
        }  # fmt: skip
        windows = {"displayWindow": window(*reference.image.shape[:2]), "dataWindow": window(height, width)}
        form = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
        return OpenEXR.Part({**form, **windows, **attributes}, channels, title)

    def window(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(2, np.int32), np.array([width - 1, height - 1], np.int32)

    blocks, about = reference.blocks, {**reference.about, "stops": reference.blocks.stops.tolist()}
    means = {f"pass{i:02}.": values for i, values in enumerate(blocks.passes)} | {"mean.": blocks.mean}
    image = {"": np.clip(reference.image, -_LARGEST, _LARGEST)}
    parts = [
        part("image", image, np.float16, **{_ATTRIBUTE: json.dumps(about, sort_keys=True)}),
        part("blocks", means, np.float32),
    ]
    refused = raised_as(OutputError, RuntimeError, at=f'reference "{path}" cannot be written')
    with replacing(path) as temporary, refused, OpenEXR.File(parts) as file:
        file.write(str(temporary))


def _parts(path: Path) -> list[tuple[dict, dict]]:
    """Return the header and the channels of each part of an EXR file."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            # copies: closing the file empties its dictionaries
            return [
                (dict(part.header), {k: v.pixels.astype(np.float32) for k, v in part.channels.items()})
                for part in file.parts
            ]
    except (RuntimeError, ValueError) as e:
        raise loading.SceneError(f"{path}: cannot be read as an EXR image; {_REMEDY}") from e


def _about(path: Path, stem: str, parts: list[tuple[dict, dict]]) -> dict:
    try:
        about = json.loads(parts[0][0][_ATTRIBUTE])
        good = all(isinstance(about[key], expected) for key, expected in _ABOUT.items())
    except (KeyError, TypeError, ValueError) as e:
        raise loading.SceneError(f"{path}: is an EXR image, but no reference; {_REMEDY}") from e
    if not (good and about["budget"] > 0 and about["spp"] > 0):
        raise loading.SceneError(f"{path}: is a damaged reference; {_REMEDY}")
    if (about["scene"], f"{about['scene']}.{about['variant']}.exr") != (stem, path.name):
        raise loading.SceneError(f'{path}: is the reference of the scene "{about["scene"]}" in {about["variant"]}')
    return about


def _reference(path: Path, about: dict, image: dict, means: dict) -> Reference:
    """Return the reference of a file from its two parts, which are checked."""
    names = _names(3 if "R" in image else 1)

    def stack(channels: dict, prefix: str = "") -> np.ndarray:
        return np.stack([channels[prefix + name] for name in names], axis=-1)

    try:
        pixels, mean = stack(image), np.float64(stack(means, "mean."))
        passes = np.float64([stack(means, f"pass{i:02}.") for i in range(REFERENCE_PASSES)])
        stops, change = np.array(about.pop("stops"), np.float64), about["visible_change"]
        good = (
            stops.shape == (GROUPS,)
            and (change is None or isinstance(change, float))
            and mean.shape == passes[0].shape == block_means(pixels).shape
            and all(np.isfinite(values).all() for values in (pixels, passes, mean, stops))
        )
    except (KeyError, TypeError, ValueError):
        good = False
    if not good:
        raise loading.SceneError(f"{path}: is a damaged reference; {_REMEDY}")
    return Reference(pixels, BlockReference(passes, mean, stops, *pixels.shape[:2]), about)


# -- passes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PassSize:
    """Samples of a pass: ``renders`` of ``samples`` a pixel each, a number that the scene's sampler takes."""

    renders: int
    samples: int

    @classmethod
    def for_check(cls, scene, spp: int) -> PassSize:
        """Return the size of one of the eight passes of a check of at least ``spp`` samples a pixel.

        Samplers such as ``stratified`` and ``multijitter`` round the samples of each render up.
        """
        samples, sampler = -(-spp // CHECK_PASSES), scene.sensors()[0].sampler()
        renders = min(-(-samples * math.prod(loading.film_size(scene)) // _RENDER), samples, _SEEDS)
        sampler.set_sample_count(-(-samples // renders))
        return cls(renders, sampler.sample_count())

    @property
    def check_spp(self) -> int:
        """Samples per pixel of a check."""
        return CHECK_PASSES * self.renders * self.samples


def _passes(scene, size: PassSize, seed: int, numbers: range, bar, stop: threading.Event) -> Iterator[np.ndarray]:
    """Render passes of independent samples, ``(height, width, 3 or 1)``, until ``stop`` is set.

    The same arguments give the same bits if the film's filter is a box and the samples of a render are a power of two:
    then no pixel is shared by two threads, which would add up its samples in any order.
    """
    for number in numbers:
        first = (seed << 16) + number * _SEEDS
        images = (loading.render_pass(scene, size.samples, first + i) for i in range(size.renders))
        yield sum(map(loading.colour_channels, images)) / size.renders
        bar.update()
        if stop.is_set():
            return


def _render_check(
    scene, size: PassSize, seed: int, title: str, progress: bool, stop: threading.Event
) -> tuple[np.ndarray, np.ndarray, int] | None:
    """Render a check; return its mean image, its blocks and the number of pixels that are not finite in a pass.

    The blocks are ``(8, rows, columns, channels)``; those with such pixels are not finite. ``None`` after Ctrl-C.
    """
    image, blocks = 0, []
    with progress_bar(title, CHECK_PASSES, progress=progress) as bar, np.errstate(invalid="ignore", over="ignore"):
        for one in _passes(scene, size, seed, range(CHECK_PASSES), bar, stop):
            image = image + one / CHECK_PASSES
            blocks.append(block_means(one))
        image = np.float32(image)
    if stop.is_set():
        return None
    return image, np.stack(blocks), int((~np.isfinite(image)).any(axis=-1).sum())


def _from_passes(image: np.ndarray, blocks: list[np.ndarray], about: dict) -> Reference:
    """Return the reference of the sum of all passes and the blocks of each, with ``visible_change`` in ``about``."""
    image, passes = np.float32(image / len(blocks)), np.stack(blocks).astype(np.float64)
    groups = passes.reshape(-1, CHECK_PASSES, *passes.shape[1:])
    stored = BlockReference.from_groups(passes[:REFERENCE_PASSES], groups.mean(axis=1), *image.shape[:2])
    change = stored.visible_change(groups[REFERENCE_PASSES // CHECK_PASSES :])
    return Reference(image, stored, {**about, "visible_change": change if math.isfinite(change) else None})


def _read_partial(path: Path, key: dict) -> tuple[np.ndarray | float, list[np.ndarray]]:
    """Return the sum and the blocks of the kept passes of the render with the same ``key``; none if damaged."""
    with contextlib.suppress(Exception), Archive(path) as archive:
        image, blocks = archive.array("image").copy(), archive.array("blocks")
        if archive.json("about") == key and np.isfinite(image).all() and np.isfinite(blocks).all():
            return image, list(blocks)
    return 0.0, []


# -- checks and updates -----------------------------------------------------------------------------------------------


def _update_reference(
    scene, path, references, spp: int | None, seed: int | None, progress: bool, defines: dict
) -> dict:
    """Render a reference of a scene in the current variant, store it (:func:`reference_path`), and return the figures.

    The reference has 128 passes of the samples of those of a check. It is checked against another render: one that
    fails twice although nothing has changed is not stored. Passes that were rendered when Ctrl-C came are kept in
    ``SCENE.VARIANT.partial.npz`` beside the reference: the same command continues from there, unless the scene, its
    files, or this package have changed.
    """
    output, stem = reference_path(path, references), Path(path).stem
    before = _about(output, stem, _parts(output)) if output.is_file() else {}
    parsed = _parse(scene, {**before.get("defines", {}), **defines})
    scene = parsed.load()
    writable_folder(output.parent, create=True)
    writable_file(output)
    width, height = loading.film_size(scene)
    a_pass = max(1, BUDGET // (width * height * CHECK_PASSES))
    asked = spp or before.get("budget") or CHECK_PASSES << (a_pass.bit_length() - 1)
    size = PassSize.for_check(scene, asked)
    seed = before.get("seed", 0) if seed is None else seed
    partial = output.with_suffix(".partial.npz")
    about = {"scene": stem, "variant": mi.variant(), "defines": parsed.defines, "seed": seed, "budget": size.check_spp}
    key = about | {"sources": fingerprint(sources() | set(parsed.files())) + mi.__version__ + parsed.description}
    (total, blocks), start = _read_partial(partial, key), time.perf_counter()
    result = {
        **_facts(path, str(output), width, height, seed, parsed.defines), "budget": size.check_spp, "asked_spp": asked,
        "spp": size.check_spp * GROUPS, "reused_passes": len(blocks), "partial": None,
    }  # fmt: skip
    with interruptible() as stop:
        with progress_bar(f"{stem}: reference", PASSES, initial=len(blocks), progress=progress) as bar:
            for image in _passes(scene, size, seed, range(PASSES + len(blocks), 2 * PASSES), bar, stop):
                total = total + image
                blocks.append(block_means(image).astype(np.float32))
        bad = int((~np.isfinite(total)).any(axis=-1).sum())
        if bad:
            raise loading.SceneError(f"{path}: {bad} pixel(s) are not finite, so this cannot be a reference")
        passed = False
        if not stop.is_set():
            reference = _from_passes(total, blocks, about)
        for seed_of_check in () if stop.is_set() else _OWN_CHECKS:
            check = _render_check(scene, size, seed_of_check, f"{stem}: check", progress, stop)
            passed = check is not None and reference.blocks.test(*check[1:]).passed
            if passed or stop.is_set():
                break
    result |= {"seconds": time.perf_counter() - start, "interrupted": stop.is_set()}
    if stop.is_set():
        with replacing(partial) as temporary, open(temporary, "wb") as stream:
            about = np.frombuffer(json.dumps(key).encode(), np.uint8)
            np.savez(stream, image=total, blocks=np.stack(blocks), about=about)
        return {**result, "spp": len(blocks) * size.renders * size.samples, "partial": str(partial)}
    if not passed:
        raise loading.SceneError(
            f"{path}: fails two checks at {size.check_spp} samples a pixel although nothing has changed: bright paths "
            "are too rare, or passes of different seeds are not independent; give more samples (--spp) or a lower "
            "max_depth, or another sampler"
        )
    about = {**reference.about, "spp": result["spp"]}
    about["versions"] = {"mi_diffind": __version__, "mitsuba": mi.__version__}
    write_reference(output, dataclasses.replace(reference, about=about))
    partial.unlink(missing_ok=True)
    return {**result, "tile": TILE, "visible_change": about["visible_change"], "bytes": output.stat().st_size}


def _parse(scene, defines: dict) -> loading.ParsedScene | SimpleNamespace:
    """Return a scene file or a dictionary parsed, or a loaded scene in their place, of which no files are known."""
    if not isinstance(scene, mi.Scene):
        return loading.ParsedScene(scene, defines)
    if defines:
        raise UsageError("defines: given with a scene in memory, allowed are scene files")
    return SimpleNamespace(load=lambda: scene, files=list, defines={}, description=os.urandom(16).hex())


def _facts(path, reference: str, width: int, height: int, seed: int, defines: dict) -> dict:
    """Return the entries that the results of a check and of an update share."""
    return {
        "scene": str(path), "reference": reference, "variant": mi.variant(), "width": width, "height": height,
        "seed": seed, "defines": defines,
    }  # fmt: skip


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
    """Render the ``scene`` in the variant that is set and test it against its reference (:mod:`.block_test`).

    The scene is a file, a dictionary as of ``mi.load_dict``, or a loaded ``mi.Scene``. A scene in memory needs a
    ``name`` for its reference, ``references/NAME.VARIANT.exr`` in the current folder, and has no ``defines``.
    ``defines`` are the reference's unless given, ``seed`` is 0; every seed is independent of the reference. ``spp`` are
    the reference's; others are refused, since the noise of both sides must be equal. If the check fails and ``out``
    names a folder, the images are written there (:func:`write_failure`).

    With ``update``, the reference is rendered again instead and stored. Settings that are not given are then those of
    the reference that is replaced: ``spp`` of a check (else about two million samples of the image, a power of two per
    pixel), ``seed`` (else 0) and each of ``defines``. If the scene's filter is a box, and the samples are a power of
    two, the same arguments give the same bytes on the same machine, interrupted or not.

    Figures of both: ``scene``, ``reference`` (the file), ``variant``, ``width``, ``height``, ``seed``, ``defines``,
    ``seconds``, ``interrupted`` (no verdict, ``passed`` is ``None``), ``spp``, and ``visible_change``
    (:meth:`.block_test.BlockReference.visible_change`, ``None`` for infinity) of a ``tile``. Of a check:
    ``reference_spp``, ``passed``, ``blocks`` (number of them that were tested), ``failing_blocks``, ``worst``
    (:class:`.block_test.Block`), ``stops``, ``stops_threshold``, ``not_finite`` (pixels), and ``files`` (written
    paths). Of an update: ``budget`` (samples per pixel of a check, which a sampler may have rounded up from
    ``asked_spp``), ``bytes``, ``reused_passes``, and ``partial``, the file of kept passes after Ctrl-C. Raises
    :class:`.SceneError`, :class:`.UsageError` and :class:`.OutputError`.
    """
    use_variant()
    seed_of_check, path = seed or 0, scene
    if not isinstance(scene, (str, os.PathLike)):
        if not name:
            raise UsageError("name: not given, a scene in memory needs one, after which its reference is called")
        path = f"{name}.xml"
    if update:
        return Regression(_update_reference(scene, path, references, spp, seed, progress, dict(defines or {})))
    reference = read_reference(path, references)
    about = reference.about
    parsed = _parse(scene, {**about["defines"], **(defines or {})})
    loaded = parsed.load()
    width, height = loading.film_size(loaded)
    _check_size(path, reference, height, width)
    size, start = PassSize.for_check(loaded, spp or about["budget"]), time.perf_counter()
    if size.check_spp != about["budget"]:
        raise loading.SceneError(
            f"{path}: a check would have {size.check_spp} samples a pixel, its reference is for {about['budget']}: "
            f"keep --spp and the sampler, or render it again with --update --spp {size.check_spp}"
        )
    with interruptible() as stop:
        check = _render_check(loaded, size, seed_of_check, Path(path).stem, progress, stop)
    figures = {
        **_facts(path, f"{about['scene']}.{about['variant']}.exr", width, height, seed_of_check, parsed.defines),
        "spp": about["budget"], "reference_spp": about["spp"], "seconds": time.perf_counter() - start,
        "interrupted": stop.is_set(), "passed": None, "files": {}, "tile": TILE,
        "visible_change": about["visible_change"],
    }  # fmt: skip
    if check is None:
        return Regression(figures)
    image, *blocks = check
    _check_size(path, reference, *image.shape)
    test = reference.blocks.test(*blocks)
    figures |= {
        "passed": test.passed, "blocks": sum(level.failing.size for level in test.levels),
        "failing_blocks": test.failing_blocks, "worst": dataclasses.asdict(test.worst), "stops": test.stops,
        "stops_threshold": test.stops_threshold, "not_finite": test.not_finite,
    }  # fmt: skip
    result = Regression(figures, image, reference.image, test)
    if not test.passed and out is not None:
        figures["files"] = write_failure(out, result)
    return result


def _check_size(path, reference: Reference, height: int, width: int, channels: int | None = None) -> None:
    expected = reference.image.shape
    if (height, width, expected[2] if channels is None else channels) != expected:
        rendered = f"{width} x {height} pixels" + ("" if channels is None else f" of {channels} channel(s)")
        raise loading.SceneError(
            f"{path}: renders {rendered}, its reference has {expected[1]} x {expected[0]} of {expected[2]} channel(s); "
            "leave the size to the reference, or render it again with --update"
        )


# -- results as sentences, pictures and files -------------------------------------------------------------------------


@dataclass
class Regression:
    """Result of :func:`.regression.regress`: its ``figures``, and of a check ``image``, ``reference`` and ``test``.

    Images are linear ``(height, width, channels)``; an interrupted check and an update of a reference have none.
    """

    figures: dict
    image: np.ndarray | None = field(default=None, repr=False)
    reference: np.ndarray | None = field(default=None, repr=False)
    test: BlockTest | None = field(default=None, repr=False)

    @property
    def passed(self) -> bool | None:
        """Whether the check passed; ``None`` without a verdict."""
        return self.figures.get("passed")

    @property
    def images(self) -> dict[str, np.ndarray]:
        """The ``image``, the ``reference``, the ``error`` (absolute difference) and ``t`` of :func:`t_map`."""
        if self.test is None:
            return {}
        error = np.abs(self.image - self.reference)
        t = t_map(self.test.worst_level, self.image.shape)
        return {"image": self.image, "reference": self.reference, "error": error, "t": np.float32(t)}

    def __str__(self) -> str:
        return "\n".join(update_summary(self.figures) if "budget" in self.figures else summary([self.figures]))

    def _repr_png_(self) -> bytes | None:
        if self.test is None:
            return None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "check.png"
            _write_figure(str(path), self)
            return path.read_bytes()


def t_map(level: Level, shape: tuple[int, ...]) -> np.ndarray:
    """Return t of each pixel and channel, ``shape``: the largest amount of the windows that cover the pixel."""
    parts, t = level.side // level.stride, level.t
    rows, columns = (n + parts - 1 for n in t.shape[:2])
    cells = np.zeros((rows, columns, t.shape[2]))
    for row in range(parts):
        for column in range(parts):
            covered = cells[row : row + t.shape[0], column : column + t.shape[1]]
            np.copyto(covered, t, where=np.abs(t) > np.abs(covered))
    pixels = cells.repeat(level.stride, axis=0).repeat(level.stride, axis=1)
    return pixels[: shape[0], : shape[1]]


def write_failure(folder: str | os.PathLike, result: Regression) -> dict[str, str]:
    """Write the images of a failed check into ``folder``, which is created if its parent exists, and return the paths.

    These are ``SCENE.VARIANT.image.exr``, ``….reference.exr``, ``….error.exr`` (absolute difference), ``….t.exr`` and a
    picture of all, ``….png``. Raises :class:`.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    stem = f"{Path(result.figures['scene']).stem}.{result.figures['variant']}"
    images = result.images
    paths = {name: str(folder / f"{stem}.{name}.exr") for name in images}
    for name, content in images.items():
        loading.write_image(paths[name], content)
    paths["figure"] = str(folder / f"{stem}.png")
    _write_figure(paths["figure"], result)
    return paths


def verdict(figures: dict) -> str:
    """Return the outcome of a check in one word: ``passed``, ``FAILED`` or ``interrupted``."""
    return "interrupted" if figures["interrupted"] else "passed" if figures["passed"] else "FAILED"


def power(figures: dict) -> str:
    """Return the change that a check finds nine times of ten, as the end of a sentence."""
    width, height = (min(figures["tile"], figures[side]) for side in ("width", "height"))
    change = figures["visible_change"]
    amount = "no change" if change is None else f"{100 * change:.2g}%"
    return f"{amount} of brightness in a tile of {width} x {height} nine times of ten"


def reasons(figures: dict) -> list[str]:
    """Return the reasons for which a check failed, as parts of a sentence."""
    parts = []
    if figures["not_finite"]:
        parts.append(f"{figures['not_finite']} pixel(s) are not finite")
    if figures["failing_blocks"]:
        worst = figures["worst"]
        parts.append(f"block of {Block(**worst)}, t = {worst['t']:.1f}, {worst['channel']}")
    if figures["stops"] > figures["stops_threshold"]:
        measured, threshold = figures["stops"], figures["stops_threshold"]
        parts.append(f"off by {measured:.3g} stops on average, noise by {threshold:.3g} at most")
    return parts


def summary(results: list[dict]) -> list[str]:
    """Return the results of checks as lines of text: one for each scene, and the picture of each failure."""
    names = [Path(r["scene"]).stem for r in results]
    width = max((len(n) for n in names), default=0)
    lines = []
    for name, r in zip(names, results, strict=True):
        line = f"{verdict(r):11} {name:{width}}  {r['variant']}, {r['width']} x {r['height']}, {r['spp']} spp"
        if not r["interrupted"]:
            line += f": would have seen {power(r)}" if r["passed"] else f": {'; '.join(reasons(r))}"
        lines.append(line)
        if r["files"]:
            lines.append(f"{'':11} {'':{width}}  see {r['files']['figure']}")
    return lines


def update_summary(figures: dict) -> list[str]:
    """Return the result of :func:`.regression.update_reference` as lines of text."""
    if figures["interrupted"]:
        return ["{partial}: {spp} samples a pixel are kept, the same command goes on".format(**figures)]
    asked = "" if figures["asked_spp"] == figures["budget"] else f" (asked for {figures['asked_spp']})"
    text = "{reference}: {width} x {height}, {spp} spp, {bytes:,} bytes; a check has {budget} spp" + asked
    return [f"{text.format(**figures)} and would see {power(figures)}"]


def _wrap(title: str, text: str) -> list[str]:
    return textwrap.wrap(f"{title:11} {text}", 58, subsequent_indent=" " * 12)


def _write_figure(path: str, result: Regression) -> None:
    """Write one picture: image, reference and figures above; error, t and failing blocks below."""
    figures, images, test = result.figures, result.images, result.test
    worst, level = test.worst, test.worst_level
    marked = np.repeat(np.clip(images["reference"], 0, 1).mean(axis=-1, keepdims=True) * 0.3, 3, axis=-1)
    failing = (np.abs(images["t"]) > level.threshold) | ~np.isfinite(images["image"])
    marked[failing.any(axis=-1)] = (1, 0.1, 0.6)
    largest = np.abs(images["t"]).argmax(axis=-1)[..., None]
    lines = [
        f"scene       {Path(figures['scene']).name}, {figures['width']} x {figures['height']}",
        f"variant     {figures['variant']}",
        f"samples     {figures['spp']} a pixel in {CHECK_PASSES} passes, seed {figures['seed']}",
        f"reference   {figures['reference_spp']} samples a pixel",
        "",
        f"{verdict(figures):11} {figures['failing_blocks']} of {figures['blocks']} blocks of all sizes fail",
        *_wrap("", "; ".join(reasons(figures))),
        *_wrap("power", f"finds {power(figures)}"),
    ]
    blocks = f"blocks of {level.side} x {level.side}"
    frame = (worst.x, worst.y, worst.width, worst.height)
    cells = [
        figure_grid.picture("image", images["image"]),
        figure_grid.picture("reference", images["reference"], frame),
        figure_grid.text(lines),
        figure_grid.error_map(np.nan_to_num(images["error"].mean(axis=-1))),
        figure_grid.colour_map(
            f"t of {blocks}, red: brighter (threshold {level.threshold:.1f})",
            np.take_along_axis(images["t"], largest, axis=-1)[..., 0],
            "both", cmap="RdBu_r", vmin=-2 * level.threshold, vmax=2 * level.threshold,
        ),
        figure_grid.picture(f"{blocks} that fail, over the reference; frame: the worst", marked, frame),
    ]  # fmt: skip
    figure_grid.write(path, cells, 3, images["image"].shape)
