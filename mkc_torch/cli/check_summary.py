"""Print the checks of a model: a table of all recordings, the reasons, and the files."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.console import Console
from rich.table import Table
from rich.text import Text

from mkc_torch._support.typesetting import plain, typeset
from mkc_torch.cli.check_files import CheckedFile
from mkc_torch.cli.remarks import warning_rows
from mkc_torch.diagnosis import RecordingCheck
from mkc_torch.report.check import sentences

_LABEL = 11
"""Letters of the longest label."""


def show_checks(console: Console, checked: Sequence[CheckedFile]) -> None:
    """Print the table, and below it what a reader has to know of each recording."""
    known = [(each, each.check) for each in checked if each.check is not None]
    if not known:
        return
    table = Table(box=None, padding=(0, 3, 0, 0), show_edge=False)
    for name in ("recording", "output"):
        table.add_column(name)
    for name in ("without", "with findings"):
        table.add_column(name, justify="right")
    table.add_column("ratio (95 %)", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    for file, check in known:
        for number, each in enumerate(check.outputs):
            verdict = check.verdict if check.used_in_fit or not each.failure else "does not hold"
            verdict = verdict if check.used_in_fit or each.failure else "holds"
            table.add_row(
                "" if number else file.path.name,
                plain(each.output),
                sentences.rmse(each.baseline, each.unit),
                sentences.rmse(each.corrected, each.unit),
                sentences.ratio(each.ratio),
                Text(verdict, style="bold green" if verdict == "holds" else "bold yellow"),
            )
    console.print(table)
    for how, group in groupby(known, lambda pair: sentences.how(pair[1])):
        names = ", ".join(file.path.name for file, _ in group)
        _row(console, "predicted", f"{names}: {how}" if len(known) > 1 else how)
    for file, check in known:
        for label, text in _remarks(check):
            _row(console, label, f"{file.path.name}: {text}" if len(known) > 1 else text)
        for path in file.files:
            console.print(Text.assemble(f"{'written':<{_LABEL + 3}}", (str(path), "cyan")), soft_wrap=True)


def _remarks(check: RecordingCheck) -> list[tuple[str, str]]:
    """Return the reasons and warnings of a recording, each with its label."""
    rows = [("why", typeset(reason)) for reason in check.reasons]
    return [*rows, *((label, typeset(text)) for label, text in warning_rows(check.warnings, "check.html"))]


def _row(console: Console, label: str, text: str) -> None:
    table = Table.grid(padding=(0, 3, 0, 0))
    table.add_column(no_wrap=True, min_width=_LABEL)
    table.add_column(overflow="fold")
    table.add_row(label, text)
    console.print(table)
