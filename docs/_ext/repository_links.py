"""Links of pages to files of the repository, which work on GitHub and in the site.

A page links to a file as GitHub needs it, ``../plugins/disney.py``. In the site, the link leads to the page that is
made from the file (``repository_pages``: path in the repository → name of the page), if there is one. Otherwise it
leads to the file in the repository (``repository_url``) or, as long as the project has no public address, to a copy of
the file in the site; a link to a folder is then plain text. A file that does not exist is a warning.
"""

from __future__ import annotations

import os
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms import SphinxTransform
from sphinx.util import logging

logger = logging.getLogger(__name__)


def link_to_page(docname: str, page: str, children: list, anchor: str | None = None) -> addnodes.pending_xref:
    """Return a link of a page to another one; MyST's link keeps the nodes inside, Sphinx's their text only."""
    options = {"refdomain": "doc", "reftype": "myst", "refdoc": docname, "refexplicit": True}
    return addnodes.pending_xref("", *children, reftarget=page, reftargetid=anchor, **options)


class RepositoryLinks(SphinxTransform):
    """Replaces the targets of links that leave the folder of the pages."""

    default_priority = 4  # before files to be copied are collected

    def apply(self, **kwargs):
        for kind in (addnodes.download_reference, addnodes.pending_xref):
            for node in [*self.document.findall(kind)]:
                path, anchor = self._path(node)
                if path:
                    node.replace_self(self._link(node, path, anchor) or node)

    def _path(self, node) -> tuple[str, str | None]:
        """Return the path in the repository that a link of Markdown names, and its anchor; "" for any other link."""
        target, docname = node["reftarget"], self.env.docname
        if node.get("reftype") != "myst" or target.startswith("#"):
            return "", None
        if node.get("refdomain") == "doc":  # a page of the site, unless it lies in another folder
            outside = os.path.isabs(target)
            return f"{os.path.relpath(target, self.config.repository_root)}.md" if outside else "", None
        folder = Path(self.env.srcdir).name
        page = self.config.repository_sources.get(docname, f"{folder}/{docname}")
        target, _, anchor = target.partition("#")
        return os.path.normpath(Path(page).parent / target), anchor or None

    def _link(self, node, path: str, anchor: str | None):
        """Return the node that takes the place of a link to a path; ``None`` if there is no such file."""
        config, docname, source = self.config, self.env.docname, Path(self.env.srcdir)
        found, page = Path(config.repository_root, path), config.repository_pages.get(path)
        if page is None and path.startswith(f"{source.name}/") and path.endswith(".md"):
            page = path.removeprefix(f"{source.name}/").removesuffix(".md")
        if page is not None:
            return link_to_page(docname, page, node.children, anchor)
        if not found.exists():
            logger.warning("the repository has no file %r", path, location=node, type="repository", subtype="missing")
            return nodes.inline("", "", *node.children)
        if config.repository_url:
            form = "tree" if found.is_dir() else "blob"
            uri = f"{config.repository_url}/{form}/{config.repository_branch}/{path}"
            return nodes.reference("", "", *node.children, refuri=uri)
        if found.is_dir():
            return nodes.inline("", "", *node.children)
        copy = os.path.relpath(found, (source / docname).parent)
        return addnodes.download_reference("", "", *node.children, reftarget=copy, refdoc=docname)


def setup(app):
    """Register the transform and its settings."""
    defaults = {"root": "..", "url": "", "branch": "main", "pages": {}, "sources": {}}
    for name, default in defaults.items():
        app.add_config_value(f"repository_{name}", default, "env")
    app.add_transform(RepositoryLinks)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
