"""Sources of learned BSDFs that are functions of two directions: Python functions, and networks of Neural-BRDF.

- A Python function takes NumPy arrays ``wi`` and ``wo``, ``(n, 3)`` float32: unit vectors in the local frame, z along
  the normal, above the surface. It returns f without the cosine in linear sRGB, ``(n, 3)``, or ``(n,)`` or ``(n, 1)``
  for grey. PyTorch and JAX take and return such arrays by their own conversions.
- A network of Neural-BRDF (Sztrajman et al., *Neural BRDF Representation and Importance Sampling*, 2021) is an array of
  675 floats in a ``.npz`` file: weights and biases of 6 → 21 → 21 → 3 units, each matrix by rows of its inputs. Inputs
  are the half vector at azimuth 0 and the difference vector (Rusinkiewicz 1998); f is exp(x) − 1, at least 0.
"""

from __future__ import annotations

import hashlib
import importlib
import itertools
import operator
import os
import re
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.lookup import clamp
from ...core.archives import Archive
from ...core.errors import DiffindError, UsageError, reason
from ...core.files import irregular
from ...core.units import memory
from .measured import LARGEST, Truth, value_remarks

#: Name of a function on the command line.
FUNCTION = re.compile(r"[^\W\d][\w.]*:[^\W\d]\w*(\.\w+)*")

#: Units of the layers of a network.
LAYERS = (6, 21, 21, 3)

#: Weights and biases of a network.
WEIGHTS = sum((a + 1) * b for a, b in itertools.pairwise(LAYERS))

#: Pairs of directions for which a Python function is called at once.
CHUNK = 2**18

#: Directions whose values stand for the content of a Python function.
PROBES = 256


class PythonTruth(Truth):
    """Python function ``f(wi, wo)`` of NumPy arrays, without the cosine. Raises :class:`UsageError`."""

    def __init__(self, call: Callable, name: str = ""):
        self.call, self.name = call, name or getattr(call, "__name__", type(call).__name__)
        w = np.abs(np.random.default_rng(3).normal(size=(2, PROBES, 3)))
        values = self.evaluate(*(w / np.linalg.norm(w, axis=2, keepdims=True)).astype(np.float32))
        self.digest = hashlib.sha256(self.name.encode() + values.tobytes()).hexdigest()

    def evaluate(self, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """Return f at directions ``(n, 3)``, ``(n, 3)`` float32."""
        parts = []
        for k in range(0, len(wi), CHUNK):
            pair = wi[k : k + CHUNK].copy(), wo[k : k + CHUNK].copy()  # a function may write into its arguments
            count = len(pair[0])
            try:
                value = np.asarray(self.call(*pair))
            except (Exception, SystemExit) as e:  # any: it is the user's
                fault = f"raised {type(e).__name__} ({reason(e)})"
                raise UsageError(f"{self.name}: {fault} for two arrays of directions, ({count}, 3)") from e
            if value.dtype.kind not in "biuf":
                raise UsageError(f"{self.name}: returned values of the type {value.dtype}, real numbers are needed")
            if value.shape not in ((count, 3), (count, 1), (count,)):
                raise UsageError(f"{self.name}: returned the shape {value.shape}, ({count}, 3) or ({count},) is needed")
            with np.errstate(over="ignore"):  # infinite values are counted
                parts.append(np.broadcast_to(value.reshape(count, -1), (count, 3)).astype(np.float32))
        return np.concatenate(parts)

    def _columns(self, wi, wo) -> list:
        """Return f cos θ_o as it is: also negative, infinite or NaN."""
        columns = [np.asarray(dr.detach(c).numpy(), np.float32) for c in (*wi, *wo)]
        wi_array, wo_array = (np.stack(c, axis=1) for c in np.split(np.array(np.broadcast_arrays(*columns)), 2))
        f = self.evaluate(wi_array, wo_array)
        return [wo.z * device_array(type(wo.z), column) for column in f.T]

    def value(self, wi, wo):
        return [clamp(v, 0, LARGEST) for v in self._columns(wi, wo)]

    def remarks(self, samples):
        values, again = (np.stack([v.numpy() for v in self._columns(samples.wi, samples.wo)]) for _ in range(2))
        lines = value_remarks(self.name, values)
        if not np.allclose(values, again, rtol=1e-3, atol=1e-6, equal_nan=True):
            lines.append("its values differ from call to call: the fit is to noise, and does not repeat")
        return lines


def import_function(source: str) -> PythonTruth:
    """Return the function ``module:function``, of a module of the current folder or an installed one.

    Raises :class:`UsageError`.
    """
    module, _, name = source.partition(":")
    if os.getcwd() not in sys.path:  # at the end, where it hides no other module, and stays for what f imports
        sys.path.append(os.getcwd())
    try:
        code = importlib.import_module(module)
    except (Exception, SystemExit) as e:  # any: importing runs the user's code
        fault = f"{type(e).__name__}: {reason(e)}"
        raise UsageError(f"{source}: the module {module} cannot be imported ({fault})") from None
    try:
        call = operator.attrgetter(name)(code)
    except AttributeError:
        call = None
    if not callable(call):  # the file shows which module hides another of its name
        raise UsageError(f"{source}: the module {module} ({getattr(code, '__file__', None)}) has no function {name}")
    return PythonTruth(call, source)


class NetworkTruth(Truth):
    """Network of Neural-BRDF: the array ``name`` of a ``.npz`` file ("": its only one). Raises :class:`UsageError`."""

    isotropic = True

    def __init__(self, path: Path, name: str, types):
        with open_networks(path) as archive:
            names = list(archive.members)
            if not name and len(names) > 1:
                shown = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
                raise UsageError(f"{path}: has {len(names)} networks: name one (material), they are {shown}")
            if name and name not in names:
                raise UsageError(f'material: found "{name}", {path} has no such network')
            try:
                weights = archive.array(name or names[0])
            except (OSError, EOFError, BadZipFile, zlib.error) as e:
                raise UsageError(f"{path}: the array {name or names[0]} is damaged ({reason(e)})") from None
        finite = weights.dtype.kind == "f" and (np.abs(weights) <= np.finfo(np.float32).max).all()
        if weights.shape != (WEIGHTS,) or not finite:
            array = f"the array {name or names[0]} has the shape {weights.shape}"
            raise UsageError(f"{path}: is no network of Neural-BRDF: {array}, {WEIGHTS} finite floats are needed")
        self.name = name or path.stem
        self.digest = hashlib.sha256(self.name.encode() + weights.tobytes()).hexdigest()
        self.weights = device_array(types.Float, weights.astype(np.float32))

    def value(self, wi, wo):
        Float, UInt32 = type(wo.z), dr.uint32_array_t(type(wo.z))
        weights = (dr.gather(Float, self.weights, UInt32(k)) for k in range(WEIGHTS))
        units = half_and_difference(wi, wo)
        for layer, count in enumerate(LAYERS[1:]):
            matrix = [[next(weights) for _ in range(count)] for _ in units]
            sums = [next(weights) for _ in range(count)]
            for x, row in zip(units, matrix, strict=True):
                sums = [dr.fma(x, weight, total) for weight, total in zip(row, sums, strict=True)]
            units = [dr.maximum(x, 0) for x in sums] if layer < len(LAYERS) - 2 else sums
        return [clamp(wo.z * (dr.exp(x) - 1), 0, LARGEST) for x in units]


def half_and_difference(wi, wo) -> list:
    """Return the components of the half vector at azimuth 0, and of the difference vector (Rusinkiewicz 1998)."""
    half = wi + wo
    half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
    sin = dr.sqrt(dr.square(half.x) + dr.square(half.y))
    cos_phi = dr.select(sin > 1e-6, half.x * dr.rcp(dr.maximum(sin, 1e-6)), 1)
    sin_phi = dr.select(sin > 1e-6, half.y * dr.rcp(dr.maximum(sin, 1e-6)), 0)
    along = dr.fma(cos_phi, wi.x, sin_phi * wi.y)
    difference = [dr.fma(half.z, along, -sin * wi.z), dr.fma(cos_phi, wi.y, -sin_phi * wi.x)]
    return [sin, type(sin)(0), half.z, *difference, dr.fma(sin, along, half.z * wi.z)]


def open_networks(path: Path) -> Archive:
    """Return the archive of networks at ``path``. Raises :class:`UsageError`."""
    try:
        archive = Archive(path)
    except (OSError, BadZipFile, DiffindError) as e:
        raise UsageError(f"{path}: is no file of networks ({reason(e)})") from None
    if "meta" in archive.members or not archive.members:
        fault = "is a table file, which was fitted already" if archive.members else "holds no networks"
        archive.__exit__()
        raise UsageError(f"{path}: {fault}")
    return archive


def is_table(path: Path) -> bool:
    """Return whether a file is a table file."""
    try:
        if irregular(path, memory() // 4):  # a pipe would block
            return False
        with Archive(path) as archive:
            return "meta" in archive.members
    except (OSError, BadZipFile, DiffindError):
        return False
