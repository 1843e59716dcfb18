"""Settings of Sphinx, which builds the documentation site: ``sphinx-build -W -b html docs FOLDER``.

The pages are Markdown and can also be read in the repository. No page is fetched from the network during the build.
"""

import re
import tomllib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCE = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["urls"]["Source"]
LINK = re.compile(r"(\[[^\]]*\]\()((?:\.\./)+[^)#\s]+)((?:#[^)]*)?\))")
"""Markdown link with a relative target in a parent folder."""

project = "imu-monitor"
author = "The imu-monitor authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinxcontrib.mermaid", "sphinx_copybutton"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
myst_fence_as_directive = ["mermaid"]
nb_execution_mode = "off"  # the tests run the notebooks
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the signature shows the types
napoleon_numpy_docstring = True
smartquotes = False  # the pages quote values of keys
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "imu-monitor"
html_show_copyright = False
html_show_sphinx = False


def link_to_repository(page: Path, text: str) -> str:
    """Replace the links to files outside the folder docs by links to the repository.

    Parameters
    ----------
    page
        File of the page.
    text
        Markdown text of the page.
    """

    def replace(link: re.Match[str]) -> str:
        target = (page.parent / link[2]).resolve()
        if target.is_relative_to(ROOT / "docs") and target.is_file():
            return link[0]
        return f"{link[1]}{SOURCE}/blob/main/{target.relative_to(ROOT)}{link[3]}"

    return LINK.sub(replace, text)


def setup(app: Any) -> None:
    """Register the replacement of links."""

    def read_source(_app: Any, name: str, content: list[str]) -> None:
        content[0] = link_to_repository(ROOT / "docs" / f"{name}.md", content[0])

    app.connect("source-read", read_source)
