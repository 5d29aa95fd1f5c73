"""Metadata hook: the README as the description, with absolute links, and the addresses of the project."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

PICTURES = {".gif", ".jpg", ".png", ".svg", ".webp"}
"""Endings of files that a page shows, not links to."""

_FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)
_RELATIVE = re.compile(r'(\]\(|\b(?:src|href)=")(?!\w+:|[#/])([^)"\s]+)')


def with_absolute_links(text: str, repository: str, version: str) -> str:
    """Return a page in Markdown whose relative links and pictures are those of a repository at a version's tag."""

    def absolute(link: re.Match[str]) -> str:
        kind = "raw" if Path(link[2].partition("#")[0]).suffix in PICTURES else "blob"
        return f"{link[1]}{repository}/{kind}/v{version}/{link[2]}"

    parts = _FENCED.split(text)
    parts[::2] = (_RELATIVE.sub(absolute, part) for part in parts[::2])  # not in code
    return "".join(parts)


class CustomMetadataHook(MetadataHookInterface):  # type: ignore[misc]
    """Gives the package its description and addresses, both from the setting `repository`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Add the README, and the addresses if there is a public repository. Then the README's links are absolute."""
        text, repository = (Path(self.root) / "README.md").read_text("utf-8"), self.config["repository"].rstrip("/")
        metadata["urls"] = {}
        if repository:
            text = with_absolute_links(text, repository, metadata["version"])
            metadata["urls"] = {
                "Repository": repository,
                "Issues": f"{repository}/issues",
                "Changelog": f"{repository}/blob/v{metadata['version']}/CHANGELOG.md",
            }
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
