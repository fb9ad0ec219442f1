"""Stored renderings of scenes: the EXR files that :mod:`.regression` checks against, and partial renders of them.

A reference is kept beside its scene, as ``references/SCENE.VARIANT.exr``: the image (``R``, ``G``, ``B``, or ``Y`` in
mono variants), the variance of one sample (``variance.R``, …), and a header attribute with the settings of the render.
"""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import scenes
from .archives import Archive
from .files import OutputError, replacing
from .z_test import PassMoments

_ATTRIBUTE = "mi_diffind"
_REMEDY = "remove it and make it again with --update"
_ABOUT = {"scene": str, "variant": str, "defines": dict, "budget": int, "spp": int, "seed": int}


class BadReference(scenes.SceneError):
    """A stored reference is missing, damaged, or of another size; the message is one sentence that names it."""


@dataclass(frozen=True)
class Reference:
    """A stored rendering: ``image`` and the ``variance`` of one sample, both ``(height, width, channels)``, float32.

    Values are linear, of 3 channels (red, green, blue) or 1 (mono variants). ``about`` holds ``scene`` (file name
    without its extension), ``variant``, ``defines`` (texts for the scene's ``<default>`` values), ``budget`` (samples
    per pixel of a check), ``spp`` (samples per pixel of the reference), ``seed``, and the ``versions`` of mi_diffind
    and Mitsuba that rendered it.
    """

    image: np.ndarray
    variance: np.ndarray
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
    reference = _read(stored)
    about = reference.about
    if (about["scene"], f"{about['scene']}.{about['variant']}.exr") != (Path(path).stem, stored.name):
        raise BadReference(f'{stored}: is the reference of the scene "{about["scene"]}" in {about["variant"]}')
    return reference


def _channels(count: int) -> str:
    return "RGB" if count == 3 else "Y"


def write_reference(path: Path, reference: Reference) -> None:
    """Write a reference in one piece. Raises :class:`~mi_diffind.files.OutputError`."""
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
        good = all(isinstance(about[key], expected) for key, expected in _ABOUT.items())
        image, variance = (
            np.stack([channels[prefix + name] for name in _channels(3 if "R" in channels else 1)], -1).astype(
                np.float32
            )
            for prefix in ("", "variance.")
        )
    except (KeyError, TypeError, ValueError) as e:
        raise BadReference(f"{path}: is an EXR image, but no reference; {_REMEDY}") from e
    if not (good and about["budget"] > 0 and about["spp"] > 0 and np.isfinite(image + variance).all()):
        raise BadReference(f"{path}: is a damaged reference; {_REMEDY}")
    return Reference(image, variance, about)


def write_partial(path: Path, moments: PassMoments, key: dict) -> None:
    """Keep the passes of an unfinished reference, with a ``key`` (JSON) of all that the render depends on."""
    about = json.dumps({**key, "samples": moments.samples, "passes": moments.passes}).encode()
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, mean=moments.mean, squares=moments.squares, about=np.frombuffer(about, np.uint8))


def read_partial(path: Path, key: dict) -> PassMoments:
    """Return the kept passes of the render with the same ``key``; none if missing or damaged."""
    with contextlib.suppress(Exception), Archive(path) as archive:
        about = archive.json("about")
        sums = archive.array("mean"), archive.array("squares")
        moments = PassMoments(*sums, about.pop("samples"), about.pop("passes"))
        if about == key and np.isfinite(moments.mean + moments.squares).all():
            return moments
    return PassMoments()
