"""Campaigns: many damaged files through one limited child, counted by outcome. Tests and ``run.py`` share them."""

from __future__ import annotations

import json
import shutil
import zlib
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import captures
import damage
import numpy as np
import solid_meshes
from hypothesis import given
from hypothesis.strategies import SearchStrategy
from limited_child import FAULTS, GOOD, LimitedChild
from PIL import Image
from trial_files import CHECKPOINT, all_seeds


class Target(NamedTuple):
    """A sort of file: the probe that reads ``path`` among valid ``files`` (by name), and how they are damaged.

    ``mutants``: form ("structured" or "raw") → name of the damaged file, and the strategy of its
    :class:`damage.Mutant`. ``arguments``: further ones of the probe.
    """

    probe: str
    path: str
    files: dict[str, bytes]
    mutants: dict[str, tuple[str, SearchStrategy]]
    arguments: dict

    def write(self, folder: Path, file: str, mutant: damage.Mutant) -> dict:
        """Write the files, one of them damaged, to ``folder``, and return the arguments of the probe."""
        shutil.rmtree(folder / "mutant", ignore_errors=True)
        for name, data in {**self.files, file: mutant.data}.items():
            path = folder / "mutant" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        untouched = {"untouched": mutant.untouched} if self.probe == "table" else {}
        return {"path": f"mutant/{self.path}", **self.arguments, **untouched}


def run(child, name: str, target: Target, form: str, examples: int, share=1, seed=0) -> dict:
    """Send ``examples`` mutants through the child; return the figures.

    Of the table files that load, one in ``share`` is decoded and rendered. The figures are numbers of outcomes and, by
    exception and line, the message and the lies of the first file of each fault.
    """
    outcomes, faults = Counter(), {}
    file, strategy = target.mutants[form]

    @damage.hostile(examples, seed)
    @given(mutant=strategy)
    def each(mutant):
        request = target.write(child.folder, file, mutant)
        if target.probe == "table":
            request["evaluate"] = zlib.crc32(mutant.data) % share == 0
        answer = child.check(target.probe, **request)
        outcome, message = answer["outcome"], answer["message"]
        outcomes[outcome] += 1
        if outcome in FAULTS:
            end = message.rpartition(" (")[2] if outcome == "traceback" else ""
            key = f"{outcome} {message.partition(':')[0][:40]} {end}".strip()
            faults.setdefault(key, [message, mutant.lies])

    each()
    counted = {outcome: outcomes[outcome] for outcome in (*GOOD, *FAULTS)}
    return {"recipes": form, "target": name, "mutants": outcomes.total(), **counted, "faults": faults}


def single(probe: str, name: str, data: bytes, structured=None, **arguments) -> Target:
    """Return a target of one file; ``structured`` is a strategy of mutants, by default of other words."""
    if structured is None:
        structured = damage.mutants(data, (damage.other_word,))
    mutants = {"structured": (name, structured), "raw": (name, damage.mutants(data))}
    return Target(probe, name, {name: data}, mutants, arguments)


def folder(probe: str, path: str, files: dict[str, bytes], description: str, picture: str) -> Target:
    """Return a target of a folder, of which a JSON file and a picture are damaged."""
    content = damage.json_mutants(json.loads(files[description]))
    mutants = {"structured": (description, content), "raw": (picture, damage.mutants(files[picture]))}
    return Target(probe, path, files, mutants, {})


def views(child: LimitedChild) -> Target:
    """Return a capture of 4 pictures of 8 × 8 pixels as a target."""
    source = captures.write(child.folder / "valid_views", 4, 1, 8)
    files = {path.name: path.read_bytes() for path in source.iterdir()}
    content = json.loads(files["transforms_train.json"])
    content |= {"aabb": [[-1, -1, -1], [1, 1, 1]], "fl_x": 12.0, "fl_y": 12.0, "cx": 4.0, "cy": 4.0, "w": 8, "h": 8}
    files["transforms_train.json"] = damage.dump(content)
    return folder("capture", "", files, "transforms_train.json", "train_0.png")


def manifest(child: LimitedChild) -> Target:
    """Return the manifest of three maps as a target."""
    path = child.folder / "colour.png"
    Image.fromarray(np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)).save(path)
    colour = {"file": "colour.png", "color_space": "srgb"}
    maps = {"base_color": colour, "normal": "normal.png", "roughness": {"file": "colour.png", "channels": [0]}}
    files = {"maps.json": damage.dump({"maps": maps}), **dict.fromkeys(("colour.png", "normal.png"), path.read_bytes())}
    return folder("manifest", "maps.json", files, "maps.json", "colour.png")


def gaussians() -> bytes:
    """Return 8 Gaussians as a PLY file."""
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 8", *(f"property float {n}" for n in names)]
    values = np.random.default_rng(1).normal(0, 0.5, (8, len(names))).astype("<f4")
    return "\n".join([*lines, "end_header\n"]).encode() + values.tobytes()


#: Names of all targets: table files, and others.
TABLES = list(all_seeds())
OTHERS = [
    "capture",
    "manifest",
    *(f"mesh .{suffix}" for suffix in ("obj", "ply", "off", "stl")),
    "splats",
    "checkpoint",
]


def target(name: str, child: LimitedChild) -> Target:
    """Return a target by its name: a small table file, one of the other files, or a ball in a format of meshes."""
    match name.split():
        case ["capture"]:
            return views(child)
        case ["manifest"]:
            return manifest(child)
        case ["mesh", suffix]:
            path = solid_meshes.write(child.folder / f"valid{suffix}", solid_meshes.sphere(4, 0.8))
            return single("mesh", f"mutant{suffix}", path.read_bytes())
        case ["splats"]:
            return single("splats", "mutant.ply", gaussians())
        case ["checkpoint"]:
            data = CHECKPOINT.read_bytes()
            return single("checkpoint", "mutant.npz", data, damage.archive_mutants(data))
    path = all_seeds()[name]
    data = path.read_bytes()
    return single("table", "table.npz", data, damage.archive_mutants(data), original=str(path))
