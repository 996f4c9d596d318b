"""Statements of a report that exclude each other: ``PAIRS`` of texts, and ``RULES`` on the numbers."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from html.parser import HTMLParser
from typing import Literal

import torch
from rich.console import Console

from mkc_torch.cli.diagnosis_summary import show
from mkc_torch.diagnosis.result import Diagnosis, Finding
from mkc_torch.diagnosis.vetoes import is_zero_within_error, transfers, worth_correcting
from mkc_torch.report.diagnosis.page import diagnosis_report
from mkc_torch.report.diagnosis.summary import summary
from mkc_torch.report.diagnosis.unseen import better
from mkc_torch.report.diagnosis.verdict import headline, to_do, warned

Where = Literal["row", "finding", "report"]

REASON = (
    "varies between blocks|in the tail of the residual|open-loop residual is (?:larger|smaller) there"
    "|open-loop simulation diverges"
)
"""Why likelihood and residual disagree."""

CLAIM = r"[Ll]eft out of the simulation"
DISTURBANCE = r"Process noise (?:acts |remains )?on the rate|in addition to (?:its white|the sensor's) noise"


@dataclass(frozen=True)
class Pair:
    """Two patterns that may not both be in a row, in the text on a finding, or in a report, unless a third is there."""

    first: str
    second: str
    where: Where
    unless: str = ""


PAIRS = (
    # held-out blocks
    Pair("surely better", "no change", "row", r"\d % less"),
    Pair("surely better", r"\d % more", "row", r"\d % less"),
    Pair("surely better", "[Nn]ot confirmed", "finding"),
    Pair("surely better", "open-loop residual is larger", "row"),
    Pair("[Nn]ot confirmed on", r"\b([5-9]|\d\d) % less", "finding", REASON),
    Pair("not shown to be better", r"\b([5-9]|\d\d) % less", "row", REASON),
    Pair("(?<!surely )worse on held-out", r"\b([5-9]|\d\d) % less", "row", REASON),
    Pair("worse on held-out", CLAIM, "finding"),
    Pair("do not reject it", "[Nn]ot confirmed", "finding"),
    # two sizes of the same name: of an output, robust, and of the fit's samples
    Pair(r"held-out blocks rms of the residual", r"→.*\), noise floor", "report"),
    # what is missing
    Pair("[Nn]o missing physics", CLAIM, "report"),
    Pair("[Nn]o missing physics", "[Nn]earest in the catalogue", "report"),
    Pair("[Nn]o missing physics", "[Nn]ot confirmed|[Rr]eal, but small", "report", "worth correcting"),
    Pair("[Nn]o missing physics", DISTURBANCE, "report"),
    Pair(
        "[Nn]o missing physics",
        "[Ss]tructure remains|has structure|smooth trend along|does not fit|unnamed structure",
        "report",
    ),
    Pair("no physics in the catalogue explains it", CLAIM, "report"),
    Pair("No physics is significant", CLAIM, "report"),
    Pair("The strongest candidate is significant", r"named +nothing confirmed", "report"),
    Pair(r"named\W+nothing\b(?! confirmed)", f"{CLAIM}|[Nn]earest in the catalogue", "report"),
    Pair(
        r"unexplained\W+nothing\b",
        f"{DISTURBANCE}|[Ss]tructure remains|has structure|smooth trend along",
        "report",
        "explained",
    ),
    # what is left
    Pair("The residual is the sensor's noise", DISTURBANCE, "report"),
    Pair(
        "The residual is the sensor's noise",
        "[Ss]tructure remains|has structure|smooth trend along|Look for the cause of the disturbance",
        "report",
    ),
    Pair(r"(?<!not )\bwhite\b", "is not white", "row"),
    Pair(r"correlation time \S+ s", r"is white\.", "row"),
    # what to do
    Pair("The simulation can be used", f"{CLAIM}|{DISTURBANCE}|[Nn]earest in the catalogue", "report"),
    Pair(
        "The simulation can be used",
        "does not fit|[Ss]tructure remains|has structure|smooth trend along|Do not rely",
        "report",
    ),
    Pair("The simulation can be used", "The model found here corrects|mkc apply", "report"),
    Pair("Do not rely on this simulation", f"{CLAIM}|mkc apply|The simulation can be used", "report"),
    Pair("does not fit the recording", f"{CLAIM}|[Nn]earest in the catalogue|mkc apply", "report"),
    # where
    Pair("throughout the recording", r"mainly (from|in)|everywhere|first at|from \S+ s on", "row"),
    Pair("everywhere", r"mainly (from|in)", "finding"),
    # how sure
    Pair(CLAIM, r"size is 0 within its standard error", "finding"),
)

Rule = Callable[[Diagnosis], bool]


def _claims(d: Diagnosis) -> list[Finding]:
    return [f for f in d.findings if f.grade in ("left_out", "small")]


def _moments(f: Finding) -> list[float]:
    onset = [] if f.onset is None else [f.onset]
    return [*onset, *(f.onset_interval or ()), *f.event_times, *(moment for pair in f.intervals for moment in pair)]


def _outside(d: Diagnosis) -> bool:
    known = d.traces.time[d.traces.time.isfinite()]
    low, high = float(known.min()), float(known.max())
    edge = 1e-9 * max(abs(low), abs(high))
    return any(not low - edge <= moment <= high + edge for f in d.findings for moment in _moments(f))


def _advised(d: Diagnosis, start: str) -> list[str]:
    return [sentence for sentence in d.advice if sentence.startswith(start)]


def _claimed_and_refused(d: Diagnosis) -> bool:
    """Whether the advice is both to correct and not to correct for an effect."""
    use = " ".join(_advised(d, "The model found here corrects for")).partition(":")[0]
    corrected = set(re.split(" and | for ", use)[1:])
    refused = [re.sub(r"(Do not correct for|Do not add) (.*?)( yet| to the simulation|, unless|: ).*", r"\2", item)
               for start in ("Do not correct", "Do not add") for item in _advised(d, start)]  # fmt: skip
    return bool(corrected.intersection(refused))


def _two_residuals(d: Diagnosis) -> bool:
    """Whether the held-out table and the first finding have different residuals of the baseline."""
    held = d.findings[0].held_out if d.findings else None
    if held is None or held.outputs or len(d.traces.channels) > 1 or not math.isfinite(d.baseline.rmse):
        return False
    return not math.isclose(held.rmse_before, d.baseline.rmse, rel_tol=1e-6)


def _worded(d: Diagnosis) -> Iterator[tuple[str, float, float]]:
    """Yield what is stated on held-out blocks, with the 95 % interval of the gain."""
    return ((better(f.held_out), *f.held_out.confidence_interval) for f in d.findings if f.held_out is not None)


RULES: dict[str, Rule] = {
    "surely better although the interval of the gain has 0 in it": lambda d: any(
        text.startswith("surely") and low <= 0.0 for text, low, _ in _worded(d)
    ),
    "not rejected without a reason although the gain is below 0": lambda d: any(
        "do not reject it" in text and high < 0.0 and not re.search(REASON, text) for text, _, high in _worded(d)
    ),
    "a gain that varies by more than its mean although its interval has no 0 in it": lambda d: any(
        "varies between blocks" in text and not low <= 0.0 <= high for text, low, high in _worded(d)
    ),
    "an interval or onset outside of the recording": _outside,
    "an interval that ends before it begins": lambda d: any(a > b for f in d.findings for a, b in f.intervals),
    "a claim whose size is 0 within its error": lambda d: any(is_zero_within_error(f) for f in _claims(d)),
    "a claim above the level": lambda d: any(f.p_value > d.level for f in _claims(d)),
    "a claim that is worse in open loop": lambda d: any(
        f.held_out is not None
        and not f.held_out.decides
        and f.held_out.rmse_after > 1.05 * f.held_out.rmse_before
        and not f.held_out.outputs
        for f in _claims(d)
    ),
    "left out, and of another shape": lambda d: any(
        f.shape is not None and f.shape.curve is not None for f in _claims(d)
    ),
    "adequate with a finding": lambda d: d.verdict == "adequate" and bool(d.findings),
    "adequate with process noise": lambda d: d.verdict == "adequate" and bool(d.environment.process_noise),
    "adequate with an estimated disturbance": lambda d: d.verdict == "adequate" and bool(d.environment.disturbance),
    "adequate with a remaining trend": lambda d: d.verdict == "adequate" and bool(d.remaining),
    "adequate with a warning of a disturbance": lambda d: (
        d.verdict == "adequate"
        and any(
            re.search("acts on the rate|is driven|disturbs|smooth trend along|more structure", w) for w in d.warnings
        )
    ),
    "explained without a claim": lambda d: d.verdict == "explained" and not _claims(d),
    "explained with an unconfirmed finding": lambda d: d.verdict == "explained" and len(_claims(d)) < len(d.findings),
    "explained with process noise of a rate": lambda d: (
        d.verdict == "explained" and any(p.at_rate for p in d.environment.process_noise)
    ),
    "unfit with a finding": lambda d: d.verdict == "unfit" and bool(d.findings),
    "unfit although every output is explained": lambda d: (
        d.verdict == "unfit"
        and bool(d.environment.goodness_of_fit)
        and all(fit.explained > 0.9 for fit in d.environment.goodness_of_fit)
    ),
    "reasons for a poor fit although the fit is good": lambda d: d.verdict != "unfit" and bool(d.environment.reasons),
    "to be corrected and not to be": _claimed_and_refused,
    "a model to apply without a transferable finding": lambda d: (
        bool(_advised(d, "The model found here")) and not any(transfers(f) for f in d.findings)
    ),
    "not plausible, and to be corrected": lambda d: any(transfers(f) and not f.plausible for f in d.findings),
    "a finding among its own alternatives": lambda d: any(
        (a.effect, a.drivers, a.port) == (f.effect, f.drivers, "") for f in d.findings for a in f.alternatives
    ),
    "two residuals of the simulation without findings": _two_residuals,
    "shares of runs that do not sum to 1": lambda d: any(
        f.experiments and not math.isclose(sum(f.experiments), 1.0, abs_tol=0.02) for f in d.findings
    ),
    "adequate with a residual far above the noise floor": lambda d: (
        d.verdict == "adequate" and any(fit.residual > 3.0 * fit.noise_floor for fit in d.environment.goodness_of_fit)
    ),
    "worth correcting in an unfit simulation": lambda d: (
        d.verdict == "unfit" and any(map(worth_correcting, d.findings))
    ),
    "numbers of the gain outside of their own interval": lambda d: any(
        f.held_out is not None
        and torch.isfinite(torch.tensor(f.held_out.confidence_interval)).all()
        and not f.held_out.confidence_interval[0] <= f.held_out.log_likelihood_gain <= f.held_out.confidence_interval[1]
        for f in d.findings
    ),
}


def contradictions(diagnosis: Diagnosis, *, page: bool = True) -> list[str]:
    """Return the contradictions in a diagnosis, its summary on the terminal, and its page.

    Args:
        diagnosis: the result.
        page: with the whole page, whose pictures take a second; else with the box at its top.
    """
    sentences = [f"by its numbers: {name}" for name, broken in RULES.items() if broken(diagnosis)]
    texts = {"terminal": terminal_rows(diagnosis), "box": box_rows(diagnosis)}
    if page:
        texts["page"] = page_rows(diagnosis_report(diagnosis))
    for place, rows in texts.items():
        sentences += [f"{place}: {found}" for found in _in_text(rows, diagnosis)]
    return sentences


def _in_text(rows: Sequence[str], d: Diagnosis) -> Iterator[str]:
    alone = len(d.findings) == 1
    for pair in PAIRS:
        if pair.where == "row":
            parts = list(rows)
        elif pair.where == "finding":
            parts = ["\n".join(rows)] if alone else _sections(rows)
        else:
            parts = ["\n".join(rows)]
        for part in parts:
            first, second = re.search(pair.first, part), re.search(pair.second, part)
            if first and second and not (pair.unless and re.search(pair.unless, part)):
                yield f"{first[0]!r} and {second[0]!r} in one {pair.where}: {part[:400]}"


def _sections(rows: Sequence[str]) -> list[str]:
    """Return the text on each of several findings, which starts with a number."""
    end = next((k for k, row in enumerate(rows) if re.match("[Tt]ogether", row)), None)
    rows = [*rows[:end], *([] if end is None else rows[end + 1 :])]
    begins = [k for k, row in enumerate(rows) if re.match(r"\d+( ·|  )", row)]
    return ["\n".join(rows[a:b]) for a, b in zip(begins, [*begins[1:], len(rows)], strict=False)]


def terminal_rows(diagnosis: Diagnosis) -> list[str]:
    """Return the summary on a wide terminal, a row per label with its continuation lines."""
    out = io.StringIO()
    show(Console(file=out, width=4000, color_system=None), diagnosis, [])
    rows: list[str] = []
    for line in out.getvalue().splitlines():
        if line.startswith(" ") and rows:
            rows[-1] += f"; {line.strip()}"
        elif line.strip():
            rows.append(line.rstrip())
    return rows


def box_rows(diagnosis: Diagnosis) -> list[str]:
    """Return the rows of the box at the top of a page, of the advice and of the warnings."""
    rows = [headline(diagnosis), *(f"{question} {' '.join(lines)}" for question, lines in summary(diagnosis))]
    return [row.replace("`", "") for row in [*rows, *to_do(diagnosis), *warned(diagnosis)]]


class _Rows(HTMLParser):
    """Rows of tables, paragraphs and headings, without styles and pictures."""

    ENDS = frozenset(("tr", "p", "li", "h1", "h2", "h3", "figcaption", "summary", "pre", "footer"))
    SKIPPED = frozenset(("style", "svg", "script", "title"))

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[str] = [""]
        self.inside = 0

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        self.inside += tag in self.SKIPPED
        self.rows[-1] += " "

    def handle_endtag(self, tag: str) -> None:
        self.inside -= tag in self.SKIPPED
        self.rows[-1] += " "
        if tag in self.ENDS:
            self.rows.append("")

    def handle_data(self, data: str) -> None:
        if not self.inside:
            self.rows[-1] += data


def page_rows(page: str) -> list[str]:
    """Return the text of a page, one item per table row, paragraph or heading."""
    parser = _Rows()
    parser.feed(page)
    return [text for row in parser.rows if (text := " ".join(row.replace("\u00a0", " ").split()))]
