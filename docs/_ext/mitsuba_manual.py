"""Form of Mitsuba's manual pages, which the docstrings of plugins have.

- ``.. pluginparameters::``: a list table of name, type, meaning and flags of each parameter;
- ``.. tabs::`` with ``.. code-tab:: xml`` and ``.. code-tab:: python``: tabs of sphinx-design, all of a page in step;
- ``:monosp:`NAME```: a name in a fixed font, and a link where a page of the site describes a plugin of this name;
- ``|string|``, ``|float|``, …: types of parameters, ``|exposed|``, ``|differentiable|``, ``|discontinuous|``: flags;
- formulas as MathML, which browsers show without a script.
"""

from __future__ import annotations

from docutils import nodes
from docutils.parsers.rst.directives.tables import ListTable
from docutils.statemachine import StringList
from docutils.utils.math.latex2mathml import tex2mathml
from repository_links import link_to_page
from sphinx.util.docutils import SphinxRole
from sphinx_design.tabs import TabItemDirective, TabSetDirective

#: Types of parameters.
TYPES = ("string", "bool", "int", "float", "tensor", "transform", "spectrum", "texture", "bsdf", "integrator", "volume")

#: Flag of a parameter → its meaning.
FLAGS = {
    "exposed": "mi.traverse lists the parameter",
    "differentiable": "derivatives reach the parameter",
    "discontinuous": "derivatives lack the part of moving edges or of directions that are no longer sampled",
}

#: Heads and relative widths of the columns of a table of parameters.
COLUMNS = {"Parameter": 21, "Type": 13, "Description": 52, "Flags": 14}

#: Language of a tab → its title.
TITLES = {"xml": "XML", "python": "Python", "sh": "Shell"}


class PluginParameters(ListTable):
    """Table of the parameters of a plugin."""

    def run(self):
        head = [("* - " if i == 0 else "  - ") + name for i, name in enumerate(COLUMNS)]
        self.content = StringList([*head, ""], "pluginparameters") + self.content
        self.options |= {"header-rows": 1, "widths": list(COLUMNS.values()), "class": ["pluginparameters"]}
        return super().run()


class Tabs(TabSetDirective):
    """Set of tabs; the choice of a language holds for all sets of a page."""

    def run_with_defaults(self):
        self.options["sync-group"] = "language"
        return super().run_with_defaults()


class CodeTab(TabItemDirective):
    """Tab of :class:`Tabs` that shows a listing in the language that the argument names."""

    def run_with_defaults(self):
        language = self.arguments[0]
        self.arguments, self.options = [TITLES.get(language, language)], {"sync": language}
        lines = [f".. code-block:: {language}", "", *(f"   {line}" for line in self.content)]
        self.content = StringList(lines, "code-tab")
        return super().run_with_defaults()


class Monospaced(SphinxRole):
    """Name in a fixed font; a link to the manual page where the name is that of a plugin of this project."""

    def run(self):
        literal = nodes.literal(self.rawtext, self.text, classes=["monosp"])
        page = self.env.config.plugin_pages.get(self.text)
        if page is None or page == self.env.docname:
            return [literal], []
        return [link_to_page(self.env.docname, page, [nodes.inline("", "", literal)])], []


class Flag(SphinxRole):
    """Flag of a parameter, whose meaning shows under the pointer."""

    def run(self):
        return [nodes.abbreviation(self.rawtext, self.text, explanation=FLAGS[self.text], classes=["flag"])], []


def _inline(translator, node):
    translator.body.append(tex2mathml(node.astext()))
    raise nodes.SkipNode


def _displayed(translator, node):
    translator.body.append(f'<div class="math">{tex2mathml(node.astext())}</div>')
    raise nodes.SkipNode


def setup(app):
    """Register directives, roles, substitutions and the renderer of formulas."""
    app.setup_extension("sphinx_design")
    app.add_config_value("plugin_pages", {}, "env")
    for name, directive in {"pluginparameters": PluginParameters, "tabs": Tabs, "code-tab": CodeTab}.items():
        app.add_directive(name, directive)
    app.add_role("monosp", Monospaced())
    app.add_role("flag", Flag())
    app.add_html_math_renderer("mathml", (_inline, None), (_displayed, None))
    replaced = {name: name for name in TYPES} | {name: f":flag:`{name}`" for name in FLAGS}
    prolog = "".join(f".. |{name}| replace:: {text}\n" for name, text in replaced.items())
    app.config.rst_prolog = f"{app.config.rst_prolog or ''}\n{prolog}"
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
