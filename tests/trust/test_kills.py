"""Runs that are killed (SIGKILL) at drawn moments and gone on with: the bytes of an undisturbed run, and no file beside
them. Moments do not depend on the speed of the machine.
"""

import json
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

from mi_diffind.commands import cli

SCENE = """
<scene version="3.0.0">
    <integrator type="direct"/>
    <emitter type="constant"/>
    <shape type="sphere"><float name="radius" value="0.5"/></shape>
    <bsdf type="roughplastic" id="paint"><float name="alpha" value="0.2"/></bsdf>
</scene>
"""

#: Name of all checkpoints here.
STATE = "state.npz"

#: Words of a fit with a checkpoint.
FIT = ["-o", "own.npz", "--checkpoint", STATE, "--variant", "llvm_ad_rgb"]


def run_command(arguments: list[str], folder: Path, moment: str = "", prepare: str = "") -> int | None:
    """Run a command in another process; return its number of calls, ``None`` if it was killed.

    A moment is the number of a call in Python code: ``17`` kills the process in the 17th call of any function.
    ``prepare`` names a function that is called first.
    """
    request = json.dumps({"arguments": arguments, "moment": moment, "prepare": prepare})
    done = subprocess.run(
        [sys.executable, __file__, request], cwd=folder, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    if done.returncode == -signal.SIGKILL and moment:
        return None
    assert done.returncode == 0, done.stderr[-2000:]
    return int(done.stdout.splitlines()[-1])


def files(folder: Path) -> dict[str, bytes]:
    """Return the content of all files in a folder, by path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def main(arguments: list[str], moment: str, prepare: str) -> None:
    """Run one command in this process."""
    if prepare:
        globals()[prepare]()
    last, calls = int(moment or 0), 0

    def count(frame, event, argument):
        nonlocal calls
        calls += event in ("call", "c_call")
        if last and calls == last:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(count)
    code = cli.main(arguments)
    sys.setprofile(None)
    print(calls)
    sys.exit(code)


def measure_little() -> None:
    """Measure results at few places."""
    from mi_diffind.tasks.ggx.training import GGXModel

    GGXModel.measure.__defaults__ = (2**12,)


def kill_and_go_on(command, folder, kills=1, prepare="", resume=()):
    """Run a command in ``folder / "whole"``; in ``folder / "killed"``, kill it at drawn moments, each time going on.

    Returns the files of both folders.
    """
    whole, killed = (folder / name for name in ("whole", "killed"))
    for each in (whole, killed):
        each.mkdir()
    calls, rng = run_command(command, whole, prepare=prepare), random.Random(1)

    def again():  # a run that was killed before its first checkpoint has none to go on from
        return [*command, *(resume if (killed / STATE).exists() else ())]

    moments = [str(rng.randrange(calls // 3, calls)) for _ in range(kills)]
    ended = [run_command(again(), killed, moment, prepare) for moment in moments]
    assert None in ended, "the moments lie after the end of the run"
    run_command(again(), killed, prepare=prepare)
    return files(whole), files(killed)


def assert_same(first, second, differing=()):
    """Assert that two folders hold the same files, with the same bytes but for those that hold times."""
    assert list(first) == list(second)
    assert [name for name, content in first.items() if content != second[name] and name not in differing] == []


def test_a_training(tmp_path):
    command = ["fit", "ggx", *FIT, "--steps", "401", "--batch", "64", "--primary", "4", "--cascaded", "3"]
    files = kill_and_go_on(command, tmp_path, 1, "measure_little", ["--resume"])
    assert_same(*files, differing={STATE})


def test_a_capture(tmp_path):
    (tmp_path / "scene.xml").write_text(SCENE)
    command = ["capture", "../scene.xml", "-o", "views", "--views", "3", "--test", "1", "--resolution", "8",
               "--spp", "2", "--variant", "llvm_ad_rgb"]  # fmt: skip
    assert_same(*kill_and_go_on(command, tmp_path))


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
