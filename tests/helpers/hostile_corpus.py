"""Corpus of everything that ever failed, as recipes: ``write(folder)`` writes the files and returns a request.

Large files are recipes, tiny ones lie in ``tests/trust/corpus``.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import captures
import hostile_files
import numpy as np
from hostile_files import Archive, header, png
from trial_files import all_seeds

CORPUS = Path(__file__).resolve().parents[1] / "trust" / "corpus"


@dataclass(frozen=True)
class Case:
    """One file, or command line, that failed: ``outcomes`` are those that are right."""

    write: Callable[[Path], tuple[str, dict]]
    outcomes: tuple[str, ...] = ("refused",)


CASES: dict[str, Case] = {}


def case(name: str, *outcomes: str):
    """Add a function to the corpus."""

    def add(write):
        CASES[name] = Case(write, outcomes or ("refused",))
        return write

    return add


def recipe(name: str, seed: str, *steps: list, outcomes: tuple[str, ...] = ("refused",)) -> None:
    """Add a recipe of damage to a small valid file."""

    def write(folder: Path) -> tuple[str, dict]:
        path = all_seeds()[seed][1]
        changed, untouched = hostile_files.damaged(path.read_bytes(), list(steps))
        (folder / "mutant.npz").write_bytes(changed)
        return "table", {"path": "mutant.npz", "original": str(path), "untouched": untouched}

    CASES[name] = Case(write, outcomes)


def refused_command(name: str, *arguments: str) -> None:
    """Add a command line that has to be refused."""
    CASES[name] = Case(lambda folder: ("command", {"arguments": list(arguments)}))


# -- memory and time by small files ------------------------------------------------------------------------------------

#: Bytes that a member of a bomb holds. 64 MiB and 20 times the file's size may be taken.
BOMB = 160 << 20


def large_member(path: Path, archive: Archive, name: str, start: bytes, filling: bytes, size: int = BOMB) -> None:
    """Write an archive one of whose members goes on for ``size`` bytes with a repeated ``filling``."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for member, data in archive.members():
            if member != f"{name}.npy":
                file.writestr(member, data)
        with file.open(f"{name}.npy", "w", force_zip64=True) as stream:
            stream.write(start)
            chunk = filling * ((1 << 20) // len(filling))
            for _ in range(size // len(chunk)):
                stream.write(chunk)


def ggx_archive() -> Archive:
    """Return the small file of the task ``ggx``."""
    return Archive.read(all_seeds()["ggx_small"][1])


def opened(folder: Path) -> tuple[str, dict]:
    """Return the request that opens ``mutant.npz``, of which no array has to be as before."""
    return "table", {"path": "mutant.npz", "original": str(all_seeds()["ggx_small"][1]), "untouched": []}


@case("entries of one bit")
def _(folder):
    archive, count = ggx_archive(), 8 * BOMB
    archive.meta["arrays"]["primary"] |= {
        "shape": [count // 2**13, 2**12, 2], "storage": "uint8", "scale": [1.0, 1.0], "offset": [0.0, 0.0], "bits": 1,
    }  # fmt: skip
    large_member(folder / "mutant.npz", archive, "primary", header([BOMB], "|u1"), b"\0", BOMB)
    return opened(folder)


@case("a large description")
def _(folder):
    archive = ggx_archive()
    text = json.dumps(archive.meta)[:-1] + ', "more": [0'
    filling, size = b",0", BOMB // 4
    start = header([len(text) + size + 2], "|u1") + text.encode()
    path = folder / "mutant.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
        for member, data in archive.members():
            if member != "meta.npy":
                file.writestr(member, data)
        file.writestr("meta.npy", start + filling * (size // 2) + b"]}")
    return opened(folder)


@case("a large array of zeros")
def _(folder):
    archive, sides = ggx_archive(), [BOMB // 4 // 2**12, 2**11, 2]
    archive.meta["arrays"]["primary"]["shape"] = sides
    large_member(folder / "mutant.npz", archive, "primary", header(sides, "<f4"), b"\0")
    return opened(folder)


recipe("a member compressed by bzip2", "ggx_small", ["method", "primary", 12])
recipe("a member compressed by LZMA", "ggx_small", ["method", "primary", 14])


@case("a distance field of empty regions")
def _(folder):
    path = all_seeds()["sdf_sparse"][1]
    archive = Archive.read(path)
    regions = np.zeros((192, 192, 192, 1), np.uint8)
    regions[:2, :2, :2] = archive.arrays["regions"]
    archive.arrays["regions"], archive.meta["arrays"]["regions"]["shape"] = regions, list(regions.shape)
    (folder / "mutant.npz").write_bytes(archive.write())
    return "table", {"path": "mutant.npz", "original": str(path), "untouched": []}


@case("a radiance field of a large empty grid")
def _(folder):
    path, side = all_seeds()["field_grid"][1], 600
    archive = Archive.read(path)
    archive.meta["settings"]["shape"] = [side] * 3
    arrays = {
        "cells": np.zeros((side**3 // 8, 1), np.uint8),
        "density": archive.arrays["density"][:1],
        "colour": archive.arrays["colour"][:1],
    }
    for name, array in arrays.items():
        archive.arrays[name], archive.meta["arrays"][name]["shape"] = array, list(array.shape)
    (folder / "mutant.npz").write_bytes(archive.write())
    return "table", {"path": "mutant.npz", "original": str(path), "untouched": []}


def large_picture(side: int) -> bytes:
    """Return a black PNG of one bit a pixel."""
    return png(side, side, zlib.compress(bytes(side * (side // 8 + 1)), 1), colour=0, depth=1)


@case("a manifest of a large picture")
def _(folder):
    (folder / "large.png").write_bytes(large_picture(16384))
    (folder / "maps.json").write_text(json.dumps({"base_color": "large.png"}))
    return "manifest", {"path": "maps.json"}


@case("a capture of a large picture")
def _(folder):
    shutil.rmtree(folder / "views", ignore_errors=True)
    captures.write(folder / "views", 3, 1, 8)
    (folder / "views" / "train_0.png").write_bytes(large_picture(24000))
    return "capture", {"path": "views"}


# -- crashes and hangs -------------------------------------------------------------------------------------------------

FIT = ("fit", "ggx", "--steps", "1", "--primary", "4", "--cascaded", "3", "--variant", "llvm_ad_rgb")

refused_command("2^31 samples a step", *FIT, "-o", "x.npz", "--batch", str(2**31))
refused_command("2^64 samples a step", *FIT, "-o", "x.npz", "--batch", str(2**64))
refused_command("seed 2^70", *FIT, "-o", "x.npz", "--batch", "64", "--seed", str(2**70))
refused_command("output of 300 characters", *FIT, "--batch", "64", "-o", "x" * 300 + ".npz")
refused_command("report of 300 characters", *FIT, "--batch", "64", "-o", "x.npz", "--json", "x" * 300 + ".json")
refused_command("checkpoint of 300 characters", *FIT, "--batch", "64", "-o", "x.npz", "--checkpoint", "x" * 300)
refused_command("file of 5000 characters", "inspect", "x" * 5000 + ".npz", "--variant", "llvm_ad_rgb")
refused_command("report in place of the table", *FIT, "--batch", "64", "-o", "x.npz", "--json", "x.npz")


@case("a ray without a direction", "loaded")
def _(folder):
    return "still_ray", {"path": str(all_seeds()["sdf_sparse"][1])}


@case("a manifest of an endless file")
def _(folder):
    (folder / "maps.json").write_text(json.dumps({"base_color": "/dev/zero"}))
    return "manifest", {"path": "maps.json"}


@case("a manifest of a pipe")
def _(folder):
    if not (folder / "pipe.png").exists():
        os.mkfifo(folder / "pipe.png")
    (folder / "maps.json").write_text(json.dumps({"base_color": "pipe.png"}))
    return "manifest", {"path": "maps.json"}


@case("a manifest of a long path")
def _(folder):
    (folder / "maps.json").write_text(json.dumps({"base_color": "x" * 5000}))
    return "manifest", {"path": "maps.json"}


def changed_view(**changes):
    """Return a function that writes a capture whose list of views has other entries."""

    def write(folder: Path) -> tuple[str, dict]:
        shutil.rmtree(folder / "views", ignore_errors=True)
        captures.write(folder / "views", 3, 1, 8)
        path = folder / "views" / "transforms_train.json"
        content = json.loads(path.read_text())
        content["frames"][0] |= changes
        path.write_text(json.dumps(content))
        return "capture", {"path": "views"}

    return write


CASES["a focal length of 1e300"] = Case(changed_view(fl_x=1e300))
CASES["a focal length of 2**64"] = Case(changed_view(fl_x=2**64))
CASES["a camera of 10**400"] = Case(changed_view(transform_matrix=[[10**400, 0, 0, 0]] * 4))
CASES["a picture of a long path"] = Case(changed_view(file_path="x" * 5000))
CASES["a picture that is an endless file"] = Case(changed_view(file_path="/dev/zero"))

recipe("a layout that is an object: sdf", "sdf_sparse", ["set_value", ["settings", "layout"], {"a": 1}])
recipe("a layout that is an object: field", "field_coded", ["set_value", ["settings", "layout"], {"a": 1}])
recipe("a layout that is a list: bsdf, which has none", "bsdf_single",
       ["set_value", ["settings", "layout"], [1]], outcomes=("loaded",))  # fmt: skip
recipe("a box without volume", "sdf_paper", ["set_value", ["settings", "upper"], [0, 0, 0]],
       ["set_value", ["settings", "lower"], [0, 0, 0]])  # fmt: skip
recipe("a primary array of one entry: sdf", "sdf_paper",
       *(["resize", "primary", axis, 1] for axis in range(3)), outcomes=("refused", "loaded"))  # fmt: skip
recipe("a primary array of one entry: ggx", "ggx_small",
       *(["resize", "primary", axis, 1] for axis in range(2)), outcomes=("refused", "loaded"))  # fmt: skip
recipe("spacing 1e-30", "field_coded", ["set_value", ["settings", "spacing"], 1e-30])
recipe("spacing 1e-30 of a grid", "field_grid", ["set_value", ["settings", "spacing"], 1e-30])
recipe("a palette of floats", "field_coded", ["convert", "palette", "float32"])
recipe("probabilities of floats", "field_coded", ["convert", "probabilities", "float32"])
recipe("arrays of which one is of floats, nothing inside", "sdf_paper", ["convert", "cascaded", "float32"],
       ["set_record", "end", 0, 4, 4, 65536])  # fmt: skip
recipe("a primary array of floats", "sdf_paper", ["convert", "primary", "float32"],
       ["set_record", "local", 2, 6, 1, 2], outcomes=("refused", "loaded"))  # fmt: skip
recipe("random probabilities, no nodes", "field_coded", ["random_entries", "probabilities", 18])
recipe("flags of floats", "field_pairs", ["convert", "cells", "float16"])
recipe("a figure of 400 digits", "texture_pages", ["set_value", ["measured", "psnr_base_color_db"], 10**400])
recipe("no nodes", "field_grid", ["set_entries", "cells", "all", 0, 0])
recipe("no crossed cell", "sdf_sparse", ["set_entries", "region_masks", "all", 0, 0])
recipe("control characters in a setting", "ggx_small", ["set_value", ["settings", "inputs"], "\x1b[31mred"])
recipe("control characters in the task", "ggx_small", ["set_value", ["task"], "\x1b]0;title\x07"])
recipe("a task of 5000 characters", "ggx_small", ["set_value", ["task"], "x" * 5000])
recipe("an array called in 5000 characters", "ggx_small", ["rename", "primary", "x" * 5000])
recipe("nested 100,000 times", "ggx_small", ["nested", ["measured"], 100000])
recipe("a preset of control characters", "disney_shipped_tables", ["set_value", ["preset"], "a\nb\x1b[2J"])


def damaged_checkpoint(key: str, value):
    """Return a function that writes the checkpoint of a short training with another value."""

    def write(folder: Path) -> tuple[str, dict]:
        archive = Archive.read(CORPUS / "checkpoint.npz")
        archive.meta[key] = value
        (folder / "mutant.npz").write_bytes(archive.write())
        return "checkpoint", {"path": "mutant.npz"}

    return write


for _key, _value in (
    ("step", "x"), ("step", [1]), ("lr_scale", "x"), ("lr_scale", None), ("best_measured", 3), ("best_step", "x"),
    ("history", 3), ("history", [1]), ("restarts", "x"), ("seconds", "x"), ("plateau", 3), ("references", 3),
    ("settings", 3), ("step", -1), ("step", 2**70),
):  # fmt: skip
    _name = f"a checkpoint with {_key} {_value!r}"
    CASES[_name] = Case(damaged_checkpoint(_key, _value), ("refused", "loaded"))


def mesh(name: str, suffix: str, text: str) -> None:
    """Add a mesh that has to be refused."""

    def write(folder: Path) -> tuple[str, dict]:
        (folder / f"mutant{suffix}").write_text(text)
        return "mesh", {"path": f"mutant{suffix}"}

    CASES[name] = Case(write)


mesh("a negative index: off", ".off", "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 -5\n")
mesh("a large index: obj", ".obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999\n")
mesh("no content: ply", ".ply", "ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n")
mesh("numbers that are none: obj", ".obj", "v nan 0 0\nv inf 0 0\nv 0 1 0\nf 1 2 3\n")


def tiny_files() -> list[Path]:
    """Return the recipes that campaigns have found: ``corpus/*.json``, one a fault."""
    return sorted(CORPUS.glob("*.json"))
