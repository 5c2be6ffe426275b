"""The relative links of a Markdown page, and where in the repository they lead."""

from __future__ import annotations

import re
from pathlib import Path

LINK = re.compile(r"\]\((?!\w+:)(?P<path>[^()\s#]*)#?(?P<anchor>[^()\s]*)\)")
BLOCK = re.compile(r"^(`{3,}).*?^\1$", re.MULTILINE | re.DOTALL)
INLINE_CODE = re.compile(r"`[^`\n]+`")
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


def anchor_of(heading: str) -> str:
    """What a heading is reached by, on the repository's pages and on the site."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def links_of(page: Path) -> list[tuple[str, str]]:
    """(path, anchor) of every relative link; either may be empty."""
    return LINK.findall(INLINE_CODE.sub("", _without_blocks(page)))


def dead_links(page: Path) -> list[str]:
    """What is linked and not there."""
    dead = []
    for path, anchor in links_of(page):
        target = page.parent / path if path else page
        if not target.exists():
            dead.append(path)
        elif anchor and anchor not in map(anchor_of, HEADING.findall(_without_blocks(target))):
            dead.append(f"{path}#{anchor}")
    return dead


def _without_blocks(page: Path) -> str:
    return BLOCK.sub("", page.read_text(encoding="utf-8"))
