"""Read the messages of an ArduPilot DataFlash log in text form (``.log``): a message per line, ``MAG, 1000, 12, …``."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np

from mkc_torch.recording.formats.base import Topic, counted, polars
from mkc_torch.recording.formats.damage import with_warnings
from mkc_torch.recording.formats.dataflash_messages import MESSAGE_FORMAT, TEXT, WHOLE, MessageFormat, message_format
from mkc_torch.recording.formats.dataflash_topics import DEFINITIONS, statements, topics_of_message


def read_text(path: Path) -> tuple[list[Topic], list[str]]:
    """Read the topics of a log, and warnings about its lost parts; memory is about ten times the file's size.

    Numbers are used as written: the text holds fractions, so format letters do not divide them.
    """
    formats: dict[str, tuple[int, MessageFormat]] = {"FMT": (0x80, MESSAGE_FORMAT)}
    rows: dict[str, list[list[str]]] = defaultdict(list)
    damaged, line = 0, ""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.strip():
                continue
            name, _, rest = line.partition(",")
            known = formats.get(name.strip())
            if known is None:
                damaged += 1
                continue
            count = len(known[1].columns)
            cells = [cell.strip() for cell in rest.split(",", max(count - 1, 0))]
            if len(cells) < count:
                damaged += 1
                continue
            if known[1] is MESSAGE_FORMAT:
                new = _definition(cells)
                if new is None:
                    damaged += 1
                elif formats.get(new[1].name) != new and new[1].name != "FMT":
                    formats[new[1].name] = new
                    rows.pop(new[1].name, None)
            else:
                rows[name.strip()].append(cells)
    cut = bool(line.strip()) and not line.endswith("\n")
    columns = {name: _columns(formats[name][1], cells) for name, cells in rows.items()}
    stated = statements({name: columns[name][1] for name in columns if name in DEFINITIONS})
    topics = []
    for name, (numbers, _, bad) in columns.items():
        if name in DEFINITIONS or not numbers:
            continue
        kind, message = formats[name]
        unreadable = (
            [
                f"{counted(bad, 'value')} of `{name}` cannot be read and is left empty."
                if bad == 1
                else f"{counted(bad, 'value')} of `{name}` cannot be read and are left empty."
            ]
            if bad
            else []
        )
        topics += with_warnings(topics_of_message(kind, message, numbers, stated), unreadable)
    warnings = []
    if damaged:
        what = "is" if damaged == 1 else "are"
        warnings.append(f"{counted(damaged, 'line')} of the log {what} damaged or of an unknown message, and left out.")
    if cut:
        warnings.append("The last line of the log has no end: it may be cut off within a number.")
    return topics, warnings


def _definition(cells: list[str]) -> tuple[int, MessageFormat] | None:
    kind, length, name, letters, columns = cells
    if not (kind.isascii() and kind.isdigit() and length.isascii() and length.isdigit()):
        return None
    found = message_format(int(kind), int(length), name, letters, columns)
    return None if found is None else (int(kind), found)


def _columns(
    message: MessageFormat, rows: list[list[str]]
) -> tuple[dict[str, np.ndarray], dict[str, list[object]], int]:
    """The columns of a message's lines as numbers and as text, and the number of cells that are not numbers."""
    package = polars()
    numbers: dict[str, np.ndarray] = {}
    texts: dict[str, list[object]] = {}
    bad = 0
    for place, (letter, name) in enumerate(zip(message.letters, message.columns, strict=True)):
        cells = [row[place] for row in rows]
        texts[name] = list(cells)
        if letter in TEXT or letter == "a":
            numbers[name] = np.array(cells, dtype=object)
            continue
        series = package.Series(cells, dtype=package.String)
        whole = series.cast(package.Int64, strict=False) if letter in WHOLE else None
        if whole is not None and not whole.null_count():
            numbers[name] = whole.to_numpy()
            continue
        found = series.cast(package.Float64, strict=False)
        # a mode is written by its name
        if letter == "M" and found.null_count() == len(found):
            numbers[name] = np.array(cells, dtype=object)
            continue
        bad += found.null_count()
        numbers[name] = found.fill_null(float("nan")).to_numpy()
    return numbers, texts, bad
