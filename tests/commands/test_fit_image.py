"""``fit image``, ``decode`` and ``inspect`` on images: hard cases, interruptions, full disks, and how they refuse."""

import errno
import json
import os
import re
import signal
import zipfile

import numpy as np
import pytest

from mi_diffind import StoredArray, load_model
from mi_diffind.arrays.tables import Table, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import tasks
from mi_diffind.maps.layout import Layout, MapLayout
from mi_diffind.tasks.image import training

SHORT = ["--steps", "4", "--batch", "256", "--variant", "llvm_ad_rgb", "--dims", "2"]

pytestmark = pytest.mark.usefixtures("few_samples")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder that is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(path, array):
    import mitsuba as mi

    mi.Bitmap(np.ascontiguousarray(array)).write(str(path))
    return str(path)


def read(path):
    import mitsuba as mi

    values = np.array(mi.Bitmap(str(path)))
    return values.reshape(*values.shape[:2], -1)


def noise(*shape, seed=0, dtype=np.uint8):
    rng = np.random.default_rng(seed)
    return rng.random(shape).astype(dtype) if np.dtype(dtype).kind == "f" else rng.integers(0, 256, shape).astype(dtype)


def waves(height=16, width=16):
    """A smooth image that repeats along both axes."""
    y, x = np.mgrid[0:height, 0:width]
    y, x = 2 * np.pi * (y + 0.5) / height, 2 * np.pi * (x + 0.5) / width
    return np.rint(127.5 + 100 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)).astype(np.uint8)


def fit(source, *options, output="out.npz"):
    return main(["fit", "image", str(source), "-o", output, *SHORT, *map(str, options)])


def refused(capsys, *arguments):
    """Run a command that must fail with exit code 2 and one sentence; returns it."""
    capsys.readouterr()
    assert main(list(map(str, arguments))) == 2
    lines = [line for line in capsys.readouterr().err.strip().splitlines() if "error" in line or "Traceback" in line]
    assert len(lines) == 1 and lines[0].startswith("mi-diffind: error: "), lines
    return lines[0]


def decoded(path="out.npz"):
    model = load_model(path, array_module("llvm").TensorXf)
    return model.image.decode(), model.image.layout, model.table


# -- sources of every kind --------------------------------------------------------------------------------------------

SOURCES = {
    "one texel": ("a.png", noise(1, 1, 3)),
    "7 x 5": ("a.png", noise(7, 5, 3)),
    "a row": ("a.png", noise(1, 4096, 3)),
    "a column": ("a.png", noise(300, 1, 1)),
    "one colour": ("a.png", np.full((6, 6, 3), 77, np.uint8)),
    "grey": ("a.png", noise(8, 8, 1)),
    "transparent": ("a.png", noise(8, 8, 4)),
    "16 bits": ("a.png", noise(8, 8, 3).astype(np.uint16) * 257),
    "16 channels": ("a.exr", noise(8, 8, 16, dtype=np.float32)),
    "signed": ("a.exr", 2 * noise(8, 8, 3, dtype=np.float32) - 1),
    "bright": ("a.exr", 1e6 * noise(8, 8, 3, dtype=np.float32) ** 8),
}


@pytest.mark.parametrize("name", SOURCES)
def test_sources_of_every_kind(folder, capsys, name):
    """What is fitted can be inspected and decoded, and is what the report says."""
    file, array = SOURCES[name]
    write(file, array)
    assert fit(file, "--json", "report.json") == 0
    report, (maps, layout, table) = json.loads((folder / "report.json").read_text()), decoded()
    size = (folder / "out.npz").stat().st_size
    assert report["bytes"] == table.nbytes <= size and report["measured"] == table.measured
    assert (layout.height, layout.width) == array.shape[:2] and report["source_bytes"] == array.nbytes
    assert sum(v.shape[2] for v in maps.values()) == array.shape[2]
    assert all(np.isfinite(v).all() for v in maps.values()) and set(maps) == set(layout.names)
    if name in ("one texel", "one colour"):
        assert table.arrays == {} and report["bytes"] == 0 and report["compression"] is None
        np.testing.assert_array_equal(np.rint(255 * maps["image"]), array)
    else:
        assert report["compression"] == pytest.approx(array.nbytes / table.nbytes)
    assert main(["decode", "out.npz", "-o", "back.exr"]) == 0
    names = ["back.exr"] if len(maps) == 1 else [f"back_{m}.exr" for m in maps]
    assert sorted(os.listdir(folder)) == sorted([file, "out.npz", "report.json", *names])
    for path, values in zip(names, maps.values(), strict=True):
        assert read(path).shape == values.shape and np.isfinite(read(path)).all()
    capsys.readouterr()
    assert main(["inspect", "out.npz", "--json", "inspect.json"]) == 0
    text, found = capsys.readouterr().out, json.loads((folder / "inspect.json").read_text())
    assert 'tables for the task "image"' in text and found["bytes"] == table.nbytes
    assert {n: a["bytes"] for n, a in found["arrays"].items()} == {n: array.nbytes for n, array in table.arrays.items()}
    assert found["measured"] == table.measured and found["settings"]["source_path"] == file


# -- sizes ------------------------------------------------------------------------------------------------------------


def test_a_size_in_each_unit(folder):
    """Bits of a texel are those of all its channels together; without a word it is 12x."""
    write("a.png", noise(32, 32, 3) // 2 + waves(32, 32) // 4)
    files = []
    for option in (("--compression", "3x"), ("--bytes", "1k"), ("--bpp", "8"), ()):
        assert fit("a.png", *option, "--json", "r.json", "--structure", "6 bits") == 0
        report, asked = json.loads((folder / "r.json").read_text()), 1024 if option else 256
        assert report["compression_asked"] == pytest.approx(3072 / asked)
        assert 0.85 * asked <= report["bytes"] <= asked
        files.append((folder / "out.npz").read_bytes())
    assert files[0] == files[1] == files[2] != files[3]


def test_one_size_only(folder, capsys):
    write("a.png", noise(4, 4, 3))
    options = [("--compression", "12"), ("--bytes", "1k"), ("--bpp", "2"), ("--psnr", "30")]
    for i, first in enumerate(options):
        for second in options[i + 1 :]:
            with pytest.raises(SystemExit) as caught:
                fit("a.png", *first, *second)
            assert caught.value.code == 2
            assert f"argument {second[0]}: not allowed with argument {first[0]}" in capsys.readouterr().err
    assert os.listdir(folder) == ["a.png"]


@pytest.mark.parametrize(
    "option, value",
    [
        *(("--compression", v) for v in ("0", "-1", "x", "nan", "inf", "")),
        *(("--bytes", v) for v in ("0", "-5", "0.1", "1q", "1e30")),
        *(("--bpp", v) for v in ("0", "-2", "inf", "2x")),
        *(("--psnr", v) for v in ("0", "-3", "nan", "120", "inf", "good")),
        *(("--structure", v) for v in ("9 bits", "0", "")),
        *(("--dims", v) for v in ("0", "5", "x")),
        *(("--cascaded", v) for v in ("0", "-4", "4.5")),
        *(("--steps", v) for v in ("0", "many")),
        ("--seconds", "0"), ("--border", "mirror"), ("--preset", "theirs"), ("--without", "speed"),
        ("--nonfinite", "ignore"),
    ],
)  # fmt: skip
def test_bad_values(folder, capsys, option, value):
    write("a.png", noise(4, 4, 3))
    with pytest.raises(SystemExit) as caught:
        main(["fit", "image", "a.png", "-o", "out.npz", f"{option}={value}"])
    assert caught.value.code == 2
    assert f"mi-diffind fit image: error: argument {option}: " in capsys.readouterr().err.splitlines()[-1]
    assert os.listdir(folder) == ["a.png"]


@pytest.mark.parametrize(
    "options, sentence",
    [
        (["--bpp", "1e308"], "bpp 1e308 is out of range"),
        (["--cascaded", "1000", "--dims", "4"], r"--cascaded: found 1000.*bytes.*allowed are"),
        (["--lr", "-1"], "lr: found -1.0"),
        (["--lr", "nan"], "lr: found nan"),
        (["--resume"], "--checkpoint FILE"),
        (["--resume", "--checkpoint", "c.npz"], "there is nothing to resume"),
        (["--checkpoint", "out.npz"], "the same file as -o"),
        (["--checkpoint", "a.png"], "the same file as source"),
        (["--checkpoint", "c.npz", "--psnr", "30"], "--checkpoint: for one training"),
        (["--checkpoint", "c.npz", "--ratio-search"], "--checkpoint: for one training"),
        (["--ratio-search", "--cascaded", "8"], "leave out --psnr and --cascaded"),
        (["--ratio-search", "--psnr", "30"], "leave out --psnr and --cascaded"),
        (["--psnr", "30", "--cascaded", "8"], "leave out --cascaded"),
        (["--preset", "paper", "--without", "jitter"], "leave it out"),
        (["-o", "out.png"], "allowed is .npz"),
        (["-o", "gone/out.npz"], 'output folder "gone" does not exist'),
    ],
)
def test_what_does_not_go_together(folder, capsys, options, sentence):
    write("a.png", noise(16, 16, 3))
    assert re.search(sentence, refused(capsys, "fit", "image", "a.png", "-o", "out.npz", *SHORT, *options))
    assert os.listdir(folder) == ["a.png"]


# -- interruptions ----------------------------------------------------------------------------------------------------


def ctrl_c(monkeypatch, when):
    """Send SIGINT while the batch with the number ``when`` is drawn."""
    original, calls = training.ImageProblem.batch, []

    def batch(self, rng, size):
        calls.append(size)
        if len(calls) == when:
            signal.raise_signal(signal.SIGINT)
        return original(self, rng, size)

    monkeypatch.setattr(training.ImageProblem, "batch", batch)
    return calls


RUN = ["--steps", "20", "--json", "r.json"]


@pytest.mark.parametrize("changed", ["a texel", "the size", "the channels", "a name"])
def test_resuming_with_another_source(folder, capsys, changed):
    image = waves()
    write("a.png", image)
    assert fit("a.png", *RUN, "--checkpoint", "c.npz", "--cascaded", "16", "--bytes", "2000") == 0
    before = [(folder / name).read_bytes() for name in ("c.npz", "out.npz")]
    image[3, 4, 1] ^= 1
    source = write("a.png", {"the size": image[:12], "the channels": image[..., 0]}.get(changed, image))
    if changed == "a name":  # the same values as a map of another one
        write("a.png", waves())
        (folder / "m.json").write_text('{"maps": {"stain": {"file": "a.png", "color_space": "srgb"}}}')
        source = "m.json"
    arguments = [source, "-o", "out.npz", *SHORT, *RUN, "--checkpoint", "c.npz", "--cascaded", "16", "--bytes", "2000"]
    message = refused(capsys, "fit", "image", *arguments, "--resume")
    assert 'the checkpoint "c.npz" is of another source, or the source has changed since' in message
    assert [(folder / name).read_bytes() for name in ("c.npz", "out.npz")] == before


def test_ctrl_c_in_a_search(folder, capsys, monkeypatch):
    write("a.png", waves())
    with monkeypatch.context() as patch:
        calls = ctrl_c(patch, 25)  # in the second training of 20 steps
        assert fit("a.png", "--ratio-search", "--bytes", "1200", "--steps", "160", "--json", "r.json") == 130
    report = json.loads((folder / "r.json").read_text())
    assert len(calls) == 25 and len(report["tried"]) == 2 and report["interrupted"]
    assert report["measured"]["psnr_db"] == max(t["psnr_db"] for t in report["tried"])
    (folder / "out.npz").unlink()
    with monkeypatch.context() as patch:
        ctrl_c(patch, 3)
        assert fit("a.png", "--psnr", "100") == 130
    assert not (folder / "out.npz").exists() and capsys.readouterr().err.endswith("mi-diffind: interrupted\n")
    with monkeypatch.context() as patch:
        ctrl_c(patch, 6)  # the first training reached it, the second one looks for less
        assert fit("a.png", "--psnr", "1", "--json", "r.json") == 130
    assert json.loads((folder / "r.json").read_text())["measured"] == decoded()[2].measured


# -- full disks -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["the file", "the checkpoint", "the report"])
def test_no_space_left(folder, capsys, monkeypatch, what):
    write("a.png", waves())
    names = ["a.png"]

    def full(*arguments, **options):
        assert [name for name in os.listdir(folder) if name.startswith(".")]  # the temporary file is there
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    options = []
    if what == "the file":
        monkeypatch.setattr(zipfile.ZipFile, "writestr", full)
    elif what == "the checkpoint":
        monkeypatch.setattr(np, "savez", full)
        options = ["--checkpoint", "c.npz"]
    else:
        monkeypatch.setattr("pathlib.Path.write_text", full)
        options, names = ["--json", "r.json"], ["a.png", "out.npz"]  # which was complete by then
    file = {"the file": "out.npz", "the checkpoint": "c.npz", "the report": "r.json"}[what]
    message = refused(capsys, "fit", "image", "a.png", "-o", "out.npz", *SHORT, *options)
    assert f'output file "{file}" cannot be written: No space left on device' in message
    assert sorted(os.listdir(folder)) == names


# -- decode -----------------------------------------------------------------------------------------------------------

MAPS = (
    MapLayout("albedo", "albedo", "srgb", 1, (0, 1, 2)),
    MapLayout("normal", "normal", "linear", 1, (1, 2, "z")),
    MapLayout("ao", "ao", "linear", 1, (3,)),
    MapLayout("glow", "other", "linear", 4, (0, 3, 2), 0.0, 1e6, 1e3),
    MapLayout("signed", "other", "linear", 4, (0,), -2.0, 2.0),
    MapLayout("black", "metallic", "linear", 1, (("constant", 0.0),)),
)


def in_bytes(entries, scale=1 / 255, offset=0.0):
    channels = entries.shape[-1]
    return StoredArray(entries, (), (scale,) * channels, (offset,) * channels)


def make_file(path, height=5, width=7, maps=MAPS, seed=0):
    """A file of random arrays."""
    rng = np.random.default_rng(seed)
    stored = 1 + max(w for m in maps for w in m.where if isinstance(w, int))
    layout = Layout(width, height, tuple(maps), (0.5,) * stored, (maps[0].name,) * stored)
    table = Table("image", {}, settings={"layout": layout.to_json()})
    for name, shape in (("primary", (6, 5, 2)), ("cascaded", (4, 4, stored))):
        table.arrays[name] = in_bytes(rng.integers(0, 256, shape, dtype=np.uint8))
    save_table(path, table)
    return str(path)


def test_decode_to_png(folder, capsys):
    make_file("t.npz")
    assert main(["decode", "t.npz", "-o", "b.png", "--json", "r.json"]) == 0
    maps, layout, _ = decoded("t.npz")
    assert json.loads((folder / "r.json").read_text())["files"] == [f"b_{name}.png" for name in layout.names]
    text = capsys.readouterr().out
    for name, values in maps.items():
        found = read(f"b_{name}.png")
        assert found.dtype == np.uint8 and f"b_{name}.png: 7 x 5, {values.shape[2]} channel(s)" in text
        np.testing.assert_array_equal(found, np.rint(255 * np.clip(values.astype(np.float64), 0, 1)).astype(np.uint8))


def test_decode_to_exr(folder):
    """Linear: sRGB is decoded. Half precision, single where that overflows."""
    make_file("t.npz")
    assert main(["decode", "t.npz", "-o", "b.exr"]) == 0
    maps, *_ = decoded("t.npz")
    assert maps["glow"].max() > 65504 > 1 > maps["signed"].min() and maps["signed"].min() < 0
    for name, values in maps.items():
        found, expected = read(f"b_{name}.exr"), values.astype(np.float64)
        if name == "albedo":
            expected = np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4)
        assert found.dtype == (np.float32 if name == "glow" else np.float16)
        np.testing.assert_allclose(found.astype(np.float64), expected, rtol=1e-3, atol=1e-6)


def test_decode_some_maps_at_other_sizes(folder):
    make_file("t.npz")
    assert main(["decode", "t.npz", "-o", "one.png", "--map", "ao", "--width", "21", "--height", "3"]) == 0
    assert read("one.png").shape == (3, 21, 1)
    assert main(["decode", "t.npz", "-o", "two.png", "--map", "ao", "--map", "normal", "--width", "2"]) == 0
    assert read("two_ao.png").shape == (5, 2, 1) and read("two_normal.png").shape == (5, 2, 3)
    assert sorted(os.listdir(folder)) == ["one.png", "t.npz", "two_ao.png", "two_normal.png"]


def test_what_decode_refuses(folder, capsys):
    make_file("t.npz")
    many = [MapLayout("many", "other", "linear", 1, tuple(range(6)))]
    make_file("many.npz", maps=many)
    save_table("unknown.npz", Table("cloth", {"a": StoredArray(np.zeros((2, 1), np.float32))}))
    save_table("other.npz", load_table(tasks()["ggx"].file()))
    before = sorted(os.listdir(folder))
    for arguments, sentence in (
        (["t.npz", "-o", "b.jpg"], 'output "b.jpg": found the extension ".jpg", allowed are .png and .exr'),
        (["t.npz", "-o", "b"], 'found the extension ""'),
        (["t.npz", "-o", "gone/b.png"], 'output folder "gone" does not exist'),
        (["t.npz", "-o", "b.png", "--map", "colour"], 'found "colour", the file holds albedo, normal, ao'),
        (["gone.npz", "-o", "b.png"], "gone.npz: no such file"),
        (
            ["other.npz", "-o", "b.png"],
            'other.npz: holds tables for the task "ggx", which stand for nothing that could be decoded',
        ),
        (["other.npz", "-o", "b.png", "--map", "a"], "other.npz: --map does not apply to this file"),
        (["unknown.npz", "-o", "b.png"], 'unknown.npz: holds tables for the task "cloth", installed are bsdf, disney'),
        (["many.npz", "-o", "b.png"], 'many.npz: "many" has 6 channels, PNG holds 4: use .exr'),
    ):
        assert sentence in refused(capsys, "decode", *arguments)
    assert sorted(os.listdir(folder)) == before
    message = refused(capsys, "decode", "t.npz", "-o", "b.png", "--width", "100000", "--height", "100000")
    assert "texels are more than fit into memory" in message
    for option in (["--width", "0"], ["--height", "-3"], ["--width", "9" * 30]):
        with pytest.raises(SystemExit):
            main(["decode", "t.npz", "-o", "b.png", *option])
    assert main(["decode", "many.npz", "-o", "b.exr"]) == 0 and read("b.exr").shape == (5, 7, 6)


@pytest.mark.parametrize("name", ["plain", "one colour", "cleaned"])
def test_inspect_measures_against_the_source(folder, capsys, name):
    """What was measured after the training; from another folder, too; not against anything else."""
    values = {"plain": waves(), "one colour": np.full((6, 6, 3), 77, np.uint8), "cleaned": waves() / np.float32(255)}[
        name
    ]
    if name == "cleaned":
        values[3, 4, 1] = np.nan
    (folder / "files").mkdir()
    source = write("a.exr" if name == "cleaned" else "a.png", values)
    assert fit(source, "--nonfinite", "clean", output="files/out.npz") == 0
    assert main(["inspect", "files/out.npz", "--measure", "--json", "r.json"]) == 0
    ((form, measured),) = json.loads((folder / "r.json").read_text())["measured_in_each_form"].items()
    model = load_model("files/out.npz", array_module("llvm").TensorXf)
    assert form == model.storage and measured.pop("bytes") == model.nbytes
    assert measured.pop("memory_bytes") == model.memory_nbytes
    assert measured == pytest.approx(load_table("files/out.npz").measured, rel=1e-4)
    changed = np.nan_to_num(values)
    for other in (changed[:5], changed // 2 if name != "cleaned" else changed / 2, changed[..., :1]):
        write(source, other)
        assert "has changed since" in refused(capsys, "inspect", "files/out.npz", "--measure")
    os.unlink(source)
    assert f"{source}: no such file" in refused(capsys, "inspect", "files/out.npz", "--measure")
