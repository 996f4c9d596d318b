"""Print the score of a blind proof."""

from __future__ import annotations

import math
from pathlib import Path

from rich.table import Table
from rich.text import Text

from mkc_torch.challenge.page import measured_text, share_text
from mkc_torch.challenge.score import MeasuredThreshold, Score
from mkc_torch.cli.console import out

__all__ = ["show_challenge"]


def _is_count(measured: MeasuredThreshold) -> bool:
    """Whether the threshold is a minimum number of recordings."""
    return math.isinf(measured.threshold.high)


def _reason(measured: MeasuredThreshold) -> str:
    return "too few" if _is_count(measured) else "no"


def show_challenge(score: Score, cases: int, empty: int, output: Path) -> None:
    """Print the measured values, their thresholds, and the paths of the files."""
    console = out()
    console.print()
    console.print(Text(f"Blind proof: {cases + empty:,} recordings, hidden physics in {cases:,}", style="bold"))
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("threshold", overflow="fold")
    table.add_column("measured", justify="right")
    table.add_column("holds")
    for m in score.measured:
        table.add_row(
            Text(m.threshold.sentence),
            measured_text(m),
            Text("—") if math.isnan(m.value) else Text("yes") if m.holds else Text(_reason(m), style="bold yellow"),
        )
    console.print(table)
    if few := [m for m in score.measured if _is_count(m) and not m.holds]:
        found = " and ".join(f"{m.value:.0f} of at least {m.threshold.low:.0f}" for m in few)
        console.print(
            f"Too few recordings ({found}): these results may be chance. Leave out --cases and --empty for a run of "
            "full size."
        )
    facts = Table.grid(padding=(0, 3, 0, 0))
    facts.add_column(no_wrap=True)
    facts.add_column(overflow="fold")
    facts.add_row("verdicts, empty", ", ".join(f"{verdict} {count}" for verdict, count in score.verdicts.items()))
    facts.add_row("false alarms", share_text(score.false_alarms))
    facts.add_row("named right", share_text(score.named))
    if score.driver.total:
        facts.add_row("driver right", share_text(score.driver))
    if score.located.total:
        facts.add_row("located right", share_text(score.located))
    facts.add_row("failed", ", ".join(score.failed) or "none")
    console.print(facts)
    for name in ("challenge.html", "summary.md", "key_hash.txt"):
        # outside the table, so that a long path is not broken and can be copied
        console.print(Text.assemble(f"{'written':<15}", (str(output / name), "cyan")), soft_wrap=True)
