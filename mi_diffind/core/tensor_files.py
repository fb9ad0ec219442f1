"""Tensor files of measured materials, as Mitsuba's plugins ``measured`` and ``measured_polarized`` read them."""

import contextlib
import io
import struct
from pathlib import Path

import numpy as np

from .errors import UsageError, reason

#: Types of numbers in a tensor file, by their code.
TYPES = ("", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")

#: Most fields of a file.
MOST = 256

#: Field of ``measured``, beside its values → number of dimensions.
MEASURED = {"phi_i": 1, "theta_i": 1, "ndf": 2, "sigma": 2, "vndf": 4, "luminance": 4}

#: Field of ``measured_polarized`` → number of dimensions.
POLARISED = {"theta_h": 2, "theta_d": 2, "phi_d": 2, "wvls": 1, "M": 6}

#: Fields that increase.
ANGLES = ("phi_i", "theta_i", "theta_h", "theta_d", "phi_d")

#: Largest polar angle and azimuth of a file, radians; Mitsuba would read angles in degrees as the last ones.
LARGEST_ANGLES = {"theta": 1.6, "phi": 6.3}

#: Fields of wavelengths, nm.
WAVELENGTHS = ("wavelengths", "wvls")

#: Fields of densities.
POSITIVE = ("ndf", "sigma", "vndf")


def read(path: Path) -> dict[str, np.ndarray]:
    """Return the fields of a tensor file by name, arrays that are read when used. Raises :class:`UsageError`."""
    fields = {}
    try:
        with open(path, "rb") as stream:

            def unpack(form: str) -> tuple:
                return struct.unpack("<" + form, stream.read(struct.calcsize("<" + form)))

            magic, version, _, count = unpack("12sBBI")
            if magic != b"tensor_file\0" or version != 1 or count > MOST:
                raise ValueError("another format")
            for _ in range(count):
                name = stream.read(*unpack("H")).decode()
                dims, dtype, offset = unpack("HBQ")
                shape = unpack("Q" * dims)
                if 0 in shape:  # which cannot be mapped
                    fields[name] = np.empty(shape, TYPES[dtype])
                else:
                    fields[name] = np.memmap(path, TYPES[dtype], "r", offset, shape)
    except Exception as e:  # struct and NumPy have their own
        raise UsageError(f"{path}: is no tensor file of a measured material ({reason(e)})") from None
    return fields


def check(path: Path, fields: dict) -> None:
    """Refuse fields of a file from which Mitsuba's plugins would read nothing, or something else.

    Those are of ``measured`` or, with a field ``M``, of ``measured_polarized``: each has to be there, in its shape and
    with finite numbers (but for invalid entries of ``M``). Raises :class:`UsageError`.
    """
    polarised, spectral = "M" in fields, "wavelengths" in fields or "spectra" in fields
    content = "Mueller matrices" if polarised else "spectra" if spectral else "colours"
    colours = {"spectra": 5, "wavelengths": 1} if spectral else {"rgb": 5}
    needed = POLARISED if polarised else {**MEASURED, **colours}
    shapes = {name: np.shape(fields.get(name, ())) for name in needed}

    def refuse(fault: str):
        raise UsageError(f"{path}: is no file of measured {content}: {fault}")

    for name, dimensions in needed.items():
        if name not in fields:
            refuse(f'has no field "{name}"')
        if len(shapes[name]) != dimensions or 0 in shapes[name]:
            refuse(f'the field "{name}" has the shape {shapes[name]}, {dimensions} dimensions are needed')
    if polarised:
        expected = {"M": (*(shapes[name][-1] for name in ("phi_d", "theta_d", "theta_h", "wvls")), 4, 4)}
    else:
        nodes, image = (*shapes["phi_i"], *shapes["theta_i"]), shapes["luminance"][2:]
        values = {"spectra": (*nodes, *shapes["wavelengths"], *image)} if spectral else {"rgb": (*nodes, 3, *image)}
        expected = {"vndf": (*nodes, *shapes["vndf"][2:]), "luminance": (*nodes, *image), **values}
    for name, shape in expected.items():
        if shapes[name] != shape:
            refuse(f'the field "{name}" has the shape {shapes[name]}, {shape} is needed')
    for name in needed:
        finite = np.isfinite(fields[name][..., 0, 0] if name == "M" else fields[name])
        if not (finite.any() if name == "M" else finite.all()):
            refuse(f'the field "{name}" has {finite.size - np.count_nonzero(finite):,} values that are not finite')
        if name in ANGLES and (np.diff(np.ravel(fields[name])) <= 0).any():
            refuse(f'the field "{name}" does not increase')
        most = LARGEST_ANGLES.get(name.partition("_")[0], np.inf)
        if (largest := np.abs(fields[name]).max() if name in ANGLES else 0) > most:
            refuse(f'the field "{name}" has angles up to {largest:.4g}, radians up to {most} are needed')
        if name.startswith("theta") and (smallest := np.min(fields[name])) < -1e-3:
            refuse(f'the field "{name}" has angles down to {smallest:.4g}, at least 0 are needed')
        if name in WAVELENGTHS and not ((fields[name] > 300) & (fields[name] < 1000)).any():
            refuse(f'the field "{name}" has no wavelength between 300 and 1000 nm')
        if name in POSITIVE and not (np.min(fields[name]) >= 0 and np.max(fields[name]) > 0):
            refuse(f'the field "{name}" has negative values, or none above 0')


def write(path: Path, fields: dict) -> None:
    """Write the fields of a tensor file."""
    from mitsuba.python import tensor_io

    with contextlib.redirect_stdout(io.StringIO()):
        tensor_io.write(str(path), **fields)
