"""Stored renderings of scenes: the EXR files that :mod:`.regression` checks against, and partial renders of them.

A reference is kept beside its scene, as ``references/SCENE.VARIANT.exr``, an EXR file of two parts. The first is the
image in half floats (``R``, ``G``, ``B``, or ``Y`` in mono variants), with the settings of the render in its header.
The second has the means of blocks of 4 × 4 pixels: of 16 single passes (``pass00.R``, …) and of all 128 (``mean.R``).
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.archives import Archive
from ..core.files import OutputError, replacing
from . import loading
from .block_test import CHECK_PASSES, GROUPS, REFERENCE_PASSES, BlockReference, block_means

_ATTRIBUTE = "mi_diffind"
_REMEDY = "remove it and make it again with --update"
_ABOUT = {"scene": str, "variant": str, "defines": dict, "budget": int, "spp": int, "seed": int}
#: Largest half float.
_LARGEST = 65504.0


class BadReference(loading.SceneError):
    """A stored reference is missing, damaged, or of another size; the message is one sentence that names it."""


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

    ``llvm_…`` and ``cuda_…`` variants render the same. Raises :class:`BadReference`.
    """
    wanted = reference_path(path, references)
    backend, _, mode = mi.variant().partition("_")
    twins = [wanted.with_name(f"{Path(path).stem}.{b}_{mode}.exr") for b in ("llvm", "cuda") if b != backend]
    stored = next((file for file in (wanted, *twins) if file.is_file()), None)
    if stored is None:
        raise BadReference(f'{path}: has no reference "{wanted}"; run the same command with --update to make it')
    parts = _parts(stored)
    about = _about(stored, Path(path).stem, parts)
    if len(parts) != 2:
        raise BadReference(f"{stored}: is a reference of an earlier version, render it again with --update")
    return _reference(stored, about, *(channels for _, channels in parts))


def read_settings(path: str | os.PathLike, references: str | os.PathLike | None = None) -> dict:
    """Return ``about`` of a scene's reference in this variant, also of earlier versions; nothing if there is none."""
    stored = reference_path(path, references)
    return _about(stored, Path(path).stem, _parts(stored)) if stored.is_file() else {}


def _channels(count: int) -> str:
    return "RGB" if count == 3 else "Y"


def write_reference(path: Path, reference: Reference) -> None:
    """Write a reference in one piece. Raises :class:`.OutputError`."""
    import OpenEXR

    def part(title: str, values: dict[str, np.ndarray], dtype: type, **attributes) -> OpenEXR.Part:
        height, width, count = next(iter(values.values())).shape
        channels = {
            prefix + name: np.ascontiguousarray(value[..., i], dtype)
            for prefix, value in values.items() for i, name in enumerate(_channels(count))
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
    with replacing(path) as temporary:
        try:
            with OpenEXR.File(parts) as file:
                file.write(str(temporary))
        except RuntimeError as e:
            raise OutputError(f'reference "{path}" cannot be written: {e}') from None


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
        raise BadReference(f"{path}: cannot be read as an EXR image; {_REMEDY}") from e


def _about(path: Path, stem: str, parts: list[tuple[dict, dict]]) -> dict:
    try:
        about = json.loads(parts[0][0][_ATTRIBUTE])
        good = all(isinstance(about[key], expected) for key, expected in _ABOUT.items())
    except (KeyError, TypeError, ValueError) as e:
        raise BadReference(f"{path}: is an EXR image, but no reference; {_REMEDY}") from e
    if not (good and about["budget"] > 0 and about["spp"] > 0):
        raise BadReference(f"{path}: is a damaged reference; {_REMEDY}")
    if (about["scene"], f"{about['scene']}.{about['variant']}.exr") != (stem, path.name):
        raise BadReference(f'{path}: is the reference of the scene "{about["scene"]}" in {about["variant"]}')
    return about


def _reference(path: Path, about: dict, image: dict, means: dict) -> Reference:
    try:
        names = _channels(3 if "R" in image else 1)
        pixels = np.stack([image[name] for name in names], axis=-1)
        passes = np.stack(
            [np.stack([means[f"pass{i:02}.{name}"] for name in names], -1) for i in range(REFERENCE_PASSES)]
        ).astype(np.float64)
        mean = np.stack([means[f"mean.{name}"] for name in names], axis=-1).astype(np.float64)
        stops = np.array(about.pop("stops"), np.float64)
        change = about["visible_change"]
        good = (
            stops.shape == (GROUPS,)
            and (change is None or isinstance(change, float))
            and mean.shape == passes[0].shape == block_means(pixels).shape
        )
    except (KeyError, TypeError, ValueError):
        good = False
    if not (good and all(np.isfinite(values).all() for values in (pixels, passes, mean, stops))):
        raise BadReference(f"{path}: is a damaged reference; {_REMEDY}")
    return Reference(pixels, BlockReference(passes, mean, stops, *pixels.shape[:2]), about)


@dataclass
class PassSums:
    """Passes of a reference that is being rendered: the sum of the images, and the ``blocks`` of each pass."""

    image: np.ndarray | float = 0.0
    blocks: list[np.ndarray] = field(default_factory=list)

    def add(self, image: np.ndarray) -> None:
        """Add the next pass."""
        self.image = self.image + image
        self.blocks.append(block_means(image).astype(np.float32))

    def reference(self, about: dict) -> Reference:
        """Return the reference of all passes, with its ``visible_change``, ``None`` for infinity, in ``about``."""
        image = np.float32(self.image / len(self.blocks))
        passes = np.stack(self.blocks).astype(np.float64)
        groups = passes.reshape(-1, CHECK_PASSES, *passes.shape[1:])
        blocks = BlockReference.from_groups(passes[:REFERENCE_PASSES], groups.mean(axis=1), *image.shape[:2])
        change = blocks.visible_change(groups[REFERENCE_PASSES // CHECK_PASSES :])
        return Reference(image, blocks, {**about, "visible_change": change if math.isfinite(change) else None})


def write_partial(path: Path, sums: PassSums, key: dict) -> None:
    """Keep the passes of an unfinished reference, with a ``key`` (JSON) of all that the render depends on."""
    about = np.frombuffer(json.dumps(key).encode(), np.uint8)
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, image=sums.image, blocks=np.stack(sums.blocks), about=about)


def read_partial(path: Path, key: dict) -> PassSums:
    """Return the kept passes of the render with the same ``key``; none if missing or damaged."""
    with contextlib.suppress(Exception), Archive(path) as archive:
        image, blocks = archive.array("image").copy(), archive.array("blocks")
        if archive.json("about") == key and np.isfinite(image).all() and np.isfinite(blocks).all():
            return PassSums(image, list(blocks))
    return PassSums()
