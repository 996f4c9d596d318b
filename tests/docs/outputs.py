"""Outputs that the pages show: compared with what the blocks print, and filled in by `python -m tests.docs.outputs`.

A text block after the line `<!-- output -->` shows what the last block before it prints; after
`<!-- output of mkc inspect -->`, what the last command with this beginning prints. A line `…` stands for any lines.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from importlib.util import find_spec
from io import StringIO
from pathlib import Path

from tests.docs.commands import commands, run
from tests.docs.files import write_examples
from tests.docs.pages import PAGES, RUN, Block, blocks

REST = "…"
"""A line, or the end of a line, that stands for any text."""

MARK = re.compile(r"^<!-- output(?: of (?P<command>.+?))? -->$")
NUMBER = re.compile(r"\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")
TOLERANCE = 0.03
"""Relative difference of numbers, which rounding on another processor causes."""


class Printed:
    """What the blocks of a page have printed so far."""

    def __init__(self) -> None:
        self._of_block = ""
        self._of_commands: list[tuple[str, str]] = []

    def python(self, text: str) -> None:
        """Keep the output of a Python block."""
        self._of_block = text

    def shell(self, outputs: Sequence[tuple[str, str]]) -> None:
        """Keep the outputs of a shell block, by command."""
        self._of_commands += outputs
        self._of_block = "".join(text for _, text in outputs)

    def of(self, mark: re.Match[str]) -> list[str]:
        """Return the lines that a block with this mark shows.

        Raises:
            AssertionError: no command begins so.
        """
        text = self._of_block
        if mark["command"] is not None:
            found = [text for command, text in self._of_commands if command.startswith(mark["command"])]
            assert found, f"no block runs a command that begins with `{mark['command']}`"
            text = found[-1]
        lines = [line.rstrip() for line in text.splitlines()]
        return lines[next((i for i, line in enumerate(lines) if line), 0) :]


def run_python(block: Block, names: dict[str, object], folder: Path) -> str:
    """Execute a Python block, and return what it prints; a block that begins with a file's name is saved too."""
    first, _, _ = block.text.partition("\n")
    if first.startswith("# ") and first.endswith(".py"):  # "save this as"
        (folder / first.removeprefix("# ")).write_text(block.text, encoding="utf-8")
    # the line numbers of a traceback are those of the page
    code = compile("\n" * (block.line - 1) + block.text, str(block.page), "exec")
    with redirect_stdout(StringIO()) as printed:
        exec(code, names)
    return printed.getvalue()


def run_shell(block: Block, folder: Path) -> list[tuple[str, str]]:
    """Run the commands of a shell block, and return each with what it prints."""
    outputs = []
    for line in block.text.splitlines():
        assert not line.endswith("\\"), f"{block}: write a command on one line"
        outputs += [(" ".join(words), run(words, folder)) for words in commands(line)]
    return outputs


def run_page(page: Path, folder: Path) -> tuple[dict[str, object], list[tuple[Block, list[str]]]]:
    """Run all blocks of a page in order; returns its names, and each block of output with what was printed."""
    names: dict[str, object] = {"__name__": page.stem}
    lines, printed = page.read_text(encoding="utf-8").splitlines(), Printed()
    shown = []
    for block in blocks(page):
        print(f"{block}:")  # shown if the block fails
        mark = mark_of(lines, block)
        if mark is not None:
            shown.append((block, printed.of(mark)))
        elif block.language not in RUN or (block.needs is not None and find_spec(block.needs) is None):
            continue
        elif block.language == "python":
            printed.python(run_python(block, names, folder))
        else:
            printed.shell(run_shell(block, folder))
    return names, shown


def mark_of(lines: Sequence[str], block: Block) -> re.Match[str] | None:
    """Return the mark above a block of output, with an empty line between; None for other blocks."""
    above = [line for line in lines[max(block.line - 4, 0) : block.line - 2] if line]
    return MARK.match(above[-1]) if above and block.language == "text" else None


def agree(shown: str, printed: str) -> bool:
    """Whether two lines are equal, numbers within the tolerance; a shown line may end with `…`.

    Example:
        >>> agree("offset 11.969 µT", "offset 11.968 µT"), agree("offset 11.969 µT", "offset 12.968 µT")
        (True, False)
        >>> agree("p = 0.01 (the…", "p = 0.01 (the minimum with 99 surrogates)")
        True
    """
    if shown.endswith(REST):
        shown = shown[: -len(REST)]
        words = NUMBER.split(shown)
        printed = printed[: len(shown)] if len(words) == 1 else printed
        if len(printed) < len(shown) or not printed.startswith(words[0]):
            return False
        printed = printed[: len(shown)]
    if NUMBER.sub("#", shown).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    values = [(float(a.replace(",", "")), float(b.replace(",", ""))) for a, b in pairs]
    return all(abs(a - b) <= max(TOLERANCE * max(abs(a), abs(b)), 0.0011) for a, b in values)


def differences(shown: Sequence[str], printed: Sequence[str]) -> Iterator[str]:
    """Lines that are shown but not printed in this order; and printed lines that are not shown, without a `…`."""
    at, skipping = 0, False
    for line in shown:
        if line == REST:
            skipping = True
            continue
        place = next((i for i in range(at, len(printed)) if agree(line, printed[i])), None)
        if place is None or (place > at and not skipping):
            yield f"shown: {line}\nprinted: {printed[at] if at < len(printed) else 'nothing more'}"
        at, skipping = (at if place is None else place) + 1, False
    if not skipping and any(printed[at:]):
        yield f"not shown: {printed[at]}"


def filled(shown: Sequence[str], printed: Sequence[str]) -> list[str]:
    """Return the printed lines; of a block with `…`, those that start with the first word of each shown line.

    Indented lines belong to the line before them.

    Raises:
        ValueError: no printed line begins like a shown line.
    """
    if REST not in shown:
        return list(printed)
    lines, at = [], 0
    for line in shown:
        if line == REST:
            lines.append(line)
        elif line and not line.startswith(" "):
            found = (i for i in range(at, len(printed)) if _first_word(printed[i]) == _first_word(line))
            if (place := next(found, -1)) < 0:
                raise ValueError(f"No printed line begins like {line!r}; edit the block by hand.")
            if place > at and lines[-1:] != [REST]:
                lines.append(REST)
            lines.append(printed[place])
            at = place
            at += 1
            while at < len(printed) and printed[at].startswith(" "):
                lines.append(printed[at])
                at += 1
    return lines


def _first_word(line: str) -> str:
    return "" if line.startswith(" ") else line.partition(" ")[0]


def fill(page: Path, folder: Path) -> int:
    """Write what the blocks print into the page; returns how many blocks of output it has."""
    _, shown = run_page(page, folder)
    lines = page.read_text(encoding="utf-8").splitlines()
    for block, printed in reversed(shown):
        old = block.text.splitlines()
        lines[block.line - 1 : block.line - 1 + len(old)] = filled(old, printed)
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return len(shown)


def main() -> None:
    parser = argparse.ArgumentParser(description="Fill in the outputs that pages show.")
    parser.add_argument("pages", nargs="*", type=Path, help="all pages with outputs unless given")
    with_outputs = [page for page in PAGES if re.search(r"^<!-- output", page.read_text(encoding="utf-8"), re.M)]
    for page in parser.parse_args().pages or with_outputs:
        page = page.resolve()
        folder = Path(tempfile.mkdtemp())
        write_examples(folder)
        before = Path.cwd()
        os.chdir(folder)
        try:
            print(f"{page.name}: {fill(page, folder)} outputs")
        finally:
            os.chdir(before)
            shutil.rmtree(folder)


if __name__ == "__main__":
    main()
