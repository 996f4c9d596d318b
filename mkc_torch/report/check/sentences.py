"""Sentences on a check, for the terminal and the page."""

from __future__ import annotations

import math

from mkc_torch._support.typesetting import plain
from mkc_torch.diagnosis.validation.blocks import Ratio
from mkc_torch.diagnosis.validation.result import RecordingCheck
from mkc_torch.report.words.numbers import size


def headline(check: RecordingCheck) -> str:
    """Return the verdict as a sentence."""
    name = plain(check.simulation)
    if check.used_in_fit:
        return "This recording was used in the fit."
    subject = f"The findings in {name}" if check.findings else f"{name}"
    if check.holds:
        return f"{subject} hold on this recording." if check.findings else f"{subject} holds on this recording."
    return f"{subject} do not hold on this recording." if check.findings else f"{subject} does not hold."


def how(check: RecordingCheck) -> str:
    """Return what was estimated and what was predicted."""
    if check.start_seconds is None:
        return f"all {check.samples:,} samples are predicted; the model has no initial states"
    each = "run"
    if check.segment_seconds is not None:
        each = f"segment of {check.segment_seconds:.4g} s, in which the model was fitted too"
    return (
        f"initial states from the first {check.start_seconds:.3g} s of each {each}; the other {check.predicted:,} of "
        f"{check.samples:,} samples are predicted"
    )


def ratio(value: Ratio) -> str:
    """Return a ratio with its interval.

    Example:
        >>> ratio(Ratio(0.349, 0.283, 0.431)), ratio(Ratio(0.5, math.nan, math.nan))
        ('0.35 (0.28 to 0.43)', '0.50')
    """
    if math.isnan(value.value):
        return "—"
    if math.isnan(value.low):
        return f"{value.value:.2f}"
    return f"{value.value:.2f} ({value.low:.2f} to {value.high:.2f})"


def rmse(value: float, unit: str = "") -> str:
    """Return a root mean square with its unit.

    Example:
        >>> rmse(0.0123, "rad"), rmse(math.nan, "rad")
        ('0.0123 rad', '—')
    """
    return f"{size(value)} {plain(unit)}".rstrip() if math.isfinite(value) else "—"
