"""A diagnosis on the terminal: the verdict, each finding in a few lines, then noise, what to do and the files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.report import diagnosis_wording as say

_LABEL = 9  # letters of the longest label
_MOST_PARAMETERS = 4
_MOST_WARNINGS = 6
_STYLE = {"adequate": "bold green", "explained": "bold cyan", "unexplained": "bold yellow"}


def show(console: Console, diagnosis: Diagnosis, files: list[Path]) -> None:
    """Print the summary of a diagnosis and the files that hold it."""
    d = diagnosis
    console.print()
    against = f" against {say.plain(d.simulation)}" if d.simulation else ""
    console.print(Text(f"{say.plain(d.recording) or 'recording'}{against}", style="bold"))
    console.print(Text(say.headline(d), style=_STYLE[d.verdict]))
    for i, finding in enumerate(d.findings, 1):
        if len(d.findings) > 1:
            console.print(Text(f"{i}  {say.finding_name(finding)}", style="bold"))
        console.print(_facts(_of_finding(finding, d)))
    console.print(_facts(_of_all(d)))
    for file in files:
        # outside the table, where a long path would be broken and could not be copied
        console.print(Text.assemble(f"{'written':<{_LABEL + 3}}", (str(file), "cyan")), soft_wrap=True)


def _of_finding(finding: Finding, diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    f = finding
    lines = [
        f"{say.plain(p.name)} {line}" if i == 0 else line
        for p in f.parameters[:_MOST_PARAMETERS]
        for i, line in enumerate(say.measured(p.value, p.standard_error, p.unit))
    ]
    if len(f.parameters) > _MOST_PARAMETERS:
        lines.append(f"and {len(f.parameters) - _MOST_PARAMETERS} more")
    if lines:
        yield "size", "\n".join(lines)
    acts = f"; acts on {say.several(f.channels)}" if f.channels else ""
    yield "where", say.where(f, say.clock_of(diagnosis.traces)) + acts
    if f.region is not None:
        yield "mostly", say.region(f.region)
    if f.experiments:
        yield "in", say.experiments(f.experiments)
    yield "driven by", say.driven_by(f)
    yield "how sure", f"{say.evidence(f.p_value, diagnosis.surrogates)}, after the whole search"
    if f.held_out is None:
        yield "held out", f"not measured: {say.plain(f.held_out_note)}"
    else:
        residual = say.improvement(f.held_out.rmse_before, f.held_out.rmse_after, f.held_out.unit)
        note = f"\n{say.plain(f.held_out_note)}" if f.held_out_note else ""
        yield "held out", f"{say.gain(f.held_out)}, residual {residual}{note}"
    if say.inseparable(f):
        yield "!or", f"{say.rivals(f)}: this recording cannot tell"
    if not f.plausible:
        yield "!doubtful", say.plain(f.plausibility) or "no plausible size"


def _of_all(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    d = diagnosis
    if len(d.findings) > 1:
        yield "together", f"residual {say.residual_sizes(d)} on held-out data"
    if not d.findings:
        searched = f"{d.candidates_tried:,} candidates tried, level {d.level:g}"
        yield "how sure", f"{say.evidence(d.p_value, d.surrogates)}; {searched}"
    if d.ceiling is not None:
        yield "ceiling", say.ceiling_reached(d)
    yield "noise", say.noise_model(d.noise)
    for sentence in say.to_do(d):
        yield "to do", sentence
    for warning in d.warnings[:_MOST_WARNINGS]:
        yield "!warning", say.plain(warning)
    if len(d.warnings) > _MOST_WARNINGS:
        yield "!warning", f"{len(d.warnings) - _MOST_WARNINGS} more; see the report"


def _facts(rows: Iterator[tuple[str, str]]) -> Table:
    """Names and values; a name that begins with an exclamation mark stands out."""
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True, min_width=_LABEL)
    table.add_column(overflow="fold")
    last = ""
    for name, value in rows:
        label = Text("" if name == last else name.removeprefix("!"), style="bold yellow" if name[0] == "!" else "")
        table.add_row(label, Text(value))
        last = name
    return table
