"""The result of the proof: an HTML page with pictures, and a summary in Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mkc_torch.challenge.binomial import Share
from mkc_torch.challenge.key import Key
from mkc_torch.challenge.score import MeasuredThreshold, Score
from mkc_torch.challenge.verdict import ADEQUATE, UNEXPLAINED, UNFIT

_TEMPLATES = Path(__file__).parent / "templates"
_SHARED = Path(__file__).parents[1] / "report" / "templates"


def challenge_page(
    score: Score, baselines: Mapping[str, Score], keys: Sequence[Key], settings: Mapping[str, Any]
) -> str:
    """Return the HTML page. Needs the ``cli`` extra.

    Args:
        score: score of the diagnosis.
        baselines: scores of the methods it is compared with, by name.
        keys: keys of all cases.
        settings: settings of the run.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined, select_autoescape
    from markupsafe import Markup

    from mkc_torch.challenge import pictures

    environment = Environment(
        loader=FileSystemLoader([_TEMPLATES, _SHARED]),
        autoescape=select_autoescape(["html", "html.j2"]),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(share=share_text, number=number_text, measured=measured_text)
    return environment.get_template("challenge.html.j2").render(
        score=score,
        passed=sum(m.holds for m in score.measured),
        baselines=baselines,
        settings=settings,
        effects=hidden_table(keys),
        rows=comparison(score, baselines),
        figures={
            "power": Markup(pictures.power_curves(score, baselines)),
            "p_values": Markup(pictures.p_values(score)),
            "confusion": Markup(pictures.confusion(score)),
        },
    )


def summary(score: Score, baselines: Mapping[str, Score], settings: Mapping[str, Any]) -> str:
    """Return the numbers in Markdown."""
    lines = ["# The blind proof", "", *(f"- {name}: {value}" for name, value in settings.items()), ""]
    lines += ["| threshold | measured | holds |", "|---|---|---|"]
    lines += [
        f"| {m.threshold.sentence} | {measured_text(m)} | {'yes' if m.holds else '**no**'} |" for m in score.measured
    ]
    names = ["diagnosis", *baselines]
    lines += ["", f"| | {' | '.join(names)} |", "|---" * (len(names) + 1) + "|"]
    lines += [f"| {label} | {' | '.join(cells)} |" for label, cells in comparison(score, baselines)]
    lines += ["", "| hidden | named first |", "|---|---|"]
    for hidden, row in score.confusion.items():
        counts = ", ".join(f"{name} {count}" for name, count in sorted(row.items(), key=lambda item: -item[1]))
        lines.append(f"| {hidden} | {counts} |")
    return "\n".join(lines) + "\n"


def comparison(score: Score, baselines: Mapping[str, Score]) -> list[tuple[str, list[str]]]:
    """Return the rows that compare the diagnosis with the baselines; a row without recordings is left out."""
    scores = [score, *baselines.values()]
    shares: Sequence[tuple[str, Callable[[Score], Share]]] = (
        ("false alarms on empty recordings", lambda s: s.false_alarms),
        ("named right, z and z_sep ≥ 10", lambda s: s.named),
        ("driver right", lambda s: s.driver),
        ("located right", lambda s: s.located),
        ("named right with the driver withheld", lambda s: s.withheld_named),
        ("more findings than effects", lambda s: s.extra),
    )
    rows = [(label, [share_text(of(s)) for s in scores]) for label, of in shares if any(of(s).total for s in scores)]
    if sum(score.doubles.values()):
        rows.append(("both of two named", [f"{s.doubles[2]} of {sum(s.doubles.values())}" for s in scores]))
    verdicts = [
        (f"empty recordings: {verdict}", [str(s.verdicts[verdict]) for s in scores])
        for verdict in (ADEQUATE, UNEXPLAINED, UNFIT)
    ]
    return [*rows, *verdicts, ("failed", [str(len(s.failed)) for s in scores])]


def hidden_table(keys: Sequence[Key]) -> list[dict[str, Any]]:
    """Return for each effect how often it was hidden, and how detectable it was."""
    found: dict[str, list[tuple[float, float]]] = {}
    for key in keys:
        for effect in key.effects:
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
    return "not measured" if math.isnan(value) else f"{value:.4g}"


def measured_text(measured: MeasuredThreshold) -> str:
    """Return a measured value, in per cent if the threshold is in per cent.

    Example:
        >>> from mkc_torch.challenge.thresholds import THRESHOLDS
        >>> (
        ...     measured_text(MeasuredThreshold(THRESHOLDS[1], 0.0625)),
        ...     measured_text(MeasuredThreshold(THRESHOLDS[-1], 1.007)),
        ... )
        ('6.2 %', '1.007')
    """
    value = measured.value
    asked_in_per_cent = "%" in measured.threshold.sentence and math.isfinite(value)
    return f"{100.0 * value:.1f} %" if asked_in_per_cent else number_text(value)


def _median(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2]
