"""Print calibrations: the result first, then the warnings, the numbers, the notes and the paths of the files."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.differences import Differences
from mkc_torch.calibration.quality import doubts
from mkc_torch.cli.remarks import NOTE, note_rows, warning_rows
from mkc_torch.report.words import numbers as w
from mkc_torch.report.words.comparison import difference_rows, difference_sentences
from mkc_torch.report.words.verdict import calibration_verdict, is_doubtful, result_in_a_word

_LABEL = 11
"""Letters of the column of labels."""

_REPORT = "report.html"

_MOST_WARNINGS = 2
"""Most warnings for each sensor of a file that holds several."""


class SensorResult(NamedTuple):
    """A sensor of a file with its calibration and files, or the reason why it has no calibration."""

    name: str
    calibration: Calibration | None
    files: Sequence[Path]
    notes: Sequence[str]
    reason: str = ""


def show(
    console: Console,
    c: Calibration,
    files: Sequence[Path],
    compared: Differences | None = None,
    notes: Sequence[str] = (),
    source: Path | None = None,
    read_with: Sequence[str] = (),
) -> None:
    """Print a summary of a calibration, its differences from an earlier one, the next command and its files.

    ``notes`` are remarks on the exports, ``source`` is the recording, which was read with the options
    ``read_with``.
    """
    console.print()
    console.print(_headline(c.name or c.recording or "recording", c))
    _print_rows(console, [*warning_rows(c.warnings, _REPORT), *_exports(notes)])
    console.print(_numbers(c))
    _print_rows(console, [*_facts(c), *note_rows(c.notes, _REPORT, console.width - _LABEL - 3)])
    if compared is not None:
        _show_differences(console, compared)
    if files and source is not None:
        command = shlex.join(_next_command(c, files[0], source, read_with))
        console.print(Text(f"{'to do':<{_LABEL + 3}}{command}"), soft_wrap=True)
    _print_files(console, files)


def _next_command(c: Calibration, file: Path, source: Path, read_with: Sequence[str]) -> tuple[str, ...]:
    """Return the proposed command: a diagnosis of a changed offset, else the correction of the recording."""
    if "offset_changed" in doubts(c) and c.sensor == "mag":
        return "mkc", "diagnose", str(source), "--simulation", "magnetometer", *read_with, "--output", "diagnosed"
    return "mkc", "apply", str(file), str(source), *read_with, "--output", "corrected.csv"


def show_sensors(console: Console, recording: str, results: Sequence[SensorResult]) -> None:
    """Print the results of a file with several magnetometers: a table, what questions each, notes, and the files."""
    console.print()
    console.print(Text(f"{recording}: {len(results)} magnetometers", style="bold"))
    table = Table.grid(padding=(0, 3, 0, 0))
    units = {r.calibration.unit for r in results if r.calibration is not None}
    unit = next(iter(units)) if len(units) == 1 else ""
    offset = f"offset x, y, z ± SE, {unit}"
    heads = ("sensor", "result", offset, "residual", "rejected")
    for _ in heads:
        table.add_column(no_wrap=True)
    table.add_row(*(Text(head, style="dim") for head in heads))
    for result in results:
        table.add_row(*map(Text, _row(result)))
    console.print(table)
    for result in results:
        console.print()
        if result.calibration is None:
            console.print(Text.assemble((f"{result.name}: ", "bold"), result.reason), soft_wrap=True)
            continue
        console.print(_headline(result.name, result.calibration))
        remarks = warning_rows(result.calibration.warnings, _REPORT, _MOST_WARNINGS)
        _print_rows(console, [*remarks, *_exports(result.notes)])
    console.print()
    notes = dict.fromkeys(note for r in results if r.calibration is not None for note in r.calibration.notes)
    _print_rows(console, note_rows(list(notes), _REPORT, console.width - _LABEL - 3))
    for result in results:
        _print_files(console, result.files)


def _row(result: SensorResult) -> tuple[str, ...]:
    c = result.calibration
    if c is None:
        return result.name, "not calibrated", "", "", ""
    offset = "  ".join(w.with_errors(c.center, c.center_se, w.power(c.radius)))
    return result.name, result_in_a_word(c), offset, w.change(c.before, c.after, c.unit), w.share(c.rejected_share)


def _headline(name: str, c: Calibration) -> Text:
    style = "bold yellow" if is_doubtful(c) else "bold green"
    return Text.assemble((f"{name}: ", "bold"), (calibration_verdict(c), style))


def _exports(notes: Sequence[str]) -> Iterator[tuple[str, str]]:
    for note in notes:
        yield "warning", note


def _numbers(c: Calibration) -> Table:
    """Return the table of offset and semi-axes."""
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True)
    for _ in range(3):
        table.add_column(justify="right", no_wrap=True)
    power = w.power(c.radius)
    unit = w.in_power(power, c.unit)
    table.add_row(Text(f"offset x, y, z ± SE, {unit}"), *w.with_errors(c.center, c.center_se, power))
    table.add_row(Text(f"semi-axes ± SE, {unit}"), *w.with_errors(c.semi_axes, c.semi_axes_se, power))
    return table


def _facts(c: Calibration) -> Iterator[tuple[str, str]]:
    """Yield the residual, the noise, the rejected samples, the coverage, and what aided the fit."""
    yield (
        "residual",
        (f"{w.change(c.before, c.after, c.unit)} robust, {w.size(c.before.rms)} → {w.size(c.after.rms)} rms"),
    )
    yield "noise", w.noise(c)
    yield "rejected", w.rejection(c)
    yield "coverage", f"{w.share(c.coverage.fraction)} of all directions have a sample within 15°"
    if c.rest_bias is not None:
        yield "gyroscope", w.rest_bias(c.rest_bias)
    if c.aid is not None:
        yield "aided", " ".join(w.aided(c))


def _print_rows(console: Console, rows: Iterator[tuple[str, str]] | Sequence[tuple[str, str]]) -> None:
    facts = Table.grid(padding=(0, 3, 0, 0))
    facts.add_column(no_wrap=True, min_width=_LABEL)
    facts.add_column(overflow="fold")
    rows, last = list(rows), ""
    for label, text in rows:
        style = "bold yellow" if label == "warning" else ""
        facts.add_row(Text("" if label == last == NOTE else label, style=style), Text(text))
        last = label
    if rows:
        console.print(facts)


def _print_files(console: Console, files: Sequence[Path]) -> None:
    for file in files:
        # outside the table, so that a long path is not broken and can be copied
        console.print(Text.assemble(f"{'written':<{_LABEL + 3}}", (str(file), "cyan")), soft_wrap=True)


def _show_differences(console: Console, found: Differences) -> None:
    """Print the differences from an earlier calibration."""
    console.print(Text(f"Comparison with the calibration {found.name}", style="bold"))
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="")
    table.add_column("", no_wrap=True)
    heads = ("this calibration", found.name, "difference ± SE", "in standard errors")
    for head in heads:
        table.add_column(Text(head), justify="right")
    for row in difference_rows(found):
        table.add_row(*map(Text, row))
    console.print(table)
    for sentence in difference_sentences(found):
        console.print(Text(sentence))
