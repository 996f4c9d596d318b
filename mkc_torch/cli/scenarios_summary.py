"""Print the score of a blind proof in scenarios."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table
from rich.text import Text

from mkc_torch.challenge.page import measured_text, share_text
from mkc_torch.challenge.scenarios.page import NOT_HELD, TOO_FEW, held
from mkc_torch.challenge.scenarios.score import ScenarioScore, ScenariosScore
from mkc_torch.cli.console import out

__all__ = ["show_scenarios"]


def show_scenarios(score: ScenariosScore, total: int, output: Path) -> None:
    """Print the score and the aims of each scenario, and the paths of the files."""
    console = out()
    console.print()
    console.print(Text(f"Blind proof in scenarios: {total:,} recordings", style="bold"))
    for scenario in (*score.scenarios, score.total):
        console.print()
        console.print(Text.assemble((scenario.name, "bold"), f": {scenario.sentence}"))
        facts = Table.grid(padding=(0, 3, 0, 0))
        facts.add_column(no_wrap=True)
        facts.add_column(overflow="fold")
        for label, value in _facts(scenario):
            facts.add_row(f"  {label}", value)
        console.print(facts)
        aims = Table.grid(padding=(0, 3, 0, 0))
        aims.add_column(overflow="fold")
        aims.add_column(justify="right", no_wrap=True)
        aims.add_column(no_wrap=True)
        for measured in scenario.measured:
            word = held(measured)
            style = "bold yellow" if word in (NOT_HELD, TOO_FEW) else ""
            aims.add_row(f"  {measured.threshold.sentence}", measured_text(measured), Text(word, style=style))
        console.print(aims)
    console.print()
    failed = [name for scenario in score.scenarios for name in scenario.failed]
    console.print(Text(f"{'failed':<15}{', '.join(failed) or 'none'}"))
    for name in ("challenge.html", "score.json", "summary.md", "key_hash.txt"):
        # outside the table, so that a long path is not broken and can be copied
        console.print(Text.assemble(f"{'written':<15}", (str(output / name), "cyan")), soft_wrap=True)


def _facts(scenario: ScenarioScore) -> list[tuple[str, str]]:
    """Return labels and values; a share without recordings is left out."""
    verdicts = ", ".join(f"{verdict} {count}" for verdict, count in scenario.verdicts.items())
    facts = [(f"verdicts of {scenario.empty}", verdicts), ("false alarms", share_text(scenario.false_alarms))]
    shares = (
        ("unexplained, at the right state", scenario.unexplained_located),
        ("at the right state", scenario.located),
        ("named right, z, z_sep ≥ 10", scenario.named),
        ("  with a disturbance", scenario.named_disturbed),
        ("  without", scenario.named_undisturbed),
        ("a wrong name claimed", scenario.wrong),
        ("nearest in the catalogue", scenario.nearest),
        ("outside, a name claimed", scenario.outside_wrong),
        ("attributed to the sensor", scenario.sensor_reported),
    )
    facts += [(label, share_text(share)) for label, share in shares if share.total]
    if scenario.apart:
        facts += [("a name alone", share_text(scenario.alone)), ("undecided", share_text(scenario.undecided))]
    facts += [(why, ", ".join(f"{v} {n}" for v, n in counts.items() if n)) for why, counts in scenario.reasons.items()]
    return facts
