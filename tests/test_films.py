"""Films of frames: H.264 that another decoder call reads back, panels with labels, what is refused."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_diffind.core.errors import UsageError
from mi_diffind.core.files import OutputError
from mi_diffind.images import films

ROOT = Path(__file__).resolve().parents[1]

needs_ffmpeg = pytest.mark.skipif(
    importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed: pip install '.[film]'"
)


def decoded(path):
    """Return the frames of a film, ``(frames, height, width, 3)`` bytes."""
    import imageio_ffmpeg

    exact = ["-vf", "scale=flags=accurate_rnd+full_chroma_int+full_chroma_inp"]
    stream = imageio_ffmpeg.read_frames(str(path), output_params=exact)
    width, height = next(stream)["size"]
    return np.stack([np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in stream])


def smooth_frames(count, height, width):
    """Frames of bytes, a slow wave that moves."""
    y, x = np.mgrid[:height, :width]
    waves = [(np.sin(x / 17 + k), np.cos(y / 13 + k), np.sin((x + y) / 23 - k)) for k in np.arange(count) / 3]
    return [np.round(127 + 100 * np.stack(wave, axis=-1)).astype(np.uint8) for wave in waves]


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_linear_images_as_displayed(channels):
    """Bytes of sRGB, rounded; colours multiplied by alpha are divided by it, or stand in front of black."""
    alpha = np.array([0, 0.02, 0.25, 1])[None, :, None]
    colours = np.array([0.001, 0.2, 0.7, 3])[:, None, None] * np.array([1, 0.6, 0.3])[: 1 if channels < 3 else 3]

    def encoded(values):
        values = np.clip(values, 0, 1)
        return 255 * np.where(values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055)

    if channels % 2:
        image = np.repeat(colours, 4, axis=1)
        straight, black = encoded(image), encoded(image)
    else:
        image = np.concatenate([colours * alpha, np.repeat(alpha, 4, axis=0)], axis=-1)
        straight, black = encoded(np.where(alpha > 0, colours, 0)), encoded(colours * alpha)
    shown, in_front = films.displayed(image), films.over_black(image)
    assert shown.dtype == np.uint8 and shown.shape[2] == (3 if channels % 2 else 4) and in_front.shape[2] == 3
    assert np.abs(shown[..., :3] - straight).max() < 0.51 and np.abs(in_front - black).max() < 0.51
    if channels % 2 == 0:
        assert np.abs(shown[..., 3] - 255 * image[..., -1]).max() < 0.51


@needs_ffmpeg
@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
def test_h264_is_read_back(tmp_path, size):
    frames, path = smooth_frames(9, *size), tmp_path / "film.mp4"
    films.write(path, frames, seconds=3.0)
    import imageio_ffmpeg

    count, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert count == 9 and seconds == pytest.approx(3.0)
    read = decoded(path)
    assert read.shape == (9, 48, 64, 3)
    error = read[:, : size[0], : size[1]].astype(float) - np.stack(frames)
    assert (10 * np.log10(255**2 / np.square(error).mean(axis=(1, 2, 3))) > 38).all()
    assert np.abs(error.mean(axis=(1, 2))).max() < 0.7  # no shift of colours by another matrix or range
    if size[0] % 2:
        assert np.abs(read[:, -1].astype(int) - read[:, -2]).mean() < 4


@needs_ffmpeg
def test_a_name_like_an_address_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for count, name in enumerate(("http:film.mp4", "-y.mp4"), 1):  # one frame is a film, too
        films.write(name, smooth_frames(count, 16, 16))
        assert decoded(tmp_path / name).shape[0] == count


@needs_ffmpeg
def test_a_failed_encoder_leaves_nothing(tmp_path):
    """Frames without pixels, which the encoder refuses."""
    with pytest.raises(OutputError, match=r'output file ".*film\.mp4" cannot be written: .+'):
        films.write(tmp_path / "film.mp4", [np.zeros((0, 0, 3), np.uint8)])
    assert not os.listdir(tmp_path)


@needs_ffmpeg
def test_refused_frames(tmp_path):
    frame = smooth_frames(1, 8, 8)[0]
    for frames, name, message in (
        ([], "film.webp", "frames: found none"),
        ([frame, frame[:4]], "film.webp", r"found uint8 \(4, 8, 3\) as number 1, allowed .*\(height, width, 3 or 4\)"),
        ([frame / 255], "film.webp", r"found float64 \(8, 8, 3\) as number 0"),
        ([frame[..., :1]], "film.webp", r"found uint8 \(8, 8, 1\)"),
        (
            [frame[..., [0, 1, 2, 0]]],
            "film.mp4",
            r"found uint8 \(8, 8, 4\) as .* allowed are uint8 \(height, width, 3\)",
        ),
    ):
        with pytest.raises(UsageError, match=message):
            films.write(tmp_path / name, frames)
    assert not os.listdir(tmp_path)


@pytest.mark.parametrize("name", ["film.webp", "film.gif"])
def test_nothing_stays_of_the_frame_before(tmp_path, name):
    """A square without a corner that moves in front of nothing: each frame is clear but for its own square."""
    frames = np.zeros((3, 16, 48, 4), np.uint8)
    for i, frame in enumerate(frames):
        frame[4:12, 16 * i + 4 : 16 * i + 12] = 200, 60, 20, 255
        frame[4, 16 * i + 4] = 0
    films.write(tmp_path / name, frames)
    with Image.open(tmp_path / name) as film:
        for i, frame in enumerate(frames):
            film.seek(i)
            np.testing.assert_array_equal(np.array(film.convert("RGBA"))[..., 3], frame[..., 3])


@needs_ffmpeg
@pytest.mark.long
def test_the_films_of_the_pages_are_rendered(tmp_path):
    command = [sys.executable, str(ROOT / "docs" / "make_films.py"), "zoom", "--frames", "3"]
    subprocess.run([*command, "--out", str(tmp_path), "--json", str(tmp_path)], check=True, capture_output=True)
    names = ["film_zoom.json", "zoom.jpg", "zoom.mp4", "zoom.webp"]
    assert sorted(os.listdir(tmp_path)) == names
    with Image.open(tmp_path / "zoom.webp") as film:
        assert film.n_frames == 4  # 1 2 3 2
    assert decoded(tmp_path / "zoom.mp4").shape[0] == 4
