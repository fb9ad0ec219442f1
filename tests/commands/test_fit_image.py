"""``fit image``, ``decode`` and ``inspect`` on images: sources, sizes, searches, interruptions, refusals."""

import json
import os
import re

import mitsuba as mi
import numpy as np
import pytest
from commands import refused

from mi_diffind import StoredArray, load_model
from mi_diffind.arrays.tables import Table, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import tasks
from mi_diffind.maps.layout import Layout, MapLayout

SHORT = ["--steps", "4", "--batch", "256", "--variant", "llvm_ad_rgb", "--dims", "2"]

pytestmark = pytest.mark.usefixtures("few_samples")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder that is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write(path, array):
    mi.Bitmap(np.ascontiguousarray(array)).write(str(path))
    return str(path)


def read(path):
    values = np.array(mi.Bitmap(str(path)))
    return values.reshape(*values.shape[:2], -1)


def noise(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def reals(*shape):
    return np.random.default_rng(0).random(shape, dtype=np.float32)


def waves(height=16, width=16):
    """Return a smooth image that repeats along both axes."""
    y, x = np.mgrid[0:height, 0:width]
    y, x = 2 * np.pi * (y + 0.5) / height, 2 * np.pi * (x + 0.5) / width
    return np.rint(127.5 + 100 * np.stack([np.sin(x), np.cos(y), np.sin(x + y)], axis=-1)).astype(np.uint8)


def fit(source, *options, output="out.npz"):
    return main(["fit", "image", str(source), "-o", output, *SHORT, *map(str, options)])


def report():
    with open("r.json") as file:
        return json.load(file)


def decoded(path="out.npz"):
    model = load_model(path, array_module("llvm").TensorXf)
    return model.image.decode(), model.image.layout, model.table


SOURCES = {
    "one texel": ("a.png", noise(1, 1, 3)),
    "a column": ("a.png", noise(300, 1, 1)),
    "one colour": ("a.png", np.full((6, 6, 3), 77, np.uint8)),
    "transparent": ("a.png", noise(8, 8, 4)),
    "16 bits": ("a.png", noise(7, 5, 3).astype(np.uint16) * 257),
    "16 channels": ("a.exr", reals(8, 8, 16)),
    "signed": ("a.exr", 2 * reals(8, 8, 3) - 1),
    "bright": ("a.exr", 1e6 * reals(8, 8, 3) ** 8),
}


@pytest.mark.parametrize("name", SOURCES)
def test_sources_are_fitted_decoded_and_inspected(folder, capsys, name):
    file, array = SOURCES[name]
    write(file, array)
    assert fit(file, "--json", "r.json") == 0
    (maps, layout, table), size = decoded(), (folder / "out.npz").stat().st_size
    assert report()["bytes"] == table.nbytes <= size and report()["measured"] == table.measured
    assert (layout.height, layout.width) == array.shape[:2] and report()["source_bytes"] == array.nbytes
    assert sum(v.shape[2] for v in maps.values()) == array.shape[2]
    assert all(np.isfinite(v).all() for v in maps.values()) and set(maps) == set(layout.names)
    if name in ("one texel", "one colour"):
        assert table.arrays == {} and report()["bytes"] == 0 and report()["compression"] is None
        np.testing.assert_array_equal(np.rint(255 * maps["image"]), array)
    else:
        assert report()["compression"] == pytest.approx(array.nbytes / table.nbytes)
    assert main(["decode", "out.npz", "-o", "back.exr"]) == 0
    names = ["back.exr"] if len(maps) == 1 else [f"back_{m}.exr" for m in maps]
    assert sorted(os.listdir(folder)) == sorted([file, "out.npz", "r.json", *names])
    capsys.readouterr()
    assert main(["inspect", "out.npz", "--json", "r.json"]) == 0
    assert 'tables for the task "image"' in capsys.readouterr().out and report()["bytes"] == table.nbytes
    assert {n: a["bytes"] for n, a in report()["arrays"].items()} == {n: a.nbytes for n, a in table.arrays.items()}
    assert report()["measured"] == table.measured and report()["settings"]["source_path"] == file


def test_manifests(folder, capsys):
    (folder / "maps").mkdir()
    normal = np.full((6, 7, 3), (128, 128, 255), np.uint8)
    for name, array in (("paint", noise(6, 7, 3)), ("orm", noise(6, 7, 3, seed=1)), ("normal", normal)):
        write(folder / "maps" / f"{name}.png", array)
    maps = {"paint": "paint.png", "normal": "normal.png"}
    maps |= {name: {"file": "orm.png", "channels": c} for name, c in (("roughness", "g"), ("ao", "r"))}
    (folder / "maps" / "material.json").write_text(json.dumps({"maps": maps, "licence": "CC0"}))
    assert fit("maps/material.json") == 0
    out = capsys.readouterr().out
    assert 'map "paint": an unknown name' in out and "material.json: keys that are not used: licence" in out
    values, layout, table = decoded()
    assert layout.names == tuple(maps) and layout.stored == 5  # the normal is constant
    np.testing.assert_array_equal(np.rint(255 * values["normal"]), normal)
    assert table.settings["source_path"] == "maps/material.json"
    figures = {"psnr_db", "psnr_mean_db", "psnr_between_db", *(f"psnr_{n}_db" for n in maps)}
    assert {k for k in table.measured if k.startswith("psnr_")} == figures


def test_sizes_that_cannot_be_met_are_explained(folder, capsys):
    write("a.png", noise(8, 8, 3))
    assert fit("a.png", "--bytes", "20") == 0
    assert re.search(r"20 bytes were requested, but [\d,]+ are the nearest that the arrays", capsys.readouterr().out)


@pytest.mark.parametrize(
    "options, sentence",
    [
        (["--compression", "nan"], "argument --compression"),
        (["--psnr", "120"], "argument --psnr"),
        (["--compression", "12", "--psnr", "30"], "argument --psnr: not allowed with argument --compression"),
        (["--structure", "9 bits"], "argument --structure"),
        (["--dims", "5"], "argument --dims"),
        (["--cascaded", "4.5"], "argument --cascaded"),
        (["--without", "speed"], "argument --without"),
        (["--bpp", "1e308"], "bpp 1e308 is out of range"),
        (["--cascaded", "1000", "--dims", "4"], r"--cascaded: found 1000.*bytes.*allowed are"),
        (["--lr", "-1"], "lr: found -1.0"),
        (["--resume"], "--checkpoint FILE"),
        (["--resume", "--checkpoint", "c.npz"], "there is nothing to resume"),
        (["--checkpoint", "out.npz"], "the same file as -o"),
        (["--checkpoint", "c.npz", "--psnr", "30"], "--checkpoint: for one training"),
        (["--checkpoint", "c.npz", "--ratio-search"], "--checkpoint: for one training"),
        (["--ratio-search", "--cascaded", "8"], "leave out --psnr and --cascaded"),
        (["--psnr", "30", "--cascaded", "8"], "leave out --cascaded"),
        (["--preset", "paper", "--without", "jitter"], "leave it out"),
        (["-o", "out.png"], "allowed is .npz"),
    ],
)
def test_options_that_are_refused(folder, capsys, options, sentence):
    write("a.png", noise(16, 16, 3))
    assert re.search(sentence, refused(capsys, "fit", "image", "a.png", "-o", "out.npz", *SHORT, *options))
    assert os.listdir(folder) == ["a.png"]


def test_ratio_search(folder, capsys):
    """The file is of the best of the short trainings that were tried, within the bytes."""
    write("a.png", waves())
    assert fit("a.png", "--ratio-search", "--bytes", "1200", "--steps", "8", "--json", "r.json") == 0
    tried, settings = report()["tried"], report()["settings"]
    assert len(tried) == capsys.readouterr().out.count("  tried ") >= 2 and settings["steps"] == 8
    best = max(tried, key=lambda t: t["psnr_db"] + t["psnr_between_db"])
    assert (settings["structure"], settings["dims"]) == (best["structure"], best["dims"])
    assert report()["bytes"] == best["bytes"] <= 1260


def test_the_smallest_of_a_quality(folder, capsys):
    write("a.png", waves())
    options = ["--psnr", "15", "--steps", "10", "--dims", "3", "--lr", "0.01"]
    assert fit("a.png", *options, "--json", "r.json") == 0
    assert report()["measured"]["psnr_db"] >= 15 and report()["compression_asked"] is None
    assert report()["bytes"] == min(t["bytes"] for t in report()["tried"] if t["psnr_db"] >= 15)
    (folder / "out.npz").unlink()
    message = refused(capsys, "fit", "image", "a.png", "-o", "out.npz", *SHORT, "--psnr", "110")
    assert "a.png: 110 dB were not reached; the best of" in message and not (folder / "out.npz").exists()


def test_resuming_something_else(folder, capsys):
    """Another texel, and other settings of the training; both files stay."""
    image, run = waves(), ["--checkpoint", "c.npz", "--cascaded", "16", "--bytes", "2000"]
    write("a.png", image)
    assert fit("a.png", *run) == 0
    before = [(folder / name).read_bytes() for name in ("c.npz", "out.npz")]
    arguments = ["fit", "image", "a.png", "-o", "out.npz", *SHORT, *run, "--resume"]
    assert "was made with other settings (jitter)" in refused(capsys, *arguments, "--without", "jitter")
    image[3, 4, 1] ^= 1
    write("a.png", image)
    assert "is of another source, or the source has changed since" in refused(capsys, *arguments)
    assert [(folder / name).read_bytes() for name in ("c.npz", "out.npz")] == before


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


def make_file(path, height=5, width=7, maps=MAPS):
    """Write a file of random arrays."""
    rng = np.random.default_rng(0)
    stored = 1 + max(w for m in maps for w in m.where if isinstance(w, int))
    layout = Layout(width, height, tuple(maps), (0.5,) * stored, (maps[0].name,) * stored)
    table = Table("image", {}, settings={"layout": layout.to_json()})
    for name, shape in (("primary", (6, 5, 2)), ("cascaded", (4, 4, stored))):
        table.arrays[name] = in_bytes(rng.integers(0, 256, shape, dtype=np.uint8))
    save_table(path, table)
    return str(path)


def test_decode_to_files(folder, capsys):
    """PNG: bytes, sRGB. EXR: linear, half precision, single where that overflows."""
    make_file("t.npz")
    maps, layout, _ = decoded("t.npz")
    assert maps["glow"].max() > 65504 > 1 > maps["signed"].min() and maps["signed"].min() < 0
    for kind in ("png", "exr"):
        assert main(["decode", "t.npz", "-o", f"b.{kind}", "--json", "r.json"]) == 0
        assert report()["files"] == [f"b_{name}.{kind}" for name in layout.names]
        text = capsys.readouterr().out
        for name, values in maps.items():
            written, expected = read(f"b_{name}.{kind}"), values.astype(np.float64)
            assert f"b_{name}.{kind}: 7 x 5, {values.shape[2]} channel(s)" in text
            if kind == "png":
                np.testing.assert_array_equal(written, np.rint(255 * np.clip(expected, 0, 1)).astype(np.uint8))
                continue
            if name == "albedo":
                expected = np.where(expected <= 0.04045, expected / 12.92, ((expected + 0.055) / 1.055) ** 2.4)
            assert written.dtype == (np.float32 if name == "glow" else np.float16)
            np.testing.assert_allclose(written.astype(np.float64), expected, rtol=1e-3, atol=1e-6)
    assert main(["decode", "t.npz", "-o", "two.png", "--map", "ao", "--map", "normal", "--width", "2"]) == 0
    assert read("two_ao.png").shape == (5, 2, 1) and read("two_normal.png").shape == (5, 2, 3)


def test_what_decode_refuses(folder, capsys):
    make_file("t.npz")
    make_file("many.npz", maps=[MapLayout("many", "other", "linear", 1, tuple(range(6)))])
    save_table("unknown.npz", Table("cloth", {"a": StoredArray(np.zeros((2, 1), np.float32))}))
    save_table("other.npz", load_table(tasks()["ggx"].file()))
    before = sorted(os.listdir(folder))
    for arguments, sentence in (
        (["t.npz", "-o", "b.jpg"], 'output "b.jpg": found the extension ".jpg", allowed are .png and .exr'),
        (["t.npz", "-o", "gone/b.png"], 'output folder "gone" does not exist'),
        (["t.npz", "-o", "b.png", "--map", "colour"], 'found "colour", the file holds albedo, normal, ao'),
        (["gone.npz", "-o", "b.png"], "gone.npz: no such file"),
        (["other.npz", "-o", "b.png"], 'the task "ggx", which stand for nothing that could be decoded'),
        (["other.npz", "-o", "b.png", "--map", "a"], "other.npz: --map does not apply to this file"),
        (["unknown.npz", "-o", "b.png"], 'unknown.npz: holds tables for the task "cloth", installed are bsdf, disney'),
        (["many.npz", "-o", "b.png"], 'many.npz: "many" has 6 channels, PNG holds 4: use .exr'),
        (["t.npz", "-o", "b.png", "--width", "100000", "--height", "100000"], "are more than fit into memory"),
    ):
        assert sentence in refused(capsys, "decode", *arguments)
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize("name", ["plain", "one colour", "cleaned"])
def test_inspect_measures_against_the_source(folder, capsys, name):
    """From another folder, too; not against anything but the source."""
    values = np.full((6, 6, 3), 77, np.uint8) if name == "one colour" else waves()
    if name == "cleaned":
        values = values / np.float32(255)
        values[3, 4, 1] = np.nan
    (folder / "files").mkdir()
    source = write("a.exr" if name == "cleaned" else "a.png", values)
    assert fit(source, "--nonfinite", "clean", output="files/out.npz") == 0
    assert main(["inspect", "files/out.npz", "--measure", "--json", "r.json"]) == 0
    ((storage, measured),) = report()["measured_in_each_form"].items()
    model = load_model("files/out.npz", array_module("llvm").TensorXf)
    assert storage == model.storage and measured.pop("bytes") == model.nbytes
    assert measured.pop("memory_bytes") == model.memory_nbytes
    assert measured == pytest.approx(load_table("files/out.npz").measured, rel=1e-4)
    write(source, np.nan_to_num(values)[:5])
    assert "has changed since" in refused(capsys, "inspect", "files/out.npz", "--measure")
    os.unlink(source)
    assert f"{source}: no such file" in refused(capsys, "inspect", "files/out.npz", "--measure")
    make_file("t.npz")
    assert "t.npz: no source file is recorded" in refused(capsys, "inspect", "t.npz", "--measure")
