"""The order of a calibration's warnings, by their weight."""

from __future__ import annotations

from collections.abc import Sequence

from mkc_torch.calibration.clipped_samples import CLIPPED
from mkc_torch.calibration.frozen_samples import FROZEN

NOT_COVERED = "Directions not covered"
"""Beginning of the warning about missing directions, which clipped samples may have caused."""


def by_weight(warnings: Sequence[str]) -> tuple[str, ...]:
    """Sort warnings: first faults of the sensor, clipped then frozen samples; missing directions after all others.

    Example:
        >>> by_weight(["Directions not covered: +z.", "Few samples.", "Left out 3 of 9 samples of a frozen sensor."])
        ('Left out 3 of 9 samples of a frozen sensor.', 'Few samples.', 'Directions not covered: +z.')
    """
    return tuple(sorted(warnings, key=_rank))


def is_fault(warning: str) -> bool:
    """Whether a warning is on clipped or frozen samples."""
    return CLIPPED in warning or FROZEN in warning


def _rank(warning: str) -> int:
    if CLIPPED in warning:
        return 0
    if FROZEN in warning:
        return 1
    return 3 if warning.startswith(NOT_COVERED) else 2
