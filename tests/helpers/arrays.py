"""NumPy arrays as inputs of kernels, and as their results."""

import drjit as dr
import numpy as np


def aligned(values, dtype=np.float32) -> np.ndarray:
    """Return a contiguous copy whose memory starts at a multiple of 64 bytes.

    Dr.Jit uses NumPy's memory as it is, and compiles another kernel for each combination of aligned and other inputs.
    NumPy aligns at random, so without this helper a repeated computation is compiled several times.
    """
    values = np.asarray(values, dtype)
    memory = np.empty(values.nbytes + 64, np.uint8)
    start = -memory.ctypes.data % 64
    copy = memory[start : start + values.nbytes].view(dtype).reshape(values.shape)
    copy[...] = values
    return copy


def numpy_of(channels) -> np.ndarray:
    """Return Dr.Jit arrays as columns of one NumPy array, float64.

    They are computed together: NumPy asks for one after the other, and each would be a kernel.
    """
    channels = list(channels)
    dr.eval(channels)
    return np.stack([np.asarray(c.numpy(), np.float64) for c in channels], axis=-1)
