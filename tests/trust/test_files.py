"""Damaged files of every task and every reader: each is refused in one sentence, or it loads, and then arrays that
nothing was done to are unchanged and everything that is computed from it is finite. No read leaves an array, no mutant
takes more memory or time than its size allows.

A task gets its part of this suite by fits of seconds, whose files are damaged (``trial_files.TRIALS``).
"""

import json
import shutil
import zlib
from pathlib import Path
from typing import NamedTuple

import captures
import damage
import numpy as np
import pytest
import solid_meshes
import trial_files
from hypothesis import given
from hypothesis import strategies as st
from limited_child import GOOD, LimitedChild
from PIL import Image

from mi_diffind.fitting.task import tasks


class Target(NamedTuple):
    """A sort of file: the probe that reads ``path`` among valid ``files`` (by name), and what is damaged.

    ``mutants``: name of a file → strategy of its :class:`damage.Mutant`. ``arguments``: further ones of the probe.
    """

    probe: str
    path: str
    files: dict[str, bytes]
    mutants: dict[str, st.SearchStrategy]
    arguments: dict

    def check(self, child, file: str, mutant: damage.Mutant, **more) -> dict:
        """Write the files, one of them damaged, and return the answer of the probe."""
        shutil.rmtree(child.folder / "mutant", ignore_errors=True)
        for name, data in {**self.files, file: mutant.data}.items():
            path = child.folder / "mutant" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        if self.probe == "table":
            more["untouched"] = mutant.untouched
        return child.check(self.probe, path=f"mutant/{self.path}", **self.arguments, **more)


def archive(probe: str, path: Path, **arguments) -> Target:
    data = path.read_bytes()
    mutants = st.one_of(damage.archive_mutants(data), damage.mutants(data))
    return Target(probe, "table.npz", {"table.npz": data}, {"table.npz": mutants}, arguments)


def text(probe: str, name: str, data: bytes) -> Target:
    mutants = st.one_of(damage.mutants(data, (damage.other_word,)), damage.mutants(data))
    return Target(probe, name, {name: data}, {name: mutants}, {})


def mesh(folder: Path, suffix: str) -> Target:
    path = solid_meshes.write(folder / f"valid.{suffix}", solid_meshes.sphere(4, 0.8))
    return text("mesh", f"mutant.{suffix}", path.read_bytes())


def described(probe: str, path: str, files: dict[str, bytes], description: str, picture: str) -> Target:
    """Return a target of a folder, of which a JSON file and a picture are damaged."""
    content = damage.json_mutants(json.loads(files[description]))
    return Target(probe, path, files, {description: content, picture: damage.mutants(files[picture])}, {})


def views(folder: Path) -> Target:
    """Return a capture of 4 pictures of 8 × 8 pixels."""
    source = captures.write(folder / "valid_views", 4, 1, 8)
    files = {path.name: path.read_bytes() for path in source.iterdir()}
    content = json.loads(files["transforms_train.json"])
    content |= {"aabb": [[-1, -1, -1], [1, 1, 1]], "fl_x": 12.0, "fl_y": 12.0, "cx": 4.0, "cy": 4.0, "w": 8, "h": 8}
    files["transforms_train.json"] = damage.dump(content)
    return described("capture", "", files, "transforms_train.json", "train_0.png")


def manifest(folder: Path) -> Target:
    """Return the manifest of three maps."""
    path = folder / "colour.png"
    Image.fromarray(np.random.default_rng(3).integers(0, 256, (6, 8, 3), dtype=np.uint8)).save(path)
    colour = {"file": "colour.png", "color_space": "srgb"}
    maps = {"base_color": colour, "normal": "normal.png", "roughness": {"file": "colour.png", "channels": [0]}}
    files = {"maps.json": damage.dump({"maps": maps}), **dict.fromkeys(("colour.png", "normal.png"), path.read_bytes())}
    return described("manifest", "maps.json", files, "maps.json", "colour.png")


def gaussians() -> bytes:
    """Return 8 Gaussians as a PLY file."""
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), "opacity", *(f"scale_{i}" for i in range(3))]
    names += [f"rot_{i}" for i in range(4)]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 8", *(f"property float {n}" for n in names)]
    values = np.random.default_rng(1).normal(0, 0.5, (8, len(names))).astype("<f4")
    return "\n".join([*lines, "end_header\n"]).encode() + values.tobytes()


#: Name → function of a folder for valid files that returns the target.
TARGETS = {
    **{name: lambda folder, p=path: archive("table", p, original=str(p))
       for name, path in trial_files.all_seeds().items()},
    "capture": views,
    "manifest": manifest,
    **{f"mesh .{suffix}": lambda folder, s=suffix: mesh(folder, s) for suffix in ("obj", "ply", "off", "stl")},
    "splats": lambda folder: text("splats", "mutant.ply", gaussians()),
    "checkpoint": lambda folder: archive("checkpoint", trial_files.CHECKPOINT),
}  # fmt: skip


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    with LimitedChild(tmp_path_factory.mktemp("mutants")) as limited:
        yield limited


@pytest.mark.parametrize("name", [name for name, task in tasks().items() if trial_files.has_files(task)])
def test_every_task_has_small_files(name):
    """Where they are missing or out of date: ``python tests/helpers/trial_files.py``."""
    assert trial_files.seeds(tasks()[name]), "the task has no file to damage: give it trials (trial_files.TRIALS)"


@pytest.mark.parametrize(
    "examples, share",
    # As many as the environment variable MI_DIFFIND_MUTANTS says (default: 2000)
    [(8, 4), pytest.param(10 * damage.MUTANTS, 1, marks=pytest.mark.slow)],
    ids=["few", "many"],
)
@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files(child, name, examples, share):
    """Mutants by structure and by bytes; of the tables that load, one in ``share`` is decoded and rendered."""
    target = TARGETS[name](child.folder)
    files = st.one_of([st.tuples(st.just(file), mutants) for file, mutants in target.mutants.items()])

    @damage.hostile(examples)
    @given(damaged=files)
    def each(damaged):
        file, mutant = damaged
        more = {"evaluate": zlib.crc32(mutant.data) % share == 0} if target.probe == "table" else {}
        answer = target.check(child, file, mutant, **more)
        assert answer["outcome"] in GOOD, answer

    each()


@pytest.mark.parametrize("name", TARGETS)
def test_undamaged_files_load(child, name):
    """An archive that is written again without a lie has the same arrays and description."""
    target = TARGETS[name](child.folder)
    file = next(iter(target.mutants))
    data = target.files[file]
    answer = target.check(child, file, damage.Mutant(data))
    assert answer["outcome"] == "loaded", answer
    if file.endswith(".npz"):
        before = damage.Archive(data)
        copy = damage.Archive(before.write())
        assert copy.members() == before.members() and list(copy.arrays) == list(before.arrays)


@pytest.mark.slow
@pytest.mark.parametrize("name", trial_files.NAMES)
def test_trials_have_the_arrays_of_the_kept_files(mi, tmp_path, name):
    """The files in ``corpus/seeds`` are what the trials still give."""
    task, trial = name.split("/")
    trained = trial_files.make(tasks()[task], trial, tmp_path, tmp_path / "trial.npz")
    kept = tasks()[task].load(trial_files.SEEDS / f"{task}_{trial}.npz")
    assert set(tasks()[task].load(trained).arrays) == set(kept.arrays)
