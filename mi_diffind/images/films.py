"""Films: frames as H.264, WebP or GIF, and panels with labels side by side."""

from __future__ import annotations

import importlib.util
import os
import subprocess
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from ..core.errors import UsageError, missing_package
from ..core.files import OutputError, replacing, shown
from . import srgb

#: Extensions of films.
FILMS = (".mp4", ".webp", ".gif")

#: Quality of H.264 (constant rate factor of x264: 0 is lossless, 51 the worst) and of WebP (100 is the best).
CRF, WEBP_QUALITY = 18, 85

#: Colours of a label and of the space around panels, and the height of a label over that of its text.
INK, PAPER, LABEL = (32, 32, 32), (255, 255, 255), 1.7


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
    path: str | os.PathLike,
    frames: Sequence[np.ndarray],
    seconds: float = 4.0,
    quality: float | None = None,
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
    _check_frames(frames, (3,) if path.suffix.lower() == ".mp4" else (3, 4))
    with replacing(path) as temporary:
        if path.suffix.lower() == ".mp4":
            _write_h264(path, temporary, frames, seconds, CRF if quality is None else quality)
            return
        from PIL import Image

        images = [Image.fromarray(frame) for frame in frames]
        options = {
            "save_all": True,
            "append_images": images[1:],
            "loop": 0,
            "duration": round(1000 * seconds / len(frames)),
        }
        if path.suffix.lower() == ".webp":
            options |= {"quality": WEBP_QUALITY if quality is None else quality, "method": 4}
        else:
            options |= {"disposal": 2}
        images[0].save(temporary, **options)


def _check_frames(frames: Sequence[np.ndarray], channels: tuple[int, ...]) -> None:
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

    frames = [even(frame) for frame in frames]
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


def even(frame: np.ndarray) -> np.ndarray:
    """Return a frame of even width and height: an odd one is extended by a copy of its last column or row."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def beside(
    panels: Mapping[str, Sequence[np.ndarray]], columns: int, text_height: int = 13, gap: int = 4
) -> list[np.ndarray]:
    """Return the frames of several films of one size and length as one film, ``columns`` panels in a row.

    ``panels``: label → frames of bytes, ``(height, width, 3)``. The label stands above its panel, in text of
    ``text_height`` pixels; ``gap`` pixels separate columns.

    Raises :class:`.UsageError` for panels of different lengths or sizes.
    """
    from PIL import Image, ImageDraw, ImageFont

    if len({len(frames) for frames in panels.values()}) != 1:
        counts = ", ".join(f"{len(frames)} of {label!r}" for label, frames in panels.items()) or "no panel"
        raise UsageError(f"panels: found {counts}, allowed are one or more panels of equally many frames")
    _check_frames([frame for frames in panels.values() for frame in frames], (3,))
    height, width, _ = next(iter(panels.values()))[0].shape
    columns, band = min(columns, len(panels)), round(LABEL * text_height)
    rows = -(-len(panels) // columns)
    size = (columns * (width + gap) - gap, rows * (height + band))
    sheet, font = Image.new("RGB", size, PAPER), ImageFont.truetype(_font(), text_height)
    corners, draw = [], ImageDraw.Draw(sheet)
    for i, label in enumerate(panels):
        x, y = i % columns * (width + gap), i // columns * (height + band)
        draw.text((x + width / 2, y + band / 2), label, fill=INK, font=font, anchor="mm")
        corners.append((x, y + band))
    empty, frames = np.array(sheet), []
    for together in zip(*panels.values(), strict=True):
        frame = empty.copy()
        for (x, y), image in zip(corners, together, strict=True):
            frame[y : y + height, x : x + width] = image
        frames.append(frame)
    return frames


def _font() -> str:
    """Return the path of DejaVu Sans, which Matplotlib brings."""
    import matplotlib

    return os.path.join(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")
