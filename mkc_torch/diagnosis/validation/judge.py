"""Decide whether a model holds in an output."""

from __future__ import annotations

import math
from dataclasses import replace

from mkc_torch._support.typesetting import plain
from mkc_torch.diagnosis.io.training import OutputTraining
from mkc_torch.diagnosis.thresholds import ABOVE_FLOOR, LARGER, LOST, SMALL, USEFUL
from mkc_torch.diagnosis.validation.blocks import Ratio, independent_ratio, paired_ratio
from mkc_torch.diagnosis.validation.result import OutputCheck


def claims(training: OutputTraining | None) -> bool:
    """Whether the findings make the residual of an output clearly smaller in the diagnosed recording: by 5 % or more,
    with the interval of the ratio below 1.

    Example:
        >>> from mkc_torch.diagnosis.io.training import BlockSquares
        >>> before = BlockSquares((4.0, 4.4, 3.6), (9, 9, 9))
        >>> claims(OutputTraining(before, BlockSquares((1.0, 1.2, 0.8), (9, 9, 9)))), claims(None)
        (True, False)
    """
    return training is not None and clearly_smaller(paired_ratio(training.corrected, training.baseline))


def clearly_smaller(ratio: Ratio) -> bool:
    """Whether a residual is clearly smaller: by 5 % or more, with the interval of the ratio below 1.

    Example:
        >>> clearly_smaller(Ratio(0.8, 0.7, 0.9)), clearly_smaller(Ratio(0.98, 0.97, 0.99))
        (True, False)
    """
    return ratio.value <= 1.0 - SMALL and ratio.high < 1.0


def clearly_larger(ratio: Ratio) -> bool:
    """Whether a residual is clearly larger: by more than 5 %, with the interval of the ratio above 1.

    Example:
        >>> clearly_larger(Ratio(1.2, 1.1, 1.3)), clearly_larger(Ratio(1.2, 0.9, 1.6))
        (True, False)
    """
    return ratio.value > LARGER and ratio.low > 1.0


def clearly_grown(growth: Ratio) -> bool:
    """Whether a residual is clearly larger than in the diagnosed recording: more than 1.5 times, with the interval
    above 1.

    The interval contains neither the error of the parameters nor that of the initial states, which are the same in all
    blocks; together they add a fifth to the residual in many recordings of a simulation that lacks nothing.

    Example:
        >>> clearly_grown(Ratio(1.9, 1.5, 2.4)), clearly_grown(Ratio(1.2, 1.1, 1.3))
        (True, False)
    """
    return growth.value > ABOVE_FLOOR and growth.low > 1.0


def judged(
    output: str,
    unit: str,
    new: OutputTraining,
    training: OutputTraining | None,
    explained: float,
    *,
    findings: bool,
    any_claim: bool,
) -> OutputCheck:
    """Return the check of an output.

    A claimed output fails unless its residual is clearly smaller with the findings; another output fails if it is
    clearly larger. A model that claims nothing in any output fails in an output whose
    residual is clearly larger than in the diagnosed recording.

    Args:
        output, unit: name and unit.
        new: residuals in the new recording.
        training: residuals in the diagnosed recording; None if they are unknown.
        explained: share of the output's variance that the simulation with the findings explains; nan if unknown.
        findings: whether the model has any; without them both simulations are the same.
        any_claim: whether the findings claim an improvement in any output.
    """
    ratio, claimed = paired_ratio(new.corrected, new.baseline), claims(training)
    missing = Ratio(math.nan, math.nan, math.nan)
    growth = missing if training is None else independent_ratio(new.corrected, training.corrected)
    name = plain(output)
    failure = ""
    if not math.isfinite(new.corrected.rmse):
        failure = f"{name}: it has no predicted samples."
    elif claimed and not clearly_smaller(ratio):
        failure = f"{name}: the findings do not make the residual clearly smaller: {_with_interval(ratio)} times."
    elif findings and clearly_larger(ratio):
        failure = f"{name}: the findings make the residual clearly larger: {_with_interval(ratio)} times."
    elif not any_claim and clearly_grown(growth):
        failure = (
            f"{name}: the residual is clearly larger than in the diagnosed recording: {_with_interval(growth)} times."
        )
    before = math.nan if training is None else training.corrected.rmse
    return OutputCheck(
        output, unit, new.baseline.rmse, new.corrected.rmse, before, ratio, growth, explained, claimed, failure
    )


def unless_lost(outputs: tuple[OutputCheck, ...]) -> tuple[OutputCheck, ...]:
    """Return the checks; if the simulation loses the recording, the outputs that it explains least fail.

    A simulation that goes its own way can be a little nearer to the recording with the findings than without, which
    means nothing. It loses a recording as one that is diagnosed does: if the mean share of the outputs' variance that
    it explains is too small for any verdict but unfit.
    """
    known = [each.explained for each in outputs if not math.isnan(each.explained)]
    if not known or sum(max(share, LOST) for share in known) / len(known) >= USEFUL:
        return outputs
    return tuple(replace(each, failure=each.failure or _lost(each)) for each in outputs)


def _lost(each: OutputCheck) -> str:
    if not each.explained < USEFUL:
        return ""
    share = f"{max(each.explained, 0.0):.0%} of the variance" if each.explained > 0 else "nothing of the variance"
    return (
        f"{plain(each.output)}: the simulation with the findings does not follow the recording: it explains {share}. "
        "If its free run leaves any recording, diagnose with `restart_after`."
    )


def _with_interval(ratio: Ratio) -> str:
    """Return a ratio with its interval.

    Example:
        >>> _with_interval(Ratio(0.5, 0.41, 0.62))
        '0.50 (95 % interval 0.41 to 0.62)'
    """
    if math.isnan(ratio.low):
        return f"{ratio.value:.2f} (too few samples for an interval)"
    return f"{ratio.value:.2f} (95 % interval {ratio.low:.2f} to {ratio.high:.2f})"
