"""Classify the lines of a text table: comments, text above the header, header, units, rows, and truncated lines."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from mkc_torch._support.note import Note
from mkc_torch.recording.formats.base import RecordingError, counted
from mkc_torch.recording.formats.text_cells import SEPARATORS, WHITE, cells_of, count_of, is_value, separator_of
from mkc_torch.recording.formats.text_lines import Line
from mkc_torch.recording.unit_words import is_unit

_MARKS = ("#", "%", "//", ";")
_DIGITS = frozenset("0123456789+-.")
_CUT_NUMBER = re.compile(r"[+-]?(\d*[.,]?\d*([eE][+-]?)?|na?|in?)")
"""Pattern of a truncated number."""

_AXES = ("x", "y", "z")
"""Names of the columns of a table of three columns without a header."""

_MOST_TORN = 3
"""Most truncated lines at the end that are left out."""

_MANY = 10
"""Fewest lines with another number of cells than the header if the header is wrong."""

_FIXED = 20
"""Fewest rows with equally many decimals if the number of decimals is fixed."""

_MOST = 300
"""Most rows whose decimals are counted."""


class Layout(NamedTuple):
    """The parts of a text table.

    Attributes:
        separator: the sign between cells.
        names: the cells of the header.
        units: the cells of the row of units; empty without such a row.
        rows: the rows of values.
        restarts: row indices at which the header is repeated.
        warnings: what was skipped.
    """

    separator: str
    names: list[str]
    units: list[str]
    rows: list[Line]
    restarts: tuple[int, ...]
    warnings: list[str]


def layout_of(path: Path, lines: list[Line]) -> Layout:
    """Find the parts of a text table.

    Raises:
        RecordingError: no header, no rows, or a line between rows that is not a row.
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
    skipped_comments = [line for line in comments if line.number not in head.lines]
    if skipped_comments:
        number = counted(len(skipped_comments), "comment line")
        warnings.append(Note(f"{number} skipped, the first {_shown(skipped_comments[0])}."))
    if not head.has_header:
        warnings.append(Note(f"The file has no header; its columns are taken as {', '.join(head.names)}."))
    if head.above:
        above = f"{counted(len(head.above), 'line')} above the first row skipped, the first {_shown(head.above[0])}."
        warnings.append(Note(above))
    if not rows:
        why = f" {' '.join(skipped)}" if skipped else ""
        raise RecordingError(
            f"{path}: the file has a header line but no rows of numbers; copy the whole file, or export it again.{why}"
        )
    return Layout(separator, head.names, head.units, rows, restarts, warnings + skipped)


class _Head(NamedTuple):
    """The header of a text table.

    Attributes:
        separator: the sign between cells.
        names: its cells.
        text: its line, stripped.
        units: the cells of the row of units; empty without such a row.
        units_text: the line of units, stripped; empty without such a row.
        lines: line numbers of the header, the units and the lines above.
        above: the lines above the first row that are neither header nor units.
        has_rows: False if the table has no row of numbers.
        has_header: False if the names are not in the file.
    """

    separator: str
    names: list[str]
    text: str
    units: list[str]
    units_text: str
    lines: set[int]
    above: list[Line]
    has_rows: bool = True
    has_header: bool = True


def _is_marked(text: str) -> bool:
    return text[0] not in _DIGITS and text.lstrip().startswith(_MARKS)


def _head(path: Path, plain: list[Line], comments: list[Line], separator: str, count: int) -> _Head:
    """Find the header: the last line of names above the first row, a comment above it, or names further down."""
    if not plain:
        raise RecordingError(
            f"{path}: the file has a header line but no rows of numbers; copy the whole file, or export it again."
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
    """The header of a table without a row of numbers: its first line."""
    header, units = plain[0], plain[1] if len(plain) > 1 and _are_units(split(plain[1])) else None
    used = {header.number} | ({units.number} if units else set())
    return _Head(separator, split(header), header.text.strip(), [], "", used, [], has_rows=False)


def _unusual_head(path: Path, plain: list[Line], comments: list[Line], first: int, separator: str, count: int) -> _Head:
    """A header with numbers as names, in a comment, between rows, or with another number of cells than the rows."""
    row = cells_of(plain[first].text, separator)
    if _names_among_numbers(row, plain[first + 1 :], separator):
        line = plain[first]
        above = plain[:first]
        return _Head(separator, row, line.text.strip(), [], "", {other.number for other in [*above, line]}, above)
    for comment in reversed([other for other in comments if other.number < plain[first].number]):
        cells = cells_of(re.sub(r"^\s*(#|%|//|;)+\s?", "", comment.text), separator)
        if len(cells) == count and not any(map(is_value, cells)) and any(cell.strip() for cell in cells):
            above = plain[:first]
            used = {other.number for other in above} | {comment.number}
            return _Head(separator, cells, comment.text.strip(), [], "", used, above)
    for line in plain[first + 1 :]:
        cells = cells_of(line.text, separator)
        if len(cells) == count and all(cell.strip() and not is_value(cell) for cell in cells):
            above = plain[:first]
            return _Head(separator, cells, line.text.strip(), [], "", {other.number for other in above}, above)
    if first == 0 and count == len(_AXES) and _all_numbers(plain, separator):
        return _Head(separator, list(_AXES), ",".join(_AXES), [], "", set(), [], has_header=False)
    if first == 0:
        raise RecordingError(
            f"{path}: the first line holds numbers; it must hold the column names: add a first line such as "
            "time,mag_x,mag_y,mag_z."
        )
    line = plain[first - 1]
    used = {other.number for other in plain[:first]}
    return _Head(separator, cells_of(line.text, separator), line.text.strip(), [], "", used, plain[: first - 1])


def _all_numbers(lines: list[Line], separator: str) -> bool:
    """Whether the first lines hold numbers in all of their three cells."""
    cells = [cells_of(line.text, separator) for line in lines[:_FIXED]]
    return all(len(row) == len(_AXES) and all(map(is_value, row)) for row in cells)


def _is_row(cells: Sequence[str], count: int) -> bool:
    return len(cells) == count and any(map(is_value, cells))


def _are_units(cells: Sequence[str]) -> bool:
    units = [cell.strip() for cell in cells if cell.strip(" -")]
    return bool(units) and all(is_unit(cell) for cell in units)


def _last_unique(lines: list[Line], split: Callable[[Line], list[str]]) -> Line | None:
    """The last line with distinct cells, or else the last line; None without lines."""
    for line in reversed(lines):
        names = [cell.strip() for cell in split(line) if cell.strip()]
        if len(set(names)) == len(names) and names:
            return line
    return lines[-1] if lines else None


def _names_among_numbers(cells: list[str], after: list[Line], separator: str) -> bool:
    """Whether a line is a header with numbers as names: it holds text above a number of the next row."""
    if all(is_value(cell) for cell in cells) or not after:
        return False
    below = cells_of(after[0].text, separator)
    pairs = list(zip(cells, below, strict=False))
    return len(below) == len(cells) and all(is_value(b) for a, b in pairs if not is_value(a))


def _without_trailing(lines: list[Line], separator: str, count: int) -> tuple[list[Line], int, list[str]]:
    """Remove a trailing separator from the rows if all rows have it and the header does not.

    Returns:
        The lines, the number of cells of a row, and warnings.
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
    trimmed = [
        Line(line.number, line.text.rstrip(" ").removesuffix(separator)) if end and n == count else line
        for line, end, n in zip(lines, ends, counts, strict=True)
    ]
    return trimmed, count - 1, [Note(f"Every row ends with an extra {SEPARATORS[separator]}.")]


def _rows(path: Path, head: _Head, body: list[Line]) -> tuple[list[Line], tuple[int, ...], list[str]]:
    """The rows of a table, the row indices of repeated headers, and warnings about skipped lines."""
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
            for other in pending:
                (cut if _is_cut(other.text, head.separator, count) else between).append(other)
            pending = []
            restarts.append(line)
            if rows:
                at.append(len(rows))
            continue
        if head.units_text and text == head.units_text:
            continue
        if line.text.count('"') % 2:
            if line is not body[-1]:
                raise RecordingError(f"{path}: line {line.number} has an unclosed quotation mark; correct it.")
            pending.append(line)
            continue
        names = head.has_rows and text[0] not in _DIGITS and _is_names(line.text, head.separator)
        if count_of(line.text, head.separator) == count and not names:
            if pending:
                raise _strange(path, head, pending[0])
            rows.append(line)
        else:
            pending.append(line)
    torn = _torn(head, rows, pending)
    if pending and not torn:
        raise _strange(path, head, pending[0], len(pending))
    if torn and torn[0] not in pending:
        rows.remove(torn[0])
    begins = tuple(row for row in dict.fromkeys(at) if row < len(rows))
    warnings = _skip_warnings(restarts, at, cut, between, torn)
    if broken:
        warnings.append(
            f"{counted(len(broken), 'line')} cut short by zero bytes left out, the first {_shown(broken[0])}."
        )
    return rows, begins, warnings


def _skip_warnings(
    restarts: list[Line], at: list[int], cut: list[Line], between: list[Line], torn: list[Line]
) -> list[str]:
    warnings: list[str] = []
    if restarts and at:
        numbers = ", ".join(str(line.number) for line in restarts[:5]) + (", …" if len(restarts) > 5 else "")
        lines = f"line{'s' if len(restarts) > 1 else ''} {numbers}"
        warnings.append(Note(f"The header is repeated in {lines}, as after a restart of the logger."))
    if cut:
        warnings.append(Note(f"{counted(len(cut), 'line')} cut short before it left out, the first {_shown(cut[0])}."))
    if between:
        skipped = f"{counted(len(between), 'line')} of text before it skipped, the first {_shown(between[0])}."
        warnings.append(Note(skipped))
    if len(torn) == 1:
        warnings.append(Note(f"The last line is cut short and left out, {_shown(torn[0])}."))
    elif torn:
        warnings.append(Note(f"The last {len(torn)} lines are cut short and left out, the first {_shown(torn[0])}."))
    return warnings


def _is_names(text: str, separator: str) -> bool:
    """Whether a line holds only words, like a header."""
    cells = [cell for cell in cells_of(text, separator) if cell.strip()]
    return len(cells) > 1 and not any(is_value(cell) or _CUT_NUMBER.fullmatch(cell.strip()) for cell in cells)


def _is_cut(text: str, separator: str, count: int) -> bool:
    """Whether a line is a truncated row."""
    cells = cells_of(text, separator)
    return len(cells) <= count and all(is_value(cell) for cell in cells[:-1]) and any(map(is_value, cells))


def _torn(head: _Head, rows: list[Line], pending: list[Line]) -> list[Line]:
    """The truncated lines at the end of the table; empty if there are none, or if a line is something else."""
    if 1 < len(pending) <= _MOST_TORN:
        after = bool(rows) and pending[0].number > rows[-1].number
        cut = all(_is_cut(line.text, head.separator, len(head.names)) for line in pending)
        return pending if after and cut else []
    last = _last_cut(head, rows, pending)
    return [] if last is None else [last]


def _last_cut(head: _Head, rows: list[Line], pending: list[Line]) -> Line | None:
    """The last line if it is a truncated row, else None."""
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
    """Number of digits after the decimal point; 99 for other cells, so that they never count as shorter."""
    found = re.fullmatch(r"[+-]?\d+(?:[.,](\d*))?", cell.strip())
    return 99 if found is None else len(found[1] or "")


def _strange(path: Path, head: _Head, line: Line, alike: int = 1) -> RecordingError:
    if count_of(line.text, head.separator) == len(head.names):
        return RecordingError(
            f"{path}: line {line.number} holds words and no numbers, {_quoted(line)}: a second header, or text; split "
            "the file there, or remove the line."
        )
    count = count_of(line.text, head.separator)
    remedy = "correct or remove that line" if alike < _MANY else "other lines are the same, so correct the header"
    return RecordingError(
        f"{path}: line {line.number} has {counted(count, 'value')} but the header names "
        f"{counted(len(head.names), 'column')} (the separator is the {SEPARATORS[head.separator]}); {remedy}."
        f"{_comma_advice(head, line)}"
    )


def _comma_advice(head: _Head, line: Line) -> str:
    """Advice if commas may separate both decimals and cells; else empty."""
    count = count_of(line.text, head.separator)
    if head.separator == "," and count > len(head.names) and "." not in line.text:
        return " If the decimals are written with a comma, export the table with semicolons."
    return ""


def _quoted(line: Line) -> str:
    text = line.text.strip()
    return f'"{text if len(text) <= 40 else text[:39] + "…"}"'


def _shown(line: Line) -> str:
    return f"line {line.number}, {_quoted(line)}"
