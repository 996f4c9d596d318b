"""The result of the proof in worlds for a reader: one HTML page, each world a row, and a summary in Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mkc_torch.challenge.page import measured_text, share_text
from mkc_torch.challenge.scenarios.score import ScenarioScore, ScenariosScore
from mkc_torch.challenge.score import MeasuredThreshold
from mkc_torch.challenge.verdict import VERDICTS

_TEMPLATES = Path(__file__).parents[1] / "templates"
_SHARED = Path(__file__).parents[2] / "report" / "templates"

HELD, NOT_HELD, TOO_FEW, NOT_MEASURED = "held", "not held", "too few", "not measured"

Column = tuple[str, Callable[[ScenarioScore], str]]

SAID: Sequence[Column] = (
    ("recordings", lambda world: str(world.empty)),
    ("false alarms", lambda world: share_text(world.false_alarms)),
    *((verdict, lambda world, verdict=verdict: str(world.verdicts[verdict])) for verdict in VERDICTS),
    ("unexplained, at the right state", lambda world: share_text(world.unexplained_located)),
    ("at the right state", lambda world: share_text(world.located)),
    ("told as the sensor's", lambda world: share_text(world.sensor_told)),
)
"""Of recordings with nothing hidden, and of useless simulations."""

NAMED: Sequence[Column] = (
    ("hidden", lambda world: str(world.hidden)),
    ("z, z_sep ≥ 10", lambda world: str(world.strong)),
    ("named right", lambda world: share_text(world.named)),
    ("with a push", lambda world: share_text(world.named_pushed)),
    ("without", lambda world: share_text(world.named_quiet)),
    ("a wrong name claimed", lambda world: share_text(world.wrong)),
    ("nearest in the catalogue", lambda world: share_text(world.nearest)),
    ("outside: a name claimed", lambda world: share_text(world.outside_wrong)),
    ("outside: nearest, or unknown", lambda world: share_text(world.outside_nearest)),
)
"""Of recordings with something hidden."""


APART: Sequence[Column] = (
    ("recordings", lambda world: str(world.empty + world.hidden)),
    ("a name alone, not the hidden one's", lambda world: share_text(world.alone)),
    ("said that it cannot be told", lambda world: share_text(world.undecided)),
)
"""Of worlds that are counted apart, with something hidden or nothing."""


def held(measured: MeasuredThreshold) -> str:
    """Whether an aim holds, in words.

    Example:
        >>> from mkc_torch.challenge.aims import FALSE_ALARMS
        >>> held(MeasuredThreshold(FALSE_ALARMS, 0.05)), held(MeasuredThreshold(FALSE_ALARMS, 0.2))
        ('held', 'not held')
    """
    if math.isnan(measured.value):
        return NOT_MEASURED
    if measured.holds:
        return HELD
    return TOO_FEW if math.isinf(measured.threshold.high) else NOT_HELD


def worlds_page(score: ScenariosScore, settings: Mapping[str, Any]) -> str:
    """The page. Needs the ``cli`` extra."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=FileSystemLoader([_TEMPLATES, _SHARED]),
        autoescape=select_autoescape(["html", "html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(share=share_text, measured=measured_text, held=held)
    asked = [measured for world in _rows(score) for measured in world.measured if held(measured) != NOT_MEASURED]
    return environment.get_template("worlds.html.j2").render(
        score=score,
        rows=_rows(score),
        hiding=[world for world in _rows(score) if world.hidden],
        said=SAID,
        named=NAMED,
        counted=APART,
        apart=[world for world in _rows(score) if world.apart],
        passed=sum(m.holds for m in asked),
        asked=len(asked),
        settings=settings,
        failed=[name for world in score.worlds for name in world.failed],
        verdicts=VERDICTS,
    )


def worlds_summary(score: ScenariosScore, settings: Mapping[str, Any]) -> str:
    """The numbers in Markdown."""
    lines = ["# The blind proof, in worlds", "", *(f"- {name}: {value}" for name, value in settings.items()), ""]
    lines += _table(SAID, _rows(score))
    if hiding := [world for world in _rows(score) if world.hidden]:
        lines += ["", *_table(NAMED, hiding)]
    if apart := [world for world in _rows(score) if world.apart]:
        lines += ["", *_table(APART, apart)]
    lines += ["", "| world | asked | measured | holds |", "|---|---|---|---|"]
    lines += [
        f"| {world.name} | {m.threshold.sentence} | {measured_text(m)} | {_marked(held(m))} |"
        for world in _rows(score)
        for m in world.measured
    ]
    lines += ["", "| world | what it is like | right | not right |", "|---|---|---|---|"]
    lines += [
        f"| {world.name} | {world.sentence} | {world.right_to_say} | {world.wrong_to_say} |" for world in score.worlds
    ]
    for world in score.worlds:
        lines += [""] * bool(world.reasons)
        lines += [
            f"- {why}: {', '.join(f'{verdict} {count}' for verdict, count in told.items())}"
            for why, told in world.reasons.items()
        ]
    return "\n".join(lines) + "\n"


def _table(columns: Sequence[Column], rows: Sequence[ScenarioScore]) -> list[str]:
    lines = [f"| world | {' | '.join(name for name, _ in columns)} |", "|---" * (len(columns) + 1) + "|"]
    return lines + [f"| {row.name} | {' | '.join(cell(row) for _, cell in columns)} |" for row in rows]


def _marked(word: str) -> str:
    return f"**{word}**" if word in (NOT_HELD, TOO_FEW) else word


def _rows(score: ScenariosScore) -> list[ScenarioScore]:
    return [*score.worlds, score.total]
