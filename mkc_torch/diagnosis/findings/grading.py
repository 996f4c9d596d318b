"""Grade of a finding: confirmation on held-out blocks, and size relative to the noise."""

from __future__ import annotations

import math
from typing import Literal

import torch

from mkc_torch.diagnosis.environment import Grade, ShapeCheck
from mkc_torch.diagnosis.result import Finding, HeldOut

Confirmation = Literal["surely", "probably", "not shown", "worse"]

SMALL = 0.05
"""Relative reduction of the residual below which a finding is small."""

_NORMAL_95 = 1.96
"""Half-width of a 95 % interval in standard errors."""


def confirmation(gain: float, interval: tuple[float, float]) -> Confirmation:
    """Classify a gain on held-out blocks by its 95 % interval.

    "probably": a gain above its standard error whose interval contains 0.

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
    """Whether held-out blocks confirm a finding; the search confirms an event that cannot be held out.

    A finding of size 0 is unconfirmed whatever the blocks show: another change, such as of the noise model, made the
    difference. A finding of impossible size is a proxy of other physics. Blocks confirm by a surely larger likelihood,
    or by a larger one with a residual smaller by :data:`SMALL`: the surrogates have shown that the finding is no
    chance. Where blocks can only reject, because process noise predicts one step ahead as well, the open loop has to
    gain somewhere: its likelihood, or its residual on the blocks; a reduction there below :data:`SMALL` counts only
    with a larger likelihood.
    """
    if is_zero_within_error(finding) or finding.cannot_be:
        return False
    held = finding.held_out
    if held is None:
        return True
    kind = confirmation(held.log_likelihood_gain, held.confidence_interval)
    if held.decides:
        return kind == "surely" or better_on_average(held)
    least = 1.0 if kind == "surely" else 1.0 - SMALL
    return not vetoed(held) and (finding.clearly_better or mean_ratio(held) <= least)


def better_on_average(held_out: HeldOut) -> bool:
    """Whether likelihood and residual on held-out blocks are better in the mean, whatever the interval of the gain."""
    return held_out.log_likelihood_gain > 0.0 and mean_ratio(held_out) <= 1.0 - SMALL


def vetoed(held_out: HeldOut) -> bool:
    """Whether held-out blocks reject a finding: a larger open-loop residual, or a smaller likelihood without gain.

    Several outputs are combined by the geometric mean of their residual ratios.

    Example:
        >>> from mkc_torch.diagnosis.result import ResidualSizes
        >>> each = {"angle": ResidualSizes(2.0, 1.8, "rad"), "speed": ResidualSizes(2.0, 3.0, "rad/s")}
        >>> vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.8, "", each))
        True
        >>> vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 1.0, "m")), vetoed(HeldOut(0.0, (-0.1, 0.1), 2.0, 2.2, "m"))
        (False, True)
    """
    less = 1.0 - mean_ratio(held_out)
    worse = confirmation(held_out.log_likelihood_gain, held_out.confidence_interval) == "worse"
    return less < -SMALL or (worse and less < SMALL)


def mean_ratio(held_out: HeldOut) -> float:
    """Return the geometric mean over the outputs of the ratio of residuals with and without the finding."""
    ratios = [_ratio(*pair) for pair in _sizes(held_out)]
    return math.exp(sum(map(math.log, ratios)) / len(ratios))


def is_zero_within_error(finding: Finding) -> bool:
    """Whether all sizes are within a standard error of 0; False without standard errors.

    Numbers of the shape, such as a period, do not count: they exist at any size. A size that ended at a bound of 0 has
    a standard error of 0. Otherwise False as well if the open-loop fit without the finding is clearly less likely, and
    the residual on held-out blocks clearly smaller with it. Far from 0 the likelihood can be flat, as for the capacity
    of a large second store, and the standard error larger than the size (Hauck & Donner, Journal of the American
    Statistical Association 72 (1977), 851).
    """
    held = finding.held_out
    better = finding.clearly_better and (held is None or mean_ratio(held) <= 1.0 - SMALL)
    known = [
        (torch.as_tensor(parameter.value), torch.as_tensor(parameter.standard_error))
        for parameter in finding.parameters
        if parameter.standard_error is not None and not parameter.of_shape
    ]
    if known and not any(bool(value.any()) for value, _ in known):
        return True
    return bool(known) and not better and all(bool((value.abs() < error).all()) for value, error in known)


def change(held_out: HeldOut) -> float:
    """Return the largest relative reduction of an output's residual; 0 if unknown.

    Example:
        >>> round(change(HeldOut(0.3, (0.2, 0.4), 2.0, 1.5, "µT")), 3)
        0.25
        >>> from mkc_torch.diagnosis.result import ResidualSizes
        >>> each = {"angle": ResidualSizes(0.2, 0.1, "rad"), "speed": ResidualSizes(3.0, 3.0, "rad/s")}
        >>> change(HeldOut(0.3, (0.2, 0.4), 3.0, 3.0, "", each))
        0.5
    """
    return 1.0 - min(_ratio(*pair) for pair in _sizes(held_out))


def _sizes(held_out: HeldOut) -> list[tuple[float, float]]:
    """Return residual before and after of each output."""
    each = [(output.before, output.after) for output in held_out.outputs.values()]
    return each or [(held_out.rmse_before, held_out.rmse_after)]


def _ratio(before: float, after: float) -> float:
    """Return the ratio of residuals after and before; 1 if unknown."""
    return after / before if before > 0.0 and 0.0 < after / before < math.inf else 1.0


def small(finding: Finding) -> bool:
    """Whether a finding hardly reduces the residual; only means over many samples show it."""
    return finding.held_out is not None and change(finding.held_out) < SMALL


def grade_of(finding: Finding) -> Grade:
    """Return the grade of a finding by its evidence, without the test of its shape.

    Example:
        >>> from mkc_torch.diagnosis.result import EvidenceResult
        >>> held = HeldOut(0.02, (0.01, 0.03), 2.0, 1.96, "µT")
        >>> seen = (EvidenceResult("held_out", (held, "")),)
        >>> grade_of(Finding("time_lag", (), (), (), None, "", "", (), 0.01, (), True, "", evidence=seen))
        'small'
    """
    if not confirmed(finding):
        return "unconfirmed"
    return "small" if small(finding) else "left_out"


def with_shape(grade: Grade, shape: ShapeCheck | None) -> Grade:
    """Return the grade after the test of the shape: a confirmed finding of another shape has only the nearest name.

    An unconfirmed finding stays unconfirmed: held-out blocks do not show that its place lacks anything.

    Args:
        grade: by the other evidence.
        shape: result of the test of the shape; None if it was not tested.

    Example:
        >>> with_shape("small", ShapeCheck(1.2, 0.4))
        'small'
    """
    other = shape is not None and shape.curve is not None
    return "nearest" if other and grade != "unconfirmed" else grade


def grade_in_short(finding: Finding) -> Grade:
    """Return the grade without surrogates and without the test of the shape: only held-out blocks can confirm.

    They have to do so surely, and blocks that can only reject a finding, as with process noise, do not confirm it.
    """
    held = finding.held_out
    if held is None or not held.decides:
        return "unconfirmed"
    if confirmation(held.log_likelihood_gain, held.confidence_interval) != "surely":
        return "unconfirmed"
    return grade_of(finding)


def worth_correcting(finding: Finding) -> bool:
    """Whether the finding clearly improves the simulation."""
    return finding.grade == "left_out"


def transfers(finding: Finding) -> bool:
    """Whether a finding can be applied to another recording.

    Location-specific and intermittent findings cannot.
    """
    return worth_correcting(finding) and finding.plausible and not (finding.location_specific or finding.comes_and_goes)
