"""A calibration on the terminal: one small table, then what to notice and where the files are."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch.calibration.calibrate import Calibration
from mkc_torch.report.words import numbers as w


def show(console: Console, c: Calibration, files: list[Path]) -> None:
    """Print the summary of a calibration and the files that hold it."""
    console.print()
    console.print(Text(c.recording or "recording", style="bold"))
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True)
    for _ in range(3):
        table.add_column(justify="right", no_wrap=True)
    power = w.power(c.radius)
    unit = w.in_power(power, c.unit)
    table.add_row(Text(f"offset x, y, z ± SE, {unit}"), *w.with_errors(c.center, c.center_se, power))
    table.add_row(Text(f"semi-axes ± SE, {unit}"), *w.with_errors(c.semi_axes, c.semi_axes_se, power))
    console.print(table)
    residual = f"{w.change(c.before, c.after, c.unit)} robust, {w.size(c.before.rms)} → {w.size(c.after.rms)} rms"
    facts = Table.grid(padding=(0, 3, 0, 0))
    facts.add_column(no_wrap=True)
    facts.add_column(overflow="fold")
    for name, value in (
        ("residual", residual),
        ("noise", w.noise(c)),
        ("rejected", w.rejection(c)),
        ("coverage", f"{w.share(c.coverage.fraction)} of all directions have a sample within 15°"),
    ):
        facts.add_row(name, Text(value))
    for warning in c.warnings:
        facts.add_row(Text("warning", style="bold yellow"), Text(warning))
    console.print(facts)
    for file in files:
        # outside the table, where a long path would be broken and could not be copied
        console.print(Text.assemble("written    ", (str(file), "cyan")), soft_wrap=True)
