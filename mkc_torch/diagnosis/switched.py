"""Whether a step comes and goes, as what is switched does."""

from __future__ import annotations

from mkc_torch.diagnosis.result import Finding

__all__ = ["comes_and_goes"]

_FEWEST, _COVERED = 3, 0.5
"""Intervals, and the share of the time from the onset to the last of them, that the gain of a lasting step covers."""


def comes_and_goes(finding: Finding) -> bool:
    """Whether most of a step's gain lies in separate intervals with nothing between them: something goes on and off.

    Example:
        >>> from dataclasses import replace
        >>> step = Finding("hard_iron_step", (), (), (), 6.2, "", "", (), 0.01, None, "", (), True, "")
        >>> lasting = replace(step, intervals=((6.2, 20.0), (21.0, 40.0)))
        >>> switched = replace(step, intervals=((10.0, 12.0), (34.0, 37.3), (60.0, 62.0)))
        >>> comes_and_goes(lasting), comes_and_goes(switched)
        (False, True)
    """
    if finding.onset is None or finding.moments or len(finding.intervals) < _FEWEST:
        return False
    covered = sum(end - start for start, end in finding.intervals)
    return covered < _COVERED * (finding.intervals[-1][1] - finding.onset)
