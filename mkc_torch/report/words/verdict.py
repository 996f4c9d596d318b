"""The headline of a calibration, for the terminal and the page: the result, its doubts and its disturbances."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch.calibration.offset_change import OffsetChange
from mkc_torch.calibration.quality import LONG_SECONDS, Doubt, disturbances, doubts
from mkc_torch.calibration.result import Calibration
from mkc_torch.recording.disturbance import RejectedInterval
from mkc_torch.report.words.numbers import change, share, size, when


def calibration_verdict(calibration: Calibration) -> str:
    """Return the headline: doubtful with its reasons, or calibrated; then the disturbed intervals."""
    c, reasons = calibration, doubts(calibration)
    if reasons:
        first = f"Doubtful: {'; '.join(_reason(doubt, c) for doubt in reasons)}."
    else:
        first = "Calibrated, but read the warnings." if is_doubtful(c) else "Calibrated."
    long = disturbances(c)
    text = disturbed(long, c.disturbed_unit)
    if len(long) < len(c.disturbed):  # the text below the headline counts the shorter intervals too
        text = text.replace(" intervals, ", f" intervals of at least {LONG_SECONDS:g} s, ")
    return " ".join(filter(None, [first, text]))


def result_in_a_word(calibration: Calibration) -> str:
    """Return "calibrated", "doubtful" or "read the warnings", for a table of several sensors."""
    if doubts(calibration):
        return "doubtful"
    return "read the warnings" if is_doubtful(calibration) else "calibrated"


def is_doubtful(calibration: Calibration) -> bool:
    """Return whether a warning or a doubt questions the result, and not only the file."""
    c = calibration
    of_file = () if c.used is None else c.used.warnings
    return bool(doubts(c)) or any(warning not in of_file for warning in c.warnings)


def disturbed(intervals: Sequence[RejectedInterval], unit: str = "s") -> str:
    """Return a sentence on the disturbed intervals; empty if there are none.

    Example:
        >>> disturbed([RejectedInterval(48.8, 51.8)])
        'Disturbed between 48.8 s and 51.8 s: most samples were rejected there.'
    """
    return f"Disturbed {when(intervals, unit)}: most samples were rejected there." if intervals else ""


def _reason(doubt: Doubt, calibration: Calibration) -> str:
    c = calibration
    if doubt == "not_better":
        return f"the field's length scatters no less than before ({change(c.before, c.after, c.unit)})"
    if doubt == "offset_changed" and c.offset_change is not None:
        return offset_changed(c.offset_change, c.unit, c.disturbed_unit)
    return f"{share(c.rejected_share)} of the samples were rejected"


def offset_changed(change: OffsetChange, unit: str, unit_of_place: str = "s") -> str:
    """Return the part of a sentence on a change of the offset.

    Example:
        >>> offset_changed(OffsetChange("step", 9.4, 30.0, 0.0015), "µT")
        'the offset changed by about 9.40 µT at 30 s (p = 0.0015)'
    """
    at = "" if change.at is None else f" at row {change.at:.0f}" if unit_of_place == "row" else f" at {change.at:.3g} s"
    verb = {"drift": "drifted", "rotation": "rotated"}.get(change.kind, "changed")
    return f"the offset {verb} by about {size(change.size)} {unit}{at} (p = {change.p_value:.2g})"
