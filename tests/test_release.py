"""The package without a checkout: the example scenes, the data of the pages, the wheel and the source archive."""

import functools
import hashlib
import http.server
import json
import re
import shutil
import subprocess
import sys
import tarfile
import threading
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import pytest
from commands import refused

import mi_diffind
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.scenes import examples

ROOT = Path(__file__).resolve().parents[1]

CONTENT = {"one.bin": bytes(range(256)) * 700, "two.bin": b"two"}


def below(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


# -- Example scenes ----------------------------------------------------------------------------------------------------


def test_examples(tmp_path, capsys):
    folder, report = tmp_path / "scenes", tmp_path / "report.json"
    assert main(["examples", str(folder), "--json", str(report)]) == 0
    text, written = capsys.readouterr().out, below(folder)
    assert {p.name for p in (ROOT / "scenes").glob("*.xml")} | {"README.md"} == {n for n in written if "/" not in n}
    for name, content in written.items():
        assert content == (ROOT / "scenes" / name).read_bytes(), name
    assert not [name for name in written if name.startswith("references") or name.endswith((".py", ".jpg"))]
    figures = json.loads(report.read_text())
    assert figures["files"] == len(written) and figures["bytes"] == sum(map(len, written.values()))
    assert all(Path(scene).is_file() and scene in text for scene in figures["scenes"])


def test_examples_hold_all_that_they_read(tmp_path):
    """Each file that a scene names, with the values of its ``<default>``s, is in the folder."""
    mi_diffind.examples(tmp_path / "scenes")
    checked = 0
    for scene in (tmp_path / "scenes").glob("*.xml"):
        tree = ElementTree.parse(scene)
        defaults = {node.get("name"): node.get("value") for node in tree.iter("default")}
        names = [node.get("filename") for node in tree.iter("include")]
        names += [n.get("value") for n in tree.iter("string") if n.get("name") in ("filename", "file")]
        for name in names:
            name = re.sub(r"\$(\w+)", lambda match, known=defaults: known[match[1]], name)
            assert (scene.parent / name).is_file(), f"{scene.name} reads {name}"
            checked += 1
    assert checked > 30


def test_examples_again(tmp_path, capsys):
    folder = tmp_path / "scenes"
    mi_diffind.examples(folder)
    before = below(folder)
    (folder / "mine.txt").write_text("mine")
    (folder / "tiles.xml").unlink()
    mi_diffind.examples(folder)
    assert below(folder) == {**before, "mine.txt": b"mine"}
    (folder / "tiles.xml").write_text("<scene/>")
    (folder / "field.xml").unlink()
    message = refused(capsys, "examples", str(folder))
    assert "tiles.xml: differs from the example scene of that name; choose another folder" in message
    assert not (folder / "field.xml").exists() and (folder / "tiles.xml").read_text() == "<scene/>"
    assert "does not exist" in refused(capsys, "examples", str(tmp_path / "a" / "b"))


# -- Data of the pages -------------------------------------------------------------------------------------------------


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves a folder; counts requests, redirects ``/moved``, and breaks off what lies in ``/broken``."""

    asked: list = []  # noqa: RUF012

    def do_GET(self):
        self.asked.append(self.path)
        if self.path.startswith("/moved"):
            self.send_response(302)
            self.send_header("Location", "file:///etc/passwd")
            self.end_headers()
        elif self.path.startswith("/broken"):
            self.send_response(200)
            self.send_header("Content-Length", str(len(CONTENT["one.bin"])))
            self.end_headers()
            self.wfile.write(CONTENT["one.bin"][:1000])
        else:
            super().do_GET()

    def log_message(self, *_):
        pass


@pytest.fixture
def server(tmp_path, monkeypatch):
    """The address of a server on this machine whose folder, ``tmp_path/served``, has the files of the name "thing"."""
    served = tmp_path / "served"
    (served / "thing").mkdir(parents=True)
    for name, content in CONTENT.items():
        (served / "thing" / name).write_bytes(content)
    files = {name: (len(c), hashlib.sha256(c).hexdigest()) for name, c in CONTENT.items()}
    monkeypatch.setattr(Handler, "asked", [])
    monkeypatch.setenv("no_proxy", "*")
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=served)) as found:
        threading.Thread(target=found.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{found.server_port}"
        known = {"thing": examples.Download("a thing", "CC0", f"{address}/thing", files, {"albedo": "one.bin"})}
        monkeypatch.setattr(examples, "DOWNLOADS", known)
        yield address
        found.shutdown()


def test_fetch(server, tmp_path, capsys):
    folder, report = tmp_path / "data", tmp_path / "report.json"
    assert main(["fetch", "thing", "thing", "-o", str(folder), "--json", str(report)]) == 0
    manifest = below(folder).pop("thing/thing.json")
    assert json.loads(manifest) == {"maps": {"albedo": "one.bin"}}
    assert below(folder) == {"thing/thing.json": manifest, **{f"thing/{n}": content for n, content in CONTENT.items()}}
    assert Handler.asked == ["/thing/one.bin", "/thing/two.bin"]
    assert "3 files, 2 fetched" in capsys.readouterr().out and json.loads(report.read_text())["loaded"] == 2
    (folder / "thing" / "two.bin").unlink()
    assert mi_diffind.fetch("thing", folder).figures["loaded"] == 1 and Handler.asked[2:] == ["/thing/two.bin"]
    mirror = mi_diffind.fetch(["thing"], tmp_path / "other", base=f"{server}/")
    assert mirror.figures["loaded"] == 2 and below(tmp_path / "other") == below(folder)


def test_fetch_that_fails(server, tmp_path, capsys):
    """Nothing is left of a file that is gone, differs, is moved, is broken off or is served by nobody."""
    folder, file = tmp_path / "data", tmp_path / "served" / "thing" / "one.bin"
    with http.server.HTTPServer(("127.0.0.1", 0), Handler) as closed:
        nobody = f"http://127.0.0.1:{closed.server_port}"
    for base, message in ((f"{server}/moved", "cannot be fetched: "), (f"{server}/broken", ""), (nobody, "cannot be")):
        found = refused(capsys, "fetch", "thing", "-o", str(folder), "--from", base)
        assert f"error: {base}/thing/one.bin: " in found and message in found and below(folder) == {}
    for content in (CONTENT["one.bin"][:-1], CONTENT["one.bin"][::-1], None):
        file.unlink() if content is None else file.write_bytes(content)
        found = refused(capsys, "fetch", "thing", "-o", str(folder))
        message = "cannot be fetched: 404" if content is None else "found the SHA-256"
        assert message in found and "/thing/one.bin: " in found and below(folder) == {}


def test_fetch_refuses(server, tmp_path, capsys):
    assert 'data "lego": is not known, allowed are thing' in refused(capsys, "fetch", "lego", "-o", str(tmp_path))
    assert "found no http" in refused(capsys, "fetch", "thing", "-o", str(tmp_path), "--from", "file:///etc")
    (tmp_path / "thing").mkdir()
    (tmp_path / "thing" / "one.bin").write_bytes(b"mine")
    assert "one.bin: is another file of that name" in refused(capsys, "fetch", "thing", "-o", str(tmp_path))
    assert (tmp_path / "thing" / "one.bin").read_bytes() == b"mine" and Handler.asked == []
    with pytest.raises(UsageError):
        mi_diffind.fetch("lego", tmp_path)


def test_what_can_be_fetched(capsys):
    """The list shows the licence of each; addresses name a commit or a version, so that they keep their content."""
    assert main(["fetch"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(examples.DOWNLOADS)
    for line, each in zip(lines, examples.DOWNLOADS.values(), strict=True):
        assert each.licence in line and each.base.startswith("https://")
        assert re.search(r"/[0-9a-f]{40}/|/v\d+\.\d+\.\d+/", each.base)
        for size, sha256 in each.files.values():
            assert re.fullmatch(r"[0-9a-f]{64}", sha256) and 0 < size < 2**24
        mapped = {m if isinstance(m, str) else m["file"] for m in (each.maps or {}).values()}
        assert mapped <= each.files.keys()


# -- The release -------------------------------------------------------------------------------------------------------


def test_one_version():
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.M)[1]
    changes = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.M)[1]
    assert mi_diffind.__version__ == cited == changes


@pytest.mark.long
def test_wheel(tmp_path):
    """The wheel, built from the source archive, holds all modules, tables and scenes, and works without a checkout."""

    def run(*command, cwd=tmp_path):
        done = subprocess.run([sys.executable, *map(str, command)], cwd=cwd, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    ignored = shutil.ignore_patterns(".*", "out", "build", "dist", "*.egg-info", "__pycache__")
    copy = shutil.copytree(ROOT, tmp_path / "copy", ignore=ignored)  # setuptools works beside the sources
    run("-m", "build", "--outdir", tmp_path / "dist", copy)
    (wheel,), (archive,) = (tmp_path / "dist").glob("*.whl"), (tmp_path / "dist").glob("*.tar.gz")
    assert wheel.name.startswith(f"mi_diffind-{mi_diffind.__version__}-py3-none-any")

    names = set(zipfile.ZipFile(wheel).namelist())
    modules = {f"mi_diffind/{p.relative_to(ROOT / 'mi_diffind')}" for p in (ROOT / "mi_diffind").rglob("*.py")}
    modules |= {f"mi_diffind/plugins/{p.relative_to(ROOT / 'plugins')}" for p in (ROOT / "plugins").rglob("*.py")}
    tables = {f"mi_diffind/data/{p.name}" for p in (ROOT / "mi_diffind" / "data").glob("*.npz")}
    scenes = {f"mi_diffind/example_scenes/{p.name}" for p in (ROOT / "scenes").glob("*.xml")}
    assert len(modules) > 150 and len(tables) >= 4 and len(scenes) >= 12
    assert modules | tables | scenes <= names, sorted((modules | tables | scenes) - names)
    strange = {n for n in names if not n.startswith(("mi_diffind/", f"mi_diffind-{mi_diffind.__version__}.dist-info/"))}
    assert not strange and not [n for n in names if "/references/" in n or "__pycache__" in n or n.endswith(".jpg")]
    assert wheel.stat().st_size < 2**23
    with tarfile.open(archive) as sources:
        kept = {name.partition("/")[2] for name in sources.getnames()}
    assert {"CHANGELOG.md", "LICENSE", "scenes/materials.xml", "tests/conftest.py", "docs/trust.md"} <= kept

    installed, empty = tmp_path / "installed", tmp_path / "empty"
    zipfile.ZipFile(wheel).extractall(installed)
    empty.mkdir()
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); import mi_diffind; from mi_diffind.commands import cli\n"
    code += "print(mi_diffind.__file__); sys.exit(cli.main())"
    command = ("-P" if sys.version_info >= (3, 11) else "-s", "-c", code, installed)
    assert run(*command, "examples", "scenes", cwd=empty).startswith(str(installed))
    small = ("-D", "width=48", "-D", "height=28", "--spp", "2", "--passes", "2")
    run(*command, "compare", "scenes/materials.xml", *small, cwd=empty)
    assert (empty / "out" / "comparison.png").stat().st_size > 1000
    points = (installed / f"mi_diffind-{mi_diffind.__version__}.dist-info" / "entry_points.txt").read_text()
    assert "[mitsuba]\nmi_diffind = mi_diffind.plugins.mitsuba_entry" in points
