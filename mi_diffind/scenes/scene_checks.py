"""Checks of parsed and loaded scenes, and of their pictures: one sentence for what cannot be rendered."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import plugins
from ..core import compat, tensor_files, units
from ..core.errors import DiffindError
from ..images import metrics

#: Parts that a scene needs to be rendered, beside objects and lights.
NEEDS = ("integrator", "sensor")

#: Bytes of memory of a channel of a pixel while a pass is rendered: of the film, the developed image, its copy in
#: single precision, and sums in double precision.
PIXEL_BYTES = 3 * 4 + 2 * 8


class SceneError(DiffindError, RuntimeError):
    """A scene cannot be loaded or rendered; the message is one sentence that names the file and the fault."""


def check_renderable(scene, path: str | os.PathLike = "scene", needs: tuple[str, ...] = NEEDS) -> None:
    """Raise :class:`SceneError` if a loaded scene lacks what it ``needs`` to be rendered."""
    for name in needs:
        if not (scene.integrator() if name == "integrator" else scene.sensors()):
            example = {"integrator": "path", "sensor": "perspective"}[name]
            raise SceneError(f'{path}: has no {name}, one is needed, such as <{name} type="{example}">')


def check_size(scene, spp: int, size: tuple[int, int] | None = None) -> None:
    """Refuse a picture that takes more memory than this machine has, or too many samples per pixel.

    ``size`` is its width and height, by default that of the first sensor's film. Raises
    :class:`.UsageError`.
    """
    width, height = size or map(int, scene.sensors()[0].film().crop_size())
    channels = scene.sensors()[0].film().base_channels_count()
    units.check_memory("film", f"{width:,} x {height:,} pixels", width * height * channels * PIXEL_BYTES)
    units.check_samples(spp)


def warn_of_black(scene, path: str | os.PathLike, images) -> None:
    """Warn if all ``images`` of a loaded scene are black."""
    if not any(image[..., :3].any() for image in images):
        plugins.warn(f"{path}: the picture is black{'' if scene.emitters() else ', the scene has no emitter'}")


def check_finite(image: np.ndarray, name: str) -> None:
    """Raise :class:`SceneError` if pixels of the image ``name`` are NaN or infinite."""
    if count := metrics.nonfinite_pixels(image):
        raise SceneError(f"{name}: {count:,} of {image.shape[0] * image.shape[1]:,} pixels are not finite")


def use_slashes(state) -> None:
    """Write names of files in a parsed scene with slashes where they have backslashes, and only that is a file."""
    copies = compat.properties_of(compat.copy_parsed(state)[1])  # a parameter that was read counts as known
    for props, copy in zip(compat.properties_of(state), copies, strict=True):
        for key in copy:
            text = str(copy[key]) if compat.property_kind(copy, key) == "text" else ""
            if "\\" in text and not _is_file(text) and _is_file(text.replace("\\", "/")):
                props[key] = text.replace("\\", "/")


def _is_file(name: str) -> bool:
    """Return whether a name is that of a file, as Mitsuba resolves it."""
    with contextlib.suppress(OSError, ValueError):
        return Path(str(mi.file_resolver().resolve(name))).is_file()
    return False


def check_measured(state) -> None:
    """Refuse damaged files of measured materials that a parsed scene names. Raises UsageError."""
    for props in compat.properties_of(state):
        if props.plugin_name() in ("measured", "measured_polarized") and "filename" in props:
            path = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
            if path.is_file():
                tensor_files.check(path, tensor_files.read(path))
