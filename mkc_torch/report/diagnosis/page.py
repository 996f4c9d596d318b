"""The diagnosis report as a self-contained HTML page."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from markupsafe import Markup

from mkc_torch._parallel.pool import shared
from mkc_torch._support.typesetting import several, typeset
from mkc_torch.diagnosis.plot.drawings import CURVE_COLORS
from mkc_torch.diagnosis.result import CandidateScore, Diagnosis, Separability
from mkc_torch.report.diagnosis import (
    before_search,
    decisions,
    environment,
    evidence,
    findings,
    first_picture,
    forcing_pictures,
    noise,
    numbers,
    pictures,
    summary,
    unseen,
    untested,
    verdict,
)
from mkc_torch.report.drawing import themed
from mkc_torch.report.rendering import render
from mkc_torch.report.words.markup import marked, unbroken

_MOST_SHOWN = 12
_MOST_FORCINGS = 3
_FAINT, _CLEAR = (244, 196, 160), (214, 232, 244)  # inseparable, orthogonal


class Bar(NamedTuple):
    """A candidate with its rank and the length of its bar in per cent."""

    rank: int
    candidate: CandidateScore
    percent: float


class Cell(NamedTuple):
    """A cell of the heat map: its text and its colour."""

    text: str
    color: str


def diagnosis_report(
    diagnosis: Diagnosis, *, note: str = "", paths: verdict.RunPaths | None = None, changes: str = ""
) -> str:
    """Return the page of a diagnosis.

    Args:
        diagnosis: what was found.
        note: a sentence for the top of the page, for example that the data are simulated.
        paths: paths of the run, for the proposed command.
        changes: what the corrected file of a model changes, as a unified diff; empty to leave it out.

    Returns:
        HTML with inline figures.
    """
    d = diagnosis
    shown = d.traces.courses is not None and len(d.traces.time) > 0
    count, driven = len(d.findings), min(len(d.environment.disturbance), _MOST_FORCINGS)
    works: list[Callable[[], str | None]] = [
        lambda: first_picture.of_outputs(d) if shown else None,
        lambda: pictures.over_time(d) if len(d.traces.time) else None,
        *(partial(pictures.of_finding, d, i) for i in range(count)),
        *(partial(pictures.over_states, d, i) for i in range(count)),
        *(partial(forcing_pictures.of_shape, d, i) for i in range(count)),
        *(partial(forcing_pictures.of_forcing, d, i) for i in range(driven)),
    ]
    outputs_figure, time_figure, *drawn = (None if svg is None else Markup(svg) for svg in shared(works))
    page = render(
        "diagnosis.html.j2",
        d=d,
        note=note,
        paths=paths,
        changes=changes,
        say=findings,
        evidence=evidence,
        decided=decisions,
        numbers=numbers,
        noise=noise,
        top=verdict,
        lead=summary.summary(d),
        unseen=unseen,
        before_search=before_search,
        environment=environment,
        untested=untested,
        several=several,
        typeset=typeset,
        marked=marked,
        notes=noise.channel_notes(d.traces.channels),
        numbered=pictures.numbered(d),
        clock=numbers.clock_of(d.traces),
        first=first_picture,
        corrected=first_picture.is_corrected(d),
        outputs_figure=outputs_figure,
        time_figure=time_figure,
        figures=drawn[:count],
        maps=drawn[count : 2 * count],
        shapes=drawn[2 * count : 3 * count],
        forced=drawn[3 * count :],
        forced_titles=forcing_pictures.titles(d.environment.disturbance),
        floors=pictures.floors(d),
        panels=[pictures.driver_panels(d, i) for i in range(len(d.findings))],
        curve_colors=[themed(color) for color in CURVE_COLORS],
        bars=bars(d.candidates),
        heat=heat_map(d.separability),
        most=_MOST_SHOWN,
    )
    return unbroken(page)


def bars(candidates: tuple[CandidateScore, ...]) -> list[Bar]:
    """Return the best candidates in the order of the search, with bars in proportion to their gain."""
    shown = candidates[:_MOST_SHOWN]
    best = max((c.log_likelihood_gain for c in shown), default=0.0)
    return [
        Bar(i, c, 100.0 * max(c.log_likelihood_gain, 0.0) / best if best > 0 else 0.0) for i, c in enumerate(shown, 1)
    ]


def heat_map(separability: Separability) -> list[list[Cell]]:
    """Return one row per candidate: its share after the refit, then after each other candidate."""
    s = separability
    shown = min(len(s.labels), _MOST_SHOWN)
    rows = []
    for i in range(shown):
        others = [Cell("·", "transparent") if i == j else _cell(float(s.share[i, j])) for j in range(shown)]
        rows.append([_cell(float(s.left[i])), *others])
    return rows


def _cell(share: float) -> Cell:
    if not math.isfinite(share):
        return Cell("–", "transparent")
    part = min(max(share, 0.0), 1.0)
    color = "#" + "".join(f"{round(a + part * (b - a)):02x}" for a, b in zip(_FAINT, _CLEAR, strict=True))
    return Cell(f"{part:.2f}", color)
