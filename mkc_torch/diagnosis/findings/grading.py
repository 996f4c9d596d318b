"""What a finding is worth: whether unseen blocks confirm it, and how large it is beside the noise."""

from __future__ import annotations

import math
from typing import Literal

import torch

from mkc_torch.diagnosis.environment import Grade
from mkc_torch.diagnosis.result import Finding, HeldOut

__all__ = [
    "SMALL",
    "Confirmation",
    "change",
    "confirmation",
    "confirmed",
    "grade_in_short",
    "grade_of",
    "is_zero_within_error",
    "small",
    "transfers",
    "vetoed",
    "worth_correcting",
]

Confirmation = Literal["surely", "probably", "not shown", "worse"]

SMALL = 0.05
"""Share by which a finding has to make the residual smaller to be more than small beside the noise."""

_NORMAL_95 = 1.96
"""Standard errors to either side that a 95 % interval of a normal variable reaches."""


def confirmation(gain: float, interval: tuple[float, float]) -> Confirmation:
    """Whether a gain on unseen blocks shows that a model is better, by its 95 % interval.

    "probably" is a gain of more than one standard error whose interval reaches to 0.

    Example:
        >>> confirmation(0.3, (0.2, 0.4)), confirmation(0.13, (-0.02, 0.28)), confirmation(0.01, (-0.1, 0.1))
        ('surely', 'probably', 'not shown')
        >>> confirmation(-0.3, (-0.4, -0.2)), confirmation(0.3, (float("nan"), float("nan")))
        ('worse', 'not shown')
    """
    low, high = interval
    if low > 0.0:
        return "surely"
    if high < 0.0:
        return "worse"
    error = (high - low) / (2.0 * _NORMAL_95)
    return "probably" if math.isfinite(error) and gain > error else "not shown"


def confirmed(finding: Finding) -> bool:
    """Whether unseen blocks surely confirm it; of an event that cannot be held out the search alone has to.

    One without a size is none, whatever the blocks show: something that came with it, such as another noise, made the
    difference. One of a size that cannot be stands in for something else.
    """
    if is_zero_within_error(finding) or finding.cannot_be:
        return False
    held = finding.held_out
    if held is None:
        return True
    kind = confirmation(held.log_likelihood_gain, held.confidence_interval)
    return kind == "surely" if held.decides else not vetoed(held)


def vetoed(held_out: HeldOut) -> bool:
    """Whether unseen blocks speak against a finding: the free run is farther off, or it is less likely for no gain.

    Of several outputs the mean of the logarithms of their residuals counts: what mends one may spoil another.

    Example:
        >>> from mkc_torch.diagnosis.result import Sizes
        >>> each = {"angle": Sizes(2.0, 1.8, "rad"), "speed": Sizes(2.0, 3.0, "rad/s")}
        >>> vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.8, "", each))
        True
        >>> vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.0, "m")), vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 2.2, "m"))
        (False, True)
    """
    ratios = [_ratio(*pair) for pair in _sizes(held_out)]
    less = 1.0 - math.exp(sum(map(math.log, ratios)) / len(ratios))
    worse = confirmation(held_out.log_likelihood_gain, held_out.confidence_interval) == "worse"
    return less < -SMALL or (worse and less < SMALL)


def is_zero_within_error(finding: Finding) -> bool:
    """Whether each of its numbers is as well 0, within one standard error; of what has no standard errors, never."""
    known = [
        (torch.as_tensor(parameter.value), torch.as_tensor(parameter.standard_error))
        for parameter in finding.parameters
        if parameter.standard_error is not None
    ]
    return bool(known) and all(bool((value.abs() < error).all()) for value, error in known)


def change(held_out: HeldOut) -> float:
    """Share by which a finding makes the residual smaller, of the output where that is most; 0 where it is not known.

    Example:
        >>> round(change(HeldOut(0.3, (0.2, 0.4), 2.0, 1.5, "µT")), 3)
        0.25
        >>> from mkc_torch.diagnosis.result import Sizes
        >>> each = {"angle": Sizes(0.2, 0.1, "rad"), "speed": Sizes(3.0, 3.0, "rad/s")}
        >>> change(HeldOut(0.3, (0.2, 0.4), 3.0, 3.0, "", each))
        0.5
    """
    return 1.0 - min(_ratio(*pair) for pair in _sizes(held_out))


def _sizes(held_out: HeldOut) -> list[tuple[float, float]]:
    """Residuals before and after, of each output."""
    each = [(output.before, output.after) for output in held_out.outputs.values()]
    return each or [(held_out.rmse_before, held_out.rmse_after)]


def _ratio(before: float, after: float) -> float:
    """Of residuals after and before; 1 where it is not known."""
    return after / before if before > 0.0 and 0.0 < after / before < math.inf else 1.0


def small(finding: Finding) -> bool:
    """Whether it hardly makes the residual smaller: a mean over many samples shows it, a single sample does not."""
    return finding.held_out is not None and change(finding.held_out) < SMALL


def grade_of(finding: Finding) -> Grade:
    """What a finding is worth by its evidence, as long as its shape is the recording's.

    Example:
        >>> from mkc_torch.diagnosis.result import Told
        >>> held = HeldOut(0.02, (0.01, 0.03), 2.0, 1.96, "µT")
        >>> seen = (Told("held_out", (held, "")),)
        >>> grade_of(Finding("time_lag", (), (), (), None, "", "", (), 0.01, (), True, "", evidence=seen))
        'small'
    """
    if not confirmed(finding):
        return "unconfirmed"
    return "small" if small(finding) else "left_out"


def grade_in_short(finding: Finding) -> Grade:
    """The same where no noise was drawn, or nobody asked for its shape: only unseen blocks can confirm it.

    Blocks that only speak against a finding, as those of process noise do, do not.
    """
    held = finding.held_out
    if held is None or not held.decides:
        return "unconfirmed"
    return grade_of(finding)


def worth_correcting(finding: Finding) -> bool:
    """Whether a simulation is clearly better with it, in this form."""
    return finding.grade == "left_out"


def transfers(finding: Finding) -> bool:
    """Whether a model of it is of use on another recording.

    What belongs to the place of this one, or comes and goes at times that nothing tells, is not.
    """
    return worth_correcting(finding) and finding.plausible and not (finding.location_specific or finding.comes_and_goes)
