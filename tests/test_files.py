"""Files to write and to read: which ones are refused, and what stays behind."""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from commands import refused
from PIL import Image

import mi_diffind
from mi_diffind.core.errors import UsageError
from mi_diffind.core.files import (
    CACHE,
    MOST_NAMES,
    OutputError,
    RecordedKeys,
    cache_folder,
    check_distinct,
    replacing,
    same_file,
    unused_keys,
    unused_note,
)

#: Process that begins to write a file, says so, and waits to be killed.
WRITER = """
import sys, time
from mi_diffind.core.files import replacing
with replacing(sys.argv[1]) as temporary:
    temporary.write_bytes(b"half of it")
    print(temporary, flush=True)
    time.sleep(600)
"""


def begun(path):
    """A process that writes a file, and the path of its temporary file."""
    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, text=True)
    return process, process.stdout.readline().strip()


@pytest.mark.parametrize("name", ["a.npz", "noextension", "ä" * 120 + ".json", "a" * 250 + ".npz", "a[b].(c)*.npz"])
def test_a_killed_run_leaves_nothing_to_the_next(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"before")
    process, temporary = begun(path)
    assert os.path.dirname(temporary) == str(tmp_path) and os.path.getsize(temporary) == 10
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert os.path.exists(temporary) and path.read_bytes() == b"before"
    with replacing(path) as other:
        assert not os.path.exists(temporary)
        assert other.name.endswith(path.suffix)
        other.write_bytes(b"after")
    assert os.listdir(tmp_path) == [name] and path.read_bytes() == b"after"


def test_a_living_run_keeps_its_temporary_file(tmp_path):
    path = tmp_path / "a.npz"
    process, temporary = begun(path)
    try:
        with replacing(path) as other:
            other.write_bytes(b"first")
        assert os.path.getsize(temporary) == 10
        with replacing(path) as one, replacing(path) as two:  # within a process, too
            one.write_bytes(b"outer")
            two.write_bytes(b"inner")
        assert path.read_bytes() == b"outer"
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_other_files_are_not_taken_for_temporary_ones(tmp_path):
    others = [".a.npz", ".a-20240101.npz", ".a.unfinished-2024.npz", ".b.unfinished-0123abcd.npz", "a.json"]
    others += [".a.unfinished-0123abcd.json", ".a.unfinished-0123abcz.npz"]
    for name in others:
        (tmp_path / name).write_bytes(b"kept")
    os.symlink(tmp_path / "a.json", tmp_path / ".a.unfinished-00000000.npz")
    with replacing(tmp_path / "a.npz") as temporary:
        temporary.write_bytes(b"new")
    assert (tmp_path / "a.json").read_bytes() == b"kept"
    assert set(others) <= set(os.listdir(tmp_path))


def test_only_regular_files_are_replaced(tmp_path):
    """A device as a file to write was replaced by a file, with the rights to do so: /dev/null, as root."""
    pipe, folder = tmp_path / "pipe", tmp_path / "folder"
    os.mkfifo(pipe)
    folder.mkdir()
    os.symlink(pipe, tmp_path / "link")
    for path, fault in ((pipe, "is a pipe"), (folder, "is a folder"), (tmp_path / "link", "is a pipe")):
        with pytest.raises(OutputError, match=fault), replacing(path):
            raise AssertionError("reached")
    assert os.stat(pipe).st_mode == os.lstat(pipe).st_mode and len(os.listdir(tmp_path)) == 3


def test_a_link_is_written_through(tmp_path):
    """The link stays; its target, which may be missing, is replaced in its folder, in the format of the link's name."""
    target, link = tmp_path / "there" / "data.bin", tmp_path / "a.npz"
    target.parent.mkdir()
    (tmp_path / "between").symlink_to(target)
    link.symlink_to("between")
    for content in (b"first", b"second"):
        with replacing(link) as temporary:
            assert temporary.parent == target.parent and temporary.suffix == ".npz"
            temporary.write_bytes(content)
        assert link.is_symlink() and target.read_bytes() == content and not target.is_symlink()
    with pytest.raises(ZeroDivisionError), replacing(link):
        raise ZeroDivisionError
    assert os.listdir(target.parent) == ["data.bin"] and target.read_bytes() == b"second"
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "lost").symlink_to(tmp_path / "no" / "a")
    for name, fault in (("loop", "too many levels"), ("lost", 'no" does not exist')):
        with pytest.raises(OutputError, match=fault), replacing(tmp_path / name):
            raise AssertionError("reached")


def test_a_cache_that_cannot_be_made_names_its_variable(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    for name, fault in (("file/a/cache", "cannot be made: Not a directory"), ("file", "is not a folder")):
        monkeypatch.setenv(CACHE, str(tmp_path / name))
        with pytest.raises(OutputError, match=f"{fault}; the environment variable MI_DIFFIND_CACHE names another"):
            cache_folder()


def test_one_file_by_several_names(tmp_path):
    folder, file = tmp_path / "folder", tmp_path / "folder" / "a.npz"
    folder.mkdir()
    os.symlink(folder, tmp_path / "other")
    assert same_file(file, tmp_path / "other" / "a.npz")  # neither exists
    assert same_file(file, f"{folder}/../folder/./a.npz") and not same_file(file, folder / "b.npz")
    file.write_bytes(b"")
    os.symlink(file, tmp_path / "soft")
    os.link(file, tmp_path / "hard")
    os.symlink(tmp_path / "nowhere", tmp_path / "dangling")
    for name in ("soft", "hard"):
        assert same_file(file, tmp_path / name) and same_file(tmp_path / name, file)
        with pytest.raises(UsageError, match=r'^--json: found ".*", the same file as -o, allowed is another one$'):
            check_distinct({"-o": file, "--json": tmp_path / name}, {})
        with pytest.raises(UsageError, match=r"-o: .* the same file as --start"):
            check_distinct({"-o": file}, {"--start": ["x", str(tmp_path / name)]})
    assert same_file(tmp_path / "dangling", tmp_path / "nowhere") and not same_file(file, "a" * 5000)
    with pytest.raises(UsageError, match="the same file as source"):
        check_distinct({"--json": file}, {"source": f"{file}#part"})
    check_distinct({"-o": file, "--json": None, "x": ""}, {"a": file.with_name("b"), "b": np.zeros(3), "c": folder})
    check_distinct({}, {"a": file, "b": file})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A current folder with an image, a manifest, a scene and a link to the folder."""
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save("a.png")
    (tmp_path / "m.json").write_text(json.dumps({"albedo": "a.png"}))
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"/>')
    (tmp_path / "t.npz").write_bytes(b"a table")
    os.link("t.npz", "hard.npz")
    os.symlink("t.npz", "soft.npz")
    os.symlink(".", "here")
    return tmp_path


@pytest.mark.parametrize(
    "command, sentence",
    [
        ("fit ggx -o t.npz --json t.npz", "--json: found"),
        ("fit ggx -o t.npz --json hard.npz", "the same file as -o"),
        ("fit ggx -o t.npz --checkpoint hard.npz", "--checkpoint: found"),
        ("fit ggx -o new.npz --checkpoint here/new.npz", "the same file as -o"),
        ("fit ggx -o new.npz --checkpoint ck --json ./ck", "the same file as --checkpoint"),
        ("fit image a.png -o new.npz --checkpoint here/a.png", "the same file as source"),
        ("fit texture m.json -o new.npz --preview m.json", "--preview: found"),
        ("fit texture m.json -o t.npz --start hard.npz", "the same file as --start"),
        ("fit field . -o t.npz --grid here/t.npz", "--grid: found"),
        ("fit sdf scene.xml#ball -o new.npz --json scene.xml", "the same file as source"),
        ("fit scene scene.xml -o t.npz --start soft.npz", "the same file as --start"),
        ("inspect t.npz --json soft.npz", "the same file as the file to read"),
        ("decode t.npz -o hard.npz", "the same file as the file to read"),
        ("render scene.xml --json scene.xml", "the same file as the scene"),
        ("convert scene.xml -o new.xml --json here/new.xml", "the same file as -o"),
        ("regress scene.xml --json scene.xml", "the same file as a scene"),
        ("compare scene.xml --json scene.xml", "the same file as the scene"),
        ("capture scene.xml -o views --json scene.xml", "the same file as the scene"),
        ("tradeoff image a.png --json a.png", "the same file as source"),
    ],
)
def test_a_file_is_not_written_over_another_one(folder, capsys, command, sentence):
    before = {name: (folder / name).read_bytes() for name in os.listdir(folder) if (folder / name).is_file()}
    message = refused(capsys, *command.split())
    assert sentence in message and len(message) < 300
    names = [name for name in os.listdir(folder) if (folder / name).is_file()]
    assert {name: (folder / name).read_bytes() for name in names} == before


def test_the_function_refuses_as_the_command_does(folder):
    with pytest.raises(UsageError, match=r"-o: found .* the same file as --start"):
        mi_diffind.fit("texture", "m.json", start="t.npz", output="hard.npz")
    with pytest.raises(UsageError, match=r"--checkpoint: found .* the same file as source"):
        mi_diffind.fit("image", "a.png", checkpoint="here/a.png")


TEXT = '{"a": 1, "b": {"c": 2, "d": 3}, "e": [{"f": 4, "g": 5}, {"f": 6, "g": 7, "h": {"i": 8}}], "j": null}'


def content():
    return json.loads(TEXT, object_hook=RecordedKeys)


def test_keys_of_all_levels():
    assert unused_keys(content()) == ["a", "b", "e", "j"]
    read = content()
    assert read["a"] == 1 and read["b"].get("d") == 3 and read["e"][1]["h"]["i"] == 8
    assert unused_keys(read) == ["b.c", "e.f", "e.g", "j"]
    assert read["e"][0]["f"] == 4 and "g" in read["e"][0]  # those of the second remain
    assert unused_keys(read) == ["b.c", "e.f", "e.g", "j"]
    for entry in read["e"]:
        assert dict(entry.items())
    assert unused_keys(read) == ["b.c", "j"]


def test_the_sentence():
    read = content()
    assert list(read.items()) and list(read["b"].items())
    note = unused_note("folder/x.json", read, also=("k",))
    assert note == "x.json: keys that are not used: e.f, e.g, e.h, k"
    assert unused_note("x.json", RecordedKeys()) is None
    many = RecordedKeys({f"\x1b{i}": 0 for i in range(MOST_NAMES + 2)} | {"l" * 1000: 0})
    note = unused_note("x.json", many)
    assert note.endswith(" and 3 more") and "\x1b" not in note and "\\x1b0, \\x1b1, " in note
