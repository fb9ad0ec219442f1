"""Decoding of films, for tests."""

import importlib.util

import numpy as np
import pytest

#: Mark of tests that need an encoder and a decoder of H.264.
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
