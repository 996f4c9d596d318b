"""Thresholds of the proofs, for all recordings and for each scenario. Set before the first scored run."""

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
    Threshold("strong", 150, float("inf"), "z and z_sep at least 10, at least 150 recordings"),
    Threshold("named", 0.95, 1.0, "named right in at least 95 %"),
    Threshold("driver", 0.95, 1.0, "driver right or rightly inseparable in at least 95 %"),
    Threshold("separable", 0.90, 1.0, "separable in at least 90 % of the cases with z_sep of at least 6"),
    Threshold("candidates", 1.0, 1.5, "at most 1.5 candidates named on average"),
    Threshold("onsets_near", 0.95, 1.0, "step within 1 s (of at least 95 % of the named ones)"),
    Threshold("coverage", 0.85, 0.95, "90 % intervals cover 85-95 %"),
    Threshold("second_ratio", 0.0, 1.05, "corrected second recording at most 1.05 of the oracle's residual (median)"),
)


EMPTY_CASES = Threshold("empty", 60, float("inf"), "at least 60 recordings without hidden physics")
FALSE_ALARMS = Threshold("false_alarms", 0.0, 0.07, "at most 7 % false alarms")
ADEQUATE = Threshold("adequate", 0.90, 1.0, "adequate in at least 90 %")
LOCATED = Threshold("unexplained_located", 0.80, 1.0, "unexplained, at the right state, in at least 80 %")
UNFIT = Threshold("unfit", 0.95, 1.0, "unfit in at least 95 %")
NOT_ADEQUATE = Threshold("adequate", 0.0, 0.0, "adequate in none (0 %)")
USEFUL_UNFIT = Threshold("useful_unfit", 0.0, 0.02, "unfit, for a usable simulation, in at most 2 %")
NAMED = Threshold("named", 0.90, 1.0, "named right, with z and z_sep of at least 10, in at least 90 %")
ALONE = Threshold("alone", 0.0, 0.15, "a single wrong name, without alternatives, in at most 15 %")
WRONG = Threshold("outside_wrong", 0.0, 0.03, "outside the catalogue, a name claimed in at most 3 %")

# Right and wrong results of a scenario, as the page shows them.
QUIET = "nothing hidden: adequate; hidden physics: its name, or an inseparable rival"
DISTURBED = "nothing hidden: unexplained, at the disturbed state or sensor; hidden physics: its name, or a rival"
NAMELESS = "nothing hidden: no name; hidden physics: its name, or an inseparable rival"
CLAIMED = "a name where nothing is hidden; unfit"

ORDINARY = (EMPTY_CASES, FALSE_ALARMS, USEFUL_UNFIT, NAMED)
"""Thresholds of every scenario with a usable simulation."""

WHITE = (*ORDINARY, ADEQUATE)
"""Thresholds of scenarios without disturbances."""

DISTURBED_STATE = (*ORDINARY, LOCATED)
"""Thresholds of scenarios with process noise in one state."""

LASTING = (EMPTY_CASES, ALONE, USEFUL_UNFIT)
"""Thresholds of one run with a disturbance as long as the run, which imitates any physics as slow as it."""

USELESS = (EMPTY_CASES, UNFIT, NOT_ADEQUATE)
"""Thresholds of unusable simulations."""

TOTALS = (FALSE_ALARMS, USEFUL_UNFIT, NAMED, WRONG)
"""Thresholds of all scenarios together."""
