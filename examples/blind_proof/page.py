"""The result of a proof: an HTML page with pictures, a summary in Markdown, and the rows of both."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.blind_proof.binomial import Share
from examples.blind_proof.score import MeasuredThreshold, ProofScore, Score
from examples.blind_proof.scored_case import ScoredCase
from examples.blind_proof.statements import VERDICTS

_TEMPLATES = Path(__file__).parent / "templates"

HELD, NOT_HELD, TOO_FEW, NOT_MEASURED = "held", "not held", "too few", "not measured"

Column = tuple[str, Callable[[Score], str]]


def _share(name: str) -> Callable[[Score], str]:
    return lambda score: share_text(score.shares[name])


VERDICT_COLUMNS: Sequence[Column] = (
    ("recordings", lambda score: str(score.empty)),
    ("false alarms", _share("false_alarms")),
    *((verdict, lambda score, verdict=verdict: str(score.verdicts[verdict])) for verdict in VERDICTS),
    ("unexplained, at the right state", _share("unexplained_located")),
    ("at the right state", _share("located")),
    ("attributed to the sensor", _share("sensor_reported")),
)
"""Columns on recordings without hidden physics, and on unusable simulations."""

NAMED_COLUMNS: Sequence[Column] = (
    ("hidden", lambda score: str(score.hidden)),
    ("z, z_sep ≥ 10", lambda score: str(score.strong)),
    ("named right", _share("named")),
    ("with a disturbance", _share("named_disturbed")),
    ("without", _share("named_undisturbed")),
    ("driver right", _share("driver")),
    ("at the right port", _share("at_port")),
    ("named right with the driver withheld", _share("withheld_named")),
    ("a wrong name claimed", _share("wrong")),
    ("nearest in the catalogue", _share("nearest")),
    ("more findings than effects", _share("extra")),
    ("outside: a name claimed", _share("outside_wrong")),
    ("outside: nearest, or unknown", _share("outside_nearest")),
    ("both of two named", lambda score: f"{score.doubles[2]} of {n}" if (n := sum(score.doubles.values())) else "—"),
)
"""Columns on recordings with hidden physics."""

APART_COLUMNS: Sequence[Column] = (
    ("recordings", lambda score: str(score.empty + score.hidden)),
    ("a single wrong name", _share("alone")),
    ("undecided", _share("undecided")),
)
"""Columns on scenarios that are counted apart, with and without hidden physics."""


def proof_page(proof: ProofScore, baselines: Mapping[str, Score], settings: Mapping[str, Any]) -> str:
    """Return the HTML page. Needs the ``cli`` extra.

    Args:
        proof: the score.
        baselines: scores of the methods it is compared with, by name.
        settings: settings of the run.
    """
    from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined, select_autoescape
    from markupsafe import Markup

    from examples.blind_proof import pictures

    environment = Environment(
        loader=ChoiceLoader([FileSystemLoader(_TEMPLATES), PackageLoader("mkc_torch.report")]),
        autoescape=select_autoescape(["html", "html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(share=share_text, number=number_text, measured=measured_text, held=held)
    total = proof.total
    return environment.get_template("proof.html.j2").render(
        proof=proof,
        total=total,
        tables=tables(proof),
        compared=compared(total, baselines),
        baselines=list(baselines),
        aims=[measured for row in proof.rows for measured in row.measured if held(measured) != NOT_MEASURED],
        effects=hidden_table(proof.cases),
        settings=settings,
        verdicts=VERDICTS,
        figures={
            "power": Markup(pictures.power_curves(total, baselines)),
            "p_values": Markup(pictures.p_values(total)),
            "confusion": Markup(pictures.confusion(total)),
        },
    )


def summary(proof: ProofScore, baselines: Mapping[str, Score], settings: Mapping[str, Any]) -> str:
    """Return the numbers in Markdown."""
    lines = ["# The blind proof", "", *(f"- {name}: {value}" for name, value in settings.items())]
    for _, head, rows in tables(proof):
        lines += ["", *_markdown(head, rows)]
    aims = [
        [row.name, m.threshold.sentence, measured_text(m), _marked(held(m))] for row in proof.rows for m in row.measured
    ]
    lines += ["", *_markdown(["scenario", "aim", "measured", "holds"], aims)]
    if baselines:
        lines += ["", *_markdown(["", "diagnosis", *baselines], compared(proof.total, baselines))]
    confusion = [[hidden, ", ".join(_counted(row))] for hidden, row in proof.total.confusion.items()]
    lines += ["", *_markdown(["hidden", "named first"], confusion)]
    described = [[s.name, s.sentence, s.right, s.wrong] for row in proof.scenarios if (s := row.scenario)]
    lines += ["", *_markdown(["scenario", "description", "right", "wrong"], described)]
    for row in proof.scenarios:
        lines += [""] * bool(row.reasons)
        lines += [f"- {why}: {', '.join(_counted(verdicts))}" for why, verdicts in row.reasons.items()]
    return "\n".join(lines) + "\n"


def tables(proof: ProofScore) -> list[tuple[str, list[str], list[list[str]]]]:
    """Return the tables of shares: their kind, heads, and rows; a column or table without a value is left out."""
    hiding = [row for row in proof.rows if row.hidden]
    apart = [row for row in proof.scenarios if row.scenario and row.scenario.apart]
    kinds = (
        ("without", VERDICT_COLUMNS, list(proof.rows)),
        ("hidden", NAMED_COLUMNS, hiding),
        ("apart", APART_COLUMNS, apart),
    )
    found = []
    for kind, columns, rows in kinds:
        cells = [[row.name, *(cell(row) for _, cell in columns)] for row in rows]
        used = [k for k in range(len(columns) + 1) if any(row[k] != "—" for row in cells)]
        heads = ["scenario", *(head for head, _ in columns)]
        if rows:
            found.append((kind, [heads[k] for k in used], [[row[k] for k in used] for row in cells]))
    return found


def compared(score: Score, baselines: Mapping[str, Score]) -> list[list[str]]:
    """Return the rows that compare the diagnosis with the baselines; a row without recordings is left out."""
    scores = [score, *baselines.values()]
    rows = [[head, *(cell(one) for one in scores)] for head, cell in (*VERDICT_COLUMNS, *NAMED_COLUMNS)]
    failed = ["failed, of all", *(str(len(one.failed)) for one in scores)]
    return [*(row for row in rows if any(cell != "—" for cell in row[1:])), failed]


def facts(score: Score) -> list[tuple[str, str]]:
    """Return labels and values of a scenario for a terminal; a share without recordings is left out."""
    found = [(f"verdicts of {score.empty}", ", ".join(_counted(score.verdicts, every=True)))]
    columns = [column for column in VERDICT_COLUMNS if column[0] not in ("recordings", *VERDICTS)]
    if score.scenario is not None and score.scenario.apart:
        columns += APART_COLUMNS[1:]
    found += [(head, cell(score)) for head, cell in (*columns, *(NAMED_COLUMNS[1:] if score.hidden else ()))]
    found += [(why, ", ".join(_counted(verdicts))) for why, verdicts in score.reasons.items()]
    return [(label, value) for label, value in found if value != "—"]


def hidden_table(cases: Sequence[ScoredCase]) -> list[dict[str, Any]]:
    """Return for each effect how often it was hidden, and how detectable it was."""
    found: dict[str, list[tuple[float, float]]] = {}
    for case in cases:
        for effect in case.key.effects:
            found.setdefault(effect.effect, []).append((effect.z, effect.z_sep))
    return [
        {
            "effect": name,
            "count": len(pairs),
            "z": _median([z for z, _ in pairs]),
            "z_sep": _median([z_sep for _, z_sep in pairs]),
            "strong": sum(min(pair) >= 10.0 for pair in pairs),
        }
        for name, pairs in sorted(found.items())
    ]


def held(measured: MeasuredThreshold) -> str:
    """Return in words whether an aim holds.

    Example:
        >>> from examples.blind_proof.aims import FALSE_ALARMS
        >>> held(MeasuredThreshold(FALSE_ALARMS, 0.05)), held(MeasuredThreshold(FALSE_ALARMS, 0.2))
        ('held', 'not held')
    """
    if math.isnan(measured.value):
        return NOT_MEASURED
    if measured.holds:
        return HELD
    return TOO_FEW if math.isinf(measured.threshold.high) else NOT_HELD


def share_text(share: Share) -> str:
    """Return a share with its 95 % interval.

    Example:
        >>> share_text(Share(3, 60, 0.01, 0.139))
        '5.0 % (3 of 60; 1.0-13.9 %)'
    """
    if not share.total:
        return "—"
    interval = f"{100 * share.low:.1f}-{100 * share.high:.1f} %"
    return f"{100 * share.value:.1f} % ({share.count} of {share.total}; {interval})"


def number_text(value: float) -> str:
    return NOT_MEASURED if math.isnan(value) else f"{value:.4g}"


def measured_text(measured: MeasuredThreshold) -> str:
    """Return a measured value, in per cent if the threshold is in per cent.

    Example:
        >>> from examples.blind_proof.aims import THRESHOLDS
        >>> [measured_text(MeasuredThreshold(THRESHOLDS[k], value)) for k, value in ((1, 0.0625), (-1, 1.007))]
        ['6.2 %', '1.007']
    """
    value = measured.value
    asked_in_per_cent = "%" in measured.threshold.sentence and math.isfinite(value)
    return f"{100.0 * value:.1f} %" if asked_in_per_cent else number_text(value)


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(head)} |", "|---" * len(head) + "|", *(f"| {' | '.join(row)} |" for row in rows)]


def _marked(word: str) -> str:
    return f"**{word}**" if word in (NOT_HELD, TOO_FEW) else word


def _counted(counts: Mapping[str, int], *, every: bool = False) -> list[str]:
    """Return names with their counts, largest first; with ``every`` all, in their own order."""
    items = list(counts.items())
    if not every:
        items = sorted((item for item in items if item[1]), key=lambda item: -item[1])
    return [f"{name} {count}" for name, count in items]


def _median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2]
