"""A diagnosis on the terminal: the verdict, each finding in a few lines, then noise, what to do and the files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.report.diagnosis import findings as say
from mkc_torch.report.diagnosis import noise, numbers
from mkc_torch.report.diagnosis import verdict as top
from mkc_torch.report.diagnosis.evidence import rows
from mkc_torch.report.words.terms import term
from mkc_torch.report.words.typesetting import plain, typeset

_LABEL = 9  # letters of the longest label
_MOST_LINES = 6
_MOST_WARNINGS = 6
_STYLE: dict[top.Tone, str] = {"good": "bold green", "found": "bold cyan", "faint": "bold", "open": "bold yellow"}


def show(console: Console, diagnosis: Diagnosis, files: list[Path]) -> None:
    """Print the summary of a diagnosis and the files that hold it."""
    d = diagnosis
    console.print()
    told = plain(d.recording) or term("label.recording")
    if d.simulation:
        told = term("label.against", recording=told, simulation=plain(d.simulation))
    console.print(Text(told, style="bold"))
    console.print(Text(top.headline(d), style=_STYLE[top.tone(d)]))
    for i, finding in enumerate(d.findings, 1):
        if len(d.findings) > 1:
            console.print(Text(f"{i}  {say.finding_name(finding)}", style="bold"))
        console.print(_facts(_of_finding(finding, d, first=i == 1)))
    console.print(_facts(_of_all(d)))
    for file in files:
        # outside the table, where a long path would be broken and could not be copied
        console.print(Text.assemble(f"{term('label.written'):<{_LABEL + 3}}", (str(file), "cyan")), soft_wrap=True)


def _of_finding(finding: Finding, diagnosis: Diagnosis, *, first: bool) -> Iterator[tuple[str, str]]:
    f = finding
    lines = [line for p in f.parameters for line in numbers.named_lines(p, f.channels)]
    if len(lines) > _MOST_LINES:
        lines = [numbers.largest(p) for p in f.parameters[:_MOST_LINES]]
        lines.append(term("number.more_parameters"))
    if lines:
        yield term("label.size"), "\n".join(lines)
    acts = f"; {say.acts_on(f)}" if f.channels else ""
    yield term("label.where"), say.where(f, numbers.clock_of(diagnosis.traces)) + acts
    if f.region is not None:
        yield term("label.mostly"), say.region(f.region)
    if f.experiments:
        yield term("label.in"), say.experiments(f.experiments)
    yield term("label.driven_by"), say.driven_by(f)
    evidence = numbers.evidence(f.p_value, diagnosis.surrogates)
    yield term("label.how_sure"), term("evidence.after_the_search", evidence=evidence)
    if f.held_out is None:
        yield term("label.held_out"), f"{term('evidence.not_measured')}: {plain(f.held_out_note)}"
    else:
        change = numbers.improvement(f.held_out.rmse_before, f.held_out.rmse_after, f.held_out.unit)
        residual = term("evidence.of_residual", change=change)
        note = f"\n{plain(f.held_out_note)}" if f.held_out_note else ""
        zero = f"; {term('evidence.zero')}" if first else ""
        yield term("label.held_out"), f"{say.better(f.held_out)}: {residual}, {numbers.gain(f.held_out)}{zero}{note}"
    yield from rows(f.evidence, terminal=True)
    if say.inseparable(f):
        yield _striking("label.or"), term("evidence.cannot_tell", rivals=say.rivals(f))
    if not f.plausible:
        yield _striking("label.doubtful"), typeset(f.plausibility) or term("evidence.no_plausible_size")


def _of_all(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    d = diagnosis
    if len(d.findings) > 1:
        yield term("label.together"), term("evidence.together", change=numbers.residual_sizes(d))
    if not d.findings:
        evidence = numbers.evidence(d.p_value, d.surrogates)
        tried = f"{d.candidates_tried:,}"
        yield (
            term("label.how_sure"),
            term("evidence.searched", evidence=evidence, candidates=tried, level=f"{d.level:g}"),
        )
    beside = noise.smooth_fit(d)
    if beside:
        yield term("label.compare"), beside
    yield term("label.noise"), noise.noise_model(d.noise)
    yield from rows(d.evidence, terminal=True)
    for sentence in top.to_do(d):
        yield term("label.to_do"), sentence
    command = top.apply_command(d)
    if command:
        yield term("label.to_do"), command
    warnings = top.warned(d)
    for warning in warnings[:_MOST_WARNINGS]:
        yield _striking("label.warning"), warning
    if len(warnings) > _MOST_WARNINGS:
        yield _striking("label.warning"), term("number.more_warnings", count=len(warnings) - _MOST_WARNINGS)


def _striking(key: str) -> str:
    """A name that stands out."""
    return f"!{term(key)}"


def _facts(lines: Iterator[tuple[str, str]]) -> Table:
    """Names and values; a name that begins with an exclamation mark stands out."""
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True, min_width=_LABEL)
    table.add_column(overflow="fold")
    last = ""
    for name, value in lines:
        label = Text("" if name == last else name.removeprefix("!"), style="bold yellow" if name[0] == "!" else "")
        table.add_row(label, Text(value))
        last = name
    return table
