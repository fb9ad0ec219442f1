"""Image files of captures: PNG and JPEG as bytes, EXR in half precision.

PNG and JPEG hold sRGB, not multiplied by alpha; EXR holds linear values multiplied by alpha. An image without alpha is
opaque everywhere.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.archives import Allowance, LimitError
from ...core.errors import DiffindError, reason
from ...core.files import OutsideError, irregular, path_by_name, shown
from ...core.units import memory
from ...images.headers import check_picture
from ...images.srgb import from_linear, to_linear

#: Extensions tried in turn for an image name without one.
EXTENSIONS = (".png", ".jpg", ".jpeg", ".exr")

#: Extensions of one format.
JPEG = (".jpg", ".jpeg")

#: Bytes up to this one are black in a mask that was written as JPEG, whose black is not exact.
BLACK_OF_JPEG = 127

#: Byte of sRGB → linear value, and byte of alpha → share.
LINEAR, SHARE = to_linear(np.arange(256) / 255).astype(np.float32), np.arange(256, dtype=np.float32) / np.float32(255)

#: Largest number in half precision.
LARGEST = 65504.0


class ViewsError(DiffindError, ValueError):
    """Error for unusable images or poses; the message is one sentence that names the file and the fault."""


class MissingImageError(ViewsError):
    """Error for an image that a list of views names and that does not exist."""


def image_file(root: Path, name: str, file: Path) -> Path:
    r"""Return the path of an image in the folder ``root``, which the ``file`` with a list of views names.

    The name may lack its extension, have ``\`` between folders, and differ from the file's in upper and lower case, or
    by ``.jpg`` and ``.jpeg``. Raises :class:`MissingImageError`, and :class:`ViewsError` for a path out of the folder.
    """
    names = [name, *(name + extension for extension in EXTENSIONS)]
    if Path(name).suffix.lower() in JPEG:
        names += [str(Path(name).with_suffix(suffix)) for suffix in JPEG]
    for spelling in names:
        try:
            path = path_by_name(root, spelling, file)
        except OutsideError as e:
            raise ViewsError(str(e)) from None
        if fault := irregular(path, memory() // 4):
            raise ViewsError(f"{shown(path)}: {fault}, {file.name} names it")
        if path.is_file():
            return path
    more = "" if Path(name).suffix.lower() in EXTENSIONS else f", nor with {', '.join(EXTENSIONS)}"
    raise MissingImageError(f"{shown(Path(root) / name)}: no such image{more}, {file.name} names it")


def is_linear(path: Path) -> bool:
    """Return whether an image file holds linear values."""
    return path.suffix.lower() == ".exr"


def read_image(path: Path) -> tuple[np.ndarray, bool]:
    """Return an image ``(height, width, 4)`` as the file has it, and whether the file has alpha.

    That is uint8, or float32 for EXR. Raises :class:`ViewsError`.
    """
    encoded = not is_linear(path)
    try:
        values = _read_bytes(path) if encoded else _read_exr(path)
    except (ViewsError, ImportError):
        raise
    except LimitError as e:
        raise ViewsError(str(e)) from None
    except Exception as e:  # each decoder raises errors of its own for a damaged file
        raise ViewsError(
            f"{path}: cannot be read as an image, it is damaged or of an unknown format ({reason(e)})"
        ) from None
    if not encoded and not np.isfinite(values).all():
        raise ViewsError(f"{path}: has {np.count_nonzero(~np.isfinite(values)):,} values that are NaN or infinite")
    has_alpha = values.shape[2] in (2, 4)
    image = np.full((*values.shape[:2], 4), 255 if encoded else 1, values.dtype)
    image[..., :3] = values[..., :-1] if has_alpha else values
    if has_alpha:
        image[..., 3] = values[..., -1] if encoded else np.clip(values[..., -1], 0, 1)
    return image, has_alpha


def half_floats(image: np.ndarray) -> np.ndarray:
    """Return an image of :func:`read_image` in half precision: linear and multiplied by alpha."""
    values = decoded(image) if image.dtype == np.uint8 else image
    return np.clip(values, -LARGEST, LARGEST).astype(np.float16)


def decoded(image: np.ndarray) -> np.ndarray:
    """Return an image ``(…, 4)`` of bytes or halves as float32: linear colours multiplied by alpha, and alpha."""
    if image.dtype != np.uint8:
        return image.astype(np.float32)
    values = np.empty(image.shape, np.float32)
    values[..., 3] = alpha = SHARE[image[..., 3]]
    for channel in range(3):  # three times as fast as all at once
        np.multiply(LINEAR[image[..., channel]], alpha, out=values[..., channel])
    return values


def encoded(image: np.ndarray) -> np.ndarray:
    """Return an image ``(…, 4)`` of linear colours multiplied by alpha, and alpha, as bytes, see :func:`decoded`."""
    alpha = image[..., 3:]
    straight = image[..., :3] / np.where(alpha > 0, alpha, 1)
    shown = from_linear(np.clip(straight, 0, 1))
    return np.rint(255 * np.concatenate([shown, np.clip(alpha, 0, 1)], axis=-1)).astype(np.uint8)


def reduced(image: np.ndarray, mask: np.ndarray | None, factor: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return an image of :func:`read_image` and its mask at a resolution that is lower by a whole ``factor``.

    Linear colours multiplied by alpha are averaged. A pixel counts if all that it covers count. Rows and columns at the
    right and the bottom that fill no pixel are left out.
    """
    height, width = (side // factor for side in image.shape[:2])
    rows = []
    for row in range(height):  # one after the other, since a photograph in single precision is large
        values = image[row * factor : (row + 1) * factor, : width * factor]
        values = decoded(values) if image.dtype == np.uint8 else values
        rows.append(values.reshape(factor, width, factor, 4).mean(axis=(0, 2)))
    if mask is not None:
        blocks = mask[: height * factor, : width * factor].reshape(height, factor, width, factor)
        mask = blocks.all(axis=(1, 3))
    mean = np.stack(rows)
    return encoded(mean) if image.dtype == np.uint8 else mean, mask


def read_mask(path: Path, image: np.ndarray, image_path: Path) -> tuple[np.ndarray, bool]:
    """Return the mask of an image, bool ``(height, width)``, true where a pixel counts, and whether alpha holds it.

    Alpha holds the mask if the file has an alpha that is not 1 everywhere, else the luminance does. A pixel counts
    where it is not 0 or, in a JPEG, above :data:`BLACK_OF_JPEG`. Raises :class:`ViewsError`, also if the sizes differ.
    """
    try:
        with _opened(path, 4) as opened:
            alpha = np.array(opened.convert("RGBA"))[..., 3] if opened.has_transparency_data else None
            if in_alpha := alpha is not None and bool(alpha.min() < 255):
                mask = alpha > 0
            else:
                single = opened.mode in ("1", "L", "I", "F") or opened.mode.startswith("I;")  # of 16 bits, too
                values = np.array(opened if single else opened.convert("L"))
                mask = values > (BLACK_OF_JPEG if opened.format == "JPEG" else 0)
    except LimitError as e:
        raise ViewsError(str(e)) from None
    except Exception as e:
        raise ViewsError(f"{path}: cannot be read as a mask ({reason(e)})") from None
    if mask.shape != image.shape[:2]:
        sizes = " × ".join(map(str, mask.shape[::-1])), " × ".join(map(str, image.shape[1::-1]))
        raise ViewsError(f"{path}: has {sizes[0]} pixels, its image {image_path.name} has {sizes[1]}")
    return mask, in_alpha


def _opened(path: Path, channels: int):
    """Return an open image file of Pillow, not yet decoded, that may have so many ``channels`` of a byte.

    Raises :class:`.LimitError` for one that takes more memory than a file of its size may.
    """
    from PIL import Image

    limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None  # the limit here is the one of all readers
    try:
        image = Image.open(path)
    finally:
        Image.MAX_IMAGE_PIXELS = limit
    try:
        content = f"a picture of {image.width:,} x {image.height:,} pixels"
        Allowance(path).check(channels * image.width * image.height, content)
    except LimitError:
        image.close()
        raise
    return image


def _read_bytes(path: Path) -> np.ndarray:
    """Return an image of 8 bits, ``(height, width, 1 to 4)``, uint8."""
    with _opened(path, 4) as image:
        if image.mode not in ("RGB", "RGBA", "L", "LA"):
            if image.mode in ("CMYK", "YCbCr", "LAB", "HSV", "1", "F", "I") or image.mode.startswith("I;"):
                raise ViewsError(f"{path}: has pixels of the mode {image.mode}, allowed are 8 bits of grey or RGB")
            image = image.convert("RGBA" if image.has_transparency_data else "RGB")
        elif image.mode in ("RGB", "L") and image.has_transparency_data:
            image = image.convert("RGBA")
        values = np.array(image)
    return values.reshape(*values.shape[:2], -1)


def _read_exr(path: Path) -> np.ndarray:
    """Return an EXR image, ``(height, width, 1 to 4)``, float32: R, G, B or Y, and A."""
    import OpenEXR

    check_picture(path)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    colours = next((c for c in (("R", "G", "B"), ("Y",)) if set(c) <= set(planes)), None)
    if colours is None:
        raise ViewsError(f"{path}: has the channels {', '.join(sorted(planes))}, expected R, G, B or Y, and A")
    return np.stack([planes[name] for name in (*colours, *(("A",) if "A" in planes else ()))], axis=-1)
