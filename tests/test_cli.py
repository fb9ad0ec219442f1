"""The command line: what it writes, what it says, and how it refuses."""

import json
import os
import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from commands import interrupt_at, refused

from mi_diffind.arrays.tables import load_table
from mi_diffind.commands.cli import VERBS, main
from mi_diffind.fitting.task import tasks
from mi_diffind.tasks.ggx.training import GGXProblem

SCENES = Path(__file__).resolve().parents[1] / "scenes"
#: Two materials, exact and from tables, under one lamp.
LAMP = Path(__file__).resolve().parent / "lamp.xml"
SMALL = ["-D", "width=48", "-D", "height=28", "--spp", "4"]


def shipped(task, preset=""):
    return tasks()[task].file(preset=preset)


def entries(task):
    """How many numbers are in the tables that ship for a task."""
    return sum(array.entries.size for array in load_table(shipped(task)).arrays.values())


def scene_file(tmp_path, bsdf='<bsdf type="neural_disney"/>'):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><default name="width" value="16"/><default name="height" value="16"/>'
        '<integrator type="path"/><emitter type="constant"/>'
        '<sensor type="perspective"><sampler type="independent"><integer name="sample_count" value="2"/></sampler>'
        '<film type="hdrfilm"><integer name="width" value="$width"/><integer name="height" value="$height"/></film>'
        "</sensor>"
        f'<shape type="sphere"><transform name="to_world"><translate z="4"/></transform>{bsdf}</shape></scene>'
    )
    return str(path)


def test_render(tmp_path, capsys):
    out, report = tmp_path / "image.exr", tmp_path / "report.json"
    assert main(["render", str(SCENES / "still_life.xml"), "-o", str(out), "--json", str(report), *SMALL]) == 0
    assert str(out) in capsys.readouterr().out
    image = np.array(mi.Bitmap(str(out)))
    assert image.shape == (28, 48, 3) and np.isfinite(image).all() and image.mean() > 0.01
    found = json.loads(report.read_text())
    assert found["spp"] == 4 and found["width"] == 48 and found["variant"].endswith("_ad_rgb")
    assert len(found["learned_plugins"]) == 9 and found["seconds_render"] > 0
    assert found["table_bytes"] == entries("disney")
    assert sorted(os.listdir(tmp_path)) == ["image.exr", "report.json"]  # nothing temporary stays
    assert main(["render", str(SCENES / "still_life.xml"), "-o", str(tmp_path / "image.png"), *SMALL]) == 0
    assert np.array(mi.Bitmap(str(tmp_path / "image.png"))).shape == (28, 48, 3)


def test_compare(tmp_path, capsys):
    out, report = tmp_path / "pictures", tmp_path / "report.json"
    small = ["-D", "width=48", "-D", "height=28", "-D", "spp=4"]  # a name of defines may be one of options, too
    assert main(["compare", str(LAMP), "--out", str(out), "--json", str(report), *small, "--passes", "2"]) == 0
    text = capsys.readouterr().out
    assert "PSNR" in text and "FLIP" in text
    assert "against     exact (disney), " in text and "not measured: 1 pair of passes without compilation" in text
    assert sorted(os.listdir(out)) == ["comparison.png", "error.exr", "exact.exr", "written.exr"]
    assert np.array(mi.Bitmap(str(out / "comparison.png"))).std() > 20  # not blank
    found = json.loads(report.read_text())
    written, exact, error = (np.array(mi.Bitmap(found["files"][k])) for k in ("written", "exact", "error"))
    assert np.allclose(np.abs(written - exact), error, atol=1e-5)
    mse = np.mean((np.clip(written, 0, 1) - np.clip(exact, 0, 1)) ** 2)
    assert found["psnr_db"] == pytest.approx(-10 * np.log10(mse), abs=0.01)
    assert found["time_ratio"]["min"] <= found["time_ratio"]["q1"] <= found["time_ratio"]["max"]
    assert found["time_ratio"]["pairs"] == 1 and found["time_ratio"]["median"] is None  # the first compiled
    assert found["further"] == [] and found["noise_db"] > found["psnr_db"]
    assert {"flip", "mae", "seconds_per_pass", "learned_plugins", "table_bytes"} <= set(found)


def test_inspect_tables(tmp_path, capsys):
    report = tmp_path / "report.json"
    assert main(["inspect", str(shipped("disney", "paper")), "--json", str(report)]) == 0
    text = capsys.readouterr().out
    assert "12,480 bytes" in text and "PSNR" in text and '<bsdf type="neural_disney">' in text
    assert not any(word in text for word in ("masking", "gathers a read", "trained with"))
    assert main(["inspect", str(shipped("disney", "paper")), "--verbose"]) == 0
    text = capsys.readouterr().out
    assert all(word in text for word in ("masking", "gathers a read", "trained with"))
    found = json.loads(report.read_text())
    assert found["task"] == "disney" and found["arrays"]["ggx"]["channels"] == 3
    assert sum(a["bytes"] for a in found["arrays"].values()) == found["bytes"]


#: Enough steps to see that it trains.
FIT = ["--steps", "10", "--batch", "2048", "--variant", "llvm_ad_rgb"]


def test_an_interrupted_fit_keeps_the_best(tmp_path, capsys, few_samples, monkeypatch):
    """Ctrl-C; ``tests/trust/test_kills.py`` and ``tests/tasks/sdf`` go on with one."""
    out, report = tmp_path / "own.npz", tmp_path / "report.json"
    interrupt_at(monkeypatch, GGXProblem, "batch", 259)
    command = ["fit", "--json", str(report), "ggx", "--steps", "500", "--batch", "512", "--variant", "llvm_ad_rgb"]
    assert main([*command, "-o", str(out)]) == 130
    text, found = capsys.readouterr(), json.loads(report.read_text())
    assert "interrupted at step 259, kept step " in text.out and "stopping after this step" in text.err
    assert found["interrupted"] and out.exists() and "NaN" not in report.read_text()
    assert [(h["step"], h["loss"] is None) for h in found["history"]] == [(200, False), (259, True)]


def test_interrupted_renders_keep_what_they_have(mi_rgb, tmp_path, monkeypatch, capsys):
    """Ctrl-C in the second pass of each command."""
    passes = interrupt_at(monkeypatch, mi_rgb, "render", 2)
    out, report, folder = tmp_path / "image.exr", tmp_path / "report.json", tmp_path / "pictures"
    scene, variant = scene_file(tmp_path), ["--variant", mi_rgb.variant()]
    assert main(["render", scene, "-o", str(out), "--json", str(report), "--spp", "96", *variant]) == 130
    assert "interrupted, kept 32 of 96 spp" in capsys.readouterr().out
    assert json.loads(report.read_text())["spp"] == 32
    assert np.array(mi_rgb.Bitmap(str(out))).mean() > 0.01
    passes.clear()
    assert main(["compare", scene, "--out", str(folder), "--spp", "20", *variant]) == 130
    assert "interrupted, kept 4 of 20 spp" in capsys.readouterr().out and (folder / "comparison.png").exists()


HELP = """
import contextlib, io, json, sys
from mi_diffind.commands.cli import main

texts = []
for arguments in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as text:
        try:
            main([*arguments, "--help"])
        except SystemExit as e:
            assert e.code == 0, arguments
    texts.append(text.getvalue())
print(json.dumps({"texts": texts, "modules": sorted(sys.modules)}))
"""

#: What nobody wants to wait for who asks for help.
HEAVY = {"drjit", "mitsuba", "matplotlib", "OpenEXR", "trimesh", "scipy"}


def asked_for_help(commands):
    """The texts, and the modules that were imported on the way."""
    done = subprocess.run(
        [sys.executable, "-c", HELP, json.dumps(commands)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    return dict(zip(map(tuple, commands), found["texts"], strict=True)), set(found["modules"])


def test_help_is_light():
    """It imports neither Mitsuba nor Dr.Jit, nor training; of a study, no other one; the command looks for no tasks."""
    modules = asked_for_help([[]])[1]
    assert not (HEAVY | {"numpy", "tqdm"}) & modules
    assert not [m for m in modules if m.startswith("mi_diffind.tasks.") and m.split(".")[2] in tasks()]
    text, modules = asked_for_help([[], *([verb] for verb in VERBS), *(["fit", name] for name in tasks())])
    of_studies, of_disney = asked_for_help([["tradeoff", "disney"]])
    assert {m for m in of_disney if m.startswith("mi_diffind.studies.") and ".baselines" not in m} == {
        "mi_diffind.studies.disney"
    }
    text |= of_studies
    for command, found in text.items():
        words = " ".join(["mi-diffind", *command])
        assert found.startswith(f"usage: {words} [-h]"), command
        example = " ".join(found.rpartition("example: ")[2].split())
        assert not command or example.startswith(words), command
    assert all(f"\n    {verb} " in text[()] for verb in VERBS)
    training = (".texture.fit", ".loading", ".loop", ".model", ".compressed")
    assert not HEAVY & modules and not [m for m in modules if m.endswith(training)]
    assert "--primary" in text["fit", "ggx"] and "--primary" not in text["fit", "disney"]  # those of the task only


# -- bad input ---------------------------------------------------------------------------------------------------------


def test_missing_files(tmp_path, capsys):
    out = ["--out", str(tmp_path / "o")]
    for words, options in ((["render"], []), (["compare"], out), (["inspect"], [])):
        assert "nowhere.xml: no such scene file" in refused(capsys, *words, "nowhere.xml", *options)
    assert not (tmp_path / "o").exists()
    assert "nowhere.npz: no such file" in refused(capsys, "inspect", "nowhere.npz")


@pytest.mark.parametrize(
    "bsdf, sentence",
    [
        ('<bsdf type="neural_disney"><float name="roughness" value="1.5"/></bsdf>', "found 1.5, allowed is [0, 1]"),
        ('<bsdf type="neural_disney"><float name="roughnes" value="0.5"/></bsdf>', '"roughnes"'),
        ('<bsdf type="neural_disney"><float name="spec_trans" value="0.5"/></bsdf>', "no transmission"),
        ('<bsdf type="neural_disney"><string name="filename" value="no.npz"/></bsdf>', "no.npz: no such file"),
        ('<bsdf type="neural_disney"><string name="filename" value="scene.xml"/></bsdf>', "xml: not a table file"),
        ('<bsdf type="neural_disneyy"/>', "neural_disneyy"),
        ("<bsdf", "scene.xml"),
    ],
)
def test_bad_scenes(tmp_path, capsys, bsdf, sentence):
    path, out = scene_file(tmp_path, bsdf), tmp_path / "image.exr"
    message = refused(capsys, "render", path, "-o", str(out))
    assert sentence in message and "scene.xml" in message
    assert not any(noise in message for noise in (".cpp:", "Error: "))
    assert not out.exists()


def test_bad_options(tmp_path, capsys):
    path = scene_file(tmp_path)
    for name, fault in (
        ("llvm_rgb", 'the variant "llvm_rgb" does not exist; available are'),
        ("scalar_rgb", 'does not run in the variant "scalar_rgb"; use one of'),
    ):
        assert fault in refused(capsys, "render", path, "--variant", name)
    assert "expected NAME=VALUE" in refused(capsys, "render", path, "-D", "width")
    assert "nothing" in refused(capsys, "render", path, "-D", "nothing=1")
    assert "allowed are .exr and .png" in refused(capsys, "render", path, "-o", str(tmp_path / "image.tiff"))
    for arguments in (["render", path, "--spp", "0"], ["nothing"], []):
        refused(capsys, *arguments)


def test_bad_tasks(capsys):
    for arguments, sentence in (
        (["fit", "nothing", "-o", "t.npz"], "mi-diffind fit: error: argument TASK: invalid choice: 'nothing'"),
        (["fit", "disney", "-o", "t.npz", "--preset", "best"], "fit disney: error: argument --preset: invalid choice"),
        (["fit", "image", "a.png", "-o", "t.npz", "--storage", "uint8"], "unrecognized arguments: --storage uint8"),
        (["fit", "disney", "-o", "t.npz", "--steps", "5", "--seconds", "5"], "not allowed with argument --steps"),
        (["tradeoff", "nothing"], "mi-diffind tradeoff: error: argument STUDY: invalid choice: 'nothing'"),
        (["fit"], "mi-diffind fit: error: the following arguments are required: TASK"),
        (["fit", "disney", "-o", "t.npz", "--primary", "8"], "unrecognized arguments: --primary 8"),
        (["fit", "ggx", "-o", "t.npz", "--primary", "1"], "--primary: found 1, allowed are 2 to 4096 entries a side"),
    ):
        assert sentence in refused(capsys, *arguments)


def test_checkpoints_replace_nothing_else(tmp_path, capsys, few_samples):
    table, checkpoint = tmp_path / "table.npz", tmp_path / "state.npz"
    table.write_bytes(shipped("disney").read_bytes())
    fit = ["fit", "disney", *FIT, "-o", str(tmp_path / "own.npz")]
    assert "would replace a file that is not one" in refused(capsys, *fit, "--checkpoint", str(table))
    assert table.read_bytes() == shipped("disney").read_bytes()
    for _ in range(2):  # its own checkpoint may be replaced
        assert main([*fit, "--checkpoint", str(checkpoint)]) == 0
    assert "is the checkpoint of a training" in refused(capsys, "inspect", str(checkpoint))
    assert "--checkpoint FILE" in refused(capsys, *fit, "--resume")


def test_not_a_scene(tmp_path, capsys):
    assert ".: is a folder, a scene file is needed" in refused(capsys, "render", ".")
    path = tmp_path / "bsdf.xml"
    path.write_text('<bsdf version="3.0.0" type="neural_disney"/>')
    assert "a scene is expected" in refused(capsys, "render", str(path), "-o", str(tmp_path / "image.exr"))


def test_bad_output_folders(tmp_path, capsys):
    """Said before anything is rendered or trained."""
    path, missing = scene_file(tmp_path), tmp_path / "missing"
    for arguments in (
        ["render", path, "-o", str(missing / "image.exr")],
        ["fit", "disney", "-o", str(missing / "own.npz")],
        ["render", path, "-o", str(tmp_path / "image.exr"), "--json", str(missing / "report.json")],
        ["fit", "disney", "-o", str(tmp_path / "own.npz"), "--checkpoint", str(missing / "state.npz")],
    ):
        assert f'output folder "{missing}" does not exist' in refused(capsys, *arguments)
    for words in (["compare", path], ["tradeoff", "disney"]):
        assert f'output folder "{missing / "a"}"' in refused(capsys, *words, "--out", str(missing / "a"))
    assert not missing.exists()
    assert "is not a folder" in refused(capsys, "render", path, "-o", f"{path}/image.exr")
    (tmp_path / "own.npz").mkdir()
    assert "is a folder" in refused(capsys, "fit", "disney", "-o", str(tmp_path / "own.npz"))


def test_read_only_output_folder(tmp_path, capsys):
    path = scene_file(tmp_path)
    if os.geteuid() == 0:  # root writes everywhere but into the kernel's own file systems
        folder = Path("/proc/self/task")
    else:
        folder = tmp_path / "locked"
        folder.mkdir(mode=0o555)
    for arguments in (
        ["render", path, "-o", str(folder / "image.exr")],
        ["compare", path, "--out", str(folder)],
        ["compare", path, "--out", str(folder / "new")],
        ["fit", "disney", "-o", str(folder / "own.npz")],
    ):
        assert "cannot be written" in refused(capsys, *arguments)
