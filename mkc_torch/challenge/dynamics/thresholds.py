"""Thresholds of the proof of differential equations. Set before the first scored run."""

from __future__ import annotations

from mkc_torch.challenge.thresholds import Threshold

THRESHOLDS = (
    Threshold("empty_cases", 150, float("inf"), "Empty recordings, at least 150 at level 0.05"),
    Threshold("false_alarms", 0.0, 0.08, "at most 8 % false alarms"),
    Threshold("strong_cases", 50, float("inf"), "z and z_sep at least 10, at least 50 recordings"),
    Threshold("named_right", 0.90, 1.0, "named right in at least 90 %"),
    Threshold("located_right", 0.90, 1.0, "at the right state, input or output in at least 90 %"),
    Threshold("second_ratio", 0.0, 1.1, "free run on a second recording at most 1.1 of the oracle's error (median)"),
)
