"""What the terminal says of a proof in worlds: each world, its aims, and where the rest stands."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table
from rich.text import Text

from mkc_torch.challenge.page import measured_text, share_text
from mkc_torch.challenge.scenarios.page import NOT_HELD, TOO_FEW, held
from mkc_torch.challenge.scenarios.score import ScenarioScore, ScenariosScore
from mkc_torch.cli.console import out

__all__ = ["show_worlds"]


def show_worlds(score: ScenariosScore, total: int, output: Path) -> None:
    """Print the score of each world, with its aims beside it."""
    console = out()
    console.print()
    console.print(Text(f"Blind proof in worlds: {total:,} recordings", style="bold"))
    for world in (*score.worlds, score.total):
        console.print()
        console.print(Text.assemble((world.name, "bold"), f": {world.sentence}"))
        facts = Table.grid(padding=(0, 3, 0, 0))
        facts.add_column(no_wrap=True)
        facts.add_column(overflow="fold")
        for label, told in _facts(world):
            facts.add_row(f"  {label}", told)
        console.print(facts)
        aims = Table.grid(padding=(0, 3, 0, 0))
        aims.add_column(overflow="fold")
        aims.add_column(justify="right", no_wrap=True)
        aims.add_column(no_wrap=True)
        for measured in world.measured:
            word = held(measured)
            style = "bold yellow" if word in (NOT_HELD, TOO_FEW) else ""
            aims.add_row(f"  {measured.threshold.sentence}", measured_text(measured), Text(word, style=style))
        console.print(aims)
    console.print()
    failed = [name for world in score.worlds for name in world.failed]
    console.print(Text(f"{'failed':<15}{', '.join(failed) or 'none'}"))
    for name in ("challenge.html", "score.json", "summary.md", "key_hash.txt"):
        # outside the table, where a long path would be broken and could not be copied
        console.print(Text.assemble(f"{'written':<15}", (str(output / name), "cyan")), soft_wrap=True)


def _facts(world: ScenarioScore) -> list[tuple[str, str]]:
    """Labels and numbers, but for what there were no recordings of."""
    said = ", ".join(f"{verdict} {count}" for verdict, count in world.verdicts.items())
    facts = [(f"said of {world.empty}", said), ("false alarms", share_text(world.false_alarms))]
    shares = (
        ("unexplained, at the right state", world.unexplained_located),
        ("at the right state", world.located),
        ("named right, z, z_sep ≥ 10", world.named),
        ("  with a push", world.named_pushed),
        ("  without", world.named_quiet),
        ("a wrong name claimed", world.wrong),
        ("nearest in the catalogue", world.nearest),
        ("outside, a name claimed", world.outside_wrong),
        ("told as the sensor's", world.sensor_told),
    )
    facts += [(label, share_text(share)) for label, share in shares if share.total]
    if world.apart:
        facts += [("a name alone", share_text(world.alone)), ("cannot be told", share_text(world.undecided))]
    facts += [(why, ", ".join(f"{v} {n}" for v, n in told.items() if n)) for why, told in world.reasons.items()]
    return facts
