"""Settings of the site: ``pip install -e ".[docs]"``, then ``sphinx-build -W --keep-going docs out/site``.

Warnings are errors: a link to a page, a heading or a file of the repository that does not exist ends the build.
External links are checked on request: ``sphinx-build -b linkcheck docs out/links``.
"""

import os
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "docs" / "_ext"), str(ROOT / "docs"), str(ROOT)]

import mi_diffind  # noqa: E402

project = "mi_diffind"
author = "The mi_diffind authors"
copyright = "the mi_diffind authors, BSD-3-Clause"
version = release = mi_diffind.__version__

extensions = [
    "generated_pages",
    "mitsuba_manual",
    "repository_links",
    "myst_parser",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
]
exclude_patterns = ["_ext", "measured"]

myst_enable_extensions = ["deflist", "colon_fence"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"

repository_root = str(ROOT)
#: Address of the repository; without one, the site carries copies of the files that pages link to.
declared = re.search(r'^Source = "(.+)"$', (ROOT / "pyproject.toml").read_text(encoding="utf-8"), re.MULTILINE)
repository_url = os.environ.get("MI_DIFFIND_REPOSITORY", declared[1] if declared else "").rstrip("/")

#: Options keep their two dashes.
smartquotes = False

html_theme = "furo"
html_title = f"mi_diffind {version}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
highlight_language = "none"
pygments_style = "friendly"
pygments_dark_style = "monokai"
copybutton_exclude = ".linenos, .gp, .go"
