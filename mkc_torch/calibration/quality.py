"""Doubts about a calibration that must be looked at before use, and the disturbances of its recording."""

from __future__ import annotations

from typing import Literal

from mkc_torch.calibration.places import ROWS_A_SECOND
from mkc_torch.calibration.result import Calibration
from mkc_torch.recording.disturbance import RejectedInterval

Doubt = Literal["not_better", "much_rejected", "offset_changed"]
"""``not_better``: the corrected field's length scatters no less than the measured length.
``much_rejected``: a third or more of the samples were rejected.
``offset_changed``: the sensor's offset changed during the recording.
"""

MUCH_REJECTED = 1.0 / 3.0
"""Share of rejected samples from which a calibration is doubtful."""

LONG_SECONDS = 0.5
"""Shortest interval of rejected samples that is a disturbance, in s."""


def doubts(calibration: Calibration) -> tuple[Doubt, ...]:
    """Return the reasons for which a calibration must be looked at before it is used; empty for a usable one.

    Example:
        >>> from mkc_torch.calibration.calibrate import calibrate
        >>> from mkc_torch.recording.demonstration import simulated_recording
        >>> doubts(calibrate(simulated_recording()[0]))
        ()
    """
    found: list[Doubt] = []
    if calibration.after.robust >= calibration.before.robust > 0.0:
        found.append("not_better")
    if calibration.rejected_share >= MUCH_REJECTED:
        found.append("much_rejected")
    if calibration.offset_change is not None:
        found.append("offset_changed")
    return tuple(found)


def disturbances(calibration: Calibration) -> tuple[RejectedInterval, ...]:
    """Return the intervals of rejected samples that last half a second or longer; without a time, 25 rows or more."""
    least = LONG_SECONDS * (ROWS_A_SECOND if calibration.disturbed_unit == "row" else 1.0)
    return tuple(interval for interval in calibration.disturbed if interval.end - interval.start >= least)
