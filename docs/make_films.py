"""
Render the films of the documentation.

    python docs/make_films.py [suite] [zoom] [orbit] [shading] [--frames 20] [--out docs/films] [--json docs/measured]

Each film is written as NAME.webp, which pages show, as NAME.mp4 (H.264; it needs the package imageio-ffmpeg), and its
first frame as NAME.jpg. JSON named film_NAME.json holds the settings, the bytes of the films and of the table files,
and the PSNR of each panel against the panel "truth", of values as displayed.

Cameras start and end slowly, and a film returns by the same frames; ``orbit`` goes once around instead. Frame ``i`` has
the random numbers of seed ``i``: the same command gives the same films.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_diffind.core.files import write_json
from mi_diffind.core.progress import progress_bar
from mi_diffind.images import films
from mi_diffind.measure import renders
from mi_diffind.measure.renders import TextureZoom
from mi_diffind.scenes import loading, poses, rendering

DOCS = Path(__file__).resolve().parent
SCENES = DOCS.parent / "scenes"
ASSETS = SCENES / "assets"

#: Frames a second; samples a pixel of the floor, whose light has noise, and of the truth.
RATE, SAMPLES, TRUTH = 12, 4, 64

#: Colour of a label.
INK = (32, 32, 32)

#: Colour of the space around panels.
PAPER = (255, 255, 255)

#: Height of a label over that of its text.
LABEL = 1.7

#: Settings of panels of the scenes, without "spp".
FLOOR = {"max_depth": 3}
METAL = {"sky": 0, "max_depth": 2}

#: Panels of a film: label → frames of bytes.
Panels = dict[str, list[np.ndarray]]

#: Motions of the camera, a matrix in world space for each frame.
Motions = Sequence[np.ndarray]


@dataclass
class Film:
    """Panels with their labels, how many stand in a row, the table files that they read, and whether they return.

    A film that ``returns`` shows its frames forwards and then backwards.
    """

    panels: Panels
    columns: int
    files: list[str]
    returns: bool = True


def times(frames: int) -> list[float]:
    """Return a number for each frame that goes from 0 to 1, slowly at both ends."""
    return [(1 - math.cos(math.pi * i / (frames - 1))) / 2 for i in range(frames)]


def turned(angles: Sequence[float]) -> Motions:
    """Return motions about the vertical through the origin by angles in degrees."""
    return [poses.rotation((0, 1, 0), angle) for angle in angles]


def swing(degrees: float, frames: int) -> Motions:
    """Return motions about the vertical through the origin, from ``-degrees`` to ``degrees``."""
    return turned([degrees * (2 * t - 1) for t in times(frames)])


def rendered(
    name: str,
    motions: Motions,
    size: tuple[int, int],
    spp: int = 1,
    against: str | None = None,
    scale: int = 1,
    **defines,
) -> list[np.ndarray]:
    """Render the frames of one panel: a scene of ``scenes/``, its learned plugins replaced by those of ``against``.

    The panel has ``size`` (width, height); each pixel of the render is enlarged to ``scale`` × ``scale`` of it.
    """
    defines |= {"spp": spp, "width": size[0] // scale, "height": size[1] // scale}
    options = {"exact": True, "against": against} if against else {}
    scene = loading.load(SCENES / f"{name}.xml", defines, **options)
    with progress_bar(" ".join(filter(None, (name, against))), len(motions), "frame", True) as bar:
        images = rendering.along(scene, motions, new_seeds=True, on_frame=bar.update)
    return [films.displayed(image).repeat(scale, axis=0).repeat(scale, axis=1) for image in images]


def suite(frames: int) -> Film:
    """Render the README's film."""
    size, back = (288, 172), np.tile(np.eye(4), (frames, 1, 1))
    back[:, :3, 3] = np.outer(times(frames), (0.0, 0.5, 2.2))
    panels = {
        f"bitmap, {SAMPLES} samples a pixel": rendered("horizon", back, size, SAMPLES, against="exact", **FLOOR),
        f"neural_texture, {SAMPLES} samples a pixel": rendered("horizon", back, size, SAMPLES, **FLOOR),
        "neural_field among mirrors and glass": rendered("field", swing(22.0, frames), size, 48, max_depth=6),
        "neural_material, filtered maps": metal("rust_plain.npz", frames, size),
        "neural_material, trained for shading": metal("rust_shaded.npz", frames, size),
        "neural_bsdf: left exact, right learned": rendered("library", swing(14.0, frames), size, 64),
    }
    wall = [f"library/{path.name}" for path in sorted((ASSETS / "library").glob("*.npz"))]
    return Film(panels, 3, ["tiles_filtered.npz", "group.npz", "rust_plain.npz", "rust_shaded.npz", *wall])


def metal(file: str, frames: int, size: tuple[int, int], **options) -> list[np.ndarray]:
    """Render a panel of hammered metal, its pixels enlarged."""
    return rendered("rust", swing(8.0, frames), size, scale=2, metal=file, **METAL, **options)


def floor(frames: int) -> Film:
    """Render an orbit through the pillars of ``horizon.xml``, of three times as many frames."""
    size, around = (288, 162), turned([120 * i / frames for i in range(3 * frames)])
    panels = {
        f"bitmap, {SAMPLES} samples a pixel": rendered("horizon", around, size, SAMPLES, against="exact", **FLOOR),
        f"mipmap, {SAMPLES} samples a pixel": rendered("horizon", around, size, SAMPLES, against="mipmap", **FLOOR),
        f"neural_texture, {SAMPLES} samples a pixel": rendered("horizon", around, size, SAMPLES, **FLOOR),
        f"truth, {TRUTH} samples a pixel": rendered("horizon", around, size, TRUTH, "exact", **FLOOR),
    }
    return Film(panels, 2, ["tiles_filtered.npz"], returns=False)


def shading(frames: int) -> Film:
    """Render hammered metal, by textures and by one that is trained for its shading."""
    size = (288, 162)
    panels = {
        "bitmap, 1 sample a pixel": metal("rust_plain.npz", frames, size, against="exact"),
        "filtered maps, 1 sample a pixel": metal("rust_plain.npz", frames, size),
        "trained for shading, 1 sample a pixel": metal("rust_shaded.npz", frames, size),
        f"truth, {TRUTH} samples a pixel": metal("rust_plain.npz", frames, size, spp=TRUTH, against="exact"),
    }
    return Film(panels, 2, ["rust_plain.npz", "rust_shaded.npz"])


def zoom(frames: int) -> Film:
    """Render the zoom of the texture study over the tiles."""
    size, albedo = (288, 162), str(ASSETS / "tiles_albedo.png")
    with_levels = {"filter": "anisotropic"}
    textures = {
        "bitmap, 1 sample a pixel": {"type": "bitmap", "filename": albedo},
        "mipmap, 1 sample a pixel": {"type": "mipmap", "filename": albedo, **with_levels},
        "neural_texture, 1 sample a pixel": {
            "type": "neural_texture", "filename": str(ASSETS / "tiles_filtered.npz"), "channels": "albedo",
            **with_levels,
        },
        f"truth, {TRUTH} samples a pixel": {"type": "bitmap", "filename": albedo},
    }  # fmt: skip
    side = mi.Bitmap(albedo).size()[0]
    view = TextureZoom(renders.zoom_scene(), size, (side, side), frames)
    panels = {}
    for label, texture in textures.items():
        truth = label.startswith("truth")
        reader = renders.TextureReader(
            lambda repeats, texture=texture: {**texture, "to_uv": renders.to_uv(repeats)},
            spp=TRUTH if truth else 1,
            sampler="multijitter" if truth else "independent",
            prepare=loading.attach,
        )
        panels[label] = [np.round(255 * image).astype(np.uint8) for image in view.render(reader)]
    return Film(panels, 2, ["tiles_filtered.npz"])


#: Films by name.
FILMS = {"suite": suite, "zoom": zoom, "orbit": floor, "shading": shading}


def psnr(panels: Panels) -> dict[str, float]:
    """Return the PSNR of all frames together of each panel against the panel "truth", if there is one."""
    truth = next((np.stack(panel).astype(float) for label, panel in panels.items() if label.startswith("truth")), None)
    if truth is None:
        return {}
    errors = {label: np.mean((np.stack(panel) - truth) ** 2) / 255**2 for label, panel in panels.items()}
    return {label: float(-10 * np.log10(error)) for label, error in errors.items() if not label.startswith("truth")}


def beside(
    panels: Mapping[str, Sequence[np.ndarray]], columns: int, text_height: int = 13, gap: int = 4
) -> list[np.ndarray]:
    """Return the frames of several films of one size and length as one film, ``columns`` panels in a row.

    ``panels``: label → frames of bytes, ``(height, width, 3)``. The label stands above its panel, in text of
    ``text_height`` pixels; ``gap`` pixels separate columns.
    """
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    fonts = Path(matplotlib.get_data_path(), "fonts", "ttf")
    height, width, _ = next(iter(panels.values()))[0].shape
    columns, band = min(columns, len(panels)), round(LABEL * text_height)
    rows = -(-len(panels) // columns)
    size = (columns * (width + gap) - gap, rows * (height + band))
    sheet, font = Image.new("RGB", size, PAPER), ImageFont.truetype(str(fonts / "DejaVuSans.ttf"), text_height)
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


def make(name: str, frames: int, out: Path, json_folder: Path | None, quality: float) -> None:
    """Render a film and write it."""
    film = FILMS[name](frames)
    shown = beside(film.panels, film.columns)
    rendered_frames = len(shown)
    if film.returns:
        shown += shown[-2:0:-1]
    seconds = len(shown) / RATE
    films.write(out / f"{name}.webp", shown, seconds, quality)
    films.write(out / f"{name}.mp4", shown, seconds, 23)
    mi.Bitmap(shown[0]).write(str(out / f"{name}.jpg"), quality=85)
    files = [out / f"{name}.{extension}" for extension in ("webp", "mp4", "jpg")]
    with tempfile.TemporaryDirectory() as folder:  # for its size alone
        films.write(gif := Path(folder) / f"{name}.gif", shown, seconds)
        sizes = {file.suffix[1:]: file.stat().st_size for file in (*files, gif)}
    height, width, _ = shown[0].shape
    figures = {
        "command": f"python docs/make_films.py {name} --frames {frames}",
        "width": width, "height": height, "frames": len(shown), "frames_rendered": rendered_frames,
        "frames_per_second": RATE, "variant": mi.variant(), "psnr_db": psnr(film.panels),
        "table_file_bytes": {file: (ASSETS / file).stat().st_size for file in film.files},
        "bytes": sizes,
    }  # fmt: skip
    print(name, figures["bytes"], figures["psnr_db"])
    if json_folder:
        write_json(json_folder / f"film_{name}.json", figures)


def main() -> None:
    """Write the films."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"films: {', '.join(FILMS)} (default: all)")
    parser.add_argument("--frames", type=int, default=20, help="frames that are rendered of each (default: 20)")
    parser.add_argument("--quality", type=float, default=60, help="quality of WebP (default: 60)")
    parser.add_argument("--out", type=Path, default=DOCS / "films", help="folder of the films (default: docs/films)")
    parser.add_argument("--json", type=Path, metavar="FOLDER", help="folder of the figures, such as docs/measured")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(FILMS):
        parser.error(f"NAME: found {', '.join(sorted(unknown))}, allowed are {', '.join(FILMS)}")
    if arguments.frames < 2:
        parser.error(f"--frames: found {arguments.frames}, allowed are whole numbers from 2 on")
    mi.set_variant("llvm_ad_rgb")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in arguments.names or FILMS:
        make(name, arguments.frames, arguments.out, arguments.json, arguments.quality)


if __name__ == "__main__":
    main()
