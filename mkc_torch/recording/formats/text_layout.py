"""What each line of a text table is: a comment, text above the header, the header, its units, a row, or cut short."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mkc_torch.recording.formats.base import RecordingError, counted
from mkc_torch.recording.formats.text_cells import SEPARATORS, WHITE, cells_of, count_of, is_value, separator_of
from mkc_torch.recording.formats.text_lines import Line
from mkc_torch.recording.unit_words import is_unit

__all__ = ["Layout", "layout_of"]

_MARKS = ("#", "%", "//", ";")
_DIGITS = frozenset("0123456789+-.")
_CUT_NUMBER = re.compile(r"[+-]?(\d*[.,]?\d*([eE][+-]?)?|na?|in?)")
"""What is left of a number that ended anywhere."""

_MANY = 10
"""Lines from which it is the header that is wrong."""

_FIXED, _MOST = 20, 300
"""Rows from which as many decimals everywhere are the format's, and how many are looked at."""


class Layout(NamedTuple):
    """A text table taken apart.

    Attributes:
        separator: between cells.
        names: the header's cells.
        units: the cells of a row of units below it; empty where there is none.
        rows: its rows.
        restarts: rows, from 0, before which the header stands again.
        warnings: what was skipped.
    """

    separator: str
    names: list[str]
    units: list[str]
    rows: list[Line]
    restarts: tuple[int, ...]
    warnings: list[str]


def layout_of(path: Path, lines: list[Line]) -> Layout:
    """Take a text table apart.

    Raises:
        RecordingError: there is no header, there are no rows, or a line between rows is none of them.
    """
    comments = [line for line in lines if _is_marked(line.text)]
    separator, count = separator_of([line.text for line in lines if not _is_marked(line.text)] or [lines[0].text])
    if separator == ";":  # a row may begin with an empty cell
        comments = [
            line for line in comments if line.text.lstrip()[0] != ";" or count_of(line.text, separator) != count
        ]
    marked = {line.number for line in comments}
    plain = [line for line in lines if line.number not in marked] if marked else lines
    plain, count, warnings = _without_trailing(plain, separator, count)
    head = _head(path, plain, comments, separator, count)
    body = [line for line in plain if line.number not in head.lines]
    rows, restarts, skipped = _rows(path, head, body)
    told = [line for line in comments if line.number not in head.lines]
    if told:
        warnings.append(f"{counted(len(told), 'comment line')} skipped, the first {_shown(told[0])}.")
    if head.above:
        warnings.append(
            f"{counted(len(head.above), 'line')} above the first row skipped, the first {_shown(head.above[0])}."
        )
    if not rows:
        why = f" {' '.join(skipped)}" if skipped else ""
        raise RecordingError(
            f"{path}: the file has a header line but no rows of numbers; copy it whole, or export it anew.{why}"
        )
    return Layout(separator, head.names, head.units, rows, restarts, warnings + skipped)


class _Head(NamedTuple):
    """The header: its cells and text, units below it, the numbers of its lines, what stands above; if it is by rows."""

    separator: str
    names: list[str]
    text: str
    units: list[str]
    units_text: str
    lines: set[int]
    above: list[Line]
    has_rows: bool = True


def _is_marked(text: str) -> bool:
    return text[0] not in _DIGITS and text.lstrip().startswith(_MARKS)


def _head(path: Path, plain: list[Line], comments: list[Line], separator: str, count: int) -> _Head:
    """Find the header: the last line of names above the first row, or a comment there, or names further down."""
    if not plain:
        raise RecordingError(
            f"{path}: the file has a header line but no rows of numbers; copy it whole, or export it anew."
        )

    def split(line: Line) -> list[str]:
        return cells_of(line.text, separator)

    first = next((i for i, line in enumerate(plain) if _is_row(split(line), count)), None)
    if first is None:
        return _of_text(plain, split, separator)
    names = [line for line in plain[:first] if len(split(line)) == count]
    units = names.pop() if len(names) > 1 and _are_units(split(names[-1])) else None
    header = _last_unique(names, split)
    if header is None:
        return _unusual_head(path, plain, comments, first, separator, count)
    if units is None:
        units = next((line for line in names if line.number < header.number and _are_units(split(line))), None)
    used = {header.number} | ({units.number} if units else set())
    above = [line for line in plain[:first] if line.number not in used]
    return _Head(
        separator,
        split(header),
        header.text.strip(),
        split(units) if units else [],
        units.text.strip() if units else "",
        used | {line.number for line in above},
        above,
    )


def _of_text(plain: list[Line], split: Callable[[Line], list[str]], separator: str) -> _Head:
    """A table without a row of numbers: its first line is the header."""
    header, units = plain[0], plain[1] if len(plain) > 1 and _are_units(split(plain[1])) else None
    used = {header.number} | ({units.number} if units else set())
    return _Head(separator, split(header), header.text.strip(), [], "", used, [], has_rows=False)


def _unusual_head(path: Path, plain: list[Line], comments: list[Line], first: int, separator: str, count: int) -> _Head:
    """A header that has numbers among its names, is a comment, stands between rows, or has another number of cells."""
    row = cells_of(plain[first].text, separator)
    if _names_among_numbers(row, plain[first + 1 :], separator):
        line = plain[first]
        above = plain[:first]
        return _Head(separator, row, line.text.strip(), [], "", {one.number for one in [*above, line]}, above)
    for comment in reversed([one for one in comments if one.number < plain[first].number]):
        cells = cells_of(re.sub(r"^\s*(#|%|//|;)+\s?", "", comment.text), separator)
        if len(cells) == count and not any(map(is_value, cells)) and any(cell.strip() for cell in cells):
            above = plain[:first]
            used = {one.number for one in above} | {comment.number}
            return _Head(separator, cells, comment.text.strip(), [], "", used, above)
    for line in plain[first + 1 :]:
        cells = cells_of(line.text, separator)
        if len(cells) == count and all(cell.strip() and not is_value(cell) for cell in cells):
            above = plain[:first]
            return _Head(separator, cells, line.text.strip(), [], "", {one.number for one in above}, above)
    if first == 0:
        raise RecordingError(
            f"{path}: the first line holds numbers; it must hold the column names: add a first line such as "
            "time,mag_x,mag_y,mag_z."
        )
    line = plain[first - 1]
    used = {one.number for one in plain[:first]}
    return _Head(separator, cells_of(line.text, separator), line.text.strip(), [], "", used, plain[: first - 1])


def _is_row(cells: Sequence[str], count: int) -> bool:
    return len(cells) == count and any(map(is_value, cells))


def _are_units(cells: Sequence[str]) -> bool:
    told = [cell.strip() for cell in cells if cell.strip(" -")]
    return bool(told) and all(is_unit(cell) for cell in told)


def _last_unique(lines: list[Line], split: Callable[[Line], list[str]]) -> Line | None:
    """The last line whose cells differ; the last of all, where none has such."""
    for line in reversed(lines):
        names = [cell.strip() for cell in split(line) if cell.strip()]
        if len(set(names)) == len(names) and names:
            return line
    return lines[-1] if lines else None


def _names_among_numbers(cells: list[str], after: list[Line], separator: str) -> bool:
    """Whether a line is a header some of whose names are numbers: there is text where the next row has a number."""
    if all(is_value(cell) for cell in cells) or not after:
        return False
    below = cells_of(after[0].text, separator)
    pairs = list(zip(cells, below, strict=False))
    return len(below) == len(cells) and all(is_value(b) for a, b in pairs if not is_value(a))


def _without_trailing(lines: list[Line], separator: str, count: int) -> tuple[list[Line], int, list[str]]:
    """Rows that all end with a separator more than the header has lose it.

    Returns:
        The lines, how many cells a row has then, and a sentence.
    """
    if separator == WHITE or count < 2:
        return lines, count, []
    middle = lines[max(0, len(lines) // 2 - 2) : len(lines) // 2 + 3]
    if not any(line.text.rstrip(" ").endswith(separator) for line in middle):
        return lines, count, []
    ends = [line.text.rstrip(" ").endswith(separator) for line in lines]
    counts = [count_of(line.text, separator) for line in lines]
    names = {n for line, n in zip(lines, counts, strict=True) if not any(map(is_value, cells_of(line.text, separator)))}
    rows = [end for end, n in zip(ends, counts, strict=True) if n == count]
    if not all(rows) or count in names or count - 1 not in names:
        return lines, count, []
    told = [
        Line(line.number, line.text.rstrip(" ").removesuffix(separator)) if end and n == count else line
        for line, end, n in zip(lines, ends, counts, strict=True)
    ]
    return told, count - 1, [f"Every row ends with a {SEPARATORS[separator]} too many."]


def _rows(path: Path, head: _Head, body: list[Line]) -> tuple[list[Line], tuple[int, ...], list[str]]:
    """The rows of a table, where the header stands again, and what was skipped."""
    rows: list[Line] = []
    restarts: list[Line] = []
    at: list[int] = []
    pending: list[Line] = []
    cut: list[Line] = []
    between: list[Line] = []
    count = len(head.names)
    broken: list[Line] = []
    for line in body:
        text = line.text.strip()
        if line.cut and not text.endswith(head.text):
            broken.append(line)
            continue
        if text == head.text or (len(head.text) > 2 and text.endswith(head.text)):
            if text != head.text:
                pending.append(Line(line.number, text.removesuffix(head.text)))
            for one in pending:
                (cut if _is_cut(one.text, head.separator, count) else between).append(one)
            pending = []
            restarts.append(line)
            if rows:
                at.append(len(rows))
            continue
        if head.units_text and text == head.units_text:
            continue
        if line.text.count('"') % 2:
            if line is not body[-1]:
                raise RecordingError(f"{path}: line {line.number} has a quotation mark that does not end; correct it.")
            pending.append(line)
            continue
        names = head.has_rows and text[0] not in _DIGITS and _is_names(line.text, head.separator)
        if count_of(line.text, head.separator) == count and not names:
            if pending:
                raise _strange(path, head, pending[0])
            rows.append(line)
        else:
            pending.append(line)
    last = _last_cut(head, rows, pending)
    if pending and last is not pending[0]:
        raise _strange(path, head, pending[0], len(pending))
    if last is not None and last not in pending:
        rows.remove(last)
    begins = tuple(row for row in dict.fromkeys(at) if row < len(rows))
    told = _told(restarts, at, cut, between, last)
    if broken:
        told.append(f"{counted(len(broken), 'line')} cut short by zero bytes left out, the first {_shown(broken[0])}.")
    return rows, begins, told


def _told(restarts: list[Line], at: list[int], cut: list[Line], between: list[Line], last: Line | None) -> list[str]:
    told = []
    if restarts and at:
        numbers = ", ".join(str(line.number) for line in restarts[:5]) + (", …" if len(restarts) > 5 else "")
        told.append(
            f"The header stands again in line{'s' if len(restarts) > 1 else ''} {numbers}, as after a restart of the "
            "logger."
        )
    if cut:
        told.append(f"{counted(len(cut), 'line')} cut short before it left out, the first {_shown(cut[0])}.")
    if between:
        told.append(f"{counted(len(between), 'line')} of text before it skipped, the first {_shown(between[0])}.")
    if last is not None:
        told.append(f"The last line is cut short and left out, {_shown(last)}.")
    return told


def _is_names(text: str, separator: str) -> bool:
    """Whether a line holds words alone, as another header would."""
    cells = [cell for cell in cells_of(text, separator) if cell.strip()]
    return len(cells) > 1 and not any(is_value(cell) or _CUT_NUMBER.fullmatch(cell.strip()) for cell in cells)


def _is_cut(text: str, separator: str, count: int) -> bool:
    """Whether a line is the beginning of a row."""
    cells = cells_of(text, separator)
    return len(cells) <= count and all(is_value(cell) for cell in cells[:-1]) and any(map(is_value, cells))


def _last_cut(head: _Head, rows: list[Line], pending: list[Line]) -> Line | None:
    """The last line, where it ends before its row does."""
    if len(pending) == 1:
        text = pending[0].text
        short = count_of(text, head.separator) < len(head.names) or bool(text.count('"') % 2)
        return pending[0] if short and (not rows or pending[0].number > rows[-1].number) else None
    if pending or len(rows) < 2:
        return None
    cells, before = cells_of(rows[-1].text, head.separator), cells_of(rows[-2].text, head.separator)
    end = cells[-1].strip()
    if not is_value(before[-1]):
        return None
    if end and not is_value(end):
        return rows[-1] if _CUT_NUMBER.fullmatch(end) else None
    decimals = {_decimals(cells_of(line.text, head.separator)[-1]) for line in rows[-_MOST - 1 : -1]}
    shorter = len(decimals) == 1 and len(rows) > _FIXED and _decimals(end) < next(iter(decimals))
    return rows[-1] if end and shorter else None


def _decimals(cell: str) -> int:
    """Digits after the point of a plain number; many where it is none, so that it never counts as shorter."""
    found = re.fullmatch(r"[+-]?\d+(?:[.,](\d*))?", cell.strip())
    return 99 if found is None else len(found[1] or "")


def _strange(path: Path, head: _Head, line: Line, alike: int = 1) -> RecordingError:
    if count_of(line.text, head.separator) == len(head.names):
        return RecordingError(
            f"{path}: line {line.number} holds words and no numbers, {_quoted(line)}: another header, or text; split "
            "the file there, or remove the line."
        )
    count = count_of(line.text, head.separator)
    mend = "correct or remove that line" if alike < _MANY else "other lines are like it, so correct the header"
    return RecordingError(
        f"{path}: line {line.number} has {counted(count, 'value')} but the header names "
        f"{counted(len(head.names), 'column')} (the separator is the {SEPARATORS[head.separator]}); {mend}."
        f"{_comma_advice(head, line)}"
    )


def _comma_advice(head: _Head, line: Line) -> str:
    """Where decimals and cells are separated by one sign, nobody can tell them apart."""
    count = count_of(line.text, head.separator)
    if head.separator == "," and count > len(head.names) and "." not in line.text:
        return " If the decimals are written with a comma, export the table with semicolons."
    return ""


def _quoted(line: Line) -> str:
    text = line.text.strip()
    return f'"{text if len(text) <= 40 else text[:39] + "…"}"'


def _shown(line: Line) -> str:
    return f"line {line.number}, {_quoted(line)}"
