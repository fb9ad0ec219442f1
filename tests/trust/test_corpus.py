"""Everything that ever failed: each file and command line is refused in one sentence, or does as it should."""

import json
import os
import re
import struct
import zlib

import captures
import numpy as np
import pytest
from damage import Archive, header, png
from limited_child import LimitedChild
from trial_files import CHECKPOINT, all_seeds

from mi_diffind.tasks.radiance import coding

#: Name → function that writes the files to a folder and returns the probe and its arguments, the right outcomes, and
#: an expression that the sentence has to match.
CASES = {}


def case(name, *outcomes, says=""):
    """Add a function to the corpus."""

    def add(write):
        CASES[name] = write, outcomes or ("refused",), says
        return write

    return add


def table(name, seed, *changes, outcomes=("refused",), patch=lambda data: data):
    """Add changes of the :class:`Archive` of a small valid table file or checkpoint; no array has to be as before."""

    @case(name, *outcomes)
    def _(folder):
        path = CHECKPOINT if seed == "checkpoint" else all_seeds()[seed]
        archive = Archive(path.read_bytes())
        for change in changes:
            change(archive)
        (folder / "mutant.npz").write_bytes(patch(archive.write()))
        if seed == "checkpoint":
            return seed, {"path": "mutant.npz"}
        return "table", {"path": "mutant.npz", "original": str(path), "untouched": []}


def put(*path):
    """Return a change that puts the last of these in the description, at the path of the others."""
    *above, key, value = path

    def change(archive):
        content = archive.meta
        for step in above:
            content = content[step]
        content[key] = value

    return change


def edit(name, function):
    """Return a change of the entries of an array, its shape and type described as they are then."""

    def change(archive):
        array = archive.arrays[name] = function(archive.arrays[name])
        described = archive.meta["arrays"][name]
        if array.dtype.kind == "f":
            described["storage"] = str(array.dtype)
        if "bits" not in described or described["bits"] == 8:
            described["shape"] = list(array.shape)

    return change


def as_type(name, dtype):
    return edit(name, lambda array: array.astype(dtype))


def one_entry(axes):
    return edit("primary", lambda array: np.resize(array, (1,) * axes + array.shape[axes:]))


# -- memory and time by small files ------------------------------------------------------------------------------------

#: Bytes that a member of a bomb holds. 64 MiB and 20 times the file's size may be taken.
BOMB = 160 << 20


def fill(name, start, filling, size=BOMB, end=b""):
    """Return a change: a member goes on for ``size`` bytes with a repeated ``filling``."""
    return lambda archive: archive.raw.update({name: start + filling * (size // len(filling)) + end})


def fill_text(before, filling, end):
    """Return a change: the description is ``before``, a repeated ``filling`` of BOMB / 4 bytes, and ``end``."""

    def change(archive):
        text = before(archive.meta)
        size = len(text) + BOMB // 4 // len(filling) * len(filling) + len(end)
        fill("meta", header([size], "|u1") + text, filling, BOMB // 4, end)(archive)

    return change


def smaller_claim(data):
    """Return an archive whose records claim a member of 400 bytes in place of BOMB."""
    return data.replace(*(struct.pack("<I", n + len(header([400], "|u1"))) for n in (BOMB, 400)))


def coded_grid(archive):
    """Claim a grid of 600³ nodes for the codes of one of 60³."""
    shape, settings = (60, 60, 60), archive.meta["settings"]
    numbers, colours = np.zeros(np.prod(shape), int), len(archive.arrays["palette"])
    codes = coding.encode(np.ones(shape, bool), numbers, numbers, 2 ** settings["density_bits"], colours)
    settings["shape"] = [600] * 3
    for name, array in zip(("probabilities", "nodes"), codes, strict=True):
        edit(name, lambda _, array=array: array[:, None])(archive)


ZEROS = [BOMB // 4 // 2**12, 2**11, 2]
ONE_BIT = {"shape": [BOMB // 2**10, 2**12, 2], "storage": "uint8", "scale": [1.0] * 2, "offset": [0.0] * 2, "bits": 1}
table("entries of one bit", "ggx_small", lambda a: a.meta["arrays"]["primary"].update(ONE_BIT),
      fill("primary", header([BOMB], "|u1"), b"\0"))  # fmt: skip
table("a large description", "ggx_small",
      fill_text(lambda meta: (json.dumps(meta)[:-1] + ', "more": [0').encode(), b",0", b"]}"))  # fmt: skip
table("a large array of zeros", "ggx_small", put("arrays", "primary", "shape", ZEROS),
      fill("primary", header(ZEROS, "<f4"), b"\0"))  # fmt: skip
table("an array that is larger than its archive says", "ggx_small", fill("primary", header([400], "|u1"), b"\0"),
      patch=smaller_claim)  # fmt: skip
table("a long history of a checkpoint", "checkpoint",
      fill_text(lambda meta: b'{"lr_scale": 1, "settings": {}, "history": [', b"[],", b"0]}"),
      outcomes=("refused", "loaded"))  # fmt: skip
table("a distance field of empty regions", "sdf_sparse",
      edit("regions", lambda array: np.pad(array, [(0, 192 - n) for n in array.shape[:3]] + [(0, 0)])))  # fmt: skip
table("a radiance field of a large empty grid", "field_grid", put("settings", "shape", [600] * 3),
      *(edit(name, lambda array: array[:1]) for name in ("density", "colour")),
      edit("cells", lambda _: np.zeros((600**3 // 8, 1), np.uint8)))  # fmt: skip
table("a coded radiance field that claims a large grid", "field_coded", coded_grid)


def large_picture(side):
    """Return a black PNG of one bit a pixel."""
    return png(side, side, zlib.compress(bytes(side * (side // 8 + 1)), 1), colour=0, depth=1)


def manifest(name, file, write=lambda folder: None):
    """Add a manifest that names a file."""

    @case(name)
    def _(folder):
        write(folder)
        (folder / "maps.json").write_text(json.dumps({"base_color": file}))
        return "manifest", {"path": "maps.json"}


manifest("a manifest of a large picture", "large.png",
         lambda folder: (folder / "large.png").write_bytes(large_picture(16384)))  # fmt: skip
manifest("a manifest of an endless file", "/dev/zero")
manifest("a manifest of a pipe", "pipe.png", lambda folder: os.mkfifo(folder / "pipe.png"))
manifest("a manifest of a long path", "x" * 5000)


def views(name, picture=None, **changes):
    """Add a capture whose first view has other entries, or another picture."""

    @case(name)
    def _(folder):
        captures.write(folder / "views", 3, 1, 8)
        captures.change(folder / "views", frame=0, **changes)
        if picture:
            (folder / "views" / "train_0.png").write_bytes(large_picture(picture))
        return "capture", {"path": "views"}


views("a capture of a large picture", 24000)
views("a focal length of 1e300", fl_x=1e300)
views("a focal length of 2**64", fl_x=2**64)
views("a camera of 10**400", transform_matrix=[[10**400, 0, 0, 0]] * 4)
views("a picture of a long path", file_path="x" * 5000)
views("a picture that is an endless file", file_path="/dev/zero")


# -- crashes and hangs -------------------------------------------------------------------------------------------------


@case("a ray without a direction", "loaded")
def _(folder):
    return "still_ray", {"path": str(all_seeds()["sdf_sparse"])}


FIT = "fit ggx --steps 1 --primary 4 --cascaded 3 --variant llvm_ad_rgb -o a.npz"


def command(words, says="", write=lambda folder: None):
    """Add a command line that has to be refused."""

    @case(words if len(words) < 200 else f"{words[:100]} ({len(words)} characters)", says=says)
    def _(folder):
        write(folder)
        return "command", {"arguments": words.split()}


command(f"{FIT} --json a.npz")
for option in ("batch", "steps", "seconds", "seed"):
    for value in (str(2**31), str(2**64), str(2**70), "9" * 5000):
        if (option, value) != ("seed", str(2**31)):  # seeds have 32 bits
            command(f"fit ggx -o a.npz --{option} {value}", f"--{option}: ")

#: Command lines that read PATH, or a file of the folder LINK that names it.
SOURCES = """
    fit image PATH.png -o a.npz
    fit texture PATH.json -o a.npz
    fit image LINK/m.json -o a.npz
    fit sdf PATH.obj -o a.npz
    fit bsdf PATH.csv -o a.npz
    capture PATH.ply -o views
    fit field LINK/views -o a.npz
    fit ggx -o a.npz --resume --checkpoint PATH.c
    inspect PATH.npz
    render PATH.xml
"""

#: Further command lines that read or write PATH.
PATHS = """
    fit ggx -o PATH.npz
    fit ggx -o a.npz --json PATH
    fit ggx -o a.npz --steps 1 --checkpoint PATH
    fit image PATH.json -o a.npz
    fit field PATH -o a.npz
    fit bsdf PATH.xml -o a.npz
    decode PATH.npz -o a.png
    decode a.npz -o PATH.png
    compare PATH.xml
    capture PATH.xml -o views
"""

for words in (SOURCES.strip() + PATHS.rstrip()).splitlines():
    for path in ("a" * 300, "a/" * 2500, "a" * 5000):
        command(words.replace("PATH", path))


def special_files(target):
    """Return a function that writes pipes, which block whoever opens them, or devices that never end."""

    def write(folder):
        folder = folder / target
        (folder / "views").mkdir(parents=True, exist_ok=True)
        (folder / "m.json").write_text(json.dumps({"albedo": "PATH.png"}))
        endings = ("png", "json", "obj", "csv", "ply", "c", "npz", "xml")
        for name in (*(f"PATH.{ending}" for ending in endings), "views/transforms.json"):
            if not os.path.lexists(folder / name):
                os.mkfifo(folder / name) if target == "pipe" else os.symlink("/dev/zero", folder / name)

    return write


for target in ("pipe", "device"):
    for words in SOURCES.strip().splitlines():
        words = words.replace("PATH", f"{target}/PATH").replace("LINK", target)
        command(words, f"is a {target}|holds no views", special_files(target))


def rename(archive):
    archive.arrays["x" * 5000] = archive.arrays.pop("primary")
    archive.meta["arrays"]["x" * 5000] = archive.meta["arrays"].pop("primary")


EITHER = ("refused", "loaded")
ZERO = lambda array: np.zeros_like(array)  # noqa: E731
RANDOM = lambda array: np.random.default_rng(18).integers(0, 256, array.shape).astype(array.dtype)  # noqa: E731
table("a layout that is an object: sdf", "sdf_sparse", put("settings", "layout", {"a": 1}))
table("a layout that is an object: field", "field_coded", put("settings", "layout", {"a": 1}))
table(
    "a layout that is a list: bsdf, which has none", "bsdf_single", put("settings", "layout", [1]), outcomes=EITHER[1:]
)
table("a box without volume", "sdf_paper", *(put("settings", name, [0, 0, 0]) for name in ("lower", "upper")))
table("a primary array of one entry: sdf", "sdf_paper", one_entry(3), outcomes=EITHER)
table("a primary array of one entry: ggx", "ggx_small", one_entry(2), outcomes=EITHER)
table("spacing 1e-30", "field_coded", put("settings", "spacing", 1e-30))
table("spacing 1e-30 of a grid", "field_grid", put("settings", "spacing", 1e-30))
table("a palette of floats", "field_coded", as_type("palette", "float32"))
table("probabilities of floats", "field_coded", as_type("probabilities", "float32"))
table("a primary array of floats", "sdf_paper", as_type("primary", "float32"), outcomes=EITHER)
table("flags of floats", "field_pairs", as_type("cells", "float16"))
table("random probabilities, no nodes", "field_coded", edit("probabilities", RANDOM))
table("no nodes", "field_grid", edit("cells", ZERO))
table("no crossed cell", "sdf_sparse", edit("region_masks", ZERO))
table("a figure of 400 digits", "texture_pages", put("measured", "psnr_base_color_db", 10**400))
table("control characters in a setting", "ggx_small", put("settings", "inputs", "\x1b[31mred"))
table("control characters in the task", "ggx_small", put("task", "\x1b]0;title\x07"))
table("a preset of control characters", "disney_shipped_tables", put("preset", "a\nb\x1b[2J"))
table("a task of 5000 characters", "ggx_small", put("task", "x" * 5000))
table("an array called in 5000 characters", "ggx_small", rename)
table("nested 100,000 times", "ggx_small", put("measured", "@@nested 100000@@"))
for method in (12, 14):
    table(f"a member compressed by method {method}", "ggx_small", lambda a, m=method: a.methods.update(primary=m))


for key in ("step", "lr_scale", "best_measured", "best_step", "history", "restarts", "seconds", "plateau", "references",
            "settings"):  # fmt: skip
    for value in (None, "x", [1], {"a": "b"}, 3, -1, 2**70):
        table(f"a checkpoint with {key} {value!r}", "checkpoint", put(key, value), outcomes=EITHER)


def mesh(name, text):
    """Add a mesh that has to be refused; its name ends with the format."""

    @case(name)
    def _(folder):
        path = f"mutant.{name.split()[-1]}"
        (folder / path).write_text(text)
        return "mesh", {"path": path}


mesh("a negative index: off", "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 1 2 3\n3 0 3 -5\n")
mesh("a large index: obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999\n")
mesh("no content: ply", "ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n")
mesh("numbers that are none: obj", "v nan 0 0\nv inf 0 0\nv 0 1 0\nf 1 2 3\n")


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    with LimitedChild(tmp_path_factory.mktemp("corpus")) as limited:
        yield limited


@pytest.mark.parametrize("name", CASES)
def test_what_once_failed(child, name):
    """A command that is refused leaves no file."""
    write, outcomes, says = CASES[name]
    probe, arguments = write(child.folder)
    before = set(child.folder.rglob("*"))
    answer = child.check(probe, **arguments)
    assert answer["outcome"] in outcomes and re.search(says, answer["message"]), answer
    assert probe != "command" or set(child.folder.rglob("*")) == before
