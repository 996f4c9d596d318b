"""The result of the proof in scenarios: an HTML page with a row for each scenario, and a summary in Markdown."""

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

VERDICT_COLUMNS: Sequence[Column] = (
    ("recordings", lambda scenario: str(scenario.empty)),
    ("false alarms", lambda scenario: share_text(scenario.false_alarms)),
    *((verdict, lambda scenario, verdict=verdict: str(scenario.verdicts[verdict])) for verdict in VERDICTS),
    ("unexplained, at the right state", lambda scenario: share_text(scenario.unexplained_located)),
    ("at the right state", lambda scenario: share_text(scenario.located)),
    ("attributed to the sensor", lambda scenario: share_text(scenario.sensor_reported)),
)
"""Columns on recordings without hidden physics, and on unusable simulations."""

NAMED_COLUMNS: Sequence[Column] = (
    ("hidden", lambda scenario: str(scenario.hidden)),
    ("z, z_sep ≥ 10", lambda scenario: str(scenario.strong)),
    ("named right", lambda scenario: share_text(scenario.named)),
    ("with a disturbance", lambda scenario: share_text(scenario.named_disturbed)),
    ("without", lambda scenario: share_text(scenario.named_undisturbed)),
    ("a wrong name claimed", lambda scenario: share_text(scenario.wrong)),
    ("nearest in the catalogue", lambda scenario: share_text(scenario.nearest)),
    ("outside: a name claimed", lambda scenario: share_text(scenario.outside_wrong)),
    ("outside: nearest, or unknown", lambda scenario: share_text(scenario.outside_nearest)),
)
"""Columns on recordings with hidden physics."""

APART_COLUMNS: Sequence[Column] = (
    ("recordings", lambda scenario: str(scenario.empty + scenario.hidden)),
    ("a single wrong name", lambda scenario: share_text(scenario.alone)),
    ("undecided", lambda scenario: share_text(scenario.undecided)),
)
"""Columns on scenarios that are counted apart, with and without hidden physics."""


def held(measured: MeasuredThreshold) -> str:
    """Return in words whether an aim holds.

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


def scenarios_page(score: ScenariosScore, settings: Mapping[str, Any]) -> str:
    """Return the HTML page. Needs the ``cli`` extra."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape

    environment = Environment(
        loader=FileSystemLoader([_TEMPLATES, _SHARED]),
        autoescape=select_autoescape(["html", "html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(share=share_text, measured=measured_text, held=held)
    aims = [measured for scenario in _rows(score) for measured in scenario.measured if held(measured) != NOT_MEASURED]
    return environment.get_template("scenarios.html.j2").render(
        score=score,
        rows=_rows(score),
        hiding=[scenario for scenario in _rows(score) if scenario.hidden],
        verdict_columns=VERDICT_COLUMNS,
        named=NAMED_COLUMNS,
        counted=APART_COLUMNS,
        apart=[scenario for scenario in _rows(score) if scenario.apart],
        passed=sum(m.holds for m in aims),
        asked=len(aims),
        settings=settings,
        failed=[name for scenario in score.scenarios for name in scenario.failed],
        verdicts=VERDICTS,
    )


def scenarios_summary(score: ScenariosScore, settings: Mapping[str, Any]) -> str:
    """Return the numbers in Markdown."""
    lines = ["# The blind proof, in scenarios", "", *(f"- {name}: {value}" for name, value in settings.items()), ""]
    lines += _table(VERDICT_COLUMNS, _rows(score))
    if hiding := [scenario for scenario in _rows(score) if scenario.hidden]:
        lines += ["", *_table(NAMED_COLUMNS, hiding)]
    if apart := [scenario for scenario in _rows(score) if scenario.apart]:
        lines += ["", *_table(APART_COLUMNS, apart)]
    lines += ["", "| scenario | aim | measured | holds |", "|---|---|---|---|"]
    lines += [
        f"| {scenario.name} | {m.threshold.sentence} | {measured_text(m)} | {_marked(held(m))} |"
        for scenario in _rows(score)
        for m in scenario.measured
    ]
    lines += ["", "| scenario | description | right | wrong |", "|---|---|---|---|"]
    lines += [
        f"| {scenario.name} | {scenario.sentence} | {scenario.right_to_say} | {scenario.wrong_to_say} |"
        for scenario in score.scenarios
    ]
    for scenario in score.scenarios:
        lines += [""] * bool(scenario.reasons)
        lines += [
            f"- {why}: {', '.join(f'{verdict} {count}' for verdict, count in counts.items())}"
            for why, counts in scenario.reasons.items()
        ]
    return "\n".join(lines) + "\n"


def _table(columns: Sequence[Column], rows: Sequence[ScenarioScore]) -> list[str]:
    lines = [f"| scenario | {' | '.join(name for name, _ in columns)} |", "|---" * (len(columns) + 1) + "|"]
    return lines + [f"| {row.name} | {' | '.join(cell(row) for _, cell in columns)} |" for row in rows]


def _marked(word: str) -> str:
    return f"**{word}**" if word in (NOT_HELD, TOO_FEW) else word


def _rows(score: ScenariosScore) -> list[ScenarioScore]:
    return [*score.scenarios, score.total]
