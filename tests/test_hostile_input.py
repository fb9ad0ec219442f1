"""Input that is wrong by accident or on purpose: one sentence and the exit code 2, at once."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from commands import refused

from mi_diffind.commands.cli import main
from mi_diffind.core.errors import DiffindError, UsageError
from mi_diffind.fitting.settings import FitSettings, within_memory

PATHS = ("a" * 300, "a/" * 2500, "a" * 5000)


@pytest.mark.parametrize("value", [str(2**31), str(2**64), str(2**70), "9" * 5000])
@pytest.mark.parametrize("option", ["batch", "steps", "seconds", "seed"])
def test_numbers_beyond_32_bits(tmp_path, capsys, option, value):
    if (option, value) == ("seed", str(2**31)):
        pytest.skip("seeds have 32 bits")
    with pytest.raises(SystemExit) as end:
        main(["fit", "ggx", "-o", str(tmp_path / "a.npz"), f"--{option}", value])
    message = capsys.readouterr().err.splitlines()[-1]
    assert end.value.code == 2 and f"--{option}: " in message and len(message) < 300
    assert not os.listdir(tmp_path)


def test_a_batch_beyond_memory(tmp_path, capsys, monkeypatch):
    """Dr.Jit ends the process with a segmentation fault where memory cannot be allocated."""
    monkeypatch.setattr("mi_diffind.core.units.memory", lambda: 2**34)
    for task in (["ggx"], ["sdf", "no.ply"]):
        message = refused(capsys, "fit", *task, "-o", str(tmp_path / "a.npz"), "--batch", str(2**31 - 1))
        assert "batch: found 2,147,483,647, which takes about 128 GiB of memory, this machine has 16 GiB" in message
    assert within_memory(FitSettings(batch=2**28)).batch == 2**28
    for given in ({"batch": 2**31}, {"seed": 2**32}, {"batch": "8"}, {"steps": 1.5}, {"lr": "1"}, {"seed": True}):
        with pytest.raises(DiffindError, match=next(iter(given))):
            FitSettings(**given)
    for seconds in (0, -1, 10**400, float("nan"), float("inf")):
        with pytest.raises(UsageError, match="seconds: found"):
            import mi_diffind

            mi_diffind.fit("ggx", seconds=seconds)


@pytest.mark.parametrize("path", PATHS, ids=len)
@pytest.mark.parametrize(
    "command",
    [
        "fit ggx -o PATH.npz",
        "fit ggx -o a.npz --json PATH",
        "fit ggx -o a.npz --steps 1 --checkpoint PATH",
        "fit image PATH.png -o a.npz",
        "fit image PATH.json -o a.npz",
        "fit sdf PATH.obj -o a.npz",
        "fit field PATH -o a.npz",
        "fit bsdf PATH.xml -o a.npz",
        "inspect PATH.npz",
        "render PATH.xml -o a.exr",
        "decode PATH.npz -o a.png",
        "decode a.npz -o PATH.png",
        "compare PATH.xml",
        "capture PATH.xml -o views",
    ],
)
def test_long_paths(tmp_path, monkeypatch, capsys, command, path):
    monkeypatch.chdir(tmp_path)
    message = refused(capsys, *(word.replace("PATH", path) for word in command.split()))
    assert len(message) < 300 and not os.listdir(tmp_path)


@pytest.mark.parametrize(
    "command",
    [
        "fit image PATH.png -o a.npz",
        "fit texture PATH.json -o a.npz",
        "fit image m.json -o a.npz",
        "fit sdf PATH.obj -o a.npz",
        "fit bsdf PATH.csv -o a.npz",
        "fit field PATH.ply -o a.npz",
        "fit field views -o a.npz",
        "fit ggx -o a.npz --resume --checkpoint PATH.c",
        "inspect PATH.npz",
        "render PATH.xml",
    ],
)
@pytest.mark.parametrize("target", ["pipe", "device"])
def test_pipes_and_devices_are_not_read(tmp_path, command, target):
    """In a process of its own: a pipe blocks whoever opens it, and a device never ends."""
    words = command.split()
    suffix = next((os.path.splitext(w)[1] for w in words if w.startswith("PATH")), ".png")
    (tmp_path / "views").mkdir()
    for name in (f"PATH{suffix}", "views/transforms.json"):
        os.mkfifo(tmp_path / name) if target == "pipe" else os.symlink("/dev/zero", tmp_path / name)
    (tmp_path / "m.json").write_text(json.dumps({"albedo": "PATH.png"}))
    done = subprocess.run(
        [sys.executable, "-m", "mi_diffind.commands.cli", *words],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=100,
    )
    last = done.stderr.strip().splitlines()[-1]
    assert done.returncode == 2 and last.startswith("mi-diffind: error: ") and "Traceback" not in done.stderr
    assert f"is a {target}" in last or "holds no views" in last


def test_checkpoints_of_wrong_types(tmp_path, capsys):
    checkpoint = tmp_path / "state.ck"
    command = ["fit", "ggx", "-o", str(tmp_path / "a.npz"), "--steps", "4", "--checkpoint", str(checkpoint)]
    assert main(command) == 0
    with np.load(checkpoint) as data:
        arrays = dict(data)
    meta = json.loads(arrays["meta"].tobytes())
    keys = ("step", "lr_scale", "best_measured", "best_step", "history", "restarts", "seconds", "plateau", "references")
    for key in (*keys, "settings"):
        for value in (None, "x", [1], {"a": "b"}):
            changed = json.dumps({**meta, key: value}).encode()
            with open(checkpoint, "wb") as stream:
                np.savez(stream, **{**arrays, "meta": np.frombuffer(changed, np.uint8)})
            assert main([*command, "--resume"]) == 2, (key, value)
            message = capsys.readouterr().err
            assert "the checkpoint" in message and "Traceback" not in message and len(message) < 300
