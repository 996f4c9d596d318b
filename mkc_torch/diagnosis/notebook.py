"""A diagnosis as a table in a notebook: the verdict, a row per finding, and advice."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch._support.html_table import html_table
from mkc_torch._words.terms import term
from mkc_torch._words.typesetting import plain, typeset
from mkc_torch.diagnosis.environment import Verdict
from mkc_torch.diagnosis.parts import Finding
from mkc_torch.diagnosis.stop import Stop
from mkc_torch.effects import words_of

__all__ = ["as_html"]

_VERDICTS: dict[Verdict, str] = {
    "unfit": "verdict.unfit",
    "adequate": "verdict.nothing",
    "explained": "verdict.explained",
    "unexplained": "verdict.structure",
}


def as_html(
    recording: str,
    simulation: str,
    verdict: Verdict,
    findings: Sequence[Finding],
    sentences: Sequence[str],
    *,
    stop: Stop | None = None,
) -> str:
    """Return the table with sentences below it: why the search was stopped, if it was; then advice and warnings."""
    names = term("label.against", recording=plain(recording) or term("label.recording"), simulation=plain(simulation))
    heads = ("", "grade", "p", "on unseen data")
    rows = [_row(finding) for finding in findings]
    first = term(_VERDICTS[verdict]) if stop is None else term("verdict.unfinished")
    below = [first, *(typeset(sentence) for sentence in sentences)]
    for finding in findings:
        below = [text.replace(finding.effect, words_of(finding.effect, finding.kind)) for text in below]
    return html_table(names, heads, rows, below)


def _row(f: Finding) -> tuple[str, ...]:
    drivers = f" ({', '.join(plain(name) for name in f.drivers)})" if f.drivers else ""
    held = f.held_out
    change = "" if held is None else f"{held.rmse_before:.3g} → {held.rmse_after:.3g} {plain(held.unit)}".rstrip()
    return (
        words_of(f.effect, f.kind) + drivers,
        f.grade.replace("_", " "),
        "" if f.p_value is None else f"{f.p_value:.2g}",
        change,
    )
