"""What is asked of diagnoses in the worlds. Set before the first scored run."""

from __future__ import annotations

from mkc_torch.challenge.thresholds import Threshold

EMPTY_CASES = Threshold("empty", 60, float("inf"), "at least 60 recordings with nothing hidden")
FALSE_ALARMS = Threshold("false_alarms", 0.0, 0.07, "at most 7 % false alarms")
ADEQUATE = Threshold("adequate", 0.90, 1.0, "adequate in at least 90 %")
LOCATED = Threshold("unexplained_located", 0.80, 1.0, "unexplained, at the right state, in at least 80 %")
UNFIT = Threshold("unfit", 0.95, 1.0, "unfit in at least 95 %")
NOT_ADEQUATE = Threshold("adequate", 0.0, 0.0, "adequate in none (0 %)")
USEFUL_UNFIT = Threshold("useful_unfit", 0.0, 0.02, "unfit, where the simulation is of use, in at most 2 %")
NAMED = Threshold("named", 0.90, 1.0, "named right, z and z_sep at least 10, in at least 90 %")
ALONE = Threshold("alone", 0.0, 0.15, "a name alone that is not the hidden one's in at most 15 %")
WRONG = Threshold("outside_wrong", 0.0, 0.03, "outside the catalogue a confident name in at most 3 %")

QUIET = "adequate where nothing is hidden; what is hidden, or a rival that cannot be told from it"
DISTURBED = "unexplained where nothing is hidden, at the state or sensor that is disturbed; what is hidden, or a rival"
NAMELESS = "no name where nothing is hidden; what is hidden, or a rival that cannot be told from it"
CLAIMED = "a name where nothing is hidden; unfit"
"""What is right to say in a world, and what is not, for the page."""

ORDINARY = (EMPTY_CASES, FALSE_ALARMS, USEFUL_UNFIT, NAMED)
"""Of every world in which the simulation is of use."""

WHITE = (*ORDINARY, ADEQUATE)
PUSHED = (*ORDINARY, LOCATED)
LASTING = (EMPTY_CASES, ALONE, USEFUL_UNFIT)
"""Of one run under a push that lasts as long, which imitates any physics that changes as slowly."""

USELESS = (EMPTY_CASES, UNFIT, NOT_ADEQUATE)
TOTALS = (FALSE_ALARMS, USEFUL_UNFIT, NAMED, WRONG)
