"""Thresholds for the diagnoses in each scenario. Set before the first scored run."""

from __future__ import annotations

from mkc_torch.challenge.thresholds import Threshold

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
