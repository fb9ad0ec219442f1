"""Cameras of lists of views: the spellings of NeRF's Blender data, nerfstudio, instant-ngp and BlenderNeRF.

A camera is described by keys of its frame and of the whole file; those of the frame go first.

- Focal lengths along the axes x and y: ``fl_x`` in pixels, else the field of view, ``x_fov`` in degrees or
  ``camera_angle_x`` in radians; likewise for y, which has the focal length of x by default.
- ``cx``, ``cy``: the principal point in pixels from the upper left corner; ``w``, ``h``: the size of the image.
- Lenses (:mod:`.lenses`): ``k1`` to ``k6``, ``p1``, ``p2``, or nerfstudio's list ``distortion_params``.
- Projections that are not those of a pinhole or of such a lens are refused by name.
"""

from __future__ import annotations

import math

import numpy as np

from .image_files import ViewsError
from .lenses import DISTORTION

#: Axes of an image, and the keys of the focal length or of the field of view along each.
FOCAL = {axis: (f"fl_{axis}", f"{axis}_fov", f"camera_angle_{axis}") for axis in "xy"}

#: Entries of nerfstudio's ``distortion_params``.
DISTORTION_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Camera models that are read; a distortion may be 0.
CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")

#: Keys of instant-ngp that name other projections.
PROJECTIONS = {
    "is_fisheye": "fisheye", "latlong": "latlong", "equirectangular": "equirectangular", "orthographic": "orthographic",
    "ftheta_p0": "f-theta",
}  # fmt: skip

#: Focal lengths, sizes and places in pixels and the coefficients of lenses are smaller.
LONGEST = 1e9

#: Fields of view in radians are larger: those of telescopes.
SMALLEST_ANGLE = 1e-6

#: Largest ratio of the focal length that a field of view gives to that in pixels, minus 1, without a note.
AGREEMENT = 5e-3


def camera_numbers(where: str, frame: dict, file: dict) -> dict[str, float]:
    """Return the numbers of the camera of a ``frame`` by their names, those that the ``file`` gives for all included.

    Fields of view in degrees become ``camera_angle_x`` and ``camera_angle_y``, lists of distortion parameters become
    their names. ``where`` begins the sentence of a :class:`ViewsError`.
    """
    levels = frame, file
    model = _check_model(where, levels)
    numbers = {name: _first(where, levels, name) for name in ("w", "h", "cx", "cy")}
    for names in FOCAL.values():
        level = next((level for level in levels if any(level.get(name) is not None for name in names)), file)
        pixels, degrees, radians = (_number(where, level, name) for name in names)
        if degrees is not None:
            if not 0 < degrees < 180:
                raise ViewsError(f'{where} has the "{names[1]}" {degrees:g}, expected degrees between 0 and 180')
            radians = math.radians(degrees)
        numbers |= {names[0]: pixels, names[2]: radians}
    if numbers["fl_x"] is None and numbers["camera_angle_x"] is None:
        raise ViewsError(f'{where} has no focal length: neither "camera_angle_x" nor "fl_x" is given')
    numbers = {name: value for name, value in numbers.items() if value is not None} | _lens(where, levels, model)
    for names, least, limit, allowed in (
        (("fl_x", "fl_y", "w", "h"), 0, LONGEST, f"a number > 0 and < {LONGEST:g}"),
        (("camera_angle_x", "camera_angle_y"), SMALLEST_ANGLE, np.pi, f"radians between {SMALLEST_ANGLE:g} and π"),
        (("cx", "cy", *DISTORTION), -LONGEST, LONGEST, f"a number between -{LONGEST:g} and {LONGEST:g}"),
    ):
        for name in names:
            if name in numbers and not least < numbers[name] < limit:
                raise ViewsError(f'{where} has the "{name}" {numbers[name]:g}, expected {allowed}')
    return numbers


def focal_lengths(numbers: dict[str, float], width: int, height: int) -> tuple[tuple[float, float], list[str]]:
    """Return the focal lengths along x and y in pixels of an image of this size, and notes on what contradicts them."""
    focal, notes = {}, []
    for (axis, (pixels, _, angle)), side in zip(FOCAL.items(), (width, height), strict=True):
        by_angle = side / 2 / np.tan(numbers[angle] / 2) if angle in numbers else focal.get("x")
        focal[axis] = numbers.get(pixels, by_angle)
        if angle in numbers and abs(by_angle / focal[axis] - 1) > AGREEMENT:
            notes.append(
                f'the field of view {numbers[angle]:.4g} ("{angle}") would be a focal length of {by_angle:.4g} pixels, '
                f'the "{pixels}" {focal[axis]:.4g} is used'
            )
    return (focal["x"], focal["y"]), notes


def _check_model(where: str, levels: tuple[dict, dict]) -> str:
    """Return the camera model, or raise :class:`ViewsError` if it is not read."""
    model = next((level["camera_model"] for level in levels if level.get("camera_model") is not None), "PINHOLE")
    name = model.upper() if isinstance(model, str) else model
    given = (PROJECTIONS[key] for key in PROJECTIONS for level in levels if level.get(key) not in (None, False))
    other = next(given, "")
    if name not in CAMERA_MODELS or other:
        raise ViewsError(
            f"{where} has the camera model {other if name in CAMERA_MODELS else model!r:.40}, allowed are "
            f"{', '.join(CAMERA_MODELS)}: undistort the images first"
        )
    return name


def _lens(where: str, levels: tuple[dict, dict], model: str) -> dict[str, float]:
    """Return the coefficients of the distortion by their names."""
    lens: dict[str, float] = {}
    for level in levels:
        entries = level.get("distortion_params") if set(DISTORTION_PARAMS) - lens.keys() else None
        if entries is None:
            given = {name: _number(where, level, name) for name in DISTORTION if name not in lens}
        elif isinstance(entries, list) and len(entries) == len(DISTORTION_PARAMS):
            given = dict(zip(DISTORTION_PARAMS, entries, strict=True))
            given = {name: _number(where, given, name) for name in given}
        else:
            raise ViewsError(
                f'{where} has the "distortion_params" {entries!r:.60}, expected the list '
                f"[{', '.join(DISTORTION_PARAMS)}] of nerfstudio"
            )
        lens = {name: value for name, value in given.items() if value is not None} | lens
    if lens.get("k4") and not (lens.get("k5") or lens.get("k6") or model == "FULL_OPENCV"):
        raise ViewsError(
            f"{where} has the distortion k4 = {lens['k4']:g}, which nerfstudio multiplies by r⁸ and OpenCV divides by: "
            f'undistort the images first, or name the "camera_model" FULL_OPENCV'
        )
    return lens


def _first(where: str, levels: tuple[dict, dict], name: str) -> float | None:
    """Return a number of the first level that has it."""
    for level in levels:
        value = _number(where, level, name)
        if value is not None:
            return value
    return None


def _number(where: str, entries: dict, name: str) -> float | None:
    value = entries.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < float("inf"):
        raise ViewsError(f'{where} has the "{name}" {value!r:.40}, expected a number')
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 308 digits
        raise ViewsError(f'{where} has a "{name}" above 1e308, expected a number') from None
