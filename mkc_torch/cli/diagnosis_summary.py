"""Print a diagnosis: the verdict, its four questions, the findings, the next steps and the files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch._support.typesetting import plain, typeset
from mkc_torch.cli.remarks import note_rows, warning_rows
from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.diagnosis.verdict import Answer
from mkc_torch.report.diagnosis import before_search, environment, noise, numbers, unseen, untested
from mkc_torch.report.diagnosis import findings as sentences
from mkc_torch.report.diagnosis import verdict as top
from mkc_torch.report.diagnosis.evidence import rows

_LABEL = 11
"""Letters of the longest label."""

_MOST_LINES = 6
"""Most lines on the parameters of a finding."""

_REPORT = "report.html"

_STYLE: dict[Answer, str] = {"usable": "bold green", "look": "bold yellow", "unusable": "bold red"}
"""Style of the headline."""


def show(console: Console, diagnosis: Diagnosis, files: list[Path], paths: top.RunPaths | None = None) -> None:
    """Print the summary of a diagnosis and the files that hold it."""
    d = diagnosis
    console.print()
    heading = plain(d.recording) or "recording"
    if d.simulation:
        heading = f"{heading} against {plain(d.simulation)}"
    console.print(Text(heading, style="bold"))
    for notice in top.notices_first(d):
        console.print(Text(notice, style="bold yellow"))
    console.print(Text(top.headline(d), style=_STYLE[top.answer_word(d)]))
    if d.checks:
        console.print(Text(before_search.TITLE, style="bold"))
        console.print(_facts(("parameter", line) for line in before_search.check_lines(d)))
    console.print(_facts(_four_answers(d)))
    for i, finding in enumerate(d.findings, 1):
        if len(d.findings) > 1:
            console.print(Text(f"{i}  {_graded(finding)}", style="bold"))
        console.print(_facts(_of_finding(finding, d)))
    if d.too_few:
        console.print(_facts(("candidate", untested.candidate_line(one)) for one in untested.strongest(d)))
    console.print(_facts(_of_all(d, console.width - _LABEL - 3)))
    # outside the table, so that a command or a long path is not broken and can be copied
    command = top.apply_command(d, paths)
    for label, text in [*([("to do", command)] if command else []), *(("written", str(file)) for file in files)]:
        console.print(Text.assemble(f"{label:<{_LABEL + 3}}", (text, "cyan")), soft_wrap=True)


def _four_answers(diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    """Yield whether the simulation can be used, the goodness of fit, the noise, the findings, and the rest."""
    d = diagnosis
    yield "answer", top.answer(d)
    for line in environment.output_lines(d):
        yield "fit", line
    if d.verdict == "unfit":
        for reason in top.reasons(d):
            yield _striking("why"), reason
        yield "named", "nothing: a simulation must fit before physics is named"
        return
    for line in environment.noise_lines(d) or [noise.noise_model(d.noise)]:
        yield "noise", line
    yield "named", _named(d.findings)
    yield "unexplained", top.unexplained_place(d) or "nothing"


def _named(findings: Sequence[Finding]) -> str:
    """Return the certain findings, or the uncertain ones if there are no others."""
    sure = [f for f in findings if f.grade in ("left_out", "small")]
    names = "; ".join(_graded(f) for f in sure or findings)
    if sure or not findings:
        return names or "nothing"
    return f"nothing confirmed; {names}"


def _graded(finding: Finding) -> str:
    return f"{sentences.finding_name(finding)}: {sentences.grade(finding)}"


def _of_finding(finding: Finding, diagnosis: Diagnosis) -> Iterator[tuple[str, str]]:
    f = finding
    parameters = sentences.stated_parameters(f)
    lines = [line for p in parameters for line in numbers.named_lines(p, f.channels)]
    if len(lines) > _MOST_LINES:
        lines = [numbers.largest(p) for p in parameters[:_MOST_LINES]]
        lines.append("further parameters: see the report")
    lines += sentences.curve_values(f)
    if lines:
        yield "size", "\n".join(filter(None, [*lines, numbers.at_input(f.at_input)]))
    acts = f"; {sentences.acts_on(f)}" if f.channels else ""
    yield "where", sentences.where(f, numbers.clock_of(diagnosis.traces)) + acts
    if f.region is not None:
        yield "mostly", sentences.region(f.region)
    if f.experiments:
        yield "in", sentences.shares_of_runs(f.experiments, diagnosis.environment.runs)
    yield "driven by", sentences.driven_by(f)
    evidence = numbers.evidence(f.p_value, diagnosis.surrogates)
    sure = evidence if f.p_value is None else f"{evidence}, corrected for the search"
    yield "how sure", sure
    if f.shape is not None:
        yield "shape", "; ".join(filter(None, [sentences.shape(f), plain(f.shape.formula)]))
    if f.held_out is None:
        yield "held out", f"not measured: {plain(f.held_out_note)}"
    else:
        residual = "; ".join(unseen.residuals(f.held_out, diagnosis.environment))
        more = [unseen.diverged(f.held_out), plain(f.held_out_note)]
        change = f"{residual}; {unseen.better(f.held_out)}"
        yield "held out", "\n".join(filter(None, [change, *more]))
    yield from rows(f.evidence, terminal=True)
    if sentences.inseparable(f):
        yield _striking("or"), f"{sentences.rivals(f, sizes=True)}: this recording cannot distinguish"
    if not f.plausible:
        yield _striking("doubtful"), typeset(f.plausibility) or "no plausible size"


def _of_all(diagnosis: Diagnosis, width: int) -> Iterator[tuple[str, str]]:
    d = diagnosis
    for sentence in d.suspected:
        yield "suspected", typeset(sentence)
    if len(d.findings) > 1:
        for change in unseen.residual_of_all(d):
            yield "together", f"on held-out data: {change}"
    if not d.findings and d.verdict != "unfit":
        evidence = numbers.evidence(d.p_value, d.surrogates)
        tried = f"{d.candidates_tried:,}"
        yield ("how sure", f"{evidence}, corrected for {tried} candidates, level {d.level:g}")
    smooth = noise.smooth_fit(d)
    if smooth and d.verdict != "unfit":
        yield "compare", smooth
    if d.verdict != "unfit":
        if environment.noise_lines(d):
            yield "sensor", noise.noise_model(d.noise)
        yield from rows(d.evidence, terminal=True)
    for sentence in top.to_do(d):
        yield "to do", sentence
    for _, warning in warning_rows(top.warned(d), _REPORT):
        yield _striking("warning"), warning
    yield from note_rows([plain(note) for note in d.notes], _REPORT, width)


def _striking(key: str) -> str:
    """Return a label that is highlighted."""
    return f"!{key}"


def _facts(lines: Iterator[tuple[str, str]]) -> Table:
    """Return a table of labels and values; a label that begins with an exclamation mark is highlighted."""
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True, min_width=_LABEL)
    table.add_column(overflow="fold")
    last = ""
    for name, value in lines:
        label = Text("" if name == last else name.removeprefix("!"), style="bold yellow" if name[0] == "!" else "")
        table.add_row(label, Text(value))
        last = name
    return table
