"""Films: frames as H.264, WebP or GIF."""

import importlib.util
import os
import subprocess
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from ..core.errors import UsageError, missing_package
from ..core.files import OutputError, replacing, shown
from . import srgb

#: Extensions of films.
FILMS = (".mp4", ".webp", ".gif")

#: Quality of H.264: constant rate factor of x264, from 0 (lossless) to 51 (worst).
CRF = 18

#: Quality of WebP, from 0 to 100 (best).
WEBP_QUALITY = 85


def check_encoder(path: str | os.PathLike) -> None:
    """Refuse a film that cannot be encoded here. Raises :class:`.UsageError`."""
    if Path(path).suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UsageError(f'output "{shown(path)}": H.264 needs {missing_package("imageio-ffmpeg")}')


def displayed(image: np.ndarray) -> np.ndarray:
    """Return a linear image as displayed: bytes ``(height, width, 3)``, 4 channels for one with alpha (2 or 4)."""
    channels = image.shape[2]
    has_alpha = channels in (2, 4)
    colours, alpha = (image[..., :-1], image[..., -1:]) if has_alpha else (image, np.ones_like(image[..., :1]))
    if colours.shape[2] == 1:
        colours = colours.repeat(3, axis=2)
    encoded = srgb.for_display(colours[..., :3] / np.maximum(alpha, 1e-6))
    if has_alpha:
        encoded = np.concatenate([encoded, np.clip(alpha, 0, 1)], axis=-1)
    return np.round(255 * encoded).astype(np.uint8)


def over_black(image: np.ndarray) -> np.ndarray:
    """Return a linear image, premultiplied by its alpha if it has any, as displayed in front of black, 3 channels."""
    return displayed(image[..., :-1] if image.shape[2] in (2, 4) else image)


def write(
    path: str | os.PathLike, frames: Sequence[np.ndarray], seconds: float = 4.0, quality: float | None = None
) -> None:
    """Write a film of bytes, each frame ``(height, width, 3)`` or with alpha 4 channels, that lasts ``seconds``.

    ``.webp`` and ``.gif`` begin again at their end and keep alpha. ``.mp4`` is H.264, whose frames have 3 channels; an
    odd width or height is extended by a copy of the last column or row, which H.264 needs. ``quality``: that of WebP
    (default :data:`WEBP_QUALITY`) or the constant rate factor of H.264 (:data:`CRF`). The same frames give the same
    bytes with the same version of the encoder.

    Raises :class:`.UsageError` for other frames or without an encoder, and
    :class:`.OutputError`.
    """
    path = Path(path)
    check_encoder(path)
    check_frames(frames, (3,) if path.suffix.lower() == ".mp4" else (3, 4))
    with replacing(path) as temporary:
        if path.suffix.lower() == ".mp4":
            _write_h264(path, temporary, frames, seconds, CRF if quality is None else quality)
            return
        from PIL import Image

        images = [Image.fromarray(frame) for frame in frames]
        options = {"disposal": 2}
        if path.suffix.lower() == ".webp":
            options = {"quality": WEBP_QUALITY if quality is None else quality, "method": 4}
        duration = round(1000 * seconds / len(frames))
        images[0].save(temporary, save_all=True, append_images=images[1:], loop=0, duration=duration, **options)


def check_frames(frames: Sequence[np.ndarray], channels: tuple[int, ...]) -> None:
    """Refuse frames that are not bytes of one size, with one of the numbers of ``channels``."""
    if not len(frames):
        raise UsageError("frames: found none, a film needs one or more")
    first = frames[0].shape
    for i, frame in enumerate(frames):
        if frame.dtype != np.uint8 or len(first) != 3 or first[2] not in channels or frame.shape != first:
            allowed = f"(height, width, {' or '.join(map(str, channels))}), one size for all"
            raise UsageError(f"frames: found {frame.dtype} {frame.shape} as number {i}, allowed are uint8 {allowed}")


def _write_h264(path: Path, temporary: Path, frames: Sequence[np.ndarray], seconds: float, crf: float) -> None:
    """Encode frames by x264 on one thread, since its bytes depend on the number of threads."""
    from imageio_ffmpeg import get_ffmpeg_exe

    height, width, _ = frames[0].shape
    odd = (0, height % 2), (0, width % 2), (0, 0)
    frames = [np.pad(frame, odd, mode="edge") for frame in frames]  # H.264 needs even sizes
    height, width, _ = frames[0].shape
    rate = Fraction(len(frames)) / Fraction(seconds).limit_denominator(1000)
    command = [
        get_ffmpeg_exe(), "-y", "-loglevel", "error",
        "-f", "rawvideo", "-pixel_format", "rgb24", "-video_size", f"{width}x{height}", "-framerate", str(rate),
        "-i", "-",
        "-vf", "scale=out_color_matrix=bt709:out_range=tv:flags=accurate_rnd+full_chroma_int,"
        "setparams=color_primaries=bt709:color_trc=iec61966-2-1",
        "-c:v", "libx264", "-preset", "slow", "-crf", f"{crf:g}", "-pix_fmt", "yuv420p", "-threads", "1",
        "-fflags", "+bitexact", "-flags:v", "+bitexact", "-map_metadata", "-1", "-movflags", "+faststart",
        os.path.abspath(temporary),  # "http:film.mp4" would be an address
    ]  # fmt: skip
    raw = b"".join(np.ascontiguousarray(frame).tobytes() for frame in frames)
    encoder = subprocess.run(command, input=raw, capture_output=True, check=False)
    if encoder.returncode:
        lines = encoder.stderr.decode(errors="replace").strip().splitlines()
        why = lines[-1] if lines else f"ffmpeg ended with {encoder.returncode}"
        raise OutputError(f'output file "{shown(path)}" cannot be written: {why}')
