"""The strongest candidates of a recording that is too short for a test, for the page and the terminal."""

from __future__ import annotations

from mkc_torch._support.typesetting import typeset
from mkc_torch.diagnosis.result import CandidateScore, Diagnosis
from mkc_torch.report.diagnosis.evidence import Table
from mkc_torch.report.diagnosis.findings import with_drivers
from mkc_torch.report.words.numbers import size

_MOST = 3
"""Number of candidates."""


def strongest(diagnosis: Diagnosis) -> list[CandidateScore]:
    """Return the best candidates, each effect once per place; none where candidates are tested."""
    found: dict[tuple[str, str], CandidateScore] = {}
    if diagnosis.too_few:
        for candidate in diagnosis.candidates:
            found.setdefault((candidate.effect, candidate.port), candidate)
    return list(found.values())[:_MOST]


def candidate_line(candidate: CandidateScore) -> str:
    """Format a candidate with its gain.

    Example:
        >>> candidate_line(CandidateScore("linear_drag", (), "", 4.46, 3.0, "rate of speed", 0.0))
        'linear drag on the rate of speed: gain 4.46, not tested'
    """
    name = with_drivers(candidate.effect, candidate.drivers, candidate.port)
    return f"{name}: gain {size(candidate.log_likelihood_gain)}, not tested"


def untested_table(diagnosis: Diagnosis) -> Table | None:
    """Return the strongest candidates; None where candidates are tested."""
    rows = tuple(
        (
            with_drivers(candidate.effect, candidate.drivers, candidate.port),
            typeset(candidate.shape),
            f"+{size(candidate.log_likelihood_gain)}",
        )
        for candidate in strongest(diagnosis)
    )
    note = "Gains are log-likelihoods of the linearised model; with so few samples, noise alone may gain as much."
    return Table("Strongest candidates, not tested", ("candidate", "shape", "gain, nats"), rows, note) if rows else None
