"""Hook of the build: the description of the package is README.md with absolute links.

A package index shows the description without the files of the repository. Relative links and pictures would lead
nowhere, so they are replaced by addresses below the ``Source`` of ``[project.urls]`` in pyproject.toml, at the tag of
the version.
"""

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(?P<picture>!?)\[(?P<text>[^\]]*)\]\((?!https?://|#)(?P<target>[^)]+)\)")
"""Markdown link or picture with a relative target."""


def make_links_absolute(text: str, source: str, tag: str) -> str:
    """Replace the relative links and pictures of a Markdown text by absolute links.

    Parameters
    ----------
    text
        Markdown text in the top folder of the repository.
    source
        Address of the repository.
    tag
        Tag of the version.

    Examples
    --------
    >>> make_links_absolute("![a](docs/a.png) [b](docs/b.md#c)", "https://host.example/p", "v1.0")
    '![a](https://host.example/p/raw/v1.0/docs/a.png) [b](https://host.example/p/blob/v1.0/docs/b.md#c)'
    """

    def replace(link: re.Match[str]) -> str:
        view = "raw" if link["picture"] else "blob"
        return f"{link['picture']}[{link['text']}]({source}/{view}/{tag}/{link['target']})"

    return LINK.sub(replace, text)


class ReadmeHook(MetadataHookInterface):
    """Sets the description of the package."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the key ``readme`` of the metadata."""
        text = (Path(self.root) / "README.md").read_text("utf-8")
        text = make_links_absolute(text, metadata["urls"]["Source"], f"v{metadata['version']}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
