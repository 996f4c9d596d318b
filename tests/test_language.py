"""Texts use the vocabulary of the field: private words are rejected; `docs/glossary.md` has the terms in use."""

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WORDS = ROOT / "tests" / "language" / "words.txt"
FOLDERS = ("mkc_torch", "docs", "examples", "tests")
KINDS = {".py", ".md", ".html", ".j2", ".toml", ".yml", ".cff", ".csv"}
OWN = {WORDS, Path(__file__).resolve()}
"""Files that quote the words."""


def rules():
    """The rejected patterns, each with the pattern of its exceptions."""
    found = []
    for line in WORDS.read_text(encoding="utf-8").splitlines():
        if line.startswith("  except "):
            found[-1] = (found[-1][0], re.compile(line.removeprefix("  except "), re.IGNORECASE))
        elif line and not line.startswith("#"):
            pattern, _, _ = line.partition(" -> ")
            found.append((re.compile(rf"(?<![A-Za-z])(?:{pattern})(?![A-Za-z])", re.IGNORECASE), None))
    return found


@cache
def texts():
    """The lines of every text that a reader may see, by path."""
    paths = [ROOT / "README.md", *(ROOT / ".github").rglob("*"), ROOT / "CITATION.cff"]
    paths += [path for folder in FOLDERS for path in (ROOT / folder).rglob("*")]
    kept = [path for path in paths if path.suffix in KINDS and path not in OWN and path.is_file()]
    return {path: path.read_text(encoding="utf-8", errors="replace").splitlines() for path in sorted(kept)}


@pytest.mark.parametrize(("pattern", "allowed"), rules(), ids=lambda value: getattr(value, "pattern", "")[18:40])
def test_no_rejected_word_is_used(pattern, allowed):
    found = []
    for path, lines in texts().items():
        for number, line in enumerate(lines, start=1):
            text = line if allowed is None else allowed.sub(lambda match: " " * len(match[0]), line)
            if pattern.search(text):
                found.append(f"{path.relative_to(ROOT)}:{number}: {line.strip()}")
    assert not found, f"{len(found)} lines, of which the first are\n" + "\n".join(found[:20])


def test_a_word_is_found_in_a_name_and_in_a_sentence():
    pattern = next(pattern for pattern, _ in rules() if pattern.search("told"))
    assert pattern.search("as_told_by")
    assert pattern.search("What it told.")
    assert not pattern.search("toldo")
