"""Files of strangers: a small file takes little memory, whatever it claims, and its text cannot steer a terminal."""

import json
import os
import tracemalloc
import zlib
from pathlib import Path

import damage
import mitsuba as mi
import numpy as np
import pytest
from commands import refused
from PIL import Image

import mi_diffind
from mi_diffind import DiffindError, TableError, load_table, save_table
from mi_diffind.arrays.tables import Table, byte_array
from mi_diffind.core.archives import FACTOR, FREE, VARIABLE, Allowance, LimitError, allowed, json_bytes
from mi_diffind.core.errors import LONGEST_MESSAGE, UsageError
from mi_diffind.core.files import PATHS, OutputError
from mi_diffind.core.units import figure_lines
from mi_diffind.fitting.task import FitSettings
from mi_diffind.images.reader import picture_size
from mi_diffind.maps.pyramid import map_figure
from mi_diffind.maps.source import SourceError, load_source
from mi_diffind.scenes.inspection import Inspection
from mi_diffind.tasks.radiance.captures import ViewsError, image_file


def png(path, width: int, height: int, depth: int, colour: int = 0) -> Path:
    """A black PNG."""
    row = bytes(1 + (width * depth * {0: 1, 2: 3}[colour] + 7) // 8)
    path.write_bytes(damage.png(width, height, zlib.compress(height * row, 9), colour, depth))
    return path


def test_the_limit_and_how_to_raise_it(tmp_path, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    assert allowed(0) == FREE and allowed(10**6) == FREE + FACTOR * 10**6
    path = tmp_path / "file"
    path.write_bytes(bytes(1000))
    allowance = Allowance(path)
    allowance.take(FREE, "a part")
    with pytest.raises(LimitError, match=rf"file: a part .* file of 1,000 bytes .*{VARIABLE}=1G allows more"):
        allowance.take(FREE, "a part")
    monkeypatch.setenv(VARIABLE, "1G")
    assert allowed(0) == 2**30 and allowed(10**8) == FREE + FACTOR * 10**8  # it raises only
    with pytest.raises(LimitError, match="this machine has"):
        Allowance(path).take(2**60, "a part")
    monkeypatch.setenv(VARIABLE, "much")
    with pytest.raises(UsageError, match=rf"{VARIABLE}: 'much' is not a number of bytes"):
        allowed(0)


def test_a_raised_limit_reads_the_file(tmp_path, monkeypatch):
    path = tmp_path / "t.npz"
    save_table(path, Table("a task", {"a": byte_array(np.zeros((2**24, 1), np.uint8))}))
    with pytest.raises(TableError, match=VARIABLE):
        load_table(path)
    monkeypatch.setenv(VARIABLE, "200M")
    assert load_table(path).arrays["a"].shape == (2**24, 1)


def test_the_bound_of_json_holds():
    """Against the memory that parsing takes, for the texts that take the most."""
    emoji = "\U0001f600".join(('"', '",')).encode()
    for part in (b"[],", b"{},", b'{"a":1},', b"1.5,", b'"\xc3\xa9",', emoji, b"[[]],"):
        text = b"[" + part * 20_000 + b"0]"
        tracemalloc.start()
        content = json.loads(text)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert len(content) == 20_001 and peak <= json_bytes(text), part


def test_sizes_of_pictures(tmp_path, rng):
    """Against what Mitsuba decodes."""
    values = rng.integers(0, 255, (13, 17, 3)).astype(np.uint8)
    for name in ("x.png", "x.jpg", "x.bmp", "x.tga", "x.ppm"):
        Image.fromarray(values).save(tmp_path / name)
    for name in ("x.exr", "x.hdr", "x.pfm"):
        mi.Bitmap(values.astype(np.float32)).write(str(tmp_path / name))
    mi.Bitmap(values.astype(np.float16)).write(str(tmp_path / "half.exr"))
    for path in tmp_path.iterdir():
        size = picture_size(path)
        assert size[:2] == (17, 13), path
        depth = {".ppm": 2, ".exr": 2 if path.stem == "half" else 4, ".hdr": 4, ".pfm": 4}.get(path.suffix, 1)
        assert size[2] == 3 * depth, path
    (tmp_path / "cut.png").write_bytes((tmp_path / "x.png").read_bytes()[:20])
    (tmp_path / "text").write_text("no picture")
    assert picture_size(tmp_path / "cut.png") is None and picture_size(tmp_path / "text") is None


def test_a_batch_beyond_memory(tmp_path, capsys, monkeypatch):
    """Dr.Jit ends the process with a segmentation fault where memory cannot be allocated."""
    monkeypatch.setattr("mi_diffind.core.units.memory", lambda: 2**34)
    for task in (["ggx"], ["sdf", "no.ply"]):
        message = refused(capsys, "fit", *task, "-o", str(tmp_path / "a.npz"), "--batch", str(2**31 - 1))
        assert "batch: found 2,147,483,647, which takes about 128 GiB of memory, this machine has 16 GiB" in message
    for given in ({"batch": 2**31}, {"seed": 2**32}, {"batch": "8"}, {"steps": 1.5}, {"lr": "1"}, {"seed": True}):
        with pytest.raises(DiffindError, match=next(iter(given))):
            FitSettings(**given)
    for seconds in (0, -1, 10**400, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="seconds: found"):
            mi_diffind.fit("ggx", seconds=seconds)


def test_messages_cannot_steer_a_terminal():
    for error in (DiffindError, TableError, OutputError):
        message = str(error("t.npz: \x1b[31m is red\x07,\n \x9b and \u202e turned, α stays"))
        assert message == "t.npz: \\x1b[31m is red\\x07,\\n \\x9b and \\u202e turned, α stays"
        long = str(error("begin " + "x" * 5000 + " end"))
        assert len(long) == LONGEST_MESSAGE and long.startswith("begin") and long.endswith("end")


def test_inspection_cannot_steer_a_terminal(tmp_path):
    figures = {
        "file": "t.npz", "task": "a\x1b]0;title\x07", "preset": "\x1b[2J", "bytes": 1, "storage": "uint8", "arrays": {},
        "settings": {"name": "\x1b[31m"}, "seed": 0, "measured": {"psnr_\x1b_db": 1.0},
    }  # fmt: skip
    for verbose in (False, True):
        lines = Inspection(figures, ["remark \x1b"], ["usage \x1b"]).lines(verbose)
        assert lines and all(line.isprintable() for line in lines)


def test_files_name_others_in_their_folder(tmp_path, monkeypatch):
    folder = tmp_path / "material"
    (folder / "maps").mkdir(parents=True)
    png(tmp_path / "outside.png", 4, 4, 8, 2)
    png(folder / "maps" / "inside.png", 4, 4, 8, 2)
    manifest = folder / "m.json"
    for name in ("../outside.png", str(tmp_path / "outside.png"), "maps/../../outside.png"):
        manifest.write_text(json.dumps({"albedo": name}))
        with pytest.raises(SourceError, match=rf"outside of its folder.*{PATHS}=any"):
            load_source(manifest)
        with pytest.raises(ViewsError, match="outside of its folder"):
            image_file(folder, name, folder / "transforms.json")
        monkeypatch.setenv(PATHS, "any")
        assert load_source(manifest).texels == 16
        assert image_file(folder, name, folder / "transforms.json").samefile(tmp_path / "outside.png")
        monkeypatch.delenv(PATHS)
    for name in ("maps/inside.png", "./maps/../maps/inside.png", os.path.join(folder, "maps", "inside.png")):
        manifest.write_text(json.dumps({"albedo": name}))
        assert load_source(manifest).texels == 16


def test_maps_may_be_called_as_figures():
    """A map's PSNR has a name of its own, whatever the map is called."""
    figures = ["psnr_db", "psnr_mean_db", "psnr_between_db"]
    figures += map(map_figure, ("mean", "between", "worst", "l0", "map_mean", "albedo"))
    assert len(set(figures)) == len(figures)
    assert map_figure("albedo") == "psnr_albedo_db" and map_figure("mean") == "psnr_map_mean_db"
    assert figure_lines({"psnr_map_between_db": 1.0, "psnr_map_l0_db": 2.0}) == [
        "PSNR map between  1.00 dB", "PSNR map l0       2.00 dB",
    ]  # fmt: skip
