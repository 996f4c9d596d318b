"""Thresholds of the proof. Set before the first scored run."""

from __future__ import annotations

from dataclasses import dataclass

INSEPARABLE_BELOW = 6.0
"""A rival below this z_sep counts as a right name: it is "rightly inseparable"."""


@dataclass(frozen=True)
class Threshold:
    """The accepted range of a measure, and its sentence for reports."""

    measure: str
    low: float
    high: float
    sentence: str

    def holds(self, value: float) -> bool:
        """Whether the value is in the range; False for NaN."""
        return self.low <= value <= self.high


LEVEL = 0.05
"""Accepted rate of false alarms in a diagnosis."""

STRONG_Z = 10.0
"""Effects whose z and z_sep are at least this have to be named."""

COVERAGE_FACTOR = 1.6448536269514722
"""Half-width of a 90 % interval in standard errors."""

THRESHOLDS = (
    Threshold("empty_cases", 400, float("inf"), "Empty recordings, at least 400 at level 0.05"),
    Threshold("false_alarms", 0.0, 0.07, "at most 7 % false alarms"),
    Threshold("p_uniform", 0.01, 1.0, "p-values of empty recordings uniform: Kolmogorov-Smirnov p at least 0.01"),
    Threshold("strong_cases", 150, float("inf"), "z and z_sep at least 10, at least 150 recordings"),
    Threshold("named_right", 0.95, 1.0, "named right in at least 95 %"),
    Threshold("driver_right", 0.95, 1.0, "driver right or rightly inseparable in at least 95 %"),
    Threshold("separable_share", 0.90, 1.0, "separable in at least 90 % of the cases with z_sep of at least 6"),
    Threshold("candidates_named", 1.0, 1.5, "at most 1.5 candidates named on average"),
    Threshold("step_within", 0.95, 1.0, "step within 1 s (of at least 95 % of the named ones)"),
    Threshold("coverage", 0.85, 0.95, "90 % intervals cover 85-95 %"),
    Threshold("second_ratio", 0.0, 1.05, "corrected second recording at most 1.05 of the oracle's residual (median)"),
)
