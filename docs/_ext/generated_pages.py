"""Pages that are made from the code when the site is built: plugins, commands, notebooks.

The pages lie in ``docs/manual``, which git ignores. Nothing is listed here: plugins are those of the registry, commands
those of the command line, notebooks the files of the folder. A page whose content did not change keeps its file, so
that a second build is quick; a page whose origin is gone is removed.
"""

from __future__ import annotations

import argparse
import base64
import importlib
import json
import os
import re
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
MANUAL = DOCS / "manual"

#: Heading of a manual page: its title, and the plugin's name.
HEADING = r"^(.+) \(:monosp:`\w+`\)$"

#: Line of a table of contents that stands for all pages that are not listed.
OTHER = "(all other pages)"

#: Type of object → the heading of its plugins.
HEADINGS = {"bsdf": "BSDFs", "texture": "Textures", "shape": "Shapes", "integrator": "Integrators"}


class Pages:
    """Generated pages: ``content`` by path, and ``origins``: path in the repository → the page that is made from it."""

    def __init__(self):
        self.content: dict[str, str | bytes] = {}
        self.origins: dict[str, str] = {}

    def add(self, path: str, content: str | bytes, origin: str = "") -> None:
        """Add a page at a path below ``docs/manual``, made from a file of the repository if ``origin`` names one."""
        self.content[path] = content
        if origin:
            self.origins[origin] = f"manual/{path.rpartition('.')[0]}"

    def write(self, folder: Path = MANUAL) -> None:
        """Write all pages into ``folder``, and remove files that are no longer among them."""
        for path in sorted(folder.rglob("*"), reverse=True):
            if path.is_file() and path.relative_to(folder).as_posix() not in self.content:
                path.unlink()
        for name, content in self.content.items():
            path, data = folder / name, content if isinstance(content, bytes) else content.encode()
            path.parent.mkdir(parents=True, exist_ok=True)
            if not path.is_file() or path.read_bytes() != data:
                path.write_bytes(data)


def titled(title: str, mark: str = "=") -> list[str]:
    """Return a heading of reStructuredText."""
    return [title, mark * len(title), ""]


def literal(text: str) -> str:
    """Return a text in which reStructuredText finds no markup."""
    return re.sub(r"([\\*`|_]|(?=://))", r"\\\1", text)


def shell(command: str) -> list[str]:
    """Return a listing of a command."""
    return [".. code-block:: sh", "", f"   {command}", ""]


def toctree(names) -> list[str]:
    """Return a table of contents that is shown at the side only."""
    return ["", ".. toctree::", "   :hidden:", "", *(f"   {name}" for name in names), ""]


def gallery(entries) -> list[str]:
    """Return a grid of cards: page, heading, text and picture of each."""
    lines = [".. grid:: 1 2 3 3", "   :gutter: 3", ""]
    for page, heading, text, picture in entries:
        lines += [f"   .. grid-item-card:: {heading}", f"      :link: {page}", "      :link-type: doc"]
        lines += [f"      :img-top: {picture}" if picture else "", "", f"      {text}", ""]
    return lines


# Plugins


def plugin_pages(pages: Pages) -> dict[str, str]:
    """Add the manual page of each plugin of this package; returns the page by the plugin's name."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    from mi_diffind import plugins
    from mi_diffind.plugins.support.manual import manual_page

    modules = {name: sys.modules.get(f"{plugins.__name__}.{name}") for name in plugins.declared()}
    declared = {name: plugin for name, plugin in plugins.declared().items() if modules[name]}
    for name, plugin in declared.items():
        page = _with_picture(manual_page(modules[name]), plugin)
        pages.add(f"plugins/{name}.rst", page, f"plugins/{name}.py")
    index = [*titled("Plugins"), "Each page is the docstring of the plugin's file. The pictures are made by", ""]
    index += shell("python docs/make_plugin_pictures.py")
    for kind, heading in HEADINGS.items():
        if named := sorted(name for name, plugin in declared.items() if plugin.object_type == kind):
            titles = [re.search(HEADING, pages.content[f"plugins/{name}.rst"], re.MULTILINE)[1] for name in named]
            cards = [(name, name, title, _picture(name)) for name, title in zip(named, titles, strict=True)]
            index += [*titled(heading, "-"), *gallery(cards), *toctree(named)]
    pages.add("plugins/index.rst", "\n".join(index), "plugins")
    return {name: f"manual/plugins/{name}" for name in declared}


def _picture(name: str) -> str:
    return f"/pictures/{name}.jpg" if (DOCS / "pictures" / f"{name}.jpg").is_file() else ""


def _with_picture(page: str, plugin) -> str:
    """Return a manual page with what the registry knows of the plugin, and its picture, below the heading."""
    facts = {"Type": plugin.object_type}
    if plugin.task:
        task = f":doc:`{plugin.task} </{plugin.task}>`" if (DOCS / f"{plugin.task}.md").is_file() else plugin.task
        facts["Task"] = f"{task}; files are written by ``mi-diffind fit {plugin.task}``"
    if plugin.exact:
        facts["Exact counterpart"] = f":monosp:`{plugin.exact.name}`"
    if plugin.others:
        facts["Further counterparts"] = ", ".join(f":monosp:`{c.name}`" for c in plugin.others)
    if plugin.seen_by:
        seen = ", ".join(f":monosp:`{name}`" for name in plugin.seen_by)
        facts["Seen by"] = f"{seen}; with ``{plugin.otherwise[0]}`` ``{plugin.otherwise[1]}`` by any integrator"
    lines = [f":{name}: {text}" for name, text in facts.items()]
    if _picture(plugin.name):
        from make_plugin_pictures import PICTURES

        command = f"``python docs/make_plugin_pictures.py {plugin.name}``"
        lines += ["", f".. figure:: {_picture(plugin.name)}", f"   :alt: A render of {plugin.name}"]
        lines += ["   :class: plugin-picture", "", f"   {PICTURES[plugin.name][-1]} Made by {command}."]
    end = re.search(rf"{HEADING}\n-+\n", page, re.MULTILINE).end()
    return page[:end] + "\n" + "\n".join(lines) + "\n" + page[end:]


# Commands


def command_pages(pages: Pages) -> None:
    """Add a page for each verb of the command line, from its parser."""
    from mi_diffind.commands.cli import VERBS

    index = [*titled("Command line")]
    index += ["Exit codes: 0 done, 1 a check failed, 2 bad usage or bad input, 130 interrupted.", ""]
    index += [".. list-table::", "   :header-rows: 1", "   :widths: 15 35 50", ""]
    index += ["   * - Command", "     - Purpose", "     - Example"]
    for verb in sorted(VERBS):
        module = importlib.import_module(f"mi_diffind.commands.{verb}")
        subparsers = argparse.ArgumentParser(prog="mi-diffind").add_subparsers()
        module.add(subparsers)
        parser = subparsers.choices[verb]
        pages.add(f"commands/{verb}.rst", "\n".join(_command(parser, verb)), f"mi_diffind/commands/{verb}.py")
        index += [f"   * - :doc:`{verb}`", f"     - {literal(module.HELP)}", f"     - ``{_example(parser)}``"]
    index += toctree(sorted(VERBS))
    pages.add("commands/index.rst", "\n".join(index), "mi_diffind/commands")


def _command(parser: argparse.ArgumentParser, verb: str) -> list[str]:
    lines = titled(f"mi-diffind {verb}")
    alternatives = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    lines += _parser(parser, [a for a in parser._actions if a not in alternatives])
    for action in alternatives:
        shared = _shared(action.choices.values())
        for name, sub in action.choices.items():
            lines += titled(f"{verb} {name}", "-")
            lines += _parser(sub, [a for a in sub._actions if _entry(a) not in shared])
        if shared:
            lines += [*titled(f"Options of every {action.dest}", "-"), f".. program:: mi-diffind {verb}", ""]
            lines += [line for entry in shared for line in entry]
    return lines


def _shared(parsers) -> list[tuple]:
    """Return the entries of the options that all parsers have with the same text."""
    entries = [[_entry(action) for action in parser._actions] for parser in parsers]
    return [entry for entry in entries[0] if all(entry in others for others in entries[1:])]


def _parser(parser: argparse.ArgumentParser, actions) -> list[str]:
    description = parser.description or ""
    lines = [f"{literal(description[:1].upper() + description[1:])}.", ""]
    if parser.epilog:
        lines += shell(_example(parser))
    return [*lines, f".. program:: {parser.prog}", "", *(line for action in actions for line in _entry(action))]


def _example(parser: argparse.ArgumentParser) -> str:
    return (parser.epilog or "").partition("example: ")[2]


def _entry(action: argparse.Action) -> tuple:
    """Return the entry of an option or of a positional argument."""
    if "--help" in action.option_strings or isinstance(action, argparse._SubParsersAction):
        return ()
    choices = f"{{{','.join(map(str, action.choices))}}}" if action.choices else ""
    metavar = action.metavar or choices or action.dest.upper()
    value = "" if action.nargs == 0 else " ".join(metavar) if isinstance(metavar, tuple) else metavar
    names = [f"{name} {value}".rstrip() for name in action.option_strings] or [value or action.dest]
    text = literal((action.help or "") % {"default": action.default, "prog": "mi-diffind"})
    return (f".. option:: {', '.join(names)}", "", *(f"   {line}" for line in textwrap.wrap(text, 107)), "")


# Notebooks


def notebook_pages(pages: Pages) -> None:
    """Add a page for each notebook, with the results that the file holds; nothing is executed."""
    cards = []
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, pictures = _notebook(json.loads(path.read_text(encoding="utf-8")), path.stem)
        for name, data in pictures.items():
            pages.add(f"notebooks/{name}", data)
        pages.add(f"notebooks/{path.stem}.md", text, f"notebooks/{path.name}")
        title = re.search(r"^# (.+)$", text, re.MULTILINE)[1]
        cards.append((path.stem, title, f"``{path.name}``", next(iter(pictures), "")))
    index = [*titled("Notebooks"), "The files lie in the folder ``notebooks``, with the results of their last run.", ""]
    pages.add("notebooks/index.rst", "\n".join([*index, *gallery(cards), *toctree(c[0] for c in cards)]), "notebooks")


def _notebook(content: dict, stem: str) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its pictures by file name."""
    parts, pictures = [], {}
    for cell in content["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        if source.strip():
            parts.append(f"```python\n{source}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            kind = next((kind for kind in ("image/jpeg", "image/png") if kind in data), "")
            if kind:
                name = f"{stem}_{len(pictures) + 1}.{kind.rpartition('/')[2].replace('jpeg', 'jpg')}"
                pictures[name] = base64.b64decode("".join(data[kind]))
                parts.append(f"![Result of the cell above]({name})")
                continue
            text = "".join(output.get("text", data.get("text/plain", "")))
            if text.strip():
                parts.append(f"```text\n{text.rstrip()}\n```")
    return "\n\n".join(parts) + "\n", pictures


def generate(app, config) -> None:
    """Write all generated pages and tell other extensions of them."""
    pages = Pages()
    config.plugin_pages = plugin_pages(pages)
    command_pages(pages)
    notebook_pages(pages)
    pages.write()
    config.repository_pages = pages.origins
    config.repository_sources = {page: origin for origin, page in pages.origins.items()}


def other_pages(app, docname: str, source: list[str]) -> None:
    """List, in place of :data:`OTHER`, the pages of ``docs`` that no table of contents of the start page names."""
    if docname == "index":
        named = {re.sub(r"^.*<(\w+)>$", r"\1", line.strip()) for line in source[0].splitlines()}
        others = sorted(path.stem for path in DOCS.glob("*.md") if path.stem not in named | {"index"})
        source[0] = source[0].replace(OTHER, "\n".join(others))


def setup(app):
    """Generate the pages before Sphinx looks for them."""
    os.environ.setdefault("NO_COLOR", "1")
    app.setup_extension("mitsuba_manual")
    app.setup_extension("repository_links")
    app.connect("config-inited", generate)
    app.connect("source-read", other_pages)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
