"""Names of maps, and of folders of their images, as programs and libraries of textures write them."""

import itertools
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import reason
from ..core.files import shown
from .entries import SEVERAL, Content, ImageFiles, MapEntry, SourceError, equal, transparent

#: Words before the others that name a further lobe: its colour is no albedo, its roughness not that of the material.
LOBES = {
    *("sheen", "specular", "spec", "coat", "clearcoat", "emission", "emissive", "subsurface", "transmission", "detail"),
    *("fuzz", "edge", "attenuation", "iridescence", "film", "volume"),
}

#: Words at the end that say nothing of the content, beside numbers and resolutions.
IGNORED = {"map", "texture", "tex", "jpg", "jpeg", "png", "exr", "tif", "tiff", "tga", "lod", "var", "udim"}

_WORD = re.compile(r"\d+[kK](?![a-zA-Z])|[dD]3[dD]|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


_NORMALS = ("normal", "normals", "normalmap", "nrm", "nor", "norm", "nm")

#: Content → names of maps. Normal maps may have an end that tells whether y points down, as in DirectX.
_NAMES = {
    Content("albedo", colours=True): "albedo basecolor basecolour base basemap diff diffuse diffusecolor diffusecolour "
    "color colour col maintex albedotransparency bc",
    Content("roughness"): "roughness rough specularroughness",
    Content("ao"): "ao occlusion ambientocclusion mixedao",
    Content("metallic"): "metallic metalness metal basemetalness",
    Content("other", colours=True): "emissive emission emit translucency speccolor specularcolor",
    Content("other"): "data mask height disp displacement bump cavity curvature thickness spec specular anisotropy "
    "transmission parallax refl",
    Content("other", parts="opacity"): "alpha opacity",
    Content("other", parts="smoothness"): "gloss glossiness smoothness",
    Content("other", parts="ao roughness metallic"): "arm orm occlusionroughnessmetallic occlusionroughmetal",
    Content("other", parts="roughness metallic ao"): "rma",
    Content("other", parts="metallic roughness ao"): "mra mro",
    Content("other", parts="- roughness metallic"): "metallicroughness metalrough",
    Content("other", parts="metallic - - smoothness"): "metallicsmoothness metallicgloss",
    Content("other", parts="metallic ao - smoothness"): "maskmap",
    **{
        Content("normal", y_down=down): " ".join(name + end for name in _NORMALS for end in ends)
        for down, ends in ((False, ("", "gl", "ogl", "opengl")), (True, ("dx", "directx", "d3d")))
    },
}
_CONTENTS = {name: content for content, names in _NAMES.items() for name in names.split()}

#: Letters that are names of maps in folders alone.
LETTERS = {"n": "normal", "r": "roughness", "m": "maskmap"}

#: Most words of a name of :data:`_CONTENTS`.
_LONGEST = 4


def content_of(name: str) -> Content | None:
    """Return the content of a map by its name, or by the name of its file without an extension; ``None`` if unknown."""
    return _parse(name)[0]


def _parse(name: str, letters: bool = False) -> tuple[Content | None, int, int]:
    """Return the content of a map, and where the words that name it begin and end; with ``letters``, one suffices."""
    matches = list(_WORD.finditer(name))
    words = [match[0].lower() for match in matches]
    for ignored in (False, True):  # "maskmap" is a name, the "map" of "normal_map" is not
        while ignored and words and (words[-1] in IGNORED or words[-1][0].isdigit()):
            words.pop()
        for count in range(min(_LONGEST, len(words)), 0, -1):
            text = "".join(words[-count:])
            text = LETTERS.get(text, text) if letters else text
            content = _CONTENTS.get(text) or _CONTENTS.get(text.removesuffix("texture").removesuffix("map"))
            if content is not None:
                further = LOBES.intersection(words[:-count])
                content = Content("other", content.colours) if further else content
                return content, matches[len(words) - count].start(), matches[len(words) - 1].end()
    return None, len(name), len(name)


# ---------------------- Folders ----------------------

#: Extensions of images that are read, the most exact first, and of others that textures have.
IMAGES = (".exr", ".hdr", ".pfm", ".png", ".tga", ".bmp", ".jpg", ".jpeg")
OTHERS = (".tif", ".tiff", ".dds", ".ktx", ".ktx2", ".webp", ".psd", ".tx", ".basis")

#: Maps of a material, in their order.
ORDER = ("albedo", "normal", "roughness", "metallic", "ao", "opacity")

#: Words of images that show a material.
PREVIEWS = {"preview", "thumb", "thumbnail", "render", "sphere", "ball", "cube", "plane", "icon"}

#: Most files of a folder.
MOST_FILES = 10_000

_RESOLUTION = re.compile(r"(\d+)k|(256|512|1024|2048|4096|8192)(?:x\2)?", re.IGNORECASE)


@dataclass(frozen=True)
class _FolderImage:
    """Image of a folder that may be a map.

    ``rank`` is 0 for the map itself, larger for what it follows from. ``words``: name of the material, and what stands
    behind the name of the map, without ``resolution`` (0: unknown).
    """

    entry: MapEntry
    rank: int
    resolution: int
    words: tuple[tuple[str, ...], tuple[str, ...]]

    @property
    def file(self) -> str:
        return Path(self.entry.file).name


def read_folder(folder: Path, images: ImageFiles) -> tuple[list[MapEntry], list[str]]:
    """Return the maps of a folder by the names of its images, and notes on files that are not used.

    Raises :class:`SourceError` if no image has the name of a map, and if it is not clear which image is a map.
    """
    try:
        names = sorted(os.listdir(folder))
    except OSError as e:
        raise SourceError(f"{shown(folder)}: cannot be read ({reason(e)})") from None
    if len(names) > MOST_FILES:
        raise SourceError(f"{shown(folder)}: has {len(names):,} files, at most {MOST_FILES:,} are looked at")
    groups, notes = {}, []
    for name in names:
        candidates, why = _candidates(folder, name, images)
        notes += [f"{name}: not used, {why}"] if why else []
        for candidate in candidates:
            groups.setdefault(candidate.entry.name, []).append(candidate)
    try:
        chosen = {name: _choose(folder, groups[name]) for name in ORDER if name in groups}
        _check_material(folder, list(chosen.values()))
    except SourceError as e:
        several = [name for name in names if Path(name).suffix.lower() in SEVERAL]
        raise SourceError(f"{e}{f', or name {several[0]}' if several else ''}") from None
    for name, best in chosen.items():
        others = [candidate for candidate in groups[name] if candidate is not best]
        channels = [f"{c.file}{f' ({c.entry.channels})' if c.entry.channels else ''}" for c in others]
        notes += [f"{channel}: not used, {best.file} is taken for {name}" for channel in channels]
    entries = [candidate.entry for candidate in chosen.values()]
    return _with_alpha(folder, entries, images, notes), notes


def _check_material(folder: Path, chosen: list[_FolderImage]) -> None:
    """Raise :class:`SourceError` if there are no maps, or the names before them are those of several materials."""
    if not chosen:
        advice = _advice([MapEntry("albedo", "FILE.png")])
        raise SourceError(f"{shown(folder)}: is a folder without an image that has the name of a map: {advice}")
    materials = sorted({candidate.words[0] for candidate in chosen}, key=lambda words: (len(words), words))
    for shorter, longer in itertools.pairwise(materials):
        if longer[: len(shorter)] != shorter:
            both = " and ".join(f'"{" ".join(words)}"' for words in (shorter, longer))
            entries = [c.entry for c in chosen if c.words[0] == longer[: len(c.words[0])]]
            raise SourceError(f"{shown(folder)}: holds maps of several materials, {both}: {_advice(entries)}")


def _candidates(folder: Path, name: str, images: ImageFiles) -> tuple[list[_FolderImage], str]:
    """Return the maps that a file may be, and why it is none ("" for files that are no images)."""
    stem, suffix = os.path.splitext(name)
    if suffix.lower() not in IMAGES or name.startswith("."):
        return [], f"files {suffix.lower()} are not read" if suffix.lower() in OTHERS else ""
    content, start, end = _parse(stem, letters=True)
    tokens = [re.split(r"[\W_]+", text.casefold()) for text in (stem[:start], stem[end:])]
    if content is None:
        return [], "a preview" if PREVIEWS.intersection(*tokens[:1]) else "its name is that of no map"
    file = images.find(folder, name, folder)
    if content.parts.startswith("metallic") and stem[start:end].casefold() == "m":
        picture = images.read(file)
        if not picture.has_alpha:
            if picture.colors > 1 and not equal(picture.values):
                masks = [MapEntry("metallic", name, channels="r"), MapEntry("ao", name, channels="g")]
                raise SourceError(f"{Path(file)}: may be a metallic map or one of several masks: {_advice(masks)}")
            content = Content("metallic")
    parts = content.parts.split() or ([] if content.role == "other" else [content.role])
    if not parts:
        return [], "the BRDF has no such parameter"
    sizes = [int(m[1] or 0) * 1024 or int(m[2]) for m in map(_RESOLUTION.fullmatch, tokens[0] + tokens[1]) if m]
    words = tuple(
        tuple(word for word in part if word and word not in IGNORED and not _RESOLUTION.fullmatch(word))
        for part in tokens
    )
    candidates = []
    for letter, part in zip("rgba", parts, strict=False):
        target = "roughness" if part == "smoothness" else part
        entry = MapEntry(
            target, file, content if content.role == target else None, letter if content.packed else None,
            inverted=part == "smoothness", opaque=True, single=target not in ("albedo", "normal"),
        )  # fmt: skip
        rank = 2 * content.packed + (entry.inverted or content.y_down)
        candidates += [] if part == "-" else [_FolderImage(entry, rank, max(sizes, default=0), words)]
    return candidates, ""


def _choose(folder: Path, group: list[_FolderImage]) -> _FolderImage:
    """Return the best image for a map. Raises :class:`SourceError` if two differ in more than size and format."""
    least = min(candidate.rank for candidate in group)
    group = [candidate for candidate in group if candidate.rank == least]
    other = next((candidate for candidate in group if candidate.words != group[0].words), None)
    if other is not None:
        both = f"{group[0].file} and {other.file}"
        raise SourceError(f"{shown(folder)}: {both} may both be the {group[0].entry.name}: {_advice([group[0].entry])}")
    return min(group, key=lambda c: (-c.resolution, IMAGES.index(Path(c.file).suffix.lower())))


def _with_alpha(folder: Path, entries: list[MapEntry], images: ImageFiles, notes: list[str]) -> list[MapEntry]:
    """Return the maps with the alpha of the albedo as opacity, and add ``notes`` on any other alpha."""
    names = {entry.name for entry in entries}
    for entry in list(entries):
        file, picture = Path(entry.file).name, images.read(entry.file)
        if entry.channels is not None and picture.colors == 1 and not picture.has_alpha:
            raise SourceError(f"{shown(folder)}: {file} has one channel, several are needed: {_advice([entry])}")
        if entry.channels is not None or not transparent(picture):
            continue
        if entry.name == "albedo" and "opacity" not in names:
            entries.append(MapEntry("opacity", entry.file, channels="a"))
        elif entry.name == "metallic" and "roughness" not in names:
            smooth = MapEntry("roughness", entry.file, channels="a", inverted=True)
            advice = _advice([MapEntry("metallic", entry.file, channels="r"), smooth])
            raise SourceError(f"{shown(folder)}: the alpha of {file} may be a smoothness: {advice}")
        else:
            notes.append(f"{file} (a): not used, the alpha of the {entry.name}")
    return entries


def _advice(entries: list[MapEntry]) -> str:
    """Return the end of a sentence that shows a manifest of some maps."""
    names = {"normal": "normal_dx"} if any(e.content and e.content.y_down for e in entries) else {}
    maps = {names.get(entry.name, entry.name): entry.to_json() for entry in entries}
    return f"write a manifest there, as in {json.dumps({'maps': maps}, ensure_ascii=False)}"
