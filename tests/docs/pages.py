"""Split the README and the manual into fenced blocks, inline code, links and headings."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = (README, *sorted((ROOT / "docs").glob("*.md")))

RUN, SHOWN = frozenset({"python", "sh"}), frozenset({"text", "json", "xml"})
"""Languages of blocks that the tests run, and of blocks that show an output."""


@dataclass(frozen=True)
class Block:
    """A fenced block; ``line`` is the number of its first line in the page, from 1."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def needs(self) -> str | None:
        """The optional package of the block, from its first line ``# needs NAME``, or None."""
        found = re.match(r"# needs (\w+)\n", self.text)
        return None if found is None else found[1]

    def __str__(self) -> str:
        return f"{self.page.name}, line {self.line}"


def blocks(page: Path) -> Iterator[Block]:
    """The fenced blocks of a page, in order."""
    language, lines, start = None, [], 0
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        if not line.startswith("```"):
            lines.append(line)
        elif language is None:
            language, lines, start = line.removeprefix("```"), [], number + 1
        else:
            yield Block(page, start, language, "\n".join(lines))
            language = None
    assert language is None, f"{page.name}: the block at line {start} is never closed"


def prose(page: Path) -> str:
    """Return the page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def inline(page: Path) -> list[str]:
    """Return the inline code of the prose, each piece on a single line."""
    return [" ".join(found.replace(r"\|", "|").split()) for found in re.findall(r"`([^`]+)`", prose(page))]


def links(page: Path) -> list[str]:
    """Targets of links and pictures within the repository."""
    found = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    return [target for target in found if "://" not in target]


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of the page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
