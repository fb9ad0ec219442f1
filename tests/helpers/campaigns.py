"""Campaigns: many damaged files through one limited child, counted by outcome. Tests and ``run.py`` share them."""

from __future__ import annotations

import json
import shutil
import zlib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import captures
import hostile_files
import hostile_strategies as strategies
import numpy as np
import solid_meshes
from hypothesis import given
from limited_child import FAULTS, GOOD, LimitedChild
from trial_files import all_seeds


@dataclass
class Target:
    """A sort of file: how a recipe damages it, what recipes there are, and the probe that reads it.

    ``write(folder, recipe)`` writes the damaged file and returns the arguments of the ``probe``.
    """

    name: str
    probe: str
    structured: object
    raw: object
    write: object


@dataclass
class Campaign:
    """Outcomes of the mutants of one target."""

    target: str
    outcomes: Counter = field(default_factory=Counter)
    faults: dict[str, list] = field(default_factory=dict)

    def add(self, answer: dict, recipe: list) -> None:
        """Count an answer; of each fault, the shortest recipe is kept."""
        outcome, message = answer["outcome"], answer["message"]
        self.outcomes[outcome] += 1
        if outcome in FAULTS:
            # One entry a place: exception and line, without the numbers of this mutant
            end = message.rpartition(" (")[2] if outcome == "traceback" else ""
            key = f"{outcome} {message.partition(':')[0][:40]} {end}".strip()
            if key not in self.faults or len(json.dumps(recipe)) < len(json.dumps(self.faults[key][1])):
                self.faults[key] = [message, recipe]

    def figures(self) -> dict:
        """Return the figures for JSON."""
        counted = {name: self.outcomes[name] for name in (*GOOD, *FAULTS)}
        return {"target": self.target, "mutants": self.outcomes.total(), **counted, "faults": self.faults}


def run(
    child: LimitedChild, target: Target, recipes, examples: int, spare=lambda: True, share: int = 1, seed: int = 0
) -> Campaign:
    """Send ``examples`` mutants through the child, as long as ``spare()`` says that there is time.

    Of the table files that load, one in ``share`` is decoded and rendered.
    """
    campaign = Campaign(target.name)

    @strategies.hostile(examples, seed)
    @given(recipe=recipes)
    def each(recipe):
        if spare():
            request = target.write(child.folder, recipe)
            if target.probe == "table":
                request["evaluate"] = zlib.crc32(json.dumps(recipe).encode()) % share == 0
            campaign.add(child.check(target.probe, **request), recipe)

    each()
    return campaign


# -- table files -------------------------------------------------------------------------------------------------------


def tables() -> dict[str, Target]:
    """Return the small table files of all tasks as targets."""

    def target(name: str, path: Path) -> Target:
        data = path.read_bytes()

        def write(folder: Path, recipe: list) -> dict:
            changed, untouched = hostile_files.damaged(data, recipe)
            (folder / "mutant.npz").write_bytes(changed)
            return {"path": "mutant.npz", "original": str(path), "untouched": untouched}

        structured = strategies.archive_recipes(hostile_files.Archive.read(path))
        return Target(name, "table", structured, strategies.byte_recipes(), write)

    return {name: target(name, path) for name, (_, path) in all_seeds().items()}


# -- other files -------------------------------------------------------------------------------------------------------


def views(folder: Path) -> Target:
    """Return a capture of 4 × 8 × 6 pixels as a target: its list of views, or one of its images, is damaged."""
    source = folder / "valid_views"
    if not source.is_dir():
        captures.write(source, 4, 1, 8)
    path = source / "transforms_train.json"
    content = json.loads(path.read_text())
    content |= {"aabb": [[-1, -1, -1], [1, 1, 1]], "fl_x": 12.0, "fl_y": 12.0, "cx": 4.0, "cy": 4.0, "w": 8, "h": 8}
    image = (source / "train_0.png").read_bytes()

    def write(folder: Path, recipe: list) -> dict:
        copied = folder / "views"
        shutil.rmtree(copied, ignore_errors=True)
        shutil.copytree(source, copied)
        in_json = [step for step in recipe if step[0] in hostile_files.STEPS]
        in_bytes = [step for step in recipe if step[0] in hostile_files.BYTE_STEPS]
        _write_json(copied / path.name, hostile_files.json_steps(content, in_json))
        (copied / "train_0.png").write_bytes(hostile_files.damaged_bytes(image, in_bytes))
        return {"path": "views"}

    return Target("capture", "capture", strategies.json_recipes(content), strategies.byte_recipes(), write)


def manifests(folder: Path) -> Target:
    """Return the manifest of two maps as a target: the manifest, or one of its images, is damaged."""
    from PIL import Image

    source = folder / "valid_maps"
    source.mkdir(exist_ok=True)
    pixels = np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    for name in ("colour", "normal"):
        Image.fromarray(pixels).save(source / f"{name}.png")
    content = {
        "maps": {
            "base_color": {"file": "colour.png", "color_space": "srgb"},
            "normal": "normal.png",
            "roughness": {"file": "colour.png", "channels": [0]},
        }
    }
    image = (source / "colour.png").read_bytes()

    def write(folder: Path, recipe: list) -> dict:
        copied = folder / "maps"
        shutil.rmtree(copied, ignore_errors=True)
        shutil.copytree(source, copied)
        in_json = [step for step in recipe if step[0] in hostile_files.STEPS]
        in_bytes = [step for step in recipe if step[0] in hostile_files.BYTE_STEPS]
        _write_json(copied / "maps.json", hostile_files.json_steps(content, in_json))
        (copied / "colour.png").write_bytes(hostile_files.damaged_bytes(image, in_bytes))
        return {"path": "maps/maps.json"}

    return Target("manifest", "manifest", strategies.json_recipes(content), strategies.byte_recipes(), write)


def _write_json(path: Path, content) -> None:
    text = content if isinstance(content, bytes) else json.dumps(content).encode("utf-8", "replace")
    path.write_bytes(text)


def meshes(folder: Path, suffix: str) -> Target:
    """Return a ball in a format as a target: words of a text format, bytes of others."""
    source = solid_meshes.write(folder / f"valid{suffix}", solid_meshes.sphere(4, 0.8))
    return _bytes_target(f"mesh {suffix}", "mesh", source, suffix)


def gaussians(folder: Path) -> Target:
    """Return 8 Gaussians in a PLY file as a target."""
    source = folder / "valid_splats.ply"
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 8", *(f"property float {n}" for n in names)]
    values = np.random.default_rng(1).normal(0, 0.5, (8, len(names))).astype("<f4")
    source.write_bytes("\n".join([*lines, "end_header\n"]).encode() + values.tobytes())
    return _bytes_target("splats", "splats", source, ".ply")


def _bytes_target(name: str, probe: str, source: Path, suffix: str) -> Target:
    data = source.read_bytes()

    def write(folder: Path, recipe: list) -> dict:
        (folder / f"mutant{suffix}").write_bytes(hostile_files.damaged_bytes(data, recipe))
        return {"path": f"mutant{suffix}"}

    return Target(name, probe, strategies.text_recipes(), strategies.byte_recipes(), write)


def checkpoints(child: LimitedChild) -> Target:
    """Return the checkpoint of a short training as a target."""
    child.check("checkpoint", path="valid_checkpoint.npz", write=True)
    source = child.folder / "valid_checkpoint.npz"
    data = source.read_bytes()

    def write(folder: Path, recipe: list) -> dict:
        changed, _ = hostile_files.damaged(data, recipe)
        (folder / "mutant.npz").write_bytes(changed)
        return {"path": "mutant.npz"}

    structured = strategies.archive_recipes(hostile_files.Archive.read(source))
    return Target("checkpoint", "checkpoint", structured, strategies.byte_recipes(), write)


#: Targets beside table files: name → function of the child.
OTHERS = {
    "capture": lambda child: views(child.folder),
    "manifest": lambda child: manifests(child.folder),
    "mesh .obj": lambda child: meshes(child.folder, ".obj"),
    "mesh .ply": lambda child: meshes(child.folder, ".ply"),
    "mesh .off": lambda child: meshes(child.folder, ".off"),
    "mesh .stl": lambda child: meshes(child.folder, ".stl"),
    "splats": lambda child: gaussians(child.folder),
    "checkpoint": checkpoints,
}
