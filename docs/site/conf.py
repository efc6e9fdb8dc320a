"""Sphinx: the documents of the tree as a site, with a reference made from the docstrings. `./dev docs` builds it into
out/site.
"""

from importlib.metadata import version as version_of
from pathlib import Path

project = "SIOMS"
author = "The SIOMS authors"
copyright = author
version = release = version_of("sioms")
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinxcontrib.mermaid",
]
# The source is the tree itself: a page of a driver lies beside it.
include_patterns = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "docs/*.md",
    "docs/site/*.md",
    "docs/decisions/*.md",
    "drivers/README.md",
    "drivers/*/*.md",
]
WITHOUT_PAGES = [".*", "build", "daemon", "etc", "examples", "out", "sioms", "tests", "tools"]
"""Folders that are not walked: the environment alone has some ten thousand files."""
exclude_patterns = ["docs/site/contents.md", *WITHOUT_PAGES]
root_doc = "README"
html_theme = "furo"
html_title = f"SIOMS {release}"
html_extra_path = ["../../docs/man"]
myst_heading_anchors = 4
myst_enable_extensions = ["deflist"]
myst_fence_as_directive = ["mermaid"]
autodoc_typehints = "description"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "undoc-members": False, "show-inheritance": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
suppress_warnings = ["ref.python"]  # attributes of the same name in several classes


def setup(app):
    """Let the front page, which is the README, lead to all others."""
    contents = Path(__file__).with_name("contents.md").read_text(encoding="utf-8")

    def read(app, name, text):
        if name == root_doc:
            text[0] += "\n" + contents

    app.connect("source-read", read)
