"""Contact sheet of a library: each material as two spheres, the source and the learned BSDF."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ...core.files import replacing
from ...images.srgb import for_display
from .files import BSDFModel
from .fit import cosine
from .source import FunctionTruth, Truth
from .view import SphereView

#: Folder of the pictures, beside the tables.
PICTURES = "spheres"

#: Views whose mean is a picture, and the seed of the first one.
VIEWS, SEED = 8, 100

#: Pixels of a sphere's side, of the margin around a pair, and of a line of text; most pairs beside each other.
SIDE, MARGIN, LINE, COLUMNS = 112, 12, 17, 6


def picture_path(table: Path) -> Path:
    """Return the path of the picture that belongs to a table file."""
    return table.parent / PICTURES / f"{table.stem}.png"


def save_pair(table: Path, truth: Truth, model: BSDFModel) -> None:
    """Write the spheres of a source and, on its right, of the learned BSDF of a table file, in the same light."""
    from PIL import Image

    source = truth if truth.function else FunctionTruth(truth.name, cosine(model.bsdf))
    views = [SphereView(source, model.types, seed) for seed in range(SEED, SEED + VIEWS)]
    images = [sum(v.halves.mean(axis=0) for v in views), sum(v.images(cosine(model.bsdf)).mean(axis=0) for v in views)]
    shown = [np.where(views[0].hit[..., None], for_display(image / VIEWS), 1.0) for image in images]
    if not truth.function:
        shown[0][:] = 1.0  # rows of measured values show no sphere
    with replacing(picture_path(table)) as temporary:
        Image.fromarray(np.round(255 * np.concatenate(shown, axis=1)).astype(np.uint8)).save(temporary)


def write_sheet(path: Path, folder: Path, materials: dict[str, dict]) -> None:
    """Write the contact sheet of the ``materials`` (name → record) whose pictures lie in ``folder``."""
    from PIL import Image, ImageDraw

    width, height = 2 * SIDE + MARGIN, SIDE + 2 * LINE + MARGIN
    columns = max(1, min(COLUMNS, math.ceil(math.sqrt(len(materials)))))
    rows = math.ceil(len(materials) / columns)
    sheet = Image.new("RGB", (columns * width + MARGIN, rows * height + LINE + 2 * MARGIN), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN // 2), "left: source, right: learned; PSNR of the sphere", "dimgray")
    for k, (name, material) in enumerate(materials.items()):
        x, y = MARGIN + k % columns * width, LINE + MARGIN + k // columns * height
        picture = picture_path(folder / f"{name}.npz")
        if material["file"] and picture.is_file():
            with Image.open(picture) as pair:
                sheet.paste(pair.convert("RGB").resize((2 * SIDE, SIDE), Image.Resampling.BICUBIC), (x, y))
            text = accuracy(material)
        else:
            draw.rectangle((x, y, x + 2 * SIDE - MARGIN, y + SIDE), outline="lightgray")
            text = material["status"]
        draw.text((x, y + SIDE), shortened(draw, name, 2 * SIDE - MARGIN), "black")
        draw.text((x, y + SIDE + LINE), text, "firebrick" if material["failure"] else "dimgray")
    with replacing(path) as temporary:
        sheet.save(temporary)


def accuracy(material: dict) -> str:
    """Return the PSNR of a material's record as text, of a table of measurements the relative error."""
    if "psnr_db" in material:
        return f"{material['psnr_db']:.1f} dB"
    return f"error {100 * material['relative_error']:.2g}%"


def shortened(draw, text: str, width: float) -> str:
    """Return the beginning of a text that is at most ``width`` pixels wide, with an ellipsis if it was cut."""
    if draw.textlength(text) <= width:
        return text
    while text and draw.textlength(f"{text}...") > width:
        text = text[:-1]
    return f"{text}..."
