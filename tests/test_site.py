"""The site: manual pages in Mitsuba's form, links to files of the repository, and a whole build without a dead link."""

import os
import re
import subprocess
import sys
from html import unescape
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from PIL import Image
from plugin_examples import names

import mi_diffind
from mi_diffind import plugins
from mi_diffind.commands import cli

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"

MANUAL = r"""
.. _bsdf-example:

Example (:monosp:`example`)
---------------------------

.. pluginparameters::

 * - roughness
   - |float| or |texture|
   - Roughness :math:`\alpha^2`.
   - |exposed|, |differentiable|

A material like :monosp:`other`, not like :monosp:`unknown`.

.. tabs::
    .. code-tab:: xml
        :name: example

        <bsdf type="example"/>

    .. code-tab:: python

        'type': 'example'
"""


class Page:
    """Links, pictures, anchors and the cells of tables of a page."""

    def __init__(self, path: Path):
        self.text = path.read_text(encoding="utf-8")
        self.links, self.pictures = self.attributes("a", "href"), self.attributes("img", "src")
        self.anchors = {*self.attributes(r"\w+", "id"), *self.attributes(r"\w+", "name")}
        cells = re.findall(r"<td.*?>(.*?)</td>", self.text, re.S)
        self.cells = [" ".join(re.sub("<.+?>", "", cell).split()) for cell in cells]

    def attributes(self, tag: str, name: str) -> list[str]:
        return list(map(unescape, re.findall(rf'<{tag}\b[^>]*\s{name}="([^"]+)"', self.text)))


def build(source: Path, out: Path) -> subprocess.CompletedProcess:
    """Build a site; warnings are errors."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(source), str(out)]
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=500)


@pytest.fixture
def small(tmp_path):
    """A repository with a folder of pages and the extensions; returns the function that builds it from its pages."""
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "example.py").write_text("# a plugin\n")
    (tmp_path / "plugins" / "support.py").write_text("# no plugin\n")
    source = tmp_path / "docs"
    source.mkdir()

    def make(pages: dict[str, str], url: str = "") -> subprocess.CompletedProcess:
        lines = [
            f"import sys\nsys.path.insert(0, {str(DOCS / '_ext')!r})",
            'extensions = ["mitsuba_manual", "repository_links", "myst_parser"]',
            f"myst_heading_anchors = 3\nrepository_root = {str(tmp_path)!r}\nrepository_url = {url!r}",
            'repository_pages = {"plugins/example.py": "example"}',
            'plugin_pages = {"example": "example", "other": "index"}',
        ]
        (source / "conf.py").write_text("\n".join(lines))
        (source / "example.rst").write_text(":orphan:\n" + MANUAL)
        for name, text in pages.items():
            (source / name).write_text(text)
        return build(source, tmp_path / "site")

    make.site = tmp_path / "site"
    return make


def test_a_docstring_becomes_a_page(small):
    result = small({"index.md": "# Start\n"})
    assert result.returncode == 0, result.stderr
    page = Page(small.site / "example.html")
    text = page.text
    assert page.cells[:2] == ["roughness", "float or texture"] and page.cells[3] == "exposed, differentiable"
    assert re.findall(r'<th class="head"><p>(\w+)</p>', text) == ["Parameter", "Type", "Description", "Flags"]
    assert "<msup>" in text  # a formula without a script
    linked = re.findall(r'<a [^>]*href="index.html"[^>]*><span[^>]*><code[^>]*>(.+?)</code>', text)
    assert [re.sub("<.+?>", "", name) for name in linked] == ["other"]
    assert re.search(r"<code[^>]*>(<span[^>]*>)?unknown", text)
    assert re.findall(r"<label[^>]*sd-tab-label[^>]*>\s*(\w+)", text) == ["XML", "Python"]
    assert "bsdf-example" in page.anchors


def test_dead_links_end_the_build(small):
    links = ("missing.md", "other.md#no-such-heading", "../plugins/missing.py", "#nowhere")
    text = "# Start\n\n" + "\n".join(f"- [link]({link})" for link in links)
    result = small({"index.md": text, "other.md": "---\norphan: true\n---\n# Other\n\n## Heading\n"})
    assert result.returncode != 0
    for wanted in ("'missing'", "no-such-heading", "plugins/missing.py", "nowhere"):
        assert wanted in result.stderr, result.stderr
    assert result.stderr.count("WARNING") == len(links)


@pytest.mark.parametrize("url", ["", "https://example.org/project"])
def test_links_to_files_lead_to_pages_or_to_the_repository(small, url):
    links = ("../plugins/example.py", "../plugins/support.py", "../plugins", "other.md#heading")
    text = "# Start\n\n" + "\n".join(f"- [text]({link})" for link in links)
    result = small({"index.md": text, "other.md": "---\norphan: true\n---\n# Other\n\n## Heading\n"}, url)
    assert result.returncode == 0, result.stderr
    found = Page(small.site / "index.html").links
    assert "example.html" in found and "other.html#heading" in found
    if url:
        assert f"{url}/blob/main/plugins/support.py" in found and f"{url}/tree/main/plugins" in found
    else:
        copies = [link for link in found if link.endswith("support.py")]
        assert copies and (small.site / copies[0]).read_text() == "# no plugin\n"


def test_every_plugin_has_a_manual_page_and_a_small_picture(mi_rgb):
    import make_plugin_pictures as maker

    from mi_diffind.plugins.support.manual import manual_page

    assert sorted(maker.PICTURES) == sorted(names())
    for name in names():
        page = manual_page(sys.modules[f"{plugins.__name__}.{name}"])
        assert f":monosp:`{name}`" in page and not re.search(r"^ *\{\w+\}$", page, re.M)
        assert "``mitsuba``" in page and "mi-diffind render" in page  # which cannot load the plugin, and which can
        picture = DOCS / "pictures" / f"{name}.jpg"
        assert picture.stat().st_size <= maker.LARGEST
        assert Image.open(picture).size == (maker.WIDTH, maker.HEIGHT)


def test_the_reference_has_every_public_name():
    text = (DOCS / "reference.rst").read_text("utf-8")
    documented = set(re.findall(r"^\.\. auto\w+:: mi_diffind\.(?:images\.)?(\w+)(?:\(\))?$", text, re.M))
    assert set(mi_diffind.__all__) - {"__version__"} <= documented


def test_links_of_the_readme_exist():
    targets = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", (ROOT / "README.md").read_text("utf-8"))
    assert len(targets) > 30
    assert not [t for t in targets if not urlsplit(t).scheme and not (ROOT / t).exists()]


@pytest.mark.long
def test_the_site_builds_and_no_link_is_dead(tmp_path):
    result = build(DOCS, tmp_path)
    assert result.returncode == 0, result.stderr[-3000:]
    pages = {path.resolve(): Page(path) for path in tmp_path.rglob("*.html")}
    dead = []
    for path, page in pages.items():
        for link in [*page.links, *page.pictures]:
            parts = urlsplit(link)
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchors = pages[target].anchors | {""} if target in pages else {unquote(parts.fragment)}
            if not parts.scheme and not (target.is_file() and unquote(parts.fragment) in anchors):
                dead.append(f"{path.name}: {link}")
    assert not dead
    for name in names():
        page = pages[tmp_path.resolve() / "manual" / "plugins" / f"{name}.html"]
        assert any(picture.endswith(f"/{name}.jpg") for picture in page.pictures)
    for verb in cli.VERBS:
        assert tmp_path.resolve() / "manual" / "commands" / f"{verb}.html" in pages
    text = (tmp_path / "manual" / "commands" / "fit.html").read_text("utf-8")
    assert all(option in text for option in ("--compression", "--checkpoint", "--over", "--psnr"))
    for external in re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?:[^"]+)"', text):
        pytest.fail(f"the site needs {external}")


@pytest.mark.long
def test_the_script_of_the_start_page_finds_the_roughness(mi_rgb, capsys):
    script = re.search(r"^```python\n(.+?)^```", (DOCS / "index.md").read_text("utf-8"), re.M | re.S)[1]
    exec(compile(script, "index.md", "exec"), {"__name__": "__main__"})
    assert abs(float(capsys.readouterr().out.strip("[]\n")) - 0.6) < 0.02
