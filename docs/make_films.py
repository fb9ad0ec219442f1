"""
Render the films of the documentation.

    python docs/make_films.py [flight] [zoom] [orbit] [shading] [--frames 20] [--out docs/films] [--json docs/measured]

Each film is written as NAME.webp, which pages show, as NAME.mp4 (H.264; it needs the package imageio-ffmpeg), and its
first frame as NAME.jpg. JSON named film_NAME.json holds the settings, the bytes of the films and of the table files,
and the PSNR of each panel against the panel "truth", of values as displayed.

Cameras start and end slowly, and a film returns by the same frames; ``orbit`` goes once around instead. Frame ``i`` has
the random numbers of seed ``i``: the same command gives the same films.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "scenes"))
from make_rust import EXPOSURE, LIGHTS

from mi_diffind.core.files import write_json
from mi_diffind.core.progress import progress_bar
from mi_diffind.images import films
from mi_diffind.measure import renders
from mi_diffind.scenes import loading, poses, rendering

DOCS = Path(__file__).resolve().parent
SCENES = DOCS.parent / "scenes"
ASSETS = SCENES / "assets"
TILES = ASSETS / "tiles_albedo.png"

#: Width of the plane of ``renders.still_scenes``.
PLANE = 2000.0

#: Textures of the tiles.
BITMAP = {"type": "bitmap", "filename": str(TILES)}
LEARNED = {
    "type": "neural_texture",
    "filename": str(ASSETS / "tiles_filtered.npz"),
    "channels": "albedo",
    "filter": "anisotropic",
}

#: Frames a second; samples a pixel of the floor, whose light has noise, and of the truth.
RATE, SAMPLES, TRUTH = 12, 4, 64

#: Width and height of a panel in pixels.
SIZE = (288, 162)

#: Colours of labels and of the space around panels, height of the text, height of a label, and space between panels.
INK, PAPER, TEXT, LABEL, GAP = (32, 32, 32), (255, 255, 255), 13, 22, 4

#: Panels of a film: label → frames of bytes.
Panels = dict[str, list[np.ndarray]]


@dataclass
class Film:
    """Panels with their labels, how many stand in a row, the table files that they read, and whether they return.

    A film that ``returns`` shows its frames forwards and then backwards.
    """

    panels: Panels
    columns: int
    files: list[str]
    returns: bool = True


def times(frames: int) -> np.ndarray:
    """Return a number for each frame that goes from 0 to 1, slowly at both ends."""
    return (1 - np.cos(np.linspace(0, np.pi, frames))) / 2


def rotations(angles: Iterable[float]) -> list[np.ndarray]:
    """Return motions of the camera about the vertical through the origin by angles in degrees, ``(4, 4)`` each."""
    return [poses.rotation((0, 1, 0), angle) for angle in angles]


def swing(degrees: float, frames: int) -> list[np.ndarray]:
    """Return motions about the vertical through the origin, from ``-degrees`` to ``degrees``."""
    return rotations(degrees * (2 * times(frames) - 1))


def linear(name: str, motions: Sequence[np.ndarray], size: tuple, spp: int, against: str, **defines) -> list:
    """Render the frames of one panel: a scene of ``scenes/``, its learned plugins replaced by those of ``against``.

    Returns linear images of ``size`` (width, height).
    """
    defines |= {"spp": spp, "width": size[0], "height": size[1]}
    options = {"exact": True, "against": against} if against else {}
    scene = loading.load(SCENES / f"{name}.xml", defines, **options)
    with progress_bar(f"{name} {against}".rstrip(), len(motions), "frame", True) as bar:
        return rendering.along(scene, motions, new_seeds=True, on_frame=bar.update)


def floor(motions: Sequence[np.ndarray], against: str = "", spp: int = SAMPLES) -> list[np.ndarray]:
    """Render a panel of ``horizon.xml``."""
    return [films.displayed(image) for image in linear("horizon", motions, SIZE, spp, against, max_depth=3)]


def metal(file: str, frames: int, spp: int = 1, against: str = "") -> list[np.ndarray]:
    """Render a panel of hammered metal under lights without noise, the sum of a render under each; enlarged pixels."""
    small, options = (SIZE[0] // 2, SIZE[1] // 2), {"metal": file, "sky": 0, "max_depth": 2}
    lit = (np.array(linear("rust", swing(8.0, frames), small, spp, against, **options, **light)) for light in LIGHTS)
    return [films.displayed(EXPOSURE * image).repeat(2, axis=0).repeat(2, axis=1) for image in sum(lit)]


def orbit(frames: int) -> Film:
    """Render an orbit through the pillars of ``horizon.xml``, of three times as many frames."""
    around = rotations(120 * i / frames for i in range(3 * frames))
    panels = {
        f"bitmap, {SAMPLES} samples a pixel": floor(around, "exact"),
        f"mipmap, {SAMPLES} samples a pixel": floor(around, "mipmap"),
        f"neural_texture, {SAMPLES} samples a pixel": floor(around),
        f"truth, {TRUTH} samples a pixel": floor(around, "exact", TRUTH),
    }
    return Film(panels, 2, ["tiles_filtered.npz"], returns=False)


def shading(frames: int) -> Film:
    """Render hammered metal, by textures and by one that is trained for its shading."""
    panels = {
        "bitmap, 1 sample a pixel": metal("rust_plain.npz", frames, against="exact"),
        "filtered maps, 1 sample a pixel": metal("rust_plain.npz", frames),
        "trained for shading, 1 sample a pixel": metal("rust_shaded.npz", frames),
        f"truth, {TRUTH} samples a pixel": metal("rust_plain.npz", frames, spp=TRUTH, against="exact"),
    }
    return Film(panels, 2, ["rust_plain.npz", "rust_shaded.npz"])


def tiled_plane(
    scene: renders.TextureScene, size, poses_at: Callable[[tuple], list], textures: dict[str, tuple]
) -> Panels:
    """Render panels of tiles on a plane in a light without noise.

    ``poses_at(repeats)`` returns (origin, target) of the camera in each frame, given how often the tiles repeat along u
    and v. ``textures`` holds (plugin, samples a pixel, sampler) by label.
    """
    side, panels = mi.Bitmap(str(TILES)).size()[0], {}
    repeats = scene.repeats(size, (side, side))
    for label, (texture, spp, sampler) in textures.items():
        plugin = lambda repeats, texture=texture: texture | {"to_uv": renders.to_uv(repeats)}  # noqa: E731
        loaded = renders.TextureReader(plugin, spp, sampler).loaded(scene, size, (side, side))
        parameters, panels[label] = mi.traverse(loaded), []
        for k, (origin, target) in enumerate(poses_at(repeats)):
            parameters["sensor.to_world"] = mi.Transform4f().look_at(origin=origin, target=target, up=(0.0, 1.0, 0.0))
            parameters.update()
            loading.attach(loaded)
            image = renders.displayed(mi.render(loaded, spp=spp, seed=k))
            panels[label].append(np.round(255 * image).astype(np.uint8))
    return panels


def flight(frames: int) -> Film:
    """Render the README's film, a flight over one repetition of the tiles, of twice as many frames."""
    scene = dataclasses.replace(
        renders.still_scenes()["plane"], name="flight", target=(0.0, 0.7, -1.0), fov=50.0, texels=1.0
    )

    def poses_at(repeats) -> list:
        steps = np.linspace(0, PLANE / repeats[1], 2 * frames, endpoint=False).tolist()
        return [((0.0, 1.0, -z), (0.0, 0.7, -1.0 - z)) for z in steps]

    maps = [mi.Bitmap(str(path)) for path in sorted(ASSETS.glob("tiles_*.png"))]
    raw = sum(np.array(bitmap).size for bitmap in maps)
    size = (ASSETS / "tiles_filtered.npz").stat().st_size
    textures = {
        f"bitmap, 1 sample a pixel, maps of {raw / 1e6:.2f} MB": (BITMAP, 1, "independent"),
        f"neural_texture, 1 sample a pixel, file of {size / 1e6:.2f} MB": (LEARNED, 1, "independent"),
    }
    return Film(tiled_plane(scene, (400, 225), poses_at, textures), 2, ["tiles_filtered.npz"], returns=False)


def zoom(frames: int) -> Film:
    """Render a zoom into the tiles: the distance of the camera decreases by the same factor each frame, to its half."""
    origin, target = np.array([0.0, 2.0, 2.0]), (0.0, 0.0, 0.0)
    scene = dataclasses.replace(
        renders.still_scenes()["plane"], name="zoom", origin=tuple(origin), target=target, fov=40.0, texels=100.0,
        anchor=(0.5, 0.5),
    )  # fmt: skip
    textures = {
        "bitmap, 1 sample a pixel": (BITMAP, 1, "independent"),
        "mipmap, 1 sample a pixel": (BITMAP | {"type": "mipmap", "filter": "anisotropic"}, 1, "independent"),
        "neural_texture, 1 sample a pixel": (LEARNED, 1, "independent"),
        f"truth, {TRUTH} samples a pixel": (BITMAP, TRUTH, "multijitter"),
    }
    places = [(origin * 2 ** (-k / max(frames - 1, 1))).tolist() for k in range(frames)]
    panels = tiled_plane(scene, SIZE, lambda repeats: [(place, target) for place in places], textures)
    return Film(panels, 2, ["tiles_filtered.npz"])


#: Films by name.
FILMS = {"flight": flight, "zoom": zoom, "orbit": orbit, "shading": shading}


def psnr(panels: Panels) -> dict[str, float]:
    """Return the PSNR of all frames together of each panel against the panel "truth", if there is one."""
    truth = next((np.stack(panel).astype(float) for label, panel in panels.items() if label.startswith("truth")), None)
    if truth is None:
        return {}
    errors = {label: np.mean((np.stack(panel) - truth) ** 2) / 255**2 for label, panel in panels.items()}
    return {label: float(-10 * np.log10(error)) for label, error in errors.items() if not label.startswith("truth")}


def beside(panels: Panels, columns: int) -> list[np.ndarray]:
    """Return the frames of panels of one size as those of one film, ``columns`` panels in a row, labels above."""
    import matplotlib
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.truetype(str(Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")), TEXT)
    height, width, _ = next(iter(panels.values()))[0].shape
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (columns * (width + GAP) - GAP, rows * (height + LABEL)), PAPER)
    corners = [(i % columns * (width + GAP), i // columns * (height + LABEL)) for i in range(len(panels))]
    for (x, y), label in zip(corners, panels, strict=True):
        ImageDraw.Draw(sheet).text((x + width / 2, y + LABEL / 2), label, fill=INK, font=font, anchor="mm")
    frames = []
    for together in zip(*panels.values(), strict=True):
        frames.append(np.array(sheet))
        for (x, y), image in zip(corners, together, strict=True):
            frames[-1][y + LABEL : y + LABEL + height, x : x + width] = image
    return frames


def make(name: str, frames: int, out: Path, json_folder: Path | None) -> None:
    """Render a film and write it."""
    film = FILMS[name](frames)
    shown = beside(film.panels, film.columns)
    rendered_frames = len(shown)
    if film.returns:
        shown += shown[-2:0:-1]
    seconds, files = len(shown) / RATE, [out / f"{name}.{extension}" for extension in ("webp", "mp4", "jpg")]
    films.write(files[0], shown, seconds, quality=60)
    films.write(files[1], shown, seconds, quality=23)
    mi.Bitmap(shown[0]).write(str(files[2]), quality=85)
    height, width, _ = shown[0].shape
    figures = {
        "command": f"python docs/make_films.py {name} --frames {frames}",
        "width": width, "height": height, "frames": len(shown), "frames_rendered": rendered_frames,
        "frames_per_second": RATE, "variant": mi.variant(), "psnr_db": psnr(film.panels),
        "table_file_bytes": {file: (ASSETS / file).stat().st_size for file in film.files},
        "bytes": {file.suffix[1:]: file.stat().st_size for file in files},
    }  # fmt: skip
    print(name, figures["bytes"], figures["psnr_db"])
    if json_folder:
        write_json(json_folder / f"film_{name}.json", figures)


def main() -> None:
    """Write the films."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"films: {', '.join(FILMS)} (default: all)")
    parser.add_argument("--frames", type=int, default=20, help="frames that are rendered of each (default: 20)")
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
        make(name, arguments.frames, arguments.out, arguments.json)


if __name__ == "__main__":
    main()
