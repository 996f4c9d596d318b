"""Print a calibration: a table of numbers, the warnings, and the paths of the files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch._words.terms import term
from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.calibration.differences import Differences
from mkc_torch.report.words import numbers as w
from mkc_torch.report.words.comparison import difference_rows, difference_sentences


def show(
    console: Console,
    c: Calibration,
    files: Sequence[Path],
    compared: Differences | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Print a summary of a calibration, its differences from an earlier one, and its files."""
    console.print()
    console.print(Text(c.name or c.recording or term("label.recording"), style="bold"))
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True)
    for _ in range(3):
        table.add_column(justify="right", no_wrap=True)
    power = w.power(c.radius)
    unit = w.in_power(power, c.unit)
    table.add_row(Text(term("table.offset_line", unit=unit)), *w.with_errors(c.center, c.center_se, power))
    table.add_row(Text(term("table.semi_axes_line", unit=unit)), *w.with_errors(c.semi_axes, c.semi_axes_se, power))
    console.print(table)
    residual = term(
        "calibration.change",
        robust=w.change(c.before, c.after, c.unit),
        before=w.size(c.before.rms),
        after=w.size(c.after.rms),
    )
    facts = Table.grid(padding=(0, 3, 0, 0))
    facts.add_column(no_wrap=True)
    facts.add_column(overflow="fold")
    for name, value in (
        (term("label.residual"), residual),
        (term("label.noise"), w.noise(c)),
        (term("label.rejected"), w.rejection(c)),
        (term("label.coverage"), term("calibration.coverage", share=w.share(c.coverage.fraction))),
    ):
        facts.add_row(name, Text(value))
    if c.rest_bias is not None:
        facts.add_row(term("label.gyroscope"), Text(w.rest_bias(c.rest_bias)))
    if c.aid is not None:
        facts.add_row(term("label.aided"), Text(" ".join(w.aided(c))))
    for warning in (*c.warnings, *notes):
        facts.add_row(Text(term("label.warning"), style="bold yellow"), Text(warning))
    console.print(facts)
    if compared is not None:
        _show_differences(console, compared)
    for file in files:
        # outside the table, so that a long path is not broken and can be copied
        console.print(Text.assemble(f"{term('label.written'):<11}", (str(file), "cyan")), soft_wrap=True)


def _show_differences(console: Console, found: Differences) -> None:
    """Print the differences from an earlier calibration."""
    console.print(Text(term("section.against", name=found.name), style="bold"))
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="")
    table.add_column("", no_wrap=True)
    heads = (term("table.this_one"), found.name, term("table.difference"), term("table.in_errors"))
    for head in heads:
        table.add_column(Text(head), justify="right")
    for row in difference_rows(found):
        table.add_row(*map(Text, row))
    console.print(table)
    for sentence in difference_sentences(found):
        console.print(Text(sentence))
